//! What the stages of a step read and change.

use crate::body::model::{Model, Plan};
use crate::body::tables::SweepTables;
use crate::kernel::field::State;
use crate::kernel::real::Real;
use crate::state::guard::work_account::WorkAccount;
use crate::state::sleep::tiles::SleepTiles;
use crate::tools::applied_force::Applied;

/// The parts of a tissue with which a stage works.
pub(crate) struct StepContext<'a, T: Real> {
    pub(crate) model: &'a Model,
    pub(crate) plan: &'a Plan,
    pub(crate) tables: &'a SweepTables<T>,
    pub(crate) state: &'a mut State<T>,
    /// The forces of force-controlled tools, which do work along the movements of other tools.
    pub(crate) applied: &'a Applied<T>,
    pub(crate) tiles: &'a mut SleepTiles<T>,
    pub(crate) work: &'a mut WorkAccount,
}
