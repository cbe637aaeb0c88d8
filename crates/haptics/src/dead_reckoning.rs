//! Dead reckoning: a client tells its tool's place only when the server would be wrong about it.
//!
//! The server plays the movement of the newest command on ([`crate::pose_playback`]), and so can the client, which knows it. The next
//! command goes out when the tool is farther from there than a way that the hand would feel: a part of the force, over the
//! stiffness of the law at this depth ([`crate::Renderer::way_m`]); and in any case so often that the server does not take
//! the client for gone.
//!
//! **Heartbeats.** Each end holds what it does when it hears nothing for 50 ms ([`crate::pose_playback::HOLD_S`],
//! [`crate::envelope::FRESH_S`]). Over a steady network a message every 40 ms is enough; where messages are lost or late it is
//! not. So each end measures what arrives ([`SendInterval`]) and tells the other how often it wants to hear from it.

use std::collections::VecDeque;

use glam::DVec3;

use crate::deadband::HEARTBEAT_S;
use crate::pose_playback::EXTRAPOLATE_S;

/// Shortest time between two heartbeats, s: five of them in the 50 ms after which the other end holds.
pub const FASTEST_S: f64 = 0.01;

/// A loss or a delay is remembered for this long, s.
const MEMORY_S: f64 = 5.0;

/// How often one end wants to hear from the other.
#[derive(Debug, Clone, Default)]
pub struct SendInterval {
    newest: u64,
    lost_s: Option<f64>,
    /// Transit times, with whatever the clocks are apart, by arrival, s.
    transits: VecDeque<(f64, f64)>,
}

impl SendInterval {
    /// Takes the arrival at `now_s` of message `number` (they are counted from 1), sent at `sent_s` by the other's clock.
    pub fn arrive(&mut self, number: u64, sent_s: f64, now_s: f64) {
        // What comes later after all was not lost, but its place has been missed all the same.
        if number > self.newest + 1 && self.newest > 0 {
            self.lost_s = Some(now_s);
        }
        self.newest = self.newest.max(number);
        self.transits.push_back((now_s, now_s - sent_s));
        while self.transits.len() > MAX_TRANSITS || self.transits[0].0 < now_s - MEMORY_S {
            self.transits.pop_front();
        }
    }

    /// Returns the longest time between two messages that it wants, s: [`HEARTBEAT_S`] less what the transit times of the last
    /// 5 s differ by (the longest less the shortest: what the clocks are apart cancels), but at least [`FASTEST_S`];
    /// and that for 5 s after a loss.
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

/// Transit times that are remembered.
const MAX_TRANSITS: usize = 512;

/// The velocity of a tool is that over this time: a device counts in steps, and its noise is not a movement.
const LOOK_BACK_S: f64 = 0.004;

/// Places that are looked back on, at most: of a tool that is asked for more often than usual, the oldest are left out.
const MAX_RECENT: usize = 64;

/// Decides which places of a tool are news.
///
/// The server may be wrong about the tool by 0.1 mm. A tool that drifts by 0.05 mm is no news; one that is 0.2 mm off is:
///
/// ```
/// use glam::DVec3;
/// use palpate_haptics::News;
///
/// let (most_m, heartbeat_s) = (1e-4, 0.04);
/// let mut news = News::default();
/// assert!(news.tell(0.000, DVec3::ZERO, most_m, heartbeat_s).is_some());
/// assert!(news.tell(0.001, 5e-5 * DVec3::X, most_m, heartbeat_s).is_none());
/// let told = news.tell(0.002, 2e-4 * DVec3::X, most_m, heartbeat_s).expect("it is 0.2 mm from where it was told");
/// // It moves at 0.1 m/s, so 10 ms later the server thinks that it is 1.2 mm from its first place.
/// assert!((told.velocity_m_per_s - 0.1 * DVec3::X).length() < 1e-12);
/// assert!((told.at(0.012) - 1.2e-3 * DVec3::X).length() < 1e-12);
/// ```
#[derive(Debug, Clone)]
pub struct News {
    sent: Option<MotionState>,
    recent: VecDeque<(f64, DVec3)>,
}

impl Default for News {
    /// Nothing is known yet. It has room for all that it will keep: a tick must not ask for memory.
    fn default() -> Self {
        News { sent: None, recent: VecDeque::with_capacity(MAX_RECENT) }
    }
}

/// A place of a tool, and how it moves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionState {
    /// The client's time, s.
    pub time_s: f64,
    /// m.
    pub place_m: DVec3,
    /// m/s.
    pub velocity_m_per_s: DVec3,
}

impl MotionState {
    /// Returns where the server thinks the tool is at a time: x + v·(t − t0), with t − t0 from 0 to [`EXTRAPOLATE_S`], m.
    pub fn at(&self, time_s: f64) -> DVec3 {
        self.place_m + self.velocity_m_per_s * (time_s - self.time_s).clamp(0.0, EXTRAPOLATE_S)
    }
}

impl News {
    /// Returns what to tell of a tool that is at `place_m` at `now_s`; `None` while the server is wrong by no more than
    /// `most_m` and has heard something within `heartbeat_s`.
    ///
    /// The velocity told is (x(t) − x(t − τ))/τ with τ = 4 ms, m/s.
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
        // That is over after some time.
        let calm: Vec<f64> = (24..300).map(|number| arrive(number, 0.0)).collect();
        assert_eq!(calm[0], FASTEST_S);
        assert!((calm[275] - HEARTBEAT_S).abs() < 1e-9);
    }
}
