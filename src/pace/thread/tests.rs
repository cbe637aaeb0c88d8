//! When a session is due again.
#![allow(clippy::unwrap_used)]

use super::*;
use crate::limits::Limits;
use crate::pace::Pacer;
use crate::scene::{PAPER, Scene};

/// In virtual time: a session on a beat of 1 ms, whose steps take `step_ns` on average, has just done step 0, from
/// 5 ms to 7 ms; when is it due again among so many?
#[test]
fn who_is_late_and_takes_more_than_an_equal_part_goes_after_all_that_are_due() {
    let limits = Limits::default();
    let scene = Scene::parse("paper", PAPER, &[], &limits).unwrap();
    let pacer = Pacer::start(1, 0.0, &limits).unwrap();
    let due_ns = |step_ns: u64, awake: usize, begun_ns: u64, ended_ns: u64| {
        let live = pacer.create(&scene, true, 60.0).unwrap();
        (0..1000).for_each(|_| live.cost.observe(step_ns));
        let mut running = Running::new(live, true);
        running.schedule = Schedule::new(0, 1_000_000, 1000.0);
        running.next_step = 1;
        running.queue_again(begun_ns, ended_ns, awake);
        running.due_ns().unwrap()
    };
    let (ms, on_time) = (1_000_000, 2_000_000);
    // Heavy and late: after everybody who is due by now.
    assert_eq!(due_ns(2 * ms, 2, 5 * ms, 7 * ms), 7 * ms);
    // Late through no fault of its own, alone on its thread, or heavy but on time: when its step is due.
    assert_eq!(due_ns(10_000, 2, 5 * ms, 7 * ms), on_time);
    assert_eq!(due_ns(2 * ms, 1, 5 * ms, 7 * ms), on_time);
    assert_eq!(due_ns(2 * ms, 2, ms, 2 * ms), on_time);
    pacer.stop();
}
