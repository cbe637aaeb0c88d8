//! A fleet of real servers on a real etcd: who has a session, what becomes of it when its server dies, freezes, loses
//! etcd, or hands it over.
#![cfg(target_os = "linux")]

mod cut;
mod unsure;

use std::collections::BTreeMap;
use std::time::Duration;

use crate::common::authority::Authority;
use crate::common::etcd::EtcdMembers;
use crate::common::fleet::{self, FLEETS, Node, create, goes_on, owner, three, until_stood_by, verify};
use crate::common::server::{self, TestServer, TestTouch, force, told, until, waiting};
use palpate_proto::pb;
use palpate_refusal::status::elsewhere;
use palpate_session::journal::file;
use pb::touch_response::Message as Heard;
use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;
use tokio::sync::SemaphorePermit;
use tonic::Code;

/// A turn, a folder and an etcd. `None` where etcd is not installed.
async fn fleet_turn() -> Option<(SemaphorePermit<'static>, TempDir, EtcdMembers)> {
    if !EtcdMembers::is_there() {
        return None;
    }
    Some((FLEETS.acquire().await.unwrap(), tempfile::tempdir().unwrap(), EtcdMembers::start(1)))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn any_server_creates_sessions_and_tells_where_they_are() {
    let Some((_turn, folder, etcd)) = fleet_turn().await else { return };
    let nodes = three(folder.path(), &etcd.endpoints()).await;
    let mut made = BTreeMap::new();
    for index in 0..9 {
        let session = create(&nodes[index % 3]).await;
        let ownership = session.ownership.unwrap();
        made.insert(session.session_id, ownership.node);
        // It is sent to the others twice a second.
        tokio::time::sleep(Duration::from_millis(600)).await;
    }
    let of = |name: &str| made.values().filter(|node| *node == name).count();
    assert!(["n0", "n1", "n2"].iter().all(|name| (2..=4).contains(&of(name))), "{made:?}");
    for (id, name) in &made {
        let url = &nodes.iter().find(|node| node.name == *name).unwrap().url;
        for node in &nodes {
            let request = pb::LocateSessionRequest { session_id: id.clone() };
            let located = node.there().sessions().await.locate_session(request).await.unwrap().into_inner();
            assert_eq!(
                (&located.ownership.as_ref().unwrap().endpoint, &located.ownership.as_ref().unwrap().node),
                (url, name)
            );
            match node.session(id).await {
                Ok(_) => assert_eq!(node.name, *name),
                Err(refused) => {
                    assert_eq!((refused.code(), elsewhere(&refused)), (Code::FailedPrecondition, Some(url.clone())));
                }
            }
        }
    }
    for unknown in ["0123456789abcdef0123456789abcdef", "../nodes/n0", ""] {
        assert_eq!(nodes[0].session(unknown).await.unwrap_err().code(), Code::NotFound, "{unknown}");
    }
    // A deleted session is known nowhere.
    let (id, name) = made.first_key_value().unwrap();
    let there = nodes.iter().find(|node| node.name == *name).unwrap();
    let request = pb::DeleteSessionRequest { session_id: id.clone() };
    there.there().sessions().await.delete_session(request).await.unwrap();
    for node in &nodes {
        assert_eq!(node.session(id).await.unwrap_err().code(), Code::NotFound);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_of_no_fleet_says_so() {
    let server = TestServer::start(&[]);
    let request = pb::LocateSessionRequest { session_id: "0".repeat(32) };
    let refused = server.sessions().await.locate_session(request).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    let id = server.paper(false).await;
    assert_eq!(server.status(&id).await.ownership, None);
    let journal = tempfile::tempdir().unwrap();
    let journal = journal.path().to_str().unwrap();
    for (arguments, missing) in [
        (vec!["--cluster", "http://127.0.0.1:1", "--advertise", "http://127.0.0.1:2"], "journal"),
        (vec!["--cluster", "http://127.0.0.1:1"], "--advertise"),
        (
            vec!["--cluster", "http://127.0.0.1:1", "--advertise", "http://10.0.0.1:2", "--journal", journal],
            "cluster.ca",
        ),
        (
            vec!["--cluster", "http://127.0.0.1:1", "--advertise", "http://127.0.0.1:2", "--journal", journal],
            "cluster.etcd",
        ),
    ] {
        let refused = server::palpate(&[&["serve", "--listen", "127.0.0.1:0"][..], &arguments].concat());
        let told = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert!(!refused.status.success() && told.contains(missing), "{arguments:?}: {told}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_fleet_makes_no_sessions_for_exercises_and_loses_none_that_a_server_brings() {
    let Some((_turn, folder, etcd)) = fleet_turn().await else { return };
    let chosen = || {
        let source = Some(pb::chosen_exercise::Source::Name("lumps-1".to_owned()));
        pb::create_session_request::Source::Exercise(pb::ChosenExercise { source, ..Default::default() })
    };
    let journals = folder.path().join("n0");
    let mut alone = TestServer::start(&["--journal", journals.to_str().unwrap()]);
    let made = alone.create(chosen(), true).await.unwrap();
    let (id, trainee_id) = (made.session_id, made.exercise.unwrap().trainee_id);
    kill_process(Pid::from_child(&alone.child), Signal::TERM).unwrap();
    alone.child.wait().unwrap();
    let nodes = [
        Node::start(folder.path(), "n0", &etcd.endpoints(), &[]),
        Node::start(folder.path(), "n1", &etcd.endpoints(), &[]),
    ];
    for node in &nodes {
        let refused = node.there().create(chosen(), true).await.unwrap_err();
        let (code, reason, field) = told(&refused);
        assert_eq!((code, reason.as_str(), field.as_str()), (Code::FailedPrecondition, "NOT_AVAILABLE", "exercise"));
    }
    assert!(nodes[0].session(&id).await.unwrap().exercise.unwrap().seed.is_some());
    until("the other server is known", async || {
        let request = pb::MoveSessionRequest { session_id: id.clone(), node: "n1".to_owned() };
        let refused = nodes[0].admin().await.move_session(request).await.unwrap_err();
        told(&refused).1 == "NOT_AVAILABLE"
    })
    .await;
    let seen = nodes[0].session(&trainee_id).await.unwrap().exercise.unwrap();
    assert_eq!(seen.role(), pb::ExerciseRole::Trainee);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_frozen_server_says_nothing_for_its_sessions_when_it_thaws() {
    let Some((_turn, folder, etcd)) = fleet_turn().await else { return };
    let nodes = three(folder.path(), &etcd.endpoints()).await;
    let id = create(&nodes[0]).await.session_id;
    let (at, session) = until_stood_by(&nodes, &id).await;
    let mut touch = TestTouch::hold(nodes[at].there(), &id).await;
    touch.command(force(0, 1, -0.1)).await;
    let newest = touch.sample().await;
    assert_eq!(newest.ownership_revision, session.ownership.as_ref().unwrap().revision);
    nodes[at].freeze();
    let others: Vec<usize> = (0..3).filter(|other| *other != at).collect();
    let mut now = None;
    until("another server has the session", async || {
        for other in &others {
            if let Ok(session) = nodes[*other].session(&id).await {
                now = Some((*other, session));
                return true;
            }
        }
        false
    })
    .await;
    let (there, taken) = now.unwrap();
    assert!(taken.ownership.as_ref().unwrap().revision > session.ownership.as_ref().unwrap().revision);
    assert_eq!(nodes[there].name, session.ownership.as_ref().unwrap().standby);
    nodes[at].thaw();
    // Samples under way have the old revision. Then the stream ends with the reason.
    let ended = loop {
        match touch.hear().await {
            Ok(Some(Heard::Sample(sample))) => {
                assert!(sample.ownership_revision < taken.ownership.as_ref().unwrap().revision);
            }
            Ok(Some(_)) => {}
            Ok(None) => break None,
            Err(status) => break Some(status),
        }
    };
    let ended = ended.expect("a stream that is fenced ends with a reason");
    assert!([Code::Unavailable, Code::FailedPrecondition].contains(&ended.code()), "{ended}");
    until("it knows who has the session", async || {
        nodes[at].session(&id).await.is_err_and(|refused| elsewhere(&refused) == Some(nodes[there].url.clone()))
    })
    .await;
    goes_on(&nodes, &id, &nodes[there], true).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn without_etcd_all_stands_and_then_goes_on_in_place() {
    let Some((_turn, folder, mut etcd)) = fleet_turn().await else { return };
    let nodes = three(folder.path(), &etcd.endpoints()).await;
    let id = create(&nodes[0]).await.session_id;
    let (at, before) = until_stood_by(&nodes, &id).await;
    let mut touch = TestTouch::hold(nodes[at].there(), &id).await;
    touch.command(force(0, 1, -0.1)).await;
    etcd.stop_all();
    let refused = loop {
        if let Err(refused) = touch.hear().await {
            break refused;
        }
    };
    assert_eq!(refused.code(), Code::Unavailable, "{refused}");
    assert!(refused.message().contains("etcd"), "{refused}");
    assert_eq!(nodes[at].session(&id).await.unwrap_err().code(), Code::Unavailable);
    etcd.restart_all();
    until("it goes on", async || nodes[at].session(&id).await.is_ok()).await;
    let after = nodes[at].session(&id).await.unwrap();
    assert!(after.ownership.unwrap().revision >= before.ownership.unwrap().revision);
    // The tool was let go, and may be taken again.
    until("the tool is let go", async || {
        nodes[at].session(&id).await.is_ok_and(|session| session.held_tools.is_empty())
    })
    .await;
    let mut again = TestTouch::hold(nodes[at].there(), &id).await;
    again.command(force(0, 1, -0.1)).await;
    let step = again.sample().await.step;
    again.sample_with(|sample| sample.step > step).await;
    let journals = file::list(&nodes[at].journals).unwrap();
    drop((again, nodes, etcd));
    for journal in journals {
        verify(&journal.path);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_whose_owner_is_changed_by_hand_ends_at_its_old_server() {
    let Some((_turn, folder, etcd)) = fleet_turn().await else { return };
    let nodes = three(folder.path(), &etcd.endpoints()).await;
    let id = create(&nodes[0]).await.session_id;
    let at = owner(&nodes, &id).await.unwrap();
    let other = &nodes[(at + 1) % 3];
    let mut touch = TestTouch::hold(nodes[at].there(), &id).await;
    let value = serde_json::json!({ "node": other.name, "standby": "" }).to_string();
    etcd.control(&["put", &format!("/palpate/default/sessions/{id}"), &value]);
    let ended = loop {
        if let Err(status) = touch.hear().await {
            break status;
        }
    };
    assert_eq!(elsewhere(&ended), Some(other.url.clone()), "{ended}");
    let refused = nodes[at].session(&id).await.unwrap_err();
    assert_eq!(elsewhere(&refused), Some(other.url.clone()), "{refused}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_moves_with_its_tools_and_the_same_bits() {
    let Some((_turn, folder, etcd)) = fleet_turn().await else { return };
    let nodes = three(folder.path(), &etcd.endpoints()).await;
    let id = create(&nodes[0]).await.session_id;
    let mut at = owner(&nodes, &id).await.unwrap();
    let mut touch = TestTouch::hold(nodes[at].there(), &id).await;
    touch.command(force(0, 1, -0.1)).await;
    let pressed =
        touch.sample_with(|sample| sample.tools.first().is_some_and(|tool| tool.acknowledged_sequence == 1)).await;
    // Their step comes when another server has the session.
    let harder_at = pressed.step + 3000;
    touch.command(pb::Command { at_step: Some(harder_at), ..force(0, 2, -0.3) }).await;
    let request = pb::UpdateTissueRequest {
        session_id: id.clone(),
        at_step: Some(harder_at + 200),
        stiffness_n_per_m: Some(40.0),
        ..pb::UpdateTissueRequest::default()
    };
    nodes[at].there().sessions().await.update_tissue(request).await.unwrap();
    until("the command waits, or has acted on a slow machine", async || {
        let session = nodes[at].session(&id).await.unwrap();
        session.commands.unwrap().waiting == 1 || session.step > harder_at
    })
    .await;
    for _ in 0..4 {
        let to = (at + 1) % 3;
        let lease_id = touch.opened.as_ref().unwrap().lease_id.clone();
        let request = pb::MoveSessionRequest { session_id: id.clone(), node: nodes[to].name.clone() };
        let moved = nodes[at].admin().await.move_session(request).await.unwrap().into_inner();
        assert_eq!(moved.ownership.unwrap().node, nodes[to].name);
        let mut newest_n = 0.0;
        let ended = loop {
            match touch.hear().await {
                Ok(Some(Heard::Sample(sample))) => newest_n = force_n(&sample),
                Ok(_) => {}
                Err(status) => break status,
            }
        };
        assert_eq!(elsewhere(&ended), Some(nodes[to].url.clone()), "{ended}");
        // The tool is still in the tissue, and its holder continues.
        let open = pb::TouchOpen { lease_id, ..server::open(&id, &[0]) };
        touch = TestTouch::open(nodes[to].there(), open).await.unwrap();
        let sample = touch.sample_with(|sample| !sample.tools.is_empty()).await;
        assert!((force_n(&sample) - newest_n).abs() < 0.1, "{newest_n} {sample:?}");
        goes_on(&nodes, &id, &nodes[to], false).await;
        at = to;
    }
    let harder = touch.sample_with(|sample| force_n(sample) > 0.2).await;
    assert!(harder.step > harder_at, "{harder:?}");
    until("the tissue has changed", async || {
        let session = nodes[at].session(&id).await.unwrap();
        session.scene.unwrap().springs.unwrap().stiffness_n_per_m == Some(40.0)
    })
    .await;
    // An invalid lease, and an unknown server.
    let open = pb::TouchOpen { lease_id: "0".repeat(32), ..server::open(&id, &[0]) };
    assert_eq!(TestTouch::open(nodes[at].there(), open).await.err().unwrap().code(), Code::PermissionDenied);
    let request = pb::MoveSessionRequest { session_id: id.clone(), node: "nowhere".into() };
    assert_eq!(nodes[at].admin().await.move_session(request).await.unwrap_err().code(), Code::InvalidArgument);
    // Upgrades by day: nothing is left.
    let mut drained =
        nodes[at].admin().await.drain_node(pb::DrainNodeRequest { stop: false }).await.unwrap().into_inner();
    while let Some(told) = drained.message().await.unwrap() {
        assert_eq!((told.fault.as_str(), told.left), ("", 0));
        assert_ne!(told.node, nodes[at].name);
    }
    assert_ne!(owner(&nodes, &id).await, Some(at));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_change_of_the_tissue_that_waits_goes_on_at_the_server_that_takes_over() {
    let Some((_turn, folder, etcd)) = fleet_turn().await else { return };
    let mut nodes = three(folder.path(), &etcd.endpoints()).await;
    let paper = pb::create_session_request::Source::SceneName("paper".into());
    let id = nodes[0].there().create(paper, true).await.unwrap().session_id;
    let (at, session) = until_stood_by(&nodes, &id).await;
    let standby = session.ownership.unwrap().standby;
    let request = pb::UpdateTissueRequest {
        session_id: id.clone(),
        at_step: Some(100),
        stiffness_n_per_m: Some(40.0),
        ..pb::UpdateTissueRequest::default()
    };
    nodes[at].there().sessions().await.update_tissue(request).await.unwrap();
    let there = nodes.iter().position(|node| node.name == standby).unwrap();
    until("it is mirrored", async || {
        let kept = file::list(&nodes[there].journals.join("standby")).unwrap().into_iter();
        kept.filter(|file| file.session_id == id).any(|file| waiting(&file.path) == Some(vec![100]))
    })
    .await;
    nodes[at].kill();
    until("it is taken over", async || nodes[there].session(&id).await.is_ok()).await;
    nodes[there].there().start_until(&id, 150).await;
    nodes[there].there().hash_at(&id, 150).await;
    let springs = nodes[there].session(&id).await.unwrap().scene.unwrap().springs.unwrap();
    assert_eq!(springs.stiffness_n_per_m, Some(40.0));
}

fn force_n(sample: &pb::Sample) -> f64 {
    let force = sample.tools.first().and_then(|tool| tool.force_on_tool_n);
    force.map_or(0.0, |force| (force.x * force.x + force.y * force.y + force.z * force.z).sqrt())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn servers_know_each_other_by_certificates_and_clients_by_tokens() {
    let Some((_turn, folder, etcd)) = fleet_turn().await else { return };
    let authority = Authority::new();
    let write = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.display().to_string()
    };
    let known = "[[certificate]]\nname = \"node-0\"\nroles = [\"node\"]\n[[certificate]]\nname = \"node-1\"\nroles = [\"node\"]\n";
    let (ca, tokens) = (write("ca.pem", &authority.pem), write("tokens.toml", known));
    let roles = "create,touch,administer";
    let made = server::palpate(&["token", "--name", "ann", "--role", roles, "--tokens", &tokens]);
    let token = String::from_utf8(made.stdout).unwrap().trim().to_owned();
    let urls = [(); 2].map(|()| format!("https://127.0.0.1:{}", fleet::port()));
    let certify = |at: usize, name: &str| {
        let (cert, key) = authority.sign_node(&format!("{name}-{at}"));
        (write(&format!("{at}.pem"), &cert), write(&format!("{at}.key"), &key))
    };
    let serve = |at: usize| {
        let (cert, key) = certify(at, "node");
        let journal = folder.path().join(format!("journal-{at}")).display().to_string();
        let of_the_fleet =
            ["--cluster", &etcd.endpoints()[0], "--advertise", &urls[at], "--cluster-ca", &ca, "--journal", &journal];
        let of_tls = ["--tls-cert", &cert, "--tls-key", &key, "--tokens", &tokens, "--threads", "1"];
        TestServer::start_at(urls[at].trim_start_matches("https://"), &[&of_the_fleet[..], &of_tls].concat())
    };
    let _servers = [serve(0), serve(1)];
    let bearer = format!("Bearer {token}");
    let authorized = |mut request: tonic::Request<()>| {
        request.metadata_mut().insert("authorization", bearer.parse().unwrap());
        Ok::<_, tonic::Status>(request)
    };
    let to = async |at: usize, identity: Option<tonic::transport::Identity>| {
        let trust = identity.into_iter().fold(authority.trust(), tonic::transport::ClientTlsConfig::identity);
        let endpoint = tonic::transport::Channel::from_shared(urls[at].clone()).unwrap();
        endpoint.tls_config(trust).unwrap().connect().await.unwrap()
    };
    // A client needs no certificate.
    let there = to(0, None).await;
    let mut admin = pb::admin_service_client::AdminServiceClient::with_interceptor(there.clone(), authorized);
    until("both are of the fleet", async || {
        let listed = admin.list_nodes(pb::ListNodesRequest {}).await;
        listed.is_ok_and(|listed| listed.get_ref().nodes.iter().filter(|node| !node.draining).count() == 2)
    })
    .await;
    let mut sessions = pb::session_service_client::SessionServiceClient::with_interceptor(there.clone(), authorized);
    let source = pb::create_session_request::Source::SceneName("paper".into());
    let request = pb::CreateSessionRequest { source: Some(source), ..pb::CreateSessionRequest::default() };
    let session = sessions.create_session(request).await.unwrap().into_inner().session.unwrap();
    let id = session.session_id;
    // One server sends the other its journals, and hands sessions over.
    let mut ownership = session.ownership.unwrap();
    until("a session has a standby", async || {
        let request = pb::LocateSessionRequest { session_id: id.clone() };
        ownership = sessions.locate_session(request).await.unwrap().into_inner().ownership.unwrap();
        !ownership.standby.is_empty()
    })
    .await;
    let owner = urls.iter().position(|url| *url == ownership.endpoint).unwrap();
    let mut admin = pb::admin_service_client::AdminServiceClient::with_interceptor(to(owner, None).await, authorized);
    let node = ownership.standby.clone();
    let request = pb::MoveSessionRequest { session_id: id.clone(), node };
    let moved = admin.move_session(request).await.unwrap().into_inner().ownership.unwrap();
    assert_eq!(moved.node, ownership.standby);
    // Calls between servers are for servers only: a token that administers is not enough, nor a client without one.
    let create_here = || pb::CreateHereRequest::default();
    let mut calls = pb::node_service_client::NodeServiceClient::with_interceptor(there.clone(), authorized);
    let refused = calls.create_here(create_here()).await.unwrap_err();
    assert_eq!(server::told(&refused).1, "ROLE_MISSING");
    let mut calls = pb::node_service_client::NodeServiceClient::new(there);
    assert_eq!(calls.create_here(create_here()).await.unwrap_err().code(), Code::Unauthenticated);
    // A certificate of these authorities whose name has no role counts as none; one of another authority is not
    // admitted.
    let of = |(cert, key): (String, String)| Some(tonic::transport::Identity::from_pem(cert, key));
    let mut calls = pb::node_service_client::NodeServiceClient::new(to(0, of(authority.sign_node("node-9"))).await);
    assert_eq!(calls.create_here(create_here()).await.unwrap_err().code(), Code::Unauthenticated);
    let trust = authority.trust().identity(of(Authority::new().sign_node("node-1")).unwrap());
    let endpoint = tonic::transport::Channel::from_shared(urls[0].clone()).unwrap();
    // In TLS 1.3 a client learns about its refused certificate only after the handshake.
    if let Ok(channel) = endpoint.tls_config(trust).unwrap().connect().await {
        let mut calls = pb::node_service_client::NodeServiceClient::new(channel);
        assert!(calls.create_here(create_here()).await.is_err());
    }
    // Both get another certificate while they run, and the names of the first have no role any more: what they show
    // each other from then on are the new ones.
    (0..2).for_each(|at| drop(certify(at, "renewed")));
    std::fs::write(&tokens, std::fs::read_to_string(&tokens).unwrap().replace("\"node-", "\"renewed-")).unwrap();
    let source = pb::create_session_request::Source::SceneName("paper".into());
    let request = pb::CreateSessionRequest { source: Some(source), ..pb::CreateSessionRequest::default() };
    let session = sessions.create_session(request).await.unwrap().into_inner().session.unwrap();
    until("a session of servers with other certificates has a standby", async || {
        let request = pb::LocateSessionRequest { session_id: session.session_id.clone() };
        !sessions.locate_session(request).await.unwrap().into_inner().ownership.unwrap().standby.is_empty()
    })
    .await;
}
