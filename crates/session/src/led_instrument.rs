//! An instrument that a client leads: its poses become commands to the tools of its tips, and the forces on these its wrench.
//!
//! Contact, leases, journals and snapshots know tools alone. A pose of an instrument is one command to each of its tools, of
//! which either all or none are accepted.

use std::collections::VecDeque;

use glam::DVec3;
use palpate_haptics::pose_playback::EXTRAPOLATE_S;
use palpate_haptics::{Instrument, InstrumentPose, InstrumentVelocity, PortLoad, Wrench};

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

/// An instrument of a stream, with its newest poses.
#[derive(Debug, Clone)]
pub struct LedInstrument {
    instrument: Instrument,
    first_tool: u32,
    poses: VecDeque<AcceptedPose>,
}

/// What an instrument felt at the end of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
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
    /// What its port and the hand exert; `None` without a port.
    pub port_load: Option<PortLoad>,
}

impl LedInstrument {
    /// Creates an instrument without a pose. Its tips are the tools from `first_tool` on.
    pub fn new(instrument: Instrument, first_tool: u32) -> Self {
        LedInstrument { instrument, first_tool, poses: VecDeque::new() }
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
            let (place_m, tip) = (self.instrument.tip_m(number, &pose), self.instrument.tips[number].tip);
            let velocity_m_per_s =
                velocity.map(|velocity| self.instrument.tip_velocity_m_per_s(number, &pose, &velocity));
            match is_led(shape, place_m, tip.radius_m) {
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
    }

    /// Returns what the instrument felt by a sample of its tools; `None` before its first pose has acted, and after its release. One
    /// that is far from the tissue feels nothing, where its newest pose has it.
    pub fn sample(&self, sample: &Sample) -> Option<InstrumentSample> {
        let tips = || sample.tools.iter().filter_map(|tool| Some((self.tip(tool.tool)?, tool)));
        let Some((_, led)) = tips().find(|(_, tool)| tool.feel.is_some()) else {
            let far = self.poses.back().filter(|newest| newest.is_far)?;
            return Some(self.felt(far.client_time_s?, far.pose, &[]));
        };
        let pose = self.instrument.lead(&self.pose_at(led.acknowledged_sequence, led.place_time_s)?);
        let forces_n: Vec<_> =
            tips().filter_map(|(tip, tool)| Some((tip, tool.feel.as_ref()?.force_on_tool_n))).collect();
        Some(self.felt(led.place_time_s, pose, &forces_n))
    }

    /// Returns what the instrument feels at a pose by forces on its tips, N.
    fn felt(&self, client_time_s: f64, pose: InstrumentPose, forces_n: &[(usize, DVec3)]) -> InstrumentSample {
        let forces_n = || forces_n.iter().copied();
        let wrench = self.instrument.wrench(&pose, forces_n());
        InstrumentSample {
            first_tool: self.first_tool,
            client_time_s,
            pose,
            wrench,
            opening_n_m: self.instrument.has_jaws().then(|| self.instrument.opening_n_m(&pose, forces_n())),
            port_load: self.instrument.port_load(&pose, &wrench),
        }
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
