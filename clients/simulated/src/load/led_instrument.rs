//! A client of a load test whose hand leads an instrument: its movement loads the server, and nothing is rendered.

use std::f64::consts::TAU;

use glam::{DQuat, DVec3};
use palpate_haptics::hand::Hand;
use palpate_haptics::{Instrument, InstrumentPose, Tip};
use palpate_proto::{instrument, pb};
use pb::command::Action;

use super::holding::Holding;

/// The instrument that the clients of a plan lead.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum InstrumentKind {
    /// A shaft of 25 mm that lies on the tissue.
    Shaft,
    /// A shaft of 10 mm and two jaws of 15 mm, which open and close.
    Grasper,
}

/// Radius of the tips, m.
const RADIUS_M: f64 = 0.004;

/// Tilts of the instruments from the surface, and largest turn about the direction out of it, rad; turns per second.
const SHAFT_TILT_RAD: f64 = 0.3;
const GRASPER_TILT_RAD: f64 = 1.2;
const TURN_RAD: f64 = 0.25;
const TURNS_HZ: f64 = 0.5;

/// Angles of the jaws, rad, and how often they close per second.
const JAWS_RAD: [f64; 2] = [0.1, 0.9];
const JAWS_HZ: f64 = 0.7;

impl InstrumentKind {
    /// All kinds with their names in plans.
    pub(crate) const ALL: [(InstrumentKind, &'static str); 2] =
        [(InstrumentKind::Shaft, "shaft"), (InstrumentKind::Grasper, "grasper")];

    /// Returns the name in plans.
    pub(crate) fn name(self) -> &'static str {
        match self {
            InstrumentKind::Shaft => "shaft",
            InstrumentKind::Grasper => "grasper",
        }
    }

    /// Returns how many tips, and so tools, the instrument has.
    pub(crate) fn tips(self) -> u32 {
        u32::try_from(self.instrument().tips.len()).unwrap_or(u32::MAX)
    }

    /// Returns the instrument.
    fn instrument(self) -> Instrument {
        let tip = Tip { radius_m: RADIUS_M, ..Tip::default() };
        let mut instrument = Instrument::default();
        match self {
            InstrumentKind::Shaft => instrument.add_parts(None, Some((0.025, tip))),
            InstrumentKind::Grasper => instrument.add_parts(Some((0.015, tip)), Some((0.01, tip))),
        }
        instrument
    }

    /// Returns where the instrument is at a time, s, whose hand is at a place, m.
    fn pose(self, place_m: DVec3, time_s: f64) -> InstrumentPose {
        let (tilt_rad, has_jaws) = match self {
            InstrumentKind::Shaft => (SHAFT_TILT_RAD, false),
            InstrumentKind::Grasper => (GRASPER_TILT_RAD, true),
        };
        let turn_rad = TURN_RAD * (TAU * TURNS_HZ * time_s).sin();
        let part = 0.5 + 0.5 * (TAU * JAWS_HZ * time_s).cos();
        let jaw_rad = if has_jaws { JAWS_RAD[0] + (JAWS_RAD[1] - JAWS_RAD[0]) * part } else { 0.0 };
        let orientation = DQuat::from_rotation_z(turn_rad) * DQuat::from_rotation_y(tilt_rad);
        InstrumentPose { place_m, orientation: orientation.normalize(), jaw_rad }
    }
}

/// Returns the opening of a haptic stream for such a client: `open` with the instrument, whose tips are the tools from the first of
/// `open` on.
pub(crate) fn opening(open: pb::TouchOpen, kind: InstrumentKind) -> pb::TouchOpen {
    let instrument = kind.instrument();
    let first_tool = open.tools.first().copied().unwrap_or_default();
    let tools = (first_tool..).take(instrument.tips.len()).collect();
    pb::TouchOpen { tools, instruments: vec![instrument::instrument(&instrument, first_tool)], ..open }
}

/// One client's instrument, in a hand that feels nothing.
pub(crate) struct HeldInstrument {
    kind: InstrumentKind,
    holding: Holding,
}

impl HeldInstrument {
    /// Creates the instrument of a client, on a tissue with the centre `middle_m`; the seed determines the movements of the hand.
    pub(crate) fn new(kind: InstrumentKind, hand: Hand, seed: u64, middle_m: DVec3) -> Self {
        HeldInstrument { kind, holding: Holding::new(hand, seed, middle_m) }
    }

    /// Does one tick at `now_s`. Returns the pose to send.
    pub(crate) fn tick(&mut self, now_s: f64) -> Action {
        Action::Instrument(instrument::pose(&self.kind.pose(self.holding.place_m(now_s), now_s)))
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn what_a_client_opens_and_sends_is_what_a_server_reads() {
        for (kind, name) in InstrumentKind::ALL {
            assert_eq!(kind.name(), name);
            let open = opening(pb::TouchOpen { tools: vec![3], ..Default::default() }, kind);
            let read = instrument::from_instrument("instruments[0]", &open.instruments[0]).unwrap();
            assert_eq!((read.tips.len(), open.tools[0], open.instruments[0].first_tool), (open.tools.len(), 3, 3));
            let mut held = HeldInstrument::new(kind, palpate_haptics::hand::HANDS[0], 1, DVec3::ZERO);
            let poses = (0..2000_u32).map(|tick| {
                let Action::Instrument(pose) = held.tick(1e-3 * f64::from(tick)) else { panic!("a pose") };
                instrument::from_pose(&pose, &read).unwrap().0
            });
            let poses: Vec<InstrumentPose> = poses.collect();
            // It presses, turns, and closes jaws if it has any.
            assert!(poses.iter().any(|pose| pose.place_m.z < -5e-4) && poses[0].place_m.z > 0.0);
            assert!(poses.iter().any(|pose| pose.turn_to(&poses[0]).length() > 0.2));
            let least_rad = poses.iter().map(|pose| pose.jaw_rad).fold(f64::INFINITY, f64::min);
            assert_eq!(read.has_jaws(), poses[0].jaw_rad > least_rad + 0.5);
        }
    }
}
