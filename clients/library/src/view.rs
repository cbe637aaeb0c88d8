//! The frames of a session: how its surface is displaced, at the viewer's own rate.

use palpate_proto::geometry::from_vector;
use palpate_proto::pb;
use pb::view_service_client::ViewServiceClient;
use tonic::{Status, Streaming};

use crate::connect::Channel;

/// An open stream of a session's frames, and the surface as the frames received so far leave it. The stream ends when
/// this is dropped.
#[derive(Debug)]
pub struct Frames {
    parts: Streaming<pb::WatchFramesResponse>,
    surface: SurfaceState,
}

/// The displacement of a surface from rest, for applying frames by [`SurfaceState::write`]. Without any vertex before
/// the first frame.
///
/// A part of a frame says where two vertices of a surface of 1 × 2 are; the second is 2 mm deep:
///
/// ```
/// use palpate_client::view::SurfaceState;
/// use palpate_proto::pb;
///
/// let floats = [0.0_f32, 0.0, 0.0, 0.0, 0.0, -0.002];
/// let displacement: Vec<u8> = floats.iter().flat_map(|value| value.to_le_bytes()).collect();
/// let patch = pb::Patch { first_x: 0, first_y: 0, count_x: 1, count_y: 2, displacement: displacement.into() };
/// let part = pb::WatchFramesResponse { vertices_x: 1, vertices_y: 2, patches: vec![patch], ..Default::default() };
/// let mut surface = SurfaceState::default();
/// surface.write(&part)?;
/// assert_eq!(surface.displacement_m, [[0.0, 0.0, 0.0], [0.0, 0.0, -0.002]]);
/// # Ok::<(), String>(())
/// ```
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SurfaceState {
    /// Number of vertices along x and along y.
    pub vertices: [usize; 2],
    /// Displacement of each vertex, m, along x, y and z of the tissue's frame. Vertex (x, y) has index
    /// x·`vertices[1]` + y.
    pub displacement_m: Vec<[f32; 3]>,
}

/// Maximum number of vertices of a surface: 200 MB.
pub(crate) const MAX_VERTICES: usize = 1 << 24;

impl Frames {
    /// Starts to watch the frames that `request` describes, and waits until the server accepts. If `request` has
    /// `max_frames_in_flight`, acknowledge the frames by `ViewServiceClient::acknowledge_frames`: otherwise the server
    /// soon sends no more. Sets no time limit.
    ///
    /// # Errors
    /// Returns the server's refusal, or how the connection broke.
    pub async fn open(channel: Channel, request: pb::WatchFramesRequest) -> Result<Self, Status> {
        let parts = ViewServiceClient::new(channel).watch_frames(request).await?.into_inner();
        Ok(Frames { parts, surface: SurfaceState::default() })
    }

    /// Waits for the next part of a frame and returns it, without decoding its displacements; `None` after the server
    /// has ended the stream. The part is not applied to the surface of [`Frames::next`]: use only one of both methods.
    /// Dropping the future loses no part.
    ///
    /// # Errors
    /// Returns why the server ended the stream, or how the connection broke.
    pub async fn next_part(&mut self) -> Result<Option<pb::WatchFramesResponse>, Status> {
        self.parts.message().await
    }

    /// Waits for the next whole frame. Returns its last part, and the surface after it; `None` after the server has
    /// ended the stream. If you drop the future, the parts that were read stay in the surface.
    ///
    /// # Errors
    /// Returns why the server ended the stream or how the connection broke; `DATA_LOSS` with the error of
    /// [`SurfaceState::write`] if a part can't be applied.
    pub async fn next(&mut self) -> Result<Option<(pb::WatchFramesResponse, &SurfaceState)>, Status> {
        while let Some(part) = self.parts.message().await? {
            self.surface.write(&part).map_err(Status::data_loss)?;
            if part.last {
                return Ok(Some((part, &self.surface)));
            }
        }
        Ok(None)
    }
}

impl SurfaceState {
    /// Overwrites the displacements of the vertices in a part of a frame. If the part is of a surface of another size,
    /// first takes that size and sets all displacements to zero.
    ///
    /// # Errors
    /// Returns what is wrong with the part: a surface of more than 2²⁴ vertices, an unknown encoding, or a patch that
    /// reaches beyond the surface or whose number of bytes is not that of its vertices. Patches before a wrong one
    /// stay applied.
    pub fn write(&mut self, part: &pb::WatchFramesResponse) -> Result<(), String> {
        let vertices = [part.vertices_x as usize, part.vertices_y as usize];
        if vertices != self.vertices {
            let count = vertices[0].checked_mul(vertices[1]).filter(|count| *count <= MAX_VERTICES);
            let count = count.ok_or_else(|| format!("a surface of {} × {} vertices", vertices[0], vertices[1]))?;
            *self = SurfaceState { vertices, displacement_m: vec![[0.0; 3]; count] };
        }
        let array = |v: Option<&pb::Vector3>| from_vector(v).to_array();
        let (bytes, component, [origin_m, scale_m]): (usize, Component, _) = match part.encoding.try_into() {
            Ok(pb::Encoding::Unspecified | pb::Encoding::F32) => (12, as_f32, [[0.0; 3], [1.0; 3]]),
            Ok(pb::Encoding::I16) => (6, as_i16, [array(part.origin_m.as_ref()), array(part.scale_m.as_ref())]),
            Err(_) => return Err(format!("unknown encoding {}", part.encoding)),
        };
        for patch in &part.patches {
            let [first_x, first_y] = [patch.first_x as usize, patch.first_y as usize];
            let [count_x, count_y] = [patch.count_x as usize, patch.count_y as usize];
            if first_x.saturating_add(count_x) > vertices[0] || first_y.saturating_add(count_y) > vertices[1] {
                return Err("a patch is not on the surface".to_owned());
            }
            if patch.displacement.len() != count_x * count_y * bytes {
                return Err("the bytes of a patch are not those of its vertices".to_owned());
            }
            for (k, vertex) in patch.displacement.chunks_exact(bytes).enumerate() {
                let (x, y) = (first_x + k / count_y, first_y + k % count_y);
                #[allow(clippy::cast_possible_truncation)]
                let displacement_m = std::array::from_fn(|c| (origin_m[c] + scale_m[c] * component(vertex, c)) as f32);
                self.displacement_m[x * vertices[1] + y] = displacement_m;
            }
        }
        Ok(())
    }
}

/// Reads component `c` of an encoded vertex.
type Component = fn(&[u8], usize) -> f64;

fn as_f32(vertex: &[u8], c: usize) -> f64 {
    vertex[4 * c..].first_chunk().map_or(0.0, |bytes| f64::from(f32::from_le_bytes(*bytes)))
}

fn as_i16(vertex: &[u8], c: usize) -> f64 {
    vertex[2 * c..].first_chunk().map_or(0.0, |bytes| f64::from(i16::from_le_bytes(*bytes)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(encoding: pb::Encoding, patch: pb::Patch) -> pb::WatchFramesResponse {
        pb::WatchFramesResponse {
            vertices_x: 3,
            vertices_y: 2,
            encoding: encoding.into(),
            origin_m: Some(pb::Vector3 { x: 1.0, y: 0.0, z: -1.0 }),
            scale_m: Some(pb::Vector3 { x: 0.5, y: 0.25, z: 2.0 }),
            patches: vec![patch],
            ..Default::default()
        }
    }

    fn patch(first: [u32; 2], count: [u32; 2], bytes: Vec<u8>) -> pb::Patch {
        let ([first_x, first_y], [count_x, count_y]) = (first, count);
        pb::Patch { first_x, first_y, count_x, count_y, displacement: bytes.into() }
    }

    #[test]
    fn patches_are_written_over_the_surface() {
        let mut surface = SurfaceState::default();
        let values: Vec<f32> = (0..12).map(|k| 0.5 * k as f32).collect();
        let bytes = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        surface.write(&part(pb::Encoding::F32, patch([1, 0], [2, 2], bytes))).unwrap();
        let row = |k: usize| [values[3 * k], values[3 * k + 1], values[3 * k + 2]];
        assert_eq!(surface.vertices, [3, 2]);
        assert_eq!(surface.displacement_m, [[0.0; 3], [0.0; 3], row(0), row(1), row(2), row(3)]);
        // Vertices outside the patch stay as they are.
        let bytes = [2_i16, -4, 1].iter().flat_map(|q| q.to_le_bytes()).collect();
        surface.write(&part(pb::Encoding::I16, patch([1, 1], [1, 1], bytes))).unwrap();
        assert_eq!(surface.displacement_m[2..5], [row(0), [2.0, -1.0, 1.0], row(2)]);
    }

    #[test]
    fn what_does_not_fit_is_an_error() {
        let mut surface = SurfaceState::default();
        for (first, count, bytes) in [
            ([3, 0], [1, 1], 12),
            ([0, 1], [1, 2], 24),
            ([u32::MAX, 0], [1, 1], 12),
            ([0, 0], [1, 1], 11),
            ([0, 0], [0, 1], 12),
        ] {
            assert!(surface.write(&part(pb::Encoding::F32, patch(first, count, vec![0; bytes]))).is_err(), "{first:?}");
        }
        let unknown =
            pb::WatchFramesResponse { encoding: 7, ..part(pb::Encoding::F32, patch([0, 0], [1, 1], vec![0; 12])) };
        assert_eq!(surface.write(&unknown).unwrap_err(), "unknown encoding 7");
        let huge = pb::WatchFramesResponse { vertices_x: u32::MAX, vertices_y: u32::MAX, ..Default::default() };
        assert!(surface.write(&huge).is_err());
        // An empty patch is not an error, and neither is an empty surface.
        surface.write(&part(pb::Encoding::F32, patch([0, 0], [2, 0], Vec::new()))).unwrap();
        surface.write(&pb::WatchFramesResponse::default()).unwrap();
    }
}
