//! The section `[mesh]` of a scene: tissue on the surface of a triangle mesh, and its rest shape.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::sync::{Arc, OnceLock};

use glam::{DQuat, DVec3};
use palpate_geometry::decimate::MIN_VERTICES;
use palpate_geometry::surface::{Surface, SurfaceDisc};
use palpate_geometry::work::spend;
use palpate_geometry::{Group, TriangleMesh};

use super::eigenvalue::largest_of_laplacian;
use super::shown::{Shown, Simulated};
use super::source::{Files, SourceMesh};
use super::springs::Springs;
use super::volume::{Swelling, Volume};
use crate::limits::Limits;
use crate::memory;
use crate::scene::action_check::physical;
use crate::scene::body::{BodyKind, KindOfBody, StiffnessBound, strain_of};
use crate::scene::graph::{MeshGraph, MeshSpring};
use crate::scene::profile::Poke;
use crate::scene::stepping::Integrator;
use crate::scene::toml_document::{Fields, Item};
use crate::shape::{Deepest, Extent, PointId, PointName, RestShape, ShownShape};
use palpate_refusal::{Reason, Refusal, Result, did_you_mean, excerpt, finite, number, positive};

mod indentation;
mod tool_depth;

/// The largest radius of a tip, in edge lengths.
const MAX_TIP_EDGES: f64 = 32.0;

/// A triangle mesh with a mass point at each vertex and a spring along each edge. [`Mesh::new`],
/// [`Mesh::uneven`] and [`Mesh::of`] create it; they compute `stiffest`, which depends on the other fields, so
/// don't change those alone.
#[derive(Debug, Clone, PartialEq)]
pub struct Mesh {
    /// The reference mass, kg: the mass of each point, unless `differences` has others; then, for a material,
    /// that of a vertex of mean area.
    pub point_mass_kg: f64,
    /// k of the bending springs relative to k of the edge that they cross, 0 to 10 in scenes; 0 without such
    /// springs. A bending spring joins the two vertices opposite an edge.
    pub bending: f64,
    /// Where the points rest, how they are joined, and which are fixed.
    pub shape: Arc<MeshShape>,
    /// How the points and springs differ from the reference values; empty lists if they don't.
    pub differences: Arc<PerNodeFactors>,
    /// How they differ without inclusions ([`Inclusion::put_into`](super::material::Inclusion::put_into)).
    pub(super) own_differences: Arc<PerNodeFactors>,
    /// An upper bound of the stiffness of the springs, which limits the substep, and the vertex where it is
    /// largest.
    pub stiffest: StiffnessBound,
    /// The enclosed volume, if it resists changes (section `[volume]`, [`Mesh::enclosing`]); otherwise `None`.
    pub volume: Option<Arc<Volume>>,
    /// Whether a movable point has no anchor, whatever K″ is: then nothing bounds how far a small force moves it.
    pub(super) has_free_point: bool,
}

/// Masses and stiffnesses of single points and springs, relative to the reference values of the scene. A list
/// is empty if all of its points or springs have the reference value. C/m is the same at every point.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PerNodeFactors {
    /// Mass of each point, by point number, divided by the reference mass.
    pub relative_mass: Vec<f64>,
    /// K″/m of each point, by point number, divided by the reference value, minus 1.
    pub extra_anchor: Vec<f64>,
    /// k of each edge divided by the reference k, in the order of [`MeshShape::edges`].
    pub edges: Vec<f64>,
    /// k of each bending spring divided by `bending` times the reference k, in the order of
    /// [`MeshShape::opposite`].
    pub bending: Vec<f64>,
}

/// The rest shape of a mesh. Point n is vertex n of the file, unless the simulated mesh is not the mesh of the
/// file ([`MeshShape::shown`]); numbers here are those of the simulated mesh, places are in m in the frame of
/// the file.
#[derive(Debug, PartialEq)]
pub struct MeshShape {
    vertices_m: Vec<DVec3>,
    triangles: Vec<[u32; 3]>,
    normals: Vec<DVec3>,
    /// The two vertices of each edge, ascending; edges ascending.
    edges: Vec<[u32; 2]>,
    /// The two vertices opposite each edge that has two triangles, ascending. `crossed` has that edge.
    opposite: Vec<[u32; 2]>,
    crossed: Vec<[u32; 2]>,
    neighbours: Neighbours,
    is_fixed: Vec<bool>,
    on_rim: Vec<bool>,
    edge_m: f64,
    extent: Extent,
    top_m: DVec3,
    cells: Cells,
    surface: OnceLock<Surface>,
    told: MeshMetadata,
    /// The mesh of the file, if the simulated one is coarser or has joined vertices.
    shown: Option<Shown>,
}

/// Facts about a mesh that clients receive and the simulation does not need; from [`MeshShape::told`].
/// `default()` if the shape was made without a scene.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MeshMetadata {
    /// The vertices that never move, as the scene specifies them; [`RestShape::is_fixed`] answers for a single
    /// vertex.
    pub fixed: FixedVertices,
    /// Texture coordinates (u, v) of each simulated vertex, if the file has them; at a seam, those of one side.
    pub uv: Option<Vec<[f32; 2]>>,
    /// Named groups of vertices of the simulated mesh, in the order of the file; empty if it has none.
    pub groups: Vec<Group>,
    /// What was done with the mesh of the file, and doubts about it, as sentences for the user; empty if there
    /// are none.
    pub findings: Vec<String>,
}

impl Mesh {
    /// Message of the refusal of a point mass beside a material ([`Reason::WrongKind`]).
    pub const WEIGHED: &str = "does not go with [material], which says what a point weighs";

    /// Message of the refusal of shear springs ([`Reason::WrongKind`]).
    pub const NO_SHEAR: &str = "is for sheets: the edges of a mesh resist shear as well";

    /// Creates a tissue on a mesh, m, with equal springs along its edges, without bending springs, volume and
    /// shown mesh. `point_mass_kg` is the mass of each point, kg, which is not checked.
    ///
    /// # Errors
    /// Refuses every mesh that [`MeshShape::new`] refuses.
    pub fn of(mesh: TriangleMesh, point_mass_kg: f64, fixed: FixedVertices) -> Result<Self> {
        Self::simulating(Simulated { mesh, shown: None, findings: Vec::new() }, point_mass_kg, fixed)
    }

    /// Creates a tissue on a simulated mesh, for which the mesh of the file may be shown. It has equal springs
    /// along its edges, no bending springs and no volume. `point_mass_kg` is the mass of each point, kg, which
    /// is not checked. A ball of `fixed` without a vertex becomes a finding ([`MeshMetadata::findings`]).
    ///
    /// # Errors
    /// Refuses every mesh that [`MeshShape::new`] refuses.
    pub fn simulating(simulated: Simulated, point_mass_kg: f64, fixed: FixedVertices) -> Result<Self> {
        let Simulated { mesh, shown, mut findings } = simulated;
        let balls = if let FixedVertices::Balls(balls) = &fixed { balls.as_slice() } else { &[] };
        let mut is_empty = vec![true; balls.len()];
        let uv = mesh.uv.as_ref().map(|_| {
            let mut of_vertex = vec![[0.0; 2]; mesh.vertices_m.len()];
            mesh.write_vertex_uv(&mut of_vertex);
            of_vertex
        });
        let mut shape = MeshShape::new(mesh.vertices_m, mesh.triangles, |rim, place_m, vertex| match &fixed {
            FixedVertices::None => false,
            FixedVertices::Rim => rim,
            FixedVertices::Group(group) => group.vertices.binary_search(&vertex).is_ok(),
            FixedVertices::Balls(balls) => {
                spend(balls.len());
                let mut is_within = false;
                for ((centre_m, radius_m), is_empty) in balls.iter().zip(&mut is_empty) {
                    let holds = place_m.distance(*centre_m) <= *radius_m;
                    *is_empty &= !holds;
                    is_within |= holds;
                }
                is_within
            }
        })?;
        let empty = (0..).zip(balls).zip(is_empty).filter(|(_, is_empty)| *is_empty).map(|(ball, _)| ball);
        findings.extend(empty.clone().take(EMPTY_BALLS_TOLD).map(|(number, ball)| shape.empty_ball(number, *ball)));
        match empty.count().saturating_sub(EMPTY_BALLS_TOLD) {
            0 => {}
            more => findings.push(format!("mesh.fixed: {more} more balls hold no vertex")),
        }
        shape.told = MeshMetadata { fixed, uv, groups: mesh.groups, findings };
        shape.shown = shown;
        Ok(Mesh::new(point_mass_kg, 0.0, Arc::new(shape)))
    }

    /// Creates a tissue without volume in which all points, of mass `point_mass_kg`, kg, and all edges are
    /// alike. `bending` is the k of the bending springs relative to that of the edges; 0 creates none. It
    /// bounds the stiffness, which takes a while on a large mesh.
    pub fn new(point_mass_kg: f64, bending: f64, shape: Arc<MeshShape>) -> Self {
        Self::uneven(point_mass_kg, bending, shape, PerNodeFactors::default())
    }

    /// Creates a tissue without volume whose points and springs differ by the factors in `differences`, each
    /// list of which must be empty or have its full length (a missing factor counts as that of the reference).
    /// `point_mass_kg` is the reference mass, kg; `bending` is the k of the bending springs relative to that of
    /// the edges; 0 creates none. Nothing is checked.
    pub fn uneven(point_mass_kg: f64, bending: f64, shape: Arc<MeshShape>, differences: PerNodeFactors) -> Self {
        let stiffest = StiffnessBound { bound: 0.0, vertex: 0, usual: 0.0, extra_anchor: 0.0 };
        let differences = Arc::new(differences);
        let is_free =
            |(vertex, extra): (usize, &f64)| *extra <= -1.0 && shape.is_used(vertex) && !shape.is_fixed[vertex];
        let has_free_point = differences.extra_anchor.iter().enumerate().any(is_free);
        let own_differences = differences.clone();
        let mut mesh = Mesh {
            point_mass_kg,
            bending,
            shape,
            differences,
            own_differences,
            stiffest,
            volume: None,
            has_free_point,
        };
        mesh.stiffest = mesh.find_stiffest();
        mesh
    }

    /// Returns whether inclusions are applied to its springs.
    pub(super) fn has_inclusions(&self) -> bool {
        !Arc::ptr_eq(&self.differences, &self.own_differences)
    }

    /// Adds the volume that the mesh encloses, from its rest shape and its present springs and masses.
    ///
    /// # Errors
    /// Refuses a mesh with a hole, with triangles of inconsistent orientation, of several parts, or flat
    /// ([`Reason::WrongKind`], field `volume`).
    pub fn enclosing(mut self) -> Result<Self> {
        let volume = Volume::of(&self.shape.vertices_m, &self.shape.triangles)?;
        let volume = volume.among(self.springs(), |vertex| self.relative_mass(PointId::new(vertex)));
        self.volume = Some(Arc::new(volume));
        Ok(self)
    }

    /// Returns K″/m of a point divided by the reference value, minus 1; 0 without factors, or for a point that
    /// the mesh does not have.
    pub fn extra_anchor(&self, point: PointId) -> f64 {
        self.differences.extra_anchor.get(point.index()).copied().unwrap_or(0.0)
    }

    /// Returns every spring as its two ends, ascending, and its k divided by the reference k: first edges, in
    /// the order of [`MeshShape::edges`], then bending springs, in that of [`MeshShape::opposite`] (none if
    /// `bending` is 0).
    pub fn springs(&self) -> impl Iterator<Item = ([u32; 2], f64)> + '_ {
        let (shape, part) = (&self.shape, self.bending);
        let PerNodeFactors { edges, bending: bending_factors, .. } = &*self.differences;
        let of = |factors: &[f64], which: usize| factors.get(which).copied().unwrap_or(1.0);
        let bending: &[[u32; 2]] = if part > 0.0 { &shape.opposite } else { &[] };
        let along = shape.edges.iter().enumerate().map(move |(which, ends)| (*ends, of(edges, which)));
        along.chain(bending.iter().enumerate().map(move |(which, ends)| (*ends, part * of(bending_factors, which))))
    }

    /// Finds an upper bound of the stiffness and the vertex where it is largest.
    ///
    /// A spring along n contributes at most k·I to the stiffness matrix under any deformation
    /// (`scheme::stability`), so the matrix is at most the weighted Laplacian of the graph. Divided by the
    /// masses, its largest eigenvalue is at most the largest of
    ///
    /// w_i + w_j − Σ min(k_il/m_i, k_jl/m_j) over the common neighbours l of i and j,  w_i = Σ k_il/m_i,
    ///
    /// over all springs i–j (Das and Bapat, A sharp upper bound on the largest Laplacian eigenvalue of weighted
    /// graphs, 2005, for masses of 1). Proof: take the spring with the largest difference d = x_i − x_j of an
    /// eigenvector: λ·d = Σ k_il/m_i·(x_i − x_l) + Σ k_jl/m_j·(x_l − x_j). No difference is above d, and the
    /// two differences of a common neighbour add up to d. On a mesh of equal triangles this bound is 10 k/m;
    /// the true value is 9 k/m, and Gershgorin's bound is 12 k/m. The vertex comes from this bound; the method
    /// of Lanczos then gives a closer bound.
    fn find_stiffest(&self) -> StiffnessBound {
        let count = self.shape.vertices_m.len();
        let mass = |vertex: u32| self.relative_mass(PointId::new(vertex as usize));
        let mut around: Vec<Vec<(u32, f64)>> = vec![Vec::new(); count];
        for ([a, b], k) in self.springs() {
            around[a as usize].push((b, k / mass(a)));
            around[b as usize].push((a, k / mass(b)));
        }
        for of_vertex in &mut around {
            of_vertex.sort_unstable_by_key(|(other, _)| *other);
            // An edge and a spring of bending may join the same two vertices.
            of_vertex.dedup_by(|next, kept| {
                let same = next.0 == kept.0;
                kept.1 += if same { next.1 } else { 0.0 };
                same
            });
        }
        let weight: Vec<f64> = around.iter().map(|of_vertex| of_vertex.iter().map(|(_, k)| k).sum()).collect();
        let extra_anchor = self.differences.extra_anchor.iter().copied().fold(0.0, f64::max);
        let mut stiffest = StiffnessBound { bound: 0.0, vertex: 0, usual: 0.0, extra_anchor };
        let mut bounds = Vec::new();
        for ([a, b], _) in self.springs() {
            let [mut few, mut many] = [a, b].map(|end| around[end as usize].as_slice());
            if few.len() > many.len() {
                (few, many) = (many, few);
            }
            // A vertex may have very many neighbours, each of which has it as its own.
            spend(1 + few.len());
            let mut common = 0.0;
            for (other, of_one) in few {
                if let Ok(found) = many.binary_search_by_key(other, |(other, _)| *other) {
                    common += of_one.min(many[found].1);
                }
            }
            let [of_a, of_b] = [a, b].map(|end| weight[end as usize]);
            let bound = of_a + of_b - common;
            bounds.push(bound);
            if bound > stiffest.bound {
                stiffest = StiffnessBound { bound, vertex: if of_a >= of_b { a } else { b }, ..stiffest };
            }
        }
        if !bounds.is_empty() {
            let half = bounds.len() / 2;
            let usual = *bounds.select_nth_unstable_by(half, f64::total_cmp).1;
            stiffest.usual = usual;
            let closer = largest_of_laplacian(&around, mass);
            if closer > 0.0 && closer < stiffest.bound {
                // By as much less as is true of the largest.
                stiffest.usual *= closer / stiffest.bound;
                stiffest.bound = closer;
            }
        }
        stiffest
    }

    /// Returns a part of at most `most` vertices around the one that moves most in the fastest vibration,
    /// turned so that its normal is along z. Also returns three of its points: that vertex, one about half way
    /// to the rim of the part, and one at the rim.
    #[allow(clippy::cast_possible_truncation)]
    fn part_around_fastest(&self, most: usize) -> (Self, [PointId; 3]) {
        let shape = &self.shape;
        let (first, count) = (self.stiffest.vertex as usize, shape.vertices_m.len());
        let mut number_of = vec![u32::MAX; count];
        let mut found = vec![first];
        number_of[first] = 0;
        let mut next = 0;
        while next < found.len() && found.len() < most {
            for vertex in shape.neighbours.of(found[next]) {
                if found.len() < most && number_of[*vertex as usize] == u32::MAX {
                    number_of[*vertex as usize] = found.len() as u32;
                    found.push(*vertex as usize);
                }
            }
            next += 1;
        }
        let turn = DQuat::from_rotation_arc(shape.normals[first], DVec3::Z);
        let vertices_m =
            found.iter().map(|vertex| turn * (shape.vertices_m[*vertex] - shape.vertices_m[first])).collect();
        let numbered = shape.triangles.iter().map(|triangle| triangle.map(|vertex| number_of[vertex as usize]));
        let triangles: Vec<_> = numbered.filter(|triangle| triangle.iter().all(|vertex| *vertex != u32::MAX)).collect();
        let is_fixed = |_: bool, _: DVec3, vertex: u32| vertex != 0 && shape.is_fixed[found[vertex as usize]];
        let looked_at = [0, found.len() / 4, found.len() - 1].map(PointId::new);
        match MeshShape::new(vertices_m, triangles, is_fixed) {
            Ok(part) => {
                let known = &self.differences;
                let of_points =
                    |list: &[f64]| if list.is_empty() { vec![] } else { found.iter().map(|of| list[*of]).collect() };
                let of_springs = |list: &[f64], all: &[[u32; 2]], ends: &[[u32; 2]]| -> Vec<f64> {
                    let of = |ends: &[u32; 2]| {
                        let [a, b] = ends.map(|end| found[end as usize] as u32);
                        all.binary_search(&[a.min(b), a.max(b)]).map_or(1.0, |at| list[at])
                    };
                    if list.is_empty() { vec![] } else { ends.iter().map(of).collect() }
                };
                let differences = PerNodeFactors {
                    relative_mass: of_points(&known.relative_mass),
                    extra_anchor: of_points(&known.extra_anchor),
                    edges: of_springs(&known.edges, &shape.edges, &part.edges),
                    bending: of_springs(&known.bending, &shape.opposite, &part.opposite),
                };
                let mut part = Mesh::uneven(self.point_mass_kg, self.bending, Arc::new(part), differences);
                part.volume = self.volume.as_ref().and_then(|volume| {
                    let areas_m2 = found.iter().map(|vertex| turn * volume.areas_m2[*vertex]).collect();
                    volume.part(areas_m2, |vertex| part.relative_mass(PointId::new(vertex))).map(Arc::new)
                });
                (part, looked_at)
            }
            // Parts of a mesh that is sound are sound.
            Err(_) => (self.clone(), [PointId::new(first); 3]),
        }
    }
}

impl KindOfBody for Mesh {
    const SECTION: &'static str = "mesh";

    /// With a material, the edges are flipped to Delaunay.
    fn read(fields: &mut Fields<'_>, files: Files<'_>, of_material: bool, limits: &Limits) -> Result<Self> {
        let (source_mesh, source) = files.mesh(fields, limits)?;
        let point_mass_kg = match fields.item("point_mass_kg") {
            Some(mass) if of_material => {
                return Err(mass.refuse(Reason::WrongKind, Self::WEIGHED));
            }
            Some(mass) => mass.number()?,
            None if of_material => 1.0,
            None => fields.required_number("point_mass_kg")?,
        };
        let vertices = match fields.item("vertices") {
            Some(item) => {
                let least = |vertices: &usize| *vertices >= MIN_VERTICES;
                let vertices = usize::try_from(item.whole()?).ok().filter(least);
                let message = format!("must be at least {MIN_VERTICES}");
                Some(vertices.ok_or_else(|| item.refuse(Reason::OutOfRange, message))?)
            }
            None => None,
        };
        let simulated = match source_mesh {
            SourceMesh::Made(mesh) => Simulated::made(mesh, vertices, of_material),
            SourceMesh::Read(mesh) => Simulated::of(mesh, vertices, of_material).map_err(|refusal| {
                let name = source.as_text().map_or_else(String::new, |file| format!("{file}: "));
                source.refuse(refusal.reason, format!("{name}{}", refusal.message))
            })?,
        };
        let fixed =
            fields.item("fixed").map_or(Ok(FixedVertices::None), |item| FixedVertices::read(&item, &simulated.mesh))?;
        let made = Self::simulating(simulated, point_mass_kg, fixed);
        made.map_err(|refusal| source.refuse(refusal.reason, refusal.message))
    }

    /// Reads springs along the edges and, if wanted, bending springs.
    fn read_springs(&mut self, fields: &mut Fields<'_>) -> Result<Springs> {
        let stiffness_n_per_m = fields.required_number("stiffness_n_per_m")?;
        if let Some(shear) = fields.item("shear_stiffness_n_per_m") {
            return Err(shear.refuse(Reason::WrongKind, Self::NO_SHEAR));
        }
        if let Some(item) = fields.item("bending") {
            *self = Mesh::new(self.point_mass_kg, read_bending(&item)?, self.shape.clone());
        }
        let pretension_n_per_m = fields.number("pretension_n_per_m")?.unwrap_or(0.0);
        Ok(Springs { pretension_n_per_m, ..Springs::alike(stiffness_n_per_m) })
    }

    fn part(&self, side: usize) -> (Self, [PointId; 3]) {
        self.part_around_fastest(side * side)
    }
}

impl BodyKind for Mesh {
    fn section(&self) -> &'static str {
        Self::SECTION
    }

    /// Returns 2·A·T₀/Σ k·L²: the mean of a tension that is the same in all directions of a surface of area A follows from the virial
    /// of its springs, 2·A·T₀ = Σ F·L with F = k·L·ε.
    fn prestrain(&self, springs: &Springs) -> f64 {
        if springs.pretension_n_per_m == 0.0 {
            return 0.0;
        }
        let MeshShape { vertices_m, triangles, .. } = &*self.shape;
        let place_m = |vertex: u32| vertices_m[vertex as usize];
        let doubled_m2 = |[a, b, c]: &[u32; 3]| (place_m(*b) - place_m(*a)).cross(place_m(*c) - place_m(*a)).length();
        let doubled_m2: f64 = triangles.iter().map(doubled_m2).sum();
        let virial: f64 = self.springs().map(|([a, b], k)| k * place_m(a).distance_squared(place_m(b))).sum();
        strain_of(springs, springs.stiffness_n_per_m * virial / doubled_m2)
    }

    fn points_key(&self) -> &'static str {
        "mesh.file"
    }

    fn mesh(&self) -> Option<TriangleMesh> {
        if let Some(shown) = &self.shape.shown {
            return Some(shown.mesh.clone());
        }
        let MeshShape { vertices_m, triangles, told, .. } = &*self.shape;
        let corners = |triangle: &[u32; 3], uv: &[[f32; 2]]| triangle.map(|vertex| uv[vertex as usize]);
        Some(TriangleMesh {
            vertices_m: vertices_m.clone(),
            triangles: triangles.clone(),
            uv: told.uv.as_ref().map(|uv| triangles.iter().map(|of| corners(of, uv)).collect()),
            groups: told.groups.clone(),
            regions: Vec::new(),
        })
    }

    fn graph(&self) -> MeshGraph {
        let springs = self.springs();
        MeshGraph {
            rest_m: self.shape.vertices_m.clone(),
            springs: springs.map(|(ends, stiffness_n_per_m)| MeshSpring { ends, stiffness_n_per_m }).collect(),
            spacing_m: self.shape.edge_m,
            relative_mass: self.differences.relative_mass.clone(),
            extra_anchor: self.differences.extra_anchor.clone(),
        }
    }

    /// Adds bounds and factors, the points in the order of the mesh and of memory, and the springs.
    fn identify(&self, order: &[u32], add: &mut dyn FnMut(&[u8])) {
        add(b"mesh");
        let mut numbers = |values: &[f64]| {
            add(&(values.len() as u64).to_le_bytes());
            values.iter().for_each(|value| add(&value.to_bits().to_le_bytes()));
        };
        numbers(&[self.stiffest.bound, self.stiffest.usual]);
        numbers(&self.differences.relative_mass);
        numbers(&self.differences.extra_anchor);
        self.shape.vertices_m.iter().for_each(|vertex_m| numbers(&vertex_m.to_array()));
        for corner in self.shape.triangles.iter().flatten().chain(order) {
            add(&corner.to_le_bytes());
        }
        for (ends, stiffness_n_per_m) in self.springs() {
            ends.iter().for_each(|end| add(&end.to_le_bytes()));
            add(&stiffness_n_per_m.to_bits().to_le_bytes());
        }
    }

    fn unit_hint(&self) -> &'static str {
        "mesh.unit says which unit its file is in"
    }

    fn shape(&self) -> &dyn RestShape {
        &*self.shape
    }

    fn shared_shape(&self) -> Arc<dyn RestShape> {
        self.shape.clone()
    }

    fn point_mass_kg(&self) -> f64 {
        self.point_mass_kg
    }

    /// Returns the total mass of the points that have an edge, kg, fixed ones included.
    fn mass_kg(&self) -> f64 {
        let used = (0..self.shape.vertices_m.len()).filter(|vertex| self.shape.is_used(*vertex));
        self.point_mass_kg * used.map(|vertex| self.relative_mass(PointId::new(vertex))).sum::<f64>()
    }

    fn relative_mass(&self, point: PointId) -> f64 {
        self.differences.relative_mass.get(point.index()).copied().unwrap_or(1.0)
    }

    fn relative_anchor_stiffness(&self, point: PointId) -> f64 {
        self.relative_mass(point) * (1.0 + self.extra_anchor(point))
    }

    /// Returns 0 if a movable point has no anchor: the springs to its neighbours resist a movement across them only as
    /// it stretches them.
    fn restoring_n_per_m(&self, _springs: &Springs, anchor_n_per_m: f64) -> f64 {
        if self.has_free_point { 0.0 } else { anchor_n_per_m }
    }

    fn volume(&self) -> Option<&Volume> {
        self.volume.as_deref()
    }

    fn relative_cost(&self) -> f64 {
        2.8
    }

    fn indentation_m(&self, springs: &Springs, anchor_n_per_m: f64, volume_pa: f64, poke: &Poke) -> Option<f64> {
        indentation::depth_m(self, springs, anchor_n_per_m, volume_pa, poke)
    }

    fn thickness_m(&self, point: PointId) -> Option<f64> {
        indentation::thickness_m(self, point)
    }

    /// A rehearsal pushes the vertex that vibrates fastest; all others have smaller errors. (56 random meshes at 5
    /// tolerances: at most 1.4 times, half of them 0.05 times.)
    fn rehearsal_margin(&self, _: Integrator) -> f64 {
        2.0
    }

    fn spring_bound_n_per_m(&self, springs: &Springs, anchor_n_per_m: f64) -> f64 {
        springs.stiffness_n_per_m * self.stiffest.bound + anchor_n_per_m * self.stiffest.extra_anchor
    }

    fn stiffness_bound_n_per_m(&self, springs: &Springs, anchor_n_per_m: f64, volume_pa: f64) -> f64 {
        let StiffnessBound { bound, extra_anchor, .. } = self.stiffest;
        let Some(volume) = &self.volume else { return self.spring_bound_n_per_m(springs, anchor_n_per_m) };
        let elastic = volume.swelling.bound_n_per_m(volume_pa, bound, springs.stiffness_n_per_m);
        elastic + anchor_n_per_m * extra_anchor
    }

    fn fastest(&self) -> Option<StiffnessBound> {
        Some(self.stiffest)
    }

    fn volume_is_fastest(&self, springs: &Springs, volume_pa: f64) -> bool {
        let fastest = |Swelling { by_pressure_m, by_springs, .. }: Swelling| {
            let k = springs.stiffness_n_per_m;
            volume_pa * by_pressure_m + k * by_springs > k * self.stiffest.bound
        };
        self.volume.as_ref().is_some_and(|volume| fastest(volume.swelling))
    }

    /// Returns warnings about the mesh for the user, as sentences: the findings ([`MeshMetadata::findings`]),
    /// fixed vertices that fix nothing or everything, and a vertex that vibrates much faster than others.
    fn warnings(&self) -> Vec<String> {
        let shape = &self.shape;
        let mut warnings = shape.told.findings.clone();
        if shape.told.fixed == FixedVertices::Rim && shape.is_closed() {
            warnings.push("mesh.fixed: the mesh is closed and has no rim: \"rim\" fixes nothing".to_owned());
        }
        if shape.told.fixed != FixedVertices::None && shape.is_fixed.iter().all(|fixed| *fixed) {
            warnings.push("mesh.fixed: every vertex is fixed: nothing moves".to_owned());
        }
        if self.has_fast_point() {
            let point = PointId::new(self.stiffest.vertex as usize);
            warnings.push(format!(
                "mesh: {} at {:.4} m, with its short edges or small triangles, vibrates {:.1} times as fast as half of the mesh: \
                 without such vertices a step would take fewer substeps; `palpate check` finds out which mesh.vertices leaves \
                 them out",
                shape.name(point),
                shape.rest_m(point),
                self.stiffest.fastest_ratio(),
            ));
        }
        warnings
    }

    /// Counts places, neighbours, and each spring from both of its ends, as the scene has it and as the kernel
    /// reads it.
    fn table_bytes(&self) -> u64 {
        const OF_A_VERTEX: usize = 256;
        const OF_A_SPRING: usize = 192;
        const ENCLOSING: usize = 104;
        let (points, shape) = (self.shape.point_count(), &self.shape);
        let springs = shape.edges.len() + shape.opposite.len();
        let shown = shape.shown().map_or(0, |shown| shown.places.len());
        let enclosing = if self.volume.is_some() { ENCLOSING * points } else { 0 };
        (OF_A_VERTEX * (points + shown) + OF_A_SPRING * springs + enclosing) as u64
    }

    fn check(&self, limits: &Limits) -> Result<()> {
        let count = self.shape.point_count();
        if count > limits.points {
            let message = format!("has {count} vertices, above the limit of {} points in all", limits.points);
            return Err(Refusal::new(Reason::TooLarge, self.points_key(), message));
        }
        physical("mesh.point_mass_kg", positive("mesh.point_mass_kg", self.point_mass_kg)?)?;
        physical("mesh.unit", self.shape.edge_m)?;
        Ok(())
    }
}

/// Reads `springs.bending` of a mesh: k of the bending springs relative to that of the edges.
pub(super) fn read_bending(item: &Item<'_>) -> Result<f64> {
    let part = item.flag().map(|flag| if flag { 1.0 } else { 0.0 }).or_else(|_| item.number())?;
    number("springs.bending", part, "from 0 to 10", |v| (0.0..=10.0).contains(&v))
}

/// Smallest distance from the surface at rest at which a new tool begins, m.
const APPROACH_M: f64 = 0.002;

/// Number of empty balls of `mesh.fixed` with a message each; one message counts the others.
const EMPTY_BALLS_TOLD: usize = 4;

/// The vertices of a mesh that never move, as a scene specifies them (`mesh.fixed`).
#[derive(Debug, Clone, Default, PartialEq)]
pub enum FixedVertices {
    /// No vertex.
    #[default]
    None,
    /// The vertices on edges with a single triangle; none if the mesh is closed.
    Rim,
    /// The vertices of a group of the file, by numbers of the simulated mesh, ascending.
    Group(Group),
    /// The vertices within balls, each given by centre and radius, m, the surface of the ball included.
    Balls(Vec<(DVec3, f64)>),
}

impl FixedVertices {
    fn read(item: &Item<'_>, mesh: &TriangleMesh) -> Result<Self> {
        const EXPECTED: &str = "\"none\", \"rim\", { group = \"…\" } or a list of balls { centre_m, radius_m }";
        match item.as_text() {
            Some("none") => return Ok(FixedVertices::None),
            Some("rim") => return Ok(FixedVertices::Rim),
            Some(_) => return Err(item.wrong(EXPECTED)),
            None => {}
        }
        if let Ok(list) = item.list() {
            let ball = |item: &Item<'_>| {
                item.table(|fields| {
                    let centre_m = fields.required("centre_m")?.vector()?;
                    Ok((centre_m, positive(&fields.path("radius_m"), fields.required_number("radius_m")?)?))
                })
            };
            return Ok(FixedVertices::Balls(list.iter().map(ball).collect::<Result<_>>()?));
        }
        item.table(|fields| {
            let group = fields.required("group")?;
            let found = FixedVertices::group("", &group.text()?, mesh);
            found.map_err(|refusal| group.refuse(refusal.reason, refusal.message))
        })
    }

    /// Returns the vertices of the group `name` of a mesh as fixed vertices.
    ///
    /// # Errors
    /// Refuses a name that no group has ([`Reason::WrongKind`]); `field` is the key that the refusal gives.
    pub fn group(field: &str, name: &str, mesh: &TriangleMesh) -> Result<Self> {
        group_named(field, name, &mesh.groups).map(|group| FixedVertices::Group(group.clone()))
    }
}

/// Returns the group `name`.
///
/// # Errors
/// Refuses a name that no group has; `field` is the key that the refusal gives.
pub(super) fn group_named<'g>(field: &str, name: &str, groups: &'g [Group]) -> Result<&'g Group> {
    let names = || groups.iter().map(|group| group.name.as_str());
    groups
        .iter()
        .find(|group| group.name == name)
        .ok_or_else(|| unknown_name(field, "the mesh has no group", name, names))
}

/// Returns the refusal of a name that is none of `names`; `lacks` says what there is none of.
pub(super) fn unknown_name<'n, N: Iterator<Item = &'n str>>(
    field: &str,
    lacks: &str,
    name: &str,
    names: impl Fn() -> N,
) -> Refusal {
    let meant = did_you_mean(name, names());
    let first: Vec<&str> = names().take(8).collect();
    let all = if first.is_empty() { "it has none".to_owned() } else { format!("it has {}", first.join(", ")) };
    Refusal::new(Reason::WrongKind, field, format!("{lacks} `{}`{meant}; {all}", excerpt(name)))
}

impl MeshShape {
    /// Creates the shape from vertices, m, and triangles, counterclockwise seen from outside. `is_fixed`
    /// decides whether a vertex never moves; it is called once for each, ascending. Its arguments are whether
    /// the vertex is on a rim, where it rests, m, and its number. The shape has no metadata
    /// ([`MeshShape::told`]) and no shown mesh.
    ///
    /// # Errors
    /// Refuses, with the field `mesh`, a mesh without a triangle, with an edge of length 0, with an edge of
    /// more than two triangles, with a vertex number beyond the last, and with a place that is not finite
    /// ([`Reason::Unreadable`]); and one so large that its mean edge is not finite ([`Reason::NotFinite`]).
    pub fn new(
        vertices_m: Vec<DVec3>,
        triangles: Vec<[u32; 3]>,
        is_fixed: impl FnMut(bool, DVec3, u32) -> bool,
    ) -> Result<Self> {
        Self::braced(vertices_m, triangles, &[], is_fixed)
    }

    /// Creates the shape as [`MeshShape::new`] does, with additional springs `braces` between other pairs of
    /// vertices, like those of edges; for example along both diagonals of a square. They count among
    /// [`MeshShape::edges`], each once. Without triangles, they suffice as edges. Panics if a brace names a
    /// vertex that is not there; a brace between places that coincide is not refused.
    ///
    /// # Errors
    /// Refuses every mesh that [`MeshShape::new`] refuses, except one with braces but no triangle.
    pub fn braced(
        vertices_m: Vec<DVec3>,
        triangles: Vec<[u32; 3]>,
        braces: &[[u32; 2]],
        mut is_fixed: impl FnMut(bool, DVec3, u32) -> bool,
    ) -> Result<Self> {
        let refuse = |message: String| Refusal::new(Reason::Unreadable, "mesh", message);
        if let Some(vertex) = vertices_m.iter().position(|place_m| !place_m.is_finite()) {
            return Err(refuse(format!("vertex {vertex} is not finite")));
        }
        let count = vertices_m.len();
        let is_out = |triangle: &[u32; 3]| triangle.iter().any(|vertex| *vertex as usize >= count);
        if let Some(which) = triangles.iter().position(is_out) {
            return Err(refuse(format!("triangle {which} names a vertex beyond the last of {count}")));
        }
        spend(32 * triangles.len());
        // Each side of each triangle, and the vertex opposite it.
        let mut sides: Vec<([u32; 2], u32)> = triangles
            .iter()
            .flat_map(|[a, b, c]| [([*a, *b], *c), ([*b, *c], *a), ([*c, *a], *b)])
            .map(|([a, b], opposite)| ([a.min(b), a.max(b)], opposite))
            .collect();
        sides.sort_unstable();
        let (mut edges, mut opposite, mut on_rim) = (Vec::new(), Vec::new(), vec![false; count]);
        for of_edge in sides.chunk_by(|a, b| a.0 == b.0) {
            let edge @ [a, b] = of_edge[0].0;
            let [from_m, to_m] = edge.map(|vertex| vertices_m[vertex as usize]);
            let length_m = from_m.distance(to_m);
            if length_m == 0.0 {
                return Err(refuse(format!("the edge between vertices {a} and {b} at {from_m:.6} m has no length")));
            }
            match of_edge {
                [_] => edge.iter().for_each(|vertex| on_rim[*vertex as usize] = true),
                [(_, c), (_, d)] => opposite.push(([*c.min(d), *c.max(d)], edge)),
                more => {
                    let message =
                        format!("the edge between vertices {a} and {b} at {from_m:.6} m has {} triangles", more.len());
                    return Err(refuse(message));
                }
            }
            edges.push(edge);
        }
        edges.extend(braces.iter().map(|[a, b]| [*a.min(b), *a.max(b)]));
        edges.sort_unstable();
        edges.dedup();
        if edges.is_empty() {
            return Err(refuse("has no triangle".to_owned()));
        }
        opposite.retain(|([c, d], _)| c != d);
        opposite.sort_unstable();
        opposite.dedup_by_key(|(ends, _)| *ends);
        let (opposite, crossed) = opposite.into_iter().unzip();
        let length_m = |[a, b]: &[u32; 2]| vertices_m[*a as usize].distance(vertices_m[*b as usize]);
        #[allow(clippy::cast_precision_loss)]
        let edge_m = edges.iter().map(length_m).sum::<f64>() / edges.len() as f64;
        finite("mesh", edge_m)?;
        let mut normals = vec![DVec3::ZERO; count];
        for triangle in &triangles {
            let [a, b, c] = triangle.map(|vertex| vertices_m[vertex as usize]);
            let area = (b - a).cross(c - a);
            triangle.iter().for_each(|vertex| normals[*vertex as usize] += area);
        }
        normals.iter_mut().for_each(|normal| *normal = normal.try_normalize().unwrap_or(DVec3::Z));
        #[allow(clippy::cast_possible_truncation)]
        let is_fixed = (0..count).map(|vertex| is_fixed(on_rim[vertex], vertices_m[vertex], vertex as u32)).collect();
        let neighbours = Neighbours::new(count, &edges);
        let used = || (0..).zip(&vertices_m).filter(|(vertex, _)| !neighbours.of(*vertex as usize).is_empty());
        let extent = Extent::around(used().map(|(_, place_m)| *place_m));
        let cells = Cells::new(used(), extent, edge_m);
        let top_m = palpate_geometry::top::top_m(&vertices_m, &triangles, &normals, extent.middle_m());
        Ok(MeshShape {
            vertices_m,
            triangles,
            normals,
            edges,
            opposite,
            crossed,
            neighbours,
            is_fixed,
            on_rim,
            edge_m,
            extent,
            top_m,
            cells,
            surface: OnceLock::new(),
            told: MeshMetadata::default(),
            shown: None,
        })
    }

    /// Returns the warning that a ball of `mesh.fixed` fixes nothing.
    fn empty_ball(&self, number: usize, (centre_m, radius_m): (DVec3, f64)) -> String {
        let nearest = self.nearest(centre_m);
        let off_m = self.rest_m(nearest).distance(centre_m);
        format!(
            "mesh.fixed[{number}]: no vertex is within {radius_m} m of {centre_m:.4} m, so this ball fixes nothing; the nearest, {}, \
             is {off_m:.4} m off",
            self.name(nearest)
        )
    }

    /// Returns the facts about the mesh that clients receive; empty unless the shape was made by
    /// [`Mesh::simulating`] or from a scene.
    pub fn told(&self) -> &MeshMetadata {
        &self.told
    }

    /// Returns the rest position of each vertex, m, by vertex number.
    pub fn vertices_m(&self) -> &[DVec3] {
        &self.vertices_m
    }

    /// Returns the triangles as three vertices each, counterclockwise seen from outside, in the order in which
    /// they were given.
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }

    /// Returns the triangles as a surface on which a tip can move. The first call builds it, which takes a
    /// while on a large mesh; calls of other threads wait for it.
    pub fn surface(&self) -> &Surface {
        self.surface.get_or_init(|| Surface::new(&self.vertices_m, &self.triangles))
    }

    /// Returns the two vertices of each edge, braces included, ascending; edges ascending, each once.
    pub fn edges(&self) -> &[[u32; 2]] {
        &self.edges
    }

    /// Returns the two vertices opposite each edge that has two triangles, ascending: the ends of the bending
    /// springs. Pairs are ascending, each once, also if several edges have the same.
    pub fn opposite(&self) -> &[[u32; 2]] {
        &self.opposite
    }

    /// Returns the edge that each bending spring crosses, as two vertices, ascending, in the order of
    /// [`MeshShape::opposite`].
    pub fn crossed(&self) -> &[[u32; 2]] {
        &self.crossed
    }

    /// Returns the unit normal at each vertex at rest, by vertex number, out of the tissue: the mean over its
    /// triangles, weighted by area; +z for a vertex without area.
    pub fn normals(&self) -> &[DVec3] {
        &self.normals
    }

    /// Returns whether a vertex has an edge. A vertex without one is not part of the tissue: size and mass do
    /// not count it, and it is never the nearest to a place. Panics if there is no such vertex.
    pub fn is_used(&self, vertex: usize) -> bool {
        !self.neighbours.of(vertex).is_empty()
    }

    /// Returns whether a vertex is on an edge with a single triangle. Panics if there is no such vertex.
    pub fn is_on_rim(&self, vertex: usize) -> bool {
        self.on_rim[vertex]
    }

    /// Returns how far each vertex is from the nearest of `members`, m; infinite where that is `most_m` or
    /// more. The nearest member passes from vertex to vertex along the edges, so that the work is bounded by
    /// the size of the mesh. Sometimes it finds a member that is farther away by a fraction of an edge.
    pub(super) fn away_m(&self, members: &[u32], most_m: f64) -> Vec<f64> {
        let count = self.vertices_m.len();
        let (mut away_m, mut is_done) = (vec![f64::INFINITY; count], vec![false; count]);
        // Distances are ordered as their bits.
        let mut waiting = BinaryHeap::new();
        for member in members {
            away_m[*member as usize] = 0.0;
            waiting.push(Reverse((0, *member, *member)));
        }
        while let Some(Reverse((_, vertex, member))) = waiting.pop() {
            if std::mem::replace(&mut is_done[vertex as usize], true) {
                continue;
            }
            spend(16 * self.neighbours.of(vertex as usize).len());
            for next in self.neighbours.of(vertex as usize) {
                let next_m = self.vertices_m[*next as usize].distance(self.vertices_m[member as usize]);
                let known_m = &mut away_m[*next as usize];
                if !is_done[*next as usize] && next_m < *known_m && next_m < most_m {
                    *known_m = next_m;
                    waiting.push(Reverse((next_m.to_bits(), *next, member)));
                }
            }
        }
        away_m
    }

    /// Returns whether every edge has two triangles; braces don't count.
    pub fn is_closed(&self) -> bool {
        !self.on_rim.contains(&true)
    }

    /// Returns the mesh of the file, if it is shown in place of the simulated mesh, because it has other
    /// vertices; otherwise `None`.
    pub fn shown(&self) -> Option<&Shown> {
        self.shown.as_ref()
    }
}

impl RestShape for MeshShape {
    fn describe(&self) -> String {
        let count = self.vertices_m.len();
        self.shown.as_ref().map_or_else(
            || format!("{count} vertices"),
            |shown| format!("{count} vertices for the {} of the file", shown.mesh.vertices_m.len()),
        )
    }

    fn point_count(&self) -> usize {
        self.vertices_m.len()
    }

    #[allow(clippy::cast_possible_truncation)]
    fn name(&self, point: PointId) -> PointName {
        PointName::Vertex(self.shown.as_ref().map_or(point.index() as u32, |shown| shown.names[point.index()]))
    }

    fn find(&self, field: &str, name: PointName) -> Result<PointId> {
        let count = self.shown.as_ref().map_or(self.vertices_m.len(), |shown| shown.nearest.len());
        match name {
            PointName::Vertex(vertex) if (vertex as usize) < count => {
                let nearest = self.shown.as_ref().map_or(vertex, |shown| shown.nearest[vertex as usize]);
                Ok(PointId::new(nearest as usize))
            }
            PointName::Vertex(_) => Err(Refusal::new(
                Reason::OffTissue,
                field,
                format!("{name} is not on the mesh, whose vertices are numbered from 0 to {}", count - 1),
            )),
            PointName::Point(_) => {
                let message = format!("{name} is a point of a sheet; a point of a mesh is the number of a vertex");
                Err(Refusal::new(Reason::WrongKind, field, message))
            }
        }
    }

    fn rest_m(&self, point: PointId) -> DVec3 {
        self.vertices_m[point.index()]
    }

    fn normal(&self, point: PointId) -> DVec3 {
        self.normals[point.index()]
    }

    fn is_fixed(&self, point: PointId) -> bool {
        self.is_fixed[point.index()]
    }

    fn neighbours(&self, point: PointId) -> Vec<PointId> {
        self.neighbours.of(point.index()).iter().map(|vertex| PointId::new(*vertex as usize)).collect()
    }

    fn nearest(&self, place_m: DVec3) -> PointId {
        PointId::new(self.cells.nearest(&self.vertices_m, place_m))
    }

    fn prepare_contact(&self) {
        self.surface();
    }

    fn approach_m(&self, place_m: DVec3, radius_m: f64, height_m: f64) -> Option<DVec3> {
        let surface = self.surface();
        let nearest = surface.nearest(place_m)?;
        let (at_m, outward) = (surface.at_m(&nearest), nearest.frame[0].cross(nearest.frame[1]));
        let side = surface.side((place_m - at_m).dot(outward), radius_m);
        // A tool beside a rim, or far enough off the surface, begins where it is.
        let begins_m = height_m + APPROACH_M;
        let is_off = (place_m - at_m).dot(side * outward) >= begins_m;
        Some(if is_off { place_m } else { at_m + begins_m * side * outward })
    }

    fn around(&self, place_m: DVec3, radius_m: f64) -> Vec<PointId> {
        self.cells.around(&self.vertices_m, place_m, radius_m).into_iter().map(PointId::new).collect()
    }

    fn extent(&self) -> Extent {
        self.extent
    }

    fn edge_m(&self) -> f64 {
        self.edge_m
    }

    fn top_m(&self) -> DVec3 {
        self.top_m
    }

    fn triangles(&self) -> Vec<[u32; 3]> {
        MeshShape::triangles(self).to_vec()
    }

    fn shown_surface(&self) -> Option<ShownShape<'_>> {
        Some(match &self.shown {
            None => ShownShape {
                vertices_m: &self.vertices_m,
                triangles: &self.triangles,
                groups: &self.told.groups,
                bound: &[],
                in_cells: &[],
            },
            Some(Shown { mesh, places, .. }) => ShownShape {
                vertices_m: &mesh.vertices_m,
                triangles: &mesh.triangles,
                groups: &mesh.groups,
                bound: places,
                in_cells: &[],
            },
        })
    }

    fn shown_uv(&self) -> Option<Vec<[f32; 2]>> {
        let Some(Shown { mesh, .. }) = &self.shown else { return self.told.uv.clone() };
        mesh.uv.as_ref().map(|_| {
            let mut of_vertex = memory::filled(mesh.vertices_m.len(), [0.0; 2], "the texture coordinates of a mesh");
            mesh.write_vertex_uv(&mut of_vertex);
            of_vertex
        })
    }

    fn deepest(&self, way_m: &[DVec3], radius_m: f64) -> Option<Deepest> {
        tool_depth::deepest(self.surface(), way_m, radius_m)
    }

    /// Returns at most 32 lengths of an edge: what a disc covers is looked up at each step.
    fn most_tip_radius_m(&self) -> (f64, &'static str) {
        let (edges_m, longest_m) = (MAX_TIP_EDGES * self.edge_m, self.longest_side_m());
        if edges_m < longest_m {
            (edges_m, "32 lengths of an edge")
        } else {
            (longest_m, "the longest side of the tissue")
        }
    }

    fn disc_work(&self, radius_m: f64) -> u64 {
        SurfaceDisc::crossings(radius_m, self.edge_m)
    }
}

/// The other ends of the edges at each vertex, ascending.
#[derive(Debug, PartialEq)]
struct Neighbours {
    /// Where each vertex's members begin; one more entry for the end.
    from: Vec<u32>,
    members: Vec<u32>,
}

impl Neighbours {
    #[allow(clippy::cast_possible_truncation)]
    fn new(count: usize, edges: &[[u32; 2]]) -> Self {
        let mut both: Vec<[u32; 2]> = edges.iter().flat_map(|[a, b]| [[*a, *b], [*b, *a]]).collect();
        both.sort_unstable();
        let mut from = vec![0; count + 1];
        both.iter().for_each(|[a, _]| from[*a as usize + 1] += 1);
        (0..count).for_each(|vertex| from[vertex + 1] += from[vertex]);
        Neighbours { from, members: both.into_iter().map(|[_, b]| b).collect() }
    }

    fn of(&self, vertex: usize) -> &[u32] {
        &self.members[self.from[vertex] as usize..self.from[vertex + 1] as usize]
    }
}

/// The vertices sorted into cells of space, to find those near a place.
#[derive(Debug, PartialEq)]
struct Cells {
    least_m: DVec3,
    most_m: DVec3,
    side_m: f64,
    counts: [usize; 3],
    /// Where each cell's members begin; one more entry for the end.
    from: Vec<u32>,
    members: Vec<u32>,
}

/// Largest number of cells per vertex. A mesh that is far larger than its edges gets larger cells.
const CELLS_PER_VERTEX: f64 = 4.0;

impl Cells {
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn new<'v>(
        vertices_m: impl Iterator<Item = (u32, &'v DVec3)> + Clone,
        Extent { least_m, most_m }: Extent,
        edge_m: f64,
    ) -> Self {
        let size_m = most_m - least_m;
        let most = CELLS_PER_VERTEX * vertices_m.clone().count() as f64 + 8.0;
        let mut side_m = edge_m;
        let cells = |side_m: f64| (size_m / side_m).floor() + 1.0;
        while cells(side_m).element_product() > most {
            side_m *= 1.25;
        }
        let counts = cells(side_m).to_array().map(|count| count as usize);
        let mut found = Cells { least_m, most_m, side_m, counts, from: Vec::new(), members: Vec::new() };
        let mut by_cell: Vec<(usize, u32)> =
            vertices_m.map(|(vertex, place_m)| (found.index(found.cell(*place_m)), vertex)).collect();
        by_cell.sort_unstable();
        found.from = vec![0; counts.iter().product::<usize>() + 1];
        by_cell.iter().for_each(|(cell, _)| found.from[cell + 1] += 1);
        (1..found.from.len()).for_each(|cell| found.from[cell] += found.from[cell - 1]);
        found.members = by_cell.into_iter().map(|(_, vertex)| vertex).collect();
        found
    }

    /// Returns the cell of a place within the extent.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn cell(&self, place_m: DVec3) -> [usize; 3] {
        let at = ((place_m - self.least_m) / self.side_m).to_array();
        std::array::from_fn(|axis| (at[axis] as usize).min(self.counts[axis] - 1))
    }

    fn index(&self, [i, j, k]: [usize; 3]) -> usize {
        (i * self.counts[1] + j) * self.counts[2] + k
    }

    /// Returns the vertices within a distance of a place, ascending.
    fn around(&self, vertices_m: &[DVec3], place_m: DVec3, radius_m: f64) -> Vec<usize> {
        let [from, to] = [place_m - radius_m, place_m + radius_m].map(|corner_m| self.cell(corner_m.max(self.least_m)));
        let mut found = Vec::new();
        for i in from[0]..=to[0] {
            for j in from[1]..=to[1] {
                for k in from[2]..=to[2] {
                    let cell = self.index([i, j, k]);
                    let members = &self.members[self.from[cell] as usize..self.from[cell + 1] as usize];
                    let is_within = |vertex: &usize| vertices_m[*vertex].distance(place_m) <= radius_m;
                    found.extend(members.iter().map(|vertex| *vertex as usize).filter(is_within));
                }
            }
        }
        found.sort_unstable();
        found
    }

    /// Returns the vertex nearest to a place; of several, the one with the lowest number.
    #[allow(clippy::cast_precision_loss)]
    fn nearest(&self, vertices_m: &[DVec3], place_m: DVec3) -> usize {
        let inside_m = place_m.clamp(self.least_m, self.most_m);
        let middle = self.cell(inside_m);
        let beyond = place_m.distance_squared(inside_m);
        let mut best = (f64::INFINITY, usize::MAX);
        let farthest = self.counts.iter().max().copied().unwrap_or(1);
        for ring in 0..=farthest {
            // No place of a ring is nearer: the extent is convex.
            let gap_m = ring.saturating_sub(1) as f64 * self.side_m;
            if beyond + gap_m * gap_m > best.0 {
                break;
            }
            let span =
                |axis: usize| middle[axis].saturating_sub(ring)..=(middle[axis] + ring).min(self.counts[axis] - 1);
            for i in span(0) {
                for j in span(1) {
                    for k in span(2) {
                        let cell = [i, j, k];
                        if (0..3).all(|axis| cell[axis].abs_diff(middle[axis]) < ring) {
                            continue;
                        }
                        let index = self.index(cell);
                        for vertex in &self.members[self.from[index] as usize..self.from[index + 1] as usize] {
                            let vertex = *vertex as usize;
                            let away = vertices_m[vertex].distance_squared(place_m);
                            if (away, vertex) < best {
                                best = (away, vertex);
                            }
                        }
                    }
                }
            }
        }
        best.1
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shape;

    #[test]
    fn the_stiffest_vertex_is_found_in_as_many_operations_as_there_are_springs_whatever_they_share() {
        // Two cones on one circle: each tip is in half of all triangles.
        let around = 20_000_u32;
        let mut vertices_m = vec![DVec3::new(0.0, 0.0, 0.05), DVec3::new(0.0, 0.0, -0.05)];
        vertices_m.extend((0..around).map(|k| {
            let angle = std::f64::consts::TAU * f64::from(k) / f64::from(around);
            0.1 * DVec3::new(libm::cos(angle), libm::sin(angle), 0.0)
        }));
        let of = |k: u32| {
            let (a, b) = (2 + k, 2 + (k + 1) % around);
            [[0, a, b], [1, b, a]]
        };
        let mesh =
            TriangleMesh { vertices_m, triangles: (0..around).flat_map(of).collect(), ..TriangleMesh::default() };
        let most = 1000 * mesh.triangles.len() as u64;
        let balls = vec![(DVec3::new(1.0, 1.0, 1.0), 0.1); 100];
        let made = palpate_geometry::work::within(&Arc::default(), most, || {
            Mesh::of(mesh.clone(), 1e-3, FixedVertices::Balls(balls))
        });
        assert_eq!(made.unwrap().unwrap().stiffest.vertex, 0);
        // An impossible amount of work is given up.
        let balls = vec![(DVec3::new(1.0, 1.0, 1.0), 0.1); 100_000];
        let made =
            palpate_geometry::work::within(&Arc::default(), most, || Mesh::of(mesh, 1e-3, FixedVertices::Balls(balls)));
        assert_eq!(made.map(|_| ()), Err(palpate_geometry::work::GivenUp::TooMuch(most)));
    }

    /// A tetrahedron and, apart from it, a square of two triangles.
    fn shape() -> MeshShape {
        let vertices_m = [
            [0.0, 0.0, 0.0],
            [0.1, 0.0, 0.0],
            [0.0, 0.1, 0.0],
            [0.0, 0.0, 0.1],
            [1.0, 0.0, 0.0],
            [1.1, 0.0, 0.0],
            [1.1, 0.1, 0.0],
            [1.0, 0.1, 0.0],
        ];
        let triangles = vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3], [4, 5, 6], [4, 6, 7]];
        MeshShape::new(vertices_m.map(DVec3::from_array).to_vec(), triangles, |rim, _, _| rim).unwrap()
    }

    #[test]
    fn a_mesh_knows_its_edges_its_rim_and_what_lies_opposite() {
        let shape = shape();
        assert_eq!(shape.edges().len(), 6 + 5);
        assert_eq!(shape.opposite().len(), 6 + 1);
        assert!(shape.opposite().contains(&[5, 7]));
        let fixed: Vec<bool> = shape::points(&shape).map(|point| shape.is_fixed(point)).collect();
        assert_eq!(fixed, [false, false, false, false, true, true, true, true]);
        assert_eq!(shape.neighbours(PointId::new(4)), [5, 6, 7].map(PointId::new));
        assert!(shape.normal(PointId::new(6)).distance(DVec3::Z) < 1e-12);
        assert!(shape.normal(PointId::new(0)).dot(DVec3::ONE) < 0.0, "outward");
    }

    #[test]
    fn the_nearest_vertex_is_that_of_a_search_through_all() {
        let mut dice = fastrand::Rng::with_seed(19);
        let place =
            |dice: &mut fastrand::Rng, size: f64| DVec3::from_array([(); 3].map(|()| size * (dice.f64() - 0.5)));
        let vertices_m: Vec<DVec3> = (0..400).map(|_| place(&mut dice, 1.0) * DVec3::new(1.0, 0.3, 0.01)).collect();
        let triangles = (0..133).map(|k| [3 * k, 3 * k + 1, 3 * k + 2]).chain([[397, 398, 399]]).collect();
        let shape = MeshShape::new(vertices_m.clone(), triangles, |_, _, _| false).unwrap();
        for round in 0..500 {
            let place_m = place(&mut dice, if round % 2 == 0 { 1.0 } else { 9.0 });
            let away = |vertex: &usize| vertices_m[*vertex].distance_squared(place_m);
            let expected = (0..400).min_by(|a, b| away(a).total_cmp(&away(b))).unwrap();
            assert_eq!(shape.nearest(place_m).index(), expected, "{place_m}");
            let radius_m = 0.2 * dice.f64();
            let within: Vec<usize> = (0..400).filter(|vertex| away(vertex).sqrt() <= radius_m).collect();
            let found: Vec<usize> = shape.around(place_m, radius_m).into_iter().map(PointId::index).collect();
            assert_eq!(found, within, "{place_m} {radius_m}");
        }
    }

    #[test]
    fn a_ball_that_fixes_no_vertex_is_told_with_the_nearest_one() {
        let vertices_m =
            [[0.0; 3], [0.04, 0.0, 0.0], [0.04, 0.03, 0.0], [0.0, 0.03, 0.0]].map(DVec3::from_array).to_vec();
        let mesh = TriangleMesh { vertices_m, triangles: vec![[0, 1, 2], [0, 2, 3]], ..TriangleMesh::default() };
        let (held, empty) = ((DVec3::ZERO, 0.001), (DVec3::new(0.04, 0.03, 0.005), 0.004));
        let told = |balls: &[(DVec3, f64)]| {
            Mesh::of(mesh.clone(), 1e-3, FixedVertices::Balls(balls.to_vec())).unwrap().warnings()
        };
        assert_eq!(told(&[held]), [""; 0]);
        assert_eq!(
            told(&[held, empty]),
            [
                "mesh.fixed[1]: no vertex is within 0.004 m of [0.0400, 0.0300, 0.0050] m, so this ball fixes nothing; the nearest, \
              vertex 2, is 0.0050 m off"
            ]
        );
        assert_eq!(told(&[empty; 7]).last().unwrap(), "mesh.fixed: 3 more balls hold no vertex");
    }

    #[test]
    fn a_vertex_without_a_triangle_changes_neither_size_nor_mass_nor_what_is_nearest() {
        let places_m = [[0.0; 3], [0.04, 0.0, 0.0], [0.04, 0.03, 0.0], [0.0, 0.03, 0.0]].map(DVec3::from_array);
        let triangles = vec![[0, 1, 2], [0, 2, 3]];
        for stray_m in [DVec3::new(0.0, 0.0, 100.0), DVec3::new(0.01, 0.01, 0.0), DVec3::splat(-1e6)] {
            let with = places_m.into_iter().chain([stray_m]).collect();
            let [alone, with] =
                [places_m.to_vec(), with].map(|all| MeshShape::new(all, triangles.clone(), |_, _, _| false).unwrap());
            assert_eq!(with.extent(), alone.extent(), "{stray_m}");
            assert_eq!(with.nearest(stray_m), alone.nearest(stray_m), "{stray_m}");
            assert_eq!(with.around(stray_m, 0.02), alone.around(stray_m, 0.02), "{stray_m}");
            let [alone, with] = [alone, with].map(|shape| {
                let mesh = Mesh::uneven(0.01, 0.0, Arc::new(shape), PerNodeFactors::default());
                (mesh.mass_kg(), mesh.stiffest.bound)
            });
            assert_eq!(with, alone, "{stray_m}");
        }
    }

    #[test]
    fn vertices_are_nearly_as_far_from_some_as_a_search_through_all_finds() {
        let mut dice = fastrand::Rng::with_seed(31);
        let side = 30;
        let mut off = || 0.4 * dice.f64();
        let place = |k: u32| DVec3::new(f64::from(k / side) + off(), f64::from(k % side) + off(), off());
        let vertices_m: Vec<DVec3> = (0..side * side).map(place).collect();
        let cells = (0..side * (side - 1)).filter(|k| k % side != side - 1);
        let triangles = cells.flat_map(|k| [[k, k + side, k + 1], [k + 1, k + side, k + side + 1]]).collect();
        let shape = MeshShape::new(vertices_m.clone(), triangles, |_, _, _| false).unwrap();
        for (count, most_m) in [(1, 9.0), (12, 3.0), (200, 2.0), (5, 0.0)] {
            let members: Vec<u32> = (0..count).map(|_| dice.u32(..side * side)).collect();
            let mut same = 0;
            for (vertex, away_m) in shape.away_m(&members, most_m).into_iter().enumerate() {
                let to = |member: &u32| vertices_m[*member as usize].distance(vertices_m[vertex]);
                let nearest_m = members.iter().map(to).fold(f64::INFINITY, f64::min);
                let expected_m = if nearest_m < most_m || nearest_m == 0.0 { nearest_m } else { f64::INFINITY };
                same += u32::from(away_m == expected_m);
                // Where a region is cut off by others' for a part of an edge.
                let is_near = away_m >= nearest_m && away_m.min(most_m) < nearest_m + 0.4;
                assert!(away_m == expected_m || is_near, "{vertex}: {away_m} {expected_m}");
            }
            assert!(same > side * side * 98 / 100, "{same}");
        }
    }

    #[test]
    fn the_bound_of_the_stiffness_holds_and_is_not_far_above_it() {
        let mut dice = fastrand::Rng::with_seed(7);
        for round in 0..20 {
            // A strip of triangles with some left out.
            let vertices_m = (0..60)
                .map(|k| DVec3::new(f64::from(k / 6), f64::from(k % 6) + 0.5 * f64::from(k / 6 % 2), 0.1 * dice.f64()))
                .collect();
            let cells = (0..54).filter(|k| k % 6 != 5);
            let triangles: Vec<[u32; 3]> = cells.flat_map(|k| [[k, k + 6, k + 1], [k + 1, k + 6, k + 7]]).collect();
            let triangles = triangles.into_iter().filter(|_| round == 0 || dice.f64() < 0.8).collect();
            let shape = MeshShape::new(vertices_m, triangles, |_, _, _| false).unwrap();
            let shape = Arc::new(shape);
            for (bending, is_uneven) in [(0.0, false), (0.3, false), (1.0, false), (0.0, true), (0.4, true)] {
                let mut dice = |count: usize| (0..count).map(|_| 0.3 + dice.f64()).collect::<Vec<f64>>();
                let differences = PerNodeFactors {
                    relative_mass: dice(60),
                    extra_anchor: vec![],
                    edges: dice(shape.edges.len()),
                    bending: dice(shape.opposite.len()),
                };
                let differences = if is_uneven { differences } else { PerNodeFactors::default() };
                let mesh = Mesh::uneven(1.0, bending, shape.clone(), differences);
                let mass = |vertex: usize| mesh.relative_mass(PointId::new(vertex));
                // Power iteration on the Laplacian over the masses; Rayleigh's quotient is never above an eigenvalue.
                let (mut x, mut largest) = (dice(60), 0.0);
                for _ in 0..400 {
                    let mut y = vec![0.0; 60];
                    let (mut stored, mut weighed) = (0.0, 0.0);
                    for ([a, b], k) in mesh.springs() {
                        let pull = k * (x[a as usize] - x[b as usize]);
                        stored += pull * (x[a as usize] - x[b as usize]);
                        y[a as usize] += pull / mass(a as usize);
                        y[b as usize] -= pull / mass(b as usize);
                    }
                    x.iter().enumerate().for_each(|(vertex, x)| weighed += mass(vertex) * x * x);
                    largest = stored / weighed;
                    let length = y.iter().map(|y| y * y).sum::<f64>().sqrt();
                    x = y.into_iter().map(|y| y / length).collect();
                }
                let StiffnessBound { bound, .. } = mesh.stiffest;
                assert!(bound >= largest && bound < 1.03 * largest, "{round} {bending}: {bound} {largest}");
            }
        }
    }

    #[test]
    fn a_part_of_a_mesh_is_turned_and_has_its_springs() {
        let mesh = Mesh::new(0.1, 0.5, Arc::new(shape()));
        let (part, [pushed, ..]) = mesh.part_around_fastest(3);
        assert_eq!((part.shape.vertices_m.len(), part.shape.edges.len()), (3, 3));
        assert!(part.shape.rest_m(pushed).length() < 1e-12 && !part.shape.is_fixed(pushed));
        let (all, _) = mesh.part_around_fastest(100);
        assert_eq!(all.shape.vertices_m.len(), 4, "what is not joined does not belong to it");
        assert!(all.shape.normal(pushed).distance(DVec3::Z) < 1e-9);
    }

    #[test]
    fn a_mesh_that_is_none_is_refused_by_element_and_place() {
        let square = || vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::new(1.0, 1.0, 0.0), DVec3::Z];
        for (vertices_m, triangles, message) in [
            (square(), vec![], "has no triangle"),
            (square(), vec![[0, 1, 5]], "triangle 0 names a vertex beyond the last of 5"),
            (square(), vec![[0, 1, 1]], "the edge between vertices 1 and 1"),
            (
                square(),
                vec![[0, 1, 2], [1, 0, 3], [0, 1, 4]],
                "the edge between vertices 0 and 1 at [0.000000, 0.000000, 0.000000] m has 3",
            ),
            (vec![DVec3::NAN; 3], vec![[0, 1, 2]], "vertex 0 is not finite"),
        ] {
            let refused = MeshShape::new(vertices_m, triangles, |_, _, _| false).unwrap_err();
            assert!(refused.message.contains(message), "{}", refused.message);
        }
    }
}
