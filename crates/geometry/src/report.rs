//! Reports on a mesh: size, counts, holes, volume, uniformity, and problems.

use std::collections::BTreeMap;
use std::fmt;

use glam::DVec3;
use serde::Serialize;
use serde::ser::{SerializeStruct, Serializer};

use crate::format;
use crate::join::{Odd, join, places};
use crate::orient::orient;
use crate::read::ReadLimits;
use crate::topology::{Topology, is_proper};
use crate::tree::{Tree, corners, cut};
use crate::{Element, MeshError, Problem, TriangleMesh, Unit};

/// Maximum number of elements that a report lists for each kind of problem, and of borders. All are counted.
pub const LISTED: usize = 10;

/// Ratio of the largest to the smallest edge length or area above which a warning is given.
const SPREAD: f64 = 100.0;

/// Plausible range for the longest side of an organ, m. Outside this range, the unit is questioned.
const LENGTHS_M: [f64; 2] = [0.005, 5.0];

/// Coordinates of reported positions below this fraction of the longest side are rounding errors.
const NOISE: f64 = 1e-9;

/// Maximum number of boxes that the check for self-intersection visits per triangle.
const LOOKS: u64 = 400;

/// Minimum, median and maximum of some values, in their unit; all 0 if there are no values.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Spread {
    /// The minimum.
    pub least: f64,
    /// The median; of an even number of values, the larger of the two middle ones.
    pub median: f64,
    /// The maximum.
    pub largest: f64,
}

impl Spread {
    fn of(mut values: Vec<f64>) -> Self {
        if values.is_empty() {
            return Self::default();
        }
        values.sort_unstable_by(f64::total_cmp);
        Self { least: values[0], median: values[values.len() / 2], largest: values[values.len() - 1] }
    }

    /// Returns the ratio of the maximum to the minimum. `None` if there are no values, or if the minimum is 0.
    #[must_use]
    pub fn ratio(&self) -> Option<f64> {
        (self.least > 0.0).then(|| self.largest / self.least)
    }
}

/// A problem of a mesh, and where it is.
#[derive(Debug, Clone, PartialEq)]
pub struct Finding {
    /// The problem.
    pub problem: Problem,
    /// The element that has the problem; [`Element::Whole`] for the mesh as a whole.
    pub element: Element,
    /// Position of the element in space, m: the middle of an edge or triangle; `None` if it has no finite one.
    pub place_m: Option<[f64; 3]>,
}

impl Finding {
    /// Renumbers vertices and triangles.
    pub(crate) fn rename(&mut self, vertex: impl Fn(u32) -> u32, triangle: impl Fn(u32) -> u32) {
        match &mut self.problem {
            Problem::DuplicateVertex { of } => *of = vertex(*of),
            Problem::SelfIntersection { by } => *by = triangle(*by),
            _ => {}
        }
        self.element.rename(vertex, triangle);
    }
}

impl Serialize for Finding {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut fields = serializer.serialize_struct("Finding", 5)?;
        fields.serialize_field("what", self.problem.name())?;
        fields.serialize_field("element", &self.element.to_string())?;
        fields.serialize_field("place_m", &self.place_m)?;
        fields.serialize_field("refused", &self.problem.is_refused())?;
        fields.serialize_field("message", &self.problem.to_string())?;
        fields.end()
    }
}

impl Finding {
    /// Describes the finding in one line: the element, its position in `unit` if it has one, and what to do. Of a
    /// finding on the whole mesh, only the last.
    #[must_use]
    pub fn text(&self, unit: Unit) -> String {
        let at = self.place_m.map(|place_m| format!(" at {}", format::place(place_m, unit))).unwrap_or_default();
        match &self.element {
            Element::Whole => self.problem.to_string(),
            element => format!("{element}{at}: {}", self.problem),
        }
    }
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text(Unit::METRE))
    }
}

/// A border of a surface: a hole in it, or the outer boundary (rim) of an open surface.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Border {
    /// Number of its edges.
    pub edges: usize,
    /// Length of all its edges, m.
    pub length_m: f64,
    /// Whether it is at least as long as the diagonal of the bounding box: it is then probably the rim of an open
    /// surface rather than a hole.
    pub is_rim: bool,
    /// Mean position of its vertices, m.
    pub place_m: [f64; 3],
}

impl Border {
    /// Returns "rim" if [`Border::is_rim`] is true, otherwise "hole".
    #[must_use]
    pub fn name(&self) -> &'static str {
        if self.is_rim { "rim" } else { "hole" }
    }

    /// Describes the border in one line, with its length and position in `unit`: "hole of 3 edges, 12 mm around, at
    /// …".
    #[must_use]
    pub fn text(&self, unit: Unit) -> String {
        let (length, place) = (format::length(self.length_m, unit), format::place(self.place_m, unit));
        format!("{} of {} edges, {length} around, at {place}", self.name(), self.edges)
    }
}

impl From<MeshError> for Finding {
    fn from(error: MeshError) -> Self {
        Self { problem: error.problem, element: error.element, place_m: error.place_m }
    }
}

/// A report on a mesh. If the mesh exceeds the limits, has a coordinate that is not finite or an index out of range,
/// it has only the numbers of vertices and triangles, and these problems; everything else is 0 or empty.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct MeshReport {
    /// Number of vertices.
    pub vertices: usize,
    /// Number of triangles.
    pub triangles: usize,
    /// Number of connected surfaces: sets of triangles that share no vertex with others.
    pub components: usize,
    /// Number of borders of the surface: closed loops of edges that belong to only one triangle.
    pub holes: usize,
    /// The longest borders, in descending order of length; at most [`LISTED`].
    pub borders: Vec<Border>,
    /// The volume inside, m³, negative if the surface faces inwards: Σ a·(b × c)/6 over the triangles (a, b, c), by
    /// the theorem of Gauss with the field x/3. `None` unless the surface is closed and consistently oriented.
    pub volume_m3: Option<f64>,
    /// The area of all triangles (a, b, c), m²: Σ |(b − a) × (c − a)|/2. Duplicates count each time.
    pub area_m2: f64,
    /// Dimensions of the bounding box of all triangles, m: x, y, z.
    pub extent_m: [f64; 3],
    /// Lengths of the edges, each edge once, m.
    pub edge_m: Spread,
    /// Areas of the triangles that have one, m².
    pub triangle_m2: Spread,
    /// Number of edges at a vertex, of the vertices that have one.
    pub valence: Spread,
    /// Problems: first those for which the mesh is refused, then the others, in the order in which they were found.
    /// At most [`LISTED`] of each kind.
    pub problems: Vec<Finding>,
    /// Number of problems of each kind, by [`Problem::name`], also of those that are not listed.
    pub counts: BTreeMap<&'static str, usize>,
}

impl MeshReport {
    /// Returns the first problem for which the mesh is refused ([`Problem::is_refused`]); `None` if it is accepted.
    #[must_use]
    pub fn refusal(&self) -> Option<&Finding> {
        self.problems.iter().find(|finding| finding.problem.is_refused())
    }

    /// Returns the first problem for which not even a solid can fill the triangles: one that is refused, and not only because
    /// of how they are joined ([`Problem::is_of_joints`]). `None` if they may enclose a space.
    #[must_use]
    pub fn refusal_of_solid(&self) -> Option<&Finding> {
        self.problems.iter().find(|finding| finding.problem.is_refused() && !finding.problem.is_of_joints())
    }
}

/// Collects problems.
#[derive(Default)]
struct Findings {
    list: Vec<Finding>,
    counts: BTreeMap<&'static str, usize>,
    /// Coordinates below this value are rounding errors, m.
    noise_m: f64,
}

impl Findings {
    fn add(&mut self, problem: Problem, element: Element, place: Option<DVec3>) {
        let count = self.counts.entry(problem.name()).or_default();
        *count += 1;
        if *count <= LISTED {
            let place_m = place.map(|place| without_noise(place, self.noise_m));
            self.list.push(Finding { problem, element, place_m });
        }
    }
}

/// Returns a position with coordinates below `noise_m` set to 0.
fn without_noise(place: DVec3, noise_m: f64) -> [f64; 3] {
    place.to_array().map(|part| if part.abs() < noise_m { 0.0 } else { part })
}

/// Reports on a mesh, with the default limits ([`ReadLimits`]). Any mesh is accepted, also one with faults.
#[must_use]
pub fn report(mesh: &TriangleMesh) -> MeshReport {
    report_within(mesh, &ReadLimits::default())
}

/// Reports on a mesh, also on one with faults. A mesh that exceeds the vertices or triangles of `limits` is only
/// counted.
#[must_use]
pub fn report_within(mesh: &TriangleMesh, limits: &ReadLimits) -> MeshReport {
    let mut findings = Findings::default();
    let (vertices, triangles) = (&mesh.vertices_m, &mesh.triangles);
    for (count, what, limit) in
        [(vertices.len(), "vertices", limits.vertices), (triangles.len(), "triangles", limits.triangles)]
    {
        if count > limit {
            findings.add(Problem::TooLarge { what, limit }, Element::Whole, None);
        }
    }
    for (number, _) in (0..).zip(vertices).filter(|(_, at)| !at.is_finite()) {
        findings.add(Problem::NotFinite, Element::Vertex(number), None);
    }
    for (number, triangle) in (0..).zip(triangles) {
        if let Some(vertex) = triangle.iter().find(|vertex| **vertex as usize >= vertices.len()) {
            let problem = Problem::IndexOutOfRange { index: i64::from(*vertex), vertices: vertices.len() };
            findings.add(problem, Element::Triangle(number), None);
        }
    }
    let mut report = MeshReport { vertices: vertices.len(), triangles: triangles.len(), ..MeshReport::default() };
    // If there are such problems, nothing else can be determined.
    if findings.list.is_empty() {
        examine(mesh, &mut report, &mut findings);
    }
    findings.list.sort_by_key(|finding| !finding.problem.is_refused());
    (report.problems, report.counts) = (findings.list, findings.counts);
    report
}

/// The area of a triangle, |(b − a) × (c − a)|/2, and whether it has one: its height is above rounding.
pub(crate) fn area([a, b, c]: [DVec3; 3]) -> (f64, bool) {
    let double = (b - a).cross(c - a).length();
    let longest = (b - a).length_squared().max((c - b).length_squared()).max((a - c).length_squared());
    // Twice the area divided by the longest side is the height.
    (double / 2.0, double > 1e-10 * longest)
}

/// Returns whether a triangle has a nonzero area.
pub(crate) fn has_area(vertices: &[DVec3], triangle: [u32; 3]) -> bool {
    is_proper(&triangle) && area(corners(vertices, triangle)).1
}

/// Returns the volume that oriented triangles enclose, m³, with a sign: Σ a·(b × c)/6, the tetrahedra between each triangle
/// and one point, which is near them, so that no digits are lost. Panics if a triangle names a vertex that is not there.
pub fn volume(vertices: &[DVec3], triangles: &[[u32; 3]]) -> f64 {
    let middle = triangles.first().map(|triangle| vertices[triangle[0] as usize]).unwrap_or_default();
    let of = |triangle: &[u32; 3]| {
        let [a, b, c] = corners(vertices, *triangle).map(|at| at - middle);
        a.dot(b.cross(c)) / 6.0
    };
    triangles.iter().map(of).sum()
}

/// Returns the dimensions of the bounding box of triangles; unused vertices are ignored.
pub(crate) fn extent(vertices: &[DVec3], triangles: &[[u32; 3]]) -> DVec3 {
    let used = || triangles.iter().flatten().map(|vertex| vertices[*vertex as usize]);
    let least = used().reduce(DVec3::min).unwrap_or_default();
    let most = used().reduce(DVec3::max).unwrap_or_default();
    most - least
}

/// Returns the borders of a surface, the longest first.
fn borders(vertices: &[DVec3], holes: &[Vec<u32>], extent: DVec3) -> Vec<Border> {
    let noise_m = NOISE * extent.max_element();
    let of = |hole: &Vec<u32>| {
        let at = || hole.iter().map(|vertex| vertices[*vertex as usize]);
        let length_m: f64 = at().zip(at().cycle().skip(1)).map(|(from, to)| from.distance(to)).sum();
        let middle = at().sum::<DVec3>() / hole.len() as f64;
        let is_rim = length_m >= extent.length();
        Border { edges: hole.len(), length_m, is_rim, place_m: without_noise(middle, noise_m) }
    };
    let mut borders: Vec<Border> = holes.iter().map(of).collect();
    borders.sort_by(|a, b| b.length_m.total_cmp(&a.length_m));
    borders.truncate(LISTED);
    borders
}

/// Examines a mesh whose coordinates are finite and whose indices are in range.
fn examine(mesh: &TriangleMesh, report: &mut MeshReport, findings: &mut Findings) {
    let (vertices, triangles) = (&mesh.vertices_m, &mesh.triangles);
    let at = |vertex: u32| Some(vertices[vertex as usize]);
    let middle = |triangle: u32| Some(corners(vertices, triangles[triangle as usize]).iter().sum::<DVec3>() / 3.0);
    if vertices.len() < 4 {
        findings.add(Problem::TooFewVertices { vertices: vertices.len() }, Element::Whole, None);
    }
    let extent = extent(vertices, triangles);
    report.extent_m = extent.to_array();
    findings.noise_m = NOISE * extent.max_element();

    let mut areas = Vec::with_capacity(triangles.len());
    let mut smallest = None;
    for (number, triangle) in (0..).zip(triangles) {
        let (area, has_area) = area(corners(vertices, *triangle));
        report.area_m2 += area;
        if has_area && is_proper(triangle) {
            areas.push(area);
            if smallest.is_none_or(|(least, _)| area < least) {
                smallest = Some((area, number));
            }
        } else {
            findings.add(Problem::Degenerate, Element::Triangle(number), middle(number));
        }
    }
    if areas.is_empty() {
        findings.add(Problem::OnlyDegenerate, Element::Whole, None);
    }
    report.triangle_m2 = Spread::of(areas);
    if let (Some(ratio), Some((_, number))) = (report.triangle_m2.ratio().filter(|ratio| *ratio > SPREAD), smallest) {
        findings.add(Problem::AreaSpread { ratio }, Element::Triangle(number), middle(number));
    }

    let topology = Topology::new(vertices.len(), triangles);
    report.components = topology.components;
    let holes = topology.holes();
    report.holes = holes.len();
    report.borders = borders(vertices, &holes, extent);
    if topology.components > 1 {
        findings.add(Problem::Components { count: topology.components }, Element::Whole, None);
    }
    let between = |[a, b]: [u32; 2]| Some((vertices[a as usize] + vertices[b as usize]) / 2.0);
    for edge in topology.non_manifold_edges() {
        let problem = Problem::NonManifoldEdge { triangles: topology.sides(edge).len() };
        findings.add(problem, Element::Edge(edge.vertices), between(edge.vertices));
    }
    for (vertex, fans) in (0..).zip(&topology.fans).filter(|(_, fans)| **fans > 1) {
        findings.add(Problem::NonManifoldVertex { fans: *fans as usize }, Element::Vertex(vertex), at(vertex));
    }
    let mut is_consistent = true;
    for edge in topology.inconsistent_edges() {
        is_consistent = false;
        findings.add(Problem::Orientation, Element::Edge(edge.vertices), between(edge.vertices));
    }
    for triangle in &topology.duplicates {
        findings.add(Problem::DuplicateTriangle, Element::Triangle(*triangle), middle(*triangle));
    }
    if topology.is_closed() && is_consistent {
        report.volume_m3 = Some(volume(vertices, triangles));
    }
    if is_consistent {
        let own: Vec<u32> = (0..).take(vertices.len()).collect();
        let parts = orient(vertices, triangles, &join(vertices, triangles, &own, Odd::Stay)).parts;
        for part in &parts {
            let problem = match (part.is_turned, part.is_cavity) {
                (true, false) => Problem::FacesInward,
                (true, true) => Problem::CavityFacesTissue,
                (false, _) if part.faces_inward => Problem::OpenFacesInward,
                (false, _) => continue,
            };
            let first = part.triangles.first().filter(|_| parts.len() > 1);
            let (element, place) = first.map_or((Element::Whole, None), |of| (Element::Triangle(*of), middle(*of)));
            findings.add(problem, element, place);
        }
    }

    let length = |edge: [u32; 2]| vertices[edge[0] as usize].distance(vertices[edge[1] as usize]);
    report.edge_m = Spread::of(topology.edges.iter().map(|edge| length(edge.vertices)).collect());
    let shortest = topology.edges.iter().min_by(|a, b| length(a.vertices).total_cmp(&length(b.vertices)));
    if let Some(edge) = shortest {
        let ratio = report.edge_m.ratio().unwrap_or(f64::INFINITY);
        if ratio > SPREAD {
            findings.add(Problem::EdgeSpread { ratio }, Element::Edge(edge.vertices), between(edge.vertices));
        }
    }
    report.valence = Spread::of(
        topology.valence.iter().filter(|valence| **valence > 0).map(|valence| f64::from(*valence)).collect(),
    );

    let mut is_used = vec![false; vertices.len()];
    triangles.iter().flatten().for_each(|vertex| is_used[*vertex as usize] = true);
    for (vertex, _) in (0..).zip(is_used).filter(|(_, is_used)| !is_used) {
        findings.add(Problem::UnusedVertex, Element::Vertex(vertex), at(vertex));
    }
    let places = places(vertices);
    for (vertex, of) in (0..).zip(&places).filter(|(vertex, of)| *vertex != **of) {
        findings.add(Problem::DuplicateVertex { of: *of }, Element::Vertex(vertex), at(vertex));
    }
    check_size(report.extent_m, findings);
    check_cuts(mesh, &places, findings);
}

/// Questions the unit of a mesh that is too small or too large for an organ.
fn check_size(extent_m: [f64; 3], findings: &mut Findings) {
    let longest_m = extent_m.into_iter().fold(0.0, f64::max);
    let fits = |length: f64| (LENGTHS_M[0]..=LENGTHS_M[1]).contains(&length);
    if longest_m == 0.0 || fits(longest_m) {
        return;
    }
    // The user may have confused two units. Suggests the one that results in the most typical organ size.
    let factors = [
        (1e-3, "1000 times smaller: mm instead of m"),
        (1e-2, "100 times smaller: cm instead of m"),
        (1e-1, "10 times smaller: mm instead of cm"),
        (1e1, "10 times larger: cm instead of mm"),
        (1e2, "100 times larger: m instead of cm"),
        (1e3, "1000 times larger: m instead of mm"),
    ];
    let unusual = |factor: f64| (longest_m * factor / 0.2).max(0.2 / (longest_m * factor));
    let fitting = factors.into_iter().filter(|(factor, _)| fits(longest_m * factor));
    let instead = fitting.min_by(|a, b| unusual(a.0).total_cmp(&unusual(b.0)));
    findings.add(Problem::Size { longest_m, instead: instead.map(|found| found.1) }, Element::Whole, None);
}

/// Looks for triangles that intersect each other, with a limit on the work.
fn check_cuts(mesh: &TriangleMesh, places: &[u32], findings: &mut Findings) {
    let (vertices, triangles) = (&mesh.vertices_m, &mesh.triangles);
    let at_places = |triangle: [u32; 3]| triangle.map(|vertex| places[vertex as usize]);
    let with_area = (0..).take(triangles.len()).filter(|number| has_area(vertices, triangles[*number as usize]));
    let with_area: Vec<u32> = with_area.collect();
    let tree = Tree::new(vertices, triangles, with_area.iter().copied());
    let mut left = LOOKS * with_area.len() as u64;
    for number in with_area {
        let at = corners(vertices, triangles[number as usize]);
        let own = at_places(triangles[number as usize]);
        let (least, most) = (at[0].min(at[1]).min(at[2]), at[0].max(at[1]).max(at[2]));
        let (mut looked, mut by) = (0, None);
        let boxes = tree.overlapping((vertices, triangles), [least, most], |other| {
            looked += 1;
            let triangle = triangles[other as usize];
            // Checks each pair once. Triangles with a common position touch in any case.
            if other > number && !at_places(triangle).iter().any(|place| own.contains(place)) {
                let is_cut = cut(at, corners(vertices, triangle));
                by = is_cut.then_some(other);
            }
            by.is_none() && looked <= left
        });
        if let Some(by) = by {
            findings.add(
                Problem::SelfIntersection { by },
                Element::Triangle(number),
                Some(at.iter().sum::<DVec3>() / 3.0),
            );
        }
        left = left.saturating_sub(boxes + looked);
        if left == 0 {
            findings.add(Problem::SelfIntersectionUnknown, Element::Whole, None);
            return;
        }
    }
}
