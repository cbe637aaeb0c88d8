//! Generated organs: shapes blended from simple solids, varied by a seed, and meshed evenly with a given edge length.
//!
//! A shape is a signed distance (`field`). Surface nets of a coarse grid create its first mesh (`net`), which
//! determines the surface's topology; `remesh` then makes it as fine and even as requested. Each organ is a file with
//! one function; [`Organ`] lists them. An organ, edge length and seed give equal bits on every machine.

mod colon;
mod field;
mod gallbladder;
mod halfedges;
mod kidney;
mod liver;
mod net;
mod patch;
mod phantom;
mod prostate;
mod remesh;
mod shape;
mod stomach;

use std::fmt;
use std::str::FromStr;

use crate::dice::Dice;
use net::Net;
use remesh::Remesh;
use shape::Shape;

use crate::{Group, TriangleMesh};

/// Limit on the approximate number of vertices of an organ; [`generate`] refuses shorter edges.
pub const MAX_VERTICES: usize = 500_000;

/// Area of an equilateral triangle with edges of length 1, √3/4; a vertex has twice that.
const EQUILATERAL: f64 = 0.433_012_701_892_219_3;

/// An organ, or a part of one, that [`generate`] can create. Sizes are those before the seed varies them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Organ {
    /// A gallbladder with its neck and the beginning of the cystic duct, 80 mm long. Groups: `bed` (the side at the
    /// liver), `neck`.
    Gallbladder,
    /// A liver with both lobes, 180 mm wide: domed above, hollow beneath, with a rim between. Groups: `rim`,
    /// `visceral` (the underside), `bare-area` (where the diaphragm holds it).
    Liver,
    /// A kidney, 110 mm long, with the beginnings of its vein and ureter. Group: `hilum`.
    Kidney,
    /// A stomach, 250 mm long, with the ends of the oesophagus and the duodenum. Groups: `cardia`, `pylorus`.
    Stomach,
    /// A segment of colon, 200 mm long and 50 mm wide, open at both ends: one wall with folds, which faces inward, so
    /// that it is touched from inside. Groups: `rim`, `folds`.
    Colon,
    /// A slightly curved square of tissue, 100 mm wide, open at its border, raised by lumps beneath. Groups: `rim`,
    /// `lumps`.
    Patch,
    /// A prostate, 46 mm wide: two lobes with a groove between, and a flat front. Groups: `front`, `apex`, `base`.
    Prostate,
    /// A block of 100 × 100 × 40 mm with rounded edges, as of silicone for tests of palpation; no seed varies it. Group:
    /// `base`.
    Phantom,
}

impl Organ {
    /// Every organ, in the order of the variants.
    pub const ALL: [Organ; 8] = [
        Organ::Gallbladder,
        Organ::Liver,
        Organ::Kidney,
        Organ::Stomach,
        Organ::Colon,
        Organ::Patch,
        Organ::Prostate,
        Organ::Phantom,
    ];

    /// Returns the organ's name in lower case, such as `liver`, which [`FromStr`] parses.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Organ::Gallbladder => "gallbladder",
            Organ::Liver => "liver",
            Organ::Kidney => "kidney",
            Organ::Stomach => "stomach",
            Organ::Colon => "colon",
            Organ::Patch => "patch",
            Organ::Prostate => "prostate",
            Organ::Phantom => "phantom",
        }
    }

    /// Returns a short description for people, without the name: its size and parts.
    #[must_use]
    pub fn description(self) -> &'static str {
        match self {
            Organ::Gallbladder => "80 mm, with its neck and the beginning of the cystic duct",
            Organ::Liver => "180 mm, both lobes, with the rim, the fissure and the bed of the gallbladder",
            Organ::Kidney => "110 mm, with the beginnings of its vein and ureter",
            Organ::Stomach => "250 mm, with the ends of the oesophagus and the duodenum",
            Organ::Colon => "a segment of 200 mm with its folds, open at both ends, touched from inside",
            Organ::Patch => "100 mm square, slightly curved, with lumps beneath, open at its border",
            Organ::Prostate => "46 mm, two lobes with the groove between them, flat at its front",
            Organ::Phantom => "a block of 100 × 100 × 40 mm, the same for every seed",
        }
    }

    /// Returns the shape for a seed.
    fn shape(self, seed: u64) -> Shape {
        let dice = &mut Dice::new(seed);
        match self {
            Organ::Gallbladder => gallbladder::shape(dice),
            Organ::Liver => liver::shape(dice),
            Organ::Kidney => kidney::shape(dice),
            Organ::Stomach => stomach::shape(dice),
            Organ::Colon => colon::shape(dice),
            Organ::Patch => patch::shape(dice),
            Organ::Prostate => prostate::shape(dice),
            Organ::Phantom => phantom::shape(),
        }
    }
}

impl fmt::Display for Organ {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for Organ {
    type Err = OrganError;

    fn from_str(name: &str) -> Result<Organ, OrganError> {
        let known = Organ::ALL.into_iter().find(|organ| organ.name() == name);
        known.ok_or_else(|| OrganError::Unknown { name: name.to_owned() })
    }
}

/// Reason why an organ can't be generated: [`generate`] returns all but the first, the parser of [`Organ`] the first.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum OrganError {
    /// There is no organ with this name.
    #[error("there is no organ `{name}`; there are {}", Organ::ALL.map(Organ::name).join(", "))]
    Unknown {
        /// The requested name.
        name: String,
    },
    /// The edge length is not a number above 0.
    #[error("the edge length must be a number of metres above 0, but is {edge_m}")]
    NotALength {
        /// The requested edge length, m.
        edge_m: f64,
    },
    /// The mesh would have too many vertices.
    #[error(
        "with edges of {} mm the {organ} would have about {vertices} vertices, more than {most}: edges of {} mm fit",
        in_mm(*edge_m),
        in_mm(*fits_m)
    )]
    TooFine {
        /// The organ.
        organ: Organ,
        /// The requested edge length, m.
        edge_m: f64,
        /// Approximate number of vertices that it would have.
        vertices: u64,
        /// The limit on vertices.
        most: usize,
        /// The smallest accepted edge length, m.
        fits_m: f64,
    },
    /// The edges are too long for the thinnest part of the organ.
    #[error(
        "edges of {} mm are too long for the thinnest parts of the {organ}: edges of {} mm fit",
        in_mm(*edge_m),
        in_mm(*fits_m)
    )]
    TooCoarse {
        /// The organ.
        organ: Organ,
        /// The requested edge length, m.
        edge_m: f64,
        /// The largest accepted edge length, m.
        fits_m: f64,
    },
    /// The shape for this seed touches itself and can't be meshed: another seed may work.
    #[error("the {organ} of seed {seed} touches itself and can't be meshed: take another seed")]
    NotAManifold {
        /// The organ.
        organ: Organ,
        /// The seed.
        seed: u64,
    },
}

/// Converts a length to millimetres, without the digits caused by rounding.
fn in_mm(length_m: f64) -> f64 {
    (length_m * 1e6).round() / 1e3
}

/// Generates the mesh of an organ, in metres. Its edges are about `edge_m` (m) long; `seed` varies its shape within
/// the usual range of adults. The mesh is a manifold in one part with texture coordinates, and closed except for the
/// colon and the patch. Each group is the set of vertices of whole triangles, so that formats that group triangles can
/// store it. Equal arguments give equal bits on every machine.
///
/// A surface of area A has about A/(½√3·l²) vertices with edges of length l: a triangle with equal sides has the area
/// ¼√3·l², and there are two of them for each vertex.
///
/// ```
/// use palpate_geometry::organ::{Organ, generate};
/// use palpate_geometry::report;
///
/// let mesh = generate(Organ::Gallbladder, 0.003, 1)?;
/// let report = report(&mesh);
/// assert_eq!((report.components, report.holes), (1, 0));
/// assert!((0.7..1.3).contains(&(report.edge_m.median / 0.003)), "edges of {} m", report.edge_m.median);
/// let names: Vec<&str> = mesh.groups.iter().map(|group| group.name.as_str()).collect();
/// assert_eq!(names, ["bed", "neck"]);
/// # Ok::<(), palpate_geometry::organ::OrganError>(())
/// ```
///
/// # Errors
/// Refuses an edge length that is not a finite number above 0 ([`OrganError::NotALength`]), that would give more than
/// about [`MAX_VERTICES`] ([`OrganError::TooFine`]), or that is too long for the thinnest part of the organ
/// ([`OrganError::TooCoarse`]); the last two name the nearest accepted one. Refuses a seed whose shape touches itself
/// ([`OrganError::NotAManifold`]).
pub fn generate(organ: Organ, edge_m: f64, seed: u64) -> Result<TriangleMesh, OrganError> {
    generate_within(organ, edge_m, seed, MAX_VERTICES)
}

/// Generates the mesh of an organ like [`generate`], with at most about `most` vertices in place of [`MAX_VERTICES`],
/// if `most` is less. An edge length whose estimate plus a tenth exceeds it is refused.
///
/// # Errors
/// Returns the refusals of [`generate`].
pub fn generate_within(organ: Organ, edge_m: f64, seed: u64, most: usize) -> Result<TriangleMesh, OrganError> {
    let most = most.min(MAX_VERTICES);
    if !(edge_m.is_finite() && edge_m > 0.0) {
        return Err(OrganError::NotALength { edge_m });
    }
    let shape = organ.shape(seed);
    let edge = edge_m * 1e3;
    // A tenth of a nanometre allows for the rounding of a length in metres.
    if edge > shape.coarsest + 1e-7 {
        return Err(OrganError::TooCoarse { organ, edge_m, fits_m: shape.coarsest * 1e-3 });
    }
    let net = Net::new(&shape);
    let vertices = |edge: f64| net.area() / (2.0 * EQUILATERAL * edge * edge);
    // A tenth more than computed, because the number of vertices varies; rounded up as in the message.
    let fits = (vertices(1.0) * 1.1 / most.max(1) as f64).sqrt();
    let fits = (fits * 1e3).ceil() / 1e3;
    if edge < fits - 1e-7 {
        return Err(OrganError::TooFine { organ, edge_m, vertices: vertices(edge) as u64, most, fits_m: fits * 1e-3 });
    }
    let mesh = Remesh::new(&shape, &net, edge).ok_or(OrganError::NotAManifold { organ, seed })?.even();

    let is_open = mesh.at_boundary.contains(&true);
    let rim = is_open.then(|| group("rim", &around(&mesh.at_boundary, &mesh.triangles), &mesh.triangles));
    let parts = shape.parts.iter().map(|(name, is_in)| {
        let within: Vec<bool> = mesh.places.iter().map(|&place| is_in(place)).collect();
        group(name, &within, &mesh.triangles)
    });
    Ok(TriangleMesh {
        groups: rim.into_iter().chain(parts).collect(),
        uv: Some(mesh.triangles.iter().map(|t| (shape.chart)(t.map(|v| mesh.places[v as usize]))).collect()),
        vertices_m: mesh.places.iter().map(|&place| place * 1e-3).collect(),
        triangles: mesh.triangles,
        regions: Vec::new(),
    })
}

/// Marks the vertices of all triangles that have a marked vertex.
fn around(marked: &[bool], triangles: &[[u32; 3]]) -> Vec<bool> {
    let mut within = vec![false; marked.len()];
    for triangle in triangles.iter().filter(|triangle| triangle.iter().any(|&v| marked[v as usize])) {
        triangle.iter().for_each(|&v| within[v as usize] = true);
    }
    within
}

/// Returns the group of the vertices of triangles that are completely within.
fn group(name: &str, within: &[bool], triangles: &[[u32; 3]]) -> Group {
    let whole = triangles.iter().filter(|triangle| triangle.iter().all(|&v| within[v as usize]));
    let mut vertices: Vec<u32> = whole.flatten().copied().collect();
    vertices.sort_unstable();
    vertices.dedup();
    Group { name: name.to_owned(), vertices }
}
