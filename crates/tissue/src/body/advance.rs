//! The stage of a sweep that advances every point by a scheme under the tools' forces.
#![allow(unsafe_code)]
// The compiler does not always inline iterators and closures over vectors. They then run without the caller's
// instructions, ten times slower.
#![allow(clippy::needless_range_loop, clippy::manual_map)]

use std::ops::Range;

use crate::body::force_field::{self, Pull};
use crate::kernel::field::{BLOCK, Layout};
use crate::kernel::lanes::Vector;
use crate::kernel::real::Real;
use crate::kernel::stage::{ANY, ROW_LOADED, ROW_UNLOADED, Stage};
use crate::scheme::arithmetic::{Arithmetic, MAX_KEPT};

/// The stage of a sweep that advances every point.
pub(crate) struct AdvanceStage<'a, T: Real, C> {
    pub(crate) layout: Layout,
    pub(crate) scheme: &'a C,
    /// u and d, three planes each.
    pub(crate) u: *mut T,
    pub(crate) d: *mut T,
    pub(crate) kept: [*mut T; MAX_KEPT],
    /// The tools' forces, which act in rows `forced`.
    pub(crate) pulls: &'a [Pull<'a, T>],
    pub(crate) forced: Range<usize>,
    /// 1 where a point moves, 0 where it is fixed; null if every point moves.
    pub(crate) free: *const T,
    /// The mass of each point divided by the reference mass; null if all are equal to it.
    pub(crate) masses: *const T,
    /// A block that sums the squares of increments: it is finite and small only if all of them are.
    pub(crate) probe: *mut T,
    /// A block that sums the work of the tools, separately for each of 16 columns, so that it is the same at
    /// every vector width.
    pub(crate) work: *mut T,
}

impl<T: Real, C: Arithmetic<T>> Stage<T> for AdvanceStage<'_, T, C> {
    #[inline(always)]
    fn duty(&self, row: usize) -> u8 {
        match (self.free.is_null(), self.forced.contains(&row), self.pulls.len()) {
            (true, false, _) => ROW_UNLOADED,
            (true, true, 1) => ROW_LOADED,
            _ => ANY,
        }
    }

    #[inline(always)]
    unsafe fn finish<V: Vector<Real = T>, const DUTY: u8>(
        &self,
        row: usize,
        at: usize,
        x: [V; 3],
        n: [V; 3],
        sums: &mut [V; 2],
    ) {
        let reaches = || force_field::reaches(self.pulls, row, at - row * self.layout.stride);
        let forced = match DUTY {
            ROW_UNLOADED => false,
            ROW_LOADED => reaches(),
            _ => self.forced.contains(&row) && reaches(),
        };
        // SAFETY: the caller's promise.
        unsafe {
            if forced {
                self.put::<V, DUTY, true>(row, at, x, n, sums);
            } else {
                self.put::<V, DUTY, false>(row, at, x, n, sums);
            }
        }
    }

    #[inline(always)]
    unsafe fn begin<V: Vector<Real = T>>(&self) -> [V; 2] {
        // The stages of a substep add to one sum, in the same order at every width.
        // SAFETY: the caller's promise; a block is as long as the widest vector.
        unsafe { [V::of(T::default()), if V::LANES == BLOCK { V::load(self.work) } else { V::of(T::default()) }] }
    }

    #[inline(always)]
    unsafe fn end<V: Vector<Real = T>>(&self, [probe, work]: [V; 2]) {
        // SAFETY: a block is as long as the widest vector.
        unsafe {
            V::load(self.probe).add(probe).store(self.probe);
            if V::LANES == BLOCK {
                work.store(self.work);
            }
        }
    }
}

impl<T: Real, C: Arithmetic<T>> AdvanceStage<'_, T, C> {
    /// Advances a block, with or without a tool's force.
    #[inline(always)]
    unsafe fn put<V: Vector<Real = T>, const DUTY: u8, const FORCED: bool>(
        &self,
        row: usize,
        at: usize,
        x: [V; 3],
        n: [V; 3],
        sums: &mut [V; 2],
    ) {
        // SAFETY: the caller's promise.
        unsafe {
            let Layout { stride, plane, .. } = self.layout;
            debug_assert!(self.layout.holds(at, V::LANES) && V::LANES <= BLOCK);
            let column = at - row * stride;
            let free = if DUTY != ANY || self.free.is_null() { None } else { Some(V::load(self.free.add(at))) };
            // In a vector as wide as a block, each column has a lane of its own.
            let apart = V::LANES < BLOCK;
            let mut work = sums[1];
            let (mut forces, mut mass) = (None, None);
            if (FORCED || C::RELAXES) && !self.masses.is_null() {
                mass = Some(V::load(self.masses.add(at)));
            }
            if (FORCED || C::RELAXES) && apart {
                work = V::load(self.work.add(column % BLOCK));
            }
            if FORCED {
                forces = Some(match (DUTY, C::FORCES) {
                    (ROW_LOADED, 1) => force_field::force_of::<V, 1>(&self.pulls[0], at),
                    (ROW_LOADED, _) => force_field::force_of::<V, 2>(&self.pulls[0], at),
                    (_, 1) => force_field::force_on::<V, 1>(self.pulls, row, at),
                    _ => force_field::force_on::<V, 2>(self.pulls, row, at),
                });
            }
            for c in 0..3 {
                let at = at + c * plane;
                let before = [x[c], V::load(self.d.add(at))];
                let mut kept = [before[1]; MAX_KEPT];
                for k in 0..C::KEPT {
                    kept[k] = V::load(self.kept[k].add(at));
                }
                let force = if let Some(forces) = &forces { Some(forces[c]) } else { None };
                let relaxing = if C::RELAXES { Some(self.scheme.relaxing(n[c], &kept)) } else { None };
                let (mut x, mut d) = self.scheme.advance(before[0], before[1], n[c], &mut kept, force);
                if let Some(free) = free {
                    (x, d) = (x.mul(free), d.mul(free));
                }
                // A field decays without end, in time and towards the edge, and arithmetic on subnormal numbers costs
                // up to a hundred times as much. So values whose square is subnormal become 0.
                if !C::CUTS {
                    (x, d) = (x.keep(x.counts()), d.keep(d.counts()));
                }
                x.store(self.u.add(at));
                d.store(self.d.add(at));
                for k in C::KEPT - C::WRITTEN..C::KEPT {
                    kept[k].keep(kept[k].counts()).store(self.kept[k].add(at));
                }
                sums[0] = d.mul_add(d, sums[0]);
                if let Some([_, force]) = force {
                    // A force divided by the mass moves a point.
                    let force = if let Some(mass) = mass { force.mul(mass) } else { force };
                    work = force.mul_add(self.scheme.travel(before, [x, d]), work);
                }
                // What a branch stores is no energy that a survey sees: to the guard it is a tool, along the increment just done.
                if let Some(force) = relaxing {
                    let force = if let Some(mass) = mass { force.mul(mass) } else { force };
                    work = force.mul_add(before[1], work);
                }
            }
            if (FORCED || C::RELAXES) && apart {
                work.store(self.work.add(column % BLOCK));
            } else {
                sums[1] = work;
            }
        }
    }
}
