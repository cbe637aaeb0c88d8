//! The section `[gravity]` of a scene.

use glam::DVec3;

use crate::scene::toml_document::Item;
use palpate_refusal::{Reason, Refusal, Result};

/// Largest acceleration, m/s²: a hundred times that of the Earth.
const MAX_ACCELERATION_M_PER_S2: f64 = 1000.0;

/// Gravity on a solid.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Gravity {
    /// The acceleration, m/s²; 0 without gravity.
    pub acceleration_m_per_s2: DVec3,
    /// Whether the shape of the file is that under gravity: stresses that are not modelled balance the weight. Otherwise it is the
    /// shape without weight, and the tissue sags from its first step on.
    pub is_loaded: bool,
}

impl Gravity {
    /// Message of the refusal of gravity on another tissue ([`Reason::WrongKind`]).
    pub const OF_A_SOLID: &str = "is for a solid: the rest shape of other tissues is that under gravity";

    pub(in crate::scene) fn read(item: &Item<'_>) -> Result<Self> {
        item.table(|fields| {
            Ok(Gravity {
                acceleration_m_per_s2: fields.required("acceleration_m_per_s2")?.vector()?,
                is_loaded: fields.item("loaded").map_or(Ok(false), |item| item.flag())?,
            })
        })
    }

    /// Refuses an acceleration that is not finite or above 1000 m/s².
    pub(super) fn check(&self) -> Result<()> {
        if self.acceleration_m_per_s2.length() <= MAX_ACCELERATION_M_PER_S2 {
            return Ok(());
        }
        let message = format!("must be at most {MAX_ACCELERATION_M_PER_S2} m/s² long");
        Err(Refusal::new(Reason::OutOfRange, "gravity.acceleration_m_per_s2", message))
    }

    /// Returns whether the tissue rests in the shape of its file.
    pub fn is_at_rest(&self) -> bool {
        self.pull_m_per_s2() == DVec3::ZERO
    }

    /// Returns the acceleration that stress must balance, m/s².
    pub(crate) fn pull_m_per_s2(&self) -> DVec3 {
        if self.is_loaded { DVec3::ZERO } else { self.acceleration_m_per_s2 }
    }
}
