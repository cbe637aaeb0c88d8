//! `HapticService`: streams of commands and samples, tools, single commands, and records of probes.

mod event;
mod instruments;
mod lease_controller;
mod lease_session;
mod pending_messages;
mod response_stream;
mod stream;
mod tools;

use std::iter::once;
use std::pin::Pin;

use futures_util::stream::{Stream, unfold};
use tonic::{Request, Response, Status, Streaming};
use tracing::info;

use tools::{charges, lease_id};

use super::charged_caller::ChargedCaller;
use super::connections::Peer;
use super::revocation::Tenure;
use super::services::Services;
use super::stream_termination::until_cut;
use palpate_proto::pb;
use palpate_proto::pb::haptic_service_server::HapticService;
use palpate_realtime::StreamKind;
use palpate_realtime::clock::now_ns;
use palpate_realtime::ids::random_bits;
use palpate_refusal::{Reason, Refusal};
use palpate_session::rules::Commands;
use palpate_session::wire;
use palpate_tissue::shape::{PointId, PointName, RestShape};

#[derive(Clone)]
pub(super) struct Haptics(pub(super) Services);

type TouchMessages<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// Renames the field of a refusal from `tools` to `tool`, for a call that concerns a single tool.
fn of_one_tool(refusal: Refusal) -> Refusal {
    if refusal.field == "tools" { Refusal { field: "tool".to_owned(), ..refusal } } else { refusal }
}

impl Haptics {
    /// Finds the points that a probe names. Refuses more than `limits.probe_points` and unknown ones.
    fn probed(&self, field: &str, shape: &dyn RestShape, names: Vec<PointName>) -> Result<Vec<PointId>, Refusal> {
        let limit = self.0.config.limits.probe_points;
        if names.len() > limit {
            let message = format!("are {}, above the limit of {limit}", names.len());
            return Err(Refusal::new(Reason::TooLarge, field, message));
        }
        names.into_iter().enumerate().map(|(index, name)| shape.find(&format!("{field}[{index}]"), name)).collect()
    }
}

#[tonic::async_trait]
impl HapticService for Haptics {
    type TouchStream = TouchMessages<pb::TouchResponse>;
    type WatchSamplesStream = TouchMessages<pb::WatchSamplesResponse>;
    type ProbeStream = TouchMessages<pb::ProbeResponse>;

    async fn touch(
        &self,
        request: Request<Streaming<pb::TouchRequest>>,
    ) -> Result<Response<Self::TouchStream>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        Ok(Response::new(Box::pin(stream::open(self.0.clone(), request.into_inner(), account))))
    }

    async fn acquire_tool(
        &self,
        request: Request<pb::AcquireToolRequest>,
    ) -> Result<Response<pb::AcquireToolResponse>, Status> {
        let ChargedCaller { account, may_vanish } = ChargedCaller::of(request.extensions());
        let (peer, tenure) =
            (request.extensions().get::<Peer>().cloned(), request.extensions().get::<Tenure>().cloned());
        let request = request.into_inner();
        let handle = self.0.seat("AcquireTool", &request.session_id).await?.handle;
        let mut lease_s = request.lease_s.unwrap_or(self.0.config.lease_s);
        if may_vanish && !request.outlives_connection {
            lease_s = lease_s.min(self.0.config.limits.browser_lease_s);
        }
        let lease = random_bits()?;
        let tools: Vec<u32> = once(request.tool).chain(request.more_tools).collect();
        let most = self.0.config.limits.tools as usize;
        if tools.len() > most {
            let text = format!("are {}, and a session has {most} tools", tools.len());
            return Err(Refusal::new(Reason::TooLarge, "more_tools", text).into());
        }
        let charges = charges(&account, tools.len()).map_err(of_one_tool)?;
        handle
            .at_intake(|intake, now| {
                intake.acquire(&tools, &request.holder, lease_s, lease, now)?;
                intake.charge(lease, charges);
                Ok::<_, Refusal>(())
            })
            .map_err(of_one_tool)?;
        if let Some(peer) = peer.filter(|_| !may_vanish && !request.outlives_connection) {
            peer.leases.add(&handle, lease, None);
        }
        tenure.map_or(Ok(()), |tenure| tenure.bind(&handle, lease))?;
        info!(session = %handle.id, ?tools, holder = ?request.holder, "tools acquired");
        Ok(Response::new(pb::AcquireToolResponse { lease_id: format!("{lease:032x}"), lease_s }))
    }

    async fn release_tool(
        &self,
        request: Request<pb::ReleaseToolRequest>,
    ) -> Result<Response<pb::ReleaseToolResponse>, Status> {
        let request = request.into_inner();
        let handle = self.0.seat("ReleaseTool", &request.session_id).await?.handle;
        let lease = lease_id(&request.lease_id)?;
        handle.at_intake(|intake, _| intake.release(lease))?;
        Ok(Response::new(pb::ReleaseToolResponse {}))
    }

    async fn send_commands(
        &self,
        request: Request<pb::SendCommandsRequest>,
    ) -> Result<Response<pb::SendCommandsResponse>, Status> {
        let now = now_ns();
        let request = request.into_inner();
        let handle = self.0.seat("SendCommands", &request.session_id).await?.handle;
        let lease = lease_id(&request.lease_id)?;
        let shape = handle.model.shape();
        let read = |(index, command): (usize, &pb::Command)| {
            let command = wire::command::from_command(command, shape, now);
            command.map_err(|refusal| refusal.within(&format!("commands[{index}]")))
        };
        let commands: Result<Commands, Refusal> = request.commands.iter().enumerate().map(read).collect();
        let accepted = commands.and_then(|commands| handle.submit(lease, commands)).inspect_err(|refusal| {
            handle.count_refused(request.commands.len());
            self.0.traffic.refused(refusal.reason);
        })?;
        accepted.taken_in().await;
        let tools = handle.at_intake(|intake, _| intake.tools_of(lease).collect());
        self.0.traffic.commanded(request.commands.len());
        let sample = handle.next_sample(tools).await?;
        let sample = Some(wire::sample::sample(&sample, shape, 0, now_ns()));
        Ok(Response::new(pb::SendCommandsResponse { sample }))
    }

    async fn open_datagrams(
        &self,
        request: Request<pb::OpenDatagramsRequest>,
    ) -> Result<Response<pb::OpenDatagramsResponse>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let offer = lease_session::offer(&self.0, &request.into_inner(), &account).await?;
        Ok(Response::new(pb::OpenDatagramsResponse { offer: Some(offer) }))
    }

    async fn watch_samples(
        &self,
        request: Request<pb::WatchSamplesRequest>,
    ) -> Result<Response<Self::WatchSamplesStream>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let request = request.into_inner();
        let handle = self.0.seat("WatchSamples", &request.session_id).await?.handle;
        let (every, deadband) = (request.sample_every_steps, request.deadband.as_ref());
        let sampling = wire::sample::sampling(every, None, deadband, request.heartbeat_s, false)?;
        let guard = handle.open_stream("WatchSamples", StreamKind::ReadsOnly, &account)?;
        let cut = guard.cut().clone();
        let samples = handle.samples(sampling, Some(&account));
        let out = unfold(Some((samples, guard)), |state| async move {
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
        let handle = self.0.seat("Probe", &request.session_id).await?.handle;
        let every = wire::every("every_steps", request.every_steps)?;
        let points = match wire::from_probed(request.r#where.as_ref())? {
            Some((field, names)) => Some(self.probed(field, handle.model.shape(), names)?),
            None => None,
        };
        let guard = handle.open_stream("Probe", StreamKind::ReadsOnly, &account)?;
        let cut = guard.cut().clone();
        let records = handle.probe(every, points, request.energy, request.tools, &account)?;
        let out = unfold(Some((records, guard, None)), |state| async move {
            let (mut records, guard, begun) = state?;
            let (record, dropped, part) = match begun {
                Some(begun) => begun,
                None => match records.pop().await {
                    Ok((record, dropped)) => (record, dropped, 0),
                    Err(refusal) => return Some((Err(refusal.into()), None)),
                },
            };
            let message = wire::sample::record(record.step, &record.record, dropped, part)?;
            let begun = (!message.last).then_some((record, dropped, part + 1));
            Some((Ok(message), Some((records, guard, begun))))
        });
        Ok(Response::new(until_cut(out, cut)))
    }
}
