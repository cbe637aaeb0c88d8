//! Frames for viewers. A thread named `frames` refines and encodes the newest snapshot of each session. Viewers
//! with equal settings share one encoded frame, which is sent to those that have credit.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, PoisonError, Weak};
use std::time::Duration;

use super::queue::{Reader, Writer, queue};
use palpate_refusal::{Refusal, Result};
use palpate_session::budget::{Account, Budget, Purpose, Resource, Taken};
use palpate_session::surface::{Encoding, Frame, FrameTiles, Refinement, Snapshot, encode, encode_over};
use palpate_tissue::lock::lock;
use palpate_tissue::memory;

/// A stream of frames of a session, with the settings of its client. [`Pacer::add_viewer`](super::Pacer::add_viewer)
/// connects it to the session; it ends when its reader is dropped or it is closed.
#[derive(Debug)]
pub struct Viewer {
    /// Random ID, which can't be guessed; the client acknowledges frames with it.
    pub id: String,
    /// Refinement of the surface, of the session's tissue.
    pub refinement: Refinement,
    /// Encoding of the vertices.
    pub encoding: Encoding,
    /// Frames per second of simulated time, at most the session's step rate.
    pub rate_hz: f64,
    /// Whether each frame has every vertex, and not only the changed tiles.
    pub always_full: bool,
    progress: Mutex<ViewerProgress>,
    /// Frames that were sent and not yet acknowledged; `None` if the client does not acknowledge.
    credit: Option<Mutex<Credit>>,
    writer: Writer<Delivery>,
    /// Memory of the viewer's frames.
    _taken: Taken,
}

/// Progress of a viewer.
#[derive(Debug, Default, Clone, Copy)]
struct ViewerProgress {
    /// Version of the tiles that the viewer has or has been sent.
    version: Option<u64>,
    /// Number of frames that were due and in which nothing had changed.
    unchanged: u64,
}

#[derive(Debug)]
struct Credit {
    most: usize,
    in_flight: VecDeque<u64>,
}

/// A frame on its way to one viewer, with the state of its session.
#[derive(Debug, Clone)]
pub struct Delivery {
    /// Number of the frame, which counts all frames that were due to the viewer since step 0 of the session
    /// ([`Viewer::frame_id`]).
    pub frame_id: u64,
    /// The frame, which other viewers may share.
    pub frame: Arc<Frame>,
    /// The frame has the tiles that changed after this version of the viewer's tiles ([`FrameTiles`]). `None`: it has
    /// all tiles.
    pub since: Option<u64>,
    /// Number of frames so far that were due to the viewer and not sent, because nothing had changed.
    pub unchanged: u64,
    /// Number of steps that the session has dropped from its schedule so far.
    pub overrun_count: u64,
    /// Simulated over real time, measured over about the last second.
    pub time_dilation: f64,
}

/// Returns the bytes of a frame with every vertex.
fn frame_bytes(refinement: Refinement, encoding: Encoding) -> usize {
    refinement.vertex_count() * encoding.bytes_per_vertex()
}

/// Returns the bytes of the displacements of all points at one moment.
fn moment_bytes(refinement: Refinement) -> usize {
    refinement.point_count() * size_of::<[f32; 3]>()
}

impl Viewer {
    /// Creates a viewer and the reader of its frames. Their memory is charged to `account` while the viewer exists.
    /// At most `max_in_flight` frames may be unacknowledged, limited to those that fit `queued_bytes` (at least one).
    /// `None` stands for a client that does not acknowledge: then an unread frame is replaced by the next. The other
    /// parameters are the fields of the same names.
    ///
    /// # Errors
    /// Refuses if the memory exceeds the part of `account` or of the system, in the field `refinement`.
    #[allow(clippy::too_many_arguments)]
    pub fn new(
        id: String,
        refinement: Refinement,
        encoding: Encoding,
        rate_hz: f64,
        always_full: bool,
        max_in_flight: Option<u32>,
        queued_bytes: usize,
        account: &Account,
    ) -> Result<(Arc<Self>, Reader<Delivery>)> {
        let frame_bytes = frame_bytes(refinement, encoding);
        let room = (queued_bytes / frame_bytes).max(1);
        let most = max_in_flight.map(|most| (most as usize).min(room));
        // Frames that wait, the frame being sent, and what the tiles keep: the last frame, and the points at three
        // moments.
        let bytes = (most.unwrap_or(1) + 2) * frame_bytes + 3 * moment_bytes(refinement);
        let _taken = account.take(Resource::Memory(Purpose::Frames), bytes as u64, "refinement")?;
        // Without credit only the newest frame waits.
        let (writer, reader) = queue(most.unwrap_or(1));
        let credit = most.map(|most| Mutex::new(Credit { most, in_flight: VecDeque::with_capacity(most) }));
        let progress = Mutex::default();
        let viewer = Viewer { id, refinement, encoding, rate_hz, always_full, progress, credit, writer, _taken };
        Ok((Arc::new(viewer), reader))
    }

    /// Returns the number of the frame that belongs to step `step` of a session with `rate_hz` steps per second: the
    /// step times the ratio of the viewer's rate to that, rounded down.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    pub fn frame_id(&self, step: u64, rate_hz: f64) -> u64 {
        // The small addition keeps 60 Hz of 1 kHz from being late by a rounding error.
        ((step as f64 + 1e-6) * self.rate_hz / rate_hz) as u64
    }

    /// Acknowledges all frames up to this one, which frees their credit. A number that was not sent, and a viewer
    /// that does not acknowledge, are ignored.
    pub fn acknowledge(&self, frame_id: u64) {
        if let Some(credit) = &self.credit {
            lock(credit).in_flight.retain(|id| *id > frame_id);
        }
    }

    /// Returns whether a frame may be sent to it now.
    pub(super) fn has_credit(&self) -> bool {
        self.credit.as_ref().is_none_or(|credit| {
            let credit = lock(credit);
            // A client that acknowledges frames it has not read gets no more than fits.
            credit.in_flight.len() < credit.most && !self.writer.is_full()
        })
    }

    fn deliver(&self, job: &Job, frame_id: u64, frame: Arc<Frame>, since: Option<u64>) {
        if let Some(credit) = &self.credit {
            lock(credit).in_flight.push_back(frame_id);
        }
        let unchanged = lock(&self.progress).unchanged;
        let Job { overrun_count, time_dilation, .. } = *job;
        self.writer.push(Delivery { frame_id, frame, since, unchanged, overrun_count, time_dilation });
    }

    /// Sends the tiles that are newer than the viewer's, or counts an unchanged frame.
    fn deliver_newer(&self, job: &Job, frame_id: u64, tiles: &mut FrameTiles) {
        let mut since = {
            let mut progress = lock(&self.progress);
            if !tiles.is_newer_than(progress.version) {
                progress.unchanged += 1;
                return;
            }
            progress.version.replace(tiles.version())
        };
        // An unread frame is replaced by one that has all its tiles and the newer ones.
        if self.credit.is_none()
            && let Some(unread) = self.writer.withdraw()
        {
            since = unread.since;
        }
        self.deliver(job, frame_id, Arc::new(tiles.newer_than(since)), since);
    }

    /// Counts frames that were due and in which nothing had changed.
    pub(super) fn count_unchanged(&self, frames: u64) {
        lock(&self.progress).unchanged += frames;
    }

    /// Returns whether the stream has dropped its reader.
    pub fn is_gone(&self) -> bool {
        self.writer.is_abandoned()
    }

    /// Ends the stream with the reason `why`, after the frames that wait. The first reason is kept.
    pub fn close(&self, why: Refusal) {
        self.writer.close(why);
    }
}

/// A request to encode a snapshot of one session for the viewers that are due a frame of it.
#[derive(Debug)]
pub struct Job {
    /// Displacements of the points at the present step.
    pub snapshot: Arc<Snapshot>,
    /// The viewers, each with the number of its frame ([`Viewer::frame_id`]).
    pub viewers: Vec<(Arc<Viewer>, u64)>,
    /// Number of steps that the session has dropped from its schedule so far.
    pub overrun_count: u64,
    /// Simulated over real time of the session, measured over about the last second.
    pub time_dilation: f64,
}

#[derive(Debug, Default)]
struct JobQueue {
    /// Jobs by the number of their session, oldest first, so that each session is served once before another is
    /// served twice.
    jobs: VecDeque<(u64, Job)>,
    stop: bool,
}

/// Idle time after which buffers and the tiles of ended viewers are freed.
const IDLE: Duration = Duration::from_millis(500);

/// The queue of the thread that encodes frames, with at most one job for each session.
#[derive(Debug, Default)]
pub struct Encoder {
    board: Mutex<JobQueue>,
    posted: Condvar,
}

impl Encoder {
    /// Queues a job of the session with the number `number`. It replaces that session's waiting job, whose other
    /// viewers it takes over, in its place in the queue. It blocks only for a queue operation.
    pub fn post(&self, number: u64, mut job: Job) {
        let mut board = lock(&self.board);
        match board.jobs.iter_mut().find(|waiting| waiting.0 == number) {
            Some((_, older)) => {
                let waits = |viewer: &Arc<Viewer>| job.viewers.iter().any(|(other, _)| Arc::ptr_eq(other, viewer));
                let missing: Vec<_> = older.viewers.drain(..).filter(|(viewer, _)| !waits(viewer)).collect();
                job.viewers.extend(missing);
                *older = job;
            }
            None => board.jobs.push_back((number, job)),
        }
        drop(board);
        self.posted.notify_one();
    }

    /// Makes the thread end after the job that it works on; waiting jobs are not served.
    pub fn stop(&self) {
        lock(&self.board).stop = true;
        self.posted.notify_one();
    }

    /// Runs the encoding in the calling thread until [`Encoder::stop`]. Frames that are kept for their buffers take
    /// memory from `budget`. If there is no memory for a job, the streams of its viewers end.
    pub fn work(&self, budget: &Arc<Budget>) {
        let (mut spent, mut watched) = (RecycledFrames::of(budget), Watched::default());
        loop {
            let mut board = lock(&self.board);
            let (number, job) = loop {
                if board.stop {
                    return;
                }
                if let Some(next) = board.jobs.pop_front() {
                    break next;
                }
                if spent.frames.is_empty() && watched.0.is_empty() {
                    board = self.posted.wait(board).unwrap_or_else(PoisonError::into_inner);
                    continue;
                }
                let waited = self.posted.wait_timeout(board, IDLE);
                let (again, idle) = waited.unwrap_or_else(PoisonError::into_inner);
                board = again;
                if idle.timed_out() && board.jobs.is_empty() {
                    drop(board);
                    spent.clear();
                    watched.forget_the_gone();
                    board = lock(&self.board);
                }
            };
            drop(board);
            let served = memory::attempt("refinement", || {
                serve(number, &job, &mut spent, &mut watched);
                Ok(())
            });
            if let Err(refusal) = served {
                job.viewers.iter().for_each(|(viewer, _)| viewer.close(refusal.clone()));
                watched.give_up(number, &refusal);
                spent.clear();
            }
        }
    }
}

/// Limit of the bytes of full frames that are kept for their buffers, one per recently requested kind.
const SPENT_BYTES: usize = 64 << 20;

/// Account that is charged for them: they serve whichever viewer is next.
const EVERYBODY: &str = "frames";

/// The last frames of a few kinds, newest first. Viewers have mostly finished with a frame when the next of its
/// kind is due.
#[derive(Debug)]
struct RecycledFrames {
    frames: Vec<Arc<Frame>>,
    account: Account,
    /// Memory of the frames.
    taken: Option<Taken>,
}

impl RecycledFrames {
    fn of(budget: &Arc<Budget>) -> Self {
        RecycledFrames { frames: Vec::new(), account: budget.account(EVERYBODY), taken: None }
    }

    fn clear(&mut self) {
        (self.frames, self.taken) = (Vec::new(), None);
    }

    /// Charges the memory of the kept frames, or frees the frames if there is none.
    fn charge(&mut self, bytes: usize) {
        self.taken = None;
        match self.account.take(Resource::Memory(Purpose::Frames), bytes as u64, "") {
            Ok(taken) => self.taken = Some(taken),
            Err(_) => self.clear(),
        }
    }

    /// Encodes a full frame, in the buffers of the last frame of its kind if no viewer uses them.
    fn encode(&mut self, snapshot: &Snapshot, refinement: Refinement, encoding: Encoding) -> Arc<Frame> {
        let same = |frame: &Arc<Frame>| frame.refinement == refinement && frame.encoding == encoding;
        let last = self.frames.iter().position(same).and_then(|index| Arc::into_inner(self.frames.remove(index)));
        memory::require(frame_bytes(refinement, encoding) as u64, "a frame");
        let frame = Arc::new(match last {
            Some(last) => encode_over(snapshot, last),
            None => encode(snapshot, refinement, encoding),
        });
        self.frames.insert(0, frame.clone());
        let (mut bytes, mut kept_bytes) = (0, 0);
        self.frames.retain(|frame| {
            bytes += frame.patches.iter().map(|patch| patch.bytes.len()).sum::<usize>();
            if bytes <= SPENT_BYTES {
                kept_bytes = bytes;
            }
            bytes <= SPENT_BYTES
        });
        self.charge(kept_bytes);
        frame
    }
}

/// Tiles for the viewers that get only changes.
#[derive(Debug, Default)]
struct Watched(Vec<ViewerGroup>);

/// Viewers of one session with equal settings.
#[derive(Debug)]
struct ViewerGroup {
    session: u64,
    tiles: FrameTiles,
    viewers: Vec<Weak<Viewer>>,
}

impl Watched {
    /// Removes viewers that have ended, and groups without viewers.
    fn forget_the_gone(&mut self) {
        let stays = |viewer: &Weak<Viewer>| viewer.upgrade().is_some_and(|viewer| !viewer.is_gone());
        self.0.iter_mut().for_each(|kind| kind.viewers.retain(stays));
        self.0.retain(|kind| !kind.viewers.is_empty());
    }

    /// Ends the streams of a session's viewers, and removes their tiles, which are not up to date.
    fn give_up(&mut self, session: u64, refusal: &Refusal) {
        let kinds = self.0.extract_if(.., |kind| kind.session == session);
        let viewers = kinds.flat_map(|kind| kind.viewers).filter_map(|viewer| viewer.upgrade());
        viewers.for_each(|viewer| viewer.close(refusal.clone()));
    }

    /// Returns the tiles for a viewer, updated to the job's snapshot.
    fn tiles(&mut self, session: u64, job: &Job, viewer: &Arc<Viewer>) -> &mut FrameTiles {
        let (refinement, encoding) = (viewer.refinement, viewer.encoding);
        memory::require((frame_bytes(refinement, encoding) + moment_bytes(refinement)) as u64, "the tiles of a frame");
        let same = |kind: &ViewerGroup| {
            (kind.session, kind.tiles.refinement(), kind.tiles.encoding()) == (session, refinement, encoding)
        };
        let index = self.0.iter().position(same).unwrap_or_else(|| {
            let tiles = FrameTiles::new(&job.snapshot, refinement, encoding);
            self.0.push(ViewerGroup { session, tiles, viewers: Vec::new() });
            self.0.len() - 1
        });
        let ViewerGroup { tiles, viewers, .. } = &mut self.0[index];
        if !viewers.iter().any(|other| std::ptr::eq(other.as_ptr(), Arc::as_ptr(viewer))) {
            viewers.push(Arc::downgrade(viewer));
        }
        tiles.update(&job.snapshot);
        tiles
    }
}

fn serve(session: u64, job: &Job, spent: &mut RecycledFrames, watched: &mut Watched) {
    watched.forget_the_gone();
    let mut encoded: Vec<Arc<Frame>> = Vec::new();
    for (viewer, frame_id) in &job.viewers {
        if viewer.is_gone() || !viewer.has_credit() {
            continue;
        }
        if !viewer.always_full {
            viewer.deliver_newer(job, *frame_id, watched.tiles(session, job, viewer));
            continue;
        }
        let same = |frame: &&Arc<Frame>| frame.refinement == viewer.refinement && frame.encoding == viewer.encoding;
        let frame = encoded.iter().find(same).cloned().unwrap_or_else(|| {
            let frame = spent.encode(&job.snapshot, viewer.refinement, viewer.encoding);
            encoded.push(frame.clone());
            frame
        });
        viewer.deliver(job, *frame_id, frame, None);
    }
}

/// Reader of a viewer's frames, used by its stream ([`Viewer::new`]).
pub type FrameReader = Reader<Delivery>;

#[cfg(test)]
mod tests {
    use super::*;
    use palpate_tissue::limits::Limits;
    use palpate_tissue::scene::{PAPER, Scene};

    fn job(viewers: Vec<(Arc<Viewer>, u64)>) -> Job {
        let snapshot = Snapshot::new(&scene(), 1, 0.001, std::array::from_fn(|_| vec![0.5; 9]));
        Job { snapshot: Arc::new(snapshot), viewers, overrun_count: 0, time_dilation: 1.0 }
    }

    fn viewer(n: u32, encoding: Encoding, credit: Option<u32>) -> (Arc<Viewer>, Reader<Delivery>) {
        let grid = Refinement::new(&scene(), n, &Limits::default()).unwrap();
        Viewer::new("viewer".into(), grid, encoding, 60.0, true, credit, 1 << 20, &Account::alone()).unwrap()
    }

    #[tokio::test]
    async fn who_asks_for_the_same_shares_one_encoding() {
        let (a, mut read_a) = viewer(2, Encoding::I16, None);
        let (b, mut read_b) = viewer(2, Encoding::I16, Some(3));
        let (c, mut read_c) = viewer(2, Encoding::F32, None);
        let mut spent = RecycledFrames::of(&Budget::new(&Limits::default(), 1, 1));
        serve(1, &job(vec![(a, 7), (b, 9), (c, 7)]), &mut spent, &mut Watched::default());
        // One frame of each kind is kept and charged.
        let account = spent.account.clone();
        assert_eq!(account.has(Resource::Memory(Purpose::Frames)), 49 * 6 + 49 * 12);
        spent.clear();
        assert_eq!(account.has(Resource::Memory(Purpose::Frames)), 0);
        let (a, b, c) = (read_a.pop().await.unwrap().0, read_b.pop().await.unwrap().0, read_c.pop().await.unwrap().0);
        assert!(Arc::ptr_eq(&a.frame, &b.frame) && !Arc::ptr_eq(&a.frame, &c.frame));
        assert_eq!((a.frame_id, b.frame_id), (7, 9));
    }

    #[tokio::test]
    async fn who_wants_changes_gets_all_of_them_however_it_reads() {
        let grid = Refinement::new(&scene(), 0, &Limits::default()).unwrap();
        let account = Account::alone();
        let changes =
            |credit| Viewer::new("viewer".into(), grid, Encoding::F32, 60.0, false, credit, 1 << 20, &account).unwrap();
        let ((slow, mut read_slow), (thrifty, mut read_thrifty)) = (changes(None), changes(Some(1)));
        let (mut spent, mut watched) = (RecycledFrames::of(account.budget()), Watched::default());
        let mut show = |frame_id: u64, z: f32| {
            let snapshot = Snapshot::new(&scene(), frame_id, 0.001, [vec![0.0; 9], vec![0.0; 9], vec![z; 9]]);
            let viewers = vec![(slow.clone(), frame_id), (thrifty.clone(), frame_id)];
            serve(1, &Job { snapshot: Arc::new(snapshot), ..job(viewers) }, &mut spent, &mut watched);
        };
        (0..4).for_each(|frame_id| show(frame_id, frame_id as f32));
        // A viewer that has not read yet gets all changes since then; one without credit gets nothing.
        let (newest, first) = (read_slow.pop().await.unwrap().0, read_thrifty.pop().await.unwrap().0);
        assert_eq!((newest.frame_id, newest.since, newest.frame.full), (3, None, true));
        assert_eq!((first.frame_id, first.since, first.frame.step), (0, None, 0));
        show(4, 3.0);
        show(5, 3.0);
        thrifty.acknowledge(0);
        show(6, 3.0);
        show(7, 4.0);
        let (newest, second) = (read_slow.pop().await.unwrap().0, read_thrifty.pop().await.unwrap().0);
        // Nothing changed in 4, 5 and 6.
        assert_eq!((newest.frame_id, newest.since.is_some(), newest.unchanged), (7, true, 3));
        assert_eq!((second.frame_id, second.since.is_some(), second.unchanged), (6, true, 0));
        thrifty.acknowledge(6);
        drop((read_slow, read_thrifty));
        show(8, 5.0);
        assert!(watched.0.is_empty(), "what nobody looks at is forgotten");
    }

    /// Three points a side.
    fn scene() -> Scene {
        Scene::parse("test", PAPER, &["sheet.points=[3, 3]".to_owned()], &Limits::default()).unwrap()
    }

    #[test]
    fn a_job_that_waits_is_replaced_and_keeps_its_place_and_its_viewers() {
        let encoder = Encoder::default();
        let ((a, _read_a), (b, _read_b)) = (viewer(0, Encoding::F32, None), viewer(1, Encoding::F32, None));
        encoder.post(5, job(vec![(a.clone(), 1)]));
        encoder.post(3, job(vec![(a.clone(), 1)]));
        encoder.post(5, job(vec![(b.clone(), 2)]));
        let board = lock(&encoder.board);
        let order: Vec<u64> = board.jobs.iter().map(|job| job.0).collect();
        assert_eq!(order, [5, 3]);
        let viewers = &board.jobs[0].1.viewers;
        assert!(Arc::ptr_eq(&viewers[0].0, &b) && Arc::ptr_eq(&viewers[1].0, &a) && viewers.len() == 2);
    }
}
