//! A prostate: two lobes with the groove between them that a finger feels from behind.

use glam::{BVec3, DVec3};

use super::field::{Unevenness, capsule, difference, ellipsoid, intersection, union};
use super::shape::{Shape, sides};
use crate::dice::Dice;

/// Height at which the front is cut flat, mm: there the pubic bone holds it.
const FRONT: f64 = -13.0;

/// Returns the shape of the prostate. x runs from its right to its left side, y from the apex to the base, z backwards, to
/// the rectum.
pub(super) fn shape(dice: &mut Dice) -> Shape {
    let wide = dice.factor(0.1);
    let long = dice.factor(0.08);
    let deep = dice.factor(0.08);
    let groove = dice.within(1.5, 3.0);
    let uneven = Unevenness::new(0.3, 26.0, dice);
    let distance = move |place: DVec3| {
        // Narrower towards the apex.
        let narrowing = 1.0 + 0.012 * place.y.clamp(-20.0, 20.0);
        let at = DVec3::new(place.x / narrowing, place.y, place.z);
        let radii = DVec3::new(14.0 * wide, 18.0 * long, 15.0 * deep);
        let lobe = |side: f64| ellipsoid(at, DVec3::new(side * 10.0 * wide, 0.0, 0.0), radii);
        let lobes = union(lobe(-1.0), lobe(1.0), 6.0);
        let top = 15.0 * deep + 4.0 - groove;
        let ends = [DVec3::new(0.0, -24.0, top), DVec3::new(0.0, 12.0, top)];
        let grooved = difference(lobes, capsule(place, ends[0], ends[1], 4.0), 5.0);
        intersection(grooved, FRONT - place.z, 3.0) - uneven.at(place)
    };
    let extent = [DVec3::new(-38.0, -28.0, -20.0), DVec3::new(38.0, 28.0, 24.0)];
    Shape {
        distance: Box::new(distance),
        extent,
        cut: BVec3::FALSE,
        cell: 2.0,
        coarsest: 5.0,
        parts: vec![
            ("front", Box::new(|place| place.z < FRONT + 1.5)),
            ("apex", Box::new(|place| place.y < -11.0)),
            ("base", Box::new(|place| place.y > 11.0)),
        ],
        chart: sides(extent),
    }
}
