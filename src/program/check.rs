//! `palpate check`: reports the cost and the expected behaviour of a scene.

use std::io::Write;
use std::path::PathBuf;

use palpate_refusal::printable::printable_lines;
use palpate_session::check;
use palpate_session::chosen_exercise::ChosenExercise;
use palpate_session::exercise_judge::ExerciseJudge;
use palpate_tissue::Model;
use palpate_tissue::scene::collection::find_script;
use palpate_tissue::scene::exercise::CoverageTask;

use super::scene::{SceneArguments, compile_with};
use super::score::exercise::{self, ExerciseOptions};
use super::{Failure, clock_s, say};

#[derive(clap::Args)]
pub(crate) struct CheckArguments {
    #[command(flatten)]
    scene: SceneArguments,
    /// A script to check with it: a file, or the name of one that is in ./scripts or built in: `press`, `stroke`, …
    script: Option<PathBuf>,
    #[command(flatten)]
    exercise: ExerciseOptions,
}

/// Fractions of the vertices that are tried, from the smallest change. One vertex less leaves out the worst.
const TRIED: [f64; 6] = [1.0, 0.99, 0.95, 0.9, 0.75, 0.5];

/// Largest duration of a step, as a fraction of its duration before.
const WORTH_IT: f64 = 0.8;

/// Returns a tested change that makes the steps of a mesh with a few fast vertices cheaper; `None` if there is none.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
fn advice(arguments: &SceneArguments, model: &Model) -> Option<String> {
    if !model.scene.body.kind().has_fast_point() {
        return None;
    }
    let before_s = model.predicted_step_s();
    let mut tried = Vec::new();
    for part in TRIED {
        let vertices = ((model.len() as f64 * part) as usize).min(model.len() - 1);
        tried.push(vertices);
        let Ok((coarser, _)) = compile_with(arguments, &[format!("mesh.vertices={vertices}")]) else { continue };
        let after_s = coarser.predicted_step_s();
        if after_s < WORTH_IT * before_s {
            let ([from, to], [from_ms, to_ms]) =
                ([model.plan.substeps, coarser.plan.substeps], [before_s, after_s].map(|s| s * 1e3));
            let more =
                if coarser.scene.body.kind().has_fast_point() { "; other vertices are still as fast" } else { "" };
            return Some(format!(
                "vertices = {vertices} in [mesh] takes {to} substeps in place of {from}, and about {to_ms:.2} ms a step in place of \
                 {from_ms:.2}{more}"
            ));
        }
    }
    let tried: Vec<String> = tried.iter().map(ToString::to_string).collect();
    Some(format!("none of vertices = {} in [mesh] makes a step much cheaper", tried.join(", ")))
}

/// Describes a valid exercise in a line.
fn exercise_row(chosen: &ChosenExercise) -> String {
    let ChosenExercise { exercise, lumps, seed, .. } = chosen;
    let of = |count: usize, one: &str| format!("{count} {one}{}", if count == 1 { "" } else { "s" });
    let mut parts = vec![format!("{} with seed {seed}", of(lumps.len(), "lump"))];
    parts.extend(exercise.time_limit_s.map(|limit_s| format!("{limit_s} s")));
    let limits = chosen.thresholds().limits;
    parts.extend(limits.given().map(|(kind, limit)| {
        let (name, unit) = kind.name_and_unit();
        format!("{name} at most {limit}{unit}")
    }));
    if !exercise.phases.is_empty() {
        parts.push(of(exercise.phases.len(), "phase"));
    }
    let weight: f64 = exercise.criteria.iter().map(|criterion| criterion.weight).sum();
    parts.push(format!(
        "{} of weight {weight} in all",
        of(exercise.criteria.len(), "criterion").replace("criterions", "criteria")
    ));
    let felt = match (exercise.coverage, chosen.noticed_pressure_pa) {
        (Some(CoverageTask::Lump(lump)), Some(pressure_pa)) => format!(
            "coverage      from {pressure_pa:.0} Pa on: a tip of {:.1} mm radius feels with {:.2} N a lump {:.1} mm wide, {} \
             times as stiff, {:.1} mm below\n",
            1e3 * lump.tip_radius_m,
            pressure_pa * std::f64::consts::PI * lump.tip_radius_m * lump.tip_radius_m,
            2e3 * lump.radius_m,
            lump.stiffness_factor,
            1e3 * lump.depth_m
        ),
        _ => String::new(),
    };
    format!("exercise      {}, valid: {}\n{felt}", exercise.name, parts.join(", "))
}

/// Reports the cost and the expected behaviour of a scene.
pub(crate) fn check(arguments: &CheckArguments) -> Result<(), Failure> {
    let chosen = arguments.exercise.chosen()?;
    arguments.exercise.warn_of_name(chosen.as_ref());
    let (model, limits) = exercise::compile(chosen.as_ref(), &arguments.scene)?;
    let chosen = exercise::with_noticed_pressure(chosen, &model, &limits)?;
    if let Some(chosen) = &chosen {
        ExerciseJudge::new(&chosen.exercise, chosen.lumps.clone(), &model, 0)?;
    }
    let script = arguments.script.as_ref().map(|path| find_script(path, &model.scene, &limits)).transpose()?;
    if let Some(script) = &script {
        exercise::phase_ends(script, chosen.as_ref())?;
    }
    for warning in script.iter().flat_map(|script| &script.warnings) {
        say!("palpate: warning: {warning}");
    }
    let of_exercise = chosen.as_ref().map_or(String::new(), exercise_row);
    let report = check::check(&model, script.as_ref(), &limits, &clock_s);
    let advice = advice(&arguments.scene, &model).map_or(String::new(), |advice| format!("\nadvice: {advice}\n"));
    match write!(std::io::stdout(), "{}", printable_lines(format_args!("{of_exercise}{report}{advice}"))) {
        // A reader that closed the pipe is not an error.
        Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => Err(Failure::Failed(e.to_string())),
        _ => Ok(()),
    }
}
