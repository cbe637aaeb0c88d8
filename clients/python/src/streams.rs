//! Streams of a session on a server: its samples and its frames. They continue on the server that has the session.

use std::sync::Arc;

use palpate_client::{Followed, view, watch};
use palpate_proto::geometry::from_vector;
use palpate_proto::pb;
use pyo3::exceptions::{PyStopAsyncIteration, PyStopIteration};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use tokio::sync::Mutex;
use tonic::Status;

use crate::arrays::{column, records, shaped};
use crate::error::of_client;
use crate::waiting::answer;

/// Maximum number of times that a stream is reopened without receiving anything.
const MAX_TRIES: u32 = 8;

/// A stream that follows its session from server to server.
pub(crate) struct Following<S, R> {
    session: Arc<Followed>,
    request: R,
    stream: S,
    /// Number of times it was reopened since it last received something.
    tries: u32,
}

impl<S, R> Following<S, R> {
    pub(crate) fn new(session: Arc<Followed>, request: R, stream: S) -> Self {
        Following { session, request, stream, tries: 0 }
    }
}

/// Opens a stream of samples on the server that has the session.
pub(crate) async fn samples(session: &Followed, request: &pb::WatchSamplesRequest) -> PyResult<watch::Samples> {
    session.call(|channel| watch::Samples::open(channel, request.clone())).await.map_err(of_client)
}

/// Opens a stream of frames on the server that has the session.
pub(crate) async fn frames(session: &Followed, request: &pb::WatchFramesRequest) -> PyResult<view::Frames> {
    session.call(|channel| view::Frames::open(channel, request.clone())).await.map_err(of_client)
}

impl<S, R> Following<S, R> {
    /// Decides after a stream has ended with `status` whether to reopen it; returns an error if not.
    async fn follow(&mut self, status: Status) -> PyResult<()> {
        self.tries += 1;
        if self.tries > MAX_TRIES {
            return Err(of_client(status.into()));
        }
        self.session.after(status).await.map_err(of_client)
    }
}

impl Following<watch::Samples, pb::WatchSamplesRequest> {
    async fn next(&mut self) -> PyResult<Option<pb::Sample>> {
        loop {
            match self.stream.next().await {
                Ok(Some(sample)) if !self.session.is_current(sample.ownership_revision) => {}
                Ok(sample) => {
                    self.tries = 0;
                    return Ok(sample);
                }
                Err(status) => {
                    self.follow(status).await?;
                    self.stream = samples(&self.session, &self.request).await?;
                }
            }
        }
    }
}

impl Following<view::Frames, pb::WatchFramesRequest> {
    async fn next(&mut self) -> PyResult<Option<SurfaceFrame>> {
        loop {
            match self.stream.next().await {
                Ok(frame) => {
                    self.tries = 0;
                    return Ok(frame.map(|(part, surface)| SurfaceFrame {
                        step: part.step,
                        time_s: part.simulation_time_s,
                        frame_id: part.frame_id,
                        skipped: part.skipped_frames,
                        vertices: surface.vertices,
                        displacement_m: surface.displacement_m.clone(),
                    }));
                }
                Err(status) => {
                    self.follow(status).await?;
                    self.stream = frames(&self.session, &self.request).await?;
                }
            }
        }
    }
}

/// Returns the exception that ends an iteration.
fn at_end(awaited: bool) -> PyErr {
    if awaited { PyStopAsyncIteration::new_err(()) } else { PyStopIteration::new_err(()) }
}

/// The samples of a session, one after another: what tools feel. Each is a dictionary:
///
/// - `step`: steps done; `time_s`: simulated time.
/// - `awake_points`: points that the step computed; `asleep`: nothing moves; `held`: the guard has stopped the
///   session.
/// - `overruns`: steps that were due and dropped; `time_dilation`: simulated over real time; `late_commands`:
///   commands that arrived too late for their step; `dropped_samples`: samples that were dropped because this reader
///   was too slow. Counts are since the session started.
/// - `tools`: each active tool, by its number, as a dictionary. `displacement_m`: displacement of the tissue under
///   the tool from its place at rest, under a tip the mean over its disc; `surface_displacement_m`: displacement of
///   the surface just under the tool's centre; `velocity_m_per_s`; `force_on_tool_n`: the force of the tissue on the
///   tool; `applied_force_n`: the force of all tools on the tissue there; all in the tissue's frame. `late`: its
///   newest command arrived too late; `expired`: its action has ended by itself; `stale`: no pose arrived for 50 ms.
#[pyclass(frozen, module = "palpate")]
pub(crate) struct Samples {
    pub(crate) stream: Arc<Mutex<Following<watch::Samples, pb::WatchSamplesRequest>>>,
    pub(crate) awaited: bool,
}

/// Samples as columns, with one row per tool of each sample.
#[derive(Default)]
struct Sampled {
    step: Vec<u64>,
    time_s: Vec<f64>,
    tool: Vec<u32>,
    numbers: Vec<f64>,
    awake_points: Vec<u32>,
    asleep: Vec<bool>,
}

impl Sampled {
    fn add(&mut self, sample: &pb::Sample) {
        for tool in &sample.tools {
            self.step.push(sample.step);
            self.time_s.push(sample.simulation_time_s);
            self.tool.push(tool.tool);
            self.awake_points.push(sample.awake_points);
            self.asleep.push(sample.asleep);
            for vector in [
                &tool.displacement_m,
                &tool.surface_displacement_m,
                &tool.velocity_m_per_s,
                &tool.force_on_tool_n,
                &tool.applied_force_n,
            ] {
                self.numbers.extend(from_vector(vector.as_ref()).to_array());
            }
        }
    }
}

impl<'py> IntoPyObject<'py> for Sampled {
    type Target = PyAny;
    type Output = Bound<'py, PyAny>;
    type Error = PyErr;

    fn into_pyobject(self, py: Python<'py>) -> PyResult<Self::Output> {
        let (given, rows) = (PyDict::new(py), self.step.len());
        given.set_item("step", column(py, self.step)?)?;
        given.set_item("time_s", column(py, self.time_s)?)?;
        given.set_item("tool", column(py, self.tool)?)?;
        given.set_item("awake_points", column(py, self.awake_points)?)?;
        given.set_item("asleep", column(py, self.asleep)?)?;
        given.set_item("felt", records(py, self.numbers, "FELT", &[rows])?)?;
        py.import("palpate._touch")?.getattr("Sampled")?.call((), Some(&given))
    }
}

/// A sample, with or without tools.
#[derive(IntoPyObject)]
struct StreamSample {
    step: u64,
    time_s: f64,
    awake_points: u32,
    asleep: bool,
    held: bool,
    overruns: u64,
    time_dilation: f64,
    late_commands: u64,
    dropped_samples: u64,
    tools: std::collections::BTreeMap<u32, ToolSample>,
}

/// A tool in a sample.
#[derive(IntoPyObject)]
struct ToolSample {
    displacement_m: (f64, f64, f64),
    surface_displacement_m: (f64, f64, f64),
    velocity_m_per_s: (f64, f64, f64),
    force_on_tool_n: (f64, f64, f64),
    applied_force_n: (f64, f64, f64),
    late: bool,
    expired: bool,
    stale: bool,
}

impl StreamSample {
    fn of(sample: &pb::Sample) -> Self {
        let numbers = |v: Option<&pb::Vector3>| from_vector(v).into();
        let tools = sample.tools.iter().map(|tool| {
            let sampled = ToolSample {
                displacement_m: numbers(tool.displacement_m.as_ref()),
                surface_displacement_m: numbers(tool.surface_displacement_m.as_ref()),
                velocity_m_per_s: numbers(tool.velocity_m_per_s.as_ref()),
                force_on_tool_n: numbers(tool.force_on_tool_n.as_ref()),
                applied_force_n: numbers(tool.applied_force_n.as_ref()),
                late: tool.late,
                expired: tool.expired,
                stale: tool.stale,
            };
            (tool.tool, sampled)
        });
        StreamSample {
            step: sample.step,
            time_s: sample.simulation_time_s,
            awake_points: sample.awake_points,
            asleep: sample.asleep,
            held: sample.held,
            overruns: sample.overrun_count,
            time_dilation: sample.time_dilation,
            late_commands: sample.late_commands,
            dropped_samples: sample.dropped_samples,
            tools: tools.collect(),
        }
    }
}

#[pymethods]
impl Samples {
    /// Returns the next `count` samples as arrays; fewer at the end of the stream.
    fn take<'py>(&self, py: Python<'py>, count: usize) -> PyResult<Bound<'py, PyAny>> {
        let stream = self.stream.clone();
        answer(py, self.awaited, async move {
            let (mut stream, mut sampled) = (stream.lock().await, Sampled::default());
            for _ in 0..count {
                match stream.next().await? {
                    Some(sample) => sampled.add(&sample),
                    None => break,
                }
            }
            Ok(sampled)
        })
    }

    fn __iter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    fn __next__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (stream, awaited) = (self.stream.clone(), self.awaited);
        answer(py, awaited, async move {
            let sample = stream.lock().await.next().await?;
            sample.map(|sample| StreamSample::of(&sample)).ok_or_else(|| at_end(awaited))
        })
    }

    fn __aiter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    fn __anext__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.__next__(py)
    }
}

/// The frames of a session, one after another: the moving surface.
#[pyclass(frozen, name = "Frames", module = "palpate")]
pub(crate) struct FrameStream {
    pub(crate) stream: Arc<Mutex<Following<view::Frames, pb::WatchFramesRequest>>>,
    pub(crate) awaited: bool,
}

/// A frame: the whole surface at one moment.
struct SurfaceFrame {
    step: u64,
    time_s: f64,
    frame_id: u64,
    skipped: u64,
    vertices: [usize; 2],
    displacement_m: Vec<[f32; 3]>,
}

impl<'py> IntoPyObject<'py> for SurfaceFrame {
    type Target = PyAny;
    type Output = Bound<'py, PyAny>;
    type Error = PyErr;

    fn into_pyobject(self, py: Python<'py>) -> PyResult<Self::Output> {
        let given = PyDict::new(py);
        given.set_item("step", self.step)?;
        given.set_item("time_s", self.time_s)?;
        given.set_item("frame_id", self.frame_id)?;
        given.set_item("skipped", self.skipped)?;
        let numbers = self.displacement_m.into_flattened();
        given.set_item("displacement_m", shaped(py, numbers, &[self.vertices[1].max(1), 3])?)?;
        py.import("palpate._touch")?.getattr("Frame")?.call((), Some(&given))
    }
}

#[pymethods]
impl FrameStream {
    fn __iter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    fn __next__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (stream, awaited) = (self.stream.clone(), self.awaited);
        answer(py, awaited, async move {
            let mut stream = stream.lock().await;
            stream.next().await?.ok_or_else(|| at_end(awaited))
        })
    }

    fn __aiter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    fn __anext__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.__next__(py)
    }
}
