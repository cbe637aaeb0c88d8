//! The largest stable step: the predicted and the observed limit for every scheme, by stiffness and damping; and the
//! effect of a large force near it; and the same limit of organs. Writes docs/benchmarks/stability.{md,svg}.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::disallowed_methods,
    clippy::cast_precision_loss,
    clippy::cast_possible_truncation,
    missing_docs
)]

mod report;
mod subject;

use std::sync::Arc;

use glam::{DVec2, DVec3};
use palpate_session::Session;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::profile::{CentreProfile, LoadProfile, Poke, Profile, StrengthProfile};
use palpate_tissue::scene::{Body, BodyKind, Integrator, Mesh, Named, Scene};
use palpate_tissue::shape::PointId;
use palpate_tissue::{Model, Push, at_rest};
use report::chart::Panel;
use report::{BenchReport, cells, digits};
use serde_json::{Value, json};
use subject::{INTEGRATOR, integrators, known, set};

/// A small sheet; everything else is varied.
const SHEET: [&str; 3] = ["sheet.points=[9, 9]", "stepping.substeps=1", "stepping.precision=f64"];
const SPRINGS_N_PER_M: [f64; 4] = [0.0, 10.0, 100.0, 1000.0];
const VIRTUAL_N_PER_M: f64 = 5.0;
const DAMPINGS_N_S_PER_M: [f64; 5] = [0.0, 0.05, 0.5, 2.0, 10.0];

/// A motion that grows by less than [`GROWTH`] in this many steps counts as stable: less than 0.05 % per step.
const STEPS: u32 = 20_000;
const GROWTH: f64 = 1e4;

/// The outcomes for a sheet, from best to worst, with their colours.
const FATES: [(&str, f64); 4] = [("stable", 0.0), ("mended", 0.4), ("astray", 0.6), ("held", 1.0)];

/// A scheme and its conditions.
#[derive(Clone, Copy)]
struct SchemeCase {
    integrator: &'static str,
    spring_n_per_m: f64,
    damping_n_s_per_m: f64,
}

impl SchemeCase {
    fn model(self, step_s: f64) -> palpate_refusal::Result<Arc<Model>> {
        let varied = [
            set(INTEGRATOR, self.integrator),
            set("springs.stiffness_n_per_m", self.spring_n_per_m),
            set("anchor_springs.stiffness_n_per_m", VIRTUAL_N_PER_M),
            set("damping.coefficient_n_s_per_m", self.damping_n_s_per_m),
            set("stepping.rate_hz", 1.0 / step_s),
        ];
        let settings: Vec<String> = SHEET.map(str::to_owned).into_iter().chain(varied).collect();
        subject::model(&settings)
    }

    /// The limit that the scheme predicts for a sheet whose fastest vibration is exactly `omega_per_s`: for this,
    /// springs whose bound (12k + K″)/m is ω². `None` if it predicts stability at every step that a scene may have.
    fn predicted_s(self, omega_per_s: f64, mass_kg: f64) -> Option<f64> {
        let spring_n_per_m = (omega_per_s * omega_per_s * mass_kg - VIRTUAL_N_PER_M) / 12.0;
        // A remainder from rounding is not a spring.
        let spring_n_per_m = if spring_n_per_m < 1e-9 { 0.0 } else { spring_n_per_m };
        let bounded = SchemeCase { spring_n_per_m, ..self };
        largest_s(1.0 / omega_per_s, |step_s| bounded.model(step_s).unwrap().plan.stable)
    }

    /// The largest step at which a small kick, which leaves the motion linear, does not grow.
    fn observed_s(self, omega_per_s: f64) -> Option<f64> {
        largest_s(1.0 / omega_per_s, |step_s| self.after_kick(step_s).is_none())
    }

    /// The failure after a small kick, if there is one.
    fn after_kick(self, step_s: f64) -> Option<&'static str> {
        let model = self.model(step_s).unwrap();
        after_kick(&model, model.scene.sheet().unwrap().point([3, 4]))
    }

    /// The index in [`FATES`] of the outcome at this force, given that the sheet should move no farther than about
    /// `settled_m`.
    fn fate(self, step_s: f64, force_n: f64, settled_m: f64) -> usize {
        match self.pushed(step_s, force_n) {
            None => 3,
            Some((largest_m, _)) if largest_m > 3.0 * settled_m => 2,
            Some((_, guard_events)) => usize::from(guard_events > 0),
        }
    }

    /// The largest displacement under a force on the centre, and the number of guard events; `None` if the guard ended
    /// the session.
    fn pushed(self, step_s: f64, force_n: f64) -> Option<(f64, u64)> {
        let model = self.model(step_s).unwrap();
        let sheet = model.scene.sheet().unwrap();
        let mut session = Session::new(&model);
        let profile = LoadProfile {
            centre: CentreProfile::Hops(vec![(0, model.shape().rest_m(sheet.point([4, 4])))]),
            strength: StrengthProfile::Scaled(force_n * DVec3::new(0.6, 0.0, -0.8), Profile::Constant),
            falloff_per_m: 1.0 / sheet.spacing_m,
            falloff_offset: 0.0,
        };
        session.play_force(0, profile);
        let mut largest_m: f64 = 0.0;
        let mut due = Vec::new();
        for _ in 0..(1.0 / step_s).ceil().max(1000.0) as u32 {
            session.advance(&mut due, |session| largest_m = largest_m.max(session.tissue().largest_displacement_m()));
            if session.fault().is_some() {
                return None;
            }
        }
        Some((largest_m, session.tissue().guard_events()))
    }
}

/// The failure of a tissue after a small kick at a point, if there is one.
fn after_kick(model: &Arc<Model>, at: PointId) -> Option<&'static str> {
    let (spacing_m, step_s) = (model.shape().edge_m(), model.scene.stepping.rate_hz.recip());
    let small_m = 1e-9 * spacing_m;
    let push = Poke {
        point: None,
        centre_m: model.shape().rest_m(at),
        force_n: model.scene.point_mass_kg() * small_m / (step_s * step_s) * DVec3::new(1.0, 0.6, 0.3),
        falloff_per_m: 0.7 / spacing_m,
        falloff_offset: 0.0,
    };
    let mut tissue = at_rest(model);
    tissue.push(0, Some(Push::Constant(push)));
    let mut largest_m = 0.0;
    for step in 0..STEPS {
        if tissue.step().is_err() {
            return Some("grows");
        }
        if step == 0 {
            tissue.push(0, None);
        }
        // A check costs as much as a step.
        if step % 16 == 0 {
            largest_m = tissue.largest_displacement_m();
        }
        if largest_m > GROWTH * small_m {
            return Some("grows");
        }
        if tissue.guard_events() > 0 {
            return Some("guard acts");
        }
    }
    None
}

/// The largest step for which `holds`, by bisection between 1/64 and 64 times `about_s`. `None` if it holds for all, 0
/// if for none.
fn largest_s(about_s: f64, holds: impl Fn(f64) -> bool) -> Option<f64> {
    let (mut low, mut high) = (about_s / 64.0, 64.0 * about_s);
    if holds(high) {
        return None;
    }
    if !holds(low) {
        return Some(0.0);
    }
    while high / low > 1.0 + 1e-4 {
        let middle = (low * high).sqrt();
        if holds(middle) { low = middle } else { high = middle }
    }
    Some(low)
}

/// The fastest vibration of a sheet without fixed points or bending at rest, rad/s: the largest eigenvalue of its
/// stiffness by the power method. At rest a spring resists only along itself, so everything is in the plane.
fn fastest_per_s(model: &Model) -> f64 {
    let scene = &model.scene;
    let [nx, ny] = scene.sheet().unwrap().points;
    let (k, shear) = (scene.springs.stiffness_n_per_m, scene.springs.shear_stiffness_n_per_m);
    let springs = [((0, 1), k), ((1, 0), k), ((1, 1), shear), ((1, -1), shear)];
    let stiffness_of = |u: &[DVec2]| {
        let mut force: Vec<DVec2> = u.iter().map(|u| scene.anchor_stiffness_n_per_m * *u).collect();
        for ((di, dj), stiffness_n_per_m) in springs {
            let along = DVec2::new(di as f64, dj as f64).normalize();
            for i in 0..nx - di {
                for j in 0..ny {
                    let Some(there) = j.checked_add_signed(dj).filter(|there| *there < ny) else { continue };
                    let (a, b) = (i * ny + j, (i + di) * ny + there);
                    let pull = stiffness_n_per_m * along.dot(u[b] - u[a]) * along;
                    force[a] -= pull;
                    force[b] += pull;
                }
            }
        }
        force
    };
    // A start vector with a part of every vibration.
    let start = (0..model.len()).map(|n| DVec2::new((n as f64).sin(), (1.7 * n as f64).cos())).collect();
    (largest_eigenvalue(start, stiffness_of) / scene.sheet().unwrap().point_mass_kg).sqrt()
}

/// A vector of a point.
trait Moved: Copy + std::ops::MulAssign<f64> {
    fn squared(self) -> f64;
}

impl Moved for DVec2 {
    fn squared(self) -> f64 {
        self.length_squared()
    }
}

impl Moved for DVec3 {
    fn squared(self) -> f64 {
        self.length_squared()
    }
}

/// The largest eigenvalue of a linear map, by the power method.
fn largest_eigenvalue<V: Moved>(mut u: Vec<V>, map: impl Fn(&[V]) -> Vec<V>) -> f64 {
    let length = |u: &[V]| u.iter().map(|u| u.squared()).sum::<f64>().sqrt();
    let mut eigenvalue = 0.0;
    for _ in 0..20_000 {
        let scale = 1.0 / length(&u);
        u.iter_mut().for_each(|u| *u *= scale);
        u = map(&u);
        eigenvalue = length(&u);
    }
    eigenvalue
}

/// dt·ω at the limit by the textbook, for the schemes that it covers.
fn textbook(integrator: &str, omega_per_s: f64, damping_per_s: f64) -> Option<f64> {
    match integrator {
        "central" => Some(2.0),
        // (dt·ω)² + 2·C·dt/m = 4.
        "lagged" => {
            let half = damping_per_s / omega_per_s;
            Some((half * half + 4.0).sqrt() - half)
        }
        _ => None,
    }
}

/// dt·ω at the limit.
struct Limit {
    tissue: SchemeCase,
    omega_per_s: f64,
    predicted: Option<f64>,
    observed: Option<f64>,
    /// The failure just beyond the limit.
    beyond: Option<&'static str>,
    textbook: Option<f64>,
}

impl Limit {
    fn find(tissue: SchemeCase) -> Self {
        let model = tissue.model(1e-3).unwrap();
        let mass_kg = model.scene.sheet().unwrap().point_mass_kg;
        let omega_per_s = fastest_per_s(&model);
        let observed_s = tissue.observed_s(omega_per_s);
        Limit {
            tissue,
            omega_per_s,
            predicted: tissue.predicted_s(omega_per_s, mass_kg).map(|step_s| step_s * omega_per_s),
            observed: observed_s.map(|step_s| step_s * omega_per_s),
            beyond: observed_s.and_then(|step_s| tissue.after_kick(1.001 * step_s)),
            textbook: textbook(tissue.integrator, omega_per_s, tissue.damping_n_s_per_m / mass_kg),
        }
    }

    fn difference(&self) -> Option<f64> {
        let predicted = self.predicted.filter(|turn| *turn > 0.0)?;
        Some(100.0 * (self.observed? / predicted - 1.0))
    }

    fn row(&self) -> Vec<String> {
        let text = |value: Option<f64>| value.map_or("any".to_owned(), |value| format!("{value:.3}"));
        let tissue = &self.tissue;
        let difference = self.difference().map_or("–".to_owned(), |percent| format!("{percent:+.2}"));
        cells([
            tissue.integrator,
            &digits(tissue.damping_n_s_per_m),
            &digits(tissue.spring_n_per_m),
            &digits(self.omega_per_s),
            &self.textbook.map_or("–".to_owned(), |turn| format!("{turn:.3}")),
            &text(self.predicted),
            &text(self.observed),
            &difference,
            self.beyond.unwrap_or(""),
        ])
    }

    fn figures(&self) -> Value {
        json!({
            "integrator": self.tissue.integrator, "damping_n_s_per_m": self.tissue.damping_n_s_per_m,
            "spring_n_per_m": self.tissue.spring_n_per_m, "anchor_n_per_m": VIRTUAL_N_PER_M,
            "omega_per_s": self.omega_per_s, "textbook_turn": self.textbook, "predicted_turn": self.predicted,
            "observed_turn": self.observed, "difference_percent": self.difference(), "beyond": self.beyond,
        })
    }
}

/// Organs that are built in, with longer edges.
const ORGANS: [(&str, &str); 2] =
    [("gallbladder", "mesh.organ.edge_m=0.0035"), ("liver-organ", "mesh.organ.edge_m=0.008")];

/// An organ, any scheme.
struct Organ {
    name: &'static str,
    scene: Scene,
    omega_per_s: f64,
}

impl Organ {
    fn new(name: &'static str, edge: &str) -> Self {
        let sets = [edge, "stepping.substeps=1", "stepping.precision=f64"].map(str::to_owned);
        let scene = subject::scene_of(name, &sets).unwrap();
        let Body::Mesh(mesh) = &scene.body else { panic!("{name} is on a mesh") };
        let omega_per_s = fastest_of_mesh_per_s(&scene, mesh);
        Organ { name, scene, omega_per_s }
    }

    fn model(&self, integrator: &str, step_s: f64) -> Arc<Model> {
        let mut scene = self.scene.clone();
        scene.stepping.rate_hz = step_s.recip();
        scene.stepping.integrator = Integrator::NAMES.iter().find(|entry| entry.0 == integrator).unwrap().1;
        // The error of such a step is of no interest.
        Model::compile(&scene, &Limits { rehearsal_work: 0, ..Limits::default() }).unwrap()
    }

    /// Returns the limit of the scheme by the bound of the graph, and the observed limit.
    fn limit(&self, integrator: &'static str) -> OrganLimit {
        let Body::Mesh(mesh) = &self.scene.body else { panic!("{} is on a mesh", self.name) };
        let kicked = PointId::new(mesh.stiffest.vertex as usize);
        let about_s = 1.0 / self.omega_per_s;
        let fails = |step_s: f64| after_kick(&self.model(integrator, step_s), kicked);
        let observed_s = largest_s(about_s, |step_s| fails(step_s).is_none());
        let model = self.model(integrator, about_s);
        OrganLimit {
            organ: self.name,
            integrator,
            vertices: model.len(),
            bound_per_s: model.omega_bound_per_s,
            omega_per_s: self.omega_per_s,
            predicted_s: largest_s(about_s, |step_s| self.model(integrator, step_s).plan.stable),
            observed_s,
            beyond: observed_s.and_then(|step_s| fails(1.001 * step_s)),
        }
    }
}

/// The fastest vibration of a mesh at rest, rad/s: of its springs along themselves and its anchor springs, by the
/// power method.
fn fastest_of_mesh_per_s(scene: &Scene, mesh: &Mesh) -> f64 {
    let shape = scene.shape();
    let mass_kg = |vertex: usize| mesh.point_mass_kg * mesh.relative_mass(PointId::new(vertex));
    let springs: Vec<([usize; 2], DVec3, f64)> = (mesh.springs())
        .map(|(ends, part)| {
            let [a, b] = ends.map(|end| end as usize);
            let along = shape.rest_m(PointId::new(b)) - shape.rest_m(PointId::new(a));
            ([a, b], along.normalize(), part * scene.springs.stiffness_n_per_m)
        })
        .collect();
    let held_per_s2 = |vertex: usize| {
        scene.anchor_stiffness_n_per_m / mesh.point_mass_kg * (1.0 + mesh.extra_anchor(PointId::new(vertex)))
    };
    let accelerations = |u: &[DVec3]| {
        let mut forces_n = vec![DVec3::ZERO; u.len()];
        for ([a, b], along, stiffness) in &springs {
            let pull = stiffness * along.dot(u[*b] - u[*a]) * *along;
            forces_n[*a] -= pull;
            forces_n[*b] += pull;
        }
        let moved = |(vertex, force_n): (usize, DVec3)| {
            let is_fixed = shape.is_fixed(PointId::new(vertex));
            if is_fixed { DVec3::ZERO } else { force_n / mass_kg(vertex) + held_per_s2(vertex) * u[vertex] }
        };
        forces_n.into_iter().enumerate().map(moved).collect::<Vec<_>>()
    };
    let start = |n: usize| DVec3::new((n as f64).sin(), (1.7 * n as f64).cos(), (2.3 * n as f64).sin());
    largest_eigenvalue((0..shape.point_count()).map(start).collect(), accelerations).sqrt()
}

/// The largest step of an organ, s.
struct OrganLimit {
    organ: &'static str,
    integrator: &'static str,
    vertices: usize,
    /// ω_b, and the fastest vibration at rest.
    bound_per_s: f64,
    omega_per_s: f64,
    predicted_s: Option<f64>,
    observed_s: Option<f64>,
    beyond: Option<&'static str>,
}

impl OrganLimit {
    fn difference(&self) -> Option<f64> {
        Some(100.0 * (self.observed_s? / self.predicted_s? - 1.0))
    }

    fn row(&self) -> Vec<String> {
        let us = |step_s: Option<f64>| step_s.map_or("any".to_owned(), |step_s| digits(1e6 * step_s));
        let difference = self.difference().map_or("–".to_owned(), |percent| format!("{percent:+.1}"));
        cells([
            self.organ,
            &self.vertices.to_string(),
            self.integrator,
            &digits(self.bound_per_s),
            &digits(self.omega_per_s),
            &us(self.predicted_s),
            &us(self.observed_s),
            &difference,
            self.beyond.unwrap_or(""),
        ])
    }

    fn figures(&self) -> Value {
        json!({
            "organ": self.organ, "vertices": self.vertices, "integrator": self.integrator,
            "omega_bound_per_s": self.bound_per_s, "omega_per_s": self.omega_per_s, "predicted_s": self.predicted_s,
            "observed_s": self.observed_s, "difference_percent": self.difference(), "beyond": self.beyond,
        })
    }
}

/// The observed limits of one scheme, over k and C.
fn limit_panel(integrator: &str, limits: &[Limit]) -> Panel {
    let of = |damping: f64, spring: f64| {
        let mut limits = limits.iter().filter(|limit| limit.tissue.integrator == integrator);
        let limit =
            limits.find(|l| l.tissue.damping_n_s_per_m == damping && l.tissue.spring_n_per_m == spring).unwrap();
        let observed = limit.observed.map_or("any".to_owned(), |turn| format!("{turn:.3}"));
        let text = limit.difference().map_or(observed.clone(), |percent| format!("{observed} ({percent:+.1} %)"));
        // Green: no smaller than predicted. Red: smaller by a tenth.
        (text, limit.difference().map_or(0.0, |percent| (-percent / 10.0).clamp(0.0, 1.0)))
    };
    Panel::Cells {
        title: format!("{integrator}: largest dt·ω observed (and against predicted)"),
        x: ("k, N/m", cells(SPRINGS_N_PER_M)),
        y: ("C, N·s/m", cells(DAMPINGS_N_S_PER_M)),
        rows: DAMPINGS_N_S_PER_M.map(|damping| SPRINGS_N_PER_M.map(|spring| of(damping, spring)).to_vec()).to_vec(),
    }
}

/// The effect of a large force, over steps and forces, and whether everything within the predicted limit went well.
fn force_panel(integrator: &'static str) -> (Panel, Vec<Value>) {
    let tissue = SchemeCase { integrator, spring_n_per_m: 10.0, damping_n_s_per_m: 0.5 };
    let omega_per_s = tissue.model(1e-3).unwrap().omega_bound_per_s;
    let turns = [0.125, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, 2.25, 2.5, 3.0, 4.0];
    let forces_n = [0.01, 0.1, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0];
    let mut figures = Vec::new();
    let rows = forces_n.map(|force_n| {
        let (settled_m, _) = tissue.pushed(0.02 / omega_per_s, force_n).unwrap();
        turns
            .map(|turn| {
                let step_s = turn / omega_per_s;
                let (fate, shade) = FATES[tissue.fate(step_s, force_n, settled_m)];
                let promised = tissue.model(step_s).unwrap().plan.stable;
                figures.push(json!({
                    "integrator": integrator, "turn": turn, "force_n": force_n, "promised": promised,
                    "fate": fate,
                }));
                (if promised { "●".to_owned() } else { String::new() }, shade)
            })
            .to_vec()
    });
    let panel = Panel::Cells {
        title: format!("{integrator}: stable, mended, astray, held (● promised)"),
        x: ("dt·ω_b", cells(turns)),
        y: ("force, N", cells(forces_n)),
        rows: rows.to_vec(),
    };
    (panel, figures)
}

fn main() {
    let mut limits = Vec::new();
    let mut panels = Vec::new();
    let mut fates = Vec::new();
    for integrator in known(INTEGRATOR, &integrators()) {
        eprintln!("{integrator}: limits");
        for damping_n_s_per_m in DAMPINGS_N_S_PER_M {
            for spring_n_per_m in SPRINGS_N_PER_M {
                limits.push(Limit::find(SchemeCase { integrator, spring_n_per_m, damping_n_s_per_m }));
            }
        }
        panels.push(limit_panel(integrator, &limits));
        eprintln!("{integrator}: large forces");
        let (panel, figures) = force_panel(integrator);
        panels.push(panel);
        fates.extend(figures);
    }

    let organs = ORGANS.map(|(name, edge)| Organ::new(name, edge));
    let mut organ_limits = Vec::new();
    for organ in &organs {
        for integrator in known(INTEGRATOR, &integrators()) {
            eprintln!("{}: {integrator}", organ.name);
            organ_limits.push(organ.limit(integrator));
        }
    }

    let mut report = BenchReport::new("stability", "The largest stable step", "make bench-stability");
    report.say(&format!(
        "The sheet: 9 × 9 points of 10 g, K″ = {VIRTUAL_N_PER_M} N/m, f64, one substep per step. ω is the angular frequency \
         of its fastest vibration at rest, from the largest eigenvalue of its stiffness by the power method. *Predicted* is \
         the largest dt·ω that the scheme's stability limit allows for a sheet whose bound ω_b is this ω. *Observed* is the \
         largest dt·ω at which a perturbation of 1e-9 spacings grows by less than {GROWTH:.0e} in {STEPS} steps and the guard \
         does not act. Both come from bisection; *textbook* is 2 for central differences, and the root of (dt·ω)² + 2·C·dt/m \
         = 4 for the paper's scheme. A positive difference is on the safe side. With strong damping, a motion just beyond the \
         limit grows too slowly to be detected. *Beyond* is the failure just above the observed limit. A guard that acts on a \
         motion that does not grow causes a negative difference."
    ));
    let header = [
        "scheme",
        "C, N·s/m",
        "k, N/m",
        "ω, rad/s",
        "textbook dt·ω",
        "predicted",
        "observed",
        "difference, %",
        "beyond",
    ];
    report.table(&cells(header), &limits.iter().map(Limit::row).collect::<Vec<_>>());
    report.heading("Organs");
    report.say(
        "The built-in organs with longer edges, in f64, one substep per step. ω_b is the upper bound for any deformation, \
         from the graph of their springs, and ω the fastest vibration at rest, by the power method. The stability limit uses \
         ω_b, so *predicted* is the largest step that is stable with it. *Observed* is defined as above, with a perturbation \
         at the vertex that decides the bound.",
    );
    let organ_header = [
        "organ",
        "vertices",
        "scheme",
        "ω_b, rad/s",
        "ω, rad/s",
        "predicted, µs",
        "observed, µs",
        "difference, %",
        "beyond",
    ];
    report.table(&cells(organ_header), &organ_limits.iter().map(OrganLimit::row).collect::<Vec<_>>());
    report.figure("organs", organ_limits.iter().map(OrganLimit::figures).collect());
    report.heading("Large forces");
    let promised = fates.iter().filter(|fate| fate["promised"] == true);
    let broken: Vec<String> = promised
        .clone()
        .filter(|fate| fate["fate"] != "stable")
        .map(|fate| {
            format!("{} at dt·ω_b = {} and {} N: {}", fate["integrator"], fate["turn"], fate["force_n"], fate["fate"])
        })
        .collect();
    report.say(&format!(
        "k = 10 N/m, C = 0.5 N·s/m, a sudden oblique force on the centre, for a second and at least 1000 steps. ω_b bounds \
         the fastest vibration under any deformation. *Mended*: the guard continued the run with a shorter substep. *Astray*: \
         the result is finite, but more than three times as far as with a small step. *Held*: the guard ended the run. Of {} \
         runs within the predicted limit, {} were not stable. {}",
        promised.count(),
        broken.len(),
        broken.join("; ")
    ));
    report.figure("limits", limits.iter().map(Limit::figures).collect());
    report.figure("large_forces", json!(fates));
    report.write(2, &panels);
}
