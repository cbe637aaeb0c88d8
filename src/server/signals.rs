//! Signals of the system: those that end the server, and those that must not end it.

use tokio_util::sync::CancellationToken;

/// Catches signals that would end the process by default, until it ends: SIGHUP makes the server check its files;
/// SIGUSR1 and SIGUSR2 do nothing; with SIGXFSZ caught, writing to a log at its size limit returns an error instead.
/// Does nothing on systems other than Unix. A signal that can't be caught keeps its default. Call it within a Tokio
/// runtime.
pub fn outlive() {
    #[cfg(unix)]
    {
        use rustix::process::Signal;
        use tokio::signal::unix::{SignalKind, signal};
        for ignored in [Signal::HUP, Signal::USR1, Signal::USR2, Signal::XFSZ] {
            // Installs the handler, which stays when the stream of signals is dropped.
            let _ = signal(SignalKind::from_raw(ignored.as_raw()));
        }
    }
}

/// Cancels `shutdown` on Ctrl-C or SIGTERM, and on Windows on Ctrl-C, Ctrl-Break, and when the console closes or the
/// system shuts down. A second one ends the process at once, with code 130. All are caught when this returns, so a
/// program may send one as soon as the server reports that it listens; if they can't be caught, this does nothing. On
/// other systems, only Ctrl-C counts. Call it within a Tokio runtime.
///
/// Windows ends a process a few seconds after its console has closed, whatever the deadline of the server is.
pub fn cancel_on(shutdown: CancellationToken) {
    #[cfg(unix)]
    let (mut interrupt, mut terminate) = {
        use tokio::signal::unix::{SignalKind, signal};
        let caught = (signal(SignalKind::interrupt()), signal(SignalKind::terminate()));
        let (Ok(interrupt), Ok(terminate)) = caught else { return };
        (interrupt, terminate)
    };
    #[cfg(windows)]
    let (mut interrupt, mut break_key, mut close, mut system) = {
        use tokio::signal::windows::{ctrl_break, ctrl_c, ctrl_close, ctrl_shutdown};
        let (Ok(interrupt), Ok(break_key)) = (ctrl_c(), ctrl_break()) else { return };
        let (Ok(close), Ok(system)) = (ctrl_close(), ctrl_shutdown()) else { return };
        (interrupt, break_key, close, system)
    };
    tokio::spawn(async move {
        for signals in 0.. {
            #[cfg(unix)]
            tokio::select! {
                _ = interrupt.recv() => {}
                _ = terminate.recv() => {}
            }
            #[cfg(windows)]
            tokio::select! {
                _ = interrupt.recv() => {}
                _ = break_key.recv() => {}
                _ = close.recv() => {}
                _ = system.recv() => {}
            }
            #[cfg(not(any(unix, windows)))]
            let _ = tokio::signal::ctrl_c().await;
            if signals > 0 {
                std::process::exit(130);
            }
            shutdown.cancel();
        }
    });
}
