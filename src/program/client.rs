//! `palpate top` and `palpate admin`: commands of `palpate-client`.

use std::process::ExitCode;

use super::say;

/// Runs a command of `palpate-client`, which must be in the folder of this program.
pub(crate) fn client(command: &str, arguments: &[std::ffi::OsString]) -> ExitCode {
    let program = std::env::current_exe().unwrap_or_default().with_file_name("palpate-client");
    match std::process::Command::new(&program).arg(command).args(arguments).status() {
        Ok(status) => status.code().and_then(|code| u8::try_from(code).ok()).map_or(ExitCode::FAILURE, ExitCode::from),
        Err(e) => {
            say!("palpate: {}: {e}", program.display());
            ExitCode::FAILURE
        }
    }
}
