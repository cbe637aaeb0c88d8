//! Converts scenes for a server. The mesh of a scene is uploaded before it.

use std::path::Path;

use palpate_client::Channel;
use palpate_client::upload::upload_mesh;
use palpate_proto::pb;
use palpate_refusal::{Reason, Refusal};
use palpate_session::wire;
use palpate_tissue::scene::sent::{self, mesh_file};
use pb::create_session_request::Source;
use pyo3::PyResult;

use crate::error::{of_status, refused};
use crate::scene::{Scene, limits};

/// The source of a new session.
pub(crate) enum SessionSource {
    /// One of the server's scenes.
    Name(String),
    Scene {
        scene: Box<pb::Scene>,
        /// The file of its mesh, in metres.
        mesh: Option<Vec<u8>>,
    },
}

impl SessionSource {
    /// Converts a scene that was read here.
    pub(crate) fn of(scene: &Scene) -> Result<Self, Refusal> {
        let mut message = Box::new(wire::scene::sent(&scene.scene));
        let Some(mesh) = scene.scene.mesh() else {
            return Ok(SessionSource::Scene { scene: message, mesh: None });
        };
        let file = Path::new(&scene.place);
        // The number of vertices as requested in the file; the mesh may have fewer.
        if file.is_file()
            && let Some(told) = &mut message.mesh
            && let Some(said) = mesh_file(file, &limits())?
        {
            told.vertices = said.vertices.map(|vertices| vertices.try_into().unwrap_or(u32::MAX));
        }
        Ok(SessionSource::Scene { scene: message, mesh: Some(sent::file(mesh).1) })
    }

    /// Returns the source for the server; uploads the mesh, if there is one.
    pub(crate) async fn source(self, channel: Channel) -> PyResult<Source> {
        let (mut scene, mesh) = match self {
            SessionSource::Name(name) => return Ok(Source::SceneName(name)),
            SessionSource::Scene { scene, mesh } => (scene, mesh),
        };
        if let (Some(file), Some(of_scene)) = (mesh, &mut scene.mesh) {
            let answer = upload_mesh(channel, "mesh.obj", &file, "m", false).await.map_err(of_status)?;
            if let Some(report) = answer.report.filter(|report| report.refused) {
                let what = report.problems.first().map(|problem| format!("{}: {}", problem.element, problem.what));
                return Err(refused(Refusal::new(Reason::OutOfRange, "scene", what.unwrap_or_default())));
            }
            of_scene.mesh_id = answer.mesh_id;
        }
        Ok(Source::Scene(*scene))
    }
}
