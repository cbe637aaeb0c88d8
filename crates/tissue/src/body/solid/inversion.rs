//! Whether a solid is inside out somewhere.
//!
//! A cube knows H at its middle alone, and its hourglasses as the integral of μ|F|²/2 does, which no inversion at a corner
//! makes larger. So a part that was torn around by half a turn can come to rest within the rest of the solid, with J near 1 in the
//! middle of all cubes and below 0 at corners: no shape that a material has.

use glam::DVec3;

use super::corner_copies::{CornerCopies, corners_of};
use super::places::SolidPlaces;
use crate::kernel::field::Layout;
use crate::kernel::real::Real;

/// Returns whether a cube has J < 0 at a corner. There J is the determinant of the cube's three edges, divided by that at rest.
pub(crate) fn is_inverted<T: Real>(
    places: &SolidPlaces,
    copies: Option<&CornerCopies>,
    layout: &Layout,
    u: &[T],
) -> bool {
    let displacement = |place: usize| {
        let at = layout.offset(place);
        DVec3::from_array(std::array::from_fn(|c| u[c * layout.plane + at].wide()))
    };
    let has_inverted_corner = |cube: usize| {
        let corners = corners_of(places, copies, cube).map(displacement);
        let edge = |corner: usize, axis: usize| {
            let (near, far) = (corner & !(1 << axis), corner | 1 << axis);
            DVec3::AXES[axis] + corners[far] - corners[near]
        };
        (0..8).any(|corner| edge(corner, 0).dot(edge(corner, 1).cross(edge(corner, 2))) < 0.0)
    };
    (0..places.count()).filter(|cube| places.weight(*cube) > 0.0).any(has_inverted_corner)
}
