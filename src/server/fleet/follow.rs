//! Follows the keys of this server's sessions: where another than this server has written another owner (an administrator with
//! etcdctl, say), the session ends here. Otherwise two servers would step it.

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

/// After a failure it is tried again so soon.
const PAUSE: Duration = Duration::from_millis(500);

impl Fleet {
    /// Follows for ever.
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
                    // A key that is deleted says of nobody that it has the session: it goes on.
                    let WatchEvent::Put(found) = event else { continue };
                    let id = found.key.strip_prefix(&prefix);
                    if let (Some(id), Some(value)) = (id, decode::<SessionValue>(&found.value)) {
                        self.is_owned_by(id, value, found.mod_revision);
                    }
                }
            }
        }
    }

    /// Looks at all keys of sessions. Tells the revision.
    async fn look_at_owned(&self, prefix: &str) -> Result<u64> {
        let (found, revision) = self.etcd.list(prefix).await.map_err(super::of_etcd)?;
        for found in found {
            if let (Some(id), Some(value)) = (found.key.strip_prefix(prefix), decode::<SessionValue>(&found.value)) {
                self.is_owned_by(id, value, found.mod_revision);
            }
        }
        Ok(revision)
    }

    /// A key says since `revision` who has a session. One that is being handed over is looked at by who does that.
    fn is_owned_by(&self, id: &str, value: SessionValue, revision: u64) {
        let is_newer = self.revision(id).is_some_and(|own| own < revision);
        if !is_newer || value.node == self.node || lock(&self.moving).contains(id) {
            return;
        }
        warn!(session = %id, node = value.node, "etcd says that another server has this session: it ends here");
        self.tally.lost.one_more();
        let found: Found = Some((value, revision));
        self.lose(id, self.is_lost(found));
    }
}
