//! When a session is due again.
#![allow(clippy::unwrap_used)]

use super::*;
use crate::budget::{Account, Budget};
use crate::limits::Limits;
use crate::pace::Pacer;
use crate::scene::{PAPER, Scene};
use crate::sheet::choice::NEVER;

/// In virtual time: a session on a beat of 1 ms, whose steps take `step_ns` on average, has just done step 0, from
/// 5 ms to 7 ms; when is it due again among so many?
#[test]
fn who_is_late_and_takes_more_than_an_equal_part_goes_after_all_that_are_due() {
    let limits = Limits::default();
    let scene = Scene::parse("paper", PAPER, &[], &limits).unwrap();
    let pacer = Pacer::start(1, 0.0, &limits, Budget::new(&limits, 1, 1)).unwrap();
    let due_ns = |step_ns: u64, awake: usize, begun_ns: u64, ended_ns: u64| {
        let live = pacer.create(&scene, true, 60.0, &Account::alone(), &NEVER).unwrap();
        (0..1000).for_each(|_| live.cost.observe(step_ns));
        let mut running = Running::new(live, true);
        running.schedule = Schedule::new(0, 1_000_000, 1000.0);
        running.next_step = 1;
        running.queue_again(begun_ns, ended_ns, awake, awake == 1);
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

/// In virtual time: 40 sessions of one caller take 2 ms of each millisecond together; one of another keeps its time.
#[test]
fn a_thread_is_divided_among_callers_first() {
    let limits = Limits::default();
    let scene = Scene::parse("paper", PAPER, &[], &limits).unwrap();
    let budget = Budget::new(&limits, 1, 1);
    let pacer = Pacer::start(1, 0.0, &limits, budget.clone()).unwrap();
    let (many, one) = (budget.account("many"), budget.account("one"));
    let mut rota = Rota::default();
    for index in 0..41 {
        let owner = if index == 40 { &one } else { &many };
        let live = pacer.create(&scene, true, 60.0, owner, &NEVER).unwrap();
        (0..1000).for_each(|_| live.cost.observe(50_000));
        let mut running = Running::new(live, true);
        running.schedule = Schedule::new(0, 1_000_000, 1000.0);
        (running.running, running.next_step) = (false, 1);
        rota.sessions.insert(index, Box::new(running));
        rota.with(index, |running| running.running = true);
    }
    assert_eq!((rota.parts(0), rota.parts(40), rota.awake.len()), (80, 2, 2));
    // All are late; those of the caller with more than its half go behind, the other does not.
    let (now_ns, due) = (10_000_000, 2_000_000);
    for (number, expected) in [(0, now_ns), (40, due)] {
        let parts = rota.parts(number);
        rota.with(number, |running| running.queue_again(now_ns, now_ns, parts, false));
        assert_eq!(rota.sessions[&number].due_ns(), Some(expected), "{number}");
    }
    // Who rests is not counted.
    (0..40).for_each(|number| drop(rota.with(number, |running| running.running = false)));
    assert_eq!((rota.parts(40), rota.awake.len()), (1, 1));
    pacer.stop();
}
