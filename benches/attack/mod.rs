//! Clients that are not friends, each on a thread of its own until it is ended.
#![allow(unreachable_pub)]

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use palpate::wire::pb;
use pb::touch_request::Message as Say;
use tokio_stream::StreamExt;

use crate::server::{Server, force, open};

/// What an attack does.
#[derive(Clone, Copy)]
pub enum Kind {
    /// Asks for a thousand full frames a second, and reads none.
    StalledViewer,
    /// Sends commands at a hundred times the rate of the session.
    Flood,
    /// Opens a thousand connections, and says nothing.
    HalfOpen,
    /// Makes sessions and drops them, as fast as it can.
    CreateAndDrop,
}

impl Kind {
    pub const ALL: [(Kind, &'static str); 4] = [
        (Kind::StalledViewer, "a viewer that asks for 1000 full frames a second and reads none"),
        (Kind::Flood, "a client that sends 100 times as many commands"),
        (Kind::HalfOpen, "1000 connections that say nothing"),
        (Kind::CreateAndDrop, "a client that makes and drops sessions without end"),
    ];
}

/// An attack under way.
pub struct Attack {
    over: Arc<AtomicBool>,
    thread: Option<JoinHandle<u64>>,
}

impl Attack {
    pub fn start(kind: Kind, server: &Arc<Server>) -> Self {
        let over = Arc::new(AtomicBool::new(false));
        let thread = std::thread::spawn({
            let (over, server) = (over.clone(), server.clone());
            move || {
                // Whoever attacks shares a core with the clients that are measured: it is the server's that counts.
                #[cfg(target_os = "linux")]
                rustix::process::setpriority_process(None, 19).unwrap();
                let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
                runtime.block_on(run(kind, &server, &over))
            }
        });
        Attack { over, thread: Some(thread) }
    }

    /// Ends it; tells how often it struck.
    pub fn end(mut self) -> u64 {
        self.over.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap()
    }
}

async fn until(over: &AtomicBool) {
    while !over.load(Ordering::Relaxed) {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

async fn run(kind: Kind, server: &Arc<Server>, over: &AtomicBool) -> u64 {
    match kind {
        Kind::StalledViewer => {
            let session_id = server.paper(false).await;
            let request = pb::WatchFramesRequest {
                session_id,
                refinement: 10,
                rate_hz: Some(1000.0),
                always_full: true,
                ..Default::default()
            };
            let _stalled = server.views().await.watch_frames(request).await.unwrap();
            until(over).await;
            1
        }
        Kind::Flood => {
            let session = server.paper(false).await;
            let say = |message| pb::TouchRequest { message: Some(message) };
            let mut sent = 0;
            // Its stream is ended again and again.
            while !over.load(Ordering::Relaxed) {
                let (sender, receiver) = tokio::sync::mpsc::channel(64);
                sender.send(say(Say::Open(open(&session, &[0])))).await.unwrap();
                let outbound = tokio_stream::wrappers::ReceiverStream::new(receiver);
                let mut inbound = server.haptics().await.touch(outbound).await.unwrap().into_inner();
                let reading = tokio::spawn(async move { while let Some(Ok(_)) = inbound.next().await {} });
                let mut sequence = 0;
                // A hundred a millisecond, or what the transport lets through.
                let mut tick = tokio::time::interval(Duration::from_millis(1));
                'stream: while !over.load(Ordering::Relaxed) {
                    tick.tick().await;
                    for _ in 0..100 {
                        sequence += 1;
                        if sender.send(say(Say::Command(force(0, sequence, -1.0)))).await.is_err() {
                            break 'stream;
                        }
                    }
                }
                sent += sequence;
                reading.abort();
            }
            sent
        }
        Kind::HalfOpen => {
            let address = server.url.strip_prefix("http://").unwrap();
            let mut open = Vec::new();
            let mut count = 0;
            while !over.load(Ordering::Relaxed) {
                // Those that were closed are opened again.
                open.retain(|socket: &tokio::net::TcpStream| socket.try_read(&mut [0; 64]).is_err());
                while open.len() < 1000 && !over.load(Ordering::Relaxed) {
                    let Ok(socket) = tokio::net::TcpStream::connect(address).await else { break };
                    open.push(socket);
                    count += 1;
                }
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
            count
        }
        Kind::CreateAndDrop => {
            let mut sessions = server.sessions().await;
            let mut count = 0;
            while !over.load(Ordering::Relaxed) {
                let source = Some(pb::create_session_request::Source::SceneName("paper".into()));
                let request = pb::CreateSessionRequest { source, ..Default::default() };
                count += 1;
                let Ok(created) = sessions.create_session(request).await else { continue };
                let session_id = created.into_inner().session.unwrap().session_id;
                let _ = sessions.delete_session(pb::DeleteSessionRequest { session_id }).await;
            }
            count
        }
    }
}
