//! Renders recordings without a network: equal laws, samples and places give equal forces, bit by bit.

use glam::DVec3;
use palpate_haptics::{Device, Predictor};
use palpate_proto::pb;
use pb::touch_response::Message as Heard;
use prost::Message;

use super::ticker::{self, LoopFeed, PositionOrigin, Ticker, ToolPose};
use crate::Error;
use crate::exchange::QueueReader;

/// A loop that renders a recording instead of a server's messages.
#[derive(Debug)]
pub struct Offline {
    /// The half of the loop.
    pub ticker: Ticker,
    /// The half of the network, which you feed with the recording. It may be on another thread.
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
    /// Creates a loop for a device whose forces stay within its limits, with the middle of its workspace at
    /// `origin_m` of the tissue, m. `up_deadband` is that of [`super::Target`]; it changes no force.
    pub fn new(device: Device, origin: PositionOrigin, origin_m: DVec3, up_deadband: f64) -> Self {
        let (ticker, feed, commands) = ticker::ticker(device, origin, up_deadband);
        Offline { ticker, record: OfflineNetwork { feed, commands, origin_m } }
    }
}

impl OfflineNetwork {
    /// Delivers a copy of the tissue, which is rendered until the next connection begins.
    pub fn predict(&mut self, copy: Box<dyn Predictor>) {
        self.feed.predict(Some(copy));
    }

    /// Delivers a server message (`TouchResponse` bytes) to the bridge. The next tick uses it. An `opened` message
    /// starts another connection. Discards the commands that the ticks have produced until now.
    ///
    /// # Errors
    /// Returns an error if the bytes are not a message, or if a force law can't be used.
    pub fn arrive(&mut self, bytes: &[u8]) -> Result<(), Error> {
        while self.commands.pop().is_some() {}
        let response = pb::TouchResponse::decode(bytes)
            .map_err(|error| Error::Argument(format!("the bytes are not a TouchResponse: {error}")))?;
        match response.message {
            Some(Heard::Opened(opened)) => {
                let law = opened.law.ok_or_else(|| Error::Argument("`opened` has no force law".to_owned()))?;
                self.feed.begin(&law, self.origin_m)
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
