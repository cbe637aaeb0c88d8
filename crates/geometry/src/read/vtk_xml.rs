//! VTK's XML formats `.vtp` and `.vtu`, with arrays as text, in base64 or appended, and compressed with zlib.
//!
//! `quick-xml` reads the XML as a stream of events, so nested elements use no stack; `miniz_oxide` decompresses with
//! a limit.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use quick_xml::Reader;
use quick_xml::events::{BytesStart, Event};

use super::allowance::MemoryAllowance;
use super::draft::Draft;
use super::source::{Order, Scalar, Source, no_number, parsed, shown};
use super::vtk::{Cells, Faces, is_region};
use crate::{Element, MeshError, Problem};

/// Limit for the arrays and for the pieces of a file. No real mesh has as many.
const MAX_ARRAYS: usize = 1 << 12;

/// Decompressed data counts towards the file size up to this number of bytes for each compressed byte.
const PACKED: usize = 4;

/// The arrays that describe the surface: section and name. The points may have any name, and arrays at cells those of [`is_region`].
const WANTED: [(&str, &str); 9] = [
    ("Points", ""),
    ("Polys", "connectivity"),
    ("Polys", "offsets"),
    ("Strips", "connectivity"),
    ("Strips", "offsets"),
    ("Cells", "connectivity"),
    ("Cells", "offsets"),
    ("Cells", "types"),
    ("CellData", ""),
];

/// The place of arrays at cells in [`WANTED`].
const OF_CELLS: usize = 8;

#[derive(Clone, Copy, PartialEq, Eq)]
enum ArrayFormat {
    Text,
    Base64,
    Appended,
}

struct Array {
    /// Index in `WANTED`.
    role: usize,
    name: String,
    scalar: Scalar,
    format: ArrayFormat,
    /// Position in the appended data.
    offset: usize,
    text: Vec<u8>,
    /// Position in the file where it begins, for error messages.
    byte: u64,
}

/// How the file encodes binary arrays.
struct Coding {
    order: Order,
    header: Scalar,
    is_compressed: bool,
    /// Whether the appended data is raw rather than base64.
    is_raw: bool,
}

fn attribute(element: &BytesStart<'_>, name: &str) -> Option<String> {
    let found = element.attributes().with_checks(false).flatten().find(|found| found.key.as_ref() == name)?;
    Some(found.value.into_owned())
}

/// Returns whether an array at cells numbers regions.
fn is_region_array(element: &BytesStart<'_>, name: &str) -> bool {
    let is_single = attribute(element, "NumberOfComponents").is_none_or(|count| count == "1" || count == "0");
    let kind = attribute(element, "type").unwrap_or_default();
    is_single && is_region(name) && scalar(&kind).is_some_and(Scalar::is_integer)
}

fn scalar(name: &str) -> Option<Scalar> {
    Some(match name {
        "Int8" => Scalar::I8,
        "UInt8" => Scalar::U8,
        "Int16" => Scalar::I16,
        "UInt16" => Scalar::U16,
        "Int32" => Scalar::I32,
        "UInt32" => Scalar::U32,
        "Int64" => Scalar::I64,
        "UInt64" => Scalar::U64,
        "Float32" => Scalar::F32,
        "Float64" => Scalar::F64,
        _ => return None,
    })
}

/// The arrays of the file, before they are decoded.
struct Document<'a> {
    file: &'a str,
    coding: Coding,
    /// The arrays of each piece.
    pieces: Vec<Vec<Array>>,
    appended: &'a [u8],
}

impl<'a> Document<'a> {
    fn parse(file: &'a str, bytes: &'a [u8]) -> Result<Self, MeshError> {
        let coding = Coding { order: Order::Little, header: Scalar::U32, is_compressed: false, is_raw: true };
        let mut document = Self { file, coding, pieces: Vec::new(), appended: &[] };
        let mut reader = Reader::from_reader(bytes);
        let mut section = String::new();
        // Whether the text of the last array follows.
        let mut is_open = false;
        let mut arrays = 0;
        let (mut has_begun, mut has_ended) = (false, false);
        loop {
            let byte = reader.buffer_position();
            let fail =
                |problem| MeshError { file: file.to_owned(), element: Element::Byte(byte), place_m: None, problem };
            let event = reader.read_event().map_err(|e| fail(Problem::Syntax { message: e.to_string() }))?;
            let is_empty = matches!(event, Event::Empty(_));
            match event {
                Event::Start(element) | Event::Empty(element) => {
                    is_open = false;
                    match element.name().as_ref() {
                        "VTKFile" => {
                            has_begun = true;
                            document.root(&element).map_err(fail)?;
                        }
                        "Piece" if document.pieces.len() < MAX_ARRAYS => document.pieces.push(Vec::new()),
                        "Piece" => return Err(fail(Problem::TooLarge { what: "pieces", limit: MAX_ARRAYS })),
                        "DataArray" => {
                            arrays += 1;
                            if arrays > MAX_ARRAYS {
                                return Err(fail(Problem::TooLarge { what: "arrays", limit: MAX_ARRAYS }));
                            }
                            let array = document.array(&element, &section, byte).map_err(fail)?;
                            if let Some((array, piece)) = array.zip(document.pieces.last_mut()) {
                                piece.push(array);
                                is_open = !is_empty;
                            }
                        }
                        "AppendedData" => {
                            document.coding.is_raw = attribute(&element, "encoding").as_deref() != Some("base64");
                            // The data that follows need not be valid XML.
                            let at = usize::try_from(reader.buffer_position()).unwrap_or(usize::MAX);
                            let rest = bytes.get(at..).unwrap_or_default();
                            let start = rest.iter().position(|byte| *byte == b'_').map_or(rest.len(), |at| at + 1);
                            document.appended = &rest[start..];
                            has_ended = true;
                        }
                        "InformationKey" => {}
                        name => section = shown(name.as_bytes()),
                    }
                }
                Event::Text(text) if is_open => {
                    if let Some(array) = document.pieces.last_mut().and_then(|piece| piece.last_mut()) {
                        array.text.extend_from_slice(text.as_bytes());
                    }
                }
                Event::End(element) => {
                    is_open &= element.name().as_ref() != "DataArray";
                    has_ended |= element.name().as_ref() == "VTKFile";
                }
                Event::Eof => break,
                _ => {}
            }
            if has_ended {
                break;
            }
        }
        let fail = |problem| MeshError { file: file.to_owned(), element: Element::Whole, place_m: None, problem };
        if !has_begun {
            return Err(fail(Problem::Syntax { message: "no VTKFile: this is other XML than VTK's".to_owned() }));
        }
        if !has_ended || document.pieces.is_empty() {
            return Err(fail(Problem::Truncated { missing: "`</VTKFile>`".to_owned() }));
        }
        Ok(document)
    }

    fn root(&mut self, element: &BytesStart<'_>) -> Result<(), Problem> {
        let unsupported = |message: String| Err(Problem::Unsupported { message });
        match attribute(element, "type").as_deref() {
            Some("PolyData" | "UnstructuredGrid") => {}
            other => {
                let other = shown(other.unwrap_or_default().as_bytes());
                return unsupported(format!(
                    "`{other}` is not read: save it as PolyData (.vtp) or UnstructuredGrid (.vtu)"
                ));
            }
        }
        if attribute(element, "byte_order").as_deref() == Some("BigEndian") {
            self.coding.order = Order::Big;
        }
        if attribute(element, "header_type").as_deref() == Some("UInt64") {
            self.coding.header = Scalar::U64;
        }
        match attribute(element, "compressor").as_deref() {
            None | Some("") => {}
            Some("vtkZLibDataCompressor") => self.coding.is_compressed = true,
            Some(other) => {
                let other = shown(other.as_bytes());
                return unsupported(format!("compressed by {other}: save it with zlib or without compression"));
            }
        }
        Ok(())
    }

    /// Returns an array if it is part of the surface.
    fn array(&self, element: &BytesStart<'_>, section: &str, byte: u64) -> Result<Option<Array>, Problem> {
        let name = attribute(element, "Name").unwrap_or_default();
        let is_wanted = |wanted: &(&str, &str)| wanted.0 == section && (wanted.1.is_empty() || wanted.1 == name);
        let Some(role) = WANTED.iter().position(is_wanted) else { return Ok(None) };
        if role == OF_CELLS && !is_region_array(element, &name) {
            return Ok(None);
        }
        let syntax = |message: String| Problem::Syntax { message };
        let kind = attribute(element, "type").unwrap_or_default();
        let scalar =
            scalar(&kind).ok_or_else(|| syntax(format!("`{}` is not a type of an array", shown(kind.as_bytes()))))?;
        let format = match attribute(element, "format").as_deref() {
            None | Some("ascii") => ArrayFormat::Text,
            Some("binary") => ArrayFormat::Base64,
            Some("appended") => ArrayFormat::Appended,
            Some(other) => return Err(syntax(format!("`{}` is not a format of an array", shown(other.as_bytes())))),
        };
        let offset = attribute(element, "offset").and_then(|offset| offset.parse().ok()).unwrap_or(0);
        Ok(Some(Array { role, name, scalar, format, offset, text: Vec::new(), byte }))
    }

    fn fail(&self, array: &Array, problem: Problem) -> MeshError {
        MeshError { file: self.file.to_owned(), element: Element::Byte(array.byte), place_m: None, problem }
    }

    /// Returns the bytes of a binary array. Their memory is taken from `allowance`; the caller gives it back.
    fn bytes(&self, array: &Array, allowance: &mut MemoryAllowance<'_>) -> Result<Vec<u8>, MeshError> {
        let fail = |problem| self.fail(array, problem);
        let text: Vec<u8> = array.text.iter().copied().filter(|byte| !byte.is_ascii_whitespace()).collect();
        let (stored, is_base64) = match array.format {
            ArrayFormat::Appended => (self.appended.get(array.offset..).unwrap_or_default(), !self.coding.is_raw),
            _ => (text.as_slice(), true),
        };
        let mut stored = Stored { bytes: stored, is_base64 };
        let Coding { order, header, is_compressed, .. } = self.coding;
        let width = header.size();
        let size = |bytes: &[u8]| usize::try_from(header.integer(bytes, order)).unwrap_or(usize::MAX);
        if !is_compressed {
            // The length and the data are encoded together.
            let length = size(&stored.peek(width).map_err(fail)?);
            allowance.take(length).map_err(fail)?;
            let mut bytes = stored.take(width + length).map_err(fail)?;
            bytes.drain(..width);
            return Ok(bytes);
        }
        // Number of blocks, block size, size of the last block if it differs, and the compressed size of each block;
        // then the blocks.
        let start = stored.peek(3 * width).map_err(fail)?;
        let blocks = size(&start);
        let length = blocks.checked_add(3).and_then(|words| words.checked_mul(width)).unwrap_or(usize::MAX);
        let sizes = stored.take(length).map_err(fail)?;
        let packed: Vec<usize> = sizes[3 * width..].chunks_exact(width).map(size).collect();
        let all = packed.iter().try_fold(0_usize, |sum, size| sum.checked_add(*size)).unwrap_or(usize::MAX);
        let stored_bytes = length.saturating_add(all).saturating_mul(2);
        allowance.take(stored_bytes).map_err(fail)?;
        let data = stored.take(all).map_err(fail)?;
        // Not more is decompressed than the header states.
        let (block_bytes, last_bytes) = (size(&start[width..]), size(&start[2 * width..]));
        let last_bytes = if last_bytes == 0 { block_bytes } else { last_bytes };
        let promised = block_bytes.saturating_mul(blocks.saturating_sub(1)).saturating_add(last_bytes);
        let promised = if blocks == 0 { 0 } else { promised };
        // A compressed file counts as a few times its size.
        allowance.add_file(promised.min(all.saturating_mul(PACKED)));
        allowance.take(promised).map_err(fail)?;
        let (mut rest, mut bytes) = (data.as_slice(), Vec::with_capacity(promised));
        for (number, size) in packed.into_iter().enumerate() {
            let most = if number + 1 == blocks { last_bytes } else { block_bytes };
            allowance.take(2 * most).map_err(fail)?;
            let (block, after) = rest.split_at_checked(size).unwrap_or((rest, &[]));
            let unpacked = miniz_oxide::inflate::decompress_to_vec_zlib_with_limit(block, most).map_err(|e| {
                let is_large = e.status == miniz_oxide::inflate::TINFLStatus::HasMoreOutput;
                let message =
                    if is_large { "a block larger than its header says" } else { "a block that zlib can't unpack" };
                fail(Problem::Syntax { message: message.to_owned() })
            })?;
            allowance.give_back(2 * most);
            bytes.extend_from_slice(&unpacked);
            rest = after;
        }
        allowance.give_back(stored_bytes);
        Ok(bytes)
    }

    fn text<T: std::str::FromStr>(
        &self,
        array: &Array,
        allowance: &mut MemoryAllowance<'_>,
    ) -> Result<Vec<T>, MeshError> {
        let mut source = Source::new(self.file, &array.text);
        let mut numbers = Vec::new();
        while let Some(word) = source.word() {
            let what = format!("number {} of an array", numbers.len());
            let number = parsed(word).ok_or_else(|| self.fail(array, no_number(word, &what)))?;
            allowance.push(&mut numbers, number).map_err(|problem| self.fail(array, problem))?;
        }
        Ok(numbers)
    }

    /// Returns the numbers of an array. Their memory is taken from `allowance`; the caller gives it back.
    fn numbers<T: std::str::FromStr>(
        &self,
        array: &Array,
        allowance: &mut MemoryAllowance<'_>,
        number: fn(Scalar, &[u8], Order) -> T,
    ) -> Result<Vec<T>, MeshError> {
        if array.format == ArrayFormat::Text {
            return self.text(array, allowance);
        }
        let (bytes, size) = (self.bytes(array, allowance)?, array.scalar.size());
        let memory = allowance.take(bytes.len() / size * size_of::<T>());
        memory.map_err(|problem| self.fail(array, problem))?;
        let numbers = bytes.chunks_exact(size).map(|bytes| number(array.scalar, bytes, self.coding.order)).collect();
        allowance.give_back(bytes.len());
        Ok(numbers)
    }
}

/// Bytes that are stored raw or in base64.
struct Stored<'a> {
    bytes: &'a [u8],
    is_base64: bool,
}

impl Stored<'_> {
    /// Returns the first `count` bytes, and how many stored bytes they take up.
    fn first(&self, count: usize) -> Result<(Vec<u8>, usize), Problem> {
        let missing = || Problem::Truncated { missing: format!("a part of {count} bytes of an array") };
        let taken = if self.is_base64 { count.div_ceil(3).checked_mul(4) } else { Some(count) };
        let stored = taken.and_then(|taken| self.bytes.get(..taken)).ok_or_else(missing)?;
        let mut bytes = if self.is_base64 {
            STANDARD.decode(stored).map_err(|e| Problem::Syntax { message: format!("an array is not base64: {e}") })?
        } else {
            stored.to_vec()
        };
        if bytes.len() < count {
            return Err(missing());
        }
        bytes.truncate(count);
        Ok((bytes, stored.len()))
    }

    /// Returns the first `count` bytes; further bytes may be encoded together with them.
    fn peek(&self, count: usize) -> Result<Vec<u8>, Problem> {
        Ok(self.first(count)?.0)
    }

    /// Removes and returns the first `count` bytes, which are encoded separately.
    fn take(&mut self, count: usize) -> Result<Vec<u8>, Problem> {
        let (bytes, taken) = self.first(count)?;
        self.bytes = &self.bytes[taken..];
        Ok(bytes)
    }
}

pub(super) fn read(file: &str, bytes: &[u8], draft: &mut Draft<'_>) -> Result<(), MeshError> {
    let document = Document::parse(file, bytes)?;
    for piece in &document.pieces {
        let first = draft.vertices();
        let find = |role: usize| piece.iter().find(|array| array.role == role);
        if let Some(array) = find(0) {
            let reals = document.numbers(array, &mut draft.allowance, Scalar::real)?;
            for (number, at) in reals.chunks_exact(3).enumerate() {
                draft.vertex([at[0], at[1], at[2]]).map_err(|problem| MeshError {
                    file: file.to_owned(),
                    element: Element::Vertex(u32::try_from(first + number).unwrap_or(u32::MAX)),
                    place_m: None,
                    problem,
                })?;
            }
            draft.allowance.give_back(size_of_val(reals.as_slice()));
        }
        let mut integers = |role: usize| -> Result<Vec<i64>, MeshError> {
            find(role)
                .map_or_else(|| Ok(Vec::new()), |array| document.numbers(array, &mut draft.allowance, Scalar::integer))
        };
        let polygons = Cells { connectivity: integers(1)?, ends: integers(2)? };
        let strips = Cells { connectivity: integers(3)?, ends: integers(4)? };
        let grid = Cells { connectivity: integers(5)?, ends: integers(6)? };
        let types = integers(7)?;
        // What can't be read is ignored, as other values at cells are.
        let regions = find(OF_CELLS).map(|array| array.name.clone()).zip(integers(OF_CELLS).ok());
        let faces = Faces { polygons, strips, grid, types, regions };
        faces.add(file, first, draft)?;
        draft.allowance.give_back(faces.bytes());
    }
    Ok(())
}
