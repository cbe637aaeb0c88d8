//! `palpate-client proxy`: simulates a bad network on this machine, between clients and a server.

use std::net::SocketAddr;
use std::sync::Arc;

use palpate_refusal::{Refusal, number};
use palpate_simulated::network::Conditions;
use palpate_simulated::relay::{MAX_FLOWS, Passed, RelayNetwork};
use serde_json::json;

use crate::{ClientFailure, interrupted, table};

/// Arguments of `proxy`.
#[derive(clap::Args)]
pub(crate) struct ProxyArguments {
    /// Address to listen on; port 0 takes a free one
    #[arg(value_name = "LISTEN")]
    listen: SocketAddr,
    /// The server
    #[arg(value_name = "TO")]
    to: SocketAddr,
    /// Relay only UDP [default: UDP and TCP, at the same port]
    #[arg(long, conflicts_with = "tcp")]
    udp: bool,
    /// Relay only TCP
    #[arg(long)]
    tcp: bool,
    /// Delay each way, ms
    #[arg(long, value_name = "MS", default_value_t = 0.0)]
    delay_ms: f64,
    /// Standard deviation of the delay each way, ms. Datagrams overtake each other; TCP data stays in order
    #[arg(long, value_name = "MS", default_value_t = 0.0)]
    jitter_ms: f64,
    /// Fraction of the packets that are lost. Lost TCP packets are sent again, which delays all later ones
    #[arg(long, value_name = "FRACTION", default_value_t = 0.0)]
    loss: f64,
    /// Mean number of packets lost in a row; 1: losses are independent
    #[arg(long, value_name = "PACKETS", default_value_t = 1.0)]
    loss_burst: f64,
    /// Once a second nothing gets through for this long, ms
    #[arg(long, value_name = "MS", default_value_t = 0.0)]
    outage_ms: f64,
    /// Seed of losses and delays
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print one JSON object at the end instead of a table
    #[arg(long)]
    json: bool,
}

/// Relays until it is interrupted, and prints counts of the relayed data.
///
/// # Errors
/// Returns an error if an argument is refused or the address is not free.
pub(crate) async fn proxy(arguments: &ProxyArguments) -> Result<(), ClientFailure> {
    let network = RelayNetwork::new(conditions(arguments)?, arguments.seed, MAX_FLOWS, Arc::new(Box::new(crate::warn)));
    let mut listen = arguments.listen;
    let unheard = |error: std::io::Error| ClientFailure::Failed(error.to_string());
    if !arguments.udp {
        listen = network.relay_tcp(listen, arguments.to).map_err(unheard)?;
    }
    if !arguments.tcp {
        listen = network.relay_udp(listen, arguments.to).map_err(unheard)?;
    }
    crate::say!("palpate-client proxy: {listen} leads to {}", arguments.to);
    interrupted().await;
    let Passed { flows, packets, bytes } = network.passed();
    if arguments.json {
        crate::tell!("{}", json!({ "flows": flows, "packets": packets, "bytes": bytes }));
    } else {
        let way = |way: usize| format!("{} packets, {} bytes", packets[way], bytes[way]);
        table::print(&[("flows", flows.to_string()), ("to the server", way(0)), ("back", way(1))]);
    }
    Ok(())
}

fn conditions(arguments: &ProxyArguments) -> Result<Conditions, Refusal> {
    let part = |field: &str, value: f64, range: &str, least: f64, most: f64| {
        number(field, value, range, |value| (least..=most).contains(&value))
    };
    Ok(Conditions {
        round_trip_s: 2e-3 * part("--delay-ms", arguments.delay_ms, "from 0 to 10000", 0.0, 1e4)?,
        jitter_s: 1e-3 * part("--jitter-ms", arguments.jitter_ms, "from 0 to 10000", 0.0, 1e4)?,
        loss: part("--loss", arguments.loss, "from 0 to 1", 0.0, 1.0)?,
        burst: part("--loss-burst", arguments.loss_burst, "from 1 to 1000", 1.0, 1e3)?,
        outage_s: 1e-3 * part("--outage-ms", arguments.outage_ms, "from 0 to 900", 0.0, 900.0)?,
        ..Conditions::default()
    })
}
