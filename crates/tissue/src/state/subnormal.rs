//! Tests that a tissue which rings down has no values so small that the processor handles them slowly.
#![allow(clippy::unwrap_used)]

use glam::DVec3;

use crate::kernel::real::Real;
use crate::limits::Limits;
use crate::scene::profile::Poke;
use crate::scene::{PAPER, Scene};
use crate::state::tissue_state::TissueState;
use crate::{Model, Push, Tissue};

/// Counts the nonzero values below `least` among the displacements, and in the rest of the state.
fn too_small<T: Real>(sheet: &TissueState<T>, least: f64) -> [usize; 2] {
    let small = |value: &&T| **value != T::default() && value.wide().abs() < least;
    let mut counts = sheet.state.fields().map(|field| field.iter().filter(small).count());
    [counts.next().unwrap(), counts.sum()]
}

/// `CUTS_U`: the scheme cuts displacements as well as increments.
fn rings_down<T: Real, const CUTS_U: bool>(sets: &[&str]) {
    for lanes in ["plain", "neon", "avx2", "avx512"] {
        let mut settings: Vec<String> = sets.iter().map(|text| (*text).to_owned()).collect();
        settings.extend([format!("stepping.lanes={lanes}"), "sheet.points=[5, 19]".to_owned()]);
        settings.extend(["sleep.tolerance=0.0", "damping.coefficient_n_s_per_m=0.5"].map(str::to_owned));
        let scene = Scene::parse("paper", PAPER, &settings, &Limits::default()).unwrap();
        // Skip lanes that this machine does not have.
        let Ok(model) = Model::compile(&scene, &Limits::default()) else { continue };
        let mut sheet = TissueState::<T>::new(&model);
        let poke = Poke {
            point: None,
            centre_m: scene.shape().edge_m() * DVec3::new(2.0, 7.0, 0.0),
            force_n: DVec3::new(0.2, -0.1, 1.0),
            falloff_per_m: 1.0 / (1.3 * scene.shape().edge_m()),
            falloff_offset: 0.0,
        };
        sheet.push(0, Some(Push::Constant(poke)));
        (0..50).for_each(|_| sheet.step().unwrap());
        sheet.push(0, None);
        // From 1 down to what rounding and the smallest number that counts leave of a vibration.
        let (mut passed, mut cancelled) = (0, 0);
        for step in 0.. {
            sheet.step().unwrap();
            let [displacements, others] = too_small(&sheet, T::MIN_MAGNITUDE);
            assert_eq!(others, 0, "{sets:?}, {lanes}, step {step}");
            if CUTS_U {
                assert_eq!(displacements, 0, "{sets:?}, {lanes}, step {step}");
            }
            // A sum of increments that count is either 0 or at least the last digit of the smallest of them.
            assert_eq!(too_small(&sheet, T::MIN_MAGNITUDE * T::EPSILON), [0; 2], "{sets:?}, {lanes}, step {step}");
            cancelled += displacements;
            let largest = sheet.state.u.iter().map(|value| value.wide().abs()).fold(0.0, f64::max);
            passed += usize::from(largest < 1e6 * T::MIN_MAGNITUDE);
            if passed == 500 {
                assert!(100_000 * cancelled < step * 3 * model.len(), "{sets:?}, {lanes}: {cancelled} in {step} steps");
                break;
            }
            assert!(step < 60_000, "{sets:?}, {lanes}: {largest:e} is left");
        }
    }
}

#[test]
fn a_field_that_decays_has_no_number_whose_square_is_below_the_normal_range() {
    rings_down::<f32, false>(&["stepping.integrator=central", "stepping.precision=f32"]);
    rings_down::<f32, false>(&["stepping.integrator=lagged", "stepping.precision=f32", "springs.bending=true"]);
    rings_down::<f32, true>(&["stepping.integrator=rk4", "stepping.precision=f32"]);
    rings_down::<f32, true>(&["stepping.integrator=exponential3", "stepping.precision=compensated"]);
    rings_down::<f64, true>(&["stepping.integrator=exponential2", "stepping.precision=f64"]);
}
