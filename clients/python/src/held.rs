//! Tools of a session on a server: each is acquired at its first command, and acquired again with its command if the
//! session has lost it.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Weak};
use std::time::Duration;

use palpate_client::{Channel, Error, Followed};
use palpate_proto::pb;
use palpate_refusal::Reason;
use pb::command::Action;
use pb::haptic_service_client::HapticServiceClient;
use tokio::sync::Mutex;
use tonic_types::StatusExt;

/// Time after which the tools of a program that has ended are released, s.
const LEASE_S: f64 = 5.0;

/// Interval between renewals of leases.
const RENEWAL: Duration = Duration::from_secs(1);

/// The tools that a session object holds, and their leases.
#[derive(Default)]
pub(crate) struct Held {
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

/// Acquires a tool. Returns the ID of its lease.
pub(crate) async fn acquire(session: &Followed, tool: u32) -> Result<String, Error> {
    let request = pb::AcquireToolRequest {
        session_id: session.session_id().to_owned(),
        tool,
        lease_s: Some(LEASE_S),
        holder: "python".to_owned(),
        ..Default::default()
    };
    let taken = session.call(|channel| {
        let request = request.clone();
        async move { haptics(channel).acquire_tool(request).await }
    });
    Ok(taken.await?.into_inner().lease_id)
}

/// Sends commands to the tools of a lease, or only renews it if there are none.
pub(crate) async fn send(session: &Followed, lease_id: &str, commands: Vec<pb::Command>) -> Result<(), Error> {
    let (session_id, lease_id) = (session.session_id().to_owned(), lease_id.to_owned());
    let request = pb::SendCommandsRequest { session_id, lease_id, commands };
    let sent = session.call(|channel| {
        let request = request.clone();
        async move { haptics(channel).send_commands(request).await }
    });
    sent.await.map(drop)
}

/// Renews the leases until the session object is dropped.
async fn renew(held: Weak<Held>, session: Weak<Followed>) {
    loop {
        tokio::time::sleep(RENEWAL).await;
        let (Some(held), Some(session)) = (held.upgrade(), session.upgrade()) else { return };
        let leases = held.leases.lock().await.clone();
        for lease_id in leases.values() {
            // If the renewal fails, the next command acquires the tool again.
            let _ = send(&session, lease_id, Vec::new()).await;
        }
    }
}

impl Held {
    /// Sends a command to a tool, which acts from the next step on. Acquires the tool first, if needed.
    pub(crate) async fn tell(self: Arc<Self>, session: Arc<Followed>, tool: u32, action: Action) -> Result<(), Error> {
        let mut leases = self.leases.lock().await;
        let sequence = Some(1 + self.sequence.fetch_add(1, Ordering::Relaxed));
        let command = pb::Command { tool, sequence, action: Some(action), ..Default::default() };
        if let Some(lease_id) = leases.get(&tool) {
            match send(&session, lease_id, vec![command.clone()]).await {
                // The server that had the tool has ended, or the lease was not renewed for too long.
                Err(error) if is_lost(&error) => drop(leases.remove(&tool)),
                sent => return sent,
            }
        }
        let lease_id = acquire(&session, tool).await?;
        leases.insert(tool, lease_id.clone());
        if !self.is_renewing.swap(true, Ordering::Relaxed) {
            tokio::spawn(renew(Arc::downgrade(&self), Arc::downgrade(&session)));
        }
        send(&session, &lease_id, vec![command]).await
    }

    /// Returns whether this object has acquired a tool and not released it.
    pub(crate) async fn holds(&self, tool: u32) -> bool {
        self.leases.lock().await.contains_key(&tool)
    }

    /// Releases a tool, which ends what it did.
    pub(crate) async fn release(self: Arc<Self>, session: Arc<Followed>, tool: u32) -> Result<(), Error> {
        let Some(lease_id) = self.leases.lock().await.remove(&tool) else { return Ok(()) };
        let request = pb::ReleaseToolRequest { session_id: session.session_id().to_owned(), lease_id };
        let released = session.call(|channel| {
            let request = request.clone();
            async move { haptics(channel).release_tool(request).await }
        });
        match released.await {
            Err(error) if is_lost(&error) => Ok(()),
            released => released.map(drop),
        }
    }
}
