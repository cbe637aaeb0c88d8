//! Frames of changes: the tiles that each viewer needs. A sheet is divided into tiles of 16 × 16 points. A tile is
//! rewritten when its last written state no longer shows its position, and each viewer gets the tiles that are
//! newer than its own copy.
//!
//! A tile keeps the displacements from which it was last written, and is compared with those, not with the last
//! frame, because slow creep adds up. It is rewritten when a point has moved by more than half a quantum since;
//! rounding may add the other half. The box that the quanta cover only grows until the next keyframe, so earlier
//! writes are never coarser than the present ones: every vertex is within one quantum of its true place.
// The compiler does not always inline iterators over vectors. They then run without the caller's instructions.
#![allow(clippy::needless_range_loop)]

use std::sync::Arc;

use super::displacements::Snapshot;
use super::encode::{Encoding, Frame, Patch, Quanta, fill, lay_out};
use super::refine::{COMPONENTS, Points, Refinement, Rows};
use super::wide::{Available, LANES, SixteenLanes, WideWork, Width};

/// Number of points along a side of a tile.
const SIDE: usize = 16;

/// Simulated time between keyframes, if anything changes, s. A keyframe writes all tiles in a box that fits.
const KEYFRAME_S: f64 = 5.0;

/// Finest quantum, as a fraction of the distance between points: smaller movements are invisible, so an almost
/// resting sheet is still.
const FINEST: f64 = 1e-6;

/// Surface of a tissue as viewers of one refinement and encoding see it, divided into tiles of 16 × 16 points. Its
/// version counts the updates; each tile has the version at which it was last written.
#[derive(Debug)]
pub struct FrameTiles {
    refinement: Refinement,
    encoding: Encoding,
    finest_m: f64,
    /// Number of updates. A tile has the version of the update at which it was last written.
    version: u64,
    /// The snapshot from which the keyframe was written.
    key: Arc<Snapshot>,
    /// Whether anything has been written since the keyframe.
    changed: bool,
    /// The newest snapshot. All tiles show it within a quantum.
    now: Arc<Snapshot>,
    /// The update since which the topology and what is burnt have their versions.
    versions_since: u64,
    box_m: [[f32; 2]; COMPONENTS],
    quanta: Quanta,
    tiles: Vec<Tile>,
    /// For each tile, the version of the patches that were last written for a viewer, and those patches.
    written: Vec<(u64, Vec<Patch>)>,
}

#[derive(Debug)]
struct Tile {
    area: Area,
    version: u64,
    /// The displacements from which it was last written, if that was after the keyframe: x, y and z of
    /// `area.points`.
    own: Option<[Vec<f32>; COMPONENTS]>,
}

/// Position of a tile.
#[derive(Debug, Clone, Copy)]
struct Area {
    /// Its vertices.
    first: [usize; 2],
    vertices: [usize; 2],
    /// The points around those vertices.
    first_point: [usize; 2],
    points: [usize; 2],
}

impl Area {
    fn of(grid: Refinement, tile: [usize; 2]) -> Self {
        let cells = grid.between + 1;
        let [mut first, mut vertices, mut points] = [[0; 2]; 3];
        for axis in 0..2 {
            first[axis] = tile[axis] * SIDE * cells;
            // The last tile also has the vertices of the edge.
            let is_last = tile[axis] + 1 == tiles_along(grid.points[axis]);
            let end = if is_last { grid.vertices()[axis] } else { first[axis] + SIDE * cells };
            vertices[axis] = end - first[axis];
            points[axis] = (end - 1).div_ceil(cells) + 1 - tile[axis] * SIDE;
        }
        Area { first, vertices, first_point: tile.map(|tile| tile * SIDE), points }
    }

    /// Returns the tile's points within those of a whole sheet.
    fn of_grid<'v>(&self, snapshot: &'v Snapshot, grid: Refinement) -> Points<'v> {
        let Points { values, stride, .. } = snapshot.points(grid);
        let from = self.first_point[0] * stride + self.first_point[1];
        Points { values: values.map(|values| &values[from..]), stride, count: self.points }
    }
}

fn tiles_along(points: usize) -> usize {
    (points - 1).div_ceil(SIDE).max(1)
}

impl Tile {
    /// Returns the displacements from which it was last written.
    fn shown<'v>(&'v self, key: &'v Snapshot, grid: Refinement) -> Points<'v> {
        match &self.own {
            None => self.area.of_grid(key, grid),
            Some(own) => {
                let [_, stride] = self.area.points;
                Points { values: own.each_ref().map(Vec::as_slice), stride, count: self.area.points }
            }
        }
    }

    /// Stores `points` as the displacements from which it is written.
    fn take(&mut self, points: Points<'_>, version: u64) {
        let mut own = self.own.take().unwrap_or_default();
        for (c, own) in own.iter_mut().enumerate() {
            own.clear();
            (0..points.count[0]).for_each(|i| own.extend_from_slice(points.row(c, i)));
        }
        self.own = Some(own);
        self.version = version;
    }
}

impl FrameTiles {
    /// Creates the tiles of `snapshot`, with a keyframe of it, in which all tiles are new, as version 1. `refinement`
    /// must be one of the same tissue.
    pub fn new(snapshot: &Arc<Snapshot>, refinement: Refinement, encoding: Encoding) -> Self {
        let [along_x, along_y] = refinement.points.map(tiles_along);
        let place = |number: usize| Area::of(refinement, [number / along_y, number % along_y]);
        let tile = |number| Tile { area: place(number), version: 0, own: None };
        let mut tiles = FrameTiles {
            refinement,
            encoding,
            finest_m: FINEST * snapshot.spacing_m,
            version: 0,
            key: snapshot.clone(),
            changed: false,
            now: snapshot.clone(),
            versions_since: 0,
            box_m: *snapshot.box_m(refinement),
            quanta: Quanta::default(),
            tiles: (0..along_x * along_y).map(tile).collect(),
            written: vec![(0, Vec::new()); along_x * along_y],
        };
        tiles.write_all(snapshot);
        tiles
    }

    /// Returns the refinement of the tiles.
    pub fn refinement(&self) -> Refinement {
        self.refinement
    }

    /// Returns the encoding of the tiles.
    pub fn encoding(&self) -> Encoding {
        self.encoding
    }

    /// Returns the number of updates, from 1. A viewer with the frame of this version is up to date.
    pub fn version(&self) -> u64 {
        self.version
    }

    /// Advances to `snapshot`, the next version: rewrites the tiles that have moved visibly since they were last
    /// written (by more than half a quantum; any movement for floats) or, 5 s of simulated time after a keyframe
    /// since which anything changed, all of them. The snapshot that was given last changes nothing.
    pub fn update(&mut self, snapshot: &Arc<Snapshot>) {
        if Arc::ptr_eq(snapshot, &self.now) {
            return;
        }
        // Buffers of tiles that keep changing are reused; others are freed.
        for (version, patches) in &mut self.written {
            if *version != self.version {
                patches.clear();
            }
        }
        let since_key_s = snapshot.simulation_time_s - self.key.simulation_time_s;
        if self.changed && since_key_s >= KEYFRAME_S {
            return self.write_all(snapshot);
        }
        self.version += 1;
        self.take_moment(snapshot);
        for (whole, now) in self.box_m.iter_mut().zip(snapshot.box_m(self.refinement)) {
            *whole = [whole[0].min(now[0]), whole[1].max(now[1])];
        }
        self.fit();
        let unseen_m = self.quanta.unseen_m(self.encoding);
        let width = Width::widest();
        for tile in &mut self.tiles {
            let (now, shown) = (tile.area.of_grid(snapshot, self.refinement), tile.shown(&self.key, self.refinement));
            let mut moved = false;
            width.run(Compare { now, shown, unseen_m, moved: &mut moved });
            if moved {
                tile.take(now, self.version);
                self.changed = true;
            }
        }
    }

    /// Writes a keyframe.
    fn write_all(&mut self, snapshot: &Arc<Snapshot>) {
        self.version += 1;
        self.key = snapshot.clone();
        self.take_moment(snapshot);
        self.changed = false;
        self.box_m = *snapshot.box_m(self.refinement);
        self.fit();
        for tile in &mut self.tiles {
            tile.version = self.version;
            tile.own = None;
        }
    }

    /// Makes `snapshot` the newest one.
    fn take_moment(&mut self, snapshot: &Arc<Snapshot>) {
        let versions = |of: &Snapshot| [of.topology_version, of.burn_version];
        if versions(snapshot) != versions(&self.now) {
            self.versions_since = self.version;
        }
        self.now = snapshot.clone();
    }

    fn fit(&mut self) {
        self.quanta = Quanta::over(self.encoding, &self.box_m, self.finest_m);
    }

    /// Returns whether any tile was written after version `version`, or the topology or what is burnt has changed since. `None` stands for a viewer
    /// without a frame: then it is true.
    pub fn is_newer_than(&self, version: Option<u64>) -> bool {
        let used = self.now.used_rows(self.refinement);
        let is_newer = |tile: &Tile| Some(tile.version) > version && tile.area.first_point[0] < used;
        Some(self.versions_since) > version || self.tiles.iter().any(is_newer)
    }

    /// Returns a frame of the newest snapshot with the tiles that were written after version `version`; all of them
    /// for `None`. It may have no patches. Each tile is encoded once for all viewers.
    pub fn newer_than(&mut self, version: Option<u64>) -> Frame {
        let FrameTiles { refinement, encoding, version: now_at, quanta, key, now, tiles, written, .. } = self;
        let (width, most) = (Width::widest(), SIDE * (refinement.between + 1) + 1);
        let mut rows = Rows::new(refinement.between, most, quanta.source(key.points(*refinement)));
        let used = now.used_rows(*refinement);
        let sent = || tiles.iter().zip(0..).filter(|(tile, _)| tile.area.first_point[0] < used);
        let newer = || sent().filter(|(tile, _)| Some(tile.version) > version);
        for (tile, number) in newer() {
            let (written_at, patches): &mut (u64, Vec<Patch>) = &mut written[number];
            if *written_at != *now_at || patches.is_empty() {
                *written_at = *now_at;
                if patches.is_empty() {
                    *patches = lay_out(tile.area.first, tile.area.vertices, *encoding);
                }
                rows.turn_to(quanta.source(tile.shown(key, *refinement)));
                fill(width, *encoding, patches, &mut rows);
            }
        }
        Frame {
            step: now.step,
            simulation_time_s: now.simulation_time_s,
            topology_version: now.topology_version,
            burn_version: now.burn_version,
            refinement: *refinement,
            encoding: *encoding,
            quanta: *quanta,
            full: newer().count() == sent().count(),
            patches: newer().flat_map(|(_, number)| written[number].1.iter().cloned()).collect(),
        }
    }
}

/// Comparison of whether any point has moved by more than is invisible.
struct Compare<'v> {
    now: Points<'v>,
    shown: Points<'v>,
    unseen_m: [f32; COMPONENTS],
    moved: &'v mut bool,
}

impl WideWork for Compare<'_> {
    #[inline(always)]
    fn work<L: SixteenLanes>(self, with: Available<L>) {
        let Compare { now, shown, unseen_m, moved } = self;
        for c in 0..COMPONENTS {
            let (mut low, mut high) = (with.splat(0.0), with.splat(0.0));
            for i in 0..now.count[0] {
                let (now, shown) = (now.row(c, i), shown.row(c, i));
                let (now_blocks, shown_blocks) = (now.as_chunks().0, shown.as_chunks().0);
                for block in 0..now_blocks.len() {
                    let by = with.load(&now_blocks[block]).sub(with.load(&shown_blocks[block]));
                    low = by.smaller(low);
                    high = by.larger(high);
                }
                let (now, shown) = (&now[now_blocks.len() * LANES..], &shown[now_blocks.len() * LANES..]);
                for j in 0..now.len() {
                    *moved |= (now[j] - shown[j]).abs() > unseen_m[c];
                }
            }
            let mut ends = [[0.0; LANES]; 2];
            low.store(&mut ends[0]);
            high.store(&mut ends[1]);
            for lane in 0..LANES {
                *moved |= -ends[0][lane] > unseen_m[c] || ends[1][lane] > unseen_m[c];
            }
            if *moved {
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::encode;
    use super::super::encode::tests::decoded;
    use super::*;
    use crate::surface::scene;
    use palpate_tissue::limits::Limits;

    fn grid(points: [usize; 2], n: u32) -> Refinement {
        Refinement::new(&scene(points), n, &Limits::default()).unwrap()
    }

    /// State of a viewer: it keeps vertices and writes patches over them.
    #[derive(Clone)]
    struct Picture {
        vertices: Vec<Option<[f64; 3]>>,
        has: Option<u64>,
    }

    impl Picture {
        fn new() -> Self {
            Picture { vertices: Vec::new(), has: None }
        }

        /// Applies a frame. Returns the number of vertices written.
        fn show(&mut self, frame: &Frame) -> usize {
            let [x, y] = frame.refinement.vertices();
            self.vertices.resize(x * y, None);
            let mut count = 0;
            for patch in &frame.patches {
                for (index, shown) in decoded(frame, patch).into_iter().enumerate() {
                    let (a, b) = (index / patch.count[1], index % patch.count[1]);
                    let vertex = (patch.first[0] + a) * y + patch.first[1] + b;
                    self.vertices[vertex] = Some(shown);
                    count += 1;
                }
            }
            assert_eq!(frame.full, count == x * y);
            count
        }

        /// Checks that every vertex is within `quanta` quanta of its true place, floats exactly, and that quanta
        /// are no larger than needed.
        fn check(&self, tiles: &FrameTiles, truth: &Snapshot, quanta: f64) {
            let mut exact = Picture::new();
            exact.show(&encode(truth, tiles.refinement, Encoding::F32));
            assert_eq!(exact.vertices.len(), self.vertices.len());
            let bounds_m: [f64; 3] = std::array::from_fn(|c| {
                let Some(largest) = tiles.encoding.largest_integer() else { return 0.0 };
                let ([low, high], quantum_m) = (tiles.box_m[c].map(f64::from), tiles.quanta.scale_m[c]);
                let finest_m = tiles.finest_m.max(0.5 * (high - low) / largest);
                assert!(quantum_m <= 1.01 * finest_m, "{quantum_m} where {finest_m} would do");
                quanta * quantum_m
            });
            for (shown, exact) in self.vertices.iter().zip(&exact.vertices) {
                let (shown, exact) = (shown.unwrap(), exact.unwrap());
                for c in 0..3 {
                    assert!((shown[c] - exact[c]).abs() <= bounds_m[c], "{} and {}", shown[c], exact[c]);
                }
            }
        }
    }

    fn at(points: [usize; 2], step: u64, time_s: f64, displacement_m: &[Vec<f32>; 3]) -> Arc<Snapshot> {
        Arc::new(Snapshot::new(&scene(points), step, time_s, displacement_m.clone()))
    }

    #[test]
    fn tiles_cover_every_vertex_once() {
        for points in [[1, 1], [1, 40], [2, 16], [16, 17], [17, 18], [33, 32], [50, 49]] {
            for n in [0, 1, 2, 10] {
                let still = at(points, 0, 0.0, &std::array::from_fn(|_| vec![0.25; points[0] * points[1]]));
                for encoding in Encoding::ALL {
                    let mut tiles = FrameTiles::new(&still, grid(points, n), encoding);
                    let mut picture = Picture::new();
                    let count = picture.show(&tiles.newer_than(None));
                    assert_eq!(count, picture.vertices.len());
                    picture.check(&tiles, &still, 0.51);
                }
            }
        }
    }

    #[test]
    fn only_tiles_that_show_a_point_that_moved_are_written() {
        let points = [48, 48];
        let mut displacement_m: [Vec<f32>; 3] = std::array::from_fn(|_| vec![0.0; 48 * 48]);
        displacement_m[2][0] = -0.01;
        for (n, point, count) in [
            (0, [20, 20], 1),
            (0, [16, 20], 1),
            (3, [20, 20], 1),
            // On the first row of a tile: there are vertices between its points and the last ones of the previous
            // tile.
            (3, [16, 20], 2),
            (3, [16, 32], 4),
        ] {
            let mut tiles = FrameTiles::new(&at(points, 0, 0.0, &displacement_m), grid(points, n), Encoding::I16);
            let first = tiles.version();
            let mut moved = displacement_m.clone();
            moved[2][point[0] * 48 + point[1]] = -0.005;
            let snapshot = at(points, 1, 0.01, &moved);
            tiles.update(&snapshot);
            let newer = tiles.tiles.iter().filter(|tile| tile.version > first).count();
            assert_eq!(newer, count, "n = {n}, {point:?}");
            assert!(!tiles.newer_than(Some(first)).full);
        }
    }

    #[test]
    fn what_stands_is_not_written_again_and_creep_adds_up() {
        let points = [20, 20];
        let mut displacement_m: [Vec<f32>; 3] = std::array::from_fn(|_| vec![0.0; 400]);
        displacement_m[0][0] = 0.01;
        let mut tiles = FrameTiles::new(&at(points, 0, 0.0, &displacement_m), grid(points, 2), Encoding::I16);
        let mut picture = Picture::new();
        picture.show(&tiles.newer_than(None));
        let quantum_m = tiles.quanta.scale_m.x as f32;
        let mut written = 0;
        for step in 1..200 {
            let version = tiles.version();
            // Every second time nothing moves.
            displacement_m[0][210] += if step % 2 == 0 { 0.04 * quantum_m } else { 0.0 };
            let snapshot = at(points, step, step as f64 * 0.01, &displacement_m);
            tiles.update(&snapshot);
            assert!(step % 2 == 0 || !tiles.is_newer_than(Some(version)));
            written += u32::from(tiles.is_newer_than(Some(version)));
            picture.show(&tiles.newer_than(Some(version)));
            picture.check(&tiles, &snapshot, 1.02);
        }
        // Four quanta in all, half a quantum each time.
        assert!((6..=8).contains(&written), "{written}");
    }

    #[test]
    fn a_keyframe_comes_after_a_while_and_only_if_something_changed() {
        let points = [40, 40];
        let mut displacement_m: [Vec<f32>; 3] = std::array::from_fn(|_| vec![0.0; 1600]);
        displacement_m[2][820] = -0.01;
        let mut tiles = FrameTiles::new(&at(points, 0, 0.0, &displacement_m), grid(points, 0), Encoding::I16);
        let coarse = tiles.quanta.scale_m.z;
        let mut full_at = Vec::new();
        for step in 1..200 {
            let version = tiles.version();
            displacement_m[2][820] = if step < 10 { -0.01 + 0.001 * step as f32 } else { 0.0 };
            tiles.update(&at(points, step, step as f64 * 0.1, &displacement_m));
            if tiles.is_newer_than(Some(version)) && tiles.newer_than(Some(version)).full {
                full_at.push(step);
            }
        }
        assert_eq!(full_at, [50]);
        assert!(tiles.quanta.scale_m.z < 0.1 * coarse);
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 40, failure_persistence: None, ..ProptestConfig::default() })]

        /// For any movement and any selection of frames, a viewer sees the present after each frame.
        #[test]
        fn a_viewer_sees_the_present_whichever_frames_it_got(
            n in 0_u32..4,
            encoding in prop::sample::select(&Encoding::ALL[..]),
            // Few points and strides, so that some movements also go back.
            moves in prop::collection::vec((0_usize..6, 0_usize..3, -7..-1, any::<bool>(), 0_u8..8, 0.0..0.5), 1..60),
        ) {
            let points = [35, 18];
            let mut displacement_m: [Vec<f32>; 3] = std::array::from_fn(|_| vec![0.0; 35 * 18]);
            let mut tiles = FrameTiles::new(&at(points, 0, 0.0, &displacement_m), grid(points, n), encoding);
            let mut pictures = vec![Picture::new(); 3];
            let mut time_s = 0.0;
            for (step, (place, c, power, sign, who, after_s)) in moves.into_iter().enumerate() {
                time_s += after_s;
                // From far below a quantum to the whole box.
                displacement_m[c][place * 125] += 10_f32.powi(power) * if sign { 1.0 } else { -1.0 };
                let snapshot = at(points, step as u64 + 1, time_s, &displacement_m);
                tiles.update(&snapshot);
                for (number, picture) in pictures.iter_mut().enumerate() {
                    if who & (1 << number) == 0 {
                        continue;
                    }
                    if tiles.is_newer_than(picture.has) {
                        picture.show(&tiles.newer_than(picture.has));
                        picture.has = Some(tiles.version());
                    }
                    picture.check(&tiles, &snapshot, 1.02);
                }
            }
        }
    }
}
