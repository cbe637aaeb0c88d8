//! The delay at which a hand and a spring at the other end of a network become unstable: measured with the loop of `link`
//! and a spring in place of the tissue, and predicted by theory. This validates the loop.

use glam::DVec3;
use palpate_haptics::hand::{HANDS, Hand, HandState};
use palpate_simulated::network::{Conditions, Direction};
use serde_json::{Value, json};

use super::setup::TICK_S;
use crate::ClientFailure;

/// Stiffnesses to try, N/m.
pub(super) const STIFFNESSES_N_PER_M: [f64; 9] = [150.0, 250.0, 300.0, 400.0, 500.0, 700.0, 1000.0, 1500.0, 3000.0];

/// Longest delay to try, ticks.
const MAX_TICKS: u32 = 200;

/// Simulated duration of each try, s.
const DURATION_S: f64 = 4.0;

/// The result for one hand and one spring.
pub(super) struct Boundary {
    pub(super) hand: &'static str,
    pub(super) stiffness_n_per_m: f64,
    /// The delay by theory, s.
    pub(super) predicted_s: f64,
    /// The measured delay, s; infinite if the loop is stable up to [`MAX_TICKS`].
    pub(super) observed_s: f64,
}

/// Growth rate of the vibration's energy in the loop, 1/s.
fn growth_per_s(hand: &Hand, stiffness_n_per_m: f64, ticks: u32) -> f64 {
    // The whole delay is on one way: with half of an odd number on each, each half would be rounded up to a tick.
    let conditions = |ticks: u32| Conditions { round_trip_s: 2.0 * f64::from(ticks) * TICK_S, ..Conditions::default() };
    let mut up: Direction<DVec3> = Direction::new(conditions(ticks), 0, 0, 0.0);
    let mut down: Direction<DVec3> = Direction::new(conditions(0), 0, 1, 0.0);
    let mut held = HandState { place_m: DVec3::new(0.0, 0.0, 1e-3), velocity_m_per_s: DVec3::ZERO };
    let (mut place_m, mut force_n) = (DVec3::ZERO, DVec3::ZERO);
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let whole = (DURATION_S / TICK_S) as u32;
    let mut halves = [0.0; 2];
    for tick in 0..whole {
        let now_s = f64::from(tick) * TICK_S;
        up.send(now_s, 0, held.place_m);
        while let Some(place) = up.receive(now_s) {
            place_m = place;
        }
        down.send(now_s, 0, -stiffness_n_per_m * place_m);
        while let Some(force) = down.receive(now_s) {
            force_n = force;
        }
        held = hand.advance(held, DVec3::ZERO, DVec3::ZERO, force_n, TICK_S);
        // The first half is skipped: there the initial condition still shows.
        let part = 4 * tick / whole;
        if part >= 2 {
            let energy_j = hand.stiffness_n_per_m * held.place_m.length_squared()
                + hand.mass_kg * held.velocity_m_per_s.length_squared();
            halves[part as usize - 2] += energy_j;
        }
        // Clearly unstable; stop before the numbers overflow.
        if held.place_m.length() >= 1e6 || held.place_m.is_nan() {
            return f64::INFINITY;
        }
    }
    (halves[1] / halves[0]).ln() / (DURATION_S / 4.0)
}

/// The delay, interpolated between two whole ticks, at which the growth is zero, s. Half a tick is added: a force that is
/// held for a tick is half a tick older on average.
fn observed_s(hand: &Hand, stiffness_n_per_m: f64) -> f64 {
    let mut before = f64::NEG_INFINITY;
    for ticks in 0..=MAX_TICKS {
        let growth = growth_per_s(hand, stiffness_n_per_m, ticks);
        if growth > 0.0 {
            let part = if growth.is_finite() && before.is_finite() { before / (before - growth) } else { 1.0 };
            return (f64::from(ticks) - 1.0 + part + 0.5) * TICK_S;
        }
        before = growth;
    }
    f64::INFINITY
}

/// All combinations of hand and spring that have a boundary in the range of delays.
pub(super) fn all() -> Vec<Boundary> {
    let mut found = Vec::new();
    for hand in &HANDS {
        for stiffness_n_per_m in STIFFNESSES_N_PER_M {
            let predicted_s = hand.critical_delay_s(stiffness_n_per_m);
            // A delay below a tick can't be resolved.
            if predicted_s > TICK_S && predicted_s < f64::from(MAX_TICKS) * TICK_S {
                let observed_s = observed_s(hand, stiffness_n_per_m);
                found.push(Boundary { hand: hand.name, stiffness_n_per_m, predicted_s, observed_s });
            }
        }
    }
    found
}

/// Prints all combinations.
pub(super) fn print(as_json: bool) -> Result<(), ClientFailure> {
    let all = all();
    if as_json {
        let rows = all.iter().map(|row| {
            json!({
                "hand": row.hand, "stiffness_n_per_m": row.stiffness_n_per_m,
                "predicted_ms": 1e3 * row.predicted_s, "observed_ms": 1e3 * row.observed_s,
            })
        });
        crate::tell!("{}", Value::Array(rows.collect()));
    } else {
        crate::tell!("{:<8} {:>12} {:>14} {:>13}", "hand", "K (N/m)", "predicted (ms)", "observed (ms)");
        for row in &all {
            let (predicted_ms, observed_ms) = (1e3 * row.predicted_s, 1e3 * row.observed_s);
            crate::tell!("{:<8} {:>12} {predicted_ms:>14.2} {observed_ms:>13.2}", row.hand, row.stiffness_n_per_m);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_loop_becomes_unstable_at_the_delay_that_theory_says() {
        let all = super::all();
        assert!(all.len() >= 20, "only {} combinations have a boundary", all.len());
        for row in all {
            let apart_s = (row.predicted_s - row.observed_s).abs();
            assert!(
                apart_s < 1e-3,
                "{} hand, {} N/m: {} s predicted, {} s observed",
                row.hand,
                row.stiffness_n_per_m,
                row.predicted_s,
                row.observed_s
            );
        }
    }
}
