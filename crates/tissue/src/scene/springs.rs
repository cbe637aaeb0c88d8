//! The springs between neighbours that a scene gives.

/// Springs between neighbours: the force on a from a spring a–b is k (L − L0)(x_b − x_a)/L (Hooke's law).
#[derive(Debug, Clone, PartialEq)]
pub struct Springs {
    /// k of the structural springs, (1,0) and (0,1) on a sheet, N/m; on a mesh, k of a reference edge.
    pub stiffness_n_per_m: f64,
    /// k of the shear springs (1,1) and (1,−1) of a sheet, N/m; without effect on a mesh.
    pub shear_stiffness_n_per_m: f64,
    /// Whether a sheet has bending springs (2,0) and (0,2), with the structural k. (On a mesh, see
    /// [`Mesh::bending`](super::Mesh::bending).)
    pub bending: bool,
    /// Tension T₀ of the tissue at rest, N for each metre across: a cut gapes by it. The same in all directions; 0 or more.
    pub pretension_n_per_m: f64,
}

/// The largest part of its length by which the pretension may stretch a spring.
pub const MAX_PRESTRAIN: f64 = 0.5;

impl Springs {
    /// Returns springs that all have the same k, N/m, without bending springs.
    pub fn alike(stiffness_n_per_m: f64) -> Self {
        Springs {
            stiffness_n_per_m,
            shear_stiffness_n_per_m: stiffness_n_per_m,
            bending: false,
            pretension_n_per_m: 0.0,
        }
    }

    /// Returns springs that are `by` times as stiff.
    #[must_use]
    pub fn stiffened(&self, by: f64) -> Self {
        let (stiffness_n_per_m, shear_stiffness_n_per_m) =
            (by * self.stiffness_n_per_m, by * self.shear_stiffness_n_per_m);
        Springs { stiffness_n_per_m, shear_stiffness_n_per_m, ..*self }
    }
}
