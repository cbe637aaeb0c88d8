//! The guard: periodic checks of a tissue's motion, and the checkpoint to go back to.
//!
//! Numbers must be finite; energy must not appear from nowhere; the springs' force must be near its prediction
//! from its history. Every [`INTERVAL_SUBSTEPS`] substeps a survey of the tissue (a sweep, about twice the cost
//! of a substep) checks them: E − E₀ ≤ W + [`MARGIN`]·(E₀ + |W|), with E₀ the energy at the last survey and W
//! the work of all tools since. Damping only removes energy, so the check stays valid. Increments are summed in
//! every substep, so a value that is not finite shows at once.
//!
//! If a check fails, the tissue goes back to the last checkpoint and repeats the tools' inputs since then with
//! half the substep; observers never see time go back. It keeps the shorter substep. After [`MAX_HALVINGS`]
//! halvings the guard gives up, at the checkpoint.
//!
//! A solid that comes to rest inside out is at rest in a shape that no material has; the guard sets it to its own.

pub(crate) mod checkpoint;
pub(crate) mod survey;
pub(crate) mod tool_bounds;
pub(crate) mod work_account;

use std::sync::Arc;

use crate::body::model::{Model, Plan};
use crate::body::severed::Severed;
use crate::body::tables::Elastic;
use crate::kernel::field::{Field, Layout, State};
use crate::kernel::real::Real;
use crate::memory;
pub use crate::state::guard::work_account::MARGIN;
use crate::tools::applied_force::Applied;

/// Number of substeps between two surveys, in which the guard checks the whole tissue and takes a checkpoint. A
/// snapshot's checkpoint is at most as many steps old.
pub const INTERVAL_SUBSTEPS: u64 = 256;

/// Largest error of a predicted displacement, as a fraction of the largest displacement; beyond it the check fails
/// with [`CheckFailure::Prediction`](crate::CheckFailure::Prediction).
pub const MAX_PREDICTION_ERROR: f64 = 0.5;

/// Largest number of times that a substep is halved (to a sixteenth) before the guard gives up and stops the tissue.
pub const MAX_HALVINGS: u32 = 4;

/// Largest number of inputs kept since the last checkpoint. With more, the next checkpoint is taken earlier.
pub(crate) const MAX_INPUTS: usize = 1024;

/// A rise of energy below this fraction of the largest so far is rounding noise in a tissue that has come to
/// rest. So is a rise below the square of ten times the error that sleeping tiles may have.
pub(crate) const NOISE: f64 = 1e-10;

/// Largest movement, in spacings, of points under tools that hold fixed points or rest on points at rest. Their
/// distances are differences of numbers of the size of the tissue.
pub(crate) const ROUNDING: f64 = 1e-12;

/// Returns the displacement, in spacings, beyond which a motion is a blow-up: far beyond any tissue, and far
/// below the root of the largest f32.
pub(crate) fn farthest_in_spacings(model: &Model) -> f64 {
    1e9 * model.shape().longest_side_m() / model.unit_m
}

/// Returns the place of a point whose values are not finite or beyond the bound, if there is one.
pub(crate) fn broken_point<T: Real>(model: &Model, layout: &Layout, state: &State<T>) -> Option<usize> {
    let farthest = T::of(farthest_in_spacings(model));
    let is_good = |field: &Field<T>, at: usize| field[at].is_finite() && field[at].magnitude() < farthest;
    (0..model.place_count()).find(|index| {
        let offsets = (0..3).map(|c| c * layout.plane + layout.offset(*index));
        !offsets.into_iter().all(|at| state.fields().all(|field| is_good(field, at)))
    })
}

/// Converts a state from one substep to another. `from` and `to` are plans of the same scheme; `springs` are
/// those of `from`, less the severed ones; `volume_change` is the growth of the volume.
pub(crate) fn convert<T: Real>(
    layout: &Layout,
    (springs, severed): (&Elastic<T>, &Severed),
    [from, to]: [&Plan; 2],
    applied: &Applied<T>,
    volume_change: f64,
    state: &mut State<T>,
) {
    let ratio = to.substep_s / from.substep_s;
    let points = layout.rows * layout.columns;
    // Compute all forces first: points are converted one by one, in place.
    let force = |index| {
        springs.gather(severed, layout, &state.u, volume_change, [index / layout.columns, index % layout.columns])
    };
    let forces: Vec<[T; 3]> = memory::collected((0..points).map(force), "the forces of a tissue");
    for (index, force) in forces.iter().enumerate() {
        let pushed = applied.force_at(layout, 0, [index / layout.columns, index % layout.columns]);
        for (c, n) in force.iter().enumerate() {
            let at = c * layout.plane + layout.offset(index);
            let mut history = state.history(n.wide(), from.scheme.kept_of_springs(), at);
            let now = [state.u[at].wide(), state.d[at].wide()];
            let [u, d] = from.scheme.resample(&to.scheme, ratio, now, pushed[c], &mut history);
            (state.u[at], state.d[at]) = (T::of(u), T::of(d));
            for (field, value) in state.kept.iter_mut().zip(&history[1..]) {
                Arc::make_mut(field)[at] = T::of(*value);
            }
        }
    }
}
