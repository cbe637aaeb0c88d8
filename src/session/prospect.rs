//! What a user should know of a tissue before anybody touches it: its size and mass, how a fingertip meets it, when it comes
//! to rest, and what of a scene or a script can't be meant.

use std::fmt;
use std::sync::atomic::AtomicBool;

use glam::DVec3;
use palpate_touch::{Law, Tip};

use crate::force_law;
use crate::scene::profile::{LoadProfile, StrengthProfile, weights};
use crate::scene::script::Script;
use crate::shape::RestShape;
use crate::sheet::Model;
use crate::sheet::integrate::Oscillator;

/// Bounds of what can be meant. Beyond them a unit is probably wrong.
const LONGEST_SIDE_M: f64 = 10.0;
const HEAVIEST_POINT_KG: f64 = 0.1;
const LONGEST_REST_S: f64 = 60.0;
/// Under a fingertip, N/m: from what nobody feels to bone.
const STIFFNESS_N_PER_M: [f64; 2] = [0.1, 1e5];

/// Vibrations are at rest when they have decayed to this part.
const AT_REST: f64 = 0.01;

/// Forces of a script that are shown.
const MOST_SHOWN: usize = 8;

/// What to expect of a tissue.
#[derive(Debug)]
pub(super) struct Prospect {
    size_m: DVec3,
    mass_kg: f64,
    radius_m: f64,
    /// The law under a fingertip in the middle; `None` if it takes too much work.
    law: Option<Law>,
    /// The deepest sensible press by a fingertip, m: half the shorter side, or as far as the law reaches.
    deepest_m: f64,
    is_by_law: bool,
    /// Time to rest, s, or why there is none.
    rest_s: Result<f64, &'static str>,
    forces: Vec<Force>,
    /// What can't be meant, in words.
    pub(super) warnings: Vec<String>,
}

/// A force of a script.
#[derive(Debug)]
struct Force {
    /// At its largest, of all points together, N.
    total_n: f64,
    /// How deep it goes, m; `None` if the law takes too much work.
    depth_m: Option<f64>,
}

impl Prospect {
    /// Of a tissue, and of a script on it.
    pub(super) fn new(model: &Model, script: Option<&Script>) -> Self {
        let (shape, sheet) = (model.shape(), Oscillator::of(&model.scene));
        let size_m = shape.extent().size_m();
        let radius_m = Tip::default().radius_m;
        let law = law(model, radius_m);
        let half_m = 0.5 * size_m.x.min(size_m.y);
        let reach_m = law.as_ref().map_or(f64::INFINITY, Law::reach_m);
        #[allow(clippy::cast_precision_loss)]
        let mass_kg = sheet.mass_kg * shape.point_count() as f64;
        let mut prospect = Prospect {
            size_m,
            mass_kg,
            radius_m,
            law,
            deepest_m: half_m.min(reach_m),
            is_by_law: reach_m < half_m,
            rest_s: rest_s(&sheet),
            forces: script.map_or(Vec::new(), |script| forces(model, script)),
            warnings: Vec::new(),
        };
        prospect.warnings = prospect.doubts(shape, sheet.mass_kg);
        prospect
    }

    /// The stiffness that a fingertip meets where it begins to press, N/m.
    fn stiffness_n_per_m(&self) -> Option<f64> {
        self.law.as_ref().map(|law| law.at_depth(0.0).stiffness_n_per_m)
    }

    fn doubts(&self, shape: &dyn RestShape, point_mass_kg: f64) -> Vec<String> {
        let mut doubts = Vec::new();
        let (longest_m, edge_m) = (shape.longest_side_m(), shape.edge_m());
        if longest_m > LONGEST_SIDE_M {
            let most = rounded(LONGEST_SIDE_M);
            doubts
                .push(format!("the sheet is {} long, more than {most} m: sheet.spacing_m is in m", length(longest_m)));
        }
        if point_mass_kg > HEAVIEST_POINT_KG {
            let (mass, most) = (rounded(point_mass_kg), rounded(HEAVIEST_POINT_KG));
            doubts.push(format!("a point weighs {mass} kg, more than {most} kg: sheet.point_mass_kg is in kg"));
        }
        if edge_m > self.radius_m {
            let (edge, radius) = (length(edge_m), length(self.radius_m));
            doubts.push(format!(
                "the points are {edge} apart, more than a fingertip's radius ({radius}): a disc of that size acts as if it \
                 were larger"
            ));
        }
        if self.size_m.x.min(self.size_m.y) < 2.0 * self.radius_m {
            doubts.push(format!("a fingertip, {} across, is wider than the sheet", length(2.0 * self.radius_m)));
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
            if let Some(depth_m) = force.depth_m.filter(|depth_m| *depth_m > longest_m) {
                doubts.push(format!(
                    "force[{index}]: {} N would push the tissue in by {}, more than its longest side: it goes through",
                    rounded(force.total_n),
                    length(depth_m)
                ));
            }
        }
        doubts
    }
}

/// The first law under a disc in the middle, coarse where the exact one takes too much work.
fn law(model: &Model, radius_m: f64) -> Option<Law> {
    force_law::first(model, radius_m, &AtomicBool::new(false)).filter(Law::is_sound)
}

/// When the slowest vibration has decayed to [`AT_REST`], s. That is the one of all points together straight out of the sheet:
/// springs at rest do not pull there, only virtual springs do.
fn rest_s(sheet: &Oscillator) -> Result<f64, &'static str> {
    let Oscillator { mass_kg, damping_n_s_per_m, virtual_stiffness_n_per_m, .. } = *sheet;
    if damping_n_s_per_m <= 0.0 {
        return Err("never: there is no damping");
    }
    if virtual_stiffness_n_per_m <= 0.0 {
        return Err("unknown: without virtual springs nothing but fixed points pulls the tissue back");
    }
    let (decay_per_s, square) = (0.5 * damping_n_s_per_m / mass_kg, virtual_stiffness_n_per_m / mass_kg);
    // Beyond the critical damping the tissue creeps back.
    let beyond = decay_per_s * decay_per_s - square;
    let slowest_per_s = if beyond > 0.0 { square / (decay_per_s + beyond.sqrt()) } else { decay_per_s };
    Ok(-AT_REST.ln() / slowest_per_s)
}

/// How deep each force of a script goes: as a disc that presses with all of the force, its area that of the falloff, in the
/// middle of the sheet; beyond the law's reach straight on.
fn forces(model: &Model, script: &Script) -> Vec<Force> {
    let shape = model.shape();
    let mut laws: Vec<(f64, Option<Law>)> = Vec::new();
    let force = |profile: &LoadProfile| {
        let total_n = total_n(shape, profile);
        let widest_m = 0.5 * shape.longest_side_m();
        // ∫ exp(−c·r) over the plane is the area of a disc of this radius.
        let radius_m = (std::f64::consts::SQRT_2 / profile.falloff_per_m).clamp(0.5 * shape.edge_m(), widest_m);
        if !laws.iter().any(|known| known.0 == radius_m) {
            laws.push((radius_m, law(model, radius_m)));
        }
        let law = laws.iter().find(|known| known.0 == radius_m).and_then(|known| known.1.as_ref());
        Force { total_n, depth_m: law.map(|law| law.depth_of(total_n)) }
    };
    script.forces.iter().map(force).collect()
}

/// The largest force of a profile on all points together, N.
fn total_n(shape: &dyn RestShape, profile: &LoadProfile) -> f64 {
    let largest_n = match &profile.strength {
        StrengthProfile::Scaled(force_n, _) => force_n.length(),
        StrengthProfile::Recorded(rows) => rows.iter().map(|row| row.1.length()).fold(0.0, f64::max),
    };
    let weights = weights(shape, profile.centre.begins_at_m(), profile.falloff_per_m);
    largest_n * libm::exp(profile.falloff_offset) * weights
}

/// Three significant digits.
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

/// In mm if it is less than 0.1 m.
fn length(length_m: f64) -> String {
    if length_m < 0.1 { format!("{} mm", rounded(1e3 * length_m)) } else { format!("{} m", rounded(length_m)) }
}

impl fmt::Display for Prospect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (x_m, y_m) = (self.size_m.x, self.size_m.y);
        let mass = if self.mass_kg < 1.0 {
            format!("{} g", rounded(1e3 * self.mass_kg))
        } else {
            format!("{} kg", rounded(self.mass_kg))
        };
        write!(f, "size          {} m × {} m", rounded(x_m), rounded(y_m))?;
        if x_m.min(y_m) < 0.1 {
            write!(f, " ({} mm × {} mm)", rounded(1e3 * x_m), rounded(1e3 * y_m))?;
        }
        writeln!(f, ", {mass} in all")?;
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
            _ => writeln!(f, "fingertip     unknown: the force law of a disc of {radius} radius takes too much work")?,
        }
        match self.rest_s {
            Ok(rest_s) => {
                writeln!(f, "rest          {} s until the slowest vibration has decayed to 1 %", rounded(rest_s))?;
            }
            Err(why) => writeln!(f, "rest          {why}")?,
        }
        for (index, force) in self.forces.iter().enumerate().take(MOST_SHOWN) {
            let depth = force.depth_m.map_or("unknown, its force law takes too much work".to_owned(), |depth_m| {
                format!("about {}", length(depth_m))
            });
            let name = format!("force[{index}]");
            writeln!(f, "{name:<13} {} N in all at most; depth: {depth}", rounded(force.total_n))?;
        }
        if self.forces.len() > MOST_SHOWN {
            writeln!(f, "              … and {} more forces", self.forces.len() - MOST_SHOWN)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::path::Path;

    use super::*;
    use crate::limits::Limits;

    /// A soft sheet of 20 mm × 40 mm that a fingertip fits.
    const SOFT: [&str; 4] = [
        "sheet.points=[9, 17]",
        "sheet.spacing_m=0.0025",
        "sheet.point_mass_kg=6.6e-5",
        "damping.coefficient_n_s_per_m=0.02",
    ];

    fn prospect(more: &[&str], script: &str) -> Prospect {
        let model = Model::paper(&[&SOFT[..], more].concat());
        let script = Script::parse("test", script, Path::new(""), &model.scene, &Limits::default());
        Prospect::new(&model, script.ok().as_ref())
    }

    #[test]
    fn a_tissue_that_can_be_meant_is_described_without_a_warning() {
        let found = prospect(&[], "");
        assert_eq!(found.warnings, [""; 0]);
        let text = found.to_string();
        assert!(text.contains("0.02 m × 0.04 m (20 mm × 40 mm), 10.1 g in all"), "{text}");
        // 2m/C is 6.6 ms, below the critical damping; ln 100 of these.
        assert!(text.contains("0.0304 s until the slowest vibration"), "{text}");
        // Half of 20 mm, which the law, of 4 radii, covers.
        assert!(text.contains("deepest       10 mm at ") && text.contains(" N: half the shorter side"), "{text}");
        let stiffness = found.stiffness_n_per_m().unwrap();
        // Some twelve points share a disc of 5 mm, each on a virtual spring of 5 N/m.
        assert!((50.0..80.0).contains(&stiffness), "{stiffness} N/m");
    }

    #[test]
    fn what_creeps_back_takes_longer_and_what_nothing_damps_never_rests() {
        let sheet = |damping_n_s_per_m: f64, virtual_stiffness_n_per_m: f64| {
            let scene = &Model::paper(&[]).scene;
            Oscillator { mass_kg: 1.0, damping_n_s_per_m, virtual_stiffness_n_per_m, ..Oscillator::of(scene) }
        };
        // The slower of the roots of s² + 10 s + 9 is −1.
        assert!((rest_s(&sheet(10.0, 9.0)).unwrap() - 100.0_f64.ln()).abs() < 1e-9);
        assert!((rest_s(&sheet(2.0, 9.0)).unwrap() - 100.0_f64.ln()).abs() < 1e-9);
        assert!(rest_s(&sheet(0.0, 9.0)).unwrap_err().starts_with("never"));
        assert!(rest_s(&sheet(1.0, 0.0)).unwrap_err().starts_with("unknown"));
    }

    #[test]
    fn what_can_not_be_meant_is_named() {
        for (set, named) in [
            ("sheet.spacing_m=2.5", "is 40 m long, more than 10 m"),
            ("sheet.point_mass_kg=66.0", "a point weighs 66 kg"),
            ("sheet.spacing_m=0.006", "the points are 6 mm apart, more than a fingertip's radius (5 mm)"),
            ("sheet.spacing_m=0.001", "a fingertip, 10 mm across, is wider than the sheet"),
            ("virtual_springs.stiffness_n_per_m=1e5", "N/m, not from 0.1 to 100000"),
            ("damping.coefficient_n_s_per_m=1e-6", "s to come to rest, more than 60 s"),
        ] {
            // Nobody looks for the error of these.
            let found = prospect(&[set, "stepping.substeps=8"], "").warnings;
            assert!(found.iter().any(|warning| warning.contains(named)), "{set}: {found:?}");
        }
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
        // The linear model of the same: depth and force have the stiffness of the disc between them.
        let Force { total_n, depth_m } = gentle.forces[0];
        let stiffness = total_n / depth_m.unwrap();
        assert!((30.0..120.0).contains(&stiffness), "{stiffness} N/m");
    }
}
