//! `palpate-client link`: simulates hand, device, network and tissue in one loop in virtual time. The seed determines
//! the result. Only this program drives a tissue itself.

mod boundary;
mod client;
mod collision;
mod direct;
mod figures;
mod instrument;
mod instrument_runs;
mod laws;
mod led_tissue;
mod live;
mod measure;
mod poses;
mod random;
mod run;
mod server;
mod setup;
mod spot;
mod tissue;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::{Args, ValueEnum};
use glam::DVec3;
use palpate_haptics::{Law, Tip, TipShape};
use palpate_refusal::{Reason, Refusal, number};
use palpate_simulated::network::{Conditions, Transport};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::memory;
use palpate_tissue::response::force_law::Disc;
use palpate_tissue::scene::Change;
use palpate_tissue::scene::action_check::check_tip;
use palpate_tissue::scene::collection::find_scene;

use crate::ClientFailure;
use crate::credentials::CredentialOptions;
use crate::simulated::{device_named, hand_named};
use crate::table;
use collision::Collision;
use figures::{figures, rows};
use instrument::InstrumentKind;
use laws::PlaceLaws;
use run::run;
use setup::{Rendering, SecondLeader, Setup, TissueChange};
use spot::Spot;

/// Arguments of `link`.
#[derive(Args)]
pub(crate) struct LinkArguments {
    /// A scene file, or the name of one that is in ./scenes or built in: `liver`, `liver-organ`, `prostate`, …
    #[arg(long, default_value = "liver")]
    scene: PathBuf,
    /// The hand that holds the device: light, medium or firm; or none: a weak string leads the device
    #[arg(long, default_value = "medium")]
    hand: String,
    /// The device: touch, omni, desktop, falcon, omega3, delta3, sigma7, lambda7 or inverse3; or undeclared. Of these sigma7 and
    /// lambda7 render torque [default: omega3; with --instrument sigma7]
    #[arg(long)]
    device: Option<String>,
    /// The hand leads an instrument by a device of six axes, which renders force and torque from a copy of the tissue
    #[arg(long, value_name = "KIND", conflicts_with_all = ["second_tool_mm", "tissue_change_s", "stall_ms", "scheme", "deadband", "up_deadband", "course", "server", "boundary"])]
    instrument: Option<InstrumentKind>,
    /// Two hands push shafts of 60 mm together above the tissue, at 0.1 m/s, and back, every two seconds. --second-hand own: both are
    /// hands of this client
    #[arg(long, value_name = "HOW", group = "second", conflicts_with_all = ["instrument", "second_tool_mm", "tissue_change_s", "stall_ms", "scheme", "deadband", "up_deadband", "course", "server", "boundary", "random"])]
    collision: Option<Collision>,
    /// Round-trip time, ms
    #[arg(long, value_name = "MS", conflicts_with = "profile")]
    rtt_ms: Option<f64>,
    /// Standard deviation of the delay each way, ms; messages of a stream stay in order
    #[arg(long, value_name = "MS", conflicts_with = "profile")]
    jitter_ms: Option<f64>,
    /// Fraction of the packets that are lost. A stream sends them again, which delays all later ones
    #[arg(long, value_name = "FRACTION", conflicts_with = "profile")]
    loss: Option<f64>,
    /// How samples and poses travel: stream (TCP: a lost packet delays all later ones) or datagram (UDP: a lost
    /// packet delays no other)
    #[arg(long, default_value = "stream", conflicts_with_all = ["random", "boundary"])]
    transport: Transport,
    /// Mean number of packets lost in a row; 1: losses are independent
    #[arg(long, value_name = "PACKETS", default_value_t = 1.0, conflicts_with_all = ["random", "boundary"])]
    loss_burst: f64,
    /// Once a second nothing gets through for this long, ms
    #[arg(long, value_name = "MS", default_value_t = 0.0, conflicts_with_all = ["random", "boundary"])]
    outage_ms: f64,
    /// Limit of the rate each way, kbit/s
    #[arg(long, value_name = "KBIT", conflicts_with_all = ["random", "boundary"])]
    bandwidth_kbit: Option<f64>,
    /// With --bandwidth-kbit: a datagram that would wait longer than this for the link is dropped, ms
    #[arg(long, value_name = "MS", default_value_t = 100.0, requires = "bandwidth_kbit")]
    queue_ms: f64,
    /// A second tool with its own seed presses at this distance from the place of the task, mm
    #[arg(long, value_name = "MM", default_value_t = 0.0, group = "second", conflicts_with_all = ["random", "boundary"])]
    second_tool_mm: f64,
    /// With --second-tool-mm or --collision: who leads the second tool or instrument
    #[arg(long, value_name = "WHOSE", default_value = "another", requires = "second")]
    second_hand: SecondLeader,
    /// The tissue changes at this time, s
    #[arg(long, value_name = "SECONDS", conflicts_with_all = ["random", "boundary"])]
    tissue_change_s: Option<f64>,
    /// With --tissue-change-s: factor by which all springs become stiffer
    #[arg(long, value_name = "FACTOR", default_value_t = 1.5, requires = "tissue_change_s")]
    tissue_change_factor: f64,
    /// Stall the client once a second, at a random moment, for this long, ms; the device holds its last force
    #[arg(long, value_name = "MS", default_value_t = 0.0, conflicts_with = "random")]
    stall_ms: f64,
    /// A network by name, instead of --rtt-ms, --jitter-ms and --loss
    #[arg(long)]
    profile: Option<Profile>,
    /// How the client renders samples [default: prediction on a mesh, model on a sheet, as `bridge` does]
    #[arg(long)]
    scheme: Option<Rendering>,
    /// Send a sample only if the error of the force that the client renders exceeds this fraction; 0 sends one per
    /// step
    #[arg(long, value_name = "FRACTION", default_value_t = 0.0, conflicts_with = "random")]
    deadband: f64,
    /// Send a place of the tool only if the server's prediction would be wrong by more than this fraction of the
    /// force; 0 sends one per tick
    #[arg(long, value_name = "FRACTION", default_value_t = 0.0, conflicts_with_all = ["random", "boundary"])]
    up_deadband: f64,
    /// Duration in simulated time, s
    #[arg(long, value_name = "SECONDS", default_value_t = 20.0)]
    seconds: f64,
    /// Seed of the task and the network
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Place of the task, m: the nearest place of the tissue's rest surface; for a sheet X,Y [default: the middle; on
    /// a solid the top]
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', allow_hyphen_values = true, conflicts_with_all = ["random", "boundary"])]
    place: Vec<f64>,
    /// The client is a trainee's: what it is told of the tissue is without lumps, and it gets no copy of it
    #[arg(long, conflicts_with_all = ["instrument", "collision", "tissue_change_s", "server", "random", "boundary"])]
    hides_lumps: bool,
    /// The tool's tip: disc (an even pressure), rigid (a rigid disc) or sphere; the last two need a solid [default: sphere on a
    /// solid, which is unstable under an even pressure that is deep; disc on other tissues]
    #[arg(long, value_name = "SHAPE", conflicts_with = "random")]
    tip: Option<TipShape>,
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
    #[arg(long, value_name = "URL", conflicts_with_all = ["rtt_ms", "jitter_ms", "loss", "loss_burst", "outage_ms", "bandwidth_kbit", "second_tool_mm", "tissue_change_s", "stall_ms", "profile", "random", "boundary"])]
    server: Option<String>,
    #[command(flatten)]
    credentials: CredentialOptions,
    /// Run this many random combinations of scene, hand, device, task and place, network and transport, deadbands, a
    /// second tool and a change of the tissue, with seeds from --seed on; report the worst value of each figure
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

/// Longest simulated time, s.
const LONGEST_S: f64 = 3600.0;

/// Performs the run or runs and prints the results.
///
/// # Errors
/// Returns an error if an argument is refused, a run fails, or a file can't be written.
pub(crate) async fn link(arguments: &LinkArguments) -> Result<(), ClientFailure> {
    if arguments.boundary {
        return boundary::print(arguments.json);
    }
    if let (Some(runs), None) = (arguments.random, arguments.instrument) {
        return random::print(arguments, runs);
    }
    let setup = memory::attempt("--scene", || setup(arguments))?;
    if let Some(collision) = arguments.collision {
        return collision::print(arguments, &setup, collision);
    }
    if let Some(kind) = arguments.instrument {
        return instrument_runs::print(arguments, &setup, kind);
    }
    let outcome = match &arguments.server {
        Some(server) => live::run(&setup, arguments.credentials.server(server)?).await?,
        None => with_tissue(|| run(&setup))?,
    };
    if let Some(path) = &arguments.course {
        let mut text = "time_s,depth_m,rendered_n,true_n\n".to_owned();
        for [time_s, depth_m, rendered_n, true_n] in &outcome.course {
            text += &format!("{time_s:.3},{depth_m:.6},{rendered_n:.6},{true_n:.6}\n");
        }
        std::fs::write(path, text).map_err(|error| ClientFailure::Failed(format!("{}: {error}", path.display())))?;
    }
    if arguments.json {
        crate::tell!("{}", figures(&setup, &outcome));
    } else {
        table::print(&rows(&setup, &outcome, arguments.server.as_deref()));
    }
    Ok(())
}

/// Runs work on a tissue.
///
/// # Errors
/// Returns an error if the system has no memory for the tissue (exit status 2), or if the guard stops it (1).
fn with_tissue<T>(work: impl FnOnce() -> Result<T, String>) -> Result<T, ClientFailure> {
    memory::attempt("--scene", || Ok(work()))?.map_err(ClientFailure::Failed)
}

fn setup(arguments: &LinkArguments) -> Result<Setup, Refusal> {
    let limits = Limits::default();
    let hand = hand_named(&arguments.hand)?;
    let usual = if arguments.instrument.is_some() || arguments.collision.is_some() { "sigma7" } else { "omega3" };
    let device = device_named(arguments.device.as_deref().unwrap_or(usual))?;
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
    let rate_kbit = arguments.bandwidth_kbit.map(|kbit| number("--bandwidth-kbit", kbit, "at least 1", |v| v >= 1.0));
    let conditions = Conditions {
        transport: arguments.transport,
        burst: number("--loss-burst", arguments.loss_burst, "from 1 to 1000", |v| (1.0..=1000.0).contains(&v))?,
        outage_s: 1e-3 * number("--outage-ms", arguments.outage_ms, "from 0 to 1000", |v| (0.0..=1000.0).contains(&v))?,
        rate_bit_per_s: 1e3 * rate_kbit.transpose()?.unwrap_or(0.0),
        queue_s: 1e-3 * number("--queue-ms", arguments.queue_ms, "from 0 to 10000", |v| (0.0..=1e4).contains(&v))?,
        ..conditions
    };
    let up_deadband = number("--up-deadband", arguments.up_deadband, "from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
    let range = format!("from 0.001 to {LONGEST_S}");
    let duration_s = number("--seconds", arguments.seconds, &range, |v| (1e-3..=LONGEST_S).contains(&v))?;
    let stalls = "from 0 to 1000";
    let stall_s = 1e-3 * number("--stall-ms", arguments.stall_ms, stalls, |v| (0.0..=1000.0).contains(&v))?;
    let deadband = number("--deadband", arguments.deadband, "from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
    let scene = find_scene(&arguments.scene, Path::new("scenes"), &[], &limits).map_err(|refusal| {
        if refusal.place.is_none() { Refusal { field: "--scene".to_owned(), ..refusal } } else { refusal }
    })?;
    let usual = if scene.shape().takes_rigid_tips() { TipShape::Sphere } else { TipShape::Disc };
    let shape = arguments.tip.unwrap_or(usual);
    let tip = Tip { shape, radius_m: arguments.radius_m, friction: arguments.friction, ..Tip::default() };
    check_tip("--tip", scene.shape(), &tip)?;
    let model = Model::compile(&scene, &limits)?;
    let near_m = match (arguments.place.as_slice(), model.shape().dimensions()) {
        ([], _) => model.shape().pressed_m(),
        ([x, y], 2) => DVec3::new(*x, *y, 0.0),
        ([x, y, z], _) => DVec3::new(*x, *y, *z),
        (_, count) => {
            let names = if count == 2 { "X,Y" } else { "X,Y,Z" };
            let message = format!("must be {count} numbers, {names}");
            return Err(Refusal::new(Reason::WrongKind, "--place", message));
        }
    };
    model.shape().check_place("--place", near_m)?;
    let spot = Spot::new(&model, near_m, &tip);
    // A server first sends the law of the middle, and before the first press that of the place.
    let disc = Disc::in_middle(&model, tip.radius_m).follow(&model, spot.at_m);
    let told =
        if arguments.hides_lumps { &Model::compile(&model.scene.without_inclusions()?, &limits)? } else { &model };
    let laws = Arc::new(PlaceLaws::new(told, tip.shape));
    let law = law_of(&laws, disc)?;
    let second = "from 0 to 1000";
    let second_m = 1e-3 * number("--second-tool-mm", arguments.second_tool_mm, second, |v| (0.0..=1e3).contains(&v))?;
    if second_m > 0.0 {
        model.shape().check_place("--second-tool-mm", spot.of_tissue(spot.at_m + DVec3::new(second_m, 0.0, 0.0)))?;
    }
    let change = arguments.tissue_change_s.map(|at_s| {
        let at_s = number("--tissue-change-s", at_s, &range, |v| (0.0..=LONGEST_S).contains(&v))?;
        let factor = arguments.tissue_change_factor;
        let factor = number("--tissue-change-factor", factor, "from 0.01 to 100", |v| (0.01..=100.0).contains(&v))?;
        changed(&model, tip.shape, at_s, factor)
    });
    let change = change.transpose()?;
    let has_copy = !model.shape().is_uniform() && !arguments.hides_lumps;
    let usual = if has_copy { Rendering::Prediction } else { Rendering::Model };
    if arguments.hides_lumps && arguments.scheme == Some(Rendering::Prediction) {
        let message = "prediction: renders from a copy of the tissue, which --hides-lumps gives no client";
        return Err(Refusal::new(Reason::WrongKind, "--scheme", message));
    }
    let (scheme, seed) = (arguments.scheme.unwrap_or(usual), arguments.seed);
    Ok(Setup {
        model,
        laws,
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
        second_m,
        second_hand: arguments.second_hand,
        change,
        duration_s,
        seed,
    })
}

/// Returns the exact force law of a tissue under a disc.
fn law_of(laws: &PlaceLaws, disc: Disc) -> Result<Arc<Law>, Refusal> {
    laws.law(disc).ok_or_else(|| {
        Refusal::new(Reason::NotAvailable, "--scene", "has no force law: nothing holds it, or it is too large")
    })
}

/// Returns a change of the tissue whose springs are stiffer by `factor` from `at_s` on.
fn changed(model: &Model, shape: TipShape, at_s: f64, factor: f64) -> Result<TissueChange, Refusal> {
    let scene = &model.scene;
    let change = Change {
        stiffness_n_per_m: Some(factor * scene.springs.stiffness_n_per_m),
        anchor_stiffness_n_per_m: Some(factor * scene.anchor_stiffness_n_per_m),
        ..Change::default()
    };
    let model = model.changed(&change, scene, &Limits::default())?;
    Ok(TissueChange { at_s, factor, laws: Arc::new(PlaceLaws::new(&model, shape)), model })
}
