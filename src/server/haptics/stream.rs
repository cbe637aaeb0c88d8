//! The haptic stream: opens it, and reads what its client sends.

use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use futures_util::stream::Stream;
use palpate_haptics::datagram_health::LIFE_S;
use palpate_haptics::device::UNDECLARED_FORCE_N;
use palpate_proto::{pb, touch};
use tokio::sync::{oneshot, watch};
use tokio::time::{Interval, MissedTickBehavior};
use tokio_util::task::AbortOnDropHandle;
use tonic::{Status, Streaming};
use tracing::{Instrument, debug, info};

use super::event::StreamEvent;
use super::instruments::instruments;
use super::lease_controller::LeaseController;
use super::pending_messages::PendingMessages;
use super::response_stream::ResponseStream;
use super::tools::charges;
use crate::server::datagrams::{Arrival, DatagramChannel};
use crate::server::force_law::{Computing, Updates};
use crate::server::recovered::Notices;
use crate::server::services::Services;
use crate::server::session_instruments::{Instruments, JoinedInstruments};
use palpate_realtime::clock::now_ns;
use palpate_realtime::ids::random_bits;
use palpate_realtime::queue::{Reader, Writer, queue};
use palpate_realtime::{StreamGuard, StreamKind};
use palpate_refusal::{Reason, Refusal};
use palpate_session::budget::Account;
use palpate_session::current_laws::{FIRST, Laws};
use palpate_session::sample_selection::PacedSample;
use palpate_session::wire;
use palpate_tissue::Model;
use palpate_tissue::scene::action_check::check_tip;

/// What the output of a haptic stream starts with.
struct Opened {
    answer: pb::TouchOpened,
    /// Later updates of the force law, if the stream has one.
    updates: Option<Updates>,
    samples: Reader<PacedSample>,
    notices: Notices,
    guard: StreamGuard,
    channel: Arc<DatagramChannel>,
    instruments: JoinedInstruments,
}

/// The tools of a stream, released when it ends for any reason.
struct StreamTools {
    tools: usize,
    controller: LeaseController,
    channel: Arc<DatagramChannel>,
    /// If the client wants datagrams: when a session was last offered, ns, and the offered session until it arrives.
    offered_ns: Option<u64>,
    arrival: Option<Arrival>,
    /// The tissue, if the client is told of its changes although it has no force law.
    tissue: Option<watch::Receiver<(u64, Arc<Model>)>>,
    /// Computes further laws while the stream is open.
    _computing: Option<AbortOnDropHandle<()>>,
}

/// Minimum time between two offers of datagrams to a stream, ns.
const BETWEEN_OFFERS_NS: u64 = 1_000_000_000;

impl StreamTools {
    /// Offers another datagram session, which replaces the current one. `None` too soon after the last offer, or if
    /// none is available.
    fn offer(&mut self, services: &Services, now_ns: u64) -> Option<pb::DatagramOffer> {
        self.offered_ns.filter(|before_ns| now_ns.saturating_sub(*before_ns) >= BETWEEN_OFFERS_NS)?;
        // Without random numbers there is no ticket, and the stream continues.
        let (offer, arrival) = services.datagrams.offer().ok().flatten()?;
        self.channel.part();
        (self.offered_ns, self.arrival) = (Some(now_ns), Some(arrival));
        Some(offer)
    }
}

impl Drop for StreamTools {
    fn drop(&mut self) {
        if self.tools > 0 {
            // An expired lease has nothing to release.
            let _ = self.controller.handle.at_intake(|intake, _| intake.release(self.controller.lease));
        }
    }
}

/// Ticks while a stream has datagrams to keep alive.
pub(super) struct KeepaliveTimer(Option<Interval>);

impl KeepaliveTimer {
    pub(super) fn of(has_datagrams: bool) -> Self {
        KeepaliveTimer(has_datagrams.then(|| {
            let mut interval = tokio::time::interval(Duration::from_secs_f64(0.5 * LIFE_S));
            interval.set_missed_tick_behavior(MissedTickBehavior::Delay);
            interval
        }))
    }

    pub(super) async fn tick(&mut self) {
        match &mut self.0 {
            Some(interval) => drop(interval.tick().await),
            None => std::future::pending().await,
        }
    }
}

/// Handles the first message of a haptic stream: checks it, computes the first law and acquires the tools.
async fn begin(services: &Services, open: &pb::TouchOpen, account: &Account) -> Result<(Opened, StreamTools), Status> {
    let seat = services.seat("Touch", &open.session_id).await?;
    let handle = seat.handle.clone();
    let device = open.device.as_ref().map(touch::from_device).transpose()?;
    let tip = touch::from_tip("tip", open.tip.as_ref())?;
    // A stream that neither renders nor declares a tip may push with forces on any tissue.
    if device.is_some() || open.tip.is_some() {
        check_tip("tip", handle.model.shape(), &tip)?;
    }
    let instruments: Instruments = Arc::new(Mutex::new(instruments(open, handle.model.shape())?));
    let only = (!open.tools.is_empty()).then(|| open.tools.clone());
    let (every, deadband) = (open.sample_every_steps, open.deadband.as_ref());
    let mut sampling = wire::sample::sampling(every, only, deadband, open.heartbeat_s, device.is_some())?;
    if open.touch_stiffness && device.is_none() {
        let message = "is missing: touch_stiffness belongs to its local models";
        return Err(Refusal::new(Reason::Missing, "device", message).into());
    }
    sampling.touch_stiffness = open.touch_stiffness;
    sampling.other_tools = open.other_tools;
    let kind = if open.tools.is_empty() { StreamKind::ReadsOnly } else { StreamKind::HoldsTools };
    let guard = handle.open_stream("Touch", kind, account)?;
    let begun = match device {
        Some(_) => Some(Computing::begin(&services.job_pool, account, &seat, tip).await?),
        None => None,
    };
    let (law, computing) = begun.unzip();
    let laws = law.clone().map(|law| Arc::new(Laws::new(law)));
    sampling.laws.clone_from(&laws);
    let lease_s = open.lease_s.unwrap_or(services.config.lease_s);
    let goes_on = !open.lease_id.is_empty() && !open.tools.is_empty();
    let lease = if goes_on { super::tools::lease_id(&open.lease_id)? } else { random_bits()? };
    let charges = charges(account, open.tools.len())?;
    let step = handle.at_intake(|intake, now| {
        if goes_on {
            intake.renew(lease, now)?;
            if !open.tools.iter().all(|tool| intake.tools_of(lease).any(|held| held == *tool)) {
                let message = "is not the lease of these tools";
                return Err(Refusal::new(Reason::NotHolder, "lease_id", message));
            }
        } else {
            intake.acquire(&open.tools, &open.holder, lease_s, lease, now)?;
        }
        intake.charge(lease, charges);
        Ok::<_, Refusal>(intake.next_step())
    })?;
    let led = open.tools.first().copied();
    let (updates, _computing) = computing.zip(laws).map(|(computing, laws)| computing.go_on(laws, led)).unzip();
    let tissue = (!open.instruments.is_empty() && open.device.is_none()).then(|| handle.tissue());
    // The tools are held from here on: any failure below releases them.
    let tools = open.tools.len();
    let (limits, traffic) = (&services.config.limits, services.traffic.clone());
    let controller = LeaseController::new(
        handle.clone(),
        lease,
        &open.tools,
        device,
        open.datagrams,
        limits,
        traffic,
        instruments.clone(),
    );
    let channel = Arc::new(DatagramChannel::new(controller.pace()));
    let mut held = StreamTools {
        tools,
        controller,
        channel: channel.clone(),
        offered_ns: None,
        arrival: None,
        tissue,
        _computing,
    };
    let offered = if open.datagrams { services.datagrams.offer()? } else { None };
    let (datagrams, arrival) = offered.unzip();
    held.offered_ns = arrival.is_some().then(now_ns);
    held.arrival = arrival;
    if datagrams.is_some() {
        sampling.wanted = Some(channel.wanted());
    }
    let law = law.as_deref();
    let answer = pb::TouchOpened {
        step,
        rate_hz: handle.model.scene.stepping.rate_hz,
        lease_s,
        heartbeat_s: sampling.heartbeat_s,
        law: law.map(|law| touch::law(law, FIRST)),
        warnings: device.zip(law).map_or(Vec::new(), |(device, law)| device.warnings(law)),
        max_force_n: device.map_or(UNDECLARED_FORCE_N, |device| device.most_n()),
        datagrams,
        lease_id: if open.tools.is_empty() { String::new() } else { format!("{lease:032x}") },
    };
    let samples = handle.samples(sampling, open.tools.is_empty().then_some(account));
    info!(session = %handle.id, tools = ?open.tools, holder = ?open.holder, "haptic stream opened");
    let notices = Notices::new(open.tools.clone(), step);
    let instruments = services.instruments.join(&handle.id, instruments, open.other_tools);
    Ok((Opened { answer, updates, samples, notices, guard, channel, instruments }, held))
}

/// Opens a stream and reads the client's messages in a task of its own, until it ends.
pub(super) fn open(services: Services, inbound: Streaming<pb::TouchRequest>, account: Account) -> Output {
    let (writer, events) = queue(services.config.limits.queued_samples);
    // The client may wait for our headers before it sends `open`, so this does not wait for its first message.
    let (opened, opening) = oneshot::channel();
    let listening = tokio::spawn(listen(services, inbound, account, opened, writer).in_current_span());
    let _listening = AbortOnDropHandle::new(listening);
    Output { stage: StreamStage::Opening(opening, Some(events)), _listening }
}

/// Reads the client's messages until it ends.
async fn listen(
    services: Services,
    mut inbound: Streaming<pb::TouchRequest>,
    account: Account,
    opening: oneshot::Sender<Result<Opened, Status>>,
    events: Writer<StreamEvent>,
) {
    use pb::touch_request::Message;
    let patience = Duration::from_secs_f64(services.config.limits.open_s);
    let Ok(first) = tokio::time::timeout(patience, inbound.message()).await else {
        let message = format!("did not come within {} s", patience.as_secs_f64());
        let _ = opening.send(Err(Refusal::new(Reason::TimedOut, "open", message).into()));
        return;
    };
    let mut early = PendingMessages::default();
    let first = match first {
        Ok(Some(pb::TouchRequest { message: Some(Message::Open(open)) })) => {
            let opening = begin(&services, &open, &account);
            early.gather(opening, &mut inbound, services.config.limits.queued_commands_per_tool).await
        }
        Ok(_) => Err(Refusal::new(Reason::OutOfTurn, "open", "the first message must be `open`").into()),
        Err(status) => {
            let _ = opening.send(Err(status));
            return;
        }
    };
    let (mut held, cut) = match first {
        Ok((opened, held)) => {
            let cut = opened.guard.cut().clone();
            let _ = opening.send(Ok(opened));
            (held, cut)
        }
        Err(status) => {
            let _ = opening.send(Err(status));
            return;
        }
    };
    let (handle, channel) = (held.controller.handle.clone(), held.channel.clone());
    for command in early.dropped.drain(..) {
        let message = "was one of too many that came before the stream was open";
        let refusal = Refusal::new(Reason::QueueFull, "command", message);
        services.traffic.refused(refusal.reason);
        events.push(StreamEvent::Rejected(wire::sample::rejection(command.0, command.1, &refusal)));
    }
    handle.count_refused(early.refused);
    let mut life = KeepaliveTimer::of(held.arrival.is_some());
    loop {
        let message = tokio::select! {
            message = early.next(&mut inbound) => message,
            step = changed(&mut held.tissue) => {
                events.push(StreamEvent::TissueChanged(step));
                continue;
            }
            datagram = channel.next(&mut held.arrival) => {
                if let Err(refusal) = held.controller.datagram(datagram, &events) {
                    return events.close(refusal);
                }
                continue;
            }
            () = life.tick() => {
                channel.stay_alive();
                continue;
            }
            () = cut.cancelled() => return events.close(palpate_realtime::streams::cut()),
        };
        match message {
            Ok(Some(pb::TouchRequest { message: Some(Message::Command(command)) })) => {
                if let Err(refusal) = held.controller.command(&command, &events) {
                    return events.close(refusal);
                }
            }
            Ok(Some(pb::TouchRequest { message: Some(Message::Renew(renew)) })) => {
                let now = now_ns();
                if let Err((refusal, is_abuse)) = held.controller.message(now) {
                    if is_abuse {
                        return events.close(refusal);
                    }
                    events.push(StreamEvent::Rejected(wire::sample::rejection(0, 0, &refusal)));
                    continue;
                }
                if held.tools > 0
                    && let Err(refusal) = handle.at_intake(|intake, now| intake.renew(held.controller.lease, now))
                {
                    // Streams do not name their lease.
                    let refusal = Refusal { field: String::new(), ..refusal };
                    events.push(StreamEvent::Rejected(wire::sample::rejection(0, 0, &refusal)));
                }
                let datagrams = if renew.datagrams { held.offer(&services, now) } else { None };
                events.push(StreamEvent::Renewed { client_time_ns: renew.client_time_ns, arrival_ns: now, datagrams });
            }
            Ok(Some(_)) => {
                let refusal = Refusal::new(Reason::OutOfTurn, "message", "must be a command or `renew`");
                return events.close(refusal);
            }
            Ok(None) => {
                // Who hears of the end may take the tools at once.
                drop(held);
                return events.push(StreamEvent::Finished);
            }
            Err(status) => {
                debug!(session = %handle.id, %status, "a client disappeared or sent an unreadable message");
                return events.push(StreamEvent::Failed(status));
            }
        }
    }
}

/// Waits for the next change of a tissue. Returns the step from which it acts.
async fn changed(tissue: &mut Option<watch::Receiver<(u64, Arc<Model>)>>) -> u64 {
    if let Some(tissue) = tissue
        && tissue.changed().await.is_ok()
    {
        return tissue.borrow_and_update().0;
    }
    std::future::pending().await
}

/// The output of a haptic stream. Dropping it stops reading from the client and releases its tools.
pub(super) struct Output {
    stage: StreamStage,
    _listening: AbortOnDropHandle<()>,
}

/// The stages of a stream: first the answer to `open`, then samples and rejections.
enum StreamStage {
    Opening(oneshot::Receiver<Result<Opened, Status>>, Option<Reader<StreamEvent>>),
    Open(Box<ResponseStream>),
    Over,
}

impl Stream for Output {
    type Item = Result<pb::TouchResponse, Status>;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        use pb::touch_response::Message;
        let stage = &mut self.get_mut().stage;
        let message = match stage {
            StreamStage::Opening(opening, events) => match (ready!(Pin::new(opening).poll(context)), events.take()) {
                (Ok(Ok(opened)), Some(events)) => {
                    let Opened { answer, updates, samples, notices, guard, channel, instruments } = opened;
                    let responses = ResponseStream::new(updates, events, samples, notices, guard, channel, instruments);
                    *stage = StreamStage::Open(Box::new(responses));
                    Some(Ok(Message::Opened(answer)))
                }
                (Ok(Err(status)), _) => Some(Err(status)),
                // The client disappeared before it sent anything.
                _ => None,
            },
            StreamStage::Open(responses) => ready!(responses.poll(context)),
            StreamStage::Over => None,
        };
        if !matches!(message, Some(Ok(_))) {
            *stage = StreamStage::Over;
        }
        Poll::Ready(message.map(|message| message.map(|message| pb::TouchResponse { message: Some(message) })))
    }
}
