//! Writer of the journal of a run: it collects events, and returns the bytes to append to the file.

use palpate_proto::journal as pb;
use prost::Message;
use std::sync::Arc;

use super::format::{self, MAX_INPUTS, REPLAYS, Topic, VERSION};
use super::message::{self, Tips};
use super::records::{self, Chunk};
use super::signature::{Key, Signer};
use crate::input::{Felt, Input};
use palpate_tissue::Model;

/// Description of a session and a run at the beginning of its journal, for [`JournalWriter::new`].
#[derive(Debug, Clone)]
pub struct Opening<'a> {
    /// ID of the session.
    pub session_id: &'a str,
    /// Number of the run, from 1.
    pub run: u64,
    /// Name of the account that created the session, for people.
    pub owner: &'a str,
    /// Time without use after which the server deletes the session, s.
    pub idle_timeout_s: f64,
    /// The tissue with which the session began, in its first run.
    pub first: &'a Arc<Model>,
    /// Number of steps done when the journal begins.
    pub begin_step: u64,
    /// Whether the session's time advances when the journal begins.
    pub running: bool,
    /// The step count at which the session pauses; `None` if it has no such end.
    pub until_step: Option<u64>,
    /// Revision in etcd at which the server became the session's owner; 0 without a fleet.
    pub ownership_revision: u64,
    /// The exercise that the session is made for ([`exercise::recorded`](super::exercise::recorded)); `None` for any other session.
    pub exercise: Option<pb::RecordedExercise>,
}

impl Opening<'_> {
    fn message(&self) -> pb::Header {
        let (scene, mesh, appearance) = message::scene(&self.first.scene);
        pb::Header {
            session_id: self.session_id.to_owned(),
            run: self.run,
            version: VERSION.to_owned(),
            replays: REPLAYS,
            owner: self.owner.to_owned(),
            rate_hz: self.first.scene.stepping.rate_hz,
            idle_timeout_s: self.idle_timeout_s,
            begin_step: self.begin_step,
            running: self.running,
            until_step: self.until_step,
            scene: Some(scene),
            mesh,
            appearance: Some(appearance),
            tissue: Some(message::tissue(self.first)),
            ownership_revision: self.ownership_revision,
            exercise: self.exercise.clone(),
        }
    }
}

/// Size of a batch's messages at which the batch ends, bytes.
const USUAL_BYTES: usize = 4 << 20;

/// Writer of a journal. It keeps the events until the next flush in memory, but neither a file nor an index: the
/// caller appends the bytes that it returns.
#[derive(Debug)]
pub struct JournalWriter {
    /// Number of batches so far, and of inputs in them.
    batches: u64,
    inputs_before: u64,
    /// Number of batches that are certainly on the disk.
    durable: u64,
    until_step: u64,
    /// Whether time advances, and to which step.
    running: (bool, Option<u64>),
    /// Time of the last flush, ns since the Unix epoch.
    unix_ns: u64,
    inputs: Vec<pb::Input>,
    tips: Tips,
    moments: Vec<pb::Moment>,
    /// Other messages, in order.
    messages: Vec<(Topic, Vec<u8>)>,
    bytes: usize,
    /// Chunks that were full before their flush.
    full: Vec<u8>,
    signer: Option<Signer>,
    /// Whether the batch that is written is the last.
    ends: bool,
}

impl JournalWriter {
    /// Creates the writer of a journal. The first flush returns the beginning of the file, with the header.
    ///
    /// A session that does not begin at rest needs a snapshot of its beginning before the first flush
    /// ([`JournalWriter::snapshot`]). `unix_ns` is the time, ns since the Unix epoch.
    pub fn new(opening: &Opening<'_>, unix_ns: u64) -> Self {
        JournalWriter::with_header(&opening.message(), unix_ns)
    }

    /// Creates the writer of a journal of a session that runs from its step 0 on, at rest, with a snapshot of that: for tests.
    #[cfg(test)]
    pub(crate) fn at_rest(model: &Arc<Model>) -> Self {
        let opening = Opening {
            session_id: "tested",
            run: 1,
            owner: "",
            idle_timeout_s: 900.0,
            first: model,
            begin_step: 0,
            running: true,
            until_step: None,
            ownership_revision: 0,
            exercise: None,
        };
        let mut writer = JournalWriter::new(&opening, 0);
        let began = crate::Session::new(model);
        writer.snapshot(0, began.tissue().state_hash(), model, began.save().to_bytes());
        writer
    }

    /// Creates a writer with the header of another journal.
    pub(super) fn with_header(header: &pb::Header, unix_ns: u64) -> Self {
        let bytes = header.encode_to_vec();
        JournalWriter {
            batches: 0,
            inputs_before: 0,
            durable: 0,
            until_step: header.begin_step,
            running: (header.running, header.until_step),
            unix_ns,
            inputs: Vec::new(),
            tips: Tips::new(),
            moments: Vec::new(),
            bytes: bytes.len(),
            messages: vec![(Topic::Header, bytes)],
            full: Vec::new(),
            signer: None,
            ends: false,
        }
    }

    /// Returns this writer with a key by which it signs what it writes, at most once a second and at the end; `None`
    /// for no signatures. Call it before anything else.
    #[must_use]
    pub fn signed(self, key: Option<&Key>) -> Self {
        JournalWriter { signer: key.map(|key| Signer::new(key.clone())), ..self }
    }

    /// Creates a writer of what is appended to a journal with `batches` batches and `inputs` inputs, complete up to
    /// `until_step`.
    pub(super) fn after(batches: u64, inputs: u64, until_step: u64) -> Self {
        let writer = JournalWriter::with_header(&pb::Header { begin_step: until_step, ..Default::default() }, 0);
        JournalWriter { batches, inputs_before: inputs, durable: batches, messages: Vec::new(), bytes: 0, ..writer }
    }

    /// Adds an input that acts when `step` steps are done. Add inputs in the order in which they act. After 65,536
    /// inputs ([`MAX_INPUTS`]) or about 4 MiB the batch ends, and its bytes wait for the flush.
    pub fn input(&mut self, step: u64, input: &Input) {
        let message = message::input(step, input, &mut self.tips);
        self.add_input(message);
    }

    /// Adds an input that is already a message.
    pub(super) fn add_input(&mut self, message: pb::Input) {
        match &message.what {
            Some(pb::input::What::Start(start)) => self.running = (true, start.until_step),
            Some(pb::input::What::Pause(_) | pb::input::What::Revive(_)) => self.running.0 = false,
            _ => {}
        }
        self.bytes += message.encoded_len();
        self.inputs.push(message);
        if self.inputs.len() == MAX_INPUTS || self.bytes > USUAL_BYTES {
            self.end_batch();
        }
    }

    /// Adds the hash of the state after `step` steps. It belongs between the inputs that were added before and those
    /// added later, so add it before the inputs that act at that step.
    pub fn hash(&mut self, step: u64, hash: u128) {
        self.add_hash(pb::Hash { step, hash: message::hash(hash), after_inputs: 0 });
    }

    pub(super) fn add_hash(&mut self, hash: pb::Hash) {
        let hash = pb::Hash { after_inputs: self.input_count(), ..hash };
        self.message(Topic::Hashes, hash.encode_to_vec());
    }

    /// Adds a snapshot after `step` steps, before the inputs that act at that step are added: the state's hash, its
    /// tissue `model`, and `saved`, the session's state from [`Saved::to_bytes`](crate::snapshot::Saved::to_bytes).
    pub fn snapshot(&mut self, step: u64, hash: u128, model: &Model, saved: Vec<u8>) {
        let (tissue, hash) = (Some(message::tissue(model)), message::hash(hash));
        self.add_snapshot(pb::Snapshot { step, hash, tissue, saved, ..Default::default() });
    }

    pub(super) fn add_snapshot(&mut self, snapshot: pb::Snapshot) {
        let (running, until_step) = self.running;
        let snapshot = pb::Snapshot { after_inputs: self.input_count(), running, until_step, ..snapshot };
        self.message(Topic::Snapshots, snapshot.encode_to_vec());
    }

    /// Adds the list of all changes of the tissue that wait for their step, each with that step, by ascending step.
    /// It replaces earlier lists; an empty one says that none waits.
    pub fn waiting(&mut self, changes: &[(u64, Arc<Model>)]) {
        let input =
            |(step, model): &(u64, Arc<Model>)| message::input(*step, &Input::Tissue(model.clone()), &mut Tips::new());
        let waiting = pb::Waiting { inputs: changes.iter().map(input).collect() };
        self.message(Topic::Waiting, waiting.encode_to_vec());
    }

    /// Adds the poses of the tools and the forces on them after `step` steps, rounded to 32-bit floats; nothing if
    /// `felt` is empty.
    pub fn felt(&mut self, step: u64, felt: &[Felt]) {
        if !felt.is_empty() {
            self.add_moment(message::moment(step, felt));
        }
    }

    pub(super) fn add_moment(&mut self, moment: pb::Moment) {
        self.bytes += moment.encoded_len();
        self.moments.push(moment);
        if self.bytes > USUAL_BYTES {
            self.end_batch();
        }
    }

    fn message(&mut self, topic: Topic, bytes: Vec<u8>) {
        self.bytes += bytes.len();
        self.messages.push((topic, bytes));
    }

    fn input_count(&self) -> u64 {
        self.inputs_before + self.inputs.len() as u64
    }

    /// Returns the approximate number of bytes that the next flush will return, without signatures and indexes.
    pub fn waiting_bytes(&self) -> usize {
        self.bytes + self.full.len()
    }

    /// Returns the step up to which the batches so far are complete: the largest that a flush was given, at first the
    /// step at which the journal begins.
    pub fn until_step(&self) -> u64 {
        self.until_step
    }

    /// Returns the number of batches so far, with those that wait for a flush because they were full. When the bytes
    /// of a flush are certainly on the disk, pass the number after that flush to [`JournalWriter::durable`].
    pub fn batches(&self) -> u64 {
        self.batches
    }

    /// Sets that the first `batches` batches are certainly on the disk. Later batches record that, so that a reader
    /// can tell damage among them from a torn end. A number below an earlier one changes nothing, and one above
    /// [`JournalWriter::batches`] counts as that.
    pub fn durable(&mut self, batches: u64) {
        self.durable = self.durable.max(batches.min(self.batches));
    }

    /// Ends the batch and returns the bytes to append to the file in one piece: all inputs that act before
    /// `until_step` steps are done must have been added. A lower `until_step` than before counts as the former.
    /// Returns no bytes if there were neither events nor steps since the last flush. `unix_ns` is the time, ns since
    /// the Unix epoch.
    pub fn flush(&mut self, until_step: u64, unix_ns: u64) -> Vec<u8> {
        let is_new = self.batches == 0 || until_step > self.until_step;
        self.until_step = self.until_step.max(until_step);
        self.unix_ns = unix_ns;
        if is_new || !self.inputs.is_empty() || !self.messages.is_empty() || !self.moments.is_empty() {
            self.end_batch();
        }
        std::mem::take(&mut self.full)
    }

    /// Ends the journal: returns the bytes to append with the last batch, which says by `why` and `message` why the
    /// journal ends; the session has done `until_step` steps at `unix_ns`, ns since the Unix epoch. [`super::seal`]
    /// then makes an indexed file of the complete journal.
    pub fn finish(mut self, why: pb::Why, message: &str, until_step: u64, unix_ns: u64) -> Vec<u8> {
        let end = pb::End { why: why.into(), message: message.to_owned() };
        self.message(Topic::End, end.encode_to_vec());
        self.ends = true;
        self.flush(until_step, unix_ns)
    }

    /// Ends the batch, without a new step up to which the file is complete.
    #[allow(clippy::cast_possible_truncation)]
    fn end_batch(&mut self) {
        let mut channels = Vec::new();
        if self.batches == 0 {
            self.full = records::beginning(&format!("palpate {VERSION}"));
            format::channels(&mut channels, self.signer.is_some());
        }
        let mut chunk = Chunk::new(self.unix_ns, self.batches as u32, &channels);
        let inputs = std::mem::take(&mut self.inputs);
        let count = inputs.len() as u64;
        let inputs = pb::Inputs {
            batch: self.batches,
            until_step: self.until_step,
            durable_batches: self.durable,
            first_input: self.inputs_before,
            inputs,
        };
        let messages = std::mem::take(&mut self.messages);
        let (first, others) = messages.split_at(messages.iter().filter(|message| message.0 == Topic::Header).count());
        let mut add = |topic: Topic, bytes: &[u8]| {
            chunk.add(topic.channel(), bytes);
            if let Some(signer) = &mut self.signer {
                signer.add(topic, self.unix_ns, bytes);
            }
        };
        first.iter().for_each(|(topic, bytes)| add(*topic, bytes));
        add(Topic::Inputs, &inputs.encode_to_vec());
        if !self.moments.is_empty() {
            let moments = std::mem::take(&mut self.moments);
            add(Topic::Felt, &pb::Felt { moments }.encode_to_vec());
        }
        others.iter().for_each(|(topic, bytes)| add(*topic, bytes));
        if let Some(signature) = self.signer.as_mut().and_then(|signer| signer.sign(self.unix_ns, self.ends)) {
            chunk.add(Topic::Signatures.channel(), &signature);
        }
        self.full.extend(chunk.finish());
        self.batches += 1;
        self.inputs_before += count;
        self.bytes = 0;
        self.tips.clear();
    }
}
