//! Messages between client and server, and the selection of the tool's places that the client sends: all, or only
//! those that the server's estimate misses. A datagram repeats places that the server may not have received.

use std::collections::VecDeque;

use glam::DVec3;
use palpate_haptics::deadband::HEARTBEAT_S;
use palpate_haptics::{LocalModel, MotionState, News, SendInterval};
use palpate_simulated::network::{Direction, Transport};

use super::client::LinkClient;

/// A message to the server.
pub(super) struct Up {
    pub(super) number: u64,
    pub(super) sent_s: f64,
    /// Places of the tool, and of the client's second one if it has one, by the number of their commands, the newest last.
    pub(super) told: Vec<(u64, Places)>,
    /// Longest interval at which the client needs samples, s.
    pub(super) heartbeat_s: f64,
}

/// The motion of a client's tool, and of its second one.
pub(super) type Places = (MotionState, Option<MotionState>);

/// A message to the client.
pub(super) struct Down {
    pub(super) number: u64,
    pub(super) sent_s: f64,
    /// The local model; `None` if the tool has let go.
    pub(super) model: Option<LocalModel>,
    /// Place of the second tool, m, and its velocity, m/s, in the hand's frame, if the samples tell of it.
    pub(super) second: Option<[DVec3; 2]>,
    /// Longest interval at which the server needs places, s.
    pub(super) heartbeat_s: f64,
}

/// Size of a message with one place and its velocity, bytes, and of each that it repeats: what the headers below it
/// take, and the fields of a pose.
const FIRST_BYTES: u64 = 66 + 100;
const FURTHER_BYTES: u64 = 24;

/// Largest number of places in a datagram.
const PLACES: usize = 8;

/// Largest error of a time that the server returns, from rounding to nanoseconds, s.
const ROUNDING_S: f64 = 5e-7;

/// The tool's places on their way to the server.
pub(super) struct Poses {
    transport: Transport,
    /// Deadband as a fraction of the force; with 0 each place is sent.
    deadband: f64,
    news: News,
    second_news: News,
    /// Number of commands so far.
    count: u64,
    /// Places that the server may not have received, the newest last.
    unanswered: VecDeque<(u64, Places)>,
    /// Arrivals of samples.
    pulse: SendInterval,
    heartbeat_s: f64,
}

impl Poses {
    pub(super) fn new(transport: Transport, deadband: f64) -> Self {
        Poses {
            transport,
            deadband,
            news: News::default(),
            second_news: News::default(),
            count: 0,
            unanswered: VecDeque::new(),
            pulse: SendInterval::default(),
            heartbeat_s: HEARTBEAT_S,
        }
    }

    /// Sends the place of the tool, and of the client's second one, to the server, if the server's estimate of one is wrong or
    /// a heartbeat is due.
    pub(super) fn tell(
        &mut self,
        now_s: f64,
        place_m: DVec3,
        second_m: Option<DVec3>,
        client: &LinkClient,
        up: &mut Direction<Up>,
    ) {
        let most_m = match client {
            LinkClient::Model(renderer) => renderer.way_m(self.deadband),
            LinkClient::Raw(_) | LinkClient::Hold(..) => 0.0,
        };
        let (heartbeat_s, deadband) = (self.heartbeat_s, self.deadband);
        let news = |news: &mut News, place_m: DVec3| {
            let at_rest = MotionState { time_s: now_s, place_m, velocity_m_per_s: DVec3::ZERO };
            if deadband > 0.0 { news.tell(now_s, place_m, most_m, heartbeat_s) } else { Some(at_rest) }
        };
        let told = news(&mut self.news, place_m);
        let second = second_m.and_then(|second_m| news(&mut self.second_news, second_m));
        if told.is_none() && second.is_none() {
            return;
        }
        // One message has the places of both.
        let due = |news: &mut News, place_m: DVec3| news.tell(now_s, place_m, most_m, 0.0);
        let told = told.or_else(|| due(&mut self.news, place_m));
        let second = second.or_else(|| due(&mut self.second_news, second_m?));
        let Some(told) = told.map(|told| (told, second)) else { return };
        self.count += 1;
        self.unanswered.push_back((self.count, told));
        if self.unanswered.len() > if self.transport == Transport::Stream { 1 } else { PLACES } {
            self.unanswered.pop_front();
        }
        let told: Vec<(u64, Places)> = self.unanswered.iter().copied().collect();
        let bytes = FIRST_BYTES + FURTHER_BYTES * (told.len() as u64 - 1);
        let heartbeat_s = self.pulse.heartbeat_s(now_s);
        up.send(now_s, bytes, Up { number: up.sent() + 1, sent_s: now_s, told, heartbeat_s });
    }

    /// Takes the acknowledgement and the server's interval from a sample.
    pub(super) fn answered(&mut self, message: &Down, now_s: f64) {
        if let Some(model) = &message.model {
            self.unanswered.retain(|(_, (told, _))| told.time_s > model.client_time_s + ROUNDING_S);
        }
        self.pulse.arrive(message.number, message.sent_s, now_s);
        self.heartbeat_s = message.heartbeat_s;
    }
}
