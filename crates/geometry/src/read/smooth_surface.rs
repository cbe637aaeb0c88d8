//! The smooth surface of a label: the parts of cells are blurred, and bounded where they fall below a level at which as much
//! is inside as before.
//!
//! The surface of voxels has stairs. A blur of one cell removes them, but shrinks what is curved, and what is thin vanishes
//! below one half. So the level is that at which the number of cells above it is the volume of the label in cells.

use fast_surface_nets::ndshape::RuntimeShape;
use fast_surface_nets::{SurfaceNetsBuffer, surface_nets};
use glam::DVec3;

use super::draft::Draft;
use crate::Problem;
use crate::manifold_grid::fill_ambiguous;
use crate::work::spend;

/// Memory for each cell, bytes: its part, and the number of its vertex.
pub(super) const MEMORY: usize = 8;

/// Memory for each crossing of an edge of the grid, bytes: a vertex, two triangles, with room to grow.
const CROSSING: usize = 192;

/// Fewest passes of the blur along an axis. Each adds half a cell² to the square of its width.
const PASSES: usize = 2;

/// Most passes of the blur along an axis.
const MAX_PASSES: usize = 24;

/// Number of steps of the level.
const LEVELS: usize = 1 << 12;

/// A part that is nearer to the level than this counts as inside, so that vertices around it are not at one place.
const NEAREST: f32 = 1e-3;

/// Times that vertices are moved to their neighbours.
const EVENINGS: usize = 2;

/// Most times that a surface is moved to its volume, and the relative error of the volume at which it is there.
const MAX_FITS: usize = 16;
const FITTED: f64 = 1e-6;

/// Longest way of vertices at once, as a part of the edge of a cube with the volume.
const MAX_STEP: f64 = 0.2;

/// Cells around a label.
pub(super) struct PartGrid {
    pub(super) sides: [usize; 3],
    /// The part of each cell inside, 0 to 1; x runs fastest, then y.
    pub(super) parts: Vec<f32>,
    /// Lengths of the edges of a cell.
    pub(super) size: [f64; 3],
}

/// A surface in cells: the middle of the first cell is at ½.
pub(super) struct CellSurface {
    pub(super) vertices: Vec<DVec3>,
    pub(super) triangles: Vec<[u32; 3]>,
}

/// Returns the surface. It is closed, and faces outward where the axes are right-handed.
pub(super) fn of(grid: PartGrid, draft: &mut Draft<'_>) -> Result<CellSurface, Problem> {
    let PartGrid { sides, mut parts, size } = grid;
    let cells = parts.iter().map(|part| f64::from(*part)).sum();
    // As wide along each axis as 0.7 times the longest edge of a cell, if not wider: else the slices of a scan show.
    let longest = size.into_iter().fold(0.0, f64::max);
    for (axis, size) in size.into_iter().enumerate() {
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let passes = (longest / size).powi(2).ceil() as usize;
        for _ in 0..passes.clamp(PASSES, MAX_PASSES) {
            blur(&mut parts, sides, axis);
        }
    }
    let level = level(&parts, cells);
    for part in &mut parts {
        let distance = level - *part;
        *part = if distance.abs() < NEAREST { -NEAREST } else { distance };
    }
    clear_border(&mut parts, sides);
    fill_ambiguous(&mut parts, sides);
    let crossings = crossings(&parts, sides);
    if 2 * crossings > draft.limits.triangles {
        return Err(Problem::TooLarge { what: "triangles", limit: draft.limits.triangles });
    }
    // As much again for the mesh that is read.
    draft.allowance.add_room(2 * CROSSING * crossings);
    draft.allowance.take(CROSSING * crossings)?;
    #[allow(clippy::cast_possible_truncation)]
    let shape = RuntimeShape::<u32, 3>::new(sides.map(|side| side as u32));
    let mut net = SurfaceNetsBuffer::default();
    #[allow(clippy::cast_possible_truncation)]
    surface_nets(&parts, &shape, [0; 3], sides.map(|side| side as u32 - 1), &mut net);
    let place = |at: &[f32; 3]| DVec3::from_array(at.map(f64::from)) + 0.5;
    Ok(CellSurface {
        vertices: net.positions.iter().map(place).collect(),
        triangles: net.indices.chunks_exact(3).map(|corners| [corners[0], corners[1], corners[2]]).collect(),
    })
}

/// Replaces each part by a quarter of those before and after it along an axis and a half of itself. Beyond the grid all is
/// empty.
fn blur(parts: &mut [f32], sides: [usize; 3], axis: usize) {
    spend(parts.len());
    let stride: usize = sides[..axis].iter().product();
    let block = stride * sides[axis];
    for block in parts.chunks_exact_mut(block) {
        for first in 0..stride {
            let mut before = 0.0;
            for at in (first..block.len()).step_by(stride) {
                let own = block[at];
                let after = block.get(at + stride).copied().unwrap_or(0.0);
                block[at] = 0.25 * (before + after) + 0.5 * own;
                before = own;
            }
        }
    }
}

/// Returns the level that as many parts reach as `cells` says: midway between the least part above it and the largest below.
fn level(parts: &[f32], cells: f64) -> f32 {
    let mut counts = vec![0_u32; LEVELS + 1];
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let step = |part: f32| ((part * LEVELS as f32) as usize).min(LEVELS);
    parts.iter().for_each(|part| counts[step(*part)] += 1);
    let mut above = 0.0;
    let mut least = LEVELS;
    for at in (0..=LEVELS).rev().filter(|at| counts[*at] > 0) {
        let own = f64::from(counts[at]);
        // Of equal parts all are inside or none, whichever is nearer.
        if at == 0 || above > 0.0 && cells - above < 0.5 * own {
            #[allow(clippy::cast_precision_loss)]
            return (least + at + 1) as f32 / (2 * LEVELS) as f32;
        }
        above += own;
        least = at;
    }
    0.5
}

/// Makes the outermost cells empty, at the end of each axis the last two, where the crate makes no faces: the surface is
/// closed.
fn clear_border(distances: &mut [f32], sides: [usize; 3]) {
    for (number, distance) in distances.iter_mut().enumerate() {
        let at = [number % sides[0], number / sides[0] % sides[1], number / (sides[0] * sides[1])];
        if (0..3).any(|axis| at[axis] == 0 || at[axis] + 2 >= sides[axis]) {
            *distance = distance.max(NEAREST);
        }
    }
}

/// Returns how many edges of the grid the surface crosses.
fn crossings(distances: &[f32], sides: [usize; 3]) -> usize {
    let strides = [1, sides[0], sides[0] * sides[1]];
    let differs = |stride: usize| {
        let pairs = distances.iter().zip(&distances[stride..]);
        pairs.filter(|(a, b)| (**a < 0.0) != (**b < 0.0)).count()
    };
    strides.into_iter().map(differs).sum()
}

/// Moves each vertex halfway to the mean of its neighbours, [`EVENINGS`] times: where the surface passes a cell's middle closely,
/// triangles have almost no area.
pub(super) fn even_out(vertices: &mut [DVec3], triangles: &[[u32; 3]]) {
    for _ in 0..EVENINGS {
        // Of a closed surface each neighbour counts twice.
        let mut sums = vec![(DVec3::ZERO, 0.0); vertices.len()];
        for [a, b, c] in triangles.iter().map(|corners| corners.map(|corner| corner as usize)) {
            for (own, one, other) in [(a, b, c), (b, c, a), (c, a, b)] {
                sums[own].0 += vertices[one] + vertices[other];
                sums[own].1 += 2.0;
            }
        }
        for (vertex, (sum, count)) in vertices.iter_mut().zip(sums).filter(|(_, (_, count))| *count > 0.0) {
            *vertex = 0.5 * (*vertex + sum / count);
        }
    }
}

/// Moves the vertices along their normals until the surface encloses a volume.
pub(super) fn fit_volume(vertices: &mut [DVec3], triangles: &[[u32; 3]], volume: f64) {
    for _ in 0..MAX_FITS {
        let mut normals = vec![DVec3::ZERO; vertices.len()];
        let (mut sixfold, mut area) = (0.0, 0.0);
        let Some(middle) = vertices.first().copied() else { return };
        for triangle in triangles {
            let [a, b, c] = triangle.map(|vertex| vertices[vertex as usize] - middle);
            let double = (b - a).cross(c - a);
            sixfold += a.dot(b.cross(c));
            area += 0.5 * double.length();
            triangle.iter().for_each(|vertex| normals[*vertex as usize] += double);
        }
        let missing = volume - sixfold / 6.0;
        let step = missing / area;
        if !step.is_finite() || missing.abs() < FITTED * volume {
            return;
        }
        // What is small would be moved too far.
        let most = MAX_STEP * volume.cbrt();
        let step = step.clamp(-most, most);
        vertices.iter_mut().zip(&normals).for_each(|(vertex, normal)| *vertex += step * normal.normalize_or_zero());
    }
}
