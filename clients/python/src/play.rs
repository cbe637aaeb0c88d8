//! Plays a script on a session of a server: each command acts at its exact step.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use palpate_client::Followed;
use palpate_client::held_tools::{acquire, send};
use palpate_proto::pb;
use palpate_session::wire;
use palpate_tissue::scene;
use palpate_tissue::scene::plot::Curves;
use palpate_tissue::scene::record::{Record, Run, Summary};
use palpate_tissue::shape;
use pb::haptic_service_client::HapticServiceClient;
use pb::session_service_client::SessionServiceClient;
use pyo3::prelude::*;

use crate::client::{HOLDER, called};
use crate::error::{failed, of_client, of_status, refused, wrong};
use crate::run::RunRecord;
use crate::scene::Script;

/// Number of steps whose commands are sent at a time, up to twice as many ahead: fewer than a session queues.
const CHUNK: u64 = 1000;

/// Interval at which the session's progress is checked.
const LOOK: Duration = Duration::from_millis(10);

/// Interval between renewals of the leases of idle tools.
const RENEWAL: Duration = Duration::from_secs(1);

/// A script being played, and its session.
struct PlaySource {
    session: Arc<Followed>,
    script: scene::script::Script,
    /// The step of the session at which the script starts.
    begin: u64,
    /// The lease of each tool.
    leases: BTreeMap<u32, String>,
    renewed: Instant,
}

impl PlaySource {
    fn id(&self) -> String {
        self.session.session_id().to_owned()
    }

    async fn take_tools(&mut self) -> PyResult<()> {
        for tool in 0..u32::try_from(self.script.tools()).unwrap_or(u32::MAX) {
            let lease = acquire(&self.session, tool, HOLDER).await.map_err(of_client)?;
            self.leases.insert(tool, lease);
        }
        Ok(())
    }

    async fn give_tools_back(&mut self) -> PyResult<()> {
        for lease_id in std::mem::take(&mut self.leases).into_values() {
            let request = pb::ReleaseToolRequest { session_id: self.id(), lease_id };
            called!(self.session, HapticServiceClient.release_tool(request))?;
        }
        Ok(())
    }

    /// Sends the commands of these steps of the script.
    async fn send(&self, steps: std::ops::Range<u64>) -> PyResult<()> {
        let mut commands: BTreeMap<u32, Vec<pb::Command>> = BTreeMap::new();
        for step in steps {
            for (tool, action) in self.script.actions_at(step) {
                let command = wire::command::scripted(&*self.script.shape, tool, self.begin + step, &action, 0);
                commands.entry(command.tool).or_default().push(command);
            }
        }
        for (tool, commands) in commands {
            let lease = self.leases.get(&tool).map_or("", String::as_str);
            send(&self.session, lease, commands).await.map_err(of_client)?;
        }
        Ok(())
    }

    async fn start_until(&self, step: u64) -> PyResult<()> {
        let until_step = Some(self.begin + step);
        let request = pb::StartSessionRequest { session_id: self.id(), until_step };
        called!(self.session, SessionServiceClient.start_session(request)).map(drop)
    }

    /// Waits until `step` steps of the script are done. Raises Failed if the session is stopped.
    async fn until(&mut self, step: u64) -> PyResult<pb::Session> {
        loop {
            let request = pb::GetSessionRequest { session_id: self.id() };
            let session = called!(self.session, SessionServiceClient.get_session(request))?.session.unwrap_or_default();
            if !session.hold_reason.is_empty() {
                return Err(failed(&session.hold_reason));
            }
            if session.step >= self.begin + step {
                return Ok(session);
            }
            if self.renewed.elapsed() >= RENEWAL {
                for lease in self.leases.values() {
                    send(&self.session, lease, Vec::new()).await.map_err(of_client)?;
                }
                self.renewed = Instant::now();
            }
            tokio::time::sleep(LOOK).await;
        }
    }

    /// Plays the whole script. The session runs only as far as all its commands have been sent, so none is ever late.
    async fn drive(&mut self) -> PyResult<pb::Session> {
        let steps = self.script.steps;
        let (mut sent, mut session) = (0, pb::Session::default());
        loop {
            let before = sent;
            sent = (sent + CHUNK).min(steps);
            self.send(before..sent).await?;
            self.start_until(sent).await?;
            session = match sent == steps {
                true => return self.until(steps).await,
                false if before > 0 => self.until(before).await?,
                false => session,
            };
        }
    }
}

/// Receives the records of a script until the last one.
async fn records(
    mut stream: tonic::Streaming<pb::ProbeResponse>,
    mut left: u64,
    recorded: &mut RunRecord,
) -> PyResult<()> {
    let mut record = Record::default();
    while left > 0 {
        let message = stream.message().await.map_err(of_status)?;
        let message = message.ok_or_else(|| failed("the server has ended the stream of records"))?;
        if message.dropped_records > 0 {
            return Err(failed("records were lost: this client can't keep up with so many points at this rate"));
        }
        if wire::sample::add_to_record(&mut record, &message) {
            recorded.add(&std::mem::take(&mut record));
            left -= 1;
        }
    }
    Ok(())
}

/// Returns the scene of a session: the caller's own, or the one that the server reports.
fn scene_of(own: Option<Arc<scene::Scene>>, session: &pb::Session) -> PyResult<Arc<scene::Scene>> {
    if let Some(own) = own {
        return Ok(own);
    }
    let told = session.scene.as_ref().ok_or_else(|| failed("the server sent no scene"))?;
    if palpate_proto::scene::mesh_id(told).is_some() {
        return Err(wrong("scene", "is missing: the session is on a mesh, whose scene you have to give"));
    }
    wire::scene::from_scene(told, None).map(Arc::new).map_err(refused)
}

/// Plays a script on a paused session.
#[allow(clippy::cast_precision_loss)]
pub(crate) async fn play(
    session: Arc<Followed>,
    own: Option<Arc<scene::Scene>>,
    script: Script,
) -> PyResult<RunRecord> {
    let request = pb::GetSessionRequest { session_id: session.session_id().to_owned() };
    let told = called!(session, SessionServiceClient.get_session(request))?.session.unwrap_or_default();
    if told.state() != pb::SessionState::Paused {
        return Err(wrong(
            "session",
            "must stand, so that no command is late: pause it, or create it with paused=True",
        ));
    }
    let scene = scene_of(own, &told)?;
    let script = script.bound(&scene).map_err(refused)?;
    let (begin, steps, every) = (told.step, script.steps, script.sample_every);
    let mut recorded = RunRecord::of(&script);
    let run = Run {
        scene: scene.name.clone(),
        script: script.name.clone(),
        integrator: told.integrator.clone(),
        substeps: told.substeps,
        precision: told.precision.clone(),
        rate_hz: scene.stepping.rate_hz,
        version: env!("CARGO_PKG_VERSION").to_owned(),
    };
    let points = scene.shape().point_count();
    let warnings = told.warnings.iter().chain(&script.warnings).cloned().collect();
    for (step, change) in &script.changes {
        let update = wire::scene::update_tissue(session.session_id(), change, begin + step);
        called!(session, SessionServiceClient.update_tissue(update))?;
    }
    let is_everywhere = script.sample_points.iter().copied().eq(shape::points(scene.shape()));
    let named = || wire::probed(script.sample_points.iter().map(|point| script.shape.name(*point)));
    let probe = pb::ProbeRequest {
        session_id: session.session_id().to_owned(),
        r#where: Some(if is_everywhere { pb::probe_request::Where::AllPoints(true) } else { named() }),
        every_steps: Some(every.try_into().unwrap_or(u32::MAX)),
        energy: true,
        tools: !script.poses.is_empty(),
    };
    let stream = called!(session, HapticServiceClient.probe(probe))?;
    // Records are counted from step 0 of the session, which has a record of its own.
    let expected = (begin + steps) / every - begin / every + u64::from(begin == 0);
    let mut player = PlaySource { session, script, begin, leases: BTreeMap::new(), renewed: Instant::now() };
    player.take_tools().await?;
    let begun = Instant::now();
    let (ended, ()) = tokio::try_join!(player.drive(), records(stream, expected, &mut recorded))?;
    let wall_s = begun.elapsed().as_secs_f64();
    let asked = pb::GetStateHashRequest { session_id: player.id(), at_step: None };
    let final_hash = called!(player.session, SessionServiceClient.get_state_hash(asked))?.state_hash;
    player.give_tools_back().await?;
    if ended.late_commands > told.late_commands {
        return Err(failed("commands came late, so the run differs from the script"));
    }
    let substeps = steps * u64::from(ended.substeps);
    let summary = Summary {
        steps,
        substeps,
        points,
        wall_s,
        ns_per_point_substep: wall_s * 1e9 / (substeps as f64 * points as f64),
        // The server does not report it.
        computed_fraction: f64::NAN,
        guard_events: 0,
        topology: None,
        final_hash,
        audited_error: None,
        mesh_error_estimate: None,
        corrections: Vec::new(),
        recoveries: ended.recoveries.into_iter().map(wire::sample::from_recovery).collect(),
        jaw_overloads: Vec::new(),
        ties: Vec::new(),
        warnings,
        largest_displacement_m: f64::NAN,
        peak_reaction_n: f64::NAN,
        curves: Curves::default(),
        stages: Vec::new(),
        network: None,
    };
    recorded.finish(run, summary);
    Ok(recorded)
}
