//! A fleet of real servers on a real etcd: who has a session, what becomes of it when its server dies, freezes, loses etcd, or hands
//! it over.
//!
//! `make chaos` does many random rounds (PALPATE_FLEET_ROUNDS, PALPATE_SEED), and tells how soon sessions are back.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

#[path = "common/authority.rs"]
mod authority;
#[path = "common/fleet.rs"]
mod fleet;
#[path = "common/proxy.rs"]
mod proxy;
#[path = "common/random.rs"]
mod random;
#[path = "common/server.rs"]
mod server;

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use authority::Authority;
use fleet::{Etcd, Node, owner, until, until_stood_by};
use palpate::journal::{Reader, file, replay};
use palpate::limits::Limits;
use palpate_proto::error::elsewhere;
use palpate_proto::pb;
use pb::touch_response::Message as Heard;
use proxy::Proxy;
use random::Random;
use server::{Server, Touch, force};
use tonic::Code;

/// One test at a time: each has several processes.
static ONE: tokio::sync::Mutex<()> = tokio::sync::Mutex::const_new(());

/// Three servers, each of which says of a step that it is durable when it is on two disks.
async fn three(folder: &std::path::Path, etcd: &[String]) -> Vec<Node> {
    let nodes: Vec<Node> =
        (0..3).map(|at| Node::start(folder, &format!("n{at}"), etcd, &["--durable", "two", "--log", "warn"])).collect();
    nodes[0].until_nodes(3).await;
    nodes
}

async fn create(node: &Node) -> pb::Session {
    let source = pb::create_session_request::Source::SceneName("paper".into());
    node.there().create(source, false).await.unwrap()
}

/// The bits with which the run of a session at `after` begins are those of an offline run of the journal before it, wherever that is.
async fn goes_on(nodes: &[Node], id: &str, after: &Node, lets_go: bool) {
    // It is written a little after the session goes on.
    let mut begun = None;
    until("the journal has begun", async || {
        let session = after.session(id).await.ok();
        let run = session.and_then(|session| session.journal).map_or(0, |journal| u64::from(journal.run));
        let path = after.journals.join(file::name(id, run));
        let batch = Reader::open(&path).ok().and_then(|mut reader| reader.next_batch().ok().flatten());
        let first = batch.and_then(|batch| batch.snapshots().ok()?.into_iter().next());
        begun = first.map(|first| (run, first));
        begun.is_some()
    })
    .await;
    let (run, first) = begun.unwrap();
    let of = |node: &Node| file::list(&node.journals).unwrap().into_iter().filter(|file| file.session_id == id);
    let before = || nodes.iter().flat_map(of).filter(|file| file.run == run - 1);
    // A server that died may have more on its own disk than the one that has taken over got.
    let fits = |path: &std::path::Path| {
        let mut survey = Reader::open(path).unwrap();
        let end = survey.survey(&mut |_| {}).unwrap().until_step;
        if end < first.step {
            return false;
        }
        let (mut session, _) =
            replay::session_at(Reader::open(path).unwrap(), &Limits::default(), first.step, &false.into()).unwrap();
        if lets_go {
            session.let_go();
        }
        first.hash == format!("{:032x}", session.tissue().state_hash())
    };
    // The last of it is written a little later, too.
    until(&format!("{id} goes on from its run {} at step {}", run - 1, first.step), async || {
        before().any(|file| fits(&file.path))
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn any_server_creates_sessions_and_tells_where_they_are() {
    if !fleet::is_there() {
        return;
    }
    let _one = ONE.lock().await;
    let folder = tempfile::tempdir().unwrap();
    let etcd = Etcd::start(folder.path(), 1);
    let nodes = three(folder.path(), &etcd.urls).await;
    let mut made = BTreeMap::new();
    for index in 0..9 {
        let session = create(&nodes[index % 3]).await;
        let ownership = session.ownership.unwrap();
        made.insert(session.session_id, ownership.node);
        // The others are told of it twice a second.
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
    // What is deleted is known nowhere.
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
    let server = Server::start(&[]);
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
async fn a_frozen_server_says_nothing_for_its_sessions_when_it_thaws() {
    if !fleet::is_there() {
        return;
    }
    let _one = ONE.lock().await;
    let folder = tempfile::tempdir().unwrap();
    let etcd = Etcd::start(folder.path(), 1);
    let nodes = three(folder.path(), &etcd.urls).await;
    let id = create(&nodes[0]).await.session_id;
    let (at, session) = until_stood_by(&nodes, &id).await;
    let mut touch = Touch::hold(nodes[at].there(), &id).await;
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
    // What was on its way is of the old revision. Then the stream ends with the reason.
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
    if !fleet::is_there() {
        return;
    }
    let _one = ONE.lock().await;
    let folder = tempfile::tempdir().unwrap();
    let mut etcd = Etcd::start(folder.path(), 1);
    let nodes = three(folder.path(), &etcd.urls).await;
    let id = create(&nodes[0]).await.session_id;
    let (at, before) = until_stood_by(&nodes, &id).await;
    let mut touch = Touch::hold(nodes[at].there(), &id).await;
    touch.command(force(0, 1, -0.1)).await;
    etcd.kill_all();
    let refused = loop {
        if let Err(refused) = touch.hear().await {
            break refused;
        }
    };
    assert_eq!(refused.code(), Code::Unavailable, "{refused}");
    assert!(refused.message().contains("etcd"), "{refused}");
    assert_eq!(nodes[at].session(&id).await.unwrap_err().code(), Code::Unavailable);
    etcd.start_all();
    until("it goes on", async || nodes[at].session(&id).await.is_ok()).await;
    let after = nodes[at].session(&id).await.unwrap();
    assert!(after.ownership.unwrap().revision >= before.ownership.unwrap().revision);
    // The tool was let go, and may be taken again.
    until("the tool is let go", async || {
        nodes[at].session(&id).await.is_ok_and(|session| session.held_tools.is_empty())
    })
    .await;
    let mut again = Touch::hold(nodes[at].there(), &id).await;
    again.command(force(0, 1, -0.1)).await;
    let step = again.sample().await.step;
    again.sample_with(|sample| sample.step > step).await;
    let journals = file::list(&nodes[at].journals).unwrap();
    drop((again, nodes, etcd));
    for journal in journals {
        let verdict = replay::verify(Reader::open(&journal.path).unwrap(), &Limits::default(), &mut |_, _| {}).unwrap();
        assert_eq!(verdict.difference, None);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_moves_with_its_tools_and_the_same_bits() {
    if !fleet::is_there() {
        return;
    }
    let _one = ONE.lock().await;
    let folder = tempfile::tempdir().unwrap();
    let etcd = Etcd::start(folder.path(), 1);
    let nodes = three(folder.path(), &etcd.urls).await;
    let id = create(&nodes[0]).await.session_id;
    let mut at = owner(&nodes, &id).await.unwrap();
    let mut touch = Touch::hold(nodes[at].there(), &id).await;
    touch.command(force(0, 1, -0.1)).await;
    let pressed =
        touch.sample_with(|sample| sample.tools.first().is_some_and(|tool| tool.acknowledged_sequence == 1)).await;
    // Their step comes when another server has the session.
    let harder_at = pressed.step + 1000;
    touch.command(pb::Command { at_step: Some(harder_at), ..force(0, 2, -0.3) }).await;
    let request = pb::UpdateTissueRequest {
        session_id: id.clone(),
        at_step: Some(harder_at + 200),
        stiffness_n_per_m: Some(40.0),
        ..pb::UpdateTissueRequest::default()
    };
    nodes[at].there().sessions().await.update_tissue(request).await.unwrap();
    until("the command waits", async || nodes[at].session(&id).await.unwrap().commands.unwrap().waiting == 1).await;
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
        // The tool is still in the tissue, and whoever held it goes on.
        let open = pb::TouchOpen { lease_id, ..server::open(&id, &[0]) };
        touch = Touch::open(nodes[to].there(), open).await.unwrap();
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
    // A lease that is none, and an unknown server.
    let open = pb::TouchOpen { lease_id: "0".repeat(32), ..server::open(&id, &[0]) };
    assert_eq!(Touch::open(nodes[at].there(), open).await.err().unwrap().code(), Code::PermissionDenied);
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

fn force_n(sample: &pb::Sample) -> f64 {
    let force = sample.tools.first().and_then(|tool| tool.force_on_tool_n);
    force.map_or(0.0, |force| (force.x * force.x + force.y * force.y + force.z * force.z).sqrt())
}

/// What clients were told of a session.
#[derive(Debug, Clone, Copy, Default)]
struct Told {
    durable_step: u64,
    revision: u64,
}

/// Presses a session at 1 kHz, wherever it is, until told to stop. Notes what it is told; a server that speaks for the session with
/// an older revision than another has is noted too.
async fn press(urls: Vec<String>, id: String, told: Arc<Mutex<Told>>, older: Arc<Mutex<u64>>) {
    let mut next = 0;
    loop {
        let url = urls[next % urls.len()].clone();
        next += 1;
        let Ok(to) = tonic::transport::Channel::from_shared(url)
            .unwrap()
            .connect_timeout(Duration::from_millis(300))
            .connect()
            .await
        else {
            continue;
        };
        let mut haptics = pb::haptic_service_client::HapticServiceClient::new(to);
        let (say, said) = tokio::sync::mpsc::channel(64);
        let open = pb::TouchOpen { sample_every_steps: Some(4), lease_s: Some(0.5), ..server::open(&id, &[0]) };
        let message = |message| pb::TouchRequest { message: Some(message) };
        let _ = say.send(message(pb::touch_request::Message::Open(open))).await;
        let opening = haptics.touch(tokio_stream::wrappers::ReceiverStream::new(said));
        let Ok(Ok(opened)) = tokio::time::timeout(Duration::from_secs(1), opening).await else { continue };
        let (mut inbound, mut sequence) = (opened.into_inner(), 0_u16);
        let mut ticks = tokio::time::interval(Duration::from_millis(1));
        loop {
            tokio::select! {
                _ = ticks.tick() => {
                    sequence = sequence.wrapping_add(1);
                    let z_n = -0.2 * (f64::from(sequence) * 0.01).sin().abs();
                    let command = force(0, u64::from(sequence), z_n);
                    if say.send(message(pb::touch_request::Message::Command(command))).await.is_err() {
                        break;
                    }
                }
                heard = tokio::time::timeout(Duration::from_secs(1), inbound.message()) => match heard {
                    Ok(Ok(Some(pb::TouchResponse { message: Some(Heard::Sample(sample)) }))) => {
                        let mut told = told.lock().unwrap();
                        if sample.ownership_revision < told.revision {
                            *older.lock().unwrap() += 1;
                            continue;
                        }
                        told.revision = sample.ownership_revision;
                        told.durable_step = told.durable_step.max(sample.durable_step.unwrap_or_default());
                    }
                    Ok(Ok(Some(_))) => {}
                    Ok(Ok(None) | Err(_)) | Err(_) => break,
                },
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn sessions_come_back_whatever_becomes_of_a_server() {
    if !fleet::is_there() {
        return;
    }
    let _one = ONE.lock().await;
    let of = |name: &str, otherwise: u64| std::env::var(name).map_or(otherwise, |text| text.parse().unwrap());
    let (rounds, count) = (of("PALPATE_FLEET_ROUNDS", 3), of("PALPATE_FLEET_SESSIONS", 4));
    let (resting, mut random) = (of("PALPATE_FLEET_RESTING", 4), Random(of("PALPATE_SEED", 1)));
    let folder = tempfile::tempdir().unwrap();
    let etcd = Etcd::start(folder.path(), 1);
    // Each server reaches etcd by a wire of its own, which can be cut.
    let mut wires = Vec::new();
    for _ in 0..3 {
        wires.push(Proxy::start(etcd.urls[0].trim_start_matches("http://").to_owned(), Duration::ZERO).await);
    }
    let mut nodes: Vec<Node> = (0..3)
        .map(|at| {
            Node::start(folder.path(), &format!("n{at}"), &[wires[at].url()], &["--durable", "two", "--log", "error"])
        })
        .collect();
    nodes[0].until_nodes(3).await;
    let urls: Vec<String> = nodes.iter().map(|node| node.url.clone()).collect();
    let (mut ids, mut told, mut clients) = (Vec::new(), Vec::new(), Vec::new());
    let older = Arc::new(Mutex::new(0));
    for index in 0..count + resting {
        let id = create(&nodes[usize::try_from(index).unwrap() % 3]).await.session_id;
        if index < count {
            let known = Arc::new(Mutex::new(Told::default()));
            clients.push(tokio::spawn(press(urls.clone(), id.clone(), known.clone(), older.clone())));
            told.push(known);
        }
        ids.push(id);
    }
    let (mut back_s, mut done) = (Vec::new(), [0; 3]);
    for round in 0..rounds {
        for id in &ids {
            until_stood_by(&nodes, id).await;
        }
        tokio::time::sleep(Duration::from_millis(random.below(500))).await;
        let (at, how) = (
            usize::try_from(random.below(3)).unwrap(),
            usize::try_from(if rounds <= 3 { round } else { random.below(3) }).unwrap(),
        );
        let mut its = Vec::new();
        for id in &ids {
            if nodes[at].session(id).await.is_ok() {
                its.push(id.clone());
            }
        }
        done[how] += 1;
        let begun = Instant::now();
        match how {
            0 => nodes[at].kill(),
            1 => nodes[at].freeze(),
            _ => wires[at].cut(),
        }
        let others: Vec<usize> = (0..3).filter(|other| *other != at).collect();
        let mut gone = its.clone();
        until("all sessions are back", async || {
            let mut left = Vec::new();
            for id in &gone {
                let mut is_back = false;
                for other in &others {
                    is_back |= nodes[*other].session(id).await.is_ok();
                }
                if is_back {
                    back_s.push(begun.elapsed().as_secs_f64());
                } else {
                    left.push(id.clone());
                }
            }
            gone = left;
            gone.is_empty()
        })
        .await;
        for id in &its {
            let there = &nodes[owner_of(&nodes, &others, id).await];
            goes_on(&nodes, id, there, true).await;
            // What was told before the session is looked at: its clients are told more by now.
            let known = ids.iter().position(|other| other == id).and_then(|index| told.get(index));
            let known = known.map(|known| *known.lock().unwrap()).unwrap_or_default();
            let session = there.session(id).await.unwrap();
            assert!(session.step >= known.durable_step, "round {round}: {known:?} {}", session.step);
        }
        match how {
            0 => nodes[at].begin(),
            1 => {
                tokio::time::sleep(Duration::from_millis(random.below(2000))).await;
                nodes[at].thaw();
            }
            _ => wires[at].mend(),
        }
        nodes[at].until_nodes(3).await;
        // It has none of them any more.
        for id in &its {
            until("the old owner knows", async || nodes[at].session(id).await.is_err()).await;
        }
        if (round + 1) % 10 == 0 {
            eprintln!("{} of {rounds} rounds", round + 1);
        }
    }
    assert_eq!(ids.len(), ids.iter().collect::<std::collections::BTreeSet<_>>().len());
    clients.iter().for_each(tokio::task::JoinHandle::abort);
    back_s.sort_by(f64::total_cmp);
    let [median, worst] = [back_s.get(back_s.len() / 2), back_s.last()].map(|s| s.copied().unwrap_or_default());
    println!(
        "{rounds} rounds (killed, frozen, cut from etcd: {done:?}), {} sessions: {} times back, after {median:.2} s (median), \
         {worst:.2} s (worst); {} samples of an older revision",
        ids.len(),
        back_s.len(),
        older.lock().unwrap()
    );
}

async fn owner_of(nodes: &[Node], among: &[usize], id: &str) -> usize {
    for at in among {
        if nodes[*at].session(id).await.is_ok() {
            return *at;
        }
    }
    panic!("nobody has {id}")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn servers_know_each_other_by_certificates_and_clients_by_tokens() {
    if !fleet::is_there() {
        return;
    }
    let _one = ONE.lock().await;
    let folder = tempfile::tempdir().unwrap();
    let etcd = Etcd::start(folder.path(), 1);
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
    let serve = |at: usize| {
        let (cert, key) = authority.sign_node(&format!("node-{at}"));
        let (cert, key) = (write(&format!("{at}.pem"), &cert), write(&format!("{at}.key"), &key));
        let journal = folder.path().join(format!("journal-{at}")).display().to_string();
        let of_the_fleet =
            ["--cluster", &etcd.urls[0], "--advertise", &urls[at], "--cluster-ca", &ca, "--journal", &journal];
        let of_tls = ["--tls-cert", &cert, "--tls-key", &key, "--tokens", &tokens, "--threads", "1"];
        Server::start_at(urls[at].trim_start_matches("https://"), &[&of_the_fleet[..], &of_tls].concat())
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
    // What is between servers is for servers: neither a token that administers is enough, nor a client without one.
    let create_here = || pb::CreateHereRequest::default();
    let mut calls = pb::node_service_client::NodeServiceClient::with_interceptor(there.clone(), authorized);
    let refused = calls.create_here(create_here()).await.unwrap_err();
    assert_eq!(server::told(&refused).1, "ROLE_MISSING");
    let mut calls = pb::node_service_client::NodeServiceClient::new(there);
    assert_eq!(calls.create_here(create_here()).await.unwrap_err().code(), Code::Unauthenticated);
    // A certificate of these authorities whose name has no role is as good as none; one of others is not let in.
    let of = |(cert, key): (String, String)| Some(tonic::transport::Identity::from_pem(cert, key));
    let mut calls = pb::node_service_client::NodeServiceClient::new(to(0, of(authority.sign_node("node-9"))).await);
    assert_eq!(calls.create_here(create_here()).await.unwrap_err().code(), Code::Unauthenticated);
    let trust = authority.trust().identity(of(Authority::new().sign_node("node-1")).unwrap());
    let endpoint = tonic::transport::Channel::from_shared(urls[0].clone()).unwrap();
    // TLS 1.3 tells a client of its certificate only after the handshake.
    if let Ok(channel) = endpoint.tls_config(trust).unwrap().connect().await {
        let mut calls = pb::node_service_client::NodeServiceClient::new(channel);
        assert!(calls.create_here(create_here()).await.is_err());
    }
}
