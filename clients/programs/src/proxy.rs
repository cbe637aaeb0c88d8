//! `palpate-client proxy`: a bad network on this machine. What a client sends to it, by TCP or UDP, goes on to a server later, or
//! not at all.

use std::io::{self, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use palpate_proto::refusal::{Refusal, number};
use serde_json::json;

use crate::simulated::network::{Conditions, Direction, Transport};
use crate::{Failure, interrupted, table, warn};

/// Arguments of `proxy`.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// Where it listens; port 0 takes a free one
    #[arg(value_name = "LISTEN")]
    listen: SocketAddr,
    /// The server
    #[arg(value_name = "TO")]
    to: SocketAddr,
    /// UDP alone [default: UDP and TCP, at the same port]
    #[arg(long, conflicts_with = "tcp")]
    udp: bool,
    /// TCP alone
    #[arg(long)]
    tcp: bool,
    /// Delay each way, ms
    #[arg(long, value_name = "MS", default_value_t = 0.0)]
    delay_ms: f64,
    /// Standard deviation of the delay each way, ms. Datagrams overtake each other; what goes by TCP stays in order
    #[arg(long, value_name = "MS", default_value_t = 0.0)]
    jitter_ms: f64,
    /// Fraction of the packets that are lost. By TCP each is sent again, which delays all later ones
    #[arg(long, value_name = "FRACTION", default_value_t = 0.0)]
    loss: f64,
    /// Mean number of packets that are lost in a row; 1: each by itself
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

/// Connections, and senders of datagrams, at a time.
const MOST_FLOWS: u64 = 64;

/// Packets of a flow that are under way each way; beyond, TCP waits and datagrams are lost.
const MOST_UNDER_WAY: usize = 4096;

/// A sender of datagrams that was silent for so long has gone.
const GONE: Duration = Duration::from_secs(60);

/// Bytes that are read at a time, from TCP as much as a packet has.
const PACKET_BYTES: [usize; 2] = [1400, 65536];

/// What went through, each way: packets and bytes.
#[derive(Default)]
struct Counts {
    flows: AtomicU64,
    open: AtomicU64,
    packets: [AtomicU64; 2],
    bytes: [AtomicU64; 2],
}

/// The network of all flows.
struct Network {
    conditions: [Conditions; 2],
    seed: u64,
    begun: Instant,
    counts: Counts,
}

/// Relays until it is interrupted, and tells what went through.
///
/// # Errors
/// Returns an error if an argument is refused or the address is not free.
pub(crate) async fn proxy(arguments: &Arguments) -> Result<(), Failure> {
    let conditions = conditions(arguments)?;
    let of = |transport| Conditions { transport, ..conditions };
    let network = Arc::new(Network {
        conditions: [of(Transport::Stream), of(Transport::Datagram)],
        seed: arguments.seed,
        begun: Instant::now(),
        counts: Counts::default(),
    });
    let refused = |error: io::Error| Failure::Failed(format!("can't listen on {}: {error}", arguments.listen));
    let mut listen = arguments.listen;
    if !arguments.udp {
        let listener = TcpListener::bind(listen).map_err(refused)?;
        listen = listener.local_addr().map_err(refused)?;
        let (network, to) = (network.clone(), arguments.to);
        thread(move || accept(&listener, to, &network))?;
    }
    if !arguments.tcp {
        let socket = UdpSocket::bind(listen).map_err(refused)?;
        listen = socket.local_addr().map_err(refused)?;
        let (network, to) = (network.clone(), arguments.to);
        thread(move || receive(&socket, to, &network))?;
    }
    crate::say!("palpate-client proxy: {listen} leads to {}", arguments.to);
    interrupted().await;
    let Counts { flows, packets, bytes, .. } = &network.counts;
    let read = |counts: &[AtomicU64; 2]| [0, 1].map(|way| counts[way].load(Ordering::Relaxed));
    let (flows, packets, bytes) = (flows.load(Ordering::Relaxed), read(packets), read(bytes));
    if arguments.json {
        crate::tell!("{}", json!({ "flows": flows, "packets": packets, "bytes": bytes }));
    } else {
        let way = |way: usize| format!("{} packets, {} bytes", packets[way], bytes[way]);
        table::print(&[("flows", flows.to_string()), ("to the server", way(0)), ("back", way(1))]);
    }
    Ok(())
}

fn conditions(arguments: &Arguments) -> Result<Conditions, Refusal> {
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

fn thread(work: impl FnOnce() + Send + 'static) -> Result<(), Failure> {
    std::thread::Builder::new()
        .spawn(work)
        .map(drop)
        .map_err(|error| Failure::Failed(format!("can't start a thread: {error}")))
}

/// One direction of a flow: what was read and has not arrived.
struct Way {
    network: Arc<Network>,
    way: usize,
    inner: Mutex<Inner>,
    changed: Condvar,
}

struct Inner {
    direction: Direction<Vec<u8>>,
    is_over: bool,
}

impl Way {
    fn new(network: &Arc<Network>, transport: Transport, flow: u64, way: usize) -> Arc<Self> {
        let conditions = network.conditions[usize::from(transport == Transport::Datagram)];
        // The outages of all flows are those of the seed. The first streams of random numbers are theirs.
        let direction = Direction::new(conditions, network.seed, 8 + 2 * flow + way as u64, 0.0);
        let inner = Mutex::new(Inner { direction, is_over: false });
        Arc::new(Way { network: network.clone(), way, inner, changed: Condvar::new() })
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn now_s(&self) -> f64 {
        self.network.begun.elapsed().as_secs_f64()
    }

    /// Sends a packet off. `waits`: waits for room, in place of dropping it.
    fn send(&self, packet: &[u8], waits: bool) {
        let mut inner = self.lock();
        while waits && !inner.is_over && inner.direction.under_way() >= MOST_UNDER_WAY {
            inner = self.changed.wait(inner).unwrap_or_else(PoisonError::into_inner);
        }
        if inner.is_over || inner.direction.under_way() >= MOST_UNDER_WAY {
            return;
        }
        inner.direction.send(self.now_s(), packet.len() as u64, packet.to_vec());
        self.changed.notify_all();
    }

    /// Nothing more comes.
    fn end(&self) {
        self.lock().is_over = true;
        self.changed.notify_all();
    }

    /// Waits for the next packet that arrives; `None` after the last.
    fn next(&self) -> Option<Vec<u8>> {
        let mut inner = self.lock();
        loop {
            let now_s = self.now_s();
            if let Some(packet) = inner.direction.receive(now_s) {
                self.changed.notify_all();
                let Counts { packets, bytes, .. } = &self.network.counts;
                packets[self.way].fetch_add(1, Ordering::Relaxed);
                bytes[self.way].fetch_add(packet.len() as u64, Ordering::Relaxed);
                return Some(packet);
            }
            inner = match inner.direction.next_s() {
                Some(next_s) => {
                    let wait = Duration::from_secs_f64((next_s - now_s).max(0.0));
                    self.changed.wait_timeout(inner, wait).unwrap_or_else(PoisonError::into_inner).0
                }
                None if inner.is_over => return None,
                None => self.changed.wait(inner).unwrap_or_else(PoisonError::into_inner),
            };
        }
    }
}

/// A place among the flows, until it is dropped.
struct Flow(Arc<Network>, u64);

impl Flow {
    fn begin(network: &Arc<Network>) -> Option<Flow> {
        let Counts { open, flows, .. } = &network.counts;
        if open.fetch_add(1, Ordering::Relaxed) >= MOST_FLOWS {
            open.fetch_sub(1, Ordering::Relaxed);
            warn("too many connections at a time: one was refused");
            return None;
        }
        Some(Flow(network.clone(), flows.fetch_add(1, Ordering::Relaxed)))
    }
}

impl Drop for Flow {
    fn drop(&mut self) {
        self.0.counts.open.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Relays connections.
fn accept(listener: &TcpListener, to: SocketAddr, network: &Arc<Network>) {
    for near in listener.incoming() {
        let relayed = near.and_then(|near| {
            let Some(flow) = Flow::begin(network) else { return Ok(()) };
            let far = TcpStream::connect(to)?;
            near.set_nodelay(true)?;
            far.set_nodelay(true)?;
            let flow = Arc::new(flow);
            for (way, from, to) in [(0, near.try_clone()?, far.try_clone()?), (1, far, near)] {
                let (flow, way) = (flow.clone(), Way::new(network, Transport::Stream, flow.1, way));
                let begun = thread({
                    let way = way.clone();
                    move || read(from, &way)
                });
                let _ = begun.and_then(|()| thread(move || write(to, &way, &flow)));
            }
            Ok(())
        });
        if let Err(error) = relayed {
            warn(&format!("a connection was not relayed: {error}"));
        }
    }
}

fn read(mut from: TcpStream, way: &Way) {
    let mut packet = [0; PACKET_BYTES[0]];
    while let Ok(bytes @ 1..) = from.read(&mut packet) {
        way.send(&packet[..bytes], true);
    }
    way.end();
}

fn write(mut to: TcpStream, way: &Way, _flow: &Flow) {
    while let Some(packet) = way.next() {
        if to.write_all(&packet).is_err() {
            way.end();
            // Its reader notices.
            let _ = to.shutdown(Shutdown::Both);
            return;
        }
    }
    let _ = to.shutdown(Shutdown::Write);
}

/// Relays datagrams, those of each sender from a socket of its own.
fn receive(near: &UdpSocket, to: SocketAddr, network: &Arc<Network>) {
    let mut senders: Vec<(SocketAddr, Arc<Way>)> = Vec::new();
    let mut packet = vec![0; PACKET_BYTES[1]];
    loop {
        // An error is of a packet that was sent before, to who has gone.
        let Ok((bytes, from)) = near.recv_from(&mut packet) else { continue };
        senders.retain(|sender| !sender.1.lock().is_over);
        let known = senders.iter().find(|sender| sender.0 == from).map(|sender| sender.1.clone());
        let way = match known {
            Some(way) => way,
            None => match begin_sender(near, from, to, network) {
                Ok(Some(way)) => {
                    senders.push((from, way.clone()));
                    way
                }
                Ok(None) => continue,
                Err(error) => {
                    warn(&format!("datagrams of {from} are not relayed: {error}"));
                    continue;
                }
            },
        };
        way.send(&packet[..bytes], false);
    }
}

fn begin_sender(
    near: &UdpSocket,
    from: SocketAddr,
    to: SocketAddr,
    network: &Arc<Network>,
) -> io::Result<Option<Arc<Way>>> {
    let Some(flow) = Flow::begin(network) else { return Ok(None) };
    let any = if to.is_ipv4() { SocketAddr::from(([0, 0, 0, 0], 0)) } else { SocketAddr::from(([0_u16; 8], 0)) };
    let far = UdpSocket::bind(any)?;
    far.connect(to)?;
    far.set_read_timeout(Some(GONE))?;
    let [up, down] = [0, 1].map(|way| Way::new(network, Transport::Datagram, flow.1, way));
    let (near, back, answers) = (near.try_clone()?, far.try_clone()?, down.clone());
    let gone = up.clone();
    let wrong = |_| io::Error::other("no thread");
    // A server that is not there yet answers by an error, and may come.
    thread(move || {
        let mut packet = vec![0; PACKET_BYTES[1]];
        loop {
            match back.recv(&mut packet) {
                Ok(bytes) => answers.send(&packet[..bytes], false),
                Err(error) if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) => break,
                Err(_) => {}
            }
        }
        answers.end();
        gone.end();
    })
    .map_err(wrong)?;
    thread(move || {
        while let Some(packet) = down.next() {
            let _ = near.send_to(&packet, from);
        }
    })
    .map_err(wrong)?;
    thread({
        let up = up.clone();
        move || {
            while let Some(packet) = up.next() {
                let _ = far.send(&packet);
            }
            drop(flow);
        }
    })
    .map_err(wrong)?;
    Ok(Some(up))
}
