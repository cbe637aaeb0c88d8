//! Watches the etcd keys of this server's sessions: if anyone else has written another owner (an administrator with
//! etcdctl, for example), the session ends here. Otherwise two servers would step it.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::sleep;
use tracing::warn;

use super::Fleet;
use super::owned::Found;
use palpate_cluster::etcd::{WatchError, WatchEvent};
use palpate_cluster::key::{SessionValue, decode};
use palpate_refusal::Result;
use palpate_tissue::lock::lock;

/// Pause before another try after a failure.
const PAUSE: Duration = Duration::from_millis(500);

impl Fleet {
    /// Watches the keys until the server ends.
    pub(super) async fn follow_owned(self: Arc<Self>) {
        let prefix = self.keys.sessions();
        loop {
            let Ok(revision) = self.look_at_owned(&prefix).await else {
                sleep(PAUSE).await;
                continue;
            };
            let mut watch = self.etcd.watch(&prefix, revision + 1);
            loop {
                let events = match watch.next().await {
                    Ok(events) => events,
                    Err(WatchError::Compacted { .. }) => break,
                    Err(error) => {
                        warn!("{error}");
                        sleep(PAUSE).await;
                        break;
                    }
                };
                for event in events {
                    // A deleted key names no other owner: the session continues.
                    let WatchEvent::Put(found) = event else { continue };
                    let id = found.key.strip_prefix(&prefix);
                    if let (Some(id), Some(value)) = (id, decode::<SessionValue>(&found.value)) {
                        self.is_owned_by(id, value, found.mod_revision);
                    }
                }
            }
        }
    }

    /// Checks the keys of all sessions. Returns their revision.
    async fn look_at_owned(&self, prefix: &str) -> Result<u64> {
        let (found, revision) = self.etcd.list(prefix).await.map_err(super::of_etcd)?;
        for found in found {
            if let (Some(id), Some(value)) = (found.key.strip_prefix(prefix), decode::<SessionValue>(&found.value)) {
                self.is_owned_by(id, value, found.mod_revision);
            }
        }
        Ok(revision)
    }

    /// Ends a session here if its key has named another owner since `revision`. Sessions that are being handed over
    /// are left to the task that does that.
    fn is_owned_by(&self, id: &str, value: SessionValue, revision: u64) {
        let is_newer = self.revision(id).is_some_and(|own| own < revision);
        if !is_newer || value.node == self.node || lock(&self.moving).contains(id) {
            return;
        }
        warn!(session = %id, node = value.node, "etcd names another server as the owner of this session: it ends here");
        self.tally.lost.one_more();
        let found: Found = Some((value, revision));
        self.lose(id, self.is_lost(found));
    }
}
