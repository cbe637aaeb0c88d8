//! Counts of network traffic: connections, bytes, calls and refusals.

use std::net::SocketAddr;

use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use tracing::{info, warn};

use super::identity::CALLS;
use super::transport::Cut;
use palpate_refusal::Reason;

/// One label of a metric: name and value.
type Label = [(&'static str, &'static str); 1];

/// Counters and gauges of the network traffic, for the metrics.
#[derive(Debug, Default)]
pub(crate) struct Traffic {
    pub(super) connections: Gauge,
    pub(super) connected: Counter,
    pub(super) handshakes_failed: Counter,
    pub(super) silent: Counter,
    pub(super) cuts: Family<[(&'static str, &'static str); 2], Counter>,
    pub(super) useless_files: Family<Label, Gauge>,
    pub(super) bytes_in: Counter,
    pub(super) bytes_out: Counter,
    pub(super) calls: Family<Label, Counter>,
    pub(super) commands: Counter,
    pub(super) datagram_sessions: Counter,
    pub(super) datagram_sessions_refused: Counter,
    pub(super) refusals: Family<Label, Counter>,
}

/// Counts a connection as open until it is dropped.
pub(super) struct Open(Gauge);

impl Drop for Open {
    fn drop(&mut self) {
        self.0.dec();
    }
}

impl Traffic {
    /// Counts a connection as open until the returned value is dropped.
    pub(super) fn open(&self) -> Open {
        self.connected.inc();
        self.connections.inc();
        Open(self.connections.clone())
    }

    pub(super) fn handshake_failed(&self, client: SocketAddr, error: &str) {
        info!(%client, error, "TLS handshake failed");
        self.handshakes_failed.inc();
    }

    /// Counts and logs a connection that was closed because it sent no request in time.
    pub(super) fn stayed_silent(&self, client: SocketAddr) {
        info!(%client, "connection closed: it sent no request in time");
        self.silent.inc();
    }

    /// Counts and logs a connection that the transport of `side` has cut.
    pub(super) fn cut(&self, client: SocketAddr, side: &'static str, cut: &Cut) {
        let Cut { reason, words } = cut;
        warn!(%client, reason, "connection cut by the transport of the {side}: {words}");
        self.cuts.get_or_create(&[("side", side), ("reason", reason)]).inc();
    }

    /// Records whether the contents of these files are unused (unreadable or invalid).
    pub(super) fn files(&self, what: &'static str, are_useless: bool) {
        self.useless_files.get_or_create(&[("files", what)]).set(are_useless.into());
    }

    /// Counts an admitted call.
    pub(super) fn called(&self, path: &str) {
        if let Some((path, _)) = CALLS.iter().find(|call| call.0 == path) {
            self.calls.get_or_create(&[("call", path)]).inc();
        }
    }

    /// Counts accepted commands.
    pub(super) fn commanded(&self, commands: usize) {
        self.commands.inc_by(commands as u64);
    }

    /// Counts a refused call or command.
    pub(super) fn refused(&self, reason: Reason) {
        self.refusals.get_or_create(&[("reason", reason.as_str())]).inc();
    }
}
