//! Limits that a tool must stay below: of its force, of the pressure under it, and of the strain of the tissue near it.

use palpate_refusal::{Result, positive};

use crate::definition::{MeasureDefinition, Scope};

const fn above(name: &'static str, formula: &'static str, meaning: &'static str) -> MeasureDefinition {
    MeasureDefinition { name, unit: "1", scope: Scope::Both, range: [0.0, 1.0], formula, source: "Palpate", meaning }
}

pub(crate) const FORCE_ABOVE_LIMIT: MeasureDefinition = above(
    "force_above_limit_share",
    "time with |F| above the chosen limit over the contact time",
    "Which part of the contact was too strong.",
);

pub(crate) const PRESSURE_ABOVE_LIMIT: MeasureDefinition = above(
    "pressure_above_limit_share",
    "time with F·n/(πr²) above the chosen limit over the contact time",
    "Which part of the contact pressed a place too hard.",
);

pub(crate) const STRAIN_ABOVE_LIMIT: MeasureDefinition = above(
    "strain_above_limit_share",
    "time with the strain near the tool above the chosen limit over the contact time",
    "Which part of the contact stretched the tissue too far.",
);

/// What a limit is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LimitKind {
    /// The force of a tool, N.
    Force,
    /// The mean pressure under a tip, Pa.
    Pressure,
    /// The largest strain of the tissue near a tool.
    Strain,
}

impl LimitKind {
    /// All kinds, in the order in which they are told.
    pub const ALL: [LimitKind; 3] = [LimitKind::Force, LimitKind::Pressure, LimitKind::Strain];

    /// Returns its key, its name and unit, and its measure.
    fn entry(self) -> (&'static str, (&'static str, &'static str), &'static MeasureDefinition) {
        match self {
            LimitKind::Force => ("force_n", ("force", " N"), &FORCE_ABOVE_LIMIT),
            LimitKind::Pressure => ("pressure_pa", ("pressure", " Pa"), &PRESSURE_ABOVE_LIMIT),
            LimitKind::Strain => ("strain", ("strain", ""), &STRAIN_ABOVE_LIMIT),
        }
    }

    /// Returns its key in the `[limits]` of an exercise, with the unit at the end if it has one.
    pub fn key(self) -> &'static str {
        self.entry().0
    }

    /// Returns its name and its unit for people; a strain has none.
    pub fn name_and_unit(self) -> (&'static str, &'static str) {
        self.entry().1
    }

    /// Returns the measure that has the share of the contact above the limit.
    pub fn share(self) -> &'static MeasureDefinition {
        self.entry().2
    }
}

/// The limits of a tool; `None`: there is no limit of this kind.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ToolLimits {
    /// The force, N, above which a tool is too strong.
    pub force_n: Option<f64>,
    /// The pressure, Pa, above which a tip presses too hard.
    pub pressure_pa: Option<f64>,
    /// The strain above which a tool stretches the tissue too far. Without it no strain is measured.
    pub strain: Option<f64>,
}

impl ToolLimits {
    /// Returns the limit of a kind.
    pub fn of(&self, kind: LimitKind) -> Option<f64> {
        match kind {
            LimitKind::Force => self.force_n,
            LimitKind::Pressure => self.pressure_pa,
            LimitKind::Strain => self.strain,
        }
    }

    /// Returns the limits that there are.
    pub fn given(self) -> impl Iterator<Item = (LimitKind, f64)> {
        LimitKind::ALL.into_iter().filter_map(move |kind| self.of(kind).map(|limit| (kind, limit)))
    }

    /// Returns these limits, and of `others` those of the kinds that these have not.
    #[must_use]
    pub fn or(self, others: ToolLimits) -> Self {
        ToolLimits {
            force_n: self.force_n.or(others.force_n),
            pressure_pa: self.pressure_pa.or(others.pressure_pa),
            strain: self.strain.or(others.strain),
        }
    }

    /// Checks the limits.
    ///
    /// # Errors
    /// Refuses a limit that is not above 0 or not finite; the field is [`LimitKind::key`].
    pub fn check(&self) -> Result<()> {
        self.given().try_for_each(|(kind, limit)| positive(kind.key(), limit).map(|_| ()))
    }
}
