//! `palpate-client bridge`: connects a haptic device, simulated or real, to a server at 1 kHz.

use std::time::Duration;

use glam::DVec3;
use palpate_client::HapticDevice;
use palpate_client::bridge::{
    BridgeReport, CutButton, Options, SessionChoice, Target, Tick, Traffic, Warn, run, two_hands,
};
use palpate_client::devices::{self, DeviceKind, Placed, Placement};
use palpate_haptics::instrument::MAX_TIPS;
use palpate_haptics::jaw_limit::MAX_JAW_TORQUE_LIMIT_N_M;
use palpate_haptics::port::HANDLE_M;
use palpate_haptics::{Instrument, LimitCause, Port, RenderingState, Tip, TipShape};
use palpate_refusal::printable::printable_json;
use palpate_refusal::{finite_vector, number};
use palpate_simulated::random::Random;
use palpate_simulated::task::{LEAD_S, Task};
use serde_json::json;

use crate::credentials::CredentialOptions;
use crate::placement::{PlacementOptions, vector};
use crate::prediction::When;
use crate::simulated::{Simulated, device_named, hand_named};
use crate::{ClientFailure, interrupted, table, warn};

/// Arguments of `bridge`.
#[derive(clap::Args)]
pub(crate) struct BridgeArguments {
    /// The server
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:7117")]
    server: String,
    /// ID of an existing session [default: a new session of --scene]
    #[arg(long, value_name = "ID")]
    session: Option<String>,
    /// Name of a scene of the server
    #[arg(long, value_name = "NAME", default_value = "liver")]
    scene: String,
    /// The tool's number
    #[arg(long, default_value_t = 0)]
    tool: u32,
    /// The device: force-dimension, openhaptics, haply, spacemouse or gamepad (`palpate-client devices` lists the
    /// available ones); or a simulated one: touch, omni, desktop, falcon, omega3, delta3, sigma7, lambda7, inverse3
    /// or undeclared
    #[arg(long, value_name = "NAME", default_value = "omega3")]
    device: String,
    /// A second device, for the other hand, with a tool of its own in the same session. The library, the hand and the placement
    /// are those of the first, but for --second-offset-m
    #[arg(long, value_name = "NAME", requires = "session")]
    second_device: Option<String>,
    /// The tool of the second device, of an instrument the first one [default: the one after those of the first device]
    #[arg(long, value_name = "NUMBER", requires = "second_device")]
    second_tool: Option<u32>,
    /// Offset of the second device's workspace from that of the first, m
    #[arg(long, value_name = "X,Y,Z", value_parser = vector, allow_hyphen_values = true, default_value = "0.02,0,0")]
    second_offset_m: DVec3,
    /// The library of the device's maker, if it is not where the system looks for libraries
    #[arg(long, value_name = "FILE")]
    library: Option<std::path::PathBuf>,
    #[command(flatten)]
    placement: PlacementOptions,
    /// The tool's tip: disc (an even pressure), rigid (a rigid disc) or sphere; the last two need a solid
    #[arg(long, value_name = "SHAPE", default_value = "disc")]
    tip: TipShape,
    /// Radius of the tool's tip, m
    #[arg(long, value_name = "M", default_value_t = Tip::default().radius_m)]
    radius_m: f64,
    /// The device leads an instrument, by its position and orientation: jaws of this length, m, whose angle is that of the device's
    /// gripper. Its tips have --tip and --radius-m, and are the tools from --tool on. Force and torque come from a copy of the tissue.
    /// A second device leads an equal instrument
    #[arg(long, value_name = "M", conflicts_with_all = ["up_deadband", "deadband"])]
    jaws_m: Option<f64>,
    /// The device leads an instrument with a shaft of this length, m, behind its jaws if it has any
    #[arg(long, value_name = "M", conflicts_with_all = ["up_deadband", "deadband"])]
    shaft_m: Option<f64>,
    /// The shaft of the instrument slides through this place, as through a trocar, m, in the tissue's frame
    #[arg(long, value_name = "X,Y,Z", value_parser = vector, allow_hyphen_values = true)]
    port_m: Option<DVec3>,
    /// With --port-m: distance from the tip of the instrument to its handle, m
    #[arg(long, value_name = "M", default_value_t = palpate_haptics::port::DEFAULT_HANDLE_M, requires = "port_m")]
    handle_m: f64,
    /// Warn and count when the torque between the jaws of the instrument exceeds this, N·m: then they crush what they hold
    #[arg(long, value_name = "N_M", requires = "jaws_m")]
    jaw_torque_limit_n_m: Option<f64>,
    /// While this button of the device is held, the tool is a blade of the radius of its tip, and cuts; the first is 0. When it is let go, the
    /// blade cuts no more, and touches again once it is out of the tissue. Forces come without a copy of the tissue
    #[arg(long, value_name = "NUMBER", conflicts_with_all = ["jaws_m", "shaft_m", "up_deadband"])]
    cut_button: Option<u32>,
    /// With --cut-button: length of the blade's edge, m. It stands on the tip, along z of the device, and turns with its handle
    #[arg(long, value_name = "M", default_value_t = 0.02, requires = "cut_button")]
    blade_m: f64,
    /// The simulated hand that holds a simulated device: light, medium, firm or none
    #[arg(long, default_value = "medium")]
    hand: String,
    /// Receive a sample only if the error of the rendered force would exceed this fraction; 0: one per step
    #[arg(long, value_name = "FRACTION", default_value_t = 0.0)]
    deadband: f64,
    /// Send a pose only if the server's prediction of the tool would be wrong by more than this fraction of the
    /// force; 0: one per tick
    #[arg(long, value_name = "FRACTION", default_value_t = 0.0)]
    up_deadband: f64,
    /// When to keep a copy of the tissue, which the client simulates: forces then have no network delay, and samples
    /// correct them
    #[arg(long, value_name = "WHEN", default_value = "auto")]
    prediction: When,
    /// Touch by the stream alone, even if the server offers datagrams
    #[arg(long)]
    no_datagrams: bool,
    /// End after this time, s [default: at Ctrl-C]
    #[arg(long, value_name = "SECONDS")]
    seconds: Option<f64>,
    /// Seed of the simulated hand's movements
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Keep the new session at the end, and print its ID: the server deletes it when nobody has used it for a quarter
    /// of an hour (idle_session_s)
    #[arg(long)]
    keep_session: bool,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
    /// Write time, place, force and state of each tick to this file (CSV); at most an hour
    #[arg(long, value_name = "FILE")]
    course: Option<std::path::PathBuf>,
    #[command(flatten)]
    credentials: CredentialOptions,
}

/// Scale of the depths of the simulated hand's presses.
const SCALE: f64 = 0.2;

/// Returns the instrument that the device leads, if it leads one.
fn instrument(arguments: &BridgeArguments, tip: Tip) -> Result<Option<Instrument>, ClientFailure> {
    let length = |field: &str, value: Option<f64>| {
        value.map(|m| number(field, m, "above 0 and at most 0.5", |m| m > 0.0 && m <= 0.5)).transpose()
    };
    let (jaws_m, shaft_m) = (length("--jaws-m", arguments.jaws_m)?, length("--shaft-m", arguments.shaft_m)?);
    if jaws_m.is_none() && shaft_m.is_none() {
        let Some(_) = arguments.port_m else { return Ok(None) };
        return Err(ClientFailure::Refused("--port-m: needs --shaft-m or --jaws-m".to_owned()));
    }
    number("--radius-m", tip.radius_m, "above 0", |m| m > 0.0)?;
    let range = format!("from {} to {}", HANDLE_M.start(), HANDLE_M.end());
    arguments.port_m.map_or(Ok(DVec3::ZERO), |place_m| finite_vector("--port-m", place_m))?;
    if arguments.prediction == When::Never {
        let text = "--prediction: an instrument is rendered from a copy of the tissue: choose auto or always";
        return Err(ClientFailure::Refused(text.to_owned()));
    }
    let handle_m = number("--handle-m", arguments.handle_m, &range, |m| HANDLE_M.contains(&m))?;
    let mut instrument = Instrument::default();
    instrument.add_parts(jaws_m.map(|length_m| (length_m, tip)), shaft_m.map(|length_m| (length_m, tip)));
    if instrument.tips.len() > MAX_TIPS {
        let message = format!("has {} tips, above the limit of {MAX_TIPS}: one for each radius", instrument.tips.len());
        return Err(ClientFailure::Refused(format!("the instrument: {message}")));
    }
    instrument.port = arguments.port_m.map(|place_m| Port { place_m, handle_m });
    let range = format!("above 0 and at most {MAX_JAW_TORQUE_LIMIT_N_M}");
    let limit =
        |torque_n_m| number("--jaw-torque-limit-n-m", torque_n_m, &range, |v| v > 0.0 && v <= MAX_JAW_TORQUE_LIMIT_N_M);
    instrument.jaw_torque_limit_n_m = arguments.jaw_torque_limit_n_m.map(limit).transpose()?;
    Ok(Some(instrument))
}

/// Returns the button that cuts, if there is one.
fn cut_button(arguments: &BridgeArguments, placement: &Placement) -> Result<Option<CutButton>, ClientFailure> {
    let Some(button) = arguments.cut_button else { return Ok(None) };
    let refuse = |why: &str| Err(ClientFailure::Refused(format!("--cut-button: {why}")));
    if arguments.prediction == When::Always {
        return refuse("a copy of the tissue knows no blade: not with --prediction always");
    }
    if placement.clutch_button == Some(button) {
        return refuse("is the button of the clutch: give another --clutch-button, or --no-clutch");
    }
    if button >= u32::BITS {
        return refuse("a device has at most 32 buttons, the first is 0");
    }
    let length_m = number("--blade-m", arguments.blade_m, "above 0 and at most 0.5", |m| m > 0.0 && m <= 0.5)?;
    Ok(Some(CutButton { button, length_m }))
}

/// Opens the real device of a name, or makes a simulated one, whose hand moves by a stream of random numbers.
fn device(arguments: &BridgeArguments, name: &str, stream: u64) -> Result<Box<dyn HapticDevice>, ClientFailure> {
    if DeviceKind::of(name).is_some() {
        return Ok(devices::open(name, arguments.library.as_deref())?);
    }
    let hand = hand_named(&arguments.hand)?;
    let device = device_named(name).map_err(|refusal| {
        let real: Vec<&str> = DeviceKind::ALL.iter().map(|kind| kind.1).collect();
        ClientFailure::Refused(format!("{refusal}; or a real device: {}", real.join(", ")))
    })?;
    let seconds = arguments.seconds.unwrap_or(3600.0);
    let task = Task::new(DVec3::ZERO, LEAD_S, seconds, SCALE, &mut Random::new(arguments.seed, stream));
    Ok(Box::new(Simulated::new(device, hand, task, false)))
}

/// Runs a device and prints the results.
///
/// # Errors
/// Returns an error if an argument is refused, the device is missing or fails, no connection succeeds or none stands at the end, or the course can't be
/// written.
pub(crate) async fn bridge(arguments: &BridgeArguments) -> Result<(), ClientFailure> {
    let placement = arguments.placement.placement()?;
    let target = Target {
        server: arguments.credentials.server(&arguments.server)?,
        session: match &arguments.session {
            Some(id) => SessionChoice::Existing(id.clone()),
            None => SessionChoice::New { scene: arguments.scene.clone() },
        },
        tool: arguments.tool,
        tip: Tip { shape: arguments.tip, radius_m: arguments.radius_m, ..Tip::default() },
        deadband: arguments.deadband,
        up_deadband: arguments.up_deadband,
        datagrams: !arguments.no_datagrams,
        holder: "palpate-client bridge".to_owned(),
    };
    let instrument = instrument(arguments, target.tip)?;
    let cut_button = cut_button(arguments, &placement)?;
    let lasts = arguments.seconds.map(Duration::try_from_secs_f64).transpose();
    let lasts = lasts.map_err(|error| ClientFailure::Refused(format!("--seconds: {error}")))?;
    // Last, so that what is refused is refused before a device moves.
    let first = Placed::new(device(arguments, &arguments.device, 0)?, placement)?;
    let remembers = arguments.course.is_some();
    let options = |hand| {
        // Force and torque on an instrument come from a copy of any tissue.
        let prediction = if instrument.is_some() { When::Always } else { arguments.prediction };
        let (warn, copies) = (Some(Box::new(warn) as Warn), prediction.copies().filter(|_| cut_button.is_none()));
        let (keeps_session, instrument) = (arguments.keep_session, instrument.clone());
        Options { lasts, remembers, keeps_session, warn, copies, hand, instrument, cut_button, ..Options::default() }
    };
    let (served, second) = match &arguments.second_device {
        None => (run(first, target, options(None), interrupted()).await?.1, None),
        Some(name) => {
            #[allow(clippy::cast_possible_truncation)] // At most MAX_TIPS.
            let tips = instrument.as_ref().map_or(1, |instrument| instrument.tips.len() as u32);
            let tool = arguments.second_tool.unwrap_or(arguments.tool.saturating_add(tips));
            let placement = Placement { offset_m: placement.offset_m + arguments.second_offset_m, ..placement };
            let device = Placed::new(device(arguments, name, 1)?, placement)?;
            let ([left, right], beside) = (two_hands(), Target { tool, ..target.clone() });
            let both = tokio::try_join!(
                run(first, target, options(Some(left)), interrupted()),
                run(device, beside, options(Some(right)), interrupted())
            );
            let (one, other) = both?;
            (one.1, Some(other.1))
        }
    };
    if let Some(path) = &arguments.course {
        write_course(path, &served.course)?;
    }
    let session_id = arguments.session.as_deref().or(served.made.as_deref());
    if arguments.json {
        let mut report = as_json(&served, session_id);
        if let Some(second) = &second {
            report["second"] = as_json(second, session_id);
        }
        crate::tell!("{}", printable_json(report));
    } else {
        table::print(&rows(&served));
        if let Some(second) = &second {
            crate::tell!("\nsecond device");
            table::print(&rows(second));
        }
    }
    if let Some(id) = served.made.as_ref().filter(|_| arguments.keep_session) {
        let url = &arguments.server;
        crate::say!("palpate-client: session {id} is kept; the server deletes it when nobody has used it for long");
        crate::say!("palpate-client: touch it again with `palpate-client bridge --server {url} --session {id}`");
        crate::say!("palpate-client: end it with `palpate-client admin delete {id} --server {url}`");
    }
    let lost = served.lost.or(second.and_then(|second| second.lost));
    lost.map_or(Ok(()), |error| Err(error.into()))
}

/// The results for programs.
fn as_json(served: &BridgeReport, session_id: Option<&str>) -> serde_json::Value {
    let traffic = served.traffic;
    let [p50_us, p99_us, max_us] = served.tick_lateness_s.map(|late_s| 1e6 * late_s);
    let mut report = json!({
        "connections": traffic.connections, "samples": traffic.samples, "commands_refused": traffic.refused,
        "failed_attempts": traffic.failed, "poses": traffic.poses, "datagrams_up": traffic.carried.sent,
        "datagrams_down": traffic.carried.came, "fell_back": traffic.carried.fell_back, "late_ticks": served.late_ticks, "missed_ticks": served.missed_ticks,
        "tick_lateness_us": { "p50": p50_us, "p99": p99_us, "max": max_us },
        "predicted_ticks": served.predicted_ticks, "largest_force_n": served.most_force_n, "largest_torque_n_m": served.most_torque_n_m,
        "largest_displacement_m": traffic.deepest_m, "jaw_overloads": traffic.jaw_overloads, "session_id": session_id,
    });
    if let Some(envelope) = &served.envelope {
        report["energy_j"] = json!(envelope.energy_j());
        report["enabled"] = json!(envelope.state() == RenderingState::Enabled);
        let counts =
            LimitCause::ALL.iter().map(|(reason, name)| ((*name).to_owned(), json!(envelope.count(*reason).0)));
        report["interventions_ticks"] = serde_json::Value::Object(counts.collect());
    }
    report
}

/// The results for people.
fn rows(served: &BridgeReport) -> Vec<(&'static str, String)> {
    let Traffic { connections, samples, bytes, refused, jaw_overloads, failed, poses, carried, deepest_m } =
        served.traffic;
    #[allow(clippy::cast_precision_loss)]
    let kilobytes = bytes as f64 / 1e3;
    let [p50_us, p99_us, max_us] = served.tick_lateness_s.map(|late_s| 1e6 * late_s);
    let mut rows = vec![
        ("connections", format!("{connections} (attempts that failed, and breaks: {failed})")),
        ("samples received", format!("{samples}, {} kB", table::rounded(kilobytes))),
        ("poses sent", poses.to_string()),
        (
            "datagrams",
            format!("{} up, {} down; the stream took over {} times", carried.sent, carried.came, carried.fell_back),
        ),
        ("commands refused", refused.to_string()),
        ("late ticks", format!("{} (skipped: {})", served.late_ticks, served.missed_ticks)),
        ("lateness of ticks p50 / p99 / max", format!("{p50_us:.0} / {p99_us:.0} / {max_us:.0} µs")),
        ("largest force", table::with_unit(served.most_force_n, "N")),
        ("tissue moved at most", format!("{:.1} mm", 1e3 * deepest_m)),
        ("from a copy of the tissue", format!("{} ticks", served.predicted_ticks)),
    ];
    if served.most_torque_n_m > 0.0 {
        rows.push(("largest torque", table::with_unit(served.most_torque_n_m, "N·m")));
    }
    if jaw_overloads > 0 {
        rows.push(("jaws above their limit", format!("{jaw_overloads} times")));
    }
    if let Some(envelope) = &served.envelope {
        let is_on = envelope.state() == RenderingState::Enabled;
        rows.push(("energy into the device", table::with_unit(envelope.energy_j(), "J")));
        rows.push(("forces were on at the end", if is_on { "yes" } else { "no" }.to_owned()));
        let counts = LimitCause::ALL.iter().map(|(reason, name)| (*name, envelope.count(*reason).0));
        rows.push(("limits that acted", table::acted(counts)));
    }
    rows
}

fn write_course(path: &std::path::Path, course: &[Tick]) -> Result<(), ClientFailure> {
    let mut text = "time_s,x_m,y_m,z_m,force_x_n,force_y_n,force_z_n,state\n".to_owned();
    for Tick { time_s, place_m, force_n, state } in course {
        let state = state.map_or("waiting".to_owned(), |state| format!("{state:?}").to_lowercase());
        let [place, force] = [place_m, force_n].map(|v| format!("{:.7},{:.7},{:.7}", v.x, v.y, v.z));
        text += &format!("{time_s:.9},{place},{force},{state}\n");
    }
    std::fs::write(path, text).map_err(|error| ClientFailure::Failed(format!("{}: {error}", path.display())))
}
