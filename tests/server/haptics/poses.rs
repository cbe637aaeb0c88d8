//! Tools controlled by poses over a real server: local models, the force law, deadbands, and refusals.

use crate::common::server::{TestServer, TestTouch, open, told};
use palpate_haptics::device::DEVICES;
use palpate_haptics::{Device, Touching};
use palpate_proto::{pb, touch};
use tonic::Code;

fn device() -> pb::Device {
    touch::device(&Device::named("omega3").unwrap())
}

/// A pose above or in the middle of `liver`, by the client's clock.
fn pose(sequence: u64, time_ms: u64, z_m: f64) -> pb::Command {
    pb::Command {
        tool: 0,
        sequence: Some(sequence),
        client_time_ns: time_ms * 1_000_000,
        action: Some(pb::command::Action::Pose(pb::Pose {
            position_m: Some(pb::Vector3 { x: 0.0375, y: 0.0375, z: z_m }),
            ..Default::default()
        })),
        ..Default::default()
    }
}

async fn liver(server: &TestServer) -> String {
    let request = pb::CreateSessionRequest {
        source: Some(pb::create_session_request::Source::SceneName("liver".into())),
        ..Default::default()
    };
    server.sessions().await.create_session(request).await.unwrap().into_inner().session.unwrap().session_id
}

#[tokio::test]
async fn a_pressed_tool_gets_local_models_that_agree_with_the_law() {
    let server = TestServer::start(&[]);
    let session = liver(&server).await;
    let mut touch =
        TestTouch::open(&server, pb::TouchOpen { device: Some(device()), ..open(&session, &[0]) }).await.unwrap();
    let opened = touch.opened.take().unwrap();
    assert!((opened.max_force_n - 3.3).abs() < 1e-12);
    let law = touch.exact_law().await;
    assert!((law.at_depth(0.0005).force_n / 0.0005 / 71.1 - 1.0).abs() < 0.15);
    // Down to 4 mm, at 20 mm/s by the client's clock.
    for k in 0..400_u64 {
        touch.command(pose(k + 1, 1000 + k, 0.002 - 2e-5 * (k.min(300)) as f64)).await;
    }
    let sample = touch.sample_with(|sample| {
        let model = sample.tools.first().and_then(|tool| tool.local_model.as_ref());
        model.is_some_and(|model| model.position_m.as_ref().unwrap().z < -0.0039)
    });
    let sample = sample.await;
    let tool = &sample.tools[0];
    let model = touch::from_local_model(tool.local_model.as_ref().unwrap(), sample.step);
    assert!(model.is_sound() && model.force_n.z > 0.2, "{model:?}");
    assert_eq!(model.force_n.z, tool.force_on_tool_n.as_ref().unwrap().z);
    // The law passes through the sample.
    let repeated_n = Touching::at_sample(&model, &law).force_n(&model, &law, model.velocity_m_per_s);
    assert!((repeated_n - model.force_n).length() < 1e-6, "{repeated_n} beside {}", model.force_n);
    let stiffness = model.stiffness_n_per_m;
    assert!(stiffness.z_axis.z > 70.0 && (stiffness - stiffness.transpose()).abs().x_axis.y < 1e-9);
}

/// One stream sees the tool of another: where it is, how fast, and with what tip. A stream that does not ask sees none.
#[tokio::test]
async fn a_stream_may_see_the_tools_of_others() {
    let server = TestServer::start(&[]);
    let session = liver(&server).await;
    let mut seen = TestTouch::open(&server, pb::TouchOpen { other_tools: true, ..open(&session, &[0]) }).await.unwrap();
    let mut mover =
        TestTouch::open(&server, pb::TouchOpen { other_tools: true, ..open(&session, &[3, 5]) }).await.unwrap();
    let mut blind = TestTouch::open(&server, open(&session, &[1])).await.unwrap();
    let tip = pb::Tip { radius_m: 0.007, friction: Some(0.4), ..Default::default() };
    for k in 0..200_u64 {
        let mut command = pose(k + 1, 1000 + k, 0.002 - 2e-5 * (k.min(150)) as f64);
        command.tool = 3;
        if let Some(pb::command::Action::Pose(pose)) = &mut command.action {
            pose.tip = Some(tip);
        }
        mover.command(command).await;
    }
    let lowered = |sample: &pb::Sample| {
        sample.other_tools.first().is_some_and(|other| other.position_m.is_some_and(|place_m| place_m.z < 0.0))
    };
    let sample = seen.sample_with(lowered).await;
    let [other] = &sample.other_tools[..] else { panic!("{sample:?}") };
    assert_eq!((other.tool, other.tip), (3, Some(tip)));
    let velocity_m_per_s = other.velocity_m_per_s.unwrap();
    assert!((-0.5..=0.0).contains(&velocity_m_per_s.z), "{velocity_m_per_s:?}");
    assert!(sample.tools.iter().all(|tool| tool.tool == 0));
    // Its own tools are none of the others.
    assert_eq!(mover.sample_with(|sample| sample.step > 0).await.other_tools, []);
    assert_eq!(blind.sample_with(|sample| sample.step > 0).await.other_tools, []);
}

#[tokio::test]
async fn without_poses_the_tool_is_held_and_then_lets_go() {
    let server = TestServer::start(&[]);
    let session = liver(&server).await;
    let mut touch =
        TestTouch::open(&server, pb::TouchOpen { device: Some(device()), ..open(&session, &[0]) }).await.unwrap();
    for k in 0..200_u64 {
        touch.command(pose(k + 1, 1000 + k, 0.001 - 2e-5 * k as f64)).await;
    }
    let pressed =
        |sample: &pb::Sample| sample.tools.first().is_some_and(|tool| tool.force_on_tool_n.is_some_and(|f| f.z > 0.05));
    touch.sample_with(pressed).await;
    touch.sample_with(|sample| sample.tools[0].stale).await;
    let free = |sample: &pb::Sample| sample.tools[0].expired && sample.tools[0].local_model.is_none();
    touch.sample_with(free).await;
}

#[tokio::test]
async fn what_makes_no_sense_is_refused() {
    let server = TestServer::start(&[]);
    let session = liver(&server).await;
    let broken = |change: fn(&mut pb::Device)| {
        let mut device = device();
        change(&mut device);
        pb::TouchOpen { device: Some(device), ..open(&session, &[0]) }
    };
    let tip = pb::Tip { radius_m: -1.0, ..Default::default() };
    for (request, reason, field) in [
        (broken(|device| device.max_force_n = f64::NAN), "NOT_FINITE", "device.max_force_n"),
        (broken(|device| device.workspace_radius_m = 0.0), "OUT_OF_RANGE", "device.workspace_radius_m"),
        (pb::TouchOpen { deadband: Some(foretold()), ..open(&session, &[0]) }, "MISSING", "deadband.rendered_fraction"),
        (pb::TouchOpen { tip: Some(tip), ..open(&session, &[0]) }, "OUT_OF_RANGE", "tip.radius_m"),
        (pb::TouchOpen { touch_stiffness: true, ..open(&session, &[0]) }, "MISSING", "device"),
    ] {
        let refused = TestTouch::open(&server, request).await.err().unwrap();
        let (code, told_reason, told_field) = told(&refused);
        assert_eq!((told_reason.as_str(), told_field.as_str()), (reason, field));
        assert_ne!(code, Code::Internal);
    }
    let mut touch =
        TestTouch::open(&server, pb::TouchOpen { device: Some(device()), ..open(&session, &[0]) }).await.unwrap();
    for (sequence, z_m, reason) in [(1, f64::NAN, "NOT_FINITE"), (2, 0.08, "OUT_OF_RANGE"), (3, 1e9, "OUT_OF_RANGE")] {
        touch.command(pose(sequence, sequence, z_m)).await;
        let rejection = touch.rejection().await;
        assert_eq!((rejection.reason.as_str(), rejection.field.as_str()), (reason, "pose.position_m"), "z = {z_m}");
    }
    assert_eq!(DEVICES.len(), 9);
}

#[tokio::test]
async fn a_tool_at_the_fixed_rim_says_so() {
    let server = TestServer::start(&[]);
    let session = liver(&server).await;
    let mut touch = TestTouch::open(&server, open(&session, &[0, 1])).await.unwrap();
    for (tool, x) in [(0, 0.0375), (1, 0.0)] {
        let position_m = Some(pb::Vector3 { x, y: 0.0375, z: -0.001 });
        let action = Some(pb::command::Action::Pose(pb::Pose { position_m, ..Default::default() }));
        touch.command(pb::Command { tool, action, ..Default::default() }).await;
        let sample = touch.sample_with(|sample| sample.tools[tool as usize].point.is_some()).await;
        let told = &sample.tools[tool as usize];
        assert_eq!((told.point.unwrap().x, told.on_fixed_point), ([15, 0][tool as usize], tool == 1));
    }
}

/// A deadband on the force that a client renders.
fn foretold() -> pb::Deadband {
    pb::Deadband { rendered_fraction: Some(0.1), ..Default::default() }
}

#[tokio::test]
async fn a_deadband_sends_heartbeats_and_little_else() {
    let server = TestServer::start(&[]);
    let session = liver(&server).await;
    let thrifty = pb::TouchOpen { device: Some(device()), deadband: Some(foretold()), ..open(&session, &[0]) };
    let mut touch = TestTouch::open(&server, thrifty).await.unwrap();
    // A better law is news.
    touch.exact_law().await;
    touch.command(pose(1, 1, 0.001)).await;
    let with_model = |sample: &pb::Sample| sample.tools.first().is_some_and(|tool| tool.local_model.is_some());
    let first = touch.sample_with(with_model).await.step;
    touch.command(pose(2, 20, 0.001)).await;
    let second = touch.sample_with(|sample| sample.step > first).await.step;
    assert!(second - first >= 40, "steps {first} and {second}: nothing happened between them");
}

#[tokio::test]
async fn a_tissue_beyond_the_device_is_told_of() {
    let server = TestServer::start(&[]);
    let source = pb::create_session_request::Source::SceneName("fibrotic".into());
    let request = pb::CreateSessionRequest { source: Some(source), ..Default::default() };
    let session =
        server.sessions().await.create_session(request).await.unwrap().into_inner().session.unwrap().session_id;
    for (tool, device, warnings) in [(0, "touch", 1), (1, "lambda7", 0)] {
        let device = touch::device(&Device::named(device).unwrap());
        let opened = TestTouch::open(&server, pb::TouchOpen { device: Some(device), ..open(&session, &[tool]) }).await;
        let told = opened.unwrap().opened.take().unwrap().warnings;
        assert_eq!(told.len(), warnings, "{told:?}");
    }
}

/// No tool ever leaps, whatever commands ask for it.
#[tokio::test]
async fn a_pose_across_the_sheet_is_walked_to() {
    let server = TestServer::start(&[]);
    let session = liver(&server).await;
    let mut touch = TestTouch::open(&server, open(&session, &[0])).await.unwrap();
    touch.command(pose(1, 0, 0.001)).await;
    let there = touch.sample_with(|sample| sample.tools[0].displacement_m.is_some()).await;
    let mut far = pose(2, 0, -0.01);
    if let Some(pb::command::Action::Pose(pose)) = &mut far.action {
        pose.position_m = Some(pb::Vector3 { x: 0.005, y: 0.07, z: -0.01 });
    }
    touch.command(far).await;
    let mut fastest_m_per_s = 0.0_f64;
    while touch.sample_with(|_| true).await.step < there.step + 150 {
        let sample = touch.sample_with(|sample| sample.step > there.step).await;
        let velocity = sample.tools[0].velocity_m_per_s.unwrap();
        fastest_m_per_s = fastest_m_per_s.max((velocity.x.powi(2) + velocity.y.powi(2) + velocity.z.powi(2)).sqrt());
    }
    assert!((0.4..=0.5 + 1e-9).contains(&fastest_m_per_s), "{fastest_m_per_s} m/s");
}
