//! Fetches a session's tissue and makes a copy of it, beside the haptic stream.

use palpate_proto::pb;
use palpate_touch::{Predictor, Tip};
use pb::session_service_client::SessionServiceClient;
use tokio::task::JoinSet;

use super::{MakeCopy, Prediction};
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
    /// At most one. What is under way ends when this is dropped.
    under_way: JoinSet<Made>,
}

impl Copying {
    /// Begins to make a copy, if the tissue is of a kind to be copied.
    pub(super) fn begin(prediction: Option<&Prediction>, session: &pb::Session, channel: Channel, tip: Tip) -> Self {
        let is_mesh = session.scene.as_ref().is_some_and(|scene| scene.mesh.is_some());
        let make =
            prediction.filter(|prediction| is_mesh || prediction.of_sheets).map(|prediction| prediction.make.clone());
        let session_id = session.session_id.clone();
        let mut copying = Copying { channel, session_id, tip, make, under_way: JoinSet::new() };
        copying.again();
        copying
    }

    /// Makes another copy: the tissue has changed.
    pub(super) fn again(&mut self) {
        let Some(make) = self.make.clone() else { return };
        self.under_way.abort_all();
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
                Some(Ok(made)) => return made,
                // One that was given up for a newer one.
                Some(Err(_)) => {}
                None => std::future::pending().await,
            }
        }
    }
}
