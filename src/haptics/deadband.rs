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

/// Longest time without a sample, s: well below `envelope::FRESH_S`.
pub const HEARTBEAT_S: f64 = 0.04;

/// One tool's deadband.
#[derive(Debug, Clone)]
pub struct Deadband {
    delta: f64,
    sent: Option<(LocalModel, Touching)>,
    sent_s: f64,
}

impl Deadband {
    /// Sends when the force differs by more than `delta` of itself; 0 sends always.
    pub fn new(delta: f64) -> Self {
        Deadband { delta, sent: None, sent_s: f64::NEG_INFINITY }
    }

    /// Whether `model`, that of the tool's place now, is to be sent.
    pub fn is_due(&mut self, model: &LocalModel, law: &Law, now_s: f64) -> bool {
        let due = match &mut self.sent {
            _ if self.delta <= 0.0 => true,
            None => true,
            Some((sent, touching)) => {
                touching.move_to(sent, law, model.place_m);
                let rendered_n: DVec3 = touching.force_n(sent, law, model.velocity_m_per_s);
                let most_n = (self.delta * model.force_n.length()).max(LEAST_N);
                (model.force_n - rendered_n).length() > most_n || now_s - self.sent_s >= HEARTBEAT_S - 1e-9
            }
        };
        if due {
            self.sent = Some((*model, Touching::at_sample(model, law)));
            self.sent_s = now_s;
        }
        due
    }
}
