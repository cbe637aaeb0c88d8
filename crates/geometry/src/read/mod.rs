//! Reads mesh files within limits: OBJ, STL, PLY, glTF, Gmsh, VTK, MEDIT, TetGen and Abaqus; and the
//! labels of NRRD, NIfTI and DICOM. Never panics, for any bytes.

mod abaqus;
mod allowance;
mod dicom;
mod draft;
mod gltf;
mod gmsh;
mod label_map;
mod medit;
mod nifti;
mod nodes;
mod nrrd;
mod obj;
mod ply;
mod polygon;
mod smooth_surface;
mod source;
mod stl;
mod tetgen;
mod volume;
mod voxels;
mod vtk;
mod vtk_xml;

use crate::{Element, MeshError, Problem, TriangleMesh, Unit};
use allowance::MemoryAllowance;
use draft::Draft;
use source::Source;

/// Memory that reading may take per byte of a file and of its neighbours, bytes, in addition to [`ROOM`]; files that
/// would take more are refused with [`Problem::TooLarge`]. Meshes written by programs take less than half of it.
pub const MULTIPLE: usize = 32;

/// Memory that reading may take for a file of any length, bytes; [`MULTIPLE`] adds to it.
pub const ROOM: usize = 2 << 20;

/// Limits for reading a mesh, all inclusive; more is refused with [`Problem::TooLarge`]. The default is 64 MiB, 500
/// 000 vertices and 1 000 000 triangles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ReadLimits {
    /// Maximum number of bytes of the file, and of everything unpacked from it.
    pub bytes: usize,
    /// Maximum number of vertices.
    pub vertices: usize,
    /// Maximum number of triangles, and of volume elements.
    pub triangles: usize,
}

impl Default for ReadLimits {
    fn default() -> Self {
        Self { bytes: 64 << 20, vertices: 500_000, triangles: 1_000_000 }
    }
}

/// A mesh that was read from a file, before it is prepared ([`crate::prepare()`]) or checked ([`crate::report()`]).
#[derive(Debug, Clone, PartialEq)]
pub struct ReadMesh {
    /// The mesh: coordinates are finite, in metres, and indices in range. It may be empty.
    pub mesh: TriangleMesh,
    /// Unit of the file's lengths.
    pub unit: Unit,
    /// What was done to it, and what was left out, one sentence each; empty if it is just what the file has.
    pub notes: Vec<String>,
}

/// The supported formats.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Format {
    Obj,
    Stl,
    Ply,
    Gltf,
    Gmsh,
    Vtk,
    VtkXml,
    Medit,
    TetGen,
    Abaqus,
    Nrrd,
    Nifti,
    Dicom,
}

impl Format {
    /// Returns the format by the beginning of the file; OBJ has no signature, and STL only a weak one.
    fn of_content(bytes: &[u8]) -> Option<Self> {
        let text = bytes.trim_ascii_start();
        let starts =
            |mark: &str| text.get(..mark.len()).is_some_and(|start| start.eq_ignore_ascii_case(mark.as_bytes()));
        if bytes.starts_with(b"glTF") || text.starts_with(b"{") {
            Some(Format::Gltf)
        } else if starts("ply\n") || starts("ply\r") || starts("ply ") {
            Some(Format::Ply)
        } else if starts("# vtk DataFile") {
            Some(Format::Vtk)
        } else if starts("<?xml") || starts("<VTKFile") {
            Some(Format::VtkXml)
        } else if starts("$MeshFormat") || starts("$NOD") || starts("$Comments") || starts("$PhysicalNames") {
            Some(Format::Gmsh)
        } else if starts("MeshVersionFormatted") {
            Some(Format::Medit)
        } else if starts("*Heading") || starts("*Node") {
            Some(Format::Abaqus)
        } else if bytes.starts_with(b"NRRD") {
            Some(Format::Nrrd)
        } else if nifti::is_plain(bytes) || nifti::is_gzip(bytes) {
            Some(Format::Nifti)
        } else if dicom::is_dicom(bytes) {
            Some(Format::Dicom)
        } else if stl::is_binary(bytes) || starts("solid") {
            Some(Format::Stl)
        } else {
            None
        }
    }

    fn of_extension(name: &str) -> Option<Self> {
        let (_, extension) = name.rsplit_once('.')?;
        match extension.to_ascii_lowercase().as_str() {
            "obj" => Some(Format::Obj),
            "stl" => Some(Format::Stl),
            "ply" => Some(Format::Ply),
            "gltf" | "glb" => Some(Format::Gltf),
            "msh" => Some(Format::Gmsh),
            "vtk" => Some(Format::Vtk),
            "vtp" | "vtu" => Some(Format::VtkXml),
            "mesh" | "meshb" => Some(Format::Medit),
            "node" | "ele" => Some(Format::TetGen),
            "inp" => Some(Format::Abaqus),
            "nrrd" | "nhdr" => Some(Format::Nrrd),
            "nii" | "gz" => Some(Format::Nifti),
            "dcm" => Some(Format::Dicom),
            _ => None,
        }
    }
}

/// Returns the bytes after a byte order mark of UTF-8, if there is one.
fn without_mark(bytes: &[u8]) -> &[u8] {
    bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes)
}

/// Returns whether a file is UTF-16: it has such a byte order mark, or starts with Latin letters of two bytes each.
fn is_utf16(bytes: &[u8]) -> bool {
    let is_wide = |zero: usize| {
        let pairs = bytes.get(..16).map(|bytes| bytes.chunks_exact(2));
        pairs.is_some_and(|mut pairs| pairs.all(|pair| pair[zero] == 0 && matches!(pair[1 - zero], 9..=13 | 32..=126)))
    };
    bytes.starts_with(b"\xff\xfe") || bytes.starts_with(b"\xfe\xff") || is_wide(0) || is_wide(1)
}

/// Reads the mesh file with the content `bytes`. The content determines the format, or else the extension of `name`,
/// which also appears in errors. `unit` is that of the file's lengths. Vertices keep their order in the file, numbered
/// from 0, unless a note says otherwise. `neighbours` returns the content of another file in the same folder by its
/// bare name, or `None` if it can't be read. Memory is limited ([`MULTIPLE`]), but not charged.
///
/// A file has no unit, so you tell it: here a corner of a cube with edges of 10 mm.
///
/// ```
/// use palpate_geometry::{ReadLimits, read, report};
///
/// let obj = b"v 0 0 0\nv 10 0 0\nv 0 10 0\nv 0 0 10\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
/// let mm = "mm".parse().expect("a unit");
/// let file = read("corner.obj", obj, mm, &|_| None, &ReadLimits::default())?;
/// let report = report(&file.mesh);
/// assert_eq!((report.vertices, report.triangles, report.holes), (4, 4, 0));
/// // A sixth of 1 cm³.
/// let volume_m3 = report.volume_m3.expect("the surface is closed");
/// assert!((volume_m3 - 1e-6 / 6.0).abs() < 1e-18, "{volume_m3} m³");
/// # Ok::<(), palpate_geometry::MeshError>(())
/// ```
///
/// # Errors
/// Refuses a file of an unknown format or an unsupported variant (UTF-16 text included), one that violates its format,
/// ends early, names a neighbour that can't be read, exceeds the limits or the memory for its size, or has coordinates
/// that are not finite or indices out of range. The error names the element.
pub fn read(
    name: &str,
    bytes: &[u8],
    unit: Unit,
    neighbours: &dyn Fn(&str) -> Option<Vec<u8>>,
    limits: &ReadLimits,
) -> Result<ReadMesh, MeshError> {
    read_paid(name, bytes, None, Some(unit), neighbours, limits, &mut |_| true)
}

/// Reads the surface around a label of a label map (NRRD, NIfTI or DICOM) like [`read`]: a closed surface without the stairs of
/// voxels, whose volume is that of the voxels with the label. [`read`] does so if a file has one label. Without `unit`, it is the
/// one that the file states, or else mm.
///
/// # Errors
/// Returns the refusals of [`read`], and refuses other formats, 0, and a label that no voxel has.
pub fn read_label(
    name: &str,
    bytes: &[u8],
    label: i64,
    unit: Option<Unit>,
    limits: &ReadLimits,
) -> Result<ReadMesh, MeshError> {
    read_paid(name, bytes, Some(label), unit, &|_| None, limits, &mut |_| true)
}

/// Reads a mesh file like [`read`], or with a `label` like [`read_label`], with memory paid by `pay`: before memory is allocated,
/// it is called with the total number of bytes for this file so far, a rising number, about 256 KiB in advance. It returns `false`
/// to refuse. Without `unit`, it is the one that a label map states, or else mm, and m of other files.
///
/// # Errors
/// Returns the refusals of [`read`] or [`read_label`], and [`Problem::TooLarge`] if `pay` refuses.
pub fn read_paid(
    name: &str,
    bytes: &[u8],
    label: Option<i64>,
    mut unit: Option<Unit>,
    neighbours: &dyn Fn(&str) -> Option<Vec<u8>>,
    limits: &ReadLimits,
    pay: &mut dyn FnMut(u64) -> bool,
) -> Result<ReadMesh, MeshError> {
    let fail = |problem| MeshError { file: name.to_owned(), element: Element::Whole, place_m: None, problem };
    if bytes.len() > limits.bytes {
        return Err(fail(Problem::TooLarge { what: "bytes", limit: limits.bytes }));
    }
    // A binary STL file may start with any bytes.
    let is_free = stl::is_binary(bytes);
    if !is_free && is_utf16(bytes) {
        let message = "the text is UTF-16, which no mesh format is: save it as ASCII or UTF-8".to_owned();
        return Err(fail(Problem::Unsupported { message }));
    }
    let bytes = if is_free { bytes } else { without_mark(bytes) };
    let by_name = Format::of_extension(name);
    let format = Format::of_content(bytes).or(by_name).ok_or_else(|| fail(Problem::UnknownFormat))?;
    let mut draft = Draft::new(limits, MemoryAllowance::new(bytes.len(), pay));
    if by_name.is_some_and(|by_name| by_name != format) {
        draft.notes.push(format!("The file's content is {format:?}, not what its extension says."));
    }
    let source = Source::new(name, bytes);
    if label.is_some() && !matches!(format, Format::Nrrd | Format::Nifti | Format::Dicom) {
        let message = format!("a file of {format:?} has no labels: leave `label` out");
        return Err(fail(Problem::Unsupported { message }));
    }
    match format {
        Format::Obj => obj::read(source, &mut draft)?,
        Format::Stl => stl::read(source, &mut draft)?,
        Format::Ply => ply::read(source, &mut draft)?,
        Format::Gltf => gltf::read(name, bytes, neighbours, &mut draft)?,
        Format::Gmsh => gmsh::read(source, &mut draft)?,
        Format::Vtk => vtk::read(source, &mut draft)?,
        Format::VtkXml => vtk_xml::read(name, bytes, &mut draft)?,
        Format::Medit => medit::read(source, &mut draft)?,
        Format::TetGen => tetgen::read(name, bytes, neighbours, &mut draft)?,
        Format::Abaqus => abaqus::read(source, &mut draft)?,
        Format::Nrrd | Format::Nifti | Format::Dicom => {
            let map = match format {
                Format::Nrrd => nrrd::read(source)?,
                Format::Nifti => nifti::read(name, bytes)?,
                _ => dicom::read(name, bytes, &mut draft.allowance)?,
            };
            map.surface(label, &mut draft).map_err(fail)?;
            let unit = *unit.get_or_insert(map.unit.unwrap_or(Unit::MILLIMETRE));
            if let Some(own) = map.unit.filter(|own| *own != unit) {
                let own_m = own.metres();
                draft.notes.push(format!("The file says that its lengths are in units of {own_m} m, not in {unit}."));
            }
        }
    }
    draft.finish(name, unit.unwrap_or_default())
}
