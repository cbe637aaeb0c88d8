//! Converts exercises, figures and results to their messages, each as far as its reader may know it.

use palpate_exercise::{Figure, register};
use palpate_proto::geometry::vector;
use palpate_proto::pb;
use palpate_realtime::{LiveExercise, TrainerAdvice};
use palpate_session::RecordedMark;
use palpate_session::exercise_judge::{EarnedCriterion, PhaseFigures};
use palpate_session::measured_run::{EndedExercise, MomentFigures};
use palpate_tissue::scene::exercise::{AvoidedRegion, CoverageTask, CutLine, Exercise, ExercisePhase, Lump};

/// Returns what everybody may know of an exercise.
pub(super) fn exercise(exercise: &Exercise) -> pb::Exercise {
    let line = |line: &CutLine| pb::ExerciseLine {
        points_m: line.points_m.iter().filter_map(|place_m| vector(*place_m)).collect(),
        within_m: line.within_m,
    };
    let ball = |ball: &AvoidedRegion| pb::ExerciseBall { centre_m: vector(ball.centre_m), radius_m: ball.radius_m };
    let phase = |phase: &ExercisePhase| pb::ExercisePhase {
        title: phase.title.clone(),
        instructions: phase.instructions.clone(),
        time_limit_s: phase.time_limit_s,
    };
    pb::Exercise {
        name: exercise.name.clone(),
        title: exercise.title.clone(),
        instructions: exercise.instructions.clone(),
        scene_names: exercise.scenes.clone(),
        time_limit_s: exercise.time_limit_s,
        force_limit_n: exercise.limits.force_n,
        pressure_limit_pa: exercise.limits.pressure_pa,
        strain_limit: exercise.limits.strain,
        coverage_pa: match exercise.coverage {
            Some(CoverageTask::Pressure(pressure_pa)) => Some(pressure_pa),
            // That of a lump follows from a tissue.
            Some(CoverageTask::Lump(_)) | None => None,
        },
        hides_truth: exercise.hides_truth(),
        seen_along: vector(exercise.seen_along),
        lines: exercise.lines.iter().map(line).collect(),
        avoided: exercise.avoid.iter().map(ball).collect(),
        lifted_m: exercise.lift.and_then(|lift| vector(lift.place_m)),
        live_measures: register::definitions()
            .filter(|definition| is_live(exercise, definition.name))
            .map(|definition| definition.name.to_owned())
            .collect(),
        tells_result: exercise.trainee.sees_result,
        phases: exercise.phases.iter().map(phase).collect(),
    }
}

/// Returns whether a trainee is sent a measure while the exercise goes on: none that needs the truth.
fn is_live(exercise: &Exercise, name: &str) -> bool {
    let needs_truth = register::find(name).is_none_or(register::needs_truth);
    let chosen = exercise.trainee.live_measures.as_ref();
    !needs_truth && chosen.is_none_or(|chosen| chosen.iter().any(|chosen| chosen == name))
}

/// Returns the exercise of a session as its trainer, or a trainee, may know it.
pub(super) fn of_session(live: &LiveExercise, is_trainee: bool) -> pb::SessionExercise {
    let role = if is_trainee { pb::ExerciseRole::Trainee } else { pb::ExerciseRole::Trainer };
    let known = exercise(&live.chosen.exercise);
    let felt_pa = live.chosen.noticed_pressure_pa;
    pb::SessionExercise {
        exercise: Some(pb::Exercise { coverage_pa: known.coverage_pa.or(felt_pa), ..known }),
        role: role.into(),
        trainee_id: if is_trainee { String::new() } else { live.trainee_id.clone() },
        seed: (!is_trainee).then_some(live.chosen.seed),
        begin_step: live.begin_step,
        finished: live.has_ended(),
    }
}

fn figure(figure: &Figure) -> pb::Figure {
    pb::Figure {
        measure: figure.definition.name.to_owned(),
        value: figure.value,
        unit: figure.definition.unit.to_owned(),
        tool: figure.tool,
    }
}

fn figures<'f>(figures: impl Iterator<Item = &'f Figure>) -> Vec<pb::Figure> {
    figures.map(figure).collect()
}

/// Returns the simulated time between two steps, s.
#[allow(clippy::cast_precision_loss)]
fn time_s(live: &LiveExercise, begin_step: u64, step: u64) -> f64 {
    step.saturating_sub(begin_step) as f64 / live.plain.scene.stepping.rate_hz
}

/// Returns the figures of a moment.
pub(super) fn moment(live: &LiveExercise, moment: &MomentFigures, is_trainee: bool) -> pb::WatchExerciseResponse {
    let exercise = &live.chosen.exercise;
    let told = |figure: &&Figure| !is_trainee || is_live(exercise, figure.definition.name);
    pb::WatchExerciseResponse {
        step: moment.step,
        time_s: time_s(live, live.begin_step, moment.step),
        figures: figures(moment.figures.iter().filter(told)),
        score_percent: moment.score.as_ref().filter(|_| !is_trainee).map(|score| score.percent),
        phase: u32::try_from(moment.phases.len()).unwrap_or(u32::MAX),
        phase_time_s: moment.phases.last().map_or(0.0, |phase| time_s(live, phase.begin_step, moment.step)),
        ..Default::default()
    }
}

/// Returns a lump that is hidden.
pub(super) fn lump(lump: &Lump) -> pb::HiddenLump {
    pb::HiddenLump { centre_m: vector(lump.centre_m), radius_m: lump.radius_m, stiffness_factor: lump.stiffness_factor }
}

/// Returns the result of an exercise.
pub(super) fn result(live: &LiveExercise, ended: &EndedExercise, is_trainee: bool) -> pb::ExerciseResult {
    let MomentFigures { step, figures: all, phases, score } = &ended.figures;
    let brief = pb::ExerciseResult { step: *step, time_s: time_s(live, ended.begin_step, *step), ..Default::default() };
    if is_trainee && !live.chosen.exercise.trainee.sees_result {
        return brief;
    }
    let criterion = |earned: &EarnedCriterion| pb::EarnedCriterion {
        measure: earned.criterion.measure.clone(),
        weight: earned.criterion.weight,
        poor: earned.criterion.poor,
        good: earned.criterion.good,
        value: earned.value,
        earned: earned.part,
        phase: earned.criterion.phase.unwrap_or(0),
    };
    let answer = |answer: &RecordedMark| pb::GivenAnswer {
        step: answer.step,
        tool: answer.tool,
        place_m: vector(answer.mark.place_m),
        diameter_m: answer.mark.diameter_m,
    };
    let phase = |phase: &PhaseFigures| pb::PhaseResult {
        begin_step: phase.begin_step,
        step: phase.end_step,
        time_s: time_s(live, phase.begin_step, phase.end_step),
        figures: figures(phase.figures.iter()),
    };
    pb::ExerciseResult {
        is_told: true,
        figures: figures(all.iter()),
        score_percent: score.as_ref().map(|score| score.percent),
        criteria: score.iter().flat_map(|score| score.criteria.iter().map(criterion)).collect(),
        lumps: live.chosen.lumps.iter().chain(&ended.added_lumps).map(lump).collect(),
        answers: ended.answers.iter().map(answer).collect(),
        phases: phases.iter().map(phase).collect(),
        ..brief
    }
}

/// Returns what a trainer tells.
pub(super) fn advice(advice: &TrainerAdvice) -> pb::Advice {
    pb::Advice { number: advice.number, text: advice.text.clone(), place_m: advice.place_m.and_then(vector) }
}
