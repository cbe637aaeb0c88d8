//! Builds and steps a copy of the tissue on a thread of its own. The server decides how large the tissue is, so a
//! step may take long: the device's loop never waits for one. It leaves its newest place in one slot and finds in
//! another what the tool felt at an earlier place, usually that of the last tick. What the server reports of cuts comes to this
//! thread from that of the network, and does not pass through the loop either.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use glam::DVec3;
use palpate_haptics::prediction::MAX_OTHERS;
use palpate_haptics::{InstrumentPose, OtherTool, Predicted, Predictor, ReportedCuts};
use tokio::sync::{OwnedSemaphorePermit, oneshot};

use crate::exchange::{NewestReader, NewestWriter, QueueReader, QueueWriter, newest, queue};

/// Age above which a result is not rendered, s: local models are more accurate then.
const MAX_LATE_S: f64 = 0.0045;

/// Interval at which the thread checks for a new place. A tick wakes no thread, because that would be a call of the
/// system.
const ROUND: Duration = Duration::from_micros(200);

/// Number of checks without a new place after which they become less frequent.
const PATIENT_ROUNDS: u32 = 5000;
const LONG_ROUND: Duration = Duration::from_millis(5);

/// Where the tool is at a time, and the other tools.
#[derive(Clone, Copy)]
struct ToolsThen {
    now_s: f64,
    pose: InstrumentPose,
    others: [Option<OtherTool>; MAX_OTHERS],
}

/// What the tool felt at a place.
#[derive(Clone, Copy)]
struct Felt {
    now_s: f64,
    felt: Option<Predicted>,
}

/// A copy that another thread steps. Its method takes a fixed number of operations. The thread ends after its current
/// step when this is dropped.
struct Stepped {
    places: NewestWriter<ToolsThen>,
    felt: NewestReader<Felt>,
    is_over: Arc<AtomicBool>,
}

impl Predictor for Stepped {
    fn feel(&mut self, now_s: f64, pose: &InstrumentPose, others: &[OtherTool]) -> Option<Predicted> {
        self.felt.refresh();
        let Felt { now_s: then_s, felt } = *self.felt.read();
        self.places.write(|place| {
            (place.now_s, place.pose) = (now_s, *pose);
            let others = others.iter().copied().map(Some).chain(std::iter::repeat(None));
            place.others.iter_mut().zip(others).for_each(|(place, other)| *place = other);
        });
        felt.filter(|_| now_s - then_s <= MAX_LATE_S)
    }
}

impl Drop for Stepped {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
    }
}

/// Largest number of reports of cuts that wait for the thread.
const REPORTS: usize = 4;

/// The end of the network: what the copy learns of cuts.
pub(super) struct CutsWriter {
    reports: QueueWriter<ReportedCuts>,
    /// The version of the topology that the copy has, once it has read all reports.
    version: u32,
}

impl CutsWriter {
    /// Returns the version of the topology that the copy has, with the reports so far.
    pub(super) fn version(&self) -> u32 {
        self.version
    }

    /// Passes a report to the copy. Drops it if too many wait: the version then stays.
    pub(super) fn report(&mut self, cuts: ReportedCuts) {
        let version = cuts.version;
        if self.reports.push(cuts).is_ok() {
            self.version = version;
        }
    }
}

/// A copy that was made: the end of the loop, and that of the network if the copy follows cuts.
pub(super) struct MadeCopy {
    pub(super) copy: Box<dyn Predictor>,
    pub(super) cuts: Option<CutsWriter>,
}

/// The end of the stepping thread.
struct Stepper {
    places: NewestReader<ToolsThen>,
    /// The other tools at the newest place.
    others: Vec<OtherTool>,
    felt: NewestWriter<Felt>,
    reports: QueueReader<ReportedCuts>,
    is_over: Arc<AtomicBool>,
}

impl Stepper {
    /// Passes the reports of cuts to the copy, and steps it to the newest place. Returns whether there was a new one.
    fn step(&mut self, copy: &mut dyn Predictor) -> bool {
        while let Some(cuts) = self.reports.pop() {
            copy.follow_cuts(&cuts);
        }
        if !self.places.refresh() {
            return false;
        }
        let ToolsThen { now_s, pose, others } = self.places.read();
        self.others.clear();
        self.others.extend(others.iter().map_while(|other| *other));
        let now_s = *now_s;
        let felt = copy.feel(now_s, pose, &self.others);
        self.felt.write(|newest| *newest = Felt { now_s, felt });
        true
    }

    fn is_over(&self) -> bool {
        self.is_over.load(Ordering::Relaxed)
    }

    /// Steps until the other end is dropped.
    fn run(mut self, copy: &mut dyn Predictor) {
        let mut idle = 0_u32;
        while !self.is_over() {
            if self.step(copy) {
                idle = 0;
            } else {
                idle = idle.saturating_add(1);
                std::thread::sleep(if idle < PATIENT_ROUNDS { ROUND } else { LONG_ROUND });
            }
        }
    }
}

/// Creates the ends of a copy: of the loop, the stepping thread and the network.
fn ends() -> (Stepped, Stepper, QueueWriter<ReportedCuts>) {
    let (places, to_step) =
        newest(&ToolsThen { now_s: 0.0, pose: InstrumentPose::at(DVec3::ZERO), others: [None; MAX_OTHERS] });
    let (told, felt) = newest(&Felt { now_s: f64::NEG_INFINITY, felt: None });
    let is_over = Arc::new(AtomicBool::new(false));
    let (reporting, reports) = queue(REPORTS);
    let others = Vec::with_capacity(MAX_OTHERS);
    let stepper = Stepper { places: to_step, others, felt: told, reports, is_over: is_over.clone() };
    (Stepped { places, felt, is_over }, stepper, reporting)
}

/// Runs `make` on the thread that will step its result, and returns the future result. Drops `permit` when that
/// thread ends. If nobody waits for the result any longer, the thread ends as soon as the copy is built.
pub(super) fn made_apart(
    make: impl FnOnce() -> Result<Box<dyn Predictor>, String> + Send + 'static,
    permit: OwnedSemaphorePermit,
) -> io::Result<oneshot::Receiver<Result<MadeCopy, String>>> {
    let (tell, made) = oneshot::channel();
    // Not a thread of the runtime: the runtime would wait for it when it ends.
    std::thread::Builder::new().name("copy".to_owned()).spawn(move || {
        let _permit = permit;
        match make() {
            Ok(mut copy) => {
                let (stepped, stepper, reports) = ends();
                let cuts = copy.topology_version().map(|version| CutsWriter { reports, version });
                if tell.send(Ok(MadeCopy { copy: Box::new(stepped), cuts })).is_ok() {
                    stepper.run(&mut *copy);
                }
            }
            Err(why) => drop(tell.send(Err(why))),
        }
    })?;
    Ok(made)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::sync::mpsc;

    use palpate_haptics::{ContactState, Wrench};
    use tokio::sync::Semaphore;

    use super::*;

    fn pressed(place_m: DVec3) -> Predicted {
        Predicted {
            wrench: Wrench::of_force(-400.0 * place_m),
            contact_state: ContactState::Sticking,
            own_work_j: 0.0,
            others_work_j: 0.0,
        }
    }

    /// A spring.
    struct CopySpring;

    impl Predictor for CopySpring {
        fn feel(&mut self, _: f64, pose: &InstrumentPose, _: &[OtherTool]) -> Option<Predicted> {
            Some(pressed(pose.place_m))
        }
    }

    #[test]
    fn a_tick_gets_what_was_felt_at_the_last_one_and_nothing_old() {
        let (mut stepped, mut stepper, _) = ends();
        let place_m = |tick: u32| DVec3::new(0.0, 0.0, -1e-4 * f64::from(tick));
        let at = |tick: u32| InstrumentPose::at(place_m(tick));
        for tick in 0..50 {
            let felt = stepped.feel(f64::from(tick) * 1e-3, &at(tick), &[]);
            assert_eq!(felt, tick.checked_sub(1).map(|last| pressed(place_m(last))));
            assert!(stepper.step(&mut CopySpring) && !stepper.step(&mut CopySpring));
        }
        // The thread is in a step that does not end.
        let felt: Vec<bool> =
            (50..60).map(|tick| stepped.feel(f64::from(tick) * 1e-3, &at(tick), &[]).is_some()).collect();
        assert_eq!(felt, [true, true, true, true, false, false, false, false, false, false]);
        // It continues with the newest place.
        assert!(stepper.step(&mut CopySpring));
        assert_eq!(stepped.feel(0.060, &at(60), &[]), Some(pressed(place_m(59))));
        drop(stepped);
        assert!(stepper.is_over());
    }

    /// A copy whose steps end when the test says so.
    struct Endless(mpsc::Receiver<()>);

    impl Predictor for Endless {
        fn feel(&mut self, _: f64, pose: &InstrumentPose, _: &[OtherTool]) -> Option<Predicted> {
            let _ = self.0.recv();
            Some(pressed(pose.place_m))
        }
    }

    /// A copy that counts what is severed.
    struct CountingCuts(u32);

    impl Predictor for CountingCuts {
        fn feel(&mut self, _: f64, _: &InstrumentPose, _: &[OtherTool]) -> Option<Predicted> {
            Some(pressed(f64::from(self.0) * DVec3::Z))
        }

        fn topology_version(&self) -> Option<u32> {
            Some(self.0)
        }

        fn follow_cuts(&mut self, cuts: &ReportedCuts) {
            self.0 += cuts.version;
        }
    }

    #[test]
    fn reports_of_cuts_reach_the_copy_before_its_next_step_and_few_wait() {
        let (mut stepped, mut stepper, reports) = ends();
        let mut copy = CountingCuts(7);
        let mut cuts = CutsWriter { reports, version: copy.0 };
        (10..20).for_each(|version| cuts.report(ReportedCuts { version, ..ReportedCuts::default() }));
        // The version is that of the last report that was passed on: the others are fetched again.
        assert_eq!(cuts.version(), 13);
        let at_rest = InstrumentPose::at(DVec3::ZERO);
        assert_eq!(stepped.feel(0.0, &at_rest, &[]), None);
        assert!(stepper.step(&mut copy));
        let summed = 7 + (10..14).sum::<u32>();
        assert_eq!(stepped.feel(1e-3, &at_rest, &[]), Some(pressed(f64::from(summed) * DVec3::Z)));
        cuts.report(ReportedCuts { version: 20, ..ReportedCuts::default() });
        assert_eq!(cuts.version(), 20);
        assert!(stepper.step(&mut copy) && copy.0 == summed + 20);
    }

    #[test]
    fn a_step_that_does_not_end_holds_up_no_tick_and_keeps_its_place() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        runtime.block_on(async {
            let places = Arc::new(Semaphore::new(1));
            let (end, ended) = mpsc::channel();
            let permit = places.clone().acquire_owned().await.unwrap();
            let made = made_apart(move || Ok(Box::new(Endless(ended))), permit).unwrap();
            let mut copy = made.await.unwrap().unwrap().copy;
            // This thread gets past although no step ends.
            assert!(
                (0..1000)
                    .all(|tick| copy.feel(f64::from(tick) * 1e-3, &InstrumentPose::at(DVec3::ZERO), &[]).is_none())
            );
            drop(copy);
            drop(end);
            // Once the step has ended, another copy can be built.
            let permit = places.acquire_owned().await.unwrap();
            let refused = made_apart(|| Err("too large".to_owned()), permit).unwrap().await.unwrap();
            assert_eq!(refused.err().as_deref(), Some("too large"));
        });
    }
}
