//! Conversion of instruments and their poses to messages and back.

use glam::DQuat;
use palpate_haptics::instrument::MAX_TIPS;
use palpate_haptics::instrument_contact::MAX_CAPSULES;
use palpate_haptics::instrument_pose::MAX_JAW_RAD;
use palpate_haptics::jaw_limit::MAX_JAW_TORQUE_LIMIT_N_M;
use palpate_haptics::port::HANDLE_M;
use palpate_haptics::{
    Coupling, Instrument, InstrumentPart, InstrumentPose, InstrumentTip, InstrumentVelocity, MotionState,
    MovingCapsule, OtherInstrument, Port, Wrench, WrenchSample,
};

use crate::geometry::{from_vector, vector};
use crate::pb;
use crate::touch::{from_tip, tip};
use palpate_refusal::{Reason, Refusal, Result, legible, number};

/// Largest distance of a tip or a hinge from an instrument's origin, m.
const MAX_OFFSET_M: f64 = 10.0;

/// Largest distance of an instrument from the origin of the tissue's frame, m.
const MAX_AWAY_M: f64 = 1e3;
const AWAY_RANGE: &str = "at most 1000 m from the origin of the tissue's frame";

/// Largest size of a velocity of an instrument, m/s and rad/s.
const MAX_VELOCITY: f64 = 1e3;

/// Returns the instrument in a message. `field` is its path in the request. Does not check whether the tips suit a tissue.
///
/// # Errors
/// Refuses an instrument without tips or with more than [`MAX_TIPS`], a part or a shape that this program does not know, a tip
/// that grasps or has a spring, a place that is not finite or farther than 10 m from the origin, a port that is farther than
/// 1000 m away or has a handle at no possible distance, and a limit of the jaws' torque that is not above 0 and at most 100 N·m, or for
/// an instrument without jaws.
pub fn from_instrument(field: &str, message: &pb::Instrument) -> Result<Instrument> {
    let near = |field: &str, place_m: Option<&pb::Vector3>| {
        let place_m = from_vector(place_m);
        number(field, place_m.length(), "at most 10 m from the origin", |away_m| away_m <= MAX_OFFSET_M)?;
        Ok::<_, Refusal>(place_m)
    };
    if message.tips.is_empty() {
        return Err(Refusal::new(Reason::Missing, format!("{field}.tips"), "is missing: an instrument has tips"));
    }
    if message.tips.len() > MAX_TIPS {
        let text = format!("are {}, above the limit of {MAX_TIPS}", message.tips.len());
        return Err(Refusal::new(Reason::TooLarge, format!("{field}.tips"), text));
    }
    let tip_of = |(index, message): (usize, &pb::InstrumentTip)| {
        let field = format!("{field}.tips[{index}]");
        let unknown =
            |_| Refusal::new(Reason::OutOfRange, format!("{field}.part"), "is a part that this program does not know");
        let part = match pb::InstrumentPart::try_from(message.part).map_err(unknown)? {
            pb::InstrumentPart::Unspecified | pb::InstrumentPart::Body => InstrumentPart::Body,
            pb::InstrumentPart::UpperJaw => InstrumentPart::UpperJaw,
            pb::InstrumentPart::LowerJaw => InstrumentPart::LowerJaw,
        };
        let tip = from_tip(&format!("{field}.tip"), message.tip.as_ref())?;
        if tip.grasps || tip.coupling != Coupling::Constraint {
            let (key, text) =
                (if tip.grasps { "grasps" } else { "spring" }, "is for a single tool: tips of an instrument touch");
            return Err(Refusal::new(Reason::WrongKind, format!("{field}.tip.{key}"), text));
        }
        Ok(InstrumentTip { offset_m: near(&format!("{field}.offset_m"), message.offset_m.as_ref())?, tip, part })
    };
    let instrument = Instrument {
        tips: message.tips.iter().enumerate().map(tip_of).collect::<Result<_>>()?,
        hinge_m: near(&format!("{field}.hinge_m"), message.hinge_m.as_ref())?,
        port: message.port.as_ref().map(|message| from_port(&format!("{field}.port"), message)).transpose()?,
        jaw_torque_limit_n_m: message.jaw_torque_limit_n_m,
    };
    if let Some(limit_n_m) = instrument.jaw_torque_limit_n_m {
        let field = format!("{field}.jaw_torque_limit_n_m");
        if !instrument.has_jaws() {
            return Err(Refusal::new(Reason::WrongKind, field, "is for an instrument with jaws"));
        }
        let range = format!("above 0 and at most {MAX_JAW_TORQUE_LIMIT_N_M}");
        number(&field, limit_n_m, &range, |v| v > 0.0 && v <= MAX_JAW_TORQUE_LIMIT_N_M)?;
    }
    Ok(instrument)
}

fn from_port(field: &str, message: &pb::Port) -> Result<Port> {
    let place_m = from_vector(message.position_m.as_ref());
    number(&format!("{field}.position_m"), place_m.length(), AWAY_RANGE, |away_m| away_m <= MAX_AWAY_M)?;
    let range = format!("from {} to {}", HANDLE_M.start(), HANDLE_M.end());
    let handle_m = number(&format!("{field}.handle_m"), message.handle_m, &range, |v| HANDLE_M.contains(&v))?;
    Ok(Port { place_m, handle_m })
}

/// Converts an instrument to a message. Its first tip is the tool `first_tool`.
pub fn instrument(instrument: &Instrument, first_tool: u32) -> pb::Instrument {
    let tip_of = |of: &InstrumentTip| pb::InstrumentTip {
        offset_m: vector(of.offset_m),
        tip: Some(tip(&of.tip)),
        part: match of.part {
            InstrumentPart::Body => pb::InstrumentPart::Body,
            InstrumentPart::UpperJaw => pb::InstrumentPart::UpperJaw,
            InstrumentPart::LowerJaw => pb::InstrumentPart::LowerJaw,
        }
        .into(),
    };
    pb::Instrument {
        first_tool,
        tips: instrument.tips.iter().map(tip_of).collect(),
        hinge_m: vector(instrument.hinge_m),
        port: instrument.port.map(|port| pb::Port { position_m: vector(port.place_m), handle_m: port.handle_m }),
        jaw_torque_limit_n_m: instrument.jaw_torque_limit_n_m,
    }
}

/// Converts an instrument of another stream to a message. Its time is that of the sample.
pub fn other_instrument(other: &OtherInstrument) -> pb::OtherInstrument {
    let capsule = |MovingCapsule { ends: [from, to], radius_m }: &MovingCapsule| pb::Capsule {
        from_m: vector(from.place_m),
        to_m: vector(to.place_m),
        from_velocity_m_per_s: vector(from.velocity_m_per_s),
        to_velocity_m_per_s: vector(to.velocity_m_per_s),
        radius_m: *radius_m,
    };
    pb::OtherInstrument {
        first_tool: other.first_tool,
        capsules: other.capsules.iter().flatten().map(capsule).collect(),
    }
}

/// Returns the instrument of another stream in a message, at the time `time_s` of the client's clock, s. Absent vectors become 0.
/// Leaves out what is beyond [`MAX_CAPSULES`]. Its numbers may be anything ([`OtherInstrument::is_sound`]).
pub fn from_other_instrument(message: &pb::OtherInstrument, time_s: f64) -> OtherInstrument {
    let end = |place_m: &Option<pb::Vector3>, velocity_m_per_s: &Option<pb::Vector3>| MotionState {
        time_s,
        place_m: from_vector(place_m.as_ref()),
        velocity_m_per_s: from_vector(velocity_m_per_s.as_ref()),
    };
    let mut capsules = [None; MAX_CAPSULES];
    for (place, message) in capsules.iter_mut().zip(&message.capsules) {
        let pb::Capsule { from_m, to_m, from_velocity_m_per_s, to_velocity_m_per_s, radius_m } = message;
        let ends = [end(from_m, from_velocity_m_per_s), end(to_m, to_velocity_m_per_s)];
        *place = Some(MovingCapsule { ends, radius_m: *radius_m });
    }
    OtherInstrument { first_tool: message.first_tool, capsules }
}

/// Returns the pose of an instrument in a message, and its velocity if it has one.
///
/// # Errors
/// Refuses an absent position, or one that is not finite, farther than 1000 m away or not possible in the instrument's port, an
/// orientation whose length is not 1 (within 0.001), an angle of the jaws that is not from 0 to π, or not 0 without jaws, and a velocity that is not finite or above 1000 m/s or rad/s.
pub fn from_pose(
    message: &pb::InstrumentPose,
    instrument: &Instrument,
) -> Result<(InstrumentPose, Option<InstrumentVelocity>)> {
    let missing = || Refusal::new(Reason::Missing, "instrument.position_m", "is missing");
    let place_m = from_vector(Some(message.position_m.as_ref().ok_or_else(missing)?));
    number("instrument.position_m", place_m.length(), AWAY_RANGE, |away_m| away_m <= MAX_AWAY_M)?;
    if let Some(port) = &instrument.port {
        let depths_m = port.depths_m();
        let range = format!("from {} to {} m from the port", legible(*depths_m.start()), legible(*depths_m.end()));
        number("instrument.position_m", place_m.distance(port.place_m), &range, |depth_m| depths_m.contains(&depth_m))?;
    }
    let orientation = message.orientation.as_ref().map_or(Ok(DQuat::IDENTITY), |turn| {
        let turn = DQuat::from_xyzw(turn.x, turn.y, turn.z, turn.w);
        number("instrument.orientation", turn.length(), "of length 1", |length| (length - 1.0).abs() <= 1e-3)?;
        // One that is of length 1 but for rounding keeps its bits.
        let is_unit = (turn.length_squared() - 1.0).abs() <= 4.0 * f64::EPSILON;
        Ok::<_, Refusal>(if is_unit { turn } else { turn.normalize() })
    })?;
    let jaw_rad = number("instrument.jaw_rad", message.jaw_rad, "from 0 to π", |v| (0.0..=MAX_JAW_RAD).contains(&v))?;
    if !instrument.has_jaws() && jaw_rad != 0.0 {
        return Err(Refusal::new(Reason::WrongKind, "instrument.jaw_rad", "is for an instrument with jaws"));
    }
    let velocity = message.velocity_m_per_s.as_ref().map(|velocity| {
        let velocity = InstrumentVelocity {
            velocity_m_per_s: from_vector(Some(velocity)),
            angular_rad_per_s: from_vector(message.angular_velocity_rad_per_s.as_ref()),
            jaw_rad_per_s: message.jaw_velocity_rad_per_s,
        };
        let InstrumentVelocity { velocity_m_per_s, angular_rad_per_s, jaw_rad_per_s } = velocity;
        for (field, value) in [
            ("velocity_m_per_s", velocity_m_per_s.length()),
            ("angular_velocity_rad_per_s", angular_rad_per_s.length()),
            ("jaw_velocity_rad_per_s", jaw_rad_per_s.abs()),
        ] {
            number(&format!("instrument.{field}"), value, "at most 1000", |v| v <= MAX_VELOCITY)?;
        }
        Ok::<_, Refusal>(velocity)
    });
    Ok((InstrumentPose { place_m, orientation, jaw_rad }, velocity.transpose()?))
}

/// Converts a pose to a message, without a velocity.
pub fn pose(pose: &InstrumentPose) -> pb::InstrumentPose {
    pb::InstrumentPose {
        position_m: vector(pose.place_m),
        orientation: orientation(pose.orientation),
        jaw_rad: pose.jaw_rad,
        ..Default::default()
    }
}

/// Returns what a client renders of an instrument's sample, which is of a `step`. Checks nothing: a value that is not finite is refused
/// by [`palpate_haptics::InstrumentRenderer::receive`].
#[allow(clippy::cast_precision_loss)]
pub fn from_sample(message: &pb::InstrumentSample, step: u64) -> WrenchSample {
    let orientation = message.orientation.as_ref();
    WrenchSample {
        sequence: step,
        client_time_s: message.client_time_ns as f64 * 1e-9,
        pose: InstrumentPose {
            place_m: from_vector(message.about_m.as_ref()),
            orientation: orientation.map_or(DQuat::IDENTITY, |turn| DQuat::from_xyzw(turn.x, turn.y, turn.z, turn.w)),
            jaw_rad: message.jaw_rad,
        },
        wrench: Wrench {
            force_n: from_vector(message.force_on_tool_n.as_ref()),
            torque_n_m: from_vector(message.torque_on_tool_n_m.as_ref()),
        },
    }
}

/// Converts an orientation to a message.
pub fn orientation(orientation: DQuat) -> Option<pb::Quaternion> {
    let [x, y, z, w] = orientation.to_array();
    Some(pb::Quaternion { w, x, y, z })
}
