//! The section `[cluster]` of the configuration, which makes a server a member of a fleet.

use std::path::PathBuf;

use serde::Deserialize;

use palpate_cluster::key::{Keys, check_name};
use palpate_refusal::{Reason, Refusal, Result};

/// The section `[cluster]`: the server's fleet and its access to etcd. Without `etcd`, the server belongs to no
/// fleet, and `advertise`, `node` and `agones` are refused.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ClusterConfig {
    /// URLs of the members of etcd. Empty (default): the server belongs to no fleet.
    pub etcd: Vec<String>,
    /// Name of the fleet: servers with the same name and etcd share their sessions. Default: `default`.
    pub name: String,
    /// URL at which clients and other servers of the fleet reach this server, without a path; required in a fleet.
    /// With https:// and `ca`, unless only this machine can reach it or the server is `insecure`.
    pub advertise: Option<String>,
    /// Name of this server in the fleet, unique there; empty (default): host and port of `advertise`.
    pub node: String,
    /// Time to live of the server's lease in etcd, 2 to 60 s: after its death other servers wait this long before
    /// they take over. Default: 3.
    pub ttl_s: u64,
    /// What `durable_step` means: `one` (default), on the disk of this server; `two`, also on the disk of its standby.
    pub durable: Durable,
    /// Whether to report the server's state to Agones, through its SDK at `localhost:$AGONES_SDK_GRPC_PORT` (9357).
    /// Default: false. Requires a program built with the feature `agones`.
    pub agones: bool,
    /// File of certificate authorities (PEM) for connections between servers of the fleet; both ends check them. Each
    /// server presents its certificate `tls_cert`. Other clients need none.
    pub ca: Option<PathBuf>,
    /// File of certificate authorities (PEM) of etcd.
    pub etcd_ca: Option<PathBuf>,
    /// File of this server's certificate for etcd, PEM; requires `etcd_key`.
    pub etcd_cert: Option<PathBuf>,
    /// File of the private key of `etcd_cert`, PEM.
    pub etcd_key: Option<PathBuf>,
    /// User name for etcd, if it requires a password; requires `etcd_password_file`.
    pub etcd_user: Option<String>,
    /// File with the password of `etcd_user`.
    pub etcd_password_file: Option<PathBuf>,
}

/// The keys of the rest of the configuration that a fleet depends on.
pub(super) struct Beside {
    pub(super) journal: bool,
    pub(super) tls: bool,
    pub(super) insecure: bool,
}

/// Where the journal of a step must be before a server of a fleet reports that step as durable (`durable_step`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum Durable {
    /// On the disk of the server.
    #[default]
    One,
    /// Also on the disk of its standby, the server of the fleet that mirrors the journal.
    Two,
}

impl Default for ClusterConfig {
    fn default() -> Self {
        ClusterConfig {
            etcd: Vec::new(),
            name: "default".to_owned(),
            advertise: None,
            node: String::new(),
            ttl_s: 3,
            durable: Durable::One,
            agones: false,
            ca: None,
            etcd_ca: None,
            etcd_cert: None,
            etcd_key: None,
            etcd_user: None,
            etcd_password_file: None,
        }
    }
}

impl ClusterConfig {
    /// Returns whether the server belongs to a fleet: `etcd` is not empty.
    pub fn is_on(&self) -> bool {
        !self.etcd.is_empty()
    }

    /// Returns `advertise` without a slash at its end; empty if the server belongs to no fleet.
    pub(super) fn endpoint(&self) -> &str {
        self.advertise.as_deref().unwrap_or_default().trim_end_matches('/')
    }

    /// Returns this server's name in its fleet: `node`, or host and port of `advertise`.
    pub(super) fn node(&self) -> String {
        if self.node.is_empty() {
            self.endpoint().split_once("://").map_or("", |(_, rest)| rest).replace(['[', ']'], "")
        } else {
            self.node.clone()
        }
    }

    /// Checks the section, and that the rest of the configuration fits it.
    ///
    /// # Errors
    /// Returns an error that names the first key that is missing or wrong.
    pub(super) fn check(&self, beside: Beside) -> Result<()> {
        if self.agones && !cfg!(feature = "agones") {
            let message = "is set, but this program was built without the feature `agones`";
            return Err(Refusal::new(Reason::NotAvailable, "cluster.agones", message));
        }
        if !self.is_on() {
            if self.advertise.is_some() || !self.node.is_empty() || self.agones {
                let message = "is missing: without the URLs of etcd the server belongs to no fleet";
                return Err(Refusal::new(Reason::Missing, "cluster.etcd", message));
            }
            return Ok(());
        }
        if !cfg!(target_os = "linux") {
            let message = "a fleet needs Linux: elsewhere a server can't tell for how long the machine was suspended, and could \
                           act for a session that another server has";
            return Err(Refusal::new(Reason::NotAvailable, "cluster.etcd", message));
        }
        let missing = |field: &str, why: &str| Err(Refusal::new(Reason::Missing, field, format!("is missing: {why}")));
        let Some(advertise) = &self.advertise else {
            return missing(
                "cluster.advertise",
                "clients and other servers must know under which URL they reach this one",
            );
        };
        let uri = advertise.parse::<http::Uri>().ok().filter(|uri| uri.scheme().is_some() && uri.host().is_some());
        let Some(uri) = uri.filter(|uri| uri.path() == "/") else {
            let message = format!("must be http://host:port or https://host:port, but is `{advertise}`");
            return Err(Refusal::new(Reason::WrongKind, "cluster.advertise", message));
        };
        if !beside.journal {
            return missing("journal", "other servers of the fleet continue sessions from their journals");
        }
        Keys::of(&self.name)?;
        check_name("cluster.node", &self.node())?;
        if !(2..=60).contains(&self.ttl_s) {
            let message = format!("must be from 2 to 60 s, but is {}", self.ttl_s);
            return Err(Refusal::new(Reason::OutOfRange, "cluster.ttl_s", message));
        }
        let host = uri.host().unwrap_or_default().trim_matches(['[', ']']);
        let is_here = host == "localhost" || host.parse::<std::net::IpAddr>().is_ok_and(|at| at.is_loopback());
        let is_secure = uri.scheme_str() == Some("https") && self.ca.is_some() && beside.tls;
        if !is_here && !is_secure && !beside.insecure {
            let message = "other machines can reach this server: its fleet needs TLS on both sides. Give --tls-cert, --tls-key, \
                           --tokens and --cluster-ca, and an https:// URL (see docs/fleet.md), or pass --insecure: then \
                           everyone who can reach it may do everything";
            return Err(Refusal::new(Reason::Missing, "cluster.ca", message));
        }
        let pairs = [
            ("cluster.etcd_cert", self.etcd_cert.is_some(), "cluster.etcd_key", self.etcd_key.is_some()),
            ("cluster.etcd_key", self.etcd_key.is_some(), "cluster.etcd_cert", self.etcd_cert.is_some()),
            (
                "cluster.etcd_user",
                self.etcd_user.is_some(),
                "cluster.etcd_password_file",
                self.etcd_password_file.is_some(),
            ),
        ];
        for (field, given, needs, there) in pairs {
            if given && !there {
                return missing(needs, &format!("{field} requires it"));
            }
        }
        Ok(())
    }
}
