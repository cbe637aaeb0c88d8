//! Long work: runs without the interpreter's lock, and Ctrl-C ends it.

use std::future::Future;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

use pyo3::BoundObject;
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3_async_runtimes::generic::future_into_py;
use tokio::runtime::Runtime;
use tokio::sync::oneshot;

use crate::ending::NetworkRuntime;

/// Interval between checks for signals.
pub(crate) const LOOK: Duration = Duration::from_millis(50);

/// Stack size of a computing thread, bytes: that of a main thread.
pub(crate) const STACK_BYTES: usize = 8 << 20;

/// Runs `work` on a thread of its own and checks for signals in the meantime. If the handler of a signal raises, as
/// for Ctrl-C, sets the stop flag of `work`, and raises the exception when that has ended.
pub(crate) fn work<T: Send>(py: Python<'_>, work: impl FnOnce(&AtomicBool) -> T + Send) -> PyResult<T> {
    let stop = AtomicBool::new(false);
    py.detach(|| {
        std::thread::scope(|scope| {
            let (tell, told) = channel();
            let worker = std::thread::Builder::new().name("palpate".to_owned()).stack_size(STACK_BYTES);
            let stop = &stop;
            let worker = worker.spawn_scoped(scope, move || {
                let done = work(stop);
                let _ = tell.send(());
                done
            })?;
            let mut raised = None;
            while told.recv_timeout(LOOK) == Err(RecvTimeoutError::Timeout) {
                if raised.is_none() {
                    raised = Python::attach(|py| py.check_signals()).err();
                    stop.store(raised.is_some(), Ordering::Relaxed);
                }
            }
            let done = worker.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
            raised.map_or(Ok(done), Err)
        })
    })
}

/// Returns the runtime of all connections.
///
/// # Errors
/// Raises RuntimeError if its threads can't be started, and in a process that was forked after they were: it does not
/// have them, and would wait without end.
pub(crate) fn runtime() -> PyResult<&'static Runtime> {
    static RUNTIME: OnceLock<(u32, Option<Runtime>)> = OnceLock::new();
    let (process, made) = RUNTIME.get_or_init(|| {
        let mut threads = tokio::runtime::Builder::new_multi_thread();
        let made = threads.worker_threads(2).thread_name("palpate-net").enable_all().build().ok();
        (std::process::id(), made)
    });
    if *process != std::process::id() {
        let message = "this process was forked from one that had used palpate for connections, and has none of its threads: \
                       start it by multiprocessing.get_context(\"spawn\"), or connect in the parent only after the fork";
        return Err(PyRuntimeError::new_err(message));
    }
    made.as_ref().ok_or_else(|| PyRuntimeError::new_err("no threads for the network"))
}

/// Returns the result of a future, or an awaitable for asyncio. The future is dropped when a signal ends the wait, or
/// when the awaiting task is cancelled.
pub(crate) fn answer<'py, T>(
    py: Python<'py>,
    awaited: bool,
    future: impl Future<Output = PyResult<T>> + Send + 'static,
) -> PyResult<Bound<'py, PyAny>>
where
    T: for<'a> IntoPyObject<'a> + Send + 'static,
{
    answer_in_order(py, awaited, None, future)
}

/// Like [`answer`], for a future that ends by itself when `end` is dropped: a signal drops that, and the result of
/// the future is lost.
pub(crate) fn answer_in_order<'py, T>(
    py: Python<'py>,
    awaited: bool,
    mut end: Option<oneshot::Sender<()>>,
    future: impl Future<Output = PyResult<T>> + Send + 'static,
) -> PyResult<Bound<'py, PyAny>>
where
    T: for<'a> IntoPyObject<'a> + Send + 'static,
{
    let runtime = runtime()?;
    if awaited {
        return future_into_py::<NetworkRuntime, _, _>(py, async move {
            let _end = end;
            future.await
        });
    }
    let found = py.detach(|| {
        runtime.block_on(async {
            let mut future = std::pin::pin!(future);
            let mut raised = None;
            loop {
                match tokio::time::timeout(LOOK, &mut future).await {
                    Ok(found) => return raised.map_or(found, Err),
                    // The future was asked to end already.
                    Err(_) if raised.is_some() => {}
                    Err(_) => {
                        let looked = Python::attach(|py| py.check_signals());
                        match end.take_if(|_| looked.is_err()) {
                            Some(_) => raised = looked.err(),
                            None => looked?,
                        }
                    }
                }
            }
        })
    })?;
    found.into_pyobject(py).map(|found| found.into_any().into_bound()).map_err(Into::into)
}
