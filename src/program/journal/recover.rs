//! `palpate journal recover`: finishes a journal whose server was killed, or that is damaged.

use std::path::{Path, PathBuf};

use palpate_session::journal::{JournalReader, Survey, recover};

use super::super::{Failure, say, with_progress};
use super::output::{new_file, unwritten};

#[derive(clap::Args)]
pub(super) struct RecoverArguments {
    /// The journal
    file: PathBuf,
    /// The completed journal [default: replaces FILE; a damaged FILE is kept as FILE.damaged]
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

/// Recovers a journal into a new file, which finally replaces the old one if no other file is given.
pub(super) fn recover(arguments: &RecoverArguments) -> Result<(), Failure> {
    let RecoverArguments { file, output } = arguments;
    let beside = file.with_extension("mcap.part");
    let target = output.as_deref().unwrap_or(&beside);
    let reader = JournalReader::open(file)?.up_to_damage();
    let length = reader.length();
    let mut new = new_file(target)?;
    let recovered = with_progress("byte", length, false, |progress| recover::recover(reader, &mut new, progress));
    let survey = match recovered {
        Ok(survey) => survey,
        Err(refusal) => {
            let _ = std::fs::remove_file(target);
            return Err(refusal.into());
        }
    };
    new.sync_all().map_err(|e| unwritten(target, &e))?;
    if output.is_none() {
        if survey.damage.is_some() {
            // The bytes after the damage may still be useful.
            let damaged = file.with_extension("mcap.damaged");
            std::fs::rename(file, &damaged).map_err(|e| unwritten(&damaged, &e))?;
            say!("{}: the file as it was is {}", file.display(), damaged.display());
        }
        std::fs::rename(target, file).map_err(|e| unwritten(file, &e))?;
    }
    tell(output.as_deref().unwrap_or(file), &survey);
    Ok(())
}

fn tell(path: &Path, survey: &Survey) {
    let Survey { until_step, torn_bytes, end, sealed, damage, .. } = survey;
    if let Some(damage) = damage {
        return say!("{}: complete up to step {until_step}; {damage}; {torn_bytes} bytes are lost", path.display());
    }
    let was = match (end, torn_bytes) {
        (Some(_), _) if *sealed => "it was finished already".to_owned(),
        (Some(_), _) => "its end was there; it has a summary now".to_owned(),
        (None, 0) => "nothing was lost that had been written; its end was missing".to_owned(),
        (None, bytes) => format!("{bytes} bytes at its end belonged to no whole batch, and are lost"),
    };
    say!("{}: complete up to step {until_step}; {was}", path.display());
}
