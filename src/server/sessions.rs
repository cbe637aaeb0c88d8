//! `SessionService`: creates, starts, changes, pauses and deletes sessions; lists scenes, scripts and journals;
//! receives meshes.

use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use futures_util::stream::{self, Stream};
use palpate_proto::pb;
use palpate_proto::pb::session_service_server::SessionService;
use tonic::{Request, Response, Status};
use tracing::{info, warn};

use super::charged_caller::ChargedCaller;
use super::connections::Peer;
use super::curves;
use super::exercises;
use super::job_pool::CancelFlag;
use super::journals;
use super::meshes;
use super::services::Services;
use super::status;
use super::stream_termination::until_cut;
use super::trainee::{is_authenticated, unlisted};
use palpate_realtime::clock::now_ns;
use palpate_realtime::{SessionHandle, SessionReservation, StreamKind};
use palpate_refusal::{Reason, Refusal, number};
use palpate_session::budget::{Account, Purpose, Resource, Work};
use palpate_session::wire;
use palpate_tissue::scene::script::Script;

pub(super) struct Sessions(pub(super) Services);

/// Bytes of a snapshot per message.
const SNAPSHOT_PART_BYTES: usize = 64 << 10;

impl Sessions {
    /// Creates a session on this server, owned by `account`.
    ///
    /// # Errors
    /// Refuses a request from which no session can be created.
    pub(super) async fn create_here(
        &self,
        request: pb::CreateSessionRequest,
        account: Account,
    ) -> Result<pb::Session, Status> {
        use pb::create_session_request::Source;
        let most_s = self.0.config.idle_session_s;
        let idle_timeout_s = request.idle_timeout_s.unwrap_or(most_s);
        let range = format!("above 0 and at most {most_s}");
        number("idle_timeout_s", idle_timeout_s, &range, |value| value > 0.0 && value <= most_s)?;
        // Reading and compiling a large tissue takes a while.
        let pacer = self.0.pacer.clone();
        let payer = account.clone();
        let source = request.source;
        let mesh_id = match &source {
            Some(Source::Scene(scene)) => palpate_proto::scene::mesh_id(scene),
            _ => None,
        };
        let mesh = mesh_id.map(|mesh_id| self.0.meshes.get(mesh_id, &account)).transpose()?;
        let (catalog, config, recorded) = (self.0.catalog.clone(), self.0.config.clone(), self.0.recorded.clone());
        let birth = match &self.0.fleet {
            Some(fleet) => fleet.birth().await?,
            None => SessionReservation::new()?,
        };
        let birth = SessionReservation { recorded: config.journal_meshes || mesh.is_none(), ..birth };
        let named = birth.clone();
        let create = move |cancel: &CancelFlag| {
            let scene = match &source {
                Some(Source::SceneName(name)) => catalog.load(name, &[], &config.limits)?,
                Some(Source::Scene(scene)) => {
                    let made = wire::scene::from_scene(scene, mesh.as_deref());
                    made.map_err(|refusal| refusal.within("scene"))?
                }
                Some(Source::Exercise(exercise)) => {
                    let (how, services) = ((request.paused, idle_timeout_s), (&catalog, &*pacer, &config.limits));
                    return exercises::create(exercise, services, named, how, &payer, cancel);
                }
                Some(Source::Journal(moment)) => {
                    let how = (request.paused, idle_timeout_s);
                    return recorded.begin(moment, named, how, (&payer, &pacer), &config.limits, cancel.flag());
                }
                None => {
                    return Err(Refusal::new(
                        Reason::Missing,
                        "source",
                        "scene_name, scene, journal or exercise is missing",
                    ));
                }
            };
            pacer.create_as(named, &scene, (request.paused, idle_timeout_s), &payer, cancel.flag())
        };
        let made = self.0.job_pool.work(&account, create).await.and_then(|made| Ok(made?));
        if let Some(fleet) = &self.0.fleet {
            fleet.born(&birth, made.is_ok()).await;
        }
        let handle = made?;
        info!(session = %handle.id, scene = %handle.model.scene.name, points = handle.model.len(), "session created");
        let not_kept = journals::until_durable(&handle).await;
        for warning in &handle.model.warnings {
            warn!(session = %handle.id, warning);
        }
        let mut session = self.0.told(&handle);
        if let (Some(why), Some(journal)) = (not_kept, &mut session.journal) {
            warn!(session = %handle.id, why, "session created, but not kept");
            journal.fault = why;
        }
        Ok(session)
    }
}

#[tonic::async_trait]
impl SessionService for Sessions {
    type SaveSnapshotStream = Pin<Box<dyn Stream<Item = Result<pb::SaveSnapshotResponse, Status>> + Send>>;
    type GetScriptStream = Pin<Box<dyn Stream<Item = Result<pb::GetScriptResponse, Status>> + Send>>;

    async fn list_scenes(&self, _: Request<pb::ListScenesRequest>) -> Result<Response<pb::ListScenesResponse>, Status> {
        Ok(Response::new(pb::ListScenesResponse { scene_names: self.0.catalog.names(&self.0.config.limits) }))
    }

    async fn create_session(
        &self,
        request: Request<pb::CreateSessionRequest>,
    ) -> Result<Response<pb::CreateSessionResponse>, Status> {
        if let Some(peer) = request.extensions().get::<Peer>()
            && let Err((refusal, wait)) = peer.creations.pass()
        {
            info!(client = %peer.address, "session refused: {refusal}");
            self.0.traffic.refused(refusal.reason);
            tokio::time::sleep(wait).await;
            return Err(refusal.into());
        }
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let may_see_hidden = is_authenticated(request.extensions());
        let request = request.into_inner();
        if self.0.fleet.is_some() {
            exercises::check_no_fleet(&request)?;
        }
        if let Some(pb::create_session_request::Source::Journal(moment)) = &request.source {
            self.0.check_not_for_trainee(&moment.session_id)?;
            if !may_see_hidden {
                let (recorded, payer, moment) = (self.0.recorded.clone(), account.clone(), moment.clone());
                let check = move |_: &CancelFlag| recorded.check_hides_nothing(&moment, &payer);
                self.0.job_pool.work(&account, check).await??;
            }
        }
        if let Some(fleet) = &self.0.fleet
            && let Some(created) = fleet.create_elsewhere(&request, &account).await
        {
            return created.map(|session| Response::new(pb::CreateSessionResponse { session: Some(session) }));
        }
        let session = Some(self.create_here(request, account).await?);
        Ok(Response::new(pb::CreateSessionResponse { session }))
    }

    async fn upload_mesh(
        &self,
        request: Request<pb::UploadMeshRequest>,
    ) -> Result<Response<pb::UploadMeshResponse>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let request = request.into_inner();
        let how = if request.last { Some(meshes::read_as(&request)?) } else { None };
        let mut answer = self.0.meshes.add(&request, &account)?;
        let Some(how) = how else { return Ok(Response::new(answer)) };
        let reading = self.0.meshes.read(&answer.mesh_id, &request.file_name, &account)?;
        let read = move |cancel: &CancelFlag| reading.finish(how, request.repair, cancel.flag());
        let report = self.0.job_pool.work(&account, read).await??;
        info!(
            caller = account.name(),
            bytes = answer.received_bytes,
            vertices = report.vertices,
            refused = report.refused,
            "mesh received"
        );
        answer.report = Some(report);
        answer.kept = self.0.recorded.told_of_meshes();
        Ok(Response::new(answer))
    }

    async fn upload_journal(
        &self,
        request: Request<pb::UploadJournalRequest>,
    ) -> Result<Response<pb::UploadJournalResponse>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let request = request.into_inner();
        let mut answer = self.0.recorded.add(&request, &account)?;
        if request.last {
            let (recorded, payer, id) = (self.0.recorded.clone(), account.clone(), answer.upload_id.clone());
            let read = move |cancel: &CancelFlag| recorded.read(&id, &payer, cancel.flag());
            let told = self.0.job_pool.work(&account, read).await??;
            info!(caller = account.name(), bytes = answer.received_bytes, steps = told.end_step, "journal received");
            answer.journal = Some(told);
        }
        Ok(Response::new(answer))
    }

    async fn list_journals(
        &self,
        request: Request<pb::ListJournalsRequest>,
    ) -> Result<Response<pb::ListJournalsResponse>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let (recorded, pacer) = (self.0.recorded.clone(), self.0.pacer.clone());
        let mut answer = self.0.job_pool.work(&account, move |_: &CancelFlag| recorded.list(&pacer)).await??;
        for handle in self.0.pacer.list().iter().filter(|handle| unlisted(handle, request.extensions()).is_some()) {
            answer.journals.retain(|journal| journal.session_id != handle.id);
        }
        Ok(Response::new(answer))
    }

    async fn get_journal(
        &self,
        request: Request<pb::GetJournalRequest>,
    ) -> Result<Response<pb::GetJournalResponse>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let (recorded, pacer, request) = (self.0.recorded.clone(), self.0.pacer.clone(), request.into_inner());
        self.0.check_not_for_trainee(&request.session_id)?;
        let tell = move |_: &CancelFlag| recorded.told(&request, &pacer);
        Ok(Response::new(self.0.job_pool.work(&account, tell).await??))
    }

    async fn save_snapshot(
        &self,
        request: Request<pb::SaveSnapshotRequest>,
    ) -> Result<Response<Self::SaveSnapshotStream>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let handle = self.0.seat("SaveSnapshot", &request.get_ref().session_id).await?.handle;
        let bytes = 4 * handle.model.state_bytes() + handle.model.bytes();
        let taken = account.take(Resource::Memory(Purpose::Records), bytes, "session_id")?;
        let present = handle.save().await?;
        let encode = move |_: &CancelFlag| journals::recorded::snapshot(&handle, &present);
        let file = self.0.job_pool.work(&account, encode).await??;
        let parts = stream::unfold((file, 0, taken), |(file, from, taken)| async move {
            let end = file.len().min(from + SNAPSHOT_PART_BYTES);
            let part = (from < end).then(|| file[from..end].to_vec())?;
            Some((Ok(pb::SaveSnapshotResponse { part }), (file, end, taken)))
        });
        Ok(Response::new(Box::pin(parts)))
    }

    async fn get_session(
        &self,
        request: Request<pb::GetSessionRequest>,
    ) -> Result<Response<pb::GetSessionResponse>, Status> {
        let seat = self.0.seat("GetSession", &request.get_ref().session_id).await?;
        Ok(Response::new(pb::GetSessionResponse { session: Some(self.0.told_to(&seat)) }))
    }

    async fn list_sessions(
        &self,
        request: Request<pb::ListSessionsRequest>,
    ) -> Result<Response<pb::ListSessionsResponse>, Status> {
        let told = |handle: &Arc<SessionHandle>| match unlisted(handle, request.extensions()) {
            Some(exercise) => status::of_trainee(handle, exercise),
            None => self.0.told(handle),
        };
        let without_scene = |handle: &Arc<_>| pb::Session { scene: None, ..told(handle) };
        let served = self.0.pacer.list().into_iter().filter(|handle| !handle.is_coming());
        let sessions = served.map(|handle| without_scene(&handle)).collect();
        Ok(Response::new(pb::ListSessionsResponse { sessions }))
    }

    async fn delete_session(
        &self,
        request: Request<pb::DeleteSessionRequest>,
    ) -> Result<Response<pb::DeleteSessionResponse>, Status> {
        let id = &request.get_ref().session_id;
        let handle = self.0.session(id).await?;
        self.0.pacer.delete(id)?;
        info!(session = %id, "session deleted");
        let journal_fault = journals::until_complete(&handle).await.unwrap_or_default();
        if let Some(fleet) = &self.0.fleet {
            fleet.until_deleted(id).await?;
        }
        Ok(Response::new(pb::DeleteSessionResponse { journal_fault }))
    }

    async fn delete_journal(
        &self,
        request: Request<pb::DeleteJournalRequest>,
    ) -> Result<Response<pb::DeleteJournalResponse>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let id = request.into_inner().session_id;
        self.0.check_not_for_trainee(&id)?;
        let (recorded, pacer) = (self.0.recorded.clone(), self.0.pacer.clone());
        let remove = move |_: &CancelFlag| recorded.remove(&id, &pacer);
        let files = self.0.job_pool.work(&account, remove).await??;
        Ok(Response::new(pb::DeleteJournalResponse { files }))
    }

    async fn start_session(
        &self,
        request: Request<pb::StartSessionRequest>,
    ) -> Result<Response<pb::StartSessionResponse>, Status> {
        let request = request.into_inner();
        let handle = self.0.seat("StartSession", &request.session_id).await?.handle;
        let step = self.0.pacer.start_session(&handle, request.until_step).await?;
        Ok(Response::new(pb::StartSessionResponse { step }))
    }

    async fn update_tissue(
        &self,
        request: Request<pb::UpdateTissueRequest>,
    ) -> Result<Response<pb::UpdateTissueResponse>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let request = request.into_inner();
        let handle = self.0.session(&request.session_id).await?;
        if handle.exercise.is_some() {
            // What a trainee is told of the tissue is that of the beginning.
            let message = "is made for an exercise, whose coefficients stay as they are; HideLump adds a lump";
            return Err(Refusal::new(Reason::WrongKind, "session_id", message).into());
        }
        let (change, to_change, pacer) = (wire::scene::from_change(&request), handle.clone(), self.0.pacer.clone());
        let change =
            move |cancel: &CancelFlag| pacer.change_tissue(&to_change, &change, request.at_step, cancel.flag());
        let (step, model) = self.0.job_pool.work(&account, change).await??;
        info!(
            session = %handle.id,
            step,
            stiffness_n_per_m = model.scene.springs.stiffness_n_per_m,
            damping_n_s_per_m = model.scene.damping_n_s_per_m,
            anchor_stiffness_n_per_m = model.scene.anchor_stiffness_n_per_m,
            volume_stiffness_pa = model.scene.volume_stiffness_pa,
            "tissue changed"
        );
        for warning in &model.warnings {
            warn!(session = %handle.id, warning);
        }
        let session = Some(status::with_model(self.0.told(&handle), &model));
        Ok(Response::new(pb::UpdateTissueResponse { step, session }))
    }

    async fn pause_session(
        &self,
        request: Request<pb::PauseSessionRequest>,
    ) -> Result<Response<pb::PauseSessionResponse>, Status> {
        self.0.session(&request.get_ref().session_id).await?.pause().await?;
        Ok(Response::new(pb::PauseSessionResponse {}))
    }

    async fn get_state_hash(
        &self,
        request: Request<pb::GetStateHashRequest>,
    ) -> Result<Response<pb::GetStateHashResponse>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let request = request.into_inner();
        let handle = self.0.seat("GetStateHash", &request.session_id).await?.handle;
        // A request for the current hash waits for its caller's share. A request for a later step must reach that
        // step.
        let wait_ns = account.must_wait_ns(Work::Reading, now_ns());
        if request.at_step.is_none() && wait_ns > 0 {
            tokio::time::sleep(Duration::from_nanos(wait_ns)).await;
        }
        let (step, hash) = handle.hash_at(request.at_step, &account).await?;
        Ok(Response::new(pb::GetStateHashResponse { step, state_hash: format!("{hash:032x}") }))
    }

    async fn locate_session(
        &self,
        request: Request<pb::LocateSessionRequest>,
    ) -> Result<Response<pb::LocateSessionResponse>, Status> {
        let ownership = self.0.fleet()?.locate(&request.get_ref().session_id).await?;
        Ok(Response::new(pb::LocateSessionResponse { ownership: Some(ownership) }))
    }

    async fn compare_curves(
        &self,
        request: Request<pb::CompareCurvesRequest>,
    ) -> Result<Response<pb::CompareCurvesResponse>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let request = request.into_inner();
        let handle = self.0.session(&request.session_id).await?;
        let model = handle.tissue().borrow().1.clone();
        let taken = account.take(Resource::Memory(Purpose::Session), model.session_bytes(), "session_id")?;
        let config = self.0.config.clone();
        let compare = move |cancel: &CancelFlag| {
            let _taken = taken;
            curves::compare(&request, &model, &config.limits, cancel.flag())
        };
        Ok(Response::new(self.0.job_pool.work(&account, compare).await??))
    }

    async fn list_scripts(
        &self,
        request: Request<pb::ListScriptsRequest>,
    ) -> Result<Response<pb::ListScriptsResponse>, Status> {
        let pb::ListScriptsRequest { session_id } = request.into_inner();
        let script_names = if session_id.is_empty() {
            self.0.catalog.script_names(&self.0.config.limits)
        } else {
            let handle = self.0.seat("ListScripts", &session_id).await?.handle;
            self.0.catalog.script_names_for(&handle.model.scene.name, &self.0.config.limits)
        };
        Ok(Response::new(pb::ListScriptsResponse { script_names }))
    }

    async fn get_script(
        &self,
        request: Request<pb::GetScriptRequest>,
    ) -> Result<Response<Self::GetScriptStream>, Status> {
        let ChargedCaller { account, .. } = ChargedCaller::of(request.extensions());
        let request = request.into_inner();
        let handle = self.0.seat("GetScript", &request.session_id).await?.handle;
        let guard = handle.open_stream("GetScript", StreamKind::ReadsOnly, &account)?;
        let cut = guard.cut().clone();
        let (catalog, config) = (self.0.catalog.clone(), self.0.config.clone());
        // A script may contain megabytes of traces.
        let read = move |_: &CancelFlag| catalog.script(&request.script_name, &handle.model.scene, &config.limits);
        let script = self.0.job_pool.work(&account, read).await??;
        let out = stream::unfold(Some((script, 0, guard)), |state| async move {
            let (script, from, guard) = state?;
            let (message, next) = script_part(&script, from);
            Some((Ok(message), next.map(|next| (script, next, guard))))
        });
        Ok(Response::new(until_cut(out, cut)))
    }
}

/// Commands per message, about 50 KiB.
const COMMANDS_PER_PART: usize = 500;

/// Steps searched per message: a script of a week must not occupy a thread.
const STEPS_PER_PART: u64 = 100_000;

/// Returns the message with the script's commands from step `from` on, and the step at which the next message begins;
/// `None` after the last.
#[allow(clippy::cast_possible_truncation)]
fn script_part(script: &Script, from: u64) -> (pb::GetScriptResponse, Option<u64>) {
    let mut message = pb::GetScriptResponse { steps: script.steps, tools: script.tools() as u32, ..Default::default() };
    if from == 0 {
        message.warnings.clone_from(&script.warnings);
    }
    let end = script.steps.min(from + STEPS_PER_PART);
    let mut step = from;
    while step < end && message.commands.len() < COMMANDS_PER_PART {
        let commands = script
            .actions_at(step)
            .map(|(tool, action)| wire::command::scripted(&*script.shape, tool, step, &action, 0));
        message.commands.extend(commands);
        step += 1;
    }
    message.last = step == script.steps;
    let next = (!message.last).then_some(step);
    (message, next)
}
