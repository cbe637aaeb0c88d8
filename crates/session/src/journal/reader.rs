//! Reader of a journal, batch by batch, which works with damaged files.
//!
//! An invalid record is judged by what follows it. If a later batch says that the batch here was certainly on the
//! disk, the file is damaged: that is an error, which names the place. Otherwise the file is torn here: what
//! follows had not reached the disk, and the journal ends with the previous batch.
//!
//! A chunk's checksum detects every changed bit. The bytes outside chunks (records' lengths, indexes, the summary)
//! only determine where chunks are, and the numbers of batches have no gap.
//!
//! The memory of a batch is known, and charged to the account that pays for the reader, before its messages are
//! decoded.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::Path;

use palpate_proto::journal as pb;
use palpate_proto::measure::{self, memory_of, varint};
use prost::Message;

use super::exercise::ExerciseEvents;
use super::format::{MAX_BYTES, MAX_INPUTS, Topic};
use super::message::fill_tips;
use super::records::{
    CHANNEL, CHUNK, CHUNK_HEAD, DATA_END, HEAD, HEADER, MAGIC, MESSAGE, MESSAGE_HEAD, MESSAGE_INDEX, SCHEMA, number,
};
use crate::budget::Taken;
use crate::phase_run::PhaseEnd;
use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::memory;
use palpate_tissue::scene::exercise::MAX_PHASES;

/// A batch of a journal: the content of one chunk, whose checksum has been checked. Each function decodes its
/// messages anew.
#[derive(Debug, Clone)]
pub struct JournalBatch {
    /// Number of the batch in its journal, from 0.
    pub number: u64,
    /// Position of the record of the batch's chunk in the file, bytes.
    pub offset: u64,
    /// The journal up to this batch has every input that acts before this step.
    pub until_step: u64,
    /// Number of batches that were certainly on the disk when this one was written.
    pub durable_batches: u64,
    /// Number of the first input in this batch: the number of inputs in the batches before.
    pub first_input: u64,
    /// Number of inputs in this batch.
    pub input_count: u64,
    /// Time at which the batch was written, ns since the Unix epoch.
    pub unix_ns: u64,
    place: String,
    data: Vec<u8>,
    messages: Vec<(Topic, Range<usize>)>,
    /// Channel, time and position of each message, including messages of unknown channels.
    places: Vec<(u16, u64, u64)>,
}

/// Memory that the inputs of a batch may take whatever their length, bytes: there are at most [`MAX_INPUTS`], in a
/// vector that has grown.
const INPUTS_ROOM: usize = 2 * MAX_INPUTS * size_of::<pb::Input>();

/// Memory of a message beside what it refers to, in the lists in which it waits, bytes.
const MESSAGE_BYTES: usize = 1024;

impl JournalBatch {
    /// Returns the memory of the batch with all its messages decoded, bytes.
    fn memory(&self) -> Result<u64> {
        let mut sum = self.data.len() + size_of_val(self.places.as_slice());
        for (topic, range) in &self.messages {
            let bytes = &self.data[range.clone()];
            let memory = match topic {
                Topic::Header => memory_of::<pb::Header>(bytes, measure::ROOM),
                Topic::Inputs => memory_of::<pb::Inputs>(bytes, INPUTS_ROOM),
                Topic::Hashes => memory_of::<pb::Hash>(bytes, measure::ROOM),
                Topic::Snapshots => memory_of::<pb::Snapshot>(bytes, measure::ROOM),
                Topic::Felt => memory_of::<pb::Felt>(bytes, measure::ROOM),
                Topic::Waiting => memory_of::<pb::Waiting>(bytes, measure::ROOM),
                Topic::End => memory_of::<pb::End>(bytes, measure::ROOM),
                Topic::Signatures => memory_of::<pb::Signature>(bytes, measure::ROOM),
            };
            let memory =
                memory.map_err(|refusal| self.refuse(format!("a message {}: {}", topic.name(), refusal.message)))?;
            // As messages, and as the list of items in order, whose entries are larger.
            sum = sum.saturating_add(3 * memory + MESSAGE_BYTES);
        }
        Ok(sum as u64)
    }

    /// Returns each message of a topic, decoded.
    fn all<M: Message + Default>(&self, topic: Topic) -> impl Iterator<Item = Result<M>> + '_ {
        let of_topic = self.messages.iter().filter(move |message| message.0 == topic);
        of_topic.map(move |(_, range)| {
            M::decode(&self.data[range.clone()])
                .map_err(|e| self.refuse(format!("a message {} can't be decoded: {e}", topic.name())))
        })
    }

    /// Returns each of its messages with a known topic, as it was written, in order.
    pub(super) fn messages(&self) -> impl Iterator<Item = (Topic, &[u8])> {
        self.messages.iter().map(|(topic, range)| (*topic, &self.data[range.clone()]))
    }

    /// Returns the content of its chunk.
    pub(super) fn data(&self) -> &[u8] {
        &self.data
    }

    /// Returns the index of its chunk.
    pub(super) fn places(&self) -> &[(u16, u64, u64)] {
        &self.places
    }

    /// Returns a refusal of something in the batch.
    pub(super) fn refuse(&self, message: String) -> Refusal {
        self.placed(Refusal::new(Reason::Unreadable, "", message))
    }

    /// Returns a refusal with the place of this batch.
    pub(super) fn placed(&self, refusal: Refusal) -> Refusal {
        let JournalBatch { number, offset, until_step, .. } = self;
        let field = if refusal.field.is_empty() { String::new() } else { format!("{}: ", refusal.field) };
        let message = format!("batch {number} at byte {offset}, up to step {until_step}: {field}{}", refusal.message);
        Refusal { place: Some(self.place.clone()), message, field: String::new(), ..refusal }
    }

    /// Returns the inputs of the batch, in the order in which they acted; empty if there are none. A pose that was
    /// written without a tip gets the tip of the previous pose of its tool in this batch.
    ///
    /// # Errors
    /// Refuses a message that can't be decoded ([`Reason::Unreadable`]), and a pose without a tip if no earlier pose
    /// of its tool in this batch has one ([`Reason::Missing`]). Refusals name the place of the batch.
    pub fn inputs(&self) -> Result<Vec<pb::Input>> {
        let mut inputs = Vec::new();
        for message in self.all::<pb::Inputs>(Topic::Inputs) {
            inputs = message?.inputs;
        }
        fill_tips(&mut inputs).map_err(|refusal| self.placed(refusal))?;
        Ok(inputs)
    }

    /// Returns the hashes of the batch, in the order of writing; empty if there are none.
    ///
    /// # Errors
    /// Refuses a message that can't be decoded ([`Reason::Unreadable`]).
    pub fn hashes(&self) -> Result<Vec<pb::Hash>> {
        self.all(Topic::Hashes).collect()
    }

    /// Returns the snapshots of the batch, in the order of writing; empty if there are none. The state in a snapshot
    /// stays encoded.
    ///
    /// # Errors
    /// Refuses a message that can't be decoded ([`Reason::Unreadable`]).
    pub fn snapshots(&self) -> Result<Vec<pb::Snapshot>> {
        self.all(Topic::Snapshots).collect()
    }

    /// Returns the recorded poses of the tools and forces on them, one entry for each recorded step, in the order of
    /// writing; empty if there are none.
    ///
    /// # Errors
    /// Refuses a message that can't be decoded ([`Reason::Unreadable`]).
    pub fn felt(&self) -> Result<Vec<pb::Moment>> {
        let messages: Result<Vec<pb::Felt>> = self.all(Topic::Felt).collect();
        Ok(messages?.into_iter().flat_map(|felt| felt.moments).collect())
    }

    /// Returns the batch's last list of the changes of the tissue that wait for their step; `None` if it has no list.
    /// A list replaces those of earlier batches.
    ///
    /// # Errors
    /// Refuses a last list that can't be decoded ([`Reason::Unreadable`]).
    pub fn waiting(&self) -> Result<Option<pb::Waiting>> {
        self.all(Topic::Waiting).last().transpose()
    }

    /// Returns why the journal ends, if this is its last batch; `None` otherwise, or if the journal is unfinished.
    ///
    /// # Errors
    /// Refuses a message that can't be decoded ([`Reason::Unreadable`]).
    pub fn end(&self) -> Result<Option<pb::End>> {
        self.all(Topic::End).next().transpose()
    }

    /// Returns the header, which is in the first batch.
    fn header(&self) -> Result<pb::Header> {
        self.all(Topic::Header).next().unwrap_or_else(|| Err(self.refuse("the header is missing".to_owned())))
    }

    /// Returns whether the batch has messages of a topic. Nothing is decoded.
    pub fn has(&self, topic: Topic) -> bool {
        self.messages.iter().any(|message| message.0 == topic)
    }
}

/// Position of a snapshot in a journal, as [`JournalReader::survey`] finds it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SnapshotAt {
    /// Number of steps done when the snapshot was made.
    pub step: u64,
    /// Position of the snapshot's chunk in the file, bytes.
    pub offset: u64,
    /// Number of the batch that has the snapshot.
    pub batch: u64,
}

/// Content of a journal, as one pass over its whole batches finds it ([`JournalReader::survey`]).
#[derive(Debug, Clone, Default)]
pub struct Survey {
    /// Number of whole batches.
    pub batches: u64,
    /// The journal has every input that acts before this step; that of the last whole batch.
    pub until_step: u64,
    /// Number of inputs in all batches.
    pub inputs: u64,
    /// Number of hashes in all batches; those of snapshots do not count.
    pub hashes: u64,
    /// Positions of the snapshots, in the order of the file, which is by ascending step.
    pub snapshots: Vec<SnapshotAt>,
    /// Changes of the tissue in the last list that was written; at most 4096. Some of them may have taken effect
    /// since.
    pub waiting: Vec<pb::Input>,
    /// Times of the first and the last batch, ns since the Unix epoch; 0 without a batch.
    pub unix_ns: [u64; 2],
    /// Why the journal ends; `None` if it is unfinished.
    pub end: Option<pb::End>,
    /// Length of the file up to the end of the last whole batch with its indexes, bytes.
    pub whole_bytes: u64,
    /// Bytes after that, which belong to no whole batch; 0 if the file ends with a summary or with a whole batch.
    pub torn_bytes: u64,
    /// Whether the file has a summary ([`super::seal`]), so that every MCAP tool opens it with an index.
    pub sealed: bool,
    /// Description of the damage at which reading ended; `None` if there is none. Only a reader that stops at damage
    /// sets it ([`JournalReader::up_to_damage`]); others refuse.
    pub damage: Option<String>,
}

impl Survey {
    /// Returns the damage as the end of a message about the journal's content; empty without damage.
    pub(super) fn and_damage(&self) -> String {
        self.damage.as_ref().map_or(String::new(), |damage| format!("; the journal is {damage}"))
    }
}

/// Limit of the waiting changes of the tissue that are read: more than any session lets wait.
const MAX_WAITING: usize = 4096;

/// Length up to which an index is read and discarded rather than skipped by a seek, bytes.
const SHORT: usize = 4096;

/// The next record of a file.
enum NextRecord {
    Chunk(u64),
    DataEnd,
    End,
    /// Description of what is wrong.
    Wrong(String),
}

/// The bytes of a journal: a file or memory that can be read and sought. Every type with these traits has it.
pub trait JournalBytes: Read + Seek + Send {}

impl<T: Read + Seek + Send> JournalBytes for T {}

/// Reader of a journal, whose bytes live for `'s`. It reads batch by batch from the first, and keeps nothing of a
/// batch that it has returned.
pub struct JournalReader<'s> {
    place: String,
    // One reader for every kind of source: it is large, and reads through a buffer.
    source: Box<dyn JournalBytes + 's>,
    length: u64,
    /// Position of the next record, and the numbers of the next batch and the next input.
    at: u64,
    batch: u64,
    input: u64,
    header: pb::Header,
    /// Position of the first chunk.
    begin: u64,
    /// Channel numbers of the topics.
    channels: Vec<(u16, Topic)>,
    torn_bytes: u64,
    sealed: bool,
    ended: bool,
    /// Whether damage ends the journal rather than being an error.
    stops_at_damage: bool,
    damage: Option<String>,
    /// Position of the source: a seek would empty its buffer.
    stands: u64,
    /// Position, kind and length of the newest record whose head was read.
    peeked: Option<(u64, (u8, u64))>,
    /// Charge of the account that pays for its memory; `None` if nothing is charged.
    paid: Option<Taken>,
    /// Memory that stays beside the batch that is read, and the memory of that batch, bytes.
    kept_bytes: u64,
    batch_bytes: u64,
}

impl JournalReader<'static> {
    /// Opens the file of a journal; its path is the name in refusals.
    ///
    /// # Errors
    /// Refuses a path that can't be read or is not a regular file ([`file`]), and what [`JournalReader::new`]
    /// refuses.
    pub fn open(path: &Path) -> Result<Self> {
        JournalReader::new(&path.display().to_string(), file(path)?)
    }
}

/// Opens a regular file from which a journal can be read, with a buffer of 64 KiB. A symbolic link is followed.
///
/// # Errors
/// Refuses a file that is absent or can't be read, and a folder, pipe or device ([`Reason::Unreadable`]).
pub fn file(path: &Path) -> Result<BufReader<File>> {
    let place = path.display().to_string();
    let unreadable = |e: std::io::Error| Refusal {
        place: Some(place.clone()),
        ..Refusal::new(Reason::Unreadable, "", format!("can't be read: {e}"))
    };
    // Checked before it is opened: opening a pipe would wait for a writer.
    let kind = std::fs::metadata(path).map_err(unreadable)?.file_type();
    if !kind.is_file() {
        let what = if kind.is_dir() { "it is a folder" } else { "it is not a file" };
        return Err(unreadable(std::io::Error::other(what)));
    }
    let file = File::open(path).map_err(unreadable)?;
    Ok(BufReader::with_capacity(1 << 16, file))
}

impl<'s> JournalReader<'s> {
    /// Creates a reader and reads the header of the journal. `place` is the name of the file in refusals. The first
    /// batch comes next.
    ///
    /// # Errors
    /// - [`Reason::Unreadable`]: the bytes can't be read, do not begin as an MCAP file, are damaged before the first
    ///   whole batch, or have no valid header.
    /// - [`Reason::Missing`]: the bytes are too short for a journal or have no whole batch, so its session was never
    ///   reported as durable.
    pub fn new(place: &str, source: impl JournalBytes + 's) -> Result<Self> {
        JournalReader::paid(place, source, None)
    }

    /// Creates a reader as [`JournalReader::new`] does, whose memory is charged: `paid` grows and shrinks with what
    /// the reader and the batch that it read last need. `None` charges nothing.
    ///
    /// # Errors
    /// Returns the refusals of [`JournalReader::new`], and refuses memory beyond the account's part
    /// ([`Reason::TooLarge`] or [`Reason::Overloaded`]); later calls of the reader refuse that too.
    pub fn paid(place: &str, source: impl JournalBytes + 's, paid: Option<Taken>) -> Result<Self> {
        let mut source: Box<dyn JournalBytes + 's> = Box::new(source);
        let length = source.seek(SeekFrom::End(0)).map_err(|e| unreadable(place, &e.to_string()))?;
        let mut reader = JournalReader {
            place: place.to_owned(),
            source,
            length,
            at: 0,
            batch: 0,
            input: 0,
            header: pb::Header::default(),
            begin: 0,
            channels: Vec::new(),
            torn_bytes: 0,
            sealed: false,
            ended: false,
            stops_at_damage: false,
            damage: None,
            stands: length,
            peeked: None,
            paid,
            kept_bytes: 0,
            batch_bytes: 0,
        };
        let mut magic = [0; 8];
        let head = if length >= 17 { reader.read_at(0, &mut magic).and_then(|()| reader.head(8))? } else { (0, 0) };
        if magic != MAGIC || head.0 != HEADER || head.1 > 1 << 16 {
            let what = if length < 17 { "it is too short" } else { "it does not begin as an MCAP file" };
            let reason = if length < 17 { Reason::Missing } else { Reason::Unreadable };
            return Err(Refusal { reason, ..unreadable(place, &format!("no journal: {what}")) });
        }
        reader.at = 8 + HEAD + head.1;
        reader.begin = reader.at;
        let begin = reader.at;
        let Some(first) = reader.next_batch()? else {
            let message = "has no whole batch: the server ended before the journal's beginning was on the disk";
            return Err(Refusal { place: Some(place.to_owned()), ..Refusal::new(Reason::Missing, "", message) });
        };
        reader.header = first.header()?;
        reader.kept_bytes = first.memory()?;
        (reader.at, reader.batch, reader.input, reader.torn_bytes, reader.ended) = (begin, 0, 0, 0, false);
        Ok(reader)
    }

    /// Returns the header of the journal: the session, its first scene and tissue, and the run.
    pub fn header(&self) -> &pb::Header {
        &self.header
    }

    /// Returns this reader without the names of files on the machine that wrote the journal (the texture in the
    /// header), which an untrusted party may have sent.
    #[must_use]
    pub fn without_files(mut self) -> Self {
        if let Some(appearance) = &mut self.header.appearance {
            appearance.texture.clear();
        }
        self
    }

    /// Returns this reader so that a journal that is damaged in the middle ends there, rather than being refused;
    /// [`JournalReader::damage`] then has the reason. To continue a session, use a reader that refuses damage. A
    /// damaged header is always refused.
    #[must_use]
    pub fn up_to_damage(self) -> Self {
        JournalReader { stops_at_damage: true, ..self }
    }

    /// Returns a description of the damage at which the journal ended early. `None` if there is none, if the reader
    /// refuses damage, or until [`JournalReader::next_batch`] has returned `None`.
    pub fn damage(&self) -> Option<&str> {
        self.damage.as_deref()
    }

    /// Returns the name of the file in refusals.
    pub fn place(&self) -> &str {
        &self.place
    }

    /// Returns the length of the file when it was opened, bytes.
    pub fn length(&self) -> u64 {
        self.length
    }

    /// Returns the position of the next record, bytes; after the last batch, the end of the last whole batch.
    pub fn position(&self) -> u64 {
        self.at
    }

    /// Returns the number of bytes at the end that belong to no whole batch; 0 until [`JournalReader::next_batch`]
    /// has returned `None`.
    pub fn torn_bytes(&self) -> u64 {
        self.torn_bytes
    }

    /// Returns a refusal of something in the file.
    pub(super) fn refuse(&self, message: &str) -> Refusal {
        unreadable(&self.place, message)
    }

    /// Moves to the batch that has a snapshot: that batch comes next. `snapshot` must come from the survey of this
    /// journal.
    pub fn go_to(&mut self, snapshot: &SnapshotAt) {
        (self.at, self.batch, self.ended, self.torn_bytes) = (snapshot.offset, snapshot.batch, false, 0);
        (self.input, self.damage) = (u64::MAX, None);
    }

    /// Moves to the first batch: that one comes next. [`JournalReader::damage`] and [`JournalReader::torn_bytes`] are
    /// unknown again.
    pub fn rewind(&mut self) {
        (self.at, self.batch, self.input, self.ended, self.torn_bytes) = (self.begin, 0, 0, false, 0);
        self.damage = None;
    }

    /// Returns the bytes before the first batch.
    ///
    /// # Errors
    /// Refuses a file that can't be read.
    pub(super) fn beginning(&mut self) -> Result<Vec<u8>> {
        let mut bytes = self.buffer(self.begin)?;
        self.read_at(0, &mut bytes)?;
        Ok(bytes)
    }

    /// Reads the file once from the beginning, and moves to the first batch again. `progress` gets the position in
    /// the file after each batch, bytes. Returns what the journal has. It takes as long as reading the file.
    ///
    /// # Errors
    /// - [`Reason::Unreadable`]: the file can't be read, is damaged in the middle (unless the reader stops there,
    ///   [`JournalReader::up_to_damage`]), or has a snapshot, an end or a list that can't be decoded.
    /// - [`Reason::TooLarge`] or [`Reason::Overloaded`]: there is no memory for a batch.
    pub fn survey(&mut self, progress: &mut dyn FnMut(u64)) -> Result<Survey> {
        self.rewind();
        let mut survey = Survey { whole_bytes: self.begin, ..Survey::default() };
        while let Some(batch) = self.next_batch()? {
            survey.batches += 1;
            survey.until_step = batch.until_step;
            survey.inputs += batch.input_count;
            survey.hashes += batch.messages.iter().filter(|message| message.0 == Topic::Hashes).count() as u64;
            if batch.has(Topic::Snapshots) {
                for message in batch.all::<SnapshotStep>(Topic::Snapshots) {
                    let step = message?.step;
                    survey.snapshots.push(SnapshotAt { step, offset: batch.offset, batch: batch.number });
                }
            }
            let first = if survey.batches == 1 { batch.unix_ns } else { survey.unix_ns[0] };
            survey.unix_ns = [first, batch.unix_ns];
            survey.end = batch.end()?.or(survey.end);
            if let Some(mut waiting) = batch.waiting()? {
                waiting.inputs.truncate(MAX_WAITING);
                waiting.inputs.shrink_to_fit();
                survey.waiting = waiting.inputs;
            }
            survey.whole_bytes = self.at;
            progress(self.at);
        }
        (survey.torn_bytes, survey.sealed) = (self.torn_bytes, self.sealed);
        survey.damage.clone_from(&self.damage);
        self.rewind();
        Ok(survey)
    }

    /// Reads the file once from the beginning, and moves to the first batch again. Returns what the journal has of the session's exercise:
    /// where its phases were ended before their time, and its result, if it has ended.
    ///
    /// # Errors
    /// Returns the refusals of [`JournalReader::next_batch`], and refuses inputs that can't be decoded.
    pub fn exercise_events(&mut self) -> Result<ExerciseEvents> {
        self.rewind();
        let mut events = ExerciseEvents::default();
        while let (None, Some(batch)) = (&events.result, self.next_batch()?) {
            for input in batch.inputs()? {
                match input.what {
                    Some(pb::input::What::ExerciseResult(result)) => events.result = Some(result),
                    Some(pb::input::What::PhaseEnd(end)) if events.phase_ends.len() < MAX_PHASES => {
                        events.phase_ends.push(PhaseEnd { phase: end.phase, step: input.step });
                    }
                    _ => {}
                }
            }
        }
        self.rewind();
        Ok(events)
    }

    /// Returns the next batch; `None` after the last whole one, also if bytes of a torn batch follow.
    ///
    /// # Errors
    /// - [`Reason::Unreadable`]: the file can't be read, has a message that can't be measured, or is damaged, so that
    ///   a batch is missing that was certainly on the disk. A reader that stops at damage
    ///   ([`JournalReader::up_to_damage`]) returns `None` then.
    /// - [`Reason::TooLarge`] or [`Reason::Overloaded`]: there is no memory for the batch.
    pub fn next_batch(&mut self) -> Result<Option<JournalBatch>> {
        while !self.ended {
            let wrong = match self.next_record()? {
                NextRecord::End | NextRecord::DataEnd => {
                    self.ended = true;
                    break;
                }
                NextRecord::Wrong(what) => what,
                NextRecord::Chunk(size) => {
                    let mut data = self.buffer(size)?;
                    self.read_at(self.at + HEAD, &mut data)?;
                    match self.batch(data) {
                        Ok(batch) => {
                            self.pay(batch.memory()?)?;
                            self.at += HEAD + size;
                            self.batch += 1;
                            self.input = batch.first_input + batch.input_count;
                            self.skip_indexes()?;
                            return Ok(Some(batch));
                        }
                        Err(what) => what,
                    }
                }
            };
            self.ended = true;
            self.judge(&wrong)?;
        }
        Ok(None)
    }

    /// Returns a buffer for `size` bytes of the file, and charges it.
    fn buffer(&mut self, size: u64) -> Result<Vec<u8>> {
        self.pay(size)?;
        let length = usize::try_from(size).unwrap_or(usize::MAX);
        memory::attempt("", || Ok(memory::zeroed(length, "a batch of it")))
            .map_err(|refusal| Refusal { place: Some(self.place.clone()), ..refusal })
    }

    /// Charges the memory of the batch that is read beside the memory that stays, bytes. It replaces that of the
    /// previous batch.
    fn pay(&mut self, bytes: u64) -> Result<()> {
        memory::check(bytes, "a part of a journal")?;
        self.batch_bytes = bytes;
        self.take(0)
    }

    /// Charges memory for what is made of the present batch and lasts no longer than it, bytes.
    ///
    /// # Errors
    /// Refuses memory beyond the account's part.
    pub(super) fn pay_beside(&mut self, bytes: u64) -> Result<()> {
        memory::check(bytes, "a part of a journal")?;
        self.take(bytes)
    }

    fn take(&mut self, beside: u64) -> Result<()> {
        let sum = self.kept_bytes.saturating_add(self.batch_bytes).saturating_add(beside);
        self.paid.as_mut().map_or(Ok(()), |paid| paid.grow_to(sum, ""))
    }

    /// Charges memory for what is made of the journal and lasts as long as this reader, such as a tissue and its
    /// session, bytes.
    ///
    /// # Errors
    /// Refuses memory beyond the account's part.
    pub(super) fn keep(&mut self, bytes: u64) -> Result<()> {
        self.pay_beside(bytes)?;
        self.kept_bytes = self.kept_bytes.saturating_add(bytes);
        Ok(())
    }

    /// Releases the charge of what was made of the journal, because another owner pays for it from now on.
    pub(super) fn let_go(&mut self, bytes: u64) {
        self.kept_bytes = self.kept_bytes.saturating_sub(bytes);
        if let Some(paid) = &mut self.paid {
            paid.shrink_to(self.kept_bytes);
        }
    }

    fn read_at(&mut self, at: u64, into: &mut [u8]) -> Result<()> {
        let sought = if self.stands == at { Ok(at) } else { self.source.seek(SeekFrom::Start(at)) };
        self.stands = u64::MAX;
        let read = sought.and_then(|_| self.source.read_exact(into));
        read.map_err(|e| unreadable(&self.place, &format!("can't be read at byte {at}: {e}")))?;
        self.stands = at + into.len() as u64;
        Ok(())
    }

    /// Returns the kind and the length of the record at a position.
    fn head(&mut self, at: u64) -> Result<(u8, u64)> {
        if let Some((_, head)) = self.peeked.filter(|peeked| peeked.0 == at) {
            // What follows it is read next.
            return Ok(head);
        }
        let mut bytes = [0; HEAD as usize];
        self.read_at(at, &mut bytes)?;
        let head = (bytes[0], number::<8>(&bytes, 1).unwrap_or_default());
        self.peeked = Some((at, head));
        Ok(head)
    }

    fn next_record(&mut self) -> Result<NextRecord> {
        let left = self.length.saturating_sub(self.at);
        if left == 0 {
            return Ok(NextRecord::End);
        }
        if left < HEAD {
            return Ok(NextRecord::Wrong("a record is cut off".to_owned()));
        }
        let (kind, length) = self.head(self.at)?;
        Ok(match kind {
            CHUNK if length > left - HEAD => NextRecord::Wrong("a chunk is cut off".to_owned()),
            CHUNK if length > MAX_BYTES => {
                NextRecord::Wrong(format!("a chunk has {length} bytes, more than {MAX_BYTES}"))
            }
            CHUNK if length < CHUNK_HEAD => NextRecord::Wrong("a chunk is too short".to_owned()),
            CHUNK => NextRecord::Chunk(length),
            DATA_END if length == 4 => {
                // The last record is the footer, and the file ends with the bytes with which it began.
                let mut magic = [0; 8];
                if left > HEAD + 4 + 8 {
                    self.read_at(self.length - 8, &mut magic)?;
                }
                self.sealed = magic == MAGIC;
                NextRecord::DataEnd
            }
            kind => NextRecord::Wrong(format!("there is a record of kind {kind}, where a chunk should be")),
        })
    }

    /// Skips the indexes after a chunk, as far as they are whole.
    fn skip_indexes(&mut self) -> Result<()> {
        while self.length.saturating_sub(self.at) >= HEAD {
            let (kind, length) = self.head(self.at)?;
            if kind != MESSAGE_INDEX || length > self.length - self.at - HEAD {
                break;
            }
            if length <= SHORT as u64 {
                let mut index = [0; SHORT];
                self.read_at(self.at + HEAD, &mut index[..length as usize])?;
            }
            self.at += HEAD + length;
        }
        Ok(())
    }

    /// Returns the batch in a chunk, or a description of what is wrong with it.
    fn batch(&mut self, data: Vec<u8>) -> std::result::Result<JournalBatch, String> {
        let messages = messages_of(&data, if self.batch == 0 { None } else { Some(&self.channels) })?;
        if let Some(channels) = messages.channels {
            self.channels = channels;
        }
        let head = messages.head.ok_or("a chunk has no inputs")?;
        if head.batch != self.batch {
            return Err(format!("there is batch {}, where batch {} should be", head.batch, self.batch));
        }
        if self.input != u64::MAX && head.first_input != self.input {
            return Err(format!("there is input {}, where input {} should be", head.first_input, self.input));
        }
        if head.first_input.checked_add(head.input_count).is_none() {
            return Err("the number of an input is too large".to_owned());
        }
        Ok(JournalBatch {
            number: head.batch,
            offset: self.at,
            until_step: head.until_step,
            durable_batches: head.durable_batches,
            first_input: head.first_input,
            input_count: head.input_count,
            unix_ns: messages.unix_ns,
            place: self.place.clone(),
            data,
            messages: messages.found,
            places: messages.places,
        })
    }

    /// Decides whether an invalid record is damage, which is an error, or a torn end.
    fn judge(&mut self, what: &str) -> Result<()> {
        let (at, batch) = (self.at, self.batch);
        let later = self.find_durable(at + 1, batch)?;
        if batch == 0 && self.channels.is_empty() && self.find_any(at + 1)? {
            return Err(self.refuse(&format!("damaged at byte {at}, in its header: {what}")));
        }
        if let Some(found) = later {
            let message = format!(
                "damaged at byte {at}, in batch {batch}: {what}; batch {} at byte {} says that it had been on the disk",
                found.0, found.1
            );
            if !self.stops_at_damage {
                return Err(self.refuse(&message));
            }
            self.damage = Some(message);
        }
        self.torn_bytes = self.length - at;
        Ok(())
    }

    /// Returns the number and the position of a later batch that says that batch `wanted` was certainly on the
    /// disk, if there is one.
    fn find_durable(&mut self, from: u64, wanted: u64) -> Result<Option<(u64, u64)>> {
        let channels = std::mem::take(&mut self.channels);
        let found = self.find_chunk(from, &mut |data| {
            let head = messages_of(data, Some(&channels)).ok().and_then(|messages| messages.head)?;
            (head.batch > wanted && head.durable_batches > wanted).then_some(head.batch)
        });
        self.channels = channels;
        found
    }

    /// Returns whether there is any whole chunk at or after `from`.
    fn find_any(&mut self, from: u64) -> Result<bool> {
        Ok(self.find_chunk(from, &mut |_| Some(0))?.is_some())
    }

    /// Returns the first whole chunk at or after `from` that `wanted` accepts, with its position.
    fn find_chunk(&mut self, from: u64, wanted: &mut dyn FnMut(&[u8]) -> Option<u64>) -> Result<Option<(u64, u64)>> {
        const WINDOW: u64 = 1 << 16;
        let mut window = vec![0; (WINDOW + HEAD + CHUNK_HEAD) as usize];
        // Limits the reading of bytes that only look like chunks.
        let mut budget = 4 * (self.length - from.min(self.length)) + (1 << 20);
        let mut at = from;
        while at + HEAD + CHUNK_HEAD <= self.length {
            let size = (self.length - at).min(window.len() as u64) as usize;
            self.read_at(at, &mut window[..size])?;
            let most = (size as u64 - HEAD - CHUNK_HEAD).min(WINDOW - 1);
            let mut next = at + most + 1;
            for place in 0..=most {
                let head = &window[place as usize..][..(HEAD + CHUNK_HEAD) as usize];
                let Some(length) = plain_chunk(head).filter(|length| *length <= self.length - at - place - HEAD) else {
                    continue;
                };
                if length > budget.min(MAX_BYTES) {
                    continue;
                }
                budget -= length;
                let mut data = self.buffer(length)?;
                self.read_at(at + place + HEAD, &mut data)?;
                if is_sound(&data) {
                    if let Some(found) = wanted(&data) {
                        return Ok(Some((found, at + place)));
                    }
                    next = at + place + HEAD + length;
                    break;
                }
            }
            at = next;
        }
        Ok(None)
    }
}

/// The step of a snapshot, without the rest of it.
#[derive(Clone, PartialEq, Message)]
struct SnapshotStep {
    #[prost(uint64, tag = "1")]
    step: u64,
}

fn unreadable(place: &str, message: &str) -> Refusal {
    Refusal { place: Some(place.to_owned()), ..Refusal::new(Reason::Unreadable, "", message) }
}

/// Returns the length of a chunk that is not compressed, if `head` begins one.
fn plain_chunk(head: &[u8]) -> Option<u64> {
    if head[0] != CHUNK {
        return None;
    }
    let length = number::<8>(head, 1)?;
    let size = length.checked_sub(CHUNK_HEAD)?;
    let [plain, packed] = [25, 41].map(|at| number::<8>(head, at));
    (plain == Some(size) && packed == Some(size) && number::<4>(head, 37) == Some(0)).then_some(length)
}

/// Returns whether the checksum of a chunk matches its messages.
fn is_sound(data: &[u8]) -> bool {
    number::<4>(data, 24) == Some(u64::from(crc32fast::hash(&data[CHUNK_HEAD as usize..])))
}

/// The first fields of a message `Inputs`.
#[derive(Debug, Default)]
struct InputsHead {
    batch: u64,
    until_step: u64,
    durable_batches: u64,
    first_input: u64,
    input_count: u64,
}

impl InputsHead {
    /// Reads the numbers, and counts the inputs, so that their memory is known before they are decoded.
    fn read(mut bytes: &[u8]) -> Option<Self> {
        let mut head = InputsHead::default();
        while !bytes.is_empty() {
            let key = varint(&mut bytes)?;
            match (key >> 3, key & 7) {
                (field @ 1..=4, 0) => {
                    let value = varint(&mut bytes)?;
                    match field {
                        1 => head.batch = value,
                        2 => head.until_step = value,
                        3 => head.durable_batches = value,
                        _ => head.first_input = value,
                    }
                }
                (5, 2) => {
                    let length = usize::try_from(varint(&mut bytes)?).ok()?;
                    bytes = bytes.get(length..)?;
                    head.input_count += 1;
                }
                _ => return None,
            }
        }
        (head.input_count <= MAX_INPUTS as u64).then_some(head)
    }
}

/// Content of a chunk.
struct Messages {
    found: Vec<(Topic, Range<usize>)>,
    places: Vec<(u16, u64, u64)>,
    head: Option<InputsHead>,
    unix_ns: u64,
    /// The channels that it defines.
    channels: Option<Vec<(u16, Topic)>>,
}

/// Limit of the messages and channels of a chunk: a writer makes few.
const MAX_MESSAGES: usize = 1 << 16;

/// Returns the messages of a chunk. `channels` are the known ones, if the chunk does not define them itself.
fn messages_of(data: &[u8], channels: Option<&[(u16, Topic)]>) -> std::result::Result<Messages, String> {
    let cut_off = || "a record within a chunk is cut off".to_owned();
    let size = (data.len() as u64).saturating_sub(CHUNK_HEAD);
    let sizes = [number::<8>(data, 16), number::<8>(data, 32)];
    if number::<4>(data, 28) != Some(0) {
        return Err("a chunk is compressed; `mcap decompress` of the MCAP tools makes it readable".to_owned());
    }
    if sizes != [Some(size); 2] {
        return Err("a chunk has another size than it says".to_owned());
    }
    if !is_sound(data) {
        return Err("the checksum of a chunk is wrong".to_owned());
    }
    let (mut found, mut head, mut unix_ns, mut defined) = (Vec::new(), None, 0, Vec::new());
    let mut places = Vec::new();
    let mut at = CHUNK_HEAD as usize;
    while at < data.len() {
        let kind = data[at];
        let length = number::<8>(data, at + 1).ok_or_else(cut_off)?;
        let begin = at + HEAD as usize;
        let end = usize::try_from(length).ok().and_then(|length| begin.checked_add(length));
        let end = end.filter(|end| *end <= data.len()).ok_or_else(cut_off)?;
        match kind {
            SCHEMA => {}
            CHANNEL => {
                let body = mcap::parse_record(CHANNEL, &data[begin..end]);
                let Ok(mcap::records::Record::Channel(channel)) = body else {
                    return Err("a channel can't be read".to_owned());
                };
                let topic = Topic::ALL.into_iter().find(|topic| topic.name() == channel.topic);
                defined.extend(topic.map(|topic| (channel.id, topic)));
            }
            MESSAGE => {
                let channel = number::<2>(data, begin).filter(|_| begin + MESSAGE_HEAD <= end).ok_or_else(cut_off)?;
                let known = channels.unwrap_or(&defined);
                let topic = known.iter().find(|known| u64::from(known.0) == channel).map(|known| known.1);
                unix_ns = number::<8>(data, begin + 6).unwrap_or_default();
                #[allow(clippy::cast_possible_truncation)]
                places.push((channel as u16, unix_ns, at as u64 - CHUNK_HEAD));
                // Channels of later versions are ignored.
                if let Some(topic) = topic {
                    let range = begin + MESSAGE_HEAD..end;
                    if topic == Topic::Inputs {
                        let read = InputsHead::read(&data[range.clone()]);
                        if head.replace(read.ok_or("inputs can't be decoded")?).is_some() {
                            return Err("a chunk has inputs twice".to_owned());
                        }
                    }
                    found.push((topic, range));
                }
            }
            kind => return Err(format!("a chunk has a record of kind {kind}")),
        }
        if places.len() + defined.len() > MAX_MESSAGES {
            return Err("a chunk has too many messages".to_owned());
        }
        at = end;
    }
    places.sort_by_key(|(channel, ..)| *channel);
    Ok(Messages { found, places, head, unix_ns, channels: channels.is_none().then_some(defined) })
}
