//! Sleeping tiles: points at rest are not computed.
//!
//! **Falling asleep.** Let ε be a length, a part of the scene's tolerance times the recent largest
//! displacement. A tile may sleep if |v|·√(m/K″) ≤ ε and |F + N − K″·u|/K″ ≤ ε for each of its points (F of the
//! tools, N of the springs), and again [`CHECK_STEPS`] later. Then it is within ε of its rest position. It
//! stays where it is, and the scheme's history becomes that of constant forces.
//!
//! **Waking.** A sleeping tile remembers where the points around it were when it fell asleep, and wakes when
//! one of them is more than ε_w from there. (A comparison with the step before would miss a slow creep.) ε_w is
//! ε, or less if springs are much stiffer than the anchor springs and so pass on more of an omitted force. A
//! tile also wakes when the tools' force on it may have changed by more than ε_w·K″ since, or the pressure (both
//! `criterion`), when one of its points is grasped (`state::guarded`), and when a position-controlled tool
//! pushes on it (`position_control`). A point that moves by more than ε_w in one
//! substep would escape that comparison if springs reach two rows, or a scheme has several sweeps: so it wakes
//! all tiles that it reaches in the sweeps of a substep, whether a tool moves it (`criterion`,
//! `position_control`) or it moves by itself. All tiles wake when the tissue changes, after a recovery, and when
//! the guard goes back to a checkpoint (all `state::guarded`).
//!
//! **Cost.** The cost of a step depends on the awake part, not on the size of the tissue: sets of tiles are
//! lists, memory in which nothing has ever moved is never written, a checkpoint copies what was awake since the
//! last one, a record adds the energies that sleeping tiles store, and a hash knows which tiles are 0.
//!
//! ε is a quarter of `[sleep] tolerance`, because errors of tiles add up, to 3.4 ε in a sheet that creeps in
//! one direction. Without anchor springs (K″ = 0), or once one is severed, nothing bounds the effect of an omitted force, and
//! only tiles that do not move at all sleep.

use std::cell::Cell;
use std::ops::Range;

use crate::body::force_field::ForceChange;
use crate::body::model::Model;
use crate::body::tile_graph::{TileGraph, Watches};
use crate::kernel::field::{Field, Layout};
use crate::kernel::real::Real;
use crate::kernel::region::{Marks, Region, sides_of, tile_of, tiles};
use crate::memory;
use crate::saved::{SavedTile, SavedTiles, ensure, unsound};
use crate::scene::Scene;
use crate::scheme::Relaxation;
use palpate_refusal::Result;

/// Steps between two checks of which tiles may sleep.
pub(crate) const CHECK_STEPS: u64 = 16;

/// Number of consecutive checks at which a tile must be calm.
const CALM_CHECKS: u8 = 2;

/// Part of the tolerance by which a tile may be off its rest position: errors of neighbours add up. (Measured:
/// up to three and a half times the ε of a tile, where a whole sheet creeps in one direction.)
const PART: f64 = 0.25;

/// The name of the tables in messages.
const TABLES: &str = "the tiles of a tissue";

/// A copy of the tiles for a snapshot of a session.
#[derive(Debug)]
pub(crate) struct TakenTiles<T> {
    awake: Vec<bool>,
    /// The tiles that have moved, in the order in which their energies are added.
    pub(crate) moved: Vec<usize>,
    settled: Vec<u8>,
    drift_n: Vec<f64>,
    energy_j: Vec<f64>,
    volume_change: Vec<f64>,
    asleep_j: f64,
    largest: f64,
    /// The positions that sleeping tiles which have moved remember, in their order.
    pub(crate) remembered: Vec<T>,
}

impl<T: Real> TakenTiles<T> {
    /// Converts the tiles to plain data, without the remembered positions.
    #[allow(clippy::cast_possible_truncation)]
    pub(crate) fn plain(&self) -> SavedTiles {
        let each = (0..self.settled.len()).map(|tile| SavedTile {
            tile: tile as u32,
            awake: self.awake[tile],
            settled: self.settled[tile],
            drift_n: self.drift_n[tile],
            energy_j: self.energy_j[tile],
            volume_change: self.volume_change.get(tile).copied().unwrap_or(0.0),
        });
        let is_new = |tile: &SavedTile| {
            let numbers = [tile.drift_n, tile.energy_j, tile.volume_change];
            !tile.awake && tile.settled == 0 && numbers == [0.0; 3]
        };
        SavedTiles {
            moved: self.moved.iter().map(|tile| *tile as u32).collect(),
            each: each.filter(|tile| !is_new(tile)).collect(),
            asleep_j: self.asleep_j,
            largest: self.largest,
        }
    }
}

/// Which tiles of a tissue sleep, and the values kept for waking them.
#[derive(Debug)]
pub(crate) struct SleepTiles<T> {
    layout: Layout,
    /// Number of rows over which a spring reaches.
    reach: usize,
    graph: TileGraph,
    /// Rows that have points.
    rows: usize,
    /// Number of points.
    points: usize,
    /// The sleep tolerance; at 0 nothing sleeps.
    tolerance: f64,
    /// Whether anchor springs are severed, so that nothing bounds how far an omitted force would move a point.
    pub(crate) has_severed_anchors: bool,
    pub(crate) region: Region,
    pub(crate) awake_points: usize,
    /// For each tile, consecutive checks at which it was calm.
    settled: Vec<u8>,
    /// How much the tools' force on each tile may have changed since it fell asleep, N.
    drift_n: Vec<f64>,
    /// The energy of each tile when it fell asleep.
    energy_j: Vec<f64>,
    /// The sum over all sleeping tiles, J.
    pub(crate) asleep_j: f64,
    /// The elastic energies of each tile, cached until it, or a tile that its springs reach, wakes.
    elastic_j: Vec<Cell<Option<[f64; 2]>>>,
    /// By how much the volume had grown when each tile fell asleep. Empty before that, and without a volume.
    volume_change: Vec<f64>,
    /// Positions of the points around each tile; allocated when the first tile sleeps.
    snapshots: Vec<T>,
    watches: Watches,
    /// The movement for which all points around the watched tiles were compared, since the same tiles have been awake; `None` before that.
    compared: Option<f64>,
    /// Tiles that were awake since the last checkpoint.
    touched: Marks,
    /// Tiles that were ever awake, or whose springs reach such a tile. In all others nothing has ever moved:
    /// their values are 0.
    pub(crate) moved: Marks,
    /// The recent largest displacement, spacings.
    pub(crate) largest: f64,
}

impl<T: Real> SleepTiles<T> {
    /// Creates the tiles of a tissue at rest: all asleep if there is a tolerance, otherwise all awake forever.
    pub(crate) fn new(layout: Layout, model: &Model) -> Self {
        let graph = TileGraph::of(layout, model);
        let sizes = [model.rows_of_points(), model.len()];
        SleepTiles::asleep(layout, model.tile_tolerance(), model.spring_rows(), graph, sizes)
    }

    fn asleep(layout: Layout, tolerance: f64, reach: usize, graph: TileGraph, [rows, points]: [usize; 2]) -> Self {
        let count = tiles(layout.rows) * tiles(layout.columns);
        let mut tiles = SleepTiles {
            layout,
            reach,
            graph,
            rows,
            points,
            tolerance,
            has_severed_anchors: false,
            region: Region::none(&layout),
            awake_points: 0,
            settled: memory::zeroed(count, TABLES),
            drift_n: memory::zeroed(count, TABLES),
            energy_j: memory::zeroed(count, TABLES),
            asleep_j: 0.0,
            elastic_j: memory::filled(count, Cell::new(None), TABLES),
            volume_change: Vec::new(),
            snapshots: Vec::new(),
            watches: Watches::default(),
            compared: None,
            touched: Marks::none_of(count),
            moved: Marks::none_of(count),
            largest: 0.0,
        };
        if !tiles.may_sleep() {
            tiles.wake_all();
        }
        tiles
    }

    /// Returns the tiles of a copy for reading: what is awake and what has moved, without the data for steps.
    pub(crate) fn for_copy(&self) -> Self {
        SleepTiles {
            region: self.region.clone(),
            settled: Vec::new(),
            drift_n: Vec::new(),
            energy_j: Vec::new(),
            elastic_j: Vec::new(),
            volume_change: Vec::new(),
            snapshots: Vec::new(),
            watches: Watches::default(),
            compared: None,
            touched: Marks::default(),
            moved: self.moved.clone(),
            graph: self.graph.clone(),
            ..*self
        }
    }

    /// Returns a copy for a snapshot of a session.
    pub(crate) fn taken(&self) -> TakenTiles<T> {
        let mut remembered = Vec::new();
        for range in self.places_remembered() {
            match self.snapshots.get(range.clone()) {
                Some(values) => remembered.extend_from_slice(values),
                // Nothing has slept since anything moved.
                None => remembered.resize(remembered.len() + range.len(), T::default()),
            }
        }
        TakenTiles {
            awake: self.region.awake.has.clone(),
            moved: self.moved.members.clone(),
            settled: self.settled.clone(),
            drift_n: self.drift_n.clone(),
            energy_j: self.energy_j.clone(),
            volume_change: self.volume_change.clone(),
            asleep_j: self.asleep_j,
            largest: self.largest,
            remembered,
        }
    }

    /// Returns where sleeping tiles that have moved remember the points around them, in their order.
    fn places_remembered(&self) -> impl Iterator<Item = Range<usize>> + '_ {
        let asleep = self.moved.members.iter().filter(|tile| !self.region.awake.has[**tile]);
        asleep.map(|tile| self.graph.remembered(*tile))
    }

    /// Returns the number of tiles.
    pub(crate) fn tile_count(&self) -> usize {
        self.settled.len()
    }

    /// Restores the saved tiles; `self` must be new. The remembered positions follow
    /// ([`SleepTiles::remember_again`]).
    pub(crate) fn restore(&mut self, saved: &SavedTiles) -> Result<()> {
        let count = self.settled.len();
        let is_tile = |tile: u32| ensure((tile as usize) < count, "a tile that the tissue lacks");
        self.moved.clear();
        self.region.awake.clear();
        for tile in &saved.moved {
            is_tile(*tile)?;
            ensure(self.moved.add(*tile as usize), "a tile twice")?;
        }
        ensure(saved.each.is_sorted_by(|a, b| a.tile < b.tile), "tiles out of order")?;
        for SavedTile { tile, awake, settled, drift_n, energy_j, volume_change } in &saved.each {
            is_tile(*tile)?;
            let tile = *tile as usize;
            let is_finite = drift_n.is_finite() && energy_j.is_finite() && volume_change.is_finite();
            ensure(is_finite, "a tile whose energy is not finite")?;
            if *volume_change != 0.0 {
                self.volume_change.resize(count, 0.0);
                self.volume_change[tile] = *volume_change;
            }
            (self.settled[tile], self.drift_n[tile], self.energy_j[tile]) = (*settled, *drift_n, *energy_j);
            if *awake {
                self.region.awake.add(tile);
            }
        }
        let has_moved = |tile: &usize| self.graph.pulling(*tile).chain([*tile]).all(|other| self.moved.has[other]);
        ensure(self.region.awake.members.iter().all(has_moved), "a tile that is awake and has never moved")?;
        ensure(self.may_sleep() || self.region.awake.is_full(), "a tile that sleeps where none may")?;
        ensure(
            saved.asleep_j.is_finite() && (0.0..f64::INFINITY).contains(&saved.largest),
            "an energy that is not finite",
        )?;
        (self.asleep_j, self.largest) = (saved.asleep_j, saved.largest);
        self.settle();
        self.touch_all();
        Ok(())
    }

    /// Restores the positions that sleeping tiles remember.
    pub(crate) fn remember_again(&mut self, values: &mut impl Iterator<Item = T>) -> Result<()> {
        let places: Vec<Range<usize>> = self.places_remembered().collect();
        if places.iter().any(|place| !place.is_empty()) {
            self.remember();
        }
        // A tile that nothing watches remembers nothing, and there may be no other.
        for place in places.into_iter().filter(|place| !place.is_empty()) {
            for value in &mut self.snapshots[place] {
                *value = values.next().ok_or_else(|| unsound("too few values"))?;
                ensure(value.is_finite(), "a value that is not finite")?;
            }
        }
        Ok(())
    }

    pub(crate) fn may_sleep(&self) -> bool {
        self.tolerance > 0.0
    }

    /// Returns ε, the error that a sleeping tile may have, in spacings.
    pub(crate) fn epsilon(&self) -> f64 {
        self.epsilon_of(self.largest)
    }

    /// Returns ε_w, the movement of a neighbour that wakes a tile, in spacings.
    pub(crate) fn wake_threshold(&self, scene: &Scene) -> f64 {
        let epsilon = self.epsilon();
        let relaxation = self.relaxation(scene);
        let restoring = relaxation.restoring_n_per_m();
        let ratio = restoring / scene.springs.stiffness_n_per_m / scene.body.kind().unevenness();
        // Without springs nothing passes from tile to tile.
        let unnoticed = if ratio.is_nan() { epsilon } else { epsilon * (20.0 * ratio).clamp(0.1, 1.0) };
        // A difference in the last digit is rounding noise.
        if relaxation.is_bounded() { unnoticed.max(T::EPSILON * self.largest) } else { unnoticed }
    }

    fn epsilon_of(&self, largest: f64) -> f64 {
        let most = if self.has_severed_anchors { f64::MIN_POSITIVE } else { f64::INFINITY };
        PART * self.tolerance.min(most) * largest
    }

    /// Returns how the tissue of a scene comes back to rest, after cuts.
    pub(crate) fn relaxation(&self, scene: &Scene) -> Relaxation {
        let relaxation = Relaxation::of(scene);
        if self.has_severed_anchors { relaxation.without_anchors() } else { relaxation }
    }

    /// Returns the tile of a point.
    pub(crate) fn of(&self, point: [usize; 2]) -> usize {
        tile_of(&self.layout, point)
    }

    /// Updates everything to the set of awake tiles. Costs as much as those, not as much as the tissue.
    fn settle(&mut self) {
        self.region.cover(&self.layout, self.reach);
        self.awake_points = 0;
        for tile in self.region.tiles() {
            let [rows, columns] = sides_of(&self.layout, *tile);
            self.awake_points += self.with_points(rows).len() * columns.len();
            self.touched.add(*tile);
        }
        self.graph.watch(&self.region.awake, &mut self.watches);
        self.compared = None;
        // The last tile of a mesh has empty places.
        self.awake_points = self.awake_points.min(self.points);
    }

    /// Returns those of a tile's rows that have points; of a tile of spare places, all.
    fn with_points(&self, rows: Range<usize>) -> Range<usize> {
        if rows.start < self.rows { rows.start..rows.end.min(self.rows) } else { rows }
    }

    /// Wakes the sleeping tiles among `which`.
    pub(crate) fn wake(&mut self, which: impl IntoIterator<Item = usize>) {
        let mut any = false;
        for tile in which {
            if self.region.awake.add(tile) {
                any = true;
                self.asleep_j -= self.energy_j[tile];
                self.settled[tile] = 0;
                self.graph.beside(tile).chain([tile]).for_each(|other| self.elastic_j[other].set(None));
                let mut moved = std::mem::take(&mut self.moved);
                self.graph.pulling(tile).chain([tile]).for_each(|other| _ = moved.add(other));
                self.moved = moved;
            }
        }
        if any {
            self.settle();
        }
    }

    /// Wakes the tiles that contain the points.
    pub(crate) fn wake_under(&mut self, points: impl IntoIterator<Item = [usize; 2]>) {
        if self.region.awake.is_full() {
            return;
        }
        let layout = self.layout;
        self.wake(points.into_iter().map(|point| tile_of(&layout, point)));
    }

    /// Wakes the tile of a point and those that its springs reach in `sweeps` sweeps.
    pub(crate) fn wake_around(&mut self, point: [usize; 2], sweeps: usize) {
        let is_awake = |tile| self.region.awake.has[tile];
        if self.region.awake.is_full() || self.graph.reached(point, sweeps).all(is_awake) {
            return;
        }
        let graph = self.graph.clone();
        self.wake(graph.reached(point, sweeps));
    }

    pub(crate) fn wake_all(&mut self) {
        self.wake(0..self.settled.len());
        self.asleep_j = 0.0;
    }

    /// Wakes all tiles, and sets another tolerance.
    pub(crate) fn begin_anew(&mut self, tolerance: f64) {
        self.wake_all();
        self.tolerance = tolerance;
        self.settled.fill(0);
    }

    /// Wakes tiles whose neighbours have moved by more than `far`: points next to a tile since it fell asleep,
    /// and on a sheet also points whose motion reaches it in the `sweeps` of a substep, in the substep before.
    pub(crate) fn wake_beside_moved(&mut self, moved: [&Field<T>; 2], sweeps: usize, far: f64) {
        if self.watches.is_empty() {
            return;
        }
        self.remember();
        // What sleeps has stayed where it was.
        let awake_alone = self.compared.is_some_and(|compared| far >= compared);
        if !awake_alone {
            self.compared = Some(far);
        }
        let awake = &self.region.awake.has;
        let of = |tile: usize| !awake_alone || awake[tile];
        let waking = self.graph.woken(&self.watches, moved, (&self.snapshots, T::of(far)), sweeps, of);
        self.wake(waking);
    }

    /// Makes the next comparison of tiles with points around them one of all points: also of those that sleep.
    pub(crate) fn compare_all(&mut self) {
        self.compared = None;
    }

    /// Wakes tiles on which the pressure has changed too much since they fell asleep: `stiffness` times the
    /// change of the volume's growth, times the reach of the tile, is above `least`.
    pub(crate) fn wake_pressed(&mut self, volume_change: f64, reaches: &[f64], stiffness: f64, least: f64) {
        let pressed = |tile: &usize| {
            !self.region.awake.has[*tile]
                && stiffness * (volume_change - self.volume_change_then(*tile)).abs() * reaches[*tile] > least
        };
        let waking: Vec<usize> = (0..reaches.len()).filter(pressed).collect();
        self.wake(waking);
    }

    /// Returns by how much the volume had grown when a tile fell asleep.
    pub(crate) fn volume_change_then(&self, tile: usize) -> f64 {
        self.volume_change.get(tile).copied().unwrap_or(0.0)
    }

    /// Allocates the snapshots. Before the first sleep, all points were at 0.
    fn remember(&mut self) {
        if self.snapshots.is_empty() {
            let values = self.graph.remembered_values(self.settled.len());
            self.snapshots = memory::zeroed(values, TABLES);
        }
    }

    /// Adds a change of the tools' force, and wakes tiles for which all changes since they fell asleep may
    /// exceed `least_n`. `change` gives the bound for a tile by its distance from the centres. Beyond the
    /// points it reaches, nothing has changed. With `least_n` = 0 it wakes all tiles: a moving point must not
    /// meet a sleeping tile.
    pub(crate) fn pushed(&mut self, change: &ForceChange, spacing_m: f64, least_n: f64) {
        let mut waking = Vec::new();
        let SleepTiles { graph, region, drift_n, .. } = self;
        graph.force_changes(change, spacing_m, least_n <= 0.0, &region.awake.has, |tile, changed_n| {
            drift_n[tile] += changed_n;
            if drift_n[tile] > least_n {
                waking.push(tile);
            }
        });
        self.wake(waking);
    }

    /// Counts the consecutive checks at which a tile was calm. Returns whether it may sleep.
    pub(crate) fn is_settled(&mut self, tile: usize, settled: bool) -> bool {
        self.settled[tile] = if settled { self.settled[tile].saturating_add(1) } else { 0 };
        self.settled[tile] >= CALM_CHECKS
    }

    /// Samples a few points of each awake tile. Updates the largest displacement, and returns the tiles that
    /// may be calm because all sampled increments are at most `slow`. The recent largest displacement decays by the factor
    /// `forget`.
    pub(crate) fn quiescent_tiles(
        &mut self,
        u: &Field<T>,
        d: &Field<T>,
        forget: f64,
        slow: impl Fn(f64) -> f64,
    ) -> Vec<usize> {
        let Layout { stride, plane, .. } = self.layout;
        let most = |field: &Field<T>, tile: usize| {
            let [rows, columns] = sides_of(&self.layout, tile);
            let rows = self.with_points(rows);
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
        let largest = self.region.tiles().iter().map(|tile| most(u, *tile)).fold(self.largest * forget, f64::max);
        let slow = slow(self.epsilon_of(largest));
        let (settled, moving): (Vec<usize>, Vec<usize>) =
            self.region.tiles().iter().partition(|tile| most(d, **tile) <= slow);
        self.largest = largest;
        moving.into_iter().for_each(|tile| self.settled[tile] = 0);
        settled
    }

    /// Makes `region`, which belongs to this tissue, cover the tiles of `which`.
    pub(crate) fn cover(&self, region: &mut Region, which: impl Iterator<Item = usize>) {
        region.awake.clear();
        which.for_each(|tile| _ = region.awake.add(tile));
        region.cover(&self.layout, self.reach);
    }

    /// Returns a region of this tissue without tiles.
    pub(crate) fn no_region(&self) -> Region {
        Region::none(&self.layout)
    }

    /// Returns the sleeping tiles that are not at 0, with their energies if cached.
    pub(crate) fn sleeping(&self) -> impl Iterator<Item = (usize, Option<[f64; 2]>)> {
        let asleep = self.moved.members.iter().filter(|tile| !self.region.awake.has[**tile]);
        asleep.map(|tile| (*tile, self.elastic_j[*tile].get()))
    }

    /// Caches the energies of a sleeping tile if nothing can change them before it or a neighbour wakes. (In a
    /// multistep scheme the observed displacement depends on the springs' force, and so on all tiles around.)
    pub(crate) fn keep_energies(&self, tile: usize, elastic_j: [f64; 2]) {
        if !self.graph.beside(tile).any(|other| self.region.awake.has[other]) {
            self.elastic_j[tile].set(Some(elastic_j));
        }
    }

    /// Puts tiles to sleep, and stores their energies. `volume_change` is the growth of the volume.
    pub(crate) fn sleep(&mut self, which: &[(usize, f64)], u: &Field<T>, volume_change: f64) {
        self.remember();
        if self.volume_change.is_empty() && volume_change != 0.0 {
            self.volume_change = memory::filled(self.settled.len(), 0.0, TABLES);
        }
        for &(tile, energy_j) in which {
            if let Some(then) = self.volume_change.get_mut(tile) {
                *then = volume_change;
            }
            self.region.awake.has[tile] = false;
            self.energy_j[tile] = energy_j;
            self.asleep_j += energy_j;
            self.drift_n[tile] = 0.0;
            self.graph.remember(tile, u, &mut self.snapshots);
        }
        self.settle();
    }

    /// Makes the next copy include everything that is not 0.
    pub(crate) fn touch_all(&mut self) {
        self.moved.members.iter().for_each(|tile| _ = self.touched.add(*tile));
    }

    /// Copies from `from` to `to` the tiles that were awake since the last call.
    pub(crate) fn copy_touched<'a>(&mut self, fields: impl Iterator<Item = (&'a mut Field<T>, &'a Field<T>)>) {
        for (to, from) in fields {
            self.copy(&self.touched, to, from);
        }
        self.touched.clear();
        self.region.tiles().iter().for_each(|tile| _ = self.touched.add(*tile));
    }

    /// Copies the nonzero part to a field of zeros.
    pub(crate) fn copy_moved(&self, to: &mut Field<T>, from: &Field<T>) {
        self.copy(&self.moved, to, from);
    }

    fn copy(&self, which: &Marks, to: &mut Field<T>, from: &Field<T>) {
        if which.is_full() {
            return to.copy_from_slice(from);
        }
        for tile in &which.members {
            let [rows, columns] = sides_of(&self.layout, *tile);
            for c in 0..3 {
                for i in rows.clone() {
                    let row = c * self.layout.plane + i * self.layout.stride;
                    let place = row + columns.start..row + columns.end;
                    to[place.clone()].copy_from_slice(&from[place]);
                }
            }
        }
    }

    /// Returns whether the tile of a point may have values other than 0.
    pub(crate) fn has_moved(&self, point: [usize; 2]) -> bool {
        self.moved.has[self.of(point)]
    }
}

#[cfg(test)]
mod tests;
