//! `palpate journal verify`: simulates journals again, and compares every hash.

use std::path::PathBuf;

use palpate::journal::{Reader, Replay, Verdict};

use super::super::{Failure, clock_s, say, with_progress};
use super::limits;

#[derive(clap::Args)]
pub(super) struct VerifyArguments {
    /// The journals
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Configuration file (TOML) with other limits, in a section [limits]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

/// Verifies journals, each by itself; the worst decides how the program ends.
pub(super) fn verify(arguments: &VerifyArguments) -> Result<(), Failure> {
    let limits = limits(arguments.config.as_deref())?;
    let (mut differs, mut unread) = (Vec::new(), Vec::new());
    for path in &arguments.files {
        let (name, begun_s) = (path.display(), clock_s());
        let verdict = Reader::open(path).and_then(|mut reader| {
            let survey = reader.survey(&mut |_| {})?;
            let last = survey.until_step;
            let replay = Replay::new(reader, survey, &limits)?;
            with_progress("step", last, false, |progress| replay.verify(&mut |step, _| progress(step)))
        });
        match verdict {
            Err(refusal) => unread.push(refusal.to_string()),
            Ok(Verdict { difference: Some(difference), .. }) => differs.push(format!("{name}: {difference}")),
            Ok(Verdict { steps: [from, to], compared: [hashes, snapshots], .. }) => say!(
                "{name}: steps {from} to {to} are the same: {hashes} hashes, {snapshots} snapshots, in {:.2} s",
                clock_s() - begun_s
            ),
        }
    }
    let failure = if unread.is_empty() { Failure::Failed } else { Failure::Refused };
    let mut problems = [unread, differs].concat();
    let last = problems.pop();
    for problem in problems {
        say!("palpate: {problem}");
    }
    last.map_or(Ok(()), |problem| Err(failure(problem)))
}
