//! A session shown live in Foxglove, as a client of its protocol gets it.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader};
use std::net::TcpStream;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use palpate_client::view::Frames;
use palpate_client::{Credentials, Server};
use palpate_proto::geometry::from_vector;
use palpate_proto::journal::foxglove::PointCloud;
use palpate_proto::journal::{TissueCurve, ToolCurve};
use palpate_proto::pb;
use prost::Message as _;
use serde_json::{Value, json};
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};

use crate::common::server::{TEST_TIMEOUT, TestServer, TestTouch, client_program, force, open};

/// The bridge, which ends with the test.
struct FoxgloveBridge {
    child: Child,
    url: String,
}

impl FoxgloveBridge {
    fn start(server: &TestServer, session_id: &str) -> Self {
        let mut child = Command::new(client_program())
            .args(["foxglove", session_id, "--server", &server.url, "--listen", "127.0.0.1:0", "--frames-hz", "1000"])
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let url = line.split_whitespace().last().unwrap_or_default().to_owned();
        assert!(url.starts_with("ws://127.0.0.1:"), "{line:?}");
        FoxgloveBridge { child, url }
    }
}

impl Drop for FoxgloveBridge {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A client of Foxglove's protocol, subscribed to every topic that it hears of.
struct FoxgloveViewer {
    socket: WebSocket<TcpStream>,
    /// The topic of each subscription, and the name of its schema.
    topics: BTreeMap<u32, (String, String)>,
}

impl FoxgloveViewer {
    fn connect(url: &str) -> Self {
        let stream = TcpStream::connect(url.trim_start_matches("ws://")).unwrap();
        stream.set_read_timeout(Some(TEST_TIMEOUT)).unwrap();
        let mut request = url.into_client_request().unwrap();
        request.headers_mut().insert("Sec-WebSocket-Protocol", "foxglove.sdk.v1".parse().unwrap());
        let (socket, response) = tungstenite::client(request, stream).unwrap();
        assert_eq!(response.headers()["sec-websocket-protocol"], "foxglove.sdk.v1");
        FoxgloveViewer { socket, topics: BTreeMap::new() }
    }

    /// Waits for the next message of a topic; `None` when the connection has ended. Subscribes to topics that are
    /// advertised before.
    fn next(&mut self) -> Option<(&(String, String), Vec<u8>)> {
        loop {
            match self.socket.read().ok()? {
                Message::Text(text) => {
                    let said: Value = serde_json::from_str(&text).unwrap();
                    for channel in
                        said["channels"].as_array().into_iter().flatten().filter(|_| said["op"] == "advertise")
                    {
                        assert_eq!(
                            (&channel["encoding"], &channel["schemaEncoding"]),
                            (&json!("protobuf"), &json!("protobuf"))
                        );
                        let text = |key: &str| channel[key].as_str().unwrap().to_owned();
                        let id = u32::try_from(self.topics.len()).unwrap();
                        self.topics.insert(id, (text("topic"), text("schemaName")));
                        let subscription = json!({ "id": id, "channelId": channel["id"] });
                        let subscribe = json!({ "op": "subscribe", "subscriptions": [subscription] });
                        self.socket.send(Message::text(subscribe.to_string())).unwrap();
                    }
                }
                // Opcode 1, the subscription, the time, and the message.
                Message::Binary(bytes) if bytes[0] == 1 => {
                    let id = u32::from_le_bytes(bytes[1..5].try_into().unwrap());
                    return Some((&self.topics[&id], bytes[13..].to_vec()));
                }
                _ => {}
            }
        }
    }
}

/// The newest messages that have come.
#[derive(Default, Debug, Clone)]
struct NewestMessages {
    cloud: Option<Vec<[f32; 4]>>,
    tools: BTreeMap<u32, ToolCurve>,
    tissue: Option<TissueCurve>,
}

impl NewestMessages {
    fn take(&mut self, (topic, schema): &(String, String), message: &[u8]) {
        match topic.as_str() {
            "/surface" => {
                assert_eq!(schema, "foxglove.PointCloud");
                let cloud = PointCloud::decode(message).unwrap();
                let names: Vec<&str> = cloud.fields.iter().map(|field| field.name.as_str()).collect();
                assert_eq!((cloud.frame_id.as_str(), cloud.point_stride), ("tissue", 16));
                assert_eq!(names, ["x", "y", "z", "displacement_m"]);
                let number = |bytes: &[u8]| f32::from_le_bytes(bytes.try_into().unwrap());
                let floats = |point: &[u8]| std::array::from_fn(|k| number(&point[4 * k..4 * k + 4]));
                self.cloud = Some(cloud.data.chunks_exact(16).map(floats).collect());
            }
            "/tissue" => {
                assert_eq!(schema, "palpate.journal.v1.TissueCurve");
                self.tissue = Some(TissueCurve::decode(message).unwrap());
            }
            tool => {
                assert_eq!(schema, "palpate.journal.v1.ToolCurve");
                let curve = ToolCurve::decode(message).unwrap();
                assert_eq!(tool, format!("/tool/{}", curve.tool));
                self.tools.insert(curve.tool, curve);
            }
        }
    }

    /// Returns whether every topic has a message of this step, or of a later one. A point cloud has no step.
    fn has_step(&self, step: u64) -> bool {
        let of_tool = |tool| self.tools.get(tool).is_some_and(|curve: &ToolCurve| curve.step >= step);
        let of_tissue = self.tissue.as_ref().is_some_and(|curve| curve.step >= step);
        of_tool(&0) && of_tool(&1) && of_tissue && self.cloud.is_some()
    }
}

/// Where tool 1 presses, m.
const POSE_M: [f64; 3] = [0.05, 0.1, -0.03];

/// Presses tool 1 in.
fn pose(sequence: u64) -> pb::Command {
    let [x, y, z] = POSE_M;
    let pose = pb::Pose { position_m: Some(pb::Vector3 { x, y, z }), ..Default::default() };
    let (sequence, action) = (Some(sequence), Some(pb::command::Action::Pose(pose)));
    pb::Command { tool: 1, sequence, client_time_ns: 1, action, ..Default::default() }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn foxglove_gets_the_surface_the_tools_and_the_energies_of_a_session() {
    let (server, newest) = (TestServer::start(&[]), Arc::new(Mutex::new(NewestMessages::default())));
    let session_id = server.paper(true).await;
    let bridge = FoxgloveBridge::start(&server, &session_id);
    let (url, taken) = (bridge.url.clone(), newest.clone());
    // Ends with the bridge.
    let receiver = std::thread::spawn(move || {
        let mut viewer = FoxgloveViewer::connect(&url);
        while let Some((topic, message)) = viewer.next() {
            taken.lock().unwrap().take(topic, &message);
        }
    });
    let mut touch = TestTouch::open(&server, open(&session_id, &[0, 1])).await.unwrap();
    touch.command(force(0, 1, -2.0)).await;
    let probe = pb::ProbeRequest {
        session_id: session_id.clone(),
        r#where: Some(pb::probe_request::Where::Points(pb::GridPoints::default())),
        every_steps: Some(10),
        energy: true,
        tools: true,
    };
    let mut records = server.haptics().await.probe(probe).await.unwrap().into_inner();
    let begun = Instant::now();
    // Ten steps at a time: first until every topic is subscribed to, then to a step of which all messages come.
    let (mut step, mut last) = (0, false);
    let sample = loop {
        step += 10;
        touch.command(pose(step)).await;
        touch.settle().await;
        server.start_until(&session_id, step).await;
        let sample = touch.sample_with(|sample| sample.step == step).await;
        if last {
            break sample;
        }
        last = newest.lock().unwrap().has_step(1);
        assert!(begun.elapsed() < TEST_TIMEOUT && !receiver.is_finished(), "{newest:?}");
    };
    // What any viewer sees of this step.
    let channel = Server::new(&server.url, &Credentials::default()).unwrap().connect().await.unwrap();
    let request = pb::WatchFramesRequest { session_id, ..Default::default() };
    let mut frames = Frames::open(channel, request).await.unwrap();
    let (_, surface) = frames.next().await.unwrap().unwrap();
    let is_same = |cloud: &[[f32; 4]]| {
        let length_m = |moved_m: &[f32; 3]| moved_m.iter().map(|part| part * part).sum::<f32>().sqrt();
        let mut points = cloud.iter().zip(&surface.displacement_m);
        points.all(|(at, moved_m)| (at[2] - moved_m[2]).abs() < 1e-7 && (at[3] - length_m(moved_m)).abs() < 1e-7)
    };
    let last = loop {
        let last = newest.lock().unwrap().clone();
        if last.has_step(step) && last.cloud.as_deref().is_some_and(is_same) {
            break last;
        }
        assert!(begun.elapsed() < TEST_TIMEOUT, "step {step}: {last:?} {surface:?}");
        tokio::time::sleep(Duration::from_millis(10)).await;
    };
    let cloud = last.cloud.unwrap();
    assert_eq!((cloud.len(), surface.displacement_m.len()), (961, 961));
    assert!(cloud.iter().any(|point| point[3] > 1e-3));
    // A force leads tool 0, and poses lead tool 1.
    for (felt, curve) in sample.tools.iter().zip(last.tools.values()) {
        assert_eq!((curve.tool, curve.step), (felt.tool, step));
        assert_eq!(curve.force_n, felt.force_on_tool_n);
        let force_n = from_vector(curve.force_n.as_ref()).length();
        assert!(force_n > 0.0 && (curve.force_magnitude_n - force_n).abs() < 1e-12, "{curve:?}");
    }
    let curve = &last.tools[&0];
    assert_eq!(curve.displacement_m, sample.tools[0].displacement_m);
    let rest_m = from_vector(curve.place_m.as_ref()) - from_vector(curve.displacement_m.as_ref());
    // Point (15, 15), the middle of the sheet.
    let centre_m = cloud[15 * 31 + 15].map(f64::from);
    assert!((rest_m.x - centre_m[0]).abs() < 1e-6 && rest_m.x > 0.0 && rest_m.z.abs() < 1e-15, "{rest_m} {centre_m:?}");
    // What a record of the same step has.
    let record = loop {
        let record = tokio::time::timeout(TEST_TIMEOUT, records.message()).await.unwrap().unwrap().unwrap();
        if record.step == step {
            break record;
        }
    };
    let (posed, curve) = (&record.tools[0], &last.tools[&1]);
    assert_eq!((curve.place_m, curve.displacement_m), (posed.place_m, posed.displacement_m));
    assert!(curve.place_m.is_some_and(|place_m| place_m.x == POSE_M[0] && place_m.y == POSE_M[1]), "{curve:?}");
    let (tissue, energy) = (last.tissue.unwrap(), record.energy.unwrap());
    assert_eq!(
        (tissue.kinetic_j, tissue.spring_j, tissue.anchor_j),
        (energy.kinetic_j, energy.spring_j, energy.anchor_j)
    );
    assert!(tissue.spring_j > 0.0 && tissue.awake_points == record.awake_points, "{tissue:?}");
    assert!(tissue.largest_displacement_m > 1e-3, "{tissue:?}");
    drop(bridge);
    receiver.join().unwrap();
}
