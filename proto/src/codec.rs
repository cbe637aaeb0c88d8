//! Decodes received messages, requests and responses, within limits: they are measured before they are decoded
//! (`measure`). A megabyte of empty parts would otherwise occupy a network thread for a tenth of a second and take
//! many times its size in memory. The memory of a larger request is charged to its caller first ([`paid_by`]).

use std::cell::RefCell;
use std::sync::Arc;

use prost::{Message, Name};
use tonic::Status;
use tonic::codec::{BufferSettings, Codec, DecodeBuf, Decoder};
use tonic_prost::ProstCodec;

use crate::measure::{MULTIPLE, ROOM, Shape};
use palpate_refusal::{Reason, Refusal, Result};

/// Largest number of fields at a request's top level: a batch of as many commands as may wait, and some more.
const MAX_FIELDS: usize = 4096 + 256;

/// Largest number of fields of a request on all levels together: such a batch of poses, or 20,000 fixed points.
const MAX_FIELDS_IN_ALL: usize = 1 << 16;

/// Memory below which a request is not charged, bytes: a caller has few calls at once, and thousands per second.
const SMALL: usize = 16 << 10;

/// An account that is charged for the memory of large requests before they are decoded, such as that of a caller
/// ([`paid_by`]).
pub trait Payer: Send + Sync {
    /// Charges for a request that takes `bytes` bytes in memory. Called before it is decoded, once per request of more
    /// than 16 KiB. It must not wait.
    ///
    /// # Errors
    /// Refuses if the caller has no memory for the request, which is then not decoded.
    fn pay(&self, bytes: u64) -> Result<()>;
}

thread_local! {
    /// The payer of the requests that this thread decodes.
    static PAYER: RefCell<Option<Arc<dyn Payer>>> = const { RefCell::new(None) };
}

/// Restores the previous payer when it is dropped.
struct PreviousPayer(Option<Arc<dyn Payer>>);

impl Drop for PreviousPayer {
    fn drop(&mut self) {
        PAYER.set(self.0.take());
    }
}

/// Runs `act` with `payer` charged for the requests that this thread decodes in the meantime, and returns its result.
/// Then the payer from before applies again, also after a panic; without any, requests are not charged.
pub fn paid_by<T>(payer: &Arc<dyn Payer>, act: impl FnOnce() -> T) -> T {
    let _previous = PreviousPayer(PAYER.replace(Some(payer.clone())));
    act()
}

/// The protobuf codec of the generated clients and servers, with limits on received messages: on the memory of all,
/// and on the fields of requests, as [`accepts`] describes. It ends the call of a message beyond them with
/// `TOO_LARGE`, and that of a request that can't be decoded with `UNREADABLE`. `T` is sent, `U` is received.
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
        BoundedDecoder { inner: self.0.decoder(), shape: Shape::of::<U>(), is_request: U::NAME.ends_with("Request") }
    }
}

/// The decoder of [`BoundedCodec`]: checks a message, then has `D` decode it.
pub struct BoundedDecoder<D> {
    inner: D,
    shape: Option<&'static Shape>,
    is_request: bool,
}

impl<D: Decoder<Error = Status>> Decoder for BoundedDecoder<D> {
    type Item = D::Item;
    type Error = Status;

    fn decode(&mut self, buffer: &mut DecodeBuf<'_>) -> std::result::Result<Option<D::Item>, Status> {
        use bytes::Buf;
        // The buffer contains the message in one chunk.
        if let Some(shape) = self.shape {
            check(buffer.chunk(), shape, self.is_request)?;
        }
        let decoded = self.inner.decode(buffer);
        if !self.is_request {
            return decoded;
        }
        decoded.map_err(|status| {
            let message = format!("the message can't be decoded: {}", status.message());
            Refusal::new(Reason::Unreadable, "", message).into()
        })
    }

    fn buffer_settings(&self) -> BufferSettings {
        self.inner.buffer_settings()
    }
}

/// Performs the checks of [`BoundedCodec`] on the bytes of a message of type `M`, without decoding it: malformed bytes
/// are left to the decoder. A type is a request if its name ends in `Request`. Charges the payer of this thread
/// ([`paid_by`]) for a request of more than 16 KiB. A type of another crate is not checked.
///
/// # Errors
/// Refuses (`TOO_LARGE`) a message that takes more memory than [`MULTIPLE`] times its length plus [`ROOM`], and a
/// request with more than 4352 fields at its top level or 65,536 in all; and returns the refusal of the payer.
pub fn accepts<M: Name>(message: &[u8]) -> Result<()> {
    Shape::of::<M>().map_or(Ok(()), |shape| check(message, shape, M::NAME.ends_with("Request")))
}

/// Refuses a message that takes more memory than any valid one, and a request with too many fields. Charges a large
/// request.
fn check(message: &[u8], shape: &Shape, is_request: bool) -> Result<()> {
    let most_memory = message.len().saturating_mul(MULTIPLE).saturating_add(ROOM);
    let most_fields = if is_request { [MAX_FIELDS, MAX_FIELDS_IN_ALL] } else { [usize::MAX; 2] };
    let measure = shape.measure(message, most_fields[1], most_memory);
    for (has, most, what) in [
        (measure.fields, most_fields[1], "fields in all"),
        (measure.own_fields, most_fields[0], "fields or entries of its own"),
        (measure.memory, most_memory, "bytes in memory"),
    ] {
        if has > most {
            let advice = if is_request { ": send it in parts" } else { "" };
            return Err(Refusal::new(Reason::TooLarge, "", format!("the message has more than {most} {what}{advice}")));
        }
    }
    if is_request && measure.memory > SMALL {
        PAYER.with_borrow(|payer| payer.as_ref().map_or(Ok(()), |payer| payer.pay(measure.memory as u64)))?;
    }
    // The decoder refuses malformed messages.
    Ok(())
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::geometry::vector;
    use crate::pb;

    fn checked<M: Message + Name>(message: &M) -> Result<()> {
        accepts::<M>(&message.encode_to_vec())
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
        // Zeros would be half a million fields, and the corners of `vt 0 0` are such.
        let part = vec![0; 1 << 20];
        checked(&pb::UploadMeshRequest { part: part.clone(), ..Default::default() }).unwrap();
        checked(&pb::UploadJournalRequest { part: part.clone(), ..Default::default() }).unwrap();
        for message in [
            pb::take_session_request::Message::Part(part.clone()),
            pb::take_session_request::Message::Waiting(part.clone()),
        ] {
            checked(&pb::TakeSessionRequest { message: Some(message) }).unwrap();
        }
        let parts = pb::MirrorParts { parts: vec![pb::MirrorPart { bytes: part, ..Default::default() }] };
        checked(&pb::MirrorRequest { message: Some(pb::mirror_request::Message::Parts(parts)) }).unwrap();
    }

    #[test]
    fn answers_have_a_bound_too() {
        let answer = |sessions| pb::ListSessionsResponse { sessions: vec![Default::default(); sessions] };
        // Sessions without any content, which no server sends.
        checked(&answer(500)).unwrap();
        assert_eq!(checked(&answer(100_000)).unwrap_err().reason, Reason::TooLarge);
    }

    #[test]
    fn malformed_messages_are_left_to_the_decoder() {
        for bytes in [&[0xff; 100][..], &[0x0a, 0xff, 0xff, 0xff, 0x7f], &[0x0b], &[0x80; 20], &[]] {
            accepts::<pb::CreateSessionRequest>(bytes).unwrap();
        }
    }
}
