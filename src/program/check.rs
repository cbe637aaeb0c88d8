//! `palpate check`: reports what a scene needs, and what to expect of it.

use std::io::Write;
use std::path::PathBuf;

use palpate::printable::printable_lines;
use palpate::scene::collection::find_script;
use palpate::session::check;

use super::scene::{SceneArguments, compile};
use super::{Failure, clock_s, say};

#[derive(clap::Args)]
pub(crate) struct CheckArguments {
    #[command(flatten)]
    scene: SceneArguments,
    /// A script to check with it: a file, or the name of a script in ./scripts
    script: Option<PathBuf>,
}

/// Reports what a scene needs, and what to expect of it.
pub(crate) fn check(arguments: &CheckArguments) -> Result<(), Failure> {
    let (model, limits) = compile(&arguments.scene)?;
    let script = arguments.script.as_ref().map(|path| find_script(path, &model.scene, &limits)).transpose()?;
    for warning in script.iter().flat_map(|script| &script.warnings) {
        say!("palpate: warning: {warning}");
    }
    let report = check::check(&model, script.as_ref(), &limits, &clock_s);
    match write!(std::io::stdout(), "{}", printable_lines(report)) {
        // A reader that closed the pipe is not an error.
        Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => Err(Failure::Failed(e.to_string())),
        _ => Ok(()),
    }
}
