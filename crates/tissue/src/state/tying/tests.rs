//! Tests of threads and clips: what they hold, how long they stay, and that they give no energy.
#![allow(clippy::unwrap_used)]

use std::sync::Arc;

use glam::DVec3;

use crate::compile::square_of_triangles;
use crate::interface::Tissue;
use crate::limits::Limits;
use crate::scene::Scene;
use crate::scene::profile::Poke;
use crate::scene::tie::{Bite, Tie, TieKind};
use crate::{Model, Push, at_rest, restored};
use palpate_haptics::{Tip, TipShape};

const STEPPING: &str = "[stepping]\nintegrator = \"exponential2\"\nprecision = \"f64\"\ntolerance = 1e-3\n";

/// Returns a strip of 12 × 8 cells of 5 mm whose end at x = 0 is fixed: a sheet or a surface.
fn strip(kind: &str, anchor: f64) -> Arc<Model> {
    let both = format!(
        "[damping]\ncoefficient_n_s_per_m = 0.02\n[anchor_springs]\nstiffness_n_per_m = {anchor:?}\n{STEPPING}"
    );
    if kind == "sheet" {
        let fixed: Vec<String> = (0..9).map(|j| format!("[0, {j}]")).collect();
        let text = format!(
            "[sheet]\npoints = [13, 9]\nspacing_m = 0.005\npoint_mass_kg = 1e-4\nfixed = [{}]\n\
             [springs]\nstiffness_n_per_m = 100\n{both}",
            fixed.join(", ")
        );
        return Model::parse("strip", &text, &[]).unwrap();
    }
    let ball = |j: i32| format!("{{ centre_m = [0, {:?}, 0], radius_m = 0.001 }}", 0.005 * f64::from(j));
    let fixed: Vec<String> = (0..9).map(ball).collect();
    let text = format!(
        "[mesh]\nfile = \"strip.obj\"\nunit = \"m\"\npoint_mass_kg = 1e-4\nfixed = [{}]\n\
         [springs]\nstiffness_n_per_m = 100\n{both}",
        fixed.join(", ")
    );
    let mesh = square_of_triangles([12, 8], 0.005);
    let scene = Scene::parse_given("strip", &text, ("strip.obj", mesh.as_bytes()), &Limits::default()).unwrap();
    Model::compile(&scene, &Limits::default()).unwrap()
}

fn bite(x: f64, y: f64) -> Bite {
    Bite { place_m: DVec3::new(x, y, 0.0), radius_m: 0.004 }
}

fn thread(bites: &[Bite], length_m: f64, friction: f64) -> Tie {
    Tie { bites: bites.to_vec(), kind: TieKind::Thread { length_m, friction }, strength_n: None }
}

fn clip(bites: [Bite; 2]) -> Tie {
    Tie { bites: bites.to_vec(), kind: TieKind::Clip, strength_n: None }
}

/// Cuts a strip in two at x = 32.5 mm.
fn cut(tissue: &mut dyn Tissue) {
    let tip = Tip { shape: TipShape::Blade, radius_m: 0.001, edge_m: 0.02 * DVec3::Z, ..Tip::default() };
    for step in 0..=100 {
        tissue.pose(0, DVec3::new(0.0325, -0.01 + 0.0006 * f64::from(step), -0.01), tip);
        tissue.step().unwrap();
    }
    tissue.release(0);
}

#[test]
fn a_stitch_alone_holds_1_n_for_a_minute_without_creep_and_keeps_its_length() {
    for kind in ["sheet", "surface"] {
        let model = strip(kind, 0.0);
        let mut tissue = at_rest(&model);
        cut(&mut *tissue);
        assert_eq!(tissue.cuts().pieces(&model), 2, "{kind}");
        let length_m = 0.022;
        let bites = [bite(0.0225, 0.02), bite(0.0425, 0.02)];
        tissue.tie(0, Some(thread(&bites, length_m, 0.0)));
        // Nothing else holds the piece that is drawn away, by the same force at all of its points.
        let shape = model.shape();
        let of_piece = crate::shape::points(shape).filter(|point| shape.rest_m(*point).x > 0.0325).count() as f64;
        let poke = Poke {
            point: None,
            centre_m: DVec3::new(0.0425, 0.02, 0.0),
            force_n: DVec3::X / of_piece,
            falloff_per_m: 0.0,
            falloff_offset: 0.0,
        };
        tissue.push(1, Some(Push::Constant(poke)));
        let mut held = Vec::new();
        for step in 0..60_000 {
            tissue.step().unwrap();
            if step == 4999 || step == 59_999 {
                let state = tissue.ties().remove(0);
                held.push((state, tissue.surface_displacement_m(DVec3::new(0.0425, 0.02, 0.0))));
            }
        }
        let [(first, early_m), (last, late_m)] = held.try_into().unwrap();
        assert!((last.tensions_n[0] - 1.0).abs() < 0.01, "{kind}: {last:?}");
        assert!((last.path_m / length_m - 1.0).abs() < 0.01 && last.length_m == length_m, "{kind}: {last:?}");
        assert!(early_m.distance(late_m) < 1e-7, "{kind}: {early_m} {late_m}");
        assert!((first.path_m - last.path_m).abs() < 1e-8, "{kind}: {first:?} {last:?}");
        assert!(tissue.guard_events() == 0 && last.peak_n < 30.0, "{kind}: {last:?}");
    }
}

#[test]
fn a_stitch_in_a_solid_keeps_its_length_and_does_not_creep() {
    let block = "v 0 0 0\nv 0.04 0 0\nv 0.04 0.03 0\nv 0 0.03 0\nv 0 0 0.015\nv 0.04 0 0.015\nv 0.04 0.03 0.015\nv 0 0.03 0.015\n\
                 f 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n";
    let text = "[solid]\nfile = \"block.obj\"\nunit = \"m\"\ncell_m = 0.005\nfixed = [{ plane_m = [0, 0, 0], normal = [0, 0, 1] }]\n\
                [material]\nyoungs_modulus_pa = 8e3\npoissons_ratio = 0.45\ndamping_per_s = 100\n\
                [stepping]\nintegrator = \"central\"\nsubsteps = 4\nprecision = \"f64\"\n";
    let scene = Scene::parse_given("block", text, ("block.obj", block.as_bytes()), &Limits::default()).unwrap();
    let model = Model::compile(&scene, &Limits::default()).unwrap();
    let mut tissue = at_rest(&model);
    let at = |x: f64| Bite { place_m: DVec3::new(x, 0.015, 0.015), radius_m: 0.004 };
    tissue.tie(0, Some(thread(&[at(0.01), at(0.03)], 0.017, 0.0)));
    let mut held = Vec::new();
    for step in 0..6000 {
        tissue.step().unwrap();
        if step == 1999 || step == 5999 {
            held.push(tissue.ties().remove(0));
        }
    }
    let [first, last] = held.try_into().unwrap();
    assert!(last.tensions_n[0] > 0.05 && tissue.guard_events() == 0, "{last:?}");
    assert!((last.path_m / 0.017 - 1.0).abs() < 0.01, "{last:?}");
    assert!((first.tensions_n[0] / last.tensions_n[0] - 1.0).abs() < 1e-3, "{first:?} {last:?}");
}

#[test]
fn friction_lets_the_tensions_of_a_sliding_thread_differ_as_the_capstan_equation_says() {
    for kind in ["sheet", "surface"] {
        let model = strip(kind, 20.0);
        let zigzag = [bite(0.01, 0.012), bite(0.02, 0.028), bite(0.03, 0.012), bite(0.04, 0.028), bite(0.05, 0.012)];
        for (count, friction) in [(3, 0.0), (3, 0.3), (5, 0.0), (5, 0.15)] {
            let mut tissue = at_rest(&model);
            let bites = &zigzag[..count];
            let path_m: f64 = bites.windows(2).map(|pair| pair[0].place_m.distance(pair[1].place_m)).sum();
            // Drawn in slowly, so that it slides towards its last bite all the time.
            let mut length_m = path_m;
            let mut draw = |tissue: &mut dyn Tissue, by_m: f64, steps: u32| {
                for _ in 0..steps {
                    length_m += by_m / f64::from(steps);
                    tissue.tie(0, Some(thread(bites, length_m, friction)));
                    tissue.step().unwrap();
                }
                tissue.ties().remove(0)
            };
            let drawn = draw(&mut *tissue, -0.2 * path_m, 1500);
            let check = |state: &crate::TieState, tightens: bool| {
                assert!(state.tensions_n[0] > 0.02, "{kind} {count} {friction}: {state:?}");
                for bite in 1..count - 1 {
                    let along = |part: usize| (state.places_m[part + 1] - state.places_m[part]).normalize();
                    let angle = along(bite - 1).angle_between(along(bite));
                    let ratio = state.tensions_n[bite] / state.tensions_n[bite - 1];
                    let expected = (if tightens { friction * angle } else { -friction * angle }).exp();
                    assert!((ratio / expected - 1.0).abs() < 0.02, "{kind} {count} {friction}: {ratio} {expected}");
                }
            };
            check(&drawn, true);
            assert!((drawn.path_m / drawn.length_m - 1.0).abs() < 0.01, "{drawn:?}");
            if friction > 0.0 && count == 3 {
                // Let out, it slides back, but only once the tension has turned round.
                let turning = draw(&mut *tissue, 0.002 * path_m, 100);
                assert!(turning.tensions_n[1] < 0.999 * drawn.tensions_n[1], "{turning:?}");
                check(&draw(&mut *tissue, 0.12 * path_m, 1500), false);
            }
        }
    }
}

#[test]
fn a_clip_closes_and_holds_its_bites_at_one_place() {
    for kind in ["sheet", "surface"] {
        let model = strip(kind, 2.0);
        let mut tissue = at_rest(&model);
        tissue.tie(3, Some(clip([bite(0.02, 0.02), bite(0.035, 0.02)])));
        (0..2000).for_each(|_| tissue.step().unwrap());
        let state = tissue.ties().remove(0);
        assert!(state.number == 3 && state.length_m == 0.0 && state.path_m < 1e-5 && !state.is_broken, "{state:?}");
        assert!(state.tensions_n[0] > 0.1 && tissue.guard_events() == 0, "{state:?}");
        // Taken off, the tissue goes back, and rests.
        tissue.tie(3, None);
        (0..8000).for_each(|_| tissue.step().unwrap());
        assert!(
            tissue.ties().is_empty() && tissue.largest_displacement_m() < 1e-4,
            "{}",
            tissue.largest_displacement_m()
        );
    }
}

#[test]
fn a_thread_breaks_at_its_strength_and_a_loose_one_lets_the_tissue_rest() {
    let model = strip("sheet", 20.0);
    let mut tissue = at_rest(&model);
    let bites = [bite(0.02, 0.02), bite(0.04, 0.02)];
    tissue.tie(0, Some(Tie { strength_n: Some(0.5), ..thread(&bites, 0.01, 0.0) }));
    let mut most_n = 0.0_f64;
    for _ in 0..300 {
        tissue.step().unwrap();
        most_n = most_n.max(tissue.ties()[0].tensions_n[0]);
    }
    let broken = tissue.ties().remove(0);
    assert!(broken.is_broken && broken.peak_n > 0.5 && most_n <= 0.5 && broken.tensions_n[0] == 0.0, "{broken:?}");
    // The same again does not mend it; other bites do.
    tissue.tie(0, Some(Tie { strength_n: Some(0.5), ..thread(&bites, 0.01, 0.0) }));
    tissue.step().unwrap();
    assert!(tissue.ties()[0].is_broken);
    tissue.tie(0, Some(thread(&[bite(0.02, 0.015), bite(0.04, 0.015)], 0.03, 0.0)));
    (0..10_000).for_each(|_| tissue.step().unwrap());
    let loose = tissue.ties().remove(0);
    assert!(!loose.is_broken && loose.peak_n == 0.0 && (loose.length_m - 0.03).abs() < 1e-15, "{loose:?}");
    assert!(tissue.is_still(), "{} points are awake", tissue.awake_points());
}

#[test]
fn threads_and_clips_have_the_same_bits_at_every_width_and_continue_from_a_snapshot() {
    for scene in ["sheet", "gallbladder"] {
        for precision in ["f32", "f64"] {
            let mut hashes = Vec::new();
            for lanes in ["plain", "avx2", "auto"] {
                let sets = [format!("stepping.precision={precision}"), format!("stepping.lanes={lanes}")];
                let sets = sets.each_ref().map(String::as_str);
                let model = if scene == "sheet" { Model::paper(&sets) } else { Model::gallbladder(&sets) };
                let extent = model.shape().extent();
                let (middle_m, size_m) = (extent.middle_m(), extent.size_m());
                let top_m = DVec3::new(middle_m.x, middle_m.y, extent.most_m.z);
                let radius_m = 0.05 * size_m.x;
                let at = |x: f64, y: f64| Bite {
                    place_m: top_m + DVec3::new(0.1 * x * size_m.x, 0.1 * y * size_m.y, 0.0),
                    radius_m,
                };
                let mut tissue = at_rest(&model);
                let bites = [at(-1.0, 0.0), at(0.0, 1.0), at(1.0, 0.0)];
                tissue.tie(5, Some(thread(&bites, 1.0, 0.2)));
                let path_m = tissue.ties()[0].path_m;
                tissue.tie(5, None);
                let lead = |tissue: &mut dyn Tissue, steps: std::ops::Range<u32>| {
                    for step in steps {
                        let length_m = (1.0 - 0.0003 * f64::from(step)) * path_m;
                        tissue.tie(5, Some(thread(&bites, length_m, 0.2)));
                        if step == 10 {
                            tissue.tie(1, Some(clip([at(0.0, 0.0), at(0.5, 0.5)])));
                        }
                        tissue.step().unwrap();
                    }
                };
                lead(&mut *tissue, 0..50);
                let saved = tissue.save().plain();
                let mut again = restored(&model, &saved.parts, &saved.values, &Limits::default()).unwrap();
                assert_eq!(again.state_hash(), tissue.state_hash(), "{scene} {precision} {lanes}");
                assert_eq!((again.ties(), tissue.copy().state_hash()), (tissue.ties(), tissue.state_hash()));
                lead(&mut *tissue, 50..100);
                lead(&mut *again, 50..100);
                assert!(tissue.ties().iter().all(|tie| tie.peak_n > 1e-6), "{:?}", tissue.ties());
                assert_eq!((again.state_hash(), again.ties()), (tissue.state_hash(), tissue.ties()), "{scene} {lanes}");
                assert_eq!(again.save().plain(), tissue.save().plain());
                hashes.push(tissue.state_hash());
            }
            assert!(hashes.windows(2).all(|pair| pair[0] == pair[1]), "{scene} {precision}: {hashes:x?}");
        }
    }
}

#[test]
fn a_thread_that_is_drawn_in_gives_no_more_energy_than_its_work() {
    // Without damping, a multistep scheme gives energy by itself.
    for (integrator, damping_n_s_per_m) in [("central", 0.0), ("exponential2", 0.02), ("exponential4", 0.02)] {
        for kind in ["sheet", "surface"] {
            let model = strip(kind, 5.0);
            let mut scene = model.scene.clone();
            scene.damping_n_s_per_m = damping_n_s_per_m;
            scene.stepping.integrator =
                <crate::scene::Integrator as crate::scene::Named>::named("", integrator).unwrap();
            scene.stepping.substeps = Some(4);
            scene.sleep_tolerance = Some(0.0);
            let model = Model::compile(&scene, &Limits::default()).unwrap();
            let mut tissue = at_rest(&model);
            let bites = [bite(0.015, 0.012), bite(0.03, 0.028), bite(0.045, 0.012)];
            let mut work_j = 0.0;
            let mut length_m = f64::NAN;
            let energy = |tissue: &dyn Tissue| {
                let of = tissue.energy();
                of.kinetic_j + of.spring_j + of.anchor_j
            };
            // All at once: it is drawn in as fast as it may be.
            tissue.tie(0, Some(thread(&bites, 0.035, 0.1)));
            let mut most_j = 0.0_f64;
            for step in 0..5000 {
                tissue.step().unwrap();
                let state = tissue.ties().remove(0);
                let drawn_m = if length_m.is_nan() { 0.0 } else { length_m - state.length_m };
                work_j += state.tensions_n[1] * drawn_m.max(0.0);
                length_m = state.length_m;
                if step > 20 {
                    let energy_j = energy(&*tissue);
                    assert!(energy_j <= 1.05 * work_j + 1e-7, "{integrator} {kind} {step}: {energy_j} J of {work_j} J");
                    most_j = most_j.max(energy_j);
                }
            }
            assert!(most_j > 1e-5 && tissue.guard_events() == 0, "{integrator} {kind}: {most_j} J");
        }
    }
}
