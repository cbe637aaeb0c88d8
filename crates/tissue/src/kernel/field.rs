//! The memory of a tissue's state: values per point, laid out so that vectors of any width can sweep the rows.

use std::ops::{Deref, DerefMut, Range};
use std::sync::Arc;

use xxhash_rust::xxh3::Xxh3;

use crate::kernel::real::Real;
use crate::memory;

/// Lanes of the widest vector: rows are padded to a multiple of it.
pub(crate) const BLOCK: usize = crate::scene::MIN_WIDTH;

/// Alignment of every row and plane, bytes: a cache line.
const LINE: usize = 64;

/// Bytes by which the length of a plane exceeds a multiple of a page. A processor treats a load as dependent on an
/// earlier store if their addresses agree in the last 12 bits. With planes whole pages apart, each store to x would
/// seem to block the next load of y. (Measured at 31²: up to a quarter of a step.)
const SKEW: usize = 1408;

/// Where the values of a point are in a field: component c of point [i, j] is at c·plane + i·stride + j.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Layout {
    /// Rows: points along x, or blocks of a mesh.
    pub(crate) rows: usize,
    /// Columns: points along y, or the 16 slots of a block.
    pub(crate) columns: usize,
    /// Distance from one row to the next, values.
    pub(crate) stride: usize,
    /// Distance from one component to the next, values.
    pub(crate) plane: usize,
}

impl Layout {
    pub(crate) fn new<T: Real>([rows, columns]: [usize; 2]) -> Self {
        let mut stride = columns.next_multiple_of(BLOCK);
        // Rows half a page or more apart would collide like planes.
        if (stride * size_of::<T>()).is_multiple_of(2048) {
            stride += BLOCK;
        }
        // A vector at the last point may reach two points and a row beyond.
        let (page, skew) = (4096 / size_of::<T>(), SKEW / size_of::<T>());
        let plane = ((rows.max(4) + 1) * stride + BLOCK).saturating_sub(skew).next_multiple_of(page) + skew;
        Layout { rows, columns, stride, plane }
    }

    /// Returns whether `count` values from `offset` on lie within one plane.
    pub(crate) fn holds(&self, offset: usize, count: usize) -> bool {
        offset + count <= self.plane
    }

    /// Returns the offset of the x component of the point with row-major number `index`.
    pub(crate) fn offset(&self, index: usize) -> usize {
        index / self.columns * self.stride + index % self.columns
    }
}

/// The state that a step advances. Lengths are in spacings (see `scheme`).
#[derive(Debug)]
pub(crate) struct State<T> {
    /// Displacement from rest. For a multistep scheme, as predicted for the present.
    pub(crate) u: Field<T>,
    /// The increment of the last substep, or the velocity times the substep.
    pub(crate) d: Field<T>,
    /// The other values that the scheme keeps. In a tissue at rest, some of them share memory.
    pub(crate) kept: Vec<Arc<Field<T>>>,
}

impl<T: Real> State<T> {
    pub(crate) fn at_rest(layout: &Layout, kept: usize) -> Self {
        let zero = || Field::zero(layout);
        // The history of a tissue at rest is the same at all times, so it shares memory until the first write.
        let past = Arc::new(zero());
        State { u: zero(), d: zero(), kept: vec![past; kept] }
    }

    /// Adds a change to u and d of a point, with a factor for each.
    #[inline]
    pub(crate) fn add(&mut self, layout: &Layout, [i, j]: [usize; 2], change: [f64; 3], [of_u, of_d]: [f64; 2]) {
        let first = i * layout.stride + j;
        for (c, change) in change.into_iter().enumerate() {
            let at = c * layout.plane + first;
            self.u[at] += T::of(of_u * change);
            self.d[at] += T::of(of_d * change);
        }
    }

    /// Creates a state of zeros with separate memory for each field. The system supplies zeroed pages at the
    /// first write.
    pub(crate) fn zero(layout: &Layout, kept: usize) -> Self {
        let zero = || Field::zero(layout);
        State { u: zero(), d: zero(), kept: std::iter::repeat_with(|| Arc::new(zero())).take(kept).collect() }
    }

    /// Returns all fields: u, d and the kept ones.
    pub(crate) fn fields(&self) -> impl Iterator<Item = &Field<T>> {
        [&self.u, &self.d].into_iter().chain(self.kept.iter().map(|field| &**field))
    }

    pub(crate) fn fields_mut(&mut self) -> impl Iterator<Item = &mut Field<T>> {
        [&mut self.u, &mut self.d].into_iter().chain(self.kept.iter_mut().map(Arc::make_mut))
    }

    /// Returns the springs' force at a place, `now`, and the `count` values that a scheme keeps of the past: the last forces, newest
    /// first, and filters of branches.
    pub(crate) fn history(&self, now: f64, count: usize, at: usize) -> Vec<f64> {
        std::iter::once(now).chain(self.kept[..count].iter().map(|field| field[at].wide())).collect()
    }

    /// Makes the last `count` spring forces share memory until the next write. They are equal in a tissue at
    /// rest.
    pub(crate) fn share_history(&mut self, count: usize) {
        if let Some((first, rest)) = self.kept[..count].split_first_mut() {
            rest.fill(first.clone());
        }
    }

    /// Makes the last `count` spring forces share memory if they have the same bits.
    pub(crate) fn share_equal_history(&mut self, count: usize) {
        let is_same = |a: &T, b: &T| a.wide().to_bits() == b.wide().to_bits();
        let equals = |a: &Field<T>, b: &Field<T>| a.iter().zip(b.iter()).all(|(a, b)| is_same(a, b));
        if self.kept[..count].windows(2).all(|pair| equals(&pair[0], &pair[1])) {
            self.share_history(count);
        }
    }

    /// Gives fields that share memory their own memory; `copy` copies the nonzero part.
    pub(crate) fn part_history(&mut self, copy: impl Fn(&mut Field<T>, &Field<T>)) {
        for field in &mut self.kept {
            if Arc::get_mut(field).is_none() {
                let mut own = Field::of_length(field.length);
                copy(&mut own, field);
                *field = Arc::new(own);
            }
        }
    }

    /// Adds the values of some blocks of [`BLOCK`] points (the last of a row may be shorter) to a hash: point
    /// by point, for each field x, y and z, little-endian. Blocks are counted by rows. Points for which
    /// `has_moved` is false are known to be 0.
    pub(crate) fn hash_blocks(
        &self,
        layout: &Layout,
        has_moved: impl Fn([usize; 2]) -> bool,
        blocks: Range<usize>,
        hasher: &mut Xxh3,
    ) {
        let size = size_of::<T>();
        let of_point = self.fields().count() * 3 * size;
        let blocks_per_row = layout.columns.div_ceil(BLOCK);
        let (zeros, mut bytes) = (vec![0; BLOCK * of_point], vec![0; BLOCK * of_point]);
        for block in blocks {
            let (i, column) = (block / blocks_per_row, block % blocks_per_row * BLOCK);
            let length = (layout.columns - column).min(BLOCK) * of_point;
            if !has_moved([i, column]) {
                hasher.update(&zeros[..length]);
                continue;
            }
            let from = i * layout.stride + column;
            let planes = self.fields().flat_map(|field| (0..3).map(|c| &field[c * layout.plane + from..]));
            for (plane, values) in planes.enumerate() {
                for (point, value) in bytes[..length].chunks_exact_mut(of_point).zip(values) {
                    value.write(&mut point[plane * size..][..size]);
                }
            }
            hasher.update(&bytes[..length]);
        }
    }

    /// Copies the values of another state of the same layout and scheme.
    pub(crate) fn copy_from(&mut self, other: &Self) {
        self.fields_mut().zip(other.fields()).for_each(|(to, from)| to.copy_from_slice(from));
    }
}

/// Values over the points: three each, with x, y and z in separate planes, or (for a table) one. Padding is 0.
#[derive(Debug)]
pub(crate) struct Field<T> {
    storage: Vec<T>,
    from: usize,
    length: usize,
}

impl<T: Real> Field<T> {
    pub(crate) fn zero(layout: &Layout) -> Self {
        Field::of_length(3 * layout.plane)
    }

    /// Creates a field of `length` zeros.
    pub(crate) fn of_length(length: usize) -> Self {
        let storage: Vec<T> = memory::zeroed(length + LINE / size_of::<T>(), "the state of a tissue");
        // `align_offset` need not succeed: alignment only affects speed.
        let from = storage.as_ptr().align_offset(LINE).min(LINE / size_of::<T>());
        Field { storage, from, length }
    }

    /// Changes the length; the contents are unspecified.
    pub(crate) fn resize(&mut self, length: usize) {
        if self.from + length <= self.storage.len() {
            self.length = length;
        } else {
            *self = Field::of_length(length);
        }
    }
}

impl<T: Real> Clone for Field<T> {
    fn clone(&self) -> Self {
        let mut field = Field::of_length(self.length);
        field.copy_from_slice(self);
        field
    }

    fn clone_from(&mut self, other: &Self) {
        self.resize(other.length);
        self.copy_from_slice(other);
    }
}

impl<T> Deref for Field<T> {
    type Target = [T];

    // Not inlined, each access to a value is a call: a tool's contact accesses thousands.
    #[inline]
    fn deref(&self) -> &[T] {
        &self.storage[self.from..self.from + self.length]
    }
}

impl<T> DerefMut for Field<T> {
    #[inline]
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.storage[self.from..self.from + self.length]
    }
}
