//! What a tool that is led by its position is where it meets the sheet.

use crate::refusal::{Result, not_negative, number, positive};

use super::Sheet;

/// How a tool is bound to what it touches.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Coupling {
    /// The surface is where the tool is: the stiffness that is felt is the tissue's.
    Constraint,
    /// By a spring of Kc and a damper of Bc: felt is K·Kc/(K + Kc).
    Spring {
        /// Kc, N/m.
        stiffness_n_per_m: f64,
        /// Bc, N·s/m.
        damping_n_s_per_m: f64,
    },
}

/// What a tool is where it meets the sheet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tip {
    /// Of the disc with which it meets the sheet, m. Stiffness in N/m means little without it.
    pub radius_m: f64,
    /// μ of Coulomb's friction; of a grasp it has no meaning.
    pub friction: f64,
    /// Holds what it has, pulling as well as pushing; or touches, and only pushes.
    pub grasps: bool,
    /// How it is bound.
    pub coupling: Coupling,
}

impl Default for Tip {
    /// A finger's end on wet tissue.
    fn default() -> Self {
        Tip { radius_m: 0.005, friction: 0.2, grasps: false, coupling: Coupling::Constraint }
    }
}

impl Tip {
    /// Whether such a tool can be on such a sheet.
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
