//! What the message of a scene says about its tissue, for programs that do not read the whole scene.

use crate::pb;

/// The points of a tissue that are a grid in the plane z = 0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SceneGrid {
    /// Number of points along x and along y.
    pub points: [u32; 2],
    /// Distance of neighbouring points, m.
    pub spacing_m: f64,
}

/// Returns the grid of a scene's points; `None` if they are arranged in another way, as on a mesh. Values that are absent
/// count as 1.
pub fn grid(scene: &pb::Scene) -> Option<SceneGrid> {
    let sheet = scene.sheet.as_ref()?;
    let points = [sheet.points_x, sheet.points_y].map(|count| count.unwrap_or(1));
    Some(SceneGrid { points, spacing_m: sheet.spacing_m.unwrap_or(1.0) })
}

/// The field of a request with a scene that has its mesh, for refusals.
pub const MESH: &str = "scene.mesh";

/// The field of a request with a scene that has the ID of its mesh, for refusals.
pub const MESH_ID: &str = "scene.mesh.mesh_id";

/// Returns the ID of the mesh that belongs to a scene besides its message, and that a client sends before it: empty if it
/// has none yet. `None` if the message describes the whole tissue.
pub fn mesh_id(scene: &pb::Scene) -> Option<&str> {
    let of_solid = scene.solid.as_ref().map(|solid| solid.mesh_id.as_str());
    scene.mesh.as_ref().map(|mesh| mesh.mesh_id.as_str()).or(of_solid)
}

/// Sets the ID of the mesh that belongs to a scene, if one does.
pub fn set_mesh_id(scene: &mut pb::Scene, id: String) {
    if let Some(mesh) = &mut scene.mesh {
        mesh.mesh_id = id;
    } else if let Some(solid) = &mut scene.solid {
        solid.mesh_id = id;
    }
}
