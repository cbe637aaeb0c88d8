//! The force laws of a session, one for each radius of a tip and each tissue that it had: computed once, whoever asks.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock};

use palpate_touch::Law;
use tokio::sync::MutexGuard;

use crate::force_law::{self, Computation, Progress};
use crate::lock::lock;
use crate::memory;
use crate::refusal::{Reason, Refusal, Result};
use crate::sheet::Model;

/// Laws that a session keeps.
const MOST_LAWS: usize = 16;

/// What a session keeps of laws; the oldest goes when there are too many.
#[derive(Default)]
pub(crate) struct KeptLaws(Mutex<Vec<Arc<SoughtLaw>>>);

impl KeptLaws {
    /// The law of `model` under a tip of `radius_m`, for which at most `most_work` springs times iterations are done.
    pub(crate) fn of(&self, radius_m: f64, model: &Arc<Model>, most_work: u64) -> Arc<SoughtLaw> {
        let mut kept = lock(&self.0);
        if let Some(law) = kept.iter().find(|law| law.radius_m == radius_m && Arc::ptr_eq(&law.model, model)) {
            return law.clone();
        }
        if kept.len() == MOST_LAWS {
            kept.remove(0);
        }
        let (coarse, exact, turn) = (OnceLock::new(), OnceLock::new(), tokio::sync::Mutex::default());
        let law = Arc::new(SoughtLaw { radius_m, model: model.clone(), most_work, coarse, exact, turn });
        kept.push(law.clone());
        law
    }
}

/// The law of a tissue under a tip: a coarse one at once, the exact one when it is computed.
#[derive(Debug)]
pub(crate) struct SoughtLaw {
    radius_m: f64,
    model: Arc<Model>,
    most_work: u64,
    coarse: OnceLock<Arc<Law>>,
    /// Or why there is none.
    exact: OnceLock<Result<Arc<Law>>>,
    turn: tokio::sync::Mutex<()>,
}

impl SoughtLaw {
    /// The exact law, or why it can't be had, if that is known.
    pub(crate) fn exact(&self) -> Option<Result<Arc<Law>>> {
        self.exact.get().cloned()
    }

    /// The law to begin with, at most 50 ms of work: the exact one if it is known or takes no longer, else a coarse one.
    ///
    /// # Errors
    /// Refuses if no law can be computed with the work that is allowed, or if `stop` is set.
    pub(crate) fn first(&self, stop: &AtomicBool) -> Result<Arc<Law>> {
        if let Some(Ok(law)) = self.exact.get() {
            return Ok(law.clone());
        }
        if let Some(law) = self.coarse.get() {
            return Ok(law.clone());
        }
        let law = memory::attempt("device", || {
            let law = force_law::first(&self.model, self.radius_m, stop);
            // Hardly any tissue has no coarse law; then the exact one is worth its time.
            Ok(law.or_else(|| force_law::exact_within(&self.model, self.radius_m, self.most_work, stop)))
        });
        match law?.map(Arc::new) {
            Some(law) if law.is_coarse => Ok(self.coarse.get_or_init(|| law).clone()),
            Some(law) => self.exact.get_or_init(|| Ok(law)).clone(),
            None => {
                let message = "the force law of this tissue would take too much work: touch without a device";
                Err(Refusal::new(Reason::NotAvailable, "device", message))
            }
        }
    }

    /// Waits until nobody else computes the exact law. It is computed by one at a time: the others find it then.
    pub(crate) async fn turn(&self) -> MutexGuard<'_, ()> {
        self.turn.lock().await
    }

    /// Whether nobody computes the exact law.
    #[cfg(test)]
    pub(crate) fn is_free(&self) -> bool {
        self.turn.try_lock().is_ok()
    }

    /// Computes the exact law further, by one depth, or begins it; unless `stop` is set. What is returned goes on with the
    /// next call. None: [`Self::exact`] tells the result, unless it was stopped.
    pub(crate) fn advance(&self, computation: Option<Computation>, stop: &AtomicBool) -> Option<Computation> {
        let progress = memory::attempt("law", || {
            let computation = computation.or_else(|| Computation::new(&self.model, self.radius_m, self.most_work));
            Ok(computation.map_or(Progress::GivenUp, |computation| computation.advance(&self.model, stop)))
        });
        match progress {
            Ok(Progress::UnderWay(computation)) => return Some(computation),
            Ok(Progress::Done(law)) => {
                let _ = self.exact.set(Ok(Arc::new(law)));
            }
            Err(refusal) => {
                let _ = self.exact.set(Err(refusal));
            }
            Ok(Progress::GivenUp) if stop.load(Ordering::Relaxed) => {}
            Ok(Progress::GivenUp) => {
                let message = "the exact force law of this tissue takes more work than limits.law_work allows";
                let _ = self.exact.set(Err(Refusal::new(Reason::NotAvailable, "law", message)));
            }
        }
        None
    }
}
