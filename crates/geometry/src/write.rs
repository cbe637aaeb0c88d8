//! Writes meshes to files: OBJ, STL and PLY. Lengths are in metres.

use std::collections::BTreeMap;
use std::fmt::Write;

use crate::{Problem, TriangleMesh};

/// A file format that [`write()`] can write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Wavefront OBJ, with texture coordinates and groups.
    Obj,
    /// STL, binary: positions in single precision; no groups and texture coordinates, and vertices are not shared.
    Stl,
    /// PLY, binary, little-endian, with texture coordinates and without groups.
    Ply,
}

impl Format {
    /// Returns the format for the extension of a file name: `.obj`, `.stl` or `.ply`, also in capitals.
    ///
    /// # Errors
    /// Returns [`Problem::Unsupported`] for other extensions, and for a name without one.
    pub fn of(name: &str) -> Result<Self, Problem> {
        let extension = name.rsplit_once('.').map_or(String::new(), |(_, extension)| extension.to_ascii_lowercase());
        match extension.as_str() {
            "obj" => Ok(Format::Obj),
            "stl" => Ok(Format::Stl),
            "ply" => Ok(Format::Ply),
            _ => Err(Problem::Unsupported { message: "meshes are written as .obj, .stl or .ply".to_owned() }),
        }
    }
}

/// Returns the contents of a file with this mesh, lengths in metres. OBJ and PLY keep positions exactly; STL rounds
/// them to single precision. Only OBJ keeps groups: a triangle is in the groups that contain its three vertices, and
/// spaces in names become `_`. Nothing is checked: an index out of range is written as it is (in STL, as a corner at
/// the origin).
#[must_use]
pub fn write(mesh: &TriangleMesh, format: Format) -> Vec<u8> {
    match format {
        Format::Obj => obj(mesh).into_bytes(),
        Format::Stl => stl(mesh),
        Format::Ply => ply(mesh),
    }
}

/// Returns the groups of each triangle: those that contain all its vertices.
fn groups_of(mesh: &TriangleMesh) -> Vec<Vec<usize>> {
    let mut of_vertex: Vec<Vec<usize>> = vec![Vec::new(); mesh.vertices_m.len()];
    for (number, group) in mesh.groups.iter().enumerate() {
        for vertex in &group.vertices {
            if let Some(groups) = of_vertex.get_mut(*vertex as usize) {
                groups.push(number);
            }
        }
    }
    let has = |vertex: u32, group: &usize| of_vertex.get(vertex as usize).is_some_and(|groups| groups.contains(group));
    let of = |[a, b, c]: &[u32; 3]| -> Vec<usize> {
        let first = of_vertex.get(*a as usize).map_or(&[][..], Vec::as_slice);
        first.iter().copied().filter(|group| has(*b, group) && has(*c, group)).collect()
    };
    mesh.triangles.iter().map(of).collect()
}

fn obj(mesh: &TriangleMesh) -> String {
    let mut text = String::from("# lengths in metres\n");
    // Writing to a string can't fail.
    for at in &mesh.vertices_m {
        let _ = writeln!(text, "v {} {} {}", at.x, at.y, at.z);
    }
    // Corners with equal texture coordinates share one entry.
    let mut numbers = BTreeMap::new();
    for uv in mesh.uv.iter().flatten().flatten() {
        let count = numbers.len() + 1;
        numbers.entry(uv.map(f32::to_bits)).or_insert_with(|| {
            let _ = writeln!(text, "vt {} {}", uv[0], uv[1]);
            count
        });
    }
    let groups = groups_of(mesh);
    let mut current: &[usize] = &[];
    for (number, triangle) in mesh.triangles.iter().enumerate() {
        let own = groups[number].as_slice();
        if own != current {
            text.push('g');
            for group in own {
                let name: String = mesh.groups[*group].name.split_whitespace().collect::<Vec<_>>().join("_");
                let _ = write!(text, " {name}");
            }
            text.push('\n');
            current = own;
        }
        text.push('f');
        for (corner, vertex) in triangle.iter().enumerate() {
            let _ = write!(text, " {}", u64::from(*vertex) + 1);
            let uv = mesh.uv.as_ref().and_then(|uv| numbers.get(&uv.get(number)?[corner].map(f32::to_bits)));
            if let Some(uv) = uv {
                let _ = write!(text, "/{uv}");
            }
        }
        text.push('\n');
    }
    text
}

#[allow(clippy::cast_possible_truncation)]
fn stl(mesh: &TriangleMesh) -> Vec<u8> {
    let mut bytes = b"binary STL, lengths in metres".to_vec();
    bytes.resize(80, b' ');
    bytes.extend((mesh.triangles.len() as u32).to_le_bytes());
    for triangle in &mesh.triangles {
        let at = triangle.map(|vertex| mesh.vertices_m.get(vertex as usize).copied().unwrap_or_default());
        let normal = (at[1] - at[0]).cross(at[2] - at[0]).normalize_or_zero();
        for vector in [normal, at[0], at[1], at[2]] {
            vector.to_array().iter().for_each(|part| bytes.extend((*part as f32).to_le_bytes()));
        }
        bytes.extend([0, 0]);
    }
    bytes
}

fn ply(mesh: &TriangleMesh) -> Vec<u8> {
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\ncomment lengths in metres\nelement vertex {}\nproperty double x\n\
         property double y\nproperty double z\nelement face {}\nproperty list uchar int vertex_indices\n{}end_header\n",
        mesh.vertices_m.len(),
        mesh.triangles.len(),
        if mesh.uv.is_some() { "property list uchar float texcoord\n" } else { "" }
    )
    .into_bytes();
    for at in &mesh.vertices_m {
        at.to_array().iter().for_each(|part| bytes.extend(part.to_le_bytes()));
    }
    for (number, triangle) in mesh.triangles.iter().enumerate() {
        bytes.push(3);
        triangle.iter().for_each(|vertex| bytes.extend(vertex.to_le_bytes()));
        if let Some(uv) = mesh.uv.as_ref().and_then(|uv| uv.get(number)) {
            bytes.push(6);
            uv.iter().flatten().for_each(|part| bytes.extend(part.to_le_bytes()));
        }
    }
    bytes
}
