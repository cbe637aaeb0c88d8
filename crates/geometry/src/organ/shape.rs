//! The shape of an organ, from which its mesh is generated. Lengths are in millimetres.

use glam::{BVec3, DVec3};

/// A function of a place.
pub(super) type OfPlace<T> = Box<dyn Fn(DVec3) -> T>;

/// A function that returns texture coordinates of a triangle's corners, from their positions.
pub(super) type Chart = Box<dyn Fn([DVec3; 3]) -> [[f32; 2]; 3]>;

/// The shape of an organ: its surface, its named parts, and its texture coordinates.
pub(super) struct Shape {
    /// The signed distance: 0 on the surface, positive on the side to touch. It need not be exact, but its gradient
    /// at the surface is about 1.
    pub(super) distance: OfPlace<f64>,
    /// The box that contains the surface: smallest and largest coordinates.
    pub(super) extent: [DVec3; 2],
    /// Axes at both of whose ends the box cuts the surface, which is open there. Elsewhere the box is a few cells
    /// larger than the surface.
    pub(super) cut: BVec3,
    /// Size of grid cells that resolves the thinnest part.
    pub(super) cell: f64,
    /// Longest edge length that still shows the thinnest part.
    pub(super) coarsest: f64,
    /// Names of parts, and whether a place is in each.
    pub(super) parts: Vec<(&'static str, OfPlace<bool>)>,
    /// The texture coordinates.
    pub(super) chart: Chart,
}

/// Step of the differences that compute the gradient, mm: much smaller than any radius of curvature.
const STEP: f64 = 1e-3;

/// The corners of a tetrahedron.
const CORNERS: [DVec3; 4] =
    [DVec3::new(1.0, -1.0, -1.0), DVec3::new(-1.0, -1.0, 1.0), DVec3::new(-1.0, 1.0, -1.0), DVec3::new(1.0, 1.0, 1.0)];

impl Shape {
    /// Returns the distance at a place and its gradient.
    fn slope(&self, place: DVec3) -> (f64, DVec3) {
        let (mut sum, mut gradient) = (0.0, DVec3::ZERO);
        for corner in CORNERS {
            let distance = (self.distance)(place + corner * STEP);
            sum += distance;
            gradient += corner * distance;
        }
        (sum / 4.0, gradient / (4.0 * STEP))
    }

    /// Moves a place near the surface onto it, by `times` steps of Newton's method, but not along the `held` axes.
    /// Returns the place, and the normal there.
    pub(super) fn settle(&self, mut place: DVec3, held: BVec3, times: usize) -> (DVec3, DVec3) {
        let mut normal = DVec3::ZERO;
        for _ in 0..times {
            let (distance, gradient) = self.slope(place);
            normal = gradient;
            let free = DVec3::select(held, DVec3::ZERO, gradient);
            let square = free.length_squared();
            if square > 1e-6 {
                place -= (free * (distance / square)).clamp_length_max(self.cell);
            }
        }
        (place, normal.normalize_or_zero())
    }
}

/// Returns texture coordinates by the six sides of a box: each triangle is projected along the axis nearest to its
/// normal, so no part is stretched by more than 1.8. The image covers the longest side; all sides share it.
pub(super) fn sides(extent: [DVec3; 2]) -> Chart {
    let (least, side) = (extent[0], (extent[1] - extent[0]).max_element());
    Box::new(move |corners| {
        let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]);
        let size = normal.abs();
        let axis = if size.x >= size.y && size.x >= size.z {
            0
        } else if size.y >= size.z {
            1
        } else {
            2
        };
        corners.map(|corner| {
            let place = (corner - least) / side;
            let (u, v) = (place[(axis + 1) % 3], place[(axis + 2) % 3]);
            // Seen from outside, the image is not mirrored.
            [if normal[axis] < 0.0 { 1.0 - u } else { u } as f32, v as f32]
        })
    })
}
