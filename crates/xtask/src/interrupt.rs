//! Ctrl-C while the server of `cargo xtask run` runs: the server ends first, then this program.
//!
//! The standard library can't catch it, and a crate that can would be compiled before the first run begins. So this file declares
//! the three functions of the system.
#![allow(unsafe_code)]

use std::process::{Child, Command};

#[cfg(unix)]
mod of_the_system {
    use std::ffi::c_int;
    use std::os::unix::process::CommandExt;
    use std::process::Command;
    use std::sync::atomic::{AtomicI32, Ordering};

    const SIGHUP: c_int = 1;
    const SIGINT: c_int = 2;
    const SIGTERM: c_int = 15;

    unsafe extern "C" {
        fn signal(number: c_int, handler: extern "C" fn(c_int)) -> usize;
        fn kill(process: c_int, number: c_int) -> c_int;
    }

    /// The process of the server; 0 before it starts and after it has ended.
    static SERVER: AtomicI32 = AtomicI32::new(0);

    extern "C" fn pass_on(_: c_int) {
        terminate(SERVER.load(Ordering::SeqCst));
    }

    pub(super) fn terminate(process: c_int) {
        if process > 0 {
            // SAFETY: `kill` has no memory of ours, and may be called in the handler of a signal.
            unsafe { kill(process, SIGTERM) };
        }
    }

    /// A group of its own: otherwise Ctrl-C would reach the server twice, from the terminal and from here, and the second
    /// signal ends it at once.
    pub(super) fn separate(command: &mut Command) {
        command.process_group(0);
    }

    pub(super) fn watch(process: u32) {
        SERVER.store(c_int::try_from(process).unwrap_or(0), Ordering::SeqCst);
        for number in [SIGHUP, SIGINT, SIGTERM] {
            // SAFETY: the handler reads an atomic number and calls `kill`, which is all that a handler may do. A program that
            // this one starts has the default handlers again.
            unsafe { signal(number, pass_on) };
        }
    }

    pub(super) fn forget() {
        SERVER.store(0, Ordering::SeqCst);
    }
}

#[cfg(windows)]
mod of_the_system {
    use std::process::Command;

    unsafe extern "system" {
        fn SetConsoleCtrlHandler(handler: extern "system" fn(u32) -> i32, add: i32) -> i32;
    }

    /// Returns that the event is handled: the console also tells the server, which ends by itself.
    extern "system" fn stay(_: u32) -> i32 {
        1
    }

    pub(super) fn separate(_: &mut Command) {}

    pub(super) fn watch(_: u32) {
        // SAFETY: the handler touches nothing. Programs that this one starts do not inherit it.
        unsafe { SetConsoleCtrlHandler(stay, 1) };
    }

    pub(super) fn forget() {}
}

/// Starts the server. From then on Ctrl-C ends the server, and this program continues.
///
/// # Errors
/// Returns the system's error if it can't be started.
pub(crate) fn start(mut server: Command) -> std::io::Result<Child> {
    of_the_system::separate(&mut server);
    let server = server.spawn()?;
    of_the_system::watch(server.id());
    Ok(server)
}

/// Ends the server: as Ctrl-C does on Unix, at once on Windows.
pub(crate) fn end(server: &mut Child) {
    #[cfg(unix)]
    of_the_system::terminate(i32::try_from(server.id()).unwrap_or(0));
    #[cfg(not(unix))]
    let _ = server.kill();
    wait(server);
}

/// Waits until the server has ended. Returns whether it ended as it should.
pub(crate) fn wait(server: &mut Child) -> bool {
    let ended = server.wait();
    of_the_system::forget();
    ended.is_ok_and(|status| status.success())
}
