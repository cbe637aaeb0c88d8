//! Snapshots: a session at one moment, as bytes, from which it continues with the bits that it would have had
//! without a stop.
//!
//! **Content**: the state of the tissue ([`tissue::saved`]), the state of each tool with its path, what
//! recoveries depend on, and counts. A snapshot has no waiting commands, no leases, no unfinished audit and no scene.
//!
//! **What a caller keeps beside it**: only the scene with which the session began. The snapshot has the result of
//! all changes and corrections of the tissue ([`Saved::tissue`]). So:
//!
//! ```text
//! let saved = Saved::from_bytes(&bytes, &limits)?;
//! let model = Model::resumed(&first_scene, saved.tissue(), &limits)?;
//! let session = Session::restore(&model, &saved)?;
//! ```
//!
//! Later changes also need that scene ([`Model::changed`] takes it as `first`). For each change, a recorder of
//! inputs must record the resulting [`SavedPlan`] and not the change: so nothing is chosen again, under limits
//! that may differ.
//!
//! **Bytes**: [`MAGIC`], the version of the format, the length of the parts, XXH3-128 of everything else (16
//! bytes), the parts as `postcard` encodes them, behind them the threads and clips, burns, the energy of cuts and the times of burns if there are any, and the values at the points. All numbers are little-endian. The
//! bytes are equal on every machine and at every width of vectors. The checksum detects damage, but an attacker can
//! compute it again. So every value is checked when a snapshot is read or restored.

use std::sync::Arc;

use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::Xxh3;

use super::recovery::{Acts, Ended, MAX_RECOVERIES, Recovered, Recoveries};
use super::{Posed, Session, Tool};
use palpate_haptics::ReportedCuts;
use palpate_haptics::pose_playback::{Path, PathState};
use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::limits::Limits;
use palpate_tissue::saved::{
    Checks, PlainTissue, SNAPSHOT, SavedBurnTimes, SavedBurns, SavedFracture, SavedPlan, SavedPoke, SavedTies,
    SavedTip, SavedTissue, TissueParts, ensure, tool_above, unsound,
};
use palpate_tissue::scene::record::Recovery;
use palpate_tissue::{self as tissue, Model, Tissue};

/// The first eight bytes of a snapshot.
pub const MAGIC: [u8; 8] = *b"PALPSNAP";

/// Version of the format and of the arithmetic. A program that reads another version would continue with other
/// bits, so it is refused.
pub const VERSION: u32 = 2;

/// Memory for the parts per byte: the smallest entry of a list is three bytes, which take 24 in a vector that may
/// have room for twice as many.
const PARTS_MULTIPLE: u64 = 32;

/// Memory that a reader reserves for lists that it has begun, bytes.
const ROOM: u64 = 4 << 20;

/// Returns an upper bound of the memory for reading and restoring the parts of a snapshot, bytes, from the lengths in
/// its header. It trusts no length beyond that of `bytes`, and checks nothing.
pub fn memory_of(bytes: &[u8]) -> u64 {
    let parts = bytes.get(12..20).map_or(0, |length| u64::from_le_bytes(array(length))).min(bytes.len() as u64);
    bytes.len() as u64 + parts.saturating_mul(PARTS_MULTIPLE) + ROOM.min(parts << 10)
}

/// Length of the bytes before the parts: magic, version, length, checksum.
const HEADER: usize = 8 + 4 + 8 + 16;

/// Position of the checksum.
const CHECKSUM: std::ops::Range<usize> = 20..36;

/// A snapshot: a session at one moment, copied in memory or read from bytes. Clones share the content.
#[derive(Debug, Clone)]
pub struct Saved {
    content: Content,
    /// Limits by which it is restored.
    limits: Limits,
}

#[derive(Debug, Clone)]
enum Content {
    /// A copy of a session of this process.
    Taken { own: Arc<SessionParts>, tissue: SavedTissue, state: SavedPlan, step: u64 },
    /// Content that was read from bytes.
    Read { parts: Arc<Parts>, values: Arc<Vec<u8>> },
}

/// Everything in a snapshot but the values at the points.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Parts {
    session: SessionParts,
    tissue: TissueParts,
}

/// A session without its tissue.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct SessionParts {
    tools: Vec<SavedTool>,
    late_commands: u64,
    paused_commands: u64,
    path_counts: [u64; 3],
    recoveries: SavedRecoveries,
    hold_reason: Option<String>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct SavedTool {
    acknowledged_sequence: u64,
    client_time_ns: u64,
    arrival_ns: u64,
    control_point: Option<u64>,
    around: Option<Box<SavedPoke>>,
    expires_at: Option<u64>,
    late: bool,
    expired: bool,
    posed: Option<Box<SavedPosed>>,
    paused_until: Option<u64>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct SavedPosed {
    tip: SavedTip,
    path: SavedPath,
    client_time_s: f64,
}

type SavedVector = [f64; 3];

/// Serialized form of [`PathState`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct SavedPath {
    at_once: bool,
    begins_m: Option<SavedVector>,
    waiting: Vec<(f64, SavedVector)>,
    heading: Option<(f64, SavedVector, SavedVector)>,
    played: Option<(f64, SavedVector)>,
    place_m: Option<SavedVector>,
    arrived_s: f64,
    spare_s: f64,
    watched_s: f64,
    counts: [u64; 3],
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct SavedRecoveries {
    count: u64,
    newest: Vec<SavedRecovery>,
    /// Step, tool and count.
    acts: Vec<(u64, u32, u64)>,
    disturbed: bool,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct SavedRecovery {
    step: u64,
    state_of_step: u64,
    at_rest: bool,
    undone_commands: u64,
    paused_until_step: Option<u64>,
    reason: String,
    /// Tool, sequence number and undone commands.
    tools: Vec<(u32, u64, u64)>,
}

impl Session {
    /// Returns a copy of everything that the next steps depend on. It only copies memory, as much as the state of the
    /// tissue has; [`Saved::to_bytes`] encodes it later, in any thread. A running audit is left out. Do not call it
    /// within an unfinished step.
    pub fn save(&self) -> Saved {
        let own = SessionParts {
            tools: self.tools.iter().map(SavedTool::of).collect(),
            late_commands: self.late_commands,
            paused_commands: self.paused_commands,
            path_counts: self.path_counts,
            recoveries: SavedRecoveries::of(&self.recoveries),
            hold_reason: self.hold_reason.clone(),
        };
        let (tissue, state, step) = (self.tissue.save(), self.model().saved_plan(), self.step_count());
        // The values come from this process, which has checked them against its own limits.
        let limits = Limits { tools: u32::MAX, point_force_n: f64::INFINITY, ..Limits::default() };
        Saved { content: Content::Taken { own: Arc::new(own), tissue, state, step }, limits }
    }

    /// Creates a session that continues from a snapshot with equal bits. `model` is that of the session when it was
    /// saved ([`Model::resumed`] of [`Saved::tissue`]); only the width of its vectors may differ.
    ///
    /// # Errors
    /// Refuses a snapshot of another model, and values that no session can have or that are beyond the limits given
    /// to [`Saved::from_bytes`].
    pub fn restore(model: &Arc<Model>, saved: &Saved) -> Result<Self> {
        match &saved.content {
            Content::Taken { own, tissue, .. } => {
                let PlainTissue { parts, values } = tissue.plain();
                Session::restored(model, own, tissue::restored(model, &parts, &values, &saved.limits)?, &saved.limits)
            }
            Content::Read { parts, values } => {
                let tissue = tissue::restored(model, &parts.tissue, values, &saved.limits)?;
                Session::restored(model, &parts.session, tissue, &saved.limits)
            }
        }
    }

    fn restored(model: &Model, own: &SessionParts, tissue: Box<dyn Tissue>, limits: &Limits) -> Result<Self> {
        let (checks, step) = (Checks { shape: model.shape(), limits }, tissue.step_count());
        if let Some(last) = own.tools.len().checked_sub(1) {
            checks.tool(last as u64)?;
        }
        for count in own.path_counts {
            checks.count(count)?;
        }
        Ok(Session {
            tissue,
            tools: own.tools.iter().map(|tool| tool.restored(&checks)).collect::<Result<_>>()?,
            late_commands: checks.count(own.late_commands)?,
            paused_commands: checks.count(own.paused_commands)?,
            path_counts: own.path_counts,
            recoveries: own.recoveries.restored(step, &checks)?,
            hold_reason: own.hold_reason.clone(),
            marks: Vec::new(),
        })
    }

    /// Releases all tools at the present step, as if their leases ended: their paths and sequence numbers are
    /// forgotten, and pauses stay. A server does this when it continues a session after a restart. It is an input, so
    /// a recorder of inputs must record it at this step.
    pub fn let_go(&mut self) {
        for index in 0..self.tools.len() {
            self.end_lease(index);
        }
    }
}

impl Saved {
    /// Returns the number of steps that the saved session had done.
    pub fn step(&self) -> u64 {
        match &self.content {
            Content::Taken { step, .. } => *step,
            Content::Read { parts, .. } => parts.tissue.steps,
        }
    }

    /// Returns the scheme and the coefficients of the tissue, for [`Model::resumed`].
    pub fn tissue(&self) -> &SavedPlan {
        match &self.content {
            Content::Taken { state, .. } => state,
            Content::Read { parts, .. } => &parts.tissue.tissue,
        }
    }

    /// Returns what is severed in the tissue, as a server reports it to a copy. Nothing is checked.
    pub fn cuts(&self) -> ReportedCuts {
        match &self.content {
            Content::Taken { tissue, .. } => tissue.plain().parts.reported_cuts(),
            Content::Read { parts, .. } => parts.tissue.reported_cuts(),
        }
    }

    /// Encodes the snapshot in the format of this module, with a checksum. It takes as long as reading the state
    /// several times, and the model once.
    pub fn to_bytes(&self) -> Vec<u8> {
        match &self.content {
            Content::Taken { own, tissue, .. } => {
                let PlainTissue { parts, values } = tissue.plain();
                encoded(&Parts { session: SessionParts::clone(own), tissue: parts }, &values)
            }
            Content::Read { parts, values } => encoded(parts, values),
        }
    }

    /// Decodes a snapshot and checks its checksum and sizes. [`Session::restore`] checks later, under these limits,
    /// that it fits a model.
    ///
    /// # Errors
    /// - [`Reason::Unreadable`]: the bytes are no snapshot, are cut off or damaged, or can't be decoded.
    /// - [`Reason::NotAvailable`]: they have another version than [`VERSION`].
    /// - More tools than `limits.tools` or more points than `limits.points`.
    pub fn from_bytes(bytes: &[u8], limits: &Limits) -> Result<Self> {
        let refuse = |reason, message: &str| Err(Refusal::new(reason, SNAPSHOT, message));
        let Some((header, content)) = bytes.split_at_checked(HEADER).filter(|(header, _)| header.starts_with(&MAGIC))
        else {
            return refuse(Reason::Unreadable, "is not a snapshot of Palpate, or was cut off");
        };
        let version = u32::from_le_bytes(array(&header[8..12]));
        if version != VERSION {
            let message = format!(
                "has version {version} of the format, and this program ({}) reads version {VERSION}: use the program that wrote it",
                env!("CARGO_PKG_VERSION")
            );
            return refuse(Reason::NotAvailable, &message);
        }
        if header[CHECKSUM] != checksum(&header[..CHECKSUM.start], content).to_le_bytes() {
            return refuse(Reason::Unreadable, "is damaged or cut off: its checksum does not match");
        }
        let length = usize::try_from(u64::from_le_bytes(array(&header[12..20]))).unwrap_or(usize::MAX);
        let Some((parts, values)) = content.split_at_checked(length) else {
            return refuse(Reason::Unreadable, "is cut off");
        };
        let parts: Parts = match postcard::take_from_bytes(parts) {
            Ok((parts, [])) => parts,
            Ok((mut parts, rest)) => {
                let Ok((ties, rest)) = postcard::take_from_bytes::<SavedTies>(rest) else {
                    return Err(unsound("threads or clips that can't be read"));
                };
                if rest.is_empty() {
                    ensure(!ties.is_empty(), "threads or clips that can't be read")?;
                } else {
                    let Ok((burns, rest)) = postcard::take_from_bytes::<SavedBurns>(rest) else {
                        return Err(unsound("burns that can't be read"));
                    };
                    if rest.is_empty() {
                        ensure(!burns.is_empty(), "burns that can't be read")?;
                    } else {
                        let Ok((fracture, rest)) = postcard::take_from_bytes::<SavedFracture>(rest) else {
                            return Err(unsound("an energy of cuts that can't be read"));
                        };
                        if rest.is_empty() {
                            ensure(!fracture.is_empty(), "an energy of cuts that can't be read")?;
                        } else {
                            parts.tissue.burn_times = match postcard::take_from_bytes::<SavedBurnTimes>(rest) {
                                Ok((times, [])) if !times.is_empty() => times,
                                _ => return Err(unsound("times of burns that can't be read")),
                            };
                        }
                        parts.tissue.fracture = fracture;
                    }
                    parts.tissue.burns = burns;
                }
                parts.tissue.ties = ties;
                parts
            }
            Err(_) => return Err(unsound("parts that can't be read")),
        };
        if let Some(last) = parts.session.tools.len().checked_sub(1).filter(|last| *last >= limits.tools as usize) {
            return Err(tool_above(last as u64, limits));
        }
        if parts.tissue.points > limits.points as u64 {
            let message = format!("has {} points, above the limit of {}", parts.tissue.points, limits.points);
            return refuse(Reason::TooLarge, &message);
        }
        let content = Content::Read { parts: Arc::new(parts), values: Arc::new(values.to_vec()) };
        Ok(Saved { content, limits: limits.clone() })
    }
}

/// Returns the bytes of a slice of length N as an array; zeros for another length.
fn array<const N: usize>(bytes: &[u8]) -> [u8; N] {
    bytes.try_into().unwrap_or([0; N])
}

fn checksum(header: &[u8], content: &[u8]) -> u128 {
    let mut hasher = Xxh3::new();
    hasher.update(header);
    hasher.update(content);
    hasher.digest128()
}

fn encoded(parts: &Parts, values: &[u8]) -> Vec<u8> {
    // Serialization of plain data to memory can't fail.
    let mut bytes_of_parts = postcard::to_stdvec(parts).unwrap_or_default();
    let TissueParts { ties, burns, fracture, burn_times, .. } = &parts.tissue;
    // Each is written if there is any of it, or of what is behind it.
    let has_times = !burn_times.is_empty();
    let has_fracture = has_times || !fracture.is_empty();
    let has_burns = has_fracture || !burns.is_empty();
    if has_burns || !ties.is_empty() {
        bytes_of_parts.extend(postcard::to_stdvec(ties).unwrap_or_default());
    }
    if has_burns {
        bytes_of_parts.extend(postcard::to_stdvec(burns).unwrap_or_default());
    }
    if has_fracture {
        bytes_of_parts.extend(postcard::to_stdvec(fracture).unwrap_or_default());
    }
    if has_times {
        bytes_of_parts.extend(postcard::to_stdvec(burn_times).unwrap_or_default());
    }
    let parts = bytes_of_parts;
    let mut bytes = Vec::with_capacity(HEADER + parts.len() + values.len());
    bytes.extend_from_slice(&MAGIC);
    bytes.extend_from_slice(&VERSION.to_le_bytes());
    bytes.extend_from_slice(&(parts.len() as u64).to_le_bytes());
    bytes.extend_from_slice(&[0; 16]);
    bytes.extend_from_slice(&parts);
    bytes.extend_from_slice(values);
    seal(&mut bytes);
    bytes
}

/// Writes the matching checksum into a snapshot, so that a test can pass altered bytes to the checks that follow it.
/// Bytes shorter than a header stay as they are.
pub fn seal(bytes: &mut [u8]) {
    if let Some((header, content)) = bytes.split_at_mut_checked(HEADER) {
        let sum = checksum(&header[..CHECKSUM.start], content).to_le_bytes();
        header[CHECKSUM].copy_from_slice(&sum);
    }
}

impl SavedTool {
    fn of(tool: &Tool) -> Self {
        let posed = tool.posed.as_ref().map(|posed| {
            Box::new(SavedPosed {
                tip: SavedTip::of(&posed.tip),
                path: SavedPath::of(posed.path.state()),
                client_time_s: posed.client_time_s,
            })
        });
        SavedTool {
            acknowledged_sequence: tool.acknowledged_sequence,
            client_time_ns: tool.client_time_ns,
            arrival_ns: tool.arrival_ns,
            control_point: tool.control_point.map(|point| point.index() as u64),
            around: tool.around.as_ref().map(SavedPoke::of).map(Box::new),
            expires_at: tool.expires_at,
            late: tool.late,
            expired: tool.expired,
            posed,
            paused_until: tool.paused_until,
        }
    }

    fn restored(&self, checks: &Checks<'_>) -> Result<Tool> {
        let posed = self.posed.as_ref().map(|posed| {
            Ok(Posed {
                tip: posed.tip.restored(checks)?,
                path: posed.path.restored(checks)?,
                client_time_s: checks.number(posed.client_time_s)?,
            })
        });
        Ok(Tool {
            acknowledged_sequence: self.acknowledged_sequence,
            client_time_ns: self.client_time_ns,
            arrival_ns: self.arrival_ns,
            control_point: self.control_point.map(|point| checks.point(point)).transpose()?,
            around: self.around.as_ref().map(|poke| poke.restored(checks)).transpose()?,
            expires_at: self.expires_at,
            late: self.late,
            expired: self.expired,
            posed: posed.transpose()?,
            paused_until: self.paused_until,
        })
    }
}

impl SavedPath {
    fn of(state: PathState) -> Self {
        SavedPath {
            at_once: state.at_once,
            begins_m: state.begins_m.map(Into::into),
            waiting: state.waiting.into_iter().map(|(time_s, place_m)| (time_s, place_m.into())).collect(),
            heading: state.heading.map(|(time_s, place_m, velocity)| (time_s, place_m.into(), velocity.into())),
            played: state.played.map(|(time_s, place_m)| (time_s, place_m.into())),
            place_m: state.place_m.map(Into::into),
            arrived_s: state.arrived_s,
            spare_s: state.spare_s,
            watched_s: state.watched_s,
            counts: state.counts,
        }
    }

    fn restored(&self, checks: &Checks<'_>) -> Result<Path> {
        let places = self.waiting.iter().chain(&self.played).map(|place| &place.1);
        let heads_m = self.heading.iter().map(|heading| &heading.1);
        for place_m in places.chain(&self.begins_m).chain(&self.place_m).chain(heads_m) {
            checks.vector(*place_m)?;
        }
        let path = Path::restored(PathState {
            at_once: self.at_once,
            begins_m: self.begins_m.map(Into::into),
            waiting: self.waiting.iter().map(|(time_s, place_m)| (*time_s, (*place_m).into())).collect(),
            heading: self.heading.map(|(time_s, place_m, velocity)| (time_s, place_m.into(), velocity.into())),
            played: self.played.map(|(time_s, place_m)| (time_s, place_m.into())),
            place_m: self.place_m.map(Into::into),
            arrived_s: self.arrived_s,
            spare_s: self.spare_s,
            watched_s: self.watched_s,
            counts: self.counts,
        });
        path.ok_or_else(|| unsound("an invalid path of a tool"))
    }
}

impl SavedRecoveries {
    fn of(recoveries: &Recoveries) -> Self {
        let newest = recoveries.newest.iter().map(|recovered| {
            let Recovered { recovery, tools } = &**recovered;
            SavedRecovery {
                step: recovery.step,
                state_of_step: recovery.state_of_step,
                at_rest: recovery.at_rest,
                undone_commands: recovery.undone_commands,
                paused_until_step: recovery.paused_until_step,
                reason: recovery.reason.clone(),
                tools: tools.iter().map(|ended| (ended.tool, ended.sequence, ended.undone_commands)).collect(),
            }
        });
        SavedRecoveries {
            count: recoveries.count,
            newest: newest.collect(),
            acts: recoveries.acts.iter().map(|acts| (acts.step, acts.tool, acts.count)).collect(),
            disturbed: recoveries.disturbed,
        }
    }

    fn restored(&self, now: u64, checks: &Checks<'_>) -> Result<Recoveries> {
        ensure(self.newest.len() <= MAX_RECOVERIES, "more recoveries than a session keeps")?;
        let newest = self.newest.iter().map(|saved| {
            ensure(saved.step <= now, "a recovery after its last step")?;
            let recovery = Recovery {
                step: saved.step,
                state_of_step: saved.state_of_step,
                at_rest: saved.at_rest,
                undone_commands: saved.undone_commands,
                paused_until_step: saved.paused_until_step,
                reason: saved.reason.clone(),
            };
            let ended = saved.tools.iter().map(|(tool, sequence, undone_commands)| {
                checks.tool(u64::from(*tool))?;
                Ok(Ended { tool: *tool, sequence: *sequence, undone_commands: *undone_commands })
            });
            Ok(Arc::new(Recovered { recovery, tools: ended.collect::<Result<_>>()? }))
        });
        // The counts are summed, so each is limited.
        const MAX_COUNTED: u64 = 1 << 24;
        let acts = self.acts.iter().map(|(step, tool, count)| {
            ensure(*step <= now && *count < MAX_COUNTED, "commands after its last step")?;
            checks.tool(u64::from(*tool))?;
            Ok(Acts { step: *step, tool: *tool, count: *count })
        });
        Ok(Recoveries {
            count: checks.count(self.count)?,
            newest: newest.collect::<Result<_>>()?,
            acts: acts.collect::<Result<_>>()?,
            disturbed: self.disturbed,
        })
    }
}
