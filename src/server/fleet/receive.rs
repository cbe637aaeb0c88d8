//! Receives a session that another server hands over.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::sync::Arc;
use std::time::Duration;

use palpate_haptics::Law;
use palpate_proto::geometry::from_vector;
use palpate_proto::measure::MULTIPLE;
use palpate_proto::{pb, touch};
use pb::take_session_request::Message;
use tokio::sync::mpsc;
use tokio::time::{sleep, timeout};
use tonic::{Status, Streaming};
use tracing::{info, warn};

use super::{Fleet, Owned};
use crate::server::journals::{until_complete, until_on_disk};
use palpate_cluster::rules;
use palpate_realtime::{Begin, SessionHandle, fenced};
use palpate_refusal::{Reason, Refusal};
use palpate_session::budget::{Purpose, Resource, Taken};
use palpate_session::input::Input;
use palpate_session::intake_transfer::Handed;
use palpate_session::journal::replay::{self, Known, Resumed};
use palpate_session::journal::{JournalReader, inputs};
use palpate_session::lease::{HandedLease, LeaseId};
use palpate_tissue::Model;
use palpate_tissue::lock::lock;
use palpate_tissue::memory;
use palpate_tissue::response::force_law::Disc;
use palpate_tissue::select::scheme_selection::NEVER;

/// Limit on the bytes of a session's state.
const MAX_STATE_BYTES: usize = 1 << 30;

/// Limit on the memory of the inputs that wait; the rest is dropped.
const MAX_WAITING_BYTES: usize = 64 << 20;

/// Time without a message from the other server after which etcd is asked who has the session.
const SILENCE: Duration = Duration::from_secs(1);

/// Interval between further requests to etcd.
const ASK: Duration = Duration::from_millis(250);

/// Limit on the number of force laws that are taken over.
const MAX_LAWS: usize = 64;

type Tell = mpsc::Sender<Result<pb::TakeSessionResponse, Status>>;

fn ended() -> Refusal {
    Refusal::new(Reason::OutOfTurn, "", "the stream has ended before it was complete")
}

fn internal(error: impl std::fmt::Display) -> Status {
    Status::internal(error.to_string())
}

/// The account charged for a handover as long as the session's owner is not known.
const PAYER: &str = "servers of the fleet";

/// Receives a state. `paid` is charged for the bytes before they are stored.
///
/// # Errors
/// Refuses a state that ends early, is above [`MAX_STATE_BYTES`], or exceeds the memory.
async fn state(inbound: &mut Streaming<pb::TakeSessionRequest>, paid: &mut Taken) -> Result<Vec<u8>, Status> {
    let mut bytes = Vec::new();
    loop {
        let message = inbound.message().await?.and_then(|message| message.message);
        let Some(Message::Part(part)) = message else { return Err(ended().into()) };
        if part.is_empty() {
            return Ok(bytes);
        }
        if bytes.len() + part.len() > MAX_STATE_BYTES {
            return Err(Refusal::new(Reason::TooLarge, "part", "the state is above 1 GiB").into());
        }
        // A growing vector may take twice its length.
        paid.grow_to(2 * (bytes.len() + part.len()) as u64, "part")?;
        bytes.extend(part);
    }
}

/// What the other server has sent since its last state.
struct SenderState {
    /// The memory charged for the pieces.
    paid: Taken,
    leases: Vec<pb::HeldLease>,
    laws: Vec<pb::KnownLaw>,
    /// Inputs that wait, encoded for `inputs::decoded`.
    pieces: Vec<Vec<u8>>,
    bytes: usize,
}

impl SenderState {
    /// Reads messages until the other server sends the revision since which this server owns the session. `None` if
    /// the stream ends without it.
    async fn hear(&mut self, inbound: &mut Streaming<pb::TakeSessionRequest>) -> Option<u64> {
        loop {
            match inbound.message().await.ok().flatten()?.message? {
                Message::Waiting(piece) => {
                    self.bytes += piece.len();
                    // Includes the memory that they take once decoded.
                    let memory = (self.bytes * (1 + MULTIPLE)) as u64;
                    if self.bytes <= MAX_WAITING_BYTES && self.paid.grow_to(memory, "waiting").is_ok() {
                        self.pieces.push(piece);
                    }
                }
                Message::TakeOver(over) => {
                    (self.leases, self.laws) = (over.leases, over.laws);
                    return Some(over.revision);
                }
                Message::Part(_) => return None,
            }
        }
    }
}

/// Returns a force law with its place, if both are valid.
fn known_law(known: &pb::KnownLaw) -> Option<(Disc, Law)> {
    let disc = Disc { radius_m: known.radius_m, at_m: from_vector(known.at_m.as_ref()) };
    let is_sound = disc.radius_m > 0.0 && disc.radius_m.is_finite() && disc.at_m.is_finite();
    touch::from_law(known.law.as_ref()?).ok().filter(|_| is_sound).map(|law| (disc, law))
}

impl Fleet {
    /// Receives a session over a stream; sends a failure back on it.
    pub(in crate::server) async fn take_in(
        self: Arc<Self>,
        mut inbound: Streaming<pb::TakeSessionRequest>,
        tell: Tell,
    ) {
        if let Err(status) = self.take(&mut inbound, &tell).await {
            let _ = tell.send(Err(status)).await;
        }
    }

    /// Returns an empty charge that can grow.
    fn paid(&self) -> palpate_refusal::Result<Taken> {
        self.account(PAYER).take(Resource::Memory(Purpose::Journals), 0, "part")
    }

    async fn restored(&self, bytes: Vec<u8>, known: Option<Known>) -> Result<Resumed, Status> {
        let limits = self.config.limits.clone();
        let paid = self.paid()?;
        let restore = move || {
            let reader = JournalReader::paid("the state of a session", Cursor::new(bytes), Some(paid))?;
            memory::attempt("part", || replay::resume_as(reader, &limits, known))
        };
        Ok(tokio::task::spawn_blocking(restore).await.map_err(internal)??)
    }

    async fn take(
        self: &Arc<Self>,
        inbound: &mut Streaming<pb::TakeSessionRequest>,
        tell: &Tell,
    ) -> Result<(), Status> {
        let answer = || tell.send(Ok(pb::TakeSessionResponse {}));
        // Building the tissue from the first state takes the longest.
        let mut paid = self.paid()?;
        let before = self.restored(state(inbound, &mut paid).await?, None).await?;
        paid.shrink_to(0);
        let _ = answer().await;
        let first = before.first.clone();
        let known = Some((before.header, before.first));
        let resumed = self.restored(state(inbound, &mut paid).await?, known).await?;
        paid.shrink_to(0);
        let offered = resumed.header.ownership_revision;
        let id = resumed.header.session_id.clone();
        let here =
            || Refusal::new(Reason::OutOfTurn, "session_id", "is that of a session that is here or arriving already");
        let _coming = self.comes(&id).ok_or_else(here)?;
        if !self.pacer.fence.may_act() {
            return Err(fenced().into());
        }
        let handle = self.admit(resumed).await?;
        // Only once it is on the disk: a crash of this server can't lose it from then on.
        if let Some(why) = until_on_disk(&handle).await {
            self.withdraw(&handle).await;
            return Err(Refusal::new(Reason::NotAvailable, "", why).into());
        }
        let _ = answer().await;
        let mut told = SenderState { paid, leases: Vec::new(), laws: Vec::new(), pieces: Vec::new(), bytes: 0 };
        let Some(revision) = self.until_certain(&id, offered, inbound, &mut told).await else {
            info!(session = %id, "a session that was being handed over does not arrive");
            self.withdraw(&handle).await;
            return Err(ended().into());
        };
        let waiting = self.waiting(&id, told.pieces, first).await;
        self.adopt(&handle, told.leases, waiting);
        handle.adopt_laws(told.laws.iter().take(MAX_LAWS).filter_map(known_law).collect());
        lock(&self.owned).insert(id.clone(), Owned::since(revision));
        self.stand_by.forget(&id);
        handle.arrive(revision);
        info!(session = %id, revision, "session taken");
        let _ = answer().await;
        Ok(())
    }

    /// Decodes the inputs that wait. Unreadable ones are dropped with a warning: the session belongs to this server
    /// and continues.
    async fn waiting(&self, id: &str, pieces: Vec<Vec<u8>>, first: Arc<Model>) -> Vec<(u64, Input)> {
        let limits = self.config.limits.clone();
        let read = move || -> palpate_refusal::Result<Vec<(u64, Input)>> {
            let mut waiting = Vec::new();
            for piece in pieces {
                waiting.extend(inputs::decoded(&piece, &first, &limits)?);
            }
            Ok(waiting)
        };
        match tokio::task::spawn_blocking(read).await {
            Ok(Ok(waiting)) => return waiting,
            Ok(Err(refusal)) => warn!(session = id, "the inputs that waited for it can't be read: {refusal}"),
            Err(error) => warn!(session = id, "the inputs that waited for it can't be read: {error}"),
        }
        Vec::new()
    }

    /// Waits until it is certain who has the session, and returns the revision if it is this server: according to the
    /// other server, or to etcd. As long as its key has the revision `offered`, the other server's transaction may
    /// still take place. `None`: the session does not arrive.
    async fn until_certain(
        &self,
        id: &str,
        offered: u64,
        inbound: &mut Streaming<pb::TakeSessionRequest>,
        told: &mut SenderState,
    ) -> Option<u64> {
        if let Ok(Some(revision)) = timeout(SILENCE, told.hear(inbound)).await {
            return Some(revision);
        }
        loop {
            match self.session_value(id).await {
                Ok(Some((value, revision))) if value.node == self.node => return Some(revision),
                // The owner is gone: claiming the session from its journal finds out whether the transaction took
                // place.
                Ok(Some((value, _))) if rules::may_claim(&value, &self.node, |node| self.is_there(node)) => {
                    return None;
                }
                Ok(Some((_, revision))) if revision == offered => {}
                Ok(_) => return None,
                Err(refusal) => warn!(session = %id, "the owner of this session is not known: {refusal}"),
            }
            // The other server may still say so. If the stream has ended, etcd is asked again.
            let wait = sleep(ASK);
            tokio::pin!(wait);
            tokio::select! {
                revision = told.hear(inbound) => match revision {
                    Some(revision) => return Some(revision),
                    None => wait.await,
                },
                () = &mut wait => {}
            }
        }
    }

    /// Discards a session that does not arrive, with its journal, which records a branch that no server continued.
    async fn withdraw(&self, handle: &SessionHandle) {
        if self.pacer.withdraw(&handle.id, ended()).is_ok() {
            let _ = until_complete(handle).await;
        }
        self.growth.ended(&handle.id);
        self.unsettled.notify_one();
    }

    /// Creates the session, which stands still and is not served yet: whether there is room for it must be known
    /// before the other server gives it up. Its tools keep their places, since their holders will connect here.
    async fn admit(&self, resumed: Resumed) -> Result<Arc<SessionHandle>, Status> {
        let begin = Begin {
            id: resumed.header.session_id.clone(),
            first: resumed.first.clone(),
            running: resumed.running,
            until: resumed.until_step,
            idle_timeout_s: resumed.header.idle_timeout_s,
            playback: None,
            after_run: resumed.header.run,
            revision: resumed.header.ownership_revision,
            // They arrive with the commands that wait.
            waiting: Vec::new(),
            frozen: true,
            exercise: None,
            recorded: true,
        };
        let (owner, pacer) = (self.account(&resumed.header.owner), self.pacer.clone());
        let session = resumed.session;
        let admit = move || pacer.resume(begin, &owner, || Ok(session), &NEVER);
        Ok(tokio::task::spawn_blocking(admit).await.map_err(internal)??)
    }

    /// Restores the leases of the held tools, and then the inputs that wait.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn adopt(&self, handle: &SessionHandle, leases: Vec<pb::HeldLease>, waiting: Vec<(u64, Input)>) {
        let longest_s = self.config.limits.lease_s;
        let mut by_lease: BTreeMap<LeaseId, Vec<HandedLease>> = BTreeMap::new();
        for pb::HeldLease { tool, lease_id, holder, lease_s, owner } in leases {
            let Ok(id) = u128::from_str_radix(&lease_id, 16) else { continue };
            let duration_ns = (lease_s.clamp(0.01, longest_s) * 1e9) as u64;
            by_lease.entry(id).or_default().push(HandedLease { tool, id, holder, duration_ns, owner });
        }
        for (id, leases) in by_lease {
            let account = leases.first().map(|lease| self.account(&lease.owner));
            // Even beyond the account's share: the tool is already in the tissue.
            let charge = |_: &HandedLease| account.as_ref()?.take(Resource::Leases, 1, "tools").ok();
            let charges = leases.iter().filter_map(charge).collect();
            handle.at_intake(|intake, now| {
                intake.adopt(Handed { leases, waiting: Vec::new() }, now);
                intake.charge(id, charges);
            });
        }
        // After the leases, to which the waiting inputs belong.
        handle.adopt_waiting(waiting);
    }
}
