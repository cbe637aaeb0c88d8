//! A session that moves to another server in the middle of a cut.

use palpate_proto::{instrument, pb};

use super::fleet_turn;
use crate::common::fleet::{three, until_stood_by};
use crate::common::server::{TestServer, TestTouch, open};
use crate::haptics::blades::{STEPS, create, knife, lead, topology};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_cut_goes_on_at_another_server_with_the_same_bits() {
    let Some((_turn, folder, etcd)) = fleet_turn().await else { return };
    let liver = || pb::create_session_request::Source::SceneName("liver".into());
    let with_knife =
        |session: &str| pb::TouchOpen { instruments: vec![instrument::instrument(&knife(), 0)], ..open(session, &[0]) };
    // The same cut where nothing moves.
    let alone = TestServer::start(&[]);
    let whole = create(&alone, liver()).await;
    let mut touch = TestTouch::open(&alone, with_knife(&whole)).await.unwrap();
    lead(&alone, &whole, &mut touch, 0..STEPS).await;
    let (severed, hash) = (topology(&alone, &whole, 0).await.severed, alone.hash_at(&whole, STEPS).await);

    let nodes = three(folder.path(), &etcd.endpoints()).await;
    let id = create(nodes[0].there(), liver()).await;
    let (at, _) = until_stood_by(&nodes, &id).await;
    let mut touch = TestTouch::open(nodes[at].there(), with_knife(&id)).await.unwrap();
    lead(nodes[at].there(), &id, &mut touch, 0..STEPS / 2).await;
    let half = topology(nodes[at].there(), &id, 0).await;
    assert!(!half.severed.is_empty() && half.severed.len() < severed.len());
    let lease_id = touch.opened.as_ref().unwrap().lease_id.clone();
    let to = (at + 1) % 3;
    let request = pb::MoveSessionRequest { session_id: id.clone(), node: nodes[to].name.clone() };
    nodes[at].admin().await.move_session(request).await.unwrap();
    let moved = topology(nodes[to].there(), &id, 0).await;
    assert_eq!(moved.severed, half.severed);
    let mut touch = TestTouch::open(nodes[to].there(), pb::TouchOpen { lease_id, ..with_knife(&id) }).await.unwrap();
    lead(nodes[to].there(), &id, &mut touch, STEPS / 2..STEPS).await;
    let all = topology(nodes[to].there(), &id, 0).await;
    assert_eq!((all.severed, nodes[to].there().hash_at(&id, STEPS).await), (severed, hash));
}
