//! How much memory a message takes once it is decoded, and how many fields it has: found by a walk over its bytes by its type,
//! before anything is allocated. Bounds of requests, answers, journals and what etcd says all come from this walk.
//!
//! An entry of two bytes may be a message of hundreds in memory. What is in a field of type `bytes` or `string` is not looked at:
//! a file in it may look like any message.

use prost::{Message, Name};

use palpate_refusal::{Reason, Refusal, Result};

/// A message may take so many bytes of memory for each byte that came, and [`ROOM`] beside.
pub const MULTIPLE: usize = 32;

/// What a message may take whatever its length, bytes: a full batch of commands that say little takes less.
pub const ROOM: usize = 2 << 20;

/// Levels that are looked at: more than any message has.
const LEVELS: u32 = 16;

/// Fields of a message, at most.
const FIELDS: usize = 64;

/// The least that a text takes, bytes.
const MIN_TEXT: usize = 8;

/// What a field is in memory.
enum FieldKind {
    /// A number or an enumeration, of so many bytes in memory. On the wire it has so many, or, if 0, as many as it needs.
    Number(usize, usize),
    /// A text or byte string.
    Text,
    /// The message of this place in [`SHAPES`].
    Message(usize),
}

/// A field of a message.
struct Field {
    number: u64,
    is_list: bool,
    kind: FieldKind,
}

/// What a message is made of.
pub struct Shape {
    /// Its full name.
    name: &'static str,
    /// What it takes itself, without what it refers to, bytes.
    bytes: usize,
    fields: &'static [Field],
    /// Decodes it.
    decode: fn(&[u8]) -> bool,
}

include!(concat!(env!("OUT_DIR"), "/shapes.rs"));

/// What a message has and takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Measure {
    /// Fields at its top level.
    pub own_fields: usize,
    /// Fields of all levels.
    pub fields: usize,
    /// Memory that it refers to when it is decoded, bytes. Vectors that grow have room for up to twice their entries.
    pub memory: usize,
}

impl Shape {
    /// Returns the shape of a type of message. `None` if it is none of this crate's own.
    pub fn of<M: Name>() -> Option<&'static Shape> {
        let name = M::full_name();
        SHAPES.iter().find(|shape| shape.name == name)
    }

    /// Returns the shapes of every type of message: of the protocol, of journals and, with the feature `etcd`, of etcd.
    pub fn all() -> &'static [Shape] {
        SHAPES
    }

    /// Returns the full name of its type.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// Returns whether bytes can be decoded as such a message, whatever that takes.
    pub fn decodes(&self, bytes: &[u8]) -> bool {
        (self.decode)(bytes)
    }

    /// Measures the bytes of a message; ends early when it has more than `most_fields` fields or takes more than `most_memory`
    /// bytes. Bytes that are no message are measured up to where that shows: the decoder refuses them there.
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

    /// `None` where the bytes are no message, or the walk is over.
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

/// For how many entries a vector has room at most that has grown to so many, one by one. A message that comes several times where
/// it may come once is one in the end, with the entries of all: so their sum counts, and not the next power of two of each.
fn room(entries: usize) -> usize {
    if entries == 0 { 0 } else { entries.saturating_mul(2).max(4) }
}

/// Takes a varint from the front of `bytes`.
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

/// Returns the memory that the message in `bytes` takes when it is decoded.
///
/// # Errors
/// Refuses one that would take more than [`MULTIPLE`] times its bytes and `room`.
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

/// Decodes a message that takes no more memory than [`memory_of`] allows it, with [`ROOM`].
///
/// # Errors
/// Refuses what [`memory_of`] refuses, and what can't be decoded.
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
        // Of inner levels, too, and the least that a vector takes.
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
