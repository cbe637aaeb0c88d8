//! Refinement of a sheet: bilinear interpolation between neighbouring points. With n vertices between neighbours,
//! as in the paper, a side of m points has M = (m − 1)·n + m vertices.
// The compiler does not always inline iterators over vectors. They then run without the caller's instructions.
#![allow(clippy::needless_range_loop)]

use glam::{DVec2, DVec3};

use super::wide::{Available, LANES, SixteenLanes};
use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::limits::Limits;
use palpate_tissue::memory;
use palpate_tissue::scene::Scene;
use palpate_tissue::shape::PointId;

/// Name of the buffers in messages.
const ROW: &str = "a row of a frame";

/// Largest refinement n: the number of vertices between two neighbouring points of a sheet.
pub const LARGEST_REFINEMENT: u32 = 10;

/// Vertices along the longest side of a picture: enough that no edge is seen in it.
const PICTURE_VERTICES: u32 = 300;

/// Number of places for a mesh's vertices in a row of a frame. 16 rows are a tile of the frame, and a tile of the
/// sleeping logic.
pub const MESH_ROW: usize = 16;

/// Returns the number of points of a scene along x and y, as a frame has them, and their distance at rest, m. The
/// vertices of a mesh are in rows, in an order that keeps neighbours together; the last row may have places without
/// a vertex.
pub(super) fn grid(scene: &Scene) -> ([usize; 2], f64) {
    let shape = scene.shape();
    (shape.grid().unwrap_or_else(|| [shape.shown_count().div_ceil(MESH_ROW), MESH_ROW]), shape.edge_m())
}

/// Grid of a frame: nx × ny vertices, of which vertex [i, j] has the number i·ny + j. For a sheet these are its
/// points with n vertices between neighbours; for a mesh, its vertices in rows of [`MESH_ROW`] places (n = 0), where
/// the last row may have places without a vertex.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Refinement {
    /// Number of points along x and y; of a mesh, rows and places per row.
    pub(super) points: [usize; 2],
    /// Distance between points at rest, m; of a mesh, the usual length of an edge.
    point_spacing_m: f64,
    /// The n of the refinement.
    pub(super) between: usize,
}

impl Refinement {
    /// Returns the number of points between neighbouring ones that makes a picture smooth: some 300 vertices along its
    /// longest side. 0 where frames show the points alone.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub fn for_picture(scene: &Scene) -> u32 {
        if !scene.body.kind().can_refine() {
            return 0;
        }
        let cells = (scene.shape().longest_side_m() / scene.shape().edge_m()).round().max(1.0) as u32;
        PICTURE_VERTICES.div_ceil(cells).clamp(1, LARGEST_REFINEMENT + 1) - 1
    }

    /// Creates refinement `n` of the tissue of a scene.
    ///
    /// # Errors
    /// Refuses an `n` above [`LARGEST_REFINEMENT`] (10), an `n` above 0 on a mesh ([`Reason::OutOfRange`]), and a
    /// grid with more than `limits.frame_vertices` vertices ([`Reason::TooLarge`]).
    pub fn new(scene: &Scene, n: u32, limits: &Limits) -> Result<Self> {
        if n > LARGEST_REFINEMENT {
            let message = format!("must be from 0 to {LARGEST_REFINEMENT}, but is {n}");
            return Err(Refusal::new(Reason::OutOfRange, "refinement", message));
        }
        if n > 0 && !scene.body.kind().can_refine() {
            let message = format!("must be 0 on a mesh, whose own vertices are shown, but is {n}");
            return Err(Refusal::new(Reason::OutOfRange, "refinement", message));
        }
        let (points, point_spacing_m) = grid(scene);
        let refinement = Refinement { points, point_spacing_m, between: n as usize };
        refinement.check("refinement", limits)?;
        Ok(refinement)
    }

    /// Checks the number of vertices.
    ///
    /// # Errors
    /// Refuses a grid with more than `limits.frame_vertices` vertices ([`Reason::TooLarge`]), in the field `field`.
    pub fn check(&self, field: &str, limits: &Limits) -> Result<()> {
        let [x, y] = self.vertices();
        if x * y > limits.frame_vertices {
            let message = format!("makes {x} × {y} vertices, above the limit of {} in all", limits.frame_vertices);
            return Err(Refusal::new(Reason::TooLarge, field, message));
        }
        Ok(())
    }

    /// Returns this refinement with so many more rows.
    pub(super) fn with_rows(self, more: usize) -> Self {
        let [rows, columns] = self.points;
        Refinement { points: [rows + more, columns], ..self }
    }

    /// Returns nx and ny, the numbers of vertices along x and y; of a mesh, rows and places per row.
    pub fn vertices(&self) -> [usize; 2] {
        self.points.map(|points| (points - 1) * (self.between + 1) + 1)
    }

    /// Returns the refinement of the same tissue without vertices between the points (n = 0).
    pub fn coarsest(self) -> Self {
        Refinement { between: 0, ..self }
    }

    /// Returns n, the number of vertices between neighbouring points; 0 for a mesh.
    pub fn between(&self) -> usize {
        self.between
    }

    /// Returns the number of points of the sheet; of a mesh, the number of places in a frame.
    pub fn point_count(&self) -> usize {
        self.points[0] * self.points[1]
    }

    /// Returns the number of vertices, nx·ny; of a mesh, the number of places, with those that have no vertex.
    pub fn vertex_count(&self) -> usize {
        let [nx, ny] = self.vertices();
        nx * ny
    }

    /// Returns the distance between neighbouring vertices of a sheet at rest, m; of a mesh, the usual length of an
    /// edge.
    #[allow(clippy::cast_precision_loss)]
    pub fn spacing_m(&self) -> f64 {
        self.point_spacing_m / (self.between + 1) as f64
    }

    /// Returns the number of the vertex at a point of a sheet. On a mesh use [`Skin::places`](super::Skin::places).
    pub fn vertex_at(&self, point: PointId) -> usize {
        let (step, [_, ny]) = (self.between + 1, self.vertices());
        (point.index() / self.points[1]) * step * ny + (point.index() % self.points[1]) * step
    }

    /// Returns the rest position of vertex `vertex` = i·ny + j of a sheet, m, in the tissue's frame: x = i and y = j
    /// times the spacing of vertices, and z = 0. On a mesh use [`Skin::rest_m`](super::Skin::rest_m).
    #[allow(clippy::cast_precision_loss)]
    pub fn rest_m(&self, vertex: usize) -> DVec3 {
        let [_, ny] = self.vertices();
        self.spacing_m() * DVec3::new((vertex / ny) as f64, (vertex % ny) as f64, 0.0)
    }

    /// Returns the texture coordinates of vertex `vertex` = i·ny + j of a sheet: i/(nx − 1) along x and j/(ny − 1)
    /// along y, from 0 to 1. On a mesh use [`Skin::texture_at`](super::Skin::texture_at).
    #[allow(clippy::cast_precision_loss)]
    pub fn texture_at(&self, vertex: usize) -> DVec2 {
        let [nx, ny] = self.vertices();
        let share = |at: usize, count: usize| at as f64 / (count - 1).max(1) as f64;
        DVec2::new(share(vertex / ny, nx), share(vertex % ny, ny))
    }

    /// Returns the number of a sheet's cells, (nx − 1)·(ny − 1), of two triangles each. It has no meaning for a mesh.
    pub fn cell_count(&self) -> usize {
        let [nx, ny] = self.vertices();
        (nx - 1) * (ny - 1)
    }

    /// Returns the vertices of the two triangles of a sheet's cell, three and three, anticlockwise seen from above
    /// the tissue. Cell i·(ny − 1) + j has vertex [i, j] as its first corner. On a mesh use
    /// [`Skin::triangles`](super::Skin::triangles).
    pub fn triangles(&self, cell: usize) -> [usize; 6] {
        let [_, ny] = self.vertices();
        let corner = cell / (ny - 1) * ny + cell % (ny - 1);
        let (right, up) = (corner + ny, corner + 1);
        [corner, right, right + 1, corner, right + 1, up]
    }
}

/// Components of a point or vertex. In a row of a patch, x, y and z of a vertex are adjacent.
pub(super) const COMPONENTS: usize = 3;

/// Written form of a component.
pub(super) trait Written: Copy + Default {
    /// Writes displacements in quanta.
    fn write<L: SixteenLanes>(values: L, to: &mut [Self; LANES]);
    /// Writes x, y and z of points in quanta, point by point.
    fn weave<L: SixteenLanes>(xyz: [L; COMPONENTS], to: &mut [[Self; LANES]; COMPONENTS]);
}

/// Not encoded, because it is refined further.
impl Written for f32 {
    #[inline(always)]
    fn write<L: SixteenLanes>(values: L, to: &mut [Self; LANES]) {
        values.store(to);
    }
    #[inline(always)]
    fn weave<L: SixteenLanes>(xyz: [L; COMPONENTS], to: &mut [[Self; LANES]; COMPONENTS]) {
        L::weave(xyz, to);
    }
}

/// An IEEE float, little-endian.
impl Written for [u8; 4] {
    #[inline(always)]
    fn write<L: SixteenLanes>(values: L, to: &mut [Self; LANES]) {
        let mut floats = [0.0; LANES];
        values.store(&mut floats);
        for lane in 0..LANES {
            to[lane] = floats[lane].to_le_bytes();
        }
    }
    #[inline(always)]
    fn weave<L: SixteenLanes>(xyz: [L; COMPONENTS], to: &mut [[Self; LANES]; COMPONENTS]) {
        let mut floats = [[0.0; LANES]; COMPONENTS];
        L::weave(xyz, &mut floats);
        for c in 0..COMPONENTS {
            for lane in 0..LANES {
                to[c][lane] = floats[c][lane].to_le_bytes();
            }
        }
    }
}

/// A signed integer, little-endian; the values are within ±32767.
impl Written for [u8; 2] {
    #[inline(always)]
    fn write<L: SixteenLanes>(values: L, to: &mut [Self; LANES]) {
        values.store_rounded(to);
    }
    #[inline(always)]
    fn weave<L: SixteenLanes>(xyz: [L; COMPONENTS], to: &mut [[Self; LANES]; COMPONENTS]) {
        L::weave_rounded(xyz, to);
    }
}

/// The input of refinement: displacements of points, and their conversion to quanta, (v − origin)·per_scale.
#[derive(Debug, Clone, Copy)]
pub(super) struct Source<'v> {
    points: Points<'v>,
    /// The value repeated in each lane. The compiler would shuffle a value that it knows to be uniform.
    origin: [Block<f32>; COMPONENTS],
    per_scale: [Block<f32>; COMPONENTS],
}

/// A rectangle of points.
#[derive(Debug, Clone, Copy)]
pub(super) struct Points<'v> {
    /// x, y and z separate. Points along y are adjacent.
    pub(super) values: [&'v [f32]; COMPONENTS],
    /// Distance from one point to the next along x, in values.
    pub(super) stride: usize,
    /// Number of points along x and y.
    pub(super) count: [usize; 2],
}

impl<'v> Points<'v> {
    /// Returns row `i` of component `c`.
    #[inline(always)]
    pub(super) fn row(&self, c: usize, i: usize) -> &'v [f32] {
        &self.values[c][i * self.stride..][..self.count[1]]
    }
}

impl<'v> Source<'v> {
    pub(super) fn new(points: Points<'v>, origin: [f32; 3], per_scale: [f32; 3]) -> Self {
        Source { points, origin: origin.map(|v| Block([v; LANES])), per_scale: per_scale.map(|v| Block([v; LANES])) }
    }
}

/// Writer of the rows of vertices between some points, from the first to the last.
///
/// Points are converted to quanta before refinement, because there are fewer points than vertices. Interpolation
/// along y costs permutations, interpolation along x does not. So rows of points are refined along y, and rows of
/// vertices are mixed from them.
pub(super) struct Rows<'v> {
    /// Number of vertices for each point except the last.
    cells: usize,
    source: Source<'v>,
    /// The rows of points on either side of the row of vertices, refined along y, in whole periods of `spread`.
    near: Vec<Block<f32>>,
    far: Vec<Block<f32>>,
    /// A row of points before refinement, with padding for reads beyond it.
    points: Vec<f32>,
    spread: Vec<BlockPattern>,
}

/// Sixteen values that are aligned to one cache line: a load across two lines costs twice as much.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
struct Block<T>([T; LANES]);

/// A block of vertices in a row. The pattern repeats after 16 points, which are as many blocks as a point has
/// components of vertices.
struct BlockPattern {
    /// Beginning of the block of points from which it is made.
    begin: usize,
    /// Indices in that block of the components on the left and right side.
    left: Block<i32>,
    right: Block<i32>,
    /// Position of each vertex between left (0) and right (1).
    part: Block<f32>,
}

impl<'v> Rows<'v> {
    /// Creates the writer of rows of at most `most` vertices, with `between` of them between neighbouring points.
    pub(super) fn new(between: usize, most: usize, source: Source<'v>) -> Self {
        let cells = between + 1;
        let periods = if cells == 1 { 0 } else { most.div_ceil(cells * LANES) };
        let [near, far] = [(); 2].map(|()| memory::filled(periods * COMPONENTS * cells, Block([0.0; LANES]), ROW));
        let points = memory::zeroed((periods + 1) * COMPONENTS * LANES, ROW);
        let spread = (0..COMPONENTS * cells).map(|block| BlockPattern::new(cells, block)).collect();
        Rows { cells, source, near, far, points, spread }
    }

    /// Continues with the rows between other points.
    pub(super) fn turn_to(&mut self, source: Source<'v>) {
        self.source = source;
    }

    /// Writes row `a`, three components per vertex, as many as `row` has room for. Call it for consecutive rows
    /// from 0.
    #[inline(always)]
    #[allow(clippy::cast_precision_loss)]
    pub(super) fn write<L: SixteenLanes, W: Written>(&mut self, with: Available<L>, a: usize, row: &mut [W]) {
        let cells = self.cells;
        if cells == 1 {
            return weave(with, &self.source, a, row);
        }
        let (i, k) = (a / cells, a % cells);
        match k {
            0 => {
                if a == 0 {
                    self.load(with, 0);
                }
                // A row that lies on points is not mixed with the next, and at the edge there is no next row.
                std::mem::swap(&mut self.near, &mut self.far);
                put(with, &self.near, row);
            }
            _ => {
                if k == 1 {
                    self.load(with, i + 1);
                }
                mix(with, &self.near, &self.far, k as f32 / cells as f32, row);
            }
        }
    }

    /// Loads row `i` of the points into `far`.
    #[inline(always)]
    fn load<L: SixteenLanes>(&mut self, with: Available<L>, i: usize) {
        weave(with, &self.source, i, &mut self.points[..COMPONENTS * self.source.points.count[1]]);
        for (period, row) in self.far.chunks_exact_mut(self.spread.len()).enumerate() {
            let points = &self.points[period * COMPONENTS * LANES..];
            for (spread, vertices) in self.spread.iter().zip(row) {
                let points = with.load(&points[spread.begin..].as_chunks().0[0]);
                let (left, right) = (points.permute(&spread.left.0), points.permute(&spread.right.0));
                between(left, right, with.load(&spread.part.0)).store(&mut vertices.0);
            }
        }
    }
}

impl BlockPattern {
    #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, clippy::cast_precision_loss)]
    fn new(cells: usize, block: usize) -> Self {
        let begin = block * LANES / COMPONENTS / cells * COMPONENTS;
        let (mut left, mut part) = ([0; LANES], [0.0; LANES]);
        for lane in 0..LANES {
            let (vertex, c) = ((block * LANES + lane) / COMPONENTS, (block * LANES + lane) % COMPONENTS);
            left[lane] = (vertex / cells * COMPONENTS + c - begin) as i32;
            part[lane] = (vertex % cells) as f32 / cells as f32;
        }
        let right = left.map(|left| left + COMPONENTS as i32);
        BlockPattern { begin, left: Block(left), right: Block(right), part: Block(part) }
    }
}

/// Converts the points of row `i` to quanta, as many as `row` has room for.
#[inline(always)]
fn weave<L: SixteenLanes, W: Written>(with: Available<L>, source: &Source<'_>, i: usize, row: &mut [W]) {
    let row = row.as_chunks_mut::<COMPONENTS>().0;
    let (count, points) = (row.len(), &source.points);
    let values = [&points.row(0, i)[..count], &points.row(1, i)[..count], &points.row(2, i)[..count]];
    if count < LANES {
        let mut padded = [[0.0; LANES]; COMPONENTS];
        for c in 0..COMPONENTS {
            padded[c][..count].copy_from_slice(values[c]);
        }
        let mut block = [[W::default(); COMPONENTS]; LANES];
        source.weave(with, [&padded[0], &padded[1], &padded[2]], &mut block);
        return row.copy_from_slice(&block[..count]);
    }
    let blocks = row.as_chunks_mut::<LANES>().0;
    let x = &values[0].as_chunks::<LANES>().0[..blocks.len()];
    let y = &values[1].as_chunks::<LANES>().0[..blocks.len()];
    let z = &values[2].as_chunks::<LANES>().0[..blocks.len()];
    for block in 0..blocks.len() {
        source.weave(with, [&x[block], &y[block], &z[block]], &mut blocks[block]);
    }
    // The last block overlaps the previous one.
    let last = (values[0].last_chunk(), values[1].last_chunk(), values[2].last_chunk(), row.last_chunk_mut());
    if let (Some(x), Some(y), Some(z), Some(block)) = last {
        source.weave(with, [x, y, z], block);
    }
}

impl Source<'_> {
    /// Writes x, y and z of a block, in quanta.
    #[inline(always)]
    fn weave<L: SixteenLanes, W: Written>(
        &self,
        with: Available<L>,
        xyz: [&[f32; LANES]; COMPONENTS],
        to: &mut [[W; COMPONENTS]; LANES],
    ) {
        let mut quanta = [with.splat(0.0); COMPONENTS];
        for c in 0..COMPONENTS {
            quanta[c] = with.load(xyz[c]).sub(with.load(&self.origin[c].0)).mul(with.load(&self.per_scale[c].0));
        }
        if let Some(to) = to.as_flattened_mut().as_chunks_mut().0.first_chunk_mut() {
            W::weave(quanta, to);
        }
    }
}

/// Interpolates at `part` between `near` and `far`.
#[inline(always)]
fn between<L: SixteenLanes>(near: L, far: L, part: L) -> L {
    near.add(part.mul(far.sub(near)))
}

/// Writes a row without mixing.
#[inline(always)]
fn put<L: SixteenLanes, W: Written>(with: Available<L>, values: &[Block<f32>], row: &mut [W]) {
    let (blocks, rest) = row.as_chunks_mut();
    for (block, values) in blocks.iter_mut().zip(values) {
        W::write(with.load(&values.0), block);
    }
    if !rest.is_empty() {
        let mut block = [W::default(); LANES];
        W::write(with.load(&values[blocks.len()].0), &mut block);
        rest.copy_from_slice(&block[..rest.len()]);
    }
}

/// Writes a row at `part` between `near` and `far`.
#[inline(always)]
fn mix<L: SixteenLanes, W: Written>(
    with: Available<L>,
    near: &[Block<f32>],
    far: &[Block<f32>],
    part: f32,
    row: &mut [W],
) {
    let part = with.splat(part);
    let (blocks, rest) = row.as_chunks_mut();
    for ((block, near), far) in blocks.iter_mut().zip(near).zip(far) {
        W::write(between(with.load(&near.0), with.load(&far.0), part), block);
    }
    if !rest.is_empty() {
        let (near, far) = (with.load(&near[blocks.len()].0), with.load(&far[blocks.len()].0));
        let mut block = [W::default(); LANES];
        W::write(between(near, far, part), &mut block);
        rest.copy_from_slice(&block[..rest.len()]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::scene;

    /// Returns all rows of one component.
    fn refine(grid: Refinement, values: &[f32]) -> Vec<Vec<f32>> {
        let points = Points { values: [values; COMPONENTS], stride: grid.points[1], count: grid.points };
        let [x, y] = grid.vertices();
        let mut rows = Rows::new(grid.between, y, Source::new(points, [0.0; COMPONENTS], [1.0; COMPONENTS]));
        let row = |a| {
            let mut row = vec![[0; 4]; COMPONENTS * y];
            rows.write(Available::PLAIN, a, &mut row);
            row.chunks(COMPONENTS).map(|vertex| f32::from_le_bytes(vertex[1])).collect()
        };
        (0..x).map(row).collect()
    }

    #[test]
    fn a_refined_grid_has_the_papers_size_and_interpolates_bilinearly() {
        for n in 0..=LARGEST_REFINEMENT {
            let (nx, ny) = (4, 3);
            let grid = Refinement::new(&scene([nx, ny]), n, &Limits::default()).unwrap();
            let between = n as usize;
            assert_eq!(grid.vertices(), [(nx - 1) * between + nx, (ny - 1) * between + ny]);
            // A bilinear function is its own bilinear interpolation.
            let law = |x: f32, y: f32| 1.0 + 2.0 * x - 3.0 * y + 0.5 * x * y;
            let values: Vec<f32> = (0..nx * ny).map(|k| law((k / ny) as f32, (k % ny) as f32)).collect();
            for (a, row) in refine(grid, &values).into_iter().enumerate() {
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
        let refusal = Refinement::new(&scene([31, 31]), 11, &Limits::default()).unwrap_err();
        assert_eq!((refusal.reason, refusal.field.as_str()), (Reason::OutOfRange, "refinement"));
        let refusal = Refinement::new(&scene([1001, 1001]), 10, &Limits::default()).unwrap_err();
        assert_eq!(refusal.reason, Reason::TooLarge);
    }
}
