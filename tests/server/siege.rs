//! Eight callers who do all that is known to hurt a server, and what is merely legal, at random by seed, against four
//! honest clients at 1 kHz. No honest command is lost, memory stays within its budget, and all is given back. Here
//! for 30 s of a fixed seed; `make siege SECONDS=1800 SEED=7` runs for as long as you like, and prints the honest
//! clients' times.
#![cfg(target_os = "linux")]
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::disallowed_methods,
    clippy::cast_precision_loss
)]

#[path = "../../benches/attack/mod.rs"]
mod attack;
#[path = "../common/caller.rs"]
mod caller;
#[path = "../common/cores.rs"]
mod cores;
#[path = "../common/honest.rs"]
mod honest;
#[path = "../common/metrics.rs"]
mod metrics;
#[path = "../common/server.rs"]
mod server;

use std::sync::Arc;
use std::time::{Duration, Instant};

use attack::{Attack, AttackKind, Ground, Toll};
use caller::{TestCaller, TokenFile};
use cores::{descriptors, kept_to, peak, resident, threads};
use fastrand::Rng;
use honest::{ClientLedger, Honest, Newcomers};
use palpate::server::identity::Role;
use server::{TEST_TIMEOUT, TestServer};

const ATTACKERS: u64 = 8;
const HONEST: u64 = 4;

/// What the server may take for all callers together, and what it may need beside: code, threads, and what an
/// allocator keeps.
const BUDGET: u64 = 256 << 20;
const BESIDE: u64 = 64 << 20;

/// The siege has failed, and the machine is to survive it.
const FAR_TOO_MUCH: u64 = 3 << 30;

/// Attacks on the honest clients' own ways to the server, one at a time.
const WEATHER: [&str; 1] = ["stall-server-16"];

fn environment(name: &str) -> Option<u64> {
    std::env::var(name).ok().and_then(|text| text.parse().ok())
}

/// The attacks that eight may do at once, at random, again and again.
fn mixable() -> Vec<&'static AttackKind> {
    attack::KINDS.iter().filter(|kind| !kind.name.starts_with("stall-")).collect()
}

struct Besieged {
    server: TestServer,
    keys: Arc<TokenFile>,
    /// Address of the metrics.
    metrics: String,
    /// Descriptors and threads of a server that has nothing to do.
    before: [u64; 2],
}

impl Besieged {
    fn start(keys: TokenFile) -> Self {
        // Unused sessions are removed soon.
        let config = keys.beside("palpate.toml", "idle_session_s = 2.0\n");
        let mut arguments = vec!["--tokens", keys.file(), "--metrics", "127.0.0.1:0", "--threads", "1"];
        arguments.extend(["--log", "error", "--config", &config]);
        let budget = BUDGET.to_string();
        arguments.extend(["--memory", &budget]);
        // Attackers do not take the server's core from it, but only its time.
        let mut server = kept_to(true, || TestServer::start(&arguments));
        // A log that is not read would block the server.
        let mut log = server.child.stderr.take().unwrap();
        std::thread::spawn(move || std::io::copy(&mut log, &mut std::io::stderr()));
        let metrics = metrics::url(&mut server.out);
        let mut besieged = Besieged { server, keys: Arc::new(keys), metrics, before: [0; 2] };
        // What the first look at it brings with it is the server's own.
        besieged.gauge("palpate_streams");
        besieged.before = besieged.weight();
        besieged
    }

    fn process(&self) -> u32 {
        self.server.child.id()
    }

    fn weight(&self) -> [u64; 2] {
        [descriptors(self.process()), threads(self.process())]
    }

    /// Sum of a metric over its labels; nothing if the server does not answer.
    fn gauge(&self, name: &str) -> Option<f64> {
        metrics::try_scrape(&self.metrics).map(|told| metrics::sum(&told, name))
    }

    /// Waits until `is`, for as long as any machine may need.
    fn until(&self, is: impl Fn(&Self) -> bool) -> bool {
        let begun = Instant::now();
        while begun.elapsed() < TEST_TIMEOUT {
            if is(self) {
                return true;
            }
            std::thread::sleep(Duration::from_millis(100));
        }
        false
    }
}

/// Ends a process, at once.
fn kill(process: u32) {
    let process = rustix::process::Pid::from_raw(i32::try_from(process).unwrap()).unwrap();
    rustix::process::kill_process(process, rustix::process::Signal::KILL).unwrap();
}

/// One attacker: for a while this, for a while that.
fn attacker(besieged: &Besieged, number: u64, seed: u64, token: &str, shared: &str, until: Instant) -> Toll {
    let mut random = Rng::with_seed(seed * 1000 + number);
    let kinds = mixable();
    let mut whole = Toll::default();
    while Instant::now() < until {
        // Half of the time what is merely legal.
        let kind =
            if random.bool() { attack::named("legal-calls").unwrap() } else { kinds[random.usize(..kinds.len())] };
        let caller = TestCaller::new(&besieged.server.url, token);
        let mut ground = Ground::new(caller, shared, besieged.process(), &besieged.keys);
        // A machine without optimization does a twentieth of the work in the same time.
        ground.scale = if cfg!(debug_assertions) { 0.01 } else { 0.25 };
        ground.seed = random.u64(..);
        let length = Duration::from_millis(random.u64(300..3000));
        let attack = kept_to(false, || Attack::start(kind.run, ground));
        std::thread::sleep(length.min(until.saturating_duration_since(Instant::now())));
        let toll = attack.end();
        whole.strikes += toll.strikes;
        whole.processor_s += toll.processor_s;
        for (reason, count) in toll.refusals {
            *whole.refusals.entry(format!("{} {reason}", kind.name)).or_default() += count;
        }
    }
    whole
}

/// Now and then the machine itself stands still.
fn weather(besieged: &Besieged, seed: u64, shared: &str, until: Instant) -> u64 {
    let mut random = Rng::with_seed(seed ^ 0x7765_6174);
    let mut stalls = 0;
    while Instant::now() < until {
        std::thread::sleep(Duration::from_millis(random.u64(4000..9000)));
        let kind = attack::named(WEATHER[random.usize(..WEATHER.len())]).unwrap();
        let caller = TestCaller::new(&besieged.server.url, "nobody");
        let attack = Attack::start(kind.run, Ground::new(caller, shared, besieged.process(), &besieged.keys));
        std::thread::sleep(Duration::from_millis(1200));
        stalls += attack.end().strikes;
    }
    stalls
}

#[test]
fn honest_clients_outlive_a_siege_and_all_is_given_back() {
    let (seconds, seed) =
        (environment("PALPATE_SIEGE_S").unwrap_or(30), environment("PALPATE_SIEGE_SEED").unwrap_or(16));
    let keys = TokenFile::new();
    let admit = |name: &str, number: u64| keys.admit(&format!("{name}-{number}"), &[Role::Create, Role::Touch]);
    let honest: Vec<String> = (0..HONEST).map(|number| admit("honest", number)).collect();
    let attackers: Vec<String> = (0..ATTACKERS).map(|number| admit("attacker", number)).collect();
    let newcomer = admit("newcomer", 0);
    let mut besieged = Besieged::start(keys);
    let url = besieged.server.url.clone();
    let (clients, newcomers) = kept_to(false, || {
        let clients: Vec<Honest> = honest.iter().map(|token| Honest::start(TestCaller::new(&url, token), 1)).collect();
        let shared = clients[0].session_id.clone();
        let newcomers = Newcomers::start(TestCaller::new(&url, &newcomer), shared, TEST_TIMEOUT);
        (clients, newcomers)
    });
    let shared = clients[0].session_id.clone();
    let begun = Instant::now();
    let until = begun + Duration::from_secs(seconds);
    let mut accounts: Vec<ClientLedger> = clients.iter().map(|_| ClientLedger::default()).collect();
    let (tolls, stalls) = std::thread::scope(|scope| {
        let attackers: Vec<_> = (0..)
            .zip(&attackers)
            .map(|(number, token)| {
                let (besieged, shared) = (&besieged, &shared);
                scope.spawn(move || attacker(besieged, number, seed, token, shared, until))
            })
            .collect();
        let weather = scope.spawn(|| weather(&besieged, seed, &shared, until));
        let mut last = begun;
        while Instant::now() < until {
            std::thread::sleep(Duration::from_millis(100));
            if resident(besieged.process()) > FAR_TOO_MUCH {
                println!("the server takes more than {} MiB: it is ended", FAR_TOO_MUCH >> 20);
                kill(besieged.process());
                break;
            }
            if last.elapsed() < Duration::from_secs(10) && Instant::now() < until {
                continue;
            }
            last = Instant::now();
            let mut all = ClientLedger::default();
            for (client, account) in clients.iter().zip(&mut accounts) {
                let part = client.take();
                account.add(&part);
                all.add(&part);
            }
            println!(
                "{:5.0} s: honest p50 {:.2}, p99 {:.2}, gap {:.0} ms; sent {}, lost {}, refused {}; {} MiB resident, {} at \
                 most",
                begun.elapsed().as_secs_f64(),
                all.quantile_ms(0.5),
                all.quantile_ms(0.99),
                1e3 * all.longest_gap.as_secs_f64(),
                all.sent,
                all.lost,
                all.refused,
                resident(besieged.process()) >> 20,
                peak(besieged.process()) >> 20,
            );
        }
        let tolls: Vec<Toll> = attackers.into_iter().map(|attacker| attacker.join().unwrap()).collect();
        (tolls, weather.join().unwrap())
    });
    let mut failures = Vec::new();
    let mut must = |holds: bool, what: String| {
        if !holds {
            println!("FAILED: {what}");
            failures.push(what);
        }
    };
    // The attacks took place.
    let strikes: u64 = tolls.iter().map(|toll| toll.strikes).sum();
    let mut refusals = std::collections::BTreeMap::<String, u64>::new();
    for (reason, count) in tolls.iter().flat_map(|toll| &toll.refusals) {
        *refusals.entry(reason.clone()).or_default() += count;
    }
    println!("{strikes} strikes, the server stood still {stalls} times; refused:");
    refusals.iter().for_each(|(reason, count)| println!("    {count} × {reason}"));
    must(strikes > 0 && stalls > 0, "there was no siege".into());
    // Honest clients.
    let welcome = newcomers.end();
    println!(
        "newcomers: {} of {} served, the slowest took {:.2} s; {:?}",
        welcome.served,
        welcome.rounds,
        welcome.slowest.as_secs_f64(),
        welcome.reasons
    );
    let silent = welcome.reasons.get("DeadlineExceeded: no answer").copied().unwrap_or(0);
    must(silent == 0, format!("{silent} newcomers had no answer in {TEST_TIMEOUT:?}"));
    // The attackers' remains are removed; then there is room.
    let given_back = besieged.until(|besieged| besieged.gauge("palpate_sessions") == Some(HONEST as f64));
    must(given_back, format!("{:?} sessions stay, of {HONEST} that are in use", besieged.gauge("palpate_sessions")));
    let late = Newcomers::start(TestCaller::new(&url, &newcomer), clients[1].session_id.clone(), TEST_TIMEOUT).end();
    must(late.served == 1, format!("when it is over, a newcomer is not served: {:?}", late.reasons));
    for (number, (client, account)) in clients.into_iter().zip(&mut accounts).enumerate() {
        let verdict = client.end();
        account.add(&verdict.account);
        println!(
            "honest {number}: {} sent, {} answered, {} refused, {} lost, broken {:?}",
            account.sent, account.answered, account.refused, account.lost, account.broken
        );
        let counts = verdict.counts.unwrap_or_default();
        let kept = account.broken.is_empty() && account.lost == 0 && account.refused == 0;
        must(kept, format!("honest {number} was cut, lost commands, or had some refused"));
        // Data of streams that were cut is not counted by any stream.
        // Newcomers' commands count in the first two sessions, which they visit.
        let told = |count: u64| count == account.sent || count > account.sent && number < 2;
        let all = account.answered == account.sent && told(counts.accepted) && told(counts.applied);
        must(
            !kept || all && account.sent > 0,
            format!("honest {number}: of {} the server says {counts:?}", account.sent),
        );
    }
    // The server.
    must(besieged.server.child.try_wait().unwrap().is_none(), "the server has ended".into());
    let most = peak(besieged.process());
    must(most <= BUDGET + BESIDE, format!("{} MiB were resident, of a budget of {} MiB", most >> 20, BUDGET >> 20));
    for gauge in ["palpate_sessions", "palpate_streams", "palpate_viewers", "palpate_points"] {
        let given_back = besieged.until(|besieged| besieged.gauge(gauge) == Some(0.0));
        must(given_back, format!("{gauge} stays at {:?}", besieged.gauge(gauge)));
    }
    let before = besieged.before;
    // A few threads of a pool come and go.
    let given_back = besieged.until(|besieged| {
        let now = besieged.weight();
        now[0] <= before[0] && now[1] <= before[1] + 2
    });
    must(given_back, format!("descriptors and threads: {before:?} at first, now {:?}", besieged.weight()));
    must(
        besieged.until(|besieged| resident(besieged.process()) <= BESIDE),
        format!("{} MiB stay resident", resident(besieged.process()) >> 20),
    );
    println!("{} MiB resident at the end, {} at most", resident(besieged.process()) >> 20, most >> 20);
    assert!(failures.is_empty(), "seed {seed}, {seconds} s: {failures:#?}");
}
