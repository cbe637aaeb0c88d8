//! A server's protection: TLS and credentials. A server that other machines can reach does not start without both.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use super::config::Config;
use super::identity::KnownCallers;
use super::reload::{Reloaded, of_file, warn_if_readable};
use super::tls::{self, Expiries, Tls};
use palpate_refusal::{Reason, Refusal, Result};

/// Interval between two checks of when certificates expire.
const MINUTE: Duration = Duration::from_secs(60);

/// Interval, in minutes, at which the warning of an upcoming expiry is repeated.
const MINUTES_OF_DAY: u32 = 24 * 60;

/// TLS and the known callers of one server, both reloaded when their files change.
pub(super) struct Protection {
    pub(super) tls: Option<Arc<Reloaded<Tls>>>,
    /// When the certificates for etcd expire.
    etcd: Arc<Reloaded<Expiries>>,
    pub(super) credentials: Arc<Reloaded<KnownCallers>>,
}

impl Protection {
    /// Reads the files that the configuration names.
    ///
    /// # Errors
    /// Refuses an invalid configuration or file, and an unprotected address that other machines can reach.
    pub(super) fn load(config: &Config, address: SocketAddr) -> Result<Self> {
        config.check()?;
        let tls = match (&config.tls_cert, &config.tls_key) {
            (Some(cert), Some(key)) => {
                let node_ca = config.cluster.ca.as_deref().filter(|_| config.cluster.is_on());
                Some(Arc::new(tls::load(cert, key, config.tls_client_ca.as_deref(), node_ca)?))
            }
            _ => None,
        };
        let certified = config.tls_client_ca.is_some();
        let known = certified || config.tokens.is_some();
        if !(config.insecure || address.ip().is_loopback() || (tls.is_some() && known)) {
            let message = format!(
                "other machines can reach {address}, and the server {}. Either protect it with --tls-cert FILE and \
                 --tls-key FILE, and with --tokens FILE or --tls-client-ca FILE (see `palpate serve --help`), or pass \
                 --insecure: then everyone who can reach it may do everything, and the network can read it all",
                match (tls.is_some(), known) {
                    (false, false) => "has neither TLS nor tokens",
                    (false, true) => "has no TLS, so tokens would be sent in the clear",
                    _ => "does not authenticate callers",
                }
            );
            return Err(Refusal::new(Reason::OutOfRange, "listen", message));
        }
        let paths = config.tokens.iter().cloned().collect();
        let tokens = config.tokens.clone();
        if let Some(path) = &tokens {
            warn_if_readable(path, "the hashes of tokens");
        }
        let credentials = Reloaded::load("tokens", paths, move |texts| match (&tokens, texts) {
            (Some(path), [text]) => KnownCallers::parse(path, text).map_err(|refusal| match refusal.place {
                Some(_) => refusal,
                None => of_file(path)(refusal),
            }),
            _ if certified => Ok(KnownCallers::certified()),
            _ => Ok(KnownCallers::open()),
        })?;
        let cluster = &config.cluster;
        let etcd = [&cluster.etcd_ca, &cluster.etcd_cert].into_iter().flatten().cloned();
        let etcd = Arc::new(tls::load_expiries("certificates for etcd", etcd.collect())?);
        Ok(Protection { tls, etcd, credentials: Arc::new(credentials) })
    }

    /// Returns the scheme of the server's URLs.
    pub(super) fn scheme(&self) -> &'static str {
        if self.tls.is_some() { "https" } else { "http" }
    }

    /// Reloads files that change, and warns of certificates that expire. Never completes.
    pub(super) async fn watch(&self) {
        let tls = async {
            let Some(tls) = &self.tls else { return std::future::pending().await };
            tls.clone().watch().await;
        };
        let warning = async {
            for minute in 1u32.. {
                tokio::time::sleep(MINUTE).await;
                let again = minute % MINUTES_OF_DAY == 0;
                self.tls.iter().for_each(|tls| tls.get().expiries.warn(again));
                self.etcd.get().warn(again);
            }
        };
        tokio::join!(tls, warning, self.etcd.clone().watch(), self.credentials.clone().watch());
    }
}
