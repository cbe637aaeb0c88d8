//! Tests on a sheet of three by three tiles, the last of which are not whole.
#![allow(clippy::unwrap_used)]

use glam::DVec3;

use super::*;
use crate::body::model::Model;
use crate::body::sheet::tiles::SheetTiles;
use crate::scene::profile::Poke;
use crate::tools::applied_force::{Applied, Push};

const POINTS: [usize; 2] = [40, 37];
const MIDDLE: usize = 4;

fn layout() -> Layout {
    Layout::new::<f64>(POINTS)
}

fn asleep<T: Real>(tolerance: f64) -> SleepTiles<T> {
    let graph = TileGraph::Sheet(SheetTiles::new(layout(), 1));
    SleepTiles::asleep(layout(), tolerance, 1, graph, [POINTS[0], POINTS[0] * POINTS[1]])
}

/// All asleep.
fn tiles() -> SleepTiles<f64> {
    asleep(1e-3)
}

fn offset(c: usize, [i, j]: [usize; 2]) -> usize {
    let Layout { stride, plane, .. } = layout();
    c * plane + i * stride + j
}

fn points() -> impl Iterator<Item = [usize; 2]> {
    (0..POINTS[0]).flat_map(|i| (0..POINTS[1]).map(move |j| [i, j]))
}

#[test]
fn each_point_is_in_one_tile_and_wakes_that_alone() {
    let all = tiles();
    let sizes: Vec<usize> =
        (0..9).map(|tile| sides_of(&layout(), tile).iter().map(ExactSizeIterator::len).product()).collect();
    assert_eq!(sizes.iter().sum::<usize>(), POINTS[0] * POINTS[1]);
    for [i, j] in points() {
        let tile = all.of([i, j]);
        let [rows, columns] = sides_of(&layout(), tile);
        assert!(rows.contains(&i) && columns.contains(&j), "{i} {j}");
    }
    for [i, j] in points().step_by(61) {
        let (mut tiles, tile) = (tiles(), all.of([i, j]));
        tiles.wake_under([[i, j]]);
        assert_eq!((tiles.region.tiles(), tiles.awake_points), (&[tile][..], sizes[tile]), "{i} {j}");
    }
}

#[test]
fn a_tile_wakes_when_a_point_beside_it_is_too_far_from_where_it_was_as_it_fell_asleep() {
    let mut u = Field::zero(&layout());
    for (number, point) in points().enumerate() {
        (0..3).for_each(|c| u[offset(c, point)] = (number + 7 * c) as f64);
    }
    let mut tiles = tiles();
    tiles.wake_all();
    tiles.sleep(&[(MIDDLE, 0.0)], &u, 0.0);
    assert_eq!(tiles.region.tiles(), [0, 1, 2, 3, 5, 6, 7, 8]);
    tiles.wake_beside_moved([&u, &u], 1, 0.01);
    assert!(!tiles.region.awake.has[MIDDLE], "nothing has moved");
    // The middle tile has rows 16 to 31 and columns 16 to 31.
    let is_beside = |at: usize| at == 15 || at == 32;
    for point in points().filter(|point| point.iter().all(|at| (14..=33).contains(at))) {
        let is_outside = point.iter().any(|at| !(16..=31).contains(at));
        let wakes = is_outside && point.iter().all(|at| is_beside(*at) || (16..=31).contains(at));
        for c in 0..3 {
            let at = offset(c, point);
            for (far, expected) in [(0.009, false), (0.011, wakes)] {
                u[at] += far;
                tiles.wake_beside_moved([&u, &u], 1, 0.01);
                assert_eq!(tiles.region.awake.has[MIDDLE], expected, "{point:?} {c} {far}");
                u[at] -= far;
                tiles.sleep(&[(MIDDLE, 0.0)], &u, 0.0);
            }
        }
    }
}

#[test]
fn a_movement_at_an_end_or_in_the_middle_of_a_tile_is_seen() {
    let (zero, mut moved) = (Field::zero(&layout()), Field::zero(&layout()));
    let all: Vec<usize> = (0..9).collect();
    for tile in 0..9 {
        let sides = sides_of(&layout(), tile);
        let [rows, columns] = sides.map(|side| [side.start, side.start + side.len() / 2, side.end - 1]);
        for (n, point) in rows.into_iter().flat_map(|i| columns.map(|j| [i, j])).enumerate() {
            let (mut tiles, at) = (tiles(), offset(n % 3, point));
            tiles.wake_all();
            moved[at] = -3.0;
            let settled = tiles.quiescent_tiles(&zero, &moved, 0.99, |_| 0.5);
            assert_eq!(settled, all.iter().copied().filter(|other| *other != tile).collect::<Vec<_>>(), "{point:?}");
            assert_eq!(tiles.quiescent_tiles(&moved, &zero, 0.99, |_| 0.5), all);
            assert_eq!(tiles.largest, 3.0, "{point:?}");
            moved[at] = 0.0;
        }
    }
}

#[test]
fn the_recent_largest_displacement_is_forgotten_little_by_little() {
    let (zero, mut tiles) = (Field::zero(&layout()), tiles());
    tiles.wake_all();
    tiles.largest = 2.0;
    for look in 1..400 {
        tiles.quiescent_tiles(&zero, &zero, 0.99, |_| 0.5);
        assert!((tiles.largest - 2.0 * 0.99_f64.powi(look)).abs() < 1e-9, "{look}: {}", tiles.largest);
    }
    // A hundredth of it after some seconds.
    assert!(tiles.largest < 0.04);
}

#[test]
fn tiles_wake_when_the_changes_of_force_since_they_fell_asleep_exceed_the_bound_together() {
    let model = Model::paper(&[
        &format!("sheet.points={POINTS:?}"),
        "stepping.integrator=central",
        "stepping.substeps=1",
        "stepping.precision=f64",
    ]);
    let (mut applied, mut tiles) = (Applied::<f64>::new(), tiles());
    // The same force on each point: so its change is the bound of its change, to the last digit.
    for (z_n, awake) in [(1.0, 0), (1.25, 0), (1.5, 9)] {
        let (centre_m, force_n) = (DVec3::new(0.4, 0.3, 0.0), DVec3::new(0.0, 0.0, z_n));
        applied.set(
            0,
            Some(Push::Constant(Poke { point: None, centre_m, force_n, falloff_per_m: 0.0, falloff_offset: 0.0 })),
        );
        for change in applied.changes(&model, 0).collect::<Vec<_>>() {
            tiles.pushed(&change, model.scene.sheet().unwrap().spacing_m, 1.25);
        }
        assert_eq!(tiles.region.tiles().len(), awake, "{z_n} N");
    }
}

#[test]
fn a_tile_drifts_by_the_force_on_its_nearest_point() {
    let model = Model::paper(&[
        &format!("sheet.points={POINTS:?}"),
        "stepping.integrator=central",
        "stepping.substeps=1",
        "stepping.precision=f64",
    ]);
    let spacing_m = model.scene.sheet().unwrap().spacing_m;
    let (mut applied, mut tiles) = (Applied::<f64>::new(), tiles());
    // Beyond the last tile of each axis.
    let place = |i: f64, j: f64| spacing_m * DVec3::new(i, j, 0.0);
    let (centre_m, falloff_per_m) = (place(39.0, 36.0), 0.3 / spacing_m);
    let poke = Poke { point: None, centre_m, force_n: -DVec3::Z, falloff_per_m, falloff_offset: 0.0 };
    applied.set(0, Some(Push::Constant(poke)));
    for change in applied.changes(&model, 0).collect::<Vec<_>>() {
        tiles.pushed(&change, spacing_m, 1e3);
    }
    for tile in [4, 5, 7, 8] {
        let [rows, columns] = sides_of(&layout(), tile);
        let points = rows.flat_map(|i| columns.clone().map(move |j| place(i as f64, j as f64)));
        let nearest_m = points.map(|point_m| point_m.distance(centre_m)).min_by(f64::total_cmp).unwrap();
        let expected_n = (-falloff_per_m * nearest_m).exp();
        assert!((tiles.drift_n[tile] - expected_n).abs() < 1e-9, "{tile}: {} N {expected_n}", tiles.drift_n[tile]);
    }
}

#[test]
fn without_anchor_springs_even_a_difference_in_the_last_digit_is_noticed() {
    let model = |stiffness: f64| Model::paper(&[&format!("anchor_springs.stiffness_n_per_m={stiffness:?}")]);
    let mut tiles = asleep::<f32>(1e-12);
    tiles.largest = 2.0;
    let last_digit = 2.0 * <f32 as Real>::EPSILON;
    assert_eq!(tiles.wake_threshold(&model(5.0).scene), last_digit);
    let unnoticed = tiles.wake_threshold(&model(0.0).scene);
    assert!(unnoticed > 0.0 && unnoticed < 1e-3 * last_digit, "{unnoticed}");
}
