//! The deadband: a sample is sent only if the client could tell the difference, or if it has not heard for long.
//!
//! What the client renders is known here: it repeats the tissue from the last sample along the tool's way, and that way
//! is what the server has just played. So the same law is run beside it, and a sample goes out when the true force has
//! left it by more than δ of itself. Weber's law says that δ of about 10 % is not felt.

use glam::DVec3;

use super::law::Law;
use super::local::{LocalModel, Touching};

/// Differences below are not worth a message, N.
pub const LEAST_N: f64 = 0.01;

/// Longest time without a sample for who renders, s: well below `envelope::FRESH_S`.
pub const HEARTBEAT_S: f64 = 0.04;

/// One tool's deadband.
#[derive(Debug, Clone)]
pub struct Deadband {
    fraction: f64,
    sent: Option<(LocalModel, Touching)>,
}

impl Deadband {
    /// Left when the force differs by more than `fraction` of itself; 0 is left always.
    pub fn new(fraction: f64) -> Self {
        Deadband { fraction, sent: None }
    }

    /// Whether the client is off by too much at the tool's place now, of which `model` is. To be asked at each step: the
    /// client's way is gone along.
    pub fn is_left(&mut self, model: &LocalModel, law: &Law) -> bool {
        let Some((sent, touching)) = &mut self.sent else { return true };
        touching.move_to(sent, law, model.place_m);
        let rendered_n: DVec3 = touching.force_n(sent, law, model.velocity_m_per_s);
        let most_n = (self.fraction * model.force_n.length()).max(LEAST_N);
        self.fraction <= 0.0 || (model.force_n - rendered_n).length() > most_n
    }

    /// `model` is sent: what the client renders from now on.
    pub fn send(&mut self, model: &LocalModel, law: &Law) {
        self.sent = Some((*model, Touching::at_sample(model, law)));
    }
}
