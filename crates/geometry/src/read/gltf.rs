//! glTF 2.0, as JSON with buffers and as GLB: nodes with their transforms, primitives, indices of all types.
//!
//! The JSON is parsed by `serde_json`. The crate `gltf` slices buffers without checks and panics on files with wrong
//! offsets and counts.

mod json;

use std::borrow::Cow;
use std::cell::Cell;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use glam::{DMat4, DQuat, DVec3};
use serde::Deserialize;

use super::draft::Draft;
use super::source::{Order, Scalar, named};
use super::without_mark;
use crate::{Element, MeshError, Problem};
use json::{Head, MAX_NESTED, Root, other_extension, other_version};

/// Memory for the short entries of lists in JSON: bytes per byte of its text, and at most.
const ENTRIES_MULTIPLE: usize = 24;
const MAX_ENTRIES: usize = 16 << 20;

/// Memory of a node that waits to be visited, with its transform.
const WAITING: usize = 2 * size_of::<(usize, DMat4)>();

/// A file that is being read.
struct GltfFile<'a> {
    name: &'a str,
    root: Root,
    buffers: Vec<Cow<'a, [u8]>>,
    /// Number of primitives so far, counted for each node that has them.
    primitives: Cell<usize>,
}

/// Returns the JSON and the binary part of a GLB file, or all of a glTF file.
fn parts<'a>(name: &str, bytes: &'a [u8]) -> Result<(&'a [u8], Option<&'a [u8]>), MeshError> {
    if !bytes.starts_with(b"glTF") {
        return Ok((bytes, None));
    }
    let fail = |at: usize, problem| MeshError {
        file: name.to_owned(),
        element: Element::Byte(at as u64),
        place_m: None,
        problem,
    };
    let word = |at: usize| bytes.get(at..at + 4).map(|word| Scalar::U32.integer(word, Order::Little));
    let version = word(4).ok_or_else(|| fail(4, Problem::Truncated { missing: "the version".to_owned() }))?;
    if version != 2 {
        return Err(fail(4, other_version(&format!("{version}.0"))));
    }
    let (mut json, mut binary, mut at) = (None, None, 12);
    while let Some((length, kind)) = word(at).zip(word(at + 4)) {
        let start = at + 8;
        let end = usize::try_from(length).ok().and_then(|length| start.checked_add(length));
        let chunk = end.and_then(|end| bytes.get(start..end));
        let Some(chunk) = chunk else {
            return Err(fail(at, Problem::Truncated { missing: "a part of a chunk".to_owned() }));
        };
        match &kind.to_le_bytes()[..4] {
            b"JSON" if json.is_none() => json = Some(chunk),
            b"BIN\0" if binary.is_none() => binary = Some(chunk),
            _ => {}
        }
        at = start + chunk.len();
    }
    let json = json.ok_or_else(|| fail(at, Problem::Truncated { missing: "the JSON chunk".to_owned() }))?;
    Ok((json, binary))
}

/// Returns the file name in a URI, with escapes such as `%20` decoded.
fn unescaped(uri: &str) -> String {
    let mut bytes = Vec::new();
    let mut rest = uri.as_bytes();
    while let Some((first, after)) = rest.split_first() {
        let hexadecimal = (*first == b'%').then(|| after.get(..2)).flatten();
        let code = hexadecimal.and_then(|digits| u8::from_str_radix(std::str::from_utf8(digits).ok()?, 16).ok());
        bytes.push(code.unwrap_or(*first));
        rest = if code.is_some() { &after[2..] } else { after };
    }
    String::from_utf8_lossy(&bytes).into_owned()
}

/// Parses JSON text to `T`. Refuses invalid text with its line.
fn parsed<'a, T: Deserialize<'a>>(name: &str, json: &'a [u8]) -> Result<T, MeshError> {
    serde_json::from_slice(json).map_err(|e| MeshError {
        file: name.to_owned(),
        element: Element::Line(e.line() as u64),
        place_m: None,
        problem: match e.classify() {
            serde_json::error::Category::Eof => Problem::Truncated { missing: "a part of the JSON text".to_owned() },
            _ => Problem::Syntax { message: e.to_string() },
        },
    })
}

pub(super) fn read(
    name: &str,
    bytes: &[u8],
    neighbours: &dyn Fn(&str) -> Option<Vec<u8>>,
    draft: &mut Draft<'_>,
) -> Result<(), MeshError> {
    let (json, binary) = parts(name, bytes)?;
    // Some programs pad it with NULs to a multiple of four.
    let end = json.iter().rposition(|byte| !matches!(byte, 0 | 0x1a)).map_or(0, |last| last + 1);
    let json = without_mark(&json[..end]);
    let fail_whole = |problem| MeshError { file: name.to_owned(), element: Element::Whole, place_m: None, problem };
    // Includes texts, which take no more memory than in the file.
    let entries = json.len().saturating_mul(ENTRIES_MULTIPLE).min(MAX_ENTRIES);
    draft.allowance.take(2 * json.len() + entries).map_err(fail_whole)?;
    let head: Head = parsed(name, json)?;
    if let Some(problem) = head.refusal() {
        return Err(MeshError { file: name.to_owned(), element: Element::Whole, place_m: None, problem });
    }
    let root: Root = parsed(name, json)?;
    let mut file = GltfFile { name, root, buffers: Vec::new(), primitives: Cell::new(0) };
    let mut buffers: Vec<Cow<'_, [u8]>> = Vec::new();
    for (number, buffer) in file.root.buffers.0.iter().enumerate() {
        let fail = |problem| file.fail("buffer", number, problem);
        let content = match &buffer.uri {
            None if buffer.extensions.meshopt.is_some() => {
                return Err(fail(other_extension("EXT_meshopt_compression")));
            }
            // The binary part of a GLB file is the first buffer.
            None => {
                let content = binary.filter(|_| number == 0);
                Cow::Borrowed(content.ok_or_else(|| fail(Problem::Truncated { missing: "its content".to_owned() }))?)
            }
            Some(uri) => Cow::Owned(match uri.strip_prefix("data:").and_then(|data| data.split_once("base64,")) {
                Some((_, text)) => {
                    STANDARD.decode(text).map_err(|e| fail(Problem::Syntax { message: e.to_string() }))?
                }
                None => {
                    let named = unescaped(uri);
                    let is_bare = !named.contains(['/', '\\', ':', '\0']) && named != ".." && named != ".";
                    let found = is_bare.then(|| neighbours(&named)).flatten();
                    found.ok_or_else(|| fail(Problem::NeighbourMissing { name: named.chars().take(256).collect() }))?
                }
            }),
        };
        let used: usize = buffers.iter().map(|content| content.len()).sum();
        if used + content.len() > draft.limits.bytes {
            return Err(fail(Problem::TooLarge { what: "bytes", limit: draft.limits.bytes }));
        }
        if matches!(content, Cow::Owned(_)) {
            draft.allowance.add_file(content.len());
            draft.allowance.take(content.len()).map_err(fail)?;
        }
        if content.len() < buffer.byte_length {
            let missing = format!("{} of {} bytes", buffer.byte_length - content.len(), buffer.byte_length);
            return Err(fail(Problem::Truncated { missing }));
        }
        buffers.push(content);
    }
    file.buffers = buffers;
    file.nodes(draft)
}

impl GltfFile<'_> {
    fn fail(&self, part: &'static str, number: usize, problem: Problem) -> MeshError {
        MeshError { file: self.name.to_owned(), element: Element::Part(part, number as u64), place_m: None, problem }
    }

    fn missing(&self, part: &'static str, number: usize) -> MeshError {
        self.fail(part, number, Problem::Syntax { message: "it is named, but does not exist".to_owned() })
    }

    /// Visits the nodes of the scene and adds their meshes.
    fn nodes(&self, draft: &mut Draft<'_>) -> Result<(), MeshError> {
        let root = &self.root;
        if root.nodes.0.is_empty() {
            for mesh in 0..root.meshes.0.len() {
                self.mesh(mesh, None, DMat4::IDENTITY, draft)?;
            }
            return Ok(());
        }
        let memory = draft.allowance.take(WAITING * root.nodes.0.len());
        memory.map_err(|problem| self.fail("node", 0, problem))?;
        let mut is_child = vec![false; root.nodes.0.len()];
        for child in root.nodes.0.iter().flat_map(|node| &node.children.0) {
            let child = *child as usize;
            *is_child.get_mut(child).ok_or_else(|| self.missing("node", child))? = true;
        }
        let mut waiting: Vec<(usize, DMat4)> = match root.scenes.0.get(root.scene) {
            Some(scene) => scene.nodes.0.iter().rev().map(|node| (*node as usize, DMat4::IDENTITY)).collect(),
            None => (0..is_child.len()).rev().filter(|node| !is_child[*node]).map(|n| (n, DMat4::IDENTITY)).collect(),
        };
        let mut is_done = vec![false; root.nodes.0.len()];
        while let Some((number, parent)) = waiting.pop() {
            let node = root.nodes.0.get(number).ok_or_else(|| self.missing("node", number))?;
            if std::mem::replace(&mut is_done[number], true) {
                let message = "it is in two places of the tree, or contains itself".to_owned();
                return Err(self.fail("node", number, Problem::Syntax { message }));
            }
            let own = node.matrix.as_ref().map_or_else(
                || {
                    let rotation =
                        node.rotation.as_ref().map_or(DQuat::IDENTITY, |rotation| DQuat::from_array(rotation.0));
                    let scale = node.scale.as_ref().map_or(DVec3::ONE, |scale| DVec3::from_array(scale.0));
                    let translation = node.translation.as_ref().map_or(DVec3::ZERO, |by| DVec3::from_array(by.0));
                    // Not by glam's function, which asserts in some builds that the rotation has unit length.
                    let axes = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| rotated(rotation, axis));
                    DMat4::from_cols(
                        (axes[0] * scale.x).extend(0.0),
                        (axes[1] * scale.y).extend(0.0),
                        (axes[2] * scale.z).extend(0.0),
                        translation.extend(1.0),
                    )
                },
                |matrix| DMat4::from_cols_array(&matrix.0),
            );
            let whole = parent * own;
            if let Some(mesh) = node.mesh {
                self.mesh(mesh, node.name.as_deref(), whole, draft)?;
            }
            let memory = draft.allowance.take(WAITING * node.children.0.len());
            memory.map_err(|problem| self.fail("node", number, problem))?;
            waiting.extend(node.children.0.iter().rev().map(|child| (*child as usize, whole)));
        }
        Ok(())
    }

    fn mesh(&self, number: usize, node: Option<&str>, place: DMat4, draft: &mut Draft<'_>) -> Result<(), MeshError> {
        let mesh = self.root.meshes.0.get(number).ok_or_else(|| self.missing("mesh", number))?;
        for primitive in &mesh.primitives.0 {
            self.primitives.set(self.primitives.get() + 1);
            if self.primitives.get() > MAX_NESTED {
                return Err(self.fail("mesh", number, Problem::TooLarge { what: "primitives", limit: MAX_NESTED }));
            }
            let mode = primitive.mode.unwrap_or(4);
            if !(4..=6).contains(&mode) {
                draft.lines += 1;
                continue;
            }
            let fail = |problem| self.fail("mesh", number, problem);
            // Besides Draco's data there may be uncompressed data, for programs that can't read it.
            let position = self.root.accessors.0.get(primitive.attributes.position);
            if primitive.extensions.draco.is_some() && position.is_some_and(|list| list.buffer_view.is_none()) {
                return Err(fail(other_extension("KHR_draco_mesh_compression")));
            }
            let material = primitive.material.and_then(|material| self.root.materials.0.get(material));
            let mut groups = Vec::new();
            for name in [node.or(mesh.name.as_deref()), material.and_then(|material| material.name.as_deref())] {
                let name = name.map(|name| named(name.as_bytes())).filter(|name| !name.is_empty());
                groups.extend(name.map(|name| draft.group(&name)).transpose().map_err(fail)?);
            }
            groups.dedup();
            let most = draft.limits.vertices.saturating_sub(draft.vertices());
            let positions =
                self.numbers::<3>(draft, primitive.attributes.position, most, "vertices", draft.limits.vertices)?;
            let first = draft.vertices() as i64;
            for at in &positions {
                let at = place.transform_point3(DVec3::from_array(*at));
                draft.vertex(at.to_array()).map_err(fail)?;
            }
            let uv = primitive.attributes.uv;
            let count = positions.len();
            let uv = match uv {
                Some(uv) => Some(self.numbers::<2>(draft, uv, count, "texture coordinates", count)?),
                None => None,
            };
            let corners: Vec<i64> = match primitive.indices {
                #[allow(clippy::cast_possible_truncation)]
                Some(indices) => {
                    let most = draft.limits.triangles.saturating_mul(3);
                    let indices = self.numbers::<1>(draft, indices, most, "indices", most)?;
                    indices.into_iter().map(|[index]| index as i64).collect()
                }
                None => (0..positions.len() as i64).collect(),
            };
            // A mirrored node reverses the orientation of its triangles.
            let is_mirrored = place.determinant() < 0.0;
            draft.allowance.take(size_of_val(corners.as_slice())).map_err(fail)?;
            let triangles: Box<dyn Iterator<Item = [i64; 3]>> = match mode {
                4 => Box::new(corners.chunks_exact(3).map(|c| [c[0], c[1], c[2]])),
                5 => Box::new(
                    corners
                        .windows(3)
                        .zip(0..)
                        .map(|(c, n)| if n % 2 == 0 { [c[0], c[1], c[2]] } else { [c[1], c[0], c[2]] }),
                ),
                _ => Box::new(corners.windows(2).skip(1).map(|c| [corners[0], c[0], c[1]])),
            };
            for [a, b, c] in triangles {
                // A repeated vertex starts a strip or fan elsewhere.
                if mode != 4 && (a == b || b == c || c == a) {
                    continue;
                }
                let triangle = if is_mirrored { [a, c, b] } else { [a, b, c] };
                if let Some(index) = triangle.into_iter().find(|index| *index >= positions.len() as i64) {
                    return Err(fail(Problem::IndexOutOfRange { index, vertices: positions.len() }));
                }
                #[allow(clippy::cast_possible_truncation)]
                let uv: Vec<[f32; 2]> = triangle
                    .iter()
                    .filter_map(|corner| uv.as_ref()?.get(usize::try_from(*corner).ok()?))
                    .map(|uv| [uv[0] as f32, uv[1] as f32])
                    .collect();
                draft.polygon(&triangle.map(|corner| corner + first), &uv, &groups).map_err(fail)?;
            }
            let uv = uv.as_deref().map_or(0, size_of_val);
            draft.allowance.give_back(size_of_val(positions.as_slice()) + uv + 2 * size_of_val(corners.as_slice()));
        }
        Ok(())
    }

    /// Returns the bytes of a buffer view from an offset on, and its stride.
    fn view(&self, number: usize, offset: usize) -> Result<(&[u8], Option<usize>), MeshError> {
        let view = self.root.buffer_views.0.get(number).ok_or_else(|| self.missing("bufferView", number))?;
        let buffer = self.buffers.get(view.buffer).ok_or_else(|| self.missing("buffer", view.buffer))?;
        let end = view.byte_offset.checked_add(view.byte_length);
        let bytes = end.and_then(|end| buffer.get(view.byte_offset..end)?.get(offset..));
        let missing =
            || self.fail("bufferView", number, Problem::Truncated { missing: "a part of its bytes".to_owned() });
        Ok((bytes.ok_or_else(missing)?, view.byte_stride))
    }

    /// Returns the numbers of an accessor, `N` per entry. Refuses more than `most` entries.
    fn numbers<const N: usize>(
        &self,
        draft: &mut Draft<'_>,
        number: usize,
        most: usize,
        what: &'static str,
        limit: usize,
    ) -> Result<Vec<[f64; N]>, MeshError> {
        let accessor = self.root.accessors.0.get(number).ok_or_else(|| self.missing("accessor", number))?;
        let fail = |problem| self.fail("accessor", number, problem);
        let syntax = |message: String| fail(Problem::Syntax { message });
        let kind = ["SCALAR", "VEC2", "VEC3"][N.clamp(1, 3) - 1];
        if accessor.kind != kind {
            return Err(syntax(format!("its type is not {kind}")));
        }
        if accessor.count > most {
            return Err(fail(Problem::TooLarge { what, limit }));
        }
        // Entries may be missing in the file, or overlap in it.
        draft.allowance.take(accessor.count.saturating_mul(size_of::<[f64; N]>())).map_err(fail)?;
        let known = |component: u32| scalar(component).ok_or_else(|| syntax(format!("component type {component}")));
        let component = known(accessor.component_type)?;
        let factor = if accessor.normalized { normal_factor(component) } else { 1.0 };
        let entry = |bytes: &[u8]| -> [f64; N] {
            let size = component.size();
            std::array::from_fn(|part| {
                component.real(bytes.get(part * size..).unwrap_or_default(), Order::Little) * factor
            })
        };
        let width = N * component.size();
        let cut = || fail(Problem::Truncated { missing: format!("a part of its {} entries", accessor.count) });
        let mut values = match accessor.buffer_view {
            None => vec![[0.0; N]; accessor.count],
            Some(view) => {
                let (bytes, stride) = self.view(view, accessor.byte_offset)?;
                let stride = stride.unwrap_or(width).max(1);
                let starts = (0..accessor.count).map(|entry| entry.checked_mul(stride));
                let entries = starts.map(|start| bytes.get(start?..)?.get(..width).map(entry));
                let mut values = Vec::with_capacity(accessor.count);
                for value in entries {
                    values.push(value.ok_or_else(cut)?);
                }
                values
            }
        };
        if let Some(sparse) = &accessor.sparse {
            let index = known(sparse.indices.component_type.unwrap_or(0))?;
            let (indices, _) = self.view(sparse.indices.buffer_view, sparse.indices.byte_offset)?;
            let (replaced, _) = self.view(sparse.values.buffer_view, sparse.values.byte_offset)?;
            let have = (indices.len() / index.size()).min(replaced.len() / width);
            if sparse.count > have.min(accessor.count) {
                return Err(cut());
            }
            let pairs = indices.chunks_exact(index.size()).zip(replaced.chunks_exact(width));
            for (at, value) in pairs.take(sparse.count) {
                let at = usize::try_from(index.integer(at, Order::Little)).ok();
                let at =
                    at.and_then(|at| values.get_mut(at)).ok_or_else(|| syntax("a sparse index is too large".into()))?;
                *at = entry(value);
            }
        }
        Ok(values)
    }
}

/// Rotates a vector by a quaternion that need not have unit length.
fn rotated(rotation: DQuat, vector: DVec3) -> DVec3 {
    let (axis, w) = (DVec3::new(rotation.x, rotation.y, rotation.z), rotation.w);
    let squared = axis.length_squared() + w * w;
    if squared > 0.0 { vector + 2.0 * axis.cross(axis.cross(vector) + w * vector) / squared } else { vector }
}

fn scalar(component: u32) -> Option<Scalar> {
    Some(match component {
        5120 => Scalar::I8,
        5121 => Scalar::U8,
        5122 => Scalar::I16,
        5123 => Scalar::U16,
        5125 => Scalar::U32,
        5126 => Scalar::F32,
        _ => return None,
    })
}

/// Returns the factor of a normalized integer.
fn normal_factor(component: Scalar) -> f64 {
    match component {
        Scalar::I8 => 1.0 / 127.0,
        Scalar::U8 => 1.0 / 255.0,
        Scalar::I16 => 1.0 / 32767.0,
        Scalar::U16 => 1.0 / 65535.0,
        _ => 1.0,
    }
}
