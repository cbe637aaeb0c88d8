//! A simulated hand of a client of a load test.

use glam::DVec3;
use palpate_haptics::hand::{Hand, HandState};

use crate::random::Random;
use crate::task::{LEAD_S, Task};

/// Scale of the depths of a hand's presses, and duration of its task, s.
const SCALE: f64 = 0.2;
const LASTS_S: f64 = 3600.0;

/// Longest time that a hand moves between two ticks, s.
const MAX_S: f64 = 0.02;

/// A hand that holds a device.
pub(crate) struct Holding {
    hand: Hand,
    task: Task,
    held: HandState,
    /// The force on the hand until the next tick, N.
    pub(crate) force_n: DVec3,
    /// The time of the first tick and of the last, s.
    began_s: f64,
    last_s: f64,
    /// When it last asked for forces, s.
    pub(crate) asked_s: f64,
}

impl Holding {
    /// Creates a hand whose movements follow from a seed, on a tissue with the centre `middle_m`, m.
    pub(crate) fn new(hand: Hand, seed: u64, middle_m: DVec3) -> Self {
        let task = Task::new(middle_m, LEAD_S, LASTS_S, SCALE, &mut Random::new(seed, 0));
        let held = HandState { place_m: task.start_m(), velocity_m_per_s: DVec3::ZERO };
        let never = f64::NEG_INFINITY;
        Holding { hand, task, held, force_n: DVec3::ZERO, began_s: f64::NAN, last_s: never, asked_s: never }
    }

    /// Advances the hand to `now_s`. Returns the place of its tool, m.
    pub(crate) fn place_m(&mut self, now_s: f64) -> DVec3 {
        if self.began_s.is_nan() {
            (self.began_s, self.last_s) = (now_s, now_s);
        }
        let (passed_s, from_s) = ((now_s - self.last_s).clamp(0.0, MAX_S), self.last_s - self.began_s);
        if passed_s > 0.0 {
            let (from_m, to_m) = (self.task.at(from_s), self.task.at(from_s + passed_s));
            let string_n = self.hand.string_n(from_m, self.held.place_m);
            self.held = self.hand.advance(self.held, from_m, to_m, self.force_n + string_n, passed_s);
        }
        self.last_s = now_s;
        self.held.place_m
    }
}
