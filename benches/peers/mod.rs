//! Implementations of the step in Python's compilers, run if PEERS names a Python that has them (`make bench-kernel`).
#![allow(unreachable_pub)]

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

/// Returns the Python of the peers. Prints how to install it if it is missing.
pub fn python() -> Option<PathBuf> {
    let python = std::env::var_os("PEERS").map(PathBuf::from).filter(|path| path.exists());
    if python.is_none() {
        eprintln!("left out: the peers, as PEERS names no Python (make bench-kernel and bench-mesh install one)");
    }
    python
}

/// The lines that a peer's script prints as JSON; empty if it does not run.
pub fn lines<A: AsRef<OsStr>>(python: &Path, script: &str, arguments: &[A]) -> Vec<Value> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/peers").join(script);
    // Some write a log where they run.
    let folder = tempfile::tempdir().unwrap();
    let mut command = Command::new(std::path::absolute(python).unwrap());
    command.current_dir(folder.path()).arg(&script).args(arguments);
    command.env("OMP_NUM_THREADS", "1").env("NUMBA_NUM_THREADS", "1").env("PYTHONDONTWRITEBYTECODE", "1");
    let output = match command.output() {
        Ok(output) if output.status.success() => output.stdout,
        Ok(output) => {
            let error = String::from_utf8_lossy(&output.stderr);
            eprintln!("left out: {}: {}", script.display(), error.lines().last().unwrap_or(""));
            return Vec::new();
        }
        Err(error) => {
            eprintln!("left out: {}: {error}", python.display());
            return Vec::new();
        }
    };
    String::from_utf8_lossy(&output).lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
}
