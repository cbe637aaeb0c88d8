//! The caller of a call as the account that is charged for it. The account is named after the token or certificate,
//! or after the address if authentication is disabled.

use http::{Request, Version, header};
use tonic::Extensions;

use super::address::address_name;
use super::connections::Peer;
use palpate_session::budget::Account;

/// The account that a call is charged to. `authorize` adds it to the extensions of every call that it admits.
#[derive(Debug, Clone)]
pub(crate) struct ChargedCaller {
    pub(crate) account: Account,
    /// The client may disappear without its connection closing: over HTTP/1.1, and over gRPC-web, whose connections a
    /// browser shares among pages.
    pub(crate) may_vanish: bool,
}

impl ChargedCaller {
    /// Returns the name of a caller's account; `caller` is the authenticated name, if any.
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
        ChargedCaller { account, may_vanish: is_web || request.version() < Version::HTTP_2 }
    }

    /// Returns the caller that `authorize` added to these extensions, or an account of its own if there is none.
    pub(super) fn of(extensions: &Extensions) -> Self {
        let known = extensions.get::<ChargedCaller>().cloned();
        known.unwrap_or_else(|| ChargedCaller { account: Account::alone(), may_vanish: true })
    }
}
