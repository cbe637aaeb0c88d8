//! PLY, text and binary in both byte orders. In text, each element is one row: columns that the header does not name
//! are ignored, and a row with too few numbers is refused.
//!
//! `ply-rs-bw` is not used: it allocates as much memory as the header demands, and panics if a count is too large.

use super::allowance::MemoryAllowance;
use super::draft::Draft;
use super::source::{Order, Scalar, Source, named, parsed, shown, words};
use crate::{Element as Place, MeshError, Problem};

/// How the numbers of a file are encoded; `None` is text.
type Encoding = Option<Order>;

/// Limit for the properties of an element and for the elements of a file. No real mesh has as many.
const MAX_ELEMENTS: usize = 256;

struct Property {
    name: String,
    /// Type of the count, if this is a list.
    count: Option<Scalar>,
    scalar: Scalar,
}

struct PlyElement {
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
        b"int64" => Scalar::I64,
        b"uint64" => Scalar::U64,
        b"float" | b"float32" => Scalar::F32,
        b"double" | b"float64" => Scalar::F64,
        _ => return None,
    })
}

fn header(source: &mut Source<'_>) -> Result<(Encoding, Vec<PlyElement>), MeshError> {
    let mut encoding = None;
    let mut elements: Vec<PlyElement> = Vec::new();
    loop {
        let line = source.line().ok_or_else(|| source.truncated("`end_header`"))?;
        let words: Vec<&[u8]> = words(line).collect();
        match words.as_slice() {
            [] | [b"ply" | b"comment" | b"obj_info", ..] => {}
            [b"end_header"] => break,
            [b"format", name, ..] => {
                encoding = Some(match *name {
                    b"ascii" => None,
                    b"binary_little_endian" => Some(Order::Little),
                    b"binary_big_endian" => Some(Order::Big),
                    _ => return Err(source.syntax(format!("`{}` is not a format of PLY", shown(name)))),
                });
            }
            [b"element", name, count] if elements.len() < MAX_ELEMENTS => {
                let count = parsed(count).ok_or_else(|| source.syntax("the count of an element is not a number"))?;
                elements.push(PlyElement { name: named(name), count, properties: Vec::new() });
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
                let element = elements.last_mut().filter(|element| element.properties.len() < MAX_ELEMENTS);
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
        None => {
            // Some programs write indices as 3.0.
            let number: f64 = source.number(what)?;
            if number.fract() != 0.0 {
                return Err(source.syntax(format!("`{number}` is not a whole number: {what} is expected")));
            }
            Ok(number as i64)
        }
        Some(order) => source.integer(scalar, order, what),
    }
}

/// Purpose of an element.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Role {
    Vertex,
    Face,
    Strips,
    Edge,
    /// Ignored.
    Other,
}

impl PlyElement {
    fn role(&self) -> Role {
        match self.name.as_str() {
            "vertex" => Role::Vertex,
            "face" => Role::Face,
            "tristrips" => Role::Strips,
            "edge" => Role::Edge,
            _ => Role::Other,
        }
    }

    /// Returns the property that the element needs for its role but does not have.
    fn missing(&self) -> Option<&'static str> {
        let lacks = |name: &&str| !self.properties.iter().any(|own| own.count.is_none() && own.name == **name);
        match self.role() {
            Role::Vertex => ["x", "y", "z"].into_iter().find(lacks),
            Role::Face | Role::Strips => self.corners().is_none().then_some("vertex_indices"),
            Role::Edge | Role::Other => None,
        }
    }

    /// Returns the property that lists the vertices: the one with that name, or the only list.
    fn corners(&self) -> Option<usize> {
        let is_named = |own: &Property| ["vertex_indices", "vertex_index"].contains(&own.name.as_str());
        let lists = || self.properties.iter().enumerate().filter(|(_, own)| own.count.is_some());
        let only = || lists().nth(1).is_none().then(|| lists().next()).flatten();
        lists().find(|(_, own)| is_named(own)).or_else(only).map(|(place, _)| place)
    }
}

/// Returns the next row of a table in text. Comments belong in the header, but are accepted here.
fn next_row<'a>(source: &mut Source<'a>) -> Option<Source<'a>> {
    loop {
        let row = source.row()?;
        if !matches!(row.peek(), Some(b"comment" | b"obj_info")) {
            return Some(row);
        }
    }
}

/// The numbers of one row that are used.
#[derive(Default)]
struct PlyRow {
    at: [f64; 3],
    /// Texture coordinates of a vertex.
    uv: [f32; 2],
    corners: Vec<i64>,
    /// Texture coordinates of the corners.
    corner_uv: Vec<[f32; 2]>,
}

impl PlyRow {
    /// Reads the properties of an element. Its corners are listed in the property with the index `corners`.
    #[allow(clippy::cast_possible_truncation)]
    fn read(
        &mut self,
        source: &mut Source<'_>,
        element: &PlyElement,
        corners: Option<usize>,
        encoding: Encoding,
        allowance: &mut MemoryAllowance<'_>,
    ) -> Result<(), MeshError> {
        self.corners.clear();
        self.corner_uv.clear();
        for (place, property) in element.properties.iter().enumerate() {
            let Some(of_count) = property.count else {
                let value = real(source, property.scalar, encoding, &property.name)?;
                match property.name.as_str() {
                    "x" => self.at[0] = value,
                    "y" => self.at[1] = value,
                    "z" => self.at[2] = value,
                    "s" | "u" | "texture_u" => self.uv[0] = value as f32,
                    "t" | "v" | "texture_v" => self.uv[1] = value as f32,
                    _ => {}
                }
                continue;
            };
            let length = integer(source, of_count, encoding, "the length of a list")?;
            let bytes = if encoding.is_some() { property.scalar.size() } else { 2 };
            let length = source.count(length, bytes, "entries of a list")?;
            let is_uv = property.name == "texcoord";
            let mut first = 0.0;
            for entry in 0..length {
                if corners == Some(place) {
                    let corner = integer(source, property.scalar, encoding, "a vertex of a face")?;
                    allowance.push(&mut self.corners, corner).map_err(|problem| source.fail(problem))?;
                    continue;
                }
                let value = real(source, property.scalar, encoding, "an entry of a list")? as f32;
                match entry % 2 {
                    0 => first = value,
                    _ if is_uv => {
                        let place = [first, value];
                        allowance.push(&mut self.corner_uv, place).map_err(|problem| source.fail(problem))?;
                    }
                    _ => {}
                }
            }
        }
        Ok(())
    }
}

pub(super) fn read(mut source: Source<'_>, draft: &mut Draft<'_>) -> Result<(), MeshError> {
    let (encoding, elements) = header(&mut source)?;
    source.is_binary = encoding.is_some();
    // Texture coordinates of the vertices, if there are any.
    let mut uv_of: Vec<[f32; 2]> = Vec::new();
    let (mut row, mut wider) = (PlyRow::default(), 0_usize);
    for element in &elements {
        if element.properties.is_empty() {
            continue;
        }
        if let Some(property) = element.missing().filter(|_| element.count != 0) {
            return Err(source.syntax(format!("the element `{}` has no property `{property}`", element.name)));
        }
        // Minimum size of a row; in text, a digit and a space for each number.
        let least = |property: &Property| match encoding {
            None => 2,
            Some(_) => property.count.unwrap_or(property.scalar).size(),
        };
        let bytes = element.properties.iter().map(least).sum();
        let count = source.count(element.count, bytes, &element.name)?;
        let (role, corners) = (element.role(), element.corners());
        let has_uv = element.properties.iter().any(|p| ["s", "u", "texture_u"].contains(&p.name.as_str()));
        for number in 0..count as u64 {
            if encoding.is_some() {
                row.read(&mut source, element, corners, encoding, &mut draft.allowance)?;
            } else {
                let mut line = next_row(&mut source)
                    .ok_or_else(|| source.truncated(format!("row {number} of {count} of `{}`", element.name)))?;
                row.read(&mut line, element, corners, encoding, &mut draft.allowance)?;
                let is_wider = line.word().is_some();
                // This happens if the row does not begin with the length of its list.
                if is_wider && role == Role::Face && row.corners.len() < 3 {
                    return Err(line.syntax(format!(
                        "a face of {} vertices in a longer row: the length of its list is wrong, or a count of the header",
                        row.corners.len()
                    )));
                }
                wider += usize::from(is_wider);
            }
            let of_vertex = |corner: &i64| uv_of.get(usize::try_from(*corner).ok()?).copied();
            if row.corner_uv.len() != row.corners.len() {
                row.corner_uv.clear();
                for place in row.corners.iter().filter_map(of_vertex) {
                    let paid = draft.allowance.push(&mut row.corner_uv, place);
                    paid.map_err(|problem| source.fail(problem))?;
                }
            }
            let fail = |problem| source.fail_at(Place::Face(number), problem);
            match role {
                Role::Vertex => {
                    draft.vertex(row.at).map_err(|problem| source.fail(problem))?;
                    if has_uv {
                        draft.allowance.push(&mut uv_of, row.uv).map_err(|problem| source.fail(problem))?;
                    }
                }
                Role::Face => draft.polygon(&row.corners, &row.corner_uv, &[]).map_err(fail)?,
                Role::Strips => strips(&row.corners, &uv_of, draft).map_err(fail)?,
                Role::Edge => draft.lines += 1,
                Role::Other => {}
            }
        }
    }
    if encoding.is_none()
        && let Some(line) = next_row(&mut source)
    {
        // Otherwise, rows of one element could have been read as rows of another.
        let counts: Vec<String> = elements.iter().map(|own| format!("{} of `{}`", own.count, own.name)).collect();
        return Err(line.syntax(format!("a row more than the header counts: {}", counts.join(", "))));
    }
    if wider > 0 {
        draft.notes.push(format!("Rows with columns that the header does not name, which are left out: {wider}."));
    }
    Ok(())
}

/// Adds triangle strips. The index −1 (the largest number if unsigned) begins a new strip.
fn strips(corners: &[i64], uv_of: &[[f32; 2]], draft: &mut Draft<'_>) -> Result<(), Problem> {
    let is_end = |corner: &i64| *corner == -1 || *corner == i64::from(u32::MAX);
    for strip in corners.split(is_end) {
        let of_vertex = |corner: &i64| uv_of.get(usize::try_from(*corner).ok()?).copied();
        let uv: Vec<[f32; 2]> = strip.iter().filter_map(of_vertex).collect();
        draft.strip(strip, &uv)?;
    }
    Ok(())
}
