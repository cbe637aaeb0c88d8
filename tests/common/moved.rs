//! A session as one server hands it to another, or a client sends it: as a journal of one snapshot, in requests.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used)]

use std::io::Cursor;
use std::sync::Arc;

use palpate_proto::codec::accepts;
use palpate_proto::pb;
use palpate_refusal::Result;
use palpate_session::Session;
use palpate_session::budget::{Budget, Purpose, Resource};
use palpate_session::journal::{JournalReader, JournalWriter, Opening, pb as kept, replay};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use prost::Message;

use super::journal_opening;

/// Bytes in one message.
const PART_BYTES: usize = 256 << 10;

/// The journal of one moment of a session that began with the tissue of `first`.
pub fn journal(first: &Arc<Model>, session: &Session) -> Vec<u8> {
    let step = session.step_count();
    let opening = Opening { owner: "test", begin_step: step, ownership_revision: 1, ..journal_opening::opening(first) };
    let mut writer = JournalWriter::new(&opening, 1);
    writer.snapshot(step, session.tissue().state_hash(), session.model(), session.save().to_bytes());
    writer.finish(kept::Why::Cut, "a snapshot", step, 1)
}

/// The bytes, as they come in requests of each call that has them.
pub fn received(bytes: &[u8]) -> Result<Vec<u8>> {
    let mut received = Vec::new();
    for part in bytes.chunks(PART_BYTES) {
        let message = Some(pb::take_session_request::Message::Part(part.to_vec()));
        let sent = pb::TakeSessionRequest { message }.encode_to_vec();
        accepts::<pb::TakeSessionRequest>(&sent)?;
        let upload = pb::UploadJournalRequest { part: part.to_vec(), ..Default::default() };
        accepts::<pb::UploadJournalRequest>(&upload.encode_to_vec())?;
        let mirrored = pb::MirrorPart { bytes: part.to_vec(), ..Default::default() };
        let message = pb::mirror_request::Message::Parts(pb::MirrorParts { parts: vec![mirrored] });
        accepts::<pb::MirrorRequest>(&pb::MirrorRequest { message: Some(message) }.encode_to_vec())?;
        if let Some(pb::take_session_request::Message::Part(part)) =
            pb::TakeSessionRequest::decode(&*sent).unwrap().message
        {
            received.extend(part);
        }
    }
    Ok(received)
}

/// The session there.
pub fn moved(first: &Arc<Model>, session: &Session, limits: &Limits) -> Result<Session> {
    let bytes = received(&journal(first, session))?;
    let account = Budget::new(&Limits { memory_bytes: 4 << 30, ..limits.clone() }, 1, 1).account("test");
    let paid = account.take(Resource::Memory(Purpose::Journals), 0, "")?;
    let reader = JournalReader::paid("the state of a session", Cursor::new(bytes), Some(paid))?;
    Ok(replay::resume(reader, limits)?.session)
}
