//! The vertices of a mesh as frames show them, in an order that keeps neighbours together. If a coarser mesh is
//! simulated than the file has, each vertex of the file moves with a place on that one.

use std::sync::Arc;

use glam::DVec3;
use palpate_geometry::Group;

use palpate_tissue::Model;
use palpate_tissue::memory;
use palpate_tissue::scene::{BoundPlace, MeshShape};
use palpate_tissue::shape::RestShape;

/// Name of the skin's tables in messages.
const TABLES: &str = "the shown surface of a mesh";

/// Surface by which frames show a tissue on a mesh: the vertices of the mesh file, their order in a frame, and how
/// they move with the simulated vertices, which may be fewer. Vertices are numbered as in the file.
#[derive(Debug, PartialEq)]
pub struct Skin {
    shape: Arc<MeshShape>,
    /// The vertex at each place of a frame, and the place of each vertex.
    vertices: Vec<u32>,
    places: Vec<u32>,
    /// Texture coordinates of each vertex, if the file has them.
    uv: Option<Vec<[f32; 2]>>,
    /// If another mesh is simulated: how each place of a frame moves with it. Otherwise empty.
    bound: Vec<SkinVertex>,
    /// Rest positions of that mesh's vertices, in the order of memory, m.
    rest_m: Vec<DVec3>,
}

/// A vertex that moves with a triangle of the simulated mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
struct SkinVertex {
    /// Slots of the triangle's corners in memory.
    corners: [u32; 3],
    weights: [f64; 3],
    height_m: f64,
}

impl Skin {
    /// Creates the skin of a tissue on a mesh; `None` for a sheet. It unwinds with a refusal if there is no memory
    /// for its tables (`palpate_tissue::memory`).
    pub fn of(model: &Model) -> Option<Arc<Self>> {
        let (mesh, [order, slot_of]) = model.scene.mesh().zip(model.shown_order())?;
        let shape = mesh.shape.clone();
        let Some(shown) = shape.shown() else {
            let (vertices, places) = (order.to_vec(), slot_of.to_vec());
            let uv = shape.told().uv.clone();
            return Some(Arc::new(Skin { vertices, places, uv, bound: Vec::new(), rest_m: Vec::new(), shape }));
        };
        let corners =
            |place: &BoundPlace| shape.triangles()[place.triangle as usize].map(|vertex| slot_of[vertex as usize]);
        // Vertices that move with neighbouring triangles are shown side by side.
        let count = shown.places.len();
        #[allow(clippy::cast_possible_truncation)]
        let mut vertices: Vec<u32> = memory::collected(0..count as u32, TABLES);
        vertices.sort_by_key(|vertex| (corners(&shown.places[*vertex as usize]).iter().min().copied(), *vertex));
        let mut places: Vec<u32> = memory::zeroed(count, TABLES);
        for (place, vertex) in (0..).zip(&vertices) {
            places[*vertex as usize] = place;
        }
        let bound = vertices.iter().map(|vertex| {
            let place = &shown.places[*vertex as usize];
            SkinVertex { corners: corners(place), weights: place.barycentric, height_m: place.height_m }
        });
        let bound = memory::collected(bound, TABLES);
        let rest_m = memory::collected(order.iter().map(|vertex| shape.vertices_m()[*vertex as usize]), TABLES);
        let uv = shown.mesh.uv.as_ref().map(|_| {
            let mut of_vertex = memory::filled(count, [0.0; 2], TABLES);
            shown.mesh.write_vertex_uv(&mut of_vertex);
            of_vertex
        });
        Some(Arc::new(Skin { vertices, places, uv, bound, rest_m, shape }))
    }

    /// Returns the number of the vertex at each place of a frame: place p is row p/[`MESH_ROW`](super::MESH_ROW) and
    /// column p mod it. Places beyond the last vertex are left out.
    pub fn vertices(&self) -> &[u32] {
        &self.vertices
    }

    /// Returns the place in a frame of each vertex of the file: the inverse of [`Skin::vertices`].
    pub fn places(&self) -> &[u32] {
        &self.places
    }

    /// Returns the rest position of a vertex of the file, m, in the tissue's frame. Panics if the file has no such
    /// vertex.
    pub fn rest_m(&self, vertex: u32) -> DVec3 {
        let own = self.shape.shown().map_or(self.shape.vertices_m(), |shown| &shown.mesh.vertices_m);
        own[vertex as usize]
    }

    /// Returns the triangles of the file, each as three of its vertices, anticlockwise seen from outside.
    pub fn triangles(&self) -> &[[u32; 3]] {
        self.shape.shown().map_or(self.shape.triangles(), |shown| &shown.mesh.triangles)
    }

    /// Returns the named groups of the file's vertices; empty if it has none.
    pub fn groups(&self) -> &[Group] {
        self.shape.shown().map_or(&self.shape.told().groups, |shown| &shown.mesh.groups)
    }

    /// Returns the texture coordinates of a vertex of the file; `None` if the file has none. Panics if it has
    /// coordinates but no such vertex.
    pub fn texture_at(&self, vertex: u32) -> Option<[f32; 2]> {
        self.uv.as_ref().map(|uv| uv[vertex as usize])
    }

    /// Returns the usual length of an edge of the simulated mesh, m; the file may have shorter edges.
    pub fn edge_m(&self) -> f64 {
        self.shape.edge_m()
    }

    /// Returns the memory of the skin's tables, bytes, without the mesh that it shares with the model.
    pub fn bytes(&self) -> u64 {
        let uv = self.uv.as_deref().map_or(0, size_of_val);
        let tables = size_of_val(&*self.vertices) + size_of_val(&*self.places);
        (tables + uv + size_of_val(&*self.bound) + size_of_val(&*self.rest_m)) as u64
    }

    /// Returns whether the shown vertices differ from the simulated ones.
    pub(super) fn is_bound(&self) -> bool {
        !self.bound.is_empty()
    }

    /// Returns the displacements of the shown vertices, m, in the order of a frame of `count` places, from those of
    /// the simulated vertices in the order of memory.
    #[allow(clippy::cast_possible_truncation)]
    pub(super) fn displacement_m(&self, simulated_m: &[Vec<f32>; 3], count: usize) -> [Vec<f32>; 3] {
        let mut shown_m = [(); 3].map(|()| memory::zeroed::<f32>(count, TABLES));
        for (place, bound) in self.bound.iter().enumerate() {
            let moved_m = bound
                .corners
                .map(|slot| DVec3::from_array(std::array::from_fn(|c| f64::from(simulated_m[c][slot as usize]))));
            let rest_m = bound.corners.map(|slot| self.rest_m[slot as usize]);
            let normal = |[a, b, c]: [DVec3; 3]| (b - a).cross(c - a).normalize_or_zero();
            let turned = normal([0, 1, 2].map(|k| rest_m[k] + moved_m[k])) - normal(rest_m);
            let [u, v, w] = bound.weights;
            let by_m = u * moved_m[0] + v * moved_m[1] + w * moved_m[2] + bound.height_m * turned;
            for (shown_m, by_m) in shown_m.iter_mut().zip(by_m.to_array()) {
                shown_m[place] = by_m as f32;
            }
        }
        shown_m
    }
}
