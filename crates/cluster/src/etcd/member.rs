//! A member of etcd: the connection to it, made when it is needed and again after it broke.

use std::sync::Arc;
use std::time::Duration;

use palpate_proto::etcd::etcdserverpb::StatusRequest;
use palpate_proto::etcd::etcdserverpb::maintenance_client::MaintenanceClient;
use tokio::sync::Mutex;
use tokio::time::{Instant, timeout};
use tonic::transport::{Channel, Endpoint, Uri};

use super::error::{root, text};
use super::options::{EtcdOptions, is_secure};

/// A member to which no connection could be made is left alone for so long, and so long is the longest wait between attempts.
pub(super) const BACK_OFF: Duration = Duration::from_millis(250);

/// A connection with calls under way that is silent for so long is pinged. etcd ends connections that ping it more often than
/// every 5 s.
const SILENCE: Duration = Duration::from_secs(6);

/// Bytes that may wait unread, of a stream and of a connection.
const WINDOWS_BYTES: (u32, u32) = (1 << 20, 4 << 20);

/// A member, by its address.
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
    /// With its number, since a call that failed must not end the connection after it.
    channel: Option<(u64, Channel)>,
    made: u64,
    /// When the last attempt failed, and why.
    failed: Option<(Instant, String)>,
}

impl Member {
    pub(super) fn new(uri: Uri, options: Arc<EtcdOptions>, limit: Duration) -> Self {
        let url = uri.to_string().trim_end_matches('/').to_owned();
        Member { uri, url, options, limit, line: Mutex::default() }
    }

    /// Its address, for messages.
    pub(super) fn url(&self) -> &str {
        &self.url
    }

    /// The connection, and its number. One that is new has been tried by a call that changes nothing, so that a member which
    /// accepts connections and does not answer gets no transaction. An error says why there is none; nothing was sent then.
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

    /// Gives a connection up that has failed or does not answer: the next call makes another.
    pub(super) async fn give_up(&self, number: u64) {
        let mut line = self.line.lock().await;
        line.channel.take_if(|made| made.0 == number);
    }

    /// A connection for one caller alone.
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

    /// What to say of a member that does not answer.
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
