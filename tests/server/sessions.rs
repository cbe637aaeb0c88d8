//! The life of sessions and of the server.

use std::process::Command;

use crate::common::server::{TEST_TIMEOUT, TestServer, TestTouch, force, open, palpate, repository, told};
use palpate_proto::pb;
use pb::create_session_request::Source;
use tonic::Code;

fn paper() -> pb::Scene {
    let limits = palpate_tissue::limits::Limits::default();
    let paper = palpate_tissue::scene::Scene::parse("paper", palpate_tissue::scene::PAPER, &[], &limits).unwrap();
    palpate_session::wire::scene::scene(&paper)
}

#[tokio::test]
async fn sessions_are_made_listed_and_deleted() {
    let server = TestServer::start(&[]);
    let mut sessions = server.sessions().await;
    let names = sessions.list_scenes(pb::ListScenesRequest {}).await.unwrap().into_inner().scene_names;
    assert!(names.contains(&"paper".to_owned()), "{names:?}");
    let by_name = server.create(Source::SceneName("paper".into()), false).await.unwrap();
    assert_eq!(by_name.scene, Some(paper()));
    let mut own = paper();
    own.name = "own".into();
    own.stepping = Some(pb::Stepping { precision: "f64".into(), ..Default::default() });
    let own = server.create(Source::Scene(own), true).await.unwrap();
    assert_eq!((own.precision.as_str(), own.integrator.as_str(), own.substeps), ("f64", "exponential3", 1));
    assert_eq!((by_name.state(), own.state()), (pb::SessionState::Running, pb::SessionState::Paused));
    let listed = sessions.list_sessions(pb::ListSessionsRequest {}).await.unwrap().into_inner().sessions;
    let ids: Vec<_> = listed.iter().map(|session| session.session_id.clone()).collect();
    assert_eq!(ids, [by_name.session_id.clone(), own.session_id.clone()]);
    // A deletion ends every stream with a reason.
    let mut touch = TestTouch::hold(&server, &own.session_id).await;
    let request = pb::DeleteSessionRequest { session_id: own.session_id.clone() };
    sessions.delete_session(request.clone()).await.unwrap();
    let ended = loop {
        if let Err(status) = touch.hear().await {
            break status;
        }
    };
    assert_eq!(told(&ended), (Code::NotFound, "SESSION_DELETED".into(), "session_id".into()));
    let again = sessions.delete_session(request).await.unwrap_err();
    assert_eq!(told(&again), (Code::NotFound, "UNKNOWN_SESSION".into(), "session_id".into()));
    assert_eq!(sessions.list_sessions(pb::ListSessionsRequest {}).await.unwrap().into_inner().sessions.len(), 1);
}

#[tokio::test]
async fn bad_scenes_are_refused_with_the_field() {
    let server = TestServer::start(&[]);
    type Change = fn(&mut pb::Scene);
    let cases: [(Change, Code, &str, &str); 13] = [
        (|s| s.sheet.as_mut().unwrap().points_x = Some(0), Code::InvalidArgument, "OUT_OF_RANGE", "sheet.points"),
        (
            |s| s.sheet.as_mut().unwrap().points_y = Some(1_000_000_000),
            Code::ResourceExhausted,
            "TOO_LARGE",
            "sheet.points",
        ),
        (
            |s| s.sheet.as_mut().unwrap().spacing_m = Some(f64::NAN),
            Code::InvalidArgument,
            "NOT_FINITE",
            "sheet.spacing_m",
        ),
        (
            |s| s.sheet.as_mut().unwrap().point_mass_kg = Some(0.0),
            Code::InvalidArgument,
            "OUT_OF_RANGE",
            "sheet.point_mass_kg",
        ),
        (|s| s.sheet = None, Code::InvalidArgument, "MISSING", "scene.sheet"),
        (
            |s| s.springs.as_mut().unwrap().stiffness_n_per_m = Some(-1.0),
            Code::InvalidArgument,
            "OUT_OF_RANGE",
            "springs.stiffness_n_per_m",
        ),
        (
            |s| s.damping.as_mut().unwrap().coefficient_n_s_per_m = Some(f64::INFINITY),
            Code::InvalidArgument,
            "NOT_FINITE",
            "damping.coefficient_n_s_per_m",
        ),
        (
            |s| s.stepping.as_mut().unwrap().rate_hz = Some(0.0),
            Code::InvalidArgument,
            "OUT_OF_RANGE",
            "stepping.rate_hz",
        ),
        (
            |s| s.stepping.as_mut().unwrap().rate_hz = Some(1e6),
            Code::InvalidArgument,
            "OUT_OF_RANGE",
            "stepping.rate_hz",
        ),
        (
            |s| s.stepping.as_mut().unwrap().integrator = "magic".into(),
            Code::InvalidArgument,
            "WRONG_KIND",
            "scene.stepping.integrator",
        ),
        (
            |s| s.stepping.as_mut().unwrap().substeps = Some(0),
            Code::InvalidArgument,
            "OUT_OF_RANGE",
            "stepping.substeps",
        ),
        (
            |s| {
                let points = vec![pb::GridPoint { x: 40, y: 0 }];
                s.sheet.as_mut().unwrap().fixed = Some(pb::sheet::Fixed::FixedPoints(pb::GridPoints { points }));
            },
            Code::InvalidArgument,
            "OFF_TISSUE",
            "sheet.fixed[0]",
        ),
        (
            |s| s.springs.as_mut().unwrap().stiffness_n_per_m = Some(1e12),
            Code::ResourceExhausted,
            "TOO_LARGE",
            "stepping.rate_hz",
        ),
    ];
    for (change, code, reason, field) in cases {
        let mut scene = paper();
        change(&mut scene);
        let status = server.create(Source::Scene(scene), false).await.unwrap_err();
        assert_eq!(told(&status), (code, reason.into(), field.into()), "{}", status.message());
    }
    for name in ["nothing", "../scenes/paper", ""] {
        let status = server.create(Source::SceneName(name.into()), false).await.unwrap_err();
        assert_eq!(told(&status), (Code::NotFound, "UNKNOWN_SCENE".into(), "scene_name".into()));
    }
    let nothing = pb::CreateSessionRequest::default();
    let status = server.sessions().await.create_session(nothing).await.unwrap_err();
    assert_eq!(told(&status).1, "MISSING");
    // The server lives on, and made nothing of all this.
    let listed = server.sessions().await.list_sessions(pb::ListSessionsRequest {}).await.unwrap().into_inner();
    assert!(listed.sessions.is_empty());
}

#[tokio::test]
async fn a_paused_session_stands_and_a_started_one_goes_as_far_as_it_should() {
    let server = TestServer::start(&[]);
    let session = server.paper(true).await;
    server.start_until(&session, 25).await;
    let hash = server.hash_at(&session, 25).await;
    let status = server.status(&session).await;
    assert_eq!((status.step, status.state()), (25, pb::SessionState::Paused));
    assert_eq!(status.simulation_time_s, 0.025);
    assert_eq!(server.hash_at(&session, 25).await, hash);
    let mut sessions = server.sessions().await;
    let request = pb::GetStateHashRequest { session_id: session.clone(), at_step: Some(24) };
    let status = sessions.get_state_hash(request).await.unwrap_err();
    assert_eq!(told(&status), (Code::OutOfRange, "STEP_PASSED".into(), "at_step".into()));
    let request = pb::StartSessionRequest { session_id: session.clone(), until_step: Some(25) };
    assert_eq!(told(&sessions.start_session(request).await.unwrap_err()).2, "until_step");
    // For ever, until paused.
    let request = pb::StartSessionRequest { session_id: session.clone(), until_step: None };
    assert_eq!(sessions.start_session(request).await.unwrap().into_inner().step, 25);
    server.hash_at(&session, 60).await;
    sessions.pause_session(pb::PauseSessionRequest { session_id: session.clone() }).await.unwrap();
    let request = pb::GetStateHashRequest { session_id: session.clone(), at_step: None };
    let first = sessions.get_state_hash(request.clone()).await.unwrap().into_inner();
    tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    assert_eq!(sessions.get_state_hash(request).await.unwrap().into_inner(), first);
}

#[tokio::test]
async fn the_same_scene_and_commands_give_the_same_hash_on_any_number_of_threads() {
    let mut hashes = Vec::new();
    for threads in ["1", "3"] {
        let server = TestServer::start(&["--threads", threads]);
        // Other sessions make other schedules.
        for _ in 0..5 {
            server.paper(false).await;
        }
        let session = server.paper(true).await;
        let mut touch = TestTouch::hold(&server, &session).await;
        for step in 0..200 {
            let command = force(0, step + 1, -1.0 - 0.001 * step as f64);
            touch.command(pb::Command { at_step: Some(step), ..command }).await;
        }
        touch.settle().await;
        server.start_until(&session, 250).await;
        hashes.push(server.hash_at(&session, 250).await);
        assert_eq!(server.status(&session).await.late_commands, 0);
    }
    assert_eq!(hashes[0], hashes[1]);
}

#[tokio::test]
async fn a_session_too_heavy_for_its_rate_slows_its_own_time_and_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("palpate.toml");
    std::fs::write(&config, "[limits]\nperiods_per_step = 20.0\n").unwrap();
    let server = TestServer::start(&["--config", config.to_str().unwrap()]);
    let mut heavy = paper();
    let sheet = heavy.sheet.as_mut().unwrap();
    // No machine does 400,000 points 10,000 times a second on one core.
    (sheet.points_x, sheet.points_y) = (Some(800), Some(500));
    heavy.stepping.as_mut().unwrap().rate_hz = Some(10_000.0);
    let session = server.create(Source::Scene(heavy), false).await.unwrap().session_id;
    let request = pb::WatchSamplesRequest { session_id: session.clone(), ..Default::default() };
    let mut samples = server.haptics().await.watch_samples(request).await.unwrap().into_inner();
    // One force everywhere, so that all of it moves. At rest it would cost nothing.
    let touch = TestTouch::hold(&server, &session).await;
    let mut everywhere = force(0, 1, -1.0);
    let Some(pb::command::Action::Force(force)) = &mut everywhere.action else { unreachable!() };
    force.falloff_per_m = Some(0.0);
    touch.command(everywhere).await;
    let mut last: Option<pb::Sample> = None;
    loop {
        let sample =
            tokio::time::timeout(TEST_TIMEOUT, samples.message()).await.unwrap().unwrap().unwrap().sample.unwrap();
        if let Some(last) = last {
            // No step is longer than another, and none is left out: time is what gives way.
            assert!((sample.simulation_time_s - sample.step as f64 * 1e-4).abs() < 1e-12);
            assert!(sample.step > last.step && sample.overrun_count >= last.overrun_count);
        }
        if sample.overrun && sample.time_dilation < 0.9 && sample.overrun_count > 100 {
            break;
        }
        last = Some(sample);
    }
    let status = server.status(&session).await;
    assert!(status.time_dilation < 0.9 && status.overrun_count > 100);
}

/// Asks until the session rests.
async fn rested(server: &TestServer, session: &str) -> pb::Session {
    let until = std::time::Instant::now() + TEST_TIMEOUT;
    loop {
        let status = server.status(session).await;
        if status.resting {
            return status;
        }
        assert!(std::time::Instant::now() < until, "does not come to rest");
        tokio::time::sleep(std::time::Duration::from_millis(5)).await;
    }
}

#[tokio::test]
async fn time_goes_on_at_rest_without_steps_and_without_overruns() {
    let server = TestServer::start(&["--threads", "1"]);
    let session = server.paper(false).await;
    let first = rested(&server, &session).await;
    let later = loop {
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
        let status = rested(&server, &session).await;
        if status.step > first.step + 1500 {
            break status;
        }
    };
    assert_eq!(later.state(), pb::SessionState::Running);
    assert!(later.rested_steps > 1400, "{} of {} steps", later.rested_steps, later.step);
    assert_eq!((later.overrun_count, later.simulation_time_s), (0, later.step as f64 / 1000.0));
    // As many steps as there is time for, by our clock: what passed at least and at most between the two answers.
    let ask = async || {
        let asked = std::time::Instant::now();
        (asked, rested(&server, &session).await.step, std::time::Instant::now())
    };
    let (from, to) = (ask().await, {
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        ask().await
    });
    let steps = |begun: std::time::Instant, ended: std::time::Instant| (ended - begun).as_secs_f64() * 1000.0;
    let (least, most) = (steps(from.2, to.0) - 2.0, steps(from.0, to.2) + 2.0);
    let passed = (to.1 - from.1) as f64;
    assert!((least..=most).contains(&passed), "{passed} steps, not {least} to {most}");
    // To be paused ends it: time stands where it is.
    let mut sessions = server.sessions().await;
    sessions.pause_session(pb::PauseSessionRequest { session_id: session.clone() }).await.unwrap();
    let stands = server.status(&session).await;
    assert!(stands.step >= later.step && !stands.resting);
    assert_eq!(stands.state(), pb::SessionState::Paused);
    let asked = pb::GetStateHashRequest { session_id: session.clone(), at_step: Some(stands.step) };
    assert_eq!(sessions.get_state_hash(asked).await.unwrap().into_inner().step, stands.step);
    // And a step that somebody waits for is done at its time.
    server.start_until(&session, stands.step + 300).await;
    server.hash_at(&session, stands.step + 200).await;
    server.hash_at(&session, stands.step + 300).await;
    let stands = server.status(&session).await;
    assert_eq!((stands.state(), stands.resting, stands.overrun_count), (pb::SessionState::Paused, false, 0));
}

#[tokio::test]
async fn the_state_after_rest_is_that_of_a_session_that_was_stepped_all_the_time() {
    let server = TestServer::start(&["--threads", "1"]);
    let mut hashes = Vec::new();
    for probed in [false, true] {
        let session = server.paper(true).await;
        // One who records every step leaves nothing to skip.
        let points = pb::GridPoints { points: vec![pb::GridPoint { x: 1, y: 1 }] };
        let r#where = Some(pb::probe_request::Where::Points(points));
        let probe = pb::ProbeRequest { session_id: session.clone(), r#where, ..Default::default() };
        let mut haptics = server.haptics().await;
        let records = if probed { Some(haptics.probe(probe).await.unwrap()) } else { None };
        let mut touch = TestTouch::hold(&server, &session).await;
        touch.command(pb::Command { at_step: Some(400), ..force(0, 1, -1.0) }).await;
        touch.settle().await;
        server.start_until(&session, 450).await;
        hashes.push(server.hash_at(&session, 450).await);
        let status = server.status(&session).await;
        assert_eq!((status.step, status.late_commands), (450, 0));
        assert_eq!(status.rested_steps > 300, !probed, "{} steps rested", status.rested_steps);
        drop(records);
    }
    assert_eq!(hashes[0], hashes[1]);
}

#[tokio::test]
async fn a_command_wakes_a_session_at_the_step_that_is_next() {
    let server = TestServer::start(&["--threads", "1"]);
    let session = server.paper(false).await;
    let mut touch = TestTouch::hold(&server, &session).await;
    let mut sequence = 0;
    for at_step in [None, Some(0)] {
        let before = rested(&server, &session).await;
        sequence += 1;
        // A release changes nothing: the session continues to rest.
        let release = Some(pb::command::Action::Release(pb::Release {}));
        touch.command(pb::Command { sequence: Some(sequence), at_step, action: release, ..Default::default() }).await;
        let sample = touch.sample_with(|sample| sample.tools[0].acknowledged_sequence == sequence).await;
        let after = server.status(&session).await;
        assert!((before.step..=after.step).contains(&sample.step), "{} {} {}", before.step, sample.step, after.step);
        assert_eq!((sample.asleep, sample.tools[0].late), (true, at_step.is_some()));
    }
    rested(&server, &session).await;
    touch.command(force(0, sequence + 1, -1.0)).await;
    let sample = touch.sample_with(|sample| sample.tools[0].acknowledged_sequence == sequence + 1).await;
    assert!(!sample.asleep && sample.awake_points > 0);
    assert_eq!(sample.tools[0].applied_force_n.unwrap().z, -1.0);
}

#[tokio::test]
async fn a_lease_lapses_at_rest_at_its_step() {
    let server = TestServer::start(&["--threads", "1"]);
    let session = server.paper(false).await;
    rested(&server, &session).await;
    let mut touch =
        TestTouch::open(&server, pb::TouchOpen { lease_s: Some(0.1), ..open(&session, &[0]) }).await.unwrap();
    let opened = touch.opened.take().unwrap();
    // Nobody asks for anything. Of the step, not of the time at which a busy machine does it.
    let expired = touch.sample_with(|sample| sample.tools[0].expired).await;
    assert!((100..=102).contains(&(expired.step - opened.step)), "{} steps", expired.step - opened.step);
    assert!(expired.asleep);
}

#[cfg(target_os = "linux")]
#[tokio::test]
async fn with_nothing_awake_the_stepping_threads_sleep() {
    let server = TestServer::start(&["--threads", "2"]);
    for _ in 0..20 {
        let session = server.paper(false).await;
        rested(&server, &session).await;
    }
    // How often each stepping thread gave up a core of its own accord: a sleep is one, a poll many.
    let sleeps = || {
        let tasks = std::fs::read_dir(format!("/proc/{}/task", server.child.id())).unwrap();
        let steps = tasks.map(|task| std::fs::read_to_string(task.unwrap().path().join("status")).unwrap());
        let of = |status: &String| {
            let line = status.lines().find(|line| line.starts_with("voluntary_ctxt_switches:")).unwrap();
            line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap()
        };
        steps.filter(|status| status.starts_with("Name:\tstep-")).map(|status| of(&status)).collect::<Vec<_>>()
    };
    let until = std::time::Instant::now() + TEST_TIMEOUT;
    loop {
        // The last of them may be on its way to sleep.
        let before = sleeps();
        // Two, and the one that gives way to them.
        assert_eq!(before.len(), 3);
        tokio::time::sleep(std::time::Duration::from_millis(500)).await;
        if sleeps() == before {
            break;
        }
        assert!(std::time::Instant::now() < until, "the stepping threads do not sleep");
    }
}

#[tokio::test]
async fn sessions_and_streams_have_a_limit() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("palpate.toml");
    std::fs::write(&config, "threads = 1\n[limits]\nsessions = 2\nstreams_per_session = 1\n").unwrap();
    let server = TestServer::start(&["--config", config.to_str().unwrap()]);
    let session = server.paper(true).await;
    server.paper(true).await;
    let status = server.create(Source::SceneName("paper".into()), true).await.unwrap_err();
    assert_eq!(told(&status), (Code::ResourceExhausted, "TOO_MANY".into(), String::new()));
    let touch = TestTouch::hold(&server, &session).await;
    let refused = TestTouch::open(&server, open(&session, &[1])).await.err().unwrap();
    assert_eq!(told(&refused).1, "TOO_MANY");
    // Room again when a stream has ended.
    drop(touch);
    let until = std::time::Instant::now() + TEST_TIMEOUT;
    while TestTouch::open(&server, open(&session, &[1])).await.is_err() {
        assert!(std::time::Instant::now() < until);
        tokio::time::sleep(std::time::Duration::from_millis(10)).await;
    }
}

#[tokio::test]
async fn a_session_that_nobody_uses_is_deleted_and_one_in_use_stays() {
    let server = TestServer::start(&[]);
    let make = |idle_timeout_s: f64| pb::CreateSessionRequest {
        source: Some(Source::SceneName("paper".into())),
        idle_timeout_s: Some(idle_timeout_s),
        ..Default::default()
    };
    let mut sessions = server.sessions().await;
    for wrong in [0.0, -1.0, f64::NAN, 1e9] {
        assert_eq!(told(&sessions.create_session(make(wrong)).await.unwrap_err()).2, "idle_timeout_s");
    }
    let unused = sessions.create_session(make(0.2)).await.unwrap().into_inner().session.unwrap();
    let used = sessions.create_session(make(0.2)).await.unwrap().into_inner().session.unwrap();
    let mut touch = TestTouch::hold(&server, &used.session_id).await;
    let until = std::time::Instant::now() + TEST_TIMEOUT;
    loop {
        let listed = sessions.list_sessions(pb::ListSessionsRequest {}).await.unwrap().into_inner().sessions;
        assert!(listed.iter().any(|session| session.session_id == used.session_id));
        if !listed.iter().any(|session| session.session_id == unused.session_id) {
            break;
        }
        assert!(std::time::Instant::now() < until);
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    touch.sample().await;
}

#[tokio::test]
async fn a_session_beyond_the_limits_of_the_server_is_refused() {
    let server = TestServer::start(&[]);
    let mut scene = paper();
    let sheet = scene.sheet.as_mut().unwrap();
    (sheet.points_x, sheet.points_y) = (Some(1000), Some(1000));
    scene.stepping.as_mut().unwrap().substeps = Some(1000);
    let status = server.create(Source::Scene(scene), true).await.unwrap_err();
    assert_eq!(told(&status), (Code::ResourceExhausted, "TOO_LARGE".into(), "stepping.substeps".into()));
    let mut scene = paper();
    scene.name = "two\nlines".into();
    let status = server.create(Source::Scene(scene), true).await.unwrap_err();
    assert_eq!(told(&status), (Code::InvalidArgument, "OUT_OF_RANGE".into(), "name".into()));
}

#[tokio::test]
async fn health_is_served() {
    let server = TestServer::start(&[]);
    let mut health = tonic_health::pb::health_client::HealthClient::new(server.channel().await);
    for service in ["", "palpate.v1.SessionService", "palpate.v1.HapticService", "palpate.v1.ViewService"] {
        let request = tonic_health::pb::HealthCheckRequest { service: service.into() };
        assert_eq!(health.check(request).await.unwrap().into_inner().status, 1, "{service}");
    }
}

#[cfg(unix)]
#[tokio::test]
async fn shutdown_tells_open_streams_and_ends_before_the_deadline() {
    // The deadline is longer than any wait of this test.
    let mut server = TestServer::start(&["--shutdown-deadline-s", "3600"]);
    let session = server.paper(false).await;
    let mut touch = TestTouch::hold(&server, &session).await;
    touch.command(force(0, 1, -1.0)).await;
    touch.sample_with(|sample| sample.tools[0].acknowledged_sequence == 1).await;
    let killed = Command::new("kill").arg(server.child.id().to_string()).status().unwrap();
    assert!(killed.success());
    let ended = loop {
        if let Err(status) = touch.hear().await {
            break status;
        }
    };
    assert_eq!(told(&ended), (Code::Unavailable, "SHUTTING_DOWN".into(), String::new()));
    drop(touch);
    let waited = async {
        loop {
            if let Some(status) = server.child.try_wait().unwrap() {
                return status;
            }
            tokio::time::sleep(std::time::Duration::from_millis(10)).await;
        }
    };
    assert!(tokio::time::timeout(TEST_TIMEOUT, waited).await.expect("it does not end").success());
}

#[cfg(unix)]
#[tokio::test]
async fn a_stream_that_will_not_end_is_cut_at_the_deadline() {
    let mut server = TestServer::start(&["--shutdown-deadline-s", "0.3"]);
    let session = server.paper(true).await;
    // A connection that holds a stream open and reads nothing of it.
    let request = pb::WatchFramesRequest {
        session_id: session,
        refinement: 10,
        rate_hz: Some(1000.0),
        always_full: true,
        ..Default::default()
    };
    let stalled = server.views().await.watch_frames(request).await.unwrap();
    Command::new("kill").arg(server.child.id().to_string()).status().unwrap();
    let waited = tokio::task::spawn_blocking(move || server.child.wait().unwrap());
    let status = tokio::time::timeout(TEST_TIMEOUT, waited).await.unwrap().unwrap();
    assert!(status.success());
    drop(stalled);
}

#[tokio::test]
async fn a_port_in_use_is_told() {
    let server = TestServer::start(&[]);
    let address = server.url.strip_prefix("http://").unwrap();
    let second = palpate(&["serve", "--listen", address]);
    let message = String::from_utf8_lossy(&second.stderr).into_owned();
    assert_eq!(second.status.code(), Some(1), "{message}");
    assert!(message.contains(address) && message.contains("in use") && message.contains("--listen"), "{message}");
    server.paper(false).await;
}

#[test]
fn the_example_of_a_configuration_has_every_key_with_its_default() {
    use palpate::server::config::Config;
    let root = repository();
    let example = Config::load(&root.join("docs/palpate.toml")).unwrap();
    assert_eq!(format!("{example:#?}"), format!("{:#?}", Config::default()));
    let text = std::fs::read_to_string(root.join("docs/palpate.toml")).unwrap();
    for key in format!("{example:#?}").lines().filter_map(|line| line.trim().split_once(": ").map(|field| field.0)) {
        let has = |line: &str| line.starts_with(&format!("{key} = ")) || line.starts_with(&format!("[{key}]"));
        // Keys without a default are shown in a comment.
        assert!(text.lines().any(|line| has(line.trim_start_matches("# "))), "docs/palpate.toml lacks {key}");
    }
}

#[test]
fn bad_configuration_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("palpate.toml");
    let path = config.to_str().unwrap();
    for (text, expected) in [
        ("listen = \"nowhere\"\n", "listen: must be address:port"),
        ("listen = 7\n", "palpate.toml:1"),
        ("shutdown_deadline_s = 1e300\n", "shutdown_deadline_s"),
        ("lease_s = 1000.0\n", "lease_s"),
        ("threads = 1\nthraeds = 2\n", "palpate.toml:2"),
        ("[limits]\npoint_force_n = -1.0\n", "limits.point_force_n"),
        ("[limits]\nthread_share = 0.0\n", "limits.thread_share"),
        ("[limits]\nopen_s = -1.0\n", "limits.open_s"),
        ("lease_s = nan\n", "lease_s"),
        ("threads = [", "palpate.toml:1"),
    ] {
        std::fs::write(&config, text).unwrap();
        let output = palpate(&["serve", "--config", path]);
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(message.contains(expected), "{message}");
    }
    for arguments in [
        &["serve", "--config", "no-such-file.toml"][..],
        &["serve", "--scenes", "no-such-folder"],
        &["serve", "--listen", "nonsense"],
        &["serve", "--log", "=,="],
        &["serve", "--shutdown-deadline-s", "NaN"],
    ] {
        let output = palpate(arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    }
}

#[cfg(unix)]
#[tokio::test]
async fn who_watches_the_health_is_told_first_and_not_waited_for() {
    use tonic_health::ServingStatus::{NotServing, Serving};
    use tonic_health::pb::HealthCheckRequest;
    use tonic_health::pb::health_client::HealthClient;
    // A deadline that the test would not outlive.
    let mut server = TestServer::start(&["--shutdown-deadline-s", "3600"]);
    let mut health = HealthClient::new(server.channel().await);
    let mut watching = health.watch(HealthCheckRequest::default()).await.unwrap().into_inner();
    assert_eq!(watching.message().await.unwrap().unwrap().status, Serving as i32);
    assert!(Command::new("kill").arg(server.child.id().to_string()).status().unwrap().success());
    assert_eq!(watching.message().await.unwrap().unwrap().status, NotServing as i32);
    assert!(watching.message().await.unwrap().is_none());
    let ended = tokio::task::spawn_blocking(move || server.child.wait().unwrap());
    assert!(tokio::time::timeout(TEST_TIMEOUT, ended).await.unwrap().unwrap().success());
}

#[cfg(unix)]
#[tokio::test]
async fn who_watches_the_health_and_does_not_read_holds_up_no_shutdown() {
    use tonic_health::pb::HealthCheckRequest;
    use tonic_health::pb::health_client::HealthClient;
    let mut server = TestServer::start(&["--shutdown-deadline-s", "3600"]);
    // Not a byte of an answer may be sent.
    let endpoint = tonic::transport::Channel::from_shared(server.url.clone()).unwrap().initial_stream_window_size(0);
    let mut health = HealthClient::new(endpoint.connect().await.unwrap());
    let _watching = health.watch(HealthCheckRequest::default()).await.unwrap();
    assert!(Command::new("kill").arg(server.child.id().to_string()).status().unwrap().success());
    let ended = tokio::task::spawn_blocking(move || server.child.wait().unwrap());
    assert!(tokio::time::timeout(TEST_TIMEOUT, ended).await.unwrap().unwrap().success());
}

/// Springs far too stiff for the substeps that the scene gives: no error can be expected.
#[tokio::test]
async fn an_expected_error_is_always_finite() {
    // Where a number of substeps is given, no rehearsal is needed; without one nothing is known.
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("palpate.toml");
    std::fs::write(&config, "[limits]\nrehearsal_work = 1\n").unwrap();
    let server = TestServer::start(&["--config", config.to_str().unwrap()]);
    let mut unknown = paper();
    unknown.springs.as_mut().unwrap().stiffness_n_per_m = Some(1e9);
    unknown.springs.as_mut().unwrap().shear_stiffness_n_per_m = None;
    unknown.stepping.as_mut().unwrap().substeps = Some(1);
    let created = server.create(Source::Scene(unknown), true).await.unwrap();
    let session_id = created.session_id.clone();
    let mut sessions = server.sessions().await;
    let request = pb::GetSessionRequest { session_id: session_id.clone() };
    let got = sessions.get_session(request).await.unwrap().into_inner().session.unwrap();
    let listed = sessions.list_sessions(pb::ListSessionsRequest {}).await.unwrap().into_inner().sessions.remove(0);
    let stiffer = pb::UpdateTissueRequest { session_id, stiffness_n_per_m: Some(2e9), ..Default::default() };
    let updated = sessions.update_tissue(stiffer).await.unwrap().into_inner().session.unwrap();
    for session in [&created, &got, &listed, &updated] {
        assert_eq!(session.expected_error, 1.0);
        assert!(
            !session.warnings.is_empty() && session.warnings.iter().all(|text| !text.contains("inf")),
            "{session:?}"
        );
    }
    // Of a scene whose tolerance is kept it is what is expected.
    let server = TestServer::start(&[]);
    let known = server.create(Source::SceneName("paper".into()), true).await.unwrap();
    assert!(known.expected_error > 0.0 && known.expected_error < 1e-2, "{}", known.expected_error);
}

#[tokio::test]
async fn a_session_tells_where_its_tissue_rests() {
    let server = TestServer::start(&[]);
    let session = server.create(Source::SceneName("liver".into()), false).await.unwrap();
    let extent = session.extent.unwrap();
    let place = |place: Option<pb::Vector3>| place.map(|place| [place.x, place.y, place.z]);
    assert_eq!(place(extent.least_m), Some([0.0, 0.0, 0.0]));
    assert_eq!(place(extent.most_m), Some([0.075, 0.075, 0.0]));
    assert_eq!(place(extent.middle_m), Some([0.0375, 0.0375, 0.0]));
}
