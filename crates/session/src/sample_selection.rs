//! Selection of a stream's samples: every Nth step, changes beyond a deadband, and heartbeats while nothing
//! changes.
//!
//! One rule holds for all streams. Of the steps that are multiples of N, a stream gets those whose sample differs
//! from its last one, beyond the deadband if there is one, and those at which a heartbeat is due. Without a
//! deadband every change counts. The stepping thread asks the same rule for the next step that is due if nothing
//! changes, so a session at rest can skip to it.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use palpate_haptics::dead_reckoning::FASTEST_S;
use palpate_haptics::{Law, LocalModel};

use super::current_laws::{FIRST, Laws};
use super::local_model::{Modeller, StiffnessJob};
use super::{Sample, Session, ToolSample};
use palpate_refusal::{Reason, Refusal, Result, number};

/// A sample, with the timing of the session, as a stream of samples gets it.
#[derive(Debug, Clone, PartialEq)]
pub struct PacedSample {
    /// State of the session and of its tools, with local models if the stream has force laws.
    pub sample: Sample,
    /// Time at which the sample's step was due, ns of the server's clock.
    pub due_ns: u64,
    /// Number of steps dropped from the schedule so far, because the session was late.
    pub overrun_count: u64,
    /// Simulated over real time, measured over about the last second: 1 on time, less if the session is late; the
    /// nominal speed of a playback is 1 too.
    pub time_dilation: f64,
    /// Everything before this step is durable: on disk or, if that is required, on two disks; `None` if no journal is
    /// kept, or before anything is.
    pub durable_step: Option<u64>,
    /// Revision at which this server became the session's owner; 0 without a fleet.
    pub ownership_revision: u64,
    /// Whether steps were dropped from the schedule since the stream's last sample.
    pub overrun: bool,
}

/// Default interval between samples while nothing changes, s: 20 a second, so that a client can tell stillness from
/// a lost connection within the 50 ms after which it should no longer trust its model.
pub const HEARTBEAT_S: f64 = 0.05;

/// Longest heartbeat, s: clients take a longer silence for the end of the stream.
pub const MAX_HEARTBEAT_S: f64 = 10.0;

/// Bounds of changes that need no sample, in comparison with the last sample that the stream got. A quantity without
/// a bound is not compared; each bound that is exceeded makes a sample due.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Deadband {
    /// Length of the change of the force on the tool, N.
    pub force_n: Option<f64>,
    /// Length of the change of the force on the tool, as a fraction of the present force, 0 to 1. If `force_n` is
    /// also given, the larger bound applies.
    pub force_fraction: Option<f64>,
    /// Length of the change of the control point's displacement, m.
    pub displacement_m: Option<f64>,
    /// Error of the force that a client renders from the last local model, as a fraction of the true force, 0 to 1.
    /// It has an effect only in a stream with force laws.
    pub rendered_fraction: Option<f64>,
}

impl Deadband {
    /// Checks the bounds. A bound of 0 means any change.
    ///
    /// # Errors
    /// Refuses a deadband without a bound ([`Reason::Missing`]), a negative or infinite bound, a number that is not
    /// finite, and a fraction above 1.
    pub fn check(&self) -> Result<()> {
        let Deadband { force_n, force_fraction, displacement_m, rendered_fraction } = *self;
        if !self.looks_at_samples() && rendered_fraction.is_none() {
            let message =
                "has no bound: give force_n, force_fraction, displacement_m, rendered_fraction, or no deadband";
            return Err(Refusal::new(Reason::Missing, "deadband", message));
        }
        for (field, value, most) in [
            ("deadband.force_n", force_n, f64::INFINITY),
            ("deadband.force_fraction", force_fraction, 1.0),
            ("deadband.displacement_m", displacement_m, f64::INFINITY),
            ("deadband.rendered_fraction", rendered_fraction, 1.0),
        ] {
            if let Some(value) = value {
                let range = if most.is_finite() { "from 0 to 1" } else { "at least 0" };
                number(field, value, range, |v| (0.0..=most).contains(&v))?;
            }
        }
        Ok(())
    }

    /// Returns whether samples are compared with each other, and not only with the rendered force.
    fn looks_at_samples(&self) -> bool {
        self.force_n.or(self.force_fraction).or(self.displacement_m).is_some()
    }

    fn is_exceeded(&self, told: &ToolSample, now: &ToolSample) -> bool {
        if (told.tool, told.late, told.expired) != (now.tool, now.late, now.expired) {
            return true;
        }
        let (told, now) = match (&told.contact, &now.contact) {
            (Some(told), Some(now)) if told.point == now.point => (told, now),
            (None, None) => return false,
            (Some(_), Some(_)) if !self.looks_at_samples() => return false,
            _ => return true,
        };
        let force = (self.force_n.is_some() || self.force_fraction.is_some()).then(|| {
            let fraction = self.force_fraction.unwrap_or(0.0);
            self.force_n.unwrap_or(0.0).max(fraction * now.force_on_tool_n.length())
        });
        force.is_some_and(|bound_n| (now.force_on_tool_n - told.force_on_tool_n).length() > bound_n)
            || self.displacement_m.is_some_and(|m| (now.displacement_m - told.displacement_m).length() > m)
    }
}

/// Settings of a stream of samples. [`Sampling::check`] checks them.
#[derive(Debug, Clone)]
pub struct Sampling {
    /// Only steps that are multiples of this are sampled; at least 1.
    pub every: u64,
    /// Numbers of the tools to sample, in the order in which samples have them; `None` for all that ever had a
    /// control point.
    pub only: Option<Vec<u32>>,
    /// Bounds within which changes are not sent. `None`: each change is sent, so every sampled step while the tissue
    /// is awake.
    pub deadband: Option<Deadband>,
    /// Longest simulated time between samples, s, above 0 and at most [`MAX_HEARTBEAT_S`]: a heartbeat is sent while
    /// nothing changes.
    pub heartbeat_s: f64,
    /// Force laws for the local models of tools that are led by poses. `None`: samples have no local models.
    pub laws: Option<Arc<Laws>>,
    /// Whether stiffness and damping are also computed from the tissue around the tool under a touch, and not only
    /// under a grasp. Without `laws` it has no effect.
    pub touch_stiffness: bool,
    /// Whether samples contain the tools that are not in `only` and are led by poses.
    pub other_tools: bool,
    /// Shorter heartbeat that the reader may request at any time; the shorter of the two applies. `None`: only
    /// `heartbeat_s` applies.
    pub wanted: Option<Arc<WantedHeartbeat>>,
}

/// Heartbeat that the reader of a stream requests at present, by its measurements of the network. It can be set from
/// any thread; at first there is no request.
#[derive(Debug, Default)]
pub struct WantedHeartbeat(AtomicU64);

impl WantedHeartbeat {
    /// Sets the requested heartbeat, s; below 0.01 s ([`FASTEST_S`]) it counts as 0.01 s. A value that is not above 0
    /// withdraws the request.
    pub fn set(&self, heartbeat_s: f64) {
        let bits = if heartbeat_s > 0.0 { heartbeat_s.max(FASTEST_S).to_bits() } else { 0 };
        self.0.store(bits, Ordering::Relaxed);
    }

    fn get(&self) -> Option<f64> {
        let bits = self.0.load(Ordering::Relaxed);
        (bits != 0).then(|| f64::from_bits(bits))
    }
}

impl Sampling {
    /// Checks the deadband and the heartbeat; the other settings are not checked.
    ///
    /// # Errors
    /// Returns the refusals of [`Deadband::check`], and refuses a heartbeat that is not above 0 and at most
    /// [`MAX_HEARTBEAT_S`].
    pub fn check(&self) -> Result<()> {
        if let Some(deadband) = &self.deadband {
            deadband.check()?;
        }
        let range = format!("above 0 and at most {MAX_HEARTBEAT_S}");
        number("heartbeat_s", self.heartbeat_s, &range, |v| v > 0.0 && v <= MAX_HEARTBEAT_S).map(|_| ())
    }
}

/// Selector of the samples of one stream, which compares each with the last one that the stream got. Before the
/// first, every sampled step is due.
#[derive(Debug)]
pub struct Sampler {
    sampling: Sampling,
    rate_hz: f64,
    /// The last sample that was sent, without its local models.
    told: Option<Sample>,
    followed: BTreeMap<u32, FollowedTool>,
    /// Number of the law that the last local models refer to.
    law: u32,
}

/// Local models of one tool, and a deadband by the force that the client renders from them.
#[derive(Debug)]
struct FollowedTool {
    modeller: Modeller,
    deadband: palpate_haptics::ForceDeadband,
}

impl Sampler {
    /// Creates a sampler for a session with `rate_hz` steps per second. `sampling` must have been checked.
    pub fn new(sampling: Sampling, rate_hz: f64) -> Self {
        Sampler { sampling, rate_hz, told: None, followed: BTreeMap::new(), law: FIRST }
    }

    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn heartbeat_steps(&self) -> u64 {
        let asked_s = self.sampling.heartbeat_s;
        let wanted_s = self.sampling.wanted.as_ref().and_then(|wanted| wanted.get());
        (wanted_s.map_or(asked_s, |wanted_s| wanted_s.min(asked_s)) * self.rate_hz).round().max(1.0) as u64
    }

    /// Returns the sample of the present step, if the stream is due one; otherwise `None`. With `last` the stream
    /// gets it even if it is not due, because no other follows for now. A step is returned once, or twice if the
    /// session was stopped in between. A returned sample counts as sent.
    pub fn pick(&mut self, session: &Session, last: bool) -> Option<Sample> {
        self.pick_from(session, &mut None, last)
    }

    /// Returns the sample of the present step as [`Sampler::pick`] does, for one of many streams. `all` keeps the
    /// sample of all tools for the other streams, once a stream has needed it: begin each step with `None`.
    pub fn pick_from(&mut self, session: &Session, all: &mut Option<Sample>, last: bool) -> Option<Sample> {
        let (step, told) = (session.step_count(), self.told.as_ref());
        let is_told = told.is_some_and(|told| told.step == step && told.held == session.hold_reason().is_some());
        if is_told || !(last || step.is_multiple_of(self.sampling.every)) {
            return None;
        }
        let mut sample = match &self.sampling.only {
            Some(only) => session.sample(Some(only)),
            None => all.get_or_insert_with(|| session.sample(None)).clone(),
        };
        if let (true, Some(only)) = (self.sampling.other_tools, &self.sampling.only) {
            sample.other_tools = session.other_tools(only);
        }
        let is_due = |told: &Sample| {
            last || step.saturating_sub(told.step) >= self.heartbeat_steps() || self.is_news(told, &sample)
        };
        let is_due = told.is_none_or(is_due);
        let Some(laws) = self.sampling.laws.clone() else {
            self.told = is_due.then(|| sample.clone()).or(self.told.take());
            return is_due.then_some(sample);
        };
        let (number, law) = laws.newest();
        let is_other = number != self.law;
        if is_other {
            self.law = number;
            self.followed.values_mut().for_each(|followed| followed.modeller.change_law(number, law.clone()));
        }
        let (models, is_exceeded) = self.look_ahead(&sample, &law);
        // Another law counts as a change: the client renders by the old one until a model refers to the new one.
        if !(is_due || is_exceeded || is_other && !models.is_empty()) {
            return None;
        }
        self.told = Some(sample.clone());
        for (tool, model) in models {
            if let Some(followed) = self.followed.get_mut(&tool) {
                followed.deadband.send(&model, &law);
            }
            sample.tools.iter_mut().filter(|sample| sample.tool == tool).for_each(|sample| sample.local = Some(model));
        }
        Some(sample)
    }

    /// Returns the local models of the tools led by poses, and whether the force that a client renders is beyond
    /// the deadband.
    fn look_ahead(&mut self, sample: &Sample, law: &Arc<Law>) -> (Vec<(u32, LocalModel)>, bool) {
        let fraction = self.sampling.deadband.as_ref().and_then(|deadband| deadband.rendered_fraction);
        let (mut models, mut is_exceeded) = (Vec::new(), false);
        for tool in &sample.tools {
            let Some(feel) = &tool.feel else {
                if let Some(followed) = self.followed.get_mut(&tool.tool) {
                    followed.modeller.let_go();
                    followed.deadband = palpate_haptics::ForceDeadband::new(fraction.unwrap_or(0.0));
                }
                // A client can't render a tool without a model.
                is_exceeded |= fraction.is_some() && tool.contact.is_some();
                continue;
            };
            let followed = self.followed.entry(tool.tool).or_insert_with(|| FollowedTool {
                modeller: Modeller::new(self.law, law.clone(), self.sampling.touch_stiffness),
                deadband: palpate_haptics::ForceDeadband::new(fraction.unwrap_or(0.0)),
            });
            let model = followed.modeller.model(feel, sample.step, tool.place_time_s);
            is_exceeded |= fraction.is_some() && followed.deadband.is_exceeded(&model, law);
            models.push((tool.tool, model));
        }
        (models, is_exceeded)
    }

    /// Returns computations of stiffness and damping, by ascending number, for the tools under which the stream needs
    /// them as of its newest sample: those that grasp and, with `touch_stiffness`, those that touch. Each has a copy
    /// of the tissue around its tool, and computes nothing before [`StiffnessJob::work`]. Empty in a stream without
    /// laws, and before the first sample.
    pub fn refinements(&self, session: &Session) -> impl Iterator<Item = StiffnessJob> {
        let wanted = self.followed.iter().filter(|(_, followed)| followed.modeller.wants_refinement());
        wanted.filter_map(|(tool, followed)| {
            Some(followed.modeller.refinement(session.tissue().tangent_input(*tool as usize)?))
        })
    }

    fn is_news(&self, told: &Sample, now: &Sample) -> bool {
        let asleep = now.awake_points == 0;
        if asleep != (told.awake_points == 0) || told.recoveries != now.recoveries {
            return true;
        }
        match &self.sampling.deadband {
            // A sleeping tissue is still, but a command without other effects may have taken effect.
            None => !asleep || told.tools != now.tools,
            Some(deadband) => {
                let mut pairs = told.tools.iter().zip(&now.tools);
                told.tools.len() != now.tools.len() || pairs.any(|(told, now)| deadband.is_exceeded(told, now))
            }
        }
    }

    /// Returns the next step after `step`, a multiple of N, whose sample the stream gets even if nothing changes from
    /// now on: the next sampled one while the tissue moves, otherwise that of the heartbeat.
    pub fn next_due(&self, step: u64) -> u64 {
        let told = self.told.as_ref().filter(|told| told.awake_points == 0);
        let heartbeat = told.map_or(0, |told| told.step + self.heartbeat_steps());
        heartbeat.max(step + 1).next_multiple_of(self.sampling.every)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::command::{Command, Due};
    use glam::DVec3;
    use palpate_haptics::Tip;
    use palpate_tissue::Model;
    use palpate_tissue::response::force_law;
    use palpate_tissue::scene::script::Action;
    use palpate_tissue::shape::PointId;

    fn session(assignments: &[&str]) -> Session {
        Session::new(&Model::parse("paper", palpate_tissue::scene::PAPER, assignments).unwrap())
    }

    fn sampler(every: u64, deadband: Option<Deadband>) -> Sampler {
        Sampler::new(Sampling { every, deadband, heartbeat_s: 0.02, ..sampling() }, 1000.0)
    }

    fn sampling() -> Sampling {
        Sampling {
            every: 1,
            only: None,
            deadband: None,
            heartbeat_s: HEARTBEAT_S,
            laws: None,
            touch_stiffness: false,
            other_tools: false,
            wanted: None,
        }
    }

    fn tell(session: &mut Session, sequence: u64, action: Action) {
        let command = Command { arrival_ns: 1, ..Command::new(0, Some(sequence), action) };
        session.advance(&mut vec![Due::in_time(command)], |_| {});
    }

    fn grasp(session: &mut Session, sequence: u64, z_m: f64) {
        tell(
            session,
            sequence,
            Action::Grasp { point: PointId::new(15 * 31 + 15), displacement_m: DVec3::new(0.0, 0.0, z_m) },
        );
    }

    #[test]
    fn the_stiffness_is_computed_under_grasps_and_under_touches_for_who_asked() {
        for (grasps, touch_stiffness, computed) in
            [(false, false, false), (false, true, true), (true, false, true), (true, true, true)]
        {
            // In f32 the last digits tilt the surface's normal.
            let mut session = session(&["stepping.precision=f64"]);
            let tip = Tip { grasps, radius_m: 0.05, ..Tip::default() };
            let law = Arc::new(force_law::exact(session.model(), tip.radius_m));
            let laws = Some(Arc::new(Laws::new(law.clone())));
            let mut sampler = Sampler::new(Sampling { laws, touch_stiffness, ..sampling() }, 1000.0);
            let middle_m = session.model().shape().extent().middle_m();
            let (mut model, mut touched) = (None, false);
            for step in 1..=100 {
                let place_m = middle_m - 1e-4 * step as f64 * DVec3::Z;
                tell(&mut session, step, Action::Pose { place_m, velocity_m_per_s: None, tip });
                model = sampler.pick(&session, false).and_then(|sample| sample.tools[0].local);
                let refinements: Vec<_> = sampler.refinements(&session).collect();
                // A touch begins where the tool meets the surface.
                let touches = session.tissue().tangent_input(0).is_some();
                assert_eq!(
                    refinements.len(),
                    usize::from(computed && touches),
                    "grasps {grasps}, asked {touch_stiffness}, step {step}"
                );
                touched |= touches;
                refinements.into_iter().for_each(StiffnessJob::work);
            }
            assert!(touched, "grasps {grasps}, asked {touch_stiffness}");
            // Otherwise they are the law's: one stiffness along the normal, and one across.
            let k = model.unwrap().stiffness_n_per_m;
            let by_law = (0..3).all(|c| (0..c).all(|row| k.col(c)[row].abs() < 1e-9)) && k.x_axis.x == k.y_axis.y;
            let along = law.rows.iter().map(|row| row.stiffness_n_per_m);
            let (least, most) = along.fold((f64::INFINITY, 0.0_f64), |(a, b), k| (a.min(k), b.max(k)));
            assert!(k.z_axis.z > 0.5 * least && k.z_axis.z < 2.0 * most, "{k}");
            assert!(computed || by_law, "{k}");
        }
    }

    /// Returns the steps at which a stream gets a sample while the session gets no command.
    fn picked(session: &mut Session, sampler: &mut Sampler, steps: u64) -> Vec<u64> {
        let pick = |_| {
            session.advance(&mut Vec::new(), |_| {});
            sampler.pick(session, false).map(|sample| sample.step)
        };
        (0..steps).filter_map(pick).collect()
    }

    #[test]
    fn what_is_still_is_told_by_heartbeats_at_multiples_of_n() {
        assert_eq!(picked(&mut session(&[]), &mut sampler(1, None), 50), [1, 21, 41]);
        assert_eq!(picked(&mut session(&[]), &mut sampler(15, None), 100), [15, 45, 75]);
        // `next_due` predicts it, so the steps between can be skipped.
        let (mut session, mut sampler) = (session(&[]), sampler(15, None));
        for due in [15, 45, 75] {
            assert_eq!(sampler.next_due(session.step_count()), due);
            session.skip_to(due);
            assert_eq!(sampler.pick(&session, false).map(|sample| sample.step), Some(due));
        }
    }

    #[test]
    fn what_moves_is_told_every_nth_step_without_a_deadband() {
        let mut session = session(&[]);
        grasp(&mut session, 1, -0.01);
        assert_eq!(picked(&mut session, &mut sampler(7, None), 30), [7, 14, 21, 28]);
    }

    #[test]
    fn a_deadband_passes_what_leaves_it_and_heartbeats() {
        let mut session = session(&[]);
        let deadband = Deadband { displacement_m: Some(0.0025), ..Deadband::default() };
        let mut sampler = sampler(1, Some(deadband));
        let mut steps = Vec::new();
        for step in 1..=60 {
            // One millimetre per step up to 10 mm, then held.
            grasp(&mut session, step, -0.001 * step.min(10) as f64);
            steps.extend(sampler.pick(&session, false).map(|sample| sample.step));
        }
        assert_eq!(steps, [1, 4, 7, 10, 30, 50]);
    }

    #[test]
    fn the_models_of_a_tool_that_has_let_go_and_touches_again_are_newer() {
        let mut session = session(&[]);
        let law = Arc::new(force_law::exact(session.model(), 0.05));
        let laws = Some(Arc::new(Laws::new(law)));
        let mut sampler = Sampler::new(Sampling { laws, ..sampling() }, 1000.0);
        let place_m = session.model().shape().extent().middle_m();
        let pose = Action::Pose { place_m, velocity_m_per_s: None, tip: Tip { radius_m: 0.05, ..Tip::default() } };
        let mut sequences = Vec::new();
        for step in 1..=30 {
            let action = if (11..=20).contains(&step) { Action::Release } else { pose.clone() };
            tell(&mut session, step, action);
            let local = sampler.pick(&session, false).and_then(|sample| sample.tools[0].local);
            sequences.extend(local.map(|model| model.sequence));
        }
        assert!(sequences.len() > 10 && sequences.is_sorted_by(|a, b| a < b), "{sequences:?}");
    }

    #[test]
    fn a_reader_may_want_samples_more_often_for_a_while() {
        let mut session = session(&[]);
        let wanted = Arc::new(WantedHeartbeat::default());
        let deadband = Some(Deadband { displacement_m: Some(1.0), ..Deadband::default() });
        let sampling = Sampling { deadband, heartbeat_s: 0.02, wanted: Some(wanted.clone()), ..sampling() };
        let mut sampler = Sampler::new(sampling, 1000.0);
        grasp(&mut session, 1, -0.01);
        assert_eq!(picked(&mut session, &mut sampler, 41), [2, 22, 42]);
        // At most a hundred times a second.
        wanted.set(0.005);
        assert_eq!(picked(&mut session, &mut sampler, 20), [52, 62]);
        wanted.set(0.0);
        assert_eq!(picked(&mut session, &mut sampler, 20), [82]);
    }

    #[test]
    fn of_two_bounds_of_the_force_the_larger_counts() {
        let contact = |z_n: f64| crate::Contact {
            point: PointId::new(0),
            displacement_m: DVec3::ZERO,
            surface_displacement_m: DVec3::ZERO,
            velocity_m_per_s: DVec3::ZERO,
            force_on_tool_n: DVec3::new(0.0, 0.0, z_n),
            applied_force_n: DVec3::ZERO,
        };
        let tool = |z_n: f64| ToolSample {
            tool: 0,
            acknowledged_sequence: 1,
            client_time_ns: 0,
            arrival_ns: 0,
            contact: Some(contact(z_n)),
            feel: None,
            place_time_s: 0.0,
            local: None,
            stale: false,
            late: false,
            expired: false,
            paused_until: None,
        };
        let deadband = Deadband { force_n: Some(0.1), force_fraction: Some(0.1), ..Deadband::default() };
        for (told_n, now_n, left) in [(0.0, 0.09, false), (0.0, 0.11, true), (10.0, 10.9, false), (10.0, 11.2, true)] {
            assert_eq!(deadband.is_exceeded(&tool(told_n), &tool(now_n)), left, "{told_n} N to {now_n} N");
        }
        // A new acknowledgement alone is not a change; an expired action is.
        let later = ToolSample { acknowledged_sequence: 2, ..tool(0.0) };
        assert!(!deadband.is_exceeded(&tool(0.0), &later));
        assert!(deadband.is_exceeded(&tool(0.0), &ToolSample { expired: true, ..tool(0.0) }));
    }

    #[test]
    fn the_last_sample_before_time_stops_is_told_once() {
        let (mut session, mut sampler) = (session(&[]), sampler(5, None));
        assert_eq!(picked(&mut session, &mut sampler, 7), [5]);
        assert_eq!(sampler.pick(&session, true).map(|sample| sample.step), Some(7));
        assert_eq!(sampler.pick(&session, true), None);
    }

    #[test]
    fn a_heartbeat_is_above_0_and_at_most_10_s() {
        let check = |heartbeat_s: f64| Sampling { heartbeat_s, ..sampling() }.check();
        for good_s in [f64::MIN_POSITIVE, 0.05, MAX_HEARTBEAT_S] {
            assert_eq!(check(good_s), Ok(()), "{good_s}");
        }
        for bad_s in [0.0, -0.05, 10.001, f64::INFINITY, f64::NAN] {
            assert_eq!(check(bad_s).unwrap_err().field, "heartbeat_s", "{bad_s}");
        }
    }
}
