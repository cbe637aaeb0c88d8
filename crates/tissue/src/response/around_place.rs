//! Reads the reaction to a force around a place that need not be a mass point.

use glam::DVec3;

use crate::scene::profile::Poke;
use crate::shape::{PointId, RestShape};

/// The exponent of a weight beyond which a point does not count.
const MIN_EXPONENT: f64 = 7.0;

/// The smallest and the largest radius of the surroundings, in spacings. The largest bounds the work; within
/// the smallest there is always a point.
const RADIUS: [f64; 2] = [1.5, 4.0];

/// Returns the weighted mean reaction around the centre of a force, N, from that of points. The weights are those of the
/// force, reduced smoothly to 0 at a radius, so that no point enters or leaves with a jump.
pub(crate) fn reaction_around(shape: &dyn RestShape, poke: &Poke, reaction_n: impl Fn(PointId) -> DVec3) -> DVec3 {
    let [least, most] = RADIUS.map(|spacings| spacings * shape.edge_m());
    let radius_m = (MIN_EXPONENT / poke.falloff_per_m).clamp(least, most);
    let (mut sum_n, mut weights) = (DVec3::ZERO, 0.0);
    for point in shape.around(poke.centre_m, radius_m) {
        let away_m = shape.rest_m(point).distance(poke.centre_m);
        let taper = 1.0 - (away_m / radius_m).powi(2);
        if taper > 0.0 {
            let weight = libm::exp(-poke.falloff_per_m * away_m) * taper * taper;
            sum_n += weight * reaction_n(point);
            weights += weight;
        }
    }
    // A place off the tissue may have no point around it.
    if weights > 0.0 { sum_n / weights } else { reaction_n(shape.nearest(poke.centre_m)) }
}
