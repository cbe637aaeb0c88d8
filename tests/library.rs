//! The client library against a real server: a tool, a device, samples and frames.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

#[path = "common/server.rs"]
mod server;

use std::f64::consts::TAU;
use std::sync::Arc;

use glam::DVec3;
use palpate_client::bridge::{Options, Session, Target, run};
use palpate_client::view::Frames;
use palpate_client::watch::Samples;
use palpate_client::{Channel, Credentials, Error, HapticDevice, Reading, Touch};
use palpate_proto::geometry::from_vector;
use palpate_proto::pb;
use palpate_touch::{Device, Tip};
use pb::create_session_request::Source;
use pb::session_service_client::SessionServiceClient;
use pb::touch_request::Message as Say;
use pb::touch_response::Message as Heard;
use server::{PATIENCE, Server, force, open};
use tokio::sync::{Notify, mpsc};
use tokio_stream::wrappers::ReceiverStream;

fn at(server: &Server) -> palpate_client::Server {
    palpate_client::Server::new(&server.url, &Credentials::default()).unwrap()
}

async fn create(channel: Channel, scene: &str) -> String {
    let request = pb::CreateSessionRequest { source: Some(Source::SceneName(scene.into())), ..Default::default() };
    let created = SessionServiceClient::new(channel).create_session(request).await.unwrap();
    created.into_inner().session.unwrap().session_id
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_force_is_felt_watched_and_seen() {
    let server = Server::start(&[]);
    let channel = at(&server).connect().await.unwrap();
    let session_id = create(channel.clone(), "paper").await;
    let request = pb::WatchSamplesRequest { session_id: session_id.clone(), ..Default::default() };
    let mut samples = Samples::open(channel.clone(), request).await.unwrap();
    let encoding = pb::Encoding::I16.into();
    let request = pb::WatchFramesRequest { session_id: session_id.clone(), encoding, ..Default::default() };
    let mut frames = Frames::open(channel.clone(), request).await.unwrap();
    let (say, messages) = mpsc::channel(8);
    let mut touch = Touch::open(channel, open(&session_id, &[0]), ReceiverStream::new(messages)).await.unwrap();
    say.send(Say::Command(force(0, 1, -0.1))).await.unwrap();
    let pressed =
        |sample: &pb::Sample| sample.tools.iter().any(|tool| from_vector(tool.displacement_m.as_ref()).z < -1e-5);
    let done = tokio::time::timeout(PATIENCE, async {
        loop {
            match touch.next().await.unwrap().expect("the stream goes on") {
                Heard::Sample(sample) if pressed(&sample) => break,
                Heard::Rejection(rejection) => panic!("{rejection:?}"),
                _ => {}
            }
        }
        while !pressed(&samples.next().await.unwrap().expect("samples go on")) {}
        loop {
            let (frame, surface) = frames.next().await.unwrap().expect("frames go on");
            assert!(frame.last && surface.vertices == [31, 31]);
            if surface.displacement_m[15 * 31 + 15][2] < -1e-5 {
                assert!(surface.displacement_m[0][2].abs() < 1e-6, "a corner moved: {:?}", surface.displacement_m[0]);
                break;
            }
        }
    });
    done.await.expect("the server is silent");
}

/// Goes down into the tissue and up again without end, and asks for forces again and again.
struct Pressing {
    ticks: u32,
    force_n: DVec3,
    felt: Arc<Notify>,
}

impl HapticDevice for Pressing {
    fn descriptor(&self) -> Device {
        Device::named("omega3").unwrap()
    }

    fn read(&mut self) -> std::io::Result<Reading> {
        self.ticks += 1;
        let z_m = -0.001 + 0.004 * (TAU * f64::from(self.ticks) / 2000.0).cos();
        Ok(Reading { place_m: z_m * DVec3::Z, enable: self.ticks % 300 < 150 })
    }

    fn write(&mut self, force_n: DVec3) -> std::io::Result<()> {
        self.force_n = force_n;
        if force_n.z > 0.05 {
            self.felt.notify_one();
        }
        Ok(())
    }
}

fn pressing() -> (Pressing, Arc<Notify>) {
    let felt = Arc::new(Notify::new());
    (Pressing { ticks: 0, force_n: DVec3::ZERO, felt: felt.clone() }, felt)
}

fn target(server: &Server, session: Session) -> Target {
    let holder = "test".to_owned();
    Target {
        server: at(server),
        session,
        tool: 0,
        tip: Tip::default(),
        deadband: 0.0,
        up_deadband: 0.0,
        datagrams: true,
        holder,
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_device_in_the_middle_of_its_workspace_touches_the_middle_of_the_sheet() {
    let server = Server::start(&[]);
    let (device, felt) = pressing();
    let options = Options { remembers: true, ..Options::default() };
    let target = target(&server, Session::New { scene: "liver".to_owned() });
    let serving = run(device, target, options, async move { felt.notified().await });
    let (device, report) = tokio::time::timeout(PATIENCE, serving).await.expect("no force").unwrap();
    assert_eq!(device.force_n, DVec3::ZERO, "a device is left without a force");
    assert_eq!((report.traffic.connections, report.traffic.refused), (1, 0));
    let last = report.course.last().unwrap();
    assert!((last.place_m - DVec3::new(0.0375, 0.0375, last.place_m.z)).length() < 1e-9, "{last:?}");
    assert!(report.envelope.is_some());
}

#[tokio::test]
async fn what_a_server_refuses_at_first_ends_the_bridge() {
    let server = Server::start(&[]);
    for session in [Session::New { scene: "nowhere".to_owned() }, Session::Existing("0".repeat(32))] {
        let (device, _felt) = pressing();
        let serving = run(device, target(&server, session), Options::default(), std::future::pending());
        let error = tokio::time::timeout(PATIENCE, serving).await.expect("it goes on").err().unwrap();
        assert!(error.is_refusal() && matches!(&error, Error::Call(_)), "{error}");
    }
}
