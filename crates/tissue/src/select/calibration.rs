//! A rehearsal: it pushes a small tissue of a scene hard and measures the error of a scheme.
//!
//! The error of a scheme depends on the spectrum of the tissue, on its geometry once springs turn and stretch,
//! and on the rounding of a number format. A formula knows only the first: on random scenes its estimate was
//! between 0.04 and 10,000 times the true error. So the scheme itself runs, on at most [`SIDE`]² points for
//! half a second, under a few loads that are harder than most scripts ([`LOADS`]). The reference ("truth") is a
//! run in f64 with a substep so short that half of it changes nothing. The true error of a script on the whole
//! tissue is then at most a few times the rehearsed one ([`BodyKind::rehearsal_margin`](crate::scene::BodyKind); `make
//! bench-tolerance`, `tests/tolerance.rs`). Forces that change smoothly have errors 10 to 1000 times
//! smaller than those that jump, but a choice that is made before the script is known can't use that.

use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use glam::DVec3;

use crate::body::model::{Model, Plan};
use crate::kernel::lanes;
use crate::scene::profile::{CentreProfile, LoadProfile, Profile, StrengthProfile};
use crate::scene::{Integrator, Precision, Scene};
use crate::scheme::Oscillator;
use crate::scheme::stability;
use crate::shape::PointId;
use crate::state::tissue_state::at_rest;
use crate::tools::applied_force::Push;

/// Largest number of points along a side. Larger tissues have similar errors: a force spreads over some points.
const SIDE: usize = 12;

/// Length of a rehearsal, s. Rounding and phase errors grow with time where little damps them.
const COURSE_S: f64 = 0.5;

/// Smallest and largest number of steps of a rehearsal. The smallest applies to slow steps.
const STEPS: (f64, f64) = (40.0, 4000.0);

/// Largest number of substeps of a rehearsal with the longest stable substep: bounds the work for absurd
/// scenes.
const SUBSTEPS: f64 = 8000.0;

/// If each step needs more substeps than this to be stable, a rehearsal treats parts of steps as steps.
const SUBSTEPS_A_LOOK: u32 = 8;

/// Time over which undamped, growing errors are predicted, s.
pub(crate) const LASTING_S: f64 = 2.0;

/// Time after a jump of a force in which the error may be [`ALLOWANCE`] times the tolerance, s. A jump starts
/// the fastest vibrations, which no substep follows exactly and which are over before anybody feels them.
const SOON_S: f64 = 0.02;

/// Factor of the tolerance in the time [`SOON_S`] after a jump.
const ALLOWANCE: f64 = 10.0;

/// Largest number of substeps of the reference: bounds the work for absurd scenes and tolerances.
const MAX_SUBSTEPS: u64 = 400_000;

/// How many times the substep of the reference is halved at most.
const MAX_HALVINGS: u32 = 6;

/// Largest uncertainty of a reference, as a fraction of the largest value. If halving the substep still changes
/// more, neighbouring motions diverge, and no substep follows them.
const MAX_UNCERTAINTY: f64 = 0.1;

/// A force that pushes the small tissue, from its first step on.
struct CalibrationLoad {
    profile: Profile,
    /// Part of the course in which the load shows its errors.
    part: f64,
    /// c of the falloff, in 1/spacing.
    falloff: f64,
    /// The force, in (K″ + 0.3·k)·spacing: it moves a point by about as many spacings.
    force: DVec3,
}

/// A sharp force excites every vibration. Under a wide one, the springs' forces are small differences of large
/// displacements, which is where rounding shows; along the surface it makes folds, and rounding grows with
/// them. A force that oscillates as fast as in usual scripts shows how well a scheme follows a force.
const LOADS: [CalibrationLoad; 3] = [
    CalibrationLoad { profile: Profile::Constant, part: 1.0, falloff: 3.0, force: DVec3::new(0.3, 0.15, -0.37) },
    CalibrationLoad { profile: Profile::Constant, part: 1.0, falloff: 0.3, force: DVec3::new(0.2, 0.15, -0.05) },
    CalibrationLoad {
        profile: Profile::Sine { frequency_hz: 20.0 },
        part: 0.25,
        falloff: 1.0,
        force: DVec3::new(0.1, 0.06, -0.16),
    },
];

/// Fixed cost of a substep and of a step of a rehearsal, in points.
const SUBSTEP_POINTS: u64 = 32;
const STEP_POINTS: u64 = 500;

/// Displacement and reaction of the compared points, step by step.
type Trajectory = Vec<[[DVec3; 2]; 3]>;

/// The reference motion of the small tissue under a load.
struct Truth {
    course: Trajectory,
    /// Estimated error of the course if that is above the tolerance; otherwise 0.
    uncertainty: f64,
}

/// The small tissue and its reference motion.
pub(crate) struct Rehearsal<'s> {
    scene: Scene,
    /// The integrator of the reference motion.
    reference: Integrator,
    /// The points that are compared; the first is pushed.
    looked_at: [PointId; 3],
    sheet: Oscillator,
    /// Number of parts of the scene's step, each of which counts as a step here.
    parts: u32,
    steps: usize,
    /// `None`: the motion is chaotic, or beyond every bound.
    truth: [Option<Truth>; LOADS.len()],
    /// Points × substeps that may still be computed, and whether something was left out because they did not
    /// suffice.
    left: Cell<u64>,
    is_cut: Cell<bool>,
    /// When set by another thread, nothing more is computed.
    stop: &'s AtomicBool,
}

/// Returns the integrator of the reference motion: that of the highest order; but where viscosity asks for much shorter substeps with it, the
/// one that needs fewest, and with branches `stormer`.
fn reference(step_s: f64, sheet: &Oscillator) -> Integrator {
    if sheet.relaxes() {
        return Integrator::Stormer;
    }
    let substeps = |integrator| stability::stable_substeps(integrator, step_s, sheet);
    let is_cheap = substeps(Integrator::Exponential4) <= substeps(Integrator::Exponential2).saturating_mul(2);
    if is_cheap { Integrator::Exponential4 } else { Integrator::Exponential2 }
}

impl<'s> Rehearsal<'s> {
    /// Creates the rehearsal of a scene, with a reference that is good enough to judge schemes by `tolerance`.
    /// All courses together compute at most `most_work` points × substeps, and nothing more once `stop` is set.
    pub(crate) fn new(scene: &Scene, tolerance: f64, most_work: u64, stop: &'s AtomicBool) -> Self {
        let sheet = Oscillator::of(scene);
        let step_s = scene.stepping.rate_hz.recip();
        let reference = reference(step_s, &sheet);
        let parts = stability::stable_substeps(reference, step_s, &sheet) / SUBSTEPS_A_LOOK;
        let parts = parts.min(scene.stepping.substeps.unwrap_or(u32::MAX)).max(1);
        let mut small = scene.clone();
        let (body, looked_at) = scene.body.part(SIDE);
        small.body = body;
        small.stepping.rate_hz = scene.stepping.rate_hz * f64::from(parts);
        let least = stability::stable_substeps(reference, small.stepping.rate_hz.recip(), &sheet);
        let most_steps = STEPS.1.min(SUBSTEPS / f64::from(least)).max(STEPS.0);
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let steps = (COURSE_S * small.stepping.rate_hz).clamp(STEPS.0, most_steps) as usize;
        let mut rehearsal = Rehearsal {
            scene: small,
            reference,
            looked_at,
            sheet,
            parts,
            steps,
            truth: [const { None }; LOADS.len()],
            left: Cell::new(most_work),
            is_cut: Cell::new(false),
            stop,
        };
        for (load, at) in LOADS.iter().zip(0..) {
            rehearsal.truth[at] = rehearsal.true_course(load, least, tolerance);
            // Without one of the references, nothing can be judged.
            if rehearsal.truth[at].is_none() {
                break;
            }
        }
        rehearsal
    }

    /// Returns the points × substeps that may still be computed.
    pub(crate) fn left(&self) -> u64 {
        self.left.get()
    }

    /// Returns whether a course was left out because it would have needed more work than was left.
    pub(crate) fn is_cut(&self) -> bool {
        self.is_cut.get()
    }

    /// Returns whether the caller no longer waits for the result.
    pub(crate) fn is_stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// Computes the reference: halves the substep until that changes less than the tolerance; an error of fifth
    /// order is then 32 times smaller, one of third order 8 times, of second order 4 times. If rounding or a sensitive motion prevents that, the course that changed
    /// least is the reference, and this change is its uncertainty.
    fn true_course(&self, load: &CalibrationLoad, least: u32, tolerance: f64) -> Option<Truth> {
        let mut substeps = least;
        let mut coarse = self.course(load, self.reference, substeps, Precision::F64);
        let mut best = None::<Truth>;
        for _ in 0..MAX_HALVINGS {
            substeps = substeps.saturating_mul(2);
            if u64::from(substeps) * self.steps as u64 > MAX_SUBSTEPS {
                break;
            }
            let Some(fine) = self.course(load, self.reference, substeps, Precision::F64) else { break };
            if let Some(coarse) = coarse.replace(fine.clone()) {
                let uncertainty = self.difference(load, &fine, &coarse);
                if uncertainty <= tolerance {
                    return Some(Truth { course: fine, uncertainty: 0.0 });
                }
                if best.as_ref().is_none_or(|best| uncertainty < best.uncertainty) {
                    best = Some(Truth { course: fine, uncertainty });
                }
            }
        }
        best.filter(|truth| truth.uncertainty <= MAX_UNCERTAINTY)
    }

    /// Returns the factor by which the true error of a script with an integrator may exceed the rehearsed one.
    fn margin(&self, integrator: Integrator) -> f64 {
        self.scene.body.kind().rehearsal_margin(integrator)
    }

    /// Returns the smallest error that can be expected of any scheme, given the uncertainty of the reference. 0
    /// if that is within the tolerance; infinite if nothing can be estimated.
    pub(crate) fn least_error(&self) -> f64 {
        let uncertainty = |truth: &Option<Truth>| truth.as_ref().map_or(f64::INFINITY, |truth| truth.uncertainty);
        self.margin(self.reference) * self.truth.iter().map(uncertainty).fold(0.0, f64::max)
    }

    /// Returns the expected error of a scheme with `substeps` in a step of the scene and a format: the larger
    /// of the errors of displacement and force, each relative to its largest. Infinite if the motion can't be
    /// followed.
    pub(crate) fn error(&self, integrator: Integrator, substeps: u32, precision: Precision) -> f64 {
        if self.truth.iter().any(Option::is_none) {
            return f64::INFINITY;
        }
        let substeps = (substeps / self.parts).max(1);
        let error = |(load, truth): (&CalibrationLoad, &Option<Truth>)| -> Option<f64> {
            let Truth { course, uncertainty } = truth.as_ref()?;
            Some(self.difference(load, course, &self.course(load, integrator, substeps, precision)?) + uncertainty)
        };
        // The first course that can't be followed is enough.
        let largest = LOADS.iter().zip(&self.truth).try_fold(0.0, |largest: f64, pair| Some(largest.max(error(pair)?)));
        self.margin(integrator) * largest.unwrap_or(f64::INFINITY)
    }

    /// Returns `substeps` rounded up to whole rehearsed steps.
    pub(crate) fn whole(&self, substeps: u32) -> u32 {
        substeps.div_ceil(self.parts).saturating_mul(self.parts)
    }

    /// Returns `substeps` rounded down to whole rehearsed steps.
    pub(crate) fn whole_within(&self, substeps: u32) -> u32 {
        substeps / self.parts * self.parts
    }

    /// Returns the course of a scheme; `None` if the guard rejects it, if it would be too much work, or if it
    /// is stopped.
    fn course(
        &self,
        load: &CalibrationLoad,
        integrator: Integrator,
        substeps: u32,
        precision: Precision,
    ) -> Option<Trajectory> {
        if self.is_stopped() {
            return None;
        }
        let scene = &self.scene;
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
        let steps = (load.part * self.steps as f64) as usize;
        let points = scene.shape().point_count() as u64 + SUBSTEP_POINTS;
        let work = |substeps: u64| points.saturating_mul(substeps) + STEP_POINTS * steps as u64;
        if work((steps as u64).saturating_mul(u64::from(substeps))) > self.left.get() {
            self.is_cut.set(true);
            return None;
        }
        let plan = Plan::unjudged(integrator, substeps, scene.stepping.rate_hz.recip(), &self.sheet);
        let lanes = lanes::available(scene.stepping.lanes).unwrap_or(crate::scene::Lanes::Plain);
        let model = Arc::new(Model::planned(scene.clone(), plan, precision, lanes).ok()?);
        let (spacing_m, [pushed, ..]) = (scene.shape().edge_m(), self.looked_at);
        let stiffness = scene.anchor_stiffness_n_per_m + 0.3 * scene.springs.stiffness_n_per_m;
        // Without any spring, a force that moves a point about as far within a step.
        let free = scene.point_mass_kg() * scene.stepping.rate_hz * scene.stepping.rate_hz;
        let strength = scene.body.kind().rehearsal_strength();
        let newtons = strength * spacing_m * if stiffness > 0.0 { stiffness } else { free };
        let mut tissue = at_rest(&model);
        let profile = LoadProfile {
            centre: CentreProfile::Hops(vec![(0, scene.shape().rest_m(pushed))]),
            strength: StrengthProfile::Scaled(load.force * newtons, load.profile),
            falloff_per_m: load.falloff / spacing_m,
            falloff_offset: 0.0,
        };
        tissue.push(0, Some(Push::Profile(profile)));
        let mut course = Vec::with_capacity(steps);
        let mut is_sound = true;
        while is_sound && course.len() < steps {
            is_sound = tissue.step().is_ok() && tissue.guard_events() == 0 && !self.is_stopped();
            course.push(self.looked_at.map(|point| {
                let point = tissue.point(point);
                [point.displacement_m, point.reaction_n()]
            }));
        }
        // Substeps that the guard repeated count as well.
        self.left.set(self.left.get().saturating_sub(work(tissue.substeps_done())));
        is_sound.then_some(course)
    }

    /// Returns the largest difference of two courses, of displacement and force, relative to the largest of
    /// each. An error that grows in the second half of the course is expected to keep growing for as long as
    /// vibrations last.
    fn difference(&self, load: &CalibrationLoad, truth: &Trajectory, other: &Trajectory) -> f64 {
        #[allow(clippy::cast_precision_loss)]
        let course_s = self.steps as f64 / self.scene.stepping.rate_hz;
        // In a short course, less time is excluded.
        let soon_s = if load.profile == Profile::Constant { SOON_S.min(0.04 * course_s) } else { 0.0 };
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let soon = (soon_s * self.scene.stepping.rate_hz).ceil() as usize;
        let (mut largest, mut error, mut early) = ([0.0_f64; 2], [0.0_f64; 2], [0.0_f64; 2]);
        for (step, (a, b)) in truth.iter().zip(other).enumerate() {
            let weight = if step < soon { 1.0 / ALLOWANCE } else { 1.0 };
            if step == truth.len() / 2 {
                early = error;
            }
            for which in 0..2 {
                for (a, b) in a.iter().zip(b) {
                    largest[which] = largest[which].max(a[which].abs().max_element());
                    error[which] = error[which].max(weight * (a[which] - b[which]).abs().max_element());
                }
            }
        }
        let decay_s = 2.0 * self.sheet.mass_kg / self.sheet.damping_n_s_per_m;
        let halves_to_come = ((decay_s.min(LASTING_S) - course_s) / (0.5 * course_s)).max(0.0);
        let relative = |which: usize| {
            let growth = if error[which] > 1.5 * early[which] { error[which] - early[which] } else { 0.0 };
            // Where nothing moves, there is no error.
            if largest[which] > 0.0 { (error[which] + growth * halves_to_come) / largest[which] } else { 0.0 }
        };
        relative(0).max(relative(1))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::limits::Limits;
    use crate::scene::PAPER;

    fn scene(sets: &[&str]) -> Scene {
        let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
        Scene::parse("paper", PAPER, &sets, &Limits::default()).unwrap()
    }

    /// A course of values that depend on the part of the course that is over.
    fn course(steps: usize, of: impl Fn(f64) -> f64) -> Trajectory {
        let value = |step: usize| DVec3::new(0.0, of((step + 1) as f64 / steps as f64), 0.0);
        (0..steps).map(|step| [[value(step), 2.0 * value(step)]; 3]).collect()
    }

    #[test]
    fn an_error_that_grows_is_expected_to_grow_as_long_as_vibrations_last() {
        let difference = |sets: &[&str], error: &dyn Fn(f64) -> f64| {
            let rehearsal = Rehearsal::new(
                &scene(&[&["sheet.points=[3, 3]"][..], sets].concat()),
                1.0,
                0,
                &crate::select::scheme_selection::NEVER,
            );
            let truth = course(rehearsal.steps, |_| 0.5);
            let other = course(rehearsal.steps, |part| 0.5 + error(part));
            rehearsal.difference(&LOADS[2], &truth, &other)
        };
        let undamped = ["damping.coefficient_n_s_per_m=0.0"];
        // A course of 0.5 s of an undamped tissue represents 2 s.
        assert!((difference(&undamped, &|part| 1e-3 * part) / 8e-3 - 1.0).abs() < 0.01);
        // An error that does not grow stays as it is, and so does one in a tissue whose vibrations die within
        // the course.
        assert!((difference(&undamped, &|_| 1e-3) - 2e-3).abs() < 1e-9);
        assert!((difference(&["damping.coefficient_n_s_per_m=0.5"], &|part| 1e-3 * part) - 2e-3).abs() < 1e-9);
        // Where nothing moves there is no error.
        let rehearsal =
            Rehearsal::new(&scene(&["sheet.points=[3, 3]"]), 1.0, 0, &crate::select::scheme_selection::NEVER);
        let still = course(rehearsal.steps, |_| 0.0);
        assert_eq!(rehearsal.difference(&LOADS[2], &still, &still), 0.0);
    }

    #[test]
    fn a_course_takes_the_work_of_its_points_its_substeps_and_its_steps() {
        const WORK: u64 = 1 << 40;
        let scene = scene(&["sheet.points=[4, 3]"]);
        let never = &crate::select::scheme_selection::NEVER;
        let work = |load: &CalibrationLoad, substeps: u32| {
            let rehearsal = Rehearsal::new(&scene, 1e-3, WORK, never);
            let before = rehearsal.left();
            assert!(before < WORK && rehearsal.course(load, Integrator::Central, substeps, Precision::F64).is_some());
            (before - rehearsal.left(), rehearsal.steps as u64, rehearsal.scene.shape().point_count() as u64)
        };
        let ((few, steps, points), (many, ..)) = (work(&LOADS[0], 5), work(&LOADS[0], 10));
        assert_eq!(many - few, 5 * steps * (points + SUBSTEP_POINTS));
        assert_eq!(2 * few - many, steps * STEP_POINTS);
        // The course of a force that swings is a quarter as long.
        assert_eq!(work(&LOADS[2], 5).0, few / steps * (steps / 4));
        // A course that needs more work than is left is not begun.
        let rehearsal = Rehearsal::new(&scene, 1e-3, 0, never);
        rehearsal.left.set(few - 1);
        assert!(rehearsal.course(&LOADS[0], Integrator::Central, 5, Precision::F64).is_none() && rehearsal.is_cut());
        rehearsal.left.set(few);
        assert!(rehearsal.course(&LOADS[0], Integrator::Central, 5, Precision::F64).is_some());
        assert_eq!(rehearsal.left(), 0);
    }
}
