//! MEDIT's `.mesh` and `.meshb`, as Gmsh, TetGen, MMG and FreeFEM write them; references become groups and regions.

use super::draft::Draft;
use super::nodes::ElementKind;
use super::source::{Order, Scalar, Source, parsed, shown};
use super::volume::Cell;
use crate::{MeshError, Problem};

/// A section of elements that is read: its name, its code in binary files, the number of its vertices, and its kind.
const SECTIONS: [(&str, i64, usize, ElementKind); 11] = [
    ("Edges", 5, 2, ElementKind::Line),
    ("Triangles", 6, 3, ElementKind::Face(3)),
    ("Quadrilaterals", 7, 4, ElementKind::Face(4)),
    ("Tetrahedra", 8, 4, ElementKind::Cell(Cell::Tetrahedron)),
    ("Prisms", 9, 6, ElementKind::Cell(Cell::Prism)),
    ("Hexahedra", 10, 8, ElementKind::Cell(Cell::Hexahedron)),
    ("Pyramids", 49, 5, ElementKind::Cell(Cell::Pyramid)),
    // Curved elements; their corners come first.
    ("TrianglesP2", 24, 6, ElementKind::Face(3)),
    ("EdgesP2", 25, 3, ElementKind::Line),
    ("QuadrilateralsQ2", 27, 9, ElementKind::Face(4)),
    ("TetrahedraP2", 30, 10, ElementKind::Cell(Cell::Tetrahedron)),
];

/// Codes of the other sections that are read.
const DIMENSION: i64 = 3;
const VERTICES: i64 = 4;
const END: i64 = 54;

/// Returns the byte order of a binary file, which begins with the number 1; `None` for text.
fn order(bytes: &[u8]) -> Option<Order> {
    match bytes.get(..4)? {
        [1, 0, 0, 0] => Some(Order::Little),
        [0, 0, 0, 1] => Some(Order::Big),
        _ => None,
    }
}

/// A file that is being read.
struct MeditFile<'s, 'd, 'l> {
    source: Source<'s>,
    draft: &'d mut Draft<'l>,
    /// Byte order of binary files.
    order: Option<Order>,
    /// Types of whole numbers, of positions in the file and of coordinates in a binary file.
    whole: Scalar,
    position: Scalar,
    real: Scalar,
}

pub(super) fn read(source: Source<'_>, draft: &mut Draft<'_>) -> Result<(), MeshError> {
    let order = order(source.rest());
    let mut file = MeditFile { source, draft, order, whole: Scalar::I32, position: Scalar::I32, real: Scalar::F64 };
    let has_vertices = if order.is_some() { file.binary_sections()? } else { file.text_sections()? };
    if !has_vertices {
        return Err(file.source.truncated("the section Vertices"));
    }
    Ok(())
}

impl<'s> MeditFile<'s, '_, '_> {
    /// Returns the next word of text that is not in a comment.
    fn word(&mut self) -> Option<&'s [u8]> {
        loop {
            let word = self.source.word()?;
            if !word.starts_with(b"#") {
                return Some(word);
            }
            self.source.line();
        }
    }

    fn text<T: std::str::FromStr>(&mut self, what: &str) -> Result<T, MeshError> {
        let word = self.word().ok_or_else(|| self.source.truncated(what))?;
        parsed(word).ok_or_else(|| self.source.no_number(word, what))
    }

    fn integer(&mut self, scalar: Scalar, what: &str) -> Result<i64, MeshError> {
        match self.order {
            None => self.text(what),
            Some(order) => self.source.integer(scalar, order, what),
        }
    }

    /// Reads the sections of a text file. Returns whether there are vertices.
    fn text_sections(&mut self) -> Result<bool, MeshError> {
        let mut has_vertices = false;
        loop {
            let word = self.word().ok_or_else(|| self.source.truncated("`End`"))?;
            let is = |name: &str| word.eq_ignore_ascii_case(name.as_bytes());
            if is("End") {
                return Ok(has_vertices);
            } else if is("MeshVersionFormatted") {
                self.text::<i64>("the version")?;
            } else if is("Dimension") {
                self.dimension()?;
            } else if is("Vertices") {
                has_vertices = true;
                self.vertices()?;
            } else if let Some(section) = SECTIONS.into_iter().find(|section| is(section.0)) {
                self.elements(section)?;
            } else if word[0].is_ascii_alphabetic() {
                // An unused section, such as one of normals: numbers up to the next name.
                loop {
                    let before = self.source.clone();
                    let Some(word) = self.word() else { break };
                    if word[0].is_ascii_alphabetic() {
                        self.source = before;
                        break;
                    }
                }
            } else {
                let message = format!("`{}`: a section such as Vertices is expected", shown(word));
                return Err(self.source.syntax(message));
            }
        }
    }

    /// Reads the sections of a binary file. Returns whether there are vertices.
    fn binary_sections(&mut self) -> Result<bool, MeshError> {
        let whole = self.source.rest();
        self.source.is_binary = true;
        self.source.take(4, "the number 1 in binary")?;
        let version = self.integer(Scalar::I32, "the version")?;
        self.real = if version == 1 { Scalar::F32 } else { Scalar::F64 };
        self.position = if version < 3 { Scalar::I32 } else { Scalar::I64 };
        self.whole = if version < 4 { Scalar::I32 } else { Scalar::I64 };
        let mut has_vertices = false;
        loop {
            let code = self.integer(Scalar::I32, "a section")?;
            if code == END {
                return Ok(has_vertices);
            }
            let next = self.integer(self.position, "the position of the next section")?;
            match SECTIONS.into_iter().find(|section| section.1 == code) {
                _ if code == DIMENSION => self.dimension()?,
                _ if code == VERTICES => {
                    has_vertices = true;
                    self.vertices()?;
                }
                Some(section) => self.elements(section)?,
                None => {}
            }
            if next == 0 {
                return Ok(has_vertices);
            }
            // Sections follow each other; one that is not used is skipped.
            let at = whole.len() - self.source.rest().len();
            let skipped = usize::try_from(next).ok().and_then(|next| next.checked_sub(at));
            let skipped = skipped.ok_or_else(|| self.source.syntax("a section that ends before its content"))?;
            self.source.take(skipped, "the next section")?;
        }
    }

    fn dimension(&mut self) -> Result<(), MeshError> {
        let dimension = self.integer(Scalar::I32, "the dimension")?;
        if dimension == 3 {
            return Ok(());
        }
        let message = format!("a mesh of dimension {dimension} is not read: export it with three coordinates");
        Err(self.source.fail(Problem::Unsupported { message }))
    }

    /// Reads a count of records of so many numbers, each at least as wide as a whole number.
    fn count(&mut self, numbers: usize, what: &str) -> Result<usize, MeshError> {
        let count = self.integer(self.whole, what)?;
        let bytes = if self.order.is_some() { self.whole.size() } else { 2 };
        self.source.count(count, bytes * numbers, what)
    }

    fn vertices(&mut self) -> Result<(), MeshError> {
        if self.draft.vertices() > 0 {
            return Err(self.source.syntax("a second section Vertices"));
        }
        for _ in 0..self.count(4, "vertices")? {
            let mut at = [0.0; 3];
            for coordinate in &mut at {
                *coordinate = match self.order {
                    None => self.text("a coordinate")?,
                    Some(order) => self.source.real(self.real, order, "a coordinate")?,
                };
            }
            self.integer(self.whole, "the reference of a vertex")?;
            self.draft.vertex(at).map_err(|problem| self.source.fail(problem))?;
        }
        Ok(())
    }

    fn elements(&mut self, (name, _, vertices, kind): (&str, i64, usize, ElementKind)) -> Result<(), MeshError> {
        let mut corners = vec![0; vertices];
        for _ in 0..self.count(vertices + 1, name)? {
            for corner in &mut corners {
                *corner = self.integer(self.whole, "a vertex of an element")?.saturating_sub(1);
            }
            let reference = self.integer(self.whole, "the reference of an element")?;
            // The references of faces and of cells are numbered apart.
            let name = match kind {
                _ if reference == 0 => None,
                ElementKind::Line => None,
                ElementKind::Face(_) => Some(format!("surface {reference}")),
                ElementKind::Cell(_) => Some(format!("medit:ref {reference}")),
            };
            let group = name.map(|name| self.draft.group(&name)).transpose();
            let added = group.and_then(|group| self.draft.element(kind, &corners, group.as_slice()));
            added.map_err(|problem| self.source.fail(problem))?;
        }
        Ok(())
    }
}
