//! `ViewService`: streams of frames, textures, and the surface of a tissue at rest.

use std::collections::VecDeque;
use std::pin::Pin;

use bytes::Bytes;
use futures_util::stream::{self, Stream};
use palpate_proto::pb;
use palpate_proto::pb::view_service_server::ViewService;
use tonic::{Request, Response, Status};
use tracing::info;

use super::burn_parts::BurnParts;
use super::charged_caller::ChargedCaller;
use super::frame_message::frame_messages;
use super::job_pool::CancelFlag;
use super::mesh_parts::mesh_part;
use super::services::Services;
use super::stream_termination::until_cut;
use super::topology_parts::TopologyParts;
use super::wound_parts::WoundParts;
use palpate_realtime::frames::Viewer;
use palpate_realtime::ids::random_id;
use palpate_realtime::{FrameReader, StreamGuard, StreamKind};
use palpate_refusal::number;
use palpate_session::surface::Refinement;
use palpate_session::wire;
use palpate_texture::Texture;

pub(super) struct Views(pub(super) Services);

type ViewMessages<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// Frames per second if the viewer requests no rate.
const DEFAULT_RATE_HZ: f64 = 60.0;

/// A running stream of frames.
struct ViewStream {
    viewer_id: String,
    reader: FrameReader,
    _guard: StreamGuard,
    messages: VecDeque<pb::WatchFramesResponse>,
    /// Number of the last frame, and how many had been left out until then because nothing had changed.
    last: Option<(u64, u64)>,
    skipped: u64,
}

impl ViewStream {
    async fn next(mut self) -> Option<(Result<pb::WatchFramesResponse, Status>, Option<ViewStream>)> {
        if self.messages.is_empty() {
            match self.reader.pop().await {
                Ok((delivery, _)) => {
                    let (frame_id, unchanged) = (delivery.frame_id, delivery.unchanged);
                    self.skipped += self.last.map_or(0, |last| {
                        frame_id.saturating_sub(last.0 + 1).saturating_sub(unchanged.saturating_sub(last.1))
                    });
                    self.last = Some((frame_id, unchanged));
                    self.messages.extend(frame_messages(&self.viewer_id, &delivery, self.skipped));
                }
                Err(refusal) => return Some((Err(refusal.into()), None)),
            }
        } else {
            // Between the parts of a frame, messages of other streams can be sent.
            tokio::task::yield_now().await;
        }
        let message = self.messages.pop_front()?;
        Some((Ok(message), Some(self)))
    }
}

/// Sends the messages of an answer; `next` returns the next one and whether it is the last. `guard` is that of the stream.
fn in_parts<P: Send + 'static, M: Send + 'static>(
    parts: P,
    guard: StreamGuard,
    next: fn(&mut P) -> (M, bool),
) -> ViewMessages<M> {
    let cut = guard.cut().clone();
    let out = stream::unfold(Some((parts, guard)), move |rest| async move {
        let (mut parts, guard) = rest?;
        let (message, last) = next(&mut parts);
        Some((Ok(message), (!last).then_some((parts, guard))))
    });
    until_cut(out, cut)
}

#[tonic::async_trait]
impl ViewService for Views {
    type GetMeshStream = ViewMessages<pb::GetMeshResponse>;
    type GetTopologyStream = ViewMessages<pb::GetTopologyResponse>;
    type GetWoundStream = ViewMessages<pb::GetWoundResponse>;
    type GetBurnsStream = ViewMessages<pb::GetBurnsResponse>;
    type GetTextureStream = ViewMessages<pb::GetTextureResponse>;
    type WatchFramesStream = ViewMessages<pb::WatchFramesResponse>;

    async fn get_mesh(&self, request: Request<pb::GetMeshRequest>) -> Result<Response<Self::GetMeshStream>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let request = request.into_inner();
        let handle = self.0.seat("GetMesh", &request.session_id).await?.handle;
        let grid = Refinement::new(&handle.model.scene, request.refinement, &self.0.config.limits)?;
        let guard = handle.open_stream("GetMesh", StreamKind::ReadsOnly, &account)?;
        let cut = guard.cut().clone();
        let skin = handle.skin.clone();
        let out = stream::unfold((0, guard, skin), move |(part, guard, skin)| async move {
            mesh_part(skin.as_deref(), grid, part).map(|message| (Ok(message), (part + 1, guard, skin)))
        });
        Ok(Response::new(until_cut(out, cut)))
    }

    async fn get_topology(
        &self,
        request: Request<pb::GetTopologyRequest>,
    ) -> Result<Response<Self::GetTopologyStream>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let pb::GetTopologyRequest { session_id, since_version, by_name } = request.into_inner();
        // Names belong to a snapshot.
        let call = if by_name { "SaveSnapshot" } else { "GetTopology" };
        let handle = self.0.seat(call, &session_id).await?.handle;
        let guard = handle.open_stream("GetTopology", StreamKind::ReadsOnly, &account)?;
        let parts = move |_: &CancelFlag| TopologyParts::new(&handle, since_version, by_name);
        let parts = self.0.job_pool.work(&account, parts).await?;
        Ok(Response::new(in_parts(parts, guard, TopologyParts::next)))
    }

    async fn get_wound(&self, request: Request<pb::GetWoundRequest>) -> Result<Response<Self::GetWoundStream>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let request = request.into_inner();
        let handle = self.0.seat("GetWound", &request.session_id).await?.handle;
        let grid = Refinement::new(&handle.model.scene, request.refinement, &self.0.config.limits)?;
        let guard = handle.open_stream("GetWound", StreamKind::ReadsOnly, &account)?;
        let parts = move |_: &CancelFlag| WoundParts::new(&handle, grid, &request);
        let parts = self.0.job_pool.work(&account, parts).await?;
        Ok(Response::new(in_parts(parts, guard, WoundParts::next)))
    }

    async fn get_burns(&self, request: Request<pb::GetBurnsRequest>) -> Result<Response<Self::GetBurnsStream>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let request = request.into_inner();
        let handle = self.0.seat("GetBurns", &request.session_id).await?.handle;
        let grid = Refinement::new(&handle.model.scene, request.refinement, &self.0.config.limits)?;
        let guard = handle.open_stream("GetBurns", StreamKind::ReadsOnly, &account)?;
        let parts = move |_: &CancelFlag| BurnParts::new(&handle, grid, request.since_version);
        let parts = self.0.job_pool.work(&account, parts).await?;
        Ok(Response::new(in_parts(parts, guard, BurnParts::next)))
    }

    async fn get_texture(
        &self,
        request: Request<pb::GetTextureRequest>,
    ) -> Result<Response<Self::GetTextureStream>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let request = request.into_inner();
        let handle = self.0.seat("GetTexture", &request.session_id).await?.handle;
        let guard = handle.open_stream("GetTexture", StreamKind::ReadsOnly, &account)?;
        let cut = guard.cut().clone();
        let Texture { png, etag } = self.0.textures.texture(&handle.id).await?;
        let png = if etag == request.known_etag { Bytes::new() } else { png };
        // An empty texture still has one part.
        let rest = Some((png, etag, guard));
        let out = stream::unfold(rest, |rest| async move {
            let (mut png, etag, guard) = rest?;
            let part = png.split_to(png.len().min(BYTES_PER_PART));
            let last = png.is_empty();
            let message = pb::GetTextureResponse { png: part, etag: etag.clone(), last };
            Some((Ok(message), (!last).then_some((png, etag, guard))))
        });
        Ok(Response::new(until_cut(out, cut)))
    }

    async fn watch_frames(
        &self,
        request: Request<pb::WatchFramesRequest>,
    ) -> Result<Response<Self::WatchFramesStream>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let request = request.into_inner();
        let handle = self.0.seat("WatchFrames", &request.session_id).await?.handle;
        let mut grid = Refinement::new(&handle.model.scene, request.refinement, &self.0.config.limits)?;
        if let Some(skin) = handle.skin.as_ref().filter(|_| request.cut_surface) {
            grid = skin.with_cut_surface(grid);
            grid.check("cut_surface", &self.0.config.limits)?;
        }
        let encoding = wire::sample::from_encoding(request.encoding)?;
        let most_hz = handle.model.scene.stepping.rate_hz;
        let rate_hz = request.rate_hz.unwrap_or(DEFAULT_RATE_HZ.min(most_hz));
        let range = format!("above 0 and at most the session's {most_hz}");
        number("rate_hz", rate_hz, &range, |v| v > 0.0 && v <= most_hz)?;
        if let Some(most) = request.max_frames_in_flight {
            number("max_frames_in_flight", f64::from(most), "from 1 to 64", |v| (1.0..=64.0).contains(&v))?;
        }
        let guard = handle.open_stream("WatchFrames", StreamKind::ReadsOnly, &account)?;
        let cut = guard.cut().clone();
        let room = self.0.config.limits.queued_bytes;
        let viewer_id = random_id()?;
        let (viewer, reader) = Viewer::new(
            viewer_id.clone(),
            grid,
            encoding,
            rate_hz,
            request.always_full,
            request.max_frames_in_flight,
            room,
            &account,
        )?;
        self.0.pacer.add_viewer(&handle, &viewer);
        info!(session = %handle.id, refinement = request.refinement, ?encoding, rate_hz, "viewer joined");
        let frames = ViewStream { viewer_id, reader, _guard: guard, messages: VecDeque::new(), last: None, skipped: 0 };
        let out = stream::unfold(Some(frames), |frames| async move { frames?.next().await });
        Ok(Response::new(until_cut(out, cut)))
    }

    async fn acknowledge_frames(
        &self,
        request: Request<pb::AcknowledgeFramesRequest>,
    ) -> Result<Response<pb::AcknowledgeFramesResponse>, Status> {
        let request = request.into_inner();
        self.0.pacer.viewer(&request.viewer_id)?.acknowledge(request.frame_id);
        Ok(Response::new(pb::AcknowledgeFramesResponse {}))
    }
}

/// Bytes of a texture per message.
const BYTES_PER_PART: usize = 64 << 10;
