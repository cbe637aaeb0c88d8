//! Abaqus `.inp`, as Abaqus, Gmsh, meshio and others write it: the nodes and elements of one part.

use super::draft::Draft;
use super::nodes::{ElementKind, NumberedNodes};
use super::source::{Source, named, parsed, shown};
use super::volume::Cell;
use crate::{MeshError, Problem};

/// Beginnings of the names of element types, with the number of nodes, corners first, and the kind. What follows tells
/// how an element is evaluated (reduced, hybrid, modified, …), which does not change its shape.
const TYPES: [(&str, usize, ElementKind); 34] = [
    ("C3D4", 4, ElementKind::Cell(Cell::Tetrahedron)),
    ("C3D10", 10, ElementKind::Cell(Cell::Tetrahedron)),
    ("C3D8", 8, ElementKind::Cell(Cell::Hexahedron)),
    ("C3D20", 20, ElementKind::Cell(Cell::Hexahedron)),
    ("C3D6", 6, ElementKind::Cell(Cell::Prism)),
    ("C3D15", 15, ElementKind::Cell(Cell::Prism)),
    ("C3D5", 5, ElementKind::Cell(Cell::Pyramid)),
    ("SC6", 6, ElementKind::Cell(Cell::Prism)),
    ("SC8", 8, ElementKind::Cell(Cell::Hexahedron)),
    ("S3", 3, ElementKind::Face(3)),
    ("S4", 4, ElementKind::Face(4)),
    ("S6", 6, ElementKind::Face(3)),
    ("S8", 8, ElementKind::Face(4)),
    ("S9", 9, ElementKind::Face(4)),
    ("STRI3", 3, ElementKind::Face(3)),
    ("STRI65", 6, ElementKind::Face(3)),
    // Gmsh and meshio write the surface of a volume so.
    ("CPS3", 3, ElementKind::Face(3)),
    ("CPS4", 4, ElementKind::Face(4)),
    ("CPS6", 6, ElementKind::Face(3)),
    ("CPS8", 8, ElementKind::Face(4)),
    ("CPE3", 3, ElementKind::Face(3)),
    ("CPE4", 4, ElementKind::Face(4)),
    ("M3D3", 3, ElementKind::Face(3)),
    ("M3D4", 4, ElementKind::Face(4)),
    ("M3D6", 6, ElementKind::Face(3)),
    ("M3D8", 8, ElementKind::Face(4)),
    ("R3D3", 3, ElementKind::Face(3)),
    ("R3D4", 4, ElementKind::Face(4)),
    ("SFM3D3", 3, ElementKind::Face(3)),
    ("SFM3D4", 4, ElementKind::Face(4)),
    ("T3D2", 2, ElementKind::Line),
    ("T3D3", 3, ElementKind::Line),
    ("B31", 2, ElementKind::Line),
    ("B32", 3, ElementKind::Line),
];

/// Beginnings of the names of element types that are no part of a surface, with any number of nodes.
const NO_SURFACE: [&str; 9] = ["SPRING", "DASHPOT", "MASS", "ROTARYI", "CONN", "DCOUP", "GAP", "PIPE", "T2D"];

/// What the data lines after a keyword are.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Data {
    Unused,
    Placement,
    Nodes,
    Elements { nodes: usize, kind: ElementKind, group: Option<usize> },
}

/// A file that is being read.
struct AbaqusFile<'s, 'd, 'l> {
    source: Source<'s>,
    /// The line that was read last.
    row: Source<'s>,
    draft: &'d mut Draft<'l>,
    /// The nodes of the current part: parts number theirs apart.
    nodes: NumberedNodes,
    /// Number of parts and other sections so far that have nodes of their own, and which of them has elements.
    section: usize,
    section_of_elements: Option<usize>,
    instances: usize,
}

pub(super) fn read(source: Source<'_>, draft: &mut Draft<'_>) -> Result<(), MeshError> {
    let row = source.clone();
    let nodes = NumberedNodes::default();
    let mut file = AbaqusFile { source, row, draft, nodes, section: 0, section_of_elements: None, instances: 0 };
    // Nodes of other parts, and those of reference points, are in no triangle.
    file.draft.drops_unused = true;
    let mut data = Data::Unused;
    while let Some(line) = file.next() {
        if line.starts_with(b"*") {
            data = file.keyword(line)?;
            continue;
        }
        match data {
            Data::Unused => {}
            Data::Placement => file.placement(line)?,
            Data::Nodes => file.node(line)?,
            Data::Elements { nodes, kind, group } => file.element(line, nodes, kind, group)?,
        }
    }
    if file.section_of_elements.is_none() {
        return Err(file.source.truncated("the section of elements (*ELEMENT)"));
    }
    Ok(())
}

/// Returns whether a line is a comment.
fn is_comment(line: &[u8]) -> bool {
    line.starts_with(b"**")
}

/// Splits a line at its commas.
fn fields(line: &[u8]) -> impl Iterator<Item = &[u8]> {
    line.split(|byte| *byte == b',').map(<[u8]>::trim_ascii)
}

impl<'s> AbaqusFile<'s, '_, '_> {
    /// Returns the next line that is not empty and no comment, without white space around it.
    fn next(&mut self) -> Option<&'s [u8]> {
        loop {
            self.row = self.source.row()?;
            let line = self.row.rest().trim_ascii();
            if !is_comment(line) {
                return Some(line);
            }
        }
    }

    fn unsupported(&self, message: String) -> MeshError {
        self.row.fail(Problem::Unsupported { message })
    }

    /// Reads the line of a keyword, with the lines that continue it.
    fn keyword(&mut self, line: &[u8]) -> Result<Data, MeshError> {
        let mut line = line.to_owned();
        while line.ends_with(b",") {
            let Some(more) = self.next() else { break };
            if more.len() + line.len() > 1 << 12 {
                return Err(self.row.syntax("a keyword with more than 4096 letters"));
            }
            line.extend(more);
        }
        let mut parts = fields(&line);
        let name = parts.next().unwrap_or_default().split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        let name = name.collect::<Vec<_>>().join(&b' ').to_ascii_uppercase();
        let option = |wanted: &[u8]| {
            let pair = |field: &[u8]| {
                let at = field.iter().position(|byte| *byte == b'=')?;
                field[..at].trim_ascii().eq_ignore_ascii_case(wanted).then(|| field[at + 1..].trim_ascii().to_owned())
            };
            fields(&line).find_map(pair)
        };
        match &name[..] {
            b"*NODE" => {
                if let Some(system) = option(b"SYSTEM").filter(|system| !system.eq_ignore_ascii_case(b"R")) {
                    let message = format!("nodes in the system `{}` are not read: export x, y and z", shown(&system));
                    return Err(self.unsupported(message));
                }
                if option(b"INPUT").is_some() {
                    return Err(self.in_other_file());
                }
                Ok(Data::Nodes)
            }
            b"*ELEMENT" => {
                if option(b"INPUT").is_some() {
                    return Err(self.in_other_file());
                }
                let kind = option(b"TYPE").ok_or_else(|| self.row.syntax("*ELEMENT without TYPE="))?;
                self.elements(&kind.to_ascii_uppercase(), option(b"ELSET").as_deref())
            }
            b"*INCLUDE" | b"*MANIFEST" => Err(self.in_other_file()),
            b"*SYSTEM" => {
                let message = "*SYSTEM, another system of coordinates, is not read: export nodes in the global one";
                Err(self.unsupported(message.to_owned()))
            }
            b"*NGEN" | b"*NFILL" | b"*NCOPY" | b"*ELGEN" | b"*ELCOPY" => {
                let message =
                    format!("{}, which generates a part of the mesh, is not read: export all of it", shown(&name));
                Err(self.unsupported(message))
            }
            b"*PART" | b"*ASSEMBLY" | b"*INSTANCE" | b"*END PART" | b"*END ASSEMBLY" | b"*END INSTANCE" => {
                self.instances += usize::from(name == b"*INSTANCE");
                if self.instances > 1 {
                    let message = "an assembly of more than one instance is not read: export one part";
                    return Err(self.unsupported(message.to_owned()));
                }
                self.section += 1;
                self.nodes = NumberedNodes::default();
                Ok(if name == b"*INSTANCE" { Data::Placement } else { Data::Unused })
            }
            _ => Ok(Data::Unused),
        }
    }

    fn in_other_file(&self) -> MeshError {
        let message = "a part of the mesh is in another file (*INCLUDE or INPUT=), which is not read: put all into one";
        self.unsupported(message.to_owned())
    }

    /// Begins the elements of a type, which may name an element set: a region.
    fn elements(&mut self, kind: &[u8], set: Option<&[u8]>) -> Result<Data, MeshError> {
        let starts = |name: &str| kind.starts_with(name.as_bytes());
        if NO_SURFACE.into_iter().any(starts) {
            self.draft.lines += 1;
            return Ok(Data::Unused);
        }
        let found = TYPES.into_iter().filter(|(name, ..)| starts(name)).max_by_key(|(name, ..)| name.len());
        let Some((_, nodes, kind)) = found else {
            let message = format!("elements of the type {} are not read: export C3D4, C3D8, C3D10 or S3", shown(kind));
            return Err(self.unsupported(message));
        };
        if *self.section_of_elements.get_or_insert(self.section) != self.section {
            let message = "elements in more than one part are not read: export one part";
            return Err(self.unsupported(message.to_owned()));
        }
        let group = set.map(|set| self.draft.group(&named(set))).transpose();
        let group = group.map_err(|problem| self.row.fail(problem))?;
        Ok(Data::Elements { nodes, kind, group })
    }

    fn number<T: std::str::FromStr>(&self, field: Option<&[u8]>, what: &str) -> Result<T, MeshError> {
        let field = field.filter(|field| !field.is_empty()).ok_or_else(|| self.row.truncated(what))?;
        parsed(field).ok_or_else(|| self.row.no_number(field, what))
    }

    /// Reads how an instance is moved: a translation, or two points of an axis and an angle. Refuses one that is.
    fn placement(&self, line: &[u8]) -> Result<(), MeshError> {
        let given = fields(line).filter(|field| !field.is_empty()).take(8);
        let numbers: Vec<f64> = given.map(|field| self.number(Some(field), "a placement")).collect::<Result<_, _>>()?;
        let moves = if let [_, _, _, _, _, _, angle] = &numbers[..] { std::slice::from_ref(angle) } else { &numbers };
        if moves.iter().all(|number| *number == 0.0) {
            return Ok(());
        }
        let message = "an instance that is translated or rotated is not read: export the part where it is";
        Err(self.unsupported(message.to_owned()))
    }

    /// Reads a node: its number, and up to three coordinates; a missing one is 0.
    fn node(&mut self, line: &[u8]) -> Result<(), MeshError> {
        let mut parts = fields(line);
        let number = self.number(parts.next(), "the number of a node")?;
        let mut at = [0.0; 3];
        for (coordinate, field) in at.iter_mut().zip(parts).filter(|(_, field)| !field.is_empty()) {
            *coordinate = self.number(Some(field), "a coordinate")?;
        }
        self.nodes.add(number, at, self.draft).map_err(|problem| self.row.fail(problem))
    }

    /// Reads an element: its number and its nodes, with the lines that continue it.
    fn element(
        &mut self,
        line: &'s [u8],
        count: usize,
        kind: ElementKind,
        group: Option<usize>,
    ) -> Result<(), MeshError> {
        let mut nodes = Vec::with_capacity(count + 1);
        let mut line = line;
        loop {
            for field in fields(line).filter(|field| !field.is_empty()) {
                if nodes.len() <= count {
                    nodes.push(self.number::<i64>(Some(field), "a node of an element")?);
                }
            }
            if nodes.len() > count {
                break;
            }
            let missing = || format!("a part of an element of {count} nodes");
            line = self.next().ok_or_else(|| self.source.truncated(missing()))?;
            if line.starts_with(b"*") {
                return Err(self.row.syntax(format!("{} is missing", missing())));
            }
        }
        let nodes = &mut nodes[1..];
        let added = self.nodes.to_vertices(nodes, self.draft);
        let added = added.and_then(|()| self.draft.element(kind, nodes, group.as_slice()));
        added.map_err(|problem| self.row.fail(problem))
    }
}
