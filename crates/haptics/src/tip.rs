//! The tip of a position-controlled tool: how it meets the tissue.

/// The coupling between a tool and the surface it touches.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Coupling {
    /// The surface follows the tool exactly: the stiffness felt is the tissue's.
    Constraint,
    /// A spring of Kc and a damper of Bc: the stiffness felt is K·Kc/(K + Kc), that of two springs in a row, which bear the same
    /// force and add their lengths.
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
    /// Radius of the disc with which it meets the tissue, m. A stiffness in N/m means little without it.
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
