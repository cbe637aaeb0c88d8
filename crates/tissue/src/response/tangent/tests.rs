//! Tests that compare linearised springs with the springs themselves, and with closed forms.
#![allow(clippy::unwrap_used)]

mod cuts;

use std::sync::Arc;

use glam::DVec2;

use super::*;
use crate::body::elements::Spring;
use crate::body::window::{REACHES, half_window_m};
use crate::limits::Limits;
use crate::scene::Scene;
use crate::scene::{FixedPoints, Sheet};

fn model(sets: &[&str]) -> Arc<Model> {
    let always = ["stepping.integrator=central", "stepping.substeps=1", "sheet.spacing_m=0.02"];
    Model::paper(&[&always[..], sets].concat())
}

/// Returns the patch of a whole sheet around a disc of some spacings near its middle, with displaced points.
fn patch<'m>(model: &'m Model, radius: f64, displacement_m: impl Fn([usize; 2]) -> DVec3) -> LinearPatch<'m> {
    let sheet = model.scene.sheet().unwrap();
    let centre_m = 0.5 * sheet.extent_m() + DVec2::new(0.13, -0.21) * sheet.spacing_m;
    let footprint = Footprint::new(model, radius * sheet.spacing_m, centre_m.extend(0.0));
    let window = Window::Grid { origin: [0, 0], size: model.points };
    let displacement_m = (0..model.len()).map(|index| displacement_m(model.point_of(index))).collect();
    LinearPatch::new(model, &Cuts::default(), &footprint, window, displacement_m)
}

/// Values between −1 and 1 that are different for each point and component.
fn scattered([i, j]: [usize; 2]) -> DVec3 {
    let (x, y) = (i as f64, j as f64);
    DVec3::new((1.7 * x + 2.9 * y).sin(), (3.1 * x - 1.3 * y).cos(), (0.7 * x * y + 1.0).sin())
}

/// A stretch of 30 % with some disorder: each spring is longer than at rest.
fn stretched(spacing_m: f64) -> impl Fn([usize; 2]) -> DVec3 {
    move |[i, j]| spacing_m * (0.3 * DVec3::new(i as f64, j as f64, 0.0) + 0.04 * scattered([i, j]))
}

/// The force of springs and anchor springs on each point, by lengths and roots.
fn forces_n(model: &Model, displacement_m: &[DVec3]) -> Vec<DVec3> {
    let (springs, spacing_m) = (&model.scene.springs, model.scene.sheet().unwrap().spacing_m);
    let (k, shear) = (springs.stiffness_n_per_m, springs.shear_stiffness_n_per_m);
    let kinds = [([1, 0], k), ([0, 1], k), ([1, 1], shear), ([1, -1], shear), ([2, 0], k), ([0, 2], k)];
    let kinds = &kinds[..if springs.bending { 6 } else { 4 }];
    let mut forces: Vec<DVec3> = displacement_m.iter().map(|u| -model.scene.anchor_stiffness_n_per_m * *u).collect();
    for a in 0..model.len() {
        let [i, j] = model.point_of(a);
        for ([di, dj], stiffness) in kinds {
            let Some(other) = i.checked_add_signed(*di).zip(j.checked_add_signed(*dj)) else { continue };
            if other.0 >= model.points[0] || other.1 >= model.points[1] {
                continue;
            }
            let b = model.index_of([other.0, other.1]);
            let rest_m = spacing_m * DVec3::new(*di as f64, *dj as f64, 0.0);
            let apart_m = rest_m + displacement_m[b] - displacement_m[a];
            let pull_n = *stiffness * (1.0 - rest_m.length() / apart_m.length()) * apart_m;
            forces[a] += pull_n;
            forces[b] -= pull_n;
        }
    }
    forces
}

const SPRINGS: [&str; 2] = ["springs.bending=true", "springs.shear_stiffness_n_per_m=4.0"];

#[test]
fn the_linearised_springs_have_the_springs_forces_and_their_derivative() {
    let model = model(&[&SPRINGS[..], &["sheet.points=[6, 7]"]].concat());
    let spacing_m = model.scene.sheet().unwrap().spacing_m;
    let patch = patch(&model, 1.0, stretched(spacing_m));
    let mut found: Vec<DVec3> =
        patch.displacement_m.iter().map(|u| -model.scene.anchor_stiffness_n_per_m * *u).collect();
    for Spring { ends: [a, b], force_n, .. } in patch.elements.springs() {
        found[*a] += *force_n;
        found[*b] -= *force_n;
    }
    let truth = forces_n(&model, &patch.displacement_m);
    assert!(found.iter().zip(&truth).all(|(found, truth)| found.distance(*truth) < 1e-12));
    // K·x is the change of the force against a small movement along x.
    let x: Vec<[DVec3; 3]> =
        (0..model.len()).map(|at| [0, 40, 80].map(|more| scattered([at + more, 2 * at + 1]))).collect();
    let mut product = vec![[DVec3::ZERO; 3]; x.len()];
    patch.times(&x, &mut product);
    for system in 0..3 {
        let [ahead, behind] = [1e-6, -1e-6].map(|part| {
            let moved = patch.displacement_m.iter().zip(&x).map(|(u, x)| *u + part * spacing_m * x[system]);
            forces_n(&model, &moved.collect::<Vec<_>>())
        });
        for (at, product) in product.iter().enumerate() {
            let change = (behind[at] - ahead[at]) / (2e-6 * spacing_m);
            assert!(change.distance(product[system]) < 1e-4, "{at} {system}: {change} {}", product[system]);
        }
    }
}

#[test]
fn a_solution_leaves_no_more_than_the_part_it_may_of_any_load() {
    let model = model(&[&SPRINGS[..], &["sheet.points=[9, 8]", "sheet.fixed=corners"]].concat());
    let patch = patch(&model, 1.0, stretched(model.scene.sheet().unwrap().spacing_m));
    // A faint load is solved as exactly as a strong one.
    for size in [1e-9, 1.0] {
        let load: Vec<[DVec3; 3]> =
            (0..model.len()).map(|at| [0, 40, 80].map(|more| size * scattered([at + more, at]))).collect();
        let (x, iterations) = patch.solve(&load, 1e-8);
        let mut left = vec![[DVec3::ZERO; 3]; x.len()];
        patch.times(&x, &mut left);
        for system in 0..3 {
            let free = (0..model.len()).filter(|at| patch.free[*at]);
            let (rest, whole) = free.fold((0.0, 0.0), |(rest, whole), at| {
                let load = load[at][system];
                (rest + (left[at][system] - load).length_squared(), whole + load.length_squared())
            });
            assert!(rest <= 1.01e-16 * whole, "{size} {system}: {rest:e} of {whole:e}");
        }
        // Preconditioned, such a small and stiffly held sheet takes far fewer than it has unknowns.
        assert!(iterations < 60, "{iterations}");
    }
}

#[test]
fn without_springs_a_disc_moves_each_point_against_its_own_anchor_spring() {
    let model = model(&["sheet.points=[7, 7]", "springs.stiffness_n_per_m=0.0"]);
    let (scene, patch) = (&model.scene, patch(&model, 1.3, |_| DVec3::ZERO));
    let tangent = patch.tangent();
    // A force F moves point p by w·F/K″, and the disc by Σ w² F/K″.
    let shared: f64 = patch.weights.iter().map(|weight| weight * weight).sum();
    let is = |found: DMat3, expected: f64| found.abs_diff_eq(DMat3::IDENTITY * expected, 1e-6 * expected);
    assert!(is(tangent.stiffness_n_per_m, scene.anchor_stiffness_n_per_m / shared), "{tangent:?}");
    assert!(is(tangent.damping_n_s_per_m, scene.damping_n_s_per_m / shared), "{tangent:?}");
    let mass_kg = scene.sheet().unwrap().point_mass_kg / shared;
    assert!((tangent.mass_kg - mass_kg).abs() < 1e-6 * mass_kg, "{tangent:?}");
    assert_eq!(tangent.drag_n_s_per_m, 0.0);
}

#[test]
fn drag_is_what_the_points_are_moved_as_the_dimple_passes() {
    let model = model(&["sheet.points=[8, 11]"]);
    let spacing_m = model.scene.sheet().unwrap().spacing_m;
    // Zero at the rim, where a dimple has no slope.
    let rim = |[i, j]: [usize; 2]| i < 2 || j < 2 || i >= 6 || j >= 9;
    let dimple_m = |point| if rim(point) { DVec3::ZERO } else { 1e-3 * scattered(point) };
    let found = patch(&model, 1.0, dimple_m).tangent().drag_n_s_per_m;
    let mut squares = 0.0;
    for i in 1..7 {
        for j in 1..10 {
            let along_x = (dimple_m([i + 1, j]) - dimple_m([i - 1, j])) / (2.0 * spacing_m);
            let along_y = (dimple_m([i, j + 1]) - dimple_m([i, j - 1])) / (2.0 * spacing_m);
            squares += 0.5 * (along_x.length_squared() + along_y.length_squared());
        }
    }
    let expected = model.scene.damping_n_s_per_m * squares;
    assert!(expected > 0.0 && (found - expected).abs() < 1e-12 * expected, "{found} {expected}");
}

#[test]
fn after_a_press_every_point_is_in_balance() {
    let model = model(&["sheet.points=[9, 9]", "anchor_springs.stiffness_n_per_m=0.5", "sheet.fixed=edges"]);
    let mut patch = patch(&model, 1.0, |_| DVec3::ZERO);
    let depth_m = 1.5 * model.scene.sheet().unwrap().spacing_m;
    let force_n = patch.press(Some(-depth_m));
    let place_m: f64 = patch.weights.iter().zip(&patch.displacement_m).map(|(weight, u)| weight * u.z).sum();
    assert!((place_m + depth_m).abs() < 1e-6 * depth_m, "{place_m}");
    let forces = forces_n(&model, &patch.displacement_m);
    for at in (0..model.len()).filter(|at| patch.free[*at]) {
        let left_n = forces[at] - force_n * patch.weights[at] * DVec3::Z;
        assert!(left_n.length() < 1e-6 * force_n, "{at}: {left_n} of {force_n} N");
    }
}

#[test]
fn a_window_holds_all_that_notices_the_disc_and_not_much_more() {
    // Anchor springs as stiff as the others: a press is felt within a spacing.
    let model = model(&["sheet.points=[50, 44]", "anchor_springs.stiffness_n_per_m=10.0"]);
    let spacing_m = model.scene.sheet().unwrap().spacing_m;
    for (centre, radius) in [([22.3, 20.1], 5.5), ([3.0, 41.0], 2.0), ([24.0, 21.0], 0.3)] {
        let footprint = Footprint::new(&model, radius * spacing_m, (DVec2::from(centre) * spacing_m).extend(0.0));
        let half = half_window_m(&model, radius * spacing_m) / spacing_m - radius;
        assert!((REACHES..REACHES + 4.0).contains(&half), "{half} spacings beyond the disc");
        let points: Vec<usize> = Window::around(&model, &footprint).points(&model).collect();
        assert!(points.is_sorted_by(|a, b| a < b) && points.last().is_some_and(|last| *last < model.len()));
        for index in 0..model.len() {
            let [i, j] = model.point_of(index);
            let away = (i as f64 - centre[0]).abs().max((j as f64 - centre[1]).abs());
            let is_inside = points.binary_search(&index).is_ok();
            assert!(is_inside || away > radius + REACHES, "{centre:?}: {i} {j} is left out");
            assert!(!is_inside || away < radius + REACHES + 4.0, "{centre:?}: {i} {j} is in");
        }
    }
}

#[test]
fn a_window_of_a_mesh_is_a_ball_which_shrinks_to_the_disc_until_it_has_few_enough_points() {
    let text = "[mesh]\norgan = { name = \"gallbladder\", edge_m = 0.0035 }\n[material]\nyoungs_modulus_pa = 2e4\n\
                thickness_m = 0.003\nfoundation_n_per_m3 = 5e6\n[stepping]\nsubsteps = 8\n";
    let scene = Scene::parse("test", text, &[], &Limits::default()).unwrap();
    let model = Model::compile(&scene, &Limits::default()).unwrap();
    let (shape, radius_m) = (model.shape(), 0.006);
    let centre_m = shape.rest_m(shape.nearest(shape.extent().middle_m()));
    let of = |most: usize| -> Vec<usize> {
        Window::at(&model, radius_m, centre_m, most, f64::INFINITY).points(&model).collect()
    };
    // Every point that is within a distance and none else.
    let is_ball = |found: &[usize], within_m: f64| {
        model.points().all(|point| {
            let is_near = shape.rest_m(point).distance(centre_m) <= within_m;
            found.contains(&model.place_of(point)) == is_near
        })
    };
    let (all, few, least) = (of(usize::MAX), of(60), of(1));
    let reach_m = half_window_m(&model, radius_m);
    assert!(is_ball(&all, reach_m), "{} points", all.len());
    assert!(all.len() > 60 && (30..=60).contains(&few.len()), "{} and {} points", all.len(), few.len());
    let shrunk = |found: &[usize]| (0..60).map(|times| reach_m * 0.9_f64.powi(times)).find(|m| is_ball(found, *m));
    assert!(shrunk(&few).is_some_and(|within_m| within_m > radius_m), "{few:?}");
    assert!(shrunk(&least).is_some_and(|within_m| within_m > 0.9 * radius_m), "{least:?}");
    assert!(least.len() > 1 && !Window::at(&model, radius_m, centre_m, 1, f64::INFINITY).is_empty());
    assert!(Window::at(&model, radius_m, DVec3::splat(10.0), usize::MAX, f64::INFINITY).is_empty());
}

#[test]
fn a_sheet_that_stands_in_for_another_has_its_tissue_and_its_fixed_points_as_far_as_it_reaches() {
    let model = model(&["sheet.points=[17, 25]", "sheet.fixed=[[0, 0], [16, 24], [8, 12], [3, 24]]"]);
    let of = |model: &Model| (model.scene.sheet().unwrap().clone(), model.scene.clone());
    let (fine, fine_scene) = of(&model);
    let points = |sheet: &Sheet| -> Vec<[usize; 2]> {
        sheet.fixed_indices().iter().map(|index| [index / sheet.points[1], index % sheet.points[1]]).collect()
    };
    // All of it, in points twice as far apart.
    let all = stand_in(&model, 0.04, 10.0);
    let (sheet, scene) = of(&all);
    assert_eq!((all.points, sheet.points, sheet.extent_m()), ([9, 13], [9, 13], fine.extent_m()));
    assert_eq!(points(&sheet), [[0, 0], [2, 12], [4, 6], [8, 12]]);
    assert_eq!(all.fixed, sheet.fixed_indices());
    assert_eq!((all.unit_m, sheet.spacing_m), (0.04, 0.04));
    // Of the same area the same mass, damping and anchor springs; the springs are the membrane's.
    assert_eq!(sheet.point_mass_kg, 4.0 * fine.point_mass_kg);
    assert_eq!(scene.damping_n_s_per_m, 4.0 * fine_scene.damping_n_s_per_m);
    assert_eq!(scene.anchor_stiffness_n_per_m, 4.0 * fine_scene.anchor_stiffness_n_per_m);
    assert_eq!(scene.springs, fine_scene.springs);
    // The middle of it, held at its edges.
    let (sheet, _) = of(&stand_in(&model, 0.02, 0.1));
    assert_eq!((sheet.points, sheet.fixed), ([11, 11], FixedPoints::Edges));
    // Where the sheet is narrower than that, it goes as far as the sheet does.
    assert_eq!(of(&stand_in(&model, 0.02, 0.2)).0.points, [17, 21]);
}

#[test]
fn the_points_of_a_window_that_move_are_those_whose_springs_end_in_it() {
    let model =
        model(&["sheet.points=[60, 44]", "anchor_springs.stiffness_n_per_m=40", "springs.stiffness_n_per_m=10"]);
    let spacing_m = model.scene.sheet().unwrap().spacing_m;
    // Near one side, near another, and in a corner: there the sheet itself ends.
    for centre in [[30.0, 3.0], [57.0, 22.0], [2.0, 41.0]] {
        let footprint = Footprint::new(&model, 1.5 * spacing_m, (DVec2::from(centre) * spacing_m).extend(0.0));
        let window = Window::around(&model, &footprint);
        let points: Vec<[usize; 2]> = window.points(&model).map(|index| model.point_of(index)).collect();
        let free = window.free(&model, None);
        assert!(free.len() == points.len() && free.iter().any(|free| !free), "{centre:?}: all of the sheet");
        for ([i, j], free) in points.iter().zip(&free) {
            let around = points.iter().filter(|[k, l]| k.abs_diff(*i) <= 1 && l.abs_diff(*j) <= 1).count();
            let [rows, columns] = [(*i, 60), (*j, 44)].map(|(at, count)| 3 - usize::from(at == 0 || at + 1 == count));
            assert_eq!(*free, around == rows * columns, "{centre:?}: point {i} {j}");
        }
    }
}
