//! Connects a haptic device to a server: a loop at 1 kHz, and the network side in parallel.
//!
//! [`run`] runs the loop on a thread of its own. Code that has such a thread itself uses [`begin`] and calls
//! [`Ticker`]. [`Offline`] renders recordings, without a network.
//!
//! When the connection breaks, the network side connects again. Forces return when the operator requests them.
//! Commands that could not be sent in the meantime are dropped: outdated ones are never replayed.

mod background_call;
mod copy_fetch;
mod copy_thread;
mod cut_button;
mod cut_fetch;
mod hand_slot;
mod hands;
mod lateness;
mod line;
mod loop_renderer;
mod offline;
mod tick;
mod ticker;

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use palpate_haptics::{Device, Envelope, Instrument, Predictor, Tip};
use palpate_refusal::printable::printable;
use tokio::sync::{Notify, oneshot};
use tokio::task::JoinSet;

use crate::Error;
use crate::connect::Server;
use crate::device::HapticDevice;
use crate::os::{self, Priority};
use line::{Commands, SILENCE, Shared};

pub use cut_button::CutButton;
pub use hand_slot::{HandSlot, two_hand_slots};
pub use hands::{BridgeHand, two_hands};
pub use line::Traffic;
pub use offline::{Offline, OfflineNetwork};
pub use tick::{TICK_S, Tick};
pub use ticker::{PositionOrigin, Ticker};

/// The server, session and tool that a device is connected to.
#[derive(Debug, Clone)]
pub struct Target {
    /// The server's address and credentials.
    pub server: Server,
    /// The session to touch, which exists or is created.
    pub session: SessionChoice,
    /// Number of the session's tool that the device moves, from 0. No other caller may hold it.
    pub tool: u32,
    /// The tool's tip.
    pub tip: Tip,
    /// The server sends a sample only when the force rendered without it would be wrong by more than this fraction;
    /// 0: one per step.
    pub deadband: f64,
    /// The bridge sends a pose only when the server's prediction of the tool would be wrong by more than this
    /// fraction of the force; 0: one per tick.
    pub up_deadband: f64,
    /// Whether poses and samples go by datagram if the server offers datagrams.
    pub datagrams: bool,
    /// The name of the tool's holder, which other users of the server see.
    pub holder: String,
}

/// A session to touch.
#[derive(Debug, Clone)]
pub enum SessionChoice {
    /// The session with this ID.
    Existing(String),
    /// A new session, created again if the server no longer has it. It is deleted at the end.
    New {
        /// The name of one of the server's scenes.
        scene: String,
    },
}

/// A function that shows a text to people: one line without control characters. It may be called on any thread, and
/// must not wait.
pub type Warn = Box<dyn Fn(&str) + Send + Sync>;

/// A function that is called with the priority of a loop before it starts.
pub type Begun = Box<dyn FnOnce(&Priority) + Send>;

/// A function that builds a copy of a tissue for an instrument, which may be a single tip, from the bytes of a snapshot (`SaveSnapshot`, at
/// most 64 MiB), or returns why it can't. It is called on a thread of its own, for one copy at a time.
pub type MakeCopy = Arc<dyn Fn(&[u8], &Instrument) -> Result<Box<dyn Predictor>, String> + Send + Sync>;

/// Which tissues a loop copies, to render from the copy without the delay of the network
/// ([`palpate_haptics::prediction`]).
#[derive(Clone)]
pub struct Copies {
    /// The function that builds a copy.
    pub make: MakeCopy,
    /// Whether to copy tissues whose points are a grid too, for which local models are accurate anyway.
    pub of_grids: bool,
}

/// A switch that stops the forces of a loop, from any thread, until the operator requests them again. All clones
/// control the loop of the [`Options`] that one of them was given to.
#[derive(Debug, Clone, Default)]
pub struct Disable(Arc<AtomicBool>);

impl Disable {
    /// Stops rendering from the next tick on, until [`crate::Reading::enable`] changes from false to true. The force
    /// falls within the next ticks. Never waits.
    pub fn disable(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Returns whether it was called since the last time, and resets that.
    fn take(&self) -> bool {
        self.0.swap(false, Ordering::Relaxed)
    }
}

/// Options of [`run`] and [`begin`]. By default there is no time limit, nothing is recorded or shown, the priority is
/// the usual one, a created session is deleted at the end, and no tissue is copied. [`begin`] uses only
/// `keeps_session`, `warn`, `copies`, `hand`, `instrument` and `cut_button`.
#[derive(Default)]
pub struct Options {
    /// Time after which [`run`] ends, from the first tick, which does not wait for a connection; `None`: no limit.
    pub lasts: Option<Duration>,
    /// Whether [`run`] records its ticks (at most 3.6 million, an hour) and the ages of the models (without a limit).
    pub remembers: bool,
    /// Whether the loop of [`run`] requests real-time priority. [`BridgeReport::priority`] and `warn` report the
    /// result.
    pub real_time: bool,
    /// Whether to keep the session that was created for the target; the server deletes it when it is idle for long.
    pub keeps_session: bool,
    /// Called when the connection breaks, with the server's warnings, and at the end of [`run`] if no force was felt.
    pub warn: Option<Warn>,
    /// Called by the loop of [`run`] before its first tick, with its priority.
    pub begun: Option<Begun>,
    /// Keep a clone to stop the forces of [`run`]; with [`begin`], use [`Ticker::disable`].
    pub disable: Disable,
    /// Which tissues to copy; the loop renders from a copy as soon as there is one. Another thread builds and steps
    /// it, however long that takes: while it is late, or if it can't be built, forces come from local models. `None`:
    /// only from those.
    pub copies: Option<Copies>,
    /// One of the two hands of this client ([`two_hands`]), whose other one leads another tool or instrument of the same session:
    /// each copy of the tissue then has the tools of both without a delay, at most 32 of the other hand. `None`: this device is the
    /// only one.
    pub hand: Option<BridgeHand>,
    /// The instrument that the device leads, by its position, orientation and jaws; its tips are the tools from
    /// [`Target::tool`] on. Force and torque come from a copy of the tissue, so `copies` is needed. `None`: the single tip of
    /// [`Target::tip`].
    pub instrument: Option<Instrument>,
    /// The button of the device by which its single tip cuts while it is held. Forces then come from local models, as a copy of the tissue
    /// knows only the tip: not with `copies`, an instrument or [`Target::up_deadband`]. `None`: it never cuts.
    pub cut_button: Option<CutButton>,
}

impl fmt::Debug for Options {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Options {
            lasts,
            remembers,
            real_time,
            keeps_session,
            warn,
            begun,
            disable: _,
            copies,
            hand,
            instrument,
            cut_button,
        } = self;
        let mut fields = f.debug_struct("Options");
        fields.field("lasts", lasts).field("remembers", remembers).field("real_time", real_time);
        fields.field("keeps_session", keeps_session);
        fields.field("warn", &warn.is_some()).field("begun", &begun.is_some());
        fields.field("copies", &copies.is_some()).field("hand", &hand.is_some());
        fields.field("instrument", instrument).field("cut_button", cut_button).finish()
    }
}

/// The results of [`run`], over all its connections.
#[derive(Debug)]
pub struct BridgeReport {
    /// The ticks in order, at most 3.6 million; empty unless [`Options::remembers`] was set.
    pub course: Vec<Tick>,
    /// Age of the newest local model, s, at each tick of `course` that had one ([`Ticker::model_age_s`]), in order. Its
    /// indices are not those of `course`.
    pub ages_s: Vec<f64>,
    /// The envelope at the end: the limits that act on the forces. `None` if no tick had a connection.
    pub envelope: Option<Envelope>,
    /// Number of ticks that started more than a millisecond late.
    pub late_ticks: u64,
    /// Number of ticks that were skipped, because the loop was more than 5 ms late.
    pub missed_ticks: u64,
    /// Time by which ticks began after they were due, s: median, 99th percentile and longest, the first two rounded up
    /// to whole microseconds; skipped ticks don't count. Zeros without a tick.
    pub tick_lateness_s: [f64; 3],
    /// Number of ticks that were rendered from a copy of the tissue.
    pub predicted_ticks: u64,
    /// The largest magnitude of a rendered force, N.
    pub most_force_n: f64,
    /// The largest magnitude of a rendered torque, N·m; 0 without an instrument.
    pub most_torque_n_m: f64,
    /// The priority with which the loop ran.
    pub priority: Priority,
    /// Totals of what was sent and received.
    pub traffic: Traffic,
    /// The ID of the session that was created for the target, if any. It was deleted at the end unless
    /// [`Options::keeps_session`] was set.
    pub made: Option<String>,
    /// Why there was no connection at the end ([`Error::Connection`]); `None` if there was one.
    pub lost: Option<Error>,
    /// The error of the device that ended the loop; only set by [`run_told`].
    pub failure: Option<Error>,
}

/// Force below which no hand feels anything, N.
const MIN_FELT_N: f64 = 1e-3;

/// Displacement below which a tool counts as not having touched the tissue, m: motion left from an earlier touch is
/// smaller.
const MIN_MOVED_M: f64 = 1e-5;

impl BridgeReport {
    /// Returns a sentence that explains why no force was felt at all; `None` if one of at least 1 mN was.
    pub fn unfelt(&self) -> Option<&'static str> {
        if self.most_force_n >= MIN_FELT_N {
            return None;
        }
        Some(if self.traffic.deepest_m >= MIN_MOVED_M {
            "the tool moved the tissue, but no force was rendered: ask for forces while the tool is out of the tissue"
        } else {
            "the tool never touched the tissue: the device has its origin on the top of the surface, with z up"
        })
    }
}

/// Connects `device` to `target`, until [`Options::lasts`] has passed or `stop` completes, and connects again when a
/// connection breaks. Returns the device and the results. The loop starts at once, with forces of zero until the first
/// connection. The last force written to the device is zero, also after an error and if you drop the future, but not
/// after a panic of the device. Call it within a Tokio runtime.
///
/// # Errors
/// Returns [`Error::Device`] if the device fails or no thread can be started. If no connection was ever opened,
/// returns why: the server refuses the session or the tool, the caller's rights do not suffice, somebody else holds
/// the tool (these end the loop at once), or the server can't be reached until the end. Returns [`Error::Internal`]
/// if the loop panicked.
pub async fn run<D: HapticDevice + 'static>(
    device: D,
    target: Target,
    options: Options,
    stop: impl Future<Output = ()> + Send + 'static,
) -> Result<(D, BridgeReport), Error> {
    let (device, mut report) = run_told(device, target, options, stop).await?;
    report.failure.take().map_or(Ok((device, report)), Err)
}

/// Runs like [`run`], but if the device fails after the first connection, returns the results until then, with the
/// error in [`BridgeReport::failure`].
///
/// # Errors
/// Returns the errors of [`run`], that of the device only if no connection was opened before it.
pub async fn run_told<D: HapticDevice + 'static>(
    mut device: D,
    target: Target,
    mut options: Options,
    stop: impl Future<Output = ()> + Send + 'static,
) -> Result<(D, BridgeReport), Error> {
    let led = Led::of(&target, &mut options)?;
    let Options { lasts, remembers, real_time, keeps_session, warn, begun, disable, copies, .. } = options;
    let descriptor = device.descriptor();
    let warn = Arc::new(warn);
    let (ticker, mut line) =
        line(target, led, copies, descriptor, PositionOrigin::Workspace, keeps_session, warn.clone(), stop);
    let (news, of_loop) = (line.news.clone(), warn.clone());
    let (tell, ended) = oneshot::channel();
    std::thread::Builder::new().name("device".to_owned()).spawn(move || {
        let priority = if real_time { os::take_real_time_priority() } else { Priority::Usual };
        if let (Priority::Refused(why), Some(warn)) = (&priority, &*of_loop) {
            warn(&format!("the loop has no real-time priority, so other programs may delay it: {why}"));
        }
        if let Some(begun) = begun {
            begun(&priority);
        }
        let served = tick::serve(&mut device, ticker, &news, &disable, lasts, remembers);
        let _ = tell.send((device, served, priority));
    })?;
    let (device, served, priority) =
        ended.await.map_err(|_| Error::Internal("the device's loop panicked".to_owned()))?;
    let made = line.shared.inbound().made.clone();
    // The loop is over: the network side ends the stream, and the server releases the tool.
    let _ = tokio::time::timeout(SILENCE, line.network.join_next()).await;
    line.close().await;
    let tick::Served {
        course,
        envelope,
        late_ticks,
        missed_ticks,
        lateness,
        predicted_ticks,
        most_force_n,
        most_torque_n_m,
        ages_s,
        failure,
    } = served;
    let failure = failure.map(Error::Device);
    let mut inbound = line.shared.inbound();
    let (traffic, lost) = (inbound.traffic, inbound.failure.take());
    if traffic.connections == 0 {
        return Err(failure.or(lost).unwrap_or_else(silent));
    }
    let report = BridgeReport {
        course,
        ages_s,
        envelope,
        late_ticks,
        missed_ticks,
        tick_lateness_s: lateness.quantiles_s(),
        predicted_ticks,
        most_force_n,
        most_torque_n_m,
        priority,
        traffic,
        made,
        lost,
        failure,
    };
    if let (Some(why), Some(warn)) = (report.unfelt(), &*warn) {
        warn(why);
    }
    Ok((device, report))
}

fn silent() -> Error {
    Error::Connection("never connected: the server did not answer in time".to_owned())
}

/// What a loop leads.
struct Led {
    hand: Option<BridgeHand>,
    instrument: Option<Instrument>,
    cut_button: Option<CutButton>,
}

impl Led {
    /// # Errors
    /// Returns [`Error::Argument`] for a button that cuts with what that does not go with, or whose edge is not above 0; for an instrument without tips or without a copy of the tissue, or whose tools have no numbers.
    fn of(target: &Target, options: &mut Options) -> Result<Self, Error> {
        let Options { hand, instrument, copies, cut_button, .. } = options;
        if let Some(CutButton { length_m, .. }) = *cut_button {
            let is_alone = instrument.is_none() && copies.is_none() && target.up_deadband == 0.0;
            if !(is_alone && length_m > 0.0 && length_m.is_finite()) {
                let why = "cut_button: needs an edge above 0, and goes neither with an instrument nor with copies or `up_deadband`";
                return Err(Error::Argument(why.to_owned()));
            }
        }
        let refuse = |why: &str| Err(Error::Argument(format!("instrument: {why}")));
        if let Some(instrument) = instrument {
            let tips = u32::try_from(instrument.tips.len()).unwrap_or(u32::MAX);
            if tips == 0 || target.tool.checked_add(tips).is_none() {
                return refuse("has no tips, or its tools no numbers");
            }
            if copies.is_none() {
                return refuse("is rendered from a copy of the tissue: allow copies");
            }
        }
        Ok(Led { hand: hand.take(), instrument: instrument.take(), cut_button: *cut_button })
    }
}

/// Starts to connect in a task. Returns the half of the loop and the connection.
#[allow(clippy::too_many_arguments)] // Its callers have them all.
fn line(
    target: Target,
    led: Led,
    copies: Option<Copies>,
    device: Device,
    origin: PositionOrigin,
    keeps_session: bool,
    warn: Arc<Option<Warn>>,
    stop: impl Future<Output = ()> + Send + 'static,
) -> (Ticker, Connection) {
    let server = target.server.clone();
    let (ticker, feed, queue) = ticker::ticker(device, origin, target.up_deadband);
    let Led { hand, instrument, cut_button } = led;
    let ticker = ticker.of_hand(hand, target.tool, target.tip).of_instrument(instrument.clone());
    let (shared, news) = (Arc::new(Shared::default()), Arc::new(Notify::new()));
    let is_stopped = Arc::new(AtomicBool::new(false));
    let commands = Commands { queue, news: news.clone(), is_stopped: is_stopped.clone() };
    let mut network = JoinSet::new();
    network.spawn({
        let (shared, news) = (shared.clone(), news.clone());
        async move {
            // The text may contain parts that a server has written.
            let warn = |message: &str| warn.iter().for_each(|warn| warn(&printable(message)));
            let kept = line::keep(target, instrument, cut_button, copies, device, &shared, feed, commands, &warn);
            tokio::pin!(kept);
            tokio::select! {
                () = &mut kept => return,
                () = stop => {}
            }
            is_stopped.store(true, Ordering::Relaxed);
            news.notify_one();
            // Until the server has released the tool. The loop then detects that it is over.
            let _ = tokio::time::timeout(SILENCE, kept).await;
        }
    });
    (ticker, Connection { network, shared, news, server, keeps_session })
}

/// Interval at which the courier thread of [`begin`] checks for something to send.
const ROUND: Duration = Duration::from_micros(250);

/// Connects a loop of your own to `target`. Waits for the first connection, at most ten seconds; later ones are
/// opened automatically. `device` describes the limits of the forces; it is also sent to the server. `origin` is the
/// frame of the readings. Of `options`, only `keeps_session`, `warn`, `copies`, `hand` and `instrument` are used. Call it within a Tokio
/// runtime, which must run as long as the connection.
///
/// A tick wakes no thread, because that would be a call of the system. A courier thread notices within a quarter of a
/// millisecond that a tick has something to send.
///
/// # Errors
/// Returns the server's refusal of the session or the tool, [`Error::Connection`] if it can't be reached within ten
/// seconds, or [`Error::Device`] if no thread can be started.
pub async fn begin(
    target: Target,
    device: Device,
    origin: PositionOrigin,
    mut options: Options,
) -> Result<(Ticker, Connection), Error> {
    let led = Led::of(&target, &mut options)?;
    let Options { keeps_session, warn, copies, .. } = options;
    let (ticker, mut line) =
        line(target, led, copies, device, origin, keeps_session, Arc::new(warn), std::future::pending());
    let (commands, news) = (ticker.commands_view(), line.news.clone());
    std::thread::Builder::new().name("bridge-wake".to_owned()).spawn(move || {
        while !commands.is_over() {
            if commands.is_waiting() {
                news.notify_one();
            }
            std::thread::sleep(ROUND);
        }
        news.notify_one();
    })?;
    let is_open = tokio::select! {
        () = line.shared.opened.notified() => true,
        _ = line.network.join_next() => false,
        // A server may be unreachable for a long time.
        () = tokio::time::sleep(CONNECT_TIMEOUT) => false,
    };
    if is_open {
        return Ok((ticker, line));
    }
    let error = line.shared.inbound().failure.take().unwrap_or_else(silent);
    line.close().await;
    Err(error)
}

/// Time limit for the first connection of [`begin`].
const CONNECT_TIMEOUT: Duration = Duration::from_secs(10);

/// The network side of a [`Ticker`], which connects again whenever a connection breaks. When you drop it, the server
/// releases the tool and the forces of the ticker fade; a session that was created for the target stays until it is
/// idle for long ([`Connection::end`] deletes it).
pub struct Connection {
    /// Dropping it aborts the task; the loop then detects that it is over.
    network: JoinSet<()>,
    shared: Arc<Shared>,
    /// Notified when the loop has something to send.
    news: Arc<Notify>,
    server: Server,
    keeps_session: bool,
}

impl Connection {
    /// Returns the totals of what was sent and received so far.
    pub fn traffic(&self) -> Traffic {
        self.shared.inbound().traffic
    }

    /// Returns why there is no connection now, one line; `None` while there is one. Unless [`Ticker::is_over`] holds,
    /// another attempt follows.
    pub fn lost(&self) -> Option<String> {
        self.shared.inbound().failure.as_ref().map(ToString::to_string)
    }

    /// Releases the tool, and deletes the session that was created for the target unless [`Options::keeps_session`]
    /// is set. Waits at most 2 s for the server; if it does not answer, the session stays until it is idle for long.
    /// The ticker is then over ([`Ticker::is_over`]).
    pub async fn end(mut self) {
        self.close().await;
    }

    async fn close(&mut self) {
        // The task may wait for an answer that never arrives.
        self.network.shutdown().await;
        if !self.keeps_session {
            line::delete_made(&self.server, &self.shared).await;
        }
    }
}

impl fmt::Debug for Connection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Connection")
            .field("server", &self.server)
            .field("traffic", &self.traffic())
            .finish_non_exhaustive()
    }
}
