//! Commands of `palpate-client`: `palpate top`, `palpate admin` and `palpate cluster`, and `palpate journal replay` with a server.

use super::Failure;

/// Runs a command of `palpate-client`, which must be in the folder of this program.
///
/// # Errors
/// Returns an error if there is no such program, and its exit status if that is not 0.
pub(crate) fn client(command: &str, arguments: &[std::ffi::OsString]) -> Result<(), Failure> {
    let program = std::env::current_exe()
        .unwrap_or_default()
        .with_file_name(format!("palpate-client{}", std::env::consts::EXE_SUFFIX));
    let ran = std::process::Command::new(&program).arg(command).args(arguments).status();
    let status = ran.map_err(|e| Failure::Failed(format!("{}: {e}", program.display())))?;
    if status.success() {
        return Ok(());
    }
    Err(Failure::Told(status.code().and_then(|code| u8::try_from(code).ok()).unwrap_or(1)))
}
