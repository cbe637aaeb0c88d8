//! Scenes, scripts and compiled tissues.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, PoisonError};

use palpate_refusal::{Reason, Refusal};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::saved::SavedPlan;
use palpate_tissue::scene::collection::{Collection, find_scene, find_script};
use palpate_tissue::scene::kind::TextKind;
use palpate_tissue::scene::{self, Named};
use palpate_tissue::shape::{PointId, PointName};
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict, PyFloat, PyInt, PyString};

use crate::arrays::{column, rows, shaped, vector};
use crate::error::{refused, wrong};
use crate::waiting::work;

/// The name in refusals of a text that comes from no file.
pub(crate) const TEXT: &str = "<text>";

/// Returns the limits of a process with one user.
pub(crate) fn limits() -> Limits {
    Limits::default().offline()
}

/// The source of a scene, a script or a plan.
#[derive(Debug, Clone)]
pub(crate) enum SceneSource {
    Text(String),
    /// A file, or a name.
    Path(PathBuf),
}

impl SceneSource {
    pub(crate) fn of(field: &str, value: &Bound<'_, PyAny>) -> PyResult<Self> {
        if let Ok(text) = value.cast::<PyString>() {
            let text: String = text.extract()?;
            // A name contains neither; a file with such a name can be given as a pathlib.Path.
            let is_text = text.contains('\n') || text.contains('=');
            return Ok(if is_text { SceneSource::Text(text) } else { SceneSource::Path(text.into()) });
        }
        let path: PyResult<PathBuf> = value.extract();
        path.map(SceneSource::Path).map_err(|_| wrong(field, "must be TOML text, a path, or a name"))
    }
}

/// Converts an argument to TOML.
pub(crate) fn toml(field: &str, value: &Bound<'_, PyAny>) -> PyResult<String> {
    if value.is_instance_of::<PyBool>() {
        return Ok(if value.extract()? { "true" } else { "false" }.to_owned());
    }
    if value.is_instance_of::<PyInt>() {
        return Ok(value.str()?.to_string());
    }
    if value.is_instance_of::<PyFloat>() {
        let value: f64 = value.extract()?;
        return Ok(if value.is_nan() { "nan".to_owned() } else { format!("{value:?}") });
    }
    if let Ok(text) = value.cast::<PyString>() {
        return Ok(serde_json::Value::from(text.extract::<String>()?).to_string());
    }
    if let Ok(table) = value.cast::<PyDict>() {
        let pairs: PyResult<Vec<String>> =
            table.iter().map(|(key, value)| Ok(format!("{} = {}", key.str()?, toml(field, &value)?))).collect();
        return Ok(format!("{{ {} }}", pairs?.join(", ")));
    }
    if value.hasattr("tolist")? {
        return toml(field, &value.call_method0("tolist")?);
    }
    let items = value.try_iter().map_err(|_| wrong(field, format!("can't write {value} as TOML")))?;
    let items: PyResult<Vec<String>> = items.map(|item| toml(field, &item?)).collect();
    Ok(format!("[{}]", items?.join(", ")))
}

/// Converts `{"springs.stiffness_n_per_m": 50}` to assignments.
fn assignments(set: Option<&Bound<'_, PyAny>>) -> PyResult<Vec<String>> {
    let Some(set) = set else { return Ok(Vec::new()) };
    if let Ok(table) = set.cast::<PyDict>() {
        return table.iter().map(|(key, value)| Ok(format!("{}={}", key.str()?, toml("set", &value)?))).collect();
    }
    set.extract().map_err(|_| wrong("set", "must be a dict of keys and values, or a list of \"key=value\""))
}

/// A scene that was read and checked: from TOML text, a file, or a scene's name (`scenes()`).
///
/// `set` overrides keys: {"springs.stiffness_n_per_m": 50}. `folder` contains the scenes that are given by name. With
/// `plan` the scene is stepped like that tissue (integrator, substeps, precision, sleep), without the search for what
/// its own tolerance requires: that saves most of the time of a short run, but its error is unknown (`run(...,
/// audit=True)` measures it).
#[pyclass(frozen, module = "palpate")]
pub(crate) struct Scene {
    pub(crate) scene: scene::Scene,
    /// Its name in refusals.
    pub(crate) place: String,
    /// Stepped like this model, without a search for what its tolerance requires.
    plan: Option<Arc<Model>>,
    model: Mutex<Option<Arc<Model>>>,
}

impl Scene {
    /// Reads what Python gave: a scene, or the source of one.
    pub(crate) fn given<'py>(value: &Bound<'py, PyAny>) -> PyResult<Bound<'py, Scene>> {
        if let Ok(scene) = value.cast::<Scene>() {
            return Ok(scene.clone());
        }
        Bound::new(value.py(), Scene::new(value, None, "scenes".into(), None)?)
    }

    /// Returns the scene of a fit.
    pub(crate) fn fitted(scene: scene::Scene) -> Self {
        Scene { place: scene.name.clone(), scene, plan: None, model: Mutex::new(None) }
    }

    /// Returns the tissue, which is compiled once.
    pub(crate) fn compiled(&self, stop: &AtomicBool) -> Result<Arc<Model>, Refusal> {
        let mut model = self.model.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(model) = &*model {
            return Ok(model.clone());
        }
        // As in the programs: an error of compilation belongs to no single line.
        let in_scene = |refusal: Refusal| Refusal { place: Some(self.place.clone()), ..refusal };
        let made = match &self.plan {
            Some(plan) => Model::resumed(&self.scene, &planned(&self.scene, plan), &limits()),
            None => Model::compile_until(&self.scene, &limits(), stop),
        };
        let made = made.map_err(in_scene)?;
        Ok(model.insert(made).clone())
    }
}

/// Combines the coefficients of a scene with the plan of a model. The error is unknown.
fn planned(scene: &scene::Scene, plan: &Model) -> SavedPlan {
    SavedPlan {
        stiffness_n_per_m: scene.springs.stiffness_n_per_m,
        shear_stiffness_n_per_m: scene.springs.shear_stiffness_n_per_m,
        anchor_stiffness_n_per_m: scene.anchor_stiffness_n_per_m,
        damping_n_s_per_m: scene.damping_n_s_per_m,
        volume_stiffness_pa: scene.volume_stiffness_pa,
        sleep_tolerance: scene.sleep_tolerance.unwrap_or(plan.sleep_tolerance),
        sleep_tolerance_of_scene: scene.sleep_tolerance,
        expected_error: f64::INFINITY,
        corrected: None,
        ..plan.saved_plan()
    }
}

#[pymethods]
impl Scene {
    #[new]
    #[pyo3(signature = (source, *, set=None, folder="scenes".into(), plan=None))]
    fn new(
        source: &Bound<'_, PyAny>,
        set: Option<&Bound<'_, PyAny>>,
        folder: PathBuf,
        plan: Option<&Bound<'_, Tissue>>,
    ) -> PyResult<Self> {
        let (source, sets, limits) = (SceneSource::of("source", source)?, assignments(set)?, limits());
        let read = source_scene(&source, &sets, &folder, &limits).map_err(refused)?;
        Ok(Scene { plan: plan.map(|plan| plan.get().model.clone()), ..read })
    }

    /// The scene's name.
    #[getter]
    fn name(&self) -> &str {
        &self.scene.name
    }

    /// The number of mass points.
    #[getter]
    fn points(&self) -> usize {
        self.scene.shape().point_count()
    }

    /// Number of steps per second.
    #[getter]
    fn rate_hz(&self) -> f64 {
        self.scene.stepping.rate_hz
    }

    fn __repr__(&self) -> String {
        format!("<palpate.Scene {:?}: {}>", self.scene.name, self.scene.shape().describe())
    }
}

fn source_scene(source: &SceneSource, sets: &[String], folder: &Path, limits: &Limits) -> Result<Scene, Refusal> {
    let (scene, place) = match source {
        SceneSource::Text(text) => (scene::Scene::parse_in(Path::new(""), TEXT, text, sets, limits)?, TEXT.to_owned()),
        SceneSource::Path(path) => (find_scene(path, folder, sets, limits)?, path.display().to_string()),
    };
    Ok(Scene { scene, place, plan: None, model: Mutex::new(None) })
}

/// Forces and movements over time: from TOML text, a file, or a script's name (`scripts()`). `folder` contains the
/// traces that a text names.
#[pyclass(frozen, module = "palpate")]
#[derive(Debug, Clone)]
pub(crate) struct Script {
    source: SceneSource,
    folder: PathBuf,
}

impl Script {
    /// Reads what Python gave: a script, or the source of one.
    pub(crate) fn given(value: &Bound<'_, PyAny>) -> PyResult<Self> {
        match value.cast::<Script>() {
            Ok(script) => Ok(script.get().clone()),
            Err(_) => Script::new(value, PathBuf::new()),
        }
    }

    /// Binds the script to a scene.
    pub(crate) fn bound(&self, scene: &scene::Scene) -> Result<scene::script::Script, Refusal> {
        match &self.source {
            SceneSource::Text(text) => scene::script::Script::parse(TEXT, text, &self.folder, scene, &limits()),
            SceneSource::Path(path) => find_script(path, scene, &limits()),
        }
    }
}

#[pymethods]
impl Script {
    #[new]
    #[pyo3(signature = (source, *, folder=PathBuf::new()))]
    fn new(source: &Bound<'_, PyAny>, folder: PathBuf) -> PyResult<Self> {
        Ok(Script { source: SceneSource::of("source", source)?, folder })
    }

    /// Binds the script to a scene; returns its name, steps, sample_every_steps, tools and warnings. Raises Refused
    /// if it does not fit.
    fn check<'py>(&self, py: Python<'py>, scene: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyDict>> {
        let scene = Scene::given(scene)?;
        let script = self.bound(&scene.get().scene).map_err(refused)?;
        let found = PyDict::new(py);
        found.set_item("name", &script.name)?;
        found.set_item("steps", script.steps)?;
        found.set_item("sample_every_steps", script.sample_every)?;
        found.set_item("tools", script.tools())?;
        found.set_item("warnings", &script.warnings)?;
        Ok(found)
    }

    fn __repr__(&self) -> String {
        match &self.source {
            SceneSource::Text(_) => "<palpate.Script>".to_owned(),
            SceneSource::Path(path) => format!("<palpate.Script {:?}>", path.display().to_string()),
        }
    }
}

/// A compiled scene: what is simulated, and how. Compiling may take some tenths of a second; a Scene does it once.
#[pyclass(frozen, module = "palpate")]
pub(crate) struct Tissue {
    pub(crate) model: Arc<Model>,
}

impl Tissue {
    /// Compiles what Python gave: a tissue, a scene, or the source of one.
    pub(crate) fn given(py: Python<'_>, value: &Bound<'_, PyAny>) -> PyResult<Arc<Model>> {
        if let Ok(tissue) = value.cast::<Tissue>() {
            return Ok(tissue.get().model.clone());
        }
        let scene = Scene::given(value)?;
        let scene = scene.get();
        work(py, |stop| scene.compiled(stop))?.map_err(refused)
    }
}

/// Finds the point that Python names: (i, j) on a sheet, the number of a vertex on a mesh.
pub(crate) fn point(model: &Model, value: &Bound<'_, PyAny>) -> PyResult<PointId> {
    model.shape().find("point", point_name(value)?).map_err(refused)
}

/// Reads the name of a point.
pub(crate) fn point_name(value: &Bound<'_, PyAny>) -> PyResult<PointName> {
    if let Ok(vertex) = value.extract::<u32>() {
        return Ok(PointName::Vertex(vertex));
    }
    let message = "must be (i, j) on a sheet, or the number of a vertex on a mesh; none below 0";
    value.extract().map(PointName::Point).map_err(|_| wrong("point", message))
}

/// Converts the name of a point for Python.
pub(crate) fn named<'py>(py: Python<'py>, name: PointName) -> PyResult<Bound<'py, PyAny>> {
    match name {
        PointName::Point([i, j]) => Ok((i, j).into_pyobject(py)?.into_any()),
        PointName::Vertex(vertex) => Ok(vertex.into_pyobject(py)?.into_any()),
    }
}

#[pymethods]
impl Tissue {
    #[new]
    fn new(py: Python<'_>, scene: &Bound<'_, PyAny>) -> PyResult<Self> {
        Ok(Tissue { model: Tissue::given(py, scene)? })
    }

    /// The name of its scene.
    #[getter]
    fn name(&self) -> &str {
        &self.model.scene.name
    }

    fn __len__(&self) -> usize {
        self.model.len()
    }

    /// Number of steps per second.
    #[getter]
    fn rate_hz(&self) -> f64 {
        self.model.scene.stepping.rate_hz
    }

    /// The integrator with which it is stepped.
    #[getter]
    fn integrator(&self) -> &'static str {
        self.model.plan.integrator.name()
    }

    /// Number of substeps per step.
    #[getter]
    fn substeps(&self) -> u32 {
        self.model.plan.substeps
    }

    /// The number format of the points.
    #[getter]
    fn precision(&self) -> &'static str {
        self.model.precision.name()
    }

    /// The vector instructions with which it is stepped. They do not change the results.
    #[getter]
    fn lanes(&self) -> &'static str {
        self.model.lanes.name()
    }

    /// The expected error of displacement and force, relative to the largest of each; infinite if it is unknown.
    #[getter]
    fn expected_error(&self) -> f64 {
        self.model.expected_error
    }

    /// Warnings about the scene, as sentences.
    #[getter]
    fn warnings(&self) -> Vec<String> {
        self.model.warnings.clone()
    }

    /// Number of points along x and y of a sheet, as in rest_m.reshape(*grid, 3); None for a mesh.
    #[getter]
    fn grid(&self) -> Option<(usize, usize)> {
        self.model.shape().grid().map(|[x, y]| (x, y))
    }

    /// The position of each point at rest, m.
    #[getter]
    fn rest_m<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let shape = self.model.shape();
        rows(py, self.model.points().flat_map(|point| shape.rest_m(point).to_array()).collect())
    }

    /// The outward unit normal of the surface at rest at each point.
    #[getter]
    fn normals<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let shape = self.model.shape();
        rows(py, self.model.points().flat_map(|point| shape.normal(point).to_array()).collect())
    }

    /// Whether each point is fixed.
    #[getter]
    fn fixed<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let shape = self.model.shape();
        let fixed: Vec<bool> = self.model.points().map(|point| shape.is_fixed(point)).collect();
        column(py, fixed)
    }

    /// The mass of each point, kg.
    #[getter]
    fn mass_kg<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let masses: Vec<f64> = self.model.points().map(|point| self.model.mass_kg(point)).collect();
        column(py, masses)
    }

    /// The triangles of the surface, each with the rows of its three points, counter-clockwise from outside.
    #[getter]
    fn triangles<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        shaped(py, self.model.shape().triangles().into_flattened(), &[3])
    }

    /// Returns the row of a point: (i, j) on a sheet, the number of a vertex on a mesh.
    fn index(&self, point: &Bound<'_, PyAny>) -> PyResult<usize> {
        Ok(self::point(&self.model, point)?.index())
    }

    /// Returns the name of the point in a row.
    fn point<'py>(&self, py: Python<'py>, index: usize) -> PyResult<Bound<'py, PyAny>> {
        if index >= self.model.len() {
            let message = format!("must be below {}, the number of points, but is {index}", self.model.len());
            return Err(refused(Refusal::new(Reason::OutOfRange, "index", message)));
        }
        named(py, self.model.shape().name(PointId::new(index)))
    }

    /// Returns the row of the point that rests nearest to a place.
    fn nearest(&self, place_m: &Bound<'_, PyAny>) -> PyResult<usize> {
        let place_m = vector("place_m", place_m)?;
        palpate_refusal::finite_vector("place_m", place_m).map_err(refused)?;
        Ok(self.model.shape().nearest(place_m).index())
    }

    /// The middle of the bounding box of the tissue at rest, m.
    #[getter]
    fn middle_m(&self) -> (f64, f64, f64) {
        let middle_m = self.model.shape().extent().middle_m();
        middle_m.into()
    }

    /// The highest place of the surface at rest above or below the middle, m: of a sheet, its middle. Devices have
    /// their origin there.
    #[getter]
    fn top_m(&self) -> (f64, f64, f64) {
        self.model.shape().top_m().into()
    }

    fn __repr__(&self) -> String {
        let Model { scene, plan, precision, .. } = &*self.model;
        let (name, shape, rate_hz) = (&scene.name, scene.shape().describe(), scene.stepping.rate_hz);
        let (integrator, substeps) = (plan.integrator.name(), plan.substeps);
        format!(
            "<palpate.Tissue {name:?}: {shape}, {rate_hz} Hz, {integrator}, {substeps} substeps, {}>",
            precision.name()
        )
    }
}

fn names(kind: TextKind, folder: &Path) -> Vec<String> {
    Collection::new(kind, folder).names(&limits())
}

/// Returns the names of the built-in scenes, and of those in a folder.
#[pyfunction]
#[pyo3(signature = (folder="scenes".into()))]
pub(crate) fn scenes(folder: PathBuf) -> Vec<String> {
    names(TextKind::Scene, &folder)
}

/// Returns the names of the built-in scripts, and of those in a folder.
#[pyfunction]
#[pyo3(signature = (folder="scripts".into()))]
pub(crate) fn scripts(folder: PathBuf) -> Vec<String> {
    names(TextKind::Script, &folder)
}
