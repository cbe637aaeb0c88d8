//! Conversion between protobuf messages and our types. The defaults of absent fields are defined here, once. Messages, and
//! what clients convert as well, are in the crate `palpate-proto`.

pub mod command;
pub mod sample;
pub mod scene;

use palpate_proto::{geometry, pb};

use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::shape::{Extent, PointName};

/// Returns the value of a required field.
///
/// # Errors
/// Returns an error that names the field if it is absent.
pub fn required<T>(field: &str, value: Option<T>) -> Result<T> {
    value.ok_or_else(|| Refusal::new(Reason::Missing, field, "is missing"))
}

/// Returns the N of an "every Nth step" field; 1 if it is absent.
///
/// # Errors
/// Returns an error if N is 0.
pub fn every(field: &str, steps: Option<u32>) -> Result<u64> {
    match steps {
        Some(0) => Err(Refusal::new(Reason::OutOfRange, field, "must be at least 1, but is 0")),
        steps => Ok(u64::from(steps.unwrap_or(1))),
    }
}

/// Returns the name of a mass point as a message: the fields `point` and `vertex`.
pub fn point(name: PointName) -> (Option<pb::GridPoint>, Option<u32>) {
    match name {
        PointName::Point(place) => (Some(geometry::point(place)), None),
        PointName::Vertex(vertex) => (None, Some(vertex)),
    }
}

/// Returns the name of a mass point in the fields `point` and `vertex` of a message; `None` if neither is there.
pub fn from_point(point: Option<&pb::GridPoint>, vertex: Option<u32>) -> Option<PointName> {
    let vertex = vertex.map(PointName::Vertex);
    vertex.or_else(|| point.map(|point| PointName::Point(geometry::from_point(point))))
}

/// The name of a mass point of a record; the first point's if it has none.
fn from_record(point: &pb::PointRecord) -> PointName {
    from_point(point.point.as_ref(), point.vertex).unwrap_or(PointName::Point([0, 0]))
}

/// Returns the names of the mass points that a probe is of, and the field that has them; `None` for all points.
///
/// # Errors
/// Returns an error if the request does not say which.
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

/// Returns some mass points of a tissue as the subject of a probe.
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

/// Returns the box around a tissue or a mesh, as a message. Its `top_m` is absent.
pub fn extent(extent: &Extent) -> pb::Extent {
    let vector = geometry::vector;
    let [least_m, most_m, middle_m] = [extent.least_m, extent.most_m, extent.middle_m()].map(vector);
    pb::Extent { least_m, most_m, middle_m, top_m: None }
}
