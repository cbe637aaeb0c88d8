//! Connections as they come: plain, or through TLS when the handshake is done. None waits for another's handshake.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use futures_util::stream::Stream;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Semaphore, mpsc};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::ServerConfig;
use tokio_rustls::server::TlsStream;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::server::Connected;
use tracing::{debug, warn};

use super::metrics::{Open, Traffic};
use super::reload::Reloaded;
use super::tls;

/// Handshakes at a time: who connects beyond that waits in the kernel's queue.
const HANDSHAKES: usize = 256;

/// A client that takes longer is cut off.
const HANDSHAKE: Duration = Duration::from_secs(5);

/// Before the next attempt when the system has no more file descriptors.
const PAUSE: Duration = Duration::from_millis(100);

/// Connections that wait to be served.
const WAITING: usize = 64;

/// Who is at the other end.
#[derive(Clone, Debug)]
pub(super) struct Peer {
    /// Where it is.
    pub(super) address: Option<SocketAddr>,
    /// What its certificate calls it, if it had to show one.
    pub(super) certificate: Option<Arc<[String]>>,
}

enum Transport {
    Plain(TcpStream),
    Tls(Box<TlsStream<TcpStream>>),
}

/// A connection that counts what it carries.
pub(super) struct Connection {
    transport: Transport,
    peer: Peer,
    traffic: Arc<Traffic>,
    _open: Open,
}

/// Every connection that `listener` takes, through TLS if there is a configuration for it.
pub(super) fn incoming(
    listener: TcpListener,
    tls: Option<Arc<Reloaded<ServerConfig>>>,
    traffic: Arc<Traffic>,
) -> impl Stream<Item = io::Result<Connection>> {
    let (ready, connections) = mpsc::channel(WAITING);
    tokio::spawn(async move {
        let handshakes = Arc::new(Semaphore::new(HANDSHAKES));
        loop {
            let (stream, address) = tokio::select! {
                () = ready.closed() => return,
                accepted = listener.accept() => match accepted {
                    Ok(accepted) => accepted,
                    Err(error) => {
                        warn!(%error, "a connection could not be taken");
                        tokio::time::sleep(PAUSE).await;
                        continue;
                    }
                },
            };
            // Nagle's algorithm would hold a sample back for milliseconds.
            let _ = stream.set_nodelay(true);
            let Some(tls) = &tls else {
                let peer = Peer { address: Some(address), certificate: None };
                if ready.send(Ok(Connection::new(Transport::Plain(stream), peer, &traffic))).await.is_err() {
                    return;
                }
                continue;
            };
            let Ok(permit) = handshakes.clone().acquire_owned().await else { return };
            let (acceptor, ready, traffic) = (TlsAcceptor::from(tls.get()), ready.clone(), traffic.clone());
            tokio::spawn(async move {
                let stream = match tokio::time::timeout(HANDSHAKE, acceptor.accept(stream)).await {
                    Ok(Ok(stream)) => stream,
                    Ok(Err(error)) => return traffic.handshake_failed(address, &error.to_string()),
                    Err(_) => return traffic.handshake_failed(address, "it took too long"),
                };
                drop(permit);
                let certificate = stream.get_ref().1.peer_certificates().map(|chain| tls::names(chain).into());
                let peer = Peer { address: Some(address), certificate };
                let connection = Connection::new(Transport::Tls(Box::new(stream)), peer, &traffic);
                // If nobody takes it any more the server is going down.
                let _ = ready.send(Ok(connection)).await;
            });
        }
    });
    ReceiverStream::new(connections)
}

impl Connection {
    fn new(transport: Transport, peer: Peer, traffic: &Arc<Traffic>) -> Self {
        debug!(client = ?peer.address, "connected");
        Connection { transport, peer, traffic: traffic.clone(), _open: traffic.open() }
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
        this.traffic.bytes_in.inc_by((buffer.filled().len() - before) as u64);
        polled
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

impl AsyncWrite for Connection {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        let polled = match &mut this.transport {
            Transport::Plain(stream) => Pin::new(stream).poll_write(cx, bytes),
            Transport::Tls(stream) => Pin::new(stream).poll_write(cx, bytes),
        };
        this.count(polled)
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

    fn poll_write_vectored(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        let polled = match &mut this.transport {
            Transport::Plain(stream) => Pin::new(stream).poll_write_vectored(cx, bytes),
            Transport::Tls(stream) => Pin::new(stream).poll_write_vectored(cx, bytes),
        };
        this.count(polled)
    }

    fn is_write_vectored(&self) -> bool {
        match &self.transport {
            Transport::Plain(stream) => stream.is_write_vectored(),
            Transport::Tls(stream) => stream.is_write_vectored(),
        }
    }
}
