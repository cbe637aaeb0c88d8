//! A wire that delays: what goes in at one end comes out at the other so much later, in order. And it can be cut.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used, clippy::disallowed_methods)]

use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc;

pub struct Proxy {
    address: SocketAddr,
    target: Arc<Mutex<String>>,
    whole: Arc<AtomicBool>,
    connections: Arc<AtomicU64>,
}

impl Proxy {
    /// In front of `target` ("127.0.0.1:7117"), delaying each way.
    pub async fn start(target: String, delay: Duration) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let (whole, connections) = (Arc::new(AtomicBool::new(true)), Arc::new(AtomicU64::new(0)));
        let target = Arc::new(Mutex::new(target));
        tokio::spawn({
            let (target, whole, connections) = (target.clone(), whole.clone(), connections.clone());
            async move {
                while let Ok((near, _)) = listener.accept().await {
                    if !whole.load(Ordering::Relaxed) {
                        continue;
                    }
                    let target = target.lock().unwrap().clone();
                    let Ok(far) = TcpStream::connect(target).await else { continue };
                    connections.fetch_add(1, Ordering::Relaxed);
                    near.set_nodelay(true).unwrap();
                    far.set_nodelay(true).unwrap();
                    let ((near_in, near_out), (far_in, far_out)) = (near.into_split(), far.into_split());
                    tokio::spawn(carry(near_in, far_out, delay, whole.clone()));
                    tokio::spawn(carry(far_in, near_out, delay, whole.clone()));
                }
            }
        });
        Proxy { address, target, whole, connections }
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
        self.whole.store(false, Ordering::Relaxed);
    }

    pub fn mend(&self) {
        self.whole.store(true, Ordering::Relaxed);
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
    whole: Arc<AtomicBool>,
) {
    let (sender, mut waiting) = mpsc::unbounded_channel::<(Instant, Vec<u8>)>();
    let reading = async {
        let mut buffer = vec![0; 1 << 16];
        while let Ok(count @ 1..) = from.read(&mut buffer).await {
            if !whole.load(Ordering::Relaxed)
                || sender.send((Instant::now() + delay, buffer[..count].to_vec())).is_err()
            {
                return;
            }
        }
    };
    let writing = async {
        while let Some((due, bytes)) = waiting.recv().await {
            tokio::time::sleep_until(due.into()).await;
            if !whole.load(Ordering::Relaxed) || to.write_all(&bytes).await.is_err() {
                return;
            }
        }
    };
    let cut = async {
        while whole.load(Ordering::Relaxed) {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    // Whoever ends first ends the connection.
    tokio::select! {
        () = reading => {}
        () = writing => {}
        () = cut => {}
    }
}
