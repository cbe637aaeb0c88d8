//! What callers choose: structures that begin with their size, so that later versions can add to them.

use std::ffi::{c_char, c_void};
use std::sync::Arc;

use palpate_client::bridge::{Copies, PositionOrigin, Warn};
use palpate_haptics::{Device, Tip};
use palpate_proto::{pb, touch};
use palpate_session::journal;

use crate::axes::palpate_axes;
use crate::error::{CodedError, guard, optional_text, palpate_result, text};

/// A function of the caller's that is shown texts for people.
pub type palpate_warn = Option<unsafe extern "C" fn(user: *mut c_void, message: *const c_char)>;

/// How to connect.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct palpate_connect_options {
    /// Of this structure, as `palpate_connect_options_init` has set it.
    pub size: usize,
    /// Your token, or null. It is sent only over TLS or to this machine.
    pub token: *const c_char,
    /// Certificates (PEM) to trust in place of the system's, or null.
    pub ca_pem: *const c_char,
    /// The name that the server's certificate must carry if it is not the URL's host, or null.
    pub tls_name: *const c_char,
    /// Your certificate (PEM), or null.
    pub certificate_pem: *const c_char,
    /// Its private key (PEM), or null.
    pub key_pem: *const c_char,
    /// Time for each call, s; 60: a session of an organ takes the server some seconds. For the connection 10 at most.
    pub timeout_s: f64,
}

/// What a haptic device can bear. No force goes beyond it, nor beyond 3.3 N.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct palpate_limits {
    /// N.
    pub max_force_n: f64,
    /// For longer than 2 s, N.
    pub continuous_force_n: f64,
    /// N/m.
    pub max_stiffness_n_per_m: f64,
    /// N·s/m.
    pub max_damping_n_s_per_m: f64,
    /// Radius of the workspace around the middle of the tissue, m. Outside it nothing is rendered.
    pub workspace_radius_m: f64,
}

/// How to touch.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct palpate_touch_options {
    /// Of this structure, as `palpate_touch_options_init` has set it.
    pub size: usize,
    /// The tool's number; 0.
    pub tool: u32,
    /// One of `palpate_axes`: of positions and forces.
    pub axes: u32,
    /// What positions mean. 0: they are in the device's frame, whose origin lies on the top of the tissue. 1: they are in the
    /// tissue's frame, as positions of its surface are.
    pub in_tissue_frame: u32,
    /// The tip holds the tissue, pulling as well as pushing; 0: it touches.
    pub grasps: u32,
    /// Radius of the tip, m; 0.005.
    pub tip_radius_m: f64,
    /// Friction coefficient of the tip; 0.2.
    pub friction: f64,
    /// What the device can bear; 2 N.
    pub limits: palpate_limits,
    /// A sample is sent only when the rendered force would be off by more than this fraction; 0: one per step.
    pub deadband: f64,
    /// A position is sent only when the server would be wrong by more than this fraction of the force; 0: one per tick.
    pub up_deadband: f64,
    /// Positions and samples go by datagram where the server has them; 1.
    pub datagrams: u32,
    /// Our loop asks the system for real-time priority; 1.
    pub real_time: u32,
    /// Your name, which other users of the server see; null: "libpalpate".
    pub holder: *const c_char,
    /// Shows a text for people: a warning of the server, a connection that broke. From any thread of the library; it must not
    /// wait. Null: nobody is told.
    pub warn: palpate_warn,
    /// Is handed to `warn`.
    pub warn_user: *mut c_void,
    /// Of which tissues to keep a copy, which is simulated here, so that forces come without the delay of the network; samples
    /// correct them. 0: none; 1: meshes, over whose rims, folds and lumps nothing else knows what comes next; 2: any. A thread
    /// of the library steps the copy; a tick takes what that found at the last one, and waits for nothing. 0.
    pub prediction: u32,
}

/// Which surface to show.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct palpate_surface_options {
    /// Of this structure, as `palpate_surface_options_init` has set it.
    pub size: usize,
    /// One of `palpate_axes`.
    pub axes: u32,
    /// So many vertices are put between neighbouring points; 0 to 10; 0.
    pub refinement: u32,
    /// Frames a second; 60.
    pub rate_hz: f64,
}

/// Fills in what holds if you change nothing; `size` is `sizeof *options`. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_connect_options_init(
    options: *mut palpate_connect_options,
    size: usize,
) -> palpate_result {
    // SAFETY: the caller's promise.
    unsafe { init(options, size) }
}

/// Fills in what holds if you change nothing; `size` is `sizeof *options`. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_touch_options_init(
    options: *mut palpate_touch_options,
    size: usize,
) -> palpate_result {
    // SAFETY: the caller's promise.
    unsafe { init(options, size) }
}

/// Fills in what holds if you change nothing; `size` is `sizeof *options`. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_surface_options_init(
    options: *mut palpate_surface_options,
    size: usize,
) -> palpate_result {
    // SAFETY: the caller's promise.
    unsafe { init(options, size) }
}

/// Returns the limits of a device by its name: touch, omni, desktop, falcon, omega3, delta3, sigma7, lambda7, inverse3.
/// Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_limits_of(name: *const c_char, limits: *mut palpate_limits) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promise.
        let name = unsafe { text(name, "name") }?;
        // SAFETY: the caller's promise.
        let limits = unsafe { crate::error::at_mut(limits, "limits is null") }?;
        let device =
            Device::named(name).ok_or_else(|| CodedError::argument(format!("name: no device is called `{name}`")))?;
        *limits = device.into();
        Ok(())
    })
}

impl From<Device> for palpate_limits {
    fn from(device: Device) -> Self {
        palpate_limits {
            max_force_n: device.force_n,
            continuous_force_n: device.continuous_n,
            max_stiffness_n_per_m: device.stiffness_n_per_m,
            max_damping_n_s_per_m: device.damping_n_s_per_m,
            workspace_radius_m: device.workspace_m,
        }
    }
}

impl palpate_limits {
    /// The device with these limits.
    pub(crate) fn device(&self) -> Result<Device, CodedError> {
        let message = pb::Device {
            name: "libpalpate".to_owned(),
            max_force_n: self.max_force_n,
            continuous_force_n: self.continuous_force_n,
            max_stiffness_n_per_m: self.max_stiffness_n_per_m,
            max_damping_n_s_per_m: self.max_damping_n_s_per_m,
            workspace_radius_m: self.workspace_radius_m,
        };
        touch::from_device(&message).map_err(|refusal| CodedError::argument(refusal.to_string()))
    }
}

/// A structure that begins with its size.
///
/// # Safety
/// The first field is its size, a `usize`, and all bytes may be copied.
pub(crate) unsafe trait Versioned: Copy {
    fn initial() -> Self;
}

// SAFETY: they begin with `size` and have no owner.
unsafe impl Versioned for palpate_connect_options {
    fn initial() -> Self {
        let none = std::ptr::null();
        palpate_connect_options {
            size: size_of::<Self>(),
            token: none,
            ca_pem: none,
            tls_name: none,
            certificate_pem: none,
            key_pem: none,
            timeout_s: 60.0,
        }
    }
}

// SAFETY: as above.
unsafe impl Versioned for palpate_touch_options {
    fn initial() -> Self {
        let tip = Tip::default();
        palpate_touch_options {
            size: size_of::<Self>(),
            tool: 0,
            axes: palpate_axes::default() as u32,
            in_tissue_frame: 0,
            grasps: 0,
            tip_radius_m: tip.radius_m,
            friction: tip.friction,
            limits: palpate_haptics::device::UNDECLARED.into(),
            deadband: 0.0,
            up_deadband: 0.0,
            datagrams: 1,
            real_time: 1,
            holder: std::ptr::null(),
            warn: None,
            warn_user: std::ptr::null_mut(),
            prediction: 0,
        }
    }
}

// SAFETY: as above.
unsafe impl Versioned for palpate_surface_options {
    fn initial() -> Self {
        palpate_surface_options { size: size_of::<Self>(), axes: 0, refinement: 0, rate_hz: 60.0 }
    }
}

unsafe fn init<T: Versioned>(options: *mut T, size: usize) -> palpate_result {
    guard(|| {
        if options.is_null() {
            return Err(CodedError::argument("options is null"));
        }
        if size < size_of::<usize>() || size > size_of::<T>() {
            let why = format!("size is {size}: the header is of another version than the library ({})", size_of::<T>());
            return Err(CodedError::argument(why));
        }
        let initial = T::initial();
        // SAFETY: so many bytes are valid on both sides; the structure of an older header is shorter.
        unsafe {
            std::ptr::copy_nonoverlapping((&raw const initial).cast::<u8>(), options.cast::<u8>(), size);
            options.cast::<usize>().write(size);
        }
        Ok(())
    })
}

/// The options of a caller, whose structure may be that of an older header; null stands for the initial ones.
///
/// # Safety
/// It is null, or as many bytes as its first field says are valid.
pub(crate) unsafe fn options_at<T: Versioned>(pointer: *const T) -> Result<T, CodedError> {
    let mut options = T::initial();
    if pointer.is_null() {
        return Ok(options);
    }
    // SAFETY: the first field is the size.
    let size = unsafe { pointer.cast::<usize>().read() };
    // What a later header has beyond this library's is not known here: it might be of importance.
    if size < size_of::<usize>() || size > size_of::<T>() {
        let why = format!(
            "options.size is {size}: fill the structure by its _init function first; or the header is newer than the library"
        );
        return Err(CodedError::argument(why));
    }
    // SAFETY: so many bytes are valid on both sides.
    unsafe { std::ptr::copy_nonoverlapping(pointer.cast::<u8>(), (&raw mut options).cast::<u8>(), size) };
    Ok(options)
}

/// Options of touch, checked.
pub(crate) struct TouchOptions {
    pub(crate) tool: u32,
    pub(crate) axes: palpate_axes,
    pub(crate) origin: PositionOrigin,
    pub(crate) tip: Tip,
    pub(crate) device: Device,
    pub(crate) deadband: f64,
    pub(crate) up_deadband: f64,
    pub(crate) datagrams: bool,
    pub(crate) real_time: bool,
    pub(crate) holder: String,
    pub(crate) warn: Option<Warn>,
    pub(crate) copies: Option<Copies>,
}

/// By the number of `palpate_touch_options`.
fn copies(number: u32) -> Result<Option<Copies>, CodedError> {
    if number > 2 {
        return Err(CodedError::argument(format!("prediction is {number}: must be 0, 1 or 2")));
    }
    Ok((number > 0).then(|| Copies { make: Arc::new(journal::prediction), of_sheets: number == 2 }))
}

/// A caller's function for texts.
struct TextCallback {
    show: unsafe extern "C" fn(*mut c_void, *const c_char),
    user: *mut c_void,
}

// SAFETY: the header says that any thread of the library may call it.
unsafe impl Send for TextCallback {}
// SAFETY: as above.
unsafe impl Sync for TextCallback {}

impl TextCallback {
    fn show(&self, message: &str) {
        let text = std::ffi::CString::new(message.replace('\0', " ")).unwrap_or_default();
        // SAFETY: the caller's promise; the text is valid during the call.
        unsafe { (self.show)(self.user, text.as_ptr()) };
    }
}

impl palpate_touch_options {
    /// # Safety
    /// `holder` is null or a text.
    pub(crate) unsafe fn checked(&self) -> Result<TouchOptions, CodedError> {
        let within = |name: &str, value: f64, range: std::ops::RangeInclusive<f64>| {
            let wrong = || {
                CodedError::argument(format!("{name} is {value}: must be from {} to {}", range.start(), range.end()))
            };
            if range.contains(&value) { Ok(value) } else { Err(wrong()) }
        };
        let warn = |show| -> Warn {
            let shown = TextCallback { show, user: self.warn_user };
            Box::new(move |message| shown.show(message))
        };
        // SAFETY: the caller's promise.
        let holder = unsafe { optional_text(self.holder, "holder") }?.unwrap_or("libpalpate").to_owned();
        let tip = Tip {
            radius_m: within("tip_radius_m", self.tip_radius_m, 1e-4..=0.1)?,
            friction: within("friction", self.friction, 0.0..=10.0)?,
            grasps: self.grasps != 0,
            ..Tip::default()
        };
        Ok(TouchOptions {
            tool: self.tool,
            axes: palpate_axes::of(self.axes)?,
            origin: if self.in_tissue_frame == 0 { PositionOrigin::Workspace } else { PositionOrigin::Tissue },
            tip,
            device: self.limits.device()?,
            deadband: within("deadband", self.deadband, 0.0..=1.0)?,
            up_deadband: within("up_deadband", self.up_deadband, 0.0..=1.0)?,
            datagrams: self.datagrams != 0,
            real_time: self.real_time != 0,
            holder,
            warn: self.warn.map(warn),
            copies: copies(self.prediction)?,
        })
    }
}
