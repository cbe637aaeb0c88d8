//! Chooses what a tolerance requires: the cheapest integrator, substeps and number format that keep the
//! tolerance in a rehearsal.

use std::cell::RefCell;
use std::sync::atomic::AtomicBool;

use crate::limits::Limits;
use crate::scene::BodyKind;
use crate::scene::{Integrator, Lanes, Precision, Scene, Stepping};
use crate::scheme::stability;
use crate::scheme::{self, Oscillator, entry};
use crate::select::calibration::{self, Rehearsal};
use palpate_refusal::{Reason, Refusal, Result};

/// Time over which undamped, growing errors are predicted, s: a longer run of such a tissue may have larger
/// errors than expected.
pub const LASTING_S: f64 = calibration::LASTING_S;

/// The number formats and their costs relative to f32.
const FORMATS: [(Precision, f64); 3] = [(Precision::F32, 1.0), (Precision::Compensated, 1.1), (Precision::F64, 2.6)];

/// Measured times, ns: of a point in a substep of `central` in f32 with the widest lanes, and of a step besides
/// its points.
const POINT_SUBSTEP_NS: f64 = 1.7;
pub(crate) const STEP_NS: f64 = 2000.0;

/// Returns the predicted processor time of a point of a scene in a substep, ns.
pub(crate) fn point_substep_ns(scene: &Scene, integrator: Integrator, precision: Precision, lanes: Lanes) -> f64 {
    let scheme = scene.body.kind().scheme_cost(entry(integrator).cost);
    let format = FORMATS.iter().find(|format| format.0 == precision).map_or(1.0, |found| found.1);
    let width = match lanes {
        Lanes::Auto | Lanes::Avx512 => 1.0,
        Lanes::Avx2 => 1.6,
        Lanes::Neon => 3.0,
        // Fused multiply-adds are calls.
        Lanes::Plain => 200.0,
    };
    POINT_SUBSTEP_NS * scheme * format * width * scene.body.kind().relative_cost()
}

/// Part of the tolerance that rounding may add to a tissue at rest. A rehearsal is too short to show that
/// error.
const RESTING_PART: f64 = 0.5;

/// A stop flag that nobody may set: for callers of [`choose`] and
/// [`Model::compile_until`](crate::Model::compile_until) that wait to the end.
pub static NEVER: AtomicBool = AtomicBool::new(false);

/// Returns the refusal of work whose stop flag was set ([`Reason::TimedOut`], with an empty field).
pub fn given_up() -> Refusal {
    Refusal::new(Reason::TimedOut, "", "was given up, because nobody waits for it")
}

/// Largest number of rehearsals of one integrator in one format.
const MAX_ROUNDS: u32 = 6;

/// Largest number of substeps that `auto` chooses, as a multiple of the number with which an integrator is
/// stable. `central` is stable while the fastest vibration turns by less than 2 rad in a substep. It follows
/// that vibration for as long as it lasts while the turn is [`stability::THETA`] divided by at most 8
/// ([`stability::endurance`]): this limit is the quotient. (Of 700 random scenes at tolerances from 1e-14 to
/// 1e-2, the choices that keep them have at most 32 times as many.)
pub const MAX_TIMES_STABLE: u32 = 64;

/// Error from which courses have nothing in common, so that its size says nothing.
const SATURATED: f64 = 0.1;

/// A choice of integrator, substeps and number format for a scene, with its expected error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Choice {
    /// The integrator; never `Auto`.
    pub integrator: Integrator,
    /// Substeps per step, at least 1.
    pub substeps: u32,
    /// The number format; never `Auto`.
    pub precision: Precision,
    /// The larger of the expected errors of displacement and force, each relative to its largest. Infinite if
    /// it is unknown.
    pub expected_error: f64,
}

/// Returns what rounding adds to the state of a tissue that has come to rest, relative to its displacement:
/// measured.
fn rounding(precision: Precision, sheet: &Oscillator, substep_s: f64) -> f64 {
    let unit = f64::from(f32::EPSILON) / 2.0;
    // A displacement that creeps by less than half its last digit in a substep stands still. What is missing
    // then grows with the number of substeps that the damping takes to release one digit.
    let stiffness = sheet.anchor_stiffness_n_per_m + 0.05 * sheet.spring_stiffness_n_per_m;
    if stiffness == 0.0 {
        return if precision == Precision::F64 { 1e-12 } else { 4.0 * unit };
    }
    let creep = 0.5 * sheet.damping_n_s_per_m / (stiffness * substep_s);
    // The stiffest vibrations' forces are differences of nearly equal displacements.
    let stiff = (sheet.spring_stiffness_n_per_m / stiffness).sqrt();
    match precision {
        Precision::F64 => 1e-12,
        Precision::Compensated => unit * (4.0 + stiff),
        Precision::Auto | Precision::F32 => unit * (4.0 + stiff + creep),
    }
}

/// An integrator that the scene allows, and the substeps per step that it may have.
#[derive(Debug, Clone, Copy)]
struct OpenChoice {
    integrator: Integrator,
    /// With fewer it is unstable, or differs from what the scene gives.
    least: u32,
    /// With more it is chosen only if the scene names it, and if it then keeps the tolerance.
    most: u32,
}

/// Makes the choice for a scene from rehearsals.
struct Chooser<'a> {
    body: &'a dyn BodyKind,
    stepping: &'a Stepping,
    sheet: Oscillator,
    /// The oscillator without the pressure of a volume, which does not reduce creep.
    unpressed: Oscillator,
    rehearsal: Rehearsal<'a>,
    /// The error to keep: the tolerance or, if that can't be verified or no format keeps it, the smallest that
    /// can.
    aim: f64,
    most_substeps: u32,
    open: Vec<OpenChoice>,
    /// All choices tried so far, in this order.
    tried: RefCell<Vec<Choice>>,
}

/// The result of the search for the fewest substeps of an integrator in a format.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Search {
    /// The choice has few substeps and keeps the aim.
    Keeps(Choice),
    /// More substeps did not help: the error comes from the rounding of the format, or from the reference
    /// itself.
    Stalls,
    /// It would need more substeps than allowed.
    Beyond,
}

/// How much a search tries before it gives up.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Effort {
    /// If one integrator stalls, all are taken to stall in this format; an error that does not fall at once is
    /// taken not to fall.
    Quick,
    /// Tries each integrator in each format, from the most exact on, and continues after errors whose size says
    /// nothing.
    Thorough,
}

impl Chooser<'_> {
    fn new<'a>(scene: &'a Scene, limits: &Limits, stop: &'a AtomicBool) -> Chooser<'a> {
        let rehearsal = Rehearsal::new(scene, scene.stepping.tolerance, limits.rehearsal_work, stop);
        let sheet = Oscillator::of(scene);
        let spring_stiffness_n_per_m = stability::stiffness_of_springs_n_per_m(scene);
        let unpressed = Oscillator { spring_stiffness_n_per_m, ..sheet };
        let (stepping, most_substeps) = (&scene.stepping, limits.substeps);
        // An error near the smallest that can be distinguished from none is as good as any.
        let aim = stepping.tolerance.max(2.0 * rehearsal.least_error());
        let mut chooser = Chooser {
            body: scene.body.kind(),
            stepping,
            sheet,
            unpressed,
            rehearsal,
            aim,
            most_substeps,
            open: Vec::new(),
            tried: RefCell::default(),
        };
        chooser.aim = aim.max(chooser.resting_error(Precision::F64, 1));
        chooser.open = chooser.integrators().map(|integrator| chooser.opened(integrator)).collect();
        chooser
    }

    /// Refuses a choice that ran out of work, so that a choice is never less accurate for lack of work. A user
    /// who gives the number of substeps gets a warning instead.
    fn check_work(&self, limits: &Limits) -> Result<()> {
        if self.rehearsal.is_stopped() {
            return Err(given_up());
        }
        if self.stepping.substeps.is_some() || !self.rehearsal.is_cut() {
            return Ok(());
        }
        let message = format!(
            "to find out what keeps an error of {:e} here would take more than {} points × substeps of rehearsals \
             (limits.rehearsal_work): a larger tolerance takes less, and a given number of substeps none",
            self.stepping.tolerance, limits.rehearsal_work
        );
        Err(Refusal::new(Reason::TooLarge, "stepping.tolerance", message))
    }

    /// Returns the integrators that the scene allows.
    fn integrators(&self) -> impl Iterator<Item = Integrator> + use<> {
        let (asked, compensates) = (self.stepping.integrator, self.stepping.precision == Precision::Compensated);
        let candidates =
            scheme::candidates(&self.sheet).iter().copied().filter(move |of| !compensates || entry(*of).compensates);
        let (named, candidates) =
            if asked == Integrator::Auto { (None, Some(candidates)) } else { (Some(asked), None) };
        named.into_iter().chain(candidates.into_iter().flatten())
    }

    fn opened(&self, integrator: Integrator) -> OpenChoice {
        let step_s = self.stepping.rate_hz.recip();
        // An integrator for comparison has exactly the substeps that it needs.
        let needed =
            || self.is_for_comparison(integrator).then(|| stability::substeps(integrator, step_s, &self.sheet));
        if let Some(substeps) = self.stepping.substeps.or_else(needed) {
            return OpenChoice { integrator, least: substeps, most: substeps };
        }
        let stable = stability::stable_substeps(integrator, step_s, &self.sheet);
        let least = Some(self.rehearsal.whole(stable)).filter(|least| *least <= self.most_substeps).unwrap_or(stable);
        let most = stable.saturating_mul(MAX_TIMES_STABLE).min(self.most_substeps);
        OpenChoice { integrator, least, most: self.rehearsal.whole_within(most).max(least) }
    }

    /// Rehearses an integrator with `substeps` in a format, once, and returns the expected error. If it keeps
    /// the aim while the tissue moves but not at rest, the error at rest counts.
    fn tried(&self, integrator: Integrator, substeps: u32, precision: Precision) -> Choice {
        let is_this =
            |tried: &&Choice| (tried.integrator, tried.substeps, tried.precision) == (integrator, substeps, precision);
        if let Some(tried) = self.tried.borrow().iter().find(is_this) {
            return *tried;
        }
        let (moving, resting) =
            (self.rehearsal.error(integrator, substeps, precision), self.resting_error(precision, substeps));
        let expected_error = if resting > self.aim { moving.max(resting) } else { moving };
        let tried = Choice { integrator, substeps, precision, expected_error };
        self.tried.borrow_mut().push(tried);
        tried
    }

    fn keeps(&self, choice: &Choice) -> bool {
        choice.expected_error <= self.aim
    }

    /// Returns the expected error at rest of a format that the scene does not give: rounding alone, which may
    /// be [`RESTING_PART`] of the tolerance.
    fn resting_error(&self, precision: Precision, substeps: u32) -> f64 {
        if self.stepping.precision != Precision::Auto {
            return 0.0;
        }
        let substep_s = (self.stepping.rate_hz * f64::from(substeps)).recip();
        rounding(precision, &self.unpressed, substep_s) / RESTING_PART
    }

    /// Returns the formats that the scene allows for an integrator, by rising cost.
    fn formats(&self, integrator: Integrator) -> Vec<(Precision, f64)> {
        let is_open = |format: &(Precision, f64)| match self.stepping.precision {
            Precision::Auto => format.0 != Precision::Compensated || entry(integrator).compensates,
            asked => format.0 == asked,
        };
        FORMATS.into_iter().filter(is_open).collect()
    }

    /// Finds the fewest substeps, at most `most`, with which an integrator keeps the aim in a format. The
    /// search goes up as the order of the integrator predicts, at most to 3^[`MAX_ROUNDS`] times the stable
    /// number.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn fewest(&self, open: &OpenChoice, precision: Precision, most: u32, effort: Effort) -> Search {
        let OpenChoice { integrator, least, .. } = *open;
        if least > most || self.resting_error(precision, least) > self.aim {
            return Search::Beyond;
        }
        let or_beyond = |choice: Choice| if self.keeps(&choice) { Search::Keeps(choice) } else { Search::Beyond };
        let mut now = self.tried(integrator, least, precision);
        if self.is_given(open) {
            return or_beyond(now);
        }
        let order = entry(integrator).order;
        let mut before: Option<Choice> = None;
        for _ in 0..MAX_ROUNDS {
            if self.keeps(&now) {
                break;
            }
            // As many more as the order predicts; an infinite error says nothing.
            let excess = now.expected_error / self.aim;
            let ratio = libm::pow(excess, order.recip()).min(3.0);
            let more = (f64::from(now.substeps) * ratio).ceil().max(f64::from(now.substeps + 1));
            let more = self.rehearsal.whole(more.min(f64::from(u32::MAX / 2)) as u32);
            if more > most {
                return Search::Beyond;
            }
            let next = self.tried(integrator, more, precision);
            let shorter = f64::from(now.substeps) / f64::from(more);
            let least_fall = libm::pow(shorter, 0.3 * order);
            let says_much = effort == Effort::Quick || now.expected_error < SATURATED;
            if says_much && next.expected_error > now.expected_error * least_fall {
                return if self.keeps(&next) { Search::Keeps(next) } else { Search::Stalls };
            }
            (before, now) = (Some(now), next);
        }
        // The last step may have gone too far: try fewer, by the slope between the last two.
        if let Some(before) =
            before.filter(|before| self.keeps(&now) && self.rehearsal.whole(before.substeps + 1) < now.substeps)
        {
            let ratio = libm::log(f64::from(now.substeps) / f64::from(before.substeps));
            let slope = libm::log(before.expected_error / now.expected_error) / ratio;
            let needed = libm::log(before.expected_error / self.aim) / slope;
            let fewer = self.rehearsal.whole((f64::from(before.substeps) * libm::exp(needed)).ceil() as u32);
            if fewer > before.substeps && fewer < now.substeps {
                let tried = self.tried(integrator, fewer, precision);
                if self.keeps(&tried) {
                    now = tried;
                }
            }
        }
        or_beyond(now)
    }

    /// Returns whether the number of substeps is fixed.
    fn is_given(&self, open: &OpenChoice) -> bool {
        self.stepping.substeps.is_some() || self.is_for_comparison(open.integrator)
    }

    /// Returns whether an integrator is none that `auto` may become.
    fn is_for_comparison(&self, integrator: Integrator) -> bool {
        !scheme::candidates(&self.sheet).contains(&integrator)
    }
}

/// Returns the fewest substeps of a step of `step_s` with which an integrator is stable (or the best of those
/// that `auto` may choose). Saturates for absurd scenes.
pub(crate) fn least_substeps(asked: Integrator, step_s: f64, sheet: &Oscillator) -> u32 {
    let is_open = |integrator: Integrator| asked == Integrator::Auto || asked == integrator;
    let open = scheme::candidates(sheet).iter().copied().filter(|integrator| is_open(*integrator));
    let least = open.map(|integrator| stability::stable_substeps(integrator, step_s, sheet)).min();
    least.unwrap_or_else(|| stability::substeps(asked, step_s, sheet))
}

/// Returns the fewest substeps per step that a scene needs for stability (with `auto`, those of the best
/// integrator that it may choose), or those that the scene gives; and the processor time of a step of the
/// cheapest kind with them and all points awake, s (see
/// [`Model::predicted_step_s`](crate::Model::predicted_step_s)). Runs no rehearsals and checks no limits: the
/// substeps may be above `limits.substeps`.
#[allow(clippy::cast_precision_loss)]
pub fn least_step(scene: &Scene) -> (u32, f64) {
    let Stepping { integrator, substeps, precision, rate_hz, lanes, .. } = scene.stepping;
    let least = || least_substeps(integrator, rate_hz.recip(), &Oscillator::of(scene));
    let substeps = substeps.unwrap_or_else(least);
    let point_ns =
        point_substep_ns(scene, integrator, precision, crate::kernel::lanes::available(lanes).unwrap_or(lanes));
    let points = scene.shape().point_count();
    (substeps, 1e-9 * (STEP_NS + point_ns * points as f64 * f64::from(substeps)))
}

/// Returns, for every integrator that the scene allows, the choice that would be made if it were the only one;
/// by falling order of the integrators. An integrator that needs more than `limits.substeps` is left out, so
/// the list may be empty. Runs rehearsals, which block for some tenths of a second; if `limits.rehearsal_work`
/// does not suffice, choices may be less good or have an infinite expected error.
pub fn candidates(scene: &Scene, limits: &Limits) -> Vec<Choice> {
    let chooser = Chooser::new(scene, limits, &NEVER);
    let possible = chooser.open.iter().filter(|open| open.least <= limits.substeps);
    possible.map(|open| chooser.best(std::slice::from_ref(open))).collect()
}

/// Returns the choice for a scene if it gave no integrator, no substeps and no precision. Runs rehearsals,
/// which block for some tenths of a second. `None` if the scene gives none of them anyway, or if no such choice
/// can be made within the limits `substeps` and `rehearsal_work`.
pub fn by_auto(scene: &Scene, limits: &Limits) -> Option<Choice> {
    let given = &scene.stepping;
    let auto = Stepping { integrator: Integrator::Auto, substeps: None, precision: Precision::Auto, ..given.clone() };
    let least = least_substeps(Integrator::Auto, auto.rate_hz.recip(), &Oscillator::of(scene));
    if auto == *given || least > limits.substeps {
        return None;
    }
    choose(&Scene { stepping: auto, ..scene.clone() }, limits, &NEVER).ok().map(|(choice, _)| choice)
}

/// Chooses integrator, substeps and format for a scene's tolerance, as far as the scene leaves them open:
///
/// 1. The cheapest choice that is expected to keep the tolerance.
/// 2. If there is none: the cheapest whose error is at most twice the smallest that can be distinguished from
///    none; if there is none either, the choice with the smallest expected error.
/// 3. If no error can be predicted: the cheapest stable scheme, with as many substeps as let the fastest
///    vibration turn by at most [`stability::THETA`] in each: at most 8 times as many as stability needs.
///
/// No choice has more than [`MAX_TIMES_STABLE`] times the substeps with which it is stable, except an
/// integrator that the scene names and that keeps the tolerance with more.
///
/// Also returns the work of the rehearsals in points × substeps. They block for some tenths of a second. The
/// scene must be valid ([`Scene::check`]). The substeps may be above `limits.substeps` if the scene gives them
/// or needs them for stability: the caller must check that.
///
/// # Errors
/// Refuses a scene that gives no substeps and for which that would take more than `limits.rehearsal_work`
/// ([`Reason::TooLarge`]); and refuses if another thread has set `stop` ([`Reason::TimedOut`]).
pub fn choose(scene: &Scene, limits: &Limits, stop: &AtomicBool) -> Result<(Choice, u64)> {
    let chooser = Chooser::new(scene, limits, stop);
    let choice = chooser.best(&chooser.open);
    chooser.check_work(limits).map(|()| (choice, limits.rehearsal_work - chooser.rehearsal.left()))
}

impl Chooser<'_> {
    /// Returns the cost of a substep of an integrator in a format, in substeps of `central` in f32.
    fn cost(&self, integrator: Integrator, format_cost: f64) -> f64 {
        self.body.scheme_cost(entry(integrator).cost) * format_cost
    }

    /// Makes the choice of [`choose`] among some integrators. If one of them alone keeps the tolerance, the
    /// overall choice does too: a thorough search leaves none out.
    fn best(&self, open: &[OpenChoice]) -> Choice {
        let cheapest = self.cheapest(open, Effort::Quick).or_else(|| self.cheapest(open, Effort::Thorough));
        cheapest.or_else(|| self.nearest(open)).unwrap_or_else(|| self.unpredicted(open))
    }

    /// Returns the cheapest choice that keeps the aim.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn cheapest(&self, open: &[OpenChoice], effort: Effort) -> Option<Choice> {
        if self.aim.is_infinite() {
            return None;
        }
        let mut formats = FORMATS;
        if effort == Effort::Thorough {
            formats.reverse();
        }
        let is_kept = effort == Effort::Quick && self.aim <= self.stepping.tolerance;
        let may_go_beyond = is_kept && self.stepping.integrator != Integrator::Auto;
        let mut best = None::<(f64, Choice)>;
        for (format, format_cost) in formats {
            for open in open {
                let of_this = self.formats(open.integrator);
                if !of_this.iter().any(|open| open.0 == format) {
                    continue;
                }
                let cost = self.cost(open.integrator, format_cost);
                // A choice that is not cheaper than the best so far need not be tried.
                let most = best.as_ref().map_or(u32::MAX, |(least, _)| (least / cost - 1e-9).floor() as u32);
                let bound = if may_go_beyond { self.most_substeps } else { open.most.min(self.most_substeps) };
                let is_exact = of_this.last().is_some_and(|last| last.0 == format);
                let of_search = if is_exact { effort } else { Effort::Quick };
                match self.fewest(open, format, most.min(bound), of_search) {
                    Search::Keeps(choice) => {
                        let cost = cost * f64::from(choice.substeps);
                        if best.as_ref().is_none_or(|(least, _)| cost < *least) {
                            best = Some((cost, choice));
                        }
                    }
                    Search::Stalls if effort == Effort::Quick => break,
                    Search::Stalls | Search::Beyond => {}
                }
            }
            // A format that rounds more will hardly keep what this one does.
            if effort == Effort::Thorough && best.is_some() {
                break;
            }
        }
        best.map(|(_, choice)| choice)
    }

    /// Returns the choice with the smallest error among those tried with at most [`OpenChoice::most`] substeps,
    /// and the most exact format with the fewest substeps. `None` if no error is known.
    fn nearest(&self, open: &[OpenChoice]) -> Option<Choice> {
        if self.aim.is_infinite() {
            return None;
        }
        let possible = open.iter().filter(|open| open.least <= self.most_substeps);
        for open in possible.clone() {
            let formats = self.formats(open.integrator);
            let skipped = if self.is_given(open) { 0 } else { formats.len().saturating_sub(1) };
            for (format, _) in formats.into_iter().skip(skipped) {
                self.tried(open.integrator, open.least, format);
            }
        }
        let tried = self.tried.borrow();
        let is_near = |tried: &&Choice| {
            possible.clone().any(|open| open.integrator == tried.integrator && tried.substeps <= open.most)
        };
        let finite = tried.iter().filter(|tried| tried.expected_error.is_finite()).filter(is_near);
        finite.min_by(|a, b| a.expected_error.total_cmp(&b.expected_error)).copied()
    }

    /// Returns the choice if no error can be predicted.
    fn unpredicted(&self, open: &[OpenChoice]) -> Choice {
        let step_s = self.stepping.rate_hz.recip();
        let stable_cost = |integrator: Integrator| {
            self.cost(integrator, f64::from(stability::stable_substeps(integrator, step_s, &self.sheet)))
        };
        let cheapest = open.iter().min_by(|a, b| stable_cost(a.integrator).total_cmp(&stable_cost(b.integrator)));
        // A scene always allows at least one.
        let open = cheapest.copied().unwrap_or_else(|| self.opened(Integrator::Central));
        let turn = stability::substeps_of_turn(step_s, self.sheet.omega_bound_per_s(), stability::THETA);
        let substeps = turn.clamp(open.least, open.most);
        let formats = self.formats(open.integrator);
        let rests = |format: &&(Precision, f64)| self.resting_error(format.0, substeps) <= self.stepping.tolerance;
        let precision = formats.iter().find(rests).or(formats.last()).map_or(Precision::F64, |format| format.0);
        Choice { integrator: open.integrator, substeps, precision, expected_error: f64::INFINITY }
    }
}

#[cfg(test)]
mod tests;
