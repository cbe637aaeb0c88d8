//! The deadband: a sample is sent only if the client could feel the difference, or after a long time without a sample.
//!
//! The server knows what the client renders: the client repeats the tissue from the last sample along the tool's path,
//! and the server has just played that path. So the server evaluates the same law, and sends a sample when the true
//! force differs from it by more than the fraction δ. By Weber's law, a δ of about 10 % is not felt.

use glam::DVec3;

use crate::law::Law;
use crate::local::{LocalModel, Touching};

/// Smaller differences are not worth a message, N.
pub const LEAST_N: f64 = 0.01;

/// Longest time without a sample for a rendering client, s: well below `envelope::FRESH_S`.
pub const HEARTBEAT_S: f64 = 0.04;

/// One tool's deadband.
#[derive(Debug, Clone)]
pub struct ForceDeadband {
    fraction: f64,
    sent: Option<(LocalModel, Touching)>,
}

impl ForceDeadband {
    /// A deadband that is exceeded when the force differs by more than `fraction` of itself; 0 means at every step.
    pub fn new(fraction: f64) -> Self {
        ForceDeadband { fraction, sent: None }
    }

    /// Whether the client's force is off by too much at the tool's present place, of which `model` is. Call it at each
    /// step: it follows the client along its path.
    pub fn is_exceeded(&mut self, model: &LocalModel, law: &Law) -> bool {
        let Some((sent, touching)) = &mut self.sent else { return true };
        touching.move_to(sent, law, model.place_m);
        let rendered_n: DVec3 = touching.force_n(sent, law, model.velocity_m_per_s);
        let most_n = (self.fraction * model.force_n.length()).max(LEAST_N);
        self.fraction <= 0.0 || (model.force_n - rendered_n).length() > most_n
    }

    /// Records that `model` was sent: the client renders it from now on.
    pub fn send(&mut self, model: &LocalModel, law: &Law) {
        self.sent = Some((*model, Touching::at_sample(model, law)));
    }
}
