//! Tests of how stiff burns make a tissue: by the stated factor where it has burnt through, the same bits everywhere, and within the bound of the
//! substep.
#![allow(clippy::unwrap_used, clippy::cast_possible_truncation)]

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use glam::DVec3;

use super::{SHEET, on_top};
use crate::body::burnt_stiffness;
use crate::compile::square_of_triangles;
use crate::interface::Tissue;
use crate::limits::Limits;
use crate::response::force_law::{self, Disc};
use crate::scene::Scene;
use crate::state::tissue_state::TissueState;
use crate::{Cuts, Model, at_rest, restored};
use palpate_haptics::Tip;
use palpate_refusal::Reason;

/// Time of contact in which the tips of these tests burn through, s.
const BURN_S: f64 = 0.05;

/// The keys of a surface like the sheet of the other tests.
const SURFACE: [&str; 7] = [
    "mesh.file=flat.obj",
    "mesh.unit=m",
    "mesh.point_mass_kg=1e-4",
    "springs.bending=0.2",
    "springs.stiffness_n_per_m=100",
    "anchor_springs.stiffness_n_per_m=5",
    "damping.coefficient_n_s_per_m=0.05",
];

/// Returns a flat sheet or surface of 13 × 15 cm with these keys.
fn model(kind: &str, sets: &[String]) -> Arc<Model> {
    let limits = Limits::default();
    let scene = if kind == "sheet" {
        Scene::parse("sheet", SHEET, sets, &limits)
    } else {
        let mesh = square_of_triangles([26, 30], 0.005);
        // A later key takes the place of an earlier one.
        let keys = SURFACE.into_iter().chain(sets.iter().map(String::as_str)).map(|set| set.split_once('=').unwrap());
        let keys: BTreeMap<&str, &str> = keys.collect();
        let is_number = |value: &str| value.parse::<f64>().is_ok();
        let line = |(key, value): (&str, &str)| {
            if is_number(value) { format!("{key} = {value}\n") } else { format!("{key} = \"{value}\"\n") }
        };
        let text: String = keys.into_iter().map(line).collect();
        Scene::parse_given("flat", &text, ("flat.obj", mesh.as_bytes()), &limits)
    };
    Model::compile(&scene.unwrap(), &limits).unwrap()
}

fn sets<const N: usize>(sets: [&str; N]) -> Vec<String> {
    sets.map(str::to_owned).to_vec()
}

fn holding(burn_s: f64) -> Tip {
    Tip { radius_m: 0.012, grasps: true, burn_s, ..Tip::default() }
}

/// Holds the place on top for some steps, and moves it by `by_m` from where it rests, at most 1 mm in a step. A tip that grasps holds the tissue
/// where it finds it, so it begins on the surface.
fn hold(tissue: &mut dyn Tissue, by_m: DVec3, tip: Tip, steps: u32) {
    let (rest_m, _) = on_top(&tissue.model().clone());
    for _ in 0..steps {
        let next_m = tissue.tool_contact(0).map_or(rest_m, |held| {
            let left_m = rest_m + by_m - held.place_m;
            held.place_m + left_m.clamp_length_max(0.001)
        });
        tissue.pose(0, next_m, tip);
        tissue.step().unwrap();
    }
}

/// Returns a tissue at rest of which each point has burnt for some steps of [`BURN_S`].
fn burnt_alike(model: &Arc<Model>, steps: u32) -> Box<dyn Tissue> {
    let mut plain = at_rest(model).save().plain();
    plain.parts.burns.now = (0..model.place_count() as u32).map(|place| (place, steps)).collect();
    plain.parts.burn_times.now_s = vec![BURN_S; model.place_count()];
    plain.parts.burn_times.version = 1;
    restored(model, &plain.parts, &plain.values, &Limits::default()).unwrap()
}

fn displacements(tissue: &dyn Tissue) -> Vec<DVec3> {
    tissue.model().points().map(|point| tissue.point(point).displacement_m).collect()
}

#[test]
fn a_tissue_that_has_burnt_alike_everywhere_moves_to_the_bit_as_one_of_springs_so_stiff() {
    for kind in ["sheet", "surface"] {
        for precision in ["f32", "f64"] {
            for lanes in ["plain", "auto"] {
                let integrator = if lanes == "auto" && precision == "f32" { "central" } else { "exponential3" };
                let stepping = [format!("stepping.precision={precision}"), format!("stepping.lanes={lanes}")];
                let stepping = [&stepping[..], &[format!("stepping.integrator={integrator}")]].concat();
                let of = |sets: Vec<String>| {
                    let fixed = ["stepping.substeps=8".to_owned(), "sleep.tolerance=0.0".to_owned()];
                    model(kind, &[&sets[..], &stepping, &fixed].concat())
                };
                // Half of the burn: the factor is 1 + (3 − 1)/2.
                let mut burnt = burnt_alike(&of(sets(["cutting.burnt_stiffness_factor=3.0"])), 25);
                let stiff = match kind {
                    "sheet" => sets(["springs.stiffness_n_per_m=200.0", "springs.shear_stiffness_n_per_m=200.0"]),
                    _ => sets(["springs.stiffness_n_per_m=200.0"]),
                };
                let (mut stiff, mut soft) = (at_rest(&of(stiff)), at_rest(&of(vec![])));
                let by_m = DVec3::new(0.001, 0.003, 0.006);
                let [of_burnt, of_stiff, of_soft] = [&mut burnt, &mut stiff, &mut soft].map(|tissue| {
                    hold(&mut **tissue, by_m, holding(0.0), 60);
                    displacements(&**tissue)
                });
                assert!(of_burnt == of_stiff && of_burnt != of_soft, "{kind} {precision} {lanes} {integrator}");
                let force_n = |tissue: &dyn Tissue| tissue.tool_contact(0).unwrap().force_on_tool_n;
                assert_eq!(force_n(&*burnt), force_n(&*stiff), "{kind} {precision} {lanes} {integrator}");
            }
        }
    }
}

#[test]
fn a_spring_is_two_halves_in_series_each_as_stiff_as_its_own_end() {
    let of = |points: &[(u32, f64)]| burnt_stiffness::BurntStiffness::of(points.iter().copied());
    let burnt = of(&[(3, 5.0), (4, 5.0), (7, 2.0), (9, 1.0)]);
    assert_eq!(burnt.places().collect::<Vec<_>>(), [3, 4, 7]);
    assert_eq!((burnt.of_spring([3, 4]), burnt.of_spring([1, 2]), burnt.of_spring([1, 9])), (5.0, 1.0, 1.0));
    for [a, b] in [[3, 7], [7, 3], [1, 3], [3, 9]] {
        let halves = [a, b].map(|place| 1.0 / (2.0 * burnt.of_point(place)));
        assert!((burnt.of_spring([a, b]) * (halves[0] + halves[1]) - 1.0).abs() < 1e-15, "{a} {b}");
    }
    // Levels: none below a sixteenth, all of it at 1.
    let factors = [0.0, 0.06, 0.0625, 0.5, 0.999, 1.0].map(|burn| burnt_stiffness::of_point(9.0, burn));
    assert_eq!(factors, [1.0, 1.0, 1.5, 5.0, 8.5, 9.0]);
    let other = of(&[(3, 5.0), (4, 4.0), (8, 2.0)]);
    let mut differences: Vec<_> = burnt.differences(&other).collect();
    differences.sort_unstable();
    differences.dedup();
    assert_eq!(differences, [4, 7, 8]);
}

/// Burns the place on top almost through, and lets it go.
fn burn(tissue: &mut dyn Tissue) {
    hold(tissue, DVec3::ZERO, holding(BURN_S), 49);
    tissue.release(0);
    assert!(tissue.cuts().is_empty() && !tissue.burns().is_empty());
}

#[test]
fn a_press_on_a_burn_meets_the_force_of_its_law_which_is_above_that_of_a_whole_tissue() {
    for kind in ["sheet", "surface"] {
        let of = |factor: f64| {
            let factor = format!("cutting.burnt_stiffness_factor={factor:?}");
            model(kind, &[sets(["stepping.precision=f64", "sleep.tolerance=0.0"]), vec![factor]].concat())
        };
        let tip = Tip { radius_m: 0.007, friction: 1.0, ..Tip::default() };
        let mut found = Vec::new();
        for factor in [1.0, 8.0] {
            let model = of(factor);
            let mut tissue = at_rest(&model);
            burn(&mut *tissue);
            let (top_m, _) = on_top(&model);
            for step in 0..3000 {
                let down_m = 0.004 * (f64::from(step) / 500.0).min(1.0);
                tissue.pose(1, top_m - down_m * DVec3::Z, tip);
                tissue.step().unwrap();
            }
            assert_eq!(tissue.guard_events(), 0);
            let (cuts, disc) = (tissue.cuts(), Disc { radius_m: tip.radius_m, at_m: top_m });
            assert_eq!(disc.notices(&model, &cuts), factor > 1.0, "{kind}");
            let law = force_law::exact_within(&model, &cuts, disc, u64::MAX, &AtomicBool::new(false)).unwrap();
            let force_n = tissue.tool_contact(1).unwrap().force_on_tool_n.z;
            let slope = tissue.tangent_input(1).unwrap().tangent().stiffness_n_per_m.z_axis.z;
            let of_law = law.at_depth(0.004);
            let errors = [force_n / of_law.force_n - 1.0, slope / of_law.stiffness_n_per_m - 1.0];
            println!("{kind}, factor {factor}: {force_n:.4} N, off its law by {:.1e} and {:.1e}", errors[0], errors[1]);
            assert!(errors.iter().all(|error| error.abs() < 0.03), "{kind} {factor}: {errors:?}");
            found.push(force_n);
        }
        assert!(found[1] > 1.15 * found[0], "{kind}: {found:?} N");
    }
}

#[test]
fn a_tissue_that_stiffens_has_the_same_bits_at_every_width_after_a_snapshot_and_in_a_twin() {
    for kind in ["sheet", "surface", "gallbladder"] {
        for precision in ["f32", "f64", "compensated"] {
            let mut hashes = Vec::new();
            for lanes in ["plain", "auto"] {
                let sets = sets(["cutting.burnt_stiffness_factor=6.0", "stepping.integrator=exponential3"]);
                let of_run = [format!("stepping.precision={precision}"), format!("stepping.lanes={lanes}")];
                let sets = [&sets[..], &of_run].concat();
                let model = match kind {
                    "gallbladder" => Model::gallbladder(&sets.iter().map(String::as_str).collect::<Vec<_>>()),
                    _ => model(kind, &sets),
                };
                let (_, normal) = on_top(&model);
                let (tip, by_m) = (Tip { radius_m: 0.006, ..holding(BURN_S) }, 0.002 * normal);
                let mut tissue = at_rest(&model);
                hold(&mut *tissue, by_m, tip, 23);
                let saved = tissue.save().plain();
                let mut again = restored(&model, &saved.parts, &saved.values, &Limits::default()).unwrap();
                assert_eq!(again.save().plain(), saved, "{kind}");
                assert_eq!(again.cuts().burnt(), tissue.cuts().burnt(), "{kind}");
                let at_snapshot = tissue.cuts();
                for tissue in [&mut tissue, &mut again] {
                    hold(&mut **tissue, by_m, tip, 20);
                    assert!(tissue.cuts().is_empty() && tissue.cuts() != at_snapshot, "{kind}");
                    hold(&mut **tissue, by_m, tip, 20);
                    assert!(!tissue.cuts().is_empty(), "{kind}");
                }
                assert_eq!(again.state_hash(), tissue.state_hash(), "{kind} {precision} {lanes}");
                assert_eq!(tissue.copy().point(model.point_at(0)), tissue.point(model.point_at(0)));
                hashes.push(tissue.state_hash());
            }
            assert_eq!(hashes[0], hashes[1], "{kind} {precision}");
        }
    }
}

/// The sums of a sweep over the table of springs are those of the springs one by one, whatever has become of them.
fn assert_tables_are_those_of_the_state(tissue: &TissueState<f64>, case: &str) {
    let plain = tissue.saved().plain();
    let again = restored(&tissue.model, &plain.parts, &plain.values, &Limits::default()).unwrap();
    // A restored tissue has made its tables from nothing.
    let energy = |tissue: &dyn Tissue| tissue.energy();
    assert_eq!(energy(tissue), energy(&*again), "{case}");
}

#[test]
fn the_guard_goes_back_to_the_stiffness_of_the_checkpoint_before_and_after_a_burn_is_through() {
    for kind in ["sheet", "surface", "gallbladder"] {
        // The guard takes a checkpoint of its own each 21 steps.
        for (at, steps) in [(21, 12), (42, 15)] {
            let sets = sets([
                "cutting.burnt_stiffness_factor=6.0",
                "stepping.precision=f64",
                "stepping.integrator=exponential3",
                "stepping.substeps=12",
                "sleep.tolerance=0.0",
            ]);
            let model = match kind {
                "gallbladder" => Model::gallbladder(&sets.iter().map(String::as_str).collect::<Vec<_>>()),
                _ => model(kind, &sets),
            };
            let (_, normal) = on_top(&model);
            let (tip, by_m) = (Tip { radius_m: 0.006, ..holding(BURN_S) }, 0.002 * normal);
            let mut tissue = TissueState::<f64>::new(&model);
            hold(&mut tissue, by_m, tip, at);
            tissue.take_checkpoint();
            let cuts = tissue.cuts();
            let mut resumed = TissueState::resumed(&tissue.model, tissue.checkpoint.as_ref().unwrap());
            hold(&mut tissue, by_m, tip, steps);
            assert_tables_are_those_of_the_state(&tissue, kind);
            assert_eq!(tissue.cuts().is_empty(), at == 21, "{kind}");
            let (later, moved_m) = (tissue.state_hash(), displacements(&tissue));
            for _ in 0..steps {
                resumed.do_step();
            }
            assert_eq!(resumed.state_hash(), later, "{kind}: a twin");
            let after = (tissue.cuts().burnt().clone(), tissue.cuts().len());
            assert_ne!(&after.0, cuts.burnt());
            // The conversion to another substep and back rounds.
            tissue.go_back(0);
            assert_tables_are_those_of_the_state(&tissue, kind);
            assert_eq!((tissue.cuts().burnt(), tissue.cuts().len()), (cuts.burnt(), 0), "{kind}");
            hold(&mut tissue, by_m, tip, steps);
            assert_tables_are_those_of_the_state(&tissue, kind);
            assert_eq!((tissue.cuts().burnt().clone(), tissue.cuts().len()), after, "{kind} after {steps} steps");
            let apart_m = moved_m.iter().zip(displacements(&tissue)).map(|(a, b)| a.distance(b)).fold(0.0, f64::max);
            assert!(apart_m < 1e-9, "{kind} after {steps} steps: {apart_m:.1e} m");
        }
    }
}

#[test]
fn what_stiffens_while_it_is_stretched_moves_as_with_shorter_substeps_and_the_guard_sees_no_fault() {
    // The history of a multistep scheme is that of the stiffer springs: without that the error is of first order.
    for kind in ["sheet", "surface"] {
        let moved = |integrator: &str, substeps: u32| {
            let sets = sets(["cutting.burnt_stiffness_factor=8.0", "stepping.precision=f64", "sleep.tolerance=0.0"]);
            let of_run = [format!("stepping.integrator={integrator}"), format!("stepping.substeps={substeps}")];
            let mut tissue = at_rest(&model(kind, &[&sets[..], &of_run].concat()));
            hold(&mut *tissue, DVec3::new(0.002, 0.0, 0.006), holding(0.0), 200);
            hold(&mut *tissue, DVec3::new(0.002, 0.0, 0.006), holding(BURN_S), 45);
            assert!(tissue.guard_events() == 0 && tissue.cuts().is_empty(), "{kind} {integrator}");
            displacements(&*tissue)
        };
        let truth = moved("exponential4", 64);
        let largest_m = truth.iter().map(|u_m| u_m.length()).fold(0.0, f64::max);
        for integrator in ["exponential2", "exponential3", "exponential4"] {
            let found = moved(integrator, 16);
            let error = found.iter().zip(&truth).map(|(a, b)| a.distance(*b)).fold(0.0, f64::max) / largest_m;
            println!("{kind} {integrator}: {error:.1e}");
            assert!(error < 1e-5, "{kind} {integrator}: {error:.1e}");
        }
    }
}

#[test]
fn the_substep_of_a_tissue_that_may_stiffen_is_stable_when_all_of_it_has_burnt_through() {
    for kind in ["sheet", "surface"] {
        for integrator in ["auto", "central", "exponential4"] {
            let of = |factor: f64| {
                let sets =
                    [format!("cutting.burnt_stiffness_factor={factor:?}"), format!("stepping.integrator={integrator}")];
                model(kind, &sets)
            };
            let (stiffening, whole) = (of(50.0), of(1.0));
            let ratio = stiffening.omega_bound_per_s / whole.omega_bound_per_s;
            assert!(ratio > 6.5 && ratio <= 50_f64.sqrt() && stiffening.plan.stable, "{kind} {integrator}: {ratio}");
            let mut tissue = burnt_alike(&stiffening, 50);
            hold(&mut *tissue, 0.004 * DVec3::Z, holding(0.0), 50);
            tissue.release(0);
            for _ in 0..500 {
                tissue.step().unwrap();
            }
            let largest_m = displacements(&*tissue).iter().map(|u_m| u_m.length()).fold(0.0, f64::max);
            assert!(tissue.guard_events() == 0 && largest_m < 1e-3, "{kind} {integrator}: {largest_m} m");
        }
    }
}

#[test]
fn a_factor_of_1_has_the_bits_of_a_tissue_that_does_not_stiffen() {
    for kind in ["sheet", "surface"] {
        let [one, none] = [sets(["cutting.burnt_stiffness_factor=1.0"]), vec![]].map(|sets| {
            let model = model(kind, &[sets, vec!["stepping.precision=f32".to_owned()]].concat());
            let mut tissue = at_rest(&model);
            hold(&mut *tissue, 0.003 * DVec3::Z, holding(BURN_S), 80);
            assert!(!tissue.cuts().is_empty() && tissue.cuts().burnt().is_empty());
            (model.fingerprint(), model.plan.clone(), tissue.state_hash(), model.cut_bytes())
        });
        assert!(one == none, "{kind}");
        let other = model(kind, &sets(["cutting.burnt_stiffness_factor=2.0", "stepping.precision=f32"]));
        assert!(other.fingerprint() != none.0 && other.cut_bytes() > none.3, "{kind}");
    }
}

#[test]
fn a_tip_that_does_not_burn_moves_a_tissue_that_may_stiffen_as_any_other() {
    for kind in ["sheet", "surface"] {
        let [may, not] = ["8.0", "1.0"].map(|factor| {
            let factor = format!("cutting.burnt_stiffness_factor={factor}");
            let fixed = sets(["stepping.substeps=16", "stepping.integrator=exponential3", "sleep.tolerance=0.0"]);
            let mut tissue =
                at_rest(&model(kind, &[vec![factor, "stepping.precision=f32".to_owned()], fixed].concat()));
            hold(&mut *tissue, 0.003 * DVec3::Z, holding(0.0), 50);
            (tissue.cuts() == Cuts::default(), displacements(&*tissue))
        });
        assert!(may == not && may.0, "{kind}");
    }
}

#[test]
fn factors_out_of_range_and_for_tissues_that_cannot_stiffen_are_refused() {
    let refused = |text: &str, set: &[&str]| {
        let refusal = Model::parse("scene", text, set).unwrap_err();
        assert_eq!(refusal.field, "cutting.burnt_stiffness_factor", "{set:?}");
        refusal.reason
    };
    for factor in ["0.5", "0.0", "-3.0", "100.5"] {
        let set = format!("cutting.burnt_stiffness_factor={factor}");
        assert_eq!(refused(SHEET, &[&set]), Reason::OutOfRange, "{factor}");
    }
    assert_eq!(refused(SHEET, &["cutting.burnt_stiffness_factor=nan"]), Reason::NotFinite);
    let tense = ["springs.pretension_n_per_m=1.0", "cutting.burnt_stiffness_factor=2.0"];
    assert_eq!(refused(SHEET, &tense), Reason::WrongKind);
    let one = ["springs.pretension_n_per_m=1.0", "cutting.burnt_stiffness_factor=1.0"];
    assert!(Model::parse("scene", SHEET, &one).is_ok());
    let block = "[solid]\norgan = { name = \"phantom\", edge_m = 0.008, seed = 1 }\ncell_m = 0.01\n\
                 fixed = [{ plane_m = [0, 0, 0], normal = [0, 0, 1], within_m = 0.001 }]\n\
                 [material]\nyoungs_modulus_pa = 15e3\npoissons_ratio = 0.45\ndensity_kg_per_m3 = 980\n";
    assert_eq!(refused(block, &["cutting.burnt_stiffness_factor=2.0"]), Reason::WrongKind);
}
