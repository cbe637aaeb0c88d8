//! Output of `palpate journal`: the standard output or a file.

use std::fs::File;
use std::io::{BufWriter, ErrorKind, Write};
use std::path::Path;

use super::super::Failure;
use palpate_tissue::files;

/// The standard output, or a file.
pub(super) fn output(file: Option<&Path>) -> Result<Box<dyn Write>, Failure> {
    let Some(path) = file else { return Ok(Box::new(BufWriter::new(std::io::stdout()))) };
    let file = File::create(path).map_err(|e| unwritten(path, &e))?;
    Ok(Box::new(BufWriter::new(file)))
}

/// Creates a file that only its owner can read and write. Does not overwrite an existing file.
pub(super) fn new_file(path: &Path) -> Result<File, Failure> {
    files::private_options().read(true).create_new(true).open(path).map_err(|e| match e.kind() {
        ErrorKind::AlreadyExists => Failure::Refused(format!("{}: exists already; give another name", path.display())),
        _ => unwritten(path, &e),
    })
}

/// Returns the failure for a file that can't be written.
pub(super) fn unwritten(path: &Path, e: &std::io::Error) -> Failure {
    Failure::Failed(format!("{}: can't be written: {e}", path.display()))
}

/// Ends the program quietly if a reader closed the pipe.
pub(super) fn written(result: std::io::Result<()>) -> Result<(), Failure> {
    match result {
        Err(e) if e.kind() != ErrorKind::BrokenPipe => Err(Failure::Failed(format!("can't write the output: {e}"))),
        _ => Ok(()),
    }
}

/// Returns a time in UTC as a text: `2026-01-31 12:34:56.789`.
pub(super) fn utc(unix_ns: u64) -> String {
    let (seconds, millis) = (unix_ns / 1_000_000_000, unix_ns / 1_000_000 % 1000);
    let (days, second) = (seconds / 86_400, seconds % 86_400);
    // Years of 365.2425 days from 0000-03-01 (H. Hinnant, chrono-compatible low-level date algorithms).
    let shifted = days + 719_468;
    let (era, day_of_era) = (shifted / 146_097, shifted % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month_from_march = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * month_from_march + 2) / 5 + 1;
    let month = if month_from_march < 10 { month_from_march + 3 } else { month_from_march - 9 };
    let year = year_of_era + era * 400 + u64::from(month <= 2);
    let (hour, minute) = (second / 3600, second / 60 % 60);
    format!("{year:04}-{month:02}-{day:02} {hour:02}:{minute:02}:{:02}.{millis:03}", second % 60)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_is_that_of_the_calendar() {
        for (unix_s, text) in [
            (0, "1970-01-01 00:00:00.000"),
            (951_782_400, "2000-02-29 00:00:00.000"),
            (1_767_225_599, "2025-12-31 23:59:59.000"),
            (4_107_542_399, "2100-02-28 23:59:59.000"),
        ] {
            assert_eq!(utc(unix_s * 1_000_000_000), text);
        }
        assert_eq!(utc(1_767_225_600_123_456_789), "2026-01-01 00:00:00.123");
    }
}
