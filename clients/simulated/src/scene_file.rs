//! Scenes by name or from files, converted for a server. The mesh of a scene file is uploaded before the scene.

use std::path::{Path, PathBuf};

use glam::DVec3;
use palpate_client::upload::upload_mesh;
use palpate_client::{Channel, Error};
use palpate_geometry::{Group, TriangleMesh};
use palpate_proto::{pb, scene};
use palpate_refusal::Refusal;
use palpate_session::wire;
use palpate_session::wire::scene::{MeshToSend, SceneToSend};
use palpate_tissue::files;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::Scene;
use palpate_tissue::scene::sent::mesh_file;
use pb::create_session_request::Source;
use pb::view_service_client::ViewServiceClient;
use tonic::Status;

/// Extensions of files whose bytes alone do not tell the mesh of a scene.
const REWRITTEN: [&str; 8] = ["gltf", "node", "ele", "nrrd", "nhdr", "nii", "gz", "dcm"];

/// The scene of sessions to create: the name of one of the server's scenes, or a scene read from a file with its mesh.
pub struct SceneFile(SceneOrigin);

enum SceneOrigin {
    Name(String),
    /// A scene, and how it is sent.
    Own(Box<(Scene, SceneToSend)>),
}

impl SceneFile {
    /// Reads a scene: `scene` is a path that ends in .toml, or otherwise the name of one of the server's scenes,
    /// which is not checked. Reads the mesh that the file names too. Sends nothing.
    ///
    /// # Errors
    /// Refuses a scene file or mesh that can't be read, is invalid, or exceeds the default limits.
    pub fn read(scene: &str) -> Result<Self, Refusal> {
        let file = Path::new(scene);
        if file.extension().is_none_or(|extension| extension != "toml") {
            return Ok(SceneFile(SceneOrigin::Name(scene.to_owned())));
        }
        let limits = Limits::default();
        let own = Scene::load(file, &[], &limits)?;
        let said = mesh_file(file, &limits)?;
        // The other files of a textual glTF file or of TetGen are not uploaded, nor is the label of a scan; a rewritten
        // mesh contains everything.
        let whole = |path: &&PathBuf| {
            path.extension().is_none_or(|extension| !REWRITTEN.iter().any(|own| extension.eq_ignore_ascii_case(own)))
        };
        let mesh = match said.as_ref().and_then(|said| Some((said.path.as_ref().filter(whole)?, said))) {
            Some((path, said)) => {
                let bytes = files::read_regular(path, limits.mesh_bytes)?;
                let name = path.file_name().map(|name| name.to_string_lossy().into_owned());
                Some(MeshToSend { name: name.unwrap_or_default(), bytes, unit: said.unit.clone() })
            }
            None => None,
        };
        let to_send = SceneToSend::of(&own, said.as_ref(), mesh);
        Ok(SceneFile(SceneOrigin::Own(Box::new((own, to_send)))))
    }

    /// Returns the source of a session for a call to create it. Uploads the mesh of the file, if there is one, at each
    /// call.
    ///
    /// # Errors
    /// Returns [`Error::Call`] if the server refuses the upload or the connection breaks, and [`Error::Argument`] with
    /// the first problem if the server can't use the mesh.
    pub async fn source(&self, channel: Channel) -> Result<Source, Error> {
        let to_send = match &self.0 {
            SceneOrigin::Name(name) => return Ok(Source::SceneName(name.clone())),
            SceneOrigin::Own(own) => &own.1,
        };
        let mut mesh_id = String::new();
        if let Some(MeshToSend { name, bytes, unit }) = &to_send.upload {
            let sent = upload_mesh(channel, name, bytes, unit, None, false).await?;
            if let Some(report) = sent.report.filter(|report| report.refused) {
                let what = report.problems.first().map(|problem| format!("{}: {}", problem.element, problem.what));
                return Err(Error::Argument(format!("{name}: {}", what.unwrap_or_default())));
            }
            mesh_id = sent.mesh_id;
        }
        Ok(Source::Scene(to_send.with_mesh_id(mesh_id)))
    }

    /// Returns the scene of `session`, which the server has created from this source: that of the file if it has a
    /// mesh, otherwise that of the server. A mesh of the server is fetched over `channel`: its rest positions have
    /// only seven digits, it has all vertices of its file, and all points and springs have the reference values.
    ///
    /// # Errors
    /// Returns [`Error::Connection`] if `session` has no scene, [`Error::Call`] if the server refuses to send its
    /// mesh or the connection breaks, and [`Error::Argument`] if the scene is invalid.
    pub async fn scene(&self, session: &pb::Session, channel: Channel) -> Result<Scene, Error> {
        let told = session.scene.as_ref().ok_or_else(|| Error::Connection("the server sent no scene".to_owned()))?;
        let wrong = |refusal: Refusal| Error::Argument(refusal.to_string());
        if scene::mesh_id(told).is_none() {
            return wire::scene::from_scene(told, None).map_err(wrong);
        }
        match &self.0 {
            SceneOrigin::Own(own) => Ok(own.0.clone()),
            SceneOrigin::Name(_) => {
                let mesh = server_mesh(&session.session_id, channel).await?;
                wire::scene::from_told(told, &mesh).map_err(wrong)
            }
        }
    }
}

/// Gets the mesh of a session, with the vertex numbers of its file.
async fn server_mesh(session_id: &str, channel: Channel) -> Result<TriangleMesh, Status> {
    let request = pb::GetMeshRequest { session_id: session_id.to_owned(), refinement: 0 };
    let mut parts = ViewServiceClient::new(channel).get_mesh(request).await?.into_inner();
    let (mut rest_m, mut file_vertex, mut triangles, mut mesh) =
        (Vec::new(), Vec::new(), Vec::new(), TriangleMesh::default());
    while let Some(part) = parts.message().await? {
        rest_m.extend(part.rest_position_m.as_chunks().0.iter().map(|place: &[f32; 3]| place.map(f64::from)));
        file_vertex.extend(part.file_vertex);
        triangles.extend_from_slice(part.triangles.as_chunks::<3>().0);
        for group in part.groups {
            match mesh.groups.last_mut().filter(|last| last.name == group.name) {
                Some(last) => last.vertices.extend(group.vertices),
                None => mesh.groups.push(Group { name: group.name, vertices: group.vertices }),
            }
        }
    }
    let wrong = || Status::data_loss("the server's mesh has a vertex beyond its last");
    mesh.vertices_m = vec![DVec3::ZERO; rest_m.len()];
    for (place_m, vertex) in rest_m.iter().zip(&file_vertex) {
        *mesh.vertices_m.get_mut(*vertex as usize).ok_or_else(wrong)? = DVec3::from_array(*place_m);
    }
    let number = |place: u32| file_vertex.get(place as usize).copied().ok_or_else(wrong);
    for [a, b, c] in triangles {
        mesh.triangles.push([number(a)?, number(b)?, number(c)?]);
    }
    Ok(mesh)
}
