//! Conversion between protobuf messages and our types. The defaults of absent fields are defined here, once.

pub mod codec;
pub mod command;
pub mod error;
pub mod local;
pub mod sample;
pub mod scene;

use glam::{DVec2, DVec3};

use crate::refusal::{Reason, Refusal, Result};

/// The generated code: messages, clients and servers of package `palpate.v1`.
#[allow(missing_docs, clippy::all, clippy::pedantic, clippy::unwrap_used, unreachable_pub, rust_2018_idioms)]
pub mod pb {
    tonic::include_proto!("palpate.v1");

    /// Every file of the protocol, for reflection.
    pub const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/palpate.bin"));
}

/// The value of a required field.
///
/// # Errors
/// Returns an error that names the field if it is absent.
pub(crate) fn required<T>(field: &str, value: Option<T>) -> Result<T> {
    value.ok_or_else(|| Refusal::new(Reason::Missing, field, "is missing"))
}

/// A vector as a message.
pub fn vector(v: DVec3) -> Option<pb::Vector3> {
    Some(pb::Vector3 { x: v.x, y: v.y, z: v.z })
}

/// The vector in a message; 0 if it is absent.
pub fn from_vector(v: Option<&pb::Vector3>) -> DVec3 {
    v.map_or(DVec3::ZERO, |v| DVec3::new(v.x, v.y, v.z))
}

/// The position in the rest plane in a message, m.
pub fn from_place(v: &pb::Vector2) -> DVec2 {
    DVec2::new(v.x, v.y)
}

/// A mass point as a message. Indices are below the limit of points, which is below 2³².
#[allow(clippy::cast_possible_truncation)]
pub fn point([x, y]: [usize; 2]) -> pb::GridPoint {
    pb::GridPoint { x: x as u32, y: y as u32 }
}

/// The mass point in a message: indices along x and y.
pub fn from_point(point: &pb::GridPoint) -> [usize; 2] {
    [point.x as usize, point.y as usize]
}

/// The N of an "every Nth step" field; 1 if it is absent.
///
/// # Errors
/// Returns an error if N is 0.
pub fn every(field: &str, steps: Option<u32>) -> Result<u64> {
    match steps {
        Some(0) => Err(Refusal::new(Reason::OutOfRange, field, "must be at least 1, but is 0")),
        steps => Ok(u64::from(steps.unwrap_or(1))),
    }
}
