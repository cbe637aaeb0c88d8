//! STL, text and binary. In these files each triangle has its own vertices; vertices at exactly the same position are
//! merged.
//!
//! `stl_io` is not used: it treats a binary file that begins with "solid" as text, and does not say which triangle is
//! wrong.

use std::collections::HashMap;

use super::draft::Draft;
use super::source::{Order, Scalar, Source, parsed, shown, words};
use crate::{Element, MeshError, Problem};

/// Size of the header of a binary file, and of each triangle, bytes.
const HEADER: usize = 84;
const TRIANGLE: usize = 50;

/// Returns whether the length of the file matches its triangle count.
pub(super) fn is_binary(bytes: &[u8]) -> bool {
    let Some(count) = bytes.get(80..HEADER) else { return false };
    let count = u64::try_from(Scalar::U32.integer(count, Order::Little)).unwrap_or(0);
    bytes.len() as u64 == HEADER as u64 + TRIANGLE as u64 * count
}

/// Returns whether a file that begins with "solid" is text. Binary files may also begin with this word, and may have
/// more or fewer bytes than their count demands; in this case no keyword follows, and the first byte of a count below
/// 2²⁴ is 0.
fn is_text(bytes: &[u8]) -> bool {
    let starts =
        |word: &[u8], text: &str| word.get(..text.len()).is_some_and(|s| s.eq_ignore_ascii_case(text.as_bytes()));
    let mut source = Source::new("", bytes);
    if !source.word().is_some_and(|word| starts(word, "solid")) {
        return false;
    }
    source.line();
    let next = source.word().unwrap_or_default();
    starts(next, "facet") || starts(next, "end") || bytes.get(83) != Some(&0)
}

/// Merges vertices whose positions have the same bits.
struct Welder<'d, 'l> {
    draft: &'d mut Draft<'l>,
    // Used for lookups only, so its order does not matter.
    numbers: HashMap<[u64; 3], i64>,
}

impl Welder<'_, '_> {
    /// Returns the vertex at a position; adds it if it is new.
    fn vertex(&mut self, at: [f64; 3]) -> Result<i64, Problem> {
        // Turns -0 into 0.
        let at = at.map(|part| part + 0.0);
        let key = at.map(f64::to_bits);
        if let Some(number) = self.numbers.get(&key) {
            return Ok(*number);
        }
        // The hash table grows, so it may use twice the memory of its entries.
        self.draft.allowance.take(2 * size_of::<([u64; 3], i64)>() + 2)?;
        let number = self.draft.vertices() as i64;
        self.draft.vertex(at)?;
        self.numbers.insert(key, number);
        Ok(number)
    }
}

pub(super) fn read(source: Source<'_>, draft: &mut Draft<'_>) -> Result<(), MeshError> {
    let bytes = source.rest();
    let mut welder = Welder { draft, numbers: HashMap::new() };
    let triangles =
        if is_binary(bytes) || !is_text(bytes) { binary(source, &mut welder)? } else { text(source, &mut welder)? };
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
        // Line by line, because the names after `solid` and `endsolid` may be any text.
        let mut words = words(line);
        let Some(keyword) = words.next() else { continue };
        let mut keyword = keyword.to_ascii_lowercase();
        if keyword == b"end" {
            // Some programs write `end solid`.
            keyword.extend(words.next().unwrap_or_default().to_ascii_lowercase());
        }
        match keyword.as_slice() {
            b"vertex" => {
                let mut at = [0.0; 3];
                for coordinate in &mut at {
                    let missing = || source.syntax("a vertex needs three numbers: vertex x y z");
                    let word = words.next().ok_or_else(missing)?;
                    *coordinate = parsed(word).ok_or_else(|| source.no_number(word, "a coordinate"))?;
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
            b"facet" | b"outer" | b"outerloop" | b"endloop" => {}
            _ => return Err(source.syntax(format!("`{}` is not a keyword of STL", shown(&keyword)))),
        }
    }
    if is_open && corners.is_empty() && welder.draft.is_closed() {
        welder.draft.notes.push("`endsolid` is missing; the surface is closed, so that nothing else is.".to_owned());
    } else if is_open || !corners.is_empty() {
        return Err(source.truncated("`endsolid`"));
    }
    Ok(triangles)
}
