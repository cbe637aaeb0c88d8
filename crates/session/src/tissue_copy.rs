//! A copy of a session's tissue for one tool, which a client steps itself without delay
//! ([`palpate_haptics::prediction`]).

use std::sync::Arc;

use glam::DVec3;
use palpate_haptics::{ContactState, Predicted, Predictor, Tip};

use super::Session;
use super::command::{Command, Due};
use palpate_refusal::{Result, legible, number};
use palpate_tissue::Model;
use palpate_tissue::scene::action_check::check_tip;
use palpate_tissue::scene::script::Action;

/// Number of the copy's only tool.
const TOOL: u32 = 0;

/// Limit of a client copy's work in a millisecond, in awake points times substeps: this takes up to 1 ms with a tip
/// on the tissue. Beyond it the copy predicts nothing.
pub const TICK_POINT_SUBSTEPS: u64 = 100_000;

/// Largest radius of a tip on a copy, in lengths of an edge: the cost of contact grows with the area of the tip.
const MAX_EDGES: f64 = 32.0;

/// A client's usual tick, s.
const TICK_S: f64 = 1e-3;

/// Time behind the client's above which a copy skips to the present, s: the client has paused.
const MAX_BEHIND_S: f64 = 0.005;

/// A copy of a tissue with one tool, which predicts the force on the tool between a server's samples. It begins at
/// rest, and knows nothing of other tools.
pub struct TissueCopy {
    session: Session,
    tip: Tip,
    due: Vec<Due>,
    /// The client's time minus the copy's, s; `None` before the first tick.
    ahead_s: Option<f64>,
    place_m: DVec3,
    /// Points times substeps that may be computed in a tick.
    most_point_substeps: u64,
}

impl TissueCopy {
    /// Creates a copy at rest, for a tool with this tip, without a limit of its work and without a check of the tip.
    pub fn new(model: &Arc<Model>, tip: Tip) -> Self {
        let (session, due) = (Session::new(model), Vec::with_capacity(1));
        TissueCopy { session, tip, due, ahead_s: None, place_m: DVec3::ZERO, most_point_substeps: u64::MAX }
    }

    /// Returns this copy with a limit of awake points times substeps per millisecond. While more points are awake
    /// than that allows, it is not stepped and predicts nothing, because the loop that it runs in must not be late.
    #[must_use]
    pub fn within(self, most_point_substeps: u64) -> Self {
        TissueCopy { most_point_substeps, ..self }
    }

    /// Creates a copy at rest of a tissue that a server describes, limited to what a client can step in time
    /// ([`TICK_POINT_SUBSTEPS`]).
    ///
    /// # Errors
    /// Refuses a tip that does not fit the tissue, and a radius above 32 lengths of an edge (`tip.radius_m`).
    pub fn for_client(model: &Arc<Model>, tip: Tip) -> Result<Self> {
        let shape = model.shape();
        check_tip("tip", shape, &tip)?;
        let most_m = MAX_EDGES * shape.edge_m();
        let range = format!("at most {} for a copy of this tissue, {MAX_EDGES} lengths of an edge", legible(most_m));
        number("tip.radius_m", tip.radius_m, &range, |radius_m| radius_m <= most_m)?;
        Ok(TissueCopy::new(model, tip).within(TICK_POINT_SUBSTEPS))
    }

    /// Steps until `now_s`, with the tool on a straight path to `place_m`. The number of steps is rounded, so that
    /// ticks that are a little early or late have one step each. `None` if too many points are awake.
    fn step_to(&mut self, now_s: f64, place_m: DVec3) -> Option<()> {
        let step_s = self.session.model().scene.stepping.rate_hz.recip();
        let time_s = self.session.time_s();
        let behind_s = self.ahead_s.map(|ahead_s| now_s - ahead_s - time_s);
        let behind_s = behind_s.filter(|behind_s| *behind_s <= MAX_BEHIND_S.max(2.0 * step_s)).unwrap_or_else(|| {
            // The tool gets there at once; its largest speed limits how far it moves in a step.
            (self.ahead_s, self.place_m) = (Some(now_s - step_s - time_s), place_m);
            step_s
        });
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let steps = (behind_s / step_s).round() as u32;
        for step in 1..=steps {
            if self.is_too_much(step_s) {
                return None;
            }
            let on_way_m = self.place_m.lerp(place_m, f64::from(step) / f64::from(steps));
            let action = Action::Pose { place_m: on_way_m, velocity_m_per_s: None, tip: self.tip };
            self.due.push(Due::in_time(Command::new(TOOL, None, action)));
            self.session.advance(&mut self.due, |_| {});
        }
        if steps > 0 {
            self.place_m = place_m;
        }
        Some(())
    }

    /// Returns whether a tick's steps take more than their limit.
    #[allow(clippy::cast_precision_loss)]
    fn is_too_much(&self, step_s: f64) -> bool {
        let substeps = f64::from(self.session.model().plan.substeps) * (TICK_S / step_s).max(1.0);
        self.session.tissue().awake_points() as f64 * substeps > self.most_point_substeps as f64
    }
}

impl Predictor for TissueCopy {
    fn feel(&mut self, now_s: f64, place_m: DVec3) -> Option<Predicted> {
        if self.session.hold_reason().is_some() {
            return None;
        }
        self.step_to(now_s, place_m)?;
        let felt = self.session.tissue().tool_contact(TOOL as usize);
        let free = Predicted { force_n: DVec3::ZERO, contact_state: ContactState::Free };
        Some(felt.map_or(free, |feel| Predicted { force_n: feel.force_on_tool_n, contact_state: feel.contact_state }))
    }
}

impl std::fmt::Debug for TissueCopy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let TissueCopy { ahead_s, place_m, most_point_substeps, .. } = self;
        let mut fields = f.debug_struct("TissueCopy");
        fields.field("ahead_s", ahead_s).field("place_m", place_m).field("most_point_substeps", most_point_substeps);
        fields.finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the place at a tick of a press of 3 mm and a stroke.
    fn place_m(tick: u32) -> DVec3 {
        let time_s = f64::from(tick) * TICK_S;
        let down = (time_s / 0.1).min(1.0);
        DVec3::new(0.05 + 0.02 * (time_s - 0.1).max(0.0), 0.05, 0.002 - 0.005 * down)
    }

    fn model() -> Arc<Model> {
        Model::parse(
            "paper",
            palpate_tissue::scene::PAPER,
            &["sheet.points=[21, 21]", "sheet.spacing_m=0.005", "sheet.fixed=\"edges\""],
        )
        .unwrap()
    }

    /// Returns the forces of a session with equal poses at equal steps.
    fn truth_n(model: &Arc<Model>, ticks: u32) -> Vec<DVec3> {
        let (mut session, tip) = (Session::new(model), Tip::default());
        let felt = (0..ticks).map(|tick| {
            let action = Action::Pose { place_m: place_m(tick), velocity_m_per_s: None, tip };
            session.advance(&mut vec![Due::in_time(Command::new(0, None, action))], |_| {});
            session.tissue().tool_contact(0).map_or(DVec3::ZERO, |feel| feel.force_on_tool_n)
        });
        felt.collect()
    }

    #[test]
    fn a_copy_feels_what_a_session_does_at_the_same_places_also_when_ticks_are_early_and_late() {
        let model = model();
        let truth_n = truth_n(&model, 300);
        assert!(truth_n[299].length() > 0.01, "{}", truth_n[299]);
        let mut copy = TissueCopy::new(&model, Tip::default());
        for (tick, truth_n) in (0..300).zip(truth_n) {
            let early_s = [0.0, -3e-4, 4e-4, 1e-4][tick as usize % 4];
            let felt = copy.feel(17.0 + f64::from(tick) * TICK_S + early_s, place_m(tick)).unwrap();
            assert_eq!(felt.force_n, truth_n, "{tick}");
        }
    }

    #[test]
    fn a_copy_does_the_steps_of_ticks_that_were_left_out_and_goes_on_after_a_pause() {
        let model = model();
        let mut copy = TissueCopy::new(&model, Tip::default());
        let steps = |copy: &TissueCopy| copy.session.step_count();
        for (tick, expected) in [(0, 1), (1, 2), (5, 6), (15, 7), (15, 7), (16, 8), (5000, 9), (5001, 10)] {
            let felt = copy.feel(f64::from(tick) * TICK_S, place_m(tick.min(200))).unwrap();
            assert!(felt.force_n.is_finite() && steps(&copy) == expected, "{tick}: {} steps", steps(&copy));
        }
    }

    #[test]
    fn a_copy_with_slow_or_fast_steps_keeps_to_the_time() {
        for rate_hz in [1.0, 10.0, 50.0, 499.0, 1000.0, 5000.0] {
            let rate = format!("stepping.rate_hz={rate_hz}");
            let model = Model::parse(
                "paper",
                palpate_tissue::scene::PAPER,
                &["sheet.points=[9, 9]", "sheet.fixed=\"edges\"", &rate],
            )
            .unwrap();
            let mut copy = TissueCopy::new(&model, Tip::default());
            for tick in 0..2000 {
                let felt = copy.feel(3.0 + f64::from(tick) * TICK_S, DVec3::new(0.1, 0.1, 0.01)).unwrap();
                assert!(felt.force_n.is_finite());
            }
            let apart_s = (copy.session.time_s() - 2.0).abs();
            assert!(apart_s <= 2.0 / rate_hz + TICK_S, "{rate_hz} Hz: {} s", copy.session.time_s());
        }
    }

    #[test]
    fn a_copy_with_too_much_to_compute_tells_nothing() {
        let model = model();
        let mut copy = TissueCopy::new(&model, Tip::default()).within(50);
        let felt: Vec<_> = (0..200).map(|tick| copy.feel(f64::from(tick) * TICK_S, place_m(tick))).collect();
        // Nothing is computed at rest.
        assert!(felt[0].is_some() && felt[199].is_none());
    }
}
