//! Measurements of a run: the force on the hand against the true one, the depth of the hand, and the energy at the
//! port.
//!
//! There are two references. The force is compared with that of a twin (the same tissue without a network) at the
//! tool's own place. The depth is compared with that of a second hand, which feels the tissue directly, without a
//! network.

use glam::DVec3;
use palpate_haptics::datagram_health::Carried;
use palpate_haptics::envelope::Envelope;
use palpate_haptics::{LimitCause, RenderingState};
use palpate_simulated::network::Outages;

/// Energy received by the port below which a run is unstable, J.
const UNSTABLE_J: f64 = -0.1;

/// Rendered force below which it counts as 0, N.
const MIN_FORCE_N: f64 = 1e-6;

/// Time after the end of an outage for which its effect on the force may last, s.
const RECOVERS_S: f64 = 0.05;

/// Returns how often each limit of an envelope has acted.
pub(super) fn interventions(envelope: &Envelope) -> Vec<(&'static str, u64)> {
    LimitCause::ALL.iter().map(|(reason, name)| (*name, envelope.count(*reason).0)).collect()
}

/// The outcome of a run. A tick is in contact if the twin touches or a force is rendered; figures without another
/// word are over these ticks.
#[derive(Debug, Clone, Default)]
pub(super) struct LinkOutcome {
    /// Scale of the task's depths.
    pub(super) scale: f64,
    pub(super) force_error_rms_percent: Option<f64>,
    /// The error of the force without outages: from 50 ms after the end of each, while rendering is enabled and has
    /// engaged.
    pub(super) force_error_after_outages_percent: Option<f64>,
    /// Part of the ticks in contact that this figure is over.
    pub(super) after_outages_share: Option<f64>,
    pub(super) force_error_p99_n: f64,
    /// Mean of rendered − true force along the normal, N.
    pub(super) force_bias_n: Option<f64>,
    /// Slope of the regression of the rendered force over the true one, along the normal.
    pub(super) force_gain: Option<f64>,
    /// Difference of the tool's depth from that of a hand that feels the tissue directly, m; and its root mean square
    /// as a fraction of that hand's depth.
    pub(super) depth_error_rms_m: Option<f64>,
    pub(super) depth_error_p99_m: Option<f64>,
    pub(super) depth_error_percent: Option<f64>,
    pub(super) energy_min_j: f64,
    pub(super) jump_max_n: f64,
    /// Part of the ticks in contact in which passivity acted.
    pub(super) guard_share: f64,
    pub(super) rendered_share: Option<f64>,
    pub(super) packets_per_s: f64,
    pub(super) kbit_per_s: f64,
    pub(super) commands_per_s: f64,
    /// Messages that found the queue of a link full, both ways.
    pub(super) overflowed: u64,
    pub(super) model_age_ms_p99: Option<f64>,
    pub(super) peak_ratio: Option<f64>,
    /// Ticks that were rendered from a copy of the tissue.
    pub(super) predicted_ticks: u64,
    pub(super) true_force_max_n: f64,
    pub(super) force_max_n: f64,
    pub(super) unstable_at_s: Option<f64>,
    pub(super) pauses: u64,
    pub(super) faults: u64,
    pub(super) interventions: Vec<(&'static str, u64)>,
    pub(super) path: [u64; 3],
    /// Only for a run in real time.
    pub(super) late_ticks: Option<u64>,
    /// Counts of datagrams in a run in real time.
    pub(super) carried: Option<Carried>,
    /// For each tick: time, s, the tool's depth below the rest plane, m, rendered and true force, N.
    pub(super) course: Vec<[f64; 4]>,
}

/// Values to measure in a tick. The normal is z.
pub(super) struct LinkTick {
    pub(super) now_s: f64,
    /// The tool's depth, m, and that of a hand that feels the tissue itself, where it is known.
    pub(super) depth_m: f64,
    pub(super) direct_m: Option<f64>,
    pub(super) force_n: DVec3,
    pub(super) true_n: DVec3,
    /// Whether the twin touches the tissue.
    pub(super) touches: bool,
    /// Age of the sample that the force is from, s.
    pub(super) age_s: Option<f64>,
}

/// Sums of a force and its error.
#[derive(Default)]
struct Errors {
    count: f64,
    error_squared: f64,
    true_squared: f64,
}

impl Errors {
    fn add(&mut self, tick: &LinkTick) {
        self.count += 1.0;
        self.error_squared += (tick.force_n - tick.true_n).length_squared();
        self.true_squared += tick.true_n.length_squared();
    }

    fn percent(&self) -> Option<f64> {
        part(self.error_squared, self.true_squared).map(|part| 100.0 * part.sqrt())
    }
}

/// Sums of a regression of y over x.
#[derive(Default)]
struct Regression {
    count: f64,
    mean: [f64; 2],
    /// Of squares of x, and of products, about the means.
    xx: f64,
    xy: f64,
}

impl Regression {
    /// Welford's update: no difference of large sums.
    fn add(&mut self, x: f64, y: f64) {
        self.count += 1.0;
        let (dx, dy) = (x - self.mean[0], y - self.mean[1]);
        self.mean[0] += dx / self.count;
        self.mean[1] += dy / self.count;
        self.xx += dx * (x - self.mean[0]);
        self.xy += dx * (y - self.mean[1]);
    }

    fn slope(&self) -> Option<f64> {
        part(self.xy, self.xx)
    }

    /// Mean of y − x.
    fn bias(&self) -> Option<f64> {
        (self.count > 0.0).then(|| self.mean[1] - self.mean[0])
    }
}

/// Accumulates the outcome of a run.
#[derive(Default)]
pub(super) struct Totals {
    pub(super) outcome: LinkOutcome,
    energy_j: f64,
    before: Option<DVec3>,
    force_n: DVec3,
    errors: Errors,
    settled: Errors,
    normal: Regression,
    rendered_sum: f64,
    true_sum: f64,
    errors_n: Vec<f64>,
    depth_errors_m: Vec<f64>,
    direct_squared: f64,
    pub(super) ages_s: Vec<f64>,
    /// The outages, if there are any.
    outages: Option<Outages>,
    /// Ticks in which soft engage has acted.
    engaging: u64,
}

impl Totals {
    /// Creates the measurement for a network with these outages.
    pub(super) fn with(outages: Outages) -> Self {
        Totals { outages: Some(outages), ..Totals::default() }
    }

    /// Counts the tool's movement to `place_m` under the force of the last tick. `supplied_j` is the energy that a second
    /// tool has given to a tool there through the true tissue so far: that may leave the port.
    pub(super) fn moved(&mut self, place_m: DVec3, supplied_j: f64) {
        if let Some(before_m) = self.before.replace(place_m) {
            self.energy_j -= self.force_n.dot(place_m - before_m);
            self.outcome.energy_min_j = self.outcome.energy_min_j.min(self.energy_j + supplied_j);
        }
    }

    /// Returns whether the port has given so much energy that the run is unstable.
    pub(super) fn is_unstable(&self) -> bool {
        self.energy_j < UNSTABLE_J
    }

    /// Counts a tick's rendered force against the true one; `envelope` is what it has passed.
    pub(super) fn rendered(&mut self, tick: &LinkTick, envelope: Option<&Envelope>) {
        let is_settled = self.is_settled(tick.now_s, envelope);
        let outcome = &mut self.outcome;
        outcome.jump_max_n = outcome.jump_max_n.max((tick.force_n - self.force_n).length());
        self.force_n = tick.force_n;
        let (rendered, truth) = (tick.force_n.length(), tick.true_n.length());
        outcome.force_max_n = outcome.force_max_n.max(rendered);
        outcome.true_force_max_n = outcome.true_force_max_n.max(truth);
        outcome.course.push([tick.now_s, tick.depth_m, rendered, truth]);
        self.ages_s.extend(tick.age_s);
        if !tick.touches && rendered <= MIN_FORCE_N {
            return;
        }
        self.errors.add(tick);
        if is_settled {
            self.settled.add(tick);
        }
        self.normal.add(tick.true_n.z, tick.force_n.z);
        self.rendered_sum += rendered;
        self.true_sum += truth;
        self.errors_n.push((tick.force_n - tick.true_n).length());
        if let Some(direct_m) = tick.direct_m {
            self.depth_errors_m.push((tick.depth_m - direct_m).abs());
            self.direct_squared += direct_m * direct_m;
        }
    }

    /// Whether the force is that of a connection: no outage, nor the time after one, and rendering has engaged.
    fn is_settled(&mut self, now_s: f64, envelope: Option<&Envelope>) -> bool {
        let engaging = envelope.map_or(0, |envelope| envelope.count(LimitCause::Engage).0);
        let is_engaged = std::mem::replace(&mut self.engaging, engaging) == engaging;
        let is_enabled = envelope.is_none_or(|envelope| envelope.state() == RenderingState::Enabled);
        let has_recovered = self.outages.as_mut().is_none_or(|outages| outages.since_s(now_s) >= RECOVERS_S);
        is_engaged && is_enabled && has_recovered
    }

    /// Counts the actions of the envelope in the whole run.
    pub(super) fn limited(&mut self, envelope: &Envelope) {
        let (acted, _) = envelope.count(LimitCause::Passivity);
        // Passivity acts on a force, which exists only in contact.
        self.outcome.guard_share = acted as f64 / self.errors_n.len().max(1) as f64;
        self.outcome.interventions = interventions(envelope);
    }

    /// Computes the outcome from the sums.
    pub(super) fn close(mut self) -> LinkOutcome {
        let outcome = &mut self.outcome;
        outcome.force_error_rms_percent = self.errors.percent();
        let has_outages = self.outages.as_ref().is_some_and(Outages::are_any);
        outcome.force_error_after_outages_percent = self.settled.percent().filter(|_| has_outages);
        outcome.after_outages_share = part(self.settled.count, self.errors.count).filter(|_| has_outages);
        (outcome.force_bias_n, outcome.force_gain) = (self.normal.bias(), self.normal.slope());
        outcome.rendered_share = part(self.rendered_sum, self.true_sum);
        outcome.peak_ratio = part(outcome.force_max_n, outcome.true_force_max_n);
        outcome.force_error_p99_n = percentile(&mut self.errors_n, 0.99).unwrap_or(0.0);
        let squared: f64 = self.depth_errors_m.iter().map(|error_m| error_m * error_m).sum();
        outcome.depth_error_rms_m = part(squared, self.depth_errors_m.len() as f64).map(f64::sqrt);
        outcome.depth_error_percent = part(squared, self.direct_squared).map(|part| 100.0 * part.sqrt());
        outcome.depth_error_p99_m = percentile(&mut self.depth_errors_m, 0.99);
        outcome.model_age_ms_p99 = percentile(&mut self.ages_s, 0.99).map(|age_s| 1e3 * age_s);
        self.outcome
    }
}

fn part(of: f64, whole: f64) -> Option<f64> {
    (whole > 0.0).then(|| of / whole)
}

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn percentile(values: &mut [f64], part: f64) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let place = (part * values.len() as f64).ceil() as usize;
    values.get(place.saturating_sub(1)).copied()
}

#[cfg(test)]
mod tests {
    use super::*;
    use palpate_simulated::network::Conditions;

    /// A tick in contact under a true force along the normal.
    fn tick(now_s: f64, true_n: f64, force_n: f64, apart_m: f64) -> LinkTick {
        LinkTick {
            now_s,
            depth_m: 0.01 + apart_m,
            direct_m: Some(0.01),
            force_n: force_n * DVec3::Z,
            true_n: true_n * DVec3::Z,
            touches: true,
            age_s: None,
        }
    }

    #[test]
    fn a_force_that_is_too_strong_and_off_by_a_constant_has_a_gain_and_a_bias() {
        let mut totals = Totals::default();
        for number in 0..=200_u32 {
            let true_n = 0.01 * f64::from(number);
            totals.rendered(&tick(0.0, true_n, 1.1 * true_n + 0.3, 1e-4), None);
        }
        // Ticks without touch or rendered force do not count.
        totals.rendered(&LinkTick { touches: false, ..tick(0.0, 0.0, 0.0, 1.0) }, None);
        let outcome = totals.close();
        let near = |found: Option<f64>, expected: f64| found.is_some_and(|found| (found - expected).abs() < 1e-9);
        assert!(near(outcome.force_gain, 1.1) && near(outcome.force_bias_n, 0.4), "{outcome:?}");
        assert!(near(outcome.depth_error_rms_m, 1e-4) && near(outcome.depth_error_p99_m, 1e-4), "{outcome:?}");
        assert!(near(outcome.depth_error_percent, 1.0), "{outcome:?}");
        assert_eq!(outcome.force_error_after_outages_percent, None);
    }

    #[test]
    fn an_outage_and_the_50_ms_after_it_count_in_one_figure_and_not_in_the_other() {
        let conditions = Conditions { outage_s: 0.1, ..Conditions::default() };
        let outages = || Outages::new(&conditions, 1, 0.0);
        let (mut totals, mut told) = (Totals::with(outages()), outages());
        for number in 0..10_000_u32 {
            let now_s = 1e-3 * f64::from(number);
            let is_right = told.since_s(now_s) >= 0.05;
            totals.rendered(&tick(now_s, 1.0, if is_right { 1.01 } else { 0.0 }, 0.0), None);
        }
        let outcome = totals.close();
        assert!(outcome.force_error_rms_percent.is_some_and(|percent| percent > 30.0), "{outcome:?}");
        let after = outcome.force_error_after_outages_percent;
        assert!(after.is_some_and(|percent| (percent - 1.0).abs() < 1e-9), "{after:?}");
    }
}
