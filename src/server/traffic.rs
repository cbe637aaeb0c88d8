//! Counts of what goes over the network.

use std::net::SocketAddr;

use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use tracing::{info, warn};

use super::identity::CALLS;
use super::transport::Cut;
use palpate_refusal::Reason;

/// One label.
type Label = [(&'static str, &'static str); 1];

/// What goes over the network.
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

/// Counts a connection until it is dropped.
pub(super) struct Open(Gauge);

impl Drop for Open {
    fn drop(&mut self) {
        self.0.dec();
    }
}

impl Traffic {
    /// A connection is open for as long as what this returns.
    pub(super) fn open(&self) -> Open {
        self.connected.inc();
        self.connections.inc();
        Open(self.connections.clone())
    }

    pub(super) fn handshake_failed(&self, client: SocketAddr, error: &str) {
        info!(%client, error, "TLS handshake failed");
        self.handshakes_failed.inc();
    }

    /// A connection had to be closed that did not say what it wants.
    pub(super) fn stayed_silent(&self, client: SocketAddr) {
        info!(%client, "connection closed: it sent no request in time");
        self.silent.inc();
    }

    /// The transport of `side` has cut a connection.
    pub(super) fn cut(&self, client: SocketAddr, side: &'static str, cut: &Cut) {
        let Cut { reason, words } = cut;
        warn!(%client, reason, "connection cut by the transport of the {side}: {words}");
        self.cuts.get_or_create(&[("side", side), ("reason", reason)]).inc();
    }

    /// What these files hold is in force, or not.
    pub(super) fn files(&self, what: &'static str, are_useless: bool) {
        self.useless_files.get_or_create(&[("files", what)]).set(are_useless.into());
    }

    /// A call was let through.
    pub(super) fn called(&self, path: &str) {
        if let Some((path, _)) = CALLS.iter().find(|call| call.0 == path) {
            self.calls.get_or_create(&[("call", path)]).inc();
        }
    }

    /// Commands were taken.
    pub(super) fn commanded(&self, commands: usize) {
        self.commands.inc_by(commands as u64);
    }

    /// A call or a command was refused.
    pub(super) fn refused(&self, reason: Reason) {
        self.refusals.get_or_create(&[("reason", reason.as_str())]).inc();
    }
}
