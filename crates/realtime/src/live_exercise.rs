//! The exercise of a session, for the server's calls: what it hides, what readers are told of it, and what a trainee may learn of the
//! tissue.

use std::sync::Arc;

use glam::DVec3;
use tokio::sync::watch;

use super::law_cache::{LawCache, SoughtLaw};
use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::budget::Account;
use palpate_session::chosen_exercise::ChosenExercise;
use palpate_session::measured_run::{EndedExercise, MomentFigures};
use palpate_tissue::limits::Limits;
use palpate_tissue::response::force_law::Disc;
use palpate_tissue::{Cuts, Model};

/// The most advice that a session has.
pub const MAX_ADVICE: usize = 64;

/// The exercise that a new session is made for ([`Begin::exercise`](super::Begin::exercise)).
#[derive(Debug, Clone)]
pub struct SessionExercise {
    /// The exercise with its truth, which the session's tissue has in it.
    pub chosen: ChosenExercise,
    /// The ID that opens the session for a trainee; random, and no session's.
    pub trainee_id: String,
    /// The tissue without what is hidden: whatever a trainee learns of a tissue before touching it is of this one.
    pub plain: Arc<Model>,
    /// The result, if the exercise has ended before the session came to this server.
    pub ended: Option<EndedExercise>,
}

/// What a trainer tells a trainee.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainerAdvice {
    /// Its number, from 1.
    pub number: u32,
    /// The text; may be empty with a marker.
    pub text: String,
    /// A place of the surface at rest, m; `None` for a hint.
    pub place_m: Option<DVec3>,
}

/// What readers of an exercise are told: always the newest.
#[derive(Debug, Clone, Default)]
pub struct ExerciseNews {
    /// The newest figures; `None` before the first.
    pub measured: Option<Arc<MomentFigures>>,
    /// The phase that goes on, from 1; 0 for an exercise of one piece.
    pub phase: u32,
    /// All advice so far, by ascending number.
    pub advice: Vec<TrainerAdvice>,
    /// The result, once the exercise has ended.
    pub ended: Option<Arc<EndedExercise>>,
    /// Why no news will follow, because the session is gone.
    pub closed: Option<Refusal>,
}

/// The exercise of a session, for the server's calls.
pub struct LiveExercise {
    /// The exercise with its truth.
    pub chosen: ChosenExercise,
    /// The ID that opens the session for a trainee.
    pub trainee_id: String,
    /// The tissue without what is hidden.
    pub plain: Arc<Model>,
    /// Number of steps done when it began, also if it has ended before the session came to this server.
    pub begin_step: u64,
    plain_tissue: watch::Sender<(u64, Arc<Model>)>,
    plain_laws: LawCache,
    news: watch::Sender<ExerciseNews>,
}

impl LiveExercise {
    pub(super) fn new(SessionExercise { chosen, trainee_id, plain, ended }: SessionExercise, begin_step: u64) -> Self {
        // What had ended before the session came here keeps its own beginning.
        let begin_step = ended.as_ref().map_or(begin_step, |ended| ended.begin_step);
        let ended = ended.map(Arc::new);
        let measured = ended.as_ref().map(|ended| Arc::new(ended.figures.clone()));
        // The phases that had begun are in the result.
        let begun = measured.as_ref().map_or(1, |measured| measured.phases.len());
        let phase = begun.min(chosen.exercise.phases.len()) as u32;
        let news = watch::Sender::new(ExerciseNews { ended, measured, phase, ..ExerciseNews::default() });
        let plain_tissue = watch::Sender::new((begin_step, plain.clone()));
        let plain_laws = LawCache::default();
        LiveExercise { chosen, trainee_id, plain, begin_step, plain_tissue, plain_laws, news }
    }

    /// Returns a receiver of the news, which has the present ones.
    pub fn news(&self) -> watch::Receiver<ExerciseNews> {
        self.news.subscribe()
    }

    /// Returns whether the exercise has ended and its result is known.
    pub fn has_ended(&self) -> bool {
        self.news.borrow().ended.is_some()
    }

    /// Returns a receiver of the tissue without what is hidden, which never changes.
    pub fn plain_tissue(&self) -> watch::Receiver<(u64, Arc<Model>)> {
        self.plain_tissue.subscribe()
    }

    /// Returns the force law of the tissue without what is hidden, as [`SessionHandle::law`](super::SessionHandle::law) does.
    ///
    /// # Errors
    /// Refuses if the memory of a further law exceeds the part of `payer` or of the system.
    pub fn plain_law(&self, cuts: &Cuts, disc: Disc, limits: &Limits, payer: &Account) -> Result<Arc<SoughtLaw>> {
        self.plain_laws.of(disc, &self.plain, cuts, limits.law_work, payer)
    }

    /// Tells the trainee a text, with a marker at a place or without one. Both must have been checked.
    ///
    /// # Errors
    /// Refuses more than [`MAX_ADVICE`], and advice after the end ([`Reason::OutOfTurn`]).
    pub fn advise(&self, text: String, place_m: Option<DVec3>) -> Result<TrainerAdvice> {
        let mut told = Err(Refusal::new(Reason::OutOfTurn, "session_id", "is a session whose exercise has ended"));
        self.news.send_if_modified(|news| {
            if news.ended.is_some() {
                return false;
            }
            if news.advice.len() >= MAX_ADVICE {
                let message = format!("has had {MAX_ADVICE} hints and markers already");
                told = Err(Refusal::new(Reason::TooMany, "session_id", message));
                return false;
            }
            let number = u32::try_from(news.advice.len() + 1).unwrap_or(u32::MAX);
            let advice = TrainerAdvice { number, text: text.clone(), place_m };
            news.advice.push(advice.clone());
            told = Ok(advice);
            true
        });
        told
    }

    /// Tells that no news will follow.
    pub(super) fn close(&self, why: &Refusal) {
        self.news.send_modify(|news| news.closed = Some(why.clone()));
    }

    pub(super) fn tell_figures(&self, figures: MomentFigures) {
        self.news.send_modify(|news| news.measured = Some(Arc::new(figures)));
    }

    pub(super) fn tell_phase(&self, phase: u32) {
        self.news.send_modify(|news| news.phase = phase);
    }

    pub(super) fn tell_end(&self, ended: Arc<EndedExercise>) {
        self.news.send_modify(|news| {
            news.measured = Some(Arc::new(ended.figures.clone()));
            news.ended = Some(ended);
        });
    }
}
