//! The tiles of a sheet: which lie beside each other, and the points beyond their edges.

use std::ops::Range;

use crate::body::force_field::ForceChange;
use crate::kernel::field::{Field, Layout};
use crate::kernel::real::Real;
use crate::kernel::region::{Marks, TILE, sides_of, tile_of, tiles};

/// Offsets of a tile's neighbours: along x, along y.
const NEIGHBOURS: [[isize; 2]; 8] = [[-1, -1], [-1, 0], [-1, 1], [0, -1], [0, 1], [1, -1], [1, 0], [1, 1]];

/// Indices of the neighbours in which springs begin that reach the tile.
const PULLING: [usize; 3] = [0, 1, 3];

/// Number of values that a tile remembers: three for each of 16 points, for each side and corner.
const REMEMBERED: usize = NEIGHBOURS.len() * 3 * TILE;

/// Points next to a sleeping tile, in an awake tile.
#[derive(Debug, Clone, Copy)]
pub(crate) struct EdgeWatch {
    pub(crate) tile: usize,
    /// The side of the tile, as an index into [`NEIGHBOURS`].
    side: usize,
    points: TileEdge,
}

/// The points beyond a side or corner of a tile.
#[derive(Debug, Clone, Copy)]
struct TileEdge {
    /// Offset of the first point, and the distance to the next.
    first: usize,
    next: usize,
    count: usize,
}

/// Returns the place of the positions of the points beyond a side of a tile, for x; y and z are [`TILE`] and twice
/// [`TILE`] values later.
fn place_of(tile: usize, side: usize) -> usize {
    tile * REMEMBERED + side * 3 * TILE
}

/// The tiles of a sheet.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SheetTiles {
    pub(crate) layout: Layout,
    /// Tiles along x and along y.
    counts: [usize; 2],
    /// Number of rows over which a spring reaches.
    reach: usize,
}

impl SheetTiles {
    /// Returns the tiles of a sheet whose springs reach over `reach` rows.
    pub(crate) fn new(layout: Layout, reach: usize) -> Self {
        SheetTiles { layout, counts: [tiles(layout.rows), tiles(layout.columns)], reach }
    }

    fn neighbour(&self, tile: usize, side: usize) -> Option<usize> {
        let [x, y] = NEIGHBOURS[side];
        let [i, j] = [(tile / self.counts[1]).checked_add_signed(x)?, (tile % self.counts[1]).checked_add_signed(y)?];
        (i < self.counts[0] && j < self.counts[1]).then_some(i * self.counts[1] + j)
    }

    /// Returns the tiles around a tile.
    pub(crate) fn beside(&self, tile: usize) -> impl Iterator<Item = usize> + '_ {
        (0..NEIGHBOURS.len()).filter_map(move |side| self.neighbour(tile, side))
    }

    /// Returns the tiles in which springs begin that reach a tile.
    pub(crate) fn pulling(&self, tile: usize) -> impl Iterator<Item = usize> + '_ {
        PULLING.iter().filter_map(move |side| self.neighbour(tile, *side))
    }

    /// Returns how many rows motion travels in `sweeps` sweeps; not beyond the neighbouring tiles.
    fn front(&self, sweeps: usize) -> usize {
        (self.reach * sweeps).min(TILE)
    }

    /// Returns the tiles that motion of a point reaches in `sweeps` sweeps; some perhaps twice.
    pub(crate) fn reached(&self, point: [usize; 2], sweeps: usize) -> impl Iterator<Item = usize> + '_ {
        let Layout { rows, columns, .. } = self.layout;
        let front = self.front(sweeps);
        let [i, j] = [(point[0], rows), (point[1], columns)]
            .map(|(at, count)| [at.saturating_sub(front), (at + front).min(count - 1)]);
        let corners = [[i[0], j[0]], [i[0], j[1]], [i[1], j[0]], [i[1], j[1]]];
        corners.into_iter().map(|corner| tile_of(&self.layout, corner))
    }

    /// Returns the points beyond a side or corner.
    fn beyond(&self, tile: usize, side: usize) -> TileEdge {
        let Layout { stride, .. } = self.layout;
        let [rows, columns] = sides_of(&self.layout, tile);
        let [x, y] = NEIGHBOURS[side];
        let (i, count_x) = match x {
            -1 => (rows.start - 1, 1),
            0 => (rows.start, rows.len()),
            _ => (rows.end, 1),
        };
        let (j, count_y) = match y {
            -1 => (columns.start - 1, 1),
            0 => (columns.start, columns.len()),
            _ => (columns.end, 1),
        };
        TileEdge { first: i * stride + j, next: if x == 0 { stride } else { 1 }, count: count_x.max(count_y) }
    }

    /// Returns up to `front` rows and columns beyond a side or corner.
    fn near(&self, tile: usize, side: usize, front: usize) -> [Range<usize>; 2] {
        let beyond = |own: Range<usize>, way: isize, count: usize| match way {
            -1 => own.start.saturating_sub(front)..own.start,
            0 => own,
            _ => own.end..(own.end + front).min(count),
        };
        let ([x, y], [rows, columns]) = (NEIGHBOURS[side], sides_of(&self.layout, tile));
        [beyond(rows, x, self.layout.rows), beyond(columns, y, self.layout.columns)]
    }

    /// Returns the place of the positions that a tile remembers.
    pub(crate) fn remembered(tile: usize) -> Range<usize> {
        tile * REMEMBERED..(tile + 1) * REMEMBERED
    }

    /// Stores where the points around a tile are.
    pub(crate) fn remember<T: Real>(&self, tile: usize, u: &Field<T>, snapshots: &mut [T]) {
        for side in (0..NEIGHBOURS.len()).filter(|side| self.neighbour(tile, *side).is_some()) {
            let TileEdge { first, next, count } = self.beyond(tile, side);
            for c in 0..3 {
                for k in 0..count {
                    snapshots[place_of(tile, side) + c * TILE + k] = u[c * self.layout.plane + first + k * next];
                }
            }
        }
    }

    /// Adds the comparisons of the sleeping tiles around an awake one.
    pub(crate) fn watch(&self, tile: usize, awake: &Marks, watches: &mut Vec<EdgeWatch>) {
        // The order of neighbours is the reverse of that of their opposites.
        for (side, opposite) in (0..NEIGHBOURS.len()).zip((0..NEIGHBOURS.len()).rev()) {
            if let Some(tile) = self.neighbour(tile, opposite).filter(|other| !awake.has[*other]) {
                watches.push(EdgeWatch { tile, side, points: self.beyond(tile, side) });
            }
        }
    }

    /// Returns whether a watched point is more than `far` from where it was when the tile fell asleep, or a point whose
    /// motion reaches the tile in `sweeps` sweeps has moved by more than that in the substep before.
    pub(crate) fn has_moved<T: Real>(
        &self,
        watch: &EdgeWatch,
        [u, d]: [&Field<T>; 2],
        snapshots: &[T],
        sweeps: usize,
        far: T,
    ) -> bool {
        let EdgeWatch { tile, side, points: TileEdge { first, next, count } } = *watch;
        let then = place_of(tile, side);
        let has_moved = (0..3).any(|c| {
            let (here, then) = (&u[c * self.layout.plane + first..], &snapshots[then + c * TILE..][..count]);
            // Compares all of them without an early exit, so that it compiles to a few vectors.
            let any = |any: bool, (now, then): (&T, &T)| any | ((*now - *then).magnitude() > far);
            if next == 1 {
                here[..count].iter().zip(then).fold(false, any)
            } else {
                here.iter().step_by(next).zip(then).fold(false, any)
            }
        });
        let front = self.front(sweeps);
        has_moved || front > 1 && self.is_near_fast(self.near(tile, side, front), d, far)
    }

    fn is_near_fast<T: Real>(&self, [rows, columns]: [Range<usize>; 2], d: &Field<T>, far: T) -> bool {
        (0..3).any(|c| {
            let row = |i: usize| &d[c * self.layout.plane + i * self.layout.stride..][columns.clone()];
            rows.clone().any(|i| row(i).iter().fold(false, |any, d| any | (d.magnitude() > far)))
        })
    }

    /// Calls `changed` with each sleeping tile that a changed force reaches, or with all, and a bound of its change, N.
    pub(crate) fn force_changes(
        &self,
        change: &ForceChange,
        spacing_m: f64,
        everywhere: bool,
        awake: &[bool],
        mut changed: impl FnMut(usize, f64),
    ) {
        let within = |sides: [Range<usize>; 2]| sides.map(|points| points.start / TILE..tiles(points.end));
        let [old, new] =
            if everywhere { [self.counts.map(|count| 0..count), [0..0, 0..0]] } else { change.reached().map(within) };
        let is_old = |row, column| old[0].contains(&row) && old[1].contains(&column);
        for (which, [rows, columns]) in [&old, &new].into_iter().enumerate() {
            for (row, column) in rows.clone().flat_map(|row| columns.clone().map(move |column| (row, column))) {
                let tile = row * self.counts[1] + column;
                if awake[tile] || which == 1 && is_old(row, column) {
                    continue;
                }
                #[allow(clippy::cast_precision_loss)]
                let sides = sides_of(&self.layout, tile)
                    .map(|range| [range.start as f64 * spacing_m, (range.end - 1) as f64 * spacing_m]);
                changed(tile, change.most_n(&sides));
            }
        }
    }
}

#[cfg(test)]
#[test]
fn neighbours_are_the_tiles_around_that_are_on_the_sheet() {
    // Three by three tiles, the last of which are not whole.
    let tiles = SheetTiles::new(Layout::new::<f64>([40, 37]), 1);
    let around: Vec<Vec<usize>> = (0..9).map(|tile| tiles.beside(tile).collect()).collect();
    assert_eq!(around[0], [1, 3, 4]);
    assert_eq!(around[1], [0, 2, 3, 4, 5]);
    assert_eq!(around[4], [0, 1, 2, 3, 5, 6, 7, 8]);
    assert_eq!(around[5], [1, 2, 4, 7, 8]);
    assert_eq!(around[8], [4, 5, 7]);
}
