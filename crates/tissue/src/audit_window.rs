//! What a tissue records of a window of steps that is to be audited.

use std::fmt;
use std::sync::Arc;

use glam::DVec3;

use crate::body::model::Model;
use crate::tools::input::ToolInput;

/// Largest number of inputs in a window. With more, the window ends without a result.
const MAX_INPUTS: usize = 4096;

/// The inputs of the tools in a window of steps, for [`Tissue::request_audit`](crate::Tissue::request_audit):
/// the step that each precedes, its tool, and the input, in the order of arrival. `default()` allocates its
/// memory, for 4096 inputs, so that stepping allocates none.
#[derive(Debug)]
pub struct WindowInputs(pub(crate) Vec<(u64, usize, ToolInput)>);

impl Default for WindowInputs {
    fn default() -> Self {
        WindowInputs(Vec::with_capacity(MAX_INPUTS))
    }
}

/// What a tissue reports about the requested window of steps ([`Tissue::take_mark`](crate::Tissue::take_mark)).
#[derive(Debug)]
pub enum Mark {
    /// The window has begun, at this checkpoint: call [`SharedCheckpoint::open`] soon.
    Begin(SharedCheckpoint),
    /// The window has ended, at this checkpoint, with these inputs: for
    /// [`WindowOpening::close`](crate::select::audit::WindowOpening::close). No window is requested any more.
    End(SharedCheckpoint, WindowInputs),
    /// The window can't be audited, and none is requested any more: the guard went back, the tissue changed or
    /// was recovered, everything came to rest, there were more than 4096 inputs, or the end was not taken
    /// before the next checkpoint.
    Dropped,
}

/// The state of a tissue at a checkpoint of the guard, shared with the tissue. While it exists, the tissue
/// can't reuse the memory of this checkpoint and allocates another one: open it soon.
#[derive(Debug)]
pub struct SharedCheckpoint {
    pub(crate) model: Arc<Model>,
    pub(crate) checkpoint: Arc<dyn Resume>,
}

impl SharedCheckpoint {
    /// Returns the model of the tissue at the checkpoint.
    pub fn model(&self) -> &Arc<Model> {
        &self.model
    }
}

/// A checkpoint in any number format, from which a tissue can be made.
pub(crate) trait Resume: fmt::Debug + Send + Sync {
    /// Returns a tissue in the state of the checkpoint, of a tissue with `model`. None of it sleeps.
    fn resume(&self, model: &Model) -> Box<dyn Replay>;
}

/// A tissue in any number format that repeats a window.
pub(crate) trait Replay: fmt::Debug + Send {
    /// Returns the model.
    fn model(&self) -> &Arc<Model>;
    /// Returns the number of steps done.
    fn steps(&self) -> u64;
    /// Returns the recent largest displacement, spacings, to which sleep is relative.
    fn largest(&self) -> f64;
    /// Returns the displacement, m, and the tissue's force on a tool, N, of each point.
    fn observed(&self) -> Vec<[DVec3; 2]>;
    /// Returns a tissue in the same state in f64, with 1/`by` of the substep.
    fn twin(&self, by: u32) -> Box<dyn Replay>;
    /// Repeats the recorded inputs up to step `until`, in slices. Calls `go_on` between slices; stops and
    /// returns false if that did.
    fn repeat(&mut self, inputs: &WindowInputs, until: u64, go_on: &mut dyn FnMut() -> bool) -> bool;
}

/// How far a tissue is with a requested window.
#[derive(Debug, Default)]
pub(crate) enum AuditWindow {
    /// No window is requested.
    #[default]
    Off,
    /// The window begins at the next checkpoint.
    Wanted(WindowInputs),
    /// The window ends at the first checkpoint from this step on.
    Open(u64, WindowInputs),
    /// The end is still to be reported.
    Closed(WindowInputs),
    /// The failure is still to be reported.
    Dropped,
}

impl AuditWindow {
    /// Records an input of a tool.
    pub(crate) fn input(&mut self, step: u64, tool: usize, input: &ToolInput) {
        let AuditWindow::Open(_, inputs) = self else { return };
        if inputs.0.len() < MAX_INPUTS {
            inputs.0.push((step, tool, input.clone()));
        } else {
            self.give_up();
        }
    }

    /// Drops the window after an event that a repetition can't follow.
    pub(crate) fn give_up(&mut self) {
        if matches!(self, AuditWindow::Open(..) | AuditWindow::Closed(_)) {
            *self = AuditWindow::Dropped;
        }
    }
}
