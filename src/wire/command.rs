//! Commands.

use glam::DVec3;

use super::{from_place, from_point, from_vector, pb, point, required, vector};
use crate::refusal::Result;
use crate::scene::Sheet;
use crate::scene::law::Poke;
use crate::scene::script::Action;
use crate::session::command::Command;

/// A command out of a message that came at `arrival_ns`.
pub fn from_command(message: &pb::Command, sheet: &Sheet, arrival_ns: u64) -> Result<Command> {
    use pb::command::Action as Message;
    let action = match required("action", message.action.as_ref())? {
        Message::Force(force) => Action::Push(Poke {
            centre_m: match required("force.centre", force.centre.as_ref())? {
                pb::force::Centre::Point(at) => {
                    sheet.index("force.point", from_point(at))?;
                    sheet.rest_m(from_point(at))
                }
                pb::force::Centre::CentreM(place) => from_place(place),
            },
            force_n: from_vector(force.force_n.as_ref()),
            falloff_per_m: force.falloff_per_m,
            falloff_offset: force.falloff_offset,
        }),
        Message::Position(position) => {
            let point = from_point(required("position.point", position.point.as_ref())?);
            sheet.index("position.point", point)?;
            let displacement_m = match required("position.target", position.target.as_ref())? {
                pb::position::Target::DisplacementM(displacement) => from_vector(Some(displacement)),
                pb::position::Target::PositionM(place) => from_vector(Some(place)) - sheet.rest_m(point).extend(0.0),
            };
            Action::Grasp { point, displacement_m }
        }
        Message::Release(_) => Action::Release,
    };
    Ok(Command {
        tool: message.tool,
        sequence: message.sequence,
        client_time_ns: message.client_time_ns,
        at_step: message.at_step,
        time_to_live_s: message.time_to_live_s,
        action,
        arrival_ns,
    })
}

/// A message of what a script tells tool `tool`, to act at step `at_step`.
#[allow(clippy::cast_possible_truncation)]
pub fn scripted(tool: usize, at_step: u64, action: &Action, client_time_ns: u64) -> pb::Command {
    use pb::command::Action as Message;
    let action = match action {
        Action::Push(poke) => Message::Force(pb::Force {
            centre: Some(pb::force::Centre::CentreM(pb::Vector2 { x: poke.centre_m.x, y: poke.centre_m.y })),
            force_n: vector(poke.force_n),
            falloff_per_m: poke.falloff_per_m,
            falloff_offset: poke.falloff_offset,
        }),
        Action::Grasp { point: at, displacement_m: DVec3 { x, y, z } } => Message::Position(pb::Position {
            point: Some(point(*at)),
            target: Some(pb::position::Target::DisplacementM(pb::Vector3 { x: *x, y: *y, z: *z })),
        }),
        Action::Release => Message::Release(pb::Release {}),
    };
    pb::Command {
        tool: tool as u32,
        sequence: at_step + 1,
        client_time_ns,
        at_step: Some(at_step),
        time_to_live_s: None,
        action: Some(action),
    }
}
