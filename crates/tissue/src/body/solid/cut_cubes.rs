//! The cubes beside cuts in a sweep: they are no longer in the rows of the lattice, and gather their corners one by one.
#![allow(unsafe_code)]
// The compiler does not always inline iterators over vectors. They then run without the caller's instructions, ten
// times slower.
#![allow(clippy::needless_range_loop)]

use std::cell::RefCell;

use super::corner_copies::CornerCopies;
use super::neo_hookean::{NeoHookean, Patterns};
use super::places::SolidPlaces;
use crate::kernel::field::{BLOCK, Field, Layout};
use crate::kernel::lanes::{Scalar, Vector};
use crate::kernel::real::Real;
use crate::kernel::region::Region;
use crate::kernel::stage::Stage;

/// The cubes beside cuts ([`CornerCopies::cubes`]), as a sweep reads them.
#[derive(Debug)]
pub(crate) struct CutCubes<T> {
    /// Where the corners of each cube are in a plane of a field.
    corners: Vec<[u32; 8]>,
    /// The row and column of the least corner of each cube, to which its energy belongs.
    least: Vec<[u32; 2]>,
    /// The weight of each cube; 0 beyond the last one, up to a whole block.
    weights: Vec<T>,
    /// The forces on the corners of these cubes, three planes: those of the sweep that runs.
    forces: RefCell<Field<T>>,
    /// Which rows have such corners.
    rows: Vec<bool>,
}

impl<T: Real> CutCubes<T> {
    /// Creates it without cubes.
    pub(crate) fn none(layout: &Layout) -> Self {
        CutCubes {
            corners: Vec::new(),
            least: Vec::new(),
            weights: vec![T::default(); BLOCK],
            forces: RefCell::new(Field::zero(layout)),
            rows: vec![false; layout.rows],
        }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.corners.is_empty()
    }

    /// Sets where the corners of the cube of a number are; a new one has the next number. `weight` is that of the cube.
    #[allow(clippy::cast_possible_truncation)]
    pub(crate) fn set(&mut self, places: &SolidPlaces, layout: &Layout, copies: &CornerCopies, number: usize) {
        let cube = &copies.cubes()[number];
        let corners = cube.corners.map(|place| layout.offset(place as usize) as u32);
        corners.iter().for_each(|at| self.rows[*at as usize / layout.stride] = true);
        if let Some(known) = self.corners.get_mut(number) {
            // A sweep clears the places that these cubes have then.
            let forces = self.forces.get_mut();
            for at in std::mem::replace(known, corners) {
                (0..3).for_each(|c| forces[c * layout.plane + at as usize] = T::default());
            }
            return;
        }
        let least = cube.cube as usize;
        self.weights[self.corners.len()] = T::of(places.weight(least));
        self.corners.push(corners);
        self.least.push([least / layout.columns, least % layout.columns].map(|at| at as u32));
        self.weights.resize(self.corners.len() + BLOCK, T::default());
    }

    /// Returns where the corners of the cube of a number are in a plane of a field.
    #[inline]
    pub(crate) fn offsets_of(&self, number: usize) -> [usize; 8] {
        self.corners[number].map(|at| at as usize)
    }

    /// Returns the forces on the corners of a block of a row; `None` if it has none.
    ///
    /// # Safety
    /// The processor has the instructions, and the block is within the layout.
    #[inline(always)]
    pub(crate) unsafe fn forces_at<V: Vector<Real = T>>(
        &self,
        layout: &Layout,
        row: usize,
        at: usize,
    ) -> Option<[V; 3]> {
        if !self.rows[row] {
            return None;
        }
        let forces = self.forces.borrow();
        debug_assert!(layout.holds(at, V::LANES));
        // SAFETY: the caller's promise.
        unsafe {
            let of = |c: usize| V::load(forces.as_ptr().add(c * layout.plane + at));
            Some([of(0), of(1), of(2)])
        }
    }

    /// Computes the forces on the corners, and tells the stage the energies of cubes that are awake.
    ///
    /// # Safety
    /// The processor has the instructions, and `x` has the layout's planes.
    #[inline(always)]
    pub(crate) unsafe fn pull<V: Vector<Real = T>, S: Stage<T>>(
        &self,
        layout: &Layout,
        law: &NeoHookean<T>,
        x: *const T,
        over: &Region,
        stage: &S,
    ) {
        let plane = layout.plane;
        let mut forces = self.forces.borrow_mut();
        assert!(forces.len() == 3 * plane && self.weights.len() >= self.corners.len() + BLOCK);
        let forces = forces.as_mut_ptr();
        // SAFETY: the caller's promise; the corners are in the layout.
        unsafe {
            for corners in &self.corners {
                for at in corners {
                    for c in 0..3 {
                        *forces.add(c * plane + *at as usize) = T::default();
                    }
                }
            }
            let zero = V::of(T::default());
            let mut from = 0;
            while from < self.corners.len() {
                let count = V::LANES.min(self.corners.len() - from);
                // What sleeps needs no force: a survey looks at one tile after another.
                let is_awake = |at: &u32| over.is_awake(*at as usize / layout.stride, *at as usize % layout.stride);
                if !over.awake.is_full() && !self.corners[from..from + count].as_flattened().iter().any(is_awake) {
                    from += V::LANES;
                    continue;
                }
                let mut values = [[[T::default(); BLOCK]; 3]; 8];
                for lane in 0..count {
                    for corner in 0..8 {
                        let at = self.corners[from + lane][corner] as usize;
                        for c in 0..3 {
                            values[corner][c][lane] = *x.add(c * plane + at);
                        }
                    }
                }
                let mut corners = [[zero; 3]; 8];
                for corner in 0..8 {
                    for c in 0..3 {
                        corners[corner][c] = V::load(values[corner][c].as_ptr());
                    }
                }
                let weights = V::load(self.weights.as_ptr().add(from));
                let patterns = Patterns::of_corners(&corners);
                if S::ENERGY {
                    let mut energies = [T::default(); BLOCK];
                    law.energy(weights, &patterns).store(energies.as_mut_ptr());
                    for lane in 0..count {
                        let [row, column] = self.least[from + lane].map(|at| at as usize);
                        if over.is_awake(row, column) {
                            stage.energy(column, Scalar(energies[lane]));
                        }
                    }
                    if (from + V::LANES).is_multiple_of(BLOCK) {
                        stage.end_row();
                    }
                }
                let pulled = law.stress(weights, &patterns).on_corners();
                for corner in 0..8 {
                    for c in 0..3 {
                        pulled[corner][c].store(values[corner][c].as_mut_ptr());
                    }
                }
                // Cube by cube: then the order of a sum does not depend on the width.
                for lane in 0..count {
                    for corner in 0..8 {
                        let at = self.corners[from + lane][corner] as usize;
                        for c in 0..3 {
                            let force = forces.add(c * plane + at);
                            *force += values[corner][c][lane];
                        }
                    }
                }
                from += V::LANES;
            }
            if S::ENERGY {
                stage.end_row();
            }
        }
    }
}

/// Returns the force of cubes beside cuts on a place, with the bits of [`CutCubes::pull`].
#[inline(always)]
pub(super) fn gather_cut<T: Real>(
    places: &SolidPlaces,
    copies: &CornerCopies,
    law: &NeoHookean<T>,
    layout: &Layout,
    u: &[T],
    place: usize,
) -> [T; 3] {
    let mut sum = [T::default(); 3];
    for number in copies.cut_cubes_around(places, place) {
        let cube = &copies.cubes()[number];
        let mut corners = [[Scalar(T::default()); 3]; 8];
        for corner in 0..8 {
            let at = layout.offset(cube.corners[corner] as usize);
            for c in 0..3 {
                corners[corner][c] = Scalar(u[c * layout.plane + at]);
            }
        }
        let weight = Scalar(T::of(places.weight(cube.cube as usize)));
        let pulled = law.stress(weight, &Patterns::of_corners(&corners)).on_corners();
        for corner in 0..8 {
            if cube.corners[corner] as usize == place {
                for c in 0..3 {
                    sum[c] += pulled[corner][c].0;
                }
            }
        }
    }
    sum
}
