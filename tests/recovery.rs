//! A session whose tissue blows up goes back to the last state that passed the guard's checks, and continues.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

use std::sync::Arc;

use glam::DVec3;
use palpate_session::Session;
use palpate_session::command::Command;
use palpate_session::intake::Intake;
use palpate_session::recovery::{MAX_RECOVERIES, WINDOW_STEPS};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::script::Action;
use palpate_tissue::scene::{Change, PAPER, Scene};

/// Command of the holder of tools 0 and 1: its step, tool and action.
type Order = (u64, u32, Action);

/// The course of a session.
struct SessionRun {
    session: Session,
    /// The state's hash at the end of each step.
    hashes: Vec<u128>,
}

/// Plays `orders`, by ascending step, through an intake as a server does.
fn play(model: &Arc<Model>, orders: &[Order], steps: u64) -> SessionRun {
    let limits = Limits { lease_s: 1e4, ..Limits::default() };
    let (mut session, mut intake) = (Session::new(model), Intake::new(&model.scene, &limits));
    intake.acquire(&[0, 1], "test", 1e4, 1, 0).unwrap();
    let mut due = Vec::new();
    let mut waiting = orders.iter().enumerate().peekable();
    let mut hashes = Vec::new();
    for step in 0..steps {
        while let Some((index, (_, tool, action))) = waiting.next_if(|(_, order)| order.0 == step) {
            let command = Command {
                tool: *tool,
                sequence: Some(index as u64 + 1),
                client_time_ns: 0,
                by_datagram: false,
                at_step: None,
                time_to_live_s: None,
                action: action.clone(),
                arrival_ns: 0,
            };
            intake.submit(1, vec![command], 0).unwrap();
        }
        intake.take_due(step, 0, &mut due);
        session.advance(&mut due, |_| {});
        if session.hold_reason().is_some() {
            break;
        }
        assert_eq!(session.step_count(), step + 1, "time went back");
        hashes.push(session.tissue().state_hash());
    }
    for index in model.points() {
        let point = session.tissue().point(index);
        assert!(point.displacement_m.is_finite() && point.velocity_m_per_s.is_finite(), "{point:?}");
    }
    SessionRun { session, hashes }
}

/// Springs far too stiff for the substeps that the scene gives: each force makes the tissue blow up.
fn stiff() -> Arc<Model> {
    let sets = ["springs.stiffness_n_per_m=1e9", "stepping.substeps=1"].map(str::to_owned);
    // The error is not known, and looking for it would take long.
    let limits = Limits { rehearsal_work: 1, ..Limits::default() };
    Model::compile(&Scene::parse("stiff", PAPER, &sets, &limits).unwrap(), &limits).unwrap()
}

fn push(model: &Model, point: [usize; 2], z_n: f64) -> Action {
    let sheet = model.scene.sheet().unwrap();
    Action::Push(Poke {
        point: None,
        centre_m: model.shape().rest_m(sheet.point(point)),
        force_n: DVec3::new(0.0, 0.0, z_n),
        falloff_per_m: 1.0 / sheet.spacing_m,
        falloff_offset: 0.0,
    })
}

#[test]
fn a_blow_up_undoes_what_led_to_it_and_time_goes_on() {
    let model = stiff();
    let orders = [(20, 0, push(&model, [15, 15], -1.0)), (20, 1, push(&model, [3, 4], -1.0))];
    let SessionRun { session, hashes } = play(&model, &orders, 100);
    assert_eq!((session.hold_reason(), session.step_count()), (None, 100));
    let recoveries = session.recoveries().list();
    let [recovery] = &recoveries[..] else { panic!("{recoveries:?}") };
    assert!(recovery.step > 20 && recovery.step < 60 && !recovery.reason.is_empty(), "{recovery:?}");
    assert_eq!((recovery.state_of_step, recovery.undone_commands), (20, 2));
    // The tissue was at rest in that state, and nothing acts any more.
    assert_eq!((hashes[99], session.tissue().largest_displacement_m()), (hashes[0], 0.0));
    let sample = session.sample(None);
    assert_eq!((sample.recoveries, sample.tools.len()), (1, 2));
    assert!(sample.tools.iter().all(|tool| tool.expired), "{sample:?}");
    let told = sample.recovered.unwrap();
    let tools: Vec<_> = told.tools.iter().map(|ended| (ended.tool, ended.sequence, ended.undone_commands)).collect();
    assert_eq!(tools, [(0, 1, 1), (1, 2, 1)]);
}

#[test]
fn the_same_commands_recover_to_the_same_bits() {
    let model = stiff();
    let orders: Vec<Order> = [20, 90, 91, 500].map(|step| (step, 0, push(&model, [15, 15], -1.0))).to_vec();
    let [first, second] = [(); 2].map(|()| play(&model, &orders, 600));
    assert!(first.session.recoveries().count() >= 3, "{:?}", first.session.recoveries().list());
    assert_eq!(first.session.recoveries().list(), second.session.recoveries().list());
    assert_eq!(first.hashes, second.hashes);
}

#[test]
fn too_many_recoveries_in_a_short_time_pause_the_tool_that_caused_them() {
    let model = stiff();
    let pushed = |tool: u32, steps: &[u64]| -> Vec<Order> {
        steps.iter().map(|step| (*step, tool, push(&model, [15, 15], -1.0))).collect()
    };
    let few = [20, 120, 220, 320];
    let paused = play(&model, &pushed(0, &few), 400).session.recoveries().list();
    let end = paused[0].step + WINDOW_STEPS;
    let told: Vec<_> = paused.iter().map(|recovery| (recovery.at_rest, recovery.paused_until_step)).collect();
    assert_eq!(told, [(false, None), (false, None), (false, None), (true, Some(end))]);
    // Commands during the pause have no effect, to the last step; another tool is not paused.
    let late = [420, 5000, end - 1, end];
    let again = play(&model, &pushed(0, &[&few[..], &late[..]].concat()), end + 100);
    let session = &again.session;
    assert_eq!((session.hold_reason(), session.recoveries().count(), session.paused_commands()), (None, 5, 3));
    assert_eq!(session.recoveries().newest().unwrap().recovery.state_of_step, end);
    let sample = session.sample(Some(&[0, 1]));
    assert_eq!((sample.tools[0].acknowledged_sequence, sample.tools[0].paused_until.is_some()), (8, true));
    assert_eq!(sample.tools[1].paused_until, None);
    let other = play(&model, &[pushed(0, &few), pushed(1, &[420])].concat(), 500).session;
    assert_eq!(
        (other.hold_reason(), other.recoveries().count(), other.paused_commands()),
        (None, MAX_RECOVERIES as u64 + 1, 0)
    );
    // Equal commands give equal bits.
    let repeated = play(&model, &pushed(0, &[&few[..], &late[..]].concat()), end + 100);
    assert_eq!(again.hashes, repeated.hashes);
    // As many, and the last when the first is long over.
    let kept = play(&model, &pushed(0, &[20, 120, 220, WINDOW_STEPS + 70]), WINDOW_STEPS + 200).session;
    assert_eq!((kept.hold_reason(), kept.recoveries().count()), (None, MAX_RECOVERIES as u64));
    assert!(kept.recoveries().list().iter().all(|recovery| recovery.paused_until_step.is_none()));
}

/// Another tissue, legal and too stiff for the substeps that the scene gives, while the sheet is bent.
#[test]
fn a_tissue_that_can_not_bear_its_state_continues_at_rest() {
    let limits = Limits { rehearsal_work: 1, ..Limits::default() };
    let sets = ["sheet.points=[7, 9]", "stepping.substeps=2", "stepping.integrator=central"].map(str::to_owned);
    let model = Model::compile(&Scene::parse("soft", PAPER, &sets, &limits).unwrap(), &limits).unwrap();
    let stiffer = Change { stiffness_n_per_m: Some(1e9), ..Change::default() };
    let stiffer = model.changed(&stiffer, &model.scene, &limits).unwrap();
    let mut session = play(&model, &[(0, 0, push(&model, [3, 4], -1.0))], 100).session;
    assert!(session.fault().is_none() && session.tissue().largest_displacement_m() > 0.0);
    session.change(&stiffer);
    for _ in 0..200 {
        session.advance(&mut Vec::new(), |_| {});
    }
    assert_eq!((session.hold_reason(), session.step_count()), (None, 300));
    let recoveries = session.recoveries().list();
    let [recovery] = &recoveries[..] else { panic!("{recoveries:?}") };
    assert_eq!((recovery.state_of_step, recovery.at_rest, recovery.undone_commands), (100, true, 0));
    assert_eq!(session.tissue().largest_displacement_m(), 0.0);
    assert!(session.sample(None).tools[0].expired);
}
