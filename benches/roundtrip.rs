//! The haptic round trip compared with a bare tonic echo: what Palpate adds to the network.
//!
//! One client asks a real `palpate serve` and an echo server (each a process of its own) in turn, a second each. Both
//! streams carry the same messages: a force command up, a sample with one tool down, a thousand times a second. Only
//! the wait until the step was due is subtracted from the haptic round trip, because it is by design; lateness,
//! stepping, encoding and queueing in the server all count. The echo is measured in three ways: a message per
//! millisecond; the same with an answer after a millisecond, so that the client is as deeply asleep when the answer
//! comes as in a haptic loop (minus the time that the echo held the message, which leaves the network alone); and back
//! to back, when no core ever sleeps.

#![allow(clippy::unwrap_used, clippy::disallowed_methods, clippy::cast_precision_loss, missing_docs)]

#[path = "../tests/common/server.rs"]
mod server;

use std::process::Command;
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use palpate_proto::pb;
use pb::haptic_service_server::{HapticService, HapticServiceServer};
use pb::touch_request::Message as Say;
use pb::touch_response::Message as Heard;
use server::{TestServer, TestTouch, force};
use tokio_stream::wrappers::TcpListenerStream;
use tokio_stream::{Stream, StreamExt};
use tonic::{Request, Response, Status, Streaming};

type OutStream<T> = std::pin::Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// Answers each command with a sample of the usual size: at once, or after a millisecond in a session named "wait".
struct Echo;

const WAIT: &str = "wait";

fn no<T>() -> Result<Response<T>, Status> {
    Err(Status::unimplemented("an echo"))
}

fn echoed(request: &pb::TouchRequest, server_hold_ns: u64) -> pb::TouchResponse {
    let (sequence, client_time_ns) = match &request.message {
        Some(Say::Command(command)) => (command.sequence.unwrap_or_default(), command.client_time_ns),
        _ => return pb::TouchResponse { message: Some(Heard::Opened(pb::TouchOpened::default())) },
    };
    let vector = Some(pb::Vector3 { x: 0.125, y: 0.25, z: -0.5 });
    let tool = pb::ToolSample {
        acknowledged_sequence: sequence,
        client_time_ns,
        server_hold_ns,
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
    type TouchStream = OutStream<pb::TouchResponse>;
    type WatchSamplesStream = OutStream<pb::WatchSamplesResponse>;
    type ProbeStream = OutStream<pb::ProbeResponse>;
    async fn touch(
        &self,
        request: Request<Streaming<pb::TouchRequest>>,
    ) -> Result<Response<Self::TouchStream>, Status> {
        let mut waits = false;
        let out = request.into_inner().then(move |request| {
            if let Ok(pb::TouchRequest { message: Some(Say::Open(open)) }) = &request {
                waits = open.session_id == WAIT;
            }
            let arrival = Instant::now();
            async move {
                if waits {
                    tokio::time::sleep(Duration::from_millis(1)).await;
                }
                request.map(|request| echoed(&request, u64::try_from(arrival.elapsed().as_nanos()).unwrap()))
            }
        });
        Ok(Response::new(Box::pin(out)))
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
    async fn open_datagrams(
        &self,
        _: Request<pb::OpenDatagramsRequest>,
    ) -> Result<Response<pb::OpenDatagramsResponse>, Status> {
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
        tonic::transport::Server::builder()
            .add_service(HapticServiceServer::new(Echo))
            .serve_with_incoming(incoming)
            .await
            .unwrap();
    });
}

/// Starts the echo server in a process of its own.
fn spawn_echo() -> TestServer {
    let mut echo = Command::new(std::env::current_exe().unwrap());
    TestServer::spawn(echo.arg("--echo"))
}

/// A haptic stream that sends a command and waits for its acknowledgement.
struct Asker {
    touch: TestTouch,
    sequence: u64,
    clock: Instant,
}

impl Asker {
    async fn open(server: &TestServer, session_id: &str) -> Self {
        Asker { touch: TestTouch::hold(server, session_id).await, sequence: 0, clock: Instant::now() }
    }

    fn now_ns(&self) -> u64 {
        u64::try_from(self.clock.elapsed().as_nanos()).unwrap()
    }

    /// Round trip; the part of it in which the server held the command; and the part of that until its step was due,
    /// ns.
    async fn ask(&mut self) -> [u64; 3] {
        self.sequence += 1;
        let strength_n = if self.sequence.is_multiple_of(2) { -1.0 } else { -0.9 };
        let client_time_ns = self.now_ns();
        self.touch.command(pb::Command { client_time_ns, ..force(0, self.sequence, strength_n) }).await;
        let sequence = self.sequence;
        let sample = self.touch.sample_with(|sample| sample.tools[0].acknowledged_sequence == sequence).await;
        let tool = &sample.tools[0];
        [self.now_ns() - tool.client_time_ns, tool.server_hold_ns, tool.step_wait_ns]
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
    let palpate = TestServer::start(&["--log", "warn"]);
    let echo = spawn_echo();
    let rounds: usize = std::env::var("ROUNDS").ok().and_then(|text| text.parse().ok()).unwrap_or(10);
    tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(async {
        let session = palpate.paper(false).await;
        let mut haptic = Asker::open(&palpate, &session).await;
        let mut waiting = Asker::open(&echo, WAIT).await;
        let mut echo = Asker::open(&echo, "").await;
        let histogram = || Histogram::<u64>::new(3).unwrap();
        let (mut whole, mut unplanned, mut network) = (histogram(), histogram(), histogram());
        let (mut paced, mut asleep, mut busy) = (histogram(), histogram(), histogram());
        for _ in 0..rounds {
            // Read what is already there.
            haptic.ask().await;
            let until = Instant::now() + Duration::from_secs(1);
            while Instant::now() < until {
                let [round_trip_ns, hold_ns, wait_ns] = haptic.ask().await;
                whole.record(round_trip_ns).unwrap();
                unplanned.record(round_trip_ns - wait_ns).unwrap();
                network.record(round_trip_ns - hold_ns).unwrap();
            }
            // The session keeps stepping beside the echo, so that the machine is equally busy in both measurements.
            let until = Instant::now() + Duration::from_secs(1);
            let mut tick = tokio::time::interval(Duration::from_millis(1));
            while Instant::now() < until {
                tick.tick().await;
                paced.record(echo.ask().await[0]).unwrap();
            }
            let until = Instant::now() + Duration::from_secs(1);
            while Instant::now() < until {
                let [round_trip_ns, hold_ns, _] = waiting.ask().await;
                asleep.record(round_trip_ns - hold_ns).unwrap();
            }
            let until = Instant::now() + Duration::from_millis(500);
            while Instant::now() < until {
                busy.record(echo.ask().await[0]).unwrap();
            }
        }
        println!("| {rounds} rounds, loopback, µs | p50 | p99 | p99.9 | max |\n|---|---|---|---|---|");
        report("haptic round trip (waits for the next step)", &whole);
        report("the same less the wait until the step was due", &unplanned);
        report("the same less all of the server's time: the network alone", &network);
        report("bare tonic echo, a message a millisecond", &paced);
        report("bare tonic echo, answered after a millisecond, less that", &asleep);
        report("bare tonic echo, back to back", &busy);
        println!("\nless the wait until the step was due, over echo, medians:");
        for (name, echo) in [("a message a millisecond", &paced), ("as fast asleep", &asleep), ("back to back", &busy)]
        {
            let ratio = unplanned.value_at_quantile(0.5) as f64 / echo.value_at_quantile(0.5) as f64;
            println!("- {name}: {ratio:.2}");
        }
    });
}
