//! Conversion of commands from and to messages.

use glam::{DQuat, DVec3};
use palpate_haptics::Tip;
use palpate_proto::geometry::{from_place, from_vector, vector};
use palpate_proto::pb;
use palpate_proto::touch::{from_tip, pose};

use super::{from_point, point, required};
use crate::command::Command;
use palpate_refusal::{Reason, Refusal, Result, number};
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::script::{Action, PlaceMark};
use palpate_tissue::scene::tie::{Bite, Tie, TieKind};
use palpate_tissue::shape::{PointId, RestShape};

/// Returns the command in a message that arrived at `arrival_ns`, ns of the server's clock. `shape` is the rest shape
/// of the session's tissue. An absent falloff is that of a fingertip, and an absent tip is [`Tip::default`]. Numbers,
/// forces and reach are not checked ([`Rules::check_one`](crate::rules::Rules::check_one)).
///
/// # Errors
/// Refuses an absent action, centre, point, target or position ([`Reason::Missing`]); a point or place that is not on
/// the tissue; a place in the plane on a mesh, and a point together with a vertex ([`Reason::WrongKind`]); and an
/// orientation whose length is not 1 (within 0.001).
pub fn from_command(message: &pb::Command, shape: &dyn RestShape, arrival_ns: u64) -> Result<Command> {
    use pb::command::Action as Message;
    let action = match required("action", message.action.as_ref())? {
        Message::Force(force) => {
            let (point, centre_m) = match required("force.centre", force.centre.as_ref())? {
                pb::force::Centre::Point(at) => {
                    let point = shape.find("force.point", required("force.point", from_point(Some(at), None))?)?;
                    (Some(point), shape.rest_m(point))
                }
                pb::force::Centre::Vertex(vertex) => {
                    let point =
                        shape.find("force.vertex", required("force.vertex", from_point(None, Some(*vertex)))?)?;
                    (Some(point), shape.rest_m(point))
                }
                pb::force::Centre::CentreM(place) => (None, shape.in_plane_m("force.centre_m", from_place(place))?),
                pb::force::Centre::AtM(place) => (None, at(shape, from_vector(Some(place)))?),
            };
            let force_n = from_vector(force.force_n.as_ref());
            let falloff_per_m = force.falloff_per_m.unwrap_or_else(|| Tip::default().radius_m.recip());
            let falloff_offset = force.falloff_offset.unwrap_or(0.0);
            Action::Push(Poke { point, centre_m, force_n, falloff_per_m, falloff_offset })
        }
        Message::Position(position) => {
            let point = grasped(shape, position)?;
            let displacement_m = match required("position.target", position.target.as_ref())? {
                pb::position::Target::DisplacementM(displacement) => from_vector(Some(displacement)),
                pb::position::Target::PositionM(place) => from_vector(Some(place)) - shape.rest_m(point),
            };
            Action::Grasp { point, displacement_m }
        }
        Message::Pose(pose) => Action::Pose {
            place_m: from_pose(pose)?,
            velocity_m_per_s: pose.velocity_m_per_s.as_ref().map(|velocity| from_vector(Some(velocity))),
            tip: from_tip("pose.tip", pose.tip.as_ref())?,
        },
        Message::Tie(message) => Action::Tie { number: message.number, tie: from_tie(shape, message)? },
        Message::Mark(pb::Mark { place_m, diameter_m }) => {
            let place_m = from_vector(Some(required("mark.place_m", place_m.as_ref())?));
            Action::Mark(PlaceMark { place_m: shape.in_rest_space_m(place_m), diameter_m: *diameter_m })
        }
        Message::Release(_) => Action::Release,
        Message::Instrument(_) => {
            let message =
                format!("is for an instrument of this stream, and tool {} is the first tip of none", message.tool);
            return Err(Refusal::new(Reason::WrongKind, "instrument", message));
        }
    };
    Ok(with_action(message, action, arrival_ns))
}

/// Returns a command with an action of its own and all else from a message.
pub fn with_action(message: &pb::Command, action: Action, arrival_ns: u64) -> Command {
    Command {
        tool: message.tool,
        sequence: message.sequence,
        client_time_ns: message.client_time_ns,
        by_datagram: false,
        at_step: message.at_step,
        time_to_live_s: message.time_to_live_s,
        action,
        arrival_ns,
    }
}

/// Returns the place of a force in space, m; on a sheet, the nearest one in its rest plane.
fn at(shape: &dyn RestShape, place_m: DVec3) -> Result<DVec3> {
    shape.check_place("force.at_m", place_m)?;
    Ok(shape.in_rest_space_m(place_m))
}

/// Returns the point that a tool grasps.
fn grasped(shape: &dyn RestShape, position: &pb::Position) -> Result<PointId> {
    let (point, vertex) = (position.point.as_ref(), position.vertex);
    if point.is_some() && vertex.is_some() {
        let message = "does not go with `position.point`: a tool grasps a point of a sheet or a vertex of a mesh";
        return Err(Refusal::new(Reason::WrongKind, "position.vertex", message));
    }
    let is_vertex = vertex.is_some() || point.is_none() && shape.grid().is_none();
    let field = if is_vertex { "position.vertex" } else { "position.point" };
    shape.find(field, required(field, from_point(point, vertex))?)
}

/// Returns the thread or clip in a message; `None` if it is cut.
fn from_tie(shape: &dyn RestShape, message: &pb::Tie) -> Result<Option<Tie>> {
    use pb::tie::Kind;
    let bites = |field: &str, bites: &[pb::Bite]| -> Result<Vec<Bite>> {
        let of = |(index, bite): (usize, &pb::Bite)| {
            let place_m = required(&format!("{field}.bites[{index}].place_m"), bite.place_m.as_ref())?;
            let place_m = shape.in_rest_space_m(from_vector(Some(place_m)));
            Ok(Bite { place_m, radius_m: bite.radius_m })
        };
        bites.iter().enumerate().map(of).collect()
    };
    Ok(Some(match required("tie.kind", message.kind.as_ref())? {
        Kind::Thread(thread) => Tie {
            bites: bites("tie.thread", &thread.bites)?,
            kind: TieKind::Thread { length_m: thread.length_m, friction: thread.friction },
            strength_n: thread.strength_n,
        },
        Kind::Clip(clip) => {
            Tie { bites: bites("tie.clip", &clip.bites)?, kind: TieKind::Clip, strength_n: clip.strength_n }
        }
        Kind::Cut(_) => return Ok(None),
    }))
}

/// Returns a thread or clip as a message; `None` is one that is cut.
pub fn tie(number: u32, tie: Option<&Tie>) -> pb::Tie {
    use pb::tie::Kind;
    let of = |tie: &Tie| {
        let bite = |bite: &Bite| pb::Bite { place_m: vector(bite.place_m), radius_m: bite.radius_m };
        let (bites, strength_n) = (tie.bites.iter().map(bite).collect(), tie.strength_n);
        match tie.kind {
            TieKind::Thread { length_m, friction } => {
                Kind::Thread(pb::Thread { bites, length_m, friction, strength_n })
            }
            TieKind::Clip => Kind::Clip(pb::Clip { bites, strength_n }),
        }
    };
    pb::Tie { number, kind: Some(tie.map_or(Kind::Cut(pb::Release {}), of)) }
}

/// Returns the position of a pose's tip, m: the position plus the turned offset of the tip.
fn from_pose(pose: &pb::Pose) -> Result<DVec3> {
    let position_m = from_vector(required("pose.position_m", pose.position_m.as_ref()).map(Some)?);
    let offset_m = from_vector(pose.tip_offset_m.as_ref());
    let Some(pb::Quaternion { w, x, y, z }) = pose.orientation else { return Ok(position_m + offset_m) };
    let turn = DQuat::from_xyzw(x, y, z, w);
    number("pose.orientation", turn.length(), "of length 1", |length| (length - 1.0).abs() <= 1e-3)?;
    Ok(position_m + turn.normalize() * offset_m)
}

/// Returns the message for a script's command to tool `tool`, which acts at step `at_step`. Its sequence number is
/// `at_step` + 1 (a thread's has none), and it has no time to live. `client_time_ns` is the client time, ns, or 0. `shape` is the rest
/// shape of the tissue.
#[allow(clippy::cast_possible_truncation)]
pub fn scripted(shape: &dyn RestShape, tool: usize, at_step: u64, action: &Action, client_time_ns: u64) -> pb::Command {
    use pb::command::Action as Message;
    let action = match action {
        Action::Push(poke) => Message::Force(pb::Force {
            centre: Some(match poke.point {
                Some(at) => match point(shape.name(at)) {
                    (Some(point), _) => pb::force::Centre::Point(point),
                    (None, vertex) => pb::force::Centre::Vertex(vertex.unwrap_or_default()),
                },
                None => {
                    let DVec3 { x, y, z } = poke.centre_m;
                    match shape.dimensions() {
                        2 => pb::force::Centre::CentreM(pb::Vector2 { x, y }),
                        _ => pb::force::Centre::AtM(pb::Vector3 { x, y, z }),
                    }
                }
            }),
            force_n: vector(poke.force_n),
            falloff_per_m: Some(poke.falloff_per_m),
            falloff_offset: Some(poke.falloff_offset),
        }),
        Action::Grasp { point: at, displacement_m: DVec3 { x, y, z } } => {
            let (point, vertex) = point(shape.name(*at));
            let target = Some(pb::position::Target::DisplacementM(pb::Vector3 { x: *x, y: *y, z: *z }));
            Message::Position(pb::Position { point, vertex, target })
        }
        Action::Pose { place_m, velocity_m_per_s, tip } => {
            Message::Pose(pb::Pose { velocity_m_per_s: velocity_m_per_s.and_then(vector), ..pose(*place_m, tip) })
        }
        Action::Tie { number, tie: laid } => Message::Tie(tie(*number, laid.as_ref())),
        Action::Mark(PlaceMark { place_m, diameter_m }) => {
            Message::Mark(pb::Mark { place_m: vector(*place_m), diameter_m: *diameter_m })
        }
        Action::Release => Message::Release(pb::Release {}),
    };
    // A tool lays several threads in a step; only commands of which the last counts are numbered by steps.
    let sequence = (!matches!(action, Message::Tie(_))).then_some(at_step + 1);
    let (tool, action) = (tool as u32, Some(action));
    pb::Command { tool, sequence, client_time_ns, at_step: Some(at_step), time_to_live_s: None, action }
}
