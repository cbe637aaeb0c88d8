//! The kernel for tissue with an inside: cubes of a lattice, and their corners as points.
//!
//! A row of the memory is a row of the lattice along x; rows follow along y, then along z. Corners that are no points are
//! empty places: they have no mass, and count as fixed, so they stay at 0.
//!
//! A cube with corners at rest X and displacements u has F = I + H at its middle, H = ∂u/∂X. It is stretched and sheared
//! as F says ([`neo_hookean`]), and resists the other ways in which eight corners can move (hourglasses) as the integral of
//! μ|F|²/2 over the cube does. So one evaluation a cube suffices, and nothing locks.

pub(crate) mod corner_copies;
pub(crate) mod cut_cubes;
mod cut_plane;
pub(crate) mod cut_surface;
pub(crate) mod footprint;
pub(crate) mod inversion;
pub(crate) mod linear_cells;
pub(crate) mod neo_hookean;
pub(crate) mod place_numbers;
pub(crate) mod places;
pub(crate) mod sweep;

#[cfg(test)]
mod tests;

pub(crate) use inversion::is_inverted;
pub(crate) use neo_hookean::NeoHookean;
pub(crate) use places::SolidPlaces;
pub(crate) use sweep::{PointLoad, SolidGrid, SolidSweep, SolidTables, gather};
