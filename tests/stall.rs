//! Either side may stand still for seconds while the other talks on: connection and stream outlive that, no command is
//! lost without a word, and no old one moves a tool.
#![cfg(unix)]
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

#[path = "common/proxy.rs"]
mod proxy;
#[path = "common/server.rs"]
mod server;

use std::collections::HashMap;
use std::time::{Duration, Instant};

use glam::DVec3;
use palpate::limits::Limits;
use palpate::scene::Scene;
use palpate::scene::script::Action;
use palpate::scene::tip::Tip;
use palpate::wire::{self, pb};
use pb::create_session_request::Source;
use pb::haptic_service_client::HapticServiceClient;
use pb::touch_request::Message as Say;
use pb::touch_response::Message as Heard;
use proxy::Proxy;
use server::{PATIENCE, Server, open};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Streaming;
use tonic::transport::Channel;

/// As long as either side stands still, s.
const STALL: Duration = Duration::from_secs(5);

/// What an unoptimized server steps in time.
fn small() -> Source {
    let text = "name = \"small\"\n[sheet]\npoints = [9, 9]\nspacing_m = 0.01\npoint_mass_kg = 0.002\n\
                [springs]\nstiffness_n_per_m = 30.0\n[virtual_springs]\nstiffness_n_per_m = 5.0\n\
                [damping]\ncoefficient_n_s_per_m = 0.2\n\
                [stepping]\nintegrator = \"central\"\nsubsteps = 4\nprecision = \"f32\"\n";
    Source::Scene(wire::scene::scene(&Scene::parse("small", text, &[], &Limits::default()).unwrap()))
}

fn signal(server: &Server, name: &str) {
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
    async fn open(channel: Channel, session: &str, tools: u32) -> Self {
        let (outbound, messages) = mpsc::channel(1 << 20);
        let open = open(session, &(0..tools).collect::<Vec<_>>());
        outbound.send(pb::TouchRequest { message: Some(Say::Open(open)) }).await.unwrap();
        let mut inbound = HapticServiceClient::new(channel).touch(ReceiverStream::new(messages)).await.unwrap().into_inner();
        assert!(matches!(inbound.message().await.unwrap().unwrap().message, Some(Heard::Opened(_))));
        Led { outbound, inbound, tools, sequence: 0, begun: Instant::now() }
    }

    /// Tells every tool where it is, above the tissue.
    fn tick(&mut self) {
        self.sequence += 1;
        let time_ns = 1 + self.begun.elapsed().as_nanos() as u64;
        let place_m = DVec3::new(0.04, 0.04, 0.02 + 1e-6 * (self.sequence % 100) as f64);
        for tool in 0..self.tools {
            let action = Action::Lead { place_m, tip: Tip::default() };
            let command = wire::command::now(tool, self.sequence, &action, time_ns);
            let message = pb::TouchRequest { message: Some(Say::Command(command)) };
            self.outbound.try_send(message).expect("the stream has ended");
        }
    }

    /// A thousand times a second for so long, whatever is heard.
    async fn lead(&mut self, lasts: Duration) {
        let mut ticks = tokio::time::interval(Duration::from_millis(1));
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Burst);
        for _ in 0..lasts.as_millis() {
            ticks.tick().await;
            self.tick();
        }
    }

    /// Listens until all that was said is acknowledged by a sample; tells how many commands were refused, by reason.
    async fn acknowledged(&mut self) -> HashMap<String, u64> {
        let mut refused = HashMap::new();
        loop {
            let heard = tokio::time::timeout(PATIENCE, self.inbound.message()).await.expect("the server is silent");
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
}

/// Every command was taken in or refused, and no tool moved by more than it was led.
async fn all_are_told(server: &Server, session: &str, led: &Led) {
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
async fn the_server_stands_still(url: String, server: &Server, tools: u32, stall: Duration) {
    let session = server.create(small(), false).await.unwrap().session_id;
    let channel = Channel::from_shared(url).unwrap().connect().await.unwrap();
    let mut led = Led::open(channel, &session, tools).await;
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
    let server = Server::start(&["--log", "error"]);
    the_server_stands_still(server.url.clone(), &server, 1, STALL).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn sixteen_tools_outlive_a_server_that_stands_still() {
    let server = Server::start(&["--log", "error"]);
    the_server_stands_still(server.url.clone(), &server, 16, Duration::from_secs(1)).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_tool_far_away_outlives_a_server_that_stands_still() {
    let server = Server::start(&["--log", "error"]);
    let address = server.url.strip_prefix("http://").unwrap().to_owned();
    let proxy = Proxy::start(address, Duration::from_millis(25)).await;
    the_server_stands_still(proxy.url(), &server, 1, STALL).await;
}
