//! How to reach etcd: endpoints, certificates, and the user.

use std::net::IpAddr;
use std::path::{Path, PathBuf};

use tonic::transport::{Certificate, ClientTlsConfig, Identity, Uri};

use super::error::{EtcdError, EtcdResult};
use palpate_tissue::files;

/// Limit of endpoints: etcd itself advises at most seven members.
const MAX_ENDPOINTS: usize = 16;

/// Addresses and credentials for etcd. The struct holds no secret: passwords and keys are read from their files when
/// a connection needs them, so a changed file takes effect at the next connection. [`Etcd::open`](super::Etcd::open)
/// checks it.
#[derive(Debug, Clone, Default)]
pub struct EtcdOptions {
    /// Addresses of the members for clients, `http://HOST:PORT` or `https://HOST:PORT` without path and user; 1 to
    /// 16.
    pub endpoints: Vec<String>,
    /// File of the certificates (PEM) of the authorities that signed the members' certificates; required with
    /// `https://`, refused without it.
    pub ca: Option<PathBuf>,
    /// File of this client's certificate (PEM), if etcd requires one; together with `key`, and only with `https://`.
    pub certificate: Option<PathBuf>,
    /// File of the private key (PEM) of `certificate`.
    pub key: Option<PathBuf>,
    /// User name, if etcd requires passwords; together with `password_file`. Endpoints of other machines must then
    /// begin with `https://`.
    pub user: Option<String>,
    /// File of the password, UTF-8 and not empty. Line breaks at its end are ignored.
    pub password_file: Option<PathBuf>,
}

impl EtcdOptions {
    /// Returns the endpoints, if all options fit together and the files can be read.
    pub(super) fn checked(&self) -> EtcdResult<Vec<Uri>> {
        let refuse = |why: String| Err(EtcdError::Refused(why));
        if self.endpoints.is_empty() || self.endpoints.len() > MAX_ENDPOINTS {
            return refuse(format!("name 1 to {MAX_ENDPOINTS} endpoints of etcd, not {}", self.endpoints.len()));
        }
        let uris: Vec<Uri> = self.endpoints.iter().map(|url| self.endpoint(url)).collect::<EtcdResult<_>>()?;
        let tls = uris.iter().any(is_secure);
        if !tls && (self.ca.is_some() || self.certificate.is_some() || self.key.is_some()) {
            return refuse(
                "certificates mean nothing at http://: the endpoints of etcd must begin with https://".into(),
            );
        }
        if tls {
            self.tls().map_err(EtcdError::Refused)?;
        }
        if self.user.is_some() != self.password_file.is_some() {
            return refuse("a user of etcd and the file of its password belong together: give both or neither".into());
        }
        if self.user.is_some() {
            self.password().map_err(EtcdError::Refused)?;
        }
        Ok(uris)
    }

    fn endpoint(&self, url: &str) -> EtcdResult<Uri> {
        // A text that can't be parsed is not quoted if it may contain a password.
        let quoted = if url.contains('@') { "an endpoint of etcd" } else { url };
        let refuse = |why: &str| EtcdError::Refused(format!("{quoted}: {why}"));
        let uri: Uri =
            url.parse().map_err(|_| refuse("is not an address; write http://HOST:PORT or https://HOST:PORT"))?;
        let is_whole = uri.authority().is_some_and(|authority| !authority.as_str().contains('@'));
        if !matches!(uri.scheme_str(), Some("http" | "https"))
            || !is_whole
            || uri.path() != "/"
            || uri.query().is_some()
        {
            return Err(refuse("write http://HOST:PORT or https://HOST:PORT; a user has options of its own"));
        }
        let is_here = uri.host().is_some_and(|host| {
            let host = host.trim_matches(['[', ']']);
            host == "localhost" || host.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
        });
        if self.user.is_some() && !is_secure(&uri) && !is_here {
            return Err(refuse("the password would be sent in the clear; the endpoint must begin with https://"));
        }
        Ok(uri)
    }

    /// Returns the TLS configuration from the files as they are now.
    pub(super) fn tls(&self) -> std::result::Result<ClientTlsConfig, String> {
        let Some(ca) = &self.ca else {
            return Err("https:// needs the certificates of etcd's authorities: name the file that has them".into());
        };
        let tls = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(read(ca)?));
        match (&self.certificate, &self.key) {
            (Some(certificate), Some(key)) => Ok(tls.identity(Identity::from_pem(read(certificate)?, read(key)?))),
            (None, None) => Ok(tls),
            _ => Err("a certificate for etcd and its private key belong together: give both or neither".into()),
        }
    }

    /// Returns the password from the file as it is now; empty if no file is named.
    pub(super) fn password(&self) -> std::result::Result<String, String> {
        let Some(path) = &self.password_file else { return Ok(String::new()) };
        let text =
            String::from_utf8(read(path)?).map_err(|_| format!("{}: the password must be UTF-8", path.display()))?;
        let password = text.trim_end_matches(['\n', '\r']);
        if password.is_empty() {
            return Err(format!("{}: has no password of etcd in it", path.display()));
        }
        Ok(password.to_owned())
    }
}

/// Returns whether an endpoint uses TLS.
pub(super) fn is_secure(uri: &Uri) -> bool {
    uri.scheme_str() == Some("https")
}

fn read(path: &Path) -> std::result::Result<Vec<u8>, String> {
    files::read_regular(path, files::MAX_SECRET_BYTES).map_err(|refusal| refusal.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(options: &EtcdOptions) -> String {
        options.checked().unwrap_err().to_string()
    }

    #[test]
    fn options_that_do_not_fit_together_are_refused() {
        let at = |url: &str| EtcdOptions { endpoints: vec![url.to_owned()], ..Default::default() };
        assert!(at("http://127.0.0.1:2379").checked().is_ok());
        for url in ["", "127.0.0.1:2379", "ftp://etcd:2379", "http://etcd:2379/v3", "http://etcd:2379?a=b"] {
            assert!(refused(&at(url)).contains("http://HOST:PORT"), "{url}");
        }
        assert!(refused(&EtcdOptions::default()).contains("endpoints"));
        assert!(refused(&at("https://etcd:2379")).contains("authorities"));
        assert!(!refused(&at("http://me:secret@etcd:2379")).contains("secret"));
        let ca = EtcdOptions { ca: Some("ca.pem".into()), ..at("http://etcd:2379") };
        assert!(refused(&ca).contains("https://"));
        let alone = EtcdOptions { user: Some("me".into()), ..at("http://127.0.0.1:2379") };
        assert!(refused(&alone).contains("password"));
        let clear =
            EtcdOptions { password_file: Some("nowhere".into()), user: Some("me".into()), ..at("http://etcd:2379") };
        assert!(refused(&clear).contains("in the clear"));
        let missing = EtcdOptions { endpoints: vec!["http://127.0.0.1:2379".into()], ..clear };
        assert!(refused(&missing).contains("nowhere: can't be opened"));
    }
}
