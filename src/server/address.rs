//! IP addresses: the network that limits are counted by, and parsing of HOST:PORT.

use std::net::IpAddr;

/// Returns the network that limits per address are counted by: the first 64 bits of an IPv6 address, since one client
/// has 2⁶⁴ of them; all of an IPv4 address.
pub(super) fn network(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => IpAddr::V6((u128::from(address) >> 64 << 64).into()),
        IpAddr::V4(address) => IpAddr::V4(address),
    }
}

/// Returns the account name of an address. Addresses of one IPv6 network of 64 bits share an account.
pub(super) fn address_name(address: IpAddr) -> String {
    format!("address:{}", network(address))
}

/// Parses HOST:PORT. `None` if the host is empty, an IPv6 host lacks its brackets, or the port is 0 or not a number.
pub(super) fn host_and_port(text: &str) -> Option<(String, u16)> {
    let (host, port) = text.rsplit_once(':')?;
    let is_host = !host.is_empty() && (!host.contains(':') || host.starts_with('[') && host.ends_with(']'));
    is_host.then_some((host.to_owned(), port.parse().ok().filter(|port| *port > 0)?))
}
