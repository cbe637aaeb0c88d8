//! The records of `palpate run` and of a replay: JSON Lines, one schema.

use glam::DVec3;
use serde::Serialize;

use crate::sheet::{Energy, PointState};

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
#[derive(Debug, Clone, Serialize)]
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

impl From<Energy> for EnergyJ {
    fn from(energy: Energy) -> Self {
        EnergyJ { kinetic: energy.kinetic_j, spring: energy.spring_j, virtual_springs: energy.virtual_j }
    }
}

impl Point {
    /// The record of a point.
    pub fn new(point: [usize; 2], state: &PointState) -> Self {
        // −0 reads badly.
        let array = |v: DVec3| (v + DVec3::ZERO).to_array();
        Point {
            point,
            displacement_m: array(state.displacement_m),
            velocity_m_per_s: array(state.velocity_m_per_s),
            spring_n: array(state.spring_n),
            virtual_n: array(state.virtual_n),
            damping_n: array(state.damping_n),
            applied_n: array(state.applied_n),
            reaction_n: array(state.reaction_n()),
            constraint_n: state.constraint_n.map(array),
        }
    }
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
    /// What a replay measured besides.
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    pub network: Option<Network>,
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
    /// Least simulated over real time of any second.
    pub time_dilation: f64,
    /// From a heartbeat's departure to its sample's arrival.
    pub round_trip_us: Option<Percentiles>,
}

/// Of a distribution.
#[derive(Debug, Clone, Serialize)]
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
