//! Finds the representative of a place on a sheet: a place where a disc meets the sheet in the same way, so that
//! results for the one serve the other.
//!
//! A sheet is the same everywhere except near its rim and its fixed points, so the representative has the same distance
//! to the nearer rim along each side. The effect of a disc on a rim travels back to the disc, so the distance counts
//! twice. From half the distance at which a disc is noticed, the rim makes no difference, and the middle represents all
//! places, as they lie in a cell of the grid.

use glam::DVec2;

use super::{FixedPoints, Sheet};
use crate::shape::RestShape;

/// Places on a raster of this part of the radius have force laws of their own. The raster contains the points
/// of the sheet, or some of them.
const APART_IN_RADII: f64 = 0.5;

/// Returns the representative of the place `at_m` for a disc of `radius_m`, m: a place of a raster of at most half the
/// radius, with the same distances to the rims that count, those nearer than ½(a + r), with a the radius and r the
/// distance `noticed_m` at which the disc is noticed. A place within a radius of a rim counts as one radius away; near
/// listed fixed points each place of the raster represents itself.
pub(super) fn of(sheet: &Sheet, radius_m: f64, noticed_m: f64, at_m: DVec2) -> DVec2 {
    let far_m = 0.5 * (radius_m + noticed_m);
    let at_m = on_sheet(sheet, radius_m, at_m);
    let folded_m = folded(sheet, radius_m, far_m, at_m);
    // Listed fixed points are irregular: near them each place has its own law.
    let is_plain = |at_m: DVec2| match &sheet.fixed {
        FixedPoints::Edges | FixedPoints::Corners => true,
        FixedPoints::Points(points) => points.as_slice().iter().all(|place| {
            let fixed_m = sheet.rest_m(sheet.point(*place)).truncate();
            (fixed_m - at_m).abs().max_element() >= far_m
        }),
    };
    if is_plain(at_m) && is_plain(folded_m) { folded_m } else { rounded(sheet, radius_m, at_m) }
}

/// Returns the nearest place where a disc does not extend over the rim, if there is one. Over a fixed rim a tip
/// slides off: the law of a disc that sticks there would be many times too stiff.
fn on_sheet(sheet: &Sheet, radius_m: f64, at_m: DVec2) -> DVec2 {
    let middle_m = 0.5 * sheet.extent_m();
    let most_m = (middle_m - radius_m).max(DVec2::ZERO);
    middle_m + (at_m - middle_m).clamp(-most_m, most_m)
}

/// Returns the place with the same distances to the rims within `far_m` as `at_m`, as near to the middle as
/// possible.
fn folded(sheet: &Sheet, radius_m: f64, far_m: f64, at_m: DVec2) -> DVec2 {
    let (extent_m, spacing_m) = (sheet.extent_m(), sheet.spacing_m);
    let middle_m = 0.5 * extent_m;
    let mut inward_m = (rounded(sheet, radius_m, at_m) - middle_m).abs();
    for axis in 0..2 {
        if middle_m[axis] - (at_m - middle_m)[axis].abs() >= far_m {
            // By whole cells.
            inward_m[axis] = (inward_m[axis] - spacing_m * (inward_m[axis] / spacing_m).round()).abs();
        }
    }
    let folded_m = middle_m - inward_m;
    // Both sides of a square are alike.
    let is_square = sheet.points[0] == sheet.points[1];
    if is_square { DVec2::new(folded_m.min_element(), folded_m.max_element()) } else { folded_m }
}

/// Returns the nearest place on the raster around the middle. All points of the sheet lie alike on it.
fn rounded(sheet: &Sheet, radius_m: f64, at_m: DVec2) -> DVec2 {
    let points = APART_IN_RADII * radius_m / sheet.spacing_m;
    let raster_m = sheet.spacing_m * if points >= 1.0 { points.floor() } else { points.recip().ceil().recip() };
    let middle_m = 0.5 * sheet.extent_m();
    middle_m + raster_m * ((at_m - middle_m) / raster_m).round()
}
