//! The records of `palpate run` and of a replay, as JSON Lines with one schema.

use std::io::{BufWriter, IsTerminal, Write};
use std::path::Path;

use serde::Serialize;

use super::plot::Curves;
use super::{Integrator, Named, Precision};
use crate::shape::{PointName, RestShape};
use palpate_refusal::printable::printable_json;
use palpate_refusal::{Reason, Refusal};

/// The first line of a file of records, `{"run": …}`: what was run, and how.
#[derive(Debug, Clone, Serialize)]
pub struct Run {
    /// Display name of the scene.
    pub scene: String,
    /// Display name of the script.
    pub script: String,
    /// Name of the integrator used at the beginning; with `auto`, the one that was selected.
    pub integrator: String,
    /// Substeps per step at the beginning.
    pub substeps: u32,
    /// Name of the number format used at the beginning; with `auto`, the one that was selected.
    pub precision: String,
    /// Steps per second, Hz.
    pub rate_hz: f64,
    /// Version of Palpate that made the records.
    pub version: String,
}

/// The state at one sample time, on one line. Forces on points are those on the tissue, N. Vectors are [x, y,
/// z] in the tissue's frame.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Record {
    /// Simulated time, s, since the beginning of step 0.
    pub time_s: f64,
    /// The points, in the order requested; empty if none were.
    pub points: Vec<Point>,
    /// The tools with a tip that are at the tissue, by ascending number; not written if there are none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub tools: Vec<ToolRecord>,
    /// The script's instruments that are there, by ascending number; not written if there are none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub instruments: Vec<InstrumentRecord>,
    /// Energies of the whole tissue, J; `None` if they were not requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub energy_j: Option<EnergyJ>,
    /// Points computed in this step; sleeping points are not counted.
    pub awake_points: usize,
}

impl Record {
    /// Returns the displacement, m, and the force of the tissue, N, of the tool whose number is `tip`
    /// ([`Script::first_tip`](super::script::Script::first_tip)); `None` while that tool is away. If `tip` is
    /// `None`, returns displacement and reaction of the first point; `None` without points.
    pub fn first(&self, tip: Option<usize>) -> Option<([f64; 3], [f64; 3])> {
        let Some(tip) = tip else {
            return self.points.first().map(|point| (point.displacement_m, point.reaction_n));
        };
        let tool = self.tools.iter().find(|tool| tool.tool as usize == tip);
        tool.map(|tool| (tool.displacement_m, tool.force_on_tool_n))
    }

    /// Returns the largest force of the tissue on a tool with a tip, N (its length); 0 while all are away. If
    /// `has_tips` is false, the reactions at the points count too.
    pub fn peak_n(&self, has_tips: bool) -> f64 {
        let length = |v: [f64; 3]| v.iter().map(|c| c * c).sum::<f64>().sqrt();
        let tools = self.tools.iter().map(|tool| length(tool.force_on_tool_n));
        let points = self.points.iter().filter(|_| !has_tips).map(|point| length(point.reaction_n));
        tools.chain(points).fold(0.0, f64::max)
    }
}

/// The state of one mass point at the end of a step: displacement, velocity, and the forces on it, as [x, y, z]
/// in the tissue's frame.
#[derive(Debug, Clone, Serialize)]
pub struct Point {
    /// The name of the point: `"point": [i, j]` on a sheet, `"vertex": n` on a mesh.
    #[serde(flatten)]
    pub name: PointName,
    /// Displacement from rest, m.
    pub displacement_m: [f64; 3],
    /// Velocity, m/s.
    pub velocity_m_per_s: [f64; 3],
    /// Force of all springs between points, and of an enclosed volume's pressure, N.
    pub spring_n: [f64; 3],
    /// Force of the anchor spring, −K″·u, N.
    pub anchor_n: [f64; 3],
    /// Damping force, −C·v, N.
    pub damping_n: [f64; 3],
    /// Force of all pushing tools, N.
    pub applied_n: [f64; 3],
    /// Force of the tissue on a tool at the point, N: the sum of the forces of springs, anchor spring and
    /// damping.
    pub reaction_n: [f64; 3],
    /// The force that holds a prescribed (grasped) point, N; `None`, and not written, for other points.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub constraint_n: Option<[f64; 3]>,
}

/// The state of a tool with a tip, which a client moves by poses. Vectors are [x, y, z] in the tissue's frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ToolRecord {
    /// The tool's number: a script numbers its forces first, then its grasped points, then its tools with a
    /// tip.
    pub tool: u32,
    /// Place of the tip in the frame of the tissue at rest, m.
    pub place_m: [f64; 3],
    /// Displacement of the tissue under the tip, averaged over the tip's disc, m.
    pub displacement_m: [f64; 3],
    /// Force of the tissue on the tool, N, as a haptic device receives it. 0 while the tip does not touch.
    pub force_on_tool_n: [f64; 3],
}

/// The state of an instrument, whose tips are tools. Vectors are [x, y, z] in the tissue's frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct InstrumentRecord {
    /// The instrument's number in the script, from 0.
    pub instrument: u32,
    /// Place of its origin in the frame of the tissue at rest, m.
    pub place_m: [f64; 3],
    /// Turns vectors of the instrument's frame into the tissue's, as [w, x, y, z].
    pub orientation: [f64; 4],
    /// Force of the tissue on it, N: the sum over its tips.
    pub force_on_tool_n: [f64; 3],
    /// Torque of the tissue on it about `place_m`, N·m. The force of a tip acts at the tip's place.
    pub torque_on_tool_n_m: [f64; 3],
    /// The angle between its jaws, rad; `None`, and not written, without jaws.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub jaw_rad: Option<f64>,
    /// Torque with which the tissue opens the jaws, N·m ([`Instrument::opening_n_m`](palpate_haptics::Instrument::opening_n_m));
    /// `None`, and not written, without jaws.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub opening_n_m: Option<f64>,
    /// What its port and the hand that holds it exert; not written without a port.
    #[serde(flatten)]
    pub in_port: Option<PortRecord>,
    /// The other instruments with which it overlaps; not written if there are none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub contacts: Vec<ContactRecord>,
}

/// An overlap of an instrument with another ([`palpate_haptics::instrument_contact`]). Vectors are [x, y, z] in the tissue's frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ContactRecord {
    /// The number of the other instrument in the script.
    pub with_instrument: u32,
    /// How far they overlap at most, m.
    pub depth_m: f64,
    /// Force of the other on this one, N.
    pub force_n: [f64; 3],
    /// Its torque about `place_m` of this one, N·m.
    pub torque_n_m: [f64; 3],
}

/// What acts on an instrument in a port, so that it is in balance ([`palpate_haptics::port`]). Vectors are [x, y, z] in the tissue's
/// frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PortRecord {
    /// Force of the port on the instrument, N; across its shaft.
    pub force_of_port_n: [f64; 3],
    /// Force of the instrument on the hand at its handle, N.
    pub force_on_hand_n: [f64; 3],
    /// Torque of the instrument on the hand about its handle, N·m; along its shaft.
    pub torque_on_hand_n_m: [f64; 3],
}

/// Energies of the whole tissue, J, at the end of a step.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct EnergyJ {
    /// Σ ½m·v² of the points.
    pub kinetic: f64,
    /// Energy stored in the springs between points, and in an enclosed volume.
    pub spring: f64,
    /// Energy stored in the anchor springs, which pull each point to its rest position. Records call it
    /// `virtual`.
    #[serde(rename = "virtual")]
    pub anchor_springs: f64,
}

/// The last line of a file of records, `{"summary": …}`: counts, speed and accuracy of the run. Some fields are
/// only for display and not written.
#[derive(Debug, Clone, Serialize)]
pub struct Summary {
    /// Steps done.
    pub steps: u64,
    /// Substeps done, those that the guard repeated included.
    pub substeps: u64,
    /// Points of the tissue.
    pub points: usize,
    /// Wall time spent on stepping alone, s.
    pub wall_s: f64,
    /// `wall_s`/(`substeps`·`points`), ns.
    pub ns_per_point_substep: f64,
    /// Fraction, 0 to 1, of all point-substeps that were computed; the rest slept.
    pub computed_fraction: f64,
    /// How many times the guard went back and repeated with a shorter substep, or brought a solid that rested
    /// inside out to its shape.
    pub guard_events: u64,
    /// How blades have changed what joins the points; `None`, and not written, for a replay.
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    pub topology: Option<TopologyRecord>,
    /// What the threads and clips bore, in the order of the script; not written if it has none. Of a replay always empty.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub ties: Vec<TieRecord>,
    /// XXH3-128 hash of the final state (`Tissue::state_hash`), 32 hexadecimal
    /// digits.
    pub final_hash: String,
    /// The errors that an audit measured, over all sample points and times; `None`, and not written, without an
    /// audit.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub audited_error: Option<AuditedError>,
    /// How much the size of the cells of a solid adds to its stiffness under the first tip, as a fraction of it (an
    /// estimate); `None`, and not written, for other tissues.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mesh_error_estimate: Option<f64>,
    /// Corrections after an audit, by ascending step; not written if there are none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub corrections: Vec<Correction>,
    /// The newest recoveries, by ascending step; not written if there were none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub recoveries: Vec<Recovery>,
    /// When jaws exceeded their limit of torque, by ascending step: the first [`MAX_JAW_OVERLOADS`]; not written if they never did. Of
    /// a replay always empty.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub jaw_overloads: Vec<JawOverload>,
    /// Warnings for the user. Not written.
    #[serde(skip)]
    pub warnings: Vec<String>,
    /// Length of the largest displacement, m. For a run: of all points at the times of the records; for a
    /// replay: in what the server sent. Not written.
    #[serde(skip)]
    pub largest_displacement_m: f64,
    /// The largest force of the tissue in the records, N ([`Record::peak_n`]). Not written.
    #[serde(skip)]
    pub peak_reaction_n: f64,
    /// Displacement and force of the first tool or point over time ([`Record::first`]). Not written.
    #[serde(skip)]
    pub curves: Curves,
    /// The time of each stage of a step, summed over the run; not written unless it was measured.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub stages: Vec<StageTime>,
    /// The additional measurements of a replay; `None` for a run.
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    pub network: Option<Network>,
}

/// How blades have changed what joins the points of a tissue, at the end of a run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TopologyRecord {
    /// Version of the topology: 0 if nothing was severed ([`Cuts::version`](crate::Cuts::version)).
    pub topology_version: u32,
    /// Number of severed springs, anchor springs included.
    pub severed: usize,
    /// How many of them are anchor springs; not written if there are none.
    #[serde(skip_serializing_if = "is_none")]
    pub severed_anchors: usize,
    /// Number of parts of the tissue; 1 for one that is whole.
    pub pieces: usize,
    /// Energy that has gone into separation, J ([`Cuts::fracture_j`](crate::Cuts::fracture_j)).
    pub fracture_j: f64,
}

#[allow(clippy::trivially_copy_pass_by_ref)]
fn is_none(count: &usize) -> bool {
    *count == 0
}

/// What a thread or clip bore in a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TieRecord {
    /// Its name in the script; empty without.
    pub name: String,
    /// The largest tension between two of its bites in any step, N.
    pub peak_tension_n: f64,
    /// Length of the thread at the end, m, without its stretch; of a clip how far it is from being closed.
    pub length_m: f64,
    /// Sum of the distances between its successive bites just after it was laid, m.
    pub path_when_laid_m: f64,
    /// That sum at the end, or just before it was cut.
    pub path_m: f64,
    /// Whether it broke.
    pub is_broken: bool,
}

/// Largest number of [`Summary::jaw_overloads`].
pub const MAX_JAW_OVERLOADS: usize = 100;

/// The jaws of an instrument crush what they hold: the torque between them exceeds the script's limit
/// ([`JawTorqueMonitor`](palpate_haptics::JawTorqueMonitor)).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct JawOverload {
    /// The number of steps at whose end it did.
    pub step: u64,
    /// The instrument's number in the script, from 0.
    pub instrument: u32,
    /// The tool of its first tip.
    pub first_tool: u32,
    /// The torque with which the tissue opens the jaws, N·m.
    pub torque_n_m: f64,
    /// The limit, N·m.
    pub limit_n_m: f64,
}

/// The time that a stage of the steps has taken.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StageTime {
    /// The stage: `sleep` (which tiles wake and sleep), `pressure` (of a volume), `force` (force-controlled tools),
    /// `sweep` (the springs), `grasp`, `contact` (position-controlled tools), or `guard` (checks and checkpoints).
    pub stage: &'static str,
    /// Its time, s.
    pub time_s: f64,
}

impl Summary {
    /// Returns a message if the records are not those of the script, because the guard released the tools:
    /// about the first of `recoveries`. `None` if there is none.
    pub fn fault(&self) -> Option<String> {
        let Recovery { step, reason, .. } = self.recoveries.first()?;
        Some(format!(
            "the guard released all tools after step {step}, because {reason}: from there on the run differs from the script"
        ))
    }
}

/// Returns a warning if a point moved by more than the tissue's longest side: then a unit is probably wrong.
/// `largest_m` is the largest displacement of the run, m. Otherwise `None`.
pub fn far_warning(largest_m: f64, shape: &dyn RestShape) -> Option<String> {
    let longest_m = shape.longest_side_m();
    (largest_m > longest_m).then(|| {
        format!(
            "the largest displacement was {largest_m:.3} m, more than the tissue's longest side, {longest_m:.3} m: look at the \
             forces and the stiffness (`palpate check SCENE SCRIPT`)"
        )
    })
}

/// A measured error, of an audit. Each part is the largest difference of its quantity, relative to the largest
/// component of that quantity: without unit. `default()` is no error.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct AuditedError {
    /// Largest difference of any component of a displacement, relative to the largest such component.
    pub displacement: f64,
    /// Largest difference of any component of the tissue's force on a tool (springs, anchor springs and
    /// damping), relative to the largest such component.
    pub force: f64,
}

impl AuditedError {
    /// Returns the larger of the two errors.
    pub fn largest(&self) -> f64 {
        self.displacement.max(self.force)
    }

    /// Returns the larger displacement error and the larger force error of two measurements.
    pub fn max(self, other: Self) -> Self {
        AuditedError { displacement: self.displacement.max(other.displacement), force: self.force.max(other.force) }
    }
}

/// A correction: from this step on, the tissue is stepped more accurately, because an audited error was above
/// the tolerance. `Model::correction` makes one,
/// `Model::corrected()` applies it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Correction {
    /// The step at whose beginning it takes effect.
    pub step: u64,
    /// The measured error, above the scene's tolerance.
    pub audited_error: AuditedError,
    /// The main source of the error, in words (`Origin::describe`.
    pub reason: String,
    /// The scheme from then on; never `Auto`.
    #[serde(serialize_with = "name")]
    pub integrator: Integrator,
    /// The substeps per step from then on, at least.
    pub substeps: u32,
    /// The number format from then on; never `Auto`.
    #[serde(serialize_with = "name")]
    pub precision: Precision,
    /// The error that sleeping regions may add from then on, relative to the largest displacement; 0 turns
    /// sleep off.
    pub sleep_tolerance: f64,
}

/// A recovery by the guard. The tissue's motion was wrong, and shorter substeps did not help. The tissue went
/// back to the state of the last checkpoint, or to rest, and continued without tools.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Recovery {
    /// Steps done when the guard found the error. Time continues from there.
    pub step: u64,
    /// The step of the state that the tissue went back to, at most `step`.
    pub state_of_step: u64,
    /// Whether the tissue continued at rest, because that state had passed no check, or because there were too
    /// many recoveries.
    pub at_rest: bool,
    /// Number of commands whose effect was lost, because they took effect after the state that the tissue went
    /// back to.
    pub undone_commands: u64,
    /// After too many recoveries: until this step, commands to the tools that acted have no effect. Otherwise
    /// `None`, and not written.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub paused_until_step: Option<u64>,
    /// The check that failed, in words (`CheckFailure`.
    pub reason: String,
}

fn name<S: serde::Serializer>(value: &impl Named, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(value.name())
}

/// The measurements of a replay through a server, written among the fields of the [`Summary`].
#[derive(Debug, Clone, Serialize)]
pub struct Network {
    /// Commands that arrived after the step for which they were meant.
    pub late_commands: u64,
    /// Commands that the server refused.
    pub rejected_commands: u64,
    /// Steps that the server dropped because it could not keep its rate.
    pub overruns: u64,
    /// Simulated time divided by real time, from the first sample to the last: below 1, the server was slower
    /// than real time.
    pub time_dilation: f64,
    /// Time from sending a message to its answer, µs, the server's hold included. The answer does not wait for
    /// a step.
    pub round_trip_us: Percentiles,
    /// Time from the arrival of that message at the server to its answer, µs.
    pub server_hold_us: Percentiles,
}

/// Percentiles of a distribution, in the unit of the field that has them.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct Percentiles {
    /// The median.
    pub p50: f64,
    /// 99 % of the values are at most this.
    pub p99: f64,
    /// The largest value.
    pub max: f64,
}

/// The first or the last line of a file of records, for [`write_line`]: `{"run": …}` or `{"summary": …}`. The
/// lines between are [`Record`]s.
#[derive(Debug, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Line<'a> {
    /// The first line.
    Run(&'a Run),
    /// The last line.
    Summary(&'a Summary),
}

/// Opens the output of the records, buffered: `file` (created or overwritten), or else the standard output. If
/// the standard output is a terminal and `plots` is true, the records are discarded. Flush it at the end:
/// dropping it loses errors.
///
/// # Errors
/// Refuses a file that can't be created or opened for writing ([`Reason::Unreadable`]); [`Refusal::place`] is
/// its path.
pub fn output(file: Option<&Path>, plots: bool) -> Result<Box<dyn Write>, Refusal> {
    let Some(path) = file else {
        let out = std::io::stdout();
        return Ok(if plots && out.is_terminal() { Box::new(std::io::sink()) } else { Box::new(BufWriter::new(out)) });
    };
    let file = std::fs::File::create(path).map_err(|e| Refusal {
        place: Some(path.display().to_string()),
        ..Refusal::new(Reason::Unreadable, "", format!("can't be written: {e}"))
    })?;
    Ok(Box::new(BufWriter::new(file)))
}

/// Writes one value as a JSON object on one line, with a line feed. Characters that act on a terminal are
/// escaped.
///
/// # Errors
/// Returns the error of writing to `output`, or of a value that can't be written as JSON.
pub fn write_line(output: &mut dyn Write, line: &impl Serialize) -> std::io::Result<()> {
    let line = printable_json(serde_json::to_string(line)?);
    writeln!(output, "{line}")
}
