//! Conversion of samples, records, sessions and frames to messages, and of records back.

use std::sync::Arc;

use palpate_proto::geometry::{from_point, from_vector, point, vector};
use palpate_proto::{pb, touch};

use super::every;
use crate::pace::frames::Delivery;
use crate::pace::{Live, PacedRecord, PacedSample, State};
use crate::refusal::{Reason, Refusal, Result};
use crate::scene::Named;
use crate::scene::record::{AuditedError, EnergyJ, Point, Record, Recovery};
use crate::session::ToolSample;
use crate::session::sampling::{Deadband, HEARTBEAT_S, Sampling};
use crate::sheet::Model;
use crate::sheet::audit::Origin;
use crate::surface::Encoding;
use crate::surface::encode::Patch;

/// The samples that a stream asks for. `renders`: the stream has declared a device.
///
/// # Errors
/// Returns an error if a value is out of range, or if a deadband of rendered force is given without a device.
pub fn sampling(
    every_steps: Option<u32>,
    only: Option<Vec<u32>>,
    deadband: Option<&pb::Deadband>,
    heartbeat_s: Option<f64>,
    renders: bool,
) -> Result<Sampling> {
    if !renders && deadband.is_some_and(|deadband| deadband.rendered_fraction.is_some()) {
        let message = "is missing, but deadband.rendered_fraction requires it";
        return Err(Refusal::new(Reason::Missing, "device", message));
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
    };
    sampling.check()?;
    Ok(sampling)
}

/// A sample as a message that is sent at `now_ns`.
pub fn sample(paced: &PacedSample, dropped: u64, now_ns: u64) -> pb::Sample {
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
        late_commands: sample.late_commands,
        dropped_samples: dropped,
        recovery_count: sample.recoveries,
        tools: sample.tools.iter().map(|tool| tool_sample(tool, paced.due_ns, now_ns)).collect(),
    }
}

fn tool_sample(tool: &ToolSample, due_ns: u64, now_ns: u64) -> pb::ToolSample {
    let contact = tool.contact.as_ref();
    let since_arrival_ns = |at_ns: u64| if tool.arrival_ns == 0 { 0 } else { at_ns.saturating_sub(tool.arrival_ns) };
    pb::ToolSample {
        tool: tool.tool,
        acknowledged_sequence: tool.acknowledged_sequence,
        client_time_ns: tool.client_time_ns,
        server_hold_ns: since_arrival_ns(now_ns),
        step_wait_ns: since_arrival_ns(due_ns),
        point: contact.map(|contact| point(contact.point)),
        displacement_m: contact.and_then(|contact| vector(contact.displacement_m)),
        velocity_m_per_s: contact.and_then(|contact| vector(contact.velocity_m_per_s)),
        force_on_tool_n: contact.and_then(|contact| vector(contact.force_on_tool_n)),
        applied_force_n: contact.and_then(|contact| vector(contact.applied_force_n)),
        late: tool.late,
        expired: tool.expired,
        local_model: tool.local.as_ref().map(touch::local_model),
        stale: tool.stale,
    }
}

/// A refused command as a message.
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

/// Points per message of a record.
const POINTS_PER_MESSAGE: usize = 1000;

/// Message `part` of a record; `None` after the last. A record without points has one message. The messages are made one
/// at a time: those of a large sheet together would take a second and a gigabyte.
pub fn record(paced: &PacedRecord, dropped: u64, part: usize) -> Option<pb::ProbeResponse> {
    let record = &paced.record;
    let parts = record.points.len().div_ceil(POINTS_PER_MESSAGE).max(1);
    let points = record.points.chunks(POINTS_PER_MESSAGE).nth(part).unwrap_or_default();
    let mut message = pb::ProbeResponse {
        step: paced.step,
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
            virtual_j: energy.virtual_springs,
        });
    }
    (part < parts).then_some(message)
}

fn point_record(record: &Point) -> pb::PointRecord {
    let vector = |v: [f64; 3]| vector(v.into());
    pb::PointRecord {
        point: Some(point(record.point)),
        displacement_m: vector(record.displacement_m),
        velocity_m_per_s: vector(record.velocity_m_per_s),
        spring_n: vector(record.spring_n),
        virtual_n: vector(record.virtual_n),
        damping_n: vector(record.damping_n),
        applied_n: vector(record.applied_n),
        reaction_n: vector(record.reaction_n),
        constraint_n: record.constraint_n.and_then(vector),
    }
}

/// Adds a message to a record; returns whether it was the record's last.
pub fn add_to_record(record: &mut Record, message: &pb::ProbeResponse) -> bool {
    let array = |v: &Option<pb::Vector3>| from_vector(v.as_ref()).to_array();
    record.time_s = message.simulation_time_s;
    record.points.extend(message.points.iter().map(|point| Point {
        point: point.point.as_ref().map_or([0, 0], from_point),
        displacement_m: array(&point.displacement_m),
        velocity_m_per_s: array(&point.velocity_m_per_s),
        spring_n: array(&point.spring_n),
        virtual_n: array(&point.virtual_n),
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
            virtual_springs: energy.virtual_j,
        });
    }
    message.last
}

/// The current state of a session as a message.
pub fn session(live: &Arc<Live>) -> pb::Session {
    let status = live.status();
    let (held_tools, lapsed_leases, counts) = live.at_intake(|intake, _| {
        let held = intake.holders().map(|(tool, holder)| pb::HeldTool { tool, holder: holder.to_owned() });
        (held.collect(), intake.lapsed(), intake.counts())
    });
    let count = |count: usize| u32::try_from(count).unwrap_or(u32::MAX);
    let model = &status.model;
    #[allow(clippy::cast_precision_loss)]
    let simulation_time_s = status.step as f64 / model.scene.stepping.rate_hz;
    let session = pb::Session {
        session_id: live.id.clone(),
        state: match status.state {
            State::Running => pb::SessionState::Running,
            State::Paused => pb::SessionState::Paused,
            State::Held => pb::SessionState::Held,
        }
        .into(),
        step: status.step,
        simulation_time_s,
        overrun_count: status.overrun_count,
        time_dilation: status.dilation.value,
        late_commands: status.late_commands,
        hold_reason: status.hold_reason.unwrap_or_default(),
        held_tools,
        lapsed_leases,
        idle_timeout_s: live.idle_timeout_s,
        guard_events: status.guard_events,
        recovery_count: status.recovery_count,
        recoveries: status.recoveries.into_iter().map(recovery).collect(),
        resting: status.resting,
        rested_steps: status.rested_steps,
        commands: Some(pb::CommandCounts {
            accepted: counts.accepted,
            applied: counts.applied,
            superseded: counts.superseded,
            dropped: counts.dropped,
            waiting: counts.waiting,
            refused: live.refused(),
        }),
        awake_points: count(status.awake_points),
        streams: count(live.streams()),
        scene_name: model.scene.name.clone(),
        points: count(model.len()),
        audit: audit(live),
        ..Default::default()
    };
    with_model(session, model)
}

fn recovery(recovery: Recovery) -> pb::Recovery {
    let Recovery { step, state_of_step, at_rest, undone_commands, reason } = recovery;
    pb::Recovery { step, state_of_step, undone_commands, reason, at_rest }
}

/// A recovery of a session, as a record has it.
pub fn from_recovery(recovery: pb::Recovery) -> Recovery {
    let pb::Recovery { step, state_of_step, undone_commands, reason, at_rest } = recovery;
    Recovery { step, state_of_step, at_rest, undone_commands, reason }
}

/// The results of a session's audits; `None` before the first.
fn audit(live: &Live) -> Option<pb::Audit> {
    let audited = live.audited();
    let (step, newest) = audited.newest?;
    let error = |error: AuditedError| Some(pb::AuditedError { displacement: error.displacement, force: error.force });
    Some(pb::Audit {
        windows: audited.windows,
        step,
        newest_error: error(newest),
        largest_error: error(audited.largest),
        windows_above_tolerance: audited.above,
        reason: audited.origin.map(Origin::describe).unwrap_or_default().to_owned(),
        corrections: audited.corrections,
        refused_correction: audited.refused_correction.map(|refusal| refusal.to_string()).unwrap_or_default(),
        newest_correction: audited.correction.map(|correction| pb::Correction {
            step: correction.step,
            audited_error: error(correction.audited_error),
            reason: correction.reason,
            integrator: correction.integrator.name().to_owned(),
            substeps: correction.substeps,
            precision: correction.precision.name().to_owned(),
            sleep_tolerance: correction.sleep_tolerance,
        }),
    })
}

/// Adds the fields that describe the tissue's model.
pub fn with_model(session: pb::Session, model: &Model) -> pb::Session {
    pb::Session {
        scene: Some(super::scene::scene(&model.scene)),
        integrator: model.plan.integrator.name().to_owned(),
        substeps: model.plan.substeps,
        precision: model.precision.name().to_owned(),
        warnings: model.warnings.clone(),
        // An unknown error counts as the largest possible one.
        expected_error: if model.expected_error.is_finite() { model.expected_error } else { 1.0 },
        ..session
    }
}

/// Bytes of displacements per message: messages of other streams wait for at most one of these.
const FRAME_BYTES_PER_MESSAGE: usize = 64 << 10;

/// The messages of a frame for one viewer.
pub fn frame(viewer_id: &str, delivery: &Delivery, skipped: u64) -> Vec<pb::WatchFramesResponse> {
    let frame = &delivery.frame;
    let [vertices_x, vertices_y] = frame.refinement.vertices();
    #[allow(clippy::cast_possible_truncation)]
    let message = || pb::WatchFramesResponse {
        viewer_id: viewer_id.to_owned(),
        frame_id: delivery.frame_id,
        step: frame.step,
        simulation_time_s: frame.simulation_time_s,
        refinement: frame.refinement.between as u32,
        vertices_x: vertices_x as u32,
        vertices_y: vertices_y as u32,
        encoding: match frame.encoding {
            Encoding::F32 => pb::Encoding::F32,
            Encoding::I16 => pb::Encoding::I16,
        }
        .into(),
        origin_m: vector(frame.quanta.origin_m),
        scale_m: vector(frame.quanta.scale_m),
        full: frame.full,
        skipped_frames: skipped,
        overrun_count: delivery.overrun_count,
        time_dilation: delivery.time_dilation,
        patches: Vec::new(),
        last: false,
    };
    let mut messages: Vec<pb::WatchFramesResponse> = Vec::new();
    let mut room = 0;
    for patch in &frame.patches {
        if messages.is_empty() || patch.bytes.len() > room {
            messages.push(message());
            room = FRAME_BYTES_PER_MESSAGE;
        }
        room -= patch.bytes.len().min(room);
        if let Some(message) = messages.last_mut() {
            message.patches.push(self::patch(patch));
        }
    }
    if let Some(last) = messages.last_mut() {
        last.last = true;
    }
    messages
}

#[allow(clippy::cast_possible_truncation)]
fn patch(patch: &Patch) -> pb::Patch {
    pb::Patch {
        first_x: patch.first[0] as u32,
        first_y: patch.first[1] as u32,
        count_x: patch.count[0] as u32,
        count_y: patch.count[1] as u32,
        displacement: patch.bytes.clone(),
    }
}
