//! The trait of a tissue in motion, and the types that it speaks in.

use std::ops::Range;
use std::sync::Arc;

use glam::DVec3;
use xxhash_rust::xxh3::Xxh3;

use super::model::{Model, Plan};
use crate::guard::checkpoint::CheckFailure;
use crate::kernel::field::BLOCK;
use crate::scene::profile::Poke;
use crate::select::audit_window::{Mark, WindowInputs};
use crate::shape::PointId;
use crate::state::saved::SavedTissue;
use crate::tools::applied_force::Push;
use crate::tools::contact::{TangentInput, ToolContact};
use crate::tools::prescribed::Grasp;
use palpate_haptics::Tip;

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
    pub anchor_n: DVec3,
    /// −C·v, N.
    pub damping_n: DVec3,
    /// Force of all pushing tools, N.
    pub applied_n: DVec3,
    /// For a prescribed point, the force that holds it: m·a − spring − virtual − damping − applied, N.
    pub constraint_n: Option<DVec3>,
}

impl PointState {
    /// Returns the force of the tissue on a tool at the point: spring + virtual + damping, N.
    pub fn reaction_n(&self) -> DVec3 {
        self.spring_n + self.anchor_n + self.damping_n
    }
}

/// Energies of the whole sheet, J: sums over all points, and over all springs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Energy {
    /// ½m·v².
    pub kinetic_j: f64,
    /// ½k(L − L0)² of all springs.
    pub spring_j: f64,
    /// ½K″·u².
    pub anchor_j: f64,
}

/// A failure that the guard could not repair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BlowUp {
    /// Steps done when the guard found it.
    pub step: u64,
    /// The cause.
    pub cause: CheckFailure,
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
///
/// A force of 0.1 N on one point, which an anchor spring of 5 N/m holds, brings it 20 mm down (Hooke: u = F/K″):
///
/// ```
/// use glam::DVec3;
/// use palpate_tissue::scene::PAPER;
/// use palpate_tissue::scene::profile::Poke;
/// use palpate_tissue::{Model, Push, at_rest};
///
/// let model = Model::parse("anchors", PAPER, &["sheet.points=[5, 5]", "springs.stiffness_n_per_m=0"])?;
/// let middle = model.shape().nearest(model.shape().extent().middle_m());
/// let mut tissue = at_rest(&model);
/// tissue.push(
///     0,
///     Some(Push::Constant(Poke {
///         point: Some(middle),
///         centre_m: model.shape().rest_m(middle),
///         force_n: -0.1 * DVec3::Z,
///         // e^(-c·h) of the neighbours, 33 mm away, is nothing.
///         falloff_per_m: 3000.0,
///         falloff_offset: 0.0,
///     })),
/// );
/// for _ in 0..1500 {
///     tissue.step().expect("a stable substep");
/// }
/// // 1.5 s at 1 kHz, fifteen times the time constant C/K″ = 0.1 s.
/// let state = tissue.point(middle);
/// assert!((state.displacement_m.z + 0.02).abs() < 1e-5, "{} m", state.displacement_m);
/// assert!((state.reaction_n().z - 0.1).abs() < 1e-4, "{} N", state.reaction_n());
/// # Ok::<(), palpate_refusal::Refusal>(())
/// ```
pub trait Tissue: Send {
    /// The model that it was made from.
    fn model(&self) -> &Arc<Model>;
    /// Steps done.
    fn step_count(&self) -> u64;
    /// From the coming step on `tool` exerts `push`, or no force.
    fn push(&mut self, tool: usize, push: Option<Push>);
    /// From the coming step on `tool` moves `point`.
    fn grasp(&mut self, tool: usize, point: PointId, grasp: Grasp);
    /// From the coming step on `tool` meets the sheet with `tip` and is at `place_m` at the step's end.
    fn pose(&mut self, tool: usize, place_m: DVec3, tip: Tip);
    /// The motion of a position-controlled tool and the force on it.
    fn tool_contact(&self, tool: usize) -> Option<ToolContact>;
    /// A copy of the sheet around such a tool, if it touches or holds, to compute the stiffness there.
    fn tangent_input(&self, tool: usize) -> Option<TangentInput>;
    /// From the coming step on `tool` no longer pushes, grasps or touches.
    fn release(&mut self, tool: usize);
    /// From the coming step on springs, anchor springs and damping are those of `model` (from [`Model::changed`] of
    /// this sheet's model). Displacements and velocities stay; all tiles wake.
    fn change(&mut self, model: &Arc<Model>);
    /// Requests an audit of a window of steps, which begins at the next checkpoint.
    fn request_audit(&mut self, inputs: WindowInputs);
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
    fn step(&mut self) -> Result<(), BlowUp> {
        while !self.step_while(&mut || true)? {}
        Ok(())
    }
    /// Advances one step, but stops in what the guard repeats for it where it may not go on: then the result is false, the state is that
    /// of no step, and only this may be called, again. What comes of it does not depend on where it stops.
    ///
    /// # Errors
    /// As `step`.
    fn step_while(&mut self, may_go_on: &mut dyn FnMut() -> bool) -> Result<bool, BlowUp>;
    /// Whether a step is not done yet, because `step_while` has stopped.
    fn is_within_step(&self) -> bool;
    /// After a blow-up: continues at step `step` (of the blow-up) from the state of the last checkpoint, or at rest if
    /// `to_rest` or if that state has passed no check, with all tools released and the model's own substep.
    fn recover(&mut self, step: u64, to_rest: bool) -> Released;
    /// A point.
    fn point(&self, point: PointId) -> PointState;
    /// How far the surface is moved at a place of the rest shape, m: interpolated between points as in frames.
    fn surface_displacement_m(&self, place_m: DVec3) -> DVec3;
    /// The force of the tissue on a tool whose force acts around a place, N: the mean of the points' reactions r by the
    /// weights w of the force, Σ w·r/Σ w. It changes smoothly while the place moves.
    fn reaction_around_n(&self, poke: &Poke) -> DVec3;
    /// The energies. A pass over what is awake; sleeping tiles use cached values. Earlier calls do not affect the
    /// result.
    fn energy(&self) -> Energy;
    /// Length of the largest displacement, m.
    fn largest_displacement_m(&self) -> f64;
    /// Writes the displacements, m, with x, y and z in separate vectors, in the order of the points.
    fn displacements_m(&self, into: &mut [Vec<f32>; 3]);
    /// The same in full, x, y and z of each point after the other.
    fn whole_displacements_m(&self, into: &mut Vec<f64>);
    /// Displacements in the order in which frames show them ([`Model::shown_order`]), with x, y and z in separate vectors and zeros where a frame of a mesh has
    /// places without a vertex.
    fn shown_displacements_m(&self, into: &mut [Vec<f32>; 3]);
    /// Blocks of at most 16 points, in the order in which they are hashed.
    fn hash_block_count(&self) -> usize;
    /// Adds some of these blocks to a hash: all that the future of each point depends on.
    fn hash_blocks(&self, blocks: Range<usize>, hasher: &mut Xxh3);
    /// XXH3-128 of the state of every point.
    fn state_hash(&self) -> u128 {
        Hashing::default().add(self, usize::MAX).unwrap_or_default()
    }
    /// A copy of all that the next steps depend on, from which another thread makes a snapshot. An audit under way is left out.
    fn save(&self) -> SavedTissue;
    /// A copy of the sheet as it is now, to be read by another thread.
    fn copy(&self) -> ReadCopy;
}

/// A sheet that stays as it was.
pub struct ReadCopy(Box<dyn Tissue>);

impl ReadCopy {
    /// `copy` is not stepped any more.
    pub(super) fn of(copy: Box<dyn Tissue>) -> Self {
        ReadCopy(copy)
    }

    /// Returns what it was copied from.
    pub fn model(&self) -> &Model {
        self.0.model()
    }

    /// Returns a point.
    pub fn point(&self, point: PointId) -> PointState {
        self.0.point(point)
    }

    /// Returns XXH3-128 of the state of every point.
    pub fn state_hash(&self) -> u128 {
        self.0.state_hash()
    }

    /// Adds so many points, or a few more, to the hash. Returns it when all are in.
    pub fn hash(&self, hashing: &mut Hashing, points: usize) -> Option<u128> {
        hashing.add(&*self.0, points)
    }
}

/// A hash of a state that is not finished.
pub struct Hashing {
    hasher: Box<Xxh3>,
    /// The next block of points.
    next: usize,
}

impl Default for Hashing {
    fn default() -> Self {
        Hashing { hasher: Box::new(Xxh3::new()), next: 0 }
    }
}

impl Hashing {
    /// Adds at least one and at most so many points of a tissue, rounded up to a block. Returns the hash when all are in.
    fn add(&mut self, tissue: &(impl Tissue + ?Sized), points: usize) -> Option<u128> {
        let blocks = tissue.hash_block_count();
        let end = self.next.saturating_add(points.div_ceil(BLOCK).max(1)).min(blocks);
        tissue.hash_blocks(self.next..end, &mut self.hasher);
        self.next = end;
        (end == blocks).then(|| self.hasher.digest128())
    }
}
