//! The unit of a file's lengths. Mesh files don't state it, so the user does.

use std::str::FromStr;

use crate::Problem;

/// How many metres one unit of a file is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Unit {
    metres: f64,
}

impl Unit {
    /// Metres.
    pub const METRE: Unit = Unit { metres: 1.0 };

    /// Metres in one unit: above 0 and finite.
    #[must_use]
    pub fn metres(self) -> f64 {
        self.metres
    }
}

impl FromStr for Unit {
    type Err = Problem;

    /// Reads "m", "cm", "mm" or the metres of one unit, such as "0.0254".
    fn from_str(text: &str) -> Result<Self, Problem> {
        let metres = match text.trim() {
            "m" => 1.0,
            "cm" => 1e-2,
            "mm" => 1e-3,
            other => other.parse().unwrap_or(f64::NAN),
        };
        if metres > 0.0 && f64::is_finite(metres) {
            Ok(Self { metres })
        } else {
            Err(Problem::Unit { text: text.chars().take(40).collect() })
        }
    }
}
