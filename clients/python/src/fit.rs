//! Fits the parameters of a tissue to measured curves.

use std::path::PathBuf;

use palpate_fitting::curve_file::{MeasuredCurve, UsualTip, read_curves};
use palpate_fitting::fit::fit as fit_curves;
use palpate_fitting::options::FitOptions;
use palpate_haptics::TipShape;
use palpate_session::press::ImposedPress;
use palpate_tissue::files;
use palpate_tissue::scene::Named;
use palpate_tissue::scene::tissue_parameter::TissueParameter;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

use crate::arrays::{column, shaped, vector};
use crate::error::{of_run, refused, wrong};
use crate::run::thread_count;
use crate::scene::{Scene, Tissue, limits};
use crate::waiting::work;

/// The tip of curves of a file whose table does not give one.
const USUAL: UsualTip = UsualTip { shape: TipShape::Disc, radius_m: 0.005 };

/// Reads the curves that Python gave: the path of a table, or curves.
fn curves_of(given: &Bound<'_, PyAny>) -> PyResult<Vec<MeasuredCurve>> {
    if let Ok(path) = given.extract::<PathBuf>() {
        let read = files::read_text(&path, limits().trace_bytes);
        return read.and_then(|text| read_curves(&path.display().to_string(), &text, USUAL)).map_err(refused);
    }
    let is_one = given.hasattr("force_n")?;
    let curves: Vec<Bound<'_, PyAny>> =
        if is_one { vec![given.clone()] } else { given.try_iter()?.collect::<PyResult<_>>()? };
    let curve = |(index, curve): (usize, &Bound<'_, PyAny>)| {
        let of = |name: &str| format!("curves[{index}].{name}");
        let numbers = |name: &str| -> PyResult<Vec<f64>> {
            curve.getattr(name)?.extract().map_err(|_| wrong(&of(name), "must be a list or an array of numbers"))
        };
        let shape: String = curve.getattr("tip")?.extract()?;
        let place = curve.getattr("place_m")?;
        let press = ImposedPress {
            place_m: if place.is_none() { None } else { Some(vector(&of("place_m"), &place)?) },
            shape: shape.parse().map_err(|message: String| wrong(&of("tip"), message))?,
            radius_m: curve.getattr("radius_m")?.extract()?,
            time_s: numbers("time_s")?,
            depth_m: numbers("depth_m")?,
        };
        press.check().map_err(|refusal| refused(refusal.within(&format!("curves[{index}]"))))?;
        let force_n = numbers("force_n")?;
        if force_n.len() != press.time_s.len() || force_n.iter().any(|force_n| !force_n.is_finite()) {
            let message = format!("must be {} finite numbers, one for each time", press.time_s.len());
            return Err(wrong(&of("force_n"), message));
        }
        Ok(MeasuredCurve { name: curve.getattr("name")?.extract()?, press, force_n })
    };
    curves.iter().enumerate().map(curve).collect()
}

/// Fits parameters of a scene to measured curves of force over depth, as `palpate fit` does: `curves` are one or several `Curve`, or
/// the path of a table. `parameters` are keys of the scene such as "material.youngs_modulus_pa"; by default all that the scene has and
/// the curves can tell. Raises Refused if the curves can't tell one that is named.
#[pyfunction]
#[pyo3(signature = (scene, curves, *, parameters=None, threads=None))]
pub(crate) fn fit<'py>(
    py: Python<'py>,
    scene: &Bound<'py, PyAny>,
    curves: &Bound<'py, PyAny>,
    parameters: Option<Vec<String>>,
    threads: Option<usize>,
) -> PyResult<Bound<'py, PyAny>> {
    let model = Tissue::given(py, scene)?;
    let curves = curves_of(curves)?;
    let named = |name: &String| TissueParameter::named("parameters", name).map_err(refused);
    let parameters = parameters.unwrap_or_default().iter().map(named).collect::<PyResult<Vec<_>>>()?;
    let threads = thread_count(threads)?;
    let limits = limits();
    let found = work(py, |stop| {
        let options = FitOptions { parameters: &parameters, threads, limits: &limits, stop };
        fit_curves(&model, &curves, &options, &mut |_| {})
    })?;
    let found = found.map_err(of_run)?;
    let [values, intervals, start, units, untold] = std::array::from_fn(|_| PyDict::new(py));
    for one in &found.parameters {
        let name = one.parameter.name();
        values.set_item(name, one.value)?;
        intervals.set_item(name, (one.interval[0], one.interval[1]))?;
        start.set_item(name, one.start)?;
        units.set_item(name, one.parameter.unit())?;
    }
    for one in &found.untold {
        untold.set_item(one.parameter.name(), &one.reason)?;
    }
    let count = found.parameters.len();
    let residual = |(curve, fitted_n): (&MeasuredCurve, &Vec<f64>)| {
        column(
            py,
            fitted_n.iter().zip(&curve.force_n).map(|(fitted, measured)| fitted - measured).collect::<Vec<f64>>(),
        )
    };
    let residual_n = curves.iter().zip(&found.fitted_n).map(residual).collect::<PyResult<Vec<_>>>()?;
    let fitted_n = found.fitted_n.iter().map(|fitted_n| column(py, fitted_n.clone())).collect::<PyResult<Vec<_>>>()?;
    let given = PyDict::new(py);
    for (name, table) in
        [("values", values), ("intervals", intervals), ("start", start), ("units", units), ("untold", untold)]
    {
        given.set_item(name, table)?;
    }
    given.set_item("correlations", shaped(py, found.correlations.concat(), &[count])?)?;
    given.set_item("fitted_n", PyList::new(py, fitted_n)?)?;
    given.set_item("residual_n", PyList::new(py, residual_n)?)?;
    given.set_item("rms_n", found.residual.rms_n)?;
    given.set_item("relative_rms", found.residual.relative_rms)?;
    given.set_item("r_squared", found.residual.r_squared)?;
    given.set_item("noise_of_curves_n", &found.noise_of_curves_n)?;
    given.set_item("autocorrelation", found.autocorrelation)?;
    given.set_item("runs", found.runs)?;
    given.set_item("warnings", &found.warnings)?;
    given.set_item("scene", Bound::new(py, Scene::fitted(found.scene))?)?;
    py.import("palpate._fit")?.getattr("Fit")?.call((), Some(&given))
}
