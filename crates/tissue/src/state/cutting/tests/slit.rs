//! Tests of a slit in a sheet under tension: how far it opens.
//!
//! `PALPATE_CRACK_CELLS` is half its length in springs.
#![allow(clippy::unwrap_used, clippy::cast_precision_loss)]

use std::fmt::Write;
use std::sync::Arc;

use glam::DVec3;

use crate::limits::Limits;
use crate::scene::Scene;
use crate::{Model, at_rest};
use palpate_haptics::{Tip, TipShape};

/// The distance of points, and the tension of the sheet, N/m.
const SPACING_M: f64 = 0.001;
const TENSION_N_PER_M: f64 = 0.4;

/// Young's modulus times thickness, N/m.
const STIFFNESS_N_PER_M: f64 = 100.0;

/// Returns a surface of equal triangles, or of triangles whose corners are moved at random, held at its rim; it is `width` triangles wide
/// and as high.
fn surface(width: usize, jitter: f64) -> Arc<Model> {
    let rise_m = 0.75_f64.sqrt() * SPACING_M;
    let rows = 2 * (width as f64 * SPACING_M / rise_m / 2.0).round() as usize;
    let mut random = fastrand::Rng::with_seed(7);
    let mut mesh = String::new();
    for row in 0..rows {
        for column in 0..=width {
            let is_rim = row == 0 || row + 1 == rows || column == 0 || column == width;
            let mut moved = || if is_rim { 0.0 } else { jitter * SPACING_M * (2.0 * random.f64() - 1.0) };
            let at_m = SPACING_M * (column as f64 + if row % 2 == 0 { 0.0 } else { 0.5 });
            writeln!(mesh, "v {:?} {:?} 0", at_m + moved(), row as f64 * rise_m + moved()).unwrap();
        }
    }
    let vertex = |row: usize, column: usize| row * (width + 1) + column + 1;
    for (row, column) in (1..rows).flat_map(|row| (0..width).map(move |column| (row - 1, column))) {
        let [a, b, c, d] = [[0, 0], [0, 1], [1, 0], [1, 1]].map(|[up, on]| vertex(row + up, column + on));
        let triangles = if row % 2 == 0 { [[a, b, c], [b, d, c]] } else { [[a, b, d], [a, d, c]] };
        triangles.iter().for_each(|[a, b, c]| writeln!(mesh, "f {a} {b} {c}").unwrap());
    }
    // The foundation damps; against the tension of a slit it is weak.
    let text = format!(
        "[mesh]\nfile = \"slit.obj\"\nunit = \"m\"\nfixed = \"rim\"\n[material]\nyoungs_modulus_pa = 1e5\n\
         thickness_m = {:?}\nfoundation_n_per_m3 = 100\ndamping_ratio = 100\ndensity_kg_per_m3 = 1000\ndepth_m = 3e-4\n\
         [springs]\nbending = 0\npretension_n_per_m = {TENSION_N_PER_M}\n\
         [stepping]\nrate_hz = 10000\nprecision = \"f64\"\ntolerance = 1e-3\n[sleep]\ntolerance = 0\n",
        STIFFNESS_N_PER_M / 1e5
    );
    let scene = Scene::parse_given("slit", &text, ("slit.obj", mesh.as_bytes()), &Limits::default()).unwrap();
    Model::compile(&scene, &Limits::default()).unwrap()
}

/// A slit of the half length c opens by 4·T₀·c/(E·t) in its middle (Inglis 1913). (A rim that is held makes it stiffer:
/// 5 c from the middle by 7 %, 7 c by 4 %.)
#[test]
fn a_slit_opens_as_inglis_says_also_where_points_are_uneven() {
    let half: usize = std::env::var("PALPATE_CRACK_CELLS").map_or(10, |cells| cells.parse().unwrap());
    let width = if half > 10 { 20 } else { 14 } * half;
    for jitter in if half > 10 { vec![0.0, 0.2] } else { vec![0.2] } {
        let model = surface(width, jitter);
        let mut tissue = at_rest(&model);
        (0..20).for_each(|_| tissue.step().unwrap());
        assert_eq!(tissue.largest_displacement_m(), 0.0);
        let middle_m = model.shape().extent().middle_m();
        let half_m = SPACING_M * half as f64;
        let blade = Tip { shape: TipShape::Blade, radius_m: 0.001, edge_m: 0.02 * DVec3::Z, ..Tip::default() };
        for step in 0..=40 {
            let along_m = half_m * (f64::from(step) / 20.0 - 1.0);
            tissue.pose(0, middle_m + DVec3::new(along_m, 0.0, -0.01), blade);
            tissue.step().unwrap();
        }
        tissue.release(0);
        (0..90 * half).for_each(|_| tissue.step().unwrap());
        let joints = tissue.cuts().joints(&model);
        let (mut lips_m, mut counts) = ([0.0; 2], [0.0; 2]);
        for point in joints.iter().flat_map(|joint| joint.points) {
            let from_m = model.shape().rest_m(point) - middle_m;
            if from_m.x.abs() < 0.15 * half_m {
                let side = usize::from(from_m.y > 0.0);
                lips_m[side] += tissue.point(point).displacement_m.y;
                counts[side] += 1.0;
            }
        }
        let opening_m = lips_m[1] / counts[1] - lips_m[0] / counts[0];
        // Two springs cross each spacing.
        let slit_m = SPACING_M * joints.len() as f64 / 4.0;
        let expected_m = 4.0 * TENSION_N_PER_M * slit_m / STIFFNESS_N_PER_M;
        let ratio = opening_m / expected_m;
        println!("jitter {jitter}, c = {:.2} springs: {ratio:.4} of the closed form", slit_m / SPACING_M);
        let most = if half >= 20 { 0.05 } else { 0.1 };
        assert!((ratio - 1.0).abs() < most, "jitter {jitter}: {opening_m} m, {expected_m} m");
    }
}
