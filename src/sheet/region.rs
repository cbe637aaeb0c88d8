//! The part of a sheet that a sweep goes over: whole tiles, and the strips of rows and columns that cover them.
//!
//! Everything costs what is in it, not what is in the sheet.

use std::ops::Range;

use super::field::{BLOCK, Layout};

/// Points along a side of a tile.
pub(super) const TILE: usize = BLOCK;

/// Tiles along so many points.
pub(super) fn tiles(points: usize) -> usize {
    points.div_ceil(TILE)
}

/// A set of tiles: to go through it or to empty it costs what is in it, whatever the size of the sheet.
#[derive(Debug, Clone, Default)]
pub(super) struct Marks {
    pub(super) members: Vec<usize>,
    pub(super) has: Vec<bool>,
}

impl Marks {
    pub(super) fn none_of(count: usize) -> Self {
        Marks { members: Vec::new(), has: vec![false; count] }
    }

    /// Adds a tile; whether it is new.
    pub(super) fn add(&mut self, tile: usize) -> bool {
        let new = !std::mem::replace(&mut self.has[tile], true);
        if new {
            self.members.push(tile);
        }
        new
    }

    pub(super) fn clear(&mut self) {
        let Marks { members, has } = self;
        members.drain(..).for_each(|tile| has[tile] = false);
    }

    pub(super) fn is_full(&self) -> bool {
        self.members.len() == self.has.len()
    }
}

/// Part of a sheet that a sweep goes over.
#[derive(Debug, Clone, Default)]
pub(super) struct Region {
    /// In the order in which a sweep may take them: none reads what one before it has overwritten.
    pub(super) strips: Vec<Strip>,
    /// [`Region::cover`] puts the members in order, and takes those out that are no longer.
    pub(super) awake: Marks,
    /// Tiles along y.
    columns: usize,
}

/// A rectangle of points.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Strip {
    pub(super) rows: Range<usize>,
    /// Whole tiles, the last of which may reach beyond the sheet.
    pub(super) columns: Range<usize>,
    /// All of it is awake.
    pub(super) awake: bool,
}

impl Region {
    /// No tile of a sheet.
    pub(super) fn none(layout: &Layout) -> Self {
        let columns = tiles(layout.columns);
        Region { strips: Vec::new(), awake: Marks::none_of(tiles(layout.rows) * columns), columns }
    }

    /// The tiles that are awake, rising.
    pub(super) fn tiles(&self) -> &[usize] {
        &self.awake.members
    }

    /// Makes the strips those of the tiles that are awake; springs reach `reach` rows on.
    pub(super) fn cover(&mut self, layout: &Layout, reach: usize) {
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
            // The last rows above a tile begin springs that pull at it.
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

    /// Whether all of it is memory of such a sheet: strips may reach beyond its columns, but not beyond its rows.
    pub(super) fn is_within(&self, layout: &Layout) -> bool {
        let is_within =
            |strip: &Strip| strip.rows.end <= layout.rows && strip.columns.end <= tiles(layout.columns) * TILE;
        self.strips.iter().all(is_within)
    }

    /// Whether the tile of a point is awake.
    #[inline(always)]
    pub(super) fn is_awake(&self, row: usize, column: usize) -> bool {
        self.awake.has[row / TILE * self.columns + column / TILE]
    }
}

/// Adds the strips over `rows` of two rows of tiles, rising, joined where they meet. The first is awake there.
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
    // A strip that goes on below the one before it is the same strip.
    if let [.., above, below] = &mut strips[..]
        && (above.rows.end, &above.columns, above.awake) == (below.rows.start, &below.columns, below.awake)
    {
        above.rows.end = below.rows.end;
        strips.pop();
    }
}
