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
}

/// Components of a point or vertex: in a row, x, y and z of one lie together, as they do in a patch.
const COMPONENTS: usize = 3;

/// Components of `count` points in a row, and one more: four lanes can then be read at every point, which is one
/// load where three would be three.
fn row_of_points(count: usize) -> Vec<f32> {
    vec![0.0; COMPONENTS * count + 1]
}

/// The rows of vertices of one frame, from the first to the last, each component made into a `T`.
///
/// Interpolation along y costs shuffles, interpolation along x does not. `Order::XThenY` interpolates every row of
/// vertices along y; `Order::YThenX` only every row of points, and is faster. They differ by rounding errors, and f32
/// frames promise the bits of the first.
pub(super) struct Rows<'v, P> {
    grid: Refinement,
    values: &'v [Vec<f32>; COMPONENTS],
    prepare: P,
    order: Order,
    /// The rows of points on either side of the row of vertices; with `YThenX` they are refined.
    near: Vec<f32>,
    far: Vec<f32>,
    /// A row of points before it is refined.
    points: Vec<f32>,
}

/// Which interpolation comes first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Order {
    XThenY,
    YThenX,
}

impl<'v, P: Fn(usize, f32) -> f32> Rows<'v, P> {
    /// Rows of `values`, one per point and component; `prepare` is given each component's number and value.
    pub(super) fn new(grid: Refinement, values: &'v [Vec<f32>; COMPONENTS], order: Order, prepare: P) -> Self {
        // Where there is nothing to refine along y, both orders are the same, and this one does less.
        let order = if grid.between == 0 { Order::YThenX } else { order };
        let side = if order == Order::XThenY { grid.points[1] } else { grid.vertices()[1] };
        let [near, far, points] = [side, side, grid.points[1]].map(row_of_points);
        Rows { grid, values, prepare, order, near, far, points }
    }

    /// Writes row `a`, three components a vertex. Rows are asked for one after the other, from 0.
    #[allow(clippy::cast_precision_loss)]
    pub(super) fn write<T: Copy>(&mut self, a: usize, row: &mut [T], put: impl Fn(f32) -> T + Copy) {
        let cells = self.grid.between + 1;
        let (i, k) = (a / cells, a % cells);
        match k {
            0 if a > 0 && cells > 1 => std::mem::swap(&mut self.near, &mut self.far),
            0 => {
                self.load(i);
                std::mem::swap(&mut self.near, &mut self.far);
            }
            1 => self.load(i + 1),
            _ => {}
        }
        // A row of points has no row beyond it to be mixed with, and at the rim there is none.
        let far = if k == 0 { &self.near } else { &self.far };
        let part = k as f32 / cells as f32;
        match self.order {
            Order::XThenY => {
                mix(&self.near, far, part, &mut self.points, |v| v);
                spread(cells, &self.points, row, put);
            }
            Order::YThenX => mix(&self.near, far, part, row, put),
        }
    }

    /// Brings row `i` of the points into `far`.
    fn load(&mut self, i: usize) {
        let columns = self.grid.points[1];
        let refines = self.order == Order::YThenX && self.grid.between > 0;
        let points = if refines { &mut self.points } else { &mut self.far };
        let [x, y, z] = self.values.each_ref().map(|values| &values[i * columns..][..columns]);
        for (((point, x), y), z) in points.as_chunks_mut::<COMPONENTS>().0.iter_mut().zip(x).zip(y).zip(z) {
            *point = [(self.prepare)(0, *x), (self.prepare)(1, *y), (self.prepare)(2, *z)];
        }
        if refines {
            spread(self.grid.between + 1, &self.points, &mut self.far, |v| v);
        }
    }
}

/// Interpolates between two rows: `part` of the way from `near` to `far`.
fn mix<T>(near: &[f32], far: &[f32], part: f32, row: &mut [T], put: impl Fn(f32) -> T) {
    for ((value, near), far) in row.iter_mut().zip(near).zip(far) {
        *value = put(near + part * (far - near));
    }
}

/// Interpolates within a row: `cells` vertices for each of the `points` but the last, which ends the row.
fn spread<T: Copy, P: Fn(f32) -> T>(cells: usize, points: &[f32], row: &mut [T], put: P) {
    // The loop over the vertices of a cell is unrolled only where their number is known: up to twice as fast.
    let spread_by = [
        spread_by::<1, T, P> as fn(&[f32], &mut [T], P),
        spread_by::<2, T, P>,
        spread_by::<3, T, P>,
        spread_by::<4, T, P>,
        spread_by::<5, T, P>,
        spread_by::<6, T, P>,
        spread_by::<7, T, P>,
        spread_by::<8, T, P>,
        spread_by::<9, T, P>,
        spread_by::<10, T, P>,
        spread_by::<11, T, P>,
    ];
    spread_by[cells - 1](points, row, put);
}

#[allow(clippy::cast_precision_loss)]
fn spread_by<const CELLS: usize, T: Copy, P: Fn(f32) -> T>(points: &[f32], row: &mut [T], put: P) {
    let cells = points.len() / COMPONENTS - 1;
    for j in 0..cells {
        let pair = &points[COMPONENTS * j..][..COMPONENTS + 4];
        let slope: [f32; 4] = std::array::from_fn(|c| (pair[COMPONENTS + c] - pair[c]) / CELLS as f32);
        // The fourth lane of a vertex is rubbish, and overwritten by the next vertex.
        let cell = &mut row[COMPONENTS * CELLS * j..][..COMPONENTS * CELLS + 1];
        for k in 0..CELLS {
            let vertex: [T; 4] = std::array::from_fn(|c| put(pair[c] + slope[c] * k as f32));
            cell[COMPONENTS * k..][..4].copy_from_slice(&vertex);
        }
    }
    for c in 0..COMPONENTS {
        row[COMPONENTS * CELLS * cells + c] = put(points[COMPONENTS * cells + c]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    impl Refinement {
        /// Row `a` of one component, in either order.
        fn row(self, values: &[f32], a: usize, row: &mut [f32]) {
            let values = [values.to_vec(), vec![0.0; values.len()], vec![0.0; values.len()]];
            for order in [Order::YThenX, Order::XThenY] {
                let mut rows = Rows::new(self, &values, order, |_, v| v);
                let mut vertices = vec![0.0; COMPONENTS * row.len()];
                (0..=a).for_each(|a| rows.write(a, &mut vertices, |v| v));
                for (vertex, value) in vertices.chunks(COMPONENTS).zip(&mut *row) {
                    assert!(order == Order::YThenX || (vertex[0] - *value).abs() < 1e-5);
                    *value = vertex[0];
                }
            }
        }
    }

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
