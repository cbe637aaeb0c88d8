//! TetGen's `.node` and `.ele`: points in one file, tetrahedra in the other.

use super::draft::Draft;
use super::nodes::{ElementKind, NumberedNodes};
use super::source::{Source, parsed, shown};
use super::volume::Cell;
use crate::{Element, MeshError, Problem};

/// Longest line, in words: a point or element with many attributes.
const MAX_WORDS: usize = 1 << 12;

/// Reads both files. `name` is that of either, with the content `bytes`.
pub(super) fn read(
    name: &str,
    bytes: &[u8],
    neighbours: &dyn Fn(&str) -> Option<Vec<u8>>,
    draft: &mut Draft<'_>,
) -> Result<(), MeshError> {
    let fail = |problem| MeshError { file: name.to_owned(), element: Element::Whole, place_m: None, problem };
    let (stem, extension) = name.rsplit_once('.').unwrap_or((name, ""));
    let is_elements = extension.eq_ignore_ascii_case("ele");
    let bare = stem.rsplit(['/', '\\']).next().unwrap_or_default();
    let other = format!("{bare}.{}", if is_elements { "node" } else { "ele" });
    let found = neighbours(&other).ok_or_else(|| fail(Problem::NeighbourMissing { name: other.clone() }))?;
    if bytes.len() + found.len() > draft.limits.bytes {
        return Err(fail(Problem::TooLarge { what: "bytes", limit: draft.limits.bytes }));
    }
    draft.allowance.add_file(found.len());
    draft.allowance.take(found.len()).map_err(fail)?;
    let (own, beside) = (Source::new(name, bytes), Source::new(&other, super::without_mark(&found)));
    let (nodes, elements) = if is_elements { (beside, own) } else { (own, beside) };
    let nodes = read_nodes(Table::new(nodes), draft)?;
    read_elements(Table::new(elements), &nodes, draft)
}

/// The rows of a file, without comments.
struct Table<'s> {
    source: Source<'s>,
    row: Source<'s>,
}

impl<'s> Table<'s> {
    fn new(source: Source<'s>) -> Self {
        Table { row: source.clone(), source }
    }

    /// Goes to the next row with a word. Returns whether there is one.
    fn next(&mut self) -> bool {
        while let Some(row) = self.source.row() {
            if row.peek().is_some_and(|word| !word.starts_with(b"#")) {
                self.row = row;
                return true;
            }
        }
        false
    }

    /// Returns the next word of the row that is not in a comment.
    fn word(&mut self) -> Option<&'s [u8]> {
        self.row.peek().filter(|word| !word.starts_with(b"#"))?;
        self.row.word()
    }

    /// Reads the next number of the row.
    fn number<T: std::str::FromStr>(&mut self, what: &str) -> Result<T, MeshError> {
        let word = self.word().ok_or_else(|| self.row.truncated(what))?;
        parsed(word).ok_or_else(|| self.row.no_number(word, what))
    }

    /// Reads the numbers of the first row: a count, and those that the row may leave out, with what they are then.
    fn head<const N: usize>(&mut self, what: &str, others: [(i64, &str); N]) -> Result<(usize, [i64; N]), MeshError> {
        if !self.next() {
            return Err(self.source.truncated(format!("the count of {what}")));
        }
        let count = self.number(&format!("the count of {what}"))?;
        let count = self.source.count(count, 2, what)?;
        let mut numbers = [0; N];
        for (number, (default, what)) in numbers.iter_mut().zip(others) {
            *number = match self.word() {
                None => default,
                Some(word) => parsed(word).ok_or_else(|| self.row.no_number(word, what))?,
            };
        }
        Ok((count, numbers))
    }

    fn record(&mut self, number: usize, count: usize, what: &str) -> Result<(), MeshError> {
        if self.next() { Ok(()) } else { Err(self.source.truncated(format!("row {number} of {count} of the {what}"))) }
    }

    fn columns(&self, count: i64) -> Result<usize, MeshError> {
        let count = usize::try_from(count).ok().filter(|count| *count <= MAX_WORDS);
        count.ok_or_else(|| self.row.syntax(format!("the count of attributes is not from 0 to {MAX_WORDS}")))
    }
}

/// Reads the points. Those with a boundary marker other than 0 are in the group `marker N`.
fn read_nodes(mut table: Table<'_>, draft: &mut Draft<'_>) -> Result<NumberedNodes, MeshError> {
    let others = [(3, "the dimension"), (0, "the count of attributes"), (0, "0 or 1, whether there are markers")];
    let (count, [dimension, attributes, markers]) = table.head("points", others)?;
    if dimension != 3 {
        let message = format!("points of dimension {dimension} are not read: they need three coordinates");
        return Err(table.row.fail(Problem::Unsupported { message }));
    }
    let attributes = table.columns(attributes)?;
    let mut nodes = NumberedNodes::default();
    for record in 0..count {
        table.record(record, count, "points")?;
        let number = table.number("the number of a point")?;
        let mut at = [0.0; 3];
        for coordinate in &mut at {
            *coordinate = table.number("a coordinate")?;
        }
        for _ in 0..attributes {
            table.number::<f64>("an attribute")?;
        }
        let marker = if markers == 0 { 0 } else { table.number::<i64>("a boundary marker")? };
        let vertex = draft.vertices() as i64;
        let added = nodes.add(number, at, draft).and_then(|()| {
            if marker == 0 {
                return Ok(());
            }
            let group = draft.group(&format!("marker {marker}"))?;
            draft.assign(&[vertex], &[group])
        });
        added.map_err(|problem| table.row.fail(problem))?;
    }
    Ok(nodes)
}

/// Reads the tetrahedra. The first attribute, if there is one, is the number of a region.
fn read_elements(mut table: Table<'_>, nodes: &NumberedNodes, draft: &mut Draft<'_>) -> Result<(), MeshError> {
    let others = [(4, "the nodes of a tetrahedron"), (0, "the count of attributes")];
    let (count, [corners, attributes]) = table.head("tetrahedra", others)?;
    if corners != 4 && corners != 10 {
        let message = format!("elements of {corners} nodes are not read: tetrahedra have 4 or 10");
        return Err(table.row.fail(Problem::Unsupported { message }));
    }
    let attributes = table.columns(attributes)?;
    for record in 0..count {
        table.record(record, count, "tetrahedra")?;
        table.number::<i64>("the number of a tetrahedron")?;
        let mut vertices = [0; 10];
        let vertices = &mut vertices[..if corners == 4 { 4 } else { 10 }];
        for vertex in &mut *vertices {
            *vertex = table.number("a point of a tetrahedron")?;
        }
        let mut region = None;
        for place in 0..attributes {
            let word = table.word().ok_or_else(|| table.row.truncated("an attribute"))?;
            let number: f64 = parsed(word).ok_or_else(|| table.row.no_number(word, "an attribute"))?;
            if place == 0 && number != 0.0 {
                region = Some(format!("region {}", shown(word)));
            }
        }
        let added = nodes.to_vertices(vertices, draft).and_then(|()| {
            let region = region.map(|name| draft.group(&name)).transpose()?;
            draft.element(ElementKind::Cell(Cell::Tetrahedron), vertices, region.as_slice())
        });
        added.map_err(|problem| table.row.fail(problem))?;
    }
    Ok(())
}
