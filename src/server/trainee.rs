//! What a trainee's client gets of a session that is made for an exercise: the one place that decides it.
//!
//! A session that is made for an exercise has two IDs, both of 128 random bits. Its own is that of the trainer, who has created it. The
//! other one opens it for a trainee, with the role that a call needs in any case. [`TRAINEE_CALLS`] has the calls that it opens; every
//! other call is refused, also one that is added later. What follows from the whole tissue (scene, integrator, force laws) comes from the
//! tissue without what is hidden. Samples, frames and local models are those of the tissue: a trainee feels and sees it by touching.

use std::sync::Arc;

use palpate_realtime::{LiveExercise, SessionHandle};
use palpate_refusal::{Reason, Refusal, Result};
use tonic::Extensions;

use super::revocation::Tenure;

/// When a call may be made with a trainee's ID.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TraineeMay {
    /// Always: its answer shows nothing that is hidden.
    Always,
    /// If the exercise hides nothing: the answer shows the whole tissue.
    UnlessHidden,
}

use TraineeMay::{Always, UnlessHidden};

/// The calls, by the names of their methods, that a trainee's ID opens.
pub(super) const TRAINEE_CALLS: &[(&str, TraineeMay)] = &[
    // What is felt by touching.
    ("AcquireTool", Always),
    ("OpenDatagrams", Always),
    ("ReleaseTool", Always),
    ("SendCommands", Always),
    ("Touch", Always),
    ("WatchSamples", Always),
    // What is seen: the surface, its image, and what was severed or burnt.
    ("GetBurns", Always),
    ("GetMesh", Always),
    ("GetTexture", Always),
    ("GetTopology", Always),
    ("GetWound", Always),
    ("WatchFrames", Always),
    // The session without what is hidden; its time, so that the trainee can begin; the exercise.
    ("FinishExercise", Always),
    ("GetSession", Always),
    ("ListScripts", Always),
    ("StartSession", Always),
    ("WatchExercise", Always),
    // The motion of every point, the state and its hash, by which a guess of the truth could be checked.
    ("GetScript", UnlessHidden),
    ("GetStateHash", UnlessHidden),
    ("Probe", UnlessHidden),
    ("SaveSnapshot", UnlessHidden),
];

/// A session as the ID shows it that a caller has sent.
#[derive(Clone)]
pub(super) struct Seat {
    /// The session.
    pub(super) handle: Arc<SessionHandle>,
    /// The exercise, if the ID is the trainee's.
    pub(super) trainee: Option<Arc<LiveExercise>>,
}

impl Seat {
    /// Returns the seat of a session's own ID.
    pub(super) fn of_trainer(handle: Arc<SessionHandle>) -> Self {
        Seat { handle, trainee: None }
    }

    /// Returns the trainee's seat in a session, for a call.
    ///
    /// # Errors
    /// Refuses a call that the trainee's ID does not open ([`Reason::NotForTrainee`]).
    pub(super) fn of_trainee(handle: Arc<SessionHandle>, call: &str) -> Result<Self> {
        let exercise = handle.live_exercise()?.clone();
        let hides = exercise.chosen.exercise.hides_truth();
        let may = TRAINEE_CALLS.iter().find(|known| known.0 == call).map(|known| known.1);
        match may {
            Some(Always) => {}
            Some(UnlessHidden) if !hides => {}
            Some(UnlessHidden) => {
                return Err(refused("shows more of the tissue than a trainee may know before the end"));
            }
            None => return Err(refused("does not open this call: it is for the trainer, with the session's own ID")),
        }
        Ok(Seat { handle, trainee: Some(exercise) })
    }

    /// Returns the exercise if something of the tissue is hidden from the caller.
    pub(super) fn hidden(&self) -> Option<&Arc<LiveExercise>> {
        self.trainee.as_ref().filter(|exercise| exercise.chosen.exercise.hides_truth())
    }
}

fn refused(what: &str) -> Refusal {
    Refusal::new(Reason::NotForTrainee, "session_id", format!("is a trainee's, which {what}"))
}

/// Returns the refusal of a trainee's ID by a call that has no use for it.
pub(super) fn not_for_trainee() -> Refusal {
    refused("does not open this call: it is for the trainer, with the session's own ID")
}

/// Returns the exercise of a session whose own ID a list must not tell: without authentication everybody may ask for the list, trainees
/// too.
pub(super) fn unlisted<'h>(handle: &'h SessionHandle, extensions: &Extensions) -> Option<&'h Arc<LiveExercise>> {
    let hides = |exercise: &&Arc<LiveExercise>| exercise.chosen.exercise.hides_truth();
    handle.exercise.as_ref().filter(hides).filter(|_| !is_authenticated(extensions))
}

/// Returns whether the server knows who has made a call.
pub(super) fn is_authenticated(extensions: &Extensions) -> bool {
    extensions.get::<Tenure>().is_some()
}

/// Returns the refusal to play, for a caller whom the server does not know, what an exercise hides: everybody may ask for the list of
/// sessions, and so for the scene of the new one.
pub(super) fn shows_hidden() -> Refusal {
    let message = "is of an exercise, and shows what it hides to everybody: that needs a server with tokens (docs/security.md), or the \
                   journal's file and `palpate journal`";
    Refusal::new(Reason::NotForTrainee, "session_id", message)
}

#[cfg(test)]
mod tests {
    use super::super::identity::CALLS;
    use super::*;

    #[test]
    fn the_calls_of_a_trainee_are_calls_of_the_protocol_and_none_is_of_administration_or_creation() {
        assert!(TRAINEE_CALLS.iter().all(|(name, _)| {
            let of_name = |call: &&(&str, _)| call.0.rsplit('/').next() == Some(*name);
            CALLS.iter().filter(of_name).count() == 1
        }));
        for never in [
            "UpdateTissue",
            "GetJournal",
            "DeleteSession",
            "PauseSession",
            "AdviseTrainee",
            "HideLump",
            "CreateSession",
        ] {
            assert!(TRAINEE_CALLS.iter().all(|known| known.0 != never), "{never}");
        }
    }
}
