//! Where to look for springs that something crosses: the boxes around the tiles of a tissue.
#![allow(unsafe_code)]

use std::cell::RefCell;
use std::ops::Range;

use glam::DVec3;

use crate::body::model::Model;
use crate::body::tables::SweepTables;
use crate::kernel::field::{Layout, State};
use crate::kernel::lanes::{self, Run, Vector};
use crate::kernel::real::Real;
use crate::kernel::region::{Marks, TILE, sides_of};

/// The part of a gap that a displacement must be to close it: rounding closes none unseen.
const NEARLY: f64 = 1.0 - 1e-5;

/// The boxes around the tiles of a tissue at rest, and the length of its longest spring: what a search for springs begins with.
#[derive(Debug)]
pub(crate) struct SpringSearch {
    /// The corners of the box around the points of each tile at rest, m; the first above the second in an empty tile.
    boxes: Vec<[DVec3; 2]>,
    /// The same of each row of each tile.
    row_boxes: Vec<[[DVec3; 2]; TILE]>,
    longest_m: f64,
}

impl SpringSearch {
    /// Looks at all points of a model.
    pub(crate) fn of(model: &Model, layout: &Layout, tiles: usize) -> Self {
        const EMPTY: [DVec3; 2] = [DVec3::INFINITY, DVec3::NEG_INFINITY];
        let join = |[low_m, high_m]: [DVec3; 2], [other_low_m, other_high_m]: [DVec3; 2]| {
            [low_m.min(other_low_m), high_m.max(other_high_m)]
        };
        let mut row_boxes = vec![[EMPTY; TILE]; tiles];
        let (mut longest, across) = (0.0_f64, model.points[1]);
        for (tile, boxes) in row_boxes.iter_mut().enumerate() {
            let [rows, columns] = sides_of(layout, tile);
            for (row, around) in rows.zip(boxes) {
                for place in columns.clone().map(|column| row * across + column) {
                    let mut has_spring = false;
                    model.each_spring(place, |spring| {
                        has_spring = true;
                        longest = longest.max(spring.rest.length());
                    });
                    if has_spring {
                        *around = join(*around, [model.end_at_rest_m(place); 2]);
                    }
                }
            }
        }
        let boxes = row_boxes.iter().map(|rows| rows.iter().copied().fold(EMPTY, join)).collect();
        SpringSearch { boxes, row_boxes, longest_m: longest * model.unit_m }
    }

    /// Returns the length of the longest spring at rest, m.
    pub(crate) fn longest_m(&self) -> f64 {
        self.longest_m
    }

    /// Returns the tiles whose boxes touch that between two corners, m, ascending; `moved` are the tiles whose points may not be at rest. A
    /// box counts from that at rest, and grows by displacements.
    pub(crate) fn near<T: Real>(
        &self,
        model: &Model,
        tables: &SweepTables<T>,
        state: &State<T>,
        moved: &Marks,
        within_m: [DVec3; 2],
    ) -> Vec<NearTile> {
        let (layout, found) = (&tables.layout, RefCell::default());
        assert!(state.u.len() >= 3 * layout.plane);
        let near = Near { search: self, unit_m: model.unit_m, layout, u: &state.u, moved, within_m, found };
        // SAFETY: the field has the layout's three planes, and the tiles are those of the layout.
        unsafe { lanes::run(tables.width, &near) };
        near.found.into_inner()
    }

    /// Returns the rows of a tile, each with its columns, whose boxes touch that between two corners, m, as those of tiles do in
    /// [`SpringSearch::near`].
    pub(crate) fn rows_near(
        &self,
        model: &Model,
        layout: &Layout,
        NearTile { tile, displaced }: NearTile,
        [least_m, most_m]: [DVec3; 2],
    ) -> impl Iterator<Item = (usize, Range<usize>)> {
        let [down_m, up_m] = displaced.map(|displaced| model.unit_m * displaced);
        let [rows, columns] = sides_of(layout, tile);
        rows.zip(&self.row_boxes[tile]).filter_map(move |(row, [low_m, high_m])| {
            let touches = (*high_m + up_m).cmpge(least_m) & (*low_m + down_m).cmple(most_m);
            touches.all().then(|| (row, columns.clone()))
        })
    }
}

/// A tile near a box.
#[derive(Debug, Clone, Copy)]
pub(crate) struct NearTile {
    pub(crate) tile: usize,
    /// The least and the greatest displacement of its points along each axis, in units of the model, both with 0.
    pub(crate) displaced: [DVec3; 2],
}

/// The search for the tiles near a box.
struct Near<'a, T> {
    search: &'a SpringSearch,
    unit_m: f64,
    layout: &'a Layout,
    u: &'a [T],
    moved: &'a Marks,
    within_m: [DVec3; 2],
    found: RefCell<Vec<NearTile>>,
}

impl<T: Real> Run<T> for Near<'_, T> {
    #[inline(always)]
    unsafe fn run<V: Vector<Real = T>>(&self) {
        let Near { search, unit_m, layout, u, moved, within_m: [least_m, most_m], found } = self;
        let mut near = found.borrow_mut();
        for (tile, [low_m, high_m]) in search.boxes.iter().enumerate() {
            let (below, above) = (high_m.cmplt(*least_m), low_m.cmpgt(*most_m));
            let mut displaced = [DVec3::ZERO; 2];
            if !moved.has[tile] {
                if !(below | above).any() {
                    near.push(NearTile { tile, displaced });
                }
                continue;
            }
            let sides = sides_of(layout, tile);
            let mut touches = true;
            // No closures: they would not get the instructions of their caller.
            // Most tiles are far, along an axis along which the boxes are apart at rest.
            for c in 0..3 {
                if touches && (below | above).test(c) {
                    let gap_m = if below.test(c) { least_m[c] - high_m[c] } else { most_m[c] - low_m[c] };
                    let gap = NEARLY * gap_m / unit_m;
                    // SAFETY: the caller's promise.
                    touches = unsafe { any_beyond::<V>(layout, &u[c * layout.plane..], &sides, gap) };
                }
            }
            for c in 0..3 {
                if !touches {
                    break;
                }
                // SAFETY: the caller's promise.
                let [least, most] = unsafe { range::<V>(layout, &u[c * layout.plane..], &sides) };
                (displaced[0][c], displaced[1][c]) = (least.wide(), most.wide());
                touches = high_m[c] + unit_m * displaced[1][c] >= least_m[c]
                    && low_m[c] + unit_m * displaced[0][c] <= most_m[c];
            }
            if touches {
                near.push(NearTile { tile, displaced });
            }
        }
    }
}

/// Returns whether a value in a tile of a plane is beyond a number, away from 0. Padding counts as in [`range`].
///
/// # Safety
/// As that of [`range`].
#[inline(always)]
unsafe fn any_beyond<V: Vector>(
    layout: &Layout,
    plane: &[V::Real],
    [rows, columns]: &[Range<usize>; 2],
    number: f64,
) -> bool {
    let is_above = number > 0.0;
    // SAFETY: the caller's promise; a row has the padding of a whole tile.
    unsafe {
        let (bound, mut farthest) = (V::of(V::Real::of(number)), V::of(V::Real::default()));
        for i in rows.clone() {
            let row = plane.as_ptr().add(i * layout.stride + columns.start);
            for part in 0..TILE / V::LANES {
                let values = V::load(row.add(part * V::LANES));
                farthest = if is_above { values.larger(farthest) } else { values.smaller(farthest) };
            }
        }
        V::any(if is_above { farthest.above(bound) } else { bound.above(farthest) })
    }
}

/// Returns the least and the largest value in a tile of a plane, both with 0. Rows are padded to whole tiles: what is there may widen the
/// range.
///
/// # Safety
/// The processor has the instructions, and the tile is one of the layout, which the plane has.
#[inline(always)]
unsafe fn range<V: Vector>(layout: &Layout, plane: &[V::Real], [rows, columns]: &[Range<usize>; 2]) -> [V::Real; 2] {
    let zero = V::Real::default();
    let mut ends = [[zero; TILE]; 2];
    // SAFETY: the caller's promise; a row has the padding of a whole tile.
    unsafe {
        let (mut least, mut most) = (V::of(zero), V::of(zero));
        for i in rows.clone() {
            let row = plane.as_ptr().add(i * layout.stride + columns.start);
            for part in 0..TILE / V::LANES {
                let values = V::load(row.add(part * V::LANES));
                least = values.smaller(least);
                most = values.larger(most);
            }
        }
        least.store(ends[0].as_mut_ptr());
        most.store(ends[1].as_mut_ptr());
    }
    let (mut low, mut high) = (zero, zero);
    for (least, most) in ends[0].into_iter().zip(ends[1]) {
        low = if least < low { least } else { low };
        high = if most > high { most } else { high };
    }
    [low, high]
}
