//! The client library against a real server: a tool, a device, samples and frames.

use std::f64::consts::TAU;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use crate::common::server::{self, TEST_TIMEOUT, TestServer, force, open};
use glam::DVec3;
use palpate_client::bridge::{CutButton, Options, SessionChoice, Target, Tick, run};
use palpate_client::devices::{Enables, Placed, Placement};
use palpate_client::view::Frames;
use palpate_client::watch::Samples;
use palpate_client::{Channel, Credentials, Error, HapticDevice, Reading, Touch};
use palpate_haptics::{Device, RenderingState, Tip};
use palpate_proto::geometry::from_vector;
use palpate_proto::pb;
use pb::create_session_request::Source;
use pb::session_service_client::SessionServiceClient;
use pb::touch_request::Message as Say;
use pb::touch_response::Message as Heard;
use tokio::sync::{Notify, mpsc};
use tokio_stream::wrappers::ReceiverStream;

fn at(server: &TestServer) -> palpate_client::Server {
    palpate_client::Server::new(&server.url, &Credentials::default()).unwrap()
}

async fn create(channel: Channel, scene: &str) -> String {
    let request = pb::CreateSessionRequest { source: Some(Source::SceneName(scene.into())), ..Default::default() };
    let created = SessionServiceClient::new(channel).create_session(request).await.unwrap();
    created.into_inner().session.unwrap().session_id
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_force_is_felt_watched_and_seen() {
    let server = TestServer::start(&[]);
    let channel = at(&server).connect().await.unwrap();
    let session_id = create(channel.clone(), "paper").await;
    let request = pb::WatchSamplesRequest { session_id: session_id.clone(), ..Default::default() };
    let mut samples = Samples::open(channel.clone(), request).await.unwrap();
    let encoding = pb::Encoding::I16.into();
    let request = pb::WatchFramesRequest { session_id: session_id.clone(), encoding, ..Default::default() };
    let mut frames = Frames::open(channel.clone(), request).await.unwrap();
    let (say, messages) = mpsc::channel(8);
    let mut touch = Touch::open(channel, open(&session_id, &[0]), ReceiverStream::new(messages)).await.unwrap();
    say.send(Say::Command(force(0, 1, -0.1))).await.unwrap();
    let pressed =
        |sample: &pb::Sample| sample.tools.iter().any(|tool| from_vector(tool.displacement_m.as_ref()).z < -1e-5);
    let done = tokio::time::timeout(TEST_TIMEOUT, async {
        loop {
            match touch.next().await.unwrap().expect("the stream ended") {
                Heard::Sample(sample) if pressed(&sample) => break,
                Heard::Rejection(rejection) => panic!("{rejection:?}"),
                _ => {}
            }
        }
        while !pressed(&samples.next().await.unwrap().expect("samples go on")) {}
        loop {
            let (frame, surface) = frames.next().await.unwrap().expect("frames go on");
            assert!(frame.last && surface.vertices == [31, 31]);
            if surface.displacement_m[15 * 31 + 15][2] < -1e-5 {
                assert!(surface.displacement_m[0][2].abs() < 1e-6, "a corner moved: {:?}", surface.displacement_m[0]);
                break;
            }
        }
    });
    done.await.expect("the server is silent");
}

/// Goes down into the tissue and up again without end, and asks for forces again and again.
struct Pressing {
    ticks: u32,
    force_n: DVec3,
    felt: Arc<Notify>,
}

impl HapticDevice for Pressing {
    fn descriptor(&self) -> Device {
        Device::named("omega3").unwrap()
    }

    fn read(&mut self) -> std::io::Result<Reading> {
        self.ticks += 1;
        let z_m = -0.001 + 0.004 * (TAU * f64::from(self.ticks) / 2000.0).cos();
        Ok(Reading { place_m: z_m * DVec3::Z, enable: self.ticks % 300 < 150 })
    }

    fn write(&mut self, force_n: DVec3) -> std::io::Result<()> {
        self.force_n = force_n;
        if force_n.z > 0.05 {
            self.felt.notify_one();
        }
        Ok(())
    }
}

fn pressing() -> (Pressing, Arc<Notify>) {
    let felt = Arc::new(Notify::new());
    (Pressing { ticks: 0, force_n: DVec3::ZERO, felt: felt.clone() }, felt)
}

fn target(server: &TestServer, session: SessionChoice) -> Target {
    let holder = "test".to_owned();
    Target {
        server: at(server),
        session,
        tool: 0,
        tip: Tip::default(),
        deadband: 0.0,
        up_deadband: 0.0,
        datagrams: true,
        holder,
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_device_in_the_middle_of_its_workspace_touches_the_middle_of_the_sheet() {
    let server = TestServer::start(&[]);
    let (device, felt) = pressing();
    let options = Options { remembers: true, ..Options::default() };
    let target = target(&server, SessionChoice::New { scene: "liver".to_owned() });
    let serving = run(device, target, options, async move { felt.notified().await });
    let (device, report) = tokio::time::timeout(TEST_TIMEOUT, serving).await.expect("no force").unwrap();
    assert_eq!(device.force_n, DVec3::ZERO, "a device is left without a force");
    assert_eq!((report.traffic.connections, report.traffic.refused), (1, 0));
    let last = report.course.last().unwrap();
    assert!((last.place_m - DVec3::new(0.0375, 0.0375, last.place_m.z)).length() < 1e-9, "{last:?}");
    assert!(report.envelope.is_some());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_device_over_an_organ_comes_down_onto_the_top_of_its_surface() {
    let server = TestServer::start(&[]);
    let session_id = create(at(&server).connect().await.unwrap(), "liver-organ").await;
    let extent = server.status(&session_id).await.extent.unwrap();
    let [top_m, middle_m, most_m] =
        [&extent.top_m, &extent.middle_m, &extent.most_m].map(|place_m| from_vector(place_m.as_ref()));
    assert!(top_m.truncate() == middle_m.truncate() && top_m.z > middle_m.z + 0.01, "{top_m} {middle_m}");
    assert!(top_m.z <= most_m.z, "{top_m} {most_m}");
    let (device, felt) = pressing();
    let options = Options { remembers: true, ..Options::default() };
    let serving =
        run(
            device,
            target(&server, SessionChoice::Existing(session_id)),
            options,
            async move { felt.notified().await },
        );
    let (_, report) = tokio::time::timeout(TEST_TIMEOUT, serving).await.expect("no force").unwrap();
    let last = report.course.last().unwrap();
    assert!((last.place_m - top_m).truncate().length() < 1e-9 && (last.place_m - top_m).z.abs() < 0.006, "{last:?}");
    assert_eq!((report.unfelt(), report.made), (None, None));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_tool_that_somebody_holds_ends_the_bridge_with_its_number_and_holder() {
    let server = TestServer::start(&[]);
    let channel = at(&server).connect().await.unwrap();
    let session_id = create(channel.clone(), "paper").await;
    let (_say, messages) = mpsc::channel(8);
    let _held = Touch::open(channel, open(&session_id, &[0]), ReceiverStream::new(messages)).await.unwrap();
    let (device, _felt) = pressing();
    let serving =
        run(device, target(&server, SessionChoice::Existing(session_id)), Options::default(), std::future::pending());
    let error = tokio::time::timeout(TEST_TIMEOUT, serving).await.expect("it waits").err().unwrap().to_string();
    assert!(error.contains("tool 0 is held by `") && error.contains("TOOL_HELD"), "{error}");
}

/// Who ends a loop may use its tool at once by a call: neither a loop that ends by its time nor one that is told to end leaves it held.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_tool_is_free_once_its_loop_has_ended() {
    let server = TestServer::start(&[]);
    let session_id = create(at(&server).connect().await.unwrap(), "paper").await;
    // A lease ends with its connection.
    let mut haptics = server.haptics().await;
    for round in 0..20 {
        let (device, _felt) = pressing();
        let lasts = Duration::from_millis(50);
        let options = Options { lasts: (round % 2 == 0).then_some(lasts), ..Options::default() };
        let target = target(&server, SessionChoice::Existing(session_id.clone()));
        let stop =
            async move { if round % 2 == 0 { std::future::pending().await } else { tokio::time::sleep(lasts).await } };
        let serving = run(device, target, options, stop);
        let ended = tokio::time::timeout(TEST_TIMEOUT, serving).await.expect("it does not end");
        // A loop that was told to end before it was connected has held nothing.
        if let Err(error) = ended {
            assert!(round % 2 == 1, "{error}");
        }
        let request = pb::AcquireToolRequest { session_id: session_id.clone(), tool: 0, ..Default::default() };
        let lease_id = haptics.acquire_tool(request).await.unwrap().into_inner().lease_id;
        let request = pb::ReleaseToolRequest { session_id: session_id.clone(), lease_id };
        haptics.release_tool(request).await.unwrap();
    }
}

#[cfg(unix)]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_bridge_that_touched_nothing_says_so_and_tells_the_session_that_it_keeps() {
    let server = TestServer::start(&[]);
    // 3 cm above the tissue.
    let options = ["--server", &server.url, "--scene", "paper", "--offset-m", "0,0,0.03", "--seconds", "1.5"];
    let mut bridge = std::process::Command::new(server::client_program());
    let ran = bridge.arg("bridge").args(options).args(["--keep-session", "--json"]).output().unwrap();
    let told = String::from_utf8_lossy(&ran.stderr);
    assert!(ran.status.success() && told.contains("warning: the tool never touched the tissue"), "{told}");
    let report: serde_json::Value = serde_json::from_slice(&ran.stdout).unwrap();
    let session_id = report["session_id"].as_str().unwrap();
    assert!(told.contains(&format!("palpate-client admin delete {session_id} --server {}", server.url)), "{told}");
    assert_eq!(server.status(session_id).await.scene_name, "paper");
}

/// Two simulated devices in one program, each with its own tool of one session: both are felt, and both render from a copy.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_devices_of_one_bridge_lead_a_tool_each() {
    let server = TestServer::start(&[]);
    let session_id = create(at(&server).connect().await.unwrap(), "liver").await;
    let options =
        ["--server", &server.url, "--session", &session_id, "--seconds", "4", "--prediction", "always", "--json"];
    let mut bridge = std::process::Command::new(server::client_program());
    let ran = bridge.arg("bridge").args(options).args(["--second-device", "touch", "--second-tool", "3"]).output();
    let ran = ran.unwrap();
    assert!(ran.status.success(), "{}", String::from_utf8_lossy(&ran.stderr));
    let report: serde_json::Value = serde_json::from_slice(&ran.stdout).unwrap();
    for hand in [&report, &report["second"]] {
        assert_eq!((&hand["connections"], &hand["commands_refused"]), (&1.into(), &0.into()), "{report}");
        assert!(hand["largest_force_n"].as_f64().unwrap() > 0.05, "{report}");
        assert!(hand["predicted_ticks"].as_u64().unwrap() > 100, "{report}");
    }
}

/// Two simulated devices of six axes, each with a grasper: both feel force and torque from a copy that has the tips of both.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_devices_of_one_bridge_lead_an_instrument_each() {
    let server = TestServer::start(&[]);
    let session_id = create(at(&server).connect().await.unwrap(), "liver").await;
    let options = ["--server", &server.url, "--session", &session_id, "--seconds", "4", "--json", "--device", "sigma7"];
    let grasper = ["--jaws-m", "0.012", "--shaft-m", "0.008", "--radius-m", "0.004"];
    let has_felt = |hand: &serde_json::Value| {
        let [force_n, torque_n_m] = ["largest_force_n", "largest_torque_n_m"].map(|key| hand[key].as_f64().unwrap());
        force_n > 0.02 && torque_n_m > 1e-5
    };
    // On a busy machine a copy may come late.
    for trial in 1.. {
        let mut bridge = std::process::Command::new(server::client_program());
        bridge.arg("bridge").args(options).args(grasper);
        let ran = bridge.args(["--second-device", "sigma7", "--second-offset-m", "0,0.02,0"]).output().unwrap();
        assert!(ran.status.success(), "{}", String::from_utf8_lossy(&ran.stderr));
        let report: serde_json::Value = serde_json::from_slice(&ran.stdout).unwrap();
        let hands = [&report, &report["second"]];
        assert!(hands.iter().all(|hand| hand["connections"].as_u64() >= Some(1)), "{report}");
        if hands.into_iter().all(has_felt) {
            break;
        }
        assert!(trial < 10, "{report}");
    }
}

#[tokio::test]
async fn what_a_server_refuses_at_first_ends_the_bridge() {
    let server = TestServer::start(&[]);
    for session in [SessionChoice::New { scene: "nowhere".to_owned() }, SessionChoice::Existing("0".repeat(32))] {
        let (device, _felt) = pressing();
        let serving = run(device, target(&server, session), Options::default(), std::future::pending());
        let error = tokio::time::timeout(TEST_TIMEOUT, serving).await.expect("it did not end").err().unwrap();
        assert!(error.is_refusal() && matches!(&error, Error::Call(_)), "{error}");
    }
}

/// Presses into the tissue, and has buttons: 0 asks for forces, 1 is the clutch.
struct Clutched {
    orders: Arc<Orders>,
    place_m: DVec3,
}

/// Target of the hand, and its result.
#[derive(Default)]
struct Orders {
    goal_m: Mutex<DVec3>,
    buttons: AtomicU32,
    newest: Mutex<Option<Tick>>,
    /// The force that was set on the device.
    force_n: Mutex<DVec3>,
}

impl Orders {
    fn go(&self, place_m: DVec3) {
        *self.goal_m.lock().unwrap() = place_m;
    }

    async fn until(&self, what: &str, holds: impl Fn(&Tick, DVec3) -> bool) -> Tick {
        let waited = tokio::time::timeout(TEST_TIMEOUT, async {
            loop {
                let (newest, force_n) = (*self.newest.lock().unwrap(), *self.force_n.lock().unwrap());
                if let Some(tick) = newest.filter(|tick| tick.state.is_some() && holds(tick, force_n)) {
                    return tick;
                }
                tokio::time::sleep(Duration::from_millis(2)).await;
            }
        });
        waited.await.unwrap_or_else(|_| panic!("never: {what}"))
    }
}

impl HapticDevice for Clutched {
    fn descriptor(&self) -> Device {
        Device::named("omega3").unwrap()
    }

    fn read(&mut self) -> std::io::Result<Reading> {
        let way_m = *self.orders.goal_m.lock().unwrap() - self.place_m;
        self.place_m += way_m.clamp_length_max(2e-5);
        Ok(Reading { place_m: self.place_m, enable: false })
    }

    fn write(&mut self, force_n: DVec3) -> std::io::Result<()> {
        *self.orders.force_n.lock().unwrap() = force_n;
        Ok(())
    }

    fn buttons(&self) -> u32 {
        self.orders.buttons.load(Ordering::Relaxed)
    }

    fn button_count(&self) -> u32 {
        2
    }

    fn ticked(&mut self, tick: &Tick) {
        *self.orders.newest.lock().unwrap() = Some(*tick);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_clutch_leaves_the_tool_in_the_tissue_and_takes_the_force_off_the_hand() {
    const ENABLE: u32 = 1;
    const CLUTCH: u32 = 2;
    let server = TestServer::start(&[]);
    let session_id = create(at(&server).connect().await.unwrap(), "liver").await;
    let orders = Arc::new(Orders::default());
    let (out_m, in_m) = (0.004 * DVec3::Z, -0.003 * DVec3::Z);
    orders.go(out_m);
    let hand = Clutched { orders: orders.clone(), place_m: out_m };
    let placement = Placement { enable: Enables::Button(0), ..Placement::default() };
    let placed = Placed::new(hand, placement).unwrap();
    let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
    let target = target(&server, SessionChoice::Existing(session_id.clone()));
    let serving = tokio::spawn(run(placed, target, Options::default(), async { drop(stopped.await) }));
    orders.until("it is connected", |tick, _| tick.place_m.z > 0.0039).await;
    orders.buttons.store(ENABLE, Ordering::Relaxed);
    orders.until("it renders", |tick, _| tick.state == Some(RenderingState::Enabled)).await;
    orders.go(in_m);
    let held = orders.until("it presses", |tick, force_n| tick.place_m.z < -0.00299 && force_n.z > 0.05).await;
    // The clutch: the hand goes up and aside, the tool stays.
    orders.buttons.store(ENABLE | CLUTCH, Ordering::Relaxed);
    orders.until("the force is off", |_, force_n| force_n == DVec3::ZERO).await;
    orders.go(DVec3::new(0.005, 0.0, 0.004));
    let request = pb::WatchSamplesRequest { session_id, ..Default::default() };
    let mut samples = Samples::open(at(&server).connect().await.unwrap(), request).await.unwrap();
    let begun = held.time_s;
    let after = orders.until("the hand has moved", |tick, _| tick.time_s > begun + 1.0).await;
    assert!((after.place_m - held.place_m).length() < 1e-4, "{after:?}, but it was {held:?}");
    assert_eq!(*orders.force_n.lock().unwrap(), DVec3::ZERO);
    let sample = samples.next().await.unwrap().expect("samples go on");
    let pushed_m = from_vector(sample.tools[0].displacement_m.as_ref()).z;
    assert!(pushed_m < -0.002, "the tool has left the tissue: {pushed_m} m");
    // It continues from its place: the hand's place 4 mm above the tissue is the tool's place.
    orders.buttons.store(ENABLE, Ordering::Relaxed);
    orders.go(DVec3::new(0.005, 0.0, 0.003));
    let lower = orders.until("it goes on", |tick, _| tick.place_m.z < after.place_m.z - 9e-4).await;
    assert!((lower.place_m.x - after.place_m.x).abs() < 1e-4, "{lower:?}");
    assert_eq!(*orders.force_n.lock().unwrap(), DVec3::ZERO, "a force begins within the tissue");
    orders.go(DVec3::new(0.005, 0.0, 0.012));
    orders.until("it is out of the tissue", |tick, _| tick.place_m.z > 0.002).await;
    orders.go(DVec3::new(0.005, 0.0, 0.004));
    orders.until("it is felt again", |tick, force_n| tick.place_m.z < 0.0 && force_n.z > 0.05).await;
    drop(stop);
    let (placed, report) = tokio::time::timeout(TEST_TIMEOUT, serving).await.expect("it did not end").unwrap().unwrap();
    assert_eq!(*placed.device().orders.force_n.lock().unwrap(), DVec3::ZERO);
    assert_eq!(report.lost.map(|error| error.to_string()), None);
}

/// A device that goes to the next place of a course when the test says so, and holds its button on the way there if the place says so.
struct Scalpel {
    /// Places from the middle of the workspace, m, and whether the button is held.
    course: &'static [([f64; 3], bool)],
    /// The place to go to, and the last one that was reached.
    goal: Arc<AtomicU32>,
    reached: Arc<AtomicU32>,
    from_m: DVec3,
    towards: u32,
    ticks: u32,
    is_held: bool,
    felt: Arc<Notify>,
}

/// Ticks on the way between two places.
const WAY_TICKS: u32 = 300;

impl HapticDevice for Scalpel {
    fn descriptor(&self) -> Device {
        Device::named("omega3").unwrap()
    }

    fn read(&mut self) -> std::io::Result<Reading> {
        let goal = self.goal.load(Ordering::Relaxed);
        let to_m = |place: u32| DVec3::from_array(self.course[place as usize].0);
        if goal != self.towards {
            (self.from_m, self.towards, self.ticks) = (to_m(self.towards), goal, 0);
        }
        self.ticks += 1;
        let part = f64::from(self.ticks.min(WAY_TICKS)) / f64::from(WAY_TICKS);
        if self.ticks == WAY_TICKS {
            self.reached.store(goal, Ordering::Relaxed);
        }
        self.is_held = self.course[goal as usize].1;
        Ok(Reading { place_m: self.from_m.lerp(to_m(goal), part), enable: self.ticks % 100 < 50 })
    }

    fn write(&mut self, force_n: DVec3) -> std::io::Result<()> {
        if force_n.z > 0.05 && self.towards as usize + 1 == self.course.len() {
            self.felt.notify_one();
        }
        Ok(())
    }

    fn buttons(&self) -> u32 {
        u32::from(self.is_held) << 2
    }

    fn button_count(&self) -> u32 {
        3
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_device_cuts_while_its_button_is_held_and_then_touches_again() {
    const COURSE: &[([f64; 3], bool)] = &[
        ([-0.00125, -0.015, 0.003], false),
        ([-0.00125, -0.015, -0.006], true),
        ([-0.00125, 0.015, -0.006], true),
        ([-0.00125, 0.015, -0.0061], false),
        ([0.015, 0.015, -0.006], false),
        ([0.015, 0.015, 0.004], false),
        ([0.015, 0.0, -0.003], false),
    ];
    let server = TestServer::start(&[]);
    let session_id = create(at(&server).connect().await.unwrap(), "liver").await;
    let [goal, reached] = [0, u32::MAX].map(|value| Arc::new(AtomicU32::new(value)));
    let felt = Arc::new(Notify::new());
    let device = Scalpel {
        course: COURSE,
        goal: goal.clone(),
        reached: reached.clone(),
        from_m: DVec3::from_array(COURSE[0].0),
        towards: 0,
        ticks: 0,
        is_held: false,
        felt: felt.clone(),
    };
    let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
    let cut_button = Some(CutButton { button: 2, length_m: 0.02 });
    let serving = tokio::spawn(run(
        device,
        target(&server, SessionChoice::Existing(session_id.clone())),
        Options { cut_button, ..Options::default() },
        async move { drop(stopped.await) },
    ));
    let mut severed = Vec::new();
    let whole_course = async {
        for place in 0..COURSE.len() as u32 {
            goal.store(place, Ordering::Relaxed);
            while reached.load(Ordering::Relaxed) != place {
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
            // What was sent has acted.
            let step = server.status(&session_id).await.step + 300;
            while server.status(&session_id).await.step < step {
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
            severed.push(server.status(&session_id).await.severed);
        }
        felt.notified().await;
    };
    tokio::time::timeout(TEST_TIMEOUT, whole_course).await.expect("no force");
    drop(stop);
    serving.await.unwrap().unwrap();
    // Twelve rows of springs along 30 mm; the way across cuts nothing.
    assert!(severed[0] == 0 && severed[3] >= 24, "{severed:?}");
    assert!(severed[3..].iter().all(|count| *count == severed[3]), "{severed:?}");
}
