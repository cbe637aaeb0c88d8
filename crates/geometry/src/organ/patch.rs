//! A slightly curved square of tissue, raised by lumps beneath.

use glam::{BVec3, DVec2, DVec3};

use super::field::{Unevenness, bump};
use super::shape::{Shape, sides};
use crate::dice::Dice;

/// Half its side, mm.
const HALF: f64 = 50.0;

/// A rise above a lump.
struct Rise {
    centre: DVec2,
    radius: f64,
    height: f64,
}

/// Returns the shape of the patch. It extends along x and y; the side to touch is above (z).
pub(super) fn shape(dice: &mut Dice) -> Shape {
    let curvature = dice.within(1.0 / 500.0, 1.0 / 260.0);
    // One rise in each third of the patch, so that they stay apart.
    let rises = [-1.0, 0.0, 1.0].map(|third| Rise {
        centre: DVec2::new(27.0 * third + dice.within(-3.0, 3.0), dice.within(-28.0, 28.0)),
        radius: dice.within(8.0, 13.0),
        height: dice.within(1.4, 2.8),
    });
    let within = rises.iter().map(|rise| (rise.centre, rise.radius)).collect::<Vec<_>>();
    let uneven = Unevenness::new(0.35, 38.0, dice);
    let distance = move |place: DVec3| {
        let flat = place.truncate();
        let above = |rise: &Rise| rise.height * bump((flat - rise.centre).length() / (1.5 * rise.radius));
        let height = rises.iter().map(above).sum::<f64>() - 0.5 * curvature * flat.length_squared();
        place.z - height - uneven.at(flat.extend(0.0))
    };
    let extent = [DVec3::new(-HALF, -HALF, -20.0), DVec3::new(HALF, HALF, 13.0)];
    Shape {
        distance: Box::new(distance),
        extent,
        cut: BVec3::new(true, true, false),
        cell: 3.0,
        coarsest: 10.0,
        parts: vec![(
            "lumps",
            Box::new(move |place| within.iter().any(|lump| (place.truncate() - lump.0).length() < lump.1)),
        )],
        chart: sides(extent),
    }
}
