//! A device continues with a session that moves between the servers of a fleet, by the same lease of its tool; and
//! rests until its user asks for forces when the server of its session has died.
#![cfg(target_os = "linux")]

use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::{Arc, Mutex};

use crate::common::etcd::EtcdMembers;
use crate::common::fleet::{self, FLEETS, Node, until_stood_by};
use crate::common::server::{self, until};
use glam::DVec3;
use palpate_client::bridge::{BridgeReport, Options, SessionChoice, Target, Tick, run};
use palpate_client::{Credentials, HapticDevice, Reading};
use palpate_haptics::envelope::{PAUSE_S, SLEW_N_PER_S};
use palpate_haptics::{Device, RenderingState, Tip};
use palpate_proto::pb;
use palpate_session::journal::{JournalReader, file};
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::collection::find_scene;
use tokio::sync::oneshot;
use tokio::task::JoinHandle;

/// The name by which servers know the hand.
const HOLDER: &str = "the hand";

/// Target heights of a hand over the tissue, µm.
const OUT_UM: i64 = 4000;
const IN_UM: i64 = -3000;

/// Target of a hand, and the forces that it has felt.
#[derive(Default)]
struct HandPath {
    ticks: Mutex<Vec<Tick>>,
    goal_um: AtomicI64,
    asks: AtomicBool,
}

impl HandPath {
    fn go(&self, goal_um: i64) {
        self.goal_um.store(goal_um, Ordering::Relaxed);
    }

    fn ask(&self, asks: bool) {
        self.asks.store(asks, Ordering::Relaxed);
    }

    fn len(&self) -> usize {
        self.ticks.lock().unwrap().len()
    }

    /// The ticks from one on.
    fn since(&self, tick: usize) -> Vec<Tick> {
        self.ticks.lock().unwrap()[tick..].to_vec()
    }

    fn last(&self) -> Option<Tick> {
        self.ticks.lock().unwrap().last().copied()
    }

    fn state(&self) -> Option<RenderingState> {
        self.last().and_then(|tick| tick.state)
    }

    fn force_n(&self) -> f64 {
        self.last().map_or(0.0, |tick| tick.force_n.length())
    }

    /// Waits until so many more ticks are done.
    async fn until_ticks(&self, more: usize) {
        let end = self.len() + more;
        until("the hand ticks", async || self.len() >= end).await;
    }

    /// Brings the hand out of the tissue, asks for forces, and presses until they are felt in full: they ramp in for
    /// half a second.
    async fn press(&self) {
        self.ask(false);
        self.go(OUT_UM);
        until("it is out", async || self.last().is_some_and(|tick| tick.place_m.z > 0.0035)).await;
        self.ask(true);
        until("it renders", async || self.state() == Some(RenderingState::Enabled)).await;
        self.until_ticks(700).await;
        self.go(IN_UM);
        until("it is in", async || self.last().is_some_and(|tick| tick.place_m.z < -0.0029)).await;
        until("it is felt", async || self.force_n() > 0.05).await;
        self.until_ticks(300).await;
    }
}

/// A hand that moves to its target at 20 mm/s.
struct SlowHand {
    course: Arc<HandPath>,
    z_m: f64,
}

impl HapticDevice for SlowHand {
    fn descriptor(&self) -> Device {
        Device::named("omega3").unwrap()
    }

    #[allow(clippy::cast_precision_loss)]
    fn read(&mut self) -> std::io::Result<Reading> {
        let goal_m = 1e-6 * self.course.goal_um.load(Ordering::Relaxed) as f64;
        self.z_m += (goal_m - self.z_m).clamp(-2e-5, 2e-5);
        Ok(Reading { place_m: self.z_m * DVec3::Z, enable: self.course.asks.load(Ordering::Relaxed) })
    }

    fn write(&mut self, _: DVec3) -> std::io::Result<()> {
        Ok(())
    }

    fn ticked(&mut self, tick: &Tick) {
        self.course.ticks.lock().unwrap().push(*tick);
    }
}

/// A bridge that touches a session of a fleet.
struct Bridge {
    course: Arc<HandPath>,
    stop: oneshot::Sender<()>,
    serving: JoinHandle<Result<(SlowHand, BridgeReport), palpate_client::Error>>,
}

impl Bridge {
    /// Begins with one known server only.
    fn begin(node: &Node, session_id: &str) -> Self {
        let course = Arc::new(HandPath { goal_um: AtomicI64::new(OUT_UM), ..HandPath::default() });
        let hand = SlowHand { course: course.clone(), z_m: 0.004 };
        let target = Target {
            server: palpate_client::Server::new(&node.url, &Credentials::default()).unwrap(),
            session: SessionChoice::Existing(session_id.to_owned()),
            tool: 0,
            tip: Tip::default(),
            deadband: 0.0,
            up_deadband: 0.0,
            datagrams: true,
            holder: HOLDER.to_owned(),
        };
        let (stop, stopped) = oneshot::channel();
        let stopped = async { drop(stopped.await) };
        let serving = tokio::spawn(run(hand, target, Options { keeps_session: true, ..Options::default() }, stopped));
        Bridge { course, stop, serving }
    }

    async fn end(self) -> BridgeReport {
        drop(self.stop);
        tokio::time::timeout(server::TEST_TIMEOUT, self.serving).await.expect("it did not end").unwrap().unwrap().1
    }
}

/// No force changes faster than the envelope lets it: 0.1 N in a tick of 1 ms. A loop that was late may catch up with
/// ten ticks.
fn assert_smooth(ticks: &[Tick]) {
    for pair in ticks.windows(2) {
        let elapsed_s = (pair[1].time_s - pair[0].time_s).clamp(0.0, 0.01);
        let change_n = (pair[1].force_n - pair[0].force_n).length();
        assert!(change_n <= SLEW_N_PER_S * elapsed_s + 1e-9, "{change_n} N within {elapsed_s} s: {pair:?}");
    }
}

async fn two(folder: &Path, etcd: &[String]) -> Vec<Node> {
    let nodes: Vec<Node> =
        (0..2).map(|at| Node::start(folder, &format!("n{at}"), etcd, &["--durable", "two", "--log", "warn"])).collect();
    nodes[0].until_nodes(2).await;
    nodes
}

/// A session of a piece of liver. A small one, whose force law is soon there.
async fn create(node: &Node) -> String {
    let (limits, points) = (Limits::default(), "sheet.points=[9, 9]".to_owned());
    let scene = find_scene(Path::new("liver"), Path::new("scenes"), &[points], &limits).unwrap();
    let source = pb::create_session_request::Source::Scene(palpate_session::wire::scene::sent(&scene));
    node.there().create(source, false).await.unwrap().session_id
}

/// Returns the number of commands that have acted at this server; `None` if it does not serve the session.
async fn applied(node: &Node, id: &str) -> Option<u64> {
    node.session(id).await.ok().map(|session| session.commands.unwrap().applied)
}

/// Waits until so many more commands have acted there.
async fn until_led(node: &Node, id: &str, more: u64) {
    let mut begun = None;
    until("the session is led there", async || {
        let now = applied(node, id).await;
        now.is_some_and(|now| now >= *begun.get_or_insert(now) + more)
    })
    .await;
}

/// Returns how often the lease of a tool has ended in the newest run of a session's journal at this server.
fn ended_leases(node: &Node, id: &str) -> usize {
    let newest = file::list(&node.journals).unwrap().into_iter().filter(|file| file.session_id == id);
    let newest = newest.max_by_key(|file| file.run).expect("it has a journal");
    let (mut reader, mut ended) = (JournalReader::open(&newest.path).unwrap(), 0);
    while let Some(batch) = reader.next_batch().unwrap() {
        for input in batch.inputs().unwrap() {
            if let Some(palpate_session::journal::pb::input::What::Command(command)) = input.what {
                ended += usize::from(command.ends_lease);
            }
        }
    }
    ended
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_hand_goes_on_with_a_session_that_moves_and_feels_no_jump() {
    const MOVES: u32 = 4;
    /// A busy machine may be silent for longer than a hand continues by itself.
    const MAX_MOVES: u32 = 16;
    if !EtcdMembers::is_there() {
        return;
    }
    let _turn = FLEETS.acquire().await.unwrap();
    let folder = tempfile::tempdir().unwrap();
    let etcd = EtcdMembers::start(1);
    let nodes = two(folder.path(), &etcd.endpoints()).await;
    let id = create(&nodes[0]).await;
    let mut at = fleet::owner(&nodes, &id).await.unwrap();
    // The other server redirects it to the session.
    let bridge = Bridge::begin(&nodes[1 - at], &id);
    until_led(&nodes[at], &id, 100).await;
    let course = bridge.course.clone();
    let (mut moves, mut went_on) = (0, 0);
    while moves < MOVES || went_on == 0 && moves < MAX_MOVES {
        if course.state() != Some(RenderingState::Enabled) || course.force_n() < 0.05 {
            course.press().await;
        }
        let (to, begun) = (1 - at, course.len());
        let request = pb::MoveSessionRequest { session_id: id.clone(), node: nodes[to].name.clone() };
        let moved = nodes[at].admin().await.move_session(request).await.unwrap().into_inner();
        assert_eq!(moved.ownership.unwrap().node, nodes[to].name);
        until_led(&nodes[to], &id, 300).await;
        course.until_ticks(100).await;
        let session = nodes[to].session(&id).await.unwrap();
        assert_eq!(session.held_tools, [pb::HeldTool { tool: 0, holder: HOLDER.to_owned() }]);
        let ticks = course.since(begun);
        assert_smooth(&ticks);
        // Nobody else can have had the tool, as its lease has not ended.
        assert_eq!(ended_leases(&nodes[to], &id), 0);
        // It was enabled only once. A pause comes only when nothing was heard for as long as it takes a force
        // to fade.
        match ticks.iter().position(|tick| tick.state != Some(RenderingState::Enabled)) {
            None => {
                went_on += 1;
                assert!(course.force_n() > 0.05, "it is enabled, but there is no force");
            }
            Some(paused) => {
                let [full_n, left_n] = [&ticks[0], &ticks[paused]].map(|tick| tick.force_n.length());
                assert_eq!(ticks[paused].state, Some(RenderingState::Paused));
                let stall_s = ticks[paused].time_s - ticks[paused.saturating_sub(1)].time_s;
                assert!(left_n < 0.1 * full_n || stall_s > PAUSE_S, "paused with {left_n} N of {full_n} N left");
            }
        }
        (moves, at) = (moves + 1, to);
    }
    let report = bridge.end().await;
    let traffic = report.traffic;
    assert_eq!((traffic.connections, traffic.failed), (1 + u64::from(moves), 0), "{traffic:?}");
    assert_eq!(report.lost.map(|error| error.to_string()), None);
    eprintln!("{went_on} of {moves} moves went on without a pause: {traffic:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_hand_whose_server_dies_rests_until_it_asks_for_forces() {
    if !EtcdMembers::is_there() {
        return;
    }
    let _turn = FLEETS.acquire().await.unwrap();
    let folder = tempfile::tempdir().unwrap();
    let etcd = EtcdMembers::start(1);
    let mut nodes = two(folder.path(), &etcd.endpoints()).await;
    let id = create(&nodes[0]).await;
    let (at, _) = until_stood_by(&nodes, &id).await;
    let bridge = Bridge::begin(&nodes[at], &id);
    let course = bridge.course.clone();
    until_led(&nodes[at], &id, 100).await;
    course.press().await;
    let begun = course.len();
    nodes[at].kill();
    until("it pauses", async || course.state() == Some(RenderingState::Paused)).await;
    let paused = course.len();
    until_led(&nodes[1 - at], &id, 300).await;
    // News has come for longer than after which they would have been missed.
    course.until_ticks(500).await;
    let rested = course.len();
    assert_smooth(&course.since(begun));
    let ticks = course.since(paused);
    assert!(ticks.iter().all(|tick| tick.state == Some(RenderingState::Paused)), "it resumed without being enabled");
    assert!(ticks.windows(2).all(|pair| pair[1].force_n.length() <= pair[0].force_n.length() + 1e-12));
    let left_n = ticks.last().unwrap().force_n.length();
    assert!(left_n < 1e-3, "{left_n} N are left after {} s", ticks.last().unwrap().time_s - ticks[0].time_s);
    let since_s = ticks[0].time_s - course.since(begun)[0].time_s;
    assert!(since_s > 0.5 * PAUSE_S, "it pauses {since_s} s after its server died");
    course.press().await;
    assert_smooth(&course.since(rested));
    let session = nodes[1 - at].session(&id).await.unwrap();
    assert_eq!(session.held_tools, [pb::HeldTool { tool: 0, holder: HOLDER.to_owned() }]);
    let report = bridge.end().await;
    assert!(report.traffic.connections >= 2 && report.traffic.failed >= 1, "{:?}", report.traffic);
    until("the tool is let go", async || {
        nodes[1 - at].session(&id).await.is_ok_and(|session| session.held_tools.is_empty())
    })
    .await;
}
