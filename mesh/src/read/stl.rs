//! STL, text and binary. Each triangle has its own vertices there; those at one position become one vertex.
//!
//! `stl_io` is not used: it takes a binary file that begins with "solid" for text and says no triangle.

use std::collections::HashMap;

use super::draft::Draft;
use super::source::{Order, Scalar, Source};
use crate::{Element, MeshError, Problem};

/// Bytes before the triangles of a binary file, and of each triangle.
const HEADER: usize = 84;
const TRIANGLE: usize = 50;

/// Whether the length of the file is that of its count of triangles.
pub(super) fn is_binary(bytes: &[u8]) -> bool {
    let Some(count) = bytes.get(80..HEADER) else { return false };
    let count = u64::try_from(Scalar::U32.integer(count, Order::Little)).unwrap_or(0);
    bytes.len() as u64 == HEADER as u64 + TRIANGLE as u64 * count
}

/// Vertices by the bits of their positions.
struct Welder<'d, 'l> {
    draft: &'d mut Draft<'l>,
    // It is only looked up, so its order does not matter.
    numbers: HashMap<[u64; 3], i64>,
}

impl Welder<'_, '_> {
    /// The vertex at a position.
    fn vertex(&mut self, at: [f64; 3]) -> Result<i64, Problem> {
        // -0 is 0.
        let at = at.map(|part| part + 0.0);
        let key = at.map(f64::to_bits);
        if let Some(number) = self.numbers.get(&key) {
            return Ok(*number);
        }
        let number = self.draft.vertices() as i64;
        self.draft.vertex(at)?;
        self.numbers.insert(key, number);
        Ok(number)
    }
}

pub(super) fn read(source: Source<'_>, draft: &mut Draft<'_>) -> Result<(), MeshError> {
    let bytes = source.rest();
    let is_text = bytes.trim_ascii_start().get(..5).is_some_and(|start| start.eq_ignore_ascii_case(b"solid"));
    let mut welder = Welder { draft, numbers: HashMap::new() };
    let triangles =
        if is_binary(bytes) || !is_text { binary(source, &mut welder)? } else { text(source, &mut welder)? };
    let vertices = draft.vertices();
    draft.notes.push(format!(
        "Corners of triangles welded by their exact positions: {} became {vertices} vertices, numbered from 0 as they first \
         appear.",
        3 * triangles
    ));
    Ok(())
}

fn binary(mut source: Source<'_>, welder: &mut Welder<'_, '_>) -> Result<usize, MeshError> {
    source.is_binary = true;
    source.take(80, "the header of a binary STL file")?;
    let count = source.integer(Scalar::U32, Order::Little, "the count of triangles")?;
    let count = source.count(count, TRIANGLE, "triangles")?;
    for number in 0..count {
        let triangle = source.take(TRIANGLE, "a triangle")?;
        let mut corners = [0; 3];
        for (corner, place) in corners.iter_mut().zip([12, 24, 36]) {
            let at = [0, 4, 8].map(|part| Scalar::F32.real(&triangle[place + part..], Order::Little));
            let fail = |problem| source.fail_at(Element::Face(number as u64), problem);
            *corner = welder.vertex(at).map_err(fail)?;
        }
        let fail = |problem| source.fail_at(Element::Face(number as u64), problem);
        welder.draft.polygon(&corners, &[], &[]).map_err(fail)?;
    }
    if !source.rest().is_empty() {
        welder.draft.notes.push(format!("Bytes left out after the last triangle: {}.", source.rest().len()));
    }
    Ok(count)
}

fn text(mut source: Source<'_>, welder: &mut Welder<'_, '_>) -> Result<usize, MeshError> {
    let mut corners: Vec<i64> = Vec::new();
    let (mut triangles, mut is_open) = (0, true);
    while let Some(line) = source.line() {
        // By lines, since the names after `solid` and `endsolid` may be anything.
        let mut words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        let Some(keyword) = words.next() else { continue };
        match keyword.to_ascii_lowercase().as_slice() {
            b"vertex" => {
                let mut at = [0.0; 3];
                for coordinate in &mut at {
                    let word = words.next().and_then(super::source::parsed);
                    *coordinate = word.ok_or_else(|| source.syntax("a vertex needs three numbers: vertex x y z"))?;
                }
                corners.push(welder.vertex(at).map_err(|problem| source.fail(problem))?);
            }
            b"endfacet" => {
                if corners.len() < 3 {
                    return Err(source.syntax(format!("a facet of {} vertices: it needs three", corners.len())));
                }
                welder.draft.polygon(&corners, &[], &[]).map_err(|problem| source.fail(problem))?;
                triangles += corners.len() - 2;
                corners.clear();
            }
            b"facet" if !corners.is_empty() => return Err(source.syntax("`endfacet` is missing before this facet")),
            b"solid" => is_open = true,
            b"endsolid" => is_open = false,
            b"facet" | b"outer" | b"endloop" => {}
            _ => return Err(source.syntax(format!("`{}` is no keyword of STL", super::source::shown(keyword)))),
        }
    }
    if is_open || !corners.is_empty() {
        return Err(source.truncated("`endsolid`"));
    }
    Ok(triangles)
}
