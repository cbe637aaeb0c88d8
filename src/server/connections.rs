//! Connections as they come, plain or through TLS: how many there may be, how long one may take to say what it wants, how
//! fast it may ask, and what it carries. None waits for another's handshake.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use futures_util::stream::Stream;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, Sleep};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::ServerConfig;
use tokio_rustls::server::TlsStream;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};
use tonic::transport::server::Connected;
use tracing::{debug, warn};

use super::leases::Leases;
use super::metrics::{Open, Traffic};
use super::rate::Turnstile;
use super::reload::Reloaded;
use super::tls;
use super::visitor::address_name;
use crate::budget::{Budget, Purpose, Resource, Taken};
use crate::limits::Limits;
use crate::pace::queue::lock;

/// After the system could not give us a connection: file descriptors that have run out come back.
const PAUSE: Duration = Duration::from_millis(100);

/// Bytes with which any client of ours begins: the preface of HTTP/2.
const GREETING_BYTES: usize = 24;

/// Between two connections that are taken in: a thousand that come at once (and, if they say nothing, are closed at once)
/// would keep a core from all others for tens of milliseconds. Those that wait do so in the system.
const APART: Duration = Duration::from_millis(1);

/// After so many bytes of one connection the others get their turn: small frames, of which nobody need read anything (PING,
/// SETTINGS, WINDOW_UPDATE, PRIORITY), cost a hundred nanoseconds each.
const BYTES_A_TURN: usize = 8 << 10;

/// Connections that wait to be served.
const WAITING: usize = 64;

/// The connections to `listener`, through TLS if there is a configuration for it. Never ends, and never fails.
pub(super) fn incoming(
    listener: TcpListener,
    tls: Option<Arc<Reloaded<ServerConfig>>>,
    limits: &Limits,
    budget: Arc<Budget>,
    traffic: Arc<Traffic>,
    register: Arc<Register>,
) -> impl Stream<Item = io::Result<Connection>> + use<> {
    let (ready, connections) = mpsc::channel(WAITING);
    let limits = limits.clone();
    tokio::spawn(async move {
        let seats = Arc::new(Seats::new(&limits));
        let mut pace = tokio::time::interval(APART);
        pace.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            pace.tick().await;
            let (socket, address) = tokio::select! {
                // Nobody takes them any more: the server is going down.
                () = ready.closed() => return,
                accepted = listener.accept() => match accepted {
                    Ok(accepted) => accepted,
                    Err(error) => {
                        warn!(%error, "no connection can be accepted; trying again");
                        tokio::time::sleep(PAUSE).await;
                        continue;
                    }
                },
            };
            let seat = match seats.take(address.ip()) {
                Ok(seat) => seat,
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
                    warn!(%address, "connection closed: its window {why}");
                    continue;
                }
            };
            // Nagle's algorithm would hold a sample back for milliseconds. Who has gone already is noticed later.
            let _ = socket.set_nodelay(true);
            let entry = Entry::new(address, seat, window, &limits, &traffic, &register);
            let Some(tls) = &tls else {
                let _ = ready.send(Ok(entry.connection(Transport::Plain(socket), None))).await;
                continue;
            };
            let (acceptor, ready) = (TlsAcceptor::from(tls.get()), ready.clone());
            tokio::spawn(async move {
                let deadline = entry.deadline.deadline();
                let stream = match tokio::time::timeout_at(deadline, acceptor.accept(socket)).await {
                    Ok(Ok(stream)) => stream,
                    Ok(Err(error)) => return entry.traffic.handshake_failed(address, &error.to_string()),
                    Err(_) => return entry.traffic.handshake_failed(address, "it took too long"),
                };
                let certificate = stream.get_ref().1.peer_certificates().map(|chain| tls::names(chain).into());
                let _ = ready.send(Ok(entry.connection(Transport::Tls(Box::new(stream)), certificate))).await;
            });
        }
    });
    ReceiverStream::new(connections)
}

/// Where somebody comes from: whoever has IPv6 has 2⁶⁴ addresses.
pub(super) fn network(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => IpAddr::V6((u128::from(address) >> 64 << 64).into()),
        IpAddr::V4(address) => IpAddr::V4(address),
    }
}

/// Room for connections: so many in all, and so many from one address.
struct Seats {
    most: usize,
    most_each: usize,
    /// By address; those that have none are left out.
    taken: Mutex<HashMap<IpAddr, usize>>,
}

/// A connection's, until it is dropped.
struct Seat {
    seats: Arc<Seats>,
    address: IpAddr,
}

impl Seats {
    fn new(limits: &Limits) -> Self {
        let (most, most_each) = (limits.connections, limits.connections_per_address);
        Seats { most, most_each, taken: Mutex::default() }
    }

    /// A seat, or why there is none.
    fn take(self: &Arc<Self>, address: IpAddr) -> Result<Seat, String> {
        let address = network(address);
        let mut taken = lock(&self.taken);
        if taken.values().sum::<usize>() >= self.most {
            return Err(format!("there are {} already (limits.connections)", self.most));
        }
        let each = taken.entry(address).or_default();
        if *each >= self.most_each {
            return Err(format!("its address has {each} already (limits.connections_per_address)"));
        }
        *each += 1;
        Ok(Seat { seats: self.clone(), address })
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        let mut taken = lock(&self.seats.taken);
        if let Some(each) = taken.get_mut(&self.address) {
            *each -= 1;
            if *each == 0 {
                taken.remove(&self.address);
            }
        }
    }
}

/// What is known of who is at the other end, for every request that comes from there.
#[derive(Debug, Clone)]
pub(crate) struct Peer {
    /// Where from.
    pub(crate) address: SocketAddr,
    /// What its certificate calls it, if it had to show one.
    pub(crate) certificate: Option<Arc<[String]>>,
    /// For calls of any kind.
    pub(super) calls: Arc<Turnstile>,
    /// For those that make a session.
    pub(super) creations: Arc<Turnstile>,
    /// Tools that are let go when it ends.
    pub(super) leases: Arc<Leases>,
    /// Cancelled when whoever administers the server has cut the connection.
    cut: CancellationToken,
    /// Accounts of those who have called over it.
    callers: Arc<Mutex<BTreeSet<u64>>>,
}

impl Peer {
    /// Somebody with that account has called.
    pub(super) fn used_by(&self, account: u64) {
        lock(&self.callers).insert(account);
    }
}

/// The connections that are open.
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

    /// Closes those over which somebody with that account has called; tells how many.
    pub(super) fn cut(&self, account: u64) -> usize {
        let open = lock(&self.0);
        let theirs = open.1.values().filter(|peer| lock(&peer.callers).contains(&account));
        theirs.map(|peer| peer.cut.cancel()).count()
    }
}

/// A connection that was let in, before its handshake.
struct Entry {
    address: SocketAddr,
    /// The memory of what comes and nobody has read.
    window: Taken,
    calls: Turnstile,
    creations: Turnstile,
    /// For the handshake and the greeting together.
    deadline: Pin<Box<Sleep>>,
    traffic: Arc<Traffic>,
    register: Arc<Register>,
    seat: Seat,
}

impl Entry {
    fn new(
        address: SocketAddr,
        seat: Seat,
        window: Taken,
        limits: &Limits,
        traffic: &Arc<Traffic>,
        register: &Arc<Register>,
    ) -> Self {
        let per_minute = limits.sessions_per_minute;
        Entry {
            address,
            window,
            calls: Turnstile::new(limits.calls_per_s, limits.calls_per_s, "calls of this connection"),
            creations: Turnstile::new(per_minute / 60.0, per_minute, "sessions made over this connection"),
            deadline: Box::pin(tokio::time::sleep(Duration::from_secs_f64(limits.handshake_s))),
            traffic: traffic.clone(),
            register: register.clone(),
            seat,
        }
    }

    fn connection(self, transport: Transport, certificate: Option<Arc<[String]>>) -> Connection {
        let Entry { address, window, calls, creations, deadline, traffic, register, seat } = self;
        debug!(%address, "connected");
        let cut = CancellationToken::new();
        let peer = Peer {
            address,
            certificate,
            calls: Arc::new(calls),
            creations: Arc::new(creations),
            leases: Arc::default(),
            cut: cut.clone(),
            callers: Arc::default(),
        };
        Connection {
            transport,
            greeting: Some((GREETING_BYTES, deadline)),
            _open: traffic.open(),
            traffic,
            is_cut: Box::pin(cut.cancelled_owned()),
            number: register.enter(&peer),
            register,
            peer,
            unyielded: 0,
            _seat: seat,
            _window: window,
        }
    }
}

enum Transport {
    Plain(TcpStream),
    Tls(Box<TlsStream<TcpStream>>),
}

/// A connection that counts what it carries, before encryption.
pub(super) struct Connection {
    transport: Transport,
    peer: Peer,
    /// Until so many bytes have come, it has so long.
    greeting: Option<(usize, Pin<Box<Sleep>>)>,
    traffic: Arc<Traffic>,
    is_cut: Pin<Box<WaitForCancellationFutureOwned>>,
    register: Arc<Register>,
    number: u64,
    /// Bytes since others had their turn.
    unyielded: usize,
    _open: Open,
    _seat: Seat,
    _window: Taken,
}

impl Drop for Connection {
    fn drop(&mut self) {
        lock(&self.register.0).1.remove(&self.number);
        self.peer.leases.end();
    }
}

impl Connection {
    fn count(&self, polled: Poll<io::Result<usize>>) -> Poll<io::Result<usize>> {
        if let Poll::Ready(Ok(bytes)) = &polled {
            self.traffic.bytes_out.inc_by(*bytes as u64);
        }
        polled
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
        if this.is_cut.as_mut().poll(cx).is_ready() {
            return Poll::Ready(Err(io::ErrorKind::ConnectionAborted.into()));
        }
        if this.unyielded >= BYTES_A_TURN {
            this.unyielded = 0;
            cx.waker().wake_by_ref();
            return Poll::Pending;
        }
        let before = buffer.filled().len();
        let polled = match &mut this.transport {
            Transport::Plain(stream) => Pin::new(stream).poll_read(cx, buffer),
            Transport::Tls(stream) => Pin::new(stream).poll_read(cx, buffer),
        };
        let bytes = buffer.filled().len() - before;
        this.traffic.bytes_in.inc_by(bytes as u64);
        // Nothing waits: the others had their turn, or will.
        this.unyielded = if polled.is_pending() { 0 } else { this.unyielded + bytes };
        let Some((left, deadline)) = &mut this.greeting else { return polled };
        if polled.is_pending() {
            ready!(deadline.as_mut().poll(cx));
            this.traffic.stayed_silent(this.peer.address);
            return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
        }
        *left = left.saturating_sub(bytes);
        if *left == 0 {
            this.greeting = None;
        }
        polled
    }
}

impl AsyncWrite for Connection {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        let polled = match &mut this.transport {
            Transport::Plain(stream) => Pin::new(stream).poll_write(cx, bytes),
            Transport::Tls(stream) => Pin::new(stream).poll_write(cx, bytes),
        };
        this.count(polled)
    }

    fn poll_write_vectored(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        let polled = match &mut this.transport {
            Transport::Plain(stream) => Pin::new(stream).poll_write_vectored(cx, slices),
            Transport::Tls(stream) => Pin::new(stream).poll_write_vectored(cx, slices),
        };
        this.count(polled)
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

    #[test]
    fn one_address_does_not_take_all_seats_and_what_goes_makes_room() {
        let limits = Limits { connections: 5, connections_per_address: 3, ..Limits::default() };
        let seats = Arc::new(Seats::new(&limits));
        let take = |address: &str| seats.take(address.parse().unwrap());
        let mut greedy: Vec<_> = (0..3).map(|_| take("192.0.2.1").unwrap()).collect();
        assert!(take("::ffff:192.0.2.1").is_err_and(|why| why.contains("per_address")));
        // Two of one network.
        let others = [take("2001:db8::1").unwrap(), take("2001:db8::ffff:1").unwrap()];
        assert!(take("192.0.2.2").is_err_and(|why| why.contains("limits.connections)")));
        greedy.pop();
        let third = take("2001:db8:0:0:1::").unwrap();
        drop((greedy, third));
        assert_eq!(lock(&seats.taken).len(), 1);
        drop(others);
        assert!(lock(&seats.taken).is_empty());
    }
}
