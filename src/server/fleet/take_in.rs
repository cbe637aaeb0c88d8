//! Takes in a session that another server hands over.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::sync::Arc;

use palpate_proto::pb;
use pb::take_session_request::Message;
use tokio::sync::mpsc;
use tonic::{Status, Streaming};
use tracing::{info, warn};

use super::{Fleet, Owned};
use crate::budget::Resource;
use crate::journal::replay::{self, Known, Resumed};
use crate::journal::{Reader, inputs};
use crate::lock::lock;
use crate::pace::{Begin, Live};
use crate::refusal::{Reason, Refusal};
use crate::session::handing::Handed;
use crate::session::input::Input;
use crate::session::lease::{HandedLease, LeaseId};
use crate::sheet::Model;
use crate::sheet::choice::NEVER;

/// Bytes of a session's state, at most.
const MOST_STATE_BYTES: usize = 1 << 30;

/// Bytes of the inputs that wait, at most; what is beyond is dropped.
const MOST_WAITING_BYTES: usize = 64 << 20;

type Tell = mpsc::Sender<Result<pb::TakeSessionResponse, Status>>;

fn ended() -> Refusal {
    Refusal::new(Reason::OutOfTurn, "", "the stream has ended before it was complete")
}

fn internal(error: impl std::fmt::Display) -> Status {
    Status::internal(error.to_string())
}

/// The bytes of a state.
async fn state(inbound: &mut Streaming<pb::TakeSessionRequest>) -> Result<Vec<u8>, Status> {
    let mut bytes = Vec::new();
    loop {
        let message = inbound.message().await?.and_then(|message| message.message);
        let Some(Message::Part(part)) = message else { return Err(ended().into()) };
        if part.is_empty() {
            return Ok(bytes);
        }
        if bytes.len() + part.len() > MOST_STATE_BYTES {
            return Err(Refusal::new(Reason::TooLarge, "part", "the state is above 1 GiB").into());
        }
        bytes.extend(part);
    }
}

/// What says that the session has come, and before that the inputs that wait, in pieces.
async fn what_it_had(inbound: &mut Streaming<pb::TakeSessionRequest>) -> (Option<Message>, Vec<Vec<u8>>) {
    let (mut pieces, mut bytes) = (Vec::new(), 0);
    loop {
        match inbound.message().await.ok().flatten().and_then(|message| message.message) {
            Some(Message::Waiting(piece)) => {
                bytes += piece.len();
                if bytes <= MOST_WAITING_BYTES {
                    pieces.push(piece);
                }
            }
            message => return (message, pieces),
        }
    }
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

    async fn restored(&self, bytes: Vec<u8>, known: Option<Known>) -> Result<Resumed, Status> {
        let limits = self.config.limits.clone();
        let restore =
            move || replay::resume_as(Reader::new("the state of a session", Cursor::new(bytes))?, &limits, known);
        Ok(tokio::task::spawn_blocking(restore).await.map_err(internal)??)
    }

    async fn take(&self, inbound: &mut Streaming<pb::TakeSessionRequest>, tell: &Tell) -> Result<(), Status> {
        let answer = || tell.send(Ok(pb::TakeSessionResponse {}));
        // Of the first state the tissue is made, which takes the longest.
        let before = self.restored(state(inbound).await?, None).await?;
        let _ = answer().await;
        let first = before.first.clone();
        let known = Some((before.header, before.first));
        let live = self.admit(self.restored(state(inbound).await?, known).await?).await?;
        let _ = answer().await;
        let (message, pieces) = what_it_had(inbound).await;
        let revision = match message {
            Some(Message::TakeOver(over)) => {
                let waiting = self.waiting(&live.id, pieces, first).await;
                self.adopt(&live, over.leases, waiting);
                over.revision
            }
            // Nobody says so any more: etcd knows.
            _ => match self.session_value(&live.id).await {
                Ok(Some((value, revision))) if value.node == self.node => revision,
                _ => {
                    let _ = self.pacer.leave(&live.id, ended());
                    return Err(ended().into());
                }
            },
        };
        lock(&self.owned).insert(live.id.clone(), Owned::since(revision));
        self.stand_by.forget(&live.id);
        live.arrive(revision);
        info!(session = %live.id, revision, "session taken");
        let _ = answer().await;
        Ok(())
    }

    /// The inputs that wait. What can't be read is left out: the session is this server's, and goes on.
    async fn waiting(&self, id: &str, pieces: Vec<Vec<u8>>, first: Arc<Model>) -> Vec<(u64, Input)> {
        let limits = self.config.limits.clone();
        let read = move || -> crate::refusal::Result<Vec<(u64, Input)>> {
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

    /// The session, which stands and is not served yet. Whether there is room for it shows before the other server gives it up. Its
    /// tools stay where they are: who holds them comes here.
    async fn admit(&self, resumed: Resumed) -> Result<Arc<Live>, Status> {
        let begin = Begin {
            id: resumed.header.session_id.clone(),
            first: resumed.first.clone(),
            running: resumed.running,
            until: resumed.until_step,
            idle_timeout_s: resumed.header.idle_timeout_s,
            playback: None,
            after_run: resumed.header.run,
            revision: resumed.header.ownership_revision,
            frozen: true,
        };
        let (owner, pacer) = (self.account(&resumed.header.owner), self.pacer.clone());
        let session = resumed.session;
        let admit = move || pacer.resume(begin, &owner, || Ok(session), &NEVER);
        Ok(tokio::task::spawn_blocking(admit).await.map_err(internal)??)
    }

    /// The tools that are held go on being held.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn adopt(&self, live: &Live, leases: Vec<pb::HeldLease>, waiting: Vec<(u64, Input)>) {
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
            live.at_intake(|intake, now| {
                intake.adopt(Handed { leases, waiting: Vec::new() }, now);
                intake.charge(id, charges);
            });
        }
        // The leases are there: so what waits belongs to them.
        let dropped = live.at_intake(|intake, now| intake.adopt(Handed { leases: Vec::new(), waiting }, now));
        if dropped > 0 {
            warn!(session = %live.id, dropped, "no memory for all commands that waited");
        }
    }
}
