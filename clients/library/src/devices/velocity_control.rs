//! Velocity control of a position: a deflection moves it at a speed, within a ball of 0.95 of the workspace's radius. For
//! devices that exert no force, such as a SpaceMouse or a gamepad.
//!
//! No force acts on the hand, so movement against a force stops when the force comes near the largest one.

use std::time::Instant;

use glam::DVec3;
use palpate_haptics::device::UNDECLARED;

/// Speed at full deflection, m/s.
const SPEED_M_PER_S: f64 = 0.05;

/// Deflection, as a fraction of the largest, that counts as none.
const DEAD: f64 = 0.08;

/// Longest time between two readings that moves the position, s.
const MAX_S: f64 = 0.02;

/// Fractions of the largest force between which a movement against it becomes slower, until it stops.
const STOPS: [f64; 2] = [0.6, 0.9];

/// A position that deflections move.
#[derive(Debug, Default)]
pub(super) struct VelocityControl {
    /// The force that was set last, N.
    force_n: DVec3,
    place_m: DVec3,
    moved: Option<Instant>,
}

impl VelocityControl {
    /// Sets the present force, N. Near the largest force, movement against it stops.
    pub(super) fn set_force(&mut self, force_n: DVec3) {
        self.force_n = force_n;
    }

    /// Moves the position until `now` at `velocity`, a fraction of the largest, and returns it, m.
    pub(super) fn advance(&mut self, now: Instant, velocity: DVec3) -> DVec3 {
        let passed_s =
            self.moved.replace(now).map_or(0.0, |before| now.duration_since(before).as_secs_f64().min(MAX_S));
        let moved_m = stopped(SPEED_M_PER_S * passed_s * velocity, self.force_n);
        // Stays within the workspace: beyond it the envelope would set the force to zero.
        self.place_m = (self.place_m + moved_m).clamp_length_max(0.95 * UNDECLARED.workspace_m);
        self.place_m
    }
}

/// Removes the dead zone from a deflection; the result is from -1 to 1.
pub(super) fn dead(deflection: f64) -> f64 {
    let beyond = (deflection.abs() - DEAD) / (1.0 - DEAD);
    if beyond > 0.0 { beyond.min(1.0).copysign(deflection) } else { 0.0 }
}

/// Returns the movement without the part that would increase a force that is already near the largest one.
fn stopped(moved_m: DVec3, force_n: DVec3) -> DVec3 {
    let along = force_n.normalize_or_zero();
    let against_m = moved_m.dot(along).min(0.0);
    let part = force_n.length() / UNDECLARED.most_n();
    let left = ((STOPS[1] - part) / (STOPS[1] - STOPS[0])).clamp(0.0, 1.0);
    moved_m - (1.0 - left) * against_m * along
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_goes_deeper_where_the_force_is_near_the_largest_one() {
        let most_n = UNDECLARED.most_n();
        let moved_m = DVec3::new(1e-5, 0.0, -2e-5);
        assert_eq!(stopped(moved_m, DVec3::ZERO), moved_m);
        assert_eq!(stopped(moved_m, DVec3::Z * 0.5 * most_n), moved_m);
        // Half way it is half as fast, then it only slides, and it can always move out.
        let half_m = stopped(moved_m, DVec3::Z * 0.75 * most_n);
        assert!((half_m - DVec3::new(1e-5, 0.0, -1e-5)).length() < 1e-12, "{half_m}");
        let slides_m = stopped(moved_m, DVec3::Z * 0.95 * most_n);
        assert!((slides_m - DVec3::X * 1e-5).length() < 1e-12, "{slides_m}");
        assert_eq!(stopped(-moved_m, DVec3::Z * most_n), -moved_m);
    }
}
