//! Prediction: a client that simulates the tissue as well feels now what samples will tell a round trip later.
//!
//! A local model knows the tissue around one place. That is enough while a hand stays there, or where the tissue is alike on
//! all sides. Over a rim, a fold or the edge of a lump the true force turns or halves within 40 to 60 ms, and a hand that is
//! a round trip ahead meets what no sample has told yet. A client that has the tissue's model moves its own tool through a
//! copy of the tissue, without a delay ([`Predictor`]).
//!
//! **Samples decide.** Each tells how far the copy was off at the sample's own moment t0: e = f(t0) − c(t0), where c is the
//! copy's force. Rendered is c(now) + e, and of e no larger part than c(now) is of c(t0): a tip that leaves the tissue is let go of
//! smoothly. What only the server knows, such as another user's tool, so comes in a round trip late.
//! Where the server's tool was a little beside the client's at t0 (a place was lost, or was no news), the local model tells f at
//! the client's.
//!
//! **The better one is rendered.** The local model goes on beside the copy. When a sample comes, both are compared with it: what
//! each had forecast for t0. While the copy has been farther off, over some tenths of a second, and by more than a hand hardly
//! notices, the local model is rendered. A copy that a sample has not met yet is not rendered. So a copy of another tissue does no
//! harm for longer than that; and one that is nearly right stays, because it alone knows what comes next.

use std::collections::VecDeque;

use glam::DVec3;

use crate::local_model::{ContactState, is_after};

/// Time over which forecasts are compared, s.
const MEMORY_S: f64 = 0.3;

/// The other one is rendered when its mean squared error is smaller by this factor: two that are alike do not take turns.
const BETTER: f64 = 2.0;

/// A copy that is off by no more than this part of the force is rendered in any case.
const NEAR: f64 = 0.05;

/// A forecast for a moment is one of no more than this before and after it, s.
const GAP_S: f64 = 0.02;

/// What a tool feels in a copy of the tissue.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Predicted {
    /// Force of the copy on the tool, N.
    pub force_n: DVec3,
    /// Of the tool and the copy.
    pub contact_state: ContactState,
}

/// A copy of the tissue on the client's side, with the client's tool in it and no other.
pub trait Predictor: Send {
    /// What the tool feels that is at `place_m` at `now_s`, by the client's clock, which never goes back. None if the copy can't
    /// tell, for now or for good.
    fn feel(&mut self, now_s: f64, place_m: DVec3) -> Option<Predicted>;
}

/// What was computed in a tick, before the bias and the envelope.
#[derive(Debug, Clone, Copy)]
struct Forecast {
    time_s: f64,
    place_m: DVec3,
    copy_n: DVec3,
    predicted_n: DVec3,
    modelled_n: DVec3,
}

impl Forecast {
    /// At a moment between two ticks: a server plays a path at moments of its own.
    fn towards(&self, next: &Forecast, time_s: f64) -> Forecast {
        let part = ((time_s - self.time_s) / (next.time_s - self.time_s)).clamp(0.0, 1.0);
        Forecast {
            time_s,
            place_m: self.place_m.lerp(next.place_m, part),
            copy_n: self.copy_n.lerp(next.copy_n, part),
            predicted_n: self.predicted_n.lerp(next.predicted_n, part),
            modelled_n: self.modelled_n.lerp(next.modelled_n, part),
        }
    }
}

/// Forecasts that are kept: two seconds at 1 kHz.
const KEPT: usize = 2048;

/// A copy at work, for [`crate::Renderer::predict`].
pub struct Prediction {
    predictor: Box<dyn Predictor>,
    now: Option<Predicted>,
    past: VecDeque<Forecast>,
    /// e: the force of the newest sample less that of the copy then, and the size of that, N; none before the first.
    error_n: Option<(DVec3, f64)>,
    /// When the sample was taken that was compared last, s.
    compared_s: f64,
    /// Squares of the errors of the copy and of the local models, and of the force, N², which count less the older they are.
    squared: [f64; 3],
    is_worse: bool,
}

impl Prediction {
    /// Creates a prediction from a copy. Asks for the memory that ticks need.
    pub fn new(predictor: Box<dyn Predictor>) -> Self {
        Prediction {
            predictor,
            now: None,
            // A tick must not ask for memory.
            past: VecDeque::with_capacity(KEPT),
            error_n: None,
            compared_s: f64::NEG_INFINITY,
            squared: [0.0; 3],
            is_worse: false,
        }
    }

    /// Moves the tool in the copy.
    pub(crate) fn move_to(&mut self, now_s: f64, place_m: DVec3) {
        self.now = self.predictor.feel(now_s, place_m).filter(|felt| felt.force_n.is_finite());
    }

    /// Keeps what was forecast for this tick.
    pub(crate) fn keep(&mut self, time_s: f64, place_m: DVec3, modelled_n: DVec3) {
        let Some(felt) = self.now else { return };
        if self.past.len() == KEPT {
            self.past.pop_front();
        }
        let predicted_n = self.sum_n(felt);
        self.past.push_back(Forecast { time_s, place_m, copy_n: felt.force_n, predicted_n, modelled_n });
    }

    /// Compares what was forecast for the moment of a sample with it; `truth_n` is its force on a tool at a place.
    pub(crate) fn compare(&mut self, time_s: f64, truth_n: impl FnOnce(DVec3) -> DVec3) {
        let after = self.past.partition_point(|past| !is_after(past.time_s, time_s));
        // A sample of before the copy's time, or of long ago.
        let Some(before) = after.checked_sub(1).and_then(|at| self.past.get(at)) else { return };
        let next = self.past.get(after);
        if time_s - before.time_s > GAP_S || next.is_some_and(|next| next.time_s - time_s > GAP_S) {
            return;
        }
        // Of the newest moment there is nothing later.
        let then = next.map_or(*before, |next| before.towards(next, time_s));
        let truth_n = truth_n(then.place_m);
        self.error_n = Some((truth_n - then.copy_n, then.copy_n.length()));
        // A server that hears nothing tells of the same moment again.
        if time_s <= self.compared_s {
            return;
        }
        let memory = ((self.compared_s - time_s) / MEMORY_S).exp();
        let values_n = [then.predicted_n - truth_n, then.modelled_n - truth_n, truth_n];
        for (squared, value_n) in self.squared.iter_mut().zip(values_n) {
            *squared = memory * *squared + value_n.length_squared();
        }
        self.compared_s = time_s;
        let [copy, models, force] = self.squared;
        let is_farther = if self.is_worse { BETTER * copy > models } else { copy > BETTER * models };
        self.is_worse = is_farther && copy > NEAR * NEAR * force;
    }

    /// The force that the copy and the newest sample tell for now, N; none while the local model is to be rendered. And where out
    /// of the tissue is, against which nothing may pull: none if the tool holds the tissue, `normal` while the copy is not touched.
    pub(crate) fn wanted_n(&self, normal: DVec3) -> Option<(DVec3, Option<DVec3>)> {
        let felt = self.now.filter(|_| self.error_n.is_some() && !self.is_worse)?;
        let outward = match felt.contact_state {
            ContactState::Holding => None,
            _ => Some(felt.force_n.try_normalize().unwrap_or(normal)),
        };
        Some((self.sum_n(felt), outward))
    }

    /// c + e. A tip that is out of the copy feels nothing.
    fn sum_n(&self, felt: Predicted) -> DVec3 {
        let (error_n, size_n) = self.error_n.unwrap_or_default();
        match felt.contact_state {
            ContactState::Free => DVec3::ZERO,
            ContactState::Holding => felt.force_n + error_n,
            _ if size_n > 0.0 => felt.force_n + error_n * (felt.force_n.length() / size_n).min(1.0),
            _ => felt.force_n,
        }
    }
}

impl std::fmt::Debug for Prediction {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Prediction { now, error_n, squared, is_worse, .. } = self;
        let mut fields = f.debug_struct("Prediction");
        fields.field("now", now).field("error_n", error_n).field("squared", squared).field("is_worse", is_worse);
        fields.finish_non_exhaustive()
    }
}
