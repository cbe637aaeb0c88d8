//! `link --instrument`: a hand leads an instrument by a device of six axes, and feels force and torque from a copy of the tissue.
//!
//! Everything is in the tissue's frame, but for the hand, whose z points out of the tissue. The hand turns like it moves: as the mass,
//! damper and spring of [`Hand`] at a radius of [`GYRATION_M`] from the instrument's place.

use std::f64::consts::TAU;

use glam::{DQuat, DVec3};
use palpate_haptics::envelope::Envelope;
use palpate_haptics::hand::{Hand, HandState};
use palpate_haptics::{
    Instrument, InstrumentPose, InstrumentRenderer, InstrumentVelocity, Prediction, Tip, TipShape, Wrench, WrenchSample,
};
use palpate_session::led_instrument::InstrumentSample;
use palpate_session::tissue_copy::TissueCopy;
use palpate_simulated::network::{Direction, Transport};
use palpate_simulated::random::Random;
use palpate_simulated::task::{self, Task};

use super::led_tissue::LedTissue;
use super::run::operate;
use super::setup::{Setup, TICK_S, ticks};
use super::spot::Spot;
use super::tissue::ns;

/// The instrument that a hand leads.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum InstrumentKind {
    /// A shaft of 25 mm that lies on the tissue, tilted by 0.3 rad
    Shaft,
    /// A shaft of 10 mm and two jaws of 15 mm that point into the tissue, and open and close
    Grasper,
    /// A blade with an edge of 12 mm that points into the tissue, and cuts it
    Scalpel,
}

/// Length of a scalpel's edge, m.
const EDGE_M: f64 = 0.012;

/// Radius at which a turning hand has its mass, damper and spring, m.
const GYRATION_M: f64 = 0.03;

/// Largest turn of the hand's target about each axis, rad, and turns per second.
const TURN_RAD: f64 = 0.25;
const TURNS_HZ: [f64; 2] = [0.3, 1.0];

/// Angles of the jaws, rad, and how often they close per second.
const JAWS_RAD: [f64; 2] = [0.1, 0.9];
const JAWS_HZ: f64 = 0.7;

/// Turn of the hand beyond which a run is unstable, rad; distance, in amplitudes of the task; and energy, J.
const UNSTABLE_RAD: f64 = 2.0;
const UNSTABLE_AMPLITUDES: f64 = 3.0;
const UNSTABLE_J: f64 = -0.1;

/// Bytes of a message with a pose, and of one with a sample.
pub(super) const POSE_BYTES: u64 = 66 + 130;
pub(super) const SAMPLE_BYTES: u64 = 66 + 220;

impl InstrumentKind {
    fn instrument(self, tip: Tip) -> Instrument {
        let mut instrument = Instrument::default();
        let (jaws_m, shaft_m) = match self {
            InstrumentKind::Shaft => (None, 0.025),
            InstrumentKind::Grasper => (Some(0.015), 0.01),
            InstrumentKind::Scalpel => {
                let blade = Tip { shape: TipShape::Blade, edge_m: -EDGE_M * DVec3::X, ..Tip::default() };
                return Instrument::of_tip(blade);
            }
        };
        instrument.add_parts(jaws_m.map(|length_m| (length_m, tip)), Some((shaft_m, tip)));
        instrument
    }

    /// Returns the orientation of a hand that is not turned, in the hand's frame.
    fn orientation(self) -> DQuat {
        DQuat::from_rotation_y(match self {
            InstrumentKind::Shaft => 0.3,
            InstrumentKind::Grasper | InstrumentKind::Scalpel => 1.2,
        })
    }
}

/// How a hand wants the instrument to turn, and the jaws to open.
struct Turning {
    /// For each axis the frequency, Hz, and the phase, rad.
    axes: [(f64, f64); 3],
    has_jaws: bool,
}

impl Turning {
    fn new(kind: InstrumentKind, random: &mut Random) -> Self {
        let axes = std::array::from_fn(|_| (random.between(TURNS_HZ[0], TURNS_HZ[1]), random.between(0.0, TAU)));
        Turning { axes, has_jaws: kind == InstrumentKind::Grasper }
    }

    /// Returns the turn of the target, rad. It begins at 0.
    fn at(&self, now_s: f64) -> DVec3 {
        let grows = (now_s / task::LEAD_S).min(1.0);
        DVec3::from_array(self.axes.map(|(hz, phase)| TURN_RAD * grows * (TAU * hz * now_s + phase).sin()))
    }

    fn jaw_rad(&self, now_s: f64) -> f64 {
        let part = 0.5 + 0.5 * (TAU * JAWS_HZ * now_s).cos();
        if self.has_jaws { JAWS_RAD[0] + (JAWS_RAD[1] - JAWS_RAD[0]) * part } else { 0.0 }
    }
}

/// A hand that holds a device of six axes.
pub(super) struct TurningHand {
    hand: Hand,
    moved: HandState,
    /// The turn from the orientation at rest, rad.
    turned: HandState,
}

impl TurningHand {
    pub(super) fn new(hand: Hand, start_m: DVec3) -> Self {
        let moved = HandState { place_m: start_m, velocity_m_per_s: DVec3::ZERO };
        TurningHand { hand, moved, turned: HandState::default() }
    }

    /// Returns where an instrument is whose hand has an `orientation` at rest, in the hand's frame.
    pub(super) fn pose(&self, orientation: DQuat, jaw_rad: f64) -> InstrumentPose {
        let turn = InstrumentVelocity { angular_rad_per_s: self.turned.place_m, ..InstrumentVelocity::default() };
        let rest = InstrumentPose { orientation, ..InstrumentPose::at(self.moved.place_m) };
        InstrumentPose { jaw_rad, ..turn.after(&rest, 1.0) }
    }

    /// Goes on for a tick under a wrench, towards targets.
    pub(super) fn advance(&mut self, wrench: &Wrench, [from_m, to_m]: [DVec3; 2], [from_rad, to_rad]: [DVec3; 2]) {
        let string_n = self.hand.string_n(from_m, self.moved.place_m);
        self.moved = self.hand.advance(self.moved, from_m, to_m, wrench.force_n + string_n, TICK_S);
        // At the radius of gyration a turn is a way, and a torque a force: both divided by it once more, the equation is the same.
        let string_n = self.hand.string_n(GYRATION_M * from_rad, GYRATION_M * self.turned.place_m);
        let turning_n = (wrench.torque_n_m / GYRATION_M + string_n) / GYRATION_M;
        self.turned = self.hand.advance(self.turned, from_rad, to_rad, turning_n, TICK_S);
    }
}

/// Does the steps of a tick of a tissue with one instrument. Returns what that feels after them.
fn step(tissue: &mut LedTissue, now_s: f64) -> Result<Option<WrenchSample>, String> {
    let felt = tissue.step(now_s)?.into_iter().flatten().next();
    let sequence = tissue.step_count();
    Ok(felt.map(|(InstrumentSample { client_time_s, pose, wrench, .. }, _)| WrenchSample {
        sequence,
        client_time_s,
        pose,
        wrench,
    }))
}

/// The outcome of a run.
#[derive(Debug, Clone, Default)]
pub(super) struct InstrumentOutcome {
    /// Number of tips of the instrument.
    pub(super) tips: usize,
    /// Root mean square of the error over that of the true force, and of the true torque about the instrument's place; over the
    /// ticks in which the instrument touches and rendering has engaged.
    pub(super) force_error_percent: Option<f64>,
    pub(super) torque_error_percent: Option<f64>,
    pub(super) true_force_max_n: f64,
    pub(super) true_torque_max_n_m: f64,
    /// Least energy that the port had received, J: negative if it gave more.
    pub(super) energy_min_j: f64,
    pub(super) unstable_at_s: Option<f64>,
    /// Number of springs or faces that a blade has severed on the server, and without a network.
    pub(super) severed: u64,
    pub(super) true_severed: u64,
    /// Largest change of the rendered and of the true force from one tick to the next, N.
    pub(super) jump_max_n: f64,
    pub(super) true_jump_max_n: f64,
    /// Ticks with an answer of the copy.
    pub(super) predicted_ticks: u64,
    /// What limited the wrench, and in how many ticks.
    pub(super) limits: Vec<(&'static str, u64)>,
}

/// The forces of the tick before, N.
#[derive(Default)]
struct LastForces {
    rendered_n: DVec3,
    true_n: DVec3,
}

/// Sums of squares of errors and of true values.
#[derive(Default)]
struct WrenchErrors {
    force: [f64; 2],
    torque: [f64; 2],
}

impl WrenchErrors {
    fn add(&mut self, rendered: &Wrench, truth: &Wrench) {
        let error = *rendered - *truth;
        for (sums, error, truth) in
            [(&mut self.force, error.force_n, truth.force_n), (&mut self.torque, error.torque_n_m, truth.torque_n_m)]
        {
            sums[0] += error.length_squared();
            sums[1] += truth.length_squared();
        }
    }

    fn percent([error, truth]: [f64; 2]) -> Option<f64> {
        (truth > 0.0).then(|| 100.0 * (error / truth).sqrt())
    }
}

/// Returns a pose of the hand's frame in the tissue's frame.
pub(super) fn in_tissue(spot: &Spot, pose: &InstrumentPose) -> InstrumentPose {
    let [x, y, z] = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| spot.direction_of_tissue(axis));
    let turn = DQuat::from_mat3(&glam::DMat3::from_cols(x, y, z));
    InstrumentPose {
        place_m: spot.of_tissue(pose.place_m),
        orientation: (turn * pose.orientation).normalize(),
        ..*pose
    }
}

/// Returns a wrench of the tissue's frame in the hand's frame.
pub(super) fn of_hand(spot: &Spot, wrench: &Wrench) -> Wrench {
    Wrench { force_n: spot.direction(wrench.force_n), torque_n_m: spot.direction(wrench.torque_n_m) }
}

/// Returns the scale of depths at which the hand meets at most [`task::FORCE_SHARE`] of the device's force, without a network.
fn scale(setup: &Setup, kind: InstrumentKind, instrument: &Instrument) -> Result<f64, String> {
    let most_n = task::FORCE_SHARE * setup.device.most_n();
    let mut scale = task::scale(&setup.hand, &setup.law, setup.device.most_n());
    loop {
        let mut tissue = LedTissue::new(&setup.model, instrument, 1)?;
        let course = Course::new(setup, kind, scale);
        let mut hand = TurningHand::new(setup.hand, course.task.start_m());
        let mut most = 0.0_f64;
        for tick in 0..ticks(setup.duration_s) {
            let now_s = f64::from(tick) * TICK_S;
            let pose = in_tissue(&setup.spot, &hand.pose(kind.orientation(), course.turning.jaw_rad(now_s)));
            tissue.lead(0, u64::from(tick) + 1, &pose, 0, now_s)?;
            let felt = step(&mut tissue, now_s)?.map_or(Wrench::default(), |felt| of_hand(&setup.spot, &felt.wrench));
            most = most.max(felt.force_n.length());
            if most > most_n {
                break;
            }
            course.advance(&mut hand, &felt, now_s);
        }
        if most <= most_n || scale < MIN_SCALE {
            return Ok(scale);
        }
        scale *= 0.8;
    }
}

/// Smallest scale: a smaller task would hardly touch the tissue.
const MIN_SCALE: f64 = 0.01;

/// What the hand of a run wants.
struct Course {
    task: Task,
    turning: Turning,
}

impl Course {
    fn new(setup: &Setup, kind: InstrumentKind, scale: f64) -> Self {
        let Setup { spot, duration_s, seed, .. } = setup;
        Course {
            task: Task::new(spot.at_m, task::LEAD_S, *duration_s, scale, &mut Random::new(*seed, 0)),
            turning: Turning::new(kind, &mut Random::new(*seed, 9)),
        }
    }

    fn advance(&self, hand: &mut TurningHand, wrench: &Wrench, now_s: f64) {
        let next_s = now_s + TICK_S;
        hand.advance(
            wrench,
            [self.task.at(now_s), self.task.at(next_s)],
            [self.turning.at(now_s), self.turning.at(next_s)],
        );
    }
}

/// Performs a run.
///
/// # Errors
/// Returns the reason if the guard stops the tissue, or a command is refused.
pub(super) fn run(setup: &Setup, kind: InstrumentKind) -> Result<InstrumentOutcome, String> {
    let instrument = kind.instrument(setup.tip);
    let course = Course::new(setup, kind, scale(setup, kind, &instrument)?);
    let (mut server, mut twin) =
        (LedTissue::new(&setup.model, &instrument, 1)?, LedTissue::new(&setup.model, &instrument, 1)?);
    let mut up = Direction::<(u64, InstrumentPose, f64)>::new(setup.conditions, setup.seed, 1, task::LEAD_S);
    let mut down = Direction::<WrenchSample>::new(setup.conditions, setup.seed, 2, task::LEAD_S);
    server.by_datagram = setup.conditions.transport == Transport::Datagram;
    let mut envelope = Envelope::new(setup.device, setup.spot.of_tissue(setup.spot.at_m));
    envelope.enable();
    let mut renderer = InstrumentRenderer::new(envelope, instrument.clone());
    let copy = TissueCopy::of_instrument(&setup.model, instrument.clone());
    renderer.predict(Some(Prediction::new(Box::new(copy))));
    let mut hand = TurningHand::new(setup.hand, course.task.start_m());
    let (mut outcome, mut errors) =
        (InstrumentOutcome { tips: instrument.tips.len(), ..Default::default() }, WrenchErrors::default());
    let (mut paused_s, mut last) = (None, LastForces::default());
    for tick in 0..ticks(setup.duration_s) {
        let now_s = f64::from(tick) * TICK_S;
        let away_m = hand.moved.place_m.distance(course.task.start_m());
        if renderer.envelope.energy_j() < UNSTABLE_J
            || away_m > UNSTABLE_AMPLITUDES * course.task.amplitude_m
            || hand.turned.place_m.length() > UNSTABLE_RAD
        {
            outcome.unstable_at_s = Some(now_s);
            break;
        }
        let pose = in_tissue(&setup.spot, &hand.pose(kind.orientation(), course.turning.jaw_rad(now_s)));
        let number = u64::from(tick) + 1;
        up.send(now_s, POSE_BYTES, (number, pose, now_s));
        while let Some((number, pose, sent_s)) = up.receive(now_s) {
            server.lead(0, number, &pose, ns(sent_s).max(1), now_s)?;
        }
        if let Some(sample) = step(&mut server, now_s)? {
            down.send(now_s, SAMPLE_BYTES, sample);
        }
        while let Some(sample) = down.receive(now_s) {
            renderer.receive(sample, now_s);
        }
        let rendered = renderer.tick(now_s, &pose);
        twin.lead(0, number, &pose, 0, now_s)?;
        let truth = step(&mut twin, now_s)?.map_or(Wrench::default(), |felt| felt.wrench);
        for (jump_max_n, last_n, force_n) in [
            (&mut outcome.jump_max_n, &mut last.rendered_n, rendered.force_n),
            (&mut outcome.true_jump_max_n, &mut last.true_n, truth.force_n),
        ] {
            *jump_max_n = jump_max_n.max(force_n.distance(std::mem::replace(last_n, force_n)));
        }
        let touches = truth.force_n != DVec3::ZERO || rendered.force_n.length() > 1e-6;
        if touches && now_s > task::LEAD_S {
            errors.add(&rendered, &truth);
        }
        operate(&mut renderer.envelope, now_s, &mut paused_s);
        outcome.energy_min_j = outcome.energy_min_j.min(renderer.envelope.energy_j());
        outcome.true_force_max_n = outcome.true_force_max_n.max(truth.force_n.length());
        outcome.true_torque_max_n_m = outcome.true_torque_max_n_m.max(truth.torque_n_m.length());
        course.advance(&mut hand, &of_hand(&setup.spot, &rendered), now_s);
    }
    outcome.force_error_percent = WrenchErrors::percent(errors.force);
    outcome.torque_error_percent = WrenchErrors::percent(errors.torque);
    (outcome.severed, outcome.true_severed) = (server.severed(), twin.severed());
    outcome.predicted_ticks = renderer.predicted();
    outcome.limits = super::measure::interventions(&renderer.envelope);
    Ok(outcome)
}
