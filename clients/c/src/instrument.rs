//! Instruments: rigid sets of tips, with or without jaws, that a device of six axes leads.

use std::ffi::c_void;

use glam::{DQuat, DVec3};
use palpate_client::Reading;
use palpate_haptics::instrument_pose::MAX_JAW_RAD;
use palpate_haptics::{InstrumentPose, Wrench};

use crate::axes::{palpate_axes, palpate_quaternion, palpate_vector};
use crate::bridge::{DeviceFunctions, begin, palpate_bridge, palpate_priority};
use crate::error::{CodedError, at, at_mut, guard, palpate_result};
use crate::options::{options_at, palpate_limits, palpate_touch_options};
use crate::server::palpate_session;
use crate::touch::{palpate_state, palpate_touch, state_of};

/// Where a device of six axes is at a tick, and whether its operator requests forces.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct palpate_instrument_reading {
    /// Position, in the axes and frame of `palpate_touch_options`.
    pub position: palpate_vector,
    /// Orientation, of length 1, in the axes of `palpate_touch_options`. Not turned, that is {1, 0, 0, 0}, the instrument
    /// points along Palpate's x, and its jaws open in Palpate's y.
    pub orientation: palpate_quaternion,
    /// Angle between the jaws, rad, 0 while they are closed. One outside 0 to π counts as the nearest within.
    pub jaw_rad: f64,
    /// Whether the operator requests forces, by a button or pedal. Only a change from 0 to another value enables
    /// them.
    pub enable: u32,
}

/// What an instrument felt in a tick: force and torque, and the state of the rendering.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct palpate_instrument_felt {
    /// The force on the hand until the next tick, N.
    pub force_n: palpate_vector,
    /// The torque on the hand until the next tick, about the position of the reading, N·m. Zero unless the options have a
    /// `max_torque_n_m`.
    pub torque_n_m: palpate_vector,
    /// The orientation of the instrument: that of the reading, with a port turned so that the shaft passes through it.
    pub orientation: palpate_quaternion,
    /// Whether forces are rendered: one of `palpate_state`.
    pub state: u32,
    /// 1 if the connection has ended for good, else 0.
    pub is_over: u32,
    /// Age of the newest data of the tissue, s; negative before the first.
    pub age_s: f64,
}

/// A device of your own with six axes, for `palpate_bridge_begin_instrument`. The rules are those of `palpate_device`.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct palpate_instrument_device {
    /// Passed to the functions.
    pub user: *mut c_void,
    /// Writes the limits of the device. Called once, before the loop starts, by the thread that starts it. The largest
    /// torque is `max_torque_n_m` of the options.
    pub descriptor: Option<unsafe extern "C" fn(user: *mut c_void, limits: *mut palpate_limits) -> i32>,
    /// Writes the device's position, orientation and jaw angle, in the axes of the options; the origin is the middle of its
    /// workspace. The orientation is {1, 0, 0, 0} before the call.
    pub read: Option<unsafe extern "C" fn(user: *mut c_void, reading: *mut palpate_instrument_reading) -> i32>,
    /// Sets force and torque to render until the next tick, N and N·m, in the axes of the options; the torque is about the
    /// device's position.
    pub write: Option<
        unsafe extern "C" fn(
            user: *mut c_void,
            force_n: *const palpate_vector,
            torque_n_m: *const palpate_vector,
        ) -> i32,
    >,
}

/// The state of an instrument after the last tick of its loop, from `palpate_bridge_look_instrument`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct palpate_instrument_state {
    /// Number of ticks so far.
    pub ticks: u64,
    /// The place of the instrument at the last tick, in the tissue's frame, in the axes of the options.
    pub position: palpate_vector,
    /// The orientation of the instrument: that of the device, with a port turned so that the shaft passes through it.
    pub orientation: palpate_quaternion,
    /// Angle between the jaws, rad.
    pub jaw_rad: f64,
    /// The force rendered at the last tick, N.
    pub force_n: palpate_vector,
    /// The torque rendered at the last tick, N·m.
    pub torque_n_m: palpate_vector,
    /// Whether forces are rendered: one of `palpate_state`.
    pub state: u32,
    /// The priority of the loop's thread: one of `palpate_priority`.
    pub priority: u32,
    /// 1 if the loop has ended; `palpate_bridge_end` returns why.
    pub is_over: u32,
}

/// Deviation of an orientation's length from 1 that is rounding.
const MAX_LENGTH_ERROR: f64 = 1e-3;

impl palpate_instrument_reading {
    /// Returns the reading in Palpate's frame. An orientation whose length is not 1 becomes NaN, with which nothing is
    /// rendered.
    pub(crate) fn own(&self, axes: palpate_axes) -> (Reading, DQuat, f64) {
        let orientation = axes.to_rotation(self.orientation);
        let is_unit = (orientation.length() - 1.0).abs() <= MAX_LENGTH_ERROR;
        let orientation =
            if is_unit { orientation.normalize() } else { DQuat::from_xyzw(f64::NAN, 0.0, 0.0, f64::NAN) };
        let reading = Reading { place_m: axes.to_m(self.position), enable: self.enable != 0 };
        (reading, orientation, self.jaw_rad.clamp(0.0, MAX_JAW_RAD))
    }
}

/// Writes the number of tools that a loop with these options moves: one for each tip of an instrument, with the numbers
/// from `tool` on; 1 for a single tip. `options` may be null. Returns `PALPATE_ARGUMENT` for options that are not valid.
/// Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_tool_count(options: *const palpate_touch_options, count: *mut u32) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (options, count) = unsafe { (options_at(options)?.checked()?, at_mut(count, "count is null")?) };
        *count = options.tool_count();
        Ok(())
    })
}

/// Writes force and torque to render from now on, for a device of six axes that reports `reading` at `time_s`. The options
/// of `palpate_touch_begin` need `jaws_m` or `shaft_m`. Takes bounded time, as `palpate_touch_tick` does. Returns
/// `PALPATE_ARGUMENT` if a number is not finite or the length of the orientation is not 1: `felt` then has a force and a
/// torque that fall to zero. After any other error they are zero. One thread at a time: another gets `PALPATE_BUSY`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_touch_tick_instrument(
    touch: *const palpate_touch,
    reading: *const palpate_instrument_reading,
    time_s: f64,
    felt: *mut palpate_instrument_felt,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let felt = unsafe { at_mut(felt, "felt is null") }?;
        *felt = palpate_instrument_felt { age_s: -1.0, ..palpate_instrument_felt::default() };
        // SAFETY: the caller's promises.
        let (touch, told) = unsafe { (at(touch, "touch is null")?, at(reading, "reading is null")?) };
        let instrument = touch
            .instrument
            .as_ref()
            .ok_or_else(|| CodedError::argument("touch leads no instrument: its options need jaws_m or shaft_m"))?;
        let (reading, orientation, jaw_rad) = told.own(touch.axes);
        let (wrench, place_m, state, is_over, age_s) = touch.ticker.with(|ticker| {
            let wrench = ticker.tick_turned(reading, orientation, jaw_rad, time_s);
            (wrench, ticker.place_m(), ticker.state(), ticker.is_over(), ticker.model_age_s())
        })?;
        let Wrench { force_n, torque_n_m } = wrench;
        let pose = InstrumentPose { place_m, orientation, jaw_rad };
        if pose.is_finite() {
            felt.orientation = touch.axes.rotation(instrument.lead(&pose).orientation);
        }
        felt.force_n = touch.axes.force(force_n);
        felt.torque_n_m = touch.axes.torque(torque_n_m);
        (felt.state, felt.is_over) = (state_of(state) as u32, u32::from(is_over));
        felt.age_s = age_s.unwrap_or(-1.0);
        if !(pose.place_m.is_finite() && pose.jaw_rad.is_finite() && time_s.is_finite()) {
            return Err(CodedError::argument(
                "the position, the jaw angle or the time is not finite: force and torque fall to zero",
            ));
        }
        if !orientation.is_finite() {
            return Err(CodedError::argument("orientation: its length must be 1: force and torque fall to zero"));
        }
        Ok(())
    })
}

/// Connects a device of six axes to a session, as `palpate_bridge_begin` connects one of three. The device leads an
/// instrument: `jaws_m` or `shaft_m` of the options must be above 0. Writes a handle for `palpate_bridge_end`. The loop
/// ends with `PALPATE_DEVICE` also if `read` writes an orientation whose length is not 1; a number that is not finite
/// makes the state FAULT. At the end of the loop, for any reason, `write` gets a force and a torque of zero. Any thread;
/// waits for the server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_bridge_begin_instrument(
    session: *const palpate_session,
    device: *const palpate_instrument_device,
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
        if options.instrument.is_none() {
            return Err(CodedError::argument("jaws_m, shaft_m: an instrument needs one of them above 0"));
        }
        *out = Box::into_raw(Box::new(begin(session, DeviceFunctions::SixAxes(device), options)?));
        Ok(())
    })
}

/// Writes where the instrument of a loop is and what is rendered, after the last tick, or, if a thread was just reading
/// that, after the tick before. Returns `PALPATE_ARGUMENT` if the loop leads no instrument. Never waits for the loop or
/// the server. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_bridge_look_instrument(
    bridge: *const palpate_bridge,
    state: *mut palpate_instrument_state,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (bridge, out) = unsafe { (at(bridge, "bridge is null")?, at_mut(state, "state is null")?) };
        let instrument = bridge
            .instrument
            .as_ref()
            .ok_or_else(|| CodedError::argument("bridge leads no instrument: its options need jaws_m or shaft_m"))?;
        let (ticks, newest, priority) = bridge.observed();
        let state: palpate_state = state_of(newest.and_then(|(tick, _)| tick.state));
        let priority: palpate_priority = priority;
        *out = palpate_instrument_state {
            ticks,
            state: state as u32,
            priority: priority as u32,
            is_over: u32::from(bridge.is_over()),
            ..palpate_instrument_state::default()
        };
        let Some((tick, turned)) = newest else { return Ok(()) };
        let at = InstrumentPose { place_m: tick.place_m, orientation: turned.orientation, jaw_rad: turned.jaw_rad };
        let led = if at.is_finite() { instrument.lead(&at) } else { InstrumentPose::at(DVec3::ZERO) };
        out.position = bridge.axes.position(led.place_m);
        out.orientation = bridge.axes.rotation(led.orientation);
        out.jaw_rad = led.jaw_rad;
        out.force_n = bridge.axes.force(tick.force_n);
        out.torque_n_m = bridge.axes.torque(turned.torque_n_m);
        Ok(())
    })
}
