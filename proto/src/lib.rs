//! Palpate's protocol in Rust, for servers and clients.
//!
//! - [`pb`]: the messages, clients and servers that are generated from `palpate/v1/*.proto`, which document them. The
//!   features `client` and `server` choose what is generated besides the messages. To connect, use `tonic::transport` or
//!   the crate `palpate-client`.
//! - [`journal`]: the messages of journals, from `palpate/journal/v1/*.proto`.
//! - [`refusal`]: the reasons for which inputs are refused, and [`error`]: refusals as gRPC statuses.
//! - [`codec`]: decodes messages, requests within bounds.
//! - `datagram` (feature `datagrams`): what both ends of datagrams agree on.
//! - [`geometry`] and [`touch`]: conversion of vectors, and of the types of the crate `palpate-touch`.

pub mod codec;
#[cfg(feature = "datagrams")]
pub mod datagram;
pub mod error;
pub mod geometry;
pub mod refusal;
pub mod touch;

/// The generated code: messages, clients and servers of package `palpate.v1`.
#[allow(missing_docs, clippy::all, clippy::pedantic, clippy::unwrap_used, unreachable_pub, rust_2018_idioms)]
pub mod pb {
    tonic::include_proto!("palpate.v1");

    /// Every file of the protocol, for reflection.
    pub const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/palpate.bin"));

    /// The request of every call, by its name: whether bytes can be decoded as one.
    pub const DECODERS: &[(&str, fn(&[u8]) -> bool)] = include!(concat!(env!("OUT_DIR"), "/decoders.rs"));
}

/// The generated messages of package `palpate.journal.v1`: what is in the journal of a session.
#[allow(missing_docs, clippy::all, clippy::pedantic, clippy::unwrap_used, unreachable_pub, rust_2018_idioms)]
pub mod journal {
    include!(concat!(env!("OUT_DIR"), "/journal/palpate.journal.v1.rs"));

    /// A convention of Foxglove, for exports.
    pub mod foxglove {
        include!(concat!(env!("OUT_DIR"), "/journal/foxglove.rs"));
    }

    /// Their files and those that they import, each after its own imports.
    pub const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/journal/journal.bin"));
}
