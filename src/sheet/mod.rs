//! The tissue: an immutable model, a state, and the step that advances it. No clock, no socket.
//!
//! The state is u, the displacement from rest, and d, what a substep adds to it, both in spacings. Positions are not stored: so
//! small movements keep their digits in f32. Each substep is one sweep over the springs (`sweep`), in which a scheme
//! (`integrate`) advances each point. A sheet at rest costs almost nothing: tiles sleep (`tiles`, `rest`).

/// Runs code with the scheme of a plan in format `$t`, for uses that do not advance the scheme and need no
/// compensation.
macro_rules! with_scheme {
    ($plan:expr, $t:ty, |$scheme:ident| $body:expr) => {
        match &$plan.scheme {
            $crate::sheet::integrate::Scheme::TwoStep(two) => {
                let $scheme = &central::Advance::<$t>::new(two);
                $body
            }
            $crate::sheet::integrate::Scheme::Multistep(multistep) if multistep.order == 2 => {
                let $scheme = &exponential::Advance::<$t, 2, false>::new(multistep);
                $body
            }
            $crate::sheet::integrate::Scheme::Multistep(multistep) if multistep.order == 3 => {
                let $scheme = &exponential::Advance::<$t, 3, false>::new(multistep);
                $body
            }
            $crate::sheet::integrate::Scheme::Multistep(multistep) => {
                let $scheme = &exponential::Advance::<$t, 4, false>::new(multistep);
                $body
            }
            $crate::sheet::integrate::Scheme::Rk4 { a, g } => {
                let $scheme = &rk4::Advance::<$t>::new(*a, *g, 0);
                $body
            }
        }
    };
}

mod advance;
mod applied;
pub mod audit;
mod change;
pub mod choice;
mod contact;
mod correction;
#[cfg(test)]
mod decay;
mod edge;
mod field;
mod footprint;
pub mod guard;
pub mod integrate;
mod lanes;
pub mod model;
mod prescribed;
mod real;
mod recovery;
mod region;
mod rehearsal;
mod rest;
mod springs;
pub mod stability;
mod still;
mod survey;
mod sweep;
pub mod tangent;
mod tiles;

use std::ops::Range;
use std::sync::Arc;

use glam::DVec3;
use palpate_touch::Tip;
use xxhash_rust::xxh3::Xxh3;

use crate::scene::Precision;
use crate::scene::law::{Moment, Motion};
use applied::Applied;
pub use applied::Push;
use audit::{Inputs, Mark, Watch};
use contact::Contacts;
pub use contact::{Feel, Surroundings};
use field::{Layout, State};
pub use footprint::{Footprint, Reached};
pub use guard::Cause;
use guard::{Checkpoint, Input, Work};
use integrate::{Scheme, central, exponential, rk4};
use lanes::Plain;
pub use model::{Model, Plan};
pub use prescribed::Grasp;
use prescribed::Prescribed;
use real::Real;
use springs::Springs;
pub use still::{Hashing, Still};
use sweep::{Bench, MAX_KEPT};
use tiles::{CHECK_STEPS, Tiles};

/// One mass point at the end of a step: displacement, velocity, and the forces on it. Where the applied force jumps,
/// the value just before the jump; at step 0, just after.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointState {
    /// Displacement from rest, m.
    pub displacement_m: DVec3,
    /// Velocity, m/s.
    pub velocity_m_per_s: DVec3,
    /// Force of all springs, N.
    pub spring_n: DVec3,
    /// −K″·u, N.
    pub virtual_n: DVec3,
    /// −C·v, N.
    pub damping_n: DVec3,
    /// Force of all pushing tools, N.
    pub applied_n: DVec3,
    /// For a prescribed point, the force that holds it: m·a − spring − virtual − damping − applied, N.
    pub constraint_n: Option<DVec3>,
}

impl PointState {
    /// The force of the tissue on a tool at the point: spring + virtual + damping, N.
    pub fn reaction_n(&self) -> DVec3 {
        self.spring_n + self.virtual_n + self.damping_n
    }
}

/// Energies of the whole sheet, J.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Energy {
    /// ½m·v².
    pub kinetic_j: f64,
    /// ½k(L − L0)² of all springs.
    pub spring_j: f64,
    /// ½K″·u².
    pub virtual_j: f64,
}

/// A failure that the guard could not repair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BlowUp {
    /// Steps done when the guard found it.
    pub step: u64,
    /// The cause.
    pub cause: Cause,
}

/// How a sheet continues after a blow-up.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Released {
    /// The tools that acted in the state that it went back to, ascending. They do no longer.
    pub tools: Vec<usize>,
    /// Whether it continues at rest.
    pub at_rest: bool,
}

/// A sheet in motion, in any precision.
pub trait Tissue: Send {
    /// The model that it was made from.
    fn model(&self) -> &Arc<Model>;
    /// Steps done.
    fn step_count(&self) -> u64;
    /// From the coming step on `tool` exerts `push`, or no force.
    fn push(&mut self, tool: usize, push: Option<Push>);
    /// From the coming step on `tool` moves the point at `index`.
    fn grasp(&mut self, tool: usize, index: usize, grasp: Grasp);
    /// From the coming step on `tool` meets the sheet with `tip` and is at `place_m` at the step's end.
    fn lead(&mut self, tool: usize, place_m: DVec3, tip: Tip);
    /// The motion of a position-controlled tool and the force on it.
    fn feel(&self, tool: usize) -> Option<Feel>;
    /// A copy of the sheet around such a tool, if it touches or holds, to compute the stiffness there.
    fn surroundings(&self, tool: usize) -> Option<Surroundings>;
    /// From the coming step on `tool` no longer pushes, grasps or touches.
    fn release(&mut self, tool: usize);
    /// From the coming step on springs, virtual springs and damping are those of `model` (from [`Model::changed`] of
    /// this sheet's model). Displacements and velocities stay; all tiles wake.
    fn change(&mut self, model: &Arc<Model>);
    /// Requests an audit of a window of steps, which begins at the next checkpoint.
    fn watch(&mut self, inputs: Inputs);
    /// Takes the report on that window after a step, once.
    fn take_mark(&mut self) -> Option<Mark>;
    /// The result of [`Tissue::change`] if `model` has another number format, as after a correction to f64.
    fn changed(&self, model: &Arc<Model>) -> Option<Box<dyn Tissue>>;
    /// The present scheme. The guard may have halved the model's substep.
    fn plan(&self) -> &Plan;
    /// How often the guard went back to a checkpoint and continued with half the substep.
    fn guard_events(&self) -> u64;
    /// The step whose state a blow-up would go back to.
    fn checkpoint_step(&self) -> u64;
    /// Substeps done, including those that the guard repeated.
    fn substeps_done(&self) -> u64;
    /// Points that a step computes now; the others are at rest.
    fn awake_points(&self) -> usize;
    /// Whether a step changes only the time, until a tool gets a command.
    fn is_still(&self) -> bool;
    /// Skips `steps` steps of a still sheet. The result is the same as that of single steps.
    fn skip_steps(&mut self, steps: u64);
    /// The fraction of all points in all substeps that was computed.
    fn computed_fraction(&self) -> f64;
    /// Advances one step.
    ///
    /// # Errors
    /// Returns a blow-up that the guard could not repair. The state is then that of the last checkpoint, which is
    /// finite.
    fn step(&mut self) -> Result<(), BlowUp>;
    /// After a blow-up: continues at step `step` (of the blow-up) from the state of the last checkpoint, or at rest if
    /// that has passed no check, with all tools released and the model's own substep.
    fn recover(&mut self, step: u64) -> Released;
    /// The point at `index`.
    fn point(&self, index: usize) -> PointState;
    /// The energies. A pass over what is awake; sleeping tiles use cached values. Earlier calls do not affect the
    /// result.
    fn energy(&self) -> Energy;
    /// Length of the largest displacement, m.
    fn largest_displacement_m(&self) -> f64;
    /// Writes the displacements, m, with x, y and z in separate vectors, points by rows.
    fn displacements_m(&self, into: &mut [Vec<f32>; 3]);
    /// Adds some blocks of 16 points of a row, counted by rows, to a hash: displacement, increment, and the scheme's kept
    /// values of each point.
    fn hash_blocks(&self, blocks: Range<usize>, hasher: &mut Xxh3);
    /// XXH3-128 of the state of every point.
    fn state_hash(&self) -> u128 {
        Hashing::default().add(self, usize::MAX).unwrap_or_default()
    }
    /// A copy of the sheet as it is now, to be read by another thread.
    fn still(&self) -> Still;
}

/// Creates a sheet at rest.
pub fn at_rest(model: &Arc<Model>) -> Box<dyn Tissue> {
    match model.precision {
        Precision::F64 => Box::new(Sheet::<f64>::new(model)),
        Precision::Auto | Precision::F32 | Precision::Compensated => Box::new(Sheet::<f32>::new(model)),
    }
}

#[derive(Debug)]
struct Sheet<T: Real> {
    model: Arc<Model>,
    /// The model's plan, or one with a shorter substep.
    plan: Plan,
    halvings: u32,
    bench: Bench<T>,
    state: State<T>,
    applied: Applied<T>,
    prescribed: Prescribed,
    contacts: Contacts,
    steps: u64,
    work: Work,
    /// `None` means the present state. A sheet at rest needs no copy.
    checkpoint: Option<Arc<Checkpoint<T>>>,
    /// The inputs of the tools since the checkpoint: step they precede, tool, input.
    inputs: Vec<(u64, usize, Input)>,
    watch: Watch,
    /// Whether the beginning of the window is still to be reported.
    is_marked: bool,
    tiles: Tiles<T>,
    guard_events: u64,
    substeps_done: u64,
    /// Points computed, summed over all substeps.
    points_done: u64,
}

impl<T: Real> Sheet<T> {
    fn new(model: &Arc<Model>) -> Self {
        let layout = Layout::new::<T>(model.points);
        let plan = model.plan.clone();
        Sheet {
            model: model.clone(),
            halvings: 0,
            bench: Bench::new(model.lanes, layout, springs_of(model, &plan), &model.fixed),
            state: State::at_rest(&layout, plan.scheme.kept(model.precision == Precision::Compensated)),
            steps: 0,
            work: Work::default(),
            checkpoint: None,
            applied: Applied::new(),
            prescribed: Prescribed::new(),
            contacts: Contacts::default(),
            inputs: Vec::new(),
            watch: Watch::Off,
            is_marked: false,
            tiles: Tiles::new(layout, rest::tolerance(model), if model.scene.springs.flexion { 2 } else { 1 }),
            guard_events: 0,
            substeps_done: 0,
            points_done: 0,
            plan,
        }
    }

    fn do_step(&mut self) {
        if self.is_still() {
            return self.skip_steps(1);
        }
        let substeps = self.plan.substeps;
        self.substeps_done += u64::from(substeps);
        self.wake_what_is_pushed();
        let fraction = |substep: u32| f64::from(substep) / f64::from(substeps);
        for substep in 0..substeps {
            self.substep(Moment { step: self.steps, fraction: fraction(substep) }, fraction(substep + 1));
        }
        self.applied.finish(&self.model, self.steps);
        self.prescribed.finish(&self.model, self.steps);
        self.contacts.finish(self.model.scene.stepping.rate_hz);
        self.steps += 1;
        if self.steps.is_multiple_of(CHECK_STEPS) {
            self.rest();
        }
    }

    /// Advances from `moment` to the fraction `end` of the same step.
    fn substep(&mut self, moment: Moment, end: f64) {
        let far = rest::farthest_unnoticed(&self.model, &self.tiles);
        self.tiles.watch(&self.state.u, far);
        self.points_done += self.tiles.awake_points as u64;
        let Sheet { model, plan, bench, applied, .. } = self;
        let layout = bench.layout;
        applied.prepare(model, plan, &layout, moment, end - moment.fraction);
        let released = self.prescribed.take_released();
        let released: Vec<_> =
            released.into_iter().map(|(index, v)| (index, self.change_at_release(index, v, moment))).collect();
        let Sheet { model, plan, bench, state, applied, tiles, .. } = self;
        let region = &tiles.region;
        match &plan.scheme {
            Scheme::TwoStep(two) => {
                bench.advance(&central::Advance::new(two), state, &applied.terms, 0, region);
            }
            Scheme::Multistep(multistep) => {
                // The change applies to the substep's initial state.
                for (index, change) in &released {
                    shift(&layout, state, *index, change);
                }
                let compensated = model.precision == Precision::Compensated;
                macro_rules! advance {
                    ($(($order:literal, $with:literal))*) => {
                        match (multistep.order, compensated) {
                            $(($order, $with) => {
                                let scheme = exponential::Advance::<T, $order, $with>::new(multistep);
                                bench.advance(&scheme, state, &applied.terms, 0, region);
                            })*
                            // `Scheme::fit` makes no other combination.
                            _ => {}
                        }
                    };
                }
                advance!((2, false)(3, false)(4, false)(2, true)(3, true)(4, true));
                // The newest force takes the place of the oldest.
                state.kept[..multistep.order].rotate_right(1);
            }
            Scheme::Rk4 { a, g } => {
                let (a, g) = (*a, *g);
                for stage in 0..rk4::STAGES.len() {
                    let field = stage.div_ceil(2);
                    let scheme = rk4::Advance::new(a, g, stage);
                    let terms = &self.applied.terms;
                    self.bench.advance(&scheme, &mut self.state, terms, field, &self.tiles.region);
                    if stage < 3 {
                        let far = rk4::STAGES[stage].0;
                        self.hold(moment.step, moment.fraction + far * (end - moment.fraction), false);
                    }
                }
            }
        }
        if self.plan.scheme.takes_means() {
            // The change applies to the substep's increment.
            for (index, change) in &released {
                shift(&layout, &mut self.state, *index, change);
            }
        }
        let unit_j = self.unit_of_work_j();
        self.work.add(self.bench.take_work() * unit_j);
        self.hold(moment.step, end, true);
        self.meet(end);
    }

    /// The work of a force of 1 in the fields of the tools along a displacement of 1, J.
    fn unit_of_work_j(&self) -> f64 {
        let Sheet { model, plan, .. } = self;
        model.scene.sheet.spacing_m / (plan.scheme.impulse() * plan.force_scale(&model.scene))
    }

    /// Displacement, velocity and springs' force of a free point, under the applied force `applied_n`.
    fn free_point(&self, index: usize, applied_n: DVec3) -> [DVec3; 3] {
        let Sheet { model, plan, bench, state, .. } = self;
        let (spacing_m, scale) = (model.scene.sheet.spacing_m, plan.force_scale(&model.scene));
        let unit = plan.scheme.spring_scale() * scale;
        let springs = bench.springs.gather(&bench.layout, &state.u, model.point_of(index));
        let [i, j] = model.point_of(index);
        let still = self.steps == 0 || !self.tiles.region.is_awake(i, j);
        let mut found = [DVec3::ZERO; 3];
        for (c, n) in springs.into_iter().enumerate() {
            let at = c * bench.layout.plane + bench.layout.place(index);
            let one = Plain::<f64, 1>::one;
            let mut kept = [one(0.0); MAX_KEPT];
            kept.iter_mut().zip(&state.kept).for_each(|(value, field)| *value = one(field[at].wide()));
            let (u, d, n) = (one(state.u[at].wide()), one(state.d[at].wide()), one(n.wide()));
            let force = one(unit * applied_n[c]);
            use sweep::Scheme as _;
            let (u, w) = with_scheme!(plan, f64, |scheme| scheme.observe(u, d, n, &kept, Some(force)));
            found[0][c] = u.value() * spacing_m;
            found[1][c] = if still { 0.0 } else { w.value() * spacing_m / plan.substep_s };
            found[2][c] = n.value() / unit;
        }
        found
    }

    fn tell(&mut self, tool: usize, input: Input) {
        match input {
            Input::Push(push) => {
                self.prescribed.release(tool);
                self.contacts.release(tool);
                self.applied.set(tool, push);
            }
            Input::Lead(place_m, tip) => {
                self.prescribed.release(tool);
                self.applied.set(tool, None);
                self.contacts.lead(&self.model, tool, place_m, tip);
            }
            Input::Grasp(index, grasp) => {
                self.applied.set(tool, None);
                self.contacts.release(tool);
                self.tiles.wake_under([self.model.point_of(index)]);
                let PointState { displacement_m, velocity_m_per_s, .. } = self.point(index);
                let now = Motion { displacement_m, velocity_m_per_s, ..Motion::default() };
                self.prescribed.grasp(tool, index, grasp, now);
            }
        }
    }
}

fn springs_of<T: Real>(model: &Model, plan: &Plan) -> Springs<T> {
    let unit = plan.substep_s * plan.substep_s / model.scene.sheet.point_mass_kg;
    Springs::new(model, unit * plan.scheme.spring_scale())
}

/// Adds to u and d of a point.
fn shift<T: Real>(layout: &Layout, state: &mut State<T>, index: usize, change: &[[f64; 2]; 3]) {
    for (c, change) in change.iter().enumerate() {
        let at = c * layout.plane + layout.place(index);
        state.u[at] += T::of(change[0]);
        state.d[at] += T::of(change[1]);
    }
}

impl<T: Real> Tissue for Sheet<T> {
    fn model(&self) -> &Arc<Model> {
        &self.model
    }

    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn step_count(&self) -> u64 {
        self.steps
    }

    fn guard_events(&self) -> u64 {
        self.guard_events
    }

    fn checkpoint_step(&self) -> u64 {
        self.checkpoint.as_ref().map_or(self.steps, |checkpoint| checkpoint.steps)
    }

    fn substeps_done(&self) -> u64 {
        self.substeps_done
    }

    fn push(&mut self, tool: usize, push: Option<Push>) {
        self.input(tool, Input::Push(push));
    }

    fn grasp(&mut self, tool: usize, index: usize, grasp: Grasp) {
        self.input(tool, Input::Grasp(index, grasp));
    }

    fn lead(&mut self, tool: usize, place_m: DVec3, tip: Tip) {
        self.input(tool, Input::Lead(place_m, tip));
    }

    fn feel(&self, tool: usize) -> Option<Feel> {
        Sheet::feel(self, tool)
    }

    fn surroundings(&self, tool: usize) -> Option<Surroundings> {
        Sheet::surroundings(self, tool)
    }

    fn release(&mut self, tool: usize) {
        self.push(tool, None);
    }

    fn change(&mut self, model: &Arc<Model>) {
        Sheet::change(self, model);
    }

    fn watch(&mut self, inputs: Inputs) {
        Sheet::watch(self, inputs);
    }

    fn take_mark(&mut self) -> Option<Mark> {
        Sheet::take_mark(self)
    }

    fn changed(&self, model: &Arc<Model>) -> Option<Box<dyn Tissue>> {
        Sheet::changed(self, model).map(|sheet| sheet as Box<dyn Tissue>)
    }

    fn is_still(&self) -> bool {
        self.tiles.region.tiles().is_empty()
            && self.applied.is_settled()
            && self.prescribed.is_empty()
            && self.contacts.is_empty()
    }

    fn skip_steps(&mut self, steps: u64) {
        self.steps += steps;
        self.substeps_done += steps * u64::from(self.plan.substeps);
    }

    fn step(&mut self) -> Result<(), BlowUp> {
        self.do_step();
        if self.checkpoint.is_some() || !self.is_still() {
            self.check().or_else(|cause| self.mend(self.steps, cause))?;
        }
        if self.checkpoint.is_some() && self.is_still() {
            self.forget_checkpoint();
        }
        Ok(())
    }

    fn recover(&mut self, step: u64) -> Released {
        Sheet::recover(self, step)
    }

    fn point(&self, index: usize) -> PointState {
        let scene = &self.model.scene;
        let applied_n = match self.steps {
            0 => self.applied.from(&self.model, index, Moment::start_of(0)),
            _ => self.applied.until(&self.model, index),
        };
        let [mut displacement_m, mut velocity_m_per_s, spring_n] = self.free_point(index, applied_n);
        let motion = self.prescribed.motion(&self.model, index);
        if let Some(motion) = motion {
            (displacement_m, velocity_m_per_s) = (motion.displacement_m, motion.velocity_m_per_s);
        }
        let virtual_n = -scene.virtual_stiffness_n_per_m * displacement_m;
        let damping_n = -scene.damping_n_s_per_m * velocity_m_per_s;
        let constraint_n = motion.map(|motion| {
            let inertia_n = scene.sheet.point_mass_kg * motion.acceleration_m_per_s2;
            inertia_n - spring_n - virtual_n - damping_n - applied_n
        });
        PointState { displacement_m, velocity_m_per_s, spring_n, virtual_n, damping_n, applied_n, constraint_n }
    }

    fn awake_points(&self) -> usize {
        self.tiles.awake_points
    }

    #[allow(clippy::cast_precision_loss)]
    fn computed_fraction(&self) -> f64 {
        match self.substeps_done {
            0 => 1.0,
            substeps => self.points_done as f64 / (substeps as f64 * self.model.len() as f64),
        }
    }

    fn energy(&self) -> Energy {
        self.energies()
    }

    fn largest_displacement_m(&self) -> f64 {
        let squared = (0..self.model.len()).map(|index| {
            let at = self.bench.layout.place(index);
            (0..3).map(|c| self.state.u[c * self.bench.layout.plane + at].wide().powi(2)).sum()
        });
        squared.fold(0.0, f64::max).sqrt() * self.model.scene.sheet.spacing_m
    }

    fn displacements_m(&self, into: &mut [Vec<f32>; 3]) {
        let Layout { rows, columns, stride, plane } = self.bench.layout;
        let spacing = T::of(self.model.scene.sheet.spacing_m);
        for (c, into) in into.iter_mut().enumerate() {
            into.clear();
            for i in 0..rows {
                let from = c * plane + i * stride;
                #[allow(clippy::cast_possible_truncation)]
                into.extend(self.state.u[from..from + columns].iter().map(|u| (*u * spacing).wide() as f32));
            }
        }
    }

    fn hash_blocks(&self, blocks: Range<usize>, hasher: &mut Xxh3) {
        Sheet::hash_blocks(self, blocks, hasher);
    }

    fn still(&self) -> Still {
        Sheet::still(self)
    }
}
