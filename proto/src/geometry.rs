//! Conversion of vectors and mass points.

use glam::{DVec2, DVec3};

use crate::pb;

/// Converts a vector to a message.
pub fn vector(v: DVec3) -> Option<pb::Vector3> {
    Some(pb::Vector3 { x: v.x, y: v.y, z: v.z })
}

/// Returns the vector in a message; 0 if it is absent. Zeros are positive (`refusal::unsigned_zero`).
pub fn from_vector(v: Option<&pb::Vector3>) -> DVec3 {
    v.map_or(DVec3::ZERO, |v| DVec3::new(v.x, v.y, v.z) + DVec3::ZERO)
}

/// Returns the position in the rest plane in a message, m. Zeros are positive.
pub fn from_place(v: &pb::Vector2) -> DVec2 {
    DVec2::new(v.x, v.y) + DVec2::ZERO
}

/// Converts the grid indices of a mass point to a message. Indices are below the limit of points, which is below 2³².
#[allow(clippy::cast_possible_truncation)]
pub fn point([x, y]: [usize; 2]) -> pb::GridPoint {
    pb::GridPoint { x: x as u32, y: y as u32 }
}

/// Returns the grid indices of the mass point in a message, along x and y.
pub fn from_point(point: &pb::GridPoint) -> [usize; 2] {
    [point.x as usize, point.y as usize]
}
