//! A bad network on this machine: forwards data sent to a local address, by TCP or UDP, to another address with a
//! delay, or loses it.

use std::io::{self, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use palpate_client::bridge::Warn;

use crate::network::{Conditions, Direction, Transport};

/// Usual maximum number of concurrent flows (connections, and senders of datagrams) for [`RelayNetwork::new`].
pub const MAX_FLOWS: u64 = 64;

/// Maximum number of packets of a flow under way in each direction; beyond it, TCP waits and datagrams are lost.
const MAX_UNDER_WAY: usize = 4096;

/// Time of silence after which a sender of datagrams counts as gone.
const GONE: Duration = Duration::from_secs(60);

/// Bytes read at a time: from TCP a packet's payload, from UDP a whole datagram.
const PACKET_BYTES: [usize; 2] = [1400, 65536];

#[derive(Default)]
struct PacketCounts {
    flows: AtomicU64,
    open: AtomicU64,
    packets: [AtomicU64; 2],
    bytes: [AtomicU64; 2],
}

/// The totals of what was forwarded so far. Pairs count what went to the server, then what came back.
pub struct Passed {
    /// Number of connections and of senders of datagrams, including those that have ended.
    pub flows: u64,
    /// Number of packets that passed the network; of TCP, pieces of at most 1400 bytes.
    pub packets: [u64; 2],
    /// Number of bytes in these packets.
    pub bytes: [u64; 2],
}

/// The simulated network that all relayed flows go through. Each flow has delays and losses of its own; outages are
/// common to all.
pub struct RelayNetwork {
    conditions: [Conditions; 2],
    most_flows: u64,
    seed: u64,
    begun: Instant,
    counts: PacketCounts,
    warn: Arc<Warn>,
}

impl RelayNetwork {
    /// Creates a network with these conditions for at most `most_flows` concurrent flows; further ones are refused.
    /// The conditions' transport is ignored: it follows from the flow. `seed` determines the random numbers, and time
    /// counts from now. `warn` is called, on any thread, with messages about flows that are not relayed.
    pub fn new(conditions: Conditions, seed: u64, most_flows: u64, warn: Arc<Warn>) -> Arc<Self> {
        let of = |transport| Conditions { transport, ..conditions };
        let conditions = [of(Transport::Stream), of(Transport::Datagram)];
        Arc::new(RelayNetwork {
            conditions,
            most_flows,
            seed,
            begun: Instant::now(),
            counts: PacketCounts::default(),
            warn,
        })
    }

    /// Relays connections to `listen` to the address `to`, on threads of its own, until the program ends. Returns the
    /// bound address: port 0 of `listen` stands for any free one. Call it any number of times.
    ///
    /// # Errors
    /// Returns an error if `listen` is not free or not of this machine, or if no thread can be started.
    pub fn relay_tcp(self: &Arc<Self>, listen: SocketAddr, to: SocketAddr) -> io::Result<SocketAddr> {
        let refused = |error: io::Error| io::Error::new(error.kind(), format!("can't listen on {listen}: {error}"));
        let listener = TcpListener::bind(listen).map_err(refused)?;
        let bound = listener.local_addr().map_err(refused)?;
        let network = self.clone();
        thread(move || accept(&listener, to, &network))?;
        Ok(bound)
    }

    /// Relays datagrams to `listen` to the address `to`, on threads of its own, until the program ends, and the
    /// answers back to each sender; a flow ends after 60 s without an answer. Returns the bound address: port 0 of
    /// `listen` stands for any free one. Call it any number of times.
    ///
    /// # Errors
    /// Returns an error if `listen` is not free or not of this machine, or if no thread can be started.
    pub fn relay_udp(self: &Arc<Self>, listen: SocketAddr, to: SocketAddr) -> io::Result<SocketAddr> {
        let refused = |error: io::Error| io::Error::new(error.kind(), format!("can't listen on {listen}: {error}"));
        let socket = UdpSocket::bind(listen).map_err(refused)?;
        let bound = socket.local_addr().map_err(refused)?;
        let network = self.clone();
        thread(move || receive(&socket, to, &network))?;
        Ok(bound)
    }

    /// Returns the totals so far, over all flows.
    pub fn passed(&self) -> Passed {
        let PacketCounts { flows, packets, bytes, .. } = &self.counts;
        let read = |counts: &[AtomicU64; 2]| [0, 1].map(|way| counts[way].load(Ordering::Relaxed));
        Passed { flows: flows.load(Ordering::Relaxed), packets: read(packets), bytes: read(bytes) }
    }
}

fn thread(work: impl FnOnce() + Send + 'static) -> io::Result<()> {
    let begun = std::thread::Builder::new().spawn(work).map(drop);
    begun.map_err(|error| io::Error::new(error.kind(), format!("can't start a thread: {error}")))
}

/// One direction of a flow: the packets that were read and have not arrived.
struct RelayDirection {
    network: Arc<RelayNetwork>,
    way: usize,
    inner: Mutex<RelayState>,
    changed: Condvar,
}

struct RelayState {
    direction: Direction<Vec<u8>>,
    is_over: bool,
}

impl RelayDirection {
    fn new(network: &Arc<RelayNetwork>, transport: Transport, flow: u64, way: usize) -> Arc<Self> {
        let conditions = network.conditions[usize::from(transport == Transport::Datagram)];
        // All flows share the outages of the seed, which uses the first streams of random numbers.
        let direction = Direction::new(conditions, network.seed, 8 + 2 * flow + way as u64, 0.0);
        let inner = Mutex::new(RelayState { direction, is_over: false });
        Arc::new(RelayDirection { network: network.clone(), way, inner, changed: Condvar::new() })
    }

    fn lock(&self) -> MutexGuard<'_, RelayState> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn now_s(&self) -> f64 {
        self.network.begun.elapsed().as_secs_f64()
    }

    /// Sends a packet into the network. If there is no room, waits for it if `waits` is set, else drops the packet.
    fn send(&self, packet: &[u8], waits: bool) {
        let mut inner = self.lock();
        while waits && !inner.is_over && inner.direction.under_way() >= MAX_UNDER_WAY {
            inner = self.changed.wait(inner).unwrap_or_else(PoisonError::into_inner);
        }
        if inner.is_over || inner.direction.under_way() >= MAX_UNDER_WAY {
            return;
        }
        inner.direction.send(self.now_s(), packet.len() as u64, packet.to_vec());
        self.changed.notify_all();
    }

    /// Ends the direction: nothing more is sent.
    fn end(&self) {
        self.lock().is_over = true;
        self.changed.notify_all();
    }

    /// Waits for the next packet to arrive; `None` after the last.
    fn next(&self) -> Option<Vec<u8>> {
        let mut inner = self.lock();
        loop {
            let now_s = self.now_s();
            if let Some(packet) = inner.direction.receive(now_s) {
                self.changed.notify_all();
                let PacketCounts { packets, bytes, .. } = &self.network.counts;
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
struct Flow(Arc<RelayNetwork>, u64);

impl Flow {
    fn begin(network: &Arc<RelayNetwork>) -> Option<Flow> {
        let PacketCounts { open, flows, .. } = &network.counts;
        if open.fetch_add(1, Ordering::Relaxed) >= network.most_flows {
            open.fetch_sub(1, Ordering::Relaxed);
            (network.warn)("too many connections at a time: one was refused");
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

/// Accepts and relays connections.
fn accept(listener: &TcpListener, to: SocketAddr, network: &Arc<RelayNetwork>) {
    for near in listener.incoming() {
        let relayed = near.and_then(|near| {
            let Some(flow) = Flow::begin(network) else { return Ok(()) };
            let far = TcpStream::connect(to)?;
            near.set_nodelay(true)?;
            far.set_nodelay(true)?;
            let flow = Arc::new(flow);
            for (way, from, to) in [(0, near.try_clone()?, far.try_clone()?), (1, far, near)] {
                let (flow, way) = (flow.clone(), RelayDirection::new(network, Transport::Stream, flow.1, way));
                let begun = thread({
                    let way = way.clone();
                    move || read(from, &way)
                });
                let _ = begun.and_then(|()| thread(move || write(to, &way, &flow)));
            }
            Ok(())
        });
        if let Err(error) = relayed {
            (network.warn)(&format!("a connection was not relayed: {error}"));
        }
    }
}

fn read(mut from: TcpStream, way: &RelayDirection) {
    let mut packet = [0; PACKET_BYTES[0]];
    while let Ok(bytes @ 1..) = from.read(&mut packet) {
        way.send(&packet[..bytes], true);
    }
    way.end();
}

fn write(mut to: TcpStream, way: &RelayDirection, _flow: &Flow) {
    while let Some(packet) = way.next() {
        if to.write_all(&packet).is_err() {
            way.end();
            // Its reader notices the shutdown.
            let _ = to.shutdown(Shutdown::Both);
            return;
        }
    }
    let _ = to.shutdown(Shutdown::Write);
}

/// Relays datagrams, those of each sender from a socket of its own.
fn receive(near: &UdpSocket, to: SocketAddr, network: &Arc<RelayNetwork>) {
    let mut senders: Vec<(SocketAddr, Arc<RelayDirection>)> = Vec::new();
    let mut packet = vec![0; PACKET_BYTES[1]];
    loop {
        // An error concerns an earlier packet, to a sender that has gone.
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
                    (network.warn)(&format!("datagrams of {from} are not relayed: {error}"));
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
    network: &Arc<RelayNetwork>,
) -> io::Result<Option<Arc<RelayDirection>>> {
    let Some(flow) = Flow::begin(network) else { return Ok(None) };
    let any = if to.is_ipv4() { SocketAddr::from(([0, 0, 0, 0], 0)) } else { SocketAddr::from(([0_u16; 8], 0)) };
    let far = UdpSocket::bind(any)?;
    far.connect(to)?;
    far.set_read_timeout(Some(GONE))?;
    let [up, down] = [0, 1].map(|way| RelayDirection::new(network, Transport::Datagram, flow.1, way));
    let (near, back, answers) = (near.try_clone()?, far.try_clone()?, down.clone());
    let gone = up.clone();
    // A server that is not running yet causes an error, and may start later.
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
    })?;
    thread(move || {
        while let Some(packet) = down.next() {
            let _ = near.send_to(&packet, from);
        }
    })?;
    thread({
        let up = up.clone();
        move || {
            while let Some(packet) = up.next() {
                let _ = far.send(&packet);
            }
            drop(flow);
        }
    })?;
    Ok(Some(up))
}
