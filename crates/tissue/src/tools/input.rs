//! The inputs of tools, as a tissue repeats them.

use glam::DVec3;

use crate::body::model::Model;
use crate::saved::{Checks, SavedBites, SavedInput, SavedTip};
use crate::scene::action_check::check_tie;
use crate::scene::tie::Tie;
use crate::tools::applied_force::Push;
use crate::tools::prescribed::{Grasp, restored_index};
use palpate_haptics::Tip;
use palpate_refusal::Result;

/// An input of a tool.
#[derive(Debug, Clone)]
pub(crate) enum ToolInput {
    Push(Option<Push>),
    Grasp(usize, Grasp),
    Pose(DVec3, Tip),
    /// Of a thread or clip, whose number is in the place of that of a tool.
    Tie(Option<Box<Tie>>),
}

impl ToolInput {
    pub(crate) fn saved(&self) -> SavedInput {
        match self {
            ToolInput::Push(push) => SavedInput::Push(push.as_ref().map(Push::saved).map(Box::new)),
            ToolInput::Grasp(index, grasp) => SavedInput::Grasp(*index as u64, grasp.saved()),
            ToolInput::Pose(place_m, tip) => SavedInput::Pose((*place_m).into(), SavedTip::of(tip)),
            ToolInput::Tie(tie) => SavedInput::Tie(tie.as_deref().map(SavedBites::of).map(Box::new)),
        }
    }

    pub(crate) fn restored(saved: &SavedInput, model: &Model, checks: &Checks<'_>) -> Result<Self> {
        Ok(match saved {
            SavedInput::Push(push) => {
                ToolInput::Push(push.as_ref().map(|push| Push::restored(push, checks)).transpose()?)
            }
            SavedInput::Grasp(index, grasp) => {
                ToolInput::Grasp(restored_index(model, *index, checks)?, Grasp::restored(grasp, checks)?)
            }
            SavedInput::Pose(place_m, tip) => ToolInput::Pose(checks.vector(*place_m)?, tip.restored(checks)?),
            SavedInput::Tie(tie) => {
                let restored = |tie: &SavedBites| {
                    let tie = tie.restored(checks)?;
                    check_tie("snapshot.tie", checks.shape, &tie, checks.limits).map(|()| Box::new(tie))
                };
                ToolInput::Tie(tie.as_deref().map(restored).transpose()?)
            }
        })
    }
}
