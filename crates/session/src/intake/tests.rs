//! Tests of the intake in virtual time: rest, stamps, leases.
#![allow(clippy::unwrap_used)]

use super::super::batch::SLICE;
use super::*;
use crate::budget::Budget;
use palpate_haptics::{Tip, TipShape};
use palpate_tissue::scene::PAPER;
use palpate_tissue::shape::PointId;

const LEASE: LeaseId = 7;
const MS: u64 = 1_000_000;

/// Tool 0 is held for a second from time 0 on; step k is due at k ms.
fn intake() -> (Intake, Schedule) {
    let limits = Limits::default();
    let scene = Scene::parse("paper", PAPER, &[], &limits).unwrap();
    let mut intake = Intake::new(&scene, &limits);
    intake.acquire(&[0], "test", 1.0, LEASE, 0).unwrap();
    (intake, Schedule::new(0, 0, 1000.0))
}

fn release(sequence: u64, at_step: Option<u64>) -> Command {
    Command { at_step, ..Command::new(0, Some(sequence), Action::Release) }
}

fn steps(intake: &Intake) -> Vec<u64> {
    intake.queue.in_order().iter().map(|(key, _)| key.0).collect()
}

#[test]
fn a_command_at_rest_acts_at_the_next_step_by_the_clock_and_wakes_once() {
    let (mut intake, schedule) = intake();
    // At rest until the lease would expire.
    assert_eq!(intake.rest(5, u64::MAX, &schedule), 1001);
    intake.submit(LEASE, vec![release(1, None)], 500 * MS).unwrap();
    assert_eq!((steps(&intake), intake.take_wake(), intake.take_wake()), (vec![501], true, false));
    // Time does not pass a waiting command: a second one comes with it or after it.
    intake.submit(LEASE, vec![release(2, None)], 520 * MS).unwrap();
    assert_eq!(steps(&intake), [501, 501]);
    assert!(!intake.take_wake());
    assert_eq!(intake.rest(5, u64::MAX, &schedule), 501);
    let mut due = Vec::new();
    intake.take_due(501, 520 * MS, &mut due);
    assert_eq!((due.len(), intake.next_step(), intake.is_resting()), (2, 502, false));
    assert!(due.iter().all(|due| !due.late));
}

#[test]
fn stamps_mean_the_same_at_rest() {
    let (mut intake, schedule) = intake();
    intake.rest(0, u64::MAX, &schedule);
    let commands = vec![release(1, Some(400)), release(2, Some(501)), release(3, Some(800))];
    intake.submit(LEASE, commands, 500 * MS).unwrap();
    // Step 400 is over at 500 ms, though no step was computed.
    assert_eq!(steps(&intake), [501, 501, 800]);
    assert_eq!(intake.queue.in_order().iter().map(|(_, due)| due.late).collect::<Vec<_>>(), [true, false, false]);
    assert_eq!(intake.rest(0, u64::MAX, &schedule), 501);
    intake.take_due(501, 501 * MS, &mut Vec::new());
    assert_eq!(intake.rest(502, u64::MAX, &schedule), 800);
}

#[test]
fn a_lease_expires_at_rest_and_what_is_wanted_earlier_comes_first() {
    let (mut intake, schedule) = intake();
    assert_eq!(intake.rest(3, 50, &schedule), 50);
    // The clock is late: time stands at the step that is to be done.
    intake.release_expired(90 * MS);
    assert_eq!(intake.next_step(), 50);
    assert_eq!(intake.rest(51, u64::MAX, &schedule), 1001);
    intake.release_expired(1000 * MS);
    assert_eq!((intake.expired(), steps(&intake), intake.take_wake()), (1, vec![1001], true));
    // A session whose very next step is wanted does not rest.
    assert_eq!(intake.rest(1001, u64::MAX, &schedule), 1001);
    assert!(!intake.is_resting());
}

#[test]
fn a_lease_expires_at_the_step_of_its_time_however_late_it_is_noticed() {
    let (mut intake, schedule) = intake();
    intake.rest(0, u64::MAX, &schedule);
    intake.acquire(&[3], "", 0.2, 2, 20 * MS).unwrap();
    intake.acquire(&[1], "", 0.1, 3, 30 * MS).unwrap();
    intake.release_expired(500 * MS);
    assert_eq!((intake.expired(), steps(&intake), intake.next_step()), (2, vec![131, 131], 131));
}

#[test]
fn renewing_wakes_nobody() {
    let (mut intake, schedule) = intake();
    intake.rest(0, u64::MAX, &schedule);
    intake.renew(LEASE, 900 * MS).unwrap();
    assert!(!intake.take_wake());
    assert_eq!(intake.rest(1001, u64::MAX, &schedule), 1901);
}

#[test]
fn a_command_without_a_sequence_follows_the_one_before() {
    let (mut intake, _) = intake();
    let unnumbered = || Command { sequence: None, ..release(0, Some(2)) };
    intake.submit(LEASE, vec![unnumbered(), unnumbered()], 0).unwrap();
    assert_eq!(intake.submit(LEASE, vec![release(1, Some(2))], 0).unwrap_err().reason, Reason::StaleSequence);
    intake.submit(LEASE, vec![release(7, Some(2)), unnumbered()], 0).unwrap();
    intake.submit(LEASE, vec![unnumbered()], 0).unwrap();
    let sequences: Vec<_> = due(&mut intake, 2).iter().map(|due| due.command.sequence).collect();
    assert_eq!(sequences, [0, 1, 7, 8, 9].map(Some));
    // No number follows the largest one.
    intake.submit(LEASE, vec![release(u64::MAX, Some(3))], 0).unwrap();
    assert_eq!(intake.submit(LEASE, vec![unnumbered()], 0).unwrap_err().reason, Reason::StaleSequence);
}

#[test]
fn a_tool_keeps_its_tip_until_it_is_released() {
    let (mut intake, _) = intake();
    let lead = |sequence, radius_m| Command {
        action: Action::Pose {
            place_m: glam::DVec3::ZERO,
            velocity_m_per_s: None,
            tip: Tip { radius_m, ..Tip::default() },
        },
        ..release(sequence, None)
    };
    intake.submit(LEASE, vec![lead(1, 0.005)], 0).unwrap();
    let refused = intake.submit(LEASE, vec![lead(2, 0.005), lead(3, 0.006)], 0).unwrap_err();
    assert_eq!((refused.reason, refused.field.as_str()), (Reason::OutOfTurn, "pose.tip.radius_m"));
    // A refused batch changes nothing.
    intake.submit(LEASE, vec![lead(2, 0.005), release(3, None), lead(4, 0.006)], 0).unwrap();
    assert!(intake.submit(LEASE, vec![lead(5, 0.005)], 0).is_err());
}

#[test]
fn poses_that_came_by_datagram_may_have_been_overtaken_and_no_others() {
    let (mut intake, _) = intake();
    let pose = |sequence: u64, by_datagram| Command {
        action: Action::Pose { place_m: glam::DVec3::ZERO, velocity_m_per_s: None, tip: Tip::default() },
        client_time_ns: sequence * 1_000_000,
        by_datagram,
        ..release(sequence, None)
    };
    intake.submit(LEASE, vec![pose(5, true)], 0).unwrap();
    intake.submit(LEASE, vec![pose(3, true), pose(4, true)], 0).unwrap();
    // A late pose does not lower the newest number.
    assert_eq!(intake.submit(LEASE, vec![pose(5, false)], 0).unwrap_err().reason, Reason::StaleSequence);
    intake.submit(LEASE, vec![pose(6, false)], 0).unwrap();
    let sequences: Vec<_> = due(&mut intake, 1).iter().map(|due| due.command.sequence).collect();
    assert_eq!(sequences, [5, 3, 4, 6].map(Some));
    // Velocities are for poses that are played by client time.
    let action =
        Action::Pose { place_m: glam::DVec3::ZERO, velocity_m_per_s: Some(glam::DVec3::X), tip: Tip::default() };
    let refused = intake.submit(LEASE, vec![Command { action, ..release(7, Some(9)) }], 0).unwrap_err();
    assert_eq!(refused.field, "pose.velocity_m_per_s");
}

/// A grasp of a free point, for step `at_step`.
fn grasp(sequence: u64, at_step: u64) -> Command {
    let action = Action::Grasp { point: PointId::new(15 * 31 + 15), displacement_m: glam::DVec3::ZERO };
    Command { action, ..release(sequence, Some(at_step)) }
}

fn due(intake: &mut Intake, step: u64) -> Vec<Due> {
    let mut due = Vec::new();
    intake.take_due(step, 0, &mut due);
    due
}

#[test]
fn commands_of_one_step_act_in_the_order_in_which_they_came() {
    let (mut intake, _) = intake();
    for commands in
        [vec![release(1, Some(2))], vec![release(2, Some(1)), release(3, Some(2))], vec![release(4, Some(2))]]
    {
        intake.submit(LEASE, commands, 0).unwrap();
    }
    let order = |due: Vec<Due>| due.iter().filter_map(|due| due.command.sequence).collect::<Vec<_>>();
    assert_eq!(order(due(&mut intake, 0)), [0; 0]);
    assert_eq!(order(due(&mut intake, 1)), [2]);
    assert_eq!(order(due(&mut intake, 2)), [1, 3, 4]);
}

#[test]
fn every_accepted_command_is_counted_by_one_outcome() {
    let (mut intake, _) = intake();
    let commands = vec![grasp(1, 5), grasp(2, 5), grasp(3, 5), grasp(4, 6), release(5, Some(6)), release(6, Some(9))];
    intake.submit(LEASE, commands, 0).unwrap();
    // The last of several positions for one step counts.
    let counts = Counts { accepted: 6, superseded: 2, waiting: 4, ..Counts::default() };
    assert_eq!(intake.counts(), counts);
    assert_eq!(due(&mut intake, 5).len(), 1);
    assert_eq!(intake.counts(), Counts { applied: 1, waiting: 3, ..counts });
    assert_eq!(due(&mut intake, 6).len(), 2);
    intake.release(LEASE).unwrap();
    assert_eq!(intake.counts(), Counts { applied: 3, dropped: 1, waiting: 0, ..counts });
    // The end of a lease is not a client's command.
    assert!(due(&mut intake, 7).iter().all(|due| due.ends_lease));
    assert_eq!(intake.counts(), Counts { applied: 3, dropped: 1, waiting: 0, ..counts });
}

#[test]
fn a_closed_intake_refuses_with_its_reason_until_it_is_opened_again() {
    let (mut intake, _) = intake();
    let refusal = Refusal::new(Reason::NotAvailable, "", "the session has ended");
    intake.submit(LEASE, vec![release(1, Some(3))], 0).unwrap();
    drop(intake.close(refusal.clone()));
    assert_eq!(intake.counts(), Counts { accepted: 1, dropped: 1, ..Counts::default() });
    let model = Model::parse("paper", palpate_tissue::scene::PAPER, &["sheet.points=[3, 3]"]).unwrap();
    let refused = [
        intake.submit(LEASE, vec![release(2, None)], 0).unwrap_err(),
        intake.acquire(&[1], "test", 1.0, LEASE + 1, 0).unwrap_err(),
        intake.change(None, &model, None, 0).unwrap_err(),
    ];
    for refused in refused {
        assert_eq!((refused.reason, &refused.message), (refusal.reason, &refusal.message));
    }
    intake.reopen();
    intake.acquire(&[0], "test", 1.0, LEASE, 0).unwrap();
    intake.submit(LEASE, vec![release(2, None)], 0).unwrap();
}

#[test]
fn a_change_of_tissue_is_made_from_the_newest() {
    let (mut intake, _) = intake();
    let [first, second] = ["4.0", "6.0"].map(|k| {
        Model::parse(
            "paper",
            palpate_tissue::scene::PAPER,
            &["sheet.points=[3, 3]", &format!("anchor_springs.stiffness_n_per_m={k}")],
        )
        .unwrap()
    });
    assert_eq!(intake.change(Some(&first), &second, Some(7), 0), Ok(None));
    assert_eq!(intake.change(None, &first, Some(7), 0), Ok(Some(7)));
    // Made from a tissue that is no longer the newest.
    assert_eq!(intake.change(None, &second, Some(8), 0), Ok(None));
    assert_eq!(intake.change(Some(&first), &second, Some(8), 0), Ok(Some(8)));
    assert!(intake.take_change(6).is_none());
    assert!(Arc::ptr_eq(&intake.take_change(7).unwrap(), &first));
    assert!(Arc::ptr_eq(&intake.take_change(8).unwrap(), &second));
}

#[test]
fn a_batch_is_taken_in_slices_and_acts_whole() {
    let (mut intake, _) = intake();
    intake.acquire(&[1], "other", 1.0, LEASE + 1, 0).unwrap();
    intake.submit(LEASE, vec![release(1, Some(3))], 0).unwrap();
    let commands: Vec<_> = (2..902).map(|sequence| release(sequence, Some(3 + sequence % 2))).collect();
    let checked = intake.rules().check(commands).unwrap();
    let mut batch = intake.accept(LEASE, checked, 0).unwrap();
    let mut slices = 1;
    assert!(intake.go_on(&mut batch));
    // Other leases are not blocked; no other command of this lease can come between.
    let of_other = |sequence| Command { tool: 1, ..release(sequence, Some(3)) };
    intake.submit(LEASE + 1, vec![of_other(1)], 0).unwrap();
    assert_eq!(intake.submit(LEASE, vec![release(1000, None)], 0).unwrap_err().reason, Reason::OutOfTurn);
    // Commands from before the batch act at their step.
    let mut due = Vec::new();
    intake.take_due(4, 0, &mut due);
    let came = due.iter().map(|due| (due.command.tool, due.command.sequence));
    assert_eq!(came.collect::<Vec<_>>(), [(0, Some(1)), (1, Some(1))]);
    while intake.go_on(&mut batch) {
        slices += 1;
    }
    assert_eq!(slices + 1, 900_usize.div_ceil(SLICE));
    due.clear();
    intake.take_due(5, 0, &mut due);
    let mut sequences: Vec<_> = due.iter().filter_map(|due| due.command.sequence).collect();
    sequences.sort_unstable();
    assert_eq!(sequences, (2..902).collect::<Vec<_>>());
    assert_eq!(intake.counts(), Counts { accepted: 902, applied: 902, ..Counts::default() });
    intake.submit(LEASE, vec![release(1000, None)], 0).unwrap();
}

#[test]
fn a_batch_whose_tool_is_released_meanwhile_is_dropped_whole() {
    let (mut intake, _) = intake();
    let commands: Vec<_> = (0..600).map(|sequence| release(sequence, Some(9))).collect();
    let checked = intake.rules().check(commands).unwrap();
    let mut batch = intake.accept(LEASE, checked, 0).unwrap();
    assert!(intake.go_on(&mut batch));
    assert_eq!(intake.counts(), Counts { accepted: 600, waiting: 600, ..Counts::default() });
    intake.release(LEASE).unwrap();
    // The next holder of the tool has none of it.
    intake.acquire(&[0], "next", 1.0, LEASE + 1, 0).unwrap();
    while intake.go_on(&mut batch) {}
    let mut due = Vec::new();
    intake.take_due(9, 0, &mut due);
    assert!(due.iter().all(|due| due.ends_lease) && due.len() == 1);
    assert_eq!(intake.counts(), Counts { accepted: 600, dropped: 600, ..Counts::default() });
}

#[test]
fn the_memory_of_commands_that_wait_is_charged_and_given_back_as_they_are_done_or_discarded() {
    let account = Account::alone();
    let mut intake = intake().0.charged_to(&account);
    let charged = || account.has(Resource::Memory(Purpose::Commands));
    // In whole pieces, of which the first is free. Nodes of a tree are two thirds full.
    let is_charged = |count: u64| {
        let bytes = 3 * count * size_of::<(QueueKey, Due)>() as u64 / 2;
        charged().is_multiple_of(PIECE_BYTES) && (charged()..charged() + PIECE_BYTES).contains(&bytes)
    };
    for sequence in 0..3000 {
        intake.submit(LEASE, vec![release(sequence, Some(10 + sequence / 1000))], 0).unwrap();
        assert!(is_charged(sequence + 1), "{} bytes for {}", charged(), sequence + 1);
    }
    assert!(charged() > 4 * PIECE_BYTES, "{}", charged());
    for (step, left) in [(10, 2000), (11, 1000), (12, 0)] {
        assert_eq!((due(&mut intake, step).len(), is_charged(left)), (1000, true), "{} bytes for {left}", charged());
    }
    // A batch is discarded as a whole at the end of its lease.
    intake.submit(LEASE, (3000..6000).map(|sequence| release(sequence, Some(100))).collect::<Vec<_>>(), 0).unwrap();
    assert!(is_charged(3000), "{}", charged());
    intake.release(LEASE).unwrap();
    due(&mut intake, 13);
    assert_eq!(charged(), 0);
}

#[test]
fn the_memory_of_cuts_is_charged_with_the_first_command_that_may_cut() {
    let account = Account::alone();
    let mut intake = intake().0.charged_to(&account).of_cut_bytes(5000);
    let has = || account.has(Resource::Memory(Purpose::Session));
    let pose = |sequence: u64, tip: Tip| Command {
        action: Action::Pose { place_m: glam::DVec3::ZERO, velocity_m_per_s: None, tip },
        ..release(sequence, None)
    };
    intake.submit(LEASE, vec![pose(1, Tip::default()), release(2, None)], 0).unwrap();
    assert_eq!(has(), 0);
    let blade = Tip { shape: TipShape::Blade, edge_m: 0.01 * glam::DVec3::Z, ..Tip::default() };
    for sequence in [3, 5] {
        intake.submit(LEASE, vec![pose(sequence, blade), release(sequence + 1, None)], 0).unwrap();
        assert_eq!(has(), 5000);
    }
    // Without memory for it, no part of the batch is accepted.
    let poor = Budget::new(&Limits { memory_bytes: 4 * PIECE_BYTES, ..Limits::default() }, 1, 1).account("poor");
    let mut intake = self::intake().0.charged_to(&poor).of_cut_bytes(8 * PIECE_BYTES);
    let burning = Tip { burn_s: 0.1, ..Tip::default() };
    let refusal = intake.submit(LEASE, vec![release(1, None), pose(2, burning)], 0).unwrap_err();
    assert_eq!((refusal.reason, refusal.field.as_str()), (Reason::TooLarge, "pose.tip"), "{refusal}");
    assert_eq!(intake.counts().accepted, 0);
}

#[test]
fn of_poses_for_one_step_the_last_counts_and_of_those_played_by_the_clients_time_each_does() {
    // Sequence, step, and client time: a pose with a step is played at that step, whatever its time.
    let superseded = |at_step: Option<u64>, client_time_ns: u64| {
        let (mut intake, _) = intake();
        let pose = |sequence: u64| Command {
            action: Action::Pose { place_m: glam::DVec3::ZERO, velocity_m_per_s: None, tip: Tip::default() },
            client_time_ns: client_time_ns * sequence,
            ..release(sequence, at_step)
        };
        intake.submit(LEASE, (1..=3).map(pose).collect::<Vec<_>>(), 0).unwrap();
        (intake.counts().superseded, intake.counts().waiting)
    };
    assert_eq!(superseded(None, 0), (2, 1));
    assert_eq!(superseded(Some(4), 0), (2, 1));
    assert_eq!(superseded(Some(4), MS), (2, 1));
    assert_eq!(superseded(None, MS), (0, 3));
}

#[test]
fn as_many_commands_come_at_once_as_a_tool_may_have_waiting_and_no_more() {
    let limits = Limits { queued_commands_per_tool: 3, ..Limits::default() };
    let scene = Scene::parse("paper", PAPER, &[], &limits).unwrap();
    let rules = Rules { scene, limits };
    let of = |count: u64| rules.check((0..count).map(|sequence| release(sequence, None)).collect::<Vec<_>>());
    assert!((0..=3).all(|count| of(count).is_ok()));
    for count in [4, 5, 100] {
        assert_eq!(of(count).unwrap_err().reason, Reason::QueueFull, "{count} commands");
    }
}

#[test]
fn a_lease_is_neither_shorter_than_10_ms_nor_longer_than_the_limit() {
    let limits = Limits { lease_s: 5.0, ..Limits::default() };
    let scene = Scene::parse("paper", PAPER, &[], &limits).unwrap();
    let of = |lease_s: f64| Intake::new(&scene, &limits).acquire(&[0], "test", lease_s, LEASE, 0).map(|_| ());
    assert!([0.01, 1.0, 5.0].into_iter().all(|lease_s| of(lease_s).is_ok()));
    for lease_s in [-1.0, 0.0, 0.0099, 5.01, 1e9] {
        let refused = of(lease_s).unwrap_err();
        assert_eq!((refused.reason, refused.field.as_str()), (Reason::OutOfRange, "lease_s"), "{lease_s} s");
    }
}

#[test]
fn a_tool_that_is_in_the_tissue_when_a_session_goes_on_keeps_its_tip() {
    let model = Model::parse("paper", palpate_tissue::scene::PAPER, &["sheet.points=[9, 9]"]).unwrap();
    let limits = Limits::default();
    let pose = |radius_m: f64| Action::Pose {
        place_m: glam::DVec3::new(0.1, 0.1, 0.01),
        velocity_m_per_s: None,
        tip: Tip { radius_m, ..Tip::default() },
    };
    let mut session = Session::new(&model);
    for (tool, action) in [(0, pose(0.03)), (1, Action::Release), (2, pose(0.02))] {
        session.advance(&mut vec![Due::in_time(Command::new(tool, Some(1), action))], |_| {});
    }
    let radii_m: Vec<(u32, f64)> = session.tips().map(|(tool, tip)| (tool, tip.radius_m)).collect();
    assert_eq!(radii_m, [(0, 0.03), (2, 0.02)]);
    let other = |intake: &mut Intake, tool: u32| {
        let refused = intake.submit(LEASE, vec![Command::new(tool, None, pose(0.01))], 0).unwrap_err();
        (refused.reason, refused.field)
    };
    let refused = (Reason::OutOfTurn, "pose.tip.radius_m".to_owned());
    // Both for a client that acquires the tool, and for one whose lease comes from another server.
    let mut taken = Intake::new(&model.scene, &limits).continued(&session, None);
    taken.acquire(&[0, 1], "test", 1.0, LEASE, 0).unwrap();
    assert_eq!(other(&mut taken, 0), refused);
    taken.submit(LEASE, vec![Command::new(0, None, pose(0.03)), Command::new(1, None, pose(0.01))], 0).unwrap();
    let (handed, _) = taken.hand_over(Refusal::new(Reason::Elsewhere, "session_id", "another server has it"));
    let mut adopting = Intake::new(&model.scene, &limits).continued(&session, None);
    adopting.adopt(crate::intake_transfer::Handed { waiting: Vec::new(), ..handed }, 0);
    assert_eq!(other(&mut adopting, 0), refused);
    // After a release any tip may be used; and a lease that ends takes its tip with it.
    adopting.submit(LEASE, vec![Command::new(0, None, Action::Release), Command::new(0, None, pose(0.01))], 0).unwrap();
    adopting.release(LEASE).unwrap();
    adopting.acquire(&[0], "test", 1.0, LEASE, 0).unwrap();
    adopting.submit(LEASE, vec![Command::new(0, None, pose(0.04))], 0).unwrap();
    // All tools are released, as after a crash, so no tip is known.
    session.let_go();
    let mut after = Intake::new(&model.scene, &limits).continued(&session, None);
    after.acquire(&[2], "test", 1.0, LEASE, 0).unwrap();
    after.submit(LEASE, vec![Command::new(2, None, pose(0.01))], 0).unwrap();
}

/// 64 tips of a third of an organ on one session stopped the other sessions of its thread for 4.5 s.
#[test]
fn tips_that_a_step_has_no_time_for_are_refused_with_the_radius_that_fits() {
    let (limits, model) = (Limits::default(), Model::parse("gallbladder", crate::GALLBLADDER, &[]).unwrap());
    let tools: Vec<u32> = (0..64).collect();
    let pose = |tool: u32, sequence: u64, radius_m: f64| {
        let tip = Tip { radius_m, ..Tip::default() };
        let action = Action::Pose { place_m: glam::DVec3::ZERO, velocity_m_per_s: None, tip };
        Command { action, ..Command::new(tool, Some(sequence), Action::Release) }
    };
    let edge_m = model.scene.shape().edge_m();
    let radius_m = 8.0 * edge_m;
    let mut intake = Intake::new(&model.scene, &limits).of_substeps(model.plan.substeps);
    intake.acquire(&tools, "test", 1.0, LEASE, 0).unwrap();
    let mut taken = 0;
    let refusal = loop {
        match intake.submit(LEASE, vec![pose(taken, 1, radius_m)], 0) {
            Ok(()) => taken += 1,
            Err(refusal) => break refusal,
        }
    };
    assert!((2..40).contains(&taken), "{taken}");
    assert_eq!((refusal.reason, refusal.field.as_str()), (Reason::TooLarge, "pose.tip.radius_m"));
    assert!(refusal.to_string().contains("m fits"), "{refusal}");
    // The radius that the message names fits, and present tips may move on.
    let fits_m: f64 = refusal.to_string().rsplit("; ").next().unwrap().split(' ').next().unwrap().parse().unwrap();
    intake.submit(LEASE, vec![pose(taken, 1, fits_m), pose(0, 2, radius_m)], 0).unwrap();
    // In one call as in many: none of it is accepted.
    let many: Vec<Command> = (taken + 1..64).map(|tool| pose(tool, 1, radius_m)).collect();
    assert_eq!(intake.submit(LEASE, many, 0).unwrap_err().reason, Reason::TooLarge);
    // A release makes room.
    intake.submit(LEASE, vec![Command::new(0, Some(3), Action::Release), pose(taken + 1, 1, radius_m)], 0).unwrap();
    // The discs of a sheet have bounded cost, and an offline run delays no other session.
    let mut alone = Intake::new(&model.scene, &limits);
    alone.acquire(&tools, "test", 1.0, LEASE, 0).unwrap();
    alone.submit(LEASE, tools.iter().map(|tool| pose(*tool, 1, radius_m)).collect::<Vec<_>>(), 0).unwrap();
}
