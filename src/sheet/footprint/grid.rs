//! A disc on a rectangular sheet.
//!
//! The surface between points is bilinear: the material place c (in the rest plane) is at Σ N_p(c)·x_p, N_p the bilinear
//! hats. The hats are averaged over a smaller disc, chosen so that the area that shares a force (`super`) is that of the
//! requested disc, in the mean over its places in a cell. From two spacings across on that is exact; below, the hats alone
//! are too large.
//!
//! The integral is a sum over rings of equal area, each with points at equal angles: sums of first powers vanish, and
//! sums of second powers are the same in every direction.

use std::f64::consts::TAU;

use glam::DVec2;

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
pub(super) struct GridDisc {
    /// Radius of the disc that the hats are averaged over.
    drawn_m: f64,
    /// Sample places of the sum, from the centre.
    offsets_m: Vec<DVec2>,
    pub(super) centre_m: DVec2,
    /// Scratch memory for the sums of a rectangle of points.
    sums: Vec<(f64, DVec2)>,
}

impl GridDisc {
    /// A disc that has no place yet.
    pub(super) fn new(sheet: &Sheet, radius_m: f64) -> Self {
        let spacing_m = sheet.spacing_m;
        let drawn = drawn_radius(radius_m / spacing_m);
        GridDisc {
            drawn_m: drawn * spacing_m,
            offsets_m: disc(drawn).into_iter().map(|offset| offset * spacing_m).collect(),
            centre_m: DVec2::NAN,
            sums: Vec::new(),
        }
    }

    /// Moves the disc to a place, onto the sheet if that is beside it. Tells the points that it covers then, by rows, their
    /// weights and how these change with the place, 1/m; nothing if it was there already.
    pub(super) fn move_to(
        &mut self,
        sheet: &Sheet,
        centre_m: DVec2,
    ) -> Option<impl Iterator<Item = ([usize; 2], f64, DVec2)>> {
        let centre_m = centre_m.clamp(DVec2::ZERO, sheet.extent_m());
        if centre_m == self.centre_m {
            return None;
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
        let columns = size[1];
        let sums = self.sums.iter().enumerate().filter(|(_, sum)| sum.0 != 0.0);
        Some(sums.map(move |(at, &(weight, gradient))| {
            ([origin[0] + at / columns, origin[1] + at % columns], weight, gradient)
        }))
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
    fn the_rings_of_a_disc_are_turned_against_each_other_by_different_parts() {
        let places = disc(6.0);
        let rings = 12;
        let count = places.len() / rings;
        // How far the first place of each ring is turned, in parts of the way to the next one of it.
        let mut parts: Vec<f64> =
            (0..rings).map(|ring| (places[ring * count].to_angle() / TAU * count as f64).rem_euclid(1.0)).collect();
        parts.sort_by(f64::total_cmp);
        let around = parts[1..].iter().copied().chain([parts[0] + 1.0]);
        let widest = parts.iter().zip(around).map(|(a, b)| b - a).fold(0.0, f64::max);
        // Evenly turned, these are a twelfth apart.
        assert!(widest < 2.0 / rings as f64, "{parts:?}");
    }
}
