//! Connects a haptic device to a server: a loop at 1 kHz on a thread of its own, and the network beside it.
//!
//! When the connection breaks, the network side connects again. Forces return when the operator asks for them. Commands that
//! were not sent by then are dropped: nothing old is replayed.

mod line;
mod tick;

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use palpate_touch::{Envelope, Tip};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinSet;

use crate::Error;
use crate::connect::Server;
use crate::device::HapticDevice;
use line::Shared;

pub use line::Traffic;
pub use tick::{TICK_S, Tick};

/// What a device is connected to.
#[derive(Debug, Clone)]
pub struct Target {
    /// The server.
    pub server: Server,
    /// The session to touch.
    pub session: Session,
    /// The number of the tool that the device moves.
    pub tool: u32,
    /// The tool's tip.
    pub tip: Tip,
    /// A sample is sent only when the rendered force would be off by more than this fraction; 0: one per step.
    pub deadband: f64,
    /// A pose is sent only when the server would be wrong about the tool by more than this fraction of the force; 0: one per tick.
    pub up_deadband: f64,
    /// Whether poses and samples go by datagram where the server has them.
    pub datagrams: bool,
    /// The holder's name, which other users of the server see.
    pub holder: String,
}

/// A session to touch.
#[derive(Debug, Clone)]
pub enum Session {
    /// The session with this ID.
    Existing(String),
    /// A new one, and again a new one if the server has forgotten it. It is deleted at the end.
    New {
        /// The name of a scene of the server.
        scene: String,
    },
}

/// A function that shows a text to people.
pub type Warn = Box<dyn Fn(&str) + Send + Sync>;

/// Options of [`run`].
#[derive(Default)]
pub struct Options {
    /// Time after which it ends; `None`: no limit.
    pub lasts: Option<Duration>,
    /// Keeps the course and the ages of the models, of at most an hour.
    pub remembers: bool,
    /// Keeps the session that was made for the target, for others; the server deletes it when nobody has used it for long.
    pub keeps_session: bool,
    /// Called when the connection breaks, and with the server's warnings.
    pub warn: Option<Warn>,
}

impl fmt::Debug for Options {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Options { lasts, remembers, keeps_session, warn } = self;
        let mut fields = f.debug_struct("Options");
        fields.field("lasts", lasts).field("remembers", remembers).field("keeps_session", keeps_session);
        fields.field("warn", &warn.is_some()).finish()
    }
}

/// The results of [`run`].
#[derive(Debug)]
pub struct Report {
    /// The ticks; empty unless they were to be remembered.
    pub course: Vec<Tick>,
    /// Age of the local model at each tick, s; empty unless it was to be remembered.
    pub ages_s: Vec<f64>,
    /// The renderer's envelope at the end.
    pub envelope: Option<Envelope>,
    /// Number of ticks that began more than a tick late.
    pub late_ticks: u64,
    /// Number of ticks that were skipped.
    pub missed_ticks: u64,
    /// What went over the network.
    pub traffic: Traffic,
    /// Why there was no connection any more at the end.
    pub lost: Option<Error>,
}

/// Connects a device until its time is over or `stop` completes. Returns the device and the results. The last force written
/// to the device is zero, also after an error and if you drop the future.
///
/// # Errors
/// Returns an error if the device fails, if the server refuses the session or the tool at first, or if no connection
/// succeeds.
pub async fn run<D: HapticDevice + 'static>(
    mut device: D,
    target: Target,
    options: Options,
    stop: impl Future<Output = ()> + Send + 'static,
) -> Result<(D, Report), Error> {
    let Options { lasts, remembers, keeps_session, warn } = options;
    let server = target.server.clone();
    let shared = Arc::new(Shared::default());
    let (commands, received) = mpsc::channel(line::COMMANDS);
    let descriptor = device.descriptor();
    let up_deadband = target.up_deadband;
    // If this future is dropped, the task is aborted; the loop then finds its channel closed and ends.
    let mut network = JoinSet::new();
    network.spawn({
        let shared = shared.clone();
        async move {
            let warn = |message: &str| warn.iter().for_each(|warn| warn(message));
            tokio::select! {
                () = line::keep(target, descriptor, &shared, received, &warn) => {}
                // The loop then finds its channel closed.
                () = stop => {}
            }
        }
    });
    let (tell, ended) = oneshot::channel();
    std::thread::Builder::new().name("device".to_owned()).spawn({
        let shared = shared.clone();
        move || {
            let served = tick::serve(&mut device, &shared, &commands, up_deadband, lasts, remembers);
            drop(commands);
            let _ = tell.send((device, served));
        }
    })?;
    let (device, served) = ended.await.map_err(|_| Error::Internal("the device's loop panicked".to_owned()))?;
    // The task may wait for an answer that never arrives.
    network.shutdown().await;
    if !keeps_session {
        line::delete_made(server, &shared).await;
    }
    let tick::Served { course, envelope, late_ticks, missed_ticks, ages_s } = served?;
    let mut inbound = shared.inbound();
    let (traffic, lost) = (inbound.traffic, inbound.failure.take());
    if traffic.connections == 0 {
        let silent = || Error::Connection("never connected: the server did not answer in time".to_owned());
        return Err(lost.unwrap_or_else(silent));
    }
    Ok((device, Report { course, ages_s, envelope, late_ticks, missed_ticks, traffic, lost }))
}
