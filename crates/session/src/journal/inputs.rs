//! Reads the inputs of a journal from a step on, batch by batch, for a playback. Also encodes inputs that are not in
//! a journal yet: a session that moves to another server takes the inputs with it that wait for their step.

use std::collections::VecDeque;
use std::sync::Arc;

use prost::Message;

use super::message::{self, Tips, fill_tips, from_command, from_tissue};
use super::reader::{JournalReader, Survey};
use crate::input::Input;
use crate::rules::Rules;
use palpate_proto::journal as pb;
use palpate_proto::measure;
use palpate_refusal::Result;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;

/// Reader of the inputs in a journal that act at a step or later, batch by batch, for a playback.
pub struct Inputs<'s> {
    reader: JournalReader<'s>,
    first: Arc<Model>,
    rules: Rules,
    limits: Limits,
    from_step: u64,
}

/// Inputs of one batch of a journal, decoded and checked.
pub struct Piece {
    /// Inputs in the order in which they act, each with the number of steps done before it acts; without those that
    /// only start, pause or skip time.
    pub inputs: VecDeque<(u64, Input)>,
    /// All inputs that act before this step are in this piece or in earlier ones.
    pub until_step: u64,
}

impl<'s> Inputs<'s> {
    /// Creates a reader of the inputs that act at `step` or later; it begins at the newest snapshot that is not after
    /// `step`. `survey` must be the survey of this journal, and `first` the tissue with which its session began.
    /// `given` are the limits of this process; forces, reach and tool numbers are not limited by them
    /// ([`message::limits`]).
    pub fn new(mut reader: JournalReader<'s>, survey: &Survey, first: &Arc<Model>, given: &Limits, step: u64) -> Self {
        // A batch with a snapshot of a step has all inputs that act at that step, or later batches have them.
        match survey.snapshots.iter().rev().find(|at| at.step <= step) {
            Some(at) => reader.go_to(at),
            None => reader.rewind(),
        }
        let limits = message::limits(given);
        let rules = Rules::new(&first.scene, &limits);
        Inputs { reader, first: first.clone(), rules, limits, from_step: step }
    }

    /// Reads the next batch and returns its inputs; `None` after the last. A batch may have no inputs.
    ///
    /// # Errors
    /// - The refusals of [`JournalReader::next_batch`]: the journal can't be read or is damaged, or memory is
    ///   missing.
    /// - An input can't be decoded, or a session would not accept it: a command that breaks a rule, or a tissue
    ///   beyond the limits. The refusal names the batch.
    pub fn next_batch(&mut self) -> Result<Option<Piece>> {
        let Some(batch) = self.reader.next_batch()? else { return Ok(None) };
        let mut inputs = VecDeque::new();
        for message in batch.inputs()? {
            if message.step >= self.from_step
                && let Some(input) =
                    input(&message, &self.rules, &self.first, &self.limits).map_err(|refusal| batch.placed(refusal))?
            {
                inputs.push_back((message.step, input));
            }
        }
        Ok(Some(Piece { inputs, until_step: batch.until_step }))
    }
}

/// Returns the input in a message if it changes the state of the tissue; `None` for inputs that only start, pause or
/// skip time, which the viewer of a playback controls.
pub(super) fn input(message: &pb::Input, rules: &Rules, first: &Model, limits: &Limits) -> Result<Option<Input>> {
    use pb::input::What;
    Ok(match message.what.as_ref() {
        Some(What::Command(command)) => Some(Input::Command(from_command(command, rules, first.len())?)),
        Some(What::Tissue(tissue)) => Some(Input::Tissue(from_tissue(tissue, first, limits)?)),
        Some(What::Revive(_)) => Some(Input::Revive),
        Some(What::Hold(hold)) => Some(Input::Hold(hold.reason.clone())),
        Some(What::Start(_) | What::Pause(_) | What::DroppedSteps(_) | What::ExerciseResult(_) | What::PhaseEnd(_))
        | None => None,
    })
}

/// Largest number of inputs in one piece.
const PIECE: usize = 2048;

/// Encodes inputs, each with the number of steps done before it acts, in order. Returns pieces of bytes for
/// [`decoded`], with at most 2048 inputs each; none if there are no inputs.
pub fn encoded(inputs: &[(u64, Input)]) -> Vec<Vec<u8>> {
    let piece = |inputs: &[(u64, Input)]| {
        let mut tips = Tips::new();
        let inputs = inputs.iter().map(|(step, input)| message::input(*step, input, &mut tips)).collect();
        pb::Inputs { inputs, ..Default::default() }.encode_to_vec()
    };
    inputs.chunks(PIECE).map(piece).collect()
}

/// Decodes one piece of bytes of [`encoded`], for a session that began with the tissue `first`. Returns the inputs in
/// order, each with the number of steps done before it acts, without those that only start, pause or skip time.
/// `given` are the limits of this process, relaxed: forces and reach are not limited, and tool numbers may be below
/// 4096 or `given.tools`, whichever is larger.
///
/// # Errors
/// Refuses bytes that are not such a piece or would take too much memory, a tool number beyond that limit, a point
/// that the tissue does not have, a command without an action, a pose without a tip, a command that breaks a rule
/// ([`Rules::check_one`]), and a tissue that `first` can't become.
pub fn decoded(bytes: &[u8], first: &Arc<Model>, given: &Limits) -> Result<Vec<(u64, Input)>> {
    let limits = message::limits(given);
    let rules = Rules::new(&first.scene, &limits);
    let mut messages = measure::decoded::<pb::Inputs>(bytes).map_err(|refusal| refusal.within("waiting"))?.inputs;
    fill_tips(&mut messages)?;
    let read = |message: &pb::Input| Ok(input(message, &rules, first, &limits)?.map(|input| (message.step, input)));
    messages.iter().map(read).filter_map(Result::transpose).collect()
}

#[cfg(test)]
mod tests {
    use palpate_haptics::Tip;

    use super::*;
    use crate::Session;
    use crate::command::{Command, Due};
    use crate::intake::{Counts, Intake};
    use crate::intake_transfer::Handed;
    use crate::lease::LeaseId;
    use palpate_refusal::{Reason, Refusal};
    use palpate_tissue::scene::script::Action;

    const LEASE: LeaseId = 7;
    const MS: u64 = 1_000_000;

    fn release(sequence: u64, at_step: Option<u64>) -> Command {
        Command { at_step, ..Command::new(0, Some(sequence), Action::Release) }
    }

    fn due(intake: &mut Intake, step: u64) -> Vec<Due> {
        let mut due = Vec::new();
        intake.take_due(step, 0, &mut due);
        due
    }

    #[test]
    fn what_waits_goes_to_another_intake_by_way_of_bytes() {
        let limits = Limits::default();
        let mut intake = Intake::new(&Model::parse("paper", palpate_tissue::scene::PAPER, &[]).unwrap().scene, &limits);
        intake.acquire(&[0], "test", 1.0, LEASE, 0).unwrap();
        intake.acquire(&[1], "other", 1.0, LEASE + 1, 0).unwrap();
        let first = Model::parse("paper", palpate_tissue::scene::PAPER, &[]).unwrap();
        let change = palpate_tissue::scene::Change { stiffness_n_per_m: Some(55.0), ..Default::default() };
        let changed = first.changed(&change, &first.scene, &limits).unwrap();
        let pose = |sequence: u64, at_step| Command {
            action: Action::Pose { place_m: glam::DVec3::Z, velocity_m_per_s: None, tip: Tip::default() },
            ..release(sequence, Some(at_step))
        };
        intake.submit(LEASE, vec![pose(1, 7), pose(2, 8), release(3, Some(9))], 0).unwrap();
        intake.submit(LEASE + 1, vec![Command { tool: 1, ..release(1, Some(9)) }], 0).unwrap();
        intake.release(LEASE + 1).unwrap();
        assert_eq!(intake.change(None, &changed, Some(8), 0), Ok(Some(8)));
        let elsewhere = Refusal::new(Reason::Elsewhere, "session_id", "another server has it");
        let (handed, _) = intake.hand_over(elsewhere.clone());
        assert_eq!(intake.acquire(&[2], "late", 1.0, LEASE + 2, 0).unwrap_err().reason, Reason::Elsewhere);
        // The waiting command of a lease that has ended was dropped here.
        assert_eq!(intake.counts(), Counts { accepted: 1, dropped: 1, ..Counts::default() });
        let pieces = encoded(&handed.waiting);
        let waiting = pieces.iter().flat_map(|piece| decoded(piece, &first, &limits).unwrap()).collect();
        let mut session = Session::new(&first);
        session.skip_to(7);
        let mut other = Intake::new(&first.scene, &limits).continued(&session, None);
        assert_eq!(other.adopt(Handed { leases: handed.leases, waiting }, 5 * MS), 0);
        assert_eq!(other.counts(), Counts { accepted: 3, waiting: 3, ..Counts::default() });
        let first_due = due(&mut other, 7);
        // The end of the other lease comes first, because it was for step 0, which has passed.
        let of = |due: &Due| (due.command.tool, due.command.sequence, due.ends_lease);
        assert_eq!(first_due.iter().map(of).collect::<Vec<_>>(), [(1, None, true), (0, Some(1), false)]);
        assert!(matches!(first_due[1].command.action, Action::Pose { place_m, .. } if place_m == glam::DVec3::Z));
        assert!(other.take_change(7).is_none());
        assert_eq!(other.take_change(8).unwrap().saved_plan(), changed.saved_plan());
        assert_eq!(other.changed_to().unwrap().saved_plan(), changed.saved_plan());
        assert_eq!(due(&mut other, 8).iter().map(of).collect::<Vec<_>>(), [(0, Some(2), false)]);
        assert_eq!(due(&mut other, 9).iter().map(of).collect::<Vec<_>>(), [(0, Some(3), false)]);
        // The lease continues, and sequence numbers of its commands start again.
        other.submit(LEASE, vec![release(0, None)], 5 * MS).unwrap();
        assert!(other.submit(LEASE + 1, vec![release(0, None)], 5 * MS).is_err());
        assert!(decoded(&[1, 2, 3], &first, &limits).is_err());
    }
}
