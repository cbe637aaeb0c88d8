//! DICOM segmentations (`.dcm`): frames of bits, or of bytes, each with its segment and its place.
//!
//! No crate is used: `dicom-object` keeps all elements of a file, and is not bounded.

mod frames;

use glam::{DMat3, DVec3};

use super::allowance::MemoryAllowance;
use super::label_map::LabelMap;
use super::source::{Order, Scalar, parsed, words};
use super::voxels::MAX_SIDE;
use crate::{Element, MeshError, Problem, Unit};
use frames::{Frames, Values};

/// Length of the part before the first element, which ends with the word `DICM`.
const PREAMBLE: usize = 132;

/// Most sequences within each other.
const MAX_DEPTH: usize = 16;

/// A length that is not said.
const UNDEFINED: usize = 0xffff_ffff;

/// Largest distance of a frame from its place in a regular stack, as a part of a voxel.
const OFF: f64 = 0.1;

/// Memory for putting a frame into the stack, bytes.
const FRAME: usize = 64;

// Tags: group and element.
const TRANSFER_SYNTAX: u32 = 0x0002_0010;
const SLICE_THICKNESS: u32 = 0x0018_0050;
const SLICE_SPACING: u32 = 0x0018_0088;
const POSITION: u32 = 0x0020_0032;
const ORIENTATION: u32 = 0x0020_0037;
const FRAMES: u32 = 0x0028_0008;
const ROWS: u32 = 0x0028_0010;
const COLUMNS: u32 = 0x0028_0011;
const PIXEL_SPACING: u32 = 0x0028_0030;
const BITS: u32 = 0x0028_0100;
const KIND: u32 = 0x0062_0001;
const FRAME_SEGMENT: u32 = 0x0062_000b;
const LARGEST_FRACTION: u32 = 0x0062_000e;
const OF_ALL_FRAMES: u32 = 0x5200_9229;
const OF_EACH_FRAME: u32 = 0x5200_9230;
const PIXELS: u32 = 0x7fe0_0010;
const ITEM: u32 = 0xfffe_e000;
const END_OF_ITEM: u32 = 0xfffe_e00d;
const END_OF_SEQUENCE: u32 = 0xfffe_e0dd;

/// Sequences that files without types (implicit VR) give with a length.
const SEQUENCES: [u32; 6] = [0x0020_9113, 0x0020_9116, 0x0028_9110, 0x0062_000a, OF_ALL_FRAMES, OF_EACH_FRAME];

/// Elements of the image as a whole. Others of the same tags are those of an icon or of an image that is referred to.
const OF_IMAGE: [u32; 7] = [FRAMES, ROWS, COLUMNS, BITS, KIND, LARGEST_FRACTION, PIXELS];

/// A frame: its segment, and the middle of its first voxel.
#[derive(Debug, Clone, Copy, Default)]
struct Frame {
    segment: i64,
    position: Option<DVec3>,
}

/// What is read of a file.
#[derive(Default)]
struct Segmentation<'a> {
    kind: Vec<u8>,
    rows: usize,
    columns: usize,
    count: usize,
    bits: usize,
    largest: usize,
    /// Distances between rows and between columns.
    spacing: Option<[f64; 2]>,
    slices: Option<f64>,
    thickness: Option<f64>,
    /// Directions along a row and along a column.
    directions: Option<[DVec3; 2]>,
    frames: Vec<Frame>,
    pixels: Option<&'a [u8]>,
}

/// Returns whether the content is a DICOM file.
pub(super) fn is_dicom(bytes: &[u8]) -> bool {
    bytes.get(128..PREAMBLE) == Some(b"DICM")
}

/// Reads all but the voxels.
pub(super) fn read<'a>(
    name: &str,
    bytes: &'a [u8],
    allowance: &mut MemoryAllowance<'_>,
) -> Result<LabelMap<'a>, MeshError> {
    let mut reader = Elements { bytes, at: PREAMBLE, has_types: true, is_of_frames: false, allowance };
    let mut found = Segmentation::default();
    let read = reader.data_set(bytes.len(), 0, &mut found);
    let at = Element::Byte(reader.at as u64);
    let fail = |element, problem| MeshError { file: name.to_owned(), element, place_m: None, problem };
    read.map_err(|problem| fail(at, problem))?;
    allowance.take(FRAME * found.frames.len()).map_err(|problem| fail(Element::Whole, problem))?;
    found.map().map_err(|problem| fail(Element::Whole, problem))
}

/// The elements of a file.
struct Elements<'a, 'b, 'l> {
    bytes: &'a [u8],
    at: usize,
    /// Whether elements have types (explicit VR).
    has_types: bool,
    /// Whether the outermost sequence tells of frames.
    is_of_frames: bool,
    allowance: &'b mut MemoryAllowance<'l>,
}

impl<'a> Elements<'a, '_, '_> {
    fn take(&mut self, count: usize) -> Result<&'a [u8], Problem> {
        let missing = || Problem::Truncated { missing: "a part of an element".to_owned() };
        let end = self.at.checked_add(count).ok_or_else(missing)?;
        let taken = self.bytes.get(self.at..end).ok_or_else(missing)?;
        self.at = end;
        Ok(taken)
    }

    fn number(&mut self, scalar: Scalar) -> Result<usize, Problem> {
        let bytes = self.take(scalar.size())?;
        Ok(usize::try_from(scalar.integer(bytes, Order::Little)).unwrap_or(0))
    }

    #[allow(clippy::cast_possible_truncation)]
    fn tag(&mut self) -> Result<u32, Problem> {
        let group = self.number(Scalar::U16)?;
        Ok((group << 16 | self.number(Scalar::U16)?) as u32)
    }

    /// Reads the elements up to a place or the end of an item.
    fn data_set(&mut self, end: usize, depth: usize, found: &mut Segmentation<'a>) -> Result<(), Problem> {
        let mut has_types_next = self.has_types;
        while self.at < end {
            let start = self.at;
            let tag = self.tag()?;
            // The first group always has types; its end decides about the others.
            if depth == 0 && tag >> 16 != 2 && self.has_types && !has_types_next {
                self.has_types = false;
            }
            let has_own_types = self.has_types && tag >> 16 != 0xfffe;
            let mut is_sequence = SEQUENCES.contains(&tag);
            let length = if has_own_types {
                let kind = self.take(2)?;
                is_sequence = kind == b"SQ";
                if [b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"SV", b"UC", b"UN", b"UR", b"UT", b"UV"]
                    .iter()
                    .any(|long| kind == *long)
                {
                    self.take(2)?;
                    self.number(Scalar::U32)?
                } else {
                    self.number(Scalar::U16)?
                }
            } else {
                self.number(Scalar::U32)?
            };
            if tag == END_OF_ITEM || tag == END_OF_SEQUENCE {
                return Ok(());
            }
            if tag == PIXELS && length == UNDEFINED {
                let message = "compressed voxels are not read: save the segmentation uncompressed".to_owned();
                return Err(Problem::Unsupported { message });
            }
            if is_sequence || length == UNDEFINED {
                let end = if length == UNDEFINED { self.bytes.len() } else { self.at.saturating_add(length).min(end) };
                self.sequence(tag, end, depth + 1, found)?;
            } else {
                let value = self.take(length)?;
                if tag == TRANSFER_SYNTAX {
                    has_types_next = has_types(value)?;
                }
                if depth == 0 || self.is_of_frames && !OF_IMAGE.contains(&tag) {
                    found.element(tag, value)?;
                }
            }
            debug_assert!(self.at > start);
        }
        Ok(())
    }

    /// Reads the items of a sequence up to a place or its end.
    fn sequence(&mut self, tag: u32, end: usize, depth: usize, found: &mut Segmentation<'a>) -> Result<(), Problem> {
        if depth > MAX_DEPTH {
            return Err(Problem::Syntax { message: format!("more than {MAX_DEPTH} sequences within each other") });
        }
        if depth == 1 {
            self.is_of_frames = tag == OF_ALL_FRAMES || tag == OF_EACH_FRAME;
        }
        while self.at < end {
            let item = self.tag()?;
            let length = self.number(Scalar::U32)?;
            if item == END_OF_SEQUENCE {
                return Ok(());
            }
            if item != ITEM {
                return Err(Problem::Syntax { message: "an item of a sequence is expected".to_owned() });
            }
            if tag == OF_EACH_FRAME && depth == 1 {
                self.allowance.push(&mut found.frames, Frame::default())?;
            }
            let end = if length == UNDEFINED { end } else { self.at.saturating_add(length).min(end) };
            self.data_set(end, depth, found)?;
        }
        Ok(())
    }
}

/// Returns whether a transfer syntax has types at its elements.
fn has_types(syntax: &[u8]) -> Result<bool, Problem> {
    let end = syntax.iter().rposition(|byte| *byte != 0 && *byte != b' ').map_or(0, |last| last + 1);
    match &syntax[..end] {
        b"1.2.840.10008.1.2" => Ok(false),
        b"1.2.840.10008.1.2.1" => Ok(true),
        other => {
            let name = super::source::shown(other);
            let message = format!("the transfer syntax {name} is not read: save uncompressed, little endian");
            Err(Problem::Unsupported { message })
        }
    }
}

/// Returns numbers in text, with backslashes between them; `None` for an element without a value.
fn numbers<const N: usize>(text: &[u8]) -> Result<Option<[f64; N]>, Problem> {
    let text = text.strip_suffix(b"\0").unwrap_or(text).trim_ascii();
    if text.is_empty() {
        return Ok(None);
    }
    let parts = text.split(|byte| *byte == b'\\').take(N + 1);
    let number = |part: &[u8]| parsed(part.trim_ascii()).filter(|number: &f64| number.is_finite());
    let found: Option<Vec<f64>> = parts.map(number).collect();
    let found = found.and_then(|found| found.try_into().ok());
    let bad =
        || Problem::Syntax { message: format!("`{}` where numbers are expected: {N}", super::source::shown(text)) };
    found.ok_or_else(bad).map(Some)
}

impl<'a> Segmentation<'a> {
    /// Takes an element that matters. One of a frame goes to the last frame.
    fn element(&mut self, tag: u32, value: &'a [u8]) -> Result<(), Problem> {
        let whole = || usize::try_from(Scalar::U16.integer(value, Order::Little)).unwrap_or(0);
        match tag {
            KIND => self.kind = value.trim_ascii_end().to_owned(),
            ROWS => self.rows = whole(),
            COLUMNS => self.columns = whole(),
            FRAMES => self.count = words(value).next().and_then(parsed).unwrap_or(0),
            BITS => self.bits = whole(),
            LARGEST_FRACTION => self.largest = whole(),
            PIXEL_SPACING => self.spacing = self.spacing.or(numbers(value)?),
            SLICE_SPACING => self.slices = self.slices.or(numbers(value)?.map(|[spacing]| spacing)),
            SLICE_THICKNESS => self.thickness = self.thickness.or(numbers(value)?.map(|[thickness]| thickness)),
            ORIENTATION => {
                let directions = numbers(value)?.map(|[a, b, c, d, e, f]| [DVec3::new(a, b, c), DVec3::new(d, e, f)]);
                self.directions = self.directions.or(directions);
            }
            POSITION => {
                if let Some(frame) = self.frames.last_mut() {
                    frame.position = numbers(value)?.map(DVec3::from_array);
                }
            }
            FRAME_SEGMENT => {
                if let Some(frame) = self.frames.last_mut() {
                    frame.segment = Scalar::U16.integer(value, Order::Little);
                }
            }
            PIXELS => self.pixels = Some(value),
            _ => {}
        }
        Ok(())
    }

    /// Puts the frames into a regular stack.
    fn map(self) -> Result<LabelMap<'a>, Problem> {
        let missing =
            |what: &str| Problem::Syntax { message: format!("this is no DICOM segmentation: it has no {what}") };
        let unsupported = |message: String| Err(Problem::Unsupported { message });
        if self.kind.is_empty() {
            return Err(missing("segmentation type"));
        }
        let pixels = self.pixels.ok_or_else(|| missing("voxels"))?;
        let [along_column, along_row] = self.spacing.ok_or_else(|| missing("spacing of voxels"))?;
        let [x, y] = self.directions.ok_or_else(|| missing("direction of slices"))?;
        let values = match (&self.kind[..], self.bits) {
            (b"BINARY", 1) => Values::Bits,
            (b"FRACTIONAL", 8) => Values::Fractions(self.largest.max(1)),
            (b"LABELMAP", 8) => Values::Labels(Scalar::U8),
            (b"LABELMAP", 16) => Values::Labels(Scalar::U16),
            (kind, bits) => {
                let kind = super::source::shown(kind);
                return unsupported(format!("a segmentation of the type {kind} with {bits} bits is not read"));
            }
        };
        let sides = [self.columns, self.rows];
        if sides.iter().any(|side| !(1..=MAX_SIDE).contains(side)) || self.frames.len() != self.count {
            return Err(missing("frame for each of its places"));
        }
        let normal = x.cross(y).normalize_or_zero();
        let heights: Option<Vec<f64>> =
            self.frames.iter().map(|frame| frame.position.map(|position| position.dot(normal))).collect();
        let mut sorted = heights.clone().ok_or_else(|| missing("position for each frame"))?;
        sorted.sort_by(f64::total_cmp);
        let least = *sorted.first().ok_or_else(|| missing("frames"))?;
        let gap = |spacing: f64, pair: &[f64]| {
            let gap = pair[1] - pair[0];
            if gap > OFF * along_row.min(along_column) { spacing.min(gap) } else { spacing }
        };
        // A gap may be of several slices that are empty.
        let nearest = sorted.windows(2).fold(f64::INFINITY, gap);
        let spacing = self.slices.or(nearest.is_finite().then_some(nearest)).or(self.thickness);
        let spacing = spacing.filter(|spacing| *spacing > 0.0).ok_or_else(|| missing("distance of slices"))?;
        let axes = DMat3::from_cols(x * along_row, y * along_column, normal * spacing);
        let first = self.frames.iter().zip(heights.iter().flatten()).find(|(_, height)| **height == least);
        let origin = first.and_then(|(frame, _)| frame.position).ok_or_else(|| missing("first slice"))?;
        let mut frames = Vec::with_capacity(self.frames.len());
        for frame in &self.frames {
            let at = axes.inverse() * (frame.position.unwrap_or(origin) - origin);
            let off = at - DVec3::new(0.0, 0.0, at.z.round());
            if !(off.abs().max_element() < OFF && at.z < MAX_SIDE as f64) {
                return unsupported("frames that are shifted, or unevenly apart, are not read".to_owned());
            }
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
            frames.push((frame.segment, at.z.round() as usize));
        }
        // Frames of labels are of all segments.
        let mut places = frames.clone();
        if let Values::Labels(_) = values {
            places.iter_mut().for_each(|(segment, _)| *segment = 0);
        }
        places.sort_unstable();
        if places.windows(2).any(|pair| pair[0] == pair[1]) {
            return unsupported("two frames of one segment at one place are not read".to_owned());
        }
        let voxels = Frames { sides, values, frames, pixels };
        Ok(LabelMap { voxels: Box::new(voxels), axes, origin, unit: Some(Unit::MILLIMETRE) })
    }
}
