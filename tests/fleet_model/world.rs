//! Virtual time: what happens next, the network, and calls to etcd.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap, VecDeque};

use palpate_cluster::etcd::{KeyValue, TransactionOutcome, Txn};
use palpate_cluster::key::Keys;

use crate::broken::Broken;
use crate::check::Check;
use crate::faults::{FaultCounts, ModelFault};
use crate::node::{Memory, ModelNode};
use crate::store::{Change, Store};
use crate::{MS, N, Ns, S, TTL_S};

/// A member of etcd that has not answered within this time is given up.
const ETCD_TIMEOUT: Ns = 1_000 * MS;

#[derive(Debug, Clone)]
pub(crate) enum ModelEvent {
    Node(N, u32, NodeInput),
    Etcd(N, u32, u64, Ask),
    Expire(i64),
    Sample(ModelSample),
    Fault(ModelFault),
}

/// What a client reads.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ModelSample {
    pub(crate) sid: S,
    pub(crate) node: N,
    pub(crate) revision: u64,
    pub(crate) count: u64,
    pub(crate) durable: Option<u64>,
    /// How often the session had gone on elsewhere from a journal.
    pub(crate) claims: u32,
}

#[derive(Debug, Clone)]
pub(crate) enum Ask {
    Grant,
    KeepAlive(i64),
    Get(String),
    List(String),
    Txn(Txn),
    /// Number of the watch, and the revision it is from.
    Watch(u64, u64),
}

#[derive(Debug, Clone)]
pub(crate) enum ModelAnswer {
    Lease(Option<i64>),
    Got(Option<KeyValue>),
    Listed(Vec<KeyValue>, u64),
    Done(TransactionOutcome),
    Refused,
    Unreachable,
    Unknown,
}

/// What a node hears.
#[derive(Debug, Clone)]
pub(crate) enum NodeInput {
    Timer(Timer),
    Answer(u64, ModelAnswer),
    Timeout(u64),
    Watch(u64, Change),
    WatchLost(u64),
    Peer(N, u64, Say),
    /// A stream has ended.
    End(u64),
}

#[derive(Debug, Clone, Copy)]
pub(crate) enum Timer {
    Join,
    OwnResumed,
    KeepAlive,
    Register,
    TakeBack(S),
    TakeOver,
    Look,
    Tell,
    ListNodes,
    Settle,
    Tick(S, u32),
    Write(S, u32),
    GoOn(S, u64),
    Prepared(u64),
    Standstill(u64),
    Certain(u64),
    Held(u64),
}

#[derive(Debug, Clone, Copy)]
pub(crate) enum Move {
    First,
    Last,
}

/// Messages between nodes.
#[derive(Debug, Clone)]
pub(crate) enum Say {
    Open,
    Has(Vec<(S, u32, u64)>),
    /// Session, run, from and to which byte.
    Part(S, u32, u64, u64),
    Confirm(S, u32, u64),
    /// Confirmed with no bytes.
    Forget(S),
    State(S, Move, u64, u32, u64),
    Stated(Move),
    TakeOver(u64),
    Close,
}

/// Why a session's key is changed.
#[derive(Debug, Clone, Copy)]
pub(crate) enum KeyChange {
    Born,
    Deleted,
    TakenBack,
    Named(N, u64),
    Claimed,
    OwnKept,
    Settled,
    Regained,
    Handed(u64),
    Fixed(u64),
}

/// The step with which a node continues when it gets an answer.
#[derive(Debug, Clone)]
pub(crate) enum Then {
    KeptAlive(Ns),
    Granted,
    SeenOwnKey(i64),
    Registered(i64),
    Checked(i64),
    ListedFirst,
    Listed,
    Watching,
    Told,
    ToldChecked,
    Txn(S, KeyChange),
    Resolve(S, KeyChange, bool),
    Own(S),
    Claim(S),
    Certain(u64),
    Held(u64),
    Settling,
}

pub(crate) struct World {
    pub(crate) now: Ns,
    pub(crate) rng: fastrand::Rng,
    pub(crate) broken: Broken,
    pub(crate) on_two: bool,
    pub(crate) keys: Keys,
    pub(crate) store: Store,
    pub(crate) nodes: Vec<ModelNode>,
    pub(crate) check: Check,
    pub(crate) counts: FaultCounts,
    queue: BinaryHeap<Reverse<(Ns, u64)>>,
    events: BTreeMap<u64, ModelEvent>,
    next: u64,
    pub(crate) etcd_is_down: bool,
    /// The round of faults, and when its faults stopped.
    pub(crate) round: u32,
    pub(crate) round_begun: Ns,
    pub(crate) chaos_ends: Ns,
    /// Faults are made now.
    pub(crate) is_chaos: bool,
    pub(crate) cut: BTreeSet<(N, N)>,
    watches: Vec<(N, u32, u64)>,
    pub(crate) doomed: BTreeSet<u64>,
    arrives: BTreeMap<(u64, N), Ns>,
    /// The two ends of each stream; the first has opened it.
    pub(crate) opened: BTreeMap<u64, (N, N)>,
    pub(crate) log: VecDeque<(Ns, String)>,
    pub(crate) ids: Vec<String>,
}

/// In the place of a node, etcd.
pub(crate) const ETCD: N = usize::MAX;

impl World {
    pub(crate) fn new(seed: u64, broken: Broken, on_two: bool) -> Self {
        let mut rng = fastrand::Rng::with_seed(seed);
        let count = rng.usize(3..=5);
        let off = if broken == Broken::Clocks { 0.3 } else { 0.05 };
        let node = |index: usize| ModelNode {
            name: format!("n{index}"),
            rate: 1.0 + off * (2.0 * rng.f64() - 1.0),
            offset: rng.u64(0..1_000_000 * MS),
            up: false,
            serving: false,
            paused: false,
            held: Vec::new(),
            epoch: 0,
            folder: BTreeMap::new(),
            kept: BTreeMap::new(),
            memory: Memory::default(),
        };
        let nodes: Vec<ModelNode> = (0..count).map(node).collect();
        World {
            now: 0,
            rng,
            broken,
            on_two,
            keys: Keys::of("f").unwrap(),
            store: Store::default(),
            nodes,
            check: Check::default(),
            counts: FaultCounts::default(),
            queue: BinaryHeap::new(),
            events: BTreeMap::new(),
            next: 0,
            etcd_is_down: false,
            round: 0,
            round_begun: 0,
            chaos_ends: 0,
            is_chaos: false,
            cut: BTreeSet::new(),
            watches: Vec::new(),
            doomed: BTreeSet::new(),
            arrives: BTreeMap::new(),
            opened: BTreeMap::new(),
            log: VecDeque::new(),
            ids: Vec::new(),
        }
    }

    pub(crate) fn is(&self, broken: Broken) -> bool {
        self.broken == broken
    }

    pub(crate) fn number(&mut self) -> u64 {
        self.next += 1;
        self.next
    }

    pub(crate) fn note(&mut self, text: impl FnOnce() -> String) {
        if self.log.len() >= 400 {
            self.log.pop_front();
        }
        self.log.push_back((self.now, text()));
    }

    pub(crate) fn at(&mut self, time: Ns, event: ModelEvent) {
        let number = self.number();
        self.queue.push(Reverse((time.max(self.now), number)));
        self.events.insert(number, event);
    }

    /// A node is woken after what its clock calls `ns`.
    pub(crate) fn timer(&mut self, n: N, ns: Ns, timer: Timer) {
        let (time, epoch) = (self.now + self.nodes[n].lasting(ns), self.nodes[n].epoch);
        self.at(time, ModelEvent::Node(n, epoch, NodeInput::Timer(timer)));
    }

    pub(crate) fn between(&mut self, from_ms: u64, to_ms: u64) -> Ns {
        self.rng.u64(from_ms * MS..=to_ms * MS)
    }

    pub(crate) fn chance(&mut self, share: f64) -> bool {
        self.rng.f64() < share
    }

    /// A delay of the network.
    fn delay(&mut self) -> Ns {
        if self.is_chaos && self.chance(0.01) { self.between(10, 600) } else { self.rng.u64(MS / 4..8 * MS) }
    }

    pub(crate) fn is_cut(&self, a: N, b: N) -> bool {
        !self.cut.is_empty() && (self.cut.contains(&(a, b)) || self.cut.contains(&(b, a)))
    }

    /// Goes on until `end`, or until a check fails.
    pub(crate) fn run(&mut self, end: Ns) {
        while let Some(Reverse((time, number))) = self.queue.peek().copied() {
            if time > end || self.check.violation.is_some() {
                break;
            }
            self.queue.pop();
            self.now = time;
            if let Some(event) = self.events.remove(&number) {
                self.happen(event);
            }
        }
        self.now = self.now.max(end);
    }

    fn happen(&mut self, event: ModelEvent) {
        match event {
            ModelEvent::Node(n, epoch, input) if self.nodes[n].epoch != epoch || !self.nodes[n].up => {
                if let NodeInput::Peer(_, stream, _) = input {
                    self.doom(stream);
                }
            }
            ModelEvent::Node(n, ..) if self.nodes[n].paused => self.nodes[n].held.push(event),
            ModelEvent::Node(n, _, input) => {
                self.hear(n, input);
                self.check_owners(n);
            }
            ModelEvent::Etcd(from, epoch, call, ask) => self.etcd(from, epoch, call, ask),
            ModelEvent::Expire(lease) => self.expire(lease),
            ModelEvent::Sample(sample) => self.read(sample),
            ModelEvent::Fault(fault) => self.fault(fault),
        }
    }

    /// At no instant can two nodes act for one session.
    pub(crate) fn check_owners(&mut self, n: N) {
        let me = &self.nodes[n];
        for sid in me.memory.live.keys() {
            if !me.can_act(self.now, *sid) {
                continue;
            }
            self.check.acts(*sid, self.now);
            let other = |(m, node): &(usize, &ModelNode)| *m != n && node.can_act(self.now, *sid);
            if let Some((m, _)) = self.nodes.iter().enumerate().find(other) {
                self.check.fail(format!("n{n} and n{m} can act for s{sid} at once"));
                return;
            }
        }
    }

    /// Asks etcd.
    pub(crate) fn ask(&mut self, n: N, ask: Ask, then: Then) {
        let call = self.number();
        let is_txn = matches!(ask, Ask::Txn(_));
        self.nodes[n].memory.calls.insert(call, (then, is_txn));
        let epoch = self.nodes[n].epoch;
        if (self.etcd_is_down || self.is_cut(n, ETCD)) && self.chance(0.3) {
            let answer = ModelEvent::Node(n, epoch, NodeInput::Answer(call, ModelAnswer::Unreachable));
            return self.at(self.now + 2 * MS, answer);
        }
        let patience = self.now + self.nodes[n].lasting(ETCD_TIMEOUT);
        self.at(patience, ModelEvent::Node(n, epoch, NodeInput::Timeout(call)));
        // It waits in etcd, or on the way there, and is done even when no node waits for it.
        let is_late = is_txn && self.is_chaos && self.now + 7_000 * MS < self.chaos_ends && self.chance(0.02);
        let delay = if is_late { self.between(900, 6_000) } else { self.delay() };
        if is_late {
            self.note(|| format!("n{n} a transaction is late by {} ms", delay / MS));
        }
        if !self.is_cut(n, ETCD) {
            self.at(self.now + delay, ModelEvent::Etcd(n, epoch, call, ask));
        }
    }

    fn etcd(&mut self, n: N, epoch: u32, call: u64, ask: Ask) {
        if self.etcd_is_down {
            return;
        }
        let before = self.store.history.len();
        let ttl = TTL_S * 1_000 * MS;
        let answer = match ask {
            Ask::Grant => {
                let lease = self.store.grant(self.now + ttl);
                let late = self.between(0, 600);
                self.at(self.now + ttl + late, ModelEvent::Expire(lease));
                ModelAnswer::Lease(Some(lease))
            }
            Ask::KeepAlive(lease) => ModelAnswer::Lease(self.store.keep_alive(lease, self.now + ttl).then_some(lease)),
            Ask::Get(key) => ModelAnswer::Got(self.store.get(&key)),
            Ask::List(prefix) => ModelAnswer::Listed(self.store.list(&prefix), self.store.revision),
            Ask::Txn(txn) => {
                self.counts.transactions += 1;
                self.store.transact(&txn).map_or(ModelAnswer::Refused, ModelAnswer::Done)
            }
            Ask::Watch(watch, from) => {
                self.watches.retain(|(node, ..)| *node != n);
                self.watches.push((n, epoch, watch));
                let newer = self.store.history.iter().filter(|change| change.revision >= from).cloned();
                for change in newer.collect::<Vec<_>>() {
                    self.tell_watch(n, epoch, watch, change);
                }
                return;
            }
        };
        self.tell_watches(before);
        let is_lost = self.is_chaos && self.chance(0.01);
        if !is_lost && !self.is_cut(n, ETCD) {
            let delay = self.delay();
            self.at(self.now + delay, ModelEvent::Node(n, epoch, NodeInput::Answer(call, answer)));
        }
    }

    fn expire(&mut self, lease: i64) {
        let Some(until) = self.store.until(lease) else { return };
        if self.etcd_is_down {
            return self.at(self.now + 100 * MS, ModelEvent::Expire(lease));
        }
        if until > self.now {
            let late = self.between(0, 600);
            return self.at(until + late, ModelEvent::Expire(lease));
        }
        let before = self.store.history.len();
        self.store.end(lease);
        self.note(|| format!("etcd: lease {lease} has ended"));
        self.tell_watches(before);
    }

    fn tell_watches(&mut self, from: usize) {
        let prefix = self.keys.nodes();
        for index in from..self.store.history.len() {
            let change = self.store.history[index].clone();
            if change.key.starts_with(&prefix) {
                for (n, epoch, watch) in self.watches.clone() {
                    self.tell_watch(n, epoch, watch, change.clone());
                }
            }
        }
        // Sessions are not watched.
        let length = self.store.history.len();
        if length > 2_000 {
            self.store.history.drain(..length - 1_000);
        }
    }

    fn tell_watch(&mut self, n: N, epoch: u32, watch: u64, change: Change) {
        if !change.key.starts_with(&self.keys.nodes()) {
            return;
        }
        if self.is_cut(n, ETCD) {
            return self.lose_watch(n);
        }
        let delay = self.delay();
        let time = self.in_order(watch, n, self.now + delay);
        self.at(time, ModelEvent::Node(n, epoch, NodeInput::Watch(watch, change)));
    }

    /// A node's watch is gone; it notices some time later.
    pub(crate) fn lose_watch(&mut self, n: N) {
        let Some(at) = self.watches.iter().position(|(node, ..)| *node == n) else { return };
        let (_, epoch, watch) = self.watches.remove(at);
        let late = self.between(500, 2_000);
        self.at(self.now + late, ModelEvent::Node(n, epoch, NodeInput::WatchLost(watch)));
    }

    fn in_order(&mut self, stream: u64, to: N, time: Ns) -> Ns {
        let last = self.arrives.entry((stream, to)).or_default();
        *last = time.max(*last + 1);
        *last
    }

    /// A message to another node, in a stream that `client` has opened.
    pub(crate) fn say(&mut self, from: N, to: N, stream: u64, say: Say) {
        self.say_after(from, to, stream, say, 0);
    }

    pub(crate) fn say_after(&mut self, from: N, to: N, stream: u64, say: Say, ns: Ns) {
        if self.doomed.contains(&stream) {
            return;
        }
        if !self.nodes[to].up || self.is_cut(from, to) {
            return self.doom(stream);
        }
        let delay = self.delay();
        let time = self.in_order(stream, to, self.now + ns + delay);
        let epoch = self.nodes[to].epoch;
        self.at(time, ModelEvent::Node(to, epoch, NodeInput::Peer(from, stream, say)));
    }

    /// Breaks a stream. Its opener notices by a keepalive of 1 s, the other end by one of 10 s; both at once if the
    /// other has died.
    pub(crate) fn doom(&mut self, stream: u64) {
        let Some((client, server)) = self.opened.get(&stream).copied() else { return };
        if !self.doomed.insert(stream) {
            return;
        }
        for (n, m, from_ms, to_ms) in [(client, server, 1_000, 2_000), (server, client, 10_000, 20_000)] {
            let is_told = !self.nodes[m].up && !self.is_cut(n, m);
            let late = if is_told { self.between(1, 5) } else { self.between(from_ms, to_ms) };
            let epoch = self.nodes[n].epoch;
            self.at(self.now + late, ModelEvent::Node(n, epoch, NodeInput::End(stream)));
        }
    }

    /// A new stream to another node.
    pub(crate) fn open(&mut self, client: N, server: N) -> u64 {
        let stream = self.number();
        self.opened.insert(stream, (client, server));
        stream
    }

    pub(crate) fn is_watching(&self, n: N, watch: u64) -> bool {
        self.watches.iter().any(|(node, epoch, of)| (*node, *epoch, *of) == (n, self.nodes[n].epoch, watch))
    }

    pub(crate) fn id(&self, sid: S) -> &str {
        &self.ids[sid]
    }

    pub(crate) fn key(&self, sid: S) -> String {
        self.keys.session(&self.ids[sid])
    }
}
