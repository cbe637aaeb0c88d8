//! The guard's data: checkpoints to go back to, and the tools' inputs.

use glam::DVec3;

use crate::guard::work_account::WorkAccount;
use crate::kernel::field::State;
use crate::kernel::real::Real;
use crate::model::Model;
use crate::state::saved::{Checks, SavedInput, SavedTip};
use crate::tools::applied_force::{Applied, Push};
use crate::tools::contact::Contacts;
use crate::tools::prescribed::{Grasp, Prescribed, restored_index};
use palpate_haptics::Tip;
use palpate_refusal::Result;

/// An input of a tool.
#[derive(Debug, Clone)]
pub(crate) enum Input {
    Push(Option<Push>),
    Grasp(usize, Grasp),
    Pose(DVec3, Tip),
}

impl Input {
    pub(crate) fn saved(&self) -> SavedInput {
        match self {
            Input::Push(push) => SavedInput::Push(push.as_ref().map(Push::saved).map(Box::new)),
            Input::Grasp(index, grasp) => SavedInput::Grasp(*index as u64, grasp.saved()),
            Input::Pose(place_m, tip) => SavedInput::Pose((*place_m).into(), SavedTip::of(tip)),
        }
    }

    pub(crate) fn restored(saved: &SavedInput, model: &Model, checks: &Checks<'_>) -> Result<Self> {
        Ok(match saved {
            SavedInput::Push(push) => Input::Push(push.as_ref().map(|push| Push::restored(push, checks)).transpose()?),
            SavedInput::Grasp(index, grasp) => {
                Input::Grasp(restored_index(model, *index, checks)?, Grasp::restored(grasp, checks)?)
            }
            SavedInput::Pose(place_m, tip) => Input::Pose(checks.vector(*place_m)?, tip.restored(checks)?),
        })
    }
}

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
}

/// Steps that the guard repeats from its checkpoint.
#[derive(Debug)]
pub(crate) struct Repetition {
    /// The step at which a check failed.
    pub(crate) target: u64,
    /// The inputs of these steps, from the checkpoint on.
    pub(crate) inputs: Vec<(u64, usize, Input)>,
    pub(crate) next_input: usize,
    pub(crate) halvings: u32,
}
