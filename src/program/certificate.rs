//! `palpate certificate`: makes a certificate and its key for trials with TLS.

use std::io::Write;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use rcgen::{CertificateParams, DnType, ExtendedKeyUsagePurpose, KeyPair, KeyUsagePurpose};

use super::{Failure, write_file};
use palpate_tissue::files;

#[derive(clap::Args)]
pub(crate) struct CertificateArguments {
    /// Names and addresses by which clients reach the server
    #[arg(value_name = "NAME", default_values = ["localhost", "127.0.0.1", "::1"])]
    names: Vec<String>,
    /// Folder for cert.pem and key.pem
    #[arg(long, value_name = "DIR", default_value = ".")]
    dir: PathBuf,
    /// Days until the certificate expires
    #[arg(long, value_name = "N", default_value_t = 90, value_parser = clap::value_parser!(u16).range(1..=825))]
    days: u16,
    /// Overwrite cert.pem and key.pem
    #[arg(long)]
    force: bool,
}

/// Time by which the clocks of clients may be behind.
const EARLIER: Duration = Duration::from_secs(3600);

const DAY: Duration = Duration::from_secs(86_400);

/// Makes a certificate that signs itself, writes it and its key, and prints the commands that use them.
pub(crate) fn certificate(arguments: &CertificateArguments) -> Result<(), Failure> {
    let CertificateArguments { names, dir, days, force } = arguments;
    let (cert, key) = (dir.join("cert.pem"), dir.join("key.pem"));
    for path in [&cert, &key] {
        if path.exists() && !force {
            return Err(Failure::Refused(format!("{}: exists already; --force overwrites it", path.display())));
        }
    }
    let [cert_pem, key_pem] = pair(names, u32::from(*days))?;
    write_key(&key, &key_pem)?;
    write_file(&cert, cert_pem.as_bytes())?;
    let written = writeln!(std::io::stdout(), "{}", next(names, *days, &cert, &key));
    written.map_err(|e| Failure::Failed(e.to_string()))
}

/// Returns certificate and key in PEM.
// Certificates expire by the wall clock.
#[allow(clippy::disallowed_methods)]
fn pair(names: &[String], days: u32) -> Result<[String; 2], Failure> {
    if let Some(name) = names.iter().find(|name| !is_name(name)) {
        let what = "must be a DNS name or an IP address, without a scheme or a port";
        return Err(Failure::Refused(format!("{name}: {what}, such as server.example or 192.0.2.7")));
    }
    let refused = |e: rcgen::Error| Failure::Refused(format!("{}: {e}", names.join(", ")));
    let mut params = CertificateParams::new(names).map_err(refused)?;
    params.distinguished_name.push(DnType::CommonName, "Palpate, for trials");
    params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
    params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    let begin = rcgen::date_time_ymd(1970, 1, 1);
    (params.not_before, params.not_after) = (begin + now.saturating_sub(EARLIER), begin + now + DAY * days);
    let failed = |e: rcgen::Error| Failure::Failed(format!("can't make a certificate: {e}"));
    let key = KeyPair::generate().map_err(failed)?;
    let cert = params.self_signed(&key).map_err(failed)?;
    Ok([cert.pem(), key.serialize_pem()])
}

fn is_name(name: &str) -> bool {
    let in_dns = |c: char| c.is_ascii_alphanumeric() || "-._*".contains(c);
    name.parse::<IpAddr>().is_ok() || (!name.is_empty() && name.chars().all(in_dns))
}

/// Writes the key so that only its owner can read it, also over a file that others could read.
pub(crate) fn write_key(path: &Path, pem: &str) -> Result<(), Failure> {
    let failed = |e: std::io::Error| Failure::Failed(format!("{}: can't be written: {e}", path.display()));
    match std::fs::remove_file(path) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(failed(e)),
        _ => {}
    }
    files::private_options()
        .create_new(true)
        .open(path)
        .and_then(|mut file| file.write_all(pem.as_bytes()))
        .map_err(failed)
}

/// Returns the names of the new files, and the commands that use them.
fn next(names: &[String], days: u16, cert: &Path, key: &Path) -> String {
    let is_here = |name: &String| name == "localhost" || name.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback());
    let (cert, key) = (cert.display(), key.display());
    let made = format!(
        "{cert} and {key} are for {}, for {days} days. They are for trials: clients trust the certificate by --ca alone.",
        names.join(", ")
    );
    let others = names.iter().find(|name| !is_here(name));
    let name = others.or(names.first()).map_or("localhost", String::as_str);
    let host = if name.contains(':') { format!("[{name}]") } else { name.to_owned() };
    let (listen, first, tokens, token) = match others {
        None => ("127.0.0.1:7117", String::new(), "", ""),
        // Others can reach such a server, so it requires tokens.
        Some(_) => (
            "0.0.0.0:7117",
            "A token for the client:\n  (umask 077; palpate token --name me --role create,touch --tokens tokens.toml > me.token)\n\n"
                .to_owned(),
            " --tokens tokens.toml",
            " --token-file me.token",
        ),
    };
    format!(
        "{made}\n\n{first}The server:\n  palpate serve --listen {listen} --tls-cert {cert} --tls-key {key}{tokens}\n\n\
         A client:\n  palpate-client replay vertical-60 --server https://{host}:7117 --ca {cert}{token}"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(names: &[&str]) -> Vec<String> {
        names.iter().map(|name| (*name).to_owned()).collect()
    }

    #[test]
    fn names_with_a_scheme_or_a_port_are_refused() {
        for wrong in ["https://server", "server:7117", "two words", ""] {
            let Err(Failure::Refused(message)) = pair(&names(&["localhost", wrong]), 1) else { panic!("{wrong}") };
            assert!(message.starts_with(&format!("{wrong}: must be a DNS name")), "{message}");
        }
        for right in ["localhost", "server.example", "*.example", "192.0.2.7", "2001:db8::1"] {
            assert!(pair(&names(&[right]), 1).is_ok(), "{right}");
        }
    }

    #[test]
    fn a_server_that_others_reach_asks_for_a_token() {
        let [cert, key] = ["cert.pem", "key.pem"].map(Path::new);
        let here = next(&names(&["localhost", "127.0.0.1"]), 90, cert, key);
        assert!(here.contains("--listen 127.0.0.1:7117 --tls-cert cert.pem --tls-key key.pem\n"), "{here}");
        assert!(here.ends_with("--server https://localhost:7117 --ca cert.pem"), "{here}");
        let there = next(&names(&["localhost", "2001:db8::1"]), 90, cert, key);
        assert!(there.contains("palpate token") && there.contains("--tokens tokens.toml"), "{there}");
        assert!(there.ends_with("--server https://[2001:db8::1]:7117 --ca cert.pem --token-file me.token"), "{there}");
    }
}
