//! Scripts: forces, tool movements and samples over time, bound to a scene. Times are whole steps, and points
//! are places.

use std::sync::Arc;

use glam::DVec3;

use super::Change;
pub use super::action::{Action, PlaceMark};
use super::profile::{InstrumentProfile, LoadProfile, Moment, MotionProfile, PoseProfile, TieProfile};
use super::record::{ContactRecord, InstrumentRecord, PortRecord, ToolRecord};
use crate::shape::{PointId, RestShape};
use palpate_haptics::{ContactLoad, InstrumentContact, InstrumentPose, PortLoad};

/// The built-in scripts: name and TOML text, by ascending name. Each is made for some of the scenes
/// ([`made_for`](super::script_reader::made_for)).
pub const BUILT_IN: [(&str, &str); 12] = [
    ("cut", include_str!("../../../../scripts/cut.toml")),
    ("cut-solid", include_str!("../../../../scripts/cut-solid.toml")),
    ("dissect", include_str!("../../../../scripts/dissect.toml")),
    ("grasp", include_str!("../../../../scripts/grasp.toml")),
    ("lift", include_str!("../../../../scripts/lift.toml")),
    ("oblique-100", include_str!("../../../../scripts/oblique-100.toml")),
    ("oblique-60", include_str!("../../../../scripts/oblique-60.toml")),
    ("press", include_str!("../../../../scripts/press.toml")),
    ("push", include_str!("../../../../scripts/push.toml")),
    ("stroke", include_str!("../../../../scripts/stroke.toml")),
    ("suture", include_str!("../../../../scripts/suture.toml")),
    ("vertical-60", include_str!("../../../../scripts/vertical-60.toml")),
];

/// Distance from the tissue at rest from which on a tip of an instrument is not led, divided by the longest side of the tissue.
const FAR_OF_SIDE: f64 = 0.25;

/// Returns the forces of the tissue on the tips of an instrument, by their numbers, N, from the records of the tools.
pub fn forces_n(profile: &InstrumentProfile, tools: &[ToolRecord]) -> impl Iterator<Item = (usize, DVec3)> {
    let tip_of = |tool: &ToolRecord| (tool.tool as usize).checked_sub(profile.first_tool);
    let tips = tools.iter().filter_map(move |tool| Some((tip_of(tool)?, tool.force_on_tool_n.into())));
    tips.filter(|(tip, _)| *tip < profile.instrument.tips.len())
}

/// Returns whether the tip of an instrument at a place is led: it is at most a quarter of the tissue's longest side from the
/// tissue at rest, less what it reaches (`reach_m`, m: [`Tip::reach_m`](palpate_haptics::Tip::reach_m)). Farther away it would cost time and feel nothing.
pub fn is_led(shape: &dyn RestShape, place_m: DVec3, reach_m: f64) -> bool {
    shape.extent().distance_m(place_m) <= FAR_OF_SIDE * shape.longest_side_m() + reach_m
}

/// A script bound to a scene: what tools do over time, and what is recorded. [`Script::load`] and
/// [`Script::parse`] create it, with times as whole steps of the scene's rate. Tools are numbered from 0:
/// forces first, then grasped points, then tips.
#[derive(Debug, Clone)]
pub struct Script {
    /// Display name; any text. `unnamed` if the text gives none.
    pub name: String,
    /// Length in steps, at least 1.
    pub steps: u64,
    /// Steps between two records, at least 1. The first record is at step 0.
    pub sample_every: u64,
    /// The points that records contain, in this order, each once. If the script lists none: the points at its
    /// forces, grasps and poses.
    pub sample_points: Vec<PointId>,
    /// Surgical forces, in the order of the text. Force k is tool k.
    pub forces: Vec<LoadProfile>,
    /// Grasped points, each by one tool only; tool numbers follow those of the forces.
    pub moves: Vec<MotionProfile>,
    /// Tools with a tip, at last the tips of the instruments; their numbers follow those of the grasped points.
    pub poses: Vec<PoseProfile>,
    /// Instruments, in the order of the text. Their tips are tools of `poses`.
    pub instruments: Vec<Arc<InstrumentProfile>>,
    /// Threads, then clips, in the order of the text: number k is entry k. The tool after the others lays them.
    pub ties: Vec<TieProfile>,
    /// Marks, each with the step at whose beginning it is made, in the order of the text. The tool that lays threads and clips makes
    /// them.
    pub marks: Vec<(u64, PlaceMark)>,
    /// When the trainee ends phases of an exercise before their time: number of steps done, and the phase, from 1; both ascend. Only who
    /// judges the run by an exercise heeds them.
    pub phase_ends: Vec<(u64, u32)>,
    /// Changes of the tissue, each with the step at whose beginning it takes effect, by strictly ascending
    /// step.
    pub changes: Vec<(u64, Change)>,
    /// Warnings for the user, as sentences: rounded times, forces that leave the tissue, another scene than the
    /// script is made for.
    pub warnings: Vec<String>,
    /// Steps per second, Hz, from the scene that the script is bound to.
    pub rate_hz: f64,
    /// The rest shape of the tissue that the script is bound to.
    pub shape: Arc<dyn RestShape>,
}

impl Script {
    /// Returns the actions that a client sends at step `step` to play this script, with their tool numbers,
    /// ascending; also beyond [`Script::steps`]. Forces and grasps are only returned if they differ from the
    /// step before, and a force that ends or leaves the tissue as [`Action::Release`]; so ask for every step. A
    /// force acts for the whole step, from its beginning; a grasped point reaches its target at the step's end.
    pub fn actions_at(&self, step: u64) -> impl Iterator<Item = (usize, Action)> {
        let poke = move |profile: &LoadProfile, step: u64| {
            let poke = profile.at(Moment::start_of(step), self.rate_hz);
            // A force that has left the tissue can no longer be commanded.
            (poke.force_n != DVec3::ZERO && self.shape.is_near(poke.centre_m)).then_some(poke)
        };
        let pushes = self.forces.iter().enumerate().filter_map(move |(tool, profile)| {
            let (before, now) = (step.checked_sub(1).and_then(|before| poke(profile, before)), poke(profile, step));
            (before != now).then_some((tool, now.map_or(Action::Release, Action::Push)))
        });
        #[allow(clippy::cast_precision_loss)]
        let target = move |profile: &MotionProfile, end: u64| profile.at(end as f64 / self.rate_hz).displacement_m;
        let grasps = self.moves.iter().enumerate().filter_map(move |(index, profile)| {
            let (before, now) = (target(profile, step), target(profile, step + 1));
            let action = Action::Grasp { point: profile.point, displacement_m: now };
            (step == 0 || before != now).then_some((self.forces.len() + index, action))
        });
        pushes.chain(grasps).chain(self.poses_at(step))
    }

    /// Returns the poses that a client sends at step `step`, with their tool numbers, ascending: one for each
    /// tool with a tip at every step from its first pose to its end, because the server takes away a silent
    /// tool; then one release. A tip reaches its place at the step's end. Tips of an instrument that are far from the tissue at
    /// rest, by a quarter of its longest side, are not led: they would cost time and feel nothing.
    #[allow(clippy::cast_precision_loss)]
    pub fn poses_at(&self, step: u64) -> impl Iterator<Item = (usize, Action)> {
        let first = self.first_tip().unwrap_or_default();
        let is_led = |profile: &PoseProfile, place_m: &DVec3| {
            profile.mounted.is_none() || is_led(&*self.shape, *place_m, profile.tip.reach_m())
        };
        let place_m = move |profile: &PoseProfile, end: u64| {
            profile.at(end as f64 / self.rate_hz).filter(|place_m| is_led(profile, place_m))
        };
        let poses = self.poses.iter().enumerate().filter_map(move |(index, profile)| {
            let action = match place_m(profile, step + 1) {
                Some(place_m) => {
                    let tip = profile.tip_at((step + 1) as f64 / self.rate_hz);
                    Action::Pose { place_m, velocity_m_per_s: None, tip }
                }
                None => place_m(profile, step).map(|_| Action::Release)?,
            };
            Some((first + index, action))
        });
        poses.chain(self.ties_at(step)).chain(self.marks_at(step))
    }

    /// Returns what lays, changes and cuts threads and clips at step `step`.
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation)]
    fn ties_at(&self, step: u64) -> impl Iterator<Item = (usize, Action)> {
        let at = move |profile: &TieProfile, end: u64| profile.at(end as f64 / self.rate_hz);
        self.ties.iter().enumerate().filter_map(move |(number, profile)| {
            let (before, tie) = (at(profile, step).filter(|_| step > 0), at(profile, step + 1));
            (before != tie).then(|| (self.tool_count(), Action::Tie { number: number as u32, tie }))
        })
    }

    /// Returns the marks that are made at step `step`.
    fn marks_at(&self, step: u64) -> impl Iterator<Item = (usize, Action)> {
        let due = self.marks.iter().filter(move |mark| mark.0 == step);
        due.map(|mark| (self.tool_count(), Action::Mark(mark.1)))
    }

    /// Returns the number of tools that act by themselves, without the one that lays threads and clips and makes marks.
    fn tool_count(&self) -> usize {
        self.forces.len() + self.moves.len() + self.poses.len()
    }

    /// Returns the number of the first tool with a tip; `None` if the script has none.
    pub fn first_tip(&self) -> Option<usize> {
        (!self.poses.is_empty()).then_some(self.forces.len() + self.moves.len())
    }

    /// Returns the records of the instruments that are there at a time, s, from those of the tools.
    pub fn instrument_records(&self, time_s: f64, tools: &[ToolRecord]) -> Vec<InstrumentRecord> {
        let of = |(number, profile): (usize, &Arc<InstrumentProfile>)| {
            let instrument = &profile.instrument;
            let pose = profile.at(time_s)?;
            let forces_n = || forces_n(profile, tools);
            let wrench = instrument.wrench(&pose, forces_n());
            let of_jaws = |value: f64| instrument.has_jaws().then_some(value + 0.0);
            let array = |v: DVec3| (v + DVec3::ZERO).to_array();
            let [x, y, z, w] = pose.orientation.to_array();
            #[allow(clippy::cast_possible_truncation)]
            Some(InstrumentRecord {
                instrument: number as u32,
                place_m: array(pose.place_m),
                orientation: [w, x, y, z],
                force_on_tool_n: array(wrench.force_n),
                torque_on_tool_n_m: array(wrench.torque_n_m),
                jaw_rad: of_jaws(pose.jaw_rad),
                opening_n_m: of_jaws(instrument.opening_n_m(&pose, forces_n())),
                in_port: instrument.port_load(&pose, &wrench).map(|PortLoad { force_of_port_n, on_hand }| PortRecord {
                    force_of_port_n: array(force_of_port_n),
                    force_on_hand_n: array(on_hand.force_n),
                    torque_on_hand_n_m: array(on_hand.torque_n_m),
                }),
                contacts: self.contacts(number, &pose, time_s),
            })
        };
        self.instruments.iter().enumerate().filter_map(of).collect()
    }

    /// Returns the overlaps of an instrument at a pose with the others at a time, s.
    fn contacts(&self, number: usize, pose: &InstrumentPose, time_s: f64) -> Vec<ContactRecord> {
        let instrument = &self.instruments[number].instrument;
        let mut contact = InstrumentContact::new(instrument);
        let others = self.instruments.iter().enumerate().filter(|(other, _)| *other != number);
        let overlap = |(number, other): (usize, &Arc<InstrumentProfile>)| {
            let (other, pose_of_other) = (&other.instrument, other.at(time_s)?);
            let capsules: Vec<_> = other.rows().iter().map(|row| other.capsule(*row, &pose_of_other)).collect();
            #[allow(clippy::cast_possible_truncation)]
            let number = number as u32;
            let ContactLoad { wrench, depth_m } = contact.feel(instrument, pose, number, capsules.into_iter())?;
            let array = |v: DVec3| (v + DVec3::ZERO).to_array();
            Some(ContactRecord {
                with_instrument: number,
                depth_m,
                force_n: array(wrench.force_n),
                torque_n_m: array(wrench.torque_n_m),
            })
        };
        others.filter_map(overlap).collect()
    }

    /// Returns the number of tools that the script uses: theirs are 0 to this − 1.
    pub fn tools(&self) -> usize {
        self.tool_count() + usize::from(!self.ties.is_empty() || !self.marks.is_empty())
    }
}
