//! A label of a scan as a closed surface: the voxels that have it, counted in cells, smoothed, and bounded.

use std::collections::BTreeMap;

use glam::{DMat3, DVec3};

use super::draft::Draft;
use super::smooth_surface::{self, PartGrid};
use super::voxels::{LabelRun, LabelSource};
use crate::{Problem, Unit};

/// More different numbers than this are those of an image.
const MAX_LABELS: usize = 4096;

/// Memory for a label while all are found, bytes.
const LABEL: usize = 128;

/// Number of labels that a refusal lists.
const LISTED: usize = 20;

/// About how many vertices a surface gets: voxels are counted in cells of several if it would get more.
const VERTICES: usize = 50_000;

/// Most cells around a label.
const MAX_CELLS: usize = 1 << 22;

/// The edges of a voxel differ by less than this, and its volume is not less than that of a box by more.
const MAX_RATIO: f64 = 1e3;

/// Empty cells beside those of the label, at each end of each axis.
const MARGIN: usize = 3;

/// A label map: its voxels, and where they are in space.
pub(super) struct LabelMap<'a> {
    pub(super) voxels: Box<dyn LabelSource + 'a>,
    /// The step from a voxel to the next along each axis, in the file's unit.
    pub(super) axes: DMat3,
    /// The middle of the first voxel.
    pub(super) origin: DVec3,
    /// The unit that the file says.
    pub(super) unit: Option<Unit>,
}

/// The voxels of a label: the box around them, and their number.
#[derive(Debug, Clone, Copy)]
struct Extent {
    least: [usize; 3],
    most: [usize; 3],
    voxels: usize,
}

impl LabelMap<'_> {
    /// Adds the surface around a label; `None` means the only one.
    pub(super) fn surface(&self, label: Option<i64>, draft: &mut Draft<'_>) -> Result<(), Problem> {
        let volume = self.axes.determinant().abs();
        let lengths = [0, 1, 2].map(|axis| self.axes.col(axis).length());
        let (shortest, longest) =
            (lengths.into_iter().fold(f64::INFINITY, f64::min), lengths.into_iter().fold(0.0, f64::max));
        let is_even = longest < MAX_RATIO * shortest && volume * MAX_RATIO > lengths.iter().product();
        if !(is_even && volume > 0.0 && volume.is_finite() && self.origin.is_finite()) {
            let message =
                "the axes of the voxels are not finite, in one plane, or of very different lengths".to_owned();
            return Err(Problem::Syntax { message });
        }
        let (label, extent) = self.extent(label, draft)?;
        let cell = cell_of(extent, self.axes);
        let grid = self.parts(label, extent, cell, draft)?;
        let surface = smooth_surface::of(grid, draft)?;
        // Cell (0, 0, 0) has its middle at the corner of the box plus half a cell, without the margin.
        let corner = DVec3::from_array(extent.least.map(|at| at as f64 - 0.5));
        let size = DVec3::from_array(cell.map(|voxels| voxels as f64));
        let place = |at: DVec3| self.origin + self.axes * (corner + (at - MARGIN as f64) * size);
        let mut vertices: Vec<DVec3> = surface.vertices.iter().map(|at| place(*at)).collect();
        let mut triangles = surface.triangles;
        if self.axes.determinant() < 0.0 {
            triangles.iter_mut().for_each(|triangle| triangle.swap(1, 2));
        }
        smooth_surface::even_out(&mut vertices, &triangles);
        smooth_surface::fit_volume(&mut vertices, &triangles, volume * extent.voxels as f64);
        vertices.iter().try_for_each(|at| draft.vertex(at.to_array()))?;
        triangles.iter().try_for_each(|triangle| draft.polygon(&triangle.map(i64::from), &[], &[]))?;
        let voxels = extent.voxels;
        draft.notes.push(format!("The mesh is the surface around the label {label}. Voxels: {voxels}."));
        if cell != [1; 3] {
            let [x, y, z] = cell;
            draft.notes.push(format!("Voxels were counted in cells of {x} × {y} × {z}."));
        }
        Ok(())
    }

    /// Returns a label and where it is.
    fn extent(&self, label: Option<i64>, draft: &mut Draft<'_>) -> Result<(i64, Extent), Problem> {
        draft.allowance.take(MAX_LABELS * LABEL)?;
        let mut labels: BTreeMap<i64, Extent> = BTreeMap::new();
        self.voxels.runs(&mut draft.allowance, &mut |(label, first, count): LabelRun| {
            if labels.len() >= MAX_LABELS && !labels.contains_key(&label) {
                let message = format!("more than {MAX_LABELS} different numbers: this is an image, not a label map");
                return Err(Problem::Unsupported { message });
            }
            let new = Extent { least: first, most: first, voxels: 0 };
            let extent = labels.entry(label).or_insert(new);
            let last = [first[0] + count - 1, first[1], first[2]];
            for axis in 0..3 {
                extent.least[axis] = extent.least[axis].min(first[axis]);
                extent.most[axis] = extent.most[axis].max(last[axis]);
            }
            extent.voxels += count;
            Ok(())
        })?;
        let mut listed: Vec<String> = labels.keys().take(LISTED).map(i64::to_string).collect();
        if labels.len() > LISTED {
            listed.push(format!("… ({} in all)", labels.len()));
        }
        let listed = listed.join(", ");
        match (label, labels.first_key_value()) {
            (_, None) => Err(Problem::Unsupported { message: "all voxels are 0: there is no label".to_owned() }),
            (None, Some((label, extent))) if labels.len() == 1 => Ok((*label, *extent)),
            (None, Some(_)) => Err(Problem::LabelMissing { labels: listed }),
            (Some(label), Some(_)) => {
                let unknown =
                    || Problem::LabelUnknown { message: format!("no voxel has the label {label}: there are {listed}") };
                labels.get(&label).map(|extent| (label, *extent)).ok_or_else(unknown)
            }
        }
    }

    /// Returns the part of each cell that has the label.
    fn parts(&self, wanted: i64, extent: Extent, cell: [usize; 3], draft: &mut Draft<'_>) -> Result<PartGrid, Problem> {
        let cells = cells(extent, cell);
        let sides = cells.map(|cells| cells + 2 * MARGIN);
        draft.allowance.add_room(smooth_surface::MEMORY * sides.iter().product::<usize>());
        draft.allowance.take(smooth_surface::MEMORY * sides.iter().product::<usize>())?;
        let mut parts = vec![0.0_f32; sides.iter().product()];
        #[allow(clippy::cast_precision_loss)]
        let one = 1.0 / cell.iter().product::<usize>() as f32;
        self.voxels.runs(&mut draft.allowance, &mut |(label, first, count): LabelRun| {
            if label == wanted {
                let [x, y, z] = [0, 1, 2].map(|axis| first[axis] - extent.least[axis]);
                let row = ((z / cell[2] + MARGIN) * sides[1] + y / cell[1] + MARGIN) * sides[0] + MARGIN;
                for x in x..x + count {
                    parts[row + x / cell[0]] += one;
                }
            }
            Ok(())
        })?;
        let size = [0, 1, 2].map(|axis| self.axes.col(axis).length() * cell[axis] as f64);
        Ok(PartGrid { sides, parts, size })
    }
}

/// Returns the number of cells along each axis of the box around a label.
fn cells(extent: Extent, cell: [usize; 3]) -> [usize; 3] {
    [0, 1, 2].map(|axis| (extent.most[axis] - extent.least[axis]) / cell[axis] + 1)
}

/// Returns the number of voxels along each side of a cell: so many that the surface of the box around the label has no more
/// faces of cells than [`VERTICES`]. The shortest side grows first.
fn cell_of(extent: Extent, axes: DMat3) -> [usize; 3] {
    let mut cell = [1; 3];
    loop {
        let [x, y, z] = cells(extent, cell);
        let all = (x + 2 * MARGIN) * (y + 2 * MARGIN) * (z + 2 * MARGIN);
        if 2 * (x * y + y * z + z * x) <= VERTICES && all <= MAX_CELLS {
            return cell;
        }
        let length = |axis: &usize| axes.col(*axis).length() * cell[*axis] as f64;
        let has_more = |axis: &usize| cells(extent, cell)[*axis] > 1;
        let shortest = (0..3).filter(has_more).min_by(|a, b| length(a).total_cmp(&length(b)));
        let Some(shortest) = shortest else { return cell };
        cell[shortest] += 1;
    }
}
