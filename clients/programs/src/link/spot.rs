//! The place of a task on the tissue.

use glam::{DMat3, DQuat, DVec3};
use palpate_haptics::{LocalModel, Tip};
use palpate_tissue::{Footprint, Model};

/// The place of a task on a surface, with the hand's frame: the task's origin is there, and z points out of the
/// tissue.
#[derive(Debug, Clone, Copy)]
pub(super) struct Spot {
    /// The place at rest, m.
    pub(super) at_m: DVec3,
    /// Rotation from the tissue's frame to the hand's frame.
    turn: DMat3,
    /// From a place of the hand to that of the tool, m, in the tissue's frame: the hand's is at the surface when the tip just
    /// touches.
    above_m: DVec3,
}

impl Spot {
    /// Returns the place of the rest surface that is nearest to `near_m`, for a tip.
    pub(super) fn new(model: &Model, near_m: DVec3, tip: &Tip) -> Self {
        let (at_m, outward) = Footprint::new(model, tip.radius_m, near_m).at_rest();
        let turn = DMat3::from_quat(DQuat::from_rotation_arc(outward, DVec3::Z));
        Spot { at_m, turn, above_m: tip.shape.height_m(tip.radius_m) * outward }
    }

    /// Converts a place in the hand's frame to the tissue's frame.
    pub(super) fn of_tissue(&self, place_m: DVec3) -> DVec3 {
        self.at_m + self.above_m + self.turn.transpose() * (place_m - self.at_m)
    }

    /// Converts a place in the tissue's frame to the hand's frame.
    pub(super) fn of_hand_m(&self, place_m: DVec3) -> DVec3 {
        self.at_m + self.turn * (place_m - self.above_m - self.at_m)
    }

    /// Converts a direction (a velocity or force) in the tissue's frame to the hand's frame.
    pub(super) fn direction(&self, of_tissue: DVec3) -> DVec3 {
        self.turn * of_tissue
    }

    /// Converts a direction in the hand's frame to the tissue's frame.
    pub(super) fn direction_of_tissue(&self, direction: DVec3) -> DVec3 {
        self.turn.transpose() * direction
    }

    /// Returns the depth of a place in the hand's frame below the surface at rest, m.
    pub(super) fn depth_m(&self, place_m: DVec3) -> f64 {
        self.at_m.z - place_m.z
    }

    /// Converts a local model of the tissue to the hand's frame.
    pub(super) fn of_hand(&self, model: LocalModel) -> LocalModel {
        let tensor = |of_tissue: DMat3| self.turn * of_tissue * self.turn.transpose();
        LocalModel {
            place_m: self.of_hand_m(model.place_m),
            velocity_m_per_s: self.direction(model.velocity_m_per_s),
            force_n: self.direction(model.force_n),
            stiffness_n_per_m: tensor(model.stiffness_n_per_m),
            damping_n_s_per_m: tensor(model.damping_n_s_per_m),
            surface_m: self.of_hand_m(model.surface_m),
            normal: self.direction(model.normal),
            curvature_per_m: tensor(model.curvature_per_m),
            ..model
        }
    }
}
