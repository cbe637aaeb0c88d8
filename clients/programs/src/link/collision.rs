//! `link --collision`: two hands push their instruments together, above the tissue.
//!
//! Each hand leads a shaft that points along x of the hands' frame, or across; both move along z, each at half of [`CLOSING_M_PER_S`],
//! until their targets lie [`BEYOND_M`] beyond each other, wait, and go back. Then they do it again.

use std::f64::consts::FRAC_PI_2;

use glam::{DQuat, DVec3};
use palpate_haptics::envelope::Envelope;
use palpate_haptics::prediction::midway_s;
use palpate_haptics::{
    Instrument, InstrumentPart, InstrumentPose, InstrumentRenderer, OtherInstrument, Prediction, SecondHand, Tip,
    TipShape, WrenchSample,
};
use palpate_session::led_instrument::InstrumentSample;
use palpate_session::tissue_copy::TissueCopy;
use palpate_simulated::network::{Direction, Transport};
use serde_json::json;

use super::instrument::{POSE_BYTES, SAMPLE_BYTES, TurningHand, in_tissue, of_hand};
use super::led_tissue::{LedTissue, tips};
use super::run::operate;
use super::setup::{self, Setup, TICK_S, ticks};
use super::tissue::ns;
use super::{LinkArguments, with_tissue};
use crate::ClientFailure;
use crate::table;

/// How two shafts meet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum Collision {
    /// The middle of one across the middle of the other
    Crossed,
    /// The tip of one on the middle of the other
    Tip,
}

/// Length of a shaft, m.
const SHAFT_M: f64 = 0.06;
/// Height of the place of the collision above the tissue, m.
const HEIGHT_M: f64 = 0.08;
/// Speed at which the targets approach each other, m/s, and how far they go beyond the place where the shafts touch, m.
const CLOSING_M_PER_S: f64 = 0.1;
const BEYOND_M: f64 = 0.016;
/// Way of each target to where they touch, m.
const WAY_M: f64 = 0.01;
/// Time until the first push, and of one push with the wait before and after it, s. Rendering begins within the first.
const LEAD_S: f64 = 1.2;
const PERIOD_S: f64 = 2.0;

/// Returns how far a target is on its way at a time, m.
fn way_m(now_s: f64) -> f64 {
    let in_push_s = (now_s - LEAD_S).max(0.0) % PERIOD_S;
    let most_m = WAY_M + 0.5 * BEYOND_M;
    (0.5 * CLOSING_M_PER_S * in_push_s.min(PERIOD_S - in_push_s - 0.4)).clamp(0.0, most_m)
}

/// Returns the poses of both instruments where they just touch, in the hands' frame; the second comes from above.
fn touching(collision: Collision, middle_m: DVec3, radius_m: f64) -> [InstrumentPose; 2] {
    let half = 0.5 * SHAFT_M;
    let lower = InstrumentPose::at(middle_m + half * DVec3::X);
    let above_m = middle_m + 2.0 * radius_m * DVec3::Z;
    let (orientation, place_m) = match collision {
        Collision::Crossed => (DQuat::from_rotation_z(FRAC_PI_2), above_m + half * DVec3::Y),
        // It points along -z.
        Collision::Tip => (DQuat::from_rotation_y(FRAC_PI_2), above_m),
    };
    [lower, InstrumentPose { orientation, ..InstrumentPose::at(place_m) }]
}

/// A hand with its instrument, and the network to its server.
struct CollidingHand {
    hand: TurningHand,
    touching: InstrumentPose,
    /// The direction in which it pushes, along z.
    sign: f64,
    first_tool: u32,
    renderer: InstrumentRenderer,
    up: Direction<(u64, InstrumentPose, f64)>,
    down: Direction<(WrenchSample, Option<OtherInstrument>)>,
    /// The other client's instrument of the newest sample.
    other: Option<OtherInstrument>,
    paused_s: Option<f64>,
    deepest_m: f64,
    most_n: f64,
    energy_min_j: f64,
}

impl CollidingHand {
    fn new(setup: &Setup, which: u8, touching: InstrumentPose, instrument: &Instrument) -> Self {
        let (sign, number) = if which == 0 { (1.0, 0) } else { (-1.0, 1) };
        let mut envelope = Envelope::new(setup.device, setup.spot.of_tissue(touching.place_m));
        envelope.enable();
        let mut renderer = InstrumentRenderer::new(envelope, instrument.clone());
        let copy = TissueCopy::of_instrument(&setup.model, instrument.clone());
        renderer.predict(Some(Prediction::new(Box::new(copy))));
        let direction = |at: u64| (setup.conditions, setup.seed, 1 + 2 * u64::from(which) + at);
        let [(of_up, seed, up), (of_down, _, down)] = [direction(0), direction(1)];
        CollidingHand {
            hand: TurningHand::new(setup.hand, touching.place_m - sign * WAY_M * DVec3::Z),
            touching,
            sign,
            first_tool: number * tips(instrument),
            renderer,
            up: Direction::new(of_up, seed, up, LEAD_S),
            down: Direction::new(of_down, seed, down, LEAD_S),
            other: None,
            paused_s: None,
            deepest_m: 0.0,
            most_n: 0.0,
            energy_min_j: 0.0,
        }
    }

    /// Returns its pose, in the tissue's frame.
    fn pose(&self, setup: &Setup) -> InstrumentPose {
        in_tissue(&setup.spot, &self.hand.pose(self.touching.orientation, 0.0))
    }

    /// Does a tick with what is known of the other hand.
    fn tick(&mut self, setup: &Setup, now_s: f64, second: Option<SecondHand>) {
        while let Some((sample, other)) = self.down.receive(now_s) {
            self.other = other.map(|other| other.at_time(midway_s(sample.client_time_s, now_s)));
            self.renderer.receive(sample, now_s);
        }
        let others = if second.is_some() { &None } else { &self.other };
        self.renderer.follow_instruments(second, others.as_slice());
        let rendered = self.renderer.tick(now_s, &self.pose(setup));
        operate(&mut self.renderer.envelope, now_s, &mut self.paused_s);
        self.deepest_m = self.deepest_m.max(self.renderer.overlap_m());
        self.most_n = self.most_n.max(rendered.force_n.length());
        self.energy_min_j = self.energy_min_j.min(self.renderer.envelope.energy_j());
        let start_m = self.touching.place_m - self.sign * WAY_M * DVec3::Z;
        let targets_m = [now_s, now_s + TICK_S].map(|at_s| start_m + self.sign * way_m(at_s) * DVec3::Z);
        self.hand.advance(&of_hand(&setup.spot, &rendered), targets_m, [DVec3::ZERO; 2]);
    }
}

/// The outcome of a run.
#[derive(Debug, Clone, Default)]
struct CollisionOutcome {
    /// Sum of both radii, m.
    reach_m: f64,
    deepest_at_clients_m: f64,
    deepest_at_server_m: f64,
    force_max_n: f64,
    /// Least energy that each port had received, and both together, J.
    energy_min_j: f64,
    energy_together_min_j: f64,
}

fn run(setup: &Setup, collision: Collision) -> Result<CollisionOutcome, String> {
    let tip = Tip { shape: if setup.tip.shape.is_rigid() { TipShape::Sphere } else { setup.tip.shape }, ..setup.tip };
    let mut instrument = Instrument::default();
    instrument.add_row(DVec3::ZERO, -SHAFT_M * DVec3::X, tip, InstrumentPart::Body);
    let [lower, upper] = touching(collision, setup.spot.at_m + HEIGHT_M * DVec3::Z, tip.radius_m);
    let mut hands =
        [CollidingHand::new(setup, 0, lower, &instrument), CollidingHand::new(setup, 1, upper, &instrument)];
    let mut server = LedTissue::new(&setup.model, &instrument, 2)?;
    server.by_datagram = setup.conditions.transport == Transport::Datagram;
    let is_own = setup.second_hand == setup::SecondLeader::Own;
    let tells = setup.second_hand != setup::SecondLeader::Unknown;
    let mut outcome = CollisionOutcome { reach_m: 2.0 * tip.radius_m, ..CollisionOutcome::default() };
    for tick in 0..ticks(setup.duration_s) {
        let (now_s, number) = (f64::from(tick) * TICK_S, u64::from(tick) + 1);
        for (which, hand) in hands.iter_mut().enumerate() {
            let pose = hand.pose(setup);
            hand.up.send(now_s, POSE_BYTES, (number, pose, now_s));
            while let Some((number, pose, sent_s)) = hand.up.receive(now_s) {
                server.lead(which, number, &pose, ns(sent_s).max(1), now_s)?;
            }
        }
        let felt = server.step(now_s)?;
        let sequence = server.step_count();
        for (which, hand) in hands.iter_mut().enumerate() {
            let Some((felt_now, _)) = &felt[which] else { continue };
            let deepest_m = felt_now.contacts.iter().map(|(_, load)| load.depth_m).fold(0.0, f64::max);
            outcome.deepest_at_server_m = outcome.deepest_at_server_m.max(deepest_m);
            let InstrumentSample { client_time_s, pose, wrench, .. } = *felt_now;
            let other = felt[1 - which].as_ref().map(|(_, other)| *other).filter(|_| tells);
            let sample = WrenchSample { sequence, client_time_s, pose, wrench };
            hand.down.send(now_s, SAMPLE_BYTES, (sample, other));
        }
        let as_second = hands
            .each_ref()
            .map(|hand| is_own.then(|| hand.renderer.as_second_hand(hand.first_tool, &hand.pose(setup), now_s)));
        for (which, hand) in hands.iter_mut().enumerate() {
            hand.tick(setup, now_s, as_second[1 - which]);
        }
        let together_j: f64 = hands.iter().map(|hand| hand.renderer.envelope.energy_j()).sum();
        outcome.energy_together_min_j = outcome.energy_together_min_j.min(together_j);
    }
    for hand in &hands {
        outcome.deepest_at_clients_m = outcome.deepest_at_clients_m.max(hand.deepest_m);
        outcome.force_max_n = outcome.force_max_n.max(hand.most_n);
        outcome.energy_min_j = outcome.energy_min_j.min(hand.energy_min_j);
    }
    Ok(outcome)
}

/// Performs the run and prints the results.
///
/// # Errors
/// Returns an error if the run fails.
pub(super) fn print(arguments: &LinkArguments, setup: &Setup, collision: Collision) -> Result<(), ClientFailure> {
    let outcome = with_tissue(|| run(setup, collision))?;
    let CollisionOutcome { reach_m, deepest_at_clients_m, deepest_at_server_m, force_max_n, energy_min_j, .. } =
        outcome;
    let deepest_m = deepest_at_clients_m.max(deepest_at_server_m);
    if arguments.json {
        crate::tell!(
            "{}",
            json!({
                "hand": setup.hand.name,
                "device": setup.device.name,
                "second_hand": setup.second_hand.name(),
                "reach_m": reach_m,
                "deepest_at_clients_m": deepest_at_clients_m,
                "deepest_at_server_m": deepest_at_server_m,
                "has_passed": deepest_m > reach_m,
                "force_max_n": force_max_n,
                "energy_min_j": energy_min_j,
                "energy_together_min_j": outcome.energy_together_min_j,
            })
        );
        return Ok(());
    }
    let depth = |depth_m: f64| format!("{} mm of {} mm", table::rounded(1e3 * depth_m), table::rounded(1e3 * reach_m));
    table::print(&[
        ("hands, device", format!("{}, {}", setup.hand.name, setup.device.name)),
        ("deepest overlap at a client", depth(deepest_at_clients_m)),
        ("deepest overlap at the server", depth(deepest_at_server_m)),
        ("an axis passed another", if deepest_m > reach_m { "yes" } else { "no" }.to_owned()),
        ("largest force", table::with_unit(force_max_n, "N")),
        ("least energy received, each", table::with_unit(energy_min_j, "J")),
        ("least energy received, both", table::with_unit(outcome.energy_together_min_j, "J")),
    ]);
    Ok(())
}
