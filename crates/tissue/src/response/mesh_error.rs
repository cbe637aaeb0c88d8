//! The error of a solid's cells under a disc, estimated by the same press on cells of another size.
//!
//! Under a disc the cells are too stiff by about C·aᵖ, with a their edge. Two sizes give C, and so the stiffness of
//! infinitely small cells (Richardson, Philosophical Transactions of the Royal Society A 210, 1911, p. 307). Cells half as
//! large are nearer to that, and are used while there are few; otherwise cells twice as large.

use std::sync::atomic::AtomicBool;

use super::force_law::Disc;
use super::tangent::{Accuracy, Course, Press};
use crate::body::model::Model;

/// p, of a disc of even pressure: measured on a block, 1.6 between cells of 5 and 2.5 mm under a disc of 5 mm.
const ORDER: f64 = 1.5;

/// Most points of a model with cells half as large: more take seconds.
const MAX_POINTS: usize = 50_000;

/// An estimate of the error that the size of the cells makes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeshErrorEstimate {
    /// Stiffness under the disc, divided by that of infinitely small cells, minus 1: positive if the cells are too stiff.
    pub relative: f64,
    /// Stiffness under the disc against a slow and small press along the normal, N/m.
    pub stiffness_n_per_m: f64,
    /// Radius of the disc, m.
    pub radius_m: f64,
    /// Edge of the cells that were pressed for comparison, m.
    pub compared_cell_m: f64,
}

impl MeshErrorEstimate {
    /// Estimates the error of the cells of a model under a disc, at a slow and small press. `None` for a tissue without
    /// cells, if nothing under the disc can move, and if the cells for comparison would not fit. Takes up to some seconds.
    /// Unwinds with a refusal if there is no memory ([`attempt`](crate::memory::attempt)).
    pub fn of(model: &Model, disc: Disc) -> Option<Self> {
        let edge_m = model.shape().edge_m();
        let is_finer = 8 * model.len() <= MAX_POINTS;
        let compared_cell_m = if is_finer { 0.5 * edge_m } else { 2.0 * edge_m };
        let compared = model.with_cells(compared_cell_m)?;
        let [own, other] = [model, &compared].map(|model| stiffness_n_per_m(model, disc));
        let (stiffness_n_per_m, other) = (own?, other?);
        let growth = ORDER.exp2();
        let true_n_per_m = if is_finer {
            other - (stiffness_n_per_m - other) / (growth - 1.0)
        } else {
            stiffness_n_per_m - (other - stiffness_n_per_m) / (growth - 1.0)
        };
        let is_sound = true_n_per_m > 0.0 && true_n_per_m.is_finite();
        is_sound.then(|| MeshErrorEstimate {
            relative: stiffness_n_per_m / true_n_per_m - 1.0,
            stiffness_n_per_m,
            radius_m: disc.radius_m,
            compared_cell_m,
        })
    }
}

/// Returns the stiffness against a slow and small press along the normal, N/m; `None` if nothing can move.
fn stiffness_n_per_m(model: &Model, disc: Disc) -> Option<f64> {
    let course = Course {
        radius_m: disc.radius_m,
        centre_m: disc.at_m,
        step_m: 0.0,
        count: 1,
        points: usize::MAX,
        within_m: f64::INFINITY,
    };
    let mut press = Press::new(model, course, Accuracy::COARSE);
    press.deepen(model, &AtomicBool::new(false));
    let stiffness = press.pressed().first()?.tangent.stiffness_n_per_m.z_axis.z;
    (stiffness > 0.0).then_some(stiffness)
}
