//! Either side may stand still for seconds while the other talks on: connection and stream outlive that, no command is
//! lost without a word, and no old one moves a tool.
#![cfg(unix)]

use std::collections::HashMap;
use std::io::{BufRead, Read, Write};
use std::time::{Duration, Instant};

use crate::common::proxy::Proxy;
use crate::common::server::{self, TEST_TIMEOUT, TestServer, open};
use glam::DVec3;
use palpate_haptics::{Device, Tip};
use palpate_proto::{pb, touch};
use palpate_session::wire;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::Scene;
use pb::create_session_request::Source;
use pb::haptic_service_client::HapticServiceClient;
use pb::touch_request::Message as Say;
use pb::touch_response::Message as Heard;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Streaming;
use tonic::transport::Channel;

/// A pose of a tool, by the client's time.
fn pose(tool: u32, sequence: u64, place_m: DVec3, client_time_ns: u64) -> pb::Command {
    let action = Some(pb::command::Action::Pose(touch::pose(place_m, &Tip::default())));
    pb::Command { tool, sequence: Some(sequence), client_time_ns, action, ..Default::default() }
}

/// As long as either side stands still, s.
const STALL: Duration = Duration::from_secs(5);

/// Returns a scene that an unoptimized server steps in time.
fn small() -> Source {
    let text = "name = \"small\"\n[sheet]\npoints = [9, 9]\nspacing_m = 0.01\npoint_mass_kg = 0.002\n\
                [springs]\nstiffness_n_per_m = 30.0\n[anchor_springs]\nstiffness_n_per_m = 5.0\n\
                [damping]\ncoefficient_n_s_per_m = 0.2\n\
                [stepping]\nintegrator = \"central\"\nsubsteps = 4\nprecision = \"f32\"\n";
    Source::Scene(wire::scene::scene(&Scene::parse("small", text, &[], &Limits::default()).unwrap()))
}

fn signal(server: &TestServer, name: &str) {
    let pid = server.child.id().to_string();
    assert!(std::process::Command::new("kill").args([name, &pid]).status().unwrap().success());
}

/// A haptic stream of several tools that are led at 1 kHz each.
struct Led {
    outbound: mpsc::Sender<pb::TouchRequest>,
    inbound: Streaming<pb::TouchResponse>,
    tools: u32,
    sequence: u64,
    begun: Instant,
}

impl Led {
    async fn open(channel: Channel, session: &str, tools: u32, lease_s: f64) -> Self {
        let (outbound, messages) = mpsc::channel(1 << 20);
        let tool_numbers: Vec<_> = (0..tools).collect();
        let open = pb::TouchOpen { lease_s: Some(lease_s), ..open(session, &tool_numbers) };
        outbound.send(pb::TouchRequest { message: Some(Say::Open(open)) }).await.unwrap();
        let mut inbound =
            HapticServiceClient::new(channel).touch(ReceiverStream::new(messages)).await.unwrap().into_inner();
        assert!(matches!(inbound.message().await.unwrap().unwrap().message, Some(Heard::Opened(_))));
        Led { outbound, inbound, tools, sequence: 0, begun: Instant::now() }
    }

    /// Tells every tool where it is, above the tissue.
    fn tick(&mut self) {
        self.sequence += 1;
        let time_ns = 1 + self.begun.elapsed().as_nanos() as u64;
        let place_m = DVec3::new(0.04, 0.04, 0.02 + 1e-6 * (self.sequence % 100) as f64);
        for tool in 0..self.tools {
            let command = pose(tool, self.sequence, place_m, time_ns);
            let message = pb::TouchRequest { message: Some(Say::Command(command)) };
            self.outbound.try_send(message).expect("the stream has ended");
        }
    }

    /// Sends a thousand times a second for this time, whatever arrives.
    async fn lead(&mut self, lasts: Duration) {
        let mut ticks = tokio::time::interval(Duration::from_millis(1));
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Burst);
        for _ in 0..lasts.as_millis() {
            ticks.tick().await;
            self.tick();
        }
    }

    /// Listens until a sample acknowledges all commands. Returns the numbers of refused commands by reason.
    async fn acknowledged(&mut self) -> HashMap<String, u64> {
        let mut refused = HashMap::new();
        loop {
            let heard = tokio::time::timeout(TEST_TIMEOUT, self.inbound.message()).await.expect("the server is silent");
            match heard.unwrap_or_else(|status| panic!("the stream was cut: {status:?}")).unwrap().message {
                Some(Heard::Rejection(rejection)) => *refused.entry(rejection.reason).or_default() += 1,
                Some(Heard::Sample(sample))
                    if sample.tools.iter().all(|tool| tool.acknowledged_sequence == self.sequence) =>
                {
                    return refused;
                }
                _ => {}
            }
        }
    }

    /// The reasons of all refusals up to the one of the newest command.
    async fn refused(&mut self) -> HashMap<String, u64> {
        let mut refused = HashMap::new();
        loop {
            let heard = tokio::time::timeout(TEST_TIMEOUT, self.inbound.message()).await.expect("the server is silent");
            if let Some(Heard::Rejection(rejection)) = heard.unwrap().unwrap().message {
                *refused.entry(rejection.reason).or_default() += 1;
                if rejection.sequence == self.sequence {
                    return refused;
                }
            }
        }
    }
}

/// Every command was taken in or refused.
async fn all_are_told(server: &TestServer, session: &str, led: &Led) {
    let status = server.status(session).await;
    let commands = status.commands.unwrap();
    assert_eq!(commands.accepted + commands.refused, led.sequence * u64::from(led.tools), "{commands:?}");
    assert_eq!(
        commands.accepted,
        commands.applied + commands.superseded + commands.dropped + commands.waiting,
        "{commands:?}"
    );
}

/// The server stands still while `tools` are led.
async fn the_server_stands_still(url: String, server: &TestServer, tools: u32, stall: Duration) {
    let session = server.create(small(), false).await.unwrap().session_id;
    let channel = Channel::from_shared(url).unwrap().connect().await.unwrap();
    let mut led = Led::open(channel, &session, tools, 60.0).await;
    led.lead(Duration::from_millis(100)).await;
    led.acknowledged().await;
    signal(server, "-STOP");
    led.lead(stall).await;
    signal(server, "-CONT");
    led.lead(Duration::from_millis(100)).await;
    let refused = led.acknowledged().await;
    assert!(refused.is_empty(), "{refused:?}");
    all_are_told(server, &session, &led).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_tool_outlives_a_server_that_stands_still() {
    let server = TestServer::start(&["--log", "error"]);
    the_server_stands_still(server.url.clone(), &server, 1, STALL).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn sixteen_tools_outlive_a_server_that_stands_still() {
    let server = TestServer::start(&["--log", "error"]);
    the_server_stands_still(server.url.clone(), &server, 16, Duration::from_secs(1)).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_tool_far_away_outlives_a_server_that_stands_still() {
    let server = TestServer::start(&["--log", "error"]);
    let address = server.url.strip_prefix("http://").unwrap().to_owned();
    let proxy = Proxy::start(address, Duration::from_millis(25)).await;
    the_server_stands_still(proxy.url(), &server, 1, STALL).await;
}

/// A client in a thread of its own that stands still with all it has, its transport too; then it says on, as long as
/// `lease_s` lets it.
fn a_client_that_stands_still(url: String, session: String, lease_s: f64) -> std::thread::JoinHandle<()> {
    std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let channel = Channel::from_shared(url).unwrap().connect().await.unwrap();
            let mut led = Led::open(channel, &session, 1, lease_s).await;
            led.lead(Duration::from_millis(100)).await;
            led.acknowledged().await;
            std::thread::sleep(STALL);
            let refused_from = led.sequence;
            led.lead(Duration::from_millis(20)).await;
            if lease_s > STALL.as_secs_f64() {
                assert!(led.acknowledged().await.is_empty());
            } else {
                let refused = led.refused().await;
                assert_eq!(refused, HashMap::from([("NOT_HOLDER".to_owned(), led.sequence - refused_from)]));
            }
        });
    })
}

#[tokio::test(flavor = "multi_thread")]
async fn a_client_that_stands_still_keeps_its_stream_and_its_tool_lets_go() {
    let server = TestServer::start(&["--log", "error"]);
    let mut clients = Vec::new();
    for lease_s in [60.0, 2.0] {
        let session = server.create(small(), false).await.unwrap().session_id;
        let request = pb::WatchSamplesRequest { session_id: session.clone(), ..Default::default() };
        let mut watching = server.haptics().await.watch_samples(request).await.unwrap().into_inner();
        clients.push(a_client_that_stands_still(server.url.clone(), session, lease_s));
        // Held, then let go, in this order.
        for wanted in [(|tool| tool.stale && !tool.expired) as fn(&pb::ToolSample) -> bool, |tool| tool.expired] {
            let seen = tokio::time::timeout(TEST_TIMEOUT, async {
                loop {
                    let sample = watching.message().await.unwrap().unwrap().sample.unwrap();
                    if sample.tools.iter().any(wanted) {
                        return;
                    }
                }
            });
            seen.await.expect("the tool goes on");
        }
    }
    tokio::task::spawn_blocking(|| clients.into_iter().for_each(|client| client.join().unwrap())).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn commands_before_a_stream_is_open_are_taken_in_or_refused() {
    let server = TestServer::start(&["--log", "error"]);
    let session = server.create(small(), false).await.unwrap().session_id;
    let (outbound, messages) = mpsc::channel(1 << 20);
    let say = |message: Say| outbound.try_send(pb::TouchRequest { message: Some(message) }).unwrap();
    // With a device, so that a force law is computed first.
    let device = Device::named("omega3").unwrap();
    say(Say::Open(pb::TouchOpen { device: Some(touch::device(&device)), ..open(&session, &[0]) }));
    const COMMANDS: u64 = 20_000;
    for sequence in 1..=COMMANDS {
        say(Say::Command(pose(0, sequence, DVec3::new(0.04, 0.04, 0.02), 1000 * sequence)));
    }
    let channel = server.channel().await;
    let mut inbound =
        HapticServiceClient::new(channel).touch(ReceiverStream::new(messages)).await.unwrap().into_inner();
    let commands = tokio::time::timeout(TEST_TIMEOUT, async {
        loop {
            let ended = inbound.message().await.map(|message| message.expect("the stream is over")).err();
            let commands = server.status(&session).await.commands.unwrap();
            if let Some(status) = &ended {
                // Our own rule for who is far too fast, with a reason; not the transport's.
                assert_eq!(server::told(status).1, "RATE_LIMITED");
            }
            if ended.is_some() || commands.accepted + commands.refused == COMMANDS {
                return commands;
            }
        }
    });
    let Ok(commands) = commands.await else {
        panic!("the commands do not come: {:?}", server.status(&session).await.commands)
    };
    assert!(commands.accepted > 0, "{commands:?}");
}

/// A server that takes connections and says nothing.
#[test]
fn no_program_waits_for_who_says_nothing() {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let programs = [
        "replay vertical-60 --quiet --server",
        "load --sessions 1 --seconds 1 --server",
        "bridge --seconds 1 --server",
        "link --scene paper --seconds 1 --server",
        "admin callers --server",
        "top --once",
        "health",
    ];
    let client = server::client_program();
    let start = |program: &str| {
        let mut command = std::process::Command::new(&client);
        command.args(program.split(' ')).arg(&url).stderr(std::process::Stdio::piped()).spawn().unwrap()
    };
    let children: Vec<_> = programs.into_iter().map(|program| (program, start(program))).collect();
    for (program, child) in children {
        let ended = child.wait_with_output().unwrap();
        let said = String::from_utf8(ended.stderr).unwrap();
        assert_eq!(ended.status.code(), Some(1), "{program}: {said}");
        assert!(said.contains("has not answered") || said.contains("never connected"), "{program}: {said}");
    }
    // A missing listener for the error must not break it.
    let shell = format!("'{}' health 127.0.0.1:1 2>&-", client.display());
    let ended = std::process::Command::new("sh").args(["-c", &shell]).status().unwrap();
    assert_eq!(ended.code(), Some(1));
}

#[tokio::test]
async fn a_cut_by_the_transport_is_logged_and_counted() {
    let mut server = TestServer::start(&["--metrics", "127.0.0.1:0"]);
    let mut line = String::new();
    server.out.read_line(&mut line).unwrap();
    let metrics = line.split_whitespace().last().unwrap().strip_prefix("http://").unwrap().to_owned();
    let address = server.url.strip_prefix("http://").unwrap();
    // DATA that belongs to no stream.
    let mut socket = std::net::TcpStream::connect(address).unwrap();
    socket.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0\0\0\x01\0\0\0\0\0\0x").unwrap();
    let mut answer = Vec::new();
    let _ = socket.read_to_end(&mut answer);
    let mut scrape = std::net::TcpStream::connect(metrics.strip_suffix("/metrics").unwrap()).unwrap();
    scrape.write_all(b"GET /metrics HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n").unwrap();
    let mut told = String::new();
    scrape.read_to_string(&mut told).unwrap();
    let counted = "palpate_transport_cuts_total{side=\"server\",reason=\"PROTOCOL_ERROR\"} 1";
    // Its log is written when it ends.
    signal(&server, "-TERM");
    server.child.wait().unwrap();
    let log = server.log();
    assert!(told.contains(counted), "{told}, {answer:?}: {log}");
    assert!(log.contains("connection cut by the transport of the server") && log.contains("PROTOCOL_ERROR"), "{log}");
}
