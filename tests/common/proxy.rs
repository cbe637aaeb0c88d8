//! A wire that delays: what goes in at one end comes out at the other so much later, in order. And it can be cut, or
//! fall silent.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used, clippy::disallowed_methods)]

use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc;

/// Carries all.
const WHOLE: u8 = 0;
/// Connections break, none are made.
const CUT: u8 = 1;
/// Connections stay, and carry nothing.
const SILENT: u8 = 2;

pub struct Proxy {
    address: SocketAddr,
    target: Arc<Mutex<String>>,
    state: Arc<AtomicU8>,
    connections: Arc<AtomicU64>,
}

impl Proxy {
    /// In front of `target` ("127.0.0.1:7117"), delaying each way.
    pub async fn start(target: String, delay: Duration) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let (state, connections) = (Arc::new(AtomicU8::new(WHOLE)), Arc::new(AtomicU64::new(0)));
        let target = Arc::new(Mutex::new(target));
        tokio::spawn({
            let (target, state, connections) = (target.clone(), state.clone(), connections.clone());
            async move {
                while let Ok((near, _)) = listener.accept().await {
                    if state.load(Ordering::Relaxed) == CUT {
                        continue;
                    }
                    let target = target.lock().unwrap().clone();
                    let Ok(far) = TcpStream::connect(target).await else { continue };
                    connections.fetch_add(1, Ordering::Relaxed);
                    near.set_nodelay(true).unwrap();
                    far.set_nodelay(true).unwrap();
                    let ((near_in, near_out), (far_in, far_out)) = (near.into_split(), far.into_split());
                    tokio::spawn(carry(near_in, far_out, delay, state.clone()));
                    tokio::spawn(carry(far_in, near_out, delay, state.clone()));
                }
            }
        });
        Proxy { address, target, state, connections }
    }

    pub fn url(&self) -> String {
        format!("http://{}", self.address)
    }

    /// From now on connections go to another target.
    pub fn aim(&self, target: String) {
        *self.target.lock().unwrap() = target;
    }

    /// Cuts it: connections break, none are made.
    pub fn cut(&self) {
        self.state.store(CUT, Ordering::Relaxed);
    }

    /// Loses all data silently, as when a switch dies. Connections of which data was lost end when it is repaired.
    pub fn silence(&self) {
        self.state.store(SILENT, Ordering::Relaxed);
    }

    pub fn mend(&self) {
        self.state.store(WHOLE, Ordering::Relaxed);
    }

    /// Made so far.
    pub fn connections(&self) -> u64 {
        self.connections.load(Ordering::Relaxed)
    }
}

async fn carry(
    mut from: tokio::net::tcp::OwnedReadHalf,
    mut to: tokio::net::tcp::OwnedWriteHalf,
    delay: Duration,
    state: Arc<AtomicU8>,
) {
    let (sender, mut waiting) = mpsc::unbounded_channel::<(Instant, Vec<u8>)>();
    let has_lost = AtomicBool::new(false);
    // Whether received data is relayed; `None` if the connection ends.
    let passes = || match state.load(Ordering::Relaxed) {
        WHOLE => (!has_lost.load(Ordering::Relaxed)).then_some(true),
        SILENT => {
            has_lost.store(true, Ordering::Relaxed);
            Some(false)
        }
        _ => None,
    };
    let reading = async {
        let mut buffer = vec![0; 1 << 16];
        while let Ok(count @ 1..) = from.read(&mut buffer).await {
            match passes() {
                Some(true) if sender.send((Instant::now() + delay, buffer[..count].to_vec())).is_ok() => {}
                Some(false) => {}
                _ => return,
            }
        }
    };
    let writing = async {
        while let Some((due, bytes)) = waiting.recv().await {
            tokio::time::sleep_until(due.into()).await;
            match passes() {
                Some(true) if to.write_all(&bytes).await.is_ok() => {}
                Some(false) => {}
                _ => return,
            }
        }
    };
    let ended = async {
        loop {
            let state = state.load(Ordering::Relaxed);
            if state == CUT || state == WHOLE && has_lost.load(Ordering::Relaxed) {
                return;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    // The first end that closes ends the connection.
    tokio::select! {
        () = reading => {}
        () = writing => {}
        () = ended => {}
    }
}
