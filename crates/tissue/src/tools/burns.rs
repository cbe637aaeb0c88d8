//! What tips have burnt: how long each point has been under one.

use crate::body::model::Model;
use crate::saved::ensure;
use palpate_refusal::Result;

/// For how many steps each point has been under a tip that burns and touches. Steps have one length, so that the time is exact.
#[derive(Debug, Clone, Default)]
pub(crate) struct Burns {
    /// Places in memory, ascending, and their steps, 1 or more.
    steps: Vec<(u32, u32)>,
}

impl Burns {
    /// Returns the number of steps for which the point at a place in memory has burnt.
    pub(crate) fn steps_at(&self, place: usize) -> u32 {
        self.found(place).map_or(0, |at| self.steps[at].1)
    }

    /// Adds a step to the point at a place in memory.
    #[allow(clippy::cast_possible_truncation)]
    pub(crate) fn add_step(&mut self, place: usize) {
        match self.found(place) {
            Ok(at) => self.steps[at].1 = self.steps[at].1.saturating_add(1),
            Err(at) => self.steps.insert(at, (place as u32, 1)),
        }
    }

    fn found(&self, place: usize) -> std::result::Result<usize, usize> {
        self.steps.binary_search_by_key(&place, |burnt| burnt.0 as usize)
    }

    /// Adds what the next steps depend on to a hash: nothing if nothing is burnt.
    pub(crate) fn hash(&self, add: &mut impl FnMut(&[u8])) {
        for (place, steps) in &self.steps {
            add(&place.to_le_bytes());
            add(&steps.to_le_bytes());
        }
    }

    /// Returns the places and their steps.
    pub(crate) fn saved(&self) -> Vec<(u32, u32)> {
        self.steps.clone()
    }

    /// Restores what was burnt.
    pub(crate) fn restored(saved: &[(u32, u32)], model: &Model) -> Result<Self> {
        ensure(saved.is_sorted_by(|a, b| a.0 < b.0), "burnt points out of order")?;
        let is_sound = |(place, steps): &(u32, u32)| (*place as usize) < model.place_count() && *steps > 0;
        ensure(saved.iter().all(is_sound), "a burnt point that is not of the tissue")?;
        Ok(Burns { steps: saved.to_vec() })
    }
}
