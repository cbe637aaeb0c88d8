//! What the system tells a server: to end, to look at its files, or nothing of interest.

use tokio_util::sync::CancellationToken;

/// What would end a process by default and is no reason for a server to end: SIGHUP has it look at its files, the others
/// mean nothing to it; a log that may not grow any more (SIGXFSZ) is an error to who writes it.
pub fn outlive() {
    #[cfg(unix)]
    {
        use rustix::process::Signal;
        use tokio::signal::unix::{SignalKind, signal};
        for ignored in [Signal::HUP, Signal::USR1, Signal::USR2, Signal::XFSZ] {
            // Caught from now on, though nobody is told here.
            let _ = signal(SignalKind::from_raw(ignored.as_raw()));
        }
    }
}

/// Ctrl-C and SIGTERM end the server; a second one ends it at once.
pub async fn cancel_on(shutdown: CancellationToken) {
    for signals in 0.. {
        #[cfg(unix)]
        {
            use tokio::signal::unix::{SignalKind, signal};
            let Ok(mut terminate) = signal(SignalKind::terminate()) else { return };
            tokio::select! {
                _ = tokio::signal::ctrl_c() => {}
                _ = terminate.recv() => {}
            }
        }
        #[cfg(not(unix))]
        let _ = tokio::signal::ctrl_c().await;
        if signals > 0 {
            std::process::exit(130);
        }
        shutdown.cancel();
    }
}
