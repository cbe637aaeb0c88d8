//! `palpate run`: plays a script on a scene, or indents it, offline.

use std::io::{IsTerminal, Write};
use std::path::PathBuf;

use palpate_realtime::clock::now_ns;
use palpate_session::Session;
use palpate_session::journal::exercise::ExerciseEvents;
use palpate_session::run::{RunEvent, RunOptions, run_observed, write_event};
use palpate_session::simulation::SimulationFailure;
use palpate_tissue::scene::collection::find_script;
use palpate_tissue::scene::record::{self, StageTime, Summary, TopologyRecord};

use super::indent::{self, IndentArguments};
use super::scene::SceneArguments;
use super::score::exercise::{ExerciseOptions, compile, phase_ends, usual_thresholds, with_noticed_pressure};
use super::score::{ScoreOptions, ScoreRecorder, ScoreSource, report};
use super::{Failure, clock_s, say, with_progress, write_file};

#[derive(clap::Args)]
pub(crate) struct RunArguments {
    #[command(flatten)]
    scene: SceneArguments,
    /// A script file, or the name of one that is in ./scripts or built in: `press`, `stroke`, …; or `indent`: press a tip
    /// into the tissue and print its force over its depth
    script: PathBuf,
    #[command(flatten)]
    indent: IndentArguments,
    /// Write the records here instead of to the standard output
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Hold forces and paths constant within each step, like a client that sends one command per step
    #[arg(long)]
    held: bool,
    /// Play the script a second time in parallel, in f64 with a quarter of the substep and all points awake. The
    /// summary then has audited_error: the largest difference of displacement and of force at the sample points and
    /// times, each relative to its largest. With [stepping] correct = true, the run is corrected where an error
    /// exceeds the tolerance
    #[arg(long)]
    audit: bool,
    /// Plot displacement and force of the first tool with a tip, or of the first point, in the terminal: on a sheet
    /// along z, on a mesh their magnitudes; without --output the records are then not written to a terminal
    #[arg(long)]
    plot: bool,
    /// Measure how long each stage of a step takes: the summary then has `stages`
    #[arg(long)]
    profile: bool,
    /// Measure what the tools do, and write the score here, as JSON: `measures` has name, value and unit of each figure
    /// (docs/exercises.md)
    #[arg(long, value_name = "FILE")]
    score: Option<PathBuf>,
    /// Measure what the tools do, and write a report to print: one page with the force over time, a map of what was pressed, and each figure
    #[arg(long, value_name = "FILE.html")]
    report: Option<PathBuf>,
    #[command(flatten)]
    score_options: ScoreOptions,
    #[command(flatten)]
    exercise: ExerciseOptions,
    /// Show no progress and no summary
    #[arg(short, long)]
    quiet: bool,
}

/// Plays a script on a scene and writes its records.
pub(crate) fn run_script(arguments: &RunArguments) -> Result<(), Failure> {
    let chosen = arguments.exercise.chosen()?;
    arguments.exercise.warn_of_name(chosen.as_ref());
    let (model, limits) = compile(chosen.as_ref(), &arguments.scene)?;
    let chosen = with_noticed_pressure(chosen, &model, &limits)?;
    let options = arguments.score_options.checked(usual_thresholds(chosen.as_ref()))?;
    let measured = [("--score", &arguments.score), ("--report", &arguments.report)];
    let measured = measured.into_iter().find(|(_, file)| file.is_some()).map(|(option, _)| option);
    if measured.is_none() {
        let of_exercise = chosen.as_ref().map(|_| "--exercise");
        if let Some(option) = arguments.score_options.given().or(of_exercise) {
            let message =
                format!("{option}: goes with --score FILE or --report FILE alone: without them nothing is measured");
            return Err(Failure::Refused(message));
        }
    }
    if arguments.script.as_os_str() == indent::NAME {
        if let Some(option) = measured {
            return Err(Failure::Refused(format!("{option}: goes with a script, not with `{}`", indent::NAME)));
        }
        return indent::run(&arguments.indent, &model, &limits, arguments.output.as_deref(), arguments.quiet);
    }
    arguments.indent.refuse_without_indent()?;
    let script = find_script(&arguments.script, &model.scene, &limits)?;
    for warning in model.warnings.iter().chain(&script.warnings) {
        say!("palpate: warning: {warning}");
    }
    let mut recorder = if measured.is_some() {
        let continuous = (!arguments.held).then_some(&script);
        let events = ExerciseEvents { phase_ends: phase_ends(&script, chosen.as_ref())?, result: None };
        Some(ScoreRecorder::new(&model, 0, options, continuous, (chosen.as_ref(), events))?)
    } else {
        None
    };
    let mut output = record::output(arguments.output.as_deref(), arguments.plot)?;
    let ended = with_progress("step", script.steps, arguments.quiet, |progress| {
        let profile = arguments.profile.then_some(now_ns as fn() -> u64);
        let options = RunOptions { held: arguments.held, audit: arguments.audit, profile };
        let mut observe = |session: &Session| {
            if let Some(recorder) = &mut recorder {
                recorder.see(session);
                if session.step_count() == script.steps {
                    recorder.finish(session);
                }
            }
        };
        let tell = &mut |event: RunEvent<'_>| write_event(&mut output, progress, event);
        run_observed(&model, &script, options, &limits, &clock_s, tell, &mut observe)
    });
    let ended = ended.and_then(|summary| output.flush().map(|()| summary).map_err(SimulationFailure::Output));
    match ended {
        // A reader that closed the pipe is not an error.
        Err(SimulationFailure::Output(e)) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        Err(failure) => Err(failure.into()),
        Ok(summary) => {
            let mut table = String::new();
            if let Some(recorder) = recorder {
                let (scene, script) = (model.scene.name.clone(), Some(script.name.clone()));
                let source = ScoreSource { scene, script, ..ScoreSource::default() };
                let (score, measures) = recorder.into_score(source, model.scene.stepping.rate_hz);
                if let Some(path) = &arguments.score {
                    score.write(path)?;
                }
                if let Some(path) = &arguments.report {
                    write_file(path, report::page(&score, &measures)?.as_bytes())?;
                }
                table = score.table();
            }
            tell(arguments, &summary, &table);
            for warning in &summary.warnings {
                say!("palpate: warning: {warning}");
            }
            summary.fault().map_or(Ok(()), |fault| Err(Failure::Failed(fault)))
        }
    }
}

/// Prints the plot, the summary and the table of the score on the output that the records do not use. Without a file for the records, summary
/// and table are printed only on a terminal, not to a program that reads the records.
fn tell(arguments: &RunArguments, summary: &Summary, table: &str) {
    let to_file = arguments.output.is_some();
    let mut text = if arguments.plot { format!("{}\n", summary.curves) } else { String::new() };
    if !arguments.quiet && (to_file || std::io::stderr().is_terminal()) {
        let rows = [
            ("steps", format!("{} in {:.2} s", summary.steps, summary.wall_s)),
            ("largest displacement", format!("{:.6} m", summary.largest_displacement_m)),
            ("peak reaction", format!("{:.6} N", summary.peak_reaction_n)),
            ("final hash", summary.final_hash.clone()),
        ];
        let cuts = summary.topology.filter(|topology| topology.severed > 0).map(|topology| {
            let TopologyRecord { severed, severed_anchors, pieces, fracture_j, .. } = topology;
            let anchors = if severed_anchors > 0 { format!(", anchors: {severed_anchors}") } else { String::new() };
            ("severed", format!("{severed}{anchors}, pieces: {pieces}, fracture: {fracture_j:.3e} J"))
        });
        text.extend(rows.into_iter().chain(cuts).map(|(name, value)| format!("{name:<28}{value}\n")));
        let all_s: f64 = summary.stages.iter().map(|stage| stage.time_s).sum();
        for StageTime { stage, time_s } in summary.stages.iter().filter(|stage| stage.time_s > 0.0) {
            let (share, name) = (100.0 * time_s / all_s, format!("stage {stage}"));
            text += &format!("{name:<28}{:.2} ms, {share:.1} %\n", 1e3 * time_s);
        }
        text += table;
    }
    // A closed output does not end the program.
    let _ = if to_file {
        std::io::stdout().write_all(text.as_bytes())
    } else {
        std::io::stderr().write_all(text.as_bytes())
    };
}
