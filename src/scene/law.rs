//! Forces and tool movements as laws of time: what a script means, bound to a sheet and a step rate.
//!
//! Time is counted in whole steps and a fraction of the step that is under way, so that a law that jumps
//! has a value on either side: just before the jump at (n − 1, 1), just after it at (n, 0).

use glam::{DVec2, DVec3};

/// A moment within a step: `fraction` from 0 (its beginning) to 1 (its end).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moment {
    /// The step under way.
    pub step: u64,
    /// How much of it is over.
    pub fraction: f64,
}

impl Moment {
    /// The beginning of a step.
    pub fn start_of(step: u64) -> Self {
        Moment { step, fraction: 0.0 }
    }

    /// In seconds, at `rate_hz` steps a second.
    #[allow(clippy::cast_precision_loss)]
    pub fn time_s(self, rate_hz: f64) -> f64 {
        (self.step as f64 + self.fraction) / rate_hz
    }
}

/// A surgical force as it acts at one moment (the paper's exerting force and its falloff): point p gets
/// `force_n`·exp(−`falloff_per_m`·r + `falloff_offset`), r the distance at rest from p to `centre_m`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Poke {
    /// The control point, in the rest plane.
    pub centre_m: DVec2,
    /// The exerting force, N.
    pub force_n: DVec3,
    /// c.
    pub falloff_per_m: f64,
    /// c′.
    pub falloff_offset: f64,
}

/// A surgical force over time.
#[derive(Debug, Clone, PartialEq)]
pub struct ForceLaw {
    /// Where.
    pub centre: CentreLaw,
    /// How strong.
    pub strength: StrengthLaw,
    /// c.
    pub falloff_per_m: f64,
    /// c′.
    pub falloff_offset: f64,
}

/// Where the control point is.
#[derive(Debug, Clone, PartialEq)]
pub enum CentreLaw {
    /// From each step on at that place; before the first there is no force.
    Hops(Vec<(u64, DVec2)>),
    /// A straight line.
    Path {
        /// Place at time 0.
        from_m: DVec2,
        /// Velocity.
        velocity_m_per_s: DVec2,
    },
}

/// The exerting force.
#[derive(Debug, Clone, PartialEq)]
pub enum StrengthLaw {
    /// A fixed vector times a profile.
    Scaled(DVec3, Profile),
    /// From each step on that vector; before the first, none.
    Recorded(Vec<(u64, DVec3)>),
}

/// A factor over time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Profile {
    /// 1.
    Constant,
    /// 1 for `on` ≤ step < `off`.
    Pulse {
        /// First step of the pulse.
        on: u64,
        /// First step after it.
        off: u64,
    },
    /// 0, then linear to 1, then 1.
    Ramp {
        /// Begins to rise.
        from_s: f64,
        /// Is 1.
        to_s: f64,
    },
    /// sin(2πft).
    Sine {
        /// f.
        frequency_hz: f64,
    },
}

/// The last of `entries` that has begun at `step`.
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
            // The same bits on every machine: not the platform's sine.
            Profile::Sine { frequency_hz } => libm::sin(std::f64::consts::TAU * frequency_hz * moment.time_s(rate_hz)),
        }
    }
}

impl ForceLaw {
    /// The force as it acts at a moment.
    pub fn at(&self, moment: Moment, rate_hz: f64) -> Poke {
        let force_n = match &self.strength {
            StrengthLaw::Scaled(force, profile) => *force * profile.at(moment, rate_hz),
            StrengthLaw::Recorded(rows) => begun(rows, moment.step).unwrap_or(DVec3::ZERO),
        };
        let centre = match &self.centre {
            CentreLaw::Hops(hops) => begun(hops, moment.step),
            CentreLaw::Path { from_m, velocity_m_per_s } => Some(*from_m + *velocity_m_per_s * moment.time_s(rate_hz)),
        };
        Poke {
            centre_m: centre.unwrap_or(DVec2::ZERO),
            force_n: if centre.is_some() { force_n } else { DVec3::ZERO },
            falloff_per_m: self.falloff_per_m,
            falloff_offset: self.falloff_offset,
        }
    }
}

/// The movement of a grasped point.
#[derive(Debug, Clone, PartialEq)]
pub struct MoveLaw {
    /// The point.
    pub point: [usize; 2],
    /// Displacements that add up.
    pub moves: Vec<Move>,
}

/// A smooth displacement: `by_m`·s((t − from)/(to − from)), s(x) = 10x³ − 15x⁴ + 6x⁵ clamped to 0…1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Move {
    /// Begins.
    pub from_s: f64,
    /// Is there.
    pub to_s: f64,
    /// Displacement, m.
    pub by_m: DVec3,
}

/// Where a prescribed point is and how it moves.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Motion {
    /// From rest, m.
    pub displacement_m: DVec3,
    /// m/s.
    pub velocity_m_per_s: DVec3,
    /// m/s².
    pub acceleration_m_per_s2: DVec3,
}

impl MoveLaw {
    /// Displacement, velocity and acceleration at a time.
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
