//! Conversion of vectors and mass points.

use glam::{DVec2, DVec3};

use crate::pb;

/// Converts a vector to a message, never `None`: messages have their vectors as options.
pub fn vector(v: DVec3) -> Option<pb::Vector3> {
    Some(pb::Vector3 { x: v.x, y: v.y, z: v.z })
}

/// Returns the vector in a message; 0 if it is absent. Zeros are positive (`refusal::unsigned_zero`). Values that are
/// not finite stay as they are.
pub fn from_vector(v: Option<&pb::Vector3>) -> DVec3 {
    v.map_or(DVec3::ZERO, |v| DVec3::new(v.x, v.y, v.z) + DVec3::ZERO)
}

/// Returns the position in the rest plane of a sheet (x, y) in a message, m. Zeros are positive. Values that are not
/// finite stay as they are.
pub fn from_place(v: &pb::Vector2) -> DVec2 {
    DVec2::new(v.x, v.y) + DVec2::ZERO
}

/// Converts the grid indices of a mass point, along x and y, to a message. They must be below 2³², as all indices
/// within the limit of points are; larger ones lose their upper bits.
#[allow(clippy::cast_possible_truncation)]
pub fn point([x, y]: [usize; 2]) -> pb::GridPoint {
    pb::GridPoint { x: x as u32, y: y as u32 }
}

/// Returns the grid indices of the mass point in a message, along x and y, from 0. They may be beyond the grid.
pub fn from_point(point: &pb::GridPoint) -> [usize; 2] {
    [point.x as usize, point.y as usize]
}
