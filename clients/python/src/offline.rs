//! A touch loop without a network: the caller decides what arrives, and when the ticks are.

use std::sync::{Mutex, PoisonError};

use glam::DVec3;
use palpate_client::Reading;
use palpate_client::bridge::{self, PositionOrigin};
use palpate_haptics::RenderingState;
use palpate_refusal::finite_vector;
use pyo3::prelude::*;

use crate::arrays::vector;
use crate::device::descriptor;
use crate::error::{of_client, refused};

/// A touch loop without a network: equal messages, places and times give equal forces, bit by bit, as in every other
/// language.
///
/// `limits` are the limits of a device, as for a Course. Places are measured from the middle of the device's
/// workspace, which is placed at `middle_m` of the tissue (use its `top_m`, as a server does); with
/// `in_tissue_frame`, in the tissue's own frame.
#[pyclass(frozen, module = "palpate")]
pub(crate) struct Offline {
    inner: Mutex<bridge::Offline>,
}

impl Offline {
    fn with<T>(&self, work: impl FnOnce(&mut bridge::Offline) -> T) -> T {
        work(&mut self.inner.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

#[pymethods]
impl Offline {
    #[new]
    #[pyo3(signature = (limits=None, *, middle_m=None, in_tissue_frame=false, up_deadband=0.0))]
    fn new(
        limits: Option<Bound<'_, PyAny>>,
        middle_m: Option<&Bound<'_, PyAny>>,
        in_tissue_frame: bool,
        up_deadband: f64,
    ) -> PyResult<Self> {
        let middle_m = middle_m.map(|place| vector("middle_m", place)).transpose()?.unwrap_or(DVec3::ZERO);
        finite_vector("middle_m", middle_m).map_err(refused)?;
        let origin = if in_tissue_frame { PositionOrigin::Tissue } else { PositionOrigin::Workspace };
        let inner = bridge::Offline::new(descriptor(limits)?, origin, middle_m, up_deadband);
        Ok(Offline { inner: Mutex::new(inner) })
    }

    /// Delivers a message of the server: the bytes of a `palpate.v1.TouchResponse`. The next tick uses it.
    fn arrive(&self, message: &[u8]) -> PyResult<()> {
        self.with(|offline| offline.record.arrive(message)).map_err(of_client)
    }

    /// Returns the force to render from now on, N, for a device that is at `place_m` at `time_s`, a time of any
    /// origin. A change of enable from False to True enables forces. Without a connection (an `opened` message that
    /// has arrived) the force is zero.
    #[pyo3(signature = (place_m, time_s, enable=true))]
    fn tick(&self, place_m: [f64; 3], time_s: f64, enable: bool) -> (f64, f64, f64) {
        let reading = Reading { place_m: DVec3::from_array(place_m), enable };
        self.with(|offline| offline.ticker.tick(reading, time_s)).into()
    }

    /// Stops rendering until it is enabled again.
    fn disable(&self) {
        self.with(|offline| offline.ticker.disable());
    }

    /// Whether forces are rendered: "waiting" before a connection, "disabled" until forces are enabled, "enabled",
    /// "paused" after a silence, "fault" after a position that is not finite or outside the workspace.
    #[getter]
    fn state(&self) -> &'static str {
        match self.with(|offline| offline.ticker.state()) {
            None => "waiting",
            Some(RenderingState::Disabled) => "disabled",
            Some(RenderingState::Enabled) => "enabled",
            Some(RenderingState::Paused) => "paused",
            Some(RenderingState::Fault) => "fault",
        }
    }

    /// The tool's position at the last tick, in the tissue's frame.
    #[getter]
    fn place_m(&self) -> (f64, f64, f64) {
        self.with(|offline| offline.ticker.place_m()).into()
    }

    /// Age of the newest data of the tissue, s; None before the first.
    #[getter]
    fn age_s(&self) -> Option<f64> {
        self.with(|offline| offline.ticker.model_age_s())
    }

    fn __repr__(&self) -> String {
        format!("<palpate.Offline: {}>", self.state())
    }
}
