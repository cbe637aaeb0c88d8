//! Conversion of scenes: the fields and defaults of a scene file. Ranges are checked when the scene is compiled.

use glam::DVec3;
use palpate_mesh::TriangleMesh;
use palpate_proto::geometry::{from_point, from_vector, point, vector};
use palpate_proto::pb;

use super::required;
use crate::refusal::{Reason, Refusal, Result, finite, number, positive};
use crate::scene::{
    Appearance, Body, Change, Fixed, FixedVertices, Integrator, Lanes, Mesh, Named, PointSet, Precision, Scene, Sheet,
    Springs, Stepping, simulated,
};
use crate::shape::RestShape;

/// The scene in a message. A scene on a mesh names the `mesh` that its client has sent before.
///
/// # Errors
/// Returns an error if a required field is missing, if a name or set is unknown, or if the mesh is missing.
pub fn from_scene(message: &pb::Scene, mesh: Option<&TriangleMesh>) -> Result<Scene> {
    let springs = required("springs", message.springs.as_ref())?;
    let virtual_springs = required("virtual_springs", message.virtual_springs.as_ref())?;
    let damping = required("damping", message.damping.as_ref())?;
    let stiffness_n_per_m = required("springs.stiffness_n_per_m", springs.stiffness_n_per_m)?;
    let body = match &message.mesh {
        None => Body::Sheet(from_sheet(required("sheet", message.sheet.as_ref())?, springs)?),
        Some(_) if message.sheet.is_some() => {
            let message = "does not go with `sheet`: a tissue is one of them";
            return Err(Refusal::new(Reason::WrongKind, "mesh", message));
        }
        Some(of_mesh) => Body::Mesh(from_mesh(of_mesh, springs, required("mesh.mesh_id", mesh)?)?),
    };
    Ok(Scene {
        name: if message.name.is_empty() { "unnamed".to_owned() } else { message.name.clone() },
        body,
        springs: Springs {
            stiffness_n_per_m,
            shear_stiffness_n_per_m: springs.shear_stiffness_n_per_m.unwrap_or(stiffness_n_per_m),
            flexion: springs.flexion,
        },
        virtual_stiffness_n_per_m: required("virtual_springs.stiffness_n_per_m", virtual_springs.stiffness_n_per_m)?,
        damping_n_s_per_m: required("damping.coefficient_n_s_per_m", damping.coefficient_n_s_per_m)?,
        stepping: message.stepping.as_ref().map_or(Ok(Stepping::default()), from_stepping)?,
        sleep_tolerance: message.sleep.as_ref().and_then(|sleep| sleep.tolerance),
        appearance: Appearance::default(),
    })
}

fn from_sheet(sheet: &pb::Sheet, springs: &pb::Springs) -> Result<Sheet> {
    if springs.flexion_factor.is_some() {
        let message = "is for meshes: a sheet has springs of flexion (`flexion`) or none";
        return Err(Refusal::new(Reason::WrongKind, "springs.flexion_factor", message));
    }
    Ok(Sheet {
        points: [
            required("sheet.points_x", sheet.points_x)? as usize,
            required("sheet.points_y", sheet.points_y)? as usize,
        ],
        spacing_m: required("sheet.spacing_m", sheet.spacing_m)?,
        point_mass_kg: required("sheet.point_mass_kg", sheet.point_mass_kg)?,
        fixed: from_fixed(sheet.fixed.as_ref())?,
    })
}

fn from_mesh(message: &pb::Mesh, springs: &pb::Springs, mesh: &TriangleMesh) -> Result<Mesh> {
    if springs.shear_stiffness_n_per_m.is_some() {
        let message = "is for sheets: the edges of a mesh resist shear as well";
        return Err(Refusal::new(Reason::WrongKind, "springs.shear_stiffness_n_per_m", message));
    }
    let flexion = springs.flexion_factor.unwrap_or(if springs.flexion { 1.0 } else { 0.0 });
    let flexion = number("springs.flexion_factor", flexion, "from 0 to 10", |v| (0.0..=10.0).contains(&v))?;
    let point_mass_kg = required("mesh.point_mass_kg", message.point_mass_kg)?;
    let vertices = message.vertices.map(|vertices| vertices as usize);
    if let Some(vertices) = vertices {
        #[allow(clippy::cast_precision_loss)]
        number("mesh.vertices", vertices as f64, "at least 4", |vertices| vertices >= 4.0)?;
    }
    let (mesh, shown) = simulated(mesh.clone(), vertices, false);
    let fixed = match &message.fixed {
        None | Some(pb::mesh::Fixed::FixedRim(false)) => FixedVertices::None,
        Some(pb::mesh::Fixed::FixedRim(true)) => FixedVertices::Rim,
        Some(pb::mesh::Fixed::FixedGroup(name)) => FixedVertices::group("mesh.fixed_group", name, &mesh)?,
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
    let made = Mesh::shown_as(mesh, shown, point_mass_kg, fixed)?;
    Ok(if flexion > 0.0 { Mesh::new(point_mass_kg, flexion, made.shape) } else { made })
}

fn from_fixed(fixed: Option<&pb::sheet::Fixed>) -> Result<Fixed> {
    Ok(match fixed {
        None => Fixed::Points(PointSet::default()),
        Some(pb::sheet::Fixed::FixedPoints(points)) => Fixed::Points(points.points.iter().map(from_point).collect()),
        Some(pb::sheet::Fixed::FixedSet(set)) => match pb::FixedSet::try_from(*set) {
            Ok(pb::FixedSet::Unspecified) => Fixed::Points(PointSet::default()),
            Ok(pb::FixedSet::Edges) => Fixed::Edges,
            Ok(pb::FixedSet::Corners) => Fixed::Corners,
            Err(_) => {
                return Err(Refusal::new(Reason::WrongKind, "sheet.fixed_set", format!("unknown set of points {set}")));
            }
        },
    })
}

fn from_stepping(message: &pb::Stepping) -> Result<Stepping> {
    let standard = Stepping::default();
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

/// The change of the tissue in a message.
pub fn from_change(message: &pb::UpdateTissueRequest) -> Change {
    Change {
        stiffness_n_per_m: message.stiffness_n_per_m,
        damping_n_s_per_m: message.damping_n_s_per_m,
        virtual_stiffness_n_per_m: message.virtual_stiffness_n_per_m,
    }
}

/// The message that requests a change of the tissue at the beginning of step `step`.
pub fn update_tissue(session_id: &str, change: &Change, step: u64) -> pb::UpdateTissueRequest {
    pb::UpdateTissueRequest {
        session_id: session_id.to_owned(),
        stiffness_n_per_m: change.stiffness_n_per_m,
        damping_n_s_per_m: change.damping_n_s_per_m,
        virtual_stiffness_n_per_m: change.virtual_stiffness_n_per_m,
        at_step: Some(step),
    }
}

/// A scene as a message, with all defaults filled in.
pub fn scene(scene: &Scene) -> pb::Scene {
    let of_mesh = match &scene.body {
        Body::Mesh(mesh) => Some(mesh),
        Body::Sheet(_) => None,
    };
    pb::Scene {
        name: scene.name.clone(),
        sheet: scene.sheet().map(sheet),
        mesh: of_mesh.map(mesh),
        springs: Some(pb::Springs {
            stiffness_n_per_m: Some(scene.springs.stiffness_n_per_m),
            // The edges of a mesh resist shear as well.
            shear_stiffness_n_per_m: scene.sheet().map(|_| scene.springs.shear_stiffness_n_per_m),
            flexion: scene.springs.flexion,
            flexion_factor: of_mesh.map(|mesh| mesh.flexion),
        }),
        virtual_springs: Some(pb::VirtualSprings { stiffness_n_per_m: Some(scene.virtual_stiffness_n_per_m) }),
        damping: Some(pb::Damping { coefficient_n_s_per_m: Some(scene.damping_n_s_per_m) }),
        stepping: Some(pb::Stepping {
            rate_hz: Some(scene.stepping.rate_hz),
            tolerance: Some(scene.stepping.tolerance),
            integrator: scene.stepping.integrator.name().to_owned(),
            substeps: scene.stepping.substeps,
            precision: scene.stepping.precision.name().to_owned(),
            correct: scene.stepping.correct,
        }),
        sleep: scene.sleep_tolerance.map(|tolerance| pb::Sleep { tolerance: Some(tolerance) }),
    }
}

/// A mesh as a message, without its vertices.
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

/// A sheet as a message.
fn sheet(sheet: &Sheet) -> pb::Sheet {
    #[allow(clippy::cast_possible_truncation)]
    let [points_x, points_y] = sheet.points.map(|points| Some(points as u32));
    let fixed = match &sheet.fixed {
        Fixed::Edges => Some(pb::sheet::Fixed::FixedSet(pb::FixedSet::Edges.into())),
        Fixed::Corners => Some(pb::sheet::Fixed::FixedSet(pb::FixedSet::Corners.into())),
        Fixed::Points(points) if points.as_slice().is_empty() => None,
        Fixed::Points(points) => {
            let points = points.as_slice().iter().copied().map(point).collect();
            Some(pb::sheet::Fixed::FixedPoints(pb::GridPoints { points }))
        }
    };
    let Sheet { spacing_m, point_mass_kg, .. } = *sheet;
    pb::Sheet { points_x, points_y, spacing_m: Some(spacing_m), point_mass_kg: Some(point_mass_kg), fixed }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::limits::Limits;

    #[test]
    fn a_scene_survives_conversion_both_ways() {
        let mut paper = Scene::parse("paper", crate::scene::PAPER, &[], &Limits::default()).unwrap();
        let points = |points: &[[usize; 2]]| Fixed::Points(points.iter().copied().collect());
        for fixed in [Fixed::Edges, Fixed::Corners, points(&[]), points(&[[30, 0], [1, 2], [30, 0]])] {
            paper.sheet_mut().unwrap().fixed = fixed;
            assert_eq!(from_scene(&scene(&paper), None).unwrap(), paper);
        }
    }

    /// The names in quotes in the comment above a field of `scene.proto`.
    fn told(field: &str) -> Vec<&'static str> {
        let (before, _) = include_str!("../../proto/palpate/v1/scene.proto").split_once(field).unwrap();
        let comment = before.trim_end().lines().rev().take_while(|line| line.trim_start().starts_with("//"));
        let mut lines: Vec<_> = comment.collect();
        lines.reverse();
        let mut names: Vec<_> = lines.into_iter().flat_map(|line| line.split('"').skip(1).step_by(2)).collect();
        // The default is told once more.
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

    #[test]
    fn a_missing_coefficient_is_named() {
        let paper = Scene::parse("paper", crate::scene::PAPER, &[], &Limits::default()).unwrap();
        let mut message = scene(&paper);
        message.damping = Some(pb::Damping::default());
        let refusal = from_scene(&message, None).unwrap_err();
        assert_eq!((refusal.reason, refusal.field.as_str()), (Reason::Missing, "damping.coefficient_n_s_per_m"));
    }
}
