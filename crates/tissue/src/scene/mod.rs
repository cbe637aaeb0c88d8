//! A scene describes the tissue, its springs, and how time advances. It is read from TOML here, or from a protobuf
//! message by the session's module `wire`, and checked. A running tissue changes only the coefficients of its copy.

pub mod action;
pub mod action_check;
mod body;
pub mod collection;
mod cutting;
mod eigenvalue;
pub mod exercise;
pub mod exercise_reader;
pub mod graph;
pub mod kind;
mod material;
mod membrane;
mod mesh;
mod named;
pub mod plot;
pub mod profile;
pub mod record;
pub mod script;
pub mod script_reader;
pub mod sent;
mod sheet;
mod shown;
mod solid;
mod source;
mod springs;
mod stepping;
pub mod tie;
pub mod tissue_parameter;
pub mod toml_document;
mod volume;
mod zero;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::files;
use crate::limits::Limits;
use crate::shape::{PointId, RestShape};
use action_check::physical;
use body::KindOfBody;
pub use body::{BodyKind, MAX_BRANCHES, MaxwellBranch, StiffnessBound};
pub use cutting::Cutting;
use exercise::Lump;
use kind::TextKind;
pub use material::{Inclusion, MadeOf, Material, Region};
use mesh::read_bending;
pub use mesh::{FixedVertices, Mesh, MeshMetadata, MeshShape, PerNodeFactors};
pub use named::Named;
use palpate_refusal::{Reason, Refusal, Result, not_negative, number, positive};
pub use sheet::{FixedPoints, MIN_WIDTH, PointSet, Sheet, largest_stiffness_of_a_sheet_n_per_m};
pub use shown::{Shown, Simulated};
pub(crate) use solid::trilinear;
pub use solid::{Branch, Branches, CellSize, FixedPart, Gravity, Layer, Solid, SolidMaterial, SolidShape};
use source::Files;
pub use springs::{MAX_PRESTRAIN, Springs};
pub use stepping::{Integrator, Lanes, Precision, Stepping};
use toml_document::{Document, Fields, Item};
pub use volume::{Swelling, Volume};

/// The TOML text of the built-in scene `paper`, a sheet, which the paper's figures use. [`Scene::parse`] reads
/// it.
pub const PAPER: &str = include_str!("../../../../scenes/paper.toml");

/// The built-in scenes: name and TOML text, by ascending name. Some have a mesh, which is generated: none names
/// a file.
pub const BUILT_IN: [(&str, &str); 12] = [
    ("colon", include_str!("../../../../scenes/colon.toml")),
    ("fibrotic", include_str!("../../../../scenes/fibrotic.toml")),
    ("gallbladder", include_str!("../../../../scenes/gallbladder.toml")),
    ("gallbladder-bed", include_str!("../../../../scenes/gallbladder-bed.toml")),
    ("kidney", include_str!("../../../../scenes/kidney.toml")),
    ("liver", include_str!("../../../../scenes/liver.toml")),
    ("liver-organ", include_str!("../../../../scenes/liver-organ.toml")),
    ("liver-solid", include_str!("../../../../scenes/liver-solid.toml")),
    ("paper", PAPER),
    ("phantom", include_str!("../../../../scenes/phantom.toml")),
    ("prostate", include_str!("../../../../scenes/prostate.toml")),
    ("stomach", include_str!("../../../../scenes/stomach.toml")),
];

/// A tissue and how it is stepped. The fields are those of a scene file, in SI units.
///
/// A scene is a text in TOML. Reading refuses every error with its file, line and key:
///
/// ```
/// use palpate_refusal::Reason;
/// use palpate_tissue::limits::Limits;
/// use palpate_tissue::scene::{PAPER, Scene};
///
/// let limits = Limits::default();
/// let scene = Scene::parse("paper", PAPER, &["sheet.point_mass_kg=0.02".to_owned()], &limits)?;
/// // 31 × 31 points of 20 g.
/// assert!((scene.mass_kg() - 19.22).abs() < 1e-9, "{} kg", scene.mass_kg());
/// assert_eq!(scene.anchor_stiffness_n_per_m, 5.0);
///
/// let refusal = Scene::parse("paper", PAPER, &["sheet.spacing=0.01".to_owned()], &limits).expect_err("no such key");
/// assert_eq!(refusal.reason, Reason::UnknownKey);
/// println!("{refusal}");
/// # Ok::<(), palpate_refusal::Refusal>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// Display name: at most 128 bytes, without control characters ([`Scene::check`]). `unnamed` if the text
    /// gives none.
    pub name: String,
    /// The mass points, and how they are arranged.
    pub body: Body,
    /// The material that the masses and coefficients were computed from; `None` if the scene gives them
    /// directly.
    pub material: Option<Material>,
    /// Regions of a mesh that are stiffer or softer, in the order of the file; empty on a sheet. Their factors
    /// are already applied to the springs of `body`.
    pub inclusions: Arc<[Inclusion]>,
    /// Lumps that were added beside the inclusions while a session ran ([`Scene::with_added_lumps`]); their factors are applied as well.
    pub added_lumps: Arc<[Lump]>,
    /// Springs between neighbours; on a mesh, their reference k.
    pub springs: Springs,
    /// K″ of the springs of zero rest length that pull each point to its rest position, N/m (the paper's eq.
    /// 4); 0 for none. On a mesh, the reference K″ ([`Scene::relative_anchor_stiffness`]).
    pub anchor_stiffness_n_per_m: f64,
    /// C of the damping force −C·v, N·s/m. On a mesh, C of a point of the reference mass.
    pub damping_n_s_per_m: f64,
    /// κ of the pressure −κ·ΔV/V0 on a mesh that encloses a volume V0 (ΔV is its growth), Pa; 0 on any other
    /// tissue.
    pub volume_stiffness_pa: f64,
    /// How time advances, as the user asked for it; what is used, `Model` has.
    pub stepping: Stepping,
    /// Largest error that leaving out regions at rest may add, relative to the largest displacement, 0 to 1; 0
    /// turns sleeping off. If `None`, it is a tenth of the wanted error (`stepping.tolerance`), or of the
    /// expected one if that is smaller and the scene gives the integrator or the substeps; see
    /// `Model::sleep_tolerance`.
    pub sleep_tolerance: Option<f64>,
    /// How viewers draw the tissue; without effect on its motion.
    pub appearance: Appearance,
    /// How the tissue resists a blade.
    pub cutting: Cutting,
}

/// Writes [`Body`] and what it asks of each kind, from one list: a kind of tissue is a line there.
macro_rules! kinds {
    ($($(#[$of_kind:meta])* $Kind:ident,)+) => {
        /// The mass points of a tissue, where they rest and how they are joined. [`Body::kind`] answers for every kind;
        /// [`Scene::shape`] gives the points.
        #[derive(Debug, Clone, PartialEq)]
        pub enum Body {
            $($(#[$of_kind])* $Kind($Kind),)+
        }

        impl Body {
            /// The sections that describe the points of a tissue, one for each kind.
            pub(crate) const SECTIONS: &'static [&'static str] = &[$($Kind::SECTION),+];

            /// Returns what every kind of tissue answers.
            pub fn kind(&self) -> &dyn BodyKind {
                match self {
                    $(Body::$Kind(kind) => kind,)+
                }
            }

            /// Reads a section, of which the document has one: see [`KindOfBody::read`].
            fn read(
                section: &str,
                fields: &mut Fields<'_>,
                files: Files<'_>,
                of_material: bool,
                limits: &Limits,
            ) -> Result<Self> {
                match section {
                    $($Kind::SECTION => $Kind::read(fields, files, of_material, limits).map(Body::$Kind),)+
                    _ => Err(fields.refuse(Reason::UnknownKey, "", "is not a kind of tissue")),
                }
            }

            /// Reads the section `[springs]`.
            fn read_springs(&mut self, fields: &mut Fields<'_>) -> Result<Springs> {
                match self {
                    $(Body::$Kind(kind) => kind.read_springs(fields),)+
                }
            }

            /// Returns a small part of the tissue that vibrates as fast as the whole, for test runs: at most `side`²
            /// points, not all of them fixed. `side` is at least 1. Also returns three points of the part, in its own
            /// numbers, to push or to watch; the first one is free to move, and they may coincide.
            pub fn part(&self, side: usize) -> (Body, [PointId; 3]) {
                match self {
                    $(Body::$Kind(kind) => {
                        let (part, points) = kind.part(side);
                        (Body::$Kind(part), points)
                    })+
                }
            }

            /// Returns the same tissue with points `spacing_m` (m) apart, each of which replaces several, and the number
            /// of points that one replaces. It reaches `half_m` (m) from the middle, where it is held, or is the whole
            /// tissue if that is not larger. `None` if the tissue is not uniform ([`RestShape::is_uniform`]).
            pub fn coarser(&self, spacing_m: f64, half_m: f64) -> Option<(Body, f64)> {
                match self {
                    $(Body::$Kind(kind) => {
                        kind.coarser(spacing_m, half_m).map(|(coarse, replaced)| (Body::$Kind(coarse), replaced))
                    })+
                }
            }

            fn with_cells(&self, cell_m: f64) -> Option<Body> {
                match self {
                    $(Body::$Kind(kind) => kind.with_cells(cell_m).map(Body::$Kind),)+
                }
            }
        }
    };
}

kinds! {
    /// A rectangular grid.
    Sheet,
    /// The surface of a triangle mesh.
    Mesh,
    /// A lattice of cubes that fills a closed surface.
    Solid,
}

/// Smallest side of a generated texture: 16 pixels. The largest is the limit `texture_side`.
pub const SMALLEST_TEXTURE: u32 = 16;

/// How a tissue looks: an image for its surface, read or generated. Clients cannot set it, because it names a
/// file on the server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Appearance {
    /// The path of a PNG image for the surface; it is not read here. If `None`, the server generates an image
    /// from the other fields, which don't count otherwise.
    pub texture: Option<PathBuf>,
    /// What a generated image shows. Default: [`PaintedSurface::Mucosa`].
    pub surface: PaintedSurface,
    /// Seed of the generated image: another seed gives another pattern. Default: 1.
    pub texture_seed: u64,
    /// Pixels along each side of the generated image, from [`SMALLEST_TEXTURE`] to the limit `texture_side`.
    /// Default: 1024.
    pub texture_size: u32,
}

impl Default for Appearance {
    fn default() -> Self {
        Appearance { texture: None, surface: PaintedSurface::Mucosa, texture_seed: 1, texture_size: 1024 }
    }
}

impl Appearance {
    /// Returns the appearance with the image's path resolved from `folder`, the folder of the scene file.
    fn within(mut self, folder: &Path) -> Self {
        self.texture = self.texture.map(|path| folder.join(path));
        self
    }
}

/// Surfaces that the server can paint: what a generated image shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PaintedSurface {
    /// The lining of a stomach.
    Mucosa,
    /// The capsule of a liver.
    Liver,
    /// A fibrotic liver: nodules in a network of scars.
    Nodular,
    /// The outside of a gallbladder, grey-green from the bile inside.
    Serosa,
}

impl Named for PaintedSurface {
    const NAMES: &'static [(&'static str, Self)] = &[
        ("mucosa", PaintedSurface::Mucosa),
        ("liver", PaintedSurface::Liver),
        ("nodular", PaintedSurface::Nodular),
        ("serosa", PaintedSurface::Serosa),
    ];
}

/// Coefficients of a tissue to change while it is in use. `None` leaves a coefficient as it is; a change with
/// `None` only is refused where it is applied ([`Change::NOTHING`]). `Model::changed`
/// applies one.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Change {
    /// k of the structural springs, N/m; on a mesh, the reference k. The k of shear and bending springs changes
    /// in proportion ([`Scene::changed`]).
    pub stiffness_n_per_m: Option<f64>,
    /// C of the damping force −C·v of a point of the reference mass, N·s/m.
    pub damping_n_s_per_m: Option<f64>,
    /// K″ of the springs that pull each point to its rest position, N/m; on a mesh, the reference K″.
    pub anchor_stiffness_n_per_m: Option<f64>,
    /// κ of the pressure in a mesh that encloses a volume, Pa. Above 0 it is refused for a tissue without
    /// `[volume]`.
    pub volume_stiffness_pa: Option<f64>,
}

impl Change {
    /// Message of the refusal of a change that changes nothing ([`Reason::Missing`]).
    pub const NOTHING: &str = "names nothing to change: stiffness_n_per_m, damping_n_s_per_m, anchor_stiffness_n_per_m or \
                               volume_stiffness_pa";
}

impl Scene {
    /// Returns the scene of the same tissue with cells of `cell_m` (m), unchecked. `None` for a tissue without cells, and if
    /// such cells do not fit.
    pub(crate) fn with_cells(&self, cell_m: f64) -> Option<Scene> {
        // k is E times the edge of a cell, and C that of a full cell.
        let ratio = cell_m / self.shape().edge_m();
        let bare = Substance {
            body: self.body.with_cells(cell_m)?,
            material: None,
            inclusions: Arc::default(),
            springs: Springs::alike(self.springs.stiffness_n_per_m * ratio),
            anchor_stiffness_n_per_m: self.anchor_stiffness_n_per_m,
            damping_n_s_per_m: self.damping_n_s_per_m * ratio.powi(3),
            volume_stiffness_pa: self.volume_stiffness_pa,
        };
        let Substance { body, springs, damping_n_s_per_m, .. } = bare.with(self.all_inclusions(), "inclusion").ok()?;
        Some(Scene { body, springs, damping_n_s_per_m, ..self.clone() })
    }

    /// Returns the inclusions, and behind them the lumps that were added.
    pub fn all_inclusions(&self) -> Vec<Inclusion> {
        self.inclusions.iter().cloned().chain(self.added_lumps.iter().map(Inclusion::of_lump)).collect()
    }

    /// Returns the scene of the same tissue with these lumps beside its inclusions, in place of those that were added before. Nothing
    /// else differs: not the points, nor their masses.
    ///
    /// # Errors
    /// Refuses a tissue that can have no lumps, one of them that reaches nothing of it, and more inclusions than a tissue may have, with
    /// the field `lump`.
    pub fn with_added_lumps(&self, lumps: &[Lump]) -> Result<Self> {
        if matches!(self.body, Body::Sheet(_)) && !lumps.is_empty() {
            return Err(Refusal::new(Reason::WrongKind, "lump", Material::OF_A_MESH));
        }
        let scene = Scene { added_lumps: lumps.into(), ..self.clone() };
        let body = self.body_with(scene.all_inclusions(), "lump")?;
        Ok(Scene { body, ..scene })
    }

    /// Returns the scene of the same tissue without its inclusions and lumps.
    ///
    /// # Errors
    /// Refuses a mesh that does not enclose its volume any more, which no scene has that was read.
    pub fn without_inclusions(&self) -> Result<Self> {
        self.with_inclusions(Vec::new())
    }

    /// Returns the scene with a lump in place of its inclusions.
    ///
    /// # Errors
    /// Refuses what [`Scene::without_inclusions`] refuses, a lump in a tissue that can have none, and one that reaches nothing of it.
    pub fn with_lump(&self, lump: &Lump) -> Result<Self> {
        self.with_inclusions(vec![Inclusion::of_lump(lump)])
    }

    fn with_inclusions(&self, inclusions: Vec<Inclusion>) -> Result<Self> {
        let body = self.body_with(inclusions.clone(), "inclusion")?;
        Ok(Scene { body, inclusions: inclusions.into(), added_lumps: Arc::default(), ..self.clone() })
    }

    /// Returns the body with inclusions in place of all that it has; `field` is the key of the list in refusals.
    fn body_with(&self, inclusions: Vec<Inclusion>, field: &str) -> Result<Body> {
        let substance = Substance {
            body: self.body.clone(),
            material: None,
            inclusions: Arc::default(),
            springs: self.springs.clone(),
            anchor_stiffness_n_per_m: self.anchor_stiffness_n_per_m,
            damping_n_s_per_m: self.damping_n_s_per_m,
            volume_stiffness_pa: self.volume_stiffness_pa,
        };
        match substance.with(inclusions, field)?.body {
            // Its volume is there, however soft.
            Body::Mesh(mesh) if self.volume().is_some() => Ok(Body::Mesh(mesh.enclosing()?)),
            body => Ok(body),
        }
    }

    /// Reads a scene file and applies the `--set` assignments (`key.path=value`), in their order, which
    /// override its keys. The path may be a pipe. Paths of other files start from the file's folder; limits
    /// bound what is read.
    ///
    /// # Errors
    /// Refuses a file that can't be read, is not UTF-8 or has more than `limits.file_bytes` bytes
    /// ([`files::read_text`]), and every text or assignment that [`Scene::parse_in`] refuses.
    pub fn load(path: &Path, assignments: &[String], limits: &Limits) -> Result<Self> {
        let text = files::read_text(path, limits.file_bytes)?;
        let folder = path.parent().unwrap_or(Path::new(""));
        Self::parse_in(folder, &path.display().to_string(), &text, assignments, limits)
    }

    /// Reads a scene from text and applies the assignments (`key.path=value`), which override its keys. Paths
    /// of other files start from `folder`; refusals call the text `name`. A mesh file is read, an image is only
    /// named.
    ///
    /// # Errors
    /// Refuses
    ///
    /// - a text that is not TOML, a script, unknown and missing keys, and values of the wrong kind;
    /// - an assignment that [`Document::set`] refuses;
    /// - a value beyond its range or a limit ([`Scene::check`]);
    /// - a mesh file that can't be read, has more than `limits.mesh_bytes` bytes or is not a surface;
    /// - a material, inclusion or volume that does not suit the tissue.
    pub fn parse_in(folder: &Path, name: &str, text: &str, assignments: &[String], limits: &Limits) -> Result<Self> {
        let scene = Self::parse_with(name, text, assignments, Files::In(folder), limits)?;
        Ok(Scene { appearance: scene.appearance.within(folder), ..scene })
    }

    /// Reads a scene from text and applies the assignments (`key.path=value`), which override its keys. It may
    /// name no other files, except for an image, whose path stays as written; refusals call the text `name`.
    ///
    /// # Errors
    /// Refuses everything that [`Scene::parse_in`] refuses, and a text that names a mesh file
    /// ([`Reason::WrongKind`]).
    pub fn parse(name: &str, text: &str, assignments: &[String], limits: &Limits) -> Result<Self> {
        Self::parse_with(name, text, assignments, Files::None, limits)
    }

    /// Reads a scene from text, with the mesh file that its `[mesh]` names: the file's name, as the text has
    /// it, and bytes. The scene may name no other files, except for an image; refusals call the text `name`. A
    /// file that is not named is ignored.
    ///
    /// # Errors
    /// Refuses everything that [`Scene::parse_in`] refuses, and a scene that names another mesh file
    /// ([`Reason::WrongKind`]).
    pub fn parse_given(name: &str, text: &str, (mesh_name, mesh): (&str, &[u8]), limits: &Limits) -> Result<Self> {
        Self::parse_with(name, text, &[], Files::Given(mesh_name, mesh), limits)
    }

    fn parse_with(name: &str, text: &str, assignments: &[String], files: Files<'_>, limits: &Limits) -> Result<Self> {
        let mut document = Document::parse(name, text)?;
        TextKind::Scene.check(&document)?;
        for assignment in assignments {
            document.set(assignment)?;
        }
        let scene = document.read(|fields| {
            let name = fields.text("name")?.unwrap_or_else(|| "unnamed".to_owned());
            let substance = read_substance(fields, files, limits)?;
            let stepping = substance.body.kind().usual_stepping();
            Ok(Scene {
                name,
                body: substance.body,
                material: substance.material,
                inclusions: substance.inclusions,
                added_lumps: Arc::default(),
                springs: substance.springs,
                anchor_stiffness_n_per_m: substance.anchor_stiffness_n_per_m,
                damping_n_s_per_m: substance.damping_n_s_per_m,
                volume_stiffness_pa: substance.volume_stiffness_pa,
                stepping: match fields.item("stepping") {
                    Some(item) => Stepping::read(&item, stepping)?,
                    None => stepping,
                },
                sleep_tolerance: match fields.item("sleep") {
                    Some(item) => item.table(|fields| fields.number("tolerance"))?,
                    None => None,
                },
                cutting: fields.item("cutting").map_or(Ok(Cutting::default()), |item| Cutting::read(&item))?,
                appearance: fields
                    .item("appearance")
                    .map_or(Ok(Appearance::default()), |item| read_appearance(&item, limits))?,
            })
        })?;
        scene.check(limits).map_err(|refusal| document.locate(refusal))?;
        Ok(scene)
    }

    /// Returns the scene with some coefficients changed, unchecked: see [`Scene::check`]. `first` is the scene
    /// that the session began with. A new k of the structural springs changes that of the shear springs by the
    /// ratio that they have in `first`, because a k of 0 in between would lose the ratio; if k is 0 in `first`,
    /// the shear springs keep the value of `first`.
    pub fn changed(&self, change: &Change, first: &Scene) -> Self {
        let mut scene = self.clone();
        if let Some(k) = change.stiffness_n_per_m {
            let Springs { stiffness_n_per_m, shear_stiffness_n_per_m, .. } = first.springs;
            scene.springs.stiffness_n_per_m = k;
            scene.springs.shear_stiffness_n_per_m = if shear_stiffness_n_per_m == stiffness_n_per_m {
                k
            } else if stiffness_n_per_m > 0.0 {
                k * (shear_stiffness_n_per_m / stiffness_n_per_m)
            } else {
                shear_stiffness_n_per_m
            };
        }
        scene.damping_n_s_per_m = change.damping_n_s_per_m.unwrap_or(scene.damping_n_s_per_m);
        scene.anchor_stiffness_n_per_m = change.anchor_stiffness_n_per_m.unwrap_or(scene.anchor_stiffness_n_per_m);
        scene.volume_stiffness_pa = change.volume_stiffness_pa.unwrap_or(scene.volume_stiffness_pa);
        scene
    }

    /// Returns by which part of its length the pretension stretches each spring at rest; 0 without.
    pub fn prestrain(&self) -> f64 {
        self.body.kind().prestrain(&self.springs)
    }

    fn check_pretension(&self) -> Result<()> {
        let prestrain = self.prestrain();
        if self.springs.pretension_n_per_m > 0.0 && matches!(self.body, Body::Solid(_)) {
            let message = "is for sheets and surfaces: a solid has none";
            return Err(Refusal::new(Reason::WrongKind, "springs.pretension_n_per_m", message));
        }
        // NaN is not below it.
        if prestrain <= MAX_PRESTRAIN {
            return Ok(());
        }
        let (most, field) = (MAX_PRESTRAIN * self.springs.pretension_n_per_m / prestrain, "springs.pretension_n_per_m");
        let message = format!(
            "would stretch each spring by {:.0} % at rest: springs of this stiffness bear at most {:.3} N/m",
            100.0 * prestrain,
            if most.is_finite() { most } else { 0.0 }
        );
        Err(Refusal::new(Reason::OutOfRange, field, message))
    }

    /// Returns the rest shape of the tissue, borrowed: its sheet or mesh.
    pub fn shape(&self) -> &dyn RestShape {
        self.body.kind().shape()
    }

    /// Returns the grid, borrowed; `None` if the tissue is a mesh.
    pub fn sheet(&self) -> Option<&Sheet> {
        if let Body::Sheet(sheet) = &self.body { Some(sheet) } else { None }
    }

    /// Returns the grid, mutable; `None` if the tissue is a mesh. Check the scene after changing it
    /// ([`Scene::check`]).
    pub fn sheet_mut(&mut self) -> Option<&mut Sheet> {
        if let Body::Sheet(sheet) = &mut self.body { Some(sheet) } else { None }
    }

    /// Returns the triangle mesh that belongs to the scene besides its text: clients upload it, journals and other
    /// servers keep it, and frames show it. `None` if the text describes the whole tissue.
    pub fn mesh(&self) -> Option<&Mesh> {
        if let Body::Mesh(mesh) = &self.body { Some(mesh) } else { None }
    }

    /// Returns the volume that a mesh encloses; `None` if the scene has no `[volume]`, as on any sheet.
    pub fn volume(&self) -> Option<&Volume> {
        self.body.kind().volume()
    }

    /// Returns whether the vibration in which the enclosed volume swells and shrinks is faster than the bound
    /// for the springs alone, so that it decides on the substeps. False without a volume.
    pub fn volume_is_fastest(&self) -> bool {
        self.body.kind().volume_is_fastest(&self.springs, self.volume_stiffness_pa)
    }

    /// Returns the mass of each point of a sheet, or the reference mass of a mesh, kg: for a material, that of
    /// a vertex of mean area.
    pub fn point_mass_kg(&self) -> f64 {
        self.body.kind().point_mass_kg()
    }

    /// Returns the mass of a point divided by the reference mass [`Scene::point_mass_kg`]; 1 on a sheet, and
    /// for a point that a mesh does not have. C of the point is `damping_n_s_per_m` times this ratio.
    pub fn relative_mass(&self, point: PointId) -> f64 {
        self.body.kind().relative_mass(point)
    }

    /// Returns K″ of a point divided by the reference value `anchor_stiffness_n_per_m`; 1 on a sheet, and for a
    /// point that a mesh does not have.
    pub fn relative_anchor_stiffness(&self, point: PointId) -> f64 {
        self.body.kind().relative_anchor_stiffness(point)
    }

    /// Returns the mass of all points, kg, fixed ones included; on a mesh, of those with an edge.
    pub fn mass_kg(&self) -> f64 {
        self.body.kind().mass_kg()
    }

    /// Returns the rest shape as a shared pointer that can outlive the scene: a copy of a sheet, or the mesh
    /// itself.
    pub fn shared_shape(&self) -> Arc<dyn RestShape> {
        self.body.kind().shared_shape()
    }

    /// Checks that every value is in its range and within the limits. It holds for scenes from files and from
    /// messages; reading a scene does it as well. Material, inclusions and appearance are not checked here.
    ///
    /// # Errors
    /// Refuses
    ///
    /// - a name of more than 128 bytes or with control characters;
    /// - no points, or more than `limits.points`; on a sheet, rows of fewer than [`MIN_WIDTH`] points count as
    ///   that many;
    /// - a spacing, mass or mean edge beyond 1e-12 to 1e12; a stiffness or damping that is neither 0 nor in
    ///   this range;
    /// - a fixed point that is not on the sheet; a stiffness of a volume above 0 without a volume;
    /// - a rate beyond 1e-3 to 1e7 Hz, a tolerance that is not above 0 and at most 1, a sleep tolerance beyond
    ///   0 to 1;
    /// - substeps beyond 1 to `limits.substeps`.
    pub fn check(&self, limits: &Limits) -> Result<()> {
        palpate_refusal::label("name", &self.name)?;
        self.body.kind().check(limits)?;
        let coefficients = [
            ("springs.stiffness_n_per_m", self.springs.stiffness_n_per_m),
            ("springs.shear_stiffness_n_per_m", self.springs.shear_stiffness_n_per_m),
            ("springs.pretension_n_per_m", self.springs.pretension_n_per_m),
            ("anchor_springs.stiffness_n_per_m", self.anchor_stiffness_n_per_m),
            ("damping.coefficient_n_s_per_m", self.damping_n_s_per_m),
            ("volume.stiffness_pa", self.volume_stiffness_pa),
        ];
        for (field, value) in coefficients {
            if not_negative(field, value)? > 0.0 {
                physical(field, value)?;
            }
        }
        if self.volume_stiffness_pa > 0.0 && self.volume().is_none() {
            return Err(Refusal::new(Reason::WrongKind, "volume.stiffness_pa", Volume::FROM_THE_BEGINNING));
        }
        self.check_pretension()?;
        self.cutting.check(!matches!(self.body, Body::Solid(_)), self.springs.pretension_n_per_m > 0.0)?;
        self.check_integrator()?;
        self.stepping.check(limits)?;
        if let Some(tolerance) = self.sleep_tolerance {
            number("sleep.tolerance", tolerance, "from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
        }
        Ok(())
    }

    /// Refuses an integrator that leaves out a property of the tissue.
    fn check_integrator(&self) -> Result<()> {
        let message = match self.stepping.integrator {
            integrator if !(integrator.takes_anchor_springs() || matches!(self.body, Body::Solid(_))) => {
                "stormer is for [solid], which has no anchor springs"
            }
            Integrator::Rk4 | Integrator::Exponential2 | Integrator::Exponential3 | Integrator::Exponential4
                if MaxwellBranch::any(&self.body.kind().branches()) =>
            {
                "leaves branches out: take stormer, central or lagged"
            }
            Integrator::Rk4 if self.body.kind().viscous_time_s() > 0.0 => {
                "rk4 leaves viscosity out: take another, or set material.viscosity_pa_s to 0"
            }
            _ => return Ok(()),
        };
        Err(Refusal::new(Reason::WrongKind, "stepping.integrator", message))
    }
}

/// The physical part of a [`Scene`]: points, springs and coefficients, without name, stepping and appearance.
/// Its values are not checked until the scene is ([`Scene::check`]).
pub struct Substance {
    /// The mass points.
    pub body: Body,
    /// The material that the masses and coefficients were computed from, if any.
    pub material: Option<Material>,
    /// Regions of a mesh that are stiffer or softer; empty for none. Their factors are already applied to the
    /// springs of `body`.
    pub inclusions: Arc<[Inclusion]>,
    /// Springs between neighbours.
    pub springs: Springs,
    /// K″ of the springs that pull each point to its rest position, N/m; on a mesh, the reference K″.
    pub anchor_stiffness_n_per_m: f64,
    /// C of the damping force −C·v, N·s/m; on a mesh, C of a point of the reference mass.
    pub damping_n_s_per_m: f64,
    /// κ of the pressure in a mesh that encloses a volume, Pa; 0 without a volume.
    pub volume_stiffness_pa: f64,
}

impl Substance {
    /// Creates a mesh of a material, without inclusions and volume. `bending` is the k of each bending spring
    /// relative to the k of the edge that it crosses; 0 creates none.
    ///
    /// # Errors
    /// Refuses what [`Material::applied`] refuses: a value of the material that is out of its range, and a mesh
    /// with a vertex that has edges but no area.
    pub fn of_material(material: Material, bending: f64, shape: Arc<MeshShape>) -> Result<Self> {
        let made = material.applied(bending, shape)?;
        let stiffness_n_per_m = made.stiffness_n_per_m;
        Ok(Substance {
            body: Body::Mesh(made.mesh),
            material: Some(material),
            inclusions: Arc::default(),
            springs: Springs::alike(stiffness_n_per_m),
            anchor_stiffness_n_per_m: made.anchor_stiffness_n_per_m,
            damping_n_s_per_m: made.damping_n_s_per_m,
            volume_stiffness_pa: 0.0,
        })
    }

    /// Creates a solid without inclusions. Its k is E times the edge of a cube.
    pub fn of_solid(solid: Solid) -> Self {
        Substance {
            springs: Springs::alike(solid.stiffness_n_per_m()),
            damping_n_s_per_m: solid.damping_n_s_per_m(),
            body: Body::Solid(solid),
            material: None,
            inclusions: Arc::default(),
            anchor_stiffness_n_per_m: 0.0,
            volume_stiffness_pa: 0.0,
        }
    }

    /// Applies inclusions, if this is a mesh or a solid, in place of a list applied before, on top of its factors; a sheet
    /// stays as it is and its inclusions unchecked. `field` is the key of the list in refusals. Call it before
    /// [`Substance::enclosing`], since it drops the volume of the mesh.
    ///
    /// # Errors
    /// Refuses everything that [`Inclusion::put_into`] refuses: too many inclusions, a value out of its range,
    /// an unknown group, and a ball that reaches no vertex.
    pub fn with(mut self, inclusions: Vec<Inclusion>, field: &str) -> Result<Self> {
        match &mut self.body {
            Body::Mesh(mesh) => *mesh = Inclusion::put_into(&inclusions, field, mesh)?,
            Body::Solid(solid) => *solid = solid.with_inclusions(&inclusions, field)?,
            Body::Sheet(_) => return Ok(self),
        }
        self.inclusions = inclusions.into();
        Ok(self)
    }

    /// Adds the volume that the mesh encloses, with the stiffness κ = `stiffness_pa`, Pa.
    ///
    /// # Errors
    /// Refuses a stiffness beyond 1e-12 to 1e12, a sheet, and a mesh that [`Mesh::enclosing`] refuses: not
    /// closed, of several parts, flat, or with triangles of inconsistent orientation.
    pub fn enclosing(mut self, stiffness_pa: f64) -> Result<Self> {
        physical("volume.stiffness_pa", positive("volume.stiffness_pa", stiffness_pa)?)?;
        self.volume_stiffness_pa = stiffness_pa;
        let Body::Mesh(mesh) = self.body else {
            return Err(Refusal::new(Reason::WrongKind, "volume", Volume::OF_A_MESH));
        };
        Ok(Substance { body: Body::Mesh(mesh.enclosing()?), ..self })
    }
}

/// Reads the section of the kind of tissue, and the sections that give stiffness, mass and damping.
fn read_substance(fields: &mut Fields<'_>, files: Files<'_>, limits: &Limits) -> Result<Substance> {
    let mut given = Body::SECTIONS.iter().filter_map(|section| Some((*section, fields.item(section)?)));
    let (first, second) = (given.next(), given.next());
    let (material, inclusions, volume) = (fields.item("material"), fields.item("inclusion"), fields.item("volume"));
    let (branches, layers, gravity) = (fields.item("branch"), fields.item("layer"), fields.item("gravity"));
    let of_material = material.is_some();
    if let (Some((section, _)), Some((_, other))) = (&first, &second) {
        let message = format!("does not go with [{section}]: a tissue is one of them");
        return Err(other.refuse(Reason::WrongKind, message));
    }
    let section = first.map_or(Body::SECTIONS[0], |(section, _)| section);
    if section == Sheet::SECTION
        && let Some(item) = material.as_ref().or(inclusions.as_ref())
    {
        return Err(item.refuse(Reason::WrongKind, Material::OF_A_MESH));
    }
    if section != Mesh::SECTION
        && let Some(item) = volume
    {
        return Err(item.refuse(Reason::WrongKind, Volume::OF_A_MESH));
    }
    if section != Solid::SECTION
        && let Some((item, message)) = (layers.as_ref().map(|item| (item, Layer::OF_A_SOLID)))
            .or(branches.as_ref().map(|item| (item, Branches::OF_A_SOLID)))
            .or(gravity.as_ref().map(|item| (item, Gravity::OF_A_SOLID)))
    {
        return Err(item.refuse(Reason::WrongKind, message));
    }
    let body = fields.required(section)?.table(|fields| Body::read(section, fields, files, of_material, limits))?;
    let substance = match (body, material) {
        (Body::Solid(solid), material) => Substance::of_solid(solid::read_material(
            fields,
            &solid,
            material.as_ref(),
            branches.as_ref(),
            layers.as_ref(),
            gravity.as_ref(),
        )?),
        (Body::Mesh(mesh), material) => {
            if mesh.shape.point_count() > limits.points {
                mesh.check(limits)?;
            }
            match material {
                None => read_coefficients(fields, Body::Mesh(mesh))?,
                Some(item) => read_material(fields, &item, &mesh)?,
            }
        }
        (body, _) => return read_coefficients(fields, body),
    };
    let substance = match inclusions {
        Some(inclusions) => {
            let inclusions = inclusions.tables()?.iter().map(Inclusion::read).collect::<Result<_>>()?;
            substance.with(inclusions, "inclusion")?
        }
        None => substance,
    };
    let Some(volume) = volume else { return Ok(substance) };
    substance.enclosing(volume.table(|fields| fields.required_number("stiffness_pa"))?)
}

/// Reads the sections that give the coefficients directly, as in the paper.
fn read_coefficients(fields: &mut Fields<'_>, mut body: Body) -> Result<Substance> {
    Ok(Substance {
        springs: fields.required("springs")?.table(|fields| body.read_springs(fields))?,
        body,
        material: None,
        inclusions: Arc::default(),
        anchor_stiffness_n_per_m: fields
            .required("anchor_springs")?
            .table(|fields| fields.required_number("stiffness_n_per_m"))?,
        damping_n_s_per_m: fields
            .required("damping")?
            .table(|fields| fields.required_number("coefficient_n_s_per_m"))?,
        volume_stiffness_pa: 0.0,
    })
}

/// Reads the section `[material]`, and from `[springs]` only the bending, which the material does not
/// determine.
fn read_material(fields: &mut Fields<'_>, item: &Item<'_>, mesh: &Mesh) -> Result<Substance> {
    let material = item.table(Material::read)?;
    let (anchor_springs, damping) = (fields.item("anchor_springs"), fields.item("damping"));
    if let Some(other) = anchor_springs.or(damping) {
        return Err(other.refuse(Reason::WrongKind, Material::FOLLOWS));
    }
    let (bending, pretension_n_per_m) = match fields.item("springs") {
        None => (0.0, 0.0),
        Some(springs) => springs.table(|fields| {
            let (stiffness, shear) = (fields.item("stiffness_n_per_m"), fields.item("shear_stiffness_n_per_m"));
            if let Some(item) = stiffness.or(shear) {
                return Err(item.refuse(Reason::WrongKind, Material::FOLLOWS));
            }
            let bending = fields.item("bending").map_or(Ok(0.0), |item| read_bending(&item))?;
            Ok((bending, fields.number("pretension_n_per_m")?.unwrap_or(0.0)))
        })?,
    };
    let substance = Substance::of_material(material, bending, mesh.shape.clone())?;
    Ok(Substance { springs: Springs { pretension_n_per_m, ..substance.springs }, ..substance })
}

fn read_appearance(item: &Item<'_>, limits: &Limits) -> Result<Appearance> {
    item.table(|fields| {
        let standard = Appearance::default();
        let texture = fields.text("texture")?.map(PathBuf::from);
        let surface = match fields.text("surface")? {
            Some(name) => Some(PaintedSurface::named(&fields.path("surface"), &name)?),
            None => None,
        };
        let seed = fields.item("texture_seed").map(|item| item.whole()).transpose()?;
        let size = fields.item("texture_size").map(|item| item.whole()).transpose()?;
        if texture.is_some() && (surface.is_some() || seed.is_some() || size.is_some()) {
            let message = "names an image: surface, texture_seed and texture_size are for a generated image";
            return Err(fields.refuse(Reason::WrongKind, "texture", message));
        }
        let texture_size = match size {
            Some(size) => {
                let most = limits.texture_side;
                let fits = u32::try_from(size).ok().filter(|size| (SMALLEST_TEXTURE..=most).contains(size));
                let message = format!("must be from {SMALLEST_TEXTURE} to {most} pixels, but is {size}");
                fits.ok_or_else(|| fields.refuse(Reason::OutOfRange, "texture_size", message))?
            }
            None => standard.texture_size,
        };
        Ok(Appearance {
            texture,
            surface: surface.unwrap_or(standard.surface),
            texture_seed: seed.unwrap_or(standard.texture_seed),
            texture_size,
        })
    })
}
