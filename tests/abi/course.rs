//! What a server has sent is recorded, with the places of a hand: Rust, C and C# make the same forces of it, bit by bit.

use std::time::Duration;

use glam::DVec3;
use palpate_client::Reading;
use palpate_client::bridge::{Offline, PositionOrigin};
use palpate_haptics::{Device, Tip};
use palpate_proto::{pb, touch};
use pb::command::Action;
use pb::touch_response::Message as Heard;
use prost::Message;

use crate::server::{TEST_TIMEOUT, TestServer, TestTouch, open};
use crate::{compiled, compiled_cs, done, folder, has_mono, mono, ours, root, told};

/// What happened at the client, in order.
enum ClientEvent {
    Arrived(Vec<u8>),
    Ticked { time_s: f64, place_m: DVec3, enable: bool },
}

/// A hand that goes down, slides and comes back, m from the middle.
fn place_m(time_s: f64) -> DVec3 {
    let press_m = 0.004 * (3.0 * (time_s - 0.4)).clamp(0.0, 1.0) * (4.0 * (1.4 - time_s)).clamp(0.0, 1.0);
    let slide_m = 0.006 * (2.0 * (time_s - 0.8)).clamp(0.0, 1.0);
    DVec3::new(slide_m, -0.3 * slide_m, 0.001 - press_m)
}

/// A second and a half of touch of a real server, as it came, with a sample every so many steps.
async fn recorded(server: &TestServer, every: u32) -> (DVec3, Vec<ClientEvent>) {
    let source = pb::create_session_request::Source::SceneName("liver".into());
    let session = server.create(source, false).await.unwrap();
    let middle_m = palpate_proto::geometry::from_vector(session.extent.unwrap().middle_m.as_ref());
    let request = pb::TouchOpen {
        device: Some(touch::device(&Device::named("omega3").unwrap())),
        tip: Some(touch::tip(&Tip::default())),
        sample_every_steps: Some(every),
        ..open(&session.session_id, &[0])
    };
    let mut stream = TestTouch::open(server, request).await.unwrap();
    let bytes = |message: Heard| ClientEvent::Arrived(pb::TouchResponse { message: Some(message) }.encode_to_vec());
    let mut events = vec![bytes(Heard::Opened(stream.opened.clone().unwrap()))];
    for tick in 0..1500_u32 {
        let time_s = 1e-3 * f64::from(tick);
        let place_m = middle_m + place_m(time_s);
        events.push(ClientEvent::Ticked { time_s, place_m, enable: tick > 5 });
        let command = pb::Command {
            sequence: Some(1 + u64::from(tick)),
            // The clock of a ticker begins at 1 s.
            client_time_ns: 1_000_000_000 + 1_000_000 * u64::from(tick),
            action: Some(Action::Pose(touch::pose(place_m, &Tip::default()))),
            ..Default::default()
        };
        stream.command(command).await;
        // Everything that comes within a millisecond.
        let until = tokio::time::Instant::now() + Duration::from_millis(1);
        while let Ok(heard) = tokio::time::timeout_at(until, stream.hear()).await {
            events.push(bytes(heard.unwrap().unwrap()));
        }
    }
    (middle_m, events)
}

/// The file of `replay.c`.
fn written(middle_m: DVec3, events: &[ClientEvent]) -> Vec<u8> {
    let mut file = Vec::new();
    let numbers = |file: &mut Vec<u8>, numbers: &[f64]| numbers.iter().for_each(|x| file.extend(x.to_le_bytes()));
    numbers(&mut file, &middle_m.to_array());
    for event in events {
        match event {
            ClientEvent::Arrived(bytes) => {
                file.extend(0_u32.to_le_bytes());
                file.extend(u32::try_from(bytes.len()).unwrap().to_le_bytes());
                file.extend(bytes);
            }
            ClientEvent::Ticked { time_s, place_m, enable } => {
                file.extend(1_u32.to_le_bytes());
                numbers(&mut file, &[*time_s, place_m.x, place_m.y, place_m.z, f64::from(u8::from(*enable))]);
            }
        }
    }
    file
}

/// What [`written`] has written.
fn read(file: &[u8]) -> (DVec3, Vec<ClientEvent>) {
    fn take<'f, const N: usize>(rest: &mut &'f [u8]) -> &'f [u8; N] {
        let (taken, left) = rest.split_first_chunk().expect("the record ends within an event");
        *rest = left;
        taken
    }
    let number = |rest: &mut &[u8]| f64::from_le_bytes(*take(rest));
    let vector = |rest: &mut &[u8]| DVec3::new(number(rest), number(rest), number(rest));
    let mut rest = file;
    let (middle_m, mut events) = (vector(&mut rest), Vec::new());
    while !rest.is_empty() {
        events.push(if u32::from_le_bytes(*take(&mut rest)) == 0 {
            let length = u32::from_le_bytes(*take(&mut rest)) as usize;
            let (bytes, left) = rest.split_at(length);
            rest = left;
            ClientEvent::Arrived(bytes.to_vec())
        } else {
            let time_s = number(&mut rest);
            ClientEvent::Ticked { time_s, place_m: vector(&mut rest), enable: number(&mut rest) != 0.0 }
        });
    }
    (middle_m, events)
}

/// The forces of Rust, as `replay.c` writes them; those of C and C# are the same.
fn assert_same_forces(name: &str, middle_m: DVec3, events: &[ClientEvent]) {
    let device = Device::named("omega3").unwrap();
    let Offline { mut ticker, mut record } = Offline::new(device, PositionOrigin::Tissue, middle_m, 0.0);
    let (mut forces, mut most_n) = (Vec::new(), 0.0_f64);
    for event in events {
        match event {
            ClientEvent::Arrived(bytes) => record.arrive(bytes).unwrap(),
            ClientEvent::Ticked { time_s, place_m, enable } => {
                let force_n = ticker.tick(Reading { place_m: *place_m, enable: *enable }, *time_s);
                most_n = most_n.max(force_n.length());
                force_n.to_array().iter().for_each(|part| forces.extend(part.to_le_bytes()));
            }
        }
    }
    assert_eq!(forces.len(), 1500 * 24);
    assert!(most_n > 0.1, "{most_n} N: the record shows no touch");
    let replay = compiled("clients/c/tests/replay.c", &[]);
    let file = |ending: &str| folder().join(format!("{name}.{ending}"));
    let (recorded, by_c, by_cs) = (file("record"), file("c.forces"), file("cs.forces"));
    std::fs::write(&recorded, written(middle_m, events)).unwrap();
    done(ours(&replay).args([&recorded, &by_c]));
    assert!(std::fs::read(&by_c).unwrap() == forces, "C renders other forces");
    // Glibc lets a program have these functions of its own.
    if cfg!(target_env = "gnu") {
        let counted = told(&done(ours(&compiled("clients/c/tests/counted.c", &["-ldl"])).arg(&recorded)));
        let expected = serde_json::json!({ "ticks": 1500, "memory": 0, "locks": 0, "system_calls": 0 });
        assert_eq!(counted, expected, "what ticks ask of the system");
    }
    if has_mono() {
        done(mono(&compiled_cs("clients/csharp/tests/Replay.cs")).args([&recorded, &by_cs]));
        assert!(std::fs::read(&by_cs).unwrap() == forces, "C# renders other forces");
    }
}

/// Both tests compile to the same files.
static COMPILED: tokio::sync::Mutex<()> = tokio::sync::Mutex::const_new(());

/// The record that the tests of Python render too. PALPATE_RECORD=1 makes it anew.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_kept_record_gives_the_same_forces_in_every_language() {
    let _turn = COMPILED.lock().await;
    let kept = root().join("tests/abi/touch.record");
    if std::env::var_os("PALPATE_RECORD").is_some() {
        let server = TestServer::start(&[]);
        let (middle_m, events) = recorded(&server, 20).await;
        std::fs::write(&kept, written(middle_m, &events)).unwrap();
    }
    let file = std::fs::read(&kept).unwrap();
    let (middle_m, events) = read(&file);
    assert!(written(middle_m, &events) == file);
    assert_same_forces("kept", middle_m, &events);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_force_course_is_the_same_in_every_language() {
    let _turn = COMPILED.lock().await;
    let server = TestServer::start(&[]);
    let (middle_m, events) =
        tokio::time::timeout(TEST_TIMEOUT, recorded(&server, 1)).await.expect("the server is silent");
    assert_same_forces("fresh", middle_m, &events);
}
