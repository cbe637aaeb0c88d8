//! Journals on their way to standbys, as `src/server/fleet/{mirror,stand_by}.rs` do it.

use palpate_cluster::placement;

use crate::broken::Broken;
use crate::node::{ReplicaJournal, ReplicationStream, WHOLE};
use crate::world::{Ask, KeyChange, Say, Then, World};
use crate::{MS, N, S};

impl World {
    /// Returns the standby for a session of `n`.
    fn standby_of(&self, n: N, sid: S) -> Option<N> {
        let node = &self.nodes[n];
        placement::standby(self.id(sid), &node.name, &node.memory.view).and_then(|name| self.node_of(name))
    }

    /// Opens streams to all other nodes that are there, and sends what has grown.
    pub(crate) fn mirror(&mut self, n: N) {
        if !self.nodes[n].serving {
            return;
        }
        for to in 0..self.nodes.len() {
            let is_there = to != n && self.nodes[n].memory.view.contains_key(&self.nodes[to].name);
            let known = self.nodes[n].memory.streams.get(&to).map(|stream| (stream.id, stream.is_open));
            match (is_there, known) {
                (true, None) => {
                    let id = self.open(n, to);
                    self.nodes[n].memory.streams.insert(to, ReplicationStream { id, ..ReplicationStream::default() });
                    self.say(n, to, id, Say::Open);
                }
                (false, Some((id, _))) => {
                    self.nodes[n].memory.streams.remove(&to);
                    self.say(n, to, id, Say::Close);
                }
                (true, Some((_, true))) => self.send(n, to),
                _ => {}
            }
        }
    }

    /// Sends what has grown to a node.
    fn send(&mut self, n: N, to: N) {
        let growing: Vec<(S, u32, u64)> =
            self.nodes[n].memory.growth.iter().map(|(sid, growth)| (*sid, growth.run, growth.bytes)).collect();
        // A session that is being handed to this node is another's still.
        let is_own =
            |world: &World, sid: S| world.is(Broken::MirrorComing) || world.nodes[n].memory.owned.contains_key(&sid);
        // The one before has more: it gets all until this one is named.
        let is_named =
            |world: &World, sid: S| !world.is(Broken::EndSoon) && world.nodes[n].memory.standbys.get(&sid) == Some(&to);
        let chosen: Vec<_> = growing
            .into_iter()
            .filter(|(sid, ..)| is_own(self, *sid))
            .filter(|(sid, ..)| self.standby_of(n, *sid) == Some(to) || is_named(self, *sid))
            .collect();
        let Some(stream) = self.nodes[n].memory.streams.get(&to).cloned() else { return };
        for sid in stream.sent.keys().filter(|sid| !chosen.iter().any(|(of, ..)| of == *sid)) {
            let memory = &self.nodes[n].memory;
            let is_sure = memory.standbys.get(sid).is_some_and(|known| *known != to)
                && !memory.naming.contains(sid)
                && !memory.unsure.contains(sid);
            if memory.owned.contains_key(sid) && (is_sure || self.is(Broken::EndSoon)) {
                if let Some(stream) = self.nodes[n].memory.streams.get_mut(&to) {
                    stream.sent.remove(sid);
                    stream.confirmed.remove(sid);
                    *stream.ending.entry(*sid).or_default() += 1;
                }
                self.say(n, to, stream.id, Say::Forget(*sid));
            }
        }
        for (sid, run, bytes) in chosen {
            let known = stream.sent.get(&sid).copied();
            if known == Some((run, bytes)) {
                continue;
            }
            let from = known.filter(|(of, there)| *of == run && *there <= bytes).map_or(0, |(_, there)| there);
            if from == 0 {
                self.note(|| {
                    format!(
                        "n{n} s{sid} is sent to n{to} from its beginning: run {run}, {bytes} bytes; known {known:?}"
                    )
                });
                // A journal is longer than one message.
                self.say(n, to, stream.id, Say::Part(sid, run, 0, 1));
                let long = self.between(0, 300);
                self.say_after(n, to, stream.id, Say::Part(sid, run, 1, bytes), long);
            } else {
                self.say(n, to, stream.id, Say::Part(sid, run, from, bytes));
            }
            if let Some(stream) = self.nodes[n].memory.streams.get_mut(&to) {
                stream.sent.insert(sid, (run, bytes));
            }
        }
        if !self.is(Broken::StandbyToldOnce) {
            let confirmed = self.nodes[n].memory.streams.get(&to).map(|stream| stream.confirmed.clone());
            for (sid, (run, bytes)) in confirmed.unwrap_or_default() {
                self.is_mirrored(n, to, sid, run, bytes);
            }
        }
    }

    pub(crate) fn hear_peer(&mut self, n: N, from: N, stream: u64, say: Say) {
        if self.is_cut(from, n) || self.doomed.contains(&stream) {
            return self.doom(stream);
        }
        match say {
            Say::Open => {
                if !self.nodes[n].serving {
                    return self.say(n, from, stream, Say::Close);
                }
                let node = &mut self.nodes[n];
                node.memory.inbound.insert(stream, from);
                node.kept.values_mut().filter(|kept| kept.sender == from).for_each(|kept| kept.stream = Some(stream));
                let has = node.kept.iter().map(|(sid, kept)| (*sid, kept.run, kept.bytes)).collect();
                self.say(n, from, stream, Say::Has(has));
            }
            Say::Has(has) => {
                let told_once = self.is(Broken::StandbyToldOnce);
                let Some(known) = self.nodes[n].memory.streams.get_mut(&from).filter(|known| known.id == stream) else {
                    return;
                };
                known.is_open = true;
                known.sent = has.into_iter().map(|(sid, run, bytes)| (sid, (run, bytes))).collect();
                if !told_once {
                    known.confirmed = known.sent.clone();
                }
                self.send(n, from);
            }
            Say::Part(sid, run, at, to) => self.take_part(n, (from, stream), sid, run, (at, to)),
            Say::Confirm(sid, run, bytes) => {
                let counts_ended = self.is(Broken::CountsEnded);
                let Some(known) = self.nodes[n].memory.streams.get_mut(&from).filter(|known| known.id == stream) else {
                    return;
                };
                // What it said before it heard that it shall forget the session is not so any more.
                if let Some(left) = known.ending.get_mut(&sid).filter(|_| bytes == 0 || !counts_ended) {
                    *left -= u32::from(bytes == 0);
                    if *left == 0 {
                        known.ending.remove(&sid);
                    }
                    return;
                }
                known.confirmed.insert(sid, (run, bytes));
                self.is_mirrored(n, from, sid, run, bytes);
            }
            Say::Forget(sid) => {
                if self.nodes[n].kept.get(&sid).is_some_and(|kept| kept.sender == from) {
                    self.nodes[n].kept.remove(&sid);
                }
                self.say(n, from, stream, Say::Confirm(sid, 0, 0));
            }
            Say::Close => {
                self.doomed.insert(stream);
                self.stream_ended(n, stream);
            }
            Say::State(sid, part, count, run, revision) => {
                self.take_state(n, (from, stream), sid, part, [count, run.into(), revision]);
            }
            Say::Stated(part) => self.stated(n, stream, part),
            Say::TakeOver(revision) => self.take(n, stream, revision),
        }
    }

    fn take_part(&mut self, n: N, (from, stream): (N, u64), sid: S, run: u32, (at, to): (u64, u64)) {
        if !self.nodes[n].memory.inbound.contains_key(&stream) {
            return;
        }
        let known = self.nodes[n].kept.get(&sid).copied();
        // Of a node that has lost the session, and does not know it yet.
        if known.is_some_and(|known| run < known.run) && !self.is(Broken::OlderRuns) {
            return;
        }
        let there = if at == 0 { 0 } else { known.filter(|known| known.run == run).map_or(0, |known| known.bytes) };
        if at != there {
            self.note(|| format!("n{n} s{sid} of n{from}: byte {at} does not fit {there}"));
            self.say(n, from, stream, Say::Close);
            return self.stream_ended(n, stream);
        }
        let since = self.nodes[n].clock(self.now);
        self.nodes[n].kept.insert(sid, ReplicaJournal { run, bytes: to, sender: from, stream: Some(stream), since });
        let sync = self.between(1, 8);
        self.say_after(n, from, stream, Say::Confirm(sid, run, to), sync);
    }

    /// A node has this much of a journal on its disk, and writes to etcd that it is the standby.
    fn is_mirrored(&mut self, n: N, to: N, sid: S, run: u32, bytes: u64) {
        let (once, early) = (self.is(Broken::StandbyToldOnce), self.is(Broken::DurableEarly));
        let counts_both = self.is(Broken::CountsBoth);
        let is_chosen = once || self.standby_of(n, sid) == Some(to);
        let memory = &mut self.nodes[n].memory;
        let Some(growth) = memory.growth.get_mut(&sid).filter(|growth| growth.run == run && bytes >= WHOLE) else {
            return;
        };
        if once && bytes <= growth.told {
            return;
        }
        growth.told = growth.told.max(bytes);
        let Some(live) = memory.live.get_mut(&sid) else { return };
        let step = bytes - WHOLE;
        if early {
            live.mirrored = live.mirrored.max(Some(step));
        }
        // While another is being named, what the one before has does not count: the other may have less.
        let is_open = memory.unsure.contains(&sid) || (!counts_both && memory.naming.contains(&sid));
        if memory.standbys.get(&sid) == Some(&to) && !is_open {
            live.mirrored = live.mirrored.max(Some(step));
            return;
        }
        // The one before has more: it stays until this one has as much.
        if !is_chosen || live.mirrored.is_some_and(|mirrored| step < mirrored) || live.coming {
            return;
        }
        let Some(owned) = memory.owned.get(&sid).copied() else { return };
        if !memory.naming.insert(sid) {
            return;
        }
        let standby = self.nodes[to].name.clone();
        let txn = self.keep(n, sid, owned.revision, &standby);
        self.ask(n, Ask::Txn(txn), Then::Txn(sid, KeyChange::Named(to, bytes)));
    }

    pub(crate) fn named(
        &mut self,
        n: N,
        sid: S,
        to: N,
        bytes: u64,
        result: Result<Result<u64, crate::owner::KeyState>, ()>,
    ) {
        let stale = self.is(Broken::StaleRevision);
        let me = self.nodes[n].name.clone();
        let memory = &mut self.nodes[n].memory;
        memory.naming.remove(&sid);
        // The task that waited for the answer ended with its stream.
        if stale && !memory.streams.contains_key(&to) {
            return;
        }
        match result {
            Ok(Ok(revision)) => {
                let Some(owned) = memory.owned.get_mut(&sid) else { return };
                if revision < owned.revision && !stale {
                    // The answer came late: the key has been written since.
                    memory.unsure.insert(sid);
                    return;
                }
                memory.unsure.remove(&sid);
                owned.revision = revision;
                memory.standbys.insert(sid, to);
                if let Some(live) = memory.live.get_mut(&sid) {
                    live.revision = live.revision.max(revision);
                    live.mirrored = live.mirrored.max(Some(bytes - WHOLE));
                }
            }
            Ok(Err(found)) if !stale => {
                memory.unsure.insert(sid);
                if found.as_ref().is_some_and(|(value, _)| value.node == me) {
                    self.adopt(n, sid, &found);
                }
            }
            _ if !stale => _ = memory.unsure.insert(sid),
            _ => {}
        }
    }

    /// A stream has ended, at this end.
    pub(crate) fn stream_ended(&mut self, n: N, stream: u64) {
        let clock = self.nodes[n].clock(self.now);
        let node = &mut self.nodes[n];
        node.memory.streams.retain(|_, known| known.id != stream);
        if node.memory.inbound.remove(&stream).is_some() {
            for kept in node.kept.values_mut().filter(|kept| kept.stream == Some(stream)) {
                (kept.stream, kept.since) = (None, clock);
            }
        }
        self.move_ended(n, stream);
    }

    /// The nodes at the other ends of a node's streams.
    pub(crate) fn streams(&self, n: N) -> Vec<u64> {
        let memory = &self.nodes[n].memory;
        let own = memory.streams.values().map(|stream| stream.id).chain(memory.moving.keys().copied());
        own.chain(memory.inbound.keys().copied()).chain(memory.coming.keys().copied()).collect()
    }

    pub(crate) const MIRROR_LOOK: u64 = 200 * MS;
}
