//! Reports the state of this server to Agones, if it runs under it.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use super::Fleet;
use palpate_cluster::agones::{self, ServerStatus};

impl Fleet {
    /// Reports to Agones until the server ends. Returns at once without `cluster.agones`.
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
