//! The datagrams of a haptic stream: poses and samples go by datagram while these get through, otherwise by the
//! stream.
//!
//! ```no_run
//! use palpate_client::datagrams::Datagrams;
//! use palpate_client::{Server, Touch};
//! use palpate_proto::pb;
//!
//! # async fn example(server: &Server, mut touch: Touch, command: pb::Command) -> Result<(), tonic::Status> {
//! // The stream was opened with `TouchOpen.datagrams`. The session opens beside it; the stream does not wait.
//! let mut datagrams = Datagrams::dial(touch.opened().datagrams.as_ref(), server);
//! loop {
//!     if !datagrams.send(&command) {
//!         // By the stream.
//!     }
//!     tokio::select! {
//!         sample = datagrams.next() => println!("{sample:?}"),
//!         message = touch.next() => println!("{:?}", message?),
//!     }
//! }
//! # }
//! ```

use std::collections::{BTreeMap, VecDeque};
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use palpate_haptics::datagram_health::{Carried, DatagramHealth, LIFE_S};
use palpate_haptics::dead_reckoning::{FASTEST_S, SendInterval};
use palpate_haptics::deadband::HEARTBEAT_S;
use palpate_proto::datagram::{self, MAX_BYTES, MAX_EARLIER, MAX_EARLIER_OF_INSTRUMENT, Posed};
use palpate_proto::pb;
use prost::Message;
use tokio::task::JoinSet;
use tokio::time::{Interval, MissedTickBehavior, interval};
use wtransport::tls::Sha256Digest;
use wtransport::{ClientConfig, Connection, Endpoint};

use crate::connect::Server;

/// Time limit for one attempt to open the session, and number of attempts: together within the ten seconds of a
/// ticket, which is used up only when a session is open. The stream carries everything until then. (HTTP/3 may wait
/// without limit for settings that were resent after a loss: wtransport 0.7.)
const OPEN_TIMEOUT: Duration = Duration::from_secs(2);
const ATTEMPTS: usize = 4;

/// Interval at which a session that has ended, or did not open, is requested again, s: on a blocked port each attempt
/// costs a few packets.
const AGAIN_S: f64 = 4.0;

/// The datagram session of one haptic stream, if the server offers one. It may be closed at any time, while the stream
/// continues; a new offer of the server reopens it ([`Datagrams::asks`]). It ends when this is dropped.
#[derive(Debug)]
pub struct Datagrams {
    /// Host of the server, if it has offered a session.
    host: Option<String>,
    /// When a session was last requested, s.
    asked_s: f64,
    opening: JoinSet<Option<Connection>>,
    connection: Option<Connection>,
    carrier: DatagramHealth,
    pulse: SendInterval,
    begun: Instant,
    life: Interval,
    /// For each tool its newest poses, newest first: they are sent again with the next one, in case they were lost.
    recent: BTreeMap<u32, VecDeque<Posed>>,
    /// As `recent`, for each instrument by its first tool, oldest first.
    recent_of_instruments: BTreeMap<u32, VecDeque<pb::PosedInstrument>>,
    wanted_s: f64,
    /// Owner's revision and step of the newest sample.
    newest: Option<(u64, u64)>,
}

impl Datagrams {
    /// Starts to open the session that a stream was offered, in the background; [`Datagrams::next`] takes it into use.
    /// `server` is the one that has the stream: its host is used if the offer names none. Without an offer nothing is
    /// ever sent by datagram. Makes at most 4 attempts of 2 s each.
    ///
    /// # Panics
    /// Outside a Tokio runtime with a timer.
    pub fn dial(offer: Option<&pb::DatagramOffer>, server: &Server) -> Self {
        let mut life = interval(Duration::from_secs_f64(0.5 * LIFE_S));
        life.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut datagrams = Datagrams {
            host: offer.map(|_| server.host().to_owned()),
            asked_s: 0.0,
            opening: JoinSet::new(),
            connection: None,
            carrier: DatagramHealth::default(),
            pulse: SendInterval::default(),
            begun: Instant::now(),
            life,
            recent: BTreeMap::new(),
            recent_of_instruments: BTreeMap::new(),
            wanted_s: HEARTBEAT_S,
            newest: None,
        };
        if let Some(offer) = offer {
            datagrams.take_offer(offer);
        }
        datagrams
    }

    /// Starts to open another session that the server offered after [`Datagrams::asks`], in the background. Closes the
    /// current one at once. Does nothing if [`Datagrams::dial`] got no offer.
    pub fn take_offer(&mut self, offer: &pb::DatagramOffer) {
        let Some(own) = &self.host else { return };
        let host = if offer.host.is_empty() { own.clone() } else { offer.host.clone() };
        let offer = offer.clone();
        (self.connection, self.opening) = (None, JoinSet::new());
        self.opening.spawn(async move {
            for _ in 0..ATTEMPTS {
                if let Ok(opened) = tokio::time::timeout(OPEN_TIMEOUT, open(&host, &offer)).await {
                    // A refusal is final.
                    return opened;
                }
            }
            None
        });
    }

    /// Returns whether the session has ended, or could not be opened, and the server is to be asked for another: by
    /// `renew` with `datagrams` on the stream, which it answers with an offer ([`Datagrams::take_offer`]). True at
    /// most once in four seconds, and not in the first four; never if [`Datagrams::dial`] got no offer.
    pub fn asks(&mut self) -> bool {
        let now_s = self.now_s();
        let is_over = self.host.is_some() && self.connection.is_none() && self.opening.is_empty();
        let asks = is_over && now_s - self.asked_s >= AGAIN_S;
        if asks {
            self.asked_s = now_s;
        }
        asks
    }

    fn now_s(&self) -> f64 {
        self.begun.elapsed().as_secs_f64()
    }

    /// Sends a pose that is played by the client's time (`client_time_ns` and `sequence` set, no `at_step`), together
    /// with up to 8 earlier ones of its tool, 3 of an instrument, in case these were lost. Never waits. Returns false if the stream must
    /// carry the command: there is no session, datagrams do not get through at present, the message is too long for
    /// one datagram, or it is another command.
    pub fn send(&mut self, command: &pb::Command) -> bool {
        let (Some(action), Some(sequence), None) = (&command.action, command.sequence, command.at_step) else {
            return false;
        };
        if self.connection.is_none() || command.client_time_ns == 0 {
            return false;
        }
        let pose = match action {
            pb::command::Action::Pose(pose) => pose,
            pb::command::Action::Instrument(pose) => return self.send_instrument(command, sequence, pose),
            _ => return false,
        };
        let newest = Posed { sequence, client_time_ns: command.client_time_ns, pose: *pose };
        let recent = self.recent.entry(command.tool).or_default();
        let message = datagram::tool_poses(command.tool, &newest, recent.iter());
        recent.push_front(newest);
        recent.truncate(MAX_EARLIER);
        let now_s = self.now_s();
        self.carrier.update(now_s) && self.datagram(vec![message], Vec::new(), now_s)
    }

    fn send_instrument(&mut self, command: &pb::Command, sequence: u64, pose: &pb::InstrumentPose) -> bool {
        let (tool, client_time_ns) = (command.tool, command.client_time_ns);
        let recent = self.recent_of_instruments.entry(tool).or_default();
        recent.push_back(pb::PosedInstrument { tool, sequence, client_time_ns, pose: Some(*pose) });
        if recent.len() > 1 + MAX_EARLIER_OF_INSTRUMENT {
            recent.pop_front();
        }
        let instruments = recent.iter().copied().collect();
        let now_s = self.now_s();
        self.carrier.update(now_s) && self.datagram(Vec::new(), instruments, now_s)
    }

    /// Sends a datagram. Returns false if it is too long or the session has ended.
    fn datagram(&mut self, tools: Vec<pb::ToolPoses>, instruments: Vec<pb::PosedInstrument>, now_s: f64) -> bool {
        let Some(connection) = &self.connection else { return false };
        let (number, acknowledges) = self.carrier.send(now_s);
        let heartbeat_s = self.pulse.heartbeat_s(now_s) as f32;
        let sent_ns = (now_s * 1e9) as u64;
        let message = pb::PosesDatagram { number, acknowledges, heartbeat_s, tools, sent_ns, instruments };
        let most = connection.max_datagram_size().map_or(0, |most| most.min(MAX_BYTES));
        message.encoded_len() <= most && connection.send_datagram(message.encode_to_vec()).is_ok()
    }

    /// Waits for the next sample that arrives by datagram. Skips samples older than one seen before
    /// ([`Datagrams::is_newer`]). Never completes while there is no session. Call it all the time: it also takes
    /// opened sessions into use and keeps them alive. Dropping the future loses nothing.
    pub async fn next(&mut self) -> pb::Sample {
        loop {
            let connection = self.connection.clone();
            let datagram = async {
                match &connection {
                    Some(connection) => connection.receive_datagram().await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                Some(opened) = self.opening.join_next() => self.connection = opened.ok().flatten(),
                received = datagram => match received {
                    Ok(datagram) => {
                        if let Some(sample) = self.take(&datagram.payload()) {
                            return sample;
                        }
                    }
                    // The stream continues.
                    Err(_) => self.connection = None,
                },
                _ = self.life.tick() => {
                    let now_s = self.now_s();
                    if self.connection.is_some() && self.carrier.is_silent(now_s) {
                        self.datagram(Vec::new(), Vec::new(), now_s);
                    }
                    // Detects that nothing is confirmed any longer, even while nothing is sent.
                    self.carrier.update(now_s);
                }
            }
        }
    }

    fn take(&mut self, bytes: &[u8]) -> Option<pb::Sample> {
        let message = pb::SampleDatagram::decode(bytes).ok()?;
        let now_s = self.now_s();
        self.carrier.arrive(message.number, message.acknowledges, now_s);
        self.pulse.arrive(message.number, message.sent_ns as f64 * 1e-9, now_s);
        if message.heartbeat_s > 0.0 {
            self.wanted_s = f64::from(message.heartbeat_s).max(FASTEST_S);
        }
        message.sample.filter(|sample| self.is_newer(sample))
    }

    /// Returns whether a sample is at least as new as all samples seen so far, by datagram or passed to this method,
    /// and records it if so. The ownership revision counts first, then the step. Call it for samples of the stream.
    pub fn is_newer(&mut self, sample: &pb::Sample) -> bool {
        // A server that took the session over may continue it at an earlier step; samples of the previous owner are
        // outdated.
        let this = (sample.ownership_revision, sample.step);
        let is_newer = self.newest.is_none_or(|newest| this >= newest);
        if is_newer {
            self.newest = Some(this);
        }
        is_newer
    }

    /// Returns the longest time between two poses that the server wants, s: the one of its newest datagram, at least
    /// [`FASTEST_S`]; [`HEARTBEAT_S`] before it has sent one.
    pub fn wanted_s(&self) -> f64 {
        self.wanted_s
    }

    /// Returns how many messages went and came by datagram so far, over all sessions, and how often the stream took
    /// over.
    pub fn carried(&self) -> Carried {
        self.carrier.carried()
    }
}

/// Opens a session; `None` if that fails.
async fn open(host: &str, offer: &pb::DatagramOffer) -> Option<Connection> {
    let hash: [u8; 32] = offer.certificate_sha256.as_slice().try_into().ok()?;
    let ticket: [u8; 16] = offer.ticket.as_slice().try_into().ok()?;
    let port = u16::try_from(offer.port).ok()?;
    let host = host.trim_matches(['[', ']']);
    let address = tokio::net::lookup_host((host, port)).await.ok()?.next()?;
    let any: SocketAddr = match address {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    // The offer, sent over the stream, contained the hash of the certificate.
    let config = ClientConfig::builder().with_bind_address(any);
    let mut config = config.with_server_certificate_hashes([Sha256Digest::new(hash)]).build();
    config.quic_config_mut().transport_config(Arc::new(datagram::transport()));
    let endpoint = Endpoint::client(config).ok()?;
    let url = format!("https://{address}/touch/{:032x}", u128::from_be_bytes(ticket));
    endpoint.connect(url).await.ok()
}
