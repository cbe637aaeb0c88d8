//! Movement of the tool of a client in a load test: a circle around the centre of a sheet, or one vertex of a mesh
//! after another, with a varying force, never at rest.

use std::f64::consts::TAU;

use glam::{DVec2, DVec3};
use palpate_proto::geometry::{from_vector, vector};
use palpate_proto::pb;
use palpate_proto::scene::{SceneGrid, grid};
use pb::command::Action;

/// A stroke over the tissue of a session.
#[derive(Clone)]
pub(crate) struct Stroke {
    over: Over,
    force_n: f64,
    /// Largest depth to which a tip presses, m.
    depth_m: f64,
    falloff_per_m: f64,
    /// Start of the stroke as a fraction of a turn; it differs from client to client.
    begin: f64,
}

#[derive(Clone)]
enum Over {
    /// A circle in the plane of a grid.
    Circle { middle_m: DVec2, radius_m: f64 },
    /// One vertex after another.
    Vertices { count: u32 },
}

/// Number of vertices of a mesh that are pushed, one after the other, in a turn.
const VERTICES_PER_TURN: f64 = 20.0;

impl Stroke {
    /// Creates a stroke over a session's tissue, from the server's complete description of it.
    pub(crate) fn new(session: &pb::Session) -> Self {
        let scene = session.scene.clone().unwrap_or_default();
        let (over, spacing_m) = match grid(&scene) {
            Some(SceneGrid { points, spacing_m }) => {
                let extent_m = spacing_m * DVec2::from(points.map(|count| f64::from(count) - 1.0));
                (Over::Circle { middle_m: extent_m / 2.0, radius_m: 0.25 * extent_m.min_element() }, spacing_m)
            }
            None => {
                let extent = session.extent.unwrap_or_default();
                let size_m = from_vector(extent.most_m.as_ref()) - from_vector(extent.least_m.as_ref());
                let vertices = session.points.max(1);
                (Over::Vertices { count: vertices }, 2.0 * size_m.max_element().max(1e-6) / f64::from(vertices).sqrt())
            }
        };
        let springs = scene.springs.as_ref().and_then(|springs| springs.stiffness_n_per_m);
        let anchor_springs = scene.anchor_springs.as_ref().and_then(|springs| springs.stiffness_n_per_m);
        // With this force the middle moves by about a third of a spacing.
        let stiffness_n_per_m = anchor_springs.unwrap_or(0.0) + 0.1 * springs.unwrap_or(0.0);
        Stroke {
            over,
            force_n: 0.3 * stiffness_n_per_m * spacing_m,
            depth_m: 0.3 * spacing_m,
            falloff_per_m: 4.0 / spacing_m,
            begin: 0.0,
        }
    }

    /// Returns this stroke with another start, as a fraction of a turn.
    pub(crate) fn beginning(&self, begin: f64) -> Self {
        Stroke { begin, ..self.clone() }
    }

    /// Returns the place of a tip at `time_s`, m: the turn of [`Stroke::at`], pressed in as its force would; `None`
    /// where points are no grid.
    pub(crate) fn place_m(&self, time_s: f64) -> Option<DVec3> {
        let Over::Circle { middle_m, radius_m } = self.over else { return None };
        let turn = TAU * (0.5 * time_s + self.begin);
        let place_m = middle_m + radius_m * DVec2::new(turn.cos(), turn.sin());
        Some(place_m.extend(-self.depth_m * (0.6 + 0.4 * (3.0 * turn).sin())))
    }

    /// Returns the tool's action at `time_s`, s: one turn in 2 s, with three presses.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub(crate) fn at(&self, time_s: f64) -> Action {
        let turns = 0.5 * time_s + self.begin;
        let turn = TAU * turns;
        let centre = match self.over {
            Over::Circle { middle_m, radius_m } => {
                let centre_m = middle_m + radius_m * DVec2::new(turn.cos(), turn.sin());
                pb::force::Centre::CentreM(pb::Vector2 { x: centre_m.x, y: centre_m.y })
            }
            Over::Vertices { count } => {
                pb::force::Centre::Vertex(((VERTICES_PER_TURN * turns) as u64 % u64::from(count)) as u32)
            }
        };
        Action::Force(pb::Force {
            centre: Some(centre),
            force_n: vector(DVec3::new(0.0, 0.0, -self.force_n * (0.6 + 0.4 * (3.0 * turn).sin()))),
            falloff_per_m: Some(self.falloff_per_m),
            falloff_offset: None,
        })
    }
}
