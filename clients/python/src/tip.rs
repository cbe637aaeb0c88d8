//! The tip of a tool, for Python.

use palpate_haptics::{Coupling, TipShape};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

/// The tip of a tool: a disc that touches, or holds with `grasps=True`. With a stiffness it is coupled by a spring. With
/// `shape="rigid"` it is a flat rigid disc, with `shape="sphere"` a rigid sphere, whose place is its centre: on solids only. With
/// `edge_m` it is a blade, whose edge runs from its place by that vector. With
/// `burn_s`, s, a tip that is no blade severs by heat what it has touched for that time.
#[pyclass(frozen, module = "palpate", from_py_object)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Tip(pub(crate) palpate_haptics::Tip);

#[pymethods]
impl Tip {
    #[new]
    #[allow(clippy::too_many_arguments)]
    #[pyo3(signature = (
        radius_m=0.005, *, friction=0.2, grasps=false, stiffness_n_per_m=None, damping_n_s_per_m=0.0, shape="disc",
        edge_m=None, burn_s=0.0
    ))]
    fn new(
        radius_m: f64,
        friction: f64,
        grasps: bool,
        stiffness_n_per_m: Option<f64>,
        damping_n_s_per_m: f64,
        shape: &str,
        edge_m: Option<[f64; 3]>,
        burn_s: f64,
    ) -> PyResult<Self> {
        let shape: TipShape = shape.parse().map_err(|message| PyValueError::new_err(format!("shape: {message}")))?;
        let shape = if edge_m.is_some() { TipShape::Blade } else { shape };
        let coupling = stiffness_n_per_m.map_or(Coupling::Constraint, |stiffness_n_per_m| Coupling::Spring {
            stiffness_n_per_m,
            damping_n_s_per_m,
        });
        Ok(Tip(palpate_haptics::Tip {
            shape,
            radius_m,
            friction,
            grasps,
            coupling,
            edge_m: edge_m.unwrap_or_default().into(),
            burn_s,
        }))
    }

    /// The shape: disc, rigid, sphere or blade.
    #[getter]
    fn shape(&self) -> &'static str {
        self.0.shape.name()
    }

    /// The radius of the disc or sphere, m.
    #[getter]
    fn radius_m(&self) -> f64 {
        self.0.radius_m
    }

    /// The coefficient of friction.
    #[getter]
    fn friction(&self) -> f64 {
        self.0.friction
    }

    /// Whether the tip holds the tissue under it instead of touching it.
    #[getter]
    fn grasps(&self) -> bool {
        self.0.grasps
    }

    fn __repr__(&self) -> String {
        let palpate_haptics::Tip { shape, radius_m, friction, grasps, .. } = self.0;
        let shape = if shape.is_rigid() { format!(", shape=\"{}\"", shape.name()) } else { String::new() };
        format!("Tip({radius_m}, friction={friction}, grasps={}{shape})", if grasps { "True" } else { "False" })
    }
}
