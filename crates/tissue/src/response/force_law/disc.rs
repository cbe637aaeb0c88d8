//! The disc that presses on a tissue, and its place.

use glam::DVec3;

use crate::response::representative_place::place_alike;
use crate::{Model, ToolContact};

/// Distance from the surface, in radii, beyond which a tool needs no law of its place.
const NEAR_IN_RADII: f64 = 4.0;

/// Distance, in radii, up to which the law of a place serves a tool.
const SERVES_IN_RADII: f64 = 0.5;

/// A disc that presses on a tissue, and the place at rest where it presses: that of which a force law is computed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Disc {
    /// Radius of the disc, m.
    pub radius_m: f64,
    /// Middle of the disc at rest, m, in the tissue's frame. The disc is at the place of the rest surface nearest to
    /// this.
    pub at_m: DVec3,
}

impl Disc {
    /// Returns the disc of `radius_m` (m) in the middle of the box around the tissue at rest: of a sheet, its middle;
    /// of a mesh, the place nearest to the middle of the box.
    pub fn in_middle(model: &Model, radius_m: f64) -> Self {
        Disc { radius_m, at_m: model.shape().extent().middle_m() }
    }

    /// Returns the rest position of the tissue that a tool with this disc and the contact `feel` presses or is about
    /// to press ([`ToolContact::anchor_m`]), m; `None` if the tool is more than 4 radii from the surface under it.
    /// This is not the place nearest to the tool: deep in a curved or folded tissue, another part may be nearer.
    pub fn pressed_m(&self, feel: &ToolContact) -> Option<DVec3> {
        let is_near = feel.place_m.distance(feel.surface_m) <= NEAR_IN_RADII * self.radius_m;
        is_near.then_some(feel.anchor_m)
    }

    /// Returns the disc whose law serves a tool that presses the tissue resting at `rest_m` (m,
    /// [`Disc::pressed_m`]): `self` while the representative of that place ([`place_alike`]) is at most half a radius
    /// from [`Disc::at_m`], otherwise the disc of the same radius at that representative. So a tool that moves back
    /// and forth between two near places keeps the law of the first. To be followed, [`Disc::at_m`] should be a
    /// representative itself.
    #[must_use]
    pub fn follow(self, model: &Model, rest_m: DVec3) -> Self {
        let at_m = place_alike(model, self.radius_m, rest_m);
        if at_m.distance(self.at_m) <= SERVES_IN_RADII * self.radius_m { self } else { Disc { at_m, ..self } }
    }
}

#[cfg(test)]
mod tests {
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
            exact_within(&model, disc, u64::MAX, &AtomicBool::new(false)).unwrap()
        };
        let alike = |at_m: DVec2| place_alike(&model, RADIUS_M, at_m.extend(-0.003)).truncate();
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
}
