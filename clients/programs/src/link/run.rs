//! One run in virtual time, tick by tick: hand, device, network, tissue, and the tissue's twin without a network.

use std::collections::VecDeque;
use std::sync::Arc;

use glam::DVec3;
use palpate::force_law::Disc;
use palpate::sheet::Model;
use palpate_proto::touch::sample_bytes;
use palpate_touch::carrier::Carried;
use palpate_touch::deadband::{ForceDeadband, HEARTBEAT_S};
use palpate_touch::envelope::{Envelope, Wanted};
use palpate_touch::hand::{Hand, HandState};
use palpate_touch::path::Path;
use palpate_touch::{Device, Law, LimitCause, LocalModel, News, Pulse, Renderer, RenderingState, Tip, Told};

use super::tissue::{PlaceLaws, Server, Spot, Tissue, Twin};
use crate::simulated::network::{Conditions, Direction, Stalls, Transport};
use crate::simulated::random::Random;
use crate::simulated::task::{self, Task};

/// How the client renders samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum Rendering {
    /// The newest force, unchanged: no model, no safety envelope
    Raw,
    /// The newest force, held until the next, within the safety envelope
    Hold,
    /// The local model, evaluated along the tool's path, within the safety envelope
    Model,
}

/// The setup of a run.
#[derive(Debug, Clone)]
pub(super) struct Setup {
    pub(super) model: Arc<Model>,
    /// The law to begin with, and where it is of.
    pub(super) law: Arc<Law>,
    pub(super) disc: Disc,
    pub(super) tip: Tip,
    /// Where the task is done.
    pub(super) spot: Spot,
    pub(super) hand: Hand,
    pub(super) device: Device,
    pub(super) conditions: Conditions,
    /// Once a second the client stalls for this long, s.
    pub(super) stall_s: f64,
    pub(super) scheme: Rendering,
    pub(super) deadband: f64,
    /// The client sends its place only if the server would be wrong about it by more than this part of the force; 0: always.
    pub(super) up_deadband: f64,
    pub(super) duration_s: f64,
    pub(super) seed: u64,
}

/// Period of the device's loop, s.
pub(super) const TICK_S: f64 = 1e-3;

/// A run is unstable if the energy that the port has received falls below this, J, or if the tool moves away farther than
/// this many times the task's amplitude.
const UNSTABLE_J: f64 = -0.1;
const UNSTABLE_AMPLITUDES: f64 = 3.0;

/// A smaller rendered force counts as none, N.
const LEAST_FORCE_N: f64 = 1e-6;

/// The simulated operator enables rendering this long after a pause began, s.
const PAUSE_S: f64 = 0.3;

/// The outcome of a run.
#[derive(Debug, Clone, Default)]
pub(super) struct Outcome {
    /// Scale of the task's depths.
    pub(super) scale: f64,
    pub(super) force_error_rms_percent: Option<f64>,
    pub(super) force_error_p99_n: f64,
    pub(super) energy_min_j: f64,
    pub(super) jump_max_n: f64,
    pub(super) guard_share: f64,
    pub(super) rendered_share: Option<f64>,
    pub(super) packets_per_s: f64,
    pub(super) kbit_per_s: f64,
    pub(super) commands_per_s: f64,
    pub(super) model_age_ms_p99: Option<f64>,
    pub(super) peak_ratio: Option<f64>,
    pub(super) true_force_max_n: f64,
    pub(super) force_max_n: f64,
    pub(super) unstable_at_s: Option<f64>,
    pub(super) pauses: u64,
    pub(super) faults: u64,
    pub(super) interventions: Vec<(&'static str, u64)>,
    pub(super) path: [u64; 3],
    /// Only for a run in real time.
    pub(super) late_ticks: Option<u64>,
    /// What went by datagram in a run in real time.
    pub(super) carried: Option<Carried>,
    /// For each tick: time, s, the tool's depth below the rest plane, m, rendered and true force, N.
    pub(super) course: Vec<[f64; 4]>,
}

/// The client at the device, by scheme.
enum Client {
    Raw(Option<LocalModel>),
    Hold(Option<LocalModel>, Option<f64>, Option<DVec3>, Box<Envelope>),
    Model(Box<Renderer>),
}

impl Client {
    fn receive(&mut self, model: LocalModel, now_s: f64) {
        match self {
            Client::Raw(newest) => *newest = Some(model),
            Client::Hold(newest, arrived_s, ..) => (*newest, *arrived_s) = (Some(model), Some(now_s)),
            Client::Model(renderer) => renderer.receive(model, now_s),
        }
    }

    /// A law comes before the first model that names it.
    fn learn(&mut self, number: u32, law: &Law) {
        if let Client::Model(renderer) = self {
            renderer.learn(number, law.clone());
        }
    }

    fn tick(&mut self, now_s: f64, place_m: DVec3) -> DVec3 {
        match self {
            Client::Raw(newest) => newest.map_or(DVec3::ZERO, |model| model.force_n),
            Client::Hold(newest, arrived_s, before, envelope) => {
                let moved_m = before.replace(place_m).map_or(DVec3::ZERO, |before_m| place_m - before_m);
                envelope.render(&Wanted {
                    now_s,
                    place_m,
                    velocity_m_per_s: moved_m / TICK_S,
                    force_n: newest.map_or(DVec3::ZERO, |model| model.force_n),
                    age_s: arrived_s.map_or(0.0, |arrived_s| now_s - arrived_s),
                })
            }
            Client::Model(renderer) => renderer.tick(now_s, place_m),
        }
    }

    fn envelope(&mut self) -> Option<&mut Envelope> {
        match self {
            Client::Raw(_) => None,
            Client::Hold(.., envelope) => Some(envelope),
            Client::Model(renderer) => Some(&mut renderer.envelope),
        }
    }

    fn model_time_s(&self) -> Option<f64> {
        match self {
            Client::Raw(newest) | Client::Hold(newest, ..) => newest.map(|model| model.client_time_s),
            Client::Model(renderer) => renderer.model_time_s(),
        }
    }
}

/// A message to the server.
struct Up {
    number: u64,
    sent_s: f64,
    told: Vec<Told>,
    /// How often the client wants a sample at least, s.
    heartbeat_s: f64,
}

/// A message to the client.
struct Down {
    number: u64,
    sent_s: f64,
    model: LocalModel,
    /// How often the server wants a place at least, s.
    heartbeat_s: f64,
}

/// The tool's places on their way to the server.
struct Poses {
    transport: Transport,
    /// Part of the force; 0: each place is told.
    deadband: f64,
    news: News,
    /// What the server may not have yet, the newest last.
    unanswered: VecDeque<Told>,
    /// Of the samples.
    pulse: Pulse,
    heartbeat_s: f64,
}

/// Places in a datagram.
const PLACES: usize = 8;

impl Poses {
    fn new(transport: Transport, deadband: f64) -> Self {
        Poses {
            transport,
            deadband,
            news: News::default(),
            unanswered: VecDeque::new(),
            pulse: Pulse::default(),
            heartbeat_s: HEARTBEAT_S,
        }
    }

    /// Tells a place, if it is news.
    fn tell(&mut self, now_s: f64, place_m: DVec3, client: &Client, up: &mut Direction<Up>) {
        let told = if self.deadband > 0.0 {
            let most_m = match client {
                Client::Model(renderer) => renderer.way_m(self.deadband),
                Client::Raw(_) | Client::Hold(..) => 0.0,
            };
            self.news.tell(now_s, place_m, most_m, self.heartbeat_s)
        } else {
            Some(Told { time_s: now_s, place_m, velocity_m_per_s: DVec3::ZERO })
        };
        let Some(told) = told else { return };
        self.unanswered.push_back(told);
        if self.unanswered.len() > if self.transport == Transport::Stream { 1 } else { PLACES } {
            self.unanswered.pop_front();
        }
        let told = self.unanswered.iter().copied().collect();
        let heartbeat_s = self.pulse.heartbeat_s(now_s);
        up.send(now_s, Up { number: up.sent() + 1, sent_s: now_s, told, heartbeat_s });
    }

    /// A sample tells what has arrived, and how often the server wants to hear.
    fn answered(&mut self, message: &Down, now_s: f64) {
        self.unanswered.retain(|told| told.time_s > message.model.client_time_s);
        self.pulse.arrive(message.number, message.sent_s, now_s);
        self.heartbeat_s = message.heartbeat_s;
    }

    fn arrive(&self, told: &[Told], path: &mut Path, now_s: f64) {
        for Told { time_s, place_m, velocity_m_per_s } in told.iter().copied() {
            let is_newer = path.newest_s().is_none_or(|newest_s| time_s > newest_s);
            match is_newer {
                true if self.deadband > 0.0 => _ = path.receive_moving(time_s, place_m, velocity_m_per_s, now_s),
                true => _ = path.receive(time_s, place_m, now_s),
                // A stream has them in order: what is older than the newest is refused there.
                false if self.transport == Transport::Stream => _ = path.receive(time_s, place_m, now_s),
                false => _ = path.fill(time_s, place_m),
            }
        }
    }
}

/// The scale of the task's depths: reduced until a hand that feels the tissue directly, without network and client, meets no
/// more than [`task::FORCE_SHARE`] of the device's force. So it does not depend on how the client renders samples.
///
/// # Errors
/// Returns the reason if the guard stops the tissue.
pub(super) fn fitting_scale(setup: &Setup, lead_s: f64) -> Result<f64, String> {
    let Setup { model, law, tip, spot, hand, device, duration_s, seed, .. } = setup;
    let most_n = task::FORCE_SHARE * device.most_n();
    let middle_m = spot.at_m;
    let mut scale = task::scale(hand, law, device.most_n());
    loop {
        let task = Task::new(middle_m, lead_s, *duration_s, scale, &mut Random::new(*seed, 0));
        let mut twin = Twin::new(Tissue::new(model, *tip, *spot, law.clone()));
        let mut held = HandState { place_m: task.start_m(), velocity_m_per_s: DVec3::ZERO };
        let mut largest_n = 0.0_f64;
        for tick in 0..ticks(*duration_s) {
            let now_s = f64::from(tick) * TICK_S;
            let (true_n, _) = twin.truth(held.place_m)?;
            largest_n = largest_n.max(true_n.length());
            if largest_n > most_n {
                break;
            }
            let (from_m, to_m) = (task.at(now_s), task.at(now_s + TICK_S));
            let string_n = hand.string_n(from_m, held.place_m);
            held = hand.advance(held, from_m, to_m, true_n + string_n, TICK_S);
        }
        if largest_n <= most_n || scale < LEAST_SCALE {
            return Ok(scale);
        }
        scale *= 0.9;
    }
}

/// Least scale: a smaller task would hardly touch the tissue.
const LEAST_SCALE: f64 = 0.01;

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn ticks(duration_s: f64) -> u32 {
    (duration_s / TICK_S).round() as u32
}

/// Performs a run.
///
/// # Errors
/// Returns the reason if the guard stops the tissue.
pub(super) fn run(setup: &Setup) -> Result<Outcome, String> {
    let scale = fitting_scale(setup, task::LEAD_S)?;
    let Setup {
        model,
        law,
        disc,
        tip,
        spot,
        hand,
        device,
        conditions,
        stall_s,
        scheme,
        deadband,
        up_deadband,
        duration_s,
        seed,
    } = setup;
    let middle_m = spot.at_m;
    let task = Task::new(middle_m, task::LEAD_S, *duration_s, scale, &mut Random::new(*seed, 0));
    let tissue = || Tissue::new(model, *tip, *spot, law.clone());
    let laws = PlaceLaws::new(*disc, law.clone());
    let (mut server, mut twin) = (Server::new(tissue(), laws), Twin::new(tissue()));
    let mut up: Direction<Up> = Direction::new(*conditions, *seed, 1, task::LEAD_S);
    let mut down: Direction<Down> = Direction::new(*conditions, *seed, 2, task::LEAD_S);
    let (mut at_server, mut down_heartbeat_s) = (Pulse::default(), HEARTBEAT_S);
    let mut poses = Poses::new(conditions.transport, *up_deadband);
    let (mut deadband, mut sent_s) = (ForceDeadband::new(*deadband), f64::NEG_INFINITY);
    let envelope = || {
        let mut envelope = Envelope::new(*device, middle_m);
        envelope.enable();
        envelope
    };
    let mut client = match scheme {
        Rendering::Raw => Client::Raw(None),
        Rendering::Hold => Client::Hold(None, None, None, Box::new(envelope())),
        Rendering::Model => Client::Model(Box::new(Renderer::new((**law).clone(), envelope()))),
    };
    let mut held = HandState { place_m: task.start_m(), velocity_m_per_s: DVec3::ZERO };
    let mut totals = Totals::default();
    totals.outcome.scale = scale;
    let mut paused_s: Option<f64> = None;
    let mut stalls = Stalls::new(*stall_s, task::LEAD_S, Random::new(*seed, 4));
    let mut force_n = DVec3::ZERO;
    for tick in 0..ticks(*duration_s) {
        let now_s = f64::from(tick) * TICK_S;
        let place_m = held.place_m;
        totals.moved(place_m);
        if totals.energy_j < UNSTABLE_J || (place_m - task.start_m()).length() > UNSTABLE_AMPLITUDES * task.amplitude_m
        {
            totals.outcome.unstable_at_s = Some(now_s);
            break;
        }
        let is_stalled = stalls.at(now_s).is_some();
        if !is_stalled {
            poses.tell(now_s, place_m, &client, &mut up);
        }
        while let Some(message) = up.receive(now_s) {
            poses.arrive(&message.told, &mut server.path, now_s);
            at_server.arrive(message.number, message.sent_s, now_s);
            down_heartbeat_s = message.heartbeat_s;
        }
        if let Some(model) = server.step(now_s, TICK_S)?
            && (deadband.is_exceeded(&model, server.laws.law(model.law)) || now_s - sent_s >= down_heartbeat_s - 1e-9)
        {
            deadband.send(&model, server.laws.law(model.law));
            sent_s = now_s;
            totals.bytes += sample_bytes(&model);
            let heartbeat_s = at_server.heartbeat_s(now_s);
            down.send(now_s, Down { number: down.sent() + 1, sent_s: now_s, model, heartbeat_s });
        }
        // While the client is stalled, the device holds the last force, and samples wait.
        while !is_stalled && let Some(message) = down.receive(now_s) {
            poses.answered(&message, now_s);
            client.learn(message.model.law, server.laws.law(message.model.law));
            client.receive(message.model, now_s);
        }
        if !is_stalled {
            force_n = client.tick(now_s, place_m);
        }
        let (true_n, touches) = twin.truth(place_m)?;
        let age_s = client.model_time_s().map(|time_s| now_s - time_s);
        totals.rendered(now_s, force_n, true_n, touches, age_s);
        if let Some(envelope) = client.envelope().filter(|_| !is_stalled) {
            operate(envelope, now_s, &mut paused_s, &mut totals.outcome);
        }
        let (from_m, to_m) = (task.at(now_s), task.at(now_s + TICK_S));
        let string_n = hand.string_n(from_m, place_m);
        held = hand.advance(held, from_m, to_m, force_n + string_n, TICK_S);
    }
    let lasted_s = totals.outcome.unstable_at_s.unwrap_or(*duration_s).max(TICK_S);
    let bytes = totals.bytes;
    let mut outcome = totals.close();
    outcome.packets_per_s = down.sent() as f64 / lasted_s;
    outcome.kbit_per_s = bytes as f64 * 8e-3 / lasted_s;
    outcome.commands_per_s = up.sent() as f64 / lasted_s;
    outcome.path = server.path.counts();
    if let Some(envelope) = client.envelope() {
        let (acted, ticks) = envelope.count(LimitCause::Passivity);
        outcome.guard_share = acted as f64 / ticks.max(1) as f64;
        outcome.interventions =
            LimitCause::ALL.iter().map(|(reason, name)| (*name, envelope.count(*reason).0)).collect();
    }
    Ok(outcome)
}

/// The simulated operator notices that rendering has paused, and enables it again after [`PAUSE_S`].
fn operate(envelope: &mut Envelope, now_s: f64, paused_s: &mut Option<f64>, outcome: &mut Outcome) {
    match (envelope.state(), *paused_s) {
        (RenderingState::Enabled, _) => *paused_s = None,
        (_, None) => {
            *paused_s = Some(now_s);
            outcome.pauses += 1;
            if envelope.state() == RenderingState::Fault {
                outcome.faults += 1;
            }
        }
        (_, Some(since_s)) if now_s - since_s > PAUSE_S => {
            envelope.reset();
            envelope.enable();
        }
        _ => {}
    }
}

/// Accumulates the outcome of a run.
#[derive(Default)]
pub(super) struct Totals {
    outcome: Outcome,
    energy_j: f64,
    before: Option<DVec3>,
    force_n: DVec3,
    /// Sums over the ticks in which the twin touches or a force is rendered.
    error_squared: f64,
    true_squared: f64,
    rendered_sum: f64,
    true_sum: f64,
    bytes: u64,
    errors_n: Vec<f64>,
    pub(super) ages_s: Vec<f64>,
}

impl Totals {
    /// Counts the tool's movement to `place_m` under the force of the last tick.
    pub(super) fn moved(&mut self, place_m: DVec3) {
        if let Some(before_m) = self.before.replace(place_m) {
            self.energy_j -= self.force_n.dot(place_m - before_m);
            self.outcome.energy_min_j = self.outcome.energy_min_j.min(self.energy_j);
        }
    }

    /// Counts a tick's rendered force against the true one; `age_s` is the age of the sample that it is from.
    pub(super) fn rendered(&mut self, now_s: f64, force_n: DVec3, true_n: DVec3, touches: bool, age_s: Option<f64>) {
        let outcome = &mut self.outcome;
        outcome.jump_max_n = outcome.jump_max_n.max((force_n - self.force_n).length());
        self.force_n = force_n;
        let (rendered, truth) = (force_n.length(), true_n.length());
        outcome.force_max_n = outcome.force_max_n.max(rendered);
        outcome.true_force_max_n = outcome.true_force_max_n.max(truth);
        if touches || rendered > LEAST_FORCE_N {
            let error_n = (force_n - true_n).length();
            self.error_squared += error_n * error_n;
            self.true_squared += truth * truth;
            self.rendered_sum += rendered;
            self.true_sum += truth;
            self.errors_n.push(error_n);
        }
        self.ages_s.extend(age_s);
        let depth_m = -self.before.map_or(0.0, |place_m| place_m.z);
        outcome.course.push([now_s, depth_m, rendered, truth]);
    }

    /// Computes the outcome from the sums.
    pub(super) fn close(mut self) -> Outcome {
        let part = |of: f64, whole: f64| (whole > 0.0).then(|| of / whole);
        self.outcome.force_error_rms_percent = part(self.error_squared, self.true_squared).map(|p| 100.0 * p.sqrt());
        self.outcome.rendered_share = part(self.rendered_sum, self.true_sum);
        self.outcome.peak_ratio = part(self.outcome.force_max_n, self.outcome.true_force_max_n);
        self.outcome.force_error_p99_n = percentile(&mut self.errors_n, 0.99).unwrap_or(0.0);
        self.outcome.model_age_ms_p99 = percentile(&mut self.ages_s, 0.99).map(|age_s| 1e3 * age_s);
        self.outcome
    }
}

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn percentile(values: &mut [f64], part: f64) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let place = (part * values.len() as f64).ceil() as usize;
    values.get(place.saturating_sub(1)).copied()
}
