//! Connections as they come, plain or through TLS: how many there may be, how long one may take to say what it wants, how
//! fast it may ask, and what it carries. None waits for another's handshake.

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

use super::leases::Leases;
use super::metrics::{Open, Traffic};
use super::rate::Turnstile;
use super::reload::Reloaded;
use super::tls::{self, Tls};
use super::transport::{Frames, Gate, Holdback};
use super::visitor::address_name;
use crate::budget::{Budget, Purpose, Resource, Taken};
use crate::limits::Limits;
use crate::lock::lock;

/// After the system could not give us a connection: file descriptors that have run out come back.
const PAUSE: Duration = Duration::from_millis(100);

/// Bytes with which any client of ours begins: the preface of HTTP/2.
const GREETING_BYTES: usize = 24;

/// Between two connections that are taken in: a thousand that come at once (and, if they say nothing, are closed at once)
/// would keep a core from all others for tens of milliseconds. Those that wait do so in the system.
const APART: Duration = Duration::from_millis(1);

/// Connections above the limits that are there for a moment, while those go that were sent away.
const LEAVING: usize = 16;
/// After so many bytes of one connection the others get their turn: small frames, of which nobody need read anything (PING,
/// SETTINGS, WINDOW_UPDATE, PRIORITY), cost a hundred nanoseconds each.
const BYTES_A_TURN: usize = 8 << 10;

/// Connections that wait to be served.
const WAITING: usize = 64;

/// The connections to `listener`, through TLS if there is a configuration for it. Never ends, and never fails.
pub(super) fn incoming(
    listener: TcpListener,
    tls: Option<Arc<Reloaded<Tls>>>,
    seats: Arc<Seats>,
    limits: &Limits,
    budget: Arc<Budget>,
    traffic: Arc<Traffic>,
    register: Arc<Register>,
) -> impl Stream<Item = io::Result<Connection>> + use<> {
    let (ready, connections) = mpsc::channel(WAITING);
    let limits = limits.clone();
    tokio::spawn(async move {
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
            let gate = Arc::new(Gate::new(limits.connection_window_bytes));
            let seat = match seats.take(address.ip(), &gate) {
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
            let entry = Entry::new(address, Arc::new(seat), gate, window, &limits, &traffic, &register);
            let Some(tls) = &tls else {
                let _ = ready.send(Ok(entry.connection(Transport::Plain(socket), None))).await;
                continue;
            };
            let (acceptor, ready) = (TlsAcceptor::from(tls.get().config.clone()), ready.clone());
            tokio::spawn(async move {
                let deadline = entry.deadline.deadline();
                let accepted = tokio::select! {
                    accepted = tokio::time::timeout_at(deadline, acceptor.accept(socket)) => accepted,
                    () = entry.gate.closed() => return entry.traffic.handshake_failed(address, "others came"),
                };
                let stream = match accepted {
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
#[derive(Debug)]
pub(super) struct Seats {
    most: usize,
    most_each: usize,
    /// Of those, for who has not shown who they are; nobody is asked if there is none.
    strangers: Option<usize>,
    taken: Mutex<Occupied>,
}

#[derive(Debug, Default)]
struct Occupied {
    /// By address; those that have none are left out.
    each: HashMap<IpAddr, usize>,
    /// Who has not shown who they are, the oldest first.
    strangers: VecDeque<Stranger>,
    numbers: u64,
}

#[derive(Debug)]
struct Stranger {
    number: u64,
    address: IpAddr,
    gate: Weak<Gate>,
}

impl Occupied {
    /// Closes the connection of the stranger who has been there longest, of this address if one is given; tells if there
    /// was one.
    fn send_away(&mut self, of: Option<IpAddr>) -> bool {
        let oldest = self.strangers.iter().position(|stranger| of.is_none_or(|address| address == stranger.address));
        let Some(stranger) = oldest.and_then(|index| self.strangers.remove(index)) else { return false };
        if let Some(gate) = stranger.gate.upgrade() {
            gate.close();
        }
        true
    }
}

/// A connection's, until it is dropped.
#[derive(Debug)]
pub(super) struct Seat {
    seats: Arc<Seats>,
    address: IpAddr,
    number: u64,
    known: AtomicBool,
}

impl Seats {
    /// For as many connections as `limits` say; who has not shown who they are gets `strangers` at most, and has to go when
    /// others come.
    pub(super) fn new(limits: &Limits, strangers: Option<usize>) -> Self {
        let (most, most_each) = (limits.connections, limits.connections_per_address);
        Seats { most, most_each, strangers, taken: Mutex::default() }
    }

    /// A seat, or why there is none.
    fn take(self: &Arc<Self>, address: IpAddr, gate: &Arc<Gate>) -> Result<Seat, String> {
        let address = network(address);
        let mut taken = lock(&self.taken);
        let all: usize = taken.each.values().sum();
        let each = taken.each.get(&address).copied().unwrap_or_default();
        // Who is sent away needs a moment to go, and counts until then.
        let leaving = if self.strangers.is_some() { LEAVING } else { 0 };
        let is_full = all >= self.most || self.strangers.is_some_and(|most| taken.strangers.len() >= most);
        if all >= self.most + leaving || (is_full && !taken.send_away(None)) {
            return Err(format!("there are {all} already (limits.connections)"));
        }
        if each >= self.most_each.saturating_add(leaving) || (each >= self.most_each && !taken.send_away(Some(address)))
        {
            return Err(format!("its address has {each} already (limits.connections_per_address)"));
        }
        *taken.each.entry(address).or_default() += 1;
        taken.numbers += 1;
        let number = taken.numbers;
        if self.strangers.is_some() {
            taken.strangers.push_back(Stranger { number, address, gate: Arc::downgrade(gate) });
        }
        Ok(Seat { seats: self.clone(), address, number, known: false.into() })
    }
}

impl Seat {
    /// Who has it has shown who they are.
    pub(super) fn is_known(&self) {
        if !self.known.swap(true, Ordering::Relaxed) {
            lock(&self.seats.taken).strangers.retain(|stranger| stranger.number != self.number);
        }
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        let mut taken = lock(&self.seats.taken);
        taken.strangers.retain(|stranger| stranger.number != self.number);
        if let Some(each) = taken.each.get_mut(&self.address) {
            *each -= 1;
            if *each == 0 {
                taken.each.remove(&self.address);
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
    /// Between the connection and its transport.
    pub(super) gate: Arc<Gate>,
    /// For when it has shown who it is.
    pub(super) seat: Arc<Seat>,
    /// Tools that are let go when it ends.
    pub(super) leases: Arc<Leases>,
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
        theirs.map(|peer| peer.gate.close()).count()
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
    seat: Arc<Seat>,
    gate: Arc<Gate>,
}

impl Entry {
    fn new(
        address: SocketAddr,
        seat: Arc<Seat>,
        gate: Arc<Gate>,
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
            gate,
        }
    }

    fn connection(self, transport: Transport, certificate: Option<Arc<[String]>>) -> Connection {
        let Entry { address, window, calls, creations, deadline, traffic, register, seat, gate } = self;
        debug!(%address, "connected");
        let peer = Peer {
            address,
            certificate,
            calls: Arc::new(calls),
            creations: Arc::new(creations),
            leases: Arc::default(),
            gate,
            seat,
            callers: Arc::default(),
        };
        Connection {
            transport,
            inward: Frames::default(),
            outward: Frames::of_server(),
            holdback: Holdback::default(),
            greeting: Some((GREETING_BYTES, deadline)),
            _open: traffic.open(),
            traffic,
            number: register.enter(&peer),
            register,
            peer,
            unyielded: 0,
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
    /// What comes and what goes.
    inward: Frames,
    outward: Frames,
    holdback: Holdback,
    /// Until so many bytes have come, it has so long.
    greeting: Option<(usize, Pin<Box<Sleep>>)>,
    traffic: Arc<Traffic>,
    register: Arc<Register>,
    number: u64,
    /// Bytes since others had their turn.
    unyielded: usize,
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
    /// Fails if the connection is to be closed, and wakes who asks when it is.
    fn check_open(&self, context: &Context<'_>) -> io::Result<()> {
        if self.peer.gate.is_closed(context) { Err(io::ErrorKind::ConnectionAborted.into()) } else { Ok(()) }
    }

    /// So many bytes of `slices` were sent.
    fn went(&mut self, slices: &[io::IoSlice<'_>], bytes: usize) {
        self.traffic.bytes_out.inc_by(bytes as u64);
        // What the answer of HTTP/1.1 is made of are no frames.
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
        ready!(this.holdback.poll(&this.peer.gate, cx));
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
        let came = &buffer.filled()[before..];
        this.traffic.bytes_in.inc_by(came.len() as u64);
        if let Some(cut) = this.inward.pass(came, Some(&this.peer.gate)) {
            this.traffic.cut(this.peer.address, "client", &cut);
        }
        // Nothing waits: the others had their turn, or will.
        this.unyielded = if polled.is_pending() { 0 } else { this.unyielded + came.len() };
        let Some((left, deadline)) = &mut this.greeting else { return polled };
        if polled.is_pending() {
            ready!(deadline.as_mut().poll(cx));
            this.traffic.stayed_silent(this.peer.address);
            return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
        }
        *left = left.saturating_sub(came.len());
        if *left == 0 {
            this.greeting = None;
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
            this.went(slices, *bytes);
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

    fn seats(strangers: Option<usize>) -> Arc<Seats> {
        let limits = Limits { connections: 5, connections_per_address: 3, ..Limits::default() };
        Arc::new(Seats::new(&limits, strangers))
    }

    fn take(seats: &Arc<Seats>, address: &str) -> Result<(Seat, Arc<Gate>), String> {
        let gate = Arc::new(Gate::new(1 << 20));
        seats.take(address.parse().unwrap(), &gate).map(|seat| (seat, gate))
    }

    #[test]
    fn one_address_does_not_take_all_seats_and_what_goes_makes_room() {
        let seats = seats(None);
        let mut greedy: Vec<_> = (0..3).map(|_| take(&seats, "192.0.2.1").unwrap()).collect();
        assert!(take(&seats, "::ffff:192.0.2.1").is_err_and(|why| why.contains("per_address")));
        // Two of one network.
        let others = [take(&seats, "2001:db8::1").unwrap(), take(&seats, "2001:db8::ffff:1").unwrap()];
        assert!(take(&seats, "192.0.2.2").is_err_and(|why| why.contains("limits.connections)")));
        greedy.pop();
        let third = take(&seats, "2001:db8:0:0:1::").unwrap();
        drop((greedy, third));
        assert_eq!(lock(&seats.taken).each.len(), 1);
        drop(others);
        assert!(lock(&seats.taken).each.is_empty());
    }

    #[tokio::test]
    async fn strangers_make_room_for_others_and_who_is_known_stays() {
        let seats = seats(Some(2));
        let is_closed = async |gate: &Gate| futures_util::poll!(std::pin::pin!(gate.closed())).is_ready();
        let known: Vec<_> = (1..=3).map(|host| take(&seats, &format!("192.0.2.{host}")).unwrap()).collect();
        // The third took the place of the first, which did not say who it is in time.
        assert!(is_closed(&known[0].1).await && !is_closed(&known[1].1).await);
        known.iter().for_each(|(seat, _)| seat.is_known());
        let strangers: Vec<_> = (4..=30).map_while(|host| take(&seats, &format!("192.0.2.{host}")).ok()).collect();
        // Those who are sent away and do not go take no more than a few places.
        assert_eq!(known.len() + strangers.len(), 5 + LEAVING);
        for (_, gate) in &known[1..] {
            assert!(!is_closed(gate).await);
        }
        drop(strangers);
        assert!(lock(&seats.taken).strangers.is_empty());
        // The same within one address: its own strangers go.
        let first = take(&seats, "192.0.2.2").unwrap();
        let _second = take(&seats, "192.0.2.2").unwrap();
        drop(known);
        let _third = take(&seats, "192.0.2.2").unwrap();
        assert!(is_closed(&first.1).await);
    }
}
