//! `NodeService`: the calls that other servers of the fleet make to this one.

use std::pin::Pin;
use std::sync::Arc;

use futures_util::stream::Stream;
use palpate_proto::pb;
use palpate_proto::pb::node_service_server::NodeService;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};

use super::fleet::Fleet;
use super::sessions::Sessions;

/// Responses per stream that wait for the network.
const WAITING: usize = 4;

pub(super) struct Nodes {
    pub(super) sessions: Sessions,
    pub(super) fleet: Arc<Fleet>,
}

type Out<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

#[tonic::async_trait]
impl NodeService for Nodes {
    type MirrorStream = Out<pb::MirrorResponse>;
    type TakeSessionStream = Out<pb::TakeSessionResponse>;

    async fn create_here(
        &self,
        request: Request<pb::CreateHereRequest>,
    ) -> Result<Response<pb::CreateHereResponse>, Status> {
        let pb::CreateHereRequest { request, owner } = request.into_inner();
        let account = self.fleet.account(&owner);
        let session = Some(self.sessions.create_here(request.unwrap_or_default(), account).await?);
        Ok(Response::new(pb::CreateHereResponse { session }))
    }

    async fn mirror(
        &self,
        request: Request<Streaming<pb::MirrorRequest>>,
    ) -> Result<Response<Self::MirrorStream>, Status> {
        let (tell, told) = mpsc::channel(WAITING);
        tokio::spawn(self.fleet.clone().receive(request.into_inner(), tell));
        Ok(Response::new(Box::pin(ReceiverStream::new(told))))
    }

    async fn take_session(
        &self,
        request: Request<Streaming<pb::TakeSessionRequest>>,
    ) -> Result<Response<Self::TakeSessionStream>, Status> {
        let (tell, told) = mpsc::channel(WAITING);
        tokio::spawn(self.fleet.clone().take_in(request.into_inner(), tell));
        Ok(Response::new(Box::pin(ReceiverStream::new(told))))
    }
}
