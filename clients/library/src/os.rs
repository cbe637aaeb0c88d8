//! What depends on the operating system: so far the priority of a thread.

use thread_priority::ThreadPriorityValue;

/// The priority of a thread, as far as this library has changed it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Priority {
    /// The usual priority: nothing was requested.
    Usual,
    /// Real-time priority, above all usual threads.
    RealTime,
    /// Real-time priority was requested and refused, so the thread has its usual one. Contains why, and on Unix what
    /// would help.
    Refused(String),
}

/// Real-time priority, in the library's scale of 0 to 99: below the threads of the system itself.
const REAL_TIME: u8 = 50;

/// Requests real-time priority for the current thread: the FIFO policy at priority 50. Returns its resulting priority,
/// never [`Priority::Usual`]. It lasts until the thread ends.
#[cfg(unix)]
pub fn take_real_time_priority() -> Priority {
    use thread_priority::{
        RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy, set_thread_priority_and_policy,
        thread_native_id,
    };
    let priority = ThreadPriorityValue::try_from(REAL_TIME).map(ThreadPriority::Crossplatform);
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    match priority.map(|priority| set_thread_priority_and_policy(thread_native_id(), priority, policy)) {
        Ok(Ok(())) => Priority::RealTime,
        _ => Priority::Refused(
            "the system does not allow it; `ulimit -r` must be at least 50 (rtprio in /etc/security/limits.conf)"
                .to_owned(),
        ),
    }
}

/// Requests real-time priority for the current thread: "time critical". Returns its resulting priority, never
/// [`Priority::Usual`]. It lasts until the thread ends.
#[cfg(windows)]
pub fn take_real_time_priority() -> Priority {
    use thread_priority::{ThreadPriority, set_current_thread_priority};
    // 99 is time critical on Windows.
    let priority = ThreadPriorityValue::try_from(REAL_TIME.max(99)).map(ThreadPriority::Crossplatform);
    match priority.map(set_current_thread_priority) {
        Ok(Ok(())) => Priority::RealTime,
        _ => Priority::Refused("the system does not allow it".to_owned()),
    }
}

/// Returns [`Priority::Refused`]: real-time priority is not supported on this system.
#[cfg(not(any(unix, windows)))]
pub fn take_real_time_priority() -> Priority {
    Priority::Refused("this system is not known".to_owned())
}
