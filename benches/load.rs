//! How many sessions does a core bear, each with a haptic client at 1 kHz or none, what does each cost beside the
//! kernel alone? The server is kept to one core, the generator (`palpate-client load`) to the others. Writes
//! docs/benchmarks/load.{md,svg}. `-- --quick` tries few numbers for a short time; `-- profile` prints that part
//! alone. `-- attacks` shows what one honest client notices of clients that attack, and writes
//! docs/benchmarks/attacks.{md,svg}; `-- attacks NAME` prints one attack's row alone. Linux only: times are read from
//! /proc.

#![allow(clippy::unwrap_used, clippy::panic, clippy::disallowed_methods, clippy::cast_precision_loss, missing_docs)]

mod attack;
#[path = "../tests/common/caller.rs"]
mod caller;
#[path = "../tests/common/cores.rs"]
mod cores;
#[path = "../tests/common/honest.rs"]
mod honest;
mod profile;
#[path = "../tests/common/proxy.rs"]
mod proxy;
mod report;
mod rows;
#[path = "../tests/common/server.rs"]
mod server;

use std::f64::consts::TAU;
use std::io::{BufRead, BufReader, Read};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use attack::AttackKind;
use cores::{kept_to, thread_times};
use glam::DVec3;
use palpate_session::Session;
use palpate_session::command::{Command as Order, Due};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::script::Action;
use palpate_tissue::scene::{PAPER, Scene};
use report::chart::{Look, Panel, Series};
use report::{BenchReport, cells, digits, quick};
use rows::AttackRow;
use serde_json::{Value, json};
use server::{TestServer, client_program};

const OBJECTIVE: &str = "p99<2ms,dilation>0.999";

/// One run of the generator.
struct GeneratorRun {
    told: Value,
    /// Cores that the server took: stepping and network, each in user mode and in the system.
    stepping: [f64; 2],
    network: [f64; 2],
    resident_mib: f64,
}

impl GeneratorRun {
    fn number(&self, path: &str) -> f64 {
        self.told.pointer(path).and_then(Value::as_f64).unwrap_or(f64::NAN)
    }

    fn cores(&self) -> f64 {
        self.stepping.iter().chain(&self.network).sum()
    }
}

fn load(server: &TestServer, seconds: f64, arguments: &[&str]) -> GeneratorRun {
    let mut child = kept_to(false, || {
        Command::new(client_program())
            .args(["load", "--server", &server.url, "--seconds", &seconds.to_string(), "--json"])
            .args(arguments)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap()
    });
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    // The first word comes a second after all clients are there.
    let first = lines.next();
    let (begun, before) = (Instant::now(), thread_times(server.child.id()));
    std::thread::sleep(Duration::from_secs_f64((seconds - 1.5).max(0.1)));
    let (elapsed_s, after) = (begun.elapsed().as_secs_f64(), thread_times(server.child.id()));
    let resident_mib = resident_mib(server);
    let rest: Vec<String> = lines.map_while(Result::ok).collect();
    let mut text = String::new();
    child.stdout.take().unwrap().read_to_string(&mut text).unwrap();
    child.wait().unwrap();
    let told = serde_json::from_str(&text).unwrap_or_else(|_| panic!("{first:?} {rest:?} {text}"));
    let of = |times: &[(String, [f64; 2])], name: &str| {
        times.iter().find(|thread| thread.0 == name).map_or([0.0; 2], |thread| thread.1)
    };
    let cores = |name: &str| {
        let (before, after) = (of(&before, name), of(&after, name));
        [0, 1].map(|mode| (after[mode] - before[mode]) / elapsed_s)
    };
    GeneratorRun { told, stepping: cores("step"), network: cores("network"), resident_mib }
}

fn resident_mib(server: &TestServer) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{}/status", server.child.id())).unwrap();
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<f64>().unwrap() / 1024.0
}

/// What a step of one of `count` sheets takes that are stepped in turn, each under a stroke of its own, s.
fn kernel_alone_s(count: usize, rounds: u64) -> f64 {
    let limits = Limits::default();
    let scene = Scene::parse("paper", PAPER, &[], &limits).unwrap();
    let model = Model::compile(&scene, &limits).unwrap();
    let mut sessions: Vec<Session> = (0..count).map(|_| Session::new(&model)).collect();
    let mut due = Vec::new();
    let mut round = |step: u64| {
        for (number, session) in sessions.iter_mut().enumerate() {
            let turn = TAU * (0.0005 * step as f64 + 0.618 * number as f64);
            let action = Action::Push(Poke {
                point: None,
                centre_m: scene.shape().extent().middle_m() + 0.25 * DVec3::new(turn.cos(), turn.sin(), 0.0),
                force_n: DVec3::new(0.0, 0.0, -0.05),
                falloff_per_m: 4.0 / scene.sheet().unwrap().spacing_m,
                falloff_offset: 0.0,
            });
            let command = Order {
                tool: 0,
                sequence: Some(step),
                client_time_ns: 0,
                by_datagram: false,
                at_step: None,
                time_to_live_s: None,
                action,
                arrival_ns: 1,
            };
            due.push(Due { command, late: false, late_commands: 0, ends_lease: false });
            session.advance(&mut due, |_| {});
        }
    };
    (1..200).for_each(&mut round);
    let begun = Instant::now();
    (200..200 + rounds).for_each(&mut round);
    begun.elapsed().as_secs_f64() / (rounds as f64 * count as f64)
}

fn start(arguments: &[&str]) -> Arc<TestServer> {
    let common = ["--threads", "1", "--log", "error"];
    kept_to(true, || Arc::new(TestServer::start(&[&common[..], arguments].concat())))
}

/// Number of sessions that fill a core, from the time of one among many (µs a step of 1 ms): the more there
/// are, the less of their states the caches hold.
fn most_by(line: &[(f64, f64)]) -> f64 {
    let load = |(count, us): (f64, f64)| count * us;
    let over = line.windows(2).find(|pair| load(pair[1]) > 1e3);
    match (over, line.last()) {
        // Between the two the load is nearly straight.
        (Some(pair), _) => {
            let part = (1e3 - load(pair[0])) / (load(pair[1]) - load(pair[0]));
            pair[0].0 + part * (pair[1].0 - pair[0].0)
        }
        (None, Some(last)) => 1e3 / last.1,
        (None, None) => f64::NAN,
    }
}

/// Measures the largest numbers of sessions with and without clients, and the cost of each.
fn crowds(report: &mut BenchReport, figures: &mut Vec<Value>, seconds: f64) -> Vec<Series> {
    let counts: &[usize] = if quick() { &[1, 25, 100] } else { &[1, 10, 25, 50, 75, 100, 150, 200, 300] };
    // Also sessions that a server would not admit.
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("palpate.toml");
    std::fs::write(&config, "[limits]\nthread_share = 1000.0\n").unwrap();
    let all_let_in = ["--config", config.to_str().unwrap()];
    let mut series = Vec::new();
    let mut kernel_line = Vec::new();
    for (hue, (clients, name, heading)) in [
        ("1", "with clients", "With one haptic client each, a command and a sample a step"),
        ("0", "without clients", "Without clients"),
    ]
    .into_iter()
    .enumerate()
    {
        report.heading(heading);
        let header = cells([
            "sessions",
            "dilation",
            "round trip p50 / p99 / p99.9 / max, ms",
            "lost",
            "of the core",
            "a session and step, µs",
            "kernel alone, µs",
            "stepping: program, system, µs",
            "network: program, system, µs",
            "memory, MiB",
            "generator, cores",
        ]);
        let (mut rows, mut line, mut alone_line) = (Vec::new(), Vec::new(), Vec::new());
        // Far beyond what a core bears, a client each would only show the generator's limits.
        for count in counts.iter().filter(|count| clients == "0" || **count <= 100) {
            eprintln!("{count} sessions {name}");
            let server = start(&all_let_in);
            let sessions = count.to_string();
            let found = load(&server, seconds, &["--sessions", &sessions, "--clients-per-session", clients]);
            drop(server);
            let alone_us = 1e6 * kept_to(true, || kernel_alone_s(*count, (20_000 / *count as u64).max(50)));
            let dilation = found.number("/dilation_min");
            // Of the steps that were done.
            let each_us = |cores: f64| cores * 1e3 / (*count as f64 * dilation);
            let ms = |quantile: &str| digits(found.number(&format!("/round_trip_us/{quantile}")) / 1e3);
            let two = |parts: [f64; 2]| parts.map(|cores| digits(each_us(cores))).join(", ");
            rows.push(cells([
                sessions,
                format!("{dilation:.4}"),
                ["p50", "p99", "p999", "max"].map(ms).join(" / "),
                found.number("/lost").to_string(),
                digits(found.cores()),
                digits(each_us(found.cores())),
                digits(alone_us),
                two(found.stepping),
                two(found.network),
                digits(found.resident_mib),
                digits(found.number("/generator_cores")),
            ]));
            line.push((*count as f64, each_us(found.cores())));
            alone_line.push((*count as f64, alone_us));
            figures.push(json!({
                "sessions": count, "clients_per_session": clients, "told": found.told, "stepping_cores": found.stepping,
                "network_cores": found.network, "kernel_alone_s": alone_us * 1e-6, "resident_mib": found.resident_mib,
            }));
        }
        report.table(&header, &rows);
        series.push(Series { name: name.to_owned(), hue, look: Look::Full, points: line });
        eprintln!("the limit {name}");
        let server = start(&[]);
        let trial = if quick() { 2.0 } else { 6.0 };
        let first = if clients == "1" { "40" } else { "100" };
        let objective = if clients == "1" { OBJECTIVE } else { "dilation>0.999" };
        let wanted = ["--sessions", first, "--clients-per-session", clients, "--find-limit", objective];
        let found = load(&server, trial, &wanted);
        let limit = found.number("/limit_sessions");
        report.say(&format!(
            "The largest number of sessions that meets `{objective}` in two of three trials of {trial} s: **{limit}** (the \
             server refused more, or bisection found the limit). The kernel alone would allow {:.0}.",
            most_by(&alone_line)
        ));
        kernel_line = alone_line;
        report.figure(if clients == "1" { "limit_with_clients" } else { "limit_without_clients" }, json!(limit));
    }
    series.push(Series { name: "kernel alone".to_owned(), hue: 2, look: Look::Broad, points: kernel_line });
    series
}

/// Sessions, each with a client, that a profile is made of: as many as a core bears with ease.
const PROFILED: usize = 50;

/// Measures the time spent outside of the kernel of the simulation.
fn profile(report: &mut BenchReport) {
    report.heading("Distribution of the time");
    eprintln!("a profile of {PROFILED} sessions");
    let server = start(&[]);
    let id = server.child.id();
    let sampling = std::thread::spawn(move || {
        // When all clients are there.
        std::thread::sleep(Duration::from_secs(4));
        profile::parts(id, 6)
    });
    let found = load(&server, 12.0, &["--sessions", &PROFILED.to_string()]);
    let Some(parts) = sampling.join().unwrap() else {
        return report.say("Not measured: `perf` is missing, or lacks permission.");
    };
    let each_us = found.cores() * 1e3 / (PROFILED as f64 * found.number("/dilation_min"));
    report.say(&format!(
        "With {PROFILED} sessions and one client each: {} µs per session and step, divided by the samples of `perf` (which \
         slows the threads a little). Of the system's work, receiving belongs to the clients: on other machines their cores \
         do it.",
        digits(each_us)
    ));
    let row = |((thread, doing), part): &(profile::Activity, f64)| {
        cells([(*thread).to_owned(), (*doing).to_owned(), digits(part * each_us), format!("{:.1}", 100.0 * part)])
    };
    let shown: Vec<_> = parts.iter().filter(|entry| entry.1 >= 0.002).map(row).collect();
    report.table(&cells(["thread", "doing what", "µs", "%"]), &shown);
    let of = |is: fn(&str) -> bool| {
        let parts = parts.iter().filter(|((_, doing), _)| is(doing)).map(|(_, part)| part * each_us);
        parts.sum::<f64>()
    };
    let (system_us, sweep_us) = (of(|doing| doing.starts_with("system")), of(|doing| doing.starts_with("the sweep")));
    report.say(&format!(
        "So with the sweep ({} µs) and the system's work for one connection per client ({} µs), a core has room for at most \
         {:.0} sessions, even if the rest of the server took no time.",
        digits(sweep_us),
        digits(system_us),
        1e3 / (sweep_us + system_us)
    ));
    report.figure(
        "profile",
        parts.iter().map(|((thread, doing), part)| json!([thread, doing, part * each_us])).collect(),
    );
}

/// Runs of each attack: `-- attacks --runs 1`.
fn runs() -> usize {
    let mut arguments = std::env::args().skip_while(|argument| argument != "--runs").skip(1);
    arguments.next().map_or(3, |count| count.parse().unwrap_or_else(|_| panic!("--runs {count}: not a number")))
}

/// Measures the effects of attackers on an honest client: of the attack of that name, or of all attacks.
fn attacks(report: &mut BenchReport, name: Option<&str>) -> Panel {
    let runs = runs().max(1);
    report.say(&format!(
        "One client runs at 1 kHz in its own session, on a server that is limited to one core (one stepping thread, one \
         network thread). An attacker, with its own token unless the row says otherwise, attacks for 7 s from the other \
         cores. *Quiet* is the 2 s before the attack, and 2 s that end 8 s after it; \"p99 × quiet\" is relative to the mean \
         of both. Meanwhile newcomers, one after the other, make a session, wait for the effect of a command in it and of one \
         in the client's session, and leave; a newcomer gives up after 5 s. Lost commands are those without an answer. Memory \
         is the resident memory: before, maximum, and 10 s after, when all have left. Each attack runs {runs} times; the row \
         is the run with the median p99."
    ));
    let kinds: Vec<Option<&'static AttackKind>> = match name {
        Some(name) => vec![Some(attack::named(name).unwrap_or_else(|| unknown_attack(name)))],
        // Quiet before and after: the two show how far one row can be trusted.
        None => std::iter::once(None).chain(attack::KINDS.iter().map(Some)).chain([None]).collect(),
    };
    let (mut table, mut figures, mut pictured) = (Vec::new(), Vec::new(), Vec::new());
    for kind in kinds {
        let mut rows: Vec<AttackRow> = (0..runs)
            .map(|_| {
                let row = rows::run(kind);
                eprintln!("| {} |", row.cells().join(" | "));
                row
            })
            .collect();
        figures.extend(rows.iter().map(AttackRow::figures));
        let each: Vec<_> = rows.iter().map(|row| digits(row.times_quiet())).collect();
        rows.sort_by(|a, b| a.times_quiet().total_cmp(&b.times_quiet()));
        let row = rows.swap_remove(runs / 2);
        table.push([row.cells(), vec![each.join(", ")]].concat());
        pictured.push(row);
    }
    report.table(&[AttackRow::header(), cells(["p99 × quiet, each run"])].concat(), &table);
    report.figure("runs", figures.into());
    // From the bottom up.
    pictured.reverse();
    Panel::Cells {
        title: "What one honest client notices".to_owned(),
        x: ("", cells(["p99 × quiet", "commands lost", "most memory, MiB"])),
        y: ("", pictured.iter().map(|row| row.name().to_owned()).collect()),
        rows: pictured.iter().map(AttackRow::pictured).collect(),
    }
}

fn unknown_attack(name: &str) -> ! {
    let names: Vec<_> = attack::KINDS.iter().map(|kind| kind.name).collect();
    eprintln!("there is no attack `{name}`: all, {}", names.join(", "));
    std::process::exit(2)
}

fn main() {
    if !std::path::Path::new("/proc/self/stat").exists() {
        return println!("left out: there is no /proc on this system");
    }
    // Built before anything is measured.
    client_program();
    let mut arguments = std::env::args().skip_while(|argument| !["attacks", "profile"].contains(&argument.as_str()));
    match arguments.next().as_deref() {
        Some("attacks") => {
            let name = arguments.next().filter(|name| name != "all" && !name.starts_with('-'));
            let mut report = BenchReport::new("attacks", "Under attack", "make bench-load ATTACK=all");
            let panel = attacks(&mut report, name.as_deref());
            if name.is_none() {
                return report.write(1, &[panel]);
            }
            report.print();
        }
        Some(_) => {
            let mut report = BenchReport::new("load", "Many sessions on one core", "make bench-load");
            profile(&mut report);
            report.print();
        }
        None => {
            let mut report = BenchReport::new("load", "Many sessions on one core", "make bench-load");
            report.say(
                "Sessions of the paper's 31 × 31 points at 1 kHz, all of them awake: a tool strokes each without a pause. \
                 The server (one stepping thread, one network thread) is limited to one core; `palpate-client load` uses the \
                 other cores, and sends each client's commands at 1 kHz by its own clock, over a separate connection. The \
                 effect of attacks on a client is on [another page](attacks.md).",
            );
            let mut figures = Vec::new();
            let series = crowds(&mut report, &mut figures, if quick() { 3.0 } else { 10.0 });
            profile(&mut report);
            report.figure("runs", figures.into());
            let panel = Panel::Lines {
                title: "Cost of a session".to_owned(),
                x: "sessions",
                y: "µs of the core, a session and step",
                series,
            };
            report.write(1, &[panel]);
        }
    }
}
