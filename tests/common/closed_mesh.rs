//! Random closed meshes of uneven triangles, as files.
#![allow(dead_code, unreachable_pub)]

use std::f64::consts::{PI, TAU};

/// Rings between two poles, stretched, each vertex off its place by up to a quarter of an edge.
pub struct ClosedMesh {
    pub places_m: Vec<[f64; 3]>,
    /// Vertices from 0.
    pub triangles: Vec<[u32; 3]>,
}

/// One of 2 to 8 rings with 4 to 15 vertices each, and two poles.
pub fn closed_mesh(dice: &mut fastrand::Rng) -> ClosedMesh {
    let (rings, around) = (dice.u32(2..9), dice.u32(4..16));
    let radius_m = 10_f64.powf(-2.5 + 1.5 * dice.f64());
    let stretched = [(); 3].map(|()| radius_m * (0.3 + 0.7 * dice.f64()));
    let off = 0.25 * PI / f64::from(rings.max(around / 2) + 1);
    let mut mesh = ClosedMesh { places_m: Vec::new(), triangles: Vec::new() };
    let mut vertex = |place: [f64; 3], dice: &mut fastrand::Rng| {
        let mut moved = |c: usize| stretched[c] * (place[c] + off * (2.0 * dice.f64() - 1.0));
        mesh.places_m.push([moved(0), moved(1), moved(2)]);
    };
    for ring in 0..rings {
        for k in 0..around {
            let down = PI * f64::from(ring + 1) / f64::from(rings + 1);
            let turn = TAU * f64::from(k) / f64::from(around);
            vertex([down.sin() * turn.cos(), down.sin() * turn.sin(), down.cos()], dice);
        }
    }
    vertex([0.0, 0.0, 1.0], dice);
    vertex([0.0, 0.0, -1.0], dice);
    let [top, bottom] = [rings * around, rings * around + 1];
    for k in 0..around {
        let next = (k + 1) % around;
        let last = (rings - 1) * around;
        mesh.triangles.extend([[top, k, next], [bottom, last + next, last + k]]);
        for ring in 1..rings {
            let [above, below] = [ring - 1, ring].map(|ring| ring * around);
            let (a, b, c, d) = (above + k, above + next, below + k, below + next);
            mesh.triangles.extend([[a, c, d], [a, d, b]]);
        }
    }
    mesh
}

impl ClosedMesh {
    /// As an OBJ file, in metres.
    pub fn obj(&self) -> String {
        let vertices = self.places_m.iter().map(|[x, y, z]| format!("v {x} {y} {z}\n"));
        let triangles = self.triangles.iter().map(|[a, b, c]| format!("f {} {} {}\n", a + 1, b + 1, c + 1));
        vertices.chain(triangles).collect()
    }

    /// The mean length of an edge, m.
    pub fn edge_m(&self) -> f64 {
        let sides = self.triangles.iter().flat_map(|[a, b, c]| [[a, b], [b, c], [c, a]]);
        let length_m = |[a, b]: [&u32; 2]| {
            let [a, b] = [a, b].map(|end| self.places_m[*end as usize]);
            (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>().sqrt()
        };
        sides.map(length_m).sum::<f64>() / (3 * self.triangles.len()) as f64
    }
}
