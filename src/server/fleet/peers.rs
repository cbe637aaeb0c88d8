//! Connections to the other servers of the fleet.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Mutex;
use std::time::Duration;

use palpate_proto::pb::node_service_client::NodeServiceClient;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};

use super::super::config::Config;
use crate::lock::lock;
use crate::refusal::{Reason, Refusal, Result};

/// A server that is silent for so long is given up.
const SILENCE: Duration = Duration::from_secs(1);

/// How to reach the other servers.
pub(super) struct Peers {
    tls: Option<ClientTlsConfig>,
    channels: Mutex<BTreeMap<String, Channel>>,
}

fn read(field: &str, path: &Path) -> Result<Vec<u8>> {
    std::fs::read(path)
        .map_err(|error| Refusal::new(Reason::Unreadable, field, format!("{}: can't be read: {error}", path.display())))
}

impl Peers {
    /// With this server's certificate, if it has one.
    ///
    /// # Errors
    /// Refuses files that can't be read.
    pub(super) fn new(config: &Config) -> Result<Self> {
        let mut tls = None;
        if let Some(ca) = &config.cluster.ca {
            let mut with = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(read("cluster.ca", ca)?));
            if let (Some(cert), Some(key)) = (&config.tls_cert, &config.tls_key) {
                with = with.identity(Identity::from_pem(read("tls_cert", cert)?, read("tls_key", key)?));
            }
            tls = Some(with);
        }
        Ok(Peers { tls, channels: Mutex::default() })
    }

    /// The server at that URL, which is connected to when it is called.
    ///
    /// # Errors
    /// Refuses what is no URL.
    pub(super) fn at(&self, endpoint: &str) -> Result<NodeServiceClient<Channel>> {
        let mut channels = lock(&self.channels);
        if let Some(channel) = channels.get(endpoint) {
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
            to = to.tls_config(tls.clone()).map_err(wrong)?;
        }
        let channel = to.connect_lazy();
        channels.insert(endpoint.to_owned(), channel.clone());
        Ok(client(channel))
    }

    /// Servers that are not there any more are forgotten.
    pub(super) fn keep(&self, is_there: impl Fn(&str) -> bool) {
        lock(&self.channels).retain(|endpoint, _| is_there(endpoint));
    }
}

/// Bytes of a message between nodes, at most.
pub(in crate::server) const MOST_MESSAGE_BYTES: usize = 8 << 20;

fn client(channel: Channel) -> NodeServiceClient<Channel> {
    NodeServiceClient::new(channel)
        .max_decoding_message_size(MOST_MESSAGE_BYTES)
        .max_encoding_message_size(MOST_MESSAGE_BYTES)
}
