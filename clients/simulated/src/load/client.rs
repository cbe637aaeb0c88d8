//! One client of a load test: it strokes the tissue with a command at each tick and counts the answers.

use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use glam::DVec3;
use palpate_client::{Channel, Touch, describe};
use palpate_proto::pb;
use pb::touch_request::Message as Say;
use pb::touch_response::Message as Heard;
use tokio::sync::watch;
use tokio_stream::StreamExt;
use tokio_stream::wrappers::WatchStream;

use super::stroke::Stroke;
use super::tally::Tally;
use super::tip::{self, HeldTool, Lead};

pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Stage of a load test, and the time when the measurement ended, ns.
pub(crate) struct LoadStage(AtomicU8, AtomicU64);

impl LoadStage {
    /// Sessions and clients start; nothing is counted yet.
    pub(crate) const RAMP: u8 = 0;
    pub(crate) const MEASURE: u8 = 1;
    /// Clients send nothing more and wait for outstanding answers.
    pub(crate) const DRAIN: u8 = 2;

    pub(crate) fn new() -> Self {
        LoadStage(AtomicU8::new(LoadStage::RAMP), AtomicU64::new(0))
    }

    pub(crate) fn measure(&self) {
        self.0.store(LoadStage::MEASURE, Ordering::Release);
    }

    pub(crate) fn drain(&self, now_ns: u64) {
        self.1.store(now_ns, Ordering::Release);
        self.0.store(LoadStage::DRAIN, Ordering::Release);
    }

    pub(crate) fn is(&self, stage: u8) -> bool {
        self.0.load(Ordering::Acquire) == stage
    }
}

/// State that all clients and viewers of a user share.
#[derive(Clone)]
pub(crate) struct Common {
    pub(crate) clock: Instant,
    pub(crate) stage: Arc<LoadStage>,
    pub(crate) tally: Arc<Mutex<Tally>>,
    /// Commands per second.
    pub(crate) rate_hz: f64,
    /// Present if clients lead tools with a tip.
    pub(crate) touches: Option<Lead>,
}

impl Common {
    #[allow(clippy::cast_possible_truncation)]
    pub(crate) fn now_ns(&self) -> u64 {
        self.clock.elapsed().as_nanos() as u64
    }
}

/// Number of commands whose send times are kept.
const OUTSTANDING: usize = 4096;

/// The commands that a client has sent, with their times.
struct Sent {
    /// Sequence number of the newest; the first has 1.
    sequence: u64,
    at_ns: Box<[u64; OUTSTANDING]>,
    /// Newest sequence number that a sample acknowledged.
    acknowledged: u64,
    last_tick: Option<u64>,
    is_open: bool,
    /// What a client leads by poses, and the command that a sample acknowledged last, with its
    /// time, ns.
    led: Option<HeldTool>,
    newest: (u64, u64),
}

impl Sent {
    #[allow(clippy::cast_possible_truncation)]
    fn at(&mut self, sequence: u64) -> &mut u64 {
        &mut self.at_ns[sequence as usize % OUTSTANDING]
    }

    /// Returns the number of commands that were neither acknowledged nor rejected.
    fn outstanding(&mut self) -> u64 {
        let (from, to) = (self.acknowledged + 1, self.sequence);
        // Commands older than those kept count as outstanding.
        let kept = from.max(to.saturating_sub(OUTSTANDING as u64 - 1));
        (kept - from) + (kept..=to).filter(|sequence| *self.at(*sequence) > 0).count() as u64
    }
}

/// Steps of a session, and the times when samples of them arrived.
#[derive(Default)]
struct Heartbeat {
    /// Server's time, ns, and step of the first and the last sample within the measurement.
    first: Option<(u64, u64)>,
    last: (u64, u64),
    last_arrival_ns: u64,
    /// Server's time, ns, and step at which the present second of the measurement began.
    second: Option<(u64, u64)>,
    /// Samples that were dropped before the measurement.
    dropped_before: Option<u64>,
    dropped: u64,
}

/// Arrival times of a session's samples, from which the age of its frames follows.
pub(crate) struct SampleTimes(Box<[(u64, u64); OUTSTANDING]>);

impl SampleTimes {
    pub(crate) fn new() -> Self {
        SampleTimes(Box::new([(0, 0); OUTSTANDING]))
    }

    #[allow(clippy::cast_possible_truncation)]
    fn note(&mut self, step: u64, arrival_ns: u64) {
        self.0[step as usize % OUTSTANDING] = (step, arrival_ns);
    }

    #[allow(clippy::cast_possible_truncation)]
    pub(crate) fn of(&self, step: u64) -> Option<u64> {
        let (noted, arrival_ns) = self.0[step as usize % OUTSTANDING];
        (noted == step && arrival_ns > 0).then_some(arrival_ns)
    }
}

/// A client with its own tool.
pub(crate) struct Client {
    pub(crate) common: Common,
    pub(crate) session_id: String,
    pub(crate) tool: u32,
    pub(crate) rate_hz: f64,
    pub(crate) stroke: Stroke,
    /// Seed of the movements of its hand.
    pub(crate) seed: u64,
    /// Centre of the tissue, m.
    pub(crate) middle_m: DVec3,
    /// Present if the session has viewers.
    pub(crate) sample_times: Option<Arc<Mutex<SampleTimes>>>,
}

/// Longest time for which a client waits for outstanding answers.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(2);

/// Silence at the end of the measurement beyond which a session counts as stopped, ns.
const SILENCE_NS: u64 = 50_000_000;

/// A second, ns.
const SECOND_NS: u64 = 1_000_000_000;

impl Client {
    /// Opens the stream; the client sends at each change of `ticks`. Returns a future that runs the client to its end.
    pub(crate) async fn open(
        self,
        channel: Channel,
        ticks: watch::Receiver<u64>,
    ) -> Result<impl Future<Output = ()>, tonic::Status> {
        let open = pb::TouchOpen {
            session_id: self.session_id.clone(),
            tools: vec![self.tool],
            lease_s: Some(10.0),
            holder: format!("palpate-client load {}", self.tool),
            ..Default::default()
        };
        let touches = self.common.touches;
        if touches.is_some_and(|lead| lead.hand.is_none()) && self.stroke.place_m(0.0).is_none() {
            return Err(tonic::Status::invalid_argument("--touch is for sheets: the points of this scene are no grid"));
        }
        let open = touches.map_or(open.clone(), |lead| tip::opening(open, &lead));
        let at_ns = Box::new([0; OUTSTANDING]);
        let sent =
            Sent { sequence: 0, at_ns, acknowledged: 0, last_tick: None, is_open: false, led: None, newest: (0, 0) };
        let sent = Arc::new(Mutex::new(sent));
        let commands = {
            let (sent, common, stroke, tool) = (sent.clone(), self.common.clone(), self.stroke.clone(), self.tool);
            WatchStream::from_changes(ticks).filter_map(move |tick| command(&common, &stroke, tool, &sent, tick))
        };
        let inbound = Touch::open(channel, open, commands.map(Say::Command)).await?;
        {
            let mut sent = lock(&sent);
            sent.led = touches.and_then(|lead| HeldTool::new(inbound.opened(), &lead, self.seed, self.middle_m));
            if touches.is_some() && sent.led.is_none() {
                return Err(tonic::Status::failed_precondition("the server sent no force law for --touch"));
            }
            sent.is_open = true;
        }
        Ok(self.listen(inbound, sent))
    }

    async fn listen(self, mut inbound: Touch, sent: Arc<Mutex<Sent>>) {
        let mut heartbeat = Heartbeat::default();
        let mut drained = std::pin::pin!(self.drained(&sent));
        loop {
            let message = tokio::select! {
                biased;
                message = inbound.next() => message,
                () = &mut drained => break,
            };
            match message {
                Ok(Some(Heard::Sample(sample))) => {
                    self.sample(&sample, &mut heartbeat, &mut lock(&sent));
                }
                Ok(Some(Heard::Rejection(rejection))) => {
                    // A rejected command never acts, so a later acknowledgement does not count for it.
                    *lock(&sent).at(rejection.sequence) = 0;
                    *lock(&self.common.tally).rejected.entry(rejection.reason).or_default() += 1;
                }
                Ok(Some(Heard::ForceLaw(update))) => {
                    lock(&sent).led.iter_mut().for_each(|led| led.learn(&update));
                }
                Ok(Some(_)) => {}
                Ok(None) => break lock(&self.common.tally).broke("the server ended a stream".to_owned()),
                Err(status) => break lock(&self.common.tally).broke(describe(&status)),
            }
        }
        let mut tally = lock(&self.common.tally);
        tally.lost_commands += lock(&sent).outstanding();
        tally.lost_samples += heartbeat.dropped - heartbeat.dropped_before.unwrap_or(heartbeat.dropped);
        tally.dilation_min = tally.dilation_min.min(heartbeat.dilation(self.rate_hz, &self.common.stage));
    }

    /// Completes when no answer is outstanding, or [`ANSWER_TIMEOUT`] has passed since the measurement ended.
    async fn drained(&self, sent: &Mutex<Sent>) {
        let mut begun: Option<Instant> = None;
        loop {
            tokio::time::sleep(Duration::from_millis(100)).await;
            if self.common.stage.is(LoadStage::DRAIN) {
                let begun = *begun.get_or_insert_with(Instant::now);
                if lock(sent).outstanding() == 0 || begun.elapsed() > ANSWER_TIMEOUT {
                    return;
                }
            }
        }
    }

    fn sample(&self, sample: &pb::Sample, heartbeat: &mut Heartbeat, sent: &mut Sent) {
        let now_ns = self.common.now_ns();
        if let Some(sample_times) = &self.sample_times {
            lock(sample_times).note(sample.step, now_ns);
        }
        let acknowledged = sample.tools.first().map_or(0, |tool| tool.acknowledged_sequence);
        let measures = self.common.stage.is(LoadStage::MEASURE);
        let mut tally = measures.then(|| lock(&self.common.tally));
        for sequence in sent.acknowledged + 1..=acknowledged.min(sent.sequence) {
            let at_ns = std::mem::take(sent.at(sequence));
            sent.newest = (sequence, at_ns);
            if let Some(tally) = tally.as_mut().filter(|_| at_ns > 0 && sent.led.is_none()) {
                tally.round_trip_ns.saturating_record(now_ns.saturating_sub(at_ns));
            }
        }
        if let Some(led) = &mut sent.led {
            led.hear(sample, now_ns as f64 * 1e-9);
            // Samples that change little are not sent, so only those that are sent are measured. The wait for a step
            // is by design and is subtracted.
            let waited_ns = sample.tools.first().map_or(0, |tool| tool.step_wait_ns);
            if let Some(tally) = tally.as_mut().filter(|_| sent.newest.0 == acknowledged && sent.newest.1 > 0) {
                tally.round_trip_ns.saturating_record(now_ns.saturating_sub(sent.newest.1 + waited_ns));
            }
        }
        sent.acknowledged = sent.acknowledged.max(acknowledged);
        if let Some(tally) = &mut tally {
            if heartbeat.first.is_some() {
                tally.sample_gap_ns.saturating_record(now_ns - heartbeat.last_arrival_ns);
            }
            let (from_ns, from_step) = *heartbeat.second.get_or_insert((sample.server_time_ns, sample.step));
            let passed_ns = sample.server_time_ns.saturating_sub(from_ns);
            if passed_ns >= SECOND_NS {
                #[allow(clippy::cast_precision_loss)]
                let simulated_s = sample.step.saturating_sub(from_step) as f64 / self.rate_hz;
                tally.dilation_s_min = tally.dilation_s_min.min(simulated_s / (passed_ns as f64 * 1e-9));
                heartbeat.second = Some((sample.server_time_ns, sample.step));
            }
            tally.samples += 1;
            tally.awake_points += u64::from(sample.awake_points);
            heartbeat.first.get_or_insert((sample.server_time_ns, sample.step));
            heartbeat.dropped_before.get_or_insert(sample.dropped_samples);
            heartbeat.last = (sample.server_time_ns, sample.step);
            heartbeat.last_arrival_ns = now_ns;
        }
        heartbeat.dropped = sample.dropped_samples;
    }
}

impl Heartbeat {
    /// Returns simulated time over real time: by the server's clock, plus this client's clock for a long silence at
    /// the end.
    #[allow(clippy::cast_precision_loss)]
    fn dilation(&self, rate_hz: f64, stage: &LoadStage) -> f64 {
        let Some(first) = self.first else { return 0.0 };
        let silent_ns = stage.1.load(Ordering::Acquire).saturating_sub(self.last_arrival_ns);
        let silent_ns = if silent_ns > SILENCE_NS { silent_ns } else { 0 };
        let real_s = (self.last.0 - first.0 + silent_ns) as f64 * 1e-9;
        if real_s > 0.0 { (self.last.1 - first.1) as f64 / rate_hz / real_s } else { 0.0 }
    }
}

/// Returns the command of a tick; `None` before the stream is open and after the measurement.
fn command(common: &Common, stroke: &Stroke, tool: u32, sent: &Mutex<Sent>, tick: u64) -> Option<pb::Command> {
    let mut sent = lock(sent);
    let missed = sent.last_tick.replace(tick).map_or(0, |last| tick - last - 1);
    if !sent.is_open || common.stage.is(LoadStage::DRAIN) {
        return None;
    }
    #[allow(clippy::cast_precision_loss)]
    let time_s = tick as f64 / common.rate_hz;
    let now_ns = common.now_ns();
    let action = match &mut sent.led {
        Some(led) => led.tick(stroke, time_s, now_ns as f64 * 1e-9)?,
        None => stroke.at(time_s),
    };
    sent.sequence += 1;
    let sequence = sent.sequence;
    *sent.at(sequence) = now_ns;
    if common.stage.is(LoadStage::MEASURE) {
        let mut tally = lock(&common.tally);
        tally.commands += 1;
        tally.unsent += missed;
    }
    let action = Some(action);
    let (sequence, client_time_ns) = (Some(sequence), now_ns);
    Some(pb::Command { tool, sequence, client_time_ns, action, ..Default::default() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dilation_is_simulated_over_real_time_and_silence_counts() {
        let stage = LoadStage::new();
        stage.drain(4_000_000_000);
        let heartbeat = |last_arrival_ns: u64| Heartbeat {
            first: Some((1_000_000_000, 500)),
            last: (3_000_000_000, 2000),
            last_arrival_ns,
            ..Heartbeat::default()
        };
        // 1500 steps in 2 s; and the session was silent for two more.
        assert!((heartbeat(4_000_000_000).dilation(1000.0, &stage) - 0.75).abs() < 1e-12);
        assert!((heartbeat(2_000_000_000).dilation(1000.0, &stage) - 0.375).abs() < 1e-12);
        assert!((heartbeat(4_000_000_000).dilation(500.0, &stage) - 1.5).abs() < 1e-12);
        assert!(Heartbeat::default().dilation(1000.0, &stage).abs() < 1e-12);
    }
}
