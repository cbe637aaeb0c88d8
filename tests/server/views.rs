//! Looking over the network: the mesh, frames, credit.

use crate::common::server::{TEST_TIMEOUT, TestServer, TestTouch, force, told};
use palpate_proto::pb;
use tonic::{Code, Streaming};

fn watch(session_id: &str, refinement: u32, encoding: pb::Encoding) -> pb::WatchFramesRequest {
    pb::WatchFramesRequest {
        session_id: session_id.into(),
        refinement,
        encoding: encoding.into(),
        always_full: true,
        ..Default::default()
    }
}

/// The same, of what changes.
fn changes(session_id: &str, refinement: u32, encoding: pb::Encoding) -> pb::WatchFramesRequest {
    pb::WatchFramesRequest { always_full: false, ..watch(session_id, refinement, encoding) }
}

type Vertices = Vec<Option<[f64; 3]>>;

/// A full frame: its last message, and the displacement of every vertex, m.
async fn frame(stream: &mut Streaming<pb::WatchFramesResponse>) -> (pb::WatchFramesResponse, Vec<[f64; 3]>) {
    let mut vertices = Vec::new();
    let (last, _) = show(stream, &mut vertices).await;
    assert!(last.full);
    (last, vertices.into_iter().map(Option::unwrap).collect())
}

/// Writes the next frame over what is shown; its last message, and how many vertices it wrote.
async fn show(
    stream: &mut Streaming<pb::WatchFramesResponse>,
    vertices: &mut Vertices,
) -> (pb::WatchFramesResponse, usize) {
    let (mut id, mut count) = (None, 0);
    loop {
        let part = tokio::time::timeout(TEST_TIMEOUT, stream.message()).await.expect("no frame").unwrap().unwrap();
        vertices.resize((part.vertices_x * part.vertices_y) as usize, None);
        assert_eq!(*id.get_or_insert(part.frame_id), part.frame_id, "a frame began before the last one was whole");
        let (origin, scale) = (part.origin_m.unwrap(), part.scale_m.unwrap());
        let (origin, scale) = ([origin.x, origin.y, origin.z], [scale.x, scale.y, scale.z]);
        assert!(part.patches.iter().map(|patch| patch.displacement.len()).sum::<usize>() <= 64 << 10);
        for patch in &part.patches {
            let size = if part.encoding() == pb::Encoding::F32 { 4 } else { 2 };
            assert_eq!(patch.displacement.len(), (patch.count_x * patch.count_y) as usize * 3 * size);
            for (index, bytes) in patch.displacement.chunks(3 * size).enumerate() {
                let (a, b) = (index as u32 / patch.count_y, index as u32 % patch.count_y);
                let vertex = (patch.first_x + a) * part.vertices_y + patch.first_y + b;
                let component = |c: usize| match &bytes[c * size..(c + 1) * size] {
                    [a, b] => origin[c] + scale[c] * f64::from(i16::from_le_bytes([*a, *b])),
                    [a, b, c, d] => f64::from(f32::from_le_bytes([*a, *b, *c, *d])),
                    _ => unreachable!(),
                };
                vertices[vertex as usize] = Some(std::array::from_fn(component));
                count += 1;
            }
        }
        if part.last {
            assert_eq!(part.full, count == vertices.len());
            return (part, count);
        }
    }
}

/// What is shown is the tissue as it stands, within the quantum.
async fn check(server: &TestServer, session: &str, last: &pb::WatchFramesResponse, vertices: &Vertices) {
    let request = watch(session, last.refinement, pb::Encoding::F32);
    let (now, exact) = frame(&mut server.views().await.watch_frames(request).await.unwrap().into_inner()).await;
    assert_eq!(last.step, now.step);
    let scale = last.scale_m.unwrap();
    let quantum_m = if last.encoding() == pb::Encoding::F32 { [0.0; 3] } else { [scale.x, scale.y, scale.z] };
    for (shown, exact) in vertices.iter().zip(&exact) {
        for c in 0..3 {
            let error_m = (shown.unwrap()[c] - exact[c]).abs();
            assert!(error_m <= 1.02 * quantum_m[c], "{error_m} m, but a quantum is {} m", quantum_m[c]);
        }
    }
}

/// Something that moves for so many steps: of what is still no frames are due.
async fn stir(server: &TestServer, session: &str, steps: u64) -> TestTouch {
    let mut touch = TestTouch::hold(server, session).await;
    for step in (0..steps).step_by(5) {
        let strength_n = if step % 10 == 0 { -1.0 } else { 1.0 };
        touch.command(pb::Command { at_step: Some(step), ..force(0, step + 1, strength_n) }).await;
    }
    touch.settle().await;
    touch
}

#[tokio::test]
async fn every_refinement_and_encoding_shows_the_same_tissue() {
    let server = TestServer::start(&[]);
    let session = server.paper(true).await;
    let mut touch = TestTouch::hold(&server, &session).await;
    touch.command(force(0, 1, -1.0)).await;
    touch.settle().await;
    server.start_until(&session, 200).await;
    server.hash_at(&session, 200).await;
    let depth_m = touch.sample_with(|sample| sample.step == 200).await.tools[0].displacement_m.unwrap().z;
    for refinement in 0..=10 {
        for encoding in [pb::Encoding::F32, pb::Encoding::I16] {
            // A viewer that joins late gets a full frame first, also while time is paused.
            let request = watch(&session, refinement, encoding);
            let mut frames = server.views().await.watch_frames(request).await.unwrap().into_inner();
            let (last, vertices) = frame(&mut frames).await;
            let side = 30 * (refinement + 1) + 1;
            assert_eq!((last.step, last.full, last.vertices_x, last.vertices_y), (200, true, side, side));
            let middle = (side / 2 * side + side / 2) as usize;
            // A frame shows the displacements that the step predicts; a sample corrects its point's.
            let exact_m = 1e-6 * depth_m.abs();
            let quantum = exact_m + if encoding == pb::Encoding::I16 { last.scale_m.unwrap().z } else { 0.0 };
            assert!((vertices[middle][2] - depth_m).abs() <= quantum, "{} and {depth_m}", vertices[middle][2]);
            assert!(quantum < 1e-5);
        }
    }
}

#[tokio::test]
async fn a_texture_is_sent_once() {
    let server = TestServer::start(&[]);
    let session_id = server.paper(true).await;
    let mut views = server.views().await;
    let mut sent = async |session_id: &str, known_etag: &str| {
        let request = pb::GetTextureRequest { session_id: session_id.into(), known_etag: known_etag.into() };
        let mut parts = views.get_texture(request).await?.into_inner();
        let mut png = Vec::new();
        while let Some(part) = parts.message().await? {
            png.extend_from_slice(&part.png);
            if part.last {
                return Ok((png, part.etag));
            }
        }
        panic!("the image has no end");
    };
    let (png, etag) = sent(&session_id, "").await.unwrap();
    let limits = palpate_tissue::limits::Limits::default();
    let standard = palpate_texture::texture(&palpate_tissue::scene::Appearance::default(), &limits).unwrap();
    assert!(png == standard.png && etag == standard.etag);
    assert_eq!(sent(&session_id, &etag).await.unwrap(), (Vec::new(), etag));
    let nobody: tonic::Status = sent("paper", "").await.unwrap_err();
    assert_eq!(told(&nobody).1, "UNKNOWN_SESSION");
}

#[tokio::test]
async fn the_mesh_and_a_frame_fit_together() {
    let server = TestServer::start(&[]);
    let session = server.paper(true).await;
    for refinement in [0, 3, 10] {
        let request = pb::GetMeshRequest { session_id: session.clone(), refinement };
        let mut parts = server.views().await.get_mesh(request).await.unwrap().into_inner();
        let (mut positions, mut texture, mut triangles, mut whole) = (vec![], vec![], vec![], false);
        let mut size = (0, 0);
        while let Some(part) = parts.message().await.unwrap() {
            assert!(!whole && prost::Message::encoded_len(&part) < 100_000);
            positions.extend(part.rest_position_m);
            texture.extend(part.texture_coordinates);
            triangles.extend(part.triangles);
            whole = part.last;
            size = (part.vertices_x as usize, part.vertices_y as usize);
        }
        let (nx, ny) = size;
        assert!(whole);
        assert_eq!((nx, ny), (30 * (refinement as usize + 1) + 1, 30 * (refinement as usize + 1) + 1));
        assert_eq!((positions.len(), texture.len()), (3 * nx * ny, 2 * nx * ny));
        assert_eq!(triangles.len(), 6 * (nx - 1) * (ny - 1));
        let last = nx * ny - 1;
        assert!((positions[3 * last] - 1.0).abs() < 1e-6 && (positions[3 * last + 1] - 1.0).abs() < 1e-6);
        assert_eq!(&texture[2 * last..], [1.0, 1.0]);
        // Every triangle has the same area, and faces up.
        let at = |v: u32| (positions[3 * v as usize], positions[3 * v as usize + 1]);
        let area = 0.5 / ((nx - 1) * (ny - 1)) as f32;
        for triangle in triangles.chunks(3) {
            let [a, b, c] = [at(triangle[0]), at(triangle[1]), at(triangle[2])];
            let twice = (b.0 - a.0) * (c.1 - a.1) - (b.1 - a.1) * (c.0 - a.0);
            assert!((0.5 * twice / area - 1.0).abs() < 0.01, "{}", 0.5 * twice / area);
        }
    }
}

#[tokio::test]
async fn a_viewer_without_credit_gets_no_more_frames_until_it_acknowledges() {
    let server = TestServer::start(&[]);
    let session = server.paper(true).await;
    let request = pb::WatchFramesRequest {
        max_frames_in_flight: Some(2),
        rate_hz: Some(100.0),
        ..watch(&session, 0, pb::Encoding::I16)
    };
    let mut views = server.views().await;
    let mut frames = views.watch_frames(request).await.unwrap().into_inner();
    let (first, _) = frame(&mut frames).await;
    let _touch = stir(&server, &session, 1010).await;
    server.start_until(&session, 1000).await;
    let (second, _) = frame(&mut frames).await;
    // A busy server leaves out frames that were due at once; credit decides about those after the second.
    assert!(first.frame_id == 0 && second.frame_id > 0, "{} {}", first.frame_id, second.frame_id);
    server.hash_at(&session, 1000).await;
    let acknowledge = pb::AcknowledgeFramesRequest { viewer_id: first.viewer_id, frame_id: second.frame_id };
    views.acknowledge_frames(acknowledge.clone()).await.unwrap();
    server.start_until(&session, 1010).await;
    // A hundred frames were due, and none was sent beyond the credit: the next is of what came after.
    let (third, _) = frame(&mut frames).await;
    assert_eq!((third.frame_id, third.step), (101, 1010));
    assert_eq!(third.skipped_frames, 99);
    drop(frames);
    let unknown = pb::AcknowledgeFramesRequest { viewer_id: "nobody".into(), ..acknowledge };
    assert_eq!(told(&views.acknowledge_frames(unknown).await.unwrap_err()).1, "UNKNOWN_VIEWER");
}

#[tokio::test]
async fn frames_of_changes_make_the_same_picture_as_full_ones() {
    let server = TestServer::start(&[]);
    let session = server.paper(true).await;
    let mut touch = TestTouch::hold(&server, &session).await;
    let mut streams = Vec::new();
    for (refinement, encoding) in [(0, pb::Encoding::I16), (3, pb::Encoding::I16), (2, pb::Encoding::F32)] {
        // One that is always ready, one without credit for most of the time.
        for most in [None, Some(1)] {
            let request = pb::WatchFramesRequest {
                rate_hz: Some(100.0),
                max_frames_in_flight: most,
                ..changes(&session, refinement, encoding)
            };
            let mut frames = server.views().await.watch_frames(request).await.unwrap().into_inner();
            let mut vertices = Vec::new();
            let (last, _) = show(&mut frames, &mut vertices).await;
            assert!(last.full && last.frame_id == 0);
            streams.push((frames, vertices, last));
        }
    }
    touch.command(at_a_corner(1, -1.0)).await;
    touch.settle().await;
    let mut views = server.views().await;
    let mut some_but_not_all = false;
    // While the tissue still moves, so that there is a frame at each of these steps.
    for until in [20, 70, 120] {
        server.start_until(&session, until - 10).await;
        server.hash_at(&session, until - 10).await;
        for (_, _, last) in &streams {
            let (viewer_id, frame_id) = (last.viewer_id.clone(), last.frame_id);
            views.acknowledge_frames(pb::AcknowledgeFramesRequest { viewer_id, frame_id }).await.unwrap();
        }
        server.start_until(&session, until).await;
        server.hash_at(&session, until).await;
        for (frames, vertices, last) in &mut streams {
            while last.step < until {
                let (next, count) = show(frames, vertices).await;
                some_but_not_all |= count < vertices.len();
                *last = next;
            }
            check(&server, &session, last, vertices).await;
            // A viewer that joins late sees the same at once.
            let request = changes(&session, last.refinement, last.encoding());
            let mut late = Vec::new();
            let (first, _) = show(&mut views.watch_frames(request).await.unwrap().into_inner(), &mut late).await;
            assert!(first.full && first.step == until);
            check(&server, &session, &first, &late).await;
        }
    }
    assert!(some_but_not_all);
    // The viewers without credit were informed.
    assert!(streams.iter().any(|(_, _, last)| last.skipped_frames > 0));
}

/// A force far from three of the four tiles.
fn at_a_corner(sequence: u64, z_n: f64) -> pb::Command {
    let command = force(0, sequence, z_n);
    let Some(pb::command::Action::Force(force)) = command.action else { unreachable!() };
    let centre = Some(pb::force::Centre::Point(pb::GridPoint { x: 3, y: 3 }));
    pb::Command { action: Some(pb::command::Action::Force(pb::Force { centre, ..force })), ..command }
}

#[tokio::test]
async fn a_still_tissue_sends_nothing_and_five_seconds_of_change_a_full_frame() {
    let server = TestServer::start(&[]);
    let session = server.paper(true).await;
    let mut touch = TestTouch::hold(&server, &session).await;
    let request = pb::WatchFramesRequest { rate_hz: Some(100.0), ..changes(&session, 0, pb::Encoding::I16) };
    let mut frames = server.views().await.watch_frames(request).await.unwrap().into_inner();
    let mut vertices = Vec::new();
    let (first, _) = show(&mut frames, &mut vertices).await;
    assert_eq!((first.step, first.full), (0, true));
    server.start_until(&session, 500).await;
    server.hash_at(&session, 500).await;
    touch.command(at_a_corner(1, -1.0)).await;
    touch.settle().await;
    server.start_until(&session, 510).await;
    server.hash_at(&session, 510).await;
    // Fifty frames were due and not sent, because nothing had changed; none was skipped.
    let (second, count) = show(&mut frames, &mut vertices).await;
    assert_eq!((second.frame_id, second.step, second.skipped_frames), (51, 510, 0));
    assert!(count < vertices.len());
    server.start_until(&session, 5600).await;
    let last = loop {
        let (next, _) = show(&mut frames, &mut vertices).await;
        // Before that, all four tiles may change at once.
        if next.full && next.step >= 5000 {
            break next;
        }
    };
    server.hash_at(&session, 5600).await;
    check(&server, &session, &pb::WatchFramesResponse { step: 5600, ..last }, &vertices).await;
    // At rest under the force; what is left of its motion can't be seen: the next frame is of another force.
    touch.command(at_a_corner(2, -2.0)).await;
    touch.settle().await;
    server.start_until(&session, 5610).await;
    let (next, _) = show(&mut frames, &mut vertices).await;
    assert_eq!((next.frame_id, next.step), (561, 5610));
}

#[tokio::test]
async fn a_viewer_chooses_its_rate() {
    let server = TestServer::start(&[]);
    let session = server.paper(true).await;
    let mut streams = Vec::new();
    for rate_hz in [20.0, 50.0] {
        let request = pb::WatchFramesRequest { rate_hz: Some(rate_hz), ..watch(&session, 1, pb::Encoding::I16) };
        streams.push((rate_hz, server.views().await.watch_frames(request).await.unwrap().into_inner()));
    }
    let _touch = stir(&server, &session, 1000).await;
    server.start_until(&session, 1000).await;
    for (rate_hz, mut frames) in streams {
        let mut steps = Vec::new();
        loop {
            let (last, _) = frame(&mut frames).await;
            // A frame's number gives its step: at this rate, whatever was skipped.
            assert_eq!(last.frame_id, (last.step as f64 * rate_hz / 1000.0) as u64);
            steps.push(last.step);
            if last.step == 1000 {
                break;
            }
        }
        assert!(steps.windows(2).all(|pair| pair[0] < pair[1]));
        assert!(steps.len() <= 1 + rate_hz as usize, "{steps:?}");
    }
}

#[tokio::test]
async fn a_viewer_that_reads_nothing_delays_nobody() {
    let server = TestServer::start(&[]);
    let session = server.paper(true).await;
    // Whole frames as often as they go, never read.
    let mut stalled = Vec::new();
    for _ in 0..3 {
        let request = pb::WatchFramesRequest { rate_hz: Some(1000.0), ..watch(&session, 10, pb::Encoding::F32) };
        stalled.push(server.views().await.watch_frames(request).await.unwrap().into_inner());
    }
    let request = watch(&session, 0, pb::Encoding::I16);
    let mut quick = server.views().await.watch_frames(request).await.unwrap().into_inner();
    let mut touch = stir(&server, &session, 1000).await;
    server.start_until(&session, 1000).await;
    let last = touch.sample_with(|sample| sample.step == 1000).await;
    assert_eq!(last.tools[0].acknowledged_sequence, 996);
    loop {
        let (last, _) = frame(&mut quick).await;
        if last.step > 950 {
            break;
        }
    }
    drop(stalled);
    server.start_until(&session, 1010).await;
    server.hash_at(&session, 1010).await;
}

#[tokio::test]
async fn a_greedy_session_leaves_frames_for_others() {
    let server = TestServer::start(&[]);
    let greedy = server.paper(false).await;
    let request = pb::WatchFramesRequest { rate_hz: Some(1000.0), ..watch(&greedy, 10, pb::Encoding::F32) };
    let mut flood = server.views().await.watch_frames(request).await.unwrap().into_inner();
    let reading = tokio::spawn(async move { while flood.message().await.is_ok_and(|part| part.is_some()) {} });
    let session = server.paper(true).await;
    let request = pb::WatchFramesRequest { rate_hz: Some(50.0), ..watch(&session, 0, pb::Encoding::I16) };
    let mut frames = server.views().await.watch_frames(request).await.unwrap().into_inner();
    let _touch = stir(&server, &session, 1000).await;
    server.start_until(&session, 1000).await;
    // How many come in time is for a bench; that whose turn it is gets it, for `realtime::frames`.
    while frame(&mut frames).await.0.step < 1000 {}
    assert!(!reading.is_finished(), "the flood has ended");
    reading.abort();
}

#[tokio::test]
async fn bad_views_are_refused() {
    let server = TestServer::start(&[]);
    let session = server.paper(true).await;
    let good = watch(&session, 1, pb::Encoding::F32);
    let mut views = server.views().await;
    for (request, code, reason, field) in [
        (
            pb::WatchFramesRequest { refinement: 11, ..good.clone() },
            Code::InvalidArgument,
            "OUT_OF_RANGE",
            "refinement",
        ),
        (
            pb::WatchFramesRequest { rate_hz: Some(0.0), ..good.clone() },
            Code::InvalidArgument,
            "OUT_OF_RANGE",
            "rate_hz",
        ),
        (
            pb::WatchFramesRequest { rate_hz: Some(f64::NAN), ..good.clone() },
            Code::InvalidArgument,
            "NOT_FINITE",
            "rate_hz",
        ),
        (
            pb::WatchFramesRequest { rate_hz: Some(1001.0), ..good.clone() },
            Code::InvalidArgument,
            "OUT_OF_RANGE",
            "rate_hz",
        ),
        (pb::WatchFramesRequest { encoding: 9, ..good.clone() }, Code::InvalidArgument, "WRONG_KIND", "encoding"),
        (
            pb::WatchFramesRequest { max_frames_in_flight: Some(0), ..good.clone() },
            Code::InvalidArgument,
            "OUT_OF_RANGE",
            "max_frames_in_flight",
        ),
        (
            pb::WatchFramesRequest { session_id: "nobody".into(), ..good },
            Code::NotFound,
            "UNKNOWN_SESSION",
            "session_id",
        ),
    ] {
        let status = views.watch_frames(request).await.unwrap_err();
        assert_eq!(told(&status), (code, reason.into(), field.into()));
    }
    let request = pb::GetMeshRequest { session_id: session, refinement: 11 };
    assert_eq!(told(&views.get_mesh(request).await.unwrap_err()).2, "refinement");
}
