//! The bridge between a session that it watches, like any viewer, and the topics that Foxglove gets.

use palpate_client::view::Frames;
use palpate_client::watch::Samples;
use palpate_client::{Channel, Error, Followed, describe};
use palpate_proto::pb;
use pb::haptic_service_client::HapticServiceClient;
use tonic::{Status, Streaming};

use super::FoxgloveArguments;
use super::topics::{RestVertices, Topics};
use crate::{ClientFailure, interrupted, warn};

/// What is watched of a session.
struct WatchedSession {
    rest: RestVertices,
    frames: Frames,
    samples: Samples,
    records: Streaming<pb::ProbeResponse>,
}

impl WatchedSession {
    /// Starts to watch a session, with a sample and a record every `every_steps`.
    async fn open(channel: Channel, session_id: String, every_steps: u32, frames_hz: f64) -> Result<Self, Status> {
        let rest = RestVertices::get(channel.clone(), &session_id).await?;
        let request =
            pb::WatchFramesRequest { session_id: session_id.clone(), rate_hz: Some(frames_hz), ..Default::default() };
        let frames = Frames::open(channel.clone(), request).await?;
        let request = pb::WatchSamplesRequest {
            session_id: session_id.clone(),
            sample_every_steps: Some(every_steps),
            ..Default::default()
        };
        let samples = Samples::open(channel.clone(), request).await?;
        let request = pb::ProbeRequest {
            session_id,
            r#where: Some(pb::probe_request::Where::Points(pb::GridPoints::default())),
            every_steps: Some(every_steps),
            energy: true,
            tools: true,
        };
        let records = HapticServiceClient::new(channel).probe(request).await?.into_inner();
        Ok(WatchedSession { rest, frames, samples, records })
    }

    /// Sends what arrives, until a stream ends. Returns why, or how a topic failed.
    async fn forward(&mut self, topics: &mut Topics) -> Result<Status, String> {
        let ended = || Status::aborted("the server has ended the stream");
        loop {
            tokio::select! {
                frame = self.frames.next() => match frame {
                    Ok(Some((_, surface))) => topics.frame(&self.rest, surface),
                    Ok(None) => return Ok(ended()),
                    Err(status) => return Ok(status),
                },
                sample = self.samples.next() => match sample {
                    Ok(Some(sample)) => topics.sample(&self.rest, &sample)?,
                    Ok(None) => return Ok(ended()),
                    Err(status) => return Ok(status),
                },
                record = self.records.message() => match record {
                    Ok(Some(record)) => topics.record(&record)?,
                    Ok(None) => return Ok(ended()),
                    Err(status) => return Ok(status),
                },
            }
        }
    }
}

/// Watches a session for Foxglove until it is interrupted or the session ends.
pub(super) async fn bridge(arguments: &FoxgloveArguments) -> Result<(), ClientFailure> {
    let server = arguments.credentials.server(&arguments.server)?;
    let channel = server.connect().await?;
    let (session, status) = Followed::find(server, channel, arguments.session.clone()).await?;
    let rate_hz = status.scene.and_then(|scene| scene.stepping).and_then(|stepping| stepping.rate_hz).unwrap_or(1000.0);
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let every_steps = (rate_hz / arguments.curves_hz).round().max(1.0) as u32;
    let frames_hz = arguments.frames_hz.min(rate_hz);
    let mut topics = Topics::serve(arguments.listen).await.map_err(ClientFailure::Failed)?;
    if !arguments.listen.ip().is_loopback() {
        warn("other machines can reach this address, and everyone there can watch the session");
    }
    crate::tell!("Foxglove connects to ws://{}:{}", arguments.listen.ip(), topics.port());
    let watching = async {
        loop {
            let id = || session.session_id().to_owned();
            let mut watched =
                session.call(|channel| WatchedSession::open(channel, id(), every_steps, frames_hz)).await?;
            let ended = watched.forward(&mut topics).await.map_err(ClientFailure::Failed)?;
            // At another server of its fleet, perhaps.
            session.after(ended).await.map_err(|error| match error {
                Error::Call(status) => ClientFailure::Failed(describe(&status)),
                error => error.into(),
            })?;
        }
    };
    let ended = tokio::select! {
        ended = watching => ended,
        () = interrupted() => Ok(()),
    };
    topics.stop().await;
    ended
}
