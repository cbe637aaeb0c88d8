//! What acts on a session from outside, and what its tools feel: what a journal of it holds.

use std::sync::Arc;

use glam::DVec3;

use super::command::Due;
use super::{Session, ToolSample};
use palpate_tissue::Model;

/// One input. With the inputs of a session in their order, each at its step, a session gives the same bits again.
#[derive(Debug, Clone)]
pub enum Input {
    /// A command whose step has come, or the end of a lease ([`Session::advance`]).
    Command(Due),
    /// Another tissue from this step on ([`Session::change`]).
    Tissue(Arc<Model>),
    /// Time goes on, for ever or until so many steps are done. It changes no bits.
    Start {
        /// The step at which the session pauses.
        until: Option<u64>,
    },
    /// Time stands. It changes no bits.
    Pause,
    /// So many steps were due, and not done in time: the schedule was moved. It changes no bits.
    DroppedSteps(u64),
    /// A session that was held goes on, paused, with its tissue at rest: [`Session::new`], brought to this step.
    Revive,
    /// The session is held for a reason other than the guard's ([`Session::hold`]).
    Hold(String),
}

/// What a tool feels at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Felt {
    /// The tool's number.
    pub tool: u32,
    /// Place of its tip; of a tool without one, of its control point, m.
    pub place_m: DVec3,
    /// How far the tissue under it is moved, m.
    pub displacement_m: DVec3,
    /// Force of the tissue on the tool, N.
    pub force_n: DVec3,
}

impl Session {
    /// Returns what the tools feel that touch, grasp or push, by ascending number.
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
