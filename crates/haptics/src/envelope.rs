//! The safety envelope: the limits between a wanted force and a device. Every force passes them, in this order:
//!
//! 1. The age of the newest model since its *arrival* (a constant delay is not age). The force is unchanged up to
//!    [`FRESH_S`], fades to a half up to [`STALE_S`], and then decays with the time constant [`DECAY_S`]. Beyond
//!    [`PAUSE_S`] the state is PAUSED, as it is after a gap of more than [`PAUSE_S`] between two ticks. A model that
//!    arrives earlier brings the force back within `RETURN_S`.
//! 2. Soft engage. After `enable`, nothing is rendered until a model is known and its force is below
//!    [`ENGAGE_BELOW_N`]. Then the force ramps in over [`ENGAGE_S`].
//! 3. The norm of the force (clamping its components would turn it), and the device's continuous force.
//! 4. Passivity: no more energy leaves the port than has entered it, and than other tools give to this one
//!    through the tissue ([`Envelope::supply`]).
//! 5. Slew: the force changes by at most [`SLEW_N_PER_S`], up and down, in every state.
//!
//! **Passivity.** The port's energy is exact for a held force: E −= f·Δx at each tick, as in the passivity observer
//! of Hannaford and Ryu (Time-domain passivity control of haptic interfaces, IEEE Transactions on Robotics and
//! Automation 18(1), 2002, doi:10.1109/70.988969). A force f along the hand's velocity v falls no faster than the
//! slew S, so it still gives the energy f²·v/2S before it is zero. It is therefore limited to f ≤ √(2·S·E/v). This
//! does not limit a spring K that is pressed in and released at v while its force falls no faster than the slew
//! allows, K·v ≤ S. The hand may speed up meanwhile, and a turning force falls more slowly along its old direction, so
//! v counts `SPEED_MARGIN` times. A hand at rest may start at any moment, so it counts as at least
//! `MIN_SPEED_M_PER_S`. A device
//! that nobody holds accelerates while the force falls: with an acceleration a, which falls with the force, it
//! receives f²/2S · a·f/4S more, so a·f/4S is added to v. A hand hardly accelerates within a few hundredths of a
//! second, so this term hardly affects it. To allow a first force before any energy has entered, the energy tank
//! begins with `CREDIT_J`, and a force of `FIRST_N` against a hand that presses on is always allowed.
//!
//! **Torque.** A device of six axes has all of this for the wrench (F, τ/ℓ) and the velocity (v, ω·ℓ), whose product is the power of
//! force and torque together: ℓ is the device's largest torque divided by its largest force ([`Device::lever_m`]). So a torque
//! changes by at most ℓ·[`SLEW_N_PER_S`], both have one energy tank, and they fade and ramp in together. The limits of 3 apply to
//! force and torque each.

use glam::DVec3;

use crate::device::{CONTINUOUS_S, Device};
use crate::instrument_pose::Wrench;
use crate::spatial_vector::SpatialVector;

/// Age of the newest model up to which the force is unchanged, s.
pub const FRESH_S: f64 = 0.05;
/// Age of the newest model at which half the force is left, s. Beyond it, the force decays with [`DECAY_S`].
pub const STALE_S: f64 = 0.15;
/// Age of the newest model, or gap between two ticks, beyond which rendering pauses until it is enabled, s. At this
/// age a twentieth of half the force is left.
pub const PAUSE_S: f64 = 0.3;
/// Time within which a faded force returns, s: 50 ms after an outage of 100 ms, the error is some tenths of a per
/// cent.
const RETURN_S: f64 = 0.04;
/// Time constant of the exponential decay of the force beyond [`STALE_S`], and after rendering stops, s.
pub const DECAY_S: f64 = 0.05;
/// Fraction of the force that is left at [`STALE_S`].
const STALE_SHARE: f64 = 0.5;
/// Wanted force below which rendering begins after `enable`, N.
pub const ENGAGE_BELOW_N: f64 = 0.2;
/// Duration of the ramp from zero to the wanted force when rendering begins, s.
pub const ENGAGE_S: f64 = 0.5;
/// Largest rate of change of the force, as a vector, in every state, N/s.
pub const SLEW_N_PER_S: f64 = 100.0;
/// Smallest speed that passivity assumes for the hand, m/s.
const MIN_SPEED_M_PER_S: f64 = 0.08;
/// Factor of the speed for a hand that speeds up while a force falls, and for a turning force, which falls more
/// slowly along its old direction.
const SPEED_MARGIN: f64 = 1.5;
/// Time constant of the measurement of the acceleration, s.
const ACCELERATION_S: f64 = 0.003;
/// Largest energy in the tank, J: old friction must not pay for energy that is given later.
const TANK_J: f64 = 0.05;

/// Initial energy in the tank, J: less than a hand notices.
const CREDIT_J: f64 = 2.5e-4;
/// Force that is always allowed against a hand that presses on, N.
const FIRST_N: f64 = 0.2;

/// State of rendering: whether forces are rendered, and what starts them again. In a state without rendering, a force
/// that is left decays to zero within the slew over the next ticks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RenderingState {
    /// Nothing is rendered until `enable`.
    Disabled,
    /// Forces are rendered, or ramp in.
    Enabled,
    /// No model arrived or no tick came for longer than [`PAUSE_S`]. Nothing is rendered until `enable`.
    Paused,
    /// A value was not finite, the tool left the workspace, or [`Envelope::fail`] was called. Nothing is rendered
    /// until `reset` and then `enable`.
    Fault,
}

/// Reason why the rendered force differs from the wanted one. Several may act in one tick; [`Envelope::count`] counts
/// each.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LimitCause {
    /// The newest model is old, or the last tick was long ago.
    Stale,
    /// Rendering is not enabled, or the force ramps in.
    Engage,
    /// The force exceeded the device's largest force.
    Force,
    /// The force exceeded the device's continuous force for too long.
    Continuous,
    /// The force would have given more energy than had entered.
    Passivity,
    /// The force would have changed too fast.
    Slew,
    /// The tool is outside the device's workspace.
    Workspace,
    /// A place, a speed or a force was not finite.
    NotFinite,
}

impl LimitCause {
    /// All reasons with their names in lower case, such as `not_finite`, in the order of the variants.
    pub const ALL: [(LimitCause, &'static str); 8] = [
        (LimitCause::Stale, "stale"),
        (LimitCause::Engage, "engage"),
        (LimitCause::Force, "force"),
        (LimitCause::Continuous, "continuous"),
        (LimitCause::Passivity, "passivity"),
        (LimitCause::Slew, "slew"),
        (LimitCause::Workspace, "workspace"),
        (LimitCause::NotFinite, "not_finite"),
    ];
}

/// Input of one tick of the envelope: the wanted force, and the state of the device. All vectors are in one frame,
/// that of the device, in which its workspace is given ([`Envelope::new`]).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wanted {
    /// Present time, s, from any origin; it must not go back.
    pub now_s: f64,
    /// Place of the device's tool, m.
    pub place_m: DVec3,
    /// Velocity of the device's tool, m/s.
    pub velocity_m_per_s: DVec3,
    /// Wanted force on the device, before any limit, N.
    pub force_n: DVec3,
    /// Time since the newest model arrived, s; `None` while no model of the tissue is known.
    pub age_s: Option<f64>,
}

/// Input of one tick of the envelope about the turning of a device with six axes, in the frame of [`Wanted`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct WantedTurn {
    /// Wanted torque on the device about the place of its tool, before any limit, N·m.
    pub torque_n_m: DVec3,
    /// Angular velocity of the device's tool, rad/s.
    pub angular_rad_per_s: DVec3,
    /// How far it has turned since the last tick: along the axis of the turn, by its angle, rad.
    pub turned_rad: DVec3,
}

/// Safety envelope of one device: it limits each wanted force as at the top of this module, and counts the limits. One
/// lasts as long as its device is used, over all connections: it holds the last force, the energy and the counts.
///
/// A hand presses 4 mm deep into a tissue of 1000 N/m, so the wanted force is 4 N. The force on an undeclared device
/// is at most 2 N:
///
/// ```
/// use glam::DVec3;
/// use palpate_haptics::device::UNDECLARED;
/// use palpate_haptics::envelope::Wanted;
/// use palpate_haptics::{Envelope, LimitCause};
///
/// let mut envelope = Envelope::new(UNDECLARED, DVec3::ZERO);
/// envelope.enable();
/// let (mut rendered_n, mut before_m) = (DVec3::ZERO, 0.0);
/// for tick in 0..1200_u32 {
///     let now_s = f64::from(tick) * 1e-3;
///     // The hand stays on the surface until forces have ramped in. Then it goes down with 20 mm/s.
///     let depth_m = (0.02 * (now_s - 0.6)).clamp(0.0, 0.004);
///     let velocity_m_per_s = -(depth_m - before_m) / 1e-3 * DVec3::Z;
///     before_m = depth_m;
///     rendered_n = envelope.render(&Wanted {
///         now_s,
///         place_m: -depth_m * DVec3::Z,
///         velocity_m_per_s,
///         force_n: 1000.0 * depth_m * DVec3::Z,
///         age_s: Some(0.0),
///     });
/// }
/// assert!((rendered_n - 2.0 * DVec3::Z).length() < 1e-9, "{rendered_n} N");
/// let (limited, ticks) = envelope.count(LimitCause::Force);
/// println!("the force was limited in {limited} of {ticks} ticks");
/// ```
#[derive(Debug, Clone)]
pub struct Envelope {
    device: Device,
    /// Middle of the device's workspace, m.
    middle_m: DVec3,
    state: RenderingState,
    /// When the ramp began; `None` while it waits for a small force.
    engaged_s: Option<f64>,
    /// The wrench rendered now, N.
    rendered_n: SpatialVector,
    before: Option<(f64, DVec3)>,
    /// The velocity filtered with the time constant [`ACCELERATION_S`], m/s, and the acceleration that follows from
    /// it.
    slow_m_per_s: SpatialVector,
    acceleration_m_per_s2: SpatialVector,
    /// Energy in the tank, J.
    tank_j: f64,
    /// Total energy that the hand has given to the port, J.
    energy_j: f64,
    over_s: f64,
    /// The fraction of the force that the model's age leaves.
    share: f64,
    counts: [u64; LimitCause::ALL.len()],
    ticks: u64,
}

impl Envelope {
    /// Creates an envelope in state DISABLED, with force 0. The device's workspace is the sphere of radius
    /// [`Device::workspace_m`] around `middle_m` (m, in the device's frame); a place outside is a FAULT.
    pub fn new(device: Device, middle_m: DVec3) -> Self {
        Envelope {
            device,
            middle_m,
            state: RenderingState::Disabled,
            engaged_s: None,
            rendered_n: SpatialVector::ZERO,
            before: None,
            slow_m_per_s: SpatialVector::ZERO,
            acceleration_m_per_s2: SpatialVector::ZERO,
            tank_j: CREDIT_J,
            energy_j: 0.0,
            over_s: 0.0,
            share: 1.0,
            counts: [0; LimitCause::ALL.len()],
            ticks: 0,
        }
    }

    /// Returns the state of rendering. It changes with the functions below and in [`Envelope::render`].
    pub fn state(&self) -> RenderingState {
        self.state
    }

    /// Returns the energy that the hand has given to the port minus the energy that it got back since the envelope was
    /// created, J: −Σ f·Δx over all ticks, with f the force that was held during Δx. Negative if the hand got more.
    pub fn energy_j(&self) -> f64 {
        self.energy_j
    }

    /// Returns the number of times that `reason` limited the force, and the number of all ticks, since the envelope
    /// was created. [`LimitCause::Stale`] and [`LimitCause::Passivity`] may count twice in one tick.
    pub fn count(&self, reason: LimitCause) -> (u64, u64) {
        (self.counts[reason as usize], self.ticks)
    }

    /// Returns whether the ramp after `enable` has begun. It stays true until the first tick in another state than
    /// ENABLED, or until an `enable` that changes the state.
    pub fn is_engaged(&self) -> bool {
        self.engaged_s.is_some()
    }

    /// Changes DISABLED or PAUSED to ENABLED: the force ramps in over [`ENGAGE_S`] once a model is known and the
    /// wanted force is below [`ENGAGE_BELOW_N`]. Does nothing in another state; a FAULT needs [`Envelope::reset`]
    /// first.
    pub fn enable(&mut self) {
        if matches!(self.state, RenderingState::Disabled | RenderingState::Paused) {
            (self.state, self.engaged_s) = (RenderingState::Enabled, None);
        }
    }

    /// Changes to DISABLED: the force falls to zero over the next ticks, and nothing is rendered until
    /// [`Envelope::enable`]. Does nothing in FAULT.
    pub fn disable(&mut self) {
        if self.state != RenderingState::Fault {
            self.state = RenderingState::Disabled;
        }
    }

    /// Changes any state to FAULT: the force falls to zero over the next ticks, and nothing is rendered until
    /// [`Envelope::reset`] and then [`Envelope::enable`].
    pub fn fail(&mut self) {
        self.state = RenderingState::Fault;
    }

    /// Changes FAULT to DISABLED, so that [`Envelope::enable`] acts again. Does nothing in another state. Energy,
    /// force and counts stay.
    pub fn reset(&mut self) {
        if self.state == RenderingState::Fault {
            self.state = RenderingState::Disabled;
        }
    }

    /// Adds what other tools have given to this one through the tissue since the last tick, J, to the energy that may leave the
    /// port: a hand gets energy from another that pushes it. Negative if it went back. A value that is not finite is ignored.
    pub fn supply(&mut self, work_j: f64) {
        if work_j.is_finite() {
            self.tank_j = (self.tank_j + work_j).clamp(-TANK_J, TANK_J);
        }
    }

    fn acted(&mut self, reason: LimitCause) {
        self.counts[reason as usize] += 1;
    }

    /// Advances the envelope by one tick. Returns the force to render until the next tick, N: the wanted force after
    /// the limits at the top of this module, in their order. With a model of age a, the share that is left is 1 up to
    /// [`FRESH_S`], falls linearly to a half at [`STALE_S`], and is ½·e^{−(a − STALE_S)/DECAY_S} beyond. After
    /// `enable` it rises as t/[`ENGAGE_S`], t from the beginning of the ramp. Passivity bounds the force f by
    /// √(2·S·E/v), with E the energy in the tank and v = max(1.5·u, 0.08 m/s) + a·f/4S, where u is the hand's speed and
    /// a its acceleration along the force; against a hand that presses on, `FIRST_N` is always allowed. Slew bounds
    /// the change in a tick of length h (at most 10 ms count) by S·h, S = [`SLEW_N_PER_S`].
    ///
    /// A value that is not finite, or a place outside the workspace, changes the state to FAULT; a model or a gap
    /// between two ticks older than [`PAUSE_S`] changes it to PAUSED. The force then falls to zero within the slew.
    pub fn render(&mut self, wanted: &Wanted) -> DVec3 {
        self.render_wrench(wanted, &WantedTurn::default()).force_n
    }

    /// Advances the envelope by one tick, as [`Envelope::render`] does, for a device that also turns. Returns force and torque to
    /// render until the next tick; no torque if the device renders none.
    pub fn render_wrench(&mut self, wanted: &Wanted, turn: &WantedTurn) -> Wrench {
        let lever_m = self.device.lever_m();
        let has_torque = lever_m > 0.0;
        let if_any = |value: DVec3| if has_torque { value } else { DVec3::ZERO };
        let rendered_n = self.render_vector(
            wanted,
            SpatialVector { linear: wanted.force_n, angular: if_any(turn.torque_n_m / lever_m) },
            SpatialVector { linear: wanted.velocity_m_per_s, angular: if_any(turn.angular_rad_per_s * lever_m) },
            if_any(turn.turned_rad * lever_m),
        );
        Wrench { force_n: rendered_n.linear, torque_n_m: if_any(rendered_n.angular * lever_m) }
    }

    /// Advances the envelope with a wanted wrench, N, a velocity, m/s, and how far the device has turned since the last tick, m.
    fn render_vector(
        &mut self,
        wanted: &Wanted,
        wanted_n: SpatialVector,
        velocity_m_per_s: SpatialVector,
        turned_m: DVec3,
    ) -> SpatialVector {
        self.ticks += 1;
        let known = wanted.place_m.is_finite()
            && velocity_m_per_s.is_finite()
            && turned_m.is_finite()
            && wanted.now_s.is_finite();
        if !known || wanted.age_s.is_some_and(|age_s| !age_s.is_finite()) {
            // The place of the device or the age of its model is unknown, so there is no work to account for. The force
            // falls to zero.
            self.acted(LimitCause::NotFinite);
            self.fail();
            let step_n = SLEW_N_PER_S * NOMINAL_S;
            self.rendered_n -= self.rendered_n.clamp_length_max(step_n);
            return self.rendered_n;
        }
        let elapsed_s = match self.before.replace((wanted.now_s, wanted.place_m)) {
            Some((then_s, place_m)) => {
                let moved_m = SpatialVector { linear: wanted.place_m - place_m, angular: turned_m };
                let given_j = -self.rendered_n.dot(moved_m);
                self.energy_j += given_j;
                self.tank_j = (self.tank_j + given_j).min(TANK_J);
                if wanted.now_s - then_s > PAUSE_S && self.state == RenderingState::Enabled {
                    // The client's own loop stood still: the hand is elsewhere and does not expect a force.
                    self.acted(LimitCause::Stale);
                    self.state = RenderingState::Paused;
                }
                (wanted.now_s - then_s).clamp(0.0, 10.0 * NOMINAL_S)
            }
            None => NOMINAL_S,
        };
        self.slow_m_per_s += (velocity_m_per_s - self.slow_m_per_s) * (elapsed_s / (elapsed_s + ACCELERATION_S));
        self.acceleration_m_per_s2 = (velocity_m_per_s - self.slow_m_per_s) / ACCELERATION_S;
        let mut force_n = wanted_n;
        if !force_n.is_finite() {
            self.acted(LimitCause::NotFinite);
            self.fail();
            force_n = SpatialVector::ZERO;
        }
        if (wanted.place_m - self.middle_m).length() > self.device.workspace_m {
            self.acted(LimitCause::Workspace);
            self.fail();
        }
        force_n = self.fade(wanted, elapsed_s, force_n);
        force_n = self.engage(wanted, force_n);
        force_n = self.clamp(elapsed_s, force_n);
        force_n = self.keep_passive(velocity_m_per_s, force_n);
        force_n = self.slew(elapsed_s, velocity_m_per_s, force_n);
        self.rendered_n = force_n;
        force_n
    }

    /// Returns the force reduced by the model's age.
    fn fade(&mut self, wanted: &Wanted, elapsed_s: f64, force_n: SpatialVector) -> SpatialVector {
        // Without a model there is no force, and so nothing is stale.
        let age_s = wanted.age_s.unwrap_or(0.0);
        if age_s > PAUSE_S && self.state == RenderingState::Enabled {
            self.state = RenderingState::Paused;
        }
        let share = match age_s {
            age_s if age_s <= FRESH_S => 1.0,
            age_s if age_s <= STALE_S => 1.0 - (1.0 - STALE_SHARE) * (age_s - FRESH_S) / (STALE_S - FRESH_S),
            age_s => STALE_SHARE * ((STALE_S - age_s) / DECAY_S).exp(),
        };
        self.share = share.min(self.share + elapsed_s / RETURN_S);
        if self.share < 1.0 {
            self.acted(LimitCause::Stale);
        }
        force_n * self.share
    }

    fn engage(&mut self, wanted: &Wanted, force_n: SpatialVector) -> SpatialVector {
        match self.state {
            RenderingState::Enabled => {}
            // While no model arrives, `fade` reduces the force. Here the rest of it is released.
            RenderingState::Disabled | RenderingState::Paused | RenderingState::Fault => {
                self.engaged_s = None;
                self.acted(LimitCause::Engage);
                let decay = (-NOMINAL_S / DECAY_S).exp();
                return self.rendered_n.clamp_length_max(force_n.length()) * decay;
            }
        }
        // A zero force before the first model does not mean that the tip is outside the tissue.
        if self.engaged_s.is_none() && wanted.age_s.is_some() && force_n.length() < ENGAGE_BELOW_N {
            self.engaged_s = Some(wanted.now_s);
        }
        let share = self.engaged_s.map_or(0.0, |since_s| ((wanted.now_s - since_s) / ENGAGE_S).clamp(0.0, 1.0));
        if share < 1.0 {
            self.acted(LimitCause::Engage);
        }
        force_n * share
    }

    fn clamp(&mut self, elapsed_s: f64, force_n: SpatialVector) -> SpatialVector {
        let wanted_n = force_n.linear.length().max(force_n.angular.length());
        let mut most_n = self.device.most_n();
        if wanted_n > most_n {
            self.acted(LimitCause::Force);
        }
        // A motor cools down as fast as it heats up.
        let over = wanted_n.min(most_n) > self.device.continuous_n;
        self.over_s = (self.over_s + if over { elapsed_s } else { -elapsed_s }).clamp(0.0, CONTINUOUS_S);
        if over && self.over_s >= CONTINUOUS_S {
            self.acted(LimitCause::Continuous);
            most_n = self.device.continuous_n;
        }
        SpatialVector {
            linear: force_n.linear.clamp_length_max(most_n),
            angular: force_n.angular.clamp_length_max(most_n),
        }
    }

    fn keep_passive(&mut self, velocity_m_per_s: SpatialVector, force_n: SpatialVector) -> SpatialVector {
        let (length_n, most_n) = (force_n.length(), self.bearable_n(velocity_m_per_s, force_n));
        if length_n <= most_n {
            return force_n;
        }
        self.acted(LimitCause::Passivity);
        force_n * (most_n / length_n)
    }

    /// Returns the largest force along `force_n` whose energy the tank can cover until slew has reduced it to zero,
    /// N: √(2·S·E/v), from ∫ (f − S·t)·v dt = f²·v/2S ≤ E. Here v is 1.5 times the speed along the force, at least
    /// 0.08 m/s, plus a·f/4S.
    fn bearable_n(&self, velocity_m_per_s: SpatialVector, force_n: SpatialVector) -> f64 {
        let along = force_n.normalize_or_zero();
        let along_m_per_s = velocity_m_per_s.dot(along);
        let faster_m_per_s2 = self.acceleration_m_per_s2.dot(along).max(0.0);
        let gained_m_per_s = faster_m_per_s2 * force_n.length() / (4.0 * SLEW_N_PER_S);
        let speed = (SPEED_MARGIN * along_m_per_s).max(MIN_SPEED_M_PER_S) + gained_m_per_s;
        let most_n = (2.0 * SLEW_N_PER_S * self.tank_j.max(0.0) / speed).sqrt();
        if along_m_per_s < 0.0 { most_n.max(FIRST_N) } else { most_n }
    }

    /// Returns the last force changed towards the wanted one, as fast as slew allows. A turning force passes through
    /// directions between the two. If the tank cannot cover such a force, the force falls straight to zero.
    fn slew(&mut self, elapsed_s: f64, velocity_m_per_s: SpatialVector, force_n: SpatialVector) -> SpatialVector {
        let step_n = SLEW_N_PER_S * elapsed_s;
        let change_n = force_n - self.rendered_n;
        if change_n.length() <= step_n {
            return force_n;
        }
        self.acted(LimitCause::Slew);
        let next_n = self.rendered_n + change_n.clamp_length_max(step_n);
        if next_n.length() <= self.bearable_n(velocity_m_per_s, next_n) {
            return next_n;
        }
        self.acted(LimitCause::Passivity);
        self.rendered_n - self.rendered_n.clamp_length_max(step_n)
    }
}

/// Assumed duration of a tick when it is unknown, s.
const NOMINAL_S: f64 = 1e-3;

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// Simulates a device that a hand pushes along −z, tick by tick.
    struct Port {
        envelope: Envelope,
        tick: u32,
        height_m: f64,
    }

    impl Port {
        fn new(name: &str) -> Self {
            let mut envelope = Envelope::new(Device::named(name).unwrap(), DVec3::ZERO);
            envelope.enable();
            Port { envelope, tick: 0, height_m: 0.0 }
        }

        /// Does one tick at a velocity with a wanted force, both along z. Returns the rendered force.
        fn tick(&mut self, velocity_m_per_s: f64, force_n: f64) -> f64 {
            let wanted = Wanted {
                now_s: f64::from(self.tick) * 1e-3,
                place_m: self.height_m * DVec3::Z,
                velocity_m_per_s: velocity_m_per_s * DVec3::Z,
                force_n: force_n * DVec3::Z,
                age_s: Some(0.0),
            };
            self.tick += 1;
            self.height_m += velocity_m_per_s * 1e-3;
            self.envelope.render(&wanted).z
        }

        /// Does many ticks with the same velocity and wanted force. Returns the last force.
        fn ticks(&mut self, count: u32, velocity_m_per_s: f64, force_n: f64) -> f64 {
            (0..count).map(|_| self.tick(velocity_m_per_s, force_n)).last().unwrap()
        }
    }

    #[test]
    fn a_device_that_nobody_holds_gets_no_more_than_was_put_in() {
        for (mass_kg, stiffness_n_per_m) in [(0.045, 600.0), (0.05, 1500.0), (0.1, 4000.0)] {
            let mut port = Port::new("omega3");
            port.ticks(600, 0.0, 0.0);
            // The device is pressed 5 mm into a soft spring. Then a stiff spring replaces it, as after an outage, and
            // only a weak string holds the device.
            for _ in 0..250 {
                let force_n = -300.0 * port.height_m;
                port.tick(-0.02, force_n);
            }
            let mut velocity_m_per_s = 0.0;
            for _ in 0..300 {
                let force_n = port.tick(velocity_m_per_s, stiffness_n_per_m * (-port.height_m).max(0.0));
                velocity_m_per_s += (force_n - 0.5) / mass_kg * 1e-3;
            }
            let energy_j = port.envelope.energy_j();
            assert!(energy_j > -1.1 * CREDIT_J, "{mass_kg} kg, {stiffness_n_per_m} N/m: {energy_j} J");
        }
    }

    #[test]
    fn a_force_ramps_in_linearly_and_each_tick_of_the_ramp_is_counted() {
        let mut port = Port::new("omega3");
        // It engages at once, because the force is small. A hand that presses on gives the energy for what follows.
        port.tick(-0.05, 0.0);
        let half_n = port.ticks(250, -0.05, 1.0);
        assert!((half_n - 0.5).abs() < 1e-9, "{half_n}");
        let whole_n = port.ticks(250, -0.05, 1.0);
        assert!((whole_n - 1.0).abs() < 1e-9, "{whole_n}");
        assert_eq!(port.envelope.count(LimitCause::Engage), (500, 501));
        assert_eq!(port.ticks(100, -0.05, 1.0), 1.0);
        assert_eq!(port.envelope.count(LimitCause::Engage), (500, 601));
        for reason in
            [LimitCause::Stale, LimitCause::Force, LimitCause::Slew, LimitCause::Passivity, LimitCause::NotFinite]
        {
            assert_eq!(port.envelope.count(reason).0, 0, "{reason:?}");
        }
    }

    #[test]
    fn what_is_disabled_lets_go_until_it_is_enabled_and_a_fault_stays_a_fault() {
        let mut port = Port::new("omega3");
        port.tick(-0.05, 0.0);
        assert_eq!(port.ticks(600, -0.05, 1.0), 1.0);
        port.envelope.disable();
        assert_eq!(port.envelope.state(), RenderingState::Disabled);
        assert!(port.ticks(300, 0.0, 1.0) < 0.01);
        port.envelope.enable();
        assert_eq!(port.envelope.state(), RenderingState::Enabled);
        port.envelope.fail();
        port.envelope.disable();
        assert_eq!(port.envelope.state(), RenderingState::Fault);
    }

    #[test]
    fn a_motor_exceeds_its_continuous_force_for_two_seconds_and_then_has_to_cool() {
        let mut port = Port::new("omni");
        port.tick(-0.01, 0.0);
        // The ramp passes 0.88 N after 0.22 s.
        assert_eq!(port.ticks(2200, -0.01, 2.0), 2.0);
        assert_eq!(port.envelope.count(LimitCause::Continuous).0, 0);
        assert!((port.ticks(60, -0.01, 2.0) - 0.88).abs() < 1e-12);
        assert!(port.envelope.count(LimitCause::Continuous).0 > 0);
        // A second of rest allows a second of force.
        assert_eq!(port.ticks(1000, -0.01, 0.5), 0.5);
        assert_eq!(port.ticks(950, -0.01, 2.0), 2.0);
        assert!((port.ticks(120, -0.01, 2.0) - 0.88).abs() < 1e-12);
    }

    #[test]
    fn a_spring_that_falls_no_faster_than_the_slew_is_never_limited() {
        let mut port = Port::new("omega3");
        let spring_n = |port: &Port| 400.0 * (-port.height_m).max(0.0);
        port.ticks(600, 0.0, 0.0);
        for _ in 0..2 {
            for velocity_m_per_s in [-0.05, 0.0, 0.05] {
                for _ in 0..100 {
                    let wanted_n = spring_n(&port);
                    assert_eq!(port.tick(velocity_m_per_s, wanted_n), wanted_n, "at {} m", port.height_m);
                }
            }
        }
        assert_eq!([LimitCause::Passivity, LimitCause::Slew].map(|reason| port.envelope.count(reason).0), [0; 2]);
    }

    /// A force so faint that no limit but that of the age acts on it, N.
    const FAINT_N: f64 = 0.1;

    /// Returns the share of `FAINT_N` that is rendered at a time with a model of an age.
    fn share(envelope: &mut Envelope, now_s: f64, age_s: f64) -> f64 {
        let (place_m, velocity_m_per_s, force_n) = (DVec3::ZERO, DVec3::ZERO, FAINT_N * DVec3::Z);
        envelope.render(&Wanted { now_s, place_m, velocity_m_per_s, force_n, age_s: Some(age_s) }).z / FAINT_N
    }

    #[test]
    fn a_force_fades_in_a_straight_line_to_its_half_and_then_decays_and_returns_as_time_passes() {
        let faded = |age_s: f64| {
            let mut port = Port::new("omega3");
            assert_eq!(port.ticks(600, 0.0, FAINT_N), FAINT_N);
            let now_s = f64::from(port.tick) * 1e-3;
            let share = share(&mut port.envelope, now_s, age_s);
            (port.envelope, now_s, share)
        };
        let middle_s = 0.5 * (FRESH_S + STALE_S);
        let decayed = 0.5 / std::f64::consts::E;
        for (age_s, expected) in [(FRESH_S, 1.0), (middle_s, 0.75), (STALE_S, 0.5), (STALE_S + DECAY_S, decayed)] {
            let (envelope, _, share) = faded(age_s);
            assert!((share - expected).abs() < 1e-9, "{share} of the force at an age of {age_s} s");
            assert_eq!(envelope.count(LimitCause::Stale).0, u64::from(expected < 1.0));
        }
        // Half the force returns in half the time that all of it needs.
        let (mut envelope, mut now_s, mut found) = faded(STALE_S);
        for _ in 0..(250.0 * RETURN_S) as u32 {
            now_s += 1e-3;
            found = share(&mut envelope, now_s, 0.0);
        }
        assert!((found - 0.75).abs() < 0.01, "{found}");
        // A gap between two ticks counts as ten of them at most.
        let (mut envelope, now_s, _) = faded(STALE_S);
        let after_gap = share(&mut envelope, now_s + 0.04, 0.0);
        assert!((after_gap - (0.5 + 0.01 / RETURN_S)).abs() < 1e-9, "{after_gap}");
    }

    #[test]
    fn a_force_falls_at_every_tick_in_which_a_hand_is_pushed_faster_than_its_energy_bears() {
        let mut port = Port::new("omega3");
        port.ticks(600, 0.0, 0.0);
        for tick in 0..100 {
            port.tick(-0.05, 0.03 * f64::from(tick));
        }
        let mut last_n = port.ticks(500, -0.05, 3.0);
        assert_eq!(last_n, 3.0);
        // The wanted force stays the same.
        for tick in 0..25 {
            let force_n = port.tick(1.0, 3.0);
            assert!((0.0..last_n).contains(&force_n), "tick {tick}: {last_n}, then {force_n} N");
            last_n = force_n;
        }
        assert!(port.envelope.count(LimitCause::Passivity).0 >= 25 && port.envelope.energy_j() > 0.0);
    }

    /// A hand at rest on the tissue, which another tool pushes out of it: with 1 N over 20 mm.
    #[test]
    fn a_hand_gets_the_energy_that_another_tool_gives_it_and_no_more() {
        let rendered_j = |supplied_j: f64| {
            let mut port = Port::new("omega3");
            port.ticks(600, 0.0, 0.0);
            for _ in 0..200 {
                port.envelope.supply(supplied_j / 200.0);
                port.tick(0.1, 1.0);
            }
            port.envelope.supply(f64::NAN);
            port.ticks(100, 0.1, 0.0);
            -port.envelope.energy_j()
        };
        let whole_j = rendered_j(0.03);
        assert!((0.015..0.03).contains(&whole_j), "{whole_j} J");
        for supplied_j in [0.0, 0.005, -0.005] {
            let given_j = rendered_j(supplied_j);
            assert!(
                given_j <= 1.1 * CREDIT_J + supplied_j.max(0.0) && given_j < 0.5 * whole_j,
                "{supplied_j}: {given_j} J"
            );
        }
    }
}
