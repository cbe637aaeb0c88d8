//! Touch by datagram: WebTransport beside gRPC, on the UDP port of the same number.
//!
//! A call that the caller was let in for offers a *ticket* (`tickets`). The session that presents it belongs to that call's
//! stream or lease, and ends with it: datagrams need no other authentication. The server signs its own certificate
//! (`certificate`), for which the call that carries the offer vouches. `endpoint` accepts sessions, `way` is one of them.

mod certificate;
mod endpoint;
mod tickets;
mod way;

use std::net::{SocketAddr, UdpSocket};
use std::sync::{Arc, Mutex};

use palpate_proto::pb;
use wtransport::Connection;

pub(super) use endpoint::serve;
pub(super) use way::Way;

use super::config::Config;
use crate::lock::lock;
use crate::pace::clock::now_ns;
use crate::refusal::{Reason, Refusal, Result};
use tickets::Tickets;

/// Where datagrams are received, if at all.
pub(super) struct Socket {
    socket: UdpSocket,
    advertised: (String, u16),
}

impl Socket {
    /// The UDP socket beside the listener at `address`. `None` where datagrams are disabled, or where tickets would be sent in
    /// the clear.
    ///
    /// # Errors
    /// Returns why the port can't be had: touch works without it.
    pub(super) fn open(config: &Config, address: SocketAddr) -> std::io::Result<Option<Socket>> {
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

/// The parts of HOST:PORT.
pub(super) fn host_and_port(text: &str) -> Option<(String, u16)> {
    let (host, port) = text.rsplit_once(':')?;
    let is_host = !host.is_empty() && (!host.contains(':') || host.starts_with('[') && host.ends_with(']'));
    is_host.then_some((host.to_owned(), port.parse().ok().filter(|port| *port > 0)?))
}

/// What is told of a ticket: the session that presents it.
pub(super) type Arrival = tokio::sync::oneshot::Receiver<Connection>;

/// Offers sessions for datagrams, or none if the server has none.
#[derive(Clone, Default)]
pub(super) struct Datagrams(Option<Arc<Offers>>);

struct Offers {
    advertised: (String, u16),
    tickets: Mutex<Tickets>,
    certificate_sha256: Mutex<[u8; 32]>,
}

impl Datagrams {
    /// Of what `socket` receives.
    pub(super) fn at(socket: Option<&Socket>) -> Self {
        Datagrams(socket.map(|socket| {
            Arc::new(Offers {
                advertised: socket.advertised.clone(),
                tickets: Mutex::default(),
                certificate_sha256: Mutex::default(),
            })
        }))
    }

    /// An offer for one stream or lease, and the session that takes it. `None` if the server has no datagrams, or too many
    /// tickets are out.
    ///
    /// # Errors
    /// Returns an error if the system has no random numbers.
    pub(super) fn offer(&self) -> Result<Option<(pb::DatagramOffer, Arrival)>> {
        let Some(offers) = &self.0 else { return Ok(None) };
        let Some((ticket, arrival)) = lock(&offers.tickets).give(now_ns())? else { return Ok(None) };
        let (host, port) = offers.advertised.clone();
        let certificate_sha256 = lock(&offers.certificate_sha256).to_vec();
        let offer = pb::DatagramOffer { host, port: port.into(), ticket: ticket.to_vec(), certificate_sha256 };
        Ok(Some((offer, arrival)))
    }
}

/// The refusal of a call for datagrams that the server does not have.
pub(super) fn not_available() -> Refusal {
    let message = "this server has no datagrams at the moment: samples come by WatchSamples, poses go by SendCommands";
    Refusal::new(Reason::NotAvailable, "", message)
}
