//! The library's own loop: a device given by three functions, on a real-time thread of the library.

use std::ffi::c_void;
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use glam::{DQuat, DVec3};
use palpate_client::bridge::{BridgeReport, Disable, Options, PositionOrigin, Tick, run_told};
use palpate_client::os::Priority;
use palpate_client::{Error, HapticDevice, Reading};
use palpate_haptics::{Device, Instrument, Wrench};
use tokio::sync::Notify;
use tokio::task::JoinHandle;

use crate::axes::{palpate_axes, palpate_vector};
use crate::error::{CodedError, PALPATE_CONNECTION, PALPATE_INTERNAL, PALPATE_OK, at, at_mut, guard, palpate_result};
use crate::instrument::{palpate_instrument_device, palpate_instrument_reading};
use crate::options::{TouchOptions, options_at, palpate_limits, palpate_touch_options};
use crate::server::{CONNECTING, Connected, palpate_session};
use crate::touch::{palpate_reading, palpate_state, state_of};

/// A device of your own. One thread of the library calls the functions, a thousand times per second: first `read`,
/// then `write`. Both must return within a fraction of a millisecond. They return 0, or another value if the device
/// fails, which ends the loop. At the end of the loop, for any reason, `write` gets a force of zero.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct palpate_device {
    /// Passed to the functions.
    pub user: *mut c_void,
    /// Writes the limits of the device. Called once, before the loop starts, by the thread that starts it.
    pub descriptor: Option<unsafe extern "C" fn(user: *mut c_void, limits: *mut palpate_limits) -> i32>,
    /// Writes the device's position, in the axes of the options; its origin is the middle of its workspace.
    pub read: Option<unsafe extern "C" fn(user: *mut c_void, reading: *mut palpate_reading) -> i32>,
    /// Sets the force to render until the next tick, N, in the axes of the options.
    pub write: Option<unsafe extern "C" fn(user: *mut c_void, force_n: *const palpate_vector) -> i32>,
}

/// A device's loop that runs on a thread of the library, from `palpate_bridge_begin` until `palpate_bridge_end`,
/// or until the device fails. When the connection breaks, the library connects again.
pub struct palpate_bridge {
    shared: Arc<Connected>,
    seen: Arc<Mutex<LoopObservation>>,
    disable: Disable,
    stop: Arc<Notify>,
    task: JoinHandle<Result<BridgeReport, Error>>,
    pub(crate) axes: palpate_axes,
    /// The instrument that the device leads; `None`: a single tip.
    pub(crate) instrument: Option<Instrument>,
}

/// The priority of a loop's thread.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum palpate_priority {
    /// The usual priority.
    #[default]
    PALPATE_PRIORITY_USUAL = 0,
    /// Real-time priority, above all usual threads.
    PALPATE_PRIORITY_REAL_TIME = 1,
    /// Real-time priority was requested and refused by the system; `warn` got the reason.
    PALPATE_PRIORITY_REFUSED = 2,
}

pub use palpate_priority::*;

/// The state of a loop after its last tick, from `palpate_bridge_look`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct palpate_bridge_state {
    /// Number of ticks so far.
    pub ticks: u64,
    /// The tool's position at the last tick, in the tissue's frame, in the axes of the options.
    pub position: palpate_vector,
    /// The force rendered at the last tick, N.
    pub force_n: palpate_vector,
    /// Whether forces are rendered: one of `palpate_state`.
    pub state: u32,
    /// The priority of its thread: one of `palpate_priority`.
    pub priority: u32,
    /// 1 if the loop has ended; `palpate_bridge_end` returns why.
    pub is_over: u32,
}

/// The results of a loop from its beginning to its end, from `palpate_bridge_end`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct palpate_bridge_report {
    /// Number of ticks.
    pub ticks: u64,
    /// Number of ticks that started more than a millisecond late; like the next four, 0 if the loop panicked.
    pub late_ticks: u64,
    /// Number of ticks that were skipped, because the loop was more than 5 ms late.
    pub missed_ticks: u64,
    /// Number of connections that were opened.
    pub connections: u64,
    /// Number of samples that arrived and were used; overtaken ones do not count.
    pub samples: u64,
    /// Number of positions that were sent, or dropped because the stream did not keep up.
    pub positions: u64,
    /// The priority of its thread: one of `palpate_priority`.
    pub priority: u32,
    /// The result of `palpate_bridge_end`, one of `palpate_result`: 0 unless the loop has failed.
    pub result: u32,
}

/// The state of the loop that other threads can see.
#[derive(Default)]
struct LoopObservation {
    ticks: u64,
    newest: Option<(Tick, TickTurn)>,
    priority: palpate_priority,
}

/// What a device of six axes adds to a tick.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct TickTurn {
    /// The orientation of the device.
    pub(crate) orientation: DQuat,
    /// The angle between the jaws, rad.
    pub(crate) jaw_rad: f64,
    /// The torque that was written, N·m.
    pub(crate) torque_n_m: DVec3,
}

fn seen_of(seen: &Mutex<LoopObservation>) -> MutexGuard<'_, LoopObservation> {
    seen.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The functions of the caller's device.
#[derive(Clone, Copy)]
pub(crate) enum DeviceFunctions {
    /// Of a device that has a position and renders a force.
    ThreeAxes(palpate_device),
    /// Of a device that also has an orientation and jaws, and renders a torque.
    SixAxes(palpate_instrument_device),
}

impl DeviceFunctions {
    /// Returns the limits that `descriptor` writes; an error if one of the functions is missing.
    fn limits(&self) -> Result<palpate_limits, CodedError> {
        let (user, descriptor, has_others) = match self {
            DeviceFunctions::ThreeAxes(device) => {
                (device.user, device.descriptor, device.read.is_some() && device.write.is_some())
            }
            DeviceFunctions::SixAxes(device) => {
                (device.user, device.descriptor, device.read.is_some() && device.write.is_some())
            }
        };
        let Some(descriptor) = descriptor.filter(|_| has_others) else {
            return Err(CodedError::argument("device: all three functions must be there"));
        };
        let mut limits = palpate_limits::from(palpate_haptics::device::UNDECLARED);
        // SAFETY: the caller's promise.
        checked("descriptor", unsafe { descriptor(user, &mut limits) }).map_err(Error::Device)?;
        Ok(limits)
    }
}

/// The caller's functions as a haptic device.
struct Called {
    functions: DeviceFunctions,
    limits: Device,
    axes: palpate_axes,
    ticks: u64,
    turn: TickTurn,
    seen: Arc<Mutex<LoopObservation>>,
}

// SAFETY: the header says that a thread of the library calls the functions.
unsafe impl Send for Called {}

fn checked(name: &str, code: i32) -> io::Result<()> {
    if code == 0 { Ok(()) } else { Err(io::Error::other(format!("`{name}` returned {code}"))) }
}

impl HapticDevice for Called {
    fn descriptor(&self) -> Device {
        self.limits
    }

    fn read(&mut self) -> io::Result<Reading> {
        match self.functions {
            DeviceFunctions::ThreeAxes(device) => {
                let mut reading = palpate_reading::default();
                let read = device.read.ok_or(io::ErrorKind::InvalidInput)?;
                // SAFETY: the caller's promise.
                checked("read", unsafe { read(device.user, &mut reading) })?;
                Ok(Reading { place_m: self.axes.to_m(reading.position), enable: reading.enable != 0 })
            }
            DeviceFunctions::SixAxes(device) => {
                let mut told = palpate_instrument_reading::default();
                let read = device.read.ok_or(io::ErrorKind::InvalidInput)?;
                // SAFETY: the caller's promise.
                checked("read", unsafe { read(device.user, &mut told) })?;
                let (reading, orientation, jaw_rad) = told.own(self.axes);
                // A number that is not finite is no error, in a position either: nothing is rendered until it is.
                if !orientation.is_finite() && self.axes.to_rotation(told.orientation).is_finite() {
                    return Err(io::Error::other("`read` gave an orientation whose length is not 1"));
                }
                (self.turn.orientation, self.turn.jaw_rad) = (orientation, jaw_rad);
                Ok(reading)
            }
        }
    }

    fn write(&mut self, force_n: DVec3) -> io::Result<()> {
        self.write_wrench(Wrench::of_force(force_n))
    }

    fn orientation(&self) -> DQuat {
        self.turn.orientation
    }

    fn jaw_rad(&self) -> f64 {
        self.turn.jaw_rad
    }

    fn write_wrench(&mut self, wrench: Wrench) -> io::Result<()> {
        let force_n = self.axes.force(wrench.force_n);
        match self.functions {
            DeviceFunctions::ThreeAxes(device) => {
                let write = device.write.ok_or(io::ErrorKind::InvalidInput)?;
                // SAFETY: the caller's promise.
                checked("write", unsafe { write(device.user, &force_n) })
            }
            DeviceFunctions::SixAxes(device) => {
                let write = device.write.ok_or(io::ErrorKind::InvalidInput)?;
                self.turn.torque_n_m = wrench.torque_n_m;
                // SAFETY: the caller's promise.
                checked("write", unsafe { write(device.user, &force_n, &self.axes.torque(wrench.torque_n_m)) })
            }
        }
    }

    fn ticked(&mut self, tick: &Tick) {
        self.ticks += 1;
        // A thread that reads the state must not delay a tick.
        if let Ok(mut seen) = self.seen.try_lock() {
            (seen.ticks, seen.newest) = (self.ticks, Some((*tick, self.turn)));
        }
    }
}

/// Connects a device of your own to a session, on a thread of the library at 1 kHz, with real-time priority if the
/// system allows it. `options` may be null; its `limits` are ignored, since `descriptor` provides them. Waits for the
/// first connection, at most 10 s. Writes a handle for `palpate_bridge_end`, or null after an error. `device` is
/// copied; its `user` must stay valid until the end. Returns `PALPATE_ARGUMENT` also for a device without all
/// three functions, for invalid limits, and if `in_tissue_frame` is set; `PALPATE_DEVICE` if a function of the
/// device fails; and `PALPATE_REFUSED` also if another caller holds the tool. The device has then been set to a
/// force of zero if it was set to any. Any thread; waits for the server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_bridge_begin(
    session: *const palpate_session,
    device: *const palpate_device,
    options: *const palpate_touch_options,
    bridge: *mut *mut palpate_bridge,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (session, device, options, out) = unsafe {
            (
                at(session, "session is null")?,
                *at(device, "device is null")?,
                options_at(options)?.checked()?,
                at_mut(bridge, "bridge is null")?,
            )
        };
        *out = std::ptr::null_mut();
        *out = Box::into_raw(Box::new(begin(session, DeviceFunctions::ThreeAxes(device), options)?));
        Ok(())
    })
}

/// Connects a device to a session, and waits for the first connection.
pub(crate) fn begin(
    session: &palpate_session,
    functions: DeviceFunctions,
    options: TouchOptions,
) -> Result<palpate_bridge, CodedError> {
    if options.origin != PositionOrigin::Workspace {
        return Err(CodedError::argument(
            "in_tissue_frame is not for devices: their origin lies on the top of the tissue",
        ));
    }
    let limits = functions.limits()?.device(options.device.torque_n_m)?;
    let seen = Arc::new(Mutex::new(LoopObservation::default()));
    let turn = TickTurn::default();
    let called = Called { functions, limits, axes: options.axes, ticks: 0, turn, seen: seen.clone() };
    let hand = options.hand.as_ref().map(|hand| hand.take(&session.session_id)).transpose()?;
    let shared = session.shared.clone();
    let target = session.target(&options);
    let told = seen.clone();
    let begun = move |priority: &Priority| {
        seen_of(&told).priority = match priority {
            Priority::Usual => PALPATE_PRIORITY_USUAL,
            Priority::RealTime => PALPATE_PRIORITY_REAL_TIME,
            Priority::Refused(_) => PALPATE_PRIORITY_REFUSED,
        };
    };
    let of_run = Options {
        real_time: options.real_time,
        keeps_session: true,
        warn: options.warn,
        copies: options.copies,
        hand,
        instrument: options.instrument.clone(),
        begun: Some(Box::new(begun)),
        ..Options::default()
    };
    let disable = of_run.disable.clone();
    let stop = Arc::new(Notify::new());
    let stopped = stop.clone();
    let task = shared.threads.spawn(async move {
        let ended = run_told(called, target, of_run, async move { stopped.notified().await }).await;
        ended.map(|(_, report)| report)
    })?;
    let (axes, instrument) = (options.axes, options.instrument);
    let bridge = palpate_bridge { shared, seen, disable, stop, task, axes, instrument };
    let until = Instant::now() + bridge.shared.timeout.min(CONNECTING);
    while !bridge.task.is_finished() && Instant::now() < until {
        if seen_of(&bridge.seen).newest.is_some_and(|(tick, _)| tick.state.is_some()) {
            return Ok(bridge);
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    // It never connected, so there is an error.
    Err(bridge.end().1.unwrap_or_else(|| CodedError::new(PALPATE_CONNECTION, "the server does not answer")))
}

impl palpate_bridge {
    /// Returns the number of ticks, what the last one did, and the priority of the loop.
    pub(crate) fn observed(&self) -> (u64, Option<(Tick, TickTurn)>, palpate_priority) {
        let seen = seen_of(&self.seen);
        (seen.ticks, seen.newest, seen.priority)
    }

    /// Returns whether the loop has ended.
    pub(crate) fn is_over(&self) -> bool {
        self.task.is_finished()
    }

    /// Ends the loop and waits for that. Returns its results, and the error if it failed.
    fn end(self) -> (palpate_bridge_report, Option<CodedError>) {
        self.stop.notify_one();
        let (report, fault) = match self.shared.threads.block_on(self.task) {
            Err(fault) => (None, Some(fault)),
            Ok(Ok(Ok(mut report))) => {
                let failure = report.failure.take();
                (Some(report), failure.map(CodedError::from))
            }
            Ok(Ok(Err(error))) => (None, Some(error.into())),
            Ok(Err(_)) => (None, Some(CodedError::new(PALPATE_INTERNAL, "the loop panicked"))),
        };
        let seen = seen_of(&self.seen);
        let traffic = report.as_ref().map(|report| report.traffic).unwrap_or_default();
        let told = palpate_bridge_report {
            ticks: seen.ticks,
            late_ticks: report.as_ref().map_or(0, |report| report.late_ticks),
            missed_ticks: report.as_ref().map_or(0, |report| report.missed_ticks),
            connections: traffic.connections,
            samples: traffic.samples,
            positions: traffic.poses,
            priority: seen.priority as u32,
            result: fault.as_ref().map_or(PALPATE_OK, CodedError::code) as u32,
        };
        (told, fault)
    }
}

/// Writes the state of the loop after its last tick, or, if a thread was just reading that, after the tick before.
/// Never waits for the loop or the server. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_bridge_look(
    bridge: *const palpate_bridge,
    state: *mut palpate_bridge_state,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (bridge, out) = unsafe { (at(bridge, "bridge is null")?, at_mut(state, "state is null")?) };
        let (ticks, newest, priority) = bridge.observed();
        let newest = newest.map(|(tick, _)| tick);
        let state: palpate_state = state_of(newest.and_then(|tick| tick.state));
        *out = palpate_bridge_state {
            ticks,
            position: newest.map_or_else(palpate_vector::default, |tick| bridge.axes.position(tick.place_m)),
            force_n: newest.map_or_else(palpate_vector::default, |tick| bridge.axes.force(tick.force_n)),
            state: state as u32,
            priority: priority as u32,
            is_over: u32::from(bridge.is_over()),
        };
        Ok(())
    })
}

/// Stops rendering until `enable` of a reading changes from 0 to 1; the force falls within the next ticks. Any
/// thread, also from a function of the device.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_bridge_disable(bridge: *const palpate_bridge) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promise.
        unsafe { at(bridge, "bridge is null") }?.disable.disable();
        Ok(())
    })
}

/// Ends the loop, sets the device to a force of zero, and releases the tool; the session continues. Waits until
/// that is done, and writes the results of the loop, even if it has failed; `report` may be null. Returns
/// `PALPATE_DEVICE` if the device has failed: `palpate_last_error` describes how; `PALPATE_INTERNAL` if the loop
/// panicked, without a force of zero; and `PALPATE_ARGUMENT` if `bridge` is null. A connection that is broken at
/// the end is no error. Frees the handle in any case. Any thread, once; not from a function of the device, which
/// would wait for itself.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_bridge_end(
    bridge: *mut palpate_bridge,
    report: *mut palpate_bridge_report,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promise.
        let out = unsafe { report.as_mut() };
        if bridge.is_null() {
            return Err(CodedError::argument("bridge is null"));
        }
        // SAFETY: the caller's promise.
        let (told, fault) = unsafe { Box::from_raw(bridge) }.end();
        if let Some(out) = out {
            *out = told;
        }
        fault.map_or(Ok(()), Err)
    })
}
