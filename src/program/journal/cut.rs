//! `palpate journal cut`: a part of a journal, as a journal.

use std::path::PathBuf;

use palpate_session::journal::recover;

use super::super::Failure;
use super::JournalSource;
use super::output::{new_file, unwritten};

#[derive(clap::Args)]
pub(super) struct CutArguments {
    #[command(flatten)]
    source: JournalSource,
    /// The first step of the part
    #[arg(long, value_name = "STEP")]
    from: u64,
    /// The last step of the part
    #[arg(long, value_name = "STEP")]
    to: u64,
    /// The new journal file
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
}

/// Cuts a journal.
pub(super) fn cut(arguments: &CutArguments) -> Result<(), Failure> {
    let CutArguments { source, from, to, output } = arguments;
    let limits = source.limits()?;
    let reader = source.open()?;
    let mut file = new_file(output)?;
    let survey = recover::cut(reader, [*from, *to], &limits, &mut file).inspect_err(|_| {
        // A half-written journal is useless.
        let _ = std::fs::remove_file(output);
    })?;
    file.sync_all().map_err(|e| unwritten(output, &e))?;
    // All requested steps were there.
    source.tell_damage(survey.damage.as_deref(), survey.until_step, Some(*to))
}
