//! Which tiles of a tissue are joined by what pulls between its places, for a tissue whose places are joined in any way.

use std::ops::Range;

use crate::kernel::field::{Field, Layout};
use crate::kernel::real::Real;
use crate::kernel::region::{TILE, tiles};

/// The tiles next to each tile, and the places beyond a tile that pull at it.
#[derive(Debug, Default)]
pub(crate) struct TileLinks {
    /// The row and column of the places beyond each tile that are joined to it, ascending; and where each tile's places begin, with the end
    /// of the last.
    around: Vec<[u32; 2]>,
    firsts_around: Vec<usize>,
    /// The successive ones of these that are in one tile: that tile, and how many there are. Where each tile's runs begin, in the same way.
    runs: Vec<[u32; 2]>,
    firsts_runs: Vec<usize>,
    /// The tiles of these places, ascending, in the same way.
    beside: Vec<u32>,
    firsts_beside: Vec<usize>,
}

impl TileLinks {
    /// Finds the links of places in rows and columns. `joined` returns the places that pull at a place.
    #[allow(clippy::cast_possible_truncation)]
    pub(crate) fn of(size @ [rows, columns]: [usize; 2], joined: impl Fn(usize) -> Vec<usize>) -> Self {
        let across = tiles(columns);
        let tile_of = |place: usize| place / columns / TILE * across + place % columns / TILE;
        let mut links =
            TileLinks { firsts_around: vec![0], firsts_runs: vec![0], firsts_beside: vec![0], ..TileLinks::default() };
        for tile in 0..tiles(rows) * across {
            let places = places_of(size, tile);
            let mut beyond: Vec<u32> =
                places.flat_map(&joined).filter(|place| tile_of(*place) != tile).map(|place| place as u32).collect();
            beyond.sort_unstable();
            beyond.dedup();
            let tile_of = |place: &u32| tile_of(*place as usize) as u32;
            let runs = beyond.chunk_by(|one, next| tile_of(one) == tile_of(next));
            links.runs.extend(runs.map(|run| [tile_of(&run[0]), run.len() as u32]));
            links.firsts_runs.push(links.runs.len());
            let mut beside: Vec<u32> = beyond.iter().map(tile_of).collect();
            beside.sort_unstable();
            beside.dedup();
            links.around.extend(beyond.iter().map(|place| [place / columns as u32, place % columns as u32]));
            links.beside.extend(beside);
            links.firsts_around.push(links.around.len());
            links.firsts_beside.push(links.beside.len());
        }
        links
    }

    /// Returns the tiles that are joined to a tile, ascending.
    pub(crate) fn beside(&self, tile: usize) -> impl Iterator<Item = usize> + '_ {
        let range = self.firsts_beside[tile]..self.firsts_beside[tile + 1];
        self.beside[range].iter().map(|other| *other as usize)
    }

    /// Returns the row and column of the places beyond a tile that are joined to it, ascending, and the place of the first in the list of
    /// all tiles.
    pub(crate) fn around(&self, tile: usize) -> (&[[u32; 2]], usize) {
        let [from, to] = [self.firsts_around[tile], self.firsts_around[tile + 1]];
        (&self.around[from..to], from)
    }

    /// Returns the length of the list of all tiles' places.
    pub(crate) fn watched(&self) -> usize {
        self.around.len()
    }

    /// Stores where the points around a tile are.
    pub(crate) fn remember<T: Real>(&self, layout: &Layout, tile: usize, u: &Field<T>, snapshots: &mut [T]) {
        let (places, first) = self.around(tile);
        for c in 0..3 {
            for (place, k) in places.iter().zip(0..) {
                snapshots[3 * first + c * places.len() + k] = u[c * layout.plane + offset(layout, place)];
            }
        }
    }

    /// Returns whether a point around a tile, in one of the tiles `of`, is more than `far` from where the tile remembers it.
    pub(crate) fn has_moved<T: Real>(
        &self,
        layout: &Layout,
        tile: usize,
        of: impl Fn(usize) -> bool,
        (u, snapshots, far): (&Field<T>, &[T], T),
    ) -> bool {
        let (places, first) = self.around(tile);
        let mut from = 0;
        for [other, count] in &self.runs[self.firsts_runs[tile]..self.firsts_runs[tile + 1]] {
            let run = from..from + *count as usize;
            from = run.end;
            if !of(*other as usize) {
                continue;
            }
            let moved = (0..3).any(|c| {
                let then = &snapshots[3 * first + c * places.len()..][run.clone()];
                let plane = &u[c * layout.plane..][..layout.plane];
                let any = |any: bool, (place, then): (_, &T)| {
                    any | ((plane[offset(layout, place)] - *then).magnitude() > far)
                };
                places[run.clone()].iter().zip(then).fold(false, any)
            });
            if moved {
                return true;
            }
        }
        false
    }
}

/// Returns where a place is in a plane of a field.
#[inline]
fn offset(layout: &Layout, [row, column]: &[u32; 2]) -> usize {
    *row as usize * layout.stride + *column as usize
}

/// Returns the places of a tile.
fn places_of([rows, columns]: [usize; 2], tile: usize) -> impl Iterator<Item = usize> {
    let across = tiles(columns);
    let range = |from: usize, end: usize| -> Range<usize> { from..(from + TILE).min(end) };
    let (of_rows, of_columns) = (range(tile / across * TILE, rows), range(tile % across * TILE, columns));
    of_rows.flat_map(move |row| of_columns.clone().map(move |column| row * columns + column))
}
