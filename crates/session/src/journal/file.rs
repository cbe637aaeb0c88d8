//! File names of journals in a folder.

use std::path::{Path, PathBuf};

/// File of the journal of one run, found in a folder by its name. Ordered by session, then run.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct JournalFile {
    /// ID of the session.
    pub session_id: String,
    /// Number of the run, from 1.
    pub run: u64,
    /// Path of the file.
    pub path: PathBuf,
}

/// Length limit of a session's ID in a file name, bytes.
const MAX_LETTERS: usize = 128;

/// Returns the file name of a run: `SESSION.RUN.mcap`, with RUN in decimal. It does not check the ID.
pub fn name(session_id: &str, run: u64) -> String {
    format!("{session_id}.{run}.mcap")
}

/// Returns the session and the run of a file name without folders. `None` if it is not `SESSION.RUN.mcap`, with 1 to
/// 128 ASCII letters, digits, `-` and `_`, and a run of at least 1 without leading zeros.
pub fn parse(name: &str) -> Option<(String, u64)> {
    let (session_id, run) = name.strip_suffix(".mcap")?.rsplit_once('.')?;
    let is_letter = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
    let is_id = !session_id.is_empty() && session_id.len() <= MAX_LETTERS && session_id.chars().all(is_letter);
    let number = run.parse().ok()?;
    // Each run has one name: no sign, and no leading zeros.
    (is_id && number > 0 && run == format!("{number}")).then(|| (session_id.to_owned(), number))
}

/// Returns the journals in a folder, sorted by session and run number. Only regular files, or links to them, with a
/// name that [`parse`] accepts count. Folders within it are not searched.
///
/// # Errors
/// Returns the error of the system if the folder is absent or can't be read.
pub fn list(folder: &Path) -> std::io::Result<Vec<JournalFile>> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        let told = path.file_name().and_then(|name| name.to_str()).and_then(parse);
        if let Some((session_id, run)) = told
            && std::fs::metadata(&path).is_ok_and(|found| found.is_file())
        {
            found.push(JournalFile { session_id, run, path });
        }
    }
    found.sort();
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_tells_session_and_run_and_nothing_else_does() {
        assert_eq!(parse(&name("0123abc", 17)), Some(("0123abc".to_owned(), 17)));
        for other in
            ["a.mcap", "a.0.mcap", "a.01.mcap", "a.+1.mcap", "../a.1.mcap", "a.1.mcap.part", ".1.mcap", "a/b.1.mcap"]
        {
            assert_eq!(parse(other), None, "{other}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn a_pipe_is_no_journal_and_nobody_waits_for_it() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join(name("pipe", 1));
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        std::fs::create_dir(folder.path().join(name("folder", 1))).unwrap();
        std::fs::write(folder.path().join(name("file", 1)), "").unwrap();
        let listed = list(folder.path()).unwrap();
        assert_eq!(listed.iter().map(|file| file.session_id.as_str()).collect::<Vec<_>>(), ["file"]);
        let refused = crate::journal::reader::file(&pipe).unwrap_err();
        assert!(refused.message.contains("it is not a file"), "{refused}");
    }
}
