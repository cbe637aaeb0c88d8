//! One tissue in use: the actions of the tools, the forces on them, and the records. It has no clock and no socket:
//! a session with equal commands at equal steps gives equal bits.
//!
//! **Held and continuous forces.** `palpate run` takes a script's force as a function of time. Commands, and `run
//! --held`, keep a force constant over each step. `Script::actions_at` defines once what a client commands at each
//! step; offline runs and replays send that through the intake that a server uses, so their hashes are equal. A
//! grasped point reaches its target at the *end* of the command's step with constant velocity: its place at each
//! step is exact, and no substep sees a jump.
//!
//! **Records.** A record at a jump of force has the forces just before it; at t = 0, just after.
//!
//! **Order.** Commands that are due at one step act in the order of their tools' numbers, not of arrival: two
//! clients that stamp their commands get equal bits whichever network was faster. A second tool that grasps a point
//! takes it over.

pub mod audit;
pub mod batch;
pub mod budget;
pub mod check;
pub mod chosen_exercise;
pub mod command;
mod copied_cuts;
pub mod current_laws;
pub mod exercise_judge;
pub mod felt_lump;
pub mod indentation;
pub mod input;
pub mod intake;
pub mod intake_transfer;
pub mod journal;
pub mod lease;
pub mod led_instrument;
pub mod local_model;
pub mod measure_recorder;
pub mod measured_run;
pub mod phase_run;
pub mod press;
pub mod queue;
pub mod recovery;
pub mod rules;
pub mod run;
pub mod sample_selection;
mod scene_report;
pub mod schedule;
pub mod simulation;
pub mod snapshot;
pub mod surface;
pub mod tissue_copy;
pub mod wire;

use std::sync::Arc;

use glam::DVec3;

use command::Due;
use palpate_haptics::pose_playback::{Path, Play};
use palpate_haptics::prediction::MAX_OTHERS;
use palpate_haptics::{LocalModel, MotionState, OtherTool, ReportedSpring, Tip};
use palpate_refusal::Result;
use palpate_tissue::memory;
use palpate_tissue::scene::action::MAX_MARKS;
use palpate_tissue::scene::profile::{LoadProfile, MotionProfile, Poke};
use palpate_tissue::scene::record::{EnergyJ, Point, Record, Recovery, ToolRecord};
use palpate_tissue::scene::script::{Action, PlaceMark};
use palpate_tissue::select::audit::{Mark, WindowInputs};
use palpate_tissue::shape::{self, PointId, PointName};
use palpate_tissue::{self as tissue, BlowUp, Energy, Grasp, Model, PointState, Push, ReadCopy, Tissue, ToolContact};
use recovery::{Ended, Recovered, Recoveries, describe};

/// A small organ whose points differ in mass.
#[cfg(test)]
const GALLBLADDER: &str = "[mesh]\norgan = { name = \"gallbladder\", edge_m = 0.0035 }\n[material]\nyoungs_modulus_pa = 2e4\n\
    thickness_m = 0.003\nfoundation_n_per_m3 = 5e6\n[stepping]\nsubsteps = 8\n";

/// The name of a record in messages about missing memory.
const RECORD: &str = "a record";

/// Sample of one tool at the end of a step: its state, the forces on it, and the newest command that took effect. A
/// number that no command has named yet gives a sample of zeros, without `contact` and `feel`.
#[derive(Debug, Clone, PartialEq)]
pub struct ToolSample {
    /// The tool's number, from 0.
    pub tool: u32,
    /// Highest sequence number of the commands whose step has come; also of those without effect because the tool is
    /// paused. 0 before the first, and again after the end of a lease.
    pub acknowledged_sequence: u64,
    /// Time of that command, ns of the client's clock; 0 if it has none.
    pub client_time_ns: u64,
    /// Arrival of that command, ns of the server's clock; 0 before the first, and without a network.
    pub arrival_ns: u64,
    /// Motion and forces at the tool's control point. `None` before the first command that gives the tool a point; a
    /// tool that has let go keeps its last point.
    pub contact: Option<Contact>,
    /// Motion and force of the tip itself, for a tool that is led by poses; `None` for any other tool, and after a
    /// release.
    pub feel: Option<ToolContact>,
    /// Client time of the place that a tool led by poses has now, s; 0 for any other tool.
    pub place_time_s: f64,
    /// Local model for the client's rendering. [`Session::sample`] leaves it `None`; a
    /// [`Sampler`](sample_selection::Sampler) fills it in if the stream has force laws and the tool is led by poses.
    pub local: Option<LocalModel>,
    /// Whether the tool stays where it is because no pose has arrived for 50 ms
    /// ([`palpate_haptics::pose_playback::HOLD_S`]). After 250 ms it lets go, and `expired` is set.
    pub stale: bool,
    /// Whether the newest command came too late for its step, so it acted at a later one.
    pub late: bool,
    /// Whether the tool's action was ended by its time to live, with its lease, for lack of poses, or by a recovery;
    /// or the newest command had no effect because the tool is paused. The next command that acts clears it.
    pub expired: bool,
    /// The step before which commands to the tool, except releases, have no effect; `None` if it was never paused
    /// ([`recovery`]). It stays after that step.
    pub paused_until: Option<u64>,
}

/// Motion and forces at a tool's control point: the mass point that it acts on. All vectors are in the tissue's frame
/// (x and y along a sheet, z out of it).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Contact {
    /// The mass point: the one that is pushed or grasped, or the one nearest to a force's centre or to the place
    /// under a tip.
    pub point: PointId,
    /// Displacement of the point from rest, m; under a tip the displacement of the surface, as the mean over the
    /// tip's disc.
    pub displacement_m: DVec3,
    /// Displacement of the surface exactly under the control point, m, interpolated between points; equals that of
    /// the point if the tool was given a point.
    pub surface_displacement_m: DVec3,
    /// Velocity of the point, m/s; of a tip, that of the tool.
    pub velocity_m_per_s: DVec3,
    /// Force of the tissue on the tool, N: springs, anchor spring and damping. For a push around a place it is the
    /// mean of the points' reactions, weighted as the force is.
    pub force_on_tool_n: DVec3,
    /// Force of all tools on the point, N; under a tip, the force of that tool on the tissue.
    pub applied_force_n: DVec3,
}

/// Samples of the tools at the end of a step, with the state of the session. [`Session::sample`] makes it.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    /// Number of steps done.
    pub step: u64,
    /// Simulated time, s.
    pub simulation_time_s: f64,
    /// Number of points that a step computes now; 0 if the whole tissue is asleep.
    pub awake_points: usize,
    /// Number of commands so far that came too late for their step.
    pub late_commands: u64,
    /// Whether the session is stopped by the guard, by a fault or by [`Session::hold`]: it is not stepped any more.
    pub held: bool,
    /// Whether blades only push, because a solid has no room for further cuts ([`Session::cuts_exhausted`]).
    pub cuts_exhausted: bool,
    /// The version of the topology ([`palpate_tissue::Cuts::version`]).
    pub topology_version: u32,
    /// Number of recoveries so far: returns of the tissue to an earlier state ([`recovery`]).
    pub recoveries: u64,
    /// The newest recovery, with the tools that had acted; `None` before the first. It stays until the next one.
    pub recovered: Option<Arc<Recovered>>,
    /// Samples of the tools: those that ever had a control point by ascending number, or the requested ones in the
    /// order of the request.
    pub tools: Vec<ToolSample>,
    /// Other tools ([`Session::other_tools`]), if a [`Sampler`](sample_selection::Sampler) was to add them.
    pub other_tools: Vec<OtherTool>,
}

#[derive(Debug, Clone, Default)]
struct Tool {
    acknowledged_sequence: u64,
    client_time_ns: u64,
    arrival_ns: u64,
    control_point: Option<PointId>,
    /// The push whose reaction is measured around its centre, if it was given by a place and not by a point.
    around: Option<Poke>,
    expires_at: Option<u64>,
    late: bool,
    expired: bool,
    posed: Option<Posed>,
    paused_until: Option<u64>,
}

/// A tool that is led by poses.
#[derive(Debug, Clone)]
struct Posed {
    tip: Tip,
    path: Path,
    /// Client time of its place, s.
    client_time_s: f64,
}

/// A tissue with its tools and their commands' effects: what a server, a run or a replay advances step by step.
///
/// A fingertip presses 3 mm into the middle of a sheet at rest. Half a second later the surface under it is as deep,
/// and pushes back:
///
/// ```
/// use glam::DVec3;
/// use palpate_haptics::Tip;
/// use palpate_session::Session;
/// use palpate_session::command::{Command, Due};
/// use palpate_tissue::Model;
/// use palpate_tissue::scene::PAPER;
/// use palpate_tissue::scene::script::Action;
///
/// let model = Model::parse("paper", PAPER, &["sheet.points=[9, 9]"])?;
/// let place_m = model.shape().extent().middle_m() - 0.003 * DVec3::Z;
/// let tip = Tip { radius_m: 0.04, ..Tip::default() };
/// let press = Action::Pose { place_m, velocity_m_per_s: None, tip };
/// let mut session = Session::new(&model);
/// let mut due = vec![Due::in_time(Command::new(0, Some(1), press))];
/// for _ in 0..500 {
///     session.advance(&mut due, |_| {});
/// }
/// assert_eq!((session.step_count(), session.time_s()), (500, 0.5));
/// let sample = session.sample(None);
/// let contact = sample.tools[0].contact.expect("the tool acts");
/// assert!((contact.displacement_m.z + 0.003).abs() < 1e-5, "{} m", contact.displacement_m);
/// assert!(contact.force_on_tool_n.z > 0.0, "{} N", contact.force_on_tool_n);
/// # Ok::<(), palpate_refusal::Refusal>(())
/// ```
pub struct Session {
    tissue: Box<dyn Tissue>,
    tools: Vec<Tool>,
    late_commands: u64,
    paused_commands: u64,
    path_counts: [u64; 3],
    recoveries: Recoveries,
    hold_reason: Option<String>,
    marks: Vec<RecordedMark>,
}

/// A place that somebody marked on the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RecordedMark {
    /// Number of steps done when it was made.
    pub step: u64,
    /// The tool whose holder made it.
    pub tool: u32,
    /// The mark.
    pub mark: PlaceMark,
}

impl Session {
    /// Creates a session of a tissue at rest, at step 0, without tools. It unwinds with a refusal if there is no
    /// memory for the state ([`memory::attempt`]).
    pub fn new(model: &Arc<Model>) -> Self {
        Session {
            tissue: tissue::at_rest(model),
            tools: Vec::new(),
            late_commands: 0,
            paused_commands: 0,
            path_counts: [0; 3],
            recoveries: Recoveries::default(),
            hold_reason: None,
            marks: Vec::new(),
        }
    }

    /// Returns the model of the present tissue: that of [`Session::new`], or of the last [`Session::change`].
    pub fn model(&self) -> &Arc<Model> {
        self.tissue.model()
    }

    /// Returns the tissue, read-only: its points, forces and hash at the present step.
    pub fn tissue(&self) -> &dyn Tissue {
        &*self.tissue
    }

    /// Begins to measure how long each stage of a step takes ([`Tissue::time_stages`]).
    pub fn time_stages(&mut self, now_ns: Option<fn() -> u64>) {
        self.tissue.time_stages(now_ns);
    }

    /// Returns the number of steps done, with skipped ones. A recovery does not lower it.
    pub fn step_count(&self) -> u64 {
        self.tissue.step_count()
    }

    /// Returns the simulated time, s: the number of steps done over the step rate.
    #[allow(clippy::cast_precision_loss)]
    pub fn time_s(&self) -> f64 {
        self.step_count() as f64 / self.model().scene.stepping.rate_hz
    }

    /// Returns whether a solid has no spare places left for the corners that one more severed face could double, so that blades only
    /// push. Another tissue always has room.
    pub fn cuts_exhausted(&self) -> bool {
        !self.tissue.cuts().has_room(self.model())
    }

    /// Returns why the session is stopped for good; `None` if it is not. The reason comes from a blow-up after which
    /// a recovery would not help, or from [`Session::hold`].
    pub fn hold_reason(&self) -> Option<&str> {
        self.hold_reason.as_deref()
    }

    /// Stops the session for good, as the guard does: [`Session::advance`] does nothing but discard commands from now
    /// on. `reason` is for people; if there is one already, that is kept.
    pub fn hold(&mut self, reason: String) {
        self.hold_reason.get_or_insert(reason);
    }

    /// Returns the number of commands so far that came too late for their step, with those that a later one
    /// superseded.
    pub fn late_commands(&self) -> u64 {
        self.late_commands
    }

    /// Returns the number of commands so far without effect because their tool was paused ([`recovery`]).
    pub fn paused_commands(&self) -> u64 {
        self.paused_commands
    }

    /// Returns the marks that were made since the session began or continued, in their order: at most 1024, further ones are ignored.
    pub fn marks(&self) -> &[RecordedMark] {
        &self.marks
    }

    /// Returns the tools that are led by poses now, by ascending number, with their tips; not those that have let go.
    #[allow(clippy::cast_possible_truncation)]
    pub fn tips(&self) -> impl Iterator<Item = (u32, Tip)> {
        let of = |(tool, state): (usize, &Tool)| Some((tool as u32, state.posed.as_ref()?.tip));
        self.tools.iter().enumerate().filter_map(of)
    }

    /// Returns three sums of [`Path::counts`] over all tools and all their touches so far: steps in which the speed
    /// limit of 0.5 m/s acted on a tool, poses that were refused or skipped, and releases for lack of poses.
    pub fn path_counts(&self) -> [u64; 3] {
        self.path_counts
    }

    /// Returns the step count at which the first action's time to live ends, while nothing happens before without a
    /// new command: `u64::MAX` if nothing ever does. `None` if the tissue moves or a tool is led by poses, so that
    /// each step must be computed.
    pub fn rests_until(&self) -> Option<u64> {
        let expiry = self.tools.iter().filter_map(|tool| tool.expires_at).min();
        // A path may move a tool at any time.
        let still = self.tissue.is_still() && self.tools.iter().all(|tool| tool.posed.is_none());
        still.then(|| expiry.unwrap_or(u64::MAX))
    }

    /// Skips to the moment when `step` steps are done; does nothing if they are done already. Call it only if
    /// [`Session::rests_until`] is `Some`, and with no later step: this is not checked. The result equals that of
    /// single steps without commands. Nothing is observed.
    pub fn skip_to(&mut self, step: u64) {
        self.tissue.skip_steps(step.saturating_sub(self.step_count()));
    }

    /// Changes the tissue, from the coming step on, to that of `model`, which must come from [`Model::changed`] or
    /// [`Model::corrected`] of this session's model (not checked). Displacements, velocities and tools stay; all
    /// tiles wake.
    pub fn change(&mut self, model: &Arc<Model>) {
        match self.tissue.changed(model) {
            Some(tissue) => self.tissue = tissue,
            None => self.tissue.change(model),
        }
    }

    /// Severs springs in the copy of a tissue that a client has, as its server reports them ([`Tissue::sever`]). It is no command: a
    /// session of which a journal is written must not use it.
    ///
    /// # Errors
    /// Refuses springs of which the tissue lacks one; then it severs none.
    fn sever(&mut self, springs: &[ReportedSpring]) -> Result<()> {
        self.tissue.sever(springs)
    }

    /// Requests an audit of a window of steps, which begins at the guard's next checkpoint
    /// ([`tissue::select::audit`]). `inputs` is memory in which the tools' inputs are recorded; it is emptied first.
    /// [`Session::take_mark`] reports the progress.
    pub fn request_audit(&mut self, inputs: WindowInputs) {
        self.tissue.request_audit(inputs);
    }

    /// Takes the mark that begins, ends or drops the requested window, if the last step made one; `None` otherwise.
    /// Each mark is returned once, so call it after every step.
    pub fn take_mark(&mut self) -> Option<Mark> {
        self.tissue.take_mark()
    }

    /// Advances one step. The commands in `due` take effect at its beginning, by ascending number of the tool and,
    /// for one tool, in their order in `due`; `due` is empty afterwards.
    ///
    /// `observe` is called at the step's end, also after a recovery, but not if the step made the session stop
    /// ([`Session::hold_reason`]). Before the first step it is also called at t = 0⁺, when the commands act and
    /// nothing has moved. A session that is stopped already discards `due` and does nothing else.
    pub fn advance(&mut self, due: &mut Vec<Due>, mut observe: impl FnMut(&Session)) {
        while !self.advance_while(due, &mut || true, &mut observe) {}
    }

    /// Advances one step as [`Session::advance`] does, but stops within the guard's repetition of the step when
    /// `may_go_on` returns false. Then it returns false, the state belongs to no step, and only this function may be
    /// called until it returns true; it does not read `due` again before that. The result does not depend on where it
    /// stops.
    pub fn advance_while(
        &mut self,
        due: &mut Vec<Due>,
        may_go_on: &mut dyn FnMut() -> bool,
        mut observe: impl FnMut(&Session),
    ) -> bool {
        if self.hold_reason.is_some() {
            due.clear();
            return true;
        }
        if !self.is_within_step() {
            self.begin_step(due, &mut observe);
        }
        match self.tissue.step_while(may_go_on) {
            Ok(true) => {}
            Ok(false) => return false,
            Err(blow_up) => {
                if !self.recover(blow_up) {
                    return true;
                }
            }
        }
        self.recoveries.accept_until(self.tissue.checkpoint_step());
        observe(self);
        true
    }

    /// Returns whether a step is unfinished, because [`Session::advance_while`] has returned false.
    pub fn is_within_step(&self) -> bool {
        self.tissue.is_within_step() && self.hold_reason.is_none()
    }

    /// Applies the commands and paths that act at the beginning of a step.
    fn begin_step(&mut self, due: &mut Vec<Due>, observe: &mut impl FnMut(&Session)) {
        // The order of arrival depends on the network, so it must not affect the result.
        due.sort_by_key(|due| due.command.tool);
        for due in due.drain(..) {
            self.act(due);
        }
        self.end_expired_actions();
        self.play();
        if self.step_count() == 0 {
            observe(self);
        }
    }

    /// Returns the recoveries so far: their number, and the newest [`MAX_RECOVERIES`](recovery::MAX_RECOVERIES).
    pub fn recoveries(&self) -> &Recoveries {
        &self.recoveries
    }

    /// Returns why the tissue is not what its commands have made of it: the reason of a stop, or else a description
    /// of the newest recovery. `None` if there was neither. A recovery counts for the rest of the session.
    pub fn fault(&self) -> Option<String> {
        let recovered = || self.recoveries.newest().map(|newest| describe(&newest.recovery));
        self.hold_reason().map(str::to_owned).or_else(recovered)
    }

    /// Recovers from a blow-up if something has acted on the tissue since it was at rest. Otherwise it holds the
    /// session and returns false.
    fn recover(&mut self, blow_up: BlowUp) -> bool {
        let (step, state_of_step) = (blow_up.step, self.step_count());
        if !self.recoveries.is_disturbed() {
            self.hold(format!(
                "after step {step} {}; shorter substeps did not help, and nothing has acted on the tissue since it was at \
                 rest; the state is that of step {state_of_step}",
                blow_up.cause
            ));
            return false;
        }
        let paused_until_step = self.recoveries.pause_end(step);
        let released = self.tissue.recover(step, paused_until_step.is_some());
        // All that took effect since the checkpoint: `accept_until` has removed earlier ones.
        self.recoveries.accept_until(state_of_step);
        let mut tools = Vec::new();
        for (index, tool) in self.tools.iter_mut().enumerate() {
            let undone_commands = self.recoveries.acts_of(index);
            let acted = undone_commands > 0 || released.tools.binary_search(&index).is_ok() || tool.posed.is_some();
            (tool.posed, tool.expires_at) = (None, None);
            tool.expired |= acted;
            if acted {
                tool.paused_until = paused_until_step.or(tool.paused_until);
                #[allow(clippy::cast_possible_truncation)]
                tools.push(Ended { tool: index as u32, sequence: tool.acknowledged_sequence, undone_commands });
            }
        }
        let undone_commands = tools.iter().map(|ended| ended.undone_commands).sum();
        let (at_rest, reason) = (released.at_rest, blow_up.cause.to_string());
        let recovery = Recovery { step, state_of_step, at_rest, undone_commands, paused_until_step, reason };
        self.recoveries.add(Recovered { recovery, tools });
        true
    }

    /// Moves the tools that have a path.
    fn play(&mut self) {
        let step_s = self.model().scene.stepping.rate_hz.recip();
        let end_s = self.time_s() + step_s;
        for (index, tool) in self.tools.iter_mut().enumerate() {
            let Some(posed) = &mut tool.posed else { continue };
            let before = posed.path.counts();
            let play = posed.path.step(end_s, step_s);
            for (index, count) in posed.path.counts().into_iter().enumerate() {
                self.path_counts[index] += count - before[index];
            }
            match play {
                Some(Play::Pose(place_m, client_time_s)) => {
                    posed.client_time_s = client_time_s;
                    self.tissue.pose(index, place_m, posed.tip);
                }
                Some(Play::Release) => {
                    (tool.posed, tool.expired) = (None, true);
                    self.tissue.release(index);
                }
                None => {}
            }
        }
    }

    fn tool(&mut self, tool: usize) -> &mut Tool {
        if self.tools.len() <= tool {
            self.tools.resize(tool + 1, Tool::default());
        }
        &mut self.tools[tool]
    }

    fn act(&mut self, Due { command, late, late_commands, ends_lease }: Due) {
        let step = self.step_count();
        let rate_hz = self.model().scene.stepping.rate_hz;
        self.late_commands += late_commands;
        let index = command.tool as usize;
        let tool = self.tool(index);
        // A pose that was overtaken fills a gap in a path; it does not begin a touch that a newer command has
        // ended. A release that was overtaken ends none that a newer command has begun.
        let is_overtaken =
            command.by_datagram && command.sequence.is_some_and(|sequence| sequence < tool.acknowledged_sequence);
        if is_overtaken && (tool.posed.is_none() || command.action == Action::Release) {
            return;
        }
        if ends_lease {
            return self.end_lease(index);
        }
        // Commands with a step may take effect in another order than that in which they were sent.
        if let Some(sequence) = command.sequence.filter(|sequence| *sequence >= tool.acknowledged_sequence) {
            tool.acknowledged_sequence = sequence;
            tool.client_time_ns = command.client_time_ns;
            tool.arrival_ns = command.arrival_ns;
        }
        if matches!(command.action, Action::Mark(_)) {
            // The tissue and the tool stay as they are.
            tool.late = late;
            if let (Action::Mark(mark), true) = (command.action.with_unsigned_zeros(), self.marks.len() < MAX_MARKS) {
                self.marks.push(RecordedMark { step, tool: command.tool, mark });
            }
            return;
        }
        if matches!(command.action, Action::Tie { .. }) {
            // What the tool does goes on.
            if tool.paused_until.is_some_and(|end| step < end) {
                self.paused_commands += 1;
                return;
            }
            tool.late = late;
            self.recoveries.note(step, command.tool);
            self.recoveries.disturb();
            if let Action::Tie { number, tie } = command.action.with_unsigned_zeros() {
                self.tissue.tie(number as usize, tie);
            }
            return;
        }
        let releases = command.action == Action::Release;
        tool.late = late;
        tool.expired = !releases && tool.paused_until.is_some_and(|end| step < end);
        if tool.expired {
            self.paused_commands += 1;
            return;
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let lifetime = command.time_to_live_s.map(|seconds| (seconds * rate_hz).ceil().max(1.0) as u64);
        tool.expires_at = lifetime.map(|steps| step.saturating_add(steps));
        self.recoveries.note(step, command.tool);
        if !releases {
            self.recoveries.disturb();
        }
        match command.action.with_unsigned_zeros() {
            Action::Push(poke) => {
                self.tool(index).posed = None;
                let nearest = self.model().shape().nearest(poke.centre_m);
                self.tool(index).control_point = Some(poke.point.unwrap_or(nearest));
                self.tool(index).around = poke.point.is_none().then_some(poke);
                // To the tissue a point and its place are the same.
                self.tissue.push(index, Some(Push::Constant(Poke { point: None, ..poke })));
            }
            Action::Grasp { point, displacement_m } => {
                self.tool(index).posed = None;
                self.tool(index).control_point = Some(point);
                self.tool(index).around = None;
                self.tissue.grasp(index, point, Grasp::Target(displacement_m));
            }
            Action::Pose { place_m, velocity_m_per_s, tip } => {
                let point = self.model().shape().nearest(place_m);
                let client_time_s = command.client_time_ns as f64 * 1e-9;
                let now_s = self.time_s();
                if self.tool(index).posed.is_none() {
                    let path = if tip.grasps {
                        Path::of_grasp()
                    } else {
                        let height_m = tip.shape.height_m(tip.radius_m);
                        let begins_m = self.model().shape().approach_m(place_m, tip.radius_m, height_m);
                        begins_m.map_or_else(Path::default, Path::beginning_at)
                    };
                    self.tool(index).posed = Some(Posed { tip, path, client_time_s });
                }
                let tool = self.tool(index);
                (tool.control_point, tool.around) = (Some(point), None);
                let Some(posed) = &mut tool.posed else { return };
                posed.tip = tip;
                // A pose with a step is played at that step; a pose with client time only is played by that time.
                if command.at_step.is_some() || command.client_time_ns == 0 {
                    posed.path.go_to(client_time_s, place_m);
                    return;
                }
                let is_overtaken = posed.path.newest_s().is_some_and(|newest_s| client_time_s <= newest_s);
                let is_taken = match velocity_m_per_s {
                    _ if command.by_datagram && is_overtaken => posed.path.fill(client_time_s, place_m),
                    Some(velocity) => posed.path.receive_moving(client_time_s, place_m, velocity, now_s),
                    None => posed.path.receive(client_time_s, place_m, now_s),
                };
                self.path_counts[1] += u64::from(!is_taken);
            }
            // Done above.
            Action::Tie { .. } | Action::Mark(_) => {}
            Action::Release => {
                let tool = self.tool(index);
                (tool.expires_at, tool.posed) = (None, None);
                self.tissue.release(index);
            }
        }
    }

    /// Ends all actions of a tool's holder.
    fn end_lease(&mut self, index: usize) {
        let tool = self.tool(index);
        let Tool { control_point, around, paused_until, .. } = *tool;
        *tool = Tool { control_point, around, paused_until, expired: true, ..Tool::default() };
        self.tissue.release(index);
    }

    /// Ends the actions whose time to live is over.
    fn end_expired_actions(&mut self) {
        let step = self.step_count();
        for index in 0..self.tools.len() {
            if self.tools[index].expires_at.is_some_and(|at| at <= step) {
                self.tools[index].expires_at = None;
                self.tools[index].expired = true;
                self.tools[index].posed = None;
                self.tissue.release(index);
            }
        }
    }

    /// Makes `tool` apply a force as a function of time, exact within the step, from the next step on. No command can
    /// express this. It ends what the tool did before; a later command to the tool ends it. A tool that got no
    /// command has no entry in [`Session::sample`].
    pub fn play_force(&mut self, tool: usize, profile: LoadProfile) {
        self.recoveries.disturb();
        self.tissue.push(tool, Some(Push::Profile(profile)));
    }

    /// Makes `tool` grasp a point and move it as a function of time, from the next step on, in place of what the tool
    /// did before. A later command to the tool ends it. A tool that got no command has no entry in
    /// [`Session::sample`].
    pub fn play_move(&mut self, tool: usize, profile: MotionProfile) {
        self.recoveries.disturb();
        self.tissue.grasp(tool, profile.point, Grasp::Profile(profile));
    }

    /// Returns the sample of the present step: of all tools that ever had a control point, by ascending number, or of
    /// the tools whose numbers are in `only`, in that order. A number without a tool gives an empty sample. Local
    /// models are left out.
    pub fn sample(&self, only: Option<&[u32]>) -> Sample {
        let sample_of = |number: u32| {
            let tool = self.tools.get(number as usize).cloned().unwrap_or_default();
            let feel = self.tissue.tool_contact(number as usize);
            let contact_of = |feel: ToolContact| Contact {
                point: self.model().shape().nearest(feel.anchor_m),
                displacement_m: feel.surface_m - feel.anchor_m,
                surface_displacement_m: self.tissue.surface_displacement_m(feel.anchor_m),
                velocity_m_per_s: feel.velocity_m_per_s,
                force_on_tool_n: feel.force_on_tool_n,
                applied_force_n: -feel.force_on_tool_n,
            };
            let contact = feel.map(contact_of).or_else(|| {
                tool.control_point.map(|point| {
                    let state = self.tissue.point(point);
                    let reaction_n = |poke| self.tissue.reaction_around_n(&poke);
                    let moved_m = |poke: Poke| self.tissue.surface_displacement_m(poke.centre_m);
                    Contact {
                        point,
                        displacement_m: state.displacement_m,
                        surface_displacement_m: tool.around.map_or(state.displacement_m, moved_m),
                        velocity_m_per_s: state.velocity_m_per_s,
                        force_on_tool_n: tool.around.map_or_else(|| state.reaction_n(), reaction_n),
                        applied_force_n: state.applied_n,
                    }
                })
            });
            ToolSample {
                tool: number,
                acknowledged_sequence: tool.acknowledged_sequence,
                client_time_ns: tool.client_time_ns,
                arrival_ns: tool.arrival_ns,
                contact,
                feel,
                place_time_s: tool.posed.as_ref().map_or(0.0, |posed| posed.client_time_s),
                local: None,
                stale: tool.posed.as_ref().is_some_and(|posed| posed.path.is_held(self.time_s())),
                late: tool.late,
                expired: tool.expired,
                paused_until: tool.paused_until,
            }
        };
        let in_use = |number: &u32| self.tools[*number as usize].control_point.is_some();
        #[allow(clippy::cast_possible_truncation)]
        let tools = match only {
            Some(numbers) => numbers.iter().map(|number| sample_of(*number)).collect(),
            None => (0..self.tools.len() as u32).filter(in_use).map(sample_of).collect(),
        };
        let cuts = self.tissue.cuts();
        Sample {
            step: self.step_count(),
            simulation_time_s: self.time_s(),
            awake_points: self.tissue.awake_points(),
            late_commands: self.late_commands,
            held: self.hold_reason.is_some(),
            cuts_exhausted: !cuts.has_room(self.model()),
            topology_version: cuts.version(),
            recoveries: self.recoveries.count(),
            recovered: self.recoveries.newest(),
            tools,
            other_tools: Vec::new(),
        }
    }

    /// Returns the tools that are led by poses and are not in `own`, by ascending number, at most [`MAX_OTHERS`]. The time of
    /// their motion is the simulated time.
    pub fn other_tools(&self, own: &[u32]) -> Vec<OtherTool> {
        let of = |(number, tool): (usize, &Tool)| {
            let (tip, felt) = (tool.posed.as_ref()?.tip, self.tissue.tool_contact(number)?);
            let (place_m, velocity_m_per_s) = (felt.place_m, felt.velocity_m_per_s);
            #[allow(clippy::cast_possible_truncation)]
            let tool = number as u32;
            let motion = MotionState { time_s: self.time_s(), place_m, velocity_m_per_s };
            (!own.contains(&tool)).then_some(OtherTool { tool, tip, motion })
        };
        self.tools.iter().enumerate().filter_map(of).take(MAX_OTHERS).collect()
    }

    /// Returns a copy of the present tissue that another thread can read, for example with [`record_of`]. It copies
    /// the memory of the whole state.
    pub fn copy(&self) -> ReadCopy {
        self.tissue.copy()
    }

    /// Returns the energies of the whole tissue, J, for a record: kinetic, of springs, and of anchor springs. It
    /// computes every awake point.
    pub fn energy(&self) -> EnergyJ {
        energy_record(self.tissue.energy())
    }

    /// Returns the records of the tools that are led by poses and got a command, by ascending number; empty if there
    /// are none.
    #[allow(clippy::cast_possible_truncation)]
    pub fn tool_records(&self) -> Vec<ToolRecord> {
        let of = |number: usize| {
            let feel = self.tissue.tool_contact(number)?;
            Some(ToolRecord {
                tool: number as u32,
                place_m: array(feel.place_m),
                displacement_m: array(feel.surface_m - feel.anchor_m),
                force_on_tool_n: array(feel.force_on_tool_n),
            })
        };
        (0..self.tools.len()).filter_map(of).collect()
    }

    /// Returns the lowest number of a tool that presses where less than a quarter of its tip can move, because the
    /// points are fixed: its force is not that of free tissue. `None` if there is no such tool.
    pub fn tool_on_fixed(&self) -> Option<u32> {
        let presses = |number: &usize| {
            let feel = self.tissue.tool_contact(*number);
            feel.is_some_and(|feel| feel.is_on_fixed && (feel.place_m - feel.touching_m).dot(feel.normal) < 0.0)
        };
        (0..self.tools.len()).find(presses).map(|number| number as u32)
    }

    /// Returns a record of `points` in their order, or of all points in that of their numbers for `None`. Energies
    /// and tools are left out ([`Session::energy`], [`Session::tool_records`]). It unwinds with a refusal if there is
    /// no memory for all points ([`memory::attempt`]).
    pub fn record(&self, points: Option<&[PointId]>) -> Record {
        let shape = self.model().shape();
        let of = |point: PointId| point_record(shape.name(point), &self.tissue.point(point));
        Record {
            time_s: self.time_s(),
            points: match points {
                Some(points) => memory::collected(points.iter().copied().map(of), RECORD),
                None => memory::collected(shape::points(shape).map(of), RECORD),
            },
            tools: Vec::new(),
            instruments: Vec::new(),
            energy_j: None,
            awake_points: self.tissue.awake_points(),
        }
    }
}

/// Returns the record of one point of a copied tissue ([`Session::copy`]): displacement, velocity and forces. `point`
/// must be one of its points.
pub fn record_of(copy: &ReadCopy, point: PointId) -> Point {
    point_record(copy.model().shape().name(point), &copy.point(point))
}

fn energy_record(energy: Energy) -> EnergyJ {
    EnergyJ { kinetic: energy.kinetic_j, spring: energy.spring_j, anchor_springs: energy.anchor_j }
}

/// Returns a vector for a record, with 0 in place of −0.
fn array(v: DVec3) -> [f64; 3] {
    (v + DVec3::ZERO).to_array()
}

fn point_record(name: PointName, state: &PointState) -> Point {
    Point {
        name,
        displacement_m: array(state.displacement_m),
        velocity_m_per_s: array(state.velocity_m_per_s),
        spring_n: array(state.spring_n),
        anchor_n: array(state.anchor_n),
        damping_n: array(state.damping_n),
        applied_n: array(state.applied_n),
        reaction_n: array(state.reaction_n()),
        constraint_n: state.constraint_n.map(array),
    }
}

#[cfg(test)]
mod tests {
    use super::command::Command;
    use super::*;

    #[test]
    fn a_sample_of_a_tool_that_presses_has_how_far_the_tissue_under_it_has_moved() {
        let model = Model::parse("paper", palpate_tissue::scene::PAPER, &["sheet.points=[21, 21]"]).unwrap();
        let mut session = Session::new(&model);
        let spacing_m = model.scene.sheet().unwrap().spacing_m;
        let place_m = DVec3::new(9.3 * spacing_m, 11.2 * spacing_m, -0.1 * spacing_m);
        let tip = Tip { radius_m: spacing_m, ..Tip::default() };
        let pose = Action::Pose { place_m, velocity_m_per_s: None, tip };
        let mut due = vec![Due::in_time(Command::new(0, Some(1), pose))];
        for _ in 0..100 {
            session.advance(&mut due, |_| {});
        }
        let sample = session.sample(None);
        let contact = sample.tools[0].contact.unwrap();
        // It is the mean over the tip of the surface's displacement: down, and hardly to a side.
        assert!(contact.displacement_m.z < 0.5 * place_m.z, "{contact:?}");
        let apart_m = contact.displacement_m.distance(contact.surface_displacement_m);
        assert!(apart_m < 0.2 * contact.surface_displacement_m.length(), "{apart_m} m: {contact:?}");
    }
}
