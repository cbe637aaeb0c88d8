//! The part of a tissue that a sweep covers: whole tiles, and the strips of rows and columns that cover them.
//!
//! Every operation costs as much as the part holds, not as much as the tissue.

use std::ops::Range;

use crate::kernel::field::{BLOCK, Layout};
use crate::memory;

/// Points along a side of a tile.
pub(crate) const TILE: usize = BLOCK;

/// Returns the number of tiles that cover `points` points.
pub(crate) fn tiles(points: usize) -> usize {
    points.div_ceil(TILE)
}

/// Returns the tile of a point, by its row and column in memory.
pub(crate) fn tile_of(layout: &Layout, [i, j]: [usize; 2]) -> usize {
    i / TILE * tiles(layout.columns) + j / TILE
}

/// Returns the rows and columns of a tile.
pub(crate) fn sides_of(layout: &Layout, tile: usize) -> [Range<usize>; 2] {
    let columns = tiles(layout.columns);
    let side = |from: usize, points: usize| from..(from + TILE).min(points);
    [side(tile / columns * TILE, layout.rows), side(tile % columns * TILE, layout.columns)]
}

/// A set of tiles. Iterating and clearing cost as much as the set holds, whatever the size of the tissue.
#[derive(Debug, Clone, Default)]
pub(crate) struct Marks {
    pub(crate) members: Vec<usize>,
    pub(crate) has: Vec<bool>,
}

impl Marks {
    pub(crate) fn none_of(count: usize) -> Self {
        Marks { members: Vec::new(), has: memory::zeroed(count, "the tiles of a tissue") }
    }

    /// Adds a tile. Returns whether it is new.
    pub(crate) fn add(&mut self, tile: usize) -> bool {
        let new = !std::mem::replace(&mut self.has[tile], true);
        if new {
            self.members.push(tile);
        }
        new
    }

    pub(crate) fn clear(&mut self) {
        let Marks { members, has } = self;
        members.drain(..).for_each(|tile| has[tile] = false);
    }

    pub(crate) fn is_full(&self) -> bool {
        self.members.len() == self.has.len()
    }
}

/// Part of a tissue that a sweep covers.
#[derive(Debug, Clone, Default)]
pub(crate) struct Region {
    /// Ordered for the sweep: no strip reads what an earlier strip has overwritten.
    pub(crate) strips: Vec<Strip>,
    /// [`Region::cover`] sorts the members and removes those that are no longer awake.
    pub(crate) awake: Marks,
    /// Number of tiles along y.
    columns: usize,
}

/// A rectangle of points.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Strip {
    pub(crate) rows: Range<usize>,
    /// Whole tiles, the last of which may reach beyond the grid.
    pub(crate) columns: Range<usize>,
    /// Whether all of it is awake.
    pub(crate) awake: bool,
}

impl Region {
    /// Creates a region without tiles.
    pub(crate) fn none(layout: &Layout) -> Self {
        let columns = tiles(layout.columns);
        Region { strips: Vec::new(), awake: Marks::none_of(tiles(layout.rows) * columns), columns }
    }

    /// Returns the awake tiles, ascending.
    pub(crate) fn tiles(&self) -> &[usize] {
        &self.awake.members
    }

    /// Returns the rows from `before` rows above the first awake tile to the end of the last one, of `rows` rows in all.
    /// [`Region::cover`] has sorted the tiles.
    pub(crate) fn rows(&self, before: usize, rows: usize) -> Range<usize> {
        let (Some(first), Some(last)) = (self.tiles().first(), self.tiles().last()) else { return 0..0 };
        (first / self.columns * TILE).saturating_sub(before)..((last / self.columns + 1) * TILE).min(rows)
    }

    /// Makes the strips cover the awake tiles; springs reach over `reach` rows.
    pub(crate) fn cover(&mut self, layout: &Layout, reach: usize) {
        let Region { strips, awake, columns } = self;
        let Marks { members, has } = awake;
        members.retain(|tile| has[*tile]);
        members.sort_unstable();
        strips.clear();
        if members.len() == has.len() {
            strips.push(Strip { rows: 0..layout.rows, columns: 0..*columns * TILE, awake: true });
            return;
        }
        let row_of = |row: usize| {
            let from = members.partition_point(|tile| *tile < row * *columns);
            &members[from..from + members[from..].partition_point(|tile| *tile < (row + 1) * *columns)]
        };
        let mut next = 0;
        for tile in members.iter() {
            // Springs that begin in the last rows above a tile pull at it.
            for row in (tile / *columns).saturating_sub(1).max(next)..=tile / *columns {
                let (own, below) = (row_of(row), row_of(row + 1));
                let rows = row * TILE..((row + 1) * TILE).min(layout.rows);
                let last = if below.is_empty() { rows.end } else { rows.end.saturating_sub(reach).max(rows.start) };
                push_strips(strips, rows.start..last, *columns, [own, &[]]);
                push_strips(strips, last..rows.end, *columns, [own, below]);
                next = row + 1;
            }
        }
    }

    /// Returns whether the strips lie within the memory of `layout`: they may reach beyond the columns, but not
    /// beyond the rows.
    pub(crate) fn is_within(&self, layout: &Layout) -> bool {
        let is_within =
            |strip: &Strip| strip.rows.end <= layout.rows && strip.columns.end <= tiles(layout.columns) * TILE;
        self.strips.iter().all(is_within)
    }

    /// Returns whether the tile of a point is awake.
    #[inline(always)]
    pub(crate) fn is_awake(&self, row: usize, column: usize) -> bool {
        self.awake.has[row / TILE * self.columns + column / TILE]
    }
}

/// Adds the strips over `rows` for two ascending rows of tiles, joined where they meet. The first row is awake.
fn push_strips(strips: &mut Vec<Strip>, rows: Range<usize>, columns: usize, [mut own, mut below]: [&[usize]; 2]) {
    if rows.is_empty() {
        return;
    }
    let first = strips.len();
    let place = |tile: &usize| tile % columns * TILE;
    while let Some(from) = own.first().into_iter().chain(below.first()).map(place).min() {
        let is_next = |tiles: &mut &[usize]| {
            let next = tiles.split_first().filter(|(tile, _)| place(tile) == from);
            next.map(|(_, others)| *tiles = others).is_some()
        };
        let awake = is_next(&mut own);
        is_next(&mut below);
        match strips[first..].last_mut() {
            Some(strip) if strip.columns.end == from => {
                strip.columns.end = from + TILE;
                strip.awake &= awake;
            }
            _ => strips.push(Strip { rows: rows.clone(), columns: from..from + TILE, awake }),
        }
    }
    // A strip that continues the one above is merged with it.
    if let [.., above, below] = &mut strips[..]
        && (above.rows.end, &above.columns, above.awake) == (below.rows.start, &below.columns, below.awake)
    {
        above.rows.end = below.rows.end;
        strips.pop();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn region(layout: &Layout, awake: &[usize], reach: usize) -> Region {
        let mut region = Region::none(layout);
        awake.iter().for_each(|tile| {
            region.awake.add(*tile);
        });
        region.cover(layout, reach);
        region
    }

    #[test]
    fn strips_cover_what_is_awake_and_the_springs_above_once() {
        let layout = Layout::new::<f32>([3 * TILE + 5, 4 * TILE + 1]);
        let [down, across] = [4, 5];
        let mut dice = 20_261_122_u64;
        for _ in 0..400 {
            dice = dice.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let bits = (dice >> 33) & (dice >> 40) | (dice >> 12) & 0b1000;
            let awake: Vec<usize> = (0..down * across).filter(|tile| bits >> tile & 1 == 1).rev().collect();
            for reach in [1, 2] {
                let region = region(&layout, &awake, reach);
                assert!(region.is_within(&layout));
                assert!(region.tiles().is_sorted() && region.tiles().len() == awake.len());
                let is_awake = |i: usize, j: usize| awake.contains(&(i / TILE * across + j / TILE));
                let of = |i: usize, j: usize| {
                    region.strips.iter().filter(move |strip| strip.rows.contains(&i) && strip.columns.contains(&j))
                };
                for i in 0..layout.rows {
                    for j in 0..layout.columns {
                        // Springs that begin in the last rows above an awake tile pull at it.
                        let above = (1..=reach).any(|k| i + k < layout.rows && is_awake(i + k, j));
                        let needed = is_awake(i, j) || above && i % TILE + reach >= TILE;
                        assert_eq!(of(i, j).count(), usize::from(needed), "{awake:?} {reach}: {i}, {j}");
                        assert!(of(i, j).all(|strip| !strip.awake || is_awake(i, j)), "{awake:?} {reach}: {i}, {j}");
                        assert_eq!(region.is_awake(i, j), is_awake(i, j));
                    }
                }
                // No strip reads what an earlier strip has overwritten: its own points, and those that its springs
                // reach.
                for (index, strip) in region.strips.iter().enumerate() {
                    let rows = strip.rows.start..(strip.rows.end + reach).min(layout.rows);
                    let columns = strip.columns.start.saturating_sub(reach)..strip.columns.end + reach;
                    for before in &region.strips[..index] {
                        let shared = |a: &Range<usize>, b: &Range<usize>| a.start.max(b.start)..a.end.min(b.end);
                        let mut both = shared(&rows, &before.rows)
                            .flat_map(|i| shared(&columns, &before.columns).map(move |j| (i, j)));
                        assert!(!both.any(|(i, j)| is_awake(i, j)), "{awake:?} {reach}: {before:?}, {strip:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_sheet_that_is_awake_is_one_strip() {
        let layout = Layout::new::<f32>([2 * TILE + 3, TILE + 1]);
        let region = region(&layout, &[5, 1, 0, 3, 2, 4], 1);
        assert_eq!(region.strips, [Strip { rows: 0..2 * TILE + 3, columns: 0..2 * TILE, awake: true }]);
        assert!(Region::none(&layout).tiles().is_empty());
    }

    #[test]
    fn marks_are_added_once_and_cleared_whole() {
        let mut marks = Marks::none_of(3);
        assert!([marks.add(2), marks.add(0), !marks.add(2), !marks.is_full()].iter().all(|holds| *holds));
        assert!(marks.add(1) && marks.is_full());
        marks.clear();
        assert!(marks.members.is_empty() && marks.has == [false; 3]);
    }

    #[test]
    fn a_strip_may_reach_beyond_the_columns_up_to_a_tile_and_never_beyond_the_rows() {
        let layout = Layout::new::<f32>([20, 20]);
        for (rows, columns, within) in [
            (0..20, 0..32, true),
            (16..20, 16..32, true),
            (0..21, 0..32, false),
            (0..20, 0..48, false),
            (0..32, 16..48, false),
        ] {
            let mut region = Region::none(&layout);
            region.strips.push(Strip { rows: 0..4, columns: 0..16, awake: true });
            region.strips.push(Strip { rows: rows.clone(), columns: columns.clone(), awake: true });
            assert_eq!(region.is_within(&layout), within, "{rows:?} {columns:?}");
        }
    }
}
