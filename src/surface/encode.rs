//! Frames: the refined displacements as bytes, in patches small enough that other streams get in between.

use bytes::{Bytes, BytesMut};
use glam::DVec3;

use super::refine::{Order, Rows};
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

impl Frame {
    /// A frame with its patches laid out, but without bytes.
    fn blank(refinement: Refinement, encoding: Encoding) -> Self {
        let [vertices_x, vertices_y] = refinement.vertices();
        // Whole rows, as many as fit; parts of a row where not even one does.
        let vertices = PATCH_BYTES / encoding.bytes_per_vertex();
        let columns_per_patch = vertices_y.min(vertices);
        let rows_per_patch = (vertices / vertices_y).max(1);
        let mut patches = Vec::new();
        for x in (0..vertices_x).step_by(rows_per_patch) {
            patches.extend((0..vertices_y).step_by(columns_per_patch).map(|y| Patch {
                first: [x, y],
                count: [rows_per_patch.min(vertices_x - x), columns_per_patch.min(vertices_y - y)],
                bytes: Bytes::new(),
            }));
        }
        let (origin_m, scale_m) = (DVec3::ZERO, DVec3::ONE);
        Frame { step: 0, simulation_time_s: 0.0, refinement, encoding, origin_m, scale_m, patches }
    }
}

/// Refines and encodes `snapshot`, whose points are those of `refinement`.
pub fn encode(snapshot: &Snapshot, refinement: Refinement, encoding: Encoding) -> Frame {
    encode_over(snapshot, Frame::blank(refinement, encoding))
}

/// Makes the next frame of the kind of `spent`, in its buffers where nobody else holds them: fresh memory costs more
/// than what is written into it.
#[allow(clippy::cast_possible_truncation)]
pub fn encode_over(snapshot: &Snapshot, spent: Frame) -> Frame {
    let mut frame = Frame { step: snapshot.step, simulation_time_s: snapshot.simulation_time_s, ..spent };
    let (grid, values) = (frame.refinement, &snapshot.displacement_m);
    match frame.encoding {
        Encoding::F32 => {
            fill(&mut frame.patches, Rows::new(grid, values, Order::XThenY, |_, v| v), f32::to_le_bytes);
        }
        Encoding::I16 => {
            (frame.origin_m, frame.scale_m) = quantisation(values);
            let origin = frame.origin_m.to_array().map(|v| v as f32);
            let per_scale = frame.scale_m.to_array().map(|v| if v > 0.0 { v.recip() as f32 } else { 0.0 });
            // Points become quanta before they are refined: there are fewer of them than vertices.
            let quanta = |c: usize, v: f32| ((v - origin[c]) * per_scale[c]).clamp(-32767.0, 32767.0);
            fill(&mut frame.patches, Rows::new(grid, values, Order::YThenX, quanta), |v| quantum(v).to_le_bytes());
        }
    }
    frame
}

/// Writes all rows into the patches, `BYTES` a component.
fn fill<const BYTES: usize>(
    patches: &mut [Patch],
    mut rows: Rows<'_, impl Fn(usize, f32) -> f32>,
    put: impl Fn(f32) -> [u8; BYTES] + Copy,
) {
    let mut parted = Vec::new();
    for band in patches.chunk_by_mut(|a, b| a.first[0] == b.first[0]) {
        let ([x, _], rows_of_band) = (band[0].first, band[0].count[0]);
        if let [patch] = band {
            let row_bytes = 3 * BYTES * patch.count[1];
            let mut bytes = patch.buffer(rows_of_band * row_bytes);
            for (a, row) in bytes.chunks_exact_mut(row_bytes).enumerate() {
                rows.write(x + a, row.as_chunks_mut().0, put);
            }
            patch.bytes = bytes.freeze();
        } else {
            // One row, in parts.
            parted.resize(3 * band.iter().map(|patch| patch.count[1]).sum::<usize>(), [0; BYTES]);
            rows.write(x, &mut parted, put);
            for patch in band {
                let part = parted[3 * patch.first[1]..][..3 * patch.count[1]].as_flattened();
                let mut bytes = patch.buffer(part.len());
                bytes.copy_from_slice(part);
                patch.bytes = bytes.freeze();
            }
        }
    }
}

impl Patch {
    /// `length` bytes to write to: the patch's own, if nobody else reads them.
    fn buffer(&mut self, length: usize) -> BytesMut {
        let mut bytes = std::mem::take(&mut self.bytes).try_into_mut().unwrap_or_default();
        bytes.resize(length, 0);
        bytes
    }
}

/// Nearest integer, within ±32767 as `v` is, by the trick of the magic number: 1.5·2²³ + v has no bits left for the
/// fraction, and its last 16 are those of the integer.
#[allow(clippy::cast_possible_truncation)]
fn quantum(v: f32) -> i16 {
    const MAGIC: f32 = 12_582_912.0;
    (v + MAGIC).to_bits() as i16
}

/// Middle and quantum of the box around all displacements. Interpolated ones are within it too.
fn quantisation(displacement_m: &[Vec<f32>; 3]) -> (DVec3, DVec3) {
    let span = |values: &Vec<f32>| {
        let low = -greatest(values, |v| -v);
        let high = greatest(values, |v| v);
        // A value of f32, which is what encodes; the box then reaches as far as its farther side.
        let middle = 0.5 * low + 0.5 * high;
        (f64::from(middle), f64::from((high - middle).max(middle - low)) / f64::from(i16::MAX))
    };
    let spans = displacement_m.each_ref().map(span);
    (DVec3::from_array(spans.map(|span| span.0)), DVec3::from_array(spans.map(|span| span.1)))
}

/// The greatest of `of(value)`, in as many lanes as hide the time of a comparison.
fn greatest(values: &[f32], of: impl Fn(f32) -> f32) -> f32 {
    let (chunks, rest) = values.as_chunks::<16>();
    let lanes = chunks.iter().fold([f32::NEG_INFINITY; 16], |mut lanes, chunk| {
        for (lane, value) in lanes.iter_mut().zip(chunk) {
            if of(*value) > *lane {
                *lane = of(*value);
            }
        }
        lanes
    });
    rest.iter().map(|value| of(*value)).chain(lanes).fold(f32::NEG_INFINITY, f32::max)
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
    fn f32_frames_are_the_formula_bit_for_bit() {
        let snapshot = snapshot();
        for n in 0..=10 {
            let cells = n as usize + 1;
            let grid = Refinement::new([31, 17], n, &Limits::default()).unwrap();
            let frame = encode(&snapshot, grid, Encoding::F32);
            let bytes = frame.patches.iter().flat_map(|patch| patch.bytes.as_chunks::<12>().0);
            for (index, bytes) in bytes.enumerate() {
                let [a, b] = [index / grid.vertices()[1], index % grid.vertices()[1]];
                for (c, values) in snapshot.displacement_m.iter().enumerate() {
                    let at = |j: usize| {
                        let (near, far) = (values[a / cells * 17 + j], values[a.div_ceil(cells) * 17 + j]);
                        near + (a % cells) as f32 / cells as f32 * (far - near)
                    };
                    let (left, right) = (at(b / cells), at(b.div_ceil(cells)));
                    let value = left + (right - left) / cells as f32 * (b % cells) as f32;
                    assert_eq!(bytes[4 * c..4 * c + 4], value.to_le_bytes(), "n = {n}, ({a}, {b})");
                }
            }
        }
    }

    #[test]
    fn a_spent_frame_lends_the_buffers_that_nobody_reads() {
        for encoding in [Encoding::F32, Encoding::I16] {
            let grid = Refinement::new([31, 17], 10, &Limits::default()).unwrap();
            let first = encode(&snapshot(), grid, encoding);
            let (held, place) = (first.patches[0].bytes.clone(), first.patches[1].bytes.as_ptr());
            let before = held.to_vec();
            let mut moved = snapshot();
            moved.displacement_m.iter_mut().flatten().for_each(|v| *v = 1.0 - 2.0 * *v);
            let second = encode_over(&moved, first);
            assert_eq!((second.patches[1].bytes.as_ptr(), held), (place, before.into()));
            assert_eq!(decode(&second), decode(&encode(&moved, grid, encoding)));
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
