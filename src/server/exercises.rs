//! `ExerciseService`: lists exercises; shows the measures of one that a session is made for, and ends it; passes on what the trainer
//! advises.

use std::pin::Pin;
use std::sync::Arc;

use futures_util::stream::{self, Stream};
use glam::DVec3;
use palpate_proto::geometry::from_vector;
use palpate_proto::pb;
use palpate_proto::pb::exercise_service_server::ExerciseService;
use palpate_realtime::{ExerciseNews, LiveExercise, StreamGuard, StreamKind};
use palpate_refusal::printable::printable;
use palpate_refusal::{Reason, Refusal, finite_vector};
use palpate_session::budget::Account;
use palpate_session::chosen_exercise::ChosenExercise;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::exercise::{Lump, MAX_PARTS};
use palpate_tissue::scene::{Body, Scene};
use tokio::sync::watch;
use tonic::{Request, Response, Status};
use tracing::info;

use super::catalog::Catalog;
use super::charged_caller::ChargedCaller;
use super::exercise_message::{self, advice, moment, result};
use super::job_pool::CancelFlag;
use super::services::Services;
use super::stream_termination::until_cut;
use palpate_realtime::ids::random_bits;

pub(super) struct Exercises(pub(super) Services);

/// The most bytes of a hint.
const MAX_ADVICE_BYTES: usize = 500;

/// A seed that the server draws is below this: every number below it is exact also where numbers are floats.
const SEEDS: u64 = 1 << 53;

/// Reads the exercise that a new session is made for, and its scene with the truth in it.
///
/// # Errors
/// Refuses an unknown exercise or scene, a text that is no exercise, one that was sent and changes the scene, and a truth that the scene
/// has no room for.
pub(super) fn chosen(
    request: &pb::ChosenExercise,
    catalog: &Catalog,
    limits: &Limits,
) -> Result<(ChosenExercise, Scene), Refusal> {
    use pb::chosen_exercise::Source;
    let (name, text, is_sent) = match &request.source {
        Some(Source::Name(name)) => {
            let (file, text) = catalog.exercise_text(name, limits)?;
            (file, text, false)
        }
        Some(Source::Text(text)) => ("the exercise".to_owned(), text.clone(), true),
        None => return Err(Refusal::new(Reason::Missing, "source", "name or text is missing")),
    };
    let seed = match request.seed {
        Some(seed) => seed,
        #[allow(clippy::cast_possible_truncation)]
        None => random_bits()? as u64 % SEEDS,
    };
    let chosen = ChosenExercise::new(&name, &text, Some(seed))?;
    if is_sent && !chosen.exercise.set.is_empty() {
        let message = "changes the scene, which only an exercise of the server may do";
        return Err(Refusal::new(Reason::WrongKind, "set", message));
    }
    let scene_name = if request.scene_name.is_empty() { &chosen.exercise.scenes[0] } else { &request.scene_name };
    let scene = catalog.load(scene_name, &chosen.assignments(), limits)?;
    if let Body::Solid(solid) = &scene.body
        && chosen.exercise.hides_truth()
        && !solid.gravity().is_at_rest()
    {
        let message = "hides lumps in a solid that sags as the session begins, which would show them: set `loaded = true` in its [gravity]";
        return Err(Refusal::new(Reason::WrongKind, "scene_name", message));
    }
    Ok((chosen, scene))
}

/// A running stream of news.
struct NewsStream {
    live: Arc<LiveExercise>,
    is_trainee: bool,
    news: watch::Receiver<ExerciseNews>,
    /// The number of the newest advice that was sent.
    advised: u32,
    is_first: bool,
    _guard: StreamGuard,
}

impl NewsStream {
    async fn next(mut self) -> Option<(Result<pb::WatchExerciseResponse, Status>, Option<NewsStream>)> {
        if !std::mem::take(&mut self.is_first) && self.news.changed().await.is_err() {
            return None;
        }
        let news = self.news.borrow_and_update().clone();
        let live = &self.live;
        let measured = news.measured.as_deref().map(|figures| moment(live, figures, self.is_trainee));
        let mut message = pb::WatchExerciseResponse {
            advice: news.advice.iter().filter(|advice| advice.number > self.advised).map(advice).collect(),
            result: news.ended.as_deref().map(|ended| result(live, ended, self.is_trainee)),
            ..measured.unwrap_or_else(|| pb::WatchExerciseResponse { step: live.begin_step, ..Default::default() })
        };
        // A phase has begun since these figures.
        if message.phase < news.phase {
            (message.phase, message.phase_time_s) = (news.phase, 0.0);
        }
        if news.ended.is_some() {
            return Some((Ok(message), None));
        }
        if let Some(why) = news.closed {
            return Some((Err(why.into()), None));
        }
        self.advised = news.advice.last().map_or(self.advised, |advice| advice.number);
        Some((Ok(message), Some(self)))
    }
}

#[tonic::async_trait]
impl ExerciseService for Exercises {
    type WatchExerciseStream = Pin<Box<dyn Stream<Item = Result<pb::WatchExerciseResponse, Status>> + Send>>;

    async fn list_exercises(
        &self,
        request: Request<pb::ListExercisesRequest>,
    ) -> Result<Response<pb::ListExercisesResponse>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let (catalog, config) = (self.0.catalog.clone(), self.0.config.clone());
        let list = move |_: &CancelFlag| catalog.exercises(&config.limits);
        let exercises = self.0.job_pool.work(&account, list).await?;
        let exercises = exercises.iter().map(exercise_message::exercise).collect();
        Ok(Response::new(pb::ListExercisesResponse { exercises }))
    }

    async fn watch_exercise(
        &self,
        request: Request<pb::WatchExerciseRequest>,
    ) -> Result<Response<Self::WatchExerciseStream>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let seat = self.0.seat("WatchExercise", &request.get_ref().session_id).await?;
        let live = seat.handle.live_exercise()?.clone();
        let guard = seat.handle.open_stream("WatchExercise", StreamKind::ReadsOnly, &account)?;
        let (cut, news, is_trainee) = (guard.cut().clone(), live.news(), seat.trainee.is_some());
        let news = NewsStream { live, is_trainee, news, advised: 0, is_first: true, _guard: guard };
        let out = stream::unfold(Some(news), |news| async move { news?.next().await });
        Ok(Response::new(until_cut(out, cut)))
    }

    async fn finish_exercise(
        &self,
        request: Request<pb::FinishExerciseRequest>,
    ) -> Result<Response<pb::FinishExerciseResponse>, Status> {
        let pb::FinishExerciseRequest { session_id, phase } = request.get_ref();
        let seat = self.0.seat("FinishExercise", session_id).await?;
        let ended = match phase {
            0 => Some(seat.handle.finish_exercise().await?),
            phase => seat.handle.finish_phase(*phase).await?,
        };
        let live = seat.handle.live_exercise()?;
        let result = ended.map(|ended| result(live, &ended, seat.trainee.is_some()));
        Ok(Response::new(pb::FinishExerciseResponse { result }))
    }

    async fn advise_trainee(
        &self,
        request: Request<pb::AdviseTraineeRequest>,
    ) -> Result<Response<pb::AdviseTraineeResponse>, Status> {
        let pb::AdviseTraineeRequest { session_id, text, place_m } = request.into_inner();
        let handle = self.0.session(&session_id).await?;
        let live = handle.live_exercise()?;
        if text.len() > MAX_ADVICE_BYTES {
            let message = format!("has {} bytes, more than {MAX_ADVICE_BYTES}", text.len());
            return Err(Refusal::new(Reason::TooLarge, "text", message).into());
        }
        if printable(&text) != text {
            return Err(Refusal::new(Reason::WrongKind, "text", "has a control character").into());
        }
        if text.is_empty() && place_m.is_none() {
            return Err(Refusal::new(Reason::Missing, "text", "is missing: a hint has a text, a marker a place").into());
        }
        let place_m = place_m.map(|place_m| from_vector(Some(&place_m)));
        if let Some(place_m) = place_m {
            handle.model.shape().check_place("place_m", place_m)?;
        }
        let told = live.advise(text, place_m)?;
        info!(session = %handle.id, number = told.number, "trainee advised");
        Ok(Response::new(pb::AdviseTraineeResponse { advice: Some(advice(&told)) }))
    }

    async fn hide_lump(&self, request: Request<pb::HideLumpRequest>) -> Result<Response<pb::HideLumpResponse>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let pb::HideLumpRequest { session_id, lump } = request.into_inner();
        let handle = self.0.session(&session_id).await?;
        let (chosen, seed) = (another_lump(handle.live_exercise()?, lump.as_ref())?, random_bits()? as u64);
        let (pacer, to_change) = (self.0.pacer.clone(), handle.clone());
        let hide = move |cancel: &CancelFlag| {
            let exercise = to_change.live_exercise()?;
            let lump = |added: &[Lump]| match chosen {
                _ if exercise.chosen.lumps.len() + added.len() >= MAX_PARTS => {
                    let message = format!("has {MAX_PARTS} lumps already");
                    Err(Refusal::new(Reason::TooMany, "session_id", message))
                }
                Some(lump) => Ok(lump),
                None => drawn_lump(exercise, added, seed),
            };
            pacer.add_lump(&to_change, lump, cancel.flag())
        };
        let (step, model) = self.0.job_pool.work(&account, hide).await??;
        info!(session = %handle.id, step, "lump hidden");
        let lump = model.scene.added_lumps.last().map(exercise_message::lump);
        Ok(Response::new(pb::HideLumpResponse { lump, step }))
    }
}

/// Reads the lump that a trainer chooses to hide; `None`: it is drawn.
///
/// # Errors
/// Refuses an exercise that hides no lumps ([`Reason::NotAvailable`]), one that has ended ([`Reason::OutOfTurn`]), and a lump without a
/// place.
fn another_lump(live: &LiveExercise, lump: Option<&pb::HiddenLump>) -> Result<Option<Lump>, Refusal> {
    if live.chosen.exercise.lumps.as_ref().is_none_or(|hidden| hidden.count[1] == 0) {
        let message = "is a session whose exercise hides no lumps";
        return Err(Refusal::new(Reason::NotAvailable, "session_id", message));
    }
    if live.has_ended() {
        return Err(Refusal::new(Reason::OutOfTurn, "session_id", "is a session whose exercise has ended"));
    }
    let read = |lump: &pb::HiddenLump| {
        let centre_m =
            lump.centre_m.as_ref().ok_or_else(|| Refusal::new(Reason::Missing, "lump.centre_m", "is missing"))?;
        Ok(Lump {
            centre_m: finite_vector("lump.centre_m", from_vector(Some(centre_m)))? + DVec3::ZERO,
            radius_m: lump.radius_m,
            stiffness_factor: lump.stiffness_factor,
        })
    };
    lump.map(read).transpose()
}

/// Draws another lump for an exercise, in which a trainer has hidden `added` already.
///
/// # Errors
/// Refuses a box without room for another one.
fn drawn_lump(live: &LiveExercise, added: &[Lump], seed: u64) -> Result<Lump, Refusal> {
    let ChosenExercise { exercise, lumps, .. } = &live.chosen;
    let others: Vec<Lump> = lumps.iter().chain(added).copied().collect();
    exercise.lumps.as_ref().and_then(|hidden| hidden.another(seed, &others)).ok_or_else(|| {
        Refusal::new(
            Reason::OutOfRange,
            "lump",
            "can't be drawn: the exercise's box has no room for another one; give its place",
        )
    })
}

/// Refuses exercises on a server of a fleet, where the trainee's ID would lead to no server.
///
/// # Errors
/// Refuses a request for an exercise ([`Reason::NotAvailable`]).
pub(super) fn check_no_fleet(request: &pb::CreateSessionRequest) -> Result<(), Refusal> {
    match request.source {
        Some(pb::create_session_request::Source::Exercise(_)) => {
            let message = "is not possible on a server of a fleet: a trainee could not find the session after a move";
            Err(Refusal::new(Reason::NotAvailable, "exercise", message))
        }
        _ => Ok(()),
    }
}

/// Creates a session for an exercise.
///
/// # Errors
/// Returns the refusals of [`chosen`], and those of [`Pacer::create_exercise`](palpate_realtime::Pacer::create_exercise).
pub(super) fn create(
    request: &pb::ChosenExercise,
    services: (&Catalog, &palpate_realtime::Pacer, &Limits),
    reservation: palpate_realtime::SessionReservation,
    how: (bool, f64),
    payer: &Account,
    cancel: &CancelFlag,
) -> Result<Arc<palpate_realtime::SessionHandle>, Refusal> {
    let (catalog, pacer, limits) = services;
    let (chosen, scene) = chosen(request, catalog, limits).map_err(|refusal| refusal.within("exercise"))?;
    pacer.create_exercise(reservation, &scene, chosen, how, payer, cancel.flag())
}
