//! Calls about recordings: lists journals, describes one, receives those that clients upload, and starts sessions at
//! a moment of one.

use std::io::Cursor;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::UNIX_EPOCH;

use palpate_proto::pb;

use super::super::config::Config;
use super::super::trainee::shows_hidden;
use super::super::uploads::{FilePart, UploadKind, Uploads};
use super::folder::Folder;
use super::keeper::unix_ns;
use super::player::{Player, read_ahead};
use super::{Journals, Keep};
use palpate_realtime::playback::{Playback, PlaybackSource};
use palpate_realtime::priority::thread;
use palpate_realtime::{Begin, Pacer, Present, SessionHandle, SessionReservation};
use palpate_refusal::{Reason, Refusal, Result, number};
use palpate_session::budget::{Account, Purpose, Resource, Taken};
use palpate_session::journal::file::{self, JournalFile};
use palpate_session::journal::inputs::Inputs;
use palpate_session::journal::{self, JournalReader, JournalWriter, Opening, Replay, pb as kept, seal};
use palpate_tissue::limits::Limits;
use palpate_tissue::lock::lock;
use palpate_tissue::select::scheme_selection::{NEVER, given_up};

/// Maximum number of moments in a curve of forces.
const MAX_MOMENTS: usize = 2000;

/// Lists the journals of a folder.
fn listed(folder: &Path) -> Result<Vec<JournalFile>> {
    file::list(folder).map_err(|error| {
        Refusal::new(Reason::Unreadable, "journal", format!("the folder of the journals can't be read: {error}"))
    })
}

/// Finds and opens the journal of a run of a session; its newest run if `run` is 0.
fn find(
    folder: &Path,
    session_id: &str,
    run: u32,
    payer: Option<&Account>,
) -> Result<(JournalFile, JournalReader<'static>)> {
    let unknown = |message: &str| Refusal::new(Reason::UnknownSession, "session_id", message.to_owned());
    // A text that is not an ID would be a path.
    if file::parse(&file::name(session_id, 1)).is_none() {
        return Err(unknown("is not the ID of a session"));
    }
    let listed = listed(folder)?;
    let is_it = |file: &JournalFile| file.session_id == session_id && (run == 0 || file.run == u64::from(run));
    for file in listed.into_iter().rev().filter(is_it) {
        match open(&file, payer) {
            // The newest run may have been cut off before anything of it was on the disk.
            Err(refusal) if run == 0 && refusal.reason == Reason::Missing => {}
            opened => return opened.map(|reader| (file, reader)),
        }
    }
    Err(unknown("there is no journal of this session and run; ListJournals tells which there are"))
}

fn open(file: &JournalFile, payer: Option<&Account>) -> Result<JournalReader<'static>> {
    let source = journal::reader::file(&file.path).map_err(Refusal::without_folder)?;
    // Callers are sent what is wrong with it, and not its path.
    Ok(JournalReader::paid(&file::name(&file.session_id, file.run), source, paid_by(payer)?)?.up_to_damage())
}

/// Returns a charge to `payer` that grows by what is read.
fn paid_by(payer: Option<&Account>) -> Result<Option<Taken>> {
    payer.map(|payer| payer.take(Resource::Memory(Purpose::Journals), 0, "")).transpose()
}

/// Returns the entry of a journal in a list. `reader` is the open journal, or the reason why it can't be opened.
fn info(
    file: &JournalFile,
    reader: std::result::Result<&mut JournalReader<'_>, String>,
    pacer: &Pacer,
) -> pb::JournalInfo {
    let metadata = std::fs::metadata(&file.path).ok();
    let written = metadata.as_ref().and_then(|metadata| metadata.modified().ok()?.duration_since(UNIX_EPOCH).ok());
    let run = u32::try_from(file.run).unwrap_or(u32::MAX);
    let known = pb::JournalInfo {
        session_id: file.session_id.clone(),
        run,
        end_unix_ns: written.map_or(0, |since| u64::try_from(since.as_nanos()).unwrap_or(u64::MAX)),
        bytes: metadata.map_or(0, |metadata| metadata.len()),
        live: pacer.is_recording(&file.session_id, run),
        ..Default::default()
    };
    let begun = reader.and_then(|reader| {
        let batch = reader.next_batch().map_err(|refusal| refusal.to_string())?;
        let begin_unix_ns = batch.map_or(0, |batch| batch.unix_ns);
        let header = reader.header();
        let scene_name = header.scene.as_ref().map(|scene| scene.name.clone()).unwrap_or_default();
        Ok(pb::JournalInfo { scene_name, owner: header.owner.clone(), begin_unix_ns, ..known.clone() })
    });
    begun.unwrap_or_else(|fault| pb::JournalInfo { fault, ..known })
}

/// The recordings that the server can play: the journals of its folder, and those that clients have uploaded.
pub(in crate::server) struct Recorded {
    /// `None` if the server keeps no journals.
    folder: Option<Arc<Folder>>,
    /// How long they are kept.
    keep: Keep,
    /// Whether sessions whose mesh a client has sent have journals too.
    with_meshes: bool,
    sent: Uploads<Vec<u8>>,
    player: Arc<Player>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

impl Recorded {
    /// Starts the thread that reads ahead for sessions that play.
    ///
    /// # Errors
    /// Refuses if no thread can be started.
    pub(in crate::server) fn new(journals: Option<&Journals>, config: &Config) -> Result<Arc<Self>> {
        let limits = &config.limits;
        let player = Arc::new(Player::default());
        let reader = player.clone();
        let playing = thread("player").spawn(move || reader.work()).map_err(|error| {
            Refusal::new(Reason::Overloaded, "journal", format!("no thread can be started to play journals: {error}"))
        })?;
        let sent = Uploads::new(UploadKind {
            names: ["journal", "journals"],
            id: "upload_id",
            unknown: Reason::UnknownJournal,
            purpose: Purpose::Journals,
            most_bytes: (limits.journal_bytes, "limits.journal_bytes"),
            most_each: (limits.journals_per_caller, "limits.journals_per_caller"),
            kept_s: limits.journal_s,
        });
        let folder = journals.map(|journals| journals.folder.clone());
        let (keep, with_meshes) = (config.journal_keep, config.journal_meshes);
        Ok(Arc::new(Recorded { folder, keep, with_meshes, sent, player, thread: Some(playing).into() }))
    }

    /// Stops the thread. The stepping threads must have ended.
    pub(in crate::server) fn finish(&self) {
        self.player.stop();
        if let Some(thread) = lock(&self.thread).take() {
            let _ = thread.join();
        }
    }

    /// Removes uploaded journals that were not used for too long.
    pub(in crate::server) fn forget_expired(&self, now_ns: u64) {
        self.sent.forget_expired(now_ns);
    }

    fn folder(&self, field: &str) -> Result<&Path> {
        let none = || {
            let message = "this server keeps no journals: `palpate serve --journal DIR` does";
            Refusal::new(Reason::NotAvailable, field, message)
        };
        self.folder.as_ref().map(|folder| folder.path()).ok_or_else(none)
    }

    /// Returns, as a sentence, what the server keeps of a mesh that a client sends; empty if nothing.
    pub(in crate::server) fn told_of_meshes(&self) -> String {
        match (&self.folder, self.with_meshes && !self.keep.age.is_zero()) {
            (Some(_), true) => format!(
                "the journals of sessions on this mesh contain it, and stay {}; DeleteJournal removes them earlier",
                self.keep.in_words()
            ),
            _ => String::new(),
        }
    }

    /// Removes all journals of a session that is not here any more. Returns their number.
    ///
    /// # Errors
    /// Refuses a session that still runs or has no journal, and names a file that can't be removed.
    pub(in crate::server) fn remove(&self, session_id: &str, pacer: &Pacer) -> Result<u32> {
        let folder = self.folder("session_id")?;
        if pacer.has(session_id) {
            let message = "belongs to a session that still runs: delete that first (DeleteSession)";
            return Err(Refusal::new(Reason::OutOfTurn, "session_id", message));
        }
        let unreadable = |name: &str, error: std::io::Error| {
            let refusal = Refusal::new(Reason::Unreadable, "session_id", format!("can't be removed: {error}"));
            Refusal { place: Some(name.to_owned()), ..refusal }
        };
        let listed = file::list(folder).map_err(|error| unreadable("the folder of the journals", error))?;
        let mut removed = 0;
        for file in listed.into_iter().filter(|file| file.session_id == session_id) {
            match std::fs::remove_file(&file.path) {
                Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
                removal => {
                    removal.map_err(|error| unreadable(&file::name(session_id, file.run), error))?;
                    tracing::info!(
                        session = session_id,
                        run = file.run,
                        "journal removed, because a client asked for it"
                    );
                    removed += 1;
                }
            }
        }
        if removed == 0 {
            let message = "there is no journal of this session";
            return Err(Refusal::new(Reason::UnknownSession, "session_id", message));
        }
        Ok(removed)
    }

    /// Returns all journals of the folder, by session and run; none if there is no folder.
    ///
    /// # Errors
    /// Refuses if the folder can't be read.
    pub(in crate::server) fn list(&self, pacer: &Pacer) -> Result<pb::ListJournalsResponse> {
        let Some(folder) = &self.folder else { return Ok(pb::ListJournalsResponse::default()) };
        let listed = listed(folder.path())?;
        let info =
            |file: &JournalFile| info(file, open(file, None).as_mut().map_err(|refusal| refusal.to_string()), pacer);
        Ok(pb::ListJournalsResponse { journals: listed.iter().map(info).collect() })
    }

    /// Describes the contents of a journal, which takes a pass over it.
    ///
    /// # Errors
    /// Refuses a journal that does not exist or can't be read.
    pub(in crate::server) fn told(
        &self,
        request: &pb::GetJournalRequest,
        pacer: &Pacer,
    ) -> Result<pb::GetJournalResponse> {
        let (file, mut reader) = find(self.folder("session_id")?, &request.session_id, request.run, None)?;
        let info = info(&file, Ok(&mut reader), pacer);
        tell(reader, info, &NEVER)
    }

    /// Adds a part of a journal that a client uploads.
    ///
    /// # Errors
    /// Returns the errors of [`Uploads::add`].
    pub(in crate::server) fn add(
        &self,
        request: &pb::UploadJournalRequest,
        account: &Account,
    ) -> Result<pb::UploadJournalResponse> {
        let pb::UploadJournalRequest { upload_id, offset, part, last } = request;
        let part = FilePart { id: upload_id, offset: *offset, bytes: part, last: *last };
        let (upload_id, received_bytes) = self.sent.add(&part, account)?;
        Ok(pb::UploadJournalResponse { upload_id, received_bytes, journal: None })
    }

    /// Reads a completely received journal and describes it. It can be used from then on.
    ///
    /// # Errors
    /// Refuses a journal that this caller is not uploading, one that can't be read, and when `stop` is set.
    pub(in crate::server) fn read(
        &self,
        id: &str,
        account: &Account,
        stop: &AtomicBool,
    ) -> Result<pb::GetJournalResponse> {
        let mut received = self.sent.take(id, account)?;
        let bytes = std::mem::take(&mut received.bytes);
        let paid = paid_by(Some(account))?;
        let reader = JournalReader::paid(SENT, Cursor::new(&bytes), paid).map_err(within_upload)?.up_to_damage();
        let header = reader.header();
        let known = pb::JournalInfo {
            session_id: header.session_id.clone(),
            run: u32::try_from(header.run).unwrap_or(u32::MAX),
            scene_name: header.scene.as_ref().map(|scene| scene.name.clone()).unwrap_or_default(),
            bytes: bytes.len() as u64,
            ..Default::default()
        };
        let told = tell(reader, known, stop).map_err(within_upload)?;
        let length = bytes.len() as u64;
        received.finish(bytes, length)?;
        Ok(told)
    }

    /// Opens the journal of a moment. Returns it with its session and run.
    fn open(&self, moment: &pb::JournalMoment, payer: &Account) -> Result<Opened> {
        if moment.upload_id.is_empty() {
            let (file, reader) = find(self.folder("journal")?, &moment.session_id, moment.run, Some(payer))?;
            return Ok((reader, file.session_id, file.run));
        }
        if !moment.session_id.is_empty() || moment.run != 0 {
            let message = "names a session's journal, and upload_id one that was sent: leave one of them out";
            return Err(Refusal::new(Reason::WrongKind, "session_id", message));
        }
        let bytes = self.sent.get(&moment.upload_id, payer)?;
        // A session that plays it keeps it, even after the upload has expired.
        let taken = payer.take(Resource::Memory(Purpose::Journals), bytes.len() as u64, "upload_id")?;
        let source = Cursor::new(UploadedJournal { bytes, _taken: taken });
        let reader = JournalReader::paid(SENT, source, paid_by(Some(payer))?)?.without_files().up_to_damage();
        let (session_id, run) = (reader.header().session_id.clone(), reader.header().run);
        Ok((reader, session_id, run))
    }

    /// Refuses a journal of this server whose exercise hides something ([`Reason::NotForTrainee`]).
    ///
    /// # Errors
    /// Also refuses a journal that does not exist, or can't be read.
    pub(in crate::server) fn check_hides_nothing(&self, moment: &pb::JournalMoment, payer: &Account) -> Result<()> {
        if !moment.upload_id.is_empty() {
            return Ok(());
        }
        let check = || {
            let (file, reader) = find(self.folder("journal")?, &moment.session_id, moment.run, Some(payer))?;
            let place = file::name(&file.session_id, file.run);
            let chosen = journal::exercise::from_header(&place, reader.header())?;
            let hides = chosen.is_some_and(|chosen| chosen.exercise.hides_truth());
            if hides { Err(shows_hidden()) } else { Ok(()) }
        };
        check().map_err(|refusal| refusal.within("journal"))
    }

    /// Creates a session that starts at a moment of a journal, and continues live or plays back the recording.
    ///
    /// # Errors
    /// Refuses a journal that does not exist, can't be read or simulated again here, a step that it does not have,
    /// and a speed out of range; returns the errors of [`Pacer::resume`]; refuses when `stop` is set.
    pub(in crate::server) fn begin(
        &self,
        moment: &pb::JournalMoment,
        SessionReservation { id, revision, .. }: SessionReservation,
        (paused, idle_timeout_s): (bool, f64),
        (payer, pacer): (&Account, &Pacer),
        limits: &Limits,
        stop: &AtomicBool,
    ) -> Result<Arc<SessionHandle>> {
        let speed = moment.speed.unwrap_or(1.0);
        number("journal.speed", speed, "from 0.1 to 8", |speed| (0.1..=8.0).contains(&speed))?;
        let within = |refusal: Refusal| refusal.within("journal");
        let (mut reader, session_id, run) = self.open(moment, payer).map_err(within)?;
        let has_mesh = reader.header().mesh.is_some();
        let survey = reader.survey(&mut |_| {}).map_err(within)?;
        let step = moment.step.unwrap_or(survey.until_step);
        let steps = [reader.header().begin_step, survey.until_step];
        let replay = Replay::near(reader, survey.clone(), limits, step).map_err(within)?;
        let (mut session, first, reader) = replay.reach(step, stop).map_err(within)?;
        let mut begin = Begin {
            id,
            first: first.clone(),
            running: !paused,
            until: None,
            idle_timeout_s,
            playback: None,
            after_run: 0,
            revision,
            waiting: Vec::new(),
            frozen: false,
            exercise: None,
            // A session started from a journal of this server may be recorded as well.
            recorded: self.with_meshes || moment.upload_id.is_empty() || !has_mesh,
        };
        if !moment.plays {
            // With the memory charged for an uploaded journal.
            drop(reader);
            return pacer.resume(
                begin,
                payer,
                || {
                    session.let_go();
                    Ok(session)
                },
                stop,
            );
        }
        let feed = Arc::new(PlaybackSource::default());
        let mut inputs = Inputs::new(reader, &survey, &first, limits, step);
        read_ahead(&feed, &mut inputs, step)?;
        begin.playback = Some(Playback { session_id, run, steps, speed, feed: feed.clone() });
        let handle = pacer.resume(begin, payer, || Ok(session), stop)?;
        self.player.play(&handle, &feed, inputs);
        Ok(handle)
    }
}

/// An open journal, with its session and run.
type Opened = (JournalReader<'static>, String, u64);

/// The name of an uploaded journal in refusals.
const SENT: &str = "the journal";

/// Sets the field of a refusal about an uploaded journal.
fn within_upload(refusal: Refusal) -> Refusal {
    if refusal.field.is_empty() { Refusal { field: "part".to_owned(), ..refusal } } else { refusal }
}

/// The bytes of an uploaded journal, with the memory charged for them.
struct UploadedJournal {
    bytes: Arc<Vec<u8>>,
    _taken: Taken,
}

impl AsRef<[u8]> for UploadedJournal {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

/// Describes the contents of a journal, of which `info` is known; a damaged one up to the damage.
fn tell(mut reader: JournalReader<'_>, info: pb::JournalInfo, stop: &AtomicBool) -> Result<pb::GetJournalResponse> {
    let survey = reader.survey(&mut |_| {})?;
    let mut forces = Forces::default();
    while let Some(batch) = reader.next_batch()? {
        if stop.load(Ordering::Relaxed) {
            return Err(given_up());
        }
        for moment in batch.felt()? {
            let of = |tool: &kept::FeltTool| {
                let kept::Vector { x, y, z } = tool.force_n.unwrap_or_default();
                glam::Vec3::new(x, y, z).length()
            };
            forces.add(moment.step, f64::from(moment.tools.iter().map(of).fold(0.0, f32::max)));
        }
    }
    Ok(pb::GetJournalResponse {
        info: Some(pb::JournalInfo { fault: survey.damage.unwrap_or_default(), ..info }),
        rate_hz: reader.header().rate_hz,
        begin_step: reader.header().begin_step,
        end_step: survey.until_step,
        forces: forces.moments,
        snapshot_steps: survey.snapshots.iter().map(|at| at.step).collect(),
    })
}

/// A curve of forces with at most [`MAX_MOMENTS`] moments; each is the largest force of an interval.
#[derive(Default)]
struct Forces {
    moments: Vec<pb::ForceMoment>,
    /// Power of 2 of the moments that are merged into one; and how many of them the newest contains already.
    halvings: u32,
    in_newest: u32,
}

impl Forces {
    fn add(&mut self, step: u64, force_n: f64) {
        if self.in_newest == 0 {
            self.moments.push(pb::ForceMoment { step, force_n });
        } else if let Some(newest) = self.moments.last_mut() {
            *newest = pb::ForceMoment { step, force_n: newest.force_n.max(force_n) };
        }
        self.in_newest = (self.in_newest + 1) % (1 << self.halvings);
        if self.moments.len() == MAX_MOMENTS && self.in_newest == 0 {
            let pair = |pair: &[pb::ForceMoment]| {
                let force_n = pair.iter().map(|moment| moment.force_n).fold(0.0, f64::max);
                pb::ForceMoment { step: pair[pair.len() - 1].step, force_n }
            };
            self.moments = self.moments.chunks(2).map(pair).collect();
            self.halvings += 1;
        }
    }
}

/// Returns a journal with a single moment: the session of `handle` in the state `present`.
pub(in crate::server) fn snapshot(handle: &SessionHandle, present: &Present) -> Result<Vec<u8>> {
    let Present { saved, copy, running, until_step } = present;
    let step = saved.step();
    let run = handle.event_log.as_ref().map_or(0, |event_log| event_log.progress().borrow().run);
    let opening = Opening {
        session_id: &handle.id,
        run: u64::from(run.max(1)),
        owner: handle.owner.name(),
        idle_timeout_s: handle.idle_timeout_s,
        first: &handle.model,
        begin_step: step,
        running: *running,
        until_step: *until_step,
        ownership_revision: handle.revision(),
        exercise: None,
    };
    let now = unix_ns();
    let mut writer = JournalWriter::new(&opening, now);
    writer.snapshot(step, copy.state_hash(), copy.model(), saved.to_bytes());
    let mut file = Cursor::new(writer.finish(kept::Why::Cut, "a snapshot", step, now));
    seal::seal(&mut file).map_err(|error| Refusal::new(Reason::Overloaded, "", error.to_string()))?;
    Ok(file.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_keeps_its_peaks_and_its_end_however_long_it_is() {
        for count in [0, 1, 1999, 2000, 2001, 5000, 100_003_u64] {
            let mut forces = Forces::default();
            for step in 0..count {
                forces.add(step, if step == count / 3 { 7.0 } else { 1.0 });
            }
            assert!(forces.moments.len() <= MAX_MOMENTS);
            assert!(forces.moments.is_sorted_by_key(|moment| moment.step));
            if count > 0 {
                assert_eq!(forces.moments.last().unwrap().step, count - 1);
                assert_eq!(forces.moments.iter().filter(|moment| moment.force_n == 7.0).count(), 1, "{count}");
            }
        }
    }
}
