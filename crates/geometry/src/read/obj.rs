//! Wavefront OBJ: vertices, texture coordinates, faces; groups, objects and materials become groups.
//!
//! No crate is used: the existing ones renumber vertices in each object and report no line.

use super::draft::Draft;
use super::source::{Source, named, parsed, shown, words};
use crate::{MeshError, Problem};

/// Maximum number of names used per `g` line.
const NAMES: usize = 8;

/// Returns the vertex of an index, which counts from 1, or backwards from the last if negative.
fn resolved(index: i64, count: usize) -> i64 {
    if index < 0 { index.saturating_add(i64::try_from(count).unwrap_or(i64::MAX)) } else { index - 1 }
}

/// Returns whether a backslash at the end of a line is part of it, as in a path, rather than a continuation.
fn ends_with_path(line: &[u8]) -> bool {
    let keyword = words(line).next().unwrap_or_default();
    keyword.starts_with(b"#")
        || keyword.starts_with(b"$")
        || [&b"mtllib"[..], b"maplib", b"usemtl", b"usemap", b"o"].iter().any(|text| keyword.eq_ignore_ascii_case(text))
}

/// Returns the line without its trailing spaces and backslash, if it continues on the next line.
fn continued(line: &[u8]) -> Option<&[u8]> {
    line.trim_ascii_end().strip_suffix(b"\\").filter(|_| !ends_with_path(line))
}

pub(super) fn read(mut source: Source<'_>, draft: &mut Draft<'_>) -> Result<(), MeshError> {
    let mut places: Vec<[f32; 2]> = Vec::new();
    let (mut group, mut object, mut material): (Vec<usize>, Option<usize>, Option<usize>) = (Vec::new(), None, None);
    let mut active: Vec<usize> = Vec::new();
    let (mut corners, mut uv): (Vec<i64>, Vec<[f32; 2]>) = (Vec::new(), Vec::new());
    let mut ignored = 0_usize;
    let mut joined: Vec<u8>;
    while let Some(mut line) = source.line() {
        if continued(line).is_some() {
            joined = Vec::new();
            while let Some(part) = continued(line) {
                joined.extend_from_slice(part);
                joined.push(b' ');
                line = source.line().unwrap_or_default();
            }
            joined.extend_from_slice(line);
            line = &joined;
        }
        let line = line.split(|byte| *byte == b'#').next().unwrap_or_default();
        let mut words = words(line);
        let Some(keyword) = words.next() else { continue };
        match keyword.to_ascii_lowercase().as_slice() {
            b"v" => {
                let mut at = [0.0; 3];
                for coordinate in &mut at {
                    let word = words.next().ok_or_else(|| source.syntax("a vertex needs three numbers: v x y z"))?;
                    *coordinate = parsed(word).ok_or_else(|| source.no_number(word, "a coordinate"))?;
                }
                draft.vertex(at).map_err(|problem| source.fail(problem))?;
            }
            b"vt" => {
                let u = words.next().ok_or_else(|| source.syntax("texture coordinates are numbers: vt u v"))?;
                let u = parsed(u).ok_or_else(|| source.no_number(u, "a texture coordinate"))?;
                let place = [u, words.next().map_or(0.0, |v| parsed(v).unwrap_or(f32::NAN))];
                draft.allowance.push(&mut places, place).map_err(|problem| source.fail(problem))?;
            }
            // `fo` means a face in old files.
            b"f" | b"fo" => {
                corners.clear();
                uv.clear();
                for word in words.take_while(|word| !word.starts_with(b"$")) {
                    let mut parts = word.split(|byte| *byte == b'/');
                    let index: i64 = parts.next().and_then(parsed).ok_or_else(|| {
                        source.syntax(format!("`{}` is not a corner of a face: f 1 2 3 or f 1/1 2/2 3/3", shown(word)))
                    })?;
                    if index == 0 {
                        return Err(source.syntax("a face names vertex 0: OBJ counts vertices from 1"));
                    }
                    let corner = resolved(index, draft.vertices());
                    draft.allowance.push(&mut corners, corner).map_err(|problem| source.fail(problem))?;
                    let place = parts.next().and_then(parsed::<i64>);
                    let place = place.map(|place| resolved(place, places.len()));
                    if let Some(place) = place.and_then(|place| places.get(usize::try_from(place).ok()?)) {
                        draft.allowance.push(&mut uv, *place).map_err(|problem| source.fail(problem))?;
                    }
                }
                draft.polygon(&corners, &uv, &active).map_err(|problem| {
                    // Numbered like in the file.
                    source.fail(match problem {
                        Problem::IndexOutOfRange { index, vertices } if index >= 0 => {
                            Problem::IndexOutOfRange { index: index.saturating_add(1), vertices }
                        }
                        problem => problem,
                    })
                })?;
            }
            b"g" | b"o" | b"usemtl" => {
                let mut names = Vec::new();
                if keyword.eq_ignore_ascii_case(b"g") {
                    for name in words.take(NAMES) {
                        names.push(draft.group(&named(name)).map_err(|problem| source.fail(problem))?);
                    }
                    group = names;
                } else {
                    let name = named(&line[keyword.len() + line.len() - line.trim_ascii_start().len()..]);
                    let found = if name.is_empty() { None } else { Some(draft.group(&name)) };
                    let found = found.transpose().map_err(|problem| source.fail(problem))?;
                    *if keyword.eq_ignore_ascii_case(b"o") { &mut object } else { &mut material } = found;
                }
                active = group.iter().copied().chain(object).chain(material).collect();
                active.sort_unstable();
                active.dedup();
            }
            b"l" | b"p" => draft.lines += 1,
            b"vn" | b"vp" | b"s" | b"mtllib" | b"usemap" | b"maplib" | b"lod" | b"mg" => {}
            b"curv" | b"curv2" | b"surf" | b"bzp" | b"bsp" => ignored += 1,
            // Some programs start comments with a dollar sign.
            _ if keyword.starts_with(b"$") || keyword.iter().all(u8::is_ascii_alphabetic) => {}
            _ => return Err(source.syntax(format!("`{}` is not a keyword of OBJ", shown(keyword)))),
        }
    }
    if ignored > 0 {
        draft.notes.push(format!("Curves and free-form surfaces left out, export triangles instead: {ignored}."));
    }
    Ok(())
}
