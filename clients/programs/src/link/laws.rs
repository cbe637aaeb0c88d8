//! The laws of a tissue at the places where tools have been: each is computed once, which takes no virtual time.

use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, PoisonError};

use palpate_haptics::Law;
use palpate_tissue::Model;
use palpate_tissue::response::force_law::{self, Disc};

/// The laws of one tissue.
#[derive(Debug)]
pub(super) struct PlaceLaws {
    pub(super) model: Arc<Model>,
    known: Mutex<Vec<(Disc, Arc<Law>)>>,
}

impl PlaceLaws {
    /// Creates an empty cache for a tissue.
    pub(super) fn new(model: &Arc<Model>) -> Self {
        PlaceLaws { model: model.clone(), known: Mutex::default() }
    }

    /// Returns the exact law under a disc; `None` if nothing holds the tissue.
    pub(super) fn law(&self, disc: Disc) -> Option<Arc<Law>> {
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, law)) = known.iter().find(|known| known.0 == disc) {
            return Some(law.clone());
        }
        let law = force_law::exact_within(&self.model, disc, u64::MAX, &AtomicBool::new(false));
        let law = law.filter(Law::is_sound).map(Arc::new)?;
        known.push((disc, law.clone()));
        Some(law)
    }
}
