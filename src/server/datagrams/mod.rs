//! Touch by datagram: WebTransport beside gRPC, on the UDP port of the same number.
//!
//! A call that the caller was let in for offers a *ticket* (`tickets`). The session that presents it belongs to that call's
//! stream or lease, and ends with it: datagrams need no other authentication. The server signs its own certificate
//! (`certificate`), for which the call that carries the offer vouches. `endpoint` accepts sessions, `channel` is one of them.

mod certificate;
mod channel;
mod endpoint;
mod offers;
mod tickets;

pub(super) use channel::DatagramChannel;
pub(super) use endpoint::receive;
pub(super) use offers::{Datagrams, Socket, not_available};
pub(super) use tickets::{Arrival, GOOD};
