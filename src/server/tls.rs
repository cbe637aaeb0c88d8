//! TLS and mutual TLS: the server's certificate, and the authorities of the client certificates that it accepts.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::server::WebPkiClientVerifier;
use tokio_rustls::rustls::{RootCertStore, ServerConfig};
use tracing::warn;

use super::reload::{Reloaded, of_file, warn_if_readable};
use super::validity;
use crate::refusal::{Reason, Refusal, Result};

/// The TLS configuration of new connections.
pub(super) struct Tls {
    pub(super) config: Arc<ServerConfig>,
    /// The file of each certificate, and when it expires, s since 1970.
    expiries: Vec<(PathBuf, i64)>,
}

/// The log warns of a certificate this long before it expires, s.
const NEAR_S: i64 = 14 * validity::DAY_S;

impl Tls {
    /// Logs a warning for each certificate that has expired or will soon.
    #[allow(clippy::disallowed_methods)]
    pub(super) fn warn_of_expiry(&self) {
        // Certificates expire by the wall clock.
        let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
        let now_s = i64::try_from(now.as_secs()).unwrap_or(i64::MAX);
        for (path, expires_s) in &self.expiries {
            let left_s = expires_s.saturating_sub(now_s);
            if left_s <= 0 {
                warn!("{}: the certificate has expired: clients refuse it", path.display());
            } else if left_s < NEAR_S {
                warn!("{}: the certificate expires in {} days", path.display(), left_s / validity::DAY_S);
            }
        }
    }
}

/// Loads the certificate chain `cert` and its key. With `client_ca`, clients must present a certificate that one of its
/// authorities has signed, or one of `node_ca`: those of the other servers of a fleet. With `node_ca` alone clients need none.
pub(super) fn load(cert: &Path, key: &Path, client_ca: Option<&Path>, node_ca: Option<&Path>) -> Result<Reloaded<Tls>> {
    warn_if_readable(key, "the private key");
    let mut paths = vec![cert.to_owned(), key.to_owned()];
    paths.extend(client_ca.into_iter().chain(node_ca).map(Path::to_owned));
    let (named, everyone) = (paths.clone(), client_ca.is_some());
    Reloaded::load("TLS", paths, move |texts| configure(&named, texts, everyone))
}

/// Of certificate, key and authorities. `everyone` needs a certificate of these, or only who wants to show one.
fn configure(paths: &[PathBuf], texts: &[String], everyone: bool) -> Result<Tls> {
    let unreadable = |what: &str| Refusal::new(Reason::Unreadable, "", what.to_owned());
    let chain = certificates(&paths[0], &texts[0])?;
    let mut expiries: Vec<_> = chain.iter().filter_map(|c| Some((paths[0].clone(), validity::expires_s(c)?))).collect();
    // The parser's error is dropped: no part of a key may appear in a log.
    let key = PrivateKeyDer::from_pem_slice(texts[1].as_bytes())
        .map_err(|_| of_file(&paths[1])(unreadable("is not a private key in PEM")))?;
    let provider = Arc::new(ring::default_provider());
    let builder = ServerConfig::builder_with_provider(provider.clone())
        .with_safe_default_protocol_versions()
        .map_err(|e| unreadable(&e.to_string()))?;
    let mut roots = RootCertStore::empty();
    for (path, text) in paths.iter().zip(texts).skip(2) {
        for certificate in certificates(path, text)? {
            expiries.extend(validity::expires_s(&certificate).map(|expires_s| (path.clone(), expires_s)));
            roots.add(certificate).map_err(|e| of_file(path)(unreadable(&e.to_string())))?;
        }
    }
    let builder = if roots.is_empty() {
        builder.with_no_client_auth()
    } else {
        let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider);
        let verifier = if everyone { verifier } else { verifier.allow_unauthenticated() };
        builder.with_client_cert_verifier(verifier.build().map_err(|e| unreadable(&e.to_string()))?)
    };
    let mut config = builder.with_single_cert(chain, key).map_err(|e| {
        let both = format!("can't be used with the key {}: {e}", paths[1].display());
        of_file(&paths[0])(unreadable(&both))
    })?;
    config.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
    let tls = Tls { config: Arc::new(config), expiries };
    tls.warn_of_expiry();
    Ok(tls)
}

fn certificates(path: &Path, text: &str) -> Result<Vec<CertificateDer<'static>>> {
    let read: std::result::Result<Vec<_>, _> = CertificateDer::pem_slice_iter(text.as_bytes()).collect();
    let refuse = |why: String| of_file(path)(Refusal::new(Reason::Unreadable, "", why));
    let certificates = read.map_err(|e| refuse(format!("is not a certificate in PEM: {e}")))?;
    if certificates.is_empty() { Err(refuse("has no certificate in PEM".into())) } else { Ok(certificates) }
}

/// The names in a client's certificate: DNS names and URIs of its `subjectAltName`. TLS has verified the chain before.
pub(super) fn names(chain: &[CertificateDer<'_>]) -> Vec<String> {
    let Some(certificate) = chain.first().and_then(|first| webpki::EndEntityCert::try_from(first).ok()) else {
        return Vec::new();
    };
    certificate.valid_dns_names().chain(certificate.valid_uri_names()).map(str::to_owned).collect()
}
