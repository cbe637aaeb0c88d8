//! What a viewer gets: the sheet refined by bilinear interpolation, encoded, in pieces.

pub mod encode;
pub mod refine;
pub mod tiles;
mod wide;

pub use encode::{Encoding, Frame, encode, encode_over};
pub use refine::{LARGEST_REFINEMENT, Refinement};
pub use tiles::Tiles;

use refine::Points;

/// The displacements of a sheet at one moment: what frames are made of.
#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    /// Steps done.
    pub step: u64,
    /// s.
    pub simulation_time_s: f64,
    /// m, x, y and z apart, point [i, j] at i·ny + j.
    displacement_m: [Vec<f32>; 3],
    /// The least and the greatest of each component, m.
    box_m: [[f32; 2]; 3],
    /// Points along x and y.
    points: [usize; 2],
}

impl Snapshot {
    /// Looks through the displacements once for the box around them, for all encodings.
    pub fn new(step: u64, simulation_time_s: f64, points: [usize; 2], displacement_m: [Vec<f32>; 3]) -> Self {
        let box_m = displacement_m.each_ref().map(|values| encode::range(values));
        Snapshot { step, simulation_time_s, displacement_m, box_m, points }
    }

    /// All of them.
    fn points(&self) -> Points<'_> {
        let values = self.displacement_m.each_ref().map(Vec::as_slice);
        Points { values, stride: self.points[1], count: self.points }
    }
}
