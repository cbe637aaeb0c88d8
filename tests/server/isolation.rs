//! Nobody suffers from another: slow, silent, flooding and greedy clients, and sessions that are too heavy.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use crate::common::server::{self, TEST_TIMEOUT, TestServer, TestTouch, force, told};
use palpate_proto::pb;
use pb::create_session_request::Source;
use pb::haptic_service_client::HapticServiceClient;
use pb::touch_response::Message as Heard;
use tonic::Code;

/// A server with these keys of `[limits]`.
fn limited(limits: &str, arguments: &[&str]) -> TestServer {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("palpate.toml");
    std::fs::write(&config, format!("[limits]\n{limits}\n")).unwrap();
    TestServer::start(&[&["--config", config.to_str().unwrap()], arguments].concat())
}

/// A server as a shell starts it: $0 is the program, $1 where it is to listen.
#[cfg(unix)]
fn serve(command: &str, address: &str) -> TestServer {
    TestServer::by_script(&format!("{command} \"$1\""), &[address.as_ref()])
}

fn connect(server: &TestServer) -> TcpStream {
    let socket = TcpStream::connect(server.url.strip_prefix("http://").unwrap()).unwrap();
    socket.set_read_timeout(Some(TEST_TIMEOUT)).unwrap();
    socket
}

/// The server has closed it.
fn is_closed(mut socket: TcpStream) -> bool {
    let mut buffer = [0; 1024];
    loop {
        match socket.read(&mut buffer) {
            Ok(0) => return true,
            Ok(_) => {}
            Err(error) => return error.kind() == std::io::ErrorKind::ConnectionReset,
        }
    }
}

/// Sends this many commands; each is accepted and acts.
async fn all_act(server: &TestServer, session: &str, count: u64) {
    let mut touch = TestTouch::hold(server, session).await;
    for sequence in 1..=count {
        touch.command(force(0, sequence, -1.0 - 0.001 * sequence as f64)).await;
        touch.sample_with(|sample| sample.tools[0].acknowledged_sequence == sequence).await;
    }
    let commands = server.status(session).await.commands.unwrap();
    assert_eq!((commands.accepted, commands.applied, commands.refused), (count, count, 0));
}

fn handles(server: &TestServer) -> usize {
    std::fs::read_dir(format!("/proc/{}/fd", server.child.id())).map_or(0, Iterator::count)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_thousand_connections_that_say_nothing_disturb_nobody_and_are_closed() {
    let server = limited("handshake_s = 2.0", &["--log", "error"]);
    let session = server.paper(false).await;
    let before = handles(&server);
    let mut silent: Vec<TcpStream> = (0..1000).map(|_| connect(&server)).collect();
    // Some say half of what they should.
    for socket in silent.iter_mut().step_by(3) {
        socket.write_all(b"PRI * HTTP/2").unwrap();
    }
    all_act(&server, &session, 50).await;
    tokio::task::spawn_blocking(move || assert!(silent.into_iter().all(is_closed))).await.unwrap();
    // Only what the test itself has open still.
    let waited = tokio::time::timeout(TEST_TIMEOUT, async {
        while handles(&server) > before + 8 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    });
    waited.await.expect("the server keeps what it has closed");
}

#[tokio::test]
async fn connections_above_the_limit_are_closed_and_let_in_later() {
    let server = limited("connections = 4\nhandshake_s = 600.0", &["--log", "error"]);
    let held: Vec<TcpStream> = (0..4).map(|_| connect(&server)).collect();
    let fifth = connect(&server);
    assert!(tokio::task::spawn_blocking(move || is_closed(fifth)).await.unwrap());
    drop(held);
    let waited = tokio::time::timeout(TEST_TIMEOUT, async {
        loop {
            let endpoint = tonic::transport::Channel::from_shared(server.url.clone()).unwrap();
            if let Ok(channel) = endpoint.connect().await {
                let mut sessions = pb::session_service_client::SessionServiceClient::new(channel);
                if sessions.list_scenes(pb::ListScenesRequest {}).await.is_ok() {
                    break;
                }
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    });
    waited.await.expect("no new client was admitted");
}

#[cfg(unix)]
#[tokio::test]
async fn a_server_without_file_descriptors_waits_for_some() {
    let server = serve("ulimit -n 64 && exec \"$0\" serve --log error --listen", "127.0.0.1:0");
    let session = server.paper(false).await;
    let mut touch = TestTouch::hold(&server, &session).await;
    let held: Vec<TcpStream> = (0..100).map(|_| connect(&server)).collect();
    // Clients that are connected are still served.
    for sequence in 1..=50 {
        touch.command(force(0, sequence, -1.0)).await;
        touch.sample_with(|sample| sample.tools[0].acknowledged_sequence == sequence).await;
    }
    drop(held);
    assert_eq!(
        tokio::time::timeout(TEST_TIMEOUT, server.status(&session)).await.unwrap().commands.unwrap().applied,
        50
    );
}

#[tokio::test]
async fn a_stream_that_never_opens_is_ended() {
    let server = limited("open_s = 0.2", &[]);
    let silent = tokio_stream::pending::<pb::TouchRequest>();
    let mut inbound = server.haptics().await.touch(silent).await.unwrap().into_inner();
    let ended = tokio::time::timeout(TEST_TIMEOUT, inbound.message()).await.unwrap().unwrap_err();
    assert_eq!(told(&ended), (Code::DeadlineExceeded, "TIMED_OUT".into(), "open".into()));
}

#[tokio::test]
async fn a_call_whose_message_does_not_come_is_ended() {
    let server = limited("open_s = 0.2", &[]);
    // A stream that is half open: the head of a call, and no message.
    let channel = server.channel().await;
    for path in ["/palpate.v1.SessionService/ListScenes", "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo"] {
        let mut grpc = tonic::client::Grpc::new(channel.clone());
        grpc.ready().await.unwrap();
        let codec = tonic_prost::ProstCodec::<(), ()>::default();
        let silent = tonic::Request::new(tokio_stream::pending());
        let ended = tokio::time::timeout(TEST_TIMEOUT, async {
            let mut answer = grpc.streaming(silent, path.parse().unwrap(), codec).await?.into_inner();
            answer.message().await
        });
        match ended.await.unwrap() {
            // Reflection ends without a word.
            Ok(message) => assert!(message.is_none() && path.starts_with("/grpc.reflection."), "{path}"),
            Err(status) => {
                assert_eq!(told(&status), (Code::DeadlineExceeded, "TIMED_OUT".into(), "request".into()), "{path}");
            }
        }
    }
    // A browser's call that contains its length and nothing else.
    let mut socket = connect(&server);
    let head = "POST /palpate.v1.SessionService/ListScenes HTTP/1.1\r\nHost: localhost\r\n\
                Content-Type: application/grpc-web+proto\r\nContent-Length: 5\r\n\r\n";
    socket.write_all(head.as_bytes()).unwrap();
    assert!(tokio::task::spawn_blocking(|| is_closed(socket)).await.unwrap());
}

#[tokio::test]
async fn what_is_no_message_and_no_call_is_refused_in_words() {
    let server = TestServer::start(&["--log", "error"]);
    // A field of a length that is not there.
    let mut head = "POST /palpate.v1.SessionService/GetSession HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\
                    Content-Type: application/grpc-web+proto\r\nContent-Length: 7\r\n\r\n"
        .as_bytes()
        .to_vec();
    head.extend([0, 0, 0, 0, 2, 0x0a, 0x7f]);
    let ask = |said: &[u8]| {
        let mut socket = connect(&server);
        socket.write_all(said).unwrap();
        let mut answer = Vec::new();
        socket.read_to_end(&mut answer).unwrap();
        String::from_utf8_lossy(&answer).to_lowercase()
    };
    let answer = ask(&head);
    assert!(answer.contains("grpc-status: 3") || answer.contains("grpc-status:3"), "{answer}");
    assert!(answer.contains("grpc-status-details-bin"), "{answer}");
    let path = "/palpate.v1.SessionService/GetSession HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n";
    let answer = ask(format!("POST {path}Content-Type: application/json\r\nContent-Length: 2\r\n\r\n{{}}").as_bytes());
    assert!(answer.starts_with("http/1.1 415") && answer.contains("application/grpc-web"), "{answer}");
    let answer = ask(format!("GET {path}\r\n").as_bytes());
    assert!(answer.starts_with("http/1.1 405") && answer.contains("post"), "{answer}");
}

#[cfg(unix)]
#[tokio::test]
async fn connections_that_show_no_token_leave_room_for_who_does() {
    let folder = tempfile::tempdir().unwrap();
    let tokens = folder.path().join("tokens.toml");
    let file = tokens.to_str().unwrap();
    let made = server::palpate(&["token", "--name", "a", "--role", "create,touch", "--tokens", file]);
    let token = format!("Bearer {}", String::from_utf8(made.stdout).unwrap().trim());
    let server = limited("connections = 8\nhandshake_s = 600.0", &["--log", "error", "--tokens", file]);
    let list = async |channel: tonic::transport::Channel| {
        let mut request = tonic::Request::new(pb::ListScenesRequest {});
        request.metadata_mut().insert("authorization", token.parse().unwrap());
        let mut sessions = pb::session_service_client::SessionServiceClient::new(channel);
        tokio::time::timeout(TEST_TIMEOUT, sessions.list_scenes(request)).await.unwrap()
    };
    let known = server.channel().await;
    list(known.clone()).await.unwrap();
    let silent: Vec<TcpStream> = (0..100).map(|_| connect(&server)).collect();
    // Known clients stay, and new ones are admitted.
    list(known).await.unwrap();
    list(server.channel().await).await.unwrap();
    let closed = tokio::task::spawn_blocking(move || {
        let mut closed = 0;
        for socket in silent {
            socket.set_read_timeout(Some(Duration::from_millis(20))).unwrap();
            closed += usize::from(is_closed(socket));
        }
        closed
    });
    assert!(closed.await.unwrap() >= 92);
}

#[cfg(unix)]
#[tokio::test]
async fn a_server_raises_its_limit_of_descriptors() {
    let server = serve("ulimit -Sn 40 && exec \"$0\" serve --log error --listen", "127.0.0.1:0");
    let session = server.paper(false).await;
    let held: Vec<TcpStream> = (0..100).map(|_| connect(&server)).collect();
    // All of them are there, and more.
    all_act(&server, &session, 3).await;
    assert!(handles(&server) > 100);
    drop(held);
}

#[tokio::test]
async fn a_message_that_is_too_large_is_refused_and_the_connection_goes_on() {
    let server = limited("message_bytes = 10000", &[]);
    let session = server.paper(true).await;
    let mut haptics = HapticServiceClient::new(server.channel().await);
    let points = (0..10_000).map(|_| pb::GridPoint { x: 1, y: 1 }).collect();
    let probe = |points| pb::ProbeRequest {
        session_id: session.clone(),
        r#where: Some(pb::probe_request::Where::Points(pb::GridPoints { points })),
        ..Default::default()
    };
    let refused = haptics.probe(probe(points)).await.unwrap_err();
    assert_eq!(refused.code(), Code::OutOfRange, "{refused:?}");
    haptics.probe(probe(vec![pb::GridPoint { x: 1, y: 1 }])).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_flood_is_refused_with_a_reason_accounted_for_and_no_harm_to_others() {
    let server = limited("queued_commands_per_tool = 500", &["--log", "error"]);
    let (flooded, other) = (server.paper(false).await, server.paper(false).await);
    let flood = TestTouch::hold(&server, &flooded).await;
    let flooding = tokio::spawn(async move {
        let mut flood = flood;
        let (mut sent, mut rejected) = (0, 0);
        // Far more than a hundred times what a session steps, until that is the end of the stream.
        loop {
            for _ in 0..1000 {
                if !flood.try_command(force(0, sent + 1, -1.0)).await {
                    break;
                }
                sent += 1;
            }
            while let Ok(heard) = tokio::time::timeout(Duration::ZERO, flood.hear()).await {
                match heard {
                    Ok(Some(Heard::Rejection(rejection))) => {
                        let known = ["RATE_LIMITED", "QUEUE_FULL"].contains(&rejection.reason.as_str());
                        assert!(known, "{rejection:?}");
                        rejected += u64::from(rejection.reason == "RATE_LIMITED");
                    }
                    Ok(_) => {}
                    Err(status) => return (told(&status), sent, rejected),
                }
            }
        }
    });
    all_act(&server, &other, 200).await;
    let (ended, sent, rejected) = tokio::time::timeout(TEST_TIMEOUT, flooding).await.unwrap().unwrap();
    assert_eq!((ended.0, ended.1.as_str()), (Code::ResourceExhausted, "RATE_LIMITED"));
    assert!(rejected > 0);
    let status = server.status(&flooded).await;
    assert!(status.held_tools.is_empty(), "{status:?}");
    let commands = status.commands.unwrap();
    assert!(commands.refused > 0 && commands.waiting <= 500, "{commands:?}");
    assert!(commands.accepted + commands.refused <= sent, "{commands:?} of {sent}");
    assert_eq!(
        commands.accepted,
        commands.applied + commands.superseded + commands.dropped + commands.waiting,
        "{commands:?}"
    );
}

#[tokio::test]
async fn sessions_made_without_end_are_refused_to_who_makes_them_alone() {
    let server = limited("sessions_per_minute = 5.0", &[]);
    let mut greedy = server.sessions().await;
    let source = || Some(Source::SceneName("paper".into()));
    let request = || pb::CreateSessionRequest { source: source(), ..Default::default() };
    let mut made = 0;
    let refused = loop {
        match greedy.create_session(request()).await {
            Ok(created) => {
                let session_id = created.into_inner().session.unwrap().session_id;
                greedy.delete_session(pb::DeleteSessionRequest { session_id }).await.unwrap();
                made += 1;
            }
            Err(status) => break status,
        }
        assert!(made < 1000, "no end");
    };
    assert!(made >= 5);
    assert_eq!(told(&refused), (Code::ResourceExhausted, "RATE_LIMITED".into(), String::new()));
    // Over a connection of its own.
    server.paper(false).await;
}

#[tokio::test]
async fn calls_without_end_are_refused_to_who_makes_them_alone() {
    let server = limited("calls_per_s = 20.0", &[]);
    let mut greedy = server.sessions().await;
    // Together: a refusal contains when the next call would be admitted, and the bucket fills meanwhile.
    let calls = (0..200).map(|_| {
        let mut sessions = greedy.clone();
        async move { sessions.list_scenes(pb::ListScenesRequest {}).await }
    });
    let answers = futures_util::future::join_all(calls).await;
    let refused: Vec<_> = answers.iter().filter_map(|answer| answer.as_ref().err()).collect();
    assert!(answers.len() - refused.len() >= 20, "{} of {} were refused", refused.len(), answers.len());
    assert!(!refused.is_empty());
    for status in refused {
        assert_eq!(told(status), (Code::ResourceExhausted, "RATE_LIMITED".into(), String::new()));
    }
    // Over a connection of its own.
    server.paper(false).await;
    // A caller within its limits is served again after the time that the refusal contained.
    while let Err(status) = greedy.list_scenes(pb::ListScenesRequest {}).await {
        assert_eq!(told(&status).1, "RATE_LIMITED");
    }
}

#[tokio::test]
async fn who_does_not_read_loses_samples_and_delays_nobody() {
    let server = limited("queued_samples = 8", &["--log", "error"]);
    let session = server.paper(false).await;
    // Its transport buffers little unread data.
    let endpoint = tonic::transport::Channel::from_shared(server.url.clone()).unwrap();
    let channel = endpoint.initial_stream_window_size(16_384).connect().await.unwrap();
    let request = pb::WatchSamplesRequest { session_id: session.clone(), ..Default::default() };
    let mut stalled = HapticServiceClient::new(channel).watch_samples(request).await.unwrap().into_inner();
    all_act(&server, &session, 1000).await;
    let mut last = 0;
    loop {
        let sample =
            tokio::time::timeout(TEST_TIMEOUT, stalled.message()).await.unwrap().unwrap().unwrap().sample.unwrap();
        assert!(sample.step > last);
        last = sample.step;
        if sample.dropped_samples > 0 {
            break;
        }
    }
}

/// A sheet of so many points, 10,000 times a second.
fn frequent(points_x: u32, points_y: u32) -> Source {
    let limits = palpate_tissue::limits::Limits::default();
    let paper = palpate_tissue::scene::Scene::parse("paper", palpate_tissue::scene::PAPER, &[], &limits).unwrap();
    let mut scene = palpate_session::wire::scene::scene(&paper);
    let sheet = scene.sheet.as_mut().unwrap();
    (sheet.points_x, sheet.points_y) = (Some(points_x), Some(points_y));
    scene.stepping.as_mut().unwrap().rate_hz = Some(10_000.0);
    Source::Scene(scene)
}

/// Returns one force everywhere, so that all of a tissue moves.
fn everywhere(sequence: u64) -> pb::Command {
    let mut command = force(0, sequence, -1.0);
    let Some(pb::command::Action::Force(force)) = &mut command.action else { unreachable!() };
    force.falloff_per_m = Some(0.0);
    command
}

#[tokio::test]
async fn heavy_sessions_slow_themselves_and_let_no_further_one_in() {
    let server = limited("periods_per_step = 20.0", &["--threads", "1"]);
    // More work than any machine can do on one core, while all of them move.
    let mut heavy = Vec::new();
    for _ in 0..12 {
        heavy.push(server.create(frequent(200, 100), false).await.unwrap().session_id);
    }
    // At rest they use nothing: others are admitted.
    let light = server.paper(false).await;
    let mut quick = TestTouch::hold(&server, &light).await;
    let mut slow = Vec::new();
    for session in &heavy {
        let hold = TestTouch::hold(&server, session).await;
        hold.command(everywhere(1)).await;
        slow.push(hold);
    }
    for sequence in 1..=500 {
        quick.command(force(0, sequence, -1.0 - 0.001 * sequence as f64)).await;
        quick.sample_with(|sample| sample.tools[0].acknowledged_sequence == sequence).await;
    }
    // Steps of the heavy ones were dropped, commands of the light one were not. `realtime::thread` sets the
    // priorities.
    let (heavy_now, light_now) = (server.status(&heavy[0]).await, server.status(&light).await);
    assert!(heavy_now.overrun_count > 0, "{heavy_now:?}");
    let commands = light_now.commands.unwrap();
    assert_eq!((commands.applied, commands.superseded, commands.dropped), (500, 0, 0), "{commands:?}");
    // The thread is full, and says so; a session that stands takes nothing until it is started.
    let refused = server.create(Source::SceneName("paper".into()), false).await.unwrap_err();
    assert_eq!(told(&refused), (Code::ResourceExhausted, "OVERLOADED".into(), String::new()));
    let standing = server.paper(true).await;
    let start = || pb::StartSessionRequest { session_id: standing.clone(), until_step: None };
    let refused = server.sessions().await.start_session(start()).await.unwrap_err();
    assert_eq!(told(&refused).1, "OVERLOADED");
    for session_id in heavy {
        server.sessions().await.delete_session(pb::DeleteSessionRequest { session_id }).await.unwrap();
    }
    server.paper(false).await;
    server.sessions().await.start_session(start()).await.unwrap();
}

#[tokio::test]
async fn a_session_whose_steps_are_too_long_for_others_leaves_the_thread_to_them() {
    let server = limited("periods_per_step = 200.0", &["--threads", "1"]);
    // Steps of some milliseconds on any machine.
    let heavy = server.create(frequent(2000, 500), false).await.unwrap().session_id;
    let light = server.paper(false).await;
    let (slow, mut quick) = (TestTouch::hold(&server, &heavy).await, TestTouch::hold(&server, &light).await);
    slow.command(everywhere(1)).await;
    for sequence in 1..=200 {
        quick.command(force(0, sequence, -1.0 - 0.001 * sequence as f64)).await;
        quick.sample_with(|sample| sample.tools[0].acknowledged_sequence == sequence).await;
    }
    // Only it is late: another session is admitted, after some of its steps.
    while server.status(&heavy).await.overrun_count == 0
        || server.create(Source::SceneName("paper".into()), false).await.is_err()
    {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let commands = server.status(&light).await.commands.unwrap();
    assert_eq!((commands.applied, commands.superseded, commands.dropped), (200, 0, 0), "{commands:?}");
}

#[cfg(unix)]
#[tokio::test(flavor = "multi_thread")]
async fn a_bridge_comes_back_to_a_server_that_was_killed() {
    let mut server = TestServer::start(&[]);
    let address = server.url.strip_prefix("http://").unwrap().to_owned();
    let mut bridge = std::process::Command::new(server::client_program())
        .args(["bridge", "--server", &server.url, "--scene", "liver"])
        .stdout(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    server.until_applied("liver", 100).await;
    server.child.kill().unwrap();
    server.child.wait().unwrap();
    let again = serve("exec \"$0\" serve --log error --listen", &address);
    again.until_applied("liver", 100).await;
    bridge.kill().unwrap();
    bridge.wait().unwrap();
    // Its tools are let go, whatever it did.
    again.until_let_go().await;
}

#[cfg(unix)]
#[tokio::test]
async fn a_second_signal_ends_the_server_at_once() {
    let mut server = TestServer::start(&["--shutdown-deadline-s", "3600"]);
    let session = server.paper(false).await;
    // Nothing of it is read: it would not end before the deadline.
    let request = pb::WatchFramesRequest {
        session_id: session.clone(),
        refinement: 10,
        rate_hz: Some(1000.0),
        always_full: true,
        ..Default::default()
    };
    let _stalled = server.views().await.watch_frames(request).await.unwrap();
    let mut touch = TestTouch::hold(&server, &session).await;
    touch.command(force(0, 1, -1.0)).await;
    touch.sample_with(|sample| sample.step >= 300).await;
    let id = server.child.id().to_string();
    let signal = || assert!(std::process::Command::new("kill").arg(&id).status().unwrap().success());
    let ended = tokio::time::timeout(TEST_TIMEOUT, async {
        loop {
            signal();
            tokio::time::sleep(Duration::from_millis(100)).await;
            if let Some(status) = server.child.try_wait().unwrap() {
                return status;
            }
        }
    });
    assert_eq!(ended.await.unwrap().code(), Some(130));
}
