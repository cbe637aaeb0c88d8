//! Records of MCAP, as journals have them: written by hand, so that a file needs no writer that stays.
//!
//! A record is its kind (a byte), the length of its content (8 bytes) and the content; numbers are little-endian.

/// What a file begins and ends with.
pub const MAGIC: [u8; 8] = [0x89, b'M', b'C', b'A', b'P', 0x30, b'\r', b'\n'];

/// Kinds of records.
pub const HEADER: u8 = 0x01;
/// The end of the file.
pub const FOOTER: u8 = 0x02;
/// What a message means.
pub const SCHEMA: u8 = 0x03;
/// A topic.
pub const CHANNEL: u8 = 0x04;
/// A message.
pub const MESSAGE: u8 = 0x05;
/// Some messages with a checksum.
pub const CHUNK: u8 = 0x06;
/// Where the messages of a chunk are.
pub const MESSAGE_INDEX: u8 = 0x07;
/// Where a chunk is.
pub const CHUNK_INDEX: u8 = 0x08;
/// How many messages there are.
pub const STATISTICS: u8 = 0x0B;
/// Where the parts of the summary are.
pub const SUMMARY_OFFSET: u8 = 0x0E;
/// The end of the data.
pub const DATA_END: u8 = 0x0F;

/// Bytes before the content of a record.
pub const HEAD: u64 = 9;

/// Bytes of a chunk before its messages, if it is not compressed.
pub const CHUNK_HEAD: u64 = 40;

/// Bytes of a message before its data.
pub const MESSAGE_HEAD: usize = 22;

/// Appends a record whose content `fill` writes.
pub fn record(out: &mut Vec<u8>, kind: u8, fill: impl FnOnce(&mut Vec<u8>)) {
    out.push(kind);
    let at = out.len();
    out.extend([0; 8]);
    fill(out);
    let length = (out.len() - at - 8) as u64;
    out[at..at + 8].copy_from_slice(&length.to_le_bytes());
}

/// Appends a string with its length.
pub fn string(out: &mut Vec<u8>, text: &str) {
    bytes(out, text.as_bytes());
}

/// Appends bytes with their length, which is below 2³².
#[allow(clippy::cast_possible_truncation)]
pub fn bytes(out: &mut Vec<u8>, bytes: &[u8]) {
    out.extend((bytes.len() as u32).to_le_bytes());
    out.extend(bytes);
}

/// Returns what a file begins with.
pub fn beginning(library: &str) -> Vec<u8> {
    let mut out = MAGIC.to_vec();
    record(&mut out, HEADER, |body| {
        string(body, "palpate");
        string(body, library);
    });
    out
}

/// A chunk that is being filled: messages of one moment.
#[derive(Debug)]
pub struct Chunk {
    out: Vec<u8>,
    unix_ns: u64,
    sequence: u32,
    /// Channel and place of each message.
    index: Vec<(u16, u64)>,
}

impl Chunk {
    /// Begins a chunk; all its messages have this time and number. `first` is put before them: schemas and channels.
    pub fn new(unix_ns: u64, sequence: u32, first: &[u8]) -> Self {
        let mut out = vec![0; (HEAD + CHUNK_HEAD) as usize];
        out.extend(first);
        Chunk { out, unix_ns, sequence, index: Vec::new() }
    }

    /// Adds a message.
    pub fn add(&mut self, channel: u16, data: &[u8]) {
        self.index.push((channel, self.out.len() as u64 - HEAD - CHUNK_HEAD));
        let Chunk { out, unix_ns, sequence, .. } = self;
        record(out, MESSAGE, |body| {
            body.extend(channel.to_le_bytes());
            body.extend(sequence.to_le_bytes());
            body.extend(unix_ns.to_le_bytes());
            body.extend(unix_ns.to_le_bytes());
            body.extend(data);
        });
    }

    /// Returns the chunk, and the index of its messages.
    pub fn finish(self) -> Vec<u8> {
        let Chunk { mut out, unix_ns, mut index, .. } = self;
        let size = out.len() as u64 - HEAD - CHUNK_HEAD;
        let crc = crc32fast::hash(&out[(HEAD + CHUNK_HEAD) as usize..]);
        let mut head = vec![CHUNK];
        head.extend((size + CHUNK_HEAD).to_le_bytes());
        head.extend(unix_ns.to_le_bytes());
        head.extend(unix_ns.to_le_bytes());
        head.extend(size.to_le_bytes());
        head.extend(crc.to_le_bytes());
        string(&mut head, "");
        head.extend(size.to_le_bytes());
        out[..head.len()].copy_from_slice(&head);
        index.sort_by_key(|(channel, _)| *channel);
        let index: Vec<_> = index.into_iter().map(|(channel, at)| (channel, unix_ns, at)).collect();
        indexes(&mut out, &index);
        out
    }
}

/// Appends the index of a chunk: channel, time and place of each of its messages, by ascending channel.
#[allow(clippy::cast_possible_truncation)]
pub fn indexes(out: &mut Vec<u8>, messages: &[(u16, u64, u64)]) {
    for of_channel in messages.chunk_by(|a, b| a.0 == b.0) {
        record(out, MESSAGE_INDEX, |body| {
            body.extend(of_channel[0].0.to_le_bytes());
            body.extend((16 * of_channel.len() as u32).to_le_bytes());
            for (_, unix_ns, at) in of_channel {
                body.extend(unix_ns.to_le_bytes());
                body.extend(at.to_le_bytes());
            }
        });
    }
}

/// Returns a whole number at a place, if there are enough bytes.
pub fn number<const N: usize>(bytes: &[u8], at: usize) -> Option<u64> {
    let mut whole = [0; 8];
    whole[..N].copy_from_slice(bytes.get(at..at + N)?);
    Some(u64::from_le_bytes(whole))
}
