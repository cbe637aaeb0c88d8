//! The configuration of a server: a TOML file, then the command line over it.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::limits::Limits;
use crate::refusal::{Reason, Refusal, Result, number, positive};
use crate::scene::document::read_text;

/// Everything that can be configured. Absent keys keep these defaults.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Where to listen: address:port. At one that other machines can reach, TLS and tokens or client certificates are needed.
    pub listen: String,
    /// File of the certificate chain that the server shows, PEM. Looked at again when it changes, as the next three.
    pub tls_cert: Option<PathBuf>,
    /// File of its private key, PEM.
    pub tls_key: Option<PathBuf>,
    /// File of certificates, PEM: a client must show one that was signed by one of them.
    pub tls_client_ca: Option<PathBuf>,
    /// File of tokens and the names of client certificates, and what they may do (docs/formats.md).
    pub tokens: Option<PathBuf>,
    /// Serve unprotected also where other machines can reach it.
    pub insecure: bool,
    /// Origins of pages of other sites that may call, as in `https://example.org`.
    pub origins: Vec<String>,
    /// Where Prometheus finds `/metrics`: address:port; nowhere if absent. Nobody is asked who they are there.
    pub metrics: Option<String>,
    /// Folder of the scenes that sessions can be made from by name.
    pub scenes: PathBuf,
    /// Folder of the scripts that clients can ask for by name.
    pub scripts: PathBuf,
    /// Folder of the page that `/` shows, built by `npm run build`.
    pub viewer: PathBuf,
    /// Stepping threads; one less than the machine has cores if 0.
    pub threads: usize,
    /// Threads of the network side; as many as the stepping threads leave cores, at least 1, if 0.
    pub network_threads: usize,
    /// Part of a core with which the errors of live sessions are measured; nothing is measured if 0.
    pub audit_share: f64,
    /// How long open streams may take to end at shutdown before they are cut, s.
    pub shutdown_deadline_s: f64,
    /// Lease of a tool if the client asks for none, s.
    pub lease_s: f64,
    /// A session is deleted when so long nobody asked for it, held a tool or had a stream, s.
    pub idle_session_s: f64,
    /// What is logged: `info`, `debug`, `palpate=debug,tonic=warn`, …
    pub log: String,
    /// Upper bounds.
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
            metrics: None,
            scenes: PathBuf::from("scenes"),
            scripts: PathBuf::from("scripts"),
            viewer: PathBuf::from("clients/viewer/dist"),
            threads: 0,
            network_threads: 0,
            audit_share: 0.02,
            shutdown_deadline_s: 5.0,
            lease_s: 2.0,
            idle_session_s: 900.0,
            log: "info".to_owned(),
            limits: Limits::default(),
        }
    }
}

impl Config {
    /// Reads a configuration file.
    pub fn load(path: &Path) -> Result<Self> {
        Config::parse(&path.display().to_string(), &read_text(path, Limits::default().file_bytes)?)
    }

    /// Parses a configuration; `name` is what refusals call it.
    pub fn parse(name: &str, text: &str) -> Result<Self> {
        let config: Config = toml::from_str(text).map_err(|e| {
            let line = e.span().map_or(1, |span| text[..span.start].matches('\n').count() + 1);
            let place = Some(format!("{name}:{line}"));
            Refusal { place, ..Refusal::new(Reason::Unreadable, "", format!("{}\n{e}", e.message()).trim_end()) }
        })?;
        config.check().map_err(|refusal| Refusal { place: Some(name.to_owned()), ..refusal })?;
        Ok(config)
    }

    /// Ranges.
    pub fn check(&self) -> Result<()> {
        for (field, value) in [
            ("limits.point_force_n", self.limits.point_force_n),
            ("limits.reach_in_sheets", self.limits.reach_in_sheets),
            ("limits.session_rate_hz", self.limits.session_rate_hz),
            ("limits.periods_per_step", self.limits.periods_per_step),
            ("limits.commands_per_step", self.limits.commands_per_step),
            ("limits.sessions_per_minute", self.limits.sessions_per_minute),
            ("limits.calls_per_s", self.limits.calls_per_s),
            ("limits.thread_share", self.limits.thread_share),
        ] {
            positive(field, value)?;
        }
        // None of these would let anything through.
        macro_rules! whole {
            ($($limit:ident)*) => { [$((concat!("limits.", stringify!($limit)), self.limits.$limit == 0),)*] };
        }
        let whole = whole!(
            points substeps file_bytes trace_bytes tools queued_commands_per_tool queued_samples queued_records
            queued_bytes sessions points_in_all point_substeps_per_step streams_per_session frame_vertices texture_side
            probe_points connections connections_per_address streams_per_connection message_bytes
            connection_window_bytes queued_changes rehearsal_work law_work queued_work streams leases
        );
        if let Some((field, _)) = whole.iter().find(|limit| limit.1) {
            return Err(Refusal::new(Reason::OutOfRange, *field, "must be 1 or more: 0 lets nothing through"));
        }
        let together = |field: &str, given: bool, needs: &str, there: bool| {
            let missing = || Refusal::new(Reason::Missing, needs, format!("is missing, which goes with {field}"));
            if given && !there { Err(missing()) } else { Ok(()) }
        };
        let (cert, key) = (self.tls_cert.is_some(), self.tls_key.is_some());
        together("tls_cert", cert, "tls_key", key)?;
        together("tls_key", key, "tls_cert", cert)?;
        together("tls_client_ca", self.tls_client_ca.is_some(), "tls_cert", cert)?;
        for (index, origin) in self.origins.iter().enumerate() {
            let uri = origin.parse::<http::Uri>().ok().filter(|uri| uri.scheme().is_some() && uri.host().is_some());
            if uri.is_none() || origin.ends_with('/') {
                let message = format!("must be a scheme, a host and perhaps a port, as https://example.org: {origin}");
                return Err(Refusal::new(Reason::WrongKind, format!("origins[{index}]"), message));
            }
        }
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
        ] {
            number(field, value, "above 0 and at most a day", within(day_s))?;
        }
        number("shutdown_deadline_s", self.shutdown_deadline_s, "above 0 and at most a day", within(day_s))?;
        number("audit_share", self.audit_share, "from 0 to 1", |share| (0.0..=1.0).contains(&share))?;
        number("idle_session_s", self.idle_session_s, "above 0", |value| value > 0.0)?;
        Ok(())
    }

    /// Stepping threads, at least 1.
    pub fn stepping_threads(&self) -> usize {
        if self.threads > 0 { self.threads } else { cores().saturating_sub(1).max(1) }
    }

    /// Threads of the network side, at least 1.
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
    fn a_limit_of_nothing_is_refused_with_its_name() {
        let guide = include_str!("../../docs/palpate.toml");
        let limits = guide.split_once("[limits]").unwrap().1;
        let mut named = 0;
        for line in limits.lines() {
            let Some((key, _)) = line.trim_start_matches(['#', ' ']).split_once(" = ") else { continue };
            // Half of the memory that there is; no stream kept.
            if ["memory_bytes", "streams_for_holders"].contains(&key) {
                continue;
            }
            for nothing in ["0", "0.0", "-1.0"] {
                // One of the two is of the wrong kind; which, the kind of the limit tells.
                let refused = Config::parse("test", &format!("[limits]\n{key} = {nothing}\n")).unwrap_err();
                let told = format!("{} {}", refused.field, refused.message);
                assert!(told.contains(key), "{key} = {nothing}: {told}");
            }
            named += 1;
        }
        assert!(named >= 30, "{named}");
    }
}
