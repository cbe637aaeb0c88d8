//! Position-controlled tools: how they act in a substep, and the forces on them.

use glam::DVec3;

use palpate_haptics::ContactState;

use crate::body::footprint::WeightedNode;
use crate::body::tables::SweepTables;
use crate::body::window::Window;
use crate::kernel::field::{Field, State};
use crate::kernel::real::Real;
use crate::memory;
use crate::model::{Model, Plan};
use crate::state::tissue_state::{TissueState, spring_force_n};
use crate::tools::contact::{
    ContactForce, TangentInput, Tool, ToolContact, displacement_m, movement_m, push, within_cone,
};
use palpate_haptics::Coupling;

impl<T: Real> TissueState<T> {
    /// Makes position-controlled tools act at the end of a substep, which ends at `fraction` of the step. A
    /// tool that moves points by more than `far` spacings wakes the tiles that these points pull at in the next
    /// substep.
    pub(crate) fn solve_contact(&mut self, fraction: f64, far: f64) {
        let unit_j = self.unit_of_work_j();
        let TissueState { model, plan, tables, state, applied, contacts, tiles, work, .. } = self;
        let layout = &tables.layout;
        for tool in &mut contacts.tools {
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
            let thrust = tool.solve_contact(model, plan, layout, state, leg);
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
            let is_put_at_once = is_put && tool.tip.coupling == Coupling::Constraint;
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

    /// Returns the energy of spring couplings, J.
    pub(crate) fn coupling_j(&self) -> f64 {
        let TissueState { model, tables, state, contacts, .. } = self;
        let stored_j = |tool: &Tool| {
            let (surface_m, _) = tool.footprint.surface(|point| displacement_m(model, &tables.layout, state, point));
            tool.stored_j(surface_m, tool.from_m)
        };
        contacts.tools.iter().filter(|tool| tool.is_coupled()).map(stored_j).sum()
    }

    /// Returns the motion of a position-controlled tool and the force on it; `None` for other tools.
    pub(crate) fn tool_contact(&self, number: usize) -> Option<ToolContact> {
        let model = &self.model;
        let tool = self.contacts.tools.iter().find(|tool| tool.number == number)?;
        let (surface_m, _) =
            tool.footprint.surface(|point| displacement_m(model, &self.tables.layout, &self.state, point));
        let felt_n = match (tool.contact_state, tool.tip.coupling) {
            (ContactState::Free, _) => DVec3::ZERO,
            (_, Coupling::Spring { .. }) => -tool.force_n,
            (contact_state, Coupling::Constraint) => {
                let felt_n = self.without_inertia(tool);
                if contact_state == ContactState::Holding {
                    felt_n
                } else if felt_n.dot(tool.normal) <= 0.0 {
                    DVec3::ZERO
                } else {
                    within_cone(felt_n, tool.normal, tool.tip.friction).1
                }
            }
        };
        Some(ToolContact {
            place_m: tool.from_m,
            velocity_m_per_s: tool.velocity_m_per_s,
            contact_state: tool.contact_state,
            force_on_tool_n: felt_n,
            surface_m,
            anchor_m: tool.footprint.anchor_m(),
            normal: tool.normal,
            rest: tool.footprint.rest_surface(tool.side.unwrap_or(1.0)),
            friction: tool.tip.friction,
            is_on_fixed: tool.footprint.is_on_fixed(),
        })
    }

    /// Returns a copy of the tool's disc and of the displacements of the points around it; `None` if the tool
    /// neither touches nor holds, or if there is no memory.
    pub(crate) fn tangent_input(&self, number: usize) -> Option<TangentInput> {
        let tool = self.contacts.tools.iter().find(|tool| tool.number == number)?;
        if tool.contact_state == ContactState::Free {
            return None;
        }
        let window = Window::around(&self.model, &tool.footprint);
        // Without memory for it, the stiffness from the force law must suffice.
        memory::check(window.bytes(), "the stiffness under a tool").ok()?;
        let displacement =
            |index: usize| displacement_m(&self.model, &self.tables.layout, &self.state, self.model.point_of(index));
        let displacement_m = window.points(&self.model).map(displacement).collect();
        Some(TangentInput { model: self.model.clone(), footprint: tool.footprint.clone(), window, displacement_m })
    }

    /// Returns Σ(w·f/mass)/Σ(w²/mass), N: the force under which the disc is not accelerated. f is that of
    /// springs, anchor springs, damping and force-controlled tools.
    fn without_inertia(&self, tool: &Tool) -> DVec3 {
        let (model, footprint) = (&self.model, &tool.footprint);
        let scene = &model.scene;
        let mut sum = DVec3::ZERO;
        for WeightedNode { point, mass, weight, .. } in footprint.reached().iter().copied().filter(|point| point.free) {
            let index = model.index_of(point);
            let of_stiffness = model.relative_anchor_stiffness_at(index);
            let applied_n = if self.steps == 0 { DVec3::ZERO } else { self.applied.until(model, index) };
            let [u, v, spring_n] = self.free_point(index, applied_n);
            let anchor_n = -of_stiffness * scene.anchor_stiffness_n_per_m * u;
            let damping_n = -mass * scene.damping_n_s_per_m * v;
            sum += weight / mass * (spring_n + anchor_n + damping_n + applied_n);
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
    let of = |WeightedNode { point, mass, .. }: WeightedNode| {
        let index = model.index_of(point);
        let at = |c: usize| c * tables.layout.plane + tables.layout.offset(index);
        let vector = |field: &Field<T>| DVec3::from_array([0, 1, 2].map(|c| field[at(c)].wide()));
        let (u, springs) = (vector(&state.u), tables.springs.gather(&tables.layout, &state.u, volume_change, point));
        let spring_n = [0, 1, 2].map(|c| spring_force_n(model, plan, index, springs[c].wide(), u[c]));
        let place_n_per_m = model.scene.anchor_stiffness_n_per_m * model.relative_anchor_stiffness_at(index);
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::scene::profile::Poke;
    use crate::{Energy, Grasp, Push, Tissue};
    use palpate_haptics::Tip;

    fn sheet(sets: &[&str]) -> TissueState<f64> {
        let always = ["stepping.precision=f64", "stepping.integrator=central", "stepping.substeps=1"];
        TissueState::new(&Model::paper(&[&always[..], &["sheet.points=[9, 9]", "sleep.tolerance=0.0"], sets].concat()))
    }

    /// A force next to a tool or held point at rest does no work. The sweep alone would count the drift of the points
    /// away from the tool in each substep, which the tool then undoes: enough for the guard to stop a finger that rests
    /// next to a force.
    #[test]
    fn a_force_beside_a_tool_at_rest_does_no_work() {
        for integrator in ["central", "exponential2", "exponential4", "rk4"] {
            for grasps in [false, true] {
                let mut sheet = sheet(&[&format!("stepping.integrator={integrator}"), "sheet.points=[21, 21]"]);
                let middle_m = sheet.model.shape().rest_m(sheet.model.points().nth(220).unwrap());
                sheet.push(
                    1,
                    Some(Push::Constant(Poke {
                        point: None,
                        centre_m: middle_m + DVec3::new(0.05, 0.0, 0.0),
                        force_n: DVec3::new(0.02, 0.0, -0.05),
                        falloff_per_m: 10.0,
                        falloff_offset: 0.0,
                    })),
                );
                if grasps {
                    let point = sheet.model.points().nth(220).unwrap();
                    sheet.grasp(0, point, Grasp::Target(DVec3::new(0.0, 0.0, -0.01)));
                } else {
                    let tip = Tip { radius_m: 0.08, ..Tip::default() };
                    sheet.pose(0, middle_m - DVec3::new(0.0, 0.0, 0.01), tip);
                }
                let mut steps = |steps: u64| {
                    (0..steps).for_each(|_| sheet.do_step());
                    sheet.work.done_j
                };
                let before_j = steps(6000);
                let drift_j = steps(1000) - before_j;
                let energy_j = sheet.energies().spring_j + sheet.energies().anchor_j;
                assert!(drift_j.abs() < 1e-6 * energy_j, "{integrator}, {grasps}: {drift_j} J beside {energy_j} J");
            }
        }
    }

    /// Without damping, all work of a tip becomes energy of the tissue, except what friction takes as its disc slides.
    #[test]
    fn the_work_of_a_tip_that_slides_is_the_energy_of_the_sheet() {
        for friction in [0.0, 0.4] {
            let mut sheet = sheet(&[
                "sheet.points=[31, 21]",
                "damping.coefficient_n_s_per_m=0",
                "stepping.integrator=exponential3",
                "stepping.substeps=4",
            ]);
            let tip = Tip { radius_m: 0.07, friction, ..Tip::default() };
            let smooth = |t: f64| {
                let t = t.clamp(0.0, 1.0);
                t * t * t * (10.0 - 15.0 * t + 6.0 * t * t)
            };
            let (mut heat_j, mut before) = (0.0, None);
            for step in 0..900 {
                let t = f64::from(step) * 1e-3;
                let along_m = 0.5 * smooth((t - 0.2) / 0.7);
                let place_m = DVec3::new(0.25 + along_m, 0.33 + 0.1 * along_m, 0.001 - 0.05 * smooth(t / 0.2));
                sheet.pose(0, place_m, tip);
                sheet.do_step();
                let Energy { kinetic_j, spring_j, anchor_j } = sheet.energies();
                let (energy_j, work_j) = (kinetic_j + spring_j + anchor_j, sheet.work.done_j);
                // Friction times the way of the disc over the moved surface.
                let tool = &sheet.contacts.tools[0];
                let (_, [x, y]) = tool
                    .footprint
                    .surface(|point| displacement_m(&sheet.model, &sheet.tables.layout, &sheet.state, point));
                let across_n = tool.force_n - tool.force_n.dot(tool.normal) * tool.normal;
                let now = (across_n, tool.footprint.anchor_m(), [x, y]);
                let (before_n, anchor_m, along) = before.replace(now).unwrap_or(now);
                let way_m = now.1 - anchor_m;
                heat_j += 0.25 * (before_n + across_n).dot(way_m.x * (along[0] + x) + way_m.y * (along[1] + y));
                // The work of an impulse is counted by the speed after it, so a little too high; the heat is
                // summed once a step, and the disc sticks and slips within one.
                let part = (work_j - heat_j) / energy_j;
                assert!(
                    step < 200 || (0.98..1.03).contains(&part),
                    "{friction}, {step}: {work_j} - {heat_j} J for {energy_j} J"
                );
            }
        }
    }

    /// Impulses that move a surface and stop it again cancel: their sum does no work, and the guard would take
    /// the energy for a fault. Rounding of that sum decided whether such a tip touched at all.
    #[test]
    fn a_tip_that_is_put_into_tissue_at_rest_presses_and_does_the_work_that_the_tissue_gets() {
        for integrator in ["central", "exponential2", "exponential3", "exponential4", "rk4"] {
            for friction in [0.0, 0.4] {
                for precision in ["f32", "f64"] {
                    let set = [format!("stepping.integrator={integrator}"), format!("stepping.precision={precision}")];
                    let mut sheet =
                        sheet(&[&set[0], &set[1], "sheet.points=[21, 21]", "damping.coefficient_n_s_per_m=0"]);
                    let place_m = sheet.model.shape().rest_m(sheet.model.points().nth(220).unwrap()) - 0.01 * DVec3::Z;
                    sheet.pose(0, place_m, Tip { radius_m: 0.06, friction, ..Tip::default() });
                    for step in 0..400 {
                        sheet.do_step();
                        let Energy { kinetic_j, spring_j, anchor_j } = sheet.energies();
                        let (energy_j, work_j) = (kinetic_j + spring_j + anchor_j, sheet.work.done_j);
                        let part = work_j / energy_j;
                        // Two-step schemes can't stop the surface at once: the tool takes that energy back in
                        // the next step.
                        let is_right = part > 0.9 && (part < 1.1 || integrator == "central");
                        assert!(is_right, "{set:?}, {friction}, {step}: {work_j} J for {energy_j} J");
                        let is_free = sheet.tool_contact(0).unwrap().contact_state == ContactState::Free;
                        // Its surface bounces, so it may let go later.
                        assert!(!is_free || integrator == "central" && step > 0, "{set:?}, {friction}, {step}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_coupling_pulls_with_its_spring_and_its_damper() {
        // Points so heavy that they hardly move.
        let mut sheet = sheet(&["sheet.point_mass_kg=1000"]);
        let coupling = Coupling::Spring { stiffness_n_per_m: 100.0, damping_n_s_per_m: 3.0 };
        let tip = Tip { radius_m: 0.03, grasps: true, coupling, ..Tip::default() };
        let (held_m, step_m) = (DVec3::new(0.13, 0.12, 0.0), DVec3::new(2e-4, -1e-4, 5e-4));
        sheet.pose(0, held_m, tip);
        sheet.step().unwrap();
        for step in 1..=10 {
            sheet.pose(0, held_m + f64::from(step) * step_m, tip);
            sheet.step().unwrap();
            let expected_n = -(100.0 * f64::from(step) * step_m + 3.0 * step_m * 1000.0);
            let felt_n = sheet.tool_contact(0).unwrap().force_on_tool_n;
            assert!(felt_n.distance(expected_n) < 1e-3 * expected_n.length(), "{step}: {felt_n} {expected_n}");
        }
    }

    #[test]
    fn a_disc_on_fixed_points_alone_exerts_no_force() {
        for coupling in [Coupling::Constraint, Coupling::Spring { stiffness_n_per_m: 100.0, damping_n_s_per_m: 1.0 }] {
            for grasps in [false, true] {
                let mut sheet = sheet(&["sheet.fixed=[[3, 3], [3, 4], [4, 3], [4, 4]]"]);
                let spacing_m = sheet.model.unit_m;
                // In the middle of a cell, smaller than it: its four corners alone are under the disc.
                let place_m = DVec3::new(3.5, 3.5, 0.0) * spacing_m;
                let tip = Tip { radius_m: 0.1 * spacing_m, grasps, coupling, ..Tip::default() };
                for step in 0..20 {
                    sheet.pose(0, place_m - 1e-3 * f64::from(step) * DVec3::Z, tip);
                    sheet.step().unwrap();
                    assert_eq!(sheet.tool_contact(0).unwrap().force_on_tool_n, DVec3::ZERO, "{tip:?}");
                }
                assert_eq!(sheet.largest_displacement_m(), 0.0);
            }
        }
    }
}
