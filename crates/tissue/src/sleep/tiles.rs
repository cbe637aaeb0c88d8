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
//! tile also wakes when the tools' force on it may have changed by more than ε_w·K″ since (`criterion`), or the
//! pressure (`volume_change`), when one of its points is grasped (`tissue_state`), and when a
//! position-controlled tool pushes on it (`position_control`). A point that moves by more than ε_w in one
//! substep would escape that comparison if springs reach two rows, or a scheme has several sweeps: so it wakes
//! all tiles that it reaches in the sweeps of a substep, whether a tool moves it (`criterion`,
//! `position_control`) or it moves by itself. All tiles wake when the tissue changes (`change`), after a
//! recovery (`recovery`), and when the guard goes back to a checkpoint (`guard`).
//!
//! **Cost.** The cost of a step depends on the awake part, not on the size of the tissue: sets of tiles are
//! lists, memory in which nothing has ever moved is never written, a checkpoint copies what was awake since the
//! last one, a record adds the energies that sleeping tiles store, and a hash knows which tiles are 0.
//!
//! ε is a quarter of `[sleep] tolerance`, because errors of tiles add up, to 3.4 ε in a sheet that creeps in
//! one direction. Without anchor springs (K″ = 0) nothing bounds the effect of an omitted force, and only tiles
//! that do not move at all sleep.

use std::cell::Cell;
use std::ops::Range;
use std::sync::Arc;

use crate::body::surface::MeshPlaces;
use crate::kernel::field::{Field, Layout};
use crate::kernel::real::Real;
use crate::kernel::region::{Marks, Region, TILE, tiles};
use crate::memory;
use crate::model::Model;
use crate::scene::Scene;
use crate::state::saved::{SavedTile, SavedTiles, ensure, unsound};
use crate::tools::applied_force::ForceChange;
use palpate_refusal::Result;

/// Steps between two checks of which tiles may sleep.
pub(crate) const CHECK_STEPS: u64 = 16;

/// Number of consecutive checks at which a tile must be calm.
const CALM_CHECKS: u8 = 2;

/// Part of the tolerance by which a tile may be off its rest position: errors of neighbours add up. (Measured:
/// up to three and a half times the ε of a tile, where a whole sheet creeps in one direction.)
const PART: f64 = 0.25;

/// Factor by which the recent largest displacement decays from one check to the next.
const FORGET: f64 = 0.99;

/// Offsets of a tile's neighbours: along x, along y.
const NEIGHBOURS: [[isize; 2]; 8] = [[-1, -1], [-1, 0], [-1, 1], [0, -1], [0, 1], [1, -1], [1, 0], [1, 1]];

/// Indices of the neighbours in which springs begin that reach the tile.
const PULLING: [usize; 3] = [0, 1, 3];

/// Number of values in a snapshot: three for each of 16 points, for each side and corner.
const SNAPSHOT: usize = NEIGHBOURS.len() * 3 * TILE;

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

/// Returns the rows and columns of a tile.
pub(crate) fn sides_of(layout: &Layout, tile: usize) -> [Range<usize>; 2] {
    let columns = tiles(layout.columns);
    let side = |from: usize, points: usize| from..(from + TILE).min(points);
    [side(tile / columns * TILE, layout.rows), side(tile % columns * TILE, layout.columns)]
}

/// Points next to a sleeping tile of a sheet, in an awake tile.
#[derive(Debug, Clone, Copy)]
struct EdgeWatch {
    tile: usize,
    /// The side of the tile, as an index into [`NEIGHBOURS`].
    side: usize,
    /// The first point, and the distance to the next.
    first: usize,
    next: usize,
    count: usize,
}

impl EdgeWatch {
    /// Returns where the snapshots have the earlier positions of its points.
    fn then(&self) -> usize {
        self.tile * SNAPSHOT + self.side * 3 * TILE
    }
}

/// Which tiles of a tissue sleep, and the values kept for waking them.
#[derive(Debug)]
pub(crate) struct SleepTiles<T> {
    layout: Layout,
    /// Tiles along x and along y.
    counts: [usize; 2],
    /// Number of rows over which a spring reaches.
    reach: usize,
    /// Which tiles of a mesh have springs between them; `None` for a sheet.
    graph: Option<Arc<MeshPlaces>>,
    /// Number of points.
    points: usize,
    /// The sleep tolerance; at 0 nothing sleeps.
    tolerance: f64,
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
    /// The comparisons of sleeping tiles next to awake ones, on a sheet.
    watches: Vec<EdgeWatch>,
    /// The sleeping tiles that have springs to awake ones, on a mesh.
    watched: Vec<usize>,
    /// Tiles that were awake since the last checkpoint.
    touched: Marks,
    /// Tiles that were ever awake, or whose springs reach such a tile. In all others nothing has ever moved:
    /// their values are 0.
    moved: Marks,
    /// The recent largest displacement, spacings.
    pub(crate) largest: f64,
}

impl<T: Real> SleepTiles<T> {
    /// Creates the tiles of a tissue at rest: all asleep if there is a tolerance, otherwise all awake forever.
    pub(crate) fn new(layout: Layout, model: &Model) -> Self {
        let reach = if model.scene.springs.bending { 2 } else { 1 };
        let joined = (model.graph.clone(), model.len());
        SleepTiles::asleep(layout, model.tile_tolerance(), reach, joined)
    }

    fn asleep(layout: Layout, tolerance: f64, reach: usize, (graph, points): (Option<Arc<MeshPlaces>>, usize)) -> Self {
        let counts = [tiles(layout.rows), tiles(layout.columns)];
        let count = counts[0] * counts[1];
        let mut tiles = SleepTiles {
            layout,
            counts,
            reach,
            graph,
            points,
            tolerance,
            region: Region::none(&layout),
            awake_points: 0,
            settled: memory::zeroed(count, TABLES),
            drift_n: memory::zeroed(count, TABLES),
            energy_j: memory::zeroed(count, TABLES),
            asleep_j: 0.0,
            elastic_j: memory::filled(count, Cell::new(None), TABLES),
            volume_change: Vec::new(),
            snapshots: Vec::new(),
            watches: Vec::new(),
            watched: Vec::new(),
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
            watches: Vec::new(),
            watched: Vec::new(),
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
        asleep.map(|tile| match &self.graph {
            Some(graph) => {
                let (slots, first) = graph.around(*tile);
                3 * first..3 * (first + slots.len())
            }
            None => tile * SNAPSHOT..(tile + 1) * SNAPSHOT,
        })
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
        let has_moved = |tile: &usize| self.pulling(*tile).chain([*tile]).all(|other| self.moved.has[other]);
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
        for place in places {
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
        let ratio = scene.anchor_stiffness_n_per_m / scene.springs.stiffness_n_per_m / scene.body.kind().unevenness();
        // Without springs nothing passes from tile to tile.
        let unnoticed = if ratio.is_nan() { epsilon } else { epsilon * (20.0 * ratio).clamp(0.1, 1.0) };
        // A difference in the last digit is rounding noise.
        if scene.anchor_stiffness_n_per_m > 0.0 { unnoticed.max(T::EPSILON * self.largest) } else { unnoticed }
    }

    fn epsilon_of(&self, largest: f64) -> f64 {
        PART * self.tolerance * largest
    }

    /// Returns the tile of a point.
    pub(crate) fn of(&self, [i, j]: [usize; 2]) -> usize {
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

    /// Updates everything to the set of awake tiles. Costs as much as those, not as much as the tissue.
    fn settle(&mut self) {
        self.region.cover(&self.layout, self.reach);
        self.awake_points = 0;
        self.watches.clear();
        self.watched.clear();
        for index in 0..self.region.tiles().len() {
            let tile = self.region.tiles()[index];
            self.awake_points += self.rows(tile).len() * self.columns(tile).len();
            self.touched.add(tile);
            if let Some(graph) = &self.graph {
                self.watched.extend(graph.beside(tile).filter(|other| !self.region.awake.has[*other]));
                continue;
            }
            // The order of neighbours is the reverse of that of their opposites.
            for (side, opposite) in (0..NEIGHBOURS.len()).zip((0..NEIGHBOURS.len()).rev()) {
                let beside = self.neighbour(tile, opposite);
                if let Some(other) = beside.filter(|other| !self.region.awake.has[*other]) {
                    let (first, next, count) = self.beyond(other, side);
                    self.watches.push(EdgeWatch { tile: other, side, first, next, count });
                }
            }
        }
        self.watched.sort_unstable();
        self.watched.dedup();
        // The last tile of a mesh has empty places.
        self.awake_points = self.awake_points.min(self.points);
    }

    /// Returns the tiles that springs join to a tile.
    fn beside(&self, tile: usize) -> impl Iterator<Item = usize> + '_ {
        let of_mesh = self.graph.iter().flat_map(move |graph| graph.beside(tile));
        let sides = if self.graph.is_some() { 0 } else { NEIGHBOURS.len() };
        of_mesh.chain((0..sides).filter_map(move |side| self.neighbour(tile, side)))
    }

    /// Returns the tiles in which springs begin that reach a tile: on a mesh, all that are joined to it.
    fn pulling(&self, tile: usize) -> impl Iterator<Item = usize> + '_ {
        let of_mesh = self.graph.iter().flat_map(move |graph| graph.beside(tile));
        let sides = if self.graph.is_some() { &[][..] } else { &PULLING };
        of_mesh.chain(sides.iter().filter_map(move |side| self.neighbour(tile, *side)))
    }

    fn neighbour(&self, tile: usize, side: usize) -> Option<usize> {
        let [x, y] = NEIGHBOURS[side];
        let [i, j] = [(tile / self.counts[1]).checked_add_signed(x)?, (tile % self.counts[1]).checked_add_signed(y)?];
        (i < self.counts[0] && j < self.counts[1]).then_some(i * self.counts[1] + j)
    }

    /// Returns the points beyond a side or corner: the first offset, the distance to the next, and their
    /// number.
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

    /// Returns how many rows motion travels in `sweeps` sweeps; not beyond the neighbouring tiles.
    fn front(&self, sweeps: usize) -> usize {
        (self.reach * sweeps).min(TILE)
    }

    /// Returns up to `front` rows and columns beyond a side or corner.
    fn near(&self, tile: usize, side: usize, front: usize) -> [Range<usize>; 2] {
        let beyond = |own: Range<usize>, way: isize, count: usize| match way {
            -1 => own.start.saturating_sub(front)..own.start,
            0 => own,
            _ => own.end..(own.end + front).min(count),
        };
        let [x, y] = NEIGHBOURS[side];
        [beyond(self.rows(tile), x, self.layout.rows), beyond(self.columns(tile), y, self.layout.columns)]
    }

    /// Wakes the sleeping tiles among `which`.
    pub(crate) fn wake(&mut self, which: impl IntoIterator<Item = usize>) {
        let mut any = false;
        for tile in which {
            if self.region.awake.add(tile) {
                any = true;
                self.asleep_j -= self.energy_j[tile];
                self.settled[tile] = 0;
                self.beside(tile).chain([tile]).for_each(|other| self.elastic_j[other].set(None));
                let mut moved = std::mem::take(&mut self.moved);
                self.pulling(tile).chain([tile]).for_each(|other| _ = moved.add(other));
                self.moved = moved;
            }
        }
        if any {
            self.settle();
        }
    }

    /// Wakes the tiles that contain the points.
    pub(crate) fn wake_under(&mut self, points: impl IntoIterator<Item = [usize; 2]>) {
        let columns = self.counts[1];
        self.wake(points.into_iter().map(|[i, j]| i / TILE * columns + j / TILE));
    }

    /// Wakes the tile of a point and those that its springs reach in `sweeps` sweeps.
    pub(crate) fn wake_around(&mut self, point: [usize; 2], sweeps: usize) {
        if let Some(graph) = self.graph.clone() {
            let tile = self.of(point);
            return self.wake(graph.beside(tile).chain([tile]));
        }
        let Layout { rows, columns, .. } = self.layout;
        let front = self.front(sweeps);
        let [i, j] = [(point[0], rows), (point[1], columns)]
            .map(|(at, count)| [at.saturating_sub(front), (at + front).min(count - 1)]);
        self.wake_under([[i[0], j[0]], [i[0], j[1]], [i[1], j[0]], [i[1], j[1]]]);
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
    pub(crate) fn wake_beside_moved(&mut self, [u, d]: [&Field<T>; 2], sweeps: usize, far: f64) {
        if self.watches.is_empty() && self.watched.is_empty() {
            return;
        }
        self.remember();
        let far = T::of(far);
        if let Some(graph) = &self.graph {
            let moved = |tile: &&usize| {
                let (slots, first) = graph.around(**tile);
                (0..3).any(|c| {
                    let place = |slot: &u32| c * self.layout.plane + self.layout.offset(*slot as usize);
                    let then = &self.snapshots[3 * first + c * slots.len()..][..slots.len()];
                    let any = |any: bool, (slot, then): (&u32, &T)| any | ((u[place(slot)] - *then).magnitude() > far);
                    slots.iter().zip(then).fold(false, any)
                })
            };
            let waking: Vec<usize> = self.watched.iter().filter(moved).copied().collect();
            return self.wake(waking);
        }
        let front = self.front(sweeps);
        let is_near_fast = |watch: &EdgeWatch| {
            let [rows, columns] = self.near(watch.tile, watch.side, front);
            (0..3).any(|c| {
                let row = |i: usize| &d[c * self.layout.plane + i * self.layout.stride..][columns.clone()];
                rows.clone().any(|i| row(i).iter().fold(false, |any, d| any | (d.magnitude() > far)))
            })
        };
        let moved = |watch: &&EdgeWatch| {
            let (EdgeWatch { first, next, count, .. }, then) = (**watch, watch.then());
            (0..3).any(|c| {
                let (here, then) = (&u[c * self.layout.plane + first..], &self.snapshots[then + c * TILE..][..count]);
                // Compares all of them without an early exit, so that it compiles to a few vectors.
                let any = |any: bool, (now, then): (&T, &T)| any | ((*now - *then).magnitude() > far);
                if next == 1 {
                    here[..count].iter().zip(then).fold(false, any)
                } else {
                    here.iter().step_by(next).zip(then).fold(false, any)
                }
            }) || front > 1 && is_near_fast(watch)
        };
        let waking: Vec<usize> = self.watches.iter().filter(moved).map(|watch| watch.tile).collect();
        self.wake(waking);
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
            let values = self.graph.as_ref().map_or(self.settled.len() * SNAPSHOT, |graph| 3 * graph.watched_slots());
            self.snapshots = memory::zeroed(values, TABLES);
        }
    }

    /// Adds a change of the tools' force, and wakes tiles for which all changes since they fell asleep may
    /// exceed `least_n`. `change` gives the bound for a tile by its distance from the centres. Beyond the
    /// points it reaches, nothing has changed. With `least_n` = 0 it wakes all tiles: a moving point must not
    /// meet a sleeping tile.
    pub(crate) fn pushed(&mut self, change: &ForceChange, spacing_m: f64, least_n: f64) {
        let mut waking = Vec::new();
        if let Some(graph) = self.graph.clone() {
            for tile in (0..self.settled.len()).filter(|tile| !self.region.awake.has[*tile]) {
                self.drift_n[tile] += change.most_n(graph.box_of(tile)) / graph.least_pull(tile);
                if self.drift_n[tile] > least_n {
                    waking.push(tile);
                }
            }
            return self.wake(waking);
        }
        let within = |sides: [Range<usize>; 2]| sides.map(|points| points.start / TILE..tiles(points.end));
        let [old, new] = match change.reached() {
            reached if least_n > 0.0 => reached.map(within),
            _ => [self.counts.map(|count| 0..count), [0..0, 0..0]],
        };
        let is_old = |row, column| old[0].contains(&row) && old[1].contains(&column);
        for (which, [rows, columns]) in [&old, &new].into_iter().enumerate() {
            for (row, column) in rows.clone().flat_map(|row| columns.clone().map(move |column| (row, column))) {
                let tile = row * self.counts[1] + column;
                if self.region.awake.has[tile] || which == 1 && is_old(row, column) {
                    continue;
                }
                #[allow(clippy::cast_precision_loss)]
                let sides = [self.rows(tile), self.columns(tile)]
                    .map(|range| [range.start as f64 * spacing_m, (range.end - 1) as f64 * spacing_m]);
                self.drift_n[tile] += change.most_n(&sides);
                if self.drift_n[tile] > least_n {
                    waking.push(tile);
                }
            }
        }
        self.wake(waking);
    }

    /// Counts the consecutive checks at which a tile was calm. Returns whether it may sleep.
    pub(crate) fn is_settled(&mut self, tile: usize, settled: bool) -> bool {
        self.settled[tile] = if settled { self.settled[tile].saturating_add(1) } else { 0 };
        self.settled[tile] >= CALM_CHECKS
    }

    /// Samples a few points of each awake tile. Updates the largest displacement, and returns the tiles that
    /// may be calm because all sampled increments are at most `slow`.
    pub(crate) fn quiescent_tiles(&mut self, u: &Field<T>, d: &Field<T>, slow: impl Fn(f64) -> f64) -> Vec<usize> {
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
        let largest = self.region.tiles().iter().map(|tile| most(u, *tile)).fold(self.largest * FORGET, f64::max);
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
        if !self.beside(tile).any(|other| self.region.awake.has[other]) {
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
            if let Some(graph) = &self.graph {
                let (slots, first) = graph.around(tile);
                for c in 0..3 {
                    for (slot, k) in slots.iter().zip(0..) {
                        let place = c * self.layout.plane + self.layout.offset(*slot as usize);
                        self.snapshots[3 * first + c * slots.len() + k] = u[place];
                    }
                }
                continue;
            }
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
            let columns = self.columns(*tile);
            for c in 0..3 {
                for i in self.rows(*tile) {
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
