//! Tests of the energy of a cut: what a blade puts in is found again.
#![allow(clippy::unwrap_used)]

use glam::DVec3;

use crate::Model;
use crate::interface::Tissue;
use crate::kernel::real::Real;
use crate::state::tissue_state::TissueState;
use palpate_haptics::{Tip, TipShape};

/// A block of 100 × 100 × 40 mm on a table, of cubes of 10 mm.
const BLOCK: &str = "[solid]\norgan = { name = \"phantom\", edge_m = 0.008, seed = 1 }\ncell_m = 0.01\n\
                     fixed = [{ plane_m = [0, 0, 0], normal = [0, 0, 1], within_m = 0.001 }]\n\
                     [material]\nyoungs_modulus_pa = 15e3\npoissons_ratio = 0.4\ndensity_kg_per_m3 = 980\n\
                     viscosity_pa_s = 0\ndamping_per_s = 60\n[cutting]\ntoughness_j_per_m2 = 20\n";

/// A blade with an upright edge of 60 mm.
fn blade() -> Tip {
    Tip { shape: TipShape::Blade, radius_m: 0.001, edge_m: 0.06 * DVec3::Z, ..Tip::default() }
}

/// Returns the power that damping takes, W.
fn damping_w(tissue: &TissueState<f64>) -> f64 {
    let TissueState { model, tables, state, plan, .. } = tissue;
    let speed = model.unit_m / plan.substep_s;
    let of = |place: usize| {
        let v_m_per_s = |c: usize| speed * state.d[c * tables.layout.plane + tables.layout.offset(place)].wide();
        tables.relative_mass_at(model, place) * (0..3).map(|c| v_m_per_s(c).powi(2)).sum::<f64>()
    };
    model.scene.damping_n_s_per_m * (0..model.place_count()).map(of).sum::<f64>()
}

#[test]
fn the_work_of_a_blade_is_that_of_separation_and_what_the_tissue_keeps_or_loses_by_damping() {
    let block = Model::parse("block", BLOCK, &["stepping.precision=f64"]).unwrap();
    // Along y, from the rim inward: begin and way, m.
    for (kind, model, from_m, way_m) in [
        (
            "sheet",
            super::liver(&["sheet.points=[21, 25]", "stepping.precision=f64", "cutting.toughness_j_per_m2=20"]),
            DVec3::new(0.02625, 0.008, -0.005),
            0.036,
        ),
        ("solid", block, DVec3::new(0.002, -0.052, 0.02), 0.06),
    ] {
        let mut tissue = TissueState::<f64>::new(&model);
        let rate_hz = model.scene.stepping.rate_hz;
        let steps = 2000_u32;
        let (mut work_j, mut damped_j) = (0.0, 0.0);
        let (mut before_n, mut before_w) = (DVec3::ZERO, 0.0);
        for step in 0..=steps {
            let by_m = way_m * f64::from(step) / f64::from(steps) * DVec3::Y;
            tissue.pose(0, from_m + by_m, blade());
            tissue.step().unwrap();
            let contact = tissue.tool_contact(0).unwrap();
            let (force_n, power_w) = (-contact.force_on_tool_n, damping_w(&tissue));
            work_j += 0.5 * (force_n + before_n).dot(contact.velocity_m_per_s) / rate_hz;
            damped_j += 0.5 * (power_w + before_w) / rate_hz;
            (before_n, before_w) = (force_n, power_w);
        }
        let energy = tissue.energy();
        let coupled_j = tissue.contacts.coupling_j(&model, &tissue.tables.layout, &tissue.state);
        let kept_j = energy.kinetic_j + energy.spring_j + energy.anchor_j + coupled_j;
        let fracture_j = tissue.cuts().fracture_j();
        assert!(fracture_j > 0.5 * work_j && tissue.cuts().len() > 5, "{kind}: {fracture_j} J of {work_j} J");
        let found_j = fracture_j + kept_j + damped_j;
        assert!((found_j / work_j - 1.0).abs() < 0.01, "{kind}: {found_j} J of {work_j} J");
    }
}

/// The shipped organ, 180 mm wide.
const ORGAN: &str = include_str!("../../../../../../scenes/liver-organ.toml");

#[test]
fn a_blade_that_enters_an_organ_from_any_side_does_not_look_like_energy_from_nowhere() {
    let sets = ["mesh.organ={ name = \"liver\", edge_m = 0.004, seed = 1 }", "cutting.toughness_j_per_m2=187"];
    let model = Model::parse("liver-organ", ORGAN, &sets).unwrap();
    let extent = model.shape().extent();
    let (middle_m, across_m) = (extent.middle_m(), extent.size_m());
    for seed in 0..8 {
        let mut random = fastrand::Rng::with_seed(seed);
        let mut within = |part: f64| part * across_m * DVec3::from_array([(); 3].map(|()| random.f64() - 0.5));
        let (begin_m, through_m) = (middle_m + within(1.5), middle_m + within(0.7));
        let edge = within(1.0).normalize();
        let mut tissue = TissueState::<f32>::new(&model);
        let tip = Tip { edge_m: 0.06 * edge, ..blade() };
        for step in 0..1500_u32 {
            tissue.pose(0, begin_m.lerp(through_m, f64::from(step) / 750.0), tip);
            tissue.step().unwrap_or_else(|found| panic!("seed {seed}, {} cut: {found:?}", tissue.cuts().len()));
        }
    }
}
