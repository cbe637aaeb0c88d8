//! What becomes of a session when something ends in the middle: a move whose target can't keep it, or dies; a
//! deletion without etcd.

use std::path::Path;
use std::time::Duration;

use palpate_proto::pb;
use palpate_session::journal::file;
use tonic::Code;

use super::fleet_turn;
use crate::common::etcd::EtcdMembers;
use crate::common::fleet::{Node, create, owner, three, until_stood_by};
use crate::common::random::TestRandom;
use crate::common::server::until;

async fn move_to(from: &Node, id: &str, to: &Node) -> Result<pb::MoveSessionResponse, tonic::Status> {
    let request = pb::MoveSessionRequest { session_id: id.to_owned(), node: to.name.clone() };
    Ok(from.admin().await.move_session(request).await?.into_inner())
}

fn run(session: &pb::Session) -> u64 {
    session.journal.as_ref().map_or(0, |journal| u64::from(journal.run))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_stays_if_the_other_server_can_not_write_its_journal() {
    let Some((_turn, folder, etcd)) = fleet_turn().await else { return };
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

/// Servers whose leases outlast a silence of etcd.
async fn patient(folder: &Path, etcd: &EtcdMembers) -> Vec<Node> {
    let config = folder.join("palpate.toml");
    std::fs::write(&config, "[cluster]\nttl_s = 60\n").unwrap();
    let more = ["--config", config.to_str().unwrap(), "--log", "warn"];
    let nodes: Vec<Node> = (0..3).map(|at| Node::start(folder, &format!("n{at}"), &etcd.endpoints(), &more)).collect();
    nodes[0].until_nodes(3).await;
    nodes
}

/// Returns a new session and its server. etcd is silent since it was created, and its standby is about to be written.
async fn being_named(nodes: &[Node], etcd: &EtcdMembers) -> (String, usize) {
    let session = create(&nodes[0]).await;
    etcd.pause(0);
    let (id, name) = (session.session_id, session.ownership.unwrap().node);
    until("its journal is mirrored", async || {
        let kept = nodes.iter().flat_map(|node| file::list(&node.journals.join("standby")).unwrap_or_default());
        kept.into_iter().any(|file| file.session_id == id)
    })
    .await;
    tokio::time::sleep(Duration::from_millis(300)).await;
    (id, nodes.iter().position(|node| node.name == name).unwrap())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_moves_also_while_its_standby_is_being_named() {
    let Some((_turn, folder, etcd)) = fleet_turn().await else { return };
    let nodes = patient(folder.path(), &etcd).await;
    for _ in 0..4 {
        let (id, at) = being_named(&nodes, &etcd).await;
        let (from, to) = (nodes[at].admin().await, &nodes[(at + 1) % 3]);
        let request = pb::MoveSessionRequest { session_id: id.clone(), node: to.name.clone() };
        let moving = tokio::spawn(async move { { from }.move_session(request).await });
        tokio::time::sleep(Duration::from_millis(500)).await;
        etcd.resume(0);
        let moved = moving.await.unwrap().unwrap().into_inner();
        assert_eq!(moved.ownership.unwrap().node, to.name);
        until("it goes on there", async || to.session(&id).await.is_ok_and(|session| session.step > 0)).await;
    }
    let (id, at) = being_named(&nodes, &etcd).await;
    let mut from = nodes[at].admin().await;
    let mut draining = from.drain_node(pb::DrainNodeRequest { stop: false }).await.unwrap().into_inner();
    tokio::time::sleep(Duration::from_millis(500)).await;
    etcd.resume(0);
    let mut drained = Vec::new();
    while let Some(told) = draining.message().await.unwrap() {
        assert_eq!(told.fault, "");
        drained.push(told.session_id);
    }
    assert!(drained.contains(&id) && nodes[at].served().await == Some(Vec::new()), "{drained:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_move_is_refused_with_the_reason_if_etcd_does_not_say_who_stands_by() {
    let Some((_turn, folder, etcd)) = fleet_turn().await else { return };
    let nodes = patient(folder.path(), &etcd).await;
    let mut refused = None;
    for _ in 0..5 {
        let (id, at) = being_named(&nodes, &etcd).await;
        let before = nodes[at].session(&id).await.unwrap();
        let (from, to) = (nodes[at].admin().await, nodes[(at + 1) % 3].name.clone());
        let request = pb::MoveSessionRequest { session_id: id.clone(), node: to };
        let mut moving = tokio::spawn(async move { { from }.move_session(request).await });
        let early = tokio::time::timeout(Duration::from_secs(10), &mut moving).await;
        etcd.resume(0);
        let Ok(moved) = early else {
            // The standby was named before etcd was silent: the session is paused until etcd is back.
            let _ = moving.await.unwrap();
            continue;
        };
        refused = Some(moved.unwrap().unwrap_err());
        let after = nodes[at].session(&id).await.unwrap();
        assert!(after.step > before.step, "it has stood: {after:?}");
        until("it moves", async || move_to(&nodes[at], &id, &nodes[(at + 1) % 3]).await.is_ok()).await;
        break;
    }
    let told = "the session stays here: etcd has not said within 5 s who stands by for it";
    assert!(refused.as_ref().is_some_and(|refused| refused.message().contains(told)), "{refused:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_has_one_server_whenever_the_one_that_takes_it_dies() {
    let Some((_turn, folder, etcd)) = fleet_turn().await else { return };
    let mut nodes = three(folder.path(), &etcd.endpoints()).await;
    let id = create(&nodes[0]).await.session_id;
    let (mut random, mut revision, mut durable_step) = (TestRandom(7), 0, 0);
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
    let Some((_turn, folder, mut etcd)) = fleet_turn().await else { return };
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
    // It has no standby either.
    until("its journals are forgotten", async || {
        nodes.iter().all(|node| {
            let left = file::list(&node.journals.join("standby")).unwrap();
            left.iter().all(|file| file.session_id != id)
        })
    })
    .await;
}
