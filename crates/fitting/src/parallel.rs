//! Spreads jobs over threads, and returns their results in the order of the jobs.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::channel;

/// Stack of a thread, bytes: that of a main thread.
const STACK_BYTES: usize = 8 << 20;

/// Does the jobs 0 to `count` − 1 on at most `threads` threads, and calls `done` in this thread after each. Returns the results by
/// number; `None` for a job that no thread could be started for.
pub(crate) fn in_parallel<T: Send>(
    threads: usize,
    count: usize,
    job: impl Fn(usize) -> T + Sync,
    mut done: impl FnMut(),
) -> Vec<Option<T>> {
    let mut results: Vec<Option<T>> = (0..count).map(|_| None).collect();
    if threads <= 1 || count <= 1 {
        for (number, result) in results.iter_mut().enumerate() {
            *result = Some(job(number));
            done();
        }
        return results;
    }
    let next = AtomicUsize::new(0);
    std::thread::scope(|scope| {
        let (tell, told) = channel();
        let workers: Vec<_> = (0..threads.min(count))
            .filter_map(|worker| {
                let (tell, next, job) = (tell.clone(), &next, &job);
                let thread = std::thread::Builder::new().name(format!("fit-{worker}")).stack_size(STACK_BYTES);
                let work = move || {
                    loop {
                        let number = next.fetch_add(1, Ordering::Relaxed);
                        if number >= count || tell.send((number, job(number))).is_err() {
                            break;
                        }
                    }
                };
                thread.spawn_scoped(scope, work).ok()
            })
            .collect();
        drop(tell);
        for (number, result) in told {
            results[number] = Some(result);
            done();
        }
        for worker in workers {
            // A refusal for lack of memory unwinds, to whoever catches it.
            worker.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        }
    });
    results
}
