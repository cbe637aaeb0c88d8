//! The Touch of 3D Systems, and its predecessors, through `libHD` of OpenHaptics (version 3).
//!
//! The library calls a function of ours a thousand times per second on its own thread: one frame reads the position
//! and sets the force. It measures in millimetres, with x to the right, y up and z towards the operator. If our loop
//! stops, the frame sets the force to zero. The library is never unloaded.

// Functions of a C library.
#![allow(unsafe_code)]

use std::ffi::{CString, c_char, c_int, c_uint, c_ulong, c_ushort, c_void};
use std::io;
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use glam::{DMat3, DQuat, DVec3};
use palpate_haptics::{Device, Wrench};

use super::loaded::{Loaded, text_of};
use crate::device::{HapticDevice, Reading};

#[cfg(windows)]
const NAMES: [&str; 1] = ["hd.dll"];
#[cfg(not(windows))]
const NAMES: [&str; 3] = ["libHD.so", "libHD.so.3.4", "libHD.so.3"];

// Of hdDefines.h.
const INVALID_HANDLE: c_uint = 0xFFFF_FFFF;
const CURRENT_BUTTONS: c_uint = 0x2000;
const CURRENT_POSITION: c_uint = 0x2050;
const CURRENT_TRANSFORM: c_uint = 0x2052;
const CURRENT_FORCE: c_uint = 0x2700;
const CURRENT_TORQUE: c_uint = 0x2701;
const VERSION: c_uint = 0x2500;
const MODEL: c_uint = 0x2501;
const MAX_WORKSPACE: c_uint = 0x2550;
const USABLE_WORKSPACE: c_uint = 0x2551;
const OUTPUT_DOF: c_uint = 0x2554;
const MAX_STIFFNESS: c_uint = 0x2602;
const MAX_FORCE: c_uint = 0x2603;
const MAX_CONTINUOUS_FORCE: c_uint = 0x2604;
const MAX_DAMPING: c_uint = 0x2609;
const MAX_TORQUE: c_uint = 0x2622;
const FORCE_OUTPUT: c_uint = 0x4000;
const NEEDS_INKWELL: c_uint = 0x5002;
const CALLBACK_DONE: c_uint = 0;
const CALLBACK_CONTINUE: c_uint = 1;
/// Errors about forces: warm motors, or a force or speed above the device's own limits. The device continues.
const FORCE_ERRORS: std::ops::Range<c_uint> = 0x0200..0x0300;
/// Number of errors that are read at once.
const MAX_ERRORS: u32 = 16;
/// Output axes of a device that renders torque.
const SIX_AXES: c_int = 6;
/// `HD_MAX_SCHEDULER_PRIORITY`.
const PRIORITY: c_ushort = c_ushort::MAX;

/// Time without a write of our loop after which the frame sets no force.
const STILL: Duration = Duration::from_millis(50);

/// Time without a frame after which the device counts as gone.
const GONE: Duration = Duration::from_millis(500);

/// The stylus's axes as those of an instrument: that points along the stylus, which is its −z, with the stylus's y as z.
const STYLUS: DMat3 = DMat3::from_cols(DVec3::NEG_Z, DVec3::NEG_X, DVec3::Y);

/// Longest time for which closing waits for frames that set no force.
const CLOSES: Duration = Duration::from_millis(250);

/// Time limit for the first frame.
const FIRST: Duration = Duration::from_secs(2);

/// `HDErrorInfo`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
struct ErrorInfo {
    code: c_uint,
    internal: c_int,
    handle: c_uint,
}

type SdkFrame = unsafe extern "system" fn(*mut c_void) -> c_uint;
type OfHandle = unsafe extern "system" fn(c_uint);
type Bare = unsafe extern "system" fn();

/// The functions of the library that are used.
#[derive(Debug, Clone, Copy)]
struct OpenHapticsCalls {
    init: unsafe extern "system" fn(*const c_char) -> c_uint,
    disable_device: OfHandle,
    make_current: OfHandle,
    begin: OfHandle,
    end: OfHandle,
    get_numbers: unsafe extern "system" fn(c_uint, *mut f64),
    get_whole: unsafe extern "system" fn(c_uint, *mut c_int),
    set_numbers: unsafe extern "system" fn(c_uint, *const f64),
    get_text: unsafe extern "system" fn(c_uint) -> *const c_char,
    enable: OfHandle,
    error: unsafe extern "system" fn() -> ErrorInfo,
    error_text: unsafe extern "system" fn(c_uint) -> *const c_char,
    start: Bare,
    stop: Bare,
    schedule: unsafe extern "system" fn(SdkFrame, *mut c_void, c_ushort) -> c_ulong,
    unschedule: unsafe extern "system" fn(c_ulong),
    calibration: Option<unsafe extern "system" fn() -> c_uint>,
}

impl OpenHapticsCalls {
    fn load(library: Option<&Path>) -> io::Result<(Self, Loaded)> {
        let loaded = Loaded::find(library, &NAMES, "libHD", "Install OpenHaptics and the driver of the device")?;
        // SAFETY: the types are those of hd.h and hdDevice.h.
        let calls = unsafe {
            OpenHapticsCalls {
                init: loaded.function("hdInitDevice")?,
                disable_device: loaded.function("hdDisableDevice")?,
                make_current: loaded.function("hdMakeCurrentDevice")?,
                begin: loaded.function("hdBeginFrame")?,
                end: loaded.function("hdEndFrame")?,
                get_numbers: loaded.function("hdGetDoublev")?,
                get_whole: loaded.function("hdGetIntegerv")?,
                set_numbers: loaded.function("hdSetDoublev")?,
                get_text: loaded.function("hdGetString")?,
                enable: loaded.function("hdEnable")?,
                error: loaded.function("hdGetError")?,
                error_text: loaded.function("hdGetErrorString")?,
                start: loaded.function("hdStartScheduler")?,
                stop: loaded.function("hdStopScheduler")?,
                schedule: loaded.function("hdScheduleAsynchronous")?,
                unschedule: loaded.function("hdUnschedule")?,
                calibration: loaded.optional("hdCheckCalibration"),
            }
        };
        Ok((calls, loaded))
    }

    /// Returns the library's name of an error.
    fn words(&self, code: c_uint) -> String {
        // SAFETY: the library's texts are constants.
        let words = unsafe { text_of((self.error_text)(code)) }.unwrap_or_default();
        format!("{words} (0x{code:04X})")
    }

    /// Returns the first error since the last call, other than those about forces; `None` if there is none.
    fn failure(&self) -> Option<c_uint> {
        // The library keeps errors until they are read, one by one.
        // SAFETY: a function without arguments.
        let errors = (0..MAX_ERRORS).map(|_| unsafe { (self.error)() }.code).take_while(|code| *code != 0);
        errors.fold(None, |found, code| found.or(Some(code).filter(|code| !FORCE_ERRORS.contains(code))))
    }

    /// Returns numeric parameters of the current device; 0 for those that it does not report.
    fn numbers<const N: usize>(&self, parameter: c_uint) -> [f64; N] {
        // More than any parameter has.
        let mut numbers = [0.0; 16];
        // SAFETY: room for as many numbers as any parameter has.
        unsafe { (self.get_numbers)(parameter, numbers.as_mut_ptr()) };
        // A missing parameter is reported as an error, which is not a failure.
        let _ = self.failure();
        std::array::from_fn(|index| numbers[index])
    }

    /// Returns the library's version. Refuses versions other than 3.
    fn version(&self, loaded: &Loaded) -> io::Result<String> {
        // SAFETY: the library's texts are constants.
        let version = unsafe { text_of((self.get_text)(VERSION)) }.unwrap_or_default();
        let _ = self.failure();
        let major = version.split(['.', ' ']).next().and_then(|major| major.parse::<u32>().ok());
        if major.is_some_and(|major| major != 3) {
            let message = format!("{} is of OpenHaptics {version}: Palpate knows OpenHaptics 3", loaded.name());
            return Err(io::Error::new(io::ErrorKind::Unsupported, message));
        }
        Ok(if version.is_empty() { "of an unknown version".to_owned() } else { version })
    }
}

/// The data exchanged between frames and our loop.
#[derive(Debug, Clone, Copy)]
struct Exchange {
    /// Position in the library's axes, mm.
    place_mm: [f64; 3],
    buttons: c_int,
    /// Axes of the stylus in the library's axes, by columns.
    stylus: [f64; 9],
    /// Force, N, and torque, mN·m, in the library's axes; no torque: the device renders none.
    force_n: [f64; 3],
    torque_mn_m: Option<[f64; 3]>,
    written: Instant,
    /// When the newest frame arrived; `None` before the first.
    came: Option<Instant>,
    frames: u64,
    /// The error that ended the frames.
    fault: Option<c_uint>,
}

#[derive(Debug)]
struct SharedState {
    calls: OpenHapticsCalls,
    handle: c_uint,
    exchange: Mutex<Exchange>,
}

impl SharedState {
    fn exchange(&self) -> MutexGuard<'_, Exchange> {
        self.exchange.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns a copy, without holding the lock: the library may call us in the meantime.
    fn seen(&self) -> Exchange {
        *self.exchange()
    }
}

/// Handles one frame, on the library's thread.
unsafe extern "system" fn frame(shared: *mut c_void) -> c_uint {
    // SAFETY: `open` passes a `SharedState` that is never freed.
    let shared = unsafe { &*shared.cast::<SharedState>() };
    let SharedState { calls, handle, .. } = shared;
    let (mut place_mm, mut transform) = ([0.0; 16], [0.0; 16]);
    let mut buttons = 0;
    // SAFETY: the device is open; there is room for the numbers.
    unsafe {
        (calls.begin)(*handle);
        (calls.get_numbers)(CURRENT_POSITION, place_mm.as_mut_ptr());
        (calls.get_whole)(CURRENT_BUTTONS, &raw mut buttons);
    }
    let failure = calls.failure();
    // SAFETY: as above.
    unsafe { (calls.get_numbers)(CURRENT_TRANSFORM, transform.as_mut_ptr()) };
    // A library without a transform leaves the stylus as it was.
    let _ = calls.failure();
    let (force_n, torque_mn_m) = {
        let mut exchange = shared.exchange();
        exchange.place_mm = [place_mm[0], place_mm[1], place_mm[2]];
        exchange.stylus = std::array::from_fn(|index| transform[index / 3 * 4 + index % 3]);
        exchange.buttons = buttons;
        exchange.came = Some(Instant::now());
        exchange.frames += 1;
        let is_still = exchange.written.elapsed() > STILL;
        let torque_mn_m = exchange.torque_mn_m.map(|torque_mn_m| if is_still { [0.0; 3] } else { torque_mn_m });
        (if is_still { [0.0; 3] } else { exchange.force_n }, torque_mn_m)
    };
    // SAFETY: as above.
    unsafe {
        (calls.set_numbers)(CURRENT_FORCE, force_n.as_ptr());
        if let Some(torque_mn_m) = torque_mn_m {
            (calls.set_numbers)(CURRENT_TORQUE, torque_mn_m.as_ptr());
        }
        (calls.end)(*handle);
    }
    match failure.or(calls.failure()) {
        None => CALLBACK_CONTINUE,
        Some(code) => {
            // Tries to set the force to zero, in case the device still accepts it.
            // SAFETY: as above.
            unsafe {
                (calls.begin)(*handle);
                (calls.set_numbers)(CURRENT_FORCE, [0.0; 3].as_ptr());
                if torque_mn_m.is_some() {
                    (calls.set_numbers)(CURRENT_TORQUE, [0.0; 3].as_ptr());
                }
                (calls.end)(*handle);
            }
            let _ = calls.failure();
            shared.exchange().fault = Some(code);
            CALLBACK_DONE
        }
    }
}

/// An open device.
#[derive(Debug)]
pub(super) struct OpenHaptics {
    shared: &'static SharedState,
    task: c_ulong,
    descriptor: Device,
    /// Middle of the workspace in the library's axes, mm.
    middle_mm: DVec3,
    buttons: u32,
    orientation: DQuat,
}

/// Converts a vector of the library's axes to the device's, and back.
fn of_device(library: DVec3) -> DVec3 {
    DVec3::new(library.x, -library.z, library.y)
}

fn of_library(device: DVec3) -> [f64; 3] {
    [device.x, device.z, -device.y]
}

impl OpenHaptics {
    /// Opens the device of that configuration, or the default one.
    ///
    /// # Errors
    /// Returns an error if the library or the device is missing, the library has another version, or the device is
    /// not calibrated.
    pub(super) fn open(which: Option<&str>, library: Option<&Path>) -> io::Result<Self> {
        let (calls, loaded) = OpenHapticsCalls::load(library)?;
        calls.version(&loaded)?;
        let name = which.map(CString::new).transpose()?;
        // SAFETY: null is the default device.
        let handle = unsafe { (calls.init)(name.as_ref().map_or(std::ptr::null(), |name| name.as_ptr())) };
        let failure = calls.failure();
        if handle == INVALID_HANDLE || failure.is_some() {
            let why = failure.map_or_else(|| "no reason given".to_owned(), |code| calls.words(code));
            let message = format!(
                "no device of OpenHaptics: {why}. Is it plugged in, was it set up by the maker's tool, and does no other program have it?"
            );
            return Err(io::Error::new(io::ErrorKind::NotFound, message));
        }
        // SAFETY: the device is open.
        unsafe { (calls.make_current)(handle) };
        if calls.calibration.is_some_and(|check| unsafe { check() } == NEEDS_INKWELL) {
            // SAFETY: as above.
            unsafe { (calls.disable_device)(handle) };
            let message = "the device is not calibrated: put the stylus into its inkwell, and try again";
            return Err(io::Error::other(message));
        }
        let (descriptor, middle_mm) = describe(&calls);
        let exchange = Exchange {
            place_mm: [0.0; 3],
            buttons: 0,
            stylus: [0.0; 9],
            force_n: [0.0; 3],
            torque_mn_m: (descriptor.torque_n_m > 0.0).then_some([0.0; 3]),
            written: Instant::now(),
            came: None,
            frames: 0,
            fault: None,
        };
        // Never freed: a frame of the library may be running as long as the program does.
        let shared: &'static SharedState =
            Box::leak(Box::new(SharedState { calls, handle, exchange: Mutex::new(exchange) }));
        // SAFETY: the function has the type of a frame, and `shared` is never freed.
        let task = unsafe {
            let task = (calls.schedule)(frame, std::ptr::from_ref(shared).cast_mut().cast(), PRIORITY);
            (calls.enable)(FORCE_OUTPUT);
            (calls.start)();
            task
        };
        let device = OpenHaptics { shared, task, descriptor, middle_mm, buttons: 0, orientation: DQuat::IDENTITY };
        let begun = Instant::now();
        loop {
            let seen = device.shared.seen();
            if seen.came.is_some() {
                return Ok(device);
            }
            device.alive(&seen, begun, FIRST)?;
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// Returns an error if frames have ended, or if none arrived for `most` since `came`.
    fn alive(&self, seen: &Exchange, came: Instant, most: Duration) -> io::Result<()> {
        let gone = |message: String| io::Error::new(io::ErrorKind::NotConnected, message);
        if let Some(code) = seen.fault {
            return Err(gone(format!("openhaptics: the device failed: {}", self.shared.calls.words(code))));
        }
        if came.elapsed() > most {
            return Err(gone("openhaptics: the library's loop stands still".to_owned()));
        }
        Ok(())
    }
}

/// Returns the limits of the current device, as it reports them, and the middle of its workspace, mm.
fn describe(calls: &OpenHapticsCalls) -> (Device, DVec3) {
    // SAFETY: the library's texts are constants.
    let model = unsafe { text_of((calls.get_text)(MODEL)) }.unwrap_or_default().to_lowercase();
    let _ = calls.failure();
    let name = if model.contains("desktop") {
        "desktop"
    } else if model.contains("omni") {
        "omni"
    } else {
        "touch"
    };
    let table = Device::named(name).unwrap_or(palpate_haptics::device::UNDECLARED);
    let told = |parameter, factor: f64, instead: f64| {
        let [number] = calls.numbers(parameter);
        if number.is_finite() && number > 0.0 { factor * number } else { instead }
    };
    let corners = |parameter| {
        let [a, b, c, d, e, f] = calls.numbers(parameter);
        (DVec3::new(a, b, c), DVec3::new(d, e, f))
    };
    let mut outputs = 0;
    // SAFETY: a number that lives during the call.
    unsafe { (calls.get_whole)(OUTPUT_DOF, &raw mut outputs) };
    let _ = calls.failure();
    let (least_mm, most_mm) = corners(USABLE_WORKSPACE);
    let whole_mm = corners(MAX_WORKSPACE);
    let reach_m = 0.5e-3 * (whole_mm.1 - whole_mm.0).length();
    let descriptor = Device {
        name: table.name,
        force_n: told(MAX_FORCE, 1.0, table.force_n),
        continuous_n: told(MAX_CONTINUOUS_FORCE, 1.0, table.continuous_n),
        stiffness_n_per_m: told(MAX_STIFFNESS, 1e3, table.stiffness_n_per_m),
        damping_n_s_per_m: told(MAX_DAMPING, 1e3, table.damping_n_s_per_m),
        workspace_m: if reach_m.is_finite() && reach_m > 0.0 { reach_m } else { table.workspace_m },
        torque_n_m: if outputs == SIX_AXES { told(MAX_TORQUE, 1e-3, 0.0) } else { 0.0 },
    };
    let middle_mm = 0.5 * (least_mm + most_mm);
    (descriptor, if middle_mm.is_finite() { middle_mm } else { DVec3::ZERO })
}

impl HapticDevice for OpenHaptics {
    fn descriptor(&self) -> Device {
        self.descriptor
    }

    fn read(&mut self) -> io::Result<Reading> {
        let seen = self.shared.seen();
        self.alive(&seen, seen.came.unwrap_or_else(Instant::now), GONE)?;
        self.buttons = seen.buttons.unsigned_abs();
        let stylus = DMat3::from_cols_array(&seen.stylus) * STYLUS;
        // A library that reports no transform leaves the stylus as it was.
        if (stylus.determinant() - 1.0).abs() < 1e-3 {
            let [x, y, z] = [stylus.x_axis, stylus.y_axis, stylus.z_axis].map(of_device);
            self.orientation = DQuat::from_mat3(&DMat3::from_cols(x, y, z)).normalize();
        }
        let place_m = of_device(1e-3 * (DVec3::from_array(seen.place_mm) - self.middle_mm));
        Ok(Reading { place_m, enable: self.buttons & 1 != 0 })
    }

    fn write(&mut self, force_n: DVec3) -> io::Result<()> {
        self.write_wrench(Wrench::of_force(force_n))
    }

    fn orientation(&self) -> DQuat {
        self.orientation
    }

    fn write_wrench(&mut self, wrench: Wrench) -> io::Result<()> {
        let mut exchange = self.shared.exchange();
        exchange.force_n = of_library(wrench.force_n);
        exchange.torque_mn_m = exchange.torque_mn_m.map(|_| of_library(1e3 * wrench.torque_n_m));
        exchange.written = Instant::now();
        Ok(())
    }

    fn buttons(&self) -> u32 {
        self.buttons
    }

    fn button_count(&self) -> u32 {
        2
    }
}

impl Drop for OpenHaptics {
    fn drop(&mut self) {
        let _ = self.write(DVec3::ZERO);
        let (begun, before) = (Instant::now(), self.shared.seen().frames);
        loop {
            let Exchange { frames, fault, .. } = self.shared.seen();
            // Waits for two more frames: one of them is whole, and has set that force.
            if frames >= before + 2 || fault.is_some() || begun.elapsed() > CLOSES {
                break;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        let OpenHapticsCalls { stop, unschedule, disable_device, .. } = self.shared.calls;
        // SAFETY: the device is open, and nothing uses it after this.
        unsafe {
            stop();
            unschedule(self.task);
            disable_device(self.shared.handle);
        }
    }
}

/// Returns whether the library is there, and a description. The library reports devices only when they are opened.
///
/// # Errors
/// Returns an error if the library is missing or has another version.
pub(super) fn tell(library: Option<&Path>) -> io::Result<(bool, String)> {
    let (calls, loaded) = OpenHapticsCalls::load(library)?;
    let version = calls.version(&loaded)?;
    Ok((true, format!("{} {version}: it finds out about devices when one is opened", loaded.name())))
}
