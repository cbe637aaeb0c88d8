//! The sections `[material]` and `[[inclusion]]` of a scene on a mesh: the material of the tissue, and regions
//! where it differs.

use std::sync::Arc;

use glam::{DMat3, DVec3};

use super::membrane::settled_energy_j;
use super::mesh::{Mesh, MeshShape, PerNodeFactors, group_named};
use crate::scene::action_check::physical;
use crate::scene::exercise::Lump;
use crate::scene::toml_document::{Fields, Item};
use crate::shape::{PointId, RestShape};
use palpate_refusal::{Reason, Refusal, Result, finite_vector, not_negative, number, positive, unsigned_zero};

/// k of an edge between equal triangles with equal sides, over E·t: such springs resist as a membrane with ν = 1/3.
const EQUAL_SIDES: f64 = 0.866_025_403_784_438_6;

/// ν of a membrane of springs.
const POISSON: f64 = 1.0 / 3.0;

/// A third of the mass beneath the surface counts: its displacement falls linearly with depth.
const MOVES_ALONG: f64 = 1.0 / 3.0;

/// The material of a tissue on a mesh: an elastic capsule on a soft foundation. [`Material::applied`] checks
/// it.
#[derive(Debug, Clone, PartialEq)]
pub struct Material {
    /// Young's modulus E of the capsule, Pa. Its Poisson ratio ν is 1/3.
    pub youngs_modulus_pa: f64,
    /// Thickness t of the capsule, m.
    pub thickness_m: f64,
    /// Density ρ of the tissue that moves along with the capsule, kg/m³.
    pub density_kg_per_m3: f64,
    /// Depth H of the tissue that moves along, m.
    pub depth_m: f64,
    /// Stiffness k″ of the foundation, which pulls back to the rest shape, N/m for each m² of surface; 0 for
    /// none.
    pub foundation_n_per_m3: f64,
    /// Damping ratio ζ of a point on its anchor spring alone, 0 to 100; 1 is critical. Without a foundation
    /// nothing is damped.
    pub damping_ratio: f64,
    /// The group of the mesh whose vertices lie on the foundation; the others have no anchor springs. `None`: all do.
    pub foundation_group: Option<String>,
}

/// A tissue made of a material, by [`Material::applied`]: the mesh, and the reference coefficients.
#[derive(Debug, Clone, PartialEq)]
pub struct MadeOf {
    /// The mesh, with the factors of its points and springs, without inclusions and volume.
    pub mesh: Mesh,
    /// Reference k, N/m: that of an edge between triangles with equal sides.
    pub stiffness_n_per_m: f64,
    /// Reference K″, N/m: that of a vertex of mean area.
    pub anchor_stiffness_n_per_m: f64,
    /// Reference C, N·s/m: that of a vertex of mean area.
    pub damping_n_s_per_m: f64,
}

impl Material {
    /// Message of the refusal of a coefficient beside a material ([`Reason::WrongKind`]).
    pub const FOLLOWS: &str = "does not go with [material], from which it follows";

    /// Message of the refusal of a material or an inclusion on a sheet ([`Reason::WrongKind`]).
    pub const OF_A_MESH: &str = "is for a mesh: a sheet has the same points and springs all over";

    /// Creates a material of usual soft tissue: density 1060 kg/m³, depth 0.03 m, damping ratio 0.5, a foundation everywhere. The
    /// arguments, Pa, m and N/m³, are not checked.
    pub fn new(youngs_modulus_pa: f64, thickness_m: f64, foundation_n_per_m3: f64) -> Self {
        let (density_kg_per_m3, depth_m, damping_ratio) = (1060.0, 0.03, 0.5);
        Material {
            youngs_modulus_pa,
            thickness_m,
            density_kg_per_m3,
            depth_m,
            foundation_n_per_m3,
            damping_ratio,
            foundation_group: None,
        }
    }

    pub(super) fn read(fields: &mut Fields<'_>) -> Result<Self> {
        let youngs_modulus_pa = fields.required_number("youngs_modulus_pa")?;
        let thickness_m = fields.required_number("thickness_m")?;
        let foundation_n_per_m3 = fields.required_number("foundation_n_per_m3")?;
        let usual = Material::new(youngs_modulus_pa, thickness_m, foundation_n_per_m3);
        Ok(Material {
            density_kg_per_m3: fields.number("density_kg_per_m3")?.unwrap_or(usual.density_kg_per_m3),
            depth_m: fields.number("depth_m")?.unwrap_or(usual.depth_m),
            damping_ratio: fields.number("damping_ratio")?.unwrap_or(usual.damping_ratio),
            foundation_group: fields.text("foundation_group")?,
            ..usual
        })
    }

    fn check(&self) -> Result<()> {
        for (field, value) in [
            ("material.youngs_modulus_pa", self.youngs_modulus_pa),
            ("material.thickness_m", self.thickness_m),
            ("material.density_kg_per_m3", self.density_kg_per_m3),
            ("material.depth_m", self.depth_m),
        ] {
            physical(field, positive(field, value)?)?;
        }
        if not_negative("material.foundation_n_per_m3", self.foundation_n_per_m3)? > 0.0 {
            physical("material.foundation_n_per_m3", self.foundation_n_per_m3)?;
        }
        number("material.damping_ratio", self.damping_ratio, "from 0 to 100", |v| (0.0..=100.0).contains(&v))?;
        Ok(())
    }

    /// Returns K″/m of each vertex divided by the reference value, minus 1: −1 beside the foundation. Empty if it is everywhere.
    fn extra_anchor(&self, shape: &MeshShape) -> Result<Vec<f64>> {
        let Some(name) = &self.foundation_group else { return Ok(Vec::new()) };
        let group = group_named("material.foundation_group", name, &shape.told().groups)?;
        let mut extra = vec![-1.0; shape.vertices_m().len()];
        group.vertices.iter().for_each(|vertex| extra[*vertex as usize] = 0.0);
        Ok(extra)
    }

    /// Returns a tissue of this material. `bending` is the k of the bending springs relative to that of the
    /// edge they cross; 0 creates none.
    ///
    /// A vertex has the area A, a third of that of its triangles. Mass, K″ and C follow from it (a vertex
    /// without an edge gets the mean values):
    ///
    /// m = ρ·H·A/3,  K″ = k″·A,  C = 2ζ·√(K″·m),
    ///
    /// where H is the depth of the tissue that moves along. If displacements fall linearly with depth, the
    /// kinetic energy is that of a third of the mass. ζ is the damping ratio of a point on its anchor spring
    /// alone.
    ///
    /// An edge of length L between triangles of areas A₁ and A₂ has k = E·t·(A₁ + A₂)/L² (Van Gelder,
    /// Approximate simulation of elastic membranes by triangulated spring meshes, Journal of Graphics Tools
    /// 3(2), 1998), times one factor for the whole mesh. With this factor, all springs, those of bending
    /// included, store the energy of the material when it is stretched equally in all directions: E·t/(1 − ν)
    /// on each m² for a strain of 1, with ν = 1/3 (module `membrane`).
    ///
    /// # Errors
    /// Refuses a modulus, thickness, density or depth beyond 1e-12 to 1e12; a foundation that is neither 0 nor
    /// in this range; a damping ratio beyond 0 to 100; a group that the mesh does not have; and a mesh with a vertex that has edges but no area
    /// ([`Reason::Unreadable`]).
    pub fn applied(&self, bending: f64, shape: Arc<MeshShape>) -> Result<MadeOf> {
        self.check()?;
        let Spread { of_vertices_m2, beside_edges_m2 } = Spread::of(&shape);
        let whole_m2: f64 = of_vertices_m2.iter().sum();
        #[allow(clippy::cast_precision_loss)]
        let mean_m2 = whole_m2 / (0..of_vertices_m2.len()).filter(|vertex| shape.is_used(*vertex)).count() as f64;
        let is_none = |area_m2: f64| !area_m2.is_finite() || area_m2 <= mean_m2 * 1e-9;
        let lacks = |vertex: &usize| shape.is_used(*vertex) && is_none(of_vertices_m2[*vertex]);
        if let Some(vertex) = (0..of_vertices_m2.len()).find(lacks) {
            let (name, place_m) = (shape.name(PointId::new(vertex)), shape.vertices_m()[vertex]);
            let message = format!(
                "{name} at {place_m:.6} m has no area, so [material] gives it no mass: `palpate mesh FILE --repair` may mend it"
            );
            return Err(Refusal::new(Reason::Unreadable, "material", message));
        }
        let squared_m2 = |[a, b]: &[u32; 2]| {
            let [a, b] = [a, b].map(|end| shape.vertices_m()[*end as usize]);
            a.distance_squared(b)
        };
        let edges: Vec<f64> = shape.edges().iter().zip(&beside_edges_m2).map(|(e, a)| a / squared_m2(e)).collect();
        let crossed = |edge: &[u32; 2]| shape.edges().binary_search(edge).map_or(0.0, |at| edges[at]);
        let across: Vec<f64> = shape.crossed().iter().map(crossed).collect();
        let relative = |list: &[f64]| list.iter().map(|factor| factor / EQUAL_SIDES).collect::<Vec<f64>>();
        let relative_mass = of_vertices_m2
            .iter()
            .enumerate()
            .map(|(vertex, area_m2)| if shape.is_used(vertex) { area_m2 / mean_m2 } else { 1.0 });
        let differences = PerNodeFactors {
            relative_mass: relative_mass.collect(),
            extra_anchor: self.extra_anchor(&shape)?,
            edges: relative(&edges),
            bending: relative(&across),
        };
        let (mass_per_m2, foundation) = (MOVES_ALONG * self.density_kg_per_m3 * self.depth_m, self.foundation_n_per_m3);
        let mesh = Mesh::uneven(mass_per_m2 * mean_m2, bending, shape, differences);
        let membrane_n_per_m = self.youngs_modulus_pa * self.thickness_m;
        Ok(MadeOf {
            stiffness_n_per_m: EQUAL_SIDES * membrane_n_per_m / modulus(&mesh, whole_m2),
            anchor_stiffness_n_per_m: foundation * mean_m2,
            damping_n_s_per_m: 2.0 * self.damping_ratio * (foundation * mass_per_m2).sqrt() * mean_m2,
            mesh,
        })
    }
}

/// Returns E·t of the membrane that a mesh's springs form, where an edge between triangles with equal sides has
/// k = √3/2. A strain of 1 in all directions stores E·t/(1 − ν) on each m².
fn modulus(mesh: &Mesh, whole_m2: f64) -> f64 {
    let shape = &mesh.shape;
    let springs = mesh.springs().map(|(ends, k)| (ends, EQUAL_SIDES * k));
    let held = |vertex: usize| shape.is_on_rim(vertex);
    let stored_j = settled_energy_j([shape.vertices_m(), shape.normals()], springs, held, DMat3::IDENTITY);
    let modulus = stored_j * (1.0 - POISSON) / whole_m2;
    // A mesh of so few triangles that all of it gives way is left as it is.
    if modulus > 0.1 { modulus } else { 1.0 }
}

/// How the area of a mesh is distributed over vertices and edges.
struct Spread {
    /// A third of the area of each vertex's triangles, m².
    of_vertices_m2: Vec<f64>,
    /// The area of the triangles beside each edge, m².
    beside_edges_m2: Vec<f64>,
}

impl Spread {
    fn of(shape: &MeshShape) -> Self {
        let (vertices_m, edges) = (shape.vertices_m(), shape.edges());
        let (mut of_vertices_m2, mut beside_edges_m2) = (vec![0.0; vertices_m.len()], vec![0.0; edges.len()]);
        for triangle in shape.triangles() {
            let [a, b, c] = triangle.map(|vertex| vertices_m[vertex as usize]);
            let area_m2 = 0.5 * (b - a).cross(c - a).length();
            triangle.iter().for_each(|vertex| of_vertices_m2[*vertex as usize] += area_m2 / 3.0);
            let [a, b, c] = *triangle;
            for edge in [[a, b], [b, c], [c, a]].map(|[a, b]| [a.min(b), a.max(b)]) {
                if let Ok(at) = edges.binary_search(&edge) {
                    beside_edges_m2[at] += area_m2;
                }
            }
        }
        Spread { of_vertices_m2, beside_edges_m2 }
    }
}

/// A region of a mesh that is stiffer or softer. [`Inclusion::put_into`] checks it and applies it.
#[derive(Debug, Clone, PartialEq)]
pub struct Inclusion {
    /// Where the region is; a ball must reach a vertex, and a group exist.
    pub region: Region,
    /// k of the springs inside divided by k outside, 0.01 to 100; bending springs included.
    pub stiffness_factor: f64,
    /// K″ of the points inside divided by K″ outside, 0.01 to 100.
    pub anchor_stiffness_factor: f64,
    /// Width of the transition around the region, in which the factors fall to 1, m; at least 0. A factor f
    /// acts as 1 + (f − 1)·p, with p = 1 within the region and p = 1 − x²·(3 − 2x) at x times this distance
    /// beyond it. A spring has the mean p of its ends.
    pub edge_m: f64,
}

/// A part of a surface: where an inclusion is.
#[derive(Debug, Clone, PartialEq)]
pub enum Region {
    /// The vertices within a ball, through the tissue: also those of another side of the surface.
    Ball {
        /// Its centre, m, in the frame of the mesh.
        centre_m: DVec3,
        /// Its radius, m; above 0.
        radius_m: f64,
    },
    /// The vertices of the mesh's group with this name.
    Group(String),
}

impl Region {
    /// Creates a region from either a ball (centre and radius, m) or the name of a group. Numbers and name are
    /// not checked.
    ///
    /// # Errors
    /// Refuses both ([`Reason::WrongKind`]), neither, and a ball without centre or radius
    /// ([`Reason::Missing`]).
    pub fn of(centre_m: Option<DVec3>, radius_m: Option<f64>, group: Option<String>) -> Result<Self> {
        let refuse = |reason, key, message| Err(Refusal::new(reason, key, message));
        match (centre_m, radius_m, group) {
            (Some(centre_m), Some(radius_m), None) => Ok(Region::Ball { centre_m, radius_m }),
            (None, None, Some(group)) => Ok(Region::Group(group)),
            (Some(_), None, None) => refuse(Reason::Missing, "radius_m", "is missing"),
            (Some(_), _, Some(_)) => {
                refuse(Reason::WrongKind, "group", "does not go with centre_m: an inclusion is a ball or a group")
            }
            (None, Some(_), Some(_)) => {
                refuse(Reason::WrongKind, "radius_m", "does not go with group: an inclusion is a ball or a group")
            }
            (None, _, None) => {
                refuse(Reason::Missing, "centre_m", "is missing, or else `group`: where the inclusion is")
            }
        }
    }

    /// Returns how far each vertex is beyond the region, m: 0 or less within it. Where the distance is above
    /// `most_m`, any number above `most_m`.
    fn beyond_m(&self, shape: &MeshShape, most_m: f64) -> Vec<f64> {
        match self {
            Region::Ball { centre_m, radius_m } => {
                shape.vertices_m().iter().map(|place_m| place_m.distance(*centre_m) - radius_m).collect()
            }
            Region::Group(name) => {
                let named = group_named("", name, &shape.told().groups);
                shape.away_m(named.map_or(&[], |group| &group.vertices), most_m)
            }
        }
    }
}

/// Largest number of inclusions in a scene.
pub(super) const MAX_INCLUSIONS: usize = 256;

/// Largest number of inclusions times vertices: each inclusion examines every vertex.
const MAX_LOOKED_AT: usize = 8_000_000;

impl Inclusion {
    /// Creates the inclusion of a lump.
    pub fn of_lump(lump: &Lump) -> Self {
        let region = Region::Ball { centre_m: lump.centre_m, radius_m: lump.radius_m };
        Inclusion { stiffness_factor: lump.stiffness_factor, ..Inclusion::even(region) }
    }

    /// Creates an inclusion whose factors are 1 and whose edge is 0 wide, so that it changes nothing: a start
    /// for others.
    pub fn even(region: Region) -> Self {
        Inclusion { region, stiffness_factor: 1.0, anchor_stiffness_factor: 1.0, edge_m: 0.0 }
    }

    pub(super) fn read(item: &Item<'_>) -> Result<Self> {
        item.table(|fields| {
            let (centre, group) = (fields.item("centre_m"), fields.text("group")?);
            let radius_m = match (&centre, &group) {
                (Some(_), None) => Some(fields.required_number("radius_m")?),
                _ => fields.number("radius_m")?,
            };
            let centre_m = centre.map(|centre| centre.vector()).transpose()?;
            let region = Region::of(centre_m, radius_m, group);
            let region = region.map_err(|refusal| fields.refuse(refusal.reason, &refusal.field, refusal.message))?;
            let even = Inclusion::even(region);
            Ok(Inclusion {
                stiffness_factor: fields.number("stiffness_factor")?.unwrap_or(even.stiffness_factor),
                anchor_stiffness_factor: fields
                    .number("anchor_stiffness_factor")?
                    .unwrap_or(even.anchor_stiffness_factor),
                edge_m: fields.number("edge_m")?.unwrap_or(even.edge_m),
                ..even
            })
        })
    }

    /// Checks what does not depend on the tissue; `field` is the key of the inclusion in refusals.
    pub(super) fn check_numbers(&self, field: &str) -> Result<()> {
        let named = |key: &str| format!("{field}.{key}");
        let factors =
            [("stiffness_factor", self.stiffness_factor), ("anchor_stiffness_factor", self.anchor_stiffness_factor)];
        for (key, factor) in factors {
            number(&named(key), factor, "from 0.01 to 100", |v| (0.01..=100.0).contains(&v))?;
        }
        not_negative(&named("edge_m"), self.edge_m)?;
        if let Region::Ball { centre_m, radius_m } = &self.region {
            finite_vector(&named("centre_m"), *centre_m)?;
            positive(&named("radius_m"), *radius_m)?;
        }
        Ok(())
    }

    /// Checks an inclusion of a mesh; `field` is its key in refusals.
    fn check(&self, field: &str, shape: &MeshShape) -> Result<()> {
        self.check_numbers(field)?;
        match &self.region {
            Region::Ball { centre_m, radius_m } => {
                let nearest_m = shape.rest_m(shape.nearest(*centre_m));
                let away_m = nearest_m.distance(*centre_m);
                if away_m > radius_m + self.edge_m {
                    let message = format!(
                        "no vertex is within the ball: the nearest is at {nearest_m:.4} m, {away_m:.4} m from its centre"
                    );
                    return Err(Refusal::new(Reason::OutOfRange, format!("{field}.radius_m"), message));
                }
            }
            Region::Group(name) => _ = group_named(&format!("{field}.group"), name, &shape.told().groups)?,
        }
        Ok(())
    }

    /// Returns how much a place belongs to the inclusion that is `beyond_m` (m) beyond its region: 1 within, 0 beyond its
    /// edge, smooth between.
    pub(super) fn part_beyond(&self, beyond_m: f64) -> f64 {
        if beyond_m <= 0.0 {
            return 1.0;
        }
        // With an edge of 0, this is infinite; an edge of −0 must not give minus infinity.
        let x = beyond_m / unsigned_zero(self.edge_m);
        if x < 1.0 { 1.0 - x * x * (3.0 - 2.0 * x) } else { 0.0 }
    }

    /// Returns how much each vertex belongs to the inclusion ([`Inclusion::part_beyond`]).
    fn parts(&self, shape: &MeshShape) -> Vec<f64> {
        let mut parts = self.region.beyond_m(shape, self.edge_m);
        parts.iter_mut().for_each(|part| *part = self.part_beyond(*part));
        parts
    }

    /// Returns the mesh with inclusions applied, in place of those that it had; where several overlap, or the mesh has factors of its
    /// own, the factors multiply. The result has no volume, unless neither had inclusions: then the mesh is unchanged.
    /// `field` is the key of the list in refusals (`field[n].key` for inclusion n).
    ///
    /// # Errors
    /// Refuses more than 256 inclusions, or than 8,000,000 divided by the number of vertices
    /// ([`Reason::TooLarge`]); a factor beyond 0.01 to 100, a negative edge, a radius that is not above 0; a
    /// group that the mesh does not have; and a ball that no vertex is in or within `edge_m` of.
    pub fn put_into(inclusions: &[Inclusion], field: &str, mesh: &Mesh) -> Result<Mesh> {
        let shape = &mesh.shape;
        let count = shape.vertices_m().len();
        let most = MAX_INCLUSIONS.min(MAX_LOOKED_AT / count);
        if inclusions.len() > most {
            let message = format!("are {}, more than {most} on a mesh of {count} vertices", inclusions.len());
            return Err(Refusal::new(Reason::TooLarge, field, message));
        }
        for (index, inclusion) in inclusions.iter().enumerate() {
            inclusion.check(&format!("{field}[{index}]"), shape)?;
        }
        if inclusions.is_empty() && !mesh.has_inclusions() {
            return Ok(mesh.clone());
        }
        if inclusions.is_empty() {
            let own = PerNodeFactors::clone(&mesh.own_differences);
            return Ok(Mesh::uneven(mesh.point_mass_kg, mesh.bending, shape.clone(), own));
        }
        let or = |list: &[f64], value: f64, length: usize| {
            if list.is_empty() { vec![value; length] } else { list.to_vec() }
        };
        let known = &mesh.own_differences;
        let mut differences = PerNodeFactors {
            relative_mass: known.relative_mass.clone(),
            extra_anchor: or(&known.extra_anchor, 0.0, count),
            edges: or(&known.edges, 1.0, shape.edges().len()),
            bending: or(&known.bending, 1.0, shape.opposite().len()),
        };
        for inclusion in inclusions {
            let parts = inclusion.parts(shape);
            for (extra, part) in differences.extra_anchor.iter_mut().zip(&parts) {
                *extra = (1.0 + *extra) * (1.0 + (inclusion.anchor_stiffness_factor - 1.0) * part) - 1.0;
            }
            let between = |[a, b]: &[u32; 2]| 0.5 * (parts[*a as usize] + parts[*b as usize]);
            let both = [(&mut differences.edges, shape.edges()), (&mut differences.bending, shape.opposite())];
            for (factors, ends) in both {
                for (factor, ends) in factors.iter_mut().zip(ends) {
                    *factor *= 1.0 + (inclusion.stiffness_factor - 1.0) * between(ends);
                }
            }
        }
        if differences.extra_anchor.iter().all(|extra| *extra == 0.0) {
            differences.extra_anchor = Vec::new();
        }
        let made = Mesh::uneven(mesh.point_mass_kg, mesh.bending, shape.clone(), differences);
        Ok(Mesh { own_differences: mesh.own_differences.clone(), ..made })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use palpate_geometry::TriangleMesh;
    use palpate_geometry::delaunay::flip_to_delaunay;

    use super::*;
    use crate::scene::BodyKind;

    const SOFT: Material = Material {
        youngs_modulus_pa: 5000.0,
        thickness_m: 0.01,
        density_kg_per_m3: 1000.0,
        depth_m: 0.03,
        foundation_n_per_m3: 9e5,
        damping_ratio: 0.5,
        foundation_group: None,
    };

    /// A flat patch of triangles with equal sides, its inner points moved by up to `jitter` edges.
    fn patch(side: u32, jitter: f64) -> MeshShape {
        let mut dice = fastrand::Rng::with_seed(23);
        let at = |i: u32, j: u32| i * side + j;
        let mut mesh = TriangleMesh::default();
        for (i, j) in (0..side).flat_map(|i| (0..side).map(move |j| (i, j))) {
            let inner = (1..side - 1).contains(&i) && (1..side - 1).contains(&j);
            let moved = DVec3::new(dice.f64() - 0.5, dice.f64() - 0.5, 0.0) * if inner { 2.0 * jitter } else { 0.0 };
            let place = DVec3::new(f64::from(j) + 0.5 * f64::from(i % 2), EQUAL_SIDES * f64::from(i), 0.0);
            mesh.vertices_m.push(0.002 * (place + moved));
        }
        for (i, j) in (0..side - 1).flat_map(|i| (0..side - 1).map(move |j| (i, j))) {
            let [a, b, c, d] = [at(i, j), at(i, j + 1), at(i + 1, j), at(i + 1, j + 1)];
            let both = if i % 2 == 0 { [[a, b, c], [b, d, c]] } else { [[a, b, d], [a, d, c]] };
            mesh.triangles.extend(both);
        }
        flip_to_delaunay(&mut mesh);
        MeshShape::new(mesh.vertices_m, mesh.triangles, |_, _, _| false).unwrap()
    }

    #[test]
    fn a_patch_that_is_stretched_resists_as_the_material_says() {
        for jitter in [0.0, 0.15, 0.3] {
            for bending in [0.0, 0.3] {
                let shape = Arc::new(patch(30, jitter));
                let made = SOFT.applied(bending, shape.clone()).unwrap();
                let area_m2: f64 = Spread::of(&shape).of_vertices_m2.iter().sum();
                let springs = || made.mesh.springs().map(|(ends, k)| (ends, k * made.stiffness_n_per_m));
                // Stretched along one side while the other gives way, by E·t; to all sides alike; and sheared.
                for (strain, expected) in [
                    (DVec3::new(1.0, -POISSON, 0.0), 50.0),
                    (DVec3::new(-POISSON, 1.0, 0.0), 50.0),
                    (DVec3::new(1.0, 1.0, 0.0), 50.0 * 2.0 / (1.0 - POISSON)),
                    (DVec3::new(1.0, -1.0, 0.0), 50.0 * 2.0 / (1.0 + POISSON)),
                ] {
                    let at = [shape.vertices_m(), shape.normals()];
                    let held = |vertex: usize| shape.is_on_rim(vertex);
                    let energy_j = settled_energy_j(at, springs(), held, DMat3::from_diagonal(strain));
                    let found = 2.0 * energy_j / area_m2;
                    let within = if bending > 0.0 { 0.06 } else { 0.035 };
                    assert!((found / expected - 1.0).abs() < within, "{jitter} {bending} {strain}: {found} {expected}");
                }
            }
        }
    }

    #[test]
    fn a_vertex_without_a_triangle_changes_no_other() {
        let alone = patch(12, 0.2);
        let with = alone.vertices_m().iter().copied().chain([DVec3::new(0.0, 0.0, 100.0)]).collect();
        let with = MeshShape::new(with, alone.triangles().to_vec(), |_, _, _| false).unwrap();
        let [alone, with] = [alone, with].map(|shape| SOFT.applied(0.1, Arc::new(shape)).unwrap());
        assert_eq!(with.stiffness_n_per_m, alone.stiffness_n_per_m);
        assert_eq!(with.anchor_stiffness_n_per_m, alone.anchor_stiffness_n_per_m);
        assert_eq!(with.damping_n_s_per_m, alone.damping_n_s_per_m);
        assert_eq!(with.mesh.mass_kg(), alone.mesh.mass_kg());
        let count = alone.mesh.differences.relative_mass.len();
        assert_eq!(with.mesh.differences.relative_mass[..count], alone.mesh.differences.relative_mass);
    }

    #[test]
    fn an_uneven_patch_has_mass_and_bed_by_its_area() {
        let shape = Arc::new(patch(12, 0.2));
        let made = SOFT.applied(0.0, shape.clone()).unwrap();
        let area_m2: f64 = Spread::of(&shape).of_vertices_m2.iter().sum();
        assert!((made.mesh.mass_kg() / (1000.0 * 0.03 / 3.0 * area_m2) - 1.0).abs() < 1e-12);
        let foundation: f64 =
            made.mesh.differences.relative_mass.iter().map(|mass| mass * made.anchor_stiffness_n_per_m).sum();
        assert!((foundation / (9e5 * area_m2) - 1.0).abs() < 1e-12);
        // 2ζ√(k″·ρH/3) on each m².
        let damping = made.damping_n_s_per_m / made.anchor_stiffness_n_per_m * 9e5;
        assert!((damping - (9e5_f64 * 10.0).sqrt()).abs() < 1e-6 * damping, "{damping}");
    }

    #[test]
    fn beside_the_group_of_a_foundation_no_vertex_has_an_anchor() {
        let mut text = crate::compile::square_of_triangles([4, 4], 0.01);
        text += "g bed\nf 1 6 7\n";
        let scene = |group: &str| {
            let scene = format!(
                "[mesh]\nfile = \"square.obj\"\nunit = \"m\"\n[material]\nyoungs_modulus_pa = 5e3\nthickness_m = 0.01\n\
                 foundation_n_per_m3 = 9e5\nfoundation_group = \"{group}\"\n"
            );
            let mesh = ("square.obj", text.as_bytes());
            crate::scene::Scene::parse_given("square", &scene, mesh, &crate::limits::Limits::default())
        };
        let found = scene("bed").unwrap();
        for point in crate::shape::points(found.shape()) {
            let expected = if [0, 5, 6].contains(&point.index()) { found.relative_mass(point) } else { 0.0 };
            assert_eq!(found.relative_anchor_stiffness(point), expected, "{point:?}");
        }
        let refusal = scene("bad").unwrap_err();
        assert_eq!(refusal.field, "material.foundation_group");
    }

    #[test]
    fn inclusions_have_a_smooth_edge_and_multiply() {
        let shape = Arc::new(patch(20, 0.0));
        let mesh = Mesh::new(0.001, 0.5, shape.clone());
        let centre_m = shape.extent().middle_m();
        let inclusion = |stiffness_factor: f64| Inclusion {
            region: Region::Ball { centre_m, radius_m: 0.005 },
            stiffness_factor,
            anchor_stiffness_factor: 5.0,
            edge_m: 0.006,
        };
        let found = Inclusion::put_into(&[inclusion(3.0), inclusion(2.0)], "inclusion", &mesh).unwrap().differences;
        for (vertex, extra) in found.extra_anchor.iter().enumerate() {
            let away_m = shape.vertices_m()[vertex].distance(centre_m);
            let factor = extra + 1.0;
            let holds = match away_m {
                m if m <= 0.005 - 1e-9 => (factor - 25.0).abs() < 1e-9,
                m if m >= 0.011 + 1e-9 => factor == 1.0,
                _ => (1.0..=25.0).contains(&factor),
            };
            assert!(holds, "{away_m}: {factor}");
        }
        let most = found.edges.iter().chain(&found.bending).copied().fold(0.0, f64::max);
        let least = found.edges.iter().copied().fold(f64::INFINITY, f64::min);
        assert!((most - 6.0).abs() < 1e-9 && least == 1.0, "{most} {least}");
    }

    #[test]
    fn there_are_fewer_inclusions_on_a_larger_mesh() {
        let mesh = Mesh::new(0.001, 0.0, Arc::new(patch(300, 0.0)));
        let ball = Region::Ball { centre_m: mesh.shape.extent().middle_m(), radius_m: 0.005 };
        let refused = Inclusion::put_into(&vec![Inclusion::even(ball); 89], "inclusion", &mesh).unwrap_err();
        assert_eq!((refused.reason, refused.field.as_str()), (Reason::TooLarge, "inclusion"));
        assert_eq!(refused.message, "are 89, more than 88 on a mesh of 90000 vertices");
    }
}
