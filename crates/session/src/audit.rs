//! The audit of a run: a more accurate twin gets the inputs of the session, and the records of both are compared.
//! The twin runs in f64 with a quarter of the substep and without sleep. With `[stepping] correct`, windows of the
//! run are audited one after the other, as in a server, and an error above the tolerance changes how the tissue is
//! stepped.

use std::collections::VecDeque;
use std::sync::Arc;

use super::Session;
use super::command::Due;
use palpate_tissue::Model;
use palpate_tissue::scene::Precision;
use palpate_tissue::scene::record::{AuditedError, Record};
use palpate_tissue::scene::script::Script;
use palpate_tissue::select::audit::{AuditFinding, ErrorExtent, FINER, Mark, WindowInputs, WindowOpening};

/// Returns the more accurate model to compare with.
fn twin_of(model: &Model) -> Arc<Model> {
    model.twin(FINER, Precision::F64)
}

/// A twin: a more accurate session (f64, a quarter of the substep, no sleep) that gets another session's inputs, with
/// the differences between the records of the two.
pub struct Twin {
    session: Session,
    /// The tissue of the other session.
    of: Arc<Model>,
    records: VecDeque<Record>,
    differences: ErrorExtent,
    largest: ErrorExtent,
}

impl Twin {
    /// Creates a twin at step 0 of a session of `model` that has not begun. The forces and moves of `script` act in
    /// it as continuous profiles; `None` if they come as commands.
    pub fn new(model: &Arc<Model>, script: Option<&Script>) -> Self {
        let mut session = Session::new(&twin_of(model));
        script.iter().for_each(|script| session.play_script(script));
        let (differences, largest) = (ErrorExtent::default(), ErrorExtent::default());
        Twin { session, of: model.clone(), records: VecDeque::new(), differences, largest }
    }

    /// Changes the twin's tissue, from the coming step on, to a more accurate form of `model`, the other session's
    /// tissue. Does nothing if that is the same as before.
    pub fn follow(&mut self, model: &Arc<Model>) {
        if !Arc::ptr_eq(&self.of, model) {
            self.session.change(&twin_of(model));
            self.of = model.clone();
        }
    }

    /// Advances the twin by one step with the commands in `due`. Call it before the other session does that step with
    /// the same commands. Keeps a record of the script's sample points if one is due, for [`Twin::compare`].
    pub fn advance(&mut self, due: &[Due], script: &Script) {
        let Twin { session, records, .. } = self;
        session.advance(&mut due.to_vec(), |session| {
            if session.step_count().is_multiple_of(script.sample_every) {
                records.push_back(session.record(Some(&script.sample_points)));
            }
        });
    }

    /// Returns why the twin can no longer be compared with the other session: it has stopped, or there was a recovery
    /// in it. `None` if it can.
    pub fn fault(&self) -> Option<String> {
        self.session.fault().map(|reason| format!("the audit's twin: {reason}"))
    }

    /// Compares the twin's oldest record with `record`, the next one of the other session: displacements and
    /// reactions, each component. Does nothing if the twin has no record left. Call it once for each record, in
    /// order.
    pub fn compare(&mut self, record: &Record) {
        let Some(truth) = self.records.pop_front() else { return };
        for (point, truth) in record.points.iter().zip(&truth.points) {
            for c in 0..3 {
                let (displacement_m, force_n) = (truth.displacement_m[c], truth.reaction_n[c]);
                let found = ErrorExtent {
                    displacement_m: (point.displacement_m[c] - displacement_m).abs(),
                    force_n: (point.reaction_n[c] - force_n).abs(),
                };
                self.differences = self.differences.max(found);
                let size = ErrorExtent { displacement_m: displacement_m.abs(), force_n: force_n.abs() };
                self.largest = self.largest.max(size);
            }
        }
    }

    /// Returns the largest difference in all compared records so far, of displacements and of forces, each relative
    /// to the largest component in the twin's records.
    pub fn error(&self) -> AuditedError {
        self.differences.relative_to(self.largest)
    }
}

/// Audits of the windows of a session, one after the other, in the thread that steps it. Which steps they cover
/// depends only on the scene and its inputs.
#[derive(Default)]
pub struct Windows {
    opening: Option<WindowOpening>,
    largest: ErrorExtent,
    begun: bool,
}

impl Windows {
    /// Audits the window that has ended, if one has, and requests the next. Call it after each step, and before the
    /// first. It simulates the window again with a quarter of the substep, which takes longer than the window's own
    /// steps. Returns the finding of the audit; `None` if no window ended or its audit gave none.
    pub fn look(&mut self, session: &mut Session) -> Option<AuditFinding> {
        if !std::mem::replace(&mut self.begun, true) {
            session.request_audit(WindowInputs::default());
        }
        let mut found = None;
        match session.take_mark()? {
            Mark::Begin(begin) => {
                self.opening = Some(begin.open());
                return None;
            }
            Mark::End(end, inputs) => {
                let audit = self.opening.take().map(|opening| opening.close(end, inputs));
                found = audit.and_then(|audit| audit.work(FINER, self.largest, &mut || true));
            }
            Mark::Dropped => self.opening = None,
        }
        self.largest = found.map_or(self.largest, |finding| finding.largest);
        session.request_audit(WindowInputs::default());
        found
    }
}
