//! The rest shape of a tissue: its mass points, where they rest, and how they are joined. Code outside
//! `scene::sheet` and `scene::mesh` uses a tissue only through this interface, so that it works for grids and
//! meshes.

use std::fmt;
use std::str::FromStr;

use glam::{DVec2, DVec3};
use palpate_geometry::Group;
use serde::Serialize;

use palpate_refusal::{Reason, Refusal, Result, finite, legible};

/// A mass point of a tissue, as an index into arrays over all its points: 0 to [`RestShape::point_count`] − 1.
/// Point [i, j] of a sheet of nx × ny points has the index i·ny + j; on a mesh it is the number of the
/// simulated vertex. It is valid for one rest shape only; other names are in [`PointName`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PointId(usize);

impl PointId {
    /// Returns the point with this index in arrays over all points of the tissue. The index isn't checked: most
    /// functions panic on a point that the tissue does not have.
    pub fn new(index: usize) -> Self {
        PointId(index)
    }

    /// Returns the point's index, from 0, in arrays over all points of the tissue.
    pub fn index(self) -> usize {
        self.0
    }
}

/// The name of a point in scripts, records and messages, as people write it. [`RestShape::find`] gives its
/// point, [`RestShape::name`] the name of a point. As text, `FromStr` reads `X,Y` (a point of a sheet) or one
/// number (a vertex).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum PointName {
    /// Point [i, j] of a sheet, from [0, 0]: index i along x, index j along y.
    Point([usize; 2]),
    /// A vertex of a mesh, numbered from 0 as in its file, also if the simulated mesh has fewer vertices.
    Vertex(u32),
}

impl fmt::Display for PointName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            PointName::Point([i, j]) => write!(f, "[{i}, {j}]"),
            PointName::Vertex(vertex) => write!(f, "vertex {vertex}"),
        }
    }
}

impl FromStr for PointName {
    type Err = &'static str;

    fn from_str(text: &str) -> std::result::Result<Self, Self::Err> {
        let name = match text.split_once(',') {
            Some((i, j)) => i.trim().parse().ok().zip(j.trim().parse().ok()).map(|(i, j)| PointName::Point([i, j])),
            None => text.trim().parse().ok().map(PointName::Vertex),
        };
        name.ok_or("must be X,Y or the number of a vertex")
    }
}

/// The box around a shape at rest, parallel to the axes of the tissue's frame. A sheet's box is flat: z is 0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extent {
    /// The least of each coordinate, m.
    pub least_m: DVec3,
    /// The largest of each coordinate, m.
    pub most_m: DVec3,
}

impl Extent {
    /// Returns the box around places, m. Without places, `least_m` is +∞ and `most_m` is −∞.
    pub fn around(places_m: impl Iterator<Item = DVec3> + Clone) -> Self {
        let least_m = places_m.clone().fold(DVec3::INFINITY, DVec3::min);
        Extent { least_m, most_m: places_m.fold(DVec3::NEG_INFINITY, DVec3::max) }
    }

    /// Returns the middle of the box, m, in the tissue's frame. NaN for the box around no places.
    pub fn middle_m(&self) -> DVec3 {
        (self.least_m + self.most_m) / 2.0
    }

    /// Returns how far a place is beside the box along x and along y, m; 0 within it.
    pub fn beside_m(&self, place_m: DVec3) -> DVec2 {
        self.beyond_m(place_m).truncate()
    }

    /// Returns the distance of a place from the box, m; 0 within it.
    pub fn distance_m(&self, place_m: DVec3) -> f64 {
        self.beyond_m(place_m).length()
    }

    /// Returns how far a place is beyond the box along each axis, m; 0 within it.
    fn beyond_m(&self, place_m: DVec3) -> DVec3 {
        (self.least_m - place_m).max(place_m - self.most_m).max(DVec3::ZERO)
    }

    /// Returns the ends of the part of a straight path whose x and y are within the box, or within `margin_m` of it, m;
    /// `None` if no part is.
    pub fn part_beneath_m(&self, [from_m, to_m]: [DVec3; 2], margin_m: f64) -> Option<[DVec3; 2]> {
        let (mut begin, mut end) = (0.0_f64, 1.0_f64);
        for c in 0..2 {
            let (least_m, most_m) = (self.least_m[c] - margin_m, self.most_m[c] + margin_m);
            let way_m = to_m[c] - from_m[c];
            if way_m == 0.0 {
                if !(least_m..=most_m).contains(&from_m[c]) {
                    return None;
                }
                continue;
            }
            let [a, b] = [least_m, most_m].map(|edge_m| (edge_m - from_m[c]) / way_m);
            (begin, end) = (begin.max(a.min(b)), end.min(a.max(b)));
        }
        (begin <= end).then(|| [from_m.lerp(to_m, begin), from_m.lerp(to_m, end)])
    }

    /// Returns the length of the box along each axis, m.
    pub fn size_m(&self) -> DVec3 {
        self.most_m - self.least_m
    }
}

impl fmt::Display for Extent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [x, y, z] = self.size_m().to_array().map(legible);
        if z > 0.0 { write!(f, "{x} m × {y} m × {z} m") } else { write!(f, "{x} m × {y} m") }
    }
}

/// A place in a cell of a grid ([`RestShape::cell_around`]).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GridCell {
    /// The corners, by index along x, then along y; at the end of a side of one point two are the same.
    pub corners: [[PointId; 2]; 2],
    /// The place between the corners along x and along y, 0 to 1.
    pub part: [f64; 2],
}

impl GridCell {
    /// Returns the value at the place, bilinear between those of the corners.
    pub fn interpolate(&self, value: impl Fn(PointId) -> DVec3) -> DVec3 {
        let along_y = |[from, to]: [PointId; 2]| value(from).lerp(value(to), self.part[1]);
        let [from, to] = self.corners.map(along_y);
        from.lerp(to, self.part[0])
    }
}

/// The deepest place of a tip's path ([`RestShape::deepest`]).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deepest {
    /// Depth below the surface, on the side where the tip did not begin, m; negative if it stays away.
    pub depth_m: f64,
    /// The place of the tissue at rest that the tip presses there, m.
    pub rest_m: DVec3,
}

/// A place at a height above a triangle of the simulated surface. It moves and turns with the triangle: with the
/// corners a, b, c and the weights u, v, w it is at u·a + v·b + w·c + height·n, n the unit normal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoundPlace {
    /// The number of the triangle ([`RestShape::triangles`]), from 0.
    pub triangle: u32,
    /// Barycentric weights of the triangle's three vertices, in its order; each is at least 0 (but for
    /// rounding), and their sum is 1.
    pub barycentric: [f64; 3],
    /// Height of the place above the triangle at rest, along its normal, m; negative below it.
    pub height_m: f64,
}

/// A place within a cell of eight points. It moves with them, weighted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellPlace {
    /// The numbers of the points at the corners of the cell.
    pub points: [u32; 8],
    /// Trilinear weight of each; at least 0, with the sum 1.
    pub weights: [f64; 8],
}

impl CellPlace {
    /// Returns the point with the largest weight.
    pub fn most_moving(&self) -> PointId {
        let most = (0..8).max_by(|a, b| self.weights[*a].total_cmp(&self.weights[*b])).unwrap_or(0);
        PointId::new(self.points[most] as usize)
    }
}

/// The surface by which frames show a tissue whose points are no grid ([`RestShape::shown_surface`]). Vertices are numbered
/// as people and files number them.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ShownShape<'s> {
    /// Rest position of each vertex, m, in the tissue's frame.
    pub vertices_m: &'s [DVec3],
    /// The triangles, each as three vertices, anticlockwise seen from outside.
    pub triangles: &'s [[u32; 3]],
    /// Named groups of vertices; empty if there are none.
    pub groups: &'s [Group],
    /// How each vertex moves with a triangle of the simulated points ([`RestShape::triangles`]). Empty if the vertices are
    /// the points themselves, in their order, or move with cells.
    pub bound: &'s [BoundPlace],
    /// How each vertex moves with a cell of eight points; empty for a tissue without cells.
    pub in_cells: &'s [CellPlace],
}

/// The rest shape of a tissue: its points, in the tissue's frame (the axes of the scene or mesh file, m).
/// Points are numbered from 0 without a gap. It never changes. A method that takes a [`PointId`] panics if the
/// shape has no such point.
pub trait RestShape: fmt::Debug + Send + Sync {
    /// Returns the size in points as text for people, such as `31 × 31 points` or `500 vertices`.
    fn describe(&self) -> String;
    /// Returns the number of points, at least 1.
    fn point_count(&self) -> usize;
    /// Returns the name of a point. If a mesh is simulated more coarsely than its file, it is the number of a
    /// nearby vertex of the file.
    fn name(&self, point: PointId) -> PointName;
    /// Returns the point of a name. If a mesh is simulated more coarsely than its file, it is the vertex
    /// nearest to the named vertex of the file: several names may have the same point.
    ///
    /// # Errors
    /// Refuses a name that is beyond the shape ([`Reason::OffTissue`]), and a vertex of a sheet or a point [i,
    /// j] of a mesh ([`Reason::WrongKind`]); `field` is the key that the refusal gives.
    fn find(&self, field: &str, name: PointName) -> Result<PointId>;
    /// Returns the rest position of a point, m, in the tissue's frame.
    fn rest_m(&self, point: PointId) -> DVec3;
    /// Returns the unit normal of the surface at a point at rest, out of the tissue: +z on a sheet; on a mesh,
    /// the mean over the triangles around the vertex, weighted by area (+z if they have no area).
    fn normal(&self, point: PointId) -> DVec3;
    /// Returns whether the scene fixes a point, so that it never moves.
    fn is_fixed(&self, point: PointId) -> bool;
    /// Returns the points that are joined to a point by springs within the surface (structural and shear
    /// springs of a sheet, edges of a mesh), ascending, each once. Bending springs don't count.
    fn neighbours(&self, point: PointId) -> Vec<PointId>;
    /// Returns the point that rests nearest to a place, m; on a sheet, z of the place does not count. A vertex
    /// without an edge is never the nearest.
    fn nearest(&self, place_m: DVec3) -> PointId;
    /// Returns the points that rest within `radius_m` of a place, m, ascending, each once; empty if there are
    /// none. A sheet ignores z of the place and returns those of the square around the circle; for a place off
    /// the sheet, also some of its rim.
    fn around(&self, place_m: DVec3, radius_m: f64) -> Vec<PointId>;
    /// Returns the box around all points at rest; vertices without an edge don't count.
    fn extent(&self) -> Extent;
    /// Returns the usual distance between neighbours at rest, m: the spacing of a sheet, the mean length of a
    /// mesh's edges. It is the tissue's unit of length h.
    fn edge_m(&self) -> f64;

    /// Returns the highest place of the surface in line with the middle of the box, m, in the tissue's frame;
    /// on a sheet, the middle. Haptic devices have their origin there, so that a tip that comes down meets the
    /// tissue.
    fn top_m(&self) -> DVec3 {
        self.extent().middle_m()
    }

    /// Returns a place that stands for the tissue when nobody has chosen one, m: the disc of a first force law presses at
    /// the place of the rest surface nearest to it. By default it is the middle of the box.
    fn pressed_m(&self) -> DVec3 {
        self.extent().middle_m()
    }

    /// Returns the place, m, where a newly placed tool with a tip of `radius_m` begins on its way to `place_m`:
    /// on the side of `place_m`, and at least 2 mm farther off the surface at rest than `height_m`, where it would touch, so
    /// that it meets the surface as a hand does. A place at most `radius_m` inside a closed mesh counts as outside. `None` on a sheet, where a
    /// tool begins straight above `place_m`.
    fn approach_m(&self, _place_m: DVec3, _radius_m: f64, _height_m: f64) -> Option<DVec3> {
        None
    }

    /// Returns the place of the rest shape's own space that is nearest to a place, m: with z = 0 if the whole shape
    /// rests in that plane.
    fn in_rest_space_m(&self, place_m: DVec3) -> DVec3 {
        place_m
    }

    /// Computes now what the contact with a tool would compute at its first use, so that no step waits for it.
    fn prepare_contact(&self) {}

    /// Returns how many numbers give a place: 3, or 2 if the whole shape rests in the plane z = 0.
    fn dimensions(&self) -> usize {
        3
    }

    /// Returns the place in space of a place `[x, y]`, m, in the plane in which the whole shape rests.
    ///
    /// # Errors
    /// Refuses it if the shape does not rest in the plane z = 0 ([`Reason::WrongKind`]); `field` is the key that the
    /// refusal gives.
    fn in_plane_m(&self, field: &str, _place_m: DVec2) -> Result<DVec3> {
        let message = "is a place in the plane of a sheet; on a mesh give `vertex`, or `at_m`, a place in space";
        Err(Refusal::new(Reason::WrongKind, field, message))
    }

    /// Returns the points along x and y, if the points are a grid numbered row by row (index i·ny + j).
    fn grid(&self) -> Option<[usize; 2]> {
        None
    }

    /// Returns the triangles of the surface whose corners are points, each by these ([`PointId::index`]), counter-clockwise
    /// from outside; none if no part of the surface has points as its corners.
    fn triangles(&self) -> Vec<[u32; 3]> {
        Vec::new()
    }

    /// Returns the surface that frames show; `None` if the points are a grid, which frames show by its rows.
    fn shown_surface(&self) -> Option<ShownShape<'_>> {
        None
    }

    /// Returns the texture coordinates (u, v) of each vertex of [`RestShape::shown_surface`], if it has them. It unwinds
    /// with a refusal if there is no memory for them.
    fn shown_uv(&self) -> Option<Vec<[f32; 2]>> {
        None
    }

    /// Returns the number of vertices that frames show without refinement: those of [`RestShape::shown_surface`], or the
    /// points.
    fn shown_count(&self) -> usize {
        self.shown_surface().map_or(self.point_count(), |shown| shown.vertices_m.len())
    }

    /// Returns whether the tissue is the same everywhere but near its rim and its listed fixed points, so that one
    /// place can represent the others ([`RestShape::representative_m`]).
    fn is_uniform(&self) -> bool {
        false
    }

    /// Returns a place at rest, m, where a disc of `radius_m` (m) meets the tissue in the same way as at `place_m` (m),
    /// if a disc is noticed `noticed_m` (m) away from its middle. By default it is the point nearest to
    /// `place_m`.
    fn representative_m(&self, _radius_m: f64, _noticed_m: f64, place_m: DVec3) -> DVec3 {
        self.rest_m(self.nearest(place_m))
    }

    /// Returns the cell of four points around a place, m, if the points are a grid; a place beyond the rim is moved to
    /// it. `None` if the nearest point stands for the place.
    fn cell_around(&self, _place_m: DVec3) -> Option<GridCell> {
        None
    }

    /// Returns the deepest place of the path of a tip of `radius_m` (m) along `way_m` (m) in the tissue at rest; `None`
    /// if the tip is beside the tissue all the time.
    fn deepest(&self, way_m: &[DVec3], radius_m: f64) -> Option<Deepest>;

    /// Returns how far a place is beyond the rim at which the shape ends, m; 0 within it, and for a shape without a
    /// rim. A tip that touches there drags the rim along.
    fn beyond_rim_m(&self, _place_m: DVec3) -> f64 {
        0.0
    }

    /// Returns the largest radius of a tip, m, with the reason for it.
    fn most_tip_radius_m(&self) -> (f64, &'static str) {
        (self.longest_side_m(), "the longest side of the tissue")
    }

    /// Returns how many triangles are looked up to lay out a disc of `radius_m` (m) once; 0 if the cost of a disc has a
    /// bound, however large it is.
    fn disc_work(&self, _radius_m: f64) -> u64 {
        0
    }

    /// Returns whether rigid tips can touch it.
    fn takes_rigid_tips(&self) -> bool {
        false
    }

    /// Returns whether the normal of every point is +z, so that z alone tells how far a point was pressed.
    fn faces_up(&self) -> bool {
        false
    }

    /// Returns the longest side of the box around the shape, or [`RestShape::edge_m`] if that is longer, m.
    fn longest_side_m(&self) -> f64 {
        self.extent().size_m().max_element().max(self.edge_m())
    }

    /// Returns whether a place, m, is within the box around the shape, or beyond it along each axis by at most
    /// a tenth of its longest side ([`RestShape::longest_side_m`]): a tool that strokes over the edge is still
    /// felt.
    fn is_near(&self, place_m: DVec3) -> bool {
        let Extent { least_m, most_m } = self.extent();
        let margin_m = DVec3::splat(0.1 * self.longest_side_m());
        place_m.cmpge(least_m - margin_m).all() && place_m.cmple(most_m + margin_m).all()
    }

    /// Checks the place of a force, m.
    ///
    /// # Errors
    /// Refuses a place that is not finite ([`Reason::NotFinite`]), and one that is not near the shape
    /// ([`RestShape::is_near`], [`Reason::OffTissue`]); `field` is the key that the refusal gives.
    fn check_place(&self, field: &str, place_m: DVec3) -> Result<()> {
        for component in place_m.to_array() {
            finite(field, component)?;
        }
        if self.is_near(place_m) {
            return Ok(());
        }
        let ([x, y, z], extent) = (place_m.to_array().map(legible), self.extent());
        let message =
            format!("({x}, {y}, {z}) m is off the tissue, which is {extent}, by more than a tenth of its longest side");
        Err(Refusal::new(Reason::OffTissue, field, message))
    }
}

/// Returns all points of a shape, ascending: indices 0 to [`RestShape::point_count`] − 1, fixed points and
/// vertices without an edge included.
pub fn points(shape: &dyn RestShape) -> impl ExactSizeIterator<Item = PointId> + Clone + use<> {
    (0..shape.point_count()).map(PointId)
}
