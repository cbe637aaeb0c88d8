//! A hand that feels the tissue directly: the same hand and task without a network, client or device. Its depth is
//! the reference for a touch over a network.

use palpate_haptics::hand::HandState;

use super::setup::{Setup, TICK_S, ticks};
use super::tissue::LinkTissue;

use glam::DVec3;
use palpate_simulated::random::Random;
use palpate_simulated::task::{self, Task};

/// Smallest scale: a smaller task would hardly touch the tissue.
const MIN_SCALE: f64 = 0.01;

/// Course of a hand that feels the tissue directly.
pub(super) struct Direct {
    /// The scale of the task's depths: reduced until this hand meets no more than [`task::FORCE_SHARE`] of the
    /// device's force. So it does not depend on how a client renders samples.
    pub(super) scale: f64,
    /// Its depth in each tick, m.
    depths_m: Vec<f64>,
}

impl Direct {
    /// Simulates the hand and the task of a run whose first press is after `lead_s`.
    ///
    /// # Errors
    /// Returns the reason if the guard stops the tissue.
    pub(super) fn new(setup: &Setup, lead_s: f64) -> Result<Self, String> {
        let most_n = task::FORCE_SHARE * setup.device.most_n();
        let mut scale = task::scale(&setup.hand, &setup.law, setup.device.most_n());
        loop {
            let (depths_m, largest_n) = Self::performed(setup, lead_s, scale, most_n)?;
            if largest_n <= most_n || scale < MIN_SCALE {
                return Ok(Direct { scale, depths_m });
            }
            scale *= 0.9;
        }
    }

    /// Returns the depths and the largest force of a task; only until the force exceeds `most_n`.
    fn performed(setup: &Setup, lead_s: f64, scale: f64, most_n: f64) -> Result<(Vec<f64>, f64), String> {
        let (middle_m, hand) = (setup.spot.at_m, &setup.hand);
        let task = Task::new(middle_m, lead_s, setup.duration_s, scale, &mut Random::new(setup.seed, 0));
        let mut tissue = LinkTissue::new(setup)?;
        let mut held = HandState { place_m: task.start_m(), velocity_m_per_s: DVec3::ZERO };
        let (mut depths_m, mut largest_n) = (Vec::new(), 0.0_f64);
        for tick in 0..ticks(setup.duration_s) {
            let now_s = f64::from(tick) * TICK_S;
            depths_m.push(setup.spot.depth_m(held.place_m));
            let (true_n, _) = tissue.truth(held.place_m, now_s)?;
            largest_n = largest_n.max(true_n.length());
            if largest_n > most_n {
                break;
            }
            let (from_m, to_m) = (task.at(now_s), task.at(now_s + TICK_S));
            let string_n = hand.string_n(from_m, held.place_m);
            held = hand.advance(held, from_m, to_m, true_n + string_n, TICK_S);
        }
        Ok((depths_m, largest_n))
    }

    /// Returns its depth in a tick, m.
    pub(super) fn depth_m(&self, tick: u32) -> Option<f64> {
        self.depths_m.get(tick as usize).copied()
    }
}
