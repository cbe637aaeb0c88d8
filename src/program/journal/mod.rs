//! `palpate journal`: lists, shows, verifies, replays, scores, draws, exports, cuts and recovers journals of sessions.

mod compare;
mod cut;
mod draw;
mod export;
mod foxglove;
mod key;
mod list;
mod output;
mod records;
mod recover;
mod score;
mod show;
mod verify;
mod xapi;

use std::path::{Path, PathBuf};

use palpate_session::journal::{JournalReader, Replay};
use palpate_tissue::limits::Limits;

use super::{Failure, load_config, say, with_progress};

#[derive(clap::Args)]
pub(crate) struct JournalArguments {
    #[command(subcommand)]
    command: JournalCommand,
}

#[derive(clap::Subcommand)]
enum JournalCommand {
    /// List the journals of a folder: sessions, runs, steps, sizes, and the kind of end
    List(list::ListArguments),
    /// Show the events of a session, one per line
    Show(show::ShowArguments),
    /// Simulate journals again and compare every hash; report the first step that differs, and the number of proven
    /// steps
    #[command(
        after_help = "A step is proven if a hash at or after that step is equal: the inputs in the file give these \
        bits. Anyone who can change a file can change its hashes too. --signed-by checks the signatures of the \
        server that wrote the file.\n\n\
        Exit status: 0 when all hashes are equal, or when there are none; 1 when one differs, or a signature is \
        missing or wrong; 2 when a journal can't be read, is damaged, or was written by a version that computes \
        other bits."
    )]
    Verify(verify::VerifyArguments),
    /// Simulate a journal again, and write records as `palpate run` does; or play it on a server
    Replay(records::ReplayArguments),
    /// Measure what the tools of a session did: time, path, smoothness, force, presses and coverage, as a table, as JSON,
    /// or as a report to print
    Score(score::ScoreArguments),
    /// Compare the figures of several sessions: a learning curve, percentiles, CSV for statistics
    Compare(compare::CompareArguments),
    /// Draw a session: a PNG image of one moment, or a GIF of all of it
    Render(draw::RenderArguments),
    /// Write places and forces of tools as JSON Lines or CSV, or curves and a moving surface as MCAP for Foxglove
    Export(export::ExportArguments),
    /// Write a part of a journal, as a journal that you can verify alone
    Cut(cut::CutArguments),
    /// Complete a journal that is damaged or whose server was killed, up to its last whole batch; report what was
    /// lost
    Recover(recover::RecoverArguments),
    /// Make a key with which a server signs its journals
    Key(key::KeyArguments),
}

/// A journal that is simulated.
#[derive(clap::Args)]
struct JournalSource {
    /// The journal
    file: PathBuf,
    /// Configuration file (TOML) with other limits, in a section [limits]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

impl JournalSource {
    fn limits(&self) -> Result<Limits, Failure> {
        limits(self.config.as_deref())
    }

    /// Opens the journal, up to a damaged place if there is one.
    fn open(&self) -> Result<JournalReader<'static>, Failure> {
        Ok(JournalReader::open(&self.file)?.up_to_damage())
    }

    /// Reports damage after all whole parts were written. Returns an error if steps after `until` were requested.
    fn tell_damage(&self, damage: Option<&str>, until: u64, wanted: Option<u64>) -> Result<(), Failure> {
        let Some(damage) = damage else { return Ok(()) };
        let message = format!("{}: {damage}; it is whole up to step {until}", self.file.display());
        if wanted.is_some_and(|wanted| wanted <= until) {
            say!("palpate: warning: {message}");
            return Ok(());
        }
        Err(Failure::Refused(format!("{message}; the output ends there")))
    }

    /// Begins a replay at the beginning, or at the newest snapshot before a step.
    fn replay(&self, from: Option<u64>) -> Result<Replay<'static>, Failure> {
        let mut reader = self.open()?;
        let length = reader.length();
        let survey = with_progress("byte", length, false, |progress| reader.survey(progress))?;
        let limits = self.limits()?;
        Ok(match from {
            Some(step) => Replay::near(reader, survey, &limits, step)?,
            None => Replay::new(reader, survey, &limits)?,
        })
    }
}

fn limits(config: Option<&Path>) -> Result<Limits, Failure> {
    Ok(load_config(config)?.limits)
}

/// Runs the subcommand.
pub(crate) fn journal(arguments: &JournalArguments) -> Result<(), Failure> {
    match &arguments.command {
        JournalCommand::List(arguments) => list::list(arguments),
        JournalCommand::Show(arguments) => show::show(arguments),
        JournalCommand::Verify(arguments) => verify::verify(arguments),
        JournalCommand::Replay(arguments) => records::replay(arguments),
        JournalCommand::Score(arguments) => score::score(arguments),
        JournalCommand::Compare(arguments) => compare::compare(arguments),
        JournalCommand::Render(arguments) => draw::render(arguments),
        JournalCommand::Export(arguments) => export::export(arguments),
        JournalCommand::Cut(arguments) => cut::cut(arguments),
        JournalCommand::Recover(arguments) => recover::recover(arguments),
        JournalCommand::Key(arguments) => key::key(arguments),
    }
}
