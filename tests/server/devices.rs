//! Devices of makers, imitated: a whole bridge between each of them and a real server, its forces and units, and what
//! happens when something is wrong. No device was touched for this; docs/devices.md says so.
#![cfg(target_os = "linux")]
#![allow(clippy::type_complexity)]

use std::fs::OpenOptions;
use std::future::pending;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use crate::common::inverse_service::{InverseService, Wrong, turn};
use crate::common::server::{TEST_TIMEOUT, TestServer, client_program, repository, until_blocking};
use glam::{DQuat, DVec3};
use palpate_client::bridge::{BridgeReport, Copies, Options, SessionChoice, Target, run};
use palpate_client::devices::{Enables, Placed, Placement, open};
use palpate_client::{Credentials, Error, HapticDevice, Reading};
use palpate_haptics::device::SAFE_FORCE_N;
use palpate_haptics::{Device, Instrument, RenderingState, Tip, Wrench};

/// The middle of the scene `liver`.
const MIDDLE_M: DVec3 = DVec3::new(0.0375, 0.0375, 0.0);

/// A library that imitates a maker's, in a folder of its own, and what it was asked.
struct Imitation {
    _folder: tempfile::TempDir,
    library: PathBuf,
    log: Log,
}

impl Imitation {
    /// Compiles it; `wrong` are the things that go wrong.
    fn build(name: &str, wrong: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let library = folder.path().join(format!("lib{name}.so"));
        let source = repository().join(format!("tests/imitations/{name}.c"));
        let mut compile = Command::new("cc");
        compile.args(["-shared", "-fPIC", "-O1", "-o"]).arg(&library).arg(source);
        let log = Log(folder.path().join("log"));
        compile.arg(format!("-DLOG=\"{}\"", log.0.display()));
        compile.args(wrong.iter().map(|what| format!("-D{what}"))).args(["-lm", "-lpthread"]);
        let compiled = compile.output().expect("a C compiler, which Rust needs to link");
        assert!(compiled.status.success(), "{}", String::from_utf8_lossy(&compiled.stderr));
        Imitation { _folder: folder, library, log }
    }
}

/// Requests to an imitation.
#[derive(Clone)]
struct Log(PathBuf);

impl Log {
    /// By the first word of the lines.
    fn asked(&self, word: &str) -> Vec<String> {
        let log = std::fs::read_to_string(&self.0).unwrap_or_default();
        // The last line may be half written.
        let whole = log.rfind('\n').map_or("", |end| &log[..end]);
        let rest = whole.lines().filter_map(|line| line.strip_prefix(word)).map(|rest| rest.trim().to_owned());
        rest.collect()
    }

    fn vectors(&self, word: &str) -> Vec<DVec3> {
        let vector = |text: &String| {
            let numbers: Vec<f64> = text.split_whitespace().map(|number| number.parse().unwrap()).collect();
            DVec3::from_slice(&numbers)
        };
        self.asked(word).iter().map(vector).collect()
    }
}

fn target(server: &TestServer) -> Target {
    Target {
        server: palpate_client::Server::new(&server.url, &Credentials::default()).unwrap(),
        session: SessionChoice::New { scene: "liver".to_owned() },
        tool: 0,
        tip: Tip::default(),
        deadband: 0.0,
        up_deadband: 0.0,
        datagrams: true,
        holder: "test".to_owned(),
    }
}

/// Runs the bridge of the library until the device has felt a press for some ticks.
async fn touch(
    device: impl HapticDevice + 'static,
    server: &TestServer,
    felt: impl Fn() -> bool + Send + 'static,
) -> BridgeReport {
    let options = Options { remembers: true, ..Options::default() };
    let stop = async move {
        while !felt() {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    let serving = run(device, target(server), options, stop);
    let (device, report) = tokio::time::timeout(TEST_TIMEOUT, serving).await.expect("no force").unwrap();
    drop(device);
    report
}

/// A device that records its last place and the forces that it was given.
struct Noting<D> {
    device: D,
    noted: Arc<Mutex<(DVec3, Vec<DVec3>)>>,
}

/// A device of six axes that records the wrenches that it was given.
struct NotingWrenches<D> {
    device: D,
    noted: Arc<Mutex<Vec<Wrench>>>,
}

impl<D: HapticDevice> HapticDevice for NotingWrenches<D> {
    fn descriptor(&self) -> Device {
        self.device.descriptor()
    }

    fn read(&mut self) -> std::io::Result<Reading> {
        self.device.read()
    }

    fn write(&mut self, _: DVec3) -> std::io::Result<()> {
        panic!("an instrument has a wrench");
    }

    fn orientation(&self) -> DQuat {
        self.device.orientation()
    }

    fn jaw_rad(&self) -> f64 {
        self.device.jaw_rad()
    }

    fn write_wrench(&mut self, wrench: Wrench) -> std::io::Result<()> {
        self.noted.lock().unwrap().push(wrench);
        self.device.write_wrench(wrench)
    }
}

/// Leads a shaft of 16 mm on `liver` by a device until it has felt what `is_felt` asks for during some ticks, or has failed. Returns
/// what the loop asked of it, with the results.
async fn lead(
    device: Box<dyn HapticDevice>,
    server: &TestServer,
    is_felt: fn(&Wrench) -> bool,
) -> (Vec<Wrench>, Result<BridgeReport, Error>) {
    let tip = Tip { radius_m: 0.004, ..Tip::default() };
    let mut instrument = Instrument::default();
    instrument.add_parts(None, Some((0.016, tip)));
    let copies = Some(Copies { make: Arc::new(palpate_session::journal::prediction), of_grids: true });
    let noted = Arc::new(Mutex::new(Vec::new()));
    let device = NotingWrenches { device, noted: noted.clone() };
    let options = Options { remembers: true, copies, instrument: Some(instrument), ..Options::default() };
    let felt = noted.clone();
    let stop = async move {
        while felt.lock().unwrap().iter().filter(|wrench| is_felt(wrench)).count() <= 50 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    let serving = run(device, target(server), options, stop);
    let ended = tokio::time::timeout(TEST_TIMEOUT, serving).await.expect("nothing felt");
    let noted = noted.lock().unwrap().clone();
    (noted, ended.map(|(_, report)| report))
}

/// Leads the shaft as [`lead`] does, by a device that does not fail.
async fn lead_shaft(
    device: Box<dyn HapticDevice>,
    server: &TestServer,
    is_felt: fn(&Wrench) -> bool,
) -> (Vec<Wrench>, BridgeReport) {
    let (asked, report) = lead(device, server, is_felt).await;
    let report = report.unwrap();
    assert_eq!(report.traffic.refused, 0);
    assert!(report.predicted_ticks > 0);
    (asked, report)
}

/// A torque of 0.1 mN·m.
fn is_torque(wrench: &Wrench) -> bool {
    wrench.torque_n_m.length() > 1e-4
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_device_of_six_axes_gets_force_and_torque_in_its_own_axes() {
    let server = TestServer::start(&[]);
    let imitation = Imitation::build("dhd", &["SIX_AXES"]);
    let mut device = open("force-dimension", Some(&imitation.library)).unwrap();
    let limits = device.descriptor();
    assert_eq!((limits.name, limits.torque_n_m), ("sigma7", 0.4));
    device.read().unwrap();
    // The base's x is towards the operator and its y to the right. A quarter turn has the handle, which points away along the base's
    // −x, point along its −y, to the left.
    assert!((device.orientation() * DVec3::X).distance(DVec3::NEG_X) < 1e-12);
    assert!((device.orientation() * DVec3::Z).distance(DVec3::Z) < 1e-12 && device.jaw_rad() == 0.4);
    let (asked, _) = lead_shaft(device, &server, is_torque).await;
    let (forces, torques) = (imitation.log.vectors("force"), imitation.log.vectors("torque"));
    let to_base = |v: DVec3| DVec3::new(-v.y, v.x, v.z);
    // One without torque at the opening, and one of zeros when it is closed.
    assert_eq!((forces.len(), torques.len()), (asked.len() + 2, asked.len() + 1));
    for (index, wrench) in asked.iter().enumerate() {
        assert!(near(forces[index + 1], to_base(wrench.force_n)), "{index}");
        assert!(near(torques[index], to_base(wrench.torque_n_m)), "{index}");
        assert!(wrench.torque_n_m.length() <= limits.most_n_m() + 1e-12);
    }
    // The shaft lies to the right of the tip, so what presses it up turns it about the axis away from the operator, to the left.
    let most = asked.iter().max_by(|a, b| a.torque_n_m.length().total_cmp(&b.torque_n_m.length())).unwrap();
    assert!(most.force_n.z > 0.0 && most.torque_n_m.y < -1e-4, "{most:?}");
    assert!(most.torque_n_m.y.abs() > 5.0 * most.torque_n_m.z.abs(), "{most:?}");
    assert_eq!((asked.last(), torques.last()), (Some(&Wrench::default()), Some(&DVec3::ZERO)));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_phantom_gets_torque_in_millinewton_metres_and_none_when_the_loop_stands_still() {
    let server = TestServer::start(&[]);
    let imitation = Imitation::build("hd", &["SIX_AXES"]);
    let mut device = open("openhaptics", Some(&imitation.library)).unwrap();
    assert!((device.descriptor().torque_n_m - 0.17).abs() < 1e-15);
    device.read().unwrap();
    // The stylus points to the left: its −z after a quarter turn about y.
    assert!((device.orientation() * DVec3::X).distance(DVec3::NEG_X) < 1e-12, "{}", device.orientation());
    let (asked, _) = lead_shaft(device, &server, is_torque).await;
    let torques = imitation.log.vectors("torque");
    let to_library = |v: DVec3| 1e3 * DVec3::new(v.x, v.z, -v.y);
    assert!(torques.iter().filter(|torque| torque.length() > 0.1).count() > 10);
    for torque in &torques {
        let is_asked = asked.iter().any(|wrench| near(to_library(wrench.torque_n_m), *torque));
        assert!(*torque == DVec3::ZERO || is_asked, "{torque}");
    }
    assert_eq!(torques.last(), Some(&DVec3::ZERO));
    let imitation = Imitation::build("hd", &["SIX_AXES"]);
    let mut device = open("openhaptics", Some(&imitation.library)).unwrap();
    device.write_wrench(Wrench { force_n: DVec3::ZERO, torque_n_m: DVec3::new(0.01, 0.02, 0.03) }).unwrap();
    let set = DVec3::new(10.0, 30.0, -20.0);
    until_blocking("the torque ends", || {
        let torques = imitation.log.vectors("torque");
        torques.last() == Some(&DVec3::ZERO) && torques.iter().any(|torque| near(*torque, set))
    });
}

impl<D: HapticDevice> HapticDevice for Noting<D> {
    fn descriptor(&self) -> Device {
        self.device.descriptor()
    }

    fn read(&mut self) -> std::io::Result<Reading> {
        let reading = self.device.read()?;
        self.noted.lock().unwrap().0 = reading.place_m;
        Ok(reading)
    }

    fn write(&mut self, force_n: DVec3) -> std::io::Result<()> {
        self.noted.lock().unwrap().1.push(force_n);
        self.device.write(force_n)
    }
}

/// Returns whether a force was above a twentieth of a newton often enough.
fn is_felt(forces: &[DVec3]) -> bool {
    forces.iter().filter(|force_n| force_n.length() > 0.05).count() > 50
}

/// Waits until something is so.
fn near(a: DVec3, b: DVec3) -> bool {
    (a - b).length() < 1e-12
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_force_dimension_device_gets_each_force_of_the_bridge_in_its_own_axes() {
    let server = TestServer::start(&[]);
    // Returns of 1 and 2 are no errors.
    for wrong in [&[][..], &["SATURATED"]] {
        let imitation = Imitation::build("dhd", wrong);
        let placement = Placement {
            offset_m: DVec3::new(0.001, 0.0, 0.0),
            rotation_deg: DVec3::new(0.0, 0.0, 90.0),
            scale: 0.5,
            force_scale: 0.8,
            ..Placement::default()
        };
        let device = open("force-dimension", Some(&imitation.library)).unwrap();
        assert_eq!((device.descriptor().name, device.descriptor().force_n), ("omega3", 9.0));
        let device = Placed::new(device, placement).unwrap();
        let log = imitation.log.clone();
        let felt = move || log.vectors("force").iter().filter(|force_n| force_n.z > 0.05).count() > 50;
        let report = touch(device, &server, felt).await;
        let (forces, places) = (imitation.log.vectors("force"), imitation.log.vectors("place"));
        assert!(is_felt(&forces) && report.traffic.connections == 1);
        // It opens with no force, gets one a tick, and is left with none: by the loop, and by closing.
        assert_eq!(forces[0], DVec3::ZERO);
        assert_eq!((forces.len(), places.len()), (report.course.len() + 3, report.course.len()));
        assert_eq!(forces[forces.len() - 2..], [DVec3::ZERO; 2]);
        let mut touched = 0;
        for (index, tick) in report.course.iter().enumerate() {
            // x of the SDK is towards the operator, y to the right. Then a quarter turn: our x becomes the tissue's y.
            let (asked, place) = (forces[index + 1], places[index]);
            let ours = 0.8 * DVec3::new(tick.force_n.y, -tick.force_n.x, tick.force_n.z);
            assert!(near(asked, DVec3::new(-ours.y, ours.x, ours.z)), "tick {index}: {asked} for {}", tick.force_n);
            let device_m = DVec3::new(place.y, -place.x, place.z);
            let laid_m = DVec3::new(0.001, 0.0, 0.0) + 0.5 * DVec3::new(-device_m.y, device_m.x, device_m.z);
            if tick.state.is_some() {
                assert!(near(tick.place_m, MIDDLE_M + laid_m), "tick {index}: {} for {place}", tick.place_m);
                touched += 1;
            }
            assert!(asked.length() <= 0.8 * SAFE_FORCE_N);
        }
        assert!(touched > 100);
        assert_eq!(imitation.log.asked("most"), ["3.2999999999999998"]);
        assert_eq!(imitation.log.asked("enable"), ["1", "0"]);
        assert_eq!(imitation.log.asked("close"), [""]);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_touch_gets_millimetres_right_and_its_own_limits() {
    let server = TestServer::start(&[]);
    for wrong in [&[][..], &["SATURATED"]] {
        let imitation = Imitation::build("hd", wrong);
        let device = open("openhaptics:Left Device", Some(&imitation.library)).unwrap();
        let limits = device.descriptor();
        assert_eq!((limits.name, limits.force_n, limits.continuous_n), ("touch", 2.9, 0.8));
        assert_eq!((limits.stiffness_n_per_m, limits.damping_n_s_per_m), (500.0, 3.0));
        let log = imitation.log.clone();
        let felt = move || log.vectors("force").iter().filter(|force_n| force_n.y > 0.05).count() > 50;
        let report = touch(device, &server, felt).await;
        let forces = imitation.log.vectors("force");
        assert!(is_felt(&forces) && report.traffic.connections == 1);
        // Frames are the library's, at its own rate: each sets a force of ours, or none.
        let ours: Vec<DVec3> = report.course.iter().map(|tick| tick.force_n).collect();
        for asked in &forces {
            let back = DVec3::new(asked.x, -asked.z, asked.y);
            assert!(*asked == DVec3::ZERO || ours.contains(&back), "{asked} was not asked for");
            assert!(asked.length() <= limits.force_n);
        }
        assert_eq!(forces.last(), Some(&DVec3::ZERO));
        for tick in report.course.iter().filter(|tick| tick.state.is_some()) {
            let along = DVec3::new(tick.place_m.x, tick.place_m.y, 0.0);
            assert!(near(along, MIDDLE_M + DVec3::new(0.006, -0.004, 0.0)), "{}", tick.place_m);
            assert!((-0.0051..=0.0031).contains(&tick.place_m.z), "{}", tick.place_m);
        }
        assert_eq!(imitation.log.asked("open"), ["Left Device"]);
        assert_eq!(imitation.log.asked("start"), ["enabled 1"]);
        // Stopped, unscheduled, closed; and 101 is the handle that scheduling gave.
        assert_eq!((imitation.log.asked("stop").len(), imitation.log.asked("close").len()), (1, 1));
        assert_eq!(imitation.log.asked("unschedule"), ["101"]);
    }
}

#[test]
fn a_loop_of_ours_that_stands_still_leaves_a_touch_without_a_force() {
    let imitation = Imitation::build("hd", &[]);
    let mut device = open("openhaptics", Some(&imitation.library)).unwrap();
    device.read().unwrap();
    device.write(DVec3::new(0.1, 0.2, 0.3)).unwrap();
    // To the right, up, towards the operator.
    let set = DVec3::new(0.1, 0.3, -0.2);
    until_blocking("the force ends", || {
        imitation.log.vectors("force").last() == Some(&DVec3::ZERO) && imitation.log.vectors("force").contains(&set)
    });
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_inverse3_is_spoken_to_in_the_words_of_its_services_version() {
    let server = TestServer::start(&[]);
    for (version, field) in [(Some("3.5.2"), "vector"), (Some("3.1.1"), "values"), (None, "vector")] {
        let service = InverseService::start(version, Wrong::Nothing);
        let device = open(&format!("haply:{}", service.url), None).unwrap();
        assert_eq!(device.descriptor().name, "inverse3");
        let heard = service.heard();
        let report = touch(device, &server, move || is_felt(&heard.forces_n())).await;
        assert_eq!(report.traffic.connections, 1);
        let heard = service.heard();
        until_blocking("the force ends", || heard.forces_n().last() == Some(&DVec3::ZERO));
        assert_eq!(heard.fields(), [field]);
        // A client of version 3.5 identifies itself once.
        assert_eq!(heard.profiles(), if field == "vector" { vec!["palpate".to_owned()] } else { vec![] });
        let (ours, forces) = (report.course, heard.forces_n());
        for asked in &forces {
            assert!(*asked == DVec3::ZERO || ours.iter().any(|tick| near(tick.force_n, *asked)), "{asked}");
        }
        // The middle of its workspace is on the middle of the sheet.
        let touching = ours.iter().rfind(|tick| tick.state.is_some()).unwrap();
        let along = DVec3::new(touching.place_m.x, touching.place_m.y, 0.0);
        assert!((along - MIDDLE_M - DVec3::new(0.003, 0.002, 0.0)).length() < 1e-9, "{touching:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_instrument_led_by_an_inverse3_turns_with_its_grip() {
    let server = TestServer::start(&[]);
    let service = InverseService::start(Some("3.5.0"), Wrong::Nothing);
    let mut device = open(&format!("haply:{}", service.url), None).unwrap();
    let mut seen: Vec<DQuat> = Vec::new();
    while seen.last().is_none_or(|last| last.angle_between(seen[0]) < 0.01) {
        assert!(seen.len() < 5000, "it does not turn");
        device.read().unwrap();
        device.write(DVec3::ZERO).unwrap();
        seen.push(device.orientation());
        std::thread::sleep(Duration::from_millis(1));
    }
    for turned in seen {
        // Not turned, it would point away from the operator.
        let points = turned * DVec3::X;
        let is_told = (0..3000).any(|tick| (turn(tick) * DVec3::Y).distance(points) < 1e-12);
        assert!(is_told && (turned * DVec3::Z).distance(DVec3::Z) < 1e-12, "{turned}");
    }
    drop(device);
    let is_pressed = |wrench: &Wrench| wrench.force_n.z > 0.05;
    for wrong in [Wrong::Nothing, Wrong::Unturned] {
        let service = InverseService::start(Some("3.5.0"), wrong);
        let device = open(&format!("haply:{}", service.url), None).unwrap();
        let asked = if wrong == Wrong::Nothing {
            let (asked, report) = lead_shaft(device, &server, is_pressed).await;
            assert!(report.most_torque_n_m == 0.0, "it has no motors for that");
            asked
        } else {
            let (asked, ended) = lead(device, &server, |_| false).await;
            let said = ended.unwrap_err().to_string();
            assert!(said.contains("no valid orientation of the grip"), "{said}");
            asked
        };
        assert!(asked.iter().any(is_pressed));
        let heard = service.heard();
        until_blocking("the force ends", || heard.forces_n().last() == Some(&DVec3::ZERO));
        for force_n in heard.forces_n() {
            assert!(force_n == DVec3::ZERO || asked.iter().any(|asked| near(asked.force_n, force_n)), "{force_n}");
        }
        is_bounded(&heard.forces_n());
    }
}

/// `struct input_event`, as the kernel writes it.
fn event(kind: u16, code: u16, value: i32) -> Vec<u8> {
    let mut event = vec![0; 2 * size_of::<usize>()];
    event.extend(kind.to_ne_bytes());
    event.extend(code.to_ne_bytes());
    event.extend(value.to_ne_bytes());
    event
}

const KEY: u16 = 1;
const REL: u16 = 2;
const ABS: u16 = 3;

fn pipe(folder: &Path) -> PathBuf {
    let path = folder.join("events");
    assert!(Command::new("mkfifo").arg(&path).status().unwrap().success());
    path
}

/// Writes events into a pipe for as long as they are wanted: a press of the button every now and then, and down or
/// up. `last` is what it says at the end.
fn play(
    path: &Path,
    kind: u16,
    over: std::sync::mpsc::Receiver<()>,
    last: &'static [u8],
    goes_down: impl Fn(u32) -> bool + Send + 'static,
) -> std::thread::JoinHandle<()> {
    let path = path.to_owned();
    std::thread::spawn(move || {
        // Waits for who reads.
        let mut events = OpenOptions::new().write(true).open(path).unwrap();
        let (button, axis, far) = if kind == REL { (0x100, 2, 350) } else { (0x130, 4, 32767) };
        for moment in 0.. {
            let mut said = event(kind, axis, if goes_down(moment) { far } else { -far });
            said.extend(event(KEY, button, i32::from(moment % 20 < 10)));
            said.extend(event(0, 0, 0));
            let is_over =
                over.recv_timeout(Duration::from_millis(20)) != Err(std::sync::mpsc::RecvTimeoutError::Timeout);
            if is_over {
                let _ = events.write_all(last);
                return;
            }
            if events.write_all(&said).is_err() {
                return;
            }
        }
    })
}

/// Goes down to 4 mm in the tissue, and up to 4 mm above it, by where the device is.
fn down_and_up(z_m: impl Fn() -> f64 + Send + 'static) -> impl Fn(u32) -> bool + Send + 'static {
    let was_down = AtomicBool::new(true);
    move |_| {
        let z_m = z_m();
        let is_down = if z_m > 0.004 { true } else { z_m > -0.004 && was_down.load(Ordering::Relaxed) };
        was_down.store(is_down, Ordering::Relaxed);
        is_down
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn recorded_events_of_a_knob_and_of_a_stick_touch_the_tissue() {
    let server = TestServer::start(&[]);
    for (name, kind) in [("spacemouse", REL), ("gamepad", ABS)] {
        let folder = tempfile::tempdir().unwrap();
        let path = pipe(folder.path());
        let device = open(&format!("{name}:{}", path.display()), None).unwrap();
        let noted = Arc::new(Mutex::new((DVec3::ZERO, Vec::new())));
        let (seen, felt) = (noted.clone(), noted.clone());
        let (stop, over) = std::sync::mpsc::channel();
        let playing = play(&path, kind, over, &[], down_and_up(move || seen.lock().unwrap().0.z));
        let report = touch(Noting { device, noted }, &server, move || is_felt(&felt.lock().unwrap().1)).await;
        drop(stop);
        playing.join().unwrap();
        let forces: Vec<DVec3> = report.course.iter().map(|tick| tick.force_n).collect();
        assert!(is_felt(&forces), "{name}: the tissue was not felt");
        assert!(forces.iter().all(|force_n| force_n.length() <= 2.0));
        // It never leaves its ball, and moves by rate.
        for pair in report.course.windows(2).filter(|pair| pair[0].state.is_some()) {
            let moved_m = (pair[1].place_m - pair[0].place_m).length();
            assert!(moved_m <= 0.05 * 0.0201, "{name}: {moved_m} m in a tick");
            assert!((pair[1].place_m - MIDDLE_M).length() <= 0.075, "{name}: {}", pair[1].place_m);
        }
    }
}

fn client(arguments: &[&str]) -> Output {
    let mut program = Command::new(client_program());
    program.args(arguments).stdin(Stdio::null()).output().unwrap()
}

/// Faults of a device, the bridge's exit status, and its message.
struct DeviceFaultCase {
    device: String,
    library: Option<PathBuf>,
    status: i32,
    says: &'static [&'static str],
}

/// Runs `palpate-client bridge`, which must end by itself as the case says.
fn ends(server: &TestServer, case: &DeviceFaultCase) {
    let library = case.library.as_ref().map(|library| library.display().to_string());
    // It ends earlier, if it ends as it should.
    let mut arguments = vec!["bridge", "--server", &server.url, "--device", &case.device, "--seconds", "300"];
    arguments.extend(library.iter().flat_map(|library| ["--library", library]));
    let output = client(&arguments);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(case.status), "{}: {said}", case.device);
    for part in case.says {
        assert!(said.contains(part), "{}: `{part}` is not in: {said}", case.device);
    }
}

/// Everything that was set lies within the envelope.
fn is_bounded(forces: &[DVec3]) {
    assert!(forces.iter().all(|force_n| force_n.length() <= SAFE_FORCE_N), "a force beyond the envelope");
}

/// The same, and the last is no force.
fn is_safe(forces: &[DVec3]) {
    is_bounded(forces);
    assert!(forces.last().is_none_or(|force_n| *force_n == DVec3::ZERO), "{:?} is left", forces.last());
}

#[test]
fn what_goes_wrong_with_a_loaded_library_ends_the_bridge_without_a_force() {
    let server = TestServer::start(&[]);
    // Device, what is wrong, exit status, whether it was touched, what is said.
    type Row = (&'static str, &'static [&'static str], i32, bool, &'static [&'static str]);
    let table: [Row; 11] = [
        ("force-dimension", &["MISSING"], 1, false, &["has no function dhdSetForce", "another version"]),
        ("force-dimension", &["VERSION=2"], 1, false, &["SDK 2.17.0", "Palpate knows SDK 3"]),
        ("force-dimension", &["NO_DEVICE"], 1, false, &["no Force Dimension device", "no device found", "plugged in"]),
        ("force-dimension:4", &[], 1, false, &["no Force Dimension device", "invalid index"]),
        ("force-dimension:1", &["UNPLUGGED"], 1, true, &["omega.3", "communication error"]),
        ("openhaptics", &["MISSING"], 1, false, &["has no function hdBeginFrame"]),
        ("openhaptics", &["OLD"], 1, false, &["OpenHaptics 2.0.66", "Palpate knows OpenHaptics 3"]),
        ("openhaptics", &["NO_DEVICE"], 1, false, &["no device of OpenHaptics", "communication error (0x0302)"]),
        ("openhaptics", &["INKWELL"], 1, false, &["not calibrated", "inkwell"]),
        ("openhaptics", &["UNPLUGGED"], 1, true, &["the device failed", "communication error"]),
        ("openhaptics", &["STILL"], 1, true, &["the library's loop stands still"]),
    ];
    for (device, wrong, status, is_touched, says) in table {
        let imitation = Imitation::build(if device.starts_with('f') { "dhd" } else { "hd" }, wrong);
        ends(
            &server,
            &DeviceFaultCase { device: device.to_owned(), library: Some(imitation.library.clone()), status, says },
        );
        let forces = imitation.log.vectors("force");
        assert_eq!(is_felt(&forces), is_touched, "{device} {wrong:?}");
        match wrong {
            // Its own loop would have to let go.
            ["STILL"] => is_bounded(&forces),
            _ => is_safe(&forces),
        }
    }
    for (device, library, status, says) in [
        ("force-dimension", Some("/nowhere/libdhd.so"), 1, &["libdhd can't be loaded", "/nowhere", "--library"][..]),
        ("force-dimension", None, 1, &["libdhd.so.3", "Install the Force Dimension SDK"]),
        ("force-dimension:x", None, 1, &["which one is a number"]),
        ("openhaptics", None, 1, &["libHD.so", "Install OpenHaptics"]),
        ("openhaptics", Some("Cargo.toml"), 1, &["libHD can't be loaded"]),
        ("phantom", None, 2, &["--device", "force-dimension, openhaptics, haply, spacemouse, gamepad"]),
    ] {
        let root = repository();
        let library = library.map(|library| root.join(library));
        ends(&server, &DeviceFaultCase { device: device.to_owned(), library, status, says });
    }
}

/// Felt, and after that nothing for a while.
fn is_let_go(forces: &[DVec3]) -> bool {
    let pushes: Vec<bool> = forces.iter().map(|force_n| force_n.abs().max_element() > 0.05).collect();
    pushes.iter().filter(|pushes| **pushes).count() > 50 && pushes.iter().rev().take(200).all(|pushes| !pushes)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn positions_that_no_arm_has_give_no_force_and_do_not_end_the_touch() {
    let server = TestServer::start(&[]);
    let is_wrong = |report: &BridgeReport| {
        let last = report.course.last().unwrap();
        assert!(
            (last.place_m.is_nan() || last.place_m.length() >= 1e3) && last.state == Some(RenderingState::Fault),
            "{last:?}"
        );
    };
    for (name, device) in [("dhd", "force-dimension"), ("hd", "openhaptics")] {
        for garbage in ["GARBAGE=NAN", "GARBAGE=1e9"] {
            let imitation = Imitation::build(name, &[garbage]);
            let device = open(device, Some(&imitation.library)).unwrap();
            let log = imitation.log.clone();
            is_wrong(&touch(device, &server, move || is_let_go(&log.vectors("force"))).await);
            let forces = imitation.log.vectors("force");
            assert!(forces.iter().all(|force_n| force_n.is_finite()), "{name} {garbage}");
            is_safe(&forces);
        }
    }
    let service = InverseService::start(Some("3.5.0"), Wrong::Far);
    let heard = service.heard();
    let device = open(&format!("haply:{}", service.url), None).unwrap();
    is_wrong(&touch(device, &server, move || is_let_go(&heard.forces_n())).await);
    is_bounded(&service.heard().forces_n());
    until_blocking("the force ends", || service.heard().forces_n().last() == Some(&DVec3::ZERO));
}

#[test]
fn what_goes_wrong_with_haplys_service_ends_the_bridge_within_the_envelope() {
    let server = TestServer::start(&[]);
    let table: [(Option<&str>, Wrong, bool, &[&str]); 9] = [
        (Some("3.0.7"), Wrong::Nothing, false, &["version 3.0.7", "knows 3.1 up to 3.x"]),
        (Some("4.0.0"), Wrong::Nothing, false, &["version 4.0.0"]),
        (Some("3.5.0"), Wrong::NoDevice, false, &["no Inverse3", "plugged in"]),
        (Some("3.5.0"), Wrong::GarbageAtFirst, false, &["sent something other than a state", "hello"]),
        (Some("3.5.0"), Wrong::Unplugged, true, &["does not tell where the Inverse3 is any more"]),
        (Some("3.5.0"), Wrong::Placeless, true, &["does not tell where the Inverse3 is any more"]),
        (Some("3.1.0"), Wrong::Killed, true, &["Haply's Inverse Service is gone"]),
        (Some("3.5.0"), Wrong::Silent, true, &["does not answer any more"]),
        (Some("3.5.0"), Wrong::Garbage, true, &["sent something other than a state", "{{{"]),
    ];
    for (version, wrong, is_touched, says) in table {
        let service = InverseService::start(version, wrong);
        let device = format!("haply:{}", service.url);
        ends(&server, &DeviceFaultCase { device, library: None, status: 1, says });
        let forces = service.heard().forces_n();
        assert_eq!(is_felt(&forces), is_touched, "{wrong:?}");
        assert!(forces.iter().all(|force_n| force_n.length() <= SAFE_FORCE_N), "{wrong:?}");
        // A service that still listens is told to render no force.
        if ![Wrong::Killed, Wrong::Silent].contains(&wrong) && is_touched {
            until_blocking("the force ends", || service.heard().forces_n().last() == Some(&DVec3::ZERO));
        }
    }
    let nobody = "ws://127.0.0.1:9";
    let says = &["does not answer at 127.0.0.1:9", "Haply Hub"][..];
    ends(&server, &DeviceFaultCase { device: format!("haply:{nobody}"), library: None, status: 1, says });
    let says = &["an address is like ws://localhost:10001"][..];
    ends(&server, &DeviceFaultCase { device: "haply:here".to_owned(), library: None, status: 1, says });
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_knob_or_stick_that_fails_while_it_is_pressed_is_left_without_a_force() {
    let server = TestServer::start(&[]);
    for (name, kind) in [("spacemouse", REL), ("gamepad", ABS)] {
        for (last, says) in [(&[][..], "it was unplugged"), (&[0xa5; 480], "not an event of an input device")] {
            let folder = tempfile::tempdir().unwrap();
            let path = pipe(folder.path());
            let device = open(&format!("{name}:{}", path.display()), None).unwrap();
            let noted = Arc::new(Mutex::new((DVec3::ZERO, Vec::new())));
            // Down until it is felt, which some presses of the button later it is; up again if it went too deep.
            let (seen, felt) = (noted.clone(), noted.clone());
            let (stop, over) = std::sync::mpsc::channel();
            let playing = play(&path, kind, over, last, down_and_up(move || seen.lock().unwrap().0.z));
            let ending = std::thread::spawn(move || {
                until_blocking("it is felt", || {
                    let (_, forces) = &*felt.lock().unwrap();
                    is_felt(forces) && forces.last().is_some_and(|force_n| force_n.length() > 0.05)
                });
                drop(stop);
            });
            let serving = run(Noting { device, noted: noted.clone() }, target(&server), Options::default(), pending());
            let failed = tokio::time::timeout(TEST_TIMEOUT, serving).await.expect("it did not end").err().unwrap();
            assert!(failed.to_string().contains(says), "{name}: {failed}");
            ending.join().unwrap();
            playing.join().unwrap();
            let forces = &noted.lock().unwrap().1;
            assert!(is_felt(forces), "{name}: {says}");
            is_safe(forces);
        }
    }
}

#[test]
fn what_goes_wrong_with_events_ends_the_bridge() {
    let server = TestServer::start(&[]);
    let folder = tempfile::tempdir().unwrap();
    let path = pipe(folder.path());
    let device = format!("gamepad:{}", path.display());
    // Unplugged while it is pressed.
    let (stop, over) = std::sync::mpsc::channel();
    let playing = play(&path, ABS, over, &[], |moment| moment % 60 < 25);
    let ending = std::thread::spawn(move || {
        std::thread::sleep(Duration::from_secs(3));
        drop(stop);
    });
    ends(
        &server,
        &DeviceFaultCase {
            device: device.clone(),
            library: None,
            status: 1,
            says: &["no more events: it was unplugged"],
        },
    );
    playing.join().unwrap();
    ending.join().unwrap();
    let garbage = std::thread::spawn({
        let path = path.clone();
        move || {
            let _ = OpenOptions::new().write(true).open(path).unwrap().write_all(&[0xa5; 480]);
        }
    });
    ends(&server, &DeviceFaultCase { device, library: None, status: 1, says: &["not an event of an input device"] });
    garbage.join().unwrap();
    for (device, says) in [
        (format!("gamepad:{}/none", folder.path().display()), &["No such file"][..]),
        (format!("spacemouse:{}", folder.path().display()), &["neither an input device nor a pipe"]),
    ] {
        ends(&server, &DeviceFaultCase { device, library: None, status: 1, says });
    }
}

#[test]
fn devices_are_listed_and_tested_without_a_force() {
    let imitation = Imitation::build("dhd", &[]);
    let library = imitation.library.to_str().unwrap();
    let output = client(&["devices", "--library", library, "--json"]);
    let listed: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let found = listed["devices"].as_array().unwrap();
    let of = |name: &str| found.iter().find(|found| found["name"].as_str().unwrap().starts_with(name)).unwrap();
    assert_eq!(of("force-dimension")["is_there"], true);
    assert!(of("force-dimension")["about"].as_str().unwrap().contains("3.17.0: 1 devices"));
    // The same file is no libHD.
    assert_eq!(of("openhaptics")["is_there"], false);
    for name in ["haply", "spacemouse", "gamepad"] {
        assert!(!of(name)["about"].as_str().unwrap().is_empty());
    }
    let tested = client(&["devices", "--library", library, "--test", "force-dimension", "--seconds", "0.5", "--json"]);
    assert!(tested.status.success());
    let told: serde_json::Value = serde_json::from_slice(&tested.stdout).unwrap();
    assert!(told["ticks"].as_u64().unwrap() > 10 && told["failure"].is_null() && told["model"] == "omega3", "{told}");
    let forces = imitation.log.vectors("force");
    assert!(forces.len() > 10 && forces.iter().all(|force_n| *force_n == DVec3::ZERO));
    let broken = Imitation::build("dhd", &["GARBAGE=NAN", "PRESSED=51"]);
    let arguments =
        ["devices", "--library", broken.library.to_str().unwrap(), "--test", "force-dimension", "--seconds", "2"];
    let output = client(&arguments);
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("not finite"));
    assert_eq!(client(&["devices", "--test", "phantom"]).status.code(), Some(2));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_device_without_a_button_gets_forces_by_itself() {
    let server = TestServer::start(&[]);
    let service = InverseService::start(Some("3.5.0"), Wrong::NoGrip);
    let device = open(&format!("haply:{}", service.url), None).unwrap();
    let placement = Placement { enable: Enables::Always, ..Placement::default() };
    let heard = service.heard();
    touch(Placed::new(device, placement).unwrap(), &server, move || is_felt(&heard.forces_n())).await;
    assert!(is_felt(&service.heard().forces_n()));
}
