//! The tip of a tool that is controlled by its position: its size, its friction and its coupling to the tissue.

use std::str::FromStr;

use glam::DVec3;

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

/// The body with which a tool meets the tissue.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum TipShape {
    /// A disc that presses with an even pressure, and lies on the surface however that turns. The place of the tool is the
    /// mean of the surface over the disc.
    #[default]
    Disc,
    /// A flat rigid disc. It begins with the direction of the surface that it meets, and turns as that does at rest along its
    /// way. The place of the tool is its middle.
    RigidDisc,
    /// A rigid sphere. The place of the tool is its centre.
    Sphere,
    /// A blade, which severs what its edge crosses. The place of the tool is the tip of the edge ([`Tip::edge_m`]).
    Blade,
}

impl TipShape {
    /// All shapes, in the order of their numbers in journals.
    pub const ALL: [Self; 4] = [TipShape::Disc, TipShape::RigidDisc, TipShape::Sphere, TipShape::Blade];

    /// Returns the name in scripts.
    pub fn name(self) -> &'static str {
        match self {
            TipShape::Disc => "disc",
            TipShape::RigidDisc => "rigid",
            TipShape::Sphere => "sphere",
            TipShape::Blade => "blade",
        }
    }

    /// Returns whether the tissue takes the shape of the tip, so that its pressure is part of the solution.
    pub fn is_rigid(self) -> bool {
        matches!(self, TipShape::RigidDisc | TipShape::Sphere)
    }

    /// Returns the distance of the tool's place from the surface when a tip of `radius_m` (m) just touches, m.
    pub fn height_m(self, radius_m: f64) -> f64 {
        if self == TipShape::Sphere { radius_m } else { 0.0 }
    }
}

impl FromStr for TipShape {
    type Err = String;

    /// Returns the shape of a name in scripts ([`TipShape::name`]).
    fn from_str(name: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|shape| shape.name() == name);
        found.ok_or_else(|| format!("must be one of {}", Self::ALL.map(Self::name).join(", ")))
    }
}

/// Properties of a tool's tip that determine its contact with the tissue. The default is a finger on wet tissue.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tip {
    /// The body that meets the tissue.
    pub shape: TipShape,
    /// Radius of the disc or sphere, m, above 0. The tissue's stiffness in N/m depends on it.
    pub radius_m: f64,
    /// Coefficient μ of Coulomb friction, 0 or more; unused for a grasp.
    pub friction: f64,
    /// Whether it holds the tissue, so that it pulls as well as pushes. Otherwise it only pushes.
    pub grasps: bool,
    /// Coupling between the tool and the surface.
    pub coupling: Coupling,
    /// The edge of a blade, from its tip to its heel, m, in the tissue's frame; in an instrument's tips, in the instrument's frame. 0
    /// for every other shape.
    pub edge_m: DVec3,
    /// The time of contact after which it severs the tissue under it by heat (cautery), s; 0: it does not burn. A blade does not
    /// burn.
    pub burn_s: f64,
}

impl Tip {
    /// Returns how far the tip reaches from the tool's place, m: its radius, and the length of a blade's edge.
    pub fn reach_m(&self) -> f64 {
        self.radius_m + self.edge_m.length()
    }
}

impl Default for Tip {
    /// Returns the tip of a finger on wet tissue: a disc of 5 mm, μ = 0.2, no grasp, a constraint, no burning.
    fn default() -> Self {
        Tip {
            shape: TipShape::Disc,
            radius_m: 0.005,
            friction: 0.2,
            grasps: false,
            coupling: Coupling::Constraint,
            edge_m: DVec3::ZERO,
            burn_s: 0.0,
        }
    }
}
