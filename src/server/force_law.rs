//! The force law of a haptic stream: first one that is there at once, then the exact one, when it is computed.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use palpate_proto::{pb, touch};
use palpate_touch::Law;
use tokio::sync::oneshot;
use tokio_util::task::AbortOnDropHandle;
use tonic::Status;
use tonic_types::StatusExt;
use tracing::{Instrument, debug};

use super::workshop::Workshop;
use crate::budget::Account;
use crate::pace::laws::SoughtLaw;
use crate::session::laws::{BETTER, FIRST, Laws};

/// The law that a stream begins with.
pub(super) async fn first(workshop: &Workshop, account: &Account, sought: &Arc<SoughtLaw>) -> Result<Arc<Law>, Status> {
    let sought = sought.clone();
    Ok(workshop.work(account, move |stop| sought.first(stop.flag())).await??)
}

/// What a stream is told of its coarse law, once.
pub(super) struct Update {
    exact: oneshot::Receiver<Result<Arc<Law>, Status>>,
    laws: Arc<Laws>,
}

impl Update {
    /// The message, when there is one. The exact law is used by samples from then on: so none that names it can come before
    /// the message. `None`: there will be no message.
    pub(super) fn poll(&mut self, context: &mut Context<'_>) -> Poll<Option<pb::ForceLawUpdate>> {
        let Ok(exact) = ready!(Pin::new(&mut self.exact).poll(context)) else { return Poll::Ready(None) };
        Poll::Ready(Some(match exact {
            Ok(law) => {
                let update = touch::law_update(FIRST, Ok((BETTER, &law)));
                self.laws.improve(law);
                update
            }
            Err(status) => {
                let reason = status.get_details_error_info().map_or(String::new(), |info| info.reason);
                touch::law_update(FIRST, Err((&reason, status.message())))
            }
        }))
    }
}

/// Computes the exact law until the handle is dropped.
pub(super) fn improve(
    workshop: &Workshop,
    account: &Account,
    sought: Arc<SoughtLaw>,
    laws: Arc<Laws>,
) -> (Update, AbortOnDropHandle<()>) {
    let (tell, exact) = oneshot::channel();
    let (workshop, account) = (workshop.clone(), account.clone());
    let work = async move {
        let exact = compute(&workshop, &account, &sought).await;
        if let Err(status) = &exact {
            debug!(message = status.message(), "a force law stays coarse");
        }
        // A stream that has ended is told nothing.
        let _ = tell.send(exact);
    };
    (Update { exact, laws }, AbortOnDropHandle::new(tokio::spawn(work.in_current_span())))
}

/// The exact law. It is computed depth by depth: between two of them it is the turn of other work, also of the same caller.
async fn compute(workshop: &Workshop, account: &Account, sought: &Arc<SoughtLaw>) -> Result<Arc<Law>, Status> {
    let _turn = sought.turn().await;
    let mut computation = None;
    loop {
        if let Some(exact) = sought.exact() {
            return Ok(exact?);
        }
        let sought = sought.clone();
        computation = workshop.work(account, move |stop| sought.advance(computation, stop.flag())).await?;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::budget::Budget;
    use crate::limits::Limits;
    use crate::pace::laws::KeptLaws;
    use crate::sheet::Model;

    /// A tissue whose exact law takes longer than a first one may.
    fn sought(limits: &Limits) -> Arc<SoughtLaw> {
        let model = Model::paper(&["sheet.points=[21, 21]", "virtual_springs.stiffness_n_per_m=1.0"]);
        KeptLaws::default().of(model.scene.sheet.spacing_m, &model, limits.law_work)
    }

    async fn told(mut update: Update) -> Option<pb::ForceLawUpdate> {
        std::future::poll_fn(|context| update.poll(context)).await
    }

    fn workshop(limits: &Limits) -> (Workshop, Account) {
        (Workshop::open("test", limits).unwrap(), Budget::new(limits, 1, 1).account("one"))
    }

    #[tokio::test]
    async fn a_coarse_law_is_followed_by_the_exact_one() {
        let limits = Limits::default();
        let ((workshop, account), sought) = (workshop(&limits), sought(&limits));
        let first = first(&workshop, &account, &sought).await.unwrap();
        assert!(first.is_coarse && sought.exact().is_none());
        let laws = Arc::new(Laws::new(first));
        let (update, _computing) = improve(&workshop, &account, sought.clone(), laws.clone());
        // Local models refer to it when it was told, not before.
        while sought.exact().is_none() {
            tokio::task::yield_now().await;
        }
        assert_eq!(laws.newest().0, FIRST);
        let update = told(update).await.unwrap();
        assert_eq!((update.coarse_number, update.reason.as_str()), (FIRST, ""));
        let law = update.law.unwrap();
        assert!(!law.coarse && law.number == BETTER);
        let exact = sought.exact().unwrap().unwrap();
        assert_eq!(touch::from_law(&law).unwrap(), *exact);
        assert_eq!(laws.newest(), (BETTER, &exact));
        // Whoever comes later begins with it.
        assert_eq!(super::first(&workshop, &account, &sought).await.unwrap(), exact);
    }

    #[tokio::test]
    async fn a_law_beyond_the_bound_stays_coarse_and_says_why() {
        let limits = Limits { law_work: 1 << 20, ..Limits::default() };
        let ((workshop, account), sought) = (workshop(&limits), sought(&limits));
        let laws = Arc::new(Laws::new(first(&workshop, &account, &sought).await.unwrap()));
        for _ in 0..2 {
            let (update, computing) = improve(&workshop, &account, sought.clone(), laws.clone());
            let update = told(update).await.unwrap();
            assert_eq!((update.law, update.reason.as_str()), (None, "NOT_AVAILABLE"));
            assert!(update.message.contains("limits.law_work"), "{}", update.message);
            computing.await.unwrap();
            assert_eq!(laws.newest().0, FIRST);
        }
    }

    #[tokio::test]
    async fn a_computation_that_nobody_waits_for_ends_and_another_begins_anew() {
        let limits = Limits::default();
        let ((workshop, account), sought) = (workshop(&limits), sought(&limits));
        let laws = Arc::new(Laws::new(first(&workshop, &account, &sought).await.unwrap()));
        let (update, computing) = improve(&workshop, &account, sought.clone(), laws.clone());
        // It is under way when its turn is taken.
        while sought.is_free() {
            tokio::task::yield_now().await;
        }
        drop(computing);
        assert_eq!(told(update).await, None);
        // The turn is given back, though nothing was settled.
        drop(sought.turn().await);
        assert!(sought.exact().is_none() && laws.newest().0 == FIRST);
        let (update, _computing) = improve(&workshop, &account, sought.clone(), laws.clone());
        assert!(told(update).await.unwrap().law.is_some());
    }
}
