//! Where to look for springs that something crosses: the boxes around the tiles of a tissue.

use glam::DVec3;

use crate::body::model::Model;
use crate::kernel::field::{Layout, State};
use crate::kernel::real::Real;
use crate::kernel::region::{Marks, TILE, sides_of};

/// The boxes around the tiles of a tissue at rest, and the length of its longest spring: what a search for springs begins with.
#[derive(Debug)]
pub(crate) struct SpringSearch {
    /// The corners of the box around the points of each tile at rest, m; the first above the second in an empty tile.
    boxes: Vec<[DVec3; 2]>,
    longest_m: f64,
}

impl SpringSearch {
    /// Looks at all points of a model.
    pub(crate) fn of(model: &Model, layout: &Layout, tiles: usize) -> Self {
        let mut boxes = vec![[DVec3::INFINITY, DVec3::NEG_INFINITY]; tiles];
        let mut longest = 0.0_f64;
        for (tile, [least_m, most_m]) in boxes.iter_mut().enumerate() {
            for place in places_of(model, layout, tile) {
                let mut has_spring = false;
                model.each_spring(place, |spring| {
                    has_spring = true;
                    longest = longest.max(spring.rest.length());
                });
                if has_spring {
                    let rest_m = model.end_at_rest_m(place);
                    (*least_m, *most_m) = (least_m.min(rest_m), most_m.max(rest_m));
                }
            }
        }
        SpringSearch { boxes, longest_m: longest * model.unit_m }
    }

    /// Returns the length of the longest spring at rest, m.
    pub(crate) fn longest_m(&self) -> f64 {
        self.longest_m
    }

    /// Returns the corners of a box around the points of a tile, m; `moved` are the tiles whose points may not be at rest.
    pub(crate) fn tile_box_m<T: Real>(
        &self,
        model: &Model,
        layout: &Layout,
        state: &State<T>,
        moved: &Marks,
        tile: usize,
    ) -> [DVec3; 2] {
        let [low_m, high_m] = self.boxes[tile];
        if !moved.has[tile] {
            return [low_m, high_m];
        }
        let [rows, columns] = sides_of(layout, tile);
        // A lane for each column: only then does the compiler compare a row at once.
        #[allow(clippy::needless_range_loop)]
        let bounds = |c: usize| {
            let (mut low, mut high) = ([T::default(); TILE], [T::default(); TILE]);
            for i in rows.clone() {
                let row = &state.u[c * layout.plane + i * layout.stride..][columns.clone()];
                let (low, high) = (&mut low[..row.len()], &mut high[..row.len()]);
                // Not zipped: the compiler calls a function for each row then.
                for lane in 0..row.len() {
                    let value = row[lane];
                    low[lane] = if value < low[lane] { value } else { low[lane] };
                    high[lane] = if value > high[lane] { value } else { high[lane] };
                }
            }
            let low = low.iter().map(|value| value.wide()).fold(0.0, f64::min);
            [low, high.iter().map(|value| value.wide()).fold(0.0, f64::max)]
        };
        let [x, y, z] = [bounds(0), bounds(1), bounds(2)];
        [low_m + model.unit_m * DVec3::new(x[0], y[0], z[0]), high_m + model.unit_m * DVec3::new(x[1], y[1], z[1])]
    }
}

/// Returns the places of a tile.
fn places_of(model: &Model, layout: &Layout, tile: usize) -> impl Iterator<Item = usize> + use<> {
    let ([rows, columns], across) = (sides_of(layout, tile), model.points[1]);
    rows.flat_map(move |i| columns.clone().map(move |j| i * across + j))
}
