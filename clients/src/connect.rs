//! Connections to a server: plain or TLS, with the caller's credentials.

use std::error::Error;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use palpate::wire::error;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Certificate, ClientTlsConfig, Endpoint, Identity, Uri};
use tonic::{Request, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

use crate::Failure;

/// The caller's credentials, and which servers are trusted.
#[derive(clap::Args, Debug, Clone, Default)]
#[command(next_help_heading = "Credentials (a server on this machine usually needs none)")]
pub(crate) struct Credentials {
    /// File with your token [or set the environment variable PALPATE_TOKEN to the token itself]
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Certificates (PEM) to trust for https URLs instead of the system's
    #[arg(long, value_name = "FILE")]
    ca: Option<PathBuf>,
    /// Name that the server's certificate must carry, if it differs from the URL's host
    #[arg(long, value_name = "NAME")]
    tls_name: Option<String>,
    /// Your client certificate (PEM), if the server requires one
    #[arg(long, value_name = "FILE", requires = "key")]
    cert: Option<PathBuf>,
    /// Private key of the client certificate (PEM)
    #[arg(long, value_name = "FILE", requires = "cert")]
    key: Option<PathBuf>,
}

/// A connection that adds the token, if there is one, to each call.
pub(crate) type Channel = InterceptedService<tonic::transport::Channel, Bearer>;

/// Adds the token to each call.
#[derive(Clone)]
pub(crate) struct Bearer(Option<MetadataValue<Ascii>>);

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(value) = &self.0 {
            request.metadata_mut().insert("authorization", value.clone());
        }
        Ok(request)
    }
}

/// A server's address and how to connect to it.
#[derive(Clone)]
pub(crate) struct Server {
    url: String,
    endpoint: Endpoint,
    bearer: Bearer,
    /// Time limit for the connection and the first answer.
    patience: Duration,
}

/// Default time limit for the connection and the first answer.
const PATIENCE: Duration = Duration::from_secs(10);

/// A connection that is silent for so long is pinged, and closed after a further [`PATIENCE`]. That is longer than a server
/// may stall.
const SILENCE: Duration = Duration::from_secs(5);

/// Bytes that may wait unread on a connection. The transport closes a connection when unread small messages, counted as 256
/// bytes each, fill half of it. This size allows a stall of 5 s with samples of several tools at 1 kHz.
const WINDOW_BYTES: u32 = 16 << 20;

impl std::fmt::Debug for Server {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.url)
    }
}

impl Server {
    /// The server at `url`; you may omit http://.
    pub(crate) fn new(url: &str, credentials: &Credentials) -> Result<Self, Failure> {
        let refuse = |why: &str| Failure::Refused(format!("--server {url}: {why}"));
        let url_text = if url.contains("://") { url.to_owned() } else { format!("http://{url}") };
        let uri: Uri = url_text.parse().map_err(|e: tonic::codegen::http::uri::InvalidUri| refuse(&e.to_string()))?;
        let secure = match uri.scheme_str() {
            Some("http") => false,
            Some("https") => true,
            _ => return Err(refuse("must begin with http:// or https://")),
        };
        let token = credentials.token()?;
        let host = uri.host().unwrap_or_default().trim_matches(['[', ']']).to_owned();
        let is_here = host == "localhost" || host.parse::<IpAddr>().is_ok_and(|address| address.is_loopback());
        if token.is_some() && !secure && !is_here {
            return Err(refuse("a token would be sent in the clear; the URL must begin with https://"));
        }
        let mut endpoint = Endpoint::from(uri)
            .tcp_nodelay(true)
            .initial_connection_window_size(WINDOW_BYTES)
            .http2_keep_alive_interval(SILENCE)
            .keep_alive_timeout(PATIENCE)
            .keep_alive_while_idle(true);
        if secure {
            endpoint = endpoint.tls_config(credentials.tls()?).map_err(|e| refuse(&root(&e)))?;
        } else if credentials.ca.is_some() || credentials.cert.is_some() || credentials.tls_name.is_some() {
            let why =
                "has no TLS, so --ca, --cert, --key and --tls-name mean nothing; the URL must begin with https://";
            return Err(refuse(why));
        }
        Ok(Server { url: url_text, endpoint, bearer: Bearer(token), patience: PATIENCE })
    }

    /// Sets the time limit for connecting.
    #[must_use]
    pub(crate) fn within(mut self, timeout: Duration) -> Self {
        self.patience = timeout;
        self
    }

    /// Connects and waits for a first answer: a listener that accepts connections and stays silent is an error.
    pub(crate) async fn connect(&self) -> Result<Channel, String> {
        let unreached = |why: String| format!("can't reach {}: {why}", self.url);
        let connecting = async {
            let channel = self.endpoint.connect().await.map_err(|e| unreached(in_words(&root(&e))))?;
            // Any answer will do, also a refusal.
            match HealthClient::new(channel.clone()).check(HealthCheckRequest::default()).await {
                Err(status) if status.source().is_some() => Err(unreached(broken(&status))),
                _ => Ok(channel),
            }
        };
        let within_s = self.patience.as_secs_f64();
        let silent = |_| unreached(format!("it accepts the connection but has not answered within {within_s} s"));
        let channel = tokio::time::timeout(self.patience, connecting).await.map_err(silent)??;
        Ok(InterceptedService::new(channel, self.bearer.clone()))
    }
}

/// The text that a program shows for a status: the server's message, or how the connection broke.
pub(crate) fn describe(status: &Status) -> String {
    if status.source().is_some() { broken(status) } else { error::describe(status) }
}

fn broken(status: &Status) -> String {
    let root = status.source().map_or_else(|| status.message().to_owned(), root);
    let hint = if root.contains("frame with invalid size") || root.contains("invalid HTTP version") {
        "; if it speaks TLS, the URL must begin with https://"
    } else {
        ""
    };
    format!("the connection broke: {}{hint}", in_words(&root))
}

/// The message of an error's innermost cause.
fn root(error: &(dyn std::error::Error + 'static)) -> String {
    let mut cause = error;
    while let Some(deeper) = cause.source() {
        cause = deeper;
    }
    cause.to_string()
}

/// Library errors in plain words.
fn in_words(said: &str) -> String {
    let known = [
        ("UnknownIssuer", "no authority that is trusted here has signed the server's certificate; --ca FILE adds one"),
        ("NotValidForName", "the server's certificate is for another name; give the expected one with --tls-name NAME"),
        ("Expired", "the server's certificate has expired"),
        ("CertificateRequired", "the server requires a client certificate: --cert FILE and --key FILE"),
        ("InvalidContentType", "it does not speak TLS; the URL may have to begin with http://"),
        ("too_many_data_frames", "a transport closed it: too many small messages waited unread"),
        ("excessive load", "the server's transport closed it: too many requests at once"),
        ("keep-alive timed out", "the other side was silent for too long"),
    ];
    known
        .iter()
        .find(|(name, _)| said.contains(name))
        .map_or_else(|| said.to_owned(), |(_, words)| format!("{words} ({said})"))
}

impl Credentials {
    fn token(&self) -> Result<Option<MetadataValue<Ascii>>, Failure> {
        let (text, place) = match (&self.token_file, std::env::var("PALPATE_TOKEN")) {
            (Some(path), _) => {
                warn_if_readable(path);
                (read("--token-file", path)?, path.display().to_string())
            }
            (None, Ok(text)) => (text, "PALPATE_TOKEN".to_owned()),
            (None, Err(_)) => return Ok(None),
        };
        let token = text.trim();
        // The message does not quote the token: it would appear in a log.
        let wrong = || Failure::Refused(format!("{place}: holds no token; `palpate token` makes one"));
        if token.is_empty() || token.contains(char::is_whitespace) {
            return Err(wrong());
        }
        let mut value: MetadataValue<Ascii> = format!("Bearer {token}").parse().map_err(|_| wrong())?;
        value.set_sensitive(true);
        Ok(Some(value))
    }

    fn tls(&self) -> Result<ClientTlsConfig, Failure> {
        let mut tls = ClientTlsConfig::new();
        tls = match &self.ca {
            Some(path) => tls.ca_certificate(Certificate::from_pem(read("--ca", path)?)),
            // tonic's own feature for this would make cargo build tonic twice, for the server and for the clients.
            None => {
                tls.trust_anchors(rustls_native_certs::load_native_certs().certs.iter().filter_map(|certificate| {
                    webpki::anchor_from_trusted_cert(certificate).map(|anchor| anchor.to_owned()).ok()
                }))
            }
        };
        if let Some(name) = &self.tls_name {
            tls = tls.domain_name(name);
        }
        if let (Some(cert), Some(key)) = (&self.cert, &self.key) {
            tls = tls.identity(Identity::from_pem(read("--cert", cert)?, read("--key", key)?));
        }
        Ok(tls)
    }
}

/// Warns if every user of this machine can read the token file.
fn warn_if_readable(path: &Path) {
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        if std::fs::metadata(path).is_ok_and(|meta| meta.permissions().mode() & 0o007 != 0) {
            let path = path.display();
            crate::say!(
                "palpate-client: warning: {path}: every user of this machine can read it; run `chmod o= {path}`"
            );
        }
    }
    #[cfg(not(unix))]
    let _ = path;
}

fn read(option: &str, path: &Path) -> Result<String, Failure> {
    std::fs::read_to_string(path)
        .map_err(|e| Failure::Refused(format!("{option} {}: can't be read: {e}", path.display())))
}
