//! Measures how much memory a message takes once it is decoded, and how many fields it has, by walking over its bytes
//! before anything is allocated. The limits of requests, responses, journals and data from etcd all use this.
//!
//! An entry of two bytes may become a message of hundreds in memory. The contents of fields of type `bytes` or
//! `string` are not parsed: a file in them may look like any message.

use prost::{Message, Name};

use palpate_refusal::{Reason, Refusal, Result};

/// Bytes of memory that a message may take per received byte, in addition to [`ROOM`].
pub const MULTIPLE: usize = 32;

/// Memory that a message may take regardless of its length, bytes: more than a full batch of short commands.
pub const ROOM: usize = 3 << 20;

/// Number of nested levels that are measured: more than any message has.
const LEVELS: u32 = 16;

/// Maximum number of different fields of a message.
const FIELDS: usize = 64;

/// Smallest memory of a text, bytes.
const MIN_TEXT: usize = 8;

/// The representation of a field in memory.
enum FieldKind {
    /// A number or an enumeration: its bytes in memory, and on the wire; 0 for a variable length.
    Number(usize, usize),
    /// A text or byte string.
    Text,
    /// The message with this index in [`SHAPES`].
    Message(usize),
}

/// A field of a message.
struct Field {
    number: u64,
    is_list: bool,
    kind: FieldKind,
}

/// The fields and the size in memory of a type of message, known when this crate is built, for measuring messages of
/// that type.
pub struct Shape {
    /// Its full name.
    name: &'static str,
    /// Size of the type itself, without what it refers to, bytes.
    bytes: usize,
    fields: &'static [Field],
    /// Returns whether bytes can be decoded as such a message.
    decode: fn(&[u8]) -> bool,
}

include!("../generated/shapes.rs");

/// The size of a message, from [`Shape::measure`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Measure {
    /// Number of fields at its top level; each entry of a list counts, except in a packed one.
    pub own_fields: usize,
    /// Number of fields on all levels, counted in the same way.
    pub fields: usize,
    /// Memory that it refers to when it is decoded, bytes, without that of the type itself: an upper estimate, in
    /// which growing vectors have room for twice their entries.
    pub memory: usize,
}

impl Shape {
    /// Returns the shape of the message type `M`; `None` if it does not belong to the protocol, to journals or, with
    /// the feature `etcd`, to etcd.
    pub fn of<M: Name>() -> Option<&'static Shape> {
        let name = M::full_name();
        SHAPES.iter().find(|shape| shape.name == name)
    }

    /// Returns the shapes of all types of messages, in no particular order: of the protocol, of journals and, with the
    /// feature `etcd`, of etcd.
    pub fn all() -> &'static [Shape] {
        SHAPES
    }

    /// Returns the full name of its type, with the package, such as `palpate.v1.Pose`.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// Returns whether bytes can be decoded as such a message. Decodes them without any limit on memory: measure them
    /// first.
    pub fn decodes(&self, bytes: &[u8]) -> bool {
        (self.decode)(bytes)
    }

    /// Measures the bytes of a message, to 16 nested levels. Stops when it has more than `most_fields` fields or
    /// takes more than `most_memory` bytes; the result is then beyond that limit, but not complete. Invalid bytes are
    /// measured up to the error: the decoder refuses them there.
    pub fn measure(&self, bytes: &[u8], most_fields: usize, most_memory: usize) -> Measure {
        let mut walk = Walk { measure: Measure::default(), most_fields, most_memory };
        walk.message(self, bytes, LEVELS);
        walk.measure
    }
}

/// A walk over a message.
struct Walk {
    measure: Measure,
    most_fields: usize,
    most_memory: usize,
}

impl Walk {
    fn is_over(&self) -> bool {
        self.measure.fields > self.most_fields || self.measure.memory > self.most_memory
    }

    /// Measures a message on one level. Returns `None` if the bytes are not a message, or a limit was exceeded.
    fn message(&mut self, shape: &Shape, mut bytes: &[u8], levels: u32) -> Option<()> {
        let mut counts = [0_usize; FIELDS];
        while !bytes.is_empty() && !self.is_over() {
            let tag = varint(&mut bytes)?;
            self.measure.fields += 1;
            self.measure.own_fields += usize::from(levels == LEVELS);
            let value = match tag & 7 {
                0 => {
                    varint(&mut bytes)?;
                    None
                }
                1 => bytes.split_off(..8).map(|_| None)?,
                2 => {
                    let length = usize::try_from(varint(&mut bytes)?).ok()?;
                    Some(bytes.split_off(..length)?)
                }
                5 => bytes.split_off(..4).map(|_| None)?,
                _ => return None,
            };
            let Some(place) = shape.fields.iter().position(|field| field.number == tag >> 3) else { continue };
            let Field { is_list, ref kind, .. } = shape.fields[place];
            let (entries, size) = match (kind, value) {
                (FieldKind::Number(memory, 0), Some(packed)) => {
                    (packed.iter().filter(|byte| **byte < 0x80).count(), *memory)
                }
                (FieldKind::Number(memory, wire), Some(packed)) => (packed.len() / wire, *memory),
                (FieldKind::Number(memory, _), None) => (1, *memory),
                (FieldKind::Text, text) => {
                    self.measure.memory += text.map_or(0, |text| text.len().max(MIN_TEXT));
                    (1, size_of::<Vec<u8>>())
                }
                (FieldKind::Message(of), message) => {
                    let of = &SHAPES[*of];
                    if let Some(message) = message.filter(|_| levels > 0) {
                        self.message(of, message, levels - 1);
                    }
                    (1, of.bytes)
                }
            };
            if is_list {
                let before = room(counts[place]);
                counts[place] += entries;
                self.measure.memory += (room(counts[place]) - before).saturating_mul(size);
            }
        }
        (!self.is_over()).then_some(())
    }
}

/// Returns the largest capacity of a vector that has grown to `entries` one by one. A single message that occurs
/// several times is merged into one with the entries of all: so the sum of these counts, and not the next power of
/// two of each.
fn room(entries: usize) -> usize {
    if entries == 0 { 0 } else { entries.saturating_mul(2).max(4) }
}

/// Reads a protobuf varint of at most 10 bytes from the front of `bytes`, and advances `bytes` beyond it. Returns
/// `None` if there is none; what was read until then is lost.
pub fn varint(bytes: &mut &[u8]) -> Option<u64> {
    let mut value = 0;
    for shift in (0..64).step_by(7) {
        let first = *bytes.split_off_first()?;
        value |= u64::from(first & 0x7f) << shift;
        if first & 0x80 == 0 {
            return Some(value);
        }
    }
    None
}

/// Returns the memory that the message of type `M` in `bytes` takes when it is decoded, bytes ([`Measure::memory`]);
/// 0 if the type does not belong to this crate. Does not decode it. `room` is the memory that it may take regardless
/// of its length, bytes, such as [`ROOM`].
///
/// # Errors
/// Refuses (`TOO_LARGE`) a message that would take more than [`MULTIPLE`] times its bytes plus `room`.
pub fn memory_of<M: Name>(bytes: &[u8], room: usize) -> Result<usize> {
    let Some(shape) = Shape::of::<M>() else { return Ok(0) };
    let most = bytes.len().saturating_mul(MULTIPLE).saturating_add(room);
    let memory = shape.measure(bytes, usize::MAX, most).memory;
    if memory <= most {
        return Ok(memory);
    }
    let message = format!(
        "{} bytes would take more than {most} in memory, {MULTIPLE} for each: no valid message has so many empty entries",
        bytes.len()
    );
    Err(Refusal::new(Reason::TooLarge, "", message))
}

/// Decodes a message that takes no more memory than [`memory_of`] allows with [`ROOM`].
///
/// # Errors
/// Returns the refusals of [`memory_of`], and refuses (`UNREADABLE`) bytes that can't be decoded.
pub fn decoded<M: Message + Name + Default>(bytes: &[u8]) -> Result<M> {
    memory_of::<M>(bytes, ROOM)?;
    M::decode(bytes).map_err(|error| Refusal::new(Reason::Unreadable, "", format!("can't be decoded: {error}")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{journal, pb};

    fn measured<M: Message + Name>(message: &M) -> Measure {
        Shape::of::<M>().unwrap().measure(&message.encode_to_vec(), usize::MAX, usize::MAX)
    }

    #[test]
    fn every_entry_counts_with_what_it_takes_in_memory() {
        let felt = journal::Felt { moments: vec![Default::default(); 1000] };
        let (bytes, measure) = (felt.encoded_len(), measured(&felt));
        assert_eq!((bytes, measure.fields, measure.own_fields), (2000, 1000, 1000));
        assert_eq!(measure.memory, 2000 * size_of::<journal::Moment>());
        // On inner levels too, with the smallest capacity of a vector.
        let moments = vec![journal::Moment { step: 0, tools: vec![Default::default()] }; 1000];
        let memory = measured(&journal::Felt { moments }).memory;
        assert_eq!(memory, 2000 * size_of::<journal::Moment>() + 1000 * 4 * size_of::<journal::FeltTool>());
        // Packed numbers, by what each takes.
        let mesh = journal::TriangleMesh { triangles: vec![1; 4096], uv: vec![0.0; 64], ..Default::default() };
        assert_eq!(measured(&mesh).memory, 2 * (4096 * 4 + 64 * 4));
        let hold = journal::Hold { reason: "a".repeat(100) };
        assert_eq!(measured(&hold).memory, 100);
    }

    #[test]
    fn what_would_take_many_times_its_bytes_is_refused_before_it_is_decoded() {
        let many = journal::Waiting { inputs: vec![Default::default(); 100_000] }.encode_to_vec();
        assert_eq!(decoded::<journal::Waiting>(&many).unwrap_err().reason, Reason::TooLarge);
        assert_eq!(decoded::<journal::Waiting>(&many[..2000]).unwrap().inputs.len(), 1000);
        assert_eq!(decoded::<journal::Waiting>(&[0xff]).unwrap_err().reason, Reason::Unreadable);
    }

    #[test]
    fn every_type_of_message_has_a_shape_by_its_name() {
        assert!(Shape::of::<pb::TakeSessionRequest>().is_some() && Shape::of::<journal::Header>().is_some());
        assert!(SHAPES.iter().all(|shape| shape.fields.len() <= FIELDS && shape.bytes > 0 || shape.fields.is_empty()));
        assert!(Shape::of::<()>().is_none());
    }
}
