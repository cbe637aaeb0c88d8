//! What goes wrong, and when; and what must hold some time after it has stopped.

use palpate_cluster::key::{SessionValue, decode};
use palpate_cluster::placement;

use crate::broken::Broken;
use crate::node::{Memory, WHOLE};
use crate::world::{ETCD, ModelEvent, NodeInput, World};
use crate::{BOUND, MS, N, Ns, S};

#[derive(Debug, Clone, Copy)]
pub(crate) enum ModelFault {
    /// A node begins, if it still waits since that crash.
    Start(N, u32),
    Resume(N, u32),
    Heal(N, N, u32),
    EtcdBack(u32),
    /// An end gives up a stream after a long silence.
    Silence(u64, N, u32),
}

/// What a run has had.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct FaultCounts {
    pub(crate) seeds: u64,
    pub(crate) seconds: u64,
    pub(crate) crashes: u64,
    pub(crate) pauses: u64,
    pub(crate) partitions: u64,
    pub(crate) outages: u64,
    pub(crate) created: u64,
    pub(crate) deleted: u64,
    pub(crate) claims: u64,
    pub(crate) take_backs: u64,
    pub(crate) moves: u64,
    pub(crate) transactions: u64,
    pub(crate) dropped: u64,
    /// The longest without an owner after faults stopped, ns.
    pub(crate) longest: Ns,
}

impl FaultCounts {
    pub(crate) fn add(&mut self, other: &FaultCounts) {
        let sums = [
            (&mut self.seeds, other.seeds),
            (&mut self.seconds, other.seconds),
            (&mut self.crashes, other.crashes),
            (&mut self.pauses, other.pauses),
            (&mut self.partitions, other.partitions),
            (&mut self.outages, other.outages),
            (&mut self.created, other.created),
            (&mut self.deleted, other.deleted),
            (&mut self.claims, other.claims),
            (&mut self.take_backs, other.take_backs),
            (&mut self.moves, other.moves),
            (&mut self.transactions, other.transactions),
            (&mut self.dropped, other.dropped),
        ];
        sums.into_iter().for_each(|(sum, more)| *sum += more);
        self.longest = self.longest.max(other.longest);
    }
}

/// Duration of the faults, and of the time without faults that follows.
const CHAOS: Ns = 40_000 * MS;
const CALM: Ns = 16_000 * MS;

/// Sessions of a fleet.
const SESSIONS: usize = 5;

impl World {
    pub(crate) fn crash(&mut self, n: N) {
        if !self.nodes[n].up {
            return;
        }
        self.note(|| format!("n{n} crashes"));
        let mut streams = self.streams(n);
        let node = &mut self.nodes[n];
        // What came while it was paused is lost with it.
        streams.extend(node.held.iter().filter_map(|event| match event {
            ModelEvent::Node(_, _, NodeInput::Peer(_, stream, _)) => Some(*stream),
            _ => None,
        }));
        (node.up, node.serving, node.paused) = (false, false, false);
        node.memory = Memory::default();
        node.held.clear();
        streams.into_iter().for_each(|stream| self.doom(stream));
    }

    pub(crate) fn fault(&mut self, fault: ModelFault) {
        match fault {
            ModelFault::Start(n, epoch) if self.nodes[n].epoch == epoch && !self.nodes[n].up => self.start(n),
            ModelFault::Resume(n, epoch) if self.nodes[n].epoch == epoch => self.resume(n),
            ModelFault::Heal(a, b, round) if self.round == round => {
                self.note(|| format!("n{a} and {b} reach each other again"));
                self.cut.remove(&(a, b));
            }
            ModelFault::EtcdBack(round) if self.round == round => self.etcd_back(),
            ModelFault::Silence(stream, n, epoch) if self.nodes[n].epoch == epoch && self.nodes[n].paused => {
                self.doom(stream);
            }
            _ => {}
        }
    }

    fn pause(&mut self, n: N) {
        if !self.nodes[n].up || self.nodes[n].paused {
            return;
        }
        self.counts.pauses += 1;
        let long = if self.chance(0.5) { self.between(50, 3_000) } else { self.between(1_000, 14_000) };
        self.note(|| format!("n{n} is paused for {} ms", long / MS));
        self.nodes[n].paused = true;
        let epoch = self.nodes[n].epoch;
        for stream in self.streams(n) {
            let opener = self.opened.get(&stream).map(|opened| opened.0);
            let late = if opener == Some(n) { self.between(10_000, 20_000) } else { self.between(1_000, 2_000) };
            self.at(self.now + late, ModelEvent::Fault(ModelFault::Silence(stream, n, epoch)));
        }
        self.at(self.now + long, ModelEvent::Fault(ModelFault::Resume(n, epoch)));
    }

    fn resume(&mut self, n: N) {
        if !std::mem::replace(&mut self.nodes[n].paused, false) {
            return;
        }
        self.note(|| format!("n{n} goes on after a pause"));
        self.check_owners(n);
        for event in std::mem::take(&mut self.nodes[n].held) {
            self.at(self.now, event);
        }
    }

    fn etcd_back(&mut self) {
        self.etcd_is_down = false;
        self.note(|| "etcd is back".to_owned());
        if self.chance(0.5) {
            let until = self.now + crate::TTL_S * 1_000 * MS;
            self.store.extend_all(until);
        }
    }

    /// One thing goes wrong, or somebody does something.
    fn make_fault(&mut self) {
        let n = self.rng.usize(0..self.nodes.len());
        let m = self.rng.usize(0..self.nodes.len());
        let round = self.round;
        match self.rng.u32(0..100) {
            0..14 => {
                if self.nodes[n].up {
                    self.counts.crashes += 1;
                    self.crash(n);
                    let long = if self.chance(0.5) { self.between(100, 2_000) } else { self.between(1_000, 20_000) };
                    let epoch = self.nodes[n].epoch;
                    self.at(self.now + long, ModelEvent::Fault(ModelFault::Start(n, epoch)));
                }
            }
            14..26 => self.pause(n),
            26..38 => {
                let to = if self.chance(0.5) || n == m { ETCD } else { m };
                if self.nodes.len() > n && self.cut.insert((n, to)) {
                    self.counts.partitions += 1;
                    self.note(|| format!("n{n} and {to} are cut"));
                    if to == ETCD {
                        self.lose_watch(n);
                    } else {
                        let both = |stream: &(N, N)| *stream == (n, to) || *stream == (to, n);
                        let cut: Vec<u64> =
                            self.streams(n).into_iter().filter(|id| self.opened.get(id).is_some_and(both)).collect();
                        cut.into_iter().for_each(|stream| self.doom(stream));
                    }
                    let long = self.between(200, 15_000);
                    self.at(self.now + long, ModelEvent::Fault(ModelFault::Heal(n, to, round)));
                }
            }
            38..42 => {
                if !self.etcd_is_down {
                    self.counts.outages += 1;
                    self.note(|| "etcd is down".to_owned());
                    self.etcd_is_down = true;
                    (0..self.nodes.len()).for_each(|n| self.lose_watch(n));
                    let long = self.between(200, 9_000);
                    self.at(self.now + long, ModelEvent::Fault(ModelFault::EtcdBack(round)));
                }
            }
            42..46 => self.lose_watch(n),
            46..52 => self.delete_any(n),
            52..62 => self.create_missing(),
            _ => {
                if let Some(sid) = self.any_session(n) {
                    self.move_session(n, sid, m);
                }
            }
        }
    }

    fn any_session(&mut self, n: N) -> Option<S> {
        let now = self.now;
        let node = &self.nodes[n];
        let sessions: Vec<S> = node.memory.live.keys().copied().filter(|sid| node.can_act(now, *sid)).collect();
        self.rng.choice(sessions)
    }

    fn delete_any(&mut self, n: N) {
        if let Some(sid) = self.any_session(n) {
            self.delete(n, sid);
        }
    }

    fn create_missing(&mut self) {
        let there = self.store.list(&self.keys.sessions()).len();
        let serving: Vec<N> =
            (0..self.nodes.len()).filter(|n| self.nodes[*n].serving && !self.nodes[*n].paused).collect();
        if there < SESSIONS
            && let Some(n) = self.rng.choice(serving)
        {
            self.create(n);
        }
    }

    /// Everything goes well from now on; who is dead may stay so.
    fn calm(&mut self) {
        self.round += 1;
        (self.is_chaos, self.round_begun) = (false, self.now);
        self.note(|| "faults stop".to_owned());
        self.cut.clear();
        if self.etcd_is_down {
            self.etcd_back();
        }
        for n in 0..self.nodes.len() {
            self.resume(n);
            if !self.nodes[n].up {
                if self.chance(0.6) {
                    self.start(n);
                } else {
                    // It stays away.
                    self.nodes[n].epoch += 1;
                }
            }
        }
        self.check.sessions.values_mut().for_each(|truth| truth.acted = None);
        for n in 0..self.nodes.len() {
            self.check_owners(n);
        }
    }

    fn owners(&self) -> Vec<(S, SessionValue)> {
        let prefix = self.keys.sessions();
        let of = |found: &palpate_cluster::etcd::KeyValue| {
            let sid = self.ids.iter().position(|id| found.key.strip_prefix(&prefix) == Some(id))?;
            Some((sid, decode(&found.value)?))
        };
        self.store.list(&prefix).iter().filter_map(of).collect()
    }

    fn is_up(&self, name: &str) -> bool {
        self.node_of(name).is_some_and(|n| self.nodes[n].up)
    }

    fn actor(&self, sid: S) -> Option<N> {
        (0..self.nodes.len()).find(|n| self.nodes[*n].can_act(self.now, sid))
    }

    /// Some time after faults have stopped, every session that some node can continue has an owner.
    fn check_served(&mut self) {
        for (sid, value) in self.owners() {
            let can_go_on = self.is_up(&value.node) || self.is_up(&value.standby);
            let is_known =
                self.check.sessions.get(&sid).is_some_and(|truth| truth.durable.is_some() && !truth.to_be_deleted);
            if can_go_on && is_known && self.actor(sid).is_none() {
                let (node, standby) = (&value.node, &value.standby);
                self.check.fail(format!(
                    "nobody acts for s{sid} {} ms after faults stopped; etcd says node `{node}`, standby `{standby}`",
                    (self.now - self.round_begun) / MS
                ));
            }
        }
        let begun = self.round_begun;
        let acted = self.check.sessions.values().filter(|truth| !truth.to_be_deleted).filter_map(|truth| truth.acted);
        if let Some(last) = acted.max() {
            self.counts.longest = self.counts.longest.max(last - begun);
        }
    }

    /// Long after faults have stopped: etcd and the nodes agree, and every session has a standby if there is one.
    fn check_settled(&mut self) {
        let there = self.owners();
        for n in 0..self.nodes.len() {
            for sid in self.nodes[n].memory.live.keys().copied().collect::<Vec<S>>() {
                let owner = there.iter().find(|(of, _)| *of == sid).map(|(_, value)| &*value.node);
                if self.nodes[n].can_act(self.now, sid) && owner != Some(&self.nodes[n].name) {
                    self.check.fail(format!("n{n} acts for s{sid}, but etcd says {owner:?}"));
                }
            }
        }
        let known = self.check.sessions.clone();
        for (sid, truth) in known.iter().filter(|(_, truth)| truth.durable.is_some()) {
            let found = there.iter().find(|(of, _)| of == sid);
            let Some((_, value)) = found else {
                if !truth.to_be_deleted {
                    self.check.fail(format!("s{sid} has vanished from etcd"));
                }
                continue;
            };
            if truth.deleted {
                self.check.fail(format!("s{sid} is deleted, but still in etcd: {value:?}"));
            }
            let Some(n) = self.actor(*sid) else { continue };
            let wanted = placement::standby(self.id(*sid), &self.nodes[n].name, &self.nodes[n].memory.view);
            let Some(to) = wanted.and_then(|wanted| self.node_of(wanted)) else { continue };
            let run = self.nodes[n].memory.live[sid].run;
            let has = self.nodes[to].kept.get(sid).is_some_and(|kept| kept.run == run && kept.bytes >= WHOLE);
            if value.standby != self.nodes[to].name || !has {
                self.check.fail(format!(
                    "n{to} should stand by for s{sid} {} ms after faults stopped, but etcd says `{}`, and it has {:?} (run {run}); n{n}: {:?}",
                    (self.now - self.round_begun) / MS,
                    value.standby,
                    self.nodes[to].kept.get(sid),
                    self.nodes[n].memory.streams.get(&to)
                ));
            }
            if self.nodes[n].durable(*sid, self.on_two).is_none() {
                self.check.fail(format!("nothing of s{sid} is durable on n{n}"));
            }
        }
    }
}

/// A fleet through some rounds of faults.
pub(crate) fn simulate(seed: u64, broken: Broken, on_two: bool, rounds: u32) -> World {
    let mut world = World::new(seed, broken, on_two);
    (0..world.nodes.len()).for_each(|n| world.start(n));
    world.run(6_000 * MS);
    for _ in 0..SESSIONS {
        world.create_missing();
    }
    world.run(world.now + 2_000 * MS);
    for _ in 0..rounds {
        for n in 0..world.nodes.len() {
            if !world.nodes[n].up {
                world.start(n);
            }
        }
        (world.is_chaos, world.round) = (true, world.round + 1);
        world.chaos_ends = world.now + CHAOS;
        while world.now < world.chaos_ends && world.check.violation.is_none() {
            let next = world.between(100, 2_000);
            world.run(world.now + next);
            world.make_fault();
        }
        world.calm();
        world.run(world.now + BOUND);
        if world.check.violation.is_none() {
            world.check_served();
        }
        world.run(world.round_begun + CALM);
        if world.check.violation.is_none() {
            world.check_settled();
        }
        if world.check.violation.is_some() {
            break;
        }
    }
    world.counts.seeds = 1;
    world.counts.seconds = world.now / (1_000 * MS);
    world
}
