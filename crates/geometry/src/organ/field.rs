//! Solids as signed distances, and how to blend them. Lengths are in millimetres; a distance is negative inside.

use std::f64::consts::{PI, TAU};

use glam::{DVec3, DVec4, Vec4Swizzles};

use crate::dice::Dice;

/// Returns the distance of the union of two solids, with a fillet of `width` mm where they meet (quadratic smooth
/// minimum, Quilez).
pub(super) fn union(one: f64, other: f64, width: f64) -> f64 {
    let overlap = (width - (one - other).abs()).max(0.0);
    one.min(other) - overlap * overlap / (4.0 * width)
}

/// Returns the distance of the intersection of two solids, with edges rounded over `width` mm.
pub(super) fn intersection(one: f64, other: f64, width: f64) -> f64 {
    -union(-one, -other, width)
}

/// Returns the distance of the first solid without the second, with edges rounded over `width` mm.
pub(super) fn difference(one: f64, other: f64, width: f64) -> f64 {
    -union(-one, other, width)
}

/// Returns the distance of a ball.
pub(super) fn ball(place: DVec3, centre: DVec3, radius: f64) -> f64 {
    (place - centre).length() - radius
}

/// Returns the distance of an axis-aligned ellipsoid, exact to first order near the surface.
pub(super) fn ellipsoid(place: DVec3, centre: DVec3, radii: DVec3) -> f64 {
    let scaled = (place - centre) / radii;
    let (norm, slope) = (scaled.length(), (scaled / radii).length());
    if slope == 0.0 { -radii.min_element() } else { norm * (norm - 1.0) / slope }
}

/// Returns the distance of a capsule: all places within `radius` of the line between two ends.
pub(super) fn capsule(place: DVec3, from: DVec3, to: DVec3, radius: f64) -> f64 {
    let (along, way) = (to - from, place - from);
    let part = (way.dot(along) / along.length_squared()).clamp(0.0, 1.0);
    (way - along * part).length() - radius
}

/// Returns 1 at 0, and 0 below −1 and above 1, with two continuous derivatives.
pub(super) fn bump(x: f64) -> f64 {
    let rest = (1.0 - x * x).max(0.0);
    rest * rest * rest
}

/// Returns 0 below `from`, 1 above `to`, and a smooth transition between.
pub(super) fn step(from: f64, to: f64, x: f64) -> f64 {
    let part = ((x - from) / (to - from)).clamp(0.0, 1.0);
    part * part * (3.0 - 2.0 * part)
}

/// A smooth unevenness, so that no surface is as regular as a formula.
pub(super) struct Unevenness {
    height: f64,
    /// Direction times the wave number, 1/mm, and phase.
    waves: [DVec4; 3],
}

impl Unevenness {
    /// Creates waves with a length of about `length` mm and a height of about `height` mm.
    pub(super) fn new(height: f64, length: f64, dice: &mut Dice) -> Unevenness {
        let mut component = || dice.within(-1.0, 1.0);
        let waves = [(); 3].map(|()| {
            let direction = DVec3::new(component(), component(), component()).normalize_or(DVec3::X);
            let wave_number = TAU / (length * (1.0 + 0.4 * component()));
            (direction * wave_number).extend(PI * component())
        });
        Unevenness { height, waves }
    }

    /// Returns the height at a place, mm.
    pub(super) fn at(&self, place: DVec3) -> f64 {
        let phases = self.waves.iter().map(|wave| wave.dot(place.extend(1.0)));
        self.height * 0.6 * phases.map(libm::sin).sum::<f64>()
    }
}

/// A bent body of round sections: the union of balls along a curve. Its control points are (x, y, z, radius); the
/// curve is a quadratic B-spline of them, which starts at the first and ends at the last.
pub(super) struct Spine {
    /// Each piece of the curve is p₀ + p₁·t + p₂·t², with t from 0 to 1.
    pieces: Vec<[DVec4; 3]>,
    /// Balls along the curve, `PER_PIECE` per piece and the last one: starting points of the search for the nearest
    /// ball.
    balls: Vec<DVec4>,
}

/// Enough that Newton's method converges from the nearest of them.
const PER_PIECE: usize = 3;

impl Spine {
    /// Creates the body along at least three control points.
    pub(super) fn new(controls: &[[f64; 4]]) -> Spine {
        let controls: Vec<DVec4> = controls.iter().map(|&control| DVec4::from_array(control)).collect();
        let last = controls.len().saturating_sub(1);
        let pieces: Vec<[DVec4; 3]> = (1..last)
            .map(|i| {
                // A piece runs from the middle before its control point to the middle after it.
                let from = if i == 1 { controls[0] } else { (controls[i - 1] + controls[i]) * 0.5 };
                let to = if i + 1 == last { controls[last] } else { (controls[i] + controls[i + 1]) * 0.5 };
                [from, (controls[i] - from) * 2.0, from - controls[i] * 2.0 + to]
            })
            .collect();
        let mut spine = Spine { pieces, balls: Vec::new() };
        let count = PER_PIECE * spine.pieces.len() + 1;
        spine.balls = (0..count).map(|i| spine.ball(i as f64 / PER_PIECE as f64)[0]).collect();
        spine
    }

    /// Returns the ball at `t`, counted in pieces, and its first and second derivatives.
    fn ball(&self, t: f64) -> [DVec4; 3] {
        let piece = (t as usize).min(self.pieces.len() - 1);
        let [p0, p1, p2] = self.pieces[piece];
        let t = t - piece as f64;
        [p0 + (p1 + p2 * t) * t, p1 + p2 * (2.0 * t), p2 * 2.0]
    }

    /// Returns the distance of a place: the smallest of its distances to all the balls.
    pub(super) fn distance(&self, place: DVec3) -> f64 {
        let gap = |ball: DVec4| (ball.xyz() - place).length() - ball.w;
        let mut nearest = (f64::INFINITY, 0);
        for (i, &ball) in self.balls.iter().enumerate() {
            let gap = gap(ball);
            if gap < nearest.0 {
                nearest = (gap, i);
            }
        }
        // Newton's method near the nearest ball of the table, for the zero of the distance's derivative times the
        // length of the vector: that is nearly linear even close to the curve.
        let (table, end) = (1.0 / PER_PIECE as f64, self.pieces.len() as f64);
        let begin = nearest.1 as f64 * table;
        let mut t = begin;
        for _ in 0..3 {
            let [ball, first, second] = self.ball(t);
            let way = ball.xyz() - place;
            let slope = way.dot(first.xyz()) - way.length() * first.w;
            let bend = first.xyz().length_squared() + way.dot(second.xyz()) - way.length() * second.w;
            // Beyond the curve's centre of curvature there is no smallest distance.
            if bend > 0.0 {
                t = (t - slope / bend).clamp((begin - table).max(0.0), (begin + table).min(end));
            }
        }
        nearest.0.min(gap(self.ball(t)[0]))
    }
}
