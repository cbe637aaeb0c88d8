//! Capsules: what of an instrument other instruments touch. A row of tips is one.

use glam::DVec3;

use crate::dead_reckoning::MotionState;

/// All places that are within a radius of a segment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Capsule {
    /// The ends of the segment, m; one place twice is a ball.
    pub ends_m: [DVec3; 2],
    /// The radius, m.
    pub radius_m: f64,
}

impl Capsule {
    /// Returns the place on the segment at a part, 0 to 1, of the way between its ends, m.
    pub fn at_m(&self, part: f64) -> DVec3 {
        self.ends_m[0].lerp(self.ends_m[1], part)
    }

    /// Returns where this segment and another are nearest: a part of the way along each; of parallel ones the middle of the part in which
    /// they lie side by side. Where they are nearly parallel, a small turn moves these places from end to end.
    pub fn nearest(&self, other: &Self) -> [f64; 2] {
        let [way_m, other_way_m] = [self, other].map(|capsule| capsule.ends_m[1] - capsule.ends_m[0]);
        let apart_m = self.ends_m[0] - other.ends_m[0];
        let [a, b, e] = [way_m.length_squared(), way_m.dot(other_way_m), other_way_m.length_squared()];
        let [c, f] = [way_m.dot(apart_m), other_way_m.dot(apart_m)];
        // Of a point whose product with the way is `along`.
        let nearest_on = |along: f64, length_squared: f64| {
            if length_squared > 0.0 { (along / length_squared).clamp(0.0, 1.0) } else { 0.0 }
        };
        if a == 0.0 || e == 0.0 {
            return [nearest_on(-c, a), nearest_on(f, e)];
        }
        // Where the ends of the other segment are beside this one.
        let [first, last] = [-c / a, (b - c) / a].map(|part| part.clamp(0.0, 1.0));
        let middle = 0.5 * (first + last);
        let sine_squared = (1.0 - b * b / (a * e)).max(0.0);
        let crossed = if sine_squared > 1e-12 { ((b * f - c * e) / (a * e - b * b)).clamp(0.0, 1.0) } else { middle };
        // If the nearest place on the line of the other is beyond its end, the nearest one to that end.
        let part = match (b * crossed + f) / e {
            ..0.0 => nearest_on(-c, a),
            1.0.. => nearest_on(b - c, a),
            _ => crossed,
        };
        [part, nearest_on(b * part + f, e)]
    }
}

/// A capsule that moves: its ends go on at constant velocity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MovingCapsule {
    /// The last known places and velocities of its ends.
    pub ends: [MotionState; 2],
    /// The radius, m.
    pub radius_m: f64,
}

impl MovingCapsule {
    /// Returns where it is at `time_s`, s ([`MotionState::at`]).
    pub fn at(&self, time_s: f64) -> Capsule {
        Capsule { ends_m: self.ends.map(|end| end.at(time_s)), radius_m: self.radius_m }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn capsule(from_m: DVec3, to_m: DVec3) -> Capsule {
        Capsule { ends_m: [from_m, to_m], radius_m: 0.003 }
    }

    /// Returns the least distance of places on a fine grid on both segments, m.
    fn least_m(one: &Capsule, other: &Capsule) -> f64 {
        let parts = || (0..=200).map(|part| f64::from(part) / 200.0);
        parts().flat_map(|s| parts().map(move |t| one.at_m(s).distance(other.at_m(t)))).fold(f64::MAX, f64::min)
    }

    #[test]
    fn the_nearest_places_of_two_segments_are_nearer_than_any_of_a_grid() {
        let mut state = 1_u64;
        let mut number = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f64 / f64::from(1 << 24) - 0.5
        };
        let mut place_m = || 0.05 * DVec3::new(number(), number(), number());
        for _ in 0..200 {
            let [one, other] = [capsule(place_m(), place_m()), capsule(place_m(), place_m())];
            let ball = capsule(one.ends_m[0], one.ends_m[0]);
            for [one, other] in [[one, other], [ball, other], [other, ball], [ball, ball]] {
                let [s, t] = one.nearest(&other);
                let apart_m = one.at_m(s).distance(other.at_m(t));
                assert!(apart_m < least_m(&one, &other) + 1e-12, "{one:?} {other:?} {s} {t}");
            }
        }
    }

    #[test]
    fn parallel_segments_touch_in_the_middle_of_where_they_lie_side_by_side() {
        // From -2 to 13 mm along a segment from 0 to 20 mm.
        let one = capsule(DVec3::ZERO, 0.02 * DVec3::X);
        let beside_m = DVec3::new(-0.002, 0.004, 0.001);
        let other = capsule(beside_m, beside_m + 0.015 * DVec3::X);
        for [one, other] in [[one, other], [other, one]] {
            let [s, t] = one.nearest(&other);
            let places_m = [one.at_m(s), other.at_m(t)];
            assert!(places_m.iter().all(|at_m| (at_m.x - 0.0065).abs() < 1e-12), "{places_m:?}");
        }
    }
}
