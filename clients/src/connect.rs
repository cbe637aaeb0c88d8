//! How every command reaches its server: in the clear, or by TLS, and with what shows who calls.

use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Certificate, ClientTlsConfig, Endpoint, Identity, Uri};
use tonic::{Request, Status};

use crate::Failure;

/// Who calls, and which servers are trusted.
#[derive(clap::Args, Debug, Clone, Default)]
#[command(next_help_heading = "Identity (a server on this machine mostly asks for none)")]
pub(crate) struct Credentials {
    /// The file of a token that the server knows [or the token itself in the environment variable PALPATE_TOKEN]
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Certificates (PEM) to trust for an https URL, instead of the system's
    #[arg(long, value_name = "FILE")]
    ca: Option<PathBuf>,
    /// The name that the server's certificate must be of, if it is not that of the URL
    #[arg(long, value_name = "NAME")]
    tls_name: Option<String>,
    /// The client's own certificate (PEM), if the server asks for one
    #[arg(long, value_name = "FILE", requires = "key")]
    cert: Option<PathBuf>,
    /// Its private key (PEM)
    #[arg(long, value_name = "FILE", requires = "cert")]
    key: Option<PathBuf>,
}

/// A connection whose calls all show the token, if there is one.
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

/// A server, and how to reach it.
#[derive(Clone)]
pub(crate) struct Server {
    url: String,
    endpoint: Endpoint,
    bearer: Bearer,
}

impl std::fmt::Debug for Server {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.url)
    }
}

impl Server {
    /// The server at `url`; http:// may be left out.
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
        let mut endpoint = Endpoint::from(uri).tcp_nodelay(true).connect_timeout(Duration::from_secs(10));
        if secure {
            endpoint = endpoint.tls_config(credentials.tls()?).map_err(|e| refuse(&causes(&e)))?;
        } else if credentials.ca.is_some() || credentials.cert.is_some() || credentials.tls_name.is_some() {
            let why =
                "has no TLS, so --ca, --cert, --key and --tls-name mean nothing; the URL must begin with https://";
            return Err(refuse(why));
        }
        Ok(Server { url: url_text, endpoint, bearer: Bearer(token) })
    }

    /// Gives up connecting after `timeout`.
    #[must_use]
    pub(crate) fn within(mut self, timeout: Duration) -> Self {
        self.endpoint = self.endpoint.connect_timeout(timeout);
        self
    }

    /// Connects.
    pub(crate) async fn connect(&self) -> Result<Channel, String> {
        let connected = self.endpoint.connect().await;
        let channel = connected.map_err(|e| format!("can't reach {}: {}", self.url, causes(&e)))?;
        Ok(InterceptedService::new(channel, self.bearer.clone()))
    }
}

/// What an error says at its root.
fn causes(error: &tonic::transport::Error) -> String {
    let mut cause: &dyn std::error::Error = error;
    while let Some(deeper) = cause.source() {
        cause = deeper;
    }
    cause.to_string()
}

impl Credentials {
    fn token(&self) -> Result<Option<MetadataValue<Ascii>>, Failure> {
        let (text, place) = match (&self.token_file, std::env::var("PALPATE_TOKEN")) {
            (Some(path), _) => (read("--token-file", path)?, path.display().to_string()),
            (None, Ok(text)) => (text, "PALPATE_TOKEN".to_owned()),
            (None, Err(_)) => return Ok(None),
        };
        let token = text.trim();
        // What is wrong with it is not said: it would show in a log.
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
            // Not by a feature of tonic: it would have the server built with another tonic than the clients.
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

fn read(option: &str, path: &Path) -> Result<String, Failure> {
    std::fs::read_to_string(path)
        .map_err(|e| Failure::Refused(format!("{option} {}: can't be read: {e}", path.display())))
}
