//! The disc of a tool on a rectangular sheet.
//!
//! The surface between points is bilinear: the material place c (in the rest plane) is at Σ N_p(c)·x_p, with
//! N_p the bilinear hat functions. The hats are averaged over a smaller disc, chosen so that the area that
//! shares a force (`body::footprint`) is that of the requested disc, in the mean over its places in a cell.
//! From two spacings across on this is exact; below, the hats alone are too large.
//!
//! The integral is a sum over rings of equal area, each with points at equal angles: sums of first powers
//! vanish, and sums of second powers are the same in every direction.
//!
//! A disc has at most 1024 sample places, and a place lies among four points. So no disc covers more than 4096
//! points, however large it is and however fine the sheet: this bounds its memory and the work of creating,
//! moving and pressing it.

use std::cell::RefCell;
use std::f64::consts::TAU;
use std::sync::OnceLock;

use glam::{DVec2, DVec3};

use crate::body::disc::{DiscPoint, TissueDisc};
use crate::body::solid::corner_copies::CornerCopies;
use crate::saved::{SavedPlace, ensure, unsound};
use crate::scene::Sheet;
use palpate_refusal::Result;

/// Smallest number of rings in a disc; larger discs have two per spacing.
const MIN_RINGS: f64 = 6.0;

/// Rotation of each ring against the one before, so that hardly two sample places cross a grid line at once.
/// The slope of the surface jumps at each crossing; this makes the sum change smoothly.
const GOLDEN: f64 = 0.618_033_988_749_895;

/// Largest number of rings. Beyond, a spacing has fewer than two, which makes no difference to a disc that
/// large.
const MAX_RINGS: f64 = 16.0;

/// Sample places in a ring, for each ring of its disc.
const PLACES_PER_RING: u32 = 4;

/// Upper bound of a disc's area, in spacings squared. Each sample place has at least a quarter of a square to
/// itself: with n places, Σ w² is at least 1/(4·n), so the area is at most 4·n. A little more, for rounding.
const MAX_AREA: f64 = 4.0 * PLACES_PER_RING as f64 * MAX_RINGS * MAX_RINGS * (1.0 + 1e-6);

/// A rectangle of more points than this is not stored as a whole, but only the points that are met.
const MAX_LAID_OUT: usize = 1 << 14;

/// The disc of a tool on a sheet, at a place. Lengths in m.
#[derive(Debug, Clone)]
pub(crate) struct GridDisc {
    sheet: Sheet,
    /// Radius of the disc over which the hats are averaged.
    drawn_m: f64,
    /// Sample places of the sum, relative to the centre.
    offsets_m: Vec<DVec2>,
    centre_m: DVec2,
    /// First row and column of the rectangle of these points, and its columns.
    origin: [usize; 2],
    columns: usize,
    /// Scratch memory: the sums of each point, by rows.
    sums: Vec<(f64, DVec2)>,
    /// The points of these sums, if the rectangle around them is too large to be stored.
    met: Vec<[usize; 2]>,
}

impl GridDisc {
    /// Creates a disc without a place.
    pub(crate) fn new(sheet: &Sheet, radius_m: f64) -> Self {
        let spacing_m = sheet.spacing_m;
        let drawn = drawn_radius(radius_m / spacing_m);
        GridDisc {
            sheet: sheet.clone(),
            drawn_m: drawn * spacing_m,
            offsets_m: disc(drawn).into_iter().map(|offset| offset * spacing_m).collect(),
            centre_m: DVec2::NAN,
            origin: [0; 2],
            columns: 1,
            sums: Vec::new(),
            met: Vec::new(),
        }
    }

    /// Moves the disc to a place, or to the edge of the sheet if the place is beside it, and computes the points that it
    /// then covers. Returns false if it was there already.
    fn move_to(&mut self, centre_m: DVec2) -> bool {
        let centre_m = centre_m.clamp(DVec2::ZERO, self.sheet.extent_m());
        if centre_m == self.centre_m {
            return false;
        }
        self.centre_m = centre_m;
        let (mut origin, mut size) = ([0; 2], [0; 2]);
        for axis in 0..2 {
            let (low, _) = cell(&self.sheet, axis, centre_m[axis] - self.drawn_m);
            let (high, _) = cell(&self.sheet, axis, centre_m[axis] + self.drawn_m);
            origin[axis] = low;
            size[axis] = (high + 2).min(self.sheet.points[axis]) - low;
        }
        (self.origin, self.columns) = (origin, size[1]);
        self.sums.clear();
        self.met.clear();
        let is_laid_out = size[0].saturating_mul(size[1]) <= MAX_LAID_OUT;
        if is_laid_out {
            self.sums.resize(size[0] * size[1], (0.0, DVec2::ZERO));
        } else {
            self.intersect();
            self.sums.resize(self.met.len(), (0.0, DVec2::ZERO));
        }
        let GridDisc { sheet, offsets_m, sums, met, .. } = self;
        for_each_share(sheet, centre_m, offsets_m, |point, weight, gradient| {
            let [row, column] = [point[0] - origin[0], point[1] - origin[1]];
            // A sheet of one row has no next row.
            if row >= size[0] || column >= size[1] {
                return;
            }
            let at = if is_laid_out { Some(row * size[1] + column) } else { met.binary_search(&point).ok() };
            if let Some(sum) = at.and_then(|at| sums.get_mut(at)) {
                sum.0 += weight;
                sum.1 += gradient;
            }
        });
        true
    }

    /// Returns the points that the disc covers, by rows, with their weights and the derivatives of these by the place,
    /// 1/m.
    fn covered(&self) -> impl Iterator<Item = ([usize; 2], f64, DVec2)> {
        let GridDisc { sums, met, origin, columns, .. } = self;
        let sums = sums.iter().enumerate().filter(|(_, sum)| sum.0 != 0.0);
        sums.map(move |(at, &(weight, gradient))| {
            let point = met.get(at).copied().unwrap_or([origin[0] + at / columns, origin[1] + at % columns]);
            (point, weight, gradient)
        })
    }

    /// Finds the points around the sample places.
    fn intersect(&mut self) {
        let GridDisc { sheet, offsets_m, met, centre_m, .. } = self;
        for_each_share(sheet, *centre_m, offsets_m, |point, _, _| met.push(point));
        met.sort_unstable();
        met.dedup();
    }
}

/// Returns the place on a plane that a snapshot has.
fn place_of(saved: &SavedPlace) -> Option<DVec2> {
    if let SavedPlace::OfPlane(centre_m) = saved { Some(DVec2::from(*centre_m)) } else { None }
}

impl TissueDisc for GridDisc {
    fn boxed(&self) -> Box<dyn TissueDisc> {
        Box::new(self.clone())
    }

    fn saved(&self) -> SavedPlace {
        SavedPlace::OfPlane(self.centre_m.to_array())
    }

    fn restore(&mut self, saved: &SavedPlace) -> Result<()> {
        let centre_m = place_of(saved).ok_or_else(|| unsound("a tool on a tissue of another kind"))?;
        let is_on_it = centre_m.cmpge(DVec2::ZERO).all() && centre_m.cmple(self.sheet.extent_m()).all();
        ensure(is_on_it, "a tool that is not on the tissue")?;
        self.move_to(centre_m);
        Ok(())
    }

    fn return_to(&mut self, saved: &SavedPlace) -> bool {
        place_of(saved).is_some_and(|centre_m| self.move_to(centre_m))
    }

    fn anchor_m(&self) -> DVec3 {
        self.centre_m.extend(0.0)
    }

    fn put(&mut self, at_m: DVec3) -> bool {
        self.move_to(at_m.truncate())
    }

    fn walk(&mut self, by_m: DVec2) -> bool {
        self.move_to(self.centre_m + by_m)
    }

    fn is_flat(&self) -> bool {
        true
    }

    fn cover(&mut self, _copies: Option<&CornerCopies>, add: &mut dyn FnMut(DiscPoint, f64, DVec2)) {
        self.covered().for_each(|(point, weight, gradient)| add(self.sheet.point(point).into(), weight, gradient));
    }
}

/// Calls `add` for each sample place and each of the four points around it, with the place's part of the
/// point's weight and its derivative by the centre, 1/m. A point may be beyond the last of a row or column;
/// then its part is 0.
fn for_each_share(sheet: &Sheet, centre_m: DVec2, offsets_m: &[DVec2], mut add: impl FnMut([usize; 2], f64, DVec2)) {
    #[allow(clippy::cast_precision_loss)]
    let share = 1.0 / offsets_m.len() as f64;
    for offset in offsets_m {
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
                add([i + di, j + dj], share * wx * wy, DVec2::new(sx * wy, wx * sy));
            }
        }
    }
}

/// Returns the directions from the centre to the sample places of a disc with `rings` rings, ring by ring.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn directions(rings: u32) -> &'static [DVec2] {
    static KNOWN: [OnceLock<Vec<DVec2>>; MAX_RINGS as usize + 1] = [const { OnceLock::new() }; MAX_RINGS as usize + 1];
    KNOWN[rings as usize].get_or_init(|| {
        let count = PLACES_PER_RING * rings;
        let direction = |ring: u32, k: u32| {
            let angle = TAU * (f64::from(k) + GOLDEN * f64::from(ring + 1)) / f64::from(count);
            DVec2::new(libm::cos(angle), libm::sin(angle))
        };
        (0..rings).flat_map(|ring| (0..count).map(move |k| direction(ring, k))).collect()
    })
}

/// Returns sample places spread evenly over a disc. All lengths in spacings.
fn disc(radius: f64) -> Vec<DVec2> {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let rings = (2.0 * radius).ceil().clamp(MIN_RINGS, MAX_RINGS) as u32;
    let out = |ring: u32| radius * ((f64::from(ring) + 0.5) / f64::from(rings)).sqrt();
    let of_rings = directions(rings).chunks_exact((PLACES_PER_RING * rings) as usize);
    (0..rings).zip(of_rings).flat_map(|(ring, of_ring)| of_ring.iter().map(move |way| out(ring) * *way)).collect()
}

/// Number of radii that a thread remembers.
const REMEMBERED: usize = 256;

thread_local! {
    /// Radii, and those of the discs that the hats are averaged over: a tool that touches again, or another
    /// with the same tip, only costs a lookup.
    static DRAWN: RefCell<Vec<[f64; 2]>> = RefCell::new(vec![[f64::NAN; 2]; REMEMBERED]);
}

/// Returns the radius, in spacings, of the disc whose blurred weights have the area of a disc of `radius`.
fn drawn_radius(radius: f64) -> f64 {
    #[allow(clippy::cast_possible_truncation)]
    let slot = (radius.to_bits().wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 56) as usize % REMEMBERED;
    DRAWN.with_borrow_mut(|known| {
        if known[slot][0] != radius {
            known[slot] = [radius, find_drawn_radius(radius)];
        }
        known[slot][1]
    })
}

fn find_drawn_radius(radius: f64) -> f64 {
    let target = std::f64::consts::PI * radius * radius;
    let (mut low, mut high) = (0.0, radius);
    let mut scratch = Vec::new();
    for _ in 0..24 {
        let middle = 0.5 * (low + high);
        // Skip the computation if the area is certainly smaller; for a large disc it always is.
        let is_smaller = most_area(middle) < target || shared_area(middle, &mut scratch) < target;
        if is_smaller { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

/// Returns an upper bound of the area that [`shared_area`] finds for a radius. By the inequality of Cauchy and
/// Schwarz it is at most the number of points with a weight: those within √2 of a place, each in a square of
/// its own.
fn most_area(radius: f64) -> f64 {
    let reach = radius + 2.2;
    (std::f64::consts::PI * reach * reach).min(MAX_AREA)
}

/// Places in a cell whose weights are computed together, so that the processor need not wait for one sum after
/// another.
const TOGETHER: usize = 4;

/// Returns 1/Σ w² on an infinite grid, in the mean over places in a cell, in spacings squared.
fn shared_area(radius: f64, weights: &mut Vec<[f64; TOGETHER]>) -> f64 {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let (reach, offsets) = (radius.ceil() as usize + 2, disc(radius));
    let width = 2 * reach;
    let mut sum = 0.0;
    let places: [f64; TOGETHER] = [0.0, 0.25, 0.5, 0.75];
    for x in places {
        weights.clear();
        weights.resize(width * width, [0.0; TOGETHER]);
        for (which, y) in places.into_iter().enumerate() {
            for offset in &offsets {
                #[allow(clippy::cast_precision_loss)]
                let at = DVec2::new(x, y) + *offset + (reach as f64 - 1.0);
                // No coordinate is negative, so the cast rounds down.
                #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
                let [i, j] = [at.x as usize, at.y as usize];
                #[allow(clippy::cast_precision_loss)]
                let part = at - DVec2::new(i as f64, j as f64);
                let first = i * width + j;
                weights[first][which] += (1.0 - part.x) * (1.0 - part.y);
                weights[first + 1][which] += (1.0 - part.x) * part.y;
                weights[first + width][which] += part.x * (1.0 - part.y);
                weights[first + width + 1][which] += part.x * part.y;
            }
        }
        let mut squares = [0.0; TOGETHER];
        for of_point in weights.iter() {
            squares.iter_mut().zip(of_point).for_each(|(squares, weight)| *squares += weight * weight);
        }
        squares.iter().for_each(|squares| sum += squares);
    }
    #[allow(clippy::cast_precision_loss)]
    let (samples, count) = (offsets.len() as f64, (places.len() * places.len()) as f64);
    samples * samples * count / sum
}

/// Returns the cell of a coordinate and the position in it, from 0 to 1. Coordinates outside the sheet are
/// clamped to its edge.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
fn cell(sheet: &Sheet, axis: usize, at_m: f64) -> (usize, f64) {
    let last = sheet.points[axis].saturating_sub(2);
    let at = (at_m / sheet.spacing_m).clamp(0.0, (sheet.points[axis] - 1) as f64);
    let low = (at as usize).min(last);
    (low, at - low as f64)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::body::model::Model;

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

    /// [`shared_area`] by its definition.
    fn area(radius: f64) -> f64 {
        let (reach, offsets) = (radius.ceil() as usize + 2, disc(radius));
        let (width, mut sum) = (2 * reach, 0.0);
        for place in 0..16 {
            let place = 0.25 * DVec2::new(f64::from(place / 4), f64::from(place % 4));
            let mut weights = vec![0.0; width * width];
            for offset in &offsets {
                let at = place + *offset + (reach as f64 - 1.0);
                let (low, part) = (at.floor(), at - at.floor());
                let first = low.x as usize * width + low.y as usize;
                weights[first] += (1.0 - part.x) * (1.0 - part.y);
                weights[first + 1] += (1.0 - part.x) * part.y;
                weights[first + width] += part.x * (1.0 - part.y);
                weights[first + width + 1] += part.x * part.y;
            }
            sum += weights.iter().map(|w| w * w).sum::<f64>();
        }
        (offsets.len() * offsets.len()) as f64 * 16.0 / sum
    }

    #[test]
    fn the_drawn_radius_is_that_of_the_area_to_the_last_bit_however_it_is_found() {
        for radius in [0.05, 0.3, 1.0, 1.7, 3.2, 7.9, 8.1, 20.0, 35.9, 36.2, 60.0] {
            let (mut low, mut high) = (0.0, radius);
            for _ in 0..24 {
                let middle = 0.5 * (low + high);
                let found = area(middle);
                assert!(found <= most_area(middle), "{middle}: {found}");
                if found < std::f64::consts::PI * radius * radius { low = middle } else { high = middle }
            }
            for _ in 0..2 {
                assert_eq!(drawn_radius(radius), 0.5 * (low + high), "{radius}");
            }
        }
    }

    #[test]
    fn a_disc_covers_what_its_places_meet_however_fine_the_sheet_is() {
        let model = |points: &str| {
            let fixed = ["stepping.integrator=central", "stepping.substeps=1"];
            Model::paper(&[&fixed[..], &[&format!("sheet.points={points}")]].concat())
        };
        // Half of a strip, which takes 28.8 GB as a square.
        let strip = model("[1, 60000]");
        let (sheet, length_m) = (strip.scene.sheet().unwrap(), strip.shape().longest_side_m());
        let mut disc = GridDisc::new(sheet, 0.5 * length_m);
        assert!(disc.move_to(DVec2::new(0.0, 0.4 * length_m)));
        let covered: Vec<_> = disc.covered().collect();
        let whole: f64 = covered.iter().map(|(_, weight, _)| weight).sum();
        assert!((whole - 1.0).abs() < 1e-9 && covered.len() <= 4096, "{whole} {}", covered.len());
        // What is met is the same as what is laid out.
        let square = model("[160, 300]");
        let sheet = square.scene.sheet().unwrap();
        let (mut disc, centre_m) = (GridDisc::new(sheet, 90.3 * sheet.spacing_m), 80.2 * DVec2::splat(sheet.spacing_m));
        assert!(disc.move_to(centre_m));
        let covered: Vec<_> = disc.covered().collect();
        assert!(!disc.met.is_empty());
        let mut sums = vec![(0.0, DVec2::ZERO); 162 * 302];
        for_each_share(sheet, centre_m, &disc.offsets_m, |[i, j], weight, gradient| {
            sums[302 * i + j].0 += weight;
            sums[302 * i + j].1 += gradient;
        });
        let of = |at: usize| ([at / 302, at % 302], sums[at].0, sums[at].1);
        let all: Vec<_> = (0..sums.len()).filter(|at| sums[*at].0 != 0.0).map(of).collect();
        assert_eq!(covered, all);
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
