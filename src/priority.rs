//! Threads: heavy work, and what strangers send by UDP, give way to stepping and to the network; all have a stack that the kernel fits on.

use std::thread::Builder;

/// The stack of a thread that steps a tissue, bytes. The kernel is inlined into one function for each scheme and width. Without
/// optimization each of its thousands of intermediate vectors has a place of its own there: 2 MB in all.
const STACK_BYTES: usize = if cfg!(debug_assertions) { 32 << 20 } else { 2 << 20 };

/// A thread of that name, to be spawned.
pub(crate) fn thread(name: impl Into<String>) -> Builder {
    Builder::new().name(name.into()).stack_size(STACK_BYTES)
}

/// Makes the calling thread give way to those of the process that step, and to the network's: where there is not enough for all
/// it gets about a tenth of what they get. No thread is ever shut out.
pub(crate) fn give_way() {
    be_nice(10);
}

/// Makes the calling thread give way, but less: it gets about a third.
pub(crate) fn give_way_a_little() {
    be_nice(5);
}

/// Of this thread alone, on Linux; elsewhere it would be the whole process. Best effort.
fn be_nice(niceness: i32) {
    #[cfg(target_os = "linux")]
    let _ = rustix::process::setpriority_process(None, niceness);
    #[cfg(not(target_os = "linux"))]
    let _ = niceness;
}
