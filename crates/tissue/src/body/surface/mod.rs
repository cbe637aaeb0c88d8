//! The kernel for tissue on a triangle mesh: points and springs in any arrangement, instead of the rows of a
//! rectangle.
//!
//! A [`MeshGraph`] describes the tissue. [`MeshSlots`] gives each point a *slot*, its place in memory:
//! neighbours along the mesh come near to each other (`order`). Slots have the sheet's layout with rows of 16
//! columns: slot s is at row s / 16, column s % 16, and at offset s of a plane, because such rows need no
//! padding. A row is a *block*, and a tile of the sleeping logic is 256 successive slots. So state, stages,
//! tables of forces, sums, hashes and tiles are those of the sheet. The last block is filled with empty slots:
//! nothing pulls at them, and they stay at 0.
//!
//! **Springs.** Each spring is evaluated from both of its ends, so a point's force is a sum that only its own
//! lane writes. Each end has its own factor, the spring's stiffness divided by the mass of that end. Q and the
//! weight have the same bits from both ends. The order in which a point's springs are added belongs to the
//! mesh, not to a width. A lane's result therefore has the same bits at every width.
//!
//! **Snapshot.** Neighbours may be anywhere, so the sweep can't overwrite values that later blocks read. Before
//! a tile is swept, its displacements and those of the tiles next to it are copied to *records*, unless this
//! sweep has already done so: x, y and z of a point side by side, one cache access for each neighbour. Forces
//! come from the records, and the stage then writes the state in place. So only the state must be consistent
//! between two sweeps. (The copy costs about 6 % of a sweep.)
//!
//! **Packing.** Each width has its own arrangement of the coefficients (`pack`): a vector of neighbours loaded from
//! their records, or, where lanes move fast within registers, 16 slots whose outside neighbours are loaded once and
//! then picked.
//!
//! Units are those of the sheet (`scheme`), where the spacing h is a length that belongs to the mesh, such as
//! its mean edge.

pub(crate) mod footprint;
mod mesh_calibration;
mod order;
mod pack;
mod places;
pub(crate) mod pressure;
mod slots;
mod sweep;

#[cfg(test)]
mod tests;

pub use crate::scene::graph::{GraphFault, MeshGraph, MeshSpring};
pub use mesh_calibration::MeshTrial;
pub(crate) use pack::MeshSprings;
pub(crate) use places::{MeshPlaces, VolumePlaces};
pub use slots::{MeshSlots, NO_VERTEX};
pub(crate) use sweep::{MeshGrid, MeshSweep, Snapshot, gather};
