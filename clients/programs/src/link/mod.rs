//! `palpate-client link`: simulates hand, device, network and tissue in one loop in virtual time. The seed determines the
//! result. Only this program drives a tissue itself.

mod boundary;
mod live;
mod random;
mod run;
mod tissue;

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use glam::DVec3;
use palpate::force_law::Disc;
use palpate::limits::Limits;
use palpate::memory;
use palpate::scene::check::check_tip;
use palpate::scene::collection::find_scene;
use palpate::sheet::Model;
use palpate_proto::refusal::{Reason, Refusal, number};
use palpate_touch::Tip;
use palpate_touch::carrier::Carried;
use serde_json::{Value, json};

use crate::Failure;
use crate::credentials::CredentialOptions;
use crate::simulated::network::{Conditions, Transport};
use crate::simulated::{device_named, hand_named};
use crate::table;
use run::{Outcome, Rendering, Setup, run};
use tissue::Spot;

/// Arguments of `link`.
#[derive(Args)]
pub(crate) struct Arguments {
    /// A scene file, or the name of a scene in ./scenes or built in (fibrotic, liver, paper, stomach)
    #[arg(long, default_value = "liver")]
    scene: PathBuf,
    /// The hand that holds the device: light, medium or firm; or none: a weak string leads the device
    #[arg(long, default_value = "medium")]
    hand: String,
    /// The device: touch, omni, desktop, falcon, omega3, delta3, sigma7, lambda7 or inverse3; or undeclared
    #[arg(long, default_value = "omega3")]
    device: String,
    /// Round-trip time, ms
    #[arg(long, value_name = "MS", conflicts_with = "profile")]
    rtt_ms: Option<f64>,
    /// Standard deviation of the delay each way, ms; messages of a stream stay in order
    #[arg(long, value_name = "MS", conflicts_with = "profile")]
    jitter_ms: Option<f64>,
    /// Fraction of the packets that are lost. A stream sends them again, which delays all later ones
    #[arg(long, value_name = "FRACTION", conflicts_with = "profile")]
    loss: Option<f64>,
    /// How samples and poses travel
    #[arg(long, default_value = "stream", conflicts_with = "boundary")]
    transport: Transport,
    /// Mean number of packets that are lost in a row; 1: each by itself
    #[arg(long, value_name = "PACKETS", default_value_t = 1.0, conflicts_with = "boundary")]
    loss_burst: f64,
    /// Once a second nothing gets through for this long, ms
    #[arg(long, value_name = "MS", default_value_t = 0.0, conflicts_with = "boundary")]
    outage_ms: f64,
    /// Stall the client once a second, at a random moment, for this long, ms; the device holds its last force
    #[arg(long, value_name = "MS", default_value_t = 0.0, conflicts_with = "random")]
    stall_ms: f64,
    /// A network by name, instead of the three options above
    #[arg(long)]
    profile: Option<Profile>,
    /// How the client renders samples
    #[arg(long, default_value = "model")]
    scheme: Rendering,
    /// Send a sample only when the force that the client renders is off by more than this fraction; 0 sends one per step
    #[arg(long, value_name = "FRACTION", default_value_t = 0.0)]
    deadband: f64,
    /// Send a place of the tool only when the server would be wrong about it by more than this fraction of the force; 0
    /// sends one per tick
    #[arg(long, value_name = "FRACTION", default_value_t = 0.0, conflicts_with = "boundary")]
    up_deadband: f64,
    /// Duration in simulated time, s
    #[arg(long, value_name = "SECONDS", default_value_t = 20.0)]
    seconds: f64,
    /// Seed of the task and the network
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Where the task is done, m: the place of the tissue's rest surface that is nearest to this; of a sheet X,Y. The middle,
    /// if absent
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', allow_negative_numbers = true, conflicts_with_all = ["server", "random", "boundary"])]
    place: Vec<f64>,
    /// Radius of the tool's tip, m
    #[arg(long, value_name = "M", default_value_t = Tip::default().radius_m)]
    radius_m: f64,
    /// Friction coefficient of the tip
    #[arg(long, default_value_t = Tip::default().friction)]
    friction: f64,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
    /// Write time, depth, rendered and true force of each tick to this file (CSV)
    #[arg(long, value_name = "FILE")]
    course: Option<PathBuf>,
    /// Run in real time against this server, which must know the scene by its name, over the real network
    #[arg(long, value_name = "URL", conflicts_with_all = ["rtt_ms", "jitter_ms", "loss", "loss_burst", "outage_ms", "stall_ms", "profile", "random", "boundary"])]
    server: Option<String>,
    #[command(flatten)]
    credentials: CredentialOptions,
    /// Run this many random combinations of scene, hand, device, network and task, with seeds from --seed on; report the
    /// worst value of each figure
    #[arg(long, value_name = "RUNS", conflicts_with_all = ["course", "boundary"])]
    random: Option<u64>,
    /// Find the delay at which hand and spring become unstable, and compare it with theory
    #[arg(long, conflicts_with = "course")]
    boundary: bool,
}

/// Networks by name: round trip, jitter each way, loss.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Profile {
    /// 0.5 ms
    Lan,
    /// 10 ± 2 ms
    Metro,
    /// 50 ± 10 ms, one message in a thousand lost
    Wan,
    /// 120 ± 40 ms, one message in a hundred lost
    BadWan,
}

impl Profile {
    fn conditions(self) -> Conditions {
        let (round_trip_s, jitter_s, loss) = match self {
            Profile::Lan => (0.0005, 0.0, 0.0),
            Profile::Metro => (0.010, 0.002, 0.0),
            Profile::Wan => (0.050, 0.010, 0.001),
            Profile::BadWan => (0.120, 0.040, 0.01),
        };
        Conditions { round_trip_s, jitter_s, loss, ..Conditions::default() }
    }
}

impl Arguments {
    /// A network, with what is asked for beside it.
    fn on(&self, conditions: Conditions) -> Conditions {
        let outage_s = 1e-3 * self.outage_ms;
        Conditions { transport: self.transport, burst: self.loss_burst, outage_s, ..conditions }
    }
}

/// Longest simulated time, s.
const LONGEST_S: f64 = 3600.0;

/// Performs the run or runs and prints the results.
///
/// # Errors
/// Returns an error if an argument is refused, a run fails, or a file can't be written.
pub(crate) async fn link(arguments: &Arguments) -> Result<(), Failure> {
    if arguments.boundary {
        return boundary::print(arguments.json);
    }
    if let Some(runs) = arguments.random {
        return random::print(arguments, runs);
    }
    let setup = memory::attempt("--scene", || setup(arguments))?;
    let outcome = match &arguments.server {
        Some(server) => live::run(&setup, arguments.credentials.server(server)?).await?,
        None => with_tissue(|| run(&setup))?,
    };
    if let Some(path) = &arguments.course {
        let mut text = "time_s,depth_m,rendered_n,true_n\n".to_owned();
        for [time_s, depth_m, rendered_n, true_n] in &outcome.course {
            text += &format!("{time_s:.3},{depth_m:.6},{rendered_n:.6},{true_n:.6}\n");
        }
        std::fs::write(path, text).map_err(|error| Failure::Failed(format!("{}: {error}", path.display())))?;
    }
    if arguments.json {
        crate::tell!("{}", figures(&setup, &outcome));
    } else {
        table::print(&rows(&setup, &outcome, arguments.server.as_deref()));
    }
    Ok(())
}

/// The figures of a run for people; `server` is that of a run in real time.
fn rows(setup: &Setup, outcome: &Outcome, server: Option<&str>) -> Vec<(&'static str, String)> {
    let (scene, hand, device) = (&setup.model.scene.name, setup.hand.name, setup.device.name);
    let scheme = format!("{:?}", setup.scheme).to_lowercase();
    let Conditions { transport, round_trip_s, jitter_s, loss, burst, outage_s } = setup.conditions;
    let network = match server {
        Some(url) => format!("the real one, to {url}"),
        None => {
            let [round_trip, jitter] = [round_trip_s, jitter_s].map(|time_s| table::rounded(1e3 * time_s));
            let mut text = format!(
                "{}, {round_trip} ms round trip, ± {jitter} ms each way, {} lost",
                transport.name(),
                table::percent(loss)
            );
            if burst > 1.0 {
                text += &format!(", {} in a row", table::rounded(burst));
            }
            if outage_s > 0.0 {
                text += &format!(", {} ms once a second nothing", table::rounded(1e3 * outage_s));
            }
            text
        }
    };
    let unstable =
        outcome.unstable_at_s.map_or("no".to_owned(), |at_s| format!("yes, after {} s", table::rounded(at_s)));
    let or_none = |value: Option<f64>, show: &dyn Fn(f64) -> String| value.map_or("none".to_owned(), show);
    let [limited, dropped, released] = outcome.path;
    let mut rows = vec![
        ("scene", format!("{scene}, {hand} hand, device {device}, rendering {scheme}")),
        ("network", network),
        ("duration", format!("{} s, seed {}", table::rounded(setup.duration_s), setup.seed)),
        ("depths of the task", format!("{} of the whole", table::percent(outcome.scale))),
        (
            "force error",
            format!(
                "{} rms, {} in the 99th percentile",
                or_none(outcome.force_error_rms_percent, &|error| format!("{} %", table::rounded(error))),
                table::with_unit(outcome.force_error_p99_n, "N")
            ),
        ),
        (
            "largest force",
            format!(
                "{} rendered, {} true",
                table::with_unit(outcome.force_max_n, "N"),
                table::with_unit(outcome.true_force_max_n, "N")
            ),
        ),
        ("force rendered", format!("{} of the true one", or_none(outcome.rendered_share, &table::percent))),
        ("largest jump", format!("{} in a tick", table::with_unit(outcome.jump_max_n, "N"))),
        (
            "least energy at the port",
            format!("{} (below 0: it gave some)", table::with_unit(outcome.energy_min_j, "J")),
        ),
        ("passivity acted", format!("in {} of the ticks", table::percent(outcome.guard_share))),
        ("unstable", unstable),
        ("pauses, faults", format!("{}, {}", outcome.pauses, outcome.faults)),
        (
            "samples",
            format!(
                "{} a second, {} kbit/s",
                table::rounded(outcome.packets_per_s),
                table::rounded(outcome.kbit_per_s)
            ),
        ),
        ("commands", format!("{} a second", table::rounded(outcome.commands_per_s))),
        (
            "age of the model",
            or_none(outcome.model_age_ms_p99, &|age_ms| {
                format!("{} ms in the 99th percentile", table::rounded(age_ms))
            }),
        ),
        (
            "path of the tool",
            format!("{limited} steps at the speed limit, {dropped} commands dropped, {released} releases"),
        ),
        ("limits that acted", table::acted(outcome.interventions.iter().copied())),
    ];
    if setup.stall_s > 0.0 {
        rows.insert(2, ("stalls of the client", format!("{} ms once a second", table::rounded(1e3 * setup.stall_s))));
    }
    if setup.up_deadband > 0.0 {
        rows.insert(2, ("deadband of poses", table::percent(setup.up_deadband)));
    }
    if setup.deadband > 0.0 {
        rows.insert(2, ("deadband", table::percent(setup.deadband)));
    }
    if let Some(late) = outcome.late_ticks {
        rows.push(("late ticks", late.to_string()));
    }
    if let Some(Carried { sent, came, fell_back }) = outcome.carried {
        rows.push(("datagrams", format!("{sent} up, {came} down; the stream took over {fell_back} times")));
    }
    rows
}

/// Does something with a tissue.
///
/// # Errors
/// Returns an error if the system has no memory for the tissue (exit status 2), or if the guard stops it (1).
fn with_tissue<T>(work: impl FnOnce() -> Result<T, String>) -> Result<T, Failure> {
    memory::attempt("--scene", || Ok(work()))?.map_err(Failure::Failed)
}

fn setup(arguments: &Arguments) -> Result<Setup, Refusal> {
    let limits = Limits::default();
    let hand = hand_named(&arguments.hand)?;
    let device = device_named(&arguments.device)?;
    let conditions = match arguments.profile {
        Some(profile) => profile.conditions(),
        None => {
            let part = |field: &str, value: Option<f64>, range: &str, most: f64| {
                number(field, value.unwrap_or(0.0), range, |v| (0.0..=most).contains(&v))
            };
            Conditions {
                round_trip_s: 1e-3 * part("--rtt-ms", arguments.rtt_ms, "from 0 to 10000", 1e4)?,
                jitter_s: 1e-3 * part("--jitter-ms", arguments.jitter_ms, "from 0 to 10000", 1e4)?,
                loss: part("--loss", arguments.loss, "from 0 to 1", 1.0)?,
                ..Conditions::default()
            }
        }
    };
    let conditions = arguments.on(conditions);
    number("--loss-burst", conditions.burst, "from 1 to 1000", |v| (1.0..=1000.0).contains(&v))?;
    number("--outage-ms", arguments.outage_ms, "from 0 to 1000", |v| (0.0..=1000.0).contains(&v))?;
    let up_deadband = number("--up-deadband", arguments.up_deadband, "from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
    let range = format!("from 0.001 to {LONGEST_S}");
    let duration_s = number("--seconds", arguments.seconds, &range, |v| (1e-3..=LONGEST_S).contains(&v))?;
    let stalls = "from 0 to 1000";
    let stall_s = 1e-3 * number("--stall-ms", arguments.stall_ms, stalls, |v| (0.0..=1000.0).contains(&v))?;
    let deadband = number("--deadband", arguments.deadband, "from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
    let scene = find_scene(&arguments.scene, Path::new("scenes"), &[], &limits).map_err(|refusal| {
        if refusal.place.is_none() { Refusal { field: "--scene".to_owned(), ..refusal } } else { refusal }
    })?;
    let tip = Tip { radius_m: arguments.radius_m, friction: arguments.friction, ..Tip::default() };
    check_tip("--tip", scene.shape(), &tip)?;
    let model = Model::compile(&scene, &limits)?;
    let near_m = match (arguments.place.as_slice(), model.shape().dimensions()) {
        ([], _) => model.shape().extent().middle_m(),
        ([x, y], 2) => DVec3::new(*x, *y, 0.0),
        ([x, y, z], _) => DVec3::new(*x, *y, *z),
        (_, count) => {
            let names = if count == 2 { "X,Y" } else { "X,Y,Z" };
            let message = format!("must be {count} numbers, {names}");
            return Err(Refusal::new(Reason::WrongKind, "--place", message));
        }
    };
    model.shape().check_place("--place", near_m)?;
    if arguments.server.is_some() && model.shape().dimensions() > 2 {
        let message = "works on sheets only: on a mesh leave it out, and the loop runs in virtual time";
        return Err(Refusal::new(Reason::NotAvailable, "--server", message));
    }
    let spot = Spot::new(&model, near_m, tip.radius_m);
    // With a server the first law is that of the middle, but before the first press it tells that of the place.
    let disc = Disc::in_middle(&model, tip.radius_m).follow(&model, spot.at_m);
    let law = tissue::law_at(&model, disc).ok_or_else(|| {
        Refusal::new(Reason::NotAvailable, "--scene", "has no force law: nothing holds it, or it is too large")
    })?;
    let (scheme, seed) = (arguments.scheme, arguments.seed);
    Ok(Setup {
        model,
        law,
        disc,
        tip,
        spot,
        hand,
        device,
        conditions,
        stall_s,
        scheme,
        deadband,
        up_deadband,
        duration_s,
        seed,
    })
}

/// The figures of a run that are printed.
fn figures(setup: &Setup, outcome: &Outcome) -> Value {
    let interventions: serde_json::Map<String, Value> =
        outcome.interventions.iter().map(|(name, ticks)| ((*name).to_owned(), json!(ticks))).collect();
    let [limited, dropped, released] = outcome.path;
    let mut figures = json!({
        "scene": setup.model.scene.name,
        "hand": setup.hand.name,
        "device": setup.device.name,
        "scheme": format!("{:?}", setup.scheme).to_lowercase(),
        "rtt_ms": 1e3 * setup.conditions.round_trip_s,
        "jitter_ms": 1e3 * setup.conditions.jitter_s,
        "loss": setup.conditions.loss,
        "transport": setup.conditions.transport.name(),
        "loss_burst": setup.conditions.burst,
        "outage_ms": 1e3 * setup.conditions.outage_s,
        "stall_ms": 1e3 * setup.stall_s,
        "deadband": setup.deadband,
        "up_deadband": setup.up_deadband,
        "seconds": setup.duration_s,
        "seed": setup.seed,
        "place_m": setup.spot.at_m.to_array(),
        "scale": outcome.scale,
        "force_error_rms_percent": outcome.force_error_rms_percent,
        "force_error_p99_n": outcome.force_error_p99_n,
        "energy_min_j": outcome.energy_min_j,
        "jump_max_n": outcome.jump_max_n,
        "guard_share": outcome.guard_share,
        "rendered_share": outcome.rendered_share,
        "packets_per_s": outcome.packets_per_s,
        "kbit_per_s": outcome.kbit_per_s,
        "model_age_ms_p99": outcome.model_age_ms_p99,
        "peak_ratio": outcome.peak_ratio,
        "unstable": outcome.unstable_at_s.is_some(),
        "unstable_at_s": outcome.unstable_at_s,
        "true_force_max_n": outcome.true_force_max_n,
        "force_max_n": outcome.force_max_n,
        "pauses": outcome.pauses,
        "faults": outcome.faults,
        "commands_per_s": outcome.commands_per_s,
        "speed_limited_steps": limited,
        "commands_dropped": dropped,
        "releases": released,
        "interventions_ticks": interventions,
        "late_ticks": outcome.late_ticks,
    });
    if let Some(Carried { sent, came, fell_back }) = outcome.carried {
        figures["datagrams_up"] = json!(sent);
        figures["datagrams_down"] = json!(came);
        figures["fell_back"] = json!(fell_back);
    }
    figures
}
