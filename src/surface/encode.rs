//! Frames: the refined displacements as bytes, in patches small enough that other streams get in between.

use bytes::Bytes;
use glam::DVec3;

use super::{Refinement, Snapshot};

/// How displacements are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Encoding {
    /// 4-byte IEEE floats, little-endian, m.
    F32,
    /// 2-byte signed integers over the frame's bounding box: displacement = origin + scale·q.
    I16,
}

impl Encoding {
    /// Three components.
    pub fn bytes_per_vertex(self) -> usize {
        match self {
            Encoding::F32 => 12,
            Encoding::I16 => 6,
        }
    }
}

/// Bytes of a patch at most: small messages of other streams wait no longer than one of these takes.
const PATCH_BYTES: usize = 64 << 10;

/// An encoded frame, shared by all viewers that asked for the same.
#[derive(Debug, Clone)]
pub struct Frame {
    /// Steps done.
    pub step: u64,
    /// s.
    pub simulation_time_s: f64,
    /// How far refined.
    pub refinement: Refinement,
    /// How written.
    pub encoding: Encoding,
    /// Middle of the bounding box for `I16`, else 0; m.
    pub origin_m: DVec3,
    /// Quantum for `I16`, else 1; m.
    pub scale_m: DVec3,
    /// Together all vertices.
    pub patches: Vec<Patch>,
}

/// A rectangle of vertices.
#[derive(Debug, Clone)]
pub struct Patch {
    /// The first vertex along x and y.
    pub first: [usize; 2],
    /// Vertices along x and y.
    pub count: [usize; 2],
    /// Displacements, three components a vertex, y running fastest.
    pub bytes: Bytes,
}

/// Refines and encodes.
pub fn encode(snapshot: &Snapshot, refinement: Refinement, encoding: Encoding) -> Frame {
    let (origin_m, scale_m) = match encoding {
        Encoding::F32 => (DVec3::ZERO, DVec3::ONE),
        Encoding::I16 => quantisation(&snapshot.displacement_m),
    };
    let [vertices_x, vertices_y] = refinement.vertices();
    // Whole rows, as many as fit; parts of a row where not even one does.
    let vertices = PATCH_BYTES / encoding.bytes_per_vertex();
    let columns_per_patch = vertices_y.min(vertices);
    let rows_per_patch = (vertices / vertices_y).max(1);
    let mut row: [Vec<f32>; 3] = std::array::from_fn(|_| vec![0.0; vertices_y]);
    #[allow(clippy::cast_possible_truncation)]
    let (origin, per_scale): ([f32; 3], [f32; 3]) = (
        origin_m.to_array().map(|v| v as f32),
        scale_m.to_array().map(|v| if v > 0.0 { v.recip() as f32 } else { 0.0 }),
    );
    let mut patch = |first: [usize; 2]| {
        let count = [rows_per_patch.min(vertices_x - first[0]), columns_per_patch.min(vertices_y - first[1])];
        let mut bytes = vec![0_u8; count[0] * count[1] * encoding.bytes_per_vertex()];
        for (a, out) in bytes.chunks_exact_mut(count[1] * encoding.bytes_per_vertex()).enumerate() {
            for (values, row) in snapshot.displacement_m.iter().zip(&mut row) {
                refinement.row(values, first[0] + a, row);
            }
            let [x, y, z] = row.each_ref().map(|row| &row[first[1]..first[1] + count[1]]);
            match encoding {
                Encoding::F32 => {
                    for (b, vertex) in out.as_chunks_mut::<12>().0.iter_mut().enumerate() {
                        let [p, q, r] = [x[b], y[b], z[b]].map(f32::to_le_bytes);
                        *vertex = [p[0], p[1], p[2], p[3], q[0], q[1], q[2], q[3], r[0], r[1], r[2], r[3]];
                    }
                }
                Encoding::I16 => {
                    for (b, vertex) in out.as_chunks_mut::<6>().0.iter_mut().enumerate() {
                        let values = [x[b], y[b], z[b]];
                        let [p, q, r] =
                            std::array::from_fn(|c| quantum((values[c] - origin[c]) * per_scale[c]).to_le_bytes());
                        *vertex = [p[0], p[1], q[0], q[1], r[0], r[1]];
                    }
                }
            }
        }
        Patch { first, count, bytes: Bytes::from(bytes) }
    };
    let mut patches = Vec::new();
    for x in (0..vertices_x).step_by(rows_per_patch) {
        patches.extend((0..vertices_y).step_by(columns_per_patch).map(|y| patch([x, y])));
    }
    let Snapshot { step, simulation_time_s, .. } = *snapshot;
    Frame { step, simulation_time_s, refinement, encoding, origin_m, scale_m, patches }
}

/// Nearest integer within ±32767, by the trick of the magic number: 1.5·2²³ + v has no bits left for the fraction.
#[allow(clippy::cast_possible_truncation)]
fn quantum(v: f32) -> i16 {
    const MAGIC: f32 = 12_582_912.0;
    ((v.clamp(-32767.0, 32767.0) + MAGIC).to_bits().wrapping_sub(MAGIC.to_bits())) as i16
}

/// Middle and quantum of the box around all displacements. Interpolated ones are within it too.
fn quantisation(displacement_m: &[Vec<f32>; 3]) -> (DVec3, DVec3) {
    let span = |values: &Vec<f32>| {
        let low = values.iter().copied().fold(f32::INFINITY, f32::min);
        let high = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        // A value of f32, which is what encodes; the box then reaches as far as its farther side.
        let middle = 0.5 * low + 0.5 * high;
        (f64::from(middle), f64::from((high - middle).max(middle - low)) / f64::from(i16::MAX))
    };
    let spans = displacement_m.each_ref().map(span);
    (DVec3::from_array(spans.map(|span| span.0)), DVec3::from_array(spans.map(|span| span.1)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::limits::Limits;

    fn snapshot() -> Snapshot {
        let wave = |k: usize, c: usize| ((k * (c + 3)) as f32 * 0.37).sin() * 10_f32.powi(-(c as i32));
        let displacement_m = std::array::from_fn(|c| (0..31 * 17).map(|k| wave(k, c)).collect());
        Snapshot { step: 7, simulation_time_s: 0.007, displacement_m }
    }

    /// Every vertex of a frame, decoded as a client does.
    fn decode(frame: &Frame) -> Vec<[f64; 3]> {
        let mut vertices = Vec::new();
        for patch in &frame.patches {
            match frame.encoding {
                Encoding::F32 => vertices.extend(patch.bytes.as_chunks::<12>().0.iter().map(|v| {
                    std::array::from_fn(|c| f64::from(f32::from_le_bytes(v[4 * c..4 * c + 4].try_into().unwrap())))
                })),
                Encoding::I16 => vertices.extend(patch.bytes.as_chunks::<6>().0.iter().map(|v| {
                    std::array::from_fn(|c| {
                        let q = i16::from_le_bytes(v[2 * c..2 * c + 2].try_into().unwrap());
                        frame.origin_m[c] + frame.scale_m[c] * f64::from(q)
                    })
                })),
            }
        }
        vertices
    }

    #[test]
    fn both_encodings_hold_every_vertex_and_i16_within_half_a_quantum() {
        let snapshot = snapshot();
        for n in [0, 1, 3, 10] {
            let grid = Refinement::new([31, 17], n, &Limits::default()).unwrap();
            let exact = encode(&snapshot, grid, Encoding::F32);
            let coarse = encode(&snapshot, grid, Encoding::I16);
            let [x, y] = grid.vertices();
            let (exact, decoded) = (decode(&exact), decode(&coarse));
            assert_eq!((exact.len(), decoded.len()), (x * y, x * y));
            for (a, b) in exact.iter().zip(&decoded) {
                for c in 0..3 {
                    let error = (a[c] - b[c]).abs();
                    // Half a quantum, and what f32 loses in between.
                    assert!(error <= 0.5 * coarse.scale_m[c] * 1.02, "{error} against {}", coarse.scale_m[c]);
                }
            }
        }
    }

    #[test]
    fn patches_are_small_and_tile_the_frame() {
        let grid = Refinement::new([31, 17], 10, &Limits::default()).unwrap();
        let frame = encode(&snapshot(), grid, Encoding::F32);
        let mut next = 0;
        for patch in &frame.patches {
            assert_eq!(patch.first, [next, 0]);
            assert!(patch.bytes.len() <= PATCH_BYTES);
            next += patch.count[0];
        }
        assert_eq!(next, grid.vertices()[0]);
        assert!(frame.patches.len() > 1);
    }

    #[test]
    fn a_long_row_is_split_too() {
        let displacement_m = std::array::from_fn(|c| (0..40_000).map(|k| (k + c) as f32).collect());
        let snapshot = Snapshot { step: 0, simulation_time_s: 0.0, displacement_m };
        let grid = Refinement::new([2, 20_000], 0, &Limits::default()).unwrap();
        let frame = encode(&snapshot, grid, Encoding::F32);
        assert!(frame.patches.iter().all(|patch| patch.bytes.len() <= PATCH_BYTES));
        for (vertex, value) in frame.patches.iter().flat_map(|patch| {
            let vertices = (0..patch.count[0] * patch.count[1]).map(|k| {
                let (a, b) = (k / patch.count[1], k % patch.count[1]);
                (patch.first[0] + a) * 20_000 + patch.first[1] + b
            });
            vertices.zip(patch.bytes.as_chunks::<12>().0)
        }) {
            assert_eq!(f32::from_le_bytes(value[..4].try_into().unwrap()), vertex as f32);
        }
    }

    #[test]
    fn a_still_tissue_is_encoded_exactly() {
        let still = Snapshot {
            step: 0,
            simulation_time_s: 0.0,
            displacement_m: std::array::from_fn(|c| vec![c as f32 * 0.25; 9]),
        };
        let grid = Refinement::new([3, 3], 1, &Limits::default()).unwrap();
        for vertex in decode(&encode(&still, grid, Encoding::I16)) {
            assert_eq!(vertex, [0.0, 0.25, 0.5]);
        }
    }
}
