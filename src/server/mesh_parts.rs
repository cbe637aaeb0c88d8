//! The vertices and triangles of a tissue at rest, split into messages for viewers.

use palpate_geometry::Group;
use palpate_proto::pb;

use palpate_session::surface::{MESH_ROW, Refinement, Skin};

/// Vertices per message: 40 KiB with positions and texture coordinates.
const VERTICES_PER_PART: usize = 2048;

/// Triangles per message: at most 60 KiB.
const TRIANGLES_PER_PART: usize = 4096;

/// Vertices of groups per message: at most 16 KiB.
const MEMBERS_PER_PART: usize = 4096;

/// Returns message `part` of a tissue's surface: first the vertices, then the triangles. `skin` is the surface of a
/// mesh; without it, `grid` is that of a sheet. `None` after the last message.
pub(super) fn mesh_part(skin: Option<&Skin>, grid: Refinement, part: usize) -> Option<pb::GetMeshResponse> {
    skin.map_or_else(|| part_of_sheet(grid, part), |skin| part_of_mesh(skin, part))
}

#[allow(clippy::cast_possible_truncation)]
fn part_of_sheet(grid: Refinement, part: usize) -> Option<pb::GetMeshResponse> {
    const CELLS_PER_PART: usize = TRIANGLES_PER_PART / 2;
    let [nx, ny] = grid.vertices();
    let (vertices, cells) = (grid.vertex_count(), grid.cell_count());
    let vertex_parts = vertices.div_ceil(VERTICES_PER_PART);
    let parts = vertex_parts + cells.div_ceil(CELLS_PER_PART);
    if part >= parts {
        return None;
    }
    let mut message = pb::GetMeshResponse {
        vertices_x: nx as u32,
        vertices_y: ny as u32,
        vertex_spacing_m: grid.spacing_m(),
        last: part + 1 == parts,
        ..Default::default()
    };
    if part < vertex_parts {
        let first = part * VERTICES_PER_PART;
        for vertex in first..(first + VERTICES_PER_PART).min(vertices) {
            message.rest_position_m.extend(grid.rest_m(vertex).as_vec3().to_array());
            message.texture_coordinates.extend(grid.texture_at(vertex).as_vec2().to_array());
        }
    } else {
        let first = (part - vertex_parts) * CELLS_PER_PART;
        for cell in first..(first + CELLS_PER_PART).min(cells) {
            message.triangles.extend(grid.triangles(cell).map(|vertex| vertex as u32));
        }
    }
    Some(message)
}

/// Returns message `part` of a mesh. Its vertices are in the order of its frames; the groups are in the first
/// messages.
#[allow(clippy::cast_possible_truncation)]
fn part_of_mesh(skin: &Skin, part: usize) -> Option<pb::GetMeshResponse> {
    let (order, triangles) = (skin.vertices(), skin.triangles());
    let (vertices, members) = (order.len(), skin.groups().iter().map(|group| group.vertices.len()).sum::<usize>());
    let vertex_parts = vertices.div_ceil(VERTICES_PER_PART);
    let parts = (vertex_parts + triangles.len().div_ceil(TRIANGLES_PER_PART)).max(members.div_ceil(MEMBERS_PER_PART));
    if part >= parts {
        return None;
    }
    let mut message = pb::GetMeshResponse {
        vertices_x: vertices.div_ceil(MESH_ROW) as u32,
        vertices_y: MESH_ROW as u32,
        vertex_spacing_m: skin.edge_m(),
        groups: groups(skin.groups(), part),
        cut_rows: skin.cut_rows() as u32,
        last: part + 1 == parts,
        ..Default::default()
    };
    if part < vertex_parts {
        let first = part * VERTICES_PER_PART;
        for vertex in &order[first..(first + VERTICES_PER_PART).min(vertices)] {
            message.rest_position_m.extend(skin.rest_m(*vertex).as_vec3().to_array());
            message.texture_coordinates.extend(skin.texture_at(*vertex).into_iter().flatten());
            message.file_vertex.push(*vertex);
        }
    } else {
        let first = ((part - vertex_parts) * TRIANGLES_PER_PART).min(triangles.len());
        for triangle in &triangles[first..(first + TRIANGLES_PER_PART).min(triangles.len())] {
            message.triangles.extend(triangle.map(|vertex| skin.places()[vertex as usize]));
        }
    }
    Some(message)
}

/// Returns the groups in message `part`: the vertices of all groups in succession are split into parts of
/// `MEMBERS_PER_PART`.
fn groups(groups: &[Group], part: usize) -> Vec<pb::VertexGroup> {
    let (from, to) = (part * MEMBERS_PER_PART, (part + 1) * MEMBERS_PER_PART);
    let mut begin = 0;
    let mut found = Vec::new();
    for group in groups {
        let end = begin + group.vertices.len();
        if begin < to && end > from {
            let vertices = group.vertices[from.max(begin) - begin..to.min(end) - begin].to_vec();
            found.push(pb::VertexGroup { name: group.name.clone(), vertices });
        }
        begin = end;
    }
    found
}
