//! PLY, text and binary of both byte orders.
//!
//! `ply-rs-bw` is not used: it allocates what a header counts and panics at a count that is too long.

use super::draft::Draft;
use super::source::{Order, Scalar, Source, named, parsed, shown};
use crate::{Element as Place, MeshError};

/// How the numbers of a file are written; `None` is text.
type Encoding = Option<Order>;

/// Properties of an element and elements of a file; no mesh has as many.
const MOST: usize = 256;

struct Property {
    name: String,
    /// Of the count of a list.
    count: Option<Scalar>,
    scalar: Scalar,
}

struct Element {
    name: String,
    count: i64,
    properties: Vec<Property>,
}

fn scalar(word: &[u8]) -> Option<Scalar> {
    Some(match word {
        b"char" | b"int8" => Scalar::I8,
        b"uchar" | b"uint8" => Scalar::U8,
        b"short" | b"int16" => Scalar::I16,
        b"ushort" | b"uint16" => Scalar::U16,
        b"int" | b"int32" => Scalar::I32,
        b"uint" | b"uint32" => Scalar::U32,
        b"float" | b"float32" => Scalar::F32,
        b"double" | b"float64" => Scalar::F64,
        _ => return None,
    })
}

fn header(source: &mut Source<'_>) -> Result<(Encoding, Vec<Element>), MeshError> {
    let mut encoding = None;
    let mut elements: Vec<Element> = Vec::new();
    loop {
        let line = source.line().ok_or_else(|| source.truncated("`end_header`"))?;
        let words: Vec<&[u8]> = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty()).collect();
        match words.as_slice() {
            [] | [b"ply" | b"comment" | b"obj_info", ..] => {}
            [b"end_header"] => break,
            [b"format", name, ..] => {
                encoding = Some(match *name {
                    b"ascii" => None,
                    b"binary_little_endian" => Some(Order::Little),
                    b"binary_big_endian" => Some(Order::Big),
                    _ => return Err(source.syntax(format!("`{}` is no format of PLY", shown(name)))),
                });
            }
            [b"element", name, count] if elements.len() < MOST => {
                let count = parsed(count).ok_or_else(|| source.syntax("the count of an element is no number"))?;
                elements.push(Element { name: named(name), count, properties: Vec::new() });
            }
            [b"property", rest @ ..] => {
                let property = match rest {
                    [b"list", count, of, name] => {
                        scalar(count).zip(scalar(of)).map(|(count, scalar)| (Some(count), scalar, name))
                    }
                    [of, name] => scalar(of).map(|scalar| (None, scalar, name)),
                    _ => None,
                };
                let (count, scalar, name) = property.ok_or_else(|| source.syntax("no property of PLY"))?;
                let element = elements.last_mut().filter(|element| element.properties.len() < MOST);
                let element = element.ok_or_else(|| source.syntax("a property without an element, or too many"))?;
                element.properties.push(Property { name: named(name), count, scalar });
            }
            _ => return Err(source.syntax(format!("`{}` does not belong into a header of PLY", shown(line)))),
        }
    }
    let encoding = encoding.ok_or_else(|| source.syntax("the header says no format"))?;
    Ok((encoding, elements))
}

fn real(source: &mut Source<'_>, scalar: Scalar, encoding: Encoding, what: &str) -> Result<f64, MeshError> {
    match encoding {
        None => source.number(what),
        Some(order) => source.real(scalar, order, what),
    }
}

#[allow(clippy::cast_possible_truncation)]
fn integer(source: &mut Source<'_>, scalar: Scalar, encoding: Encoding, what: &str) -> Result<i64, MeshError> {
    match encoding {
        // Some programs write indices as 3.0.
        None => Ok(source.number::<f64>(what)? as i64),
        Some(order) => source.integer(scalar, order, what),
    }
}

#[allow(clippy::cast_possible_truncation)]
pub(super) fn read(mut source: Source<'_>, draft: &mut Draft<'_>) -> Result<(), MeshError> {
    let (encoding, elements) = header(&mut source)?;
    source.is_binary = encoding.is_some();
    // Texture coordinates of the vertices, if they have any.
    let mut uv_of: Vec<[f32; 2]> = Vec::new();
    let (mut corners, mut list, mut uv) = (Vec::new(), Vec::new(), Vec::new());
    for element in &elements {
        if element.properties.is_empty() {
            continue;
        }
        // What a record takes at least, in text a digit and a space for each number.
        let least = |property: &Property| match encoding {
            None => 2,
            Some(_) => property.count.unwrap_or(property.scalar).size(),
        };
        let bytes = element.properties.iter().map(least).sum();
        let count = source.count(element.count, bytes, &element.name)?;
        let (is_vertex, is_face) = (element.name == "vertex", element.name == "face");
        let has_uv = is_vertex && element.properties.iter().any(|p| ["s", "u", "texture_u"].contains(&p.name.as_str()));
        if element.name == "tristrips" {
            draft.notes.push("Triangle strips are left out: export triangles instead.".to_owned());
        }
        for number in 0..count {
            let (mut at, mut place) = ([f64::NAN; 3], [0.0_f32; 2]);
            corners.clear();
            uv.clear();
            for property in &element.properties {
                if let Some(of_count) = property.count {
                    let length = integer(&mut source, of_count, encoding, "the length of a list")?;
                    let bytes = if encoding.is_some() { property.scalar.size() } else { 2 };
                    let length = source.count(length, bytes, "entries of a list")?;
                    let is_corners = is_face && ["vertex_indices", "vertex_index"].contains(&property.name.as_str());
                    list.clear();
                    for _ in 0..length {
                        if is_corners {
                            corners.push(integer(&mut source, property.scalar, encoding, "a vertex of a face")?);
                        } else {
                            list.push(real(&mut source, property.scalar, encoding, "an entry of a list")? as f32);
                        }
                    }
                    if is_face && property.name == "texcoord" {
                        uv.extend(list.chunks_exact(2).map(|pair| [pair[0], pair[1]]));
                    }
                } else {
                    let value = real(&mut source, property.scalar, encoding, &property.name)?;
                    match property.name.as_str() {
                        "x" => at[0] = value,
                        "y" => at[1] = value,
                        "z" => at[2] = value,
                        "s" | "u" | "texture_u" => place[0] = value as f32,
                        "t" | "v" | "texture_v" => place[1] = value as f32,
                        _ => {}
                    }
                }
            }
            let number = number as u64;
            if is_vertex {
                draft.vertex(at).map_err(|problem| source.fail(problem))?;
                if has_uv {
                    uv_of.push(place);
                }
            } else if is_face {
                let of_vertex = |corner: &i64| uv_of.get(usize::try_from(*corner).ok()?).copied();
                if uv.len() != corners.len() {
                    uv.clear();
                    uv.extend(corners.iter().filter_map(of_vertex));
                }
                let fail = |problem| source.fail_at(Place::Face(number), problem);
                draft.polygon(&corners, &uv, &[]).map_err(fail)?;
            } else if element.name == "edge" {
                draft.lines += 1;
            }
        }
    }
    Ok(())
}
