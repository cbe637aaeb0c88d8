//! The hashes in a journal, and their comparison with those of a session that plays it.

use std::collections::{BTreeMap, VecDeque};
use std::io::Cursor;

use palpate_client::Channel;
use palpate_proto::pb;
use palpate_refusal::Refusal;
use palpate_session::journal::JournalReader;
use pb::session_service_client::SessionServiceClient;
use tonic::Code;

use crate::ClientFailure;

/// Number of hashes that are requested before their steps are done.
const AHEAD: usize = 8;

/// Recorded hashes of the state, with their steps.
pub(super) type Hashes = BTreeMap<u64, String>;

/// Returns the hashes of a journal; refusals name it `place`.
pub(super) fn hashes(place: &str, journal: &[u8]) -> Result<Hashes, Refusal> {
    let mut reader = JournalReader::new(place, Cursor::new(journal))?;
    let mut hashes = Hashes::new();
    while let Some(batch) = reader.next_batch()? {
        let of_snapshots = batch.snapshots()?.into_iter().map(|snapshot| (snapshot.step, snapshot.hash));
        for (step, hash) in batch.hashes()?.into_iter().map(|hash| (hash.step, hash.hash)).chain(of_snapshots) {
            hashes.entry(step).or_insert(hash);
        }
    }
    Ok(hashes)
}

/// Result of the comparison.
#[derive(Default)]
pub(super) struct Compared {
    /// This many hashes are equal.
    pub(super) equal: u64,
    /// The server did not report this many hashes in time.
    missed: u64,
    /// The first hash that differs.
    pub(super) difference: Option<String>,
}

impl Compared {
    /// Returns the result as a text.
    pub(super) fn told(&self) -> String {
        let missed = if self.missed == 0 { String::new() } else { format!(", {} not reported in time", self.missed) };
        match self.equal + self.missed {
            0 => "none between these steps".to_owned(),
            _ => format!("{} equal{missed}", self.equal),
        }
    }
}

/// Compares the hashes of a session with those that were `recorded`, up to the first that differs. Ends when all
/// their steps are done.
pub(super) async fn compare(channel: &Channel, session_id: &str, recorded: Hashes) -> Result<Compared, ClientFailure> {
    let (mut compared, mut left, mut asked) = (Compared::default(), recorded.into_iter(), VecDeque::new());
    loop {
        for (step, hash) in left.by_ref().take(AHEAD - asked.len()) {
            let mut sessions = SessionServiceClient::new(channel.clone());
            let request = pb::GetStateHashRequest { session_id: session_id.to_owned(), at_step: Some(step) };
            asked.push_back((step, hash, tokio::spawn(async move { sessions.get_state_hash(request).await })));
        }
        let Some((step, recorded, answer)) = asked.pop_front() else { return Ok(compared) };
        match answer.await.map_err(|error| ClientFailure::Failed(error.to_string()))? {
            Ok(answer) if answer.get_ref().state_hash == recorded => compared.equal += 1,
            Ok(answer) => {
                let played = &answer.get_ref().state_hash;
                let what = format!("the state at step {step} was {recorded} when it was recorded, and is {played}");
                compared.difference = Some(what);
                return Ok(compared);
            }
            // The step was done before the request arrived, or the caller has read too much recently.
            Err(status) if [Code::OutOfRange, Code::ResourceExhausted].contains(&status.code()) => compared.missed += 1,
            Err(status) => return Err(super::refused(status)),
        }
    }
}
