//! Touch by datagram: it uses datagrams while they get through and the stream otherwise, and no client is admitted
//! without a ticket.

use std::future::Future;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use crate::common::server::{TEST_TIMEOUT, TestServer, TestTouch, open, palpate};
use palpate_client::Credentials;
use palpate_client::datagrams::Datagrams;
use palpate_haptics::{Device, Tip};
use palpate_proto::{datagram, pb, touch};
use palpate_session::Session;
use palpate_session::command::{Command, Due};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::script::Action;
use palpate_tissue::scene::{BUILT_IN, Scene};
use pb::touch_request::Message as Say;
use pb::touch_response::Message as Heard;
use prost::Message;
use tokio::net::UdpSocket;
use wtransport::endpoint::ConnectOptions;
use wtransport::error::ConnectingError;
use wtransport::tls::Sha256Digest;
use wtransport::{ClientConfig, Connection, Endpoint};

/// A wire for datagrams that can be cut, and that counts bytes.
struct Wire {
    address: SocketAddr,
    /// To the server, and back.
    whole: Arc<[AtomicBool; 2]>,
    bytes: Arc<[AtomicU64; 2]>,
}

impl Wire {
    /// Each client's datagrams go to `target` from a socket of their own; one client at a time.
    async fn start() -> (Self, tokio::sync::oneshot::Sender<SocketAddr>) {
        let near = UdpSocket::bind("127.0.0.1:0").await.unwrap();
        let far = UdpSocket::bind("127.0.0.1:0").await.unwrap();
        let address = near.local_addr().unwrap();
        let whole = Arc::new([AtomicBool::new(true), AtomicBool::new(true)]);
        let bytes = Arc::new([AtomicU64::new(0), AtomicU64::new(0)]);
        let (aim, aimed) = tokio::sync::oneshot::channel();
        let (passes, counted) = (whole.clone(), bytes.clone());
        tokio::spawn(async move {
            let target: SocketAddr = aimed.await.unwrap();
            let (mut packet, mut answer, mut client) = ([0; 2048], [0; 2048], None);
            loop {
                let (way, to, packet, socket) = tokio::select! {
                    got = near.recv_from(&mut packet) => {
                        let (length, from) = got.unwrap();
                        client = Some(from);
                        (0, Some(target), &packet[..length], &far)
                    }
                    Ok((length, _)) = far.recv_from(&mut answer) => (1, client, &answer[..length], &near),
                };
                counted[way].fetch_add(packet.len() as u64, Ordering::Relaxed);
                if let Some(to) = to.filter(|_| passes[way].load(Ordering::Relaxed)) {
                    let _ = socket.send_to(packet, to).await;
                }
            }
        });
        (Wire { address, whole, bytes }, aim)
    }

    /// A server whose datagrams go by a wire.
    async fn before_server(arguments: &[&str]) -> (Self, TestServer) {
        let (wire, aim) = Wire::start().await;
        let advertised = wire.address.to_string();
        let server = TestServer::start(&[&["--datagrams-advertise", &advertised], arguments].concat());
        aim.send(address(&server)).unwrap();
        (wire, server)
    }

    fn cut(&self, way: usize, is_cut: bool) {
        self.whole[way].store(!is_cut, Ordering::Relaxed);
    }
}

fn address(server: &TestServer) -> SocketAddr {
    server.url.trim_start_matches("http://").parse().unwrap()
}

async fn liver(server: &TestServer) -> String {
    let source = pb::create_session_request::Source::SceneName("liver".into());
    server.create(source, false).await.unwrap().session_id
}

fn by_datagram(session: &str, tools: &[u32]) -> pb::TouchOpen {
    let device = Some(touch::device(&Device::named("omega3").unwrap()));
    pb::TouchOpen { datagrams: true, device, heartbeat_s: Some(0.04), ..open(session, tools) }
}

/// A pose that presses to 2 mm, one a millisecond.
fn pose(tool: u32, sequence: u64) -> pb::Command {
    let z_m = 0.002 - 2e-5 * sequence.min(200) as f64;
    let pose = touch::pose(glam::DVec3::new(0.0375, 0.0375, z_m), &Tip::default());
    pb::Command {
        tool,
        sequence: Some(sequence),
        client_time_ns: 1_000_000_000 + 1_000_000 * sequence,
        action: Some(pb::command::Action::Pose(pose)),
        ..Default::default()
    }
}

/// A continuous touch, one pose a millisecond.
struct DatagramClient {
    touch: TestTouch,
    datagrams: Datagrams,
    sequence: u64,
    /// Poses that went by datagram, and samples that came by it and by the stream.
    poses: u64,
    samples: [u64; 2],
    newest: Option<pb::Sample>,
    /// Number of requests for another session.
    asked: u64,
}

impl DatagramClient {
    async fn open(server: &TestServer) -> Self {
        let session = liver(server).await;
        let mut touch = TestTouch::open(server, by_datagram(&session, &[0])).await.unwrap();
        let offer = touch.opened.take().unwrap().datagrams;
        assert!(offer.is_some());
        let at = palpate_client::Server::new(&server.url, &Credentials::default()).unwrap();
        let datagrams = Datagrams::dial(offer.as_ref(), &at);
        DatagramClient { touch, datagrams, sequence: 0, poses: 0, samples: [0; 2], newest: None, asked: 0 }
    }

    /// Touches until `enough`.
    async fn until(&mut self, what: &str, enough: impl Fn(&Self) -> bool) {
        let touching = async {
            let mut tick = tokio::time::interval(Duration::from_millis(1));
            while !enough(self) {
                tokio::select! {
                    _ = tick.tick() => {
                        self.sequence += 1;
                        if self.datagrams.asks() {
                            self.asked += 1;
                            self.touch.say(Say::Renew(pb::Renew { client_time_ns: 1, datagrams: true })).await;
                        }
                        let command = pose(0, self.sequence);
                        if self.datagrams.send(&command) {
                            self.poses += 1;
                        } else {
                            self.touch.command(command).await;
                        }
                    }
                    sample = self.datagrams.next() => {
                        self.samples[0] += 1;
                        self.newest = Some(sample);
                    }
                    heard = self.touch.hear() => match heard.unwrap().unwrap() {
                        Heard::Sample(sample) => {
                            self.samples[1] += 1;
                            self.newest = Some(sample);
                        }
                        Heard::Renewed(renewed) => self.datagrams.take_offer(&renewed.datagrams.unwrap()),
                        Heard::Rejection(rejection) => panic!("{rejection:?}"),
                        _ => {}
                    },
                }
            }
        };
        assert!(tokio::time::timeout(TEST_TIMEOUT, touching).await.is_ok(), "{what}");
    }

    fn acknowledged(&self) -> u64 {
        self.newest.as_ref().and_then(|sample| sample.tools.first()).map_or(0, |tool| tool.acknowledged_sequence)
    }

    fn is_pressed(&self) -> bool {
        let tool = self.newest.as_ref().and_then(|sample| sample.tools.first());
        tool.and_then(|tool| tool.force_on_tool_n).is_some_and(|force| force.z > 0.05)
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn touch_goes_by_datagram_while_it_gets_through_and_by_the_stream_else() {
    let (wire, server) = Wire::before_server(&[]).await;
    let mut client = DatagramClient::open(&server).await;
    client
        .until("datagrams carry", |client| client.samples[0] > 100 && client.poses > 100 && client.is_pressed())
        .await;
    for way in [0, 1] {
        wire.cut(way, true);
        let (poses, [_, streamed], acknowledged) = (client.poses, client.samples, client.acknowledged());
        client
            .until("the stream takes over", |client| {
                client.samples[1] > streamed + 100 && client.acknowledged() > acknowledged + 200 && client.is_pressed()
            })
            .await;
        wire.cut(way, false);
        let [datagrams, _] = client.samples;
        client
            .until("datagrams carry again", |client| {
                client.samples[0] > datagrams + 100 && client.poses > poses + 100 && client.is_pressed()
            })
            .await;
    }
    let carried = client.datagrams.carried();
    assert!(carried.fell_back >= 2 && carried.came > 300, "{carried:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_that_the_network_has_ended_is_opened_anew() {
    let (wire, server) = Wire::before_server(&[]).await;
    let mut client = DatagramClient::open(&server).await;
    client.until("datagrams carry", |client| client.samples[0] > 100 && client.poses > 100).await;
    [0, 1].iter().for_each(|way| wire.cut(*way, true));
    client.until("the session is over", |client| client.asked > 0).await;
    [0, 1].iter().for_each(|way| wire.cut(*way, false));
    let (poses, [datagrams, _]) = (client.poses, client.samples);
    client
        .until("datagrams carry again", |client| {
            client.samples[0] > datagrams + 100 && client.poses > poses + 100 && client.is_pressed()
        })
        .await;
    assert_eq!(client.asked, 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn where_udp_is_blocked_touch_goes_by_the_stream() {
    let (wire, server) = Wire::before_server(&[]).await;
    wire.cut(0, true);
    let mut client = DatagramClient::open(&server).await;
    client.until("pressed", |client| client.is_pressed() && client.acknowledged() > 300).await;
    assert_eq!((client.poses, client.samples[0], client.datagrams.carried().came), (0, 0, 0));
}

#[tokio::test]
async fn nothing_is_offered_where_there_is_nothing() {
    let server = TestServer::start(&["--no-datagrams"]);
    let session = liver(&server).await;
    let touch = TestTouch::open(&server, by_datagram(&session, &[0])).await.unwrap();
    assert!(touch.opened.unwrap().datagrams.is_none());
    let lease_id = lease(&server, &session, 1).await;
    let request = pb::OpenDatagramsRequest { session_id: session.clone(), lease_id, ..Default::default() };
    let refused = server.haptics().await.open_datagrams(request).await.unwrap_err();
    assert!(refused.message().contains("no datagrams"), "{refused}");
    // A stream that did not ask gets none either.
    let server = TestServer::start(&[]);
    let session = liver(&server).await;
    let touch = TestTouch::open(&server, open(&session, &[0])).await.unwrap();
    assert!(touch.opened.unwrap().datagrams.is_none());
    let wrong = palpate(&["serve", "--datagrams-advertise", "nowhere"]);
    assert_eq!(wrong.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&wrong.stderr).contains("datagrams_advertise"));
}

/// A lease of a tool that no stream holds.
async fn lease(server: &TestServer, session: &str, tool: u32) -> String {
    let request = pb::AcquireToolRequest {
        session_id: session.to_owned(),
        tool,
        lease_s: Some(60.0),
        outlives_connection: true,
        ..Default::default()
    };
    server.haptics().await.acquire_tool(request).await.unwrap().into_inner().lease_id
}

/// Opens a session by hand, with a ticket and an origin.
async fn dial(to: SocketAddr, hash: &[u8], ticket: &str, origin: Option<&str>) -> Result<Connection, ConnectingError> {
    let hash = Sha256Digest::new(hash.try_into().unwrap());
    let config = ClientConfig::builder().with_bind_address("127.0.0.1:0".parse().unwrap());
    let config = config.with_server_certificate_hashes([hash]).build();
    let options = ConnectOptions::builder(format!("https://{to}/touch/{ticket}"));
    let options = origin.into_iter().fold(options, |options, origin| options.add_header("origin", origin));
    Endpoint::client(config).unwrap().connect(options.build()).await
}

fn hex(ticket: &[u8]) -> String {
    ticket.iter().map(|byte| format!("{byte:02x}")).collect()
}

async fn in_time<T>(what: impl Future<Output = T>) -> T {
    tokio::time::timeout(TEST_TIMEOUT, what).await.expect("in time")
}

#[tokio::test]
async fn a_session_needs_a_ticket_that_is_good_and_a_page_that_may_call_and_ends_with_its_stream() {
    let server = TestServer::start(&["--origin", "https://good.example"]);
    let (to, session) = (address(&server), liver(&server).await);
    let open = || async {
        let mut touch = TestTouch::open(&server, by_datagram(&session, &[0])).await.unwrap();
        let offer = touch.opened.take().unwrap().datagrams.unwrap();
        assert_eq!((offer.host.as_str(), offer.port, offer.ticket.len()), ("", u32::from(to.port()), 16));
        (touch, offer.certificate_sha256, hex(&offer.ticket))
    };
    let (touch, hash, ticket) = open().await;
    for forged in ["", "0", &"0".repeat(32), &ticket[1..], &format!("{ticket}0"), &format!("{ticket}/.."), "../admin"] {
        let refused = in_time(dial(to, &hash, forged, None)).await;
        assert!(matches!(refused, Err(ConnectingError::SessionRejected)), "{forged}: {refused:?}");
    }
    // A page of another site does not use the ticket up.
    for origin in ["https://evil.example", "null", "file://"] {
        let refused = in_time(dial(to, &hash, &ticket, Some(origin))).await;
        assert!(matches!(refused, Err(ConnectingError::SessionRejected)), "{origin}: {refused:?}");
    }
    // The certificate of another server is not accepted.
    assert!(in_time(dial(to, &[7; 32], &ticket, None)).await.is_err());
    let connection = in_time(dial(to, &hash, &ticket, Some("https://good.example"))).await.unwrap();
    let again = in_time(dial(to, &hash, &ticket, None)).await;
    assert!(matches!(again, Err(ConnectingError::SessionRejected)), "a ticket is good once: {again:?}");
    drop(touch);
    in_time(connection.closed()).await;
    server.until_let_go().await;
    let (touch, hash, ticket) = open().await;
    drop(touch);
    server.until_let_go().await;
    let late = in_time(dial(to, &hash, &ticket, None)).await;
    assert!(matches!(late, Err(ConnectingError::SessionRejected)), "its stream has ended: {late:?}");
}

/// A datagram with a pose.
fn poses(number: u64, tool: u32, sequence: u64) -> Vec<u8> {
    let command = pose(tool, sequence);
    let Some(pb::command::Action::Pose(pose)) = command.action else { panic!() };
    let newest = datagram::Posed { sequence, client_time_ns: command.client_time_ns, pose };
    let tools = vec![datagram::tool_poses(tool, &newest, [].iter())];
    pb::PosesDatagram { number, tools, ..Default::default() }.encode_to_vec()
}

#[tokio::test]
async fn a_session_leads_the_tools_of_its_own_stream_alone_and_bears_nonsense() {
    let server = TestServer::start(&[]);
    let session = liver(&server).await;
    let mut touch = TestTouch::open(&server, by_datagram(&session, &[0])).await.unwrap();
    let other = TestTouch::open(&server, by_datagram(&session, &[1])).await.unwrap();
    let offer = touch.opened.take().unwrap().datagrams.unwrap();
    let connection =
        in_time(dial(address(&server), &offer.certificate_sha256, &hex(&offer.ticket), None)).await.unwrap();
    connection.send_datagram(poses(1, 1, 1)).unwrap();
    let refused = touch.rejection().await;
    assert_eq!((refused.tool, refused.reason.as_str()), (1, "NOT_HOLDER"));
    // Of a tip that is nowhere, and of a place that is no number.
    let mut wild = pb::PosesDatagram::decode(poses(2, 0, 1).as_slice()).unwrap();
    wild.tools[0].pose.as_mut().unwrap().position_m = Some(pb::Vector3 { x: f64::NAN, y: 0.0, z: 0.0 });
    connection.send_datagram(wild.encode_to_vec()).unwrap();
    let refused = touch.rejection().await;
    assert_eq!((refused.tool, refused.sequence), (0, 1));
    let mut random = fastrand::Rng::with_seed(20);
    for length in (0..1100).step_by(7) {
        let mut bytes = poses(3, 0, 2);
        bytes.resize(length, 0);
        (0..1 + length / 8).for_each(|_| {
            if length > 0 {
                bytes[random.usize(..length)] = random.u8(..);
            }
        });
        let _ = connection.send_datagram(bytes);
        tokio::time::sleep(Duration::from_micros(200)).await;
    }
    // The stream continues, and so does the other.
    touch.command(pose(0, 1_000_000)).await;
    loop {
        match touch.hear().await.unwrap().unwrap() {
            Heard::Sample(sample) if sample.tools[0].acknowledged_sequence == 1_000_000 => break,
            _ => {}
        }
    }
    drop(other);
}

#[tokio::test]
async fn the_server_answers_an_address_that_was_not_confirmed_by_less_than_it_was_sent() {
    let (wire, server) = Wire::before_server(&[]).await;
    let session = liver(&server).await;
    let mut touch = TestTouch::open(&server, by_datagram(&session, &[0])).await.unwrap();
    let offer = touch.opened.take().unwrap().datagrams.unwrap();
    // No answer gets through, so nothing shows that the client is where it says.
    wire.cut(1, true);
    let ticket = hex(&offer.ticket);
    let dialled = dial(wire.address, &offer.certificate_sha256, &ticket, None);
    assert!(tokio::time::timeout(Duration::from_millis(1500), dialled).await.is_err());
    let [sent, answered] = [0, 1].map(|way| wire.bytes[way].load(Ordering::Relaxed));
    assert!(sent >= 1200 && answered > 0 && answered <= sent, "{sent} bytes were answered by {answered}");
}

#[tokio::test]
async fn a_client_that_cant_open_a_stream_has_datagrams_for_its_lease() {
    let server = TestServer::start(&[]);
    let session = liver(&server).await;
    let mut haptics = server.haptics().await;
    let lease_id = lease(&server, &session, 0).await;
    let request = |lease_id: &str| pb::OpenDatagramsRequest {
        session_id: session.clone(),
        lease_id: lease_id.to_owned(),
        ..Default::default()
    };
    assert!(haptics.open_datagrams(request(&"0".repeat(32))).await.unwrap_err().message().contains("holds no tool"));
    let offer = haptics.open_datagrams(request(&lease_id)).await.unwrap().into_inner().offer.unwrap();
    let connection =
        in_time(dial(address(&server), &offer.certificate_sha256, &hex(&offer.ticket), None)).await.unwrap();
    // Unconfirmed data comes by the session's stream.
    let mut stream = in_time(connection.accept_uni()).await.unwrap();
    let mut length = [0; 4];
    in_time(stream.read_exact(&mut length)).await.unwrap();
    let mut message = vec![0; u32::from_le_bytes(length) as usize];
    in_time(stream.read_exact(&mut message)).await.unwrap();
    let first = pb::TouchResponse::decode(message.as_slice()).unwrap();
    assert!(matches!(first.message, Some(Heard::Sample(_))), "{first:?}");
    // Poses are answered by datagram once it is confirmed that these come.
    let (mut number, mut acknowledges) = (0, 0);
    let answered = async {
        loop {
            number += 1;
            let mut datagram = pb::PosesDatagram::decode(poses(number, 0, number).as_slice()).unwrap();
            datagram.acknowledges = acknowledges;
            connection.send_datagram(datagram.encode_to_vec()).unwrap();
            if let Ok(Ok(datagram)) =
                tokio::time::timeout(Duration::from_millis(5), connection.receive_datagram()).await
            {
                let answer = pb::SampleDatagram::decode(datagram.payload()).unwrap();
                acknowledges = acknowledges.max(answer.number);
                let acted =
                    answer.sample.and_then(|sample| sample.tools.first().map(|tool| tool.acknowledged_sequence));
                if acted.is_some_and(|acted| acted > 0) {
                    return;
                }
            }
        }
    };
    in_time(answered).await;
    let request = pb::ReleaseToolRequest { session_id: session.clone(), lease_id };
    haptics.release_tool(request).await.unwrap();
    in_time(connection.closed()).await;
}

/// Plays commands to tool 0 of liver, those of each step; the forces on the tool after each, N.
fn played(steps: usize, commands: impl Fn(usize) -> Vec<Command>) -> Vec<f64> {
    let text = BUILT_IN.iter().find(|scene| scene.0 == "liver").unwrap().1;
    let scene = Scene::parse("liver", text, &[], &Limits::default()).unwrap();
    let mut session = Session::new(&Model::compile(&scene, &Limits::default()).unwrap());
    let forces = (0..steps).map(|step| {
        let due = |command| Due { command, late: false, late_commands: 0, ends_lease: false };
        session.advance(&mut commands(step).into_iter().map(due).collect(), |_| {});
        let contact = session.sample(None).tools.first().and_then(|tool| tool.contact);
        contact.map_or(0.0, |contact| contact.force_on_tool_n.z)
    });
    forces.collect()
}

/// A pose that presses, 10 mm/s down to 3 mm, sent at that step and played by the client's time.
fn pressing(step: usize) -> Command {
    let z_m = 0.001 - 1e-5 * step.min(400) as f64;
    Command {
        tool: 0,
        sequence: Some(1 + step as u64),
        client_time_ns: 1_000_000_000 + 1_000_000 * step as u64,
        by_datagram: true,
        at_step: None,
        time_to_live_s: None,
        action: Action::Pose {
            place_m: glam::DVec3::new(0.0375, 0.0375, z_m),
            velocity_m_per_s: None,
            tip: Tip::default(),
        },
        arrival_ns: 0,
    }
}

#[test]
fn poses_that_overtake_each_other_press_as_those_in_order_do() {
    let in_order = played(600, |step| vec![pressing(step)]);
    // The two of a pair come in the other order, both with the second of them.
    let in_pairs = played(600, |step| if step % 2 == 1 { vec![pressing(step), pressing(step - 1)] } else { vec![] });
    let without = played(600, |step| if step % 2 == 1 { vec![pressing(step)] } else { vec![] });
    let most_n = in_order.iter().copied().fold(0.0, f64::max);
    assert!(most_n > 0.2, "{most_n} N");
    for (name, forces) in [("in pairs", in_pairs), ("every second", without)] {
        // A pair is late by a step.
        let apart_n = in_order[..598].iter().zip(&forces[1..]).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(apart_n < 0.02 * most_n, "{name}: {apart_n} N of {most_n}");
    }
}

#[test]
fn a_pose_that_was_overtaken_by_a_release_begins_no_touch() {
    let forces = played(900, |step| match step {
        0..500 => vec![pressing(step)],
        500 => vec![Command { action: Action::Release, by_datagram: false, ..pressing(501) }],
        501 => vec![pressing(500), pressing(499)],
        _ => vec![],
    });
    assert!(forces[499] > 0.2 && forces[502..].iter().all(|force_n| force_n.abs() < 0.1 * forces[499]), "{forces:?}");
}

/// Answer of a stream to a request for another session, at most once a second.
async fn another_offer(touch: &mut TestTouch) -> pb::DatagramOffer {
    loop {
        touch.say(Say::Renew(pb::Renew { client_time_ns: 1, datagrams: true })).await;
        loop {
            match touch.hear().await.unwrap().unwrap() {
                Heard::Renewed(pb::Renewed { datagrams: Some(offer), .. }) => return offer,
                Heard::Renewed(_) => break,
                _ => {}
            }
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

#[tokio::test]
async fn another_session_takes_the_place_of_the_one_before() {
    let server = TestServer::start(&[]);
    let (to, session) = (address(&server), liver(&server).await);
    let mut touch = TestTouch::open(&server, by_datagram(&session, &[0])).await.unwrap();
    let offer = touch.opened.take().unwrap().datagrams.unwrap();
    let first = in_time(dial(to, &offer.certificate_sha256, &hex(&offer.ticket), None)).await.unwrap();
    let offer = in_time(another_offer(&mut touch)).await;
    in_time(first.closed()).await;
    let second = in_time(dial(to, &offer.certificate_sha256, &hex(&offer.ticket), None)).await.unwrap();
    second.send_datagram(poses(1, 0, 7)).unwrap();
    let acknowledged = |sample: &pb::Sample| sample.tools.first().map_or(0, |tool| tool.acknowledged_sequence);
    in_time(async {
        let mut number = 1;
        loop {
            let datagram = second.receive_datagram().await.unwrap();
            let message = pb::SampleDatagram::decode(datagram.payload()).unwrap();
            if message.sample.as_ref().is_some_and(|sample| acknowledged(sample) == 7) {
                return;
            }
            // Until it is confirmed that datagrams come, the stream carries the samples.
            number += 1;
            let alive = pb::PosesDatagram { number, acknowledges: message.number, ..Default::default() };
            second.send_datagram(alive.encode_to_vec()).unwrap();
        }
    })
    .await;
    // A stream that did not ask for datagrams gets none later.
    let mut touch = TestTouch::open(&server, open(&session, &[1])).await.unwrap();
    touch.say(Say::Renew(pb::Renew { client_time_ns: 5, datagrams: true })).await;
    let renewed = in_time(async {
        loop {
            if let Heard::Renewed(renewed) = touch.hear().await.unwrap().unwrap() {
                return renewed;
            }
        }
    });
    let renewed = renewed.await;
    assert_eq!((renewed.client_time_ns, renewed.datagrams), (5, None));
}

#[tokio::test]
async fn an_offer_that_nobody_takes_gives_its_place_among_the_streams_back() {
    let server = TestServer::start(&[]);
    let session = liver(&server).await;
    let mut haptics = server.haptics().await;
    let lease_id = lease(&server, &session, 0).await;
    let request = pb::OpenDatagramsRequest { session_id: session.clone(), lease_id, ..Default::default() };
    haptics.open_datagrams(request).await.unwrap();
    let mut admin = pb::admin_service_client::AdminServiceClient::new(server.channel().await);
    let mut streams = async || {
        let request = pb::ListStreamsRequest { session_id: session.clone() };
        admin.list_streams(request).await.unwrap().into_inner().streams.len()
    };
    assert_eq!(streams().await, 1);
    let given_back = async {
        while streams().await > 0 {
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
    };
    in_time(given_back).await;
}
