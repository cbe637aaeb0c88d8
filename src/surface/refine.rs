//! Refinement (the paper's bilinear interpolation): n vertices between neighbouring points, so that a side of m
//! points has M = (m − 1)·n + m vertices.

use crate::limits::Limits;
use crate::refusal::{Reason, Refusal, Result};

/// The largest n.
pub const LARGEST_REFINEMENT: u32 = 10;

/// A refined grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Refinement {
    /// Points of the sheet along x and y.
    pub points: [usize; 2],
    /// n.
    pub between: usize,
}

impl Refinement {
    /// Refinement `n` of a sheet of `points`.
    pub fn new(points: [usize; 2], n: u32, limits: &Limits) -> Result<Self> {
        if n > LARGEST_REFINEMENT {
            let message = format!("must be from 0 to {LARGEST_REFINEMENT}, but is {n}");
            return Err(Refusal::new(Reason::OutOfRange, "refinement", message));
        }
        let refinement = Refinement { points, between: n as usize };
        let [x, y] = refinement.vertices();
        if x * y > limits.frame_vertices {
            let message = format!("makes {x} × {y} vertices, above the limit of {} in all", limits.frame_vertices);
            return Err(Refusal::new(Reason::TooLarge, "refinement", message));
        }
        Ok(refinement)
    }

    /// Vertices along x and y.
    pub fn vertices(&self) -> [usize; 2] {
        self.points.map(|points| (points - 1) * (self.between + 1) + 1)
    }

    /// Distance of vertices at rest, for points `spacing_m` apart.
    #[allow(clippy::cast_precision_loss)]
    pub fn spacing_m(&self, spacing_m: f64) -> f64 {
        spacing_m / (self.between + 1) as f64
    }

    /// Interpolates row `a` of the vertices out of `values`, one per point, into `row`.
    #[allow(clippy::cast_precision_loss)]
    pub fn row(&self, values: &[f32], a: usize, row: &mut [f32]) {
        let (cells, columns) = (self.between + 1, self.points[1]);
        let (i, part) = (a / cells, (a % cells) as f32 / cells as f32);
        let near = &values[i * columns..][..columns];
        // A row of points has no row beyond it to be mixed with, and at the rim there is none.
        let far = if part > 0.0 { &values[(i + 1) * columns..][..columns] } else { near };
        let at = |j: usize| near[j] + part * (far[j] - near[j]);
        let mut left = at(0);
        for (j, cell) in row[..(columns - 1) * cells].chunks_exact_mut(cells).enumerate() {
            let right = at(j + 1);
            let slope = (right - left) / cells as f32;
            for (k, vertex) in cell.iter_mut().enumerate() {
                *vertex = left + slope * k as f32;
            }
            left = right;
        }
        row[(columns - 1) * cells] = left;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refined_grid_has_the_papers_size_and_interpolates_bilinearly() {
        for n in 0..=LARGEST_REFINEMENT {
            let (nx, ny) = (4, 3);
            let grid = Refinement::new([nx, ny], n, &Limits::default()).unwrap();
            let between = n as usize;
            assert_eq!(grid.vertices(), [(nx - 1) * between + nx, (ny - 1) * between + ny]);
            // A bilinear function is its own bilinear interpolation.
            let law = |x: f32, y: f32| 1.0 + 2.0 * x - 3.0 * y + 0.5 * x * y;
            let values: Vec<f32> = (0..nx * ny).map(|k| law((k / ny) as f32, (k % ny) as f32)).collect();
            let [rows, columns] = grid.vertices();
            for a in 0..rows {
                let mut row = vec![f32::NAN; columns];
                grid.row(&values, a, &mut row);
                for (b, value) in row.into_iter().enumerate() {
                    let cells = (between + 1) as f32;
                    let expected = law(a as f32 / cells, b as f32 / cells);
                    assert!((value - expected).abs() < 1e-5, "n = {n}, ({a}, {b}): {value}, expected {expected}");
                }
            }
        }
    }

    #[test]
    fn eleven_and_too_many_vertices_are_refused() {
        let refusal = Refinement::new([31, 31], 11, &Limits::default()).unwrap_err();
        assert_eq!((refusal.reason, refusal.field.as_str()), (Reason::OutOfRange, "refinement"));
        let refusal = Refinement::new([1001, 1001], 10, &Limits::default()).unwrap_err();
        assert_eq!(refusal.reason, Reason::TooLarge);
    }
}
