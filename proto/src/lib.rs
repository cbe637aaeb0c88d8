//! Palpate's protocol in Rust, for servers and clients.
//!
//! - [`pb`]: the messages, clients and servers generated from `palpate/v1/*.proto`, which document them. The features
//!   `client` and `server` choose what is generated besides the messages. To connect, use `tonic::transport` or the
//!   crate `palpate-client`.
//! - [`journal`]: the messages of journals, from `palpate/journal/v1/*.proto`.
//! - `agones` (feature `agones`): the calls of the SDK of Agones that servers of a fleet use, from `agones/*.proto`.
//! - Refusals as gRPC statuses are in the crate `palpate-refusal`, with its feature `status`.
//! - `etcd` (feature `etcd`): messages and clients of etcd, from `etcd/*.proto`, which have what a fleet of servers uses.
//! - [`measure`]: how much memory a message takes, measured before it is decoded; [`codec`]: decodes messages within
//!   such limits.
//! - `datagram` (feature `datagrams`): limits and conversions that both ends of datagrams share.
//! - [`scene`]: what the message of a scene says about its tissue.
//! - [`geometry`], [`instrument`] and [`touch`]: conversion of vectors, of instruments, and of the types of the crate `palpate-haptics`.

pub mod codec;
#[cfg(feature = "datagrams")]
pub mod datagram;
pub mod geometry;
pub mod instrument;
pub mod measure;
pub mod scene;
pub mod touch;

/// The generated code: messages, clients and servers of package `palpate.v1`.
#[allow(missing_docs, clippy::all, clippy::pedantic, clippy::unwrap_used, unreachable_pub, rust_2018_idioms)]
pub mod pb {
    include!("../generated/palpate.v1.rs");

    /// Every file of the protocol, for reflection: the bytes of a `google.protobuf.FileDescriptorSet`.
    pub const DESCRIPTORS: &[u8] = include_bytes!("../generated/palpate.v1.bin");

    /// For the request type of every call, its name and a function that returns whether bytes can be decoded as one,
    /// without any limit on their memory.
    pub const DECODERS: &[(&str, fn(&[u8]) -> bool)] = include!("../generated/decoders.rs");
}

/// The generated messages, clients and servers of the SDK of Agones, from `agones/*.proto`: the part that servers of
/// a fleet use.
#[cfg(feature = "agones")]
#[allow(missing_docs, clippy::all, clippy::pedantic, clippy::unwrap_used, unreachable_pub, rust_2018_idioms)]
pub mod agones {
    include!("../generated/agones.dev.sdk.rs");

    /// The part of the SDK that is not stable yet: counters.
    pub mod beta {
        include!("../generated/agones.dev.sdk.beta.rs");
    }
}

/// The generated messages of package `palpate.journal.v1`: the contents of a session's journal.
#[allow(missing_docs, clippy::all, clippy::pedantic, clippy::unwrap_used, unreachable_pub, rust_2018_idioms)]
pub mod journal {
    include!("../generated/palpate.journal.v1.rs");

    /// Message formats of Foxglove, for exports.
    pub mod foxglove {
        include!("../generated/foxglove.rs");
    }

    /// The descriptors of these files and their imports, each after its own imports: the bytes of a
    /// `google.protobuf.FileDescriptorSet`.
    pub const DESCRIPTORS: &[u8] = include_bytes!("../generated/palpate.journal.v1.bin");
}

/// The generated messages and clients of etcd, by its own names of packages: `etcdserverpb` uses `mvccpb`.
#[cfg(feature = "etcd")]
#[allow(missing_docs, clippy::all, clippy::pedantic, clippy::unwrap_used, unreachable_pub, rust_2018_idioms)]
pub mod etcd {
    pub mod mvccpb {
        include!("../generated/mvccpb.rs");
    }

    pub mod etcdserverpb {
        include!("../generated/etcdserverpb.rs");
    }
}
