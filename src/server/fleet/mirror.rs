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

use super::{Fleet, Standby};
use crate::cluster::{placement, rules};
use crate::lock::lock;
use crate::server::journals::growth::Grown;

/// A server that can't be reached is tried again so soon.
const PAUSE: Duration = Duration::from_millis(250);

/// What has grown is looked for at least so often.
const LOOK: Duration = Duration::from_millis(200);

/// Bytes of journals in one message, about.
const MESSAGE_BYTES: u64 = 1 << 20;

/// Messages that wait for the network.
const WAITING: usize = 2;

/// What a server that stands by has been sent: of each session the run and its bytes.
type Sent = BTreeMap<String, (u32, u64)>;

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
        let told = |status: tonic::Status| status.message().to_owned();
        let mut peer = self.peers.at(endpoint).map_err(|refusal| refusal.to_string())?;
        let (say, said) = mpsc::channel(WAITING);
        let open = pb::MirrorOpen { node: self.node.clone() };
        let message = |message| pb::MirrorRequest { message: Some(message) };
        let _ = say.send(message(Say::Open(open))).await;
        let mut heard = peer.mirror(ReceiverStream::new(said)).await.map_err(told)?.into_inner();
        let there = heard.message().await.map_err(told)?.ok_or("it has ended the stream")?;
        // How far it has each journal on its disk.
        let known = there.mirrored.iter().map(|at| (at.session_id.clone(), at.clone()));
        let acked: Mutex<BTreeMap<String, pb::Mirrored>> = Mutex::new(known.collect());
        let mut sent: Sent = there.mirrored.into_iter().map(|at| (at.session_id, (at.run, at.durable_bytes))).collect();
        // What it has of sessions that it need not stand by for, it may forget; also of those that are deleted.
        let mut forgotten: Vec<String> = Vec::new();
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
                let gone = sent.keys().filter(|id| !grown.iter().any(|grown| grown.session_id == **id));
                let is_own = |id: &&String| self.revision(id).is_some();
                forgotten.extend(gone.filter(is_own).cloned());
                for session_id in forgotten.drain(..) {
                    sent.remove(&session_id);
                    say.send(message(Say::End(pb::MirrorEnd { session_id }))).await.map_err(|_| closed())?;
                }
                // It has all, and etcd does not say so: that was not done before, or was undone.
                for grown in grown.iter().filter(|grown| !is_told(&grown.session_id)) {
                    let at = lock(&acked).get(&grown.session_id).cloned();
                    if let Some(at) = at.filter(|at| at.run == grown.run) {
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
                    self.is_mirrored(name, &at).await;
                    lock(&acked).insert(at.session_id.clone(), at);
                }
            }
            Err::<(), String>("it has ended the stream".to_owned())
        };
        tokio::select! {
            sent = sending => sent,
            heard = hearing => heard,
        }
    }

    /// A server has so much of a journal on its disk. The first time, etcd is told who stands by.
    async fn is_mirrored(&self, name: &str, at: &pb::Mirrored) {
        let Some((tape, step)) = self.growth.mirrored(&at.session_id, at.run, at.durable_bytes) else { return };
        let id = &at.session_id;
        let is_named = {
            let mut standbys = lock(&self.standbys);
            let standby = standbys.entry(id.clone()).or_default();
            match &standby.naming {
                Some(other) if other != name && self.is_there(other) => return,
                None if standby.named == name => true,
                _ => {
                    // The one before has more: it stays until this one has as much.
                    if tape.progress().borrow().mirrored_step.is_some_and(|mirrored| step < mirrored) {
                        return;
                    }
                    standby.naming = Some(name.to_owned());
                    false
                }
            }
        };
        if !is_named {
            let Some(revision) = self.revision(id) else { return };
            let keep = |revision| rules::keep(&self.keys, id, revision, &self.node, name);
            let is_done = |found: Option<&crate::cluster::key::SessionValue>| {
                found.is_some_and(|value| value.node == self.node && value.standby == name)
            };
            match self.change(id, revision, keep, is_done).await {
                Ok(Ok(now)) => {
                    if let Some(owned) = lock(&self.owned).get_mut(id) {
                        owned.revision = now;
                    }
                    lock(&self.standbys).insert(id.clone(), Standby { named: name.to_owned(), naming: None });
                    if let Ok(live) = self.pacer.get(id) {
                        live.is_owned_since(now);
                    }
                    info!(session = %id, node = name, "this server stands by");
                }
                // Another has the session, or etcd does not answer: that is for the lease to find out. It is tried again.
                Ok(Err(_)) | Err(_) => return,
            }
        }
        tape.is_mirrored(step);
    }
}

/// The parts of journals that were not sent, in messages of a usual size.
fn parts(behind: &[Grown], sent: &Sent) -> Vec<Vec<pb::MirrorPart>> {
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
