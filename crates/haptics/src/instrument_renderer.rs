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
//! **Contact.** Instruments push each other apart ([`crate::instrument_contact`]). This is computed here, in each tick, from where the
//! others are: the instrument of the same client's second hand at once, and those of other clients by samples. The two hands of a client
//! have one account: what one gives to their contact, by the force that its device renders, may leave the port of the other
//! ([`Envelope::supply`]); jaws that close on the other give nothing. What another client gives may not leave: over a delay, each would
//! take the other's late push for energy.
//!
//! **Port.** An instrument in a port follows the place of the device and its turn about the shaft ([`crate::port`]). The device gets
//! the wrench with the same power for each of its own movements ([`Port::on_device`]), and the envelope counts these.

use crate::envelope::{Envelope, RenderingState, Wanted, WantedTurn};
use crate::instrument::Instrument;
use crate::instrument_contact::{InstrumentContact, MAX_OTHER_INSTRUMENTS, OtherInstrument, SecondHand};
use crate::instrument_pose::{InstrumentPose, InstrumentVelocity, Wrench};
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
    instrument: Instrument,
    others: Vec<OtherTool>,
    /// The second hand, and the instruments of other clients.
    second: Option<SecondHand>,
    other_instruments: Vec<OtherInstrument>,
    contact: InstrumentContact,
    /// What the second hand had given at the last tick, J.
    taken_j: f64,
    /// Where the device was at the last tick, and what it has rendered of the second hand since; and what it has given to that, J.
    pushed: Option<(InstrumentPose, Wrench)>,
    given_j: f64,
    /// How far it overlaps with others, m.
    overlap_m: f64,
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
    /// been compared with it. The wrench passes through `envelope`.
    pub fn new(envelope: Envelope, instrument: Instrument) -> Self {
        InstrumentRenderer {
            prediction: None,
            contact: InstrumentContact::new(&instrument),
            instrument,
            others: Vec::with_capacity(MAX_OTHERS),
            second: None,
            other_instruments: Vec::with_capacity(MAX_OTHER_INSTRUMENTS),
            taken_j: 0.0,
            pushed: None,
            given_j: 0.0,
            overlap_m: 0.0,
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

    /// Replaces what is known of other instruments: this client's second hand, and up to [`MAX_OTHER_INSTRUMENTS`] of other
    /// clients. Leaves out what is not sound.
    pub fn follow_instruments(&mut self, second: Option<SecondHand>, others: &[OtherInstrument]) {
        self.second = second.filter(|second| second.instrument.is_sound() && second.given_j.is_finite());
        self.other_instruments.clear();
        let sound = others.iter().filter(|other| other.is_sound());
        self.other_instruments.extend(sound.take(MAX_OTHER_INSTRUMENTS));
    }

    /// Forgets the samples for a new connection. The copy stays set: also call [`InstrumentRenderer::predict`].
    pub fn begin(&mut self) {
        (self.newest, self.arrived, self.second) = (None, None, None);
        self.others.clear();
        self.other_instruments.clear();
        self.contact.forget();
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
        let led = self.instrument.lead(pose);
        let mut pushed = [Wrench::default(); 2];
        self.overlap_m = 0.0;
        if is_known {
            self.before = Some((now_s, *pose));
            pushed = self.touch(now_s, &led);
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
        let wanted = self.last + pushed[0] + pushed[1];
        let on_device = self.instrument.port.map_or(wanted, |port| port.on_device(pose, &wanted));
        let Wrench { force_n, torque_n_m } = on_device;
        // An orientation that is not finite is as bad as such a place.
        let place_m = if is_known { pose.place_m } else { DVec3::NAN };
        let rendered = self.envelope.render_wrench(
            &Wanted { now_s, place_m, velocity_m_per_s, force_n, age_s },
            &WantedTurn { torque_n_m, angular_rad_per_s, turned_rad },
        );
        if is_known {
            // The envelope may have shortened it, and the device may render no torque.
            let part = |rendered: DVec3, wanted: DVec3| {
                (rendered.dot(wanted) / wanted.length_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0)
            };
            let second = self.instrument.port.map_or(pushed[0], |port| port.on_device(pose, &pushed[0]));
            let second = Wrench {
                force_n: part(rendered.force_n, force_n) * second.force_n,
                torque_n_m: part(rendered.torque_n_m, torque_n_m) * second.torque_n_m,
            };
            self.give(pose, second);
        }
        rendered
    }

    /// Returns the wrenches of the second hand and of other instruments at a pose, about its place.
    fn touch(&mut self, now_s: f64, led: &InstrumentPose) -> [Wrench; 2] {
        self.contact.begin();
        let mut wrenches = [Wrench::default(); 2];
        let second = self.second.iter().map(|second| (0, &second.instrument));
        for (whose, other) in second.chain(self.other_instruments.iter().map(|other| (1, other))) {
            let capsules = other.capsules.iter().flatten().map(|capsule| capsule.at(now_s));
            if let Some(load) = self.contact.feel(&self.instrument, led, other.first_tool, capsules) {
                wrenches[whose] = wrenches[whose] + load.wrench;
                self.overlap_m = self.overlap_m.max(load.depth_m);
            }
        }
        if let Some(second) = &self.second {
            self.envelope.supply(second.given_j - std::mem::replace(&mut self.taken_j, second.given_j));
        }
        wrenches
    }

    /// Adds the work on the second hand over the device's way to a pose, from which on the device renders `wrench` of that contact.
    fn give(&mut self, pose: &InstrumentPose, wrench: Wrench) {
        if let Some((from, rendered)) = self.pushed.replace((*pose, wrench)) {
            self.given_j -=
                rendered.force_n.dot(pose.place_m - from.place_m) + rendered.torque_n_m.dot(from.turn_to(pose));
        }
    }

    /// Returns this hand, with its instrument at a pose of [`Instrument::lead`] at `now_s`, s, as the second hand of another renderer.
    pub fn as_second_hand(&self, first_tool: u32, led: &InstrumentPose, now_s: f64) -> SecondHand {
        let (rows, velocity) = (self.contact.rows(), InstrumentVelocity::default());
        let instrument = OtherInstrument::of(first_tool, &self.instrument, rows, led, &velocity, now_s);
        SecondHand { instrument, given_j: self.given_j }
    }

    /// Returns how far the instrument overlaps with other instruments at the last tick, m: above the sum of two radii if an axis has
    /// passed another.
    pub fn overlap_m(&self) -> f64 {
        self.overlap_m
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
    use crate::hand::{Hand, HandState};
    use crate::instrument::InstrumentPart;
    use crate::local_model::ContactState;
    use crate::prediction::{Predicted, Predictor};
    use crate::tip::Tip;

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
            (!self.is_off.load(Ordering::Relaxed)).then_some(Predicted {
                wrench,
                contact_state,
                own_work_j: 0.0,
                others_work_j: 0.0,
            })
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
            let mut renderer = InstrumentRenderer::new(envelope, Instrument::default());
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

    /// One of two hands: a mass in a grip that follows a target, with an instrument that is all it feels.
    struct PushingHand {
        renderer: InstrumentRenderer,
        hand: Hand,
        state: HandState,
        pose: InstrumentPose,
        deepest_m: f64,
        least_j: f64,
        most_n: f64,
    }

    impl PushingHand {
        fn new(device: &str, hand: &str, pose: InstrumentPose) -> Self {
            let mut instrument = Instrument::default();
            let tip = Tip { radius_m: 0.003, ..Tip::default() };
            instrument.add_row(DVec3::ZERO, -0.06 * DVec3::X, tip, InstrumentPart::Body);
            let mut envelope = Envelope::new(Device::named(device).unwrap(), DVec3::ZERO);
            envelope.enable();
            let mut renderer = InstrumentRenderer::new(envelope, instrument);
            let copy = TurningCopy { factor: 0.0, is_off: Arc::default() };
            renderer.predict(Some(Prediction::new(Box::new(copy))));
            let state = HandState { place_m: pose.place_m, velocity_m_per_s: DVec3::ZERO };
            let hand = Hand::named(hand).unwrap();
            PushingHand { renderer, hand, state, pose, deepest_m: 0.0, least_j: 0.0, most_n: 0.0 }
        }

        fn seen(&self, first_tool: u32, now_s: f64) -> SecondHand {
            self.renderer.as_second_hand(first_tool, &self.pose, now_s)
        }

        /// Renders a tick at its pose, where a tissue that it does not touch is told by a sample, beside another hand. Returns the force, N.
        fn render(&mut self, tick: u32, other: SecondHand, is_second: bool) -> DVec3 {
            let (now_s, pose) = (f64::from(tick) * TICK_S, self.pose);
            let wrench = Wrench::default();
            self.renderer.receive(WrenchSample { sequence: tick.into(), client_time_s: now_s, pose, wrench }, now_s);
            let others = if is_second { &[][..] } else { &[other.instrument] };
            self.renderer.follow_instruments(is_second.then_some(other), others);
            self.renderer.tick(now_s, &pose).force_n
        }

        /// Goes on for a tick towards a target that moves.
        fn tick(&mut self, tick: u32, [from_m, to_m]: [DVec3; 2], other: SecondHand, is_second: bool) {
            let force_n = self.render(tick, other, is_second);
            let string_n = self.hand.string_n(from_m, self.state.place_m);
            self.state = self.hand.advance(self.state, from_m, to_m, force_n + string_n, TICK_S);
            self.pose.place_m = self.state.place_m;
            self.deepest_m = self.deepest_m.max(self.renderer.overlap_m());
            self.least_j = self.least_j.min(self.renderer.envelope.energy_j());
            self.most_n = self.most_n.max(force_n.length());
        }
    }

    /// Two hands push their instruments together, each at 0.05 m/s, until their targets are 16 mm beyond each other, and go back; or
    /// nobody holds the upper one, and it does not move by itself. The poses are of the instruments when they just touch.
    fn push([lower, upper]: [InstrumentPose; 2], is_second: bool, is_held: bool) -> [PushingHand; 2] {
        let apart =
            |pose: InstrumentPose, by_m: f64| InstrumentPose { place_m: pose.place_m + by_m * DVec3::Z, ..pose };
        let upper_hand = if is_held { "medium" } else { "none" };
        let starts = [apart(lower, -0.01), apart(upper, 0.01)];
        let mut hands =
            [PushingHand::new("sigma7", "medium", starts[0]), PushingHand::new("sigma7", upper_hand, starts[1])];
        // The force of a renderer that begins grows within a second.
        for tick in 0..3000_u32 {
            let way_m = |tick: u32| 5e-5 * f64::from(tick.saturating_sub(1200).min(3000 - tick).min(360));
            let target_m = |which: usize, tick: u32| match which {
                0 => starts[0].place_m + way_m(tick) * DVec3::Z,
                _ => starts[1].place_m - if is_held { way_m(tick) * DVec3::Z } else { 0.01 * DVec3::Z },
            };
            let seen = [hands[0].seen(0, f64::from(tick) * TICK_S), hands[1].seen(30, f64::from(tick) * TICK_S)];
            for (which, hand) in hands.iter_mut().enumerate() {
                hand.tick(tick, [target_m(which, tick), target_m(which, tick + 1)], seen[1 - which], is_second);
            }
        }
        hands
    }

    #[test]
    fn two_instruments_that_are_pushed_together_do_not_pass_and_give_no_energy() {
        let along_y = DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2);
        let shaft = InstrumentPose::at(DVec3::new(0.03, 0.0, 0.0));
        let crossed = InstrumentPose { orientation: along_y, ..InstrumentPose::at(DVec3::new(0.0, 0.03, 0.006)) };
        // The second instrument points down, with its tip on the first one's shaft.
        let down = DQuat::from_rotation_y(std::f64::consts::FRAC_PI_2);
        let tip = InstrumentPose { orientation: down, ..InstrumentPose::at(DVec3::new(0.0, 0.0, 0.006)) };
        for (upper, is_second, is_held) in [crossed, tip]
            .into_iter()
            .flat_map(|upper| [(true, true), (false, true), (true, false)].map(|(a, b)| (upper, a, b)))
        {
            let hands = push([shaft, upper], is_second, is_held);
            let together_j: f64 = hands.iter().map(|hand| hand.renderer.envelope.energy_j()).sum();
            for PushingHand { deepest_m, least_j, most_n, .. } in hands {
                assert!(deepest_m < 0.0055 && deepest_m > 1e-4 && most_n > 0.2, "{deepest_m} m {most_n} N");
                // One of two hands may get what the other gives.
                assert!(is_second || least_j > -3e-4, "{least_j} J");
            }
            assert!(together_j > -5e-4, "{together_j} J");
        }
    }

    #[test]
    fn a_device_without_torque_gives_its_second_hand_nothing_by_turning() {
        for (device, gives) in [("omega3", false), ("sigma7", true)] {
            let middle = InstrumentPose::at(DVec3::new(0.03, 0.0, 0.0));
            let mut hand = PushingHand::new(device, "medium", middle);
            let other = PushingHand::new(device, "medium", InstrumentPose::at(DVec3::new(-0.02, 0.0, 0.0061)));
            for tick in 0..2000_u32 {
                // Its end turns up into the other shaft.
                let angle = 0.03 * (f64::from(tick) - 1200.0).max(0.0) / 800.0;
                hand.pose = InstrumentPose { orientation: DQuat::from_rotation_y(angle), ..middle };
                hand.render(tick, other.seen(30, f64::from(tick) * TICK_S), true);
            }
            let (overlap_m, given_j) = (hand.renderer.overlap_m(), hand.renderer.given_j);
            assert!(overlap_m > 5e-4, "{device}: {overlap_m} m");
            assert!(if gives { given_j > 1e-5 } else { given_j == 0.0 }, "{device}: {given_j} J");
        }
    }
}
