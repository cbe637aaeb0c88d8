//! Profile of a running server: samples of all its threads from `perf`, grouped by activity.
#![allow(unreachable_pub)]

use std::collections::BTreeMap;
use std::process::{Command, Stdio};

/// Samples per second.
const RATE_HZ: u32 = 1999;

/// Thread and activity.
pub type Activity = (&'static str, &'static str);

/// Matched against each frame of the stack, leaf first; the first match counts. System calls come before their causes.
const SYSTEM: [(&str, &str); 8] = [
    ("net_rx_action", "system: receiving what was written, for the client on the same machine"),
    ("tcp_sendmsg", "system: writing"),
    ("writev", "system: writing"),
    ("recvfrom", "system: reading"),
    ("epoll_wait", "system: waiting for events"),
    ("futex", "system: waking and sleeping"),
    ("nanosleep", "system: waking and sleeping"),
    ("__schedule", "system: waking and sleeping"),
];

/// Matched against the leaf, outside the system; the first match counts.
const PROGRAM: [(&str, &str); 17] = [
    ("palpate_tissue::kernel::lanes", "the sweep over the springs"),
    ("palpate::tissue", "the sheet beside the sweep: forces, samples, checks"),
    ("libm", "the sheet beside the sweep: forces, samples, checks"),
    ("fma", "the sheet beside the sweep: forces, samples, checks"),
    ("palpate::session", "session and schedule"),
    ("palpate_realtime", "session and schedule"),
    ("palpate", "wire and services"),
    ("tonic", "gRPC and protobuf"),
    ("prost", "gRPC and protobuf"),
    ("tower", "gRPC and protobuf"),
    ("h2::", "HTTP/2"),
    ("hyper", "HTTP/2"),
    ("http", "HTTP/2"),
    ("bytes::", "HTTP/2"),
    ("tokio", "tasks"),
    ("clock_gettime", "the clock"),
    ("tsc", "the clock"),
];

fn place(thread: &str, stack: &[&str]) -> Activity {
    let thread = ["network", "step"].into_iter().find(|name| thread.starts_with(name)).unwrap_or("other threads");
    let find = |table: &[(&str, &'static str)], frame: &str| {
        table.iter().find(|entry| frame.contains(entry.0)).map(|entry| entry.1)
    };
    let system = SYSTEM.iter().find(|entry| stack.iter().any(|frame| frame.contains(entry.0))).map(|entry| entry.1);
    let leaf = stack.first().copied().unwrap_or_default();
    // Kernel addresses are the highest.
    let is_kernel = leaf.starts_with("ffff");
    let elsewhere = || if is_kernel { "system: the rest" } else { "memory, and what else there is" };
    let doing = system.filter(|_| is_kernel).or_else(|| find(&PROGRAM, leaf).filter(|_| !is_kernel));
    (thread, doing.unwrap_or_else(elsewhere))
}

/// The fraction of time that process `id` spends in each place, over `seconds` from now, largest first. `None` if
/// there is no `perf` with permission to sample.
pub fn parts(id: u32, seconds: u32) -> Option<Vec<(Activity, f64)>> {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("perf.data");
    let mut record = Command::new("perf");
    record.args(["record", "-e", "cpu-clock", "-F", &RATE_HZ.to_string(), "-g", "-p", &id.to_string(), "-o"]);
    record.arg(&data).args(["--", "sleep", &seconds.to_string()]).stdout(Stdio::null()).stderr(Stdio::null());
    if !record.status().ok()?.success() {
        return None;
    }
    let script = Command::new("perf").args(["script", "-F", "comm,ip,sym", "-i"]).arg(&data).output().ok()?;
    let text = String::from_utf8_lossy(&script.stdout).into_owned();
    let mut counts: BTreeMap<Activity, f64> = BTreeMap::new();
    // A sample is a line with the thread's name, a line for each frame, and an empty one.
    for sample in text.split("\n\n") {
        let mut lines = sample.lines().filter(|line| !line.is_empty());
        let Some(thread) = lines.next() else { continue };
        let stack: Vec<&str> = lines.map(str::trim).collect();
        if !stack.is_empty() {
            *counts.entry(place(thread.trim(), &stack)).or_default() += 1.0;
        }
    }
    let all: f64 = counts.values().sum();
    let mut parts: Vec<_> = counts.into_iter().map(|(place, count)| (place, count / all)).collect();
    parts.sort_by(|a, b| b.1.total_cmp(&a.1));
    (all > 0.0).then_some(parts)
}
