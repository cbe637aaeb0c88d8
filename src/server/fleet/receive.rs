//! Takes in a session that another server hands over.

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

/// Bytes of a session's state, at most.
const MAX_STATE_BYTES: usize = 1 << 30;

/// Bytes of the inputs that wait, at most; what is beyond is dropped.
const MAX_WAITING_BYTES: usize = 64 << 20;

/// When the other server has said nothing for so long, etcd is asked who has the session.
const SILENCE: Duration = Duration::from_secs(1);

/// And again so often.
const ASK: Duration = Duration::from_millis(250);

/// Force laws that are taken over, at most.
const MAX_LAWS: usize = 64;

type Tell = mpsc::Sender<Result<pb::TakeSessionResponse, Status>>;

fn ended() -> Refusal {
    Refusal::new(Reason::OutOfTurn, "", "the stream has ended before it was complete")
}

fn internal(error: impl std::fmt::Display) -> Status {
    Status::internal(error.to_string())
}

/// The account of what other servers hand over, as long as it is not known whose it is.
const PAYER: &str = "servers of the fleet";

/// The bytes of a state. `paid` grows by them, before they are kept.
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
        // What a vector takes that grows.
        paid.grow_to(2 * (bytes.len() + part.len()) as u64, "part")?;
        bytes.extend(part);
    }
}

/// What the other server has said since its last state.
struct SenderState {
    /// What the pieces take.
    paid: Taken,
    leases: Vec<pb::HeldLease>,
    laws: Vec<pb::KnownLaw>,
    /// Inputs that wait, as `inputs::decoded` reads them.
    pieces: Vec<Vec<u8>>,
    bytes: usize,
}

impl SenderState {
    /// Hears on until it says since which revision the session is this server's. `None`: it says no more.
    async fn hear(&mut self, inbound: &mut Streaming<pb::TakeSessionRequest>) -> Option<u64> {
        loop {
            match inbound.message().await.ok().flatten()?.message? {
                Message::Waiting(piece) => {
                    self.bytes += piece.len();
                    // With what they are when they are decoded.
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

/// A law that a client can use, and its tip.
fn known_law(known: &pb::KnownLaw) -> Option<(Disc, Law)> {
    let disc = Disc { radius_m: known.radius_m, at_m: from_vector(known.at_m.as_ref()) };
    let is_sound = disc.radius_m > 0.0 && disc.radius_m.is_finite() && disc.at_m.is_finite();
    touch::from_law(known.law.as_ref()?).ok().filter(|_| is_sound).map(|law| (disc, law))
}

impl Fleet {
    /// Takes a session, as the stream tells it.
    pub(in crate::server) async fn take_in(
        self: Arc<Self>,
        mut inbound: Streaming<pb::TakeSessionRequest>,
        tell: Tell,
    ) {
        if let Err(status) = self.take(&mut inbound, &tell).await {
            let _ = tell.send(Err(status)).await;
        }
    }

    /// Takes nothing yet, and grows.
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
        // Of the first state the tissue is made, which takes the longest.
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
            || Refusal::new(Reason::OutOfTurn, "session_id", "is that of a session that is here, or comes already");
        let _coming = self.comes(&id).ok_or_else(here)?;
        if !self.pacer.fence.may_act() {
            return Err(fenced().into());
        }
        let handle = self.admit(resumed).await?;
        // Not before it is on the disk: from then on a crash of this server does not lose it.
        if let Some(why) = until_on_disk(&handle).await {
            self.withdraw(&handle).await;
            return Err(Refusal::new(Reason::NotAvailable, "", why).into());
        }
        let _ = answer().await;
        let mut told = SenderState { paid, leases: Vec::new(), laws: Vec::new(), pieces: Vec::new(), bytes: 0 };
        let Some(revision) = self.until_certain(&id, offered, inbound, &mut told).await else {
            info!(session = %id, "a session that was being handed over does not come");
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

    /// The inputs that wait. What can't be read is left out: the session is this server's, and goes on.
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
            Ok(Err(refusal)) => warn!(session = id, "what waited there can't be read: {refusal}"),
            Err(error) => warn!(session = id, "what waited there can't be read: {error}"),
        }
        Vec::new()
    }

    /// Waits until it is certain whose the session is: the other server says that it is this one's, or etcd does. As long as its key is
    /// as it was when it was `offered`, the other's transaction may still come. `None`: it does not come.
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
                // Its owner is gone: this server claims it from its journal, and so finds out.
                Ok(Some((value, _))) if rules::may_claim(&value, &self.node, |node| self.is_there(node)) => {
                    return None;
                }
                Ok(Some((_, revision))) if revision == offered => {}
                Ok(_) => return None,
                Err(refusal) => warn!(session = %id, "who has this session is not known: {refusal}"),
            }
            // It may say so yet. If the stream has ended, etcd is asked.
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

    /// A session does not come: nothing of it is kept. Its journal is of a course that was not taken.
    async fn withdraw(&self, handle: &SessionHandle) {
        if self.pacer.withdraw(&handle.id, ended()).is_ok() {
            let _ = until_complete(handle).await;
        }
        self.growth.ended(&handle.id);
        self.unsettled.notify_one();
    }

    /// The session, which stands and is not served yet. Whether there is room for it shows before the other server gives it up. Its
    /// tools stay where they are: who holds them comes here.
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
            // They come with the commands that wait.
            waiting: Vec::new(),
            frozen: true,
            recorded: true,
        };
        let (owner, pacer) = (self.account(&resumed.header.owner), self.pacer.clone());
        let session = resumed.session;
        let admit = move || pacer.resume(begin, &owner, || Ok(session), &NEVER);
        Ok(tokio::task::spawn_blocking(admit).await.map_err(internal)??)
    }

    /// The tools that are held go on being held.
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
            // Beyond their share too: the tool is in the tissue.
            let charge = |_: &HandedLease| account.as_ref()?.take(Resource::Leases, 1, "tools").ok();
            let charges = leases.iter().filter_map(charge).collect();
            handle.at_intake(|intake, now| {
                intake.adopt(Handed { leases, waiting: Vec::new() }, now);
                intake.charge(id, charges);
            });
        }
        // The leases are there: so what waits belongs to them.
        handle.adopt_waiting(waiting);
    }
}
