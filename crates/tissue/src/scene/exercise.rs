//! Exercises: a task on a tissue, its hidden truth, its limits, and how it is scored. What a trainee did is measured elsewhere.

use glam::DVec3;
use palpate_geometry::dice::Dice;

/// The built-in exercises: name and TOML text, by ascending name.
pub const BUILT_IN: [(&str, &str); 8] = [
    ("close-wound", include_str!("../../../../exercises/close-wound.toml")),
    ("cut-line", include_str!("../../../../exercises/cut-line.toml")),
    ("lift-hold", include_str!("../../../../exercises/lift-hold.toml")),
    ("lumps-1", include_str!("../../../../exercises/lumps-1.toml")),
    ("lumps-2", include_str!("../../../../exercises/lumps-2.toml")),
    ("lumps-3", include_str!("../../../../exercises/lumps-3.toml")),
    ("palpate-all", include_str!("../../../../exercises/palpate-all.toml")),
    ("search-mark", include_str!("../../../../exercises/search-mark.toml")),
];

/// Largest number of lumps, lines, regions to avoid and criteria of an exercise, each.
pub const MAX_PARTS: usize = 64;

/// Largest number of phases of an exercise.
pub const MAX_PHASES: usize = 8;

/// How often a lump is placed anew before the exercise is refused: its box has no room for another one.
const MAX_DRAWS: usize = 1000;

/// A task on a tissue and how it is scored.
#[derive(Debug, Clone, PartialEq)]
pub struct Exercise {
    /// Its name, as of its file.
    pub name: String,
    /// What people call it.
    pub title: String,
    /// What the trainee is asked to do.
    pub instructions: String,
    /// The scenes for which it is made, in order of preference: at least one.
    pub scenes: Vec<String>,
    /// Changes of the scene, `KEY=VALUE` each ([`Document::set`](super::toml_document::Document::set)).
    pub set: Vec<String>,
    /// The seed of its hidden truth if nothing else gives one.
    pub seed: u64,
    /// The time that the trainee has, s: what is done later does not count. `None`: as long as it takes.
    pub time_limit_s: Option<f64>,
    /// Its phases, one after the other; none if it is one piece. It ends with the last one.
    pub phases: Vec<ExercisePhase>,
    /// The direction along which the trainee looks at the surface, of length 1. Distances along it do not count: an answer is on the
    /// surface and the lump below it, and a cut is deeper than its line.
    pub seen_along: DVec3,
    /// Lumps that are hidden in the tissue, in place of those of the scene.
    pub lumps: Option<HiddenLumps>,
    /// The lines along which the tissue must be cut.
    pub lines: Vec<CutLine>,
    /// The regions of the surface that no tool may touch.
    pub avoid: Vec<AvoidedRegion>,
    /// The place that must be lifted and held.
    pub lift: Option<LiftTask>,
    /// How the surface must be pressed for a part of it to count as felt.
    pub coverage: Option<CoverageTask>,
    /// The values that the trainee must stay below.
    pub limits: ExerciseLimits,
    /// How the measures become a score.
    pub criteria: Vec<Criterion>,
    /// What the trainee is told.
    pub trainee: TraineeView,
}

/// A part of an exercise that is measured for itself.
#[derive(Debug, Clone, PartialEq)]
pub struct ExercisePhase {
    /// What people call it.
    pub title: String,
    /// What the trainee is asked to do in it.
    pub instructions: String,
    /// The time after which the next one begins, s. `None`: when the trainee goes on.
    pub time_limit_s: Option<f64>,
}

/// What a trainee is told of their measures.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TraineeView {
    /// Names of the measures that they see while the exercise goes on, none of which needs the truth; `None`: all of these.
    pub live_measures: Option<Vec<String>>,
    /// Whether they see the result, with the truth.
    pub sees_result: bool,
}

impl Default for TraineeView {
    fn default() -> Self {
        TraineeView { live_measures: None, sees_result: true }
    }
}

/// Lumps that are drawn from a seed. Ranges are [least, most], both included.
#[derive(Debug, Clone, PartialEq)]
pub struct HiddenLumps {
    /// How many.
    pub count: [u64; 2],
    /// Radius, m.
    pub radius_m: [f64; 2],
    /// Stiffness inside over that outside.
    pub stiffness_factor: [f64; 2],
    /// The corners of the box in which their centres lie, m, in the tissue's frame.
    pub from_m: DVec3,
    /// The opposite corner.
    pub to_m: DVec3,
    /// Least distance between the surfaces of two lumps, m.
    pub apart_m: f64,
    /// An answer is a hit if it is at most this far beyond the lump's radius from its centre, across the exercise's `seen_along`, m.
    pub found_within_m: f64,
}

/// A lump of an exercise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lump {
    /// Its centre, m, in the tissue's frame.
    pub centre_m: DVec3,
    /// Its radius, m.
    pub radius_m: f64,
    /// Stiffness inside over that outside.
    pub stiffness_factor: f64,
}

/// A line on the surface along which the tissue must be cut.
#[derive(Debug, Clone, PartialEq)]
pub struct CutLine {
    /// Its corners, m, in the tissue's frame; at least two.
    pub points_m: Vec<DVec3>,
    /// A cut is on the line if it is at most this far from it, m.
    pub within_m: f64,
}

/// A part of the surface that no tool may touch: what is in a ball.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AvoidedRegion {
    /// Centre of the ball, m.
    pub centre_m: DVec3,
    /// Radius of the ball, m.
    pub radius_m: f64,
}

/// A place of the surface that must be lifted, and held there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LiftTask {
    /// The place of the surface at rest, m.
    pub place_m: DVec3,
    /// How far it must be lifted from there, against `seen_along`, m.
    pub height_m: f64,
    /// For how long, s.
    pub hold_s: f64,
}

/// How the surface must be pressed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CoverageTask {
    /// The pressure from which on a part of the surface counts as felt, Pa.
    Pressure(f64),
    /// The pressure from which on this lump would be felt: it follows from the tissue.
    Lump(FeltLump),
}

/// A lump that must be felt where it could be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FeltLump {
    /// Its radius, m.
    pub radius_m: f64,
    /// Distance of its nearest place from the surface, m.
    pub depth_m: f64,
    /// Stiffness inside over that outside.
    pub stiffness_factor: f64,
    /// Radius of the fingertip that feels it, m.
    pub tip_radius_m: f64,
}

/// Values that the trainee must stay below; `None`: no limit.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ExerciseLimits {
    /// Force of one tool, N.
    pub force_n: Option<f64>,
    /// Mean pressure under a tip, Pa.
    pub pressure_pa: Option<f64>,
    /// Strain of the tissue near a tool ([`Tissue::strain_around`](crate::Tissue::strain_around)).
    pub strain: Option<f64>,
}

/// A measure in a score.
#[derive(Debug, Clone, PartialEq)]
pub struct Criterion {
    /// Name of the measure.
    pub measure: String,
    /// The phase whose figure counts, from 1; `None`: that of the whole exercise.
    pub phase: Option<u32>,
    /// Its weight beside the other criteria, above 0.
    pub weight: f64,
    /// The value that earns nothing.
    pub poor: f64,
    /// The value that earns all. Between both the points are in proportion.
    pub good: f64,
}

impl Criterion {
    /// Returns the part of its weight that a value earns, 0 to 1: 0 at `poor`, 1 at `good` and beyond.
    pub fn part(&self, value: f64) -> f64 {
        ((value - self.poor) / (self.good - self.poor)).clamp(0.0, 1.0)
    }
}

impl HiddenLumps {
    /// Returns the lumps of a seed: each in the box, and at least `apart_m` from the others. `None` if the box has no room for
    /// so many ([`MAX_DRAWS`]). Equal seeds give equal lumps on every machine.
    pub fn drawn(&self, seed: u64) -> Option<Vec<Lump>> {
        let mut dice = Dice::new(seed);
        let [least, most] = self.count;
        // Saturating cast of a number from `least` to `most` + 1.
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
        let count = (dice.within(least as f64, most as f64 + 1.0) as u64).min(most);
        let mut lumps: Vec<Lump> = Vec::new();
        for _ in 0..count {
            let free = self.free_lump(&mut dice, &lumps)?;
            lumps.push(free);
        }
        Some(lumps)
    }

    /// Returns another lump of a seed, at least `apart_m` from `others`; `None` if the box has no room for it. Equal seeds give equal
    /// lumps on every machine.
    pub fn another(&self, seed: u64, others: &[Lump]) -> Option<Lump> {
        self.free_lump(&mut Dice::new(seed), others)
    }

    fn free_lump(&self, dice: &mut Dice, others: &[Lump]) -> Option<Lump> {
        let mut lump = || Lump {
            radius_m: dice.within(self.radius_m[0], self.radius_m[1]),
            stiffness_factor: dice.within(self.stiffness_factor[0], self.stiffness_factor[1]),
            centre_m: DVec3::from_array(std::array::from_fn(|axis| dice.within(self.from_m[axis], self.to_m[axis]))),
        };
        let is_free = |lump: &Lump| {
            others
                .iter()
                .all(|other| other.centre_m.distance(lump.centre_m) >= other.radius_m + lump.radius_m + self.apart_m)
        };
        (0..MAX_DRAWS).map(|_| lump()).find(is_free)
    }
}

impl Exercise {
    /// Returns the lumps of a seed; empty without hidden lumps. The reader has checked that the exercise's own seed has some.
    pub fn lumps(&self, seed: u64) -> Option<Vec<Lump>> {
        self.lumps.as_ref().map_or(Some(Vec::new()), |hidden| hidden.drawn(seed))
    }

    /// Returns whether the exercise hides something from the trainee: how many lumps there are, and where.
    pub fn hides_truth(&self) -> bool {
        self.lumps.is_some()
    }

    /// Returns the assignments by which a scene is changed ([`Document::set`](super::toml_document::Document::set)): those of the exercise,
    /// and one by which the scene gets these lumps in place of its own, if the exercise hides any.
    pub fn assignments(&self, lumps: &[Lump]) -> Vec<String> {
        let inclusion = |lump: &Lump| {
            let Lump { centre_m: DVec3 { x, y, z }, radius_m, stiffness_factor } = lump;
            format!(
                "{{ centre_m = [{x:?}, {y:?}, {z:?}], radius_m = {radius_m:?}, stiffness_factor = {stiffness_factor:?} }}"
            )
        };
        let mut all = self.set.clone();
        if self.lumps.is_some() {
            all.push(format!("inclusion=[{}]", lumps.iter().map(inclusion).collect::<Vec<_>>().join(", ")));
        }
        all
    }
}
