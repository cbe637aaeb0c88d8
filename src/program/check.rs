//! `palpate check`: reports what a scene needs.

use std::io::Write;

use palpate::session::check;

pub(crate) use super::scene::SceneArguments as CheckArguments;
use super::scene::compile;
use super::{Failure, clock_s};

/// Reports what a scene needs.
pub(crate) fn check(arguments: &CheckArguments) -> Result<(), Failure> {
    let (model, limits) = compile(arguments)?;
    let report = check::check(&model, &limits, &clock_s);
    match write!(std::io::stdout(), "{report}") {
        // A reader that closed the pipe is not an error.
        Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => Err(Failure::Failed(e.to_string())),
        _ => Ok(()),
    }
}
