//! Memory of a sheet: numbers for each point, laid out so that rows can be swept by vectors of any width.

use std::ops::{Deref, DerefMut};
use std::sync::Arc;

use xxhash_rust::xxh3::Xxh3;

use super::real::Real;

/// Lanes of the widest vector: rows are padded to a multiple of it.
pub(super) const BLOCK: usize = crate::scene::LEAST_WIDTH;

/// Bytes that every row and plane is aligned to: a cache line.
const LINE: usize = 64;

/// By how many bytes a plane is longer than a multiple of a page. A processor takes a load for one that waits for an
/// earlier store if the two agree in the last 12 bits of their addresses; with planes apart by whole pages, each store
/// to x would seem to be what the next load of y waits for. (Measured at 31²: up to a quarter of a step.)
const SKEW: usize = 1408;

/// Where the numbers of a point are: component c of point [i, j] at c·plane + i·stride + j.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Layout {
    /// Along x.
    pub(super) rows: usize,
    /// Along y.
    pub(super) columns: usize,
    /// From a row to the next.
    pub(super) stride: usize,
    /// From a component to the next.
    pub(super) plane: usize,
}

impl Layout {
    pub(super) fn new<T: Real>([rows, columns]: [usize; 2]) -> Self {
        let mut stride = columns.next_multiple_of(BLOCK);
        // Rows apart by half a page or more would collide like planes.
        if (stride * size_of::<T>()).is_multiple_of(2048) {
            stride += BLOCK;
        }
        // A vector at the last point may reach two points and a row beyond.
        let (page, skew) = (4096 / size_of::<T>(), SKEW / size_of::<T>());
        let plane = ((rows.max(4) + 1) * stride + BLOCK).saturating_sub(skew).next_multiple_of(page) + skew;
        Layout { rows, columns, stride, plane }
    }

    /// Whether so many numbers from a place of a plane on are memory of that plane.
    pub(super) fn holds(&self, place: usize, count: usize) -> bool {
        place + count <= self.plane
    }

    /// The place of the x component of the point that is number `index` of all, by rows.
    pub(super) fn place(&self, index: usize) -> usize {
        index / self.columns * self.stride + index % self.columns
    }
}

/// What a step advances. Lengths are in spacings (`integrate`).
#[derive(Debug)]
pub(super) struct State<T> {
    /// Displacement from rest: of a multistep scheme as predicted for now.
    pub(super) u: Field<T>,
    /// The increment of the last substep, or the velocity times the substep.
    pub(super) d: Field<T>,
    /// What the scheme keeps beside; of a sheet at rest, some are one in memory.
    pub(super) kept: Vec<Arc<Field<T>>>,
}

impl<T: Real> State<T> {
    pub(super) fn at_rest(layout: &Layout, kept: usize) -> Self {
        let zero = || Field::zero(layout);
        // The past of rest is the same at all times: one in memory, until it is written to.
        let past = Arc::new(zero());
        State { u: zero(), d: zero(), kept: vec![past; kept] }
    }

    /// The same, with memory of its own for each field: the system gives zeros when they are written to.
    pub(super) fn zero(layout: &Layout, kept: usize) -> Self {
        let zero = || Field::zero(layout);
        State { u: zero(), d: zero(), kept: std::iter::repeat_with(|| Arc::new(zero())).take(kept).collect() }
    }

    /// All of it.
    pub(super) fn fields(&self) -> impl Iterator<Item = &Field<T>> {
        [&self.u, &self.d].into_iter().chain(self.kept.iter().map(|field| &**field))
    }

    pub(super) fn fields_mut(&mut self) -> impl Iterator<Item = &mut Field<T>> {
        [&mut self.u, &mut self.d].into_iter().chain(self.kept.iter_mut().map(Arc::make_mut))
    }

    /// The last values of the springs' force at a place, newest first: `now`, and `count` that a multistep scheme keeps.
    pub(super) fn history(&self, now: f64, count: usize, at: usize) -> Vec<f64> {
        std::iter::once(now).chain(self.kept[..count].iter().map(|field| field[at].wide())).collect()
    }

    /// Of a sheet at rest the last `count` forces of the springs are the same: they become one in memory, until they are
    /// written to.
    pub(super) fn share_history(&mut self, count: usize) {
        if let Some((first, rest)) = self.kept[..count].split_first_mut() {
            rest.fill(first.clone());
        }
    }

    /// Gives what is one in memory memory of its own; `copy` copies what is not 0.
    pub(super) fn part_history(&mut self, copy: impl Fn(&mut Field<T>, &Field<T>)) {
        for field in &mut self.kept {
            if Arc::get_mut(field).is_none() {
                let mut own = Field::of_length(field.length);
                copy(&mut own, field);
                *field = Arc::new(own);
            }
        }
    }

    /// XXH3-128 of the values of each point, by rows: of each field, x, y and z, little-endian. What `has_moved` is false
    /// for is known to be 0.
    pub(super) fn hash(&self, layout: &Layout, has_moved: impl Fn([usize; 2]) -> bool) -> u128 {
        let mut hasher = Xxh3::new();
        let size = size_of::<T>();
        let of_point = self.fields().count() * 3 * size;
        let mut bytes = vec![0; layout.columns * of_point];
        for i in 0..layout.rows {
            if i.is_multiple_of(BLOCK) {
                bytes.fill(0);
            }
            for (block, bytes) in bytes.chunks_mut(BLOCK * of_point).enumerate() {
                if !has_moved([i, block * BLOCK]) {
                    continue;
                }
                let from = i * layout.stride + block * BLOCK;
                let planes = self.fields().flat_map(|field| (0..3).map(|c| &field[c * layout.plane + from..]));
                for (plane, values) in planes.enumerate() {
                    for (point, value) in bytes.chunks_exact_mut(of_point).zip(values) {
                        value.write(&mut point[plane * size..][..size]);
                    }
                }
            }
            hasher.update(&bytes);
        }
        hasher.digest128()
    }

    /// Takes the values of another of the same layout and scheme.
    pub(super) fn copy_from(&mut self, other: &Self) {
        self.fields_mut().zip(other.fields()).for_each(|(to, from)| to.copy_from_slice(from));
    }
}

/// Numbers over the points: three each, x, y and z apart, or (a table) one. What pads rows and planes is 0.
#[derive(Debug)]
pub(super) struct Field<T> {
    storage: Vec<T>,
    from: usize,
    length: usize,
}

impl<T: Real> Field<T> {
    pub(super) fn zero(layout: &Layout) -> Self {
        Field::of_length(3 * layout.plane)
    }

    /// Zeros.
    pub(super) fn of_length(length: usize) -> Self {
        let storage = vec![T::default(); length + LINE / size_of::<T>()];
        // Where no alignment is promised, none is needed: it is for speed alone.
        let from = storage.as_ptr().align_offset(LINE).min(LINE / size_of::<T>());
        Field { storage, from, length }
    }

    /// Makes room for another length; what is in it does not matter.
    pub(super) fn resize(&mut self, length: usize) {
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
    fn deref(&self) -> &[T] {
        &self.storage[self.from..self.from + self.length]
    }
}

impl<T> DerefMut for Field<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.storage[self.from..self.from + self.length]
    }
}
