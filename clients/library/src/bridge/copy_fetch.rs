//! Fetches a session's tissue and builds a local copy of it, in parallel with the haptic stream; then what is severed in that tissue.

use std::sync::Arc;

use palpate_haptics::{Instrument, Predictor};
use palpate_proto::pb;
use pb::session_service_client::SessionServiceClient;
use tokio::sync::Semaphore;

use super::Copies;
use super::background_call::BackgroundCall;
use super::copy_thread::{self, MadeCopy};
use super::cut_fetch::CutsFollower;
use crate::Error;
use crate::connect::Channel;
use crate::snapshot;

/// Limit on the bytes of a snapshot: no client could step a larger tissue in time.
const MAX_BYTES: usize = 64 << 20;

/// Builds copies for a bridge, over all its connections. One at a time, since nothing stops the thread of a copy
/// until its step ends.
#[derive(Clone)]
pub(super) struct Copier {
    copies: Copies,
    places: Arc<Semaphore>,
}

impl Copier {
    pub(super) fn new(copies: Copies) -> Self {
        Copier { copies, places: Arc::new(Semaphore::new(1)) }
    }
}

/// The copies of one connection.
pub(super) struct Copying {
    channel: Channel,
    session_id: String,
    instrument: Instrument,
    /// `None`: this tissue is not copied.
    copier: Option<Copier>,
    call: BackgroundCall<MadeCopy>,
    follower: CutsFollower,
}

impl Copying {
    /// Creates the copying of a session's tissue, if `copier` copies such tissues.
    pub(super) fn new(
        copier: Option<&Copier>,
        session: &pb::Session,
        channel: Channel,
        instrument: Instrument,
    ) -> Self {
        let is_grid = session.scene.as_ref().is_some_and(|scene| palpate_proto::scene::grid(scene).is_some());
        // A trainee gets no copy of a tissue in which something is hidden.
        let is_hidden = session.exercise.as_ref().is_some_and(|of| {
            of.role() == pb::ExerciseRole::Trainee && of.exercise.as_ref().is_some_and(|exercise| exercise.hides_truth)
        });
        let copier = copier.filter(|copier| !is_hidden && (!is_grid || copier.copies.of_grids)).cloned();
        let session_id = session.session_id.clone();
        let follower = CutsFollower::new(channel.clone(), session_id.clone());
        Copying { channel, session_id, instrument, copier, call: BackgroundCall::none(), follower }
    }

    /// Returns whether this tissue is copied.
    pub(super) fn is_wanted(&self) -> bool {
        self.copier.is_some()
    }

    /// Starts building a copy of the current tissue. Aborts an earlier one that is not finished.
    pub(super) fn begin(&mut self) {
        self.follower.follow(None);
        let Some(Copier { copies: Copies { make, .. }, places }) = self.copier.clone() else { return };
        let (channel, session_id, instrument) =
            (self.channel.clone(), self.session_id.clone(), self.instrument.clone());
        self.call.begin(async move {
            let none = |_| Error::Internal("no copy of the tissue is made any more".to_owned());
            let permit = places.acquire_owned().await.map_err(none)?;
            let request = pb::SaveSnapshotRequest { session_id };
            let parts = SessionServiceClient::new(channel).save_snapshot(request).await?.into_inner();
            let bytes = snapshot::collect_within(parts, MAX_BYTES).await?;
            let none = |error| Error::Internal(format!("no thread for a copy of the tissue: {error}"));
            let made = copy_thread::made_apart(move || make(&bytes, &instrument), permit).map_err(none)?;
            let panicked = |_| Error::Internal("making a copy of the tissue panicked".to_owned());
            made.await.map_err(panicked)?.map_err(Error::Argument)
        });
    }

    /// Fetches what was severed for the copy, if it lacks the version of the topology in a sample.
    pub(super) fn look(&mut self, topology_version: u32) {
        self.follower.look(topology_version);
    }

    /// Returns the copy, once it is built, and passes reports of cuts to it meanwhile. Dropping the future loses nothing.
    pub(super) async fn next(&mut self) -> Result<Box<dyn Predictor>, Error> {
        loop {
            tokio::select! {
                made = self.call.result() => {
                    let made = made?;
                    self.follower.follow(made.cuts);
                    return Ok(made.copy);
                }
                () = self.follower.passed_on() => {}
            }
        }
    }
}
