//! The time of a step on triangle meshes: `central` in f32, all awake, at every width, on spheres of even and of uneven
//! triangles. Prints a page. `-- --quick` measures the two smaller sizes, with fewer rounds.

#![allow(clippy::unwrap_used, clippy::disallowed_methods, clippy::cast_precision_loss, missing_docs)]

mod report;
mod subject;

use std::collections::BTreeMap;

use glam::DVec3;
use palpate::scene::{Lanes, Named};
use palpate::sheet::mesh::{MeshGraph, MeshSpring, Trial};
use report::{Report, digits, least, quick, seconds};
use subject::{LANE_NAMES, LANES, known};

/// Steps of one timing: the first of them bring the mesh into the caches.
const STEPS: usize = 6;

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

fn main() {
    let (rounds, sizes): (_, &[u32]) = if quick() { (20, &[4, 5]) } else { (80, &[4, 5, 6]) };
    let names = known(LANES, &LANE_NAMES);
    let lanes_of = |name: &str| Lanes::NAMES.iter().find(|entry| entry.0 == name).unwrap().1;
    let mut report = Report::new("mesh", "The time of a step on a mesh", "cargo bench --bench mesh");
    report.say(
        "ns a vertex and step of `central` in f32, one thread, all awake, without the checks of a session: the least of \
         many timings in which the widths take turns. Spheres with three springs a vertex: regular (divided \
         icosahedra), and jittered by 0.3 edges with some (mild) or many (irregular) edges flipped at random.",
    );
    let header = ["mesh", "vertices"].into_iter().chain(names.iter().copied()).map(str::to_owned);
    let mut rows = Vec::new();
    for (kind, flips) in KINDS {
        for times in sizes {
            let mut sphere = Sphere::icosphere(*times);
            if flips > 0.0 {
                sphere.disturb(flips, &mut fastrand::Rng::with_seed(5));
            }
            let graph = sphere.graph();
            let vertices = graph.rest_m.len();
            let at = |vertex: usize| graph.rest_m[vertex] / graph.spacing_m;
            let trials: Vec<_> = names
                .iter()
                .map(|name| {
                    let mut trial = Trial::new(&graph, 0.1, 0.03, lanes_of(name)).unwrap();
                    trial.displace(|vertex| 0.01 * DVec3::from_array(at(vertex).to_array().map(f64::sin)));
                    std::cell::RefCell::new(trial)
                })
                .collect();
            let times = least(rounds, &trials, |trial| {
                let mut trial = trial.borrow_mut();
                trial.step(2);
                seconds(|| trial.step(STEPS)).0
            });
            let ns = times.into_iter().map(|time| digits(time * 1e9 / (STEPS * vertices) as f64));
            rows.push([kind.to_owned(), vertices.to_string()].into_iter().chain(ns).collect());
        }
    }
    report.table(&header.collect::<Vec<_>>(), &rows);
    report.print();
}
