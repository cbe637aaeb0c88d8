//! Where a tool of finite size meets the sheet: a disc of stated radius, spread over the mass points around it.
//!
//! The surface between points is bilinear: the material place c (in the rest plane) is at Σ N_p(c)·x_p, N_p the bilinear
//! hats. A disc of radius a about c averages that over its area, s(c) = Σ w_p·x_p with w_p = ⨍ N_p; the weights add up
//! to 1 and their centre is c exactly. A tool moves s, and its force goes to the points with the same weights, so its
//! work is force · ds. With a single point instead, the stiffness would fall without limit as the grid gets finer; with
//! the disc it converges.
//!
//! The hats blur the disc: under even pressure it would act as if larger, by much where the grid is coarse. The area
//! that matters is the A = h²/Σ w² that shares a force: a foundation of k″ N/m³ has the stiffness k″·A under the disc.
//! So the hats are averaged over a smaller disc, chosen so that A is that of the requested disc, in the mean over its
//! places in a cell. From two spacings across on that is exact; below, the hats alone are too large.
//!
//! The integral is a sum over rings of equal area, each with points at equal angles: sums of first powers vanish, and
//! sums of second powers are the same in every direction.

use std::f64::consts::TAU;

use glam::{DVec2, DVec3};

use super::model::Model;
use crate::scene::Sheet;

/// Least number of rings in a disc; larger discs have two per spacing.
const LEAST_RINGS: f64 = 6.0;

/// Each ring is rotated against the one before, so that hardly two places cross a grid line at once. The slope of the
/// surface jumps at each crossing; this makes the sum change smoothly.
const GOLDEN: f64 = 0.618_033_988_749_895;

/// Most rings. Beyond, a spacing has fewer than two, which makes no difference to a disc that large.
const MOST_RINGS: f64 = 16.0;

/// A disc on a sheet, at a place. Lengths in m.
#[derive(Debug, Clone)]
pub struct Footprint {
    radius_m: f64,
    /// Radius of the disc that the hats are averaged over.
    drawn_m: f64,
    /// Sample places of the sum, from the centre.
    offsets_m: Vec<DVec2>,
    centre_m: DVec2,
    reached: Vec<Reached>,
    /// Scratch memory for the sums of a rectangle of points.
    sums: Vec<(f64, DVec2)>,
    /// Σ w² over the points that can move.
    mobility: f64,
}

/// A mass point that a disc covers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reached {
    /// Its indices in the grid.
    pub point: [usize; 2],
    /// Whether it is not fixed.
    pub free: bool,
    /// w.
    pub weight: f64,
    /// ∂w/∂c, 1/m.
    pub gradient: DVec2,
}

impl Footprint {
    /// A disc of `radius_m` about `centre_m`, which is moved onto the sheet if it is beside it.
    pub fn new(model: &Model, radius_m: f64, centre_m: DVec2) -> Self {
        let spacing_m = model.unit_m;
        let drawn = drawn_radius(radius_m / spacing_m);
        let mut footprint = Footprint {
            radius_m,
            drawn_m: drawn * spacing_m,
            offsets_m: disc(drawn).into_iter().map(|offset| offset * spacing_m).collect(),
            centre_m,
            reached: Vec::new(),
            sums: Vec::new(),
            mobility: 0.0,
        };
        footprint.move_to(model, centre_m);
        footprint
    }

    /// The radius, m.
    pub fn radius_m(&self) -> f64 {
        self.radius_m
    }

    /// The material place of the centre, m.
    pub fn centre_m(&self) -> DVec2 {
        self.centre_m
    }

    /// Moves the disc to another material place.
    pub fn move_to(&mut self, model: &Model, centre_m: DVec2) {
        // Tools with a tip are refused on a mesh.
        let Some(sheet) = model.scene.sheet() else { return };
        let centre_m = centre_m.clamp(DVec2::ZERO, sheet.extent_m());
        if !self.reached.is_empty() && centre_m == self.centre_m {
            return;
        }
        self.centre_m = centre_m;
        let (mut origin, mut size) = ([0; 2], [0; 2]);
        for axis in 0..2 {
            let (low, _) = cell(sheet, axis, centre_m[axis] - self.drawn_m);
            let (high, _) = cell(sheet, axis, centre_m[axis] + self.drawn_m);
            origin[axis] = low;
            size[axis] = (high + 2).min(sheet.points[axis]) - low;
        }
        self.sums.clear();
        self.sums.resize(size[0] * size[1], (0.0, DVec2::ZERO));
        #[allow(clippy::cast_precision_loss)]
        let share = 1.0 / self.offsets_m.len() as f64;
        for offset in &self.offsets_m {
            let at = centre_m + *offset;
            let [(i, x), (j, y)] = [cell(sheet, 0, at.x), cell(sheet, 1, at.y)];
            // Outside the sheet, the surface continues level from its edge.
            let slope = |axis: usize| {
                let inside = at[axis] >= 0.0 && at[axis] <= sheet.extent_m()[axis] && sheet.points[axis] > 1;
                if inside { share / sheet.spacing_m } else { 0.0 }
            };
            let (slope_x, slope_y) = (slope(0), slope(1));
            for (di, wx, sx) in [(0, 1.0 - x, -slope_x), (1, x, slope_x)] {
                for (dj, wy, sy) in [(0, 1.0 - y, -slope_y), (1, y, slope_y)] {
                    let [row, column] = [i + di - origin[0], j + dj - origin[1]];
                    // A sheet of one row has no next row.
                    if row < size[0] && column < size[1] {
                        let sum = &mut self.sums[row * size[1] + column];
                        sum.0 += share * wx * wy;
                        sum.1 += DVec2::new(sx * wy, wx * sy);
                    }
                }
            }
        }
        self.reached.clear();
        let sums = self.sums.iter().enumerate().filter(|(_, sum)| sum.0 != 0.0);
        self.reached.extend(sums.map(|(at, &(weight, gradient))| {
            let point = [origin[0] + at / size[1], origin[1] + at % size[1]];
            let free = model.fixed.is_empty() || model.fixed.binary_search(&model.index_of(point)).is_err();
            Reached { point, free, weight, gradient }
        }));
        self.mobility = self.reached.iter().filter(|point| point.free).map(|point| point.weight * point.weight).sum();
    }

    /// The points that the disc covers.
    pub fn reached(&self) -> &[Reached] {
        &self.reached
    }

    /// Σ w² over the points that can move: the movement of s per unit force, relative to that of one free point.
    pub fn mobility(&self) -> f64 {
        self.mobility
    }

    /// s, the place of the disc, in m, and ∂s/∂c, for points displaced by `displacement_m`.
    pub fn surface(&self, displacement_m: impl Fn([usize; 2]) -> DVec3) -> (DVec3, [DVec3; 2]) {
        let mut place = self.centre_m.extend(0.0);
        let mut along = [DVec3::X, DVec3::Y];
        for Reached { point, weight, gradient, .. } in &self.reached {
            let u = displacement_m(*point);
            place += *weight * u;
            along[0] += gradient.x * u;
            along[1] += gradient.y * u;
        }
        (place, along)
    }
}

/// Places spread evenly over a disc. All lengths in spacings.
fn disc(radius: f64) -> Vec<DVec2> {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let rings = (2.0 * radius).ceil().clamp(LEAST_RINGS, MOST_RINGS) as u32;
    let ring = |ring: u32| {
        let r = radius * ((f64::from(ring) + 0.5) / f64::from(rings)).sqrt();
        let count = 4 * rings;
        (0..count).map(move |k| {
            let angle = TAU * (f64::from(k) + GOLDEN * f64::from(ring + 1)) / f64::from(count);
            r * DVec2::new(libm::cos(angle), libm::sin(angle))
        })
    };
    (0..rings).flat_map(ring).collect()
}

/// The radius, in spacings, of the disc whose blurred weights have the area of a disc of `radius`.
fn drawn_radius(radius: f64) -> f64 {
    let (mut low, mut high) = (0.0, radius);
    for _ in 0..24 {
        let middle = 0.5 * (low + high);
        if shared_area(middle) < std::f64::consts::PI * radius * radius { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

/// 1/Σ w² on an infinite grid, in the mean over places in a cell, in spacings squared.
fn shared_area(radius: f64) -> f64 {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let (reach, offsets) = (radius.ceil() as usize + 2, disc(radius));
    let width = 2 * reach;
    let mut weights = vec![0.0; width * width];
    let mut sum = 0.0;
    let places = [0.0, 0.25, 0.5, 0.75];
    for place in places.iter().flat_map(|x| places.map(|y| DVec2::new(*x, y))) {
        weights.fill(0.0);
        for offset in &offsets {
            #[allow(clippy::cast_precision_loss)]
            let at = place + *offset + (reach as f64 - 1.0);
            let low = at.floor();
            let part = at - low;
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
            let first = low.x as usize * width + low.y as usize;
            weights[first] += (1.0 - part.x) * (1.0 - part.y);
            weights[first + 1] += (1.0 - part.x) * part.y;
            weights[first + width] += part.x * (1.0 - part.y);
            weights[first + width + 1] += part.x * part.y;
        }
        sum += weights.iter().map(|w| w * w).sum::<f64>();
    }
    #[allow(clippy::cast_precision_loss)]
    let (samples, count) = (offsets.len() as f64, (places.len() * places.len()) as f64);
    samples * samples * count / sum
}

/// The cell of a coordinate and the position in it, from 0 to 1. Coordinates outside the sheet are clamped to its edge.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
fn cell(sheet: &Sheet, axis: usize, at_m: f64) -> (usize, f64) {
    let last = sheet.points[axis].saturating_sub(2);
    let at = (at_m / sheet.spacing_m).clamp(0.0, (sheet.points[axis] - 1) as f64);
    let low = (at as usize).min(last);
    (low, at - low as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model(sets: &[&str]) -> std::sync::Arc<Model> {
        let always = ["sheet.spacing_m=0.02", "stepping.integrator=central", "stepping.substeps=1"];
        Model::paper(&[&always[..], sets].concat())
    }

    /// Radii, in spacings.
    const RADII: [f64; 4] = [0.2, 1.0, 1.7, 3.2];

    #[test]
    fn the_places_in_a_disc_are_spread_alike_in_every_direction() {
        for radius in RADII {
            let places = disc(radius);
            let mean = |of: &dyn Fn(&DVec2) -> f64| places.iter().map(of).sum::<f64>() / places.len() as f64;
            // Of a disc that is filled evenly: the centre, and a quarter of the radius squared along each axis.
            let quarter = 0.25 * radius * radius;
            for (found, expected) in [
                (mean(&|place| place.x), 0.0),
                (mean(&|place| place.y), 0.0),
                (mean(&|place| place.x * place.x), quarter),
                (mean(&|place| place.y * place.y), quarter),
                (mean(&|place| place.x * place.y), 0.0),
            ] {
                assert!((found - expected).abs() < 1e-12 * (1.0 + radius * radius), "{radius}: {found} {expected}");
            }
            assert!(places.iter().all(|place| place.length() < radius));
        }
    }

    #[test]
    fn a_disc_gives_way_like_its_own_area_of_a_foundation() {
        let model = model(&["sheet.points=[21, 21]"]);
        let spacing_m = model.unit_m;
        for radius in RADII.into_iter().filter(|radius| *radius >= 1.0) {
            // h²/Σ w² is the area, in the mean over places in a cell.
            let places = (0..16).map(|place| DVec2::new(f64::from(place / 4), f64::from(place % 4)) / 4.0);
            let mobility =
                places.map(|place| Footprint::new(&model, radius * spacing_m, (place + 10.0) * spacing_m).mobility());
            let area = 16.0 / mobility.sum::<f64>();
            let expected = std::f64::consts::PI * radius * radius;
            assert!((area - expected).abs() < 2e-3 * expected, "{radius}: {area} {expected}");
        }
    }

    #[test]
    fn weights_add_up_to_1_about_the_centre_and_follow_a_plane_exactly() {
        let model = model(&["sheet.points=[13, 17]"]);
        let spacing_m = model.unit_m;
        for radius in RADII {
            let centre_m = DVec2::new(6.13, 8.71) * spacing_m;
            let footprint = Footprint::new(&model, radius * spacing_m, centre_m);
            let rest_m = |[i, j]: [usize; 2]| DVec2::new(i as f64, j as f64) * spacing_m;
            let whole: f64 = footprint.reached().iter().map(|point| point.weight).sum();
            let middle_m: DVec2 = footprint.reached().iter().map(|point| point.weight * rest_m(point.point)).sum();
            assert!((whole - 1.0).abs() < 1e-12 && middle_m.distance(centre_m) < 1e-12, "{radius}: {whole} {middle_m}");
            let (slopes, level_m) = (DVec2::new(0.3, -0.2), 0.01);
            let (place_m, along) = footprint.surface(|point| DVec3::new(0.0, 0.0, level_m + slopes.dot(rest_m(point))));
            assert!((place_m - centre_m.extend(level_m + slopes.dot(centre_m))).length() < 1e-12, "{place_m}");
            let tilted = [DVec3::new(1.0, 0.0, slopes.x), DVec3::new(0.0, 1.0, slopes.y)];
            assert!((0..2).all(|axis| along[axis].distance(tilted[axis]) < 1e-9), "{radius}: {along:?}");
        }
    }

    #[test]
    fn the_slopes_are_the_change_of_place_also_where_the_disc_leaves_the_sheet() {
        let model = model(&["sheet.points=[7, 9]"]);
        let spacing_m = model.unit_m;
        let displacement_m = |[i, j]: [usize; 2]| {
            let (x, y) = (i as f64, j as f64);
            1e-3 * DVec3::new((1.3 * x + y).sin(), (x - 0.7 * y).cos(), (0.9 * x * y).sin())
        };
        for radius in RADII {
            for centre in [[0.31, 0.17], [2.87, 0.05], [5.96, 7.93], [3.11, 4.07]] {
                let mut footprint = Footprint::new(&model, radius * spacing_m, DVec2::from(centre) * spacing_m);
                let (centre_m, step_m) = (footprint.centre_m(), 1e-8 * spacing_m);
                let (_, along) = footprint.surface(displacement_m);
                for axis in 0..2 {
                    let mut step = DVec2::ZERO;
                    step[axis] = step_m;
                    let [ahead_m, behind_m] = [centre_m + step, centre_m - step].map(|place_m| {
                        footprint.move_to(&model, place_m);
                        footprint.surface(displacement_m).0
                    });
                    let slope = (ahead_m - behind_m) / (2.0 * step_m);
                    assert!(slope.distance(along[axis]) < 1e-5, "{radius} {centre:?}: {slope} {}", along[axis]);
                }
            }
        }
    }
}
