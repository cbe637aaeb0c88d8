//! A fleet of real servers on a real etcd, under clients at 1 kHz that follow their sessions, while servers are
//! killed, frozen and cut off from etcd, etcd loses its leader or is gone altogether, and sessions move.
//!
//! `make chaos` does it all at length, and gathers the figures:
//!
//! | variable | what |
//! |---|---|
//! | `PALPATE_FLEET_ROUNDS`, `PALPATE_FLEET_SEED` | random rounds |
//! | `PALPATE_FLEET_SESSIONS`, `PALPATE_FLEET_RESTING` | sessions with a client each, and at rest |
//! | `PALPATE_FLEET_FROZEN_S` | how long a server is frozen, at least |
//! | `PALPATE_FLEET_LEADERS` | how often etcd's leader is killed |
//! | `PALPATE_FLEET_GONE_S` | how long etcd is gone |
//! | `PALPATE_FLEET_MOVES` | live moves |
//! | `PALPATE_FLEET_SUMMARY` | a file to which the figures are added |
#![cfg(target_os = "linux")]

mod follower;
mod stayed;

use std::collections::{BTreeMap, BTreeSet};
use std::io::Write;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::common::etcd::EtcdMembers;
use crate::common::fleet::{FLEETS, Node, create, goes_on, three, verify};
use crate::common::proxy::Proxy;
use crate::common::random::TestRandom;
use crate::common::server::{TestTouch, force, until};
use follower::{Doors, Follower, FollowingViewer};
use palpate_client::fleet::is_fenced;
use palpate_proto::pb;

/// The lease of a server.
const TTL_S: f64 = 3.0;

fn number(name: &str, otherwise: u64) -> u64 {
    std::env::var(name).map_or(otherwise, |text| text.parse().unwrap())
}

/// Prints figures, and adds them to the summary of all tests.
fn tell(figures: &str) {
    println!("{figures}");
    if let Some(path) = std::env::var_os("PALPATE_FLEET_SUMMARY") {
        let mut file = std::fs::File::options().create(true).append(true).open(path).unwrap();
        writeln!(file, "{figures}").unwrap();
    }
}

/// Times or other figures of one kind.
#[derive(Default)]
struct Figures(Vec<f64>);

impl Figures {
    fn at(&mut self, quantile: f64) -> f64 {
        self.0.sort_by(f64::total_cmp);
        #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let index = (quantile * self.0.len().saturating_sub(1) as f64).round() as usize;
        self.0.get(index).copied().unwrap_or(f64::NAN)
    }

    fn above(&self, bound: f64) -> usize {
        self.0.iter().filter(|figure| **figure > bound).count()
    }
}

/// A fleet under touch.
struct Ward {
    nodes: Vec<Node>,
    doors: Arc<Doors>,
    /// Sessions with a client each, and all of them.
    followers: Vec<Follower>,
    ids: Vec<String>,
    _folder: tempfile::TempDir,
}

impl Ward {
    /// So many sessions with clients, which get a sample every so many steps, and so many at rest. Each server
    /// reaches etcd by its own addresses.
    async fn open(etcd: &[Vec<String>], sessions: u64, every: u32, resting: u64) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let config = folder.path().join("palpate.toml");
        // Nothing is refused because the machine is slow, or deleted because it was idle.
        std::fs::write(&config, "idle_session_s = 86400.0\n[limits]\nthread_share = 1000.0\n").unwrap();
        let more = ["--durable", "two", "--log", "error", "--config", config.to_str().unwrap()];
        let nodes: Vec<Node> =
            (0..3).map(|at| Node::start(folder.path(), &format!("n{at}"), &etcd[at], &more)).collect();
        nodes[0].until_nodes(3).await;
        let doors = Doors::of(&nodes);
        let (mut ids, mut followers) = (Vec::new(), Vec::new());
        for index in 0..sessions + resting {
            let id = create(&nodes[usize::try_from(index).unwrap() % 3]).await.session_id;
            if index < sessions {
                followers.push(Follower::start(&doors, &id, every));
            }
            ids.push(id);
        }
        let ward = Ward { nodes, doors, followers, ids, _folder: folder };
        ward.until_well().await;
        ward
    }

    /// Waits until all sessions have an owner and another server that stands by, and all clients touch. Tells who has
    /// what.
    async fn until_well(&self) -> BTreeMap<String, pb::Ownership> {
        let mut found = BTreeMap::new();
        until("all is well", async || {
            let told = self.nodes[0].fleet_sessions().await;
            let stood_by = |session: &pb::FleetSession| {
                session.served && session.ownership.as_ref().is_some_and(|own| !own.standby.is_empty())
            };
            let is_well = self.ids.iter().all(|id| told.get(id).is_some_and(stood_by));
            found = told.into_iter().filter_map(|(id, session)| Some((id, session.ownership?))).collect();
            is_well && self.followers.iter().all(Follower::acts)
        })
        .await;
        found
    }

    /// Every session is there once, at the server that etcd says, and nothing else is.
    async fn is_each_there_once(&self) {
        until("each session is at its owner, and only there", async || {
            let told = self.nodes[0].fleet_sessions().await;
            let mut served = BTreeMap::new();
            let mut count = 0;
            for node in &self.nodes {
                let Some(ids) = node.served().await else { return false };
                count += ids.len();
                served.extend(ids.into_iter().map(|id| (id, node.name.clone())));
            }
            let owners = told.iter().map(|(id, session)| (id.clone(), session.ownership.clone().unwrap().node));
            count == self.ids.len() && served == owners.collect() && self.ids.iter().all(|id| served.contains_key(id))
        })
        .await;
    }

    /// Ends all. Checks that the journals are those of offline runs, and that clients were served by one server at a
    /// time.
    async fn close(mut self) -> Vec<follower::FollowerObservation> {
        let mut seen = Vec::new();
        for follower in self.followers.drain(..) {
            seen.push(follower.end().await);
        }
        seen.iter().for_each(follower::FollowerObservation::check);
        self.nodes.iter_mut().for_each(Node::kill);
        let journals = self.nodes.iter().flat_map(|node| self.ids.iter().flat_map(|id| node.runs(id)));
        let compared: u64 = journals.map(|journal| verify(&journal.path)).sum();
        assert!(compared >= self.ids.len() as u64);
        seen
    }
}

/// Fate of a server.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
enum ServerFault {
    Killed,
    Frozen,
    /// Its connections to etcd break.
    Cut,
    /// Silently blocks all data between it and etcd.
    Silenced,
}

/// The runs of a session before its newest are those of offline runs. They are removed but for the one before: room
/// for many rounds.
fn check_runs(nodes: &[Node], id: &str) -> u64 {
    let mut runs: Vec<_> = nodes.iter().flat_map(|node| node.runs(id)).collect();
    runs.sort_by_key(|file| file.run);
    let newest = runs.last().map_or(0, |file| file.run);
    let mut compared = 0;
    for file in runs.iter().filter(|file| file.run + 1 == newest) {
        compared += verify(&file.path);
    }
    for file in runs.iter().filter(|file| file.run + 1 < newest) {
        std::fs::remove_file(&file.path).unwrap();
    }
    compared
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn rounds() {
    if !EtcdMembers::is_there() {
        return;
    }
    let _turn = FLEETS.acquire().await.unwrap();
    let (rounds, mut random) = (number("PALPATE_FLEET_ROUNDS", 4), TestRandom(number("PALPATE_FLEET_SEED", 1)));
    let (sessions, resting) = (number("PALPATE_FLEET_SESSIONS", 3), number("PALPATE_FLEET_RESTING", 3));
    let frozen = Duration::from_secs(number("PALPATE_FLEET_FROZEN_S", 4));
    let etcd = EtcdMembers::start(1);
    // Each server reaches etcd by a wire of its own, which can be cut.
    let mut wires = Vec::new();
    for _ in 0..3 {
        wires.push(Proxy::start(etcd.endpoints()[0].trim_start_matches("http://").to_owned(), Duration::ZERO).await);
    }
    let ways: Vec<Vec<String>> = wires.iter().map(|wire| vec![wire.url()]).collect();
    let mut ward = Ward::open(&ways, sessions, 4, resting).await;
    let viewers: Vec<FollowingViewer> =
        ward.followers.iter().take(2).map(|follower| FollowingViewer::start(&ward.doors, &follower.id)).collect();
    let (mut touched, mut rested, mut done) = (Figures::default(), Figures::default(), BTreeMap::new());
    let (mut compared, mut others) = (0, 0);
    for round in 1..=rounds {
        let owners = ward.until_well().await;
        tokio::time::sleep(Duration::from_millis(random.below(500))).await;
        // Mostly one that somebody touches.
        let pressed = &owners[&ward.followers[usize::try_from(random.below(sessions)).unwrap()].id].node;
        let mut at = ward.nodes.iter().position(|node| node.name == *pressed).unwrap();
        if round > 4 && random.below(4) == 0 {
            at = usize::try_from(random.below(3)).unwrap();
        }
        let kinds = [ServerFault::Killed, ServerFault::Frozen, ServerFault::Cut, ServerFault::Silenced];
        // The first rounds have one of each.
        let kind = if round <= 4 { round - 1 } else { random.below(4) };
        let fault = kinds[usize::try_from(kind).unwrap()];
        let its: Vec<String> = owners
            .iter()
            .filter(|(id, own)| own.node == ward.nodes[at].name && ward.ids.contains(id))
            .map(|(id, _)| id.clone())
            .collect();
        let before: BTreeMap<String, u64> =
            ward.followers.iter().map(|f| (f.id.clone(), f.seen().durable_step)).collect();
        let begun = Instant::now();
        match fault {
            ServerFault::Killed => ward.nodes[at].kill(),
            ServerFault::Frozen => ward.nodes[at].freeze(),
            ServerFault::Cut => wires[at].cut(),
            ServerFault::Silenced => wires[at].silence(),
        }
        *done.entry(fault).or_insert(0) += 1;
        let (back_touched, back_rested) = until_back(&ward, at, &its, begun, &before).await;
        if fault == ServerFault::Frozen {
            tokio::time::sleep(frozen.saturating_sub(begun.elapsed())).await;
        }
        match fault {
            ServerFault::Killed => ward.nodes[at].begin(),
            ServerFault::Frozen => ward.nodes[at].thaw(),
            ServerFault::Cut | ServerFault::Silenced => wires[at].mend(),
        }
        ward.nodes[at].until_nodes(3).await;
        let owners = ward.until_well().await;
        for id in &its {
            until("the old owner knows", async || ward.nodes[at].session(id).await.is_err()).await;
            let there = ward.nodes.iter().find(|node| node.name == owners[id].node).unwrap();
            assert_ne!(there.name, ward.nodes[at].name);
            goes_on(&ward.nodes, id, there, true).await;
            compared += check_runs(&ward.nodes, id);
        }
        for (index, viewer) in viewers.iter().enumerate() {
            let looked = Instant::now();
            let owner = &owners[&ward.followers[index].id].node;
            until("a viewer sees what the owner shows", async || {
                viewer.shown_since(looked).is_some_and(|shown| ward.nodes[shown].name == *owner)
            })
            .await;
        }
        others += ward.followers.iter().filter(|f| !its.contains(&f.id) && f.back_since(begun).is_some()).count();
        let worst = [&back_touched[..], &back_rested].concat().into_iter().fold(0.0, f64::max);
        eprintln!(
            "round {round} of {rounds}: n{at} {fault:?}, {} touched and {} at rest are back after {worst:.2} s",
            back_touched.len(),
            back_rested.len()
        );
        touched.0.extend(back_touched);
        rested.0.extend(back_rested);
    }
    ward.is_each_there_once().await;
    drop(viewers);
    let seen = ward.close().await;
    let older: u64 = seen.iter().map(|seen| seen.older).sum();
    let figures = |what: &str, times: &mut Figures| {
        tell(&format!(
            "  {what}: {} interrupted, back after {:.2} s (median), {:.2} s (worst); {} after more than {} s",
            times.0.len(),
            times.at(0.5),
            times.at(1.0),
            times.above(TTL_S + 1.0),
            TTL_S + 1.0
        ));
    };
    tell(&format!(
        "Rounds: {rounds} ({done:?}), {sessions} sessions with a client at 1 kHz, {resting} at rest, 2 viewers"
    ));
    figures("under touch, to the first sample with the tool enabled again", &mut touched);
    figures("at rest, to the first answer", &mut rested);
    tell(&format!(
        "  none lost, none twice; {compared} hashes and snapshots like those of offline runs; {others} interruptions at servers \
         that were well; {older} samples of an older revision"
    ));
}

/// Waits until the sessions of the server that fails are back at others. Tells how long that took for those under
/// touch and at rest, s.
async fn until_back(
    ward: &Ward,
    at: usize,
    its: &[String],
    begun: Instant,
    before: &BTreeMap<String, u64>,
) -> (Vec<f64>, Vec<f64>) {
    let pressed: Vec<&Follower> = ward.followers.iter().filter(|follower| its.contains(&follower.id)).collect();
    let mut gone: BTreeSet<&String> =
        its.iter().filter(|id| pressed.iter().all(|follower| follower.id != **id)).collect();
    let mut rested = Vec::new();
    until("all sessions are back", async || {
        if !gone.is_empty() {
            for (_, node) in ward.nodes.iter().enumerate().filter(|node| node.0 != at) {
                for id in node.served().await.unwrap_or_default() {
                    if gone.remove(&id) {
                        rested.push(begun.elapsed().as_secs_f64());
                    }
                }
            }
        }
        gone.is_empty() && pressed.iter().all(|follower| follower.back_since(begun).is_some_and(|back| back.node != at))
    })
    .await;
    let mut touched = Vec::new();
    for follower in pressed {
        let back = follower.back_since(begun).unwrap();
        assert!(back.step >= before[&follower.id], "durable input is lost: {} {back:?}", before[&follower.id]);
        touched.push((back.acts - begun).as_secs_f64());
    }
    (touched, rested)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 3)]
async fn etcds_leader_is_killed() {
    if !EtcdMembers::is_there() {
        return;
    }
    let _turn = FLEETS.acquire().await.unwrap();
    let (leaders, sessions) = (number("PALPATE_FLEET_LEADERS", 2), number("PALPATE_FLEET_SESSIONS", 3));
    let mut etcd = EtcdMembers::start(3);
    let ward = Ward::open(&vec![etcd.endpoints(); 3], sessions, 4, 0).await;
    let before = ward.until_well().await;
    ward.followers.iter().for_each(Follower::forget_silence);
    for round in 1..=leaders {
        let mut leader = None;
        until("etcd has a leader", async || {
            leader = etcd.leader();
            leader.is_some()
        })
        .await;
        let leader = leader.unwrap();
        let begun = Instant::now();
        etcd.kill(leader);
        until("another leads", async || etcd.leader().is_some_and(|other| other != leader)).await;
        let led_s = begun.elapsed().as_secs_f64();
        // A server that would lose its lease loses it now.
        tokio::time::sleep(Duration::from_secs_f64(2.0 * TTL_S).saturating_sub(begun.elapsed())).await;
        tokio::task::block_in_place(|| {
            etcd.restart(leader);
            etcd.wait();
        });
        ward.until_well().await;
        eprintln!("leader {round} of {leaders}: another leads after {led_s:.2} s");
    }
    let after = ward.until_well().await;
    for (id, own) in &after {
        assert_eq!((&own.node, own.revision), (&before[id].node, before[id].revision), "a session has moved");
    }
    ward.is_each_there_once().await;
    let seen = ward.close().await;
    let longest = seen.iter().map(|seen| seen.longest_silence.as_secs_f64()).fold(0.0, f64::max);
    let interrupted: usize = seen.iter().map(|seen| seen.returns.len()).sum();
    tell(&format!(
        "EtcdMembers's leader: killed {leaders} times, {sessions} sessions; none has moved, no revision has changed; {interrupted} streams \
         were interrupted, the longest silence of a client was {longest:.3} s"
    ));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 3)]
#[ignore = "takes a minute: make chaos"]
async fn etcd_is_gone() {
    if !EtcdMembers::is_there() {
        return;
    }
    let _turn = FLEETS.acquire().await.unwrap();
    let (gone_s, sessions) = (number("PALPATE_FLEET_GONE_S", 60), number("PALPATE_FLEET_SESSIONS", 3));
    let mut etcd = EtcdMembers::start(3);
    let ward = Ward::open(&vec![etcd.endpoints(); 3], sessions, 1, 3).await;
    let before = ward.until_well().await;
    // Holds a tool, and does not come back by itself.
    let held = ward.ids.last().unwrap();
    let holder = ward.nodes.iter().find(|node| node.name == before[held].node).unwrap();
    let mut touch = TestTouch::hold(holder.there(), held).await;
    touch.command(force(0, 1, -0.1)).await;
    touch.sample_with(|sample| sample.tools.first().is_some_and(|tool| tool.acknowledged_sequence == 1)).await;
    etcd.stop_all();
    // No keepalive was sent later than this.
    let stopped = Instant::now();
    let refused = loop {
        if let Err(refused) = touch.hear().await {
            break refused;
        }
    };
    assert!(is_fenced(&refused), "{refused}");
    until("calls are refused", async || {
        for (id, own) in &before {
            let owner = ward.nodes.iter().find(|node| node.name == own.node).unwrap();
            if !owner.session(id).await.is_err_and(|refused| is_fenced(&refused)) {
                return false;
            }
        }
        true
    })
    .await;
    let refused_s = stopped.elapsed().as_secs_f64();
    let last_step: Vec<u64> = ward.followers.iter().map(|f| f.seen().newest_step).collect();
    tokio::time::sleep(Duration::from_secs(gone_s).saturating_sub(stopped.elapsed())).await;
    assert!(ward.followers.iter().all(|follower| !follower.acts()), "no server may answer for a session");
    let starting = Instant::now();
    (0..3).for_each(|member| etcd.restart(member));
    until("etcd has a leader", async || etcd.leader().is_some()).await;
    let returned = Instant::now();
    until("all go on", async || ward.followers.iter().all(|follower| follower.back_since(starting).is_some())).await;
    let mut back = Figures::default();
    for (follower, last_step) in ward.followers.iter().zip(last_step) {
        let returns = follower.back_since(starting).unwrap();
        assert_eq!(ward.nodes[returns.node].name, before[&follower.id].node, "it goes on in place");
        assert!(returns.revision >= before[&follower.id].revision);
        assert!(returns.step >= last_step, "state is kept: {} {last_step}", returns.step);
        // By the scene's rate, within the time in which it had a lease: as long as etcd was gone would be far more.
        let most = 1e3 * (TTL_S + (returns.acts - starting).as_secs_f64());
        let done = u32::try_from(returns.step - last_step).unwrap();
        assert!(f64::from(done) <= most, "{done} steps were done unseen");
        back.0.push((returns.acts - starting).as_secs_f64());
    }
    until("the tool is let go", async || holder.session(held).await.is_ok_and(|session| session.held_tools.is_empty()))
        .await;
    let after = ward.until_well().await;
    for (id, own) in &after {
        assert_eq!(own.node, before[id].node, "it goes on in place");
        let session = ward.nodes.iter().find(|node| node.name == own.node).unwrap().session(id).await.unwrap();
        assert_eq!(session.ownership.unwrap().revision, own.revision, "the answer equals etcd's record");
    }
    let stopped_s = ward.doors.seconds(stopped);
    let (starting_s, led_s) = (ward.doors.seconds(starting), (returned - starting).as_secs_f64());
    let seen = ward.close().await;
    let mut latest_s = f64::NEG_INFINITY;
    for stretch in seen.iter().flat_map(|seen| &seen.stretches) {
        // The newest keepalive was sent before etcd stopped.
        assert!(stretch.last_s < stopped_s + TTL_S || stretch.first_s > starting_s, "no lease is held: {stretch:?}");
        if stretch.first_s < starting_s {
            latest_s = latest_s.max(stretch.last_s - stopped_s);
        }
    }
    tell(&format!(
        "EtcdMembers gone for {gone_s} s: {} sessions; the last step was {latest_s:.2} s after it stopped, all calls were refused as FENCED \
         after {refused_s:.2} s; started again, etcd had a leader after {led_s:.2} s; all went on in place, their clients touched again \
         {:.2} s (median), {:.2} s (worst) after the start",
        before.len(),
        back.at(0.5),
        back.at(1.0)
    ));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn moves_under_a_tool() {
    if !EtcdMembers::is_there() {
        return;
    }
    let _turn = FLEETS.acquire().await.unwrap();
    let moves = number("PALPATE_FLEET_MOVES", 12);
    let mut random = TestRandom(number("PALPATE_FLEET_SEED", 1));
    let etcd = EtcdMembers::start(1);
    let folder = tempfile::tempdir().unwrap();
    let nodes = three(folder.path(), &etcd.endpoints()).await;
    let doors = Doors::of(&nodes);
    let session = create(&nodes[0]).await;
    let id = session.session_id;
    let follower = Follower::start(&doors, &id, 1);
    until("it touches", async || follower.acts()).await;
    let own = session.ownership.unwrap();
    let mut at = nodes.iter().position(|node| node.name == own.node).unwrap();
    let (mut gap_ms, mut still_ms, mut change_n) = (Figures::default(), Figures::default(), Figures::default());
    for index in 1..=moves {
        tokio::time::sleep(Duration::from_millis(200 + random.below(200))).await;
        let to = (at + 1 + usize::try_from(random.below(2)).unwrap()) % 3;
        let request = pb::MoveSessionRequest { session_id: id.clone(), node: nodes[to].name.clone() };
        let asked = Instant::now();
        let moved = nodes[at].admin().await.move_session(request).await.unwrap().into_inner();
        assert_eq!(moved.ownership.unwrap().node, nodes[to].name);
        still_ms.0.push(1e3 * moved.gap_s);
        until("touch goes on", async || follower.back_since(asked).is_some()).await;
        let back = follower.back_since(asked).unwrap();
        assert_eq!(back.node, to);
        gap_ms.0.push(1e3 * (back.first - back.last).as_secs_f64());
        assert!(back.change_n <= 0.1, "the force jumps by {} N", back.change_n);
        change_n.0.push(back.change_n);
        goes_on(&nodes, &id, &nodes[to], false).await;
        at = to;
        if index % 10 == 0 {
            eprintln!("{index} of {moves} moves");
        }
    }
    let seen = follower.end().await;
    seen.check();
    assert_eq!(seen.returns.len(), usize::try_from(moves).unwrap(), "a tool was let go");
    // All is on the disks when the servers have ended.
    let mut nodes = nodes;
    nodes.iter_mut().for_each(Node::end);
    let mut runs: Vec<_> = nodes.iter().flat_map(|node| node.runs(&id)).map(|file| (file.run, file.path)).collect();
    runs.sort();
    let compared = stayed::compare(&runs.into_iter().map(|run| run.1).collect::<Vec<_>>());
    tell(&format!(
        "Moves under a tool: {moves}; touch was interrupted for {:.1} ms (p50), {:.1} ms (p99), {:.1} ms (worst), the session stood for \
         {:.1} ms (p50), {:.1} ms (p99)\n  the force changed by at most {:.4} N over a move, by at most {:.4} N from step to step \
         otherwise; {compared} hashes and snapshots like those of a session that stayed",
        gap_ms.at(0.5),
        gap_ms.at(0.99),
        gap_ms.at(1.0),
        still_ms.at(0.5),
        still_ms.at(0.99),
        change_n.at(1.0),
        seen.steady_change_n
    ));
}
