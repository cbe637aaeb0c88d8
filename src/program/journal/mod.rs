//! `palpate journal`: lists, shows, verifies, replays, draws, exports, cuts and recovers journals of sessions.

mod cut;
mod draw;
mod export;
mod foxglove;
mod list;
mod output;
mod records;
mod recover;
mod show;
mod verify;

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use palpate::journal::{Reader, Replay};
use palpate::limits::Limits;

use super::{Failure, load_config, with_progress};

#[derive(clap::Args)]
pub(crate) struct JournalArguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(clap::Subcommand)]
enum Command {
    /// List the journals of a folder: sessions, runs, steps, sizes, and how each ends
    List(list::ListArguments),
    /// Show what happened in a session, as lines
    Show(show::ShowArguments),
    /// Simulate journals again and compare every hash; name the first step that differs
    #[command(
        after_help = "Exit status: 0 when all hashes are equal; 1 when one differs; 2 when a journal can't be read, or was \
        written by a version whose bits are others."
    )]
    Verify(verify::VerifyArguments),
    /// Simulate a journal again, and write records as `palpate run` does; or play it on a server
    Replay(records::ReplayArguments),
    /// Draw a session: a PNG image of one moment, or a GIF of all of it
    Render(draw::RenderArguments),
    /// Write what was felt as JSON Lines or CSV, or curves and a moving surface as MCAP for Foxglove
    Export(export::ExportArguments),
    /// Write a part of a journal: a journal that verifies alone
    Cut(cut::CutArguments),
    /// Finish a journal whose server was killed, up to its last whole batch; tell what was lost
    Recover(recover::RecoverArguments),
}

/// A journal that is simulated.
#[derive(clap::Args)]
struct Source {
    /// The journal
    file: PathBuf,
    /// Configuration file (TOML) with other limits, in a section [limits]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

impl Source {
    fn limits(&self) -> Result<Limits, Failure> {
        limits(self.config.as_deref())
    }

    fn open(&self) -> Result<Reader<BufReader<File>>, Failure> {
        Ok(Reader::open(&self.file)?)
    }

    /// A replay from the beginning, or from the newest snapshot before a step.
    fn replay(&self, from: Option<u64>) -> Result<Replay<BufReader<File>>, Failure> {
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

/// Does what the arguments say.
pub(crate) fn journal(arguments: &JournalArguments) -> Result<(), Failure> {
    match &arguments.command {
        Command::List(arguments) => list::list(arguments),
        Command::Show(arguments) => show::show(arguments),
        Command::Verify(arguments) => verify::verify(arguments),
        Command::Replay(arguments) => records::replay(arguments),
        Command::Render(arguments) => draw::render(arguments),
        Command::Export(arguments) => export::export(arguments),
        Command::Cut(arguments) => cut::cut(arguments),
        Command::Recover(arguments) => recover::recover(arguments),
    }
}
