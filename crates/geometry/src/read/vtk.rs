//! VTK's legacy format, text and binary: POLYDATA and UNSTRUCTURED_GRID. Also contains what this format shares with
//! VTK's XML formats.
//!
//! `vtkio` is not used: it allocates as much memory as the counts in a file demand, decompresses without a limit and
//! does not say which element is wrong.

use std::collections::BTreeMap;

use super::allowance::MemoryAllowance;
use super::draft::{Draft, MAX_REGIONS};
use super::source::{Order, Scalar, Source, shown, words};
use super::volume::Cell;
use crate::{Element, MeshError, Problem};

fn scalar(word: &[u8]) -> Option<Scalar> {
    Some(match word.to_ascii_lowercase().as_slice() {
        b"char" | b"signed_char" | b"vtktypeint8" => Scalar::I8,
        b"unsigned_char" | b"vtktypeuint8" => Scalar::U8,
        b"short" | b"vtktypeint16" => Scalar::I16,
        b"unsigned_short" | b"vtktypeuint16" => Scalar::U16,
        // Identifiers are written as `int`, whatever their type in memory.
        b"int" | b"vtkidtype" | b"vtktypeint32" => Scalar::I32,
        b"unsigned_int" | b"vtktypeuint32" => Scalar::U32,
        b"long" | b"long_long" | b"vtktypeint64" => Scalar::I64,
        b"unsigned_long" | b"unsigned_long_long" | b"vtktypeuint64" => Scalar::U64,
        b"float" => Scalar::F32,
        b"double" => Scalar::F64,
        _ => return None,
    })
}

/// Lists of vertices: the vertices of cell n are `connectivity[ends[n - 1]..ends[n]]`.
#[derive(Default)]
pub(super) struct Cells {
    pub(super) connectivity: Vec<i64>,
    pub(super) ends: Vec<i64>,
}

/// The surface of a POLYDATA or UNSTRUCTURED_GRID file, before its vertex indices are checked.
#[derive(Default)]
pub(super) struct Faces {
    pub(super) polygons: Cells,
    pub(super) strips: Cells,
    pub(super) grid: Cells,
    /// VTK cell types of `grid`.
    pub(super) types: Vec<i64>,
    /// The name of an array at the cells that numbers regions, and its values.
    pub(super) regions: Option<(String, Vec<i64>)>,
}

/// Names of arrays at cells that number regions, as programs write them: Gmsh and meshio, VMTK, TetGen and others.
const REGIONS: [&str; 9] = [
    "gmsh:physical",
    "cellentityids",
    "material",
    "materialid",
    "materialids",
    "region",
    "regionid",
    "medit:ref",
    "label",
];

/// Returns whether an array at cells numbers regions.
pub(super) fn is_region(name: &str) -> bool {
    REGIONS.iter().any(|region| name.eq_ignore_ascii_case(region))
}

impl Cells {
    /// Returns the lists with their indices.
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
    /// Returns the memory of the lists, bytes.
    pub(super) fn bytes(&self) -> usize {
        let cells = [&self.polygons, &self.strips, &self.grid];
        let lists = cells.into_iter().flat_map(|cells| [&cells.connectivity, &cells.ends]).chain([&self.types]);
        let lists = lists.chain(self.regions.iter().map(|(_, list)| list));
        lists.map(|list| size_of_val(list.as_slice())).sum()
    }

    /// Returns the group of the region of a cell, if it is a volume element. `groups` are those of the values so far; one more than
    /// [`MAX_REGIONS`] suffices for the draft to tell that some are left out.
    fn region(
        &self,
        kind: i64,
        number: u64,
        groups: &mut BTreeMap<i64, usize>,
        draft: &mut Draft<'_>,
    ) -> Result<Option<usize>, Problem> {
        let is_volume = matches!(kind, 10..=14 | 24..=27 | 29 | 31..=33 | 37 | 71..=74 | 78..=81);
        let Some((name, values)) = self.regions.as_ref().filter(|_| is_volume) else { return Ok(None) };
        let Some(value) = usize::try_from(number).ok().and_then(|number| values.get(number)) else { return Ok(None) };
        if !groups.contains_key(value) {
            if groups.len() > MAX_REGIONS {
                return Ok(None);
            }
            groups.insert(*value, draft.group(&format!("{name} {value}"))?);
        }
        Ok(groups.get(value).copied())
    }

    /// Adds the faces to a draft. Their vertex indices are relative to the vertex `first` of the draft.
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
            draft.strip(&corners, &[]).map_err(|problem| fail(number, problem))?;
        }
        let mut groups: BTreeMap<i64, usize> = BTreeMap::new();
        for ((number, list), kind) in self.grid.lists().zip(&self.types) {
            corners.clear();
            corners.extend(list.map_err(|problem| fail(number, problem))?.iter().map(|at| at.saturating_add(first)));
            let region = self.region(*kind, number, &mut groups, draft).map_err(|problem| fail(number, problem))?;
            cell(*kind, &mut corners, region.as_slice(), draft).map_err(|problem| fail(number, problem))?;
        }
        if self.grid.ends.len() != self.types.len() {
            let message = format!("{} cells, but {} types", self.grid.ends.len(), self.types.len());
            return Err(fail(self.types.len() as u64, Problem::Syntax { message }));
        }
        Ok(())
    }
}

/// Adds a cell of a VTK cell type; a volume element to the groups of its regions.
fn cell(kind: i64, corners: &mut [i64], regions: &[usize], draft: &mut Draft<'_>) -> Result<(), Problem> {
    let mut face = |corners: &[i64], count: usize| {
        draft.drops_unused |= corners.len() > count;
        let short = || Problem::Syntax { message: format!("a cell of type {kind} with {} vertices", corners.len()) };
        draft.polygon(corners.get(..count).ok_or_else(short)?, &[], &[])
    };
    match kind {
        5 => face(corners, 3),
        7 => face(corners, corners.len()),
        9 => face(corners, 4),
        // A pixel is a rectangle whose corners are numbered row by row.
        8 if corners.len() == 4 => {
            corners.swap(2, 3);
            face(corners, 4)
        }
        22 | 34 | 69 | 76 => face(corners, 3),
        23 | 28 | 30 | 70 | 77 => face(corners, 4),
        // For a polygon with curved sides, the corners come first.
        36 => face(corners, corners.len() / 2),
        6 => draft.strip(corners, &[]),
        10 | 24 | 71 | 78 => draft.cell(Cell::Tetrahedron, corners, regions),
        11 if corners.len() == 8 => {
            corners.swap(2, 3);
            corners.swap(6, 7);
            draft.cell(Cell::Hexahedron, corners, regions)
        }
        12 | 25 | 29 | 33 | 72 | 79 => draft.cell(Cell::Hexahedron, corners, regions),
        13 | 26 | 31 | 32 | 73 | 80 => draft.cell(Cell::Prism, corners, regions),
        14 | 27 | 37 | 74 | 81 => draft.cell(Cell::Pyramid, corners, regions),
        0..=4 | 21 | 35 | 68 | 75 => {
            draft.lines += 1;
            Ok(())
        }
        _ => Err(Problem::Unsupported {
            message: format!("cells of type {kind} are not read: export triangles or tetrahedra"),
        }),
    }
}

/// Reads integers in the encoding of the file: text, or binary with the most significant byte first.
fn integers(
    source: &mut Source<'_>,
    is_binary: bool,
    count: i64,
    scalar: Scalar,
    what: &str,
    allowance: &mut MemoryAllowance<'_>,
) -> Result<Vec<i64>, MeshError> {
    let count = source.count(count, if is_binary { scalar.size() } else { 2 }, what)?;
    allowance.take(2 * size_of::<i64>() * count).map_err(|problem| source.fail(problem))?;
    if is_binary {
        let bytes = source.take(count * scalar.size(), what)?;
        return Ok(bytes.chunks_exact(scalar.size()).map(|bytes| scalar.integer(bytes, Order::Big)).collect());
    }
    (0..count).map(|_| source.number(what)).collect()
}

/// Moves to the data of a section, which begins on the next line.
fn begin_data(source: &mut Source<'_>, is_binary: bool) {
    if is_binary {
        source.line();
    }
    source.is_binary = is_binary;
}

/// Reads the lists of a section: `n size` and each list after its length, or, since version 5, offsets and
/// connectivity.
fn cells(source: &mut Source<'_>, is_binary: bool, allowance: &mut MemoryAllowance<'_>) -> Result<Cells, MeshError> {
    let what = "lists of vertices";
    let count: i64 = source.number("the count of cells")?;
    let size: i64 = source.number("the size of cells")?;
    let mut cells = Cells::default();
    if is_word(source.peek(), "OFFSETS") {
        for part in ["OFFSETS", "CONNECTIVITY"] {
            if !is_word(source.word(), part) {
                return Err(source.syntax(format!("`{part}` is expected")));
            }
            let kind = source.word().and_then(scalar).ok_or_else(|| source.syntax("a type of numbers is expected"))?;
            begin_data(source, is_binary);
            let is_offsets = part == "OFFSETS";
            let list = integers(source, is_binary, if is_offsets { count } else { size }, kind, what, allowance)?;
            source.is_binary = false;
            *if is_offsets { &mut cells.ends } else { &mut cells.connectivity } = list;
        }
        if cells.ends.first().is_some_and(|first| *first != 0) {
            return Err(source.syntax(format!("the first offset is {} instead of 0", cells.ends[0])));
        }
        cells.ends = cells.ends.split_off(1.min(cells.ends.len()));
        return Ok(cells);
    }
    begin_data(source, is_binary);
    let list = integers(source, is_binary, size, Scalar::I32, what, allowance)?;
    source.is_binary = false;
    let mut rest = list.as_slice();
    while let Some((length, after)) = rest.split_first() {
        let own = usize::try_from(*length).ok().and_then(|length| after.get(..length));
        let own =
            own.ok_or_else(|| source.syntax(format!("a list of {length} vertices does not fit into its section")))?;
        for corner in own {
            allowance.push(&mut cells.connectivity, *corner).map_err(|problem| source.fail(problem))?;
        }
        allowance.push(&mut cells.ends, cells.connectivity.len() as i64).map_err(|problem| source.fail(problem))?;
        rest = &after[own.len()..];
    }
    if cells.ends.len() as i64 != count {
        return Err(source.syntax(format!("{} cells instead of {count}", cells.ends.len())));
    }
    Ok(cells)
}

/// Returns whether a word is a keyword, ignoring case.
fn is_word(word: Option<&[u8]>, keyword: &str) -> bool {
    word.is_some_and(|word| word.eq_ignore_ascii_case(keyword.as_bytes()))
}

/// Skips `FIELD name n` and its arrays.
fn skip_field(source: &mut Source<'_>, is_binary: bool) -> Result<(), MeshError> {
    source.word();
    let arrays: i64 = source.number("the count of arrays")?;
    for _ in 0..source.count(arrays, 8, "arrays")? {
        while is_word(source.peek(), "METADATA") {
            skip_metadata(source);
        }
        let name = source.word().ok_or_else(|| source.truncated("an array"))?;
        if !is_word(Some(name), "NULL_ARRAY") {
            skip_array(source, is_binary)?;
        }
    }
    Ok(())
}

/// Skips a METADATA block, which ends with an empty line.
fn skip_metadata(source: &mut Source<'_>) {
    source.word();
    source.line();
    while source.line().is_some_and(|line| words(line).next().is_some()) {}
}

/// Skips an array of a field after its name: `components tuples type`, followed by the values.
fn skip_array(source: &mut Source<'_>, is_binary: bool) -> Result<(), MeshError> {
    let components: i64 = source.number("the count of components")?;
    let tuples: i64 = source.number("the count of tuples")?;
    let kind = source.word().unwrap_or_default().to_ascii_lowercase();
    let count = components.checked_mul(tuples).unwrap_or(i64::MAX);
    let what = "values of an array";
    match kind.as_slice() {
        // Each value is on its own line, with special characters encoded as %20 etc.
        b"string" | b"utf8_string" | b"variant" if !is_binary || kind == b"variant" => {
            source.line();
            for _ in 0..source.count(count, 1, what)? {
                source.line();
            }
        }
        b"string" | b"utf8_string" => {
            begin_data(source, is_binary);
            for _ in 0..source.count(count, 1, what)? {
                skip_text(source)?;
            }
        }
        b"bit" if is_binary => {
            begin_data(source, is_binary);
            // VTK packs all values, but writes only one bit per tuple. The data is followed by a line feed.
            let packed = |count: i64| usize::try_from(count / 8 + i64::from(count % 8 != 0)).unwrap_or(usize::MAX);
            let ends = |bytes: &usize| source.rest().get(*bytes) == Some(&b'\n');
            let bytes = Some(packed(tuples)).filter(|bytes| !ends(&packed(count)) && ends(bytes));
            source.take(bytes.unwrap_or(packed(count)), what)?;
        }
        _ => {
            let numbers = if kind == b"bit" { Some(Scalar::U8) } else { scalar(&kind) };
            let numbers = numbers.ok_or_else(|| source.syntax(format!("arrays of `{}` are not read", shown(&kind))))?;
            begin_data(source, is_binary);
            skip_values(source, is_binary, count, numbers)?;
        }
    }
    source.is_binary = false;
    Ok(())
}

/// Skips a string in a binary file. The first two bits give the number of bytes of its length: from 3 for one byte to
/// 0 for eight.
fn skip_text(source: &mut Source<'_>) -> Result<(), MeshError> {
    let what = "a text of an array";
    let first = source.rest().first().copied().ok_or_else(|| source.truncated(what))?;
    let bytes = source.take(1 << (3 - (first >> 6)), what)?;
    let length = bytes[1..].iter().fold(i64::from(first & 0x3f), |length, byte| length << 8 | i64::from(*byte));
    let length = source.count(length, 1, "letters")?;
    source.take(length, what)?;
    Ok(())
}

/// Returns the first array at the cells that numbers regions. `source` is behind `CELL_DATA` or `POINT_DATA`.
fn regions(
    source: &mut Source<'_>,
    is_binary: bool,
    mut is_of_cells: bool,
    allowance: &mut MemoryAllowance<'_>,
) -> Result<Option<(String, Vec<i64>)>, MeshError> {
    const WHAT: &str = "values at cells";
    let mut count: i64 = source.number("a count of values")?;
    while let Some(word) = source.peek() {
        if is_word(Some(word), "METADATA") {
            skip_metadata(source);
            continue;
        }
        source.word();
        match word.to_ascii_uppercase().as_slice() {
            section @ (b"CELL_DATA" | b"POINT_DATA") => {
                is_of_cells = section == b"CELL_DATA";
                count = source.number("a count of values")?;
            }
            b"SCALARS" => {
                let name = shown(source.word().unwrap_or_default());
                let kind = source.word().unwrap_or_default().to_ascii_lowercase();
                let components: i64 =
                    if is_word(source.peek(), "LOOKUP_TABLE") { 1 } else { source.number("a count of components")? };
                // `LOOKUP_TABLE` and its name.
                source.word();
                source.word();
                let (numbers, values) = (scalar(&kind), count.checked_mul(components).unwrap_or(i64::MAX));
                let Some(numbers) = numbers else { return Ok(None) };
                begin_data(source, is_binary);
                if is_of_cells && components == 1 && is_region(&name) && numbers.is_integer() {
                    return Ok(Some((name, integers(source, is_binary, values, numbers, WHAT, allowance)?)));
                }
                skip_values(source, is_binary, values, numbers)?;
            }
            b"FIELD" => {
                source.word();
                let arrays: i64 = source.number("the count of arrays")?;
                for _ in 0..source.count(arrays, 8, "arrays")? {
                    while is_word(source.peek(), "METADATA") {
                        skip_metadata(source);
                    }
                    let name = shown(source.word().ok_or_else(|| source.truncated("an array"))?);
                    if is_of_cells && is_region(&name) {
                        let (components, tuples): (i64, i64) = (source.number("components")?, source.number("tuples")?);
                        let numbers = source.word().and_then(|kind| scalar(&kind.to_ascii_lowercase()));
                        let Some(numbers) = numbers.filter(|of| of.is_integer() && components == 1) else {
                            return Ok(None);
                        };
                        begin_data(source, is_binary);
                        return Ok(Some((name, integers(source, is_binary, tuples, numbers, WHAT, allowance)?)));
                    }
                    skip_array(source, is_binary)?;
                }
            }
            // Vectors and others.
            _ => return Ok(None),
        }
    }
    Ok(None)
}

/// Skips values in the encoding of the file.
fn skip_values(source: &mut Source<'_>, is_binary: bool, count: i64, scalar: Scalar) -> Result<(), MeshError> {
    let what = "values of an array";
    let count = source.count(count, if is_binary { scalar.size() } else { 2 }, what)?;
    if is_binary {
        source.take(count * scalar.size(), what)?;
    } else {
        for _ in 0..count {
            source.word();
        }
    }
    source.is_binary = false;
    Ok(())
}

pub(super) fn read(mut source: Source<'_>, draft: &mut Draft<'_>) -> Result<(), MeshError> {
    // The first line contains the version, which is not needed: the lists show which version they use.
    source.line();
    source.line().ok_or_else(|| source.truncated("the title"))?;
    let is_binary = match source.word().ok_or_else(|| source.truncated("`ASCII` or `BINARY`"))? {
        word if is_word(Some(word), "ASCII") => false,
        word if is_word(Some(word), "BINARY") => true,
        other => return Err(source.syntax(format!("`{}` instead of ASCII or BINARY", shown(other)))),
    };
    let mut faces = Faces::default();
    let mut has_points = false;
    while let Some(word) = source.peek() {
        if is_word(Some(word), "METADATA") {
            skip_metadata(&mut source);
            continue;
        }
        source.word();
        match word.to_ascii_uppercase().as_slice() {
            b"DATASET" => match source.word() {
                Some(kind) if is_word(Some(kind), "POLYDATA") || is_word(Some(kind), "UNSTRUCTURED_GRID") => {}
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
            b"POLYGONS" => faces.polygons = cells(&mut source, is_binary, &mut draft.allowance)?,
            b"TRIANGLE_STRIPS" => faces.strips = cells(&mut source, is_binary, &mut draft.allowance)?,
            b"CELLS" => faces.grid = cells(&mut source, is_binary, &mut draft.allowance)?,
            b"VERTICES" | b"LINES" => {
                let lines = cells(&mut source, is_binary, &mut draft.allowance)?.ends.len();
                draft.lines += lines;
            }
            b"CELL_TYPES" => {
                let count: i64 = source.number("the count of types")?;
                begin_data(&mut source, is_binary);
                let allowance = &mut draft.allowance;
                faces.types = integers(&mut source, is_binary, count, Scalar::I32, "types of cells", allowance)?;
                source.is_binary = false;
            }
            b"FIELD" => skip_field(&mut source, is_binary)?,
            // Values at points and cells come last. Those that number regions are read; what can't be read is ignored.
            b"POINT_DATA" | b"CELL_DATA" => {
                let is_of_cells = is_word(Some(word), "CELL_DATA");
                faces.regions = regions(&mut source, is_binary, is_of_cells, &mut draft.allowance).unwrap_or_default();
                break;
            }
            _ => return Err(source.syntax(format!("`{}`: a section such as POINTS is expected", shown(word)))),
        }
    }
    if !has_points {
        return Err(source.truncated("the section POINTS"));
    }
    faces.add(source.file, 0, draft)
}
