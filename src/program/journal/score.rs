//! `palpate journal score`: simulates a journal again, and measures what its tools did.

use std::io::Write;
use std::path::PathBuf;

use palpate_exercise::Measures;
use palpate_refusal::printable::printable_json;
use palpate_session::journal::ReplayEvent;
use palpate_session::journal::exercise::ExerciseEvents;
use palpate_tissue::limits::Limits;

use super::super::score::exercise::{ExerciseOptions, usual_thresholds, warn, with_noticed_pressure};
use super::super::score::{Score, ScoreOptions, ScoreRecorder, ScoreSource, report};
use super::super::{Failure, with_progress, write_file};
use super::JournalSource;
use super::output::{output, utc, written};
use super::xapi::{self, XapiOptions};

#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
    palpate journal score session.1.mcap\n  \
    palpate journal score session.1.mcap --force-limit-n 2 --report session.html\n  \
    palpate journal score session.1.mcap --output session.json\n  \
    palpate journal score session.1.mcap --xapi session.xapi.json --actor mailto:ada@example.org --xapi-base https://example.org/simulation\n  \
    palpate journal compare *.json\n\n\
    The figures are those of `palpate run … --score` and have the same bits: the journal is simulated again. \
    docs/exercises.md has the formula and the source of each.\n\n\
    Exit status: 0; 1 when the simulation differs from the recording, or a file can't be written; 2 when the journal \
    can't be read, is damaged (the figures then end there), or an option was refused.")]
pub(super) struct ScoreArguments {
    #[command(flatten)]
    source: JournalSource,
    #[command(flatten)]
    options: ScoreOptions,
    #[command(flatten)]
    exercise: ExerciseOptions,
    /// Print the score as JSON instead of as a table
    #[arg(long)]
    json: bool,
    /// Write the score as JSON to this file, and print nothing
    #[arg(short, long, value_name = "FILE", conflicts_with = "json")]
    output: Option<PathBuf>,
    /// Write a report to print: one page with the force over time, a map of what was pressed, and each figure
    #[arg(long, value_name = "FILE.html")]
    report: Option<PathBuf>,
    #[command(flatten)]
    xapi: XapiOptions,
    /// Show no progress
    #[arg(short, long)]
    quiet: bool,
}

/// What a journal gave.
pub(super) struct MeasuredJournal {
    pub(super) score: Score,
    measures: Measures,
    /// When its recording began, ns after the beginning of 1970.
    began_unix_ns: u64,
    /// Whether its exercise has ended; also of a session that was made for none.
    has_ended: bool,
    /// Where it is damaged, and the last whole step.
    pub(super) damage: Option<(String, u64)>,
}

/// Simulates a journal again, and measures it. A session that was made for an exercise is judged by that.
pub(super) fn measure(
    source: &JournalSource,
    options: &ScoreOptions,
    exercise: &ExerciseOptions,
    quiet: bool,
) -> Result<MeasuredJournal, Failure> {
    let mut reader = source.open()?;
    let place = source.file.display().to_string();
    let chosen = exercise.recorded(&place, reader.header())?;
    // What was done after the end of the exercise does not count.
    let events = match reader.header().exercise {
        Some(_) => reader.exercise_events()?,
        None => ExerciseEvents::default(),
    };
    // Each step is a row, also where the tissue rests.
    let mut replay = source.replay(None)?.stopping_every(1);
    let (model, begin) = (replay.session().model().clone(), replay.session().step_count());
    let chosen = with_noticed_pressure(chosen, &model, &Limits::default())?;
    let options = options.checked(usual_thresholds(chosen.as_ref()))?;
    if let Some(chosen) = &chosen {
        warn(chosen, &model);
    }
    let has_ended = replay.header().exercise.is_none() || events.result.is_some();
    let mut recorder = ScoreRecorder::new(&model, begin, options, None, (chosen.as_ref(), events))?;
    recorder.see(replay.session());
    let last = replay.survey().until_step;
    with_progress("step", last, quiet, |progress| {
        replay.advance(u64::MAX, &mut |event| {
            if let ReplayEvent::Step(session) = event {
                recorder.see(session);
                if session.step_count().is_multiple_of(1024) {
                    progress(session.step_count());
                }
            }
            Ok(())
        })
    })?;
    if let Some(difference) = replay.difference() {
        return Err(Failure::Failed(format!("{}: {difference}", source.file.display())));
    }
    let survey = replay.survey();
    let began_unix_ns = survey.unix_ns[0];
    let damage = survey.damage.clone().map(|damage| (damage, survey.until_step));
    let name = source.file.file_name().map(|name| name.to_string_lossy().into_owned());
    let of = ScoreSource {
        scene: model.scene.name.clone(),
        script: None,
        journal: name,
        session_id: Some(replay.header().session_id.clone()),
        recorded: Some(utc(began_unix_ns)),
    };
    recorder.finish(replay.session());
    let (score, measures) = recorder.into_score(of, model.scene.stepping.rate_hz);
    Ok(MeasuredJournal { score, measures, began_unix_ns, has_ended, damage })
}

/// Measures a journal, and writes the score.
pub(super) fn score(arguments: &ScoreArguments) -> Result<(), Failure> {
    let ScoreArguments { source, options, exercise, json, output: file, report: page, xapi, quiet } = arguments;
    if xapi.xapi.is_some() && exercise.recorded(&source.file.display().to_string(), source.open()?.header())?.is_none()
    {
        return Err(xapi::needs_exercise().into());
    }
    let MeasuredJournal { score, measures, began_unix_ns, has_ended, damage } =
        measure(source, options, exercise, *quiet)?;
    if let Some(page) = page {
        write_file(page, report::page(&score, &measures)?.as_bytes())?;
    }
    if let Some(file) = &xapi.xapi {
        let statements = xapi::statements(&score, xapi, began_unix_ns, has_ended)?;
        write_file(file, (printable_json(format!("{statements:#}")) + "\n").as_bytes())?;
    }
    match file {
        Some(file) => score.write(file)?,
        None => {
            let text = if *json { score.json()? } else { score.table() };
            let mut out = output(None)?;
            written(out.write_all(text.as_bytes()).and_then(|()| out.flush()))?;
        }
    }
    damage.map_or(Ok(()), |(damage, until_step)| source.tell_damage(Some(&damage), until_step, None))
}
