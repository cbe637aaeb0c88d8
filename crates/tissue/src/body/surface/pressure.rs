//! The pressure of a mesh that encloses a volume, for its sweeps: the growth of the volume, and the resulting
//! forces.
//!
//! The volume grows by Σ a·u over all points, and each point is pushed by −κ/V0 times that, times its own a
//! (`scene::volume`). So before each sweep the sum is computed over the awake tiles; the contribution of
//! sleeping tiles is known. Then the force on a point is that of its springs minus one number times its a:
//! every scheme treats it like the springs.
//!
//! Tiles are summed separately, and columns separately within them, in f64 and in a fixed order: the sum has
//! the same bits at every width, and does not depend on what slept before.
#![allow(unsafe_code)]
// The compiler does not always inline iterators over vectors. They then run without the caller's instructions, ten
// times slower.
#![allow(clippy::needless_range_loop)]

use std::cell::{Cell, RefCell};

use crate::body::surface::MeshPlaces;
use crate::kernel::field::{BLOCK, Field, Layout};
use crate::kernel::lanes::{self, Run, Vector, Width};
use crate::kernel::real::Real;
use crate::kernel::region::TILE;
use crate::memory;

/// The tables of the pressure. Lengths are in spacings h.
#[derive(Debug)]
pub(crate) struct Pressure<T> {
    /// a of each place, h²: three planes.
    areas: Field<T>,
    /// a of each place divided by its relative mass, if masses differ.
    over_masses: Option<Field<T>>,
    /// What each tile adds to the volume, h³.
    tiles: RefCell<Vec<f64>>,
    /// The factor whose product with a, divided by the relative mass, is subtracted from the springs' force in
    /// the next sweep.
    push: Cell<f64>,
}

impl<T: Real> Pressure<T> {
    /// Creates the tables of a mesh at rest; `None` if it encloses no volume.
    pub(crate) fn new(graph: &MeshPlaces, layout: &Layout) -> Option<Self> {
        let volume = graph.volume.as_ref()?;
        let field = |mass: &dyn Fn(usize) -> f64| {
            let mut field = Field::zero(layout);
            for (slot, area) in volume.areas.iter().enumerate().filter(|(_, area)| **area != glam::DVec3::ZERO) {
                for c in 0..3 {
                    field[c * layout.plane + layout.offset(slot)] = T::of(area[c] / mass(slot));
                }
            }
            field
        };
        let over_masses = graph.slots.has_masses().then(|| field(&|slot| graph.slots.mass(slot)));
        let tiles = RefCell::new(memory::filled(graph.slots.tiles(), 0.0, "the pressure of a mesh"));
        Some(Pressure { areas: field(&|_| 1.0), over_masses, tiles, push: Cell::new(0.0) })
    }

    /// Returns the growth of the volume, h³, after the points of `tiles` have moved to `u`.
    pub(crate) fn volume_change(&self, width: Width, layout: &Layout, u: &Field<T>, tiles: &[usize]) -> f64 {
        let mut known = self.tiles.borrow_mut();
        debug_assert!(u.len() == 3 * layout.plane && self.areas.len() == u.len());
        assert!(layout.stride == BLOCK && tiles.iter().all(|tile| *tile < known.len()));
        let sums = Sums { layout: *layout, areas: self.areas.as_ptr(), u: u.as_ptr(), tiles, into: known.as_mut_ptr() };
        // SAFETY: both fields have the layout, and each tile a sum.
        unsafe { lanes::run(width, &sums) };
        known.iter().sum()
    }

    /// Sets the factor of the pressure from the next sweep on.
    pub(crate) fn set(&self, push: T) {
        self.push.set(push.wide());
    }

    /// Returns the factor of the pressure and the planes that it multiplies.
    pub(crate) fn at_hand(&self) -> (T, *const T) {
        (T::of(self.push.get()), self.over_masses.as_ref().unwrap_or(&self.areas).as_ptr())
    }
}

/// Returns the factor of the pressure for a growth of the volume (h³); `factor` converts the growth to it.
pub(crate) fn push_of<T: Real>(factor: f64, volume_change: f64) -> T {
    let push = factor * volume_change;
    // Products with smaller factors may be below the normal range.
    if push.abs() < T::MIN_MAGNITUDE { T::default() } else { T::of(push) }
}

/// Computes the sums of some tiles.
struct Sums<'a, T> {
    layout: Layout,
    areas: *const T,
    u: *const T,
    tiles: &'a [usize],
    into: *mut f64,
}

impl<T: Real> Run<T> for Sums<'_, T> {
    #[inline(always)]
    unsafe fn run<V: Vector<Real = T>>(&self) {
        let Layout { rows, plane, .. } = self.layout;
        for &tile in self.tiles {
            let mut columns = [0.0_f64; BLOCK];
            for row in tile * TILE..((tile + 1) * TILE).min(rows) {
                for c in 0..3 {
                    let from = c * plane + row * BLOCK;
                    for column in 0..BLOCK {
                        // SAFETY: the caller's promise.
                        let (a, u) = unsafe { (*self.areas.add(from + column), *self.u.add(from + column)) };
                        columns[column] += a.wide() * u.wide();
                    }
                }
            }
            let mut sum = 0.0;
            for column in 0..BLOCK {
                sum += columns[column];
            }
            // SAFETY: the caller's promise.
            unsafe { *self.into.add(tile) = sum };
        }
    }
}
