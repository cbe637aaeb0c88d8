//! Conversion between protobuf messages and the types of this crate. The defaults of absent fields are defined
//! here. The messages, and conversions that clients need too, are in the crate `palpate-proto`.

pub mod command;
pub mod sample;
pub mod scene;

use palpate_proto::{geometry, pb};

use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::shape::{Extent, PointName};

/// Returns the value of a required field.
///
/// # Errors
/// Refuses an absent field, by the name `field` ([`Reason::Missing`]).
pub fn required<T>(field: &str, value: Option<T>) -> Result<T> {
    value.ok_or_else(|| Refusal::new(Reason::Missing, field, "is missing"))
}

/// Returns the N of an "every Nth step" field; 1 if it is absent.
///
/// # Errors
/// Refuses 0, by the name `field` ([`Reason::OutOfRange`]).
pub fn every(field: &str, steps: Option<u32>) -> Result<u64> {
    match steps {
        Some(0) => Err(Refusal::new(Reason::OutOfRange, field, "must be at least 1, but is 0")),
        steps => Ok(u64::from(steps.unwrap_or(1))),
    }
}

/// Returns the name of a mass point as the message fields `point` (of a sheet) and `vertex` (of a mesh); one of
/// them is `None`.
pub fn point(name: PointName) -> (Option<pb::GridPoint>, Option<u32>) {
    match name {
        PointName::Point(place) => (Some(geometry::point(place)), None),
        PointName::Vertex(vertex) => (None, Some(vertex)),
    }
}

/// Returns the name of a mass point from the message fields `point` and `vertex`, of which `vertex` wins; `None` if
/// both are absent.
pub fn from_point(point: Option<&pb::GridPoint>, vertex: Option<u32>) -> Option<PointName> {
    let vertex = vertex.map(PointName::Vertex);
    vertex.or_else(|| point.map(|point| PointName::Point(geometry::from_point(point))))
}

/// Returns the name of a record's mass point; the first point of a sheet if it has none.
fn from_record(point: &pb::PointRecord) -> PointName {
    from_point(point.point.as_ref(), point.vertex).unwrap_or(PointName::Point([0, 0]))
}

/// Returns the mass points that a probe requests, in their order, with the name of the field that has them; `None`
/// for all points. It does not check that the tissue has them.
///
/// # Errors
/// Refuses a request that names neither points nor vertices nor all of them ([`Reason::Missing`]).
pub fn from_probed(r#where: Option<&pb::probe_request::Where>) -> Result<Option<(&'static str, Vec<PointName>)>> {
    use pb::probe_request::Where;
    match r#where {
        Some(Where::Points(named)) => {
            let names = named.points.iter().map(|point| PointName::Point(geometry::from_point(point)));
            Ok(Some(("points", names.collect())))
        }
        Some(Where::Vertices(named)) => {
            Ok(Some(("vertices", named.vertices.iter().copied().map(PointName::Vertex).collect())))
        }
        Some(Where::AllPoints(true)) => Ok(None),
        Some(Where::AllPoints(false)) | None => {
            Err(Refusal::new(Reason::Missing, "where", "points, vertices or all_points is missing"))
        }
    }
}

/// Returns the request of a probe for these mass points, in their order. If any is a vertex of a mesh, points of a
/// sheet are left out.
pub fn probed(names: impl Iterator<Item = PointName>) -> pb::probe_request::Where {
    let (mut points, mut vertices) = (Vec::new(), Vec::new());
    for name in names {
        let (point, vertex) = self::point(name);
        points.extend(point);
        vertices.extend(vertex);
    }
    if vertices.is_empty() {
        pb::probe_request::Where::Points(pb::GridPoints { points })
    } else {
        pb::probe_request::Where::Vertices(pb::Vertices { vertices })
    }
}

/// Returns the box around a tissue or a mesh as a message, m: its least and greatest corner and its middle, without
/// `top_m`.
pub fn extent(extent: &Extent) -> pb::Extent {
    let vector = geometry::vector;
    let [least_m, most_m, middle_m] = [extent.least_m, extent.most_m, extent.middle_m()].map(vector);
    pb::Extent { least_m, most_m, middle_m, top_m: None }
}
