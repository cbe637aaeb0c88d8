//! How a tissue resists a blade.

use super::toml_document::Item;
use palpate_refusal::{Result, not_negative, positive};

/// How a tissue resists a blade.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Cutting {
    /// Fracture toughness Gc: the work that a cut takes for each unit of its area, J/m²; 0: a blade feels nothing. Porcine liver by a
    /// blade has 187 to 225, bovine liver by a needle 164 ± 6 (Gokgol, Basdogan, Canadinc, Estimation of fracture toughness
    /// of liver tissue, Medical Engineering & Physics 34(7), 2012, doi:10.1016/j.medengphy.2011.09.030).
    pub toughness_j_per_m2: f64,
    /// Thickness of what is cut, m: a blade that is deeper in it cuts no more. `None`: as deep as the blade is.
    pub thickness_m: Option<f64>,
}

impl Cutting {
    /// Reads the section `[cutting]`.
    pub(super) fn read(item: &Item<'_>) -> Result<Self> {
        item.table(|fields| {
            let toughness_j_per_m2 = fields.number("toughness_j_per_m2")?.unwrap_or(0.0);
            Ok(Cutting { toughness_j_per_m2, thickness_m: fields.number("thickness_m")? })
        })
    }

    /// Checks the values.
    pub(super) fn check(&self) -> Result<()> {
        not_negative("cutting.toughness_j_per_m2", self.toughness_j_per_m2)?;
        self.thickness_m.map_or(Ok(()), |thickness_m| positive("cutting.thickness_m", thickness_m).map(drop))
    }

    /// Returns the force with which the tissue resists an edge that is `depth_m` (m) within it, N: the work for a unit of its way.
    pub(crate) fn resistance_n(&self, depth_m: f64) -> f64 {
        self.toughness_j_per_m2 * self.thickness_m.map_or(depth_m, |thickness_m| depth_m.min(thickness_m))
    }
}
