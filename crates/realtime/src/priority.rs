//! Priorities of threads. Heavy work and the processing of unauthenticated UDP packets yield to stepping and to the
//! network, which ask for short time slices. Every thread has a stack that is large enough for the stepping code.

use std::thread::Builder;
use std::time::Duration;

/// Stack size of a thread that steps a tissue, bytes. The stepping code is inlined into one function for each
/// scheme and width. Without optimization each of its thousands of intermediate vectors has its own place on the
/// stack: 2 MB in all.
const STACK_BYTES: usize = if cfg!(debug_assertions) { 32 << 20 } else { 2 << 20 };

/// Time slice of a network thread for [`take_short_turns`]: a message takes some tens of microseconds.
pub const NETWORK_TURN: Duration = Duration::from_micros(100);
/// Time slice of a stepping thread for [`take_short_turns`]: some steps of sessions at 1 kHz.
pub const STEPPING_TURN: Duration = Duration::from_millis(1);

/// Returns a builder of a thread of that name, with a stack that is large enough to step a tissue (2 MiB; 32 MiB
/// without optimization). Nothing is started.
pub fn thread(name: impl Into<String>) -> Builder {
    Builder::new().name(name.into()).stack_size(STACK_BYTES)
}

/// Lowers the priority of the calling thread (niceness 10). If the processors are busy, it gets about a tenth of
/// the time of a stepping or network thread, and never none. Nothing changes except on Linux and Windows.
pub fn give_way() {
    be_nice(10);
}

/// Lowers the priority of the calling thread a little (niceness 5): it gets about a third of the time of a stepping
/// thread if the processors are busy. Nothing changes except on Linux and Windows.
pub fn give_way_a_little() {
    be_nice(5);
}

/// Asks the system to run the calling thread for no longer than `turn` (0.1 to 100 ms) at a time. On a busy core
/// the thread then waits less after it wakes, and its share of the core stays the same. (EEVDF: the virtual
/// deadline of a thread is its time slice after it became eligible, and the earliest deadline runs.) It needs Linux
/// 6.12 or later; elsewhere nothing changes.
#[allow(unsafe_code)]
pub fn take_short_turns(turn: Duration) {
    #[cfg(target_os = "linux")]
    {
        let nanoseconds = u64::try_from(turn.as_nanos()).unwrap_or(u64::MAX);
        let attributes = libc::sched_attr {
            size: std::mem::size_of::<libc::sched_attr>() as u32,
            sched_policy: libc::SCHED_OTHER as u32,
            sched_flags: 0,
            // The call sets all attributes, so the niceness must be repeated.
            sched_nice: rustix::process::getpriority_process(None).unwrap_or_default(),
            sched_priority: 0,
            sched_runtime: nanoseconds,
            sched_deadline: 0,
            sched_period: 0,
        };
        // SAFETY: `attributes` lives through the call, which reads `size` bytes of it and keeps no pointer
        // (sched_setattr(2)). A failure is ignored: older kernels ignore the time slice, and a sandbox may refuse
        // the call.
        unsafe { libc::syscall(libc::SYS_sched_setattr, 0, &raw const attributes, 0) };
    }
    #[cfg(not(target_os = "linux"))]
    let _ = turn;
}

/// Sets the niceness of the calling thread, on Linux; on Windows its priority: below normal, or the lowest from 10 on.
/// Elsewhere it would be that of the whole process, and nothing changes. A failure is ignored.
fn be_nice(niceness: i32) {
    #[cfg(target_os = "linux")]
    let _ = rustix::process::setpriority_process(None, niceness);
    #[cfg(windows)]
    {
        use thread_priority::{ThreadPriority, WinAPIThreadPriority, set_current_thread_priority};
        let lower = if niceness < 10 { WinAPIThreadPriority::BelowNormal } else { WinAPIThreadPriority::Lowest };
        let _ = set_current_thread_priority(ThreadPriority::Os(lower.into()));
    }
    #[cfg(not(any(target_os = "linux", windows)))]
    let _ = niceness;
}
