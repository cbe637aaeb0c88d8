//! Threads: heavy work, and what strangers send by UDP, give way to stepping and to the network, which ask for short turns; all have
//! a stack that the kernel fits on.

use std::thread::Builder;
use std::time::Duration;

/// The stack of a thread that steps a tissue, bytes. The kernel is inlined into one function for each scheme and width. Without
/// optimization each of its thousands of intermediate vectors has a place of its own there: 2 MB in all.
const STACK_BYTES: usize = if cfg!(debug_assertions) { 32 << 20 } else { 2 << 20 };

/// The turn of a network thread: a message takes some tens of microseconds.
pub const NETWORK_TURN: Duration = Duration::from_micros(100);
/// The turn of a stepping thread: some steps of sessions at 1 kHz.
pub const STEPPING_TURN: Duration = Duration::from_millis(1);

/// Returns a thread of that name, to be spawned.
pub fn thread(name: impl Into<String>) -> Builder {
    Builder::new().name(name.into()).stack_size(STACK_BYTES)
}

/// Makes the calling thread give way to those of the process that step, and to the network's: where there is not enough for all
/// it gets about a tenth of what they get. No thread is ever shut out.
pub fn give_way() {
    be_nice(10);
}

/// Makes the calling thread give way, but less: it gets about a third.
pub fn give_way_a_little() {
    be_nice(5);
}

/// Asks the system to run the calling thread for no longer than `turn` (0.1 to 100 ms) at a time. On a busy core it then waits less
/// after it wakes, and its share of the core stays the same. (EEVDF: the virtual deadline of a thread is its turn after it became
/// eligible, and the earliest deadline runs.) Linux 6.12 and later; elsewhere nothing changes.
#[allow(unsafe_code)]
pub fn take_short_turns(turn: Duration) {
    #[cfg(target_os = "linux")]
    {
        let nanoseconds = u64::try_from(turn.as_nanos()).unwrap_or(u64::MAX);
        let attributes = libc::sched_attr {
            size: std::mem::size_of::<libc::sched_attr>() as u32,
            sched_policy: libc::SCHED_OTHER as u32,
            sched_flags: 0,
            // The call sets all of them, so the niceness must be repeated.
            sched_nice: rustix::process::getpriority_process(None).unwrap_or_default(),
            sched_priority: 0,
            sched_runtime: nanoseconds,
            sched_deadline: 0,
            sched_period: 0,
        };
        // SAFETY: `attributes` lives through the call, which reads `size` bytes of it and keeps no pointer (sched_setattr(2)).
        // Best effort: older kernels ignore the turn, and a sandbox may refuse the call.
        unsafe { libc::syscall(libc::SYS_sched_setattr, 0, &raw const attributes, 0) };
    }
    #[cfg(not(target_os = "linux"))]
    let _ = turn;
}

/// Of this thread alone, on Linux; elsewhere it would be the whole process. Best effort.
fn be_nice(niceness: i32) {
    #[cfg(target_os = "linux")]
    let _ = rustix::process::setpriority_process(None, niceness);
    #[cfg(not(target_os = "linux"))]
    let _ = niceness;
}
