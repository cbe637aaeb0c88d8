//! Random clients for long (PALPATE_SOAK_S seconds): they come, touch, look, misbehave and vanish. Memory, handles and
//! threads of the server must not grow, and every command must be accounted for.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::common::random::TestRandom;
use crate::common::server::{TEST_TIMEOUT, TestServer, TestTouch, force, position};
use palpate_proto::pb;
use pb::touch_response::Message as Heard;

/// Messages that one client has sent and received.
#[derive(Default)]
struct SoakLedger {
    sent: u64,
    refused: u64,
    seen: u64,
}

/// A session of its own for a while, with a client, a viewer or both, that ends well or badly.
async fn life(server: &TestServer, random: &mut TestRandom) -> SoakLedger {
    let mut account = SoakLedger::default();
    let session = server.paper(false).await;
    let mut touch = TestTouch::hold(server, &session).await;
    let mut frames = None;
    if random.below(2) == 0 {
        let request = pb::WatchFramesRequest { session_id: session.clone(), ..Default::default() };
        frames = Some(server.views().await.watch_frames(request).await.unwrap().into_inner());
    }
    let reads = random.below(4) > 0;
    for sequence in 1..=random.below(500) + 50 {
        let command = match random.below(20) {
            0 => force(0, sequence, f64::NAN),
            1 => force(1, sequence, -1.0),
            2..=9 => position(0, sequence, -0.001 * random.below(20) as f64),
            _ => force(0, sequence, -0.01 * random.below(100) as f64),
        };
        let command = match random.below(10) {
            0 => pb::Command { at_step: Some(random.below(2000)), ..command },
            1 => pb::Command { time_to_live_s: Some(0.01), ..command },
            _ => command,
        };
        touch.command(command).await;
        account.sent += 1;
        if reads {
            // Whatever is there; now and then it waits for more.
            let patience = Duration::from_millis(random.below(3));
            while let Ok(heard) = tokio::time::timeout(patience, touch.hear()).await {
                match heard.unwrap().unwrap() {
                    Heard::Rejection(_) => account.refused += 1,
                    Heard::Sample(sample) => account.seen = account.seen.max(sample.step),
                    _ => {}
                }
                if random.below(3) == 0 {
                    break;
                }
            }
        }
        if let Some(frames) = &mut frames
            && random.below(8) == 0
        {
            let _ = tokio::time::timeout(Duration::from_millis(1), frames.message()).await;
        }
    }
    // Earlier messages have been processed once this is answered.
    let settled = pb::touch_request::Message::Renew(pb::Renew { client_time_ns: 1, datagrams: false });
    touch.say(settled).await;
    loop {
        match tokio::time::timeout(TEST_TIMEOUT, touch.hear()).await.unwrap().unwrap().unwrap() {
            Heard::Renewed(_) => break,
            Heard::Rejection(_) => account.refused += 1,
            _ => {}
        }
    }
    let counts = server.status(&session).await.commands.unwrap();
    assert_eq!(counts.accepted + counts.refused, account.sent, "{counts:?}");
    assert_eq!(counts.accepted, counts.applied + counts.superseded + counts.dropped + counts.waiting, "{counts:?}");
    match random.below(3) {
        0 => drop(touch),
        1 => touch.finish(),
        _ => {}
    }
    let request = pb::DeleteSessionRequest { session_id: session };
    server.sessions().await.delete_session(request).await.unwrap();
    account
}

/// Resident memory (KiB), handles and threads.
fn weight(server: &TestServer) -> [usize; 3] {
    let of = |what: &str| format!("/proc/{}/{what}", server.child.id());
    let status = std::fs::read_to_string(of("status")).unwrap();
    let line = |name: &str| {
        let line = status.lines().find(|line| line.starts_with(name)).unwrap();
        line.split_whitespace().nth(1).unwrap().parse().unwrap()
    };
    [line("VmRSS:"), std::fs::read_dir(of("fd")).unwrap().count(), line("Threads:")]
}

#[cfg(target_os = "linux")]
#[test]
#[ignore = "long: `make soak`"]
fn nothing_grows_and_no_command_is_lost() {
    let seconds: u64 = std::env::var("PALPATE_SOAK_S").ok().and_then(|text| text.parse().ok()).unwrap_or(60);
    let server = Arc::new(TestServer::start(&["--log", "error"]));
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    let begun = Instant::now();
    let lives = |round: u64, length: Duration| {
        let clients: Vec<_> = (0..12)
            .map(|number| {
                let server = server.clone();
                let mut random = TestRandom(round * 1000 + number);
                let until = Instant::now() + length;
                runtime.spawn(async move {
                    let (mut lives, mut account) = (0_u64, SoakLedger::default());
                    while Instant::now() < until {
                        let one = life(&server, &mut random).await;
                        account.sent += one.sent;
                        account.refused += one.refused;
                        account.seen += one.seen;
                        lives += 1;
                    }
                    (lives, account)
                })
            })
            .collect();
        let mut sum = (0, 0, 0, 0);
        for client in clients {
            let (lives, account) = runtime.block_on(client).unwrap();
            sum = (sum.0 + lives, sum.1 + account.sent, sum.2 + account.refused, sum.3 + account.seen);
        }
        // The last ended session is removed.
        let quiet = Instant::now();
        while weight(&server)[1] > 40 && quiet.elapsed() < TEST_TIMEOUT {
            std::thread::sleep(Duration::from_millis(50));
        }
        sum
    };
    // Caches and arenas grow to what so many clients need, once.
    let part = Duration::from_secs((seconds / 10).max(3));
    lives(0, part);
    let before = weight(&server);
    println!("{before:?}: KiB resident, handles, threads");
    let mut round = 1;
    while begun.elapsed() < Duration::from_secs(seconds) {
        let (lives, sent, refused, seen) = lives(round, part);
        println!(
            "{:.0} s: {lives} lives, {sent} commands, {refused} refused, {seen} steps seen; {:?}",
            begun.elapsed().as_secs_f64(),
            weight(&server)
        );
        assert!(sent > 0 && refused > 0);
        round += 1;
    }
    let after = weight(&server);
    assert!(after[0] < before[0] + before[0] / 4 + 8192, "memory grows: {before:?} to {after:?}");
    assert!(after[1] <= before[1] + 2 && after[2] <= before[2] + 2, "handles or threads grow: {before:?} to {after:?}");
}
