//! One run in virtual time, tick by tick: hand, device, network, tissue, and the tissue's twin without a network.

use glam::DVec3;
use palpate_haptics::envelope::Envelope;
use palpate_haptics::hand::HandState;
use palpate_haptics::prediction::midway_s;
use palpate_haptics::{MotionState, RenderingState};
use palpate_proto::touch::sample_bytes;
use palpate_simulated::network::{Conditions, Direction, Outages, Stalls, Transport};
use palpate_simulated::random::Random;
use palpate_simulated::task::{self, Task};

use super::client::LinkClient;
use super::direct::Direct;
use super::measure::{LinkOutcome, LinkTick, Totals};
use super::poses::{Down, Poses, Up};
use super::server::{LinkServer, Other, Told};
use super::setup::{SecondLeader, Setup, TICK_S, ticks};
use super::tissue::{LinkTissue, Second};

/// Distance of the tool, in amplitudes of the task, beyond which a run is also unstable.
const UNSTABLE_AMPLITUDES: f64 = 3.0;

/// Time after the beginning of a pause at which the simulated operator enables rendering again, s.
const PAUSE_S: f64 = 0.3;

/// Size of a message without a local model, bytes.
const EMPTY_BYTES: u64 = 120;

/// The two directions between client and server. Both have their outages at the same time.
struct LinkNetwork {
    up: Direction<Up>,
    down: Direction<Down>,
    /// A law must not be lost, so it is always sent by stream.
    laws: Direction<Other>,
}

impl LinkNetwork {
    fn new(conditions: Conditions, seed: u64) -> Self {
        let stream = Conditions { transport: Transport::Stream, rate_bit_per_s: 0.0, ..conditions };
        LinkNetwork {
            up: Direction::new(conditions, seed, 1, task::LEAD_S),
            down: Direction::new(conditions, seed, 2, task::LEAD_S),
            laws: Direction::new(stream, seed, 8, task::LEAD_S),
        }
    }
}

/// Performs a run.
///
/// # Errors
/// Returns the reason if the guard stops the tissue.
pub(super) fn run(setup: &Setup) -> Result<LinkOutcome, String> {
    let direct = Direct::new(setup, task::LEAD_S)?;
    let Setup { spot, hand, conditions, duration_s, seed, .. } = setup;
    let task = Task::new(spot.at_m, task::LEAD_S, *duration_s, direct.scale, &mut Random::new(*seed, 0));
    let (mut server, mut twin) = (LinkServer::new(setup)?, LinkTissue::new(setup)?);
    let mut network = LinkNetwork::new(*conditions, *seed);
    let mut poses = Poses::new(conditions.transport, setup.up_deadband);
    let mut client = LinkClient::new(setup);
    let mut held = HandState { place_m: task.start_m(), velocity_m_per_s: DVec3::ZERO };
    let mut totals = Totals::with(Outages::new(conditions, *seed, task::LEAD_S));
    totals.outcome.scale = direct.scale;
    let own = Second::of(setup).filter(|_| setup.second_hand == SecondLeader::Own);
    let mut paused_s: Option<f64> = None;
    let mut stalls = Stalls::new(setup.stall_s, task::LEAD_S, Random::new(*seed, 4));
    let (mut force_n, mut bytes) = (DVec3::ZERO, 0);
    for tick in 0..ticks(*duration_s) {
        let now_s = f64::from(tick) * TICK_S;
        let place_m = held.place_m;
        totals.moved(place_m, twin.supplied_j());
        if totals.is_unstable() || (place_m - task.start_m()).length() > UNSTABLE_AMPLITUDES * task.amplitude_m {
            totals.outcome.unstable_at_s = Some(now_s);
            break;
        }
        let is_stalled = stalls.at(now_s).is_some();
        let second_m = own.as_ref().map(|own| own.place_m(spot, now_s));
        if !is_stalled {
            poses.tell(now_s, place_m, second_m, &client, &mut network.up);
        }
        bytes += serve(&mut server, &mut network, now_s)?;
        // While the client is stalled, the device holds the last force, and messages wait.
        if !is_stalled {
            while let Some(Other { number, law, changed }) = network.laws.receive(now_s) {
                client.learn(number, &law);
                changed.iter().for_each(|model| client.copy(setup, model));
            }
            while let Some(message) = network.down.receive(now_s) {
                poses.answered(&message, now_s);
                if let (Some(model), Some([place_m, velocity_m_per_s])) = (&message.model, message.second) {
                    let time_s = midway_s(model.client_time_s, now_s);
                    client.follow(setup.tip, MotionState { time_s, place_m, velocity_m_per_s });
                }
                if let Some(model) = message.model {
                    client.receive(model, now_s);
                }
            }
            if let Some(place_m) = second_m {
                client.follow(setup.tip, MotionState { time_s: now_s, place_m, velocity_m_per_s: DVec3::ZERO });
            }
            force_n = client.tick(now_s, place_m);
        }
        let (true_n, touches) = twin.truth(place_m, now_s)?;
        let age_s = client.model_time_s().map(|time_s| now_s - time_s);
        let (depth_m, direct_m) = (spot.depth_m(place_m), direct.depth_m(tick));
        totals.rendered(
            &LinkTick { now_s, depth_m, direct_m, force_n, true_n, touches, age_s },
            client.envelope().map(|envelope| &*envelope),
        );
        if let Some(envelope) = client.envelope().filter(|_| !is_stalled)
            && let Some(state) = operate(envelope, now_s, &mut paused_s)
        {
            totals.outcome.pauses += 1;
            totals.outcome.faults += u64::from(state == RenderingState::Fault);
        }
        let (from_m, to_m) = (task.at(now_s), task.at(now_s + TICK_S));
        let string_n = hand.string_n(from_m, place_m);
        held = hand.advance(held, from_m, to_m, force_n + string_n, TICK_S);
    }
    if let Some(envelope) = client.envelope() {
        totals.limited(envelope);
    }
    totals.outcome.predicted_ticks = client.predicted();
    let mut outcome = totals.close();
    let lasted_s = outcome.unstable_at_s.unwrap_or(*duration_s).max(TICK_S);
    let LinkNetwork { up, down, .. } = network;
    outcome.packets_per_s = down.sent() as f64 / lasted_s;
    outcome.kbit_per_s = bytes as f64 * 8e-3 / lasted_s;
    outcome.commands_per_s = up.sent() as f64 / lasted_s;
    outcome.overflowed = up.overflowed() + down.overflowed();
    outcome.path = server.path_counts();
    Ok(outcome)
}

/// Does the server's part of a tick: receives messages, does a step, and sends samples. Returns the bytes of the
/// samples.
fn serve(server: &mut LinkServer, network: &mut LinkNetwork, now_s: f64) -> Result<u64, String> {
    while let Some(message) = network.up.receive(now_s) {
        server.receive(&message, now_s);
    }
    if let Some(law) = server.take_law(now_s) {
        network.laws.send(now_s, 0, law);
    }
    let Some(Told { model, second }) = server.step(now_s)? else { return Ok(0) };
    let bytes = model.as_ref().map_or(EMPTY_BYTES, sample_bytes);
    let (number, heartbeat_s) = (network.down.sent() + 1, server.heartbeat_s(now_s));
    network.down.send(now_s, bytes, Down { number, sent_s: now_s, model, second, heartbeat_s });
    Ok(bytes)
}

/// Enables rendering again, as the simulated operator, [`PAUSE_S`] after it has paused. Returns the state in which it has paused in
/// this tick, if it has.
pub(super) fn operate(envelope: &mut Envelope, now_s: f64, paused_s: &mut Option<f64>) -> Option<RenderingState> {
    match (envelope.state(), *paused_s) {
        (RenderingState::Enabled, _) => *paused_s = None,
        (state, None) => {
            *paused_s = Some(now_s);
            return Some(state);
        }
        (_, Some(since_s)) if now_s - since_s > PAUSE_S => {
            envelope.reset();
            envelope.enable();
        }
        _ => {}
    }
    None
}
