//! Connections as they come, plain or through TLS: how many there may be, how long one may take to say what it wants, how
//! fast it may ask, and what it carries. None waits for another's handshake.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use futures_util::stream::Stream;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio::time::Sleep;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::ServerConfig;
use tokio_rustls::server::TlsStream;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::server::Connected;
use tracing::{debug, warn};

use super::metrics::{Open, Traffic};
use super::rate::Turnstile;
use super::reload::Reloaded;
use super::tls;
use crate::limits::Limits;

/// After the system could not give us a connection: file descriptors that have run out come back.
const PAUSE: Duration = Duration::from_millis(100);

/// Bytes with which any client of ours begins: the preface of HTTP/2.
const GREETING_BYTES: usize = 24;

/// Connections that wait to be served.
const WAITING: usize = 64;

/// The connections to `listener`, through TLS if there is a configuration for it. Never ends, and never fails.
pub(super) fn incoming(
    listener: TcpListener,
    tls: Option<Arc<Reloaded<ServerConfig>>>,
    limits: &Limits,
    traffic: Arc<Traffic>,
) -> impl Stream<Item = io::Result<Connection>> + use<> {
    let (ready, connections) = mpsc::channel(WAITING);
    let limits = limits.clone();
    tokio::spawn(async move {
        let free = Arc::new(Semaphore::new(limits.connections));
        loop {
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
            let Ok(permit) = free.clone().try_acquire_owned() else {
                warn!(%address, connections = limits.connections, "connection closed: there are too many already");
                continue;
            };
            // Nagle's algorithm would hold a sample back for milliseconds. Who has gone already is noticed later.
            let _ = socket.set_nodelay(true);
            let entry = Entry::new(address, permit, &limits, &traffic);
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
}

/// A connection that was let in, before its handshake.
struct Entry {
    address: SocketAddr,
    calls: Turnstile,
    creations: Turnstile,
    /// For the handshake and the greeting together.
    deadline: Pin<Box<Sleep>>,
    traffic: Arc<Traffic>,
    permit: OwnedSemaphorePermit,
}

impl Entry {
    fn new(address: SocketAddr, permit: OwnedSemaphorePermit, limits: &Limits, traffic: &Arc<Traffic>) -> Self {
        let per_minute = limits.sessions_per_minute;
        Entry {
            address,
            calls: Turnstile::new(limits.calls_per_s, limits.calls_per_s, "calls of this connection"),
            creations: Turnstile::new(per_minute / 60.0, per_minute, "sessions made over this connection"),
            deadline: Box::pin(tokio::time::sleep(Duration::from_secs_f64(limits.handshake_s))),
            traffic: traffic.clone(),
            permit,
        }
    }

    fn connection(self, transport: Transport, certificate: Option<Arc<[String]>>) -> Connection {
        let Entry { address, calls, creations, deadline, traffic, permit } = self;
        debug!(%address, "connected");
        Connection {
            transport,
            peer: Peer { address, certificate, calls: Arc::new(calls), creations: Arc::new(creations) },
            greeting: Some((GREETING_BYTES, deadline)),
            _open: traffic.open(),
            traffic,
            _permit: permit,
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
    _open: Open,
    _permit: OwnedSemaphorePermit,
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
        let before = buffer.filled().len();
        let polled = match &mut this.transport {
            Transport::Plain(stream) => Pin::new(stream).poll_read(cx, buffer),
            Transport::Tls(stream) => Pin::new(stream).poll_read(cx, buffer),
        };
        let bytes = buffer.filled().len() - before;
        this.traffic.bytes_in.inc_by(bytes as u64);
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
