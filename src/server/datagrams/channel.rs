//! The datagram session of a stream or lease: decides which samples go by datagram and which by the gRPC stream.

use std::sync::{Arc, Mutex};

use palpate_haptics::datagram_health::DatagramHealth;
use palpate_haptics::dead_reckoning::SendInterval;
use palpate_proto::datagram::MAX_BYTES;
use palpate_proto::pb;
use prost::Message;
use wtransport::{Connection, VarInt};

use super::tickets::Arrival;
use crate::server::rate::Bucket;
use palpate_realtime::clock::now_ns;
use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::sample_selection::WantedHeartbeat;
use palpate_tissue::lock::lock;

/// The datagrams of a stream, in both directions. Its receiving and its sending task share it.
#[derive(Debug)]
pub(in crate::server) struct DatagramChannel {
    /// Limits the rate at which messages are read. The rest overflow their buffer, which costs nothing.
    pace: Mutex<Bucket>,
    inner: Mutex<Inner>,
    wanted: Arc<WantedHeartbeat>,
}

#[derive(Debug, Default)]
struct Inner {
    connection: Option<Connection>,
    carrier: DatagramHealth,
    pulse: SendInterval,
}

fn seconds(ns: u64) -> f64 {
    ns as f64 * 1e-9
}

impl DatagramChannel {
    /// Creates a channel, without a session yet, that reads messages at this pace.
    pub(in crate::server) fn new(pace: Bucket) -> Self {
        DatagramChannel { pace: Mutex::new(pace), inner: Mutex::default(), wanted: Arc::default() }
    }

    /// Waits for the session; `None` if no client presents its ticket.
    pub(in crate::server) async fn arrive(&self, arrival: &mut Option<Arrival>) -> Option<Connection> {
        if let Some(waiting) = arrival {
            let connection = waiting.await.ok();
            *arrival = None;
            lock(&self.inner).connection = connection;
        }
        lock(&self.inner).connection.clone()
    }

    /// Returns the client's next message when the pace allows it. Never completes if there is no session or it has
    /// ended.
    ///
    /// # Errors
    /// Refuses a datagram that is too long or can't be decoded.
    pub(in crate::server) async fn next(&self, arrival: &mut Option<Arrival>) -> Result<pb::PosesDatagram> {
        let Some(connection) = self.arrive(arrival).await else { return std::future::pending().await };
        loop {
            let early = lock(&self.pace).time_to_one(now_ns());
            let Some(early) = early else { break };
            tokio::time::sleep(early).await;
        }
        let Ok(datagram) = connection.receive_datagram().await else {
            lock(&self.inner).connection = None;
            return std::future::pending().await;
        };
        let _ = lock(&self.pace).take(now_ns(), "datagrams of this stream");
        let bytes = datagram.payload();
        let wrong = |why: String| Refusal::new(Reason::Unreadable, "datagram", why);
        if bytes.len() > MAX_BYTES {
            return Err(wrong(format!("has {} bytes, more than {MAX_BYTES}", bytes.len())));
        }
        let message = pb::PosesDatagram::decode(bytes).map_err(|error| wrong(error.to_string()))?;
        let now_s = seconds(now_ns());
        let mut inner = lock(&self.inner);
        inner.carrier.arrive(message.number, message.acknowledges, now_s);
        inner.pulse.arrive(message.number, seconds(message.sent_ns), now_s);
        drop(inner);
        self.wanted.set(f64::from(message.heartbeat_s));
        Ok(message)
    }

    /// Sends a sample as a datagram. Returns false if the gRPC stream must carry it instead.
    pub(in crate::server) fn send(&self, sample: &pb::Sample) -> bool {
        let now_ns = now_ns();
        let mut inner = lock(&self.inner);
        inner.connection.is_some()
            && inner.carrier.update(seconds(now_ns))
            && inner.datagram(Some(sample.clone()), now_ns).is_some()
    }

    /// Sends an empty datagram (heartbeat) if nothing was sent for a while.
    pub(in crate::server) fn stay_alive(&self) {
        let now_ns = now_ns();
        let mut inner = lock(&self.inner);
        if inner.connection.is_some() && inner.carrier.is_silent(seconds(now_ns)) {
            inner.datagram(None, now_ns);
        }
    }

    /// Closes the session, if there is one.
    pub(in crate::server) fn part(&self) {
        if let Some(connection) = lock(&self.inner).connection.take() {
            connection.close(VarInt::from_u32(0), b"it is over");
        }
    }

    /// Returns the interval at which the client wants samples; the client's messages update it.
    pub(in crate::server) fn wanted(&self) -> Arc<WantedHeartbeat> {
        self.wanted.clone()
    }
}

impl Inner {
    /// Sends a datagram; `None` if it is too long or the session has ended.
    fn datagram(&mut self, sample: Option<pb::Sample>, now_ns: u64) -> Option<()> {
        let connection = self.connection.as_ref()?;
        let heartbeat_s = self.pulse.heartbeat_s(seconds(now_ns)) as f32;
        let mut message = pb::SampleDatagram { number: 0, acknowledges: 0, heartbeat_s, sample, sent_ns: now_ns };
        // Only sent datagrams get a number. The numbers take a few bytes.
        const NUMBERS_BYTES: usize = 22;
        let most = connection.max_datagram_size().map_or(0, |most| most.min(MAX_BYTES));
        if message.encoded_len() + NUMBERS_BYTES > most {
            return None;
        }
        (message.number, message.acknowledges) = self.carrier.send(seconds(now_ns));
        connection.send_datagram(message.encode_to_vec()).ok()
    }
}

impl Drop for DatagramChannel {
    fn drop(&mut self) {
        self.part();
    }
}
