//! The laws of a tissue under a tip at the places where it has been: each is computed once, which takes no virtual time.

use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, PoisonError};

use palpate_haptics::{Law, TipShape};
use palpate_tissue::response::force_law::{self, Disc};
use palpate_tissue::{Cuts, Model};

/// The laws of one tissue.
#[derive(Debug)]
pub(super) struct PlaceLaws {
    pub(super) model: Arc<Model>,
    shape: TipShape,
    known: Mutex<Vec<(Disc, Arc<Law>)>>,
}

impl PlaceLaws {
    /// Creates an empty cache for a tissue and a tip.
    pub(super) fn new(model: &Arc<Model>, shape: TipShape) -> Self {
        PlaceLaws { model: model.clone(), shape, known: Mutex::default() }
    }

    /// Returns the exact law of the tip where a disc is; `None` if nothing holds the tissue.
    pub(super) fn law(&self, disc: Disc) -> Option<Arc<Law>> {
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, law)) = known.iter().find(|known| known.0 == disc) {
            return Some(law.clone());
        }
        let law = force_law::exact_within(&self.model, &Cuts::default(), disc, u64::MAX, &AtomicBool::new(false));
        let law = law
            .map(|law| force_law::of_tip(&self.model, law, self.shape, disc.radius_m))
            .filter(Law::is_sound)
            .map(Arc::new)?;
        known.push((disc, law.clone()));
        Some(law)
    }
}
