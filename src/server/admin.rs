//! `AdminService`: lists what callers use, and cuts or frees it. In a fleet, lists servers and sessions and moves
//! sessions.

use std::pin::Pin;
use std::sync::Arc;

use futures_util::stream::{self, Stream, StreamExt};
use tonic::{Request, Response, Status};
use tracing::info;

use super::connections::Register;
use super::services::Services;
use palpate_proto::pb;
use palpate_proto::pb::admin_service_server::AdminService;
use palpate_realtime::StreamKind;
use palpate_realtime::clock::now_ns;
use palpate_refusal::{Reason, Refusal, excerpt};
use palpate_session::budget::{Account, Purpose, Resource, Work};

/// Sessions per message of `ListFleetSessions`.
const FLEET_SESSIONS_PER_PART: usize = 1000;

pub(super) struct Admin {
    pub(super) services: Services,
    pub(super) register: Arc<Register>,
}

#[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
#[tonic::async_trait]
impl AdminService for Admin {
    type ListFleetSessionsStream = Pin<Box<dyn Stream<Item = Result<pb::ListFleetSessionsResponse, Status>> + Send>>;
    type DrainNodeStream = Pin<Box<dyn Stream<Item = Result<pb::DrainNodeResponse, Status>> + Send>>;

    async fn list_callers(
        &self,
        _: Request<pb::ListCallersRequest>,
    ) -> Result<Response<pb::ListCallersResponse>, Status> {
        let now = now_ns();
        let use_of = |account: &Account| pb::CallerUse {
            caller: account.name().to_owned(),
            memory_bytes: account.has(Resource::Memory(Purpose::Session)),
            sessions: account.has(Resource::Sessions),
            streams: account.has(Resource::Streams),
            tools: account.has(Resource::Leases),
            processor_share: Work::ALL.iter().map(|work| account.share(*work, now)).sum(),
        };
        let callers = self.services.pacer.budget.accounts().iter().map(use_of).collect();
        Ok(Response::new(pb::ListCallersResponse { callers }))
    }

    async fn list_streams(
        &self,
        request: Request<pb::ListStreamsRequest>,
    ) -> Result<Response<pb::ListStreamsResponse>, Status> {
        let handle = self.services.session(&request.get_ref().session_id).await?;
        let streams = handle.list_streams().into_iter().map(|stream| pb::StreamUse {
            number: stream.number,
            call: stream.what.to_owned(),
            caller: stream.caller,
            holds_tools: stream.kind == StreamKind::HoldsTools,
            age_s: stream.age_ns as f64 * 1e-9,
        });
        Ok(Response::new(pb::ListStreamsResponse { streams: streams.collect() }))
    }

    async fn free_tool(&self, request: Request<pb::FreeToolRequest>) -> Result<Response<pb::FreeToolResponse>, Status> {
        let pb::FreeToolRequest { session_id, tool } = request.into_inner();
        let handle = self.services.session(&session_id).await?;
        if handle.at_intake(|intake, _| intake.free(|other, _| other == tool)) == 0 {
            return Err(Refusal::new(Reason::OutOfRange, "tool", format!("nobody holds tool {tool}")).into());
        }
        info!(session = %handle.id, tool, "tool released by an administrator");
        Ok(Response::new(pb::FreeToolResponse {}))
    }

    async fn cut_stream(
        &self,
        request: Request<pb::CutStreamRequest>,
    ) -> Result<Response<pb::CutStreamResponse>, Status> {
        let pb::CutStreamRequest { session_id, number } = request.into_inner();
        let handle = self.services.session(&session_id).await?;
        if handle.cut_streams(|other, _| other == number) == 0 {
            let message = format!("the session has no stream {number}");
            return Err(Refusal::new(Reason::OutOfRange, "number", message).into());
        }
        info!(session = %handle.id, number, "stream cut");
        Ok(Response::new(pb::CutStreamResponse {}))
    }

    async fn cut_caller(
        &self,
        request: Request<pb::CutCallerRequest>,
    ) -> Result<Response<pb::CutCallerResponse>, Status> {
        let pb::CutCallerRequest { caller, delete_sessions } = request.into_inner();
        let pacer = &self.services.pacer;
        let account =
            pacer.budget.accounts().into_iter().find(|account| account.name() == caller).ok_or_else(|| {
                Refusal::new(Reason::OutOfRange, "caller", format!("unknown caller `{}`", excerpt(&caller)))
            })?;
        let mut answer = pb::CutCallerResponse::default();
        for handle in pacer.list() {
            answer.streams += handle.cut_streams(|_, other| other.number() == account.number()) as u32;
            let theirs = |payer: Option<&Account>| payer.is_some_and(|payer| payer.number() == account.number());
            let freed = handle.at_intake(|intake, _| intake.free(|_, payer| theirs(payer)));
            answer.tools += freed as u32;
            if delete_sessions && handle.owner.number() == account.number() && pacer.delete(&handle.id).is_ok() {
                answer.sessions += 1;
            }
        }
        answer.connections = self.register.cut(account.number()) as u32;
        info!(caller, streams = answer.streams, tools = answer.tools, sessions = answer.sessions, "caller cut");
        Ok(Response::new(answer))
    }

    async fn revive_session(
        &self,
        request: Request<pb::ReviveSessionRequest>,
    ) -> Result<Response<pb::ReviveSessionResponse>, Status> {
        let step = self.services.session(&request.get_ref().session_id).await?.revive().await?;
        Ok(Response::new(pb::ReviveSessionResponse { step }))
    }

    async fn list_nodes(&self, _: Request<pb::ListNodesRequest>) -> Result<Response<pb::ListNodesResponse>, Status> {
        Ok(Response::new(pb::ListNodesResponse { nodes: self.services.fleet()?.nodes() }))
    }

    async fn list_fleet_sessions(
        &self,
        _: Request<pb::ListFleetSessionsRequest>,
    ) -> Result<Response<Self::ListFleetSessionsStream>, Status> {
        let sessions = self.services.fleet()?.sessions().await?;
        let parts: Vec<_> = sessions
            .chunks(FLEET_SESSIONS_PER_PART)
            .map(|sessions| Ok(pb::ListFleetSessionsResponse { sessions: sessions.to_vec() }))
            .collect();
        Ok(Response::new(Box::pin(stream::iter(parts))))
    }

    async fn move_session(
        &self,
        request: Request<pb::MoveSessionRequest>,
    ) -> Result<Response<pb::MoveSessionResponse>, Status> {
        let request = request.into_inner();
        let fleet = self.services.fleet()?;
        let handle = self.services.session(&request.session_id).await?;
        let (ownership, gap_s) = fleet.clone().move_session(handle, &request.node).await?;
        Ok(Response::new(pb::MoveSessionResponse { ownership: Some(ownership), gap_s }))
    }

    async fn drain_node(
        &self,
        request: Request<pb::DrainNodeRequest>,
    ) -> Result<Response<Self::DrainNodeStream>, Status> {
        let drained = self.services.fleet()?.clone().drain(!request.get_ref().stop);
        Ok(Response::new(Box::pin(drained.map(Ok))))
    }
}
