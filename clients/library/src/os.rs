//! What differs between operating systems: so far the priority of a thread.

use thread_priority::ThreadPriorityValue;

/// With which priority a thread runs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Priority {
    /// Like all others.
    Usual,
    /// Before all that are not of real time.
    RealTime,
    /// Real-time priority was asked for, and the system did not give it: why, and what would help.
    Refused(String),
}

/// Above what is of no hurry, below the threads of the system itself.
const REAL_TIME: u8 = 50;

/// Asks for real-time priority for this thread.
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

/// Asks for real-time priority for this thread.
#[cfg(windows)]
pub fn take_real_time_priority() -> Priority {
    use thread_priority::{ThreadPriority, set_current_thread_priority};
    // 99 is time critical there.
    let priority = ThreadPriorityValue::try_from(REAL_TIME.max(99)).map(ThreadPriority::Crossplatform);
    match priority.map(set_current_thread_priority) {
        Ok(Ok(())) => Priority::RealTime,
        _ => Priority::Refused("the system does not allow it".to_owned()),
    }
}

/// Asks for real-time priority for this thread.
#[cfg(not(any(unix, windows)))]
pub fn take_real_time_priority() -> Priority {
    Priority::Refused("this system is not known".to_owned())
}
