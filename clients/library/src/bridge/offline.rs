//! Renders recordings without a network: equal laws, samples and places give equal forces, bit by bit.

use glam::DVec3;
use palpate_haptics::{Device, Predictor};
use palpate_proto::pb;
use pb::touch_response::Message as Heard;
use prost::Message;

use super::ticker::{self, LoopFeed, PositionOrigin, Ticker, ToolPose};
use crate::Error;
use crate::exchange::QueueReader;

/// A loop that renders a recording instead of a server's messages, in two halves that share queues.
#[derive(Debug)]
pub struct Offline {
    /// The half of the loop, which you call for each tick of the recording.
    pub ticker: Ticker,
    /// The half of the network, which you feed with the recorded messages between the ticks. It may be on another
    /// thread; for equal forces, each message must arrive between the same two ticks.
    pub record: OfflineNetwork,
}

/// The network half of an offline loop: delivers recorded messages to the ticker.
pub struct OfflineNetwork {
    feed: LoopFeed,
    commands: QueueReader<ToolPose>,
    origin_m: DVec3,
}

impl std::fmt::Debug for OfflineNetwork {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Record").field("origin_m", &self.origin_m).finish_non_exhaustive()
    }
}

impl Offline {
    /// Creates a loop that keeps the forces within the limits of `device`. `origin` is the frame of the readings that
    /// the ticks get. `origin_m` is the middle of the device's workspace in the tissue's frame, m. `up_deadband` is
    /// the fraction of the force below which a pose is not sent ([`super::Target::up_deadband`]; 0: one per tick):
    /// nothing is sent offline, and it changes no force. Forces are zero until an `opened` message arrives.
    pub fn new(device: Device, origin: PositionOrigin, origin_m: DVec3, up_deadband: f64) -> Self {
        let (ticker, feed, commands) = ticker::ticker(device, origin, up_deadband);
        Offline { ticker, record: OfflineNetwork { feed, commands, origin_m } }
    }
}

impl OfflineNetwork {
    /// Delivers a copy of the tissue. The ticks render from it until the next copy, or until the next `opened`
    /// message. Before the first `opened` message, it has no effect.
    pub fn predict(&mut self, copy: Box<dyn Predictor>) {
        self.feed.predict(Some(copy));
    }

    /// Delivers a server message (the bytes of a `TouchResponse`), which the next tick uses. `opened` starts another
    /// connection and must come first; force laws and samples have an effect, other messages none. Discards the
    /// commands that the ticks have produced until now.
    ///
    /// # Errors
    /// Returns [`Error::Argument`] if the bytes are not a message or `opened` has no force law, and
    /// [`Error::Connection`] if a force law is not valid. The message then has no effect.
    pub fn arrive(&mut self, bytes: &[u8]) -> Result<(), Error> {
        while self.commands.pop().is_some() {}
        let response = pb::TouchResponse::decode(bytes)
            .map_err(|error| Error::Argument(format!("the bytes are not a TouchResponse: {error}")))?;
        match response.message {
            Some(Heard::Opened(opened)) => {
                let law = opened.law.ok_or_else(|| Error::Argument("`opened` has no force law".to_owned()))?;
                self.feed.begin(Some(&law), self.origin_m)
            }
            Some(Heard::ForceLaw(update)) => update.law.iter().try_for_each(|law| self.feed.learn(law)),
            Some(Heard::Sample(sample)) => {
                self.feed.receive(&sample, 0.0);
                Ok(())
            }
            _ => Ok(()),
        }
    }
}
