//! The records of `palpate run` and of a replay: JSON Lines, one schema.

use std::io::Write;

use serde::Serialize;

use super::{Integrator, Named, Precision};

/// The first line.
#[derive(Debug, Clone, Serialize)]
pub struct Run {
    /// Name of the scene.
    pub scene: String,
    /// Name of the script.
    pub script: String,
    /// What `auto` became.
    pub integrator: String,
    /// Substeps a step.
    pub substeps: u32,
    /// What `auto` became.
    pub precision: String,
    /// Steps a second.
    pub rate_hz: f64,
    /// Of Palpate.
    pub version: String,
}

/// A line a sample time. Forces are those on the tissue point, N.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Record {
    /// Simulated time.
    pub time_s: f64,
    /// In the order asked for.
    pub points: Vec<Point>,
    /// Of the whole sheet.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub energy_j: Option<EnergyJ>,
    /// Points computed in the step.
    pub awake_points: usize,
}

/// One mass point.
#[derive(Debug, Clone, Serialize)]
#[allow(missing_docs)]
pub struct Point {
    pub point: [usize; 2],
    pub displacement_m: [f64; 3],
    pub velocity_m_per_s: [f64; 3],
    pub spring_n: [f64; 3],
    pub virtual_n: [f64; 3],
    pub damping_n: [f64; 3],
    pub applied_n: [f64; 3],
    /// spring + virtual + damping.
    pub reaction_n: [f64; 3],
    /// Of a prescribed point: what holds it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub constraint_n: Option<[f64; 3]>,
}

/// Energies, J.
#[derive(Debug, Clone, Copy, Serialize)]
#[allow(missing_docs)]
pub struct EnergyJ {
    pub kinetic: f64,
    pub spring: f64,
    #[serde(rename = "virtual")]
    pub virtual_springs: f64,
}

/// The last line.
#[derive(Debug, Clone, Serialize)]
pub struct Summary {
    /// Steps done.
    pub steps: u64,
    /// Substeps done.
    pub substeps: u64,
    /// Points of the sheet.
    pub points: usize,
    /// The stepping alone.
    pub wall_s: f64,
    /// `wall_s` over `substeps`·`points`.
    pub ns_per_point_substep: f64,
    /// Computed over all point-substeps.
    pub computed_fraction: f64,
    /// How often the guard acted.
    pub guard_events: u64,
    /// XXH3-128 of the state, in hexadecimal.
    pub final_hash: String,
    /// What an audit measured: of all sample points and times.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub audited_error: Option<AuditedError>,
    /// What an audit changed, by rising steps.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub corrections: Vec<Correction>,
    /// What a replay measured besides.
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    pub network: Option<Network>,
}

/// An error that was measured, each part relative to the largest component of its kind.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct AuditedError {
    /// Largest difference of any component of a displacement.
    pub displacement: f64,
    /// The same of the tissue's force on a tool: springs, virtual springs and damping.
    pub force: f64,
}

impl AuditedError {
    /// The larger of the two.
    pub fn largest(&self) -> f64 {
        self.displacement.max(self.force)
    }

    /// The larger of each part.
    pub fn max(self, other: Self) -> Self {
        AuditedError { displacement: self.displacement.max(other.displacement), force: self.force.max(other.force) }
    }
}

/// A tissue is stepped more accurately from a step on, because an audited error was above the tolerance.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Correction {
    /// The step at whose beginning it acts.
    pub step: u64,
    /// The error that was found.
    pub audited_error: AuditedError,
    /// Where most of it came from.
    pub reason: String,
    /// Scheme from then on.
    #[serde(serialize_with = "name")]
    pub integrator: Integrator,
    /// Substeps from then on.
    pub substeps: u32,
    /// Number format from then on.
    #[serde(serialize_with = "name")]
    pub precision: Precision,
    /// What regions at rest may cost from then on.
    pub sleep_tolerance: f64,
}

fn name<S: serde::Serializer>(value: &impl Named, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(value.name())
}

/// What a replay through a server measured.
#[derive(Debug, Clone, Serialize)]
pub struct Network {
    /// Commands that came after their step.
    pub late_commands: u64,
    /// Commands that the server refused.
    pub rejected_commands: u64,
    /// Steps that the server dropped.
    pub overruns: u64,
    /// Simulated over real time, from the first sample to the last.
    pub time_dilation: f64,
    /// From a message's departure to its answer, which does not wait for a step.
    pub round_trip_us: Percentiles,
    /// Time the server had that message.
    pub server_hold_us: Percentiles,
}

/// Of a distribution.
#[derive(Debug, Clone, Copy, Default, Serialize)]
#[allow(missing_docs)]
pub struct Percentiles {
    pub p50: f64,
    pub p99: f64,
    pub max: f64,
}

/// `{"run": …}` and `{"summary": …}`.
#[derive(Debug, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Line<'a> {
    /// The first.
    Run(&'a Run),
    /// The last.
    Summary(&'a Summary),
}

/// One JSON object, one line.
pub fn write_line(output: &mut dyn Write, line: &impl Serialize) -> std::io::Result<()> {
    serde_json::to_writer(&mut *output, line)?;
    output.write_all(b"\n")
}
