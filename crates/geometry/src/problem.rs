//! The faults of a mesh file or a mesh, where they are, and what the user can do about them.

use std::fmt;

use crate::Unit;
use crate::format::{length, place, rounded};

/// A fault of a mesh file or a mesh. Its text (`Display`) says what to do. A mesh with some faults is refused, with
/// others the user is warned ([`Problem::is_refused`]).
#[derive(Debug, Clone, PartialEq)]
pub enum Problem {
    /// A text is not a unit of length.
    Unit {
        /// The given text.
        text: String,
    },
    /// Neither the content nor the extension of a file identifies its format.
    UnknownFormat,
    /// The file breaks its format.
    Syntax {
        /// What was expected, or what is wrong.
        message: String,
    },
    /// The file uses a variant of its format that is not supported.
    Unsupported {
        /// The variant, and what to do.
        message: String,
    },
    /// The file is a label map of several labels, of which none was chosen.
    LabelMissing {
        /// The first labels of the file, at most 20, ascending, as text.
        labels: String,
    },
    /// No voxel of a label map has the chosen label.
    LabelUnknown {
        /// The label, and those of the file.
        message: String,
    },
    /// The file ends too early.
    Truncated {
        /// What is missing.
        missing: String,
    },
    /// Another file to which this file refers can't be read.
    NeighbourMissing {
        /// The name of that file, as given in this one.
        name: String,
    },
    /// The file or mesh exceeds a limit.
    TooLarge {
        /// The limited quantity: bytes, vertices, triangles, …
        what: &'static str,
        /// The limit.
        limit: usize,
    },
    /// A coordinate is not a number, or infinite.
    NotFinite,
    /// A triangle refers to a vertex that does not exist.
    IndexOutOfRange {
        /// The vertex number as in the file.
        index: i64,
        /// Number of vertices.
        vertices: usize,
    },
    /// The mesh has fewer than the 4 vertices that a tissue needs.
    TooFewVertices {
        /// Number of vertices.
        vertices: usize,
    },
    /// No triangle has an area.
    OnlyDegenerate,
    /// More than two triangles share an edge.
    NonManifoldEdge {
        /// Number of triangles that share it.
        triangles: usize,
    },
    /// Surfaces touch at a vertex without sharing an edge there.
    NonManifoldVertex {
        /// Number of surfaces.
        fans: usize,
    },
    /// Two triangles at an edge face opposite sides.
    Orientation,
    /// The triangles of a closed surface face inwards.
    FacesInward,
    /// The triangles of a cavity's wall, inside another closed surface, face the tissue.
    CavityFacesTissue,
    /// The triangles of an open surface face its middle.
    OpenFacesInward,
    /// A triangle has no area.
    Degenerate,
    /// A triangle has the vertices of an earlier one.
    DuplicateTriangle,
    /// A vertex has the position of an earlier one.
    DuplicateVertex {
        /// The earlier vertex.
        of: u32,
    },
    /// A vertex is in no triangle.
    UnusedVertex,
    /// Edge lengths differ by a factor of more than 100.
    EdgeSpread {
        /// Ratio of the longest to the shortest; infinite if the shortest is 0.
        ratio: f64,
    },
    /// Areas of triangles differ by a factor of more than 100.
    AreaSpread {
        /// Ratio of the largest to the smallest, triangles without area left out.
        ratio: f64,
    },
    /// The longest side is below 5 mm or above 5 m, which suggests another unit.
    Size {
        /// The longest side of the bounding box, m.
        longest_m: f64,
        /// The unit that would fit, in words, such as "1000 times smaller: mm instead of m"; `None` if none would.
        instead: Option<&'static str>,
    },
    /// Triangles cut through each other.
    SelfIntersection {
        /// The other triangle, which cuts the one that the finding names.
        by: u32,
    },
    /// The search for triangles that cut each other ended early.
    SelfIntersectionUnknown,
    /// The mesh has several surfaces that share no vertex.
    Components {
        /// Number of surfaces.
        count: usize,
    },
}

impl Problem {
    /// Returns the name of the kind of fault, for programs: lower case with underscores, such as `not_finite`. It is
    /// stable.
    #[must_use]
    pub fn name(&self) -> &'static str {
        match self {
            Problem::Unit { .. } => "unit",
            Problem::UnknownFormat => "unknown_format",
            Problem::Syntax { .. } => "syntax",
            Problem::Unsupported { .. } => "unsupported",
            Problem::LabelMissing { .. } => "label_missing",
            Problem::LabelUnknown { .. } => "label_unknown",
            Problem::Truncated { .. } => "truncated",
            Problem::NeighbourMissing { .. } => "neighbour_missing",
            Problem::TooLarge { .. } => "too_large",
            Problem::NotFinite => "not_finite",
            Problem::IndexOutOfRange { .. } => "index_out_of_range",
            Problem::TooFewVertices { .. } => "too_few_vertices",
            Problem::OnlyDegenerate => "only_degenerate",
            Problem::NonManifoldEdge { .. } => "non_manifold_edge",
            Problem::NonManifoldVertex { .. } => "non_manifold_vertex",
            Problem::Orientation => "orientation",
            Problem::FacesInward => "faces_inward",
            Problem::CavityFacesTissue => "cavity_faces_tissue",
            Problem::OpenFacesInward => "open_faces_inward",
            Problem::Degenerate => "degenerate",
            Problem::DuplicateTriangle => "duplicate_triangle",
            Problem::DuplicateVertex { .. } => "duplicate_vertex",
            Problem::UnusedVertex => "unused_vertex",
            Problem::EdgeSpread { .. } => "edge_spread",
            Problem::AreaSpread { .. } => "area_spread",
            Problem::Size { .. } => "size",
            Problem::SelfIntersection { .. } => "self_intersection",
            Problem::SelfIntersectionUnknown => "self_intersection_unknown",
            Problem::Components { .. } => "components",
        }
    }

    /// Returns whether the fault is in how triangles are joined: the mesh is no surface, but may have an inside.
    #[must_use]
    pub fn is_of_joints(&self) -> bool {
        matches!(self, Problem::NonManifoldEdge { .. } | Problem::NonManifoldVertex { .. } | Problem::Orientation)
    }

    /// Returns whether a file or mesh with this fault is refused; otherwise the user is warned.
    #[must_use]
    pub fn is_refused(&self) -> bool {
        !matches!(
            self,
            Problem::FacesInward
                | Problem::CavityFacesTissue
                | Problem::OpenFacesInward
                | Problem::Degenerate
                | Problem::DuplicateTriangle
                | Problem::DuplicateVertex { .. }
                | Problem::UnusedVertex
                | Problem::EdgeSpread { .. }
                | Problem::AreaSpread { .. }
                | Problem::Size { .. }
                | Problem::SelfIntersection { .. }
                | Problem::SelfIntersectionUnknown
                | Problem::Components { .. }
        )
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Problem::Unit { text } => write!(
                f,
                "`{text}` is not a unit: give m, cm, mm, or the metres of one unit as a number above 0 (for inches: 0.0254)"
            ),
            Problem::UnknownFormat => write!(
                f,
                "the format is not known: give a file that ends in .obj, .stl, .ply, .gltf, .glb, .msh, .vtk, .vtp, .vtu, .mesh, \
                 .meshb, .node, .ele, .inp, .nrrd, .nii, .nii.gz or .dcm"
            ),
            Problem::Syntax { message } | Problem::Unsupported { message } | Problem::LabelUnknown { message } => {
                f.write_str(message)
            }
            Problem::LabelMissing { labels } => write!(
                f,
                "the file is a label map: choose one of its labels {labels} (label = N of a scene, --label N)"
            ),
            Problem::Truncated { missing } => {
                write!(f, "the file ends early: {missing} is missing; copy or export it again")
            }
            Problem::NeighbourMissing { name } => write!(
                f,
                "the file `{name}`, which this one names, can't be read: put it into the same folder, or export one file \
                 that contains everything"
            ),
            Problem::TooLarge { what, limit } => write!(f, "more than {limit} {what}: give a smaller mesh"),
            Problem::NotFinite => write!(f, "a coordinate is not a finite number"),
            Problem::IndexOutOfRange { index, vertices } => {
                write!(f, "vertex {index} does not exist (vertices here: {vertices})")
            }
            Problem::TooFewVertices { vertices } => {
                write!(f, "too few vertices ({vertices}): a tissue needs at least 4")
            }
            Problem::OnlyDegenerate => write!(f, "no triangle has an area: there is no surface to touch"),
            Problem::NonManifoldEdge { triangles } => {
                write!(f, "{triangles} triangles share this edge, at most 2 can: --repair pairs them")
            }
            Problem::NonManifoldVertex { fans } => {
                write!(f, "{fans} surfaces touch at this vertex alone: --repair gives each its own vertex")
            }
            Problem::Orientation => {
                write!(f, "the triangles at this edge face opposite sides: --repair turns all to one side")
            }
            Problem::FacesInward => write!(f, "the closed surface faces inwards: --repair turns it outwards"),
            Problem::CavityFacesTissue => {
                write!(f, "the wall of a cavity faces the tissue around it: --repair turns it into the cavity")
            }
            Problem::OpenFacesInward => write!(
                f,
                "the open surface faces inwards, as the lining of a tube does: a tool outside of it touches its back; if that \
                 is not meant, turn its triangles, or close it (--repair fills small holes)"
            ),
            Problem::Degenerate => write!(f, "the triangle has no area: --repair drops it"),
            Problem::DuplicateTriangle => {
                write!(f, "an earlier triangle has the same vertices: --repair drops this one")
            }
            Problem::DuplicateVertex { of } => {
                write!(f, "at the position of vertex {of}, but not joined with it")
            }
            Problem::UnusedVertex => write!(f, "no triangle has this vertex: --repair drops it"),
            Problem::EdgeSpread { ratio } => write!(
                f,
                "the longest edge is {} times the shortest, here: short edges need short time steps; \
                 --vertices N makes edges more even",
                rounded(*ratio)
            ),
            Problem::AreaSpread { ratio } => write!(
                f,
                "the largest triangle is {} times the smallest, here: small masses need short time \
                 steps; --vertices N makes triangles more even",
                rounded(*ratio)
            ),
            Problem::Size { longest_m, instead } => {
                write!(
                    f,
                    "the longest side is {}, organs are 0.005 to 5 m long: check the unit",
                    length(*longest_m, Unit::METRE)
                )?;
                instead.map_or(Ok(()), |instead| write!(f, " ({instead})"))
            }
            Problem::SelfIntersection { by } => write!(f, "triangle {by} cuts through this one"),
            Problem::SelfIntersectionUnknown => {
                write!(f, "too many triangles overlap to find which cut each other")
            }
            Problem::Components { count } => {
                write!(f, "{count} separate surfaces: --repair keeps the largest and what is inside of it")
            }
        }
    }
}

/// A part of a file or of a mesh. Vertices, faces and triangles are numbered from 0, lines from 1.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Element {
    /// The whole file or mesh.
    Whole,
    /// A line of a text file.
    Line(u64),
    /// A byte of a binary file.
    Byte(u64),
    /// A vertex.
    Vertex(u32),
    /// A face of the file, before it is split into triangles.
    Face(u64),
    /// A triangle.
    Triangle(u32),
    /// The edge between two vertices.
    Edge([u32; 2]),
    /// A part that the format names: accessor 3, node 5.
    Part(&'static str, u64),
}

impl Element {
    /// Renumbers its vertices and triangles.
    pub(crate) fn rename(&mut self, vertex: impl Fn(u32) -> u32, triangle: impl Fn(u32) -> u32) {
        match self {
            Element::Vertex(number) => *number = vertex(*number),
            Element::Triangle(number) => *number = triangle(*number),
            Element::Edge(both) => {
                *both = both.map(vertex);
                both.sort_unstable();
            }
            Element::Whole | Element::Line(_) | Element::Byte(_) | Element::Face(_) | Element::Part(..) => {}
        }
    }
}

impl fmt::Display for Element {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Element::Whole => write!(f, "the whole"),
            Element::Line(line) => write!(f, "line {line}"),
            Element::Byte(byte) => write!(f, "byte {byte}"),
            Element::Vertex(vertex) => write!(f, "vertex {vertex}"),
            Element::Face(face) => write!(f, "face {face}"),
            Element::Triangle(triangle) => write!(f, "triangle {triangle}"),
            Element::Edge([a, b]) => write!(f, "edge {a}-{b}"),
            Element::Part(name, number) => write!(f, "{name} {number}"),
        }
    }
}

/// The reason why a mesh file is refused: file, element, place in space, and fault. Its text names all of them.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub struct MeshError {
    /// The file's name as the caller gave it.
    pub file: String,
    /// The part of the file or mesh that has the fault.
    pub element: Element,
    /// The position of that part, m; `None` if it has none or the position is not known.
    pub place_m: Option<[f64; 3]>,
    /// The fault.
    pub problem: Problem,
}

impl fmt::Display for MeshError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: ", self.file)?;
        if self.element != Element::Whole {
            write!(f, "{}", self.element)?;
            if let Some(place_m) = self.place_m {
                write!(f, " at {}", place(place_m, Unit::METRE))?;
            }
            write!(f, ": ")?;
        }
        write!(f, "{}", self.problem)
    }
}
