//! A network with TCP in virtual time: nothing is lost and messages stay in order, but a lost packet delays all later ones
//! until it has been retransmitted.
//!
//! arrival = max(arrival of the message before, sent + delay + jitter + (RTT … RTO if lost)).

use std::collections::VecDeque;

use crate::simulated::random::Random;

/// The conditions of a network.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Conditions {
    /// Round-trip time without jitter, s.
    pub(super) round_trip_s: f64,
    /// Standard deviation of the delay each way, s.
    pub(super) jitter_s: f64,
    /// Fraction of the messages that are retransmitted.
    pub(super) loss: f64,
}

/// Least retransmission timeout of TCP, s (RFC 6298 requires 1 s, Linux uses 200 ms).
const LEAST_RTO_S: f64 = 0.2;

/// One direction of a connection.
pub(super) struct Direction<T> {
    conditions: Conditions,
    random: Random,
    under_way: VecDeque<(f64, T)>,
    last_s: f64,
    sent: u64,
}

impl<T> Direction<T> {
    pub(super) fn new(conditions: Conditions, random: Random) -> Self {
        Direction { conditions, random, under_way: VecDeque::new(), last_s: f64::NEG_INFINITY, sent: 0 }
    }

    pub(super) fn send(&mut self, now_s: f64, message: T) {
        let Conditions { round_trip_s, jitter_s, loss } = self.conditions;
        let mut delay_s = round_trip_s / 2.0;
        if jitter_s > 0.0 {
            delay_s = (delay_s + jitter_s * self.random.normal()).max(0.0);
        }
        if loss > 0.0 && self.random.between(0.0, 1.0) < loss {
            delay_s += self.random.between(round_trip_s, (2.0 * round_trip_s).max(LEAST_RTO_S));
        }
        self.last_s = self.last_s.max(now_s + delay_s);
        self.sent += 1;
        self.under_way.push_back((self.last_s, message));
    }

    /// The next message that has arrived.
    pub(super) fn receive(&mut self, now_s: f64) -> Option<T> {
        // The nanosecond allows for rounding: times are sums of milliseconds.
        if self.under_way.front()?.0 > now_s + 1e-9 {
            return None;
        }
        self.under_way.pop_front().map(|entry| entry.1)
    }

    pub(super) fn sent(&self) -> u64 {
        self.sent
    }
}
