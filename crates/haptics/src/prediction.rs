//! Prediction: a client that also simulates the tissue computes now the force that samples will contain a round trip
//! later.
//!
//! A local model describes the tissue around one place. That is enough while a hand stays there, or where the tissue
//! is uniform. Over a rim, a fold or the edge of a lump the true force turns or halves within 40 to 60 ms, and a hand
//! that is a round trip ahead meets tissue that no sample has described yet. A client that has the tissue's model
//! moves its own tool through a copy of the tissue, without a delay ([`Predictor`]).
//!
//! **Correction by samples.** Each sample shows the error of the copy at the sample's own time t₀: e = f(t₀) − c(t₀),
//! where c is the copy's force. The rendered force is c(now) + e, with e reduced to the fraction |c(now)|/|c(t₀)| if
//! that is below 1, so that the force falls smoothly when a tip leaves the tissue. What only the server knows takes effect a
//! round trip late. If the server's tool was a little beside the client's at t₀ (because a place was lost or not sent), the
//! local model gives f at the client's place.
//!
//! **Other tools.** The copy has those that the client knows ([`OtherTool`]): its own second tool at once, and those of
//! other clients by samples, from which they go on at constant velocity. At t₀ the server had another client's tool where
//! that is half a round trip after the copy had it there, so e contains what it did in that time, to and fro. While such a
//! tool moves, e is therefore the mean over some tenths of a second. If the copy has given the client's tool more energy than it
//! got from it, that comes from other tools, and may leave the client's port ([`crate::Envelope::supply`]): at most as much as these
//! gave to the copy. A copy is not quite passive: tips of an instrument that overlap, stick and turn may get more than they gave.
//! Without that bound, their excess would be credit.
//!
//! **Selection.** The local model is also computed beside the copy. When a sample arrives, both forecasts for t₀ are
//! compared with it. If the copy's error over some tenths of a second is larger than the local model's, and larger
//! than a hand notices, the local model is rendered. A copy is not rendered before the first sample has been compared
//! with it. So a wrong copy does no harm for longer than that, and one that is nearly right stays in use, because
//! only the copy contains what comes next.

use std::collections::VecDeque;

use glam::DVec3;

use crate::dead_reckoning::MotionState;
use crate::instrument_pose::{InstrumentPose, Wrench};
use crate::local_model::{ContactState, is_after};
use crate::reported_cuts::ReportedCuts;
use crate::tip::Tip;

/// Time constant of the memory with which forecasts are compared, and of the mean error while other tools move, s.
const MEMORY_S: f64 = 0.3;

/// Factor by which the other one's mean squared error must be smaller before it is rendered. It prevents frequent
/// changes.
const BETTER: f64 = 2.0;

/// Error of a copy, as a fraction of the force, up to which the copy is rendered in any case.
const NEAR: f64 = 0.05;

/// Longest time from a forecast before or after a moment up to which it counts for that moment, s.
const GAP_S: f64 = 0.02;

/// Force and contact of the client's tool in a copy of the tissue at one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Predicted {
    /// Force of the copy on the tool, N, and its torque about the tool's place, N·m, 0 for a single tip; in the tissue's frame. One
    /// that is not finite counts as no answer.
    pub wrench: Wrench,
    /// State of contact between the tool and the copy.
    pub contact_state: ContactState,
    /// Work that the client's tool has done on the copy since it was made, J: negative if it got more than it gave.
    pub own_work_j: f64,
    /// Work that all other tools have done on the copy since it was made, J; 0 without any.
    pub others_work_j: f64,
}

impl Predicted {
    /// Returns the energy that other tools have given to the client's through the copy, J: what that got beyond what it gave, at
    /// most what they gave.
    fn supplied_j(&self) -> f64 {
        (-self.own_work_j).min(self.others_work_j).max(0.0)
    }

    fn is_sound(&self) -> bool {
        self.wrench.is_finite() && self.own_work_j.is_finite() && self.others_work_j.is_finite()
    }
}

/// Another tool on the tissue, as far as the client knows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OtherTool {
    /// Its number in the session.
    pub tool: u32,
    /// Its tip.
    pub tip: Tip,
    /// Its last known place and velocity, in the tissue's frame, at a time by the client's clock. It is taken to go on with
    /// this velocity ([`MotionState::at`]).
    pub motion: MotionState,
}

/// Returns the time by the client's clock, s, at which another tool was where a sample says: midway between the time at which
/// the client's tool was at the place of the sample's local model, and the sample's arrival at `now_s`, as if the delay
/// were the same both ways. A copy then has all tools where they are at one moment. If it had the others where the server
/// will have them when the client's place arrives there, or had them as late as the samples are, the error is about twice
/// as large (docs/link.md).
pub fn midway_s(model_time_s: f64, now_s: f64) -> f64 {
    0.5 * (model_time_s + now_s)
}

/// Largest number of other tools that a client follows.
pub const MAX_OTHERS: usize = 32;

/// Replaces the `known` other tools by `others`. Leaves out those whose motion is not finite, and beyond [`MAX_OTHERS`] the last.
pub(crate) fn replace_others(known: &mut Vec<OtherTool>, others: &[OtherTool]) {
    known.clear();
    let is_finite = |other: &&OtherTool| {
        let MotionState { time_s, place_m, velocity_m_per_s } = other.motion;
        time_s.is_finite() && place_m.is_finite() && velocity_m_per_s.is_finite()
    };
    known.extend(others.iter().filter(is_finite).take(MAX_OTHERS));
}

/// A copy of the tissue on the client's side that contains the client's tool and the other tools that it knows.
/// [`crate::Renderer::tick`] calls it a thousand times a second, so it should neither block nor allocate.
pub trait Predictor: Send {
    /// Moves the tool, a single tip or an instrument, to a `pose` (in the tissue's frame, finite) at `now_s` by the client's clock,
    /// s, which never goes back, and the `others`, at most [`MAX_OTHERS`], to where they are then; those that are missing have
    /// let go. Returns the wrench and contact of the tool; `None` if the copy has no answer, now or from now on.
    fn feel(&mut self, now_s: f64, pose: &InstrumentPose, others: &[OtherTool]) -> Option<Predicted>;

    /// Returns the version of the topology of the server's tissue whose cuts the copy has; `None` if it follows none: it then gets no
    /// reports of later ones.
    fn topology_version(&self) -> Option<u32> {
        None
    }

    /// Severs in the copy what was severed in the server's tissue. Called between two calls of [`Predictor::feel`], with the reports in
    /// their order; it may allocate. Ignores a report that does not fit the tissue, as a whole.
    fn follow_cuts(&mut self, _cuts: &ReportedCuts) {}
}

/// Forces computed in a tick, before the bias and the envelope.
#[derive(Debug, Clone, Copy)]
struct Forecast {
    time_s: f64,
    pose: InstrumentPose,
    copied: Wrench,
    predicted: Wrench,
    modelled_n: DVec3,
}

impl Forecast {
    /// Returns the forecast at a time between two ticks. (A server plays a path at times of its own.)
    fn towards(&self, next: &Forecast, time_s: f64) -> Forecast {
        let part = ((time_s - self.time_s) / (next.time_s - self.time_s)).clamp(0.0, 1.0);
        Forecast {
            time_s,
            pose: self.pose.towards(&next.pose, part),
            copied: self.copied.lerp(next.copied, part),
            predicted: self.predicted.lerp(next.predicted, part),
            modelled_n: self.modelled_n.lerp(next.modelled_n, part),
        }
    }
}

/// Number of forecasts that are kept: two seconds at 1 kHz. Beyond it the oldest is dropped.
const KEPT: usize = 2048;

/// A copy of the tissue in use, with its past forecasts and its error, for [`crate::Renderer::predict`].
pub struct Prediction {
    predictor: Box<dyn Predictor>,
    now: Option<Predicted>,
    past: VecDeque<Forecast>,
    /// The error e, which is the wrench of the newest sample minus the copy's at that time, and the size of the copy's
    /// force, N; `None` before the first sample.
    error: Option<(Wrench, f64)>,
    /// Time of the last sample that was compared, s.
    compared_s: f64,
    /// Sums of the squared errors of the copy and of the local models, and of the squared force, N²; old values count
    /// less.
    squared: [f64; 3],
    is_worse: bool,
    /// The energy that other tools have given to the client's by the last answer, J.
    supplied_j: f64,
    /// Whether another tool moves by itself.
    others_move: bool,
}

impl Prediction {
    /// Creates a prediction from a copy. It is not rendered until a sample has been compared with it. It reserves all
    /// the memory that ticks need, for the newest 2048 forecasts.
    pub fn new(predictor: Box<dyn Predictor>) -> Self {
        Prediction {
            predictor,
            now: None,
            // A tick must not allocate.
            past: VecDeque::with_capacity(KEPT),
            error: None,
            compared_s: f64::NEG_INFINITY,
            squared: [0.0; 3],
            is_worse: false,
            supplied_j: 0.0,
            others_move: false,
        }
    }

    /// Moves the tools in the copy. Returns by how much the energy that others have given to the client's tool has changed since
    /// the last answer, J.
    pub(crate) fn move_to(&mut self, now_s: f64, pose: &InstrumentPose, others: &[OtherTool]) -> f64 {
        self.now = self.predictor.feel(now_s, pose, others).filter(Predicted::is_sound);
        self.others_move = others.iter().any(|other| other.motion.velocity_m_per_s != DVec3::ZERO);
        let Some(now) = self.now else { return 0.0 };
        let supplied_j = now.supplied_j();
        supplied_j - std::mem::replace(&mut self.supplied_j, supplied_j)
    }

    /// Stores the forecast for this tick.
    pub(crate) fn keep(&mut self, time_s: f64, pose: &InstrumentPose, modelled_n: DVec3) {
        let Some(felt) = self.now else { return };
        if self.past.len() == KEPT {
            self.past.pop_front();
        }
        let predicted = self.sum(felt);
        self.past.push_back(Forecast { time_s, pose: *pose, copied: felt.wrench, predicted, modelled_n });
    }

    /// Compares the forecast for the time of a sample with the sample; `truth` returns the sample's wrench on a tool at a pose,
    /// about its place, or `None` if the sample says nothing about that pose.
    pub(crate) fn compare(&mut self, time_s: f64, truth: impl FnOnce(&InstrumentPose) -> Option<Wrench>) {
        let after = self.past.partition_point(|past| !is_after(past.time_s, time_s));
        // The sample is older than the first forecast.
        let Some(before) = after.checked_sub(1).and_then(|at| self.past.get(at)) else { return };
        let next = self.past.get(after);
        if time_s - before.time_s > GAP_S || next.is_some_and(|next| next.time_s - time_s > GAP_S) {
            return;
        }
        // There may be no later forecast.
        let then = next.map_or(*before, |next| before.towards(next, time_s));
        let Some(truth) = truth(&then.pose) else { return };
        let (error, size_n) = (truth - then.copied, then.copied.force_n.length());
        let kept = if self.others_move { ((self.compared_s - time_s).min(0.0) / MEMORY_S).exp() } else { 0.0 };
        let (before, before_size_n) = self.error.unwrap_or((error, size_n));
        self.error = Some((error.lerp(before, kept), size_n + kept * (before_size_n - size_n)));
        // A server that receives nothing sends samples of the same time again.
        if time_s <= self.compared_s {
            return;
        }
        let memory = ((self.compared_s - time_s) / MEMORY_S).exp();
        let truth_n = truth.force_n;
        let values_n = [then.predicted.force_n - truth_n, then.modelled_n - truth_n, truth_n];
        for (squared, value_n) in self.squared.iter_mut().zip(values_n) {
            *squared = memory * *squared + value_n.length_squared();
        }
        self.compared_s = time_s;
        let [copy, models, force] = self.squared;
        let is_farther = if self.is_worse { BETTER * copy > models } else { copy > BETTER * models };
        self.is_worse = is_farther && copy > NEAR * NEAR * force;
    }

    /// Returns the present force from the copy and the newest sample, N, and the direction out of the tissue, against
    /// which nothing may pull: `None` if the tool holds the tissue, `normal` while it does not touch the copy.
    /// Returns `None` as a whole while the local model is to be rendered.
    pub(crate) fn wanted_n(&self, normal: DVec3) -> Option<(DVec3, Option<DVec3>)> {
        let felt = self.now.filter(|_| self.error.is_some() && !self.is_worse)?;
        let outward = match felt.contact_state {
            ContactState::Holding => None,
            _ => Some(felt.wrench.force_n.try_normalize().unwrap_or(normal)),
        };
        Some((self.sum(felt).force_n, outward))
    }

    /// Returns the present wrench from the copy and the newest sample; `None` before the first sample, and while the copy has no
    /// answer.
    pub(crate) fn wrench(&self) -> Option<Wrench> {
        self.now.filter(|_| self.error.is_some()).map(|felt| self.sum(felt))
    }

    /// Returns c + e: 0 if the tool does not touch the copy.
    fn sum(&self, felt: Predicted) -> Wrench {
        let (error, size_n) = self.error.unwrap_or_default();
        match felt.contact_state {
            ContactState::Free => Wrench::default(),
            ContactState::Holding => felt.wrench + error,
            _ if size_n > 0.0 => felt.wrench + error * (felt.wrench.force_n.length() / size_n).min(1.0),
            _ => felt.wrench,
        }
    }
}

impl std::fmt::Debug for Prediction {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Prediction { now, error, squared, is_worse, .. } = self;
        let mut fields = f.debug_struct("Prediction");
        fields.field("now", now).field("error", error).field("squared", squared).field("is_worse", is_worse);
        fields.finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct CountingCopy(Vec<[f64; 2]>);

    impl Predictor for CountingCopy {
        fn feel(&mut self, _: f64, _: &InstrumentPose, _: &[OtherTool]) -> Option<Predicted> {
            let [own_work_j, others_work_j] = self.0.pop()?;
            Some(Predicted { wrench: Wrench::default(), contact_state: ContactState::Free, own_work_j, others_work_j })
        }
    }

    #[test]
    fn a_tool_gets_no_more_energy_from_others_than_they_gave() {
        // Work of the own tool and of others, J, and the credit that changes with it.
        let rows = [
            ([0.002, 0.0], 0.0),
            // A copy that is not passive, without others.
            ([-0.001, 0.0], 0.0),
            ([-0.001, 0.0004], 0.0004),
            ([-0.001, 0.003], 0.0006),
            ([-0.0025, 0.003], 0.0015),
            // What goes back is taken back; others that have got energy give none.
            ([-0.0005, 0.003], -0.002),
            ([0.001, 0.003], -0.0005),
            ([-0.001, -0.003], 0.0),
        ];
        let copy = CountingCopy(rows.iter().rev().map(|row| row.0).collect());
        let mut prediction = Prediction::new(Box::new(copy));
        for (tick, (works_j, credit_j)) in (0_u32..).zip(rows) {
            let changed_j = prediction.move_to(1e-3 * f64::from(tick), &InstrumentPose::at(DVec3::ZERO), &[]);
            assert!((changed_j - credit_j).abs() < 1e-15, "{works_j:?}: {changed_j} J");
        }
    }
}
