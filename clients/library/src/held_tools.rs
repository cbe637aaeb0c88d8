//! Tools of a session that are held by calls instead of a stream: each is acquired at its first command, and acquired again
//! with its command if the session has lost it. With them a client lays threads and clips.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Weak};
use std::time::Duration;

use palpate_proto::pb;
use palpate_refusal::Reason;
use pb::command::Action;
use pb::haptic_service_client::HapticServiceClient;
use pb::tie::Kind;
use tokio::sync::Mutex;
use tonic_types::StatusExt;

use crate::Error;
use crate::connect::Channel;
use crate::followed::Followed;

/// Time after which the tools of a program that has ended are released, s.
const LEASE_S: f64 = 5.0;

/// Interval between renewals of leases.
const RENEWAL: Duration = Duration::from_secs(1);

/// Tools of a session that one client holds. The leases are renewed until this is dropped, or the last one is released.
///
/// ```no_run
/// use std::sync::Arc;
/// use palpate_client::{Followed, HeldTools};
/// use palpate_proto::pb;
///
/// # async fn example(session: Followed) -> Result<(), palpate_client::Error> {
/// let tools = Arc::new(HeldTools::new(Arc::new(session), "my program"));
/// let bite = |x| pb::Bite { place_m: Some(pb::Vector3 { x, y: 0.03, z: 0.0 }), radius_m: 0.001 };
/// let stitch = pb::Thread { bites: vec![bite(0.03), bite(0.04)], length_m: 0.008, ..Default::default() };
/// tools.clone().thread(1, 0, stitch).await?;
/// tools.untie(1, 0).await
/// # }
/// ```
#[derive(Debug)]
pub struct HeldTools {
    session: Arc<Followed>,
    holder: String,
    leases: Mutex<BTreeMap<u32, String>>,
    /// Number of the newest command.
    sequence: AtomicU64,
    is_renewing: AtomicBool,
}

fn haptics(channel: Channel) -> HapticServiceClient<Channel> {
    HapticServiceClient::new(channel)
}

fn is_lost(error: &Error) -> bool {
    let Error::Call(status) = error else { return false };
    status.get_details_error_info().is_some_and(|info| info.reason == Reason::NotHolder.as_str())
}

/// Acquires a tool for `holder`, a name for people. Returns the ID of its lease, which ends 5 s after its last use.
///
/// # Errors
/// Returns the errors of [`Followed::call`]: a refusal, reason TOOL_HELD, if somebody else holds the tool.
pub async fn acquire(session: &Followed, tool: u32, holder: &str) -> Result<String, Error> {
    let request = pb::AcquireToolRequest {
        session_id: session.session_id().to_owned(),
        tool,
        lease_s: Some(LEASE_S),
        holder: holder.to_owned(),
        ..Default::default()
    };
    let taken = session.call(|channel| {
        let request = request.clone();
        async move { haptics(channel).acquire_tool(request).await }
    });
    Ok(taken.await?.into_inner().lease_id)
}

/// Sends commands to the tools of a lease, or only renews it if there are none.
///
/// # Errors
/// Returns the errors of [`Followed::call`]: then no command was accepted.
pub async fn send(session: &Followed, lease_id: &str, commands: Vec<pb::Command>) -> Result<(), Error> {
    let (session_id, lease_id) = (session.session_id().to_owned(), lease_id.to_owned());
    let request = pb::SendCommandsRequest { session_id, lease_id, commands };
    let sent = session.call(|channel| {
        let request = request.clone();
        async move { haptics(channel).send_commands(request).await }
    });
    sent.await.map(drop)
}

/// Renews the leases until the tools are dropped.
async fn renew(held: Weak<HeldTools>) {
    loop {
        tokio::time::sleep(RENEWAL).await;
        let Some(held) = held.upgrade() else { return };
        let leases = held.leases.lock().await.clone();
        for lease_id in leases.values() {
            // If the renewal fails, the next command acquires the tool again.
            let _ = send(&held.session, lease_id, Vec::new()).await;
        }
    }
}

impl HeldTools {
    /// Returns the tools of a session for `holder`, the name that other users see; none is held yet. Calls nothing.
    pub fn new(session: Arc<Followed>, holder: &str) -> Self {
        HeldTools {
            session,
            holder: holder.to_owned(),
            leases: Mutex::default(),
            sequence: AtomicU64::new(0),
            is_renewing: AtomicBool::new(false),
        }
    }

    /// Sends a command to a tool, which acts from the next step on. Acquires the tool first, if needed. Call it within a Tokio runtime,
    /// which must run as long as the tool is held.
    ///
    /// # Errors
    /// Returns the errors of [`acquire`] and [`send`]; the command then has no effect.
    pub async fn command(self: Arc<Self>, tool: u32, action: Action) -> Result<(), Error> {
        let mut leases = self.leases.lock().await;
        let sequence = Some(1 + self.sequence.fetch_add(1, Ordering::Relaxed));
        let command = pb::Command { tool, sequence, action: Some(action), ..Default::default() };
        if let Some(lease_id) = leases.get(&tool) {
            match send(&self.session, lease_id, vec![command.clone()]).await {
                // The server that had the tool has ended, or the lease was not renewed for too long.
                Err(error) if is_lost(&error) => drop(leases.remove(&tool)),
                sent => return sent,
            }
        }
        let lease_id = acquire(&self.session, tool, &self.holder).await?;
        leases.insert(tool, lease_id.clone());
        if !self.is_renewing.swap(true, Ordering::Relaxed) {
            tokio::spawn(renew(Arc::downgrade(&self)));
        }
        send(&self.session, &lease_id, vec![command]).await
    }

    /// Lays thread `number`, or changes its length, friction or strength if it has these bites already. What the tool does goes on, and
    /// the thread stays when the tool is released.
    ///
    /// # Errors
    /// Returns the errors of [`HeldTools::command`].
    pub async fn thread(self: Arc<Self>, tool: u32, number: u32, thread: pb::Thread) -> Result<(), Error> {
        self.command(tool, Action::Tie(pb::Tie { number, kind: Some(Kind::Thread(thread)) })).await
    }

    /// Closes clip `number` on two places, otherwise as [`HeldTools::thread`]. Threads and clips share their numbers.
    ///
    /// # Errors
    /// Returns the errors of [`HeldTools::command`].
    pub async fn clip(self: Arc<Self>, tool: u32, number: u32, clip: pb::Clip) -> Result<(), Error> {
        self.command(tool, Action::Tie(pb::Tie { number, kind: Some(Kind::Clip(clip)) })).await
    }

    /// Cuts a thread or clip, and takes it out; without effect if there is none.
    ///
    /// # Errors
    /// Returns the errors of [`HeldTools::command`].
    pub async fn untie(self: Arc<Self>, tool: u32, number: u32) -> Result<(), Error> {
        self.command(tool, Action::Tie(pb::Tie { number, kind: Some(Kind::Cut(pb::Release {})) })).await
    }

    /// Returns whether this holds a tool: has acquired it and not released it.
    pub async fn holds(&self, tool: u32) -> bool {
        self.leases.lock().await.contains_key(&tool)
    }

    /// Releases a tool, which ends what it did; without effect if this does not hold it.
    ///
    /// # Errors
    /// Returns the errors of [`Followed::call`].
    pub async fn release(self: Arc<Self>, tool: u32) -> Result<(), Error> {
        let Some(lease_id) = self.leases.lock().await.remove(&tool) else { return Ok(()) };
        let request = pb::ReleaseToolRequest { session_id: self.session.session_id().to_owned(), lease_id };
        let released = self.session.call(|channel| {
            let request = request.clone();
            async move { haptics(channel).release_tool(request).await }
        });
        match released.await {
            Err(error) if is_lost(&error) => Ok(()),
            released => released.map(drop),
        }
    }
}
