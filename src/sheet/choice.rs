//! What a tolerance asks for: integrator, substeps and number format, the cheapest that keep to it in a rehearsal.

use std::sync::atomic::AtomicBool;

use super::integrate::{CANDIDATES, Oscillator, entry};
use super::rehearsal::{self, Rehearsal};
use super::stability;
use crate::limits::Limits;
use crate::refusal::{Reason, Refusal, Result};
use crate::scene::{Integrator, Lanes, Precision, Scene, Stepping};

/// Time over which undamped, growing errors are predicted, s.
pub const LASTING_S: f64 = rehearsal::LASTING_S;

/// The number formats and what each costs, in f32.
const FORMATS: [(Precision, f64); 3] = [(Precision::F32, 1.0), (Precision::Compensated, 1.1), (Precision::F64, 2.6)];

/// A point in a substep of `central` in f32 with the widest lanes, and a step beside its points, ns: measured.
const POINT_SUBSTEP_NS: f64 = 1.7;
pub(super) const STEP_NS: f64 = 2000.0;

/// What a vertex of a mesh takes over a point of a sheet: measured.
const VERTEX: f64 = 2.8;

/// The processor time that a point of a scene is expected to take in a substep, ns.
pub(super) fn point_substep_ns(scene: &Scene, integrator: Integrator, precision: Precision, lanes: Lanes) -> f64 {
    let scheme = entry(integrator).cost;
    let format = FORMATS.iter().find(|format| format.0 == precision).map_or(1.0, |found| found.1);
    let width = match lanes {
        Lanes::Auto | Lanes::Avx512 => 1.0,
        Lanes::Avx2 => 1.6,
        Lanes::Neon => 3.0,
        // Fused multiply-adds are calls.
        Lanes::Plain => 200.0,
    };
    let kind = if scene.sheet().is_some() { 1.0 } else { VERTEX };
    POINT_SUBSTEP_NS * scheme * format * width * kind
}

/// What rounding may add to a sheet that is at rest, as a part of the tolerance: a rehearsal is over before that shows.
const RESTING_PART: f64 = 0.5;

/// The flag of a caller who waits to the end.
pub static NEVER: AtomicBool = AtomicBool::new(false);

/// The refusal of work whose caller's flag is set.
pub fn given_up() -> Refusal {
    Refusal::new(Reason::TimedOut, "", "was given up: nobody waits for it any more")
}

/// Rehearsals of one integrator in one format at most.
const MOST_ROUNDS: u32 = 6;

/// An integrator, how often it is used in a step, in which format, and what to expect of that.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Choice {
    /// The integrator.
    pub integrator: Integrator,
    /// Substeps a step.
    pub substeps: u32,
    /// The format.
    pub precision: Precision,
    /// Expected error of displacement and force, the larger, relative to the largest of each.
    pub expected_error: f64,
}

/// What rounding adds to the state of a sheet that has come to rest, relative to its displacement: measured.
fn rounding(precision: Precision, sheet: &Oscillator, substep_s: f64) -> f64 {
    let unit = f64::from(f32::EPSILON) / 2.0;
    // A displacement that creeps by less than half its last digit in a substep stands still: short by so many digits as
    // the damping takes substeps to let go of one.
    let stiffness = sheet.virtual_stiffness_n_per_m + 0.05 * sheet.spring_stiffness_n_per_m;
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

/// The choice for a scene, and what it is made from.
struct Chooser<'a> {
    stepping: &'a Stepping,
    sheet: Oscillator,
    /// The same without the pressure of a volume, which lets nothing creep less.
    unpressed: Oscillator,
    rehearsal: Rehearsal<'a>,
    most_substeps: u32,
}

/// How the search for the fewest substeps of an integrator in a format ended.
struct Fewest {
    /// What keeps to the tolerance or, if nothing does, what misses it least.
    choice: Choice,
    /// Shorter substeps did not help: the format's rounding is what errs.
    rounding: bool,
}

impl Chooser<'_> {
    fn new<'a>(scene: &'a Scene, limits: &Limits, stop: &'a AtomicBool) -> Chooser<'a> {
        let rehearsal = Rehearsal::new(scene, scene.stepping.tolerance, limits.rehearsal_work, stop);
        let sheet = Oscillator::of(scene);
        let spring_stiffness_n_per_m = stability::stiffness_of_springs_n_per_m(scene);
        let unpressed = Oscillator { spring_stiffness_n_per_m, ..sheet };
        Chooser { stepping: &scene.stepping, sheet, unpressed, rehearsal, most_substeps: limits.substeps }
    }

    /// A choice is never less accurate for want of work: it is refused. Whoever gives the number of substeps answers for
    /// it, and is warned of an error that is not known.
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

    fn tried(&self, integrator: Integrator, substeps: u32, precision: Precision) -> Choice {
        let expected_error = self.rehearsal.error(integrator, substeps, precision);
        Choice { integrator, substeps, precision, expected_error }
    }

    fn keeps(&self, choice: &Choice) -> bool {
        choice.expected_error <= self.stepping.tolerance && self.rests(choice.precision, choice.substeps)
    }

    /// Whether a sheet that is held in this format comes to rest where it should, as exactly as [`RESTING_PART`] asks.
    fn rests(&self, precision: Precision, substeps: u32) -> bool {
        let substep_s = (self.stepping.rate_hz * f64::from(substeps)).recip();
        self.stepping.precision != Precision::Auto
            || rounding(precision, &self.unpressed, substep_s) <= RESTING_PART * self.stepping.tolerance
    }

    /// Formats that the scene leaves open to an integrator.
    fn formats(&self, integrator: Integrator) -> impl Iterator<Item = (Precision, f64)> {
        let asked = self.stepping.precision;
        FORMATS.into_iter().filter(move |(format, _)| match asked {
            Precision::Auto => *format != Precision::Compensated || entry(integrator).compensates,
            asked => *format == asked,
        })
    }

    /// Fewest substeps, at most `most`, with which a scheme is stable and keeps to the tolerance. None if it is not stable
    /// with so few.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn fewest(&self, integrator: Integrator, precision: Precision, most: u32) -> Option<Fewest> {
        let order = entry(integrator).order;
        if let Some(substeps) = self.stepping.substeps {
            return Some(Fewest { choice: self.tried(integrator, substeps, precision), rounding: false });
        }
        let least = stability::stable_substeps(integrator, self.stepping.rate_hz.recip(), &self.sheet);
        let least = self.rehearsal.whole(least);
        if least > most || !self.rests(precision, least) {
            return None;
        }
        let mut now = self.tried(integrator, least, precision);
        let mut before: Option<Choice> = None;
        for _ in 0..MOST_ROUNDS {
            if self.keeps(&now) {
                break;
            }
            // As many more as the order says; an infinite error says nothing.
            let excess = now.expected_error / self.stepping.tolerance;
            let ratio = libm::pow(excess, order.recip()).min(3.0);
            let more = (f64::from(now.substeps) * ratio).ceil().max(f64::from(now.substeps + 1));
            let more = self.rehearsal.whole(more.min(f64::from(u32::MAX / 2)) as u32);
            if more > most {
                return Some(Fewest { choice: now, rounding: false });
            }
            let next = self.tried(integrator, more, precision);
            let shorter = f64::from(now.substeps) / f64::from(more);
            if next.expected_error > now.expected_error * libm::pow(shorter, 0.3 * order) {
                let choice = if next.expected_error < now.expected_error { next } else { now };
                return Some(Fewest { choice, rounding: !self.keeps(&choice) });
            }
            (before, now) = (Some(now), next);
        }
        // The last leap may have gone too far: fewer, by the slope between the two.
        if let Some(before) =
            before.filter(|before| self.keeps(&now) && self.rehearsal.whole(before.substeps + 1) < now.substeps)
        {
            let ratio = libm::log(f64::from(now.substeps) / f64::from(before.substeps));
            let slope = libm::log(before.expected_error / now.expected_error) / ratio;
            let needed = libm::log(before.expected_error / self.stepping.tolerance) / slope;
            let fewer = self.rehearsal.whole((f64::from(before.substeps) * libm::exp(needed)).ceil() as u32);
            if fewer > before.substeps && fewer < now.substeps {
                let tried = self.tried(integrator, fewer, precision);
                if self.keeps(&tried) {
                    now = tried;
                }
            }
        }
        Some(Fewest { choice: now, rounding: false })
    }

    /// Integrators that the scene leaves open.
    fn integrators(&self) -> impl Iterator<Item = Integrator> + Clone + use<> {
        let (asked, compensates) = (self.stepping.integrator, self.stepping.precision == Precision::Compensated);
        CANDIDATES.into_iter().filter(move |integrator| match asked {
            Integrator::Auto => !compensates || entry(*integrator).compensates,
            asked => asked == *integrator,
        })
    }

    /// One that is asked for by name and is no candidate: as many substeps as it has to have.
    fn yardstick(&self) -> Choice {
        let integrator = self.stepping.integrator;
        let needed = || stability::substeps(integrator, self.stepping.rate_hz.recip(), &self.sheet);
        let substeps = self.stepping.substeps.unwrap_or_else(needed);
        let tried = self.formats(integrator).map(|(precision, _)| self.tried(integrator, substeps, precision));
        let mut least = None::<Choice>;
        for choice in tried {
            if self.keeps(&choice) {
                return choice;
            }
            if least.is_none_or(|least| choice.expected_error < least.expected_error) {
                least = Some(choice);
            }
        }
        least.unwrap_or(Choice { integrator, substeps, precision: Precision::F64, expected_error: f64::INFINITY })
    }
}

/// The fewest substeps of `step_s` with which an integrator can do, or the best of those that `auto` may become. Saturates
/// for absurd scenes.
pub(super) fn least_substeps(asked: Integrator, step_s: f64, sheet: &Oscillator) -> u32 {
    let is_open = |integrator: Integrator| asked == Integrator::Auto || asked == integrator;
    let open = CANDIDATES.into_iter().filter(|integrator| is_open(*integrator));
    let least = open.map(|integrator| stability::stable_substeps(integrator, step_s, sheet)).min();
    least.unwrap_or_else(|| stability::substeps(asked, step_s, sheet))
}

/// The fewest substeps that a scene can do with, or those that it gives, and the time that a step of the cheapest kind
/// takes with them while all of the sheet moves, s.
#[allow(clippy::cast_precision_loss)]
pub fn least_step(scene: &Scene) -> (u32, f64) {
    let Stepping { integrator, substeps, precision, rate_hz, lanes, .. } = scene.stepping;
    let least = || least_substeps(integrator, rate_hz.recip(), &Oscillator::of(scene));
    let substeps = substeps.unwrap_or_else(least);
    let point_ns = point_substep_ns(scene, integrator, precision, super::lanes::available(lanes).unwrap_or(lanes));
    let points = scene.shape().point_count();
    (substeps, 1e-9 * (STEP_NS + point_ns * points as f64 * f64::from(substeps)))
}

/// Every integrator that the scene leaves open, each with the cheapest that keeps to the tolerance.
pub fn candidates(scene: &Scene, limits: &Limits) -> Vec<Choice> {
    let chooser = Chooser::new(scene, limits, &NEVER);
    chooser.integrators().filter_map(|integrator| chooser.cheapest(std::iter::once(integrator))).collect()
}

/// The cheapest that keeps to the tolerance, of what the scene leaves open; if nothing does, what misses it least. Also
/// returns the work: points × substeps of rehearsals.
///
/// # Errors
/// Refuses a scene for which that would take more work than the limits allow, and when `stop` is set.
pub fn choose(scene: &Scene, limits: &Limits, stop: &AtomicBool) -> Result<(Choice, u64)> {
    let chooser = Chooser::new(scene, limits, stop);
    let choice = chooser.cheapest(chooser.integrators()).unwrap_or_else(|| chooser.yardstick());
    chooser.check_work(limits).map(|()| (choice, limits.rehearsal_work - chooser.rehearsal.left()))
}

impl Chooser<'_> {
    /// The cheapest of some integrators.
    fn cheapest(&self, integrators: impl Iterator<Item = Integrator> + Clone) -> Option<Choice> {
        let (mut best, mut nearest) = (None::<(f64, Choice)>, None::<Choice>);
        for (format, format_cost) in FORMATS {
            for integrator in integrators.clone() {
                if !self.formats(integrator).any(|(open, _)| open == format) {
                    continue;
                }
                let cost = entry(integrator).cost * format_cost;
                #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
                let most = best.as_ref().map_or(self.most_substeps, |(least, _)| (least / cost - 1e-9).floor() as u32);
                let Some(Fewest { choice, rounding }) = self.fewest(integrator, format, most.min(self.most_substeps))
                else {
                    continue;
                };
                if self.keeps(&choice) {
                    let cost = cost * f64::from(choice.substeps);
                    if best.as_ref().is_none_or(|(least, _)| cost < *least) {
                        best = Some((cost, choice));
                    }
                } else if nearest.is_none_or(|nearest| choice.expected_error < nearest.expected_error) {
                    nearest = Some(choice);
                }
                // Rounding is the format's, whatever the integrator.
                if rounding {
                    break;
                }
            }
        }
        best.map(|(_, choice)| choice).or(nearest)
    }
}

#[cfg(test)]
mod tests;
