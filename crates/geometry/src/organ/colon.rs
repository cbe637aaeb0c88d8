//! A segment of colon as an endoscope sees it: a wall that faces inward, with three bands along it and crescent folds
//! between them. It is one layer, open at both ends: the outside of the wall is not touched, and would double the
//! vertices.

use std::f64::consts::TAU;

use glam::{BVec3, DVec2, DVec3};

use super::field::{Unevenness, bump, step};
use super::shape::{Chart, Shape};
use crate::dice::Dice;

/// Its length along x, mm.
const LENGTH: f64 = 200.0;

/// A fold between two bands.
struct Fold {
    /// Its position along x, mm.
    along: f64,
    /// The direction to its middle.
    side: DVec2,
    /// Height of its crest above the wall, mm.
    height: f64,
    /// Half its thickness at the foot, mm.
    half: f64,
}

/// Returns the shape of the colon. It lies along x.
pub(super) fn shape(dice: &mut Dice) -> Shape {
    let radius = 25.0 * dice.factor(0.1);
    let (sway, phase) = (dice.within(2.0, 6.0), dice.within(0.0, TAU));
    let centre =
        move |x: f64| DVec2::new(sway * libm::sin(TAU * x / LENGTH + phase), 0.6 * sway * libm::cos(TAU * x / LENGTH));
    let turned = dice.within(0.0, TAU);
    let direction = |angle: f64| DVec2::new(libm::cos(angle), libm::sin(angle));
    let bands = [0.0, 1.0, 2.0].map(|third| direction(turned + third * TAU / 3.0));
    let spacing = dice.within(25.0, 30.0);
    let mut folds = Vec::new();
    for third in 0..3 {
        let mut along = 8.0 + spacing * (f64::from(third) / 3.0 + 0.4);
        while along < LENGTH - 15.0 {
            folds.push(Fold {
                along,
                side: direction(turned + (f64::from(third) + 0.5 + dice.within(-0.06, 0.06)) * TAU / 3.0),
                height: dice.within(7.0, 9.5),
                half: dice.within(9.0, 10.5),
            });
            along += spacing * dice.factor(0.12);
        }
    }
    let uneven = Unevenness::new(0.4, 30.0, dice);
    let raised = move |place: DVec3| {
        let side = (DVec2::new(place.y, place.z) - centre(place.x)).normalize_or_zero();
        // Crescents: highest in their middle, and vanishing at the bands.
        let crest = |fold: &Fold| {
            let near = bump((place.x - fold.along) / fold.half);
            if near > 0.0 { fold.height * near * step(0.4, 0.85, side.dot(fold.side)) } else { 0.0 }
        };
        let band = |band: &DVec2| 1.6 * bump((1.0 - side.dot(*band)) / 0.035);
        (folds.iter().map(crest).sum::<f64>(), bands.iter().map(band).sum::<f64>())
    };
    let raised = std::rc::Rc::new(raised);
    let fold = raised.clone();
    let distance = move |place: DVec3| {
        let (folds, bands) = raised(place);
        radius - folds - bands + uneven.at(place) - (DVec2::new(place.y, place.z) - centre(place.x)).length()
    };
    let side = radius + 14.0;
    Shape {
        distance: Box::new(distance),
        extent: [DVec3::new(0.0, -side, -side), DVec3::new(LENGTH, side, side)],
        cut: BVec3::new(true, false, false),
        cell: 2.5,
        coarsest: 6.0,
        parts: vec![("folds", Box::new(move |place| fold(place).0 > 3.0))],
        chart: around(centre, radius),
    }
}

/// Returns texture coordinates around an axis and along x: u from 0 to 1 is one turn, v has an equal scale. Where the
/// wall closes, u continues beyond 1.
fn around(centre: impl Fn(f64) -> DVec2 + 'static, radius: f64) -> Chart {
    Box::new(move |corners| {
        let turns = corners.map(|place| {
            let side = DVec2::new(place.y, place.z) - centre(place.x);
            // Seen from inside, the image is not mirrored.
            0.5 - libm::atan2(side.y, side.x) / TAU
        });
        let greatest = turns.iter().copied().fold(0.0, f64::max);
        [0, 1, 2].map(|corner| {
            let turn = turns[corner];
            let u = if greatest - turn > 0.5 { turn + 1.0 } else { turn };
            [u as f32, (corners[corner].x / (TAU * radius)) as f32]
        })
    })
}
