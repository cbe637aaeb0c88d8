//! Who makes a call, for what is charged to them: known by their token or certificate, and by their address where nobody
//! is asked.

use std::net::IpAddr;

use http::{Request, Version, header};
use tonic::Extensions;

use super::connections::{Peer, network};
use crate::budget::Account;

/// In the extensions of every call that the guard has let through.
#[derive(Debug, Clone)]
pub(crate) struct Visitor {
    pub(crate) account: Account,
    /// The end of its connection may not be noticed, or says nothing: HTTP/1.1, and gRPC-web, whose connections a browser
    /// shares among pages.
    pub(crate) may_vanish: bool,
}

impl Visitor {
    /// The name of an account: of `caller`, if they were asked who they are.
    pub(super) fn account_name(caller: Option<&str>, peer: Option<&Peer>) -> String {
        match (caller, peer) {
            (Some(name), _) => format!("token:{name}"),
            (None, Some(peer)) => address_name(peer.address.ip()),
            (None, None) => "address:unknown".to_owned(),
        }
    }

    pub(super) fn new<B>(account: Account, request: &Request<B>) -> Self {
        let kind = request.headers().get(header::CONTENT_TYPE).map(http::HeaderValue::as_bytes);
        let is_web = kind.is_some_and(|kind| kind.starts_with(b"application/grpc-web"));
        Visitor { account, may_vanish: is_web || request.version() < Version::HTTP_2 }
    }

    /// Whoever made the call; the guard put them there.
    pub(super) fn of(extensions: &Extensions) -> Self {
        let known = extensions.get::<Visitor>().cloned();
        known.unwrap_or_else(|| Visitor { account: Account::alone(), may_vanish: true })
    }
}

/// The account of who comes from there: of IPv6, from one network of 64 bits.
pub(super) fn address_name(address: IpAddr) -> String {
    format!("address:{}", network(address))
}
