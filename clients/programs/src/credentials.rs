//! The options that say who calls, and which servers are trusted.

use std::path::{Path, PathBuf};

use palpate_client::{Credentials, Server, Token};
use palpate_tissue::files;

use crate::ClientFailure;

/// The caller's credentials, and which servers are trusted.
#[derive(clap::Args, Debug, Clone, Default)]
#[command(next_help_heading = "Credentials, if the server wants any")]
pub(crate) struct CredentialOptions {
    /// File with your token [or set the environment variable PALPATE_TOKEN to the token itself]
    #[arg(long, value_name = "FILE", global = true)]
    token_file: Option<PathBuf>,
    /// Certificates (PEM) to trust for https URLs instead of the system's
    #[arg(long, value_name = "FILE", global = true)]
    ca: Option<PathBuf>,
    /// Name that the server's certificate must carry, if it differs from the URL's host
    #[arg(long, value_name = "NAME", global = true)]
    tls_name: Option<String>,
    /// Your client certificate (PEM), if the server requires one
    #[arg(long, value_name = "FILE", requires = "key", global = true)]
    cert: Option<PathBuf>,
    /// Private key of the client certificate (PEM)
    #[arg(long, value_name = "FILE", requires = "cert", global = true)]
    key: Option<PathBuf>,
}

/// The server: as `--server`, like everywhere, or as the only argument.
#[derive(clap::Args, Debug, Clone)]
pub(crate) struct ServerOption {
    /// The server, as --server
    #[arg(value_name = "URL", conflicts_with = "server")]
    url: Option<String>,
    /// The server
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:7117")]
    server: String,
}

impl ServerOption {
    /// Its URL.
    pub(crate) fn url(&self) -> &str {
        self.url.as_deref().unwrap_or(&self.server)
    }
}

impl CredentialOptions {
    /// The server at `url`, with these credentials.
    ///
    /// # Errors
    /// Returns an error if the URL or a file is refused.
    pub(crate) fn server(&self, url: &str) -> Result<Server, ClientFailure> {
        let credentials = Credentials {
            token: self.token()?,
            ca: self.ca.as_deref().map(|path| read("--ca", path)).transpose()?,
            tls_name: self.tls_name.clone(),
            cert_and_key: match (&self.cert, &self.key) {
                (Some(cert), Some(key)) => Some((read("--cert", cert)?, read("--key", key)?)),
                _ => None,
            },
        };
        credentials.check().map_err(|error| ClientFailure::Refused(format!("--{error}")))?;
        Server::new(url, &credentials).map_err(|error| ClientFailure::Refused(format!("--server {error}")))
    }

    fn token(&self) -> Result<Option<Token>, ClientFailure> {
        let (text, place) = match (&self.token_file, std::env::var("PALPATE_TOKEN")) {
            (Some(path), _) => {
                warn_if_readable(path);
                (read("--token-file", path)?, path.display().to_string())
            }
            (None, Ok(text)) => (text, "PALPATE_TOKEN".to_owned()),
            (None, Err(_)) => return Ok(None),
        };
        Token::new(&text).map(Some).map_err(|error| ClientFailure::Refused(format!("{place}: {error}")))
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

fn read(option: &str, path: &Path) -> Result<String, ClientFailure> {
    files::read_text(path, files::MAX_SECRET_BYTES)
        .map_err(|refusal| ClientFailure::Refused(format!("{option} {refusal}")))
}
