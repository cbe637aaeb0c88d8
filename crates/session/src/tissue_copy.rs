//! A copy of a session's tissue for one tool or instrument, which a client steps itself without delay
//! ([`palpate_haptics::prediction`]).

use std::sync::Arc;

use glam::DVec3;
use palpate_haptics::prediction::MAX_OTHERS;
use palpate_haptics::{
    ContactState, Instrument, InstrumentPose, OtherTool, Predicted, Predictor, ReportedCuts, Tip, TipShape,
};

use super::Session;
use super::command::{Command, Due};
use super::copied_cuts::CopiedCuts;
use super::rules::Rules;
use palpate_refusal::{Result, legible, number};
use palpate_tissue::limits::Limits;
use palpate_tissue::memory;
use palpate_tissue::scene::action_check::check_tip;
use palpate_tissue::scene::script::{Action, is_led};
use palpate_tissue::shape::RestShape;
use palpate_tissue::{Cuts, Model, ToolContact};

/// Limit of a client copy's work in a millisecond, in awake points times substeps: this takes up to 1 ms with a tip
/// on the tissue. Beyond it the copy predicts nothing.
pub const TICK_POINT_SUBSTEPS: u64 = 100_000;

/// Largest radius of a tip on a copy, in lengths of an edge: the cost of contact grows with the area of the tip.
const MAX_EDGES: f64 = 32.0;

/// A client's usual tick, s.
const TICK_S: f64 = 1e-3;

/// Time behind the client's above which a copy skips to the present, s: the client has paused.
const MAX_BEHIND_S: f64 = 0.005;

/// Time after which the server should have severed what the copy's own blade has, s: some round trips of a slow network, with the
/// report. Springs that it has not severed by then are whole.
const CONFIRMED_S: f64 = 2.0;

/// Time after which a copy begins anew even while its tool touches it, s.
const MAX_UNCONFIRMED_S: f64 = 10.0;

/// Length of the edge of another client's blade on a copy, m: it severs nothing.
const SHEATHED_M: f64 = 1e-6;

/// The work that a tool which is led by poses has done on a tissue.
#[derive(Debug, Clone, Copy, Default)]
pub struct ToolWork {
    /// Where the force on the tool acts, m, and that force, N, after the last step.
    before: Option<(DVec3, DVec3)>,
    /// The work so far, J: negative if the tool got more energy than it gave.
    pub done_j: f64,
}

impl ToolWork {
    /// Adds the work of a step, after which `contact` is what the tool feels: the mean of the forces before and after it times
    /// the way.
    pub fn add(&mut self, contact: Option<ToolContact>) {
        let now = contact.map(|felt| (felt.place_m + felt.lever_m, felt.force_on_tool_n));
        if let (Some((from_m, from_n)), Some((to_m, to_n))) = (self.before, now) {
            self.done_j -= 0.5 * (from_n + to_n).dot(to_m - from_m);
        }
        self.before = now;
    }

    /// Lets the work go on from the next step on: what the tool feels changes without a way.
    fn pause(&mut self) {
        self.before = None;
    }
}

/// Another tool on a copy.
#[derive(Debug, Clone, Copy)]
struct LedTool {
    /// Its number in the server's session.
    tool: u32,
    tip: Tip,
}

impl LedTool {
    /// Returns whether a tool is led with the same tip: shape and radius can't change until it is released.
    fn is(&self, other: &OtherTool) -> bool {
        let of = |tip: &Tip| (tip.shape, tip.radius_m, tip.grasps);
        self.tool == other.tool && of(&self.tip) == of(&other.tip)
    }
}

/// A copy of a tissue with a client's instrument, which may be a single tip. It predicts the wrench on that between a server's
/// samples. It begins at rest. Of the other tools it knows those that are led by poses, as far as the client does.
///
/// **Cuts.** The client's own blades cut it at once. What others sever, it severs when the server reports it
/// ([`Predictor::follow_cuts`]): where their blades are now, the client only guesses. The server's tissue is the true one: if the server
/// undoes a cut, or has not severed 2 s later what the copy has, the copy begins anew, at rest, with the server's cuts. In the second
/// case it waits until its tool touches nothing, at most 10 s.
pub struct TissueCopy {
    session: Session,
    cuts: CopiedCuts,
    /// What the other tools may do: a server is not believed.
    rules: Rules,
    /// The client's instrument. Its tips are the first tools; other tools have the following ones.
    instrument: Instrument,
    /// Whether it is a single tip, which is led wherever it is.
    is_single: bool,
    /// Which of its tips are led.
    is_led: Vec<bool>,
    /// The other tools on the copy.
    others: [Option<LedTool>; MAX_OTHERS],
    /// The work of each tip, and of the tool in each place of `others`, those included that were there before.
    work: Vec<ToolWork>,
    others_work: [ToolWork; MAX_OTHERS],
    due: Vec<Due>,
    /// The client's time minus the copy's, s; `None` before the first tick.
    ahead_s: Option<f64>,
    pose: InstrumentPose,
    /// Points times substeps that may be computed in a tick.
    most_point_substeps: u64,
}

impl TissueCopy {
    /// Creates a copy at rest, for a tool with this tip, without a limit of its work and without a check of the tip.
    pub fn new(model: &Arc<Model>, tip: Tip) -> Self {
        TissueCopy { is_single: true, ..TissueCopy::of_instrument(model, Instrument::of_tip(tip)) }
    }

    /// Creates a copy at rest, for an instrument, without a limit of its work and without a check of the tips.
    pub fn of_instrument(model: &Arc<Model>, instrument: Instrument) -> Self {
        let tips = instrument.tips.len();
        TissueCopy {
            session: Session::new(model),
            cuts: CopiedCuts::default(),
            rules: Rules::new(&model.scene, &Limits::default()),
            instrument,
            is_single: false,
            is_led: vec![false; tips],
            others: [None; MAX_OTHERS],
            work: vec![ToolWork::default(); tips],
            others_work: [ToolWork::default(); MAX_OTHERS],
            due: Vec::with_capacity(tips + 2 * MAX_OTHERS),
            ahead_s: None,
            pose: InstrumentPose::at(DVec3::ZERO),
            most_point_substeps: u64::MAX,
        }
    }

    /// Returns this copy with a limit of awake points times substeps per millisecond. While more points are awake
    /// than that allows, it is not stepped and predicts nothing, because the loop that it runs in must not be late.
    #[must_use]
    pub fn within(self, most_point_substeps: u64) -> Self {
        TissueCopy { most_point_substeps, ..self }
    }

    /// Creates a copy at rest of a tissue that a server describes, limited to what a client can step in time
    /// ([`TICK_POINT_SUBSTEPS`]).
    ///
    /// # Errors
    /// Refuses a tip that does not fit the tissue, and a radius above 32 lengths of an edge (`tip.radius_m`).
    pub fn for_client(model: &Arc<Model>, instrument: &Instrument) -> Result<Self> {
        let shape = model.shape();
        let most_m = most_radius_m(shape);
        let range = format!("at most {} for a copy of this tissue, {MAX_EDGES} lengths of an edge", legible(most_m));
        for tip in &instrument.tips {
            check_tip("tip", shape, &tip.tip)?;
            number("tip.radius_m", tip.tip.radius_m, &range, |radius_m| radius_m <= most_m)?;
        }
        let single = instrument.tips.first().map(|tip| Instrument::of_tip(tip.tip));
        let copy = TissueCopy::of_instrument(model, instrument.clone());
        Ok(TissueCopy { is_single: single.as_ref() == Some(instrument), ..copy }.within(TICK_POINT_SUBSTEPS))
    }

    /// Returns what is severed in the copy.
    pub fn cuts(&self) -> Cuts {
        self.session.tissue().cuts()
    }

    /// Severs what a server reports.
    ///
    /// # Errors
    /// Refuses springs of which the tissue lacks one, and missing memory; the copy then stays as it is.
    pub fn follow(&mut self, cuts: &ReportedCuts) -> Result<()> {
        if self.cuts.is_undone_by(cuts) {
            return self.begin_anew(cuts);
        }
        self.session.sever(&cuts.springs)?;
        self.cuts.add(cuts);
        self.look_for_cuts();
        Ok(())
    }

    /// Begins anew at rest, with the cuts of a report that has all. The work so far counts on.
    fn begin_anew(&mut self, cuts: &ReportedCuts) -> Result<()> {
        let model = self.session.model().clone();
        let mut session = memory::attempt("snapshot", || Ok(Session::new(&model)))?;
        session.sever(&cuts.springs)?;
        self.session = session;
        self.cuts.replace(cuts);
        self.look_for_cuts();
        self.is_led.fill(false);
        (self.others, self.ahead_s) = ([None; MAX_OTHERS], None);
        self.work.iter_mut().chain(&mut self.others_work).for_each(ToolWork::pause);
        self.due.clear();
        Ok(())
    }

    /// Notices what the copy has severed since the last look.
    fn look_for_cuts(&mut self) {
        self.cuts.look(&self.session.tissue().cuts(), self.session.time_s());
    }

    /// Begins anew if the server has not severed what the copy has severed long ago.
    fn reconcile(&mut self, contact_state: ContactState) {
        self.look_for_cuts();
        let waits_s = if contact_state == ContactState::Free { CONFIRMED_S } else { MAX_UNCONFIRMED_S };
        let time_s = self.session.time_s();
        if self.cuts.unconfirmed_since_s().is_some_and(|since_s| time_s - since_s > waits_s) {
            let cuts = self.cuts.reported();
            // Without memory for it, the copy stays as it is.
            let _ = self.begin_anew(&cuts);
        }
    }

    /// Steps until `now_s`, with the instrument on its way to `pose`, and the others on theirs. The number of steps is
    /// rounded, so that ticks that are a little early or late have one step each. `None` if too many points are awake.
    fn step_to(&mut self, now_s: f64, pose: &InstrumentPose, others: &[OtherTool]) -> Option<()> {
        let step_s = self.session.model().scene.stepping.rate_hz.recip();
        let time_s = self.session.time_s();
        let behind_s = self.ahead_s.map(|ahead_s| now_s - ahead_s - time_s);
        let behind_s = behind_s.filter(|behind_s| *behind_s <= MAX_BEHIND_S.max(2.0 * step_s)).unwrap_or_else(|| {
            // The tool gets there at once; its largest speed limits how far it moves in a step.
            (self.ahead_s, self.pose) = (Some(now_s - step_s - time_s), *pose);
            step_s
        });
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let steps = (behind_s / step_s).round() as u32;
        for step in 1..=steps {
            if self.is_too_much(step_s) {
                return None;
            }
            let on_way = self.pose.towards(pose, f64::from(step) / f64::from(steps));
            self.lead(if step == steps { pose } else { &on_way });
            self.lead_others(now_s - f64::from(steps - step) * step_s, others);
            self.session.advance(&mut self.due, |_| {});
            let tissue = self.session.tissue();
            let all = self.work.iter_mut().chain(&mut self.others_work);
            all.enumerate().for_each(|(tool, work)| work.add(tissue.tool_contact(tool)));
        }
        if steps > 0 {
            self.pose = *pose;
        }
        Some(())
    }

    /// Leads the tips of the instrument to a pose. As a server does, releases those of an instrument that are far from the tissue.
    fn lead(&mut self, pose: &InstrumentPose) {
        let pose = self.instrument.lead(pose);
        let shape = self.session.model().shape();
        for (number, is_led_now) in self.is_led.iter_mut().enumerate() {
            let (tip, place_m) = (self.instrument.tip(number, &pose), self.instrument.tip_m(number, &pose));
            let tool = tool_at(number);
            let was_led = std::mem::replace(is_led_now, self.is_single || is_led(shape, place_m, tip.reach_m()));
            if *is_led_now {
                self.due.push(led(tool, place_m, tip));
            } else if was_led {
                self.due.push(Due::in_time(Command::new(tool, None, Action::Release)));
            }
        }
    }

    /// Leads the other tools to where they are at a time of the client, and releases those that are no longer known. Ignores
    /// what a session would refuse.
    fn lead_others(&mut self, time_s: f64, others: &[OtherTool]) {
        let most_m = most_radius_m(self.session.model().shape());
        let known = || others.iter().filter(|other| other.tip.radius_m <= most_m);
        let tips = self.instrument.tips.len();
        for (slot, led_tool) in self.others.iter_mut().enumerate() {
            if led_tool.is_some_and(|led_tool| !known().any(|other| led_tool.is(other))) {
                *led_tool = None;
                self.due.push(Due::in_time(Command::new(tool_at(tips + slot), None, Action::Release)));
            }
        }
        for other in known() {
            let has = |led_tool: &Option<LedTool>| led_tool.is_some_and(|led_tool| led_tool.tool == other.tool);
            let slot = self.others.iter().position(has).or_else(|| self.others.iter().position(Option::is_none));
            let Some(slot) = slot else { continue };
            let due = led(tool_at(tips + slot), other.motion.at(time_s), blunt(other.tip));
            if self.rules.check_one(&due.command).is_err() {
                continue;
            }
            self.others[slot] = Some(LedTool { tool: other.tool, tip: other.tip });
            self.due.push(due);
        }
    }

    /// Returns whether a tick's steps take more than their limit.
    #[allow(clippy::cast_precision_loss)]
    fn is_too_much(&self, step_s: f64) -> bool {
        let substeps = f64::from(self.session.model().plan.substeps) * (TICK_S / step_s).max(1.0);
        self.session.tissue().awake_points() as f64 * substeps > self.most_point_substeps as f64
    }
}

#[allow(clippy::cast_possible_truncation)]
fn tool_at(number: usize) -> u32 {
    number as u32
}

/// Returns the largest radius of a tip on a copy, m.
fn most_radius_m(shape: &dyn RestShape) -> f64 {
    MAX_EDGES * shape.edge_m()
}

/// Returns the tip of another client's tool as it is on a copy, where it severs nothing.
fn blunt(tip: Tip) -> Tip {
    let edge_m = match tip.shape {
        TipShape::Blade => SHEATHED_M * tip.edge_m.normalize_or(DVec3::Z),
        TipShape::Disc | TipShape::RigidDisc | TipShape::Sphere => tip.edge_m,
    };
    Tip { edge_m, burn_s: 0.0, ..tip }
}

/// Returns the command that leads a tool to a place within the next step.
fn led(tool: u32, place_m: DVec3, tip: Tip) -> Due {
    Due::in_time(Command::new(tool, None, Action::Pose { place_m, velocity_m_per_s: None, tip }))
}

impl Predictor for TissueCopy {
    fn feel(&mut self, now_s: f64, pose: &InstrumentPose, others: &[OtherTool]) -> Option<Predicted> {
        if self.session.hold_reason().is_some() {
            return None;
        }
        self.step_to(now_s, pose, others)?;
        let tissue = self.session.tissue();
        let felt = || (0..self.work.len()).filter_map(|tool| Some((tool, tissue.tool_contact(tool)?)));
        let forces = felt().map(|(tool, contact)| contact.force_on_tip(tool));
        let wrench = self.instrument.wrench(&self.instrument.lead(pose), forces);
        // A tip that holds, sticks or slides says so for all.
        let touching = felt().map(|(_, contact)| contact.contact_state).find(|state| *state != ContactState::Free);
        let contact_state = touching.unwrap_or(ContactState::Free);
        let [own_work_j, others_work_j] =
            [&self.work[..], &self.others_work].map(|works| works.iter().map(|work| work.done_j).sum());
        self.reconcile(contact_state);
        Some(Predicted { wrench, contact_state, own_work_j, others_work_j })
    }

    fn topology_version(&self) -> Option<u32> {
        Some(self.cuts.version)
    }

    fn follow_cuts(&mut self, cuts: &ReportedCuts) {
        // A server is not believed: a report that makes no sense is ignored.
        let _ = self.follow(cuts);
    }
}

impl std::fmt::Debug for TissueCopy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let TissueCopy { ahead_s, pose, most_point_substeps, .. } = self;
        let mut fields = f.debug_struct("TissueCopy");
        fields.field("ahead_s", ahead_s).field("pose", pose).field("most_point_substeps", most_point_substeps);
        fields.finish_non_exhaustive()
    }
}

#[cfg(test)]
mod cut_tests;

#[cfg(test)]
mod tests {
    use super::*;
    use palpate_haptics::{MotionState, Wrench};

    /// Returns the place at a tick of a press of 3 mm and a stroke.
    fn place_m(tick: u32) -> DVec3 {
        let time_s = f64::from(tick) * TICK_S;
        let down = (time_s / 0.1).min(1.0);
        DVec3::new(0.05 + 0.02 * (time_s - 0.1).max(0.0), 0.05, 0.002 - 0.005 * down)
    }

    fn at(place_m: DVec3) -> InstrumentPose {
        InstrumentPose::at(place_m)
    }

    fn model() -> Arc<Model> {
        Model::parse(
            "paper",
            palpate_tissue::scene::PAPER,
            &["sheet.points=[21, 21]", "sheet.spacing_m=0.005", "sheet.fixed=\"edges\""],
        )
        .unwrap()
    }

    /// Returns the forces of a session with equal poses at equal steps.
    fn truth_n(model: &Arc<Model>, ticks: u32) -> Vec<DVec3> {
        let (mut session, tip) = (Session::new(model), Tip::default());
        let felt = (0..ticks).map(|tick| {
            let action = Action::Pose { place_m: place_m(tick), velocity_m_per_s: None, tip };
            session.advance(&mut vec![Due::in_time(Command::new(0, None, action))], |_| {});
            session.tissue().tool_contact(0).map_or(DVec3::ZERO, |feel| feel.force_on_tool_n)
        });
        felt.collect()
    }

    #[test]
    fn a_copy_feels_what_a_session_does_at_the_same_places_also_when_ticks_are_early_and_late() {
        let model = model();
        let truth_n = truth_n(&model, 300);
        assert!(truth_n[299].length() > 0.01, "{}", truth_n[299]);
        let mut copy = TissueCopy::new(&model, Tip::default());
        for (tick, truth_n) in (0..300).zip(truth_n) {
            let early_s = [0.0, -3e-4, 4e-4, 1e-4][tick as usize % 4];
            let felt = copy.feel(17.0 + f64::from(tick) * TICK_S + early_s, &at(place_m(tick)), &[]).unwrap();
            assert_eq!(felt.wrench, Wrench::of_force(truth_n), "{tick}");
        }
    }

    /// Another tool that presses 15 mm beside the first, from a tick on until another one.
    fn other(tick: u32) -> Option<OtherTool> {
        let time_s = f64::from(tick) * TICK_S;
        let place_m = place_m(tick) + DVec3::new(0.015, 0.0, -0.001);
        let motion = MotionState { time_s, place_m, velocity_m_per_s: DVec3::ZERO };
        (50..250).contains(&tick).then_some(OtherTool { tool: 7, tip: Tip::default(), motion })
    }

    #[test]
    fn a_copy_feels_the_other_tools_as_a_session_does_and_counts_its_work() {
        let model = model();
        let (mut session, mut copy) = (Session::new(&model), TissueCopy::new(&model, Tip::default()));
        let (mut least_j, mut most_j, mut alone) = (0.0_f64, 0.0_f64, TissueCopy::new(&model, Tip::default()));
        let mut apart_n = 0.0_f64;
        for tick in 0..400 {
            let mut due = vec![led(0, place_m(tick), Tip::default())];
            match (other(tick), tick) {
                (Some(other), _) => due.push(led(1, other.motion.place_m, other.tip)),
                (None, 250) => due.push(Due::in_time(Command::new(1, None, Action::Release))),
                (None, _) => {}
            }
            session.advance(&mut due, |_| {});
            let truth_n = session.tissue().tool_contact(0).map_or(DVec3::ZERO, |feel| feel.force_on_tool_n);
            let others: Vec<_> = other(tick).into_iter().collect();
            let felt = copy.feel(f64::from(tick) * TICK_S, &at(place_m(tick)), &others).unwrap();
            assert_eq!(felt.wrench, Wrench::of_force(truth_n), "{tick}");
            (least_j, most_j) = (least_j.min(felt.own_work_j), most_j.max(felt.own_work_j));
            let alone_n = alone.feel(f64::from(tick) * TICK_S, &at(place_m(tick)), &[]).unwrap().wrench.force_n;
            apart_n = apart_n.max(alone_n.distance(truth_n));
        }
        // The other tool matters, and this one gives the tissue the work of a press of some millimetres.
        assert!(apart_n > 1e-3, "{apart_n} N");
        assert!((1e-6..1e-2).contains(&most_j) && least_j > -1e-9, "{least_j} to {most_j} J");
    }

    /// A tool goes down where another one has pushed the tissue away. That one lifts, the tissue comes back and pushes the tool
    /// out again: with more force than it went down against.
    #[test]
    fn a_tool_that_another_one_pushes_gets_energy_from_the_copy() {
        let text = palpate_tissue::scene::BUILT_IN.iter().find(|scene| scene.0 == "liver").unwrap().1;
        let model = Model::parse("liver", text, &[]).unwrap();
        let mut copy = TissueCopy::new(&model, Tip::default());
        let depth_m = |tick: u32, begins: [u32; 2]| {
            let passed = |from: u32| f64::from(tick.saturating_sub(from).min(100)) / 100.0;
            passed(begins[0]) - passed(begins[1])
        };
        let (mut gave_j, mut gets_j, mut others_j) = (0.0_f64, 0.0, 0.0);
        for tick in 0..500 {
            let time_s = f64::from(tick) * TICK_S;
            let place_m = DVec3::new(0.035, 0.0375, 0.001 - 0.003 * depth_m(tick, [100, 300]));
            let beside_m = DVec3::new(0.041, 0.0375, 0.001 - 0.007 * depth_m(tick, [0, 200]));
            let motion = MotionState { time_s, place_m: beside_m, velocity_m_per_s: DVec3::ZERO };
            let felt = copy.feel(time_s, &at(place_m), &[OtherTool { tool: 1, tip: Tip::default(), motion }]).unwrap();
            gave_j = gave_j.max(felt.own_work_j);
            (gets_j, others_j) = (-felt.own_work_j, felt.others_work_j);
        }
        assert!(gets_j > 1e-6 && gets_j > gave_j, "gave {gave_j} J, got {gets_j} J more");
        assert!(others_j > gets_j, "the other tool gave {others_j} J, and this one got {gets_j} J");
    }

    #[test]
    fn other_tools_that_make_no_sense_are_left_out() {
        let model = model();
        let mut copy = TissueCopy::new(&model, Tip::default());
        let sound = other(100).unwrap();
        let with = |tool: u32, tip: Tip, place_m: DVec3| OtherTool {
            tool,
            tip,
            motion: MotionState { place_m, ..sound.motion },
        };
        let place_m = sound.motion.place_m;
        let others = [
            with(1, Tip { radius_m: f64::NAN, ..Tip::default() }, place_m),
            with(2, Tip { radius_m: 0.0, ..Tip::default() }, place_m),
            with(3, Tip { friction: -1.0, ..Tip::default() }, place_m),
            with(4, Tip { shape: palpate_haptics::TipShape::Sphere, ..Tip::default() }, place_m),
            with(5, Tip::default(), DVec3::splat(f64::NAN)),
            with(6, Tip::default(), DVec3::splat(1e300)),
            sound,
        ];
        for tick in 50..150 {
            let felt = copy.feel(f64::from(tick) * TICK_S, &at(place_m), &others).unwrap();
            assert!(felt.wrench.is_finite() && felt.own_work_j.is_finite());
        }
        let led_tools: Vec<u32> = copy.others.iter().flatten().map(|led_tool| led_tool.tool).collect();
        assert_eq!(led_tools, [7]);
    }

    #[test]
    fn a_copy_does_the_steps_of_ticks_that_were_left_out_and_goes_on_after_a_pause() {
        let model = model();
        let mut copy = TissueCopy::new(&model, Tip::default());
        let steps = |copy: &TissueCopy| copy.session.step_count();
        for (tick, expected) in [(0, 1), (1, 2), (5, 6), (15, 7), (15, 7), (16, 8), (5000, 9), (5001, 10)] {
            let felt = copy.feel(f64::from(tick) * TICK_S, &at(place_m(tick.min(200))), &[]).unwrap();
            assert!(felt.wrench.is_finite() && steps(&copy) == expected, "{tick}: {} steps", steps(&copy));
        }
    }

    #[test]
    fn a_copy_with_slow_or_fast_steps_keeps_to_the_time() {
        for rate_hz in [1.0, 10.0, 50.0, 499.0, 1000.0, 5000.0] {
            let rate = format!("stepping.rate_hz={rate_hz}");
            let model = Model::parse(
                "paper",
                palpate_tissue::scene::PAPER,
                &["sheet.points=[9, 9]", "sheet.fixed=\"edges\"", &rate],
            )
            .unwrap();
            let mut copy = TissueCopy::new(&model, Tip::default());
            for tick in 0..2000 {
                let felt = copy.feel(3.0 + f64::from(tick) * TICK_S, &at(DVec3::new(0.1, 0.1, 0.01)), &[]).unwrap();
                assert!(felt.wrench.is_finite());
            }
            let apart_s = (copy.session.time_s() - 2.0).abs();
            assert!(apart_s <= 2.0 / rate_hz + TICK_S, "{rate_hz} Hz: {} s", copy.session.time_s());
        }
    }

    #[test]
    fn a_copy_with_too_much_to_compute_tells_nothing() {
        let model = model();
        let mut copy = TissueCopy::new(&model, Tip::default()).within(50);
        let felt: Vec<_> = (0..200).map(|tick| copy.feel(f64::from(tick) * TICK_S, &at(place_m(tick)), &[])).collect();
        // Nothing is computed at rest.
        assert!(felt[0].is_some() && felt[199].is_none());
    }
}
