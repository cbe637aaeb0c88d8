//! Changes of a tissue's springs, anchor springs and damping while it is in use.

use std::sync::Arc;

use crate::cases::on_every_core;
use crate::common::{advance, scene_with};
use crate::server::{TEST_TIMEOUT, TestServer, TestTouch, force, open, told};
use glam::DVec3;
use palpate_proto::pb;
use palpate_refusal::Reason;
use palpate_session::Session;
use palpate_session::command::{Command, Due};
use palpate_session::intake::Intake;
use palpate_session::schedule::Schedule;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::{Change, PAPER};
use palpate_tissue::{Grasp, Model, Push, Tissue, at_rest};
use tonic::Code;

const SCHEMES: [&[&str]; 7] = [
    &[],
    &["stepping.integrator=central", "stepping.precision=f64"],
    &["stepping.integrator=lagged"],
    &["stepping.integrator=rk4", "stepping.precision=f64"],
    &["stepping.integrator=exponential2", "stepping.precision=compensated"],
    &["stepping.integrator=exponential4", "stepping.precision=f64"],
    &["springs.shear_stiffness_n_per_m=5", "springs.bending=true", "sheet.fixed=edges"],
];

fn compile(sets: &[&str]) -> Arc<Model> {
    crate::common::model(&scene_with(PAPER, sets))
}

fn changed(model: &Model, change: Change) -> Arc<Model> {
    // Undamped tissue without anchor springs takes more rehearsals than a server has time for.
    let limits = Limits { rehearsal_work: u64::MAX, ..Limits::default() };
    model.changed(&change, &model.scene, &limits).unwrap()
}

fn other(k: f64, c: f64, anchor_k: f64) -> Change {
    Change {
        stiffness_n_per_m: Some(k),
        damping_n_s_per_m: Some(c),
        anchor_stiffness_n_per_m: Some(anchor_k),
        volume_stiffness_pa: None,
    }
}

/// A tissue with a push and a grasp.
fn poked(model: &Arc<Model>) -> Box<dyn Tissue> {
    let mut tissue = at_rest(model);
    let scene = &model.scene;
    let Push::Constant(mut poke) = crate::common::push_on(scene, [15, 15], [0.7, 0.0, -2.0]) else { unreachable!() };
    poke.falloff_per_m = 30.0;
    tissue.push(0, Some(Push::Constant(poke)));
    tissue.grasp(1, model.scene.sheet().unwrap().point([22, 8]), Grasp::Target(DVec3::new(0.0, 0.0, 0.02)));
    tissue
}

fn step(tissue: &mut dyn Tissue, steps: u64) {
    for _ in 0..steps {
        tissue.step().unwrap();
    }
}

fn energy_j(tissue: &dyn Tissue) -> f64 {
    let energy = tissue.energy();
    energy.kinetic_j + energy.spring_j + energy.anchor_j
}

/// The largest distance of any point in two states, m.
fn apart_m(a: &dyn Tissue, b: &[DVec3]) -> f64 {
    a.model().points().zip(b).map(|(point, place)| a.point(point).displacement_m.distance(*place)).fold(0.0, f64::max)
}

fn places(tissue: &dyn Tissue) -> Vec<DVec3> {
    tissue.model().points().map(|index| tissue.point(index).displacement_m).collect()
}

#[test]
fn nothing_jumps_but_the_springs() {
    for sets in SCHEMES {
        let model = compile(sets);
        let mut tissue = poked(&model);
        // In full motion.
        step(&mut *tissue, 60);
        let before: Vec<_> = model.points().map(|index| tissue.point(index)).collect();
        let kinetic_j = tissue.energy().kinetic_j;
        let next = changed(&model, other(40.0, 0.2, 9.0));
        tissue.change(&next);
        assert!(Arc::ptr_eq(tissue.model(), &next) && tissue.step_count() == 60);
        assert_eq!(tissue.awake_points(), model.len());
        let fastest = before.iter().map(|point| point.velocity_m_per_s.length()).fold(0.0, f64::max);
        assert!(fastest > 0.1, "{sets:?}");
        let mut pulled_n = 0.0_f64;
        for (index, was) in model.points().zip(&before) {
            let is = tissue.point(index);
            let moved_m = is.displacement_m.distance(was.displacement_m);
            assert!(moved_m < 1e-7 * tissue.largest_displacement_m(), "{sets:?}: point {index:?} moved by {moved_m}");
            // (Second order in the substep for two-step schemes, first for the paper's.)
            let kicked = is.velocity_m_per_s.distance(was.velocity_m_per_s);
            let most = if sets.contains(&"stepping.integrator=lagged") { 5e-3 } else { 2e-3 };
            assert!(kicked < most * fastest, "{sets:?}: point {index:?} was kicked by {kicked} of {fastest} m/s");
            // The same shape with four times the spring stiffness; the forces are linear in k.
            if !sets.iter().any(|set| set.starts_with("sheet.fixed")) {
                pulled_n = pulled_n.max(was.spring_n.length());
                let off_n = is.spring_n.distance(4.0 * was.spring_n);
                assert!(off_n < 2e-5, "{sets:?}: point {index:?} is pulled by {off_n} N other than it should");
            }
        }
        assert!((tissue.energy().kinetic_j / kinetic_j - 1.0).abs() < 5e-3, "{sets:?}");
        step(&mut *tissue, 2000);
        assert_eq!(tissue.guard_events(), 0, "{sets:?}");
    }
}

#[test]
fn the_tissue_moves_to_the_balance_of_one_that_began_so() {
    for sets in SCHEMES {
        let model = compile(sets);
        let next = changed(&model, other(25.0, 0.8, 8.0));
        let mut fresh = poked(&next);
        step(&mut *fresh, 4000);
        let mut tissue = poked(&model);
        step(&mut *tissue, 100);
        let before = places(&*tissue);
        tissue.change(&next);
        step(&mut *tissue, 4000);
        let balance = places(&*fresh);
        let largest_m = fresh.largest_displacement_m();
        assert!(apart_m(&*tissue, &balance) < 2e-5 * largest_m, "{sets:?}: {}", apart_m(&*tissue, &balance));
        assert!(apart_m(&*tissue, &before) > 0.05 * largest_m, "{sets:?}");
        assert_eq!(next.precision, model.precision);
    }
}

/// A change that is undone at once has no effect beyond rounding and the scheme's history.
#[test]
fn a_change_in_full_motion_does_not_disturb_the_course() {
    for (sets, most) in SCHEMES.iter().zip([2e-4, 2e-4, 2e-3, 1e-9, 1e-4, 2e-4, 2e-4]) {
        let model = compile(sets);
        let [mut changed_twice, mut alone] = [poked(&model), poked(&model)];
        step(&mut *changed_twice, 40);
        step(&mut *alone, 40);
        changed_twice.change(&changed(&model, other(500.0, 0.0, 0.0)));
        changed_twice.change(&model);
        step(&mut *changed_twice, 200);
        step(&mut *alone, 200);
        let off_m = apart_m(&*changed_twice, &places(&*alone));
        assert!(
            off_m < most * alone.largest_displacement_m(),
            "{sets:?}: {off_m} of {}",
            alone.largest_displacement_m()
        );
    }
}

#[test]
fn extremes_stay_finite_and_end_in_balance() {
    on_every_core(&SCHEMES, |sets| {
        let model = compile(sets);
        let mut tissue = poked(&model);
        step(&mut *tissue, 80);
        // (Without any restoring force, a pushed sheet flies off.)
        let changes = [
            (other(1e4, 0.0, 0.0), 100),
            (other(0.0, 0.0, 0.0), 20),
            (other(0.0, 20.0, 300.0), 100),
            (other(300.0, 2.0, 0.0), 100),
        ];
        for (change, steps) in changes {
            tissue.change(&changed(tissue.model(), change));
            step(&mut *tissue, steps);
            assert!(energy_j(&*tissue).is_finite() && tissue.largest_displacement_m() < 10.0, "{sets:?}: {change:?}");
        }
        tissue.change(&model);
        let mut fresh = poked(&model);
        step(&mut *tissue, 6000);
        step(&mut *fresh, 6000);
        let off_m = apart_m(&*tissue, &places(&*fresh));
        assert!(off_m < 1e-4 * fresh.largest_displacement_m(), "{sets:?}: {off_m}");
    });
}

#[test]
fn a_sheet_at_rest_wakes_for_it_and_sleeps_again() {
    let model = compile(&[]);
    let mut tissue = poked(&model);
    tissue.release(1);
    let sleep = |tissue: &mut dyn Tissue| (0..20_000).any(|_| tissue.step().is_ok() && tissue.is_still());
    assert!(sleep(&mut *tissue));
    let before = places(&*tissue);
    let next = changed(&model, Change { anchor_stiffness_n_per_m: Some(10.0), ..Change::default() });
    tissue.change(&next);
    assert!(!tissue.is_still());
    assert!(sleep(&mut *tissue));
    let mut fresh = poked(&next);
    fresh.release(1);
    assert!(sleep(&mut *fresh));
    let off_m = apart_m(&*tissue, &places(&*fresh));
    assert!(off_m < 2e-5 * fresh.largest_displacement_m(), "{off_m}");
    // Twice the anchor stiffness, with the other springs unchanged: less deep, and more than half as deep.
    let centre = model.scene.sheet().unwrap().point([15, 15]);
    let ratio = tissue.point(centre).displacement_m.z / before[centre.index()].z;
    assert!((0.5..0.9).contains(&ratio), "{ratio}");
}

#[test]
fn shear_keeps_its_ratio_through_a_k_of_nothing() {
    let model = compile(&["springs.shear_stiffness_n_per_m=4", "springs.bending=true"]);
    let k = |k: f64| Change { stiffness_n_per_m: Some(k), ..Change::default() };
    let none = changed(&model, k(0.0));
    let springs = &none.scene.springs;
    assert_eq!((springs.stiffness_n_per_m, springs.shear_stiffness_n_per_m), (0.0, 0.0));
    let again = none.changed(&k(30.0), &model.scene, &Limits::default()).unwrap();
    assert_eq!(again.scene.springs.shear_stiffness_n_per_m, 12.0);
    assert_eq!(again.scene.damping_n_s_per_m, model.scene.damping_n_s_per_m);
}

#[test]
fn what_is_refused_is_refused_as_in_a_scene() {
    let model = compile(&[]);
    let refused = |change: Change| {
        let refusal = model.changed(&change, &model.scene, &Limits::default()).unwrap_err();
        (refusal.reason, refusal.field)
    };
    let field = |name: &str| name.to_owned();
    let change = Change::default();
    assert_eq!(refused(change).0, Reason::Missing);
    let k = |value| Change { stiffness_n_per_m: Some(value), ..change };
    assert_eq!(refused(k(-1.0)), (Reason::OutOfRange, field("springs.stiffness_n_per_m")));
    assert_eq!(refused(k(f64::NAN)), (Reason::NotFinite, field("springs.stiffness_n_per_m")));
    let few = Limits { substeps: 10, ..Limits::default() };
    let refusal = model.changed(&k(1e10), &model.scene, &few).unwrap_err();
    assert_eq!((refusal.reason, refusal.field), (Reason::TooLarge, field("stepping.substeps")));
    let c = Change { damping_n_s_per_m: Some(f64::INFINITY), ..change };
    assert_eq!(refused(c), (Reason::NotFinite, field("damping.coefficient_n_s_per_m")));
    let both = Change { stiffness_n_per_m: Some(20.0), anchor_stiffness_n_per_m: Some(-2.0), ..change };
    assert_eq!(refused(both), (Reason::OutOfRange, field("anchor_springs.stiffness_n_per_m")));
}

#[test]
fn changes_act_in_order_and_wake_a_session_at_rest() {
    let model = compile(&[]);
    let mut intake = Intake::new(&model.scene, &Limits::default());
    let schedule = Schedule::new(0, 1_000_000, 1000.0);
    let stiff = |k: f64| changed(&model, Change { stiffness_n_per_m: Some(k), ..Change::default() });
    let (a, b, c) = (stiff(20.0), stiff(30.0), stiff(40.0));
    assert_eq!(intake.rest(0, u64::MAX, &schedule), u64::MAX);
    assert_eq!(intake.change(None, &a, Some(500), 0).unwrap(), Some(500));
    assert!(intake.take_wake());
    assert_eq!(intake.rest(0, u64::MAX, &schedule), 500);
    // Made from a tissue that is no longer the newest.
    assert_eq!(intake.change(None, &b, Some(500), 0).unwrap(), None);
    let refusal = intake.change(Some(&a), &b, Some(499), 0).unwrap_err();
    assert_eq!((refusal.reason, refusal.field.as_str()), (Reason::OutOfTurn, "at_step"));
    assert_eq!(intake.change(Some(&a), &b, Some(500), 0).unwrap(), Some(500));
    assert_eq!(intake.change(Some(&b), &c, Some(501), 0).unwrap(), Some(501));
    assert!(intake.take_change(499).is_none());
    assert!(intake.take_change(500).is_some_and(|model| Arc::ptr_eq(&model, &b)));
    assert!(intake.take_change(501).is_some_and(|model| Arc::ptr_eq(&model, &c)));
    assert!(intake.take_change(u64::MAX).is_none());
    let mut base = c;
    let (refusal, waiting) = (0..1_000_000)
        .find_map(|waiting| {
            let next = Arc::new(Model::clone(&base));
            match intake.change(Some(&base), &next, Some(1000 + waiting), 0) {
                Ok(_) => {
                    base = next;
                    None
                }
                Err(refusal) => Some((refusal, waiting)),
            }
        })
        .unwrap();
    assert_eq!((refusal.reason, waiting), (Reason::QueueFull, Limits::default().queued_changes as u64));
}

fn update(session_id: &str, change: Change, at_step: Option<u64>) -> pb::UpdateTissueRequest {
    pb::UpdateTissueRequest {
        session_id: session_id.into(),
        stiffness_n_per_m: change.stiffness_n_per_m,
        damping_n_s_per_m: change.damping_n_s_per_m,
        anchor_stiffness_n_per_m: change.anchor_stiffness_n_per_m,
        volume_stiffness_pa: change.volume_stiffness_pa,
        at_step,
    }
}

/// The result in a server of a push and two changes, and its reports.
async fn over_the_network(threads: &str) -> String {
    let server = TestServer::start(&["--threads", threads]);
    let session_id = server.paper(true).await;
    let mut sessions = server.sessions().await;
    let mut touch = TestTouch::hold(&server, &session_id).await;
    touch.command(pb::Command { at_step: Some(5), ..force(0, 1, -2.0) }).await;
    touch.settle().await;
    let first = Change { stiffness_n_per_m: Some(60.0), ..Change::default() };
    let answer = sessions.update_tissue(update(&session_id, first, Some(50))).await.unwrap().into_inner();
    assert_eq!(answer.step, 50);
    let springs = answer.session.unwrap().scene.unwrap().springs.unwrap();
    assert_eq!((springs.stiffness_n_per_m, springs.shear_stiffness_n_per_m), (Some(60.0), Some(60.0)));
    // It has not taken effect yet.
    let scene = server.status(&session_id).await.scene.unwrap();
    assert_eq!(scene.springs.unwrap().stiffness_n_per_m, Some(10.0));
    // A refused change has no effect, neither now nor later.
    let bad = Change { damping_n_s_per_m: Some(0.1), anchor_stiffness_n_per_m: Some(f64::NAN), ..Change::default() };
    let refused = sessions.update_tissue(update(&session_id, bad, Some(60))).await.unwrap_err();
    assert_eq!(told(&refused), (Code::InvalidArgument, "NOT_FINITE".into(), "anchor_springs.stiffness_n_per_m".into()));
    let second = Change { anchor_stiffness_n_per_m: Some(12.0), ..Change::default() };
    sessions.update_tissue(update(&session_id, second, Some(120))).await.unwrap();
    let early = sessions.update_tissue(update(&session_id, second, Some(119))).await.unwrap_err();
    assert_eq!(told(&early), (Code::InvalidArgument, "OUT_OF_TURN".into(), "at_step".into()));
    server.start_until(&session_id, 300).await;
    let hash = server.hash_at(&session_id, 300).await;
    let scene = server.status(&session_id).await.scene.unwrap();
    assert_eq!(scene.springs.unwrap().stiffness_n_per_m, Some(60.0));
    assert_eq!(scene.anchor_springs.unwrap().stiffness_n_per_m, Some(12.0));
    assert_eq!(scene.damping.unwrap().coefficient_n_s_per_m, Some(0.5));
    hash
}

#[tokio::test]
async fn the_same_bits_on_any_number_of_threads_and_offline() {
    let hash = over_the_network("1").await;
    assert_eq!(over_the_network("2").await, hash);

    let model = compile(&[]);
    let mut session = Session::new(&model);
    let message = pb::Command { at_step: Some(5), ..force(0, 1, -2.0) };
    let command: Command = palpate_session::wire::command::from_command(&message, model.shape(), 0).unwrap();
    advance(&mut session, 5);
    session.advance(&mut vec![Due { command, late: false, late_commands: 0, ends_lease: false }], |_| {});
    advance(&mut session, 44);
    let stiff = changed(&model, Change { stiffness_n_per_m: Some(60.0), ..Change::default() });
    session.change(&stiff);
    advance(&mut session, 70);
    session.change(&changed(&stiff, Change { anchor_stiffness_n_per_m: Some(12.0), ..Change::default() }));
    advance(&mut session, 180);
    assert_eq!((session.step_count(), format!("{:032x}", session.tissue().state_hash())), (300, hash));
}

#[tokio::test]
async fn a_running_session_changes_at_once_and_logs_it() {
    let server = TestServer::start(&[]);
    let session_id = server.paper(false).await;
    // The holder sends nothing while the tissue comes to rest.
    let patient = pb::TouchOpen { lease_s: Some(600.0), ..open(&session_id, &[0]) };
    let mut touch = TestTouch::open(&server, patient).await.unwrap();
    touch.command(force(0, 1, -2.0)).await;
    let depth_m = |sample: &pb::Sample| -sample.tools[0].displacement_m.map_or(0.0, |at| at.z);
    touch.sample_with(|sample| depth_m(sample) > 0.01).await;
    // Another client than the one that holds the tool.
    let mut sessions = server.sessions().await;
    let softer = Change { anchor_stiffness_n_per_m: Some(1.0), ..Change::default() };
    let answer = sessions.update_tissue(update(&session_id, softer, None)).await.unwrap().into_inner();
    let mut fresh = Session::new(&changed(&compile(&[]), softer));
    let command = palpate_session::wire::command::from_command(&force(0, 1, -2.0), fresh.model().shape(), 0).unwrap();
    fresh.advance(&mut vec![Due { command, late: false, late_commands: 0, ends_lease: false }], |_| {});
    advance(&mut fresh, 20_000);
    let fresh_m = -fresh.sample(None).tools[0].contact.unwrap().displacement_m.z;
    let balanced =
        touch.sample_with(|sample| sample.step > answer.step && (depth_m(sample) / fresh_m - 1.0).abs() < 1e-4);
    tokio::time::timeout(TEST_TIMEOUT, balanced).await.expect("it comes to the balance of one that began so");
    let nothing = sessions.update_tissue(update(&session_id, Change::default(), None)).await.unwrap_err();
    assert_eq!(told(&nothing).1, "MISSING");
    let nobody = sessions.update_tissue(update("nobody", softer, None)).await.unwrap_err();
    assert_eq!(told(&nobody).1, "UNKNOWN_SESSION");
    let log = server.log();
    assert!(log.contains("tissue changed") && log.contains("anchor_stiffness_n_per_m=1"), "{log}");
}
