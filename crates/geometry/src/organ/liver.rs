//! A liver: a thick right lobe and a thin left one under one dome, hollow beneath, with a thin rim in front.

use glam::{BVec3, DVec2, DVec3};

use super::field::{Unevenness, bump, capsule, difference, ellipsoid, intersection, union};
use super::shape::{Shape, sides};
use crate::dice::Dice;

/// Returns the shape of the liver. x points to the body's left, y to its back, z up.
pub(super) fn shape(dice: &mut Dice) -> Shape {
    let right = DVec3::new(58.0 * dice.factor(0.06), 62.0 * dice.factor(0.06), 58.0 * dice.factor(0.08));
    let left = DVec3::new(66.0 * dice.factor(0.1), 42.0 * dice.factor(0.1), 25.0 * dice.factor(0.1));
    let (right_centre, left_centre) = (DVec3::new(-34.0, 4.0, -12.0), DVec3::new(24.0, -6.0, 4.0));
    // The underside is part of a large ball's surface: it faces down, back and left.
    let down = DVec3::new(0.26 * dice.factor(0.2), 0.46 * dice.factor(0.12), -0.85).normalize_or_zero();
    let hollow = dice.within(170.0, 260.0);
    let under = DVec3::new(-30.0, 0.0, -24.0 + dice.within(-4.0, 4.0)) + down * hollow;
    // Grooves of the underside, seen from below: the fissure between the lobes, the bed of the gallbladder, and the porta
    // between them; ends, depth and half the width.
    let notch = dice.within(8.0, 18.0);
    let (front, back) = (DVec2::new(notch, -80.0), DVec2::new(notch - 3.0, 14.0));
    let grooves = [
        (front, back, 8.5 * dice.factor(0.2), 14.0),
        (DVec2::new(-29.0, -80.0), DVec2::new(-17.0, 8.0), 7.5 * dice.factor(0.2), 25.0),
        (DVec2::new(-18.0, 14.0), back, 4.0, 16.0),
    ];
    let cava = [DVec3::new(2.0, 66.0, -70.0), DVec3::new(-4.0, 60.0, 70.0)];
    let uneven = Unevenness::new(0.8, 46.0, dice);
    let dome =
        move |place: DVec3| union(ellipsoid(place, right_centre, right), ellipsoid(place, left_centre, left), 30.0);
    let underside = move |place: DVec3| {
        let depth = grooves.iter().map(|&(from, to, depth, half)| {
            let away = capsule(place.truncate().extend(0.0), from.extend(0.0), to.extend(0.0), 0.0);
            depth * bump(away / half)
        });
        hollow - (place - under).length() + depth.sum::<f64>()
    };
    let distance = move |place: DVec3| {
        let solid = intersection(dome(place), underside(place), 6.0);
        difference(solid, capsule(place, cava[0], cava[1], 13.0), 8.0) - uneven.at(place)
    };
    let extent = [DVec3::new(-106.0, -80.0, -82.0), DVec3::new(106.0, 84.0, 66.0)];
    Shape {
        distance: Box::new(distance),
        extent,
        cut: BVec3::FALSE,
        cell: 2.5,
        coarsest: 8.0,
        parts: vec![
            ("rim", Box::new(move |place| place.y < 10.0 && dome(place) > -9.0 && underside(place) > -9.0)),
            ("visceral", Box::new(move |place| underside(place) > -3.0)),
            ("bare-area", Box::new(|place| place.y > 34.0 && place.z > -16.0)),
        ],
        chart: sides(extent),
    }
}
