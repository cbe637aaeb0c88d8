//! A stomach: fundus, body and antrum along a J-shaped curve, from the oesophagus to the duodenum.

use glam::{BVec3, DVec3};

use super::field::{Spine, Unevenness, step, union};
use super::shape::{Shape, sides};
use crate::dice::Dice;

/// Returns the shape of the stomach. x points to the body's left, y up, z to the front.
pub(super) fn shape(dice: &mut Dice) -> Shape {
    let wide = dice.factor(0.12);
    let flat = dice.within(0.68, 0.82);
    let low = dice.within(-10.0, 8.0);
    let pylorus = 9.5 * dice.factor(0.1);
    let stomach = Spine::new(&[
        [47.0, 72.0, 0.0, 31.0 * wide],
        [52.0, 45.0, 0.0, 44.0 * wide],
        [46.0, -5.0, 0.0, 44.0 * wide],
        [30.0, -52.0 + low, 0.0, 38.0 * wide],
        [-12.0, -78.0 + low, 0.0, 28.0 * wide],
        [-46.0, -62.0 + low / 2.0, 0.0, 22.0 * wide],
        [-66.0, -38.0, -3.0, 13.0],
        [-72.0, -26.0, -5.0, pylorus],
        [-77.0, -14.0, -8.0, 15.0],
        [-86.0, -4.0, -14.0, 15.0],
        [-98.0, -10.0, -20.0, 12.5],
    ]);
    let oesophagus = Spine::new(&[
        [-6.0, 128.0, -6.0, 10.0],
        [0.0, 100.0, -6.0, 10.0],
        [8.0, 74.0, -3.0, 11.5],
        [34.0, 50.0, 0.0, 15.0],
    ]);
    let uneven = Unevenness::new(0.9, 52.0, dice);
    let distance = move |place: DVec3| {
        // It is flattened, except at its ends.
        let flat = flat + (1.0 - flat) * step(-30.0, -66.0, place.x);
        let stomach = stomach.distance(DVec3::new(place.x, place.y, place.z / flat));
        union(stomach, oesophagus.distance(place), 9.0) - uneven.at(place)
    };
    let extent = [DVec3::new(-118.0, -128.0, -52.0), DVec3::new(112.0, 146.0, 52.0)];
    Shape {
        distance: Box::new(distance),
        extent,
        cut: BVec3::FALSE,
        cell: 3.0,
        coarsest: 10.0,
        parts: vec![
            ("cardia", Box::new(|place| place.x < 22.0 && place.y > 62.0)),
            ("pylorus", Box::new(|place| place.x < -64.0)),
        ],
        chart: sides(extent),
    }
}
