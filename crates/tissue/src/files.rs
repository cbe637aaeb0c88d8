//! Reads files that users name, up to a bound and without waiting forever; and creates files that only their owner can
//! access.

use std::fs::{DirBuilder, File, OpenOptions};
use std::io::{ErrorKind, Read};
use std::path::Path;
use std::time::Duration;

use palpate_refusal::{Reason, Refusal, Result};

/// How long the writer of a pipe may be silent.
const PIPE_TIMEOUT: Duration = Duration::from_secs(30);

/// Bound to pass as `most` for a file with a key, a certificate, a password or tokens: 1 MiB, in bytes. The
/// functions here don't apply it by themselves.
pub const MAX_SECRET_BYTES: u64 = 1 << 20;

/// Reads all bytes, at most `most`, of a path from a command line: a file, a device, or a pipe such as `<(…)`.
/// It blocks until the end of the file or pipe; links are followed.
///
/// # Errors
/// Refuses a path that can't be opened or read, and a folder ([`Reason::Unreadable`]); more than `most` bytes
/// ([`Reason::TooLarge`]); and, on Unix, a pipe or device that supplies nothing for 30 s at any time
/// (`Unreadable`; other systems wait without end). [`Refusal::place`] is the path.
pub fn read(path: &Path, most: u64) -> Result<Vec<u8>> {
    read_within(path, most, PIPE_TIMEOUT)
}

/// Reads text of at most `most` bytes from a path of a command line: a file, a device, or a pipe. It blocks as
/// [`read`] does.
///
/// # Errors
/// Refuses everything that [`read`] refuses, and bytes that are not UTF-8 ([`Reason::Unreadable`]).
pub fn read_text(path: &Path, most: u64) -> Result<String> {
    text(path, read(path, most)?)
}

/// Reads all bytes, at most `most`, of a regular file; links are followed. Use it for files that a server reads
/// by itself or that another file names: it never waits for the writer of a pipe.
///
/// # Errors
/// Refuses a path that can't be opened or read, a folder, a pipe and a device ([`Reason::Unreadable`]), and a
/// file of more than `most` bytes ([`Reason::TooLarge`]). [`Refusal::place`] is the path.
pub fn read_regular(path: &Path, most: u64) -> Result<Vec<u8>> {
    let (file, is_regular) = open(path)?;
    if is_regular { bytes_of(path, file, most) } else { Err(refuse(path, "is not a regular file")) }
}

/// Reads text of at most `most` bytes from a regular file. Use it for files that a server reads by itself or
/// that another file names.
///
/// # Errors
/// Refuses everything that [`read_regular`] refuses, and bytes that are not UTF-8 ([`Reason::Unreadable`]).
pub fn read_regular_text(path: &Path, most: u64) -> Result<String> {
    text(path, read_regular(path, most)?)
}

/// Returns options for writing a file that only its owner can access, if it is created by them: for keys, tokens and
/// journals. On Windows the file has the access rights of its folder.
pub fn private_options() -> OpenOptions {
    let mut options = File::options();
    options.write(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    options
}

/// Creates a folder, with those above it, that only its owner can access; a folder that exists stays as it is. On Windows
/// it has the access rights of the folder above it.
///
/// # Errors
/// Returns the system's error.
pub fn create_private_folder(path: &Path) -> std::io::Result<()> {
    let mut builder = DirBuilder::new();
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    builder.recursive(true).create(path)
}

fn refuse(path: &Path, message: impl Into<String>) -> Refusal {
    let place = Some(path.display().to_string());
    Refusal { place, ..Refusal::new(Reason::Unreadable, "", message) }
}

fn too_large(path: &Path, most: u64) -> Refusal {
    Refusal { reason: Reason::TooLarge, ..refuse(path, format!("is larger than the limit of {most} bytes")) }
}

fn text(path: &Path, bytes: Vec<u8>) -> Result<String> {
    String::from_utf8(bytes).map_err(|e| refuse(path, format!("is not UTF-8 text: {e}")))
}

/// Opens a file without blocking, which would happen for a pipe without a writer. Also returns whether it is a
/// regular file.
fn open(path: &Path) -> Result<(File, bool)> {
    let mut options = File::options();
    options.read(true);
    #[cfg(unix)]
    {
        let flags = rustix::fs::OFlags::NONBLOCK.bits().cast_signed();
        std::os::unix::fs::OpenOptionsExt::custom_flags(&mut options, flags);
    }
    let file = options.open(path).map_err(|e| refuse(path, format!("can't be opened: {e}")))?;
    let data = file.metadata().map_err(|e| refuse(path, format!("can't be read: {e}")))?;
    if data.is_dir() { Err(refuse(path, "is a folder")) } else { Ok((file, data.is_file())) }
}

/// Reads all bytes of a regular file, at most `most`.
fn bytes_of(path: &Path, file: File, most: u64) -> Result<Vec<u8>> {
    if file.metadata().is_ok_and(|data| data.len() > most) {
        return Err(too_large(path, most));
    }
    let mut bytes = Vec::new();
    file.take(most + 1).read_to_end(&mut bytes).map_err(|e| refuse(path, format!("can't be read: {e}")))?;
    if bytes.len() as u64 > most { Err(too_large(path, most)) } else { Ok(bytes) }
}

fn read_within(path: &Path, most: u64, patience: Duration) -> Result<Vec<u8>> {
    let (mut file, is_regular) = open(path)?;
    if is_regular {
        return bytes_of(path, file, most);
    }
    let mut bytes = Vec::new();
    let mut part = [0; 1 << 16];
    loop {
        await_bytes(path, &file, patience)?;
        match file.read(&mut part) {
            Ok(0) => return Ok(bytes),
            Ok(count) if (bytes.len() + count) as u64 > most => return Err(too_large(path, most)),
            Ok(count) => bytes.extend_from_slice(&part[..count]),
            Err(e) if matches!(e.kind(), ErrorKind::Interrupted | ErrorKind::WouldBlock) => {}
            Err(e) => return Err(refuse(path, format!("can't be read: {e}"))),
        }
    }
}

/// Waits until there is something to read, or no writer is left.
#[cfg(unix)]
fn await_bytes(path: &Path, file: &File, patience: Duration) -> Result<()> {
    use rustix::event::{PollFd, PollFlags, Timespec, poll};
    let nothing = || refuse(path, format!("is no regular file, and nobody has written into it for {patience:?}"));
    let patience = Timespec::try_from(patience).map_err(|_| nothing())?;
    match poll(&mut [PollFd::new(file, PollFlags::IN)], Some(&patience)) {
        Ok(0) => Err(nothing()),
        // Reading reports other errors.
        Ok(_) | Err(_) => Ok(()),
    }
}

#[cfg(not(unix))]
fn await_bytes(_: &Path, _: &File, _: Duration) -> Result<()> {
    Ok(())
}

#[cfg(all(test, unix))]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::io::Write;

    use super::*;

    fn pipe(path: &Path) {
        assert!(std::process::Command::new("mkfifo").arg(path).status().unwrap().success());
    }

    fn why<T: std::fmt::Debug>(told: Result<T>) -> String {
        told.unwrap_err().to_string()
    }

    #[test]
    fn a_pipe_is_read_from_who_writes_and_nobody_else_is_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pipe");
        pipe(&path);
        // The test would hang here.
        let silent = why(read_within(&path, 10, Duration::from_millis(10)));
        assert!(silent.contains("pipe: is no regular file, and nobody has written"), "{silent}");
        assert!(why(read_regular(&path, 10)).contains("is not a regular file"));
        for (sent, most) in [(100_000, 100_000), (100_000, 99_999), (0, 10)] {
            let (into, bytes) = (path.clone(), vec![b'a'; sent]);
            let writing = std::thread::spawn(move || {
                let written = File::options().write(true).open(into).unwrap().write_all(&bytes);
                // The reader may have stopped at its bound.
                drop(written);
            });
            match read_within(&path, most, PIPE_TIMEOUT) {
                Ok(bytes) => assert!(bytes.len() == sent && sent as u64 <= most),
                Err(refusal) => assert!(refusal.reason == Reason::TooLarge && sent as u64 > most, "{refusal}"),
            }
            writing.join().unwrap();
        }
    }

    #[test]
    fn what_has_no_end_and_what_is_no_file_is_refused_by_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let zero = Path::new("/dev/zero");
        assert_eq!(read(zero, 1000).unwrap_err().reason, Reason::TooLarge);
        assert!(why(read_regular(zero, 1000)).contains("/dev/zero: is not a regular file"));
        assert!(why(read(folder.path(), 1000)).contains("is a folder"));
        assert!(why(read(&folder.path().join("none"), 1000)).contains("none: can't be opened"));
        let path = folder.path().join("text");
        std::fs::write(&path, b"1234\xff").unwrap();
        assert_eq!(read(&path, 4).unwrap_err().reason, Reason::TooLarge);
        assert_eq!(read(&path, 5).unwrap(), b"1234\xff");
        assert!(why(read_regular_text(&path, 5)).contains("UTF-8"));
        let link = folder.path().join("link");
        std::os::unix::fs::symlink(&path, &link).unwrap();
        assert_eq!(read_regular(&link, 5).unwrap(), b"1234\xff");
    }
}
