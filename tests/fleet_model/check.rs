//! What must hold of every history.

use std::collections::BTreeMap;

use crate::broken::Broken;
use crate::world::{ModelEvent, ModelSample, World};
use crate::{N, Ns, S};

/// What is known of a session from outside.
#[derive(Debug, Clone, Default)]
pub(crate) struct Truth {
    /// So many of its inputs were called durable.
    pub(crate) durable: Option<u64>,
    pub(crate) to_be_deleted: bool,
    pub(crate) deleted: bool,
    pub(crate) claims: u32,
    /// The first time it acted since faults stopped.
    pub(crate) acted: Option<Ns>,
    client: ClientState,
}

#[derive(Debug, Clone, Default)]
struct ClientState {
    revision: u64,
    node: N,
    durable: u64,
    claims: u32,
}

#[derive(Debug, Default)]
pub(crate) struct Check {
    pub(crate) violation: Option<String>,
    pub(crate) sessions: BTreeMap<S, Truth>,
}

impl Check {
    pub(crate) fn fail(&mut self, what: String) {
        self.violation.get_or_insert(what);
    }

    fn of(&mut self, sid: S) -> &mut Truth {
        self.sessions.entry(sid).or_default()
    }

    /// A node can act for it.
    pub(crate) fn acts(&mut self, sid: S, now: Ns) {
        let truth = self.of(sid);
        truth.acted.get_or_insert(now);
        if truth.deleted {
            self.fail(format!("s{sid} was deleted, and has come back"));
        }
    }

    pub(crate) fn is_to_be_deleted(&mut self, sid: S) {
        self.of(sid).to_be_deleted = true;
    }

    pub(crate) fn is_deleted(&mut self, sid: S) {
        self.of(sid).deleted = true;
    }

    /// The standby claimed it while only one disk counts: it continues from there.
    pub(crate) fn may_lose(&mut self, sid: S, count: u64) {
        let truth = self.of(sid);
        truth.durable = truth.durable.min(Some(count));
        truth.claims += 1;
    }

    /// A node speaks for it.
    fn speaks(&mut self, sample: &ModelSample) {
        let ModelSample { sid, node, count, durable, .. } = *sample;
        let truth = self.of(sid);
        if let Some(before) = truth.durable.filter(|before| count < *before) {
            self.fail(format!("s{sid} has {count} inputs on n{node}, but {before} were durable"));
            return;
        }
        truth.durable = truth.durable.max(durable);
    }
}

impl World {
    /// A session does a step, and says so.
    pub(crate) fn tick(&mut self, n: N, sid: S, run: u32) {
        let Some(live) = self.nodes[n].memory.live.get(&sid).filter(|live| live.run == run) else { return };
        let mut rests = live.rests;
        if self.nodes[n].can_act(self.now, sid) {
            if self.rng.f64() < 0.03 {
                rests = !rests;
            }
            let on_two = self.on_two;
            let durable = self.nodes[n].durable(sid, on_two);
            let claims = self.check.sessions.get(&sid).map_or(0, |truth| truth.claims);
            let Some(live) = self.nodes[n].memory.live.get_mut(&sid) else { return };
            live.rests = rests;
            live.count += u64::from(!rests);
            let (count, revision) = (live.count, live.revision);
            let sample = ModelSample { sid, node: n, revision, count, durable, claims };
            self.check.speaks(&sample);
            let late = self.between(1, 250);
            self.at(self.now + late, ModelEvent::Sample(sample));
            if !rests {
                let write = self.between(10, 40);
                self.timer(n, write, crate::world::Timer::Write(sid, run));
            }
        }
        let next = self.between(200, 600);
        self.timer(n, next, crate::world::Timer::Tick(sid, run));
    }

    /// A client reads a sample.
    pub(crate) fn read(&mut self, sample: ModelSample) {
        let takes_all = self.is(Broken::ClientTakesAll);
        let Some(truth) = self.check.sessions.get_mut(&sample.sid) else { return };
        let client = &mut truth.client;
        if sample.revision < client.revision && !takes_all {
            self.counts.dropped += 1;
            return;
        }
        let mut fault = None;
        if sample.revision < client.revision {
            fault = Some(format!("revision {} after {}", sample.revision, client.revision));
        } else if sample.revision == client.revision && sample.node != client.node {
            fault = Some(format!("n{} and n{} at one revision", sample.node, client.node));
        }
        if sample.claims > client.claims && !self.on_two {
            client.durable = 0;
        }
        if sample.claims == client.claims && sample.count < client.durable {
            fault = Some(format!("{} inputs after {} durable ones", sample.count, client.durable));
        }
        (client.revision, client.node) = (sample.revision, sample.node);
        client.claims = client.claims.max(sample.claims);
        client.durable = client.durable.max(sample.durable.unwrap_or_default());
        if let Some(fault) = fault {
            self.check.fail(format!("the client of s{} has read {fault}", sample.sid));
        }
    }
}
