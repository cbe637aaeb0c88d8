//! Touch over the network: commands, samples, leases, probes.

use crate::common::metrics;
use crate::common::server::{TEST_TIMEOUT, TestServer, TestTouch, force, open, position, told};
use palpate_proto::pb;
use pb::command::Action;
use pb::touch_response::Message as Heard;
use tonic::Code;

#[tokio::test]
async fn a_force_is_felt_and_acknowledged() {
    let server = TestServer::start(&[]);
    let session = server.paper(false).await;
    let mut touch = TestTouch::hold(&server, &session).await;
    let mut command = force(0, 7, -1.0);
    command.client_time_ns = 123;
    touch.command(command).await;
    let sample = touch.sample_with(|sample| sample.tools[0].acknowledged_sequence == 7).await;
    assert_eq!(sample.tools[0].client_time_ns, 123);
    let tool = &sample.tools[0];
    assert!(tool.server_hold_ns > 0 && tool.step_wait_ns <= tool.server_hold_ns, "{tool:?}");
    let first_step = sample.step;
    let later = touch.sample_with(|sample| sample.step > first_step + 600).await;
    let tool = &later.tools[0];
    assert_eq!(tool.point, Some(pb::GridPoint { x: 15, y: 15 }));
    let (depth_m, reaction_n) = (tool.displacement_m.unwrap().z, tool.force_on_tool_n.unwrap().z);
    assert!(depth_m < -0.03 && (0.9..1.1).contains(&reaction_n), "{depth_m} m, {reaction_n} N");
    assert_eq!(tool.applied_force_n.unwrap().z, -1.0);
    assert_eq!((later.awake_points, later.held), (961, false));
}

#[tokio::test]
async fn bad_commands_are_refused_with_a_reason_and_change_nothing() {
    let server = TestServer::start(&[]);
    let (session, untouched) = (server.paper(true).await, server.paper(true).await);
    let mut touch = TestTouch::hold(&server, &session).await;
    type Change = fn(&mut pb::Command);
    fn force_of(command: &mut pb::Command) -> &mut pb::Force {
        let Some(Action::Force(force)) = &mut command.action else { unreachable!() };
        force
    }
    fn to_position(command: &mut pb::Command, position: pb::Position) {
        command.action = Some(Action::Position(position));
    }
    let cases: [(Change, &str, &str); 17] = [
        (|c| force_of(c).force_n.as_mut().unwrap().x = f64::NAN, "NOT_FINITE", "force.force_n"),
        (|c| force_of(c).force_n.as_mut().unwrap().z = f64::INFINITY, "NOT_FINITE", "force.force_n"),
        (|c| force_of(c).force_n.as_mut().unwrap().z = 1.1e4, "FORCE_TOO_LARGE", "force.force_n"),
        (|c| force_of(c).falloff_offset = Some(10.0), "FORCE_TOO_LARGE", "force.force_n"),
        (|c| force_of(c).falloff_offset = Some(1e9), "FORCE_TOO_LARGE", "force.force_n"),
        (|c| force_of(c).falloff_offset = Some(f64::NAN), "NOT_FINITE", "force.falloff_offset"),
        (|c| force_of(c).falloff_per_m = Some(-1.0), "OUT_OF_RANGE", "force.falloff_per_m"),
        (|c| force_of(c).centre = None, "MISSING", "force.centre"),
        (
            |c| force_of(c).centre = Some(pb::force::Centre::Point(pb::GridPoint { x: 31, y: 0 })),
            "OFF_TISSUE",
            "force.point",
        ),
        (
            |c| force_of(c).centre = Some(pb::force::Centre::CentreM(pb::Vector2 { x: 1.5, y: 0.5 })),
            "OFF_TISSUE",
            "force.centre_m",
        ),
        (
            |c| force_of(c).centre = Some(pb::force::Centre::CentreM(pb::Vector2 { x: f64::NAN, y: 0.5 })),
            "NOT_FINITE",
            "force.centre_m",
        ),
        (|c| c.action = None, "MISSING", "action"),
        (|c| c.time_to_live_s = Some(0.0), "OUT_OF_RANGE", "time_to_live_s"),
        (|c| c.tool = 1, "NOT_HOLDER", "tool"),
        (|c| to_position(c, pb::Position::default()), "MISSING", "position.point"),
        (
            |c| {
                let point = Some(pb::GridPoint { x: 0, y: 99 });
                let target = Some(pb::position::Target::DisplacementM(pb::Vector3::default()));
                to_position(c, pb::Position { point, target, vertex: None });
            },
            "OFF_TISSUE",
            "position.point",
        ),
        (
            |c| {
                let point = Some(pb::GridPoint { x: 1, y: 1 });
                let target = Some(pb::position::Target::PositionM(pb::Vector3 { x: 1e6, y: 0.0, z: 0.0 }));
                to_position(c, pb::Position { point, target, vertex: None });
            },
            "OUT_OF_RANGE",
            "position",
        ),
    ];
    for (index, (change, reason, field)) in cases.into_iter().enumerate() {
        let mut command = force(0, 100 + index as u64, -1.0);
        change(&mut command);
        touch.command(command).await;
        let rejection = touch.rejection().await;
        assert_eq!((rejection.reason.as_str(), rejection.field.as_str()), (reason, field), "{}", rejection.message);
        assert_eq!(rejection.sequence, 100 + index as u64);
        assert!(rejection.message.contains(field), "{}", rejection.message);
    }
    // No command took effect: both sessions are the same after some steps.
    server.start_until(&session, 50).await;
    server.start_until(&untouched, 50).await;
    assert_eq!(server.hash_at(&session, 50).await, server.hash_at(&untouched, 50).await);
    // A valid command is still accepted.
    touch.command(force(0, 200, -1.0)).await;
    touch.settle().await;
}

#[tokio::test]
async fn every_refused_command_of_a_burst_is_told_of_or_counted() {
    let server = TestServer::start(&[]);
    let session = server.paper(true).await;
    let mut touch = TestTouch::hold(&server, &session).await;
    for sequence in 1..=1000 {
        // Tool 1 is free.
        touch.command(force(1, sequence, -1.0)).await;
    }
    let (mut told, mut last) = (0, pb::Rejection::default());
    while last.sequence < 1000 {
        let rejection = touch.rejection().await;
        assert!(rejection.sequence > last.sequence && rejection.dropped_answers >= last.dropped_answers);
        assert_eq!(rejection.reason, "NOT_HOLDER");
        (told, last) = (told + 1, rejection);
    }
    assert_eq!(told + last.dropped_answers, 1000);
}

#[tokio::test]
async fn stale_sequences_are_refused() {
    let server = TestServer::start(&[]);
    let session = server.paper(false).await;
    let mut touch = TestTouch::hold(&server, &session).await;
    touch.command(force(0, 10, -1.0)).await;
    for stale in [10, 9, 0] {
        touch.command(force(0, stale, -2.0)).await;
        let rejection = touch.rejection().await;
        assert_eq!((rejection.reason.as_str(), rejection.sequence), ("STALE_SEQUENCE", stale));
    }
    touch.command(force(0, 11, -0.5)).await;
    let sample = touch.sample_with(|sample| sample.tools[0].acknowledged_sequence == 11).await;
    let later = touch.sample_with(|later| later.step > sample.step).await;
    assert_eq!(later.tools[0].applied_force_n.unwrap().z, -0.5);
}

/// The hash after 60 steps in which tool 0 gets these commands, one a step.
async fn hash_after(server: &TestServer, scene: &str, actions: Vec<Action>) -> String {
    let source = pb::create_session_request::Source::SceneName(scene.into());
    let session = server.create(source, true).await.unwrap().session_id;
    let mut touch = TestTouch::hold(server, &session).await;
    for (step, action) in (0..).zip(actions) {
        touch.command(pb::Command { at_step: Some(step), action: Some(action), ..Default::default() }).await;
    }
    touch.settle().await;
    server.start_until(&session, 60).await;
    server.hash_at(&session, 60).await
}

#[tokio::test]
async fn fields_that_a_command_leaves_out_have_defaults_and_zeros_count_as_zeros() {
    let server = TestServer::start(&[]);
    let mut forces = Vec::new();
    for (falloff_per_m, falloff_offset) in [(None, None), (Some(200.0), Some(0.0)), (Some(0.0), None)] {
        let Some(Action::Force(force)) = force(0, 1, -1e-3).action else { unreachable!() };
        let force = Action::Force(pb::Force { falloff_per_m, falloff_offset, ..force });
        forces.push(hash_after(&server, "liver", vec![force]).await);
    }
    assert_eq!(forces[0], forces[1]);
    assert_ne!(forces[0], forces[2]);
    // A tip that presses and then strokes.
    let mut strokes = Vec::new();
    for friction in [None, Some(0.2), Some(0.0)] {
        let pose = |step: u32| {
            let (down, along) = (step.min(20), step.saturating_sub(20));
            let (x, z) = (0.03 + 2e-4 * f64::from(along), -1e-4 * f64::from(down));
            let tip = Some(pb::Tip { radius_m: 0.005, friction, ..Default::default() });
            Action::Pose(pb::Pose { position_m: Some(pb::Vector3 { x, y: 0.0375, z }), tip, ..Default::default() })
        };
        strokes.push(hash_after(&server, "liver", (0..50).map(pose).collect()).await);
    }
    assert_eq!(strokes[0], strokes[1]);
    assert_ne!(strokes[0], strokes[2]);
}

#[tokio::test]
async fn commands_without_a_sequence_are_acknowledged_by_their_time_and_their_count() {
    let server = TestServer::start(&[]);
    let session = server.paper(false).await;
    let mut touch = TestTouch::hold(&server, &session).await;
    for (client_time_ns, sequence) in [(700, 0), (800, 1), (900, 2)] {
        touch.command(pb::Command { sequence: None, client_time_ns, ..force(0, 0, -1.0) }).await;
        let sample = touch.sample_with(|sample| sample.tools[0].client_time_ns == client_time_ns).await;
        assert_eq!(sample.tools[0].acknowledged_sequence, sequence);
    }
    touch.command(force(0, 2, -2.0)).await;
    assert_eq!(touch.rejection().await.reason, "STALE_SEQUENCE");
}

#[tokio::test]
async fn a_tool_has_one_holder_until_it_is_let_go() {
    let server = TestServer::start(&[]);
    let session = server.paper(false).await;
    let mut first = TestTouch::hold(&server, &session).await;
    let refused = TestTouch::open(&server, open(&session, &[1, 0])).await.err().unwrap();
    assert_eq!(told(&refused), (Code::AlreadyExists, "TOOL_HELD".into(), "tools".into()));
    assert!(refused.message().contains("held by `test`"), "{}", refused.message());
    let mut haptics = server.haptics().await;
    let acquire = pb::AcquireToolRequest { session_id: session.clone(), tool: 0, ..Default::default() };
    let refused = told(&haptics.acquire_tool(acquire.clone()).await.unwrap_err());
    assert_eq!((refused.1.as_str(), refused.2.as_str()), ("TOOL_HELD", "tool"));
    // The refused stream did not take tool 1.
    drop(TestTouch::open(&server, open(&session, &[1])).await.unwrap());

    first.command(force(0, 1, -1.0)).await;
    first.sample_with(|sample| sample.tools[0].acknowledged_sequence == 1).await;
    // The end of a stream releases the tool and ends the force.
    first.finish();
    while first.hear().await.unwrap().is_some() {}
    let lease = haptics.acquire_tool(acquire).await.unwrap().into_inner();
    assert!(lease.lease_s > 0.0);
    let request = pb::SendCommandsRequest { session_id: session, lease_id: lease.lease_id, commands: vec![] };
    let sample = haptics.send_commands(request).await.unwrap().into_inner().sample.unwrap();
    assert_eq!(sample.tools[0].applied_force_n, Some(pb::Vector3::default()));
}

#[tokio::test]
async fn a_lease_of_several_tools_moves_all_of_them_in_one_call() {
    let server = TestServer::start(&[]);
    let session = server.paper(false).await;
    let mut haptics = server.haptics().await;
    let acquire = |more_tools: &[u32]| pb::AcquireToolRequest {
        session_id: session.clone(),
        tool: 2,
        more_tools: more_tools.to_vec(),
        ..Default::default()
    };
    // All or none: tool 2 is still free afterwards.
    for (more_tools, expected) in [(&[3, 2][..], "names tool 2 twice"), (&[3, 64], "must be below 64")] {
        let refused = haptics.acquire_tool(acquire(more_tools)).await.unwrap_err();
        assert!(refused.message().contains(expected), "{refused}");
    }
    let lease = haptics.acquire_tool(acquire(&[5, 3])).await.unwrap().into_inner();
    let refused = told(&haptics.acquire_tool(pb::AcquireToolRequest { tool: 5, ..acquire(&[]) }).await.unwrap_err());
    assert_eq!((refused.1.as_str(), refused.2.as_str()), ("TOOL_HELD", "tool"));
    let request = pb::SendCommandsRequest {
        session_id: session.clone(),
        lease_id: lease.lease_id.clone(),
        commands: [2, 3, 5].map(|tool| force(tool, 1, -1.0)).to_vec(),
    };
    let sample = haptics.send_commands(request).await.unwrap().into_inner().sample.unwrap();
    assert_eq!(sample.tools.iter().map(|tool| tool.tool).collect::<Vec<_>>(), [2, 3, 5]);
    assert!(sample.tools.iter().all(|tool| tool.acknowledged_sequence == 1), "{sample:?}");
    // The release of the lease releases all.
    let release = pb::ReleaseToolRequest { session_id: session.clone(), lease_id: lease.lease_id };
    haptics.release_tool(release).await.unwrap();
    haptics.acquire_tool(acquire(&[5, 3])).await.unwrap();
}

#[tokio::test]
async fn a_client_that_vanishes_leaves_no_force_behind() {
    let server = TestServer::start(&[]);
    let session = server.paper(false).await;
    let mut watcher = TestTouch::open(&server, open(&session, &[])).await.unwrap();
    let touch = TestTouch::hold(&server, &session).await;
    touch.command(force(0, 1, -1.0)).await;
    let pushed = |sample: &pb::Sample| sample.tools.iter().any(|tool| tool.applied_force_n.unwrap().z != 0.0);
    watcher.sample_with(pushed).await;
    drop(touch);
    watcher.sample_with(|sample| !pushed(sample)).await;
    assert!(server.status(&session).await.held_tools.is_empty());
}

#[tokio::test]
async fn a_lease_lapses_by_itself_and_ends_what_the_tool_did() {
    let server = TestServer::start(&[]);
    let session = server.paper(false).await;
    let mut touch =
        TestTouch::open(&server, pb::TouchOpen { lease_s: Some(0.2), ..open(&session, &[0]) }).await.unwrap();
    touch.command(force(0, 1, -1.0)).await;
    touch.sample_with(|sample| sample.tools[0].applied_force_n.is_some_and(|force| force.z == -1.0)).await;
    // The holder sends nothing, though it keeps reading.
    let sample = touch.sample_with(|sample| sample.tools[0].expired).await;
    touch.sample_with(|later| later.step > sample.step && later.tools[0].applied_force_n.unwrap().z == 0.0).await;
    assert_eq!(server.status(&session).await.lapsed_leases, 1);
    touch.command(force(0, 2, -1.0)).await;
    assert_eq!(touch.rejection().await.reason, "NOT_HOLDER");
}

#[tokio::test]
async fn a_command_outlives_its_time_by_no_step() {
    let server = TestServer::start(&[]);
    let session = server.paper(true).await;
    let mut touch = TestTouch::hold(&server, &session).await;
    let command = pb::Command { at_step: Some(10), time_to_live_s: Some(0.02), ..force(0, 1, -1.0) };
    touch.command(command).await;
    touch.settle().await;
    server.start_until(&session, 40).await;
    for _ in 0..40 {
        let sample = touch.sample().await;
        // The forces of a sample are those of the step that has just ended.
        let acts = (11..=30).contains(&sample.step);
        let applied = sample.tools[0].applied_force_n.map_or(0.0, |force| force.z);
        assert_eq!(applied, if acts { -1.0 } else { 0.0 }, "step {}", sample.step);
        assert_eq!(sample.tools[0].expired, sample.step > 30);
        if sample.step == 40 {
            return;
        }
    }
}

#[tokio::test]
async fn commands_act_at_their_step_and_late_ones_are_told() {
    let server = TestServer::start(&[]);
    let session = server.paper(true).await;
    let mut touch = TestTouch::hold(&server, &session).await;
    touch.command(pb::Command { at_step: Some(20), ..force(0, 1, -1.0) }).await;
    touch.settle().await;
    server.start_until(&session, 30).await;
    let acknowledged = touch.sample_with(|sample| sample.tools[0].acknowledged_sequence == 1).await;
    assert_eq!((acknowledged.step, acknowledged.tools[0].late), (21, false));
    touch.sample_with(|sample| sample.step == 30).await;
    // Step 5 is over: the command takes effect at the next one and is reported late.
    touch.command(pb::Command { at_step: Some(5), ..force(0, 2, -0.5) }).await;
    touch.settle().await;
    server.start_until(&session, 40).await;
    let late = touch.sample_with(|sample| sample.tools[0].acknowledged_sequence == 2).await;
    assert_eq!((late.step, late.tools[0].late, late.late_commands), (31, true, 1));
    assert_eq!(server.status(&session).await.late_commands, 1);
}

#[tokio::test]
async fn a_position_is_reached_by_the_end_of_its_step_and_the_latest_wins() {
    let server = TestServer::start(&[]);
    let session = server.paper(true).await;
    let mut touch = TestTouch::hold(&server, &session).await;
    // More than a queue holds: each replaces the one before.
    for sequence in 1..=6000 {
        touch.command(position(0, sequence, -0.01 * (sequence % 7) as f64)).await;
    }
    touch.command(position(0, 6001, -0.004)).await;
    touch.settle().await;
    server.start_until(&session, 10).await;
    let sample = touch.sample_with(|sample| sample.tools[0].acknowledged_sequence > 0).await;
    let tool = &sample.tools[0];
    assert_eq!((sample.step, tool.acknowledged_sequence), (1, 6001));
    assert!((tool.displacement_m.unwrap().z + 0.004).abs() < 1e-9);
    assert!((tool.velocity_m_per_s.unwrap().z + 4.0).abs() < 1e-6);
    let later = touch.sample_with(|sample| sample.step == 10).await;
    assert!((later.tools[0].displacement_m.unwrap().z + 0.004).abs() < 1e-9);
    assert_eq!(later.tools[0].velocity_m_per_s.unwrap().z, 0.0);
    assert!(later.tools[0].force_on_tool_n.unwrap().z > 0.0);
}

#[tokio::test]
async fn a_late_position_counts_as_late_also_when_another_takes_its_place() {
    let server = TestServer::start(&[]);
    let session = server.paper(true).await;
    let mut touch = TestTouch::hold(&server, &session).await;
    server.start_until(&session, 10).await;
    touch.sample_with(|sample| sample.step == 10).await;
    for (sequence, at_step) in [(1, 5), (2, 6), (3, 10)] {
        touch.command(pb::Command { at_step: Some(at_step), ..position(0, sequence, -0.001) }).await;
    }
    touch.settle().await;
    server.start_until(&session, 12).await;
    let sample = touch.sample_with(|sample| sample.step == 12).await;
    assert_eq!((sample.late_commands, sample.tools[0].acknowledged_sequence), (2, 3));
}

#[tokio::test]
async fn the_order_in_which_two_clients_commands_arrive_does_not_matter() {
    let server = TestServer::start(&[]);
    let mut hashes = Vec::new();
    for order in [[0, 1], [1, 0]] {
        let session = server.paper(true).await;
        let mut touches = [TestTouch::open(&server, open(&session, &[0])).await.unwrap(), {
            TestTouch::open(&server, open(&session, &[1])).await.unwrap()
        }];
        for tool in order {
            let z_m = if tool == 0 { -0.01 } else { 0.01 };
            touches[tool].command(pb::Command { at_step: Some(3), ..position(tool as u32, 1, z_m) }).await;
            touches[tool].settle().await;
        }
        server.start_until(&session, 20).await;
        hashes.push(server.hash_at(&session, 20).await);
    }
    assert_eq!(hashes[0], hashes[1]);
}

#[tokio::test]
async fn a_batch_is_answered_also_when_time_is_stopped_under_it() {
    let server = TestServer::start(&[]);
    let mut scene = paper_scene();
    scene.stepping.as_mut().unwrap().rate_hz = Some(0.01);
    scene.stepping.as_mut().unwrap().tolerance = Some(1.0);
    let session = server.create(pb::create_session_request::Source::Scene(scene), false).await.unwrap().session_id;
    let mut haptics = server.haptics().await;
    let acquire = pb::AcquireToolRequest { session_id: session.clone(), lease_s: Some(60.0), ..Default::default() };
    let lease_id = haptics.acquire_tool(acquire).await.unwrap().into_inner().lease_id;
    // The first step is done at once; the next is due in 100 s.
    server.hash_at(&session, 1).await;
    let request = pb::SendCommandsRequest { session_id: session.clone(), lease_id, commands: vec![force(0, 1, -1.0)] };
    let waiting = tokio::spawn(async move { haptics.send_commands(request).await });
    tokio::time::sleep(std::time::Duration::from_millis(100)).await;
    let pause = pb::PauseSessionRequest { session_id: session.clone() };
    server.sessions().await.pause_session(pause).await.unwrap();
    assert_eq!(server.status(&session).await.state(), pb::SessionState::Paused);
    let answer = tokio::time::timeout(TEST_TIMEOUT, waiting).await.unwrap().unwrap().unwrap().into_inner();
    assert_eq!(answer.sample.unwrap().step, 1);
}

#[tokio::test]
async fn what_people_read_is_short_and_on_one_line() {
    let server = TestServer::start(&[]);
    let session = server.paper(true).await;
    for holder in ["x".repeat(129), "two\nlines".to_owned()] {
        let refused = TestTouch::open(&server, pb::TouchOpen { holder, ..open(&session, &[0]) }).await.err().unwrap();
        assert_eq!(told(&refused), (Code::InvalidArgument, "OUT_OF_RANGE".into(), "holder".into()));
    }
    let refused = TestTouch::open(&server, open(&"x".repeat(100_000), &[0])).await.err().unwrap();
    assert_eq!(told(&refused).1, "UNKNOWN_SESSION");
}

#[tokio::test]
async fn a_fixed_point_can_not_be_grasped() {
    let server = TestServer::start(&[]);
    let mut scene = paper_scene();
    scene.sheet.as_mut().unwrap().fixed = Some(pb::sheet::Fixed::FixedSet(pb::FixedSet::Corners.into()));
    let session = server.create(pb::create_session_request::Source::Scene(scene), true).await.unwrap().session_id;
    let mut touch = TestTouch::hold(&server, &session).await;
    let mut command = position(0, 1, -0.01);
    let Some(Action::Position(position)) = &mut command.action else { unreachable!() };
    position.point = Some(pb::GridPoint { x: 30, y: 30 });
    touch.command(command).await;
    let rejection = touch.rejection().await;
    assert_eq!((rejection.reason.as_str(), rejection.field.as_str()), ("OUT_OF_RANGE", "position.point"));
}

#[tokio::test]
async fn a_full_queue_refuses_and_keeps_what_it_has() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("palpate.toml");
    std::fs::write(&config, "[limits]\nqueued_commands_per_tool = 5\n").unwrap();
    let server = TestServer::start(&["--config", config.to_str().unwrap()]);
    let session = server.paper(true).await;
    let mut touch = TestTouch::hold(&server, &session).await;
    for sequence in 1..=8 {
        touch.command(pb::Command { at_step: Some(sequence), ..force(0, sequence, -(sequence as f64)) }).await;
    }
    for sequence in 6..=8 {
        let rejection = touch.rejection().await;
        assert_eq!((rejection.reason.as_str(), rejection.sequence), ("QUEUE_FULL", sequence));
    }
    server.start_until(&session, 10).await;
    let sample = touch.sample_with(|sample| sample.step == 10).await;
    assert_eq!(sample.tools[0].acknowledged_sequence, 5);
}

#[tokio::test]
async fn a_unary_batch_is_taken_whole_or_not_at_all() {
    let server = TestServer::start(&[]);
    let session = server.paper(false).await;
    let mut haptics = server.haptics().await;
    let acquire = pb::AcquireToolRequest { session_id: session.clone(), tool: 3, ..Default::default() };
    let lease_id = haptics.acquire_tool(acquire).await.unwrap().into_inner().lease_id;
    let batch = |commands: Vec<pb::Command>| pb::SendCommandsRequest {
        session_id: session.clone(),
        lease_id: lease_id.clone(),
        commands,
    };
    let refused = haptics.send_commands(batch(vec![force(3, 1, -1.0), force(3, 2, f64::NAN)])).await.unwrap_err();
    assert_eq!(told(&refused), (Code::InvalidArgument, "NOT_FINITE".into(), "force.force_n".into()));
    let refused = haptics.send_commands(batch(vec![force(3, 5, -1.0), force(3, 4, -1.0)])).await.unwrap_err();
    assert_eq!(told(&refused).1, "STALE_SEQUENCE");
    // Sequence 1 is free: no command of the refused batches was accepted.
    let taken = haptics.send_commands(batch(vec![force(3, 1, -1.0), force(3, 2, -0.25)])).await.unwrap().into_inner();
    let tool = taken.sample.unwrap().tools[0];
    assert_eq!((tool.tool, tool.acknowledged_sequence, tool.applied_force_n.unwrap().z), (3, 2, -0.25));
    let stolen = pb::SendCommandsRequest { lease_id: "1".into(), ..batch(vec![force(3, 9, -1.0)]) };
    assert_eq!(told(&haptics.send_commands(stolen).await.unwrap_err()).0, Code::PermissionDenied);
    let release = pb::ReleaseToolRequest { session_id: session.clone(), lease_id: lease_id.clone() };
    haptics.release_tool(release).await.unwrap();
    assert_eq!(told(&haptics.send_commands(batch(vec![])).await.unwrap_err()).1, "NOT_HOLDER");
}

#[tokio::test]
async fn a_stream_must_begin_with_open_and_only_once() {
    let server = TestServer::start(&[]);
    let session = server.paper(false).await;
    for (open, code, reason, field) in [
        (open("nobody", &[0]), Code::NotFound, "UNKNOWN_SESSION", "session_id"),
        (open(&session, &[64]), Code::InvalidArgument, "OUT_OF_RANGE", "tools"),
        (open(&session, &[1, 1]), Code::InvalidArgument, "OUT_OF_RANGE", "tools"),
        (
            pb::TouchOpen { sample_every_steps: Some(0), ..open(&session, &[0]) },
            Code::InvalidArgument,
            "OUT_OF_RANGE",
            "sample_every_steps",
        ),
        (
            pb::TouchOpen { lease_s: Some(f64::NAN), ..open(&session, &[0]) },
            Code::InvalidArgument,
            "NOT_FINITE",
            "lease_s",
        ),
    ] {
        let refused = TestTouch::open(&server, open).await.err().unwrap();
        assert_eq!(told(&refused), (code, reason.into(), field.into()));
    }
    let mut touch = TestTouch::hold(&server, &session).await;
    touch.say(pb::touch_request::Message::Open(open(&session, &[2]))).await;
    let refused = loop {
        match touch.hear().await {
            Ok(Some(_)) => {}
            Ok(None) => panic!("the stream ended without a reason"),
            Err(status) => break status,
        }
    };
    assert_eq!(told(&refused).1, "OUT_OF_TURN");
}

#[tokio::test]
async fn every_nth_sample_comes_and_watchers_see_all_tools() {
    let server = TestServer::start(&[]);
    let session = server.paper(false).await;
    let wanted = pb::TouchOpen { sample_every_steps: Some(5), ..open(&session, &[0, 4]) };
    let mut touch = TestTouch::open(&server, wanted).await.unwrap();
    touch.command(force(4, 1, -1.0)).await;
    let mut last = 0;
    for _ in 0..20 {
        let sample = touch.sample().await;
        assert!(sample.step.is_multiple_of(5) && sample.step > last);
        assert_eq!(sample.tools.iter().map(|tool| tool.tool).collect::<Vec<_>>(), [0, 4]);
        last = sample.step;
    }
    let request = pb::WatchSamplesRequest { session_id: session.clone(), ..Default::default() };
    let mut watched = server.haptics().await.watch_samples(request).await.unwrap().into_inner();
    let sample = watched.message().await.unwrap().unwrap().sample.unwrap();
    assert_eq!(sample.tools.iter().map(|tool| tool.tool).collect::<Vec<_>>(), [4]);
    let refused = pb::WatchSamplesRequest { session_id: session, sample_every_steps: Some(0), ..Default::default() };
    assert_eq!(told(&server.haptics().await.watch_samples(refused).await.unwrap_err()).2, "sample_every_steps");
}

#[tokio::test]
async fn who_watches_a_still_tissue_gets_heartbeats_at_the_rate_that_was_said() {
    let server = TestServer::start(&[]);
    let session = server.paper(false).await;
    let mut usual = TestTouch::open(&server, open(&session, &[])).await.unwrap();
    assert_eq!(usual.opened.as_ref().unwrap().heartbeat_s, 0.05);
    let wanted = pb::TouchOpen { heartbeat_s: Some(0.1), sample_every_steps: Some(30), ..open(&session, &[0]) };
    let mut seldom = TestTouch::open(&server, wanted).await.unwrap();
    for (touch, apart) in [(&mut usual, 50), (&mut seldom, 120)] {
        let mut last = touch.sample().await;
        for _ in 0..4 {
            let sample = touch.sample().await;
            assert_eq!(sample.step, last.step + apart);
            assert!((sample.simulation_time_s - sample.step as f64 / 1000.0).abs() < 1e-12);
            assert_eq!((sample.asleep, sample.awake_points, sample.dropped_samples), (true, 0, 0));
            last = sample;
        }
    }
    // Motion is reported at once, every Nth step.
    seldom.command(force(0, 1, -1.0)).await;
    let first = usual.sample_with(|sample| !sample.asleep).await;
    assert_eq!(usual.sample().await.step, first.step + 1);
}

#[tokio::test]
async fn a_deadband_leaves_out_what_changes_too_little() {
    let server = TestServer::start(&[]);
    let session = server.paper(true).await;
    let deadband = pb::Deadband { displacement_m: Some(0.0025), ..Default::default() };
    let wanted = pb::TouchOpen { deadband: Some(deadband), heartbeat_s: Some(0.1), ..open(&session, &[0]) };
    let mut touch = TestTouch::open(&server, wanted).await.unwrap();
    for step in 0..100_u64 {
        // A millimetre per step for ten steps, then held.
        let z_m = -0.001 * (step + 1).min(10) as f64;
        touch.command(pb::Command { at_step: Some(step), ..position(0, step + 1, z_m) }).await;
    }
    touch.settle().await;
    let request = pb::WatchSamplesRequest { session_id: session.clone(), ..Default::default() };
    let mut watched = server.haptics().await.watch_samples(request).await.unwrap().into_inner();
    server.start_until(&session, 250).await;
    let mut steps = Vec::new();
    while steps.last() != Some(&250) {
        // A sample of step 0 came before the start.
        steps.extend(Some(touch.sample().await.step).filter(|step| *step > 0));
    }
    // Including the first, at which the tool touched, and the last, at which time stopped.
    assert_eq!(steps, [1, 4, 7, 10, 110, 210, 250]);
    // Other streams get what they requested.
    let sample = watched.message().await.unwrap().unwrap().sample.unwrap();
    assert_eq!(sample.step + 1, watched.message().await.unwrap().unwrap().sample.unwrap().step);
}

#[tokio::test]
async fn what_a_stream_can_not_ask_for_is_refused() {
    let server = TestServer::start(&[]);
    let session = server.paper(true).await;
    let band = |force_n, force_fraction, displacement_m| pb::Deadband {
        force_n,
        force_fraction,
        displacement_m,
        rendered_fraction: None,
    };
    let cases = [
        (Some(band(None, None, None)), None, "MISSING", "deadband"),
        (Some(band(Some(-0.1), None, None)), None, "OUT_OF_RANGE", "deadband.force_n"),
        (Some(band(Some(f64::NAN), None, None)), None, "NOT_FINITE", "deadband.force_n"),
        (Some(band(None, Some(1.5), None)), None, "OUT_OF_RANGE", "deadband.force_fraction"),
        (Some(band(None, None, Some(f64::INFINITY))), None, "NOT_FINITE", "deadband.displacement_m"),
        (None, Some(0.0), "OUT_OF_RANGE", "heartbeat_s"),
        (None, Some(11.0), "OUT_OF_RANGE", "heartbeat_s"),
        (None, Some(f64::NAN), "NOT_FINITE", "heartbeat_s"),
    ];
    for (deadband, heartbeat_s, reason, field) in cases {
        let touch = pb::TouchOpen { deadband, heartbeat_s, ..open(&session, &[0]) };
        let refused = TestTouch::open(&server, touch).await.err().unwrap();
        assert_eq!(told(&refused), (Code::InvalidArgument, reason.into(), field.into()));
        let watch =
            pb::WatchSamplesRequest { session_id: session.clone(), deadband, heartbeat_s, ..Default::default() };
        let refused = server.haptics().await.watch_samples(watch).await.unwrap_err();
        assert_eq!(told(&refused), (Code::InvalidArgument, reason.into(), field.into()));
    }
    // None of them has taken the tool.
    TestTouch::hold(&server, &session).await;
}

#[tokio::test]
async fn probes_tell_every_part_of_the_force_from_step_0_on() {
    let server = TestServer::start(&[]);
    let session = server.paper(true).await;
    let points = [(15, 15), (16, 15), (0, 0)].map(|(x, y)| pb::GridPoint { x, y }).to_vec();
    let request = pb::ProbeRequest {
        session_id: session.clone(),
        r#where: Some(pb::probe_request::Where::Points(pb::GridPoints { points: points.clone() })),
        every_steps: Some(10),
        energy: true,
        tools: true,
    };
    let mut haptics = server.haptics().await;
    let mut records = haptics.probe(request.clone()).await.unwrap().into_inner();
    let mut touch = TestTouch::hold(&server, &session).await;
    touch.command(pb::Command { at_step: Some(0), ..force(0, 1, -1.0) }).await;
    touch.settle().await;
    server.start_until(&session, 100).await;
    for expected in (0..=100).step_by(10) {
        let record = tokio::time::timeout(TEST_TIMEOUT, records.message()).await.unwrap().unwrap().unwrap();
        assert_eq!((record.step, record.last, record.dropped_records), (expected, true, 0));
        let named: Vec<_> = record.points.iter().map(|point| point.point.unwrap()).collect();
        assert_eq!(named, points);
        let centre = &record.points[0];
        // Including step 0: the force acts, and nothing has moved yet.
        assert_eq!(centre.applied_n.unwrap().z, -1.0);
        assert_eq!(centre.displacement_m.unwrap().z < 0.0, expected > 0);
        let z = |v: &Option<pb::Vector3>| v.unwrap().z;
        let sum = z(&centre.spring_n) + z(&centre.anchor_n) + z(&centre.damping_n);
        assert!((z(&centre.reaction_n) - sum).abs() < 1e-12);
        assert_eq!(record.energy.unwrap().anchor_j > 0.0, expected > 0);
    }
    for (request, field) in [
        (pb::ProbeRequest { every_steps: Some(0), ..request.clone() }, "every_steps"),
        (pb::ProbeRequest { r#where: None, ..request.clone() }, "where"),
        (
            pb::ProbeRequest {
                r#where: Some(pb::probe_request::Where::Points(pb::GridPoints {
                    points: vec![pb::GridPoint { x: 31, y: 0 }],
                })),
                ..request
            },
            "points[0]",
        ),
    ] {
        assert_eq!(told(&haptics.probe(request).await.unwrap_err()).2, field);
    }
}

#[tokio::test]
async fn a_record_of_all_points_comes_in_parts() {
    let server = TestServer::start(&[]);
    let mut scene = paper_scene();
    scene.sheet.as_mut().unwrap().points_x = Some(70);
    let session = server.create(pb::create_session_request::Source::Scene(scene), true).await.unwrap().session_id;
    let request = pb::ProbeRequest {
        session_id: session.clone(),
        r#where: Some(pb::probe_request::Where::AllPoints(true)),
        ..Default::default()
    };
    let mut records = server.haptics().await.probe(request).await.unwrap().into_inner();
    server.start_until(&session, 1).await;
    let (mut points, mut parts) = (Vec::new(), 0);
    loop {
        let part = tokio::time::timeout(TEST_TIMEOUT, records.message()).await.unwrap().unwrap().unwrap();
        assert_eq!(part.step, 0);
        parts += 1;
        points.extend(part.points.iter().map(|point| point.point.unwrap()));
        if part.last {
            break;
        }
    }
    assert_eq!((points.len(), parts), (70 * 31, 3));
    assert_eq!(points[71], pb::GridPoint { x: 2, y: 9 });
}

fn paper_scene() -> pb::Scene {
    let limits = palpate_tissue::limits::Limits::default();
    let paper = palpate_tissue::scene::Scene::parse("paper", palpate_tissue::scene::PAPER, &[], &limits).unwrap();
    palpate_session::wire::scene::scene(&paper)
}

#[tokio::test]
async fn a_session_that_blows_up_again_and_again_goes_on_without_the_tool_and_sends_no_nan() {
    // The scene's error is not known, and looking for it would take long.
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("palpate.toml");
    std::fs::write(&config, "[limits]\nrehearsal_work = 1\n").unwrap();
    let config = config.to_str().unwrap();
    let mut server = TestServer::start(&["--log", "warn", "--metrics", "127.0.0.1:0", "--config", config]);
    let metrics = metrics::url(&mut server.out);
    let mut scene = paper_scene();
    scene.springs.as_mut().unwrap().stiffness_n_per_m = Some(1e9);
    scene.springs.as_mut().unwrap().shear_stiffness_n_per_m = None;
    scene.stepping.as_mut().unwrap().substeps = Some(1);
    let session = server.create(pb::create_session_request::Source::Scene(scene), true).await.unwrap().session_id;
    let mut touch = TestTouch::hold(&server, &session).await;
    touch.command(force(0, 1, -1.0)).await;
    touch.settle().await;
    server.start_until(&session, 5000).await;
    let waiting = tokio::spawn({
        let mut sessions = server.sessions().await;
        let request = pb::GetStateHashRequest { session_id: session.clone(), at_step: Some(5000) };
        async move { sessions.get_state_hash(request).await }
    });
    // It recovers, and the holder gets the result of its command each time.
    let (mut told_of, mut last_step) = (0, 0);
    let paused = loop {
        let sample = match touch.hear().await.unwrap().unwrap() {
            Heard::Sample(sample) => sample,
            Heard::Rejection(rejection) => {
                told_of += 1;
                assert_eq!((&*rejection.reason, rejection.tool, rejection.sequence), ("RECOVERED", 0, told_of));
                assert!(rejection.message.contains("1 commands were undone"), "{rejection:?}");
                assert_eq!(rejection.message.contains("have no effect before step"), told_of == 4, "{rejection:?}");
                // Once more.
                touch.command(force(0, told_of + 1, -1.0)).await;
                continue;
            }
            other => panic!("{other:?}"),
        };
        for tool in &sample.tools {
            for v in [tool.displacement_m, tool.velocity_m_per_s, tool.force_on_tool_n].into_iter().flatten() {
                assert!(v.x.is_finite() && v.y.is_finite() && v.z.is_finite(), "{tool:?}");
            }
        }
        assert!(sample.step >= last_step && sample.recovery_count == told_of && !sample.held, "{told_of}: {sample:?}");
        last_step = sample.step;
        if sample.tools[0].acknowledged_sequence == 5 {
            break sample.tools[0];
        }
    };
    // The fifth command has no effect, and the session continues.
    let status = server.status(&session).await;
    let end = status.recoveries[0].step + 10_000;
    assert_eq!((told_of, paused.expired, paused.paused_until_step), (4, true, Some(end)));
    waiting.await.unwrap().unwrap();
    assert_eq!(metrics::scrape(&metrics)["palpate_recoveries_total"], 4.0);
    assert_eq!(metrics::scrape(&metrics)["palpate_paused_commands_total"], 1.0);
    let status = server.status(&session).await;
    assert_eq!((status.state(), status.step, status.hold_reason.as_str()), (pb::SessionState::Paused, 5000, ""));
    assert_eq!((status.recovery_count, status.recoveries.len(), status.paused_commands), (4, 4, 1));
    for recovery in &status.recoveries {
        assert!(recovery.state_of_step <= recovery.step && recovery.undone_commands == 1, "{recovery:?}");
    }
    assert!(status.recoveries[3].at_rest && status.recoveries[3].paused_until_step == Some(end), "{status:?}");
    // Other sessions continue.
    let mut sound = paper_scene();
    sound.stepping.as_mut().unwrap().substeps = Some(1);
    let other = server.create(pb::create_session_request::Source::Scene(sound), true).await.unwrap().session_id;
    server.start_until(&other, 5).await;
    server.hash_at(&other, 5).await;
    let log = server.log();
    assert!(!log.contains("session held") && log.contains("tissue recovered"), "{log}");
}
