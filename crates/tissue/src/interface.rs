//! The trait of a tissue in motion, and the types of its methods.

use std::fmt;
use std::ops::Range;
use std::sync::Arc;

use glam::DVec3;
use xxhash_rust::xxh3::Xxh3;

use crate::audit_window::{Mark, WindowInputs};
use crate::body::model::{Model, Plan};
use crate::body::severed::Cuts;
use crate::kernel::field::BLOCK;
use crate::saved::SavedTissue;
use crate::scene::profile::Poke;
use crate::scene::tie::Tie;
use crate::shape::{PointId, PointName};
use crate::stage_times::StageTimes;
use crate::tools::applied_force::Push;
use crate::tools::burns::Burns;
use crate::tools::contact::{TangentInput, ToolContact};
use crate::tools::prescribed::Grasp;
use crate::tools::tie::TieState;
use palpate_haptics::{ReportedSpring, Tip};

/// One mass point at the end of a step: displacement, velocity, and the forces on it, as vectors in the
/// tissue's frame. Where the applied force jumps, this is the value just before the jump; at step 0, just after
/// it. [`Tissue::point`] returns it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointState {
    /// Displacement from rest, m.
    pub displacement_m: DVec3,
    /// Velocity, m/s, at the time of the displacement.
    pub velocity_m_per_s: DVec3,
    /// Force of all springs between points, and of an enclosed volume's pressure, N. In a solid that of the cells with their viscosity,
    /// of a foundation, and the weight.
    pub spring_n: DVec3,
    /// Force of the anchor spring, −K″·u, N.
    pub anchor_n: DVec3,
    /// Damping force, −C·v, N.
    pub damping_n: DVec3,
    /// Force of all pushing tools, N ([`Tissue::push`]). Forces of tools with a tip are not part of it.
    pub applied_n: DVec3,
    /// The force that holds a prescribed (grasped) point, N: m·a − spring − anchor − damping − applied, with a
    /// its acceleration. `None` for other points.
    pub constraint_n: Option<DVec3>,
}

impl PointState {
    /// Returns the force of the tissue on a tool at the point, N: spring + anchor + damping, as fields of this
    /// state. At rest it is the opposite of the tool's force.
    pub fn reaction_n(&self) -> DVec3 {
        self.spring_n + self.anchor_n + self.damping_n
    }
}

/// Energies of the whole tissue, J: sums over all points and over all springs, at the end of a step. Without
/// tools, damping only reduces their total.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Energy {
    /// Kinetic energy of all points, Σ ½m·v².
    pub kinetic_j: f64,
    /// Energy of the springs between points, Σ ½k(L − L0)², and of an enclosed volume, ½κ·ΔV²/V0.
    pub spring_j: f64,
    /// Energy of the anchor springs, Σ ½K″·u².
    pub anchor_j: f64,
}

/// Reason why a check of the guard failed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CheckFailure {
    /// A point is not finite, or is displaced by a billion times the tissue's size.
    NotFinite {
        /// One such point.
        point: PointName,
    },
    /// The energy rose by more than the tools' work and the tolerance ([`MARGIN`](crate::guard::MARGIN)).
    Energy {
        /// Energy of springs, anchor springs and motion, J.
        energy_j: f64,
        /// That energy at the last survey, J.
        before_j: f64,
        /// Work of all tools since, J.
        work_j: f64,
    },
    /// The springs' force is far from its prediction: by more than
    /// [`MAX_PREDICTION_ERROR`](crate::guard::MAX_PREDICTION_ERROR).
    Prediction {
        /// The resulting difference of a displacement, as a fraction of the largest displacement.
        part: f64,
    },
}

impl fmt::Display for CheckFailure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            CheckFailure::NotFinite { point } => {
                write!(f, "point {point} was not finite (or a billion tissues away)")
            }
            CheckFailure::Energy { energy_j, before_j, work_j } => {
                write!(
                    f,
                    "the energy rose from {before_j:.3e} J to {energy_j:.3e} J, while the tools did {work_j:.3e} J of work"
                )
            }
            CheckFailure::Prediction { part } => {
                write!(f, "the springs' force was far from its prediction, by {part:.1e} of the largest displacement")
            }
        }
    }
}

/// An instability of the motion that the guard could not repair with shorter substeps. [`Tissue::step`] returns
/// it; then [`Tissue::recover`] is the way to go on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BlowUp {
    /// Steps done when the guard found the first fault. The tissue itself went back to
    /// [`Tissue::checkpoint_step`].
    pub step: u64,
    /// The check that failed.
    pub cause: CheckFailure,
}

/// What [`Tissue::recover`] did: how a tissue continues after a blow-up.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Released {
    /// The numbers of the tools that acted in the state that the tissue went back to, ascending, each once.
    /// They are released. A tool that began to act later is not listed.
    pub tools: Vec<usize>,
    /// Whether the tissue continues at rest, with its displacements lost; otherwise it continues in the state
    /// of the checkpoint.
    pub at_rest: bool,
}

/// A tissue in motion, in any number format. [`at_rest`](crate::at_rest) creates one,
/// [`restored`](crate::restored) one from a snapshot. Tools have numbers from 0, which callers choose; memory
/// grows with the largest. Each tool pushes, grasps, touches with a tip, or does nothing. Places and vectors
/// are in the tissue's frame. Methods that take a [`PointId`] panic if the tissue has no such point.
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
    /// Returns the model of the tissue: the one it was created with, or that of the last [`Tissue::change`].
    fn model(&self) -> &Arc<Model>;
    /// Returns the number of steps done, 0 at first. Within an unfinished step ([`Tissue::is_within_step`]) it
    /// may be smaller than before.
    fn step_count(&self) -> u64;
    /// Sets the force of `tool` from the next step on, in place of its last one; `None` ends it. The tool no
    /// longer grasps or touches. The force isn't checked: see
    /// [`check_poke`](crate::scene::action_check::check_poke).
    fn push(&mut self, tool: usize, push: Option<Push>);
    /// Makes `tool` hold `point` and move it as `grasp` says, from the next step on. The tool no longer pushes
    /// or touches. Neither the point (it must not be fixed, nor grasped by another tool) nor the reach is
    /// checked.
    fn grasp(&mut self, tool: usize, point: PointId, grasp: Grasp);
    /// Makes `tool` touch the tissue with `tip` from the next step on. The tip reaches `place_m`, m, at that
    /// step's end, and stays there until its next pose. The tool no longer pushes or grasps a point. Tip and
    /// place aren't checked: see [`check_tip`](crate::scene::action_check::check_tip).
    fn pose(&mut self, tool: usize, place_m: DVec3, tip: Tip);
    /// Lays thread or clip number `number` from the next step on, or cuts it and takes it out (`None`). With the bites that it has already,
    /// only its length, friction or strength changes. Numbers are those of threads and clips alone, from 0: tools have others. Isn't
    /// checked: see [`check_tie`](crate::scene::action_check::check_tie).
    fn tie(&mut self, number: usize, tie: Option<Tie>);
    /// Returns the threads and clips, by ascending number, those that broke included.
    fn ties(&self) -> Vec<TieState>;
    /// Returns the motion of a tool with a tip ([`Tissue::pose`]) and the force on it; `None` for other tools.
    fn tool_contact(&self, tool: usize) -> Option<ToolContact>;
    /// Returns a copy of the tissue around a tool with a tip, from which another thread can compute the
    /// stiffness there. `None` for other tools, if the tip neither touches nor holds, or if there is no memory
    /// for the copy.
    fn tangent_input(&self, tool: usize) -> Option<TangentInput>;
    /// Releases `tool`: from the next step on it no longer pushes, grasps or touches. Without effect on a tool
    /// that does nothing.
    fn release(&mut self, tool: usize);
    /// Exchanges springs, anchor springs, damping, scheme and substep for those of `model` from the next step
    /// on. The model comes from [`Model::changed`] or [`Model::corrected()`] of this tissue's model, in the
    /// same number format; for f64 after another format, first ask [`Tissue::changed`]. Displacements and
    /// velocities stay; all tiles wake, halvings of the substep end, and a running audit is dropped.
    fn change(&mut self, model: &Arc<Model>);
    /// Begins to measure how long each stage of a step takes, by a clock that never goes back, ns; `None` ends it. Without
    /// a clock it costs nothing.
    fn time_stages(&mut self, now_ns: Option<fn() -> u64>);
    /// Returns what was measured since [`Tissue::time_stages`]; `None` without a clock.
    fn stage_times(&self) -> Option<&StageTimes>;
    /// Requests an audit of a window of steps, which begins at the next checkpoint. `inputs` is the memory in
    /// which the tools' inputs are recorded; it is emptied. A new request replaces one that waits or runs,
    /// without a report.
    fn request_audit(&mut self, inputs: WindowInputs);
    /// Takes the report on the requested window: begun, ended or dropped. Call it after each step: a report
    /// that isn't taken before the next checkpoint is lost or makes the window begin anew. Returns each report
    /// once, otherwise `None`.
    fn take_mark(&mut self) -> Option<Mark>;
    /// Returns a new tissue in the same state, with the same tools and steps, under `model`, if that is in f64
    /// and this one is not, as after a correction. This one stays as it is. Otherwise `None`: then
    /// [`Tissue::change`] applies.
    fn changed(&self, model: &Arc<Model>) -> Option<Box<dyn Tissue>>;
    /// Returns the present scheme and substep. The guard may have halved the substep of the model's plan up to
    /// 4 times ([`MAX_HALVINGS`](crate::state::guard::MAX_HALVINGS)).
    fn plan(&self) -> &Plan;
    /// Returns how many times the guard went back to a checkpoint and repeated the steps since with a shorter
    /// substep, successfully, or brought a solid that rested inside out to its shape. Several halvings for one fault count once; a
    /// blow-up does not count.
    fn guard_events(&self) -> u64;
    /// Returns the step of the state that a blow-up would go back to. Without a checkpoint (a still tissue, or
    /// one that has not moved yet) it is the present step.
    fn checkpoint_step(&self) -> u64;
    /// Returns the number of substeps done since the tissue was created, skipped ones and those that the guard
    /// repeated included.
    fn substeps_done(&self) -> u64;
    /// Returns what blades have severed.
    fn cuts(&self) -> Cuts;
    /// Severs the whole ones of some springs at the present step, as a blade does in one: for a client's copy of a tissue, whose cuts its
    /// server reports. It is no input of a tool, so no journal has it. Call it between steps, not within an unfinished one.
    ///
    /// # Errors
    /// Refuses springs of which the tissue lacks one ([`Reason::OutOfRange`](palpate_refusal::Reason::OutOfRange)); then it severs none.
    fn sever(&mut self, springs: &[ReportedSpring]) -> palpate_refusal::Result<()>;
    /// Returns what tips have burnt (cautery).
    fn burns(&self) -> Burns;
    /// Returns the number of points that a step computes now; the others are at rest. 0 if the whole tissue
    /// sleeps.
    fn awake_points(&self) -> usize;
    /// Returns whether a step would change only the time, until a tool gets a command: all tiles sleep, pushes
    /// are constant, and no tool grasps or has a tip.
    fn is_still(&self) -> bool;
    /// Skips `steps` steps of a still tissue, at no cost. The result is then the same as that of single steps.
    /// Whether the tissue is still ([`Tissue::is_still`]) isn't checked.
    fn skip_steps(&mut self, steps: u64);
    /// Returns the fraction, 0 to 1, of all points in all substeps that were computed since the tissue was
    /// created: the rest slept or was skipped. 1 before the first substep.
    fn computed_fraction(&self) -> f64;
    /// Advances one step, however often the guard must repeat it. If a step is unfinished, it only finishes
    /// that one.
    ///
    /// # Errors
    /// Returns a blow-up that the guard could not repair by halving the substep. The state is then that of the
    /// last checkpoint, which is finite, and the tools are those of that time: call [`Tissue::recover`] next.
    fn step(&mut self) -> Result<(), BlowUp> {
        while !self.step_while(&mut || true)? {}
        Ok(())
    }
    /// Advances one step, or continues an unfinished one. If the guard has to repeat substeps, it calls
    /// `may_go_on` in between and stops when that returns false. The result is then false, and the state
    /// belongs to no step: you may only call this function or [`Tissue::step`] again. True means that the step
    /// is done. Its result does not depend on where it stopped.
    ///
    /// # Errors
    /// Returns a blow-up that the guard could not repair, as [`Tissue::step`] does.
    fn step_while(&mut self, may_go_on: &mut dyn FnMut() -> bool) -> Result<bool, BlowUp>;
    /// Returns whether a step is unfinished because [`Tissue::step_while`] stopped.
    fn is_within_step(&self) -> bool;
    /// Continues after a blow-up, from the state of the last checkpoint. `step` is [`BlowUp::step`], to which
    /// the step count is set. If `to_rest`, or if that state has passed no check since a change or recovery,
    /// the tissue continues at rest. Releases all tools, takes out threads and clips, ends halvings of the substep, and drops a running
    /// audit.
    fn recover(&mut self, step: u64, to_rest: bool) -> Released;
    /// Returns the state of a point at the end of the last step.
    fn point(&self, point: PointId) -> PointState;
    /// Returns the displacement of the surface at a place of the rest shape, m. On a sheet it is bilinear
    /// between the four points around the place (beyond the rim, that of the rim), as in frames; on a mesh it
    /// is that of the nearest point.
    fn surface_displacement_m(&self, place_m: DVec3) -> DVec3;
    /// Returns the force of the tissue on a tool whose force acts around a place, N: the mean Σ w·r/Σ w of the
    /// reactions r ([`PointState::reaction_n`]) of the points around `poke.centre_m`. The weight w is that of
    /// the force, e^{−c·distance}, tapered to 0 at 1.5 to 4 times
    /// [`RestShape::edge_m`](crate::shape::RestShape::edge_m), so that the mean changes smoothly while the
    /// place moves. Without a point there, it is the reaction at the nearest.
    fn reaction_around_n(&self, poke: &Poke) -> DVec3;
    /// Returns the largest strain at the end of the last step near a place of the rest shape: (L − L₀)/L₀ of what joins two neighbours, one of
    /// which rests within `radius_m` (m), L₀ the length at rest. It is the strain at which a tissue tears (`[cutting] tear_strain`): of the
    /// springs between the points of a sheet or a surface, in a solid of the way between the middles of two cubes. What is severed does not
    /// count; 0 if nothing is stretched.
    fn strain_around(&self, place_m: DVec3, radius_m: f64) -> f64;
    /// Returns the energies at the end of the last step. It costs about a substep of the awake points; sleeping
    /// tiles use stored values. Earlier calls do not affect the result.
    fn energy(&self) -> Energy;
    /// Returns the length of the largest displacement of a point from rest, m. It looks at all points.
    fn largest_displacement_m(&self) -> f64;
    /// Writes the displacements from rest, m, in the order of the points, with x, y and z in separate vectors
    /// of [`Model::len`] numbers each. Replaces their content.
    fn displacements_m(&self, into: &mut [Vec<f32>; 3]);
    /// Writes the displacements from rest, m, in f64, in the order of the points: x, y and z of each point
    /// together, 3 times [`Model::len`] numbers. Replaces the content.
    fn whole_displacements_m(&self, into: &mut Vec<f64>);
    /// Writes the displacements from rest, m, in the order of frames ([`Model::shown_order`]), with x, y and z
    /// in separate vectors. Replaces their content. For a mesh they are padded at the end with zeros to whole
    /// rows of 16.
    fn shown_displacements_m(&self, into: &mut [Vec<f32>; 3]);
    /// Returns the number of blocks of at most 16 points, in which the state is hashed. It stays the same for a
    /// model.
    fn hash_block_count(&self) -> usize;
    /// Adds some of these blocks to a hash: everything that the future of their points depends on. Blocks are
    /// numbered from 0 to [`Tissue::hash_block_count`] − 1; all of them in ascending order give
    /// [`Tissue::state_hash`].
    fn hash_blocks(&self, blocks: Range<usize>, hasher: &mut Xxh3);
    /// Returns the XXH3-128 hash of the state of every point. It is the same on every machine and for every
    /// lane width; time and tools are not part of it.
    fn state_hash(&self) -> u128 {
        Hashing::default().add(self, usize::MAX).unwrap_or_default()
    }
    /// Returns a copy of everything that the next steps depend on, from which another thread makes a snapshot.
    /// It leaves out a running audit. Call it between steps, not within an unfinished one.
    fn save(&self) -> SavedTissue;
    /// Returns a copy of the present tissue that another thread can read while this one is stepped.
    fn copy(&self) -> ReadCopy;
}

/// A copy of a tissue at one moment, for reading: [`Tissue::copy`] makes it, nothing changes it, and it keeps
/// its memory until it is dropped.
pub struct ReadCopy(Box<dyn Tissue>);

impl ReadCopy {
    /// Wraps a tissue that nobody steps any more.
    pub(super) fn of(copy: Box<dyn Tissue>) -> Self {
        ReadCopy(copy)
    }

    /// Returns the model that the tissue had when the copy was made.
    pub fn model(&self) -> &Model {
        self.0.model()
    }

    /// Returns the state of a point, as [`Tissue::point`] did when the copy was made. Panics if the tissue has
    /// no such point.
    pub fn point(&self, point: PointId) -> PointState {
        self.0.point(point)
    }

    /// Returns the XXH3-128 hash of the state of every point, as [`Tissue::state_hash`] did when the copy was
    /// made. It reads the whole state; [`ReadCopy::hash`] does so in slices.
    pub fn state_hash(&self) -> u128 {
        self.0.state_hash()
    }

    /// Adds the next `points` points, rounded up to a block of 16 (at least one block), to an unfinished hash,
    /// which must begin as `Hashing::default()` and see this copy only. Returns the hash
    /// ([`ReadCopy::state_hash`]) once all points are in, before that `None`.
    pub fn hash(&self, hashing: &mut Hashing, points: usize) -> Option<u128> {
        hashing.add(&*self.0, points)
    }
}

/// An unfinished hash of the state of one [`ReadCopy`], which is computed in slices: begin with
/// `Hashing::default()`, and call [`ReadCopy::hash`] until it returns the hash.
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
