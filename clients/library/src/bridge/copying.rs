//! Fetches a session's tissue and makes a copy of it, beside the haptic stream.

use palpate_proto::pb;
use palpate_touch::{Predictor, Tip};
use pb::session_service_client::SessionServiceClient;
use tokio::task::JoinSet;

use super::{Copies, MakeCopy};
use crate::Error;
use crate::connect::Channel;
use crate::snapshot;

type Made = Result<Box<dyn Predictor>, Error>;

/// The copy of one connection.
pub(super) struct Copying {
    channel: Channel,
    session_id: String,
    tip: Tip,
    /// None: this tissue is not copied.
    make: Option<MakeCopy>,
    /// At most one, which ends when this is dropped.
    under_way: JoinSet<Made>,
    /// What is under way is of a tissue that has changed since.
    is_old: bool,
}

impl Copying {
    /// Of a session's tissue, if that is of a kind to be copied.
    pub(super) fn new(copies: Option<&Copies>, session: &pb::Session, channel: Channel, tip: Tip) -> Self {
        let is_mesh = session.scene.as_ref().is_some_and(|scene| scene.mesh.is_some());
        let make = copies.filter(|copies| is_mesh || copies.of_sheets).map(|copies| copies.make.clone());
        let session_id = session.session_id.clone();
        Copying { channel, session_id, tip, make, under_way: JoinSet::new(), is_old: false }
    }

    /// Begins to make a copy of the tissue as it is now, after the one that is under way: nothing stops that once it is being made.
    pub(super) fn begin(&mut self) {
        self.is_old = !self.under_way.is_empty();
        let Some(make) = self.make.clone().filter(|_| !self.is_old) else { return };
        let (channel, session_id, tip) = (self.channel.clone(), self.session_id.clone(), self.tip);
        self.under_way.spawn(async move {
            let request = pb::SaveSnapshotRequest { session_id };
            let parts = SessionServiceClient::new(channel).save_snapshot(request).await?.into_inner();
            let bytes = snapshot::collect(parts).await?;
            let made = tokio::task::spawn_blocking(move || make(&bytes, tip)).await;
            let made = made.map_err(|_| Error::Internal("making a copy of the tissue panicked".to_owned()))?;
            made.map_err(Error::Argument)
        });
    }

    /// The copy, once it is made. None is lost if you drop the future.
    pub(super) async fn next(&mut self) -> Made {
        loop {
            match self.under_way.join_next().await {
                Some(_) if self.is_old => self.begin(),
                Some(made) => {
                    let panicked = |_| Error::Internal("fetching the tissue panicked".to_owned());
                    return made.map_err(panicked).flatten();
                }
                None => std::future::pending().await,
            }
        }
    }
}
