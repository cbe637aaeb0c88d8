//! The actions of a tool: a force, a grasp, a pose, a release.

use glam::DVec3;

use super::profile::Poke;
use crate::shape::PointId;
use palpate_haptics::Tip;

/// The action of a tool, which lasts until the next one.
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    /// Exerts a force.
    Push(Poke),
    /// Holds a point and brings it to this displacement by the end of the step.
    Grasp {
        /// The point.
        point: PointId,
        /// From its rest position, m.
        displacement_m: DVec3,
    },
    /// Reaches this place by the end of the step and meets the sheet with its tip.
    Pose {
        /// Place in the frame of the sheet at rest, z out of the tissue, m.
        place_m: DVec3,
        /// How fast it moves then, m/s, if the client says so: the tool goes on like that over a gap.
        velocity_m_per_s: Option<DVec3>,
        /// The tool's tip.
        tip: Tip,
    },
    /// Ends any of these.
    Release,
}
