//! A kidney: a bean whose hollow side, the hilum, lets a vein and the ureter out.

use glam::{BVec3, DVec3};

use super::field::{Spine, Unevenness, capsule, difference, ellipsoid, union};
use super::shape::{Shape, sides};
use crate::dice::Dice;

/// Returns the shape of the kidney. x runs from the upper to the lower pole, y outward from the spine, z to the
/// front.
pub(super) fn shape(dice: &mut Dice) -> Shape {
    let long = dice.factor(0.07);
    let wide = dice.factor(0.08);
    let flat = dice.within(0.76, 0.86);
    let bow = dice.within(11.0, 17.0);
    let (upper, lower) = (dice.within(20.0, 23.0), dice.within(20.0, 23.0));
    let body = Spine::new(&[
        [-33.0 * long, -bow, 0.0, upper * wide],
        [-20.0 * long, 3.0, 0.0, 26.5 * wide],
        [20.0 * long, 3.0, 0.0, 26.5 * wide],
        [33.0 * long, -bow, 0.0, lower * wide],
    ]);
    // The ureter passes the lower pole without touching it.
    let aside = -bow - lower * wide - 8.0;
    let ureter = Spine::new(&[
        [2.0, -8.0, 0.0, 9.0],
        [4.0, -26.0, -1.0, 8.0],
        [9.0, aside + 6.0, -2.0, 5.0],
        [24.0, aside, -2.0, 3.8],
        [40.0, aside, -1.0, 3.6],
        [64.0, aside, 0.0, 3.6],
    ]);
    let vein = [DVec3::new(-8.0, -8.0, 5.0), DVec3::new(-15.0, -47.0 * dice.factor(0.06), 9.0)];
    let hollow = DVec3::new(0.0, -33.0, 0.0);
    let uneven = Unevenness::new(0.7, 34.0, dice);
    let distance = move |place: DVec3| {
        let body = body.distance(DVec3::new(place.x, place.y, place.z / flat));
        let body = difference(body, ellipsoid(place, hollow, DVec3::new(17.0, 19.0, 12.0)), 8.0) - uneven.at(place);
        let vessels = union(ureter.distance(place), capsule(place, vein[0], vein[1], 5.0), 4.0);
        union(body, vessels, 5.0)
    };
    let extent = [DVec3::new(-68.0, -62.0, -32.0), DVec3::new(76.0, 38.0, 32.0)];
    Shape {
        distance: Box::new(distance),
        extent,
        cut: BVec3::FALSE,
        cell: 2.0,
        coarsest: 4.0,
        parts: vec![("hilum", Box::new(|place| place.y < -20.0 && place.x.abs() < 22.0))],
        chart: sides(extent),
    }
}
