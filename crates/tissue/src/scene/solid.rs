//! The section `[solid]` of a scene: tissue with an inside, on a lattice of cubes that fills a closed surface, and its
//! rest shape.
//!
//! A cube has the part of its stiffness and mass that is inside the surface, so that the surface may pass through cubes
//! at any angle; the surface itself moves with the corners of the cube around each of its vertices (trilinear). The
//! corners of the cubes are the mass points.

use std::sync::Arc;

use palpate_geometry::TriangleMesh;
use palpate_geometry::fill::Lattice;

use super::body::{BodyKind, KindOfBody, MAX_BRANCHES, MaxwellBranch};
use super::material::{Inclusion, MAX_INCLUSIONS, Region};
use super::source::{Files, SourceMesh};
use super::springs::Springs;
use crate::limits::Limits;
use crate::scene::action_check::physical;
use crate::scene::stepping::{Integrator, Stepping};
use crate::scene::toml_document::{Fields, Item};
use crate::shape::{CellPlace, PointId, RestShape};
use palpate_refusal::{Reason, Refusal, Result, excerpt, not_negative, number, positive};

mod branch;
mod fixed;
mod foundation;
mod gravity;
mod layer;
mod shape;
mod slowest;

pub use branch::{Branch, Branches};
pub use fixed::FixedPart;
use foundation::Foundation;
pub use gravity::Gravity;
pub use layer::Layer;
use shape::places_in_cube;
pub(crate) use shape::trilinear;
pub use shape::{CellSize, SolidShape};
use slowest::SlowestVibration;

/// Largest Poisson's ratio. Towards ½ the number of substeps grows without bound.
const MAX_POISSON: f64 = 0.495;

/// The power of the mean of the factors in a cube that an inclusion fills in part; 0 would be the geometric mean, −1 the harmonic one.
/// With it a sharp lump is as stiff as its size says: one of 10 mm across and five times as stiff, 8 to 15 mm deep in cubes of 2.5 to
/// 5 mm, makes a block stiffer under a disc by what a body-fitted solution says, −2.2 to +1.1 %; the geometric mean is up to 3 % too
/// stiff, the arithmetic one 6 %.
const MIXING: f64 = -0.3;

/// Places along each side of a cube at which an inclusion's factor is looked up.
const LOOKS: usize = 4;

/// The material of a solid: of one density, damped in proportion to its mass and to its stiffness.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SolidMaterial {
    /// Young's modulus E, Pa.
    pub youngs_modulus_pa: f64,
    /// Poisson's ratio ν, 0 to 0.495.
    pub poissons_ratio: f64,
    /// Density ρ, kg/m³.
    pub density_kg_per_m3: f64,
    /// Damping: the force −c·m·v on a mass m, 1/s.
    pub damping_per_s: f64,
    /// Viscosity η, Pa·s (Kelvin–Voigt): stress follows strain and its rate as if every modulus E were E·(1 + τ·d/dt), with
    /// τ = η/μ. In shear η resists the rate of the angle.
    pub viscosity_pa_s: f64,
    /// Parts of the stiffness that relax, beside E.
    pub branches: Branches,
}

impl SolidMaterial {
    /// Message of the refusal of a coefficient beside the material ([`Reason::WrongKind`]).
    pub const FOLLOWS: &str = "does not go with [solid], whose [material] gives it";

    /// Returns a material of usual soft tissue, to start from: 8 kPa, ν 0.45, 1060 kg/m³, damping of 20/s, 0.097 Pa·s.
    pub fn usual() -> Self {
        SolidMaterial {
            youngs_modulus_pa: 8e3,
            poissons_ratio: 0.45,
            density_kg_per_m3: 1060.0,
            damping_per_s: 20.0,
            viscosity_pa_s: 0.097,
            branches: Branches::default(),
        }
    }

    pub(super) fn read(fields: &mut Fields<'_>) -> Result<Self> {
        let usual = Self::usual();
        let material = SolidMaterial {
            youngs_modulus_pa: fields.required_number("youngs_modulus_pa")?,
            poissons_ratio: fields.required_number("poissons_ratio")?,
            density_kg_per_m3: fields.number("density_kg_per_m3")?.unwrap_or(usual.density_kg_per_m3),
            damping_per_s: fields.number("damping_per_s")?.unwrap_or(usual.damping_per_s),
            ..usual
        };
        let material = material.with_viscosity(fields.number("viscosity_pa_s")?);
        material.check()?;
        Ok(material)
    }

    /// Returns the material with a viscosity, Pa·s. `None` is the usual one: 0.097 Pa·s, or so much that η/μ is 35 µs if that is less,
    /// so that it does not damp what cells show well.
    pub fn with_viscosity(self, viscosity_pa_s: Option<f64>) -> Self {
        let usual = Self::usual();
        let by_default = || usual.viscosity_pa_s.min(usual.viscous_time_s() * self.shear_pa());
        SolidMaterial { viscosity_pa_s: viscosity_pa_s.unwrap_or_else(by_default), ..self }
    }

    /// Returns η/μ, s.
    fn viscous_time_s(&self) -> f64 {
        self.viscosity_pa_s / self.shear_pa()
    }

    /// Returns Lamé's μ, Pa.
    fn shear_pa(&self) -> f64 {
        self.youngs_modulus_pa * self.shear_over_youngs()
    }

    pub(super) fn check(&self) -> Result<()> {
        for (field, value) in [
            ("material.youngs_modulus_pa", self.youngs_modulus_pa),
            ("material.density_kg_per_m3", self.density_kg_per_m3),
        ] {
            physical(field, positive(field, value)?)?;
        }
        let holds = |v| (0.0..=MAX_POISSON).contains(&v);
        number("material.poissons_ratio", self.poissons_ratio, "from 0 to 0.495", holds)?;
        not_negative("material.damping_per_s", self.damping_per_s)?;
        not_negative("material.viscosity_pa_s", self.viscosity_pa_s)?;
        Ok(())
    }

    /// Returns Lamé's μ divided by E.
    pub fn shear_over_youngs(&self) -> f64 {
        0.5 / (1.0 + self.poissons_ratio)
    }

    /// Returns Lamé's λ divided by E.
    pub fn lame_over_youngs(&self) -> f64 {
        let nu = self.poissons_ratio;
        nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    }
}

/// A solid tissue: its shape, its material, and how stiff each cube is.
#[derive(Debug, Clone, PartialEq)]
pub struct Solid {
    /// The lattice, its points, and the surface within it.
    pub shape: Arc<SolidShape>,
    /// The material outside of inclusions.
    pub material: SolidMaterial,
    /// The part of each cube that counts for stiffness, times its factor of E ([`Lattice::index`]); 0 for a cube outside.
    weights: Arc<[f64]>,
    /// Mass of each point divided by the mass of a full cube.
    masses: Arc<[f64]>,
    layers: Arc<[Layer]>,
    /// The factor of E of each cube that its layers give.
    layer_factors: Arc<[f64]>,
    largest_factor: f64,
    foundation: Foundation,
    gravity: Gravity,
    slowest: SlowestVibration,
}

impl Solid {
    /// Creates a solid that fills the surface of a mesh (m), without inclusions.
    ///
    /// # Errors
    /// Refuses what [`SolidShape::of`] refuses, with fields that begin with `solid`.
    pub fn of(mesh: TriangleMesh, size: CellSize, fixed: &[FixedPart], material: SolidMaterial) -> Result<Self> {
        let shape = SolidShape::of(mesh, size, fixed, &Limits::default());
        let named = |refusal: Refusal| match refusal.field.as_str() {
            "" => Refusal { field: "solid.mesh_id".to_owned(), ..refusal },
            "cell_m" => Refusal { field: "solid.cell_m".to_owned(), ..refusal },
            _ => refusal,
        };
        Ok(Solid::new(Arc::new(shape.map_err(named)?), material))
    }

    /// Returns the factor of E of the cube around a place.
    pub(crate) fn factor(&self, place: &CellPlace) -> f64 {
        let shape = &self.shape;
        let cell = shape.lattice().index(shape.corner_at(shape.corner_of(PointId::new(place.points[0] as usize))));
        self.weights[cell] / shape.stiffness_part(cell).max(f64::MIN_POSITIVE)
    }

    /// Creates a solid of a material without inclusions.
    pub fn new(shape: Arc<SolidShape>, material: SolidMaterial) -> Self {
        let parts = shape.stiffness_parts();
        let masses = shape.at_points(&shape.mass_parts()).into();
        Solid {
            layer_factors: vec![1.0; parts.len()].into(),
            weights: parts.into(),
            masses,
            layers: Arc::default(),
            largest_factor: 1.0,
            foundation: Foundation::default(),
            gravity: Gravity::default(),
            slowest: SlowestVibration::default(),
            shape,
            material,
        }
    }

    /// Returns the solid with layers in place of those that it had, and without inclusions. A cube's factor is the harmonic
    /// mean over its inside.
    ///
    /// # Errors
    /// Refuses more than 8 layers, a thickness that is not above 0, and a factor beyond 0.01 to 100; `field` is the key of the
    /// list.
    pub fn with_layers(&self, layers: &[Layer], field: &str) -> Result<Self> {
        let layer_factors = Layer::factors(layers, field, &self.shape)?.into();
        let bare = Solid { layers: layers.into(), layer_factors, ..self.clone() };
        bare.with_inclusions(&[], field)
    }

    /// Returns the solid on a foundation: each part of its surface is pulled back to where it rests, by `n_per_m3` for each area and
    /// displacement (Winkler), N/m³.
    ///
    /// # Errors
    /// Refuses a negative number, and 0 if no point is fixed, with the fields `solid.foundation_n_per_m3` and `solid.fixed`.
    pub fn with_foundation(&self, n_per_m3: f64) -> Result<Self> {
        const FIELD: &str = "solid.foundation_n_per_m3";
        if not_negative(FIELD, n_per_m3)? > 0.0 {
            physical(FIELD, n_per_m3)?;
        } else if self.shape.fixed().is_empty() {
            let message = "is missing: name a part that does not move, or give foundation_n_per_m3";
            return Err(Refusal::new(Reason::Missing, "solid.fixed", message));
        }
        let new = || Foundation::new(n_per_m3, &self.shape, &self.masses);
        let foundation = if n_per_m3 > 0.0 { new() } else { Foundation::default() };
        Ok(Solid { foundation, slowest: SlowestVibration::default(), ..self.clone() })
    }

    /// Returns the solid of another material, unchecked ([`SolidMaterial::check`]).
    pub(super) fn of_material(&self, material: SolidMaterial) -> Self {
        Solid { material, slowest: SlowestVibration::default(), ..self.clone() }
    }

    /// Returns the solid under gravity.
    pub fn with_gravity(self, gravity: Gravity) -> Self {
        Solid { gravity, ..self }
    }

    /// Returns the stiffness of the foundation, N/m³; 0 without one.
    pub fn foundation_n_per_m3(&self) -> f64 {
        self.foundation.n_per_m3
    }

    /// Returns the gravity.
    pub fn gravity(&self) -> &Gravity {
        &self.gravity
    }

    /// Returns the stiffness with which the foundation pulls a point back, N/m.
    pub(crate) fn foundation_n_per_m(&self, point: PointId) -> f64 {
        self.foundation.n_per_m(point)
    }

    /// Returns the layers, from the surface inward.
    pub fn layers(&self) -> &[Layer] {
        &self.layers
    }

    /// Returns the solid with inclusions, in place of those that it had. A cube's factor is a mean over it ([`MIXING`]).
    ///
    /// # Errors
    /// Refuses more than 256 inclusions, a group that is no region of the file, a factor beyond 0.01 to 100, and what reaches no cube;
    /// `field` is the key of the list.
    pub(super) fn with_inclusions(&self, inclusions: &[Inclusion], field: &str) -> Result<Self> {
        if inclusions.len() > MAX_INCLUSIONS {
            let message = format!("are {}, more than {MAX_INCLUSIONS}", inclusions.len());
            return Err(Refusal::new(Reason::TooLarge, field, message));
        }
        let mut weights = self.shape.stiffness_parts();
        let mut factors = self.layer_factors.to_vec();
        for (index, inclusion) in inclusions.iter().enumerate() {
            let field = format!("{field}[{index}]");
            inclusion.check_numbers(&field)?;
            let (parts, key) = match &inclusion.region {
                Region::Ball { centre_m, radius_m } => {
                    let reach_m = radius_m + inclusion.edge_m;
                    let lattice = self.shape.lattice();
                    let part = |cell| (lattice.index(cell), inclusion.mean_part(lattice, cell, LOOKS));
                    (self.shape.cells_within(*centre_m, reach_m).map(part).collect(), "radius_m")
                }
                Region::Group(name) if inclusion.edge_m > 0.0 => {
                    let message =
                        format!("is for a ball: the region `{}` has the form that the file gives", excerpt(name));
                    return Err(Refusal::new(Reason::WrongKind, format!("{field}.edge_m"), message));
                }
                Region::Group(name) => (self.shape.region_parts(name, &format!("{field}.group"))?, "group"),
            };
            let mut reaches = false;
            for (at, part) in parts {
                if weights[at] > 0.0 && part > 0.0 {
                    factors[at] *= mixed(inclusion.stiffness_factor, part);
                    reaches = true;
                }
            }
            if !reaches {
                let message = "reaches no part of the solid";
                return Err(Refusal::new(Reason::OutOfRange, format!("{field}.{key}"), message));
            }
        }
        weights.iter_mut().zip(&factors).for_each(|(weight, factor)| *weight *= factor);
        let stiffest = |(factor, weight): (&f64, &f64)| (*weight > 0.0).then_some(*factor);
        let largest_factor = factors.iter().zip(&weights).filter_map(stiffest).fold(0.0, f64::max);
        Ok(Solid { weights: weights.into(), largest_factor, slowest: SlowestVibration::default(), ..self.clone() })
    }

    /// Returns the part of each cube that counts for stiffness, times its factor of E, by [`Lattice::index`]; 0 for a cube outside.
    pub fn weights(&self) -> &[f64] {
        &self.weights
    }

    /// Returns the scale of stiffness, N/m, that stands for k of springs: E times the edge of a cube.
    pub(super) fn stiffness_n_per_m(&self) -> f64 {
        self.material.youngs_modulus_pa * self.shape.lattice().edge_m
    }

    /// Returns C of a point with the mass of a full cube, N·s/m.
    pub(super) fn damping_n_s_per_m(&self) -> f64 {
        self.material.damping_per_s * self.point_mass_kg()
    }

    /// Returns the bound of the largest eigenvalue of the stiffness, divided by E·a. With the mass of a full cube m = ρ·a³
    /// no vibration at rest is faster than ω² = 4·f·(3λ + 2μ)/(ρ·a²), for any part of each cube, because it counts for
    /// stiffness at most as it does for mass; f is the largest factor of E. So m·ω²/(E·a) = 4·f·(3λ + 2μ)/E.
    fn bound(&self) -> f64 {
        4.0 * self.largest_factor * (3.0 * self.material.lame_over_youngs() + 2.0 * self.material.shear_over_youngs())
    }

    /// Reads the mesh, the size of the cubes and the fixed parts.
    fn read_shape(fields: &mut Fields<'_>, files: Files<'_>, limits: &Limits) -> Result<SolidShape> {
        let (source_mesh, source) = files.mesh(fields, limits)?;
        let (SourceMesh::Made(mesh) | SourceMesh::Read(mesh)) = source_mesh;
        let (cell, cells) = (fields.item("cell_m"), fields.item("cells"));
        let size = match (&cell, &cells) {
            (Some(_), Some(cells)) => {
                return Err(cells.refuse(Reason::WrongKind, "does not go with cell_m, from which it follows"));
            }
            (Some(cell), None) => CellSize::Edge(positive(&fields.path("cell_m"), cell.number()?)?),
            (None, Some(cells)) => CellSize::Count(cells.whole()? as f64),
            (None, None) => CellSize::USUAL,
        };
        let fixed = match fields.item("fixed") {
            Some(item) if item.as_text() == Some("none") => Vec::new(),
            Some(item) => FixedPart::read_list(&item)?,
            None => {
                let message = "is missing: which part does not move, as [{ plane_m, normal, within_m }], or \"none\"";
                return Err(fields.refuse(Reason::Missing, "fixed", message));
            }
        };
        let made = SolidShape::of(mesh, size, &fixed, limits);
        made.map_err(|refusal| match refusal.field.as_str() {
            "" => source.refuse(refusal.reason, refusal.message),
            "cell_m" => cell.as_ref().or(cells.as_ref()).unwrap_or(&source).refuse(refusal.reason, refusal.message),
            _ => refusal,
        })
    }
}

impl KindOfBody for Solid {
    const SECTION: &'static str = "solid";

    /// The material is read afterwards.
    fn read(fields: &mut Fields<'_>, files: Files<'_>, _of_material: bool, limits: &Limits) -> Result<Self> {
        let shape = Self::read_shape(fields, files, limits)?;
        let foundation_n_per_m3 = fields.number("foundation_n_per_m3")?.unwrap_or(0.0);
        Solid::new(Arc::new(shape), SolidMaterial::usual()).with_foundation(foundation_n_per_m3)
    }

    fn read_springs(&mut self, fields: &mut Fields<'_>) -> Result<Springs> {
        Err(fields.refuse(Reason::WrongKind, "", SolidMaterial::FOLLOWS))
    }

    fn with_cells(&self, cell_m: f64) -> Option<Self> {
        let (source, size) = (self.shape.source().clone(), CellSize::Edge(cell_m));
        let shape = SolidShape::of(source, size, self.shape.fixed(), &Limits::default()).ok()?;
        let solid = Solid::new(Arc::new(shape), self.material).with_layers(&self.layers, "layer").ok()?;
        solid.with_foundation(self.foundation.n_per_m3).map(|solid| solid.with_gravity(self.gravity)).ok()
    }

    /// A block of full cubes of the stiffest material, held below.
    fn part(&self, side: usize) -> (Self, [PointId; 3]) {
        let mut cells = 1;
        while (cells + 2_usize).pow(3) <= side * side {
            cells += 1;
        }
        let shape = SolidShape::block(cells, self.shape.lattice().edge_m);
        let mut part = Solid::new(Arc::new(shape), self.material);
        part.largest_factor = self.largest_factor;
        part.weights = part.weights.iter().map(|weight| weight * self.largest_factor).collect();
        let middle = cells / 2;
        let points = [[middle, middle, cells], [cells, middle, middle], [0, 0, cells]];
        let looked_at = points.map(|node| part.shape.point_at(node).unwrap_or_else(|| PointId::new(0)));
        (part, looked_at)
    }
}

impl BodyKind for Solid {
    fn section(&self) -> &'static str {
        Self::SECTION
    }

    fn points_key(&self) -> &'static str {
        "solid.cell_m"
    }

    fn unit_hint(&self) -> &'static str {
        "solid.unit says which unit its file is in"
    }

    fn shape(&self) -> &dyn RestShape {
        &*self.shape
    }

    fn shared_shape(&self) -> Arc<dyn RestShape> {
        self.shape.clone()
    }

    /// Returns the mass of a full cube, kg.
    fn point_mass_kg(&self) -> f64 {
        self.material.density_kg_per_m3 * self.shape.lattice().edge_m.powi(3)
    }

    fn mass_kg(&self) -> f64 {
        self.point_mass_kg() * self.masses.iter().sum::<f64>()
    }

    fn relative_mass(&self, point: PointId) -> f64 {
        self.masses.get(point.index()).copied().unwrap_or(1.0)
    }

    /// Returns the relative mass: K″/m is the same at every point.
    fn relative_anchor_stiffness(&self, point: PointId) -> f64 {
        self.relative_mass(point)
    }

    fn mesh(&self) -> Option<TriangleMesh> {
        Some(self.shape.source().clone())
    }

    fn identify(&self, _order: &[u32], add: &mut dyn FnMut(&[u8])) {
        add(b"solid");
        let Lattice { origin_m, edge_m, cells } = *self.shape.lattice();
        let SolidMaterial { poissons_ratio, viscosity_pa_s, .. } = self.material;
        // Snapshots of elastic solids are older.
        let viscosity = (viscosity_pa_s > 0.0).then_some(viscosity_pa_s);
        for number in origin_m.to_array().into_iter().chain([edge_m, poissons_ratio]).chain(viscosity) {
            add(&number.to_bits().to_le_bytes());
        }
        cells.iter().for_each(|count| add(&(*count as u64).to_le_bytes()));
        if self.foundation.n_per_m3 > 0.0 || self.gravity != Gravity::default() {
            let pull_m_per_s2 = self.gravity.pull_m_per_s2().to_array();
            let numbers = pull_m_per_s2.into_iter().chain([self.foundation.n_per_m3]);
            numbers.for_each(|number| add(&number.to_bits().to_le_bytes()));
        }
        for Branch { shear_modulus_pa, time_s } in self.material.branches.iter() {
            [*shear_modulus_pa, *time_s].iter().for_each(|number| add(&number.to_bits().to_le_bytes()));
        }
        self.weights.iter().for_each(|weight| add(&weight.to_bits().to_le_bytes()));
        for point in crate::shape::points(&*self.shape) {
            add(&[u8::from(self.shape.is_fixed(point))]);
        }
        for vertex_m in self.shape.surface().vertices_m() {
            vertex_m.to_array().iter().for_each(|value| add(&value.to_bits().to_le_bytes()));
        }
        self.shape.surface().triangles().iter().flatten().for_each(|corner| add(&corner.to_le_bytes()));
    }

    fn spring_bound_n_per_m(&self, springs: &Springs, _anchor_n_per_m: f64) -> f64 {
        springs.stiffness_n_per_m * self.bound() + self.foundation.bound_n_per_m
    }

    /// Returns m·ω² of the slowest vibration ω. With forces on the points that are at most m·ω²·d of each mass m, the
    /// displacement, squared and averaged over the mass, is at most d².
    fn restoring_n_per_m(&self, springs: &Springs, _anchor_n_per_m: f64) -> f64 {
        let lame = [self.material.shear_over_youngs(), self.material.lame_over_youngs()];
        let beds = |point| self.foundation_n_per_m(point) / self.stiffness_n_per_m();
        springs.stiffness_n_per_m * self.slowest.of(&self.shape, &self.weights, lame, beds)
    }

    fn slowest_vibration(&self) -> &'static str {
        "all of it"
    }

    fn warnings(&self) -> Vec<String> {
        self.shape.findings().to_vec()
    }

    /// A depth of a solid takes as long as hundreds of steps, and an even pressure on a disc hardly stiffens it: a block of
    /// 3 mm cubes gives way to 2 mm with 5 % less stiffness than to 0.02 mm.
    fn law_is_linear(&self) -> bool {
        true
    }

    /// The error of the cells is larger: some per cent.
    fn usual_stepping(&self) -> Stepping {
        Stepping { tolerance: 1e-2, ..Stepping::default() }
    }

    fn cells(&self) -> Option<usize> {
        Some(self.weights.iter().filter(|weight| **weight > 0.0).count())
    }

    /// Measured on one core with AVX-512: 4.1 ns a point and substep of 20,000, where a sheet takes 1.7; with AVX2 7.7.
    fn relative_cost(&self) -> f64 {
        2.5
    }

    /// A cube's law costs as much with every scheme.
    fn scheme_cost(&self, of_sweeps: f64) -> f64 {
        1.0 + (of_sweeps - 1.0) / self.relative_cost()
    }

    fn viscous_time_s(&self) -> f64 {
        self.material.viscous_time_s()
    }

    fn branches(&self) -> [MaxwellBranch; MAX_BRANCHES] {
        self.material.branches.relative_to(self.material.shear_pa())
    }

    /// A rehearsal pushes points of a small block, and a whole solid also has slower vibrations. (300 random solids at two tolerances:
    /// at most 4.7 times, half of them 0.07 times. What `stormer` errs by in a viscous solid depends less on the motion: of 171 choices
    /// at most 3.3 times, three of them more than 1.5 times. With branches, of 86 choices at most 6.9 times, six of them more than 3.4
    /// times.)
    fn rehearsal_margin(&self, integrator: Integrator) -> f64 {
        match integrator {
            _ if self.material.branches.iter().next().is_some() => 7.0,
            Integrator::Stormer if self.viscous_time_s() > 0.0 => 3.4,
            _ => 5.0,
        }
    }

    /// With it a rehearsed block is strained by about a tenth, and not so far that the limits of the law count.
    fn rehearsal_strength(&self) -> f64 {
        0.2
    }

    fn table_bytes(&self) -> u64 {
        const OF_A_CELL: usize = 48;
        const OF_A_VERTEX: usize = 400;
        (OF_A_CELL * self.weights.len() + OF_A_VERTEX * self.shape.surface().vertices_m().len()) as u64
    }

    fn check(&self, limits: &Limits) -> Result<()> {
        let count = self.shape.place_count();
        if count > limits.points {
            let message = format!("gives {count} points, above the limit of {} points in all", limits.points);
            return Err(Refusal::new(Reason::TooLarge, self.points_key(), message));
        }
        physical("solid.cell_m", self.shape.lattice().edge_m)?;
        self.gravity.check()?;
        self.material.check()
    }
}

/// Returns the factor of E of a cube of which `part` has a factor.
fn mixed(factor: f64, part: f64) -> f64 {
    libm::pow(part * libm::pow(factor, MIXING) + (1.0 - part), 1.0 / MIXING)
}

impl Inclusion {
    /// Returns how much of a cube is inside a ball, 0 to 1: the mean of [`Inclusion`]'s p at `looks`³ places.
    fn mean_part(&self, lattice: &Lattice, cell: [usize; 3], looks: usize) -> f64 {
        let Region::Ball { centre_m, radius_m } = &self.region else { return 0.0 };
        let places = places_in_cube(lattice.middle_m(cell), lattice.edge_m, looks);
        let sum: f64 = places.map(|place_m| self.part_beyond(place_m.distance(*centre_m) - radius_m)).sum();
        sum / looks.pow(3) as f64
    }
}

/// Reads the material of a solid, its branches, layers and gravity, and refuses the sections that it replaces.
pub(super) fn read_material(
    fields: &mut Fields<'_>,
    solid: &Solid,
    material: Option<&Item<'_>>,
    branches: Option<&Item<'_>>,
    layers: Option<&Item<'_>>,
    gravity: Option<&Item<'_>>,
) -> Result<Solid> {
    for section in ["springs", "anchor_springs", "damping"] {
        if let Some(other) = fields.item(section) {
            return Err(other.refuse(Reason::WrongKind, SolidMaterial::FOLLOWS));
        }
    }
    let Some(material) = material else { return Err(fields.refuse(Reason::Missing, "material", "is missing")) };
    let branches = branches.map_or(Ok(Branches::default()), Branches::read)?;
    let material = SolidMaterial { branches, ..material.table(SolidMaterial::read)? };
    let solid = solid.of_material(material);
    let solid = solid.with_gravity(gravity.map_or(Ok(Gravity::default()), Gravity::read)?);
    let Some(layers) = layers else { return Ok(solid) };
    solid.with_layers(&layers.tables()?.iter().map(Layer::read).collect::<Result<Vec<_>>>()?, "layer")
}
