//! The tissue: an immutable model, a state, and the step that takes one to the next. No clock, no socket.

mod applied;
pub mod integrate;
pub mod model;
mod prescribed;
mod real;
mod springs;
pub mod stability;

use std::sync::Arc;

use glam::DVec3;
use xxhash_rust::xxh3::Xxh3;

use crate::scene::Precision;
use crate::scene::law::{Moment, Motion};
use applied::Applied;
pub use applied::Push;
pub use model::Model;
pub use prescribed::Grasp;
use prescribed::Prescribed;
use real::Real;
use springs::Springs;

/// One mass point at the end of a step: displacement, velocity, and the forces on the point. Where the applied
/// force jumps it is the one just before; at step 0, just after.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointState {
    /// From rest, m.
    pub displacement_m: DVec3,
    /// m/s.
    pub velocity_m_per_s: DVec3,
    /// Of all springs, N.
    pub spring_n: DVec3,
    /// −K″·u, N.
    pub virtual_n: DVec3,
    /// −C·v, N.
    pub damping_n: DVec3,
    /// Of all tools that push, N.
    pub applied_n: DVec3,
    /// Of a prescribed point, the force that holds it: m·a − spring − virtual − damping − applied, N.
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

/// What a scheme found that it could not go on with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BlowUp {
    /// Steps done when it was found.
    pub step: u64,
    /// A point that is not finite, or is displaced by a billion sheets.
    pub point: [usize; 2],
}

/// A sheet in motion, in whichever precision.
pub trait Tissue: Send {
    /// What it was made from.
    fn model(&self) -> &Arc<Model>;
    /// Steps done.
    fn step_count(&self) -> u64;
    /// From the coming step on `tool` exerts `push`, or nothing.
    fn push(&mut self, tool: usize, push: Option<Push>);
    /// From the coming step on `tool` moves the point at `index`.
    fn grasp(&mut self, tool: usize, index: usize, grasp: Grasp);
    /// `tool` neither pushes nor grasps any more, from the coming step on.
    fn release(&mut self, tool: usize);
    /// One step. After a blow-up the state is that of the last checkpoint, which is finite.
    fn step(&mut self) -> Result<(), BlowUp>;
    /// The point at `index`.
    fn point(&self, index: usize) -> PointState;
    /// A pass over the whole sheet.
    fn energy(&self) -> Energy;
    /// Length of the largest displacement, m.
    fn largest_displacement_m(&self) -> f64;
    /// Writes the displacements, m, x, y and z apart.
    fn displacements_m(&self, into: &mut [Vec<f32>; 3]);
    /// XXH3-128 of displacement and increment of every point.
    fn state_hash(&self) -> u128;
}

/// A sheet at rest.
pub fn at_rest(model: &Arc<Model>) -> Box<dyn Tissue> {
    match model.precision {
        Precision::F64 => Box::new(Sheet::<f64>::new(model)),
        Precision::Auto | Precision::F32 => Box::new(Sheet::<f32>::new(model)),
    }
}

/// Displacement and increment of every point, x, y and z apart: a struct of arrays, point [i, j] at i·ny + j.
#[derive(Debug, Clone)]
struct State<T> {
    /// Displacement from rest, m.
    u: [Vec<T>; 3],
    /// Increment of `u` in the last substep, m.
    d: [Vec<T>; 3],
}

/// Steps between two checkpoints, to which a blow-up goes back. A copy costs about a tenth of a step.
const CHECKPOINT_STEPS: u64 = 64;

/// A displacement of so many sheets is a blow-up: far beyond any tissue, and far below what f32 can square.
const FARTHEST_IN_SHEETS: f64 = 1e9;

#[derive(Debug)]
struct Sheet<T> {
    model: Arc<Model>,
    state: State<T>,
    /// Force of all springs at `state.u`, N: always up to date, so that reading it costs nothing.
    spring_n: [Vec<T>; 3],
    springs: Springs<T>,
    applied: Applied<T>,
    prescribed: Prescribed,
    steps: u64,
    checkpoint: (u64, State<T>),
}

impl<T: Real> Sheet<T> {
    fn new(model: &Arc<Model>) -> Self {
        let zero = || std::array::from_fn(|_| vec![T::default(); model.len()]);
        let state = State { u: zero(), d: zero() };
        Sheet {
            model: model.clone(),
            spring_n: zero(),
            springs: Springs::new(model),
            applied: Applied::new(model),
            prescribed: Prescribed::new(),
            steps: 0,
            checkpoint: (0, state.clone()),
            state,
        }
    }

    fn substep(&mut self, moment: Moment, end: f64) {
        self.applied.prepare(&self.model, moment);
        let kicks = self.kicks_of_released(moment);
        self.advance();
        for (index, kick) in kicks {
            for (c, kick) in kick.into_iter().enumerate() {
                self.state.d[c][index] += kick;
                self.state.u[c][index] += kick;
            }
        }
        self.prescribed.hold(&self.model, moment.step, end, &mut self.state.u, &mut self.state.d);
        self.springs.forces(&self.state.u, &mut self.spring_n);
    }

    /// d ← p·d + q·F(u), u ← u + d, at every point.
    ///
    /// What is far too small to matter is set to 0: fields decay towards the rim of a sheet without end, and arithmetic
    /// on the subnormal numbers at which they arrive costs tens of times the usual.
    fn advance(&mut self) {
        let plan = &self.model.plan;
        let (p, q) = (T::of(plan.p), T::of(plan.q));
        let stiffness = T::of(self.model.scene.virtual_stiffness_n_per_m);
        let spacing_m = T::of(self.model.scene.sheet.spacing_m);
        let (least_u, least_d) = (spacing_m * T::LEAST, spacing_m * T::LEAST * T::LEAST_INCREMENT);
        for c in 0..3 {
            let forces = self.spring_n[c].iter().zip(&self.applied.field[c]);
            let state = self.state.u[c].iter_mut().zip(&mut self.state.d[c]);
            for ((u, d), (spring, applied)) in state.zip(forces) {
                let next_d = p * *d + q * (*spring + *applied - stiffness * *u);
                let next_u = *u + next_d;
                *d = if next_d.magnitude() < least_d { T::default() } else { next_d };
                *u = if next_u.magnitude() < least_u { T::default() } else { next_u };
            }
        }
    }

    /// To let go is a jump: before it the whole force on the point, damping left out, was m·a + C·v with the a and v
    /// of the tool; after it, it is F = spring + applied − K″·u. At a jump a two-step scheme needs the mean of both (see
    /// `applied`), and it uses F with the mean of the applied force. The tool moved at constant velocity, so a = 0: the
    /// point gets ½(C·v + F) less that. In terms of the increment, q times the difference.
    fn kicks_of_released(&mut self, moment: Moment) -> Vec<(usize, [T; 3])> {
        let released = self.prescribed.take_released();
        let scene = &self.model.scene;
        let kick = |(index, velocity): (usize, DVec3)| {
            let applied_n = self.applied.from(&self.model, index, moment);
            let kick = std::array::from_fn(|c| {
                let elastic_n =
                    self.spring_n[c][index].wide() - scene.virtual_stiffness_n_per_m * self.state.u[c][index].wide();
                let used_n = elastic_n + self.applied.field[c][index].wide();
                let mean_n = 0.5 * (scene.damping_n_s_per_m * velocity[c] + elastic_n + applied_n[c]);
                T::of(self.model.plan.q * (mean_n - used_n))
            });
            (index, kick)
        };
        released.into_iter().map(kick).collect()
    }

    fn displacement_m(&self, index: usize) -> DVec3 {
        DVec3::from_array(std::array::from_fn(|c| self.state.u[c][index].wide()))
    }

    /// Velocity of a free point under the applied force `applied_n`: the mean of the increments of the substep just
    /// done and of the one that would follow, over its length. Second order, and at the time of the displacement.
    fn free_velocity_m_per_s(&self, index: usize, applied_n: DVec3) -> DVec3 {
        if self.steps == 0 {
            return DVec3::ZERO;
        }
        let plan = &self.model.plan;
        let stiffness = self.model.scene.virtual_stiffness_n_per_m;
        DVec3::from_array(std::array::from_fn(|c| {
            let (u, d) = (self.state.u[c][index].wide(), self.state.d[c][index].wide());
            let force_n = self.spring_n[c][index].wide() + applied_n[c] - stiffness * u;
            (d + (plan.p * d + plan.q * force_n)) / (2.0 * plan.substep_s)
        }))
    }

    /// A point that is not finite or beyond every bound, if there is one.
    fn broken_point(&self) -> Option<usize> {
        // A sum of magnitudes is small and finite only if all its terms are.
        let sum = |values: &Vec<T>| {
            let mut lanes = [T::default(); 16];
            let (blocks, rest) = values.as_chunks::<16>();
            for block in blocks {
                lanes.iter_mut().zip(block).for_each(|(lane, value)| *lane += value.magnitude());
            }
            lanes.iter().chain(rest).fold(T::default(), |sum, value| sum + value.magnitude())
        };
        let farthest = T::of(FARTHEST_IN_SHEETS * self.model.scene.sheet.longer_side_m());
        let (u, forces) = (&self.state.u, &self.spring_n);
        if u.iter().all(|u| sum(u) < farthest) && forces.iter().all(|force| sum(force).is_finite()) {
            return None;
        }
        let broken = |index: &usize| {
            let is_far = |u: &Vec<T>| !u[*index].is_finite() || u[*index].magnitude() >= farthest;
            u.iter().any(is_far) || forces.iter().any(|f| !f[*index].is_finite())
        };
        // Sums overflow before their terms do; that alone is no blow-up.
        (0..self.model.len()).find(broken)
    }
}

impl<T: Real> Tissue for Sheet<T> {
    fn model(&self) -> &Arc<Model> {
        &self.model
    }

    fn step_count(&self) -> u64 {
        self.steps
    }

    fn push(&mut self, tool: usize, push: Option<Push>) {
        self.prescribed.release(tool);
        self.applied.set(tool, push);
    }

    fn grasp(&mut self, tool: usize, index: usize, grasp: Grasp) {
        self.applied.set(tool, None);
        let PointState { displacement_m, velocity_m_per_s, .. } = self.point(index);
        let now = Motion { displacement_m, velocity_m_per_s, ..Motion::default() };
        self.prescribed.grasp(tool, index, grasp, now);
    }

    fn release(&mut self, tool: usize) {
        self.push(tool, None);
    }

    fn step(&mut self) -> Result<(), BlowUp> {
        let substeps = self.model.plan.substeps;
        for substep in 0..substeps {
            let fraction = |substep: u32| f64::from(substep) / f64::from(substeps);
            self.substep(Moment { step: self.steps, fraction: fraction(substep) }, fraction(substep + 1));
        }
        self.applied.finish(&self.model, self.steps);
        self.prescribed.finish(&self.model, self.steps);
        self.steps += 1;
        if let Some(index) = self.broken_point() {
            let blow_up = BlowUp { step: self.steps, point: self.model.point_of(index) };
            (self.steps, self.state) = self.checkpoint.clone();
            self.springs.forces(&self.state.u, &mut self.spring_n);
            return Err(blow_up);
        }
        if self.steps.is_multiple_of(CHECKPOINT_STEPS) {
            self.checkpoint.0 = self.steps;
            self.checkpoint.1.clone_from(&self.state);
        }
        Ok(())
    }

    fn point(&self, index: usize) -> PointState {
        let scene = &self.model.scene;
        let displacement_m = self.displacement_m(index);
        let applied_n = match self.steps {
            0 => self.applied.from(&self.model, index, Moment::start_of(0)),
            _ => self.applied.until(&self.model, index),
        };
        let motion = self.prescribed.motion(&self.model, index);
        let velocity_m_per_s =
            motion.map_or_else(|| self.free_velocity_m_per_s(index, applied_n), |m| m.velocity_m_per_s);
        let spring_n = DVec3::from_array(std::array::from_fn(|c| self.spring_n[c][index].wide()));
        let virtual_n = -scene.virtual_stiffness_n_per_m * displacement_m;
        let damping_n = -scene.damping_n_s_per_m * velocity_m_per_s;
        let constraint_n = motion.map(|motion| {
            let inertia_n = scene.sheet.point_mass_kg * motion.acceleration_m_per_s2;
            inertia_n - spring_n - virtual_n - damping_n - applied_n
        });
        PointState { displacement_m, velocity_m_per_s, spring_n, virtual_n, damping_n, applied_n, constraint_n }
    }

    fn energy(&self) -> Energy {
        let scene = &self.model.scene;
        let (mut speed_squared, mut displacement_squared) = (0.0, 0.0);
        for index in 0..self.model.len() {
            let point = self.point(index);
            speed_squared += point.velocity_m_per_s.length_squared();
            displacement_squared += point.displacement_m.length_squared();
        }
        Energy {
            kinetic_j: 0.5 * scene.sheet.point_mass_kg * speed_squared,
            spring_j: self.springs.energy_j(&self.state.u),
            virtual_j: 0.5 * scene.virtual_stiffness_n_per_m * displacement_squared,
        }
    }

    fn largest_displacement_m(&self) -> f64 {
        let squared = (0..self.model.len()).map(|index| self.displacement_m(index).length_squared());
        squared.fold(0.0, f64::max).sqrt()
    }

    fn displacements_m(&self, into: &mut [Vec<f32>; 3]) {
        for (into, u) in into.iter_mut().zip(&self.state.u) {
            into.clear();
            #[allow(clippy::cast_possible_truncation)]
            into.extend(u.iter().map(|u| u.wide() as f32));
        }
    }

    fn state_hash(&self) -> u128 {
        let mut hasher = Xxh3::new();
        for index in 0..self.model.len() {
            for values in self.state.u.iter().chain(&self.state.d) {
                values[index].hash_into(&mut hasher);
            }
        }
        hasher.digest128()
    }
}
