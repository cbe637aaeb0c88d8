//! The trait of a tissue in motion, and the types of its methods.

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

/// One mass point at the end of a step: displacement, velocity, and the forces on it. Where the applied force
/// jumps, this is the value just before the jump; at step 0, just after it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointState {
    /// Displacement from rest, m.
    pub displacement_m: DVec3,
    /// Velocity, m/s.
    pub velocity_m_per_s: DVec3,
    /// Force of all springs between points, and of an enclosed volume's pressure, N.
    pub spring_n: DVec3,
    /// Force of the anchor spring, −K″·u, N.
    pub anchor_n: DVec3,
    /// Damping force, −C·v, N.
    pub damping_n: DVec3,
    /// Force of all pushing tools, N.
    pub applied_n: DVec3,
    /// The force that holds a prescribed point, N: m·a − spring − anchor − damping − applied. `None` for other
    /// points.
    pub constraint_n: Option<DVec3>,
}

impl PointState {
    /// Returns the force of the tissue on a tool at the point, N: spring + anchor + damping.
    pub fn reaction_n(&self) -> DVec3 {
        self.spring_n + self.anchor_n + self.damping_n
    }
}

/// Energies of the whole tissue, J: sums over all points and over all springs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Energy {
    /// Kinetic energy, Σ ½m·v².
    pub kinetic_j: f64,
    /// Energy of the springs between points, Σ ½k(L − L0)², and of an enclosed volume.
    pub spring_j: f64,
    /// Energy of the anchor springs, Σ ½K″·u².
    pub anchor_j: f64,
}

/// An instability of the motion that the guard could not repair with shorter substeps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BlowUp {
    /// Steps done when the guard found it.
    pub step: u64,
    /// The check that failed.
    pub cause: CheckFailure,
}

/// How a tissue continues after a blow-up.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Released {
    /// The tools that acted in the state that the tissue went back to, ascending. They are released.
    pub tools: Vec<usize>,
    /// Whether the tissue continues at rest.
    pub at_rest: bool,
}

/// A tissue in motion, in any number format.
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
    /// Returns the model of the tissue.
    fn model(&self) -> &Arc<Model>;
    /// Returns the number of steps done.
    fn step_count(&self) -> u64;
    /// Sets the force of `tool` from the next step on; `None` ends it. The tool no longer grasps or touches.
    fn push(&mut self, tool: usize, push: Option<Push>);
    /// Makes `tool` move `point` from the next step on. The tool no longer pushes or touches.
    fn grasp(&mut self, tool: usize, point: PointId, grasp: Grasp);
    /// Makes `tool` touch the tissue with `tip` from the next step on. The tip reaches `place_m`, m, at the
    /// step's end.
    fn pose(&mut self, tool: usize, place_m: DVec3, tip: Tip);
    /// Returns the motion of a position-controlled tool and the force on it; `None` for other tools.
    fn tool_contact(&self, tool: usize) -> Option<ToolContact>;
    /// Returns a copy of the tissue around a position-controlled tool, from which the stiffness there is
    /// computed; `None` if the tool neither touches nor holds.
    fn tangent_input(&self, tool: usize) -> Option<TangentInput>;
    /// Releases `tool`: from the next step on it no longer pushes, grasps or touches.
    fn release(&mut self, tool: usize);
    /// Exchanges springs, anchor springs and damping for those of `model` from the next step on. The model
    /// comes from [`Model::changed`] of this tissue's model. Displacements and velocities stay; all tiles wake.
    fn change(&mut self, model: &Arc<Model>);
    /// Requests an audit of a window of steps, which begins at the next checkpoint. `inputs` is the memory in
    /// which the tools' inputs are recorded; it is emptied.
    fn request_audit(&mut self, inputs: WindowInputs);
    /// Takes the report on the requested window after a step: begun, ended or dropped. Returns each report
    /// once, otherwise `None`.
    fn take_mark(&mut self) -> Option<Mark>;
    /// Returns a new tissue under `model` if that is in f64 and this one is not, as after a correction;
    /// otherwise `None`: then [`Tissue::change`] applies.
    fn changed(&self, model: &Arc<Model>) -> Option<Box<dyn Tissue>>;
    /// Returns the present scheme and substep. The guard may have halved the model's substep.
    fn plan(&self) -> &Plan;
    /// Returns how many times the guard went back to a checkpoint and continued with half the substep.
    fn guard_events(&self) -> u64;
    /// Returns the step of the state that a blow-up would go back to.
    fn checkpoint_step(&self) -> u64;
    /// Returns the number of substeps done, including those that the guard repeated.
    fn substeps_done(&self) -> u64;
    /// Returns the number of points that a step computes now; the others are at rest.
    fn awake_points(&self) -> usize;
    /// Returns whether a step changes only the time, until a tool gets a command.
    fn is_still(&self) -> bool;
    /// Skips `steps` steps of a still tissue ([`Tissue::is_still`]). The result is the same as that of single
    /// steps.
    fn skip_steps(&mut self, steps: u64);
    /// Returns the fraction of all points in all substeps that were computed.
    fn computed_fraction(&self) -> f64;
    /// Advances one step.
    ///
    /// # Errors
    /// Returns a blow-up that the guard could not repair. The state is then that of the last checkpoint, which
    /// is finite.
    fn step(&mut self) -> Result<(), BlowUp> {
        while !self.step_while(&mut || true)? {}
        Ok(())
    }
    /// Advances one step. If the guard has to repeat substeps, it calls `may_go_on` in between and stops when
    /// that returns false. The result is then false, and the state belongs to no step: you may only call this
    /// function again. The result of the step does not depend on where it stops.
    ///
    /// # Errors
    /// Returns a blow-up that the guard could not repair, as [`Tissue::step`] does.
    fn step_while(&mut self, may_go_on: &mut dyn FnMut() -> bool) -> Result<bool, BlowUp>;
    /// Returns whether a step is unfinished because `step_while` stopped.
    fn is_within_step(&self) -> bool;
    /// Continues after a blow-up at step `step` (that of the blow-up), from the state of the last checkpoint.
    /// If `to_rest`, or if that state has passed no check, it continues at rest. Releases all tools and
    /// restores the model's own substep.
    fn recover(&mut self, step: u64, to_rest: bool) -> Released;
    /// Returns the state of a point.
    fn point(&self, point: PointId) -> PointState;
    /// Returns the displacement of the surface at a place of the rest shape, m, interpolated between points as
    /// in frames.
    fn surface_displacement_m(&self, place_m: DVec3) -> DVec3;
    /// Returns the force of the tissue on a tool whose force acts around a place, N: the mean of the points'
    /// reactions r with the force's weights w, Σ w·r/Σ w. It changes smoothly while the place moves.
    fn reaction_around_n(&self, poke: &Poke) -> DVec3;
    /// Returns the energies. It computes the awake points; sleeping tiles use stored values. Earlier calls do
    /// not affect the result.
    fn energy(&self) -> Energy;
    /// Returns the length of the largest displacement, m.
    fn largest_displacement_m(&self) -> f64;
    /// Writes the displacements, m, in the order of the points, with x, y and z in separate vectors. Replaces
    /// their content.
    fn displacements_m(&self, into: &mut [Vec<f32>; 3]);
    /// Writes the displacements, m, in f64, in the order of the points: x, y and z of each point together.
    /// Replaces the content.
    fn whole_displacements_m(&self, into: &mut Vec<f64>);
    /// Writes the displacements, m, in the order of frames ([`Model::shown_order`]), with x, y and z in
    /// separate vectors. Replaces their content. A frame of a mesh has zeros at places without a vertex.
    fn shown_displacements_m(&self, into: &mut [Vec<f32>; 3]);
    /// Returns the number of blocks of at most 16 points, in which the state is hashed.
    fn hash_block_count(&self) -> usize;
    /// Adds some of these blocks to a hash: everything that the future of their points depends on.
    fn hash_blocks(&self, blocks: Range<usize>, hasher: &mut Xxh3);
    /// Returns the XXH3-128 hash of the state of every point.
    fn state_hash(&self) -> u128 {
        Hashing::default().add(self, usize::MAX).unwrap_or_default()
    }
    /// Returns a copy of everything that the next steps depend on, from which another thread makes a snapshot.
    /// It leaves out a running audit.
    fn save(&self) -> SavedTissue;
    /// Returns a copy of the present tissue that another thread can read.
    fn copy(&self) -> ReadCopy;
}

/// A copy of a tissue at one moment, for reading.
pub struct ReadCopy(Box<dyn Tissue>);

impl ReadCopy {
    /// Wraps a tissue that nobody steps any more.
    pub(super) fn of(copy: Box<dyn Tissue>) -> Self {
        ReadCopy(copy)
    }

    /// Returns the model of the copied tissue.
    pub fn model(&self) -> &Model {
        self.0.model()
    }

    /// Returns the state of a point.
    pub fn point(&self, point: PointId) -> PointState {
        self.0.point(point)
    }

    /// Returns the XXH3-128 hash of the state of every point.
    pub fn state_hash(&self) -> u128 {
        self.0.state_hash()
    }

    /// Adds the next `points` points, rounded up to a block of 16, to an unfinished hash. Returns the hash once
    /// all points are in.
    pub fn hash(&self, hashing: &mut Hashing, points: usize) -> Option<u128> {
        hashing.add(&*self.0, points)
    }
}

/// An unfinished hash of a tissue's state, which is computed in slices.
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
    /// Adds at least one and at most `points` points of a tissue, rounded up to a block. Returns the hash once
    /// all points are in.
    fn add(&mut self, tissue: &(impl Tissue + ?Sized), points: usize) -> Option<u128> {
        let blocks = tissue.hash_block_count();
        let end = self.next.saturating_add(points.div_ceil(BLOCK).max(1)).min(blocks);
        tissue.hash_blocks(self.next..end, &mut self.hasher);
        self.next = end;
        (end == blocks).then(|| self.hasher.digest128())
    }
}
