//! Loads of a server by a plan: the same plans and reports as those of `palpate-client load`.

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

/// The plan of a dict, a file, or a text.
fn plan(value: &Bound<'_, PyAny>) -> PyResult<LoadPlan> {
    let read = if let Ok(table) = value.cast::<PyDict>() {
        let lines = table.iter().map(|(key, value)| Ok(format!("{} = {}\n", key.str()?, toml("plan", &value)?)));
        let text = lines.collect::<PyResult<String>>()?;
        // Its lines are ours, and mean nothing to who wrote a dict.
        LoadPlan::parse(TEXT, &text).map_err(|refusal| Refusal { place: None, ..refusal })
    } else {
        match SceneSource::of("plan", value)? {
            SceneSource::Text(text) => LoadPlan::parse(TEXT, &text),
            SceneSource::Path(path) => LoadPlan::read(&path),
        }
    };
    read.map_err(refused)
}

/// A report, for Python as a dict.
struct ReportDict(String);

impl<'py> IntoPyObject<'py> for ReportDict {
    type Target = PyAny;
    type Output = Bound<'py, PyAny>;
    type Error = PyErr;

    fn into_pyobject(self, py: Python<'py>) -> PyResult<Self::Output> {
        py.import("json")?.call_method1("loads", (self.0,))
    }
}

/// Loads a server by a plan, and gives its report; writes that to a page too, if one is named. When the wait for it ends early, the
/// users leave and their sessions are deleted.
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
    // Before the load: a wrong path must not cost what is measured.
    let page = page.map(|path| File::create(&path).map_err(|error| unwritten(&path, error)).map(|file| (path, file)));
    let page = page.transpose()?;
    let (end, ended) = oneshot::channel::<()>();
    answer_in_order(py, awaited, Some(end), async move {
        let stop = async {
            // Dropped when nobody waits any more.
            let _ = ended.await;
        };
        let report = course.run(&server, |_| {}, |_| {}, stop).await.map_err(of_client)?;
        if let Some((path, mut file)) = page {
            file.write_all(report.page().as_bytes()).map_err(|error| unwritten(&path, error))?;
        }
        Ok(ReportDict(report.json().to_string()))
    })
}
