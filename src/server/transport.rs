//! What the transport (HTTP/2) is given of a connection, and what it says when it cuts one.
//!
//! The transport counts small DATA frames that came and that nobody has read: each is charged 256 bytes less its own, and
//! above half of the connection's window it takes them for an attack and cuts the connection. A client that commands a
//! tool at 1 kHz sends nothing but such frames. When the server has stood still, or its cores were busy, seconds of them
//! wait in the socket, and the transport would read them all before anybody gets a turn. So we give it no more than a
//! portion before its readers have taken that: the rest waits in the system's buffer, where TCP holds the client back.

use std::pin::Pin;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;

use futures_util::task::AtomicWaker;
use tokio::time::{Instant, Sleep};

/// What a small frame is charged, less its length, bytes (`DEFAULT_DATA_FRAME_OVERHEAD_THRESHOLD` of the crate h2).
const SMALL_BYTES: usize = 256;

/// What may be charged for frames that nobody has taken before no more is read, as a part of the connection's window: the
/// transport cuts at half of it, after eight portions of which none was taken.
const PORTIONS: usize = 16;

/// So long nothing more is read for readers that take nothing. Then a portion is given all the same: an answer may wait for
/// what comes behind, and what was sent to a stream that is over is never taken.
const PATIENCE: Duration = Duration::from_millis(100);

/// What one connection has given the transport that nobody has taken yet; and whether it is to be closed.
#[derive(Debug)]
pub(super) struct Gate {
    portion_bytes: usize,
    charged_bytes: AtomicUsize,
    closed: AtomicBool,
    waker: AtomicWaker,
}

fn charge(bytes: usize) -> usize {
    if bytes == 0 { 0 } else { SMALL_BYTES.saturating_sub(bytes) }
}

impl Gate {
    /// Of a connection with that window.
    pub(super) fn new(window_bytes: u32) -> Self {
        let portion_bytes = (window_bytes as usize / PORTIONS).max(SMALL_BYTES);
        Gate { portion_bytes, charged_bytes: 0.into(), closed: false.into(), waker: AtomicWaker::new() }
    }

    /// The transport was given a frame with so many bytes.
    fn given(&self, bytes: usize) {
        self.charged_bytes.fetch_add(charge(bytes), Ordering::AcqRel);
    }

    /// Who was meant has taken a frame with so many bytes.
    pub(super) fn taken(&self, bytes: usize) {
        let less = |charged: usize| Some(charged.saturating_sub(charge(bytes)));
        let before = self.charged_bytes.fetch_update(Ordering::AcqRel, Ordering::Acquire, less).unwrap_or_default();
        let half = self.portion_bytes / 2;
        if before >= half && before.saturating_sub(charge(bytes)) < half {
            self.waker.wake();
        }
    }

    /// Closes the connection, whatever goes on there.
    pub(super) fn close(&self) {
        self.closed.store(true, Ordering::Release);
        self.waker.wake();
    }

    /// Whether it is to be closed; who asks is woken when it is.
    pub(super) fn is_closed(&self, context: &Context<'_>) -> bool {
        self.waker.register(context.waker());
        self.closed.load(Ordering::Acquire)
    }

    /// Over when it is to be closed.
    pub(super) async fn closed(&self) {
        std::future::poll_fn(|context| if self.is_closed(context) { Poll::Ready(()) } else { Poll::Pending }).await;
    }

    fn is_full(&self) -> bool {
        self.charged_bytes.load(Ordering::Acquire) >= self.portion_bytes
    }
}

/// Holds a connection back whose frames nobody takes.
#[derive(Debug, Default)]
pub(super) struct Holdback(Option<Pin<Box<Sleep>>>);

impl Holdback {
    /// Ready when more may be read; who asks was registered by [`Gate::is_closed`] before.
    pub(super) fn poll(&mut self, gate: &Gate, context: &mut Context<'_>) -> Poll<()> {
        if gate.is_full() {
            let until = Instant::now() + PATIENCE;
            if self
                .0
                .get_or_insert_with(|| Box::pin(tokio::time::sleep_until(until)))
                .as_mut()
                .poll(context)
                .is_pending()
            {
                return Poll::Pending;
            }
            gate.charged_bytes.store(0, Ordering::Release);
        }
        self.0 = None;
        Poll::Ready(())
    }
}

/// Why a transport cuts a connection.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Cut {
    /// By RFC 9113.
    pub(super) reason: &'static str,
    /// The words of who cut it, fit for a log.
    pub(super) words: String,
}

/// One direction of a connection as it passes: of HTTP/2 the heads of its frames are read.
#[derive(Debug, Default)]
pub(super) enum Frames {
    /// So many bytes of the preface have come.
    #[default]
    Unknown,
    Preface(usize),
    /// It is HTTP/1.1.
    Other,
    Head([u8; HEAD_BYTES], usize),
    Payload(usize),
    GoAway(usize, Vec<u8>),
}

/// Length (3 bytes), kind, flags and stream (4).
const HEAD_BYTES: usize = 9;
const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
const DATA: u8 = 0;
const GOAWAY: u8 = 7;

/// Of a GOAWAY: the last stream, the reason, and what is kept of the words.
const MOST_OF_GOAWAY: usize = 8 + 64;

/// Names of the reasons, by RFC 9113, section 7.
const REASONS: [&str; 14] = [
    "NO_ERROR",
    "PROTOCOL_ERROR",
    "INTERNAL_ERROR",
    "FLOW_CONTROL_ERROR",
    "SETTINGS_TIMEOUT",
    "STREAM_CLOSED",
    "FRAME_SIZE_ERROR",
    "REFUSED_STREAM",
    "CANCEL",
    "COMPRESSION_ERROR",
    "CONNECT_ERROR",
    "ENHANCE_YOUR_CALM",
    "INADEQUATE_SECURITY",
    "HTTP_1_1_REQUIRED",
];

impl Frames {
    /// Before the first frame of a server.
    pub(super) fn of_server() -> Self {
        Frames::Head([0; HEAD_BYTES], 0)
    }

    /// HTTP/2 is spoken.
    pub(super) fn are_read(&self) -> bool {
        !matches!(self, Frames::Unknown | Frames::Preface(_) | Frames::Other)
    }

    /// So many bytes have passed: counts their DATA frames at `gate`; tells if the connection is cut.
    pub(super) fn pass(&mut self, mut bytes: &[u8], gate: Option<&Gate>) -> Option<Cut> {
        let mut cut = None;
        while !bytes.is_empty() {
            match self {
                Frames::Unknown => *self = Frames::Preface(0),
                Frames::Other => break,
                Frames::Preface(come) => {
                    let here = bytes.len().min(PREFACE.len() - *come);
                    if bytes[..here] != PREFACE[*come..*come + here] {
                        *self = Frames::Other;
                        break;
                    }
                    *come += here;
                    bytes = &bytes[here..];
                    if *come == PREFACE.len() {
                        *self = Frames::Head([0; HEAD_BYTES], 0);
                    }
                }
                Frames::Head(head, come) => {
                    let here = bytes.len().min(HEAD_BYTES - *come);
                    head[*come..*come + here].copy_from_slice(&bytes[..here]);
                    *come += here;
                    bytes = &bytes[here..];
                    if *come == HEAD_BYTES {
                        let length = usize::from(head[0]) << 16 | usize::from(head[1]) << 8 | usize::from(head[2]);
                        if let (DATA, Some(gate)) = (head[3], gate) {
                            gate.given(length);
                        }
                        *self = match (head[3], length) {
                            (_, 0) => Frames::Head([0; HEAD_BYTES], 0),
                            (GOAWAY, _) => Frames::GoAway(length, Vec::new()),
                            _ => Frames::Payload(length),
                        };
                    }
                }
                Frames::Payload(left) => {
                    let here = bytes.len().min(*left);
                    bytes = &bytes[here..];
                    *left -= here;
                    if *left == 0 {
                        *self = Frames::Head([0; HEAD_BYTES], 0);
                    }
                }
                Frames::GoAway(left, kept) => {
                    let here = bytes.len().min(*left);
                    kept.extend(&bytes[..here.min(MOST_OF_GOAWAY - kept.len())]);
                    bytes = &bytes[here..];
                    *left -= here;
                    if *left == 0 {
                        cut = told(kept).or(cut);
                        *self = Frames::Head([0; HEAD_BYTES], 0);
                    }
                }
            }
        }
        cut
    }
}

/// What a GOAWAY says, unless it is an orderly end.
fn told(payload: &[u8]) -> Option<Cut> {
    let code: [u8; 4] = payload.get(4..8)?.try_into().ok()?;
    let reason =
        *usize::try_from(u32::from_be_bytes(code)).ok().and_then(|code| REASONS.get(code)).unwrap_or(&"UNKNOWN");
    let words = String::from_utf8_lossy(&payload[8..]).escape_debug().to_string();
    (reason != REASONS[0]).then_some(Cut { reason, words })
}

#[cfg(test)]
mod tests {
    use super::*;

    const WINDOW_BYTES: u32 = 1 << 20;

    fn frame(kind: u8, payload: &[u8]) -> Vec<u8> {
        let length = u32::try_from(payload.len()).unwrap().to_be_bytes();
        [&length[1..], &[kind, 0, 0, 0, 0, 1], payload].concat()
    }

    fn charged(gate: &Gate) -> usize {
        gate.charged_bytes.load(Ordering::Acquire)
    }

    #[test]
    fn small_frames_are_charged_however_they_are_cut_up_and_until_they_are_taken() {
        let goaway = [&[0, 0, 0, 0, 0, 0, 0, 11][..], b"too_many\x1b[2J"].concat();
        let said = [PREFACE, &frame(4, &[0; 18]), &frame(DATA, &[7; 56]), &frame(DATA, &[0; 300]), &frame(DATA, &[])];
        let said = [&said.concat()[..], &frame(GOAWAY, &goaway), &frame(DATA, &[9; 6])].concat();
        for piece in 1..said.len() {
            let (gate, mut frames) = (Gate::new(WINDOW_BYTES), Frames::default());
            let cuts: Vec<_> = said.chunks(piece).filter_map(|bytes| frames.pass(bytes, Some(&gate))).collect();
            assert!(frames.are_read());
            assert_eq!(charged(&gate), 200 + 250, "in pieces of {piece}");
            // Nothing of a client gets into a log as it is.
            assert_eq!(cuts, [Cut { reason: "ENHANCE_YOUR_CALM", words: "too_many\\u{1b}[2J".into() }]);
            gate.taken(56);
            gate.taken(300);
            gate.taken(6);
            gate.taken(6);
            assert_eq!(charged(&gate), 0);
        }
    }

    #[test]
    fn an_orderly_end_is_no_cut_and_another_protocol_is_left_alone() {
        let mut frames = Frames::of_server();
        assert_eq!(frames.pass(&frame(GOAWAY, &[0; 8]), None), None);
        assert_eq!(frames.pass(&frame(GOAWAY, &[0; 3]), None), None);
        let (gate, mut frames) = (Gate::new(WINDOW_BYTES), Frames::default());
        assert_eq!(frames.pass(b"PRI * HTTP/1.1\r\n", Some(&gate)), None);
        assert_eq!(frames.pass(&frame(DATA, &[1; 4]), Some(&gate)), None);
        assert!(!frames.are_read() && charged(&gate) == 0);
    }

    #[tokio::test]
    async fn a_portion_that_nobody_takes_is_waited_for_but_not_for_ever() {
        let (gate, mut holdback) = (Gate::new(WINDOW_BYTES), Holdback::default());
        for _ in 0..WINDOW_BYTES / 16 / 200 + 1 {
            gate.given(56);
        }
        let begun = Instant::now();
        let passed = std::future::poll_fn(|context| holdback.poll(&gate, context));
        passed.await;
        assert!(begun.elapsed() >= PATIENCE);
        assert_eq!(charged(&gate), 0);
        std::future::poll_fn(|context| holdback.poll(&gate, context)).await;
    }
}
