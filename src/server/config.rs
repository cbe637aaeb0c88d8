//! The configuration of a server: a TOML file whose keys the command line overrides.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::address::host_and_port;
use super::cluster_config::{Beside, ClusterConfig};
use super::journals::retention::Keep;
use palpate_refusal::{Reason, Refusal, Result, number, positive};
use palpate_tissue::files;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::toml_document::nearest_name;

/// The configuration of a server, with a field for each key of the file. Absent keys keep their defaults; unknown ones
/// are refused. [`Config::check`] checks the values.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Address to listen on: address:port; port 0: any free one. Default: 127.0.0.1:7117. An address that other
    /// machines can reach requires TLS, and tokens or client certificates, unless `insecure` is set.
    pub listen: String,
    /// File of the server's certificate chain, PEM; requires `tls_key`. `None`: no TLS. This file and the next three
    /// are reloaded when they change.
    pub tls_cert: Option<PathBuf>,
    /// File of the server's private key, PEM; requires `tls_cert`.
    pub tls_key: Option<PathBuf>,
    /// File of certificate authorities, PEM: clients must present a certificate that one of them has signed. Requires
    /// `tls_cert`. `None`: clients need no certificate.
    pub tls_client_ca: Option<PathBuf>,
    /// File with the roles of tokens and client certificates (docs/tokens.md). `None`: there are no tokens.
    pub tokens: Option<PathBuf>,
    /// Whether to serve without TLS or authentication even if other machines can reach the server. Default: false.
    pub insecure: bool,
    /// Origins of other sites whose pages may call the server, such as `https://example.org`: scheme, host and perhaps
    /// port, without a slash at the end. Default: none.
    pub origins: Vec<String>,
    /// Whether to accept touch by datagrams (WebTransport) as well as gRPC, on the UDP port of the same number.
    /// Default: true. Needs TLS, or an address that only this machine can reach.
    pub datagrams: bool,
    /// HOST:PORT that the server sends to clients for datagrams, if it differs from the server's own address: behind
    /// a proxy, in a container. `None`: its own.
    pub datagrams_advertise: Option<String>,
    /// Address for `/metrics` (Prometheus), without authentication: address:port, one that only this machine can reach
    /// unless `insecure` is set. `None` (default): no metrics.
    pub metrics: Option<String>,
    /// URL of a collector of OpenTelemetry that gets traces of calls (OTLP over gRPC), such as `http://host:4317`.
    /// `None` (default): no traces. Requires a program built with the feature `otlp`.
    pub otlp: Option<String>,
    /// Folder of the scenes that clients can create sessions from by name. Default: `scenes`; it may be missing.
    pub scenes: PathBuf,
    /// Folder of the scripts that clients can request by name. Default: `scripts`; it may be missing.
    pub scripts: PathBuf,
    /// Folder of the exercises that clients can create sessions for by name. Default: `exercises`; it may be missing.
    pub exercises: PathBuf,
    /// Folder of the page served at `/`, built by `npm run build`. Default: `clients/viewer/dist`.
    pub viewer: PathBuf,
    /// Number of stepping threads; 0 (default): one fewer than the cores of the machine, at least 1.
    pub threads: usize,
    /// Number of network threads; 0 (default): the cores that the stepping threads leave, at least 1.
    pub network_threads: usize,
    /// Fraction of a core, 0 to 1, for measuring the errors of live sessions; 0 disables the measurement. Default:
    /// 0.02.
    pub audit_share: f64,
    /// Whether to measure how long each stage of a step takes, for `palpate-client top`. Default: false.
    pub profile: bool,
    /// Time that open streams have to end at shutdown before they are cut, s, above 0 and at most a day. Default: 5.
    pub shutdown_deadline_s: f64,
    /// Duration of a tool's lease if the client requests none, s, above 0 and at most `limits.lease_s`. Default: 2.
    pub lease_s: f64,
    /// Time without a call, a leased tool or a stream after which a session is deleted, s, above 0. Default: 900.
    pub idle_session_s: f64,
    /// Folder of the journals, which record what happens to sessions. A restarted server continues the sessions from
    /// them. `None` (default) records nothing.
    pub journal: Option<PathBuf>,
    /// How long the journals of ended sessions are kept, and the size of all journals above which the oldest of those
    /// are removed: `30d`, `10GiB`, `30d,10GiB` (default), or `0` to keep none.
    pub journal_keep: Keep,
    /// Whether sessions whose mesh a client has sent have journals, which then contain the mesh. Without one such a
    /// session ends with the server. Default: true; a fleet requires it.
    pub journal_meshes: bool,
    /// File of the private key (Ed25519) that signs the journals, PEM; requires `journal`. `None`: they are not
    /// signed.
    pub journal_key: Option<PathBuf>,
    /// The fleet that the server belongs to. Default: none.
    pub cluster: ClusterConfig,
    /// The log filter: `info` (default), `debug`, `palpate=debug,tonic=warn`, …
    pub log: String,
    /// Upper limits on what clients may use.
    pub limits: Limits,
}

impl Default for Config {
    fn default() -> Self {
        Config {
            listen: "127.0.0.1:7117".to_owned(),
            tls_cert: None,
            tls_key: None,
            tls_client_ca: None,
            tokens: None,
            insecure: false,
            origins: Vec::new(),
            datagrams: true,
            datagrams_advertise: None,
            metrics: None,
            otlp: None,
            scenes: PathBuf::from("scenes"),
            scripts: PathBuf::from("scripts"),
            exercises: PathBuf::from("exercises"),
            viewer: PathBuf::from("clients/viewer/dist"),
            threads: 0,
            network_threads: 0,
            audit_share: 0.02,
            profile: false,
            shutdown_deadline_s: 5.0,
            lease_s: 2.0,
            idle_session_s: 900.0,
            journal: None,
            journal_keep: Keep::default(),
            journal_meshes: true,
            journal_key: None,
            cluster: ClusterConfig::default(),
            log: "info".to_owned(),
            limits: Limits::default(),
        }
    }
}

impl Config {
    /// Reads and checks a configuration file. Files that it names are not read.
    ///
    /// # Errors
    /// Refuses a file that can't be read or is larger than the default `limits.file_bytes`; otherwise returns the
    /// errors of [`Config::parse`].
    pub fn load(path: &Path) -> Result<Self> {
        Config::parse(&path.display().to_string(), &files::read_text(path, Limits::default().file_bytes)?)
    }

    /// Parses and checks a configuration in TOML; refusals refer to it as `name`.
    ///
    /// # Errors
    /// Refuses a text that is not TOML, has an unknown key or a value of another type, with the line; otherwise
    /// returns the errors of [`Config::check`].
    pub fn parse(name: &str, text: &str) -> Result<Self> {
        let config: Config = toml::from_str(text).map_err(|e| {
            let line = e.span().map_or(0, |span| text[..span.start].matches('\n').count());
            let message =
                format!("{}: {}", text.lines().nth(line).unwrap_or_default().trim(), nearest_name(e.message()));
            Refusal { place: Some(format!("{name}:{}", line + 1)), ..Refusal::new(Reason::Unreadable, "", message) }
        })?;
        config.check().map_err(|refusal| Refusal { place: Some(name.to_owned()), ..refusal })?;
        Ok(config)
    }

    /// Checks that all values are within their ranges and that keys that require each other are given together.
    /// [`Listeners::open`](super::Listeners::open) checks whether the addresses are safe.
    ///
    /// # Errors
    /// Refuses the first key that is out of range, malformed or missing, by its name: a number or a limit out of range
    /// (a limit of 0 too), one of two keys without the other, an origin or `datagrams_advertise` of another form, or a
    /// section `[cluster]` that is incomplete or does not fit the rest.
    pub fn check(&self) -> Result<()> {
        for (field, value) in [
            ("limits.point_force_n", self.limits.point_force_n),
            ("limits.reach_in_sides", self.limits.reach_in_sides),
            ("limits.session_rate_hz", self.limits.session_rate_hz),
            ("limits.periods_per_step", self.limits.periods_per_step),
            ("limits.commands_per_step", self.limits.commands_per_step),
            ("limits.sessions_per_minute", self.limits.sessions_per_minute),
            ("limits.calls_per_s", self.limits.calls_per_s),
            ("limits.thread_share", self.limits.thread_share),
        ] {
            positive(field, value)?;
        }
        // A limit of 0 would refuse everything.
        macro_rules! whole {
            ($($limit:ident)*) => { [$((concat!("limits.", stringify!($limit)), self.limits.$limit == 0),)*] };
        }
        let whole = whole!(
            points substeps file_bytes trace_bytes mesh_bytes mesh_vertices meshes_per_caller
            journal_bytes journals_per_caller tools ties queued_commands_per_tool queued_samples queued_records
            queued_bytes sessions points_in_all point_substeps_per_step contact_work streams_per_session frame_vertices texture_side
            probe_points connections connections_per_address streams_per_connection message_bytes
            connection_window_bytes queued_changes rehearsal_work law_work mesh_work press_work queued_work streams
            leases
        );
        if let Some((field, _)) = whole.iter().find(|limit| limit.1) {
            return Err(Refusal::new(Reason::OutOfRange, *field, "must be at least 1: 0 would refuse everything"));
        }
        let together = |field: &str, given: bool, needs: &str, there: bool| {
            let missing = || Refusal::new(Reason::Missing, needs, format!("is missing, but {field} requires it"));
            if given && !there { Err(missing()) } else { Ok(()) }
        };
        let (cert, key) = (self.tls_cert.is_some(), self.tls_key.is_some());
        together("tls_cert", cert, "tls_key", key)?;
        together("tls_key", key, "tls_cert", cert)?;
        together("journal_key", self.journal_key.is_some(), "journal", self.journal.is_some())?;
        together("tls_client_ca", self.tls_client_ca.is_some(), "tls_cert", cert)?;
        for (index, origin) in self.origins.iter().enumerate() {
            let uri = origin.parse::<http::Uri>().ok().filter(|uri| uri.scheme().is_some() && uri.host().is_some());
            if uri.is_none() || origin.ends_with('/') {
                let message = format!("must be scheme://host or scheme://host:port, but is `{origin}`");
                return Err(Refusal::new(Reason::WrongKind, format!("origins[{index}]"), message));
            }
        }
        if let Some(text) = &self.datagrams_advertise
            && host_and_port(text).is_none()
        {
            let message = format!("must be host:port, such as tissue.example:7117, but is `{text}`");
            return Err(Refusal::new(Reason::WrongKind, "datagrams_advertise", message));
        }
        self.check_otlp()?;
        let (most_s, day_s) = (self.limits.lease_s, 86400.0);
        let within = |most: f64| move |value: f64| value > 0.0 && value <= most;
        number("lease_s", self.lease_s, &format!("above 0 and at most limits.lease_s, {most_s}"), within(most_s))?;
        number("limits.lease_s", most_s, "above 0 and at most a day", within(day_s))?;
        for (field, value) in [
            ("limits.browser_lease_s", self.limits.browser_lease_s),
            ("limits.handshake_s", self.limits.handshake_s),
            ("limits.open_s", self.limits.open_s),
            ("limits.keepalive_s", self.limits.keepalive_s),
            ("limits.work_s", self.limits.work_s),
            ("limits.mesh_s", self.limits.mesh_s),
            ("limits.journal_s", self.limits.journal_s),
        ] {
            number(field, value, "above 0 and at most a day", within(day_s))?;
        }
        number("shutdown_deadline_s", self.shutdown_deadline_s, "above 0 and at most a day", within(day_s))?;
        number("audit_share", self.audit_share, "from 0 to 1", |share| (0.0..=1.0).contains(&share))?;
        self.cluster.check(Beside { journal: self.journal.is_some(), tls: cert, insecure: self.insecure })?;
        if self.cluster.is_on() && !self.journal_meshes {
            let message = "can't be false in a fleet: its servers take sessions over by their journals";
            return Err(Refusal::new(Reason::OutOfRange, "journal_meshes", message));
        }
        number("idle_session_s", self.idle_session_s, "above 0", |value| value > 0.0)?;
        Ok(())
    }

    /// Checks the URL of the collector, and that the program can send traces.
    fn check_otlp(&self) -> Result<()> {
        let Some(url) = &self.otlp else { return Ok(()) };
        if !cfg!(feature = "otlp") {
            let message = "is set, but this program was built without the feature `otlp`";
            return Err(Refusal::new(Reason::OutOfRange, "otlp", message));
        }
        let uri = url.parse::<http::Uri>().ok().filter(|uri| uri.host().is_some());
        if !uri.is_some_and(|uri| matches!(uri.scheme_str(), Some("http" | "https"))) {
            let message = format!("must be http://host:port or https://host:port, but is `{url}`");
            return Err(Refusal::new(Reason::WrongKind, "otlp", message));
        }
        Ok(())
    }

    /// Returns the number of stepping threads, at least 1: `threads`, or if that is 0, one fewer than the cores.
    pub fn stepping_threads(&self) -> usize {
        if self.threads > 0 { self.threads } else { cores().saturating_sub(1).max(1) }
    }

    /// Returns the number of network threads, at least 1: `network_threads`, or if that is 0, the cores that
    /// [`Config::stepping_threads`] leaves.
    pub fn serving_threads(&self) -> usize {
        let left = cores().saturating_sub(self.stepping_threads()).max(1);
        if self.network_threads > 0 { self.network_threads } else { left }
    }
}

fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, std::num::NonZero::get)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_limit_of_zero_is_refused_with_its_name() {
        let guide = include_str!("../../docs/palpate.toml");
        let limits = guide.split_once("[limits]").unwrap().1;
        let mut named = 0;
        for line in limits.lines() {
            let Some((key, _)) = line.trim_start_matches(['#', ' ']).split_once(" = ") else { continue };
            // 0 is valid for these keys: half of the machine's memory, and no reserved stream.
            if ["memory_bytes", "streams_for_holders"].contains(&key) {
                continue;
            }
            for value in ["0", "0.0", "-1.0"] {
                // An integer limit refuses some of these by their type; the message still names the key.
                let refused = Config::parse("test", &format!("[limits]\n{key} = {value}\n")).unwrap_err();
                let told = format!("{} {}", refused.field, refused.message);
                assert!(told.contains(key), "{key} = {value}: {told}");
            }
            named += 1;
        }
        assert!(named >= 30, "{named}");
    }
}
