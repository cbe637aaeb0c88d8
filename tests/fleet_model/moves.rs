//! Sessions that move while they run, as `src/server/fleet/{hand_over,service}.rs` do it.

use palpate_cluster::key::{SessionValue, decode};
use palpate_cluster::rules;

use crate::broken::Broken;
use crate::node::{Coming, Moving, Owned};
use crate::owner::KeyState;
use crate::world::{Ask, KeyChange, ModelAnswer, Move, Say, Then, Timer, World};
use crate::{MS, N, S};

impl World {
    /// Begins to hand a session over.
    pub(crate) fn move_session(&mut self, n: N, sid: S, to: N) {
        let memory = &self.nodes[n].memory;
        let (Some(live), Some(owned)) = (memory.live.get(&sid), memory.owned.get(&sid)) else { return };
        let is_there = memory.view.contains_key(&self.nodes[to].name);
        if to == n || !is_there || live.frozen || memory.moving.values().any(|moving| moving.sid == sid) {
            return;
        }
        let state = Say::State(sid, Move::First, live.count, live.run, owned.revision);
        let id = self.open(n, to);
        let moving = Moving { sid, to, revision: 0, stands: false, is_asked: false, unsure: false };
        self.nodes[n].memory.moving.insert(id, moving);
        self.say(n, to, id, state);
        self.timer(n, 2_000 * MS, Timer::Prepared(id));
    }

    /// The preparation took too long.
    pub(crate) fn prepared(&mut self, n: N, id: u64) {
        if self.nodes[n].memory.moving.get(&id).is_some_and(|moving| !moving.stands) {
            self.give_up_move(n, id);
        }
    }

    fn give_up_move(&mut self, n: N, id: u64) {
        if let Some(moving) = self.nodes[n].memory.moving.remove(&id) {
            self.say(n, moving.to, id, Say::Close);
        }
    }

    /// The other node gets a state; of the last one it makes a session that waits.
    pub(crate) fn take_state(
        &mut self,
        n: N,
        (from, id): (N, u64),
        sid: S,
        part: Move,
        [count, run, revision]: [u64; 3],
    ) {
        if !self.nodes[n].serving {
            return self.say(n, from, id, Say::Close);
        }
        if let Move::First = part {
            self.nodes[n].memory.coming.insert(id, Coming { sid, from, revision, is_ready: false, is_over: false });
            let restore = self.between(10, 150);
            return self.say_after(n, from, id, Say::Stated(Move::First), restore);
        }
        let is_fenced = !self.nodes[n].is_within_fence(self.now);
        let memory = &mut self.nodes[n].memory;
        // What is claimed comes already, until the answer of etcd is certain.
        let is_here = memory.live.contains_key(&sid) || memory.owned.contains_key(&sid);
        if is_fenced || is_here || memory.claiming.contains(&sid) {
            memory.coming.remove(&id);
            return self.say(n, from, id, Say::Close);
        }
        let Some(coming) = memory.coming.get_mut(&id) else { return };
        (coming.revision, coming.is_ready) = (revision, true);
        self.begin_session(n, sid, u32::try_from(run).unwrap(), count, revision, true);
        if self.is(Broken::TakeInMemory) {
            self.say(n, from, id, Say::Stated(Move::Last));
        }
        // Whether the other end is still there shows late: etcd is asked all the same.
        if !self.is(Broken::TakeReadsOnce) && !self.is(Broken::TakeWaits) {
            self.timer(n, 1_000 * MS, Timer::Held(id));
        }
    }

    /// The state that is coming is on the disk.
    pub(crate) fn is_written(&mut self, n: N, sid: S) {
        let coming = self.nodes[n].memory.coming.iter().find(|(_, coming)| coming.sid == sid && !coming.is_over);
        if let Some((id, from)) = coming.map(|(id, coming)| (*id, coming.from))
            && !self.is(Broken::TakeInMemory)
        {
            self.say(n, from, id, Say::Stated(Move::Last));
        }
    }

    /// The other node has made the session.
    pub(crate) fn stated(&mut self, n: N, id: u64, part: Move) {
        let memory = &mut self.nodes[n].memory;
        let Some(moving) = memory.moving.get_mut(&id) else { return };
        let (sid, to) = (moving.sid, moving.to);
        let (Some(live), Some(owned)) = (memory.live.get_mut(&sid), memory.owned.get(&sid)) else {
            return self.give_up_move(n, id);
        };
        match part {
            Move::First => {
                if moving.stands {
                    return;
                }
                (moving.stands, moving.revision) = (true, owned.revision);
                live.frozen = self.broken != Broken::MoveRunning;
                let last = Say::State(sid, Move::Last, live.count, live.run, owned.revision);
                self.say(n, to, id, last);
                self.timer(n, 2_000 * MS, Timer::Standstill(id));
            }
            Move::Last => {
                if moving.unsure || moving.is_asked {
                    return;
                }
                moving.is_asked = true;
                let names = [&*self.nodes[n].name, &*self.nodes[to].name];
                let revision = self.nodes[n].memory.moving[&id].revision;
                let txn = rules::hand_over(&self.keys, self.id(sid), revision, names);
                self.ask(n, Ask::Txn(txn), Then::Txn(sid, KeyChange::Handed(id)));
            }
        }
    }

    pub(crate) fn handed(&mut self, n: N, id: u64, result: Result<Result<u64, KeyState>, ()>) {
        let Some(moving) = self.nodes[n].memory.moving.get(&id).cloned().filter(|moving| !moving.unsure) else {
            return;
        };
        if let Ok(Ok(revision)) = result {
            self.counts.moves += 1;
            self.nodes[n].memory.moving.remove(&id);
            self.lose(n, moving.sid);
            return self.say(n, moving.to, id, Say::TakeOver(revision));
        }
        self.find_out(n, id);
    }

    pub(crate) fn stood_too_long(&mut self, n: N, id: u64) {
        if self.nodes[n].memory.moving.get(&id).is_some_and(|moving| moving.stands && !moving.unsure) {
            self.find_out(n, id);
        }
    }

    fn find_out(&mut self, n: N, id: u64) {
        let Some(moving) = self.nodes[n].memory.moving.get_mut(&id) else { return };
        moving.unsure = true;
        let (sid, to, is_asked) = (moving.sid, moving.to, moving.is_asked);
        if !is_asked && !self.is(Broken::HandOverLate) {
            // Nothing was asked of etcd.
            self.nodes[n].memory.moving.remove(&id);
            self.thaw(n, sid);
            return self.say(n, to, id, Say::Close);
        }
        self.be_certain(n, id);
    }

    fn thaw(&mut self, n: N, sid: S) {
        if let Some(live) = self.nodes[n].memory.live.get_mut(&sid) {
            live.frozen = false;
        }
    }

    /// Whether the other node has the session is not known. This node writes the key once more: so what is under way
    /// can't be done.
    pub(crate) fn be_certain(&mut self, n: N, id: u64) {
        let Some(moving) = self.nodes[n].memory.moving.get(&id).cloned() else { return };
        if self.is(Broken::HandOverLate) {
            let key = self.key(moving.sid);
            return self.ask(n, Ask::Get(key), Then::Certain(id));
        }
        let Some(owned) = self.nodes[n].memory.owned.get(&moving.sid).copied() else {
            return self.give_up_move(n, id);
        };
        let standby = self.nodes[n].memory.standbys.get(&moving.sid).map(|standby| self.nodes[*standby].name.clone());
        let txn = self.keep(n, moving.sid, owned.revision, &standby.unwrap_or_default());
        self.ask(n, Ask::Txn(txn), Then::Txn(moving.sid, KeyChange::Fixed(id)));
    }

    pub(crate) fn fixed(&mut self, n: N, id: u64, result: Result<Result<u64, KeyState>, ()>) {
        let Some(moving) = self.nodes[n].memory.moving.get(&id).cloned() else { return };
        let sid = moving.sid;
        match result {
            Ok(Ok(revision)) => {
                let memory = &mut self.nodes[n].memory;
                if let Some(owned) = memory.owned.get_mut(&sid) {
                    owned.revision = owned.revision.max(revision);
                }
                if let Some(live) = memory.live.get_mut(&sid) {
                    live.revision = live.revision.max(revision);
                }
                self.thaw(n, sid);
                self.give_up_move(n, id);
            }
            Ok(Err(found)) if found.as_ref().is_some_and(|(value, _)| value.node == self.nodes[n].name) => {
                self.adopt(n, sid, &found);
                self.timer(n, 100 * MS, Timer::Certain(id));
            }
            Ok(Err(_)) => {
                self.lose(n, sid);
                self.give_up_move(n, id);
            }
            Err(()) => self.timer(n, 100 * MS, Timer::Certain(id)),
        }
    }

    /// What the owner has read.
    pub(crate) fn is_certain(&mut self, n: N, id: u64, answer: &ModelAnswer) {
        let ModelAnswer::Got(found) = answer else { return self.timer(n, 100 * MS, Timer::Certain(id)) };
        let Some(moving) = self.nodes[n].memory.moving.get(&id).cloned() else { return };
        let value: Option<SessionValue> = found.as_ref().and_then(|found| decode(&found.value));
        if value.is_some_and(|value| value.node == self.nodes[moving.to].name) {
            self.lose(n, moving.sid);
        } else {
            self.thaw(n, moving.sid);
        }
        self.give_up_move(n, id);
    }

    /// etcd says that the session is this node's.
    pub(crate) fn take(&mut self, n: N, id: u64, revision: u64) {
        let Some(coming) = self.nodes[n].memory.coming.remove(&id) else { return };
        let node = &mut self.nodes[n];
        let Some(live) = node.memory.live.get_mut(&coming.sid).filter(|live| live.coming) else { return };
        (live.coming, live.frozen) = (false, false);
        live.revision = live.revision.max(revision);
        let count = live.count;
        node.memory.owned.insert(coming.sid, Owned { revision, was_here: true });
        node.kept.remove(&coming.sid);
        self.note(|| format!("n{n} s{} is taken at {count}, revision {revision}", coming.sid));
    }

    /// A stream of a move has ended.
    pub(crate) fn move_ended(&mut self, n: N, id: u64) {
        if let Some(moving) = self.nodes[n].memory.moving.get(&id).cloned() {
            if !moving.stands {
                self.nodes[n].memory.moving.remove(&id);
            } else if !moving.is_asked && !moving.unsure {
                self.find_out(n, id);
            }
        }
        if let Some(coming) = self.nodes[n].memory.coming.get_mut(&id) {
            if coming.is_ready {
                coming.is_over = true;
                self.hold(n, id);
            } else {
                self.nodes[n].memory.coming.remove(&id);
            }
        }
    }

    /// Nobody says any more whose the session is: etcd knows.
    pub(crate) fn hold(&mut self, n: N, id: u64) {
        let Some(coming) = self.nodes[n].memory.coming.get(&id) else { return };
        let key = self.key(coming.sid);
        self.ask(n, Ask::Get(key), Then::Held(id));
    }

    pub(crate) fn held(&mut self, n: N, id: u64, answer: &ModelAnswer) {
        let Some(coming) = self.nodes[n].memory.coming.get(&id).cloned() else { return };
        let once = self.is(Broken::TakeReadsOnce);
        match answer {
            ModelAnswer::Got(found) => {
                let revision = found.as_ref().map_or(0, |found| found.mod_revision);
                let value: Option<SessionValue> = found.as_ref().and_then(|found| decode(&found.value));
                if value.is_some_and(|value| value.node == self.nodes[n].name) {
                    return self.take(n, id, revision);
                }
                // As long as the key is as it was, the transaction may still come.
                if revision == coming.revision && !once {
                    return self.timer(n, 250 * MS, Timer::Held(id));
                }
            }
            _ if !once => return self.timer(n, 250 * MS, Timer::Held(id)),
            _ => {}
        }
        self.drop_coming(n, coming.sid);
    }

    /// A session that was being handed to this node does not come.
    pub(crate) fn drop_coming(&mut self, n: N, sid: S) {
        self.nodes[n].memory.coming.retain(|_, coming| coming.sid != sid);
        let live = self.nodes[n].memory.live.get(&sid).cloned().filter(|live| live.coming);
        if let Some(live) = live {
            self.lose(n, sid);
            if !self.is(Broken::OldRunsCount)
                && let Some(files) = self.nodes[n].folder.get_mut(&sid)
            {
                files.remove(&live.run);
            }
        }
    }
}
