//! The tip of a position-controlled tool: how it meets the sheet.

use crate::refusal::{Result, not_negative, number, positive};

use super::Sheet;

/// The coupling between a tool and the surface it touches.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Coupling {
    /// The surface follows the tool exactly: the stiffness felt is the tissue's.
    Constraint,
    /// A spring of Kc and a damper of Bc: the stiffness felt is K·Kc/(K + Kc).
    Spring {
        /// Kc, N/m.
        stiffness_n_per_m: f64,
        /// Bc, N·s/m.
        damping_n_s_per_m: f64,
    },
}

/// The properties of a tool's tip.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tip {
    /// Radius of the disc with which it meets the sheet, m. A stiffness in N/m means little without it.
    pub radius_m: f64,
    /// μ of Coulomb friction; unused for a grasp.
    pub friction: f64,
    /// Whether it holds the tissue, and so pulls as well as pushes. Otherwise it touches and only pushes.
    pub grasps: bool,
    /// The coupling.
    pub coupling: Coupling,
}

impl Default for Tip {
    /// A fingertip on wet tissue.
    fn default() -> Self {
        Tip { radius_m: 0.005, friction: 0.2, grasps: false, coupling: Coupling::Constraint }
    }
}

impl Tip {
    /// Checks whether such a tool fits such a sheet.
    ///
    /// # Errors
    /// Refuses a value that is not finite or out of range; `field` is the name that the refusal gives.
    pub fn check(&self, field: &str, sheet: &Sheet) -> Result<()> {
        let longest_m = sheet.longer_side_m();
        let range = format!("above 0 and at most {longest_m}, the sheet's longer side");
        number(&format!("{field}.radius_m"), self.radius_m, &range, |v| v > 0.0 && v <= longest_m)?;
        number(&format!("{field}.friction"), self.friction, "from 0 to 10", |v| (0.0..=10.0).contains(&v))?;
        if let Coupling::Spring { stiffness_n_per_m, damping_n_s_per_m } = self.coupling {
            positive(&format!("{field}.spring.stiffness_n_per_m"), stiffness_n_per_m)?;
            not_negative(&format!("{field}.spring.damping_n_s_per_m"), damping_n_s_per_m)?;
        }
        Ok(())
    }
}
