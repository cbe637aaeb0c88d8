//! Reads a journal batch by batch, whatever has happened to its file.
//!
//! A record that is not as a writer makes it is looked at in the light of what follows it. If a later batch says that the
//! one here was on the disk for certain, the file is damaged: that is an error, which names the place. Otherwise the file is
//! torn here: what follows had not reached the disk, and the journal ends with the batch before.
//!
//! A chunk's checksum finds every single bit that is other than it was written. What is outside chunks (records' lengths, indexes,
//! the summary) decides nothing but where chunks are, and their numbers have no gap.
//!
//! What a batch takes in memory is known, and taken from the account of who pays, before its messages are decoded.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::Path;

use palpate_proto::journal as pb;
use palpate_proto::measure::{self, memory_of, varint};
use prost::Message;

use super::format::{MAX_BYTES, MAX_INPUTS, Topic};
use super::message::fill_tips;
use super::records::{
    CHANNEL, CHUNK, CHUNK_HEAD, DATA_END, HEAD, HEADER, MAGIC, MESSAGE, MESSAGE_HEAD, MESSAGE_INDEX, SCHEMA, number,
};
use crate::budget::Taken;
use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::memory;

/// A batch, whose messages are decoded when they are asked for.
#[derive(Debug, Clone)]
pub struct JournalBatch {
    /// Its number.
    pub number: u64,
    /// Where its chunk begins in the file.
    pub offset: u64,
    /// The file is complete up to this step.
    pub until_step: u64,
    /// Batches that were on the disk for certain when it was written.
    pub durable_batches: u64,
    /// Inputs in the batches before.
    pub first_input: u64,
    /// Inputs in it.
    pub input_count: u64,
    /// Time at which it was written.
    pub unix_ns: u64,
    place: String,
    data: Vec<u8>,
    messages: Vec<(Topic, Range<usize>)>,
    /// Channel, time and place of each message, also of those that are not known here.
    places: Vec<(u16, u64, u64)>,
}

/// What the inputs of a batch may take in memory whatever their length, bytes: there are no more of them than [`MAX_INPUTS`], in a
/// vector that has grown.
const INPUTS_ROOM: usize = 2 * MAX_INPUTS * size_of::<pb::Input>();

/// What a message takes beside what it refers to, in the lists in which it waits, bytes.
const MESSAGE_BYTES: usize = 1024;

impl JournalBatch {
    /// What it takes when all of its messages are decoded, bytes.
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
            // As messages, and as the list of what acts in order, whose entries are larger.
            sum = sum.saturating_add(3 * memory + MESSAGE_BYTES);
        }
        Ok(sum as u64)
    }

    /// Each message of a topic, decoded.
    fn all<M: Message + Default>(&self, topic: Topic) -> impl Iterator<Item = Result<M>> + '_ {
        let of_topic = self.messages.iter().filter(move |message| message.0 == topic);
        of_topic.map(move |(_, range)| {
            M::decode(&self.data[range.clone()])
                .map_err(|e| self.refuse(format!("a message {} can't be decoded: {e}", topic.name())))
        })
    }

    /// Each of its messages that is known here, as it was written, in order.
    pub(super) fn messages(&self) -> impl Iterator<Item = (Topic, &[u8])> {
        self.messages.iter().map(|(topic, range)| (*topic, &self.data[range.clone()]))
    }

    /// The content of its chunk.
    pub(super) fn data(&self) -> &[u8] {
        &self.data
    }

    /// The index of its chunk.
    pub(super) fn places(&self) -> &[(u16, u64, u64)] {
        &self.places
    }

    /// A refusal of something in it.
    pub(super) fn refuse(&self, message: String) -> Refusal {
        self.placed(Refusal::new(Reason::Unreadable, "", message))
    }

    /// A refusal with the place of this batch.
    pub(super) fn placed(&self, refusal: Refusal) -> Refusal {
        let JournalBatch { number, offset, until_step, .. } = self;
        let field = if refusal.field.is_empty() { String::new() } else { format!("{}: ", refusal.field) };
        let message = format!("batch {number} at byte {offset}, up to step {until_step}: {field}{}", refusal.message);
        Refusal { place: Some(self.place.clone()), message, field: String::new(), ..refusal }
    }

    /// Returns its inputs, in order.
    ///
    /// # Errors
    /// Refuses what can't be decoded.
    pub fn inputs(&self) -> Result<Vec<pb::Input>> {
        let mut inputs = Vec::new();
        for message in self.all::<pb::Inputs>(Topic::Inputs) {
            inputs = message?.inputs;
        }
        fill_tips(&mut inputs).map_err(|refusal| self.placed(refusal))?;
        Ok(inputs)
    }

    /// Returns its hashes, in order.
    ///
    /// # Errors
    /// Refuses what can't be decoded.
    pub fn hashes(&self) -> Result<Vec<pb::Hash>> {
        self.all(Topic::Hashes).collect()
    }

    /// Returns its snapshots, in order.
    ///
    /// # Errors
    /// Refuses what can't be decoded.
    pub fn snapshots(&self) -> Result<Vec<pb::Snapshot>> {
        self.all(Topic::Snapshots).collect()
    }

    /// Returns what tools felt.
    ///
    /// # Errors
    /// Refuses what can't be decoded.
    pub fn felt(&self) -> Result<Vec<pb::Moment>> {
        let messages: Result<Vec<pb::Felt>> = self.all(Topic::Felt).collect();
        Ok(messages?.into_iter().flat_map(|felt| felt.moments).collect())
    }

    /// Returns the newest message of it that tells which changes of the tissue wait.
    ///
    /// # Errors
    /// Refuses what can't be decoded.
    pub fn waiting(&self) -> Result<Option<pb::Waiting>> {
        self.all(Topic::Waiting).last().transpose()
    }

    /// Returns the end of the journal, if it is in this batch.
    ///
    /// # Errors
    /// Refuses what can't be decoded.
    pub fn end(&self) -> Result<Option<pb::End>> {
        self.all(Topic::End).next().transpose()
    }

    /// The header, which is in the first batch.
    fn header(&self) -> Result<pb::Header> {
        self.all(Topic::Header).next().unwrap_or_else(|| Err(self.refuse("the header is missing".to_owned())))
    }

    /// Returns whether it has messages of a topic.
    pub fn has(&self, topic: Topic) -> bool {
        self.messages.iter().any(|message| message.0 == topic)
    }
}

/// Where a snapshot is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SnapshotAt {
    /// Steps done.
    pub step: u64,
    /// Where its chunk begins.
    pub offset: u64,
    /// The number of its batch.
    pub batch: u64,
}

/// What a journal has, after one pass over it.
#[derive(Debug, Clone, Default)]
pub struct Survey {
    /// Batches.
    pub batches: u64,
    /// The file is complete up to this step: the last durable one.
    pub until_step: u64,
    /// Inputs.
    pub inputs: u64,
    /// Hashes.
    pub hashes: u64,
    /// Snapshots, by ascending step.
    pub snapshots: Vec<SnapshotAt>,
    /// Changes of the tissue that had been accepted at its end, and may have acted by then.
    pub waiting: Vec<pb::Input>,
    /// Times of the first and the last batch.
    pub unix_ns: [u64; 2],
    /// The end, if it was written.
    pub end: Option<pb::End>,
    /// Bytes up to the end of the last whole batch.
    pub whole_bytes: u64,
    /// Bytes after that which belong to no whole batch.
    pub torn_bytes: u64,
    /// Whether the file has a summary, so that every tool opens it.
    pub sealed: bool,
    /// Why reading ended before the end, if the file is damaged there and is read [up to that](JournalReader::up_to_damage).
    pub damage: Option<String>,
}

impl Survey {
    /// The damage, to follow the words on what the journal has; empty without.
    pub(super) fn and_damage(&self) -> String {
        self.damage.as_ref().map_or(String::new(), |damage| format!("; the journal is {damage}"))
    }
}

/// Changes of the tissue that wait, at most: more than any session lets wait.
const MAX_WAITING: usize = 4096;

/// An index is read over, not sought over, if it has no more bytes.
const SHORT: usize = 4096;

/// What comes next in a file.
enum NextRecord {
    Chunk(u64),
    DataEnd,
    End,
    /// What is wrong.
    Wrong(String),
}

/// Reads a journal. It takes the memory of one batch.
pub struct JournalReader<R> {
    place: String,
    source: R,
    length: u64,
    /// Where the next record begins, and the number of the next batch and input.
    at: u64,
    batch: u64,
    input: u64,
    header: pb::Header,
    /// Where the first chunk begins.
    begin: u64,
    /// Channel numbers of the topics.
    channels: Vec<(u16, Topic)>,
    torn_bytes: u64,
    sealed: bool,
    ended: bool,
    /// Damage ends the journal in place of being an error.
    stops_at_damage: bool,
    damage: Option<String>,
    /// Where the source stands: to seek empties its buffer.
    stands: u64,
    /// The newest head of a record that was read, and where it is.
    peeked: Option<(u64, (u8, u64))>,
    /// What is taken from who pays for its memory. `None`: it is the user's own.
    paid: Option<Taken>,
    /// What stays in memory beside the batch that is read, and what that takes, bytes.
    kept_bytes: u64,
    batch_bytes: u64,
}

impl JournalReader<BufReader<File>> {
    /// Opens a file.
    ///
    /// # Errors
    /// Refuses a file that can't be read, and as [`JournalReader::new`] does.
    pub fn open(path: &Path) -> Result<Self> {
        JournalReader::new(&path.display().to_string(), file(path)?)
    }
}

/// Returns a file to read a journal from.
///
/// # Errors
/// Refuses one that can't be read.
pub fn file(path: &Path) -> Result<BufReader<File>> {
    let place = path.display().to_string();
    let unreadable = |e: std::io::Error| Refusal {
        place: Some(place.clone()),
        ..Refusal::new(Reason::Unreadable, "", format!("can't be read: {e}"))
    };
    // Before it is opened: a pipe would wait for somebody who writes into it.
    let kind = std::fs::metadata(path).map_err(unreadable)?.file_type();
    if !kind.is_file() {
        let what = if kind.is_dir() { "it is a folder" } else { "it is not a file" };
        return Err(unreadable(std::io::Error::other(what)));
    }
    let file = File::open(path).map_err(unreadable)?;
    Ok(BufReader::with_capacity(1 << 16, file))
}

impl<R: Read + Seek> JournalReader<R> {
    /// Reads the beginning of a journal; `place` is what refusals call it.
    ///
    /// # Errors
    /// Refuses what is no journal, and one without a whole batch ([`Reason::Missing`]): then its session was never told to be
    /// durable.
    pub fn new(place: &str, source: R) -> Result<Self> {
        JournalReader::paid(place, source, None)
    }

    /// Does the same, for somebody who pays for its memory: `paid` grows by it.
    ///
    /// # Errors
    /// As for [`JournalReader::new`]; refuses what is beyond the part of who pays.
    pub fn paid(place: &str, mut source: R, paid: Option<Taken>) -> Result<Self> {
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

    /// Returns the header.
    pub fn header(&self) -> &pb::Header {
        &self.header
    }

    /// Reads a journal of a stranger: what it names of this machine is left out.
    #[must_use]
    pub fn without_files(mut self) -> Self {
        if let Some(appearance) = &mut self.header.appearance {
            appearance.texture.clear();
        }
        self
    }

    /// Reads what is whole: a journal that is damaged in the middle ends there, and [`JournalReader::damage`] tells why. Who
    /// goes on with a session wants an error.
    #[must_use]
    pub fn up_to_damage(self) -> Self {
        JournalReader { stops_at_damage: true, ..self }
    }

    /// Returns why the last batch is not that of the journal, if it is damaged behind it; known after that batch.
    pub fn damage(&self) -> Option<&str> {
        self.damage.as_deref()
    }

    /// Returns what refusals call the file.
    pub fn place(&self) -> &str {
        &self.place
    }

    /// Returns the length of the file, bytes.
    pub fn length(&self) -> u64 {
        self.length
    }

    /// Returns how much of it was read, bytes.
    pub fn position(&self) -> u64 {
        self.at
    }

    /// Returns the bytes at the end that belong to no whole batch; known after the last batch.
    pub fn torn_bytes(&self) -> u64 {
        self.torn_bytes
    }

    /// A refusal of something in the file.
    pub(super) fn refuse(&self, message: &str) -> Refusal {
        unreadable(&self.place, message)
    }

    /// Goes to where a batch is that holds a snapshot: the next batch will be that one.
    pub fn go_to(&mut self, snapshot: &SnapshotAt) {
        (self.at, self.batch, self.ended, self.torn_bytes) = (snapshot.offset, snapshot.batch, false, 0);
        (self.input, self.damage) = (u64::MAX, None);
    }

    /// Goes back to the first batch.
    pub fn rewind(&mut self) {
        (self.at, self.batch, self.input, self.ended, self.torn_bytes) = (self.begin, 0, 0, false, 0);
        self.damage = None;
    }

    /// The bytes before the first batch.
    ///
    /// # Errors
    /// Refuses a file that can't be read.
    pub(super) fn beginning(&mut self) -> Result<Vec<u8>> {
        let mut bytes = self.buffer(self.begin)?;
        self.read_at(0, &mut bytes)?;
        Ok(bytes)
    }

    /// Passes over the file once, from its beginning, which is where it is afterwards. `progress` gets the bytes
    /// that are read.
    ///
    /// # Errors
    /// Refuses a file that is damaged in the middle, unless it is read [up to that](JournalReader::up_to_damage).
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

    /// Returns the next batch; `None` after the last whole one.
    ///
    /// # Errors
    /// Refuses a file that is damaged before its end, unless it is read [up to that](JournalReader::up_to_damage).
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

    /// Memory for so many bytes of the file, which has them.
    fn buffer(&mut self, size: u64) -> Result<Vec<u8>> {
        self.pay(size)?;
        let length = usize::try_from(size).unwrap_or(usize::MAX);
        memory::attempt("", || Ok(memory::zeroed(length, "a batch of it")))
            .map_err(|refusal| Refusal { place: Some(self.place.clone()), ..refusal })
    }

    /// Takes what is needed at once beside what is kept, bytes. What was taken for the batch before is used for this one.
    fn pay(&mut self, bytes: u64) -> Result<()> {
        memory::check(bytes, "a part of a journal")?;
        self.batch_bytes = bytes;
        self.take(0)
    }

    /// Takes what is made of the batch that was read, and lasts no longer than it, bytes.
    ///
    /// # Errors
    /// Refuses what is beyond the part of who pays.
    pub(super) fn pay_beside(&mut self, bytes: u64) -> Result<()> {
        memory::check(bytes, "a part of a journal")?;
        self.take(bytes)
    }

    fn take(&mut self, beside: u64) -> Result<()> {
        let sum = self.kept_bytes.saturating_add(self.batch_bytes).saturating_add(beside);
        self.paid.as_mut().map_or(Ok(()), |paid| paid.grow_to(sum, ""))
    }

    /// Takes what is made of the journal and stays as long as this reader, bytes: a tissue and its session.
    ///
    /// # Errors
    /// Refuses what is beyond the part of who pays.
    pub(super) fn keep(&mut self, bytes: u64) -> Result<()> {
        self.pay_beside(bytes)?;
        self.kept_bytes = self.kept_bytes.saturating_add(bytes);
        Ok(())
    }

    /// What was made of the journal is paid for by others from now on.
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

    /// Kind and length of the record at a place.
    fn head(&mut self, at: u64) -> Result<(u8, u64)> {
        if let Some((_, head)) = self.peeked.filter(|peeked| peeked.0 == at) {
            // What follows is read next.
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
                // The last record is the footer, and the file ends as it began.
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

    /// What a chunk has, or what is wrong with it.
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

    /// Decides what is wrong: damage, which is an error, or a torn end.
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

    /// A later batch which says that batch `wanted` was on the disk for certain: its number, and where it is.
    fn find_durable(&mut self, from: u64, wanted: u64) -> Result<Option<(u64, u64)>> {
        let channels = std::mem::take(&mut self.channels);
        let found = self.find_chunk(from, &mut |data| {
            let head = messages_of(data, Some(&channels)).ok().and_then(|messages| messages.head)?;
            (head.batch > wanted && head.durable_batches > wanted).then_some(head.batch)
        });
        self.channels = channels;
        found
    }

    /// Whether there is any whole chunk.
    fn find_any(&mut self, from: u64) -> Result<bool> {
        Ok(self.find_chunk(from, &mut |_| Some(0))?.is_some())
    }

    /// The first whole chunk at or after `from` that `wanted` accepts, with its place.
    fn find_chunk(&mut self, from: u64, wanted: &mut dyn FnMut(&[u8]) -> Option<u64>) -> Result<Option<(u64, u64)>> {
        const WINDOW: u64 = 1 << 16;
        let mut window = vec![0; (WINDOW + HEAD + CHUNK_HEAD) as usize];
        // What looks like chunks and is none is not read for ever.
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

/// The length of a chunk that is not compressed, if `head` begins one.
fn plain_chunk(head: &[u8]) -> Option<u64> {
    if head[0] != CHUNK {
        return None;
    }
    let length = number::<8>(head, 1)?;
    let size = length.checked_sub(CHUNK_HEAD)?;
    let [plain, packed] = [25, 41].map(|at| number::<8>(head, at));
    (plain == Some(size) && packed == Some(size) && number::<4>(head, 37) == Some(0)).then_some(length)
}

/// Whether the checksum of a chunk is that of its messages.
fn is_sound(data: &[u8]) -> bool {
    number::<4>(data, 24) == Some(u64::from(crc32fast::hash(&data[CHUNK_HEAD as usize..])))
}

/// The beginning of a message `Inputs`.
#[derive(Debug, Default)]
struct InputsHead {
    batch: u64,
    until_step: u64,
    durable_batches: u64,
    first_input: u64,
    input_count: u64,
}

impl InputsHead {
    /// Reads the numbers, and counts the inputs: so their memory is known before they are decoded.
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

/// What is in a chunk.
struct Messages {
    found: Vec<(Topic, Range<usize>)>,
    places: Vec<(u16, u64, u64)>,
    head: Option<InputsHead>,
    unix_ns: u64,
    /// The channels that it defines.
    channels: Option<Vec<(u16, Topic)>>,
}

/// Most messages of a chunk, and records: a writer makes few.
const MAX_MESSAGES: usize = 1 << 16;

/// The messages of a chunk; `channels` are those that are known, if it does not define them itself.
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
                // Channels of later versions are passed over.
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
