//! Offers of datagram sessions: the address to connect to, and the ticket to present.

use std::net::{SocketAddr, UdpSocket};
use std::sync::{Arc, Mutex};

use palpate_proto::pb;

use super::tickets::{Arrival, Tickets};
use crate::server::address::host_and_port;
use crate::server::config::Config;
use palpate_realtime::clock::now_ns;
use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::lock::lock;

/// The UDP socket for datagrams, and the host and port that clients are sent.
pub(in crate::server) struct Socket {
    pub(super) socket: UdpSocket,
    pub(super) advertised: (String, u16),
}

impl Socket {
    /// Opens the UDP socket at the address of the listener. `None` if datagrams are disabled, or if tickets would be
    /// sent unencrypted.
    ///
    /// # Errors
    /// Returns the system's error if the port is not available: touch works without it.
    pub(in crate::server) fn open(config: &Config, address: SocketAddr) -> std::io::Result<Option<Socket>> {
        let is_private = config.tls_cert.is_some() || address.ip().is_loopback();
        if !config.datagrams || !is_private {
            return Ok(None);
        }
        let socket = UdpSocket::bind(address)?;
        let advertised = config.datagrams_advertise.as_deref().and_then(host_and_port);
        let advertised = advertised.unwrap_or((String::new(), address.port()));
        Ok(Some(Socket { socket, advertised }))
    }
}

/// Offers datagram sessions, if the server has any.
#[derive(Clone, Default)]
pub(in crate::server) struct Datagrams(pub(super) Option<Arc<Offers>>);

/// The outstanding tickets, and the address and certificate for which they are valid.
pub(super) struct Offers {
    advertised: (String, u16),
    pub(super) tickets: Mutex<Tickets>,
    pub(super) certificate_sha256: Mutex<[u8; 32]>,
}

impl Offers {
    /// Creates the offers of sessions at that host and port, with a certificate of that hash.
    pub(super) fn new(advertised: (String, u16), certificate_sha256: [u8; 32]) -> Self {
        Offers { advertised, tickets: Mutex::default(), certificate_sha256: Mutex::new(certificate_sha256) }
    }
}

impl Datagrams {
    /// Creates an offer for one stream or lease, and the future session that accepts it. `None` if the server has no
    /// datagrams, or too many tickets are outstanding.
    ///
    /// # Errors
    /// Returns an error if the system provides no random numbers.
    pub(in crate::server) fn offer(&self) -> Result<Option<(pb::DatagramOffer, Arrival)>> {
        let Some(offers) = &self.0 else { return Ok(None) };
        let Some((ticket, arrival)) = lock(&offers.tickets).give(now_ns())? else { return Ok(None) };
        let (host, port) = offers.advertised.clone();
        let certificate_sha256 = lock(&offers.certificate_sha256).to_vec();
        let offer = pb::DatagramOffer { host, port: port.into(), ticket: ticket.to_vec(), certificate_sha256 };
        Ok(Some((offer, arrival)))
    }
}

/// Returns the refusal of a call for datagrams on a server without them.
pub(in crate::server) fn not_available() -> Refusal {
    let message = "this server has no datagrams at the moment: samples come by WatchSamples, poses go by SendCommands";
    Refusal::new(Reason::NotAvailable, "", message)
}
