//! Frames for viewers: the sheet refined by bilinear interpolation, encoded, in patches.

pub mod encode;
pub mod refine;
pub mod tiles;
mod wide;

use std::sync::OnceLock;

pub use encode::{Encoding, Frame, encode, encode_over};
pub use refine::{LARGEST_REFINEMENT, Refinement};
pub use tiles::Tiles;

use refine::Points;

/// The displacements of a sheet at one moment, from which frames are made.
#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    /// Steps done.
    pub step: u64,
    /// Simulated time, s.
    pub simulation_time_s: f64,
    /// Displacements, m: x, y and z separate, point [i, j] at i·ny + j.
    displacement_m: [Vec<f32>; 3],
    /// The least and the greatest of each component, m, once somebody wants to know.
    box_m: OnceLock<[[f32; 2]; 3]>,
    /// Points along x and y.
    points: [usize; 2],
}

impl Snapshot {
    /// Creates a snapshot of `points` along x and y. `displacement_m` has nx·ny values for each component, point [i, j]
    /// at i·ny + j.
    pub fn new(step: u64, simulation_time_s: f64, points: [usize; 2], displacement_m: [Vec<f32>; 3]) -> Self {
        Snapshot { step, simulation_time_s, displacement_m, box_m: OnceLock::new(), points }
    }

    /// The bounding box. Computed once for all encodings, by who encodes: a stepping thread makes the snapshot.
    fn box_m(&self) -> &[[f32; 2]; 3] {
        self.box_m.get_or_init(|| self.displacement_m.each_ref().map(|values| encode::range(values)))
    }

    /// All points.
    fn points(&self) -> Points<'_> {
        let values = self.displacement_m.each_ref().map(Vec::as_slice);
        Points { values, stride: self.points[1], count: self.points }
    }
}
