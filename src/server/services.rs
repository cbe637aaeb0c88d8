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
use super::trainee::{Seat, not_for_trainee};
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
            (Err(_), None) if self.pacer.get_for_trainee(id).is_some() => Err(not_for_trainee()),
            (found, _) => found,
        }
    }

    /// Returns the session that an ID opens for a call, as its trainer or a trainee.
    ///
    /// # Errors
    /// Returns the refusals of [`Services::session`], and refuses a call that a trainee's ID does not open.
    pub(super) async fn seat(&self, call: &str, id: &str) -> Result<Seat> {
        match self.pacer.get_for_trainee(id) {
            Some(handle) => Seat::of_trainee(handle?, call),
            None => self.session(id).await.map(Seat::of_trainer),
        }
    }

    /// Refuses a trainee's ID in a call about the recording of a session.
    ///
    /// # Errors
    /// Refuses the ID of a trainee ([`Reason::NotForTrainee`]).
    pub(super) fn check_not_for_trainee(&self, id: &str) -> Result<()> {
        self.pacer.get_for_trainee(id).map_or(Ok(()), |_| Err(not_for_trainee()))
    }

    /// Returns a session as the message that a caller receives, by the ID that it has sent.
    pub(super) fn told_to(&self, seat: &Seat) -> pb::Session {
        match &seat.trainee {
            Some(exercise) => status::of_trainee(&seat.handle, exercise),
            None => self.told(&seat.handle),
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
