//! The interpreter from threads that it does not know, and its end.
//!
//! A thread that waits for the interpreter's lock when the interpreter goes down is ended by it, in the middle of Rust: the process dies.
//! So who calls Python from such a thread goes through [`attached`], and when the interpreter is about to go down it waits until nobody
//! is inside, and lets nobody in any more.

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

/// The end of a program waits so long for what is inside: a device of Python that never returns must not keep it for ever.
const EXIT_TIMEOUT: Duration = Duration::from_secs(5);

#[derive(Default)]
struct Gate {
    /// Threads inside.
    inside: usize,
    /// The interpreter goes down.
    is_closed: bool,
}

static GATE: Mutex<Gate> = Mutex::new(Gate { inside: 0, is_closed: false });
static LEFT: Condvar = Condvar::new();

thread_local! {
    /// How often this thread has come in: what it calls in Python may come back.
    static DEPTH: Cell<usize> = const { Cell::new(0) };
}

fn gate() -> MutexGuard<'static, Gate> {
    GATE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A thread inside.
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

/// Does `work` with the interpreter. `None`: that goes down.
pub(crate) fn attached<T>(work: impl FnOnce(Python<'_>) -> T) -> Option<T> {
    let _inside = Inside::come()?;
    Python::try_attach(work)
}

/// What is raised in place of what there is no interpreter for any more.
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

/// Has the gate closed before the interpreter goes down.
pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.py().import("atexit")?.call_method1("register", (wrap_pyfunction!(close, module)?,))?;
    Ok(())
}

/// The runtime of futures that Python awaits. Their results go to Python from threads that may block.
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

// Without a runtime nothing is awaited.
#[allow(clippy::expect_used)]
fn running() -> &'static tokio::runtime::Runtime {
    runtime().expect("it has been asked for before anything was spawned")
}
