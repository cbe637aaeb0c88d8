//! VTK's legacy format, text and binary: POLYDATA and UNSTRUCTURED_GRID; and what it shares with VTK's XML.
//!
//! `vtkio` is not used: it reserves what a file counts, unpacks without bound and says no element.

use super::draft::{Cell, Draft};
use super::source::{Order, Scalar, Source, shown};
use crate::{Element, MeshError, Problem};

fn scalar(word: &[u8]) -> Option<Scalar> {
    Some(match word.to_ascii_lowercase().as_slice() {
        b"char" => Scalar::I8,
        b"unsigned_char" => Scalar::U8,
        b"short" => Scalar::I16,
        b"unsigned_short" => Scalar::U16,
        // Identifiers are written as `int`, whatever they are in memory.
        b"int" | b"vtkidtype" => Scalar::I32,
        b"unsigned_int" => Scalar::U32,
        b"long" | b"vtktypeint64" => Scalar::I64,
        b"unsigned_long" | b"vtktypeuint64" => Scalar::U64,
        b"float" => Scalar::F32,
        b"double" => Scalar::F64,
        _ => return None,
    })
}

/// Lists of vertices: those of cell n are `connectivity[ends[n - 1]..ends[n]]`.
#[derive(Default)]
pub(super) struct Cells {
    pub(super) connectivity: Vec<i64>,
    pub(super) ends: Vec<i64>,
}

/// The surface of a POLYDATA or UNSTRUCTURED_GRID file, before the vertices are known to exist.
#[derive(Default)]
pub(super) struct Faces {
    pub(super) polygons: Cells,
    pub(super) strips: Cells,
    pub(super) grid: Cells,
    /// Of the cells of `grid`.
    pub(super) types: Vec<i64>,
}

impl Cells {
    /// The lists, each with its number.
    fn lists(&self) -> impl Iterator<Item = (u64, Result<&[i64], Problem>)> {
        let starts = std::iter::once(&0).chain(&self.ends);
        (0..).zip(starts.zip(&self.ends)).map(|(number, (start, end))| {
            let range = usize::try_from(*start).ok().zip(usize::try_from(*end).ok());
            let list = range.and_then(|(start, end)| self.connectivity.get(start..end));
            (number, list.ok_or_else(|| Problem::Syntax { message: "its offsets are out of range".to_owned() }))
        })
    }
}

impl Faces {
    /// Adds the faces to a draft whose vertices from `first` on they count from 0.
    pub(super) fn add(&self, file: &str, first: usize, draft: &mut Draft<'_>) -> Result<(), MeshError> {
        let fail = |number, problem| MeshError {
            file: file.to_owned(),
            element: Element::Face(number),
            place_m: None,
            problem,
        };
        let first = i64::try_from(first).unwrap_or(i64::MAX);
        let mut corners: Vec<i64> = Vec::new();
        for (number, list) in self.polygons.lists() {
            corners.clear();
            corners.extend(list.map_err(|problem| fail(number, problem))?.iter().map(|at| at.saturating_add(first)));
            draft.polygon(&corners, &[], &[]).map_err(|problem| fail(number, problem))?;
        }
        for (number, list) in self.strips.lists() {
            corners.clear();
            corners.extend(list.map_err(|problem| fail(number, problem))?.iter().map(|at| at.saturating_add(first)));
            strip(&corners, draft).map_err(|problem| fail(number, problem))?;
        }
        for ((number, list), kind) in self.grid.lists().zip(&self.types) {
            corners.clear();
            corners.extend(list.map_err(|problem| fail(number, problem))?.iter().map(|at| at.saturating_add(first)));
            cell(*kind, &mut corners, draft).map_err(|problem| fail(number, problem))?;
        }
        if self.grid.ends.len() != self.types.len() {
            let message = format!("{} cells, but {} types", self.grid.ends.len(), self.types.len());
            return Err(fail(self.types.len() as u64, Problem::Syntax { message }));
        }
        Ok(())
    }
}

/// Adds a strip of triangles, every other one of which is the other way round.
fn strip(corners: &[i64], draft: &mut Draft<'_>) -> Result<(), Problem> {
    for (number, three) in corners.windows(3).enumerate() {
        let triangle = if number % 2 == 0 { [three[0], three[1], three[2]] } else { [three[1], three[0], three[2]] };
        draft.polygon(&triangle, &[], &[])?;
    }
    Ok(())
}

/// Adds a cell of a type of VTK.
fn cell(kind: i64, corners: &mut [i64], draft: &mut Draft<'_>) -> Result<(), Problem> {
    let mut face = |corners: &[i64], count: usize| {
        draft.drops_unused |= corners.len() > count;
        let short = || Problem::Syntax { message: format!("a cell of type {kind} with {} vertices", corners.len()) };
        draft.polygon(corners.get(..count).ok_or_else(short)?, &[], &[])
    };
    match kind {
        5 => face(corners, 3),
        7 => face(corners, corners.len()),
        9 => face(corners, 4),
        // A pixel is a rectangle whose corners are numbered in rows.
        8 if corners.len() == 4 => {
            corners.swap(2, 3);
            face(corners, 4)
        }
        22 => face(corners, 3),
        23 => face(corners, 4),
        6 => strip(corners, draft),
        10 | 24 => draft.cell(Cell::Tetrahedron, corners, &[]),
        11 if corners.len() == 8 => {
            corners.swap(2, 3);
            corners.swap(6, 7);
            draft.cell(Cell::Hexahedron, corners, &[])
        }
        12 | 25 => draft.cell(Cell::Hexahedron, corners, &[]),
        13 | 26 => draft.cell(Cell::Prism, corners, &[]),
        14 | 27 => draft.cell(Cell::Pyramid, corners, &[]),
        1..=4 | 21 => {
            draft.lines += 1;
            Ok(())
        }
        _ => Err(Problem::Unsupported {
            message: format!("cells of type {kind} are not read: export triangles or tetrahedra"),
        }),
    }
}

/// How a file writes its numbers: text, or binary with the most significant byte first.
fn integers(
    source: &mut Source<'_>,
    is_binary: bool,
    count: i64,
    scalar: Scalar,
    what: &str,
) -> Result<Vec<i64>, MeshError> {
    let count = source.count(count, if is_binary { scalar.size() } else { 2 }, what)?;
    if is_binary {
        let bytes = source.take(count * scalar.size(), what)?;
        return Ok(bytes.chunks_exact(scalar.size()).map(|bytes| scalar.integer(bytes, Order::Big)).collect());
    }
    (0..count).map(|_| source.number(what)).collect()
}

/// Goes to the data of a section, which begins with the next line.
fn begin_data(source: &mut Source<'_>, is_binary: bool) {
    if is_binary {
        source.line();
    }
    source.is_binary = is_binary;
}

/// The lists of a section: `n size` and each list after its length, or since version 5 offsets and connectivity.
fn cells(source: &mut Source<'_>, is_binary: bool, is_new: bool) -> Result<Cells, MeshError> {
    let what = "lists of vertices";
    let count: i64 = source.number("the count of cells")?;
    let size: i64 = source.number("the size of cells")?;
    let mut cells = Cells::default();
    if is_new {
        for part in ["OFFSETS", "CONNECTIVITY"] {
            if source.word() != Some(part.as_bytes()) {
                return Err(source.syntax(format!("`{part}` is expected")));
            }
            let kind = source.word().and_then(scalar).ok_or_else(|| source.syntax("a type of numbers is expected"))?;
            begin_data(source, is_binary);
            let is_offsets = part == "OFFSETS";
            let list = integers(source, is_binary, if is_offsets { count } else { size }, kind, what)?;
            source.is_binary = false;
            // The first offset is 0.
            *if is_offsets { &mut cells.ends } else { &mut cells.connectivity } = list;
        }
        cells.ends = cells.ends.split_off(1.min(cells.ends.len()));
        return Ok(cells);
    }
    begin_data(source, is_binary);
    let list = integers(source, is_binary, size, Scalar::I32, what)?;
    source.is_binary = false;
    let mut rest = list.as_slice();
    while let Some((length, after)) = rest.split_first() {
        let own = usize::try_from(*length).ok().and_then(|length| after.get(..length));
        let own =
            own.ok_or_else(|| source.syntax(format!("a list of {length} vertices does not fit into its section")))?;
        cells.connectivity.extend_from_slice(own);
        cells.ends.push(cells.connectivity.len() as i64);
        rest = &after[own.len()..];
    }
    if cells.ends.len() as i64 != count {
        return Err(source.syntax(format!("{} cells instead of {count}", cells.ends.len())));
    }
    Ok(cells)
}

/// Skips `FIELD name n` and its arrays.
fn skip_field(source: &mut Source<'_>, is_binary: bool) -> Result<(), MeshError> {
    source.word();
    let arrays: i64 = source.number("the count of arrays")?;
    for _ in 0..source.count(arrays, 8, "arrays")? {
        let name = source.word().ok_or_else(|| source.truncated("an array"))?;
        if name == b"METADATA" {
            return Err(source.syntax("METADATA within a FIELD is not read: save the file without it"));
        }
        let components: i64 = source.number("the count of components")?;
        let tuples: i64 = source.number("the count of tuples")?;
        let kind = source.word().unwrap_or_default();
        let Some(kind) = scalar(kind) else {
            return Err(source.syntax(format!("arrays of `{}` are not read", shown(kind))));
        };
        let count = components.checked_mul(tuples).unwrap_or(i64::MAX);
        begin_data(source, is_binary);
        let count = source.count(count, if is_binary { kind.size() } else { 2 }, "numbers of an array")?;
        if is_binary {
            source.take(count * kind.size(), "an array")?;
        } else {
            for _ in 0..count {
                source.word();
            }
        }
        source.is_binary = false;
    }
    Ok(())
}

pub(super) fn read(mut source: Source<'_>, draft: &mut Draft<'_>) -> Result<(), MeshError> {
    let header = source.line().unwrap_or_default();
    // Version 5 and later have offsets and connectivity apart.
    let version = header.trim_ascii_end().rsplit(u8::is_ascii_whitespace).next().and_then(super::source::parsed::<f64>);
    let is_new = version.is_some_and(|version| version >= 5.0);
    source.line().ok_or_else(|| source.truncated("the title"))?;
    let is_binary = match source.word().ok_or_else(|| source.truncated("`ASCII` or `BINARY`"))? {
        b"ASCII" => false,
        b"BINARY" => true,
        other => return Err(source.syntax(format!("`{}` instead of ASCII or BINARY", shown(other)))),
    };
    let mut faces = Faces::default();
    let mut has_points = false;
    while let Some(word) = source.word() {
        match word.to_ascii_uppercase().as_slice() {
            b"DATASET" => match source.word() {
                Some(b"POLYDATA" | b"UNSTRUCTURED_GRID") => {}
                other => {
                    let other = shown(other.unwrap_or_default());
                    let message =
                        format!("data sets of type `{other}` are not read: export POLYDATA or UNSTRUCTURED_GRID");
                    return Err(source.fail(Problem::Unsupported { message }));
                }
            },
            b"POINTS" => {
                has_points = true;
                let count: i64 = source.number("the count of points")?;
                let kind = source.word().and_then(scalar).ok_or_else(|| source.syntax("no type of numbers"))?;
                begin_data(&mut source, is_binary);
                let count = source.count(count, if is_binary { 3 * kind.size() } else { 6 }, "points")?;
                for _ in 0..count {
                    let mut at = [0.0; 3];
                    for coordinate in &mut at {
                        *coordinate = if is_binary {
                            source.real(kind, Order::Big, "a coordinate")?
                        } else {
                            source.number("a coordinate")?
                        };
                    }
                    draft.vertex(at).map_err(|problem| source.fail(problem))?;
                }
                source.is_binary = false;
            }
            b"POLYGONS" => faces.polygons = cells(&mut source, is_binary, is_new)?,
            b"TRIANGLE_STRIPS" => faces.strips = cells(&mut source, is_binary, is_new)?,
            b"CELLS" => faces.grid = cells(&mut source, is_binary, is_new)?,
            b"VERTICES" | b"LINES" => draft.lines += cells(&mut source, is_binary, is_new)?.ends.len(),
            b"CELL_TYPES" => {
                let count: i64 = source.number("the count of types")?;
                begin_data(&mut source, is_binary);
                faces.types = integers(&mut source, is_binary, count, Scalar::I32, "types of cells")?;
                source.is_binary = false;
            }
            b"FIELD" => skip_field(&mut source, is_binary)?,
            b"METADATA" => {
                // Up to an empty line.
                source.line();
                while source.line().is_some_and(|line| !line.trim_ascii().is_empty()) {}
            }
            // Values at points and cells come last.
            b"POINT_DATA" | b"CELL_DATA" => break,
            _ => return Err(source.syntax(format!("`{}`: a section such as POINTS is expected", shown(word)))),
        }
    }
    if !has_points {
        return Err(source.truncated("the section POINTS"));
    }
    faces.add(source.file, 0, draft)
}
