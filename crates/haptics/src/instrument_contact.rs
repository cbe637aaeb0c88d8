//! Contact between instruments: they push each other apart where their capsules overlap.
//!
//! Two capsules whose axes are by d apart, with radii that add up to R, overlap by g = R − d and push each other along the line
//! between the nearest places of their axes with k·g/(1 − g/R), k = [`STIFFNESS_N_PER_M`]: the axes of two instruments can't meet
//! under any finite force. The force is that of an energy, and acts on both at one place, so a contact gives no energy.
//!
//! A device renders no more than it can, so a stronger hand may push one axis through the other. The direction of the contact
//! is therefore kept while they overlap: the force goes on to push the instrument back to the side from which it came, and g
//! grows beyond R. Only an instrument that has come out on the other side is free again.

use glam::DVec3;

use crate::capsule::{Capsule, MovingCapsule};
use crate::dead_reckoning::MotionState;
use crate::instrument::Instrument;
use crate::instrument_pose::{InstrumentPose, InstrumentVelocity, Wrench};

/// Stiffness k of a contact that begins, N/m: less than what a device renders without vibrating.
pub const STIFFNESS_N_PER_M: f64 = 1000.0;

/// The part of R up to which the stiffness grows.
const LARGEST_PART: f64 = 0.9;

/// Distance of two axes below which they meet, m.
const MEETS_M: f64 = 1e-9;

/// Largest number of capsules of another instrument that a client follows.
pub const MAX_CAPSULES: usize = 8;
/// Largest number of other instruments that a client follows.
pub const MAX_OTHER_INSTRUMENTS: usize = 4;

/// Largest distance from the origin of the tissue's frame, and largest radius, of another instrument, m.
const FARTHEST_M: f64 = 1e4;
const LARGEST_RADIUS_M: f64 = 1.0;

/// Largest number of overlaps whose directions are kept.
const MAX_OVERLAPS: usize = 64;

/// Another instrument on the tissue, as far as a client knows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OtherInstrument {
    /// The tool of its first tip in the session.
    pub first_tool: u32,
    /// Its capsules, in the tissue's frame.
    pub capsules: [Option<MovingCapsule>; MAX_CAPSULES],
}

impl OtherInstrument {
    /// Returns an instrument as another one's client follows it: where it is at `time_s` (s, by that client's clock), and its velocity.
    /// Beyond [`MAX_CAPSULES`], leaves out its last capsules.
    pub fn of(
        first_tool: u32,
        instrument: &Instrument,
        rows: &[[usize; 2]],
        pose: &InstrumentPose,
        velocity: &InstrumentVelocity,
        time_s: f64,
    ) -> Self {
        let mut capsules = [None; MAX_CAPSULES];
        for (capsule, row) in capsules.iter_mut().zip(rows) {
            let ends = row.map(|tip| MotionState {
                time_s,
                place_m: instrument.tip_m(tip, pose),
                velocity_m_per_s: instrument.tip_velocity_m_per_s(tip, pose, velocity),
            });
            *capsule = Some(MovingCapsule { ends, radius_m: instrument.capsule_radius_m(*row) });
        }
        OtherInstrument { first_tool, capsules }
    }

    /// Returns this instrument where it is at `time_s`, s.
    #[must_use]
    pub fn go_on(mut self, time_s: f64) -> Self {
        for end in self.capsules.iter_mut().flatten().flat_map(|capsule| &mut capsule.ends) {
            (end.place_m, end.time_s) = (end.at(time_s), time_s);
        }
        self
    }

    /// Returns this instrument with its places at another time, s: for a receiver whose clock is another one.
    #[must_use]
    pub fn at_time(mut self, time_s: f64) -> Self {
        for end in self.capsules.iter_mut().flatten().flat_map(|capsule| &mut capsule.ends) {
            end.time_s = time_s;
        }
        self
    }

    /// Returns whether its numbers can be those of an instrument: places within [`FARTHEST_M`], velocities up to as much in a second, and
    /// radii above 0 and up to [`LARGEST_RADIUS_M`].
    pub fn is_sound(&self) -> bool {
        let is_near = |end: &MotionState| {
            let is_within = |v: DVec3| v.abs().max_element() <= FARTHEST_M && v.is_finite();
            end.time_s.is_finite() && is_within(end.place_m) && is_within(end.velocity_m_per_s)
        };
        self.capsules.iter().flatten().all(|capsule| {
            capsule.ends.iter().all(is_near) && capsule.radius_m > 0.0 && capsule.radius_m <= LARGEST_RADIUS_M
        })
    }
}

/// The second hand of the same client, with its instrument.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SecondHand {
    /// Its instrument.
    pub instrument: OtherInstrument,
    /// The energy that it has given to the contacts with this one, J: negative if it got more.
    pub given_j: f64,
}

/// What an instrument feels of another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ContactLoad {
    /// Force and torque of the other on this instrument, about the place of its pose.
    pub wrench: Wrench,
    /// How far they overlap at most, m: above the sum of two radii if an axis has passed the other one.
    pub depth_m: f64,
}

/// An overlap of two capsules.
#[derive(Debug, Clone, Copy)]
struct Overlap {
    row: usize,
    first_tool: u32,
    capsule: usize,
    /// Unit vector from the axis of the other to this one's, as if neither had passed.
    normal: DVec3,
    is_found: bool,
}

/// The contacts of an instrument with others.
#[derive(Debug, Clone)]
pub struct InstrumentContact {
    rows: Vec<[usize; 2]>,
    overlaps: Vec<Overlap>,
}

impl InstrumentContact {
    /// Creates the contacts of an instrument that touches nothing, by its first [`MAX_CAPSULES`] rows. Reserves all the memory that
    /// ticks need.
    pub fn new(instrument: &Instrument) -> Self {
        let mut rows = instrument.rows();
        rows.truncate(MAX_CAPSULES);
        InstrumentContact { rows, overlaps: Vec::with_capacity(MAX_OVERLAPS) }
    }

    /// Begins a tick, in which [`InstrumentContact::feel`] is called for each other instrument. Forgets the overlaps that the last tick
    /// did not find.
    pub fn begin(&mut self) {
        self.overlaps.retain(|overlap| overlap.is_found);
        self.overlaps.iter_mut().for_each(|overlap| overlap.is_found = false);
    }

    /// Returns the first and last tips of the rows that are its capsules ([`Instrument::rows`]).
    pub fn rows(&self) -> &[[usize; 2]] {
        &self.rows
    }

    /// Forgets all contacts: the instruments are elsewhere.
    pub fn forget(&mut self) {
        self.overlaps.clear();
    }

    /// Returns what the instrument feels at a pose of another one, whose first tool and capsules are given; `None` if they do not
    /// overlap. `instrument` is the one of [`InstrumentContact::new`]. Does not allocate.
    pub fn feel(
        &mut self,
        instrument: &Instrument,
        pose: &InstrumentPose,
        first_tool: u32,
        capsules: impl Iterator<Item = Capsule> + Clone,
    ) -> Option<ContactLoad> {
        let mut load: Option<ContactLoad> = None;
        for (row, tips) in self.rows.iter().enumerate() {
            let own = instrument.capsule(*tips, pose);
            for (number, other) in capsules.clone().enumerate() {
                let [part, other_part] = own.nearest(&other);
                let [at_m, other_m] = [own.at_m(part), other.at_m(other_part)];
                let (apart_m, reach_m) = (at_m - other_m, own.radius_m + other.radius_m);
                let distance_m = apart_m.length();
                let overlaps = distance_m < reach_m;
                if !overlaps {
                    continue;
                }
                let is_same = |overlap: &&mut Overlap| {
                    (overlap.row, overlap.first_tool, overlap.capsule) == (row, first_tool, number)
                };
                let has_room = self.overlaps.len() < MAX_OVERLAPS;
                let known = self.overlaps.iter_mut().find(is_same);
                let before = known.as_ref().map(|overlap| overlap.normal);
                // Of axes that meet, rounding decides about the direction.
                let meets = distance_m < MEETS_M;
                let along = before.filter(|_| meets).or(apart_m.try_normalize()).unwrap_or(DVec3::Z);
                let has_passed = before.is_some_and(|before| along.dot(before) < 0.0);
                let normal = if has_passed { -along } else { along };
                let overlap = Overlap { row, first_tool, capsule: number, normal, is_found: true };
                match known {
                    Some(known) => *known = overlap,
                    None if has_room => self.overlaps.push(overlap),
                    None => {}
                }
                let depth_m = if has_passed { reach_m + distance_m } else { reach_m - distance_m };
                let force_n = force_n(depth_m, reach_m) * normal;
                // Both places are on the line of the force.
                let wrench = Wrench { force_n, torque_n_m: (at_m - pose.place_m).cross(force_n) };
                let before = load.unwrap_or(ContactLoad { wrench: Wrench::default(), depth_m: 0.0 });
                load = Some(ContactLoad { wrench: before.wrench + wrench, depth_m: before.depth_m.max(depth_m) });
            }
        }
        load
    }
}

/// Returns the force of an overlap, N, of two capsules whose radii add up to `reach_m`.
fn force_n(depth_m: f64, reach_m: f64) -> f64 {
    STIFFNESS_N_PER_M * depth_m / (1.0 - (depth_m / reach_m).min(LARGEST_PART))
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;
    use crate::instrument::InstrumentPart;
    use crate::tip::Tip;

    const RADIUS_M: f64 = 0.003;

    /// A shaft of 60 mm along −x from the place of its pose.
    fn shaft() -> Instrument {
        let mut instrument = Instrument::default();
        let tip = Tip { radius_m: RADIUS_M, ..Tip::default() };
        instrument.add_row(DVec3::ZERO, -0.06 * DVec3::X, tip, InstrumentPart::Body);
        instrument
    }

    fn capsules(instrument: &Instrument, pose: &InstrumentPose) -> Vec<Capsule> {
        instrument.rows().into_iter().map(|row| instrument.capsule(row, pose)).collect()
    }

    /// Another shaft whose middle is at the origin, along y.
    fn across() -> InstrumentPose {
        let orientation = DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2);
        InstrumentPose { orientation, ..InstrumentPose::at(0.03 * DVec3::Y) }
    }

    #[test]
    fn crossed_shafts_push_each_other_apart_alike_and_nothing_pushes_apart() {
        let (instrument, other) = (shaft(), across());
        let pose = InstrumentPose::at(DVec3::new(0.03, 0.002, 0.004));
        let [mut of_one, mut of_other] = [InstrumentContact::new(&instrument), InstrumentContact::new(&instrument)];
        let felt = of_one.feel(&instrument, &pose, 7, capsules(&instrument, &other).into_iter()).unwrap();
        let back = of_other.feel(&instrument, &other, 1, capsules(&instrument, &pose).into_iter()).unwrap();
        assert!((felt.depth_m - 0.002).abs() < 1e-12 && (back.depth_m - 0.002).abs() < 1e-12, "{felt:?}");
        // 2 mm of 6: k·g/(1 − 1/3).
        assert!(felt.wrench.force_n.distance(3.0 * DVec3::Z) < 1e-9, "{felt:?}");
        let sum = felt.wrench + back.wrench.about(pose.place_m - other.place_m);
        assert!(sum.force_n.length() < 1e-12 && sum.torque_n_m.length() < 1e-12, "{sum:?}");
        let apart = InstrumentPose { place_m: pose.place_m + 0.0021 * DVec3::Z, ..pose };
        assert!(of_one.feel(&instrument, &apart, 7, capsules(&instrument, &other).into_iter()).is_none());
    }

    #[test]
    fn the_force_is_that_of_an_energy() {
        let (instrument, other) = (shaft(), across());
        let others = capsules(&instrument, &other);
        // Around a closed course of places and turns the contact does no work, also while the shafts are nearly parallel.
        let turned = |to_other_rad: f64, part: f64| {
            let angle = std::f64::consts::TAU * part;
            let toward = DQuat::from_rotation_z(to_other_rad);
            let turn = DQuat::from_rotation_x(0.5 * angle.sin()) * DQuat::from_rotation_y(0.02 * angle.cos());
            InstrumentPose {
                place_m: toward * DVec3::new(0.03 + 0.01 * angle.sin(), 0.002 * angle.cos(), 0.0)
                    + (0.0045 + 0.001 * (2.0 * angle).sin()) * DVec3::Z,
                orientation: toward * turn,
                jaw_rad: 0.0,
            }
        };
        for to_other_rad in [0.0, std::f64::consts::FRAC_PI_2] {
            let (mut contact, mut work_j, mut most_j) = (InstrumentContact::new(&instrument), 0.0, 0.0_f64);
            let mut before: Option<(InstrumentPose, Wrench)> = None;
            for step in 0..=20_000 {
                let pose = turned(to_other_rad, f64::from(step) / 20_000.0);
                contact.begin();
                let felt = contact.feel(&instrument, &pose, 7, others.iter().copied());
                let wrench = felt.map_or(Wrench::default(), |felt| felt.wrench);
                if let Some((from, before)) = before.replace((pose, wrench)) {
                    let mean = (before + wrench) * 0.5;
                    work_j += mean.force_n.dot(pose.place_m - from.place_m) + mean.torque_n_m.dot(from.turn_to(&pose));
                    most_j = most_j.max(work_j.abs());
                }
            }
            assert!(most_j > 1e-3 && work_j.abs() < 1e-3 * most_j, "{to_other_rad}: {work_j} J of {most_j} J");
        }
    }

    #[test]
    fn an_axis_that_has_passed_another_is_pushed_back_until_it_has_come_out() {
        let (instrument, other) = (shaft(), across());
        let others = capsules(&instrument, &other);
        let mut contact = InstrumentContact::new(&instrument);
        let mut felt_at = |height_m: f64| {
            let pose = InstrumentPose::at(DVec3::new(0.03, 0.0, height_m));
            contact.begin();
            contact.feel(&instrument, &pose, 7, others.iter().copied())
        };
        let mut before_m = 0.0;
        for tick in 0..70 {
            let height_m = 0.0061 - 1e-4 * f64::from(tick);
            if let Some(felt) = felt_at(height_m) {
                assert!(felt.wrench.force_n.z > 0.0 && felt.depth_m > before_m, "{height_m}: {felt:?}");
                before_m = felt.depth_m;
            }
        }
        // It is 0.8 mm below the axis of the other: 6.8 mm deep. Then it goes back up.
        assert!((before_m - 0.0068).abs() < 1e-9, "{before_m} m");
        assert!(felt_at(0.003).unwrap().depth_m < 0.0031);
        // Out on the other side it is free, and touches from there.
        for tick in 0..120 {
            felt_at(0.003 - 1e-4 * f64::from(tick));
        }
        assert!(felt_at(-0.005).unwrap().wrench.force_n.z < 0.0);
    }

    #[test]
    fn instruments_have_a_capsule_for_each_row() {
        let tip = Tip { radius_m: 0.002, ..Tip::default() };
        let mut grasper = Instrument::default();
        grasper.add_parts(Some((0.012, tip)), Some((0.02, tip)));
        assert_eq!(grasper.rows().len(), 3);
        let mut corner = shaft();
        corner.add_row(RADIUS_M * DVec3::Y, 0.02 * DVec3::Y, corner.tips[0].tip, InstrumentPart::Body);
        corner.add_row(0.1 * DVec3::Z, 0.1 * DVec3::Z, corner.tips[0].tip, InstrumentPart::Body);
        assert_eq!(corner.rows(), [[0, 20], [21, 27], [28, 28]]);
    }
}
