//! A node: its disk, what it holds in memory, and its clock.

use std::collections::{BTreeMap, BTreeSet};

use palpate_cluster::key::NodeValue;

use crate::world::{ModelEvent, Then};
use crate::{N, Ns, S};

/// A journal of `count` inputs has `count + WHOLE` bytes; one with fewer bytes has not even its first state.
pub(crate) const WHOLE: u64 = 2;

/// The journal of one run of a session.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct JournalRun {
    pub(crate) bytes: u64,
    /// It was deleted, or went to another node.
    pub(crate) ended: bool,
}

/// A journal of which the node is the standby.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ReplicaJournal {
    pub(crate) run: u32,
    pub(crate) bytes: u64,
    pub(crate) sender: N,
    /// The stream by which it comes, if there is one.
    pub(crate) stream: Option<u64>,
    /// Time since which there is no stream, by this node's clock.
    pub(crate) since: Ns,
}

/// A session in memory.
#[derive(Debug, Clone)]
pub(crate) struct OwnedSession {
    pub(crate) count: u64,
    pub(crate) run: u32,
    pub(crate) local: Option<u64>,
    pub(crate) mirrored: Option<u64>,
    pub(crate) frozen: bool,
    /// It is handed over to this node, and not its own yet.
    pub(crate) coming: bool,
    pub(crate) revision: u64,
    pub(crate) rests: bool,
    /// Its journal can't be written.
    pub(crate) broken: bool,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct Growth {
    pub(crate) run: u32,
    pub(crate) bytes: u64,
    /// The mirror has confirmed so many.
    pub(crate) told: u64,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct Owned {
    pub(crate) revision: u64,
    pub(crate) was_here: bool,
}

/// A stream of journals to another node.
#[derive(Debug, Clone, Default)]
pub(crate) struct ReplicationStream {
    pub(crate) id: u64,
    /// The other has said what it has.
    pub(crate) is_open: bool,
    pub(crate) sent: BTreeMap<S, (u32, u64)>,
    /// What it has confirmed.
    pub(crate) confirmed: BTreeMap<S, (u32, u64)>,
    /// Number of requests to forget a session that it has not confirmed.
    pub(crate) ending: BTreeMap<S, u32>,
}

/// A session that is being handed over, here and there.
#[derive(Debug, Clone)]
pub(crate) struct Moving {
    pub(crate) sid: S,
    pub(crate) to: N,
    /// Of the ownership, when the last state was sent.
    pub(crate) revision: u64,
    pub(crate) stands: bool,
    /// etcd was asked.
    pub(crate) is_asked: bool,
    /// The node is finding the owner.
    pub(crate) unsure: bool,
}

#[derive(Debug, Clone)]
pub(crate) struct Coming {
    pub(crate) sid: S,
    pub(crate) from: N,
    pub(crate) revision: u64,
    pub(crate) is_ready: bool,
    pub(crate) is_over: bool,
}

/// What a process holds.
#[derive(Default)]
pub(crate) struct Memory {
    pub(crate) calls: BTreeMap<u64, (Then, bool)>,
    pub(crate) fence: Ns,
    pub(crate) lease: i64,
    /// The revision of the node's own key.
    pub(crate) key_revision: u64,
    pub(crate) view: BTreeMap<String, NodeValue>,
    pub(crate) watch: u64,
    pub(crate) live: BTreeMap<S, OwnedSession>,
    pub(crate) owned: BTreeMap<S, Owned>,
    pub(crate) standbys: BTreeMap<S, N>,
    pub(crate) growth: BTreeMap<S, Growth>,
    pub(crate) runs: BTreeMap<S, u32>,
    pub(crate) streams: BTreeMap<N, ReplicationStream>,
    pub(crate) inbound: BTreeMap<u64, N>,
    /// Sessions about which a transaction of the mirror is under way.
    pub(crate) naming: BTreeSet<S>,
    /// Whether etcd names the standby that is known here is not certain.
    pub(crate) unsure: BTreeSet<S>,
    pub(crate) claiming: BTreeSet<S>,
    pub(crate) own_left: Vec<S>,
    pub(crate) own: BTreeMap<S, u64>,
    pub(crate) taking_back: BTreeSet<S>,
    pub(crate) rejoining: bool,
    pub(crate) told: Option<NodeValue>,
    pub(crate) moving: BTreeMap<u64, Moving>,
    pub(crate) coming: BTreeMap<u64, Coming>,
    pub(crate) deleting: BTreeSet<S>,
    pub(crate) asked_to_delete: BTreeSet<S>,
    pub(crate) settle_seen: BTreeMap<S, u64>,
    pub(crate) has_settled: bool,
}

pub(crate) struct ModelNode {
    pub(crate) name: String,
    pub(crate) rate: f64,
    pub(crate) offset: Ns,
    pub(crate) up: bool,
    pub(crate) serving: bool,
    pub(crate) paused: bool,
    pub(crate) held: Vec<ModelEvent>,
    pub(crate) epoch: u32,
    pub(crate) folder: BTreeMap<S, BTreeMap<u32, JournalRun>>,
    pub(crate) kept: BTreeMap<S, ReplicaJournal>,
    pub(crate) memory: Memory,
}

impl ModelNode {
    /// What its clock shows.
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub(crate) fn clock(&self, now: Ns) -> Ns {
        self.offset + (now as f64 * self.rate) as Ns
    }

    /// How long what its clock calls `ns` takes.
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub(crate) fn lasting(&self, ns: Ns) -> Ns {
        (ns as f64 / self.rate) as Ns
    }

    pub(crate) fn is_within_fence(&self, now: Ns) -> bool {
        self.clock(now) < self.memory.fence
    }

    /// Whether it can step, and speak for, a session now.
    pub(crate) fn can_act(&self, now: Ns, sid: S) -> bool {
        self.up
            && self.serving
            && !self.paused
            && self.memory.live.get(&sid).is_some_and(|live| !live.coming && !live.frozen)
            && self.is_within_fence(now)
    }

    /// What it may call durable.
    pub(crate) fn durable(&self, sid: S, on_two: bool) -> Option<u64> {
        let live = self.memory.live.get(&sid)?;
        if on_two { live.local.min(live.mirrored) } else { live.local }
    }

    /// Takes a journal for which it stood by into its own.
    pub(crate) fn hand_out(&mut self, sid: S, with_old: bool) -> bool {
        let Some(kept) = self.kept.remove(&sid) else { return false };
        let files = self.folder.entry(sid).or_default();
        if !with_old {
            files.clear();
        }
        files.insert(kept.run, JournalRun { bytes: kept.bytes, ended: false });
        true
    }

    /// What it stood by with, if that is newer than its own journals: then it is taken out.
    pub(crate) fn hand_out_newer(&mut self, sid: S) -> bool {
        let own = self.folder.get(&sid).and_then(|files| files.last_key_value()).map_or(0, |(run, _)| *run);
        let is_newer = self.kept.get(&sid).is_some_and(|kept| kept.run > own && kept.bytes >= WHOLE);
        is_newer && self.hand_out(sid, false)
    }

    /// Returns whether it has a journal from which a session can continue.
    pub(crate) fn has_any(&self, sid: S) -> bool {
        self.kept.get(&sid).is_some_and(|kept| kept.bytes >= WHOLE) || self.newest(sid).is_ok()
    }

    /// Returns the newest of its own journals from which a session can continue: run and count.
    pub(crate) fn newest(&self, sid: S) -> Result<(u32, u64), &'static str> {
        let Some(files) = self.folder.get(&sid) else { return Err("no journal") };
        for (run, file) in files.iter().rev() {
            if file.bytes >= WHOLE {
                return if file.ended { Err("ended") } else { Ok((*run, file.bytes - WHOLE)) };
            }
        }
        Err("nothing whole")
    }
}
