//! Conversion of sessions, models and inputs to messages of a journal, and back.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use glam::DVec3;
use palpate_geometry::{Group, TriangleMesh, VolumeRegion};
use palpate_haptics::{Coupling, Tip, TipShape};
use palpate_proto::geometry::{from_vector, vector};
use palpate_proto::journal as pb;

use super::exercise;
use super::format::REPLAYS;
use super::lumps::{from_lumps, lumps};
use crate::command::{Command, Due};
use crate::input::{Felt, Input};
use crate::rules::Rules;
use crate::wire::required;
use crate::wire::scene::{from_scene, sent, set_absent_viscosity};
use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::saved::{CorrectedPlan, SavedPlan};
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::script::{Action, PlaceMark};
use palpate_tissue::scene::tie::{Bite, Tie, TieKind};
use palpate_tissue::scene::{Appearance, Integrator, Named, PaintedSurface, Precision, Scene};
use palpate_tissue::shape::PointId;

/// Least number of tools with which a journal is read, whatever the limits of this program are.
const MAX_TOOLS: u32 = 4096;

/// Returns `limits` as they apply to a journal: without bounds of force and reach, and with at least 4096 tools. An
/// input that a server has accepted is not refused for these, because that server's configuration may have allowed
/// more.
pub fn limits(limits: &Limits) -> Limits {
    let tools = limits.tools.max(MAX_TOOLS);
    Limits { point_force_n: f64::MAX, reach_in_sides: f64::MAX, tools, ..limits.clone() }
}

/// Returns the mesh of a scene as a message.
fn mesh(mesh: &TriangleMesh) -> pb::TriangleMesh {
    let group = |group: &Group| pb::Group { name: group.name.clone(), vertices: group.vertices.clone() };
    pb::TriangleMesh {
        vertices_m: mesh.vertices_m.iter().flat_map(DVec3::to_array).collect(),
        triangles: mesh.triangles.iter().flatten().copied().collect(),
        uv: mesh.uv.iter().flatten().flatten().flatten().copied().collect(),
        groups: mesh.groups.iter().map(group).collect(),
        regions: mesh.regions.iter().map(region).collect(),
    }
}

fn region(region: &VolumeRegion) -> pb::VolumeRegion {
    pb::VolumeRegion {
        name: region.name.clone(),
        vertices_m: region.vertices_m.iter().flat_map(DVec3::to_array).collect(),
        triangles: region.triangles.iter().flatten().copied().collect(),
    }
}

/// Triangles that form no surface make a solid, if they enclose one.
fn from_mesh(message: &pb::TriangleMesh, is_solid: bool, limits: &Limits) -> Result<TriangleMesh> {
    let refuse = |reason, message: String| Err(Refusal::new(reason, "mesh", message));
    let (numbers, corners) = (message.vertices_m.len(), message.triangles.len());
    let of_regions: usize = message.regions.iter().map(|region| region.vertices_m.len()).sum();
    let numbers_in_all = numbers.saturating_add(of_regions);
    if numbers_in_all / 3 > limits.mesh_vertices {
        let message = format!("has {} vertices, more than {}", numbers_in_all / 3, limits.mesh_vertices);
        return refuse(Reason::TooLarge, message);
    }
    let is_whole = numbers.is_multiple_of(3)
        && corners.is_multiple_of(3)
        && (message.uv.is_empty() || message.uv.len() == 2 * corners);
    let within = |vertices: &[u32]| vertices.iter().all(|vertex| (*vertex as usize) < numbers / 3);
    let ascends = |group: &pb::Group| within(&group.vertices) && group.vertices.is_sorted_by(|a, b| a < b);
    if !is_whole || !within(&message.triangles) || !message.groups.iter().all(ascends) {
        return refuse(Reason::Unreadable, "has a triangle or a group without its vertices".to_owned());
    }
    let is_region = |region: &pb::VolumeRegion| {
        let numbers = region.vertices_m.len();
        numbers.is_multiple_of(3)
            && region.triangles.len().is_multiple_of(3)
            && region.triangles.iter().all(|vertex| (*vertex as usize) < numbers / 3)
            && region.vertices_m.iter().all(|number| number.is_finite())
    };
    if !message.regions.iter().all(is_region) {
        return refuse(Reason::Unreadable, "has a region whose surface is not whole".to_owned());
    }
    let of_corners = |uv: &[f32]| [[uv[0], uv[1]], [uv[2], uv[3]], [uv[4], uv[5]]];
    let mesh = TriangleMesh {
        vertices_m: message.vertices_m.chunks_exact(3).map(DVec3::from_slice).collect(),
        triangles: message.triangles.chunks_exact(3).map(|of| [of[0], of[1], of[2]]).collect(),
        uv: (!message.uv.is_empty()).then(|| message.uv.chunks_exact(6).map(of_corners).collect()),
        groups: (message.groups.iter())
            .map(|group| Group { name: group.name.clone(), vertices: group.vertices.clone() })
            .collect(),
        regions: (message.regions.iter())
            .map(|region| VolumeRegion {
                name: region.name.clone(),
                vertices_m: region.vertices_m.chunks_exact(3).map(DVec3::from_slice).collect(),
                triangles: region.triangles.chunks_exact(3).map(|of| [of[0], of[1], of[2]]).collect(),
            })
            .collect(),
    };
    let report = palpate_geometry::report(&mesh);
    match if is_solid { report.refusal_of_solid() } else { report.refusal() } {
        Some(finding) => refuse(Reason::Unreadable, finding.to_string()),
        None => Ok(mesh),
    }
}

/// Returns the scene with which a session began, as three parts of a header.
pub(super) fn scene(scene: &Scene) -> (palpate_proto::pb::Scene, Option<pb::TriangleMesh>, pb::Appearance) {
    let mesh = scene.body.kind().mesh().as_ref().map(mesh);
    let Appearance { texture, surface, texture_seed, texture_size } = &scene.appearance;
    let appearance = pb::Appearance {
        texture: texture.as_ref().map(|path| path.display().to_string()).unwrap_or_default(),
        surface: surface.name().to_owned(),
        texture_seed: *texture_seed,
        texture_size: *texture_size,
    };
    (sent(scene), mesh, appearance)
}

/// Checks that this program computes the bits that the journal's inputs gave.
///
/// # Errors
/// Refuses a journal whose generation is not [`REPLAYS`] ([`Reason::NotAvailable`]), and names both versions.
pub fn check_replays(header: &pb::Header) -> Result<()> {
    if header.replays == REPLAYS {
        return Ok(());
    }
    let message = format!(
        "was written by Palpate {} (replays {}), and this is {} (replays {REPLAYS}): the same inputs give other bits; \
         what it recorded can still be shown and exported",
        header.version,
        header.replays,
        super::format::VERSION,
    );
    Err(Refusal::new(Reason::NotAvailable, "replays", message))
}

/// Returns the tissue with which the session of a journal began, compiled under [`limits`] of `given`.
///
/// # Errors
/// Refuses a header without a scene or tissue, a mesh with more than `limits.mesh_vertices` or that is invalid, an
/// unknown name, and values outside the limits or that no tissue has.
pub fn model(header: &pb::Header, given: &Limits) -> Result<Arc<Model>> {
    let limits = limits(given);
    let mut message = required("scene", header.scene.as_ref())?.clone();
    set_absent_viscosity(&mut message);
    let beside = header.mesh.as_ref().map(|mesh| from_mesh(mesh, message.solid.is_some(), &limits)).transpose()?;
    let mut scene = from_scene(&message, beside.as_ref()).map_err(|refusal| refusal.within("scene"))?;
    if let Some(appearance) = &header.appearance {
        scene.appearance = from_appearance(appearance)?;
    }
    let tissue = required("tissue", header.tissue.as_ref())?;
    compiled(&scene, tissue, &limits).map_err(|refusal| refusal.within("tissue"))
}

fn from_appearance(message: &pb::Appearance) -> Result<Appearance> {
    let texture = (!message.texture.is_empty()).then(|| PathBuf::from(&message.texture));
    let surface = PaintedSurface::named("appearance.surface", &message.surface)?;
    let range = palpate_tissue::scene::SMALLEST_TEXTURE..=Limits::default().texture_side;
    let texture_size = message.texture_size.clamp(*range.start(), *range.end());
    Ok(Appearance { texture, surface, texture_seed: message.texture_seed, texture_size })
}

/// Returns a tissue as a message: its coefficients, and how it is stepped. The scene is not in it.
pub fn tissue(model: &Model) -> pb::Tissue {
    let SavedPlan {
        stiffness_n_per_m,
        shear_stiffness_n_per_m,
        anchor_stiffness_n_per_m,
        damping_n_s_per_m,
        volume_stiffness_pa,
        integrator,
        substeps,
        precision,
        sleep_tolerance,
        sleep_tolerance_of_scene,
        expected_error,
        corrected,
    } = model.saved_plan();
    pb::Tissue {
        stiffness_n_per_m,
        shear_stiffness_n_per_m,
        damping_n_s_per_m,
        volume_stiffness_pa,
        anchor_stiffness_n_per_m,
        integrator: integrator.name().to_owned(),
        substeps,
        precision: precision.name().to_owned(),
        sleep_tolerance,
        sleep_tolerance_of_scene,
        expected_error: expected_error.is_finite().then_some(expected_error),
        corrected_integrator: corrected.map(|plan| plan.integrator.name().to_owned()).unwrap_or_default(),
        corrected_substeps: corrected.map(|plan| plan.least_substeps).unwrap_or_default(),
        added_lumps: lumps(&model.scene.added_lumps),
    }
}

/// Returns the scene in which the coefficients of a message act: that with which a session began, with the lumps that were added.
///
/// # Errors
/// Refuses lumps that this tissue can't have.
pub(super) fn scene_of(first: &Scene, message: &pb::Tissue) -> Result<Scene> {
    let lumps = from_lumps(&message.added_lumps);
    if lumps[..] == first.added_lumps[..] { Ok(first.clone()) } else { first.with_added_lumps(&lumps) }
}

/// Returns the tissue in a message, of a session that began with the tissue of `first`, under [`limits`] of `given`.
///
/// # Errors
/// Refuses an unknown integrator or precision, and coefficients, substeps or tolerances that no tissue of that scene
/// has.
pub fn from_tissue(message: &pb::Tissue, first: &Model, given: &Limits) -> Result<Arc<Model>> {
    compiled(&first.scene, message, &limits(given)).map_err(|refusal| refusal.within("tissue"))
}

fn compiled(first: &Scene, message: &pb::Tissue, limits: &Limits) -> Result<Arc<Model>> {
    let least_substeps = message.corrected_substeps;
    let corrected = match message.corrected_integrator.as_str() {
        "" => None,
        name => Some(CorrectedPlan { integrator: Integrator::named("corrected_integrator", name)?, least_substeps }),
    };
    let state = SavedPlan {
        stiffness_n_per_m: message.stiffness_n_per_m,
        shear_stiffness_n_per_m: message.shear_stiffness_n_per_m,
        anchor_stiffness_n_per_m: message.anchor_stiffness_n_per_m,
        damping_n_s_per_m: message.damping_n_s_per_m,
        volume_stiffness_pa: message.volume_stiffness_pa,
        integrator: Integrator::named("integrator", &message.integrator)?,
        substeps: message.substeps,
        precision: Precision::named("precision", &message.precision)?,
        sleep_tolerance: message.sleep_tolerance,
        sleep_tolerance_of_scene: message.sleep_tolerance_of_scene,
        expected_error: message.expected_error.unwrap_or(f64::INFINITY),
        corrected,
    };
    Model::resumed(&scene_of(first, message)?, &state, limits)
}

/// Tips of tools, from the poses of a batch so far: a pose with the tip of the previous one leaves it out.
pub(super) type Tips = BTreeMap<u32, pb::Tip>;

/// Returns an input that acts at `step` as a message. `tips` are those of the batch so far, and are updated.
pub(super) fn input(step: u64, input: &Input, tips: &mut Tips) -> pb::Input {
    use pb::input::What;
    let what = match input {
        Input::Command(due) => What::Command(command(due, tips)),
        Input::Tissue(model) => What::Tissue(tissue(model)),
        Input::Start { until } => What::Start(pb::Start { until_step: *until }),
        Input::Pause => What::Pause(pb::Pause {}),
        Input::DroppedSteps(steps) => What::DroppedSteps(pb::DroppedSteps { steps: *steps }),
        Input::Revive => What::Revive(pb::Revive {}),
        Input::Hold(reason) => What::Hold(pb::Hold { reason: reason.clone() }),
        Input::ExerciseEnded(end) => What::ExerciseResult(exercise::result(end)),
        Input::PhaseEnded(phase) => What::PhaseEnd(pb::PhaseEnd { phase: *phase }),
    };
    pb::Input { step, what: Some(what) }
}

fn command(due: &Due, tips: &mut Tips) -> pb::Command {
    use pb::command::Action as Message;
    let Due { command, late, late_commands, ends_lease } = due;
    #[allow(clippy::cast_possible_truncation)]
    let number = |point: PointId| point.index() as u32;
    let action = match &command.action {
        Action::Push(poke) => Message::Push(pb::Push {
            point: poke.point.map(number),
            centre_m: vector(poke.centre_m),
            force_n: vector(poke.force_n),
            falloff_per_m: poke.falloff_per_m,
            falloff_offset: poke.falloff_offset,
        }),
        Action::Grasp { point, displacement_m } => {
            Message::Grasp(pb::Grasp { point: number(*point), displacement_m: vector(*displacement_m) })
        }
        Action::Pose { place_m, velocity_m_per_s, tip } => {
            let (spring_n_per_m, spring_n_s_per_m) = match tip.coupling {
                Coupling::Constraint => (None, 0.0),
                Coupling::Spring { stiffness_n_per_m, damping_n_s_per_m } => {
                    (Some(stiffness_n_per_m), damping_n_s_per_m)
                }
            };
            let Tip { shape, radius_m, friction, grasps, edge_m, burn_s, .. } = *tip;
            let (shape, edge_m) = (shape as u32, vector(edge_m).filter(|_| edge_m != DVec3::ZERO));
            let tip = pb::Tip { radius_m, friction, grasps, spring_n_per_m, spring_n_s_per_m, shape, edge_m, burn_s };
            let is_same = tips.insert(command.tool, tip) == Some(tip);
            Message::Pose(pb::Pose {
                place_m: vector(*place_m),
                velocity_m_per_s: velocity_m_per_s.and_then(vector),
                tip: (!is_same).then_some(tip),
            })
        }
        Action::Tie { number, tie } => Message::Tie(of_tie(*number, tie.as_ref())),
        Action::Mark(PlaceMark { place_m, diameter_m }) => {
            Message::Mark(pb::Mark { place_m: vector(*place_m), diameter_m: *diameter_m })
        }
        Action::Release => Message::Release(pb::Release {}),
    };
    pb::Command {
        tool: command.tool,
        sequence: command.sequence,
        client_time_ns: command.client_time_ns,
        by_datagram: command.by_datagram,
        at_step: command.at_step,
        time_to_live_s: command.time_to_live_s,
        late: *late,
        late_commands: *late_commands,
        ends_lease: *ends_lease,
        action: Some(action),
    }
}

/// Returns a thread or clip as a message.
fn of_tie(number: u32, tie: Option<&Tie>) -> pb::Tie {
    let bite = |bite: &Bite| pb::Bite { place_m: vector(bite.place_m), radius_m: bite.radius_m };
    let bites = tie.map_or_else(Vec::new, |tie| tie.bites.iter().map(bite).collect());
    let (length_m, friction) = match tie.map(|tie| tie.kind) {
        Some(TieKind::Thread { length_m, friction }) => (Some(length_m), friction),
        Some(TieKind::Clip) | None => (None, 0.0),
    };
    pb::Tie { number, bites, length_m, friction, strength_n: tie.and_then(|tie| tie.strength_n) }
}

/// Returns the thread or clip in a message; without bites it is cut.
fn from_tie(message: &pb::Tie) -> Option<Tie> {
    let bite = |bite: &pb::Bite| Bite { place_m: from_vector(bite.place_m.as_ref()), radius_m: bite.radius_m };
    let kind =
        message.length_m.map_or(TieKind::Clip, |length_m| TieKind::Thread { length_m, friction: message.friction });
    let bites: Vec<Bite> = message.bites.iter().map(bite).collect();
    (!bites.is_empty()).then_some(Tie { bites, kind, strength_n: message.strength_n })
}

/// Fills in the tips that poses of a batch leave out.
///
/// # Errors
/// Refuses a pose without a tip if no earlier pose of its tool has one.
pub(super) fn fill_tips(inputs: &mut [pb::Input]) -> Result<()> {
    use pb::{command::Action, input::What};
    let mut tips = Tips::new();
    for input in inputs {
        let Some(What::Command(command)) = &mut input.what else { continue };
        let Some(Action::Pose(pose)) = &mut command.action else { continue };
        match pose.tip {
            Some(tip) => _ = tips.insert(command.tool, tip),
            None => pose.tip = Some(*required("pose.tip", tips.get(&command.tool))?),
        }
    }
    Ok(())
}

/// Returns the command in a message, for a tissue of `points` points.
///
/// # Errors
/// Refuses a command that breaks `rules`, or that no session accepts.
pub(super) fn from_command(message: &pb::Command, rules: &Rules, points: usize) -> Result<Due> {
    use pb::command::Action as Message;
    let most = rules.most_tools();
    if message.tool >= most {
        let text = format!("is {}, but there are at most {most} tools", message.tool);
        return Err(Refusal::new(Reason::OutOfRange, "tool", text));
    }
    let point = |field: &str, number: u32| {
        let message = || Refusal::new(Reason::OffTissue, field, format!("the tissue has no point {number}"));
        ((number as usize) < points).then(|| PointId::new(number as usize)).ok_or_else(message)
    };
    let action = match required("action", message.action.as_ref())? {
        Message::Push(push) => Action::Push(Poke {
            point: push.point.map(|number| point("push.point", number)).transpose()?,
            centre_m: from_vector(push.centre_m.as_ref()),
            force_n: from_vector(push.force_n.as_ref()),
            falloff_per_m: push.falloff_per_m,
            falloff_offset: push.falloff_offset,
        }),
        Message::Grasp(grasp) => Action::Grasp {
            point: point("grasp.point", grasp.point)?,
            displacement_m: from_vector(grasp.displacement_m.as_ref()),
        },
        Message::Pose(pose) => {
            let tip = required("pose.tip", pose.tip.as_ref())?;
            let shape = usize::try_from(tip.shape).ok().and_then(|number| TipShape::ALL.get(number).copied());
            let shape = shape.ok_or_else(|| Refusal::new(Reason::OutOfRange, "pose.tip.shape", "is unknown"))?;
            let coupling = tip.spring_n_per_m.map_or(Coupling::Constraint, |stiffness_n_per_m| Coupling::Spring {
                stiffness_n_per_m,
                damping_n_s_per_m: tip.spring_n_s_per_m,
            });
            Action::Pose {
                place_m: from_vector(pose.place_m.as_ref()),
                velocity_m_per_s: pose.velocity_m_per_s.as_ref().map(|velocity| from_vector(Some(velocity))),
                tip: Tip {
                    shape,
                    radius_m: tip.radius_m,
                    friction: tip.friction,
                    grasps: tip.grasps,
                    coupling,
                    edge_m: from_vector(tip.edge_m.as_ref()),
                    burn_s: tip.burn_s,
                },
            }
        }
        Message::Tie(message) => Action::Tie { number: message.number, tie: from_tie(message) },
        Message::Mark(pb::Mark { place_m, diameter_m }) => {
            Action::Mark(PlaceMark { place_m: from_vector(place_m.as_ref()), diameter_m: *diameter_m })
        }
        Message::Release(_) => Action::Release,
    };
    let command = Command {
        tool: message.tool,
        sequence: message.sequence,
        client_time_ns: message.client_time_ns,
        by_datagram: message.by_datagram,
        at_step: message.at_step,
        time_to_live_s: message.time_to_live_s,
        action,
        arrival_ns: 0,
    };
    rules.check_one(&command)?;
    Ok(Due { command, late: message.late, late_commands: message.late_commands, ends_lease: message.ends_lease })
}

/// Returns the poses and forces of the tools after `step` steps as a message.
#[allow(clippy::cast_possible_truncation)]
pub(super) fn moment(step: u64, felt: &[Felt]) -> pb::Moment {
    let vector = |v: DVec3| Some(pb::Vector { x: v.x as f32, y: v.y as f32, z: v.z as f32 });
    let tool = |felt: &Felt| pb::FeltTool {
        tool: felt.tool,
        place_m: vector(felt.place_m),
        displacement_m: vector(felt.displacement_m),
        force_n: vector(felt.force_n),
    };
    pb::Moment { step, tools: felt.iter().map(tool).collect() }
}

/// Returns a hash as 32 lowercase hexadecimal digits, as messages have it.
pub fn hash(hash: u128) -> String {
    format!("{hash:032x}")
}

/// Returns the hash in a message, in lowercase or uppercase.
///
/// # Errors
/// Refuses a text that is not 32 hexadecimal digits ([`Reason::Unreadable`]).
pub fn from_hash(text: &str) -> Result<u128> {
    let hash = u128::from_str_radix(text, 16).ok().filter(|_| text.len() == 32);
    hash.ok_or_else(|| Refusal::new(Reason::Unreadable, "hash", "must be 32 hexadecimal digits"))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the model that is read from a journal of a session of `model`.
    fn again(model: &Arc<Model>) -> Arc<Model> {
        let (scene, mesh, appearance) = scene(&model.scene);
        let (scene, appearance, tissue) = (Some(scene), Some(appearance), Some(tissue(model)));
        self::model(&pb::Header { scene, mesh, appearance, tissue, ..Default::default() }, &Limits::default()).unwrap()
    }

    fn assert_same(model: &Arc<Model>, other: &Arc<Model>) {
        assert_eq!(model.scene, other.scene);
        assert_eq!((model.saved_plan(), &model.plan), (other.saved_plan(), &other.plan));
    }

    #[test]
    fn a_header_gives_the_same_model_of_sheets_and_meshes() {
        let sets: [&[&str]; 3] = [
            &["sheet.points=[9, 7]", "appearance.texture_seed=7"],
            &["sheet.points=[9, 7]", "stepping.integrator=lagged", "stepping.precision=f64", "sheet.fixed=[[1, 2]]"],
            &["sheet.points=[5, 5]", "stepping.tolerance=1e-7", "sleep.tolerance=1e-4"],
        ];
        for sets in sets {
            let model = Model::parse("paper", palpate_tissue::scene::PAPER, sets).unwrap();
            assert_same(&model, &again(&model));
        }
        for sets in [&["name=organ"][..], &["mesh.vertices=300"]] {
            let model = Model::parse("gallbladder", crate::GALLBLADDER, sets).unwrap();
            assert_same(&model, &again(&model));
        }
    }

    #[test]
    fn a_journal_of_another_generation_is_refused_with_both_versions() {
        let header = pb::Header { version: "9.8.7".to_owned(), replays: REPLAYS + 1, ..Default::default() };
        let message = check_replays(&header).unwrap_err().message;
        assert!(message.contains("9.8.7") && message.contains(super::super::format::VERSION), "{message}");
    }

    #[test]
    fn a_changed_and_a_corrected_tissue_are_the_same_again() {
        let (first, limits) =
            (Model::parse("paper", palpate_tissue::scene::PAPER, &["sheet.points=[7, 7]"]).unwrap(), Limits::default());
        let change = palpate_tissue::scene::Change { stiffness_n_per_m: Some(55.0), ..Default::default() };
        let changed = first.changed(&change, &first.scene, &limits).unwrap();
        let correction = palpate_tissue::scene::record::Correction {
            step: 5,
            audited_error: Default::default(),
            reason: String::new(),
            integrator: Integrator::Exponential4,
            substeps: 3,
            precision: first.precision,
            sleep_tolerance: 1e-7,
        };
        let corrected = changed.corrected(&correction, &limits).unwrap();
        for model in [&changed, &corrected] {
            assert_same(model, &from_tissue(&tissue(model), &first, &limits).unwrap());
        }
    }
}
