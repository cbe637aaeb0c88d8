//! Tiles of points that are at rest sleep: what does not move is not computed.
//!
//! **To sleep.** With ε a length, a part of the scene's tolerance times the largest displacement of late, a tile may sleep
//! if of every point of it |v|·√(m/K″) ≤ ε and |F + N − K″·u|/K″ ≤ ε (F of the tools, N of the springs), and still so
//! [`CHECK_STEPS`] later: then it is within ε of where it would come to rest. It stays there, with what a scheme keeps of
//! its past made true: constant forces.
//!
//! **To wake.** A tile that sleeps remembers where the points around it were when it fell asleep, and wakes when one of
//! them is more than ε_w from there: compared with the step before, a slow creep would pass unseen. ε_w is ε, or less
//! where springs are much stiffer than the virtual ones, which then let through more of what is left out. It wakes as well
//! when the tools' force on it may have changed by more than ε_w·K″ since, and when it is grasped.

use std::ops::Range;

use super::applied::Touch;
use super::field::{BLOCK, Field, Layout};
use super::real::Real;

/// Points along a side.
pub(super) const TILE: usize = BLOCK;

/// Steps between two looks at whether tiles may sleep.
pub(super) const CHECK_STEPS: u64 = 16;

/// Looks in a row at which a tile has to be calm.
const CALM_LOOKS: u8 = 2;

/// Part of the tolerance that a tile may be from its rest: errors of neighbours add up. (Measured: up to three and a
/// half times the ε of a tile, where all of a sheet creeps one way.)
const PART: f64 = 0.25;

/// By which the largest displacement of late is forgotten from one look to the next.
const FORGET: f64 = 0.99;

/// Places of a tile's neighbours: along x, along y.
const NEIGHBOURS: [[isize; 2]; 8] = [[-1, -1], [-1, 0], [-1, 1], [0, -1], [0, 1], [1, -1], [1, 0], [1, 1]];

/// Values of a snapshot: three of each of 16 points for a side or a corner.
const SNAPSHOT: usize = NEIGHBOURS.len() * 3 * TILE;

/// Part of a sheet that a sweep goes over.
#[derive(Debug, Clone, Default)]
pub(super) struct Region {
    /// In the order in which a sweep may take them: none reads what one before it has overwritten.
    pub(super) strips: Vec<Strip>,
    awake: Vec<bool>,
    /// Tiles along y.
    columns: usize,
}

/// A rectangle of points.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Strip {
    pub(super) rows: Range<usize>,
    /// Whole tiles, the last of which may reach beyond the sheet.
    pub(super) columns: Range<usize>,
    /// All of it is awake, and nothing to the left is asleep.
    pub(super) whole: bool,
}

impl Region {
    /// All of a sheet.
    pub(super) fn whole(layout: &Layout) -> Self {
        Region::of(layout, &vec![true; tiles(layout.rows) * tiles(layout.columns)], 0)
    }

    /// The tiles that are `awake`; springs reach `reach` rows on.
    fn of(layout: &Layout, awake: &[bool], reach: usize) -> Self {
        let columns = tiles(layout.columns);
        let mut region = Region { strips: Vec::new(), awake: awake.to_vec(), columns };
        if awake.iter().all(|awake| *awake) {
            let whole = Strip { rows: 0..layout.rows, columns: 0..columns * TILE, whole: true };
            region.strips.push(whole);
            return region;
        }
        let runs = |row: usize| -> Vec<Range<usize>> {
            let mut runs: Vec<Range<usize>> = Vec::new();
            for tile in (0..columns).filter(|tile| awake.get(row * columns + tile) == Some(&true)) {
                match runs.last_mut() {
                    Some(run) if run.end == tile => run.end = tile + 1,
                    _ => runs.push(tile..tile + 1),
                }
            }
            runs
        };
        let mut own = runs(0);
        for row in 0..tiles(layout.rows) {
            let below = runs(row + 1);
            let rows = row * TILE..((row + 1) * TILE).min(layout.rows);
            // The last rows begin springs that pull at the tiles below.
            let body =
                rows.start..if below.is_empty() { rows.end } else { rows.end.saturating_sub(reach).max(rows.start) };
            region.push(body.clone(), &own);
            let mut both = own;
            both.extend(below.iter().cloned());
            both.sort_by_key(|run| run.start);
            both.dedup_by(|next, run| {
                let joined = next.start <= run.end;
                if joined {
                    run.end = run.end.max(next.end);
                }
                joined
            });
            region.push(body.end..rows.end, &both);
            own = below;
        }
        region
    }

    fn push(&mut self, rows: Range<usize>, runs: &[Range<usize>]) {
        if !rows.is_empty() {
            let strip = |run: &Range<usize>| Strip {
                rows: rows.clone(),
                columns: run.start * TILE..run.end * TILE,
                whole: false,
            };
            self.strips.extend(runs.iter().map(strip));
        }
    }

    /// Whether the tile of a point is awake.
    #[inline(always)]
    pub(super) fn is_awake(&self, row: usize, column: usize) -> bool {
        self.awake[row / TILE * self.columns + column / TILE]
    }
}

/// Tiles along so many points.
fn tiles(points: usize) -> usize {
    points.div_ceil(TILE)
}

/// Which tiles of a sheet sleep, and what they remember.
#[derive(Debug)]
pub(super) struct Tiles<T> {
    layout: Layout,
    /// Tiles along x and along y.
    counts: [usize; 2],
    /// Rows that a spring reaches on.
    reach: usize,
    /// Nothing sleeps without one.
    tolerance: f64,
    pub(super) region: Region,
    /// Numbers of the tiles that are awake, rising.
    pub(super) awake: Vec<usize>,
    pub(super) awake_points: usize,
    /// Of each tile, looks in a row at which it was calm.
    calm: Vec<u8>,
    /// By how much the tools' force on it may have changed since it fell asleep, N.
    drift_n: Vec<f64>,
    /// The energy that it had.
    energy_j: Vec<f64>,
    /// Of all that sleep.
    pub(super) asleep_j: f64,
    /// Where the points around it were; made when the first tile sleeps.
    snapshots: Vec<T>,
    /// Sides of sleeping tiles beyond which a tile is awake: tile and neighbour.
    watched: Vec<(usize, usize)>,
    /// Since the last checkpoint it was awake.
    touched: Vec<bool>,
    /// The largest displacement of late, spacings.
    pub(super) largest: f64,
}

impl<T: Real> Tiles<T> {
    /// All asleep if there is a tolerance: a sheet at rest. Else all awake, for good.
    pub(super) fn new(layout: Layout, tolerance: f64, reach: usize) -> Self {
        let counts = [tiles(layout.rows), tiles(layout.columns)];
        let count = counts[0] * counts[1];
        let mut tiles = Tiles {
            layout,
            counts,
            reach,
            tolerance,
            region: Region::default(),
            awake: Vec::new(),
            awake_points: 0,
            calm: vec![0; count],
            drift_n: vec![0.0; count],
            energy_j: vec![0.0; count],
            asleep_j: 0.0,
            snapshots: Vec::new(),
            watched: Vec::new(),
            touched: vec![false; count],
            largest: 0.0,
        };
        let all = vec![!tiles.may_sleep(); count];
        tiles.set(&all);
        tiles
    }

    pub(super) fn may_sleep(&self) -> bool {
        self.tolerance > 0.0
    }

    /// ε, spacings.
    pub(super) fn epsilon(&self) -> f64 {
        self.epsilon_of(self.largest)
    }

    fn epsilon_of(&self, largest: f64) -> f64 {
        PART * self.tolerance * largest
    }

    /// The tile of a point.
    pub(super) fn of(&self, [i, j]: [usize; 2]) -> usize {
        i / TILE * self.counts[1] + j / TILE
    }

    fn rows(&self, tile: usize) -> Range<usize> {
        let from = tile / self.counts[1] * TILE;
        from..(from + TILE).min(self.layout.rows)
    }

    fn columns(&self, tile: usize) -> Range<usize> {
        let from = tile % self.counts[1] * TILE;
        from..(from + TILE).min(self.layout.columns)
    }

    /// Makes just those tiles awake.
    fn set(&mut self, awake: &[bool]) {
        self.region = Region::of(&self.layout, awake, self.reach);
        self.awake = (0..awake.len()).filter(|tile| awake[*tile]).collect();
        self.awake_points = self.awake.iter().map(|tile| self.rows(*tile).len() * self.columns(*tile).len()).sum();
        let mut watched = Vec::new();
        for (tile, _) in awake.iter().enumerate().filter(|(_, awake)| !**awake) {
            let beyond = |side: &usize| self.neighbour(tile, *side).is_some_and(|other| awake[other]);
            watched.extend((0..NEIGHBOURS.len()).filter(beyond).map(|side| (tile, side)));
        }
        self.watched = watched;
        self.awake.iter().for_each(|tile| self.touched[*tile] = true);
    }

    fn neighbour(&self, tile: usize, side: usize) -> Option<usize> {
        let [x, y] = NEIGHBOURS[side];
        let [i, j] = [(tile / self.counts[1]).checked_add_signed(x)?, (tile % self.counts[1]).checked_add_signed(y)?];
        (i < self.counts[0] && j < self.counts[1]).then_some(i * self.counts[1] + j)
    }

    /// The points beyond a side or corner: the first place, how far it is to the next, and their number.
    fn beyond(&self, tile: usize, side: usize) -> (usize, usize, usize) {
        let Layout { stride, .. } = self.layout;
        let (rows, columns) = (self.rows(tile), self.columns(tile));
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
        (i * stride + j, if x == 0 { stride } else { 1 }, count_x.max(count_y))
    }

    /// Wakes those of `which` that sleep.
    pub(super) fn wake(&mut self, which: impl IntoIterator<Item = usize>) {
        let mut awake = std::mem::take(&mut self.region.awake);
        let mut any = false;
        for tile in which {
            if !std::mem::replace(&mut awake[tile], true) {
                any = true;
                self.asleep_j -= self.energy_j[tile];
                self.calm[tile] = 0;
            }
        }
        if any {
            self.set(&awake);
        } else {
            self.region.awake = awake;
        }
    }

    /// Wakes the tiles of points.
    pub(super) fn wake_under(&mut self, points: impl IntoIterator<Item = [usize; 2]>) {
        let columns = self.counts[1];
        self.wake(points.into_iter().map(|[i, j]| i / TILE * columns + j / TILE));
    }

    pub(super) fn wake_all(&mut self) {
        self.wake(0..self.calm.len());
        self.asleep_j = 0.0;
    }

    /// All awake, and from now on with another tolerance.
    pub(super) fn begin_anew(&mut self, tolerance: f64) {
        self.wake_all();
        self.tolerance = tolerance;
        self.calm.fill(0);
    }

    /// Wakes tiles whose neighbours have moved by more than `far`.
    pub(super) fn watch(&mut self, u: &Field<T>, far: f64) {
        if self.watched.is_empty() {
            return;
        }
        self.remember();
        let far = T::of(far);
        let moved = |&(tile, side): &(usize, usize)| {
            let (first, next, count) = self.beyond(tile, side);
            let then = &self.snapshots[tile * SNAPSHOT + side * 3 * TILE..];
            (0..3).any(|c| {
                let from = c * self.layout.plane + first;
                (0..count).any(|k| (u[from + k * next] - then[c * TILE + k]).magnitude() > far)
            })
        };
        let waking: Vec<usize> = self.watched.iter().filter(|watch| moved(watch)).map(|(tile, _)| *tile).collect();
        self.wake(waking);
    }

    /// Makes room for snapshots. Before anything slept, all was at 0.
    fn remember(&mut self) {
        if self.snapshots.is_empty() {
            self.snapshots = vec![T::default(); self.calm.len() * SNAPSHOT];
        }
    }

    /// Adds a change of the tools' force, and wakes tiles for which all changes since they fell asleep may be more than
    /// `least_n`. `touch`: how much at a tile as far from the centres as this.
    pub(super) fn pushed(&mut self, touch: &Touch, spacing_m: f64, least_n: f64) {
        let mut waking = Vec::new();
        for tile in 0..self.calm.len() {
            if self.region.awake[tile] {
                continue;
            }
            #[allow(clippy::cast_precision_loss)]
            let sides = [self.rows(tile), self.columns(tile)]
                .map(|range| [range.start as f64 * spacing_m, (range.end - 1) as f64 * spacing_m]);
            self.drift_n[tile] += touch.most_n(sides);
            if self.drift_n[tile] > least_n {
                waking.push(tile);
            }
        }
        self.wake(waking);
    }

    /// Counts looks at which a tile was calm; whether it may sleep.
    pub(super) fn is_calm(&mut self, tile: usize, calm: bool) -> bool {
        self.calm[tile] = if calm { self.calm[tile].saturating_add(1) } else { 0 };
        self.calm[tile] >= CALM_LOOKS
    }

    /// Looks at a few points of each awake tile: updates the largest displacement, and tells which tiles may be calm, all
    /// of whose increments looked at are at most `slow`.
    pub(super) fn glance(&mut self, u: &Field<T>, d: &Field<T>, slow: impl Fn(f64) -> f64) -> Vec<usize> {
        let Layout { stride, plane, .. } = self.layout;
        let most = |field: &Field<T>, tile: usize| {
            let (rows, columns) = (self.rows(tile), self.columns(tile));
            let of = |range: &Range<usize>| [range.start, range.start + range.len() / 2, range.end - 1];
            let mut most = 0.0_f64;
            for i in of(&rows) {
                for j in of(&columns) {
                    for c in 0..3 {
                        most = most.max(field[c * plane + i * stride + j].wide().abs());
                    }
                }
            }
            most
        };
        let largest = self.awake.iter().map(|tile| most(u, *tile)).fold(self.largest * FORGET, f64::max);
        let slow = slow(self.epsilon_of(largest));
        let (calm, moving): (Vec<usize>, Vec<usize>) = self.awake.iter().partition(|tile| most(d, **tile) <= slow);
        self.largest = largest;
        moving.into_iter().for_each(|tile| self.calm[tile] = 0);
        calm
    }

    /// The region of some tiles.
    pub(super) fn region_of(&self, which: impl Iterator<Item = usize>) -> Region {
        let mut awake = vec![false; self.calm.len()];
        which.for_each(|tile| awake[tile] = true);
        Region::of(&self.layout, &awake, self.reach)
    }

    /// Of one tile; `region` is one that this gave before, or a new one.
    pub(super) fn region_of_one(&self, tile: usize, region: &mut Region) {
        let Region { strips, awake, columns } = region;
        awake.resize(self.calm.len(), false);
        // At most one was awake.
        if let Some(strip) = strips.pop() {
            awake[self.of([strip.rows.end - 1, strip.columns.start])] = false;
        }
        awake[tile] = true;
        *columns = self.counts[1];
        let (rows, along) = (self.rows(tile), self.columns(tile));
        let rows = rows.start.saturating_sub(self.reach)..rows.end;
        strips.push(Strip { rows, columns: along.start..along.start + TILE, whole: false });
    }

    /// Puts tiles to sleep, with the energies that they have.
    pub(super) fn sleep(&mut self, which: &[(usize, f64)], u: &Field<T>) {
        self.remember();
        let mut awake = std::mem::take(&mut self.region.awake);
        for &(tile, energy_j) in which {
            awake[tile] = false;
            self.energy_j[tile] = energy_j;
            self.asleep_j += energy_j;
            self.drift_n[tile] = 0.0;
            for side in 0..NEIGHBOURS.len() {
                if self.neighbour(tile, side).is_none() {
                    continue;
                }
                let (first, next, count) = self.beyond(tile, side);
                let into = tile * SNAPSHOT + side * 3 * TILE;
                for c in 0..3 {
                    for k in 0..count {
                        self.snapshots[into + c * TILE + k] = u[c * self.layout.plane + first + k * next];
                    }
                }
            }
        }
        self.set(&awake);
    }

    /// The next copy is of everything.
    pub(super) fn touch_all(&mut self) {
        self.touched.fill(true);
    }

    /// Copies what was awake since the last call from `from` to `to`.
    pub(super) fn copy_touched<'a>(&mut self, fields: impl Iterator<Item = (&'a mut Field<T>, &'a Field<T>)>) {
        let all = self.touched.iter().all(|touched| *touched);
        let touched: Vec<usize> = (0..self.touched.len()).filter(|tile| self.touched[*tile]).collect();
        for (to, from) in fields {
            if all {
                to.copy_from_slice(from);
                continue;
            }
            for tile in &touched {
                for c in 0..3 {
                    for i in self.rows(*tile) {
                        let columns = self.columns(*tile);
                        let row = c * self.layout.plane + i * self.layout.stride;
                        to[row + columns.start..row + columns.end]
                            .copy_from_slice(&from[row + columns.start..row + columns.end]);
                    }
                }
            }
        }
        self.touched.fill(false);
        self.awake.iter().for_each(|tile| self.touched[*tile] = true);
    }
}
