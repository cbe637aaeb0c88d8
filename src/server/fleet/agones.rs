//! What Agones is told of this server, if it runs under it.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use super::Fleet;
use palpate_cluster::agones::{self, ServerStatus};

impl Fleet {
    /// Tells Agones for ever; without `cluster.agones` nothing at all.
    pub(super) async fn tell_agones(self: Arc<Self>) {
        if !self.config.cluster.agones {
            return;
        }
        let seen = || ServerStatus {
            acts: self.pacer.fence.may_act(),
            sessions: self.pacer.list().len(),
            draining: self.is_draining.load(Ordering::Relaxed),
        };
        agones::tell(agones::port(), seen).await;
    }
}
