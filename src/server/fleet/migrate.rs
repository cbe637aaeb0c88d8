//! Moves sessions of this server to others while they run.
//!
//! The other server first gets the session's state while it runs here, and builds its tissue from it: the longer
//! part. Then the session stands still here, the other server gets its last state, and one transaction in etcd makes
//! it the owner. If anything fails before that, the session continues here.

use std::sync::Arc;
use std::time::Duration;

use futures_util::stream::{self, Stream};
use palpate_haptics::Law;
use palpate_proto::geometry::vector;
use palpate_proto::{pb, touch};
use pb::take_session_request::Message as Say;
use tokio::sync::mpsc;
use tokio::time::timeout;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Streaming;
use tracing::{info, warn};

use super::owned::Found;
use super::{Fleet, elsewhere};
use crate::server::journals::recorded;
use palpate_cluster::key::SessionValue;
use palpate_cluster::{placement, rules};
use palpate_realtime::clock::now_ns;
use palpate_realtime::{Present, SessionHandle};
use palpate_refusal::{Reason, Refusal, Result, excerpt};
use palpate_session::intake_transfer::Handed;
use palpate_session::journal::inputs;
use palpate_session::lease::HandedLease;
use palpate_tissue::lock::lock;
use palpate_tissue::response::force_law::Disc;

/// Time limit for the other server to build the tissue; beyond it the session stays.
const PREPARATION: Duration = Duration::from_secs(30);

/// Time limit for etcd to return the session's key; beyond it the session stays.
const CERTAINTY: Duration = Duration::from_secs(5);

/// Longest time for which the session stands still.
const STANDSTILL: Duration = Duration::from_secs(2);

/// Bytes of a state per message.
const PART_BYTES: usize = 256 << 10;

pub(super) fn broken(why: &str) -> Refusal {
    Refusal::new(Reason::NotAvailable, "node", format!("the session stays here: {why}"))
}

/// A stream to the server that is to take a session.
struct Handing {
    say: mpsc::Sender<pb::TakeSessionRequest>,
    heard: Streaming<pb::TakeSessionResponse>,
}

impl Handing {
    async fn send(&self, message: Say) -> Result<()> {
        let message = pb::TakeSessionRequest { message: Some(message) };
        self.say.send(message).await.map_err(|_| broken("the other server has ended the stream"))
    }

    /// Sends a state, and waits until the other server has made a session of it.
    async fn state(&mut self, bytes: &[u8]) -> Result<()> {
        for part in bytes.chunks(PART_BYTES) {
            self.send(Say::Part(part.to_vec())).await?;
        }
        self.send(Say::Part(Vec::new())).await?;
        self.answered().await
    }

    async fn answered(&mut self) -> Result<()> {
        match self.heard.message().await {
            Ok(Some(_)) => Ok(()),
            Ok(None) => Err(broken("the other server has ended the stream")),
            Err(status) => Err(broken(status.message())),
        }
    }
}

#[allow(clippy::cast_precision_loss)]
fn held_lease(lease: HandedLease) -> pb::HeldLease {
    let HandedLease { tool, id, holder, duration_ns, owner } = lease;
    pb::HeldLease { tool, lease_id: format!("{id:032x}"), holder, lease_s: duration_ns as f64 * 1e-9, owner }
}

/// Completes the handover: sends the other server the inputs that waited, the leases, and the force laws known for
/// its tissue.
async fn hand(handing: &mut Handing, revision: u64, handed: Handed, laws: Vec<(Disc, Arc<Law>)>) -> Result<()> {
    for piece in inputs::encoded(&handed.waiting) {
        handing.send(Say::Waiting(piece)).await?;
    }
    let leases = handed.leases.into_iter().map(held_lease).collect();
    let known = |(disc, law): &(Disc, Arc<Law>)| pb::KnownLaw {
        radius_m: disc.radius_m,
        at_m: vector(disc.at_m),
        law: Some(touch::law(law, 0)),
    };
    let laws = laws.iter().map(known).collect();
    handing.send(Say::TakeOver(pb::TakeOver { revision, leases, laws })).await?;
    handing.answered().await
}

/// Marks a session as being handed over, until it is dropped.
struct Moving<'f> {
    fleet: &'f Fleet,
    id: String,
}

impl Drop for Moving<'_> {
    fn drop(&mut self) {
        lock(&self.fleet.moving).remove(&self.id);
    }
}

impl Fleet {
    /// Moves a session of this server to `node`, or, if that is empty, to the server with the most room. Returns the
    /// new owner, and the time for which no step was done, s.
    ///
    /// # Errors
    /// Refuses an unknown node, one that computes different bits, and if the other server does not take it: then the
    /// session continues here.
    pub(in crate::server) async fn move_session(
        self: Arc<Self>,
        handle: Arc<SessionHandle>,
        node: &str,
    ) -> Result<(pb::Ownership, f64)> {
        // In a task of its own, which runs even if nobody waits for the answer any longer: a session must not be left
        // standing still.
        let (fleet, node) = (self.clone(), node.to_owned());
        let moved = tokio::spawn(async move { fleet.move_to(&handle, &node).await });
        moved.await.map_err(|error| broken(&error.to_string()))?
    }

    async fn move_to(&self, handle: &Arc<SessionHandle>, node: &str) -> Result<(pb::Ownership, f64)> {
        let (name, there) = {
            let nodes = self.nodes.borrow();
            let own = lock(&self.own).replays;
            let mut others = (**nodes).clone();
            others.retain(|name, there| *name != self.node && there.replays == own);
            let name = if node.is_empty() {
                placement::roomiest(&others).unwrap_or_default().to_owned()
            } else {
                node.to_owned()
            };
            let Some(there) = others.remove(&name) else {
                let message = if node.is_empty() {
                    "no other server of the fleet takes sessions of this release".to_owned()
                } else {
                    format!("the fleet has no other server `{}` that computes the same bits", excerpt(node))
                };
                return Err(Refusal::new(Reason::OutOfRange, "node", message));
            };
            (name, there)
        };
        if handle.playback.is_some() {
            return Err(Refusal::new(
                Reason::NotAvailable,
                "session_id",
                "a session that plays a recording can't be moved",
            ));
        }
        // Of a session that was made before its server came to the fleet.
        if handle.exercise.is_some() {
            let message = "is made for an exercise: what is measured of it, and the trainee's ID, don't move";
            return Err(Refusal::new(Reason::NotAvailable, "session_id", message));
        }
        let _moving = self.begins_to_move(&handle.id)?;
        self.ends_naming(&handle.id).await?;
        let (say, said) = mpsc::channel(16);
        let opening = self.peers.at(&there.endpoint)?.take_session(ReceiverStream::new(said)).await;
        let heard = opening.map_err(|status| broken(status.message()))?.into_inner();
        let mut handing = Handing { say, heard };
        let first = self.state_of(handle, handle.save().await?).await?;
        timeout(PREPARATION, handing.state(&first)).await.map_err(|_| broken("the other server is too slow"))??;
        let present = handle.freeze().await?;
        let begun_ns = now_ns();
        let handed = timeout(STANDSTILL, self.hand_over(handle, present, &name, &mut handing)).await;
        let revision = match handed.unwrap_or_else(|_| Err(broken("the other server or etcd is too slow"))) {
            Ok(revision) => revision,
            Err(refusal) => match self.settled(&handle.id).await {
                Some((value, revision)) if value.node == name => revision,
                Some((value, _)) if value.node == self.node => {
                    handle.thaw();
                    return Err(refusal);
                }
                found => {
                    // Otherwise the task that found that out has ended it.
                    if self.revision(&handle.id).is_some() {
                        self.lose(&handle.id, self.is_lost(found));
                    }
                    return Err(refusal);
                }
            },
        };
        #[allow(clippy::cast_precision_loss)]
        let gap_s = now_ns().saturating_sub(begun_ns) as f64 * 1e-9;
        let standby = lock(&self.standbys).remove(&handle.id).unwrap_or_default();
        self.lose(&handle.id, elsewhere(&name, there.endpoint.clone()));
        self.tell_past(&handle.id, standby);
        self.tally.moved.one_more();
        info!(session = %handle.id, node = name, revision, gap_s, "session moved");
        let value = SessionValue { node: name, standby: String::new() };
        Ok((self.ownership(&value, revision), gap_s))
    }

    /// Marks a session as being handed over, until the returned value is dropped.
    ///
    /// # Errors
    /// Refuses a session that is not this server's, or is being handed over already.
    fn begins_to_move(&self, id: &str) -> Result<Moving<'_>> {
        if !lock(&self.moving).insert(id.to_owned()) {
            return Err(Refusal::new(Reason::OutOfTurn, "session_id", "the session is being moved already"));
        }
        let moving = Moving { fleet: self, id: id.to_owned() };
        self.revision(id).map(|_| moving).ok_or_else(|| broken("it is not this server's"))
    }

    /// Waits until etcd has confirmed the standby of a session that is about to move. A new session is about to get
    /// its first standby: that changes its key, and a transaction at the revision before fails.
    ///
    /// # Errors
    /// Refuses if etcd does not answer in time, and if another server has the session.
    async fn ends_naming(&self, id: &str) -> Result<()> {
        if lock(&self.standbys).get(id).is_none_or(|standby| standby.naming.is_none()) {
            return Ok(());
        }
        let told = timeout(CERTAINTY, self.settled(id)).await;
        let late = format!("etcd has not said within {} s who stands by for it", CERTAINTY.as_secs());
        match told.map_err(|_| broken(&late))? {
            Some((value, _)) if value.node == self.node => Ok(()),
            found => Err(broken(&self.why_not(found.as_ref(), 0))),
        }
    }

    /// Describes why a transaction for a session of this server at `revision` failed, by what its key contains
    /// instead.
    fn why_not(&self, found: Option<&(SessionValue, u64)>, revision: u64) -> String {
        match found {
            None => "it is not this server's any more".to_owned(),
            Some((value, _)) if value.node != self.node => format!("etcd says that the server `{}` has it", value.node),
            Some((_, now)) if *now == revision => "this server or the other has lost its lease".to_owned(),
            Some(_) => "this server has just taken it back; try again".to_owned(),
        }
    }

    /// The last part of a move, while the session stands still. Returns the revision at which the other server owns
    /// it.
    async fn hand_over(
        &self,
        handle: &Arc<SessionHandle>,
        present: Present,
        to: &str,
        handing: &mut Handing,
    ) -> Result<u64> {
        // The other server learns the revision at which it is handed over: a transaction at another one does not
        // concern it.
        let revision = self.revision(&handle.id).ok_or_else(|| broken("it is not this server's"))?;
        handle.set_owned_since(revision);
        let last = self.state_of(handle, present).await?;
        handing.state(&last).await?;
        if !self.pacer.has(&handle.id) {
            return Err(broken("it is deleted"));
        }
        let over = rules::hand_over(&self.keys, &handle.id, revision, [&self.node, to]);
        let made = self.transact(over, &handle.id, |found| found.is_some_and(|value| value.node == to)).await?;
        let revision = made.map_err(|found| broken(&self.why_not(found.as_ref(), revision)))?;
        // From here on the session belongs to the other server, whatever happens to this stream.
        let endpoint = self.nodes.borrow().get(to).map(|node| node.endpoint.clone()).unwrap_or_default();
        let (handed, _) = handle.at_intake(|intake, _| intake.hand_over(elsewhere(to, endpoint)));
        if hand(handing, revision, handed, handle.known_laws()).await.is_err() {
            warn!(session = %handle.id, "the other server has the session, but has not said so");
        }
        Ok(revision)
    }

    /// Finds out who has the session after a transaction that may still take place: this server confirms its
    /// ownership again, after which the earlier transaction can't take place any longer. The session stands still
    /// until that is known.
    async fn settled(&self, id: &str) -> Found {
        loop {
            let revision = self.revision(id)?;
            // A confirmed standby stays the standby.
            let named = lock(&self.standbys).get(id).filter(|standby| standby.naming.is_none()).cloned();
            let standby = named.unwrap_or_default().named;
            let keep = |revision| rules::keep(&self.keys, id, revision, &self.node, &standby);
            match self.change(id, revision, keep, |found| self.is_own(found, &standby)).await {
                Ok(Ok(now)) => {
                    if standby.is_empty() {
                        self.names_nobody(id);
                    }
                    self.owns_since(id, now);
                    self.pacer
                        .list()
                        .iter()
                        .filter(|handle| handle.id == id)
                        .for_each(|handle| handle.set_owned_since(now));
                    return Some((SessionValue { node: self.node.clone(), standby }, now));
                }
                // Its lease has ended: the request may still take place when it has another.
                Ok(Err(Some((value, _)))) if value.node == self.node => {}
                Ok(Err(found)) => return found,
                Err(refusal) => warn!(session = %id, "who has this session is not known: {refusal}"),
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    }

    async fn state_of(&self, handle: &Arc<SessionHandle>, present: Present) -> Result<Vec<u8>> {
        let handle = handle.clone();
        let encoded = tokio::task::spawn_blocking(move || recorded::snapshot(&handle, &present)).await;
        encoded.map_err(|error| broken(&error.to_string()))?
    }

    /// Stops accepting sessions and moves all to others, or, if `is_on` is false, accepts sessions again. Yields the
    /// result for each session.
    pub(in crate::server) fn drain(self: Arc<Self>, is_on: bool) -> impl Stream<Item = pb::DrainNodeResponse> {
        self.set_draining(is_on);
        let sessions = if is_on { self.pacer.list() } else { Vec::new() };
        let left: Vec<Arc<SessionHandle>> = sessions.into_iter().rev().filter(|handle| !handle.is_coming()).collect();
        stream::unfold((self, left), |(fleet, mut left)| async move {
            let handle = left.pop()?;
            let session_id = handle.id.clone();
            let moved = fleet.clone().move_session(handle, "").await;
            let (node, fault) = match moved {
                Ok((ownership, _)) => (ownership.node, String::new()),
                Err(refusal) => (String::new(), refusal.to_string()),
            };
            let told =
                pb::DrainNodeResponse { session_id, node, fault, left: u32::try_from(left.len()).unwrap_or(u32::MAX) };
            Some((told, (fleet, left)))
        })
    }
}
