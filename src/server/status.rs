//! Converts a session to its message: its state, counts, audits and tissue.

use super::exercise_message;
use palpate_proto::geometry::vector;
use palpate_proto::pb;
use palpate_realtime::event_log::EventLog;
use palpate_realtime::playback::Playback;
use palpate_realtime::{LiveExercise, RunState, SessionHandle};
use palpate_session::wire;
use palpate_tissue::scene::Named;
use palpate_tissue::scene::record::{AuditedError, StageTime};
use palpate_tissue::select::audit::Origin;
use palpate_tissue::{Model, TieState};

/// Returns the current state of a session as a message.
pub(super) fn session(handle: &SessionHandle) -> pb::Session {
    let status = handle.status();
    let (held_tools, lapsed_leases, counts) = handle.at_intake(|intake, _| {
        let held = intake.holders().map(|(tool, holder)| pb::HeldTool { tool, holder: holder.to_owned() });
        (held.collect(), intake.expired(), intake.counts())
    });
    let count = |count: usize| u32::try_from(count).unwrap_or(u32::MAX);
    let model = &status.model;
    #[allow(clippy::cast_precision_loss)]
    let simulation_time_s = status.step as f64 / model.scene.stepping.rate_hz;
    let session = pb::Session {
        session_id: handle.id.clone(),
        state: match status.state {
            RunState::Running => pb::SessionState::Running,
            RunState::Paused => pb::SessionState::Paused,
            RunState::Held => pb::SessionState::Held,
        }
        .into(),
        step: status.step,
        simulation_time_s,
        overrun_count: status.overrun_count,
        time_dilation: status.dilation.value,
        late_commands: status.late_commands,
        paused_commands: status.paused_commands,
        hold_reason: status.hold_reason.unwrap_or_default(),
        held_tools,
        lapsed_leases,
        idle_timeout_s: handle.idle_timeout_s,
        guard_events: status.guard_events,
        recovery_count: status.recovery_count,
        recoveries: status.recoveries.into_iter().map(wire::sample::recovery).collect(),
        resting: status.resting,
        rested_steps: status.rested_steps,
        commands: Some(pb::CommandCounts {
            accepted: counts.accepted,
            applied: counts.applied,
            superseded: counts.superseded,
            dropped: counts.dropped,
            waiting: counts.waiting,
            refused: handle.refused(),
        }),
        topology_version: status.cuts.version(),
        severed: count(status.cuts.len()),
        severed_anchors: count(status.cuts.anchor_count()),
        fracture_j: status.cuts.fracture_j(),
        // Counting looks at all springs.
        pieces: if status.cuts.is_empty() { 1 } else { count(status.cuts.pieces(model)) },
        cuts_exhausted: !status.cuts.has_room(model),
        ties: status.ties.into_iter().map(laid_tie).collect(),
        awake_points: count(status.awake_points),
        streams: count(handle.streams()),
        scene_name: model.scene.name.clone(),
        points: count(model.len()),
        extent: Some(pb::Extent { top_m: vector(model.shape().top_m()), ..wire::extent(&model.shape().extent()) }),
        stages: status.stages.into_iter().map(stage_time).collect(),
        audit: audit(handle),
        mesh_error_estimate: mesh_error(handle),
        journal: handle.event_log.as_deref().map(journal),
        playback: handle.playback.as_ref().map(playback),
        exercise: handle.exercise.as_ref().map(|exercise| exercise_message::of_session(exercise, false)),
        ..Default::default()
    };
    with_model(session, model)
}

/// Returns the current state of a session that is made for an exercise, for a trainee. What follows from its model is that of the tissue
/// without what is hidden, and each other field is named here: a new one is hidden until it is added.
pub(super) fn of_trainee(handle: &SessionHandle, exercise: &LiveExercise) -> pb::Session {
    let of_trainer = session(handle);
    let told = pb::Session {
        session_id: exercise.trainee_id.clone(),
        state: of_trainer.state,
        step: of_trainer.step,
        simulation_time_s: of_trainer.simulation_time_s,
        overrun_count: of_trainer.overrun_count,
        time_dilation: of_trainer.time_dilation,
        late_commands: of_trainer.late_commands,
        paused_commands: of_trainer.paused_commands,
        hold_reason: of_trainer.hold_reason,
        held_tools: of_trainer.held_tools,
        lapsed_leases: of_trainer.lapsed_leases,
        idle_timeout_s: of_trainer.idle_timeout_s,
        recovery_count: of_trainer.recovery_count,
        resting: of_trainer.resting,
        commands: of_trainer.commands,
        topology_version: of_trainer.topology_version,
        severed: of_trainer.severed,
        severed_anchors: of_trainer.severed_anchors,
        pieces: of_trainer.pieces,
        cuts_exhausted: of_trainer.cuts_exhausted,
        ties: of_trainer.ties,
        streams: of_trainer.streams,
        scene_name: of_trainer.scene_name,
        points: of_trainer.points,
        extent: of_trainer.extent,
        exercise: Some(exercise_message::of_session(exercise, true)),
        ..Default::default()
    };
    with_model(told, &exercise.plain)
}

fn stage_time(StageTime { stage, time_s }: StageTime) -> pb::StageTime {
    pb::StageTime { stage: stage.to_owned(), time_s }
}

fn laid_tie(state: TieState) -> pb::LaidTie {
    let TieState { number, tie, tensions_n, length_m, path_m, is_broken, .. } = state;
    pb::LaidTie {
        tie: Some(wire::command::tie(u32::try_from(number).unwrap_or(u32::MAX), Some(&tie))),
        length_m,
        path_m,
        tension_n: tensions_n.into_iter().fold(0.0, f64::max),
        broken: is_broken,
    }
}

/// Returns what a session plays back.
fn playback(playback: &Playback) -> pb::Playback {
    pb::Playback {
        session_id: playback.session_id.clone(),
        run: u32::try_from(playback.run).unwrap_or(u32::MAX),
        begin_step: playback.steps[0],
        end_step: playback.steps[1],
        speed: playback.speed,
    }
}

/// Returns how far a session is recorded on disk.
fn journal(event_log: &EventLog) -> pb::Journal {
    let progress = event_log.progress().borrow().clone();
    pb::Journal {
        durable_step: progress.durable_step,
        lag_s: progress.lag_s,
        fault: progress.broken.map(|why| why.to_string()).unwrap_or_default(),
        run: progress.run,
        mirrored_step: progress.mirrored_step,
    }
}

/// Returns the results of a session's audits; `None` before the first.
fn audit(handle: &SessionHandle) -> Option<pb::Audit> {
    let audited = handle.audited();
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

/// Returns the error of the cells of a session's tissue; `None` before it is estimated.
fn mesh_error(handle: &SessionHandle) -> Option<pb::MeshErrorEstimate> {
    let estimate = handle.audited().mesh_error?;
    Some(pb::MeshErrorEstimate {
        relative: estimate.relative,
        stiffness_n_per_m: estimate.stiffness_n_per_m,
        radius_m: estimate.radius_m,
        compared_cell_m: estimate.compared_cell_m,
    })
}

/// Adds the fields that describe the tissue's model.
pub(super) fn with_model(session: pb::Session, model: &Model) -> pb::Session {
    pb::Session {
        scene: Some(wire::scene::scene(&model.scene)),
        integrator: model.plan.integrator.name().to_owned(),
        substeps: model.plan.substeps,
        precision: model.precision.name().to_owned(),
        warnings: model.warnings.clone(),
        // An unknown error counts as the largest possible one.
        expected_error: if model.expected_error.is_finite() { model.expected_error } else { 1.0 },
        ..session
    }
}
