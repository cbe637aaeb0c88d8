//! Conversion between protobuf messages and our types. The defaults of absent fields are defined here, once. Messages, and
//! what clients convert as well, are in the crate `palpate-proto`.

pub mod command;
pub mod sample;
pub mod scene;

use palpate_proto::{geometry, pb};

use crate::refusal::{Reason, Refusal, Result};
use crate::shape::{Extent, PointName};

/// The value of a required field.
///
/// # Errors
/// Returns an error that names the field if it is absent.
pub(crate) fn required<T>(field: &str, value: Option<T>) -> Result<T> {
    value.ok_or_else(|| Refusal::new(Reason::Missing, field, "is missing"))
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

/// The name of a mass point as a message.
pub fn point(name: PointName) -> pb::GridPoint {
    match name {
        PointName::Point(place) => geometry::point(place),
        // Until the protocol has vertices: as the first of two indices.
        PointName::Vertex(vertex) => pb::GridPoint { x: vertex, y: 0 },
    }
}

/// The name of a mass point in a message.
pub fn from_point(point: &pb::GridPoint) -> PointName {
    PointName::Point(geometry::from_point(point))
}

/// Where a tissue rests, as a message.
pub fn extent(extent: &Extent) -> pb::Extent {
    let vector = geometry::vector;
    pb::Extent { least_m: vector(extent.least_m), most_m: vector(extent.most_m), middle_m: vector(extent.middle_m()) }
}
