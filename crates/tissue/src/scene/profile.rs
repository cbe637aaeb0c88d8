//! Forces and tool movements as functions of time: the content of a script, bound to a tissue and a step rate.
//!
//! Time is a number of whole steps and a fraction of the present step, so that a profile that jumps has a value
//! on both sides: just before the jump at (n − 1, 1), just after it at (n, 0).

use std::sync::Arc;

use glam::DVec3;
use palpate_haptics::{Instrument, InstrumentPose, Tip};

use super::tie::{Tie, TieKind};
use crate::shape::{self, PointId, RestShape};

/// A moment within a step. A profile that jumps has its value before the jump at (n − 1, 1), and its value
/// after it at (n, 0).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moment {
    /// The present step, counted from 0.
    pub step: u64,
    /// The part of the step that has passed: from 0 (its beginning) to 1 (its end).
    pub fraction: f64,
}

impl Moment {
    /// Returns the beginning of a step, at which its commands already apply.
    pub fn start_of(step: u64) -> Self {
        Moment { step, fraction: 0.0 }
    }

    /// Returns the time since the beginning of step 0, s, at `rate_hz` steps per second, which must be above 0.
    #[allow(clippy::cast_precision_loss)]
    pub fn time_s(self, rate_hz: f64) -> f64 {
        (self.step as f64 + self.fraction) / rate_hz
    }
}

/// A surgical force at one moment (the paper's exerting force and its falloff). Point p gets the force
/// `force_n`·exp(−`falloff_per_m`·r + `falloff_offset`), where r is the distance at rest from p to `centre_m`.
/// Vectors and places are in the tissue's frame. [`check_poke`](super::action_check::check_poke) checks one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Poke {
    /// The mass point at the centre, if the force was given by a point. Then its reaction is reported;
    /// otherwise the mean of the reactions around the centre.
    pub point: Option<PointId>,
    /// Place of the control point at rest, m; the rest position of `point`, if that is some. On a sheet z is 0.
    pub centre_m: DVec3,
    /// The exerting force, N, before falloff and offset.
    pub force_n: DVec3,
    /// Falloff c, 1/m, at least 0. With 0 every point gets the same force.
    pub falloff_per_m: f64,
    /// Offset c′ of the exponent, without unit: the force at the centre is `force_n`·e^{c′}.
    pub falloff_offset: f64,
}

/// A surgical force over time, whose value at a moment is a [`Poke`]. Steps are those of the step rate for
/// which it was made.
#[derive(Debug, Clone, PartialEq)]
pub struct LoadProfile {
    /// Place of the control point over time, at rest.
    pub centre: CentreProfile,
    /// The exerting force over time, N, before falloff and offset.
    pub strength: StrengthProfile,
    /// Falloff c, 1/m, at least 0; the same all the time.
    pub falloff_per_m: f64,
    /// Offset c′ of the exponent, without unit; the same all the time.
    pub falloff_offset: f64,
}

/// The place of a force's control point over time, m, in the frame of the tissue at rest. It stays between two
/// entries of a list.
#[derive(Debug, Clone, PartialEq)]
pub enum CentreProfile {
    /// Places, m, each with the step from which it applies, by strictly ascending step. There is no force
    /// before the first.
    Hops(Vec<(u64, DVec3)>),
    /// Mass points and their rest positions, m, each with the step from which it applies, by strictly ascending
    /// step. There is no force before the first.
    Points(Vec<(u64, (PointId, DVec3))>),
    /// A straight line at constant velocity, without an end: also beyond the rim of the tissue.
    Path {
        /// Place at time 0 (the beginning of step 0), m.
        from_m: DVec3,
        /// Velocity, m/s.
        velocity_m_per_s: DVec3,
    },
}

/// The exerting force over time, N, before falloff and offset ([`Poke::force_n`]).
#[derive(Debug, Clone, PartialEq)]
pub enum StrengthProfile {
    /// A fixed force, N, times a factor over time.
    Scaled(DVec3, Profile),
    /// Forces, N, each with the step from which it applies, by strictly ascending step; it stays until the
    /// next. There is no force before the first.
    Recorded(Vec<(u64, DVec3)>),
}

/// A factor over time, without unit, which scales a force.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Profile {
    /// Always 1.
    Constant,
    /// 1 for `on` ≤ step < `off`, otherwise 0.
    Pulse {
        /// First step of the pulse.
        on: u64,
        /// First step after it.
        off: u64,
    },
    /// 0, then linear to 1, then 1.
    Ramp {
        /// Time at which the rise begins, s, from the beginning of step 0.
        from_s: f64,
        /// Time at which the factor is 1, s; above `from_s`, or else the factor jumps or is NaN.
        to_s: f64,
    },
    /// sin(2πft), from −1 to 1, with t the time since the beginning of step 0.
    Sine {
        /// f, Hz.
        frequency_hz: f64,
    },
}

/// Returns the last of `entries` that has begun at `step`.
fn begun<T: Copy>(entries: &[(u64, T)], step: u64) -> Option<T> {
    let after = entries.partition_point(|entry| entry.0 <= step);
    after.checked_sub(1).map(|index| entries[index].1)
}

impl Profile {
    fn at(self, moment: Moment, rate_hz: f64) -> f64 {
        match self {
            Profile::Constant => 1.0,
            Profile::Pulse { on, off } => f64::from(u8::from((on..off).contains(&moment.step))),
            Profile::Ramp { from_s, to_s } => ((moment.time_s(rate_hz) - from_s) / (to_s - from_s)).clamp(0.0, 1.0),
            // `libm` gives the same bits on every machine; the platform's sine does not.
            Profile::Sine { frequency_hz } => libm::sin(std::f64::consts::TAU * frequency_hz * moment.time_s(rate_hz)),
        }
    }
}

/// Returns Σ exp(−c·r) over all points of a shape, fixed ones included, where r is the distance at rest to
/// `centre_m`, m, and c is `falloff_per_m`, 1/m. A force given for all points together is divided by this sum.
/// 0 if every point is too far away.
pub fn weights(shape: &dyn RestShape, centre_m: DVec3, falloff_per_m: f64) -> f64 {
    shape::points(shape).map(|point| libm::exp(-falloff_per_m * shape.rest_m(point).distance(centre_m))).sum()
}

impl CentreProfile {
    /// Returns the first place of the control point at rest, m, whenever it applies; 0 for an empty list.
    pub fn begins_at_m(&self) -> DVec3 {
        match self {
            CentreProfile::Hops(hops) => hops.first().map_or(DVec3::ZERO, |hop| hop.1),
            CentreProfile::Points(hops) => hops.first().map_or(DVec3::ZERO, |hop| hop.1.1),
            CentreProfile::Path { from_m, .. } => *from_m,
        }
    }
}

impl LoadProfile {
    /// Returns the force at a moment, at `rate_hz` steps per second. Before the first entry of a list, the
    /// force is zero; before the first place, the centre is the origin as well.
    pub fn at(&self, moment: Moment, rate_hz: f64) -> Poke {
        let force_n = match &self.strength {
            StrengthProfile::Scaled(force, profile) => *force * profile.at(moment, rate_hz),
            StrengthProfile::Recorded(rows) => begun(rows, moment.step).unwrap_or(DVec3::ZERO),
        };
        let point = match &self.centre {
            CentreProfile::Points(hops) => begun(hops, moment.step),
            CentreProfile::Hops(_) | CentreProfile::Path { .. } => None,
        };
        let centre = match &self.centre {
            CentreProfile::Hops(hops) => begun(hops, moment.step),
            CentreProfile::Points(_) => point.map(|point| point.1),
            CentreProfile::Path { from_m, velocity_m_per_s } => {
                Some(*from_m + *velocity_m_per_s * moment.time_s(rate_hz))
            }
        };
        Poke {
            point: point.map(|point| point.0),
            centre_m: centre.unwrap_or(DVec3::ZERO),
            force_n: if centre.is_some() { force_n } else { DVec3::ZERO },
            falloff_per_m: self.falloff_per_m,
            falloff_offset: self.falloff_offset,
        }
    }
}

/// The movement of a grasped point over time: the sum of its moves, in the tissue's frame.
#[derive(Debug, Clone, PartialEq)]
pub struct MotionProfile {
    /// The point, which must not be fixed.
    pub point: PointId,
    /// Displacements from the rest position, which add up; in any order, and they may overlap. Empty: the point
    /// is held at rest.
    pub moves: Vec<Move>,
}

/// A smooth displacement: `by_m`·s((t − from)/(to − from)), s(x) = 10x³ − 15x⁴ + 6x⁵ clamped to 0…1. That is
/// the movement of least jerk from rest to rest (Flash and Hogan, The coordination of arm movements, Journal of
/// Neuroscience 5(7), 1985, doi:10.1523/JNEUROSCI.05-07-01688.1985).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Move {
    /// Time at which it begins, s, from the beginning of step 0.
    pub from_s: f64,
    /// Time at which it ends, s, above `from_s`.
    pub to_s: f64,
    /// Displacement that the whole move adds, m.
    pub by_m: DVec3,
}

/// The movement of a tool with a tip, from pose to pose. The tool is away before the first pose and from
/// `until_s` on.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseProfile {
    /// The tip: its radius, friction and coupling to the tissue; the same all the time.
    pub tip: Tip,
    /// Times, s, and places of the tip, m, in the frame of the tissue at rest, by strictly ascending time; at
    /// least one. Between two of them the tip moves on a straight line with the smooth profile of a [`Move`];
    /// after the last it stays.
    pub poses: Vec<(f64, DVec3)>,
    /// Time at which the tool is taken away, s, later than the first pose; infinite if it stays.
    pub until_s: f64,
    /// The instrument that moves the tip, and the tip's number there; `poses` are then the places of the tip at the instrument's
    /// poses.
    pub mounted: Option<(Arc<InstrumentProfile>, usize)>,
}

impl PoseProfile {
    /// Returns the place of the tip at a time, m; `None` before the first pose and from `until_s` on. Between
    /// two poses it is x₀ + (x₁ − x₀)·s(x), with the function s of a [`Move`]; on an instrument it is where that has it.
    pub fn at(&self, time_s: f64) -> Option<DVec3> {
        if let Some((instrument, tip)) = &self.mounted {
            return Some(instrument.instrument.tip_m(*tip, &instrument.at(time_s)?));
        }
        let (from_m, to) = reached(&self.poses, self.until_s, time_s)?;
        Some(to.map_or(*from_m, |(to_m, part)| *from_m + (*to_m - *from_m) * part))
    }
}

/// A thread or clip over time. It is laid at the first of its times, and cut at `until_s`.
#[derive(Debug, Clone, PartialEq)]
pub struct TieProfile {
    /// Its name, for people; empty without.
    pub name: String,
    /// The thread or clip, with its first length.
    pub tie: Tie,
    /// Times, s, and lengths of the thread, m, by strictly ascending time; at least one. Between two of them the length changes with the
    /// smooth profile of a [`Move`]; after the last it stays. The lengths of a clip are 0.
    pub lengths_m: Vec<(f64, f64)>,
    /// Time at which it is cut, s, later than the first; infinite if it stays.
    pub until_s: f64,
}

impl TieProfile {
    /// Returns the thread or clip at a time, s; `None` before it is laid and from `until_s` on.
    pub fn at(&self, time_s: f64) -> Option<Tie> {
        let (from_m, to) = reached(&self.lengths_m, self.until_s, time_s)?;
        let now_m = to.map_or(*from_m, |(to_m, part)| from_m + (to_m - from_m) * part);
        let kind = match self.tie.kind {
            TieKind::Thread { friction, .. } => TieKind::Thread { length_m: now_m, friction },
            TieKind::Clip => TieKind::Clip,
        };
        Some(Tie { kind, ..self.tie.clone() })
    }
}

/// The movement of an instrument, from pose to pose. It is away before the first pose and from `until_s` on. Each of its tips is a
/// tool.
#[derive(Debug, Clone, PartialEq)]
pub struct InstrumentProfile {
    /// The instrument.
    pub instrument: Instrument,
    /// Times, s, and poses, by strictly ascending time; at least one. Between two of them the instrument moves with the profile of a
    /// [`Move`] ([`InstrumentPose::towards`]); after the last it stays. With a port, its shaft passes through that.
    pub poses: Vec<(f64, InstrumentPose)>,
    /// Time at which it is taken away, s, later than the first pose; infinite if it stays.
    pub until_s: f64,
    /// The number of the tool that is its first tip; the others follow.
    pub first_tool: usize,
}

impl PoseProfile {
    /// Returns the tip at a time at which it is there; the edge of a blade turns with its instrument.
    pub fn tip_at(&self, time_s: f64) -> Tip {
        let pose = self.mounted.as_ref().and_then(|(instrument, tip)| Some((instrument, *tip, instrument.at(time_s)?)));
        pose.map_or(self.tip, |(instrument, tip, pose)| instrument.instrument.tip(tip, &pose))
    }
}

impl InstrumentProfile {
    /// Returns the pose at a time; `None` before the first pose and from `until_s` on.
    pub fn at(&self, time_s: f64) -> Option<InstrumentPose> {
        let (from, to) = reached(&self.poses, self.until_s, time_s)?;
        Some(self.instrument.lead(&to.map_or(*from, |(to, part)| from.towards(to, part))))
    }
}

/// Returns the last of some poses that has come at a time, s, and the next with the part of the way to it: s(x) of a [`Move`]. `None`
/// before the first and from `until_s` on.
fn reached<T>(poses: &[(f64, T)], until_s: f64, time_s: f64) -> Option<(&T, Option<(&T, f64)>)> {
    let after = poses.partition_point(|pose| pose.0 <= time_s);
    let (begun_s, from) = poses.get(after.checked_sub(1)?)?;
    if time_s >= until_s {
        return None;
    }
    let Some((end_s, to)) = poses.get(after) else { return Some((from, None)) };
    let x = (time_s - begun_s) / (end_s - begun_s);
    Some((from, Some((to, x * x * x * (10.0 + x * (6.0 * x - 15.0))))))
}

/// The position and motion of a prescribed point, as vectors in the tissue's frame. `default()` is at rest.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Motion {
    /// Displacement from rest, m.
    pub displacement_m: DVec3,
    /// Velocity, m/s.
    pub velocity_m_per_s: DVec3,
    /// Acceleration, m/s².
    pub acceleration_m_per_s2: DVec3,
}

impl MotionProfile {
    /// Returns displacement, velocity and acceleration at a time, s: the sums over all moves. With x the part
    /// of a move's duration T that has passed, they are `by_m` times s(x) ([`Move`]), s′(x)/T = 30x²(1 − x)²/T
    /// and s″(x)/T² = 60x(1 − x)(1 − 2x)/T².
    pub fn at(&self, time_s: f64) -> Motion {
        let mut motion = Motion::default();
        for Move { from_s, to_s, by_m } in &self.moves {
            let span_s = to_s - from_s;
            let x = ((time_s - from_s) / span_s).clamp(0.0, 1.0);
            motion.displacement_m += *by_m * (x * x * x * (10.0 + x * (6.0 * x - 15.0)));
            motion.velocity_m_per_s += *by_m * (30.0 * x * x * (1.0 - x) * (1.0 - x) / span_s);
            motion.acceleration_m_per_s2 += *by_m * (60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / (span_s * span_s));
        }
        motion
    }
}
