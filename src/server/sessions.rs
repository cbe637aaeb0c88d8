//! `SessionService`.

use std::sync::Arc;

use tonic::{Request, Response, Status};
use tracing::{info, warn};

use super::House;
use super::connections::Peer;
use crate::pace::clock::now_ns;
use crate::refusal::{Reason, Refusal, number};
use crate::wire::pb::session_service_server::SessionService;
use crate::wire::{self, pb};

pub(super) struct Sessions(pub(super) House);

#[tonic::async_trait]
impl SessionService for Sessions {
    async fn list_scenes(&self, _: Request<pb::ListScenesRequest>) -> Result<Response<pb::ListScenesResponse>, Status> {
        Ok(Response::new(pb::ListScenesResponse { scene_names: self.0.catalog.names() }))
    }

    async fn create_session(
        &self,
        request: Request<pb::CreateSessionRequest>,
    ) -> Result<Response<pb::CreateSessionResponse>, Status> {
        use pb::create_session_request::Source;
        if let Some(peer) = request.extensions().get::<Peer>() {
            peer.may_create(now_ns())?;
        }
        let request = request.into_inner();
        let scene = match &request.source {
            Some(Source::SceneName(name)) => self.0.catalog.load(name, &[], &self.0.config.limits)?,
            Some(Source::Scene(scene)) => wire::scene::from_scene(scene).map_err(|refusal| refusal.within("scene"))?,
            None => return Err(Refusal::new(Reason::Missing, "source", "scene_name or scene is missing").into()),
        };
        let most_s = self.0.config.idle_session_s;
        let idle_timeout_s = request.idle_timeout_s.unwrap_or(most_s);
        let range = format!("above 0 and at most {most_s}");
        number("idle_timeout_s", idle_timeout_s, &range, |value| value > 0.0 && value <= most_s)?;
        // A large sheet takes a while to lay out. Who hangs up before it is its turn is passed over.
        let turn = self.0.heavy_work.clone().acquire_owned().await;
        let pacer = self.0.pacer.clone();
        let made = tokio::task::spawn_blocking(move || {
            let _turn = turn;
            pacer.create(&scene, request.paused, idle_timeout_s)
        });
        let made = made.await;
        let live = made.map_err(|e| Status::internal(e.to_string()))??;
        info!(session = %live.id, scene = %live.model.scene.name, points = live.model.len(), "session created");
        for warning in &live.model.warnings {
            warn!(session = %live.id, warning);
        }
        Ok(Response::new(pb::CreateSessionResponse { session: Some(wire::sample::session(&live)) }))
    }

    async fn get_session(
        &self,
        request: Request<pb::GetSessionRequest>,
    ) -> Result<Response<pb::GetSessionResponse>, Status> {
        let live = self.0.pacer.get(&request.get_ref().session_id)?;
        Ok(Response::new(pb::GetSessionResponse { session: Some(wire::sample::session(&live)) }))
    }

    async fn list_sessions(
        &self,
        _: Request<pb::ListSessionsRequest>,
    ) -> Result<Response<pb::ListSessionsResponse>, Status> {
        let without_scene = |live: &Arc<_>| pb::Session { scene: None, ..wire::sample::session(live) };
        let sessions = self.0.pacer.list().iter().map(without_scene).collect();
        Ok(Response::new(pb::ListSessionsResponse { sessions }))
    }

    async fn delete_session(
        &self,
        request: Request<pb::DeleteSessionRequest>,
    ) -> Result<Response<pb::DeleteSessionResponse>, Status> {
        let id = &request.get_ref().session_id;
        self.0.pacer.delete(id)?;
        info!(session = %id, "session deleted");
        Ok(Response::new(pb::DeleteSessionResponse {}))
    }

    async fn start_session(
        &self,
        request: Request<pb::StartSessionRequest>,
    ) -> Result<Response<pb::StartSessionResponse>, Status> {
        let request = request.into_inner();
        let live = self.0.pacer.get(&request.session_id)?;
        let step = self.0.pacer.start_session(&live, request.until_step).await?;
        Ok(Response::new(pb::StartSessionResponse { step }))
    }

    async fn pause_session(
        &self,
        request: Request<pb::PauseSessionRequest>,
    ) -> Result<Response<pb::PauseSessionResponse>, Status> {
        self.0.pacer.get(&request.get_ref().session_id)?.pause().await?;
        Ok(Response::new(pb::PauseSessionResponse {}))
    }

    async fn get_state_hash(
        &self,
        request: Request<pb::GetStateHashRequest>,
    ) -> Result<Response<pb::GetStateHashResponse>, Status> {
        let request = request.into_inner();
        let live = self.0.pacer.get(&request.session_id)?;
        let (step, hash) = live.hash_at(request.at_step).await?;
        Ok(Response::new(pb::GetStateHashResponse { step, state_hash: format!("{hash:032x}") }))
    }
}
