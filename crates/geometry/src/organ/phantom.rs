//! A phantom: the flat block of silicone in which tests of palpation embed their lumps. The seed varies nothing.

use glam::{BVec3, DVec3};

use super::shape::{Shape, sides};

/// Sides of the block, mm: it stands on z = 0, with the z axis in its middle.
const SIDES: DVec3 = DVec3::new(100.0, 100.0, 40.0);

/// Radius of its edges, mm.
const ROUNDING: f64 = 3.0;

/// Returns the shape of the phantom.
pub(super) fn shape() -> Shape {
    let distance = |place: DVec3| {
        let from_middle = place - DVec3::new(0.0, 0.0, SIDES.z / 2.0);
        let beyond = from_middle.abs() - (SIDES / 2.0 - ROUNDING);
        beyond.max(DVec3::ZERO).length() + beyond.max_element().min(0.0) - ROUNDING
    };
    let margin = DVec3::splat(8.0);
    let half = SIDES / 2.0;
    let extent = [DVec3::new(-half.x, -half.y, 0.0) - margin, DVec3::new(half.x, half.y, SIDES.z) + margin];
    Shape {
        distance: Box::new(distance),
        extent,
        cut: BVec3::FALSE,
        cell: 3.0,
        coarsest: 8.0,
        parts: vec![("base", Box::new(|place| place.z < 0.5))],
        chart: sides(extent),
    }
}
