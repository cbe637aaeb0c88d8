//! `palpate-client bridge`: a haptic device at a server, at 1 kHz.

pub(crate) mod device;
pub(crate) mod line;

use std::sync::Arc;
use std::time::{Duration, Instant};

use glam::DVec3;
use palpate::haptics::{Envelope, Reason, Renderer, State};
use palpate::scene::tip::Tip;
use serde_json::json;
use tokio::sync::mpsc;

use crate::Failure;
use crate::connect::{Credentials, Server};
use crate::link;
use device::{HapticDevice, Simulated};
use line::{COMMANDS, Shared, Target};

/// What `bridge` is asked for.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The server
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:7117")]
    server: String,
    /// A session that is there; otherwise one is made of --scene
    #[arg(long, value_name = "ID")]
    session: Option<String>,
    /// A scene that the server has by that name
    #[arg(long, value_name = "NAME", default_value = "liver")]
    scene: String,
    /// The tool's number
    #[arg(long, default_value_t = 0)]
    tool: u32,
    /// A simulated device: touch, omni, desktop, falcon, omega3, delta3, sigma7, lambda7, inverse3 or undeclared
    #[arg(long, default_value = "omega3")]
    device: String,
    /// A simulated hand that holds it: light, medium, firm or none
    #[arg(long, default_value = "medium")]
    hand: String,
    /// Samples only where the rendered force would be off by this part; 0: one a step
    #[arg(long, value_name = "PART", default_value_t = 0.0)]
    deadband: f64,
    /// Ends after so long, s; default: at Ctrl-C
    #[arg(long, value_name = "S")]
    seconds: Option<f64>,
    /// Of what the simulated hand does
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Write time, place, force and state of each tick to this file, as CSV; at most an hour of them
    #[arg(long, value_name = "FILE")]
    course: Option<std::path::PathBuf>,
    #[command(flatten)]
    credentials: Credentials,
}

/// A tick of the device, s.
pub(crate) const TICK_S: f64 = 1e-3;

/// A device so late has been held up, and what it missed is left out: a burst of ticks would be a backlog.
const HELD_UP: Duration = Duration::from_millis(5);

/// Ticks that are remembered at most.
const MOST_REMEMBERED: usize = 3_600_000;

/// What a device's loop remembers of a tick.
pub(crate) struct Tick {
    /// Since the loop began.
    pub(crate) time_s: f64,
    pub(crate) place_m: DVec3,
    /// Rendered.
    pub(crate) force_n: DVec3,
    /// None before there was a server.
    pub(crate) state: Option<State>,
}

/// What a device's loop has done.
pub(crate) struct Served {
    /// Only as long as it was asked to remember.
    pub(crate) course: Vec<Tick>,
    /// Of the last renderer.
    pub(crate) envelope: Option<Envelope>,
    /// Ticks that began more than a tick late.
    pub(crate) late_ticks: u64,
    /// Ticks that were left out.
    pub(crate) missed_ticks: u64,
    pub(crate) ages_s: Vec<f64>,
}

/// Runs a device against a server for so long. The device's frame is the sheet's. `remember`: keeps its course.
pub(crate) fn serve(
    device: &mut dyn HapticDevice,
    shared: &Shared,
    commands: &mpsc::Sender<line::Command>,
    lasts: Option<Duration>,
    remember: bool,
) -> std::io::Result<Served> {
    let descriptor = device.descriptor();
    let mut renderer: Option<Renderer> = None;
    let mut served = Served { course: Vec::new(), envelope: None, late_ticks: 0, missed_ticks: 0, ages_s: Vec::new() };
    let (start, mut asked) = (Instant::now(), false);
    // A clock that does not begin at 0: 0 means no time.
    let clock_s = |at: Instant| 1.0 + at.duration_since(start).as_secs_f64();
    let mut due = start;
    while lasts.is_none_or(|lasts| due < start + lasts) && !commands.is_closed() {
        wait_until(due);
        let now = Instant::now();
        let late = now.duration_since(due);
        served.late_ticks += u64::from(late.as_secs_f64() > TICK_S);
        if late > HELD_UP {
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
            let missed = (late.as_secs_f64() / TICK_S) as u64;
            served.missed_ticks += missed;
            due = now;
        }
        due += Duration::from_secs_f64(TICK_S);
        let reading = device.read()?;
        let now_s = clock_s(now);
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let now_ns = (now_s * 1e9) as u64;
        let mut force_n = DVec3::ZERO;
        let (law, further, model, middle_m) = {
            let mut inbound = shared.inbound();
            (inbound.law.take(), inbound.further.take(), inbound.newest.take(), inbound.middle_m)
        };
        if let Some(law) = law {
            match &mut renderer {
                // The envelope goes on: what was paused stays paused, what was rendered is let go at its rate.
                Some(renderer) => renderer.begin(law),
                None => renderer = Some(Renderer::new(law, Envelope::new(descriptor, middle_m))),
            }
        }
        if let Some(renderer) = &mut renderer {
            if reading.enable && !asked {
                renderer.envelope.reset();
                renderer.envelope.enable();
            }
            // Before the models that name it.
            if let Some((number, law)) = further {
                renderer.learn(number, law);
            }
            if let Some(model) = model {
                renderer.receive(model, now_s);
            }
            force_n = renderer.tick(now_s, reading.place_m);
            if remember && let Some(time_s) = renderer.model_time_s() {
                served.ages_s.push(now_s - time_s);
            }
        }
        asked = reading.enable;
        device.write(force_n)?;
        if remember && served.course.len() < MOST_REMEMBERED {
            let state = renderer.as_ref().map(Renderer::state);
            served.course.push(Tick { time_s: now_s - 1.0, place_m: reading.place_m, force_n, state });
        }
        // A network that does not keep up gets the next one.
        let _ = commands.try_send((now_ns, reading.place_m));
    }
    let _ = device.write(DVec3::ZERO);
    served.envelope = renderer.map(|renderer| renderer.envelope);
    Ok(served)
}

/// Sleeps, and looks at the clock for the last part.
fn wait_until(due: Instant) {
    const SPIN: Duration = Duration::from_micros(80);
    if let Some(rest) = due.checked_duration_since(Instant::now() + SPIN) {
        std::thread::sleep(rest);
    }
    while Instant::now() < due {
        std::hint::spin_loop();
    }
}

/// Runs a simulated device.
pub(crate) async fn bridge(arguments: &Arguments) -> Result<(), Failure> {
    let refused = |refusal: palpate::refusal::Refusal| Failure::Refused(refusal.to_string());
    let (hand, device) =
        (link::hand_named(&arguments.hand).map_err(refused)?, link::device_named(&arguments.device).map_err(refused)?);
    let scene = link::scene_named(std::path::Path::new(&arguments.scene), &palpate::limits::Limits::default());
    let scene = scene.map_err(refused)?;
    let seconds = arguments.seconds.unwrap_or(3600.0);
    let middle_m = (scene.sheet.extent_m() / 2.0).extend(0.0);
    let task = link::Task::new(middle_m, link::LEAD_S, seconds, 0.2, &mut link::Dice::new(arguments.seed, 0));
    let mut simulated = Simulated::new(device, hand, task, false);
    let target = Target {
        server: Server::new(&arguments.server, &arguments.credentials)?,
        session: arguments.session.clone(),
        made: None,
        scene: arguments.scene.clone(),
        tool: arguments.tool,
        tip: Tip::default(),
        deadband: arguments.deadband,
    };
    let lasts = arguments.seconds.map(Duration::try_from_secs_f64).transpose();
    let lasts = lasts.map_err(|error| Failure::Refused(format!("--seconds: {error}")))?;
    let (served, shared) = run(&mut simulated, target, lasts, arguments.course.is_some()).await?;
    if let Some(path) = &arguments.course {
        write_course(path, &served.course)?;
    }
    let inbound = shared.inbound();
    let mut told = json!({
        "connections": inbound.connections, "samples": inbound.samples, "commands_refused": inbound.refused,
        "late_ticks": served.late_ticks, "missed_ticks": served.missed_ticks,
    });
    if let Some(envelope) = &served.envelope {
        told["energy_j"] = json!(envelope.energy_j());
        told["enabled"] = json!(envelope.state() == State::Enabled);
        let counts = Reason::ALL.iter().map(|(reason, name)| ((*name).to_owned(), json!(envelope.count(*reason).0)));
        told["interventions_ticks"] = serde_json::Value::Object(counts.collect());
    }
    crate::tell!("{told}");
    Ok(())
}

fn write_course(path: &std::path::Path, course: &[Tick]) -> Result<(), Failure> {
    let mut text = "time_s,x_m,y_m,z_m,force_x_n,force_y_n,force_z_n,state\n".to_owned();
    for Tick { time_s, place_m, force_n, state } in course {
        let state = state.map_or("none".to_owned(), |state| format!("{state:?}").to_lowercase());
        let [place, force] = [place_m, force_n].map(|v| format!("{:.7},{:.7},{:.7}", v.x, v.y, v.z));
        text += &format!("{time_s:.9},{place},{force},{state}\n");
    }
    std::fs::write(path, text).map_err(|error| Failure::Failed(format!("{}: {error}", path.display())))
}

/// A device's loop on a thread of its own, and the network beside it; for so long, or until Ctrl-C.
pub(crate) async fn run(
    device: &mut dyn HapticDevice,
    target: Target,
    lasts: Option<Duration>,
    remember: bool,
) -> Result<(Served, Arc<Shared>), Failure> {
    let shared = Arc::new(Shared::default());
    let (commands, received) = mpsc::channel(COMMANDS);
    let descriptor = device.descriptor();
    let network = tokio::spawn({
        let shared = shared.clone();
        async move {
            tokio::select! {
                () = line::keep(target, descriptor, &shared, received) => {}
                // The loop sees that nobody takes its commands any more.
                _ = tokio::signal::ctrl_c() => {}
            }
        }
    });
    let served = std::thread::scope(|scope| {
        let worker = scope.spawn(|| {
            let served = serve(device, &shared, &commands, lasts, remember);
            drop(commands);
            served
        });
        tokio::task::block_in_place(|| worker.join())
    });
    let served = served.map_err(|_| Failure::Failed("the device's loop broke down".to_owned()))?;
    // It waits for what a server may never say.
    network.abort();
    let _ = network.await;
    let served = served.map_err(|error| Failure::Failed(format!("the device: {error}")))?;
    let never = {
        let inbound = shared.inbound();
        (inbound.connections == 0)
            .then(|| inbound.failure.clone().unwrap_or("the server said nothing in time".to_owned()))
    };
    match never {
        Some(why) => Err(Failure::Failed(format!("never connected: {why}"))),
        None => Ok((served, shared)),
    }
}
