//! A session under load: for a minute (DUTY_S seconds), a haptic stream that sends a command for each sample, a
//! thousand a second, and a viewer that takes 60 frames of 331 × 331 vertices a second, each on its own thread and
//! connection. Checks that steps stay on time and that no command is lost.

#![allow(clippy::unwrap_used, clippy::disallowed_methods, clippy::cast_precision_loss, missing_docs)]

#[path = "../tests/common/server.rs"]
mod server;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use palpate_proto::pb;
use pb::touch_response::Message as Heard;
use server::{TestServer, TestTouch, force};

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap()
}

fn main() {
    let seconds: u64 = std::env::var("DUTY_S").ok().and_then(|text| text.parse().ok()).unwrap_or(60);
    let server = Arc::new(TestServer::start(&["--log", "warn"]));
    let session = runtime().block_on(server.paper(true));
    let steps = seconds * 1000;

    let over = Arc::new(AtomicBool::new(false));
    let viewer = std::thread::spawn({
        let (server, session, over) = (server.clone(), session.clone(), over.clone());
        move || {
            runtime().block_on(async {
                let request = pb::WatchFramesRequest {
                    session_id: session,
                    refinement: 10,
                    always_full: true,
                    ..Default::default()
                };
                let mut parts = server.views().await.watch_frames(request).await.unwrap().into_inner();
                let (mut frames, mut bytes, mut skipped) = (0_u64, 0, 0);
                while !over.load(Ordering::Relaxed) {
                    let next = tokio::time::timeout(std::time::Duration::from_millis(200), parts.message()).await;
                    let Ok(part) = next else { continue };
                    let part = part.unwrap().unwrap();
                    bytes += part.patches.iter().map(|patch| patch.displacement.len() as u64).sum::<u64>();
                    frames += u64::from(part.last);
                    skipped = part.skipped_frames;
                }
                (frames, bytes, skipped)
            })
        }
    });

    let (first, last, sent, rejected, samples) = runtime().block_on(async {
        let mut touch = TestTouch::hold(&server, &session).await;
        let (mut sent, mut rejected, mut samples, mut first) = (0, 0, 0_u64, None);
        server.start_until(&session, steps).await;
        loop {
            match touch.hear().await.unwrap().unwrap() {
                Heard::Sample(sample) if sample.step == 0 => {}
                Heard::Sample(sample) => {
                    samples += 1;
                    first.get_or_insert(sample.clone());
                    if sample.step == steps {
                        break (first.unwrap(), sample, sent, rejected, samples);
                    }
                    // The last few have no step left to take effect in.
                    if sample.step < steps - 20 {
                        sent += 1;
                        let strength_n = -1.0 - 0.5 * (sample.step as f64 * 0.01).sin();
                        touch.command(force(0, sent, strength_n)).await;
                    }
                }
                Heard::Rejection(_) => rejected += 1,
                _ => {}
            }
        }
    });
    over.store(true, Ordering::Relaxed);
    let (frames, bytes, skipped) = viewer.join().unwrap();
    let real_s = (last.server_time_ns - first.server_time_ns) as f64 * 1e-9;
    let dilation = (last.simulation_time_s - first.simulation_time_s) / real_s;
    let acted = last.tools[0].acknowledged_sequence;
    println!("| {seconds} s of one session | |\n|---|---|");
    println!("| time dilation (simulated / real) | {dilation:.5} |");
    println!("| steps dropped | {} |", last.overrun_count);
    println!("| commands sent / acted / refused | {sent} / {acted} / {rejected} |");
    println!("| samples received / dropped | {samples} / {} |", last.dropped_samples);
    println!("| frames received / skipped | {frames} / {skipped} |");
    println!("| frame bytes a second | {:.1} MB |", bytes as f64 / real_s / 1e6);
    if acted != sent || rejected > 0 {
        println!("commands were lost");
        std::process::exit(1);
    }
}
