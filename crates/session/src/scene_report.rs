//! Properties of a tissue that a user should know before touching it: its size and mass, the stiffness under a
//! fingertip, the time to rest, and unlikely values of a scene or a script.

use std::fmt;
use std::sync::atomic::AtomicBool;

use glam::DVec3;
use palpate_haptics::{Coupling, Law, Tip, TipShape};

use palpate_tissue::response::force_law::{self, Disc};
use palpate_tissue::response::mesh_error::MeshErrorEstimate;
use palpate_tissue::scene::BodyKind;
use palpate_tissue::scene::profile::{LoadProfile, Poke, PoseProfile, StrengthProfile, weights};
use palpate_tissue::scene::script::Script;
use palpate_tissue::scheme::Relaxation;
use palpate_tissue::shape::{Deepest, Extent, RestShape};
use palpate_tissue::{Cuts, Model};

/// Bounds of plausible values. Beyond them a unit is probably wrong.
const LONGEST_SIDE_M: f64 = 10.0;
const HEAVIEST_POINT_KG: f64 = 0.1;
const LONGEST_REST_S: f64 = 60.0;
/// Stiffness under a fingertip, N/m: from imperceptible to bone.
const STIFFNESS_N_PER_M: [f64; 2] = [0.1, 1e5];

/// Fraction to which vibrations must have decayed at rest.
const AT_REST: f64 = 0.01;

/// Limit of the forces that are shown, and of the tools with a tip.
const MAX_SHOWN: usize = 8;

/// Expected behaviour of a tissue, and of a script on it.
#[derive(Debug)]
pub(super) struct Prospect {
    extent: Extent,
    mass_kg: f64,
    radius_m: f64,
    /// The law under a fingertip in the middle; `None` if it takes too much work.
    law: Option<Law>,
    /// Why there is no law.
    no_law: &'static str,
    /// The error of the cells of a solid under that fingertip.
    cells: Option<MeshErrorEstimate>,
    /// Depth of the deepest sensible press by a fingertip, m: half the shorter side, or as far as the law reaches.
    deepest_m: f64,
    is_by_law: bool,
    /// Time to rest, s, or why it is unknown.
    rest_s: Result<f64, &'static str>,
    forces: Vec<Force>,
    tips: Vec<TipUse>,
    /// Descriptions of unlikely values.
    pub(super) warnings: Vec<String>,
}

/// A force of a script.
#[derive(Debug)]
struct Force {
    /// Largest force, on all points together, N.
    total_n: f64,
    /// Depth to which it pushes, m; an upper bound on a mesh. `None` if the law takes too much work, or if nothing
    /// pulls back.
    depth_m: Option<f64>,
    /// Depth beyond which it goes through, m: the longest side, or the thickness of a mesh there.
    through_m: f64,
}

/// A tool with a tip.
#[derive(Debug)]
struct TipUse {
    /// The tool's number.
    tool: usize,
    meeting: Meeting,
}

/// How a tip meets the tissue at rest.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Meeting {
    /// Its first pose is later than the end of the script.
    Unused,
    /// No part of its path is over the tissue.
    Beside,
    /// It stays above the tissue.
    Above { gap_m: f64 },
    /// It touches the tissue and presses it in.
    Pressed {
        /// Depth of the deepest place, m.
        depth_m: f64,
        /// Force there, N; `None` if the law takes too much work.
        force_n: Option<f64>,
        /// Whether depth and force are upper bounds, because a spring between tool and surface reduces them.
        is_bound: bool,
    },
    /// It grasps the tissue, and moves it.
    Held { moved_m: f64 },
}

/// The force laws of a tissue under discs; each is computed once.
struct Laws<'m> {
    model: &'m Model,
    known: Vec<(Disc, Option<Law>)>,
}

impl Laws<'_> {
    /// Returns the law under a disc of this radius in the middle.
    fn of(&mut self, radius_m: f64) -> Option<&Law> {
        self.under(Disc::in_middle(self.model, radius_m))
    }

    /// Returns the law under a disc: a coarse one if the exact one takes too much work, `None` if that does too.
    fn under(&mut self, disc: Disc) -> Option<&Law> {
        let known = self.known.iter().position(|known| known.0 == disc);
        let place = known.unwrap_or_else(|| {
            let law =
                force_law::first(self.model, &Cuts::default(), disc, &AtomicBool::new(false)).filter(Law::is_sound);
            self.known.push((disc, law));
            self.known.len() - 1
        });
        self.known[place].1.as_ref()
    }
}

impl Prospect {
    /// Computes the expected behaviour of a tissue, and of a script on it.
    pub(super) fn new(model: &Model, script: Option<&Script>) -> Self {
        let shape = model.shape();
        let size_m = shape.extent().size_m();
        let radius_m = Tip::default().radius_m;
        let mut laws = Laws { model, known: Vec::new() };
        let law = laws.of(radius_m).cloned();
        let half_m = 0.5 * shorter_m(size_m);
        let reach_m = law.as_ref().map_or(f64::INFINITY, Law::reach_m);
        let mass_kg = model.scene.mass_kg();
        let mut prospect = Prospect {
            extent: shape.extent(),
            mass_kg,
            radius_m,
            law,
            no_law: "its force law takes too much work",
            cells: MeshErrorEstimate::of(model, Disc::in_middle(model, radius_m)),
            deepest_m: half_m.min(reach_m),
            is_by_law: reach_m < half_m,
            rest_s: Relaxation::of(&model.scene).rest_s(AT_REST),
            forces: script.map_or(Vec::new(), |script| forces(model, script, &mut laws)),
            tips: script.map_or(Vec::new(), |script| tips(shape, script, &mut laws)),
            warnings: Vec::new(),
        };
        prospect.warnings = prospect.doubts(model.scene.body.kind());
        prospect
    }

    /// Returns the stiffness that a fingertip meets where it begins to press, N/m.
    fn stiffness_n_per_m(&self) -> Option<f64> {
        self.law.as_ref().map(|law| law.at_depth(0.0).stiffness_n_per_m)
    }

    fn doubts(&self, kind: &dyn BodyKind) -> Vec<String> {
        let (shape, point_mass_kg) = (kind.shape(), kind.point_mass_kg());
        let mut doubts = Vec::new();
        let (longest_m, edge_m) = (shape.longest_side_m(), shape.edge_m());
        if longest_m > LONGEST_SIDE_M {
            let most = rounded(LONGEST_SIDE_M);
            let (what, unit) = (kind.section(), kind.unit_hint());
            doubts.push(format!("the {what} is {} long, more than {most} m: {unit}", length(longest_m)));
        }
        if point_mass_kg > HEAVIEST_POINT_KG {
            let (mass, most) = (rounded(point_mass_kg), rounded(HEAVIEST_POINT_KG));
            let key = kind.section();
            doubts.push(format!("a point weighs {mass} kg, more than {most} kg: {key}.point_mass_kg is in kg"));
        }
        if edge_m > self.radius_m {
            let (edge, radius) = (length(edge_m), length(self.radius_m));
            doubts.push(format!(
                "the points are {edge} apart, more than a fingertip's radius ({radius}): a disc of that size acts as if it \
                 were larger"
            ));
        }
        let reaches_rim = |side: DVec3| shape.beyond_rim_m(shape.extent().middle_m() + self.radius_m * side) > 0.0;
        if reaches_rim(DVec3::X) || reaches_rim(DVec3::Y) {
            let (across, what) = (length(2.0 * self.radius_m), kind.section());
            doubts.push(format!("a fingertip, {across} across, is wider than the {what}"));
        }
        let [least, most] = STIFFNESS_N_PER_M;
        if let Some(stiffness) = self.stiffness_n_per_m().filter(|stiffness| !(least..=most).contains(stiffness)) {
            let range = format!("not from {} to {}", rounded(least), rounded(most));
            doubts.push(format!("a fingertip meets {} N/m, {range}: stiffness is in N/m", rounded(stiffness)));
        }
        if let Ok(rest_s) = self.rest_s
            && rest_s > LONGEST_REST_S
        {
            let (rest, most) = (rounded(rest_s), rounded(LONGEST_REST_S));
            doubts.push(format!(
                "the tissue takes {rest} s to come to rest, more than {most} s: look at mass and damping"
            ));
        }
        for (index, force) in self.forces.iter().enumerate() {
            if let Some(depth_m) = force.depth_m.filter(|depth_m| *depth_m > force.through_m) {
                let (total, depth) = (rounded(force.total_n), length(depth_m));
                let bound = if force.through_m < longest_m {
                    format!("more than the {} that it is thick there", length(force.through_m))
                } else {
                    "more than its longest side".to_owned()
                };
                doubts.push(format!(
                    "force[{index}]: {total} N would push the tissue in by {depth}, {bound}: it goes through"
                ));
            }
        }
        for TipUse { tool, meeting } in &self.tips {
            match meeting {
                Meeting::Pressed { depth_m, .. } if *depth_m > longest_m => doubts.push(format!(
                    "tool {tool} goes {} deep, more than the tissue's longest side: it goes through",
                    length(*depth_m)
                )),
                Meeting::Unused | Meeting::Beside | Meeting::Above { .. } => {
                    doubts.push(format!("tool {tool} {meeting}"));
                }
                Meeting::Pressed { .. } | Meeting::Held { .. } => {}
            }
        }
        doubts
    }
}

/// Returns the depth of each force of a script. On a uniform tissue, a disc with the area of the falloff presses with
/// the whole force in the middle; beyond the law's reach the force continues linearly. On others, the force acts where
/// it begins ([`BodyKind::indentation_m`]).
fn forces(model: &Model, script: &Script, laws: &mut Laws<'_>) -> Vec<Force> {
    let shape = model.shape();
    let force = |profile: &LoadProfile| {
        let total_n = total_n(shape, profile);
        let longest_m = shape.longest_side_m();
        if !shape.is_uniform() {
            let (centre_m, factor) = (profile.centre.begins_at_m(), profile.falloff_offset);
            let (falloff_per_m, force_n) = (profile.falloff_per_m, largest_n(profile));
            let poke = Poke { point: None, centre_m, force_n, falloff_per_m, falloff_offset: factor };
            let (scene, kind) = (&model.scene, model.scene.body.kind());
            let (anchor_n_per_m, volume_pa) = (scene.anchor_stiffness_n_per_m, scene.volume_stiffness_pa);
            let depth_m = kind.indentation_m(&scene.springs, anchor_n_per_m, volume_pa, &poke);
            let through_m = kind.thickness_m(shape.nearest(centre_m)).unwrap_or(longest_m);
            return Force { total_n, depth_m, through_m };
        }
        let widest_m = 0.5 * longest_m;
        // ∫ exp(−c·r) over the plane is the area of a disc of this radius.
        let radius_m = (std::f64::consts::SQRT_2 / profile.falloff_per_m).clamp(0.5 * shape.edge_m(), widest_m);
        Force { total_n, depth_m: laws.of(radius_m).map(|law| law.depth_of(total_n)), through_m: longest_m }
    };
    script.forces.iter().map(force).collect()
}

/// Returns how each tool with a tip meets the tissue at rest, without the effects of other tools. Tips of instruments are left out:
/// most of them stay away, and those that do not share the force.
#[allow(clippy::cast_precision_loss)]
fn tips(shape: &dyn RestShape, script: &Script, laws: &mut Laws<'_>) -> Vec<TipUse> {
    let first = script.first_tip().unwrap_or_default();
    let end_s = script.steps as f64 / script.rate_hz;
    let of = |(tool, profile): (usize, &PoseProfile)| TipUse { tool, meeting: meeting(shape, profile, end_s, laws) };
    (first..).zip(&script.poses).filter(|(_, profile)| profile.mounted.is_none()).map(of).collect()
}

/// Returns how a tool meets the tissue at rest until `end_s`. The force is that of the law under a disc of its
/// radius: in the middle of a sheet, or at the deepest place on a mesh.
fn meeting(shape: &dyn RestShape, profile: &PoseProfile, end_s: f64, laws: &mut Laws<'_>) -> Meeting {
    let end_s = end_s.min(profile.until_s);
    let endless = PoseProfile { until_s: f64::INFINITY, ..profile.clone() };
    let reached = profile.poses.iter().take_while(|pose| pose.0 <= end_s).map(|pose| pose.1);
    let way: Vec<DVec3> = reached.chain(endless.at(end_s)).collect();
    // A disc meets the tissue while its edge is over it.
    let (tip, extent) = (profile.tip, shape.extent());
    let over = |pair: &[DVec3]| extent.part_beneath_m([pair[0], pair[1]], tip.radius_m);
    let Some(begin) = way.windows(2).position(|pair| over(pair).is_some()) else {
        return if way.is_empty() { Meeting::Unused } else { Meeting::Beside };
    };
    if tip.grasps {
        let held_m = over(&way[begin..]).map_or(way[begin], |[from_m, _]| from_m);
        let moved_m = way[begin + 1..].iter().map(|place_m| place_m.distance(held_m)).fold(0.0, f64::max);
        return Meeting::Held { moved_m };
    }
    let Some(Deepest { depth_m, rest_m }) = shape.deepest(&way, tip.radius_m) else { return Meeting::Beside };
    let depth_m = depth_m + tip.shape.height_m(tip.radius_m);
    let disc = Disc::in_middle(laws.model, tip.radius_m).follow(laws.model, rest_m);
    if depth_m <= 0.0 {
        return Meeting::Above { gap_m: -depth_m };
    }
    let by_law_n = laws.under(disc).map(|law| law.at_depth(depth_m).force_n);
    match tip.coupling {
        // A sphere meets the tissue with a part of the disc.
        Coupling::Constraint => {
            Meeting::Pressed { depth_m, force_n: by_law_n, is_bound: tip.shape == TipShape::Sphere }
        }
        Coupling::Spring { stiffness_n_per_m, .. } => {
            let force_n = by_law_n.map(|force_n| force_n.min(stiffness_n_per_m * depth_m));
            Meeting::Pressed { depth_m, force_n, is_bound: true }
        }
    }
}

/// Returns the largest force of a profile on all points together, N.
fn total_n(shape: &dyn RestShape, profile: &LoadProfile) -> f64 {
    let weights = weights(shape, profile.centre.begins_at_m(), profile.falloff_per_m);
    largest_n(profile).length() * libm::exp(profile.falloff_offset) * weights
}

/// Returns the largest force of a profile, N.
fn largest_n(profile: &LoadProfile) -> DVec3 {
    let larger = |a: DVec3, b: DVec3| if b.length() > a.length() { b } else { a };
    match &profile.strength {
        StrengthProfile::Scaled(force_n, _) => *force_n,
        StrengthProfile::Recorded(rows) => rows.iter().map(|row| row.1).fold(DVec3::ZERO, larger),
    }
}

/// Returns the shorter side, m; of a sheet in its plane.
fn shorter_m(size_m: DVec3) -> f64 {
    let side_m = size_m.x.min(size_m.y);
    if size_m.z > 0.0 { side_m.min(size_m.z) } else { side_m }
}

/// Formats a value with three significant digits.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn rounded(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return value.to_string();
    }
    if !(1e-4..1e7).contains(&value.abs()) {
        return format!("{value:.2e}");
    }
    let decimals = (2.0 - value.abs().log10().floor()).max(0.0) as usize;
    let text = format!("{value:.decimals$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

/// Formats a corner of the tissue's box, m, to tenths of a millimetre, as an exercise has places.
fn corner(place_m: DVec3) -> String {
    // One zero: + 0.0 removes the sign of −0.
    let [x, y, z] = place_m.to_array().map(|value_m| (1e4 * value_m).round() / 1e4 + 0.0);
    format!("[{x}, {y}, {z}]")
}

/// Formats a length, in mm if it is less than 0.1 m.
fn length(length_m: f64) -> String {
    if length_m < 0.1 { format!("{} mm", rounded(1e3 * length_m)) } else { format!("{} m", rounded(length_m)) }
}

impl fmt::Display for Meeting {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Meeting::Unused => write!(f, "is not used: its first pose is later than the end of the script"),
            Meeting::Beside => write!(f, "never meets the tissue: it is beside it all the time"),
            Meeting::Above { gap_m } => {
                write!(f, "never meets the tissue: it stays {} away", length(gap_m))
            }
            Meeting::Pressed { depth_m, force_n, is_bound } => {
                let (most, about) = if is_bound { ("at most ", "at most") } else { ("", "about") };
                write!(f, "presses the tissue in by {most}{}, with ", length(depth_m))?;
                match force_n {
                    Some(force_n) => write!(f, "{about} {} N", rounded(force_n)),
                    None => write!(f, "an unknown force: its force law takes too much work"),
                }
            }
            Meeting::Held { moved_m } => write!(f, "grasps the tissue, and moves it by {}", length(moved_m)),
        }
    }
}

impl fmt::Display for Prospect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let size_m = self.extent.size_m();
        let sides_m = size_m.to_array();
        let sides_m = if size_m.z > 0.0 { &sides_m[..] } else { &sides_m[..2] };
        let sides = |factor: f64, unit: &str| {
            let sides: Vec<String> =
                sides_m.iter().map(|side_m| format!("{} {unit}", rounded(factor * side_m))).collect();
            sides.join(" × ")
        };
        let mass = if self.mass_kg < 1.0 {
            format!("{} g", rounded(1e3 * self.mass_kg))
        } else {
            format!("{} kg", rounded(self.mass_kg))
        };
        write!(f, "size          {}", sides(1.0, "m"))?;
        if shorter_m(size_m) < 0.1 {
            write!(f, " ({})", sides(1e3, "mm"))?;
        }
        writeln!(f, ", {mass} in all")?;
        let [least, most] = [self.extent.least_m, self.extent.most_m].map(corner);
        writeln!(f, "extent        from {least} to {most}, x, y and z in m")?;
        let radius = length(self.radius_m);
        match (self.stiffness_n_per_m(), &self.law) {
            (Some(stiffness), Some(law)) => {
                let stiffness = rounded(stiffness);
                writeln!(
                    f,
                    "fingertip     {stiffness} N/m where a disc of {radius} radius begins to press, in the middle"
                )?;
                let force = rounded(law.at_depth(self.deepest_m).force_n);
                let why = if self.is_by_law { "as far as its force law reaches" } else { "half the shorter side" };
                writeln!(f, "deepest       {} at {force} N: {why}", length(self.deepest_m))?;
            }
            _ => writeln!(f, "fingertip     unknown under a disc of {radius} radius: {}", self.no_law)?,
        }
        if let Some(error) = self.cells {
            writeln!(
                f,
                "cells         add {:.1} % to the stiffness there (an estimate, by cells of {}); the tolerance is that of stepping \
                 alone",
                100.0 * error.relative,
                length(error.compared_cell_m)
            )?;
        }
        match self.rest_s {
            Ok(rest_s) => {
                writeln!(f, "rest          {} s until the slowest vibration has decayed to 1 %", rounded(rest_s))?;
            }
            Err(why) => writeln!(f, "rest          {why}")?,
        }
        for (index, force) in self.forces.iter().enumerate().take(MAX_SHOWN) {
            let about = if sides_m.len() > 2 { "at most about" } else { "about" };
            let depth = force
                .depth_m
                .map_or(format!("unknown, {}", self.no_law), |depth_m| format!("{about} {}", length(depth_m)));
            let name = format!("force[{index}]");
            writeln!(f, "{name:<13} {} N in all at most; depth: {depth}", rounded(force.total_n))?;
        }
        if self.forces.len() > MAX_SHOWN {
            writeln!(f, "              … and {} more forces", self.forces.len() - MAX_SHOWN)?;
        }
        for TipUse { tool, meeting } in self.tips.iter().take(MAX_SHOWN) {
            let name = format!("tool {tool}");
            writeln!(f, "{name:<13} {meeting}")?;
        }
        if self.tips.len() > MAX_SHOWN {
            writeln!(f, "              … and {} more tools", self.tips.len() - MAX_SHOWN)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::path::Path;

    use super::*;
    use palpate_tissue::limits::Limits;
    use palpate_tissue::scene::Scene;

    /// A soft sheet of 20 mm × 40 mm on which a fingertip fits.
    const SOFT: [&str; 4] = [
        "sheet.points=[9, 17]",
        "sheet.spacing_m=0.0025",
        "sheet.point_mass_kg=6.6e-5",
        "damping.coefficient_n_s_per_m=0.02",
    ];

    fn prospect(more: &[&str], script: &str) -> Prospect {
        let model = Model::parse("paper", palpate_tissue::scene::PAPER, &[&SOFT[..], more].concat()).unwrap();
        let script = Script::parse("test", script, Path::new(""), &model.scene, &Limits::default());
        Prospect::new(&model, script.ok().as_ref())
    }

    #[test]
    fn a_tissue_that_can_be_meant_is_described_without_a_warning() {
        let found = prospect(&[], "");
        assert_eq!(found.warnings, [""; 0]);
        let text = found.to_string();
        assert!(text.contains("0.02 m × 0.04 m (20 mm × 40 mm), 10.1 g in all"), "{text}");
        // 2m/C is 6.6 ms, below the critical damping; ln 100 times that.
        assert!(text.contains("0.0304 s until the slowest vibration"), "{text}");
        // Half of 20 mm, within the law's reach of 4 radii.
        assert!(text.contains("deepest       10 mm at ") && text.contains(" N: half the shorter side"), "{text}");
        let stiffness = found.stiffness_n_per_m().unwrap();
        // Some twelve points share a disc of 5 mm, each on an anchor spring of 5 N/m.
        assert!((50.0..80.0).contains(&stiffness), "{stiffness} N/m");
    }

    #[test]
    fn what_can_not_be_meant_is_named() {
        for (set, named) in [
            ("sheet.spacing_m=2.5", "is 40 m long, more than 10 m"),
            ("sheet.point_mass_kg=66.0", "a point weighs 66 kg"),
            ("sheet.spacing_m=0.006", "the points are 6 mm apart, more than a fingertip's radius (5 mm)"),
            ("sheet.spacing_m=0.001", "a fingertip, 10 mm across, is wider than the sheet"),
            ("anchor_springs.stiffness_n_per_m=1e5", "N/m, not from 0.1 to 100000"),
            ("damping.coefficient_n_s_per_m=1e-6", "s to come to rest, more than 60 s"),
        ] {
            // No search for the error is needed here.
            let found = prospect(&[set, "stepping.substeps=8"], "").warnings;
            assert!(found.iter().any(|warning| warning.contains(named)), "{set}: {found:?}");
        }
    }

    /// A script of one second with these tools on the soft sheet.
    fn tools(model: &Model, tools: &[&str]) -> Script {
        let tools: String = tools.iter().map(|tool| format!("[[tool]]\n{tool}\n")).collect();
        let text = format!("duration_s = 1.0\nsample_every_s = 0.1\n{tools}");
        Script::parse("test", &text, Path::new(""), &model.scene, &Limits::default()).unwrap()
    }

    /// From 2 mm above the middle to 4 mm below.
    const PRESS: &str =
        "poses = [{ at_s = 0.0, place_m = [0.01, 0.02, 0.002] }, { at_s = 0.5, place_m = [0.01, 0.02, -0.004] }]\n";

    #[test]
    fn a_tip_presses_as_deep_as_its_lowest_place_over_the_tissue() {
        let model = Model::parse("paper", palpate_tissue::scene::PAPER, &SOFT).unwrap();
        let spring = PRESS.to_owned() + "tip = { spring = { stiffness_n_per_m = 5.0, damping_n_s_per_m = 0.0 } }";
        let half_way = PRESS.to_owned() + "until_s = 0.25";
        // The sheet is 20 mm wide: this tool leaves it at half of its depth.
        let across = "tip = { radius_m = 0.005 }\nposes = [{ at_s = 0.0, place_m = [-0.005, 0.02, 0.0] }, \
                      { at_s = 0.5, place_m = [0.055, 0.02, -0.01] }]";
        let grasp = "tip = { grasps = true }\nposes = [{ at_s = 0.0, place_m = [0.01, 0.02, 0.003] }, \
                     { at_s = 0.5, place_m = [0.01, 0.02, 0.007] }]";
        let script = tools(&model, &[PRESS, &spring, &half_way, across, grasp]);
        let mut laws = Laws { model: &model, known: Vec::new() };
        let [press, spring, half_way, across, grasp] = tips(model.shape(), &script, &mut laws).try_into().unwrap();
        assert_eq!([press.tool, spring.tool, half_way.tool, across.tool, grasp.tool], [0, 1, 2, 3, 4]);
        let pressed = |tip: &TipUse| match tip.meeting {
            Meeting::Pressed { depth_m, force_n, .. } => [depth_m, force_n.unwrap()],
            other => panic!("{other:?}"),
        };
        // By 50 to 80 N/m, and more where it goes deeper.
        let [depth_m, force_n] = pressed(&press);
        assert!((depth_m - 0.004).abs() < 1e-12 && (0.2..0.5).contains(&force_n), "{press:?}");
        assert!(press.meeting.to_string().starts_with("presses the tissue in by 4 mm, with about 0."), "{press:?}");
        // A soft spring bears at most 5 N/m times 4 mm.
        assert_eq!(spring.meeting.to_string(), "presses the tissue in by at most 4 mm, with at most 0.02 N");
        // It is removed in the middle of its path.
        assert!((pressed(&half_way)[0] - 0.001).abs() < 1e-12, "{half_way:?}");
        assert!((pressed(&across)[0] - 0.005).abs() < 1e-12, "{across:?}");
        // A grasp takes hold wherever it is over the tissue.
        assert_eq!(grasp.meeting.to_string(), "grasps the tissue, and moves it by 4 mm");
    }

    #[test]
    fn a_tip_that_never_meets_the_tissue_or_goes_through_is_warned_of() {
        let poses =
            |at_s: f64, x_m: f64, z_m: f64| format!("poses = [{{ at_s = {at_s:?}, place_m = [{x_m}, 0.02, {z_m}] }}]");
        let wrong =
            [poses(0.0, 0.01, 0.003), poses(0.0, 0.03, -0.003), poses(1.5, 0.01, -0.003), poses(0.0, 0.01, -0.06)];
        let model = Model::parse("paper", palpate_tissue::scene::PAPER, &SOFT).unwrap();
        let script = tools(&model, &[&wrong[0], &wrong[1], &wrong[2], &wrong[3], PRESS]);
        let found = Prospect::new(&model, Some(&script));
        let expected = [
            "tool 0 never meets the tissue: it stays 3 mm away",
            "tool 1 never meets the tissue: it is beside it all the time",
            "tool 2 is not used: its first pose is later than the end of the script",
            "tool 3 goes 60 mm deep, more than the tissue's longest side: it goes through",
        ];
        assert_eq!(found.warnings, expected);
        let text = found.to_string();
        assert!(text.contains("\ntool 0        never meets the tissue: "), "{text}");
        assert!(text.contains("\ntool 4        presses the tissue in by 4 mm, with about "), "{text}");
    }

    #[test]
    fn a_force_that_goes_through_the_tissue_is_named_with_its_depth() {
        let script = |force_n: f64| {
            format!(
                "duration_s = 0.1\nsample_every_s = 0.1\n[[force]]\npoint = [4, 8]\nforce_n = [0.0, 0.0, -{force_n:?}]\n\
                 falloff_per_m = 300.0\nfalloff_offset = 0.0\nprofile = {{ type = \"constant\" }}\n"
            )
        };
        let (gentle, rough) = (prospect(&[], &script(0.02)), prospect(&[], &script(100.0)));
        assert_eq!(gentle.warnings, [""; 0]);
        assert!(gentle.to_string().contains("force[0]"), "{gentle}");
        let [warning] = rough.warnings.as_slice() else { panic!("{:?}", rough.warnings) };
        assert!(warning.starts_with("force[0]: ") && warning.ends_with("it goes through"), "{warning}");
        // A linear model of that press: depth and force have the stiffness of the disc between them.
        let Force { total_n, depth_m, .. } = gentle.forces[0];
        let stiffness = total_n / depth_m.unwrap();
        assert!((30.0..120.0).contains(&stiffness), "{stiffness} N/m");
        // On a mesh the depth is a bound; on a sheet it is an estimate.
        let told = format!("depth: about {}", length(depth_m.unwrap()));
        assert!(gentle.to_string().contains(&told), "{told}: {gentle}");
    }

    #[test]
    fn a_force_is_summed_over_all_points_and_only_some_of_many_forces_are_shown() {
        let force = "[[force]]\npoint = [4, 8]\nforce_n = [0.0, 0.003, -0.004]\nfalloff_per_m = 300.0\n\
                     falloff_offset = 0.3\nprofile = { type = \"constant\" }\n";
        let of =
            |count: usize| prospect(&[], &format!("duration_s = 0.1\nsample_every_s = 0.1\n{}", force.repeat(count)));
        let found = of(MAX_SHOWN);
        let place_m = |i: usize, j: usize| 0.0025 * DVec3::new(i as f64, j as f64, 0.0);
        let points = (0..9).flat_map(|i| (0..17).map(move |j| place_m(i, j)));
        let total_n: f64 = points.map(|point| 0.005 * (0.3 - 300.0 * point.distance(place_m(4, 8))).exp()).sum();
        assert!((found.forces[0].total_n - total_n).abs() < 1e-9 * total_n, "{:?}, not {total_n}", found.forces[0]);
        let last = format!("force[{}]", MAX_SHOWN - 1);
        let shown = found.to_string();
        assert!(shown.contains(&last) && !shown.contains("more forces"), "{shown}");
        let shown = of(MAX_SHOWN + 2).to_string();
        assert!(shown.contains(&last) && shown.contains("… and 2 more forces"), "{shown}");
        assert!(!shown.contains(&format!("force[{MAX_SHOWN}]")), "{shown}");
    }

    #[test]
    fn a_force_that_goes_through_a_mesh_is_named_with_how_thick_it_is_there() {
        let text = "[mesh]\norgan = { name = \"gallbladder\", edge_m = 0.0035 }\n[material]\nyoungs_modulus_pa = 2e4\n\
                    thickness_m = 0.003\nfoundation_n_per_m3 = 5e5\n[stepping]\nsubsteps = 8\n";
        let scene = Scene::parse("test", text, &[], &Limits::default()).unwrap();
        let model = Model::compile(&scene, &Limits::default()).unwrap();
        let mesh = model.scene.mesh().unwrap();
        let point = mesh.shape.nearest(DVec3::new(0.02, 0.0, -0.05));
        let (at_m, force_n) = (mesh.shape.rest_m(point), -100.0 * mesh.shape.normal(point));
        let script = format!(
            "duration_s = 0.1\nsample_every_s = 0.1\n[[force]]\nat_m = {:?}\nforce_n = {:?}\nfalloff_per_m = 200.0\n\
             falloff_offset = 0.0\nprofile = {{ type = \"constant\" }}\n",
            at_m.to_array(),
            force_n.to_array()
        );
        let script = Script::parse("test", &script, Path::new(""), &model.scene, &Limits::default()).unwrap();
        let warnings = Prospect::new(&model, Some(&script)).warnings;
        let thick = length(mesh.thickness_m(point).unwrap());
        let named = format!("more than the {thick} that it is thick there: it goes through");
        assert!(warnings.iter().any(|warning| warning.ends_with(&named)), "{named}: {warnings:?}");
    }
}
