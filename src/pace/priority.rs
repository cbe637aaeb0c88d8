//! Who gives way to whom where there are more threads than cores.

/// About a tenth of what the others get where there is not enough for all: so nobody is ever shut out.
#[cfg(target_os = "linux")]
const NICENESS: i32 = 10;

/// Makes the calling thread give way to those of the process that step, and to the network's.
pub(crate) fn give_way() {
    // Of this thread alone, on Linux; elsewhere it would be the whole process. Where it can't be set, so be it.
    #[cfg(target_os = "linux")]
    let _ = rustix::process::setpriority_process(None, NICENESS);
}
