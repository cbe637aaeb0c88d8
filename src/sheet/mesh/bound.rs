//! How fast the springs of a mesh can vibrate, and which point decides it.
//!
//! No deformation makes the stiffness matrix larger than the graph's Laplacian with weights k (`stability`). Divided by
//! the roots of both masses it is symmetric, with the magnitudes
//!
//! B_ii = Σ_j k_ij/m_i + extra_i,  B_ij = k_ij/√(m_i·m_j).
//!
//! For any positive vector v, no eigenvalue exceeds the largest (B·v)_i/v_i. v = 1 gives the bound of Gershgorin. Each
//! product with B brings v nearer to the fastest vibration, and the bound nearer to B's largest eigenvalue.

use super::graph::MeshGraph;
use super::order::TABLES;
use crate::memory;

/// Products with B: enough to be within a few percent of its largest eigenvalue.
const ROUNDS: usize = 24;

/// The result of [`fastest`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fastest {
    /// Upper bound of all eigenvalues times the mass of reference, N/m.
    pub stiffness_n_per_m: f64,
    /// The vertex that moves most in the fastest vibration: its springs, or those around it, decide the bound.
    pub vertex: u32,
}

/// Upper bound of the eigenvalues of the springs of a valid graph and its extra virtual springs, where the point of
/// reference has the virtual stiffness `virtual_n_per_m`.
#[allow(clippy::cast_possible_truncation)]
pub fn fastest(graph: &MeshGraph, virtual_n_per_m: f64) -> Fastest {
    let count = graph.rest_m.len();
    let mut own = memory::collected((0..count as u32).map(|point| graph.extra(point) * virtual_n_per_m), TABLES);
    let mut shared = memory::with_room(graph.springs.len(), TABLES);
    for spring in &graph.springs {
        let [a, b] = spring.ends;
        let (of_a, of_b) = (graph.mass(a), graph.mass(b));
        own[a as usize] += spring.stiffness_n_per_m / of_a;
        own[b as usize] += spring.stiffness_n_per_m / of_b;
        shared.push(spring.stiffness_n_per_m / (of_a * of_b).sqrt());
    }
    // A softer point lowers its own row, at most to 0: a larger row keeps the bound true.
    own.iter_mut().for_each(|own| *own = own.max(0.0));
    let (mut v, mut product) = (memory::filled(count, 1.0, TABLES), memory::filled(count, 0.0, TABLES));
    let mut least = f64::INFINITY;
    for _ in 0..ROUNDS {
        product.iter_mut().zip(own.iter().zip(&v)).for_each(|(product, (own, v))| *product = own * v);
        for (spring, shared) in graph.springs.iter().zip(&shared) {
            let [a, b] = spring.ends.map(|end| end as usize);
            product[a] += shared * v[b];
            product[b] += shared * v[a];
        }
        let most = product.iter().zip(&v).map(|(product, v)| product / v).fold(0.0, f64::max);
        least = least.min(most);
        if most == 0.0 {
            break;
        }
        // A part of v itself keeps it positive where no spring is.
        v.iter_mut().zip(&product).for_each(|(v, product)| *v = 0.5 * *v + product / most);
    }
    let mut vertex = 0;
    for (index, value) in v.iter().enumerate() {
        if *value > v[vertex] {
            vertex = index;
        }
    }
    // Covers the rounding errors of the sums.
    Fastest { stiffness_n_per_m: least * (1.0 + 1e-9), vertex: vertex as u32 }
}
