//! Touch and grasp: the force of a sheet on a tool of finite size.

use std::sync::Arc;

use crate::common::{model, scene_with};
use glam::{DVec2, DVec3};
use palpate_haptics::{ContactState, Coupling, Tip};
use palpate_tissue::response::force_law;
use palpate_tissue::response::tangent;
use palpate_tissue::scene::BUILT_IN;
use palpate_tissue::{self as tissue, Model, Tissue, ToolContact};

/// Flat punches of 5 mm radius, 2aE/(1 − ν²), N/m.
const FLAT_PUNCH_N_PER_M: [(&str, f64); 3] = [("stomach", 25.3), ("liver", 71.1), ("fibrotic", 354.0)];

fn tissue(name: &str, sets: &[&str]) -> Arc<Model> {
    let text = BUILT_IN.iter().find(|scene| scene.0 == name).unwrap().1;
    model(&scene_with(text, sets))
}

fn middle(model: &Model) -> DVec3 {
    model.shape().extent().middle_m()
}

/// From 0 to 1 without a jerk.
fn smooth(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * x * (10.0 + x * (6.0 * x - 15.0))
}

/// Moves tool 0 along a path, and calls `look` with the force after each step.
fn lead(
    sheet: &mut dyn Tissue,
    tip: Tip,
    steps: u32,
    way: impl Fn(f64) -> DVec3,
    mut look: impl FnMut(f64, &ToolContact),
) {
    for step in 1..=steps {
        let time_s = f64::from(step) * 1e-3;
        sheet.pose(0, way(time_s), tip);
        sheet.step().unwrap();
        look(time_s, &sheet.tool_contact(0).unwrap());
    }
    assert_eq!(sheet.guard_events(), 0, "the guard had to mend a touch");
}

/// Down, along and out again: 2 s.
fn stroke(middle: DVec3, depth_m: f64) -> impl Fn(f64) -> DVec3 {
    move |t| {
        let z = 0.002 - (0.002 + depth_m) * (smooth(t / 0.4) - smooth((t - 1.4) / 0.4));
        middle + DVec3::new(-0.006 + 0.012 * smooth((t - 0.6) / 0.5), 0.0013, z)
    }
}

#[test]
fn a_touch_enters_slides_and_leaves_without_a_jump_and_never_pulls() {
    for (name, depth_m, friction) in [("liver", 0.008, 0.2), ("fibrotic", 0.003, 0.0), ("stomach", 0.01, 0.5)] {
        let model = tissue(name, &[]);
        let mut sheet = tissue::at_rest(&model);
        let (mut before, mut largest, mut jump, mut slid) = (DVec3::ZERO, 0.0_f64, (0.0_f64, 0.0), false);
        let tip = Tip { friction, ..Tip::default() };
        lead(&mut *sheet, tip, 2000, stroke(middle(&model), depth_m), |time_s, feel| {
            let force = feel.force_on_tool_n;
            let pressure = force.dot(feel.normal);
            assert!(pressure >= 0.0, "{name} pulls with {pressure} N at {time_s} s");
            let across = (force - pressure * feel.normal).length();
            assert!(across <= friction * pressure * (1.0 + 1e-9) + 1e-12, "{name}: {across} N across {pressure} N");
            slid |= feel.contact_state == ContactState::Sliding;
            if (force - before).length() > jump.0 {
                jump = ((force - before).length(), time_s);
            }
            largest = largest.max(force.length());
            before = force;
        });
        assert!(largest > 0.5 && slid, "{name}: {largest} N, slid: {slid}");
        assert!(jump.0 < 0.03 * largest, "{name}: a jump of {jump:?} (N, s) where {largest} N is the most");
        assert_eq!(before, DVec3::ZERO, "{name} is still felt in the air");
        assert_eq!(sheet.tool_contact(0).unwrap().contact_state, ContactState::Free);
    }
}

#[test]
fn stiffness_converges_as_the_grid_gets_finer() {
    // The same tissue on finer grids: masses, anchor springs and damping scale with h², springs stay.
    let stiffness = |spacing_m: f64, points: usize| {
        let base = tissue("liver", &[]);
        let share = (spacing_m / base.scene.sheet().unwrap().spacing_m).powi(2);
        let model = tissue(
            "liver",
            &[
                &format!("sheet.points=[{points}, {points}]"),
                &format!("sheet.spacing_m={spacing_m}"),
                &format!("sheet.point_mass_kg={}", share * base.scene.sheet().unwrap().point_mass_kg),
                &format!("anchor_springs.stiffness_n_per_m={}", share * base.scene.anchor_stiffness_n_per_m),
                &format!("damping.coefficient_n_s_per_m={}", share * base.scene.damping_n_s_per_m),
            ],
        );
        let pressed = tangent::press(&model, 0.005, middle(&model), 0.0005, 2);
        pressed[1].force_n / pressed[1].depth_m
    };
    let found: Vec<f64> =
        [(0.005, 17), (0.0025, 33), (0.00125, 65)].iter().map(|&(h, points)| stiffness(h, points)).collect();
    assert!((found[2] - found[1]).abs() < 0.05 * found[2], "{found:?}");
    assert!((found[2] / 71.1 - 1.0).abs() < 0.15, "{found:?} beside the flat punch's 71.1 N/m");
}

#[test]
fn the_tissues_are_as_stiff_as_a_flat_punch_finds_them() {
    for (name, punch_n_per_m) in FLAT_PUNCH_N_PER_M {
        let model = tissue(name, &[]);
        let spacing_m = model.scene.sheet().unwrap().spacing_m;
        for beside in [DVec3::ZERO, DVec3::new(0.5, 0.5, 0.0) * spacing_m, DVec3::new(0.3 * spacing_m, 0.0, 0.0)] {
            let pressed = tangent::press(&model, 0.005, middle(&model) + beside, 0.0005, 3);
            let stiffness = pressed[1].force_n / pressed[1].depth_m;
            assert!((stiffness / punch_n_per_m - 1.0).abs() < 0.15, "{name}: {stiffness} N/m at 0.5 mm");
            if name == "fibrotic" {
                let stiffness = pressed[2].force_n / pressed[2].depth_m;
                assert!((stiffness / 400.0 - 1.0).abs() < 0.05, "{stiffness} N/m at 1 mm");
            }
        }
    }
}

#[test]
fn a_slow_press_feels_the_law_that_was_computed() {
    let model = tissue("liver", &[]);
    let law = force_law::exact(&model, 0.005);
    assert!(law.is_sound());
    let mut sheet = tissue::at_rest(&model);
    let way = |t: f64| middle(&model) + DVec3::new(0.0, 0.0, 0.001 - 0.009 * smooth(t / 1.5));
    lead(&mut *sheet, Tip::default(), 1700, way, |time_s, feel| {
        let depth_m = -feel.place_m.z;
        let row = law.at_depth(depth_m.max(0.0));
        let expected = row.force_n - row.damping_n_s_per_m * feel.velocity_m_per_s.z;
        if depth_m > 0.0005 {
            let found = feel.force_on_tool_n.z;
            assert!((found - expected).abs() < 0.02 * expected + 0.002, "{time_s} s: {found} N, by law {expected} N");
        }
    });
}

#[test]
fn a_grasp_pulls_as_well_as_it_pushes_and_a_touch_does_not() {
    let model = tissue("liver", &[]);
    let up = |t: f64| middle(&model) + DVec3::new(0.0, 0.0, 0.005 * smooth(t / 0.5));
    let force = |grasps: bool| {
        let mut sheet = tissue::at_rest(&model);
        let tip = Tip { grasps, ..Tip::default() };
        let mut last = DVec3::ZERO;
        lead(&mut *sheet, tip, 700, up, |_, feel| last = feel.force_on_tool_n);
        (last, sheet.tool_contact(0).unwrap().contact_state)
    };
    let (held, contact_state) = force(true);
    assert_eq!(contact_state, ContactState::Holding);
    assert!(held.z < -0.3, "a grasp that lifts is pulled down, but feels {held}");
    assert_eq!(force(false), (DVec3::ZERO, ContactState::Free));
}

#[test]
fn a_coupling_spring_is_felt_in_series_with_the_tissue() {
    let model = tissue("liver", &[]);
    let down = |t: f64| middle(&model) - DVec3::new(0.0, 0.0, 0.001 * smooth(t / 0.5));
    let force = |coupling: Coupling| {
        let mut sheet = tissue::at_rest(&model);
        let mut last = 0.0;
        lead(&mut *sheet, Tip { coupling, ..Tip::default() }, 900, down, |_, feel| last = feel.force_on_tool_n.z);
        (last, -sheet.tool_contact(0).unwrap().surface_m.z)
    };
    let (rigid_n, _) = force(Coupling::Constraint);
    for stiffness_n_per_m in [50.0, 500.0, 50_000.0] {
        let (coupled_n, depth_m) = force(Coupling::Spring { stiffness_n_per_m, damping_n_s_per_m: 0.1 });
        // The spring's force is its stiffness times the distance from the surface to the tool.
        let spring_n = stiffness_n_per_m * (0.001 - depth_m);
        assert!((coupled_n / spring_n - 1.0).abs() < 0.02, "{coupled_n} N, the spring {spring_n} N");
        assert!(coupled_n < rigid_n * 1.001, "{coupled_n} N is above {rigid_n} N");
    }
    let (stiff_n, _) = force(Coupling::Spring { stiffness_n_per_m: 50_000.0, damping_n_s_per_m: 0.1 });
    assert!((stiff_n / rigid_n - 1.0).abs() < 0.02, "{stiff_n} N beside {rigid_n} N");
}

#[test]
fn a_disc_that_slides_lags_by_what_its_coupling_spring_stretches() {
    let model = tissue("liver", &[]);
    let stiffness_n_per_m = 500.0;
    let coupling = Coupling::Spring { stiffness_n_per_m, damping_n_s_per_m: 0.1 };
    let tip = Tip { friction: 0.4, coupling, ..Tip::default() };
    let mut sheet = tissue::at_rest(&model);
    let from_m = middle(&model) - DVec3::new(0.012, 0.0, 0.0);
    let way =
        |t: f64| from_m + DVec3::new(0.024 * ((t - 0.4) / 0.8).clamp(0.0, 1.0), 0.0, 0.001 - 0.005 * smooth(t / 0.3));
    let mut looked = 0;
    lead(&mut *sheet, tip, 1200, way, |time_s, feel| {
        if time_s < 0.9 {
            return;
        }
        assert_eq!(feel.contact_state, ContactState::Sliding, "{time_s} s");
        let across = |v: DVec3| v - v.dot(feel.normal) * feel.normal;
        let (apart_m, felt_n) = (across(feel.place_m - feel.surface_m), across(feel.force_on_tool_n));
        let pressure_n = feel.force_on_tool_n.dot(feel.normal);
        assert!(
            (felt_n.length() - 0.4 * pressure_n).abs() < 1e-6 * pressure_n && felt_n.x < 0.0,
            "{time_s} s: {feel:?}"
        );
        let left_n = stiffness_n_per_m * apart_m + felt_n;
        assert!(left_n.length() < 0.1 * felt_n.length(), "{time_s} s: {apart_m} m apart under {felt_n} N");
        looked += 1;
    });
    assert!(looked > 200);
}

#[test]
fn two_tools_press_one_tissue_each_for_itself() {
    let model = tissue("liver", &[]);
    let mut sheet = tissue::at_rest(&model);
    for step in 1..=800 {
        let down = 0.003 * smooth(f64::from(step) * 1e-3 / 0.5);
        for (tool, x) in [(0, -0.018), (1, 0.018)] {
            sheet.pose(tool, middle(&model) + DVec3::new(x, 0.0, -down), Tip::default());
        }
        sheet.step().unwrap();
    }
    let [a, b] = [0, 1].map(|tool| sheet.tool_contact(tool).unwrap().force_on_tool_n);
    assert!((a.z - b.z).abs() < 1e-3 * a.z && (a.x + b.x).abs() < 1e-3 * a.z, "{a} and {b} are not mirror images");
    let alone = tangent::press(&model, 0.005, middle(&model), 0.003, 2)[1].force_n;
    assert!((a.z / alone - 1.0).abs() < 0.1, "{} N beside another tool, {alone} N alone", a.z);
    sheet.release(1);
    sheet.step().unwrap();
    assert!(sheet.tool_contact(1).is_none());
}

/// In the plane, the presets' lattice is an isotropic sheet with ν = 1/3: under even strain it stays even and pulls
/// with E·t per metre, minus the springs of its two free sides, which belong to only half a cell.
#[test]
fn the_lattice_passes_the_patch_test() {
    let model = tissue(
        "liver",
        &["sheet.points=[9, 9]", "sheet.fixed=[]", "anchor_springs.stiffness_n_per_m=0.0", "stepping.precision=f64"],
    );
    let (strain, contraction) = (1e-4, -1e-4 / 3.0);
    let spacing_m = model.scene.sheet().unwrap().spacing_m;
    let even =
        |[i, j]: [usize; 2]| spacing_m * DVec3::new(strain * (i as f64 - 4.0), contraction * (j as f64 - 4.0), 0.0);
    let mut sheet = tissue::at_rest(&model);
    let rim = |[i, j]: [usize; 2]| i % 8 == 0 || j % 8 == 0;
    let mut tool = 0;
    for point in model.points() {
        let place = model.scene.sheet().unwrap().place_of(point);
        if rim(place) {
            sheet.grasp(tool, point, tissue::Grasp::Target(even(place)));
            tool += 1;
        }
    }
    for _ in 0..3000 {
        sheet.step().unwrap();
    }
    let mut pull_n = 0.0;
    for point in model.points() {
        let (point, state) = (model.scene.sheet().unwrap().place_of(point), sheet.point(point));
        let off = (state.displacement_m - even(point)).length();
        assert!(off < 1e-3 * strain * spacing_m, "{point:?} is {off} m off");
        if point[0] == 8 {
            pull_n += state.constraint_n.unwrap().x;
        }
    }
    let [structural, width_m] = [model.scene.springs.stiffness_n_per_m, 8.0 * spacing_m];
    let expected_n = 5400.0 * 0.01 * strain * width_m + structural * strain * spacing_m;
    assert!((pull_n / expected_n - 1.0).abs() < 2e-3, "{pull_n} N, expected {expected_n} N");
}

#[test]
fn a_touch_beside_the_sheet_or_far_above_feels_nothing() {
    let model = tissue("liver", &[]);
    let extent = model.scene.sheet().unwrap().extent_m();
    for place in
        [DVec3::new(-0.02, 0.02, -0.01), (extent + DVec2::splat(0.02)).extend(-0.01), (extent / 2.0).extend(0.05)]
    {
        let mut sheet = tissue::at_rest(&model);
        lead(
            &mut *sheet,
            Tip::default(),
            50,
            |_| place,
            |_, feel| {
                assert_eq!((feel.force_on_tool_n, feel.contact_state), (DVec3::ZERO, ContactState::Free));
            },
        );
        assert!(sheet.largest_displacement_m() < 1e-12);
    }
}

/// Of a disc that lies almost wholly on fixed points, the force was that of the few others times one over the square of their
/// part: newtons to 1e22 N.
#[test]
fn a_tip_beside_what_is_fixed_feels_no_more_than_springs_and_depth_allow() {
    let depth_m = 0.002;
    let model = tissue("liver", &["sheet.fixed=edges"]);
    let extent_m = model.scene.sheet().unwrap().extent_m();
    let pressed = |place_m: DVec3, grasps: bool, radius_m: f64| {
        let mut sheet = tissue::at_rest(&model);
        let tip = Tip { grasps, radius_m, friction: 0.0, ..Tip::default() };
        lead(&mut *sheet, tip, 600, |t| place_m - depth_m * smooth(t / 0.3) * DVec3::Z, |_, _| {});
        assert_eq!(sheet.guard_events(), 0, "{place_m}");
        sheet.tool_contact(0).unwrap()
    };
    for radius_m in [0.001, 0.005] {
        for grasps in [false, true] {
            // A quarter of a disc moves at most four times as far as the tool, and its force counts four times.
            let scene = &model.scene;
            let stiffness_n_per_m = 8.0 * scene.springs.stiffness_n_per_m + scene.anchor_stiffness_n_per_m;
            let most_n = 16.0 * stiffness_n_per_m * depth_m;
            let mut told = 0;
            for from_rim_m in [0.0, 1e-6, 1e-5, 1e-4, 3e-4, 1e-3, 2e-3, 4e-3] {
                for place_m in [DVec3::new(from_rim_m, 0.4 * extent_m.y, 0.0), DVec3::new(from_rim_m, from_rim_m, 0.0)]
                {
                    let feel = pressed(place_m, grasps, radius_m);
                    let force_n = feel.force_on_tool_n.length();
                    // A quarter of a disc moves at most four times as far as the tool.
                    assert!(force_n < most_n, "{radius_m}, {place_m}: {force_n} N of {most_n} N");
                    told += u32::from(feel.is_on_fixed);
                }
            }
            assert!(told > 4, "{told}");
            assert!(!pressed(middle(&model), grasps, radius_m).is_on_fixed);
        }
    }
}
