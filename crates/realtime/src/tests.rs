//! Tests of the stepping threads, and of the limits on sessions.
#![allow(clippy::unwrap_used)]

use glam::DVec3;

use super::inbox::Request;
use super::queue::Reader;
use super::*;
use palpate_refusal::Reason;
use palpate_session::Session;
use palpate_session::budget::{Account, Budget};
use palpate_session::command::{Command, Due};
use palpate_session::sample_selection::{PacedSample, Sampling};
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::script::Action;
use palpate_tissue::scene::{PAPER, Scene};
use palpate_tissue::select::scheme_selection::NEVER;

/// Opens a stream with a sample of each step.
fn all_samples(handle: &SessionHandle) -> Reader<PacedSample> {
    let (laws, touch_stiffness) = (None, false);
    let sampling = Sampling {
        every: 1,
        only: None,
        deadband: None,
        heartbeat_s: 0.01,
        laws,
        touch_stiffness,
        other_tools: false,
        wanted: None,
    };
    handle.samples(sampling, None)
}

#[tokio::test]
async fn a_fault_in_one_session_ends_that_one_alone() {
    let limits = Limits::default();
    let scene = Scene::parse("paper", PAPER, &[], &limits).unwrap();
    let pacer = Pacer::start(1, 0.02, &limits, Budget::new(&limits, 1, 1)).unwrap();
    let [faulty, sound] = [(); 2].map(|()| pacer.create(&scene, false, 60.0, &Account::alone(), &NEVER).unwrap());
    let mut samples = all_samples(&faulty);
    samples.pop().await.unwrap();
    faulty.inbox.send(faulty.number, Request::Panic);
    let told = faulty.hash_at(Some(1_000_000), &Account::alone()).await.unwrap_err();
    assert_eq!((told.reason, faulty.status().state), (Reason::SessionHeld, RunState::Held));
    assert!(told.message.contains("a test"), "{told}");
    let ended = loop {
        if let Err(ended) = samples.pop().await {
            break ended;
        }
    };
    assert_eq!(ended.reason, Reason::SessionHeld);
    let refused = faulty.at_intake(|intake, now| intake.acquire(&[0], "", 1.0, 1, now));
    assert_eq!(refused.unwrap_err().reason, Reason::SessionHeld);
    // On the same thread.
    let step = sound.status().step;
    assert_eq!(sound.hash_at(Some(step + 20), &Account::alone()).await.unwrap().0, step + 20);
    pacer.stop();
}

#[tokio::test]
async fn a_session_that_goes_apart_does_what_it_is_asked_and_leaves_its_thread_to_others() {
    let limits = Limits::default();
    let scene = Scene::parse("paper", PAPER, &[], &limits).unwrap();
    let pacer = Pacer::start(1, 0.0, &limits, Budget::new(&limits, 1, 1)).unwrap();
    let account = Account::alone();
    let [heavy, light] = [(); 2].map(|()| pacer.create(&scene, false, 60.0, &account, &NEVER).unwrap());
    let mut samples = all_samples(&heavy);
    samples.pop().await.unwrap();
    heavy.inbox.send(heavy.number, Request::GoApart);
    // Requested in this order, and done in this order, on the other thread.
    heavy.pause().await.unwrap();
    assert_eq!((heavy.thread(), light.thread()), (1, 0));
    let step = heavy.status().step;
    assert_eq!(heavy.hash_at(None, &account).await.unwrap().0, step);
    // The time that it takes there does not count here.
    (0..1000).for_each(|_| heavy.cost.observe(100_000_000));
    assert_eq!(pacer.start_session(&heavy, None).await.unwrap(), step);
    assert_eq!(heavy.hash_at(Some(step + 20), &account).await.unwrap().0, step + 20);
    samples.pop().await.unwrap();
    let (third, step) = (pacer.create(&scene, false, 60.0, &account, &NEVER).unwrap(), light.status().step);
    assert_eq!((third.thread(), light.hash_at(Some(step + 20), &account).await.unwrap().0), (0, step + 20));
    pacer.delete(&heavy.id).unwrap();
    while samples.pop().await.is_ok() {}
    pacer.stop();
}

#[tokio::test]
async fn what_a_session_is_asked_while_the_guard_repeats_is_done_after_that_step() {
    let limits = Limits::default();
    let sets = ["sheet.points=[9, 9]", "stepping.integrator=central", "stepping.substeps=1"].map(str::to_owned);
    let stiff = [&sets[..], &["springs.stiffness_n_per_m=100000".to_owned()]].concat();
    let scene = Scene::parse("paper", PAPER, &stiff, &limits).unwrap();
    let pacer = Pacer::start(1, 0.0, &limits, Budget::new(&limits, 1, 1)).unwrap();
    let account = Account::alone();
    let handle = pacer.create(&scene, true, 60.0, &account, &NEVER).unwrap();
    let push = Poke {
        point: None,
        centre_m: DVec3::new(0.13, 0.13, 0.0),
        force_n: DVec3::NEG_Z,
        falloff_per_m: 100.0,
        falloff_offset: 0.0,
    };
    handle
        .at_intake(|intake, now| {
            intake.acquire(&[0], "", 60.0, 1, now)?;
            intake.submit(1, vec![Command::new(0, Some(1), Action::Push(push))], now)
        })
        .unwrap();
    let mut alone = Session::new(&handle.model);
    alone.advance(&mut vec![Due::in_time(Command::new(0, Some(1), Action::Push(push)))], |_| {});
    pacer.start_session(&handle, Some(400)).await.unwrap();
    for step in 2..=400 {
        alone.advance(&mut Vec::new(), |_| {});
        if step % 16 == 0 {
            let (at, hash) = handle.hash_at(Some(step), &account).await.unwrap();
            assert_eq!((at, hash), (step, alone.tissue().state_hash()), "{step}");
        }
    }
    assert!(alone.recoveries().count() > 0 || alone.tissue().guard_events() > 0);
    pacer.delete(&handle.id).unwrap();
    pacer.stop();
}

#[tokio::test]
async fn the_place_of_a_deleted_session_is_free_while_others_still_read_it() {
    let limits = Limits { sessions: 1, ..Limits::default() };
    let scene = Scene::parse("paper", PAPER, &[], &limits).unwrap();
    let budget = Budget::new(&limits, 1, 1);
    let caller = budget.account("a caller");
    let pacer = Pacer::start(1, 0.02, &limits, budget).unwrap();
    let read = pacer.create(&scene, false, 60.0, &caller, &NEVER).unwrap();
    let refused = pacer.create(&scene, false, 60.0, &caller, &NEVER).err().map(|refusal| refusal.reason);
    assert_eq!(refused, Some(Reason::TooMany));
    pacer.delete(&read.id).unwrap();
    pacer.create(&scene, false, 60.0, &caller, &NEVER).unwrap();
    pacer.stop();
}
