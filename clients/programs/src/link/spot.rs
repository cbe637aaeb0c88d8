//! The place at which a task is done.

use glam::{DMat3, DQuat, DVec3};
use palpate_haptics::LocalModel;
use palpate_tissue::{Footprint, Model};

/// The place of a surface at which a task is done, seen by the hand: the task's own place is there, and z is out of the
/// tissue.
#[derive(Debug, Clone, Copy)]
pub(super) struct Spot {
    /// The place at rest, m.
    pub(super) at_m: DVec3,
    /// From directions of the tissue to those of the hand.
    turn: DMat3,
}

impl Spot {
    /// The place of the rest surface that is nearest to `near_m`, as a disc of `radius_m` finds it.
    pub(super) fn new(model: &Model, near_m: DVec3, radius_m: f64) -> Self {
        if model.shape().dimensions() == 2 {
            return Spot { at_m: near_m, turn: DMat3::IDENTITY };
        }
        let (at_m, outward) = Footprint::new(model, radius_m, near_m).at_rest();
        Spot { at_m, turn: DMat3::from_quat(DQuat::from_rotation_arc(outward, DVec3::Z)) }
    }

    /// Of the hand's place, which has the same middle.
    pub(super) fn of_tissue(&self, place_m: DVec3) -> DVec3 {
        self.at_m + self.turn.transpose() * (place_m - self.at_m)
    }

    /// Of the tissue's direction, as the hand sees it: a velocity or a force.
    pub(super) fn direction(&self, of_tissue: DVec3) -> DVec3 {
        self.turn * of_tissue
    }

    /// The other way round.
    pub(super) fn direction_of_tissue(&self, direction: DVec3) -> DVec3 {
        self.turn.transpose() * direction
    }

    /// How deep the hand's place is below the surface at rest, m.
    pub(super) fn depth_m(&self, place_m: DVec3) -> f64 {
        self.at_m.z - place_m.z
    }

    /// A local model of the tissue, as the hand sees it.
    pub(super) fn of_hand(&self, model: LocalModel) -> LocalModel {
        let place = |place_m: DVec3| self.at_m + self.turn * (place_m - self.at_m);
        let tensor = |of_tissue: DMat3| self.turn * of_tissue * self.turn.transpose();
        LocalModel {
            place_m: place(model.place_m),
            velocity_m_per_s: self.direction(model.velocity_m_per_s),
            force_n: self.direction(model.force_n),
            stiffness_n_per_m: tensor(model.stiffness_n_per_m),
            damping_n_s_per_m: tensor(model.damping_n_s_per_m),
            surface_m: place(model.surface_m),
            normal: self.direction(model.normal),
            curvature_per_m: tensor(model.curvature_per_m),
            ..model
        }
    }
}
