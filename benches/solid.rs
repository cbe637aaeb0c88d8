//! Solids: the time of a step, and touch against solutions of other methods. Writes docs/benchmarks/solid.{md,svg}. The peers
//! run if PEERS names a Python that has them, as `make bench-solid` ensures. `-- --quick` measures less.

#![allow(clippy::unwrap_used, clippy::disallowed_methods, clippy::cast_precision_loss, missing_docs)]

mod peers;
mod report;

use std::fmt::Write as _;
use std::sync::Arc;

use glam::{DQuat, DVec3};
use palpate_haptics::{Tip, TipShape};
use palpate_tissue::limits::Limits;
use palpate_tissue::response::force_law::Disc;
use palpate_tissue::response::mesh_error::MeshErrorEstimate;
use palpate_tissue::response::tangent;
use palpate_tissue::scene::Scene;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::{Model, Push, Tissue, at_rest};
use report::chart::{Look, Panel, Series};
use report::{BenchReport, cells, digits, least, quick, seconds};
use serde_json::json;

/// Radius of the disc, m.
const RADIUS_M: f64 = 0.005;

/// The block of the references, m.
const BLOCK_M: DVec3 = DVec3::new(0.06, 0.06, 0.03);

/// Force over mean depth of an even pressure on the middle of the block, N/m: quadratic elements with linear
/// discontinuous pressure, within 0.1 % under refinement.
const STIFFNESS_N_PER_M: [(f64, f64); 3] = [(0.45, 107.37), (0.49, 113.24), (0.495, 114.05)];

/// Force at some depths, N (four times that on a quarter of the block): quadratic elements with the law of a solid.
const DEEP_N: [(f64, f64); 4] =
    [(0.5e-3, 4.0 * 13.214e-3), (1e-3, 4.0 * 25.828e-3), (1.5e-3, 4.0 * 37.638e-3), (2e-3, 4.0 * 48.434e-3)];

/// Stiffness with a lump of radius 5 mm, five times as stiff, at some depths (m) in the block of ν = 0.49, divided by that without:
/// quadratic tetrahedra that fit the lump, of another code (docs/solids.md).
const LUMPS: [(f64, f64); 3] = [(0.008, 1.261), (0.010, 1.158), (0.015, 1.048)];

/// The corners of a box and its triangles as an OBJ file, m, each place moved by `moved`.
fn box_obj(size_m: DVec3, moved: impl Fn(DVec3) -> DVec3) -> String {
    let mut text = String::new();
    for n in 0..8 {
        let corner = DVec3::from_array([0, 1, 2].map(|axis| f64::from(n >> axis & 1))) * size_m;
        let at = moved(corner);
        let _ = writeln!(text, "v {:?} {:?} {:?}", at.x, at.y, at.z);
    }
    for [a, b, c, d] in [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]] {
        let _ = writeln!(text, "f {} {} {}\nf {} {} {}", a + 1, b + 1, c + 1, a + 1, c + 1, d + 1);
    }
    text
}

/// The keys of a scene whose shape is a file of its own.
const OF_FILE: &str = "file = \"shape.obj\"\nunit = \"m\"";

/// A solid of 8 kPa in a lattice of cubes of `cell_m`. `source` are the keys of its shape, and `obj` is the file of [`OF_FILE`];
/// `fixed` tells what is held, `more` are further keys of the material and sections after it, and `stepping` further keys of that.
fn solid([obj, source]: [&str; 2], cell_m: f64, nu: f64, fixed: &str, [more, stepping]: [&str; 2]) -> Arc<Model> {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("shape.obj"), obj).unwrap();
    let text = format!(
        "[solid]\n{source}\ncell_m = {cell_m:?}\n{fixed}\n\
         [material]\nyoungs_modulus_pa = 8e3\npoissons_ratio = {nu:?}\n{more}\n\
         [stepping]\nintegrator = \"central\"\n{stepping}\n[sleep]\ntolerance = 0\n",
    );
    let scene = Scene::parse_in(folder.path(), "solid", &text, &[], &Limits::default()).unwrap();
    Model::compile(&scene, &Limits::default()).unwrap()
}

/// Holds a solid below the plane through 0 with this normal.
fn held_below(normal: DVec3) -> String {
    format!("fixed = [{{ plane_m = [0, 0, 0], normal = {:?}, within_m = 0.0 }}]", normal.to_array())
}

/// How blocks are turned in the lattice.
fn turned() -> DQuat {
    DQuat::from_rotation_z(30_f64.to_radians()) * DQuat::from_rotation_x(20_f64.to_radians())
}

/// A block, turned by `turn`, held at its lowest face.
fn block(size_m: DVec3, cell_m: f64, nu: f64, turn: DQuat, more: &str) -> Arc<Model> {
    let obj = box_obj(size_m, |at| turn * at);
    let stepping = format!("precision = \"f32\"\nsubsteps = {}", substeps(cell_m, nu));
    let more = format!("damping_per_s = 100\n{more}");
    solid([&obj, OF_FILE], cell_m, nu, &held_below(turn * DVec3::Z), [&more, &stepping])
}

/// Substeps of a millisecond at which dt·ω is 1.5 by the bound ω² = 4·(3λ + 2μ)/(ρ·a²).
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn substeps(cell_m: f64, nu: f64) -> u32 {
    let (lame, shear) = (nu / ((1.0 + nu) * (1.0 - 2.0 * nu)), 0.5 / (1.0 + nu));
    let omega_per_s = (4.0 * 8e3 * (3.0 * lame + 2.0 * shear) / 1060.0).sqrt() / cell_m;
    (1e-3 * omega_per_s / 1.5).ceil() as u32
}

/// Stiffness under a small press of a disc, N/m.
fn stiffness(model: &Model, Disc { radius_m, at_m }: Disc) -> f64 {
    tangent::press(model, radius_m, at_m, 0.0, 1)[0].tangent.stiffness_n_per_m.z_axis.z
}

/// The disc at a place.
fn disc(at_m: DVec3) -> Disc {
    Disc { radius_m: RADIUS_M, at_m }
}

fn percent(ratio: f64) -> String {
    format!("{:+.1} %", 100.0 * (ratio - 1.0))
}

fn main() {
    let mut report = BenchReport::new("solid", "Solids", "make bench-solid");
    report.say(
        "Release build, one thread. Times are the shortest of many runs, in which the rows of a table take turns.",
    );
    speed(&mut report);
    compared(&mut report);
    theory(&mut report);
    let errors = touch(&mut report);
    curved(&mut report);
    estimates(&mut report);
    deep(&mut report);
    lumps(&mut report);
    report.write(1, &[errors]);
}

fn speed(report: &mut BenchReport) {
    report.heading("Time of a substep");
    report.say(
        "Blocks of cubes of 3 mm, 8 kPa, ν = 0.45, in free motion after a force on every point: `central`, f32, all awake, the whole step \
         with its guard.",
    );
    let sides: &[[f64; 3]] =
        if quick() { &[[15.0, 15.0, 14.0]] } else { &[[15.0, 15.0, 14.0], [27.0, 27.0, 26.0], [47.0, 47.0, 43.0]] };
    let cell_m = 0.003;
    let tissues: Vec<_> = sides
        .iter()
        .map(|side| {
            let size_m = cell_m * DVec3::from_array(*side);
            let model = block(size_m, cell_m, 0.45, DQuat::IDENTITY, "");
            let mut tissue = at_rest(&model);
            let force_n = DVec3::new(0.0, 0.0, -1e-5);
            let poke = Poke { point: None, centre_m: 0.5 * size_m, force_n, falloff_per_m: 0.0, falloff_offset: 0.0 };
            tissue.push(0, Some(Push::Constant(poke)));
            (0..20).for_each(|_| tissue.step().unwrap());
            tissue.release(0);
            std::cell::RefCell::new(tissue)
        })
        .collect();
    let steps = 5;
    let times_s = least(if quick() { 5 } else { 30 }, &tissues, |tissue| {
        let mut tissue = tissue.borrow_mut();
        seconds(|| (0..steps).for_each(|_| tissue.step().unwrap())).0 / f64::from(steps)
    });
    let mut rows = Vec::new();
    for (tissue, time_s) in tissues.iter().zip(times_s) {
        let tissue = tissue.borrow();
        let (model, points) = (tissue.model(), tissue.model().len());
        let ns = 1e9 * time_s / (points as f64 * f64::from(model.plan.substeps));
        rows.push(cells([
            points.to_string(),
            model.plan.substeps.to_string(),
            digits(ns),
            digits(1e6 * time_s),
            digits(100.0 * time_s * model.scene.stepping.rate_hz),
        ]));
        report.figure(&format!("{points} points"), json!({ "ns": ns, "step_us": 1e6 * time_s }));
    }
    let header = ["points", "substeps", "ns a point and substep", "µs a step", "% of a core at 1 kHz"];
    report.table(&header.map(str::to_owned), &rows);
}

/// What a simulator does with the block.
struct SimulatorRun {
    name: String,
    cell_mm: f64,
    points: u64,
    steps_per_ms: u64,
    /// Time of a point and step, ns.
    ns: f64,
    stiffness_n_per_m: f64,
}

/// The same block and disc in other simulators.
fn compared(report: &mut BenchReport) {
    report.heading("Other simulators");
    report.say(
        "The block of the next section, ν = 0.45, with a force on the disc: the time of a millisecond at the fewest steps at which the \
         block comes to rest, and the error of its stiffness. All on one thread of this machine. Each has the law of its own; these \
         small strains ask for its moduli alone. Newton runs on the processor; it is written for graphics processors.",
    );
    let sizes_mm: &[f64] = if quick() { &[5.0] } else { &[5.0, 3.0] };
    let mut restless = Vec::new();
    let mut all: Vec<SimulatorRun> = sizes_mm.iter().map(|cell_mm| of_palpate(*cell_mm)).collect();
    if let Some(python) = peers::python() {
        let sizes: Vec<_> = sizes_mm.iter().map(ToString::to_string).collect();
        for told in ["numba_solid.py", "mujoco_solid.py", "newton_solid.py"]
            .map(|script| peers::lines(&python, script, &sizes))
            .concat()
        {
            let (name, cell_mm) = (told["peer"].as_str().unwrap().to_owned(), told["cell_mm"].as_f64().unwrap());
            if let Some(steps) = told["restless_at"].as_u64() {
                restless.push(format!(
                    "{name}, cubes of {cell_mm} mm: not at rest with {steps} steps a millisecond either."
                ));
                continue;
            }
            all.push(SimulatorRun {
                name,
                cell_mm,
                points: told["points"].as_u64().unwrap(),
                steps_per_ms: told["steps_per_ms"].as_u64().unwrap(),
                ns: told["least_ns"].as_f64().unwrap(),
                stiffness_n_per_m: told["stiffness_n_per_m"].as_f64().unwrap(),
            });
        }
    }
    all.sort_by(|a, b| b.cell_mm.total_cmp(&a.cell_mm));
    let (_, truth) = STIFFNESS_N_PER_M[0];
    let mut rows = Vec::new();
    for SimulatorRun { name, cell_mm, points, steps_per_ms, ns, stiffness_n_per_m } in all {
        let ms_us = 1e-3 * ns * (points * steps_per_ms) as f64;
        rows.push(cells([
            name.clone(),
            cell_mm.to_string(),
            points.to_string(),
            steps_per_ms.to_string(),
            digits(ms_us),
            digits(ns),
            percent(stiffness_n_per_m / truth),
        ]));
        let figure = json!({ "ms_us": ms_us, "ns": ns, "error": stiffness_n_per_m / truth - 1.0 });
        report.figure(&format!("{name}, {cell_mm} mm"), figure);
    }
    let header = ["", "cubes, mm", "points", "steps a ms", "µs a ms", "ns a point and step", "error of the stiffness"];
    report.table(&header.map(str::to_owned), &rows);
    restless.iter().for_each(|told| report.say(told));
}

fn of_palpate(cell_mm: f64) -> SimulatorRun {
    let model = block(BLOCK_M, 1e-3 * cell_mm, 0.45, DQuat::IDENTITY, "");
    let middle_m = DVec3::new(0.5 * BLOCK_M.x, 0.5 * BLOCK_M.y, BLOCK_M.z);
    let mut tissue = at_rest(&model);
    let force_n = DVec3::new(0.0, 0.0, -1e-3);
    let poke = Poke { point: None, centre_m: middle_m, force_n, falloff_per_m: 200.0, falloff_offset: 0.0 };
    tissue.push(0, Some(Push::Constant(poke)));
    (0..50).for_each(|_| tissue.step().unwrap());
    let times_s = least(if quick() { 5 } else { 100 }, &[std::cell::RefCell::new(tissue)], |tissue| {
        let mut tissue = tissue.borrow_mut();
        seconds(|| (0..5).for_each(|_| tissue.step().unwrap())).0 / 5.0
    });
    SimulatorRun {
        name: "Palpate".to_owned(),
        cell_mm,
        points: model.len() as u64,
        steps_per_ms: u64::from(model.plan.substeps),
        ns: 1e9 * times_s[0] / (model.len() as f64 * f64::from(model.plan.substeps)),
        stiffness_n_per_m: stiffness(&model, disc(middle_m)),
    }
}

/// A block of ν = 0, turned by `turn`, under a weak weight along its own z, held at its lowest place along its own `axis`, at rest.
fn weighed(size_m: DVec3, cell_m: f64, turn: DQuat, axis: DVec3, weight: [f64; 2]) -> Box<dyn Tissue> {
    let [gravity_m_per_s2, damping_per_s] = weight;
    let pull_m_per_s2 = -gravity_m_per_s2 * (turn * DVec3::Z);
    let more =
        format!("damping_per_s = {damping_per_s:?}\n[gravity]\nacceleration_m_per_s2 = {:?}", pull_m_per_s2.to_array());
    let stepping = format!("precision = \"f64\"\nsubsteps = {}", substeps(cell_m, 0.0) + 1);
    let obj = box_obj(size_m, |at| turn * at);
    let model = solid([&obj, OF_FILE], cell_m, 0.0, &held_below(turn * axis), [&more, &stepping]);
    let mut tissue = at_rest(&model);
    (0..3000).for_each(|_| tissue.step().unwrap());
    tissue
}

/// A flat rigid disc of radius a on a layer of thickness h that is bonded to a rigid base: κ = F·(1 − ν²)/(2·a·w·E) by a/h and ν
/// (Hayes, Keer, Herrmann and Mockros, Journal of Biomechanics 5, 1972, p. 541, table 1).
const LAYERS: [(f64, [(f64, f64); 2]); 3] =
    [(0.2, [(0.3, 1.207), (0.45, 1.252)]), (0.4, [(0.3, 1.472), (0.45, 1.599)]), (0.6, [(0.3, 1.784), (0.45, 2.031)])];

/// Cases whose solution is known.
fn theory(report: &mut BenchReport) {
    report.heading("Theory");
    report.say(
        "Blocks of 8 kPa. A column of 30 mm (ν = 0) that stands under its weight sinks by ρ·g·H²/(2·E) at its top. The end of a beam of \
         60 × 12 × 12 mm (ν = 0) that is held at one end sinks by ρ·g·L⁴·12/(8·E·h²) + ρ·g·L²/(2·G·5/6) under its weight (Timoshenko); turned: \
         by 20° about its axis, and as the block of the section on touch. A flat rigid disc of radius a = 6 mm on layers of thickness h on a firm base, 10·a wide, pressed 0.3 mm deep: \
         κ = F·(1 − ν²)/(2·a·w·E) of Hayes and others (Journal of Biomechanics 5, 1972, p. 541), whose layer is infinitely wide.",
    );
    let density_kg_per_m3 = 1060.0;
    let mut rows = Vec::new();
    let mut row = |report: &mut BenchReport, name: &str, cell_m: f64, found: f64, theory: f64, unit: &str| {
        rows.push(cells([
            name.to_owned(),
            digits(1e3 * cell_m),
            format!("{}{unit}", digits(found)),
            format!("{}{unit}", digits(theory)),
            percent(found / theory),
        ]));
        report.figure(&format!("{name}, {} mm", 1e3 * cell_m), json!({ "found": found, "theory": theory }));
    };
    let (column_m, beam_m) = (DVec3::new(0.03, 0.03, 0.03), DVec3::new(0.06, 0.012, 0.012));
    for cell_m in [0.0075, 0.00375] {
        let tissue = weighed(column_m, cell_m, DQuat::IDENTITY, DVec3::Z, [1.0, 60.0]);
        let top_m = DVec3::new(0.5 * column_m.x, 0.5 * column_m.y, column_m.z);
        let sinks_um = -1e6 * tissue.surface_displacement_m(top_m).z;
        let theory_um = 1e6 * density_kg_per_m3 * column_m.z.powi(2) / 16e3;
        row(report, "column", cell_m, sinks_um, theory_um, " µm");
    }
    let about_itself = DQuat::from_rotation_x(20_f64.to_radians());
    let beams = [("beam", DQuat::IDENTITY), ("beam, turned about its axis", about_itself), ("beam, turned", turned())];
    for (name, turn, cell_m) in beams.iter().flat_map(|(name, turn)| [0.006, 0.003, 0.0015].map(|m| (*name, *turn, m)))
    {
        let tissue = weighed(beam_m, cell_m, turn, DVec3::X, [0.01, 18.0]);
        let end_m = turn * DVec3::new(beam_m.x, 0.5 * beam_m.y, beam_m.z);
        let sinks_um = -1e6 * tissue.surface_displacement_m(end_m).dot(turn * DVec3::Z);
        let load_n_per_m4 = density_kg_per_m3 * 0.01;
        let bends_m = load_n_per_m4 * beam_m.x.powi(4) * 12.0 / (8.0 * 8e3 * beam_m.z.powi(2));
        let shears_m = load_n_per_m4 * beam_m.x.powi(2) / (2.0 * 4e3 * 5.0 / 6.0);
        row(report, name, cell_m, sinks_um, 1e6 * (bends_m + shears_m), " µm");
    }
    let radius_m = 0.006;
    for (part, truths) in LAYERS {
        for (nu, theory) in truths {
            let size_m = DVec3::new(0.06, 0.06, radius_m / part);
            let cell_m = 0.0025;
            let mut tissue = at_rest(&block(size_m, cell_m, nu, DQuat::IDENTITY, ""));
            let tip = Tip { shape: TipShape::RigidDisc, radius_m, friction: 0.0, ..Tip::default() };
            for step in 0..300 {
                let depth_m = (1e-5 * f64::from(step)).min(3e-4);
                tissue.pose(0, DVec3::new(0.03, 0.03, size_m.z - depth_m), tip);
                tissue.step().unwrap();
            }
            let force_n = tissue.tool_contact(0).unwrap().force_on_tool_n.z;
            let kappa = force_n * (1.0 - nu * nu) / (2.0 * radius_m * 3e-4 * 8e3);
            row(report, &format!("layer, a/h = {part}, ν = {nu}"), cell_m, kappa, theory, "");
        }
    }
    let header = ["", "cubes, mm", "found", "theory", "error"];
    report.table(&header.map(str::to_owned), &rows);
}

/// The error of stiffness by the size of cubes, at five places and turned.
fn touch(report: &mut BenchReport) -> Panel {
    report.heading("Touch");
    report.say(
        "A disc of 5 mm with even pressure on the middle of a block of 60 × 60 × 30 mm that is held below, 8 kPa: the error of \
         its stiffness against a solution with quadratic elements (ν = 0.45: 107.37, 0.49: 113.24, 0.495: 114.05 N/m). Moved: the \
         least and the largest of five places of the disc, up to half a cube along x and y; the truth of the middle serves for all. \
         Turned: the block by 20° about x and 30° about z in the lattice. Estimate: what `palpate check` says, divided by the \
         error in the middle.",
    );
    let sizes_m: &[f64] = if quick() { &[0.005] } else { &[0.005, 0.00375, 0.003, 0.0025] };
    let middle_m = DVec3::new(0.5 * BLOCK_M.x, 0.5 * BLOCK_M.y, BLOCK_M.z);
    let turn = turned();
    let (mut rows, mut in_line, mut turned_errors) = (Vec::new(), Vec::new(), Vec::new());
    for (nu, truth) in STIFFNESS_N_PER_M {
        for cell_m in sizes_m.iter().copied() {
            let model = block(BLOCK_M, cell_m, nu, DQuat::IDENTITY, "");
            let ratios = [[0.0, 0.0], [0.5, 0.0], [0.5, 0.5], [0.25, 0.25], [0.25, 0.5]]
                .map(|[x, y]| stiffness(&model, disc(middle_m + cell_m * DVec3::new(x, y, 0.0))) / truth);
            let least = ratios.iter().copied().fold(f64::INFINITY, f64::min);
            let largest = ratios.iter().copied().fold(0.0, f64::max);
            let turned = block(BLOCK_M, cell_m, nu, turn, "");
            let turned_ratio = stiffness(&turned, disc(turn * middle_m)) / truth;
            let estimate = MeshErrorEstimate::of(&model, disc(middle_m));
            let estimated = estimate.map_or(f64::NAN, |estimate| estimate.relative / (ratios[0] - 1.0));
            rows.push(cells([
                nu.to_string(),
                digits(1e3 * cell_m),
                model.len().to_string(),
                percent(ratios[0]),
                format!("{} … {}", percent(least), percent(largest)),
                percent(turned_ratio),
                digits(estimated),
            ]));
            report.figure(
                &format!("nu {nu} cell {cell_m}"),
                json!({ "in_line": ratios[0] - 1.0, "least": least - 1.0, "largest": largest - 1.0,
                    "turned": turned_ratio - 1.0, "estimate": estimated }),
            );
            if nu == 0.45 {
                in_line.push((1e3 * cell_m, 100.0 * (ratios[0] - 1.0)));
                turned_errors.push((1e3 * cell_m, 100.0 * (turned_ratio - 1.0)));
            }
        }
    }
    let header = ["ν", "cubes, mm", "points", "in the middle", "moved", "turned", "estimate ÷ error"];
    report.table(&header.map(str::to_owned), &rows);
    let most = in_line.iter().chain(&turned_errors).map(|at| at.1).fold(0.0, f64::max);
    let series = |name: &str, hue, points| Series { name: name.to_owned(), hue, look: Look::Full, points };
    Panel::Curves {
        title: "Error of stiffness under a disc of 5 mm, ν = 0.45".to_owned(),
        x: "mm, edge of a cube",
        y: "%",
        up: 0.0..1.1 * most,
        series: vec![series("in line", 0, in_line), series("turned", 1, turned_errors)],
    }
}

/// A sphere around 0 as an OBJ file, m.
fn sphere_obj(radius_m: f64) -> String {
    let (rings, spokes) = (60_u32, 120_u32);
    let mut text = format!("v 0 0 {radius_m:?}\n");
    for ring in 1..rings {
        let down = std::f64::consts::PI * f64::from(ring) / f64::from(rings);
        for spoke in 0..spokes {
            let along = std::f64::consts::TAU * f64::from(spoke) / f64::from(spokes);
            let at_m = radius_m * DVec3::new(down.sin() * along.cos(), down.sin() * along.sin(), down.cos());
            let _ = writeln!(text, "v {:?} {:?} {:?}", at_m.x, at_m.y, at_m.z);
        }
    }
    let last = 2 + (rings - 1) * spokes;
    let _ = writeln!(text, "v 0 0 {:?}", -radius_m);
    let vertex = |ring: u32, spoke: u32| match ring {
        0 => 1,
        _ if ring == rings => last,
        _ => 2 + (ring - 1) * spokes + spoke % spokes,
    };
    for (ring, spoke) in (0..rings).flat_map(|ring| (0..spokes).map(move |spoke| (ring, spoke))) {
        let [a, b, c, d] = [[0, 0], [1, 0], [1, 1], [0, 1]].map(|[down, on]| vertex(ring + down, spoke + on));
        if ring > 0 {
            let _ = writeln!(text, "f {a} {b} {d}");
        }
        if ring + 1 < rings {
            let _ = writeln!(text, "f {d} {b} {c}");
        }
    }
    text
}

/// The prostate of the scene with its nodules, and what holds it.
const PROSTATE: [&str; 3] = [
    "organ = { name = \"prostate\", edge_m = 0.0025, seed = 1 }",
    "fixed = [{ group = \"front\" }]",
    "[[inclusion]]\ncentre_m = [0.012, 0.004, 0.008]\nradius_m = 0.005\nstiffness_factor = 4.0\n\
     [[inclusion]]\ncentre_m = [-0.011, -0.006, 0.006]\nradius_m = 0.0035\nstiffness_factor = 4.0",
];

/// Stiffness on it over a nodule and in the middle, N/m, with 17 kPa (docs/solids.md).
const ON_PROSTATE: [(DVec3, f64); 2] =
    [(DVec3::new(0.012, 0.004, 0.01585), 217.3), (DVec3::new(0.0, 0.0, 0.01289), 203.8)];

/// Stiffness at the top of a sphere of 30 mm that is held 18 mm below its middle and lower, N/m (docs/solids.md).
const ON_SPHERE: f64 = 91.44;

/// Touch of curved solids.
fn curved(report: &mut BenchReport) {
    report.heading("Touch of curved solids");
    report.say(
        "The same disc at the top of a sphere of 30 mm radius that is held 18 mm below its middle and lower, and on the scene \
         `prostate`, over a nodule and in its middle: the error against quadratic tetrahedra of another code that fit the body \
         (docs/solids.md). ν = 0.45.",
    );
    let sizes_m: &[f64] = if quick() { &[0.005] } else { &[0.005, 0.00375, 0.003, 0.0025] };
    let sphere = sphere_obj(0.03);
    let mut rows = Vec::new();
    for cell_m in sizes_m.iter().copied() {
        let stepping = format!("substeps = {}", substeps(cell_m, 0.45));
        let of = |source: [&str; 2], fixed: &str, more: &str| {
            solid(source, cell_m, 0.45, fixed, [&format!("damping_per_s = 100\n{more}"), &stepping])
        };
        let held = "fixed = [{ plane_m = [0, 0, -0.018], normal = [0, 0, 1], within_m = 0.0 }]";
        let on_sphere = stiffness(&of([&sphere, OF_FILE], held, ""), disc(0.03 * DVec3::Z)) / ON_SPHERE;
        let [source, held, nodules] = PROSTATE;
        let prostate = of(["", source], held, nodules);
        let [nodule, middle] = ON_PROSTATE.map(|(at_m, truth)| stiffness(&prostate, disc(at_m)) / (truth * 8e3 / 17e3));
        rows.push(cells([digits(1e3 * cell_m), percent(on_sphere), percent(nodule), percent(middle)]));
        let figure = json!({ "sphere": on_sphere - 1.0, "nodule": nodule - 1.0, "middle": middle - 1.0 });
        report.figure(&format!("curved, cell {cell_m}"), figure);
    }
    report.table(&["cubes, mm", "sphere", "prostate, over a nodule", "in its middle"].map(str::to_owned), &rows);
}

/// Estimates of the error of the cells on random scenes.
fn estimates(report: &mut BenchReport) {
    report.heading("Estimates of random scenes");
    report.say(
        "Organs and turned blocks of random size and seed, with random cubes, ν and disc, pressed where a device presses first. The \
         error is that against cubes half and a quarter as large, extrapolated to cubes of no size with the order 1.5; the estimate \
         is what `palpate check` says, from cubes half as large.",
    );
    let mut rows = Vec::new();
    for seed in 1..=if quick() { 2 } else { 10 } {
        let dice = &mut fastrand::Rng::with_seed(seed);
        let between = |dice: &mut fastrand::Rng, least: f64, most: f64| least + (most - least) * dice.f64();
        let (cell_m, nu) = (between(dice, 0.004, 0.006), between(dice, 0.3, 0.49));
        let radius_m = between(dice, 0.004, 0.008);
        let mut obj = String::new();
        let (name, source) = match dice.u8(0..3) {
            0 => ("kidney", format!("organ = {{ name = \"kidney\", edge_m = 0.003, seed = {seed} }}")),
            1 => ("prostate", format!("organ = {{ name = \"prostate\", edge_m = 0.0025, seed = {seed} }}")),
            _ => {
                let size_m =
                    DVec3::new(between(dice, 0.04, 0.06), between(dice, 0.04, 0.06), between(dice, 0.02, 0.03));
                let turn = DQuat::from_rotation_z(dice.f64()) * DQuat::from_rotation_x(0.5 * dice.f64());
                obj = box_obj(size_m, |at| turn * (at - 0.5 * size_m));
                ("block", OF_FILE.to_owned())
            }
        };
        let model = |cell_m: f64| {
            let stepping = format!("substeps = {}", substeps(cell_m, nu));
            let fixed = "fixed = \"none\"\nfoundation_n_per_m3 = 2e5";
            solid([&obj, &source], cell_m, nu, fixed, ["damping_per_s = 100", &stepping])
        };
        let own = model(cell_m);
        let disc = Disc { radius_m, at_m: own.shape().pressed_m() };
        let [half, quarter] = [0.5, 0.25].map(|part| stiffness(&model(part * cell_m), disc));
        let truth = quarter - (half - quarter) / (1.5_f64.exp2() - 1.0);
        let error = stiffness(&own, disc) / truth;
        let estimate = MeshErrorEstimate::of(&own, disc).unwrap().relative;
        rows.push(cells([
            seed.to_string(),
            name.to_owned(),
            digits(1e3 * cell_m),
            digits(1e3 * radius_m),
            format!("{nu:.2}"),
            own.len().to_string(),
            percent(error),
            percent(1.0 + estimate),
            digits(estimate / (error - 1.0)),
        ]));
        report.figure(&format!("estimate, seed {seed}"), json!({ "error": error - 1.0, "estimate": estimate }));
    }
    let header =
        ["seed", "", "cubes, mm", "disc, mm", "ν", "points", "error of the stiffness", "estimate", "estimate ÷ error"];
    report.table(&header.map(str::to_owned), &rows);
}

/// Presses slowly to some depths.
fn deep(report: &mut BenchReport) {
    report.heading("Deep touch");
    report.say(
        "The same block, ν = 0.45, pressed at 10 mm/s: the force against that of quadratic elements with the same law at four \
         depths, of which 2.5 mm is half of the disc's radius.",
    );
    let sizes_m: &[f64] = if quick() { &[0.005] } else { &[0.005, 0.00375, 0.003, 0.0025] };
    let mut rows = Vec::new();
    for cell_m in sizes_m.iter().copied() {
        let model = block(BLOCK_M, cell_m, 0.45, DQuat::IDENTITY, "");
        let mut tissue = at_rest(&model);
        let mut errors = Vec::new();
        let mut depth_m = 0.0;
        for (to_m, truth_n) in DEEP_N {
            while depth_m < to_m {
                depth_m = (depth_m + 1e-5_f64).min(to_m);
                press(&mut *tissue, depth_m);
            }
            (0..150).for_each(|_| press(&mut *tissue, depth_m));
            errors.push(percent(tissue.tool_contact(0).unwrap().force_on_tool_n.z / truth_n));
        }
        rows.push([vec![digits(1e3 * cell_m)], errors].concat());
    }
    report.table(&["cubes, mm", "0.5 mm deep", "1 mm", "1.5 mm", "2 mm"].map(str::to_owned), &rows);
}

fn press(tissue: &mut dyn Tissue, depth_m: f64) {
    let tip = Tip { radius_m: RADIUS_M, friction: 0.0, ..Tip::default() };
    tissue.pose(0, DVec3::new(0.5 * BLOCK_M.x, 0.5 * BLOCK_M.y, BLOCK_M.z - depth_m), tip);
    tissue.step().unwrap();
}

fn lumps(report: &mut BenchReport) {
    report.heading("Lumps");
    report.say(
        "The same block, ν = 0.49, with a lump of radius 5 mm, five times as stiff: stiffness over its middle, divided by that \
         without the lump. Of another code, with tetrahedra that fit the lump: 1.261, 1.158 and 1.048 (docs/solids.md).",
    );
    let sizes_m: &[f64] = if quick() { &[0.005] } else { &[0.005, 0.00375, 0.003, 0.0025] };
    let middle_m = DVec3::new(0.5 * BLOCK_M.x, 0.5 * BLOCK_M.y, BLOCK_M.z);
    let mut rows = Vec::new();
    for cell_m in sizes_m.iter().copied() {
        let without = stiffness(&block(BLOCK_M, cell_m, 0.49, DQuat::IDENTITY, ""), disc(middle_m));
        let ratios = LUMPS.map(|(depth_m, _)| {
            let centre_m = (middle_m - depth_m * DVec3::Z).to_array();
            let lump = format!("[[inclusion]]\ncentre_m = {centre_m:?}\nradius_m = 0.005\nstiffness_factor = 5\n");
            stiffness(&block(BLOCK_M, cell_m, 0.49, DQuat::IDENTITY, &lump), disc(middle_m)) / without
        });
        let told =
            ratios.iter().zip(LUMPS).map(|(ratio, (_, truth))| format!("{ratio:.3} ({})", percent(ratio / truth)));
        rows.push([vec![digits(1e3 * cell_m)], told.collect()].concat());
        report.figure(&format!("lump cell {cell_m}"), json!(ratios));
    }
    report.table(&["cubes, mm", "8 mm deep", "10 mm", "15 mm"].map(str::to_owned), &rows);
}
