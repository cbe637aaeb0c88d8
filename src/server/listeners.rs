//! Opens a server's listeners and loads its protection before it serves.

use std::net::SocketAddr;

use tokio::net::TcpListener;
use tracing::warn;

use super::config::Config;
use super::datagrams::Socket;
use super::protection::Protection;
use palpate_refusal::{Reason, Refusal};

/// The reasons why a server can't start, or ends by itself.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The configuration is invalid or not safe, a file that it names can't be used, or the journals or the fleet
    /// can't.
    #[error("{0}")]
    Refused(#[from] Refusal),
    /// The system does not let the server listen: the address is in use, does not belong to this machine, or has a
    /// port for which the user has no permission.
    #[error("can't listen on {address}: {}", unavailable(.field, .error))]
    Listen {
        /// The configuration key of the address: `listen` or `metrics`.
        field: &'static str,
        /// The address as it was configured.
        address: String,
        /// The system's error.
        error: std::io::Error,
    },
    /// A thread can't be started.
    #[error("can't start a stepping thread: {0}")]
    Threads(#[from] std::io::Error),
    /// The transport failed while the server ran.
    #[error("the transport failed: {0}")]
    Transport(#[from] tonic::transport::Error),
    /// The reflection service can't read its own descriptors.
    #[error("can't read the descriptors of the protocol: {0}")]
    Reflection(#[from] tonic_reflection::server::Error),
}

/// Describes why an address is not available, and what to do.
fn unavailable(field: &str, error: &std::io::Error) -> String {
    match error.kind() {
        std::io::ErrorKind::AddrInUse => format!(
            "another program, perhaps a server that still runs, listens there already ({error}); end it, or give another \
             --{field}, such as port 0 for any free port"
        ),
        std::io::ErrorKind::AddrNotAvailable => {
            format!(
                "the address does not belong to this machine ({error}); give another --{field}, such as 0.0.0.0:7117 for all of them"
            )
        }
        std::io::ErrorKind::PermissionDenied => {
            format!("this user may not ({error}); give a --{field} with a port from 1024 on")
        }
        _ => format!("{error}; give another --{field}, such as port 0 for any free port"),
    }
}

/// A server's open listeners and its protection (TLS and credentials), before [`serve`](super::serve()) takes them.
/// Clients can connect, but get no answer until then. Dropping it closes the listeners.
pub struct Listeners {
    pub(super) listener: TcpListener,
    pub(super) metrics: Option<TcpListener>,
    pub(super) datagrams: Option<Socket>,
    pub(super) protection: Protection,
}

impl Listeners {
    /// Listens on the configured addresses, if that is safe, and loads certificates, keys and tokens. If the UDP port
    /// for datagrams is not free, only logs a warning. Call it within a Tokio runtime.
    ///
    /// # Errors
    /// Returns [`ServeError::Refused`] if an address is malformed, if other machines could reach the server without
    /// TLS and authentication or its metrics at all (without `insecure`), or if a file of the protection can't be
    /// used; and [`ServeError::Listen`] if an address is not available.
    pub async fn open(config: &Config) -> Result<Self, ServeError> {
        let listener = listen("listen", &config.listen).await?;
        let address = local_address("listen", &listener, &config.listen)?;
        let protection = Protection::load(config, address)?;
        let datagrams = Socket::open(config, address).unwrap_or_else(|error| {
            warn!(%address, %error, "no touch by datagram: the UDP port is not free. --no-datagrams does without");
            None
        });
        let metrics = match &config.metrics {
            Some(text) => {
                let listener = listen("metrics", text).await?;
                let address = local_address("metrics", &listener, text)?;
                if !address.ip().is_loopback() && !config.insecure {
                    let why = "and the metrics need no authentication: listen on 127.0.0.1, or pass --insecure";
                    let message = format!("other machines can reach {address}, {why}");
                    return Err(Refusal::new(Reason::OutOfRange, "metrics", message).into());
                }
                Some(listener)
            }
            None => None,
        };
        Ok(Listeners { listener, metrics, datagrams, protection })
    }

    /// Returns the server's URL: scheme, address and port, the one that the system chose if port 0 was configured.
    pub fn url(&self) -> String {
        url(self.protection.scheme(), &self.listener)
    }

    /// Returns the URL of the metrics, with the path `/metrics`; `None` if they are not served.
    pub fn metrics_url(&self) -> Option<String> {
        self.metrics.as_ref().map(|listener| url("http", listener) + "/metrics")
    }
}

fn local_address(field: &'static str, listener: &TcpListener, text: &str) -> Result<SocketAddr, ServeError> {
    listener.local_addr().map_err(|error| ServeError::Listen { field, address: text.to_owned(), error })
}

fn url(scheme: &str, listener: &TcpListener) -> String {
    listener.local_addr().map_or_else(|e| e.to_string(), |address| format!("{scheme}://{address}"))
}

async fn listen(field: &'static str, text: &str) -> Result<TcpListener, ServeError> {
    TcpListener::bind(text).await.map_err(|error| {
        if error.kind() == std::io::ErrorKind::InvalidInput {
            let message = format!("must be address:port, such as 127.0.0.1:7117, but is `{text}`");
            return Refusal::new(Reason::WrongKind, field, message).into();
        }
        ServeError::Listen { field, address: text.to_owned(), error }
    })
}
