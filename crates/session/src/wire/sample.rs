//! Conversion of samples and records to messages, and of records back.

use super::{every, from_record, point};
use crate::ToolSample;
use crate::sample_selection::{Deadband, HEARTBEAT_S, PacedSample, Sampling};
use crate::surface::Encoding;
use palpate_proto::geometry::{from_vector, vector};
use palpate_proto::{pb, touch};
use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::scene::record::{EnergyJ, Point, Record, Recovery, ToolRecord};
use palpate_tissue::shape::RestShape;

/// Returns the settings of a stream of samples, without force laws: every step if `every_steps` is absent, and a
/// heartbeat of [`HEARTBEAT_S`] if that is. `only` has the tools, `None` for all. `renders`: the stream has declared
/// a device.
///
/// # Errors
/// Refuses an interval of 0 steps, a deadband without a bound or with one out of range, a heartbeat that is not above
/// 0 and at most 10 s, and a bound of the rendered force without a device ([`Reason::Missing`]).
pub fn sampling(
    every_steps: Option<u32>,
    only: Option<Vec<u32>>,
    deadband: Option<&pb::Deadband>,
    heartbeat_s: Option<f64>,
    renders: bool,
) -> Result<Sampling> {
    if !renders && deadband.is_some_and(|deadband| deadband.rendered_fraction.is_some()) {
        let message = "requires a device, but the request declares none";
        return Err(Refusal::new(Reason::Missing, "deadband.rendered_fraction", message));
    }
    let sampling = Sampling {
        every: every("sample_every_steps", every_steps)?,
        only,
        deadband: deadband.map(|deadband| Deadband {
            force_n: deadband.force_n,
            force_fraction: deadband.force_fraction,
            displacement_m: deadband.displacement_m,
            rendered_fraction: deadband.rendered_fraction,
        }),
        heartbeat_s: heartbeat_s.unwrap_or(HEARTBEAT_S),
        laws: None,
        touch_stiffness: false,
        other_tools: false,
        wanted: None,
    };
    sampling.check()?;
    Ok(sampling)
}

/// Returns a sample as a message that is sent at `now_ns`, ns of the server's clock. `shape` names its points.
/// `dropped` is the number of samples that the stream has lost so far.
pub fn sample(paced: &PacedSample, shape: &dyn RestShape, dropped: u64, now_ns: u64) -> pb::Sample {
    let sample = &paced.sample;
    #[allow(clippy::cast_possible_truncation)]
    pb::Sample {
        step: sample.step,
        simulation_time_s: sample.simulation_time_s,
        server_time_ns: now_ns,
        overrun_count: paced.overrun_count,
        time_dilation: paced.time_dilation,
        awake_points: sample.awake_points as u32,
        overrun: paced.overrun,
        asleep: sample.awake_points == 0,
        held: sample.held,
        cuts_exhausted: sample.cuts_exhausted,
        topology_version: sample.topology_version,
        late_commands: sample.late_commands,
        dropped_samples: dropped,
        recovery_count: sample.recoveries,
        durable_step: paced.durable_step,
        ownership_revision: paced.ownership_revision,
        tools: sample.tools.iter().map(|tool| tool_sample(tool, shape, paced.due_ns, now_ns)).collect(),
        other_tools: sample.other_tools.iter().map(touch::other_tool).collect(),
        instruments: Vec::new(),
        other_instruments: Vec::new(),
    }
}

fn tool_sample(tool: &ToolSample, shape: &dyn RestShape, due_ns: u64, now_ns: u64) -> pb::ToolSample {
    let contact = tool.contact.as_ref();
    let (point, vertex) = contact.map(|contact| point(shape.name(contact.point))).unwrap_or_default();
    let since_arrival_ns = |at_ns: u64| if tool.arrival_ns == 0 { 0 } else { at_ns.saturating_sub(tool.arrival_ns) };
    pb::ToolSample {
        tool: tool.tool,
        acknowledged_sequence: tool.acknowledged_sequence,
        client_time_ns: tool.client_time_ns,
        server_hold_ns: since_arrival_ns(now_ns),
        step_wait_ns: since_arrival_ns(due_ns),
        point,
        vertex,
        displacement_m: contact.and_then(|contact| vector(contact.displacement_m)),
        surface_displacement_m: contact.and_then(|contact| vector(contact.surface_displacement_m)),
        velocity_m_per_s: contact.and_then(|contact| vector(contact.velocity_m_per_s)),
        force_on_tool_n: contact.and_then(|contact| vector(contact.force_on_tool_n)),
        applied_force_n: contact.and_then(|contact| vector(contact.applied_force_n)),
        late: tool.late,
        expired: tool.expired,
        paused_until_step: tool.paused_until,
        local_model: tool.local.as_ref().map(touch::local_model),
        stale: tool.stale,
        on_fixed_point: contact.is_some_and(|contact| shape.is_fixed(contact.point))
            || tool.feel.as_ref().is_some_and(|feel| feel.is_on_fixed),
    }
}

/// Returns the refusal of the command with sequence number `sequence` to tool `tool` as a message. The number of
/// dropped answers in it is 0.
pub fn rejection(tool: u32, sequence: u64, refusal: &Refusal) -> pb::Rejection {
    pb::Rejection {
        tool,
        sequence,
        reason: refusal.reason.as_str().to_owned(),
        field: refusal.field.clone(),
        message: refusal.to_string(),
        dropped_answers: 0,
    }
}

/// Limit of points per message of a record.
const POINTS_PER_MESSAGE: usize = 1000;

/// Returns message `part`, from 0, of a record of step `step`, with at most 1000 points each; `None` after the last.
/// The last also has the energies, tools and number of awake points; a record without points has one message.
/// `dropped` is the number of records that the stream has lost so far. The messages are made one at a time: those of
/// a large sheet together would take a second and a gigabyte.
pub fn record(step: u64, record: &Record, dropped: u64, part: usize) -> Option<pb::ProbeResponse> {
    let parts = record.points.len().div_ceil(POINTS_PER_MESSAGE).max(1);
    let points = record.points.chunks(POINTS_PER_MESSAGE).nth(part).unwrap_or_default();
    let mut message = pb::ProbeResponse {
        step,
        simulation_time_s: record.time_s,
        points: points.iter().map(point_record).collect(),
        dropped_records: dropped,
        ..Default::default()
    };
    #[allow(clippy::cast_possible_truncation)]
    if part + 1 == parts {
        message.last = true;
        message.awake_points = record.awake_points as u32;
        message.energy = record.energy_j.map(|energy| pb::Energy {
            kinetic_j: energy.kinetic,
            spring_j: energy.spring,
            anchor_j: energy.anchor_springs,
        });
        message.tools = record.tools.iter().map(tool_record).collect();
    }
    (part < parts).then_some(message)
}

fn point_record(record: &Point) -> pb::PointRecord {
    let vector = |v: [f64; 3]| vector(v.into());
    let (point, vertex) = point(record.name);
    pb::PointRecord {
        point,
        vertex,
        displacement_m: vector(record.displacement_m),
        velocity_m_per_s: vector(record.velocity_m_per_s),
        spring_n: vector(record.spring_n),
        anchor_n: vector(record.anchor_n),
        damping_n: vector(record.damping_n),
        applied_n: vector(record.applied_n),
        reaction_n: vector(record.reaction_n),
        constraint_n: record.constraint_n.and_then(vector),
    }
}

fn tool_record(record: &ToolRecord) -> pb::ToolRecord {
    pb::ToolRecord {
        tool: record.tool,
        place_m: vector(record.place_m.into()),
        displacement_m: vector(record.displacement_m.into()),
        force_on_tool_n: vector(record.force_on_tool_n.into()),
    }
}

/// Appends a message's points to a record, and takes the energies, tools and number of awake points from the last
/// message. Give it the messages in order. Returns whether this was the last. An absent vector counts as 0.
pub fn add_to_record(record: &mut Record, message: &pb::ProbeResponse) -> bool {
    let array = |v: &Option<pb::Vector3>| from_vector(v.as_ref()).to_array();
    record.time_s = message.simulation_time_s;
    record.points.extend(message.points.iter().map(|point| Point {
        name: from_record(point),
        displacement_m: array(&point.displacement_m),
        velocity_m_per_s: array(&point.velocity_m_per_s),
        spring_n: array(&point.spring_n),
        anchor_n: array(&point.anchor_n),
        damping_n: array(&point.damping_n),
        applied_n: array(&point.applied_n),
        reaction_n: array(&point.reaction_n),
        constraint_n: point.constraint_n.as_ref().map(|v| from_vector(Some(v)).to_array()),
    }));
    if message.last {
        record.awake_points = message.awake_points as usize;
        record.energy_j = message.energy.as_ref().map(|energy| EnergyJ {
            kinetic: energy.kinetic_j,
            spring: energy.spring_j,
            anchor_springs: energy.anchor_j,
        });
        record.tools = message
            .tools
            .iter()
            .map(|tool| ToolRecord {
                tool: tool.tool,
                place_m: array(&tool.place_m),
                displacement_m: array(&tool.displacement_m),
                force_on_tool_n: array(&tool.force_on_tool_n),
            })
            .collect();
    }
    message.last
}

/// Converts a recovery to a message, field by field.
pub fn recovery(recovery: Recovery) -> pb::Recovery {
    let Recovery { step, state_of_step, at_rest, undone_commands, paused_until_step, reason } = recovery;
    pb::Recovery { step, state_of_step, undone_commands, reason, at_rest, paused_until_step }
}

/// Converts a recovery from a message, field by field; nothing is checked.
pub fn from_recovery(recovery: pb::Recovery) -> Recovery {
    let pb::Recovery { step, state_of_step, undone_commands, reason, at_rest, paused_until_step } = recovery;
    Recovery { step, state_of_step, at_rest, undone_commands, paused_until_step, reason }
}

/// Converts an encoding to its value in messages.
pub fn encoding(encoding: Encoding) -> pb::Encoding {
    match encoding {
        Encoding::F32 => pb::Encoding::F32,
        Encoding::I16 => pb::Encoding::I16,
    }
}

/// Returns the encoding that a viewer requests by the number in its message; F32 if it requests none.
///
/// # Errors
/// Refuses a number that no encoding has ([`Reason::WrongKind`]).
pub fn from_encoding(encoding: i32) -> Result<Encoding> {
    match pb::Encoding::try_from(encoding) {
        Ok(pb::Encoding::Unspecified | pb::Encoding::F32) => Ok(Encoding::F32),
        Ok(pb::Encoding::I16) => Ok(Encoding::I16),
        Err(_) => Err(Refusal::new(Reason::WrongKind, "encoding", format!("unknown encoding {encoding}"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_encoding_has_a_number_and_every_number_an_encoding() {
        let numbers = (0..).take_while(|number| pb::Encoding::try_from(*number).is_ok());
        let known: Vec<Encoding> = numbers.skip(1).map(|number| from_encoding(number).unwrap()).collect();
        assert_eq!(known, Encoding::ALL);
        for each in Encoding::ALL {
            assert_eq!(from_encoding(encoding(each).into()).unwrap(), each);
        }
        assert_eq!(from_encoding(0).unwrap(), Encoding::F32);
        assert_eq!(from_encoding(7).unwrap_err().message, "unknown encoding 7");
    }
}
