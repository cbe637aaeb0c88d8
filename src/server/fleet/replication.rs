//! Sends the growing journals of this server's sessions to the standby servers of these sessions.
//!
//! The data is read from the files: a new standby, one that was away, and one that keeps up get their parts in one
//! way, and nothing waits in memory.

use std::collections::BTreeMap;
use std::fs::File;
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
use super::positional_io::read_exact_at;
use super::{Fleet, Standby};
use crate::server::journals::progress::Grown;
use palpate_cluster::{placement, rules};
use palpate_realtime::event_log::EventLog;
use palpate_tissue::lock::lock;

/// Pause before another try to reach a server.
const PAUSE: Duration = Duration::from_millis(250);

/// Longest interval between checks for grown journals.
const LOOK: Duration = Duration::from_millis(200);

/// Approximate bytes of journals per message.
const MESSAGE_BYTES: u64 = 1 << 20;

/// Limit on the deleted or moved sessions that a server still has to be notified of; it finds out about others when
/// the stream ends.
const MAX_PAST: usize = 10_000;

/// Messages that wait for the network.
const WAITING: usize = 2;

/// What a standby server was sent: the run and its bytes, per session.
type SentBytes = BTreeMap<String, (u32, u64)>;

/// What a standby server has confirmed over one stream.
#[derive(Debug, Default)]
struct Heard {
    /// Each journal, with the bytes that are on its disk.
    confirmed: BTreeMap<String, pb::Mirrored>,
    /// Number of requests per session to forget it that are not confirmed yet. What the server reports of the session
    /// until then was sent before it received them, and no longer holds.
    ending: BTreeMap<String, u32>,
}

impl Heard {
    /// Creates the state at the start of a stream, with all that the server has.
    fn new(there: &[pb::Mirrored]) -> Self {
        let confirmed = there.iter().map(|at| (at.session_id.clone(), at.clone())).collect();
        Heard { confirmed, ending: BTreeMap::new() }
    }

    /// Records that the server is requested to forget a session.
    fn end(&mut self, id: &str) {
        self.confirmed.remove(id);
        *self.ending.entry(id.to_owned()).or_default() += 1;
    }

    /// Records a report of the server about a journal. Returns whether it counts.
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

    /// Returns what it has of that run of a session.
    fn of(&self, id: &str, run: u32) -> Option<pb::Mirrored> {
        self.confirmed.get(id).filter(|at| at.run == run).cloned()
    }
}

impl Fleet {
    /// Sends journals to the other servers until the server ends.
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

    /// Returns the server that is to be the standby of a session of this one.
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
                // Logs each reason once.
                if why != told {
                    warn!(node = name, "journals can't be replicated to this server: {why}");
                    told = why;
                }
            }
            sleep(PAUSE).await;
        }
    }

    /// Sends over one stream, until it breaks. Returns the reason.
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
                // Registered before the check: what grows during it triggers another one.
                let news = self.growth.news();
                tokio::pin!(news);
                news.as_mut().enable();
                let is_told = |id: &str| lock(&self.standbys).get(id).is_some_and(|standby| standby.is(name));
                let is_named = |id: &str| lock(&self.standbys).get(id).is_some_and(|standby| standby.may_be(name));
                // A session that another server is handing over does not belong to this one yet. The standby in etcd
                // remains until another server has the whole journal.
                let is_wanted = |id: &str| {
                    self.revision(id).is_some() && (is_named(id) || self.standby_of(id).as_deref() == Some(name))
                };
                let grown = self.growth.chosen(is_wanted);
                // It may forget sessions whose key certainly names another standby, and deleted ones.
                let gone = sent.keys().filter(|id| !grown.iter().any(|grown| grown.session_id == **id));
                let mut forgotten: Vec<String> =
                    gone.filter(|id| self.has_another_standby(id, name)).cloned().collect();
                forgotten.extend(lock(&self.past).remove(name).unwrap_or_default());
                for session_id in forgotten {
                    sent.remove(&session_id);
                    lock(&of_disk).end(&session_id);
                    say.send(message(Say::End(pb::MirrorEnd { session_id }))).await.map_err(|_| closed())?;
                }
                // It has the whole journal, and etcd does not name it: the transaction was not done before, or was
                // undone.
                for grown in grown.iter().filter(|grown| !is_told(&grown.session_id)) {
                    let at = lock(&of_disk).of(&grown.session_id, grown.run);
                    if let Some(at) = at {
                        self.record_mirrored(name, &at).await;
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
                        self.record_mirrored(name, &at).await;
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

    /// Returns whether etcd certainly names a standby other than `name` for a session of this server.
    fn has_another_standby(&self, id: &str, name: &str) -> bool {
        let is_another =
            |standby: &Standby| standby.naming.is_none() && !standby.named.is_empty() && standby.named != name;
        self.revision(id).is_some() && lock(&self.standbys).get(id).is_some_and(is_another)
    }

    /// Records that etcd names no standby any longer. The previous one keeps its copy, and may be named again.
    pub(super) fn names_nobody(&self, id: &str) {
        if let Some(standby) = lock(&self.standbys).get_mut(id) {
            let named = std::mem::take(&mut standby.named);
            standby.naming = standby.naming.take().or((!named.is_empty()).then_some(named));
        }
    }

    /// Notes that a session was deleted or belongs to another server: its former standby may remove its copy.
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

    /// Returns whether to name a server in etcd as the standby of a session, because it has the journal up to `step`.
    /// If so, nothing counts as replicated until etcd has confirmed it.
    fn begins_to_name(&self, id: &str, name: &str, event_log: &EventLog, step: u64) -> bool {
        // While this lock is held no move can start; a later one sees that a standby is being named.
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
        // The previous standby has more: it remains until this one has as much. Checked with the lock held, so that
        // its count can't grow before it stops counting.
        if !is_free || event_log.mirrored_step().is_some_and(|mirrored| step < mirrored) {
            return false;
        }
        standby.naming = Some(name.to_owned());
        true
    }

    /// Records that etcd names a server as the standby. Returns false if another is about to be named in the
    /// meantime.
    fn is_named_now(&self, id: &str, name: &str) -> bool {
        let mut standbys = lock(&self.standbys);
        let Some(standby) = standbys.get_mut(id).filter(|standby| standby.naming.as_deref() == Some(name)) else {
            return false;
        };
        *standby = Standby { named: name.to_owned(), naming: None };
        true
    }

    /// Counts what a server has on its disk, if etcd names it as the standby and no other is about to be named. That
    /// other one had all that counted when it was chosen: nothing may be added after that. Returns whether it counts.
    fn counts(&self, id: &str, name: &str, event_log: &EventLog, step: u64) -> bool {
        let standbys = lock(&self.standbys);
        let counts = standbys.get(id).is_some_and(|standby| standby.is(name));
        if counts {
            event_log.set_mirrored(step);
        }
        counts
    }

    /// Handles a report of how many bytes of a journal a server has on its disk. On the first one, names that server
    /// in etcd as the standby.
    async fn record_mirrored(&self, name: &str, at: &pb::Mirrored) {
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
            // A late answer says nothing: the key has been written since.
            Ok(Ok(now)) if self.owns_since(id, now) && self.is_named_now(id, name) => {
                if let Ok(handle) = self.pacer.get(id) {
                    handle.set_owned_since(now);
                }
                info!(session = %id, node = name, "standby server named");
                self.counts(id, name, &event_log, step);
            }
            // This server has written the key itself, and has not received the answer. It tries again later.
            Ok(Err(Some((value, now)))) if value.node == self.node => _ = self.owns_since(id, now),
            // Another server has the session, or etcd does not answer: the lease finds that out. It tries again
            // later.
            Ok(_) | Err(_) => {}
        }
    }
}

/// Returns the parts of journals that were not sent yet, in messages of about [`MESSAGE_BYTES`].
fn parts(behind: &[Grown], sent: &SentBytes) -> Vec<Vec<pb::MirrorPart>> {
    let (mut messages, mut parts, mut bytes_in) = (Vec::new(), Vec::new(), 0);
    for Grown { session_id, run, path, bytes } in behind {
        let Ok(file) = File::open(path) else { continue };
        let known = sent.get(session_id).filter(|(of, there)| of == run && there <= bytes);
        let mut offset = known.map_or(0, |(_, there)| *there);
        while offset < *bytes {
            #[allow(clippy::cast_possible_truncation)]
            let mut part = vec![0; (bytes - offset).min(MESSAGE_BYTES) as usize];
            if read_exact_at(&file, &mut part, offset).is_err() {
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
        // At most four messages per round: it must not hold all journals of a server in memory.
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
        // It was in flight; reports about other sessions still count.
        assert!(!heard.hear(&at("s", 1, 20)) && heard.hear(&at("t", 1, 3)));
        // Sent again, and ended again before the first end was confirmed.
        heard.end("s");
        assert!(!heard.hear(&at("s", 0, 0)) && !heard.hear(&at("s", 1, 30)) && !heard.hear(&at("s", 0, 0)));
        assert_eq!(heard.of("s", 1), None);
        assert!(heard.hear(&at("s", 1, 4)));
        assert_eq!(heard.of("s", 1), Some(at("s", 1, 4)));
    }
}
