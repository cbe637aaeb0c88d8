//! A network in virtual time, as TCP makes it: nothing is lost and nothing overtakes, but a lost packet holds up all that
//! come after it until it has been sent again.
//!
//! arrival = max(arrival of the one before, sent + delay + jitter + (RTT … RTO if lost)).

use std::collections::VecDeque;

/// Random numbers, the same on every machine.
pub(crate) struct Dice(fastrand::Rng);

impl Dice {
    /// One of many streams of a seed.
    pub(crate) fn new(seed: u64, stream: u64) -> Self {
        // An odd factor: neighbouring seeds and streams are far apart.
        Dice(fastrand::Rng::with_seed((seed ^ stream.rotate_left(32)).wrapping_mul(0x9e37_79b9_7f4a_7c15)))
    }

    /// From `low` to `high`.
    pub(super) fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.0.f64()
    }

    /// Of a normal distribution (Box and Muller).
    pub(super) fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.between(0.0, 1.0)).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.between(0.0, 1.0)).cos()
    }

    /// One of a list.
    pub(super) fn one_of<'t, T>(&mut self, list: &'t [T]) -> &'t T {
        &list[self.0.usize(..list.len())]
    }
}

/// What a network does to messages.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Weather {
    /// There and back, s.
    pub(super) round_trip_s: f64,
    /// Standard deviation each way, s.
    pub(super) jitter_s: f64,
    /// Part of the messages that has to be sent again.
    pub(super) loss: f64,
}

/// The least time after which TCP sends again without being told, s (RFC 6298 says 1 s, Linux 200 ms).
const LEAST_RTO_S: f64 = 0.2;

/// One way of a connection.
pub(super) struct Way<T> {
    weather: Weather,
    dice: Dice,
    under_way: VecDeque<(f64, T)>,
    last_s: f64,
    sent: u64,
}

impl<T> Way<T> {
    pub(super) fn new(weather: Weather, dice: Dice) -> Self {
        Way { weather, dice, under_way: VecDeque::new(), last_s: f64::NEG_INFINITY, sent: 0 }
    }

    pub(super) fn send(&mut self, now_s: f64, message: T) {
        let Weather { round_trip_s, jitter_s, loss } = self.weather;
        let mut delay_s = round_trip_s / 2.0;
        if jitter_s > 0.0 {
            delay_s = (delay_s + jitter_s * self.dice.normal()).max(0.0);
        }
        if loss > 0.0 && self.dice.between(0.0, 1.0) < loss {
            delay_s += self.dice.between(round_trip_s, (2.0 * round_trip_s).max(LEAST_RTO_S));
        }
        self.last_s = self.last_s.max(now_s + delay_s);
        self.sent += 1;
        self.under_way.push_back((self.last_s, message));
    }

    /// The next message that has arrived.
    pub(super) fn receive(&mut self, now_s: f64) -> Option<T> {
        // A nanosecond: times are sums of milliseconds.
        if self.under_way.front()?.0 > now_s + 1e-9 {
            return None;
        }
        self.under_way.pop_front().map(|entry| entry.1)
    }

    pub(super) fn sent(&self) -> u64 {
        self.sent
    }
}
