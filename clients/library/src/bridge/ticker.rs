//! Rendering for a thread that ticks a thousand times per second, and the data exchanged with the network side.
//!
//! A tick does not wait. Laws arrive and places leave by queues of fixed length; of the models only the newest is
//! kept (`exchange`). A tick allocates and frees no memory: laws that are no longer needed go back to the network
//! side.

use glam::{DQuat, DVec3};
use palpate_haptics::dead_reckoning::News;
use palpate_haptics::deadband::HEARTBEAT_S;
use palpate_haptics::instrument_contact::MAX_OTHER_INSTRUMENTS;
use palpate_haptics::prediction::{MAX_OTHERS, midway_s};
use palpate_haptics::renderer::MAX_LAWS;
use palpate_haptics::{
    Device, Envelope, Instrument, InstrumentPose, InstrumentRenderer, Law, MotionState, OtherInstrument, OtherTool,
    Prediction, Predictor, Renderer, RenderingState, SecondHand, Tip, Wrench,
};
use palpate_proto::{instrument, pb, touch};
use std::collections::VecDeque;

use super::hands::BridgeHand;
use super::loop_renderer::{LoopRenderer, NewestSample};
use crate::Error;
use crate::device::Reading;
use crate::exchange::{NewestReader, NewestWriter, QueueReader, QueueView, QueueWriter, newest, queue};

/// Where a tool is at a time.
#[derive(Debug, Clone, Copy)]
pub(super) struct ToolPose {
    /// Time of the client's clock, ns.
    pub(super) client_time_ns: u64,
    pub(super) pose: InstrumentPose,
    /// Velocity, m/s, if the server is to extrapolate the motion.
    pub(super) velocity_m_per_s: Option<DVec3>,
    /// The orientation of the device, also if it leads a single tip.
    pub(super) orientation: DQuat,
    /// The buttons of the device that are pressed.
    pub(super) buttons: u32,
}

/// What the network side sends to the ticks, in order.
enum LoopEvent {
    /// A new connection: its first law, and the place in the tissue of the middle of the device's workspace, m.
    Begin { connection: u64, law: Law, origin_m: DVec3 },
    /// Another valid law of this connection, with its number.
    Learn { number: u32, law: Law },
    /// A copy of this connection's tissue; `None` if the tissue has changed.
    Copy(Option<Prediction>),
}

/// What a tick no longer needs, to be dropped on another thread.
enum Used {
    #[allow(dead_code)] // Dropped.
    Law(Law),
    #[allow(dead_code)] // Dropped.
    Copy(Prediction),
}

/// State of a connection of which only the newest value counts.
#[derive(Clone, Copy)]
struct Newest {
    connection: u64,
    sample: Option<NewestSample>,
    /// The other tools at the time of the sample, and their number.
    others: [Option<OtherTool>; MAX_OTHERS],
    /// The instruments of other clients then.
    instruments: [Option<OtherInstrument>; MAX_OTHER_INSTRUMENTS],
    /// The longest time between two poses that the server wants, s; 0 before it has sent one.
    wanted_s: f64,
}

/// Limit on the commands that wait for the network: more would be a backlog.
const COMMANDS: usize = 64;
/// Limit on the laws that wait for a tick. Others wait on the network side.
const LAWS: usize = 2 * MAX_LAWS;
/// Limit on laws and copies that wait to be dropped: at least as many as a renderer has, so that a tick can always
/// replace one.
const USED: usize = 4 * MAX_LAWS;
/// Jump of the clock above which it counts as set rather than a tick as late, s.
const MAX_AHEAD_S: f64 = 3600.0;

/// The frame in which the positions of the readings are measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PositionOrigin {
    /// The device's frame, whose origin is the middle of its workspace. It is placed on the top of the tissue, which
    /// is the middle of a sheet.
    #[default]
    Workspace,
    /// The tissue's frame, as for a tracker that is calibrated to it.
    Tissue,
}

/// The loop's half of a bridge, from [`super::begin`] or [`super::Offline`]: renders forces and queues the poses to
/// send. Call [`Ticker::tick`] at 1 kHz, on any thread.
pub struct Ticker {
    told: QueueReader<LoopEvent>,
    newest: NewestReader<Newest>,
    /// Whether the renderer has not seen the newest model yet.
    is_fresh: bool,
    used: QueueWriter<Used>,
    commands: QueueWriter<ToolPose>,
    has_spoken: bool,
    device: Device,
    origin: PositionOrigin,
    up_deadband: f64,
    /// Number of the last [`LoopEvent::Begin`]; 0 before the first.
    connection: u64,
    origin_m: DVec3,
    renderer: LoopRenderer,
    /// The instrument that the device leads; `None`: a single tip.
    instrument: Option<Instrument>,
    was_asked: bool,
    buttons: u32,
    news: News,
    clock: Clock,
    place_m: DVec3,
    /// One of two hands of this client, with its first tool, and the tip of that if it leads no instrument.
    hand: Option<(BridgeHand, u32, Tip)>,
    /// The time by the client's clock at which the other tools of the newest model were where it says, s; `None` before the
    /// first model.
    others_time_s: Option<f64>,
    /// The other tools, and the instruments of other clients; kept so that a tick allocates nothing.
    others: Vec<OtherTool>,
    other_instruments: Vec<OtherInstrument>,
}

/// The network's half of a bridge: passes laws, models and copies to the ticks.
pub(super) struct LoopFeed {
    told: QueueWriter<LoopEvent>,
    newest: NewestWriter<Newest>,
    used: QueueReader<Used>,
    connection: u64,
    /// Events that did not fit into the queue yet.
    waiting: VecDeque<LoopEvent>,
    sample: Option<NewestSample>,
    others: [Option<OtherTool>; MAX_OTHERS],
    instruments: [Option<OtherInstrument>; MAX_OTHER_INSTRUMENTS],
    wanted_s: f64,
}

/// Creates both halves, and the queue of commands that the ticks send. `device` describes the limits of the forces.
pub(super) fn ticker(
    device: Device,
    origin: PositionOrigin,
    up_deadband: f64,
) -> (Ticker, LoopFeed, QueueReader<ToolPose>) {
    let (to_learn, told) = queue(LAWS);
    let (used, back) = queue(USED);
    let (commands, received) = queue(COMMANDS);
    let (newest_writer, newest_reader) = newest(&Newest {
        connection: 0,
        sample: None,
        others: [None; MAX_OTHERS],
        instruments: [None; MAX_OTHER_INSTRUMENTS],
        wanted_s: 0.0,
    });
    let ticker = Ticker {
        told,
        newest: newest_reader,
        is_fresh: false,
        used,
        commands,
        has_spoken: false,
        device,
        origin,
        up_deadband,
        connection: 0,
        origin_m: DVec3::ZERO,
        // This law is not used before the first connection.
        renderer: LoopRenderer::Tip(Box::new(Renderer::new(Law::linear(0.0, 0.0), Envelope::new(device, DVec3::ZERO)))),
        instrument: None,
        was_asked: false,
        buttons: 0,
        news: News::default(),
        clock: Clock::default(),
        place_m: DVec3::ZERO,
        hand: None,
        others_time_s: None,
        others: Vec::with_capacity(2 * MAX_OTHERS),
        other_instruments: Vec::with_capacity(MAX_OTHER_INSTRUMENTS),
    };
    let feed = LoopFeed {
        told: to_learn,
        newest: newest_writer,
        used: back,
        connection: 0,
        waiting: VecDeque::new(),
        sample: None,
        others: [None; MAX_OTHERS],
        instruments: [None; MAX_OTHER_INSTRUMENTS],
        wanted_s: 0.0,
    };
    (ticker, feed, received)
}

/// Converts the times of a caller so that they never run backwards.
#[derive(Default)]
struct Clock {
    /// The caller's time at which this clock shows 1 s; 0 means "no time" in the protocol.
    origin_s: Option<f64>,
    now_s: f64,
}

impl Clock {
    /// Returns the current time, s. If the caller's clock goes back, or ahead by more than an hour, it was set: this
    /// one continues from its last value.
    fn at(&mut self, time_s: f64) -> f64 {
        if !time_s.is_finite() {
            return f64::NAN;
        }
        let origin_s = *self.origin_s.get_or_insert(time_s);
        let now_s = 1.0 + (time_s - origin_s);
        // Also before the first tick, when `now_s` is 0.
        if now_s < self.now_s || now_s - self.now_s > MAX_AHEAD_S {
            self.now_s = if now_s < self.now_s { self.now_s } else { self.now_s + MAX_AHEAD_S };
            self.origin_s = Some(time_s - (self.now_s - 1.0));
        } else {
            self.now_s = now_s;
        }
        self.now_s
    }
}

impl Ticker {
    /// Returns this loop as that of one of two hands, if `hand` is one, which leads a tool with a tip, or an instrument from that tool
    /// on.
    #[must_use]
    pub(super) fn of_hand(self, hand: Option<BridgeHand>, tool: u32, tip: Tip) -> Self {
        Ticker { hand: hand.map(|hand| (hand, tool, tip)), ..self }
    }

    /// Returns this loop as that of a device that leads an instrument, if there is one.
    #[must_use]
    pub(super) fn of_instrument(self, instrument: Option<Instrument>) -> Self {
        let Some(instrument) = instrument else { return self };
        let renderer = InstrumentRenderer::new(Envelope::new(self.device, DVec3::ZERO), instrument.clone());
        Ticker { renderer: LoopRenderer::Instrument(Box::new(renderer)), instrument: Some(instrument), ..self }
    }

    /// Returns the force to render from now on, N, for a device that reports `reading` at `time_s`, s. The times may
    /// have any origin and must advance between ticks. Returns zero before the first connection. Queues a pose for the
    /// network; drops it if 64 wait. A change of [`Reading::enable`] from false to true enables forces.
    ///
    /// Takes bounded time: no lock, no call of the system, no memory allocated or freed. Another thread steps a copy
    /// of the tissue. Ticks may be late, early or missing: the envelope takes the time since the last one into
    /// account.
    pub fn tick(&mut self, reading: Reading, time_s: f64) -> DVec3 {
        self.tick_turned(reading, DQuat::IDENTITY, 0.0, time_s).force_n
    }

    /// Does a tick as [`Ticker::tick`] does, for a device that also has an orientation, of length 1, and an angle between jaws, rad.
    /// Returns force and torque to render from now on, the torque about the place of the reading; no torque for a single tip, or if
    /// the device renders none.
    pub fn tick_turned(&mut self, reading: Reading, orientation: DQuat, jaw_rad: f64, time_s: f64) -> Wrench {
        let now_s = self.clock.at(time_s);
        self.is_fresh |= self.newest.refresh();
        self.learn();
        self.has_spoken = false;
        self.place_m = match self.origin {
            PositionOrigin::Workspace => reading.place_m + self.origin_m,
            PositionOrigin::Tissue => reading.place_m,
        };
        let (was_asked, place_m) = (std::mem::replace(&mut self.was_asked, reading.enable), self.place_m);
        // Before the first connection the place of the tissue is not known.
        if self.connection == 0 {
            return Wrench::default();
        }
        let pose = match &self.instrument {
            // A device may have a gripper, and its instrument no jaws.
            Some(instrument) => {
                InstrumentPose { place_m, orientation, jaw_rad: if instrument.has_jaws() { jaw_rad } else { 0.0 } }
            }
            None => InstrumentPose::at(place_m),
        };
        let renderer = &mut self.renderer;
        if reading.enable && !was_asked {
            renderer.envelope_mut().reset();
            renderer.envelope_mut().enable();
        }
        let Newest { connection, sample, others, instruments, wanted_s } = self.newest.read();
        let (connection, wanted_s) = (*connection, *wanted_s);
        let is_news = self.is_fresh && connection == self.connection;
        if let Some(time_s) = sample.filter(|_| is_news).and_then(|sample| renderer.receive(&sample, now_s)) {
            self.others_time_s = Some(midway_s(time_s, now_s));
        }
        self.is_fresh &= !is_news;
        let of_time = |other: OtherTool, time_s| OtherTool { motion: MotionState { time_s, ..other.motion }, ..other };
        let mut second = None;
        if is_news || self.hand.is_some() {
            self.others.clear();
            if let Some((hand, first, tip)) = &mut self.hand {
                let at = |tool, tip, place_m| {
                    let motion = MotionState { time_s: now_s, place_m, velocity_m_per_s: DVec3::ZERO };
                    OtherTool { tool, tip, motion }
                };
                match &self.instrument {
                    Some(instrument) => {
                        let led = instrument.lead(&pose);
                        let tips = (*first..).take(instrument.tips.len()).enumerate();
                        let tips = tips.map(|(number, tool)| {
                            at(tool, instrument.tip(number, &led), instrument.tip_m(number, &led))
                        });
                        hand.tell(tips, renderer.as_second_hand(*first, &led, now_s));
                    }
                    None => hand.tell(std::iter::once(at(*first, *tip, place_m)), None),
                }
                let (other, tools) = hand.other();
                // The clock of the other loop began at another moment.
                second = other.map(|other| SecondHand { instrument: other.instrument.at_time(now_s), ..other });
                self.others.extend(tools.map(|other| of_time(other, now_s)));
            }
            let own = self.others.len();
            if let Some(time_s) = self.others_time_s.filter(|_| connection == self.connection) {
                for other in others.iter().map_while(|other| *other) {
                    // What the own second hand leads is known better by that.
                    if self.others[..own].iter().all(|second| second.tool != other.tool) {
                        self.others.push(of_time(other, time_s));
                    }
                }
            }
            renderer.follow_others(&self.others);
            self.other_instruments.clear();
            if let Some(time_s) = self.others_time_s.filter(|_| connection == self.connection) {
                let is_second = |other: &OtherInstrument| {
                    second.is_some_and(|second: SecondHand| second.instrument.first_tool == other.first_tool)
                };
                let known = instruments.iter().map_while(|other| *other).filter(|other| !is_second(other));
                self.other_instruments.extend(known.map(|other| other.at_time(time_s)));
            }
            renderer.follow_instruments(second, &self.other_instruments);
        }
        let wrench = renderer.tick(now_s, &pose);
        if !(pose.is_finite() && now_s.is_finite()) {
            return wrench;
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let client_time_ns = (now_s * 1e9) as u64;
        let still = ToolPose { client_time_ns, pose, velocity_m_per_s: None, orientation, buttons: self.buttons };
        let command = if let Some(way_m) = renderer.way_m(self.up_deadband) {
            let heartbeat_s = if connection == self.connection && wanted_s > 0.0 { wanted_s } else { HEARTBEAT_S };
            let told = self.news.tell(now_s, place_m, way_m, heartbeat_s);
            told.map(|told| ToolPose { velocity_m_per_s: Some(told.velocity_m_per_s), ..still })
        } else {
            Some(still)
        };
        // If the network does not keep up, this position is dropped; the next one replaces it.
        self.has_spoken = command.is_some_and(|command| self.commands.push(command).is_ok());
        wrench
    }

    /// Sets the buttons of the device that are pressed from the next tick on, bit n for button n ([`super::Options::cut_button`]). By
    /// default none is.
    pub fn press(&mut self, buttons: u32) {
        self.buttons = buttons;
    }

    /// Applies the events since the last tick, as long as there is room to give back what they replace.
    fn learn(&mut self) {
        for _ in 0..LAWS {
            if self.used.room() <= MAX_LAWS {
                return;
            }
            let Some(told) = self.told.pop() else { return };
            let used = &mut self.used;
            // Checked above: there is room.
            let mut give_back = |value: Used| drop(used.push(value));
            match told {
                LoopEvent::Begin { connection, law, origin_m } => {
                    self.renderer.begin_with(law, |law| give_back(Used::Law(law)));
                    self.renderer.predict(None).into_iter().for_each(|copy| give_back(Used::Copy(copy)));
                    if self.connection == 0 {
                        *self.renderer.envelope_mut() = Envelope::new(self.device, origin_m);
                    }
                    // The envelope of an earlier connection stays: a pause remains, and a rendered force falls at the
                    // slew limit.
                    (self.connection, self.origin_m, self.others_time_s) = (connection, origin_m, None);
                }
                LoopEvent::Learn { number, law } => {
                    self.renderer.learn_with(number, law, |law| give_back(Used::Law(law)));
                }
                LoopEvent::Copy(copy) => {
                    self.renderer.predict(copy).into_iter().for_each(|copy| give_back(Used::Copy(copy)));
                }
            }
        }
    }

    /// Returns the number of ticks so far that were rendered from a copy of the tissue ([`super::Options::copies`]).
    pub fn predicted(&self) -> u64 {
        self.renderer.predicted()
    }

    /// Stops rendering until [`Reading::enable`] changes from false to true again. The force falls to zero within the
    /// next ticks, at the envelope's slew limit.
    pub fn disable(&mut self) {
        self.renderer.envelope_mut().disable();
    }

    /// Returns whether forces are rendered; `None` before the first connection.
    pub fn state(&self) -> Option<RenderingState> {
        (self.connection > 0).then(|| self.renderer.state())
    }

    /// Returns the position of the tool at the last tick, in the tissue's frame, m; before the first connection, in
    /// the frame of the reading; zero before the first tick.
    pub fn place_m(&self) -> DVec3 {
        self.place_m
    }

    /// Returns the age of the newest local model at the last tick, s: the time since the tool was at the place that
    /// it describes. `None` without a model.
    pub fn model_age_s(&self) -> Option<f64> {
        self.renderer.model_time_s().filter(|_| self.connection > 0).map(|time_s| self.clock.now_s - time_s)
    }

    /// Returns the limits that act on the forces, in their current state; `None` before the first tick of the first
    /// connection. It stays over later connections.
    pub fn envelope(&self) -> Option<&Envelope> {
        (self.connection > 0).then(|| self.renderer.envelope())
    }

    /// Returns whether the network side has ended for good: its half was dropped or ended, or the server refused the
    /// first connection. Forces then fade, and no tick changes that.
    pub fn is_over(&self) -> bool {
        self.commands.is_over()
    }

    /// Returns whether the device leads an instrument.
    pub(super) fn has_instrument(&self) -> bool {
        self.instrument.is_some()
    }

    /// Returns whether the last tick had something to send.
    pub(super) fn has_spoken(&self) -> bool {
        self.has_spoken
    }

    /// Returns a view by which another thread sees whether there is something to send.
    pub(super) fn commands_view(&self) -> QueueView {
        self.commands.view()
    }
}

impl std::fmt::Debug for Ticker {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Ticker")
            .field("connection", &self.connection)
            .field("state", &self.state())
            .finish_non_exhaustive()
    }
}

/// Converts the law in a message, if it is valid.
fn law(message: &pb::ForceLaw) -> Result<Law, Error> {
    touch::from_law(message).map_err(|refusal| Error::Connection(refusal.to_string()))
}

impl LoopFeed {
    /// Starts a new connection to a tissue, with its law if a single tip is led; the middle of the device's workspace is placed at `origin_m`, m.
    ///
    /// # Errors
    /// Returns an error if the law can't be used.
    pub(super) fn begin(&mut self, message: Option<&pb::ForceLaw>, origin_m: DVec3) -> Result<(), Error> {
        // The loop of an instrument uses no law.
        let law = message.map_or(Ok(Law::linear(0.0, 0.0)), law)?;
        self.connection += 1;
        (self.sample, self.wanted_s) = (None, 0.0);
        self.forget_others();
        // Drops what the ticks have not taken of the connection before.
        self.waiting.clear();
        self.waiting.push_back(LoopEvent::Begin { connection: self.connection, law, origin_m });
        self.pass_on();
        Ok(())
    }

    /// Adds another law. Drops the oldest waiting one if more than [`MAX_LAWS`] wait.
    ///
    /// # Errors
    /// Returns an error if the law can't be used.
    pub(super) fn learn(&mut self, message: &pb::ForceLaw) -> Result<(), Error> {
        let law = law(message)?;
        self.waiting.push_back(LoopEvent::Learn { number: message.number, law });
        let is_law = |told: &LoopEvent| matches!(told, LoopEvent::Learn { .. });
        if self.waiting.iter().filter(|told| is_law(told)).count() > MAX_LAWS {
            let first = self.waiting.iter().position(is_law);
            first.and_then(|first| self.waiting.remove(first));
        }
        self.pass_on();
        Ok(())
    }

    /// Sets the copy of the connection's tissue; `None` if the tissue has changed.
    pub(super) fn predict(&mut self, copy: Option<Box<dyn Predictor>>) {
        // Only the newest copy counts.
        self.waiting.retain(|told| !matches!(told, LoopEvent::Copy(_)));
        self.waiting.push_back(LoopEvent::Copy(copy.map(Prediction::new)));
        self.pass_on();
    }

    /// Takes the local model of the tool, or the wrench on the instrument, and the other tools from a sample, and the interval at which the server wants poses, s.
    pub(super) fn receive(&mut self, sample: &pb::Sample, wanted_s: f64) {
        self.wanted_s = wanted_s;
        let model = sample.tools.first().and_then(|tool| tool.local_model.as_ref());
        let model = model.map(|model| touch::from_local_model(model, sample.step));
        let wrench = sample.instruments.first().map(|felt| instrument::from_sample(felt, sample.step));
        let told = wrench.map(|wrench| (NewestSample::Wrench(wrench), wrench.client_time_s));
        let told = told.or_else(|| model.map(|model| (NewestSample::Model(model), model.client_time_s)));
        if told.is_none() {
            // When the others were where is not known.
            self.forget_others();
        }
        if let Some((told, time_s)) = told
            && self.sample.is_none_or(|newest| newest.sequence() < told.sequence())
        {
            self.sample = Some(told);
            self.forget_others();
            let others = sample.other_tools.iter().map(|other| touch::from_other_tool(other, time_s));
            self.others.iter_mut().zip(others.flatten()).for_each(|(place, other)| *place = Some(other));
            let others = sample.other_instruments.iter().map(|other| instrument::from_other_instrument(other, time_s));
            self.instruments.iter_mut().zip(others).for_each(|(place, other)| *place = Some(other));
        }
        self.pass_on();
    }

    /// Forgets the tools and instruments of other clients.
    fn forget_others(&mut self) {
        (self.others, self.instruments) = ([None; MAX_OTHERS], [None; MAX_OTHER_INSTRUMENTS]);
    }

    /// Passes on what fits. A model goes after the laws that arrived before it.
    fn pass_on(&mut self) {
        while self.used.pop().is_some() {}
        while let Some(told) = self.waiting.pop_front() {
            if let Err(told) = self.told.push(told) {
                self.waiting.push_front(told);
                return;
            }
        }
        let Self { connection, sample, others, instruments, wanted_s, .. } = *self;
        let newest = Newest { connection, sample, others, instruments, wanted_s };
        self.newest.write(|place| *place = newest);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use palpate_haptics::{ContactState, InstrumentPose, Port, Predicted, Wrench};

    use super::super::hands::two_hands;
    use super::*;

    /// A copy that says which other tools it is given.
    struct TellingCopy(NewestWriter<Vec<OtherTool>>);

    impl Predictor for TellingCopy {
        fn feel(&mut self, _: f64, _: &InstrumentPose, others: &[OtherTool]) -> Option<Predicted> {
            self.0.write(|told| *told = others.to_vec());
            Some(Predicted {
                wrench: Wrench::default(),
                contact_state: ContactState::Free,
                own_work_j: 0.0,
                others_work_j: 0.0,
            })
        }
    }

    fn sample(sequence: u64, client_time_ns: u64, other_tools: Vec<pb::OtherTool>) -> pb::Sample {
        let local_model = Some(pb::LocalModel { sequence, client_time_ns, ..Default::default() });
        let tools = vec![pb::ToolSample { local_model, ..Default::default() }];
        pb::Sample { tools, other_tools, ..Default::default() }
    }

    #[test]
    fn a_copy_has_the_own_second_hand_at_once_and_other_clients_tools_by_samples() {
        let device = Device::named("omega3").unwrap();
        let [left, right] = two_hands();
        let one_of = |hand: BridgeHand, tool: u32| {
            let (ticker, feed, commands) = ticker(device, PositionOrigin::Tissue, 0.0);
            let tip = Tip { radius_m: 0.003 + 1e-3 * f64::from(tool), ..Tip::default() };
            (ticker.of_hand(Some(hand), tool, tip), feed, commands)
        };
        let (mut left, mut left_feed, _left_commands) = one_of(left, 0);
        let (mut right, mut right_feed, _right_commands) = one_of(right, 1);
        let law = touch::law(&Law::linear(400.0, 0.5), 0);
        let (say, mut told) = newest(&Vec::new());
        let mut heard = || {
            assert!(told.refresh());
            told.read().clone()
        };
        left_feed.begin(Some(&law), DVec3::ZERO).unwrap();
        left_feed.predict(Some(Box::new(TellingCopy(say))));
        let at = |x_m: f64| Reading { place_m: DVec3::new(x_m, 0.0, 0.0), enable: true };
        left.tick(at(0.0), 0.000);
        // The other hand has no connection yet.
        assert_eq!(heard(), []);
        right_feed.begin(Some(&law), DVec3::ZERO).unwrap();
        right.tick(at(0.02), 0.0005);
        left.tick(at(0.0), 0.001);
        let [other] = heard()[..] else { panic!("one other tool") };
        assert_eq!((other.tool, other.tip.radius_m, other.motion.place_m.x), (1, 0.004, 0.02));
        // Its clock began at another moment: the place counts for now.
        assert!((other.motion.time_s - 1.001).abs() < 1e-9, "{}", other.motion.time_s);
        // A sample that is 40 ms old knows the second hand too, and another client's tool, which it saw 20 ms ago.
        let seen = |tool: u32, x_m: f64| pb::OtherTool {
            tool,
            position_m: Some(pb::Vector3 { x: x_m, y: 0.0, z: 0.0 }),
            ..Default::default()
        };
        left_feed.receive(&sample(1, 1_000_000_000, vec![seen(1, 0.01), seen(5, 0.03)]), 0.0);
        left.tick(at(0.0), 0.040);
        let [own, another] = heard()[..] else { panic!("two other tools") };
        assert_eq!((own.tool, own.motion.place_m.x), (1, 0.02));
        assert_eq!((another.tool, another.motion.place_m.x), (5, 0.03));
        assert!((another.motion.time_s - 1.020).abs() < 1e-9, "{}", another.motion.time_s);
        drop(right);
        left.tick(at(0.0), 0.041);
        let left_over: Vec<u32> = heard().iter().map(|other| other.tool).collect();
        // The server still has its tool.
        assert_eq!(left_over, [1, 5]);
    }

    #[test]
    fn a_copy_has_all_tips_of_the_instrument_of_the_own_second_hand_where_its_port_lets_them_be() {
        let device = Device::named("sigma7").unwrap();
        let port = Some(Port { place_m: DVec3::new(0.02, 0.0, 0.2), handle_m: 0.33 });
        let tip = Tip { radius_m: 0.003, ..Tip::default() };
        let mut grasper = Instrument { port, ..Instrument::default() };
        grasper.add_parts(Some((0.015, tip)), Some((0.02, tip)));
        let [left, right] = two_hands();
        let one_of = |hand: BridgeHand, first: u32| {
            let (ticker, feed, commands) = ticker(device, PositionOrigin::Tissue, 0.0);
            let ticker = ticker.of_hand(Some(hand), first, Tip::default()).of_instrument(Some(grasper.clone()));
            (ticker, feed, commands)
        };
        let (mut left, mut left_feed, _left_commands) = one_of(left, 0);
        let (mut right, mut right_feed, _right_commands) = one_of(right, 40);
        let (say, mut told) = newest(&Vec::new());
        left_feed.begin(None, DVec3::ZERO).unwrap();
        left_feed.predict(Some(Box::new(TellingCopy(say))));
        right_feed.begin(None, DVec3::ZERO).unwrap();
        let reading = |x_m: f64| Reading { place_m: DVec3::new(x_m, 0.0, 0.001), enable: true };
        right.tick_turned(reading(0.02), DQuat::IDENTITY, 0.5, 0.0005);
        // A sample knows some of the second hand's tools too.
        let others = (44..48).map(|tool| pb::OtherTool {
            tool,
            position_m: Some(pb::Vector3 { x: 0.0, y: 0.0, z: 0.0 }),
            ..Default::default()
        });
        left_feed.receive(&sample(1, 1_000_000_000, others.collect()), 0.0);
        left.tick_turned(reading(0.0), DQuat::IDENTITY, 0.0, 0.001);
        assert!(told.refresh());
        let led = grasper.lead(&InstrumentPose { jaw_rad: 0.5, ..InstrumentPose::at(DVec3::new(0.02, 0.0, 0.001)) });
        let expected: Vec<_> = (0..grasper.tips.len()).map(|number| grasper.tip_m(number, &led)).collect();
        let found: Vec<_> = told.read().iter().map(|other| other.motion.place_m).collect();
        assert_eq!(found, expected);
        assert!(told.read().iter().zip(40..).all(|(other, tool)| other.tool == tool && other.tip == tip));
    }
}
