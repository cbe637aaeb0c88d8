//! TLS and mutual TLS: the server's certificate, and the authorities of the client certificates that it accepts.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::server::WebPkiClientVerifier;
use tokio_rustls::rustls::{RootCertStore, ServerConfig};
use tracing::warn;

use super::reload::{Reloaded, of_file, warn_if_readable};
use super::validity::{self, DAY_S};
use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::lock::lock;

/// The TLS configuration of new connections, and when its certificates expire.
pub(super) struct Tls {
    pub(super) config: Arc<ServerConfig>,
    pub(super) expiries: Expiries,
}

/// When the certificates of some files expire.
pub(super) struct Expiries(Mutex<Vec<Expiry>>);

/// A certificate's expiry, and how urgently the log warned of it.
struct Expiry {
    path: PathBuf,
    /// s since 1970.
    at_s: i64,
    /// Number of the thresholds in [`URGENT_S`] that had been passed at the last check.
    urgency: usize,
}

/// Remaining times below which a warning becomes more urgent, s.
const URGENT_S: [i64; 4] = [14 * DAY_S, DAY_S, 3600, 0];

impl Expiry {
    /// Returns the text of a warning if it has become more urgent since the last call.
    fn news(&mut self, now_s: i64) -> Option<String> {
        let left_s = self.at_s.saturating_sub(now_s);
        let urgency = URGENT_S.iter().filter(|urgent_s| left_s <= **urgent_s).count();
        let was = std::mem::replace(&mut self.urgency, urgency);
        let news = match left_s {
            ..=0 => "has expired: the other side refuses it".to_owned(),
            1..3600 => format!("expires in {} min", (left_s + 59) / 60),
            3600..DAY_S => format!("expires in {} h", left_s / 3600),
            DAY_S.. => format!("expires in {} days", left_s / DAY_S),
        };
        (urgency > was).then_some(news)
    }
}

/// Returns the wall-clock time, s since 1970: certificates expire by it.
#[allow(clippy::disallowed_methods)]
fn unix_s() -> i64 {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
    i64::try_from(now.as_secs()).unwrap_or(i64::MAX)
}

impl Expiries {
    /// Logs a warning for each certificate that has expired or expires soon: when it has become more urgent, or if
    /// `again` is set.
    pub(super) fn warn(&self, again: bool) {
        let now_s = unix_s();
        for expiry in lock(&self.0).iter_mut() {
            if again {
                expiry.urgency = 0;
            }
            if let Some(news) = expiry.news(now_s) {
                warn!("{}: the certificate {news}", expiry.path.display());
            }
        }
    }
}

/// Loads the certificate chain `cert` and its key. With `client_ca`, clients must present a certificate signed by one
/// of its authorities or of `node_ca`, the authorities of the other servers of the fleet. With `node_ca` alone
/// clients need none.
pub(super) fn load(cert: &Path, key: &Path, client_ca: Option<&Path>, node_ca: Option<&Path>) -> Result<Reloaded<Tls>> {
    warn_if_readable(key, "the private key");
    let mut paths = vec![cert.to_owned(), key.to_owned()];
    paths.extend(client_ca.into_iter().chain(node_ca).map(Path::to_owned));
    let (named, everyone) = (paths.clone(), client_ca.is_some());
    Reloaded::load("TLS", paths, move |texts| configure(&named, texts, everyone))
}

/// Builds the configuration from the texts of certificate, key and authorities. If `everyone` is set, all clients
/// must present a certificate of these authorities; otherwise only those that want to.
fn configure(paths: &[PathBuf], texts: &[String], everyone: bool) -> Result<Tls> {
    let unreadable = |what: &str| Refusal::new(Reason::Unreadable, "", what.to_owned());
    let chain = certificates(&paths[0], &texts[0])?;
    let mut expiries: Vec<_> = chain.iter().filter_map(|certificate| expiry(&paths[0], certificate)).collect();
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
            expiries.extend(expiry(path, &certificate));
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
    let tls = Tls { config: Arc::new(config), expiries: Expiries(Mutex::new(expiries)) };
    tls.expiries.warn(true);
    Ok(tls)
}

/// Returns when a certificate expires; `None` if it can't be parsed.
fn expiry(path: &Path, certificate: &CertificateDer<'_>) -> Option<Expiry> {
    Some(Expiry { path: path.to_owned(), at_s: validity::expires_s(certificate)?, urgency: 0 })
}

/// Loads when the certificates in `paths` expire, which the server presents to others or verifies them by.
///
/// # Errors
/// Refuses a file without certificates in PEM.
pub(super) fn load_expiries(name: &'static str, paths: Vec<PathBuf>) -> Result<Reloaded<Expiries>> {
    let named = paths.clone();
    Reloaded::load(name, paths, move |texts| {
        let mut expiries = Vec::new();
        for (path, text) in named.iter().zip(texts) {
            expiries.extend(certificates(path, text)?.iter().filter_map(|certificate| expiry(path, certificate)));
        }
        let expiries = Expiries(Mutex::new(expiries));
        expiries.warn(true);
        Ok(expiries)
    })
}

fn certificates(path: &Path, text: &str) -> Result<Vec<CertificateDer<'static>>> {
    let read: std::result::Result<Vec<_>, _> = CertificateDer::pem_slice_iter(text.as_bytes()).collect();
    let refuse = |why: String| of_file(path)(Refusal::new(Reason::Unreadable, "", why));
    let certificates = read.map_err(|e| refuse(format!("is not a certificate in PEM: {e}")))?;
    if certificates.is_empty() { Err(refuse("has no certificate in PEM".into())) } else { Ok(certificates) }
}

/// Returns the names in a client's certificate: DNS names and URIs of its `subjectAltName`. TLS has already verified
/// the chain.
pub(super) fn names(chain: &[CertificateDer<'_>]) -> Vec<String> {
    let Some(certificate) = chain.first().and_then(|first| webpki::EndEntityCert::try_from(first).ok()) else {
        return Vec::new();
    };
    certificate.valid_dns_names().chain(certificate.valid_uri_names()).map(str::to_owned).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_certificate_is_warned_of_when_it_becomes_more_urgent() {
        let mut expiry = Expiry { path: PathBuf::new(), at_s: 100 * DAY_S, urgency: 0 };
        let mut told = Vec::new();
        // One check per minute, as the server does.
        for minute in 0..101 * 24 * 60 {
            told.extend(expiry.news(60 * minute));
        }
        let expired = "has expired: the other side refuses it";
        assert_eq!(told, ["expires in 14 days", "expires in 1 days", "expires in 1 h", expired].map(str::to_owned));
        // A clock that is set back and then forward again.
        assert_eq!(expiry.news(0), None);
        assert_eq!(expiry.news(99 * DAY_S + 3600 * 23 + 60 * 30), Some("expires in 30 min".to_owned()));
        assert_eq!(expiry.news(200 * DAY_S), Some(expired.to_owned()));
        assert_eq!(expiry.news(201 * DAY_S), None);
    }

    #[test]
    fn certificates_for_others_are_watched_as_well_and_replaced_ones_count() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("etcd.pem");
        let write = |year| {
            let mut params = rcgen::CertificateParams::default();
            params.not_after = rcgen::date_time_ymd(year, 1, 1);
            let certificate = params.self_signed(&rcgen::KeyPair::generate().unwrap()).unwrap();
            std::fs::write(&path, certificate.pem()).unwrap();
        };
        write(2024);
        let expiries = load_expiries("certificates for etcd", vec![path.clone()]).unwrap();
        assert_eq!(lock(&expiries.get().0)[0].at_s, 1_704_067_200);
        // Reported when it was loaded.
        assert_eq!(lock(&expiries.get().0)[0].news(1_704_067_200), None);
        write(2049);
        let later = load_expiries("certificates for etcd", vec![path.clone()]).unwrap();
        assert_eq!(lock(&later.get().0)[0].at_s, 2_493_072_000);
        std::fs::write(&path, "no certificate").unwrap();
        assert!(load_expiries("certificates for etcd", vec![path]).is_err());
    }
}
