//! A saved tissue as plain data: the content of a snapshot, in a form that is independent of the program's own
//! types.
//!
//! Each type that has a part of the state converts itself to these types and back, in its own module:
//! `applied_force`, `prescribed`, `contact`, `tiles`. `restore` combines them. A change of any type here
//! changes the format of snapshots (`session::snapshot`).
//!
//! **What is saved** is everything that the next steps depend on, and nothing that follows from it. Tables (of
//! falloffs, discs, strips of a sweep) are rebuilt. The large part, the values at the points, is separate from
//! these types, as little-endian bytes: only tiles that have ever moved have values, tile by tile, then field by
//! field and row by row. That order is the same on every machine; the padding of rows is left out.
//!
//! **Memory of lists**: the sender of a snapshot decides how long its lists are. Optional parts of an entry are
//! boxed, so that no entry takes many times its bytes in memory (`session::snapshot::memory_of`).

use std::fmt;
use std::sync::Arc;

use glam::DVec3;
use palpate_haptics::{Coupling, ReportedCuts, ReportedSpring, Tip, TipShape};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::limits::Limits;
use crate::scene::action_check::{check_tie_number, check_tip};
use crate::scene::profile::{CentreProfile, LoadProfile, Motion, MotionProfile, Move, Poke, Profile, StrengthProfile};
use crate::scene::tie::{Bite, Tie, TieKind};
use crate::scene::{Integrator, Named, Precision};
use crate::shape::{PointId, RestShape};
use palpate_refusal::{Reason, Refusal, Result};

/// A vector.
pub(crate) type Vector = [f64; 3];

/// Numbers in a snapshot are below this, so that their squares are finite. No tissue reaches it: the guard ends
/// its motion long before.
pub(crate) const LARGEST: f64 = 1e150;

/// Steps and counts in a snapshot are below this, so that sums of many do not overflow and all are exact as
/// f64.
const MAX_COUNT: u64 = 1 << 48;

/// How a tissue is stepped, and its coefficients: the part of a snapshot that describes its model, not its points.
/// [`Model::resumed`] rebuilds the same model from this and the
/// scene that the session began with. Changes and corrections of the tissue are included; nothing is chosen or
/// rehearsed again, so that the model gives the same bits on every machine, under any limits and with any later
/// version that has the scheme.
///
/// [`Model::resumed`]: crate::Model::resumed
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SavedPlan {
    /// k of the structural springs, N/m; on a mesh, the reference value of which each spring has a multiple.
    pub stiffness_n_per_m: f64,
    /// k of the shear springs, N/m.
    pub shear_stiffness_n_per_m: f64,
    /// K″ of the anchor springs, N/m.
    pub anchor_stiffness_n_per_m: f64,
    /// C of the damping force, N·s/m.
    pub damping_n_s_per_m: f64,
    /// κ of the pressure in an enclosed volume, Pa; 0 without a volume.
    pub volume_stiffness_pa: f64,
    /// The integrator; never `Auto`.
    #[serde(serialize_with = "name", deserialize_with = "named")]
    pub integrator: Integrator,
    /// Substeps per step of the model's plan, 1 or more; without the halvings of the guard.
    pub substeps: u32,
    /// The number format; never `Auto`.
    #[serde(serialize_with = "name", deserialize_with = "named")]
    pub precision: Precision,
    /// Largest error that leaving out tiles at rest may add, relative to the largest displacement, from 0 to 1.
    pub sleep_tolerance: f64,
    /// The sleep tolerance that the scene or a correction sets, from which later changes of the tissue are compiled;
    /// `None` if none does, so that it is chosen.
    pub sleep_tolerance_of_scene: Option<f64>,
    /// Expected error of displacement and force, relative to the largest of each.
    pub expected_error: f64,
    /// The requirements of the last correction, which later changes of the tissue keep; `None` if the tissue was never
    /// corrected.
    pub corrected: Option<CorrectedPlan>,
}

/// What a correction requires of a tissue's later plans: a scheme, and a lower bound of the substeps. A correction
/// follows an audit that found an error above the tolerance ([`Model::correction`]). Its requirements hold until the
/// next correction or the end of the session, also when the tissue is changed.
///
/// [`Model::correction`]: crate::Model::correction
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CorrectedPlan {
    /// The integrator that the correction chose; never `Auto`.
    #[serde(serialize_with = "name", deserialize_with = "named")]
    pub integrator: Integrator,
    /// The fewest substeps per step that a later plan may have.
    pub least_substeps: u32,
}

fn name<S: Serializer>(value: &impl Named, serializer: S) -> std::result::Result<S::Ok, S::Error> {
    serializer.serialize_str(value.name())
}

fn named<'d, N: Named, D: Deserializer<'d>>(deserializer: D) -> std::result::Result<N, D::Error> {
    let name = String::deserialize(deserializer)?;
    N::named("", &name).map_err(serde::de::Error::custom)
}

/// A copy of a tissue at one step ([`Tissue::save`](crate::Tissue::save)) that any thread can convert to plain data,
/// while the tissue continues. Clones share the copy.
#[derive(Debug, Clone)]
pub struct SavedTissue(pub(crate) Arc<dyn SavedState>);

impl SavedTissue {
    /// Converts the tissue to plain data, always to the same. That takes as long as reading all of it several times,
    /// so call it outside of the thread that steps.
    pub fn plain(&self) -> PlainTissue {
        self.0.plain()
    }
}

/// A copy of a tissue in any number format.
pub(crate) trait SavedState: fmt::Debug + Send + Sync {
    fn plain(&self) -> PlainTissue;
}

/// A saved tissue as plain data, from which [`restored`](crate::restored) makes a tissue again: parts and values.
#[derive(Debug, Clone, PartialEq)]
pub struct PlainTissue {
    /// Everything but the values at the points.
    pub parts: TissueParts,
    /// The values at the points, little-endian in the tissue's number format (4 or 8 bytes each): those of each tile
    /// that has moved, then those of the checkpoint, if there is one, then those that sleeping tiles remember.
    pub values: Vec<u8>,
}

/// A saved tissue without the values at its points. Its private parts are the forces, grasps and contacts of tools,
/// the guard's account, checkpoint and inputs, and which tiles sleep.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TissueParts {
    /// Number of points of the tissue.
    pub points: u64,
    /// The model's plan and coefficients.
    pub tissue: SavedPlan,
    /// XXH3-128 hash of everything in the model that a step depends on (`Model::fingerprint`).
    pub fingerprint: u128,
    /// Number of steps done; below 2⁴⁸.
    pub steps: u64,
    pub(crate) halvings: u32,
    pub(crate) forces: SavedForces,
    pub(crate) prescribed: SavedPrescribed,
    pub(crate) contacts: Vec<SavedContact>,
    pub(crate) work: SavedWork,
    pub(crate) checkpoint: Option<SavedCheckpoint>,
    pub(crate) inputs: Vec<(u64, u64, SavedInput)>,
    pub(crate) tiles: SavedTiles,
    /// The severed springs, in the order in which they were severed, and the version of the topology.
    pub(crate) severed: Vec<SavedSpring>,
    pub(crate) topology_version: u32,
    pub(crate) guard_events: u64,
    pub(crate) substeps_done: u64,
    pub(crate) points_done: u64,
    /// The threads and clips, which a snapshot keeps behind everything else.
    #[serde(skip)]
    pub ties: SavedTies,
    /// What tips have burnt, behind these.
    #[serde(skip)]
    pub burns: SavedBurns,
    /// The energy that has gone into cuts, behind these.
    #[serde(skip)]
    pub fracture: SavedFracture,
    /// When what is burnt burns through, behind this.
    #[serde(skip)]
    pub burn_times: SavedBurnTimes,
}

impl TissueParts {
    /// Returns all that is severed, as a server reports it. Nothing is checked.
    pub fn reported_cuts(&self) -> ReportedCuts {
        let of = |spring: &SavedSpring| {
            let SavedSpring { place, number, part, .. } = *spring;
            ReportedSpring { place, number, part }
        };
        let springs = self.severed.iter().map(of).collect();
        ReportedCuts { version: self.topology_version, continues: false, springs }
    }
}

/// The state that the guard goes back to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SavedCheckpoint {
    pub(crate) steps: u64,
    pub(crate) halvings: u32,
    pub(crate) forces: SavedForces,
    pub(crate) prescribed: SavedPrescribed,
    pub(crate) contacts: Vec<SavedContact>,
    pub(crate) work: SavedWork,
    pub(crate) largest: f64,
    pub(crate) passed_checks: bool,
    /// How many of the severed springs were severed then: the first of their list.
    pub(crate) severed: u64,
}

/// A severed spring: the place in memory of its first end, its number there, the part of the way to the other end, and the
/// version of the topology since which it is severed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct SavedSpring {
    pub(crate) place: u32,
    pub(crate) number: u32,
    pub(crate) part: f64,
    pub(crate) version: u32,
}

/// The guard's account of work and energy.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct SavedWork {
    pub(crate) done_j: f64,
    pub(crate) energy_j: f64,
    pub(crate) largest_j: f64,
    pub(crate) excess_j: f64,
}

/// Which tiles sleep, and the data for waking them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SavedTiles {
    /// Tiles that may have values other than 0, in the order in which their energies are added.
    pub(crate) moved: Vec<u32>,
    /// The tiles with a value other than the default, ascending.
    pub(crate) each: Vec<SavedTile>,
    pub(crate) asleep_j: f64,
    pub(crate) largest: f64,
}

/// The state of a tile.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct SavedTile {
    pub(crate) tile: u32,
    pub(crate) awake: bool,
    pub(crate) settled: u8,
    pub(crate) drift_n: f64,
    pub(crate) energy_j: f64,
    /// By how much the volume had grown when the tile fell asleep.
    pub(crate) volume_change: f64,
}

/// An input of a tool.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum SavedInput {
    Push(Option<Box<SavedPush>>),
    Grasp(u64, SavedGrasp),
    Pose(Vector, SavedTip),
    Tie(Option<Box<SavedBites>>),
}

/// A thread or clip as it was commanded.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SavedBites {
    /// Place and radius of each bite, m.
    bites: Vec<(Vector, f64)>,
    /// Length, m, and friction of a thread; `None` for a clip.
    thread: Option<(f64, f64)>,
    strength_n: Option<f64>,
}

/// A thread or clip and what it holds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SavedTie {
    pub(crate) number: u64,
    pub(crate) tie: SavedBites,
    pub(crate) lengths_m: Vec<f64>,
    pub(crate) apart_m: Vector,
    pub(crate) forces_n: Vec<Vector>,
    pub(crate) tensions_n: Vec<f64>,
    pub(crate) peak_n: f64,
    pub(crate) is_broken: bool,
}

/// The threads and clips of a saved tissue, and those of its checkpoint. A snapshot without any has the bytes that it had before there were
/// some.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SavedTies {
    pub(crate) now: Vec<SavedTie>,
    pub(crate) at_checkpoint: Vec<SavedTie>,
}

impl SavedTies {
    /// Returns whether there are none.
    pub fn is_empty(&self) -> bool {
        self.now.is_empty() && self.at_checkpoint.is_empty()
    }
}

/// The forces of all tools.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SavedForces {
    pub(crate) slots: Vec<SavedSlot>,
    pub(crate) terms: Vec<SavedTerm>,
    pub(crate) settled: bool,
}

/// The force of a tool.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SavedSlot {
    pub(crate) push: Option<Box<SavedPush>>,
    pub(crate) before: Option<Box<SavedPoke>>,
    pub(crate) compared: Option<Box<SavedPoke>>,
}

/// Forces with the same falloff.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SavedTerm {
    pub(crate) poke: SavedPoke,
    pub(crate) forces_n: [Vector; 3],
}

/// Grasped points.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SavedPrescribed {
    pub(crate) grasped: Vec<SavedGrasped>,
    pub(crate) released: Vec<(u64, Vector)>,
}

/// A grasped point. Its index is a place in memory.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SavedGrasped {
    pub(crate) tool: u64,
    pub(crate) index: u64,
    pub(crate) grasp: SavedGrasp,
    /// Displacement, velocity and acceleration.
    pub(crate) now: [Vector; 3],
    pub(crate) held: bool,
}

/// A position-controlled tool and its state of contact.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SavedContact {
    pub(crate) number: u64,
    pub(crate) tip: SavedTip,
    pub(crate) place: SavedPlace,
    pub(crate) from_m: Vector,
    pub(crate) to_m: Vector,
    pub(crate) from_edge_m: Vector,
    /// 0 free, 1 sticking, 2 sliding, 3 holding.
    pub(crate) contact_state: u8,
    pub(crate) normal: Vector,
    pub(crate) side: SavedSide,
    pub(crate) offset_m: Vector,
    pub(crate) gap_m: Vector,
    pub(crate) is_new: bool,
    pub(crate) force_n: Vector,
    pub(crate) steady_n: Vector,
    pub(crate) velocity_m_per_s: Vector,
}

/// The side of the surface on which a tool is, 1 or -1, and how a rigid tip presses there. The first two have the bytes that an
/// `Option` has: snapshots without rigid tips stay as they were before these.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum SavedSide {
    Beside,
    On(f64),
    Pressed(f64, Box<SavedPressing>),
}

/// How a rigid tip presses: the place around which its samples were taken, the axis of the tip, by how much it is still drawn
/// back, m, and the forces (N) on samples by their number.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SavedPressing {
    pub(crate) around: SavedPlace,
    pub(crate) axis: Vector,
    pub(crate) drawn_back_m: f64,
    /// Energy of the contact, J.
    pub(crate) stored_j: f64,
    pub(crate) forces_n: Vec<(u32, Vector)>,
}

/// The place of a tip's disc on the tissue at rest, as the kind of tissue describes its places: in the plane z = 0, m, or
/// on a triangle of the surface, with the two directions along it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) enum SavedPlace {
    OfPlane([f64; 2]),
    OfTriangle { triangle: u32, barycentric: Vector, frame: [Vector; 2] },
}

/// A [`Poke`] as plain data, in a snapshot: a point or a centre (m), a force (N) and its falloff. Nothing of it is
/// checked before [`SavedPoke::restored`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SavedPoke {
    point: Option<u64>,
    centre_m: Vector,
    force_n: Vector,
    falloff_per_m: f64,
    falloff_offset: f64,
}

/// A saved [`Push`](crate::Push).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum SavedPush {
    Constant(SavedPoke),
    Profile(SavedLoad),
}

/// A saved [`LoadProfile`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SavedLoad {
    centre: SavedCentre,
    strength: SavedStrength,
    falloff_per_m: f64,
    falloff_offset: f64,
}

/// A saved [`CentreProfile`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum SavedCentre {
    Hops(Vec<(u64, Vector)>),
    Points(Vec<(u64, u64, Vector)>),
    Path { from_m: Vector, velocity_m_per_s: Vector },
}

/// A saved [`StrengthProfile`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum SavedStrength {
    Scaled(Vector, SavedProfile),
    Recorded(Vec<(u64, Vector)>),
}

/// A saved [`Profile`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
enum SavedProfile {
    Constant,
    Pulse { on: u64, off: u64 },
    Ramp { from_s: f64, to_s: f64 },
    Sine { frequency_hz: f64 },
}

/// A saved [`Grasp`](crate::Grasp).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum SavedGrasp {
    Target(Vector),
    Profile { point: u64, moves: Vec<(f64, f64, Vector)> },
}

/// A [`Tip`] as plain data, in a snapshot. Nothing of it is checked before [`SavedTip::restored`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SavedTip {
    radius_m: f64,
    friction: f64,
    /// 0 a disc that touches, 1 one that grasps, 2 a rigid disc, 3 a sphere, 4 a blade.
    kind: u8,
    coupling: SavedCoupling,
    /// The edge of a blade, m.
    edge_m: Vector,
}

/// How a tip is coupled: stiffness, N/m, and damping, N·s/m, of a spring; and after which time of contact it severs, s. The first two
/// have the bytes that an `Option` has: snapshots without tips that burn stay as they were before these.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
enum SavedCoupling {
    Constraint,
    Spring(f64, f64),
    Burning(f64, Option<(f64, f64)>),
}

/// The time for which points have been under tips that burn, in steps: by place in memory, ascending. Now, and at the checkpoint. A
/// snapshot without any has the bytes that it had before there were some.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SavedBurns {
    pub(crate) now: Vec<(u32, u32)>,
    pub(crate) at_checkpoint: Vec<(u32, u32)>,
}

impl SavedBurns {
    /// Returns whether nothing is burnt.
    pub fn is_empty(&self) -> bool {
        self.now.is_empty() && self.at_checkpoint.is_empty()
    }
}

/// In which time each burnt point burns through, s, in the order of [`SavedBurns`], and the version of the burns. Snapshots from before burns
/// were shown have none.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SavedBurnTimes {
    pub(crate) version: u32,
    pub(crate) now_s: Vec<f64>,
    pub(crate) at_checkpoint_s: Vec<f64>,
}

impl SavedBurnTimes {
    /// Returns whether nothing was ever burnt.
    pub fn is_empty(&self) -> bool {
        self.version == 0 && self.now_s.is_empty() && self.at_checkpoint_s.is_empty()
    }
}

/// The energy that has gone into cuts, J ([`Cuts::fracture_j`](crate::Cuts::fracture_j)): now, and at the checkpoint. A snapshot without
/// any has the bytes that it had before it was counted.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct SavedFracture {
    pub(crate) now_j: f64,
    pub(crate) at_checkpoint_j: f64,
}

impl SavedFracture {
    /// Returns whether no energy has gone into cuts.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

/// Checks the parts of a snapshot when it is restored, against a tissue and the limits. All its refusals name
/// [`SNAPSHOT`].
#[derive(Clone, Copy)]
pub struct Checks<'a> {
    /// The rest shape of the tissue that is restored.
    pub shape: &'a dyn RestShape,
    /// The limits of the server that restores it: `tools` and `point_force_n` are used.
    pub limits: &'a Limits,
}

/// The field that refusals of a snapshot name ([`Refusal::field`]).
pub const SNAPSHOT: &str = "snapshot";

/// Returns the refusal of a snapshot that has `what`, a fault that no session produces, such as "too few values":
/// [`Reason::OutOfRange`] of [`SNAPSHOT`], with the message "has `what`: it is damaged, …".
pub fn unsound(what: &str) -> Refusal {
    let message = format!("has {what}: it is damaged, or was not written by Palpate");
    Refusal::new(Reason::OutOfRange, SNAPSHOT, message)
}

/// Returns the refusal of a snapshot whose tool number `tool` is not below `limits.tools`: [`Reason::TooLarge`] of
/// [`SNAPSHOT`].
pub fn tool_above(tool: u64, limits: &Limits) -> Refusal {
    let message = format!("has tool {tool}, but tools are numbered below {} (limits.tools)", limits.tools);
    Refusal::new(Reason::TooLarge, SNAPSHOT, message)
}

/// Checks a condition that every snapshot of a session meets.
///
/// # Errors
/// Unless `holds`, refuses a snapshot that has `what` ([`unsound`]).
pub fn ensure(holds: bool, what: &str) -> Result<()> {
    if holds { Ok(()) } else { Err(unsound(what)) }
}

impl Checks<'_> {
    /// Checks a length, time, speed or force and returns it. Any value that a session may reach is allowed,
    /// however unlikely. The guard detects an impossible motion at the next step, as it does in the session
    /// that was saved.
    ///
    /// # Errors
    /// Refuses a number that is not finite, or of 10¹⁵⁰ and more, whose square might not be.
    pub fn number(&self, value: f64) -> Result<f64> {
        ensure(value.abs() < LARGEST, "a number that is not finite or out of range").map(|()| value)
    }

    /// Checks a vector (x, y, z) of lengths, speeds or forces and returns it.
    ///
    /// # Errors
    /// Refuses a vector with a number that [`Checks::number`] refuses.
    pub fn vector(&self, value: Vector) -> Result<DVec3> {
        value.into_iter().try_for_each(|part| self.number(part).map(drop))?;
        Ok(DVec3::from(value))
    }

    /// Checks a time of a script, s, which may be arbitrarily late or early, and returns it.
    ///
    /// # Errors
    /// Refuses a number that is not finite.
    pub fn time(&self, value: f64) -> Result<f64> {
        ensure(value.is_finite(), "a time that is not finite").map(|()| value)
    }

    /// Checks a step or a count and returns it.
    ///
    /// # Errors
    /// Refuses 2⁴⁸ and more, which no session reaches.
    pub fn count(&self, count: u64) -> Result<u64> {
        ensure(count < MAX_COUNT, "a count beyond what any session has").map(|()| count)
    }

    /// Checks the number of a tool, from 0, and returns it.
    ///
    /// # Errors
    /// Refuses a number that is not below `limits.tools` ([`tool_above`]).
    #[allow(clippy::cast_possible_truncation)]
    pub fn tool(&self, tool: u64) -> Result<usize> {
        if tool < u64::from(self.limits.tools) {
            return Ok(tool as usize);
        }
        Err(tool_above(tool, self.limits))
    }

    /// Checks the number of a thread or clip, from 0, and returns it.
    ///
    /// # Errors
    /// Refuses a number that is not below `limits.ties` ([`Reason::TooLarge`]).
    pub(crate) fn tie(&self, tie: u64) -> Result<usize> {
        let number = u32::try_from(tie).unwrap_or(u32::MAX);
        check_tie_number(SNAPSHOT, number, self.limits).map(|()| number as usize)
    }

    /// Checks the index of a point, from 0 in the numbering of [`PointId`], and returns the point.
    ///
    /// # Errors
    /// Refuses an index that is not below the number of points of the tissue.
    #[allow(clippy::cast_possible_truncation)]
    pub fn point(&self, point: u64) -> Result<PointId> {
        ensure(point < self.shape.point_count() as u64, "a point that the tissue lacks")?;
        Ok(PointId::new(point as usize))
    }

    /// Checks a force with a falloff over the points and returns it.
    fn force(&self, force_n: Vector, falloff_per_m: f64, falloff_offset: f64) -> Result<DVec3> {
        let is_falloff = (0.0..f64::INFINITY).contains(&falloff_per_m) && falloff_offset.is_finite();
        ensure(is_falloff, "a falloff that is not finite or below 0")?;
        let force_n = DVec3::from(force_n);
        let most_n = force_n.length() * libm::exp(falloff_offset);
        // A force of 0 may have any factor.
        if force_n != DVec3::ZERO && !(force_n.is_finite() && most_n <= self.limits.point_force_n) {
            let message = format!("has a force of {most_n:.6e} N, above the limit of {} N", self.limits.point_force_n);
            return Err(Refusal::new(Reason::ForceTooLarge, SNAPSHOT, message));
        }
        Ok(force_n)
    }
}

impl SavedPoke {
    /// Converts a force to plain data, without rounding.
    pub fn of(poke: &Poke) -> Self {
        let Poke { point, centre_m, force_n, falloff_per_m, falloff_offset } = *poke;
        SavedPoke {
            point: point.map(|point| point.index() as u64),
            centre_m: centre_m.into(),
            force_n: force_n.into(),
            falloff_per_m,
            falloff_offset,
        }
    }

    /// Checks a saved force against a tissue and the limits, and returns it.
    ///
    /// # Errors
    /// Refuses a point that the tissue lacks, a centre that is not finite or 10¹⁵⁰ m away, a falloff that is not
    /// finite or below 0, and a force that is not finite or above the limit `point_force_n`
    /// ([`Reason::ForceTooLarge`]).
    pub fn restored(&self, checks: &Checks<'_>) -> Result<Poke> {
        let SavedPoke { point, centre_m, force_n, falloff_per_m, falloff_offset } = *self;
        Ok(Poke {
            point: point.map(|point| checks.point(point)).transpose()?,
            centre_m: checks.vector(centre_m)?,
            force_n: checks.force(force_n, falloff_per_m, falloff_offset)?,
            falloff_per_m,
            falloff_offset,
        })
    }
}

impl SavedLoad {
    pub(crate) fn of(profile: &LoadProfile) -> Self {
        let centre = match &profile.centre {
            CentreProfile::Hops(hops) => SavedCentre::Hops(hops.iter().map(|hop| (hop.0, hop.1.into())).collect()),
            CentreProfile::Points(hops) => SavedCentre::Points(
                hops.iter().map(|(step, (point, at_m))| (*step, point.index() as u64, (*at_m).into())).collect(),
            ),
            CentreProfile::Path { from_m, velocity_m_per_s } => {
                SavedCentre::Path { from_m: (*from_m).into(), velocity_m_per_s: (*velocity_m_per_s).into() }
            }
        };
        let strength = match &profile.strength {
            StrengthProfile::Scaled(force_n, profile) => {
                let profile = match *profile {
                    Profile::Constant => SavedProfile::Constant,
                    Profile::Pulse { on, off } => SavedProfile::Pulse { on, off },
                    Profile::Ramp { from_s, to_s } => SavedProfile::Ramp { from_s, to_s },
                    Profile::Sine { frequency_hz } => SavedProfile::Sine { frequency_hz },
                };
                SavedStrength::Scaled((*force_n).into(), profile)
            }
            StrengthProfile::Recorded(rows) => {
                SavedStrength::Recorded(rows.iter().map(|row| (row.0, row.1.into())).collect())
            }
        };
        let LoadProfile { falloff_per_m, falloff_offset, .. } = *profile;
        SavedLoad { centre, strength, falloff_per_m, falloff_offset }
    }

    pub(crate) fn restored(&self, checks: &Checks<'_>) -> Result<LoadProfile> {
        let SavedLoad { centre, strength, falloff_per_m, falloff_offset } = self;
        let force = |force_n: Vector| checks.force(force_n, *falloff_per_m, *falloff_offset);
        let centre = match centre {
            SavedCentre::Hops(hops) => {
                let hops = hops.iter().map(|hop| Ok((hop.0, checks.vector(hop.1)?)));
                CentreProfile::Hops(hops.collect::<Result<_>>()?)
            }
            SavedCentre::Points(hops) => {
                let hops = hops.iter().map(|hop| Ok((hop.0, (checks.point(hop.1)?, checks.vector(hop.2)?))));
                CentreProfile::Points(hops.collect::<Result<_>>()?)
            }
            SavedCentre::Path { from_m, velocity_m_per_s } => CentreProfile::Path {
                from_m: checks.vector(*from_m)?,
                velocity_m_per_s: checks.vector(*velocity_m_per_s)?,
            },
        };
        let strength = match strength {
            SavedStrength::Scaled(force_n, profile) => {
                let profile = match *profile {
                    SavedProfile::Constant => Profile::Constant,
                    SavedProfile::Pulse { on, off } => Profile::Pulse { on, off },
                    SavedProfile::Ramp { from_s, to_s } => {
                        let (from_s, to_s) = (checks.time(from_s)?, checks.time(to_s)?);
                        ensure(from_s < to_s, "a ramp that does not rise")?;
                        Profile::Ramp { from_s, to_s }
                    }
                    SavedProfile::Sine { frequency_hz } => Profile::Sine { frequency_hz: checks.number(frequency_hz)? },
                };
                StrengthProfile::Scaled(force(*force_n)?, profile)
            }
            SavedStrength::Recorded(rows) => {
                let rows = rows.iter().map(|row| Ok((row.0, force(row.1)?)));
                StrengthProfile::Recorded(rows.collect::<Result<_>>()?)
            }
        };
        Ok(LoadProfile { centre, strength, falloff_per_m: *falloff_per_m, falloff_offset: *falloff_offset })
    }
}

/// Converts the movement of a grasped point to plain data.
pub(crate) fn saved_moves(profile: &MotionProfile) -> SavedGrasp {
    let moves = profile.moves.iter().map(|Move { from_s, to_s, by_m }| (*from_s, *to_s, (*by_m).into()));
    SavedGrasp::Profile { point: profile.point.index() as u64, moves: moves.collect() }
}

/// Checks the saved movement of a grasped point and returns it.
pub(crate) fn restored_moves(checks: &Checks<'_>, point: u64, moves: &[(f64, f64, Vector)]) -> Result<MotionProfile> {
    let moves = moves.iter().map(|(from_s, to_s, by_m)| {
        let (from_s, to_s) = (checks.time(*from_s)?, checks.time(*to_s)?);
        // Accelerations are divided by the square of this time.
        ensure(to_s - from_s > 1e-9, "a movement that takes no time")?;
        Ok(Move { from_s, to_s, by_m: checks.vector(*by_m)? })
    });
    Ok(MotionProfile { point: checks.point(point)?, moves: moves.collect::<Result<_>>()? })
}

/// Converts a motion to plain data: displacement, velocity and acceleration.
pub(crate) fn saved_motion(motion: &Motion) -> [Vector; 3] {
    [motion.displacement_m, motion.velocity_m_per_s, motion.acceleration_m_per_s2].map(Into::into)
}

/// Checks a saved motion and returns it.
pub(crate) fn restored_motion(checks: &Checks<'_>, motion: &[Vector; 3]) -> Result<Motion> {
    let [displacement_m, velocity_m_per_s, acceleration_m_per_s2] = motion.map(|v| checks.vector(v));
    Ok(Motion {
        displacement_m: displacement_m?,
        velocity_m_per_s: velocity_m_per_s?,
        acceleration_m_per_s2: acceleration_m_per_s2?,
    })
}

/// The shapes of tips and whether they grasp, in the order of [`SavedTip::kind`].
const TIP_KINDS: [(TipShape, bool); 5] = [
    (TipShape::Disc, false),
    (TipShape::Disc, true),
    (TipShape::RigidDisc, false),
    (TipShape::Sphere, false),
    (TipShape::Blade, false),
];

impl SavedBites {
    /// Converts a tie to plain data, without rounding.
    pub(crate) fn of(tie: &Tie) -> Self {
        SavedBites {
            bites: tie.bites.iter().map(|Bite { place_m, radius_m }| ((*place_m).into(), *radius_m)).collect(),
            thread: match tie.kind {
                TieKind::Thread { length_m, friction } => Some((length_m, friction)),
                TieKind::Clip => None,
            },
            strength_n: tie.strength_n,
        }
    }

    /// Returns the tie, whose numbers are finite. The rest is for [`check_tie`](crate::scene::action_check::check_tie).
    pub(crate) fn restored(&self, checks: &Checks<'_>) -> Result<Tie> {
        let bites = self.bites.iter().map(|(place_m, radius_m)| {
            Ok(Bite { place_m: checks.vector(*place_m)?, radius_m: checks.number(*radius_m)? })
        });
        let kind = self.thread.map_or(TieKind::Clip, |(length_m, friction)| TieKind::Thread { length_m, friction });
        Ok(Tie { bites: bites.collect::<Result<_>>()?, kind, strength_n: self.strength_n })
    }
}

impl SavedTip {
    /// Converts a tip to plain data, without rounding.
    #[allow(clippy::cast_possible_truncation)]
    pub fn of(tip: &Tip) -> Self {
        let Tip { shape, radius_m, friction, grasps, coupling, edge_m, burn_s } = *tip;
        let spring = match coupling {
            Coupling::Constraint => None,
            Coupling::Spring { stiffness_n_per_m, damping_n_s_per_m } => Some((stiffness_n_per_m, damping_n_s_per_m)),
        };
        let coupling = match spring {
            spring if burn_s > 0.0 => SavedCoupling::Burning(burn_s, spring),
            Some((stiffness_n_per_m, damping_n_s_per_m)) => SavedCoupling::Spring(stiffness_n_per_m, damping_n_s_per_m),
            None => SavedCoupling::Constraint,
        };
        let kind = TIP_KINDS.iter().position(|kind| *kind == (shape, grasps)).unwrap_or(0) as u8;
        SavedTip { radius_m, friction, kind, coupling, edge_m: edge_m.into() }
    }

    /// Checks a saved tip against a tissue and returns it.
    ///
    /// # Errors
    /// Refuses a tip that a command may not have either ([`check_tip`]): a radius that is not above 0 or too large for
    /// the tissue, a friction outside 0 to 10, or a coupling or a burning out of range. The field is that of `snapshot.tip`.
    pub fn restored(&self, checks: &Checks<'_>) -> Result<Tip> {
        let SavedTip { radius_m, friction, kind, coupling, edge_m } = *self;
        let (shape, grasps) =
            TIP_KINDS.get(usize::from(kind)).copied().ok_or_else(|| unsound("an unknown kind of tip"))?;
        let (burn_s, spring) = match coupling {
            SavedCoupling::Constraint => (0.0, None),
            SavedCoupling::Spring(stiffness_n_per_m, damping_n_s_per_m) => {
                (0.0, Some((stiffness_n_per_m, damping_n_s_per_m)))
            }
            SavedCoupling::Burning(burn_s, spring) => (burn_s, spring),
        };
        let coupling = spring.map_or(Coupling::Constraint, |(stiffness_n_per_m, damping_n_s_per_m)| Coupling::Spring {
            stiffness_n_per_m,
            damping_n_s_per_m,
        });
        let tip = Tip { shape, radius_m, friction, grasps, coupling, edge_m: checks.vector(edge_m)?, burn_s };
        check_tip("snapshot.tip", checks.shape, &tip)?;
        Ok(tip)
    }
}
