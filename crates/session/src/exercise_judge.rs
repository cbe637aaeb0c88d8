//! An exercise while it is done: its hidden truth, and how what the trainee does is judged by it.

use std::sync::Arc;

use glam::DVec3;

use crate::{RecordedMark, Session};
use palpate_exercise::answers::{AnswerRules, HiddenTarget, MarkedPlace, place_count};
use palpate_exercise::incision::{SeveredPlace, TargetLine};
use palpate_exercise::tasks::{AvoidedBall, LiftTarget, TaskMeasures};
use palpate_exercise::{ExerciseTruth, Figure, ToolRow, register};
use palpate_refusal::{Reason, Refusal, Result, did_you_mean};
use palpate_tissue::scene::action_check::check_free;
use palpate_tissue::scene::exercise::{Criterion, Exercise, Lump};
use palpate_tissue::shape::{PointId, RestShape};
use palpate_tissue::{Model, TieState};

/// Judges what is done in an exercise. Show it the session after each step, with the rows of its tools
/// ([`MeasureRecorder::rows`](crate::measure_recorder::MeasureRecorder::rows)).
#[derive(Debug, Clone)]
pub struct ExerciseJudge {
    exercise: Arc<Exercise>,
    lumps: Vec<Lump>,
    /// The lumps that the trainer has hidden since.
    added_lumps: Arc<[Lump]>,
    tasks: TaskMeasures,
    /// The point nearest to the place that must be lifted.
    lifted: Option<PointId>,
    rate_hz: f64,
    begin_step: u64,
    newest: u64,
    /// Number of springs that were severed at the beginning of what is judged: of the exercise, or of a phase.
    severed_before: usize,
    /// Number of springs between points that were severed at the beginning of the exercise.
    joints_before: usize,
    /// The threads and clips that were there at the beginning of the exercise.
    ties_before: Vec<usize>,
    /// Whether it judges a phase that is not the first: its beginning is not that of the exercise.
    is_later_phase: bool,
    /// Whether the trainee has done anything: touched the tissue, cut it, or marked a place.
    has_acted: bool,
    /// Number of marks that were there at the beginning.
    marks_before: usize,
}

/// A criterion of the score and what it earned.
#[derive(Debug, Clone, PartialEq)]
pub struct EarnedCriterion {
    /// The criterion.
    pub criterion: Criterion,
    /// The value of its measure; `None` if that has none, which earns nothing.
    pub value: Option<f64>,
    /// The part of its weight that it earned, 0 to 1.
    pub part: f64,
}

/// The figures of a phase.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PhaseFigures {
    /// Number of steps done at its beginning.
    pub begin_step: u64,
    /// Number of steps done at its end, or so far.
    pub end_step: u64,
    /// The figures that need no truth, then those of the exercise.
    pub figures: Vec<Figure>,
}

/// The score of an exercise.
#[derive(Debug, Clone, PartialEq)]
pub struct ExerciseScore {
    /// The earned part of all weights, in percent.
    pub percent: f64,
    /// What each criterion earned.
    pub criteria: Vec<EarnedCriterion>,
}

impl ExerciseJudge {
    /// Begins an exercise at step `begin_step` of a session of this tissue, which has `lumps` ([`Exercise::lumps`]).
    ///
    /// # Errors
    /// Refuses a criterion of a measure that does not exist or that this exercise does not have, places off the tissue, and a fixed
    /// place to lift.
    pub fn new(exercise: &Exercise, lumps: Vec<Lump>, model: &Model, begin_step: u64) -> Result<Self> {
        check_criteria(exercise)?;
        check_places(exercise, model.shape()).map_err(|refusal| within(exercise, refusal))?;
        let avoided =
            exercise.avoid.iter().map(|ball| AvoidedBall { centre_m: ball.centre_m, radius_m: ball.radius_m });
        let lift = exercise.lift.map(|lift| LiftTarget { height_m: lift.height_m, hold_s: lift.hold_s });
        Ok(ExerciseJudge {
            lumps,
            added_lumps: model.scene.added_lumps.clone(),
            tasks: TaskMeasures::new(exercise.seen_along, avoided.collect(), lift),
            lifted: exercise.lift.map(|lift| model.shape().nearest(lift.place_m)),
            begin_step,
            newest: begin_step,
            severed_before: 0,
            joints_before: 0,
            ties_before: Vec::new(),
            is_later_phase: false,
            has_acted: false,
            marks_before: 0,
            rate_hz: model.scene.stepping.rate_hz,
            exercise: Arc::new(exercise.clone()),
        })
    }

    /// Takes the session at its present step, with the rows of its tools; the first time at its beginning, so that what was cut or tied
    /// before does not count. Steps that were skipped at rest count as if nothing had changed in them.
    pub fn see(&mut self, session: &Session, rows: &[ToolRow]) {
        let step = session.step_count();
        self.added_lumps.clone_from(&session.model().scene.added_lumps);
        if step == self.begin_step && !self.is_later_phase {
            self.severed_before = session.tissue().cuts().len();
            self.joints_before = session.tissue().cuts().joint_count();
            self.marks_before = session.marks().len();
            self.ties_before = session.tissue().ties().iter().map(|tie| tie.number).collect();
        }
        // A blade in a tissue without toughness feels nothing.
        self.has_acted = self.has_acted
            || rows.iter().any(|row| row.is_in_contact)
            || !self.answers(session).is_empty()
            || session.tissue().cuts().len() > self.severed_before;
        if step > self.newest {
            let up = -self.exercise.seen_along;
            let lifted_m = self.lifted.map_or(0.0, |point| session.tissue().point(point).displacement_m.dot(up));
            self.tasks.step(rows, lifted_m, step - self.newest);
            self.newest = step;
        }
    }

    /// Returns the number of steps done when the time that the trainee has is up; `None` without a limit.
    pub fn limit_step(&self) -> Option<u64> {
        self.exercise.time_limit_s.map(|limit_s| limit_step(self.begin_step, limit_s, self.rate_hz))
    }

    /// Returns the judge of the phase that begins at the session's present step, after the one that this judges. Its marks, and what is
    /// judged step by step, are those of the phase. What is severed and tied since the exercise began counts: a wound of an earlier phase
    /// is closed in this one.
    pub(crate) fn of_phase(&self, session: &Session) -> Self {
        let step = session.step_count();
        ExerciseJudge {
            tasks: self.tasks.again(),
            begin_step: step,
            newest: step,
            is_later_phase: true,
            severed_before: session.tissue().cuts().len(),
            marks_before: session.marks().len(),
            has_acted: false,
            ..self.clone()
        }
    }

    /// Returns the number of steps done at its beginning.
    pub(crate) fn begin_step(&self) -> u64 {
        self.begin_step
    }

    /// Returns the number of steps per second.
    pub(crate) fn rate_hz(&self) -> f64 {
        self.rate_hz
    }

    /// Returns whether the trainee has touched, cut or marked anything.
    pub(crate) fn has_acted(&self) -> bool {
        self.has_acted
    }

    /// Returns whether the time that the trainee has is up.
    pub fn is_time_up(&self, session: &Session) -> bool {
        self.limit_step().is_some_and(|step| session.step_count() >= step)
    }

    /// Returns the exercise.
    pub fn exercise(&self) -> &Exercise {
        &self.exercise
    }

    /// Returns the lumps that are hidden: those with which the exercise began, then those that the trainer has hidden since.
    pub fn lumps(&self) -> impl Iterator<Item = &Lump> {
        self.lumps.iter().chain(self.added_lumps.iter())
    }

    /// Returns the lumps that the trainer has hidden since the exercise began.
    pub fn added_lumps(&self) -> &[Lump] {
        &self.added_lumps
    }

    /// Returns what was done step by step.
    pub fn tasks(&self) -> &TaskMeasures {
        &self.tasks
    }

    /// Returns the score by all figures, also those that need no truth, and by those of the phases so far, each
    /// with whether anything was done in it; `None` without a criterion. A
    /// trainee who has done nothing earns nothing, though nothing was done wrong, and so in each phase.
    pub(crate) fn score(&self, figures: &[Figure], phases: &[(&[Figure], bool)]) -> Option<ExerciseScore> {
        let earned = |criterion: &Criterion| {
            let (figures, has_acted) = match criterion.phase {
                None => (figures, self.has_acted),
                Some(phase) => {
                    (phase as usize).checked_sub(1).and_then(|index| phases.get(index)).copied().unwrap_or((&[], false))
                }
            };
            let of_all = |figure: &&Figure| figure.definition.name == criterion.measure && figure.tool.is_none();
            // A measure of single tools counts by the worst of them.
            let of_tools = figures.iter().filter(|figure| figure.definition.name == criterion.measure);
            let worst = of_tools
                .map(|figure| figure.value)
                .min_by(|one, other| criterion.part(*one).total_cmp(&criterion.part(*other)));
            let value = figures.iter().find(of_all).map(|figure| figure.value).or(worst);
            EarnedCriterion {
                criterion: criterion.clone(),
                value,
                part: value.filter(|_| has_acted).map_or(0.0, |value| criterion.part(value)),
            }
        };
        let criteria: Vec<_> = self.exercise.criteria.iter().map(earned).collect();
        let all: f64 = criteria.iter().map(|earned| earned.criterion.weight).sum();
        let earned: f64 = criteria.iter().map(|earned| earned.criterion.weight * earned.part).sum();
        (all > 0.0).then_some(ExerciseScore { percent: 100.0 * earned / all, criteria })
    }

    /// Returns the places that were marked since the exercise began.
    pub fn answers<'s>(&self, session: &'s Session) -> &'s [RecordedMark] {
        session.marks().get(self.marks_before..).unwrap_or_default()
    }

    /// Returns the truth of the exercise beside what is there now: with [`ExerciseJudge::tasks`] it gives the figures that need the truth.
    pub fn truth(&self, session: &Session) -> ExerciseTruth {
        let seen_along = self.exercise.seen_along;
        let (targets, rules) = match &self.exercise.lumps {
            None => (Vec::new(), None),
            Some(hidden) => {
                let radius_m = 0.5 * (hidden.radius_m[0] + hidden.radius_m[1]) + hidden.found_within_m;
                let rules = AnswerRules {
                    seen_along,
                    within_m: hidden.found_within_m,
                    place_count: place_count(hidden.from_m, hidden.to_m, seen_along, radius_m),
                };
                let target = |lump: &Lump| HiddenTarget { centre_m: lump.centre_m, radius_m: lump.radius_m };
                // An exercise that never hides anything has no answers.
                (self.lumps().map(target).collect(), (hidden.count[1] > 0).then_some(rules))
            }
        };
        let answer =
            |placed: &RecordedMark| MarkedPlace { place_m: placed.mark.place_m, diameter_m: placed.mark.diameter_m };
        let line = |line: &palpate_tissue::scene::exercise::CutLine| TargetLine {
            points_m: line.points_m.clone(),
            within_m: line.within_m,
        };
        let holds = |tie: &&TieState| !tie.is_broken && !self.ties_before.contains(&tie.number);
        let bites_m = |tie: &TieState| tie.tie.bites.iter().map(|bite| bite.place_m).collect();
        ExerciseTruth {
            seen_along,
            targets,
            rules,
            answers: self.answers(session).iter().map(answer).collect(),
            lines: self.exercise.lines.iter().map(line).collect(),
            severed: severed(session, self.joints_before),
            stitches_m: session.tissue().ties().iter().filter(holds).map(bites_m).collect(),
        }
    }
}

/// Returns the number of steps done when a time, s, is up that begins with `begin_step`.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub(crate) fn limit_step(begin_step: u64, limit_s: f64, rate_hz: f64) -> u64 {
    // Saturating cast.
    begin_step.saturating_add(((limit_s * rate_hz).ceil() as u64).max(1))
}

/// Returns a refusal with the name of the exercise.
fn within(exercise: &Exercise, refusal: Refusal) -> Refusal {
    Refusal { place: Some(format!("exercise {}", exercise.name)), ..refusal }
}

/// Checks the criteria of an exercise.
///
/// # Errors
/// Refuses a criterion whose measure does not exist, or has no value in this exercise.
pub fn check_criteria(exercise: &Exercise) -> Result<()> {
    criteria(exercise).map_err(|refusal| within(exercise, refusal))
}

fn criteria(exercise: &Exercise) -> Result<()> {
    for (index, criterion) in exercise.criteria.iter().enumerate() {
        let name = criterion.measure.as_str();
        let field = format!("criterion[{index}].measure");
        if register::find(name).is_none() {
            let names = register::definitions().map(|definition| definition.name);
            let message = format!("there is no measure `{name}`{}", did_you_mean(name, names));
            return Err(Refusal::new(Reason::WrongKind, field, message));
        }
        let (is_there, section) = match name {
            "hits" | "misses" | "hits_share" | "false_alarms" | "d_prime" | "place_error_m" | "size_error_m" => {
                (exercise.lumps.as_ref().is_some_and(|lumps| lumps.count[1] > 0), "[lumps] with a count above 0")
            }
            "line_cut_share" | "line_error_rms_m" | "off_line_share" => (!exercise.lines.is_empty(), "a [[line]]"),
            "avoided_contact_s" | "avoided_peak_force_n" => (!exercise.avoid.is_empty(), "an [[avoid]]"),
            "lift_height_m" | "held_share" => (exercise.lift.is_some(), "[lift]"),
            "force_above_limit_share" => (exercise.limits.force_n.is_some(), "[limits] with force_n"),
            "pressure_above_limit_share" => (exercise.limits.pressure_pa.is_some(), "[limits] with pressure_pa"),
            "peak_strain" | "strain_above_limit_share" => (exercise.limits.strain.is_some(), "[limits] with strain"),
            _ => (true, ""),
        };
        if !is_there {
            return Err(Refusal::new(Reason::Missing, field, format!("`{name}` needs {section}")));
        }
    }
    for (index, name) in exercise.trainee.live_measures.iter().flatten().enumerate() {
        let field = format!("trainee.live_measures[{index}]");
        match register::find(name) {
            None => {
                let names = register::definitions().map(|definition| definition.name);
                let message = format!("there is no measure `{name}`{}", did_you_mean(name, names));
                return Err(Refusal::new(Reason::WrongKind, field, message));
            }
            Some(definition) if register::needs_truth(definition) => {
                let message = format!("`{name}` needs the truth, which a trainee is not told before the end");
                return Err(Refusal::new(Reason::OutOfRange, field, message));
            }
            Some(_) => {}
        }
    }
    Ok(())
}

/// Refuses places that are not on the tissue.
fn check_places(exercise: &Exercise, shape: &dyn RestShape) -> Result<()> {
    for (index, line) in exercise.lines.iter().enumerate() {
        line.points_m.iter().try_for_each(|place_m| shape.check_place(&format!("line[{index}].points_m"), *place_m))?;
    }
    for (index, ball) in exercise.avoid.iter().enumerate() {
        shape.check_place(&format!("avoid[{index}].centre_m"), ball.centre_m)?;
    }
    let Some(lift) = exercise.lift else { return Ok(()) };
    shape.check_place("lift.place_m", lift.place_m)?;
    check_free("lift.place_m", shape, shape.nearest(lift.place_m))
}

/// Returns what is severed now beside the first `before` springs, and how far it is open.
fn severed(session: &Session, before: usize) -> Vec<SeveredPlace> {
    let (tissue, model) = (session.tissue(), session.model());
    let shape = model.shape();
    let of = |joint: &palpate_tissue::SeveredJoint| {
        let rest_m = joint.points.map(|point| shape.rest_m(point));
        let now_m = joint.points.map(|point| shape.rest_m(point) + tissue.point(point).displacement_m);
        let length_m = |ends: [DVec3; 2]| ends[0].distance(ends[1]);
        SeveredPlace { rest_m: rest_m[0].lerp(rest_m[1], joint.part), opening_m: length_m(now_m) - length_m(rest_m) }
    };
    tissue.cuts().joints(model).iter().skip(before).map(of).collect()
}
