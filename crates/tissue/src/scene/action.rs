//! The actions of a tool: push, grasp, pose, tie, mark, release.

use glam::DVec3;

use super::profile::Poke;
use super::tie::Tie;
use crate::shape::PointId;
use palpate_haptics::Tip;

/// A place that a person marks on the surface: what they look for is there, or below it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaceMark {
    /// The place, m, in the tissue's frame.
    pub place_m: DVec3,
    /// The diameter that they think it has, m; `None` if they don't say.
    pub diameter_m: Option<f64>,
}

/// Largest number of marks of a script, and that a session keeps.
pub const MAX_MARKS: usize = 1024;

/// An action of a tool, which lasts until its next action. Its numbers are not checked here: see
/// [`action_check`](super::action_check).
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    /// Exerts a force, from the beginning of the step on.
    Push(Poke),
    /// Holds a point and moves it to this displacement by the end of the step, at constant velocity; then the
    /// point stays there.
    Grasp {
        /// The point, which must not be fixed.
        point: PointId,
        /// Displacement from the rest position, m, in the tissue's frame.
        displacement_m: DVec3,
    },
    /// Moves the tool to this place by the end of the step and touches the tissue with its tip.
    Pose {
        /// Place of the tip in the frame of the tissue at rest, m. On a sheet, z points out of the tissue.
        place_m: DVec3,
        /// Velocity at that time, m/s, if the client sends it: over a gap in the commands, the tool continues
        /// with it.
        velocity_m_per_s: Option<DVec3>,
        /// The tool's tip: its radius, friction and coupling.
        tip: Tip,
    },
    /// Lays a thread or clip, or changes the length, friction or strength of one, or cuts it. It stays when the tool is released, and
    /// what the tool does goes on.
    Tie {
        /// Its number, from 0, below `limits.ties`.
        number: u32,
        /// What ties which bites; `None` cuts it and takes it out.
        tie: Option<Tie>,
    },
    /// Marks a place of the surface, as an answer in an exercise: it changes nothing, and what the tool does goes on.
    Mark(PlaceMark),
    /// Ends the tool's action: it no longer pushes, grasps or touches.
    Release,
}
