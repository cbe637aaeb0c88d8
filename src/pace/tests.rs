//! Tests of the threads that step, and of who may have a session.
#![allow(clippy::unwrap_used)]

use super::inbox::Request;
use super::*;
use crate::budget::{Account, Budget};
use crate::limits::Limits;
use crate::refusal::Reason;
use crate::scene::{PAPER, Scene};
use crate::session::sampling::Sampling;
use crate::sheet::choice::NEVER;

#[tokio::test]
async fn a_fault_in_one_session_ends_that_one_alone() {
    let limits = Limits::default();
    let scene = Scene::parse("paper", PAPER, &[], &limits).unwrap();
    let pacer = Pacer::start(1, 0.02, &limits, Budget::new(&limits, 1, 1)).unwrap();
    let [faulty, sound] = [(); 2].map(|()| pacer.create(&scene, false, 60.0, &Account::alone(), &NEVER).unwrap());
    let (laws, touch_stiffness) = (None, false);
    let mut samples = faulty.samples(
        Sampling { every: 1, only: None, deadband: None, heartbeat_s: 0.01, laws, touch_stiffness, wanted: None },
        None,
    );
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
