//! Frames, off the stepping threads: a thread that refines and encodes the newest snapshot of each session, once
//! for all viewers that ask for the same, and hands it to those that have credit.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, PoisonError};

use super::queue::{Reader, Writer, lock, queue};
use crate::surface::{Encoding, Frame, Refinement, Snapshot, encode, encode_over};

/// One who looks at a session.
#[derive(Debug)]
pub struct Viewer {
    /// Random, not to be guessed.
    pub id: String,
    /// How far refined.
    pub refinement: Refinement,
    /// How written.
    pub encoding: Encoding,
    /// Frames a second of simulated time.
    pub rate_hz: f64,
    /// Frames sent and not yet acknowledged, if acknowledgements are asked for.
    credit: Option<Mutex<Credit>>,
    writer: Writer<Delivery>,
}

#[derive(Debug)]
struct Credit {
    most: usize,
    in_flight: VecDeque<u64>,
}

/// A frame on its way to one viewer.
#[derive(Debug, Clone)]
pub struct Delivery {
    /// Counts the frames that were due to the viewer.
    pub frame_id: u64,
    /// Shared with others.
    pub frame: Arc<Frame>,
    /// Steps dropped by the session so far.
    pub overrun_count: u64,
    /// Of the last second or so.
    pub time_dilation: f64,
}

impl Viewer {
    /// A viewer, and where it reads its frames.
    pub fn new(
        id: String,
        refinement: Refinement,
        encoding: Encoding,
        rate_hz: f64,
        max_in_flight: Option<u32>,
        queued_bytes: usize,
    ) -> (Arc<Self>, Reader<Delivery>) {
        let frame_bytes = refinement.vertices().iter().product::<usize>() * encoding.bytes_per_vertex();
        let room = (queued_bytes / frame_bytes).max(1);
        let most = max_in_flight.map(|most| (most as usize).min(room));
        // Without credit only the newest frame waits.
        let (writer, reader) = queue(most.unwrap_or(1));
        let credit = most.map(|most| Mutex::new(Credit { most, in_flight: VecDeque::with_capacity(most) }));
        (Arc::new(Viewer { id, refinement, encoding, rate_hz, credit, writer }), reader)
    }

    /// The number of the frame that belongs to step `step` of a session that steps at `rate_hz`.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    pub fn frame_id(&self, step: u64, rate_hz: f64) -> u64 {
        // A little more, so that 60 Hz of 1 kHz is not late by a rounding error.
        ((step as f64 + 1e-6) * self.rate_hz / rate_hz) as u64
    }

    /// Frames up to this one are done with.
    pub fn acknowledge(&self, frame_id: u64) {
        if let Some(credit) = &self.credit {
            lock(credit).in_flight.retain(|id| *id > frame_id);
        }
    }

    fn has_credit(&self) -> bool {
        self.credit.as_ref().is_none_or(|credit| {
            let credit = lock(credit);
            credit.in_flight.len() < credit.most
        })
    }

    fn deliver(&self, delivery: Delivery) {
        if let Some(credit) = &self.credit {
            lock(credit).in_flight.push_back(delivery.frame_id);
        }
        self.writer.push(delivery);
    }

    /// The stream has gone.
    pub fn is_gone(&self) -> bool {
        self.writer.is_abandoned()
    }

    /// Ends the stream.
    pub fn close(&self, why: crate::refusal::Refusal) {
        self.writer.close(why);
    }
}

/// What is to be encoded of one session: only the newest, for everybody who waits.
#[derive(Debug)]
pub struct Job {
    /// The displacements.
    pub snapshot: Snapshot,
    /// To whom, as which frame.
    pub viewers: Vec<(Arc<Viewer>, u64)>,
    /// Of the session.
    pub overrun_count: u64,
    /// Of the session.
    pub time_dilation: f64,
}

#[derive(Debug, Default)]
struct Board {
    /// By the number of the session, oldest request first: nobody is served twice before another once.
    jobs: VecDeque<(u64, Job)>,
    stop: bool,
}

/// The thread that encodes.
#[derive(Debug, Default)]
pub struct Encoder {
    board: Mutex<Board>,
    posted: Condvar,
}

impl Encoder {
    /// Replaces what waits for session `number`. Never blocks for long.
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

    /// Ends the thread.
    pub fn stop(&self) {
        lock(&self.board).stop = true;
        self.posted.notify_one();
    }

    /// The thread's work.
    pub fn work(&self) {
        let mut spent = Spent::default();
        loop {
            let mut board = lock(&self.board);
            let job = loop {
                if board.stop {
                    return;
                }
                if let Some((_, job)) = board.jobs.pop_front() {
                    break job;
                }
                board = self.posted.wait(board).unwrap_or_else(PoisonError::into_inner);
            };
            drop(board);
            serve(&job, &mut spent);
        }
    }
}

/// Bytes of frames kept for their buffers, one of each kind that was asked for lately.
const SPENT_BYTES: usize = 64 << 20;

/// The last frames of a few kinds, newest first. When the next of a kind is due, the viewers are mostly done with it.
#[derive(Debug, Default)]
struct Spent(Vec<Arc<Frame>>);

impl Spent {
    /// The next frame of a kind, in the buffers of the last one as far as they are free.
    fn encode(&mut self, snapshot: &Snapshot, refinement: Refinement, encoding: Encoding) -> Arc<Frame> {
        let same = |frame: &Arc<Frame>| frame.refinement == refinement && frame.encoding == encoding;
        let last = self.0.iter().position(same).and_then(|index| Arc::into_inner(self.0.remove(index)));
        let frame = Arc::new(match last {
            Some(last) => encode_over(snapshot, last),
            None => encode(snapshot, refinement, encoding),
        });
        self.0.insert(0, frame.clone());
        let mut bytes = 0;
        self.0.retain(|frame| {
            bytes += frame.patches.iter().map(|patch| patch.bytes.len()).sum::<usize>();
            bytes <= SPENT_BYTES
        });
        frame
    }
}

fn serve(job: &Job, spent: &mut Spent) {
    let mut encoded: Vec<Arc<Frame>> = Vec::new();
    for (viewer, frame_id) in &job.viewers {
        if viewer.is_gone() || !viewer.has_credit() {
            continue;
        }
        let same = |frame: &&Arc<Frame>| frame.refinement == viewer.refinement && frame.encoding == viewer.encoding;
        let frame = encoded.iter().find(same).cloned().unwrap_or_else(|| {
            let frame = spent.encode(&job.snapshot, viewer.refinement, viewer.encoding);
            encoded.push(frame.clone());
            frame
        });
        viewer.deliver(Delivery {
            frame_id: *frame_id,
            frame,
            overrun_count: job.overrun_count,
            time_dilation: job.time_dilation,
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::limits::Limits;

    fn job(viewers: Vec<(Arc<Viewer>, u64)>) -> Job {
        let snapshot = Snapshot::new(1, 0.001, std::array::from_fn(|_| vec![0.5; 9]));
        Job { snapshot, viewers, overrun_count: 0, time_dilation: 1.0 }
    }

    fn viewer(n: u32, encoding: Encoding, credit: Option<u32>) -> (Arc<Viewer>, Reader<Delivery>) {
        let grid = Refinement::new([3, 3], n, &Limits::default()).unwrap();
        Viewer::new("viewer".into(), grid, encoding, 60.0, credit, 1 << 20)
    }

    #[tokio::test]
    async fn who_asks_for_the_same_shares_one_encoding() {
        let (a, mut read_a) = viewer(2, Encoding::I16, None);
        let (b, mut read_b) = viewer(2, Encoding::I16, Some(3));
        let (c, mut read_c) = viewer(2, Encoding::F32, None);
        serve(&job(vec![(a, 7), (b, 9), (c, 7)]), &mut Spent::default());
        let (a, b, c) = (read_a.pop().await.unwrap().0, read_b.pop().await.unwrap().0, read_c.pop().await.unwrap().0);
        assert!(Arc::ptr_eq(&a.frame, &b.frame) && !Arc::ptr_eq(&a.frame, &c.frame));
        assert_eq!((a.frame_id, b.frame_id), (7, 9));
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
