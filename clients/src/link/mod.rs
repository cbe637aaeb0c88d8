//! `palpate-client link`: hand, device, network and tissue in one loop in virtual time. It is deterministic by its seed,
//! and alone among the programs here it drives a tissue itself.

mod boundary;
mod live;
mod network;
mod random;
mod run;
mod task;
mod tissue;

use std::path::PathBuf;
use std::sync::Arc;

use clap::{Args, ValueEnum};
use palpate::haptics::Law;
use palpate::haptics::device::{DEVICES, Device, UNDECLARED};
use palpate::haptics::hand::{HANDS, Hand};
use palpate::limits::Limits;
use palpate::refusal::{Reason, Refusal, number};
use palpate::scene::tip::Tip;
use palpate::scene::{BUILT_IN, Scene};
use palpate::sheet::Model;
use serde_json::{Value, json};

use crate::Failure;
use crate::connect::{Credentials, Server};
pub(crate) use network::Dice;
use network::Weather;
use run::{Found, Scheme, Setup, run};
pub(crate) use task::{LEAD_S, Task};

/// What `link` is asked for.
#[derive(Args)]
pub(crate) struct Arguments {
    /// A scene file, or the name of one: in ./scenes, or built in (fibrotic, liver, paper, stomach)
    #[arg(long, default_value = "liver")]
    scene: PathBuf,
    /// Who holds the device: light, medium or firm; or none, who lets a string lead it
    #[arg(long, default_value = "medium")]
    hand: String,
    /// touch, omni, desktop, falcon, omega3, delta3, sigma7, lambda7 or inverse3; or undeclared
    #[arg(long, default_value = "omega3")]
    device: String,
    /// Delay there and back, ms
    #[arg(long, value_name = "MS", conflicts_with = "profile")]
    rtt_ms: Option<f64>,
    /// Standard deviation of the delay each way, ms; order is kept
    #[arg(long, value_name = "MS", conflicts_with = "profile")]
    jitter_ms: Option<f64>,
    /// Part of the messages that TCP must send again, which holds up all after them
    #[arg(long, value_name = "PART", conflicts_with = "profile")]
    loss: Option<f64>,
    /// Once a second, at a random moment, the client stands still for so long, ms; the device holds its last force
    #[arg(long, value_name = "MS", default_value_t = 0.0, conflicts_with = "random")]
    stall_ms: f64,
    /// A network by name, in place of the three above
    #[arg(long)]
    profile: Option<Profile>,
    /// What the client makes of samples
    #[arg(long, default_value = "model")]
    scheme: Scheme,
    /// Send a sample only when the force that the client renders is off by this part; 0 sends one a step
    #[arg(long, value_name = "PART", default_value_t = 0.0)]
    deadband: f64,
    /// Simulated time, s
    #[arg(long, value_name = "S", default_value_t = 20.0)]
    seconds: f64,
    /// Of the task and the network
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Radius of the tool's tip, m
    #[arg(long, value_name = "M", default_value_t = Tip::default().radius_m)]
    radius_m: f64,
    /// Friction of the tip
    #[arg(long, default_value_t = Tip::default().friction)]
    friction: f64,
    /// Print one JSON object, not a table
    #[arg(long)]
    json: bool,
    /// Write time, depth, rendered and true force of each tick to this file, as CSV
    #[arg(long, value_name = "FILE")]
    course: Option<PathBuf>,
    /// Run in real time against this server, which has the scene by its name, in place of virtual time; the network is what
    /// it is
    #[arg(long, value_name = "URL", conflicts_with_all = ["rtt_ms", "jitter_ms", "loss", "stall_ms", "profile", "random", "boundary"])]
    server: Option<String>,
    #[command(flatten)]
    credentials: Credentials,
    /// Run so many random combinations of scene, hand, device, network and task (`--seed` is the first), and report the
    /// worst of each figure
    #[arg(long, value_name = "RUNS", conflicts_with_all = ["course", "boundary"])]
    random: Option<u64>,
    /// Find the delay at which hand and spring become unstable, beside what theory says
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
    /// 120 ± 40 ms, one in a hundred lost
    BadWan,
}

impl Profile {
    fn weather(self) -> Weather {
        let (round_trip_s, jitter_s, loss) = match self {
            Profile::Lan => (0.0005, 0.0, 0.0),
            Profile::Metro => (0.010, 0.002, 0.0),
            Profile::Wan => (0.050, 0.010, 0.001),
            Profile::BadWan => (0.120, 0.040, 0.01),
        };
        Weather { round_trip_s, jitter_s, loss }
    }
}

/// Longest simulated time, s.
const LONGEST_S: f64 = 3600.0;

/// Runs what was asked for and prints what was found.
pub(crate) async fn link(arguments: &Arguments) -> Result<(), Failure> {
    if arguments.boundary {
        return boundary::print(arguments.json);
    }
    if let Some(runs) = arguments.random {
        return random::print(arguments, runs);
    }
    let refused = |refusal: Refusal| Failure::Refused(refusal.to_string());
    let setup = setup(arguments).map_err(refused)?;
    let found = match &arguments.server {
        Some(server) => live::run(&setup, Server::new(server, &arguments.credentials)?).await?,
        None => run(&setup).map_err(Failure::Failed)?,
    };
    if let Some(path) = &arguments.course {
        let mut text = "time_s,depth_m,rendered_n,true_n\n".to_owned();
        for [time_s, depth_m, rendered_n, true_n] in &found.course {
            text += &format!("{time_s:.3},{depth_m:.6},{rendered_n:.6},{true_n:.6}\n");
        }
        std::fs::write(path, text).map_err(|error| Failure::Failed(format!("{}: {error}", path.display())))?;
    }
    let figures = figures(&setup, &found);
    if arguments.json {
        crate::tell!("{figures}");
    } else if let Value::Object(fields) = figures {
        for (name, value) in fields {
            crate::tell!("{name:<26} {value}");
        }
    }
    Ok(())
}

/// By its name, or what there is.
fn named<T>(field: &str, name: &str, found: Option<T>, names: &[&str]) -> Result<T, Refusal> {
    found.ok_or_else(|| {
        Refusal::new(Reason::WrongKind, field, format!("must be one of {}, but is `{name}`", names.join(", ")))
    })
}

pub(crate) fn device_named(name: &str) -> Result<Device, Refusal> {
    let mut names: Vec<&str> = DEVICES.iter().map(|device| device.name).collect();
    names.push(UNDECLARED.name);
    let found = if name == UNDECLARED.name { Some(UNDECLARED) } else { Device::named(name) };
    named("--device", name, found, &names)
}

/// A scene file, or a scene in ./scenes, or one built in.
pub(crate) fn scene_named(name: &std::path::Path, limits: &Limits) -> Result<Scene, Refusal> {
    let mut beside = std::path::Path::new("scenes").join(name).into_os_string();
    beside.push(".toml");
    let beside = PathBuf::from(beside);
    let built_in = name.to_str().and_then(|name| BUILT_IN.iter().find(|scene| scene.0 == name));
    match built_in {
        _ if name.is_file() => Scene::load(name, &[], limits),
        _ if beside.is_file() => Scene::load(&beside, &[], limits),
        Some((name, text)) => Scene::parse(name, text, &[], limits),
        None => {
            let names: Vec<&str> = BUILT_IN.iter().map(|scene| scene.0).collect();
            let message = format!("there is no scene `{}`; built in are {}", name.display(), names.join(", "));
            Err(Refusal::new(Reason::UnknownScene, "--scene", message))
        }
    }
}

pub(crate) fn hand_named(name: &str) -> Result<Hand, Refusal> {
    let names: Vec<&str> = HANDS.iter().map(|hand| hand.name).collect();
    named("--hand", name, Hand::named(name), &names)
}

fn setup(arguments: &Arguments) -> Result<Setup, Refusal> {
    let limits = Limits::default();
    let hand = hand_named(&arguments.hand)?;
    let device = device_named(&arguments.device)?;
    let weather = match arguments.profile {
        Some(profile) => profile.weather(),
        None => {
            let part = |field: &str, value: Option<f64>, range: &str, most: f64| {
                number(field, value.unwrap_or(0.0), range, |v| (0.0..=most).contains(&v))
            };
            Weather {
                round_trip_s: 1e-3 * part("--rtt-ms", arguments.rtt_ms, "from 0 to 10000", 1e4)?,
                jitter_s: 1e-3 * part("--jitter-ms", arguments.jitter_ms, "from 0 to 10000", 1e4)?,
                loss: part("--loss", arguments.loss, "from 0 to 1", 1.0)?,
            }
        }
    };
    let range = format!("from 0.001 to {LONGEST_S}");
    let duration_s = number("--seconds", arguments.seconds, &range, |v| (1e-3..=LONGEST_S).contains(&v))?;
    let stalls = "from 0 to 1000";
    let stall_s = 1e-3 * number("--stall-ms", arguments.stall_ms, stalls, |v| (0.0..=1000.0).contains(&v))?;
    let deadband = number("--deadband", arguments.deadband, "from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
    let scene = scene_named(&arguments.scene, &limits)?;
    let tip = Tip { radius_m: arguments.radius_m, friction: arguments.friction, ..Tip::default() };
    tip.check("--tip", &scene.sheet)?;
    let model = Model::compile(&scene, &limits)?;
    let law = Arc::new(Law::of(&model, tip.radius_m));
    let (scheme, seed) = (arguments.scheme, arguments.seed);
    Ok(Setup { model, law, tip, hand, device, weather, stall_s, scheme, deadband, duration_s, seed })
}

/// What is printed of a run.
fn figures(setup: &Setup, found: &Found) -> Value {
    let interventions: serde_json::Map<String, Value> =
        found.interventions.iter().map(|(name, ticks)| ((*name).to_owned(), json!(ticks))).collect();
    let [limited, dropped, released] = found.path;
    json!({
        "scene": setup.model.scene.name,
        "hand": setup.hand.name,
        "device": setup.device.name,
        "scheme": format!("{:?}", setup.scheme).to_lowercase(),
        "rtt_ms": 1e3 * setup.weather.round_trip_s,
        "jitter_ms": 1e3 * setup.weather.jitter_s,
        "loss": setup.weather.loss,
        "stall_ms": 1e3 * setup.stall_s,
        "deadband": setup.deadband,
        "seconds": setup.duration_s,
        "seed": setup.seed,
        "scale": found.scale,
        "force_error_rms_percent": found.force_error_rms_percent,
        "force_error_p99_n": found.force_error_p99_n,
        "energy_min_j": found.energy_min_j,
        "jump_max_n": found.jump_max_n,
        "guard_share": found.guard_share,
        "rendered_share": found.rendered_share,
        "packets_per_s": found.packets_per_s,
        "kbit_per_s": found.kbit_per_s,
        "model_age_ms_p99": found.model_age_ms_p99,
        "peak_ratio": found.peak_ratio,
        "unstable": found.unstable_at_s.is_some(),
        "unstable_at_s": found.unstable_at_s,
        "true_force_max_n": found.true_force_max_n,
        "force_max_n": found.force_max_n,
        "pauses": found.pauses,
        "faults": found.faults,
        "commands_per_s": found.commands_per_s,
        "speed_limited_steps": limited,
        "commands_dropped": dropped,
        "releases": released,
        "interventions_ticks": interventions,
        "late_ticks": found.late_ticks,
    })
}
