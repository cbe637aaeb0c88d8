//! Metrics of a server for Prometheus.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used, clippy::panic, clippy::disallowed_methods)]

use std::collections::BTreeMap;
use std::io::{BufRead, Read, Write};
use std::time::Duration;

/// Returns the address of the metrics, which a server with `--metrics` prints in the line after its own address.
pub fn url(out: &mut impl BufRead) -> String {
    let mut line = String::new();
    out.read_line(&mut line).unwrap();
    line.split_whitespace().last().unwrap().to_owned()
}

/// Returns the whole answer; `None` without one.
fn answer(url: &str) -> Option<String> {
    let (host, path) = url.trim_start_matches("http://").split_once('/')?;
    let mut stream = std::net::TcpStream::connect(host).ok()?;
    stream.set_read_timeout(Some(Duration::from_secs(30))).ok()?;
    write!(stream, "GET /{path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n").ok()?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).ok()?;
    Some(answer)
}

/// Metrics as they are served: each line's name and labels, and its value.
pub fn scrape(url: &str) -> BTreeMap<String, f64> {
    let answer = answer(url).unwrap();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    assert!(head.starts_with("HTTP/1.1 200") && head.contains("application/openmetrics-text"), "{head}");
    assert!(body.ends_with("# EOF\n"), "{body}");
    values(body)
}

/// Returns the metrics; nothing if the server does not answer.
pub fn try_scrape(url: &str) -> Option<BTreeMap<String, f64>> {
    Some(values(answer(url)?.split_once("\r\n\r\n")?.1))
}

fn values(body: &str) -> BTreeMap<String, f64> {
    let told = body.lines().filter(|line| !line.starts_with('#')).map(|line| {
        let (name, value) = line.rsplit_once(' ').unwrap();
        (name.to_owned(), value.parse().unwrap_or_else(|_| panic!("{line}")))
    });
    told.collect()
}

/// The sum of a metric over its labels.
pub fn sum(metrics: &BTreeMap<String, f64>, name: &str) -> f64 {
    let of = |key: &str| key.strip_prefix(name).is_some_and(|rest| rest.is_empty() || rest.starts_with('{'));
    metrics.iter().filter(|(key, _)| of(key)).map(|(_, value)| value).sum()
}
