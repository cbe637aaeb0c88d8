//! Gmsh, formats 1, 2 and 4.1, text and binary; physical names and numbers become groups.
//!
//! No crate is used: only `mshio` reads Gmsh, only format 4.1, and it ends the program on unknown data.

use std::collections::BTreeMap;

use super::draft::Draft;
use super::nodes::{ElementKind, NumberedNodes};
use super::source::{Order, Scalar, Source, named, parsed, shown};
use super::volume::Cell;
use crate::{MeshError, Problem};

/// Maximum number of physical tags used per entity.
const PHYSICAL: usize = 16;

/// Returns an element type of Gmsh: the number of its nodes (corners first), its dimension and its kind.
fn element_type(number: i64) -> Option<(usize, i64, ElementKind)> {
    use Cell::{Hexahedron, Prism, Pyramid, Tetrahedron};
    Some(match number {
        15 => (1, 0, ElementKind::Line),
        1 => (2, 1, ElementKind::Line),
        8 => (3, 1, ElementKind::Line),
        26 => (4, 1, ElementKind::Line),
        27 => (5, 1, ElementKind::Line),
        28 => (6, 1, ElementKind::Line),
        // Curved elements have more nodes, up to the fifth order.
        2 => (3, 2, ElementKind::Face(3)),
        9 => (6, 2, ElementKind::Face(3)),
        20 => (9, 2, ElementKind::Face(3)),
        21 => (10, 2, ElementKind::Face(3)),
        22 => (12, 2, ElementKind::Face(3)),
        23 => (15, 2, ElementKind::Face(3)),
        24 => (15, 2, ElementKind::Face(3)),
        25 => (21, 2, ElementKind::Face(3)),
        3 => (4, 2, ElementKind::Face(4)),
        10 => (9, 2, ElementKind::Face(4)),
        16 => (8, 2, ElementKind::Face(4)),
        36 => (16, 2, ElementKind::Face(4)),
        37 => (25, 2, ElementKind::Face(4)),
        38 => (36, 2, ElementKind::Face(4)),
        39 => (12, 2, ElementKind::Face(4)),
        4 => (4, 3, ElementKind::Cell(Tetrahedron)),
        11 => (10, 3, ElementKind::Cell(Tetrahedron)),
        29 => (20, 3, ElementKind::Cell(Tetrahedron)),
        30 => (35, 3, ElementKind::Cell(Tetrahedron)),
        31 => (56, 3, ElementKind::Cell(Tetrahedron)),
        5 => (8, 3, ElementKind::Cell(Hexahedron)),
        12 => (27, 3, ElementKind::Cell(Hexahedron)),
        17 => (20, 3, ElementKind::Cell(Hexahedron)),
        92 => (64, 3, ElementKind::Cell(Hexahedron)),
        93 => (125, 3, ElementKind::Cell(Hexahedron)),
        6 => (6, 3, ElementKind::Cell(Prism)),
        13 => (18, 3, ElementKind::Cell(Prism)),
        18 => (15, 3, ElementKind::Cell(Prism)),
        90 => (40, 3, ElementKind::Cell(Prism)),
        91 => (75, 3, ElementKind::Cell(Prism)),
        7 => (5, 3, ElementKind::Cell(Pyramid)),
        14 => (14, 3, ElementKind::Cell(Pyramid)),
        19 => (13, 3, ElementKind::Cell(Pyramid)),
        118 => (30, 3, ElementKind::Cell(Pyramid)),
        119 => (55, 3, ElementKind::Cell(Pyramid)),
        _ => return None,
    })
}

/// A file that is being read.
struct GmshFile<'s, 'd, 'l> {
    source: Source<'s>,
    draft: &'d mut Draft<'l>,
    /// Byte order of binary files.
    order: Option<Order>,
    /// The type of counts and tags in a binary file of format 4.1.
    size: Scalar,
    nodes: NumberedNodes,
    /// Names by dimension and physical tag.
    names: BTreeMap<(i64, i64), String>,
    /// The physical tags of the entities of format 4.1, by dimension and tag.
    physical: BTreeMap<(i64, i64), Vec<i64>>,
}

pub(super) fn read(source: Source<'_>, draft: &mut Draft<'_>) -> Result<(), MeshError> {
    let mut file = GmshFile {
        source,
        draft,
        order: None,
        size: Scalar::U64,
        nodes: NumberedNodes::default(),
        names: BTreeMap::new(),
        physical: BTreeMap::new(),
    };
    // An element in several physical groups occurs once for each of them.
    file.draft.drops_repeated = true;
    let mut version = 1.0;
    let (mut has_nodes, mut has_elements) = (false, false);
    while let Some(word) = file.source.word() {
        match word {
            b"$MeshFormat" => version = file.format()?,
            b"$PhysicalNames" => file.physical_names()?,
            b"$Entities" if version >= 4.0 => file.entities()?,
            b"$NOD" | b"$Nodes" => {
                has_nodes = true;
                if version >= 4.0 { file.node_blocks()? } else { file.node_list()? }
            }
            b"$ELM" | b"$Elements" => {
                has_elements = true;
                match (file.order, version) {
                    (_, 4.0..) => file.element_blocks()?,
                    (Some(order), _) => file.element_records(order)?,
                    (None, _) => file.element_list(version)?,
                }
            }
            _ if word.starts_with(b"$End") || word.starts_with(b"$END") => {}
            _ if word.starts_with(b"$") => {
                // An unused section, such as one of results: it is skipped up to its end.
                let end = [b"$End".as_slice(), &word[1..]].concat();
                let rest = file.source.rest();
                let at = rest.windows(end.len()).position(|bytes| bytes == end);
                let Some(at) = at else { break };
                file.source.take(at, "the end of a section")?;
            }
            _ => {
                return Err(file.source.syntax(format!("`{}`: a section such as $Nodes is expected", shown(word))));
            }
        }
    }
    if !has_nodes || !has_elements {
        return Err(file.source.truncated("the section of nodes or of elements"));
    }
    Ok(())
}

impl GmshFile<'_, '_, '_> {
    /// Reads the line of the version, and whether the file is binary.
    fn format(&mut self) -> Result<f64, MeshError> {
        let version: f64 = self.source.number("the version")?;
        let kind: i64 = self.source.number("0 or 1, whether the file is binary")?;
        let size: i64 = self.source.number("the size of numbers")?;
        if (4.0..4.1).contains(&version) || version >= 5.0 {
            let message = format!("format {version} of Gmsh is not read: save the mesh as version 4.1 or 2 (ASCII)");
            return Err(self.source.fail(Problem::Unsupported { message }));
        }
        if kind == 1 {
            self.size = if size == 4 { Scalar::U32 } else { Scalar::U64 };
            self.source.line();
            let one = self.source.take(4, "the number 1 in binary")?;
            self.order = Some(if one[0] == 1 { Order::Little } else { Order::Big });
        }
        Ok(version)
    }

    /// Goes to the first byte of a section: binary data starts on the next line.
    fn begin_section(&mut self) {
        if self.order.is_some() {
            self.source.line();
        }
        self.source.is_binary = self.order.is_some();
    }

    /// Reads a number that is an `int` in binary files.
    fn int(&mut self, what: &str) -> Result<i64, MeshError> {
        self.integer(Scalar::I32, what)
    }

    fn integer(&mut self, scalar: Scalar, what: &str) -> Result<i64, MeshError> {
        match self.order {
            None => self.source.number(what),
            Some(order) => self.source.integer(scalar, order, what),
        }
    }

    /// Reads a number that is a `size_t` in binary files.
    fn tag(&mut self, what: &str) -> Result<i64, MeshError> {
        self.integer(self.size, what)
    }

    /// Reads a count of records, each of at least `bytes` bytes in binary files and `numbers` numbers in text.
    fn count(&mut self, scalar: Scalar, numbers: usize, bytes: usize, what: &str) -> Result<usize, MeshError> {
        let count = self.integer(scalar, what)?;
        self.source.count(count, if self.order.is_some() { bytes } else { 2 * numbers }, what)
    }

    fn place(&mut self) -> Result<[f64; 3], MeshError> {
        let mut at = [0.0; 3];
        for coordinate in &mut at {
            *coordinate = match self.order {
                None => self.source.number("a coordinate")?,
                Some(order) => self.source.real(Scalar::F64, order, "a coordinate")?,
            };
        }
        Ok(at)
    }

    fn physical_names(&mut self) -> Result<(), MeshError> {
        // Text also in binary files.
        let count: i64 = self.source.number("the count of names")?;
        let count = self.source.count(count, 6, "names")?;
        self.source.line();
        for _ in 0..count {
            let line = self.source.line().ok_or_else(|| self.source.truncated("a physical name"))?;
            let mut parts = line.splitn(2, |byte| *byte == b'"');
            let numbers = parts.next().unwrap_or_default();
            let numbers: Vec<i64> = numbers.split(u8::is_ascii_whitespace).filter_map(parsed).collect();
            let name = parts.next().map(|name| named(name.trim_ascii_end().strip_suffix(b"\"").unwrap_or(name)));
            let ([dimension, tag], Some(name)) = (numbers.as_slice(), name) else {
                return Err(self.source.syntax("a physical name is written so: 2 17 \"name\""));
            };
            self.names.insert((*dimension, *tag), name);
        }
        Ok(())
    }

    fn entities(&mut self) -> Result<(), MeshError> {
        self.begin_section();
        let mut counts = [0; 4];
        for count in &mut counts {
            *count = self.tag("a count of entities")?;
        }
        for (dimension, count) in (0..).zip(counts) {
            let count = self.source.count(count, 8, "entities")?;
            for _ in 0..count {
                let tag = self.int("the tag of an entity")?;
                for _ in 0..if dimension == 0 { 1 } else { 2 } {
                    self.place()?;
                }
                let tags = self.count(self.size, 1, 4, "physical tags")?;
                let mut physical = Vec::new();
                for _ in 0..tags {
                    // Negative if the entity faces the other way.
                    physical.push(self.int("a physical tag")?.saturating_abs());
                }
                physical.sort_unstable();
                physical.dedup();
                physical.truncate(PHYSICAL);
                if !physical.is_empty() {
                    self.physical.insert((dimension, tag), physical);
                }
                if dimension > 0 {
                    for _ in 0..self.count(self.size, 1, 4, "bounding entities")? {
                        self.int("a bounding entity")?;
                    }
                }
            }
        }
        self.source.is_binary = false;
        Ok(())
    }

    fn node(&mut self, tag: i64, at: [f64; 3]) -> Result<(), MeshError> {
        self.nodes.add(tag, at, self.draft).map_err(|problem| self.source.fail(problem))
    }

    /// Reads the nodes of formats 1 and 2.
    fn node_list(&mut self) -> Result<(), MeshError> {
        // The count is text also in binary files.
        let count: i64 = self.source.number("the count of nodes")?;
        self.begin_section();
        let count = self.source.count(count, if self.order.is_some() { 28 } else { 8 }, "nodes")?;
        for _ in 0..count {
            let tag = self.int("the number of a node")?;
            let at = self.place()?;
            self.node(tag, at)?;
        }
        self.source.is_binary = false;
        Ok(())
    }

    /// Reads the nodes of format 4.1.
    fn node_blocks(&mut self) -> Result<(), MeshError> {
        self.begin_section();
        let blocks = self.count(self.size, 4, 12, "blocks of nodes")?;
        for what in ["the count of nodes", "the least tag", "the largest tag"] {
            self.tag(what)?;
        }
        for _ in 0..blocks {
            let dimension = self.int("the dimension of an entity")?;
            self.int("the tag of an entity")?;
            let is_parametric = self.int("0 or 1, whether nodes have parameters")? != 0;
            let count = self.count(self.size, 4, 28, "nodes")?;
            let mut tags = Vec::new();
            for _ in 0..count {
                let tag = self.tag("the tag of a node")?;
                self.draft.allowance.push(&mut tags, tag).map_err(|problem| self.source.fail(problem))?;
            }
            let parameters = if is_parametric { dimension.clamp(0, 3) } else { 0 };
            for tag in tags {
                let at = self.place()?;
                for _ in 0..parameters {
                    match self.order {
                        None => self.source.number::<f64>("a parameter")?,
                        Some(order) => self.source.real(Scalar::F64, order, "a parameter")?,
                    };
                }
                self.node(tag, at)?;
            }
        }
        self.source.is_binary = false;
        Ok(())
    }

    fn kind_of(&self, number: i64) -> Result<(usize, i64, ElementKind), MeshError> {
        let message = || format!("elements of type {number} are not read: export triangles or tetrahedra");
        element_type(number).ok_or_else(|| self.source.fail(Problem::Unsupported { message: message() }))
    }

    /// Adds an element with nodes by their tags, to the groups of its physical tags.
    fn element(
        &mut self,
        (_, dimension, kind): (usize, i64, ElementKind),
        tags: &mut [i64],
        physical: &[i64],
    ) -> Result<(), MeshError> {
        self.nodes.to_vertices(tags, self.draft).map_err(|problem| self.source.fail(problem))?;
        let mut groups = Vec::new();
        for tag in physical {
            let name = self.names.get(&(dimension, *tag)).cloned().unwrap_or_else(|| format!("physical {tag}"));
            groups.push(self.draft.group(&name).map_err(|problem| self.source.fail(problem))?);
        }
        self.draft.element(kind, tags, &groups).map_err(|problem| self.source.fail(problem))
    }

    fn node_tags(&mut self, count: usize, scalar: Scalar) -> Result<Vec<i64>, MeshError> {
        (0..count).map(|_| self.integer(scalar, "a node of an element")).collect()
    }

    /// Reads the elements of formats 1 and 2 in text.
    fn element_list(&mut self, version: f64) -> Result<(), MeshError> {
        let count: i64 = self.source.number("the count of elements")?;
        let count = self.source.count(count, 8, "elements")?;
        for _ in 0..count {
            self.int("the number of an element")?;
            let number = self.int("the type of an element")?;
            let kind = self.kind_of(number)?;
            let (physical, nodes) = if version < 2.0 {
                let physical = self.int("the physical number of an element")?;
                self.int("the elementary number of an element")?;
                (physical, self.count(Scalar::I32, 1, 4, "nodes of an element")?)
            } else {
                let tags = self.count(Scalar::I32, 1, 4, "tags of an element")?;
                let tags = (0..tags).map(|_| self.int("a tag of an element")).collect::<Result<Vec<_>, _>>()?;
                (tags.first().copied().unwrap_or(0), kind.0)
            };
            if nodes != kind.0 {
                return Err(self.source.syntax(format!("an element of type {number} with {nodes} nodes")));
            }
            let mut tags = self.node_tags(nodes, Scalar::I32)?;
            self.element(kind, &mut tags, if physical > 0 { std::slice::from_ref(&physical) } else { &[] })?;
        }
        Ok(())
    }

    /// Reads the elements of format 2 in binary.
    fn element_records(&mut self, order: Order) -> Result<(), MeshError> {
        let count: i64 = self.source.number("the count of elements")?;
        self.begin_section();
        let mut left = self.source.count(count, 8, "elements")?;
        while left > 0 {
            let number = self.source.integer(Scalar::I32, order, "the type of elements")?;
            let kind = self.kind_of(number)?;
            let follow = self.source.integer(Scalar::I32, order, "a count of elements")?;
            let tags = self.source.integer(Scalar::I32, order, "a count of tags")?;
            let tags = self.source.count(tags, 4, "tags of an element")?;
            let follow = self.source.count(follow, 4 * (1 + tags + kind.0), "elements")?;
            if follow == 0 || follow > left {
                return Err(self.source.syntax("a block with another count of elements than the section"));
            }
            left -= follow;
            for _ in 0..follow {
                let mut record = self.node_tags(1 + tags + kind.0, Scalar::I32)?;
                let physical = if tags > 0 { record[1] } else { 0 };
                let physical = if physical > 0 { vec![physical] } else { Vec::new() };
                self.element(kind, &mut record[1 + tags..], &physical)?;
            }
        }
        self.source.is_binary = false;
        Ok(())
    }

    /// Reads the elements of format 4.1.
    fn element_blocks(&mut self) -> Result<(), MeshError> {
        self.begin_section();
        let blocks = self.count(self.size, 4, 12, "blocks of elements")?;
        for what in ["the count of elements", "the least tag", "the largest tag"] {
            self.tag(what)?;
        }
        for _ in 0..blocks {
            let dimension = self.int("the dimension of an entity")?;
            let entity = self.int("the tag of an entity")?;
            let number = self.int("the type of elements")?;
            let kind = self.kind_of(number)?;
            let count = self.count(self.size, 1 + kind.0, self.size.size() * (1 + kind.0), "elements")?;
            let physical = self.physical.get(&(dimension, entity)).cloned().unwrap_or_default();
            for _ in 0..count {
                self.tag("the tag of an element")?;
                let mut tags = self.node_tags(kind.0, self.size)?;
                self.element(kind, &mut tags, &physical)?;
            }
        }
        self.source.is_binary = false;
        Ok(())
    }
}
