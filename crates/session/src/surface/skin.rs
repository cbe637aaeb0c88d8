//! The vertices of a tissue's surface as frames show them, in an order that keeps neighbours together. If the simulated
//! points are not these vertices, as on a mesh coarser than its file, each vertex moves with a place among them.

use std::sync::{Arc, Mutex};

use glam::DVec3;
use palpate_geometry::Group;

use palpate_tissue::lock::lock;
use palpate_tissue::memory;
use palpate_tissue::shape::{BoundPlace, CellPlace, PointId, RestShape, ShownShape};
use palpate_tissue::{CutFace, CutSurface, CutVertex, Cuts, Model};

use super::refine::{MESH_ROW, Refinement};

/// Name of the skin's tables in messages.
const TABLES: &str = "the shown surface of a mesh";

/// Surface by which frames show a tissue whose points are no grid: its vertices, their order in a frame, and how they move
/// with the simulated points, which may be fewer. Vertices of a mesh are numbered as in its file.
#[derive(Debug)]
pub struct Skin {
    shape: Arc<dyn RestShape>,
    /// The vertex at each place of a frame, and the place of each vertex.
    vertices: Vec<u32>,
    places: Vec<u32>,
    /// Texture coordinates of each vertex, if the surface has them.
    uv: Option<Vec<[f32; 2]>>,
    /// If the vertices are not the points: how each place of a frame moves with these. Otherwise empty.
    bound: Vec<SkinVertex>,
    /// If the vertices move with cells of points: how each place of a frame does. Otherwise empty.
    in_cells: Vec<CellPlace>,
    /// Rest positions of the points then, in the order of memory, m.
    rest_m: Vec<DVec3>,
    model: Arc<Model>,
    /// The newest surface within cuts, and what was severed then.
    cut_surface: Mutex<(Cuts, Arc<CutSurface>)>,
}

/// A vertex that moves with a triangle of points.
#[derive(Debug, Clone, Copy, PartialEq)]
struct SkinVertex {
    /// Slots of the triangle's corners in memory.
    corners: [u32; 3],
    weights: [f64; 3],
    height_m: f64,
}

impl Skin {
    /// Creates the skin of a tissue; `None` if its points are a grid, which needs none. It unwinds with a refusal if there
    /// is no memory for its tables (`palpate_tissue::memory`).
    pub fn of(model: &Arc<Model>) -> Option<Arc<Self>> {
        let [order, place_of] = model.shown_order()?;
        let shape = model.scene.shared_shape();
        let shown = shape.shown_surface()?;
        let uv = shape.shown_uv();
        if !shown.in_cells.is_empty() {
            return Some(Arc::new(Self::in_cells(shown.in_cells, place_of, uv, model)));
        }
        if shown.bound.is_empty() {
            let (vertices, places) = (order.to_vec(), place_of.to_vec());
            return Some(Arc::new(Skin {
                vertices,
                places,
                uv,
                bound: Vec::new(),
                in_cells: Vec::new(),
                rest_m: Vec::new(),
                shape,
                model: model.clone(),
                cut_surface: Mutex::default(),
            }));
        }
        let triangles = shape.triangles();
        let corners = |place: &BoundPlace| triangles[place.triangle as usize].map(|point| place_of[point as usize]);
        // Vertices that move with neighbouring triangles are shown side by side.
        let count = shown.bound.len();
        #[allow(clippy::cast_possible_truncation)]
        let mut vertices: Vec<u32> = memory::collected(0..count as u32, TABLES);
        vertices.sort_by_key(|vertex| (corners(&shown.bound[*vertex as usize]).iter().min().copied(), *vertex));
        let mut places: Vec<u32> = memory::zeroed(count, TABLES);
        for (place, vertex) in (0..).zip(&vertices) {
            places[*vertex as usize] = place;
        }
        let bound = vertices.iter().map(|vertex| {
            let place = &shown.bound[*vertex as usize];
            SkinVertex { corners: corners(place), weights: place.barycentric, height_m: place.height_m }
        });
        let bound = memory::collected(bound, TABLES);
        let rest_m = order.iter().map(|point| shape.rest_m(PointId::new(*point as usize)));
        let rest_m = memory::collected(rest_m, TABLES);
        let (in_cells, model, cut_surface) = (Vec::new(), model.clone(), Mutex::default());
        Some(Arc::new(Skin { vertices, places, uv, bound, in_cells, rest_m, shape, model, cut_surface }))
    }

    /// Creates the skin of a tissue whose surface moves with cells of points.
    fn in_cells(cells: &[CellPlace], place_of: &[u32], uv: Option<Vec<[f32; 2]>>, model: &Arc<Model>) -> Self {
        // Vertices that move with neighbouring cells are shown side by side.
        #[allow(clippy::cast_possible_truncation)]
        let mut vertices: Vec<u32> = memory::collected(0..cells.len() as u32, TABLES);
        vertices.sort_by_key(|vertex| (cells[*vertex as usize].points[0], *vertex));
        let mut places: Vec<u32> = memory::zeroed(cells.len(), TABLES);
        for (place, vertex) in (0..).zip(&vertices) {
            places[*vertex as usize] = place;
        }
        let in_memory = |vertex: &u32| {
            let CellPlace { points, weights } = cells[*vertex as usize];
            CellPlace { points: points.map(|point| place_of[point as usize]), weights }
        };
        let in_cells = memory::collected(vertices.iter().map(in_memory), TABLES);
        let (shape, model, cut_surface) = (model.scene.shared_shape(), model.clone(), Mutex::default());
        Skin { vertices, places, uv, bound: Vec::new(), in_cells, rest_m: Vec::new(), shape, model, cut_surface }
    }

    /// Returns the shown surface at rest.
    fn surface(&self) -> ShownShape<'_> {
        self.shape.shown_surface().unwrap_or_default()
    }

    /// Returns the number of the vertex at each place of a frame: place p is row p/[`MESH_ROW`](super::MESH_ROW) and
    /// column p mod it. Places beyond the last vertex are left out.
    pub fn vertices(&self) -> &[u32] {
        &self.vertices
    }

    /// Returns the place in a frame of each vertex: the inverse of [`Skin::vertices`].
    pub fn places(&self) -> &[u32] {
        &self.places
    }

    /// Returns the rest position of a vertex, m, in the tissue's frame. Panics if there is no such vertex.
    pub fn rest_m(&self, vertex: u32) -> DVec3 {
        self.surface().vertices_m[vertex as usize]
    }

    /// Returns the triangles, each as three vertices, anticlockwise seen from outside.
    pub fn triangles(&self) -> &[[u32; 3]] {
        self.surface().triangles
    }

    /// Returns the named groups of vertices; empty if there are none.
    pub fn groups(&self) -> &[Group] {
        self.surface().groups
    }

    /// Returns the texture coordinates of a vertex; `None` if the surface has none. Panics if it has
    /// coordinates but no such vertex.
    pub fn texture_at(&self, vertex: u32) -> Option<[f32; 2]> {
        self.uv.as_ref().map(|uv| uv[vertex as usize])
    }

    /// Returns the usual distance of neighbouring points, m; shown vertices may be closer.
    pub fn edge_m(&self) -> f64 {
        self.shape.edge_m()
    }

    /// Returns the memory of the skin's tables, and of the surface within cuts at most, bytes, without the mesh that it shares with the model.
    pub fn bytes(&self) -> u64 {
        let uv = self.uv.as_deref().map_or(0, size_of_val);
        let tables = size_of_val(&*self.vertices) + size_of_val(&*self.places);
        let bound = size_of_val(&*self.bound) + size_of_val(&*self.in_cells);
        let cut_surface = self.model.max_cut_vertices() * size_of::<(CutVertex, [CutFace; 2])>();
        (tables + uv + bound + size_of_val(&*self.rest_m) + cut_surface) as u64
    }

    /// Returns whether the shown vertices differ from the simulated ones.
    pub fn is_bound(&self) -> bool {
        !self.bound.is_empty() || !self.in_cells.is_empty()
    }

    /// Returns the places in memory of the corners of the triangle with which the vertex at each place of a frame moves, and their weights,
    /// which add up to 1; empty if the vertices are the points, and for a solid.
    #[allow(clippy::cast_possible_truncation)]
    pub(super) fn bound_places(&self) -> impl ExactSizeIterator<Item = ([u32; 3], [f32; 3])> + '_ {
        self.bound.iter().map(|bound| (bound.corners, bound.weights.map(|weight| weight as f32)))
    }

    /// Returns the surface within the cuts of a solid; empty for other tissues. The newest one is kept.
    pub fn cut_surface(&self, cuts: &Cuts) -> Arc<CutSurface> {
        if self.in_cells.is_empty() || cuts.is_empty() {
            return Arc::default();
        }
        let kept = |kept: &(Cuts, Arc<CutSurface>)| kept.0.is_same(cuts).then(|| kept.1.clone());
        let known = kept(&lock(&self.cut_surface));
        known.unwrap_or_else(|| {
            // Not under the lock: another reader may be in a hurry.
            let surface = Arc::new(CutSurface::of(&self.model, cuts));
            let mut kept = lock(&self.cut_surface);
            if kept.0.version() <= cuts.version() {
                *kept = (cuts.clone(), surface.clone());
            }
            surface
        })
    }

    /// Returns the number of rows of a frame that have vertices of the surface within cuts.
    pub(super) fn used_cut_rows(&self, cuts: &Cuts) -> usize {
        self.cut_surface(cuts).vertices.len().div_ceil(MESH_ROW)
    }

    /// Returns the place in a frame of the first vertex of the surface within cuts: that of the row after the last vertex.
    pub fn first_cut_place(&self) -> usize {
        self.vertices.len().next_multiple_of(MESH_ROW)
    }

    /// Returns a refinement of frames that have the vertices of the surface within cuts as well, if this is a solid.
    #[must_use]
    pub fn with_cut_surface(&self, refinement: Refinement) -> Refinement {
        refinement.with_rows(self.cut_rows())
    }

    /// Returns the number of rows of a frame for the vertices of the surface within cuts: 0 but for a solid.
    pub fn cut_rows(&self) -> usize {
        if self.in_cells.is_empty() { 0 } else { self.model.max_cut_vertices().div_ceil(MESH_ROW) }
    }

    /// Returns the cell that the vertex at each place of a frame moves with, its corners by their places in memory; empty but for a solid.
    pub(super) fn cell_places(&self) -> &[CellPlace] {
        &self.in_cells
    }

    /// Returns the place in memory of the least corner of the cell that the vertex at each place of a frame moves with; empty but for a
    /// solid.
    pub(super) fn cells(&self) -> impl ExactSizeIterator<Item = u32> + '_ {
        self.in_cells.iter().map(|cell| cell.points[0])
    }

    /// Returns what [`Skin::displacement_m`] does, followed by the displacements of the vertices of the surface within cuts.
    pub(super) fn displacement_with_cut_surface_m(
        &self,
        simulated_m: &[Vec<f32>; 3],
        cuts: &Cuts,
        count: usize,
    ) -> [Vec<f32>; 3] {
        let mut shown_m = self.displacement_m(simulated_m, cuts, count);
        for (place, vertex) in (self.first_cut_place()..count).zip(&self.cut_surface(cuts).vertices) {
            move_with(&vertex.cell, simulated_m, &mut shown_m, place);
        }
        shown_m
    }

    /// Returns the displacements of the shown vertices, m, in the order of a frame of `count` places, from those of
    /// the simulated vertices in the order of memory. Vertices in cells that a cut has parted from others move with their own cell.
    #[allow(clippy::cast_possible_truncation)]
    pub(super) fn displacement_m(&self, simulated_m: &[Vec<f32>; 3], cuts: &Cuts, count: usize) -> [Vec<f32>; 3] {
        let mut shown_m = [(); 3].map(|()| memory::zeroed::<f32>(count, TABLES));
        for (place, CellPlace { points, weights }) in self.in_cells.iter().enumerate() {
            let points = cuts.doubled_corners(points[0]).unwrap_or(*points);
            move_with(&CellPlace { points, weights: *weights }, simulated_m, &mut shown_m, place);
        }
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

/// Sets the displacement of a place of a frame that moves with a cell, m.
#[allow(clippy::cast_possible_truncation)]
fn move_with(cell: &CellPlace, simulated_m: &[Vec<f32>; 3], shown_m: &mut [Vec<f32>; 3], place: usize) {
    for (shown_m, simulated_m) in shown_m.iter_mut().zip(simulated_m) {
        let part_m = |(point, weight): (&u32, &f64)| weight * f64::from(simulated_m[*point as usize]);
        shown_m[place] = cell.points.iter().zip(&cell.weights).map(part_m).sum::<f64>() as f32;
    }
}

impl PartialEq for Skin {
    fn eq(&self, other: &Self) -> bool {
        // The rest follows from these.
        std::ptr::eq(self, other)
            || self.surface() == other.surface()
                && self.vertices == other.vertices
                && self.bound == other.bound
                && self.in_cells == other.in_cells
                && self.uv == other.uv
    }
}
