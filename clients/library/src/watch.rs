//! The samples of a session: what its tools do and feel, without holding one.

use palpate_proto::pb;
use pb::haptic_service_client::HapticServiceClient;
use tonic::{Status, Streaming};

use crate::connect::Channel;

/// The samples of a session. The stream ends when this is dropped.
///
/// ```no_run
/// use palpate_client::watch::Samples;
/// use palpate_proto::pb;
///
/// # async fn example(channel: palpate_client::Channel, session_id: String) -> Result<(), tonic::Status> {
/// // A sample of every tenth step: 100 a second of a session at 1 kHz.
/// let request = pb::WatchSamplesRequest { session_id, sample_every_steps: Some(10), ..Default::default() };
/// let mut samples = Samples::open(channel, request).await?;
/// while let Some(sample) = samples.next().await? {
///     println!("{:.3} s: {} tools", sample.simulation_time_s, sample.tools.len());
/// }
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct Samples {
    samples: Streaming<pb::WatchSamplesResponse>,
    /// The largest ownership revision seen.
    revision: u64,
}

impl Samples {
    /// Starts to watch the samples that `request` describes, and waits until the server accepts. Sets no time limit.
    ///
    /// # Errors
    /// Returns the server's refusal, or how the connection broke.
    pub async fn open(channel: Channel, request: pb::WatchSamplesRequest) -> Result<Self, Status> {
        let samples = HapticServiceClient::new(channel).watch_samples(request).await?.into_inner();
        Ok(Samples { samples, revision: 0 })
    }

    /// Waits for the next sample and returns it; `None` after the server has ended the stream without an error. Skips
    /// samples with a smaller ownership revision than one before: their server no longer owns the session. Dropping
    /// the future loses no sample.
    ///
    /// # Errors
    /// Returns why the server ended the stream, or how the connection broke.
    pub async fn next(&mut self) -> Result<Option<pb::Sample>, Status> {
        while let Some(response) = self.samples.message().await? {
            let Some(sample) = response.sample else { continue };
            if sample.ownership_revision >= self.revision {
                self.revision = sample.ownership_revision;
                return Ok(Some(sample));
            }
        }
        Ok(None)
    }
}
