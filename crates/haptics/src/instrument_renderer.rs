//! The rendering law of an instrument: force and torque, a thousand times a second, from a copy of the tissue.
//!
//! A local model describes one tip ([`crate::renderer`]). The tips of an instrument press side by side, so the force on each depends
//! on what all do. A client that renders an instrument therefore has a copy of the tissue, in which all its tips move without a
//! delay ([`crate::Predictor`]). As with a single tip, each sample corrects it: with the wrench W(t₀) of a sample and C of the copy,
//! both about the same point, the rendered wrench is C(now) + e, e = W(t₀) − C(t₀), and e decreases with the copy's force. A newer
//! sample changes e; that difference is kept as a bias and decays with [`BIAS_S`]. If poses were late, a server has the instrument
//! elsewhere at t₀ than the client had it. Such a sample tells of another place and leaves e as it is.
//!
//! While there is no copy, or it has no answer, the last wrench is kept: the envelope counts the time since the last wrench of the
//! copy as the age of the model, so the wrench fades and rendering pauses.
//!
//! **Port.** An instrument in a port follows the place of the device and its turn about the shaft ([`crate::port`]). The device gets
//! the wrench with the same power for each of its own movements ([`Port::on_device`]), and the envelope counts these.

use crate::envelope::{Envelope, RenderingState, Wanted, WantedTurn};
use crate::instrument_pose::{InstrumentPose, InstrumentVelocity, Wrench};
use crate::port::Port;
use crate::prediction::{MAX_OTHERS, OtherTool, Prediction, replace_others};
use crate::renderer::BIAS_S;
use glam::DVec3;

/// The wrench on an instrument that a sample contains.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WrenchSample {
    /// Increases with each sample.
    pub sequence: u64,
    /// The time by the client's clock at which the instrument was where the sample has it, s.
    pub client_time_s: f64,
    /// Where the instrument was then.
    pub pose: InstrumentPose,
    /// Force and torque of the tissue on the instrument, about its place.
    pub wrench: Wrench,
}

/// How far a sample may have an instrument from where the client had it at that time, m, and rad of orientation and of jaws: such a
/// turn moves a tip that is 20 mm away by as much.
const SAME_PLACE_M: f64 = 1e-4;
const SAME_TURN_RAD: f64 = 5e-3;

/// Returns whether two poses are equal, so that a sample of one tells of the other.
fn are_same(one: &InstrumentPose, other: &InstrumentPose) -> bool {
    one.place_m.distance(other.place_m) <= SAME_PLACE_M
        && one.turn_to(other).length() <= SAME_TURN_RAD
        && (one.jaw_rad - other.jaw_rad).abs() <= SAME_TURN_RAD
}

impl WrenchSample {
    fn is_finite(&self) -> bool {
        self.client_time_s.is_finite() && self.pose.is_finite() && self.wrench.is_finite()
    }
}

/// Renderer of an instrument: it computes the wrench in each tick from a copy of the tissue and the newest sample.
#[derive(Debug)]
pub struct InstrumentRenderer {
    prediction: Option<Prediction>,
    port: Option<Port>,
    others: Vec<OtherTool>,
    /// The newest sample in use, one that waits for the next tick with its arrival, s, and the arrival of the newest, s.
    newest: Option<WrenchSample>,
    arrived: Option<(WrenchSample, f64)>,
    newest_s: Option<f64>,
    /// Time of the last wrench of the copy, s.
    answered_s: Option<f64>,
    bias: Wrench,
    biased_s: f64,
    /// The wrench that was last wanted.
    last: Wrench,
    before: Option<(f64, InstrumentPose)>,
    velocity: InstrumentVelocity,
    predicted: u64,
    refused: u64,
    /// Safety envelope that limits each wrench before the device. Use it to enable, disable and reset rendering.
    pub envelope: Envelope,
}

impl InstrumentRenderer {
    /// Creates a renderer without a copy, which renders nothing until it has one ([`InstrumentRenderer::predict`]) and a sample has
    /// been compared with it. `port`: that of the instrument. The wrench passes through `envelope`.
    pub fn new(envelope: Envelope, port: Option<Port>) -> Self {
        InstrumentRenderer {
            prediction: None,
            port,
            others: Vec::with_capacity(MAX_OTHERS),
            newest: None,
            arrived: None,
            newest_s: None,
            answered_s: None,
            bias: Wrench::default(),
            biased_s: 0.0,
            last: Wrench::default(),
            before: None,
            velocity: InstrumentVelocity::default(),
            predicted: 0,
            refused: 0,
            envelope,
        }
    }

    /// Sets the copy of the tissue. Returns the previous one. It may be large, so drop it outside of ticks.
    pub fn predict(&mut self, prediction: Option<Prediction>) -> Option<Prediction> {
        std::mem::replace(&mut self.prediction, prediction)
    }

    /// Replaces what is known of the other tools on the tissue, as [`crate::Renderer::follow_others`] does.
    pub fn follow_others(&mut self, others: &[OtherTool]) {
        replace_others(&mut self.others, others);
    }

    /// Forgets the samples for a new connection. The copy stays set: also call [`InstrumentRenderer::predict`].
    pub fn begin(&mut self) {
        (self.newest, self.arrived) = (None, None);
        self.others.clear();
    }

    /// Receives a sample that arrived at `now_s`, s, by the clock of [`InstrumentRenderer::tick`]. It takes effect at the next tick. One
    /// whose sequence number is not above the last, or with a value that is not finite, is refused and counted.
    pub fn receive(&mut self, sample: WrenchSample, now_s: f64) {
        let newest = self.arrived.as_ref().map(|arrived| &arrived.0).or(self.newest.as_ref());
        let is_late = newest.is_some_and(|newest| sample.sequence <= newest.sequence);
        if is_late || !sample.is_finite() || !now_s.is_finite() {
            self.refused += 1;
            return;
        }
        self.arrived = Some((sample, now_s));
    }

    /// Advances by one tick: moves the instrument in the copy to where a device leads it that is at a `pose`, in the tissue's frame, at
    /// `now_s` by the client's clock, s. Does not allocate. A value that is not finite makes the envelope's state FAULT. Returns the
    /// wrench to render on the device until the next tick, about the place of the pose.
    pub fn tick(&mut self, now_s: f64, pose: &InstrumentPose) -> Wrench {
        let is_known = pose.is_finite() && now_s.is_finite();
        let mut turned_rad = DVec3::ZERO;
        if let Some((then_s, before)) = self.before.filter(|_| is_known) {
            turned_rad = before.turn_to(pose);
            if now_s > then_s {
                let elapsed_s = now_s - then_s;
                self.velocity.velocity_m_per_s = (pose.place_m - before.place_m) / elapsed_s;
                self.velocity.angular_rad_per_s = turned_rad / elapsed_s;
            }
        }
        let led = self.port.map_or(*pose, |port| port.lead(pose));
        if is_known {
            self.before = Some((now_s, *pose));
            if let Some(prediction) = &mut self.prediction {
                self.envelope.supply(prediction.move_to(now_s, &led, &self.others));
            }
            if let Some((sample, arrived_s)) = self.arrived.take() {
                self.newest_s = Some(arrived_s);
                self.adopt(sample, now_s);
            }
        }
        self.last = self.wanted(now_s).unwrap_or(self.last);
        let has_wrench = self.prediction.as_ref().is_some_and(|prediction| prediction.wrench().is_some());
        if let Some(prediction) = self.prediction.as_mut().filter(|_| is_known) {
            self.predicted += u64::from(has_wrench);
            self.answered_s = if has_wrench { Some(now_s) } else { self.answered_s };
            prediction.keep(now_s, &led, DVec3::ZERO);
        }
        // What the copy does not answer is as old as its last wrench. Before the first, rendering does not engage.
        let counts = has_wrench || self.envelope.is_engaged();
        let known_s = self.newest_s.zip(self.answered_s).map(|(newest_s, answered_s)| newest_s.min(answered_s));
        let age_s = known_s.filter(|_| counts).map(|known_s| now_s - known_s);
        let InstrumentVelocity { velocity_m_per_s, angular_rad_per_s, .. } = self.velocity;
        let Wrench { force_n, torque_n_m } = self.port.map_or(self.last, |port| port.on_device(pose, &self.last));
        // An orientation that is not finite is as bad as such a place.
        let place_m = if is_known { pose.place_m } else { DVec3::NAN };
        self.envelope.render_wrench(
            &Wanted { now_s, place_m, velocity_m_per_s, force_n, age_s },
            &WantedTurn { torque_n_m, angular_rad_per_s, turned_rad },
        )
    }

    /// Compares the copy with a sample that has arrived, and keeps the difference from the wrench before as the bias.
    fn adopt(&mut self, sample: WrenchSample, now_s: f64) {
        let before = self.wanted(now_s);
        if let Some(prediction) = &mut self.prediction {
            prediction.compare(sample.client_time_s, |then| {
                let by_m = then.place_m - sample.pose.place_m;
                are_same(then, &sample.pose).then(|| sample.wrench.about(by_m))
            });
        }
        self.newest = Some(sample);
        (self.biased_s, self.bias) = (now_s, Wrench::default());
        if let Some((before, after)) = before.zip(self.wanted(now_s)) {
            self.bias = before - after;
        }
    }

    /// Returns the wrench to render before the envelope; `None` while the copy has none.
    fn wanted(&self, now_s: f64) -> Option<Wrench> {
        let wrench = self.prediction.as_ref()?.wrench()?;
        Some(wrench + self.bias * ((self.biased_s - now_s) / BIAS_S).exp())
    }

    /// Returns the state of rendering. Before the first sample it is DISABLED, even after [`Envelope::enable`].
    pub fn state(&self) -> RenderingState {
        match self.envelope.state() {
            RenderingState::Enabled if self.newest_s.is_none() => RenderingState::Disabled,
            state => state,
        }
    }

    /// Returns the number of ticks that were rendered from a copy of the tissue.
    pub fn predicted(&self) -> u64 {
        self.predicted
    }

    /// Returns the number of samples that were refused.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Returns the time of the sample in use by the client's clock, s; `None` before the first.
    pub fn sample_time_s(&self) -> Option<f64> {
        self.newest.map(|newest| newest.client_time_s)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};

    use glam::DQuat;

    use super::*;
    use crate::device::Device;
    use crate::envelope::{LimitCause, PAUSE_S};
    use crate::local_model::ContactState;
    use crate::prediction::{Predicted, Predictor};

    const TICK_S: f64 = 1e-3;

    /// A tissue that pushes the instrument up by 200 N/m and turns it back by 0.1 N·m/rad.
    fn wrench(pose: &InstrumentPose, factor: f64) -> Wrench {
        let depth_m = (-pose.place_m.z).max(0.0);
        let turn_rad = pose.turn_to(&InstrumentPose::at(DVec3::ZERO));
        Wrench {
            force_n: 200.0 * factor * depth_m * DVec3::Z,
            torque_n_m: 0.1 * factor * turn_rad * f64::from(depth_m > 0.0),
        }
    }

    struct TurningCopy {
        factor: f64,
        is_off: Arc<AtomicBool>,
    }

    impl Predictor for TurningCopy {
        fn feel(&mut self, _: f64, pose: &InstrumentPose, _: &[OtherTool]) -> Option<Predicted> {
            let wrench = wrench(pose, self.factor);
            let contact_state = if wrench == Wrench::default() { ContactState::Free } else { ContactState::Sticking };
            (!self.is_off.load(Ordering::Relaxed)).then_some(Predicted { wrench, contact_state, own_work_j: 0.0 })
        }
    }

    /// Presses 3 mm and turns by 0.3 rad within a second, and stays there.
    fn pose(tick: u32) -> InstrumentPose {
        let part = ((f64::from(tick) * TICK_S - 0.6) / 0.4).clamp(0.0, 1.0);
        let orientation = DQuat::from_rotation_x(0.3 * part);
        InstrumentPose { orientation, ..InstrumentPose::at((0.001 - 0.004 * part) * DVec3::Z) }
    }

    struct Loop {
        renderer: InstrumentRenderer,
        is_off: Arc<AtomicBool>,
        tick: u32,
    }

    impl Loop {
        fn new(factor: f64) -> Self {
            let mut envelope = Envelope::new(Device::named("sigma7").unwrap(), DVec3::ZERO);
            envelope.enable();
            let mut renderer = InstrumentRenderer::new(envelope, None);
            let is_off = Arc::new(AtomicBool::new(false));
            renderer.predict(Some(Prediction::new(Box::new(TurningCopy { factor, is_off: is_off.clone() }))));
            Loop { renderer, is_off, tick: 0 }
        }

        /// Does a tick. A sample of 50 ticks ago arrives, with the wrench of a pose `late` ticks before that.
        fn tick(&mut self, late: Option<u32>) -> Wrench {
            if let (Some(late), Some(then)) = (late, self.tick.checked_sub(50)) {
                let pose = pose(then.saturating_sub(late));
                let client_time_s = f64::from(then) * TICK_S;
                let sequence = u64::from(self.tick);
                let sample = WrenchSample { sequence, client_time_s, pose, wrench: wrench(&pose, 1.0) };
                self.renderer.receive(sample, f64::from(self.tick) * TICK_S);
            }
            let wrench = self.renderer.tick(f64::from(self.tick) * TICK_S, &pose(self.tick));
            self.tick += 1;
            wrench
        }

        fn press(factor: f64) -> (Self, Wrench) {
            let mut each = Loop::new(factor);
            let last = (0..1200).map(|_| each.tick(Some(0))).last().unwrap();
            (each, last)
        }
    }

    #[test]
    fn samples_correct_force_and_torque_of_a_copy_that_is_off() {
        for factor in [1.0, 0.8, 1.3] {
            let (_, last) = Loop::press(factor);
            let truth = wrench(&pose(1200), 1.0);
            assert!((last.force_n - truth.force_n).length() < 1e-4 && truth.force_n.z > 0.5, "{factor}: {last:?}");
            assert!(
                (last.torque_n_m - truth.torque_n_m).length() < 1e-5 && truth.torque_n_m.length() > 0.02,
                "{last:?}"
            );
        }
    }

    #[test]
    fn a_sample_of_another_place_than_the_clients_corrects_nothing() {
        let mut each = Loop::new(1.0);
        for _ in 0..1000 {
            each.tick(Some(0));
        }
        // The samples are of the way, where the server lags behind: their wrench is that of an earlier pose.
        for _ in 0..50 {
            let rendered = each.tick(Some(20));
            let error_n = (rendered - wrench(&pose(each.tick - 1), 1.0)).force_n.length();
            assert!(error_n < 1e-9, "{error_n} N");
        }
    }

    #[test]
    fn force_and_torque_fade_and_pause_when_samples_or_the_copy_stop() {
        for stops in ["samples", "copy"] {
            let (mut each, mut before) = Loop::press(1.0);
            each.is_off.store(stops == "copy", Ordering::Relaxed);
            for _ in 0..600 {
                let now = each.tick((stops == "copy").then_some(0));
                let [more_n, more_n_m] = [
                    now.force_n.length() - before.force_n.length(),
                    now.torque_n_m.length() - before.torque_n_m.length(),
                ];
                assert!(more_n < 1e-12 && more_n_m < 1e-12, "{stops}: {before:?} {now:?}");
                // Within the slew.
                assert!((now - before).force_n.length() <= 0.1 + 1e-12);
                before = now;
            }
            assert!(before.force_n.length() < 1e-3 && before.torque_n_m.length() < 1e-4, "{stops}: {before:?}");
            assert_eq!(each.renderer.state(), RenderingState::Paused, "{stops}");
            assert!(f64::from(600_u32) * TICK_S > PAUSE_S);
        }
    }

    #[test]
    fn a_pose_that_is_not_a_number_is_a_fault_without_a_wrench() {
        let (mut each, _) = Loop::press(1.0);
        let bad = InstrumentPose { orientation: DQuat::from_xyzw(f64::NAN, 0.0, 0.0, 1.0), ..pose(1200) };
        let mut last = Wrench::default();
        for _ in 0..300 {
            last = each.renderer.tick(f64::from(each.tick) * TICK_S, &bad);
            each.tick += 1;
            assert!(last.is_finite());
        }
        assert_eq!((last, each.renderer.state()), (Wrench::default(), RenderingState::Fault));
    }

    #[test]
    fn a_handle_that_nobody_holds_gets_no_more_energy_by_force_and_torque_than_was_put_in() {
        let (mut each, _) = Loop::press(1.0);
        // The tissue becomes stiffer, and only its wrench moves the device: 50 g, with 2e-5 kg·m².
        each.renderer.predict(Some(Prediction::new(Box::new(TurningCopy { factor: 4.0, is_off: Arc::default() }))));
        let mut at = pose(1200);
        let mut velocity = InstrumentVelocity::default();
        let put_in_j = each.renderer.envelope.energy_j();
        for tick in 1200..1700_u32 {
            let now_s = f64::from(tick) * TICK_S;
            let sample =
                WrenchSample { sequence: tick.into(), client_time_s: now_s, pose: at, wrench: wrench(&at, 4.0) };
            each.renderer.receive(sample, now_s);
            let rendered = each.renderer.tick(now_s, &at);
            velocity.velocity_m_per_s += rendered.force_n / 0.05 * TICK_S;
            velocity.angular_rad_per_s += rendered.torque_n_m / 2e-5 * TICK_S;
            at = velocity.after(&at, TICK_S);
        }
        let energy_j = each.renderer.envelope.energy_j();
        assert!(put_in_j > 1e-3 && energy_j > -3e-4, "{put_in_j} J, then {energy_j} J");
        assert!(each.renderer.envelope.count(LimitCause::Passivity).0 > 0);
    }
}
