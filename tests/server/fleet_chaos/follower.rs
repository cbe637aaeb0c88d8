//! Clients that follow their sessions from server to server: one that presses at 1 kHz, one that looks. They keep
//! account of the server of a session over time, and of what it sent.
#![allow(unreachable_pub)]

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use palpate_proto::pb;
use palpate_refusal::status::elsewhere;
use pb::haptic_service_client::HapticServiceClient;
use pb::session_service_client::SessionServiceClient;
use pb::touch_request::Message as Say;
use pb::touch_response::Message as Heard;
use pb::view_service_client::ViewServiceClient;
use tokio::sync::mpsc;
use tokio::task::{JoinHandle, JoinSet};
use tokio::time::timeout;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;
use tonic::transport::Channel;

use crate::common::fleet::Node;
use crate::common::server::{force, open};

/// Silence after which a client leaves a server: samples come at least every 50 ms.
const SILENCE: Duration = Duration::from_millis(500);

/// Time between two questions to a server that has no answer.
const AGAIN: Duration = Duration::from_millis(20);

/// Time for which a server that was left because of its silence is not tried again, unless the session has another
/// revision.
const SHY: Duration = Duration::from_secs(1);

/// The clocks of streams are compared as well as this: by the fastest message of each.
const CLOCK_S: f64 = 0.1;

/// Connections to all servers of a fleet. They are made anew when they break.
pub struct Doors {
    urls: Vec<String>,
    channels: Vec<Channel>,
    begun: Instant,
}

impl Doors {
    pub fn of(nodes: &[Node]) -> Arc<Self> {
        let urls: Vec<String> = nodes.iter().map(|node| node.url.clone()).collect();
        let channel = |url: &String| {
            let endpoint = Channel::from_shared(url.clone()).unwrap();
            endpoint.connect_timeout(Duration::from_millis(300)).connect_lazy()
        };
        Arc::new(Doors { channels: urls.iter().map(channel).collect(), urls, begun: Instant::now() })
    }

    /// Returns the server of a session and its revision, from the first server that knows.
    async fn locate(&self, id: &str) -> (usize, u64) {
        let mut asking = JoinSet::new();
        for channel in &self.channels {
            let (mut sessions, session_id) = (SessionServiceClient::new(channel.clone()), id.to_owned());
            asking.spawn(async move {
                loop {
                    let request = pb::LocateSessionRequest { session_id: session_id.clone() };
                    if let Ok(Ok(answer)) = timeout(SILENCE, sessions.locate_session(request)).await
                        && let Some(ownership) = answer.into_inner().ownership
                    {
                        return ownership;
                    }
                    tokio::time::sleep(AGAIN).await;
                }
            });
        }
        loop {
            let told = asking.join_next().await.unwrap().unwrap();
            if let Some(at) = self.urls.iter().position(|url| *url == told.endpoint) {
                return (at, told.revision);
            }
            // All that know have said something else.
            if asking.is_empty() {
                return Box::pin(self.locate(id)).await;
            }
        }
    }

    /// A moment, s after these were made.
    pub fn seconds(&self, moment: Instant) -> f64 {
        moment.saturating_duration_since(self.begun).as_secs_f64()
    }
}

/// What was said for a session under one revision.
#[derive(Debug, Clone)]
pub struct Spoken {
    pub node: usize,
    /// When, by the server's clock, s after the doors were made.
    pub first_s: f64,
    pub last_s: f64,
}

/// An interruption of touch that is over.
#[derive(Debug, Clone, Copy)]
pub struct Return {
    pub node: usize,
    pub revision: u64,
    /// The newest sample before, and the first after.
    pub last: Instant,
    pub first: Instant,
    /// The first sample in which the tool does what was commanded after the interruption.
    pub acts: Instant,
    /// From the newest sample before to the first after.
    pub change_n: f64,
    pub step: u64,
}

/// What a client has seen.
#[derive(Debug, Clone, Default)]
pub struct FollowerObservation {
    pub spoken: BTreeMap<u64, Spoken>,
    /// The same for each stream by itself.
    pub stretches: Vec<Spoken>,
    pub durable_step: u64,
    /// The newest step of all samples.
    pub newest_step: u64,
    /// The newest sample in which the tool follows its command.
    pub newest: Option<Instant>,
    pub returns: Vec<Return>,
    /// Samples of a revision older than one that was seen: on their way while the session went elsewhere.
    pub older: u64,
    pub longest_silence: Duration,
    /// Between two samples of steps that follow each other, on one stream.
    pub steady_change_n: f64,
    pub faults: Vec<String>,
}

impl FollowerObservation {
    fn says(&mut self, revision: u64, words: Spoken) {
        self.stretches.push(words.clone());
        if let Some(known) = self.spoken.get_mut(&revision) {
            if known.node != words.node {
                self.faults.push(format!("{} and {} speak at revision {revision}", known.node, words.node));
            }
            known.first_s = known.first_s.min(words.first_s);
            known.last_s = known.last_s.max(words.last_s);
        } else {
            self.spoken.insert(revision, words);
        }
    }

    /// Whatever was said by a server was said before the next one spoke.
    pub fn check(&self) {
        assert!(self.faults.is_empty(), "{:?}", self.faults);
        let spoken: Vec<_> = self.spoken.iter().collect();
        for pair in spoken.windows(2) {
            let [(_, before), (_, after)] = pair else { unreachable!() };
            let in_turn = before.node == after.node || before.last_s < after.first_s + CLOCK_S;
            assert!(in_turn, "two servers at once: {pair:?}");
        }
    }
}

/// A client at work.
pub struct Follower {
    pub id: String,
    seen: Arc<Mutex<FollowerObservation>>,
    over: Arc<AtomicBool>,
    task: JoinHandle<()>,
}

impl Follower {
    /// Presses at 1 kHz, and gets a sample every so many steps.
    pub fn start(doors: &Arc<Doors>, id: &str, every: u32) -> Self {
        let (seen, over, id) =
            (Arc::new(Mutex::new(FollowerObservation::default())), Arc::new(AtomicBool::new(false)), id.to_owned());
        let (doors, told) = (doors.clone(), (seen.clone(), over.clone()));
        let press = Press { doors, id: id.clone(), every, seen: told.0, over: told.1, last: None };
        Follower { id, seen, over, task: tokio::spawn(press.follow()) }
    }

    pub fn seen(&self) -> FollowerObservation {
        self.seen.lock().unwrap().clone()
    }

    /// Counts silence from now on.
    pub fn forget_silence(&self) {
        self.seen.lock().unwrap().longest_silence = Duration::ZERO;
    }

    /// Returns whether its tool has followed its commands recently.
    pub fn acts(&self) -> bool {
        self.seen.lock().unwrap().newest.is_some_and(|newest| newest.elapsed() < SILENCE)
    }

    /// The first return after a moment.
    pub fn back_since(&self, moment: Instant) -> Option<Return> {
        self.seen.lock().unwrap().returns.iter().find(|back| back.acts > moment).copied()
    }

    /// Stops. Returns what it has seen.
    pub async fn end(mut self) -> FollowerObservation {
        self.over.store(true, Ordering::Relaxed);
        if timeout(2 * SILENCE, &mut self.task).await.is_err() {
            // Nobody has its session.
            self.task.abort();
        }
        self.seen.lock().unwrap().clone()
    }
}

/// Why a stream was left.
enum Left {
    Silent,
    Ended(Option<Status>),
}

struct Press {
    doors: Arc<Doors>,
    id: String,
    every: u32,
    seen: Arc<Mutex<FollowerObservation>>,
    over: Arc<AtomicBool>,
    /// The newest sample: when, and the force.
    last: Option<(Instant, [f64; 3])>,
}

/// Content of a stream under one revision, by its own clock.
struct Words {
    revision: u64,
    first_ns: u64,
    last_ns: u64,
}

impl Press {
    async fn follow(mut self) {
        let (mut sequence, mut lease_id) = (0, String::new());
        let mut left: Option<(usize, u64, Instant)> = None;
        let mut sent_to = None;
        while !self.over.load(Ordering::Relaxed) {
            let (at, revision) = match sent_to.take() {
                Some(at) => (at, 0),
                None => self.doors.locate(&self.id).await,
            };
            if left.is_some_and(|left| (left.0, left.1) == (at, revision) && left.2.elapsed() < SHY) {
                tokio::time::sleep(AGAIN).await;
                continue;
            }
            left = None;
            match self.visit(at, &mut sequence, &mut lease_id).await {
                Left::Silent => {
                    left = Some((at, revision, Instant::now()));
                    lease_id.clear();
                }
                Left::Ended(Some(status)) if elsewhere(&status).is_some() => {
                    sent_to = elsewhere(&status).and_then(|url| self.doors.urls.iter().position(|own| *own == url));
                }
                Left::Ended(_) => {
                    lease_id.clear();
                    tokio::time::sleep(AGAIN / 4).await;
                }
            }
        }
    }

    /// One stream, to its end.
    async fn visit(&mut self, at: usize, sequence: &mut u64, lease_id: &mut String) -> Left {
        let mut haptics = HapticServiceClient::new(self.doors.channels[at].clone());
        let (say, said) = mpsc::channel(64);
        let handed = std::mem::take(lease_id);
        let open = pb::TouchOpen {
            sample_every_steps: Some(self.every),
            lease_s: Some(0.5),
            lease_id: handed,
            ..open(&self.id, &[0])
        };
        let message = |message| pb::TouchRequest { message: Some(message) };
        let _ = say.try_send(message(Say::Open(open)));
        let mut inbound = match timeout(SILENCE, haptics.touch(ReceiverStream::new(said))).await {
            Ok(Ok(opened)) => opened.into_inner(),
            Ok(Err(status)) => return Left::Ended(Some(status)),
            Err(_) => return Left::Silent,
        };
        let first_sequence = *sequence + 1;
        let mut ticks = tokio::time::interval(Duration::from_millis(1));
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
        let (mut words, mut fastest_s) = (Vec::<Words>::new(), f64::INFINITY);
        let mut back: Option<Return> = None;
        let mut before = self.last;
        let mut newest: Option<(u64, [f64; 3])> = None;
        let silence = tokio::time::sleep(SILENCE);
        tokio::pin!(silence);
        let end = loop {
            let heard = tokio::select! {
                heard = inbound.message() => heard,
                _ = ticks.tick() => {
                    if self.over.load(Ordering::Relaxed) {
                        break Left::Ended(None);
                    }
                    *sequence += 1;
                    // A bounded queue is full because the server does not read; its silence shows that.
                    let _ = say.try_send(message(Say::Command(force(0, *sequence, pressure_n(*sequence)))));
                    continue;
                }
                () = &mut silence => break Left::Silent,
            };
            silence.as_mut().reset(tokio::time::Instant::now() + SILENCE);
            let sample = match heard {
                Ok(Some(pb::TouchResponse { message: Some(Heard::Sample(sample)) })) => sample,
                Ok(Some(pb::TouchResponse { message: Some(Heard::Opened(opened)) })) => {
                    *lease_id = opened.lease_id;
                    continue;
                }
                Ok(Some(_)) => continue,
                Ok(None) => break Left::Ended(None),
                Err(status) => break Left::Ended(Some(status)),
            };
            let now = Instant::now();
            #[allow(clippy::cast_precision_loss)]
            let sent_s = sample.server_time_ns as f64 * 1e-9;
            fastest_s = fastest_s.min(self.doors.seconds(now) - sent_s);
            let revision = sample.ownership_revision;
            match words.last_mut() {
                Some(last) if last.revision == revision => last.last_ns = sample.server_time_ns,
                _ => words.push(Words { revision, first_ns: sample.server_time_ns, last_ns: sample.server_time_ns }),
            }
            let mut seen = self.seen.lock().unwrap();
            if seen.spoken.last_key_value().is_some_and(|newest| revision < *newest.0) {
                seen.older += 1;
                continue;
            }
            seen.durable_step = seen.durable_step.max(sample.durable_step.unwrap_or_default());
            seen.newest_step = sample.step;
            let Some(tool) = sample.tools.first() else { continue };
            let force_n = tool.force_on_tool_n.map_or([0.0; 3], |force| [force.x, force.y, force.z]);
            if let Some((step, before_n)) = newest
                && step + 1 == sample.step
            {
                seen.steady_change_n = seen.steady_change_n.max(distance(before_n, force_n));
            }
            newest = Some((sample.step, force_n));
            if let Some((last, before_n)) = before.take() {
                let change_n = distance(before_n, force_n);
                back = Some(Return { node: at, revision, last, first: now, acts: now, change_n, step: sample.step });
            }
            if let Some(last) = self.last {
                seen.longest_silence = seen.longest_silence.max(now - last.0);
            }
            self.last = Some((now, force_n));
            if tool.acknowledged_sequence >= first_sequence {
                seen.returns.extend(back.take().map(|back| Return { acts: now, ..back }));
                seen.newest = Some(now);
            }
        };
        #[allow(clippy::cast_precision_loss)]
        let seconds = |ns: u64| ns as f64 * 1e-9 + fastest_s;
        let mut seen = self.seen.lock().unwrap();
        for Words { revision, first_ns, last_ns } in words {
            let (first_s, last_s) = (seconds(first_ns), seconds(last_ns));
            seen.says(revision, Spoken { node: at, first_s, last_s });
        }
        drop(seen);
        end
    }
}

/// What is pressed with: it never stands still, so that the tissue does not rest.
#[allow(clippy::cast_precision_loss)]
fn pressure_n(sequence: u64) -> f64 {
    -0.1 - 0.05 * (sequence as f64 * 0.005).sin()
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
}

/// Somebody who looks at a session, wherever it is.
pub struct FollowingViewer {
    newest: Arc<Mutex<Option<(Instant, usize)>>>,
    task: JoinHandle<()>,
}

impl FollowingViewer {
    pub fn start(doors: &Arc<Doors>, id: &str) -> Self {
        let newest = Arc::new(Mutex::new(None));
        let (doors, id, told) = (doors.clone(), id.to_owned(), newest.clone());
        let task = tokio::spawn(async move {
            loop {
                let (at, _) = doors.locate(&id).await;
                let mut views = ViewServiceClient::new(doors.channels[at].clone());
                let request =
                    pb::WatchFramesRequest { session_id: id.clone(), rate_hz: Some(30.0), ..Default::default() };
                if let Ok(Ok(frames)) = timeout(SILENCE, views.watch_frames(request)).await {
                    let mut frames = frames.into_inner();
                    while let Ok(Ok(Some(_))) = timeout(2 * SILENCE, frames.message()).await {
                        *told.lock().unwrap() = Some((Instant::now(), at));
                    }
                }
                tokio::time::sleep(AGAIN).await;
            }
        });
        FollowingViewer { newest, task }
    }

    /// The server that has shown the session since a moment.
    pub fn shown_since(&self, moment: Instant) -> Option<usize> {
        self.newest.lock().unwrap().filter(|newest| newest.0 > moment).map(|newest| newest.1)
    }
}

impl Drop for FollowingViewer {
    fn drop(&mut self) {
        self.task.abort();
    }
}
