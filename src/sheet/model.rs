//! What of a sheet never changes: compiled from a scene once, checked once, shared by all who read it.

use std::sync::Arc;

use super::integrate::{self, Oscillator, Plan};
use super::stability;
use crate::limits::Limits;
use crate::refusal::{Reason, Refusal, Result};
use crate::scene::{Precision, Scene};

/// The immutable half of a sheet.
#[derive(Debug)]
pub struct Model {
    /// What it was compiled from.
    pub scene: Scene,
    /// Points along x (rows) and along y (within a row).
    pub points: [usize; 2],
    /// Springs, one entry for all of the same direction.
    pub links: Vec<Link>,
    /// Places of the fixed points, rising.
    pub fixed: Vec<usize>,
    /// ω_b = √((largest spring stiffness + K″)/m): no vibration is faster, under any deformation, rad/s.
    pub omega_bound_per_s: f64,
    /// The scheme.
    pub plan: Plan,
    /// What `auto` became.
    pub precision: Precision,
    /// What a user should know, in words.
    pub warnings: Vec<String>,
}

/// The springs from each point to the point (di, dj) farther, if that is on the sheet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Link {
    /// Rows farther: 0 to 2.
    pub di: usize,
    /// Columns farther: −1 to 2.
    pub dj: isize,
    /// k, N/m.
    pub stiffness_n_per_m: f64,
    /// The rest vector, in the rest plane, m.
    pub rest_m: [f64; 2],
}

/// Below this tolerance of a scene f32 is not enough.
const F32_TOLERANCE: f64 = 1e-6;

impl Model {
    /// Compiles a scene, after checking it.
    pub fn compile(scene: &Scene, limits: &Limits) -> Result<Arc<Self>> {
        scene.check(limits)?;
        let springs = &scene.springs;
        let h = scene.sheet.spacing_m;
        let link = |di: usize, dj: isize, stiffness_n_per_m| {
            #[allow(clippy::cast_precision_loss)]
            let rest_m = [di as f64 * h, dj as f64 * h];
            Link { di, dj, stiffness_n_per_m, rest_m }
        };
        let (structural, shear) = (springs.stiffness_n_per_m, springs.shear_stiffness_n_per_m);
        let mut links = vec![link(0, 1, structural), link(1, 0, structural), link(1, 1, shear), link(1, -1, shear)];
        if springs.flexion {
            links.extend([link(0, 2, structural), link(2, 0, structural)]);
        }
        // A spring of no stiffness costs nothing.
        links.retain(|link| link.stiffness_n_per_m > 0.0);

        let mass_kg = scene.sheet.point_mass_kg;
        let stiffness = stability::largest_stiffness_n_per_m(springs) + scene.virtual_stiffness_n_per_m;
        let omega_bound_per_s = (stiffness / mass_kg).sqrt();
        let oscillator = Oscillator {
            mass_kg,
            damping_n_s_per_m: scene.damping_n_s_per_m,
            omega_per_s: omega_bound_per_s,
            step_s: scene.stepping.rate_hz.recip(),
        };
        let plan = integrate::plan(scene.stepping.integrator, scene.stepping.substeps, &oscillator);
        if plan.substeps > limits.substeps {
            let message = format!(
                "would need {} substeps a step for stability, above the limit of {}: the springs are too stiff for \
                 points so light at this rate",
                plan.substeps, limits.substeps
            );
            return Err(Refusal::new(Reason::TooLarge, "stepping.substeps", message));
        }
        let mut warnings = Vec::new();
        if !plan.stable {
            warnings.push(format!(
                "stepping.substeps: {} is above the stability bound of the scheme; the sheet may blow up \
                 (substep × fastest vibration = {:.3})",
                plan.substeps,
                plan.substep_s * omega_bound_per_s
            ));
        }
        let precision = match scene.stepping.precision {
            Precision::Auto if scene.stepping.tolerance < F32_TOLERANCE => Precision::F64,
            Precision::Auto => Precision::F32,
            given => given,
        };
        let fixed = scene.sheet.fixed_indices();
        let points = scene.sheet.points;
        Ok(Arc::new(Model { scene: scene.clone(), points, links, fixed, omega_bound_per_s, plan, precision, warnings }))
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.points[0] * self.points[1]
    }

    /// A sheet has at least one point.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// The grid place of an array place.
    pub fn point_of(&self, index: usize) -> [usize; 2] {
        [index / self.points[1], index % self.points[1]]
    }

    /// The array place of a grid place that is on the sheet.
    pub fn index_of(&self, [i, j]: [usize; 2]) -> usize {
        i * self.points[1] + j
    }
}
