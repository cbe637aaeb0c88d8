//! The server's end of the network: its intake receives commands, and the sampler of the stream selects samples.

use std::sync::Arc;

use glam::DVec3;
use palpate_haptics::datagram_health::ReceiveWindow;
use palpate_haptics::deadband::HEARTBEAT_S;
use palpate_haptics::{Law, LocalModel, MotionState, SendInterval};
use palpate_session::command::Command;
use palpate_session::current_laws::{FIRST, Laws};
use palpate_session::sample_selection::{Deadband, Sampler, Sampling, WantedHeartbeat};
use palpate_simulated::network::Transport;
use palpate_tissue::Model;
use palpate_tissue::response::force_law::Disc;
use palpate_tissue::scene::script::Action;

use super::laws::PlaceLaws;
use super::poses::Up;
use super::setup::{SecondLeader, Setup, TICK_S};
use super::spot::Spot;
use super::tissue::{LEASE, LinkTissue, SECOND_LEASE, SECOND_TOOL, TOOL, ns};

/// Time from a change of the tissue until the law of the new tissue is known, s.
const LAW_S: f64 = 0.1;

/// Another law, and its tissue, if the tissue has changed.
pub(super) struct Other {
    pub(super) number: u32,
    pub(super) law: Arc<Law>,
    pub(super) changed: Option<Arc<Model>>,
}

/// What a sample tells, in the hand's frame.
pub(super) struct Told {
    /// The local model; `None` if the tool has let go.
    pub(super) model: Option<LocalModel>,
    /// Place of the second tool, m, and its velocity, m/s, if the sample tells of it.
    pub(super) second: Option<[DVec3; 2]>,
}

/// The server's tissue behind a network.
pub(super) struct LinkServer {
    tissue: LinkTissue,
    spot: Spot,
    sampler: Sampler,
    laws: Arc<Laws>,
    /// Deadband and interval of the samples that the client requested.
    wanted: Arc<WantedHeartbeat>,
    /// The laws of the tissue; the disc whose law is in use; and the laws of the next tissue with the time when they
    /// are sent, s.
    place_laws: Arc<PlaceLaws>,
    disc: Disc,
    next_laws: Option<(f64, Arc<PlaceLaws>)>,
    /// Whether another law must be sent on the stream, and the number of the newest.
    is_other: bool,
    number: u32,
    transport: Transport,
    /// Whether places contain velocities.
    is_moving: bool,
    /// Numbers of the commands that were received: a datagram repeats what is not acknowledged.
    seen: ReceiveWindow,
    /// Arrivals of messages.
    pulse: SendInterval,
    refused: u64,
}

impl LinkServer {
    /// # Errors
    /// Returns why the intake refuses the tools.
    pub(super) fn new(setup: &Setup) -> Result<Self, String> {
        let mut tissue = LinkTissue::new(setup)?;
        let tells_of_others = setup.second_hand == SecondLeader::Another;
        if setup.second_hand == SecondLeader::Own {
            tissue.second = None;
        }
        let laws = Arc::new(Laws::new(setup.law.clone()));
        let wanted = Arc::new(WantedHeartbeat::default());
        let rendered = Deadband { rendered_fraction: Some(setup.deadband), ..Deadband::default() };
        let sampling = Sampling {
            every: 1,
            only: Some(vec![TOOL]),
            deadband: (setup.deadband > 0.0).then_some(rendered),
            heartbeat_s: HEARTBEAT_S,
            laws: Some(laws.clone()),
            touch_stiffness: false,
            other_tools: tells_of_others,
            wanted: Some(wanted.clone()),
        };
        Ok(LinkServer {
            tissue,
            spot: setup.spot,
            sampler: Sampler::new(sampling, TICK_S.recip()),
            laws,
            wanted,
            place_laws: setup.laws.clone(),
            disc: setup.disc,
            next_laws: setup.change.as_ref().map(|change| (change.at_s + LAW_S, change.laws.clone())),
            is_other: false,
            number: FIRST,
            transport: setup.conditions.transport,
            is_moving: setup.up_deadband > 0.0,
            seen: ReceiveWindow::default(),
            pulse: SendInterval::default(),
            refused: 0,
        })
    }

    /// Receives a message that has arrived.
    pub(super) fn receive(&mut self, message: &Up, now_s: f64) {
        self.pulse.arrive(message.number, message.sent_s, now_s);
        self.wanted.set(message.heartbeat_s);
        let (mut commands, mut seconds) = (Vec::new(), Vec::new());
        for (number, told) in &message.told {
            if self.seen.take(*number) {
                let (tool, second) = told;
                commands.push(self.command(TOOL, *number, tool));
                seconds.extend(second.iter().map(|second| self.command(SECOND_TOOL, *number, second)));
            }
        }
        for (lease, commands) in [(LEASE, commands), (SECOND_LEASE, seconds)] {
            // As on a server, a refused command has no effect and is counted.
            self.refused += u64::from(!commands.is_empty() && self.tissue.submit(lease, commands, now_s).is_err());
        }
    }

    fn command(&self, tool: u32, number: u64, told: &MotionState) -> Command {
        let mut command = self.tissue.pose(told.place_m);
        if let Action::Pose { velocity_m_per_s, .. } = &mut command.action {
            *velocity_m_per_s = self.is_moving.then(|| self.spot.direction_of_tissue(told.velocity_m_per_s));
        }
        // The time 0 means none.
        let client_time_ns = ns(told.time_s).max(1);
        let by_datagram = self.transport == Transport::Datagram;
        Command { tool, sequence: Some(number), client_time_ns, by_datagram, ..command }
    }

    /// Does the step that begins at `now_s`. Returns the sample to send, if any.
    ///
    /// # Errors
    /// Returns the reason if the guard stops the tissue.
    pub(super) fn step(&mut self, now_s: f64) -> Result<Option<Told>, String> {
        self.tissue.step(now_s)?;
        let Some(sample) = self.sampler.pick(self.tissue.session(), false) else { return Ok(None) };
        let tool = sample.tools.first();
        if let Some(rest_m) = tool.and_then(|tool| self.disc.pressed_m(tool.feel.as_ref()?)) {
            self.follow(rest_m);
        }
        let model = tool.and_then(|tool| tool.local).map(|model| self.spot.of_hand(model));
        let second = sample.other_tools.first().map(|other| {
            [self.spot.of_hand_m(other.motion.place_m), self.spot.direction(other.motion.velocity_m_per_s)]
        });
        Ok(Some(Told { model, second }))
    }

    /// Changes the law to that of the tissue under the tool, if it presses at another place.
    fn follow(&mut self, rest_m: DVec3) {
        let disc = self.disc.follow(&self.place_laws.model, rest_m);
        self.is_other |= disc != self.disc;
        self.disc = disc;
    }

    /// Returns another law, if one must be sent on the stream; local models name it from now on.
    pub(super) fn take_law(&mut self, now_s: f64) -> Option<Other> {
        let mut changed = None;
        if let Some((_, laws)) = self.next_laws.take_if(|next| next.0 <= now_s) {
            changed = Some(laws.model.clone());
            (self.place_laws, self.is_other) = (laws, true);
        }
        let law = std::mem::take(&mut self.is_other).then(|| self.place_laws.law(self.disc)).flatten()?;
        self.number += 1;
        self.laws.change(self.number, law.clone());
        Some(Other { number: self.number, law, changed })
    }

    /// Returns the longest interval at which the server needs messages from the client, s.
    pub(super) fn heartbeat_s(&self, now_s: f64) -> f64 {
        self.pulse.heartbeat_s(now_s)
    }

    /// Returns the counts of the tool's path; a refused message counts as dropped.
    pub(super) fn path_counts(&self) -> [u64; 3] {
        let [limited, dropped, released] = self.tissue.session().path_counts();
        [limited, dropped + self.refused, released]
    }
}
