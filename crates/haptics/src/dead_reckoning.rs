//! Dead reckoning: a client sends its tool's place only when the server's estimate of it would be wrong.
//!
//! The server continues the movement of the newest command ([`crate::pose_playback`]). The client knows that command,
//! so it computes the same estimate. It sends the next command when the tool is farther from the estimate than a
//! distance that the hand would feel, which is a part of the force over the stiffness of the law at this depth
//! ([`crate::Renderer::way_m`]). It also sends one after the longest interval, so that the server does not regard the
//! client as gone.
//!
//! **Heartbeats.** Each end holds its last value when it receives nothing for 50 ms
//! ([`crate::pose_playback::HOLD_S`], [`crate::envelope::FRESH_S`]). Over a steady network a message every 40 ms is
//! enough, but not where messages are lost or late. So each end measures the arrivals ([`SendInterval`]) and sends
//! the other the interval that it needs.

use std::collections::VecDeque;

use glam::DVec3;

use crate::deadband::HEARTBEAT_S;
use crate::pose_playback::EXTRAPOLATE_S;

/// Shortest interval between two heartbeats, s: five fit in the 50 ms after which the other end holds its last value.
pub const FASTEST_S: f64 = 0.01;

/// Time for which a loss or a delay is remembered, s.
const MEMORY_S: f64 = 5.0;

/// Measurement of the longest interval at which this end needs messages from the other, from their losses and delays.
/// Each end has one per connection and sends the result to the other end.
#[derive(Debug, Clone, Default)]
pub struct SendInterval {
    newest: u64,
    lost_s: Option<f64>,
    /// Times of arrival and transit times, s. Transit times include the difference of the two clocks.
    transits: VecDeque<(f64, f64)>,
}

impl SendInterval {
    /// Records that message `number` (counted from 1) arrived at `now_s` by this end's clock, s. It was sent at
    /// `sent_s` by the other end's clock, s. A gap after the newest number so far counts as a loss, even if the
    /// missing message arrives later; messages before the first received one do not. At most 512 transit times of the
    /// last 5 s are kept.
    pub fn arrive(&mut self, number: u64, sent_s: f64, now_s: f64) {
        // A message that arrives out of order was not lost, but it was missing when it was needed.
        if number > self.newest + 1 && self.newest > 0 {
            self.lost_s = Some(now_s);
        }
        self.newest = self.newest.max(number);
        self.transits.push_back((now_s, now_s - sent_s));
        while self.transits.len() > MAX_TRANSITS || self.transits[0].0 < now_s - MEMORY_S {
            self.transits.pop_front();
        }
    }

    /// Returns the longest acceptable interval between two messages at `now_s`, s: [`HEARTBEAT_S`] minus the spread of
    /// the transit times in the 5 s up to the last arrival (the longest minus the shortest, so the difference of the
    /// clocks cancels), but at least [`FASTEST_S`]. For 5 s after a loss it is [`FASTEST_S`]; before the first message
    /// it is [`HEARTBEAT_S`].
    pub fn heartbeat_s(&self, now_s: f64) -> f64 {
        if self.lost_s.is_some_and(|lost_s| now_s - lost_s < MEMORY_S) {
            return FASTEST_S;
        }
        let (least_s, most_s) = self
            .transits
            .iter()
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(least_s, most_s), of| (least_s.min(of.1), most_s.max(of.1)));
        (HEARTBEAT_S - (most_s - least_s).max(0.0)).max(FASTEST_S)
    }
}

/// Number of transit times that are kept; beyond it the oldest is dropped.
const MAX_TRANSITS: usize = 512;

/// Time over which a tool's velocity is measured, s: a device measures in discrete steps, whose noise is not a
/// movement.
const LOOK_BACK_S: f64 = 0.004;

/// Number of recent places that are kept for the velocity; beyond it the oldest is dropped.
const MAX_RECENT: usize = 64;

/// Decides on the client's side which places of one tool must be sent to the server. It keeps the state that was sent
/// last, from which the server extrapolates, and the places of the last milliseconds.
///
/// The server's estimate may be wrong by 0.1 mm. A drift of 0.05 mm need not be sent; one of 0.2 mm must be:
///
/// ```
/// use glam::DVec3;
/// use palpate_haptics::News;
///
/// let (most_m, heartbeat_s) = (1e-4, 0.04);
/// let mut news = News::default();
/// assert!(news.tell(0.000, DVec3::ZERO, most_m, heartbeat_s).is_some());
/// assert!(news.tell(0.001, 5e-5 * DVec3::X, most_m, heartbeat_s).is_none());
/// let told = news.tell(0.002, 2e-4 * DVec3::X, most_m, heartbeat_s).expect("it is 0.2 mm from the estimate");
/// // It moves at 0.1 m/s, so 10 ms later the server's estimate is 1.2 mm from its first place.
/// assert!((told.velocity_m_per_s - 0.1 * DVec3::X).length() < 1e-12);
/// assert!((told.at(0.012) - 1.2e-3 * DVec3::X).length() < 1e-12);
/// ```
#[derive(Debug, Clone)]
pub struct News {
    sent: Option<MotionState>,
    recent: VecDeque<(f64, DVec3)>,
}

impl Default for News {
    /// Creates a state before the first place. It reserves all the memory that it will use, because a tick must not
    /// allocate.
    fn default() -> Self {
        News { sent: None, recent: VecDeque::with_capacity(MAX_RECENT) }
    }
}

/// Place and velocity of a tool at a time, as a command with a velocity contains them. Vectors are in the frame of the
/// commands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionState {
    /// Time by the client's clock, s.
    pub time_s: f64,
    /// Place of the tool, m.
    pub place_m: DVec3,
    /// Velocity of the tool, m/s.
    pub velocity_m_per_s: DVec3,
}

impl MotionState {
    /// Returns the server's estimate of the tool's place at `time_s` by the client's clock, m: x + v·(t − t₀), with x
    /// and v the place and velocity at t₀ = [`MotionState::time_s`]. t − t₀ is limited to 0 to [`EXTRAPOLATE_S`].
    pub fn at(&self, time_s: f64) -> DVec3 {
        self.place_m + self.velocity_m_per_s * (time_s - self.time_s).clamp(0.0, EXTRAPOLATE_S)
    }
}

impl News {
    /// Records that the tool is at `place_m`, m, at `now_s` by the client's clock, s, which must not go back. Returns
    /// the state to send; `None` while the server's estimate is wrong by at most `most_m`, m, and the last state was
    /// sent less than `heartbeat_s` ago. The first call always returns a state.
    ///
    /// The velocity is (x(t) − x(t − τ))/τ, m/s, with t − τ the newest recorded time at least 4 ms ago, or else the
    /// oldest of the last 64 calls; 0 at the first call. The caller must send the returned state: later calls rely on
    /// it.
    pub fn tell(&mut self, now_s: f64, place_m: DVec3, most_m: f64, heartbeat_s: f64) -> Option<MotionState> {
        if self.recent.len() == MAX_RECENT {
            self.recent.pop_front();
        }
        self.recent.push_back((now_s, place_m));
        while self.recent.get(1).is_some_and(|before| before.0 <= now_s - LOOK_BACK_S + 1e-9) {
            self.recent.pop_front();
        }
        let is_known = self
            .sent
            .is_some_and(|sent| now_s - sent.time_s < heartbeat_s - 1e-9 && sent.at(now_s).distance(place_m) <= most_m);
        if is_known {
            return None;
        }
        let (then_s, then_m) = self.recent[0];
        let passed_s = now_s - then_s;
        let velocity_m_per_s = if passed_s > 0.0 { (place_m - then_m) / passed_s } else { DVec3::ZERO };
        self.sent = Some(MotionState { time_s: now_s, place_m, velocity_m_per_s });
        self.sent
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_server_knows_is_not_told_and_what_it_does_not_know_is() {
        let mut news = News::default();
        let most_m = 1e-4;
        let mut told = Vec::new();
        for tick in 0..400_u32 {
            let now_s = f64::from(tick) * 1e-3;
            // Rest, then 0.1 m/s, then a circle of 5 mm at 2 Hz.
            let place_m = match tick {
                0..100 => DVec3::ZERO,
                100..200 => DVec3::X * 0.1 * (now_s - 0.1),
                _ => {
                    let (sin, cos) = (4.0 * std::f64::consts::PI * (now_s - 0.2)).sin_cos();
                    DVec3::new(0.01 + 0.005 * sin, 0.005 * (1.0 - cos), 0.0)
                }
            };
            if let Some(new) = news.tell(now_s, place_m, most_m, 0.02) {
                told.push(new);
            }
            let known_m = told.last().unwrap_or_else(|| panic!("nothing at {tick}")).at(now_s);
            assert!(known_m.distance(place_m) <= most_m + 1e-12, "{tick}");
        }
        let during = |from_s: f64| told.iter().filter(|told| (from_s..from_s + 0.1).contains(&told.time_s)).count();
        assert_eq!(during(0.0), 5, "of rest only the heartbeat");
        assert!(during(0.1) <= 8, "{}", during(0.1));
        assert!((5..40).contains(&during(0.3)), "{}", during(0.3));
    }

    #[test]
    fn an_end_that_misses_messages_or_gets_them_late_wants_more_of_them() {
        let mut pulse = SendInterval::default();
        assert_eq!(pulse.heartbeat_s(0.0), HEARTBEAT_S);
        let mut arrive = |number: u32, late_s: f64| {
            let sent_s = f64::from(number) * 0.04;
            // The clocks are 1000 s apart.
            pulse.arrive(u64::from(number), sent_s + 1000.0, sent_s + 0.025 + late_s);
            pulse.heartbeat_s(sent_s + 0.025 + late_s)
        };
        (1..=20).for_each(|number| assert!((arrive(number, 0.0) - HEARTBEAT_S).abs() < 1e-9, "{number}"));
        // One that is 10 ms late; then one that is missing.
        assert!((arrive(21, 0.01) - 0.03).abs() < 1e-9);
        assert_eq!(arrive(23, 0.0), FASTEST_S);
        // Its effect ends after some time.
        let calm: Vec<f64> = (24..300).map(|number| arrive(number, 0.0)).collect();
        assert_eq!(calm[0], FASTEST_S);
        assert!((calm[275] - HEARTBEAT_S).abs() < 1e-9);
    }
}
