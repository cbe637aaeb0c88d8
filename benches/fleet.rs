//! The cost of a fleet compared with one server, its placement of sessions, and the capacity of etcd. Writes
//! docs/benchmarks/fleet.{md,svg}; `-- calls`, `-- spread`, `-- steps` and `-- etcd` print one part alone, `-- --quick` does all
//! with small numbers. Linux only: times are read from /proc. Needs etcd.

#![allow(clippy::unwrap_used, clippy::panic, clippy::disallowed_methods, clippy::cast_precision_loss, missing_docs)]
#![allow(unreachable_pub)]

#[path = "fleet/calls.rs"]
mod calls;
#[path = "../tests/common/cores.rs"]
mod cores;
#[path = "../tests/common/etcd.rs"]
mod etcd;
#[path = "fleet/etcd_capacity.rs"]
mod etcd_capacity;
#[path = "../tests/common/fleet.rs"]
mod fleet;
mod report;
#[path = "../tests/common/server.rs"]
mod server;
#[path = "fleet/spread.rs"]
mod spread;
#[path = "fleet/steps.rs"]
mod steps;

use std::path::{Path, PathBuf};

use etcd::EtcdMembers;
use report::BenchReport;
use report::chart::Panel;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// A configuration that refuses nothing because there is much of it.
fn generous(folder: &Path) -> PathBuf {
    let path = folder.join("palpate.toml");
    let text = "idle_session_s = 86400.0\n[limits]\nthread_share = 1000.0\nsessions = 100000\nsessions_per_minute = 1e9\n\
                calls_per_s = 1e9\npoints_in_all = 1000000000\n";
    std::fs::write(&path, text).unwrap();
    path
}

/// Times of one kind.
#[derive(Default)]
struct FleetTimes(Vec<f64>);

impl FleetTimes {
    /// Not a number if there are none.
    fn quantile(&self, quantile: f64) -> f64 {
        let mut sorted = self.0.clone();
        sorted.sort_by(f64::total_cmp);
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let index = (quantile * sorted.len().saturating_sub(1) as f64).round() as usize;
        sorted.get(index).copied().unwrap_or(f64::NAN)
    }

    fn median(&self) -> f64 {
        self.quantile(0.5)
    }
}

/// One part of the page.
type PageSection = (&'static str, fn(&mut BenchReport) -> Option<Panel>);

const PARTS: [PageSection; 4] = [
    ("calls", calls::measure),
    ("spread", spread::measure),
    ("steps", steps::measure),
    ("etcd", etcd_capacity::measure),
];

fn main() {
    if !Path::new("/proc/self/stat").exists() {
        return println!("left out: there is no /proc on this system");
    }
    if !EtcdMembers::is_there() {
        return;
    }
    // A thousand nodes have a connection each.
    let most = getrlimit(Resource::Nofile).maximum;
    let _ = setrlimit(Resource::Nofile, Rlimit { current: most, maximum: most });
    let mut report = BenchReport::new("fleet", "A fleet on etcd", "make bench-fleet");
    let wanted = |part: &&PageSection| std::env::args().skip(1).any(|argument| argument == part.0);
    if let Some(part) = PARTS.iter().find(wanted) {
        part.1(&mut report);
        return report.print();
    }
    report.say(
        "Three servers of a fleet, one server without a fleet, etcd and their clients are on the same machine: etcd's \
         answers come over the loopback interface, after a write to its disk. Sessions have the paper's 31 × 31 points.",
    );
    let panels: Vec<Panel> = PARTS.iter().filter_map(|part| part.1(&mut report)).collect();
    report.write(2, &panels);
}
