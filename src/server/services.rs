//! State that all services share.

use std::sync::Arc;

use super::catalog::Catalog;
use super::config::Config;
use super::datagrams::Datagrams;
use super::fleet::Fleet;
use super::job_pool::JobPool;
use super::journals::recorded::Recorded;
use super::meshes::Meshes;
use super::session_instruments::SessionInstruments;
use super::status;
use super::textures::Textures;
use super::traffic::Traffic;
use palpate_proto::pb;
use palpate_realtime::{Pacer, SessionHandle};
use palpate_refusal::{Reason, Refusal, Result};

/// The state that every service needs.
#[derive(Clone)]
pub(crate) struct Services {
    pub(crate) config: Arc<Config>,
    pub(super) datagrams: Datagrams,
    pub(crate) catalog: Catalog,
    pub(crate) pacer: Arc<Pacer>,
    pub(crate) textures: Textures,
    pub(crate) meshes: Meshes,
    /// Creates and changes sessions, reads meshes and scripts and computes force laws.
    pub(crate) job_pool: JobPool,
    pub(crate) traffic: Arc<Traffic>,
    pub(super) recorded: Arc<Recorded>,
    pub(super) instruments: SessionInstruments,
    /// The fleet that this server belongs to, if any.
    pub(super) fleet: Option<Arc<Fleet>>,
}

impl Services {
    /// Returns the session with that ID.
    ///
    /// # Errors
    /// Refuses an unknown ID, a session that another server of the fleet has, and every ID while this server may not
    /// act for its sessions.
    pub(super) async fn session(&self, id: &str) -> Result<Arc<SessionHandle>> {
        match (self.pacer.get(id), &self.fleet) {
            (Err(unknown), Some(fleet)) if unknown.reason == Reason::UnknownSession => {
                Err(fleet.refuse(id, unknown).await)
            }
            (found, _) => found,
        }
    }

    /// Returns a session as the message that clients receive, with its owner if the server belongs to a fleet.
    pub(super) fn told(&self, handle: &SessionHandle) -> pb::Session {
        let ownership = self.fleet.as_ref().map(|fleet| fleet.own(handle));
        pb::Session { ownership, ..status::session(handle) }
    }

    /// Returns the fleet that this server belongs to.
    ///
    /// # Errors
    /// Refuses if the server belongs to no fleet.
    pub(super) fn fleet(&self) -> Result<&Arc<Fleet>> {
        self.fleet.as_ref().ok_or_else(|| {
            Refusal::new(Reason::NotAvailable, "", "this server belongs to no fleet (`palpate serve --cluster`)")
        })
    }
}
