//! Points, and springs between any two of them, as a kind of tissue describes itself to the kernel for meshes.

use glam::DVec3;
use thiserror::Error;

/// A spring between two points of a [`MeshGraph`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeshSpring {
    /// The numbers of the two points, from 0; they must differ.
    pub ends: [u32; 2],
    /// Stiffness k, N/m; 0 or more. The spring's rest length is the distance of the points at rest.
    pub stiffness_n_per_m: f64,
}

/// Points and springs of a tissue in any arrangement, in the numbering of its rest shape. The kernel for meshes checks
/// and takes it. Several springs may join the same points.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MeshGraph {
    /// Rest position of each point, m; 1 to 2²⁸ points.
    pub rest_m: Vec<DVec3>,
    /// The springs, each once (not from both ends); at most 2²⁸.
    pub springs: Vec<MeshSpring>,
    /// The unit of length h of the state (a "spacing"), m, above 0: about the length of a spring. Each spring must be
    /// 10⁻⁶ to 10⁶ of it long.
    pub spacing_m: f64,
    /// The mass of each point divided by the reference mass, above 0. Empty if all are 1.
    pub relative_mass: Vec<f64>,
    /// K″/m of each point divided by the reference value, minus 1: above 0 where the tissue is stiffer,
    /// −1 for a point without an anchor. Empty if all are 0.
    pub extra_anchor: Vec<f64>,
}

/// Reason why a [`MeshGraph`] can't be computed: its first fault. Numbers are from 0, in the graph's order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum GraphFault {
    /// No point, or more than 2²⁸ points or springs. Contains the number of points, also if there are too many
    /// springs.
    #[error("has {0} points: must have 1 to {most}", most = MAX_POINTS)]
    Count(usize),
    /// A list has some values, but not one for each point. Contains its length.
    #[error("has {0} masses or extra stiffnesses, not one for each point")]
    Length(usize),
    /// The unit of length is not a positive number.
    #[error("has a unit of length that is not a positive number")]
    Spacing,
    /// The place, mass or extra stiffness of the point of this number is not finite, or its mass is not positive.
    #[error("point {0} has a place, mass or extra stiffness that is not a number in its range")]
    Point(usize),
    /// The spring of this index joins a point to itself or to a missing point.
    #[error("spring {0} does not join two points")]
    Ends(usize),
    /// The stiffness of the spring of this index is negative or not finite.
    #[error("spring {0} has a stiffness that is negative or not finite")]
    Stiffness(usize),
    /// The spring of this index is shorter than 10⁻⁶ or longer than 10⁶ units of length: its strain can't be computed.
    #[error("spring {0} is shorter than a millionth of the unit of length, or longer than a million")]
    Rest(usize),
}

/// Largest number of points and of springs: records are counted in 32 bits.
const MAX_POINTS: usize = 1 << 28;

/// The range of rest lengths, in spacings: the squares of tiny strains stay in the normal range (`Real::FAINT`).
const LENGTHS: [f64; 2] = [1e-6, 1e6];

impl MeshGraph {
    /// Returns the mass of a point divided by the reference mass.
    pub(crate) fn mass(&self, point: u32) -> f64 {
        self.relative_mass.get(point as usize).copied().unwrap_or(1.0)
    }

    /// Returns the extra K″/m of a point.
    pub(crate) fn extra(&self, point: u32) -> f64 {
        self.extra_anchor.get(point as usize).copied().unwrap_or(0.0)
    }

    /// Returns the vector from one point to another at rest, in spacings. With the ends exchanged it is exactly
    /// the opposite.
    pub(crate) fn rest(&self, from: u32, to: u32) -> DVec3 {
        (self.rest_m[to as usize] - self.rest_m[from as usize]) / self.spacing_m
    }

    /// Checks that the graph can be computed. Returns the first fault.
    pub(crate) fn check(&self) -> Result<(), GraphFault> {
        let count = self.rest_m.len();
        if !(1..=MAX_POINTS).contains(&count) || self.springs.len() > MAX_POINTS {
            return Err(GraphFault::Count(count));
        }
        for list in [&self.relative_mass, &self.extra_anchor] {
            if !list.is_empty() && list.len() != count {
                return Err(GraphFault::Length(list.len()));
            }
        }
        if !(self.spacing_m.is_finite() && self.spacing_m > 0.0) {
            return Err(GraphFault::Spacing);
        }
        let is_good = |place: &DVec3| (*place / self.spacing_m).is_finite();
        let is_mass = |mass: &f64| mass.is_finite() && *mass > 0.0;
        let wrong = self.rest_m.iter().position(|place| !is_good(place));
        let wrong = wrong.or_else(|| self.relative_mass.iter().position(|mass| !is_mass(mass)));
        let wrong = wrong.or_else(|| self.extra_anchor.iter().position(|extra| !extra.is_finite()));
        if let Some(point) = wrong {
            return Err(GraphFault::Point(point));
        }
        for (index, spring) in self.springs.iter().enumerate() {
            let [a, b] = spring.ends;
            if a == b || a.max(b) as usize >= count {
                return Err(GraphFault::Ends(index));
            }
            if !(spring.stiffness_n_per_m.is_finite() && spring.stiffness_n_per_m >= 0.0) {
                return Err(GraphFault::Stiffness(index));
            }
            if !(LENGTHS[0]..=LENGTHS[1]).contains(&self.rest(a, b).length()) {
                return Err(GraphFault::Rest(index));
            }
        }
        Ok(())
    }
}
