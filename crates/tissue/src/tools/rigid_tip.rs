//! Rigid tips: a flat disc or a sphere to which the surface of the tissue yields, so that its pressure is part of the solution.
//!
//! The surface near the tip is divided into samples ([`SurfaceSample`]) of area A. A sample that is by g within the tip is
//! pushed along d, out of the tip, by p·A with p = s·g. The contact stiffness s stands for what happens within a cell, which cells
//! of edge h can't show: with none of it a rigid tip of a few cells would be too stiff, by about half a cell more of radius. So
//! s = [`CONTACT_STIFFNESS`]·E/((1 − ν²)·h), with E that of the cell. Block of 60 × 60 × 30 mm, E = 8 kPa, ν = 0.45, rigid disc of 5 mm,
//! in the middle of a cell, of an edge and on a corner of cells of 5, 3 and 2.5 mm:
//!
//! | s·(1 − ν²)·h/E | N/m (theory: 8.1 % above the 107.4 of an even pressure, 116.0) |
//! |---|---|
//! | 3 | 98 to 109 |
//! | 5 | 110 to 117 |
//! | 8 | 120 to 125 |
//! | 100 | 140 to 165 |
//!
//! So samples may outnumber the points that they move: a condition for each could not be met. At the rim of a disc the area of a
//! sample falls to 0, so that it slides without jumps. Which samples it covers depends on its place at rest, so that the contact
//! has one energy as long as the disc does not slide; sliding takes the change of it.
//!
//! A sphere has a core that no sample enters: with b the distance from its surface to the core, p = s·g/(1 − g/b). A sample that
//! passed the centre would be pushed out on the wrong side.
//!
//! In each substep the tissue first moves under the forces F of the last one; the change of F is an impulse at the substep's
//! beginning, so that at its end f = s·A·g ≥ 0 holds for all samples at once, however large s is. Each impulse moves
//! the neighbours too. The equations are solved by sweeps over the samples, each of which solves its own (projected
//! Gauss–Seidel); forces of the substep before are the first guess.
//!
//! Friction holds a sample to the movement of the tip, by a force across d of at most μ·f.
//!
//! A disc turns as the surface at rest does along which it slides, and begins with the direction of the surface that it meets.
//! (One that kept its direction dug its rim into a curved surface that it slid over, and jumped; one that the torque of its
//! samples turns tips over when it is as deep as its radius.)
//!
//! A tool that is placed within the tissue, or that jumps into it, comes in along its axis at a bounded speed
//! ([`MAX_DEEPENING`]). The work of a tool is F·ẋ with x the place that it has then.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use glam::DVec3;

use crate::body::disc::SurfaceSample;
use crate::body::footprint::Footprint;
use crate::body::model::{Model, Plan, displacement_m};
use crate::kernel::field::{Layout, State};
use crate::kernel::real::Real;
use crate::kernel::region::TILE;
use crate::saved::{Checks, SavedPlace, SavedPressing, ensure, unsound};
use crate::scene::Body;
use crate::shape::{CellPlace, PointId};
use palpate_haptics::{ContactState, Tip, TipShape};
use palpate_refusal::Result;

/// The contact stiffness s, relative to E/((1 − ν²)·h).
const CONTACT_STIFFNESS: f64 = 6.0;

/// Distance b from the surface of a sphere to its core, divided by its radius; and the part of it up to which s grows.
const TO_CORE: f64 = 0.6;
const LARGEST_PART: f64 = 0.95;

/// Most sweeps over the samples in a substep. Forces change little from one substep to the next, so that a few suffice.
const SWEEPS: usize = 8;

/// The sweeps end when none has changed a force by more than this part of the largest one.
const SETTLED: f64 = 1e-5;

/// Samples are at most this part of the radius apart, and at most a cell; where triangles are finer than half of that, they are joined.
const SPACING: f64 = 0.35;

/// Samples are taken as far around the tool as this, times the radius: half of the surface of a sphere that is deep within the
/// tissue touches it. They are taken anew when the tool has moved by the second.
const AROUND: f64 = 1.625;
const TAKEN_ANEW: f64 = 0.125;

/// The disc of the tool follows it along the surface when it is so far off, divided by the radius.
const OFF: f64 = 1.0 / 64.0;

/// A tip goes deeper by at most this part of a cell in a substep, and what it does not follow decreases by as much.
const MAX_DEEPENING: f64 = 0.05;

/// The cosine between the outward normal of a sample and the direction from which a tip presses it: none of the sample counts up
/// to the first, all from the second on. A sample that counted at once, as deep as it was, would make the tip jump.
const FACING: f64 = 0.1;
const FACING_WHOLLY: f64 = 0.2;

/// A sample whose points can move less than this part of what one free point with all of its weight would is as good as fixed,
/// and the tip does not feel it.
const FIXED_PART: f64 = 1e-3;

/// Time of a sample that is touched, in a substep, divided by that of looking up one triangle of a disc of even pressure.
const LOOKUPS_PER_SAMPLE: f64 = 50.0;

/// Returns the time of a substep with a rigid tip of `radius_m` (m) on cells of `edge_m` (m), in triangles that a disc of even
/// pressure would look up.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub fn rigid_tip_work(radius_m: f64, edge_m: f64) -> u64 {
    let samples = std::f64::consts::PI * (AROUND * radius_m / spacing_m(radius_m, edge_m)).powi(2);
    (LOOKUPS_PER_SAMPLE * samples) as u64
}

/// A part of the surface near a tip, and the points that it moves with.
#[derive(Debug)]
struct ContactSample {
    rest_m: DVec3,
    outward: DVec3,
    /// s·A of the whole sample divided by the modulus of the tissue, m.
    relative_stiffness_m: f64,
    /// Its points in [`RigidTip::nodes`], with their weights.
    nodes: [u32; 8],
    weights: [f64; 8],
    /// w/mass of each, 0 if the point is fixed.
    moves: [f64; 8],
    /// Σ w²/mass over its movable points.
    relative_inverse_mass: f64,
}

impl ContactSample {
    /// Returns whether the tip feels it.
    fn yields(&self) -> bool {
        self.relative_inverse_mass > FIXED_PART
    }

    /// Returns the weighted sum of what its points have.
    fn mean(&self, of: impl Fn(usize) -> DVec3) -> DVec3 {
        let mut sum = DVec3::ZERO;
        for k in 0..self.nodes.len() {
            sum += self.weights[k] * of(self.nodes[k] as usize);
        }
        sum
    }
}

/// A point that samples move with.
#[derive(Debug, Clone, Copy)]
struct TouchedPoint {
    point: [usize; 2],
    place: usize,
    /// 1/mass, relative to the reference mass; 0 if it is fixed.
    inverse_mass: f64,
}

/// A sample that the tip touches in a substep.
#[derive(Debug, Clone, Copy)]
struct TouchedSample {
    sample: usize,
    /// Unit vector out of the tip.
    way: DVec3,
    /// Depth within the tip before the impulses, m, beyond that at which the tangent of the law is 0.
    deep_m: f64,
    /// Movement along the surface relative to the tip before the impulses, m.
    slip_m: DVec3,
    /// s·A of the part of the sample that counts, N/m.
    counted_n_per_m: f64,
    /// Change of the force with the depth, N/m.
    stiffness_n_per_m: f64,
    /// Whether it had no force, and counts in part.
    enters: bool,
    /// Depth by which it may be deeper than its force at the end of the last substep says, m.
    sudden_m: f64,
}

/// Where samples were taken: the place, its rest position, m, and the unit normal out of the tissue there.
#[derive(Debug, Clone, Copy)]
struct SamplesPlace {
    saved: SavedPlace,
    rest_m: DVec3,
    outward: DVec3,
}

/// What a tip did in a substep.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct TipPress {
    /// Force on the tissue, N.
    pub(crate) force_n: DVec3,
    /// Movement of the place that the tip had, m.
    pub(crate) moved_m: DVec3,
    pub(crate) contact_state: Option<ContactState>,
    /// Energy of the samples that begin to count while the tip is deeper than they are, J.
    pub(crate) entered_j: f64,
}

/// How the tip of a tool presses.
#[derive(Debug, Clone)]
pub(crate) struct RigidTip {
    tip: Tip,
    samples: Arc<[ContactSample]>,
    nodes: Arc<[TouchedPoint]>,
    /// A point of each tile that has any of these.
    wakes: Arc<[[usize; 2]]>,
    /// The samples that may have a force: those that the tip covers, and those that have one; and their points. Ascending.
    under: Vec<u32>,
    under_nodes: Vec<u32>,
    around: Option<SamplesPlace>,
    /// s·A of each sample where the tip is, N/m, and the rest position of that place, m, with the modulus of the tissue, Pa;
    /// `None` after samples were taken.
    stiffness_n_per_m: Vec<f64>,
    covers: Option<(DVec3, f64)>,
    /// Unit vector along which the tool met the tissue, out of the tissue.
    axis: DVec3,
    /// By how much the tip is behind the tool along the axis, m.
    drawn_back_m: f64,
    /// Force on each sample at the end of the last substep, N.
    forces_n: Vec<DVec3>,
    /// Energy of the contact, J.
    stored_j: f64,
    /// Σ w·F at each point, N: it goes on in the next substep.
    steady_n: Vec<DVec3>,
    /// Σ w·ΔF/mass at each point, N, for the masses relative to the reference mass.
    change_n: Vec<DVec3>,
    /// Displacement of each point, m, and its movement in the substep, spacings; kept, so that a step allocates nothing.
    displacements_m: Vec<DVec3>,
    movements: Vec<DVec3>,
    touched: Vec<TouchedSample>,
}

impl RigidTip {
    pub(crate) fn new(tip: Tip) -> Self {
        RigidTip {
            tip,
            samples: Arc::default(),
            nodes: Arc::default(),
            wakes: Arc::default(),
            under: Vec::new(),
            under_nodes: Vec::new(),
            around: None,
            stiffness_n_per_m: Vec::new(),
            covers: None,
            axis: DVec3::Z,
            drawn_back_m: 0.0,
            forces_n: Vec::new(),
            stored_j: 0.0,
            steady_n: Vec::new(),
            change_n: Vec::new(),
            displacements_m: Vec::new(),
            movements: Vec::new(),
            touched: Vec::new(),
        }
    }

    pub(crate) fn saved(&self) -> Option<SavedPressing> {
        let around = self.around?.saved;
        let numbered = self.forces_n.iter().zip(0..).filter(|(force_n, _)| **force_n != DVec3::ZERO);
        Some(SavedPressing {
            around,
            axis: self.axis.into(),
            drawn_back_m: self.drawn_back_m,
            stored_j: self.stored_j,
            forces_n: numbered.map(|(force_n, number)| (number, (*force_n).into())).collect(),
        })
    }

    /// Restores a tip whose disc is `footprint`.
    pub(crate) fn restored(
        saved: Option<&SavedPressing>,
        tip: Tip,
        footprint: &Footprint,
        model: &Model,
        checks: &Checks<'_>,
    ) -> Result<Self> {
        let mut restored = Self::new(tip);
        let Some(saved) = saved else { return Ok(restored) };
        restored.take_samples(model, &Footprint::restored(model, tip.radius_m, &saved.around)?);
        restored.axis = checks.vector(saved.axis)?;
        ensure((restored.axis.length() - 1.0).abs() < 1e-6, "a tool whose axis has no direction")?;
        (restored.drawn_back_m, restored.stored_j) =
            (checks.number(saved.drawn_back_m)?, checks.number(saved.stored_j)?);
        ensure(restored.drawn_back_m.min(restored.stored_j) >= 0.0, "a tool that is drawn back by no length")?;
        for (number, force_n) in &saved.forces_n {
            let of_sample = restored.forces_n.get_mut(*number as usize);
            *of_sample.ok_or_else(|| unsound("a force on a part of the surface that the tissue lacks"))? =
                checks.vector(*force_n)?;
        }
        restored.cover(model, footprint);
        restored.spread();
        Ok(restored)
    }

    /// Lets the tip move with the copies of corners that its disc has got, on the same part of the surface.
    pub(crate) fn follow_cuts(&mut self, model: &Model, footprint: &Footprint) {
        let Some(around) = self.around else { return };
        if let Ok(taken_from) = footprint.at_saved(model, &around.saved) {
            self.take_samples(model, &taken_from);
            self.cover(model, footprint);
        }
    }

    /// Returns whether the tip pressed in the last substep.
    pub(crate) fn is_pressing(&self) -> bool {
        self.forces_n.iter().any(|force_n| *force_n != DVec3::ZERO)
    }

    /// Returns the least corners of the cubes in which the samples lie that the tip presses, some of them often. `footprint` is its disc.
    pub(crate) fn pressed_cubes<'t>(&'t self, footprint: &'t Footprint) -> impl Iterator<Item = usize> + 't {
        let pressed = self.samples.iter().zip(&self.forces_n).filter(|(_, force_n)| **force_n != DVec3::ZERO);
        // The corner itself, also where the sample moves with a copy of it.
        pressed.map(|(sample, _)| footprint.corner_of(self.nodes[sample.nodes[0] as usize].place))
    }

    /// Changes the friction of the tip.
    pub(crate) fn set_friction(&mut self, friction: f64) {
        self.tip.friction = friction;
    }

    /// Returns the energy of the contact, J.
    pub(crate) fn stored_j(&self) -> f64 {
        self.stored_j
    }

    /// Returns the points that the tip may move.
    pub(crate) fn points(&self) -> impl Iterator<Item = [usize; 2]> {
        self.nodes.iter().map(|node| node.point)
    }

    /// Returns a point of each tile that has one of these.
    pub(crate) fn wakes(&self) -> impl Iterator<Item = [usize; 2]> {
        self.wakes.iter().copied()
    }

    /// Returns the points that the tip moves, with their numbers.
    fn moved_nodes(&self) -> impl Iterator<Item = (usize, &TouchedPoint)> {
        self.under_nodes.iter().map(|node| (*node as usize, &self.nodes[*node as usize]))
    }

    /// Returns the continuing force on a point, N.
    pub(crate) fn steady_on(&self, place: usize) -> DVec3 {
        let found = self.nodes.binary_search_by_key(&place, |node| node.place);
        found.map_or(DVec3::ZERO, |node| self.steady_n[node])
    }

    /// Lets the force of the last substep act during this one.
    pub(crate) fn go_on<T: Real>(&self, model: &Model, plan: &Plan, layout: &Layout, state: &mut State<T>) {
        let forces = self.moved_nodes().map(|(number, node)| (node, node.inverse_mass * self.steady_n[number]));
        push(forces, plan.force_scale(&model.scene), plan.scheme.constant(), layout, state);
    }

    /// Applies the impulses that [`RigidTip::press`] found.
    pub(crate) fn kick<T: Real>(&self, model: &Model, plan: &Plan, layout: &Layout, state: &mut State<T>) {
        let changes = self.moved_nodes().map(|(number, node)| (node, self.change_n[number]));
        push(changes, plan.force_scale(&model.scene), plan.scheme.kick(), layout, state);
    }

    /// Returns the points that impulses and steady forces move by more than `far` spacings.
    pub(crate) fn moved(&self, model: &Model, plan: &Plan, far: f64) -> impl Iterator<Item = [usize; 2]> {
        let (scale, kick, constant) = (plan.force_scale(&model.scene), plan.scheme.kick(), plan.scheme.constant());
        let all = self.moved_nodes().map(|(number, node)| (node, self.change_n[number], self.steady_n[number]));
        let moves = move |c: usize, node: &TouchedPoint, change_n: DVec3, steady_n: DVec3| {
            scale * (kick[c] * change_n + constant[c] * node.inverse_mass * steady_n).abs().max_element()
        };
        all.filter(move |(node, change_n, steady_n)| {
            moves(0, node, *change_n, *steady_n).max(moves(1, node, *change_n, *steady_n)) > far
        })
        .map(|(node, ..)| node.point)
    }

    /// Returns the points that an impulse moves, with that movement in spacings.
    pub(crate) fn movements(&self, model: &Model, plan: &Plan) -> impl Iterator<Item = ([usize; 2], DVec3)> {
        let of = plan.force_scale(&model.scene) * plan.scheme.kick()[0];
        self.moved_nodes().map(move |(number, node)| (node.point, of * self.change_n[number]))
    }

    /// Takes samples around a disc's place, if those that it has are of another part of the surface.
    fn take_samples_near(&mut self, model: &Model, footprint: &Footprint) {
        let far_m = TAKEN_ANEW * self.tip.radius_m;
        let anchor_m = footprint.anchor_m();
        // On a thin part of the tissue, the other side is near.
        let is_other = |around: &SamplesPlace| {
            around.rest_m.distance(anchor_m) > far_m || around.outward.dot(footprint.at_rest().1) < 0.5
        };
        if self.around.as_ref().is_none_or(is_other) {
            self.take_samples(model, footprint);
        }
    }

    #[allow(clippy::cast_possible_truncation)]
    fn take_samples(&mut self, model: &Model, footprint: &Footprint) {
        let Tip { radius_m, .. } = self.tip;
        let taken = footprint.samples(AROUND * radius_m, spacing_m(radius_m, model.unit_m));
        let place_of = |point: &u32| model.place_of(PointId::new(*point as usize));
        let corners = |sample: &SurfaceSample| match sample.copies {
            Some(places) => places.map(|place| place as usize),
            None => sample.cell.points.map(|point| place_of(&point)),
        };
        let mut places: Vec<usize> = taken.iter().flat_map(corners).collect();
        places.sort_unstable();
        places.dedup();
        let node = |place: usize| {
            let is_fixed = model.fixed.binary_search(&footprint.corner_of(place)).is_ok();
            let inverse_mass = if is_fixed { 0.0 } else { footprint.mass_at(model, place).recip() };
            TouchedPoint { point: model.point_of(place), place, inverse_mass }
        };
        let nodes: Arc<[TouchedPoint]> = places.iter().map(|place| node(*place)).collect();
        let sample = |sample: &SurfaceSample| {
            let number = |corner: usize| places.partition_point(|place| *place < corner) as u32;
            let mut numbers = [0; 8];
            numbers.iter_mut().zip(corners(sample)).for_each(|(of, corner)| *of = number(corner));
            let weights = sample.cell.weights;
            let parts =
                numbers.iter().zip(&weights).map(|(node, weight)| weight * weight * nodes[*node as usize].inverse_mass);
            ContactSample {
                rest_m: sample.rest_m,
                outward: sample.outward,
                relative_stiffness_m: relative_contact_per_m(model, &sample.cell) * sample.area_m2,
                nodes: numbers,
                weights,
                moves: std::array::from_fn(|k| weights[k] * nodes[numbers[k] as usize].inverse_mass),
                relative_inverse_mass: parts.sum(),
            }
        };
        let samples: Arc<[ContactSample]> = taken.iter().map(sample).collect();
        // Forces stay with the parts of the surface that they act on.
        let mut forces_n = vec![DVec3::ZERO; samples.len()];
        let mut stiffness_n_per_m = vec![0.0; samples.len()];
        let key = |sample: &ContactSample| {
            (sample.rest_m.to_array().map(f64::to_bits), sample.outward.to_array().map(f64::to_bits))
        };
        let numbers: BTreeMap<_, _> = samples.iter().zip(0..).map(|(sample, number)| (key(sample), number)).collect();
        let before = self.forces_n.iter().enumerate().filter(|(_, force_n)| **force_n != DVec3::ZERO);
        for (old, force_n) in before {
            if let Some(number) = numbers.get(&key(&self.samples[old])).copied() {
                let number: usize = number;
                (forces_n[number], stiffness_n_per_m[number]) = (*force_n, self.stiffness_n_per_m[old]);
            }
        }
        self.around = Some(SamplesPlace {
            saved: footprint.saved(),
            rest_m: footprint.anchor_m(),
            outward: footprint.at_rest().1,
        });
        self.covers = None;
        let mut tiles = BTreeSet::new();
        let is_first = |point: &[usize; 2]| tiles.insert(point.map(|at| at / TILE));
        self.wakes = nodes.iter().map(|node| node.point).filter(is_first).collect();
        for of_nodes in [&mut self.steady_n, &mut self.change_n, &mut self.displacements_m, &mut self.movements] {
            of_nodes.clear();
            of_nodes.resize(nodes.len(), DVec3::ZERO);
        }
        (self.samples, self.nodes, self.forces_n, self.stiffness_n_per_m) =
            (samples, nodes, forces_n, stiffness_n_per_m);
        self.list_under();
        self.spread();
    }

    /// Lists the samples that may have a force: around a disc, most can't.
    #[allow(clippy::cast_possible_truncation)]
    fn list_under(&mut self) {
        let RigidTip { samples, forces_n, stiffness_n_per_m, .. } = self;
        let may_press = |number: &usize| {
            let is_covered = stiffness_n_per_m[*number] > 0.0 && samples[*number].yields();
            is_covered || forces_n[*number] != DVec3::ZERO
        };
        self.under = (0..samples.len()).filter(may_press).map(|number| number as u32).collect();
        self.under_nodes = self.under.iter().flat_map(|number| samples[*number as usize].nodes).collect();
        self.under_nodes.sort_unstable();
        self.under_nodes.dedup();
    }

    /// Spreads the forces on samples over the points.
    fn spread(&mut self) {
        for node in &self.under_nodes {
            self.steady_n[*node as usize] = DVec3::ZERO;
        }
        for number in &self.under {
            let (sample, force_n) = (&self.samples[*number as usize], &self.forces_n[*number as usize]);
            if *force_n == DVec3::ZERO {
                continue;
            }
            for (node, weight) in sample.nodes.iter().zip(sample.weights) {
                self.steady_n[*node as usize] += weight * *force_n;
            }
        }
    }

    /// Lets the tip be where `footprint` is, on a surface whose normal there is `outward`: it meets the tissue along this.
    /// Returns the energy that the contact takes because other samples are under the tip, J.
    pub(crate) fn follow(&mut self, model: &Model, footprint: &Footprint, outward: DVec3) -> f64 {
        self.take_samples_near(model, footprint);
        if !self.is_pressing() {
            self.axis = outward;
        }
        self.cover(model, footprint)
    }

    /// Lets the tip cover what is under a disc. Returns the energy that the contact takes, J.
    fn cover(&mut self, model: &Model, footprint: &Footprint) -> f64 {
        let covers = Some((footprint.anchor_m(), model.youngs_modulus_pa()));
        if self.covers == covers {
            return 0.0;
        }
        // A tissue that has changed is no work of the tool.
        let is_same = self.covers.is_none_or(|(_, before_pa)| before_pa == model.youngs_modulus_pa());
        self.covers = covers;
        let mut gained_j = 0.0;
        let (anchor_m, rest_outward) = (footprint.anchor_m(), footprint.at_rest().1);
        let modulus_pa = model.youngs_modulus_pa();
        for (number, sample) in self.samples.iter().enumerate() {
            let now = modulus_pa
                * sample.relative_stiffness_m
                * self.part_under(sample, anchor_m, rest_outward, model.unit_m);
            let before = std::mem::replace(&mut self.stiffness_n_per_m[number], now);
            if before > 0.0 && is_same {
                gained_j += 0.5 * (now - before) * (self.forces_n[number].length() / before).powi(2);
            }
        }
        self.list_under();
        gained_j
    }

    /// Returns the part of a sample that is under the tip.
    fn part_under(&self, sample: &ContactSample, anchor_m: DVec3, outward: DVec3, edge_m: f64) -> f64 {
        let Tip { shape, radius_m, .. } = self.tip;
        if shape == TipShape::Sphere {
            return 1.0;
        }
        let from_m = sample.rest_m - anchor_m;
        let across_m = (from_m - from_m.dot(outward) * outward).length();
        ((radius_m - across_m) / spacing_m(radius_m, edge_m) + 0.5).clamp(0.0, 1.0)
    }

    /// Returns how far the disc of a tool is from it along the surface where it must follow, m.
    pub(crate) fn off_m(&self, gap_m: DVec3, outward: DVec3) -> Option<DVec3> {
        let beside_m = gap_m - gap_m.dot(outward) * outward;
        (beside_m.length() > OFF * self.tip.radius_m).then_some(beside_m)
    }

    /// Returns whether a tip is too far from the surface to touch it: `gap_m` is the vector from the surface to the tool.
    pub(crate) fn is_far(&self, gap_m: DVec3) -> bool {
        gap_m.length() > (1.0 + AROUND) * self.tip.radius_m
    }

    /// Finds the impulses under which the tissue is where the tip lets it be at the end of a substep, for a tool that is at
    /// `place_m` then and moves by `own_m` in the substep. `state` includes the effect of the force of the last substep.
    pub(crate) fn press<T: Real>(
        &mut self,
        model: &Model,
        plan: &Plan,
        layout: &Layout,
        state: &State<T>,
        [place_m, own_m]: [DVec3; 2],
    ) -> TipPress {
        let deeper_m = MAX_DEEPENING * model.unit_m;
        let before_m = self.drawn_back_m;
        self.drawn_back_m = (self.drawn_back_m - deeper_m).max(0.0);
        let moved_m = |tip: &Self| own_m + (tip.drawn_back_m - before_m) * tip.axis;
        self.find_touched(model, layout, state, place_m + self.drawn_back_m * self.axis, moved_m(self));
        let too_deep_m = |tip: &Self| {
            let over = tip.touched.iter().filter(|touched| touched.stiffness_n_per_m > 0.0).map(|touched| {
                let pressed_n = tip.forces_n[touched.sample].dot(touched.way).max(0.0);
                touched.deep_m - pressed_n / touched.stiffness_n_per_m - touched.sudden_m
            });
            over.fold(0.0, f64::max)
        };
        let over_m = too_deep_m(self);
        if over_m > 0.0 {
            self.drawn_back_m += over_m;
            self.find_touched(model, layout, state, place_m + self.drawn_back_m * self.axis, moved_m(self));
            // Where the axis is not the way out of the tip, some are still too deep.
            for touched in &mut self.touched {
                let pressed_n = self.forces_n[touched.sample].dot(touched.way).max(0.0);
                let most_m = pressed_n / touched.stiffness_n_per_m.max(f64::MIN_POSITIVE) + 2.0 * touched.sudden_m;
                touched.deep_m = touched.deep_m.min(most_m);
            }
        }
        let slides = self.solve(model, plan);
        let mut pressed = TipPress { moved_m: moved_m(self), ..TipPress::default() };
        self.stored_j = 0.0;
        let mut is_pressing = false;
        for touched in &self.touched {
            let force_n = self.forces_n[touched.sample];
            pressed.force_n += force_n;
            is_pressing |= force_n != DVec3::ZERO;
            if touched.counted_n_per_m > 0.0 {
                let stored_j = stored_j(touched.counted_n_per_m, force_n.dot(touched.way), to_core_m(&self.tip));
                self.stored_j += stored_j;
                pressed.entered_j += if touched.enters { stored_j } else { 0.0 };
            }
        }
        if is_pressing {
            pressed.contact_state = Some(if slides { ContactState::Sliding } else { ContactState::Sticking });
        } else {
            self.drawn_back_m = 0.0;
        }
        self.spread();
        pressed
    }

    /// Turns a disc as the surface at rest turns between two outward normals, while the tool is at `place_m`. Returns the work that
    /// this takes, J.
    pub(crate) fn turn<T: Real>(
        &mut self,
        model: &Model,
        layout: &Layout,
        state: &State<T>,
        place_m: DVec3,
        [from, to]: [DVec3; 2],
    ) -> f64 {
        let turn = from.cross(to);
        if self.tip.shape == TipShape::Sphere || turn == DVec3::ZERO {
            return 0.0;
        }
        self.axis = (self.axis + turn.cross(self.axis)).normalize();
        let mut torque_n_m = DVec3::ZERO;
        for (sample, force_n) in self.samples.iter().zip(&self.forces_n).filter(|(_, force_n)| **force_n != DVec3::ZERO)
        {
            let moved_m = sample.mean(|node| displacement_m(model, layout, state, self.nodes[node].point));
            torque_n_m += (sample.rest_m + moved_m - place_m).cross(*force_n);
        }
        torque_n_m.dot(turn)
    }

    /// Finds the samples within the tip, and those that it pressed before.
    fn find_touched<T: Real>(
        &mut self,
        model: &Model,
        layout: &Layout,
        state: &State<T>,
        place_m: DVec3,
        own_m: DVec3,
    ) {
        let Tip { shape, radius_m, .. } = self.tip;
        let RigidTip { samples, nodes, axis, .. } = self;
        let (axis, to_core_m) = (*axis, to_core_m(&self.tip));
        for node in self.under_nodes.iter().map(|node| *node as usize) {
            let point = nodes[node].point;
            self.displacements_m[node] = displacement_m(model, layout, state, point);
            let component = |c: usize| state.d[c * layout.plane + point[0] * layout.stride + point[1]].wide();
            self.movements[node] = DVec3::new(component(0), component(1), component(2));
        }
        self.touched.clear();
        for number in self.under.iter().map(|number| *number as usize) {
            let sample = &samples[number];
            let force_n = self.forces_n[number];
            let counted_n_per_m = |way: DVec3| {
                let facing = ((-way.dot(sample.outward) - FACING) / (FACING_WHOLLY - FACING)).clamp(0.0, 1.0);
                if sample.yields() { facing * self.stiffness_n_per_m[number] } else { 0.0 }
            };
            // Where a sample is that faces away from a disc does not matter.
            if shape != TipShape::Sphere && force_n == DVec3::ZERO && counted_n_per_m(-axis) == 0.0 {
                continue;
            }
            let moved_m = sample.mean(|node| self.displacements_m[node]);
            let from_m = sample.rest_m + moved_m - place_m;
            let is_within = match shape {
                TipShape::Sphere => from_m.length_squared() < radius_m * radius_m,
                TipShape::RigidDisc | TipShape::Disc | TipShape::Blade => from_m.dot(axis) > 0.0,
            };
            if !is_within && force_n == DVec3::ZERO {
                continue;
            }
            let (way, deep_m) = match shape {
                TipShape::Sphere => (from_m.try_normalize().unwrap_or(-axis), radius_m - from_m.length()),
                TipShape::RigidDisc | TipShape::Disc | TipShape::Blade => (-axis, from_m.dot(axis)),
            };
            let counted_n_per_m = counted_n_per_m(way);
            let touches = counted_n_per_m > 0.0 && deep_m > 0.0 && deep_m < 2.0 * radius_m;
            if !touches && force_n == DVec3::ZERO {
                continue;
            }
            let slip_m = model.unit_m * sample.mean(|node| self.movements[node]) - own_m;
            // At the rim of a disc, or beginning to face a sphere, a sample may come in at any depth: its force begins at 0.
            let whole_n_per_m = model.youngs_modulus_pa() * sample.relative_stiffness_m;
            let enters = force_n == DVec3::ZERO && counted_n_per_m < whole_n_per_m;
            let sudden_m = 2.0 * MAX_DEEPENING * model.unit_m * whole_n_per_m / counted_n_per_m.max(f64::MIN_POSITIVE);
            // The tangent of the law.
            let part = (deep_m / to_core_m).clamp(0.0, LARGEST_PART);
            let stiffness_n_per_m = counted_n_per_m / (1.0 - part).powi(2);
            let deep_m = if touches { deep_m - part * part * to_core_m } else { deep_m.min(0.0) };
            self.touched.push(TouchedSample {
                sample: number,
                way,
                deep_m,
                slip_m: slip_m - slip_m.dot(way) * way,
                counted_n_per_m,
                stiffness_n_per_m,
                enters,
                sudden_m,
            });
        }
    }

    /// Solves for the forces at the end of the substep, by sweeps over the samples. Returns whether friction holds less than half
    /// of the pressure.
    fn solve(&mut self, model: &Model, plan: &Plan) -> bool {
        let RigidTip { samples, under_nodes, touched, forces_n, change_n, .. } = self;
        let [of_u, of_d] = plan.scheme.kick().map(|of| of * plan.force_scale(&model.scene) * model.unit_m);
        let friction = self.tip.friction;
        for node in under_nodes.iter() {
            change_n[*node as usize] = DVec3::ZERO;
        }
        let (mut held_n, mut sliding_n) = (0.0, 0.0);
        for _ in 0..SWEEPS {
            (held_n, sliding_n) = (0.0, 0.0);
            let (mut most_n2, mut most_by_n2) = (0.0_f64, 0.0_f64);
            for at in touched.iter() {
                let sample = &samples[at.sample];
                let moved_n = sample.mean(|node| change_n[node]);
                let now_n = forces_n[at.sample];
                let (pressed_n, stiffness) = (now_n.dot(at.way), at.stiffness_n_per_m);
                let deep_m = at.deep_m - of_u * moved_n.dot(at.way);
                let gives = stiffness * of_u * sample.relative_inverse_mass;
                let pressing_n = (pressed_n + (stiffness * deep_m - pressed_n) / (1.0 + gives)).max(0.0);
                let mut across_n = now_n - pressed_n * at.way;
                if friction > 0.0 && pressing_n > 0.0 {
                    let slip_m = at.slip_m + of_d * (moved_n - moved_n.dot(at.way) * at.way);
                    across_n -= slip_m / (of_d * sample.relative_inverse_mass);
                    let (length_n, most_n) = (across_n.length(), friction * pressing_n);
                    if length_n > most_n {
                        across_n *= most_n / length_n;
                        sliding_n += pressing_n;
                    } else {
                        held_n += pressing_n;
                    }
                } else {
                    across_n = DVec3::ZERO;
                    sliding_n += pressing_n;
                }
                let force_n = pressing_n * at.way + across_n;
                let by_n = force_n - now_n;
                forces_n[at.sample] = force_n;
                most_n2 = most_n2.max(force_n.length_squared());
                most_by_n2 = most_by_n2.max(by_n.length_squared());
                for k in 0..sample.nodes.len() {
                    let node = sample.nodes[k] as usize;
                    change_n[node] += sample.moves[k] * by_n;
                }
            }
            if most_by_n2 <= SETTLED * SETTLED * most_n2 {
                break;
            }
        }
        sliding_n > held_n
    }
}

/// Returns s of the cell around a sample divided by the modulus of the tissue, 1/m.
fn relative_contact_per_m(model: &Model, cell: &CellPlace) -> f64 {
    let Body::Solid(solid) = &model.scene.body else { return 0.0 };
    let nu = solid.material.poissons_ratio;
    CONTACT_STIFFNESS * solid.factor(cell) / ((1.0 - nu * nu) * model.unit_m)
}

/// Returns the distance b from the surface of a tip to its core, m; a disc has none.
fn to_core_m(tip: &Tip) -> f64 {
    if tip.shape == TipShape::Sphere { TO_CORE * tip.radius_m } else { 1e3 }
}

/// Returns the energy of the contact of a sample that is pressed with a force f, J: s·A·b²·(−ln(1 − g/b) − g/b), with
/// f = s·A·g/(1 − g/b).
fn stored_j(stiffness_n_per_m: f64, force_n: f64, to_core_m: f64) -> f64 {
    let deep_m = force_n / (stiffness_n_per_m + force_n / to_core_m);
    let part = deep_m / to_core_m;
    // Near 0 the difference of the logarithm and its argument is all rounding.
    let form = if part < 1e-4 { 0.5 * part * part } else { -libm::log1p(-part) - part };
    stiffness_n_per_m * to_core_m * to_core_m * form
}

/// Returns how far samples are apart at most, m.
pub(crate) fn spacing_m(radius_m: f64, edge_m: f64) -> f64 {
    (SPACING * radius_m).min(edge_m)
}

/// Adds to u and d of points the effect of forces divided by their masses, with the factors `of` for u and d.
fn push<'n, T: Real>(
    forces: impl Iterator<Item = (&'n TouchedPoint, DVec3)>,
    scale: f64,
    of: [f64; 2],
    layout: &Layout,
    state: &mut State<T>,
) {
    for (node, force_n) in forces.filter(|(node, force_n)| node.inverse_mass > 0.0 && *force_n != DVec3::ZERO) {
        state.add(layout, node.point, (scale * force_n).to_array(), of);
    }
}
