//! The displacements of a tissue at one moment, from which frames are made.
// The compiler does not always inline iterators over vectors. They then run without the caller's instructions.
#![allow(clippy::needless_range_loop)]

use std::sync::{Arc, OnceLock};

use super::refine::{Points, Refinement, grid};
use super::skin::Skin;
use super::wide::{Available, LANES, SixteenLanes, WideWork, Width};
use palpate_tissue::Cuts;
use palpate_tissue::scene::Scene;

/// The displacements of a tissue at one moment, in the order of a frame. All viewers' frames of that moment are made
/// from it; the bounding box is computed once, by the first.
#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    /// Number of steps done at its moment.
    pub step: u64,
    /// Simulated time, s.
    pub simulation_time_s: f64,
    /// The version of the topology ([`Cuts::version`]).
    pub topology_version: u32,
    /// The version of what is burnt ([`Burns::version`](palpate_tissue::Burns::version)).
    pub burn_version: u32,
    /// What is severed.
    cuts: Cuts,
    /// Displacements, m: x, y and z separate. Point [i, j] of a sheet is at i·ny + j; the vertices of a mesh are in
    /// the order of memory.
    displacement_m: [Vec<f32>; 3],
    /// The skin, if other vertices are shown than are simulated; and the displacements of those, computed at first
    /// use.
    skin: Option<Arc<Skin>>,
    shown_m: OnceLock<[Vec<f32>; 3]>,
    /// The same with the surface within cuts, for frames that have it.
    with_cut_surface_m: OnceLock<[Vec<f32>; 3]>,
    /// The least and the greatest value of each component, m, of frames without and with the surface within cuts, computed at first use.
    boxes_m: [OnceLock<[[f32; 2]; 3]>; 2],
    /// Number of points along x and y; of a mesh, rows and places per row.
    pub(super) points: [usize; 2],
    /// Distance between points, m; of a mesh, the usual length of an edge.
    pub(super) spacing_m: f64,
}

impl Snapshot {
    /// Creates a snapshot of the tissue of a scene after `step` steps. `displacement_m` has the x, y and z of the
    /// displacements, m, in three vectors with a value for each place of a frame: point [i, j] of a sheet at i·ny + j
    /// (`Tissue::shown_displacements_m`).
    pub fn new(scene: &Scene, step: u64, simulation_time_s: f64, displacement_m: [Vec<f32>; 3]) -> Self {
        let (points, spacing_m) = grid(scene);
        Snapshot {
            step,
            simulation_time_s,
            topology_version: 0,
            burn_version: 0,
            cuts: Cuts::default(),
            displacement_m,
            skin: None,
            shown_m: OnceLock::new(),
            with_cut_surface_m: OnceLock::new(),
            boxes_m: Default::default(),
            points,
            spacing_m,
        }
    }

    /// Returns this snapshot with the skin of a tissue on a mesh, which must be that of its model. If other vertices
    /// are shown than are simulated, the encoder computes their displacements; otherwise, and with `None`, the skin
    /// is ignored.
    #[must_use]
    pub fn with_skin(self, skin: Option<&Arc<Skin>>) -> Self {
        Snapshot { skin: skin.filter(|skin| skin.is_bound()).cloned(), ..self }
    }

    /// Returns this snapshot with what was severed at its moment.
    #[must_use]
    pub fn with_cuts(self, cuts: Cuts) -> Self {
        Snapshot { topology_version: cuts.version(), cuts, ..self }
    }

    /// Returns this snapshot with the version of what was burnt at its moment.
    #[must_use]
    pub fn with_burn_version(self, burn_version: u32) -> Self {
        Snapshot { burn_version, ..self }
    }

    /// Returns what was severed at its moment.
    pub fn cuts(&self) -> &Cuts {
        &self.cuts
    }

    /// Returns the displacements of the vertices that frames of `grid` show, m.
    pub(super) fn displacement_m(&self, grid: Refinement) -> &[Vec<f32>; 3] {
        let [rows, columns] = self.points;
        match &self.skin {
            None => &self.displacement_m,
            Some(skin) if self.is_with_cut_surface(grid) => self.with_cut_surface_m.get_or_init(|| {
                skin.displacement_with_cut_surface_m(&self.displacement_m, &self.cuts, grid.points[0] * columns)
            }),
            Some(skin) => {
                self.shown_m.get_or_init(|| skin.displacement_m(&self.displacement_m, &self.cuts, rows * columns))
            }
        }
    }

    /// Returns the bounding box of what frames of `grid` show. The thread that encodes computes it once for all encodings, not the stepping
    /// thread.
    pub(super) fn box_m(&self, grid: Refinement) -> &[[f32; 2]; 3] {
        self.boxes_m[usize::from(self.is_with_cut_surface(grid))]
            .get_or_init(|| self.displacement_m(grid).each_ref().map(|values| range(values)))
    }

    /// Returns all points that frames of `grid` show.
    pub(super) fn points(&self, grid: Refinement) -> Points<'_> {
        let values = self.displacement_m(grid).each_ref().map(Vec::as_slice);
        Points { values, stride: self.points[1], count: grid.points }
    }

    /// Returns the number of rows of frames of `grid` that may differ from 0: rows for the surface within cuts have no vertices at first.
    pub(super) fn used_rows(&self, grid: Refinement) -> usize {
        match &self.skin {
            Some(skin) if self.is_with_cut_surface(grid) => self.points[0] + skin.used_cut_rows(&self.cuts),
            _ => grid.points[0],
        }
    }

    /// Returns whether frames of `grid` have rows for the surface within cuts.
    fn is_with_cut_surface(&self, grid: Refinement) -> bool {
        grid.points[0] > self.points[0]
    }
}

/// Returns the least and the greatest of the values.
fn range(values: &[f32]) -> [f32; 2] {
    let mut range = [f32::INFINITY, f32::NEG_INFINITY];
    Width::widest().run(Range { values, range: &mut range });
    range
}

struct Range<'v> {
    values: &'v [f32],
    range: &'v mut [f32; 2],
}

impl WideWork for Range<'_> {
    #[inline(always)]
    fn work<L: SixteenLanes>(self, with: Available<L>) {
        // Enough parallel comparisons to hide their latency.
        const AT_ONCE: usize = 4;
        let mut low = [with.splat(f32::INFINITY); AT_ONCE];
        let mut high = [with.splat(f32::NEG_INFINITY); AT_ONCE];
        let (chunks, rest) = self.values.as_chunks::<{ AT_ONCE * LANES }>();
        for chunk in chunks {
            let (blocks, _) = chunk.as_chunks();
            for k in 0..AT_ONCE {
                let values = with.load(&blocks[k]);
                low[k] = values.smaller(low[k]);
                high[k] = values.larger(high[k]);
            }
        }
        let mut lanes = [[0.0; LANES]; 2 * AT_ONCE];
        for k in 0..AT_ONCE {
            low[k].store(&mut lanes[k]);
            high[k].store(&mut lanes[AT_ONCE + k]);
        }
        let (low, high) = lanes.as_flattened().split_at(AT_ONCE * LANES);
        *self.range = [
            low.iter().chain(rest).copied().fold(f32::INFINITY, f32::min),
            high.iter().chain(rest).copied().fold(f32::NEG_INFINITY, f32::max),
        ];
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_box_reaches_as_far_as_the_values() {
        for count in [1, 15, 16, 63, 64, 65, 1000] {
            let values: Vec<f32> = (0..count).map(|k| (k as f32 * 1.7).sin() + 0.1).collect();
            let least = values.iter().copied().fold(f32::INFINITY, f32::min);
            let greatest = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
            for width in Width::ALL.into_iter().filter(|width| width.is_available()) {
                let mut range = [f32::INFINITY, f32::NEG_INFINITY];
                width.run(Range { values: &values, range: &mut range });
                assert_eq!(range, [least, greatest], "{width:?}, {count}");
            }
        }
    }
}
