//! Connections to the other servers of the fleet.

use std::collections::BTreeMap;
use std::error::Error;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use palpate_proto::pb::node_service_client::NodeServiceClient;
use tonic::Status;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};

use super::super::config::Config;
use super::super::reload::Reloaded;
use palpate_cluster::etcd::root;
use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::lock::lock;

/// Time without an answer after which a server counts as unreachable.
const SILENCE: Duration = Duration::from_secs(1);

/// The connections to the other servers, by their URLs.
pub(super) struct Peers {
    /// This server's certificate and the authorities of the others, as the files are now.
    tls: Option<Arc<Reloaded<ClientTlsConfig>>>,
    /// Each connection, with the version of these files for which it was made.
    channels: Mutex<BTreeMap<String, (u64, Channel)>>,
}

/// Builds the configuration from the authorities, and this server's certificate and key if it has one.
fn configure(texts: &[String]) -> Result<ClientTlsConfig> {
    let mut tls = ClientTlsConfig::new();
    let mut texts = texts.iter();
    if let Some(ca) = texts.next() {
        tls = tls.ca_certificate(Certificate::from_pem(ca));
    }
    if let (Some(cert), Some(key)) = (texts.next(), texts.next()) {
        tls = tls.identity(Identity::from_pem(cert, key));
    }
    // The library parses them only here. Its error quotes no key.
    let tried = Endpoint::from_static("https://localhost").tls_config(tls.clone());
    tried.map_err(|error| Refusal::new(Reason::Unreadable, "cluster.ca", root(&error)))?;
    Ok(tls)
}

/// Returns why a call of another server failed: for a failed connection, the first cause.
pub(super) fn why(status: &Status) -> String {
    status.source().map_or_else(|| status.message().to_owned(), root)
}

impl Peers {
    /// Creates the connections, with this server's certificate if it has one.
    ///
    /// # Errors
    /// Refuses files that can't be read or used.
    pub(super) fn new(config: &Config) -> Result<Self> {
        let load = |ca: &PathBuf| {
            let paths = [Some(ca), config.tls_cert.as_ref(), config.tls_key.as_ref()];
            Reloaded::load("TLS of the fleet", paths.into_iter().flatten().cloned().collect(), configure)
        };
        let tls = config.cluster.ca.as_ref().map(load).transpose()?.map(Arc::new);
        Ok(Peers { tls, channels: Mutex::default() })
    }

    /// Watches the certificate files until the server ends: later connections use the new ones.
    pub(super) fn watch(&self) -> impl Future<Output = ()> + Send + 'static + use<> {
        let tls = self.tls.clone();
        async move {
            if let Some(tls) = tls {
                tls.watch().await;
            }
        }
    }

    /// Returns a client of the server at that URL; it connects at the first call.
    ///
    /// # Errors
    /// Refuses a text that is not a URL.
    pub(super) fn at(&self, endpoint: &str) -> Result<NodeServiceClient<Channel>> {
        let version = self.tls.as_ref().map_or(0, |tls| tls.version());
        let mut channels = lock(&self.channels);
        if let Some((_, channel)) = channels.get(endpoint).filter(|made| made.0 == version) {
            return Ok(client(channel.clone()));
        }
        let wrong = |error: tonic::transport::Error| {
            Refusal::new(
                Reason::NotAvailable,
                "",
                format!("no server of the fleet can be reached at {endpoint}: {error}"),
            )
        };
        let mut to = Endpoint::from_shared(endpoint.to_owned())
            .map_err(wrong)?
            .connect_timeout(SILENCE)
            .tcp_nodelay(true)
            .http2_keep_alive_interval(SILENCE)
            .keep_alive_timeout(SILENCE)
            .keep_alive_while_idle(true);
        if endpoint.starts_with("https://")
            && let Some(tls) = &self.tls
        {
            to = to.tls_config(tls.get().as_ref().clone()).map_err(wrong)?;
        }
        let channel = to.connect_lazy();
        channels.insert(endpoint.to_owned(), (version, channel.clone()));
        Ok(client(channel))
    }

    /// Drops connections to servers that have left.
    pub(super) fn keep(&self, is_there: impl Fn(&str) -> bool) {
        lock(&self.channels).retain(|endpoint, _| is_there(endpoint));
    }
}

/// Limit on the bytes of a message between servers of the fleet.
pub(in crate::server) const MAX_MESSAGE_BYTES: usize = 8 << 20;

fn client(channel: Channel) -> NodeServiceClient<Channel> {
    NodeServiceClient::new(channel)
        .max_decoding_message_size(MAX_MESSAGE_BYTES)
        .max_encoding_message_size(MAX_MESSAGE_BYTES)
}
