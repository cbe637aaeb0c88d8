//! The inputs of a journal from a step on, batch by batch: for a session that plays them.

use std::collections::VecDeque;
use std::io::{Read, Seek};
use std::sync::Arc;

use super::message::{self, from_command, from_tissue};
use super::reader::{Reader, Survey};
use crate::limits::Limits;
use crate::refusal::Result;
use crate::session::input::Input;
use crate::session::rules::Rules;
use crate::sheet::Model;
use palpate_proto::journal as pb;

/// Reads the inputs of a journal.
pub struct Inputs<R> {
    reader: Reader<R>,
    first: Arc<Model>,
    rules: Rules,
    limits: Limits,
    from_step: u64,
}

/// Inputs, each with the steps done before it acts, and the step before which there are no others.
pub struct Piece {
    /// In order.
    pub inputs: VecDeque<(u64, Input)>,
    /// All that act before this step have been read.
    pub until_step: u64,
}

impl<R: Read + Seek> Inputs<R> {
    /// Those that act at `step` and later. `survey` is that of the journal, and `first` the tissue with which its session began.
    pub fn new(mut reader: Reader<R>, survey: &Survey, first: &Arc<Model>, given: &Limits, step: u64) -> Self {
        // A batch with a snapshot of a step has all inputs that act at that step, or later ones have.
        match survey.snapshots.iter().rev().find(|at| at.step <= step) {
            Some(at) => reader.go_to(at),
            None => reader.rewind(),
        }
        let limits = message::limits(given);
        let rules = Rules::new(&first.scene, &limits);
        Inputs { reader, first: first.clone(), rules, limits, from_step: step }
    }

    /// The next batch; `None` after the last.
    ///
    /// # Errors
    /// Refuses a journal that is damaged, and inputs that no session accepts.
    pub fn next_batch(&mut self) -> Result<Option<Piece>> {
        let Some(batch) = self.reader.next_batch()? else { return Ok(None) };
        let mut inputs = VecDeque::new();
        for message in batch.inputs()? {
            if message.step >= self.from_step
                && let Some(input) = self.input(&message).map_err(|refusal| batch.placed(refusal))?
            {
                inputs.push_back((message.step, input));
            }
        }
        Ok(Some(Piece { inputs, until_step: batch.until_step }))
    }

    /// What changes bits. Whether time went on, its viewer decides.
    fn input(&self, message: &pb::Input) -> Result<Option<Input>> {
        use pb::input::What;
        Ok(match message.what.as_ref() {
            Some(What::Command(command)) => Some(Input::Command(from_command(command, &self.rules, self.first.len())?)),
            Some(What::Tissue(tissue)) => Some(Input::Tissue(from_tissue(tissue, &self.first, &self.limits)?)),
            Some(What::Revive(_)) => Some(Input::Revive),
            Some(What::Hold(hold)) => Some(Input::Hold(hold.reason.clone())),
            Some(What::Start(_) | What::Pause(_) | What::DroppedSteps(_)) | None => None,
        })
    }
}
