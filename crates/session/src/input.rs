//! Inputs that act on a session from outside, and the forces that its tools feel: the content of a journal.

use std::sync::Arc;

use glam::DVec3;

use super::command::Due;
use super::measured_run::EndedExercise;
use super::{Session, ToolSample};
use palpate_tissue::Model;

/// One input to a session: everything that acts on it from outside. A session that gets the inputs of another in
/// their order, each at its step, gives equal bits.
#[derive(Debug, Clone)]
pub enum Input {
    /// A command that is due, or the end of a lease ([`Session::advance`]).
    Command(Due),
    /// A change of the tissue from this step on ([`Session::change`]).
    Tissue(Arc<Model>),
    /// Time starts, without end or until a step. It changes no bits.
    Start {
        /// The step count at which the session pauses, if any.
        until: Option<u64>,
    },
    /// Time pauses. It changes no bits.
    Pause,
    /// This number of steps was due and not done in time, so all later steps are due that much later. It changes no
    /// bits.
    DroppedSteps(u64),
    /// A session that has stopped continues, paused, with its tissue at rest: [`Session::new`] of the present model,
    /// skipped to this step.
    Revive,
    /// The session is stopped for good ([`Session::hold`]), for a reason other than the guard's, such as a fault of
    /// the program. Contains the reason.
    Hold(String),
    /// The exercise of the session has ended with this result. It changes no bits.
    ExerciseEnded(Arc<EndedExercise>),
    /// The trainee has ended this phase of the exercise, from 1, before its time. It changes no bits.
    PhaseEnded(u32),
}

/// Pose of a tool and force on it at the end of a step. Vectors are in the tissue's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Felt {
    /// The tool's number.
    pub tool: u32,
    /// Place of the tool's tip or, without a tip, present place of its control point, m.
    pub place_m: DVec3,
    /// Displacement of the tissue at the tool's control point, m; under a tip the mean over its disc.
    pub displacement_m: DVec3,
    /// Force of the tissue on the tool, N.
    pub force_n: DVec3,
}

impl Session {
    /// Returns the poses and forces of the tools at the present step, by ascending number: of all tools that ever had
    /// a control point. A tool that has let go is still listed, with its last point; empty before the first command.
    pub fn felt(&self) -> Vec<Felt> {
        let of = |sample: &ToolSample| {
            let contact = sample.contact?;
            let control_m = || self.model().shape().rest_m(contact.point) + contact.displacement_m;
            Some(Felt {
                tool: sample.tool,
                place_m: sample.feel.map_or_else(control_m, |feel| feel.place_m),
                displacement_m: contact.displacement_m,
                force_n: contact.force_on_tool_n,
            })
        };
        self.sample(None).tools.iter().filter_map(of).collect()
    }
}
