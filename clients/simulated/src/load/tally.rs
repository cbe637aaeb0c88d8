//! Counts of a load test, and their summary.

use std::collections::BTreeMap;

use hdrhistogram::Histogram;
use serde_json::{Value, json};

/// Largest duration that the histograms resolve, ns.
const LONGEST_NS: u64 = 60_000_000_000;

/// Counts of all clients of one thread.
pub(crate) struct Tally {
    /// Times from each command to the first sample that acknowledges it.
    pub(crate) round_trip_ns: Histogram<u64>,
    /// Times between two samples of a client.
    pub(crate) sample_gap_ns: Histogram<u64>,
    /// Age of a frame against the sample of its step, or if there is none, against the least delayed frame.
    pub(crate) frame_age_ns: Histogram<u64>,
    pub(crate) samples: u64,
    pub(crate) frames: u64,
    pub(crate) commands: u64,
    /// Ticks at which this generator was too late to send.
    pub(crate) unsent: u64,
    /// Commands that were never acknowledged.
    pub(crate) lost_commands: u64,
    /// Samples that the server dropped because a client read too slowly.
    pub(crate) lost_samples: u64,
    /// Refused commands by reason.
    pub(crate) rejected: BTreeMap<String, u64>,
    /// Sum of the awake points of all samples.
    pub(crate) awake_points: u64,
    /// Smallest dilation of all sessions.
    pub(crate) dilation_min: f64,
    /// Smallest dilation of a session within a second.
    pub(crate) dilation_s_min: f64,
    /// Users that arrived, and those that left after they had started.
    pub(crate) arrived: u64,
    pub(crate) left: u64,
    /// Times from the arrival of a user until its streams are open.
    pub(crate) start_ns: Histogram<u64>,
    /// Users that could not start, by reason.
    pub(crate) turned_away: BTreeMap<String, u64>,
    /// Number of streams that broke.
    pub(crate) broken: u64,
    /// Reason why the first of them broke.
    pub(crate) first_break: Option<String>,
}

impl Tally {
    #[allow(clippy::expect_used)]
    pub(crate) fn new() -> Self {
        let histogram = || Histogram::new_with_bounds(1, LONGEST_NS, 3).expect("bounds and digits are constants");
        Tally {
            round_trip_ns: histogram(),
            sample_gap_ns: histogram(),
            frame_age_ns: histogram(),
            samples: 0,
            frames: 0,
            commands: 0,
            unsent: 0,
            lost_commands: 0,
            lost_samples: 0,
            rejected: BTreeMap::new(),
            awake_points: 0,
            dilation_min: f64::INFINITY,
            dilation_s_min: f64::INFINITY,
            arrived: 0,
            left: 0,
            start_ns: histogram(),
            turned_away: BTreeMap::new(),
            broken: 0,
            first_break: None,
        }
    }

    pub(crate) fn add(&mut self, other: &Tally) {
        for (all, one) in [
            (&mut self.round_trip_ns, &other.round_trip_ns),
            (&mut self.sample_gap_ns, &other.sample_gap_ns),
            (&mut self.frame_age_ns, &other.frame_age_ns),
            (&mut self.start_ns, &other.start_ns),
        ] {
            // Can't fail: both have the same bounds.
            let _ = all.add(one);
        }
        self.samples += other.samples;
        self.frames += other.frames;
        self.commands += other.commands;
        self.unsent += other.unsent;
        self.lost_commands += other.lost_commands;
        self.lost_samples += other.lost_samples;
        for (reason, count) in &other.rejected {
            *self.rejected.entry(reason.clone()).or_default() += count;
        }
        self.awake_points += other.awake_points;
        self.dilation_min = self.dilation_min.min(other.dilation_min);
        self.dilation_s_min = self.dilation_s_min.min(other.dilation_s_min);
        self.arrived += other.arrived;
        self.left += other.left;
        for (reason, count) in &other.turned_away {
            *self.turned_away.entry(reason.clone()).or_default() += count;
        }
        self.broken += other.broken;
        self.first_break = self.first_break.take().or_else(|| other.first_break.clone());
    }

    pub(crate) fn broke(&mut self, why: String) {
        self.broken += 1;
        self.first_break.get_or_insert(why);
    }

    /// Returns the summary of the counts.
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn outcome(&self, sessions: u64) -> LoadOutcome {
        LoadOutcome {
            sessions,
            samples: self.samples,
            frames: self.frames,
            commands: self.commands,
            unsent: self.unsent,
            lost: self.lost_commands + self.lost_samples,
            lost_commands: self.lost_commands,
            lost_samples: self.lost_samples,
            rejected: self.rejected.values().sum(),
            reasons: self.rejected.clone(),
            broken: self.broken,
            awake_points_mean: self.awake_points as f64 / self.samples as f64,
            dilation_min: if self.dilation_min.is_finite() { self.dilation_min } else { f64::NAN },
            round_trip_us: Quantiles::of(&self.round_trip_ns),
            sample_gap_us: Quantiles::of(&self.sample_gap_ns),
            frame_age_us: Quantiles::of(&self.frame_age_ns),
            start_us: Quantiles::of(&self.start_ns),
            turned_away: self.turned_away.values().sum(),
            first_break: self.first_break.clone(),
            generator_cores: f64::NAN,
        }
    }
}

/// Quantiles of a distribution, µs; NaN if nothing was measured.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Quantiles {
    pub(crate) p50: f64,
    pub(crate) p99: f64,
    pub(crate) p999: f64,
    pub(crate) max: f64,
}

impl Quantiles {
    #[allow(clippy::cast_precision_loss)]
    fn of(histogram: &Histogram<u64>) -> Self {
        let us = |ns: u64| if histogram.is_empty() { f64::NAN } else { ns as f64 / 1e3 };
        let at = |quantile| us(histogram.value_at_quantile(quantile));
        Quantiles { p50: at(0.5), p99: at(0.99), p999: at(0.999), max: us(histogram.max()) }
    }

    pub(crate) fn json(self) -> Value {
        json!({ "p50": self.p50, "p99": self.p99, "p999": self.p999, "max": self.max })
    }

    pub(crate) fn text(self) -> String {
        if self.p50.is_nan() {
            return "–".to_owned();
        }
        format!("{:.0} / {:.0} / {:.0} / {:.0} µs", self.p50, self.p99, self.p999, self.max)
    }
}

/// Returns counts by reason, as a text.
pub(crate) fn listed(reasons: &BTreeMap<String, u64>) -> String {
    reasons.iter().map(|(reason, count)| format!("{reason} {count}")).collect::<Vec<_>>().join(", ")
}

/// Summary of one load test, or of a phase or second of it: counts, and quantiles of durations.
#[derive(Debug, Clone)]
pub struct LoadOutcome {
    pub(crate) sessions: u64,
    /// Number of samples that clients received.
    pub samples: u64,
    pub(crate) frames: u64,
    /// Number of commands that clients sent.
    pub commands: u64,
    /// Number of commands that were not sent because this generator was too late at their tick.
    pub unsent: u64,
    pub(crate) lost: u64,
    pub(crate) lost_commands: u64,
    pub(crate) lost_samples: u64,
    pub(crate) rejected: u64,
    pub(crate) reasons: BTreeMap<String, u64>,
    /// Number of streams that broke.
    pub broken: u64,
    pub(crate) awake_points_mean: f64,
    pub(crate) dilation_min: f64,
    pub(crate) round_trip_us: Quantiles,
    pub(crate) sample_gap_us: Quantiles,
    pub(crate) frame_age_us: Quantiles,
    pub(crate) start_us: Quantiles,
    pub(crate) turned_away: u64,
    /// Reason why the first stream broke, or, if none did, why the first user was turned away; `None` if neither
    /// happened.
    pub first_break: Option<String>,
    /// Processor time of this generator per second, cores.
    pub(crate) generator_cores: f64,
}

impl LoadOutcome {
    /// Returns the summary as one JSON object; durations are in µs, and values that were not measured are `null`.
    /// `limit_sessions`, the largest number of sessions that a search has found, is added if present.
    pub fn json(&self, limit_sessions: Option<u32>) -> Value {
        let mut object = json!({
            "sessions": self.sessions,
            "samples": self.samples,
            "frames": self.frames,
            "commands": self.commands,
            "unsent": self.unsent,
            "lost": self.lost,
            "lost_commands": self.lost_commands,
            "lost_samples": self.lost_samples,
            "rejected": self.rejected,
            "rejected_by_reason": self.reasons,
            "broken_streams": self.broken,
            "awake_points_mean": self.awake_points_mean,
            "dilation_min": self.dilation_min,
            "round_trip_us": self.round_trip_us.json(),
            "sample_gap_us": self.sample_gap_us.json(),
            "frame_age_us": self.frame_age_us.json(),
            "generator_cores": self.generator_cores,
        });
        if let (Some(limit), Some(object)) = (limit_sessions, object.as_object_mut()) {
            object.insert("limit_sessions".to_owned(), json!(limit));
        }
        object
    }

    /// Returns the summary as a table for a terminal, a line for each quantity; the first is `limit_sessions`, the
    /// largest number of sessions that a search has found, if present.
    pub fn table(&self, limit_sessions: Option<u32>) -> String {
        let mut rows = vec![
            ("sessions", self.sessions.to_string()),
            (
                "commands",
                format!("{} sent, {} lost, {} not sent in time", self.commands, self.lost_commands, self.unsent),
            ),
            ("rejected", format!("{} {}", self.rejected, listed(&self.reasons)).trim_end().to_owned()),
            ("samples", format!("{}, {} lost", self.samples, self.lost_samples)),
            ("frames", self.frames.to_string()),
            ("awake points, mean", format!("{:.1}", self.awake_points_mean)),
            ("dilation, least", format!("{:.5}", self.dilation_min)),
            ("                            p50 / p99 / p99.9 / max", String::new()),
            ("round trip", self.round_trip_us.text()),
            ("between samples", self.sample_gap_us.text()),
            ("age of frames", self.frame_age_us.text()),
            ("this generator took", format!("{:.2} cores", self.generator_cores)),
        ];
        if let Some(limit) = limit_sessions {
            rows.insert(0, ("limit", format!("{limit} sessions")));
        }
        rows.into_iter().map(|(name, value)| format!("{name:<28}{value}").trim_end().to_owned() + "\n").collect()
    }
}
