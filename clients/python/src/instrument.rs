//! The instrument that a device leads, for Python.

use palpate_haptics::Port;
use palpate_haptics::instrument::MAX_TIPS;
use palpate_haptics::jaw_limit::MAX_JAW_TORQUE_LIMIT_N_M;
use palpate_haptics::port::{DEFAULT_HANDLE_M, HANDLE_M};
use pyo3::prelude::*;

use crate::arrays::vector;
use crate::error::wrong;
use crate::tip::Tip;

/// An instrument that a device leads by its place and orientation: jaws that end at its place, and a shaft behind them, each
/// a row of tips of a length. It points along x of its frame; the jaws open in y. With `port_m` the shaft slides through that
/// place, as through a trocar, and the handle is `handle_m` from the place. `Touched.jaw_overloads` counts how often the torque
/// between the jaws exceeded `jaw_torque_limit_n_m`. Raises Refused if it has neither jaws nor a shaft.
#[pyclass(frozen, module = "palpate", from_py_object)]
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Instrument(pub(crate) palpate_haptics::Instrument);

#[pymethods]
impl Instrument {
    #[new]
    #[pyo3(signature = (*, jaws_m=None, shaft_m=None, tip=None, port_m=None, handle_m=DEFAULT_HANDLE_M, jaw_torque_limit_n_m=None))]
    fn new(
        jaws_m: Option<f64>,
        shaft_m: Option<f64>,
        tip: Option<Tip>,
        port_m: Option<&Bound<'_, PyAny>>,
        handle_m: f64,
        jaw_torque_limit_n_m: Option<f64>,
    ) -> PyResult<Self> {
        let tip = tip.map(|tip| tip.0).unwrap_or_default();
        if tip.radius_m.is_nan() || tip.radius_m <= 0.0 {
            return Err(wrong("tip", "must have a radius above 0"));
        }
        let part = |field: &'static str, length_m: Option<f64>| match length_m {
            Some(length_m) if length_m.is_nan() || length_m <= 0.0 => Err(wrong(field, "must be above 0")),
            _ => Ok(length_m.map(|length_m| (length_m, tip))),
        };
        let (jaws, shaft) = (part("jaws_m", jaws_m)?, part("shaft_m", shaft_m)?);
        if jaws.is_none() && shaft.is_none() {
            return Err(wrong("instrument", "must have jaws or a shaft: give `jaws_m` or `shaft_m`"));
        }
        let mut instrument = palpate_haptics::Instrument::default();
        instrument.add_parts(jaws, shaft);
        let tips = instrument.tips.len();
        if tips > MAX_TIPS {
            let message = format!("has {tips} tips, above the limit of {MAX_TIPS}: rows have one for each radius");
            return Err(wrong("instrument", message));
        }
        if !HANDLE_M.contains(&handle_m) {
            return Err(wrong("handle_m", format!("must be from {} to {}", HANDLE_M.start(), HANDLE_M.end())));
        }
        let place_m = port_m.map(|port_m| vector("port_m", port_m)).transpose()?;
        instrument.port = place_m.map(|place_m| Port { place_m, handle_m });
        if let Some(limit_n_m) = jaw_torque_limit_n_m {
            if jaws.is_none() {
                return Err(wrong("jaw_torque_limit_n_m", "is for an instrument with jaws"));
            }
            if !(limit_n_m > 0.0 && limit_n_m <= MAX_JAW_TORQUE_LIMIT_N_M) {
                let message = format!("must be above 0 and at most {MAX_JAW_TORQUE_LIMIT_N_M}");
                return Err(wrong("jaw_torque_limit_n_m", message));
            }
        }
        instrument.jaw_torque_limit_n_m = jaw_torque_limit_n_m;
        Ok(Instrument(instrument))
    }

    /// The number of tips: each is a tool of the session.
    #[getter]
    fn tips(&self) -> usize {
        self.0.tips.len()
    }

    fn __repr__(&self) -> String {
        format!("Instrument(tips={})", self.0.tips.len())
    }
}
