//! Reads the surroundings of a place that need not be a mass point: the displacement of the surface there, and
//! the reaction to a force around it.

use glam::DVec3;

use crate::Tissue;
use crate::kernel::real::Real;
use crate::scene::profile::Poke;
use crate::state::tissue_state::TissueState;
use crate::tools::contact::displacement_m;

/// The exponent of a weight beyond which a point does not count.
const MIN_EXPONENT: f64 = 7.0;

/// The smallest and the largest radius of the surroundings, in spacings. The largest bounds the work; within
/// the smallest there is always a point.
const RADIUS: [f64; 2] = [1.5, 4.0];

impl<T: Real> TissueState<T> {
    /// Returns the displacement of the surface at a place, m ([`RestShape::interpolate`](crate::shape::RestShape)).
    pub(crate) fn surface_displacement(&self, place_m: DVec3) -> DVec3 {
        let displacement_m = |point| {
            let place = self.model.point_of(self.model.place_of(point));
            displacement_m(&self.model, &self.tables.layout, &self.state, place)
        };
        self.model.shape().interpolate(place_m, &displacement_m)
    }

    /// Returns the weighted mean reaction around the centre of a force, N. The weights are those of the force,
    /// reduced smoothly to 0 at a radius, so that no point enters or leaves with a jump.
    pub(crate) fn reaction_around(&self, poke: &Poke) -> DVec3 {
        let shape = self.model.shape();
        let [least, most] = RADIUS.map(|spacings| spacings * shape.edge_m());
        let radius_m = (MIN_EXPONENT / poke.falloff_per_m).clamp(least, most);
        let (mut sum_n, mut weights) = (DVec3::ZERO, 0.0);
        for point in shape.around(poke.centre_m, radius_m) {
            let away_m = shape.rest_m(point).distance(poke.centre_m);
            let taper = 1.0 - (away_m / radius_m).powi(2);
            if taper > 0.0 {
                let weight = libm::exp(-poke.falloff_per_m * away_m) * taper * taper;
                sum_n += weight * self.point(point).reaction_n();
                weights += weight;
            }
        }
        // A place off the tissue may have no point around it.
        if weights > 0.0 { sum_n / weights } else { self.point(shape.nearest(poke.centre_m)).reaction_n() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Grasp, Model};

    #[test]
    fn the_reaction_around_a_place_changes_without_a_jump_as_the_place_moves() {
        let model = Model::paper(&[
            "sheet.points=[25, 25]",
            "stepping.precision=f64",
            "stepping.integrator=central",
            "stepping.substeps=1",
        ]);
        let mut sheet = TissueState::<f64>::new(&model);
        let (shape, edge_m) = (model.shape(), model.shape().edge_m());
        let middle_m = 12.0 * edge_m * DVec3::new(1.0, 1.0, 0.0);
        sheet.grasp(0, shape.nearest(middle_m), Grasp::Target(0.5 * edge_m * DVec3::Z));
        for _ in 0..5 {
            sheet.step().unwrap();
        }
        // One force that hardly falls off within the surroundings, and one that does.
        for falloff_per_m in [0.1 / edge_m, 2.0 / edge_m] {
            let reaction_n = |step: u32| {
                let centre_m = middle_m + f64::from(step) * 0.005 * edge_m * DVec3::new(0.8, 0.6, 0.0);
                let force_n = DVec3::Z;
                sheet.reaction_around(&Poke { point: None, centre_m, force_n, falloff_per_m, falloff_offset: 0.0 })
            };
            let along: Vec<DVec3> = (0..1200).map(reaction_n).collect();
            let largest_n = along.iter().map(|force_n| force_n.length()).fold(0.0, f64::max);
            let jump_n = along.windows(2).map(|pair| pair[0].distance(pair[1])).fold(0.0, f64::max);
            assert!(largest_n > 1e-3 && jump_n < 0.02 * largest_n, "{falloff_per_m}: {jump_n} of {largest_n} N");
        }
    }
}
