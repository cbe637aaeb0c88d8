//! Touch by datagram: WebTransport in addition to gRPC, on the UDP port of the same number.
//!
//! An admitted call offers a *ticket* (`tickets`), a random number that is valid once. The session that presents it
//! belongs to that call's stream or lease, and ends with it: datagrams need no other authentication. The server signs
//! its own certificate (`certificate`); the call that carries the offer vouches for it by its hash. `offers` creates
//! offers, `endpoint` accepts sessions, and `channel` is one of them.

mod certificate;
mod channel;
mod endpoint;
mod offers;
mod tickets;

pub(super) use channel::DatagramChannel;
pub(super) use endpoint::receive;
pub(super) use offers::{Datagrams, Socket, not_available};
pub(super) use tickets::{Arrival, GOOD};
