//! Continues sessions from their journals, each at its last durable step: with its ID, its tools released, and
//! running if it was running.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::keeper::FolderContent;
use palpate_realtime::{Begin, Pacer, SessionExercise};
use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::chosen_exercise::ChosenExercise;
use palpate_session::journal::file::JournalFile;
use palpate_session::journal::{self, JournalReader, Replay, Resumed, Survey, pb};
use palpate_tissue::limits::Limits;
use palpate_tissue::lock::lock;
use palpate_tissue::select::scheme_selection::NEVER;

/// The result of continuing a session from its journals.
enum ResumeOutcome {
    /// It continues.
    Continued,
    /// It was deleted, moved to another server, or had nothing to continue yet.
    Ended,
    /// It can't be continued.
    Refused(Refusal),
}

/// Continues all sessions whose journals are in `folder` and have not ended, and logs those that can't be continued.
/// In a fleet, `own` holds the sessions that this server still owns, with their revisions; others stay as they are.
///
/// # Errors
/// Refuses a folder that can't be read.
pub(super) fn all(
    folder: &Path,
    own: Option<&BTreeMap<String, u64>>,
    pacer: &Pacer,
    limits: &Limits,
) -> Result<FolderContent> {
    let listed = list(folder)?;
    let mut by_session: BTreeMap<String, Vec<JournalFile>> = BTreeMap::new();
    for file in listed {
        by_session.entry(file.session_id.clone()).or_default().push(file);
    }
    let sessions: Vec<_> = by_session.into_iter().collect();
    let (next, found) = (AtomicUsize::new(0), Mutex::new(FolderContent::default()));
    let work = || {
        while let Some((id, files)) = sessions.get(next.fetch_add(1, Ordering::Relaxed)) {
            let revision = own.map_or(Some(0), |own| own.get(id).copied());
            let ended = (revision.map(|revision| one(files, revision, pacer, limits)), files.last());
            let mut found = lock(&found);
            found.runs.insert(id.clone(), ended.1.map_or(0, |file| file.run));
            let Some((outcome, newest)) = ended.0 else { continue };
            match outcome {
                ResumeOutcome::Continued | ResumeOutcome::Ended => {}
                ResumeOutcome::Refused(refusal) => {
                    let path = newest.path.display();
                    tracing::error!(session = %id, %path, "not continued: {refusal}; the file stays as it is");
                    found.left_alone.insert(newest.path.clone());
                }
            }
        }
    };
    let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get).min(sessions.len());
    std::thread::scope(|scope| {
        for index in 0..threads {
            let builder = palpate_realtime::priority::thread(format!("resume-{index}"));
            if builder.spawn_scoped(scope, work).is_err() {
                break;
            }
        }
        // If no thread could be started, this one does all the work.
        work();
    });
    let found = found.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
    Ok(found)
}

fn list(folder: &Path) -> Result<Vec<JournalFile>> {
    journal::file::list(folder).map_err(|error| {
        Refusal::new(Reason::Unreadable, "journal", format!("{}: can't be read: {error}", folder.display()))
    })
}

/// Returns whether `folder` has a journal from which a session can continue. An unreadable journal counts as one.
pub(super) fn can_go_on(folder: &Path, id: &str) -> bool {
    let files = list(folder).unwrap_or_default().into_iter().rev().filter(|file| file.session_id == id);
    for file in files {
        match JournalReader::open(&file.path).and_then(|mut reader| reader.survey(&mut |_| {})) {
            Ok(survey) => return !has_ended(&survey),
            Err(refusal) if refusal.reason == Reason::Missing => {}
            Err(_) => return true,
        }
    }
    false
}

/// Returns whether the session was deleted or moved to another server.
fn has_ended(survey: &Survey) -> bool {
    survey.end.as_ref().is_some_and(|end| [pb::Why::Deleted, pb::Why::Moved].contains(&end.why()))
}

/// Continues one session whose journals are in `folder`: from that run, or from the newest.
///
/// # Errors
/// Refuses if it can't be continued.
pub(super) fn session(
    folder: &Path,
    (id, run): (&str, Option<u64>),
    revision: u64,
    pacer: &Pacer,
    limits: &Limits,
) -> Result<()> {
    let mut files = list(folder)?;
    files.retain(|file| file.session_id == id && run.is_none_or(|run| file.run == run));
    if files.is_empty() {
        return Err(Refusal::new(Reason::UnknownSession, "session_id", "there is no journal of this session"));
    }
    match one(&files, revision, pacer, limits).0 {
        ResumeOutcome::Continued => Ok(()),
        ResumeOutcome::Ended => {
            Err(Refusal::new(Reason::SessionDeleted, "session_id", "its journal says that it is deleted"))
        }
        ResumeOutcome::Refused(refusal) => Err(refusal),
    }
}

/// Continues the session with these journals, sorted by run. Returns the journal that decided the result.
fn one<'f>(
    files: &'f [JournalFile],
    revision: u64,
    pacer: &Pacer,
    limits: &Limits,
) -> (ResumeOutcome, &'f JournalFile) {
    let mut newest = &files[files.len() - 1];
    for file in files.iter().rev() {
        newest = file;
        match continued(file, revision, pacer, limits) {
            Ok(outcome) => return (outcome, newest),
            // The server ended before anything of this run was on the disk: the run before has everything.
            Err(refusal) if refusal.reason == Reason::Missing => {}
            Err(refusal) => return (ResumeOutcome::Refused(refusal), newest),
        }
    }
    (ResumeOutcome::Ended, newest)
}

/// Returns the exercise of a session that continues. One that had not ended begins again.
fn exercise(
    chosen: ChosenExercise,
    resumed: &Resumed,
    ended: Option<&pb::ExerciseResult>,
    pacer: &Pacer,
) -> Result<SessionExercise> {
    let plain = pacer.plain_of(&chosen, &resumed.first, &NEVER)?;
    let trainee_id = resumed.header.exercise.as_ref().map(|exercise| exercise.trainee_id.clone()).unwrap_or_default();
    let ended = ended.map(|result| journal::exercise::from_result(result, &chosen));
    Ok(SessionExercise { chosen, trainee_id, plain, ended })
}

fn continued(file: &JournalFile, revision: u64, pacer: &Pacer, limits: &Limits) -> Result<ResumeOutcome> {
    let mut reader = JournalReader::open(&file.path)?;
    let survey = reader.survey(&mut |_| {})?;
    if has_ended(&survey) {
        return Ok(ResumeOutcome::Ended);
    }
    let until_step = survey.until_step;
    let chosen = journal::exercise::from_header(reader.place(), reader.header())?;
    let ended = if chosen.is_some() { reader.exercise_events()?.result } else { None };
    let mut resumed = Replay::near(reader, survey, limits, until_step)?.resume()?;
    let begin = Begin {
        id: file.session_id.clone(),
        first: resumed.first.clone(),
        running: resumed.running,
        until: resumed.until_step,
        idle_timeout_s: resumed.header.idle_timeout_s,
        playback: None,
        after_run: file.run,
        revision,
        waiting: std::mem::take(&mut resumed.waiting),
        frozen: false,
        recorded: true,
        exercise: chosen.map(|chosen| exercise(chosen, &resumed, ended.as_ref(), pacer)).transpose()?,
    };
    let owner = pacer.budget.account(&resumed.header.owner);
    let (step, torn_bytes) = (resumed.session.step_count(), resumed.survey.torn_bytes);
    let session = || {
        if let Some(model) = &resumed.pending {
            resumed.session.change(model);
        }
        resumed.session.let_go();
        Ok(resumed.session)
    };
    pacer.resume(begin, &owner, session, &NEVER)?;
    tracing::info!(session = %file.session_id, step, torn_bytes, run = file.run, "session continued");
    Ok(ResumeOutcome::Continued)
}
