//! Local models of one tool: what a sample contains about the tissue around it (`palpate_haptics::local_model`).

use std::sync::{Arc, Mutex, PoisonError};

use glam::{DMat3, DVec3};
use palpate_haptics::force_law::{Law, Row};
use palpate_haptics::local_model::{self, ContactState, LocalModel};

use palpate_tissue::response::tangent::Tangent;
use palpate_tissue::{RestSurface, TangentInput, ToolContact};

/// Forces below this do not limit the distance in which a model is valid, N.
const MIN_N: f64 = 0.05;

/// Number of samples after first contact in which the tissue may bounce off the tool.
const BOUNCE_SAMPLES: u32 = 5;

/// Maker of the local models of one tool in one stream. It remembers the surface that the tool last met, so give it
/// every sample of the stream in order.
#[derive(Debug, Clone)]
pub struct Modeller {
    law: Arc<Law>,
    /// Number of the law in the stream.
    number: u32,
    /// Whether stiffness K and damping B are computed from the tissue around the tool under a touch too, not only
    /// under a grasp.
    touches_too: bool,
    /// Contact state in the newest model.
    contact_state: ContactState,
    /// Place and normal of the surface when the tool last did not touch it.
    surface: Option<(DVec3, DVec3)>,
    /// Number of consecutive samples in which the tool was below the surface and did not touch it.
    bounced: u32,
    sequence: u64,
    /// The newest stiffness that was computed at the tool.
    tangent: Arc<Mutex<Option<Tangent>>>,
}

/// A pending computation of the stiffness and damping under a tool, for a thread other than the stepping threads. It
/// owns a copy of the tissue around the tool.
#[derive(Debug)]
pub struct StiffnessJob {
    surroundings: TangentInput,
    tangent: Arc<Mutex<Option<Tangent>>>,
}

impl StiffnessJob {
    /// Computes the stiffness and damping, which takes some time, and passes them to the tool's modeller: its next
    /// models have them. If the tool has let go meanwhile, they are discarded.
    pub fn work(self) {
        let tangent = self.surroundings.tangent();
        *self.tangent.lock().unwrap_or_else(PoisonError::into_inner) = Some(tangent);
    }
}

impl Modeller {
    /// Creates a modeller for a tool on a tissue with `law`, whose number in the stream is `number`. A grasp is
    /// rendered with the stiffness K (N/m) and damping B (N·s/m) of the tissue around the tool, which are recomputed
    /// continually; a touch is rendered with the law, and K and B are computed at it only if `touches_too`.
    pub fn new(number: u32, law: Arc<Law>, touches_too: bool) -> Self {
        let (contact_state, tangent) = (ContactState::Free, Arc::default());
        Modeller { law, number, touches_too, contact_state, surface: None, bounced: 0, sequence: 0, tangent }
    }

    /// Resets the modeller after the tool has let go: a further touch is a new one, with the law's K and B. Numbers
    /// of models keep rising, because a client refuses a model that is not newer than the last.
    pub fn let_go(&mut self) {
        let first = Modeller::new(self.number, self.law.clone(), self.touches_too);
        *self = Modeller { sequence: self.sequence, ..first };
    }

    /// Makes the models from the next one on refer to another law, `law`, whose number in the stream is `number`.
    pub fn change_law(&mut self, number: u32, law: Arc<Law>) {
        (self.number, self.law) = (number, law);
    }

    /// Returns whether K and B should be computed at the tool's present place ([`Modeller::refinement`]): under a
    /// grasp always, under a touch if the modeller was created with `touches_too`, otherwise never. The contact state
    /// is that of the newest model.
    pub fn wants_refinement(&self) -> bool {
        match self.contact_state {
            ContactState::Free => false,
            ContactState::Sticking | ContactState::Sliding => self.touches_too,
            ContactState::Holding => true,
        }
    }

    /// Returns a computation of stiffness and damping from `surroundings`, a copy of the tissue around the tool.
    /// Nothing is computed before [`StiffnessJob::work`].
    pub fn refinement(&self, surroundings: TangentInput) -> StiffnessJob {
        StiffnessJob { surroundings, tangent: self.tangent.clone() }
    }

    /// Returns the model after step `step`. `feel` is the tool's motion and force, `client_time_s` the client time of
    /// its place, s. Models are numbered from 1 on. K and B are the newest that were computed at the tool, or else
    /// the law's at this depth.
    pub fn model(&mut self, feel: &ToolContact, step: u64, client_time_s: f64) -> LocalModel {
        self.sequence += 1;
        self.contact_state = feel.contact_state;
        let touches = matches!(feel.contact_state, ContactState::Sticking | ContactState::Sliding);
        let below = self.surface.is_some_and(|(surface_m, normal)| (surface_m - feel.place_m).dot(normal) > 0.0);
        // On contact, the tissue moves away from the tool for a moment. Its place then is not where the tool will
        // meet it.
        self.bounced = if below && feel.contact_state == ContactState::Free { self.bounced + 1 } else { 0 };
        if touches {
            // A dent tilts the surface under a tool; the law refers to the surface at rest.
            let height_m = (feel.touching_m - feel.surface_m).dot(feel.normal);
            let above = |rest: RestSurface| (rest.place_m + height_m * rest.normal, rest.normal);
            self.surface = feel.rest.map(above).or(self.surface);
        } else if !(1..=BOUNCE_SAMPLES).contains(&self.bounced) {
            self.surface = Some((feel.touching_m, feel.normal));
        }
        let (mut surface_m, normal) = self.surface.unwrap_or((feel.touching_m, DVec3::Z));
        let mut depth_m = (surface_m - feel.place_m).dot(normal);
        if touches {
            // Put the surface where the law gives this force, so that the law passes through this sample.
            let damping = self.law.at_depth(depth_m).damping_n_s_per_m;
            let pressure_n = feel.force_on_tool_n.dot(normal) + damping * feel.velocity_m_per_s.dot(normal);
            if pressure_n > 0.0 {
                depth_m = self.law.depth_of(pressure_n);
                surface_m = feel.place_m + depth_m * normal;
            }
        }
        let row = self.law.at_depth(depth_m);
        let mut newest = self.tangent.lock().unwrap_or_else(PoisonError::into_inner);
        if !self.wants_refinement() {
            *newest = None;
        }
        let (stiffness_n_per_m, damping_n_s_per_m) = match newest.as_ref() {
            Some(tangent) => (tangent.stiffness_n_per_m, tangent.damping_n_s_per_m),
            None => (
                around(normal, row.stiffness_n_per_m, row.across_n_per_m),
                around(normal, row.damping_n_s_per_m, row.across_n_s_per_m),
            ),
        };
        drop(newest);
        let force_n = feel.force_on_tool_n.length();
        LocalModel {
            sequence: self.sequence,
            client_time_s,
            step,
            place_m: feel.place_m,
            velocity_m_per_s: feel.velocity_m_per_s,
            force_n: feel.force_on_tool_n,
            stiffness_n_per_m,
            damping_n_s_per_m,
            surface_m,
            normal,
            curvature_per_m: feel.rest.map_or(DMat3::ZERO, |rest| rest.curvature_per_m),
            valid_m: local_model::valid_m(force_n, MIN_N, self.hardening(depth_m, &row)),
            friction: feel.friction,
            contact_state: feel.contact_state,
            law: self.number,
        }
    }

    /// Returns the change of stiffness with depth, N/m².
    fn hardening(&self, depth_m: f64, row: &Row) -> f64 {
        let further = self.law.at_depth(depth_m + self.law.step_m);
        (further.stiffness_n_per_m - row.stiffness_n_per_m).abs() / self.law.step_m
    }
}

/// Returns a matrix with one value along a direction and another across it.
fn around(normal: DVec3, along: f64, across: f64) -> DMat3 {
    let outer = DMat3::from_cols(normal * normal.x, normal * normal.y, normal * normal.z);
    outer * (along - across) + DMat3::IDENTITY * across
}

#[cfg(test)]
mod tests {

    use super::*;

    /// Returns the contact of a tool at a height, over a surface that is level at `surface_m`.
    fn tool_contact(height_m: f64, surface_m: f64, contact_state: ContactState) -> ToolContact {
        ToolContact {
            place_m: height_m * DVec3::Z,
            velocity_m_per_s: DVec3::ZERO,
            contact_state,
            force_on_tool_n: DVec3::ZERO,
            lever_m: DVec3::ZERO,
            surface_m: surface_m * DVec3::Z,
            touching_m: surface_m * DVec3::Z,
            anchor_m: DVec3::ZERO,
            normal: DVec3::Z,
            rest: None,
            friction: 0.2,
            is_on_fixed: false,
        }
    }

    fn modeller() -> Modeller {
        Modeller::new(0, Arc::new(Law::linear(400.0, 0.5)), false)
    }

    #[test]
    fn a_matrix_has_one_value_along_the_normal_and_another_across() {
        let normal = DVec3::new(0.48, 0.6, 0.64);
        let matrix = around(normal, 400.0, 150.0);
        assert!((matrix * normal - 400.0 * normal).length() < 1e-9);
        for across in [normal.any_orthogonal_vector(), normal.cross(normal.any_orthogonal_vector())] {
            assert!((matrix * across - 150.0 * across).length() < 1e-9);
        }
    }

    #[test]
    fn a_surface_that_the_tool_knocks_away_stays_in_the_model_for_some_samples() {
        let mut modeller = modeller();
        assert_eq!(modeller.model(&tool_contact(0.001, 0.0, ContactState::Free), 0, 0.0).surface_m, DVec3::ZERO);
        // A surface below the tool is used as it is.
        assert_eq!(modeller.model(&tool_contact(0.001, -0.0005, ContactState::Free), 1, 0.0).surface_m.z, -0.0005);
        // Knocked away: the tool is below the former surface, and does not touch it.
        for step in 0..BOUNCE_SAMPLES {
            let model = modeller.model(&tool_contact(-0.001, -0.002, ContactState::Free), 2 + u64::from(step), 0.0);
            assert_eq!(model.surface_m.z, -0.0005, "sample {step}");
        }
        // It did not come back: the model has its present place.
        assert_eq!(modeller.model(&tool_contact(-0.001, -0.002, ContactState::Free), 20, 0.0).surface_m.z, -0.002);
    }

    #[test]
    fn a_grasp_has_the_newest_stiffness_that_was_computed_and_the_laws_before() {
        let mut modeller = modeller();
        let by_law = DMat3::IDENTITY * 400.0;
        let near = |a: DMat3, b: DMat3| (a - b).abs_diff_eq(DMat3::ZERO, 1e-9);
        assert!(near(modeller.model(&tool_contact(0.0, 0.0, ContactState::Holding), 0, 0.0).stiffness_n_per_m, by_law));
        let tangent = Tangent {
            stiffness_n_per_m: DMat3::IDENTITY * 123.0,
            damping_n_s_per_m: DMat3::IDENTITY * 4.0,
            drag_n_s_per_m: 0.0,
            mass_kg: 0.0,
            iterations: 1,
        };
        *modeller.tangent.lock().unwrap_or_else(PoisonError::into_inner) = Some(tangent);
        let model = modeller.model(&tool_contact(0.0, 0.0, ContactState::Holding), 1, 0.0);
        assert_eq!(model.stiffness_n_per_m, tangent.stiffness_n_per_m);
        assert_eq!(model.damping_n_s_per_m, tangent.damping_n_s_per_m);
        // It belongs to the place that was grasped.
        modeller.model(&tool_contact(0.001, 0.0, ContactState::Free), 2, 0.0);
        assert!(near(modeller.model(&tool_contact(0.0, 0.0, ContactState::Holding), 3, 0.0).stiffness_n_per_m, by_law));
    }

    #[test]
    fn a_stiffness_is_valid_as_far_as_half_its_change_is_a_tenth_of_the_force() {
        let holding =
            ToolContact { force_on_tool_n: DVec3::new(0.0, 1.2, 1.6), ..tool_contact(0.0, 0.0, ContactState::Holding) };
        // The stiffness of a spring does not change.
        assert!(modeller().model(&holding, 0, 0.0).valid_m > 1.0);
        // This one gets 3 N/m stiffer with each millimetre.
        let row = |depth_m: f64| Row {
            force_n: 50.0 * depth_m + 1500.0 * depth_m * depth_m,
            stiffness_n_per_m: 50.0 + 3000.0 * depth_m,
            ..Law::linear(50.0, 0.5).at_depth(0.0)
        };
        let law = Law { step_m: 0.002, rows: [0.0, 0.002, 0.004, 0.006].map(row).to_vec(), is_coarse: false };
        let mut modeller = Modeller::new(0, Arc::new(law), false);
        for depth_m in [0.0, 0.002] {
            let feel = ToolContact { place_m: -depth_m * DVec3::Z, ..holding };
            let valid_m = modeller.model(&feel, 0, 0.0).valid_m;
            let change_n = 0.5 * 3000.0 * valid_m * valid_m;
            assert!((change_n - 0.2).abs() < 1e-6, "{depth_m} m deep: {valid_m} m, {change_n} N");
        }
    }

    #[test]
    fn models_are_numbered_from_1_on_and_go_on_after_the_tool_has_let_go() {
        let mut modeller = modeller();
        let next =
            |modeller: &mut Modeller| modeller.model(&tool_contact(0.001, 0.0, ContactState::Free), 0, 0.0).sequence;
        assert_eq!([next(&mut modeller), next(&mut modeller), next(&mut modeller)], [1, 2, 3]);
        modeller.let_go();
        assert_eq!(next(&mut modeller), 4);
    }
}
