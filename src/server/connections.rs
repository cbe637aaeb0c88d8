//! Connections as they come: how many there may be, how long one may take to say what it wants, and how fast it may ask.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use futures_util::stream::{self, Stream};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::Sleep;
use tonic::transport::server::Connected;
use tracing::{debug, warn};

use super::rate::Bucket;
use crate::limits::Limits;
use crate::pace::queue::lock;
use crate::refusal::Result;

/// After the system could not give us a connection: file descriptors that have run out come back.
const PAUSE: Duration = Duration::from_millis(100);

/// Bytes with which any client of ours begins: the preface of HTTP/2.
const GREETING_BYTES: usize = 24;

/// The connections to `listener`. Never ends, and never fails.
pub(super) fn incoming(listener: TcpListener, limits: &Limits) -> impl Stream<Item = io::Result<Connection>> {
    let free = Arc::new(Semaphore::new(limits.connections));
    stream::unfold((listener, free, limits.clone()), |(listener, free, limits)| async move {
        loop {
            let (socket, address) = match listener.accept().await {
                Ok(accepted) => accepted,
                Err(error) => {
                    warn!(%error, "no connection can be accepted; trying again");
                    tokio::time::sleep(PAUSE).await;
                    continue;
                }
            };
            let Ok(permit) = free.clone().try_acquire_owned() else {
                warn!(%address, connections = limits.connections, "connection closed: there are too many already");
                continue;
            };
            // Nagle's algorithm would hold a sample back for milliseconds. Who has gone already is noticed later.
            let _ = socket.set_nodelay(true);
            let connection = Connection::new(socket, address, permit, &limits);
            return Some((Ok(connection), (listener, free, limits)));
        }
    })
}

/// What is known of who is at the other end, for every request that comes from there.
#[derive(Debug, Clone)]
pub(crate) struct Peer {
    /// Where from.
    pub(crate) address: SocketAddr,
    creations: Arc<Mutex<Bucket>>,
}

impl Peer {
    /// Whether it may make a further session now.
    pub(super) fn may_create(&self, now_ns: u64) -> Result<()> {
        lock(&self.creations).take(now_ns, "sessions made over this connection")
    }
}

/// A connection.
#[derive(Debug)]
pub(super) struct Connection {
    socket: TcpStream,
    peer: Peer,
    /// Until so many bytes have come, it has so long.
    greeting: Option<(usize, Pin<Box<Sleep>>)>,
    _permit: OwnedSemaphorePermit,
}

impl Connection {
    fn new(socket: TcpStream, address: SocketAddr, permit: OwnedSemaphorePermit, limits: &Limits) -> Self {
        let each_minute = limits.sessions_per_minute;
        let creations = Arc::new(Mutex::new(Bucket::new(each_minute / 60.0, each_minute)));
        let deadline = tokio::time::sleep(Duration::from_secs_f64(limits.handshake_s));
        let greeting = Some((GREETING_BYTES, Box::pin(deadline)));
        Connection { socket, peer: Peer { address, creations }, greeting, _permit: permit }
    }
}

impl Connected for Connection {
    type ConnectInfo = Peer;

    fn connect_info(&self) -> Peer {
        self.peer.clone()
    }
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        let polled = Pin::new(&mut self.socket).poll_read(context, buffer);
        let Some((left, deadline)) = &mut self.greeting else { return polled };
        if polled.is_pending() {
            ready!(deadline.as_mut().poll(context));
            debug!(address = %self.peer.address, "connection closed: it did not say what it wants");
            return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
        }
        *left = left.saturating_sub(buffer.filled().len() - before);
        if *left == 0 {
            self.greeting = None;
        }
        polled
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.socket).poll_write(context, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.socket).poll_write_vectored(context, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.socket.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_shutdown(context)
    }
}
