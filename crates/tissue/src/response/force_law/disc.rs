//! The disc that presses on a tissue, and its place.

use glam::DVec3;

use crate::body::window::half_window_m;
use crate::{Cuts, Model, ToolContact};

/// Distance from the surface, in radii, beyond which a tool needs no law of its place.
const NEAR_IN_RADII: f64 = 4.0;

/// Distance, in radii, up to which the law of a place serves a tool; and near a cut.
const SERVES_IN_RADII: f64 = 0.5;
const SERVES_NEAR_CUTS_IN_RADII: f64 = 0.25;

/// Distance from a disc on a solid, in radii, up to which its law is that of the tissue with the cuts there: a load that falls as 1/r
/// hardly notices others.
const NOTICES_IN_RADII: f64 = 8.0;

/// A disc that presses on a tissue, and the place at rest where it presses: that of which a force law is computed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Disc {
    /// Radius of the disc, m.
    pub radius_m: f64,
    /// Middle of the disc at rest, m, in the tissue's frame. The disc is at the place of the rest surface nearest to
    /// this.
    pub at_m: DVec3,
}

/// Returns the representative of the place `at_m` (m, in the tissue's frame) for a disc of `radius_m` (m): a place at
/// rest with the same force law, m ([`RestShape::representative_m`](crate::shape::RestShape::representative_m)).
fn representative_m(model: &Model, radius_m: f64, at_m: DVec3) -> DVec3 {
    model.shape().representative_m(radius_m, half_window_m(model, radius_m), at_m)
}

impl Disc {
    /// Returns the disc of `radius_m` (m) that stands for the tissue ([`RestShape::pressed_m`]): in the middle of a sheet; on
    /// a mesh, at the place nearest to the middle of the box around it; on top of a solid.
    ///
    /// [`RestShape::pressed_m`]: crate::shape::RestShape::pressed_m
    pub fn in_middle(model: &Model, radius_m: f64) -> Self {
        Disc { radius_m, at_m: model.shape().pressed_m() }
    }

    /// Returns the rest position of the tissue that a tool with this disc and the contact `feel` presses or is about
    /// to press ([`ToolContact::anchor_m`]), m; `None` if the tool is more than 4 radii from the surface under it.
    /// This is not the place nearest to the tool: deep in a curved or folded tissue, another part may be nearer.
    pub fn pressed_m(&self, feel: &ToolContact) -> Option<DVec3> {
        let is_near = feel.place_m.distance(feel.surface_m) <= NEAR_IN_RADII * self.radius_m;
        is_near.then_some(feel.anchor_m)
    }

    /// Returns whether the law of this disc differs from that of the whole tissue: whether anything is severed, or stiffer by a burn, at most half
    /// as far from its rim as points notice a press, which is e⁻⁶ of the stiffness on anchor springs, in a solid 8 radii.
    pub fn notices(&self, model: &Model, cuts: &Cuts) -> bool {
        let beyond_m = 0.5 * (half_window_m(model, self.radius_m) - self.radius_m);
        let most_m = NOTICES_IN_RADII * self.radius_m;
        let within_m = self.radius_m + if model.places.solid().is_some() { most_m } else { beyond_m };
        cuts.are_near(model, self.at_m, within_m)
    }

    /// Returns the disc whose law serves a tool that presses the tissue resting at `rest_m` (m, [`Disc::pressed_m`]), in a tissue with cuts,
    /// and whether that law is of the cut tissue ([`Disc::notices`]): then the disc is at that place, or at most a quarter of a radius away.
    #[must_use]
    pub fn follow_cut(self, model: &Model, cuts: &Cuts, rest_m: DVec3) -> (Self, bool) {
        let there = Disc { at_m: rest_m, ..self };
        if !there.notices(model, cuts) {
            return (self.follow(model, rest_m), false);
        }
        let is_near = rest_m.distance(self.at_m) <= SERVES_NEAR_CUTS_IN_RADII * self.radius_m;
        (if is_near { self } else { there }, true)
    }

    /// Returns the disc whose law serves a tool that presses a whole tissue resting at `rest_m` (m,
    /// [`Disc::pressed_m`]): `self` while the representative of that place ([`representative_m`]) is at most half a radius
    /// from [`Disc::at_m`], otherwise the disc of the same radius at that representative. So a tool that moves back
    /// and forth between two near places keeps the law of the first. To be followed, [`Disc::at_m`] should be a
    /// representative itself.
    #[must_use]
    pub fn follow(self, model: &Model, rest_m: DVec3) -> Self {
        let at_m = representative_m(model, self.radius_m, rest_m);
        if at_m.distance(self.at_m) <= SERVES_IN_RADII * self.radius_m { self } else { Disc { at_m, ..self } }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::AtomicBool;

    use glam::DVec2;

    use super::super::exact_within;
    use super::*;

    const RADIUS_M: f64 = 0.02;

    /// The law at the place that serves is that of the place itself, and at a rim it is another one, as the tissue is.
    #[test]
    fn laws_differ_at_a_rim_as_the_tissue_does_and_nowhere_else() {
        let model = Model::paper(&["sheet.points=[21, 21]", "sheet.spacing_m=0.01", "sheet.fixed=\"edges\""]);
        let law = |at_m: DVec2| {
            let disc = Disc { radius_m: RADIUS_M, at_m: at_m.extend(0.0) };
            exact_within(&model, &Cuts::default(), disc, u64::MAX, &AtomicBool::new(false)).unwrap()
        };
        let alike = |at_m: DVec2| representative_m(&model, RADIUS_M, at_m.extend(-0.003)).truncate();
        let middle = law(DVec2::splat(0.1));
        // At the first the law of the middle serves.
        for (x_m, most) in [(0.08, 2e-3), (0.06, 5e-3), (0.03, 5e-3)] {
            let (own, other) = (law(DVec2::new(x_m, 0.11)), law(alike(DVec2::new(x_m, 0.11))));
            for depth_m in [0.01, 0.03, 0.06] {
                let [own_n, other_n] = [&own, &other].map(|law| law.at_depth(depth_m).force_n);
                assert!((own_n / other_n - 1.0).abs() < most, "{x_m}, {depth_m} m deep: {own_n} {other_n}");
            }
        }
        let rim = law(alike(DVec2::new(RADIUS_M, 0.1)));
        assert!(rim.at_depth(0.03).force_n > 1.1 * middle.at_depth(0.03).force_n);
    }

    /// A sheet of 31 × 41 points, 10 mm apart, that is noticed over 3 points: its rim counts for 110 mm.
    fn held(fixed: &str) -> Arc<Model> {
        let sets = ["sheet.points=[31, 41]", "sheet.spacing_m=0.01", "anchor_springs.stiffness_n_per_m=1.1112", fixed];
        Model::paper(&sets)
    }

    fn served(model: &Model, x_m: f64, y_m: f64) -> DVec2 {
        representative_m(model, RADIUS_M, DVec3::new(x_m, y_m, -0.003)).truncate()
    }

    fn assert_at(found_m: DVec2, x_m: f64, y_m: f64) {
        assert!(found_m.distance(DVec2::new(x_m, y_m)) < 1e-12, "{found_m} is not at ({x_m}, {y_m})");
    }

    #[test]
    fn all_places_far_from_the_rim_have_the_law_of_the_middle() {
        for fixed in ["sheet.fixed=\"edges\"", "sheet.fixed=\"corners\"", "sheet.fixed=[]"] {
            let model = held(fixed);
            for (x_m, y_m) in
                [(0.15, 0.2), (0.152, 0.199), (0.125, 0.2), (0.15, 0.275), (0.1234, 0.1567), (0.175, 0.27)]
            {
                assert_at(served(&model, x_m, y_m), 0.15, 0.2);
            }
        }
    }

    #[test]
    fn at_a_rim_its_distance_alone_counts_wherever_along_it_and_on_whatever_side() {
        let model = held("sheet.fixed=\"edges\"");
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
        let model = held("sheet.fixed=[[18, 24]]");
        assert_at(served(&model, 0.18, 0.22), 0.18, 0.22);
        assert_at(served(&model, 0.21, 0.262), 0.21, 0.26);
        // Far from them one side is as another.
        assert_at(served(&model, 0.25, 0.05), 0.05, 0.05);
    }

    #[test]
    fn a_disc_smaller_than_a_cell_feels_where_in_the_cell_it_is() {
        let model = held("sheet.fixed=\"edges\"");
        let places = [(0.15, 0.2), (0.1525, 0.2), (0.155, 0.2025), (0.145, 0.1975), (0.185, 0.2425)];
        let served = places.map(|(x_m, y_m)| representative_m(&model, 0.005, DVec3::new(x_m, y_m, 0.0)).truncate());
        assert_at(served[0], 0.15, 0.2);
        assert_at(served[1], 0.1475, 0.2);
        served[3..].iter().for_each(|place_m| assert_at(*place_m, served[2].x, served[2].y));
    }
}
