//! Records of MCAP as journals have them. They are written here, so that a file needs no writer that stays open.
//!
//! A record is its kind (a byte), the length of its content (8 bytes) and the content; numbers are little-endian.

/// First and last bytes of a file.
pub const MAGIC: [u8; 8] = [0x89, b'M', b'C', b'A', b'P', 0x30, b'\r', b'\n'];

/// Kind of the record that begins a file.
pub const HEADER: u8 = 0x01;
/// Kind of the record that ends a file.
pub const FOOTER: u8 = 0x02;
/// Kind of a record with a schema: the type of a message.
pub const SCHEMA: u8 = 0x03;
/// Kind of a record with a channel: a topic and its schema.
pub const CHANNEL: u8 = 0x04;
/// Kind of a record with a message.
pub const MESSAGE: u8 = 0x05;
/// Kind of a record with a chunk: messages with a checksum.
pub const CHUNK: u8 = 0x06;
/// Kind of a record with the positions of a chunk's messages.
pub const MESSAGE_INDEX: u8 = 0x07;
/// Kind of a record with the position of a chunk.
pub const CHUNK_INDEX: u8 = 0x08;
/// Kind of a record with the numbers of messages, channels and chunks.
pub const STATISTICS: u8 = 0x0B;
/// Kind of a record with the position of a part of the summary.
pub const SUMMARY_OFFSET: u8 = 0x0E;
/// Kind of the record that ends the data.
pub const DATA_END: u8 = 0x0F;

/// Length of a record before its content, bytes: its kind, and 8 bytes of length.
pub const HEAD: u64 = 9;

/// Length of a chunk before its messages, bytes, if it is not compressed.
pub const CHUNK_HEAD: u64 = 40;

/// Length of a message before its data, bytes: channel, number and two times.
pub const MESSAGE_HEAD: usize = 22;

/// Appends a record of kind `kind` to `out`: its head, and the content that `fill` appends. `fill` must only append.
pub fn record(out: &mut Vec<u8>, kind: u8, fill: impl FnOnce(&mut Vec<u8>)) {
    out.push(kind);
    let at = out.len();
    out.extend([0; 8]);
    fill(out);
    let length = (out.len() - at - 8) as u64;
    out[at..at + 8].copy_from_slice(&length.to_le_bytes());
}

/// Appends a string after its length in bytes (4 bytes), which must be below 2³².
pub fn string(out: &mut Vec<u8>, text: &str) {
    bytes(out, text.as_bytes());
}

/// Appends bytes after their length (4 bytes), which must be below 2³²; a longer length is cut off.
#[allow(clippy::cast_possible_truncation)]
pub fn bytes(out: &mut Vec<u8>, bytes: &[u8]) {
    out.extend((bytes.len() as u32).to_le_bytes());
    out.extend(bytes);
}

/// Returns the first bytes of a file: the magic bytes and the header record. `library` names the program that writes.
pub fn beginning(library: &str) -> Vec<u8> {
    let mut out = MAGIC.to_vec();
    record(&mut out, HEADER, |body| {
        string(body, "palpate");
        string(body, library);
    });
    out
}

/// A chunk that is being filled with messages of one moment. It is not compressed.
#[derive(Debug)]
pub struct Chunk {
    out: Vec<u8>,
    unix_ns: u64,
    sequence: u32,
    /// Channel and position of each message.
    index: Vec<(u16, u64)>,
}

impl Chunk {
    /// Begins a chunk. All its messages have the time `unix_ns` (ns since the Unix epoch) and the number `sequence`.
    /// `first` has whole records that are put before them: schemas and channels, or nothing.
    pub fn new(unix_ns: u64, sequence: u32, first: &[u8]) -> Self {
        let mut out = vec![0; (HEAD + CHUNK_HEAD) as usize];
        out.extend(first);
        Chunk { out, unix_ns, sequence, index: Vec::new() }
    }

    /// Appends a message to the chunk. `channel` is the number of a channel that this or an earlier chunk defines.
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

    /// Returns the chunk's record with its CRC-32, followed by the index of its messages, by ascending channel.
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

/// Appends the index of a chunk, one record per channel. `messages` has the channel, the time (ns since the Unix
/// epoch) and the position within the chunk (bytes) of each message, and must be sorted by channel.
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

/// Returns the little-endian number of N bytes at position `at`; `None` if there are not enough bytes. N is at most
/// 8; it panics for more.
pub fn number<const N: usize>(bytes: &[u8], at: usize) -> Option<u64> {
    let mut whole = [0; 8];
    whole[..N].copy_from_slice(bytes.get(at..at + N)?);
    Some(u64::from_le_bytes(whole))
}
