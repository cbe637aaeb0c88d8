//! A session that stayed: the commands of all runs of one that moved, given to one session in their order.
#![allow(unreachable_pub)]

use std::path::PathBuf;

use glam::DVec3;
use palpate_session::Session;
use palpate_session::command::{Command, Due};
use palpate_session::journal::{JournalReader, Vector3, message, pb};
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::script::Action;
use palpate_tissue::shape::PointId;

fn vector(vector: Option<Vector3>) -> DVec3 {
    vector.map_or(DVec3::ZERO, |v| DVec3::new(v.x, v.y, v.z))
}

/// A push as it acted.
fn due(command: pb::Command) -> Due {
    let action = match command.action {
        Some(pb::command::Action::Push(push)) => Action::Push(Poke {
            point: push.point.map(|number| PointId::new(number as usize)),
            centre_m: vector(push.centre_m),
            force_n: vector(push.force_n),
            falloff_per_m: push.falloff_per_m,
            falloff_offset: push.falloff_offset,
        }),
        Some(pb::command::Action::Release(_)) => Action::Release,
        other => panic!("{other:?}"),
    };
    let pb::Command { tool, sequence, client_time_ns, by_datagram, at_step, time_to_live_s, .. } = command;
    let acts = Command { tool, sequence, client_time_ns, by_datagram, at_step, time_to_live_s, action, arrival_ns: 0 };
    Due { command: acts, late: command.late, late_commands: command.late_commands, ends_lease: command.ends_lease }
}

/// Goes on to `step`, as a server does: what is at rest is passed over.
fn advance(session: &mut Session, step: u64, commands: &mut Vec<Due>) {
    while session.step_count() < step {
        let rests = session.rests_until().filter(|until| commands.is_empty() && *until > session.step_count());
        match rests {
            Some(until) => session.skip_to(until.min(step)),
            None => session.advance(commands, |_| {}),
        }
    }
}

/// Compares all hashes of the runs, in their order, with those of a session that has done all of it in one place.
/// Tells how many.
pub fn compare(runs: &[PathBuf]) -> u64 {
    let first = JournalReader::open(&runs[0]).unwrap();
    let model = message::model(first.header(), &Limits::default()).unwrap();
    let begins: Vec<u64> = runs.iter().map(|run| JournalReader::open(run).unwrap().header().begin_step).collect();
    let mut session = Session::new(&model);
    let (mut compared, mut commands) = (0, Vec::new());
    for (index, run) in runs.iter().enumerate() {
        let mut reader = JournalReader::open(run).unwrap();
        // From there on the next run has the steps.
        let end = begins.get(index + 1).copied().unwrap_or(u64::MAX);
        while let Some(batch) = reader.next_batch().unwrap() {
            let hashes = batch.hashes().unwrap().into_iter().map(|at| (at.step, at.hash));
            let snapshots = batch.snapshots().unwrap().into_iter().map(|at| (at.step, at.hash));
            let mut marks: Vec<(u64, String)> = hashes.chain(snapshots).collect();
            marks.sort();
            let mut marks = marks.into_iter().filter(|mark| mark.0 <= end).peekable();
            let mut compare = |session: &mut Session, commands: &mut Vec<Due>, until: u64| {
                while let Some((step, hash)) = marks.next_if(|mark| mark.0 <= until) {
                    // One of an earlier batch's steps was compared by the run before.
                    if step < session.step_count() {
                        continue;
                    }
                    advance(session, step, commands);
                    assert_eq!(hash, message::hash(session.tissue().state_hash()), "{} at {step}", run.display());
                    compared += 1;
                }
            };
            for input in batch.inputs().unwrap() {
                if input.step >= end {
                    break;
                }
                compare(&mut session, &mut commands, input.step);
                advance(&mut session, input.step, &mut commands);
                match input.what {
                    Some(pb::input::What::Command(command)) => commands.push(due(command)),
                    // An audit may have found that it has to be stepped more accurately.
                    Some(pb::input::What::Tissue(tissue)) => {
                        session.change(&message::from_tissue(&tissue, &model, &Limits::default()).unwrap());
                    }
                    _ => {}
                }
            }
            compare(&mut session, &mut commands, end);
        }
    }
    compared
}
