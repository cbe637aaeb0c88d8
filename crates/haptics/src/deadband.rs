//! The deadband: a sample is sent only if the client could feel the difference, or after a long time without a sample.
//!
//! The server knows what the client renders: the client continues from the last sample along the tool's path, and the
//! server has just played that path. So the server evaluates the same law, and sends a sample when the true force
//! differs from the result by more than the fraction δ. By Weber's law, a δ of about 10 % is not felt.

use glam::DVec3;

use crate::force_law::Law;
use crate::local_model::{LocalModel, Touching};

/// Difference of the force up to which no sample is sent, however small the force is, N. Without effect if the
/// deadband's fraction is 0.
pub const MIN_N: f64 = 0.01;

/// Longest interval between two samples for a client that renders, s: below [`crate::envelope::FRESH_S`]. The caller
/// of [`ForceDeadband::is_exceeded`] keeps it.
pub const HEARTBEAT_S: f64 = 0.04;

/// Deadband of one tool: the last sample that was sent, and what the client renders from it.
#[derive(Debug, Clone)]
pub struct ForceDeadband {
    fraction: f64,
    sent: Option<(LocalModel, Touching)>,
}

impl ForceDeadband {
    /// Creates the deadband of a tool of which no sample was sent yet. It is exceeded when the client's force differs
    /// from the true one by more than `fraction` (δ, such as 0.1) of the true one; with 0 or less it is exceeded at
    /// every step.
    pub fn new(fraction: f64) -> Self {
        ForceDeadband { fraction, sent: None }
    }

    /// Returns whether the client's force is wrong by too much at the tool's present place, which `model` describes:
    /// |f − f_r| > max(δ·|f|, [`MIN_N`]), with f the tissue's force and f_r the force that the client renders there
    /// from the last sample and `law`, the law by which it renders that sample. True before the first sample. Call it
    /// once at each step: it also moves the client's simulated touch along the path.
    pub fn is_exceeded(&mut self, model: &LocalModel, law: &Law) -> bool {
        let Some((sent, touching)) = &mut self.sent else { return true };
        touching.move_to(sent, law, model.place_m);
        let rendered_n: DVec3 = touching.force_n(sent, law, model.velocity_m_per_s);
        let most_n = (self.fraction * model.force_n.length()).max(MIN_N);
        self.fraction <= 0.0 || (model.force_n - rendered_n).length() > most_n
    }

    /// Records that `model` was sent, from which the client renders from now on with `law`, the law that it names.
    /// Replaces the last sample.
    pub fn send(&mut self, model: &LocalModel, law: &Law) {
        self.sent = Some((*model, Touching::at_sample(model, law)));
    }
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;
    use crate::local_model::ContactState;

    /// A spring whose forces at the depths of these tests are without rounding.
    fn law() -> Law {
        Law::linear(512.0, 0.5)
    }

    /// Of a tool at rest at a depth, under a force along z.
    fn model(depth_m: f64, force_n: f64) -> LocalModel {
        LocalModel {
            sequence: 1,
            client_time_s: 0.0,
            step: 1,
            place_m: -depth_m * DVec3::Z,
            velocity_m_per_s: DVec3::ZERO,
            force_n: force_n * DVec3::Z,
            stiffness_n_per_m: DMat3::IDENTITY * 512.0,
            damping_n_s_per_m: DMat3::IDENTITY * 0.5,
            surface_m: DVec3::ZERO,
            normal: DVec3::Z,
            curvature_per_m: DMat3::ZERO,
            valid_m: 0.01,
            friction: 0.2,
            contact_state: ContactState::Sticking,
            law: 0,
        }
    }

    /// A deadband whose client renders the law itself, which it was sent at a depth of 1/512 m.
    fn sent(fraction: f64) -> ForceDeadband {
        let mut deadband = ForceDeadband::new(fraction);
        deadband.send(&model(1.0 / 512.0, 1.0), &law());
        deadband
    }

    #[test]
    fn a_difference_is_sent_if_it_is_more_than_the_fraction_of_the_force() {
        let mut deadband = sent(0.5);
        // The client renders 1 N here, whatever the true force.
        for (true_n, is_sent) in [(1.0, false), (2.0, false), (2.01, true), (0.7, false), (0.66, true)] {
            assert_eq!(deadband.is_exceeded(&model(1.0 / 512.0, true_n), &law()), is_sent, "{true_n} N");
        }
        // It follows the tool: deeper, the client renders more by itself.
        assert!(!deadband.is_exceeded(&model(4.0 / 512.0, 4.0), &law()));
        assert!(deadband.is_exceeded(&model(4.0 / 512.0, 1.0), &law()));
    }

    #[test]
    fn differences_that_no_hand_feels_are_not_sent_and_a_first_sample_and_each_of_no_fraction_are() {
        let mut deadband = sent(0.1);
        for (true_n, is_sent) in [(0.0, false), (0.8 * MIN_N, false), (1.2 * MIN_N, true)] {
            assert_eq!(deadband.is_exceeded(&model(-0.001, true_n), &law()), is_sent, "{true_n} N");
        }
        assert!(ForceDeadband::new(0.1).is_exceeded(&model(0.0, 0.0), &law()));
        assert!(sent(0.0).is_exceeded(&model(1.0 / 512.0, 1.0), &law()));
    }
}
