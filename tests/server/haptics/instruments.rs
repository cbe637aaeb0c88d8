//! Instruments over a real server: one pose moves all tips, samples have the wrench, and what is wrong is named.

use crate::common::server::{TestServer, TestTouch, open, told};
use glam::{DQuat, DVec3};
use palpate_haptics::{
    Instrument, InstrumentPart, InstrumentPose, InstrumentTip, InstrumentVelocity, JawTorqueMonitor, Port, Tip,
};
use palpate_proto::geometry::{from_vector, vector};
use palpate_proto::pb::command::Action;
use palpate_proto::{instrument, pb, touch};
use pb::touch_response::Message as Heard;

/// A shaft of 20 mm, and jaws of 8 mm: 5 + 3 + 3 tips.
fn grasper() -> Instrument {
    let tip = Tip { radius_m: 0.004, friction: 0.3, ..Tip::default() };
    let mut instrument = Instrument { hinge_m: -0.01 * DVec3::X, ..Instrument::default() };
    instrument.add_row(-0.01 * DVec3::X, -0.026 * DVec3::X, tip, InstrumentPart::Body);
    instrument.add_row(-0.008 * DVec3::X, DVec3::ZERO, tip, InstrumentPart::UpperJaw);
    instrument.add_row(-0.008 * DVec3::X, DVec3::ZERO, tip, InstrumentPart::LowerJaw);
    assert_eq!(instrument.tips.len(), 11);
    instrument
}

/// The pose at a step: down onto `liver`, tilted and turning, while the jaws close.
fn pose_at(step: u64) -> InstrumentPose {
    let part = (step as f64 / 300.0).min(1.0);
    let pose = InstrumentPose {
        place_m: DVec3::new(0.045, 0.0375, 0.004 - 0.006 * part),
        orientation: DQuat::from_rotation_z(0.6 * part) * DQuat::from_rotation_y(0.1),
        jaw_rad: 0.8 * (1.0 - part),
    };
    // As the server reads it: rounding of the orientation is part of the bits.
    instrument::from_pose(&instrument::pose(&pose), &grasper()).unwrap().0
}

const FIRST: u32 = 2;

fn tools() -> Vec<u32> {
    (FIRST..FIRST + 11).collect()
}

fn port_at(place_m: DVec3, handle_m: f64) -> pb::Port {
    pb::Port { position_m: vector(place_m), handle_m }
}

async fn liver(server: &TestServer, paused: bool) -> String {
    let source = Some(pb::create_session_request::Source::SceneName("liver".into()));
    let request = pb::CreateSessionRequest { source, paused, ..Default::default() };
    server.sessions().await.create_session(request).await.unwrap().into_inner().session.unwrap().session_id
}

async fn start(server: &TestServer, session: &str, until_step: u64) {
    let request = pb::StartSessionRequest { session_id: session.to_owned(), until_step: Some(until_step) };
    server.sessions().await.start_session(request).await.unwrap();
}

fn with_grasper(session: &str) -> pb::TouchOpen {
    let instruments = vec![instrument::instrument(&grasper(), FIRST)];
    pb::TouchOpen { instruments, ..open(session, &tools()) }
}

fn command(step: u64, pose: pb::InstrumentPose) -> pb::Command {
    let action = Some(Action::Instrument(pose));
    pb::Command { tool: FIRST, sequence: Some(step + 1), at_step: Some(step), action, ..Default::default() }
}

fn forces_n(sample: &pb::Sample) -> Vec<DVec3> {
    sample.tools.iter().map(|tool| from_vector(tool.force_on_tool_n.as_ref())).collect()
}

/// The tips have the forces of tools that are led one by one, bit by bit, and the wrench is their sum.
#[tokio::test]
async fn one_pose_moves_all_tips_and_samples_have_the_wrench() {
    const STEPS: u64 = 300;
    let server = TestServer::start(&[]);
    let (together, apart) = (liver(&server, true).await, liver(&server, true).await);
    let mut as_one = TestTouch::open(&server, with_grasper(&together)).await.unwrap();
    let mut as_many = TestTouch::open(&server, open(&apart, &tools())).await.unwrap();
    let grasper = grasper();
    for step in 0..STEPS {
        let pose = pose_at(step + 1);
        as_one.command(command(step, instrument::pose(&pose))).await;
        for (number, tool) in (FIRST..).take(grasper.tips.len()).enumerate() {
            let action = Some(Action::Pose(touch::pose(grasper.tip_m(number, &pose), &grasper.tips[number].tip)));
            let command = pb::Command { tool, action, ..command(step, pb::InstrumentPose::default()) };
            as_many.command(command).await;
        }
    }
    as_one.settle().await;
    as_many.settle().await;
    start(&server, &together, STEPS).await;
    start(&server, &apart, STEPS).await;
    let whole = as_one.sample_with(|sample| sample.step == STEPS).await;
    let parts = as_many.sample_with(|sample| sample.step == STEPS).await;
    let forces_n = (forces_n(&whole), forces_n(&parts));
    assert_eq!(forces_n.0, forces_n.1);
    assert!(forces_n.0.iter().filter(|force_n| force_n.z > 0.01).count() >= 6, "{:?}", forces_n.0);
    assert_eq!(parts.instruments, []);
    let [felt] = &whole.instruments[..] else { panic!("{whole:?}") };
    let pose = pose_at(STEPS);
    assert_eq!((felt.first_tool, from_vector(felt.about_m.as_ref())), (FIRST, pose.place_m));
    let numbered = || forces_n.0.iter().copied().enumerate();
    let wrench = grasper.wrench(&pose, numbered());
    assert_eq!(from_vector(felt.force_on_tool_n.as_ref()), wrench.force_n);
    assert_eq!(from_vector(felt.torque_on_tool_n_m.as_ref()), wrench.torque_n_m);
    assert!(wrench.torque_n_m.length() > 1e-4, "{wrench:?}");
    assert_eq!(felt.opening_n_m, Some(grasper.opening_n_m(&pose, numbered())));
    // One release lets go of all.
    let release = Some(Action::Release(pb::Release {}));
    as_one
        .command(pb::Command { sequence: Some(1000), at_step: None, action: release, ..command(0, Default::default()) })
        .await;
    as_one.settle().await;
    start(&server, &together, STEPS + 1).await;
    let after = as_one.sample_with(|sample| sample.step == STEPS + 1).await;
    assert_eq!(after.instruments, []);
}

/// The jaws close on `liver` and drag it. Half of the largest torque that a first stream was told of is the limit of a second one.
#[tokio::test]
async fn a_stream_is_told_once_that_jaws_crush_what_they_hold() {
    const STEPS: u64 = 300;
    let server = TestServer::start(&[]);
    let mut limit_n_m = None;
    for round in 0..2 {
        let session = liver(&server, true).await;
        let grasper = Instrument { jaw_torque_limit_n_m: limit_n_m, ..grasper() };
        let instruments = vec![instrument::instrument(&grasper, FIRST)];
        let mut touch =
            TestTouch::open(&server, pb::TouchOpen { instruments, ..open(&session, &tools()) }).await.unwrap();
        for step in 0..STEPS {
            touch.command(command(step, instrument::pose(&pose_at(step + 1)))).await;
        }
        touch.settle().await;
        start(&server, &session, STEPS).await;
        let (mut most_n_m, mut monitor, mut told) = (0.0_f64, JawTorqueMonitor::of(&grasper), None);
        let mut overloads = 0;
        loop {
            match touch.hear().await.unwrap().unwrap() {
                Heard::JawOverload(overload) => {
                    assert!(told.is_none(), "{told:?}");
                    told = Some(overload);
                }
                Heard::Sample(sample) => {
                    let opening_n_m = sample.instruments.first().map_or(0.0, |felt| felt.opening_n_m.unwrap());
                    most_n_m = most_n_m.max(opening_n_m);
                    // It comes before the sample in which the torque is above the limit.
                    let exceeds = monitor.as_mut().is_some_and(|monitor| monitor.exceeds(opening_n_m));
                    let expected = exceeds.then(|| pb::JawOverload {
                        first_tool: FIRST,
                        step: sample.step,
                        torque_n_m: opening_n_m,
                        limit_n_m: limit_n_m.unwrap(),
                    });
                    assert_eq!(told.take(), expected);
                    overloads += u32::from(exceeds);
                    if sample.step == STEPS {
                        break;
                    }
                }
                _ => {}
            }
        }
        println!("{most_n_m} N·m, {overloads} times");
        assert!(most_n_m > 1e-6 && (overloads > 0) == (round == 1), "{most_n_m} {overloads}");
        limit_n_m = Some(0.5 * most_n_m);
    }
}

/// Poses by the client's time are played back, also with velocities: the wrench is told about where the instrument is then.
#[tokio::test]
async fn an_instrument_is_led_by_the_clients_time() {
    let server = TestServer::start(&[]);
    let session = liver(&server, false).await;
    let mut touch = TestTouch::open(&server, with_grasper(&session)).await.unwrap();
    let velocity = InstrumentVelocity {
        velocity_m_per_s: -0.02 * DVec3::Z,
        angular_rad_per_s: 2.0 * DVec3::Z,
        jaw_rad_per_s: -0.8 / 0.3,
    };
    let mut pose = InstrumentPose { jaw_rad: 0.8, ..pose_at(0) };
    for tick in 0..300_u64 {
        let told = pb::InstrumentPose {
            velocity_m_per_s: vector(velocity.velocity_m_per_s),
            angular_velocity_rad_per_s: vector(velocity.angular_rad_per_s),
            jaw_velocity_rad_per_s: velocity.jaw_rad_per_s,
            ..instrument::pose(&pose)
        };
        let client_time_ns = (1 + tick) * 1_000_000;
        touch.command(pb::Command { client_time_ns, at_step: None, ..command(tick, told) }).await;
        pose = velocity.after(&pose, 1e-3);
    }
    let pressed = |sample: &pb::Sample| {
        let felt = sample.instruments.first().and_then(|felt| felt.force_on_tool_n);
        felt.is_some_and(|force_n| force_n.z > 0.05)
    };
    let sample = touch.sample_with(pressed).await;
    let about_m = from_vector(sample.instruments[0].about_m.as_ref());
    // On the way down, or beyond its last pose by what 50 ms of its velocity are.
    assert!((0.004 - 0.35 * 0.02 - 1e-9..0.004).contains(&about_m.z), "{about_m}");
    let sum_n: DVec3 = forces_n(&sample).into_iter().sum();
    assert!(sum_n.distance(from_vector(sample.instruments[0].force_on_tool_n.as_ref())) < 1e-12 * sum_n.length());
}

/// The shaft of an instrument in a port passes through it at every step, also while the server goes on by velocities.
#[tokio::test]
async fn an_instrument_in_a_port_stays_in_it() {
    let server = TestServer::start(&[]);
    let session = liver(&server, false).await;
    let port = Port { place_m: DVec3::new(0.0375, 0.0375, 0.12), handle_m: 0.33 };
    let shaft = Instrument { port: Some(port), ..grasper() };
    let instruments = vec![instrument::instrument(&shaft, FIRST)];
    let open = pb::TouchOpen { instruments, ..open(&session, &tools()) };
    let mut touch = TestTouch::open(&server, open).await.unwrap();
    let place_m =
        |tick: u64| DVec3::new(0.0375 + 0.01 * (0.02 * tick as f64).sin(), 0.0375, 0.003 - 2e-5 * tick as f64);
    // The first has an orientation with which the shaft would be beside the port.
    for tick in 0..300_u64 {
        let told = pb::InstrumentPose {
            velocity_m_per_s: vector(1e3 * (place_m(tick + 1) - place_m(tick))),
            ..instrument::pose(&InstrumentPose { place_m: place_m(tick), orientation: DQuat::IDENTITY, jaw_rad: 0.0 })
        };
        let client_time_ns = (1 + tick) * 1_000_000;
        if tick % 10 == 0 {
            touch.command(pb::Command { client_time_ns, at_step: None, ..command(tick, told) }).await;
        }
    }
    let mut pressed_n = 0.0_f64;
    while pressed_n < 0.05 {
        let sample = touch.sample_with(|sample| !sample.instruments.is_empty()).await;
        let felt = sample.instruments[0].clone();
        let about_m = from_vector(felt.about_m.as_ref());
        let turn = felt.orientation.unwrap();
        let axis = DQuat::from_xyzw(turn.x, turn.y, turn.z, turn.w) * DVec3::X;
        assert!((about_m - port.place_m).cross(axis).length() < 1e-12, "{felt:?}");
        let load = felt.port_load.unwrap();
        let [tissue_n, port_n, hand_n] =
            [felt.force_on_tool_n, load.force_of_port_n, load.force_on_hand_n].map(|n| from_vector(n.as_ref()));
        assert!((tissue_n + port_n).distance(hand_n) < 1e-9, "{felt:?}");
        pressed_n = pressed_n.max(port_n.length());
    }
}

#[tokio::test]
async fn an_instrument_that_is_far_away_feels_nothing_and_its_client_is_told_of_another_tissue() {
    let server = TestServer::start(&[]);
    let session = liver(&server, false).await;
    let mut touch = TestTouch::open(&server, with_grasper(&session)).await.unwrap();
    let far = InstrumentPose { place_m: DVec3::new(0.0375, 0.0375, 0.2), ..pose_at(0) };
    let told = pb::Command { client_time_ns: 7_000_000, at_step: None, ..command(0, instrument::pose(&far)) };
    touch.command(told).await;
    let sample = touch.sample_with(|sample| !sample.instruments.is_empty()).await;
    let felt = sample.instruments[0].clone();
    assert_eq!((felt.client_time_ns, from_vector(felt.about_m.as_ref())), (7_000_000, far.place_m));
    assert_eq!(from_vector(felt.force_on_tool_n.as_ref()), DVec3::ZERO);
    let change =
        pb::UpdateTissueRequest { session_id: session, anchor_stiffness_n_per_m: Some(9.0), ..Default::default() };
    let step = server.sessions().await.update_tissue(change).await.unwrap().into_inner().step;
    let update = loop {
        if let Some(pb::touch_response::Message::ForceLaw(update)) = touch.hear().await.unwrap() {
            break update;
        }
    };
    assert!(update.law.is_none() && update.tissue_step.is_some_and(|at| at >= step), "{update:?}");
}

#[tokio::test]
async fn what_is_wrong_with_an_instrument_is_named() {
    let server = TestServer::start(&[]);
    let session = liver(&server, true).await;
    let message = || instrument::instrument(&grasper(), FIRST);
    let with = |change: &dyn Fn(&mut pb::Instrument)| {
        let mut instrument = message();
        change(&mut instrument);
        pb::TouchOpen { instruments: vec![instrument], ..open(&session, &tools()) }
    };
    let tip = |change: fn(&mut pb::Tip)| {
        move |instrument: &mut pb::Instrument| change(instrument.tips[3].tip.as_mut().unwrap())
    };
    let twice = pb::TouchOpen { instruments: vec![message(), message()], ..open(&session, &tools()) };
    for (open, reason, field) in [
        (with(&|instrument| instrument.tips.clear()), "MISSING", "instruments[0].tips"),
        (with(&|instrument| instrument.tips = vec![instrument.tips[0]; 65]), "TOO_LARGE", "instruments[0].tips"),
        (with(&tip(|tip| tip.grasps = true)), "WRONG_KIND", "instruments[0].tips[3].tip.grasps"),
        (with(&tip(|tip| tip.radius_m = -1.0)), "OUT_OF_RANGE", "instruments[0].tips[3].tip.radius_m"),
        (with(&tip(|tip| tip.shape = 3)), "OUT_OF_RANGE", "instruments[0].tips[3].tip.shape"),
        (with(&|instrument| instrument.tips[1].part = 9), "OUT_OF_RANGE", "instruments[0].tips[1].part"),
        (
            with(&|instrument| instrument.tips[0].offset_m = vector(f64::NAN * DVec3::X)),
            "NOT_FINITE",
            "instruments[0].tips[0].offset_m",
        ),
        (with(&|instrument| instrument.hinge_m = vector(11.0 * DVec3::X)), "OUT_OF_RANGE", "instruments[0].hinge_m"),
        (with(&|instrument| instrument.first_tool = 3), "OUT_OF_RANGE", "instruments[0].first_tool"),
        (with(&|instrument| instrument.first_tool = u32::MAX - 2), "OUT_OF_RANGE", "instruments[0].first_tool"),
        (twice, "OUT_OF_RANGE", "instruments[1].first_tool"),
        (
            with(&|instrument| instrument.jaw_torque_limit_n_m = Some(0.0)),
            "OUT_OF_RANGE",
            "instruments[0].jaw_torque_limit_n_m",
        ),
        (
            with(&|instrument| instrument.jaw_torque_limit_n_m = Some(f64::NAN)),
            "NOT_FINITE",
            "instruments[0].jaw_torque_limit_n_m",
        ),
        (
            with(&|instrument| {
                instrument.tips.iter_mut().for_each(|tip| tip.part = 1);
                instrument.jaw_torque_limit_n_m = Some(0.1);
            }),
            "WRONG_KIND",
            "instruments[0].jaw_torque_limit_n_m",
        ),
        (
            with(&|instrument| instrument.port = Some(port_at(DVec3::Z, 3.0))),
            "OUT_OF_RANGE",
            "instruments[0].port.handle_m",
        ),
        (
            with(&|instrument| instrument.port = Some(port_at(DVec3::NAN, 0.3))),
            "NOT_FINITE",
            "instruments[0].port.position_m",
        ),
    ] {
        let refused = TestTouch::open(&server, open).await.err().unwrap();
        let (_, told_reason, told_field) = told(&refused);
        assert_eq!((&*told_reason, &*told_field), (reason, field), "{refused:?}");
    }
    let mut touch = TestTouch::open(&server, with_grasper(&session)).await.unwrap();
    let pose = |change: fn(&mut pb::InstrumentPose)| {
        let mut pose = instrument::pose(&pose_at(0));
        change(&mut pose);
        command(0, pose)
    };
    let plain = || touch::pose(DVec3::new(0.03, 0.03, 0.01), &Tip::default());
    for (command, reason, field) in [
        (pose(|pose| pose.position_m = None), "MISSING", "instrument.position_m"),
        (pose(|pose| pose.orientation.as_mut().unwrap().w += 0.1), "OUT_OF_RANGE", "instrument.orientation"),
        (pose(|pose| pose.jaw_rad = 4.0), "OUT_OF_RANGE", "instrument.jaw_rad"),
        (pose(|pose| pose.jaw_rad = f64::NAN), "NOT_FINITE", "instrument.jaw_rad"),
        (pose(|pose| pose.position_m = vector(DVec3::splat(f64::INFINITY))), "NOT_FINITE", "instrument.position_m"),
        (pose(|pose| pose.position_m = vector(DVec3::splat(1e3))), "OUT_OF_RANGE", "instrument.position_m"),
        (
            pose(|pose| (pose.velocity_m_per_s, pose.jaw_velocity_rad_per_s) = (vector(DVec3::ZERO), 1e4)),
            "OUT_OF_RANGE",
            "instrument.jaw_velocity_rad_per_s",
        ),
        (pb::Command { sequence: None, ..pose(|_| {}) }, "MISSING", "sequence"),
        (pb::Command { tool: FIRST + 1, ..pose(|_| {}) }, "WRONG_KIND", "tool"),
        (pb::Command { action: Some(Action::Pose(plain())), ..pose(|_| {}) }, "WRONG_KIND", "action"),
        (pb::Command { action: None, ..pose(|_| {}) }, "WRONG_KIND", "action"),
    ] {
        touch.command(command).await;
        let rejection = touch.rejection().await;
        assert_eq!((&*rejection.reason, &*rejection.field), (reason, field), "{}", rejection.message);
    }
    // Nothing of it has moved a tip, and a tool without an instrument has none.
    start(&server, &session, 3).await;
    let sample = touch.sample_with(|sample| sample.step == 3).await;
    assert!(sample.instruments.is_empty() && forces_n(&sample).iter().all(|force_n| *force_n == DVec3::ZERO));
    let mut single = TestTouch::open(&server, open(&session, &[0])).await.unwrap();
    single.command(pb::Command { tool: 0, ..pose(|_| {}) }).await;
    let rejection = single.rejection().await;
    assert_eq!((&*rejection.reason, &*rejection.field), ("WRONG_KIND", "instrument"));
}

#[test]
fn an_instrument_is_read_as_it_was_written() {
    let told = InstrumentTip { offset_m: 0.02 * DVec3::Y, tip: Tip::default(), part: InstrumentPart::Body };
    let port = Some(Port { place_m: DVec3::new(0.04, 0.04, 0.2), handle_m: 0.3 });
    let tips = [grasper().tips, vec![told]].concat();
    let grasper = Instrument { tips, port, jaw_torque_limit_n_m: Some(0.02), ..grasper() };
    assert_eq!(instrument::from_instrument("", &instrument::instrument(&grasper, 5)).unwrap(), grasper);
    let (pose, velocity) = instrument::from_pose(&instrument::pose(&pose_at(100)), &grasper).unwrap();
    assert!(pose.orientation.angle_between(pose_at(100).orientation) < 1e-7 && velocity.is_none());
    assert_eq!((pose.place_m, pose.jaw_rad), (pose_at(100).place_m, pose_at(100).jaw_rad));
    // At its port an instrument has no direction.
    let there = InstrumentPose { place_m: DVec3::new(0.04, 0.04, 0.2005), ..pose };
    let refusal = instrument::from_pose(&instrument::pose(&there), &grasper).unwrap_err();
    assert!(refusal.to_string().contains("from 0.001 to 0.299 m from the port"), "{refusal}");
}

/// Two clients' shafts lie across each other, 5 mm apart with radii of 3 mm: each is told of the other.
#[tokio::test]
async fn instruments_of_two_streams_push_each_other_apart() {
    let server = TestServer::start(&[]);
    let session = liver(&server, true).await;
    let tip = Tip { radius_m: 0.003, ..Tip::default() };
    let mut shaft = Instrument::default();
    shaft.add_row(DVec3::ZERO, -0.03 * DVec3::X, tip, InstrumentPart::Body);
    let tips = u32::try_from(shaft.tips.len()).unwrap();
    let opened = async |first: u32| {
        let instruments = vec![instrument::instrument(&shaft, first)];
        let tools: Vec<u32> = (first..first + tips).collect();
        let request = pb::TouchOpen { instruments, other_tools: true, ..open(&session, &tools) };
        TestTouch::open(&server, request).await.unwrap()
    };
    let (mut lower, mut upper) = (opened(0).await, opened(20).await);
    let along = InstrumentPose::at(DVec3::new(0.05, 0.0375, 0.008));
    let across = InstrumentPose {
        orientation: DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2),
        ..InstrumentPose::at(DVec3::new(0.0375, 0.05, 0.013))
    };
    for (stream, tool, pose) in [(&mut lower, 0, along), (&mut upper, 20, across)] {
        stream.command(pb::Command { tool, ..command(0, instrument::pose(&pose)) }).await;
        stream.settle().await;
    }
    // Each stream has seen its own instrument before the other one's next sample.
    start(&server, &session, 20).await;
    lower.sample_with(|sample| sample.step == 20).await;
    upper.sample_with(|sample| sample.step == 20).await;
    start(&server, &session, 21).await;
    for (stream, pose, other, sign) in [(&mut lower, along, 20, -1.0), (&mut upper, across, 0, 1.0)] {
        let sample = stream.sample_with(|sample| sample.step == 21).await;
        let [felt] = &sample.instruments[..] else { panic!("{sample:?}") };
        let [contact] = &felt.contacts[..] else { panic!("{felt:?}") };
        assert_eq!(contact.other_tool, other);
        // 1 mm of 6: 1000 N/m · 1 mm / (1 − 1/6).
        let force_n = from_vector(contact.force_n.as_ref());
        assert!((contact.depth_m - 0.001).abs() < 1e-9, "{contact:?}");
        assert!(force_n.distance(sign * 1.2 * DVec3::Z) < 1e-6, "{contact:?}");
        let middle_m = DVec3::new(0.0375, 0.0375, 0.0105);
        let torque_n_m = (middle_m - pose.place_m).cross(force_n);
        assert!(from_vector(contact.torque_n_m.as_ref()).distance(torque_n_m) < 1e-6, "{contact:?}");
        // The tissue is not touched.
        assert_eq!(from_vector(felt.force_on_tool_n.as_ref()), DVec3::ZERO);
        let [seen] = &sample.other_instruments[..] else { panic!("{sample:?}") };
        assert_eq!((seen.first_tool, seen.capsules.len(), seen.capsules[0].radius_m), (other, 1, 0.003));
    }
    // Who has gone touches nothing.
    drop(upper);
    let mut sample = pb::Sample::default();
    for step in 22..2000 {
        start(&server, &session, step).await;
        sample = lower.sample_with(|sample| sample.step >= step).await;
        if sample.instruments[0].contacts.is_empty() {
            break;
        }
    }
    assert!(sample.instruments[0].contacts.is_empty() && sample.other_instruments.is_empty(), "{sample:?}");
}
