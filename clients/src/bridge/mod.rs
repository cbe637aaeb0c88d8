//! `palpate-client bridge`: connects a haptic device to a server at 1 kHz.

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

/// Arguments of `bridge`.
#[derive(clap::Args)]
pub(crate) struct Arguments {
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
    /// The simulated device: touch, omni, desktop, falcon, omega3, delta3, sigma7, lambda7, inverse3 or undeclared
    #[arg(long, default_value = "omega3")]
    device: String,
    /// The simulated hand that holds the device: light, medium, firm or none
    #[arg(long, default_value = "medium")]
    hand: String,
    /// Receive a sample only when the rendered force would be off by more than this fraction; 0: one per step
    #[arg(long, value_name = "PART", default_value_t = 0.0)]
    deadband: f64,
    /// End after this time, s [default: at Ctrl-C]
    #[arg(long, value_name = "S")]
    seconds: Option<f64>,
    /// Seed of the simulated hand's movements
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Write time, place, force and state of each tick to this file (CSV); at most an hour
    #[arg(long, value_name = "FILE")]
    course: Option<std::path::PathBuf>,
    #[command(flatten)]
    credentials: Credentials,
}

/// Period of the device's loop, s.
pub(crate) const TICK_S: f64 = 1e-3;

/// After a longer delay the loop skips the missed ticks: catching up would cause a burst.
const MOST_LATE: Duration = Duration::from_millis(5);

/// Largest number of ticks that are remembered.
const MOST_REMEMBERED: usize = 3_600_000;

/// One tick of a device's loop.
pub(crate) struct Tick {
    /// Time since the loop began, s.
    pub(crate) time_s: f64,
    pub(crate) place_m: DVec3,
    /// The rendered force, N.
    pub(crate) force_n: DVec3,
    /// `None` before the first connection.
    pub(crate) state: Option<State>,
}

/// The results of a device's loop.
pub(crate) struct Served {
    /// The remembered ticks; empty unless the loop was to remember them.
    pub(crate) course: Vec<Tick>,
    /// The renderer's envelope; `None` without a connection.
    pub(crate) envelope: Option<Envelope>,
    /// Number of ticks that began more than a tick late.
    pub(crate) late_ticks: u64,
    /// Number of ticks that were skipped.
    pub(crate) missed_ticks: u64,
    /// Age of the local model at each tick, s; empty unless the loop was to remember.
    pub(crate) ages_s: Vec<f64>,
}

/// Runs the loop of a device for a time, or until `commands` is closed, and then sets its force to zero, also after an error.
/// The device's frame is the sheet's. `remember`: keeps the course and the models' ages.
///
/// # Errors
/// Returns the device's error if it can't be read or written.
pub(crate) fn serve(
    device: &mut dyn HapticDevice,
    shared: &Shared,
    commands: &mpsc::Sender<line::Command>,
    lasts: Option<Duration>,
    remember: bool,
) -> std::io::Result<Served> {
    let ended = tick(device, shared, commands, lasts, remember);
    // A device holds its last force until it is told another.
    let _ = device.write(DVec3::ZERO);
    ended
}

fn tick(
    device: &mut dyn HapticDevice,
    shared: &Shared,
    commands: &mpsc::Sender<line::Command>,
    lasts: Option<Duration>,
    remember: bool,
) -> std::io::Result<Served> {
    let descriptor = device.descriptor();
    let mut renderer: Option<Renderer> = None;
    let mut served = Served { course: Vec::new(), envelope: None, late_ticks: 0, missed_ticks: 0, ages_s: Vec::new() };
    let (start, mut was_asked) = (Instant::now(), false);
    // The clock begins at 1 s, because 0 means "no time" in the protocol.
    let clock_s = |at: Instant| 1.0 + at.duration_since(start).as_secs_f64();
    let mut due = start;
    while lasts.is_none_or(|lasts| due < start + lasts) && !commands.is_closed() {
        wait_until(due);
        let now = Instant::now();
        let late = now.duration_since(due);
        served.late_ticks += u64::from(late.as_secs_f64() > TICK_S);
        if late > MOST_LATE {
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
            (inbound.law.take(), std::mem::take(&mut inbound.further), inbound.newest.take(), inbound.middle_m)
        };
        if let Some(law) = law {
            match &mut renderer {
                // The envelope stays: what was paused stays paused, and a rendered force falls at the slew limit.
                Some(renderer) => renderer.begin(law),
                None => renderer = Some(Renderer::new(law, Envelope::new(descriptor, middle_m))),
            }
        }
        if let Some(renderer) = &mut renderer {
            if reading.enable && !was_asked {
                renderer.envelope.reset();
                renderer.envelope.enable();
            }
            // Before the models that name them.
            for (number, law) in further {
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
        was_asked = reading.enable;
        device.write(force_n)?;
        if remember && served.course.len() < MOST_REMEMBERED {
            let state = renderer.as_ref().map(Renderer::state);
            served.course.push(Tick { time_s: now_s - 1.0, place_m: reading.place_m, force_n, state });
        }
        // If the network does not keep up, this position is dropped; the next one replaces it.
        let _ = commands.try_send((now_ns, reading.place_m));
    }
    served.envelope = renderer.map(|renderer| renderer.envelope);
    Ok(served)
}

/// Sleeps until shortly before `due`, then polls the clock.
fn wait_until(due: Instant) {
    const SPIN: Duration = Duration::from_micros(80);
    if let Some(rest) = due.checked_duration_since(Instant::now() + SPIN) {
        std::thread::sleep(rest);
    }
    while Instant::now() < due {
        std::hint::spin_loop();
    }
}

/// Runs a simulated device and prints the results.
///
/// # Errors
/// Returns an error if an argument is refused, no connection succeeds, or the course can't be written.
pub(crate) async fn bridge(arguments: &Arguments) -> Result<(), Failure> {
    let refused = |refusal: palpate::refusal::Refusal| Failure::Refused(refusal.to_string());
    let (hand, device) =
        (link::hand_named(&arguments.hand).map_err(refused)?, link::device_named(&arguments.device).map_err(refused)?);
    let scene = link::scene_named(std::path::Path::new(&arguments.scene), &palpate::limits::Limits::default());
    let scene = scene.map_err(refused)?;
    let seconds = arguments.seconds.unwrap_or(3600.0);
    let middle_m = (scene.sheet.extent_m() / 2.0).extend(0.0);
    let task = link::Task::new(middle_m, link::LEAD_S, seconds, 0.2, &mut link::Random::new(arguments.seed, 0));
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
    let mut report = json!({
        "connections": inbound.connections, "samples": inbound.samples, "commands_refused": inbound.refused,
        "late_ticks": served.late_ticks, "missed_ticks": served.missed_ticks,
    });
    if let Some(envelope) = &served.envelope {
        report["energy_j"] = json!(envelope.energy_j());
        report["enabled"] = json!(envelope.state() == State::Enabled);
        let counts = Reason::ALL.iter().map(|(reason, name)| ((*name).to_owned(), json!(envelope.count(*reason).0)));
        report["interventions_ticks"] = serde_json::Value::Object(counts.collect());
    }
    crate::tell!("{report}");
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

/// Runs a device's loop on its own thread, and the network on the runtime; for a time, or until Ctrl-C.
///
/// # Errors
/// Returns an error if the device fails, or if no connection succeeds.
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
                // The loop notices that its channel of commands is closed.
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
    let served = served.map_err(|_| Failure::Failed("internal error (the device's loop panicked)".to_owned()))?;
    // The task may wait for an answer that never arrives.
    network.abort();
    let _ = network.await;
    let served = served.map_err(|error| Failure::Failed(format!("the device: {error}")))?;
    let never = {
        let inbound = shared.inbound();
        (inbound.connections == 0)
            .then(|| inbound.failure.clone().unwrap_or("the server did not answer in time".to_owned()))
    };
    match never {
        Some(why) => Err(Failure::Failed(format!("never connected: {why}"))),
        None => Ok((served, shared)),
    }
}

#[cfg(test)]
mod tests {
    use palpate::haptics::Law;
    use palpate::haptics::device::UNDECLARED;

    use super::*;

    /// Fails to be read at its 20th tick; remembers what it was last told.
    struct Failing {
        ticks: u32,
        force_n: DVec3,
    }

    impl HapticDevice for Failing {
        fn descriptor(&self) -> palpate::haptics::Device {
            UNDECLARED
        }

        fn read(&mut self) -> std::io::Result<device::Reading> {
            self.ticks += 1;
            if self.ticks == 20 {
                // As if a force were held.
                self.force_n = DVec3::Z;
                return Err(std::io::ErrorKind::BrokenPipe.into());
            }
            Ok(device::Reading { place_m: DVec3::ZERO, enable: true })
        }

        fn write(&mut self, force_n: DVec3) -> std::io::Result<()> {
            self.force_n = force_n;
            Ok(())
        }
    }

    #[test]
    fn a_device_that_fails_is_left_without_a_force() {
        let (commands, _received) = mpsc::channel(64);
        let shared = Shared::default();
        shared.inbound().law = Some(Law::linear(400.0, 0.5));
        let mut device = Failing { ticks: 0, force_n: DVec3::X };
        let ended = serve(&mut device, &shared, &commands, None, false);
        assert!(ended.is_err());
        assert_eq!((device.ticks, device.force_n), (20, DVec3::ZERO));
    }
}
