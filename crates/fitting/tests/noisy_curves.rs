//! Curves of a known tissue with noise give that tissue back, as often as the intervals say.
#![allow(clippy::unwrap_used, clippy::disallowed_methods)]

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use fastrand::Rng;
use palpate_fitting::curve_file::MeasuredCurve;
use palpate_fitting::fit::{Fit, fit};
use palpate_fitting::options::FitOptions;
use palpate_haptics::TipShape;
use palpate_session::press::ImposedPress;
use palpate_session::simulation::SimulationFailure;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::collection::find_scene;
use palpate_tissue::scene::tissue_parameter::TissueParameter;
use palpate_tissue::scene::{Named, Scene};

/// Standard deviation of the noise, of the largest force.
const NOISE: f64 = 0.02;

fn scene(name: &str, sets: &[&str]) -> Scene {
    let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
    find_scene(name.as_ref(), "scenes".as_ref(), &sets, &Limits::default()).unwrap()
}

/// A press in `into_s` to a depth, which is held for `holds_s`, in samples of `every_s`.
fn ramp(shape: TipShape, radius_m: f64, depth_m: f64, [into_s, holds_s, every_s]: [f64; 3]) -> ImposedPress {
    let samples = ((into_s + holds_s) / every_s).round() as usize;
    let time_s: Vec<f64> = (0..=samples).map(|k| every_s * k as f64).collect();
    let depth_m = time_s.iter().map(|time_s| depth_m * (time_s / into_s).min(1.0)).collect();
    ImposedPress { place_m: None, shape, radius_m, time_s, depth_m }
}

/// A press that vibrates about a depth by an amplitude.
fn vibration(shape: TipShape, radius_m: f64, [depth_m, amplitude_m]: [f64; 2], frequency_hz: f64) -> ImposedPress {
    let time_s: Vec<f64> = (0..=100).map(|k| 0.001 * k as f64).collect();
    let turn = |time_s: &f64| (std::f64::consts::TAU * frequency_hz * time_s).cos();
    let depth_m = time_s.iter().map(|time_s| depth_m - amplitude_m * turn(time_s)).collect();
    ImposedPress { place_m: None, shape, radius_m, time_s, depth_m }
}

/// Curves of a tissue, and what fits them.
struct Case {
    truth: Scene,
    start: Arc<Model>,
    presses: Vec<ImposedPress>,
    forces_n: Vec<Vec<f64>>,
    parameters: Vec<TissueParameter>,
}

impl Case {
    /// The fit begins with `factors` of the true values.
    fn new(truth: Scene, presses: Vec<ImposedPress>, factors: &[(TissueParameter, f64)]) -> Self {
        let model = Model::compile(&truth, &Limits::default()).unwrap();
        let run = |press: &ImposedPress| press.forces_n(&model, &Limits::default(), &AtomicBool::new(false)).unwrap();
        let forces_n = presses.iter().map(run).collect();
        let begun = factors.iter().fold(truth.clone(), |scene, (parameter, factor)| {
            parameter.set(&scene, factor * parameter.value(&truth).unwrap()).unwrap()
        });
        let start = Model::compile(&begun, &Limits::default()).unwrap();
        Case { truth, start, presses, forces_n, parameters: factors.iter().map(|factor| factor.0).collect() }
    }

    fn curves(&self, seed: u64) -> Vec<MeasuredCurve> {
        self.noisy(seed, &vec![NOISE; self.presses.len()])
    }

    /// The curves, each with its noise, of the largest force of all.
    fn noisy(&self, seed: u64, noise: &[f64]) -> Vec<MeasuredCurve> {
        let mut random = Rng::with_seed(seed);
        // Box and Muller, 1958.
        let mut normal = || (-2.0 * (1.0 - random.f64()).ln()).sqrt() * (std::f64::consts::TAU * random.f64()).cos();
        let largest_n = self.forces_n.iter().flatten().fold(0.0_f64, |largest, force_n| largest.max(*force_n));
        let noisy = |((press, forces_n), noise): ((&ImposedPress, &Vec<f64>), &f64)| MeasuredCurve {
            name: String::new(),
            press: press.clone(),
            force_n: forces_n.iter().map(|force_n| force_n + noise * largest_n * normal()).collect(),
        };
        self.presses.iter().zip(&self.forces_n).zip(noise).map(noisy).collect()
    }

    fn fit(&self, seed: u64, parameters: &[TissueParameter]) -> Result<Fit, SimulationFailure> {
        self.fit_to(&self.curves(seed), parameters)
    }

    fn fit_to(&self, curves: &[MeasuredCurve], parameters: &[TissueParameter]) -> Result<Fit, SimulationFailure> {
        let limits = Limits::default();
        let options = FitOptions { parameters, threads: 2, limits: &limits, stop: &AtomicBool::new(false) };
        fit(&self.start, curves, &options, &mut |_| {})
    }

    /// Fits `seeds` noises; prints how often each parameter is within its interval, its largest error. Returns the least share, and the largest error of `of`.
    fn recover(&self, what: &str, of: TissueParameter, seeds: u64) -> (f64, f64) {
        let begun = Instant::now();
        let mut parameters = self.parameters.clone();
        parameters.sort_by_key(|of| TissueParameter::NAMES.iter().position(|entry| entry.1 == *of));
        let (mut within, mut worst, mut width) = (vec![0_u32; 8], vec![0.0_f64; 8], vec![0.0_f64; 8]);
        let mut runs = 0;
        for seed in 0..seeds {
            let fit = self.fit(seed, &self.parameters).unwrap();
            runs += fit.runs;
            for (index, found) in fit.parameters.iter().enumerate() {
                let truth = found.parameter.value(&self.truth).unwrap();
                let [low, high] = found.interval;
                within[index] += u32::from(low <= truth && truth <= high);
                worst[index] = worst[index].max((found.value / truth - 1.0).abs());
                width[index] = width[index].max((high - low) / 2.0 / truth);
            }
        }
        for (index, parameter) in parameters.iter().enumerate() {
            println!(
                "{what} {}: {} of {seeds} within the interval, largest error {:.2} %, interval up to ±{:.2} %",
                parameter.name(),
                within[index],
                100.0 * worst[index],
                100.0 * width[index]
            );
        }
        let wall_s = begun.elapsed().as_secs_f64() / seeds as f64;
        println!(
            "{what}: {} points, {} substeps, {} runs and {wall_s:.2} s a fit",
            self.start.len(),
            self.start.plan.substeps,
            runs / seeds
        );
        let least = within[..parameters.len()].iter().min().unwrap();
        let of = parameters.iter().position(|parameter| *parameter == of).unwrap();
        (f64::from(*least) / seeds as f64, worst[of])
    }
}

use TissueParameter as P;

fn at_the_root() {
    std::env::set_current_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/../..")).unwrap();
}

/// A liver under two tips, slowly and with vibration.
fn sheet() -> Case {
    let truth = scene("liver", &["stepping.tolerance=1e-5"]);
    let presses = vec![
        ramp(TipShape::Disc, 0.005, 0.008, [0.1, 0.0, 0.001]),
        ramp(TipShape::Disc, 0.015, 0.008, [0.1, 0.0, 0.001]),
        vibration(TipShape::Disc, 0.010, [0.003, 0.002], 20.0),
    ];
    Case::new(truth, presses, &[(P::SpringStiffness, 0.4), (P::AnchorStiffness, 2.0), (P::Damping, 3.0)])
}

/// A capsule on a foundation, which carries most of a touch: the curves tell E of the capsule weakly.
fn surface() -> Case {
    let text = "[mesh]\norgan = { name = \"gallbladder\", edge_m = 0.003, seed = 1 }\n[material]\nyoungs_modulus_pa = 85e3\n\
                thickness_m = 0.002\nfoundation_n_per_m3 = 1.34e6\ndamping_ratio = 0.5\n[stepping]\ntolerance = 1e-3\n";
    let truth = Scene::parse("surface", text, &[], &Limits::default()).unwrap();
    let presses = vec![
        ramp(TipShape::Disc, 0.005, 0.005, [0.1, 0.0, 0.001]),
        ramp(TipShape::Disc, 0.015, 0.005, [0.1, 0.0, 0.001]),
        vibration(TipShape::Disc, 0.010, [0.003, 0.002], 20.0),
    ];
    Case::new(truth, presses, &[(P::YoungsModulus, 0.4), (P::Foundation, 2.0), (P::DampingRatio, 3.0)])
}

/// A block of silicone, 40 mm thick, under a small tip that goes in deep, and under one that is as wide as the block is thick: this one
/// goes in and then vibrates. Coarse triangles make a wide tip fast.
fn solid(cell: &str) -> Case {
    let truth = scene("phantom", &[cell, "solid.organ.edge_m=0.008", "material.viscosity_pa_s=5.0"]);
    let mut wide = ramp(TipShape::RigidDisc, 0.045, 0.003, [0.05, 0.1, 0.001]);
    for (time_s, depth_m) in wide.time_s.iter().zip(&mut wide.depth_m) {
        *depth_m += 0.001 * (std::f64::consts::TAU * 20.0 * (time_s - 0.05).max(0.0)).sin();
    }
    let presses = vec![ramp(TipShape::RigidDisc, 0.008, 0.010, [0.1, 0.0, 0.001]), wide];
    Case::new(truth, presses, &[(P::YoungsModulus, 0.3), (P::PoissonsRatio, 0.7), (P::Viscosity, 0.05)])
}

#[test]
fn the_stiffness_of_a_sheet_and_of_a_solid_is_given_back_within_its_interval() {
    at_the_root();
    let slowly = [0.1, 0.0, 0.001];
    let on_sheet = vec![ramp(TipShape::Disc, 0.010, 0.004, slowly)];
    let on_solid = vec![ramp(TipShape::RigidDisc, 0.012, 0.003, slowly)];
    let coarse = scene("phantom", &["solid.cell_m=0.013"]);
    for (what, truth, presses, factor) in [
        ("sheet", scene("liver", &[]), on_sheet, (P::AnchorStiffness, 2.0)),
        ("solid", coarse, on_solid, (P::YoungsModulus, 0.3)),
    ] {
        let (share, error) = Case::new(truth, presses, &[factor]).recover(what, factor.0, 1);
        assert!(share == 1.0 && error < 0.03, "{what}: {share}, {error}");
    }
}

/// A machine that shakes during one of two presses: the other one tells as much as it does alone, and each noise is found.
#[test]
fn a_noisy_curve_beside_a_quiet_one_takes_nothing_from_it() {
    at_the_root();
    let press = |radius_m| ramp(TipShape::Disc, radius_m, 0.004, [0.1, 0.0, 0.001]);
    let case = Case::new(scene("liver", &[]), vec![press(0.010), press(0.012)], &[(P::AnchorStiffness, 2.0)]);
    let curves = case.noisy(3, &[0.2, 0.005]);
    let largest_n = case.forces_n.iter().flatten().fold(0.0_f64, |largest, force_n| largest.max(*force_n));
    let both = case.fit_to(&curves, &case.parameters).unwrap();
    let alone = case.fit_to(&curves[1..], &case.parameters).unwrap();
    let truth = P::AnchorStiffness.value(&case.truth).unwrap();
    let width = |fit: &Fit| (fit.parameters[0].interval[1] - fit.parameters[0].interval[0]) / truth;
    let noise: Vec<f64> = both.noise_of_curves_n.iter().map(|noise_n| noise_n / largest_n).collect();
    println!("noise {noise:?}, intervals {} and {}, {} runs", width(&both), width(&alone), both.runs);
    assert!((noise[0] / 0.2 - 1.0).abs() < 0.25 && (noise[1] / 0.005 - 1.0).abs() < 0.25, "{noise:?}");
    assert!(width(&both) < 1.1 * width(&alone), "{} {}", width(&both), width(&alone));
    let [low, high] = both.parameters[0].interval;
    assert!(low <= truth && truth <= high, "{:?}", both.parameters);
}

/// Fits 50 noises, or `PALPATE_FIT_SEEDS`, and checks how often the truth is within the 95 % intervals, and the largest error of a
/// stiffness.
fn recovered(what: &str, case: &Case, (of, largest): (TissueParameter, f64)) {
    let seeds = std::env::var("PALPATE_FIT_SEEDS").map_or(50, |seeds| seeds.parse().unwrap());
    let (share, error) = case.recover(what, of, seeds);
    assert!(share >= 0.9 && error < largest, "{what}: {share}, {error}");
}

#[test]
#[ignore = "takes minutes"]
fn fifty_noises_of_a_sheet_are_within_the_intervals_as_often_as_these_say() {
    at_the_root();
    recovered("sheet", &sheet(), (P::AnchorStiffness, 0.03));
}

#[test]
#[ignore = "takes minutes"]
fn fifty_noises_of_a_surface_are_within_the_intervals_as_often_as_these_say() {
    at_the_root();
    recovered("surface", &surface(), (P::Foundation, 0.03));
}

#[test]
#[ignore = "takes minutes"]
fn fifty_noises_of_a_solid_are_within_the_intervals_as_often_as_these_say() {
    at_the_root();
    recovered("solid", &solid("solid.cell_m=0.013"), (P::YoungsModulus, 0.03));
}

#[test]
#[ignore = "takes minutes"]
fn a_solid_of_3000_cells_is_given_back() {
    at_the_root();
    let case = solid("solid.cell_m=0.0055");
    println!("{:?} cells", case.truth.body.kind().cells());
    let (share, error) = case.recover("solid of 3,000 cells", P::YoungsModulus, 1);
    assert!(share > 0.0 && error < 0.03, "{share}, {error}");
}
