//! Honest clients: one that sends 1000 commands a second and checks every answer, and newcomers that connect, touch
//! something and leave. Each has a thread of its own, so that other work does not delay it.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used, clippy::panic, clippy::disallowed_methods)]

use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, mpsc};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use palpate_proto::pb;
use pb::touch_request::Message as Say;
use pb::touch_response::Message as Heard;
use tokio::time::MissedTickBehavior;
use tokio_stream::wrappers::UnboundedReceiverStream;
use tonic::{Status, Streaming};

use crate::caller::{Door, MIDDLE, SIDE, TestCaller, create, haptics, push, sessions, sheet, why};
use crate::server::TEST_TIMEOUT;

fn alone<T>(work: impl Future<Output = T>) -> T {
    tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(work)
}

/// Record of an honest client.
#[derive(Clone)]
pub struct ClientLedger {
    pub sent: u64,
    pub answered: u64,
    /// With a reason.
    pub refused: u64,
    /// Sent over a stream that broke before the answer, or never answered.
    pub lost: u64,
    /// Why streams ended that should have gone on.
    pub broken: Vec<String>,
    pub round_trip_us: Histogram<u64>,
    /// Between two samples that came one after the other.
    pub longest_gap: Duration,
}

impl Default for ClientLedger {
    fn default() -> Self {
        ClientLedger {
            sent: 0,
            answered: 0,
            refused: 0,
            lost: 0,
            broken: Vec::new(),
            // Up to two minutes.
            round_trip_us: Histogram::new_with_bounds(1, 120_000_000, 3).unwrap(),
            longest_gap: Duration::ZERO,
        }
    }
}

impl ClientLedger {
    pub fn add(&mut self, other: &ClientLedger) {
        self.sent += other.sent;
        self.answered += other.answered;
        self.refused += other.refused;
        self.lost += other.lost;
        self.broken.extend_from_slice(&other.broken);
        self.round_trip_us.add(&other.round_trip_us).unwrap();
        self.longest_gap = self.longest_gap.max(other.longest_gap);
    }

    /// Of the round trip, ms; not a number if there was none.
    #[allow(clippy::cast_precision_loss)]
    pub fn quantile_ms(&self, quantile: f64) -> f64 {
        if self.round_trip_us.is_empty() {
            return f64::NAN;
        }
        self.round_trip_us.value_at_quantile(quantile) as f64 / 1e3
    }
}

#[derive(Default)]
struct Shared {
    over: AtomicBool,
    /// Time for which the client stands still, ms.
    freeze_ms: AtomicU64,
    account: Mutex<ClientLedger>,
}

/// Makes an honest client stand still, and its socket with it.
#[derive(Clone)]
pub struct Freezer(Arc<Shared>);

impl Freezer {
    pub fn freeze(&self, time: Duration) {
        self.0.freeze_ms.store(u64::try_from(time.as_millis()).unwrap(), Ordering::Relaxed);
    }
}

/// A client at work.
pub struct Honest {
    pub session_id: String,
    shared: Arc<Shared>,
    thread: JoinHandle<Option<pb::CommandCounts>>,
}

/// Final record of a client that has ended its work.
pub struct ClientVerdict {
    /// Since it was last asked.
    pub account: ClientLedger,
    /// The server's counts of the session's commands, if there is a server and a session.
    pub counts: Option<pb::CommandCounts>,
}

impl Honest {
    /// With so many tools in a session of its own.
    pub fn start(caller: TestCaller, tools: u32) -> Self {
        let shared = Arc::new(Shared::default());
        let (ready, made) = mpsc::channel();
        let thread = std::thread::spawn({
            let shared = shared.clone();
            move || alone(work(caller, tools, &shared, &ready))
        });
        let session_id = made.recv().unwrap();
        Honest { session_id, shared, thread }
    }

    pub fn freezer(&self) -> Freezer {
        Freezer(self.shared.clone())
    }

    /// Returns its record since the last call.
    pub fn take(&self) -> ClientLedger {
        std::mem::take(&mut self.shared.account.lock().unwrap())
    }

    /// Sends no more, waits for what is not answered, asks the server for its own account, and deletes the session.
    pub fn end(self) -> ClientVerdict {
        self.shared.over.store(true, Ordering::Relaxed);
        let counts = self.thread.join().unwrap();
        ClientVerdict { account: std::mem::take(&mut self.shared.account.lock().unwrap()), counts }
    }
}

/// A tool's commands that are not answered: number, and when it was sent.
type Waiting = VecDeque<(u64, Instant)>;

async fn work(
    caller: TestCaller,
    tools: u32,
    shared: &Shared,
    ready: &mpsc::Sender<String>,
) -> Option<pb::CommandCounts> {
    let door = caller.door().await.unwrap();
    let session_id = create(&door, sheet(SIDE, SIDE), false).await.unwrap();
    ready.send(session_id.clone()).unwrap();
    let mut sequence = 0;
    let mut door = Ok(door);
    let mut counts = None;
    while !shared.over.load(Ordering::Relaxed) {
        let mut waiting = vec![Waiting::new(); tools as usize];
        let visited = match &door {
            Ok(door) => visit(door, &session_id, shared, &mut sequence, &mut waiting).await,
            Err(error) => Err(Status::clone(error)),
        };
        {
            let mut account = shared.account.lock().unwrap();
            account.lost += waiting.iter().map(|waiting| waiting.len() as u64).sum::<u64>();
            match visited {
                Ok(told) => counts = told,
                Err(error) => account.broken.push(why(&error)),
            }
        }
        if !shared.over.load(Ordering::Relaxed) {
            // As a program does that wants to continue.
            tokio::time::sleep(Duration::from_millis(100)).await;
            door = caller.door().await;
        }
    }
    if let Ok(door) = door {
        let deleted = async { sessions(&door).delete_session(pb::DeleteSessionRequest { session_id }).await };
        let _ = tokio::time::timeout(TEST_TIMEOUT, deleted).await;
    }
    counts
}

/// Returns the server's counts of the session's commands.
async fn counts(door: &Door, session_id: &str) -> Result<Option<pb::CommandCounts>, Status> {
    let request = pb::GetSessionRequest { session_id: session_id.to_owned() };
    Ok(sessions(door).get_session(request).await?.into_inner().session.and_then(|session| session.commands))
}

/// One stream, until it is broken, or over and all is answered: then what the server says of it.
async fn visit(
    door: &Door,
    session_id: &str,
    shared: &Shared,
    sequence: &mut u64,
    waiting: &mut [Waiting],
) -> Result<Option<pb::CommandCounts>, Status> {
    let tools: Vec<u32> = (0..u32::try_from(waiting.len()).unwrap()).collect();
    let (say, mut inbound) = open(door, session_id, &tools).await?;
    let mut tick = tokio::time::interval(Duration::from_millis(1));
    tick.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut newest = Instant::now();
    let mut over: Option<Instant> = None;
    loop {
        let heard = tokio::select! {
            biased;
            heard = inbound.message() => heard?,
            _ = tick.tick() => {
                let still_ms = shared.freeze_ms.swap(0, Ordering::Relaxed);
                std::thread::sleep(Duration::from_millis(still_ms));
                if let Some(over) = over {
                    if waiting.iter().all(VecDeque::is_empty) {
                        return counts(door, session_id).await;
                    }
                    if over.elapsed() > TEST_TIMEOUT {
                        return Err(Status::deadline_exceeded("the last commands are not answered"));
                    }
                    continue;
                }
                over = shared.over.load(Ordering::Relaxed).then(Instant::now);
                *sequence += 1;
                for (tool, waiting) in tools.iter().zip(waiting.iter_mut()) {
                    waiting.push_back((*sequence, Instant::now()));
                    // Never the same force twice: the tissue does not fall asleep.
                    #[allow(clippy::cast_precision_loss)]
                    let force_n = -0.1 - 0.02 * (0.003 * *sequence as f64 + f64::from(*tool)).sin();
                    let command = push(*tool, *sequence, MIDDLE, force_n);
                    // The receiving side notices a stream that has ended.
                    let _ = say.send(pb::TouchRequest { message: Some(Say::Command(command)) });
                }
                shared.account.lock().unwrap().sent += tools.len() as u64;
                continue;
            }
        };
        let mut account = shared.account.lock().unwrap();
        match heard.and_then(|heard| heard.message) {
            Some(Heard::Sample(sample)) => {
                account.longest_gap = account.longest_gap.max(newest.elapsed());
                newest = Instant::now();
                for told in sample.tools {
                    let waiting = &mut waiting[told.tool as usize];
                    while let Some((number, sent)) = waiting.front().copied() {
                        if number > told.acknowledged_sequence {
                            break;
                        }
                        waiting.pop_front();
                        account.answered += 1;
                        account.round_trip_us.saturating_record(u64::try_from(sent.elapsed().as_micros()).unwrap());
                    }
                }
            }
            Some(Heard::Rejection(rejection)) => {
                waiting[rejection.tool as usize].retain(|(number, _)| *number != rejection.sequence);
                account.refused += 1;
            }
            Some(_) => {}
            None => return Err(Status::unavailable("the server ended the stream")),
        }
    }
}

type Stream = (tokio::sync::mpsc::UnboundedSender<pb::TouchRequest>, Streaming<pb::TouchResponse>);

/// A haptic stream that holds these tools.
async fn open(door: &Door, session_id: &str, tools: &[u32]) -> Result<Stream, Status> {
    let (say, messages) = tokio::sync::mpsc::unbounded_channel();
    let open = pb::TouchOpen {
        session_id: session_id.to_owned(),
        tools: tools.to_vec(),
        lease_s: Some(60.0),
        holder: "honest".into(),
        ..Default::default()
    };
    let _ = say.send(pb::TouchRequest { message: Some(Say::Open(open)) });
    let mut inbound = haptics(door).touch(UnboundedReceiverStream::new(messages)).await?.into_inner();
    match inbound.message().await?.and_then(|heard| heard.message) {
        Some(Heard::Opened(_)) => Ok((say, inbound)),
        other => Err(Status::internal(format!("{other:?} instead of `opened`"))),
    }
}

/// A newcomer's tool: none of those that an honest client has in its own session.
pub const GUEST: u32 = 40;

/// Record of newcomers.
#[derive(Clone, Default)]
pub struct Welcome {
    pub rounds: u64,
    pub served: u64,
    pub slowest: Duration,
    /// Why the others were not.
    pub reasons: BTreeMap<String, u64>,
    /// Since when the last of these rounds is under way, if it is.
    pub waiting: Option<Instant>,
}

impl Welcome {
    /// Takes what there is; a round under way is counted before and after.
    fn take(&mut self) -> Welcome {
        let waiting = self.waiting;
        let next = Welcome { rounds: waiting.iter().len() as u64, waiting, ..Welcome::default() };
        let mut taken = std::mem::replace(self, next);
        taken.slowest = taken.slowest.max(waiting.map_or(Duration::ZERO, |since| since.elapsed()));
        taken
    }
}

/// One newcomer after the other.
pub struct Newcomers {
    over: Arc<AtomicBool>,
    welcome: Arc<Mutex<Welcome>>,
    thread: JoinHandle<()>,
}

impl Newcomers {
    /// Each makes a session, feels one command in it and one in the session `shared`, and deletes its own. Who is not
    /// done within `patience` gives up.
    pub fn start(caller: TestCaller, shared: String, patience: Duration) -> Self {
        let (over, welcome) = (Arc::new(AtomicBool::new(false)), Arc::new(Mutex::new(Welcome::default())));
        let thread = std::thread::spawn({
            let (over, welcome) = (over.clone(), welcome.clone());
            move || {
                alone(async {
                    loop {
                        round(&caller, &shared, patience, &welcome).await;
                        if over.load(Ordering::Relaxed) {
                            return;
                        }
                        tokio::time::sleep(Duration::from_millis(300)).await;
                    }
                });
            }
        });
        Newcomers { over, welcome, thread }
    }

    /// Returns their record since the last call.
    pub fn take(&self) -> Welcome {
        self.welcome.lock().unwrap().take()
    }

    /// No more of them; how the last fared. There was one at least.
    pub fn end(self) -> Welcome {
        self.over.store(true, Ordering::Relaxed);
        self.thread.join().unwrap();
        self.welcome.lock().unwrap().take()
    }
}

/// One newcomer, kept account of.
async fn round(caller: &TestCaller, shared: &str, patience: Duration, welcome: &Mutex<Welcome>) {
    let begun = Instant::now();
    {
        let mut welcome = welcome.lock().unwrap();
        welcome.rounds += 1;
        welcome.waiting = Some(begun);
    }
    let served = tokio::time::timeout(patience, newcomer(caller, shared)).await;
    let served = served.unwrap_or_else(|_| Err(Status::deadline_exceeded("no answer")));
    let mut welcome = welcome.lock().unwrap();
    welcome.waiting = None;
    welcome.slowest = welcome.slowest.max(begun.elapsed());
    match served {
        Ok(()) => welcome.served += 1,
        Err(error) => *welcome.reasons.entry(why(&error)).or_default() += 1,
    }
}

async fn newcomer(caller: &TestCaller, shared: &str) -> Result<(), Status> {
    let door = caller.door().await?;
    let session_id = create(&door, sheet(SIDE, SIDE), false).await?;
    let own = feel(&door, &session_id).await;
    let other = feel(&door, shared).await;
    sessions(&door).delete_session(pb::DeleteSessionRequest { session_id }).await?;
    own.and(other)
}

/// One command, and the sample that answers it.
async fn feel(door: &Door, session_id: &str) -> Result<(), Status> {
    let (say, mut inbound) = open(door, session_id, &[GUEST]).await?;
    let command = push(GUEST, 1, MIDDLE, -0.1);
    let _ = say.send(pb::TouchRequest { message: Some(Say::Command(command)) });
    loop {
        match inbound.message().await?.and_then(|heard| heard.message) {
            Some(Heard::Sample(sample)) if sample.tools.iter().any(|told| told.acknowledged_sequence > 0) => {
                return Ok(());
            }
            Some(Heard::Rejection(rejection)) => return Err(Status::aborted(rejection.reason)),
            Some(_) => {}
            None => return Err(Status::unavailable("the server ended the stream")),
        }
    }
}
