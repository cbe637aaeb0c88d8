//! How a tissue is cut: how it resists a blade, and when it tears.

use super::action_check::physical;
use super::toml_document::Item;
use palpate_refusal::{Reason, Refusal, Result, not_negative, number, positive};

/// The largest strain that may be given as the one at which a tissue tears.
const MAX_TEAR_STRAIN: f64 = 10.0;

/// How a tissue is cut: how it resists a blade, and when it tears.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Cutting {
    /// Fracture toughness Gc: the work that a cut takes for each unit of its area, J/m²; 0: a blade feels nothing. Porcine liver by a
    /// blade has 187 to 225, bovine liver by a needle 164 ± 6 (Gokgol, Basdogan, Canadinc, Estimation of fracture toughness
    /// of liver tissue, Medical Engineering & Physics 34(7), 2012, doi:10.1016/j.medengphy.2011.09.030).
    pub toughness_j_per_m2: f64,
    /// Thickness of what is cut, m: a blade that is deeper in it cuts no more. `None`: as deep as the blade is.
    pub thickness_m: Option<f64>,
    /// The strain of a spring beyond which it tears, (L − L0)/L0 with the length L0 at which the scene has it at rest, with a
    /// pretension too. `None`: the tissue does not tear.
    pub tear_strain: Option<f64>,
    /// The length h₀ of a spring for which `tear_strain` is meant, m: one of length h then tears beyond `tear_strain`·√(h₀/h), because
    /// the strain ahead of a notch grows with 1/√distance (linear fracture mechanics), so that a notch in a finer mesh opens
    /// under the same load. `None`: all springs tear at the same strain.
    pub tear_reference_m: Option<f64>,
}

impl Cutting {
    /// Reads the section `[cutting]`.
    pub(super) fn read(item: &Item<'_>) -> Result<Self> {
        item.table(|fields| {
            let toughness_j_per_m2 = fields.number("toughness_j_per_m2")?.unwrap_or(0.0);
            Ok(Cutting {
                toughness_j_per_m2,
                thickness_m: fields.number("thickness_m")?,
                tear_strain: fields.number("tear_strain")?,
                tear_reference_m: fields.number("tear_reference_m")?,
            })
        })
    }

    /// Checks the values.
    pub(super) fn check(&self) -> Result<()> {
        not_negative("cutting.toughness_j_per_m2", self.toughness_j_per_m2)?;
        self.thickness_m.map_or(Ok(()), |thickness_m| positive("cutting.thickness_m", thickness_m).map(drop))?;
        if let Some(strain) = self.tear_strain {
            let range = format!("above 0 and at most {MAX_TEAR_STRAIN}");
            number("cutting.tear_strain", strain, &range, |v| v > 0.0 && v <= MAX_TEAR_STRAIN)?;
        }
        let Some(reference_m) = self.tear_reference_m else { return Ok(()) };
        if self.tear_strain.is_none() {
            let message = "goes with tear_strain, which it scales: give both";
            return Err(Refusal::new(Reason::Missing, "cutting.tear_reference_m", message));
        }
        physical("cutting.tear_reference_m", reference_m).map(drop)
    }

    /// Returns the strain beyond which a spring of `length_m` (m) tears; `None` if the tissue does not tear.
    pub(crate) fn tear_limit(&self, length_m: f64) -> Option<f64> {
        let scale = self.tear_reference_m.map_or(1.0, |reference_m| (reference_m / length_m).sqrt());
        self.tear_strain.map(|strain| strain * scale)
    }

    /// Returns the force with which the tissue resists an edge that is `depth_m` (m) within it, N: the work for a unit of its way.
    pub(crate) fn resistance_n(&self, depth_m: f64) -> f64 {
        self.toughness_j_per_m2 * self.thickness_m.map_or(depth_m, |thickness_m| depth_m.min(thickness_m))
    }
}
