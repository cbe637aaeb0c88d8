//! Converts scenes for a server. The mesh of a scene is uploaded before it.

use std::path::Path;

use palpate_client::Channel;
use palpate_client::upload::upload_mesh;
use palpate_proto::pb;
use palpate_refusal::{Reason, Refusal};
use palpate_session::wire::scene::{MeshToSend, SceneToSend};
use palpate_tissue::scene::sent::mesh_file;
use pb::create_session_request::Source;
use pyo3::PyResult;

use crate::error::{of_status, refused};
use crate::scene::{Scene, limits};

/// The source of a new session.
pub(crate) enum SessionSource {
    /// One of the server's scenes.
    Name(String),
    Scene(Box<SceneToSend>),
}

impl SessionSource {
    /// Converts a scene that was read here.
    pub(crate) fn of(scene: &Scene) -> Result<Self, Refusal> {
        let file = Path::new(&scene.place);
        let said = if file.is_file() { mesh_file(file, &limits())? } else { None };
        Ok(SessionSource::Scene(Box::new(SceneToSend::of(&scene.scene, said.as_ref(), None))))
    }

    /// Returns the source for the server; uploads the mesh, if there is one.
    pub(crate) async fn source(self, channel: Channel) -> PyResult<Source> {
        let scene = match self {
            SessionSource::Name(name) => return Ok(Source::SceneName(name)),
            SessionSource::Scene(scene) => scene,
        };
        let mut mesh_id = String::new();
        if let Some(MeshToSend { name, bytes, unit }) = &scene.upload {
            let answer = upload_mesh(channel, name, bytes, unit, None, false).await.map_err(of_status)?;
            if let Some(report) = answer.report.filter(|report| report.refused) {
                let what = report.problems.first().map(|problem| format!("{}: {}", problem.element, problem.what));
                return Err(refused(Refusal::new(Reason::OutOfRange, "scene", what.unwrap_or_default())));
            }
            mesh_id = answer.mesh_id;
        }
        Ok(Source::Scene(scene.with_mesh_id(mesh_id)))
    }
}
