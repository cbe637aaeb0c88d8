//! Finds the representative of a place: a place where a disc meets the tissue in the same way, so that results
//! for the one serve the other.
//!
//! On a mesh this is the nearest vertex. A sheet is the same everywhere except near its rim and its fixed
//! points, so its representative has the same distance to the nearer rim along each side. The effect of a disc
//! on a rim travels back to the disc, so the distance counts twice. From half the distance at which a disc is
//! noticed (`tangent::half_window_m`), the rim makes no difference, and the middle represents all places, as
//! they lie in a cell of the grid.

use glam::{DVec2, DVec3};

use crate::model::Model;
use crate::response::tangent;
use crate::scene::{FixedPoints, Sheet};
use crate::shape::RestShape;

/// Places on a raster of this part of the radius have force laws of their own. The raster contains the points
/// of the sheet, or some of them.
const APART_IN_RADII: f64 = 0.5;

/// Returns the representative, at rest, of the place `at_m` (m, in the tissue's frame) for a disc of `radius_m` (m): a
/// place with the same force law, m. On a mesh, it is the vertex nearest to `at_m`. On a sheet, it is a place of a
/// raster of at most half the radius, at z = 0, with the same distances to the rims that count: those nearer than
/// ½(a + r), with a the radius and r the distance at which the disc is noticed ([`tangent::half_window_m`]). A place
/// within a radius of a rim counts as one radius away; near listed fixed points each place of the raster represents
/// itself.
pub fn place_alike(model: &Model, radius_m: f64, at_m: DVec3) -> DVec3 {
    let Some(sheet) = model.scene.sheet() else {
        let shape = model.shape();
        return shape.rest_m(shape.nearest(at_m));
    };
    let far_m = 0.5 * (radius_m + tangent::half_window_m(model, radius_m));
    let at_m = on_sheet(sheet, radius_m, at_m.truncate());
    let folded_m = folded(sheet, radius_m, far_m, at_m);
    // Listed fixed points are irregular: near them each place has its own law.
    let is_plain = |at_m: DVec2| match &sheet.fixed {
        FixedPoints::Edges | FixedPoints::Corners => true,
        FixedPoints::Points(points) => points.as_slice().iter().all(|place| {
            let fixed_m = sheet.rest_m(sheet.point(*place)).truncate();
            (fixed_m - at_m).abs().max_element() >= far_m
        }),
    };
    let at_m = if is_plain(at_m) && is_plain(folded_m) { folded_m } else { rounded(sheet, radius_m, at_m) };
    at_m.extend(0.0)
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

#[cfg(test)]
mod tests {
    use super::*;

    /// A sheet of 31 × 41 points, 10 mm apart, that is noticed over 3 points: its rim counts for 110 mm.
    fn model(fixed: &str) -> std::sync::Arc<Model> {
        let sets = ["sheet.points=[31, 41]", "sheet.spacing_m=0.01", "anchor_springs.stiffness_n_per_m=1.1112", fixed];
        Model::paper(&sets)
    }

    const RADIUS_M: f64 = 0.02;

    fn served(model: &Model, x_m: f64, y_m: f64) -> DVec2 {
        place_alike(model, RADIUS_M, DVec3::new(x_m, y_m, -0.003)).truncate()
    }

    fn assert_at(found_m: DVec2, x_m: f64, y_m: f64) {
        assert!(found_m.distance(DVec2::new(x_m, y_m)) < 1e-12, "{found_m} is not at ({x_m}, {y_m})");
    }

    #[test]
    fn all_places_far_from_the_rim_have_the_law_of_the_middle() {
        for fixed in ["sheet.fixed=\"edges\"", "sheet.fixed=\"corners\"", "sheet.fixed=[]"] {
            let model = model(fixed);
            for (x_m, y_m) in
                [(0.15, 0.2), (0.152, 0.199), (0.125, 0.2), (0.15, 0.275), (0.1234, 0.1567), (0.175, 0.27)]
            {
                assert_at(served(&model, x_m, y_m), 0.15, 0.2);
            }
        }
    }

    #[test]
    fn at_a_rim_its_distance_alone_counts_wherever_along_it_and_on_whatever_side() {
        let model = model("sheet.fixed=\"edges\"");
        for (x_m, y_m) in [(0.04, 0.2), (0.042, 0.15), (0.26, 0.27), (0.259, 0.13)] {
            assert_at(served(&model, x_m, y_m), 0.04, 0.2);
        }
        // In a corner both distances do.
        for (x_m, y_m) in [(0.04, 0.06), (0.26, 0.06), (0.04, 0.34), (0.261, 0.339)] {
            assert_at(served(&model, x_m, y_m), 0.04, 0.06);
        }
        // Beside the sheet, or half on it, a disc lies at the rim.
        assert_at(served(&model, -0.02, 0.2), RADIUS_M, 0.2);
        assert_at(served(&model, 0.15, 0.47), 0.15, RADIUS_M);
        // The sides of a square are alike.
        let square = Model::paper(&["sheet.points=[41, 41]", "sheet.spacing_m=0.01"]);
        assert_at(served(&square, 0.2, 0.04), 0.04, 0.2);
        assert_at(served(&square, 0.36, 0.2), 0.04, 0.2);
    }

    #[test]
    fn near_fixed_points_that_are_named_each_place_has_its_own_law() {
        let model = model("sheet.fixed=[[18, 24]]");
        assert_at(served(&model, 0.18, 0.22), 0.18, 0.22);
        assert_at(served(&model, 0.21, 0.262), 0.21, 0.26);
        // Far from them one side is as another.
        assert_at(served(&model, 0.25, 0.05), 0.05, 0.05);
    }

    #[test]
    fn a_disc_smaller_than_a_cell_feels_where_in_the_cell_it_is() {
        let model = model("sheet.fixed=\"edges\"");
        let places = [(0.15, 0.2), (0.1525, 0.2), (0.155, 0.2025), (0.145, 0.1975), (0.185, 0.2425)];
        let served = places.map(|(x_m, y_m)| place_alike(&model, 0.005, DVec3::new(x_m, y_m, 0.0)).truncate());
        assert_at(served[0], 0.15, 0.2);
        assert_at(served[1], 0.1475, 0.2);
        served[3..].iter().for_each(|place_m| assert_at(*place_m, served[2].x, served[2].y));
    }
}
