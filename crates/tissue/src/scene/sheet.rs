//! The section `[sheet]` of a scene: a rectangular grid of points. It is also the rest shape of the tissue.
#![allow(clippy::cast_precision_loss)]

use std::sync::Arc;

use glam::{DVec2, DVec3};

use crate::limits::Limits;
use crate::memory;
use crate::scene::action_check::physical;
use crate::scene::body::{BodyKind, KindOfBody, strain_of};
use crate::scene::source::Files;
use crate::scene::springs::Springs;
use crate::scene::stepping::Integrator;
use crate::scene::toml_document::{Fields, Item};
use crate::shape::{Deepest, Extent, GridCell, PointId, PointName, RestShape};
use palpate_refusal::{Reason, Refusal, Result, positive};

mod representative;

/// Smallest number of points per row (along y) in memory: 16, the lanes of the widest vector. Shorter rows are
/// padded, and count as that many against `limits.points`.
pub const MIN_WIDTH: usize = 16;

/// A rectangular grid of points: point [i, j] rests at (i·spacing, j·spacing, 0) and has the index i·ny + j,
/// for nx × ny points. The scene checks it ([`Scene::check`](super::Scene::check)).
#[derive(Debug, Clone, PartialEq)]
pub struct Sheet {
    /// Points along x (nx) and along y (ny), each at least 1.
    pub points: [usize; 2],
    /// Distance h between structural neighbours at rest, m.
    pub spacing_m: f64,
    /// Mass of each point, kg.
    pub point_mass_kg: f64,
    /// Points that never move. A scene file that names none fixes none.
    pub fixed: FixedPoints,
}

/// The points of a grid of nx × ny points that never move.
#[derive(Debug, Clone, PartialEq)]
pub enum FixedPoints {
    /// Every point of the rim: i is 0 or nx − 1, or j is 0 or ny − 1.
    Edges,
    /// The four corners.
    Corners,
    /// The listed points, which must be on the grid; an empty list fixes none.
    Points(PointSet),
}

/// A set of grid points [i, j], ascending, each once; `collect()` makes it from any order. Clones share one
/// list in memory, because a scene may name many points.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct PointSet(Arc<[[usize; 2]]>);

impl PointSet {
    /// Returns whether the point [i, j] is in the set.
    pub fn contains(&self, point: [usize; 2]) -> bool {
        self.0.binary_search(&point).is_ok()
    }

    /// Returns all points, ascending by i, then j, each once.
    pub fn as_slice(&self) -> &[[usize; 2]] {
        &self.0
    }
}

impl FromIterator<[usize; 2]> for PointSet {
    fn from_iter<I: IntoIterator<Item = [usize; 2]>>(points: I) -> Self {
        let mut points: Vec<_> = points.into_iter().collect();
        points.sort_unstable();
        points.dedup();
        PointSet(points.into())
    }
}

impl FixedPoints {
    fn read(item: &Item<'_>) -> Result<Self> {
        match item.as_text() {
            Some("edges") => Ok(FixedPoints::Edges),
            Some("corners") => Ok(FixedPoints::Corners),
            Some(_) => Err(item.wrong("\"edges\", \"corners\" or a list of points")),
            None if item.list().is_err() => Err(item.wrong("\"edges\", \"corners\" or a list of points")),
            None => Ok(FixedPoints::Points(item.list()?.iter().map(Item::point).collect::<Result<_>>()?)),
        }
    }
}

impl Sheet {
    /// Returns the point [i, j], with the index i·ny + j. It must be on the grid, which isn't checked:
    /// [`RestShape::find`] does.
    pub fn point(&self, [i, j]: [usize; 2]) -> PointId {
        PointId::new(i * self.points[1] + j)
    }

    /// Returns the indices [i, j] of a point: i along x, j along y. For a point beyond the grid, i is too
    /// large.
    pub fn place_of(&self, point: PointId) -> [usize; 2] {
        [point.index() / self.points[1], point.index() % self.points[1]]
    }

    /// Returns the length along x and along y at rest, m: (nx − 1)·h and (ny − 1)·h, 0 for a single point.
    /// Panics without points.
    pub fn extent_m(&self) -> DVec2 {
        self.spacing_m * DVec2::new((self.points[0] - 1) as f64, (self.points[1] - 1) as f64)
    }

    /// Returns the row-major indices i·ny + j of the fixed points, ascending, each once. Without memory for
    /// them it unwinds with a refusal ([`memory::attempt`]).
    pub fn fixed_indices(&self) -> Vec<usize> {
        let [nx, ny] = self.points;
        let mut indices: Vec<usize> = match &self.fixed {
            FixedPoints::Points(points) => points.as_slice().iter().map(|[i, j]| i * ny + j).collect(),
            _ => {
                // The rim, at most.
                let mut indices = memory::with_room((2 * (nx + ny)).min(nx * ny), "the fixed points");
                indices.extend((0..nx * ny).filter(|index| self.is_fixed(PointId::new(*index))));
                indices
            }
        };
        indices.sort_unstable();
        indices.dedup();
        indices
    }
}

impl KindOfBody for Sheet {
    const SECTION: &'static str = "sheet";

    fn read(fields: &mut Fields<'_>, _: Files<'_>, _: bool, _: &Limits) -> Result<Self> {
        Ok(Sheet {
            points: fields.required("points")?.point()?,
            spacing_m: fields.required_number("spacing_m")?,
            point_mass_kg: fields.required_number("point_mass_kg")?,
            fixed: fields
                .item("fixed")
                .map_or(Ok(FixedPoints::Points(PointSet::default())), |item| FixedPoints::read(&item))?,
        })
    }

    fn read_springs(&mut self, fields: &mut Fields<'_>) -> Result<Springs> {
        let stiffness_n_per_m = fields.required_number("stiffness_n_per_m")?;
        let (shear, bending) = (fields.item("shear_stiffness_n_per_m"), fields.item("bending"));
        Ok(Springs {
            stiffness_n_per_m,
            shear_stiffness_n_per_m: shear.map_or(Ok(stiffness_n_per_m), |item| item.number())?,
            bending: bending.map_or(Ok(false), |item| item.flag())?,
            pretension_n_per_m: fields.number("pretension_n_per_m")?.unwrap_or(0.0),
        })
    }

    /// Returns a corner of the grid with at most `side` points along each side. Also returns three of its
    /// points: a free one, its middle, and one at a corner, where there are fewer springs.
    fn part(&self, side: usize) -> (Self, [PointId; 3]) {
        let points @ [nx, ny] = self.points.map(|points| points.min(side));
        let mut part = Sheet { points, ..self.clone() };
        if let FixedPoints::Points(points) = &mut part.fixed {
            *points = points.as_slice().iter().copied().filter(|[i, j]| *i < side && *j < side).collect();
        }
        let pushed = part.point([nx / 3, 2 * ny / 5]);
        if part.is_fixed(pushed) {
            part.fixed = FixedPoints::Points(PointSet::default());
        }
        let others = [[nx / 2, ny / 2], [1.min(nx - 1), 1.min(ny - 1)]].map(|place| part.point(place));
        (part, [pushed, others[0], others[1]])
    }

    /// Returns a sheet with points `spacing_m` (m) apart, each of which replaces several, and the number of points that
    /// one replaces, (`spacing_m`/h)². It reaches `half_m` (m) from the middle, where it is held, or covers the whole
    /// sheet, with its fixed points, if that is not larger.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn coarser(&self, spacing_m: f64, half_m: f64) -> Option<(Self, f64)> {
        let times = spacing_m / self.spacing_m;
        let is_cut = self.longest_side_m() > 2.0 * half_m;
        // As many on both sides of the middle.
        let points = [0, 1].map(|axis| {
            let extent_m = self.extent_m()[axis];
            2 * (extent_m.min(2.0 * half_m) / (2.0 * spacing_m)).round() as usize + 1
        });
        let fixed = match &self.fixed {
            _ if is_cut => FixedPoints::Edges,
            FixedPoints::Points(named) => {
                let coarse_of = |place: usize, most: usize| ((place as f64 / times).round() as usize).min(most - 1);
                FixedPoints::Points(
                    named
                        .as_slice()
                        .iter()
                        .map(|[i, j]| [coarse_of(*i, points[0]), coarse_of(*j, points[1])])
                        .collect(),
                )
            }
            set => set.clone(),
        };
        let replaced = times * times;
        Some((Sheet { points, spacing_m, point_mass_kg: replaced * self.point_mass_kg, fixed }, replaced))
    }
}

impl BodyKind for Sheet {
    fn section(&self) -> &'static str {
        Self::SECTION
    }

    /// Returns T₀/(k + 2k_s): of the springs that cross a line between two rows, the structural one of each point carries k·h·ε, and its
    /// two shear springs k_s·√2·h·ε each, half of which is across the line.
    fn prestrain(&self, springs: &Springs) -> f64 {
        let stiffness_n_per_m = springs.stiffness_n_per_m + 2.0 * springs.shear_stiffness_n_per_m;
        strain_of(springs, stiffness_n_per_m)
    }

    fn points_key(&self) -> &'static str {
        "sheet.points"
    }

    fn identify(&self, _: &[u32], add: &mut dyn FnMut(&[u8])) {
        add(b"sheet");
    }

    fn unit_hint(&self) -> &'static str {
        "sheet.spacing_m is in m"
    }

    fn shape(&self) -> &dyn RestShape {
        self
    }

    fn can_refine(&self) -> bool {
        true
    }

    fn shared_shape(&self) -> Arc<dyn RestShape> {
        Arc::new(self.clone())
    }

    fn point_mass_kg(&self) -> f64 {
        self.point_mass_kg
    }

    fn mass_kg(&self) -> f64 {
        self.point_mass_kg * self.point_count() as f64
    }

    fn rehearsal_margin(&self, _: Integrator) -> f64 {
        5.0
    }

    fn spring_bound_n_per_m(&self, springs: &Springs, _anchor_n_per_m: f64) -> f64 {
        largest_stiffness_of_a_sheet_n_per_m(springs)
    }

    fn check(&self, limits: &Limits) -> Result<()> {
        let [nx, ny] = self.points;
        if nx == 0 || ny == 0 {
            let message = format!("must be at least 1 along each side, but are {nx} × {ny}");
            return Err(Refusal::new(Reason::OutOfRange, self.points_key(), message));
        }
        if nx.checked_mul(ny).is_none_or(|points| points > limits.points) {
            let message = format!("are {nx} × {ny}, above the limit of {} points in all", limits.points);
            return Err(Refusal::new(Reason::TooLarge, self.points_key(), message));
        }
        // A narrow sheet takes the memory and time of one of this width, which may be sixteen times its own.
        if nx.checked_mul(ny.max(MIN_WIDTH)).is_none_or(|points| points > limits.points) {
            let message = format!(
                "are {nx} × {ny}: rows of fewer than {MIN_WIDTH} points are computed as if they had so many, and \
                 {nx} × {MIN_WIDTH} are above the limit of {} points in all; give the longer side last",
                limits.points
            );
            return Err(Refusal::new(Reason::TooLarge, self.points_key(), message));
        }
        physical("sheet.spacing_m", positive("sheet.spacing_m", self.spacing_m)?)?;
        physical("sheet.point_mass_kg", positive("sheet.point_mass_kg", self.point_mass_kg)?)?;
        if let FixedPoints::Points(points) = &self.fixed
            && let Some(index) = points.as_slice().iter().position(|[i, j]| *i >= nx || *j >= ny)
        {
            self.find(&format!("sheet.fixed[{index}]"), PointName::Point(points.as_slice()[index]))?;
        }
        Ok(())
    }
}

/// Returns an upper bound of the largest eigenvalue of the stiffness matrix of a sheet's springs under any
/// deformation, N/m.
///
/// A spring with unit direction n contributes k(nnᵀ + (1 − L0/L)(I − nnᵀ)) to the tangent stiffness, which is at
/// most k·I: so no deformation makes the matrix larger than the graph Laplacian with weights k. On the unbounded
/// grid the wave (a, b) has the eigenvalue
///
/// λ = k₁(4 − 2x − 2y) + k₂(4 − 4xy) + k₃(8 − 4x² − 4y²),  x = cos a, y = cos b in [−1, 1],
///
/// k₁ structural, k₂ shear, k₃ bending; a finite sheet has fewer springs, and smaller eigenvalues. With all k equal
/// the largest is 12k without and 16⅓·k with bending.
pub fn largest_stiffness_of_a_sheet_n_per_m(springs: &Springs) -> f64 {
    let (k1, k2) = (springs.stiffness_n_per_m, springs.shear_stiffness_n_per_m);
    let k3 = if springs.bending { k1 } else { 0.0 };
    let eigenvalue =
        |x: f64, y: f64| k1 * (4.0 - 2.0 * x - 2.0 * y) + k2 * (4.0 - 4.0 * x * y) + k3 * (8.0 - 4.0 * (x * x + y * y));
    // λ is a quadratic form: its maximum is at a corner, where its slope along an edge is 0, or where both slopes are.
    let mut candidates = vec![(-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)];
    if k3 > 0.0 {
        for edge in [-1.0, 1.0] {
            candidates.push((edge, -(2.0 * k1 + 4.0 * k2 * edge) / (8.0 * k3)));
        }
    }
    if k2 + k3 > 0.0 {
        let inner = -2.0 * k1 / (4.0 * k2 + 8.0 * k3);
        candidates.push((inner, inner));
    }
    let inside = |&(x, y): &(f64, f64)| x.abs() <= 1.0 && y.abs() <= 1.0;
    candidates.into_iter().filter(inside).map(|(x, y)| eigenvalue(x, y)).fold(0.0, f64::max)
}

impl RestShape for Sheet {
    fn describe(&self) -> String {
        let [nx, ny] = self.points;
        format!("{nx} × {ny} points")
    }

    fn point_count(&self) -> usize {
        self.points[0] * self.points[1]
    }

    fn name(&self, point: PointId) -> PointName {
        PointName::Point(self.place_of(point))
    }

    fn find(&self, field: &str, name: PointName) -> Result<PointId> {
        let [nx, ny] = self.points;
        match name {
            PointName::Point([i, j]) if i < nx && j < ny => Ok(self.point([i, j])),
            PointName::Point(_) => {
                let message = format!("{name} is not on the sheet of {nx} × {ny} points");
                Err(Refusal::new(Reason::OffTissue, field, message))
            }
            PointName::Vertex(_) => {
                let message = format!("is the number of a vertex; a point of a sheet is [i, j], here of {nx} × {ny}");
                Err(Refusal::new(Reason::WrongKind, field, message))
            }
        }
    }

    fn rest_m(&self, point: PointId) -> DVec3 {
        let [i, j] = self.place_of(point);
        self.spacing_m * DVec3::new(i as f64, j as f64, 0.0)
    }

    fn normal(&self, _: PointId) -> DVec3 {
        DVec3::Z
    }

    fn is_fixed(&self, point: PointId) -> bool {
        let ([nx, ny], [i, j]) = (self.points, self.place_of(point));
        let (rim_x, rim_y) = (i == 0 || i + 1 == nx, j == 0 || j + 1 == ny);
        match &self.fixed {
            FixedPoints::Edges => rim_x || rim_y,
            FixedPoints::Corners => rim_x && rim_y,
            FixedPoints::Points(points) => points.contains([i, j]),
        }
    }

    /// Returns the points at the other ends of the structural and the shear springs.
    fn neighbours(&self, point: PointId) -> Vec<PointId> {
        let ([nx, ny], [i, j]) = (self.points, self.place_of(point));
        let around = |at: usize, count: usize| at.saturating_sub(1)..(at + 2).min(count);
        let all = around(i, nx).flat_map(|i| around(j, ny).map(move |j| [i, j]));
        all.filter(|place| *place != [i, j]).map(|place| self.point(place)).collect()
    }

    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn nearest(&self, place_m: DVec3) -> PointId {
        let along =
            |axis: usize| (place_m[axis] / self.spacing_m).round().clamp(0.0, (self.points[axis] - 1) as f64) as usize;
        self.point([along(0), along(1)])
    }

    /// Returns the points of the square around the circle.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn around(&self, place_m: DVec3, radius_m: f64) -> Vec<PointId> {
        let within = |axis: usize| {
            let [from, to] = [-radius_m, radius_m].map(|off_m| (place_m[axis] + off_m) / self.spacing_m);
            let last = self.points[axis] - 1;
            (from.ceil().max(0.0) as usize).min(last)..=(to.floor().max(0.0) as usize).min(last)
        };
        within(0).flat_map(|i| within(1).map(move |j| [i, j])).map(|place| self.point(place)).collect()
    }

    fn extent(&self) -> Extent {
        Extent { least_m: DVec3::ZERO, most_m: self.extent_m().extend(0.0) }
    }

    fn edge_m(&self) -> f64 {
        self.spacing_m
    }

    fn in_rest_space_m(&self, place_m: DVec3) -> DVec3 {
        place_m.truncate().extend(0.0)
    }

    fn dimensions(&self) -> usize {
        2
    }

    fn in_plane_m(&self, _: &str, place_m: DVec2) -> Result<DVec3> {
        Ok(place_m.extend(0.0))
    }

    fn grid(&self) -> Option<[usize; 2]> {
        Some(self.points)
    }

    /// Returns two triangles for each cell.
    #[allow(clippy::cast_possible_truncation)]
    fn triangles(&self) -> Vec<[u32; 3]> {
        let [nx, ny] = self.points.map(|points| points as u32);
        let cells = (0..nx.saturating_sub(1)).flat_map(|i| (0..ny.saturating_sub(1)).map(move |j| i * ny + j));
        cells.flat_map(|at| [[at, at + ny, at + ny + 1], [at, at + ny + 1, at + 1]]).collect()
    }

    fn is_uniform(&self) -> bool {
        true
    }

    fn representative_m(&self, radius_m: f64, noticed_m: f64, place_m: DVec3) -> DVec3 {
        representative::of(self, radius_m, noticed_m, place_m.truncate()).extend(0.0)
    }

    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn cell_around(&self, place_m: DVec3) -> Option<GridCell> {
        let along = |axis: usize| {
            let last = self.points[axis] - 1;
            let at = (place_m[axis] / self.spacing_m).clamp(0.0, last as f64);
            let from = (at as usize).min(last.saturating_sub(1));
            ([from, (from + 1).min(last)], at - from as f64)
        };
        let ((i, s), (j, t)) = (along(0), along(1));
        Some(GridCell { corners: i.map(|i| j.map(|j| self.point([i, j]))), part: [s, t] })
    }

    /// Returns the lowest place over the sheet, and the middle of the sheet as the place that is pressed: the sheet is
    /// the same everywhere.
    fn deepest(&self, way_m: &[DVec3], radius_m: f64) -> Option<Deepest> {
        let extent = self.extent();
        let parts = way_m.windows(2).filter_map(|pair| extent.part_beneath_m([pair[0], pair[1]], radius_m));
        let lowest_m = parts.flatten().map(|place_m| place_m.z).reduce(f64::min)?;
        Some(Deepest { depth_m: extent.most_m.z - lowest_m, rest_m: extent.middle_m() })
    }

    fn beyond_rim_m(&self, place_m: DVec3) -> f64 {
        self.extent().beside_m(place_m).length()
    }

    fn faces_up(&self) -> bool {
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shape;

    const SHEET: fn(FixedPoints) -> Sheet =
        |fixed| Sheet { points: [3, 7], spacing_m: 0.01, point_mass_kg: 0.1, fixed };

    #[test]
    fn points_of_a_grid_are_numbered_by_rows_and_found_by_name_and_place() {
        let sheet = SHEET(FixedPoints::Corners);
        let places: Vec<[usize; 2]> = (0..3).flat_map(|i| (0..7).map(move |j| [i, j])).collect();
        assert_eq!(shape::points(&sheet).map(|point| sheet.place_of(point)).collect::<Vec<_>>(), places);
        for point in shape::points(&sheet) {
            assert_eq!(sheet.find("", sheet.name(point)), Ok(point));
            assert_eq!(sheet.nearest(sheet.rest_m(point) + DVec3::new(0.004, -0.004, 9.0)), point);
            assert_eq!(sheet.is_fixed(point), [0, 6, 14, 20].contains(&point.index()));
        }
        let refused = sheet.find("points[3]", PointName::Point([3, 0])).unwrap_err();
        assert_eq!(refused.to_string(), "points[3]: [3, 0] is not on the sheet of 3 × 7 points");
    }

    #[test]
    fn neighbours_know_each_other_and_lie_within_a_diagonal() {
        let sheet = SHEET(FixedPoints::Edges);
        let counts: Vec<usize> = shape::points(&sheet).map(|point| sheet.neighbours(point).len()).collect();
        assert_eq!(&counts[..7], [3, 5, 5, 5, 5, 5, 3]);
        assert_eq!(&counts[7..14], [5, 8, 8, 8, 8, 8, 5]);
        for point in shape::points(&sheet) {
            assert_eq!(sheet.normal(point), DVec3::Z);
            let neighbours = sheet.neighbours(point);
            assert!(neighbours.is_sorted());
            for other in neighbours {
                assert!(sheet.neighbours(other).contains(&point));
                let apart_m = sheet.rest_m(point).distance(sheet.rest_m(other));
                assert!((0.99..1.5).contains(&(apart_m / sheet.edge_m())));
            }
        }
    }

    #[test]
    fn a_part_of_a_sheet_is_a_corner_and_one_of_its_points_is_its_middle() {
        for points in [[1, 1], [1, 2], [2, 1], [9, 1], [1, 8], [2, 2], [11, 4], [12, 12], [40, 13]] {
            let (part, looked_at) = Sheet { points, ..SHEET(FixedPoints::Corners) }.part(12);
            assert_eq!(part.points, points.map(|count| count.min(12)));
            assert!(looked_at.iter().all(|point| point.index() < part.point_count()) && !part.is_fixed(looked_at[0]));
            let middle = part.place_of(looked_at[1]);
            for axis in 0..2 {
                // As far from either end, or nearer to the last by one point.
                let after = part.points[axis] - 1 - middle[axis];
                assert!(middle[axis] == after || middle[axis] == after + 1, "{points:?}: {middle:?}");
            }
        }
    }

    #[test]
    fn a_place_is_near_up_to_a_tenth_of_the_longest_side() {
        let sheet = SHEET(FixedPoints::Edges);
        assert_eq!(sheet.extent().middle_m(), DVec3::new(0.01, 0.03, 0.0));
        for (place_m, is_near) in
            [([-0.0059, 0.0], true), ([-0.0061, 0.0], false), ([0.01, 0.0659], true), ([0.01, 0.0661], false)]
        {
            assert_eq!(sheet.check_place("at", DVec2::from(place_m).extend(0.0)).is_ok(), is_near, "{place_m:?}");
        }
        let single = Sheet { points: [1, 1], ..sheet };
        assert_eq!(single.longest_side_m(), 0.01);
    }
}
