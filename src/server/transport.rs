//! Flow control between a socket and the transport (HTTP/2), and the reason why a transport closes a connection.
//!
//! The transport counts small DATA frames that it has received and that no reader has taken: it charges each with 256
//! bytes minus its length. When the sum exceeds half of the connection's window, it assumes an attack and closes the
//! connection. A client that commands a tool at 1 kHz sends nothing but such frames. After a stall of the server,
//! seconds of them wait in the socket, and the transport would read them all before any reader runs. So the server
//! passes it only a portion at a time, until readers have taken that. The rest waits in the system's buffer, where
//! TCP slows the client down.
//!
//! Frames that reach no reader (PING, SETTINGS, WINDOW_UPDATE, PRIORITY, RST_STREAM) cost the transport some hundred
//! nanoseconds each, and a client can send millions a second. So a connection with too many of them is read more
//! slowly.

use std::pin::Pin;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use futures_util::task::AtomicWaker;
use tokio::time::{Instant, Sleep};

/// The transport charges a frame with this many bytes minus its length (`DEFAULT_DATA_FRAME_OVERHEAD_THRESHOLD` of
/// the crate h2).
const SMALL_BYTES: usize = 256;

/// Number of portions in a connection's window. Reading stops when the frames that no reader has taken are charged
/// with one portion; the transport closes the connection at half of the window, which is eight portions.
const PORTIONS: usize = 16;

/// Longest pause of reading while readers take nothing. Then another portion is read regardless: a response may
/// depend on later frames, and frames of a stream that has ended are never taken.
const READER_TIMEOUT: Duration = Duration::from_millis(100);

/// Rate and burst of control frames that are read. A client that reads from this server as fast as it can sends some
/// thousand a second.
const CONTROL_FRAMES_PER_S: f64 = 10_000.0;
const CONTROL_FRAMES_AT_ONCE: f64 = 10_000.0;

/// State shared between a connection and its readers: the charge of frames not yet taken, and whether the connection
/// is to be closed.
#[derive(Debug)]
pub(super) struct Gate {
    portion_bytes: usize,
    charged_bytes: AtomicUsize,
    /// Control frames since they were last counted.
    control_frames: AtomicUsize,
    closed: AtomicBool,
    waker: AtomicWaker,
}

fn charge(bytes: usize) -> usize {
    if bytes == 0 { 0 } else { SMALL_BYTES.saturating_sub(bytes) }
}

impl Gate {
    /// Creates the gate of a connection with a window of `window_bytes`.
    pub(super) fn new(window_bytes: u32) -> Self {
        let portion_bytes = (window_bytes as usize / PORTIONS).max(SMALL_BYTES);
        Gate {
            portion_bytes,
            charged_bytes: 0.into(),
            control_frames: 0.into(),
            closed: false.into(),
            waker: AtomicWaker::new(),
        }
    }

    /// Counts a frame of this many bytes as passed to the transport.
    fn given(&self, bytes: usize) {
        self.charged_bytes.fetch_add(charge(bytes), Ordering::AcqRel);
    }

    /// Counts a frame of this many bytes as taken by its reader; wakes the connection when half of a portion is free
    /// again.
    pub(super) fn taken(&self, bytes: usize) {
        let less = |charged: usize| Some(charged.saturating_sub(charge(bytes)));
        let before = self.charged_bytes.fetch_update(Ordering::AcqRel, Ordering::Acquire, less).unwrap_or_default();
        let half = self.portion_bytes / 2;
        if before >= half && before.saturating_sub(charge(bytes)) < half {
            self.waker.wake();
        }
    }

    /// Closes the connection, in any state.
    pub(super) fn close(&self) {
        self.closed.store(true, Ordering::Release);
        self.waker.wake();
    }

    /// Returns whether the connection is to be closed; registers the current task to be woken when it is.
    pub(super) fn is_closed(&self, context: &Context<'_>) -> bool {
        self.waker.register(context.waker());
        self.closed.load(Ordering::Acquire)
    }

    /// Waits until the connection is to be closed.
    pub(super) async fn closed(&self) {
        std::future::poll_fn(|context| if self.is_closed(context) { Poll::Ready(()) } else { Poll::Pending }).await;
    }

    fn is_full(&self) -> bool {
        self.charged_bytes.load(Ordering::Acquire) >= self.portion_bytes
    }
}

/// Pauses reading from a connection while its readers take nothing, and slows it while it sends too many control
/// frames.
#[derive(Debug)]
pub(super) struct ReadPause {
    untaken: Option<Pin<Box<Sleep>>>,
    /// Control frames that may be read now; negative if too many were read.
    control_frames: f64,
    filled: Instant,
    slowed: Option<Pin<Box<Sleep>>>,
}

impl ReadPause {
    pub(super) fn new() -> Self {
        ReadPause { untaken: None, control_frames: CONTROL_FRAMES_AT_ONCE, filled: Instant::now(), slowed: None }
    }

    /// Ready when more may be read. The caller must have registered its task by [`Gate::is_closed`].
    pub(super) fn poll(&mut self, gate: &Gate, context: &mut Context<'_>) -> Poll<()> {
        ready!(self.poll_slowed(gate, context));
        if gate.is_full() {
            let until = Instant::now() + READER_TIMEOUT;
            let pause = self.untaken.get_or_insert_with(|| Box::pin(tokio::time::sleep_until(until)));
            ready!(pause.as_mut().poll(context));
            gate.charged_bytes.store(0, Ordering::Release);
        }
        self.untaken = None;
        Poll::Ready(())
    }

    fn poll_slowed(&mut self, gate: &Gate, context: &mut Context<'_>) -> Poll<()> {
        let read = gate.control_frames.swap(0, Ordering::AcqRel);
        if read > 0 {
            let now = Instant::now();
            self.slowed = self.debt(read, now).map(|debt| Box::pin(tokio::time::sleep_until(now + debt)));
        }
        if let Some(sleep) = &mut self.slowed {
            ready!(sleep.as_mut().poll(context));
            self.slowed = None;
        }
        Poll::Ready(())
    }

    /// Counts control frames that were read. Returns the time to pause reading if they were too many.
    #[allow(clippy::cast_precision_loss)]
    fn debt(&mut self, read: usize, now: Instant) -> Option<Duration> {
        let gained = CONTROL_FRAMES_PER_S * (now - self.filled).as_secs_f64();
        self.control_frames = (self.control_frames + gained).min(CONTROL_FRAMES_AT_ONCE) - read as f64;
        self.filled = now;
        (self.control_frames < 0.0).then(|| Duration::from_secs_f64(-self.control_frames / CONTROL_FRAMES_PER_S))
    }
}

/// Why a transport closed a connection.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Cut {
    /// The name of the error code in RFC 9113.
    pub(super) reason: &'static str,
    /// The debug data of the GOAWAY frame, escaped for a log.
    pub(super) words: String,
}

/// A parser of the frame headers in one direction of a connection, as its current state.
#[derive(Debug, Default)]
pub(super) enum FrameParser {
    /// Nothing has arrived yet.
    #[default]
    Unknown,
    /// This many bytes of HTTP/2's preface have arrived.
    Preface(usize),
    /// The protocol is HTTP/1.1.
    Other,
    Head([u8; HEAD_BYTES], usize),
    Payload(usize),
    GoAway(usize, Vec<u8>),
}

/// Length of a frame's header: length (3 bytes), type, flags and stream (4).
const HEAD_BYTES: usize = 9;
const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
const DATA: u8 = 0;
const HEADERS: u8 = 1;
const GOAWAY: u8 = 7;
const CONTINUATION: u8 = 9;

/// Bytes of a GOAWAY's payload that are kept: the last stream, the error code, and the start of the debug data.
const MAX_OF_GOAWAY: usize = 8 + 64;

/// Names of the error codes, RFC 9113, section 7.
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

impl FrameParser {
    /// Creates the parser for a server's frames: a server sends no preface.
    pub(super) fn of_server() -> Self {
        FrameParser::Head([0; HEAD_BYTES], 0)
    }

    /// Returns whether the protocol is HTTP/2.
    pub(super) fn are_read(&self) -> bool {
        !matches!(self, FrameParser::Unknown | FrameParser::Preface(_) | FrameParser::Other)
    }

    /// Parses further bytes and counts their DATA and control frames at `gate`. Returns the reason if they close the
    /// connection.
    pub(super) fn pass(&mut self, mut bytes: &[u8], gate: Option<&Gate>) -> Option<Cut> {
        let mut cut = None;
        while !bytes.is_empty() {
            match self {
                FrameParser::Unknown => *self = FrameParser::Preface(0),
                FrameParser::Other => break,
                FrameParser::Preface(read) => {
                    let here = bytes.len().min(PREFACE.len() - *read);
                    if bytes[..here] != PREFACE[*read..*read + here] {
                        *self = FrameParser::Other;
                        break;
                    }
                    *read += here;
                    bytes = &bytes[here..];
                    if *read == PREFACE.len() {
                        *self = FrameParser::Head([0; HEAD_BYTES], 0);
                    }
                }
                FrameParser::Head(head, read) => {
                    let here = bytes.len().min(HEAD_BYTES - *read);
                    head[*read..*read + here].copy_from_slice(&bytes[..here]);
                    *read += here;
                    bytes = &bytes[here..];
                    if *read == HEAD_BYTES {
                        let length = usize::from(head[0]) << 16 | usize::from(head[1]) << 8 | usize::from(head[2]);
                        match (head[3], gate) {
                            (DATA, Some(gate)) => gate.given(length),
                            (HEADERS | CONTINUATION, _) | (_, None) => {}
                            (_, Some(gate)) => _ = gate.control_frames.fetch_add(1, Ordering::AcqRel),
                        }
                        *self = match (head[3], length) {
                            (_, 0) => FrameParser::Head([0; HEAD_BYTES], 0),
                            (GOAWAY, _) => FrameParser::GoAway(length, Vec::new()),
                            _ => FrameParser::Payload(length),
                        };
                    }
                }
                FrameParser::Payload(left) => {
                    let here = bytes.len().min(*left);
                    bytes = &bytes[here..];
                    *left -= here;
                    if *left == 0 {
                        *self = FrameParser::Head([0; HEAD_BYTES], 0);
                    }
                }
                FrameParser::GoAway(left, kept) => {
                    let here = bytes.len().min(*left);
                    kept.extend(&bytes[..here.min(MAX_OF_GOAWAY - kept.len())]);
                    bytes = &bytes[here..];
                    *left -= here;
                    if *left == 0 {
                        cut = parse_goaway(kept).or(cut);
                        *self = FrameParser::Head([0; HEAD_BYTES], 0);
                    }
                }
            }
        }
        cut
    }
}

/// Returns the reason in a GOAWAY's payload; `None` for an orderly end.
fn parse_goaway(payload: &[u8]) -> Option<Cut> {
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
    fn small_frames_are_charged_however_they_are_split_and_until_they_are_taken() {
        let goaway = [&[0, 0, 0, 0, 0, 0, 0, 11][..], b"too_many\x1b[2J"].concat();
        let said = [PREFACE, &frame(4, &[0; 18]), &frame(DATA, &[7; 56]), &frame(DATA, &[0; 300]), &frame(DATA, &[])];
        let said = [&said.concat()[..], &frame(GOAWAY, &goaway), &frame(DATA, &[9; 6])].concat();
        for piece in 1..said.len() {
            let (gate, mut frames) = (Gate::new(WINDOW_BYTES), FrameParser::default());
            let cuts: Vec<_> = said.chunks(piece).filter_map(|bytes| frames.pass(bytes, Some(&gate))).collect();
            assert!(frames.are_read());
            assert_eq!(charged(&gate), 200 + 250, "in pieces of {piece}");
            // A client's text is escaped before it is logged.
            assert_eq!(cuts, [Cut { reason: "ENHANCE_YOUR_CALM", words: "too_many\\u{1b}[2J".into() }]);
            gate.taken(56);
            gate.taken(300);
            gate.taken(6);
            gate.taken(6);
            assert_eq!(charged(&gate), 0);
        }
    }

    #[test]
    fn an_orderly_end_is_no_error_and_another_protocol_is_not_parsed() {
        let mut frames = FrameParser::of_server();
        assert_eq!(frames.pass(&frame(GOAWAY, &[0; 8]), None), None);
        assert_eq!(frames.pass(&frame(GOAWAY, &[0; 3]), None), None);
        let (gate, mut frames) = (Gate::new(WINDOW_BYTES), FrameParser::default());
        assert_eq!(frames.pass(b"PRI * HTTP/1.1\r\n", Some(&gate)), None);
        assert_eq!(frames.pass(&frame(DATA, &[1; 4]), Some(&gate)), None);
        assert!(!frames.are_read() && charged(&gate) == 0);
    }

    #[tokio::test]
    async fn a_portion_that_nobody_takes_stops_reading_for_a_limited_time() {
        let (gate, mut read_pause) = (Gate::new(WINDOW_BYTES), ReadPause::new());
        for _ in 0..WINDOW_BYTES / 16 / 200 + 1 {
            gate.given(56);
        }
        let begun = Instant::now();
        let passed = std::future::poll_fn(|context| read_pause.poll(&gate, context));
        passed.await;
        assert!(begun.elapsed() >= READER_TIMEOUT);
        assert_eq!(charged(&gate), 0);
        std::future::poll_fn(|context| read_pause.poll(&gate, context)).await;
    }

    #[test]
    fn control_frames_are_counted_and_read_at_a_limited_rate() {
        let (gate, mut frames, mut read_pause) = (Gate::new(WINDOW_BYTES), FrameParser::default(), ReadPause::new());
        frames.pass(PREFACE, Some(&gate));
        frames.pass(&[frame(6, &[0; 8]), frame(1, &[0; 8]), frame(DATA, &[0; 8]), frame(4, &[])].concat(), Some(&gate));
        assert_eq!(gate.control_frames.load(Ordering::Acquire), 2);
        // A third of them at once, the rest within two seconds.
        let begun = read_pause.filled;
        let mut now = begun;
        for _ in 0..30 {
            now += read_pause.debt(1000, now).unwrap_or_default();
        }
        let elapsed_s = (now - begun).as_secs_f64();
        assert!((elapsed_s - 2.0).abs() < 0.01, "{elapsed_s}");
    }
}
