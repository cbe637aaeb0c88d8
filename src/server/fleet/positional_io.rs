//! Reads and writes parts of files at a given place.

use std::fs::File;
use std::io::Result;

/// Reads exactly `bytes.len()` bytes from `offset` on.
///
/// # Errors
/// Returns the system's error, or one of the kind `UnexpectedEof` if the file ends before.
pub(super) fn read_exact_at(file: &File, bytes: &mut [u8], offset: u64) -> Result<()> {
    #[cfg(unix)]
    return std::os::unix::fs::FileExt::read_exact_at(file, bytes, offset);
    #[cfg(not(unix))]
    {
        use std::io::{Read, Seek, SeekFrom};
        let mut file = file;
        file.seek(SeekFrom::Start(offset))?;
        file.read_exact(bytes)
    }
}

/// Writes all `bytes` from `offset` on.
///
/// # Errors
/// Returns the system's error; then some of the bytes may be written.
pub(super) fn write_all_at(file: &File, bytes: &[u8], offset: u64) -> Result<()> {
    #[cfg(unix)]
    return std::os::unix::fs::FileExt::write_all_at(file, bytes, offset);
    #[cfg(not(unix))]
    {
        use std::io::{Seek, SeekFrom, Write};
        let mut file = file;
        file.seek(SeekFrom::Start(offset))?;
        file.write_all(bytes)
    }
}
