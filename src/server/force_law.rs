//! The force laws of a haptic stream: the force on a tool's tip as a function of its depth, which the client
//! evaluates locally. A stream starts with a coarse law that is available immediately, and gets the exact one when it
//! is computed. Both are computed anew when the tissue changes, and when the tool has moved to a place with another
//! law ([`Disc::follow_cut`]). Near a cut they are those of the cut tissue, and computed anew when more is severed; until then the stream
//! keeps the law of before.

use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use glam::DVec3;
use tokio::sync::{mpsc, watch};
use tokio::time::Instant;
use tokio_util::task::AbortOnDropHandle;
use tonic::Status;
use tonic_types::StatusExt;
use tracing::{Instrument, debug};

use super::job_pool::{CancelFlag, JobPool, Urgency};
use super::trainee::Seat;
use palpate_haptics::{Law, Tip, TipShape};
use palpate_proto::{pb, touch};
use palpate_realtime::law_cache::{SoughtLaw, have_same_laws};
use palpate_session::Sample;
use palpate_session::budget::Account;
use palpate_session::current_laws::{FIRST, Laws};
use palpate_tissue::response::force_law::{self, Disc};
use palpate_tissue::{Cuts, Model};

/// After computing the laws of a place, the pause before those of the next place is this multiple of the time they
/// took, but at most `LONGEST_PAUSE`.
const PAUSES: u32 = 3;
const LONGEST_PAUSE: Duration = Duration::from_secs(2);

/// Distance, in tip radii, below which a new place of the tool is ignored: its law is nearly equal.
const NEWS_IN_RADII: f64 = 0.25;

/// A new law for a stream, or the reason why there is none.
struct LawUpdate {
    /// The number of the law that is replaced, or that stays in use.
    before: u32,
    /// The step from whose beginning a changed tissue acts, if that is the cause.
    tissue_step: Option<u64>,
    law: Result<(u32, Arc<Law>), Status>,
}

/// What a tool presses.
#[derive(Debug, Clone, Copy, PartialEq)]
struct PressedPlace {
    /// The point of the surface at rest, m.
    rest_m: DVec3,
    /// The version of the topology.
    topology_version: u32,
}

/// The updates of a stream's force law after its opening, and the place of its tool.
pub(super) struct Updates {
    told: mpsc::Receiver<LawUpdate>,
    laws: Arc<Laws>,
    /// The tool that the laws are computed for: the first of the stream's tools.
    tool: Option<u32>,
    tip: Disc,
    place: watch::Sender<Option<PressedPlace>>,
}

impl Updates {
    /// Sets the place of the next laws to where the tool presses in `sample`.
    pub(super) fn follow(&self, sample: &Sample) {
        let of_tool = sample.tools.iter().find(|tool| Some(tool.tool) == self.tool);
        let feel = of_tool.and_then(|tool| tool.feel.as_ref());
        let Some(rest_m) = feel.and_then(|feel| self.tip.pressed_m(feel)) else { return };
        let topology_version = sample.topology_version;
        let is_far = |told_m: DVec3| told_m.distance(rest_m) > NEWS_IN_RADII * self.tip.radius_m;
        self.place.send_if_modified(|told| {
            let is_news = told.is_none_or(|told| is_far(told.rest_m) || told.topology_version != topology_version);
            if is_news {
                *told = Some(PressedPlace { rest_m, topology_version });
            }
            is_news
        });
    }

    /// Polls for the next message, whose law later samples use: no sample can refer to a law before its message.
    /// `None`: no message will follow.
    pub(super) fn poll(&mut self, context: &mut Context<'_>) -> Poll<Option<pb::ForceLawUpdate>> {
        let Some(LawUpdate { before, tissue_step, law }) = ready!(self.told.poll_recv(context)) else {
            return Poll::Ready(None);
        };
        Poll::Ready(Some(match law {
            Ok((number, law)) => {
                let update = touch::law_update(before, tissue_step, Ok((number, &law)));
                self.laws.change(number, law);
                update
            }
            Err(status) => {
                let reason = status.get_details_error_info().map_or(String::new(), |info| info.reason);
                touch::law_update(before, tissue_step, Err((&reason, status.message())))
            }
        }))
    }
}

/// The law that was last sent to the stream.
struct Known {
    number: u32,
    /// The tissue that the law describes, or that has no law.
    model: Arc<Model>,
    /// The place that the law describes, and the version of the topology if it notices what is severed.
    disc: Disc,
    topology_version: Option<u32>,
    /// Whether the exact law is still to come.
    is_coarse: bool,
    /// Whether laws of other places can be computed. A sheet has only exact ones, so none if one of them can't be
    /// computed.
    has_places: bool,
}

/// Computes the laws of a stream in the job pool.
struct Maker {
    job_pool: JobPool,
    account: Account,
    seat: Seat,
    shape: TipShape,
}

impl Maker {
    /// Returns the law of the stream's tip, from that of a disc.
    fn of_tip(&self, law: Arc<Law>, model: &Model, disc: Disc) -> Arc<Law> {
        if !self.shape.is_rigid() {
            return law;
        }
        Arc::new(force_law::of_tip(model, Law::clone(&law), self.shape, disc.radius_m))
    }

    /// Returns the law of `disc`: for a caller from whom something is hidden, that of the tissue without it.
    fn sought(&self, model: &Arc<Model>, cuts: &Cuts, disc: Disc) -> Result<Arc<SoughtLaw>, Status> {
        let law = match self.seat.hidden() {
            Some(_) => self.seat.handle.plain_law(cuts, disc),
            None => self.seat.handle.law(model, cuts, disc),
        };
        Ok(law?)
    }

    /// Computes the first law of `disc`: at most 50 ms of work, on a whole tissue.
    async fn first(&self, model: &Arc<Model>, cuts: &Cuts, disc: Disc) -> Result<Arc<Law>, Status> {
        let sought = self.sought(model, cuts, disc)?;
        let law = self.job_pool.work_as(Urgency::Law, &self.account, move |stop| sought.first(stop.flag())).await??;
        Ok(self.of_tip(law, model, disc))
    }

    /// Computes the exact law of `disc`, depth by depth. Between two depths other work can run, also of this caller.
    async fn exact(&self, model: &Arc<Model>, cuts: &Cuts, disc: Disc) -> Result<Arc<Law>, Status> {
        let sought = self.sought(model, cuts, disc)?;
        let _turn = sought.turn().await;
        let mut computation = None;
        loop {
            if let Some(exact) = sought.exact() {
                return Ok(self.of_tip(exact?, model, disc));
            }
            let sought: Arc<SoughtLaw> = sought.clone();
            let advance = move |stop: &CancelFlag| sought.advance(computation, stop.flag());
            computation = self.job_pool.work_as(Urgency::BetterLaw, &self.account, advance).await?;
        }
    }

    /// Sends the laws of `model`, the tissue since `step`, that the stream does not have yet, at the place of its
    /// tool.
    async fn tell(
        &self,
        known: &mut Known,
        step: u64,
        model: &Arc<Model>,
        place: Option<PressedPlace>,
        tell: &mpsc::Sender<LawUpdate>,
    ) {
        let is_other = !have_same_laws(&known.model, model);
        let place = place.filter(|_| known.has_places || is_other);
        let cuts = self.seat.handle.status().cuts.clone();
        let (disc, notices) = match place {
            Some(PressedPlace { rest_m, .. }) => known.disc.follow_cut(model, &cuts, rest_m),
            None => (known.disc, known.topology_version.is_some()),
        };
        let cuts = if notices { cuts } else { Cuts::default() };
        let topology_version = notices.then(|| cuts.version());
        if is_other || disc != known.disc || topology_version != known.topology_version {
            // The coarse law of a uniform tissue is computed in its middle.
            let is_exact = !is_other && !notices && model.shape().is_uniform();
            let law =
                if is_exact { self.exact(model, &cuts, disc).await } else { self.first(model, &cuts, disc).await };
            let (is_coarse, has_places) = (law.as_ref().is_ok_and(|law| law.is_coarse), !is_exact || law.is_ok());
            self.say(known, is_other.then_some(step), law, tell).await;
            let (number, model) = (known.number, model.clone());
            *known = Known { number, model, disc, topology_version, is_coarse, has_places };
        }
        if known.is_coarse {
            let law = self.exact(model, &cuts, disc).await;
            known.has_places = law.is_ok() || !model.shape().is_uniform();
            self.say(known, None, law, tell).await;
            known.is_coarse = false;
        }
    }

    async fn say(
        &self,
        known: &mut Known,
        tissue_step: Option<u64>,
        law: Result<Arc<Law>, Status>,
        tell: &mpsc::Sender<LawUpdate>,
    ) {
        if let Err(status) = &law {
            debug!(session = %self.seat.handle.id, message = status.message(), "a force law can't be had");
        }
        let number = known.number.wrapping_add(u32::from(law.is_ok()));
        // The stream may have ended; then the update is dropped.
        let _ = tell.send(LawUpdate { before: known.number, tissue_step, law: law.map(|law| (number, law)) }).await;
        known.number = number;
    }
}

/// The running computation of a stream's laws.
pub(super) struct Computing {
    maker: Maker,
    tissue: watch::Receiver<(u64, Arc<Model>)>,
    known: Known,
}

impl Computing {
    /// Computes the first law for a stream of a session with the tip `tip`. Returns it with the computation of the later laws.
    ///
    /// # Errors
    /// Returns an error if no law can be computed now: for lack of memory, work or time.
    pub(super) async fn begin(
        job_pool: &JobPool,
        account: &Account,
        seat: &Seat,
        Tip { shape, radius_m, .. }: Tip,
    ) -> Result<(Arc<Law>, Self), Status> {
        let mut tissue = seat.hidden().map_or_else(|| seat.handle.tissue(), |exercise| exercise.plain_tissue());
        let model = tissue.borrow_and_update().1.clone();
        let maker = Maker { job_pool: job_pool.clone(), account: account.clone(), seat: seat.clone(), shape };
        let disc = Disc::in_middle(&model, radius_m);
        // That of the whole tissue: where the tool presses is not known yet.
        let law = maker.first(&model, &Cuts::default(), disc).await?;
        let is_coarse = law.is_coarse;
        let known = Known { number: FIRST, model, disc, topology_version: None, is_coarse, has_places: true };
        Ok((law, Computing { maker, tissue, known }))
    }

    /// Starts a task that sends the exact law, and the laws of changed tissues and of the places of `tool`, until the
    /// returned handle is dropped. A newer tissue stops the computation for an older one.
    pub(super) fn go_on(self, laws: Arc<Laws>, tool: Option<u32>) -> (Updates, AbortOnDropHandle<()>) {
        let Computing { maker, mut tissue, mut known } = self;
        let (tip, (place, mut places)) = (known.disc, watch::channel(None));
        let (tell, told) = mpsc::channel(1);
        let work = async move {
            loop {
                let (step, model) = tissue.borrow_and_update().clone();
                let place = *places.borrow_and_update();
                let begun = Instant::now();
                let changed = tokio::select! {
                    changed = tissue.changed() => changed,
                    () = maker.tell(&mut known, step, &model, place, &tell) => {
                        // A tool that moves all the time takes a part of a core for its laws, not all of it.
                        let pause = (PAUSES * begun.elapsed()).min(LONGEST_PAUSE);
                        let moved = async {
                            tokio::time::sleep(pause).await;
                            // A stream that reports no further place still has tissues that change.
                            if places.changed().await.is_err() {
                                std::future::pending::<()>().await;
                            }
                            Ok(())
                        };
                        tokio::select! {
                            changed = tissue.changed() => changed,
                            moved = moved => moved,
                        }
                    }
                };
                if changed.is_err() {
                    return;
                }
            }
        };
        (Updates { told, laws, tool, tip, place }, AbortOnDropHandle::new(tokio::spawn(work.in_current_span())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use palpate_realtime::{Pacer, SessionHandle};
    use palpate_session::budget::Budget;
    use palpate_tissue::limits::Limits;
    use palpate_tissue::scene::{Change, PAPER, Scene};
    use palpate_tissue::select::scheme_selection::NEVER;

    /// A session of a tissue whose exact law takes longer than a first one may.
    struct LawSession {
        pacer: Arc<Pacer>,
        job_pool: JobPool,
        account: Account,
        handle: Arc<SessionHandle>,
    }

    impl Drop for LawSession {
        fn drop(&mut self) {
            self.pacer.stop();
        }
    }

    impl LawSession {
        fn new(limits: &Limits) -> Self {
            let sets = ["sheet.points=[21, 21]", "anchor_springs.stiffness_n_per_m=1.0"].map(str::to_owned);
            let scene = Scene::parse("paper", PAPER, &sets, limits).unwrap();
            let budget = Budget::new(limits, 1, 1);
            let account = budget.account("one");
            let pacer = Pacer::start(1, 0.0, limits, budget).unwrap();
            let handle = pacer.create(&scene, false, 60.0, &account, &NEVER).unwrap();
            LawSession { job_pool: JobPool::open("test", limits).unwrap(), pacer, account, handle }
        }

        fn radius_m(&self) -> f64 {
            self.handle.model.shape().edge_m()
        }

        fn tip(&self) -> Tip {
            Tip { radius_m: self.radius_m(), ..Tip::default() }
        }

        /// The laws of a new stream.
        async fn begin(&self) -> (Arc<Law>, Arc<Laws>, Computing) {
            let begun =
                Computing::begin(&self.job_pool, &self.account, &Seat::of_trainer(self.handle.clone()), self.tip())
                    .await;
            let (law, computing) = begun.unwrap();
            (law.clone(), Arc::new(Laws::new(law)), computing)
        }

        fn sought(&self) -> Arc<SoughtLaw> {
            let disc = Disc::in_middle(&self.handle.model, self.radius_m());
            self.handle.law(&self.handle.model, &Cuts::default(), disc).unwrap()
        }

        /// Changes the tissue, and returns the step from which the change takes effect.
        fn change(&self, anchor_stiffness_n_per_m: f64, at_step: Option<u64>) -> (u64, Arc<Model>) {
            let change = Change { anchor_stiffness_n_per_m: Some(anchor_stiffness_n_per_m), ..Change::default() };
            self.handle.change(&change, at_step, |_| Ok(()), &NEVER).unwrap()
        }
    }

    async fn told(updates: &mut Updates) -> pb::ForceLawUpdate {
        std::future::poll_fn(|context| updates.poll(context)).await.unwrap()
    }

    #[tokio::test]
    async fn a_coarse_law_is_followed_by_the_exact_one() {
        let course = LawSession::new(&Limits::default());
        let (first, laws, computing) = course.begin().await;
        let sought = course.sought();
        assert!(first.is_coarse && sought.exact().is_none());
        let (mut updates, _computing) = computing.go_on(laws.clone(), None);
        // Local models refer to it once it was sent, not before.
        while sought.exact().is_none() {
            tokio::task::yield_now().await;
        }
        assert_eq!(laws.newest().0, FIRST);
        let update = told(&mut updates).await;
        assert_eq!((update.coarse_number, update.reason.as_str(), update.tissue_step), (FIRST, "", None));
        let law = update.law.unwrap();
        assert!(!law.coarse && law.number == 1);
        let exact = sought.exact().unwrap().unwrap();
        assert_eq!(touch::from_law(&law).unwrap(), *exact);
        assert_eq!(laws.newest(), (1, exact.clone()));
        // A stream that opens later starts with it.
        assert_eq!(course.begin().await.0, exact);
    }

    #[tokio::test]
    async fn a_law_beyond_the_bound_stays_coarse_and_says_why() {
        let course = LawSession::new(&Limits { law_work: 1 << 20, ..Limits::default() });
        for _ in 0..2 {
            let (_, laws, computing) = course.begin().await;
            let (mut updates, _computing) = computing.go_on(laws.clone(), None);
            let update = told(&mut updates).await;
            assert_eq!((update.law, update.reason.as_str()), (None, "NOT_AVAILABLE"));
            assert!(update.message.contains("limits.law_work"), "{}", update.message);
            assert_eq!(laws.newest().0, FIRST);
        }
    }

    #[tokio::test]
    async fn a_computation_that_nobody_waits_for_ends_and_another_begins_anew() {
        let course = LawSession::new(&Limits::default());
        let (_, laws, computing) = course.begin().await;
        let sought = course.sought();
        let (mut updates, handle) = computing.go_on(laws.clone(), None);
        // The job is running when its turn is taken.
        while sought.is_free() {
            tokio::task::yield_now().await;
        }
        drop(handle);
        assert_eq!(std::future::poll_fn(|context| updates.poll(context)).await, None);
        // The turn is given back, though nothing was settled.
        drop(sought.turn().await);
        assert!(sought.exact().is_none() && laws.newest().0 == FIRST);
        let (_, laws, computing) = course.begin().await;
        let (mut updates, _computing) = computing.go_on(laws, None);
        assert!(told(&mut updates).await.law.is_some());
    }

    #[tokio::test]
    async fn another_tissue_has_its_laws_told_when_it_acts() {
        let course = LawSession::new(&Limits::default());
        let (_, laws, computing) = course.begin().await;
        let (mut updates, _computing) = computing.go_on(laws.clone(), None);
        assert_eq!(told(&mut updates).await.law.unwrap().number, 1);
        let (step, model) = course.change(1.5, None);
        let first = told(&mut updates).await;
        let law = first.law.unwrap();
        assert_eq!((first.coarse_number, first.tissue_step, law.number, law.coarse), (1, Some(step), 2, true));
        let exact = told(&mut updates).await;
        assert_eq!((exact.coarse_number, exact.tissue_step), (2, None));
        let exact = exact.law.unwrap();
        assert_eq!((exact.number, exact.coarse), (3, false));
        assert_eq!(touch::from_law(&exact).unwrap(), force_law::exact(&model, course.radius_m()));
        assert_eq!(laws.newest().0, 3);
        // A stream that opens now starts with it.
        let law = course.begin().await.0;
        assert_eq!(law, laws.newest().1);
    }

    #[tokio::test]
    async fn a_newer_tissue_ends_the_computation_for_an_older_one() {
        let course = LawSession::new(&Limits::default());
        let (_, laws, computing) = course.begin().await;
        let old = course.sought();
        let (mut updates, _computing) = computing.go_on(laws.clone(), None);
        while old.is_free() {
            tokio::task::yield_now().await;
        }
        // Before the exact law of the first tissue is there.
        let (step, _) = course.change(1.5, None);
        let first = told(&mut updates).await;
        assert_eq!((first.coarse_number, first.tissue_step), (FIRST, Some(step)));
        drop(old.turn().await);
        assert!(old.exact().is_none(), "it went on");
        assert!(!told(&mut updates).await.law.unwrap().coarse);
    }
}
