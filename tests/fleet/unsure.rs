//! What becomes of a session when something ends in the middle: a move whose target can't keep it, or dies; a deletion without etcd.

use std::time::Duration;

use palpate::journal::file;
use palpate_proto::pb;
use tonic::Code;

use crate::ONE;
use crate::etcd::Etcd;
use crate::fleet::{Node, create, owner, three, until, until_stood_by};
use crate::random::Random;

async fn move_to(from: &Node, id: &str, to: &Node) -> Result<pb::MoveSessionResponse, tonic::Status> {
    let request = pb::MoveSessionRequest { session_id: id.to_owned(), node: to.name.clone() };
    Ok(from.admin().await.move_session(request).await?.into_inner())
}

fn run(session: &pb::Session) -> u64 {
    session.journal.as_ref().map_or(0, |journal| u64::from(journal.run))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_stays_if_the_other_server_can_not_write_its_journal() {
    if !Etcd::is_there() {
        return;
    }
    let _one = ONE.lock().await;
    let folder = tempfile::tempdir().unwrap();
    let etcd = Etcd::start(1);
    let nodes = three(folder.path(), &etcd.endpoints()).await;
    let id = create(&nodes[0]).await.session_id;
    let (at, before) = until_stood_by(&nodes, &id).await;
    let to = (at + 1) % 3;
    // Where its next journal would be is something else.
    let taken = nodes[to].journals.join(file::name(&id, run(&before) + 1));
    std::fs::create_dir(&taken).unwrap();
    let refused = move_to(&nodes[at], &id, &nodes[to]).await.unwrap_err();
    assert!(refused.message().contains("the session stays here"), "{refused}");
    let after = nodes[at].session(&id).await.unwrap();
    assert!(after.ownership.unwrap().node == nodes[at].name && after.step >= before.step);
    until("it goes on", async || nodes[at].session(&id).await.is_ok_and(|now| now.step > after.step)).await;
    assert!(nodes[to].session(&id).await.is_err());
    // The other server has not kept it in mind: it takes it when it can.
    std::fs::remove_dir(&taken).unwrap();
    until("it moves", async || move_to(&nodes[at], &id, &nodes[to]).await.is_ok()).await;
    assert_eq!(owner(&nodes, &id).await, Some(to));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_has_one_server_whenever_the_one_that_takes_it_dies() {
    if !Etcd::is_there() {
        return;
    }
    let _one = ONE.lock().await;
    let folder = tempfile::tempdir().unwrap();
    let etcd = Etcd::start(1);
    let mut nodes = three(folder.path(), &etcd.endpoints()).await;
    let id = create(&nodes[0]).await.session_id;
    let (mut random, mut revision, mut durable_step) = (Random(7), 0, 0);
    for round in 0..5 {
        let (at, session) = until_stood_by(&nodes, &id).await;
        let now = session.ownership.as_ref().unwrap().revision;
        assert!(now >= revision && session.step >= durable_step, "round {round}: {now} {revision} {durable_step}");
        revision = now;
        durable_step = session.journal.as_ref().and_then(|journal| journal.durable_step).unwrap_or_default();
        let to = (at + 1) % 3;
        let (from, name) = (nodes[at].admin().await, nodes[to].name.clone());
        let request = pb::MoveSessionRequest { session_id: id.clone(), node: name };
        let moving = tokio::spawn(async move { { from }.move_session(request).await.is_ok() });
        // At any moment of the move.
        tokio::time::sleep(Duration::from_millis(random.below(60))).await;
        nodes[to].kill();
        moving.await.unwrap();
        nodes[to].begin();
        nodes[at].until_nodes(3).await;
        until("somebody has it", async || owner(&nodes, &id).await.is_some()).await;
        let mut served = 0;
        for node in &nodes {
            served += usize::from(node.session(&id).await.is_ok());
        }
        assert_eq!(served, 1, "round {round}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_deletion_is_confirmed_only_when_etcd_has_done_it() {
    if !Etcd::is_there() {
        return;
    }
    let _one = ONE.lock().await;
    let folder = tempfile::tempdir().unwrap();
    let mut etcd = Etcd::start(1);
    let nodes = three(folder.path(), &etcd.endpoints()).await;
    let id = create(&nodes[0]).await.session_id;
    let (at, _) = until_stood_by(&nodes, &id).await;
    let request = pb::DeleteSessionRequest { session_id: id.clone() };
    let mut sessions = nodes[at].there().sessions().await;
    etcd.stop_all();
    // For a moment the server may still act for its sessions.
    let refused = sessions.delete_session(request).await.unwrap_err();
    assert_eq!(refused.code(), Code::Unavailable, "{refused}");
    etcd.restart_all();
    for node in &nodes {
        until("it is deleted", async || node.session(&id).await.is_err_and(|refused| refused.code() == Code::NotFound))
            .await;
    }
    // Nor does anybody stand by for it any more.
    until("its journals are forgotten", async || {
        nodes.iter().all(|node| {
            let left = file::list(&node.journals.join("standby")).unwrap();
            left.iter().all(|file| file.session_id != id)
        })
    })
    .await;
}
