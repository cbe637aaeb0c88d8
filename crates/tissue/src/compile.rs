//! Compiles a scene to a model: checks it, chooses a scheme, and predicts its error.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use crate::body::model::{Model, Plan};
use crate::kernel::lanes;
use crate::limits::Limits;
use crate::response::tangent;
use crate::saved::{CorrectedPlan, SavedPlan};
use crate::scene::exercise::Lump;
use crate::scene::{Change, Integrator, Named, Precision, Scene, Stepping};
use crate::scheme::{Oscillator, entry};
use crate::select::scheme_selection::{self, Choice};
use palpate_refusal::{Reason, Refusal, Result, number, unsigned_zero};

/// What sleeping tiles may add to the error by default, as a fraction of it.
const SLEEP_PART: f64 = 0.1;

/// Returns the refusal of a scene that needs more substeps than the limit.
fn too_many(scene: &Scene, substeps: u32, limits: &Limits) -> Refusal {
    let message = format!(
        "would need {substeps} substeps a step for stability, above the limit of {}: the springs are too stiff \
         for points so light at this rate{}",
        limits.substeps,
        if scene.volume_is_fastest() {
            " (volume.stiffness_pa most of all)".to_owned()
        } else {
            scene.body.kind().fastest_place()
        }
    );
    Refusal::new(Reason::TooLarge, "stepping.substeps", message)
}

/// The beginning of the warning of an error above the tolerance.
const TOLERANCE: &str = "stepping.tolerance: ";

/// Checks that the processor has the instructions that a step needs. [`Model::compile`] does this as well; a
/// program may call it first, to fail early.
///
/// # Errors
/// Refuses a processor of x86-64 without fused multiply-add (FMA; [`Reason::NotAvailable`]).
pub fn check_processor() -> Result<()> {
    if lanes::fuses() {
        return Ok(());
    }
    let message = "this machine's processor has no fused multiply-add (FMA), which every lane width needs";
    Err(Refusal::new(Reason::NotAvailable, "stepping.lanes", message))
}

impl Model {
    /// Adds a warning if the expected error is above the tolerance: what is known of it, and what helps. It
    /// suggests `auto` only if the scene gives its own choice.
    pub(super) fn warn_of_error(&mut self, limits: &Limits) {
        self.warnings.retain(|warning| !warning.starts_with(TOLERANCE));
        let (expected_error, undamped) = (self.expected_error, self.scene.damping_n_s_per_m == 0.0);
        let Stepping { tolerance, integrator, substeps, precision, .. } = self.scene.stepping;
        if expected_error <= tolerance {
            return;
        }
        let mut parts = vec![if expected_error.is_finite() {
            format!("an error of {expected_error:.1e} is expected, above the {tolerance:.1e} asked for")
        } else {
            format!("nothing is known of the error, which may be above the {tolerance:.1e} asked for")
        }];
        if undamped {
            parts.push("nothing damps the tissue, and errors grow for as long as it moves".to_owned());
        }
        if integrator != Integrator::Auto || substeps.is_some() || precision != Precision::Auto {
            let given = "`palpate check` shows what `auto` would take for the integrator, substeps and precision given";
            parts.push(given.to_owned());
        } else if expected_error.is_finite() {
            parts.push(format!(
                "no integrator is expected to keep it with {} times the substeps that keep it stable, or with \
                 limits.substeps ({}): ask for a larger tolerance, or for more damping",
                scheme_selection::MAX_TIMES_STABLE,
                limits.substeps
            ));
        } else {
            parts.push("`palpate run --audit` measures it".to_owned());
        }
        self.warnings.push(format!("{TOLERANCE}{}", parts.join("; ")));
    }
}

impl Model {
    /// Reads the text of a scene (TOML), applies the assignments `sets` (`"sheet.spacing_m=0.01"`, as `--set`
    /// does) in their order, and compiles it under the default limits. Refusals call the text `name`. The text
    /// may name no mesh file. Like [`Model::compile`], it may take some tenths of a second.
    ///
    /// # Errors
    /// Refuses a text or an assignment that [`Scene::parse`] refuses, and every scene that [`Model::compile`]
    /// refuses.
    pub fn parse(name: &str, text: &str, sets: &[&str]) -> Result<Arc<Self>> {
        let sets: Vec<_> = sets.iter().map(|set| (*set).to_owned()).collect();
        let limits = Limits::default();
        Model::compile(&Scene::parse(name, text, &sets, &limits)?, &limits)
    }

    /// Checks a scene and compiles it: chooses the scheme, the substep and the number format where the scene
    /// leaves them open. Then rehearsals run, which may take some tenths of a second; the call blocks. The
    /// scene itself stays unchanged.
    ///
    /// The substep follows from the stability bound: here one of a millisecond or less, within the step of 1 ms.
    ///
    /// ```
    /// use palpate_tissue::Model;
    /// use palpate_tissue::limits::Limits;
    /// use palpate_tissue::scene::{PAPER, Scene};
    ///
    /// let limits = Limits::default();
    /// let scene = Scene::parse("paper", PAPER, &["sheet.points=[9, 9]".to_owned()], &limits)?;
    /// let model = Model::compile(&scene, &limits)?;
    /// assert_eq!(model.len(), 81);
    /// assert!(model.plan.stable && model.expected_error <= scene.stepping.tolerance);
    /// assert!((f64::from(model.plan.substeps) * model.plan.substep_s - 1e-3).abs() < 1e-12);
    /// println!("{} substeps, no vibration is faster than {} rad/s", model.plan.substeps, model.omega_bound_per_s);
    /// # Ok::<(), palpate_refusal::Refusal>(())
    /// ```
    ///
    /// # Errors
    /// Refuses
    ///
    /// - every scene that [`Scene::check`] refuses;
    /// - a processor without FMA ([`check_processor`]) or without the `stepping.lanes` that the scene names;
    /// - more substeps than `limits.substeps`, which stability needs ([`Reason::TooLarge`]);
    /// - a tolerance whose rehearsals would take more than `limits.rehearsal_work` ([`Reason::TooLarge`]);
    /// - `compensated` with an integrator that is not exponential;
    /// - springs that can't be laid out in memory.
    pub fn compile(scene: &Scene, limits: &Limits) -> Result<Arc<Self>> {
        Model::compile_until(scene, limits, &scheme_selection::NEVER)
    }

    /// Compiles a scene as [`Model::compile`] does, but gives up soon after another thread sets `stop`.
    ///
    /// # Errors
    /// Refuses every scene that [`Model::compile`] refuses; and refuses if `stop` is set before the rehearsals
    /// end ([`Reason::TimedOut`]).
    pub fn compile_until(scene: &Scene, limits: &Limits, stop: &AtomicBool) -> Result<Arc<Self>> {
        scene.check(limits)?;
        // Before the rehearsals, which run sweeps.
        check_processor()?;
        let scene = &scene.clone().with_unsigned_zeros();
        let sheet = Oscillator::of(scene);
        let step_s = scene.stepping.rate_hz.recip();
        // No rehearsals for a scene that no scheme can step.
        let least = scheme_selection::least_substeps(scene.stepping.integrator, step_s, &sheet);
        if scene.stepping.substeps.is_none() && least > limits.substeps {
            return Err(too_many(scene, least, limits));
        }
        let (choice, rehearsed) = scheme_selection::choose(scene, limits, stop)?;
        Model::chosen(scene, choice, rehearsed, limits, stop)
    }

    /// Compiles a scene with a given choice of scheme, substeps and format.
    fn chosen(scene: &Scene, choice: Choice, rehearsed: u64, limits: &Limits, stop: &AtomicBool) -> Result<Arc<Self>> {
        let sheet = Oscillator::of(scene);
        let step_s = scene.stepping.rate_hz.recip();
        let Choice { integrator, substeps, precision, expected_error } = choice;
        if precision == Precision::Compensated && !entry(integrator).compensates {
            let message = format!("is for exponential schemes; `{}` has f32 and f64", integrator.name());
            return Err(Refusal::new(Reason::WrongKind, "stepping.precision", message));
        }
        if substeps > limits.substeps {
            return Err(too_many(scene, substeps, limits));
        }
        let plan = Plan::new(integrator, substeps, step_s, &sheet);
        let omega_bound_per_s = sheet.omega_bound_per_s();
        let mut warnings = scene.body.kind().warnings();
        if !plan.stable {
            warnings.push(format!(
                "stepping.substeps: {} is above the stability bound of the scheme; the tissue may blow up \
                 (substep × fastest vibration = {:.3})",
                plan.substeps,
                plan.substep_s * omega_bound_per_s
            ));
        }
        let Some(lanes) = lanes::available(scene.stepping.lanes) else {
            check_processor()?;
            let message = format!("this machine's processor has no `{}`", scene.stepping.lanes.name());
            return Err(Refusal::new(Reason::NotAvailable, "stepping.lanes", message));
        };
        let sleep_tolerance = scene.sleep_tolerance.unwrap_or_else(|| {
            // A user who chooses the scheme may want an error below the tolerance.
            let chosen = scene.stepping.integrator != Integrator::Auto || scene.stepping.substeps.is_some();
            SLEEP_PART * if chosen { expected_error.min(scene.stepping.tolerance) } else { scene.stepping.tolerance }
        });
        let model = Model::planned(scene.clone(), plan, precision, lanes)
            .map_err(|fault| Refusal::new(Reason::OutOfRange, scene.body.kind().points_key(), fault.to_string()))?;
        let volume_compliance = tangent::volume_compliance(&model, stop).into();
        let mut model = Model { expected_error, sleep_tolerance, warnings, rehearsed, volume_compliance, ..model };
        model.warn_of_error(limits);
        Ok(Arc::new(model))
    }

    /// Returns the model of the same tissue with some coefficients changed, for
    /// [`Tissue::change`](crate::Tissue::change). The number format stays; integrator and substeps are chosen
    /// again for the tolerance, except that after a correction the integrator and at least the substeps of the
    /// correction stay. `first` is the scene that the session began with ([`Scene::changed`]). Blocks as
    /// [`Model::compile`] does.
    ///
    /// # Errors
    /// Refuses an empty change ([`Reason::Missing`]), and every changed scene that [`Model::compile`] refuses.
    pub fn changed(&self, change: &Change, first: &Scene, limits: &Limits) -> Result<Arc<Self>> {
        self.changed_until(change, first, limits, &scheme_selection::NEVER)
    }

    /// Returns the model with some coefficients changed, as [`Model::changed`] does, but gives up soon after
    /// another thread sets `stop`.
    ///
    /// # Errors
    /// Refuses everything that [`Model::changed`] refuses; and refuses if `stop` is set before the rehearsals
    /// end ([`Reason::TimedOut`]).
    pub fn changed_until(
        &self,
        change: &Change,
        first: &Scene,
        limits: &Limits,
        stop: &AtomicBool,
    ) -> Result<Arc<Self>> {
        if *change == Change::default() {
            return Err(Refusal::new(Reason::Missing, "", Change::NOTHING));
        }
        self.changed_to(self.scene.changed(change, first), limits, stop)
    }

    /// Returns the model of the same tissue with a lump more ([`Scene::with_added_lumps`]), for [`Tissue::change`](crate::Tissue::change).
    /// What stays and what is chosen again is as for [`Model::changed_until`], which see for `stop`.
    ///
    /// # Errors
    /// Refuses what [`Scene::with_added_lumps`] and [`Model::compile`] refuse, and a set `stop`.
    pub fn with_lump_until(&self, lump: &Lump, limits: &Limits, stop: &AtomicBool) -> Result<Arc<Self>> {
        let lumps: Vec<Lump> = self.scene.added_lumps.iter().chain([lump]).copied().collect();
        let scene = self.scene.with_added_lumps(&lumps)?;
        self.changed_to(scene, limits, stop)
    }

    /// Compiles another scene of the same tissue, in the number format of this model.
    fn changed_to(&self, mut scene: Scene, limits: &Limits, stop: &AtomicBool) -> Result<Arc<Self>> {
        let asked = self.scene.stepping.clone();
        scene.stepping.precision = self.precision;
        let mut model = self.compile_corrected(&scene, limits, stop)?;
        model.scene.stepping = asked;
        model.warn_of_error(limits);
        Ok(Arc::new(model))
    }

    /// Returns the coefficients and the plan of this model: everything that [`Model::resumed`] needs besides
    /// the scene that the session began with. Displacements are not part of it.
    pub fn saved_plan(&self) -> SavedPlan {
        let Model { scene, plan, precision, expected_error, sleep_tolerance, corrected, .. } = self;
        SavedPlan {
            stiffness_n_per_m: scene.springs.stiffness_n_per_m,
            shear_stiffness_n_per_m: scene.springs.shear_stiffness_n_per_m,
            anchor_stiffness_n_per_m: scene.anchor_stiffness_n_per_m,
            damping_n_s_per_m: scene.damping_n_s_per_m,
            volume_stiffness_pa: scene.volume_stiffness_pa,
            integrator: plan.integrator,
            substeps: plan.substeps,
            precision: *precision,
            sleep_tolerance: *sleep_tolerance,
            sleep_tolerance_of_scene: scene.sleep_tolerance,
            expected_error: *expected_error,
            corrected: corrected.map(|(integrator, least_substeps)| CorrectedPlan { integrator, least_substeps }),
        }
    }

    /// Rebuilds the model that changes and corrections had made of `first`, the scene that the session began
    /// with, from what [`Model::tissue_state`] returned. It has the same plan and gives the same bits; nothing
    /// is rehearsed or chosen again. Lanes are those of this machine.
    ///
    /// # Errors
    /// Refuses
    ///
    /// - coefficients that [`Scene::check`] refuses;
    /// - a sleep tolerance beyond 0 to 1, an integrator or format `auto`, 0 substeps, an expected error that is
    ///   NaN;
    /// - `compensated` with an integrator that is not exponential, more substeps than `limits.substeps`;
    /// - lanes that this processor does not have, and springs that can't be laid out in memory.
    pub fn resumed(first: &Scene, state: &SavedPlan, limits: &Limits) -> Result<Arc<Self>> {
        let SavedPlan { integrator, substeps, precision, sleep_tolerance, expected_error, .. } = *state;
        let mut scene = first.clone();
        scene.springs.stiffness_n_per_m = state.stiffness_n_per_m;
        scene.springs.shear_stiffness_n_per_m = state.shear_stiffness_n_per_m;
        scene.anchor_stiffness_n_per_m = state.anchor_stiffness_n_per_m;
        scene.damping_n_s_per_m = state.damping_n_s_per_m;
        scene.volume_stiffness_pa = state.volume_stiffness_pa;
        scene.sleep_tolerance = state.sleep_tolerance_of_scene;
        scene.check(limits)?;
        let scene = scene.with_unsigned_zeros();
        let sleep_tolerance = number("sleep.tolerance", sleep_tolerance, "from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
        let is_one = integrator != Integrator::Auto && precision != Precision::Auto && substeps > 0;
        if !is_one || expected_error.is_nan() || state.corrected.is_some_and(|plan| plan.integrator == Integrator::Auto)
        {
            let message = "does not belong to a model: it has no scheme, format, substeps or expected error";
            return Err(Refusal::new(Reason::OutOfRange, "stepping", message));
        }
        let made = Choice { integrator, substeps, precision, expected_error: unsigned_zero(expected_error) };
        let model = Model::chosen(&scene, made, 0, limits, &scheme_selection::NEVER)?;
        let corrected = state.corrected.map(|plan| (plan.integrator, plan.least_substeps));
        Ok(Arc::new(Model { sleep_tolerance, corrected, ..Arc::unwrap_or_clone(model) }))
    }

    /// Returns the fewest substeps of another scene of the same points that are as short beside the fastest vibration as those of
    /// this model, and stable.
    ///
    /// # Errors
    /// Refuses every scene that [`Scene::check`] refuses.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub fn substeps_alike(&self, scene: &Scene, limits: &Limits) -> Result<u32> {
        // Substeps may be that much longer, so that coefficients a little beyond those of this model have as many.
        const SLACK: f64 = 0.97;
        scene.check(limits)?;
        let sheet = Oscillator::of(scene);
        let step_s = scene.stepping.rate_hz.recip();
        let faster = SLACK * sheet.omega_bound_per_s() / self.omega_bound_per_s;
        let Plan { integrator, substeps, .. } = self.plan;
        let mut substeps = (f64::from(substeps) * faster).ceil().clamp(1.0, f64::from(u32::MAX)) as u32;
        while substeps <= limits.substeps && !Plan::new(integrator, substeps, step_s, &sheet).stable {
            substeps += 1 + substeps / 16;
        }
        Ok(substeps)
    }

    /// Compiles another scene of the same points with the scheme and the number format of this model, without rehearsals, and with
    /// [`Model::substeps_alike`], at least `least_substeps`. The force of a run depends smoothly on the scene's coefficients as long
    /// as the substeps stay the same. The expected error and the sleep tolerance are those of this model.
    ///
    /// # Errors
    /// Refuses every scene that [`Scene::check`] refuses, and more substeps than `limits.substeps`, which stability needs
    /// ([`Reason::TooLarge`]).
    pub fn compile_alike(&self, scene: &Scene, least_substeps: u32, limits: &Limits) -> Result<Arc<Self>> {
        let scene = scene.clone().with_unsigned_zeros();
        let substeps = self.substeps_alike(&scene, limits)?.max(least_substeps);
        let Model { precision, expected_error, .. } = *self;
        let choice = Choice { integrator: self.plan.integrator, substeps, precision, expected_error };
        let model = Model::chosen(&scene, choice, 0, limits, &scheme_selection::NEVER)?;
        Ok(Arc::new(Model { sleep_tolerance: self.sleep_tolerance, ..Arc::unwrap_or_clone(model) }))
    }

    /// Compiles the scene of this model with its scheme, twice its substeps, in f64, and without sleep. What differs in a run of it shows
    /// what a run of this model errs by.
    ///
    /// # Errors
    /// Refuses more substeps than `limits.substeps` ([`Reason::TooLarge`]).
    pub fn compile_finer(&self, limits: &Limits) -> Result<Arc<Self>> {
        let (integrator, substeps) = (self.plan.integrator, self.plan.substeps.saturating_mul(2));
        let choice = Choice { integrator, substeps, precision: Precision::F64, expected_error: self.expected_error };
        let model = Model::chosen(&self.scene, choice, 0, limits, &scheme_selection::NEVER)?;
        Ok(Arc::new(Model { sleep_tolerance: 0.0, ..Arc::unwrap_or_clone(model) }))
    }

    /// Compiles the models of successive changes, each with the step at which it applies. Each change builds on
    /// the one before it; the first builds on `self`. Returns the steps and models in the order of `changes`,
    /// which is not checked. `first` is the scene that the session began with. Blocks for each change as
    /// [`Model::changed`] does.
    ///
    /// # Errors
    /// Refuses the first change that [`Model::changed`] refuses; the models before it are lost.
    pub fn apply_changes(
        self: &Arc<Self>,
        first: &Scene,
        changes: &[(u64, Change)],
        limits: &Limits,
    ) -> Result<VecDeque<(u64, Arc<Self>)>> {
        let mut newest = self.clone();
        let compiled = changes.iter().map(|(step, change)| {
            newest = newest.changed(change, first, limits)?;
            Ok((*step, newest.clone()))
        });
        compiled.collect()
    }

    /// Returns the predicted processor time of a step with all points awake, s: t₀ + t₁·P·n, with P the swept
    /// points ([`Model::swept_points`]) and n the substeps; t₀ = 2 µs and t₁ (by scheme, format, lanes and kind
    /// of tissue) were measured on one machine.
    #[allow(clippy::cast_precision_loss)]
    pub fn predicted_step_s(&self) -> f64 {
        let point_ns =
            scheme_selection::point_substep_ns(&self.scene, self.plan.integrator, self.precision, self.lanes);
        1e-9 * (scheme_selection::STEP_NS + point_ns * self.swept_points() as f64 * f64::from(self.plan.substeps))
    }

    /// Compiles another scene for this tissue, with the scheme and at least the substeps of the last
    /// correction.
    fn compile_corrected(&self, scene: &Scene, limits: &Limits, stop: &AtomicBool) -> Result<Self> {
        let Some((integrator, least)) = self.corrected else {
            return Ok(Arc::unwrap_or_clone(Model::compile_until(scene, limits, stop)?));
        };
        let mut scene = scene.clone();
        (scene.stepping.integrator, scene.stepping.substeps) = (integrator, None);
        let mut model = Model::compile_until(&scene, limits, stop)?;
        if model.plan.substeps < least {
            scene.stepping.substeps = Some(least);
            model = Model::compile_until(&scene, limits, stop)?;
        }
        Ok(Model { corrected: self.corrected, ..Arc::unwrap_or_clone(model) })
    }
}

#[cfg(test)]
impl Model {
    /// Compiles the paper's scene with some values set.
    pub(crate) fn paper(sets: &[&str]) -> Arc<Self> {
        Model::parse("paper", crate::scene::PAPER, sets).unwrap()
    }

    /// Compiles a small organ that has heavy and light points.
    pub(crate) fn gallbladder(sets: &[&str]) -> Arc<Self> {
        let text = "[mesh]\norgan = { name = \"gallbladder\", edge_m = 0.0035 }\n[material]\nyoungs_modulus_pa = 2e4\n\
                    thickness_m = 0.003\nfoundation_n_per_m3 = 5e6\n[stepping]\nsubsteps = 8\n";
        Model::parse("gallbladder", text, sets).unwrap()
    }
}

/// Returns a file of a rectangle of triangles in the plane z = 0, from the origin on.
#[cfg(test)]
pub(crate) fn square_of_triangles(cells: [u32; 2], spacing_m: f64) -> String {
    use std::fmt::Write;
    let mut mesh = String::new();
    let [nx, ny] = cells;
    for i in 0..=nx {
        for j in 0..=ny {
            writeln!(mesh, "v {:?} {:?} 0", f64::from(i) * spacing_m, f64::from(j) * spacing_m).unwrap();
        }
    }
    let vertex = |i: u32, j: u32| i * (ny + 1) + j + 1;
    for i in 0..nx {
        for j in 0..ny {
            let corners = [vertex(i, j), vertex(i + 1, j), vertex(i + 1, j + 1), vertex(i, j + 1)];
            for [a, b, c] in [[0, 1, 2], [0, 2, 3]] {
                writeln!(mesh, "f {} {} {}", corners[a], corners[b], corners[c]).unwrap();
            }
        }
    }
    mesh
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_zero_has_no_sign() {
        let compile = |zero: &str| {
            let keys = ["damping.coefficient_n_s_per_m", "anchor_springs.stiffness_n_per_m"];
            Model::paper(&keys.map(|key| format!("{key}={zero}")).each_ref().map(String::as_str))
        };
        let (negative, positive) = (compile("-0.0"), compile("0.0"));
        assert_eq!((&negative.plan, negative.expected_error), (&positive.plan, positive.expected_error));
        assert!(negative.scene.damping_n_s_per_m.is_sign_positive());
    }

    #[test]
    fn an_error_above_the_tolerance_is_warned_of() {
        let warns = |sets: &[&str]| {
            let model = Model::paper(&[&["sheet.points=[5, 5]"][..], sets].concat());
            let is_above = model.expected_error > model.scene.stepping.tolerance;
            (is_above, model.warnings.iter().any(|warning| warning.starts_with("stepping.tolerance: ")))
        };
        assert_eq!(warns(&[]), (false, false));
        assert_eq!(warns(&["stepping.integrator=lagged", "stepping.substeps=1"]), (true, true));
    }

    #[test]
    fn auto_is_advised_only_where_the_scene_does_without() {
        let advises = |model: &Model| {
            let of_error = model.warnings.iter().find(|warning| warning.starts_with(TOLERANCE));
            of_error.map(|warning| warning.contains("auto"))
        };
        let small =
            |sets: &[&str]| Model::paper(&[&["sheet.points=[5, 5]", "stepping.tolerance=1e-14"][..], sets].concat());
        for given in ["stepping.integrator=central", "stepping.substeps=2", "stepping.precision=f32"] {
            assert_eq!(advises(&small(&[given])), Some(true), "{given}");
        }
        let model = small(&[]);
        assert_eq!(advises(&model), Some(false), "{:?}", model.warnings);
        // A changed tissue keeps the format of the state, which the scene does not give.
        let change = Change { damping_n_s_per_m: Some(0.0), ..Change::default() };
        let changed = model.changed(&change, &model.scene, &Limits::default()).unwrap();
        assert_eq!(advises(&changed), Some(false), "{:?}", changed.warnings);
        assert_eq!(advises(&small(&["stepping.tolerance=1e-2"])), None);
    }

    #[test]
    fn as_many_substeps_as_the_limit_are_taken_and_more_are_refused() {
        let sets = ["sheet.points=[5, 5]", "springs.stiffness_n_per_m=5000", "stepping.integrator=central"];
        let sets = sets.map(str::to_owned);
        let scene = Scene::parse("paper", crate::scene::PAPER, &sets, &Limits::default()).unwrap();
        let least = scheme_selection::least_substeps(Integrator::Central, 1e-3, &Oscillator::of(&scene));
        assert!(least > 1);
        let limited = |substeps: u32| Model::compile(&scene, &Limits { substeps, ..Limits::default() });
        assert_eq!(limited(least).unwrap().plan.substeps, least);
        assert_eq!(limited(least - 1).unwrap_err().field, "stepping.substeps");
    }

    #[test]
    fn in_compensated_f32_only_schemes_that_compensate_are_chosen_also_for_a_changed_tissue() {
        let sets = ["sheet.points=[5, 5]", "stepping.tolerance=1e-2", "stepping.precision=compensated"];
        let damped = Model::paper(&sets);
        let model = Model::paper(&[&sets[..], &["damping.coefficient_n_s_per_m=0.0"]].concat());
        // Vibrations that decay leave less of an error: a simpler scheme would do.
        let change = Change { damping_n_s_per_m: Some(damped.scene.damping_n_s_per_m), ..Change::default() };
        let changed = model.changed(&change, &model.scene, &Limits::default()).unwrap();
        for model in [&model, &damped, &changed] {
            assert_eq!(model.precision, Precision::Compensated);
            assert_ne!(model.plan.integrator, Integrator::Central);
        }
    }
}
