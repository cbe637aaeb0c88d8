//! From which pressure on a lump below the surface is felt: two presses of the tissue's own, one over the lump and one beside it.
//!
//! A fingertip goes in at the same speed in both. A difference of two forces is noticed if it is large enough against the force: people
//! tell 7 % of 2.5 to 10 N apart (Pang, Tan and Durlach 1991, Manual discrimination of force using active finger motion, Perception &
//! Psychophysics 49), and 15 % of Young's modulus by a finger (Bergmann Tiest and Kappers 2009, doi:10.1109/TOH.2009.16). The fraction of
//! force here is between both. Of weak forces the fraction grows (Wu et al. 2014, doi:10.1177/0018720814551414, below 0.5 N): the
//! difference must also have a least size, which is ours.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use glam::DVec3;
use palpate_haptics::TipShape;
use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::memory;
use palpate_tissue::scene::exercise::{FeltLump, Lump};

use super::chosen_exercise::ChosenExercise;
use super::press::{ImposedPress, on_surface};
use super::simulation::SimulationFailure;

/// The difference that is noticed, as a part of the force beside the lump, and at least, N.
const NOTICED_PART: f64 = 0.1;
const MIN_NOTICED_N: f64 = 0.05;

/// How fast the tip goes in, m/s, and how deep at most, in radii of the tip.
const SPEED_M_PER_S: f64 = 0.01;
const DEEPEST_RADII: f64 = 1.5;

/// Number of samples of a press.
const SAMPLES: u32 = 96;

/// Returns an exercise with the pressure from which on the lump of its `[coverage]` is felt in the tissue of a model: at once if it has no
/// such lump, or knows the pressure.
///
/// # Errors
/// Refuses what [`felt_from`] refuses.
pub fn with_noticed_pressure(
    chosen: ChosenExercise,
    model: &Model,
    limits: &Limits,
    stop: &AtomicBool,
) -> Result<ChosenExercise> {
    let Some(lump) = chosen.lump_to_press() else { return Ok(chosen) };
    let place = || Some(format!("exercise {}", chosen.exercise.name));
    let found = memory::attempt("", || felt_from(model, lump, limits, stop));
    let pressure_pa = found.map_err(|refusal| Refusal { place: place(), ..refusal })?;
    Ok(ChosenExercise { noticed_pressure_pa: Some(pressure_pa), ..chosen })
}

/// Presses the tissue of a model, without its inclusions, over a lump and without it, at the place that stands for the tissue. Returns the
/// mean pressure under the tip, beside the lump, from which on the forces differ by what is noticed, Pa. The same model and limits give the
/// same bits.
///
/// # Errors
/// Refuses a tissue that can have no such lump, a lump that no press feels, presses that take more than `limits.press_work`, and a tissue that
/// fails under them, with the field `coverage.lump`; and ends with [`Reason::TimedOut`] when `stop` is set.
pub fn felt_from(model: &Model, lump: &FeltLump, limits: &Limits, stop: &AtomicBool) -> Result<f64> {
    let refuse = |reason, message: String| Refusal::new(reason, "coverage.lump", message);
    let scene = model.scene.without_inclusions()?;
    let plain = Model::compile_until(&scene, limits, stop)?;
    let radius_m = lump.tip_radius_m;
    let (place_m, outward) = on_surface(&plain, None, radius_m);
    let centre_m: DVec3 = place_m - (lump.depth_m + lump.radius_m) * outward;
    let hidden = Lump { centre_m, radius_m: lump.radius_m, stiffness_factor: lump.stiffness_factor };
    let with_lump = scene.with_lump(&hidden).map_err(|refusal| refuse(refusal.reason, refusal.message))?;
    let press = press(radius_m, plain.shape().takes_rigid_tips());
    let of_step = (plain.swept_points() as u64).saturating_mul(u64::from(plain.plan.substeps));
    let (work, most) = (press.steps(&plain).saturating_mul(2).saturating_mul(of_step), limits.press_work);
    if work > most {
        let message = format!(
            "takes two presses of {work} points times substeps, above the limit of {most} (limits.press_work): give \
             `pressure_pa` instead"
        );
        return Err(refuse(Reason::TooLarge, message));
    }
    // The same scheme: forces then differ by the lump alone.
    let lumped = plain.compile_alike(&with_lump, plain.plan.substeps, limits)?;
    let forces_n = |model: &Arc<Model>| match press.forces_n(model, limits, stop) {
        Ok(forces_n) => Ok(forces_n),
        Err(SimulationFailure::Refused(refusal)) => Err(refusal),
        Err(_) => {
            Err(refuse(Reason::OutOfRange, "a press fails in this tissue: give `pressure_pa` instead".to_owned()))
        }
    };
    let (beside_n, over_n) = (forces_n(&plain)?, forces_n(&lumped)?);
    let area_m2 = std::f64::consts::PI * radius_m * radius_m;
    noticed_force_n(&beside_n, &over_n).map(|force_n| force_n / area_m2).ok_or_else(|| {
        let (depth_m, force_n) = (1e3 * DEEPEST_RADII * radius_m, beside_n.last().copied().unwrap_or_default());
        let message = format!("is not felt by a tip that is {depth_m:.1} mm deep in, with {force_n:.2} N");
        refuse(Reason::OutOfRange, message)
    })
}

fn press(radius_m: f64, is_rigid: bool) -> ImposedPress {
    let part = |index: u32| f64::from(index) / f64::from(SAMPLES);
    let deepest_m = DEEPEST_RADII * radius_m;
    ImposedPress {
        place_m: None,
        shape: if is_rigid { TipShape::Sphere } else { TipShape::Disc },
        radius_m,
        time_s: (0..=SAMPLES).map(|index| part(index) * deepest_m / SPEED_M_PER_S).collect(),
        depth_m: (0..=SAMPLES).map(|index| part(index) * deepest_m).collect(),
    }
}

/// Returns the force beside the lump from which on the forces of two presses differ by what is noticed, N; `None` if they never do.
fn noticed_force_n(beside_n: &[f64], over_n: &[f64]) -> Option<f64> {
    // Above 0: it is noticed.
    let beyond_n = |index: usize| {
        let noticed_n = (NOTICED_PART * beside_n[index]).max(MIN_NOTICED_N);
        (over_n[index] - beside_n[index]).abs() - noticed_n
    };
    // At the first sample the tip only touches.
    let first = (1..beside_n.len()).find(|index| beyond_n(*index) >= 0.0)?;
    let before = first - 1;
    // Both are straight between two samples.
    let part = (beyond_n(before) / (beyond_n(before) - beyond_n(first))).max(0.0);
    let force_n = beside_n[before] + part * (beside_n[first] - beside_n[before]);
    (force_n > 0.0).then_some(force_n)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_difference_is_noticed_where_it_is_a_tenth_of_the_force_and_not_too_small() {
        let depth_m: Vec<f64> = (0..=100).map(|k| 1e-4 * f64::from(k)).collect();
        // 200 N/m beside the lump; over it 10 % more and 1e4 N/m² · d²: felt where that is 0.1·F, from 0.01·k·d = 1e4·d².
        let beside_n: Vec<f64> = depth_m.iter().map(|d| 200.0 * d).collect();
        let over_n: Vec<f64> = depth_m.iter().map(|d| 200.0 * d + 1e4 * d * d).collect();
        // 1e4·d² = 0.1·200·d at 2 mm, but 0.04 N are too little: 1e4·d² = 0.05 N at √5 mm.
        let felt_n = noticed_force_n(&beside_n, &over_n).unwrap();
        let expected_m = 1e-3 * 5.0_f64.sqrt();
        assert!((felt_n / (200.0 * expected_m) - 1.0).abs() < 1e-3, "{felt_n}");
        assert_eq!(noticed_force_n(&beside_n, &beside_n), None);
        // A softer lump is felt as well.
        let softer_n: Vec<f64> = beside_n.iter().map(|force_n| 0.8 * force_n).collect();
        let felt_n = noticed_force_n(&beside_n, &softer_n).unwrap();
        assert!((felt_n - 0.25).abs() < 1e-9, "{felt_n}");
    }

    #[test]
    fn a_deeper_lump_needs_more_pressure_and_one_like_the_tissue_is_refused() {
        let text = "[solid]\norgan = { name = \"phantom\", edge_m = 0.005, seed = 1 }\ncell_m = 0.005\n\
                    fixed = [{ plane_m = [0, 0, 0], normal = [0, 0, 1], within_m = 0.001 }]\n\
                    [material]\nyoungs_modulus_pa = 15e3\npoissons_ratio = 0.4\n";
        let model = Model::parse("block", text, &[]).unwrap();
        let felt = |depth_m: f64, stiffness_factor: f64| {
            let lump = FeltLump { radius_m: 0.009, depth_m, stiffness_factor, tip_radius_m: 0.008 };
            felt_from(&model, &lump, &Limits::default(), &AtomicBool::new(false))
        };
        let shallow = felt(0.003, 6.0).unwrap();
        assert_eq!(felt(0.003, 6.0).unwrap(), shallow);
        let deep = felt(0.008, 6.0).unwrap();
        println!("{shallow:?}\n{deep:?}");
        assert!(shallow > 0.0 && deep > 1.2 * shallow, "{shallow} {deep}");
        let refused = felt(0.003, 1.0).unwrap_err();
        assert!(refused.field == "coverage.lump" && refused.message.starts_with("is not felt"), "{refused}");
        // No cube is there.
        assert_eq!(felt(0.5, 6.0).unwrap_err().field, "coverage.lump");
    }
}
