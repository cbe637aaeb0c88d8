//! The haptic round trip beside a bare tonic echo: what Palpate adds to the network.
//!
//! A real `palpate serve` and an echo server (each a process of its own) are asked in turn, a second each, by one
//! client. Both streams carry the same messages: a force command up, a sample with one tool down, a thousand times a
//! second. The echo is measured twice: at that pace, and back to back, when no core ever falls asleep.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods, missing_docs)]

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use palpate::wire::pb;
use pb::haptic_service_client::HapticServiceClient;
use pb::haptic_service_server::{HapticService, HapticServiceServer};
use pb::session_service_client::SessionServiceClient;
use pb::touch_request::Message as Say;
use pb::touch_response::Message as Heard;
use tokio::sync::mpsc;
use tokio_stream::wrappers::{ReceiverStream, TcpListenerStream};
use tokio_stream::{Stream, StreamExt};
use tonic::transport::{Channel, Server};
use tonic::{Request, Response, Status, Streaming};

type Out<T> = std::pin::Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// Answers each command with a sample of the usual size, at once.
struct Echo;

fn no<T>() -> Result<Response<T>, Status> {
    Err(Status::unimplemented("an echo"))
}

fn echoed(request: &pb::TouchRequest) -> pb::TouchResponse {
    let (sequence, client_time_ns) = match &request.message {
        Some(Say::Command(command)) => (command.sequence, command.client_time_ns),
        _ => (0, 0),
    };
    let vector = Some(pb::Vector3 { x: 0.125, y: 0.25, z: -0.5 });
    let tool = pb::ToolSample {
        acknowledged_sequence: sequence,
        client_time_ns,
        server_hold_ns: 1_000_000,
        point: Some(pb::GridPoint { x: 15, y: 15 }),
        displacement_m: vector,
        velocity_m_per_s: vector,
        force_on_tool_n: vector,
        applied_force_n: vector,
        ..Default::default()
    };
    let sample = pb::Sample {
        step: 1000,
        simulation_time_s: 1.0,
        server_time_ns: 1,
        time_dilation: 1.0,
        awake_points: 961,
        tools: vec![tool],
        ..Default::default()
    };
    pb::TouchResponse { message: Some(Heard::Sample(sample)) }
}

#[tonic::async_trait]
impl HapticService for Echo {
    type TouchStream = Out<pb::TouchResponse>;
    type WatchSamplesStream = Out<pb::WatchSamplesResponse>;
    type ProbeStream = Out<pb::ProbeResponse>;
    async fn touch(
        &self,
        request: Request<Streaming<pb::TouchRequest>>,
    ) -> Result<Response<Self::TouchStream>, Status> {
        Ok(Response::new(Box::pin(request.into_inner().map(|request| request.map(|request| echoed(&request))))))
    }
    async fn acquire_tool(
        &self,
        _: Request<pb::AcquireToolRequest>,
    ) -> Result<Response<pb::AcquireToolResponse>, Status> {
        no()
    }
    async fn release_tool(
        &self,
        _: Request<pb::ReleaseToolRequest>,
    ) -> Result<Response<pb::ReleaseToolResponse>, Status> {
        no()
    }
    async fn send_commands(
        &self,
        _: Request<pb::SendCommandsRequest>,
    ) -> Result<Response<pb::SendCommandsResponse>, Status> {
        no()
    }
    async fn watch_samples(
        &self,
        _: Request<pb::WatchSamplesRequest>,
    ) -> Result<Response<Self::WatchSamplesStream>, Status> {
        no()
    }
    async fn probe(&self, _: Request<pb::ProbeRequest>) -> Result<Response<Self::ProbeStream>, Status> {
        no()
    }
}

/// The echo server: the same runtime and transport settings as `palpate serve`.
fn serve_echo() {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    runtime.block_on(async {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        println!("echo listens on http://{}", listener.local_addr().unwrap());
        let incoming =
            TcpListenerStream::new(listener).map(|stream| stream.inspect(|stream| stream.set_nodelay(true).unwrap()));
        Server::builder().add_service(HapticServiceServer::new(Echo)).serve_with_incoming(incoming).await.unwrap();
    });
}

/// A server, ended when dropped, and its URL.
struct Served(Child, String);

impl Drop for Served {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn spawn(mut command: Command) -> Served {
    let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    let url = line.split_whitespace().last().unwrap().to_owned();
    Served(child, url)
}

struct Stream_ {
    outbound: mpsc::Sender<pb::TouchRequest>,
    inbound: Streaming<pb::TouchResponse>,
    sequence: u64,
    clock: Instant,
}

impl Stream_ {
    async fn open(channel: Channel, session_id: String) -> Self {
        let (outbound, messages) = mpsc::channel(16);
        let open = pb::TouchOpen { session_id, tools: vec![0], ..Default::default() };
        outbound.send(pb::TouchRequest { message: Some(Say::Open(open)) }).await.unwrap();
        let inbound =
            HapticServiceClient::new(channel).touch(ReceiverStream::new(messages)).await.unwrap().into_inner();
        let mut stream = Stream_ { outbound, inbound, sequence: 0, clock: Instant::now() };
        stream.hear().await;
        stream
    }

    fn now_ns(&self) -> u64 {
        u64::try_from(self.clock.elapsed().as_nanos()).unwrap()
    }

    async fn poke(&mut self) {
        self.sequence += 1;
        let force = pb::Force {
            centre: Some(pb::force::Centre::Point(pb::GridPoint { x: 15, y: 15 })),
            force_n: Some(pb::Vector3 { x: 0.1, y: 0.1, z: if self.sequence.is_multiple_of(2) { -1.0 } else { -0.9 } }),
            falloff_per_m: 150.0,
            falloff_offset: 0.0,
        };
        let command = pb::Command {
            sequence: self.sequence,
            client_time_ns: self.now_ns(),
            action: Some(pb::command::Action::Force(force)),
            ..Default::default()
        };
        self.outbound.send(pb::TouchRequest { message: Some(Say::Command(command)) }).await.unwrap();
    }

    async fn hear(&mut self) -> Option<pb::Sample> {
        match self.inbound.message().await.unwrap().unwrap().message {
            Some(Heard::Sample(sample)) => Some(sample),
            Some(Heard::Rejection(rejection)) => panic!("{rejection:?}"),
            _ => None,
        }
    }

    /// Waits for the sample that acknowledges the last command: round trip, and the time the server had it, ns.
    async fn acknowledged(&mut self) -> (u64, u64) {
        loop {
            if let Some(sample) = self.hear().await
                && sample.tools[0].acknowledged_sequence == self.sequence
            {
                return (self.now_ns() - sample.tools[0].client_time_ns, sample.tools[0].server_hold_ns);
            }
        }
    }
}

fn report(name: &str, histogram: &Histogram<u64>) {
    let us = |q: f64| histogram.value_at_quantile(q) as f64 / 1e3;
    println!("| {name} | {:.1} | {:.1} | {:.1} | {:.1} |", us(0.5), us(0.99), us(0.999), histogram.max() as f64 / 1e3);
}

fn main() {
    if std::env::args().any(|argument| argument == "--echo") {
        return serve_echo();
    }
    let palpate = spawn({
        let mut command = Command::new(env!("CARGO_BIN_EXE_palpate"));
        command.args(["serve", "--listen", "127.0.0.1:0", "--log", "warn"]);
        command
    });
    let echo = spawn({
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.arg("--echo");
        command
    });
    let rounds: usize = std::env::var("ROUNDS").ok().and_then(|text| text.parse().ok()).unwrap_or(10);
    tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(async {
        let channel = Channel::from_shared(palpate.1.clone()).unwrap().connect().await.unwrap();
        let created = SessionServiceClient::new(channel.clone())
            .create_session(pb::CreateSessionRequest {
                source: Some(pb::create_session_request::Source::SceneName("paper".into())),
                paused: false,
            })
            .await
            .unwrap()
            .into_inner();
        let mut haptic = Stream_::open(channel, created.session.unwrap().session_id).await;
        let channel = Channel::from_shared(echo.1.clone()).unwrap().connect().await.unwrap();
        let mut echo = Stream_::open(channel, String::new()).await;
        let histogram = || Histogram::<u64>::new(3).unwrap();
        let (mut whole, mut network, mut paced, mut busy) = (histogram(), histogram(), histogram(), histogram());
        for _ in 0..rounds {
            let until = Instant::now() + Duration::from_secs(1);
            while Instant::now() < until {
                haptic.poke().await;
                let (round_trip_ns, hold_ns) = haptic.acknowledged().await;
                whole.record(round_trip_ns).unwrap();
                network.record(round_trip_ns - hold_ns).unwrap();
            }
            // The session steps on, as it does for others while one rests; its samples are read meanwhile.
            let until = Instant::now() + Duration::from_secs(1);
            let mut tick = tokio::time::interval(Duration::from_millis(1));
            while Instant::now() < until {
                tick.tick().await;
                echo.poke().await;
                paced.record(echo.acknowledged().await.0).unwrap();
            }
            let until = Instant::now() + Duration::from_millis(500);
            while Instant::now() < until {
                echo.poke().await;
                busy.record(echo.acknowledged().await.0).unwrap();
            }
            haptic.poke().await;
            haptic.acknowledged().await;
        }
        println!("| {rounds} rounds, loopback, µs | p50 | p99 | p99.9 | max |\n|---|---|---|---|---|");
        report("haptic round trip (waits for the next step)", &whole);
        report("the same less server_hold_ns", &network);
        report("bare tonic echo, a message a millisecond", &paced);
        report("bare tonic echo, back to back", &busy);
        let ratio = |echo: &Histogram<u64>| network.value_at_quantile(0.5) as f64 / echo.value_at_quantile(0.5) as f64;
        println!(
            "\nless hold over echo, medians: {:.2} (same pace), {:.2} (back to back)",
            ratio(&paced),
            ratio(&busy)
        );
    });
}
