//! How a tissue is cut: how it resists a blade, when it tears, where its anchor springs end, and how stiff burns make it.

use glam::DVec3;

use super::action_check::physical;
use super::toml_document::Item;
use palpate_refusal::{Reason, Refusal, Result, finite_vector, not_negative, number, positive, unsigned_zero};

/// The largest strain that may be given as the one at which a tissue tears.
const MAX_TEAR_STRAIN: f64 = 10.0;

/// The largest factor by which burns may make a tissue stiffer: a step then takes ten times as many substeps.
const MAX_BURNT_STIFFNESS_FACTOR: f64 = 100.0;

/// How a tissue is cut: how it resists a blade, when it tears, where its anchor springs end, and how stiff burns make it.
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
    /// The length of the anchor springs of a sheet or surface at rest, m: so far beneath each point its anchor is attached to what bears the
    /// tissue. A blade that crosses the line between both severs the anchor. `None`: nothing severs anchors.
    pub anchor_depth_m: Option<f64>,
    /// The direction from the points to where their anchors are attached, of any length above 0. `None`: into the tissue, against
    /// the normal of each point.
    pub anchor_direction: Option<DVec3>,
    /// The factor by which the springs of a sheet or surface without a pretension are stiffer where the tissue has burnt through; from 1
    /// to 100. It rises with the burn. `None`: burns change no stiffness.
    pub burnt_stiffness_factor: Option<f64>,
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
                anchor_depth_m: fields.number("anchor_depth_m")?,
                anchor_direction: fields.item("anchor_direction").map(|item| item.vector()).transpose()?,
                burnt_stiffness_factor: fields.number("burnt_stiffness_factor")?,
            })
        })
    }

    /// Checks the values; `has_anchors` tells whether tissues of this kind have anchor springs (only these does a burn stiffen), and `is_tense`
    /// whether this one has a pretension.
    pub(super) fn check(&self, has_anchors: bool, is_tense: bool) -> Result<()> {
        self.check_anchors(has_anchors)?;
        self.check_burns(has_anchors, is_tense)?;
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

    fn check_anchors(&self, has_anchors: bool) -> Result<()> {
        if let Some(depth_m) = self.anchor_depth_m {
            if !has_anchors {
                let message = "is for [sheet] and [mesh]: a solid has no anchor springs";
                return Err(Refusal::new(Reason::WrongKind, "cutting.anchor_depth_m", message));
            }
            physical("cutting.anchor_depth_m", depth_m)?;
        }
        let Some(direction) = self.anchor_direction else { return Ok(()) };
        if self.anchor_depth_m.is_none() {
            let message = "goes with anchor_depth_m, the length of the anchors: give both";
            return Err(Refusal::new(Reason::Missing, "cutting.anchor_direction", message));
        }
        physical("cutting.anchor_direction", finite_vector("cutting.anchor_direction", direction)?.length()).map(drop)
    }

    fn check_burns(&self, burns: bool, is_tense: bool) -> Result<()> {
        let (field, Some(factor)) = ("cutting.burnt_stiffness_factor", self.burnt_stiffness_factor) else {
            return Ok(());
        };
        let range = format!("from 1 to {MAX_BURNT_STIFFNESS_FACTOR}");
        number(field, factor, &range, |v| (1.0..=MAX_BURNT_STIFFNESS_FACTOR).contains(&v))?;
        let message = if !burns {
            "is for [sheet] and [mesh]: burns do not stiffen a solid"
        } else if is_tense && factor > 1.0 {
            // Burnt collagen shrinks, so its tension rises by more than its strain at rest says.
            "does not go with springs.pretension_n_per_m: the tension of burnt tissue is not known; leave one of both out"
        } else {
            return Ok(());
        };
        Err(Refusal::new(Reason::WrongKind, field, message))
    }

    /// Returns the values with every −0 replaced by 0. Values that must be above 0 need no replacement.
    #[must_use]
    pub(super) fn with_unsigned_zeros(self) -> Self {
        Cutting {
            toughness_j_per_m2: unsigned_zero(self.toughness_j_per_m2),
            thickness_m: self.thickness_m.map(unsigned_zero),
            anchor_direction: self.anchor_direction.map(|direction| direction + DVec3::ZERO),
            ..self
        }
    }

    /// Returns the factor of the stiffness of springs where the tissue has burnt through; 1: burns change nothing.
    pub(crate) fn burnt_stiffness(&self) -> f64 {
        self.burnt_stiffness_factor.unwrap_or(1.0)
    }

    /// Returns the vector from a point to where its anchor is attached, m; `normal` is that of the surface at the point.
    pub(crate) fn anchor_m(&self, normal: DVec3) -> Option<DVec3> {
        let direction = self.anchor_direction.unwrap_or(-normal).normalize_or_zero();
        self.anchor_depth_m.map(|depth_m| depth_m * direction)
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
