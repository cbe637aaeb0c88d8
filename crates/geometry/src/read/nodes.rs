//! The numbered nodes of a volume mesh, and elements that name them.

use std::collections::HashMap;

use super::draft::Draft;
use super::volume::Cell;
use crate::Problem;

/// The kind of an element, with its corners.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ElementKind {
    /// A point or line, which is not part of a surface.
    Line,
    Face(usize),
    Cell(Cell),
}

/// Vertices by the numbers of their nodes.
#[derive(Default)]
pub(super) struct NumberedNodes {
    // Used for lookups only, so its order does not matter.
    vertex_of: HashMap<i64, i64>,
}

impl NumberedNodes {
    /// Adds a node as the next vertex.
    pub(super) fn add(&mut self, number: i64, at: [f64; 3], draft: &mut Draft<'_>) -> Result<(), Problem> {
        let vertex = draft.vertices() as i64;
        // Memory in a growing hash table.
        draft.allowance.take(2 * size_of::<(i64, i64)>() + 2)?;
        if self.vertex_of.insert(number, vertex).is_some() {
            return Err(Problem::Syntax { message: format!("node {number} is there twice") });
        }
        draft.vertex(at)
    }

    /// Replaces the numbers of nodes by those of their vertices.
    pub(super) fn to_vertices(&self, nodes: &mut [i64], draft: &Draft<'_>) -> Result<(), Problem> {
        for node in nodes {
            let found = self.vertex_of.get(node);
            *node = *found.ok_or(Problem::IndexOutOfRange { index: *node, vertices: draft.vertices() })?;
        }
        Ok(())
    }
}

impl Draft<'_> {
    /// Adds an element by its vertices, corners first, to groups. Further nodes of curved ones are ignored.
    pub(super) fn element(&mut self, kind: ElementKind, vertices: &[i64], groups: &[usize]) -> Result<(), Problem> {
        match kind {
            ElementKind::Line => {
                self.lines += 1;
                self.assign(vertices, groups)
            }
            ElementKind::Face(corners) => {
                self.drops_unused |= vertices.len() > corners;
                self.polygon(&vertices[..corners.min(vertices.len())], &[], groups)
            }
            ElementKind::Cell(cell) => self.cell(cell, vertices, groups),
        }
    }
}
