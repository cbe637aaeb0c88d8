//! A mesh in free motion by central differences: only the kernel, for benchmarks and tests.
#![allow(unsafe_code)]

use std::cell::RefCell;

use glam::DVec3;

use super::pack::MeshSprings;
use super::slots::MeshSlots;
use super::sweep::{MeshGrid, MeshSweep, Snapshot, gather};
use crate::body::advance::AdvanceStage;
use crate::kernel::field::{BLOCK, Layout, State};
use crate::kernel::lanes::{Width, run, shape};
use crate::kernel::real::Real;
use crate::kernel::region::Region;
use crate::kernel::springs::SpringCoefficients;
use crate::scene::graph::{GraphFault, MeshGraph};
use crate::scene::{Integrator, Lanes};
use crate::scheme::arithmetic::MAX_KEPT;
use crate::scheme::family::Family;
use crate::scheme::{Coefficients, Scheme};

/// A mesh in free motion in f32, without tools and damping, stepped by the central scheme, all of it awake: for
/// benchmarks and tests of the kernel.
#[derive(Debug)]
pub struct MeshTrial(FreeMotion<f32>);

impl MeshTrial {
    /// Creates the mesh at rest. `turn` is the phase per step of a point's anchor spring alone, rad; `scale` is
    /// dt²/m with the length dt of a step and the reference mass m, m/N; `lanes` is the vector width. Unwinds with a
    /// refusal if there is no memory ([`attempt`](crate::memory::attempt)).
    ///
    /// # Errors
    /// Returns the first fault of the graph ([`MeshSlots::new`]).
    pub fn new(graph: &MeshGraph, turn: f64, scale: f64, lanes: Lanes) -> Result<Self, GraphFault> {
        Ok(MeshTrial(FreeMotion::new(MeshSlots::new(graph)?, turn, scale, lanes)))
    }

    /// Sets the displacement of each vertex to what `of_vertex` returns for its number, in spacings
    /// ([`MeshGraph::spacing_m`]). Velocities do not change.
    pub fn displace(&mut self, of_vertex: impl Fn(usize) -> DVec3) {
        self.0.displace(of_vertex);
    }

    /// Advances all points by `steps` steps, on the calling thread.
    pub fn step(&mut self, steps: usize) {
        (0..steps).for_each(|_| self.0.step());
    }

    /// Returns the displacement of a vertex from rest, in spacings. Panics if there is no such vertex.
    pub fn displacement(&self, vertex: usize) -> DVec3 {
        self.0.displacement(vertex)
    }

    /// Returns the force of the springs on a vertex, divided by its mass, in spacings per step². It includes the
    /// anchor stiffness beyond the reference value ([`MeshGraph::extra_anchor`]). Panics if there is no such vertex.
    pub fn force(&self, vertex: usize) -> DVec3 {
        let FreeMotion { slots, unit, pull, state, .. } = &self.0;
        let slot = slots.slot_of()[vertex] as usize;
        DVec3::from_array(
            gather(slots, unit, (*pull, slots.extra_of(slot)), None, &state.u, slot, |_, _| 1.0).map(f64::from),
        )
    }
}

/// A mesh in free motion in any number format, with any part awake.
#[derive(Debug)]
pub(super) struct FreeMotion<T: Real> {
    pub(super) slots: MeshSlots,
    pub(super) layout: Layout,
    pub(super) state: State<T>,
    pub(super) region: Region,
    width: Width,
    springs: MeshSprings<T>,
    unit: SpringCoefficients<T>,
    pull: T,
    scheme: Scheme,
    snapshot: RefCell<Snapshot<T>>,
    probe: [T; BLOCK],
    work: [T; BLOCK],
}

impl<T: Real> FreeMotion<T> {
    pub(super) fn new(slots: MeshSlots, turn: f64, scale: f64, lanes: Lanes) -> Self {
        let (layout, width) = (slots.layout::<T>(), Width::of(lanes));
        let scheme = Scheme::fit(Integrator::Central, Coefficients { anchor: turn * turn, ..Coefficients::default() });
        let mut region = Region::none(&layout);
        (0..slots.tiles()).for_each(|tile| _ = region.awake.add(tile));
        FreeMotion {
            layout,
            state: State::zero(&layout, 0),
            region,
            width,
            springs: MeshSprings::new(&slots, shape::<T>(width)),
            unit: SpringCoefficients::new(scale * scheme.spring_scale(), 1.0),
            pull: T::of(turn * turn * scheme.spring_scale()),
            scheme,
            snapshot: RefCell::new(Snapshot::of(&slots)),
            probe: [T::default(); BLOCK],
            work: [T::default(); BLOCK],
            slots,
        }
    }

    pub(super) fn displace(&mut self, of_vertex: impl Fn(usize) -> DVec3) {
        for (vertex, slot) in self.slots.slot_of().iter().enumerate() {
            for (c, value) in of_vertex(vertex).to_array().into_iter().enumerate() {
                self.state.u[c * self.layout.plane + *slot as usize] = T::of(value);
            }
        }
    }

    pub(super) fn displacement(&self, vertex: usize) -> DVec3 {
        let slot = self.slots.slot_of()[vertex] as usize;
        DVec3::from_array(std::array::from_fn(|c| self.state.u[c * self.layout.plane + slot].wide()))
    }

    pub(super) fn step(&mut self) {
        let Scheme::TwoStep(family) = &self.scheme else { return };
        let scheme = family.plain::<T>(0);
        let u = self.state.u.as_mut_ptr();
        let stage = AdvanceStage {
            layout: self.layout,
            scheme: &scheme,
            u,
            d: self.state.d.as_mut_ptr(),
            kept: [std::ptr::null_mut(); MAX_KEPT],
            pulls: &[],
            forced: 0..0,
            free: std::ptr::null(),
            masses: std::ptr::null(),
            probe: self.probe.as_mut_ptr(),
            work: self.work.as_mut_ptr(),
        };
        let grid = MeshGrid {
            layout: self.layout,
            slots: &self.slots,
            springs: &self.springs,
            unit: &self.unit,
            pull: self.pull,
            push: (T::default(), std::ptr::null()),
            x: u.cast_const(),
            snapshot: &self.snapshot,
        };
        let sweep = MeshSweep { grid, over: &self.region, stage };
        // SAFETY: the fields have the layout, the records one for each slot, and the springs are those of the slots.
        unsafe { run(self.width, &sweep) };
    }
}
