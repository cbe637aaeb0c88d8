//! Tests of a press beside a slit, against references that are solved by other means.
//!
//! For sheets and surfaces it is the balance of the springs that the slit leaves, for solids finite elements of the usual kind (eight
//! corners, 2³ points of integration) in which only cells with a whole face between them share its corners.
#![allow(clippy::unwrap_used, clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]

use std::sync::Arc;

use glam::DVec3;

use crate::compile::square_of_triangles;
use crate::interface::Tissue;
use crate::limits::Limits;
use crate::scene::Scene;
use crate::scene::profile::Poke;
use crate::state::cutting::faces::tests::cube;
use crate::{Model, Push, at_rest};
use palpate_haptics::{Tip, TipShape};

/// A slit across x at `x`, in the rows between two places along y, from a height up, m.
#[derive(Debug, Clone, Copy)]
struct Slit {
    x: f64,
    y: [f64; 2],
    above: f64,
}

impl Slit {
    /// Returns whether the line between two places crosses it.
    fn crosses(&self, a: DVec3, b: DVec3) -> bool {
        let crossed = a.lerp(b, (self.x - a.x) / (b.x - a.x));
        (a.x - self.x) * (b.x - self.x) < 0.0 && (self.y[0]..self.y[1]).contains(&crossed.y) && crossed.z > self.above
    }

    /// Leads a blade along it.
    fn cut(&self, tissue: &mut dyn Tissue) {
        let blade = Tip { shape: TipShape::Blade, radius_m: 0.001, edge_m: 0.1 * DVec3::Z, ..Tip::default() };
        for step in 0..=40 {
            let y = self.y[0] + (self.y[1] - self.y[0]) * f64::from(step) / 40.0;
            tissue.pose(0, DVec3::new(self.x, y, self.above), blade);
            tissue.step().unwrap();
        }
        tissue.release(0);
    }
}

fn push(centre_m: DVec3, force_n: DVec3, falloff_per_m: f64) -> Poke {
    Poke { point: None, centre_m, force_n, falloff_per_m, falloff_offset: 0.0 }
}

fn force_n(poke: &Poke, at_m: DVec3) -> DVec3 {
    poke.force_n * (-poke.falloff_per_m * at_m.distance(poke.centre_m)).exp()
}

/// Solves A·x = b by conjugate gradients, for a symmetric positive matrix.
fn solved(b: &[DVec3], times: impl Fn(&[DVec3]) -> Vec<DVec3>) -> Vec<DVec3> {
    let dot = |a: &[DVec3], b: &[DVec3]| a.iter().zip(b).map(|(a, b)| a.dot(*b)).sum::<f64>();
    let (mut x, mut residual, mut along) = (vec![DVec3::ZERO; b.len()], b.to_vec(), b.to_vec());
    let mut left = dot(&residual, &residual);
    let goal = 1e-20 * left;
    while left > goal {
        let a = times(&along);
        let step = left / dot(&along, &a);
        for at in 0..b.len() {
            x[at] += step * along[at];
            residual[at] -= step * a[at];
        }
        let next = dot(&residual, &residual);
        (0..b.len()).for_each(|at| along[at] = residual[at] + next / left * along[at]);
        left = next;
    }
    x
}

/// Points, springs between them, anchor springs, and forces.
struct SpringNetwork {
    at_m: Vec<DVec3>,
    springs: Vec<([usize; 2], f64)>,
    anchor_n_per_m: f64,
    forces_n: Vec<DVec3>,
}

impl SpringNetwork {
    /// Returns the energy of the springs, less the work of the forces, J.
    fn energy_j(&self, u_m: &[DVec3]) -> f64 {
        let of_point = |(u_m, force_n): (&DVec3, &DVec3)| (0.5 * self.anchor_n_per_m * *u_m - *force_n).dot(*u_m);
        let of_spring = |([a, b], k): &([usize; 2], f64)| {
            let rest_m = self.at_m[*b] - self.at_m[*a];
            0.5 * k * ((rest_m + u_m[*b] - u_m[*a]).length() - rest_m.length()).powi(2)
        };
        u_m.iter().zip(&self.forces_n).map(of_point).sum::<f64>() + self.springs.iter().map(of_spring).sum::<f64>()
    }

    /// Returns the displacements in balance, by Newton's method.
    fn settled_m(&self) -> Vec<DVec3> {
        let mut u_m = vec![DVec3::ZERO; self.at_m.len()];
        for _ in 0..200 {
            let mut residual: Vec<DVec3> =
                u_m.iter().zip(&self.forces_n).map(|(u_m, force_n)| *force_n - self.anchor_n_per_m * *u_m).collect();
            // Unit vector, stiffness along it and across it.
            let mut bonds = Vec::new();
            for ([a, b], k) in &self.springs {
                let rest_m = self.at_m[*b] - self.at_m[*a];
                let (span_m, length_m) = (rest_m + u_m[*b] - u_m[*a], rest_m.length());
                let unit = span_m.normalize();
                let pulled_n = k * (span_m.length() - length_m) * unit;
                residual[*a] += pulled_n;
                residual[*b] -= pulled_n;
                bonds.push(([*a, *b], unit, *k, k * (1.0 - length_m / span_m.length())));
            }
            let times = |x: &[DVec3]| {
                let mut product: Vec<DVec3> = x.iter().map(|x| self.anchor_n_per_m * *x).collect();
                for ([a, b], unit, along, across) in &bonds {
                    let by = x[*b] - x[*a];
                    let of_unit = by.dot(*unit) * *unit;
                    let force = *along * of_unit + across.max(0.0) * (by - of_unit);
                    product[*a] -= force;
                    product[*b] += force;
                }
                product
            };
            let change = solved(&residual, times);
            let moved =
                |by: f64| -> Vec<DVec3> { u_m.iter().zip(&change).map(|(u_m, change)| *u_m + by * *change).collect() };
            let before_j = self.energy_j(&u_m);
            let by = std::iter::successors(Some(1.0), |by| Some(0.5 * by))
                .find(|by| self.energy_j(&moved(*by)) <= before_j || *by < 1e-6);
            u_m = moved(by.unwrap_or(0.0));
            if change.iter().all(|change| change.length() < 1e-7) {
                return u_m;
            }
        }
        panic!("no balance found")
    }
}

/// Returns a sheet or a surface of triangles, of 24 × 24 cells of 5 mm, and its springs.
fn flat(kind: &str) -> (Arc<Model>, Vec<([usize; 2], f64)>) {
    let rest = "[anchor_springs]\nstiffness_n_per_m = 2\n[damping]\ncoefficient_n_s_per_m = 0.1\n\
                [stepping]\nprecision = \"f64\"\n[sleep]\ntolerance = 0\n";
    if kind == "surface" {
        let text = format!(
            "[mesh]\nfile = \"flat.obj\"\nunit = \"m\"\npoint_mass_kg = 1e-3\n[springs]\nstiffness_n_per_m = 40\nbending = 0\n{rest}"
        );
        let mesh = square_of_triangles([24, 24], 0.005);
        let scene = Scene::parse_given("flat", &text, ("flat.obj", mesh.as_bytes()), &Limits::default()).unwrap();
        let model = Model::compile(&scene, &Limits::default()).unwrap();
        let springs =
            scene.mesh().unwrap().springs().map(|(ends, factor)| (ends.map(|end| end as usize), 40.0 * factor));
        return (model, springs.collect());
    }
    let text = format!(
        "[sheet]\npoints = [25, 25]\nspacing_m = 0.005\npoint_mass_kg = 1e-3\n\
         [springs]\nstiffness_n_per_m = 40\nshear_stiffness_n_per_m = 20\nbending = true\n{rest}"
    );
    let model = Model::parse("flat", &text, &[]).unwrap();
    let mut springs = Vec::new();
    for at in 0..25 * 25 {
        let [i, j] = [at / 25, at % 25];
        for (by, k) in [([0, 1], 40.0), ([1, 0], 40.0), ([1, 1], 20.0), ([1, -1], 20.0), ([0, 2], 40.0), ([2, 0], 40.0)]
        {
            let (i, j): (isize, isize) = (i as isize + by[0], j as isize + by[1]);
            if i < 25 && (0..25).contains(&j) {
                springs.push(([at, (i * 25 + j) as usize], k));
            }
        }
    }
    (model, springs)
}

#[test]
fn a_press_beside_a_slit_moves_a_sheet_and_a_surface_as_the_springs_that_are_left_do() {
    let slit = Slit { x: 0.0612, y: [0.021, 0.099], above: -0.05 };
    let poke = push(DVec3::new(0.055, 0.06, 0.0), -0.03 * DVec3::Z, 120.0);
    for kind in ["sheet", "surface"] {
        let (model, all) = flat(kind);
        let at_m: Vec<DVec3> = model.points().map(|point| model.shape().rest_m(point)).collect();
        let left = |([a, b], _): &([usize; 2], f64)| !slit.crosses(at_m[*a], at_m[*b]);
        let severed = all.iter().filter(|spring| !left(spring)).count();
        let forces_n: Vec<DVec3> = at_m.iter().map(|at_m| force_n(&poke, *at_m)).collect();
        let settled_m = |springs: Vec<_>| {
            let (at_m, forces_n) = (at_m.clone(), forces_n.clone());
            SpringNetwork { at_m, springs, anchor_n_per_m: 2.0, forces_n }.settled_m()
        };
        let (whole_m, reference_m) =
            (settled_m(all.clone()), settled_m(all.iter().filter(|s| left(s)).copied().collect()));
        let mut tissue = at_rest(&model);
        slit.cut(&mut *tissue);
        assert_eq!(tissue.cuts().len(), severed, "{kind}");
        tissue.push(1, Some(Push::Constant(poke)));
        (0..1500).for_each(|_| tissue.step().unwrap());
        let most_m = reference_m.iter().map(|u_m| u_m.length()).fold(0.0, f64::max);
        let far = |from: &[DVec3]| {
            let of = |(point, from_m): (_, &DVec3)| tissue.point(point).displacement_m.distance(*from_m);
            model.points().zip(from).map(of).fold(0.0, f64::max) / most_m
        };
        let [error, change] = [far(&reference_m), far(&whole_m)];
        println!("{kind}: {error:.1e} of {most_m:.2e} m from the reference, {change:.2} from the whole tissue");
        assert!(error < 1e-3 && change > 0.1, "{kind}: {error} {change}");
    }
}

/// The stiffness matrix of a cubic element of edge 1, E = 1, by corners x before y before z.
fn element(poisson: f64) -> Vec<[[f64; 3]; 3]> {
    let (lambda, mu) = (poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson)), 0.5 / (1.0 + poisson));
    let mut matrix = vec![[[0.0; 3]; 3]; 64];
    for point in 0..8 {
        let at = [0, 1, 2].map(|axis| 0.5 + if point >> axis & 1 == 1 { 0.5 } else { -0.5 } / 3.0_f64.sqrt());
        let slopes: Vec<[f64; 3]> = (0..8)
            .map(|corner| {
                let part = |axis: usize| if corner >> axis & 1 == 1 { at[axis] } else { 1.0 - at[axis] };
                let sign = |axis: usize| if corner >> axis & 1 == 1 { 1.0 } else { -1.0 };
                [sign(0) * part(1) * part(2), sign(1) * part(0) * part(2), sign(2) * part(0) * part(1)]
            })
            .collect();
        for (pair, block) in matrix.iter_mut().enumerate() {
            let (a, b) = (slopes[pair / 8], slopes[pair % 8]);
            let dot: f64 = (0..3).map(|c| a[c] * b[c]).sum();
            for (i, j) in (0..9).map(|at| (at / 3, at % 3)) {
                let same = if i == j { mu * dot } else { 0.0 };
                block[i][j] += 0.125 * (lambda * a[i] * b[j] + mu * a[j] * b[i] + same);
            }
        }
    }
    matrix
}

/// Returns the displacements of the corners [i, j, k] of a cube of `side`³ elements that is held below, m, as those of the elements around
/// them with the least x; `poke` presses, and a slit severs faces between the elements. The force on a corner divides among its copies by
/// their elements.
fn by_elements(
    side: usize,
    edge_m: f64,
    youngs_modulus_pa: f64,
    poke: &Poke,
    slit: Option<Slit>,
) -> impl Fn([usize; 3]) -> DVec3 {
    let cells = side.pow(3);
    let place = move |cell: usize| [cell % side, cell / side % side, cell / side / side];
    let at = |cell: usize, by: f64| DVec3::from_array(place(cell).map(|at| (at as f64 + by) * edge_m));
    // Corner of each element, united across whole faces.
    let mut of: Vec<usize> = (0..8 * cells).collect();
    fn root(of: &[usize], mut at: usize) -> usize {
        while of[at] != at {
            at = of[at];
        }
        at
    }
    for cell in 0..cells {
        for axis in 0..3 {
            let beyond = cell + side.pow(axis as u32);
            if place(cell)[axis] + 1 == side || slit.is_some_and(|slit| slit.crosses(at(cell, 0.5), at(beyond, 0.5))) {
                continue;
            }
            for corner in (0..8).filter(|corner| corner >> axis & 1 == 0) {
                let [a, b] = [8 * cell + (corner | 1 << axis), 8 * beyond + corner].map(|at| root(&of, at));
                of[a.max(b)] = a.min(b);
            }
        }
    }
    let nodes: Vec<usize> = (0..8 * cells).map(|at| root(&of, at)).collect();
    let corner_of = move |at: usize| [0, 1, 2].map(|axis| place(at / 8)[axis] + ((at % 8) >> axis & 1));
    let mut elements = std::collections::BTreeMap::<[usize; 3], f64>::new();
    (0..8 * cells).for_each(|at| *elements.entry(corner_of(at)).or_default() += 1.0);
    let is_held = |at: usize| corner_of(at)[2] == 0;
    let mut forces_n = vec![DVec3::ZERO; 8 * cells];
    for (at, node) in nodes.iter().enumerate().filter(|(at, _)| !is_held(*at)) {
        let corner = corner_of(at);
        forces_n[*node] += force_n(poke, edge_m * DVec3::from_array(corner.map(|at| at as f64))) / elements[&corner];
    }
    let matrix = element(0.3);
    let times = |x: &[DVec3]| {
        let mut product = vec![DVec3::ZERO; x.len()];
        for nodes in nodes.chunks_exact(8) {
            for (a, node) in nodes.iter().enumerate().filter(|(_, node)| !is_held(**node)) {
                for (b, other) in nodes.iter().enumerate() {
                    let (block, x) = (&matrix[8 * a + b], x[*other]);
                    let row = |i: usize| block[i][0] * x.x + block[i][1] * x.y + block[i][2] * x.z;
                    product[*node] += youngs_modulus_pa * edge_m * DVec3::new(row(0), row(1), row(2));
                }
            }
        }
        product
    };
    let u_m = solved(&forces_n, times);
    move |corner| {
        let first = (0..8 * cells).find(|at| corner_of(*at) == corner);
        first.map_or(DVec3::ZERO, |at| u_m[nodes[at]])
    }
}

#[test]
fn a_press_beside_a_slit_moves_a_solid_as_finite_elements_with_the_slit_do() {
    let side = 12;
    let model = cube(side);
    let edge_m = model.unit_m;
    let middle_m = 0.5 * edge_m * side as f64;
    // From one rim past the middle, half as deep as the block.
    let slit = Slit { x: middle_m + 0.1 * edge_m, y: [-0.5 * edge_m, 1.45 * middle_m], above: middle_m };
    let poke =
        push(DVec3::new(middle_m - 2.0 * edge_m, middle_m, 2.0 * middle_m), DVec3::new(-2e-5, 0.0, -6e-5), 250.0);
    let mut tissue = at_rest(&model);
    slit.cut(&mut *tissue);
    assert_eq!(tissue.cuts().len(), 9 * 6);
    tissue.push(1, Some(Push::Constant(poke)));
    (0..500).for_each(|_| tissue.step().unwrap());
    let [reference, whole] = [Some(slit), None].map(|slit| by_elements(side, edge_m, 1e4, &poke, slit));
    let (mut most_m, mut error_m, mut change_m) = (0.0_f64, 0.0_f64, 0.0_f64);
    // Along the top, across the slit and beside it; corners in the slit are two.
    for (i, j) in (0..=side).flat_map(|i| [3, 6].map(|j| (i, j))).filter(|(i, _)| *i != side / 2) {
        let corner = [i, j, side];
        let point = model.shape().nearest(edge_m * DVec3::from_array(corner.map(|at| at as f64)));
        let (u_m, reference_m) = (tissue.point(point).displacement_m, reference(corner));
        most_m = most_m.max(reference_m.length());
        error_m = error_m.max(u_m.distance(reference_m));
        change_m = change_m.max(whole(corner).distance(reference_m));
    }
    println!(
        "{:.2} % of {most_m:.2e} m from the reference; the slit changes {:.2} %",
        100.0 * error_m / most_m,
        100.0 * change_m / most_m
    );
    assert!(error_m < 0.05 * most_m && change_m > 0.15 * most_m, "{error_m} {change_m} of {most_m} m");
}
