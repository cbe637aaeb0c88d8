//! A loop of the caller: a handle whose tick the caller calls a thousand times per second, also for rendering
//! recordings.

use std::cell::UnsafeCell;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use ::palpate_haptics::{Instrument, RenderingState};
use palpate_client::bridge::{self, Connection, Offline, OfflineNetwork, Options, Ticker};
use palpate_client::{Error, Reading};

use crate::axes::{palpate_axes, palpate_vector};
use crate::error::{CodedError, PALPATE_BUSY, at, at_mut, guard, palpate_result};
use crate::options::{options_at, palpate_touch_options};
use crate::server::{Connected, palpate_session};

/// A tool that your own loop moves, on a server or in a recording, from `palpate_touch_begin` or
/// `palpate_touch_begin_offline` to `palpate_touch_end`.
pub struct palpate_touch {
    pub(crate) ticker: Exclusive<Ticker>,
    pub(crate) axes: palpate_axes,
    /// The instrument that the loop leads; `None`: a single tip.
    pub(crate) instrument: Option<Instrument>,
    far: Far,
}

/// The other end of the loop: a server or a recording.
#[allow(clippy::large_enum_variant)] // One a tool.
enum Far {
    // Declared in this order: the connection ends on the runtime.
    Server { connection: Connection, shared: Arc<Connected> },
    Record(Exclusive<OfflineNetwork>),
}

/// Whether forces are rendered, and why not.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum palpate_state {
    /// There was no connection yet.
    #[default]
    PALPATE_STATE_WAITING = 0,
    /// Nothing is rendered until `enable` changes from 0 to 1, and then until the first data of the tissue arrives.
    PALPATE_STATE_DISABLED = 1,
    /// Forces are rendered, or fade in.
    PALPATE_STATE_ENABLED = 2,
    /// No data arrived from the server for too long, or there was no tick. Nothing is rendered until `enable` changes
    /// from 0 to 1.
    PALPATE_STATE_PAUSED = 3,
    /// The tool was outside the workspace, or a number was not finite. Nothing is rendered until `enable` changes
    /// from 0 to 1.
    PALPATE_STATE_FAULT = 4,
}

pub use palpate_state::*;

/// The position of a device at a tick, and whether its operator requests forces.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct palpate_reading {
    /// Position, in the axes and frame of `palpate_touch_options`.
    pub position: palpate_vector,
    /// Whether the operator requests forces, by a button or pedal. Only a change from 0 to another value enables
    /// them.
    pub enable: u32,
}

/// What a tick felt: the force, and the state of the rendering.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct palpate_felt {
    /// The force on the hand until the next tick, N.
    pub force_n: palpate_vector,
    /// Whether forces are rendered: one of `palpate_state`.
    pub state: u32,
    /// 1 if the connection has ended for good, else 0.
    pub is_over: u32,
    /// Age of the newest data of the tissue, s; negative before the first.
    pub age_s: f64,
}

/// Totals of what was sent and received so far, over all connections.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct palpate_traffic {
    /// Number of connections that were opened.
    pub connections: u64,
    /// Number of failed attempts, and of connections that broke; moves to another server of a fleet do not count.
    pub failed: u64,
    /// Number of samples that arrived and were used; overtaken ones do not count.
    pub samples: u64,
    /// Number of positions that were sent, or dropped because the stream did not keep up.
    pub positions: u64,
    /// 1 while there is a connection, else 0.
    pub is_connected: u32,
}

/// A value that one thread at a time may change; another thread gets an error and does not wait.
pub(crate) struct Exclusive<T> {
    is_busy: AtomicBool,
    value: UnsafeCell<T>,
}

// SAFETY: `with` lets one thread in.
unsafe impl<T: Send> Sync for Exclusive<T> {}

impl<T> Exclusive<T> {
    pub(crate) fn new(value: T) -> Self {
        Exclusive { is_busy: AtomicBool::new(false), value: UnsafeCell::new(value) }
    }

    pub(crate) fn with<R>(&self, change: impl FnOnce(&mut T) -> R) -> Result<R, CodedError> {
        /// Leaves also if `change` panics.
        struct Leave<'a>(&'a AtomicBool);
        impl Drop for Leave<'_> {
            fn drop(&mut self) {
                self.0.store(false, Ordering::Release);
            }
        }
        if self.is_busy.swap(true, Ordering::Acquire) {
            return Err(CodedError::new(PALPATE_BUSY, "another thread is in a function of this handle"));
        }
        let _leave = Leave(&self.is_busy);
        // SAFETY: no other thread is here.
        Ok(change(unsafe { &mut *self.value.get() }))
    }
}

pub(crate) fn state_of(state: Option<RenderingState>) -> palpate_state {
    match state {
        None => PALPATE_STATE_WAITING,
        Some(RenderingState::Disabled) => PALPATE_STATE_DISABLED,
        Some(RenderingState::Enabled) => PALPATE_STATE_ENABLED,
        Some(RenderingState::Paused) => PALPATE_STATE_PAUSED,
        Some(RenderingState::Fault) => PALPATE_STATE_FAULT,
    }
}

/// Acquires a tool of a session for a loop of your own, such as that of an engine's haptic thread, and waits until it
/// can be used, at most 10 s. `options` may be null. From then on call `palpate_touch_tick` a thousand times per
/// second. When the connection breaks, the library connects again. Writes a handle for `palpate_touch_end`, or
/// null after an error. Returns `PALPATE_REFUSED` also if another caller holds the tool. Any thread; waits for the
/// server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_touch_begin(
    session: *const palpate_session,
    options: *const palpate_touch_options,
    touch: *mut *mut palpate_touch,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (session, options, out) = unsafe {
            (at(session, "session is null")?, options_at(options)?.checked()?, at_mut(touch, "touch is null")?)
        };
        *out = std::ptr::null_mut();
        let shared = session.shared.clone();
        let target = session.target(&options);
        let hand = options.hand.map(|hand| hand.take(&session.session_id)).transpose()?;
        let (warn, copies, instrument) = (options.warn, options.copies, options.instrument);
        let of_run =
            Options { keeps_session: true, warn, copies, hand, instrument: instrument.clone(), ..Options::default() };
        let beginning = bridge::begin(target, options.device, options.origin, of_run);
        let (ticker, connection) = shared.threads.block_on(beginning)??;
        let far = Far::Server { connection, shared };
        let (ticker, axes) = (Exclusive::new(ticker), options.axes);
        *out = Box::into_raw(Box::new(palpate_touch { ticker, axes, instrument, far }));
        Ok(())
    })
}

/// Creates a loop that renders recordings, without a server: equal messages, positions and times give equal forces,
/// bit by bit. It has no copy of the tissue; `prediction` is ignored. `options` may be null; `middle_m` is the place
/// in the tissue of the middle of the workspace (`palpate_extent.top_m`), in Palpate's own axes. Writes a handle for
/// `palpate_touch_end`. Returns `PALPATE_ARGUMENT` also for an instrument and for a hand, which need a copy of the
/// tissue. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_touch_begin_offline(
    options: *const palpate_touch_options,
    middle_m: palpate_vector,
    touch: *mut *mut palpate_touch,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (options, out) = unsafe { (options_at(options)?.checked()?, at_mut(touch, "touch is null")?) };
        *out = std::ptr::null_mut();
        let middle_m = middle_m.vector();
        if !middle_m.is_finite() {
            return Err(CodedError::argument("middle_m must be finite"));
        }
        if options.instrument.is_some() {
            return Err(CodedError::argument(
                "jaws_m, shaft_m: an instrument is rendered from a copy of the tissue, which a recording has not",
            ));
        }
        if options.hand.is_some() {
            return Err(CodedError::argument("hand: a recording has no second hand"));
        }
        let Offline { ticker, record } = Offline::new(options.device, options.origin, middle_m, options.up_deadband);
        let far = Far::Record(Exclusive::new(record));
        let (ticker, axes) = (Exclusive::new(ticker), options.axes);
        *out = Box::into_raw(Box::new(palpate_touch { ticker, axes, instrument: None, far }));
        Ok(())
    })
}

/// Delivers a recorded message: the `count` bytes of a `palpate.v1.TouchResponse`. The next tick uses it. The
/// first one must be `opened`: until then forces are zero. Returns `PALPATE_ARGUMENT` for a handle other than one
/// of `palpate_touch_begin_offline`, and for bytes that are not such a message; `PALPATE_CONNECTION` for a force
/// law that is not valid; and `PALPATE_BUSY` if another thread delivers one. One thread at a time; it may be
/// another than that of the ticks.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_touch_arrive(
    touch: *const palpate_touch,
    bytes: *const u8,
    count: usize,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promise.
        let Far::Record(record) = &unsafe { at(touch, "touch is null") }?.far else {
            return Err(CodedError::argument("touch has a server, which sends it messages"));
        };
        if bytes.is_null() && count > 0 || count > isize::MAX as usize {
            return Err(CodedError::argument("bytes is null, or count too large"));
        }
        // SAFETY: the caller's promise.
        let bytes = if count == 0 { &[] } else { unsafe { std::slice::from_raw_parts(bytes, count) } };
        record.with(|record| record.arrive(bytes))?.map_err(CodedError::from)
    })
}

/// Writes the force to render from now on, for a device that reports `reading` at `time_s`: seconds of any origin, of
/// a clock that advances between ticks. Takes bounded time: no lock, no call of the system, no memory allocated or
/// freed. Ticks may be late, early or missing: forces then fade, and return within the safety envelope. An instrument is
/// not turned, and its jaws are closed: `palpate_touch_tick_instrument` has more. Returns
/// `PALPATE_ARGUMENT` if the position or the time is not finite: `felt` then has a force that falls to zero. After
/// any other error, `felt` has a force of zero. One thread at a time: another gets `PALPATE_BUSY`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_touch_tick(
    touch: *const palpate_touch,
    reading: *const palpate_reading,
    time_s: f64,
    felt: *mut palpate_felt,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let felt = unsafe { at_mut(felt, "felt is null") }?;
        *felt = palpate_felt { age_s: -1.0, ..palpate_felt::default() };
        // SAFETY: the caller's promises.
        let (touch, reading) = unsafe { (at(touch, "touch is null")?, at(reading, "reading is null")?) };
        let reading = Reading { place_m: touch.axes.to_m(reading.position), enable: reading.enable != 0 };
        let (force_n, state, is_over, age_s) = touch.ticker.with(|ticker| {
            let force_n = ticker.tick(reading, time_s);
            (force_n, ticker.state(), ticker.is_over(), ticker.model_age_s())
        })?;
        *felt = palpate_felt {
            force_n: touch.axes.force(force_n),
            state: state_of(state) as u32,
            // A recording never ends.
            is_over: u32::from(is_over),
            age_s: age_s.unwrap_or(-1.0),
        };
        if !(reading.place_m.is_finite() && time_s.is_finite()) {
            return Err(CodedError::argument("the position or the time is not finite: the force falls to zero"));
        }
        Ok(())
    })
}

/// Stops rendering until `enable` changes from 0 to 1; the force falls within the next ticks. One thread at a time,
/// as for `palpate_touch_tick`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_touch_disable(touch: *const palpate_touch) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promise.
        unsafe { at(touch, "touch is null") }?.ticker.with(Ticker::disable)
    })
}

/// Writes the totals of what was sent and received so far; zeros without a server. Returns `PALPATE_CONNECTION`
/// while there is no connection: the totals are written all the same, and `palpate_last_error` describes why. Any
/// thread except that of the ticks, as it takes a lock.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_touch_traffic(
    touch: *const palpate_touch,
    traffic: *mut palpate_traffic,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (touch, out) = unsafe { (at(touch, "touch is null")?, at_mut(traffic, "traffic is null")?) };
        *out = palpate_traffic::default();
        let Far::Server { connection, .. } = &touch.far else { return Ok(()) };
        let (traffic, lost) = (connection.traffic(), connection.lost());
        *out = palpate_traffic {
            connections: traffic.connections,
            failed: traffic.failed,
            samples: traffic.samples,
            positions: traffic.poses,
            is_connected: u32::from(lost.is_none()),
        };
        lost.map_or(Ok(()), |why| Err(Error::Connection(why).into()))
    })
}

/// Releases the tool and frees the handle; the session continues. Sets no force: your loop sets its device to
/// zero. Null is allowed. Any thread, once, when no other thread is in a function of this handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_touch_end(touch: *mut palpate_touch) {
    guard(|| {
        if touch.is_null() {
            return Ok(());
        }
        // SAFETY: the caller's promise.
        let touch = unsafe { Box::from_raw(touch) };
        match touch.far {
            Far::Server { connection, shared } if shared.threads.here().is_ok() => {
                shared.threads.block_on(connection.end())
            }
            // The tool belongs to the parent process.
            far @ Far::Server { .. } => {
                std::mem::forget(far);
                Ok(())
            }
            Far::Record(_) => Ok(()),
        }
    });
}
