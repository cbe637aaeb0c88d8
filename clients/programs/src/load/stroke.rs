//! What a client of a load does with its tool: a circle about the middle of the sheet with a varying force, never at rest.

use std::f64::consts::TAU;

use glam::{DVec2, DVec3};
use palpate_proto::geometry::vector;
use palpate_proto::pb;
use pb::command::Action;

/// A stroke over the sheet of a session.
#[derive(Clone)]
pub(crate) struct Stroke {
    middle_m: DVec2,
    radius_m: f64,
    force_n: f64,
    falloff_per_m: f64,
    /// Where the stroke begins, as a fraction of a turn; it differs from client to client.
    begin: f64,
}

impl Stroke {
    /// A stroke over a scene as the server tells it, with all fields.
    pub(crate) fn new(scene: &pb::Scene, begin: f64) -> Self {
        let sheet = scene.sheet.clone().unwrap_or_default();
        let spacing_m = sheet.spacing_m.unwrap_or(1.0);
        let extent_m =
            spacing_m * DVec2::from([sheet.points_x, sheet.points_y].map(|n| f64::from(n.unwrap_or(1)) - 1.0));
        let springs = scene.springs.as_ref().and_then(|springs| springs.stiffness_n_per_m);
        let virtual_springs = scene.virtual_springs.as_ref().and_then(|springs| springs.stiffness_n_per_m);
        // With this force the middle moves by about a third of a spacing.
        let stiffness_n_per_m = virtual_springs.unwrap_or(0.0) + 0.1 * springs.unwrap_or(0.0);
        Stroke {
            middle_m: extent_m / 2.0,
            radius_m: 0.25 * extent_m.min_element(),
            force_n: 0.3 * stiffness_n_per_m * spacing_m,
            falloff_per_m: 4.0 / spacing_m,
            begin,
        }
    }

    /// The tool's action at `time_s`: one turn in 2 s, with three presses.
    pub(crate) fn at(&self, time_s: f64) -> Action {
        let turn = TAU * (0.5 * time_s + self.begin);
        let centre_m = self.middle_m + self.radius_m * DVec2::new(turn.cos(), turn.sin());
        Action::Force(pb::Force {
            centre: Some(pb::force::Centre::CentreM(pb::Vector2 { x: centre_m.x, y: centre_m.y })),
            force_n: vector(DVec3::new(0.0, 0.0, -self.force_n * (0.6 + 0.4 * (3.0 * turn).sin()))),
            falloff_per_m: Some(self.falloff_per_m),
            falloff_offset: None,
        })
    }
}
