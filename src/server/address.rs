//! Addresses: which of them count as one caller, and the parts of one.

use std::net::IpAddr;

/// The network that limits per address count: of IPv6 the first 64 bits, because each client there has 2⁶⁴ addresses.
pub(super) fn network(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => IpAddr::V6((u128::from(address) >> 64 << 64).into()),
        IpAddr::V4(address) => IpAddr::V4(address),
    }
}

/// The name of an address's account. Addresses of one IPv6 network of 64 bits share an account.
pub(super) fn address_name(address: IpAddr) -> String {
    format!("address:{}", network(address))
}

/// The parts of HOST:PORT.
pub(super) fn host_and_port(text: &str) -> Option<(String, u16)> {
    let (host, port) = text.rsplit_once(':')?;
    let is_host = !host.is_empty() && (!host.contains(':') || host.starts_with('[') && host.ends_with(']'));
    is_host.then_some((host.to_owned(), port.parse().ok().filter(|port| *port > 0)?))
}
