//! Accepts connections, plain or TLS. Limits their number, the time until a client's first bytes, and the rate of
//! calls; counts the bytes that they carry. No connection waits for the handshake of another.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, Weak};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use futures_util::stream::Stream;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, Sleep};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::server::Connected;
use tracing::{debug, warn};

use super::address::{address_name, network};
use super::connection_leases::LastingLeases;
use super::rate::RateLimiter;
use super::reload::Reloaded;
use super::tls::{self, Tls};
use super::traffic::{Open, Traffic};
use super::transport::{FrameParser, Gate, ReadPause};
use palpate_session::budget::{Budget, Purpose, Resource, Taken};
use palpate_tissue::limits::Limits;
use palpate_tissue::lock::lock;

/// Pause before accepting again after an error, so that file descriptors can become free again.
const ACCEPT_RETRY: Duration = Duration::from_millis(100);

/// Bytes that a client must send before its deadline: the length of HTTP/2's connection preface. An HTTP/1.1 request
/// is longer.
const PREFACE_BYTES: usize = 24;

/// Interval between two accepted connections: a thousand that arrive at once would otherwise occupy a core for tens
/// of milliseconds. The others wait in the system's queue.
const ACCEPT_INTERVAL: Duration = Duration::from_millis(1);

/// Connections that may exceed the limits for a moment, while connections that the server is closing are still open.
const CLOSING: usize = 16;
/// Bytes that a connection may read before it yields to the others: small frames cost some hundred nanoseconds each.
const BYTES_PER_TURN: usize = 8 << 10;

/// Accepted connections that may wait until they are served.
const QUEUE: usize = 64;

/// Returns the stream of connections to `listener`, through TLS if it is configured. It never ends and yields no
/// errors.
pub(super) fn incoming(
    listener: TcpListener,
    tls: Option<Arc<Reloaded<Tls>>>,
    slots: Arc<ConnectionSlots>,
    limits: &Limits,
    budget: Arc<Budget>,
    traffic: Arc<Traffic>,
    register: Arc<Register>,
) -> impl Stream<Item = io::Result<Connection>> + use<> {
    let (ready, connections) = mpsc::channel(QUEUE);
    let limits = limits.clone();
    tokio::spawn(async move {
        let mut interval = tokio::time::interval(ACCEPT_INTERVAL);
        interval.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            interval.tick().await;
            let (socket, address) = tokio::select! {
                // The server is shutting down.
                () = ready.closed() => return,
                accepted = listener.accept() => match accepted {
                    Ok(accepted) => accepted,
                    Err(error) => {
                        warn!(%error, "can't accept connections; retrying");
                        tokio::time::sleep(ACCEPT_RETRY).await;
                        continue;
                    }
                },
            };
            let gate = Arc::new(Gate::new(limits.connection_window_bytes));
            let slot = match slots.take(address.ip(), &gate) {
                Ok(slot) => slot,
                Err(why) => {
                    warn!(%address, "connection closed: {why}");
                    continue;
                }
            };
            let account = budget.account(&address_name(address.ip()));
            let bytes = u64::from(limits.connection_window_bytes);
            let window = match account.take(Resource::Memory(Purpose::Connections), bytes, "") {
                Ok(window) => window,
                Err(why) => {
                    warn!(%address, "connection closed: no memory for its window: {why}");
                    continue;
                }
            };
            // Nagle's algorithm would delay a sample by milliseconds. An error means that the client has closed the
            // connection; the next read reports that.
            let _ = socket.set_nodelay(true);
            let entry = AcceptedConnection::new(address, Arc::new(slot), gate, window, &limits, &traffic, &register);
            let Some(tls) = &tls else {
                let _ = ready.send(Ok(entry.connection(Transport::Plain(socket), None))).await;
                continue;
            };
            let (acceptor, ready) = (TlsAcceptor::from(tls.get().config.clone()), ready.clone());
            tokio::spawn(async move {
                let deadline = entry.deadline.deadline();
                let accepted = tokio::select! {
                    accepted = tokio::time::timeout_at(deadline, acceptor.accept(socket)) => accepted,
                    () = entry.gate.closed() => return entry.traffic.handshake_failed(address, "closed to make room"),
                };
                let stream = match accepted {
                    Ok(Ok(stream)) => stream,
                    Ok(Err(error)) => return entry.traffic.handshake_failed(address, &error.to_string()),
                    Err(_) => return entry.traffic.handshake_failed(address, "timed out"),
                };
                let certificate = stream.get_ref().1.peer_certificates().map(|chain| tls::names(chain).into());
                let _ = ready.send(Ok(entry.connection(Transport::Tls(Box::new(stream)), certificate))).await;
            });
        }
    });
    ReceiverStream::new(connections)
}

/// Limits the number of connections: in total, and per address.
#[derive(Debug)]
pub(super) struct ConnectionSlots {
    most: usize,
    most_each: usize,
    /// Limit on unauthenticated connections; `None` if the server does not authenticate callers.
    most_unauthenticated: Option<usize>,
    open: Mutex<OpenConnections>,
}

#[derive(Debug, Default)]
struct OpenConnections {
    /// Number of connections of each address that has any.
    by_address: HashMap<IpAddr, usize>,
    /// Connections that have not authenticated, the oldest first.
    unauthenticated: VecDeque<Unauthenticated>,
    last_number: u64,
}

#[derive(Debug)]
struct Unauthenticated {
    number: u64,
    address: IpAddr,
    gate: Weak<Gate>,
}

impl OpenConnections {
    /// Closes the oldest unauthenticated connection, of `address` if one is given. Returns whether there was one.
    fn close_oldest_unauthenticated(&mut self, address: Option<IpAddr>) -> bool {
        let is_meant = |other: &Unauthenticated| address.is_none_or(|address| address == other.address);
        let oldest = self.unauthenticated.iter().position(is_meant);
        let Some(oldest) = oldest.and_then(|index| self.unauthenticated.remove(index)) else { return false };
        if let Some(gate) = oldest.gate.upgrade() {
            gate.close();
        }
        true
    }
}

/// One connection's place within the limits, which dropping it frees.
#[derive(Debug)]
pub(super) struct ConnectionSlot {
    slots: Arc<ConnectionSlots>,
    address: IpAddr,
    number: u64,
    is_authenticated: AtomicBool,
}

impl ConnectionSlots {
    /// Creates the limits for as many connections as `limits` allow, of which at most `most_unauthenticated` may be
    /// unauthenticated. When a limit is reached, a new connection replaces the oldest unauthenticated one.
    pub(super) fn new(limits: &Limits, most_unauthenticated: Option<usize>) -> Self {
        let (most, most_each) = (limits.connections, limits.connections_per_address);
        ConnectionSlots { most, most_each, most_unauthenticated, open: Mutex::default() }
    }

    /// Takes a slot for a connection.
    ///
    /// # Errors
    /// Returns the reason if a limit is reached and no unauthenticated connection can be closed.
    fn take(self: &Arc<Self>, address: IpAddr, gate: &Arc<Gate>) -> Result<ConnectionSlot, String> {
        let address = network(address);
        let mut open = lock(&self.open);
        let all: usize = open.by_address.values().sum();
        let each = open.by_address.get(&address).copied().unwrap_or_default();
        // A connection that is being closed needs a moment, and counts until it has closed.
        let closing = if self.most_unauthenticated.is_some() { CLOSING } else { 0 };
        let is_full =
            all >= self.most || self.most_unauthenticated.is_some_and(|most| open.unauthenticated.len() >= most);
        if all >= self.most + closing || (is_full && !open.close_oldest_unauthenticated(None)) {
            return Err(format!("the server has {all} connections already (limits.connections)"));
        }
        let is_address_full = each >= self.most_each;
        if each >= self.most_each.saturating_add(closing)
            || (is_address_full && !open.close_oldest_unauthenticated(Some(address)))
        {
            return Err(format!("its address has {each} connections already (limits.connections_per_address)"));
        }
        *open.by_address.entry(address).or_default() += 1;
        open.last_number += 1;
        let number = open.last_number;
        if self.most_unauthenticated.is_some() {
            open.unauthenticated.push_back(Unauthenticated { number, address, gate: Arc::downgrade(gate) });
        }
        Ok(ConnectionSlot { slots: self.clone(), address, number, is_authenticated: false.into() })
    }
}

impl ConnectionSlot {
    /// Marks the connection as authenticated, so that new connections no longer replace it.
    pub(super) fn mark_authenticated(&self) {
        if !self.is_authenticated.swap(true, Ordering::Relaxed) {
            lock(&self.slots.open).unauthenticated.retain(|other| other.number != self.number);
        }
    }
}

impl Drop for ConnectionSlot {
    fn drop(&mut self) {
        let mut open = lock(&self.slots.open);
        open.unauthenticated.retain(|other| other.number != self.number);
        if let Some(each) = open.by_address.get_mut(&self.address) {
            *each -= 1;
            if *each == 0 {
                open.by_address.remove(&self.address);
            }
        }
    }
}

/// The client's side of a connection, shared by all requests on it.
#[derive(Debug, Clone)]
pub(crate) struct Peer {
    /// The client's address.
    pub(crate) address: SocketAddr,
    /// The names in the client's certificate, if it had to present one.
    pub(crate) certificate: Option<Arc<[String]>>,
    /// Rate limit for all calls.
    pub(super) calls: Arc<RateLimiter>,
    /// Rate limit for calls that create a session.
    pub(super) creations: Arc<RateLimiter>,
    /// Flow control between the connection and its transport.
    pub(super) gate: Arc<Gate>,
    /// The connection's place within the limits.
    pub(super) slot: Arc<ConnectionSlot>,
    /// Leases of tools that end with the connection.
    pub(super) leases: Arc<LastingLeases>,
    /// Numbers of the accounts that have called over this connection.
    callers: Arc<Mutex<BTreeSet<u64>>>,
    /// Whether one of the server's own services was called over it.
    pub(super) is_served: Arc<AtomicBool>,
}

impl Peer {
    /// Records that the caller with this account has called over the connection.
    pub(super) fn used_by(&self, account: u64) {
        lock(&self.callers).insert(account);
    }
}

/// The open connections by number, and the last number assigned.
#[derive(Debug, Default)]
pub(crate) struct Register(Mutex<(u64, BTreeMap<u64, Peer>)>);

impl Register {
    fn enter(&self, peer: &Peer) -> u64 {
        let mut open = lock(&self.0);
        open.0 += 1;
        let number = open.0;
        open.1.insert(number, peer.clone());
        number
    }

    /// Closes the connections over which none of the server's own services was called: they only request health,
    /// reflection or pages.
    pub(super) fn close_strangers(&self) {
        let open = lock(&self.0);
        let strangers = open.1.values().filter(|peer| !peer.is_served.load(Ordering::Relaxed));
        strangers.for_each(|peer| peer.gate.close());
    }

    /// Closes the connections over which this account has called. Returns their number.
    pub(super) fn cut(&self, account: u64) -> usize {
        let open = lock(&self.0);
        let theirs = open.1.values().filter(|peer| lock(&peer.callers).contains(&account));
        theirs.map(|peer| peer.gate.close()).count()
    }
}

/// An accepted connection before its TLS handshake.
struct AcceptedConnection {
    address: SocketAddr,
    /// The memory reserved for unread data.
    window: Taken,
    calls: RateLimiter,
    creations: RateLimiter,
    /// Deadline for the handshake and the first bytes together.
    deadline: Pin<Box<Sleep>>,
    traffic: Arc<Traffic>,
    register: Arc<Register>,
    slot: Arc<ConnectionSlot>,
    gate: Arc<Gate>,
}

impl AcceptedConnection {
    fn new(
        address: SocketAddr,
        slot: Arc<ConnectionSlot>,
        gate: Arc<Gate>,
        window: Taken,
        limits: &Limits,
        traffic: &Arc<Traffic>,
        register: &Arc<Register>,
    ) -> Self {
        let per_minute = limits.sessions_per_minute;
        AcceptedConnection {
            address,
            window,
            calls: RateLimiter::new(limits.calls_per_s, limits.calls_per_s, "calls of this connection"),
            creations: RateLimiter::new(per_minute / 60.0, per_minute, "sessions created over this connection"),
            deadline: Box::pin(tokio::time::sleep(Duration::from_secs_f64(limits.handshake_s))),
            traffic: traffic.clone(),
            register: register.clone(),
            slot,
            gate,
        }
    }

    fn connection(self, transport: Transport, certificate: Option<Arc<[String]>>) -> Connection {
        let AcceptedConnection { address, window, calls, creations, deadline, traffic, register, slot, gate } = self;
        debug!(%address, "connected");
        let peer = Peer {
            address,
            certificate,
            calls: Arc::new(calls),
            creations: Arc::new(creations),
            leases: Arc::default(),
            gate,
            slot,
            callers: Arc::default(),
            is_served: Arc::default(),
        };
        Connection {
            transport,
            inward: FrameParser::default(),
            outward: FrameParser::of_server(),
            read_pause: ReadPause::new(),
            preface: Some((PREFACE_BYTES, deadline)),
            _open: traffic.open(),
            traffic,
            number: register.enter(&peer),
            register,
            peer,
            bytes_this_turn: 0,
            _window: window,
        }
    }
}

enum Transport {
    Plain(TcpStream),
    Tls(Box<TlsStream<TcpStream>>),
}

/// An accepted connection that counts the bytes it carries, before encryption.
pub(super) struct Connection {
    transport: Transport,
    peer: Peer,
    /// Parsers of the frames received and sent.
    inward: FrameParser,
    outward: FrameParser,
    read_pause: ReadPause,
    /// Until the client has sent enough bytes: the number still missing, and the deadline.
    preface: Option<(usize, Pin<Box<Sleep>>)>,
    traffic: Arc<Traffic>,
    register: Arc<Register>,
    number: u64,
    /// Bytes read since the connection last yielded to others.
    bytes_this_turn: usize,
    _open: Open,
    _window: Taken,
}

impl Drop for Connection {
    fn drop(&mut self) {
        lock(&self.register.0).1.remove(&self.number);
        self.peer.leases.end(|_| true);
    }
}

impl Connection {
    /// Returns an error if the connection is to be closed; otherwise registers the current task to be woken when it
    /// is.
    fn check_open(&self, context: &Context<'_>) -> io::Result<()> {
        if self.peer.gate.is_closed(context) { Err(io::ErrorKind::ConnectionAborted.into()) } else { Ok(()) }
    }

    /// Counts the first `bytes` bytes of `slices` as sent, and parses their frames.
    fn count_sent(&mut self, slices: &[io::IoSlice<'_>], bytes: usize) {
        self.traffic.bytes_out.inc_by(bytes as u64);
        // An HTTP/1.1 answer has no frames.
        if !self.inward.are_read() {
            return;
        }
        let mut left = bytes;
        for slice in slices {
            let here = &slice[..slice.len().min(left)];
            left -= here.len();
            if let Some(cut) = self.outward.pass(here, None) {
                self.traffic.cut(self.peer.address, "server", &cut);
            }
        }
    }
}

impl Connected for Connection {
    type ConnectInfo = Peer;

    fn connect_info(&self) -> Peer {
        self.peer.clone()
    }
}

impl AsyncRead for Connection {
    fn poll_read(self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        this.check_open(cx)?;
        ready!(this.read_pause.poll(&this.peer.gate, cx));
        if this.bytes_this_turn >= BYTES_PER_TURN {
            this.bytes_this_turn = 0;
            cx.waker().wake_by_ref();
            return Poll::Pending;
        }
        let before = buffer.filled().len();
        let polled = match &mut this.transport {
            Transport::Plain(stream) => Pin::new(stream).poll_read(cx, buffer),
            Transport::Tls(stream) => Pin::new(stream).poll_read(cx, buffer),
        };
        let received = &buffer.filled()[before..];
        this.traffic.bytes_in.inc_by(received.len() as u64);
        if let Some(cut) = this.inward.pass(received, Some(&this.peer.gate)) {
            this.traffic.cut(this.peer.address, "client", &cut);
        }
        // Pending: the socket is empty, so other connections run anyway.
        this.bytes_this_turn = if polled.is_pending() { 0 } else { this.bytes_this_turn + received.len() };
        let Some((left, deadline)) = &mut this.preface else { return polled };
        if polled.is_pending() {
            ready!(deadline.as_mut().poll(cx));
            this.traffic.stayed_silent(this.peer.address);
            return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
        }
        *left = left.saturating_sub(received.len());
        if *left == 0 {
            this.preface = None;
        }
        polled
    }
}

impl AsyncWrite for Connection {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        self.poll_write_vectored(cx, &[io::IoSlice::new(bytes)])
    }

    fn poll_write_vectored(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        this.check_open(cx)?;
        let polled = match &mut this.transport {
            Transport::Plain(stream) => Pin::new(stream).poll_write_vectored(cx, slices),
            Transport::Tls(stream) => Pin::new(stream).poll_write_vectored(cx, slices),
        };
        if let Poll::Ready(Ok(bytes)) = &polled {
            this.count_sent(slices, *bytes);
        }
        polled
    }

    fn is_write_vectored(&self) -> bool {
        match &self.transport {
            Transport::Plain(stream) => stream.is_write_vectored(),
            Transport::Tls(stream) => stream.is_write_vectored(),
        }
    }

    fn poll_flush(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        match &mut self.get_mut().transport {
            Transport::Plain(stream) => Pin::new(stream).poll_flush(cx),
            Transport::Tls(stream) => Pin::new(stream).poll_flush(cx),
        }
    }

    fn poll_shutdown(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        match &mut self.get_mut().transport {
            Transport::Plain(stream) => Pin::new(stream).poll_shutdown(cx),
            Transport::Tls(stream) => Pin::new(stream).poll_shutdown(cx),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slots(most_unauthenticated: Option<usize>) -> Arc<ConnectionSlots> {
        let limits = Limits { connections: 5, connections_per_address: 3, ..Limits::default() };
        Arc::new(ConnectionSlots::new(&limits, most_unauthenticated))
    }

    fn take(slots: &Arc<ConnectionSlots>, address: &str) -> Result<(ConnectionSlot, Arc<Gate>), String> {
        let gate = Arc::new(Gate::new(1 << 20));
        slots.take(address.parse().unwrap(), &gate).map(|slot| (slot, gate))
    }

    #[test]
    fn one_address_does_not_get_all_connections_and_a_closed_one_makes_room() {
        let slots = slots(None);
        let mut greedy: Vec<_> = (0..3).map(|_| take(&slots, "192.0.2.1").unwrap()).collect();
        assert!(take(&slots, "::ffff:192.0.2.1").is_err_and(|why| why.contains("per_address")));
        // Two addresses of one network.
        let others = [take(&slots, "2001:db8::1").unwrap(), take(&slots, "2001:db8::ffff:1").unwrap()];
        assert!(take(&slots, "192.0.2.2").is_err_and(|why| why.contains("limits.connections)")));
        greedy.pop();
        let third = take(&slots, "2001:db8:0:0:1::").unwrap();
        drop((greedy, third));
        assert_eq!(lock(&slots.open).by_address.len(), 1);
        drop(others);
        assert!(lock(&slots.open).by_address.is_empty());
    }

    #[tokio::test]
    async fn unauthenticated_connections_make_room_for_others_and_authenticated_ones_stay() {
        let slots = slots(Some(2));
        let is_closed = async |gate: &Gate| futures_util::poll!(std::pin::pin!(gate.closed())).is_ready();
        let known: Vec<_> = (1..=3).map(|host| take(&slots, &format!("192.0.2.{host}")).unwrap()).collect();
        // The third took the slot of the first, which had not authenticated yet.
        assert!(is_closed(&known[0].1).await && !is_closed(&known[1].1).await);
        known.iter().for_each(|(slot, _)| slot.mark_authenticated());
        let unknown: Vec<_> = (4..=30).map_while(|host| take(&slots, &format!("192.0.2.{host}")).ok()).collect();
        // Connections that do not close when asked to take only a few slots.
        assert_eq!(known.len() + unknown.len(), 5 + CLOSING);
        for (_, gate) in &known[1..] {
            assert!(!is_closed(gate).await);
        }
        drop(unknown);
        assert!(lock(&slots.open).unauthenticated.is_empty());
        // The same within one address: its own unauthenticated connections are closed.
        let first = take(&slots, "192.0.2.2").unwrap();
        let _second = take(&slots, "192.0.2.2").unwrap();
        drop(known);
        let _third = take(&slots, "192.0.2.2").unwrap();
        assert!(is_closed(&first.1).await);
    }
}
