//! The voxels of a label map, read as runs of one label, from plain or gzip-compressed bytes. Nothing is kept of them, so
//! that a small file can't take the memory of what it unpacks to.

use miniz_oxide::inflate::stream::{InflateState, inflate};
use miniz_oxide::{DataFormat, MZError, MZFlush, MZStatus};

use super::allowance::MemoryAllowance;
use super::source::{Order, Scalar};
use crate::Problem;
use crate::work::spend;

/// Memory for unpacking, bytes: the state with its window.
const STATE: usize = 1 << 16;

/// Bytes that are skipped at once. A row may have only one.
const SKIPPED: usize = 1 << 14;

/// Longest row of voxels.
pub(super) const MAX_SIDE: usize = 1 << 16;

/// Most bytes that a file may unpack to: a scan of 1024 × 1024 × 1024 voxels of two bytes.
const MAX_BYTES: usize = 1 << 31;

/// The voxels of a file: their arrangement, and where they are.
pub(super) struct Voxels<'a> {
    /// Number along each axis, the fastest first; each from 1 to [`MAX_SIDE`].
    pub(super) sides: [usize; 3],
    pub(super) scalar: Scalar,
    pub(super) order: Order,
    /// A label is the number in the file times the first, plus the second, rounded.
    pub(super) scale: [f64; 2],
    /// The file from the compressed part on.
    pub(super) bytes: &'a [u8],
    pub(super) is_gzip: bool,
    /// Unpacked bytes before the first voxel.
    pub(super) skip: usize,
}

/// Neighbouring voxels of a row with the same label: the label, the first voxel, and their number.
pub(super) type LabelRun = (i64, [usize; 3], usize);

/// The labels of a file.
pub(super) trait LabelSource {
    /// Calls `visit` with the runs of each label other than 0, in the order of the file. Refuses a file that ends early.
    fn runs(
        &self,
        allowance: &mut MemoryAllowance<'_>,
        visit: &mut dyn FnMut(LabelRun) -> Result<(), Problem>,
    ) -> Result<(), Problem>;
}

impl Voxels<'_> {
    /// Checks the sides.
    fn check(&self) -> Result<(), Problem> {
        if self.sides.iter().any(|side| !(1..=MAX_SIDE).contains(side)) {
            let message = format!("{:?} voxels: each side has from 1 to {MAX_SIDE}", self.sides);
            return Err(Problem::Syntax { message });
        }
        let bytes = self.sides.iter().product::<usize>().saturating_mul(self.scalar.size());
        if bytes.saturating_add(self.skip) > MAX_BYTES {
            return Err(Problem::TooLarge { what: "bytes of voxels", limit: MAX_BYTES });
        }
        Ok(())
    }

    fn label(&self, voxel: &[u8]) -> i64 {
        let [factor, offset] = self.scale;
        if self.scalar.is_integer() && factor == 1.0 && offset == 0.0 {
            return self.scalar.integer(voxel, self.order);
        }
        // What is not a number becomes 0, the outside.
        #[allow(clippy::cast_possible_truncation)]
        let label = (self.scalar.real(voxel, self.order) * factor + offset).round() as i64;
        label
    }
}

impl LabelSource for Voxels<'_> {
    fn runs(
        &self,
        allowance: &mut MemoryAllowance<'_>,
        visit: &mut dyn FnMut(LabelRun) -> Result<(), Problem>,
    ) -> Result<(), Problem> {
        self.check()?;
        let size = self.scalar.size();
        let [row_voxels, rows, slices] = self.sides;
        let memory = STATE + (row_voxels * size).max(SKIPPED);
        allowance.take(memory)?;
        let mut source = Unpacked::new(self.bytes, self.is_gzip)?;
        let mut row = vec![0; (row_voxels * size).max(SKIPPED)];
        let mut left = self.skip;
        while left > 0 {
            let part = left.min(row.len());
            source.fill(&mut row[..part])?;
            left -= part;
        }
        row.truncate(row_voxels * size);
        for z in 0..slices {
            for y in 0..rows {
                source.fill(&mut row)?;
                spend(row_voxels);
                let mut first = 0;
                for (x, voxel) in row.chunks_exact(size).enumerate() {
                    let is_last = x + 1 == row_voxels || row[(x + 1) * size..(x + 2) * size] != *voxel;
                    if is_last {
                        let label = self.label(voxel);
                        if label != 0 {
                            visit((label, [first, y, z], x + 1 - first))?;
                        }
                        first = x + 1;
                    }
                }
            }
        }
        allowance.give_back(memory);
        Ok(())
    }
}

/// Bytes that are plain or compressed by gzip.
pub(super) struct Unpacked<'a> {
    rest: &'a [u8],
    /// The state of unpacking; `None` for plain bytes.
    state: Option<Box<InflateState>>,
}

impl<'a> Unpacked<'a> {
    pub(super) fn new(bytes: &'a [u8], is_gzip: bool) -> Result<Self, Problem> {
        let mut unpacked = Unpacked { rest: bytes, state: None };
        if is_gzip {
            unpacked.member()?;
        }
        Ok(unpacked)
    }

    /// Begins a member of a gzip file (RFC 1952), behind its header.
    fn member(&mut self) -> Result<(), Problem> {
        let bad = || Problem::Syntax { message: "what should be gzip is not".to_owned() };
        let head = self.rest.get(..10).ok_or_else(bad)?;
        if head[..3] != [0x1f, 0x8b, 8] {
            return Err(bad());
        }
        let (flags, mut rest) = (head[3], &self.rest[10..]);
        if flags & 4 != 0 {
            let length = Scalar::U16.integer(rest.get(..2).ok_or_else(bad)?, Order::Little);
            rest = rest.get(2 + usize::try_from(length).unwrap_or(0)..).ok_or_else(bad)?;
        }
        // A name and a comment, each ended by a NUL.
        for _ in 0..(flags >> 3 & 1) + (flags >> 4 & 1) {
            let end = rest.iter().position(|byte| *byte == 0).ok_or_else(bad)?;
            rest = &rest[end + 1..];
        }
        if flags & 2 != 0 {
            rest = rest.get(2..).ok_or_else(bad)?;
        }
        self.rest = rest;
        self.state = Some(InflateState::new_boxed(DataFormat::Raw));
        Ok(())
    }

    /// Fills `bytes` with the next ones.
    pub(super) fn fill(&mut self, bytes: &mut [u8]) -> Result<(), Problem> {
        let truncated = || Problem::Truncated { missing: "a part of the voxels".to_owned() };
        let mut at = 0;
        while at < bytes.len() {
            let Some(state) = &mut self.state else {
                let (own, rest) = self.rest.split_at_checked(bytes.len()).ok_or_else(truncated)?;
                bytes.copy_from_slice(own);
                self.rest = rest;
                return Ok(());
            };
            let step = inflate(state, self.rest, &mut bytes[at..], MZFlush::None);
            self.rest = &self.rest[step.bytes_consumed..];
            at += step.bytes_written;
            match step.status {
                Ok(MZStatus::Ok) if step.bytes_consumed + step.bytes_written > 0 => {}
                // The next member follows the sum and the length of this one.
                Ok(MZStatus::StreamEnd) if at < bytes.len() => {
                    self.rest = self.rest.get(8..).filter(|rest| !rest.is_empty()).ok_or_else(truncated)?;
                    self.member()?;
                }
                Ok(MZStatus::StreamEnd) => {}
                Err(MZError::Buf) | Ok(_) => return Err(truncated()),
                Err(_) => return Err(Problem::Syntax { message: "gzip can't unpack the voxels".to_owned() }),
            }
        }
        Ok(())
    }
}
