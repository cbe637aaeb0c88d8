//! Unit of the lengths in a file. Mesh files don't state it, so the user specifies it; scans may.

use std::fmt;
use std::str::FromStr;

use crate::Problem;

/// Named units, and their lengths in metres.
const UNITS: [(&str, f64); 3] = [("m", 1.0), ("cm", 1e-2), ("mm", 1e-3)];

/// Unit of the lengths in a file: a number of metres above 0. It is parsed from "m", "cm", "mm" or the number of
/// metres as text, such as "0.0254". The default is the metre.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Unit {
    metres: f64,
}

impl Default for Unit {
    /// Metres.
    fn default() -> Self {
        Unit::METRE
    }
}

impl Unit {
    /// The metre, in which all lengths of this crate are.
    pub const METRE: Unit = Unit { metres: 1.0 };

    pub(crate) const CENTIMETRE: Unit = Unit { metres: 1e-2 };
    pub(crate) const MILLIMETRE: Unit = Unit { metres: 1e-3 };
    pub(crate) const MICROMETRE: Unit = Unit { metres: 1e-6 };

    /// Returns the length of one unit in metres: above 0 and finite.
    #[must_use]
    pub fn metres(self) -> f64 {
        self.metres
    }
}

impl fmt::Display for Unit {
    /// Writes what comes after a number: the name of the unit, or the factor that converts to metres.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let known = UNITS.iter().find(|(_, metres)| *metres == self.metres);
        match known {
            Some((name, _)) => f.write_str(name),
            None => write!(f, "× {} m", self.metres),
        }
    }
}

impl FromStr for Unit {
    type Err = Problem;

    /// Parses "m", "cm", "mm" or the length of one unit in metres, such as "0.0254".
    fn from_str(text: &str) -> Result<Self, Problem> {
        let text = text.trim();
        let known = UNITS.iter().find(|(name, _)| *name == text).map(|(_, metres)| *metres);
        let metres = known.unwrap_or_else(|| text.parse().unwrap_or(f64::NAN));
        if metres > 0.0 && f64::is_finite(metres) {
            Ok(Self { metres })
        } else {
            Err(Problem::Unit { text: text.chars().take(40).collect() })
        }
    }
}
