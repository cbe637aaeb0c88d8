//! Repair and cutting of journals: makes a complete journal from one that is torn or unfinished, or from a part of
//! one.

use std::io::{self, Read, Seek, Write};

use palpate_proto::journal as pb;

use super::format::Topic;
use super::reader::{JournalReader, Survey};
use super::records::{self, CHUNK};
use super::replay::{JournalItem, Replay, items};
use super::seal::seal;
use super::writer::JournalWriter;
use crate::Session;
use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::limits::Limits;
use palpate_tissue::select::scheme_selection::NEVER;

fn unwritten(e: &io::Error) -> Refusal {
    Refusal::new(Reason::Unreadable, "", format!("the new journal can't be written: {e}"))
}

/// Writes the whole batches of a journal to `output`, which must be empty, and completes it: with an end, if the
/// journal has none, and with the summary. Nothing is simulated. `progress` gets the position in the journal, bytes.
/// Returns the survey of the original journal.
///
/// # Errors
/// - The refusals of [`JournalReader::survey`]: a journal that can't be read or decoded, or that is damaged in the
///   middle, unless `reader` stops there ([`JournalReader::up_to_damage`]); and missing memory.
/// - [`Reason::Unreadable`]: `output` can't be written or read. It may have a part of the journal then.
pub fn recover(
    mut reader: JournalReader<'_>,
    output: &mut (impl Read + Write + Seek),
    progress: &mut dyn FnMut(u64),
) -> Result<Survey> {
    let survey = reader.survey(progress)?;
    let written = |result: io::Result<()>| result.map_err(|e| unwritten(&e));
    written(output.write_all(&reader.beginning()?))?;
    while let Some(batch) = reader.next_batch()? {
        let mut out = Vec::new();
        records::record(&mut out, CHUNK, |body| body.extend(batch.data()));
        records::indexes(&mut out, batch.places());
        written(output.write_all(&out))?;
    }
    if survey.end.is_none() {
        let writer = JournalWriter::after(survey.batches, survey.inputs, survey.until_step);
        let message = match (&survey.damage, survey.torn_bytes) {
            (Some(damage), bytes) => format!("{damage}; the {bytes} bytes from there on are left out"),
            (None, 0) => "the server had no time to finish it".to_owned(),
            (None, bytes) => format!("{bytes} bytes at its end belonged to no whole batch"),
        };
        written(output.write_all(&writer.finish(pb::Why::Recovered, &message, survey.until_step, survey.unix_ns[1])))?;
    }
    written(seal(output))?;
    Ok(survey)
}

/// Writes the part of a journal from step `from` to step `to` to `output`, which must be empty, as a journal that can
/// be verified alone. It simulates from the newest snapshot to `from`. Returns the survey of the whole journal.
///
/// # Errors
/// - [`Reason::OutOfRange`]: `from` is before the journal, or `to` is not above `from` or beyond the journal.
/// - The refusals of [`JournalReader::survey`] and of [`Replay::near`] and [`Replay::reach`]: a journal that is
///   damaged, is of another generation ([`REPLAYS`](super::REPLAYS)), or gives other hashes before `from`.
/// - [`Reason::Unreadable`]: `output` can't be written or read. It may have a part of the journal then.
pub fn cut(
    mut reader: JournalReader<'_>,
    [from, to]: [u64; 2],
    limits: &Limits,
    output: &mut (impl Read + Write + Seek),
) -> Result<Survey> {
    let survey = reader.survey(&mut |_| {})?;
    let had = survey.clone();
    let end = survey.until_step;
    if to <= from || to > end {
        let damage = survey.and_damage();
        let message = format!("must be above --from and at most {end}, which the journal has, but is {to}{damage}");
        return Err(Refusal::new(Reason::OutOfRange, "to", message));
    }
    let (session, _, mut reader) = Replay::near(reader, survey, limits, from)?.reach(from, &NEVER)?;
    reader.rewind();
    let (mut running, mut until_step) = (reader.header().running, reader.header().until_step);
    let mut kept: Option<JournalWriter> = None;
    let begin = |running: bool, until_step: Option<u64>, header: &pb::Header, unix_ns: u64| {
        let header = pb::Header { begin_step: from, running, until_step, ..header.clone() };
        let mut writer = JournalWriter::with_header(&header, unix_ns);
        writer.snapshot(from, session.tissue().state_hash(), session.model(), save(&session));
        writer
    };
    let (mut unix_ns, header) = (0, reader.header().clone());
    while let Some(batch) = reader.next_batch()? {
        unix_ns = batch.unix_ns;
        for item in items(&batch)? {
            if let (None, JournalItem::Input(input)) = (&kept, &item)
                && input.step < from
            {
                match &input.what {
                    Some(pb::input::What::Start(start)) => (running, until_step) = (true, start.until_step),
                    Some(pb::input::What::Pause(_) | pb::input::What::Revive(_)) => running = false,
                    _ => {}
                }
            }
            let writer = match &mut kept {
                _ if item.step() < from => continue,
                Some(writer) => writer,
                empty => empty.insert(begin(running, until_step, &header, unix_ns)),
            };
            match item {
                JournalItem::Input(input) if input.step < to => writer.add_input(input),
                JournalItem::Hash(hash) if hash.step <= to => writer.add_hash(hash),
                // The first snapshot is already written.
                JournalItem::Snapshot(snapshot) if (from + 1..=to).contains(&snapshot.step) => {
                    writer.add_snapshot(snapshot);
                }
                _ => {}
            }
        }
        if batch.has(Topic::Felt) {
            for moment in batch.felt()?.into_iter().filter(|moment| (from..=to).contains(&moment.step)) {
                kept.get_or_insert_with(|| begin(running, until_step, &header, unix_ns)).add_moment(moment);
            }
        }
        if let Some(writer) = &mut kept {
            let bytes = writer.flush(batch.until_step.clamp(from, to), unix_ns);
            output.write_all(&bytes).map_err(|e| unwritten(&e))?;
        }
        if batch.until_step > to {
            break;
        }
    }
    let writer = kept.unwrap_or_else(|| begin(running, until_step, &header, unix_ns));
    let message = format!("steps {from} to {to} of a journal up to step {end}");
    let bytes = writer.finish(pb::Why::Cut, &message, to, unix_ns);
    output.write_all(&bytes).and_then(|()| seal(output)).map_err(|e| unwritten(&e))?;
    Ok(had)
}

fn save(session: &Session) -> Vec<u8> {
    session.save().to_bytes()
}
