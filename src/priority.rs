//! The priority of threads: heavy work gives way to stepping and to the network.

/// About a tenth of what the others get where there is not enough for all: no thread is ever shut out.
#[cfg(target_os = "linux")]
const NICENESS: i32 = 10;

/// Makes the calling thread give way to those of the process that step, and to the network's.
pub(crate) fn give_way() {
    // Of this thread alone, on Linux; elsewhere it would be the whole process. Best effort.
    #[cfg(target_os = "linux")]
    let _ = rustix::process::setpriority_process(None, NICENESS);
}
