//! A node's lease and fence, who else is there, and what it takes back: as `src/server/fleet/member.rs` does it.

use palpate_cluster::etcd::{Compare, Op, Txn};
use palpate_cluster::key::{NodeValue, decode, encode};
use palpate_cluster::rules;

use crate::broken::Broken;
use crate::node::Memory;
use crate::store::Change;
use crate::world::{Ask, KeyChange, ModelAnswer, NodeInput, Then, Timer, World};
use crate::{MS, N, TTL_S};

const PAUSE: u64 = 100 * MS;
pub(crate) const LOOK: u64 = 500 * MS;

impl World {
    /// A process begins.
    pub(crate) fn start(&mut self, n: N) {
        let node = &mut self.nodes[n];
        node.epoch += 1;
        (node.up, node.serving, node.paused) = (true, false, false);
        node.memory = Memory::default();
        node.held.clear();
        node.memory.runs =
            node.folder.iter().filter_map(|(sid, files)| Some((*sid, *files.last_key_value()?.0))).collect();
        let since = node.clock(self.now);
        node.kept.values_mut().for_each(|kept| (kept.stream, kept.since) = (None, since));
        self.note(|| format!("n{n} begins"));
        self.timer(n, 0, Timer::Join);
    }

    pub(crate) fn hear(&mut self, n: N, input: NodeInput) {
        match input {
            NodeInput::Timer(timer) => self.wake(n, timer),
            NodeInput::Answer(call, answer) => {
                if let Some((then, _)) = self.nodes[n].memory.calls.remove(&call) {
                    self.go_on_with(n, then, answer);
                }
            }
            NodeInput::Timeout(call) => {
                if let Some((then, is_txn)) = self.nodes[n].memory.calls.remove(&call) {
                    self.go_on_with(n, then, if is_txn { ModelAnswer::Unknown } else { ModelAnswer::Unreachable });
                }
            }
            NodeInput::Watch(watch, change) if self.nodes[n].memory.watch == watch => self.see(n, &change),
            NodeInput::WatchLost(watch) if self.nodes[n].memory.watch == watch => self.wake(n, Timer::ListNodes),
            NodeInput::Watch(..) | NodeInput::WatchLost(_) => {}
            NodeInput::Peer(from, stream, say) => self.hear_peer(n, from, stream, say),
            NodeInput::End(stream) => self.stream_ended(n, stream),
        }
    }

    fn wake(&mut self, n: N, timer: Timer) {
        match timer {
            Timer::Join | Timer::Register => self.ask(n, Ask::Grant, Then::Granted),
            Timer::OwnResumed => self.begin(n),
            Timer::KeepAlive => {
                let (lease, sent) = (self.nodes[n].memory.lease, self.nodes[n].clock(self.now));
                self.ask(n, Ask::KeepAlive(lease), Then::KeptAlive(sent));
            }
            Timer::TakeBack(sid) => self.take_back(n, sid),
            Timer::TakeOver => {
                self.take_over(n);
                self.timer(n, LOOK, Timer::TakeOver);
            }
            Timer::Look => {
                self.mirror(n);
                self.timer(n, World::MIRROR_LOOK, Timer::Look);
            }
            Timer::Tell => {
                self.forget_the_deleted(n);
                self.tell(n);
                self.timer(n, 500 * MS, Timer::Tell);
            }
            Timer::ListNodes => {
                let prefix = self.keys.nodes();
                self.ask(n, Ask::List(prefix), Then::Listed);
            }
            Timer::Settle => {
                let prefix = self.keys.sessions();
                self.ask(n, Ask::List(prefix), Then::Settling);
            }
            Timer::Tick(sid, run) => self.tick(n, sid, run),
            Timer::Write(sid, run) => self.write(n, sid, run),
            Timer::GoOn(sid, revision) => self.go_on(n, sid, revision),
            Timer::Held(id) => self.hold(n, id),
            Timer::Prepared(id) => self.prepared(n, id),
            Timer::Standstill(id) => self.stood_too_long(n, id),
            Timer::Certain(id) => self.be_certain(n, id),
        }
    }

    fn go_on_with(&mut self, n: N, then: Then, answer: ModelAnswer) {
        match then {
            Then::KeptAlive(sent) => self.kept_alive(n, sent, &answer),
            Then::Granted => match answer {
                ModelAnswer::Lease(Some(lease)) => {
                    let key = self.keys.node(&self.nodes[n].name);
                    self.ask(n, Ask::Get(key), Then::SeenOwnKey(lease));
                }
                _ => self.not_registered(n),
            },
            Then::SeenOwnKey(lease) => match answer {
                ModelAnswer::Got(found) => {
                    let key = self.keys.node(&self.nodes[n].name);
                    let as_seen = found.map_or(Compare::Absent(key.clone()), |found| {
                        Compare::ModRevision(key.clone(), found.mod_revision)
                    });
                    let mut own = self.measure(n);
                    own.draining |= !self.nodes[n].serving;
                    let put = Op::Put { key, value: encode(&own), lease: Some(lease) };
                    let txn = Txn { if_all: vec![as_seen], then: vec![put], otherwise: vec![] };
                    self.ask(n, Ask::Txn(txn), Then::Registered(lease));
                }
                _ => self.not_registered(n),
            },
            Then::Registered(lease) => match answer {
                ModelAnswer::Done(outcome) if outcome.succeeded => self.registered(n, lease, outcome.revision),
                ModelAnswer::Unknown => {
                    let key = self.keys.node(&self.nodes[n].name);
                    self.ask(n, Ask::Get(key), Then::Checked(lease));
                }
                _ => self.not_registered(n),
            },
            Then::Checked(lease) => match answer {
                ModelAnswer::Got(Some(found)) if found.lease == lease => self.registered(n, lease, found.mod_revision),
                _ => self.not_registered(n),
            },
            Then::ListedFirst | Then::Listed => {
                let is_first = matches!(then, Then::ListedFirst);
                let ModelAnswer::Listed(found, revision) = answer else {
                    return if is_first { self.not_registered(n) } else { self.timer(n, PAUSE, Timer::ListNodes) };
                };
                let prefix = self.keys.nodes();
                let name = |key: &str| key.strip_prefix(&prefix).map(str::to_owned);
                let view = found.iter().filter_map(|found| Some((name(&found.key)?, decode(&found.value)?))).collect();
                self.nodes[n].memory.view = view;
                if is_first {
                    return self.is_of_the_fleet(n);
                }
                let watch = self.number();
                self.nodes[n].memory.watch = watch;
                self.ask(n, Ask::Watch(watch, revision + 1), Then::Watching);
                self.view_changed(n);
            }
            // It gives no answer: only that it failed is heard.
            Then::Watching => {
                let is_watched = self.nodes[n].memory.watch;
                if matches!(answer, ModelAnswer::Unreachable) && !self.is_watching(n, is_watched) {
                    self.timer(n, PAUSE, Timer::ListNodes);
                }
            }
            Then::Told => self.has_told(n, &answer),
            Then::ToldChecked => {
                let lease = self.nodes[n].memory.lease;
                if let ModelAnswer::Got(Some(found)) = answer
                    && found.lease == lease
                {
                    self.nodes[n].memory.key_revision = found.mod_revision;
                }
            }
            Then::Txn(sid, next) => self.transacted(n, sid, next, answer),
            Then::Resolve(sid, next, was_unknown) => self.resolved(n, sid, next, was_unknown, answer),
            Then::Own(sid) => self.own_seen(n, sid, answer),
            Then::Claim(sid) => self.claim(n, sid, answer),
            Then::Certain(id) => self.is_certain(n, id, &answer),
            Then::Held(id) => self.held(n, id, &answer),
            Then::Settling => self.settle(n, answer),
        }
    }

    fn not_registered(&mut self, n: N) {
        if self.nodes[n].memory.rejoining {
            self.timer(n, PAUSE, Timer::Register);
        } else {
            // The process ends, and is started again.
            self.timer(n, 500 * MS, Timer::Join);
        }
    }

    fn registered(&mut self, n: N, lease: i64, revision: u64) {
        let memory = &mut self.nodes[n].memory;
        (memory.lease, memory.key_revision) = (lease, revision);
        self.note(|| format!("n{n} has lease {lease}"));
        // A late list would permanently undo the events that the watch has delivered since.
        if self.nodes[n].memory.rejoining && !self.is(Broken::ListOverWatch) {
            return self.is_of_the_fleet(n);
        }
        let prefix = self.keys.nodes();
        self.ask(n, Ask::List(prefix), Then::ListedFirst);
    }

    fn is_of_the_fleet(&mut self, n: N) {
        if !self.nodes[n].memory.rejoining {
            if !self.is(Broken::JoinSkips) {
                self.timer(n, 0, Timer::KeepAlive);
            }
            return self.look_for_own(n);
        }
        let owned: Vec<usize> = self.nodes[n].memory.owned.keys().copied().collect();
        self.nodes[n].memory.taking_back = owned.iter().copied().collect();
        for sid in owned {
            self.take_back(n, sid);
        }
        self.is_taken_back(n);
    }

    fn begin(&mut self, n: N) {
        self.nodes[n].serving = true;
        self.note(|| format!("n{n} serves"));
        if self.is(Broken::JoinSkips) {
            self.timer(n, 0, Timer::KeepAlive);
        }
        for timer in [Timer::ListNodes, Timer::Tell, Timer::Look, Timer::TakeOver, Timer::Settle] {
            self.timer(n, 0, timer);
        }
    }

    fn kept_alive(&mut self, n: N, sent: u64, answer: &ModelAnswer) {
        match answer {
            ModelAnswer::Lease(Some(_)) => {
                let mut fence = rules::fence_ns(sent, TTL_S);
                if self.is(Broken::FenceLate) {
                    fence = sent + TTL_S * 1_200 * MS;
                }
                self.nodes[n].memory.fence = fence;
                let taken = self.nodes[n].clock(self.now) - sent;
                self.timer(n, (TTL_S * 1_000 * MS / 6).saturating_sub(taken), Timer::KeepAlive);
            }
            ModelAnswer::Lease(None) if !self.nodes[n].serving => self.restart(n),
            ModelAnswer::Lease(None) => {
                self.note(|| format!("n{n} its lease has ended"));
                let memory = &mut self.nodes[n].memory;
                (memory.fence, memory.rejoining) = (0, true);
                self.wake(n, Timer::Register);
            }
            _ => self.timer(n, PAUSE, Timer::KeepAlive),
        }
    }

    fn take_back(&mut self, n: N, sid: usize) {
        if !self.nodes[n].memory.taking_back.contains(&sid) {
            return;
        }
        let Some(owned) = self.nodes[n].memory.owned.get(&sid).copied() else {
            self.nodes[n].memory.taking_back.remove(&sid);
            return self.is_taken_back(n);
        };
        let txn = self.keep(n, sid, owned.revision, "");
        self.ask(n, Ask::Txn(txn), Then::Txn(sid, KeyChange::TakenBack));
    }

    /// All is taken back or lost: from the next keepalive on it may act.
    pub(crate) fn is_taken_back(&mut self, n: N) {
        let memory = &mut self.nodes[n].memory;
        if memory.rejoining && memory.taking_back.is_empty() {
            memory.rejoining = false;
            self.timer(n, 0, Timer::KeepAlive);
        }
    }

    fn see(&mut self, n: N, change: &Change) {
        let prefix = self.keys.nodes();
        let Some(name) = change.key.strip_prefix(&prefix) else { return };
        let view = &mut self.nodes[n].memory.view;
        match change.value.as_deref().and_then(decode::<NodeValue>) {
            Some(value) => _ = view.insert(name.to_owned(), value),
            None => _ = view.remove(name),
        }
        self.view_changed(n);
    }

    fn view_changed(&mut self, n: N) {
        if self.nodes[n].serving {
            self.mirror(n);
            self.take_over(n);
        }
    }

    pub(crate) fn measure(&self, n: N) -> NodeValue {
        NodeValue {
            endpoint: self.nodes[n].name.clone(),
            instance: self.nodes[n].name.clone(),
            version: String::new(),
            replays: 1,
            threads: 1,
            load: 0.0,
            sessions: u32::try_from(self.nodes[n].memory.live.len()).unwrap(),
            draining: false,
        }
    }

    fn tell(&mut self, n: N) {
        let own = self.measure(n);
        let memory = &self.nodes[n].memory;
        if memory.told.as_ref() == Some(&own) && memory.view.get(&self.nodes[n].name) == Some(&own) {
            return;
        }
        let key = self.keys.node(&self.nodes[n].name);
        // Its own key as it was left: so an older process, or one that waited, can't bring it under an older lease.
        let is_own = if self.is(Broken::TellAnyLease) {
            Compare::Present(key.clone())
        } else {
            Compare::ModRevision(key.clone(), memory.key_revision)
        };
        let put = Op::Put { key, value: encode(&own), lease: Some(memory.lease) };
        self.nodes[n].memory.told = Some(own);
        self.ask(n, Ask::Txn(Txn { if_all: vec![is_own], then: vec![put], otherwise: vec![] }), Then::Told);
    }

    fn has_told(&mut self, n: N, answer: &ModelAnswer) {
        let memory = &mut self.nodes[n].memory;
        match answer {
            ModelAnswer::Done(outcome) if outcome.succeeded => memory.key_revision = outcome.revision,
            _ => {
                memory.told = None;
                let key = self.keys.node(&self.nodes[n].name);
                self.ask(n, Ask::Get(key), Then::ToldChecked);
            }
        }
    }
}
