//! The surface of a session as an engine shows it: positions and normals of its vertices, how burnt they are, and its constant mesh.

use std::sync::{Arc, OnceLock};

use palpate_proto::pb;
use pb::view_service_client::ViewServiceClient;
use tokio::sync::watch;
use tokio::task::JoinSet;

use crate::Error;
use crate::connect::Channel;
use crate::exchange::{self, NewestReader, NewestWriter};
use crate::surface_burns::follow_burns;
use crate::view::{Frames, MAX_VERTICES, SurfaceState};

pub use crate::surface_burns::SurfaceBurns;

/// The part of a surface that does not change: rest positions, texture coordinates and triangles.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ShownMesh {
    /// Position of each vertex at rest, m, in the tissue's frame.
    pub rest_m: Vec<[f32; 3]>,
    /// Texture coordinates u, v of each vertex, from the lower left of the image; empty if the surface has none.
    pub texture: Vec<[f32; 2]>,
    /// Indices in `rest_m` of each triangle's vertices, counter-clockwise as seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

/// A surface at one moment: at rest, or after a frame. Its vertices have the order of [`ShownMesh`].
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SurfaceMoment {
    /// Number of frames received so far; 0 at rest, before the first.
    pub frames: u64,
    /// Number of steps that the session had done; 0 before the first frame.
    pub step: u64,
    /// Simulated time of the session, s; 0 before the first frame.
    pub simulation_time_s: f64,
    /// Position of each vertex, m, in the tissue's frame.
    pub position_m: Vec<[f32; 3]>,
    /// Outward unit normal of each vertex; 0 for a vertex without a triangle.
    pub normal: Vec<[f32; 3]>,
}

/// A session's surface that follows its newest frame: tasks of the runtime receive frames, and a thread that draws
/// takes the newest moment without waiting. Watching ends when this is dropped.
pub struct ShownSurface {
    mesh: Arc<ShownMesh>,
    newest: NewestReader<SurfaceMoment>,
    burns: NewestReader<SurfaceBurns>,
    lost: Arc<OnceLock<String>>,
    _watching: JoinSet<()>,
}

impl std::fmt::Debug for ShownSurface {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let ShownMesh { rest_m, triangles, .. } = &*self.mesh;
        f.debug_struct("Shown")
            .field("vertices", &rest_m.len())
            .field("triangles", &triangles.len())
            .finish_non_exhaustive()
    }
}

impl ShownSurface {
    /// Gets the mesh and starts to watch its frames. `refinement` is the number of vertices between neighbouring
    /// points, 0 to 10 (0 on a mesh); `rate_hz` is the number of frames per second, at most the session's step rate.
    /// Positions and normals are computed in a task of the current Tokio runtime. Set a time limit around this call.
    ///
    /// # Errors
    /// Returns the errors of [`mesh`], and [`Error::Call`] if the server refuses the frames.
    pub async fn open(channel: Channel, session_id: &str, refinement: u32, rate_hz: f64) -> Result<Self, Error> {
        let mesh = Arc::new(mesh(channel.clone(), session_id, refinement).await?);
        let request = pb::WatchFramesRequest {
            session_id: session_id.to_owned(),
            refinement,
            encoding: pb::Encoding::I16.into(),
            rate_hz: Some(rate_hz),
            ..Default::default()
        };
        let frames = Frames::open(channel.clone(), request).await?;
        let at_rest = SurfaceMoment {
            position_m: mesh.rest_m.clone(),
            normal: normals(&mesh.rest_m, &mesh.triangles),
            ..SurfaceMoment::default()
        };
        let (writer, newest) = exchange::newest(&at_rest);
        let lost = Arc::new(OnceLock::new());
        let mut watching = JoinSet::new();
        let (of_task, told) = (mesh.clone(), lost.clone());
        let (burn_version, wanted) = watch::channel(0);
        watching.spawn(async move {
            let _ = told.set(watch(frames, &of_task, writer, burn_version).await);
        });
        let unburnt = SurfaceBurns::none(mesh.rest_m.len());
        let (burns_writer, burns) = exchange::newest(&unburnt);
        watching.spawn(follow_burns(channel, session_id.to_owned(), refinement, wanted, (unburnt, burns_writer)));
        Ok(ShownSurface { mesh, newest, burns, lost, _watching: watching })
    }

    /// Returns the constant part of the surface, which the server sent when this was opened.
    pub fn mesh(&self) -> &ShownMesh {
        &self.mesh
    }

    /// Takes the newest moment, if there is one newer than that of the last call, for [`ShownSurface::read`]. Returns
    /// whether there was one. Moments in between are skipped. Never waits.
    pub fn refresh(&mut self) -> bool {
        self.newest.refresh()
    }

    /// Calls `read` with the moment that the last [`ShownSurface::refresh`] took, the surface at rest before the first
    /// one, and returns its result. Never waits.
    pub fn read<R>(&self, read: impl FnOnce(&SurfaceMoment) -> R) -> R {
        read(self.newest.read())
    }

    /// Takes the newest burns, if there are newer ones than those of the last call, and returns them. They have the order of
    /// [`ShownMesh`], and come a round trip after the frame that tells of them. Never waits.
    pub fn burns(&mut self) -> &SurfaceBurns {
        self.burns.refresh();
        self.burns.read()
    }

    /// Returns why no newer moment will arrive: the server has ended the frames, the connection broke, or a frame
    /// could not be read. `None` while frames are watched. Once lost, the surface is not watched again: open another.
    pub fn lost(&self) -> Option<&str> {
        self.lost.get().map(String::as_str)
    }
}

/// Receives frames until there are no more; returns why. Tells the version of what is burnt with each.
async fn watch(
    mut frames: Frames,
    mesh: &ShownMesh,
    mut writer: NewestWriter<SurfaceMoment>,
    burn_version: watch::Sender<u32>,
) -> String {
    let mut count = 0;
    loop {
        match frames.next().await {
            Ok(Some((last, surface))) => {
                count += 1;
                writer.write(|moment| {
                    (moment.frames, moment.step) = (count, last.step);
                    moment.simulation_time_s = last.simulation_time_s;
                    place(mesh, surface, moment);
                });
                burn_version.send_replace(last.burn_version);
            }
            Ok(None) => return "the server has ended the frames".to_owned(),
            Err(status) => return crate::describe(&status),
        }
    }
}

/// Writes the positions and normals of a moment.
fn place(mesh: &ShownMesh, surface: &SurfaceState, moment: &mut SurfaceMoment) {
    // A frame may have more vertices than the mesh.
    for ((position_m, rest_m), moved_m) in moment.position_m.iter_mut().zip(&mesh.rest_m).zip(&surface.displacement_m) {
        *position_m = [rest_m[0] + moved_m[0], rest_m[1] + moved_m[1], rest_m[2] + moved_m[2]];
    }
    write_normals(&moment.position_m, &mesh.triangles, &mut moment.normal);
}

fn normals(position_m: &[[f32; 3]], triangles: &[[u32; 3]]) -> Vec<[f32; 3]> {
    let mut normals = vec![[0.0; 3]; position_m.len()];
    write_normals(position_m, triangles, &mut normals);
    normals
}

/// Computes the normal of each vertex: the mean over its triangles, weighted by their areas.
fn write_normals(position_m: &[[f32; 3]], triangles: &[[u32; 3]], normals: &mut [[f32; 3]]) {
    normals.fill([0.0; 3]);
    for corners in triangles {
        let [a, b, c] = corners.map(|corner| position_m[corner as usize]);
        let (u, v) = ([b[0] - a[0], b[1] - a[1], b[2] - a[2]], [c[0] - a[0], c[1] - a[1], c[2] - a[2]]);
        let area = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        for corner in corners {
            for (sum, part) in normals[*corner as usize].iter_mut().zip(area) {
                *sum += part;
            }
        }
    }
    for normal in normals {
        let length = normal.iter().map(|part| part * part).sum::<f32>().sqrt();
        let scale = if length > 0.0 { length.recip() } else { 0.0 };
        *normal = normal.map(|part| part * scale);
    }
}

/// Gets the mesh of a session's surface at rest, with `refinement` vertices between neighbouring points, 0 to 10 (0 on
/// a mesh). Texture coordinates that are not there for each vertex are left out.
///
/// # Errors
/// Returns [`Error::Call`] with the server's refusal or how the connection broke, and [`Error::Connection`] if the
/// mesh has more than 2²⁴ vertices or four times as many triangles, or a triangle with a vertex that is not there.
pub async fn mesh(channel: Channel, session_id: &str, refinement: u32) -> Result<ShownMesh, Error> {
    let request = pb::GetMeshRequest { session_id: session_id.to_owned(), refinement };
    let mut parts = ViewServiceClient::new(channel).get_mesh(request).await?.into_inner();
    let mut mesh = ShownMesh::default();
    while let Some(part) = parts.message().await? {
        mesh.rest_m.extend_from_slice(part.rest_position_m.as_chunks().0);
        mesh.texture.extend_from_slice(part.texture_coordinates.as_chunks().0);
        mesh.triangles.extend_from_slice(part.triangles.as_chunks().0);
        if mesh.rest_m.len() > MAX_VERTICES || mesh.triangles.len() > 4 * MAX_VERTICES {
            return Err(Error::Connection("the server's mesh is too large to be shown".to_owned()));
        }
    }
    let is_beyond = |corner: &u32| *corner as usize >= mesh.rest_m.len();
    if mesh.triangles.iter().flatten().any(is_beyond) {
        return Err(Error::Connection("the server's mesh has a triangle beyond its last vertex".to_owned()));
    }
    if mesh.texture.len() != mesh.rest_m.len() {
        mesh.texture.clear();
    }
    Ok(mesh)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normals_point_out_of_triangles_and_have_length_one() {
        // Two triangles of a millimetre at a right angle, with an edge along y; and a vertex without a triangle.
        let corners = [[0.0, 0.0, 0.0], [0.0, 1e-3, 0.0], [-1e-3, 0.0, 0.0], [0.0, 0.0, -1e-3], [1.0; 3]];
        let normals = normals(&corners, &[[0, 1, 2], [0, 3, 1]]);
        let half = 0.5_f32.sqrt();
        for (normal, expected) in
            normals.iter().zip([[half, 0.0, half], [half, 0.0, half], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0; 3]])
        {
            assert!(normal.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{normal:?}, {expected:?}");
        }
    }

    #[test]
    fn a_frame_moves_vertices_and_what_it_has_beyond_the_last_is_left_out() {
        let mesh = ShownMesh { rest_m: vec![[1.0, 2.0, 3.0]; 3], ..ShownMesh::default() };
        let surface = SurfaceState { vertices: [1, 4], displacement_m: vec![[0.5, 0.0, -1.0]; 4] };
        let mut moment =
            SurfaceMoment { position_m: mesh.rest_m.clone(), normal: vec![[0.0; 3]; 3], ..SurfaceMoment::default() };
        place(&mesh, &surface, &mut moment);
        assert_eq!(moment.position_m, [[1.5, 2.0, 2.0]; 3]);
    }
}
