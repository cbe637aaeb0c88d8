//! The force laws of a session's tissue, one per radius and place of a tip. A force law is the curve of force over
//! depth under a tip. Each is computed once for all callers. A change of the tissue's material discards them; those near a cut are
//! discarded when anything more is severed.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock};

use tokio::sync::MutexGuard;

use palpate_haptics::Law;
use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::budget::{Account, Purpose, Resource, Taken};
use palpate_tissue::lock::lock;
use palpate_tissue::memory;
use palpate_tissue::response::force_law::{self, Computation, Disc, LawProgress};
use palpate_tissue::{Cuts, Model};

/// Limit of the laws that a session keeps: enough for a stroke about a corner of a sheet, and back.
const MAX_LAWS: usize = 64;

/// Memory of a coarse and an exact law, bytes: some tens of rows of six numbers.
const LAW_BYTES: u64 = 2 << 10;

/// The force laws of one tissue that a session keeps, one for each disc (radius and place of a tip), at most 64. The
/// least recently requested is removed when there are too many; its holders keep it.
#[derive(Default)]
pub struct LawCache(Mutex<Option<TissueLaws>>);

/// The laws of one tissue.
struct TissueLaws {
    model: Arc<Model>,
    laws: Vec<Arc<SoughtLaw>>,
    /// Memory of the laws, and of the tissue, which their computation needs.
    taken: Taken,
}

/// Returns whether two tissues of one session have equal force laws: equal springs, lumps, anchor springs, damping and
/// volume. Their schemes and substeps may differ, and so may scenes on other meshes, which are not compared.
pub fn have_same_laws(a: &Model, b: &Model) -> bool {
    let [a, b] = [a, b].map(|model| &model.scene);
    a.springs == b.springs
        && a.added_lumps == b.added_lumps
        && a.anchor_stiffness_n_per_m == b.anchor_stiffness_n_per_m
        && a.damping_n_s_per_m == b.damping_n_s_per_m
        && a.volume_stiffness_pa == b.volume_stiffness_pa
}

impl LawCache {
    /// Returns the law of `model` with `cuts` (none for a disc that does not notice any) under a disc, and creates it if it is not kept; nothing is computed. At most
    /// `most_work` (springs times iterations) may be spent on the exact law, if this call creates it. If `model` has
    /// other laws than the tissue whose laws are kept, those are discarded first. The memory is charged to `payer`.
    ///
    /// # Errors
    /// Refuses if the memory exceeds the part of `payer` or of the system. The least recently requested law may be
    /// gone then.
    pub fn of(
        &self,
        disc: Disc,
        model: &Arc<Model>,
        cuts: &Cuts,
        most_work: u64,
        payer: &Account,
    ) -> Result<Arc<SoughtLaw>> {
        let mut kept = lock(&self.0);
        let kept = match &mut *kept {
            Some(kept) if have_same_laws(&kept.model, model) => kept,
            other => {
                // The memory of the old laws is freed first.
                *other = None;
                let taken = payer.take(Resource::Memory(Purpose::Laws), model.bytes(), "device")?;
                other.insert(TissueLaws { model: model.clone(), laws: Vec::new(), taken })
            }
        };
        // A law of earlier cuts keeps their list.
        kept.laws.retain(|law| law.cuts.is_empty() || cuts.is_empty() || law.cuts.version() == cuts.version());
        let is_same = |law: &Arc<SoughtLaw>| law.disc == disc && law.cuts.version() == cuts.version();
        if let Some(known) = kept.laws.iter().position(is_same) {
            // The newest is the last.
            kept.laws[known..].rotate_left(1);
            return Ok(kept.laws[kept.laws.len() - 1].clone());
        }
        if kept.laws.len() == MAX_LAWS {
            kept.laws.remove(0);
        }
        kept.taken.grow_to(kept.model.bytes() + (kept.laws.len() as u64 + 1) * LAW_BYTES, "device")?;
        let (coarse, exact, turn) = (OnceLock::new(), OnceLock::new(), tokio::sync::Mutex::default());
        let (model, cuts) = (kept.model.clone(), cuts.clone());
        let law = Arc::new(SoughtLaw { disc, model, cuts, most_work, coarse, exact, turn });
        kept.laws.push(law.clone());
        Ok(law)
    }
}

impl LawCache {
    /// Returns the laws of `model` without cuts that have been computed so far, exact ones where available; the most recently
    /// requested is the last. Empty if another tissue's laws are kept.
    pub fn known(&self, model: &Model) -> Vec<(Disc, Arc<Law>)> {
        let kept = lock(&self.0);
        let kept = kept.as_ref().filter(|kept| have_same_laws(&kept.model, model));
        let known = |law: &Arc<SoughtLaw>| {
            let exact = law.exact.get().and_then(|exact| exact.as_ref().ok());
            Some((law.disc, exact.or(law.coarse.get())?.clone()))
        };
        kept.map_or_else(Vec::new, |kept| {
            kept.laws.iter().filter(|law| law.cuts.is_empty()).filter_map(known).collect()
        })
    }
}

/// Force law of a tissue under a disc, which is computed on demand, once for all callers: a first law soon
/// ([`SoughtLaw::first`]), and the exact one piece by piece ([`SoughtLaw::advance`]).
#[derive(Debug)]
pub struct SoughtLaw {
    disc: Disc,
    model: Arc<Model>,
    cuts: Cuts,
    most_work: u64,
    coarse: OnceLock<Arc<Law>>,
    /// The exact law, or why it can't be computed.
    exact: OnceLock<Result<Arc<Law>>>,
    turn: tokio::sync::Mutex<()>,
}

impl SoughtLaw {
    /// Returns the exact law, or the refusal that says why it can't be computed; `None` while neither is known.
    pub fn exact(&self) -> Option<Result<Arc<Law>>> {
        self.exact.get().cloned()
    }

    /// Adds a law that was computed elsewhere, as the coarse or the exact one by its `is_coarse`. It must be of this
    /// tissue and disc, which is not checked. It is ignored if there is one of its kind already or, for an exact law,
    /// a refusal.
    pub fn add_known(&self, law: Law) {
        // A law that is there already is equal.
        let _ = if law.is_coarse {
            self.coarse.set(Arc::new(law)).is_ok()
        } else {
            self.exact.set(Ok(Arc::new(law))).is_ok()
        };
    }

    /// Returns a law to begin with: the exact or else the coarse one if it is known. Otherwise it computes one in the
    /// calling thread, in about 50 ms: the exact one if that suffices, else a coarse one. For the few tissues that
    /// have no coarse law in that time it computes the exact one, with up to `limits.law_work`, which takes longer.
    /// Setting `stop` ends it.
    ///
    /// # Errors
    /// - [`Reason::NotAvailable`]: no law can be computed with the allowed work, or `stop` is set.
    /// - There is no memory for the computation, or the exact law was found to be impossible meanwhile.
    pub fn first(&self, stop: &AtomicBool) -> Result<Arc<Law>> {
        if let Some(Ok(law)) = self.exact.get() {
            return Ok(law.clone());
        }
        if let Some(law) = self.coarse.get() {
            return Ok(law.clone());
        }
        let law = memory::attempt("device", || {
            let law = force_law::first(&self.model, &self.cuts, self.disc, stop);
            // Hardly any tissue lacks a coarse law; then the exact one is worth its time.
            Ok(law.or_else(|| force_law::exact_within(&self.model, &self.cuts, self.disc, self.most_work, stop)))
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

    /// Waits until no other task computes the exact law, and reserves the computation until the guard is dropped.
    /// Then [`Self::exact`] may already have the result, so look before [`Self::advance`].
    pub async fn turn(&self) -> MutexGuard<'_, ()> {
        self.turn.lock().await
    }

    /// Returns whether no task has the turn to compute the exact law now.
    pub fn is_free(&self) -> bool {
        self.turn.try_lock().is_ok()
    }

    /// Continues the computation of the exact law by one depth, in the calling thread, or begins it if `computation`
    /// is `None`. Returns the computation for the next call, or `None` when it has ended: then [`Self::exact`] has
    /// the law or a refusal (too little work allowed, or missing memory), unless `stop` was set. Have the turn
    /// ([`Self::turn`]) while you call it.
    pub fn advance(&self, computation: Option<Computation>, stop: &AtomicBool) -> Option<Computation> {
        let progress = memory::attempt("law", || {
            let begun = || Computation::new(&self.model, &self.cuts, self.disc, self.most_work);
            let computation = computation.or_else(begun);
            Ok(computation.map_or(LawProgress::GivenUp, |computation| computation.advance(&self.model, stop)))
        });
        match progress {
            Ok(LawProgress::UnderWay(computation)) => return Some(computation),
            Ok(LawProgress::Done(law)) => {
                let _ = self.exact.set(Ok(Arc::new(law)));
            }
            Err(refusal) => {
                let _ = self.exact.set(Err(refusal));
            }
            Ok(LawProgress::GivenUp) if stop.load(Ordering::Relaxed) => {}
            Ok(LawProgress::GivenUp) => {
                let message = "the exact force law of this tissue takes more work than limits.law_work allows";
                let _ = self.exact.set(Err(Refusal::new(Reason::NotAvailable, "law", message)));
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use palpate_session::budget::Budget;
    use palpate_tissue::limits::Limits;

    #[test]
    fn laws_of_a_tissue_are_kept_charged_and_given_back() {
        let [soft, hard, finer] =
            ["damping.coefficient_n_s_per_m=0.3", "damping.coefficient_n_s_per_m=0.6", "stepping.substeps=9"].map(
                |set| {
                    Model::parse(
                        "paper",
                        palpate_tissue::scene::PAPER,
                        &["sheet.points=[5, 5]", "stepping.integrator=central", set],
                    )
                    .unwrap()
                },
            );
        let budget = Budget::new(&Limits { memory_bytes: 256 << 10, ..Limits::default() }, 1, 1);
        let (account, kept) = (budget.account("one"), LawCache::default());
        let disc = |radius_m: f64| Disc { radius_m, at_m: DVec3::ZERO };
        let whole = Cuts::default();
        let of = |radius: u32, model: &Arc<Model>| kept.of(disc(f64::from(radius)), model, &whole, 1, &account);
        let taken = || budget.bytes_for(Purpose::Laws);
        let first = of(1, &soft).unwrap();
        assert_eq!(taken(), soft.bytes() + LAW_BYTES);
        // The same law, also for a tissue that differs only in its substeps.
        assert!(Arc::ptr_eq(&first, &of(1, &soft).unwrap()));
        let mut same = Model::clone(&soft);
        same.plan = finer.plan.clone();
        assert!(Arc::ptr_eq(&first, &of(1, &Arc::new(same)).unwrap()));
        (2..100).for_each(|radius| _ = of(radius, &soft).unwrap());
        assert_eq!(taken(), soft.bytes() + MAX_LAWS as u64 * LAW_BYTES);
        assert!(!Arc::ptr_eq(&first, &of(1, &soft).unwrap()), "the oldest went");
        // A known law serves another session of the same tissue, and no other tissue.
        let law = |is_coarse| Law { is_coarse, ..palpate_tissue::response::force_law::exact(&soft, 0.002) };
        of(98, &soft).unwrap().add_known(law(true));
        of(99, &soft).unwrap().add_known(law(true));
        of(99, &soft).unwrap().add_known(law(false));
        let known: Vec<_> = kept.known(&soft).into_iter().map(|(disc, law)| (disc, law.is_coarse)).collect();
        assert_eq!(known, [(disc(98.0), true), (disc(99.0), false)]);
        assert!(kept.known(&hard).is_empty());
        // Another tissue.
        of(1, &hard).unwrap();
        assert_eq!(taken(), hard.bytes() + LAW_BYTES);
        // Others take all the remaining memory.
        let rest = std::iter::from_fn(|| account.take(Resource::Memory(Purpose::Session), 64, "").ok());
        let rest: Vec<Taken> = rest.collect();
        let refused = of(2, &hard).unwrap_err();
        assert_eq!((refused.reason, refused.field.as_str()), (Reason::Overloaded, "device"));
        assert!(of(1, &hard).is_ok(), "what is kept is there");
        drop(rest);
        of(2, &hard).unwrap();
        drop(kept);
        assert_eq!(taken(), 0);
    }
}
