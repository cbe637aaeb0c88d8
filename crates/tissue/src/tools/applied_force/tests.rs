//! Tests of tables that are placed again, and of the bound of a change of force.

use std::ops::Range;

use super::*;
use crate::limits::Limits;
use crate::scene::{PAPER, Scene};

/// A table placed again elsewhere, with another reach, equals a fresh one.
#[test]
fn a_table_keeps_nothing_of_the_place_before() {
    let scene = Scene::parse("test", PAPER, &["sheet.points=[70, 90]".to_owned()], &Limits::default()).unwrap();
    let model = Model::compile(&scene, &Limits::default()).unwrap();
    let layout = Layout::new::<f32>(model.points);
    let mut term = Term::<f32>::new();
    let spacing_m = scene.sheet().unwrap().spacing_m;
    let places = [(35.2, 45.7, 4.0), (3.0, 88.9, 20.0), (69.0, 0.4, 1.0), (-40.0, 20.0, 9.0), (30.5, 60.0, 0.5)];
    for (x, y, reach) in places.into_iter().chain(places.into_iter().rev()) {
        let poke = Poke {
            point: None,
            centre_m: DVec3::new(x, y, 0.0) * spacing_m,
            force_n: DVec3::ZERO,
            falloff_per_m: 10.0 / (reach * spacing_m),
            falloff_offset: 0.0,
        };
        let mut fresh = Term::<f32>::new();
        fresh.place(&poke, &model, &layout, None);
        term.place(&poke, &model, &layout, None);
        assert_eq!((&term.rows, &term.spans), (&fresh.rows, &fresh.spans));
        assert_eq!(*term.factors, *fresh.factors);
        let outside = |(row, span): (&[f32], &Range<usize>)| {
            (0..layout.stride).filter(|at| !span.contains(at)).all(|at| row[at] == 0.0)
        };
        assert!(term.factors.chunks_exact(layout.stride).zip(&term.spans).all(outside));
    }
}

#[test]
fn a_change_of_force_on_a_rectangle_is_at_most_its_bound() {
    let mut random = fastrand::Rng::with_seed(20_261_122);
    let mut between = |low: f64, high: f64| low + (high - low) * random.f64();
    let spacing_m = 0.05;
    for case in 0..400 {
        let mut poke = || Poke {
            point: None,
            centre_m: DVec3::new(between(0.0, 1.0), between(0.0, 1.0), 0.0),
            force_n: DVec3::new(between(-1.0, 1.0), between(-1.0, 1.0), between(-1.0, 1.0)),
            falloff_per_m: between(0.0, 20.0),
            falloff_offset: between(-1.0, 1.0),
        };
        let (old, other) = (poke(), poke());
        let new = match case % 4 {
            0 => other,
            // Only the vector, only the place, or a little of both.
            1 => Poke { force_n: other.force_n, ..old },
            2 => Poke { centre_m: other.centre_m, ..old },
            _ => Poke { force_n: 1.01 * old.force_n, centre_m: old.centre_m + 0.01 * other.centre_m, ..old },
        };
        let change = ForceChange { old: Some(old), new: Some(new), reached: Default::default() };
        let force_n = |poke: &Poke, [i, j]: [usize; 2]| {
            let (x, y) = (i as f64 * spacing_m - poke.centre_m.x, j as f64 * spacing_m - poke.centre_m.y);
            poke.force_n * factor(poke, x.hypot(y), f64::NEG_INFINITY)
        };
        let change_n = |point| force_n(&new, point).distance(force_n(&old, point));
        let most_n = |rows: Range<usize>, columns: Range<usize>| {
            let changes = rows.flat_map(|i| columns.clone().map(move |j| [i, j])).map(change_n);
            changes.fold(0.0, f64::max)
        };
        let bound_n = change.most_n(&[[0.2, 0.45], [0.4, 0.65]]);
        assert!(most_n(4..10, 8..14) <= bound_n * (1.0 + 1e-12), "{old:?} {new:?}: {bound_n}");
        // Of a rectangle that is one point the bound is the change itself, if only the vector changes.
        if case % 4 == 1 {
            let bound_n = change.most_n(&[[0.2, 0.2], [0.4, 0.4]]);
            assert!((bound_n - change_n([4, 8])).abs() <= 1e-12, "{old:?} {new:?}: {bound_n}");
        }
        // A force that begins or ends changes by itself.
        for change in [ForceChange { old: None, ..change }, ForceChange { new: None, old: Some(new), ..change }] {
            let bound_n = change.most_n(&[[0.2, 0.2], [0.4, 0.4]]);
            assert!((bound_n - force_n(&new, [4, 8]).length()).abs() <= 1e-12, "{new:?}: {bound_n}");
        }
    }
}

#[test]
fn the_peak_of_a_new_force_is_the_most_that_it_can_be_on_any_point() {
    let centre_m = DVec3::new(0.1, 0.2, 0.0);
    let force_n = DVec3::new(0.3, 0.0, -0.4);
    let poke = Poke { point: None, centre_m, force_n, falloff_per_m: 50.0, falloff_offset: 0.7 };
    let change = ForceChange { old: None, new: Some(poke), reached: [[[0, 1]; 2]; 2] };
    // On a rectangle with its centre, and on one beside it.
    assert!((change.peak_n() - change.most_n(&[[0.0, 0.15], [0.1, 0.3]])).abs() < 1e-12);
    assert!((change.peak_n() - 0.5 * 0.7_f64.exp()).abs() < 1e-12, "{} N", change.peak_n());
    assert!(change.most_n(&[[0.11, 0.15], [0.1, 0.3]]) < 0.7 * change.peak_n());
    assert_eq!(ForceChange { old: Some(poke), new: None, ..change }.peak_n(), 0.0);
}
