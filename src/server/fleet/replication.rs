//! Sends the journals of this server to the servers that stand by for their sessions, as they grow.
//!
//! What is sent is read from the files: a server that has just come, one that was away, and one that keeps up get their parts in the
//! same way, and nothing waits in memory.

use std::collections::BTreeMap;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use palpate_proto::pb;
use pb::mirror_request::Message as Say;
use tokio::sync::mpsc;
use tokio::task::AbortHandle;
use tokio::time::sleep;
use tokio_stream::wrappers::ReceiverStream;
use tracing::{info, warn};

use super::peers::why;
use super::{Fleet, Standby};
use crate::server::journals::progress::Grown;
use palpate_cluster::{placement, rules};
use palpate_realtime::event_log::EventLog;
use palpate_tissue::lock::lock;

/// A server that can't be reached is tried again so soon.
const PAUSE: Duration = Duration::from_millis(250);

/// What has grown is looked for at least so often.
const LOOK: Duration = Duration::from_millis(200);

/// Bytes of journals in one message, about.
const MESSAGE_BYTES: u64 = 1 << 20;

/// Sessions that are deleted or were moved, of which a server is still to be told; it finds the others out by itself when the stream ends.
const MAX_PAST: usize = 10_000;

/// Messages that wait for the network.
const WAITING: usize = 2;

/// What a server that stands by has been sent: of each session the run and its bytes.
type SentBytes = BTreeMap<String, (u32, u64)>;

/// What a server that stands by has said of its disk, over one stream.
#[derive(Debug, Default)]
struct Heard {
    /// How far it has each journal.
    confirmed: BTreeMap<String, pb::Mirrored>,
    /// How often it was told to forget a session, and has not said yet that it has. What it says of the session meanwhile it said
    /// before it heard that: it is not so any more.
    ending: BTreeMap<String, u32>,
}

impl Heard {
    /// All that it has when the stream begins.
    fn new(there: &[pb::Mirrored]) -> Self {
        let confirmed = there.iter().map(|at| (at.session_id.clone(), at.clone())).collect();
        Heard { confirmed, ending: BTreeMap::new() }
    }

    /// It is told to forget a session.
    fn end(&mut self, id: &str) {
        self.confirmed.remove(id);
        *self.ending.entry(id.to_owned()).or_default() += 1;
    }

    /// It says how far it has a journal. Tells whether that counts.
    fn hear(&mut self, at: &pb::Mirrored) -> bool {
        if let Some(left) = self.ending.get_mut(&at.session_id) {
            *left -= u32::from(at.durable_bytes == 0);
            if *left == 0 {
                self.ending.remove(&at.session_id);
            }
            return false;
        }
        self.confirmed.insert(at.session_id.clone(), at.clone());
        true
    }

    /// How far it has that run of a session.
    fn of(&self, id: &str, run: u32) -> Option<pb::Mirrored> {
        self.confirmed.get(id).filter(|at| at.run == run).cloned()
    }
}

impl Fleet {
    /// Sends for ever.
    pub(super) async fn mirror(self: Arc<Self>) {
        let mut nodes = self.nodes.subscribe();
        let mut tasks: BTreeMap<String, AbortHandle> = BTreeMap::new();
        loop {
            let there = nodes.borrow_and_update().clone();
            tasks.retain(|name, task| {
                let stays = there.contains_key(name);
                if !stays {
                    task.abort();
                }
                stays
            });
            lock(&self.past).retain(|name, _| there.contains_key(name));
            for name in there.keys().filter(|name| **name != self.node) {
                tasks.entry(name.clone()).or_insert_with(|| self.spawn(self.clone().mirror_to(name.clone())));
            }
            if nodes.changed().await.is_err() {
                return;
            }
        }
    }

    /// The server that stands by for a session of this one.
    fn standby_of(&self, id: &str) -> Option<String> {
        placement::standby(id, &self.node, &self.nodes.borrow()).map(str::to_owned)
    }

    async fn mirror_to(self: Arc<Self>, name: String) {
        let mut told = String::new();
        loop {
            let endpoint = self.nodes.borrow().get(&name).map(|node| node.endpoint.clone());
            if let Some(endpoint) = endpoint
                && let Err(why) = self.mirror_once(&name, &endpoint).await
            {
                // Once for each reason.
                if why != told {
                    warn!(node = name, "journals can't be mirrored there: {why}");
                    told = why;
                }
            }
            sleep(PAUSE).await;
        }
    }

    /// Sends over one stream, until that breaks.
    async fn mirror_once(self: &Arc<Self>, name: &str, endpoint: &str) -> Result<(), String> {
        let told = |status: tonic::Status| why(&status);
        let mut peer = self.peers.at(endpoint).map_err(|refusal| refusal.to_string())?;
        let (say, said) = mpsc::channel(WAITING);
        let open = pb::MirrorOpen { node: self.node.clone() };
        let message = |message| pb::MirrorRequest { message: Some(message) };
        let _ = say.send(message(Say::Open(open))).await;
        let mut heard = peer.mirror(ReceiverStream::new(said)).await.map_err(told)?.into_inner();
        let there = heard.message().await.map_err(told)?.ok_or("it has ended the stream")?;
        let of_disk = Mutex::new(Heard::new(&there.mirrored));
        let mut sent: SentBytes =
            there.mirrored.into_iter().map(|at| (at.session_id, (at.run, at.durable_bytes))).collect();
        let closed = || "the stream is closed".to_owned();
        let sending = async {
            loop {
                // Before the look: what grows meanwhile is news.
                let news = self.growth.news();
                tokio::pin!(news);
                news.as_mut().enable();
                let is_told = |id: &str| lock(&self.standbys).get(id).is_some_and(|standby| standby.is(name));
                let is_named = |id: &str| lock(&self.standbys).get(id).is_some_and(|standby| standby.may_be(name));
                // One that another server hands over is not this server's yet. Who stands by, as etcd says, does so until another
                // has all.
                let is_wanted = |id: &str| {
                    self.revision(id).is_some() && (is_named(id) || self.standby_of(id).as_deref() == Some(name))
                };
                let grown = self.growth.chosen(is_wanted);
                // What it has of sessions for which etcd certainly names another, it may forget; also of those that are deleted.
                let gone = sent.keys().filter(|id| !grown.iter().any(|grown| grown.session_id == **id));
                let mut forgotten: Vec<String> =
                    gone.filter(|id| self.has_another_standby(id, name)).cloned().collect();
                forgotten.extend(lock(&self.past).remove(name).unwrap_or_default());
                for session_id in forgotten {
                    sent.remove(&session_id);
                    lock(&of_disk).end(&session_id);
                    say.send(message(Say::End(pb::MirrorEnd { session_id }))).await.map_err(|_| closed())?;
                }
                // It has all, and etcd does not say so: that was not done before, or was undone.
                for grown in grown.iter().filter(|grown| !is_told(&grown.session_id)) {
                    let at = lock(&of_disk).of(&grown.session_id, grown.run);
                    if let Some(at) = at {
                        self.is_mirrored(name, &at).await;
                    }
                }
                let behind = |grown: &Grown| sent.get(&grown.session_id) != Some(&(grown.run, grown.bytes));
                let behind: Vec<Grown> = grown.into_iter().filter(behind).collect();
                if behind.is_empty() {
                    let _ = tokio::time::timeout(LOOK, news).await;
                    continue;
                }
                let before = sent.clone();
                let read = tokio::task::spawn_blocking(move || parts(&behind, &before)).await;
                for parts in read.map_err(|error| error.to_string())? {
                    for part in &parts {
                        sent.insert(part.session_id.clone(), (part.run, part.offset + part.bytes.len() as u64));
                    }
                    let parts = message(Say::Parts(pb::MirrorParts { parts }));
                    say.send(parts).await.map_err(|_| closed())?;
                }
            }
            #[allow(unreachable_code)]
            Ok::<(), String>(())
        };
        let hearing = async {
            while let Some(answer) = heard.message().await.map_err(told)? {
                for at in answer.mirrored {
                    if lock(&of_disk).hear(&at) {
                        self.is_mirrored(name, &at).await;
                    }
                }
            }
            Err::<(), String>("it has ended the stream".to_owned())
        };
        tokio::select! {
            sent = sending => sent,
            heard = hearing => heard,
        }
    }

    /// Whether etcd certainly says that another than `name` stands by for a session of this server.
    fn has_another_standby(&self, id: &str, name: &str) -> bool {
        let is_another =
            |standby: &Standby| standby.naming.is_none() && !standby.named.is_empty() && standby.named != name;
        self.revision(id).is_some() && lock(&self.standbys).get(id).is_some_and(is_another)
    }

    /// etcd names nobody any more who stands by for a session. Who did has what it had, and may be named again.
    pub(super) fn names_nobody(&self, id: &str) {
        if let Some(standby) = lock(&self.standbys).get_mut(id) {
            let named = std::mem::take(&mut standby.named);
            standby.naming = standby.naming.take().or((!named.is_empty()).then_some(named));
        }
    }

    /// A session is deleted, or certainly another's, at whose key nobody stands by: who stood by for it may forget it.
    pub(super) fn tell_past(&self, id: &str, standby: Standby) {
        let stood_by = [Some(standby.named), standby.naming].into_iter().flatten();
        for name in stood_by.filter(|name| self.is_there(name)) {
            let mut past = lock(&self.past);
            let of_it = past.entry(name).or_default();
            if of_it.len() < MAX_PAST {
                of_it.push(id.to_owned());
            }
        }
    }

    /// Whether etcd is to be told that a server stands by for a session, because it has all up to `step`. From then on nothing counts
    /// as mirrored till etcd has said so.
    fn begins_to_name(&self, id: &str, name: &str, event_log: &EventLog, step: u64) -> bool {
        // Nobody else changes its key meanwhile: who begins to move it sees that it is being named.
        let moving = lock(&self.moving);
        if moving.contains(id) {
            return false;
        }
        let is_chosen = self.standby_of(id).as_deref() == Some(name);
        let mut standbys = lock(&self.standbys);
        let standby = standbys.entry(id.to_owned()).or_default();
        let is_free = match &standby.naming {
            Some(other) => other == name || is_chosen,
            None => is_chosen,
        };
        // The one before has more: it stays until this one has as much. With the lock, so that it can't have still more by the time
        // that it does not count any more.
        if !is_free || event_log.mirrored_step().is_some_and(|mirrored| step < mirrored) {
            return false;
        }
        standby.naming = Some(name.to_owned());
        true
    }

    /// etcd has said that a server stands by. Tells whether that is so still: another may be about to be named by now.
    fn is_named_now(&self, id: &str, name: &str) -> bool {
        let mut standbys = lock(&self.standbys);
        let Some(standby) = standbys.get_mut(id).filter(|standby| standby.naming.as_deref() == Some(name)) else {
            return false;
        };
        *standby = Standby { named: name.to_owned(), naming: None };
        true
    }

    /// Counts what a server has on its disk, if etcd says that it stands by, and no other is about to be named. That other was told of
    /// when it had all that counted: nothing may be added after that.
    fn counts(&self, id: &str, name: &str, event_log: &EventLog, step: u64) -> bool {
        let standbys = lock(&self.standbys);
        let counts = standbys.get(id).is_some_and(|standby| standby.is(name));
        if counts {
            event_log.is_mirrored(step);
        }
        counts
    }

    /// A server has so much of a journal on its disk. The first time, etcd is told who stands by.
    async fn is_mirrored(&self, name: &str, at: &pb::Mirrored) {
        let id = &at.session_id;
        let Some((event_log, step)) = self.growth.mirrored(id, at.run, at.durable_bytes) else { return };
        if self.counts(id, name, &event_log, step) {
            return;
        }
        let Some(revision) = self.revision(id) else { return };
        if !self.begins_to_name(id, name, &event_log, step) {
            return;
        }
        let keep = rules::keep(&self.keys, id, revision, &self.node, name);
        match self.transact(keep, id, |found| self.is_own(found, name)).await {
            // An answer that came late says nothing: the key has been written since.
            Ok(Ok(now)) if self.owns_since(id, now) && self.is_named_now(id, name) => {
                if let Ok(handle) = self.pacer.get(id) {
                    handle.is_owned_since(now);
                }
                info!(session = %id, node = name, "this server stands by");
                self.counts(id, name, &event_log, step);
            }
            // This server has written it itself, and has not heard so. It is tried again.
            Ok(Err(Some((value, now)))) if value.node == self.node => _ = self.owns_since(id, now),
            // Another has the session, or etcd does not answer: that is for the lease to find out. It is tried again.
            Ok(_) | Err(_) => {}
        }
    }
}

/// The parts of journals that were not sent, in messages of a usual size.
fn parts(behind: &[Grown], sent: &SentBytes) -> Vec<Vec<pb::MirrorPart>> {
    let (mut messages, mut parts, mut bytes_in) = (Vec::new(), Vec::new(), 0);
    for Grown { session_id, run, path, bytes } in behind {
        let Ok(file) = File::open(path) else { continue };
        let known = sent.get(session_id).filter(|(of, there)| of == run && there <= bytes);
        let mut offset = known.map_or(0, |(_, there)| *there);
        while offset < *bytes {
            #[allow(clippy::cast_possible_truncation)]
            let mut part = vec![0; (bytes - offset).min(MESSAGE_BYTES) as usize];
            if file.read_exact_at(&mut part, offset).is_err() {
                break;
            }
            let length = part.len() as u64;
            parts.push(pb::MirrorPart { session_id: session_id.clone(), run: *run, offset, bytes: part });
            offset += length;
            bytes_in += length;
            if bytes_in >= MESSAGE_BYTES {
                messages.push(std::mem::take(&mut parts));
                bytes_in = 0;
            }
        }
        // A round does not hold all journals of a server in memory.
        if messages.len() >= 4 {
            break;
        }
    }
    if !parts.is_empty() {
        messages.push(parts);
    }
    messages
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(id: &str, run: u32, durable_bytes: u64) -> pb::Mirrored {
        pb::Mirrored { session_id: id.to_owned(), run, durable_bytes }
    }

    #[test]
    fn what_a_server_said_before_it_heard_that_it_shall_forget_does_not_count() {
        let mut heard = Heard::new(&[at("s", 1, 9)]);
        assert_eq!((heard.of("s", 1), heard.of("s", 2)), (Some(at("s", 1, 9)), None));
        heard.end("s");
        assert_eq!(heard.of("s", 1), None);
        // It was under way; others are heard as ever.
        assert!(!heard.hear(&at("s", 1, 20)) && heard.hear(&at("t", 1, 3)));
        // Sent anew, and ended again before the first end was confirmed.
        heard.end("s");
        assert!(!heard.hear(&at("s", 0, 0)) && !heard.hear(&at("s", 1, 30)) && !heard.hear(&at("s", 0, 0)));
        assert_eq!(heard.of("s", 1), None);
        assert!(heard.hear(&at("s", 1, 4)));
        assert_eq!(heard.of("s", 1), Some(at("s", 1, 4)));
    }
}
