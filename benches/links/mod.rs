//! Runs of `palpate-client link`, as a user has them.

use std::path::PathBuf;
use std::process::Command;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use serde_json::Value;

/// The figures of a run with these arguments.
pub(crate) fn link(arguments: &str) -> Value {
    // `make` has built it beside the server.
    let program = PathBuf::from(env!("CARGO_BIN_EXE_palpate")).with_file_name("palpate-client");
    let output = Command::new(program).arg("link").args(arguments.split_whitespace()).arg("--json").output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "link {arguments}: {told}");
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Performs all runs on all processors; results are in order.
pub(crate) fn links(runs: &[String]) -> Vec<Value> {
    let next = AtomicUsize::new(0);
    let results = Mutex::new(vec![Value::Null; runs.len()]);
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(1, usize::from) {
            scope.spawn(|| {
                while let Some((at, run)) = {
                    let at = next.fetch_add(1, Ordering::Relaxed);
                    runs.get(at).map(|run| (at, run))
                } {
                    let found = link(run);
                    results.lock().unwrap()[at] = found;
                }
            });
        }
    });
    results.into_inner().unwrap()
}

/// Performs one run with each of several seeds.
pub(crate) fn by_seed(run: &str, seeds: u64) -> Vec<String> {
    (1..=seeds).map(|seed| format!("{run} --seed {seed}")).collect()
}

/// A figure of a run; not a number if it has none.
pub(crate) fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or(f64::NAN)
}
