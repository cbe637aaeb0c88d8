//! The actions of a tool: push, grasp, pose, release.

use glam::DVec3;

use super::profile::Poke;
use crate::shape::PointId;
use palpate_haptics::Tip;

/// An action of a tool, which lasts until its next action.
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    /// Exerts a force.
    Push(Poke),
    /// Holds a point and moves it to this displacement by the end of the step.
    Grasp {
        /// The point.
        point: PointId,
        /// Displacement from the rest position, m.
        displacement_m: DVec3,
    },
    /// Moves the tool to this place by the end of the step and touches the tissue with its tip.
    Pose {
        /// Place in the frame of the tissue at rest, m. On a sheet, z points out of the tissue.
        place_m: DVec3,
        /// Velocity at that time, m/s, if the client sends it: over a gap in the commands, the tool continues
        /// with it.
        velocity_m_per_s: Option<DVec3>,
        /// The tool's tip.
        tip: Tip,
    },
    /// Ends the tool's action.
    Release,
}
