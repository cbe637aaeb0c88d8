//! The time of a step on triangle meshes: `central` in f32, all awake, at every width, on spheres of even and of
//! uneven triangles; beside it a plain loop, implementations in numba and Taichi, and a sheet of as many points.
//! Writes docs/benchmarks/mesh.{md,svg}. The peers run if PEERS names a Python that has them, as `make bench-mesh`
//! ensures. `-- --quick` measures the two smaller sizes, with fewer rounds.

#![allow(
    clippy::unwrap_used,
    clippy::disallowed_methods,
    clippy::cast_precision_loss,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    missing_docs
)]

mod peers;
mod report;
mod subject;

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::path::Path;

use glam::DVec3;
use palpate_tissue::body::surface::{MeshGraph, MeshSpring, MeshTrial};
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::{Lanes, Named};
use palpate_tissue::{Push, Tissue, at_rest};
use report::chart::{Look, Panel, Series};
use report::{BenchReport, digits, least, quick, seconds};
use serde_json::json;
use subject::{INTEGRATOR, LANE_NAMES, LANES, PRECISION, known, set};

/// Steps of one timing: the first of them bring the mesh into the caches.
const STEPS: usize = 6;

/// The phase per step of a point's anchor spring alone, rad, and (k/m)·dt²: of all that is measured on a mesh
/// (benches/peers/common.py has the squares).
const TURN: f64 = 0.1;
const PULL: f64 = 0.03;

/// Kinds of meshes: name, and the part of the edges that are considered for a flip. Those with flips are jittered.
const KINDS: [(&str, f64); 3] = [("regular", 0.0), ("mild", 0.1), ("irregular", 0.5)];

/// Places on the unit sphere, and triangles, counterclockwise from outside.
struct Sphere {
    places: Vec<DVec3>,
    triangles: Vec<[usize; 3]>,
}

impl Sphere {
    /// An icosahedron, each of whose triangles is divided in four `times` times.
    fn icosphere(times: u32) -> Self {
        let golden = f64::midpoint(1.0, 5.0_f64.sqrt());
        let mut places = Vec::new();
        for (a, b) in [(-1.0, golden), (1.0, golden), (-1.0, -golden), (1.0, -golden)] {
            places.extend([DVec3::new(a, b, 0.0), DVec3::new(0.0, a, b), DVec3::new(b, 0.0, a)]);
        }
        // The triangles are those of places at distance 2.
        let near = |a: usize, b: usize| (places[a].distance(places[b]) - 2.0).abs() < 1e-9;
        let mut triangles = Vec::new();
        for a in 0..12 {
            for b in a + 1..12 {
                for c in b + 1..12 {
                    if near(a, b) && near(b, c) && near(c, a) {
                        let outward = (places[b] - places[a]).cross(places[c] - places[a]).dot(places[a]) > 0.0;
                        triangles.push(if outward { [a, b, c] } else { [a, c, b] });
                    }
                }
            }
        }
        for _ in 0..times {
            let mut middles = BTreeMap::new();
            let mut divided = Vec::with_capacity(4 * triangles.len());
            for [a, b, c] in triangles {
                let mut middle = |a: usize, b: usize| {
                    *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
                        places.push(places[a] + places[b]);
                        places.len() - 1
                    })
                };
                let [d, e, f] = [middle(a, b), middle(b, c), middle(c, a)];
                divided.extend([[a, d, f], [d, b, e], [f, e, c], [d, e, f]]);
            }
            triangles = divided;
            places.iter_mut().for_each(|place| *place = place.normalize());
        }
        Sphere { places, triangles }
    }

    /// Moves each vertex by up to 0.3 edges, and flips edges at random: vertices keep 3 to 10 of them.
    fn disturb(&mut self, part: f64, dice: &mut fastrand::Rng) {
        let edge = (4.0 * std::f64::consts::PI / self.places.len() as f64 * 1.155).sqrt();
        for place in &mut self.places {
            let away = DVec3::from_array(std::array::from_fn(|_| 2.0 * dice.f64() - 1.0));
            *place = (*place + 0.3 * edge * away).normalize();
        }
        let mut valence = vec![0; self.places.len()];
        let mut of_edge = BTreeMap::new();
        for (index, corners) in self.triangles.iter().enumerate() {
            for k in 0..3 {
                of_edge.insert((corners[k], corners[(k + 1) % 3]), index);
                valence[corners[k]] += 1;
            }
        }
        let mut edges: Vec<(usize, usize)> = of_edge.keys().filter(|(a, b)| a < b).copied().collect();
        dice.shuffle(&mut edges);
        for (a, b) in edges {
            if dice.f64() >= part {
                continue;
            }
            let (Some(&left), Some(&right)) = (of_edge.get(&(a, b)), of_edge.get(&(b, a))) else { continue };
            let opposite = |corners: [usize; 3]| corners.into_iter().find(|corner| *corner != a && *corner != b);
            let (Some(c), Some(d)) = (opposite(self.triangles[left]), opposite(self.triangles[right])) else {
                continue;
            };
            let area = |a: usize, b: usize, c: usize| {
                let [a, b, c] = [a, b, c].map(|corner| self.places[corner]);
                (b - a).cross(c - a).dot(a) / (edge * edge)
            };
            let keeps = valence[a] > 3 && valence[b] > 3 && valence[c] < 10 && valence[d] < 10;
            if keeps && !of_edge.contains_key(&(c, d)) && area(a, d, c) > 0.2 && area(d, b, c) > 0.2 {
                of_edge.remove(&(a, b));
                of_edge.remove(&(b, a));
                for (index, corners) in [(left, [a, d, c]), (right, [d, b, c])] {
                    self.triangles[index] = corners;
                    (0..3).for_each(|k| _ = of_edge.insert((corners[k], corners[(k + 1) % 3]), index));
                }
                (valence[a], valence[b]) = (valence[a] - 1, valence[b] - 1);
                (valence[c], valence[d]) = (valence[c] + 1, valence[d] + 1);
            }
        }
    }

    /// Springs along the edges.
    fn graph(self) -> MeshGraph {
        let sides = self.triangles.iter().flat_map(|[a, b, c]| [(*a, *b), (*b, *c), (*c, *a)]);
        let edges: Vec<(usize, usize)> = sides.filter(|(a, b)| a < b).collect();
        let lengths = edges.iter().map(|(a, b)| self.places[*a].distance(self.places[*b]));
        let spacing_m = lengths.sum::<f64>() / edges.len() as f64;
        let spring =
            |(a, b)| MeshSpring { ends: [a, b].map(|end: usize| u32::try_from(end).unwrap()), stiffness_n_per_m: 1.0 };
        MeshGraph {
            rest_m: self.places,
            springs: edges.into_iter().map(spring).collect(),
            spacing_m,
            ..MeshGraph::default()
        }
    }
}

/// Returns the initial displacement of a vertex, spacings.
fn displaced(graph: &MeshGraph, vertex: usize) -> DVec3 {
    0.01 * DVec3::from_array((graph.rest_m[vertex] / graph.spacing_m).to_array().map(f64::sin))
}

/// The simplest implementation: springs in compressed rows, each evaluated from both ends, one vertex after the other.
/// Lengths are in spacings.
struct PlainLoop {
    starts: Vec<u32>,
    to: Vec<u32>,
    /// The vector of each spring at rest, and 1 over its square.
    rest: Vec<[f32; 4]>,
    u: Vec<[f32; 3]>,
    last: Vec<[f32; 3]>,
}

impl PlainLoop {
    fn new(graph: &MeshGraph) -> Self {
        let count = graph.rest_m.len();
        let mut around = vec![Vec::new(); count];
        for spring in &graph.springs {
            let [a, b] = spring.ends;
            around[a as usize].push(b);
            around[b as usize].push(a);
        }
        let mut plain =
            PlainLoop { starts: vec![0], to: Vec::new(), rest: Vec::new(), u: Vec::new(), last: Vec::new() };
        for (vertex, others) in around.iter_mut().enumerate() {
            others.sort_unstable();
            for other in others {
                let span = (graph.rest_m[*other as usize] - graph.rest_m[vertex]) / graph.spacing_m;
                plain.to.push(*other);
                plain.rest.push([span.x, span.y, span.z, 1.0 / span.length_squared()].map(|value| value as f32));
            }
            plain.starts.push(plain.to.len() as u32);
            plain.u.push(displaced(graph, vertex).as_vec3().to_array());
        }
        plain.last.clone_from(&plain.u);
        plain
    }

    fn step(&mut self, steps: usize) {
        let (turn, pull) = ((TURN * TURN) as f32, PULL as f32);
        for _ in 0..steps {
            for (vertex, last) in self.last.iter_mut().enumerate() {
                let own = self.u[vertex];
                let mut force = own.map(|u| -turn * u);
                let springs = self.starts[vertex] as usize..self.starts[vertex + 1] as usize;
                for (other, rest) in self.to[springs.clone()].iter().zip(&self.rest[springs]) {
                    let other = self.u[*other as usize];
                    let apart: [f32; 3] = std::array::from_fn(|c| other[c] - own[c]);
                    let excess: f32 = (0..3).map(|c| apart[c] * (2.0 * rest[c] + apart[c])).sum();
                    let q = excess * rest[3];
                    let root = (1.0 + q).sqrt();
                    let weight = pull * q / (root * (1.0 + root));
                    (0..3).for_each(|c| force[c] += weight * (rest[c] + apart[c]));
                }
                *last = std::array::from_fn(|c| own[c] + (own[c] - last[c]) + force[c]);
            }
            std::mem::swap(&mut self.u, &mut self.last);
        }
    }

    /// Writes the input of `Mesh` in benches/peers/common.py.
    fn write(&self, graph: &MeshGraph, path: &Path) {
        let places = graph.rest_m.iter().flat_map(|place| (*place / graph.spacing_m).as_vec3().to_array());
        let head = [graph.rest_m.len() as u32, self.to.len() as u32];
        let words = head.into_iter().chain(places.map(f32::to_bits));
        let words = words.chain(self.starts.iter().copied()).chain(self.to.iter().copied());
        std::fs::write(path, words.flat_map(u32::to_le_bytes).collect::<Vec<u8>>()).unwrap();
    }
}

/// The fastest kernel on a square sheet of about so many points, all of it in motion.
fn sheet(points: usize) -> Box<dyn Tissue> {
    let side = (points as f64).sqrt().round() as usize;
    let settings = [
        set(INTEGRATOR, "central"),
        set(PRECISION, "f32"),
        set("stepping.substeps", 1),
        set("sheet.points", format!("[{side}, {side}]")),
    ];
    let model = subject::model(&settings).unwrap();
    let mut tissue = at_rest(&model);
    let centre_m = model.shape().extent().middle_m();
    let force_n = 0.01 * DVec3::new(0.3, 0.0, -1.0);
    let push = Poke { point: None, centre_m, force_n, falloff_per_m: 0.0, falloff_offset: 0.0 };
    tissue.push(0, Some(Push::Constant(push)));
    tissue
}

/// Measurements on a mesh.
// There are three of them.
#[allow(clippy::large_enum_variant)]
enum Subject {
    Kernel(MeshTrial),
    Plain(PlainLoop),
    Sheet(Box<dyn Tissue>),
}

impl Subject {
    fn step(&mut self, steps: usize) {
        match self {
            Subject::Kernel(trial) => trial.step(steps),
            Subject::Plain(plain) => plain.step(steps),
            Subject::Sheet(tissue) => (0..steps).for_each(|_| tissue.step().unwrap()),
        }
    }

    /// Points, where these are not those of the mesh.
    fn points(&self, vertices: usize) -> usize {
        if let Subject::Sheet(tissue) = self { tissue.model().len() } else { vertices }
    }
}

/// Names beside those of the widths.
const PLAIN: &str = "plain loop";
const SHEET: &str = "sheet";
const PEERS: [(&str, &str); 2] = [("numba", "numba_mesh.py"), ("Taichi", "taichi_mesh.py")];

/// ns a vertex and step of each name, of a mesh; none where it was left out.
struct Measured {
    kind: &'static str,
    vertices: usize,
    ns: BTreeMap<String, f64>,
}

impl Measured {
    fn cell(&self, name: &str) -> String {
        self.ns.get(name).map_or("–".to_owned(), |ns| digits(*ns))
    }
}

fn measure(kind: &'static str, graph: &MeshGraph, widths: &[&str], rounds: usize) -> Measured {
    let lanes_of = |name: &str| Lanes::NAMES.iter().find(|entry| entry.0 == name).unwrap().1;
    let vertices = graph.rest_m.len();
    let mut subjects: Vec<(String, RefCell<Subject>)> = widths
        .iter()
        .map(|name| {
            let mut trial = MeshTrial::new(graph, TURN, PULL, lanes_of(name)).unwrap();
            trial.displace(|vertex| displaced(graph, vertex));
            ((*name).to_owned(), RefCell::new(Subject::Kernel(trial)))
        })
        .collect();
    let plain = PlainLoop::new(graph);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("mesh");
    plain.write(graph, &file);
    subjects.push((PLAIN.to_owned(), RefCell::new(Subject::Plain(plain))));
    subjects.push((SHEET.to_owned(), RefCell::new(Subject::Sheet(sheet(vertices)))));
    let times = least(rounds, &subjects, |(_, subject)| {
        let mut subject = subject.borrow_mut();
        subject.step(2);
        seconds(|| subject.step(STEPS)).0
    });
    let of = |((name, subject), time_s): (&(String, RefCell<Subject>), f64)| {
        (name.clone(), time_s * 1e9 / (STEPS * subject.borrow().points(vertices)) as f64)
    };
    let mut ns: BTreeMap<String, f64> = subjects.iter().zip(times).map(of).collect();
    if let Some(python) = peers::python() {
        for (name, script) in PEERS {
            let lines = peers::lines(&python, script, &[&file]);
            ns.extend(lines.iter().filter_map(|line| Some((name.to_owned(), line["least_ns"].as_f64()?))));
        }
    }
    Measured { kind, vertices, ns }
}

fn main() {
    let (rounds, sizes): (_, &[u32]) = if quick() { (20, &[4, 5]) } else { (80, &[4, 5, 6]) };
    let widths = known(LANES, &LANE_NAMES);
    let mut measured = Vec::new();
    for (kind, flips) in KINDS {
        for times in sizes {
            let mut sphere = Sphere::icosphere(*times);
            if flips > 0.0 {
                sphere.disturb(flips, &mut fastrand::Rng::with_seed(5));
            }
            measured.push(measure(kind, &sphere.graph(), &widths, rounds));
        }
    }
    let mut names = widths.clone();
    names.push(PLAIN);
    names.extend(PEERS.map(|(name, _)| name).into_iter().filter(|name| measured[0].ns.contains_key(*name)));

    let mut report = BenchReport::new("mesh", "The time of a step on a mesh", "make bench-mesh");
    report.say(
        "Time per vertex and step of `central` in f32, ns, on one thread, all awake, without the checks of a session: the \
         shortest of many timings in which the widths take turns. The meshes are spheres with three springs per vertex: \
         regular (divided icosahedra), and jittered by 0.3 edges with some (mild) or many (irregular) edges flipped at \
         random. The table compares the lane widths of the kernel with the plain loop of a compiled program \
         (benches/mesh.rs), and with the same arithmetic in numba and Taichi (benches/peers), all three with springs in \
         compressed rows. The last column is a step of a square sheet with as many points, ns per point, which has four \
         springs per point and the checks of a session.",
    );
    let header: Vec<&str> = ["mesh", "vertices"].into_iter().chain(names.iter().copied()).chain([SHEET]).collect();
    let row = |of: &Measured| {
        let cells = names.iter().chain([&SHEET]).map(|name| of.cell(name));
        [of.kind.to_owned(), of.vertices.to_string()].into_iter().chain(cells).collect()
    };
    report.table(&report::cells(&header), &measured.iter().map(row).collect::<Vec<_>>());
    report.heading("How many times faster");
    report.say("The time of the others divided by that of the fastest width.");
    let others: Vec<&str> = names.iter().copied().filter(|name| !widths.contains(name)).collect();
    let header: Vec<&str> = ["mesh", "vertices"].into_iter().chain(others.iter().copied()).collect();
    let ratios = |of: &Measured| {
        let fastest = widths.iter().map(|width| of.ns[*width]).fold(f64::INFINITY, f64::min);
        let ratio = |name: &&str| of.ns.get(*name).map_or("–".to_owned(), |ns| digits(ns / fastest));
        [of.kind.to_owned(), of.vertices.to_string()].into_iter().chain(others.iter().map(ratio)).collect()
    };
    report.table(&report::cells(&header), &measured.iter().map(ratios).collect::<Vec<_>>());
    let figures = measured.iter().map(|of| json!({ "mesh": of.kind, "vertices": of.vertices, "ns": of.ns }));
    report.figure("ns_per_vertex_step", figures.collect());

    let panels = KINDS.map(|(kind, _)| Panel::Lines {
        title: format!("A step on a mesh: {kind}"),
        x: "vertices",
        y: "ns a vertex and step",
        series: names
            .iter()
            .chain([&SHEET])
            .enumerate()
            .map(|(hue, name)| Series {
                name: (*name).to_owned(),
                hue,
                look: if widths.contains(name) { Look::Full } else { Look::Hollow },
                points: (measured.iter().filter(|of| of.kind == kind))
                    .filter_map(|of| Some((of.vertices as f64, *of.ns.get(*name)?)))
                    .collect(),
            })
            .collect(),
    });
    report.write(2, &panels);
}
