//! An attack beside one honest client, as a row of a table: what the client notices before, during and after, what the
//! attacker pays, and what the server keeps.
#![allow(unreachable_pub)]

use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use palpate::server::identity::Role;
use serde_json::{Value, json};
use tokio::runtime::Runtime;

use crate::attack::{Attack, AttackKind, Ground, Toll};
use crate::caller::{TestCaller, TokenFile};
use crate::cores::{kept_to, processor_s, resident};
use crate::honest::{ClientLedger, Honest, Newcomers, Welcome};
use crate::proxy::Proxy;
use crate::report::{cells, digits, quick};
use crate::server::TestServer;

/// Timeout of a newcomer.
const NEWCOMER_TIMEOUT: Duration = Duration::from_secs(5);

/// Configuration of the server: it deletes idle sessions soon.
const CONFIGURATION: &str = "idle_session_s = 4.0\n";

/// Factor of the amounts of all attacks: a server that was not optimized only shows that rows work.
const SCALE: f64 = if cfg!(debug_assertions) { 0.01 } else { 1.0 };

/// Resident memory at which an attack is stopped: a machine that swaps measures nothing.
const MAX_RESIDENT: u64 = 6 << 30;

/// One row.
pub struct AttackRow {
    name: &'static str,
    about: &'static str,
    quiet: ClientLedger,
    besieged: ClientLedger,
    after: ClientLedger,
    /// All of what was lost or broke, to the end.
    whole: ClientLedger,
    welcome: Welcome,
    /// Once the attack was over.
    late: Welcome,
    toll: Toll,
    attacked_s: f64,
    /// Of the server meanwhile, s of a core.
    processor_s: f64,
    /// Before, at most, and 10 s after, bytes.
    resident: [u64; 3],
}

fn server(keys: &TokenFile, kind: Option<&AttackKind>) -> TestServer {
    let limit = kind.and_then(|kind| kind.descriptors).map_or(String::new(), |most| format!("ulimit -n {most}; "));
    let config = keys.beside("palpate.toml", CONFIGURATION);
    let arguments = ["serve", "--listen", "127.0.0.1:0", "--threads", "1", "--log", "error", "--config", &config];
    kept_to(true, || {
        let mut command = Command::new("sh");
        command
            .args(["-c", &format!("{limit}exec \"$0\" \"$@\""), env!("CARGO_BIN_EXE_palpate")])
            .args(arguments)
            .args(["--tokens", keys.file()])
            // A log that is not read would block the server.
            .stderr(Stdio::null());
        TestServer::spawn(&mut command)
    })
}

/// Watches for this time. Returns the largest resident memory.
fn watch(process: u32, time: Duration) -> u64 {
    let (begun, mut most) = (Instant::now(), 0);
    while begun.elapsed() < time && most < MAX_RESIDENT {
        most = most.max(resident(process));
        std::thread::sleep(Duration::from_millis(20));
    }
    most
}

/// Measures what one honest client notices of `kind`, or of no attack.
pub fn run(kind: Option<&'static AttackKind>) -> AttackRow {
    let part = |seconds: f64| Duration::from_secs_f64(if quick() { seconds / 3.0 } else { seconds });
    let keys = Arc::new(TokenFile::new());
    let honest = keys.admit("honest", &[Role::Create, Role::Touch]);
    let attacker = keys.admit("attacker", &[Role::Create, Role::Touch]);
    let server = server(&keys, kind);
    let process = server.child.id();
    let honest = TestCaller::new(&server.url, &honest);
    let attacker = if kind.is_some_and(|kind| kind.same_caller) {
        honest.clone()
    } else {
        TestCaller::new(&server.url, &attacker)
    };
    // The wire has threads of its own: it carries on while the client stands still.
    let wires = Runtime::new().unwrap();
    let (tools, delay) = kind.map_or((1, 0), |kind| (kind.tools, kind.round_trip_ms / 2));
    let proxy = wires.block_on(Proxy::start(honest.address().to_owned(), Duration::from_millis(delay)));
    let way = if delay == 0 { honest.clone() } else { honest.by(&proxy.url()) };
    let (client, newcomers) = kept_to(false, || {
        let client = Honest::start(way, tools);
        let newcomers = Newcomers::start(honest, client.session_id.clone(), NEWCOMER_TIMEOUT);
        (client, newcomers)
    });
    std::thread::sleep(part(1.0));
    let mut whole = client.take();
    let before = watch(process, part(2.0));
    let quiet = client.take();
    newcomers.take();
    let (begun, processor_before) = (Instant::now(), processor_s(process));
    let attack = kind.map(|kind| {
        let mut ground = Ground::new(attacker, &client.session_id, process, &keys);
        ground.scale = SCALE;
        ground.freezer = Some(client.freezer());
        kept_to(false, || Attack::start(kind.run, ground))
    });
    let most = watch(process, part(7.0));
    let (attacked_s, besieged) = (begun.elapsed().as_secs_f64(), client.take());
    let welcome = newcomers.take();
    let toll = attack.map(Attack::end).unwrap_or_default();
    let processor_s = processor_s(process) - processor_before;
    // The attacker's remains are removed; the last part is quiet.
    let most = most.max(watch(process, part(6.0)));
    let settling = client.take();
    std::thread::sleep(part(2.0));
    let after = client.take();
    let late = newcomers.end();
    let verdict = client.end();
    // Sessions are gone; what is left is the server's own.
    std::thread::sleep(part(2.0));
    for account in [&quiet, &besieged, &settling, &after, &verdict.account] {
        whole.add(account);
    }
    AttackRow {
        name: kind.map_or("quiet", |kind| kind.name),
        about: kind.map_or("nobody", |kind| kind.about),
        quiet,
        besieged,
        after,
        whole,
        welcome,
        late,
        toll,
        attacked_s,
        processor_s,
        resident: [before, most, resident(process)],
    }
}

fn mib(bytes: u64) -> String {
    format!("{}", bytes >> 20)
}

/// The most frequent of some reasons, with how often.
fn foremost(reasons: &std::collections::BTreeMap<String, u64>) -> String {
    let most = reasons.iter().max_by_key(|reason| reason.1);
    most.map_or(String::new(), |(reason, count)| format!("{count} × {reason}"))
}

impl AttackRow {
    pub fn header() -> Vec<String> {
        cells([
            "attack",
            "strikes; refused",
            "attacker, server: cores",
            "p50 quiet / during / after, ms",
            "p99 quiet / during / after, ms",
            "p99 × quiet",
            "longest gap quiet / during, ms",
            "sent; lost; refused; streams broken",
            "newcomers served; slowest, s; why not; served after",
            "memory before / most / after, MiB",
        ])
    }

    pub fn name(&self) -> &'static str {
        self.name
    }

    /// Values for the chart, and their severity from 0 to 1.
    #[allow(clippy::cast_precision_loss)]
    pub fn pictured(&self) -> Vec<(String, f64)> {
        let (times, lost, most) = (self.times_quiet(), self.whole.lost, self.resident[1] >> 20);
        vec![
            // 1.2 is what is aimed at.
            (digits(times), ((times - 1.2) / 2.0).clamp(0.0, 1.0)),
            (lost.to_string(), if lost == 0 { 0.0 } else { 1.0 }),
            (most.to_string(), (most as f64 / 4096.0).min(1.0)),
        ]
    }

    pub fn times_quiet(&self) -> f64 {
        // The mean of two quiet windows is a better estimate than either.
        let quiet_ms = 0.5 * (self.quiet.quantile_ms(0.99) + self.after.quantile_ms(0.99));
        self.besieged.quantile_ms(0.99) / quiet_ms
    }

    pub fn cells(&self) -> Vec<String> {
        let phases = |quantile: f64| {
            [&self.quiet, &self.besieged, &self.after].map(|account| digits(account.quantile_ms(quantile))).join(" / ")
        };
        let gap = |account: &ClientLedger| digits(1e3 * account.longest_gap.as_secs_f64());
        let (whole, welcome) = (&self.whole, &self.welcome);
        let broken = whole.broken.first().map_or("0".to_owned(), |why| format!("{} ({why})", whole.broken.len()));
        cells([
            format!("**{}**: {}", self.name, self.about),
            format!("{}; {}", self.toll.strikes, foremost(&self.toll.refusals)),
            [self.toll.processor_s, self.processor_s].map(|time_s| digits(time_s / self.attacked_s)).join(", "),
            phases(0.5),
            phases(0.99),
            digits(self.times_quiet()),
            format!("{} / {}", gap(&self.quiet), gap(&self.besieged)),
            format!("{}; {}; {}; {broken}", whole.sent, whole.lost, whole.refused),
            format!(
                "{} of {}, {}; {}; {} of {}",
                welcome.served,
                welcome.rounds,
                digits(welcome.slowest.as_secs_f64()),
                foremost(&welcome.reasons),
                self.late.served,
                self.late.rounds
            ),
            self.resident.map(mib).join(" / "),
        ])
    }

    pub fn figures(&self) -> Value {
        let account = |account: &ClientLedger| {
            json!({
                "sent": account.sent, "answered": account.answered, "refused": account.refused, "lost": account.lost,
                "broken": account.broken, "p50_ms": account.quantile_ms(0.5), "p99_ms": account.quantile_ms(0.99),
                "longest_gap_ms": 1e3 * account.longest_gap.as_secs_f64(),
            })
        };
        json!({
            "attack": self.name, "about": self.about, "strikes": self.toll.strikes, "refusals": self.toll.refusals,
            "attacker_s": self.toll.processor_s, "server_s": self.processor_s, "attacked_s": self.attacked_s,
            "quiet": account(&self.quiet), "besieged": account(&self.besieged), "after": account(&self.after),
            "whole": account(&self.whole), "p99_times_quiet": self.times_quiet(), "resident_bytes": self.resident,
            "newcomers": {
                "rounds": self.welcome.rounds, "served": self.welcome.served, "reasons": self.welcome.reasons,
                "slowest_s": self.welcome.slowest.as_secs_f64(), "rounds_after": self.late.rounds, "served_after": self.late.served,
            },
        })
    }
}
