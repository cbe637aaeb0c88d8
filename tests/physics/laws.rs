//! Laws of nature that the sheet obeys.

use crate::common::{SMALL, advance, model, playing, push_on, scene, scene_with, schemes, script};
use glam::DVec3;
use palpate_session::Session;
use palpate_tissue::scene::Scene;
use palpate_tissue::scene::profile::{LoadProfile, Moment};
use palpate_tissue::shape::PointId;
use palpate_tissue::{self as tissue, Energy, Grasp, Tissue};

/// A tissue in motion: pushed at a point for some steps, then released.
fn shaken(scene: &Scene, steps: u64) -> Box<dyn Tissue> {
    let mut tissue = tissue::at_rest(&model(scene));
    tissue.push(0, Some(push_on(scene, [3, 2], [0.4, 0.3, -0.6])));
    for _ in 0..steps {
        tissue.step().unwrap();
    }
    tissue.release(0);
    tissue.step().unwrap();
    tissue
}

fn total_j(energy: Energy) -> f64 {
    energy.kinetic_j + energy.spring_j + energy.anchor_j
}

/// The closed form of m·a + C·v + K·u = F from rest: displacement and velocity.
fn oscillator(m: f64, c: f64, k: f64, f: f64, t: f64) -> (f64, f64) {
    let (decay, square) = (c / (2.0 * m), k / m - (c / (2.0 * m)).powi(2));
    let rest = f / k;
    if square > 0.0 {
        let w = square.sqrt();
        let (sin, cos) = (w * t).sin_cos();
        let envelope = (-decay * t).exp();
        (rest * (1.0 - envelope * (cos + decay / w * sin)), rest * envelope * (w + decay * decay / w) * sin)
    } else {
        let root = (-square).sqrt();
        let (fast, slow) = (-decay - root, -decay + root);
        let (a, b) = (slow / (fast - slow), -fast / (fast - slow));
        (
            rest * (1.0 + a * (fast * t).exp() + b * (slow * t).exp()),
            rest * (a * fast * (fast * t).exp() + b * slow * (slow * t).exp()),
        )
    }
}

#[test]
fn a_point_without_springs_is_the_damped_oscillator() {
    let (mass, anchor_stiffness) = (0.02, 5.0);
    // Under-, nearly critically and overdamped.
    for damping in [0.0, 0.2, 0.63, 6.0] {
        let set = format!("damping.coefficient_n_s_per_m={damping}");
        let mut errors = Vec::new();
        for rate_hz in [1000.0, 4000.0] {
            let rate = format!("stepping.rate_hz={rate_hz}");
            let error = |integrator: &str| {
                let integrator = format!("stepping.integrator={integrator}");
                let sets = [&set, &rate, &integrator, "springs.stiffness_n_per_m=0.0", "stepping.substeps=1"];
                let scene = scene_with(SMALL, &sets);
                let mut session = Session::new(&model(&scene));
                session.play_force(0, constant(&scene, [3, 2], DVec3::new(0.1, 0.0, -0.2)));
                let mut largest = [0.0_f64; 2];
                // At the same times for both rates: the error is largest in the first milliseconds.
                for _ in 0..1000 {
                    advance(&mut session, (rate_hz / 1000.0) as u64);
                    let point = session.tissue().point(session.model().scene.sheet().unwrap().point([3, 2]));
                    let (u, v) = oscillator(mass, damping, anchor_stiffness, -0.2, session.time_s());
                    largest[0] = largest[0].max((point.displacement_m.z - u).abs());
                    largest[1] = largest[1].max((point.velocity_m_per_s.z - v).abs());
                }
                largest
            };
            // Without springs an exponential scheme is exact.
            for integrator in schemes().filter(|name| name.starts_with("exponential")) {
                let [u, v] = error(integrator);
                assert!(u < 1e-12 && v < 1e-11, "{integrator}, C = {damping}: {u:e}, {v:e}");
            }
            let largest = error("central");
            assert!(largest[0] < 2e-4 * 0.08, "C = {damping}: {largest:?}");
            errors.push(largest);
        }
        // Second order: the error falls by 16 when the step falls by 4, in displacement and in velocity.
        for (coarse, fine) in errors[0].into_iter().zip(errors[1]) {
            assert!(coarse / fine > 14.0, "C = {damping}: {coarse:e} to {fine:e}");
        }
    }
}

fn constant(scene: &Scene, point: [usize; 2], force_n: DVec3) -> LoadProfile {
    let text = format!(
        "duration_s = 1.0\nsample_every_s = 1.0\n[[force]]\npoint = [{}, {}]\nforce_n = [{}, {}, {}]\n\
         falloff_per_m = 2000.0\nfalloff_offset = 0.0\nprofile = {{ type = \"constant\" }}\n",
        point[0], point[1], force_n.x, force_n.y, force_n.z
    );
    script(&text, scene).forces[0].clone()
}

#[test]
fn energy_is_conserved_without_damping() {
    for precision in ["f32", "f64"] {
        let set = format!("stepping.precision={precision}");
        let scene = scene_with(SMALL, &[&set, "damping.coefficient_n_s_per_m=0.0"]);
        let mut tissue = shaken(&scene, 40);
        let before = total_j(tissue.energy());
        assert!(before > 1e-3);
        let mut widest = 0.0_f64;
        for _ in 0..20_000 {
            tissue.step().unwrap();
            widest = widest.max((total_j(tissue.energy()) - before).abs());
        }
        // The energy of a symplectic scheme oscillates with (dt·ω)² and does not drift.
        assert!(widest < 0.01 * before, "{precision}: {widest} of {before}");
    }
}

#[test]
fn damping_only_takes_energy() {
    let mut tissue = shaken(&scene(SMALL), 40);
    let mut before = total_j(tissue.energy());
    for _ in 0..50 {
        for _ in 0..20 {
            tissue.step().unwrap();
        }
        let now = total_j(tissue.energy());
        assert!(now < before);
        before = now;
    }
    assert!(before < 1e-4);
}

#[test]
fn momentum_changes_by_the_outer_forces_alone() {
    let sets = ["damping.coefficient_n_s_per_m=0.0", "anchor_springs.stiffness_n_per_m=0.0"];
    let scene = scene_with(SMALL, &sets);
    let momentum = |tissue: &dyn Tissue| -> DVec3 {
        let velocities = tissue.model().points().map(|index| tissue.point(index).velocity_m_per_s);
        scene.sheet().unwrap().point_mass_kg * velocities.sum::<DVec3>()
    };
    let mut tissue = tissue::at_rest(&model(&scene));
    let force_n = DVec3::new(0.4, 0.3, -0.6);
    tissue.push(0, Some(push_on(&scene, [3, 2], force_n.to_array())));
    for _ in 0..40 {
        tissue.step().unwrap();
    }
    // Impulse = force · time.
    let pushed = momentum(&*tissue);
    assert!((pushed - force_n * 0.04).length() < 1e-12, "{pushed}");
    tissue.release(0);
    for _ in 0..1000 {
        tissue.step().unwrap();
    }
    assert!((momentum(&*tissue) - force_n * 0.04).length() < 1e-9);
}

#[test]
fn a_centred_poke_keeps_the_symmetry_of_the_sheet() {
    let square = scene_with(SMALL, &["sheet.points=[9, 9]"]);
    let mut tissue = tissue::at_rest(&model(&square));
    tissue.push(0, Some(push_on(&square, [4, 4], [0.0, 0.0, -0.8])));
    for _ in 0..200 {
        tissue.step().unwrap();
    }
    let at = |i: usize, j: usize| tissue.point(tissue.model().scene.sheet().unwrap().point([i, j])).displacement_m;
    for i in 0..9 {
        for j in 0..9 {
            let u = at(i, j);
            let close = |v: DVec3| (u - v).length() < 1e-13;
            let (left, down, turned) = (at(8 - i, j), at(i, 8 - j), at(j, i));
            assert!(close(DVec3::new(-left.x, left.y, left.z)), "mirrored in x at {i}, {j}");
            assert!(close(DVec3::new(down.x, -down.y, down.z)), "mirrored in y at {i}, {j}");
            assert!(close(DVec3::new(turned.y, turned.x, turned.z)), "mirrored in the diagonal at {i}, {j}");
        }
    }
}

#[test]
fn equilibrium_is_the_solution_of_newtons_method() {
    let scene =
        scene_with(SMALL, &["springs.bending=true", "springs.shear_stiffness_n_per_m=12.0", "sleep.tolerance=0"]);
    let load = DVec3::new(0.2, -0.1, -0.5);
    let mut tissue = tissue::at_rest(&model(&scene));
    tissue.push(0, Some(push_on(&scene, [3, 2], load.to_array())));
    for _ in 0..20_000 {
        tissue.step().unwrap();
    }
    let solution = newton(&scene, [3, 2], load);
    for (index, expected) in solution.iter().enumerate() {
        let u = tissue.point(PointId::new(index)).displacement_m;
        assert!((u - *expected).length() < 1e-10, "point {index}: {u}, expected {expected}");
    }
}

/// An independent formulation of the static problem: springs by their definition, on absolute positions, solved by
/// Newton's method with a tangent from finite differences.
struct Static<'a> {
    scene: &'a Scene,
    loaded: usize,
    load: DVec3,
}

impl Static<'_> {
    fn energy_j(&self, u: &[DVec3]) -> f64 {
        let [nx, ny] = self.scene.sheet().unwrap().points;
        let h = self.scene.sheet().unwrap().spacing_m;
        let springs = &self.scene.springs;
        let mut links = vec![
            (1, 0, springs.stiffness_n_per_m),
            (0, 1, springs.stiffness_n_per_m),
            (1, 1, springs.shear_stiffness_n_per_m),
            (1, -1, springs.shear_stiffness_n_per_m),
        ];
        if springs.bending {
            links.extend([(2, 0, springs.stiffness_n_per_m), (0, 2, springs.stiffness_n_per_m)]);
        }
        let mut energy = 0.0;
        for i in 0..nx as i64 {
            for j in 0..ny as i64 {
                for &(di, dj, k) in &links {
                    let (a, b) = (i + di, j + dj);
                    if a < nx as i64 && (0..ny as i64).contains(&b) {
                        let rest = h * DVec3::new(di as f64, dj as f64, 0.0);
                        let now = rest + u[(a * ny as i64 + b) as usize] - u[(i * ny as i64 + j) as usize];
                        energy += 0.5 * k * (now.length() - rest.length()).powi(2);
                    }
                }
            }
        }
        energy + u.iter().map(|u| 0.5 * self.scene.anchor_stiffness_n_per_m * u.length_squared()).sum::<f64>()
    }

    /// Minus the gradient of the energy, by central differences, plus the load.
    fn forces_n(&self, u: &[DVec3]) -> Vec<f64> {
        const STEP_M: f64 = 1e-6;
        let mut moved = u.to_vec();
        (0..3 * u.len())
            .map(|row| {
                let (point, axis) = (row / 3, row % 3);
                let mut energy_at = |offset: f64| {
                    moved[point][axis] = u[point][axis] + offset;
                    let energy = self.energy_j(&moved);
                    moved[point][axis] = u[point][axis];
                    energy
                };
                // Fourth order: 1e-6 m steps and energies of 1e-2 J leave an error near 1e-11 N.
                let slope = (8.0 * (energy_at(STEP_M) - energy_at(-STEP_M))
                    - (energy_at(2.0 * STEP_M) - energy_at(-2.0 * STEP_M)))
                    / (12.0 * STEP_M);
                -slope + if point == self.loaded { self.load[axis] } else { 0.0 }
            })
            .collect()
    }
}

fn newton(scene: &Scene, [i, j]: [usize; 2], load: DVec3) -> Vec<DVec3> {
    let [nx, ny] = scene.sheet().unwrap().points;
    let problem = Static { scene, loaded: i * ny + j, load };
    // Small loads first: Newton's method converges from a nearby start.
    let mut u = vec![DVec3::ZERO; nx * ny];
    for share in [0.1, 0.3, 0.6, 1.0] {
        let problem = Static { load: load * share, ..problem };
        for _ in 0..12 {
            let residual = exact_forces_n(&problem, &u);
            let n = residual.len();
            let mut system = vec![vec![0.0; n + 1]; n];
            for column in 0..n {
                let mut moved = u.clone();
                moved[column / 3][column % 3] += 1e-7;
                let there = exact_forces_n(&problem, &moved);
                for row in 0..n {
                    system[row][column] = (residual[row] - there[row]) / 1e-7;
                }
            }
            for (row, residual) in residual.iter().enumerate() {
                system[row][n] = *residual;
            }
            for (index, delta) in solve(system).into_iter().enumerate() {
                u[index / 3][index % 3] += delta;
            }
        }
    }
    u
}

/// The same forces by their formula, k(L − L0)(x_b − x_a)/L.
fn exact_forces_n(problem: &Static<'_>, u: &[DVec3]) -> Vec<f64> {
    let scene = problem.scene;
    let [nx, ny] = scene.sheet().unwrap().points;
    let springs = &scene.springs;
    let mut forces = vec![DVec3::ZERO; nx * ny];
    for a in 0..nx * ny {
        for b in 0..nx * ny {
            let (di, dj) = ((b / ny) as f64 - (a / ny) as f64, (b % ny) as f64 - (a % ny) as f64);
            let k = match (di.abs(), dj.abs()) {
                (1.0, 0.0) | (0.0, 1.0) => springs.stiffness_n_per_m,
                (1.0, 1.0) => springs.shear_stiffness_n_per_m,
                (2.0, 0.0) | (0.0, 2.0) if springs.bending => springs.stiffness_n_per_m,
                _ => continue,
            };
            let rest = scene.sheet().unwrap().spacing_m * DVec3::new(di, dj, 0.0);
            let now = rest + u[b] - u[a];
            forces[a] += k * (now.length() - rest.length()) / now.length() * now;
        }
        forces[a] -= scene.anchor_stiffness_n_per_m * u[a];
    }
    forces[problem.loaded] += problem.load;
    forces.iter().flat_map(DVec3::to_array).collect()
}

/// Gaussian elimination with pivots.
fn solve(mut system: Vec<Vec<f64>>) -> Vec<f64> {
    let n = system.len();
    for column in 0..n {
        let pivot = (column..n).max_by(|a, b| system[*a][column].abs().total_cmp(&system[*b][column].abs())).unwrap();
        system.swap(column, pivot);
        let top = system[column].clone();
        for row in system.iter_mut().skip(column + 1) {
            let factor = row[column] / top[column];
            for (value, top) in row.iter_mut().zip(&top).skip(column) {
                *value -= factor * top;
            }
        }
    }
    for column in (0..n).rev() {
        let value = system[column][n] / system[column][column];
        for row in system.iter_mut().take(column) {
            row[n] -= row[column] * value;
        }
        system[column][n] = value;
    }
    system.into_iter().map(|row| row[n]).collect()
}

#[test]
fn the_force_field_is_minus_the_gradient_of_the_energy() {
    // Central differences: the displacement is exactly the one at which the springs were evaluated.
    let sets = ["springs.bending=true", "springs.shear_stiffness_n_per_m=12.0", "stepping.integrator=central"];
    let scene = scene_with(SMALL, &sets);
    let tissue = shaken(&scene, 60);
    let u: Vec<DVec3> = tissue.model().points().map(|index| tissue.point(index).displacement_m).collect();
    assert!(u.iter().any(|u| u.length() > 0.2 * scene.sheet().unwrap().spacing_m), "the sheet is not deformed");
    let problem = Static { scene: &scene, loaded: 0, load: DVec3::ZERO };
    for (index, expected) in problem.forces_n(&u).chunks(3).enumerate() {
        let point = tissue.point(PointId::new(index));
        let force_n = point.spring_n + point.anchor_n;
        let expected = DVec3::new(expected[0], expected[1], expected[2]);
        assert!((force_n - expected).length() < 1e-8, "point {index}: {force_n}, expected {expected}");
    }
    let energy = tissue.energy();
    assert!((energy.spring_j + energy.anchor_j - problem.energy_j(&u)).abs() < 1e-14);
}

#[test]
fn anchor_springs_alone_leave_every_point_to_itself() {
    let scene = scene_with(SMALL, &["springs.stiffness_n_per_m=0.0", "sleep.tolerance=0"]);
    let mut tissue = tissue::at_rest(&model(&scene));
    tissue.push(0, Some(push_on(&scene, [3, 2], [0.0, 0.0, -0.5])));
    for _ in 0..5000 {
        tissue.step().unwrap();
    }
    for index in tissue.model().points() {
        let expected = if index == tissue.model().scene.sheet().unwrap().point([3, 2]) { -0.5 / 5.0 } else { 0.0 };
        assert!((tissue.point(index).displacement_m.z - expected).abs() < 1e-9);
    }
}

#[test]
fn a_sheet_without_anchor_springs_is_the_conventional_model_and_floats_away() {
    let sets = ["anchor_springs.stiffness_n_per_m=0.0", "damping.coefficient_n_s_per_m=0.0"];
    let scene = scene_with(SMALL, &sets);
    let mut tissue = shaken(&scene, 40);
    for _ in 0..5000 {
        tissue.step().unwrap();
    }
    assert!(tissue.largest_displacement_m() > 0.1);
}

#[test]
fn fixed_points_never_move_and_carry_the_load() {
    for fixed in ["edges", "corners", "[[0, 0], [6, 4], [0, 4]]"] {
        let set = format!("sheet.fixed={fixed}");
        let scene = scene_with(SMALL, &[&set, "anchor_springs.stiffness_n_per_m=0.0"]);
        let mut tissue = tissue::at_rest(&model(&scene));
        let load = DVec3::new(0.05, 0.0, -0.1);
        tissue.push(0, Some(push_on(&scene, [3, 2], load.to_array())));
        for _ in 0..40_000 {
            tissue.step().unwrap();
        }
        let held: Vec<_> = tissue.model().points().map(|index| tissue.point(index)).collect();
        let mut carried = DVec3::ZERO;
        for index in scene.sheet().unwrap().fixed_indices() {
            assert_eq!(held[index].displacement_m, DVec3::ZERO);
            carried += held[index].constraint_n.unwrap();
        }
        // A sheet without anchor springs creeps for long: damping carries what the fixed points do not.
        let damping: DVec3 = held.iter().map(|point| point.damping_n).sum();
        assert!((carried + damping + load).length() < 1e-6, "{fixed}: {carried}, {damping}");
        assert!(damping.length() < 2e-3 * load.length(), "{fixed}: {damping}");
        assert!(held.iter().filter(|point| point.constraint_n.is_none()).any(|point| point.displacement_m.z < -1e-3));
    }
}

#[test]
fn a_let_go_point_goes_on_with_its_velocity() {
    // A free point of mass m moved at constant velocity and released: it then oscillates about its rest position.
    let (m, k, speed) = (0.02_f64, 5.0_f64, 0.4_f64);
    let mut errors = Vec::new();
    for rate_hz in [1000.0, 4000.0] {
        let rate = format!("stepping.rate_hz={rate_hz}");
        let sets = [
            &rate,
            "springs.stiffness_n_per_m=0.0",
            "damping.coefficient_n_s_per_m=0.0",
            "stepping.substeps=1",
            "stepping.integrator=central",
        ];
        let scene = scene_with(SMALL, &sets);
        let mut tissue = tissue::at_rest(&model(&scene));
        let index = tissue.model().scene.sheet().unwrap().point([3, 2]);
        let steps = (0.1 * rate_hz) as u64;
        for step in 0..steps {
            let target = DVec3::new(0.0, 0.0, -speed * (step + 1) as f64 / rate_hz);
            tissue.grasp(0, index, Grasp::Target(target));
            tissue.step().unwrap();
        }
        tissue.release(0);
        let mut largest = 0.0_f64;
        for step in 1..=(rate_hz as u64) {
            tissue.step().unwrap();
            let (t, w) = (step as f64 / rate_hz, (k / m).sqrt());
            let expected = -0.1 * speed * (w * t).cos() - speed / w * (w * t).sin();
            largest = largest.max((tissue.point(index).displacement_m.z - expected).abs());
        }
        errors.push(largest);
    }
    assert!(errors[0] < 1e-4 && errors[0] / errors[1] > 14.0, "{errors:?}");
}

#[test]
fn a_point_let_go_as_a_force_begins_starts_like_any_free_point() {
    // Held at rest, then released at the step at which a force begins: the same as a force that begins on a free point.
    let scene = scene_with(SMALL, &["stepping.substeps=2"]);
    let index = model(&scene).scene.sheet().unwrap().point([3, 2]);
    let run = |hold: bool| {
        let mut tissue = tissue::at_rest(&model(&scene));
        if hold {
            tissue.grasp(0, index, Grasp::Target(DVec3::ZERO));
        }
        for _ in 0..50 {
            tissue.step().unwrap();
        }
        tissue.push(0, Some(push_on(&scene, [3, 2], [0.0, 0.0, -0.5])));
        for _ in 0..50 {
            tissue.step().unwrap();
        }
        tissue.point(index)
    };
    let (held, free) = (run(true), run(false));
    assert!((held.displacement_m - free.displacement_m).length() < 1e-12, "{held:?}\n{free:?}");
    assert!((held.velocity_m_per_s - free.velocity_m_per_s).length() < 1e-12);
}

#[test]
fn to_grasp_and_let_go_between_two_steps_changes_nothing() {
    let scene = scene(SMALL);
    let run = |touch: bool| {
        let mut tissue = shaken(&scene, 20);
        if touch {
            let index = tissue.model().scene.sheet().unwrap().point([3, 2]);
            tissue.grasp(0, index, Grasp::Target(DVec3::ZERO));
            tissue.release(0);
        }
        for _ in 0..20 {
            tissue.step().unwrap();
        }
        tissue.state_hash()
    };
    assert_eq!(run(true), run(false));
}

#[test]
fn a_grasped_point_taken_over_by_another_tool_follows_that_one() {
    let scene = scene(SMALL);
    let mut tissue = tissue::at_rest(&model(&scene));
    let index = tissue.model().scene.sheet().unwrap().point([3, 2]);
    tissue.grasp(0, index, Grasp::Target(DVec3::new(0.0, 0.0, 0.01)));
    tissue.step().unwrap();
    tissue.grasp(1, index, Grasp::Target(DVec3::new(0.0, 0.0, 0.012)));
    tissue.step().unwrap();
    let point = tissue.point(index);
    assert!((point.displacement_m.z - 0.012).abs() < 1e-15);
    assert!((point.velocity_m_per_s.z - 2.0).abs() < 1e-9);
    // The first tool has nothing left to release.
    tissue.release(0);
    tissue.step().unwrap();
    assert_eq!(tissue.point(index).displacement_m.z, 0.012);
    tissue.release(1);
    tissue.step().unwrap();
    assert!(tissue.point(index).constraint_n.is_none());
}

#[test]
fn a_grasp_that_goes_on_as_the_point_went_needs_little_force() {
    let scene = scene(SMALL);
    let mut tissue = shaken(&scene, 20);
    let index = tissue.model().scene.sheet().unwrap().point([3, 2]);
    let free = tissue.point(index);
    let target = free.displacement_m + free.velocity_m_per_s * 1e-3;
    tissue.grasp(0, index, Grasp::Target(target));
    tissue.step().unwrap();
    let held = tissue.point(index);
    let inertia_n = scene.sheet().unwrap().point_mass_kg * free.velocity_m_per_s.length() * 1000.0;
    let elastic_n = (held.reaction_n() + held.applied_n).length();
    let force_n = held.constraint_n.unwrap().length();
    assert!(force_n < 1.01 * elastic_n + 1e-6 && elastic_n < 0.5 * inertia_n, "{force_n}, {elastic_n}, {inertia_n}");
}

#[test]
fn two_forces_add_up_and_a_moving_one_is_where_it_should_be() {
    let scene = scene(SMALL);
    let text = r#"
duration_s = 0.2
sample_every_s = 0.1
[[force]]
path = { from_m = [0.05, 0.1], velocity_m_per_s = [0.5, 0.0] }
force_n = [0.0, 0.0, -1.0]
falloff_per_m = 30.0
falloff_offset = -0.5
profile = { type = "ramp", from_s = 0.0, to_s = 0.2 }
[[force]]
hops = [{ at_s = 0.0, point = [1, 1] }, { at_s = 0.05, point = [4, 3] }]
force_n = [0.2, 0.0, 0.0]
falloff_per_m = 10.0
falloff_offset = 0.0
profile = { type = "sine", frequency_hz = 2.5 }
"#;
    let script = script(text, &scene);
    let mut session = playing(&scene, &script);
    advance(&mut session, 150);
    let (t, h) = (0.15_f64, 0.05);
    for (i, j) in [(0, 0), (3, 2), (6, 4)] {
        let (x, y) = (i as f64 * h, j as f64 * h);
        let distance = |cx: f64, cy: f64| ((x - cx).powi(2) + (y - cy).powi(2)).sqrt();
        let z = -0.75 * (-30.0 * distance(0.05 + 0.5 * t, 0.1) - 0.5).exp();
        let sine = (std::f64::consts::TAU * 2.5 * t).sin();
        let expected = DVec3::new(0.2 * sine * (-10.0 * distance(0.2, 0.15)).exp(), 0.0, z);
        let point = session.tissue().point(session.model().scene.sheet().unwrap().point([i, j]));
        assert!((point.applied_n - expected).length() < 1e-12, "{}, expected {expected}", point.applied_n);
    }
    // Just before a hop, the force is at its old place.
    let before = script.forces[1].at(Moment { step: 49, fraction: 1.0 }, 1000.0);
    let after = script.forces[1].at(Moment::start_of(50), 1000.0);
    assert_ne!(before.centre_m, after.centre_m);
}

#[test]
fn a_spring_pressed_to_no_length_stays_finite() {
    // A point is brought exactly onto its neighbour, which is held, and through it: their spring then has no length,
    // and so no direction.
    let h = 0.05;
    for sets in [
        ["stepping.precision=f32", "stepping.integrator=central"],
        ["stepping.precision=f32", "stepping.integrator=exponential3"],
        ["stepping.precision=f64", "stepping.integrator=central"],
        ["stepping.precision=f64", "stepping.integrator=exponential4"],
    ] {
        let scene = scene_with(SMALL, &sets);
        let mut tissue = tissue::at_rest(&model(&scene));
        let (moved, held) =
            (tissue.model().scene.sheet().unwrap().point([3, 2]), tissue.model().scene.sheet().unwrap().point([4, 2]));
        let check = |tissue: &dyn Tissue, step: u32| {
            for index in tissue.model().points() {
                let point = tissue.point(index);
                let vectors = [point.displacement_m, point.velocity_m_per_s, point.spring_n, point.reaction_n()];
                assert!(
                    vectors.iter().all(|v| v.is_finite()),
                    "{sets:?}: point {index:?} after step {step}: {point:?}"
                );
                // Eight springs, none longer than three times its rest length.
                let most_n = 8.0 * 2.0 * 2.0_f64.sqrt() * h * scene.springs.stiffness_n_per_m;
                assert!(point.spring_n.length() < most_n, "{sets:?}: point {index:?} after step {step}: {point:?}");
            }
            assert!(total_j(tissue.energy()).is_finite(), "{sets:?}: after step {step}");
        };
        tissue.grasp(1, held, Grasp::Target(DVec3::ZERO));
        for step in 1..=400 {
            tissue.grasp(0, moved, Grasp::Target(DVec3::new(2.0 * h * f64::from(step) / 400.0, 0.0, 0.0)));
            tissue.step().unwrap();
            check(&*tissue, step);
            if step == 200 {
                let apart_m = tissue.point(held).displacement_m.x + h - tissue.point(moved).displacement_m.x;
                assert!(apart_m.abs() < 1e-8, "{sets:?}: {apart_m} m apart");
            }
        }
        tissue.release(0);
        tissue.release(1);
        for step in 401..=1400 {
            tissue.step().unwrap();
            check(&*tissue, step);
        }
        assert_eq!(tissue.guard_events(), 0, "{sets:?}: the guard had to go back");
    }
}

#[test]
fn a_vibration_without_damping_keeps_its_phase() {
    // A stiff undamped sheet, pushed and released, against itself at a twentieth of the substep.
    let sets = ["damping.coefficient_n_s_per_m=0.0", "springs.stiffness_n_per_m=60.0", "sheet.points=[15, 15]"];
    let shaken_for_a_second = |substeps: Option<u32>| {
        let substeps = substeps.map_or("stepping.substeps=auto".to_owned(), |n| format!("stepping.substeps={n}"));
        let scene = scene_with(SMALL, &[&sets[..], &[substeps.as_str()]].concat());
        let mut tissue = tissue::at_rest(&model(&scene));
        tissue.push(0, Some(push_on(&scene, [7, 7], [0.1, 0.0, -0.6])));
        let mut path = Vec::new();
        for step in 0..1000 {
            if step == 200 {
                tissue.release(0);
            }
            tissue.step().unwrap();
            path.push(tissue.point(tissue.model().scene.sheet().unwrap().point([7, 7])).displacement_m);
        }
        (path, tissue.model().plan.substeps)
    };
    let (path, substeps) = shaken_for_a_second(None);
    let (truth, _) = shaken_for_a_second(Some(20 * substeps));
    let largest = truth.iter().map(|u| u.length()).fold(0.0, f64::max);
    let error = path.iter().zip(&truth).map(|(u, v)| (*u - *v).length()).fold(0.0, f64::max);
    assert!(error < 1e-3 * largest, "{} with {substeps} substeps", error / largest);
}

#[test]
fn substeps_follow_the_bound_and_a_bound_is_never_below_a_vibration() {
    use palpate_tissue::scene::largest_stiffness_of_a_sheet_n_per_m;
    // λ over the whole infinite grid, by brute force.
    for (k1, k2, bending) in
        [(1.0, 1.0, false), (1.0, 1.0, true), (1.0, 0.3, true), (0.2, 1.0, false), (1.0, 0.0, true)]
    {
        let mut springs = scene(SMALL).springs;
        (springs.stiffness_n_per_m, springs.shear_stiffness_n_per_m, springs.bending) = (k1, k2, bending);
        let mut largest = 0.0_f64;
        for a in 0..=200 {
            for b in 0..=200 {
                let (a, b) = (f64::from(a) / 200.0 * std::f64::consts::PI, f64::from(b) / 200.0 * std::f64::consts::PI);
                let mut value = k1 * (4.0 - 2.0 * a.cos() - 2.0 * b.cos()) + k2 * (4.0 - 4.0 * a.cos() * b.cos());
                if bending {
                    value += k1 * (4.0 - 2.0 * (2.0 * a).cos() - 2.0 * (2.0 * b).cos());
                }
                largest = largest.max(value);
            }
        }
        let bound = largest_stiffness_of_a_sheet_n_per_m(&springs);
        assert!(bound >= largest - 1e-12 && bound < largest * 1.001, "{k1}, {k2}, {bending}: {bound} and {largest}");
    }
}
