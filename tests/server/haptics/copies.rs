//! Copies of a cut tissue, in bridges on a real server: a copy has the cuts of others, and begins with those that there are.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use super::blades::{create, knife, topology};
use crate::common::server::{TestServer, TestTouch, open};
use glam::{DQuat, DVec3};
use palpate_client::bridge::{Connection, Copies, Options, PositionOrigin, SessionChoice, TICK_S, Target, begin};
use palpate_client::connect::{Credentials, Server};
use palpate_client::device::Reading;
use palpate_haptics::{
    Device, Instrument, InstrumentPose, OtherTool, Predicted, Predictor, ReportedCuts, ReportedSpring, Tip,
};
use palpate_proto::geometry::from_vector;
use palpate_proto::pb::command::Action;
use palpate_proto::{instrument, pb};
use palpate_session::journal::replay::tissue_copy;
use palpate_session::tissue_copy::TissueCopy;

/// Longest time that anything here may take.
const TIMEOUT: Duration = Duration::from_secs(60);

/// What a copy has and feels.
#[derive(Debug, Clone, Default)]
struct CopyState {
    /// The names of its severed springs, ascending; and those with which the newest copy began.
    severed: Vec<(u32, u32)>,
    began_with: Option<Vec<(u32, u32)>>,
    /// The force on its tool, and that of a copy that does not follow cuts, N.
    force_n: DVec3,
    whole_n: DVec3,
}

/// A copy, and beside it one that does not follow cuts.
struct ObservedCopy {
    copy: TissueCopy,
    whole: TissueCopy,
    state: Arc<Mutex<CopyState>>,
}

fn names(copy: &TissueCopy) -> Vec<(u32, u32)> {
    let mut names: Vec<_> = copy.cuts().reported(0).map(|(spring, _)| spring.name()).collect();
    names.sort_unstable();
    names
}

impl Predictor for ObservedCopy {
    fn feel(&mut self, now_s: f64, pose: &InstrumentPose, others: &[OtherTool]) -> Option<Predicted> {
        let whole = self.whole.feel(now_s, pose, others)?;
        let felt = self.copy.feel(now_s, pose, others)?;
        let mut state = self.state.lock().unwrap();
        (state.force_n, state.whole_n) = (felt.wrench.force_n, whole.wrench.force_n);
        Some(felt)
    }

    fn topology_version(&self) -> Option<u32> {
        self.copy.topology_version()
    }

    fn follow_cuts(&mut self, cuts: &ReportedCuts) {
        self.copy.follow_cuts(cuts);
        self.state.lock().unwrap().severed = names(&self.copy);
    }
}

/// A bridge whose hand is moved by the test.
struct TestHand {
    place_m: Arc<Mutex<DVec3>>,
    state: Arc<Mutex<CopyState>>,
    ends: Arc<AtomicBool>,
    loop_thread: Option<std::thread::JoinHandle<()>>,
    _connection: Connection,
}

impl TestHand {
    async fn begin(server: &TestServer, session_id: &str, tool: u32, place_m: DVec3) -> Self {
        let state = Arc::new(Mutex::new(CopyState::default()));
        let seen = state.clone();
        let make = move |bytes: &[u8], instrument: &Instrument| {
            let [copy, whole] = [tissue_copy(bytes, instrument)?, tissue_copy(bytes, instrument)?];
            let severed = names(&copy);
            *seen.lock().unwrap() = CopyState { began_with: Some(severed.clone()), severed, ..CopyState::default() };
            Ok(Box::new(ObservedCopy { copy, whole, state: seen.clone() }) as Box<dyn Predictor>)
        };
        let target = Target {
            server: Server::new(&server.url, &Credentials::default()).unwrap(),
            session: SessionChoice::Existing(session_id.to_owned()),
            tool,
            tip: Tip { radius_m: 0.005, friction: 0.2, ..Tip::default() },
            deadband: 0.0,
            up_deadband: 0.0,
            datagrams: false,
            holder: "a hand".to_owned(),
        };
        let copies = Some(Copies { make: Arc::new(make), of_grids: true });
        let options = Options { copies, keeps_session: true, ..Options::default() };
        let device = Device::named("omega3").unwrap();
        let (mut ticker, connection) = begin(target, device, PositionOrigin::Tissue, options).await.unwrap();
        let (place_m, ends) = (Arc::new(Mutex::new(place_m)), Arc::new(AtomicBool::new(false)));
        let (goal_m, is_over) = (place_m.clone(), ends.clone());
        let loop_thread = std::thread::spawn(move || {
            let (begun, mut at_m) = (Instant::now(), *goal_m.lock().unwrap());
            while !is_over.load(Ordering::Relaxed) {
                let by_m = *goal_m.lock().unwrap() - at_m;
                at_m += by_m.clamp_length_max(0.02 * TICK_S);
                ticker.tick(Reading { place_m: at_m, enable: true }, begun.elapsed().as_secs_f64());
                std::thread::sleep(Duration::from_secs_f64(TICK_S));
            }
        });
        TestHand { place_m, state, ends, loop_thread: Some(loop_thread), _connection: connection }
    }

    fn state(&self) -> CopyState {
        self.state.lock().unwrap().clone()
    }

    /// Waits until the copy is as wanted. Returns its state.
    async fn until(&self, what: &str, is_wanted: impl Fn(&CopyState) -> bool) -> CopyState {
        let begun = Instant::now();
        loop {
            let state = self.state();
            if is_wanted(&state) {
                return state;
            }
            assert!(begun.elapsed() < TIMEOUT, "{what}: {} springs, {state:?}", state.severed.len());
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }
}

impl Drop for TestHand {
    fn drop(&mut self) {
        self.ends.store(true, Ordering::Relaxed);
        self.loop_thread.take().map(std::thread::JoinHandle::join);
    }
}

/// Returns the names of what the server has severed, ascending.
async fn severed(server: &TestServer, session_id: &str) -> Vec<(u32, u32)> {
    let request = pb::GetTopologyRequest { session_id: session_id.to_owned(), since_version: 0, by_name: true };
    let mut parts = server.views().await.get_topology(request).await.unwrap().into_inner();
    let mut found = Vec::new();
    while let Some(part) = parts.message().await.unwrap() {
        let of = |spring: &pb::SeveredSpring| {
            let pb::SpringName { place, number } = spring.name.unwrap();
            ReportedSpring { place, number, part: f64::from(spring.part) }.name()
        };
        found.extend(part.severed.iter().map(of));
    }
    found.sort_unstable();
    found
}

/// Waits until the force on tool 0 that samples have passes, N.
async fn until_felt(server: &TestServer, session_id: &str, what: &str, is_wanted: impl Fn(DVec3) -> bool) -> DVec3 {
    let request = pb::WatchSamplesRequest { session_id: session_id.to_owned(), ..Default::default() };
    let mut samples = server.haptics().await.watch_samples(request).await.unwrap().into_inner();
    let begun = Instant::now();
    loop {
        let sample = samples.message().await.unwrap().unwrap().sample.unwrap();
        let tool = sample.tools.iter().find(|tool| tool.tool == 0);
        let force_n = tool.and_then(|tool| tool.force_on_tool_n).map(|force_n| from_vector(Some(&force_n)));
        if let Some(force_n) = force_n.filter(|force_n| is_wanted(*force_n)) {
            return force_n;
        }
        assert!(begun.elapsed() < TIMEOUT, "{what}: {force_n:?}");
    }
}

/// Leads the knife of a stream along y through the tissue, and out, by 81 commands from `sequence` + 1 on.
pub(super) async fn cut(touch: &TestTouch, sequence: u64, from_m: DVec3, length_m: f64) {
    let poses = 80_u32;
    for number in 0..=poses {
        let is_out = number == poses;
        let along_m = length_m * f64::from(number) / f64::from(poses) * DVec3::Y;
        let pose = InstrumentPose {
            place_m: from_m + along_m + if is_out { 0.05 * DVec3::Z } else { DVec3::ZERO },
            orientation: DQuat::from_rotation_y(std::f64::consts::FRAC_PI_2),
            jaw_rad: 0.0,
        };
        let action = Some(Action::Instrument(instrument::pose(&pose)));
        let sequence = Some(sequence + u64::from(number) + 1);
        touch.command(pb::Command { tool: 2, sequence, action, ..Default::default() }).await;
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

/// Cuts what a bridge renders from a copy of, by another client.
async fn a_copy_is_cut(scene: &str, wound_m: DVec3, length_m: f64, press_m: DVec3) {
    let server = TestServer::start(&[]);
    let session = create(&server, pb::create_session_request::Source::SceneName(scene.into())).await;
    server
        .sessions()
        .await
        .start_session(pb::StartSessionRequest { session_id: session.clone(), ..Default::default() })
        .await
        .unwrap();
    let hand = TestHand::begin(&server, &session, 0, press_m + 0.01 * DVec3::Z).await;
    let began = hand.until("a copy", |state| state.began_with.is_some()).await;
    assert_eq!(began.began_with, Some(Vec::new()));
    let with_knife = pb::TouchOpen { instruments: vec![instrument::instrument(&knife(), 2)], ..open(&session, &[2]) };
    let mut touch = TestTouch::open(&server, with_knife).await.unwrap();
    cut(&touch, 0, wound_m, length_m).await;
    let release = Some(Action::Release(pb::Release {}));
    touch.command(pb::Command { tool: 2, sequence: Some(1000), action: release, ..Default::default() }).await;
    touch.settle().await;
    touch.sample_with(|sample| sample.tools.iter().any(|tool| tool.acknowledged_sequence == 1000)).await;
    let truth = severed(&server, &session).await;
    assert!(truth.len() > 20, "{} springs", truth.len());
    assert_eq!(topology(&server, &session, 0).await.severed.len(), truth.len());
    hand.until("the cut in the copy", |state| state.severed == truth).await;
    // Beside the wound, both feel the same.
    *hand.place_m.lock().unwrap() = press_m;
    let is_settled = |force_n: DVec3, state: &CopyState| {
        force_n.length() > 0.02 && (state.force_n - force_n).length() < 0.02 * force_n.length()
    };
    let truth_n =
        until_felt(&server, &session, "the force of the copy", |force_n| is_settled(force_n, &hand.state())).await;
    let state = hand.state();
    println!(
        "{scene}: {} springs, {truth_n} N, the copy has {}, a whole one {}",
        truth.len(),
        state.force_n,
        state.whole_n
    );
    assert!((state.whole_n - truth_n).length() > 0.05 * truth_n.length(), "{truth_n} {state:?}");
    // A bridge that begins now begins with the cut.
    let late = TestHand::begin(&server, &session, 1, press_m + 0.02 * DVec3::Z).await;
    let began = late.until("another copy", |state| state.began_with.is_some()).await;
    assert_eq!(began.began_with, Some(truth));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_bridge_feels_what_another_client_has_cut_in_a_sheet() {
    // 75 × 75 mm; a blade feels nothing there.
    let wound_m = DVec3::new(0.03625, 0.02, -0.005);
    a_copy_is_cut("fibrotic", wound_m, 0.035, DVec3::new(0.0395, 0.0375, -0.002)).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_bridge_feels_what_another_client_has_cut_in_a_solid() {
    // 100 × 100 × 40 mm.
    let wound_m = DVec3::new(0.003, -0.04, 0.024);
    a_copy_is_cut("phantom", wound_m, 0.08, DVec3::new(0.009, 0.0, 0.0375)).await;
}
