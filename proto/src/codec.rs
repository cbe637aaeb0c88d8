//! Decodes messages, requests with a bound on their fields: the fields are counted before decoding. A megabyte of empty
//! parts would otherwise occupy a network thread for a tenth of a second and take many times its size in memory.

use prost::{Message, Name};
use tonic::Status;
use tonic::codec::{BufferSettings, Codec, DecodeBuf, Decoder};
use tonic_prost::ProstCodec;

use crate::refusal::{Reason, Refusal, Result};

/// Largest number of fields at a request's top level: a batch of as many commands as may wait, and some more.
const MOST_FIELDS: usize = 4096 + 256;

/// Largest number of fields of all levels of a request together: such a batch of poses, or 20,000 fixed points.
const MOST_FIELDS_IN_ALL: usize = 1 << 16;

/// Levels that are counted: more than any request has.
const LEVELS: u32 = 16;

/// A request without levels, whose bytes are any: they may look like a message of many fields.
const OF_ONE_LEVEL: &str = "UploadMeshRequest";

/// The protobuf codec with a bound on requests. Answers have no bound: a client trusts the server that it has chosen.
pub struct BoundedCodec<T, U>(ProstCodec<T, U>);

impl<T, U> Default for BoundedCodec<T, U> {
    fn default() -> Self {
        BoundedCodec(ProstCodec::new())
    }
}

impl<T, U> Codec for BoundedCodec<T, U>
where
    T: Message + Send + 'static,
    U: Message + Name + Default + Send + 'static,
{
    type Encode = T;
    type Decode = U;
    type Encoder = <ProstCodec<T, U> as Codec>::Encoder;
    type Decoder = BoundedDecoder<<ProstCodec<T, U> as Codec>::Decoder>;

    fn encoder(&mut self) -> Self::Encoder {
        self.0.encoder()
    }

    fn decoder(&mut self) -> Self::Decoder {
        let levels = if U::NAME == OF_ONE_LEVEL { 0 } else { LEVELS };
        BoundedDecoder { inner: self.0.decoder(), levels: U::NAME.ends_with("Request").then_some(levels) }
    }
}

/// The decoder of [`BoundedCodec`].
pub struct BoundedDecoder<D> {
    inner: D,
    /// Levels whose fields are counted; `None` if it decodes no requests.
    levels: Option<u32>,
}

impl<D: Decoder<Error = Status>> Decoder for BoundedDecoder<D> {
    type Item = D::Item;
    type Error = Status;

    fn decode(&mut self, buffer: &mut DecodeBuf<'_>) -> std::result::Result<Option<D::Item>, Status> {
        use bytes::Buf;
        let Some(levels) = self.levels else { return self.inner.decode(buffer) };
        // The buffer holds the message in one chunk.
        check(buffer.chunk(), levels)?;
        self.inner.decode(buffer).map_err(|status| {
            let message = format!("the message can't be decoded: {}", status.message());
            Refusal::new(Reason::Unreadable, "", message).into()
        })
    }

    fn buffer_settings(&self) -> BufferSettings {
        self.inner.buffer_settings()
    }
}

/// Refuses a message with more fields than any valid request has.
fn check(message: &[u8], levels: u32) -> Result<()> {
    let too_many = |what: &str, most: usize| {
        Refusal::new(Reason::TooLarge, "", format!("the message has more than {most} {what}: send it in parts"))
    };
    let mut left = MOST_FIELDS_IN_ALL;
    match count(message, levels, &mut left) {
        _ if left == 0 => Err(too_many("fields in all", MOST_FIELDS_IN_ALL)),
        Some(own) if own > MOST_FIELDS => Err(too_many("fields or entries of its own", MOST_FIELDS)),
        // The decoder refuses malformed messages.
        _ => Ok(()),
    }
}

/// Counts the fields of a message; subtracts those of all levels from `left` until it is 0. Returns `None` if the bytes are
/// not a message. A text or byte string that could be a message counts as one.
fn count(mut message: &[u8], levels: u32, left: &mut usize) -> Option<usize> {
    let mut fields = 0;
    while !message.is_empty() && *left > 0 {
        let tag = varint(&mut message)?;
        fields += 1;
        *left -= 1;
        let length = match tag & 7 {
            0 => varint(&mut message).map(|_| 0)?,
            1 => 8,
            2 => usize::try_from(varint(&mut message)?).ok()?,
            5 => 4,
            _ => return None,
        };
        let (value, rest) = message.split_at_checked(length)?;
        message = rest;
        if tag & 7 == 2 && levels > 0 {
            let before = *left;
            if count(value, levels - 1, left).is_none() {
                *left = before;
            }
        }
    }
    Some(fields)
}

/// Takes a varint from the front of `bytes`.
fn varint(bytes: &mut &[u8]) -> Option<u64> {
    let mut value = 0;
    for shift in (0..64).step_by(7) {
        let (first, rest) = bytes.split_first()?;
        *bytes = rest;
        value |= u64::from(first & 0x7f) << shift;
        if first & 0x80 == 0 {
            return Some(value);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::geometry::vector;
    use crate::pb;

    fn checked(message: &impl Message) -> Result<()> {
        check(&message.encode_to_vec(), LEVELS)
    }

    #[test]
    fn a_full_batch_of_commands_passes_and_a_flood_of_empty_parts_does_not() {
        let command = pb::Command {
            tool: 63,
            sequence: Some(u64::MAX),
            client_time_ns: u64::MAX,
            at_step: Some(u64::MAX),
            time_to_live_s: Some(1.0),
            action: Some(pb::command::Action::Force(pb::Force { force_n: vector(DVec3::ONE), ..Default::default() })),
        };
        let batch = |commands| pb::SendCommandsRequest { commands, ..Default::default() };
        checked(&batch(vec![command; 4096])).unwrap();
        let refusal = checked(&batch(vec![pb::Command::default(); 500_000])).unwrap_err();
        assert_eq!(refusal.reason, Reason::TooLarge);
        assert_eq!(checked(&batch(vec![pb::Command::default(); 5000])).unwrap_err().reason, Reason::TooLarge);
    }

    #[test]
    fn entries_of_inner_levels_count() {
        let request = |points: usize| {
            let points = pb::GridPoints { points: vec![pb::GridPoint { x: 3, y: 4 }; points] };
            let fixed = Some(pb::sheet::Fixed::FixedPoints(points));
            let scene = pb::Scene { sheet: Some(pb::Sheet { fixed, ..Default::default() }), ..Default::default() };
            let source = Some(pb::create_session_request::Source::Scene(scene));
            pb::CreateSessionRequest { source, ..Default::default() }
        };
        checked(&request(20_000)).unwrap();
        assert_eq!(checked(&request(22_000)).unwrap_err().reason, Reason::TooLarge);
    }

    #[test]
    fn the_bytes_of_a_file_are_no_fields() {
        // Zeros would be fields, had they levels: half a million.
        let request = pb::UploadMeshRequest { part: vec![0; 1 << 20], ..Default::default() };
        check(&request.encode_to_vec(), 0).unwrap();
        assert!(check(&request.encode_to_vec(), LEVELS).is_err());
    }

    #[test]
    fn malformed_messages_are_left_to_the_decoder() {
        for bytes in [&[0xff; 100][..], &[0x0a, 0xff, 0xff, 0xff, 0x7f], &[0x0b], &[0x80; 20], &[]] {
            check(bytes, LEVELS).unwrap();
        }
    }
}
