//! A member of etcd, and the connection to it: opened when it is needed and reopened after it failed.

use std::sync::Arc;
use std::time::Duration;

use palpate_proto::etcd::etcdserverpb::StatusRequest;
use palpate_proto::etcd::etcdserverpb::maintenance_client::MaintenanceClient;
use tokio::sync::Mutex;
use tokio::time::{Instant, timeout};
use tonic::transport::{Channel, Endpoint, Uri};

use super::error::{root, text};
use super::options::{EtcdOptions, is_secure};

/// Time without new attempts after a failed connection to a member, and the longest wait between rounds of
/// attempts.
pub(super) const BACK_OFF: Duration = Duration::from_millis(250);

/// Silence after which a connection with calls under way is pinged. etcd closes connections that ping more often
/// than every 5 s.
const SILENCE: Duration = Duration::from_secs(6);

/// Flow-control windows of a stream and of a connection, bytes.
const WINDOWS_BYTES: (u32, u32) = (1 << 20, 4 << 20);

/// A member of etcd, with its shared connection.
pub(super) struct Member {
    uri: Uri,
    url: String,
    options: Arc<EtcdOptions>,
    limit: Duration,
    line: Mutex<Line>,
}

/// The connection that all calls share.
#[derive(Default)]
struct Line {
    /// The connection and its number: a call that failed must not close the connection after it.
    channel: Option<(u64, Channel)>,
    made: u64,
    /// Time of the last failed attempt, and its reason.
    failed: Option<(Instant, String)>,
}

impl Member {
    pub(super) fn new(uri: Uri, options: Arc<EtcdOptions>, limit: Duration) -> Self {
        let url = uri.to_string().trim_end_matches('/').to_owned();
        Member { uri, url, options, limit, line: Mutex::default() }
    }

    /// Returns its address, for messages.
    pub(super) fn url(&self) -> &str {
        &self.url
    }

    /// Returns the shared connection and its number; opens it if there is none. A new connection is tested by a
    /// call without effects, so that a member which accepts connections and does not answer gets no transaction.
    /// The error is the reason why there is no connection; nothing was sent then.
    pub(super) async fn line(&self) -> std::result::Result<(u64, Channel), String> {
        let mut line = self.line.lock().await;
        if let Some(made) = &line.channel {
            return Ok(made.clone());
        }
        if let Some((_, why)) = line.failed.as_ref().filter(|(at, _)| at.elapsed() < BACK_OFF) {
            return Err(why.clone());
        }
        match timeout(self.limit, self.tried()).await.unwrap_or_else(|_| Err(self.silent())) {
            Ok(channel) => {
                line.made += 1;
                line.failed = None;
                let made = (line.made, channel);
                line.channel = Some(made.clone());
                Ok(made)
            }
            Err(why) => {
                line.failed = Some((Instant::now(), why.clone()));
                Err(why)
            }
        }
    }

    /// Drops the connection `number`, if it is still the present one: the next call opens another.
    pub(super) async fn give_up(&self, number: u64) {
        let mut line = self.line.lock().await;
        line.channel.take_if(|made| made.0 == number);
    }

    /// Opens a connection for one caller alone.
    pub(super) async fn connect(&self) -> std::result::Result<Channel, String> {
        let mut endpoint = Endpoint::from(self.uri.clone())
            .connect_timeout(self.limit)
            .tcp_nodelay(true)
            .tcp_keepalive(Some(SILENCE))
            .http2_keep_alive_interval(SILENCE)
            .keep_alive_timeout(self.limit)
            .initial_stream_window_size(WINDOWS_BYTES.0)
            .initial_connection_window_size(WINDOWS_BYTES.1);
        if is_secure(&self.uri) {
            endpoint = endpoint.tls_config(self.options.tls()?).map_err(|e| root(&e))?;
        }
        endpoint.connect().await.map_err(|e| root(&e))
    }

    /// Returns the reason for a member that does not answer.
    pub(super) fn silent(&self) -> String {
        format!("has not answered within {} s", self.limit.as_secs_f64())
    }

    async fn tried(&self) -> std::result::Result<Channel, String> {
        let channel = self.connect().await?;
        let asked = MaintenanceClient::new(channel.clone()).status(StatusRequest {}).await;
        let status = asked.map_err(|status| text(&status))?.into_inner();
        match status {
            _ if status.is_learner => Err("is being added and only follows".into()),
            _ if status.leader == 0 => Err("has no leader".into()),
            _ => Ok(channel),
        }
    }
}
