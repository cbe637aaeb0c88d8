//! Accepts datagram sessions that present a ticket, from pages of allowed origins. Limits the number of concurrent
//! handshakes, and the rate at which one network starts them.

use std::collections::HashMap;
use std::net::{IpAddr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::time::Duration;

use http::HeaderValue;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot};
use tokio::time::{Interval, interval, timeout};
use tokio_util::sync::CancellationToken;
use tracing::{debug, warn};
use wtransport::endpoint::{IncomingSession, endpoint_side};
use wtransport::{Endpoint, ServerConfig, VarInt};

use super::certificate::{self, ROTATED};
use super::offers::{Datagrams, Offers, Socket};
use crate::server::address::network;
use crate::server::authorize::is_own_or_among;
use crate::server::rate::Bucket;
use crate::server::traffic::Traffic;
use palpate_proto::datagram;
use palpate_realtime::clock::now_ns;
use palpate_realtime::priority::{give_way_a_little, thread};
use palpate_tissue::lock::lock;

/// Maximum number of concurrent handshakes; others are ignored, and their clients try again.
const HANDSHAKES: usize = 64;

/// Time limit for a handshake and its ticket.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(5);

/// Rate (per second) and burst of handshakes from one network.
const EACH: (f64, f64) = (10.0, 40.0);

/// Maximum number of networks whose handshakes are counted. Beyond it, all counts are reset: [`HANDSHAKES`] still
/// limits the work.
const NETWORKS: usize = 1024;

/// Time limit for informing the clients that the server ends.
const FAREWELL: Duration = Duration::from_secs(1);

/// Receives at `socket` until `shutdown` is cancelled, and returns what offers datagram sessions: none without a
/// socket. Runs on its own thread of lower priority, so that UDP packets, genuine or not, take little time from calls
/// by gRPC.
pub(in crate::server) async fn receive(
    socket: Option<Socket>,
    origins: Arc<[HeaderValue]>,
    traffic: Arc<Traffic>,
    shutdown: CancellationToken,
) -> Datagrams {
    let Some(Socket { socket, advertised }) = socket else { return Datagrams::default() };
    let (ready, is_ready) = oneshot::channel();
    let receiving = move || -> Result<(), EndpointError> {
        give_way_a_little();
        tokio::runtime::Builder::new_current_thread().enable_all().build()?.block_on(async {
            let listener = Listener::open(socket, advertised, origins, traffic)?;
            let _ = ready.send(listener.door.offers.clone());
            listener.run(shutdown).await;
            Ok(())
        })
    };
    let spawned = thread("datagrams").spawn(move || {
        if let Err(error) = receiving() {
            warn!(%error, "no datagrams: touch goes by gRPC alone");
        }
    });
    if let Err(error) = spawned {
        warn!(%error, "no thread for datagrams: touch goes by gRPC alone");
    }
    Datagrams(is_ready.await.ok())
}

type EndpointError = Box<dyn std::error::Error + Send + Sync>;

struct Listener {
    endpoint: Endpoint<endpoint_side::Server>,
    rotation: Interval,
    handshakes: Arc<Semaphore>,
    begun: HashMap<IpAddr, Bucket>,
    door: Arc<Door>,
}

/// Decides which sessions are accepted.
struct Door {
    offers: Arc<Offers>,
    origins: Arc<[HeaderValue]>,
    traffic: Arc<Traffic>,
}

impl Listener {
    fn open(
        socket: UdpSocket,
        advertised: (String, u16),
        origins: Arc<[HeaderValue]>,
        traffic: Arc<Traffic>,
    ) -> Result<Self, EndpointError> {
        let (identity, hash) = certificate::make()?;
        let config = ServerConfig::builder().with_bind_socket(socket);
        let endpoint = Endpoint::server(settled(config.with_identity(identity).build()))?;
        let offers = Arc::new(Offers::new(advertised, hash));
        let (door, handshakes) = (Arc::new(Door { offers, origins, traffic }), Arc::new(Semaphore::new(HANDSHAKES)));
        let mut rotation = interval(ROTATED);
        // The first tick is immediate.
        rotation.reset();
        Ok(Listener { endpoint, rotation, handshakes, begun: HashMap::new(), door })
    }

    async fn run(mut self, shutdown: CancellationToken) {
        loop {
            tokio::select! {
                incoming = self.endpoint.accept() => self.take(incoming),
                _ = self.rotation.tick() => self.rotate(),
                () = shutdown.cancelled() => break,
            }
        }
        self.endpoint.close(VarInt::from_u32(0), b"the server is shutting down");
        let _ = timeout(FAREWELL, self.endpoint.wait_idle()).await;
    }

    /// Starts a handshake with a client that has proved its address, so that nobody can make the server send packets
    /// to others.
    fn take(&mut self, incoming: IncomingSession) {
        if !incoming.remote_address_validated() {
            return incoming.retry();
        }
        let address = incoming.remote_address();
        if self.begun.len() >= NETWORKS {
            self.begun.clear();
        }
        let bucket = self.begun.entry(network(address.ip())).or_insert_with(|| Bucket::new(EACH.0, EACH.1));
        let is_slow = bucket.take(now_ns(), "handshakes").is_ok();
        match self.handshakes.clone().try_acquire_owned() {
            Ok(slot) if is_slow => drop(tokio::spawn(self.door.clone().admit(incoming, address, slot))),
            _ => incoming.ignore(),
        }
    }

    /// Creates a new certificate for later sessions. Open sessions keep theirs; outstanding offers that no client has
    /// used yet fail, and their streams continue without datagrams.
    fn rotate(&self) {
        let made = certificate::make().map_err(|error| error.to_string());
        let reloaded = made.and_then(|(identity, hash)| {
            // The address has no effect: the endpoint keeps its socket.
            let config = ServerConfig::builder().with_bind_default(0).with_identity(identity).build();
            self.endpoint.reload_config(settled(config), false).map_err(|error| error.to_string())?;
            *lock(&self.door.offers.certificate_sha256) = hash;
            Ok(())
        });
        if let Err(error) = reloaded {
            warn!(error, "the certificate for datagrams stays: can't make another");
        }
    }
}

/// Applies the transport settings of touch to a configuration.
fn settled(mut config: ServerConfig) -> ServerConfig {
    config.quic_config_mut().transport_config(Arc::new(datagram::transport()));
    // Clients whose address is not yet decided on retry at once.
    config.quic_config_mut().max_incoming(HANDSHAKES).incoming_buffer_size_total(1 << 20);
    config
}

impl Door {
    /// Accepts a session that presents a valid ticket; counts and logs a refused one.
    async fn admit(self: Arc<Self>, incoming: IncomingSession, address: SocketAddr, _slot: OwnedSemaphorePermit) {
        let refused = match timeout(HANDSHAKE_TIMEOUT, self.enter(incoming)).await {
            Ok(Ok(())) => return,
            Ok(Err(why)) => why,
            Err(_) => "timed out".to_owned(),
        };
        debug!(%address, "datagram session refused: {refused}");
        self.traffic.datagram_sessions_refused.inc();
    }

    async fn enter(&self, incoming: IncomingSession) -> Result<(), String> {
        let request = incoming.await.map_err(|error| error.to_string())?;
        if let Some(origin) = request.origin()
            && !is_own_or_among(origin, request.authority(), &self.origins)
        {
            request.forbidden().await;
            return Err("its page is of another site".to_owned());
        }
        let whose = lock(&self.offers.tickets).take(request.path(), now_ns());
        let Some(whose) = whose else {
            request.forbidden().await;
            return Err("it has no ticket that is good".to_owned());
        };
        let connection = request.accept().await.map_err(|error| error.to_string())?;
        self.traffic.datagram_sessions.inc();
        whose.send(connection).map_err(|_| "its stream has ended".to_owned())
    }
}
