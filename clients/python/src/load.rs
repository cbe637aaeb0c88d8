//! Loads a server by a plan, with the plans and reports of `palpate-client load`.

use std::fs::File;
use std::io::Write;
use std::path::PathBuf;

use palpate_client::Server;
use palpate_refusal::Refusal;
use palpate_simulated::load::{LoadPlan, PreparedPlan};
use pyo3::exceptions::PyOSError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use tokio::sync::oneshot;

use crate::error::{of_client, refused};
use crate::scene::{SceneSource, TEXT, toml};
use crate::waiting::answer_in_order;

/// Reads a plan from a dict, a file, or a text.
fn plan(value: &Bound<'_, PyAny>) -> PyResult<LoadPlan> {
    let read = if let Ok(table) = value.cast::<PyDict>() {
        let lines = table.iter().map(|(key, value)| Ok(format!("{} = {}\n", key.str()?, toml("plan", &value)?)));
        let text = lines.collect::<PyResult<String>>()?;
        // The text was generated: its line numbers mean nothing to the author of a dict.
        LoadPlan::parse(TEXT, &text).map_err(|refusal| Refusal { place: None, ..refusal })
    } else {
        match SceneSource::of("plan", value)? {
            SceneSource::Text(text) => LoadPlan::parse(TEXT, &text),
            SceneSource::Path(path) => LoadPlan::read(&path),
        }
    };
    read.map_err(refused)
}

/// A report, which becomes a dict in Python.
struct ReportDict(String);

impl<'py> IntoPyObject<'py> for ReportDict {
    type Target = PyAny;
    type Output = Bound<'py, PyAny>;
    type Error = PyErr;

    fn into_pyobject(self, py: Python<'py>) -> PyResult<Self::Output> {
        py.import("json")?.call_method1("loads", (self.0,))
    }
}

/// Loads a server by a plan, and returns its report; also writes it to a page, if one is given. When the wait ends
/// early, the simulated users leave and their sessions are deleted.
pub(crate) fn load<'py>(
    py: Python<'py>,
    server: Server,
    given: &Bound<'py, PyAny>,
    page: Option<PathBuf>,
    awaited: bool,
) -> PyResult<Bound<'py, PyAny>> {
    let plan = plan(given)?;
    let course = py.detach(|| PreparedPlan::new(plan)).map_err(refused)?;
    let unwritten = |path: &PathBuf, error: std::io::Error| PyOSError::new_err(format!("{}: {error}", path.display()));
    // Opened before the load: a wrong path must not cost the measurements.
    let page = page.map(|path| File::create(&path).map_err(|error| unwritten(&path, error)).map(|file| (path, file)));
    let page = page.transpose()?;
    let (end, ended) = oneshot::channel::<()>();
    answer_in_order(py, awaited, Some(end), async move {
        let stop = async {
            // Dropped when the caller no longer waits.
            let _ = ended.await;
        };
        let report = course.run(&server, |_| {}, |_| {}, stop).await.map_err(of_client)?;
        if let Some((path, mut file)) = page {
            file.write_all(report.page().as_bytes()).map_err(|error| unwritten(&path, error))?;
        }
        Ok(ReportDict(report.json().to_string()))
    })
}
