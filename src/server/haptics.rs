//! `HapticService`: streams of commands and samples, single commands, hashes and records.

use std::collections::VecDeque;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use futures_util::stream::{self, Stream};
use glam::DVec3;
use tokio::sync::{oneshot, watch};
use tokio_util::task::AbortOnDropHandle;
use tonic::{Request, Response, Status, Streaming};
use tracing::{Instrument, debug, info};

use super::charged_caller::ChargedCaller;
use super::connections::Peer;
use super::cut::until_cut;
use super::force_law::{Computing, Updates};
use super::rate::Bucket;
use super::recovered::Notices;
use super::revocation::Tenure;
use super::services::Services;
use crate::budget::{Account, Resource, Taken};
use crate::ids::random_bits;
use crate::limits::Limits;
use crate::pace::clock::now_ns;
use crate::pace::queue::{Reader, Writer, queue};
use crate::pace::{Live, PacedSample, StreamGuard, StreamKind};
use crate::refusal::{Reason, Refusal, number};
use crate::scene::check::check_tip;
use crate::scene::script::Action;
use crate::session::command::Command;
use crate::session::laws::{FIRST, Laws};
use crate::session::lease::LeaseId;
use crate::shape::{PointId, PointName, RestShape};
use crate::wire;
use palpate_proto::pb::haptic_service_server::HapticService;
use palpate_proto::{pb, touch};
use palpate_touch::device::{Device, UNDECLARED_FORCE_N};

#[derive(Clone)]
pub(super) struct Haptics(pub(super) Services);

type Out<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// What the output of a haptic stream begins with.
struct Opened {
    answer: pb::TouchOpened,
    /// What will be told of the law, if the stream has one.
    updates: Option<Updates>,
    samples: Reader<PacedSample>,
    notices: Notices,
    guard: StreamGuard,
}

/// What a haptic stream is told besides samples.
enum Event {
    Rejected(pb::Rejection),
    /// The client's time, and when it came.
    Renewed(u64, u64),
    /// What the client sent can't be read.
    Failed(Status),
    /// The client has said all it wanted to say.
    Finished,
}

/// The tools of a stream, given back when it ends however it ends.
struct StreamTools {
    live: Arc<Live>,
    lease: LeaseId,
    tools: usize,
    device: Option<Device>,
    place: Option<ToolPlace>,
    /// Computes further laws as long as the stream is there.
    _computing: Option<AbortOnDropHandle<()>>,
}

/// Where the tool of a stream is, as the computation of its laws is told.
struct ToolPlace {
    /// Of the tip, m.
    radius_m: f64,
    told: watch::Sender<Option<DVec3>>,
}

impl ToolPlace {
    /// Tells the place of a pose that is half a radius away from the last that was told.
    fn follow(&self, command: &Command) {
        let Action::Pose { place_m, .. } = command.action else { return };
        self.told.send_if_modified(|told| {
            let is_news = told.is_none_or(|told_m| told_m.distance(place_m) > 0.5 * self.radius_m);
            if is_news {
                *told = Some(place_m);
            }
            is_news
        });
    }
}

impl StreamTools {
    /// How fast commands may come: so many for each step and tool, and at once twice what may wait.
    #[allow(clippy::cast_precision_loss)]
    fn bucket(&self, limits: &Limits) -> Bucket {
        let tools = self.tools.max(1) as f64;
        let per_s = limits.commands_per_step * self.live.model.scene.stepping.rate_hz * tools;
        Bucket::new(per_s, per_s.max(2.0 * limits.queued_commands_per_tool as f64 * tools))
    }
}

impl Drop for StreamTools {
    fn drop(&mut self) {
        if self.tools > 0 {
            // A lease that has lapsed already has nothing to give back.
            let _ = self.live.at_intake(|intake, _| intake.release(self.lease));
        }
    }
}

/// Charges `account` for so many tools.
fn charges(account: &Account, tools: usize) -> Result<Vec<Taken>, Refusal> {
    (0..tools).map(|_| account.take(Resource::Leases, 1, "tools")).collect()
}

/// The refusal of a call for a single tool, whose field is called `tool`.
fn of_one_tool(refusal: Refusal) -> Refusal {
    if refusal.field == "tools" { Refusal { field: "tool".to_owned(), ..refusal } } else { refusal }
}

fn lease_id(text: &str) -> Result<LeaseId, Refusal> {
    let wrong = |_| Refusal::new(Reason::NotHolder, "lease_id", "is none that this server gave");
    LeaseId::from_str_radix(text, 16).map_err(wrong)
}

/// A command, unless its pose is outside the declared workspace.
fn within_reach(command: Command, live: &Live, device: Option<&Device>) -> Result<Command, Refusal> {
    if let (Action::Pose { place_m, .. }, Some(device)) = (&command.action, device) {
        let middle_m = live.model.shape().extent().middle_m();
        let away_m = (*place_m - middle_m).length();
        let range = format!("within {} m of the middle of the sheet, the device's workspace", device.workspace_m);
        number("pose.position_m", away_m, &range, |away_m| away_m <= device.workspace_m)?;
    }
    Ok(command)
}

impl Haptics {
    /// Answers the first message of a haptic stream.
    async fn open(&self, open: &pb::TouchOpen, account: &Account) -> Result<(Opened, StreamTools), Status> {
        let live = self.0.pacer.get(&open.session_id)?;
        let device = open.device.as_ref().map(touch::from_device).transpose()?;
        let tip = touch::from_tip(open.tip.as_ref());
        // A stream that neither renders nor says anything of a tip may push with forces on any tissue.
        if device.is_some() || open.tip.is_some() {
            check_tip("tip", live.model.shape(), &tip)?;
        }
        let only = (!open.tools.is_empty()).then(|| open.tools.clone());
        let (every, deadband) = (open.sample_every_steps, open.deadband.as_ref());
        let mut sampling = wire::sample::sampling(every, only, deadband, open.heartbeat_s, device.is_some())?;
        if open.touch_stiffness && device.is_none() {
            let message = "is missing: touch_stiffness is of its local models";
            return Err(Refusal::new(Reason::Missing, "device", message).into());
        }
        sampling.touch_stiffness = open.touch_stiffness;
        let kind = if open.tools.is_empty() { StreamKind::ReadsOnly } else { StreamKind::HoldsTools };
        let guard = live.open_stream("Touch", kind, account)?;
        let begun = match device {
            Some(_) => Some(Computing::begin(&self.0.workshop, account, &live, tip.radius_m).await?),
            None => None,
        };
        let (law, computing) = begun.unzip();
        let laws = law.clone().map(|law| Arc::new(Laws::new(law)));
        sampling.laws.clone_from(&laws);
        let lease_s = open.lease_s.unwrap_or(self.0.config.lease_s);
        let lease = random_bits()?;
        let charges = charges(account, open.tools.len())?;
        let step = live.at_intake(|intake, now| {
            intake.acquire(&open.tools, &open.holder, lease_s, lease, now)?;
            intake.charge(lease, charges);
            Ok::<_, Refusal>(intake.next_step())
        })?;
        let (told, places) = watch::channel(None);
        let (updates, _computing) = computing.zip(laws).map(|(computing, laws)| computing.go_on(laws, places)).unzip();
        // Only a mesh has other laws at other places.
        let has_places = device.is_some() && live.model.shape().dimensions() > 2;
        let place = has_places.then_some(ToolPlace { radius_m: tip.radius_m, told });
        let held = StreamTools { live: live.clone(), lease, tools: open.tools.len(), device, place, _computing };
        let law = law.as_deref();
        let answer = pb::TouchOpened {
            step,
            rate_hz: live.model.scene.stepping.rate_hz,
            lease_s,
            heartbeat_s: sampling.heartbeat_s,
            law: law.map(|law| touch::law(law, FIRST)),
            warnings: device.zip(law).map_or(Vec::new(), |(device, law)| device.warnings(law)),
            max_force_n: device.map_or(UNDECLARED_FORCE_N, |device| device.most_n()),
        };
        let samples = live.samples(sampling, open.tools.is_empty().then_some(account));
        info!(session = %live.id, tools = ?open.tools, holder = ?open.holder, "haptic stream opened");
        let notices = Notices::new(open.tools.clone(), step);
        Ok((Opened { answer, updates, samples, notices, guard }, held))
    }

    /// The points that a probe names.
    fn probed(&self, field: &str, shape: &dyn RestShape, names: Vec<PointName>) -> Result<Vec<PointId>, Refusal> {
        let limit = self.0.config.limits.probe_points;
        if names.len() > limit {
            let message = format!("are {}, above the limit of {limit}", names.len());
            return Err(Refusal::new(Reason::TooLarge, field, message));
        }
        names.into_iter().enumerate().map(|(index, name)| shape.find(&format!("{field}[{index}]"), name)).collect()
    }

    /// Reads what the client says until it ends.
    async fn listen(
        self,
        mut inbound: Streaming<pb::TouchRequest>,
        account: Account,
        opening: oneshot::Sender<Result<Opened, Status>>,
        events: Writer<Event>,
    ) {
        use pb::touch_request::Message;
        let patience = Duration::from_secs_f64(self.0.config.limits.open_s);
        let Ok(first) = tokio::time::timeout(patience, inbound.message()).await else {
            let message = format!("did not come within {} s", patience.as_secs_f64());
            let _ = opening.send(Err(Refusal::new(Reason::TimedOut, "open", message).into()));
            return;
        };
        let mut early = Early::default();
        let first = match first {
            Ok(Some(pb::TouchRequest { message: Some(Message::Open(open)) })) => {
                let opening = self.open(&open, &account);
                early.gather(opening, &mut inbound, self.0.config.limits.queued_commands_per_tool).await
            }
            Ok(_) => Err(Refusal::new(Reason::OutOfTurn, "open", "the first message must be `open`").into()),
            Err(status) => {
                let _ = opening.send(Err(status));
                return;
            }
        };
        let (held, cut) = match first {
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
        let live = &held.live;
        let mut bucket = held.bucket(&self.0.config.limits);
        for command in early.dropped.drain(..) {
            let message = "was one of too many that came before the stream was open";
            let refusal = Refusal::new(Reason::QueueFull, "command", message);
            self.0.traffic.refused(refusal.reason);
            events.push(Event::Rejected(wire::sample::rejection(command.0, command.1, &refusal)));
        }
        live.count_refused(early.refused);
        loop {
            let message = tokio::select! {
                message = early.next(&mut inbound) => message,
                () = cut.cancelled() => return events.close(crate::pace::streams::cut()),
            };
            match message {
                Ok(Some(pb::TouchRequest { message: Some(Message::Command(command)) })) => {
                    let now = now_ns();
                    let taken = bucket
                        .take(now, "commands of this stream")
                        .and_then(|()| wire::command::from_command(&command, live.model.shape(), now))
                        .and_then(|command| within_reach(command, live, held.device.as_ref()))
                        .inspect(|command| held.place.iter().for_each(|place| place.follow(command)))
                        .and_then(|command| live.submit(held.lease, vec![command]).map(drop));
                    self.0.traffic.commanded(usize::from(taken.is_ok()));
                    if let Err(refusal) = taken {
                        live.count_refused(1);
                        self.0.traffic.refused(refusal.reason);
                        debug!(session = %live.id, reason = refusal.reason.as_str(), %refusal, "command refused");
                        let sequence = command.sequence.unwrap_or_default();
                        events.push(Event::Rejected(wire::sample::rejection(command.tool, sequence, &refusal)));
                        if bucket.is_abused() {
                            info!(session = %live.id, "haptic stream ended: its commands come far too fast");
                            return events.close(refusal);
                        }
                    }
                }
                Ok(Some(pb::TouchRequest { message: Some(Message::Renew(renew)) })) => {
                    let now = now_ns();
                    if let Err(refusal) = bucket.take(now, "messages of this stream") {
                        if bucket.is_abused() {
                            return events.close(refusal);
                        }
                        events.push(Event::Rejected(wire::sample::rejection(0, 0, &refusal)));
                        continue;
                    }
                    if held.tools > 0
                        && let Err(refusal) = live.at_intake(|intake, now| intake.renew(held.lease, now))
                    {
                        // A lease is not named in a stream.
                        let refusal = Refusal { field: String::new(), ..refusal };
                        events.push(Event::Rejected(wire::sample::rejection(0, 0, &refusal)));
                    }
                    events.push(Event::Renewed(renew.client_time_ns, now));
                }
                Ok(Some(_)) => {
                    let refusal = Refusal::new(Reason::OutOfTurn, "message", "must be a command or `renew`");
                    return events.close(refusal);
                }
                Ok(None) => return events.push(Event::Finished),
                Err(status) => {
                    debug!(session = %live.id, %status, "a client vanished, or sent what can't be read");
                    return events.push(Event::Failed(status));
                }
            }
        }
    }
}

/// What a client says before its stream is open, which may take as long as a force law does. It is taken from the transport,
/// which cuts connections whose small messages nobody reads.
#[derive(Default)]
struct Early {
    said: VecDeque<Result<Option<pb::TouchRequest>, Status>>,
    /// Commands that were dropped for newer ones, and of the last of those tool and sequence number.
    refused: usize,
    dropped: VecDeque<(u32, u64)>,
}

impl Early {
    /// Waits for `opening`, and keeps the newest `most` messages that come meanwhile.
    async fn gather<T>(
        &mut self,
        opening: impl Future<Output = T>,
        inbound: &mut Streaming<pb::TouchRequest>,
        most: usize,
    ) -> T {
        use pb::touch_request::Message;
        let mut opening = std::pin::pin!(opening);
        loop {
            // Behind the end, or what should not come now, nothing is kept.
            let goes_on = self.said.back().is_none_or(|said| {
                let message = said.as_ref().ok().and_then(|said| said.as_ref()?.message.as_ref());
                matches!(message, Some(Message::Command(_) | Message::Renew(_)))
            });
            tokio::select! {
                opened = &mut opening => return opened,
                message = inbound.message(), if goes_on => self.said.push_back(message),
            }
            if self.said.len() > most
                && let Some(Ok(Some(pb::TouchRequest { message: Some(Message::Command(old)) }))) = self.said.pop_front()
            {
                self.refused += 1;
                self.dropped.push_back((old.tool, old.sequence.unwrap_or_default()));
                if self.dropped.len() > most {
                    self.dropped.pop_front();
                }
            }
        }
    }

    /// What was said next.
    async fn next(&mut self, inbound: &mut Streaming<pb::TouchRequest>) -> Result<Option<pb::TouchRequest>, Status> {
        match self.said.pop_front() {
            Some(said) => said,
            None => inbound.message().await,
        }
    }
}

/// What the output of a haptic stream reads from.
struct Outlet {
    updates: Option<Updates>,
    events: Reader<Event>,
    samples: Reader<PacedSample>,
    notices: Notices,
    /// What goes before the next sample, and that sample.
    ready: VecDeque<pb::touch_response::Message>,
    /// Answers that the client was too slow for.
    dropped_answers: u64,
    guard: StreamGuard,
}

impl Outlet {
    fn poll(&mut self, context: &mut Context<'_>) -> Poll<Option<Result<pb::touch_response::Message, Status>>> {
        use pb::touch_response::Message;
        if let Some(message) = self.ready.pop_front() {
            return Poll::Ready(Some(Ok(message)));
        }
        if let Some(updates) = &mut self.updates
            && let Poll::Ready(told) = updates.poll(context)
        {
            match told {
                Some(update) => return Poll::Ready(Some(Ok(Message::ForceLaw(update)))),
                None => self.updates = None,
            }
        }
        if let Poll::Ready(event) = self.events.poll_pop(context) {
            return Poll::Ready(match event {
                Ok((Event::Rejected(rejection), dropped_answers)) => {
                    self.dropped_answers = dropped_answers;
                    Some(Ok(Message::Rejection(pb::Rejection { dropped_answers, ..rejection })))
                }
                Ok((Event::Renewed(client_time_ns, arrival_ns), _)) => {
                    let server_hold_ns = now_ns().saturating_sub(arrival_ns);
                    Some(Ok(Message::Renewed(pb::Renewed { client_time_ns, server_hold_ns })))
                }
                Ok((Event::Failed(status), _)) => Some(Err(status)),
                Ok((Event::Finished, _)) => None,
                Err(refusal) => Some(Err(refusal.into())),
            });
        }
        let (paced, dropped) = match ready!(self.samples.poll_pop(context)) {
            Ok(popped) => popped,
            Err(refusal) => return Poll::Ready(Some(Err(refusal.into()))),
        };
        let dropped_answers = self.dropped_answers;
        let told = |rejection| Message::Rejection(pb::Rejection { dropped_answers, ..rejection });
        self.ready.extend(self.notices.of(&paced.sample).into_iter().map(told));
        self.ready.push_back(Message::Sample(wire::sample::sample(&paced, self.guard.shape(), dropped, now_ns())));
        Poll::Ready(self.ready.pop_front().map(Ok))
    }
}

/// The output of a haptic stream. When nobody wants it any more, nothing is listened to any more, and tools are let go.
struct Output {
    stage: Stage,
    _listening: AbortOnDropHandle<()>,
}

/// First the answer to `open`, then samples and rejections.
enum Stage {
    Opening(oneshot::Receiver<Result<Opened, Status>>, Option<Reader<Event>>),
    Open(Outlet),
    Over,
}

impl Stream for Output {
    type Item = Result<pb::TouchResponse, Status>;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        use pb::touch_response::Message;
        let stage = &mut self.get_mut().stage;
        let message = match stage {
            Stage::Opening(opening, events) => match (ready!(Pin::new(opening).poll(context)), events.take()) {
                (Ok(Ok(Opened { answer, updates, samples, notices, guard })), Some(events)) => {
                    let (ready, dropped_answers) = (VecDeque::new(), 0);
                    *stage = Stage::Open(Outlet { updates, events, samples, notices, ready, dropped_answers, guard });
                    Some(Ok(Message::Opened(answer)))
                }
                (Ok(Err(status)), _) => Some(Err(status)),
                // The client vanished before it said anything.
                _ => None,
            },
            Stage::Open(outlet) => ready!(outlet.poll(context)),
            Stage::Over => None,
        };
        if !matches!(message, Some(Ok(_))) {
            *stage = Stage::Over;
        }
        Poll::Ready(message.map(|message| message.map(|message| pb::TouchResponse { message: Some(message) })))
    }
}

#[tonic::async_trait]
impl HapticService for Haptics {
    type TouchStream = Out<pb::TouchResponse>;
    type WatchSamplesStream = Out<pb::WatchSamplesResponse>;
    type ProbeStream = Out<pb::ProbeResponse>;

    async fn touch(
        &self,
        request: Request<Streaming<pb::TouchRequest>>,
    ) -> Result<Response<Self::TouchStream>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let (writer, events) = queue(self.0.config.limits.queued_samples);
        // The client may wait for our headers before it opens, so its first message is not waited for here.
        let (opened, opening) = oneshot::channel();
        let listening =
            tokio::spawn(self.clone().listen(request.into_inner(), account, opened, writer).in_current_span());
        let _listening = AbortOnDropHandle::new(listening);
        Ok(Response::new(Box::pin(Output { stage: Stage::Opening(opening, Some(events)), _listening })))
    }

    async fn acquire_tool(
        &self,
        request: Request<pb::AcquireToolRequest>,
    ) -> Result<Response<pb::AcquireToolResponse>, Status> {
        let ChargedCaller { account, may_vanish } = ChargedCaller::of(request.extensions());
        let (peer, tenure) =
            (request.extensions().get::<Peer>().cloned(), request.extensions().get::<Tenure>().cloned());
        let request = request.into_inner();
        let live = self.0.pacer.get(&request.session_id)?;
        let mut lease_s = request.lease_s.unwrap_or(self.0.config.lease_s);
        if may_vanish && !request.outlives_connection {
            lease_s = lease_s.min(self.0.config.limits.browser_lease_s);
        }
        let lease = random_bits()?;
        let charges = charges(&account, 1).map_err(of_one_tool)?;
        live.at_intake(|intake, now| {
            intake.acquire(&[request.tool], &request.holder, lease_s, lease, now)?;
            intake.charge(lease, charges);
            Ok::<_, Refusal>(())
        })
        .map_err(of_one_tool)?;
        if let Some(peer) = peer.filter(|_| !may_vanish && !request.outlives_connection) {
            peer.leases.add(&live, lease, None);
        }
        tenure.map_or(Ok(()), |tenure| tenure.bind(&live, lease))?;
        info!(session = %live.id, tool = request.tool, holder = ?request.holder, "tool acquired");
        Ok(Response::new(pb::AcquireToolResponse { lease_id: format!("{lease:032x}"), lease_s }))
    }

    async fn release_tool(
        &self,
        request: Request<pb::ReleaseToolRequest>,
    ) -> Result<Response<pb::ReleaseToolResponse>, Status> {
        let request = request.into_inner();
        let live = self.0.pacer.get(&request.session_id)?;
        let lease = lease_id(&request.lease_id)?;
        live.at_intake(|intake, _| intake.release(lease))?;
        Ok(Response::new(pb::ReleaseToolResponse {}))
    }

    async fn send_commands(
        &self,
        request: Request<pb::SendCommandsRequest>,
    ) -> Result<Response<pb::SendCommandsResponse>, Status> {
        let now = now_ns();
        let request = request.into_inner();
        let live = self.0.pacer.get(&request.session_id)?;
        let lease = lease_id(&request.lease_id)?;
        let shape = live.model.shape();
        let read = |(index, command): (usize, &pb::Command)| {
            let command = wire::command::from_command(command, shape, now);
            command.map_err(|refusal| refusal.within(&format!("commands[{index}]")))
        };
        let commands: Result<Vec<Command>, Refusal> = request.commands.iter().enumerate().map(read).collect();
        let accepted = commands.and_then(|commands| live.submit(lease, commands)).inspect_err(|refusal| {
            live.count_refused(request.commands.len());
            self.0.traffic.refused(refusal.reason);
        })?;
        accepted.taken_in().await;
        let tools = live.at_intake(|intake, _| intake.tools_of(lease).collect());
        self.0.traffic.commanded(request.commands.len());
        let sample = live.next_sample(tools).await?;
        let sample = Some(wire::sample::sample(&sample, shape, 0, now_ns()));
        Ok(Response::new(pb::SendCommandsResponse { sample }))
    }

    async fn watch_samples(
        &self,
        request: Request<pb::WatchSamplesRequest>,
    ) -> Result<Response<Self::WatchSamplesStream>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let request = request.into_inner();
        let live = self.0.pacer.get(&request.session_id)?;
        let (every, deadband) = (request.sample_every_steps, request.deadband.as_ref());
        let sampling = wire::sample::sampling(every, None, deadband, request.heartbeat_s, false)?;
        let guard = live.open_stream("WatchSamples", StreamKind::ReadsOnly, &account)?;
        let cut = guard.cut().clone();
        let samples = live.samples(sampling, Some(&account));
        let out = stream::unfold(Some((samples, guard)), |state| async move {
            let (mut samples, guard) = state?;
            Some(match samples.pop().await {
                Ok((sample, dropped)) => {
                    let sample = Some(wire::sample::sample(&sample, guard.shape(), dropped, now_ns()));
                    (Ok(pb::WatchSamplesResponse { sample }), Some((samples, guard)))
                }
                Err(refusal) => (Err(refusal.into()), None),
            })
        });
        Ok(Response::new(until_cut(out, cut)))
    }

    async fn probe(&self, request: Request<pb::ProbeRequest>) -> Result<Response<Self::ProbeStream>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let request = request.into_inner();
        let live = self.0.pacer.get(&request.session_id)?;
        let every = wire::every("every_steps", request.every_steps)?;
        let points = match wire::from_probed(request.r#where.as_ref())? {
            Some((field, names)) => Some(self.probed(field, live.model.shape(), names)?),
            None => None,
        };
        let guard = live.open_stream("Probe", StreamKind::ReadsOnly, &account)?;
        let cut = guard.cut().clone();
        let records = live.probe(every, points, request.energy, request.tools, &account)?;
        let out = stream::unfold(Some((records, guard, None)), |state| async move {
            let (mut records, guard, begun) = state?;
            let (record, dropped, part) = match begun {
                Some(begun) => begun,
                None => match records.pop().await {
                    Ok((record, dropped)) => (record, dropped, 0),
                    Err(refusal) => return Some((Err(refusal.into()), None)),
                },
            };
            let message = wire::sample::record(&record, dropped, part)?;
            let begun = (!message.last).then_some((record, dropped, part + 1));
            Some((Ok(message), Some((records, guard, begun))))
        });
        Ok(Response::new(until_cut(out, cut)))
    }
}
