//! Options of callers: structures that start with their size, so that later versions can add fields.

use std::ffi::{c_char, c_void};
use std::sync::Arc;

use glam::DVec3;
use palpate_client::bridge::{Copies, HandSlot, PositionOrigin, Warn};
use palpate_haptics::instrument::{InstrumentPart, MAX_TIPS};
use palpate_haptics::port::{DEFAULT_HANDLE_M, HANDLE_M};
use palpate_haptics::{Device, Instrument, Port, Tip, TipShape};
use palpate_proto::{pb, touch};
use palpate_session::journal;

use crate::axes::{palpate_axes, palpate_vector};
use crate::error::{CodedError, guard, optional_text, palpate_result, text};
use crate::hand::palpate_hand;

/// A function of the caller that gets messages for people: `user` as given beside it, and one line of text, which
/// is valid during the call.
pub type palpate_warn = Option<unsafe extern "C" fn(user: *mut c_void, message: *const c_char)>;

/// Options of `palpate_connect`. Texts are copied.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct palpate_connect_options {
    /// Size of this structure, set by `palpate_connect_options_init`.
    pub size: usize,
    /// Your token, or null. It is sent only over TLS or to this machine.
    pub token: *const c_char,
    /// Certificates (PEM) to trust instead of the system's, or null.
    pub ca_pem: *const c_char,
    /// The name that the server's certificate must carry if it differs from the host of the URL, or null.
    pub tls_name: *const c_char,
    /// Your certificate (PEM), or null.
    pub certificate_pem: *const c_char,
    /// The private key of your certificate (PEM), or null.
    pub key_pem: *const c_char,
    /// Time limit of each call, s; default 60, since creating a session of an organ takes the server some seconds.
    /// For connecting at most 10 s.
    pub timeout_s: f64,
}

/// The limits of a haptic device. No force exceeds them, nor 3.3 N.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct palpate_limits {
    /// Largest force, N.
    pub max_force_n: f64,
    /// Largest force for longer than 2 s, N.
    pub continuous_force_n: f64,
    /// Largest stiffness, N/m.
    pub max_stiffness_n_per_m: f64,
    /// Largest damping, N·s/m.
    pub max_damping_n_s_per_m: f64,
    /// Radius of the workspace around its middle, which is placed on the top of the tissue, m. Outside it nothing is
    /// rendered.
    pub workspace_radius_m: f64,
}

/// Options of `palpate_touch_begin`, `palpate_touch_begin_offline`, `palpate_bridge_begin` and
/// `palpate_bridge_begin_instrument`. Texts are copied.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct palpate_touch_options {
    /// Size of this structure, set by `palpate_touch_options_init`.
    pub size: usize,
    /// Number of the tool; default 0.
    pub tool: u32,
    /// Axes of positions and forces, one of `palpate_axes`; default `PALPATE_AXES_OWN`.
    pub axes: u32,
    /// The frame of positions. 0 (default): the device's frame, whose origin is placed on the top of the tissue. 1:
    /// the tissue's frame, in which positions of its surface are given too.
    pub in_tissue_frame: u32,
    /// 1: the tip holds the tissue, and pulls as well as pushes; 0 (default): it touches and only pushes.
    pub grasps: u32,
    /// Radius of the tip, m, 0.0001 to 0.1; default 0.005.
    pub tip_radius_m: f64,
    /// Friction coefficient of the tip, 0 to 10; default 0.2.
    pub friction: f64,
    /// Limits of the device; by default 2 N.
    pub limits: palpate_limits,
    /// The server sends a sample only when the force rendered without it would be wrong by more than this fraction, 0
    /// to 1; 0 (default): one per step.
    pub deadband: f64,
    /// The library sends a position only when the server's prediction would be wrong by more than this fraction of
    /// the force, 0 to 1; 0 (default): one per tick.
    pub up_deadband: f64,
    /// 1 (default): positions and samples go by datagram if the server offers datagrams; 0: never.
    pub datagrams: u32,
    /// 1 (default): the library's own loop requests real-time priority; 0: it does not.
    pub real_time: u32,
    /// Your name, which other users of the server see; null (default): "libpalpate".
    pub holder: *const c_char,
    /// Called with messages for people: a warning of the server, a connection that broke. Called from any thread of
    /// the library; it must not wait. Null (default): the messages are dropped.
    pub warn: palpate_warn,
    /// Passed to `warn`.
    pub warn_user: *mut c_void,
    /// Which tissues to copy and simulate locally, so that forces come without the delay of the network; samples
    /// correct the copy. 0 (default): none; 1: meshes, whose rims, folds and lumps no local model can predict; 2:
    /// all. A thread of the library steps the copy; a tick uses its result for the last tick, and waits for nothing.
    pub prediction: u32,
    /// How the tip presses, one of `palpate_tip_shape`; default `PALPATE_TIP_DISC`. Only that one holds. With `PALPATE_TIP_BLADE` jaws are
    /// scissors, and a shaft without jaws begins behind the `edge`.
    pub tip_shape: u32,
    /// Length of the jaws of an instrument, which end at the device's position, m, at most 0.5; 0 (default): none. With jaws
    /// or a shaft the device leads an instrument, by its position, orientation and jaws: a row of tips for each jaw and for
    /// the shaft, at most 64 in all, a tip at least for each `tip_radius_m`. Each tip is a tool, with the numbers from `tool`
    /// on (`palpate_tool_count`). Force and torque come from a copy of the tissue, also if `prediction` is 0. `grasps`,
    /// `deadband` and `up_deadband` must be 0.
    pub jaws_m: f64,
    /// Length of the shaft behind the jaws, or behind the device's position, m, at most 0.5; 0 (default): none.
    pub shaft_m: f64,
    /// 1: the shaft slides through `port` and turns about it, as through a trocar; 0 (default): it moves freely.
    pub has_port: u32,
    /// The place of the port, always in the tissue's frame, in the axes of the options.
    pub port: palpate_vector,
    /// Distance from the tip of the instrument to its handle, m, 0.01 to 2; default 0.33. The shaft passes through the port
    /// between both.
    pub handle_m: f64,
    /// Largest torque of the device, N·m, 0 to 100; 0 (default): it renders none.
    pub max_torque_n_m: f64,
    /// One of the two hands of `palpate_two_hands`, if your program moves two tools or instruments; null (default): this
    /// is the only one.
    pub hand: *const palpate_hand,
    /// With `PALPATE_TIP_BLADE`: the edge of the blade from its tip, at the tool's position, to its heel, as a vector of the tissue's
    /// frame, in the axes and units of the options; of an instrument with a shaft and no jaws, of the instrument's frame, which points
    /// along Palpate's x. Default 0: none.
    pub edge: palpate_vector,
    /// Cautery: the time of contact after which the tissue under the tip is severed, s, up to 3600; 0 (default): it does not burn. For
    /// all tips but `PALPATE_TIP_BLADE`.
    pub burn_s: f64,
}

/// Options of `palpate_surface_open`.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct palpate_surface_options {
    /// Size of this structure, set by `palpate_surface_options_init`.
    pub size: usize,
    /// Axes of positions and normals, one of `palpate_axes`; default `PALPATE_AXES_OWN`.
    pub axes: u32,
    /// Number of vertices between neighbouring points, 0 to 10; default 0.
    pub refinement: u32,
    /// Frames per second, above 0 and at most the session's step rate; default 60.
    pub rate_hz: f64,
}

/// Sets all options to their defaults; `size` is `sizeof *options`. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_connect_options_init(
    options: *mut palpate_connect_options,
    size: usize,
) -> palpate_result {
    // SAFETY: the caller's promise.
    unsafe { init(options, size) }
}

/// Sets all options to their defaults; `size` is `sizeof *options`. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_touch_options_init(
    options: *mut palpate_touch_options,
    size: usize,
) -> palpate_result {
    // SAFETY: the caller's promise.
    unsafe { init(options, size) }
}

/// Sets all options to their defaults; `size` is `sizeof *options`. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_surface_options_init(
    options: *mut palpate_surface_options,
    size: usize,
) -> palpate_result {
    // SAFETY: the caller's promise.
    unsafe { init(options, size) }
}

/// Writes the limits of a device by its name: touch, omni, desktop, falcon, omega3, delta3, sigma7, lambda7,
/// inverse3. Returns `PALPATE_ARGUMENT` for another name. Any thread.
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
    /// Returns a device with these limits and a largest torque, N·m; refuses invalid ones.
    pub(crate) fn device(&self, max_torque_n_m: f64) -> Result<Device, CodedError> {
        let message = pb::Device {
            name: "libpalpate".to_owned(),
            max_force_n: self.max_force_n,
            continuous_force_n: self.continuous_force_n,
            max_stiffness_n_per_m: self.max_stiffness_n_per_m,
            max_damping_n_s_per_m: self.max_damping_n_s_per_m,
            workspace_radius_m: self.workspace_radius_m,
            max_torque_n_m,
        };
        touch::from_device(&message).map_err(|refusal| CodedError::argument(refusal.to_string()))
    }
}

/// A structure that starts with its size.
///
/// # Safety
/// The first field must be its size, a `usize`, and all bytes may be copied.
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
            tip_shape: palpate_tip_shape::default() as u32,
            jaws_m: 0.0,
            shaft_m: 0.0,
            has_port: 0,
            port: palpate_vector::default(),
            handle_m: DEFAULT_HANDLE_M,
            max_torque_n_m: 0.0,
            hand: std::ptr::null(),
            edge: palpate_vector::default(),
            burn_s: 0.0,
        }
    }
}

// SAFETY: as above.
unsafe impl Versioned for palpate_surface_options {
    fn initial() -> Self {
        palpate_surface_options { size: size_of::<Self>(), axes: 0, refinement: 0, rate_hz: 60.0 }
    }
}

/// Sets options to their defaults.
///
/// # Safety
/// The pointer must be null, or valid for `size` bytes.
pub(crate) unsafe fn init<T: Versioned>(options: *mut T, size: usize) -> palpate_result {
    guard(|| {
        if options.is_null() {
            return Err(CodedError::argument("options is null"));
        }
        if size < size_of::<usize>() || size > size_of::<T>() {
            let why = format!("size is {size}: the header is of another version than the library ({})", size_of::<T>());
            return Err(CodedError::argument(why));
        }
        let initial = T::initial();
        // SAFETY: this number of bytes is valid on both sides; the structure of an older header is shorter.
        unsafe {
            std::ptr::copy_nonoverlapping((&raw const initial).cast::<u8>(), options.cast::<u8>(), size);
            options.cast::<usize>().write(size);
        }
        Ok(())
    })
}

/// Reads the options of a caller, whose structure may be that of an older header; null means the defaults.
///
/// # Safety
/// The pointer must be null, or as many bytes as its first field says must be valid.
pub(crate) unsafe fn options_at<T: Versioned>(pointer: *const T) -> Result<T, CodedError> {
    let mut options = T::initial();
    if pointer.is_null() {
        return Ok(options);
    }
    // SAFETY: the first field is the size.
    let size = unsafe { pointer.cast::<usize>().read() };
    // Fields that only a later header has are unknown here and might matter: refuse them.
    if size < size_of::<usize>() || size > size_of::<T>() {
        let why = format!(
            "options.size is {size}: fill the structure by its _init function first; or the header is newer than the library"
        );
        return Err(CodedError::argument(why));
    }
    // SAFETY: this number of bytes is valid on both sides.
    unsafe { std::ptr::copy_nonoverlapping(pointer.cast::<u8>(), (&raw mut options).cast::<u8>(), size) };
    Ok(options)
}

/// How a tip presses.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum palpate_tip_shape {
    /// A flat disc of even pressure.
    #[default]
    PALPATE_TIP_DISC = 0,
    /// A flat rigid disc.
    PALPATE_TIP_RIGID_DISC = 1,
    /// A rigid sphere, whose middle is at the position. Like the rigid disc it touches solids alone.
    PALPATE_TIP_SPHERE = 2,
    /// A blade, which severs what its `edge` crosses.
    PALPATE_TIP_BLADE = 3,
}

pub use palpate_tip_shape::*;

impl palpate_tip_shape {
    fn of(number: u32) -> Result<TipShape, CodedError> {
        match number {
            0 => Ok(TipShape::Disc),
            1 => Ok(TipShape::RigidDisc),
            2 => Ok(TipShape::Sphere),
            3 => Ok(TipShape::Blade),
            _ => Err(CodedError::argument(format!("tip_shape is {number}: must be one of palpate_tip_shape"))),
        }
    }
}

/// Largest length of jaws or a shaft, m.
const MAX_PART_M: f64 = 0.5;

/// Returns a value of the options if it is within its range, else an error that names it.
fn within(name: &str, value: f64, range: std::ops::RangeInclusive<f64>) -> Result<f64, CodedError> {
    let wrong =
        || CodedError::argument(format!("{name} is {value}: must be from {} to {}", range.start(), range.end()));
    if range.contains(&value) { Ok(value) } else { Err(wrong()) }
}

/// Checked options for touching.
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
    pub(crate) instrument: Option<Instrument>,
    pub(crate) hand: Option<HandSlot>,
}

impl TouchOptions {
    /// Returns the number of tools that a loop with these options moves.
    pub(crate) fn tool_count(&self) -> u32 {
        let tips = self.instrument.as_ref().map_or(1, |instrument| instrument.tips.len());
        u32::try_from(tips).unwrap_or(u32::MAX)
    }
}

/// Returns the tissues to copy, by the value of `prediction` in `palpate_touch_options`.
fn copies(number: u32) -> Result<Option<Copies>, CodedError> {
    if number > 2 {
        return Err(CodedError::argument(format!("prediction is {number}: must be 0, 1 or 2")));
    }
    Ok((number > 0).then(|| Copies { make: Arc::new(journal::prediction), of_grids: number == 2 }))
}

/// The caller's function for messages, and its argument.
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
    /// `holder` must be null or a zero-terminated text, `hand` null or a hand.
    pub(crate) unsafe fn checked(&self) -> Result<TouchOptions, CodedError> {
        let warn = |show| -> Warn {
            let shown = TextCallback { show, user: self.warn_user };
            Box::new(move |message| shown.show(message))
        };
        // SAFETY: the caller's promise.
        let holder = unsafe { optional_text(self.holder, "holder") }?.unwrap_or("libpalpate").to_owned();
        let axes = palpate_axes::of(self.axes)?;
        let tip = Tip {
            radius_m: within("tip_radius_m", self.tip_radius_m, 1e-4..=0.1)?,
            friction: within("friction", self.friction, 0.0..=10.0)?,
            grasps: self.grasps != 0,
            shape: palpate_tip_shape::of(self.tip_shape)?,
            edge_m: axes.to_m(self.edge),
            burn_s: within("burn_s", self.burn_s, 0.0..=3600.0)?,
            ..Tip::default()
        };
        // The edges of scissors are their jaws.
        let has_edge = tip.shape == TipShape::Blade && self.jaws_m == 0.0;
        if !(tip.edge_m.is_finite() && has_edge == (tip.edge_m != DVec3::ZERO)) {
            return Err(CodedError::argument(
                "edge: a blade that is not scissors needs a finite one above 0, and no other tip has one",
            ));
        }
        let instrument = self.instrument(axes, tip)?;
        // An instrument is rendered from a copy of any tissue.
        let prediction = if instrument.is_some() { self.prediction.max(2) } else { self.prediction };
        // SAFETY: the caller's promise.
        let hand = unsafe { self.hand.as_ref() }.map(|hand| hand.slot.clone());
        Ok(TouchOptions {
            tool: self.tool,
            axes,
            origin: if self.in_tissue_frame == 0 { PositionOrigin::Workspace } else { PositionOrigin::Tissue },
            tip,
            device: self.limits.device(self.max_torque_n_m)?,
            deadband: within("deadband", self.deadband, 0.0..=1.0)?,
            up_deadband: within("up_deadband", self.up_deadband, 0.0..=1.0)?,
            datagrams: self.datagrams != 0,
            real_time: self.real_time != 0,
            holder,
            warn: self.warn.map(warn),
            copies: copies(prediction)?,
            instrument,
            hand,
        })
    }

    /// Returns the instrument of the options, with these tips; `None` for a single tip.
    fn instrument(&self, axes: palpate_axes, tip: Tip) -> Result<Option<Instrument>, CodedError> {
        let part = |name, length_m: f64| {
            within(name, length_m, 0.0..=MAX_PART_M).map(|length_m| (length_m > 0.0).then_some((length_m, tip)))
        };
        let (jaws, shaft) = (part("jaws_m", self.jaws_m)?, part("shaft_m", self.shaft_m)?);
        let handle_m = within("handle_m", self.handle_m, HANDLE_M)?;
        if jaws.is_none() && shaft.is_none() {
            return if self.has_port == 0 {
                Ok(None)
            } else {
                Err(CodedError::argument("has_port: a port is for an instrument: jaws_m or shaft_m must be above 0"))
            };
        }
        if tip.grasps {
            return Err(CodedError::argument("grasps: an instrument holds the tissue between its jaws: must be 0"));
        }
        for (name, value) in [("deadband", self.deadband), ("up_deadband", self.up_deadband)] {
            if value != 0.0 {
                return Err(CodedError::argument(format!("{name} is {value}: must be 0 for an instrument")));
            }
        }
        let mut instrument = Instrument::default();
        if tip.shape == TipShape::Blade {
            // Only the edge cuts: what is behind it touches.
            let handle = Tip { shape: TipShape::Disc, edge_m: DVec3::ZERO, ..tip };
            match jaws {
                Some((length_m, blade)) => instrument.add_scissors(length_m, blade),
                None => instrument = Instrument::of_tip(tip),
            }
            if let Some((length_m, _)) = shaft {
                let from_m = if jaws.is_some() { instrument.hinge_m } else { tip.edge_m };
                instrument.add_row(from_m, from_m - length_m * DVec3::X, handle, InstrumentPart::Body);
            }
        } else {
            instrument.add_parts(jaws, shaft);
        }
        let tips = instrument.tips.len();
        if tips > MAX_TIPS {
            let why = format!(
                "jaws_m, shaft_m: the instrument has {tips} tips, above the limit of {MAX_TIPS}: rows have one for each \
                 tip_radius_m"
            );
            return Err(CodedError::argument(why));
        }
        if self.has_port != 0 {
            let place_m = axes.to_m(self.port);
            if !place_m.is_finite() {
                return Err(CodedError::argument("port must be finite"));
            }
            instrument.port = Some(Port { place_m, handle_m });
        }
        Ok(Some(instrument))
    }
}
