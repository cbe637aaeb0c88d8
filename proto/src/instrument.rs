//! Conversion of instruments and their poses to messages and back.

use glam::DQuat;
use palpate_haptics::instrument::{MAX_JAW_RAD, MAX_TIPS};
use palpate_haptics::{Coupling, Instrument, InstrumentPart, InstrumentPose, InstrumentTip, InstrumentVelocity};

use crate::geometry::{from_vector, vector};
use crate::pb;
use crate::touch::{from_tip, tip};
use palpate_refusal::{Reason, Refusal, Result, number};

/// Largest distance of a tip or a hinge from an instrument's origin, m.
const MAX_OFFSET_M: f64 = 10.0;

/// Largest distance of an instrument from the origin of the tissue's frame, m.
const MAX_AWAY_M: f64 = 1e3;

/// Largest size of a velocity of an instrument, m/s and rad/s.
const MAX_VELOCITY: f64 = 1e3;

/// Returns the instrument in a message. `field` is its path in the request. Does not check whether the tips suit a tissue.
///
/// # Errors
/// Refuses an instrument without tips or with more than [`MAX_TIPS`], a part or a shape that this program does not know, a tip
/// that grasps or has a spring, and a place that is not finite or farther than 10 m from the origin.
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
    Ok(Instrument {
        tips: message.tips.iter().enumerate().map(tip_of).collect::<Result<_>>()?,
        hinge_m: near(&format!("{field}.hinge_m"), message.hinge_m.as_ref())?,
    })
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
    }
}

/// Returns the pose in a message, and its velocity if it has one. `has_jaws`: the instrument has jaws.
///
/// # Errors
/// Refuses an absent position, or one that is not finite or farther than 1000 m away, an orientation whose length is not 1 (within 0.001), an angle of the jaws that is not from 0 to π,
/// or not 0 without jaws, and a velocity that is not finite or above 1000 m/s or rad/s.
pub fn from_pose(message: &pb::InstrumentPose, has_jaws: bool) -> Result<(InstrumentPose, Option<InstrumentVelocity>)> {
    let missing = || Refusal::new(Reason::Missing, "instrument.position_m", "is missing");
    let place_m = from_vector(Some(message.position_m.as_ref().ok_or_else(missing)?));
    let range = format!("at most {MAX_AWAY_M} m from the origin of the tissue's frame");
    number("instrument.position_m", place_m.length(), &range, |away_m| away_m <= MAX_AWAY_M)?;
    let orientation = message.orientation.as_ref().map_or(Ok(DQuat::IDENTITY), |turn| {
        let turn = DQuat::from_xyzw(turn.x, turn.y, turn.z, turn.w);
        number("instrument.orientation", turn.length(), "of length 1", |length| (length - 1.0).abs() <= 1e-3)?;
        // One that is of length 1 but for rounding keeps its bits.
        let is_unit = (turn.length_squared() - 1.0).abs() <= 4.0 * f64::EPSILON;
        Ok::<_, Refusal>(if is_unit { turn } else { turn.normalize() })
    })?;
    let jaw_rad = number("instrument.jaw_rad", message.jaw_rad, "from 0 to π", |v| (0.0..=MAX_JAW_RAD).contains(&v))?;
    if !has_jaws && jaw_rad != 0.0 {
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
    let [x, y, z, w] = pose.orientation.to_array();
    pb::InstrumentPose {
        position_m: vector(pose.place_m),
        orientation: Some(pb::Quaternion { w, x, y, z }),
        jaw_rad: pose.jaw_rad,
        ..Default::default()
    }
}
