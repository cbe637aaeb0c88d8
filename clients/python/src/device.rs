//! Haptic devices: Python objects, and courses that are played.

use std::io::{Error, ErrorKind, Result};
use std::time::Instant;

use glam::{DQuat, DVec3};
use palpate_client::{HapticDevice, Reading};
use palpate_haptics::device::{DEVICES, UNDECLARED};
use palpate_haptics::instrument_pose::MAX_JAW_RAD;
use palpate_haptics::{Device, Wrench};
use palpate_refusal::did_you_mean;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::ending;
use crate::error::{refused, wrong};

/// Returns the names of the devices whose limits are known.
#[pyfunction]
pub(crate) fn devices() -> Vec<&'static str> {
    DEVICES.iter().map(|device| device.name).chain([UNDECLARED.name]).collect()
}

/// Reads the limits of a device: by its name, or from a dict.
pub(crate) fn descriptor(value: Option<Bound<'_, PyAny>>) -> PyResult<Device> {
    let Some(value) = value.filter(|value| !value.is_none()) else { return Ok(UNDECLARED) };
    if let Ok(limits) = value.cast::<PyDict>() {
        let mut device = Device { name: "python", ..UNDECLARED };
        for (key, value) in limits.iter() {
            let key: String = key.extract()?;
            let number = value.extract().ok().filter(|number: &f64| number.is_finite() && *number >= 0.0);
            let number = number.ok_or_else(|| wrong("limits", format!("{key} must be a number, 0 or more")))?;
            match key.as_str() {
                "force_n" => device.force_n = number,
                "continuous_n" => device.continuous_n = number,
                "stiffness_n_per_m" => device.stiffness_n_per_m = number,
                "damping_n_s_per_m" => device.damping_n_s_per_m = number,
                "workspace_m" => device.workspace_m = number,
                "torque_n_m" => device.torque_n_m = number,
                _ => {
                    let keys = [
                        "force_n",
                        "continuous_n",
                        "stiffness_n_per_m",
                        "damping_n_s_per_m",
                        "workspace_m",
                        "torque_n_m",
                    ];
                    let message = format!("`{key}` is not one of {}{}", keys.join(", "), did_you_mean(&key, keys));
                    return Err(wrong("limits", message));
                }
            }
        }
        return Ok(device);
    }
    let name: String = value.extract().map_err(|_| wrong("limits", "must be the name of a device, or a dict"))?;
    if name == UNDECLARED.name {
        return Ok(UNDECLARED);
    }
    Device::named(&name).ok_or_else(|| {
        let message =
            format!("must be one of {}, but is `{name}`{}", devices().join(", "), did_you_mean(&name, devices()));
        refused(palpate_refusal::Refusal::new(palpate_refusal::Reason::WrongKind, "limits", message))
    })
}

/// A device given by Python.
pub(crate) enum Given {
    /// An object with `read()` and `write(force_n)`, or, if it leads an instrument, `write(force_n, torque_n_m)`. Then it has an
    /// orientation and an angle of the jaws, rad, at the newest reading.
    Object { device: Device, read: Py<PyAny>, write: Py<PyAny>, handle: Option<(DQuat, f64)> },
    /// A course: a place for each millisecond.
    Course { device: Device, places_m: Vec<DVec3>, begun: Option<Instant> },
}

/// Interval at which a course requests forces, s: the envelope may refuse or stop them.
const ASKS_EVERY_S: f64 = 0.3;

/// Places of a course per second.
const RATE_HZ: f64 = 1000.0;

impl Given {
    /// Reads an object or a `palpate.Course`, which does not turn.
    pub(crate) fn of(value: &Bound<'_, PyAny>, leads_instrument: bool) -> PyResult<Self> {
        let device = descriptor(value.getattr_opt("limits")?)?;
        if let Some(places_m) = value.getattr_opt("places_m")? {
            let places_m: Vec<[f64; 3]> =
                places_m.extract().map_err(|_| wrong("places_m", "must be rows of three numbers, x, y and z"))?;
            if places_m.is_empty() || places_m.iter().flatten().any(|number| !number.is_finite()) {
                return Err(wrong("places_m", "must have at least one row, and finite numbers"));
            }
            let places_m = places_m.into_iter().map(DVec3::from_array).collect();
            return Ok(Given::Course { device, places_m, begun: None });
        }
        let method = |name: &str| -> PyResult<Py<PyAny>> {
            let method = value.getattr_opt(name)?.filter(|found| found.is_callable());
            method
                .map(Bound::unbind)
                .ok_or_else(|| wrong("device", format!("has no method `{name}`: it needs read() and write(force_n)")))
        };
        let handle = leads_instrument.then_some((DQuat::IDENTITY, 0.0));
        Ok(Given::Object { device, read: method("read")?, write: method("write")?, handle })
    }

    /// Returns how long the course lasts, s; `None` for an object.
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn lasts_s(&self) -> Option<f64> {
        match self {
            Given::Object { .. } => None,
            Given::Course { places_m, .. } => Some(places_m.len() as f64 / RATE_HZ),
        }
    }
}

/// Runs `work` with the interpreter, unless it is shutting down.
fn attached<T>(work: impl FnOnce(Python<'_>) -> PyResult<T>) -> Result<T> {
    ending::attached(work).unwrap_or_else(|| Err(ending::ended())).map_err(Error::other)
}

impl HapticDevice for Given {
    fn descriptor(&self) -> Device {
        match self {
            Given::Object { device, .. } | Given::Course { device, .. } => *device,
        }
    }

    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn read(&mut self) -> Result<Reading> {
        match self {
            Given::Object { read, handle: Some(handle), .. } => attached(|py| {
                let told: ([f64; 3], bool, [f64; 4], f64) = read.bind(py).call0()?.extract().map_err(|_| {
                    let text = "read() must return place, whether forces are asked for, orientation and jaw angle: \
                                ((x, y, z), True, (w, x, y, z), 0.5)";
                    wrong("device", text)
                })?;
                let (place_m, enable, [w, x, y, z], jaw_rad) = told;
                let orientation = DQuat::from_xyzw(x, y, z, w);
                if (orientation.length() - 1.0).abs() > 1e-3 {
                    return Err(wrong("device", "read() returned an orientation whose length is not 1"));
                }
                *handle = (orientation.normalize(), jaw_rad.clamp(0.0, MAX_JAW_RAD));
                Ok(Reading { place_m: DVec3::from_array(place_m), enable })
            }),
            Given::Object { read, .. } => attached(|py| {
                let (place_m, enable): ([f64; 3], bool) = read.bind(py).call0()?.extract().map_err(|_| {
                    wrong("device", "read() must return a place and whether forces are asked for: ((x, y, z), True)")
                })?;
                Ok(Reading { place_m: DVec3::from_array(place_m), enable })
            }),
            Given::Course { places_m, begun, .. } => {
                let now_s = begun.get_or_insert_with(Instant::now).elapsed().as_secs_f64();
                // Chosen by the time that has passed: a late tick does not make the course longer.
                let place_m = places_m.get((now_s * RATE_HZ) as usize).or(places_m.last()).copied();
                let place_m = place_m.ok_or(ErrorKind::InvalidInput)?;
                Ok(Reading { place_m, enable: now_s % ASKS_EVERY_S < ASKS_EVERY_S / 2.0 })
            }
        }
    }

    fn orientation(&self) -> DQuat {
        match self {
            Given::Object { handle: Some((orientation, _)), .. } => *orientation,
            _ => DQuat::IDENTITY,
        }
    }

    fn jaw_rad(&self) -> f64 {
        match self {
            Given::Object { handle: Some((_, jaw_rad)), .. } => *jaw_rad,
            _ => 0.0,
        }
    }

    fn write_wrench(&mut self, wrench: Wrench) -> Result<()> {
        match self {
            Given::Object { write, .. } => {
                let [force, torque] = [wrench.force_n, wrench.torque_n_m].map(<(f64, f64, f64)>::from);
                attached(|py| write.bind(py).call1((force, torque)).map(drop))
            }
            Given::Course { .. } => Ok(()),
        }
    }

    fn write(&mut self, force_n: DVec3) -> Result<()> {
        match self {
            Given::Object { write, .. } => {
                attached(|py| write.bind(py).call1((<(f64, f64, f64)>::from(force_n),)).map(drop))
            }
            Given::Course { .. } => Ok(()),
        }
    }
}
