//! Position-controlled tools: how they act in a substep, and the forces on them. `contact` solves the contact of one tool.

use glam::DVec3;

use palpate_haptics::ContactState;

use crate::body::footprint::WeightedNode;
use crate::body::model::{Model, Plan, displacement_m};
use crate::body::tables::SweepTables;
use crate::kernel::field::{Field, Layout, State};
use crate::kernel::real::Real;
use crate::state::step_context::StepContext;
use crate::tools::contact::{ContactForce, Contacts, Tool, ToolContact, movement_m, push, within_cone};
use crate::tools::rigid_tip::RigidTip;
use palpate_haptics::{Coupling, TipShape};

impl Contacts {
    /// Makes position-controlled tools act at the end of a substep, which ends at `fraction` of the step. A
    /// tool that moves points by more than `far` spacings wakes the tiles that these points pull at in the next
    /// substep.
    pub(crate) fn act<T: Real>(&mut self, context: &mut StepContext<'_, T>, fraction: f64, far: f64) {
        let StepContext { model, plan, tables, state, applied, tiles, work } = context;
        let (unit_j, layout) = (plan.unit_of_work_j(model), &tables.layout);
        for tool in &mut self.tools {
            if let Some(rigid) = tool.rigid.take() {
                let context = &mut StepContext { model, plan, tables, state, applied, tiles, work };
                tool.rigid = Some(tool.act_rigid(rigid, context, fraction, far));
                continue;
            }
            let (before_n, met) = (tool.steady_n, tool.contact_state != ContactState::Free);
            let is_new = tool.is_new;
            if before_n != DVec3::ZERO {
                tiles.wake_under(tool.points());
                push(model, plan, layout, state, &tool.footprint, before_n, plan.scheme.constant());
            }
            let leg = tool.leg(model, plan, fraction);
            if leg.jump_n != DVec3::ZERO {
                push(model, plan, layout, state, &tool.footprint, leg.jump_n, plan.scheme.kick());
            }
            let thrust = match tool.tip.shape {
                TipShape::Blade => tool.resist(model, plan, layout, state, (fraction, tables.severed.has_room(model))),
                _ => tool.solve_contact(model, plan, layout, state, leg),
            };
            tool.is_new = false;
            tool.force_n = thrust.force_n();
            tool.steady_n = if met { thrust.goes_on_n } else { DVec3::ZERO };
            if tool.contact_state == ContactState::Free {
                // The tool has lost contact: undo what acted in this substep.
                if before_n != DVec3::ZERO {
                    push(model, plan, layout, state, &tool.footprint, -before_n, plan.scheme.constant());
                }
                if leg.jump_n != DVec3::ZERO {
                    push(model, plan, layout, state, &tool.footprint, -leg.jump_n, plan.scheme.kick());
                }
                continue;
            }
            if thrust == ContactForce::default() && before_n == DVec3::ZERO && leg.jump_n == DVec3::ZERO {
                continue;
            }
            // Sleeping tiles were at rest in this substep, as if they had been computed.
            tiles.wake_under(tool.points());
            let change_n = thrust.steady_n - before_n;
            let is_put = is_new && !met;
            let is_put_at_once = is_put && tool.coupling() == Coupling::Constraint;
            // The volume changes too little to compute it twice.
            let volume_change = if is_put_at_once { tables.volume_change(&state.u, tiles.region.tiles()) } else { 0.0 };
            let before = is_put_at_once.then(|| states(model, plan, tables, state, volume_change, tool));
            // Moves at once, or by the speed that the points have now.
            let moved_n =
                |c: usize| plan.scheme.kick()[c] * (leg.jump_n + thrust.kick_n) + plan.scheme.constant()[c] * change_n;
            let most = plan.force_scale(&model.scene) * moved_n(0).abs().max(moved_n(1).abs()).max_element();
            for WeightedNode { point, .. } in
                tool.footprint.reached().iter().filter(|of| of.free && of.weight / of.mass * most > far)
            {
                tiles.wake_around(*point, plan.scheme.sweeps());
            }
            push(model, plan, layout, state, &tool.footprint, thrust.kick_n, plan.scheme.kick());
            push(model, plan, layout, state, &tool.footprint, change_n, plan.scheme.constant());
            let surface_m = || tool.footprint.surface(|point| displacement_m(model, layout, state, point)).0;
            tool.gap_m = match tool.contact_state {
                ContactState::Sliding => tool.place_m(fraction) - tool.offset_m - surface_m(),
                _ => DVec3::ZERO,
            };
            // Forces of other tools on these points also do work along this movement.
            if !applied.terms.is_empty() {
                let moved =
                    plan.scheme.kick()[0] * (leg.jump_n + thrust.kick_n) + plan.scheme.constant()[0] * thrust.steady_n;
                let scale = plan.force_scale(&model.scene);
                for WeightedNode { point, mass, weight, .. } in
                    tool.footprint.reached().iter().filter(|point| point.free)
                {
                    let movement = scale * weight / mass * moved;
                    work.add(applied.work_along(model, plan, layout, *point, movement.to_array()) * unit_j);
                }
            }
            let all_n = leg.jump_n + thrust.kick_n + thrust.steady_n;
            if let Some(before) = before {
                // A tool placed within the tissue presses at once to its depth. The impulses that move the
                // surface and stop it cancel, so the work is the energy that the tissue gained.
                let after = states(model, plan, tables, state, volume_change, tool);
                work.add(before.iter().zip(&after).map(|(before, after)| gained_j(before, after, unit_j)).sum());
            } else if is_put {
                work.add(all_n.dot(movement_m(model, layout, state, &tool.footprint)));
                work.add(tool.stored_j(surface_m(), tool.place_m(fraction)));
            } else {
                // The work is counted along the tool's own path, not along that of the disc: errors of the
                // disc's movement are not the tool's work.
                work.add(all_n.dot(tool.own_movement_m(model, plan)));
            }
        }
    }

    /// Returns the energy of spring couplings, and of the stretch of threads, J.
    pub(crate) fn coupling_j<T: Real>(&self, model: &Model, layout: &Layout, state: &State<T>) -> f64 {
        let stored_j = |tool: &Tool| {
            let (surface_m, _) = tool.footprint.surface(|point| displacement_m(model, layout, state, point));
            tool.stored_j(surface_m, tool.from_m)
        };
        let tools_j: f64 = self.tools.iter().filter(|tool| tool.is_coupled()).map(stored_j).sum();
        if self.ties.is_empty() { tools_j } else { tools_j + self.ties.stored_j() }
    }

    /// Returns the tool with a number; `None` if that is not a position-controlled one.
    pub(crate) fn tool(&self, number: usize) -> Option<&Tool> {
        self.tools.iter().find(|tool| tool.number == number)
    }
}

impl Tool {
    /// Makes a rigid tip act at the end of a substep, as [`Contacts::act`] does.
    fn act_rigid<T: Real>(
        &mut self,
        mut rigid: RigidTip,
        context: &mut StepContext<'_, T>,
        fraction: f64,
        far: f64,
    ) -> RigidTip {
        let StepContext { model, plan, tables, state, applied, tiles, work } = context;
        let (unit_j, layout) = (plan.unit_of_work_j(model), &tables.layout);
        let (place_m, was_pressing) = (self.place_m(fraction), rigid.is_pressing());
        if was_pressing {
            tiles.wake_under(rigid.wakes());
        } else {
            self.seek(model, layout, state, place_m, plan.is_first(fraction));
        }
        let (surface_m, along) = self.footprint.surface(|point| displacement_m(model, layout, state, point));
        let outward = self.footprint.outward(&along);
        let gap_m = place_m - surface_m;
        if let Some(off_m) = rigid.off_m(gap_m, outward).filter(|_| was_pressing) {
            let (_, rest_outward) = self.footprint.at_rest();
            self.footprint.shift(model, off_m.clamp_length_max(self.footprint.stride_m()), &along);
            work.add(rigid.turn(model, layout, state, place_m, [rest_outward, self.footprint.at_rest().1]));
        }
        (self.normal, self.side, self.is_new) = (outward, Some(1.0), false);
        if !was_pressing && rigid.is_far(gap_m) {
            self.leave();
            return rigid;
        }
        work.add(rigid.follow(model, &self.footprint, outward));
        rigid.go_on(model, plan, layout, state);
        let pressed = rigid.press(model, plan, layout, state, [place_m, self.own_movement_m(model, plan)]);
        rigid.kick(model, plan, layout, state);
        if was_pressing || pressed.contact_state.is_some() {
            tiles.wake_under(rigid.wakes());
            rigid.moved(model, plan, far).for_each(|point| tiles.wake_around(point, plan.scheme.sweeps()));
        }
        // Forces of other tools on these points also do work along this movement.
        if !applied.terms.is_empty() {
            for (point, movement) in rigid.movements(model, plan) {
                work.add(applied.work_along(model, plan, layout, point, movement.to_array()) * unit_j);
            }
        }
        work.add(pressed.force_n.dot(pressed.moved_m) + pressed.entered_j);
        match pressed.contact_state {
            Some(contact_state) => {
                (self.contact_state, self.force_n, self.steady_n) = (contact_state, pressed.force_n, pressed.force_n);
            }
            None => self.leave(),
        }
        rigid
    }

    /// Loses contact.
    fn leave(&mut self) {
        (self.contact_state, self.force_n, self.steady_n) = (ContactState::Free, DVec3::ZERO, DVec3::ZERO);
    }

    /// Returns the motion of the tool and the force on it. `without_inertia` gives the force under which the disc is
    /// not accelerated, N.
    pub(crate) fn contact(&self, surface_m: DVec3, without_inertia: impl FnOnce() -> DVec3) -> ToolContact {
        let felt_n = match (self.contact_state, self.coupling()) {
            (ContactState::Free, _) => DVec3::ZERO,
            _ if self.rigid.is_some() => -self.force_n,
            (_, Coupling::Spring { .. }) => -self.force_n,
            (contact_state, Coupling::Constraint) => {
                let felt_n = without_inertia();
                if contact_state == ContactState::Holding {
                    felt_n
                } else if felt_n.dot(self.normal) <= 0.0 {
                    DVec3::ZERO
                } else {
                    within_cone(felt_n, self.normal, self.tip.friction).1
                }
            }
        };
        ToolContact {
            place_m: self.from_m,
            velocity_m_per_s: self.velocity_m_per_s,
            contact_state: self.contact_state,
            force_on_tool_n: felt_n,
            lever_m: self.pierced_m * self.from_edge_m.normalize_or_zero(),
            surface_m,
            touching_m: surface_m + self.tip.shape.height_m(self.tip.radius_m) * self.normal,
            anchor_m: self.footprint.anchor_m(),
            normal: self.normal,
            rest: self.footprint.rest_surface(self.side.unwrap_or(1.0)),
            friction: self.tip.friction,
            is_on_fixed: self.footprint.is_on_fixed(),
        }
    }

    /// Returns Σ(w·f/mass)/Σ(w²/mass), N: the force under which the disc is not accelerated. f is that of springs,
    /// anchor springs, damping and force-controlled tools; `force_n` gives it for a point, by its place in memory and
    /// its relative mass, N.
    pub(crate) fn without_inertia(&self, model: &Model, force_n: impl Fn(usize, f64) -> DVec3) -> DVec3 {
        let footprint = &self.footprint;
        let mut sum = DVec3::ZERO;
        for WeightedNode { point, mass, weight, .. } in footprint.reached().iter().copied().filter(|point| point.free) {
            sum += weight / mass * force_n(model.index_of(point), mass);
        }
        if footprint.relative_inverse_mass() > 0.0 { sum / footprint.relative_inverse_mass() } else { DVec3::ZERO }
    }
}

/// A free point under a tip.
struct UnderTip {
    mass: f64,
    /// Its displacement, m, and its movement in a substep, spacings.
    u_m: DVec3,
    d: DVec3,
    /// Force of springs and anchor springs on it, N.
    pull_n: DVec3,
}

/// Returns the states of the free points under a tip.
fn states<T: Real>(
    model: &Model,
    plan: &Plan,
    tables: &SweepTables<T>,
    state: &State<T>,
    volume_change: f64,
    tool: &Tool,
) -> Vec<UnderTip> {
    let spring_unit = plan.spring_unit(&model.scene);
    let of = |WeightedNode { point, mass, .. }: WeightedNode| {
        let index = model.index_of(point);
        let at = |c: usize| c * tables.layout.plane + tables.layout.offset(index);
        let vector = |field: &Field<T>| DVec3::from_array([0, 1, 2].map(|c| field[at(c)].wide()));
        let (u, springs) =
            (vector(&state.u), tables.springs.gather(&tables.severed, &tables.layout, &state.u, volume_change, point));
        let spring_n =
            [0, 1, 2].map(|c| tables.spring_force_n(model, [spring_unit, mass], index, [springs[c].wide(), u[c]]));
        let place_n_per_m = tables.anchor_stiffness_at_n_per_m(model, index);
        let u_m = model.unit_m * u;
        UnderTip { mass, u_m, d: vector(&state.d), pull_n: DVec3::from_array(spring_n) - place_n_per_m * u_m }
    };
    tool.footprint.reached().iter().copied().filter(|point| point.free).map(of).collect()
}

/// Returns the gain in energy of a point and of its springs, J. Springs are taken as linear, so they resist
/// with the mean force.
fn gained_j(before: &UnderTip, after: &UnderTip, unit_j: f64) -> f64 {
    let stored_j = -0.5 * (before.pull_n + after.pull_n).dot(after.u_m - before.u_m);
    stored_j + 0.5 * unit_j * before.mass * (after.d.length_squared() - before.d.length_squared())
}
