//! Measurements of a replay: delays, samples, the largest displacement and force.

use hdrhistogram::Histogram;
use palpate_proto::geometry::from_vector;
use palpate_proto::pb;
use palpate_tissue::scene::plot::Curves;
use palpate_tissue::scene::record::{Percentiles, Record};
use palpate_tissue::scene::script::Script;

use crate::ClientFailure;

/// Measurements of a replay.
pub(super) struct Measured<'s> {
    script: &'s Script,
    pub(super) round_trip_ns: Histogram<u64>,
    pub(super) hold_ns: Histogram<u64>,
    pub(super) overruns: u64,
    pub(super) samples: u64,
    /// Awake points in the last sample.
    pub(super) awake_points: u64,
    /// Points × steps that were computed: a sample counts for the steps since the one before, unless all points slept.
    pub(super) computed: u64,
    pub(super) late: u64,
    pub(super) rejected: u64,
    /// Number of times that the tissue was put back to an earlier state.
    pub(super) recovery_count: u64,
    pub(super) largest_displacement_m: f64,
    pub(super) peak_reaction_n: f64,
    /// Step and server time, ns, of the first sample and of the last.
    pub(super) first: Option<(u64, u64)>,
    pub(super) last: (u64, u64),
    /// Curves of the first tool with a tip, or of the first tool.
    pub(super) curves: Curves,
}

impl<'s> Measured<'s> {
    pub(super) fn new(script: &'s Script) -> Result<Self, ClientFailure> {
        let histogram = || Histogram::new(3).map_err(|e| ClientFailure::Failed(e.to_string()));
        Ok(Measured {
            script,
            round_trip_ns: histogram()?,
            hold_ns: histogram()?,
            overruns: 0,
            samples: 0,
            awake_points: 0,
            computed: 0,
            late: 0,
            rejected: 0,
            recovery_count: 0,
            largest_displacement_m: 0.0,
            peak_reaction_n: 0.0,
            first: None,
            last: (0, 0),
            curves: Curves::of(&*script.shape),
        })
    }

    pub(super) fn sample(&mut self, sample: &pb::Sample, every: u32) {
        self.overruns = sample.overrun_count;
        self.samples += 1;
        let steps = sample.step.saturating_sub(self.last.0);
        let awake_steps = if self.awake_points == 0 { steps.min(u64::from(every)) } else { steps };
        self.awake_points = u64::from(sample.awake_points);
        self.computed += self.awake_points * awake_steps;
        self.late = sample.late_commands;
        self.recovery_count = sample.recovery_count;
        self.last = (sample.step, sample.server_time_ns);
        self.first.get_or_insert(self.last);
        let plotted = self.script.first_tip().unwrap_or(0);
        // A tool whose tip was removed has a point without contact.
        let mut poses = self.script.poses.iter();
        let is_there = poses.next().is_none_or(|profile| profile.at(sample.simulation_time_s).is_some());
        for tool in &sample.tools {
            let displacement_m = from_vector(tool.displacement_m.as_ref());
            let reaction_n = from_vector(tool.force_on_tool_n.as_ref());
            self.largest_displacement_m = self.largest_displacement_m.max(displacement_m.length());
            let has_touched = tool.point.is_some() || tool.vertex.is_some();
            if tool.tool as usize == plotted && is_there && has_touched {
                self.curves.add(sample.simulation_time_s, displacement_m, reaction_n);
            }
        }
    }

    pub(super) fn record(&mut self, record: &Record) {
        self.peak_reaction_n = self.peak_reaction_n.max(record.peak_n(!self.script.poses.is_empty()));
        for point in &record.points {
            let displacement_m = point.displacement_m.iter().map(|v| v * v).sum::<f64>().sqrt();
            self.largest_displacement_m = self.largest_displacement_m.max(displacement_m);
        }
    }

    #[allow(clippy::cast_precision_loss)]
    pub(super) fn dilation(&self, rate_hz: f64) -> f64 {
        let (first, last) = (self.first.unwrap_or(self.last), self.last);
        let real_s = last.1.saturating_sub(first.1) as f64 * 1e-9;
        if real_s > 0.0 { (last.0 - first.0) as f64 / rate_hz / real_s } else { 1.0 }
    }
}

/// Returns quantiles in µs of a distribution in ns.
#[allow(clippy::cast_precision_loss)]
pub(super) fn percentiles_us(histogram: &Histogram<u64>) -> Percentiles {
    let us = |ns: u64| ns as f64 / 1e3;
    Percentiles {
        p50: us(histogram.value_at_quantile(0.5)),
        p99: us(histogram.value_at_quantile(0.99)),
        max: us(histogram.max()),
    }
}
