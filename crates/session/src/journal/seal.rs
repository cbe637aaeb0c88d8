//! Completes a journal so that every MCAP tool opens it: appends the index of its chunks, statistics, and the end.

use std::collections::BTreeMap;
use std::io::{self, Read, Seek, SeekFrom, Write};

use super::records::{
    self, CHANNEL, CHUNK, CHUNK_HEAD, CHUNK_INDEX, DATA_END, FOOTER, HEAD, MAGIC, MESSAGE_INDEX, SCHEMA, STATISTICS,
    SUMMARY_OFFSET, number,
};

/// Position and content of a chunk, for its index.
struct ChunkAt {
    at: u64,
    length: u64,
    /// Times of its first and last message.
    times: [u64; 2],
    /// For each channel: its number, the position of its index, and the number of its messages.
    indexes: Vec<(u16, u64, u64)>,
    /// Length of these indexes, bytes.
    index_length: u64,
}

/// Appends the summary to a file of whole batches, which must have nothing after them, no earlier summary either. It
/// keeps one index in memory at a time, and reads the file twice, without its messages. The position of `file` does
/// not matter.
///
/// # Errors
/// Returns the error of `file`, or [`io::ErrorKind::InvalidData`] if the file does not consist of whole batches. A
/// part of the summary may be appended then.
pub fn seal<F: Read + Write + Seek>(file: &mut F) -> io::Result<()> {
    let length = file.seek(SeekFrom::End(0))?;
    let mut out = Vec::new();
    // The checksum of the data is left out: each chunk has its own.
    records::record(&mut out, DATA_END, |body| body.extend(0_u32.to_le_bytes()));
    let mut writer = Summary { at: length + out.len() as u64, crc: crc32fast::Hasher::new(), groups: Vec::new() };
    file.write_all(&out)?;
    let begin = writer.at;

    let mut definitions = [Vec::new(), Vec::new()];
    let mut counts: BTreeMap<u16, u64> = BTreeMap::new();
    let (mut chunks, mut times, mut channels) = (0_u32, [u64::MAX, 0], [0_u32; 2]);
    let mut at = first_chunk(file)?;
    while let Some(chunk) = next_chunk(file, &mut at, length)? {
        if chunks == 0 {
            channels = define(file, &chunk, &mut definitions)?;
        }
        chunks += 1;
        times = [times[0].min(chunk.times[0]), times[1].max(chunk.times[1])];
        for (channel, _, messages) in &chunk.indexes {
            *counts.entry(*channel).or_default() += messages;
        }
    }
    let [schemas, channel_records] = definitions;
    writer.group(file, SCHEMA, &schemas)?;
    writer.group(file, CHANNEL, &channel_records)?;
    let mut statistics = Vec::new();
    records::record(&mut statistics, STATISTICS, |body| {
        body.extend(counts.values().sum::<u64>().to_le_bytes());
        #[allow(clippy::cast_possible_truncation)]
        body.extend((channels[0] as u16).to_le_bytes());
        body.extend(channels[1].to_le_bytes());
        body.extend([0; 8]);
        body.extend(chunks.to_le_bytes());
        times.iter().for_each(|time| body.extend(time.to_le_bytes()));
        map(body, counts.iter().map(|(channel, count)| (*channel, *count)));
    });
    writer.group(file, STATISTICS, &statistics)?;

    let indexes_begin = writer.at;
    let mut at = first_chunk(file)?;
    let mut indexes = Vec::new();
    while let Some(chunk) = next_chunk(file, &mut at, length)? {
        records::record(&mut indexes, CHUNK_INDEX, |body| {
            chunk.times.iter().for_each(|time| body.extend(time.to_le_bytes()));
            body.extend(chunk.at.to_le_bytes());
            body.extend(chunk.length.to_le_bytes());
            map(body, chunk.indexes.iter().map(|(channel, at, _)| (*channel, *at)));
            body.extend(chunk.index_length.to_le_bytes());
            records::string(body, "");
            let size = chunk.length - HEAD - CHUNK_HEAD;
            body.extend(size.to_le_bytes());
            body.extend(size.to_le_bytes());
        });
        if indexes.len() > 1 << 16 {
            writer.append(file, &std::mem::take(&mut indexes))?;
        }
    }
    writer.append(file, &indexes)?;
    writer.groups.push((CHUNK_INDEX, indexes_begin, writer.at - indexes_begin));

    let offsets_begin = writer.at;
    let mut offsets = Vec::new();
    for (kind, at, length) in std::mem::take(&mut writer.groups) {
        records::record(&mut offsets, SUMMARY_OFFSET, |body| {
            body.push(kind);
            body.extend(at.to_le_bytes());
            body.extend(length.to_le_bytes());
        });
    }
    records::record(&mut offsets, FOOTER, |body| {
        body.extend(begin.to_le_bytes());
        body.extend(offsets_begin.to_le_bytes());
        body.extend([0; 4]);
    });
    // The checksum of the summary covers the footer up to the checksum.
    let crc_at = offsets.len() - 4;
    writer.crc.update(&offsets[..crc_at]);
    let crc = writer.crc.finalize();
    offsets[crc_at..].copy_from_slice(&crc.to_le_bytes());
    offsets.extend(MAGIC);
    file.seek(SeekFrom::End(0))?;
    file.write_all(&offsets)?;
    file.flush()
}

/// The summary while it is written: its position, its checksum, and its parts.
struct Summary {
    at: u64,
    crc: crc32fast::Hasher,
    groups: Vec<(u8, u64, u64)>,
}

impl Summary {
    fn append(&mut self, file: &mut (impl Write + Seek), bytes: &[u8]) -> io::Result<()> {
        file.seek(SeekFrom::Start(self.at))?;
        file.write_all(bytes)?;
        self.crc.update(bytes);
        self.at += bytes.len() as u64;
        Ok(())
    }

    fn group(&mut self, file: &mut (impl Write + Seek), kind: u8, bytes: &[u8]) -> io::Result<()> {
        self.groups.push((kind, self.at, bytes.len() as u64));
        self.append(file, bytes)
    }
}

/// Appends a map of numbers by channel.
fn map(body: &mut Vec<u8>, entries: impl ExactSizeIterator<Item = (u16, u64)>) {
    #[allow(clippy::cast_possible_truncation)]
    body.extend((10 * entries.len() as u32).to_le_bytes());
    for (channel, number) in entries {
        body.extend(channel.to_le_bytes());
        body.extend(number.to_le_bytes());
    }
}

fn invalid(at: u64) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, format!("no whole batch at byte {at}"))
}

fn read_at(file: &mut (impl Read + Seek), at: u64, into: &mut [u8]) -> io::Result<()> {
    file.seek(SeekFrom::Start(at))?;
    file.read_exact(into)
}

/// Returns the position of the first chunk.
fn first_chunk(file: &mut (impl Read + Seek)) -> io::Result<u64> {
    let mut head = [0; HEAD as usize];
    read_at(file, MAGIC.len() as u64, &mut head)?;
    Ok(MAGIC.len() as u64 + HEAD + number::<8>(&head, 1).unwrap_or_default())
}

/// Returns the chunk at `at` and moves `at` beyond its indexes; `None` at `end`.
fn next_chunk(file: &mut (impl Read + Seek), at: &mut u64, end: u64) -> io::Result<Option<ChunkAt>> {
    if *at >= end {
        return Ok(None);
    }
    let begin = *at;
    let mut head = [0; (HEAD + 16) as usize];
    read_at(file, begin, &mut head)?;
    let length = number::<8>(&head, 1).filter(|length| head[0] == CHUNK && *length >= CHUNK_HEAD && *length < end);
    let length = HEAD + length.ok_or_else(|| invalid(begin))?;
    let times = [9, 17].map(|at| number::<8>(&head, at).unwrap_or_default());
    let mut chunk = ChunkAt { at: begin, length, times, indexes: Vec::new(), index_length: 0 };
    *at += length;
    while *at < end {
        let mut head = [0; (HEAD + 6) as usize];
        read_at(file, *at, &mut head[..HEAD as usize])?;
        if head[0] != MESSAGE_INDEX {
            break;
        }
        read_at(file, *at, &mut head)?;
        let length = number::<8>(&head, 1).filter(|length| *length < end).ok_or_else(|| invalid(*at))?;
        let channel = u16::from_le_bytes([head[9], head[10]]);
        let messages = number::<4>(&head, 11).unwrap_or_default() / 16;
        chunk.indexes.push((channel, *at, messages));
        *at += HEAD + length;
    }
    if *at > end {
        return Err(invalid(begin));
    }
    chunk.index_length = *at - begin - length;
    Ok(Some(chunk))
}

/// Appends the records of schemas and of channels in the first chunk to `into`. Returns how many of each there are.
fn define(file: &mut (impl Read + Seek), chunk: &ChunkAt, into: &mut [Vec<u8>; 2]) -> io::Result<[u32; 2]> {
    let (mut at, end) = (chunk.at + HEAD + CHUNK_HEAD, chunk.at + chunk.length);
    let mut counts = [0; 2];
    while at < end {
        let mut head = [0; HEAD as usize];
        read_at(file, at, &mut head)?;
        let length = number::<8>(&head, 1).filter(|length| *length < end).ok_or_else(|| invalid(at))?;
        if let Some(which) = [SCHEMA, CHANNEL].iter().position(|kind| *kind == head[0]) {
            let mut record = vec![0; (HEAD + length) as usize];
            read_at(file, at, &mut record)?;
            into[which].extend(record);
            counts[which] += 1;
        }
        at += HEAD + length;
    }
    Ok(counts)
}
