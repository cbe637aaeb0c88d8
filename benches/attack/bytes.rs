//! Attacks below the level of calls: bytes of HTTP, and somebody who stands still.

use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tonic::Status;

use super::Ground;

/// The beginning of an HTTP/2 connection: the preface, and default settings.
pub const GREETING: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0";

/// One byte more for the connection.
pub const WINDOW_UPDATE: [u8; 13] = *b"\0\0\x04\x08\0\0\0\0\0\0\0\0\x01";
/// Of a stream that there is not.
pub const PRIORITY: [u8; 14] = *b"\0\0\x05\x02\0\0\0\0\x01\0\0\0\0\x0f";
pub const PING: [u8; 17] = *b"\0\0\x08\x06\0\0\0\0\0palpated";
/// None; they are to be acknowledged.
pub const SETTINGS: [u8; 9] = *b"\0\0\0\x04\0\0\0\0\0";

fn broken(error: &std::io::Error) -> Status {
    Status::unavailable(error.kind().to_string())
}

/// `bytes` again and again, each `each` of them a strike; what comes back is thrown away.
async fn pour(ground: &Ground, greeting: &[u8], bytes: &[u8], each: usize) -> Result<(), Status> {
    let socket = TcpStream::connect(ground.caller.address()).await.map_err(|error| broken(&error))?;
    let (mut from, mut to) = socket.into_split();
    let writing = async {
        to.write_all(greeting).await?;
        let mut many = Vec::new();
        while many.len() < 16_384 {
            many.extend_from_slice(bytes);
        }
        loop {
            to.write_all(&many).await?;
            (0..many.len() / each).for_each(|_| ground.strike());
        }
    };
    let reading = async {
        let mut buffer = vec![0; 65_536];
        loop {
            if from.read(&mut buffer).await? == 0 {
                return Err(std::io::ErrorKind::ConnectionReset.into());
            }
        }
    };
    let ended: std::io::Error = tokio::select! {
        Err::<(), _>(ended) = writing => ended,
        Err::<(), _>(ended) = reading => ended,
        else => return Ok(()),
    };
    Err(broken(&ended))
}

/// Frames of one kind.
pub async fn frames(ground: &Ground, frame: &[u8]) -> Result<(), Status> {
    pour(ground, GREETING, frame, frame.len()).await
}

pub async fn page_gets(ground: &Ground) -> Result<(), Status> {
    let request = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n";
    pour(ground, b"", request, request.len()).await
}

/// Guard that lets a stopped process continue, whatever happens.
struct Stopped(Pid);

impl Drop for Stopped {
    fn drop(&mut self) {
        let _ = kill_process(self.0, Signal::CONT);
    }
}

/// Once, and then nothing.
pub async fn stall_server(ground: &Ground, seconds: f64) -> Result<(), Status> {
    let process = Pid::from_raw(i32::try_from(ground.process).unwrap()).unwrap();
    kill_process(process, Signal::STOP).map_err(|error| broken(&error.into()))?;
    let stopped = Stopped(process);
    tokio::time::sleep(Duration::from_secs_f64(seconds)).await;
    drop(stopped);
    ground.strike();
    std::future::pending().await
}

/// Stops the honest client for a time, and lets it continue.
pub async fn stall_client(ground: &Ground, seconds: f64) -> Result<(), Status> {
    if let Some(freezer) = &ground.freezer {
        freezer.freeze(Duration::from_secs_f64(seconds));
        ground.strike();
    }
    std::future::pending().await
}
