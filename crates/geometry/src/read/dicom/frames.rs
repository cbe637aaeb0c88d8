//! The voxels of a DICOM segmentation, frame by frame, as runs of labels.

use crate::Problem;
use crate::read::allowance::MemoryAllowance;
use crate::read::source::{Order, Scalar};
use crate::read::voxels::{LabelRun, LabelSource};
use crate::work::spend;

/// How voxels tell their label.
#[derive(Debug, Clone, Copy)]
pub(super) enum Values {
    /// A bit, whether the voxel is in the segment of the frame.
    Bits,
    /// A byte, which part of the voxel is in it, relative to the largest: from one half.
    Fractions(usize),
    /// The label itself.
    Labels(Scalar),
}

/// The voxels of frames, one after the other.
pub(super) struct Frames<'a> {
    /// Columns and rows.
    pub(super) sides: [usize; 2],
    pub(super) values: Values,
    /// The segment and the slice of each frame.
    pub(super) frames: Vec<(i64, usize)>,
    pub(super) pixels: &'a [u8],
}

impl Frames<'_> {
    /// Returns the label of a voxel by its number in the file.
    fn label(&self, segment: i64, number: usize) -> i64 {
        let byte = |at: usize| self.pixels.get(at).copied().unwrap_or(0);
        let is_in = match self.values {
            Values::Bits => byte(number / 8) >> (number % 8) & 1 == 1,
            Values::Fractions(largest) => 2 * usize::from(byte(number)) >= largest,
            Values::Labels(scalar) => {
                let at = number * scalar.size();
                return self.pixels.get(at..).map_or(0, |bytes| scalar.integer(bytes, Order::Little));
            }
        };
        if is_in { segment } else { 0 }
    }
}

impl LabelSource for Frames<'_> {
    fn runs(
        &self,
        _: &mut MemoryAllowance<'_>,
        visit: &mut dyn FnMut(LabelRun) -> Result<(), Problem>,
    ) -> Result<(), Problem> {
        let [columns, rows] = self.sides;
        let voxels = columns.saturating_mul(rows).saturating_mul(self.frames.len());
        let bytes = match self.values {
            Values::Bits => voxels.div_ceil(8),
            Values::Fractions(_) => voxels,
            Values::Labels(scalar) => voxels.saturating_mul(scalar.size()),
        };
        if self.pixels.len() < bytes {
            return Err(Problem::Truncated { missing: "a part of the voxels".to_owned() });
        }
        for (number, (segment, z)) in self.frames.iter().enumerate() {
            for y in 0..rows {
                spend(columns);
                let row = (number * rows + y) * columns;
                let mut x = 0;
                while x < columns {
                    let first = x;
                    let label = self.label(*segment, row + x);
                    while x < columns && self.label(*segment, row + x) == label {
                        x += 1;
                    }
                    if label != 0 {
                        visit((label, [first, y, *z], x - first))?;
                    }
                }
            }
        }
        Ok(())
    }
}
