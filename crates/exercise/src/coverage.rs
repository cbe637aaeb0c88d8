//! How hard each place of a surface was pressed at most, and which share of it was pressed hard enough.
//!
//! The surface is divided into small parts of about the same size, some 20,000, however coarse its triangles are; each triangle is at
//! least one. A
//! part belongs to a disc if its middle is within the disc's radius, and it faces the same side.

use glam::DVec3;

use crate::definition::{Figures, MeasureDefinition, Scope};
use crate::input::PressedDisc;

pub(crate) const COVERAGE: MeasureDefinition = MeasureDefinition {
    name: "coverage_share",
    unit: "1",
    scope: Scope::Total,
    range: [0.0, 1.0],
    formula: "area of the surface that lay under a disc of at least the chosen pressure, over the whole area",
    source: "Laufer et al. 2015, doi:10.1056/NEJMc1414210: who presses too lightly misses lumps",
    meaning: "Which part of the surface was pressed hard enough to feel what is below it.",
};

pub(crate) const COVERED_AREA: MeasureDefinition = MeasureDefinition {
    name: "covered_area_m2",
    unit: "m²",
    scope: Scope::Total,
    range: [0.0, f64::INFINITY],
    formula: "area of the surface that lay under a disc of at least the chosen pressure",
    source: "as coverage_share",
    meaning: "How much of the surface was pressed hard enough to feel what is below it.",
};

/// The number of parts into which a surface of few triangles is divided, about.
const PARTS: f64 = 16_384.0;

/// The largest number of parts along the side of a triangle.
const MAX_PARTS_ALONG: u32 = 128;

/// A part of the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfacePart {
    /// Its corners at rest, m, counter-clockwise from outside.
    pub corners_m: [DVec3; 3],
    /// The largest pressure on it so far, Pa.
    pub peak_pa: f64,
}

impl SurfacePart {
    fn middle_m(&self) -> DVec3 {
        let [a, b, c] = self.corners_m;
        (a + b + c) / 3.0
    }

    /// Returns twice the area, m², along the outward normal.
    fn twice_area_m2(&self) -> DVec3 {
        let [a, b, c] = self.corners_m;
        (b - a).cross(c - a)
    }
}

/// A surface with the largest pressure on each of its parts.
#[derive(Debug, Clone, Default)]
pub struct PressedSurface {
    /// By ascending cell.
    parts: Vec<SurfacePart>,
    cells: Vec<[i32; 3]>,
    cell_m: f64,
    area_m2: f64,
}

impl PressedSurface {
    /// Divides a surface of triangles at rest, m. Triangles without an area or with a place that is not finite are left
    /// out.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub fn new(triangles_m: impl Iterator<Item = [DVec3; 3]>) -> Self {
        let whole = |corners_m: [DVec3; 3]| SurfacePart { corners_m, peak_pa: 0.0 };
        let has_area = |part: &SurfacePart| {
            let squared = part.twice_area_m2().length_squared();
            squared > 0.0 && squared.is_finite()
        };
        let triangles: Vec<SurfacePart> = triangles_m.map(whole).filter(has_area).collect();
        let area_m2 = triangles.iter().map(|triangle| 0.5 * triangle.twice_area_m2().length()).sum::<f64>();
        let side_m = (2.0 * area_m2 / PARTS).sqrt();
        let mut parts = Vec::new();
        for SurfacePart { corners_m: [a, b, c], .. } in &triangles {
            let longest_m = a.distance(*b).max(b.distance(*c)).max(c.distance(*a));
            let along = ((longest_m / side_m).ceil() as u32).clamp(1, MAX_PARTS_ALONG);
            let (right, up) = ((b - a) / f64::from(along), (c - a) / f64::from(along));
            let corner = |i: u32, j: u32| a + f64::from(i) * right + f64::from(j) * up;
            for i in 0..along {
                for j in 0..along - i {
                    parts.push(whole([corner(i, j), corner(i + 1, j), corner(i, j + 1)]));
                    if i + j + 1 < along {
                        parts.push(whole([corner(i + 1, j), corner(i + 1, j + 1), corner(i, j + 1)]));
                    }
                }
            }
        }
        let cell_m = 2.0 * side_m;
        parts.sort_by_key(|part| cell_of(part.middle_m(), cell_m));
        let cells = parts.iter().map(|part| cell_of(part.middle_m(), cell_m)).collect();
        PressedSurface { parts, cells, cell_m, area_m2 }
    }

    /// Notes that a disc was pressed.
    pub fn press(&mut self, disc: &PressedDisc) {
        if self.parts.is_empty() || disc.pressure_pa <= 0.0 {
            return;
        }
        let reach_m = DVec3::splat(disc.radius_m);
        let least = cell_of(disc.rest_m - reach_m, self.cell_m);
        let most = cell_of(disc.rest_m + reach_m, self.cell_m);
        let mut next = self.cells.partition_point(|cell| *cell < least);
        // Cells are in the order of x, y and z: rows of cells that are beside the disc are skipped.
        while let Some(cell) = self.cells.get(next).copied().filter(|cell| cell[0] <= most[0]) {
            let target = match () {
                () if cell[1] < least[1] => Some([cell[0], least[1], least[2]]),
                () if cell[1] > most[1] => Some([cell[0] + 1, least[1], least[2]]),
                () if cell[2] < least[2] => Some([cell[0], cell[1], least[2]]),
                () if cell[2] > most[2] => Some([cell[0], cell[1] + 1, least[2]]),
                () => None,
            };
            if let Some(target) = target {
                next += self.cells[next..].partition_point(|cell| *cell < target);
                continue;
            }
            let part = &mut self.parts[next];
            let is_under = part.middle_m().distance_squared(disc.rest_m) <= disc.radius_m * disc.radius_m;
            if is_under && part.twice_area_m2().dot(disc.normal) > 0.0 {
                part.peak_pa = part.peak_pa.max(disc.pressure_pa);
            }
            next += 1;
        }
    }

    /// Returns the parts of the surface, in an order that depends on the surface alone.
    pub fn parts(&self) -> &[SurfacePart] {
        &self.parts
    }

    /// Returns the area, m², that was pressed with at least `pressure_pa`, Pa.
    pub fn covered_m2(&self, pressure_pa: f64) -> f64 {
        let covered = self.parts.iter().filter(|part| part.peak_pa >= pressure_pa);
        covered.map(|part| 0.5 * part.twice_area_m2().length()).sum()
    }

    pub(crate) fn figures(&self, coverage_pa: f64, figures: &mut Figures) {
        if self.area_m2 > 0.0 {
            let covered_m2 = self.covered_m2(coverage_pa);
            // Rounding may make the sum of the parts larger than the whole.
            figures.add(&COVERAGE, (covered_m2 / self.area_m2).min(1.0));
            figures.add(&COVERED_AREA, covered_m2);
        }
    }
}

#[allow(clippy::cast_possible_truncation)]
fn cell_of(place_m: DVec3, cell_m: f64) -> [i32; 3] {
    (place_m / cell_m).to_array().map(|place| place.floor() as i32)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two triangles, a square of 0.2 m, facing up, and the same facing down 1 mm below.
    fn leaf() -> PressedSurface {
        let at = |x: f64, y: f64, z: f64| DVec3::new(0.2 * x, 0.2 * y, z);
        let up = [
            [at(0.0, 0.0, 0.0), at(1.0, 0.0, 0.0), at(1.0, 1.0, 0.0)],
            [at(0.0, 0.0, 0.0), at(1.0, 1.0, 0.0), at(0.0, 1.0, 0.0)],
        ];
        let below = up.map(|[a, b, c]| [a, c, b].map(|place_m| place_m - 0.001 * DVec3::Z));
        PressedSurface::new(up.into_iter().chain(below))
    }

    fn disc(x_m: f64, y_m: f64, pressure_pa: f64) -> PressedDisc {
        PressedDisc { rest_m: DVec3::new(x_m, y_m, 0.0), normal: DVec3::Z, radius_m: 0.02, pressure_pa }
    }

    #[test]
    fn a_disc_covers_its_area_on_its_own_side_and_only_if_it_is_strong_enough() {
        let mut surface = leaf();
        surface.press(&disc(0.1, 0.1, 3000.0));
        surface.press(&disc(0.05, 0.05, 1000.0));
        let area_m2 = std::f64::consts::PI * 0.02 * 0.02;
        let near = |pressure_pa: f64, expected_m2: f64| {
            let covered_m2 = surface.covered_m2(pressure_pa);
            assert!((covered_m2 - expected_m2).abs() < 0.02 * area_m2, "{covered_m2} instead of {expected_m2}");
        };
        near(2000.0, area_m2);
        near(1000.0, 2.0 * area_m2);
        near(3001.0, 0.0);
        assert!(surface.parts().iter().all(|part| part.peak_pa == 0.0 || part.twice_area_m2().z > 0.0));
    }

    #[test]
    fn discs_find_the_parts_that_a_search_through_all_finds() {
        let mut random = fastrand::Rng::with_seed(3);
        let mut surface = leaf();
        for _ in 0..50 {
            let mut expected = surface.clone();
            let at = |random: &mut fastrand::Rng| 0.3 * random.f64() - 0.05;
            let disc = PressedDisc {
                radius_m: 0.1 * random.f64(),
                ..disc(at(&mut random), at(&mut random), 1e3 * random.f64())
            };
            for part in &mut expected.parts {
                if part.middle_m().distance_squared(disc.rest_m) <= disc.radius_m * disc.radius_m
                    && part.twice_area_m2().z > 0.0
                {
                    part.peak_pa = part.peak_pa.max(disc.pressure_pa);
                }
            }
            surface.press(&disc);
            assert_eq!(surface.parts, expected.parts);
        }
    }
}
