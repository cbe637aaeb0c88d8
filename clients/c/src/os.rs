//! What depends on the operating system. On Unix a write to a connection that the other end has closed sends SIGPIPE,
//! which ends a program that does not expect it. Rust programs ignore it from their start; C programs do not, and how
//! they handle it is up to them. So the library blocks it in its own threads, and in the caller's thread while that
//! waits for the network. In addition, a forked process has none of its parent's threads.

use std::future::Future;

use tokio::runtime::{Builder, Runtime};
use tokio::task::JoinHandle;

use crate::error::{CodedError, PALPATE_INTERNAL};

/// The library's threads for the network, in which SIGPIPE is blocked. A forked child does not have these threads:
/// there every use is refused, since it would never complete.
pub(crate) struct Threads {
    /// Always present, until it is dropped.
    runtime: Option<Runtime>,
    /// The process that has the threads.
    process: u32,
}

impl Threads {
    pub(crate) fn start() -> Result<Self, CodedError> {
        let runtime = Builder::new_multi_thread()
            .worker_threads(2)
            .thread_name("palpate")
            .on_thread_start(|| _ = sigpipe::block())
            .enable_all()
            .build()
            .map_err(|error| CodedError::new(PALPATE_INTERNAL, format!("threads can't be started: {error}")))?;
        Ok(Threads { runtime: Some(runtime), process: std::process::id() })
    }

    /// Returns the threads, if this process has them.
    pub(crate) fn here(&self) -> Result<&Runtime, CodedError> {
        let words = "the handle is of the process that this one was forked from: connect here for a handle of its own";
        let is_here = self.process == std::process::id();
        self.runtime.as_ref().filter(|_| is_here).ok_or_else(|| CodedError::argument(words))
    }

    /// Waits for `future` in this thread, in which SIGPIPE is blocked meanwhile.
    pub(crate) fn block_on<F: Future>(&self, future: F) -> Result<F::Output, CodedError> {
        let runtime = self.here()?;
        let _blocked = sigpipe::Blocked::new();
        Ok(runtime.block_on(future))
    }

    /// Runs `future` on these threads.
    pub(crate) fn spawn<F>(&self, future: F) -> Result<JoinHandle<F::Output>, CodedError>
    where
        F: Future<Output: Send> + Send + 'static,
    {
        Ok(self.here()?.spawn(future))
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        if self.here().is_err() {
            // Dropping a runtime waits for its threads, which a child does not have.
            std::mem::forget(self.runtime.take());
        }
    }
}

#[cfg(unix)]
mod sigpipe {
    use std::mem::MaybeUninit;

    use libc::{SIG_BLOCK, SIG_SETMASK, SIGPIPE, sigset_t};

    fn only() -> sigset_t {
        let mut set = MaybeUninit::uninit();
        // SAFETY: `sigemptyset` initializes the set.
        unsafe {
            libc::sigemptyset(set.as_mut_ptr());
            let mut set = set.assume_init();
            libc::sigaddset(&raw mut set, SIGPIPE);
            set
        }
    }

    fn is_in(set: &sigset_t) -> bool {
        // SAFETY: the set is initialized.
        unsafe { libc::sigismember(set, SIGPIPE) == 1 }
    }

    fn is_pending() -> bool {
        let mut set = MaybeUninit::uninit();
        // SAFETY: `sigpending` initializes the set if it returns 0.
        unsafe { libc::sigpending(set.as_mut_ptr()) == 0 && is_in(&set.assume_init()) }
    }

    /// Blocks SIGPIPE in this thread; returns the signals that were blocked before.
    pub(super) fn block() -> Option<sigset_t> {
        let mut before = MaybeUninit::uninit();
        // SAFETY: both sets are valid; the second is initialized if it returns 0.
        unsafe { (libc::pthread_sigmask(SIG_BLOCK, &only(), before.as_mut_ptr()) == 0).then(|| before.assume_init()) }
    }

    /// Blocks SIGPIPE in this thread until it is dropped.
    pub(super) struct Blocked {
        before: Option<sigset_t>,
        was_pending: bool,
    }

    impl Blocked {
        pub(super) fn new() -> Self {
            let was_pending = is_pending();
            Blocked { before: block(), was_pending }
        }
    }

    impl Drop for Blocked {
        fn drop(&mut self) {
            let Some(before) = self.before.filter(|before| !is_in(before)) else { return };
            // A signal that arrived in the meantime was caused by this library.
            if !self.was_pending && is_pending() {
                let mut signal = 0;
                // SAFETY: both are valid; it is pending, so this does not wait.
                unsafe { libc::sigwait(&only(), &raw mut signal) };
            }
            // SAFETY: the set is what the system gave.
            unsafe { libc::pthread_sigmask(SIG_SETMASK, &raw const before, std::ptr::null_mut()) };
        }
    }

    #[cfg(test)]
    mod tests {
        use super::*;

        #[test]
        fn a_signal_of_the_library_does_not_reach_its_caller() {
            let blocked = || is_in(&block().unwrap());
            std::thread::spawn(move || {
                // SAFETY: the default would end the process.
                unsafe { libc::signal(SIGPIPE, libc::SIG_DFL) };
                let raise = || {
                    // SAFETY: to this thread, where it is blocked.
                    unsafe { libc::pthread_kill(libc::pthread_self(), SIGPIPE) };
                };
                {
                    let _blocked = Blocked::new();
                    raise();
                    assert!(is_pending());
                }
                // This process continues, and no signal is left.
                assert!(!is_pending());
                assert!(!blocked());
                // If the caller has blocked it, it stays blocked and pending.
                raise();
                drop(Blocked::new());
                assert!(is_pending() && blocked());
                let mut signal = 0;
                // SAFETY: it is pending.
                unsafe { libc::sigwait(&only(), &raw mut signal) };
            })
            .join()
            .unwrap();
        }
    }
}

#[cfg(not(unix))]
mod sigpipe {
    pub(super) fn block() {}

    /// This system has no such signal.
    pub(super) struct Blocked;

    impl Blocked {
        pub(super) fn new() -> Self {
            Blocked
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn in_a_child_that_was_forked_the_parents_threads_are_not_waited_for() {
        let threads = Threads::start().map_err(|_| "threads").unwrap();
        assert_eq!(threads.block_on(async { 7 }).map_err(|_| "here"), Ok(7));
        // A child sees its parent's handles like this.
        let mut of_parent = Threads::start().map_err(|_| "threads").unwrap();
        of_parent.process ^= 1;
        let refused = of_parent.block_on(std::future::pending::<()>()).err().unwrap();
        assert_eq!(refused.code(), crate::error::PALPATE_ARGUMENT);
        assert!(of_parent.spawn(async {}).is_err());
        drop(of_parent);
    }
}
