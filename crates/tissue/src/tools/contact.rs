//! Position-controlled tools of finite size: a touch, which only pushes, and a grasp, which holds.
//!
//! A tool meets the tissue with a disc (`footprint`), whose place s(c) = Σ w·x follows from the material place
//! c under the tool. In each substep the tissue first moves under the force F₀ of the last one. Then the step
//! finds an impulse P at the substep's beginning and a force F over it that take s to the tool with the tool's
//! velocity: two unknowns for place and velocity, with the effects of an impulse and of a constant force on
//! both (`Scheme::kick`, `Scheme::constant`) and Σ w²·dt²/m. So this is a division, not an iteration, and
//! stable however stiff the coupling. (A force alone rings: a disc that must be at its place at the end of each
//! substep oscillates within them. Its velocity, and with it the damping that is felt, then have an error of
//! the change of the tool's velocity in a step.)
//!
//! With a spring as coupling, F is its force at the substep's end, F = (Kc·g + Bc·(v_tool − ṡ))/(1 + A·(Kc +
//! Bc/dt)), with the gap g = x_tool − s + A·F₀, and F − F₀ is an impulse. A two-step scheme moves a point by
//! the change of its velocity: under a constraint it has one unknown, F = g/A.
//!
//! Between steps the tool's velocity jumps, since its path is known only at their ends. Such a jump is an
//! impulse m·Δv at the disc's place at that time. Whether a tool loses contact, and how much friction it has,
//! is decided as if the impulse lasted for the step: otherwise, shorter substeps would see a tool that jumps
//! off at every step ([`ToolSubstep`]).
//!
//! A touch is unilateral: with n the outward normal of the surface under the disc, N = −F·n must be positive,
//! or the tool is free; |F_t| may be at most μN, or the disc slides: F_t is shortened, and c follows the tool.
//! With μ = 0 it always follows. While it slides, the force acts half at the old and half at the new place of
//! the disc, along the mean of both normals: with either alone the error would fall only with the first power
//! of the substep. So c is the proxy: the place of the tool on the surface. n = ∂s/∂c_x × ∂s/∂c_y is the only
//! choice whose work equals the energy that the tissue gains when the disc slides over a slope.
//!
//! **No energy from nowhere.** The tool's work is F·ẋ of the tool alone, and the guard counts that
//! (`position_control`). The disc must agree with it, whatever the surface is like:
//! - While it slides from w₀ to w₁, the points move by x̄ in the mean and the tool by Δs = Σ w̄·Δx + Δs̄ with
//!   Δs̄ = Σ (w₁ − w₀)·x̄. The pressing force must not do work along Δs̄, or the tissue would gain F·Δs̄ more
//!   than the tool gives. So the mean normal is taken perpendicular to Δs̄. On a smooth surface it is nearly so
//!   already; on one that is coarse, folded or thin it is not. Friction may only remove energy.
//! - A tool that meets the tissue presses it as deep as both have approached in this substep. If it is deeper,
//!   because its disc has moved to another part of the tissue in which the tool already is, the rest stays as
//!   an offset; if both move apart, it stays free. A new tool has no path yet: it presses as deep as it is
//!   placed. In that substep it does not test whether the tissue pulls on it: the impulses that move a surface
//!   at rest and stop it again cancel, and rounding would decide.
//! - A disc that lags behind its tool is pressed by no more than the tool's movement along the normal
//!   ([`Tool::balance`]), and it moves by no more than half its radius at once.
//! - A disc that lags behind and stops sliding sticks where it is: the impulses that would draw it to its tool
//!   and stop it there cancel, so that the tool would do no work.
//! - If the disc would move over an edge so that its path leads along its normal, it stays, and pushes along
//!   its normal alone. If friction would drive it against the tool's path, and farther, it stays, and friction
//!   acts: so a disc that slid and stops is held.
//!
//! The force felt under a constraint is that of springs, anchor springs and damping on the disc, Σ w·f/Σ w²: F
//! without the points' own inertia, which a hand would feel as a knock at each command.

use std::sync::Arc;

use glam::DVec3;

use crate::body::disc::SurfaceSample;
use crate::body::footprint::{Footprint, RestSurface, WeightedNode};
use crate::body::model::{Model, Plan, displacement_m};
use crate::body::severed::Cuts;
use crate::body::solid::corner_copies::CornerCopies;
use crate::body::window::Window;
use crate::kernel::field::{Layout, State};
use crate::kernel::real::Real;
use crate::response::tangent::{LinearPatch, Tangent};
use crate::saved::{Checks, SavedContact, SavedSide, SavedTie, SavedTip, ensure};
use crate::scene::tie::Tie;
use crate::shape::PointId;
use crate::tools::burns::Burns;
use crate::tools::rigid_tip::{RigidTip, spacing_m};
use crate::tools::tie::Ties;
use palpate_haptics::{ContactState, Coupling, Tip, TipForce, TipShape};
use palpate_refusal::Result;

/// If the determinant of a scheme's impulse and constant force is below this, the scheme has one unknown, not
/// two.
const MIN_DETERMINANT: f64 = 1e-6;

/// The offset of a sliding disc decreases by this part of the tool's movement.
const RELAXATION: f64 = 1.0 / 64.0;

/// A disc's lag behind its tool counts from this part of its radius on. On a smooth surface there is none.
const MIN_LAG: f64 = 1.0 / 64.0;

/// A tool is high above the tissue from this part of its radius on.
const HIGH: f64 = 0.5;

/// A disc continues to slide while its mean normal, taken perpendicular to its path, has at least this part
/// along the normal at its place.
const MIN_STRAIGHTNESS: f64 = 0.9;

/// The motion of a position-controlled tool and the force on it at the end of a step
/// ([`Tissue::tool_contact`](crate::Tissue::tool_contact)). Vectors are in the tissue's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ToolContact {
    /// Place of the tool, m. On a sheet, z points out of the tissue.
    pub place_m: DVec3,
    /// Velocity of the tool in the last step, m/s.
    pub velocity_m_per_s: DVec3,
    /// Whether the tool is free, sticks, slides or holds at the end of the step.
    pub contact_state: ContactState,
    /// Force of the tissue on the tool, N; 0 while it is free.
    pub force_on_tool_n: DVec3,
    /// From the tool's place to where that force acts on it, m: 0, except for a blade, on which it acts where the edge pierces the surface.
    pub lever_m: DVec3,
    /// Place of the displaced surface under the tool, m: the middle of its disc.
    pub surface_m: DVec3,
    /// Place of the tool at which it would just touch that surface, m: of a sphere, a radius above it.
    pub touching_m: DVec3,
    /// Rest position of the place of the tissue under the tool, m.
    pub anchor_m: DVec3,
    /// Unit normal of the surface under the tool, on the tool's side of it.
    pub normal: DVec3,
    /// The surface at rest there; `None` on a sheet, which is a plane at rest.
    pub rest: Option<RestSurface>,
    /// Coefficient of friction μ of the tool's tip.
    pub friction: f64,
    /// Whether the disc lies almost wholly on fixed points ([`Footprint::is_on_fixed`]), so that its force is
    /// not that of free tissue.
    pub is_on_fixed: bool,
}

impl ToolContact {
    /// Returns the force on the tool, which is a tip of an instrument.
    pub fn force_on_tip(&self, tip: usize) -> TipForce {
        TipForce { tip, force_n: self.force_on_tool_n, lever_m: self.lever_m }
    }
}

/// A copy of the tissue around a tool at one step, from which another thread computes the stiffness there while the
/// tissue continues ([`Tissue::tangent_input`](crate::Tissue::tangent_input)).
#[derive(Debug)]
pub struct TangentInput {
    pub(crate) model: Arc<Model>,
    pub(crate) footprint: Footprint,
    pub(crate) window: Window,
    pub(crate) displacement_m: Vec<DVec3>,
    pub(crate) cuts: Cuts,
}

impl TangentInput {
    /// Computes stiffness, damping and drag under the tool, in the tissue's frame. Takes some milliseconds for a
    /// thousand points, all on the calling thread.
    pub fn tangent(self) -> Tangent {
        LinearPatch::new(&self.model, &self.cuts, &self.footprint, self.window, self.displacement_m).tangent()
    }
}

/// A position-controlled tool and its disc.
#[derive(Debug, Clone)]
pub(crate) struct Tool {
    pub(crate) number: usize,
    pub(crate) tip: Tip,
    pub(crate) footprint: Footprint,
    /// Place at the step's beginning and at its end, m.
    pub(crate) from_m: DVec3,
    pub(crate) to_m: DVec3,
    /// The edge of a blade at the step's beginning, m; that at its end is the tip's.
    pub(crate) from_edge_m: DVec3,
    /// How far along its edge from the tip the force on a blade acts, m; found anew in each substep.
    pub(crate) pierced_m: f64,
    /// The most that its coupling bears at that depth, N; found with it.
    pub(crate) resistance_n: f64,
    pub(crate) contact_state: ContactState,
    /// Normal of the surface under the disc, on the tool's side.
    pub(crate) normal: DVec3,
    /// That side: 1 outside, -1 inside; `None` while the tool is beside the tissue.
    pub(crate) side: Option<f64>,
    /// The offset that a grasp, or a touch that began within the tissue, keeps between the tool and the
    /// surface, m.
    pub(crate) offset_m: DVec3,
    /// The gap between the tool and its disc at the end of a substep in which the disc slid, m: a disc may lag
    /// behind.
    pub(crate) gap_m: DVec3,
    /// Whether the tool has not yet been compared with the surface with this tip.
    pub(crate) is_new: bool,
    /// Force on the tissue in the last substep, N.
    pub(crate) force_n: DVec3,
    /// The part of that force that continues in the next substep, without the impulse of meeting.
    pub(crate) steady_n: DVec3,
    pub(crate) velocity_m_per_s: DVec3,
    /// The work of separation of a blade in this step so far, J; 0 between steps.
    pub(crate) separated_j: f64,
    /// How a rigid tip presses; `None` for a disc of even pressure.
    pub(crate) rigid: Option<RigidTip>,
}

/// The states of contact, in the order of their numbers in snapshots.
const CONTACT_STATES: [ContactState; 4] =
    [ContactState::Free, ContactState::Sticking, ContactState::Sliding, ContactState::Holding];

fn rigid_tip(tip: Tip) -> Option<RigidTip> {
    tip.shape.is_rigid().then(|| RigidTip::new(tip))
}

/// All position-controlled tools, the threads and clips, which hold discs as they do, and what tips have burnt.
#[derive(Debug, Clone, Default)]
pub(crate) struct Contacts {
    /// By ascending number.
    pub(crate) tools: Vec<Tool>,
    pub(crate) ties: Ties,
    pub(crate) burns: Burns,
    /// The corners of a solid that cuts have doubled.
    pub(crate) copies: Option<Arc<CornerCopies>>,
}

impl Contacts {
    /// Makes the tool reach `to_m` at the next step's end. A new tool begins there.
    pub(crate) fn pose(&mut self, model: &Model, number: usize, to_m: DVec3, tip: Tip) {
        if let Some(tool) = self.tools.iter_mut().find(|tool| tool.number == number) {
            let is_other = (tool.tip.radius_m, tool.tip.shape) != (tip.radius_m, tip.shape);
            if is_other {
                tool.rigid = rigid_tip(tip);
                tool.footprint = Footprint::new(model, tip.radius_m, tool.footprint.anchor_m());
                tool.footprint.follow_cuts(model, self.copies.as_ref());
            }
            if is_other || tool.tip.grasps != tip.grasps {
                (tool.contact_state, tool.steady_n, tool.is_new) = (ContactState::Free, DVec3::ZERO, true);
                (tool.from_m, tool.from_edge_m) =
                    (if tip.edge_m == DVec3::ZERO { tool.from_m } else { to_m }, tip.edge_m);
            }
            tool.rigid.iter_mut().for_each(|rigid| rigid.set_friction(tip.friction));
            (tool.to_m, tool.tip) = (to_m, tip);
            return;
        }
        let index = self.tools.partition_point(|tool| tool.number < number);
        let mut footprint = Footprint::new(model, tip.radius_m, to_m);
        footprint.follow_cuts(model, self.copies.as_ref());
        let tool = Tool {
            number,
            tip,
            footprint,
            from_m: to_m,
            to_m,
            from_edge_m: tip.edge_m,
            pierced_m: 0.0,
            resistance_n: 0.0,
            contact_state: ContactState::Free,
            normal: DVec3::Z,
            side: None,
            offset_m: DVec3::ZERO,
            gap_m: DVec3::ZERO,
            is_new: true,
            force_n: DVec3::ZERO,
            steady_n: DVec3::ZERO,
            velocity_m_per_s: DVec3::ZERO,
            separated_j: 0.0,
            rigid: rigid_tip(tip),
        };
        self.tools.insert(index, tool);
    }

    pub(crate) fn saved(&self) -> Vec<SavedContact> {
        self.tools.iter().map(Tool::saved).collect()
    }

    pub(crate) fn restored(
        (saved, ties): (&[SavedContact], &[SavedTie]),
        model: &Model,
        checks: &Checks<'_>,
    ) -> Result<Self> {
        let tools: Vec<Tool> = saved.iter().map(|tool| Tool::restored(tool, model, checks)).collect::<Result<_>>()?;
        ensure(tools.is_sorted_by(|a, b| a.number < b.number), "tools out of order")?;
        Ok(Contacts { tools, ties: Ties::restored(ties, model, checks)?, ..Contacts::default() })
    }

    /// Lays, changes or with `None` removes a thread or clip ([`Ties::set`]).
    pub(crate) fn tie(
        &mut self,
        model: &Model,
        number: usize,
        tie: Option<Tie>,
        displacement_m: impl Fn([usize; 2]) -> DVec3,
    ) {
        self.ties.set(model, number, tie, self.copies.as_ref(), displacement_m);
    }

    /// Lets all tools, threads and clips move with these copies of a solid's corners; `None` gives up those that they have.
    pub(crate) fn follow_cuts(&mut self, model: &Model, copies: Option<&Arc<CornerCopies>>) {
        self.copies = copies.cloned();
        for tool in &mut self.tools {
            tool.footprint.follow_cuts(model, copies);
            if let (Some(rigid), true) = (&mut tool.rigid, copies.is_some()) {
                rigid.follow_cuts(model, &tool.footprint);
            }
        }
        self.ties.follow_cuts(model, copies);
    }

    /// Returns the threads and clips and what is burnt, without tools.
    pub(crate) fn without_tools(&self) -> Self {
        Contacts { ties: self.ties.clone(), burns: self.burns.clone(), ..Contacts::default() }
    }

    /// Returns whether there are neither tools nor threads and clips.
    pub(crate) fn is_empty(&self) -> bool {
        self.tools.is_empty() && self.ties.is_empty()
    }

    /// Returns whether there are no tools, and threads and clips that do nothing to a tissue at rest.
    pub(crate) fn are_settled(&self) -> bool {
        self.tools.is_empty() && self.ties.are_settled()
    }

    /// Returns whether none of these tools touches or holds the tissue, and no thread or clip pulls.
    pub(crate) fn are_free(&self) -> bool {
        self.tools.iter().all(|tool| tool.contact_state == ContactState::Free) && self.ties.points().next().is_none()
    }

    /// Returns the numbers of these tools.
    pub(crate) fn tools(&self) -> impl Iterator<Item = usize> {
        self.tools.iter().map(|tool| tool.number)
    }

    /// Returns the points under tools that touch or hold, and under threads and clips that pull. Some occur more than once.
    pub(crate) fn points(&self) -> impl Iterator<Item = [usize; 2]> {
        let touching = self.tools.iter().filter(|tool| tool.contact_state != ContactState::Free);
        touching.flat_map(Tool::moved_points).chain(self.ties.points())
    }

    /// Returns the continuing force of these tools, threads and clips on a point, N.
    pub(crate) fn steady_on(&self, model: &Model, index: usize) -> DVec3 {
        let pressing = self.tools.iter().filter(|tool| tool.steady_n != DVec3::ZERO);
        let of = |tool: &Tool| match &tool.rigid {
            Some(rigid) => rigid.steady_on(index),
            None => tool.footprint.weight_of(model, index) * tool.steady_n,
        };
        let pressing_n: DVec3 = pressing.map(of).sum();
        if self.ties.is_empty() { pressing_n } else { pressing_n + self.ties.force_on(model, index) }
    }

    pub(crate) fn release(&mut self, number: usize) {
        self.tools.retain(|tool| tool.number != number);
    }

    /// Ends a step: updates the velocities and begins the next path at the present place.
    pub(crate) fn finish(&mut self, rate_hz: f64) {
        for tool in &mut self.tools {
            tool.velocity_m_per_s = (tool.to_m - tool.from_m) * rate_hz;
            (tool.from_m, tool.from_edge_m) = (tool.to_m, tool.tip.edge_m);
        }
    }
}

/// Adds to u and d of the disc's points the effect of `force_n` with the factors `of` for u and d (`Scheme::kick`,
/// `Scheme::constant`).
pub(crate) fn push<T: Real>(
    model: &Model,
    plan: &Plan,
    layout: &Layout,
    state: &mut State<T>,
    footprint: &Footprint,
    force_n: DVec3,
    of: [f64; 2],
) {
    let scale = plan.force_scale(&model.scene);
    for WeightedNode { point, mass, weight, .. } in footprint.reached().iter().copied().filter(|point| point.free) {
        state.add(layout, point, (scale * weight * force_n / mass).to_array(), of);
    }
}

/// Returns the movement of the disc in a substep, Σ w·d, m.
pub(crate) fn movement_m<T: Real>(model: &Model, layout: &Layout, state: &State<T>, footprint: &Footprint) -> DVec3 {
    let mut moved = DVec3::ZERO;
    for WeightedNode { point: [i, j], weight, .. } in footprint.reached().iter().copied() {
        let at = i * layout.stride + j;
        for c in 0..3 {
            moved[c] += weight * state.d[c * layout.plane + at].wide();
        }
    }
    moved * model.unit_m
}

impl Tool {
    #[allow(clippy::cast_possible_truncation)]
    fn saved(&self) -> SavedContact {
        SavedContact {
            number: self.number as u64,
            tip: SavedTip::of(&self.tip),
            place: self.footprint.saved(),
            from_m: self.from_m.into(),
            to_m: self.to_m.into(),
            from_edge_m: self.from_edge_m.into(),
            contact_state: CONTACT_STATES.iter().position(|state| *state == self.contact_state).unwrap_or(0) as u8,
            normal: self.normal.into(),
            side: match (self.side, self.rigid.as_ref().and_then(RigidTip::saved)) {
                (None, _) => SavedSide::Beside,
                (Some(side), None) => SavedSide::On(side),
                (Some(side), Some(pressing)) => SavedSide::Pressed(side, Box::new(pressing)),
            },
            offset_m: self.offset_m.into(),
            gap_m: self.gap_m.into(),
            is_new: self.is_new,
            force_n: self.force_n.into(),
            steady_n: self.steady_n.into(),
            velocity_m_per_s: self.velocity_m_per_s.into(),
        }
    }

    fn restored(saved: &SavedContact, model: &Model, checks: &Checks<'_>) -> Result<Self> {
        let tip = saved.tip.restored(checks)?;
        let contact_state = CONTACT_STATES.get(usize::from(saved.contact_state)).copied();
        ensure(contact_state.is_some(), "an unknown state of contact")?;
        let (side, pressing) = match &saved.side {
            SavedSide::Beside => (None, None),
            SavedSide::On(side) => (Some(*side), None),
            SavedSide::Pressed(side, pressing) => (Some(*side), Some(&**pressing)),
        };
        ensure(side.is_none_or(|side| side.abs() == 1.0), "an unknown side of the tissue")?;
        let footprint = Footprint::restored(model, tip.radius_m, &saved.place)?;
        let restored = || RigidTip::restored(pressing, tip, &footprint, model, checks);
        let rigid = tip.shape.is_rigid().then(restored).transpose()?;
        Ok(Tool {
            number: checks.tool(saved.number)?,
            tip,
            footprint,
            from_m: checks.vector(saved.from_m)?,
            to_m: checks.vector(saved.to_m)?,
            from_edge_m: checks.vector(saved.from_edge_m)?,
            pierced_m: 0.0,
            resistance_n: 0.0,
            contact_state: contact_state.unwrap_or(ContactState::Free),
            normal: checks.vector(saved.normal)?,
            side,
            offset_m: checks.vector(saved.offset_m)?,
            gap_m: checks.vector(saved.gap_m)?,
            is_new: saved.is_new,
            force_n: checks.vector(saved.force_n)?,
            steady_n: checks.vector(saved.steady_n)?,
            velocity_m_per_s: checks.vector(saved.velocity_m_per_s)?,
            separated_j: 0.0,
            rigid,
        })
    }

    /// Returns the points that the tip may move.
    pub(crate) fn moved_points(&self) -> impl Iterator<Item = [usize; 2]> {
        let of_disc = self.rigid.is_none().then(|| self.points());
        of_disc.into_iter().flatten().chain(self.rigid.iter().flat_map(RigidTip::points))
    }

    /// Returns the places in memory of what a tip that touches or holds burns: the points of its disc, in a solid the cubes of the surface
    /// under it, by their least corners. Some may occur more than once.
    pub(crate) fn burning_places(&self, model: &Model) -> Vec<usize> {
        if model.places.solid().is_none() {
            return self.points().map(|point| model.index_of(point)).collect();
        }
        if let Some(rigid) = &self.rigid {
            return rigid.pressed_cubes(&self.footprint).collect();
        }
        // A disc of even pressure presses what lies within its radius, on its own side of a thin part.
        let (disc, radius_m) = (&self.footprint, self.tip.radius_m);
        let (anchor_m, outward) = (disc.anchor_m(), disc.at_rest().1);
        let mut samples = disc.samples(radius_m, spacing_m(radius_m, model.unit_m));
        samples.retain(|sample| sample.rest_m.distance(anchor_m) <= radius_m && sample.outward.dot(outward) > 0.0);
        let least = |sample: &SurfaceSample| model.place_of(PointId::new(sample.cell.points[0] as usize));
        // It may be smaller than the parts of a large triangle.
        samples.iter().map(least).chain(model.places.solid().map(|places| places.cube_at(anchor_m))).collect()
    }

    /// Returns the points of the disc.
    pub(crate) fn points(&self) -> impl Iterator<Item = [usize; 2]> {
        self.footprint.reached().iter().map(|reached| reached.point)
    }

    pub(crate) fn place_m(&self, fraction: f64) -> DVec3 {
        if fraction >= 1.0 { self.to_m } else { self.from_m.lerp(self.to_m, fraction) }
    }

    /// Determines the state of contact and the force of the tool on the tissue, N. `state` already includes the
    /// effect of the steady force; if the disc slides, half of that moves with it.
    pub(crate) fn solve_contact<T: Real>(
        &mut self,
        model: &Model,
        plan: &Plan,
        layout: &Layout,
        state: &mut State<T>,
        leg: ToolSubstep,
    ) -> ContactForce {
        let ToolSubstep { mut place_m, spread_n, .. } = leg;
        let before = self.contact_state;
        if self.contact_state == ContactState::Free {
            self.seek(model, layout, state, place_m, leg.is_first);
        }
        let (surface_m, along) = self.footprint.surface(|point| displacement_m(model, layout, state, point));
        let outward = self.footprint.outward(&along);
        let mut gap_m = place_m - surface_m;
        let side = self.side.unwrap_or_else(|| self.footprint.side(gap_m.dot(outward)));
        self.normal = side * outward;
        match self.contact_state {
            ContactState::Free => {
                // Beside the tissue it may change to the other side.
                let is_beside = self.footprint.is_beside(gap_m, outward);
                self.side = (!is_beside).then_some(side);
                if is_beside {
                    return ContactForce::default();
                }
                let depth_m = -gap_m.dot(self.normal);
                if self.tip.grasps {
                    (self.contact_state, self.offset_m) = (ContactState::Holding, gap_m);
                } else if depth_m <= 0.0 {
                    return ContactForce::default();
                } else {
                    let approach_m =
                        movement_m(model, layout, state, &self.footprint) - self.own_movement_m(model, plan);
                    let approach_m = approach_m.dot(self.normal);
                    // What moves apart does not meet: rounding would decide whether it presses.
                    if !self.is_new && approach_m <= 0.0 {
                        return ContactForce::default();
                    }
                    self.contact_state = ContactState::Sticking;
                    let within_m = if self.is_new { 0.0 } else { depth_m - approach_m };
                    self.offset_m = -within_m.max(0.0) * self.normal;
                }
            }
            ContactState::Holding | ContactState::Sticking | ContactState::Sliding => {}
        }
        // A lag is perpendicular to the normal that the surface had when the tool was there: its rotation since
        // then moves nothing.
        let normal_before = leg.normal.unwrap_or(self.normal);
        let lag_m = match before {
            ContactState::Free => self.lag_m(gap_m, normal_before),
            ContactState::Sliding => self.lag_m(self.gap_m, normal_before),
            ContactState::Holding | ContactState::Sticking => DVec3::ZERO,
        };
        gap_m -= self.offset_m;
        place_m -= self.offset_m;
        // A sticking disc moves with the tool from its own place.
        let thrust = self.thrust(model, plan, layout, state, gap_m - lag_m);
        if self.contact_state == ContactState::Holding {
            return thrust;
        }
        if before == ContactState::Free
            && self.is_new
            && self.tip.coupling == Coupling::Constraint
            && self.footprint.relative_inverse_mass() > 0.0
        {
            return thrust.along(self.normal);
        }
        let felt_n = thrust.force_n() + spread_n;
        let pressure_n = -felt_n.dot(self.normal);
        if pressure_n <= 0.0 || self.footprint.relative_inverse_mass() == 0.0 {
            self.contact_state = ContactState::Free;
            return ContactForce::default();
        }
        let (inside, felt_n) = within_cone(felt_n, self.normal, self.tip.friction);
        if inside {
            self.contact_state = ContactState::Sticking;
            self.offset_m += lag_m;
            return thrust;
        }
        if before == ContactState::Sticking {
            // It lags behind again by as much as when it began to stick.
            let lag_m = self.lag_m(self.offset_m, normal_before);
            self.offset_m -= lag_m;
            self.gap_m += lag_m;
            gap_m += lag_m;
            place_m += lag_m;
        }
        self.contact_state = ContactState::Sliding;
        // The normal at the time of the stored gap.
        let reference = if self.is_new { None } else { leg.normal.or(Some(self.normal)) };
        if leg.normal.is_none() {
            self.gap_m = gap_m;
        }
        let leg = ToolSubstep { place_m, reference, ..leg };
        let thrust = match self.slide(model, plan, layout, state, leg, felt_n) {
            Slide::Went(thrust) => return thrust,
            Slide::Stays(across) => {
                self.balance(&mut gap_m, self.normal, reference, self.own_movement_m(model, plan));
                let thrust = self.thrust(model, plan, layout, state, gap_m).along(self.normal);
                let pressing_n = -(thrust.force_n() + spread_n).dot(self.normal);
                thrust.with(self.tip.friction * pressing_n.max(0.0) * across)
            }
            Slide::Leaves => ContactForce::default(),
        };
        if (thrust.force_n() + spread_n).dot(self.normal) >= 0.0 {
            self.contact_state = ContactState::Free;
            return ContactForce::default();
        }
        thrust
    }

    /// Moves the disc of a tool that touches nothing to where the tool would meet the tissue. While a tool is high above its
    /// disc, it does this in the first substep of each step only: it is most of what such a tool costs.
    pub(crate) fn seek<T: Real>(
        &mut self,
        model: &Model,
        layout: &Layout,
        state: &State<T>,
        place_m: DVec3,
        is_first: bool,
    ) {
        let displacement_m = |point| displacement_m(model, layout, state, point);
        if let Some(side) = self.side.filter(|_| !self.is_new && !is_first) {
            let (surface_m, along) = self.footprint.surface(displacement_m);
            let above_m = side * (place_m - surface_m).dot(self.footprint.outward(&along));
            if above_m - self.tip.shape.height_m(self.tip.radius_m) > HIGH * self.tip.radius_m {
                return;
            }
        }
        self.footprint.seek(model, place_m, self.is_new || is_first, displacement_m);
    }

    /// Returns the part of a gap perpendicular to a normal if a constraint would close it and it is too large
    /// for a disc that follows its tool, m; otherwise 0.
    fn lag_m(&self, gap_m: DVec3, normal: DVec3) -> DVec3 {
        let across_m = gap_m - gap_m.dot(normal) * normal;
        let lags = across_m.length() > MIN_LAG * self.footprint.radius_m();
        if lags && self.tip.coupling == Coupling::Constraint && !self.tip.grasps { across_m } else { DVec3::ZERO }
    }

    /// Returns the movement of the tool in a substep, m: of a blade, that of the place of its edge on which the force acts. This one also
    /// moves as the edge turns, and there the blade works.
    pub(crate) fn own_movement_m(&self, model: &Model, plan: &Plan) -> DVec3 {
        let mut moved_m = self.to_m - self.from_m;
        if self.tip.shape == TipShape::Blade {
            let turned = self.tip.edge_m.normalize_or_zero() - self.from_edge_m.normalize_or_zero();
            moved_m += self.pierced_m * turned;
        }
        moved_m * (model.scene.stepping.rate_hz * plan.substep_s)
    }

    /// Returns the tool's path in the substep that ends at `fraction` of the step.
    pub(crate) fn leg(&self, model: &Model, plan: &Plan, fraction: f64) -> ToolSubstep {
        let moves_m_per_n = self.moves_m_per_n(model, plan);
        let met = self.contact_state != ContactState::Free;
        let mut leg = ToolSubstep {
            place_m: self.place_m(fraction),
            is_first: plan.is_first(fraction),
            normal: met.then_some(self.normal),
            reference: None,
            jump_n: DVec3::ZERO,
            spread_n: DVec3::ZERO,
        };
        if self.coupling() != Coupling::Constraint || moves_m_per_n == 0.0 {
            return leg;
        }
        let [of_u, of_d] = plan.scheme.kick();
        let own_m_per_s = (self.to_m - self.from_m) * model.scene.stepping.rate_hz;
        let jump_m = (own_m_per_s - self.velocity_m_per_s) * plan.substep_s;
        let jump_n = of_u / (of_d * moves_m_per_n) * jump_m;
        let pressing_n = jump_n.dot(self.normal) * self.normal;
        let (across_n, substeps) = (jump_n - pressing_n, f64::from(plan.substeps));
        let is_first = leg.is_first;
        leg.spread_n = pressing_n / substeps;
        // A sliding disc takes no more of the part along the surface than friction allows.
        if self.contact_state == ContactState::Sticking {
            leg.spread_n += if is_first { across_n / substeps - across_n } else { across_n / substeps };
        }
        if is_first && matches!(self.contact_state, ContactState::Sticking | ContactState::Sliding) {
            leg.jump_n = pressing_n;
        }
        leg
    }

    /// Moves the disc to its place under the tool once `force_n` has acted, and determines the force there.
    fn slide<T: Real>(
        &mut self,
        model: &Model,
        plan: &Plan,
        layout: &Layout,
        state: &mut State<T>,
        ToolSubstep { place_m, normal: before, reference, spread_n, .. }: ToolSubstep,
        force_n: DVec3,
    ) -> Slide {
        let moves_m_per_n = self.moves_m_per_n(model, plan);
        let (surface_m, along) = self.footprint.surface(|point| displacement_m(model, layout, state, point));
        let mut beside_m = place_m - surface_m - moves_m_per_n * (force_n - self.steady_n);
        let across_n = force_n - force_n.dot(self.normal) * self.normal;
        if let Coupling::Spring { stiffness_n_per_m, .. } = self.tip.coupling {
            beside_m -= across_n / stiffness_n_per_m;
        }
        beside_m -= beside_m.dot(self.normal) * self.normal;
        let beside_m = beside_m.clamp_length_max(self.footprint.stride_m());
        // A moving force acts half at its old place, and half at the new one.
        let half = plan.scheme.constant().map(|of| 0.5 * of);
        let mean_place = |footprint: &Footprint, state: &State<T>| {
            let (surface_m, along) = footprint.surface(|point| displacement_m(model, layout, state, point));
            (surface_m - 0.5 * movement_m(model, layout, state, footprint), along)
        };
        push(model, plan, layout, state, &self.footprint, -self.steady_n, half);
        let ((stayed_m, _), place) = (mean_place(&self.footprint, state), self.footprint.saved());
        self.footprint.shift(model, beside_m, &along);
        let (went_m, along) = mean_place(&self.footprint, state);
        let travelled_m = went_m - stayed_m;
        let normal = self.side.unwrap_or(1.0) * self.footprint.outward(&along);
        // The force over the substep is along the mean normal, and does no work along the disc's path; a
        // spring's force is the one at its end.
        let mean = match (self.tip.coupling, before) {
            (Coupling::Constraint, Some(before)) => before + normal,
            _ => normal,
        };
        let way = travelled_m.normalize_or_zero();
        let mean = (mean - mean.dot(way) * way).normalize_or_zero();
        let is_straight = mean.dot(normal) >= MIN_STRAIGHTNESS;
        let mean = if self.tip.coupling == Coupling::Constraint { mean } else { normal };
        let across = (across_n - across_n.dot(mean) * mean).normalize_or_zero();
        // Friction removes energy from a moving disc: it does not drive it against the tool's path, farther
        // than that path.
        let is_driven = across.dot(travelled_m) < -self.own_movement_m(model, plan).length();
        if !is_straight || is_driven {
            self.footprint.return_to(model, &place);
            push(model, plan, layout, state, &self.footprint, self.steady_n, half);
            return Slide::Stays(if is_straight { across_n.normalize_or_zero() } else { DVec3::ZERO });
        }
        let straightness = mean.dot(normal);
        push(model, plan, layout, state, &self.footprint, self.steady_n, half);
        let stays = (self.normal, self.offset_m);
        self.normal = normal;
        let (surface_m, _) = self.footprint.surface(|point| displacement_m(model, layout, state, point));
        let mut gap_m = place_m - surface_m;
        self.balance(&mut gap_m, mean, reference, self.own_movement_m(model, plan));
        let thrust = self.thrust(model, plan, layout, state, gap_m);
        let pressing_n = -(thrust.force_n() + spread_n).dot(self.normal);
        if pressing_n <= 0.0 {
            // Nothing presses at the new place. All that acts in this substep acts at the old one.
            push(model, plan, layout, state, &self.footprint, -self.steady_n, half);
            self.footprint.return_to(model, &place);
            (self.normal, self.offset_m) = stays;
            push(model, plan, layout, state, &self.footprint, self.steady_n, half);
            return Slide::Leaves;
        }
        let friction_n = self.tip.friction * pressing_n * across;
        let along_mean = |normal_n: f64| normal_n / straightness * mean;
        let kick_n = along_mean(thrust.kick_n.dot(self.normal));
        let steady_n = along_mean((thrust.steady_n - friction_n).dot(self.normal)) + friction_n;
        let goes_on_n = if thrust.goes_on_n == thrust.steady_n { steady_n } else { kick_n + steady_n };
        Slide::Went(ContactForce { kick_n, steady_n, goes_on_n })
    }

    /// Keeps the offset such that closing the gap along the mean normal moves the surface as far as the tool
    /// has moved along it, `own_m` in this substep.
    ///
    /// With q the gap along the normal (0 under a constraint), a disc that follows its tool closes q₀ + n̄·(g₁
    /// − g₀). If it lags behind, or the surface is not smooth, the rotation of the normal alone changes the gap
    /// to close, as if the tool had moved. That part goes into the offset, which decreases by a small part of
    /// the tool's movement: so the second-order remainder on a smooth surface never counts, and a tool at rest
    /// adds nothing.
    fn balance(&mut self, gap_m: &mut DVec3, mean: DVec3, reference: Option<DVec3>, own_m: DVec3) {
        let Some(before) = reference else { return };
        let along_m = gap_m.dot(self.normal) / mean.dot(self.normal);
        let explained_m = self.gap_m.dot(before) + mean.dot(*gap_m - self.gap_m);
        let offset_m = -self.offset_m.dot(mean);
        let balanced_m = offset_m + explained_m - along_m;
        let kept_m = balanced_m - balanced_m.clamp(-RELAXATION * own_m.length(), RELAXATION * own_m.length());
        self.offset_m -= (kept_m - offset_m) * mean;
        *gap_m += (kept_m - offset_m) * mean;
    }

    /// Returns whether a spring, or the contact of a rigid tip, couples the tool to the tissue at present.
    pub(crate) fn is_coupled(&self) -> bool {
        self.rigid.is_some()
            || self.contact_state != ContactState::Free && matches!(self.coupling(), Coupling::Spring { .. })
    }

    /// Returns the energy of that spring, J, while the disc is at `surface_m` and the tool at `place_m`.
    pub(crate) fn stored_j(&self, surface_m: DVec3, place_m: DVec3) -> f64 {
        if let Some(rigid) = &self.rigid {
            return rigid.stored_j();
        }
        match self.coupling() {
            Coupling::Spring { stiffness_n_per_m, .. } if self.is_coupled() && self.tip.shape == TipShape::Blade => {
                // Along its edge a blade slides freely. Beyond its resistance the place of the tissue lags behind where the spring would
                // hold it, because the displacement differs there: that stretches nothing.
                let edge = self.from_edge_m.normalize_or_zero();
                let stretched_m = (place_m - self.offset_m - surface_m).reject_from(edge).length();
                let held_m = stretched_m.min(self.resistance_n / stiffness_n_per_m);
                0.5 * stiffness_n_per_m * held_m * held_m
            }
            Coupling::Spring { stiffness_n_per_m, .. } if self.is_coupled() => {
                let stretched_j = 0.5 * stiffness_n_per_m * (place_m - self.offset_m - surface_m).length_squared();
                // A disc that lags behind stretches nothing along its path.
                stretched_j.min(0.5 * self.force_n.length_squared() / stiffness_n_per_m)
            }
            _ => 0.0,
        }
    }

    /// Returns how far the disc moves in the substep under an impulse of 1 N times the substep, m/N.
    fn moves_m_per_n(&self, model: &Model, plan: &Plan) -> f64 {
        plan.scheme.kick()[0] * plan.force_scale(&model.scene) * model.unit_m * self.footprint.relative_inverse_mass()
    }

    /// Returns the steady force with an impulse for the rest of `force_n`; the next substep begins with
    /// `force_n`.
    pub(crate) fn kicked_to(&self, force_n: DVec3) -> ContactForce {
        ContactForce { kick_n: force_n - self.steady_n, steady_n: self.steady_n, goes_on_n: force_n }
    }

    /// Returns the force that closes a gap, and gives the disc the tool's velocity if the scheme can do both.
    pub(crate) fn thrust<T: Real>(
        &self,
        model: &Model,
        plan: &Plan,
        layout: &Layout,
        state: &State<T>,
        gap_m: DVec3,
    ) -> ContactForce {
        let moves_m_per_n = self.moves_m_per_n(model, plan);
        if moves_m_per_n == 0.0 {
            return ContactForce::default();
        }
        let own_m = self.own_movement_m(model, plan);
        let moved_m = movement_m(model, layout, state, &self.footprint);
        let ([kick_u, kick_d], [of_u, of_d]) = (plan.scheme.kick(), plan.scheme.constant());
        match self.coupling() {
            Coupling::Constraint => {
                let determinant = kick_u * of_d - kick_d * of_u;
                // A two-step scheme moves a point by the change of its velocity: it can only close the gap.
                if determinant.abs() < MIN_DETERMINANT {
                    return self.kicked_to(self.steady_n + gap_m / moves_m_per_n);
                }
                let unit = kick_u / (moves_m_per_n * determinant);
                let faster_m = own_m - moved_m;
                let steady_n = self.steady_n + unit * (kick_u * faster_m - kick_d * gap_m);
                let kick_n = unit * (of_d * gap_m - of_u * faster_m);
                ContactForce { kick_n, steady_n, goes_on_n: steady_n }
            }
            Coupling::Spring { stiffness_n_per_m, damping_n_s_per_m } => {
                let gap_m = gap_m + moves_m_per_n * self.steady_n;
                let apart_m_per_s = (own_m - (moved_m - moves_m_per_n * self.steady_n)) / plan.substep_s;
                let held = stiffness_n_per_m + damping_n_s_per_m / plan.substep_s;
                let sought_n = stiffness_n_per_m * gap_m + damping_n_s_per_m * apart_m_per_s;
                self.kicked_to(sought_n / (1.0 + moves_m_per_n * held))
            }
        }
    }
}

/// A tool's path in a substep. Its velocity jumps at the beginning of a step, because its path is known only at
/// the ends of steps. Forces are impulses over the substep.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ToolSubstep {
    /// Place at the substep's end, m.
    place_m: DVec3,
    /// Whether it is the first one of its step.
    is_first: bool,
    /// Normal of the surface at the substep's beginning, if the tool touches there.
    normal: Option<DVec3>,
    /// Normal at the time of the gap that the tool keeps; `None` for a new tool.
    reference: Option<DVec3>,
    /// Force of the jump of velocity in the first substep, at the disc's place then, N.
    pub(crate) jump_n: DVec3,
    /// Force to add to that of the substep, N, so that a jump counts as spread over the step. Whether the tool
    /// loses contact or slides then does not depend on the length of a substep.
    spread_n: DVec3,
}

/// What a disc does that friction does not hold.
enum Slide {
    /// It follows the tool.
    Went(ContactForce),
    /// It stays, because its path would lead along its normal, or friction would drive it. Friction acts in
    /// this direction (a vector of length 1 or 0).
    Stays(DVec3),
    /// It stays, and the tool loses contact: nothing presses at the new place.
    Leaves,
}

/// The force of a tool on its disc in a substep, N.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct ContactForce {
    /// An impulse at the substep's beginning, divided by the substep.
    pub(crate) kick_n: DVec3,
    /// A constant force during the substep.
    pub(crate) steady_n: DVec3,
    /// The force with which the next substep begins.
    pub(crate) goes_on_n: DVec3,
}

impl ContactForce {
    /// Returns the part along a normal.
    fn along(&self, normal: DVec3) -> Self {
        let along = |force_n: DVec3| force_n.dot(normal) * normal;
        ContactForce { kick_n: along(self.kick_n), steady_n: along(self.steady_n), goes_on_n: along(self.goes_on_n) }
    }

    /// Returns this force with a steady force added.
    fn with(&self, steady_n: DVec3) -> Self {
        ContactForce { kick_n: self.kick_n, steady_n: self.steady_n + steady_n, goes_on_n: self.goes_on_n + steady_n }
    }

    /// Returns the sum of the impulse and the steady force.
    pub(crate) fn force_n(&self) -> DVec3 {
        self.kick_n + self.steady_n
    }
}

/// Returns a force limited to the friction cone around the line of `normal`, a unit vector, preceded by whether it was
/// already inside. The cone is double: a force that pulls has the friction of one that presses as hard, so callers
/// first check the sign of its part along the normal.
pub(crate) fn within_cone(force_n: DVec3, normal: DVec3, friction: f64) -> (bool, DVec3) {
    let pressing_n = force_n.dot(normal) * normal;
    let across_n = force_n - pressing_n;
    let most_n = friction * pressing_n.length();
    let length_n = across_n.length();
    if length_n <= most_n { (true, force_n) } else { (false, pressing_n + across_n * (most_n / length_n)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn within_a_step_a_tool_moves_straight_and_ends_where_it_is_told_to() {
        let (model, mut contacts) = (Model::paper(&["sheet.points=[9, 9]"]), Contacts::default());
        let [from_m, to_m] = [DVec3::new(0.1, 0.12, 0.01), DVec3::new(0.1007, 0.1193, 0.0087)];
        contacts.pose(&model, 3, from_m, Tip::default());
        contacts.finish(1000.0);
        contacts.pose(&model, 3, to_m, Tip::default());
        for fraction in [0.0, 0.25, 0.8] {
            let expected_m = from_m + fraction * (to_m - from_m);
            assert!(contacts.tools[0].place_m(fraction).distance(expected_m) < 1e-15, "{fraction}");
        }
        assert_eq!(contacts.tools[0].place_m(1.0), to_m);
    }

    #[test]
    fn tools_come_by_their_number_and_one_that_is_released_goes_alone() {
        let (model, mut contacts) = (Model::paper(&["sheet.points=[9, 9]"]), Contacts::default());
        for number in [5, 1, 3, 1] {
            contacts.pose(&model, number, DVec3::new(0.1, 0.1, 0.01), Tip::default());
        }
        assert_eq!(contacts.tools().collect::<Vec<_>>(), [1, 3, 5]);
        contacts.release(3);
        assert_eq!(contacts.tools().collect::<Vec<_>>(), [1, 5]);
    }
}
