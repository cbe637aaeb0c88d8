//! Connections to a server: plain or TLS, with the caller's credentials.

use std::error::Error as _;
use std::future::Future;
use std::net::IpAddr;
use std::pin::Pin;
use std::time::Duration;

use palpate_refusal::printable::printable;
use palpate_refusal::status;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Certificate, ClientTlsConfig, Endpoint, Identity, Uri};
use tonic::{Request, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

use crate::Error;

/// The caller's credentials, and the certificates it trusts. The default has no credentials, and trusts the
/// authorities of the system. All but `token` require a URL with https://.
#[derive(Debug, Clone, Default)]
pub struct Credentials {
    /// Your token, sent with each call: only over TLS, or to `localhost` or a loopback address.
    pub token: Option<Token>,
    /// Certificates of authorities (PEM, one or more) to trust instead of the system's.
    pub ca: Option<String>,
    /// Name that the server's certificate must be for; `None`: the host of the URL.
    pub tls_name: Option<String>,
    /// Your client certificate, and its private key (both PEM), if the server requires one.
    pub cert_and_key: Option<(String, String)>,
}

impl Credentials {
    /// Checks that each certificate and key that is present contains the first line of a PEM block of its kind. The
    /// contents of the blocks are not read.
    ///
    /// # Errors
    /// Returns [`Error::Argument`] that begins with the name of the first wrong part: `ca`, `cert` or `key`.
    pub fn check(&self) -> Result<(), Error> {
        let (cert, key) = self.cert_and_key.as_ref().map(|(cert, key)| (cert, key)).unzip();
        let of = |name, what, begin, text: Option<&String>| match text {
            Some(text) if !text.contains(begin) => {
                Err(Error::Argument(format!("{name}: has no {what} in PEM (-----BEGIN {begin})")))
            }
            _ => Ok(()),
        };
        of("ca", "certificate", "CERTIFICATE-----", self.ca.as_ref())?;
        of("cert", "certificate", "CERTIFICATE-----", cert)?;
        // There are several kinds: `RSA PRIVATE KEY` and others.
        of("key", "private key", "PRIVATE KEY-----", key)?;
        Ok(())
    }
}

/// A token that authenticates the caller; `palpate token` creates one. `Debug` does not show it.
#[derive(Clone)]
pub struct Token(MetadataValue<Ascii>);

impl Token {
    /// Parses a token; surrounding space is ignored. Only a server can say whether it is valid.
    ///
    /// # Errors
    /// Returns [`Error::Argument`] if the text is empty, has space within it, or has characters that a header of HTTP
    /// can't contain. The message does not quote the text, since it might appear in a log.
    pub fn new(text: &str) -> Result<Self, Error> {
        let token = text.trim();
        let wrong = || Error::Argument("holds no token; `palpate token` makes one".to_owned());
        if token.is_empty() || token.contains(char::is_whitespace) {
            return Err(wrong());
        }
        let mut value: MetadataValue<Ascii> = format!("Bearer {token}").parse().map_err(|_| wrong())?;
        value.set_sensitive(true);
        Ok(Token(value))
    }
}

impl std::fmt::Debug for Token {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Token")
    }
}

/// A connection of [`Server::connect`], which adds the token, if there is one, to each call. The clients of
/// `palpate_proto::pb` take it. Clones share the connection, which closes when the last one is dropped.
pub type Channel = InterceptedService<tonic::transport::Channel, Bearer>;

/// The part of a [`Channel`] that adds the token, if there is one, to each call as header `authorization`.
#[derive(Debug, Clone)]
pub struct Bearer(Option<Token>);

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(Token(value)) = &self.0 {
            request.metadata_mut().insert("authorization", value.clone());
        }
        Ok(request)
    }
}

/// A server's address, the credentials for it, and the time limit for connecting. It is not a connection:
/// [`Server::connect`] opens one.
///
/// The URL tells how to connect, and nothing is sent yet. A token is not sent in the clear to another machine:
///
/// ```
/// use palpate_client::{Credentials, Server, Token};
///
/// let here = Server::new("127.0.0.1:7117", &Credentials::default())?;
/// assert_eq!((here.url(), here.host()), ("http://127.0.0.1:7117", "127.0.0.1"));
///
/// let credentials = Credentials { token: Some(Token::new("of-a-surgeon")?), ..Credentials::default() };
/// let error = Server::new("http://server.example:7117", &credentials).expect_err("it has no TLS");
/// assert!(error.is_refusal());
/// println!("{error}");
/// # Ok::<(), palpate_client::Error>(())
/// ```
///
/// With a server there, `here.connect().await?` is a channel for the clients of `palpate_proto::pb`.
#[derive(Clone)]
pub struct Server {
    url: String,
    endpoint: Endpoint,
    bearer: Bearer,
    /// Used for other servers of its fleet.
    credentials: Credentials,
    /// Time limit for the connection and the first answer.
    patience: Duration,
    is_secure: bool,
    /// Host and port.
    host: (String, u16),
}

/// Default time limit for the connection and the first answer.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(10);

/// Time without data after which a connection is pinged; it is closed after a further [`CONNECT_TIMEOUT`]. That is
/// longer than a server may stall.
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
    /// Creates a server at `url`; http:// may be omitted. The default port is 80 with http:// and 443 with https://.
    /// The time limit for connecting is 10 s ([`Server::within`]). Does not connect.
    ///
    /// # Errors
    /// Returns [`Error::Argument`] with the errors of [`Credentials::check`], if the URL is not valid or has another
    /// scheme, if a token would be sent unencrypted to another machine, if the URL has no TLS although the credentials
    /// have anything but a token, or if a certificate or key can't be read.
    pub fn new(url: &str, credentials: &Credentials) -> Result<Self, Error> {
        credentials.check()?;
        let refuse = |why: &str| Error::Argument(format!("{url}: {why}"));
        let url_text = if url.contains("://") { url.to_owned() } else { format!("http://{url}") };
        let uri = url_text.parse::<Uri>().map_err(|e| refuse(&e.to_string()))?;
        let secure = match uri.scheme_str() {
            Some("http") => false,
            Some("https") => true,
            _ => return Err(refuse("must begin with http:// or https://")),
        };
        let host = uri.host().unwrap_or_default().trim_matches(['[', ']']).to_owned();
        let port = uri.port_u16().unwrap_or(if secure { 443 } else { 80 });
        let is_here = host == "localhost" || host.parse::<IpAddr>().is_ok_and(|address| address.is_loopback());
        if credentials.token.is_some() && !secure && !is_here {
            return Err(refuse("a token would be sent in the clear; the URL must begin with https://"));
        }
        let mut endpoint = Endpoint::from(uri)
            .tcp_nodelay(true)
            .initial_connection_window_size(WINDOW_BYTES)
            .http2_keep_alive_interval(SILENCE)
            .keep_alive_timeout(CONNECT_TIMEOUT)
            .keep_alive_while_idle(true);
        if secure {
            endpoint = endpoint.tls_config(tls(credentials)).map_err(|e| refuse(&root(&e)))?;
        } else if credentials.ca.is_some() || credentials.cert_and_key.is_some() || credentials.tls_name.is_some() {
            let why = "has no TLS, so certificates and their names mean nothing; the URL must begin with https://";
            return Err(refuse(why));
        }
        let bearer = Bearer(credentials.token.clone());
        Ok(Server {
            url: url_text.trim_end_matches('/').to_owned(),
            endpoint,
            bearer,
            credentials: credentials.clone(),
            patience: CONNECT_TIMEOUT,
            is_secure: secure,
            host: (host, port),
        })
    }

    /// Creates the server at `url`, another one of the same fleet, with the credentials and time limit of this one.
    /// Does not connect.
    ///
    /// # Errors
    /// Returns the errors of [`Server::new`], and [`Error::Argument`] if this server is reached by TLS and the other
    /// is not.
    pub fn at(&self, url: &str) -> Result<Self, Error> {
        if url.trim_end_matches('/') == self.url {
            return Ok(self.clone());
        }
        let other = Server::new(url, &self.credentials)?;
        if self.is_secure && !other.is_secure {
            let why = "has no TLS, but the server that names it has; the fleet's servers must advertise https://";
            return Err(Error::Argument(format!("{url}: {why}")));
        }
        Ok(other.within(self.patience))
    }

    /// Returns the server's URL, with its scheme and without a slash at its end.
    pub fn url(&self) -> &str {
        &self.url
    }

    /// Returns the time limit for connecting.
    pub(crate) fn patience(&self) -> Duration {
        self.patience
    }

    /// Returns the host of the URL without its port, and without the brackets of an IPv6 address.
    pub fn host(&self) -> &str {
        &self.host.0
    }

    /// Returns this server with another time limit for connecting and the first answer; the default is 10 s. It also
    /// limits how long [`crate::fleet`] searches for a session.
    #[must_use]
    pub fn within(mut self, timeout: Duration) -> Self {
        self.patience = timeout;
        self
    }

    /// Connects and waits for a first answer, at most for the time limit ([`Server::within`]). Any answer counts, even
    /// a refusal: invalid credentials are noticed only by a call. The connection is pinged every 5 s without data, and
    /// closed if the server then stays silent for another 10 s.
    ///
    /// # Errors
    /// Returns [`Error::Connection`] that explains why the server can't be reached: no connection, no answer in time,
    /// a certificate that is not trusted, or the other scheme, http:// or https://. In the last case it may take a
    /// second longer.
    pub fn connect(&self) -> Pin<Box<dyn Future<Output = Result<Channel, Error>> + Send + '_>> {
        // Boxed so that it is compiled here, once, and not in every program that connects.
        Box::pin(async move {
            let unreached = |why: String| Error::Connection(format!("can't reach {}: {why}", self.url));
            let connecting = async {
                let channel = self.endpoint.connect().await.map_err(|e| (root(&e), in_words(&root(&e))))?;
                // Any answer is sufficient, even a refusal.
                match HealthClient::new(channel.clone()).check(HealthCheckRequest::default()).await {
                    Err(status) if status.source().is_some() => Err((root(&status), broken(&status))),
                    _ => Ok(channel),
                }
            };
            let within_s = self.patience.as_secs_f64();
            let silent = |_| unreached(format!("it accepts the connection but has not answered within {within_s} s"));
            let connected = tokio::time::timeout(self.patience, connecting).await.map_err(silent)?;
            let channel = match connected {
                Ok(channel) => channel,
                Err((root, _)) if self.is_secure && root.contains("InvalidContentType") => {
                    return Err(Error::Connection(self.other_scheme("does not speak TLS", "https", "http")));
                }
                Err((_, why)) => {
                    let speaks_tls = !self.is_secure && speaks_tls(&self.host).await;
                    let wrong = || Error::Connection(self.other_scheme("speaks TLS", "http", "https"));
                    return Err(if speaks_tls { wrong() } else { unreached(why) });
                }
            };
            Ok(InterceptedService::new(channel, self.bearer.clone()))
        })
    }

    /// Returns the message for a URL whose scheme is not that of the server.
    fn other_scheme(&self, does: &str, from: &str, to: &str) -> String {
        let address = self.url.trim_start_matches(from).trim_start_matches("://").trim_end_matches('/');
        format!("can't reach {}: the server at {address} {does}: use {to}://{address}", self.url)
    }
}

/// Returns whether a server speaks TLS: it answers other data with an alert of TLS.
async fn speaks_tls((host, port): &(String, u16)) -> bool {
    const ALERT: [u8; 2] = [0x15, 0x03];
    const TLS_PROBE_TIMEOUT: Duration = Duration::from_secs(1);
    let asked = async {
        let mut stream = tokio::net::TcpStream::connect((host.as_str(), *port)).await?;
        stream.write_all(b"GET / HTTP/1.0\r\n\r\n").await?;
        let mut answer = [0; 2];
        stream.read_exact(&mut answer).await?;
        Ok::<bool, std::io::Error>(answer == ALERT)
    };
    matches!(tokio::time::timeout(TLS_PROBE_TIMEOUT, asked).await, Ok(Ok(true)))
}

/// Returns the text that a program shows for a status, one line without control characters: the server's message, or
/// how the connection broke if the status did not come from a server.
pub fn describe(status: &Status) -> String {
    if status.source().is_some() { broken(status) } else { status::describe(status) }
}

fn broken(status: &Status) -> String {
    let root = status.source().map_or_else(|| status.message().to_owned(), root);
    let hint = if root.contains("frame with invalid size") || root.contains("invalid HTTP version") {
        "; if it speaks TLS, the URL must begin with https://"
    } else {
        ""
    };
    printable(format_args!("the connection broke: {}{hint}", in_words(&root)))
}

/// Returns the message of an error's innermost cause.
fn root(error: &(dyn std::error::Error + 'static)) -> String {
    let mut cause = error;
    while let Some(deeper) = cause.source() {
        cause = deeper;
    }
    cause.to_string()
}

/// Explains known errors of libraries.
fn in_words(said: &str) -> String {
    let known = [
        (
            "UnknownIssuer",
            "no authority that is trusted here has signed the server's certificate; the option `ca` adds one",
        ),
        (
            "NotValidForName",
            "the server's certificate is for another name; the option `tls-name` gives the expected one",
        ),
        ("Expired", "the server's certificate has expired"),
        ("CertificateRequired", "the server requires a client certificate: the options `cert` and `key`"),
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

/// Builds the configuration of TLS.
fn tls(credentials: &Credentials) -> ClientTlsConfig {
    let mut tls = ClientTlsConfig::new();
    tls = match &credentials.ca {
        Some(pem) => tls.ca_certificate(Certificate::from_pem(pem)),
        // tonic's own feature for this would make cargo build tonic twice, for the server and for the clients.
        None => tls.trust_anchors(rustls_native_certs::load_native_certs().certs.iter().filter_map(|certificate| {
            webpki::anchor_from_trusted_cert(certificate).map(|anchor| anchor.to_owned()).ok()
        })),
    };
    if let Some(name) = &credentials.tls_name {
        tls = tls.domain_name(name);
    }
    if let Some((cert, key)) = &credentials.cert_and_key {
        tls = tls.identity(Identity::from_pem(cert, key));
    }
    tls
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_without_a_certificate_or_key_is_refused_by_its_name() {
        let junk = || "v 0 0 0\n".to_owned();
        let cert = "-----BEGIN CERTIFICATE-----\n*\n-----END CERTIFICATE-----\n".to_owned();
        for (credentials, told) in [
            (Credentials { ca: Some(junk()), ..Credentials::default() }, "ca: has no certificate in PEM"),
            (Credentials { ca: Some(String::new()), ..Credentials::default() }, "ca: has no certificate in PEM"),
            (
                Credentials { cert_and_key: Some((junk(), junk())), ..Credentials::default() },
                "cert: has no certificate",
            ),
            (Credentials { cert_and_key: Some((cert, junk())), ..Credentials::default() }, "key: has no private key"),
        ] {
            let refused = Server::new("https://localhost:7117", &credentials).unwrap_err().to_string();
            assert!(refused.starts_with(told), "{refused}");
        }
    }

    #[test]
    fn another_server_is_called_with_the_same_credentials_but_never_in_the_clear() {
        let token = Some(Token::new("secret").unwrap());
        let trusted = Credentials { token, ..Credentials::default() };
        let here = Server::new("http://127.0.0.1:7117/", &trusted).unwrap().within(Duration::from_secs(3));
        let there = here.at("http://localhost:7118").unwrap();
        assert_eq!((there.url(), there.patience()), ("http://localhost:7118", Duration::from_secs(3)));
        assert!(there.bearer.0.is_some());
        assert!(here.at("https://far.example:7117").is_ok());
        assert!(here.at("http://far.example:7117").unwrap_err().to_string().contains("in the clear"));
        // Nobody who is called by TLS sends a client to where there is none.
        for credentials in [trusted, Credentials::default()] {
            let secure = Server::new("https://far.example:7117", &credentials).unwrap();
            assert!(secure.at("http://127.0.0.1:7117").unwrap_err().is_refusal());
            assert_eq!(secure.at("https://far.example:7117/").unwrap().url(), "https://far.example:7117");
        }
    }
}
