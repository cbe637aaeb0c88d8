//! A gallbladder: a pear whose neck bends into the cystic duct, with a pouch before the neck and a flat side at the liver.

use glam::{BVec3, DVec3};

use super::field::{Spine, Unevenness, ball, intersection, union};
use super::shape::{Shape, sides};
use crate::dice::Dice;

/// Returns the shape of the gallbladder. The fundus is at x = 0, the duct beyond x = 60; the liver is above (z).
pub(super) fn shape(dice: &mut Dice) -> Shape {
    let long = dice.factor(0.08);
    let wide = dice.factor(0.12);
    let bend = dice.within(0.7, 1.2);
    let sag = dice.within(-2.0, 3.0);
    let duct = dice.within(3.0, 3.6);
    let spine = Spine::new(&[
        [0.0, 0.0, -sag, 14.5 * wide],
        [19.0 * long, 0.0, -sag, 18.5 * wide],
        [38.0 * long, 0.5, 0.0, 15.5 * wide],
        [52.0 * long, 0.0, 2.5, 10.0 * wide],
        [61.0 * long, 2.0 * bend, 5.0, 5.0],
        [66.0 * long, 9.0 * bend, 4.0, 4.0],
        [62.0 * long, 17.0 * bend, 0.0, 3.6],
        [67.0 * long, 25.0 * bend, -3.0, duct],
        [75.0 * long, 31.0 * bend, -5.0, duct],
    ]);
    let pouch = DVec3::new(52.0 * long, -4.0 * bend, -2.0);
    let pouch_radius = 8.5 * dice.factor(0.15) * wide;
    let bed = 12.0 * wide;
    let uneven = Unevenness::new(0.35, 24.0, dice);
    let distance = move |place: DVec3| {
        let pear = union(spine.distance(place), ball(place, pouch, pouch_radius), 6.0);
        intersection(pear, place.z - bed, 9.0) - uneven.at(place)
    };
    let extent = [
        DVec3::new(-20.0, -26.0, -28.0) - 3.0,
        DVec3::new(75.0 * long + 5.0, (31.0 * bend + 5.0).max(23.0), 22.0) + 3.0,
    ];
    Shape {
        distance: Box::new(distance),
        extent,
        cut: BVec3::FALSE,
        cell: 1.5,
        coarsest: 3.5,
        parts: vec![
            ("bed", Box::new(move |place| place.z > bed - 3.0 && place.x < 48.0 * long)),
            ("neck", Box::new(move |place| place.x > 59.0 * long)),
        ],
        chart: sides(extent),
    }
}
