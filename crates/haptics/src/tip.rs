//! The tip of a tool that is controlled by its position: its size, its friction and its coupling to the tissue.

/// Coupling between a tool and the surface that it touches: how the place of the one follows from the other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Coupling {
    /// The surface follows the tool exactly: the stiffness felt is the tissue's.
    Constraint,
    /// A spring Kc and a damper Bc between tool and surface. The stiffness felt is that of two springs in series,
    /// K·Kc/(K + Kc), with K the tissue's stiffness.
    Spring {
        /// Kc, N/m.
        stiffness_n_per_m: f64,
        /// Bc, N·s/m.
        damping_n_s_per_m: f64,
    },
}

/// Properties of a tool's tip that determine its contact with the tissue: a flat disc. The default is a finger on wet
/// tissue.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tip {
    /// Radius of the disc that touches the tissue, m, above 0. The tissue's stiffness in N/m depends on it.
    pub radius_m: f64,
    /// Coefficient μ of Coulomb friction, 0 or more; unused for a grasp.
    pub friction: f64,
    /// Whether it holds the tissue, so that it pulls as well as pushes. Otherwise it only pushes.
    pub grasps: bool,
    /// Coupling between the tool and the surface.
    pub coupling: Coupling,
}

impl Default for Tip {
    /// Returns the tip of a finger on wet tissue: 5 mm, μ = 0.2, no grasp, a constraint.
    fn default() -> Self {
        Tip { radius_m: 0.005, friction: 0.2, grasps: false, coupling: Coupling::Constraint }
    }
}
