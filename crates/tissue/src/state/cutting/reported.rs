//! Springs that a server reports as severed: a client's copy of its tissue severs them between two steps, as a blade would in one.

use std::sync::Arc;

use super::Crossing;
use crate::body::model::Model;
use crate::body::severed::{ANCHOR, SeveredSpring};
use crate::body::spring_ends::SpringEnd;
use crate::kernel::real::Real;
use crate::state::tissue_state::TissueState;
use glam::DVec3;
use palpate_haptics::ReportedSpring;
use palpate_refusal::Result;

impl Crossing {
    /// Returns the crossing that severs a spring; of an anchor spring only its place and number count.
    fn of(model: &Model, spring: &SeveredSpring) -> Option<Self> {
        let SeveredSpring { ends: [place, other], number, part, .. } = *spring;
        let (place, other) = (place as usize, other as usize);
        let of_anchor = SpringEnd {
            number: ANCHOR as usize,
            other,
            rest: DVec3::ZERO,
            stiffness_n_per_m: 0.0,
            tension_n_per_m: 0.0,
        };
        let of_end = || model.springs_at(place).into_iter().find(|end| end.number == number as usize);
        let spring = if spring.is_anchor() { of_anchor } else { of_end()? };
        Some(Crossing { place, spring, part })
    }
}

impl<T: Real> TissueState<T> {
    /// Severs the whole ones of some springs.
    ///
    /// # Errors
    /// Refuses springs of which the tissue lacks one; then it severs none.
    pub(in crate::state) fn sever_reported(&mut self, springs: &[ReportedSpring]) -> Result<()> {
        let model = self.model.clone();
        let crossing = |spring: &ReportedSpring| Ok(Crossing::of(&model, &SeveredSpring::named(&model, *spring, 0)?));
        let crossings = springs.iter().map(crossing).collect::<Result<Vec<_>>>()?;
        let crossings: Vec<Crossing> = crossings.into_iter().flatten().collect();
        if self.sever_all(&crossings) {
            // No input of a tool repeats it, so the guard must not go back to before it.
            self.take_checkpoint();
            if let Some(checkpoint) = self.checkpoint.as_mut().and_then(Arc::get_mut) {
                checkpoint.passed_checks = false;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
