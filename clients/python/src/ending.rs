//! Access to the interpreter from threads that it does not know, and its shutdown.
//!
//! A thread that waits for the interpreter's lock while the interpreter shuts down is ended by it, in the middle of
//! Rust: the process dies. So code that calls Python from such a thread goes through [`attached`]. Before the
//! interpreter shuts down, it waits until no thread is inside, and admits no more.

use std::cell::Cell;
use std::future::Future;
use std::pin::Pin;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3_async_runtimes::TaskLocals;
use pyo3_async_runtimes::generic::{ContextExt, Runtime};

use crate::waiting::runtime;

/// Longest time for which the end of a program waits for threads inside: a Python device that never returns must not
/// keep it running.
const EXIT_TIMEOUT: Duration = Duration::from_secs(5);

#[derive(Default)]
struct Gate {
    /// Number of threads inside.
    inside: usize,
    /// Whether the interpreter is shutting down.
    is_closed: bool,
}

static GATE: Mutex<Gate> = Mutex::new(Gate { inside: 0, is_closed: false });
static LEFT: Condvar = Condvar::new();

thread_local! {
    /// How many calls of this thread are inside: what it calls in Python may call back.
    static DEPTH: Cell<usize> = const { Cell::new(0) };
}

fn gate() -> MutexGuard<'static, Gate> {
    GATE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Marks this thread as inside, until it is dropped.
struct Inside;

impl Inside {
    fn come() -> Option<Self> {
        if DEPTH.get() == 0 {
            let mut gate = gate();
            if gate.is_closed {
                return None;
            }
            gate.inside += 1;
        }
        DEPTH.set(DEPTH.get() + 1);
        Some(Inside)
    }
}

impl Drop for Inside {
    fn drop(&mut self) {
        DEPTH.set(DEPTH.get() - 1);
        if DEPTH.get() == 0 {
            gate().inside -= 1;
            LEFT.notify_all();
        }
    }
}

/// Runs `work` with the interpreter. `None` if that is shutting down.
pub(crate) fn attached<T>(work: impl FnOnce(Python<'_>) -> T) -> Option<T> {
    let _inside = Inside::come()?;
    Python::try_attach(work)
}

/// Returns the exception for calls that no longer have an interpreter.
pub(crate) fn ended() -> PyErr {
    PyRuntimeError::new_err("Python is ending")
}

/// Waits until no thread is inside, and closes the gate.
#[pyfunction]
fn close(py: Python<'_>) {
    py.detach(|| {
        let mut gate = gate();
        gate.is_closed = true;
        drop(LEFT.wait_timeout_while(gate, EXIT_TIMEOUT, |gate| gate.inside > 0));
    });
}

/// Registers the closing of the gate for the shutdown of the interpreter.
pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.py().import("atexit")?.call_method1("register", (wrap_pyfunction!(close, module)?,))?;
    Ok(())
}

/// The runtime of futures that Python awaits. It passes their results to Python from threads that may block.
pub(crate) struct NetworkRuntime;

impl Runtime for NetworkRuntime {
    type JoinError = tokio::task::JoinError;
    type JoinHandle = tokio::task::JoinHandle<()>;

    fn spawn<F: Future<Output = ()> + Send + 'static>(future: F) -> Self::JoinHandle {
        running().spawn(future)
    }

    fn spawn_blocking<F: FnOnce() + Send + 'static>(work: F) -> Self::JoinHandle {
        running().spawn_blocking(move || {
            if let Some(_inside) = Inside::come() {
                work();
            }
        })
    }
}

impl ContextExt for NetworkRuntime {
    // No future of this package calls coroutines of Python, which would need to know their loop.
    fn scope<F, R>(_locals: TaskLocals, future: F) -> Pin<Box<dyn Future<Output = R> + Send>>
    where
        F: Future<Output = R> + Send + 'static,
    {
        Box::pin(future)
    }

    fn get_task_locals() -> Option<TaskLocals> {
        None
    }
}

// Nothing is awaited before the runtime exists.
#[allow(clippy::expect_used)]
fn running() -> &'static tokio::runtime::Runtime {
    runtime().expect("it has been asked for before anything was spawned")
}
