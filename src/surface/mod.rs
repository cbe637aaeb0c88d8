//! What a viewer gets: the sheet refined by bilinear interpolation, encoded, in pieces.

pub mod encode;
pub mod refine;

pub use encode::{Encoding, Frame, encode, encode_over};
pub use refine::{LARGEST_REFINEMENT, Refinement};

/// The displacements of a sheet at one moment: what frames are made of.
#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    /// Steps done.
    pub step: u64,
    /// s.
    pub simulation_time_s: f64,
    /// m, x, y and z apart, point [i, j] at i·ny + j.
    pub displacement_m: [Vec<f32>; 3],
}
