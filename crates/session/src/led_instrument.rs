//! An instrument that a client leads: its poses become commands to the tools of its tips, and the forces on these its wrench.
//!
//! Contact, leases, journals and snapshots know tools alone. A pose of an instrument is one command to each of its tools, of
//! which either all or none are accepted.

use std::collections::VecDeque;

use palpate_haptics::pose_playback::{EXTRAPOLATE_S, RELEASE_S};
use palpate_haptics::{
    ContactLoad, Instrument, InstrumentContact, InstrumentPose, InstrumentVelocity, JawTorqueMonitor, OtherInstrument,
    PortLoad, Wrench,
};

use super::Sample;
use super::command::Command;
use palpate_tissue::scene::script::{Action, is_led};
use palpate_tissue::shape::RestShape;

/// Largest number of poses that are kept. At 1 kHz that is half a second, longer than a pose waits for its step.
const KEPT: usize = 512;

/// An accepted pose.
#[derive(Debug, Clone, Copy)]
struct AcceptedPose {
    sequence: u64,
    /// Time of the client, s, by which it is played; `None` if it acts at a step.
    client_time_s: Option<f64>,
    pose: InstrumentPose,
    velocity: InstrumentVelocity,
    /// Whether all tips are far from the tissue, so that none is led.
    is_far: bool,
}

/// Longest time from one sample to the next from which a velocity follows, s.
const MAX_BETWEEN_S: f64 = 0.1;

/// An instrument of a stream, with its newest poses.
#[derive(Debug, Clone)]
pub struct LedInstrument {
    instrument: Instrument,
    first_tool: u32,
    poses: VecDeque<AcceptedPose>,
    contact: InstrumentContact,
    /// `None`: its jaws have no limit.
    jaws: Option<JawTorqueMonitor>,
    /// Where it was at the newest sample, for others, and for the next velocity; `None` if it was nowhere.
    seen: Option<(OtherInstrument, SeenPose)>,
}

/// Where an instrument was at a sample.
#[derive(Debug, Clone, Copy)]
struct SeenPose {
    /// Simulated time of the sample, and that time by the client's clock, s; 0 if its poses have none.
    now_s: f64,
    client_time_s: f64,
    pose: InstrumentPose,
    /// The newest pose that has arrived, if the instrument is far from the tissue.
    far: Option<u64>,
    /// Simulated time since which that is the newest one, s.
    since_s: f64,
}

/// What an instrument felt at the end of a step.
#[derive(Debug, Clone, PartialEq)]
pub struct InstrumentSample {
    /// The tool of its first tip.
    pub first_tool: u32,
    /// The time by the client's clock at which it was there, s; 0 if its poses have none.
    pub client_time_s: f64,
    /// Where it was then.
    pub pose: InstrumentPose,
    /// Force and torque of the tissue on the instrument, about its place.
    pub wrench: Wrench,
    /// Torque with which the tissue opens the jaws, N·m; `None` without jaws.
    pub opening_n_m: Option<f64>,
    /// The limit of that torque, N·m, if it exceeds it now and did not before ([`JawTorqueMonitor`]).
    pub exceeded_n_m: Option<f64>,
    /// What its port and the hand exert; `None` without a port.
    pub port_load: Option<PortLoad>,
    /// The instruments that it overlaps with, by the tool of their first tip, and what they exert.
    pub contacts: Vec<(u32, ContactLoad)>,
}

impl LedInstrument {
    /// Creates an instrument without a pose. Its tips are the tools from `first_tool` on.
    pub fn new(instrument: Instrument, first_tool: u32) -> Self {
        let (contact, jaws) = (InstrumentContact::new(&instrument), JawTorqueMonitor::of(&instrument));
        LedInstrument { instrument, first_tool, poses: VecDeque::new(), contact, jaws, seen: None }
    }

    /// Returns the instrument.
    pub fn instrument(&self) -> &Instrument {
        &self.instrument
    }

    /// Returns the tool of the first tip.
    pub fn first_tool(&self) -> u32 {
        self.first_tool
    }

    /// Returns whether a tool is one of its tips.
    pub fn has(&self, tool: u32) -> bool {
        self.tip(tool).is_some()
    }

    /// Returns the number of the tip that a tool is.
    fn tip(&self, tool: u32) -> Option<usize> {
        tool.checked_sub(self.first_tool).map(|tip| tip as usize).filter(|tip| *tip < self.instrument.tips.len())
    }

    /// Returns the commands that lead the tips to a pose: `command` to each tool, with its own action. Tips that are far from
    /// the tissue ([`is_led`]) are released. `shape` is the rest shape of the tissue.
    pub fn lead(
        &self,
        command: &Command,
        pose: &InstrumentPose,
        velocity: Option<&InstrumentVelocity>,
        shape: &dyn RestShape,
    ) -> Vec<Command> {
        let (pose, velocity) = self.led(pose, velocity);
        self.each(command, |number| {
            let (place_m, tip) = (self.instrument.tip_m(number, &pose), self.instrument.tip(number, &pose));
            let velocity_m_per_s =
                velocity.map(|velocity| self.instrument.tip_velocity_m_per_s(number, &pose, &velocity));
            match is_led(shape, place_m, tip.reach_m()) {
                true => Action::Pose { place_m, velocity_m_per_s, tip },
                false => Action::Release,
            }
        })
    }

    /// Returns a pose and its velocity as the instrument's port leaves them.
    fn led(
        &self,
        pose: &InstrumentPose,
        velocity: Option<&InstrumentVelocity>,
    ) -> (InstrumentPose, Option<InstrumentVelocity>) {
        let pose = self.instrument.lead(pose);
        (pose, velocity.map(|velocity| self.instrument.lead_velocity(&pose, velocity)))
    }

    /// Returns the commands that release the tips: `command` to each tool.
    pub fn release(&self, command: &Command) -> Vec<Command> {
        self.each(command, |_| Action::Release)
    }

    fn each(&self, command: &Command, action: impl Fn(usize) -> Action) -> Vec<Command> {
        let tools = (self.first_tool..).take(self.instrument.tips.len()).enumerate();
        tools.map(|(number, tool)| Command { tool, action: action(number), ..command.clone() }).collect()
    }

    /// Notes that the commands of [`LedInstrument::lead`] were accepted. `is_far`: all of them release.
    #[allow(clippy::cast_precision_loss)]
    pub fn accepted(
        &mut self,
        command: &Command,
        pose: InstrumentPose,
        velocity: Option<InstrumentVelocity>,
        is_far: bool,
    ) {
        if self.poses.len() == KEPT {
            self.poses.pop_front();
        }
        let by_time = command.client_time_ns != 0 && command.at_step.is_none();
        let client_time_s = by_time.then_some(command.client_time_ns as f64 * 1e-9);
        let (pose, velocity) = self.led(&pose, velocity.as_ref());
        let (sequence, velocity) = (command.sequence.unwrap_or_default(), velocity.unwrap_or_default());
        // A datagram may have overtaken another.
        let after = self.poses.partition_point(|before| before.sequence < sequence);
        self.poses.insert(after, AcceptedPose { sequence, client_time_s, pose, velocity, is_far });
    }

    /// Notes that the commands of [`LedInstrument::release`] were accepted.
    pub fn released(&mut self) {
        self.poses.clear();
        self.contact.forget();
        self.jaws.iter_mut().for_each(JawTorqueMonitor::reset);
        self.seen = None;
    }

    /// Finds where the instrument is by a sample of its tools, for the other instruments of its session ([`LedInstrument::seen`]).
    pub fn see(&mut self, sample: &Sample) {
        let before = self.seen.map(|(_, before)| before);
        let Some((at, velocity)) = self.at(sample, before) else {
            self.seen = None;
            return;
        };
        let rows = self.contact.rows();
        let other = OtherInstrument::of(self.first_tool, &self.instrument, rows, &at.pose, &velocity, at.now_s);
        self.seen = Some((other, at));
    }

    /// Returns where the instrument was at the newest sample, by the simulated time; `None` if it was nowhere, or if that sample is of
    /// more than 0.25 s before `now_s`.
    pub fn seen(&self, now_s: f64) -> Option<OtherInstrument> {
        self.seen.filter(|(_, at)| now_s - at.now_s <= RELEASE_S).map(|(seen, _)| seen)
    }

    /// Returns what the instrument felt by a sample of its tools that it has seen ([`LedInstrument::see`]); `None` before its first pose
    /// has acted, and after its release. One that is far from the tissue feels only other instruments, where its newest pose has it.
    /// `others` are those of the session.
    pub fn sample(
        &mut self,
        sample: &Sample,
        others: impl IntoIterator<Item = OtherInstrument>,
    ) -> Option<InstrumentSample> {
        let SeenPose { client_time_s, pose, .. } = self.seen?.1;
        let tips = sample.tools.iter().filter_map(|tool| Some((self.tip(tool.tool)?, tool)));
        let forces_n: Vec<_> = tips.filter_map(|(tip, tool)| Some(tool.feel.as_ref()?.force_on_tip(tip))).collect();
        let forces_n = || forces_n.iter().copied();
        let LedInstrument { instrument, first_tool, contact, jaws, .. } = self;
        contact.begin();
        let others = others.into_iter().filter(|other| other.first_tool != *first_tool);
        let touching = others.filter_map(|other| {
            let capsules = other.capsules.iter().flatten().map(|capsule| capsule.at(sample.simulation_time_s));
            Some((other.first_tool, contact.feel(instrument, &pose, other.first_tool, capsules)?))
        });
        let mut contacts: Vec<_> = touching.collect();
        contacts.sort_by_key(|(tool, _)| *tool);
        let wrench = instrument.wrench(&pose, forces_n());
        let opening_n_m = instrument.has_jaws().then(|| instrument.opening_n_m(&pose, forces_n()));
        let exceeded = |jaws: &mut JawTorqueMonitor| jaws.exceeds(opening_n_m?).then(|| jaws.limit_n_m());
        Some(InstrumentSample {
            first_tool: *first_tool,
            client_time_s,
            pose,
            wrench,
            opening_n_m,
            exceeded_n_m: jaws.as_mut().and_then(exceeded),
            port_load: instrument.port_load(&pose, &wrench),
            contacts,
        })
    }

    /// Returns where the instrument is at a sample of its tools, and its velocity; `before`: at the sample before. One that is far from
    /// the tissue is where the newest pose that has arrived has it, until its client has been silent for as long as tools are held.
    fn at(&self, sample: &Sample, before: Option<SeenPose>) -> Option<(SeenPose, InstrumentVelocity)> {
        let now_s = sample.simulation_time_s;
        if let Some(led) = sample.tools.iter().find(|tool| tool.feel.is_some() && self.has(tool.tool)) {
            let pose = self.instrument.lead(&self.pose_at(led.acknowledged_sequence, led.place_time_s)?);
            let at = SeenPose { now_s, client_time_s: led.place_time_s, pose, far: None, since_s: now_s };
            let before = before.filter(|before| before.far.is_none());
            let velocity = before.and_then(|before| velocity(&before.pose, &pose, now_s - before.now_s));
            return Some((at, velocity.unwrap_or_default()));
        }
        let newest = self.poses.back().filter(|newest| newest.is_far)?;
        let same = before.filter(|before| before.far == Some(newest.sequence));
        let since_s = same.map_or(now_s, |before| before.since_s);
        if newest.client_time_s.is_some() && now_s - since_s > RELEASE_S {
            return None;
        }
        // By the client's clock: poses may arrive together.
        let earlier =
            self.poses.iter().rev().nth(1).and_then(|earlier| {
                velocity(&earlier.pose, &newest.pose, newest.client_time_s? - earlier.client_time_s?)
            });
        let client_time_s = newest.client_time_s.unwrap_or(0.0);
        let at = SeenPose { now_s, client_time_s, pose: newest.pose, far: Some(newest.sequence), since_s };
        Some((at, earlier.unwrap_or(newest.velocity)))
    }

    /// Returns the pose of the command with a sequence number, or, for poses that are played by the client's time, that at a time
    /// of the client, s.
    fn pose_at(&self, sequence: u64, client_time_s: f64) -> Option<InstrumentPose> {
        let newest = self.poses.iter().rposition(|accepted| accepted.sequence <= sequence)?;
        if self.poses[newest].client_time_s.is_none() {
            return Some(self.poses[newest].pose);
        }
        let by_time = |accepted: &AcceptedPose| accepted.client_time_s.is_some_and(|time_s| time_s <= client_time_s);
        // An older pose than those that are kept can't be told.
        let before = &self.poses[self.poses.iter().rposition(by_time).unwrap_or(0)];
        let passed_s = client_time_s - before.client_time_s?;
        let next = self.poses.iter().find(|next| next.client_time_s.is_some_and(|time_s| time_s > client_time_s));
        Some(match next.and_then(|next| Some((next, next.client_time_s? - before.client_time_s?))) {
            Some((next, between_s)) if between_s > 0.0 => {
                before.pose.towards(&next.pose, (passed_s / between_s).clamp(0.0, 1.0))
            }
            _ => before.velocity.after(&before.pose, passed_s.clamp(0.0, EXTRAPOLATE_S)),
        })
    }
}

/// Returns the velocity between two poses that are `between_s` (s) apart; `None` if that is no time, or too long.
fn velocity(from: &InstrumentPose, to: &InstrumentPose, between_s: f64) -> Option<InstrumentVelocity> {
    (between_s > 0.0 && between_s < MAX_BETWEEN_S).then(|| InstrumentVelocity {
        velocity_m_per_s: (to.place_m - from.place_m) / between_s,
        angular_rad_per_s: from.turn_to(to) / between_s,
        jaw_rad_per_s: (to.jaw_rad - from.jaw_rad) / between_s,
    })
}
