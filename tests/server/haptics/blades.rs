//! Blades over a real server: one pose leads a blade, the session tells what is severed, and a snapshot in mid-cut continues.

use crate::common::server::{TestServer, TestTouch, open};
use glam::{DQuat, DVec3};
use palpate_haptics::{Instrument, InstrumentPose, Tip, TipShape};
use palpate_proto::geometry::from_vector;
use palpate_proto::pb::command::Action;
use palpate_proto::{instrument, pb};
use palpate_tissue::select::scheme_selection::NEVER;

pub(crate) const STEPS: u64 = 400;

/// A blade with an edge of 20 mm.
pub(crate) fn knife() -> Instrument {
    let edge_m = -0.02 * DVec3::X;
    Instrument::of_tip(Tip { shape: TipShape::Blade, radius_m: 0.001, edge_m, ..Tip::default() })
}

/// Along `fibrotic`, 5 mm deep, the edge upright: a blade feels nothing there, so that the cut is where its edge is.
fn pose_at(step: u64) -> InstrumentPose {
    let y = 0.02 + 0.03 * step as f64 / STEPS as f64;
    let pose = InstrumentPose {
        place_m: DVec3::new(0.03625, y, -0.005),
        orientation: DQuat::from_rotation_y(std::f64::consts::FRAC_PI_2),
        jaw_rad: 0.0,
    };
    instrument::from_pose(&instrument::pose(&pose), &knife()).unwrap().0
}

pub(crate) async fn create(server: &TestServer, source: pb::create_session_request::Source) -> String {
    let request = pb::CreateSessionRequest { source: Some(source), paused: true, ..Default::default() };
    server.sessions().await.create_session(request).await.unwrap().into_inner().session.unwrap().session_id
}

pub(crate) async fn topology(server: &TestServer, session_id: &str, since_version: u32) -> pb::GetTopologyResponse {
    let request = pb::GetTopologyRequest { session_id: session_id.to_owned(), since_version, by_name: false };
    let mut parts = server.views().await.get_topology(request).await.unwrap().into_inner();
    let mut whole = pb::GetTopologyResponse::default();
    while let Some(part) = parts.message().await.unwrap() {
        assert!(!whole.last);
        whole.severed.extend(part.severed.iter().copied());
        whole = pb::GetTopologyResponse { severed: std::mem::take(&mut whole.severed), ..part };
    }
    assert!(whole.last);
    whole
}

async fn wound(server: &TestServer, session_id: &str, refinement: u32, since_version: u32) -> pb::GetWoundResponse {
    let cut_surface = true;
    let request = pb::GetWoundRequest { session_id: session_id.to_owned(), refinement, since_version, cut_surface };
    let mut parts = server.views().await.get_wound(request).await.unwrap().into_inner();
    let mut whole = pb::GetWoundResponse::default();
    while let Some(part) = parts.message().await.unwrap() {
        assert!(!whole.last);
        let (mut vertices, mut triangles) = (std::mem::take(&mut whole.vertices), std::mem::take(&mut whole.triangles));
        let (mut cut_vertices, mut cut_faces) =
            (std::mem::take(&mut whole.cut_vertices), std::mem::take(&mut whole.cut_faces));
        vertices.extend(part.vertices.iter().copied());
        triangles.extend(part.triangles.iter().cloned());
        cut_vertices.extend(part.cut_vertices.iter().copied());
        cut_faces.extend(part.cut_faces.iter().cloned());
        whole = pb::GetWoundResponse { vertices, triangles, cut_vertices, cut_faces, ..part };
    }
    assert!(whole.last);
    whole
}

/// Sends the commands of some steps and lets them pass.
pub(crate) async fn lead(server: &TestServer, session: &str, touch: &mut TestTouch, steps: std::ops::Range<u64>) {
    for step in steps.clone() {
        let action = Some(Action::Instrument(instrument::pose(&pose_at(step))));
        let sequence = Some(step + 1);
        touch.command(pb::Command { tool: 0, sequence, at_step: Some(step), action, ..Default::default() }).await;
    }
    touch.settle().await;
    server.start_until(session, steps.end).await;
    touch.sample_with(|sample| sample.step == steps.end).await;
}

#[tokio::test]
async fn a_session_tells_what_a_blade_has_severed_and_a_snapshot_in_mid_cut_continues() {
    let server = TestServer::start(&[]);
    let session = create(&server, pb::create_session_request::Source::SceneName("fibrotic".into())).await;
    let with_knife =
        |session: &str| pb::TouchOpen { instruments: vec![instrument::instrument(&knife(), 0)], ..open(session, &[0]) };
    let mut touch = TestTouch::open(&server, with_knife(&session)).await.unwrap();
    assert_eq!(topology(&server, &session, 0).await.pieces, 1);
    lead(&server, &session, &mut touch, 0..STEPS / 2).await;
    let half = topology(&server, &session, 0).await;
    assert!(half.version > 5 && half.severed.len() > 10, "{half:?}");
    let request = pb::SaveSnapshotRequest { session_id: session.clone() };
    let parts = server.sessions().await.save_snapshot(request).await.unwrap().into_inner();
    let bytes = palpate_client::snapshot::collect(parts).await.unwrap();
    let reader = palpate_session::journal::JournalReader::new("snapshot", std::io::Cursor::new(&bytes)).unwrap();
    let limits = palpate_tissue::limits::Limits::default();
    let (saved, _) = palpate_session::journal::session_at(reader, &limits, STEPS / 2, &NEVER).unwrap();
    assert_eq!(saved.tissue().cuts().len(), half.severed.len());
    let hash = server.hash_at(&session, STEPS / 2).await;
    assert_eq!(format!("{:032x}", saved.tissue().state_hash()), hash);
    lead(&server, &session, &mut touch, STEPS / 2..STEPS).await;
    // Each part of the list continues the one before.
    let (all, later) = (topology(&server, &session, 0).await, topology(&server, &session, half.version).await);
    assert!(later.continues && later.version == all.version);
    let known: Vec<_> = half.severed.iter().chain(&later.severed).copied().collect();
    assert_eq!(known, all.severed);
    let status = server.status(&session).await;
    assert_eq!((status.topology_version, status.severed as usize, status.pieces), (all.version, known.len(), 1));
    for spring in &all.severed {
        let place_m = from_vector(spring.rest_m.as_ref());
        assert!((place_m.x - 0.03625).abs() < 2e-4 && (0.019..0.051).contains(&place_m.y), "{place_m}");
        let rows = [spring.first_vertex, spring.second_vertex].map(|vertex| vertex.unwrap() / 31);
        assert!(rows[0] != rows[1] && spring.version <= all.version, "{spring:?}");
    }
    let bytes = prost::Message::encoded_len(&all);
    assert!(bytes < 100 * all.severed.len(), "{bytes} bytes for {} springs", all.severed.len());
}

#[tokio::test]
async fn a_wound_is_sent_to_a_viewer_that_follows_and_whole_to_a_late_one() {
    let server = TestServer::start(&[]);
    let session = create(&server, pb::create_session_request::Source::SceneName("liver".into())).await;
    let with_knife =
        |session: &str| pb::TouchOpen { instruments: vec![instrument::instrument(&knife(), 0)], ..open(session, &[0]) };
    let mut touch = TestTouch::open(&server, with_knife(&session)).await.unwrap();
    let request = pb::WatchFramesRequest { session_id: session.clone(), refinement: 3, ..Default::default() };
    let mut frames = server.views().await.watch_frames(request).await.unwrap().into_inner();
    let before = wound(&server, &session, 0, 0).await;
    assert_eq!((before.version, before.pieces, before.severed), (0, 1, 0));
    assert!(before.vertices.is_empty() && before.triangles.is_empty() && !before.stays_whole);
    lead(&server, &session, &mut touch, 0..STEPS / 2).await;
    let half = [wound(&server, &session, 0, 0).await, wound(&server, &session, 3, 0).await];
    lead(&server, &session, &mut touch, STEPS / 2..STEPS).await;
    for (known, (refinement, vertices)) in half.into_iter().zip([(0, 31 * 31), (3, 121 * 121)]) {
        let all = wound(&server, &session, refinement, 0).await;
        let later = wound(&server, &session, refinement, known.version).await;
        assert!(later.continues && later.version == all.version && all.severed > known.severed, "{later:?}");
        assert_eq!((all.first_vertex, later.first_vertex), (vertices, vertices + known.vertices.len() as u32));
        let followed: Vec<_> = known.vertices.iter().chain(&later.vertices).copied().collect();
        assert_eq!(followed, all.vertices);
        let mut triangles: std::collections::BTreeMap<u32, pb::CutTriangles> = std::collections::BTreeMap::new();
        triangles.extend(known.triangles.into_iter().chain(later.triangles).map(|cut| (cut.first, cut)));
        assert_eq!(triangles.into_values().collect::<Vec<_>>(), all.triangles);
        // Both lips of each spring lie side by side, and ride on vertices on both sides of the blade.
        let rows = |vertex: u32| vertex / (if refinement == 0 { 31 } else { 121 });
        for lips in all.vertices.chunks(2) {
            assert_eq!([lips[0].host, lips[0].second], [lips[1].second, lips[1].host]);
            assert!(rows(lips[0].host) != rows(lips[1].host), "{lips:?}");
        }
        let bytes = prost::Message::encoded_len(&all);
        assert!(bytes < 100 * all.severed as usize, "{bytes} bytes for {} springs", all.severed);
    }
    // Frames tell that there is more to ask for.
    let version = wound(&server, &session, 0, 0).await.version;
    while frames.message().await.unwrap().unwrap().topology_version < version {}
    let mut views = server.views().await;
    let refused = views.get_wound(pb::GetWoundRequest { session_id: session, refinement: 99, ..Default::default() });
    assert!(refused.await.is_err());
}

#[tokio::test]
async fn a_viewer_that_asks_for_it_sees_into_the_cut_of_a_solid() {
    let server = TestServer::start(&[]);
    // A block of 100 × 100 × 40 mm.
    let session = create(&server, pb::create_session_request::Source::SceneName("phantom".into())).await;
    let with_knife =
        |session: &str| pb::TouchOpen { instruments: vec![instrument::instrument(&knife(), 0)], ..open(session, &[0]) };
    let mut touch = TestTouch::open(&server, with_knife(&session)).await.unwrap();
    let mut mesh =
        server.views().await.get_mesh(pb::GetMeshRequest { session_id: session.clone(), refinement: 0 }).await;
    let mesh = mesh.as_mut().unwrap().get_mut().message().await.unwrap().unwrap();
    assert!(mesh.cut_rows > 0);
    assert!(wound(&server, &session, 0, 0).await.cut_faces.is_empty());
    for step in 0..STEPS {
        let y = -0.055 + 0.07 * step as f64 / STEPS as f64;
        let pose = InstrumentPose {
            place_m: DVec3::new(0.003, y, 0.024),
            orientation: DQuat::from_rotation_y(std::f64::consts::FRAC_PI_2),
            jaw_rad: 0.0,
        };
        let action = Some(Action::Instrument(instrument::pose(&pose)));
        touch
            .command(pb::Command {
                tool: 0,
                sequence: Some(step + 1),
                at_step: Some(step),
                action,
                ..Default::default()
            })
            .await;
    }
    touch.settle().await;
    server.start_until(&session, STEPS).await;
    touch.sample_with(|sample| sample.step == STEPS).await;
    let all = wound(&server, &session, 0, 0).await;
    assert!(all.cut_faces.len() > 20 && all.cut_faces.len() <= 2 * all.severed as usize, "{}", all.cut_faces.len());
    let count = all.cut_vertices.len() as u32;
    assert!(all.cut_vertices.iter().zip(0..).all(|(vertex, number)| vertex.number == number));
    assert!(
        all.cut_faces.iter().all(|face| face.corners.len() == 4 && face.corners.iter().all(|corner| *corner < count))
    );
    assert!(count <= mesh.cut_rows * mesh.vertices_y);
    // Frames have their displacements, if a viewer asks for them.
    for cut_surface in [false, true] {
        let request = pb::WatchFramesRequest { session_id: session.clone(), cut_surface, ..Default::default() };
        let mut frames = server.views().await.watch_frames(request).await.unwrap().into_inner();
        let mut part = frames.message().await.unwrap().unwrap();
        while !part.last {
            let more = frames.message().await.unwrap().unwrap();
            part.patches.extend(more.patches);
            part.last = more.last;
        }
        let rows = if cut_surface { mesh.cut_rows } else { 0 };
        assert_eq!((part.vertices_x, part.vertices_y), (mesh.vertices_x + rows, mesh.vertices_y));
        let first = mesh.vertices_x * mesh.vertices_y;
        let sent = |at: u32| {
            let (x, y) = (at / part.vertices_y, at % part.vertices_y);
            part.patches.iter().any(|patch| {
                (patch.first_x..patch.first_x + patch.count_x).contains(&x)
                    && (patch.first_y..patch.first_y + patch.count_y).contains(&y)
            })
        };
        assert!((first..first + count).all(|at| sent(at) == cut_surface), "{cut_surface}");
    }
    let plain = pb::GetWoundRequest { session_id: session, ..Default::default() };
    let mut parts = server.views().await.get_wound(plain).await.unwrap().into_inner();
    let part = parts.message().await.unwrap().unwrap();
    assert!(part.cut_vertices.is_empty() && part.cut_faces.is_empty() && !part.vertices.is_empty());
}

#[tokio::test]
async fn a_blade_that_cannot_cut_is_refused_with_its_field() {
    let server = TestServer::start(&[]);
    let liver = create(&server, pb::create_session_request::Source::SceneName("liver".into())).await;
    let mut long = knife();
    long.tips[0].tip.edge_m = 10.0 * DVec3::X;
    let open = pb::TouchOpen { instruments: vec![instrument::instrument(&long, 0)], ..open(&liver, &[0]) };
    let Err(refused) = TestTouch::open(&server, open).await else { panic!("an edge of 10 m was accepted") };
    let (_, _, message) = crate::common::server::told(&refused);
    assert!(message.contains("edge_m") || format!("{refused:?}").contains("edge_m"), "{refused:?}");
}
