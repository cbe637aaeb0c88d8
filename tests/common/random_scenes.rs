//! Random scenes with random scripts, by seed: what a promise about every scene is tried on.
// A benchmark uses this too.
#![allow(dead_code, unreachable_pub, clippy::cast_precision_loss)]

use std::path::Path;
use std::sync::Arc;

use palpate_session::{Session, run};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::Scene;
use palpate_tissue::scene::script::Script;

use super::closed_mesh::closed_mesh;

/// A scene and a script as files say them, and what they are in short.
pub struct RandomScene {
    pub scene: String,
    pub script: String,
    /// The file `mesh.obj` of the scene, if it has one.
    pub mesh: Option<String>,
    pub about: String,
}

/// Sheets of 4 to 33 points a side, spacing 1 mm to 0.1 m, points of 10⁻⁵ to 0.1 kg, fastest vibration × 1 ms from
/// 0.02 to 1.5, k/K″ from 0.3 to 200, ζ from 0.02 to 5 (of a point on its anchor spring), in part with bending and
/// fixed points; forces that strain springs by 1 to 50 %, constant, as a pulse, a ramp or a sine of 0.5 to 20 Hz,
/// some of which move.
pub fn case(seed: u64) -> RandomScene {
    let mut random = fastrand::Rng::with_seed(seed);
    let mut uniform = |from: f64, to: f64| from + (to - from) * random.f64();
    let [mut sides, mut control] = [[0.0; 2]; 2];
    for (side, control) in sides.iter_mut().zip(&mut control) {
        *side = uniform(4.0, 34.0).floor();
        *control = uniform(1.0, *side - 1.0).floor();
    }
    let mut decades = |from: f64, to: f64| (uniform(from.ln(), to.ln())).exp();
    let (spacing, mass, turn) = (decades(1e-3, 0.1), decades(1e-5, 0.1), decades(0.02, 1.5));
    let stiffness = mass * (turn / 1e-3_f64).powi(2) / 12.0;
    let (ratio, zeta, strain) = (decades(0.3, 200.0), decades(0.02, 5.0), decades(0.01, 0.5));
    let falloff = decades(0.3, 3.0);
    let anchor_stiffness = stiffness / ratio;
    let damping = 2.0 * zeta * (anchor_stiffness * mass).sqrt();
    let force = strain * spacing * (anchor_stiffness + 0.3 * stiffness);
    // A direction, all alike.
    let (along_z, angle) = (uniform(-1.0, 1.0), uniform(0.0, std::f64::consts::TAU));
    let level = (1.0 - along_z * along_z).sqrt();
    let force = [level * angle.cos(), level * angle.sin(), along_z].map(|part| part * force);
    let bending = uniform(0.0, 1.0) < 0.4;
    let fixed = ["", "fixed = \"edges\"\n", "fixed = \"corners\"\n"][uniform(0.0, 3.0) as usize];
    let profile = profile(&mut uniform);
    let duration = [0.5, 1.0][uniform(0.0, 2.0) as usize];
    let [nx, ny] = sides;
    let [i, j] = control;
    let place = if uniform(0.0, 1.0) < 0.25 {
        let speed = [(); 2].map(|()| 3.0 * spacing * uniform(-1.0, 1.0));
        format!("path = {{ from_m = {:?}, velocity_m_per_s = {speed:?} }}", [i * spacing, j * spacing])
    } else {
        format!("point = [{i}, {j}]")
    };
    let corner = if fixed.is_empty() { [0.0, 0.0] } else { [1.0, 1.0] };
    let mut watched = vec![control];
    for point in [corner, [(nx / 2.0).floor(), (ny / 2.0).floor()]] {
        if !watched.contains(&point) {
            watched.push(point);
        }
    }
    let watched: Vec<String> = watched.iter().map(|[i, j]| format!("[{i}, {j}]")).collect();
    RandomScene {
        mesh: None,
        scene: format!(
            "name = \"random {seed}\"\n[sheet]\npoints = [{nx}, {ny}]\nspacing_m = {spacing:?}\npoint_mass_kg = {mass:?}\n{fixed}\
             [springs]\nstiffness_n_per_m = {stiffness:?}\nbending = {bending}\n\
             [anchor_springs]\nstiffness_n_per_m = {anchor_stiffness:?}\n[damping]\ncoefficient_n_s_per_m = {damping:?}\n"
        ),
        script: format!(
            "name = \"random {seed}\"\nduration_s = {duration:?}\nsample_every_s = 0.025\nsample_points = [{}]\n\
             [[force]]\n{place}\nforce_n = {force:?}\nfalloff_per_m = {:?}\nfalloff_offset = 0.0\nprofile = {profile}\n",
            watched.join(", "),
            falloff / spacing
        ),
        about: format!(
            "seed {seed}: {nx} × {ny}, k/K″ {ratio:.3}, ω·1 ms {turn:.2}, ζ {zeta:.2}, strain {strain:.2}, falloff \
             {falloff:.2} a spacing, bending {bending}, {} {}",
            fixed.trim_end(),
            profile.replace("type = ", "")
        ),
    }
}

/// The same on closed meshes of uneven triangles: fastest vibration × 1 ms from about 0.02 to 1.5, k/K″ of an even
/// edge from 0.3 to 200; forces inward that strain its springs by 1 to 50 %.
pub fn mesh_case(seed: u64) -> RandomScene {
    let mut random = fastrand::Rng::with_seed(seed);
    let mesh = closed_mesh(&mut random);
    let edge_m = mesh.edge_m();
    let mut uniform = |from: f64, to: f64| from + (to - from) * random.f64();
    let mut decades = |from: f64, to: f64| uniform(from.ln(), to.ln()).exp();
    let (turn, ratio, zeta, strain, falloff) =
        (decades(0.02, 1.5), decades(0.3, 200.0), decades(0.02, 5.0), decades(0.01, 0.5), decades(0.3, 3.0));
    let (density, depth_m) = (1000.0, 0.03);
    // The fastest vibration of even triangles has (10k + K″)/m.
    let mass_kg_per_m2 = density * depth_m / 3.0;
    let foundation_n_per_m3 = mass_kg_per_m2 * (turn / 1e-3_f64).powi(2) / (10.0 * ratio + 1.0);
    let area_m2 = 0.75_f64.sqrt() * edge_m * edge_m;
    let (thickness_m, anchor_n_per_m) = (1e-3, foundation_n_per_m3 * area_m2);
    let stiffness_n_per_m = ratio * anchor_n_per_m;
    let modulus_pa = stiffness_n_per_m / (0.75_f64.sqrt() * thickness_m);
    let bending = [0.0, 0.1, 0.5][uniform(0.0, 3.0) as usize];
    let vertex = uniform(0.0, mesh.places_m.len() as f64) as usize;
    let place_m = mesh.places_m[vertex];
    let profile = profile(&mut uniform);
    let away_m = place_m.iter().map(|c| c * c).sum::<f64>().sqrt();
    let force_n = strain * edge_m * (anchor_n_per_m + 0.3 * stiffness_n_per_m);
    let towards = [(); 3].map(|()| uniform(-1.0, 1.0));
    let force_n = [0, 1, 2].map(|c| force_n * (0.3 * towards[c] - place_m[c] / away_m));
    let others = mesh.triangles.iter().find(|triangle| triangle.contains(&(vertex as u32)));
    let watched: Vec<u32> = others.into_iter().flatten().copied().collect();
    RandomScene {
        mesh: Some(mesh.obj()),
        scene: format!(
            "name = \"random {seed}\"\n[mesh]\nfile = \"mesh.obj\"\nunit = \"m\"\n[material]\nyoungs_modulus_pa = {modulus_pa:?}\n\
             thickness_m = {thickness_m:?}\ndensity_kg_per_m3 = {density:?}\ndepth_m = {depth_m:?}\nfoundation_n_per_m3 = {foundation_n_per_m3:?}\n\
             damping_ratio = {zeta:?}\n[springs]\nbending = {bending}\n"
        ),
        about: format!(
            "mesh of seed {seed}: {} vertices, k/K″ {ratio:.3}, ω·1 ms {turn:.2}, ζ {zeta:.2}, strain {strain:.2}, falloff \
             {falloff:.2} an edge, bending {bending}, {}",
            mesh.places_m.len(),
            profile.replace("type = ", "")
        ),
        script: format!(
            "name = \"random {seed}\"\nduration_s = 0.5\nsample_every_s = 0.025\nsample_points = {watched:?}\n[[force]]\n\
             vertex = {vertex}\nforce_n = {force_n:?}\nfalloff_per_m = {:?}\nfalloff_offset = 0.0\nprofile = {profile}\n",
            falloff / edge_m
        ),
    }
}

/// Solids that fill closed meshes of uneven triangles: 6 mm to 0.2 m wide, 60 to 600 cells, fastest vibration × 1 ms from 0.2
/// to 5 without lumps, ν from 0 to 0.495, damping from 3 to 300 a second, half of them with a lump of 0.05 to 20 times their
/// E; forces inward that strain the cells under them by about 1 to 20 %.
pub fn solid_case(seed: u64) -> RandomScene {
    let mut random = fastrand::Rng::with_seed(seed);
    let mesh = closed_mesh(&mut random);
    let mut uniform = |from: f64, to: f64| from + (to - from) * random.f64();
    let mut decades = |from: f64, to: f64| uniform(from.ln(), to.ln()).exp();
    let (turn, damping_per_s, strain, falloff) =
        (decades(0.2, 5.0), decades(3.0, 300.0), decades(0.01, 0.2), decades(0.3, 3.0));
    let (factor, cells) = (decades(0.05, 20.0), decades(60.0, 600.0).round());
    // As many near ½ as near 0.
    let poissons_ratio =
        if uniform(0.0, 1.0) < 0.5 { uniform(0.0, 0.45) } else { 0.5 - 0.005 * 10_f64.powf(uniform(0.0, 1.0)) };
    let side = |c: usize| {
        let along = mesh.places_m.iter().map(|place_m| place_m[c]);
        let (least, most) = (along.clone().fold(f64::INFINITY, f64::min), along.fold(f64::NEG_INFINITY, f64::max));
        (least, most - least)
    };
    let [x, y, z] = [0, 1, 2].map(side);
    // An ellipsoid fills about half of its box.
    let cell_m = (0.5 * x.1 * y.1 * z.1 / cells).cbrt();
    // ω² = 4·(3λ + 2μ)/(ρ·a²), with 3λ + 2μ = E/(1 − 2ν).
    let youngs_pa = 0.25 * (1.0 - 2.0 * poissons_ratio) * 1060.0 * (cell_m * turn / 1e-3_f64).powi(2);
    let plane_m = z.0 + 0.2 * z.1;
    let count = mesh.places_m.len();
    // One that is not held: the upper pole, or one near it.
    let highest = (0..count).filter(|v| mesh.places_m[*v][2] > z.0 + 0.5 * z.1).collect::<Vec<_>>();
    let vertex = highest[uniform(0.0, highest.len() as f64) as usize];
    let place_m = mesh.places_m[vertex];
    let away_m = place_m.iter().map(|c| c * c).sum::<f64>().sqrt();
    let force_n = strain * youngs_pa * cell_m * cell_m / (1.0 + (2.0 / falloff).powi(2));
    let towards = [(); 3].map(|()| uniform(-1.0, 1.0));
    let force_n = [0, 1, 2].map(|c| force_n * (0.3 * towards[c] - place_m[c] / away_m));
    let profile = profile(&mut uniform);
    let lump = match uniform(0.0, 1.0) < 0.5 {
        true => format!(
            "[[inclusion]]\ncentre_m = {:?}\nradius_m = {:?}\nstiffness_factor = {factor:?}\n",
            place_m.map(|c| 0.5 * c),
            cell_m * uniform(1.0, 2.0)
        ),
        false => String::new(),
    };
    let others = mesh.triangles.iter().find(|triangle| triangle.contains(&(vertex as u32)));
    let watched: Vec<u32> = others.into_iter().flatten().copied().collect();
    // A third is elastic, a third has the usual viscosity, and of a third τ times the fastest vibration is 0.001 to 1.
    let turn_by_viscosity = 10_f64.powf(-3.0 * fastrand::Rng::with_seed(!seed).f64());
    let viscosity_pa_s = match seed % 3 {
        0 => Some(0.0),
        1 => None,
        _ => Some(1e-3 * turn_by_viscosity / turn * 0.5 * youngs_pa / (1.0 + poissons_ratio)),
    };
    // One in seven has one to three branches.
    let branches = if seed % 7 == 5 {
        let mut random = fastrand::Rng::with_seed(seed ^ 0x_6272_616e_6368);
        let branch = |_| {
            let (of_shear, time_s) = (0.05 * 40_f64.powf(random.f64()), 3e-3 * 1e3_f64.powf(random.f64()));
            let shear_modulus_pa = of_shear * 0.5 * youngs_pa / (1.0 + poissons_ratio);
            format!("[[branch]]\nshear_modulus_pa = {shear_modulus_pa:?}\ntime_s = {time_s:?}\n")
        };
        (0..1 + seed / 7 % 3).map(branch).collect()
    } else {
        String::new()
    };
    let viscosity = viscosity_pa_s.map_or(String::new(), |value| format!("viscosity_pa_s = {value:?}\n"));
    RandomScene {
        mesh: Some(mesh.obj()),
        scene: format!(
            "name = \"random {seed}\"\n[solid]\nfile = \"mesh.obj\"\nunit = \"m\"\ncell_m = {cell_m:?}\n\
             fixed = [{{ plane_m = [0, 0, {plane_m:?}], normal = [0, 0, 1], within_m = {:?} }}]\n\
             [material]\nyoungs_modulus_pa = {youngs_pa:?}\npoissons_ratio = {poissons_ratio:?}\n\
             damping_per_s = {damping_per_s:?}\n{viscosity}{branches}{lump}",
            0.2 * z.1
        ),
        about: format!(
            "solid of seed {seed}: about {cells} cells of {:.2} mm, ω·1 ms {turn:.2}, ν {poissons_ratio:.3}, damping \
             {damping_per_s:.1}, strain {strain:.2}, falloff {falloff:.2} a cell, {}{}{}",
            1e3 * cell_m,
            if branches.is_empty() { "" } else { "branches, " },
            if lump.is_empty() { String::new() } else { format!("lump × {factor:.2}, ") },
            profile.replace("type = ", "")
        ),
        script: format!(
            "name = \"random {seed}\"\nduration_s = 0.5\nsample_every_s = 0.025\nsample_points = {watched:?}\n[[force]]\n\
             vertex = {vertex}\nforce_n = {force_n:?}\nfalloff_per_m = {:?}\nfalloff_offset = 0.0\nprofile = {profile}\n",
            falloff / cell_m
        ),
    }
}

/// A profile of a force: constant, a pulse, a ramp, or a sine of 0.5 to 20 Hz.
fn profile(uniform: &mut impl FnMut(f64, f64) -> f64) -> String {
    match uniform(0.0, 4.0) as usize {
        0 => "{ type = \"constant\" }".to_owned(),
        1 => "{ type = \"pulse\", on_s = 0.1, off_s = 0.4 }".to_owned(),
        2 => "{ type = \"ramp\", from_s = 0.05, to_s = 0.25 }".to_owned(),
        _ => format!("{{ type = \"sine\", frequency_hz = {:?} }}", uniform(0.5, 20.0)),
    }
}

/// Displacement and reaction, each x, y and z, of every watched point at each sample time.
pub type PointHistory = Vec<Vec<[[f64; 3]; 2]>>;

/// A case that was played.
pub struct Played {
    pub course: PointHistory,
    pub model: Arc<Model>,
    /// Mean duration of a step, if a clock was given, s.
    pub step_s: f64,
}

/// A case's scene with assignments over it.
pub fn scene(case: &RandomScene, assignments: &[String], limits: &Limits) -> Result<Scene, String> {
    let text = |refusal: palpate_refusal::Refusal| refusal.to_string();
    match &case.mesh {
        None => Scene::parse("random", &case.scene, assignments, limits).map_err(text),
        Some(mesh) => {
            let folder = tempfile::tempdir().map_err(|error| error.to_string())?;
            let path = folder.path().join("random.toml");
            let written =
                std::fs::write(folder.path().join("mesh.obj"), mesh).and_then(|()| std::fs::write(&path, &case.scene));
            written.map_err(|error| error.to_string())?;
            Scene::load(&path, assignments, limits).map_err(text)
        }
    }
}

/// The case compiled with its script.
pub fn compile(case: &RandomScene, assignments: &[String]) -> Result<(Arc<Model>, Script), String> {
    // Offline, as `palpate run`: the truth takes more than a server would do.
    let limits = Limits { rehearsal_work: 1 << 32, ..Limits::default() };
    let text = |refusal: palpate_refusal::Refusal| refusal.to_string();
    let scene = scene(case, assignments, &limits)?;
    let script = Script::parse("random", &case.script, Path::new("."), &scene, &limits).map_err(text)?;
    Ok((Model::compile(&scene, &limits).map_err(text)?, script))
}

/// Returns the errors of displacement and force that `palpate run --audit` reports for a case.
pub fn audited_errors(case: &RandomScene, assignments: &[String]) -> Result<[f64; 2], String> {
    let (model, script) = compile(case, assignments)?;
    let (limits, mut output) = (Limits::default(), std::io::sink());
    let summary = run::run(
        &model,
        &script,
        run::RunOptions { audit: true, ..Default::default() },
        &limits,
        &mut output,
        &|| 0.0,
        &mut |_| {},
    );
    let error = summary.map_err(|failure| failure.to_string())?.audited_error.ok_or("the run was not audited")?;
    Ok([error.displacement, error.force])
}

/// Plays a case with assignments over its scene.
pub fn play(case: &RandomScene, assignments: &[String], clock_s: &dyn Fn() -> f64) -> Result<Played, String> {
    let (model, script) = compile(case, assignments)?;
    let mut session = Session::new(&model);
    session.play_script(&script);
    let (mut course, begun_s) = (Vec::new(), clock_s());
    for _ in 0..script.steps {
        session.advance(&mut Vec::new(), |session| {
            if session.step_count().is_multiple_of(script.sample_every) {
                let record = session.record(Some(&script.sample_points));
                course.push(record.points.iter().map(|point| [point.displacement_m, point.reaction_n]).collect());
            }
        });
        if let Some(reason) = session.fault() {
            return Err(reason);
        }
    }
    Ok(Played { course, model, step_s: (clock_s() - begun_s) / script.steps as f64 })
}

/// The case in f64 at a tolerance of 1e-10, with everything awake.
pub fn truth(case: &RandomScene) -> Result<Played, String> {
    truth_within(case, 1e-10)
}

/// The case in f64 at another tolerance, with everything awake.
pub fn truth_within(case: &RandomScene, tolerance: f64) -> Result<Played, String> {
    let tolerance = format!("stepping.tolerance={tolerance:e}");
    let settings = ["stepping.precision=f64", &tolerance, "sleep.tolerance=0"];
    play(case, &settings.map(str::to_owned), &|| 0.0)
}

/// The largest difference of any component, relative to the largest: of displacements, and of forces.
pub fn errors(truth: &PointHistory, other: &PointHistory) -> [f64; 2] {
    [0, 1].map(|which: usize| {
        let (mut largest, mut error) = (0.0_f64, 0.0_f64);
        for (a, b) in truth.iter().flatten().zip(other.iter().flatten()) {
            for (a, b) in a[which].iter().zip(b[which]) {
                (largest, error) = (largest.max(a.abs()), error.max((a - b).abs()));
            }
        }
        error / largest
    })
}
