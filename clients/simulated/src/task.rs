//! The movement of a simulated hand: presses from free space into the tissue and out again, some with a stroke along
//! it. The movements are smooth, like those of hands (minimum jerk), and chosen by random numbers.

use glam::DVec3;
use palpate_haptics::Law;
use palpate_haptics::hand::Hand;

use crate::random::Random;

/// Usual time before the first press of a [`Task`], s: longer than forces take to fade in.
pub const LEAD_S: f64 = 0.7;

/// Range of the target's depths, m.
const DEPTH_M: [f64; 2] = [0.005, 0.015];
/// Range of presses per second.
const RATE_HZ: [f64; 2] = [0.4, 1.0];
/// Range of heights above the tissue between presses, m.
const HEIGHT_M: [f64; 2] = [0.002, 0.005];
/// Longest stroke, m, and largest speed of a stroke, m/s.
const STROKE_M: f64 = 0.02;
const STROKE_M_PER_S: f64 = 0.06;
/// Fraction of the presses that have a stroke.
const STROKES: f64 = 0.7;
/// Durations of the parts of a press (down, along, up) as fractions of the whole.
const PARTS: [f64; 3] = [0.3, 0.4, 0.3];

/// Ratio of the largest to the mean speed of a minimum-jerk movement.
const PEAK: f64 = 1.875;

/// Fraction of the device's largest force that the force of a hand's deepest press must not exceed ([`scale`]).
pub const FORCE_SHARE: f64 = 0.8;

/// One movement, relative to the end of the one before.
struct Leg {
    from_s: f64,
    to_s: f64,
    by_m: DVec3,
}

/// The movement of a hand's target over time: the place where the hand wants its tool to be, in the tissue's frame.
/// Presses follow each other without a pause, 0.4 to 1 per second, each 5 to 15 mm (times a scale) below the surface
/// and back to 2 to 5 mm above it; most have a stroke of up to 20 mm along the surface.
pub struct Task {
    start_m: DVec3,
    legs: Vec<Leg>,
    /// Largest distance of the target from its start at the ends of movements, m.
    pub amplitude_m: f64,
}

impl Task {
    /// Creates presses around `middle_m`, a place on the surface at rest, m, in the tissue's frame. They go down along −z
    /// and their strokes along x and y, so the surface there should face +z. The first begins at `lead_s`, the last
    /// before `duration_s`, and ends at most 2.5 s after that; both are finite times, s. If `duration_s` is not above
    /// `lead_s`, there are none, and the target rests. `scale` (above 0, see
    /// [`scale`]) multiplies the depths below the surface, not the heights above it. Equal random numbers give equal
    /// movements.
    pub fn new(middle_m: DVec3, lead_s: f64, duration_s: f64, scale: f64, random: &mut Random) -> Self {
        let mut height_m = random.between(HEIGHT_M[0], HEIGHT_M[1]);
        let start_m = middle_m + height_m * DVec3::Z;
        let mut legs: Vec<Leg> = Vec::new();
        let (mut now_s, mut along_m) = (lead_s, DVec3::ZERO);
        let (mut amplitude_m, mut away_m) = (0.0_f64, DVec3::ZERO);
        while now_s < duration_s {
            let period_s = 1.0 / random.between(RATE_HZ[0], RATE_HZ[1]);
            let depth_m = scale * random.between(DEPTH_M[0], DEPTH_M[1]);
            let next_m = random.between(HEIGHT_M[0], HEIGHT_M[1]);
            let angle = random.between(0.0, std::f64::consts::TAU);
            let longest_m = STROKE_M.min(STROKE_M_PER_S * PARTS[1] * period_s / PEAK);
            let length_m = random.between(0.0, longest_m);
            // Strokes alternate about the middle, so that none leads away from it by more than its length.
            let mut stroke_m = length_m * DVec3::new(angle.cos(), angle.sin(), 0.0);
            if along_m.dot(stroke_m) > 0.0 {
                stroke_m = -stroke_m;
            }
            if random.between(0.0, 1.0) > STROKES || (along_m + stroke_m).length() > STROKE_M / 2.0 {
                stroke_m = DVec3::ZERO;
            }
            let moves = [-(height_m + depth_m) * DVec3::Z, stroke_m, (depth_m + next_m) * DVec3::Z];
            for (part, by_m) in PARTS.iter().zip(moves) {
                legs.push(Leg { from_s: now_s, to_s: now_s + part * period_s, by_m });
                now_s += part * period_s;
                away_m += by_m;
                amplitude_m = amplitude_m.max(away_m.length());
            }
            along_m += stroke_m;
            height_m = next_m;
        }
        Task { start_m, legs, amplitude_m }
    }

    /// Returns the target's position until the first press, m: 2 to 5 mm above the middle.
    pub fn start_m(&self) -> DVec3 {
        self.start_m
    }

    /// Returns the target's position at `time_s`, m; it rests before the first press and after the last.
    pub fn at(&self, time_s: f64) -> DVec3 {
        self.legs.iter().take_while(|leg| leg.from_s < time_s).fold(self.start_m, |place_m, leg| {
            let x = ((time_s - leg.from_s) / (leg.to_s - leg.from_s)).min(1.0);
            place_m + leg.by_m * (x * x * x * (10.0 + x * (6.0 * x - 15.0)))
        })
    }
}

/// Returns the scale of depths for [`Task::new`] at which the deepest press of a hand at rest, whose spring and the
/// tissue are in balance, has 93 % of [`FORCE_SHARE`] of a device's largest force `most_n`, N: the rest is a margin
/// for damping and friction. `law` is the tissue's force law. At most 1, which a hand without stiffness gets.
pub fn scale(hand: &Hand, law: &Law, most_n: f64) -> f64 {
    let force_n = FORCE_SHARE * MARGIN * most_n;
    let yields_m = if hand.stiffness_n_per_m > 0.0 { force_n / hand.stiffness_n_per_m } else { f64::INFINITY };
    ((law.depth_of(force_n) + yields_m) / DEPTH_M[1]).min(1.0)
}

/// Margin for damping and friction, which the balance of a hand at rest ignores.
const MARGIN: f64 = 0.93;
