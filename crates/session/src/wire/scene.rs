//! Conversion of scenes, with the fields and defaults of a scene file. Ranges are checked when the scene is
//! compiled.

use std::sync::Arc;

use glam::DVec3;
use palpate_geometry::TriangleMesh;
use palpate_proto::geometry::{from_point, from_vector, point, vector};
use palpate_proto::{pb, scene};

use super::required;
use palpate_refusal::{Reason, Refusal, Result, finite, number, positive};
use palpate_tissue::scene::sent::{self, MeshFile};
use palpate_tissue::scene::{
    Appearance, Body, Branch, Branches, CellSize, Change, Cutting, FixedPart, FixedPoints, FixedVertices, Gravity,
    Inclusion, Integrator, Lanes, Layer, Material, Mesh, Named, PointSet, Precision, Region, Scene, Sheet, Simulated,
    Solid, SolidMaterial, Springs, Stepping, Substance, Volume,
};
use palpate_tissue::shape::RestShape;

/// Returns the scene in a message, with defaults for absent optional fields. `mesh` is the mesh that a scene on a
/// mesh names, which its client has sent before. Ranges of most numbers are checked when the scene is compiled.
///
/// # Errors
/// - [`Reason::Missing`]: a required field or the mesh is absent.
/// - [`Reason::WrongKind`]: a scene has a sheet and a mesh; a field is for the other of the two; coefficients are
///   given beside a material from which they follow; a set of points is unknown.
/// - An integrator, precision or group is unknown; the mesh can't be simulated with that number of vertices; a ball,
///   an inclusion, a factor of bending or a volume is invalid or does not fit the mesh.
pub fn from_scene(message: &pb::Scene, mesh: Option<&TriangleMesh>) -> Result<Scene> {
    let alone = |field: &str| match message.sheet {
        Some(_) => Err(Refusal::new(Reason::WrongKind, field, "does not go with `sheet`: a tissue is one of them")),
        None => Ok(()),
    };
    refuse_given([("gravity", message.gravity.is_some() && message.solid.is_none(), Gravity::OF_A_SOLID)])?;
    let substance = match (&message.mesh, &message.solid) {
        (None, None) => from_sheet(message)?,
        (Some(of_mesh), None) => {
            alone("mesh")?;
            from_mesh(message, of_mesh, required("mesh.mesh_id", mesh)?)?
        }
        (None, Some(of_solid)) => {
            alone("solid")?;
            from_solid(message, of_solid, required("solid.mesh_id", mesh)?)?
        }
        (Some(_), Some(_)) => {
            let message = "does not go with `mesh`: a tissue is one of them";
            return Err(Refusal::new(Reason::WrongKind, "solid", message));
        }
    };
    let stepping = substance.body.kind().usual_stepping();
    Ok(Scene {
        name: if message.name.is_empty() { "unnamed".to_owned() } else { message.name.clone() },
        body: substance.body,
        material: substance.material,
        inclusions: substance.inclusions,
        added_lumps: Arc::default(),
        springs: substance.springs,
        anchor_stiffness_n_per_m: substance.anchor_stiffness_n_per_m,
        damping_n_s_per_m: substance.damping_n_s_per_m,
        volume_stiffness_pa: substance.volume_stiffness_pa,
        stepping: match &message.stepping {
            Some(message) => from_stepping(message, &stepping)?,
            None => stepping,
        },
        sleep_tolerance: message.sleep.as_ref().and_then(|sleep| sleep.tolerance),
        appearance: Appearance::default(),
        cutting: message.cutting.map_or_else(Cutting::default, from_cutting),
    })
}

/// Returns how a tissue is cut.
fn from_cutting(message: pb::Cutting) -> Cutting {
    let pb::Cutting {
        toughness_j_per_m2,
        thickness_m,
        tear_strain,
        tear_reference_m,
        anchor_depth_m,
        anchor_direction,
        burnt_stiffness_factor,
    } = message;
    let anchor_direction = anchor_direction.map(|direction| from_vector(Some(&direction)));
    Cutting {
        toughness_j_per_m2,
        thickness_m,
        tear_strain,
        tear_reference_m,
        anchor_depth_m,
        anchor_direction,
        burnt_stiffness_factor,
    }
}

/// Returns a tissue whose coefficients the message gives.
fn from_coefficients(message: &pb::Scene, body: Body) -> Result<Substance> {
    let springs = required("springs", message.springs.as_ref())?;
    let anchor_springs = required("anchor_springs", message.anchor_springs.as_ref())?;
    let damping = required("damping", message.damping.as_ref())?;
    let stiffness_n_per_m = required("springs.stiffness_n_per_m", springs.stiffness_n_per_m)?;
    Ok(Substance {
        body,
        material: None,
        inclusions: Arc::default(),
        springs: Springs {
            stiffness_n_per_m,
            shear_stiffness_n_per_m: springs.shear_stiffness_n_per_m.unwrap_or(stiffness_n_per_m),
            bending: springs.bending,
            pretension_n_per_m: springs.pretension_n_per_m,
        },
        anchor_stiffness_n_per_m: required("anchor_springs.stiffness_n_per_m", anchor_springs.stiffness_n_per_m)?,
        damping_n_s_per_m: required("damping.coefficient_n_s_per_m", damping.coefficient_n_s_per_m)?,
        volume_stiffness_pa: 0.0,
    })
}

fn from_sheet(message: &pb::Scene) -> Result<Substance> {
    refuse_given([
        ("material", message.material.is_some(), Material::OF_A_MESH),
        ("inclusions", !message.inclusions.is_empty(), Material::OF_A_MESH),
        ("volume", message.volume.is_some(), Volume::OF_A_MESH),
    ])?;
    if message.springs.is_some_and(|springs| springs.bending_factor.is_some()) {
        let message = "is for meshes: a sheet has springs of bending (`bending`) or none";
        return Err(Refusal::new(Reason::WrongKind, "springs.bending_factor", message));
    }
    let sheet = required("sheet", message.sheet.as_ref())?;
    let body = Body::Sheet(Sheet {
        points: [
            required("sheet.points_x", sheet.points_x)? as usize,
            required("sheet.points_y", sheet.points_y)? as usize,
        ],
        spacing_m: required("sheet.spacing_m", sheet.spacing_m)?,
        point_mass_kg: required("sheet.point_mass_kg", sheet.point_mass_kg)?,
        fixed: from_fixed(sheet.fixed.as_ref())?,
    });
    from_coefficients(message, body)
}

fn from_mesh(message: &pb::Scene, of_mesh: &pb::Mesh, mesh: &TriangleMesh) -> Result<Substance> {
    let material = message.material.as_ref().map(from_material).transpose()?;
    if material.is_some() {
        refuse_coefficients(message, of_mesh)?;
    }
    let springs = message.springs.unwrap_or_default();
    if springs.shear_stiffness_n_per_m.is_some() {
        let message = "is for sheets: the edges of a mesh resist shear as well";
        return Err(Refusal::new(Reason::WrongKind, "springs.shear_stiffness_n_per_m", message));
    }
    let bending = springs.bending_factor.unwrap_or(if springs.bending { 1.0 } else { 0.0 });
    let bending = number("springs.bending_factor", bending, "from 0 to 10", |v| (0.0..=10.0).contains(&v))?;
    // A material determines the mass of a point later.
    let point_mass_kg = required("mesh.point_mass_kg", of_mesh.point_mass_kg.or(material.as_ref().map(|_| 1.0)))?;
    let vertices = of_mesh.vertices.map(|vertices| vertices as usize);
    if let Some(vertices) = vertices {
        #[allow(clippy::cast_precision_loss)]
        number("mesh.vertices", vertices as f64, "at least 4", |vertices| vertices >= 4.0)?;
    }
    let simulated = Simulated::of(mesh.clone(), vertices, material.is_some())?;
    let fixed = match &of_mesh.fixed {
        None | Some(pb::mesh::Fixed::FixedRim(false)) => FixedVertices::None,
        Some(pb::mesh::Fixed::FixedRim(true)) => FixedVertices::Rim,
        Some(pb::mesh::Fixed::FixedGroup(name)) => FixedVertices::group("mesh.fixed_group", name, &simulated.mesh)?,
        Some(pb::mesh::Fixed::FixedBalls(balls)) => {
            let ball = |ball: &pb::Ball| {
                let centre_m = from_vector(required("mesh.fixed_balls.centre_m", ball.centre_m.as_ref()).map(Some)?);
                for component in centre_m.to_array() {
                    finite("mesh.fixed_balls.centre_m", component)?;
                }
                Ok((centre_m, positive("mesh.fixed_balls.radius_m", ball.radius_m)?))
            };
            FixedVertices::Balls(balls.balls.iter().map(ball).collect::<Result<_>>()?)
        }
    };
    let made = Mesh::simulating(simulated, point_mass_kg, fixed)?;
    let substance = match material {
        Some(material) => {
            let made = Substance::of_material(material, bending, made.shape)?;
            let pretension_n_per_m = springs.pretension_n_per_m;
            Substance { springs: Springs { pretension_n_per_m, ..made.springs }, ..made }
        }
        None if bending > 0.0 => from_coefficients(message, Body::Mesh(Mesh::new(point_mass_kg, bending, made.shape)))?,
        None => from_coefficients(message, Body::Mesh(made))?,
    };
    let inclusions = message.inclusions.iter().enumerate().map(from_inclusion).collect::<Result<_>>()?;
    let substance = substance.with(inclusions, "inclusions")?;
    match &message.volume {
        Some(volume) => substance.enclosing(required("volume.stiffness_pa", volume.stiffness_pa)?),
        None => Ok(substance),
    }
}

fn from_solid(message: &pb::Scene, of_solid: &pb::Solid, mesh: &TriangleMesh) -> Result<Substance> {
    refuse_given([
        ("material", message.material.is_some(), SolidMaterial::FOLLOWS),
        ("springs", message.springs.is_some(), SolidMaterial::FOLLOWS),
        ("anchor_springs", message.anchor_springs.is_some(), SolidMaterial::FOLLOWS),
        ("damping", message.damping.is_some(), SolidMaterial::FOLLOWS),
        ("volume", message.volume.is_some(), Volume::OF_A_MESH),
    ])?;
    let usual = SolidMaterial::usual();
    let material = SolidMaterial {
        youngs_modulus_pa: required("solid.youngs_modulus_pa", of_solid.youngs_modulus_pa)?,
        poissons_ratio: required("solid.poissons_ratio", of_solid.poissons_ratio)?,
        density_kg_per_m3: of_solid.density_kg_per_m3.unwrap_or(usual.density_kg_per_m3),
        damping_per_s: of_solid.damping_per_s.unwrap_or(usual.damping_per_s),
        ..usual
    };
    let branches = of_solid.branches.iter().enumerate().map(from_branch).collect::<Result<Vec<_>>>()?;
    let branches = Branches::of(&branches, "solid.branches")?;
    let material = SolidMaterial { branches, ..material.with_viscosity(of_solid.viscosity_pa_s) };
    let size = match (of_solid.cell_m, of_solid.cells) {
        (Some(cell_m), _) => CellSize::Edge(positive("solid.cell_m", cell_m)?),
        (None, Some(cells)) => CellSize::Count(f64::from(cells)),
        (None, None) => CellSize::USUAL,
    };
    let fixed = of_solid.fixed.iter().enumerate().map(from_fixed_part).collect::<Result<Vec<_>>>()?;
    let layers = of_solid.layers.iter().enumerate().map(from_layer).collect::<Result<Vec<_>>>()?;
    let solid = Solid::of(mesh.clone(), size, &fixed, material)?.with_layers(&layers, "solid.layers")?;
    let solid = solid.with_foundation(of_solid.foundation_n_per_m3.unwrap_or(0.0))?;
    let gravity = message.gravity.as_ref().map_or(Ok(Gravity::default()), from_gravity)?;
    let solid = solid.with_gravity(gravity);
    let inclusions = message.inclusions.iter().enumerate().map(from_inclusion).collect::<Result<_>>()?;
    Substance::of_solid(solid).with(inclusions, "inclusions")
}

fn from_gravity(message: &pb::Gravity) -> Result<Gravity> {
    let acceleration = required("gravity.acceleration_m_per_s2", message.acceleration_m_per_s2.as_ref())?;
    Ok(Gravity { acceleration_m_per_s2: from_vector(Some(acceleration)), is_loaded: message.loaded })
}

fn from_layer((index, message): (usize, &pb::Layer)) -> Result<Layer> {
    let field = |key: &str| format!("solid.layers[{index}].{key}");
    Ok(Layer {
        thickness_m: required(&field("thickness_m"), message.thickness_m)?,
        stiffness_factor: required(&field("stiffness_factor"), message.stiffness_factor)?,
    })
}

fn from_branch((index, message): (usize, &pb::Branch)) -> Result<Branch> {
    let field = |key: &str| format!("solid.branches[{index}].{key}");
    Ok(Branch {
        shear_modulus_pa: required(&field("shear_modulus_pa"), message.shear_modulus_pa)?,
        time_s: required(&field("time_s"), message.time_s)?,
    })
}

fn from_fixed_part((index, message): (usize, &pb::FixedPart)) -> Result<FixedPart> {
    let field = |key: &str| format!("solid.fixed[{index}].{key}");
    let place = |key: &str, place: &Option<pb::Vector3>| -> Result<DVec3> {
        Ok(from_vector(Some(required(&field(key), place.as_ref())?)))
    };
    let part = match required(&field("part"), message.part.as_ref())? {
        pb::fixed_part::Part::Plane(plane) => {
            FixedPart::plane(place("plane_m", &plane.plane_m)?, place("normal", &plane.normal)?, plane.within_m)
        }
        pb::fixed_part::Part::Ball(ball) => FixedPart::ball(place("centre_m", &ball.centre_m)?, ball.radius_m),
        pb::fixed_part::Part::Group(name) => Ok(FixedPart::Group(name.clone())),
    };
    part.map_err(|refusal| refusal.within(&format!("solid.fixed[{index}]")))
}

fn from_material(message: &pb::Material) -> Result<Material> {
    let usual = Material::new(
        required("material.youngs_modulus_pa", message.youngs_modulus_pa)?,
        required("material.thickness_m", message.thickness_m)?,
        required("material.foundation_n_per_m3", message.foundation_n_per_m3)?,
    );
    Ok(Material {
        density_kg_per_m3: message.density_kg_per_m3.unwrap_or(usual.density_kg_per_m3),
        depth_m: message.depth_m.unwrap_or(usual.depth_m),
        damping_ratio: message.damping_ratio.unwrap_or(usual.damping_ratio),
        foundation_group: message.foundation_group.clone(),
        ..usual
    })
}

/// Refuses coefficients that follow from a material.
fn refuse_coefficients(message: &pb::Scene, of_mesh: &pb::Mesh) -> Result<()> {
    let springs = message.springs.unwrap_or_default();
    refuse_given([
        ("mesh.point_mass_kg", of_mesh.point_mass_kg.is_some(), Mesh::WEIGHED),
        ("anchor_springs", message.anchor_springs.is_some(), Material::FOLLOWS),
        ("damping", message.damping.is_some(), Material::FOLLOWS),
        ("springs.stiffness_n_per_m", springs.stiffness_n_per_m.is_some(), Material::FOLLOWS),
        ("springs.shear_stiffness_n_per_m", springs.shear_stiffness_n_per_m.is_some(), Material::FOLLOWS),
    ])
}

/// Refuses the first field that is given, with the reason why it can't be.
fn refuse_given<const N: usize>(fields: [(&str, bool, &str); N]) -> Result<()> {
    match fields.into_iter().find(|(_, is_there, _)| *is_there) {
        Some((field, _, why)) => Err(Refusal::new(Reason::WrongKind, field, why)),
        None => Ok(()),
    }
}

fn from_inclusion((index, message): (usize, &pb::Inclusion)) -> Result<Inclusion> {
    let centre_m = message.centre_m.as_ref().map(|centre_m| from_vector(Some(centre_m)));
    let region = Region::of(centre_m, message.radius_m, message.group.clone());
    let even = Inclusion::even(region.map_err(|refusal| refusal.within(&format!("inclusions[{index}]")))?);
    Ok(Inclusion {
        stiffness_factor: message.stiffness_factor.unwrap_or(even.stiffness_factor),
        anchor_stiffness_factor: message.anchor_stiffness_factor.unwrap_or(even.anchor_stiffness_factor),
        edge_m: message.edge_m.unwrap_or(even.edge_m),
        ..even
    })
}

fn from_fixed(fixed: Option<&pb::sheet::Fixed>) -> Result<FixedPoints> {
    Ok(match fixed {
        None => FixedPoints::Points(PointSet::default()),
        Some(pb::sheet::Fixed::FixedPoints(points)) => {
            FixedPoints::Points(points.points.iter().map(from_point).collect())
        }
        Some(pb::sheet::Fixed::FixedSet(set)) => match pb::FixedSet::try_from(*set) {
            Ok(pb::FixedSet::Unspecified) => FixedPoints::Points(PointSet::default()),
            Ok(pb::FixedSet::Edges) => FixedPoints::Edges,
            Ok(pb::FixedSet::Corners) => FixedPoints::Corners,
            Err(_) => {
                return Err(Refusal::new(Reason::WrongKind, "sheet.fixed_set", format!("unknown set of points {set}")));
            }
        },
    })
}

fn from_stepping(message: &pb::Stepping, standard: &Stepping) -> Result<Stepping> {
    let or_auto = |name: &String| if name.is_empty() { "auto".to_owned() } else { name.clone() };
    Ok(Stepping {
        rate_hz: message.rate_hz.unwrap_or(standard.rate_hz),
        tolerance: message.tolerance.unwrap_or(standard.tolerance),
        integrator: Integrator::named("stepping.integrator", &or_auto(&message.integrator))?,
        substeps: message.substeps,
        precision: Precision::named("stepping.precision", &or_auto(&message.precision))?,
        // The server chooses this for its processor.
        lanes: Lanes::Auto,
        correct: message.correct,
    })
}

/// Returns the change of the tissue in a message; absent coefficients stay. The step is not in it, and nothing is
/// checked.
pub fn from_change(message: &pb::UpdateTissueRequest) -> Change {
    Change {
        stiffness_n_per_m: message.stiffness_n_per_m,
        damping_n_s_per_m: message.damping_n_s_per_m,
        anchor_stiffness_n_per_m: message.anchor_stiffness_n_per_m,
        volume_stiffness_pa: message.volume_stiffness_pa,
    }
}

/// Returns the message that requests a change of the tissue of session `session_id` at the beginning of step `step`.
pub fn update_tissue(session_id: &str, change: &Change, step: u64) -> pb::UpdateTissueRequest {
    pb::UpdateTissueRequest {
        session_id: session_id.to_owned(),
        stiffness_n_per_m: change.stiffness_n_per_m,
        damping_n_s_per_m: change.damping_n_s_per_m,
        anchor_stiffness_n_per_m: change.anchor_stiffness_n_per_m,
        volume_stiffness_pa: change.volume_stiffness_pa,
        at_step: Some(step),
    }
}

/// Returns a scene as a client sends it: without the coefficients that follow from a material, and without the mesh's
/// vertices and ID.
pub fn sent(scene: &Scene) -> pb::Scene {
    let mut message = self::scene(scene);
    if message.solid.is_some() {
        (message.springs, message.anchor_springs, message.damping) = (None, None, None);
    }
    if message.material.is_some() {
        message.anchor_springs = None;
        message.damping = None;
        if let (Some(springs), Some(mesh)) = (&mut message.springs, &mut message.mesh) {
            springs.stiffness_n_per_m = None;
            mesh.point_mass_kg = None;
        }
    }
    message
}

/// The file of a mesh that a client sends before a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct MeshToSend {
    /// The name of the file, whose ending tells its format.
    pub name: String,
    /// The content of the file.
    pub bytes: Vec<u8>,
    /// The name of its unit of length, or that length in m.
    pub unit: String,
}

/// A scene as a client sends it, and the mesh to send before it.
#[derive(Debug, Clone)]
pub struct SceneToSend {
    message: pb::Scene,
    /// The mesh, if one belongs to the scene.
    pub upload: Option<MeshToSend>,
}

impl SceneToSend {
    /// Converts a scene. `said` is what its text says about its mesh ([`sent::said`]), if that is known. The mesh is that
    /// of `file`, or is written anew if there is none.
    pub fn of(scene: &Scene, said: Option<&MeshFile>, file: Option<MeshToSend>) -> Self {
        let mut message = self::sent(scene);
        // The number of vertices that the text asks for: the mesh may have fewer.
        if let (Some(said), Some(of_scene)) = (said, &mut message.mesh) {
            of_scene.vertices = said.vertices.map(|vertices| vertices.try_into().unwrap_or(u32::MAX));
        }
        let upload = file.or_else(|| {
            let (name, bytes, unit) = sent::file(scene)?;
            Some(MeshToSend { name: name.to_owned(), bytes, unit: unit.to_owned() })
        });
        SceneToSend { message, upload }
    }

    /// Returns the message, with the ID that the server gave the mesh; empty without a mesh.
    pub fn with_mesh_id(&self, id: String) -> pb::Scene {
        let mut message = self.message.clone();
        scene::set_mesh_id(&mut message, id);
        message
    }
}

/// Returns the scene that a server has told, of a session on a mesh that was fetched from it: `mesh` has all vertices of
/// its file, and all points and springs have the reference values.
///
/// # Errors
/// Refuses what [`from_scene`] refuses.
pub fn from_told(message: &pb::Scene, mesh: &TriangleMesh) -> Result<Scene> {
    // The coefficients that follow from a material are sent as well.
    let mut even = pb::Scene { material: None, inclusions: Vec::new(), ..message.clone() };
    if even.solid.is_some() {
        (even.springs, even.anchor_springs, even.damping) = (None, None, None);
    }
    set_absent_viscosity(&mut even);
    // Scripts name the vertices of the file. Only the server knows which point of a coarser mesh each one belongs to.
    even.mesh.iter_mut().for_each(|mesh| mesh.vertices = None);
    from_scene(&even, Some(mesh))
}

/// Makes a solid elastic of which nothing says how viscous it is, in a scene that is not a client's: a server or a journal from before
/// solids were viscous.
pub(crate) fn set_absent_viscosity(message: &mut pb::Scene) {
    if let Some(solid) = &mut message.solid {
        solid.viscosity_pa_s.get_or_insert(0.0);
    }
}

/// Returns a scene as a message, with all defaults filled in and the coefficients that follow from a material. The
/// mesh's vertices and ID and the appearance are left out.
pub fn scene(scene: &Scene) -> pb::Scene {
    let of_mesh = scene.mesh();
    pb::Scene {
        name: scene.name.clone(),
        sheet: scene.sheet().map(sheet),
        mesh: of_mesh.map(mesh),
        solid: if let Body::Solid(solid) = &scene.body { Some(self::solid(solid)) } else { None },
        material: scene.material.as_ref().map(material),
        inclusions: scene.all_inclusions().iter().map(inclusion).collect(),
        springs: Some(pb::Springs {
            stiffness_n_per_m: Some(scene.springs.stiffness_n_per_m),
            // The edges of a mesh resist shear as well.
            shear_stiffness_n_per_m: scene.sheet().map(|_| scene.springs.shear_stiffness_n_per_m),
            bending: scene.springs.bending,
            bending_factor: of_mesh.map(|mesh| mesh.bending),
            pretension_n_per_m: scene.springs.pretension_n_per_m,
        }),
        anchor_springs: Some(pb::AnchorSprings { stiffness_n_per_m: Some(scene.anchor_stiffness_n_per_m) }),
        damping: Some(pb::Damping { coefficient_n_s_per_m: Some(scene.damping_n_s_per_m) }),
        gravity: if let Body::Solid(solid) = &scene.body { gravity(solid.gravity()) } else { None },
        volume: scene.volume().map(|_| pb::Volume { stiffness_pa: Some(scene.volume_stiffness_pa) }),
        stepping: Some(pb::Stepping {
            rate_hz: Some(scene.stepping.rate_hz),
            tolerance: Some(scene.stepping.tolerance),
            integrator: scene.stepping.integrator.name().to_owned(),
            substeps: scene.stepping.substeps,
            precision: scene.stepping.precision.name().to_owned(),
            correct: scene.stepping.correct,
        }),
        sleep: scene.sleep_tolerance.map(|tolerance| pb::Sleep { tolerance: Some(tolerance) }),
        cutting: (scene.cutting != Cutting::default()).then_some(pb::Cutting {
            toughness_j_per_m2: scene.cutting.toughness_j_per_m2,
            thickness_m: scene.cutting.thickness_m,
            tear_strain: scene.cutting.tear_strain,
            tear_reference_m: scene.cutting.tear_reference_m,
            anchor_depth_m: scene.cutting.anchor_depth_m,
            anchor_direction: scene.cutting.anchor_direction.and_then(vector),
            burnt_stiffness_factor: scene.cutting.burnt_stiffness_factor,
        }),
    }
}

/// Returns gravity as a message; `None` without.
fn gravity(of: &Gravity) -> Option<pb::Gravity> {
    let message = pb::Gravity { acceleration_m_per_s2: vector(of.acceleration_m_per_s2), loaded: of.is_loaded };
    (*of != Gravity::default()).then_some(message)
}

/// Returns a solid as a message, without its surface.
fn solid(solid: &Solid) -> pb::Solid {
    let part = |part: &FixedPart| match part {
        FixedPart::Plane { plane_m, normal, within_m } => pb::fixed_part::Part::Plane(pb::FixedPlane {
            plane_m: vector(*plane_m),
            normal: vector(*normal),
            within_m: *within_m,
        }),
        FixedPart::Ball { centre_m, radius_m } => {
            pb::fixed_part::Part::Ball(pb::Ball { centre_m: vector(*centre_m), radius_m: *radius_m })
        }
        FixedPart::Group(name) => pb::fixed_part::Part::Group(name.clone()),
    };
    let layer = |Layer { thickness_m, stiffness_factor }: &Layer| pb::Layer {
        thickness_m: Some(*thickness_m),
        stiffness_factor: Some(*stiffness_factor),
    };
    let branch = |Branch { shear_modulus_pa, time_s }: &Branch| pb::Branch {
        shear_modulus_pa: Some(*shear_modulus_pa),
        time_s: Some(*time_s),
    };
    pb::Solid {
        mesh_id: String::new(),
        cell_m: Some(solid.shape.lattice().edge_m),
        cells: None,
        fixed: solid.shape.fixed().iter().map(|fixed| pb::FixedPart { part: Some(part(fixed)) }).collect(),
        youngs_modulus_pa: Some(solid.material.youngs_modulus_pa),
        poissons_ratio: Some(solid.material.poissons_ratio),
        density_kg_per_m3: Some(solid.material.density_kg_per_m3),
        damping_per_s: Some(solid.material.damping_per_s),
        viscosity_pa_s: Some(solid.material.viscosity_pa_s),
        foundation_n_per_m3: Some(solid.foundation_n_per_m3()).filter(|stiffness| *stiffness > 0.0),
        layers: solid.layers().iter().map(layer).collect(),
        branches: solid.material.branches.iter().map(branch).collect(),
    }
}

/// Returns a mesh as a message, without its vertices.
fn mesh(mesh: &Mesh) -> pb::Mesh {
    let ball = |(centre_m, radius_m): &(DVec3, f64)| pb::Ball { centre_m: vector(*centre_m), radius_m: *radius_m };
    let fixed = match &mesh.shape.told().fixed {
        FixedVertices::None => None,
        FixedVertices::Rim => Some(pb::mesh::Fixed::FixedRim(true)),
        FixedVertices::Group(group) => Some(pb::mesh::Fixed::FixedGroup(group.name.clone())),
        FixedVertices::Balls(balls) => {
            Some(pb::mesh::Fixed::FixedBalls(pb::Balls { balls: balls.iter().map(ball).collect() }))
        }
    };
    #[allow(clippy::cast_possible_truncation)]
    let vertices = mesh.shape.shown().map(|_| mesh.shape.point_count() as u32);
    pb::Mesh { mesh_id: String::new(), point_mass_kg: Some(mesh.point_mass_kg), vertices, fixed }
}

fn material(material: &Material) -> pb::Material {
    pb::Material {
        youngs_modulus_pa: Some(material.youngs_modulus_pa),
        thickness_m: Some(material.thickness_m),
        density_kg_per_m3: Some(material.density_kg_per_m3),
        depth_m: Some(material.depth_m),
        foundation_n_per_m3: Some(material.foundation_n_per_m3),
        damping_ratio: Some(material.damping_ratio),
        foundation_group: material.foundation_group.clone(),
    }
}

fn inclusion(inclusion: &Inclusion) -> pb::Inclusion {
    let (centre_m, radius_m, group) = match &inclusion.region {
        Region::Ball { centre_m, radius_m } => (vector(*centre_m), Some(*radius_m), None),
        Region::Group(name) => (None, None, Some(name.clone())),
    };
    pb::Inclusion {
        centre_m,
        radius_m,
        group,
        stiffness_factor: Some(inclusion.stiffness_factor),
        anchor_stiffness_factor: Some(inclusion.anchor_stiffness_factor),
        edge_m: Some(inclusion.edge_m),
    }
}

/// Returns a sheet as a message.
fn sheet(sheet: &Sheet) -> pb::Sheet {
    #[allow(clippy::cast_possible_truncation)]
    let [points_x, points_y] = sheet.points.map(|points| Some(points as u32));
    let fixed = match &sheet.fixed {
        FixedPoints::Edges => Some(pb::sheet::Fixed::FixedSet(pb::FixedSet::Edges.into())),
        FixedPoints::Corners => Some(pb::sheet::Fixed::FixedSet(pb::FixedSet::Corners.into())),
        FixedPoints::Points(points) if points.as_slice().is_empty() => None,
        FixedPoints::Points(points) => {
            let points = points.as_slice().iter().copied().map(point).collect();
            Some(pb::sheet::Fixed::FixedPoints(pb::GridPoints { points }))
        }
    };
    let Sheet { spacing_m, point_mass_kg, .. } = *sheet;
    pb::Sheet { points_x, points_y, spacing_m: Some(spacing_m), point_mass_kg: Some(point_mass_kg), fixed }
}

#[cfg(test)]
mod tests {
    use palpate_geometry::Group;

    use super::*;
    use palpate_tissue::limits::Limits;

    #[test]
    fn a_scene_survives_conversion_both_ways() {
        let mut paper = paper();
        let points = |points: &[[usize; 2]]| FixedPoints::Points(points.iter().copied().collect());
        for fixed in [FixedPoints::Edges, FixedPoints::Corners, points(&[]), points(&[[30, 0], [1, 2], [30, 0]])] {
            paper.sheet_mut().unwrap().fixed = fixed;
            assert_eq!(from_scene(&scene(&paper), None).unwrap(), paper);
        }
    }

    /// Returns the names in quotes in the comment above a field of `scene.proto`.
    fn told(field: &str) -> Vec<&'static str> {
        let (before, _) = include_str!("../../../../proto/palpate/v1/scene.proto").split_once(field).unwrap();
        let comment = before.trim_end().lines().rev().take_while(|line| line.trim_start().starts_with("//"));
        let mut lines: Vec<_> = comment.collect();
        lines.reverse();
        let mut names: Vec<_> = lines.into_iter().flat_map(|line| line.split('"').skip(1).step_by(2)).collect();
        // The default is named a second time.
        names.pop_if(|last| *last == "auto");
        names
    }

    #[test]
    fn the_protocol_tells_every_name() {
        fn names<T: Named>() -> Vec<&'static str> {
            T::NAMES.iter().map(|entry| entry.0).collect()
        }
        assert_eq!(told("string integrator ="), names::<Integrator>());
        assert_eq!(told("string precision ="), names::<Precision>());
    }

    /// The smallest closed mesh.
    fn tetrahedron() -> TriangleMesh {
        TriangleMesh {
            vertices_m: [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]].map(DVec3::from).to_vec(),
            triangles: vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]],
            uv: None,
            groups: vec![Group { name: "lump".to_owned(), vertices: vec![1, 2] }],
            regions: Vec::new(),
        }
    }

    /// A scene of a material, with a ball and a group whose factors differ.
    fn of_a_material() -> pb::Scene {
        pb::Scene {
            mesh: Some(pb::Mesh::default()),
            material: Some(pb::Material {
                youngs_modulus_pa: Some(5000.0),
                thickness_m: Some(0.002),
                foundation_n_per_m3: Some(4e5),
                ..Default::default()
            }),
            inclusions: vec![
                pb::Inclusion {
                    centre_m: vector(DVec3::ZERO),
                    radius_m: Some(0.01),
                    stiffness_factor: Some(3.0),
                    ..Default::default()
                },
                pb::Inclusion {
                    group: Some("lump".to_owned()),
                    anchor_stiffness_factor: Some(4.0),
                    edge_m: Some(0.15),
                    ..Default::default()
                },
            ],
            springs: Some(pb::Springs { bending_factor: Some(0.2), ..Default::default() }),
            volume: Some(pb::Volume { stiffness_pa: Some(300.0) }),
            ..Default::default()
        }
    }

    #[test]
    fn a_material_and_inclusions_survive_conversion_both_ways_and_what_follows_is_told() {
        let read = |message: &pb::Scene| from_scene(message, Some(&tetrahedron())).unwrap();
        let made = read(&of_a_material());
        let Body::Mesh(mesh) = &made.body else { panic!("of another kind") };
        let [edges, bending] = [&mesh.differences.edges, &mesh.differences.bending];
        assert!(edges.len() == 6 && bending.len() == 6 && mesh.bending == 0.2, "{mesh:?}");
        assert_eq!(mesh.differences.extra_anchor[1], 3.0);
        assert_eq!(read(&sent(&made)), made);
        assert_eq!((made.volume_stiffness_pa, mesh.volume.is_some()), (300.0, true));
        let told = scene(&made);
        let material = told.material.unwrap();
        assert_eq!((material.density_kg_per_m3, material.damping_ratio), (Some(1060.0), Some(0.5)));
        assert_eq!((told.inclusions[0].anchor_stiffness_factor, told.inclusions[1].radius_m), (Some(1.0), None));
        assert_eq!(told.springs.unwrap().stiffness_n_per_m, Some(made.springs.stiffness_n_per_m));
        assert_eq!(told.mesh.as_ref().unwrap().point_mass_kg, Some(made.point_mass_kg()));
        let change = Change { stiffness_n_per_m: Some(1.0), ..Change::default() };
        let changed = scene(&made.changed(&change, &made));
        assert_eq!((changed.springs.unwrap().stiffness_n_per_m, changed.material), (Some(1.0), Some(material)));
        let softer = Change { volume_stiffness_pa: Some(0.0), ..Change::default() };
        assert_eq!(scene(&made.changed(&softer, &made)).volume, Some(pb::Volume { stiffness_pa: Some(0.0) }));
        // Inclusions without a material go with coefficients.
        let even = pb::Scene { material: None, ..told };
        assert_eq!(scene(&read(&even)), even);
    }

    #[test]
    fn what_is_wrong_with_a_material_or_an_inclusion_is_named() {
        type Change = fn(&mut pb::Scene);
        let changes: [(Change, &str, Reason, &str); 38] = [
            (|s| material_of(s).youngs_modulus_pa = None, "material.youngs_modulus_pa", Reason::Missing, ""),
            (|s| material_of(s).thickness_m = None, "material.thickness_m", Reason::Missing, ""),
            (|s| material_of(s).foundation_n_per_m3 = None, "material.foundation_n_per_m3", Reason::Missing, ""),
            (
                |s| material_of(s).youngs_modulus_pa = Some(0.0),
                "material.youngs_modulus_pa",
                Reason::OutOfRange,
                "above 0",
            ),
            (
                |s| material_of(s).youngs_modulus_pa = Some(1e300),
                "material.youngs_modulus_pa",
                Reason::OutOfRange,
                "1e12",
            ),
            (|s| material_of(s).thickness_m = Some(-1.0), "material.thickness_m", Reason::OutOfRange, "above 0"),
            (|s| material_of(s).thickness_m = Some(f64::NAN), "material.thickness_m", Reason::NotFinite, ""),
            (
                |s| material_of(s).density_kg_per_m3 = Some(0.0),
                "material.density_kg_per_m3",
                Reason::OutOfRange,
                "above 0",
            ),
            (|s| material_of(s).depth_m = Some(f64::INFINITY), "material.depth_m", Reason::NotFinite, ""),
            (
                |s| material_of(s).foundation_n_per_m3 = Some(-1.0),
                "material.foundation_n_per_m3",
                Reason::OutOfRange,
                "0 or more",
            ),
            (
                |s| material_of(s).foundation_n_per_m3 = Some(1e300),
                "material.foundation_n_per_m3",
                Reason::OutOfRange,
                "1e12",
            ),
            (|s| material_of(s).damping_ratio = Some(101.0), "material.damping_ratio", Reason::OutOfRange, "100"),
            (|s| material_of(s).damping_ratio = Some(-0.1), "material.damping_ratio", Reason::OutOfRange, "from 0"),
            (|s| mesh_of(s).point_mass_kg = Some(1.0), "mesh.point_mass_kg", Reason::WrongKind, "what a point weighs"),
            (|s| s.springs = scene(&paper()).springs, "springs.stiffness_n_per_m", Reason::WrongKind, "follows"),
            (|s| s.damping = scene(&paper()).damping, "damping", Reason::WrongKind, "follows"),
            (|s| s.anchor_springs = scene(&paper()).anchor_springs, "anchor_springs", Reason::WrongKind, "follows"),
            (|s| s.material = None, "mesh.point_mass_kg", Reason::Missing, ""),
            (|s| s.mesh = None, "material", Reason::WrongKind, "is for a mesh"),
            (|s| s.volume = Some(pb::Volume::default()), "volume.stiffness_pa", Reason::Missing, ""),
            (|s| resists(s, 0.0), "volume.stiffness_pa", Reason::OutOfRange, "above 0"),
            (|s| resists(s, f64::NAN), "volume.stiffness_pa", Reason::NotFinite, ""),
            (|s| resists(s, 1e13), "volume.stiffness_pa", Reason::OutOfRange, "1e12"),
            (
                |s| (s.mesh, s.material, s.inclusions) = (None, None, vec![]),
                "volume",
                Reason::WrongKind,
                "is for a closed mesh",
            ),
            (|s| (s.mesh, s.material) = (None, None), "inclusions", Reason::WrongKind, "is for a mesh"),
            (|s| s.inclusions[0].radius_m = None, "inclusions[0].radius_m", Reason::Missing, ""),
            (|s| s.inclusions[0].radius_m = Some(0.0), "inclusions[0].radius_m", Reason::OutOfRange, "above 0"),
            (
                |s| s.inclusions[0].centre_m = vector(DVec3::ONE),
                "inclusions[0].radius_m",
                Reason::OutOfRange,
                "no vertex",
            ),
            (|s| s.inclusions[0].centre_m = vector(DVec3::NAN), "inclusions[0].centre_m", Reason::NotFinite, ""),
            (|s| s.inclusions[0].centre_m = None, "inclusions[0].centre_m", Reason::Missing, "or else `group`"),
            (
                |s| s.inclusions[0].group = Some("lump".into()),
                "inclusions[0].group",
                Reason::WrongKind,
                "a ball or a group",
            ),
            (
                |s| s.inclusions[1].radius_m = Some(1.0),
                "inclusions[1].radius_m",
                Reason::WrongKind,
                "a ball or a group",
            ),
            (
                |s| s.inclusions[1].group = Some("lamp".into()),
                "inclusions[1].group",
                Reason::WrongKind,
                "did you mean `lump`",
            ),
            (|s| s.inclusions[1].edge_m = Some(-1.0), "inclusions[1].edge_m", Reason::OutOfRange, "0 or more"),
            (|s| s.inclusions[1].edge_m = Some(f64::INFINITY), "inclusions[1].edge_m", Reason::NotFinite, ""),
            (
                |s| s.inclusions[1].stiffness_factor = Some(0.0),
                "inclusions[1].stiffness_factor",
                Reason::OutOfRange,
                "0.01",
            ),
            (
                |s| s.inclusions[1].anchor_stiffness_factor = Some(f64::NAN),
                "inclusions[1].anchor_stiffness_factor",
                Reason::NotFinite,
                "",
            ),
            (
                |s| s.inclusions = vec![s.inclusions[0].clone(); 257],
                "inclusions",
                Reason::TooLarge,
                "257, more than 256",
            ),
        ];
        for (change, field, reason, words) in changes {
            let mut message = of_a_material();
            change(&mut message);
            let refused = from_scene(&message, Some(&tetrahedron())).unwrap_err();
            assert_eq!((refused.field.as_str(), refused.reason), (field, reason), "{refused}");
            assert!(refused.message.contains(words), "{refused}");
        }
    }

    #[test]
    fn anchors_that_a_blade_severs_come_back_as_they_went() {
        let mut message = of_a_material();
        material_of(&mut message).foundation_group = Some("lump".to_owned());
        message.cutting = Some(pb::Cutting {
            anchor_depth_m: Some(0.003),
            burnt_stiffness_factor: Some(4.0),
            anchor_direction: vector(DVec3::new(0.0, -1.0, 2.0)),
            ..Default::default()
        });
        let read = |message: &pb::Scene| from_scene(message, Some(&tetrahedron())).unwrap();
        let made = read(&message);
        let told = scene(&made);
        assert_eq!((told.cutting, made.cutting.anchor_depth_m), (message.cutting, Some(0.003)));
        assert_eq!(told.material.unwrap().foundation_group.as_deref(), Some("lump"));
        assert_eq!(made.mesh().unwrap().differences.extra_anchor[0], -1.0);
    }

    fn paper() -> Scene {
        Scene::parse("paper", palpate_tissue::scene::PAPER, &[], &Limits::default()).unwrap()
    }

    fn material_of(scene: &mut pb::Scene) -> &mut pb::Material {
        scene.material.as_mut().unwrap()
    }

    fn resists(scene: &mut pb::Scene, stiffness_pa: f64) {
        scene.volume = Some(pb::Volume { stiffness_pa: Some(stiffness_pa) });
    }

    fn mesh_of(scene: &mut pb::Scene) -> &mut pb::Mesh {
        scene.mesh.as_mut().unwrap()
    }

    #[test]
    fn a_missing_coefficient_is_named() {
        let mut message = scene(&paper());
        message.damping = Some(pb::Damping::default());
        let refusal = from_scene(&message, None).unwrap_err();
        assert_eq!((refusal.reason, refusal.field.as_str()), (Reason::Missing, "damping.coefficient_n_s_per_m"));
    }
}
