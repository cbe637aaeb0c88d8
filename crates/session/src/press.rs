//! A press as a testing machine does it: the depth of a tip is imposed over time, and the force on it is read.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use glam::DVec3;
use palpate_haptics::pose_playback::SPEED_M_PER_S;
use palpate_haptics::{Tip, TipShape};
use palpate_refusal::{Reason, Refusal, Result, finite, number, positive};
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::Body;
use palpate_tissue::scene::script::Action;
use palpate_tissue::select::scheme_selection::given_up;
use palpate_tissue::{Footprint, Model};

use super::simulation::{Simulation, SimulationFailure};

/// Height above the tissue from which a tip comes to the depth at which a press begins, m. It arrives with a speed of 0: a tip that began
/// at its first place would be dropped there from 2 mm above by the playback of poses, at 0.5 m/s, and the force of its impact would hide
/// the first milliseconds of the press.
const CLEARANCE_M: f64 = 0.002;

/// The time in which a tip comes to its first depth, s: through air, at most at 0.15 m/s, and into the tissue.
const ARRIVES_ABOVE_S: f64 = 0.02;
const ARRIVES_WITHIN_S: f64 = 0.2;

/// The time for which a tip then rests in the tissue, s.
const RESTS_S: f64 = 0.3;

/// Number of samples of a press.
const MAX_SAMPLES: usize = 1 << 20;

/// The longest press, s.
const LONGEST_S: f64 = 3600.0;

/// A press: where, with what tip, and how deep at each time. Between two times the depth is on the straight line between theirs.
#[derive(Debug, Clone, PartialEq)]
pub struct ImposedPress {
    /// Where the tip goes in, m: the nearest place of the rest surface. `None` for the place that stands for the tissue.
    pub place_m: Option<DVec3>,
    /// The body that goes in, not a blade.
    pub shape: TipShape,
    /// Radius of the tip, m.
    pub radius_m: f64,
    /// Times, s, ascending. The first may be any: the tissue rests before it.
    pub time_s: Vec<f64>,
    /// Depth at each time, m, below 0 above the tissue: of a disc of even pressure the mean over it, of a sphere that of its lowest
    /// place. A tip comes to a first depth above 0 in 0.2 s, and rests there for 0.3 s; to another one it comes through air, in 0.02 s.
    pub depth_m: Vec<f64>,
}

/// Returns the place of the rest surface nearest to `place_m` (m), or that which stands for the tissue, and the direction out of the
/// tissue there.
pub(crate) fn on_surface(model: &Model, place_m: Option<DVec3>, radius_m: f64) -> (DVec3, DVec3) {
    let wanted_m = place_m.unwrap_or_else(|| model.shape().pressed_m());
    Footprint::new(model, radius_m, wanted_m).at_rest()
}

/// Returns the place of a tip that touches the surface at rest, m, on its way in at the place and against the direction that
/// [`on_surface`] returns. A flat rigid disc touches the highest vertex beneath it: the mean of a face that it reaches beyond is
/// lower, and there it would press from the beginning.
pub(crate) fn touching_m(model: &Model, shape: TipShape, radius_m: f64, (place_m, outward): (DVec3, DVec3)) -> DVec3 {
    let height_m = shape.height_m(radius_m);
    if shape != TipShape::RigidDisc {
        return place_m + height_m * outward;
    }
    let above_m = |vertex_m: &DVec3| {
        let from_m = *vertex_m - place_m;
        let up_m = from_m.dot(outward);
        ((from_m - up_m * outward).length() <= radius_m && up_m <= radius_m).then_some(up_m)
    };
    let vertices_m = model.shape().shown_surface().map_or(&[][..], |shown| shown.vertices_m);
    let highest_m = vertices_m.iter().filter_map(above_m).fold(0.0, f64::max);
    place_m + (height_m + highest_m) * outward
}

impl ImposedPress {
    /// Checks the numbers of the press.
    ///
    /// # Errors
    /// Refuses a blade, a radius that is not above 0, fewer than two times or more than 2^20, times that do not ascend, depths that are
    /// not one for each time, numbers that are not finite, and a tip that moves faster than 0.5 m/s; the field is that of this type,
    /// with the index of a sample.
    pub fn check(&self) -> Result<()> {
        if self.shape == TipShape::Blade {
            return Err(Refusal::new(Reason::WrongKind, "tip", "must be disc, rigid or sphere: a blade cuts"));
        }
        positive("radius_m", self.radius_m)?;
        let (times, depths) = (self.time_s.len(), self.depth_m.len());
        if times != depths {
            let message = format!("must be one for each time, but are {depths} for {times} times");
            return Err(Refusal::new(Reason::WrongKind, "depth_m", message));
        }
        #[allow(clippy::cast_precision_loss)]
        number("time_s", times as f64, "2 to 1048576 times", |_| (2..=MAX_SAMPLES).contains(&times))?;
        for (index, (time_s, depth_m)) in self.time_s.iter().zip(&self.depth_m).enumerate() {
            finite(&format!("time_s[{index}]"), *time_s)?;
            finite(&format!("depth_m[{index}]"), *depth_m)?;
        }
        for (index, (times_s, depths_m)) in self.time_s.windows(2).zip(self.depth_m.windows(2)).enumerate() {
            let lasts_s = times_s[1] - times_s[0];
            if lasts_s <= 0.0 {
                let message = format!("must be after {} s, but is {} s", times_s[0], times_s[1]);
                return Err(Refusal::new(Reason::OutOfRange, format!("time_s[{}]", index + 1), message));
            }
            let speed_m_per_s = (depths_m[1] - depths_m[0]).abs() / lasts_s;
            let field = format!("depth_m[{}]", index + 1);
            let range = format!("reached with at most {SPEED_M_PER_S} m/s");
            number(&field, speed_m_per_s, &range, |speed| speed <= SPEED_M_PER_S)?;
        }
        number("time_s", self.lasts_s(), &format!("{LONGEST_S} s in all at most"), |lasts_s| lasts_s <= LONGEST_S)?;
        Ok(())
    }

    /// Returns the number of steps of a press into `model`, with those before the first sample.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub fn steps(&self, model: &Model) -> u64 {
        ((self.lead_s(model) + self.lasts_s()) * model.scene.stepping.rate_hz).ceil() as u64
    }

    /// Returns the time from the first sample to the last, s.
    fn lasts_s(&self) -> f64 {
        self.time_s.last().zip(self.time_s.first()).map_or(0.0, |(last, first)| last - first)
    }

    /// Returns the time in which the tip comes to the first depth of a press into `model`, and that for which it rests there, s. A solid
    /// that sags from its first step on has the longer time for that.
    fn begins_s(&self, model: &Model) -> [f64; 2] {
        let is_within = self.depth_m.first().is_some_and(|depth_m| *depth_m > 0.0);
        let sags = matches!(&model.scene.body, Body::Solid(solid) if !solid.gravity().is_at_rest());
        [if is_within || sags { ARRIVES_WITHIN_S } else { ARRIVES_ABOVE_S }, if is_within { RESTS_S } else { 0.0 }]
    }

    /// Returns the time before the first sample, s.
    fn lead_s(&self, model: &Model) -> f64 {
        self.begins_s(model).iter().sum()
    }

    /// Returns the depth at a time after the first sample, s, or before it while the tip arrives, m. `begins_s` are the times of
    /// [`ImposedPress::begins_s`]; `before` is the number of a sample before that time, which goes up.
    fn depth_at_m(&self, time_s: f64, begins_s: [f64; 2], before: &mut usize) -> f64 {
        let begins_m = self.depth_m.first().copied().unwrap_or(0.0);
        if time_s <= 0.0 {
            let part = ((time_s + begins_s[0] + begins_s[1]) / begins_s[0]).clamp(0.0, 1.0);
            let above_m = begins_m.min(0.0) - CLEARANCE_M;
            return above_m + (begins_m - above_m) * (part * part * (3.0 - 2.0 * part));
        }
        let at_s = |index: usize| self.time_s[index] - self.time_s[0];
        while *before + 2 < self.time_s.len() && at_s(*before + 1) <= time_s {
            *before += 1;
        }
        let part = ((time_s - at_s(*before)) / (at_s(*before + 1) - at_s(*before))).min(1.0);
        self.depth_m[*before] + part * (self.depth_m[*before + 1] - self.depth_m[*before])
    }

    /// Presses into `model` at rest, as fast as possible. Returns the force of the tissue on the tip at each time, N: its part along
    /// the direction out of the tissue, between two steps on the straight line.
    ///
    /// # Errors
    /// Refuses what [`ImposedPress::check`] refuses, a tip that does not suit the tissue, and ends with [`Reason::TimedOut`] when `stop` is
    /// set. [`SimulationFailure::Held`]: the tissue had to be put back, so that its force is not that of this press.
    #[allow(clippy::cast_precision_loss)]
    pub fn forces_n(
        &self,
        model: &Arc<Model>,
        limits: &Limits,
        stop: &AtomicBool,
    ) -> std::result::Result<Vec<f64>, SimulationFailure> {
        self.check()?;
        let at_rest = on_surface(model, self.place_m, self.radius_m);
        let (touching_m, outward) = (touching_m(model, self.shape, self.radius_m, at_rest), at_rest.1);
        let tip = Tip { shape: self.shape, radius_m: self.radius_m, friction: 0.0, ..Tip::default() };
        let (step_s, begins_s) = (model.scene.stepping.rate_hz.recip(), self.begins_s(model));
        let lead_s = begins_s[0] + begins_s[1];
        let mut simulation = Simulation::new(model, limits);
        let mut forces_n = Vec::with_capacity(self.time_s.len());
        let (mut before_n, mut before) = (0.0, 0);
        for step in 0..self.steps(model) {
            if stop.load(Ordering::Relaxed) {
                return Err(given_up().into());
            }
            let ends_s = (step + 1) as f64 * step_s - lead_s;
            let place_m = touching_m - self.depth_at_m(ends_s, begins_s, &mut before) * outward;
            simulation.command(0, Action::Pose { place_m, velocity_m_per_s: None, tip })?;
            simulation.step(0)?;
            if let Some(reason) = simulation.session.fault() {
                return Err(SimulationFailure::Held(reason));
            }
            let felt = simulation.session.tissue().tool_contact(0);
            let force_n = felt.map_or(0.0, |felt| outward.dot(felt.force_on_tool_n));
            while let Some(time_s) = self.time_s.get(forces_n.len()).map(|time_s| time_s - self.time_s[0])
                && time_s <= ends_s
            {
                let part = ((ends_s - time_s) / step_s).min(1.0);
                forces_n.push(force_n + part * (before_n - force_n));
            }
            before_n = force_n;
        }
        forces_n.resize(self.time_s.len(), before_n);
        Ok(forces_n)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use palpate_tissue::scene::PAPER;

    fn ramp(begins_m: f64) -> ImposedPress {
        let time_s: Vec<f64> = (0..=20).map(|k| 0.025 * f64::from(k)).collect();
        let depth_m = time_s.iter().map(|time_s| begins_m + 0.004 * time_s).collect();
        ImposedPress { place_m: None, shape: TipShape::Disc, radius_m: 0.04, time_s, depth_m }
    }

    #[test]
    fn a_slow_press_on_anchors_alone_meets_their_stiffness_at_each_depth() {
        let sets = ["sheet.points=[9, 9]", "springs.stiffness_n_per_m=0.0", "damping.coefficient_n_s_per_m=0.1"];
        let model = Model::parse("paper", PAPER, &sets).unwrap();
        let press = |begins_m| ramp(begins_m).forces_n(&model, &Limits::default(), &AtomicBool::new(false)).unwrap();
        let forces_n = press(0.0);
        // Between samples: the damping adds the same force to all but the first.
        let depth_m = ramp(0.0).depth_m;
        let slope = |from: usize, to: usize| (forces_n[to] - forces_n[from]) / (depth_m[to] - depth_m[from]);
        assert!((slope(1, 10) / slope(10, 20) - 1.0).abs() < 0.02, "{forces_n:?}");
        // It has rested at the depth where it begins.
        let later_n = press(0.001);
        assert!((later_n[0] / (0.001 * slope(1, 10)) - 1.0).abs() < 0.02, "{later_n:?}");
        // Above the tissue there is no force.
        assert_eq!(press(-0.003)[..20], [0.0; 20]);
    }

    /// A tip that was dropped onto the tissue would be felt as 0 at first, and then as a knock.
    #[test]
    fn a_fast_press_that_begins_at_the_surface_meets_the_tissue_from_its_first_millisecond_on() {
        let sets = ["sheet.points=[9, 9]", "springs.stiffness_n_per_m=0.0", "damping.coefficient_n_s_per_m=0.1"];
        let model = Model::parse("paper", PAPER, &sets).unwrap();
        let time_s: Vec<f64> = (0..=20).map(|k| 1e-3 * f64::from(k)).collect();
        let depth_m = time_s.iter().map(|time_s| 0.1 * time_s).collect();
        let press = ImposedPress { place_m: None, shape: TipShape::Disc, radius_m: 0.04, time_s, depth_m };
        let forces_n = press.forces_n(&model, &Limits::default(), &AtomicBool::new(false)).unwrap();
        // Anchor springs and damping at a constant speed: a straight line from the first sample after contact on.
        let rise_n = (forces_n[20] - forces_n[1]) / 19.0;
        for (k, pair) in forces_n.windows(2).enumerate().skip(1) {
            assert!(((pair[1] - pair[0]) / rise_n - 1.0).abs() < 0.02, "{k}: {forces_n:?}");
        }
        assert!(forces_n[0].abs() < rise_n, "{forces_n:?}");
    }

    /// A plate that reaches beyond all of a face meets as much force as one that only just covers it, and none before it presses.
    #[test]
    fn a_plate_that_is_wider_than_the_specimen_touches_it_at_depth_0() {
        let text = "[solid]\norgan = { name = \"phantom\", edge_m = 0.005, seed = 1 }\ncell_m = 0.02\nfixed = [{ plane_m = [0, 0, 0], \
                    normal = [0, 0, 1], within_m = 0.001 }]\n[material]\nyoungs_modulus_pa = 15e3\npoissons_ratio = 0.4\n";
        let model = Model::parse("block", text, &[]).unwrap();
        let press = |radius_m| {
            let time_s: Vec<f64> = (0..=10).map(|k| 0.02 * f64::from(k)).collect();
            let depth_m = time_s.iter().map(|time_s| 0.005 * time_s).collect();
            let press = ImposedPress { place_m: None, shape: TipShape::RigidDisc, radius_m, time_s, depth_m };
            press.forces_n(&model, &Limits::default(), &AtomicBool::new(false)).unwrap()
        };
        let (covers_n, wider_n) = (press(0.071), press(0.09));
        assert!(wider_n[0].abs() < 0.01 * wider_n[10], "{wider_n:?}");
        assert!((wider_n[1] / wider_n[10] - 0.1).abs() < 0.03, "{wider_n:?}");
        assert!((wider_n[10] / covers_n[10] - 1.0).abs() < 0.05, "{covers_n:?} {wider_n:?}");
    }

    #[test]
    fn a_press_that_no_machine_does_is_refused_with_its_sample() {
        let refused = |change: &dyn Fn(&mut ImposedPress)| {
            let mut press = ramp(0.0);
            change(&mut press);
            press.check().unwrap_err().field
        };
        assert_eq!(refused(&|press| press.time_s[7] = press.time_s[6]), "time_s[7]");
        assert_eq!(refused(&|press| press.depth_m[3] = f64::NAN), "depth_m[3]");
        assert_eq!(refused(&|press| press.depth_m[3] = 0.1), "depth_m[3]");
        assert_eq!(refused(&|press| press.depth_m.truncate(3)), "depth_m");
        assert_eq!(refused(&|press| press.radius_m = 0.0), "radius_m");
        assert_eq!(refused(&|press| press.shape = TipShape::Blade), "tip");
    }
}
