//! Protobuf messages to our types and back. What a message leaves out is said here, once.

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

/// A required message.
pub(crate) fn required<T>(field: &str, value: Option<T>) -> Result<T> {
    value.ok_or_else(|| Refusal::new(Reason::Missing, field, "is missing"))
}

/// A vector.
pub fn vector(v: DVec3) -> Option<pb::Vector3> {
    Some(pb::Vector3 { x: v.x, y: v.y, z: v.z })
}

/// A vector. An absent one is 0.
pub fn from_vector(v: Option<&pb::Vector3>) -> DVec3 {
    v.map_or(DVec3::ZERO, |v| DVec3::new(v.x, v.y, v.z))
}

/// A place in the rest plane.
pub fn from_place(v: &pb::Vector2) -> DVec2 {
    DVec2::new(v.x, v.y)
}

/// A mass point. Indices are below the limit of points, which is below 2³².
#[allow(clippy::cast_possible_truncation)]
pub fn point([x, y]: [usize; 2]) -> pb::GridPoint {
    pb::GridPoint { x: x as u32, y: y as u32 }
}

/// A mass point.
pub fn from_point(point: &pb::GridPoint) -> [usize; 2] {
    [point.x as usize, point.y as usize]
}

/// "Every Nth": 1 if absent; 0 is refused.
pub fn every(field: &str, steps: Option<u32>) -> Result<u64> {
    match steps {
        Some(0) => Err(Refusal::new(Reason::OutOfRange, field, "must be at least 1, but is 0")),
        steps => Ok(u64::from(steps.unwrap_or(1))),
    }
}
