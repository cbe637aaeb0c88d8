//! The samples of a session: what its tools do and feel, without holding one.

use palpate_proto::pb;
use pb::haptic_service_client::HapticServiceClient;
use tonic::{Status, Streaming};

use crate::connect::Channel;

/// The samples of a session. The stream ends when this is dropped.
#[derive(Debug)]
pub struct Samples(Streaming<pb::WatchSamplesResponse>);

impl Samples {
    /// Begins to watch.
    ///
    /// # Errors
    /// Returns the server's refusal, or how the connection broke.
    pub async fn open(channel: Channel, request: pb::WatchSamplesRequest) -> Result<Self, Status> {
        Ok(Samples(HapticServiceClient::new(channel).watch_samples(request).await?.into_inner()))
    }

    /// The next sample; `None` after the last. A sample is not lost if you drop the future.
    ///
    /// # Errors
    /// Returns why the server ended the stream, or how the connection broke.
    pub async fn next(&mut self) -> Result<Option<pb::Sample>, Status> {
        while let Some(response) = self.0.message().await? {
            if response.sample.is_some() {
                return Ok(response.sample);
            }
        }
        Ok(None)
    }
}
