//! Threads and clips over a real server: they have the bits of a script that is run offline, they stay when the tool is released, and bad
//! ones are refused.

use crate::common::server::{TestServer, TestTouch, open};
use palpate_proto::pb;
use palpate_proto::pb::command::Action;
use palpate_session::run::{RunEvent, RunOptions, run_with};
use palpate_session::wire::command::scripted;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::script::Script;
use palpate_tissue::scene::{BUILT_IN, Scene};
use palpate_tissue::select::scheme_selection::NEVER;

const SCRIPT: &str = r#"
duration_s = 0.3
sample_every_s = 0.1
[[thread]]
name = "stitch"
bites = [{ place_m = [0.03, 0.03, 0] }, { place_m = [0.035, 0.035, 0] }, { place_m = [0.04, 0.03, 0], radius_m = 0.002 }]
friction = 0.2
length_m = [{ at_s = 0.02, length_m = 0.014 }, { at_s = 0.2, length_m = 0.011 }]
[[clip]]
bites = [{ place_m = [0.03, 0.045, 0] }, { place_m = [0.034, 0.045, 0] }]
from_s = 0.05
until_s = 0.25
"#;

async fn create(server: &TestServer) -> String {
    let source = Some(pb::create_session_request::Source::SceneName("liver".into()));
    let request = pb::CreateSessionRequest { source, paused: true, ..Default::default() };
    server.sessions().await.create_session(request).await.unwrap().into_inner().session.unwrap().session_id
}

#[tokio::test]
async fn a_thread_over_the_network_has_the_bits_of_a_script_and_stays_when_its_tool_is_released() {
    let text = BUILT_IN.iter().find(|scene| scene.0 == "liver").unwrap().1;
    let limits = Limits::default();
    let scene = Scene::parse("liver", text, &[], &limits).unwrap();
    let script = Script::parse("test", SCRIPT, std::path::Path::new("."), &scene, &limits).unwrap();
    assert_eq!((script.tools(), script.ties.len(), script.steps), (1, 2, 300));
    let model = Model::compile(&scene, &limits).unwrap();
    let mut tell = |_: RunEvent<'_>| Ok(());
    let summary = run_with(&model, &script, RunOptions::default(), &limits, &|| 0.0, &mut tell).unwrap();
    assert!(summary.ties.len() == 2 && summary.ties.iter().all(|tie| tie.peak_tension_n > 1e-3), "{:?}", summary.ties);
    assert!((summary.ties[0].path_m / 0.011 - 1.0).abs() < 0.01, "{:?}", summary.ties[0]);

    let server = TestServer::start(&[]);
    let session = create(&server).await;
    let mut touch = TestTouch::open(&server, open(&session, &[0])).await.unwrap();
    for half in [0..150, 150..300] {
        let steps = half.clone();
        for step in half {
            for (tool, action) in script.actions_at(step) {
                touch.command(scripted(scene.shape(), tool, step, &action, 0)).await;
            }
        }
        touch.settle().await;
        server.start_until(&session, steps.end).await;
        touch.sample_with(|sample| sample.step == steps.end).await;
    }
    assert_eq!(server.hash_at(&session, 300).await, summary.final_hash);
    // The thread holds on without its tool: the tissue stays away from rest.
    drop(touch);
    server.start_until(&session, 600).await;
    server.hash_at(&session, 600).await;
    let bytes = {
        let request = pb::SaveSnapshotRequest { session_id: session.clone() };
        let parts = server.sessions().await.save_snapshot(request).await.unwrap().into_inner();
        palpate_client::snapshot::collect(parts).await.unwrap()
    };
    let reader = palpate_session::journal::JournalReader::new("snapshot", std::io::Cursor::new(&bytes)).unwrap();
    let (saved, _) = palpate_session::journal::session_at(reader, &limits, 600, &NEVER).unwrap();
    let ties = saved.tissue().ties();
    assert!(ties.len() == 1 && ties[0].tensions_n[0] > 1e-3, "{ties:?}");
}

#[tokio::test]
async fn a_thread_that_does_not_fit_the_tissue_is_refused_with_its_field() {
    let server = TestServer::start(&[]);
    let session = create(&server).await;
    let bite = |x: f64| pb::Bite { place_m: Some(pb::Vector3 { x, y: 0.03, z: 0.0 }), radius_m: 0.001 };
    let thread = |bites: Vec<pb::Bite>, length_m: f64| pb::Thread { bites, length_m, ..Default::default() };
    let clip = |bites: Vec<pb::Bite>| pb::tie::Kind::Clip(pb::Clip { bites, strength_n: None });
    let mut touch = TestTouch::open(&server, open(&session, &[0])).await.unwrap();
    for (number, kind, field) in [
        (0, pb::tie::Kind::Thread(thread(vec![bite(0.03)], 0.01)), "tie.bites"),
        (0, pb::tie::Kind::Thread(thread(vec![bite(0.03), bite(3.0)], 0.01)), "tie.bites[1].place_m"),
        (0, pb::tie::Kind::Thread(thread(vec![bite(0.03), bite(0.04)], -1.0)), "tie.length_m"),
        (64, pb::tie::Kind::Thread(thread(vec![bite(0.03), bite(0.04)], 0.01)), "tie.number"),
        (0, clip(vec![bite(0.03), bite(0.04), bite(0.05)]), "tie.bites"),
    ] {
        let action = Some(Action::Tie(pb::Tie { number, kind: Some(kind) }));
        touch.command(pb::Command { tool: 0, action, ..Default::default() }).await;
        let refused = touch.rejection().await;
        assert!(format!("{refused:?}").contains(field), "{field}: {refused:?}");
    }
}
