//! The guard's data: checkpoints to go back to.

use crate::body::severed::Cuts;
use crate::kernel::field::State;
use crate::kernel::real::Real;
use crate::state::guard::work_account::WorkAccount;
use crate::tools::applied_force::Applied;
use crate::tools::contact::Contacts;
use crate::tools::input::ToolInput;
use crate::tools::prescribed::Prescribed;

/// The complete state that a tissue goes back to.
#[derive(Debug)]
pub(crate) struct Checkpoint<T: Real> {
    pub(crate) steps: u64,
    pub(crate) halvings: u32,
    pub(crate) state: State<T>,
    pub(crate) applied: Applied<T>,
    pub(crate) prescribed: Prescribed,
    pub(crate) contacts: Contacts,
    pub(crate) work: WorkAccount,
    /// The recent largest displacement, spacings. Sleep is relative to it.
    pub(crate) largest: f64,
    /// Whether the motion that led here has passed the checks, under the present springs.
    pub(crate) passed_checks: bool,
    pub(crate) cuts: Cuts,
}

/// Steps that the guard repeats from its checkpoint.
#[derive(Debug)]
pub(crate) struct Repetition {
    /// The step at which a check failed.
    pub(crate) target: u64,
    /// The inputs of these steps, from the checkpoint on.
    pub(crate) inputs: Vec<(u64, usize, ToolInput)>,
    pub(crate) next_input: usize,
    pub(crate) halvings: u32,
}
