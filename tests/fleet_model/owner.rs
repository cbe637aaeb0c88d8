//! Ownership of a session: created, kept, claimed and deleted, as `src/server/fleet/{mod,take_over}.rs` do it.

use palpate_cluster::etcd::{Compare, Txn};
use palpate_cluster::key::{SessionValue, decode};
use palpate_cluster::rules;

use crate::broken::Broken;
use crate::node::{Growth, Owned, OwnedSession, WHOLE};
use crate::world::{Ask, KeyChange, ModelAnswer, Then, Timer, World};
use crate::{MS, N, S};

/// Time for which a former standby keeps its journal: a transaction that names it may be under way.
const KEEPS: u64 = 30_000 * MS;

pub(crate) type KeyState = Option<(SessionValue, u64)>;

impl World {
    pub(crate) fn keep(&self, n: N, sid: S, revision: u64, standby: &str) -> Txn {
        let mut txn = rules::keep(&self.keys, self.id(sid), revision, &self.nodes[n].name, standby);
        if self.is(Broken::KeepBlind) {
            txn.if_all.retain(|compare| !matches!(compare, Compare::ModRevision(..)));
        }
        txn
    }

    pub(crate) fn node_of(&self, name: &str) -> Option<N> {
        self.nodes.iter().position(|node| node.name == name)
    }

    /// A new session.
    pub(crate) fn create(&mut self, n: N) {
        let sid = self.ids.len();
        let id = format!("{:032x}", self.rng.u128(..));
        self.ids.push(id);
        let txn = rules::create(&self.keys, self.id(sid), &self.nodes[n].name);
        self.ask(n, Ask::Txn(txn), Then::Txn(sid, KeyChange::Born));
    }

    /// A client deletes a session.
    pub(crate) fn delete(&mut self, n: N, sid: S) {
        self.note(|| format!("n{n} s{sid} is to be deleted"));
        self.check.is_to_be_deleted(sid);
        let node = &mut self.nodes[n];
        let Some(live) = node.memory.live.remove(&sid) else { return };
        if let Some(file) = node.folder.get_mut(&sid).and_then(|files| files.get_mut(&live.run)) {
            file.ended = true;
        }
        node.memory.asked_to_delete.insert(sid);
        self.forget_the_deleted(n);
    }

    pub(crate) fn forget_the_deleted(&mut self, n: N) {
        let memory = &mut self.nodes[n].memory;
        let mut gone = Vec::new();
        for (sid, owned) in &mut memory.owned {
            let is_here = memory.live.contains_key(sid);
            if !is_here && owned.was_here && !memory.deleting.contains(sid) {
                gone.push((*sid, owned.revision));
            }
            owned.was_here |= is_here;
        }
        for (sid, revision) in gone {
            self.nodes[n].memory.deleting.insert(sid);
            let mut txn = rules::delete(&self.keys, self.id(sid), revision);
            if self.is(Broken::DeleteBlind) {
                txn.if_all.clear();
            }
            self.ask(n, Ask::Txn(txn), Then::Txn(sid, KeyChange::Deleted));
        }
    }

    pub(crate) fn transacted(&mut self, n: N, sid: S, next: KeyChange, answer: ModelAnswer) {
        match answer {
            ModelAnswer::Done(outcome) if outcome.succeeded => self.ended(n, sid, next, Ok(Ok(outcome.revision))),
            ModelAnswer::Done(_) | ModelAnswer::Unknown => {
                let key = self.key(sid);
                self.ask(n, Ask::Get(key), Then::Resolve(sid, next, matches!(answer, ModelAnswer::Unknown)));
            }
            _ => self.ended(n, sid, next, Err(())),
        }
    }

    pub(crate) fn resolved(&mut self, n: N, sid: S, next: KeyChange, was_unknown: bool, answer: ModelAnswer) {
        let ModelAnswer::Got(found) = answer else { return self.ended(n, sid, next, Err(())) };
        let found: KeyState = found.and_then(|found| Some((decode(&found.value)?, found.mod_revision)));
        let me = &self.nodes[n].name;
        let is_done = match (next, &found) {
            (KeyChange::Deleted, found) => found.is_none(),
            (KeyChange::Settled, _) => true,
            (_, None) => false,
            (KeyChange::Born, Some(_)) => true,
            (KeyChange::Named(to, _), Some((value, revision))) => {
                // A key that was so before is not proof: what was asked for earlier may still come.
                let known = self.nodes[n].memory.owned.get(&sid).map_or(0, |owned| owned.revision);
                value.node == *me && value.standby == self.nodes[to].name && *revision > known
            }
            (KeyChange::Handed(id), Some((value, _))) => {
                let to = self.nodes[n].memory.moving.get(&id).map(|moving| moving.to);
                to.is_some_and(|to| value.node == self.nodes[to].name)
            }
            (KeyChange::OwnKept | KeyChange::Regained, Some((value, _))) => {
                value.node == *me && value.standby.is_empty()
            }
            // The present state does not show whether it was done, so it is done again.
            (KeyChange::Fixed(_), _) => false,
            (_, Some((value, _))) => value.node == *me,
        };
        let result = if was_unknown && is_done { Ok(found.map_or(0, |found| found.1)) } else { Err(found) };
        self.ended(n, sid, next, Ok(result));
    }

    /// A transaction about a session has ended: at a revision, or with what is there instead; or that is not known.
    fn ended(&mut self, n: N, sid: S, next: KeyChange, result: Result<Result<u64, KeyState>, ()>) {
        let me = self.nodes[n].name.clone();
        let is_mine = |found: &KeyState| found.as_ref().is_some_and(|(value, _)| value.node == me);
        let learns = !self.is(Broken::StaleRevision);
        self.note(|| format!("n{n} s{sid} {next:?}: {result:?}"));
        match (next, result) {
            (KeyChange::Born, Ok(Ok(revision))) => {
                self.counts.created += 1;
                self.nodes[n].memory.owned.insert(sid, Owned { revision, was_here: true });
                self.run_session(n, sid, 0, 0, revision);
            }
            (KeyChange::Regained, Ok(Ok(revision))) => {
                let memory = &self.nodes[n].memory;
                if !memory.owned.contains_key(&sid) && !memory.live.contains_key(&sid) {
                    self.nodes[n].memory.owned.insert(sid, Owned { revision, was_here: true });
                    self.continue_own(n, sid, revision);
                }
            }
            (KeyChange::Born | KeyChange::Settled | KeyChange::Regained, _) => {}
            (KeyChange::Deleted, result) => {
                let memory = &mut self.nodes[n].memory;
                memory.deleting.remove(&sid);
                let is_gone = match &result {
                    Ok(Err(found)) if learns && is_mine(found) => {
                        if let Some(owned) = memory.owned.get_mut(&sid) {
                            owned.revision = found.as_ref().map_or(0, |found| found.1);
                        }
                        false
                    }
                    result => result.is_ok(),
                };
                if is_gone {
                    memory.owned.remove(&sid);
                    memory.standbys.remove(&sid);
                    memory.growth.remove(&sid);
                }
                let is_deleted = matches!(result, Ok(Ok(_) | Err(None)));
                if (is_deleted || self.is(Broken::DeleteUnsure)) && self.nodes[n].memory.asked_to_delete.remove(&sid) {
                    self.counts.deleted += 1;
                    self.check.is_deleted(sid);
                }
            }
            (KeyChange::TakenBack, Err(()) | Ok(Err(_))) if !self.nodes[n].memory.taking_back.contains(&sid) => {}
            (KeyChange::TakenBack, Err(())) => self.timer(n, 100 * MS, Timer::TakeBack(sid)),
            (KeyChange::TakenBack, Ok(Ok(revision))) => {
                self.counts.take_backs += 1;
                let memory = &mut self.nodes[n].memory;
                if let Some(owned) = memory.owned.get_mut(&sid) {
                    owned.revision = owned.revision.max(revision);
                }
                if let Some(live) = memory.live.get_mut(&sid) {
                    live.revision = live.revision.max(revision);
                }
                memory.standbys.remove(&sid);
                if memory.taking_back.remove(&sid) {
                    self.is_taken_back(n);
                }
            }
            (KeyChange::TakenBack, Ok(Err(found))) => {
                if learns && is_mine(&found) {
                    let known = self.nodes[n].memory.owned.get(&sid).map(|owned| owned.revision);
                    if known == found.as_ref().map(|found| found.1) {
                        // So the new lease has ended too.
                        if !std::mem::take(&mut self.nodes[n].memory.taking_back).is_empty() {
                            self.timer(n, 100 * MS, Timer::Register);
                        }
                        return;
                    }
                    self.adopt(n, sid, &found);
                    return self.timer(n, 0, Timer::TakeBack(sid));
                }
                self.lose(n, sid);
                self.nodes[n].memory.taking_back.remove(&sid);
                self.is_taken_back(n);
            }
            (KeyChange::Named(to, bytes), result) => self.named(n, sid, to, bytes, result),
            (KeyChange::Claimed, result) => match result {
                Ok(Ok(revision)) => {
                    self.counts.claims += 1;
                    self.nodes[n].memory.owned.insert(sid, Owned { revision, was_here: false });
                    let replay = self.between(5, 100);
                    self.timer(n, replay, Timer::GoOn(sid, revision));
                }
                _ => _ = self.nodes[n].memory.claiming.remove(&sid),
            },
            (KeyChange::OwnKept, Err(())) => self.restart(n),
            (KeyChange::OwnKept, Ok(Ok(revision))) => {
                self.nodes[n].memory.own.insert(sid, revision);
                self.next_own(n);
            }
            (KeyChange::OwnKept, Ok(Err(found))) => {
                if learns && is_mine(&found) && !self.is(Broken::JoinSkips) {
                    // What was under way from the process before: once more.
                    self.nodes[n].memory.own_left.push(sid);
                }
                self.next_own(n);
            }
            (KeyChange::Handed(id), result) => self.handed(n, id, result),
            (KeyChange::Fixed(id), result) => self.fixed(n, id, result),
        }
    }

    /// The newest write was this node's own, though it has heard no answer.
    pub(crate) fn adopt(&mut self, n: N, sid: S, found: &KeyState) {
        if let (Some(owned), Some((_, revision))) = (self.nodes[n].memory.owned.get_mut(&sid), found) {
            owned.revision = owned.revision.max(*revision);
        }
    }

    /// A session of this node has another owner.
    pub(crate) fn lose(&mut self, n: N, sid: S) {
        let node = &mut self.nodes[n];
        node.memory.owned.remove(&sid);
        node.memory.standbys.remove(&sid);
        node.memory.growth.remove(&sid);
        if let Some(live) = node.memory.live.remove(&sid)
            && let Some(file) = node.folder.get_mut(&sid).and_then(|files| files.get_mut(&live.run))
        {
            file.ended = true;
        }
    }

    /// Continues a session here, after `after_run` with `count` inputs.
    pub(crate) fn run_session(&mut self, n: N, sid: S, after_run: u32, count: u64, revision: u64) {
        self.begin_session(n, sid, after_run, count, revision, false);
        self.note(|| format!("n{n} s{sid} goes on at {count}, revision {revision}"));
    }

    pub(crate) fn begin_session(&mut self, n: N, sid: S, after_run: u32, count: u64, revision: u64, coming: bool) {
        let rests = self.rng.f64() < 0.3;
        let memory = &mut self.nodes[n].memory;
        let run = memory.runs.get(&sid).copied().unwrap_or_default().max(after_run) + 1;
        memory.runs.insert(sid, run);
        let (local, mirrored, frozen) = (None, None, coming);
        let live = OwnedSession { count, run, local, mirrored, frozen, coming, revision, rests, broken: false };
        memory.live.insert(sid, live);
        let write = self.between(10, 40);
        self.timer(n, write, Timer::Write(sid, run));
        let tick = self.between(20, 300);
        self.timer(n, tick, Timer::Tick(sid, run));
    }

    /// What has happened is written to the journal, and synced.
    pub(crate) fn write(&mut self, n: N, sid: S, run: u32) {
        let node = &mut self.nodes[n];
        let Some(live) = node.memory.live.get_mut(&sid).filter(|live| !live.broken && live.run == run) else { return };
        let (bytes, is_ready) = (live.count + WHOLE, live.coming);
        let file = node.folder.entry(sid).or_default().entry(run).or_default();
        file.bytes = bytes;
        live.local = Some(live.count);
        let growth = node.memory.growth.entry(sid).or_insert(Growth { run, bytes, told: 0 });
        if growth.run != run {
            *growth = Growth { run, bytes, told: 0 };
        }
        growth.bytes = bytes;
        if is_ready {
            self.is_written(n, sid);
        }
        self.mirror(n);
    }

    /// A node that is started looks which sessions are its own.
    pub(crate) fn look_for_own(&mut self, n: N) {
        let node = &self.nodes[n];
        let mut own: Vec<S> = node.folder.keys().copied().collect();
        if !self.is(Broken::RestartIgnoresStandby) {
            own.extend(node.kept.keys().copied());
        }
        own.sort_unstable();
        own.dedup();
        self.nodes[n].memory.own_left = own;
        self.next_own(n);
    }

    fn next_own(&mut self, n: N) {
        if let Some(sid) = self.nodes[n].memory.own_left.pop() {
            let key = self.key(sid);
            return self.ask(n, Ask::Get(key), Then::Own(sid));
        }
        let own = self.nodes[n].memory.own.clone();
        for (sid, revision) in own {
            self.nodes[n].memory.owned.insert(sid, Owned { revision, was_here: true });
            self.continue_own(n, sid, revision);
        }
        let replay = self.between(5, 400);
        self.timer(n, replay, Timer::OwnResumed);
    }

    /// Goes on from the newest journal that is here. What it stood by with is newer than what it had before.
    fn continue_own(&mut self, n: N, sid: S, revision: u64) {
        let is_claimed = !self.is(Broken::RestartIgnoresStandby) && self.nodes[n].hand_out_newer(sid);
        match self.nodes[n].newest(sid) {
            Ok((_, count)) if is_claimed && !self.on_two => self.check.may_lose(sid, count),
            _ => {}
        }
        match self.nodes[n].newest(sid) {
            Ok((run, count)) => self.run_session(n, sid, run, count, revision),
            Err(why) => self.note(|| format!("n{n} s{sid} does not go on: {why}")),
        }
    }

    /// The process ends, and is started again.
    pub(crate) fn restart(&mut self, n: N) {
        self.crash(n);
        self.at(
            self.now + 500 * MS,
            crate::world::ModelEvent::Fault(crate::faults::ModelFault::Start(n, self.nodes[n].epoch)),
        );
    }

    pub(crate) fn own_seen(&mut self, n: N, sid: S, answer: ModelAnswer) {
        let ModelAnswer::Got(found) = answer else { return self.restart(n) };
        let found: KeyState = found.and_then(|found| Some((decode(&found.value)?, found.mod_revision)));
        match found {
            Some((value, revision)) if value.node == self.nodes[n].name => {
                let txn = self.keep(n, sid, revision, "");
                self.ask(n, Ask::Txn(txn), Then::Txn(sid, KeyChange::OwnKept));
            }
            _ => self.next_own(n),
        }
    }

    /// Claims the sessions of which it is the standby.
    pub(crate) fn take_over(&mut self, n: N) {
        let node = &self.nodes[n];
        if !node.is_within_fence(self.now) || !node.memory.claiming.is_empty() || !node.memory.has_settled {
            return;
        }
        let unsent = node.kept.iter().filter(|(_, kept)| self.is_unsent(n, kept)).map(|(sid, _)| *sid);
        for sid in unsent.collect::<Vec<S>>() {
            self.nodes[n].memory.claiming.insert(sid);
            let key = self.key(sid);
            self.ask(n, Ask::Get(key), Then::Claim(sid));
        }
    }

    fn is_unsent(&self, n: N, kept: &crate::node::ReplicaJournal) -> bool {
        let is_there = self.nodes[n].memory.view.contains_key(&self.nodes[kept.sender].name);
        kept.stream.is_none() || (!is_there && !self.is(Broken::ClaimAwaitsStream))
    }

    pub(crate) fn claim(&mut self, n: N, sid: S, answer: ModelAnswer) {
        let is_there = |world: &World, name: &str| world.nodes[n].memory.view.contains_key(name);
        let done = |world: &mut World| _ = world.nodes[n].memory.claiming.remove(&sid);
        let ModelAnswer::Got(found) = answer else { return done(self) };
        let found: KeyState = found.and_then(|found| Some((decode(&found.value)?, found.mod_revision)));
        let Some((value, revision)) = found else {
            self.nodes[n].kept.remove(&sid);
            return done(self);
        };
        let me = self.nodes[n].name.clone();
        if value.node == me && !self.is(Broken::ClaimForgotten) {
            // A claim that was done without an answer. What it owns and has is not claimed.
            let memory = &self.nodes[n].memory;
            if memory.owned.contains_key(&sid) || memory.live.contains_key(&sid) {
                return done(self);
            }
            // The read state may be old: it counts when it is written again.
            let txn = self.keep(n, sid, revision, "");
            return self.ask(n, Ask::Txn(txn), Then::Txn(sid, KeyChange::Claimed));
        }
        if value.standby != me {
            let Some(kept) = self.nodes[n].kept.get(&sid).copied() else { return done(self) };
            let is_long = self.nodes[n].clock(self.now) > kept.since + KEEPS && kept.stream.is_none();
            if is_there(self, &value.node) && (is_long || self.is(Broken::ForgetSoon) || value.node == me) {
                self.note(|| format!("n{n} s{sid} forgets what it stood by with"));
                self.nodes[n].kept.remove(&sid);
            }
            return done(self);
        }
        if !self.is(Broken::ClaimComing) {
            self.drop_coming(n, sid);
        }
        // What it has of a handing over that failed is older, or another course.
        if !self.is(Broken::OldRunsCount) {
            self.nodes[n].folder.remove(&sid);
        }
        let blind = self.is(Broken::ClaimBlind);
        if !blind && !rules::may_claim(&value, &me, |node| is_there(self, node)) {
            return done(self);
        }
        let mut txn = rules::claim(&self.keys, self.id(sid), (&value, revision), &me);
        if blind {
            txn.if_all.retain(|compare| !matches!(compare, Compare::Absent(_)));
        }
        self.ask(n, Ask::Txn(txn), Then::Txn(sid, KeyChange::Claimed));
    }

    /// Continues a claimed session from the journal that is here.
    pub(crate) fn go_on(&mut self, n: N, sid: S, revision: u64) {
        self.nodes[n].memory.claiming.remove(&sid);
        let with_old = self.is(Broken::OldRunsCount);
        let newest = if self.nodes[n].hand_out(sid, with_old) { self.nodes[n].newest(sid) } else { Err("no journal") };
        match newest {
            Ok((run, count)) => {
                if !self.on_two {
                    self.check.may_lose(sid, count);
                }
                self.run_session(n, sid, run, count, revision);
            }
            Err(why) => {
                self.nodes[n].memory.owned.remove(&sid);
                self.note(|| format!("n{n} s{sid} is claimed, but can't go on: {why}"));
            }
        }
    }

    /// Returns the sessions that etcd assigns to this node and that it does not have.
    pub(crate) fn settle(&mut self, n: N, answer: ModelAnswer) {
        let ModelAnswer::Listed(found, _) = answer else { return self.timer(n, 500 * MS, Timer::Settle) };
        let prefix = self.keys.sessions();
        let before = std::mem::take(&mut self.nodes[n].memory.settle_seen);
        for found in found {
            let value: Option<SessionValue> = decode(&found.value);
            let Some(value) = value.filter(|value| value.node == self.nodes[n].name) else { continue };
            let Some(sid) = self.ids.iter().position(|id| found.key.strip_prefix(&prefix) == Some(id)) else {
                continue;
            };
            let memory = &self.nodes[n].memory;
            let is_coming = memory.coming.values().any(|coming| coming.sid == sid);
            if memory.owned.contains_key(&sid)
                || (!self.is(Broken::SettleAll) && (memory.live.contains_key(&sid) || is_coming))
            {
                continue;
            }
            // What has been so for a while: one that is just being made or taken is not meant.
            let is_old = before.get(&sid) == Some(&found.mod_revision);
            if !is_old && !self.is(Broken::SettleAll) {
                self.nodes[n].memory.settle_seen.insert(sid, found.mod_revision);
                continue;
            }
            if !self.is(Broken::SettleAll) && !self.is(Broken::JoinSkips) && self.nodes[n].has_any(sid) {
                if !self.nodes[n].memory.claiming.contains(&sid) {
                    let txn = self.keep(n, sid, found.mod_revision, "");
                    self.ask(n, Ask::Txn(txn), Then::Txn(sid, KeyChange::Regained));
                }
                continue;
            }
            self.note(|| format!("n{n} s{sid} is not here any more"));
            let txn = if value.standby.is_empty() {
                rules::delete(&self.keys, self.id(sid), found.mod_revision)
            } else {
                rules::give_up(&self.keys, self.id(sid), found.mod_revision, &value.standby)
            };
            self.ask(n, Ask::Txn(txn), Then::Txn(sid, KeyChange::Settled));
        }
        self.nodes[n].memory.has_settled = true;
        if !self.is(Broken::SettleAll) {
            self.timer(n, 3_000 * MS, Timer::Settle);
        }
    }
}
