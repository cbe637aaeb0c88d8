//! Frames: the refined displacements as bytes, in patches that are small enough for other streams to interleave
//! with.
// The compiler does not always inline iterators over vectors. They then run without the caller's instructions.
#![allow(clippy::needless_range_loop)]

use bytes::{Bytes, BytesMut};
use glam::DVec3;

use super::displacements::Snapshot;
use super::refine::Refinement;
use super::refine::{COMPONENTS, Points, Rows, Source, Written};
use super::wide::{Available, SixteenLanes, WideWork, Width};
use palpate_tissue::memory;

/// Number format of displacements in a frame: three components for each vertex.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Encoding {
    /// 4-byte IEEE floats, little-endian, m.
    F32,
    /// 2-byte signed integers q, little-endian, within ±32767, over the bounding box of the displacements:
    /// displacement = origin + scale·q ([`Quanta`]).
    I16,
}

impl Encoding {
    /// Every encoding, in the order of declaration.
    pub const ALL: [Encoding; 2] = [Encoding::F32, Encoding::I16];

    /// Returns the bytes of the three components of a vertex: 12 or 6.
    pub fn bytes_per_vertex(self) -> usize {
        match self {
            Encoding::F32 => 12,
            Encoding::I16 => 6,
        }
    }

    /// Returns the largest integer q in displacement = origin + scale·q, 32767; the least is its negative. `None` for
    /// floats.
    pub fn largest_integer(self) -> Option<f64> {
        match self {
            Encoding::F32 => None,
            Encoding::I16 => Some(f64::from(i16::MAX)),
        }
    }
}

/// Size limit of a patch, bytes: a small message of another stream waits for one patch at most.
const PATCH_BYTES: usize = 64 << 10;

/// An encoded frame: the displacements of a tissue's surface at one moment. All viewers that request its refinement
/// and encoding share it.
#[derive(Debug, Clone)]
pub struct Frame {
    /// Number of steps done at its moment.
    pub step: u64,
    /// Simulated time, s.
    pub simulation_time_s: f64,
    /// The version of the topology then.
    pub topology_version: u32,
    /// The version of what was burnt then.
    pub burn_version: u32,
    /// Refinement of the surface.
    pub refinement: Refinement,
    /// Number format of the displacements.
    pub encoding: Encoding,
    /// Scale and origin of the encoding's integers, for all patches.
    pub quanta: Quanta,
    /// Whether the patches have every vertex, and not only those that changed.
    pub full: bool,
    /// The patches, which share no vertex; empty if nothing has changed. A patch has at most 64 KiB.
    pub patches: Vec<Patch>,
}

/// Scale and origin of a frame's integers q: a displacement is origin + scale·q for each component, m.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Quanta {
    /// Displacement at q = 0, m: the middle of the bounding box for integers, 0 for floats.
    pub origin_m: DVec3,
    /// Displacement of one integer step along each axis, m; 1 for floats.
    pub scale_m: DVec3,
}

impl Default for Quanta {
    fn default() -> Self {
        Quanta { origin_m: DVec3::ZERO, scale_m: DVec3::ONE }
    }
}

impl Quanta {
    /// Returns the finest quanta that the integers of `encoding` allow in a box, but none finer than `finest_m`.
    /// Interpolation between values in the box stays in the box. `box_m`: least and greatest value of each
    /// component, m.
    pub(super) fn over(encoding: Encoding, box_m: &[[f32; 2]; COMPONENTS], finest_m: f64) -> Self {
        let Some(largest) = encoding.largest_integer() else { return Quanta::default() };
        let spans = box_m.map(|[low, high]| {
            // Round to f32, the encoder's format. The box then reaches as far as its farther side.
            let middle = 0.5 * low + 0.5 * high;
            let quantum = f64::from((high - middle).max(middle - low)) / largest;
            (f64::from(middle), quantum.max(finest_m))
        });
        Quanta { origin_m: spans.map(|span| span.0).into(), scale_m: spans.map(|span| span.1).into() }
    }

    /// Returns how far a point may move along each axis before `encoding` shows it, m: half a quantum; 0 for
    /// floats.
    #[allow(clippy::cast_possible_truncation)]
    pub(super) fn unseen_m(&self, encoding: Encoding) -> [f32; COMPONENTS] {
        match encoding.largest_integer() {
            None => [0.0; COMPONENTS],
            Some(_) => self.scale_m.to_array().map(|scale_m| (0.5 * scale_m) as f32),
        }
    }

    /// Returns a source that writes `points` in these quanta.
    #[allow(clippy::cast_possible_truncation)]
    pub(super) fn source<'v>(&self, points: Points<'v>) -> Source<'v> {
        // A box without extent holds only its middle.
        let per_scale = |scale_m: f64| Some(scale_m.recip() as f32).filter(|per_scale| per_scale.is_finite());
        let per_scale = self.scale_m.to_array().map(|scale_m| per_scale(scale_m).unwrap_or(0.0));
        Source::new(points, self.origin_m.to_array().map(|v| v as f32), per_scale)
    }
}

/// A rectangle of vertices in a frame, with their displacements.
#[derive(Debug, Clone)]
pub struct Patch {
    /// Indices i and j of the first vertex, along x and y; of a mesh, its row and place.
    pub first: [usize; 2],
    /// Number of vertices along x and y; of a mesh, rows and places.
    pub count: [usize; 2],
    /// Displacements in the frame's encoding: x, y and z of each vertex together, in the tissue's frame. The index
    /// along y runs fastest.
    pub bytes: Bytes,
}

impl Frame {
    /// Creates a frame with its patches laid out, but without bytes.
    fn blank(refinement: Refinement, encoding: Encoding) -> Self {
        let patches = lay_out([0, 0], refinement.vertices(), encoding);
        Frame {
            step: 0,
            simulation_time_s: 0.0,
            topology_version: 0,
            burn_version: 0,
            refinement,
            encoding,
            quanta: Quanta::default(),
            full: true,
            patches,
        }
    }
}

/// Returns patches without bytes that cover a rectangle of vertices.
pub(super) fn lay_out(first: [usize; 2], [count_x, count_y]: [usize; 2], encoding: Encoding) -> Vec<Patch> {
    // Whole rows, as many as fit, or parts of a row if a whole one does not fit.
    let vertices = PATCH_BYTES / encoding.bytes_per_vertex();
    let columns_per_patch = count_y.min(vertices);
    let rows_per_patch = (vertices / count_y).max(1);
    let mut patches = Vec::new();
    for x in (0..count_x).step_by(rows_per_patch) {
        patches.extend((0..count_y).step_by(columns_per_patch).map(|y| Patch {
            first: [first[0] + x, first[1] + y],
            count: [rows_per_patch.min(count_x - x), columns_per_patch.min(count_y - y)],
            bytes: Bytes::new(),
        }));
    }
    patches
}

/// Refines and encodes `snapshot`, whose points must be those of `refinement` (of the same scene). Returns a full
/// frame. It unwinds with a refusal if there is no memory for a row (`palpate_tissue::memory`).
///
/// A sheet of 3 × 3 points, whose middle is 2 mm deep, with a vertex between neighbours: 5 × 5 vertices, of which the
/// one beside the middle is 1 mm deep.
///
/// ```
/// use palpate_session::surface::{Encoding, Refinement, Snapshot, encode};
/// use palpate_tissue::limits::Limits;
/// use palpate_tissue::scene::{PAPER, Scene};
///
/// let limits = Limits::default();
/// let scene = Scene::parse("paper", PAPER, &["sheet.points=[3, 3]".to_owned()], &limits)?;
/// let mut z_m = vec![0.0; 9];
/// z_m[4] = -0.002;
/// let snapshot = Snapshot::new(&scene, 100, 0.1, [vec![0.0; 9], vec![0.0; 9], z_m]);
/// let frame = encode(&snapshot, Refinement::new(&scene, 1, &limits)?, Encoding::F32);
/// assert!(frame.full && frame.refinement.vertices() == [5, 5]);
/// let bytes = &frame.patches[0].bytes;
/// // Vertex [1, 2]: x, y and z as floats of 4 bytes.
/// let z = &bytes[12 * (5 + 2) + 8..][..4];
/// let depth_m = -f32::from_le_bytes([z[0], z[1], z[2], z[3]]);
/// assert!((depth_m - 0.001).abs() < 1e-9, "{depth_m} m");
/// # Ok::<(), palpate_refusal::Refusal>(())
/// ```
pub fn encode(snapshot: &Snapshot, refinement: Refinement, encoding: Encoding) -> Frame {
    encode_over(snapshot, Frame::blank(refinement, encoding))
}

/// Refines and encodes `snapshot` in the refinement and encoding of `spent`, which must be a full frame of the same
/// tissue. Returns a full frame. Reuses the buffers of `spent` that nothing else holds: fresh memory costs more than
/// writing the frame.
pub fn encode_over(snapshot: &Snapshot, spent: Frame) -> Frame {
    encode_at(Width::widest(), snapshot, spent)
}

fn encode_at(width: Width, snapshot: &Snapshot, spent: Frame) -> Frame {
    let Snapshot { step, simulation_time_s, topology_version, burn_version, .. } = *snapshot;
    let mut frame = Frame { step, simulation_time_s, topology_version, burn_version, ..spent };
    frame.quanta = Quanta::over(frame.encoding, snapshot.box_m(frame.refinement), 0.0);
    let grid = frame.refinement;
    let mut rows = Rows::new(grid.between, grid.vertices()[1], frame.quanta.source(snapshot.points(grid)));
    fill(width, frame.encoding, &mut frame.patches, &mut rows);
    frame
}

/// Refines and encodes the rows into patches that were laid out for them.
pub(super) fn fill(width: Width, encoding: Encoding, patches: &mut [Patch], rows: &mut Rows<'_>) {
    match encoding {
        Encoding::F32 => width.run(Fill::<4> { patches, rows }),
        Encoding::I16 => width.run(Fill::<2> { patches, rows }),
    }
}

/// Work of writing all rows into the patches, with `BYTES` bytes per component.
struct Fill<'f, 'v, const BYTES: usize> {
    patches: &'f mut [Patch],
    rows: &'f mut Rows<'v>,
}

impl<const BYTES: usize> WideWork for Fill<'_, '_, BYTES>
where
    [u8; BYTES]: Written,
{
    #[inline(always)]
    fn work<L: SixteenLanes>(self, with: Available<L>) {
        let Fill { patches, rows } = self;
        let [first_x, first_y] = patches.first().map_or([0, 0], |patch| patch.first);
        let mut parted = Vec::new();
        for band in patches.chunk_by_mut(|a, b| a.first[0] == b.first[0]) {
            let ([x, _], rows_of_band) = (band[0].first, band[0].count[0]);
            if let [patch] = band {
                let row_bytes = COMPONENTS * BYTES * patch.count[1];
                let mut bytes = patch.buffer(rows_of_band * row_bytes);
                for (a, row) in bytes.chunks_exact_mut(row_bytes).enumerate() {
                    rows.write(with, x - first_x + a, row.as_chunks_mut::<BYTES>().0);
                }
                patch.bytes = bytes.freeze();
            } else {
                // A single row, in parts.
                let length = COMPONENTS * band.iter().map(|patch| patch.count[1]).sum::<usize>();
                if parted.len() != length {
                    parted = memory::filled(length, [0; BYTES], "a row of a frame");
                }
                rows.write(with, x - first_x, &mut parted);
                for patch in band {
                    let part =
                        parted[COMPONENTS * (patch.first[1] - first_y)..][..COMPONENTS * patch.count[1]].as_flattened();
                    let mut bytes = patch.buffer(part.len());
                    bytes.copy_from_slice(part);
                    patch.bytes = bytes.freeze();
                }
            }
        }
    }
}

impl Patch {
    /// Returns a buffer of `length` bytes: the patch's own, if nothing else reads it.
    fn buffer(&mut self, length: usize) -> BytesMut {
        let mut bytes = std::mem::take(&mut self.bytes).try_into_mut().unwrap_or_default();
        bytes.resize(length, 0);
        bytes
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::surface::scene;
    use palpate_tissue::limits::Limits;

    fn snapshot() -> Snapshot {
        let wave = |k: usize, c: usize| ((k * (c + 3)) as f32 * 0.37).sin() * 10_f32.powi(-(c as i32));
        Snapshot::new(&scene([31, 17]), 7, 0.007, std::array::from_fn(|c| (0..31 * 17).map(|k| wave(k, c)).collect()))
    }

    /// Reads a signed integer of any length, little-endian.
    fn integer(bytes: &[u8]) -> i64 {
        let sign = if bytes.last().is_some_and(|byte| *byte >= 0x80) { -1 } else { 0 };
        bytes.iter().rev().fold(sign, |q, byte| q << 8 | i64::from(*byte))
    }

    /// Decodes the vertices of a patch as a client does.
    pub(in crate::surface) fn decoded(frame: &Frame, patch: &Patch) -> Vec<[f64; 3]> {
        let size = frame.encoding.bytes_per_vertex();
        assert_eq!(patch.bytes.len(), patch.count[0] * patch.count[1] * size);
        let component = |c: usize, bytes: &[u8]| match frame.encoding.largest_integer() {
            None => f64::from(f32::from_le_bytes(bytes.try_into().unwrap())),
            Some(_) => frame.quanta.origin_m[c] + frame.quanta.scale_m[c] * integer(bytes) as f64,
        };
        let part = size / COMPONENTS;
        let vertex = |bytes: &[u8]| std::array::from_fn(|c| component(c, &bytes[c * part..(c + 1) * part]));
        patch.bytes.chunks(size).map(vertex).collect()
    }

    /// Decodes every vertex of a frame.
    fn decode(frame: &Frame) -> Vec<[f64; 3]> {
        frame.patches.iter().flat_map(|patch| decoded(frame, patch)).collect()
    }

    #[test]
    fn every_encoding_holds_every_vertex_and_integers_within_half_a_quantum() {
        let snapshot = snapshot();
        let integers = Encoding::ALL.into_iter().filter(|encoding| encoding.largest_integer().is_some());
        for (encoding, n) in integers.flat_map(|encoding| [0, 1, 3, 10].map(|n| (encoding, n))) {
            let grid = Refinement::new(&scene([31, 17]), n, &Limits::default()).unwrap();
            let exact = encode(&snapshot, grid, Encoding::F32);
            let coarse = encode(&snapshot, grid, encoding);
            let [x, y] = grid.vertices();
            let (exact, decoded) = (decode(&exact), decode(&coarse));
            assert_eq!((exact.len(), decoded.len()), (x * y, x * y));
            for (a, b) in exact.iter().zip(&decoded) {
                for c in 0..3 {
                    let error = (a[c] - b[c]).abs();
                    // Half a quantum, plus the f32 rounding error in between.
                    assert!(
                        error <= 0.5 * coarse.quanta.scale_m[c] * 1.02,
                        "{error} against {}",
                        coarse.quanta.scale_m[c]
                    );
                }
            }
        }
    }

    #[test]
    fn f32_frames_are_the_formula_bit_for_bit() {
        let snapshot = snapshot();
        for n in 0..=10 {
            let cells = n as usize + 1;
            let grid = Refinement::new(&scene([31, 17]), n, &Limits::default()).unwrap();
            let frame = encode(&snapshot, grid, Encoding::F32);
            let bytes = frame.patches.iter().flat_map(|patch| patch.bytes.as_chunks::<12>().0);
            for (index, bytes) in bytes.enumerate() {
                let [a, b] = [index / grid.vertices()[1], index % grid.vertices()[1]];
                for (c, values) in snapshot.displacement_m(grid).iter().enumerate() {
                    let at = |i: usize| {
                        let (left, right) = (values[i * 17 + b / cells], values[i * 17 + b.div_ceil(cells)]);
                        left + (b % cells) as f32 / cells as f32 * (right - left)
                    };
                    let (near, far) = (at(a / cells), at(a.div_ceil(cells)));
                    let value = near + (a % cells) as f32 / cells as f32 * (far - near);
                    assert_eq!(bytes[4 * c..4 * c + 4], value.to_le_bytes(), "n = {n}, ({a}, {b})");
                }
            }
        }
    }

    #[test]
    fn a_frame_has_the_same_bits_at_every_width() {
        for encoding in Encoding::ALL {
            for n in 0..=10 {
                let grid = Refinement::new(&scene([31, 17]), n, &Limits::default()).unwrap();
                let at = |width| encode_at(width, &snapshot(), Frame::blank(grid, encoding));
                let plain = at(Width::Plain);
                for width in Width::ALL.into_iter().filter(|width| width.is_available()) {
                    let frame = at(width);
                    assert_eq!(frame.quanta, plain.quanta);
                    for (patch, plain) in frame.patches.iter().zip(&plain.patches) {
                        assert!(patch.bytes == plain.bytes, "{width:?}, n = {n}, {encoding:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_spent_frame_lends_the_buffers_that_nobody_reads() {
        for encoding in Encoding::ALL {
            let grid = Refinement::new(&scene([31, 17]), 10, &Limits::default()).unwrap();
            let first = encode(&snapshot(), grid, encoding);
            let (held, place) = (first.patches[0].bytes.clone(), first.patches[1].bytes.as_ptr());
            let before = held.to_vec();
            let moved =
                snapshot().displacement_m(grid).each_ref().map(|values| values.iter().map(|v| 1.0 - 2.0 * v).collect());
            let moved = Snapshot::new(&scene([31, 17]), 8, 0.008, moved);
            let second = encode_over(&moved, first);
            assert_eq!((second.patches[1].bytes.as_ptr(), held), (place, before.into()));
            assert_eq!(decode(&second), decode(&encode(&moved, grid, encoding)));
        }
    }

    #[test]
    fn patches_are_small_and_tile_the_frame() {
        let grid = Refinement::new(&scene([31, 17]), 10, &Limits::default()).unwrap();
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
        let snapshot = Snapshot::new(&scene([2, 20_000]), 0, 0.0, displacement_m);
        let grid = Refinement::new(&scene([2, 20_000]), 0, &Limits::default()).unwrap();
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
        let still = Snapshot::new(&scene([3, 3]), 0, 0.0, std::array::from_fn(|c| vec![c as f32 * 0.25; 9]));
        let grid = Refinement::new(&scene([3, 3]), 1, &Limits::default()).unwrap();
        for encoding in Encoding::ALL {
            for vertex in decode(&encode(&still, grid, encoding)) {
                assert_eq!(vertex, [0.0, 0.25, 0.5]);
            }
        }
    }
}
