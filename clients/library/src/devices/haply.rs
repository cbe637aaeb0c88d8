//! Haply's Inverse3, through the Inverse Service: JSON over a WebSocket, one state for each message sent.
//!
//! The service sends its whole state when a client connects, and after that one state per message. So each tick sends
//! a force, and reads what has arrived since, without waiting for it. Positions are in metres from the device's base,
//! x to the right, y forward and z up. Since version 3.5 the force is in the field `vector`, before that in `values`.
//!
//! The orientation is that of the first grip that reports one: a quaternion, which we take to turn vectors of the grip into the
//! device's base. That direction, and the grip's own axes, were not checked on a device.

use std::f64::consts::FRAC_1_SQRT_2;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};

use glam::{DQuat, DVec3};
use palpate_haptics::device::UNDECLARED;
use palpate_haptics::{Device, Wrench};
use serde_json::{Map, Value, json};
use tungstenite::protocol::WebSocketConfig;
use tungstenite::{Message, WebSocket};

use crate::device::{HapticDevice, Reading};

/// Default address of the service.
const ADDRESS: &str = "ws://localhost:10001";

/// Time limit for each answer of the service while connecting.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(2);

/// Time without an answer after which the service counts as stopped, and time without a position after which the
/// device counts as unplugged.
const SILENCE: Duration = Duration::from_millis(500);

/// Time without an answer after which the force is set to zero, since the position is not known.
const STALE: Duration = Duration::from_millis(50);

/// Limit on unanswered messages: a service that falls behind is sent no more.
const UNANSWERED: u32 = 4;

/// Limit on the bytes of a message.
const MAX_BYTES: usize = 1 << 20;

/// The supported versions of the service: from the first, below the last.
const VERSIONS: [(u32, u32); 2] = [(3, 1), (4, 0)];

/// The version since which a force is a `vector`.
const VECTOR_SINCE: (u32, u32) = (3, 5);

/// From an instrument, which points along x, to the grip, which we take to point forward while it is not turned.
const HANDLE: DQuat = DQuat::from_xyzw(0.0, 0.0, FRAC_1_SQRT_2, FRAC_1_SQRT_2);

/// Smallest and largest length of a quaternion that counts as an orientation: it is rounded, but neither zero nor something else.
const QUATERNION_LENGTH: [f64; 2] = [0.99, 1.01];

/// Approximate middle of the workspace, m from the base; not measured on a device.
const MIDDLE_M: DVec3 = DVec3::new(0.0, -0.12, 0.16);

/// An open Inverse3.
pub(super) struct Inverse3 {
    socket: WebSocket<TcpStream>,
    id: String,
    /// The name of the field of a force.
    field: &'static str,
    place_m: DVec3,
    buttons: u32,
    grip: Grip,
    unanswered: u32,
    /// When the service last answered, and when it last reported the device's position.
    heard: Instant,
    told: Instant,
    /// Whether the newest message reports the position.
    is_told: bool,
    /// The force that was sent last, N.
    sent_n: DVec3,
}

/// What is known of the orientation of the grip.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
enum Grip {
    /// No grip has reported one: the instrument is not turned.
    #[default]
    Unknown,
    /// The last valid one, and when it came. After an invalid one, or without a grip, it grows old.
    Told { turn: DQuat, at: Instant },
    /// No report has been valid yet, since then.
    Invalid { since: Instant },
}

impl Grip {
    /// Applies a message that has arrived `now`. One without a grip, or with an invalid orientation, changes no valid one.
    fn take(&mut self, message: &Value, now: Instant) {
        match (orientation(message), &self) {
            (Some(Ok(turn)), _) => *self = Grip::Told { turn, at: now },
            (Some(Err(_)), Grip::Unknown) => *self = Grip::Invalid { since: now },
            _ => {}
        }
    }

    /// Returns for how long it has not been known at `now`, although a grip reports orientations.
    fn lost(&self, now: Instant) -> Duration {
        match self {
            Grip::Unknown => Duration::ZERO,
            Grip::Told { at: since, .. } | Grip::Invalid { since } => now.saturating_duration_since(*since),
        }
    }
}

/// Returns host and port of an address.
fn host_of(address: &str) -> io::Result<&str> {
    let host = address.strip_prefix("ws://").map(|rest| rest.split('/').next().unwrap_or(rest));
    host.filter(|host| host.contains(':')).ok_or_else(|| {
        let message = format!("haply:{address}: an address is like {ADDRESS}");
        io::Error::new(ErrorKind::InvalidInput, message)
    })
}

/// Connects, with a time limit for every answer.
fn connect(host: &str) -> io::Result<TcpStream> {
    let mut last = io::Error::new(ErrorKind::NotFound, "no address");
    for address in host.to_socket_addrs()? {
        match TcpStream::connect_timeout(&address, ANSWER_TIMEOUT) {
            Ok(stream) => {
                stream.set_nodelay(true)?;
                stream.set_read_timeout(Some(ANSWER_TIMEOUT))?;
                stream.set_write_timeout(Some(ANSWER_TIMEOUT))?;
                return Ok(stream);
            }
            Err(error) => last = error,
        }
    }
    Err(last)
}

fn missing(host: &str, error: &io::Error) -> io::Error {
    let message =
        format!("Haply's Inverse Service does not answer at {host}: {error}. Start it, or Haply Hub, which has it");
    io::Error::new(ErrorKind::NotFound, message)
}

/// Requests the service's version by HTTP at its port; `None` if it reports none.
fn version(host: &str) -> io::Result<Option<String>> {
    let mut stream = connect(host).map_err(|error| missing(host, &error))?;
    let request = format!("GET /version HTTP/1.0\r\nHost: {host}\r\nAccept: application/json\r\n\r\n");
    stream.write_all(request.as_bytes())?;
    let mut answer = Vec::new();
    // A service that keeps the connection open, or resets it, has answered all the same.
    let _ = stream.take(1 << 16).read_to_end(&mut answer);
    let answer = String::from_utf8_lossy(&answer);
    let body = answer.split_once("\r\n\r\n").map_or("", |parts| parts.1);
    let told = serde_json::from_str::<Value>(body.trim()).ok();
    Ok(told.and_then(|told| Some(told.get("project_version")?.as_str()?.to_owned())))
}

/// Parses the first two numbers of a version.
fn numbers(version: &str) -> Option<(u32, u32)> {
    let mut parts = version.trim_start_matches('v').split(|c: char| !c.is_ascii_digit());
    Some((parts.next()?.parse().ok()?, parts.next().and_then(|part| part.parse().ok()).unwrap_or(0)))
}

/// Returns the name of the field of a force: by the service's version, or by its first message if it reports none.
fn field(version: Option<&str>, first: &Value) -> io::Result<&'static str> {
    let known = match version.and_then(numbers) {
        Some(numbers) if numbers < VERSIONS[0] || numbers >= VERSIONS[1] => {
            let version = version.unwrap_or_default();
            let message = format!("Haply's Inverse Service is of version {version}: Palpate knows 3.1 up to 3.x");
            return Err(io::Error::new(ErrorKind::Unsupported, message));
        }
        Some(numbers) => numbers >= VECTOR_SINCE,
        // Since that version the first message contains a number of the session.
        None => first.get("session_id").is_some(),
    };
    Ok(if known { "vector" } else { "values" })
}

/// Returns the devices of a kind in a message.
fn devices<'v>(message: &'v Value, kind: &str) -> impl Iterator<Item = &'v Value> {
    message.get(kind).and_then(Value::as_array).into_iter().flatten()
}

fn id_of(device: &Value) -> Option<&str> {
    device.get("device_id").and_then(Value::as_str)
}

/// Parses a vector of a message.
fn vector(value: &Value) -> Option<DVec3> {
    let part = |name: &str| value.get(name).and_then(Value::as_f64);
    Some(DVec3::new(part("x")?, part("y")?, part("z")?))
}

/// Returns the grips in a message: wireless ones first.
fn grips(message: &Value) -> impl Iterator<Item = &Value> {
    devices(message, "wireless_verse_grip").chain(devices(message, "verse_grip"))
}

/// Returns the orientation of the first grip in a message that has that field, of length 1; as an error the field as it is, if it is
/// no orientation: not four finite numbers, or not of length 1.
fn orientation(message: &Value) -> Option<Result<DQuat, &Value>> {
    let told = grips(message).find_map(|grip| grip.get("state")?.get("orientation"))?;
    let part = |name: &str| told.get(name).and_then(Value::as_f64);
    let turn = || Some(DQuat::from_xyzw(part("x")?, part("y")?, part("z")?, part("w")?));
    // What is not finite has no such length.
    let [least, most] = QUATERNION_LENGTH;
    let turn = turn().filter(|turn| (least..=most).contains(&turn.length()));
    Some(turn.map(DQuat::normalize).ok_or(told))
}

/// Returns the buttons in a message, if it contains any: those of a wireless grip, or the one of a wired grip.
fn buttons(message: &Value) -> Option<u32> {
    let pressed = |state: &Value, name: &str| state.get(name).and_then(Value::as_bool);
    let wireless = devices(message, "wireless_verse_grip").filter_map(|grip| {
        let buttons = grip.get("state")?.get("buttons")?;
        Some(
            ["a", "b", "c"]
                .iter()
                .enumerate()
                .map(|(bit, name)| u32::from(pressed(buttons, name) == Some(true)) << bit)
                .sum(),
        )
    });
    let wired =
        devices(message, "verse_grip").filter_map(|grip| Some(u32::from(pressed(grip.get("state")?, "button")?)));
    wireless.chain(wired).reduce(|all: u32, one| all | one)
}

/// Parses the state in a message; `None` for control messages of the WebSocket.
fn state(message: &Message) -> io::Result<Option<Value>> {
    let text = match message {
        Message::Text(text) => text,
        Message::Binary(_) => return Err(garbage("binary data")),
        _ => return Ok(None),
    };
    let told = serde_json::from_str(text).ok().filter(Value::is_object);
    told.map(Some).ok_or_else(|| garbage(text))
}

fn garbage(text: &str) -> io::Error {
    let shown: String = text.chars().take(60).collect();
    io::Error::new(
        ErrorKind::InvalidData,
        format!("Haply's Inverse Service sent something other than a state: `{shown}`"),
    )
}

fn broken(error: &tungstenite::Error) -> io::Error {
    io::Error::new(ErrorKind::NotConnected, format!("Haply's Inverse Service is gone: {error}"))
}

/// Returns whether an error means that nothing has arrived yet.
fn waits(error: &tungstenite::Error) -> bool {
    matches!(error, tungstenite::Error::Io(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut))
}

/// Connects to a service. Returns the connection, its first message, and the name of the field of a force.
fn begin(address: &str) -> io::Result<(WebSocket<TcpStream>, Value, &'static str)> {
    let host = host_of(address)?;
    let version = version(host)?;
    // Checked before anything is sent in the format of an unsupported version.
    field(version.as_deref(), &Value::Null)?;
    let stream = connect(host).map_err(|error| missing(host, &error))?;
    let bounds = WebSocketConfig::default().max_message_size(Some(MAX_BYTES)).max_frame_size(Some(MAX_BYTES));
    let (mut socket, _) = tungstenite::client::client_with_config(format!("ws://{host}/"), stream, Some(bounds))
        .map_err(|error| missing(host, &io::Error::other(error.to_string())))?;
    let first = loop {
        match socket.read() {
            Ok(message) => {
                if let Some(told) = state(&message)? {
                    break told;
                }
            }
            Err(error) if waits(&error) => {
                return Err(missing(host, &io::Error::new(ErrorKind::TimedOut, "it says nothing")));
            }
            Err(error) => return Err(broken(&error)),
        }
    };
    let field = field(version.as_deref(), &first)?;
    Ok((socket, first, field))
}

impl Inverse3 {
    /// Opens the first Inverse3 of the service at an address.
    ///
    /// # Errors
    /// Returns an error if the service or the device is missing, or the service has another version.
    pub(super) fn open(which: Option<&str>) -> io::Result<Self> {
        let (socket, first, field) = begin(which.unwrap_or(ADDRESS))?;
        let id = devices(&first, "inverse3").find_map(id_of).ok_or_else(|| {
            let message = "Haply's Inverse Service has no Inverse3: is it plugged in and on?";
            io::Error::new(ErrorKind::NotFound, message)
        })?;
        let id = id.to_owned();
        socket.get_ref().set_nonblocking(true)?;
        let now = Instant::now();
        let mut device = Inverse3 {
            socket,
            id,
            field,
            place_m: DVec3::ZERO,
            buttons: 0,
            grip: Grip::default(),
            unanswered: 0,
            heard: now,
            told: now,
            is_told: false,
            sent_n: DVec3::ZERO,
        };
        device.take(&first);
        device.send(DVec3::ZERO, true)?;
        Ok(device)
    }

    /// Applies a message. Values that it does not contain stay as they are.
    fn take(&mut self, message: &Value) {
        let ours = devices(message, "inverse3").find(|device| id_of(device) == Some(&self.id));
        let place_m = ours.and_then(|ours| vector(ours.get("state")?.get("cursor_position")?));
        self.is_told = place_m.is_some();
        if let Some(place_m) = place_m {
            (self.told, self.place_m) = (Instant::now(), place_m - MIDDLE_M);
        }
        if let Some(buttons) = buttons(message) {
            self.buttons = buttons;
        }
        self.grip.take(message, Instant::now());
    }

    /// Sends a force, N; the first message also contains the name of this program.
    fn send(&mut self, force_n: DVec3, is_first: bool) -> io::Result<()> {
        let DVec3 { x, y, z } = force_n;
        let mut command = Map::new();
        command.insert(self.field.to_owned(), json!({ "x": x, "y": y, "z": z }));
        let mut message =
            json!({ "inverse3": [{ "device_id": self.id, "commands": { "set_cursor_force": command } }] });
        if is_first && self.field == "vector" {
            message["session"] = json!({ "configure": { "profile": { "name": "palpate" } } });
        }
        match self.socket.send(Message::text(message.to_string())) {
            // What does not fit now is sent with the next message.
            Err(error) if !waits(&error) => Err(broken(&error)),
            _ => {
                if self.unanswered == 0 {
                    self.heard = Instant::now();
                }
                self.unanswered += 1;
                self.sent_n = force_n;
                Ok(())
            }
        }
    }
}

impl HapticDevice for Inverse3 {
    fn descriptor(&self) -> Device {
        Device::named("inverse3").unwrap_or(UNDECLARED)
    }

    fn read(&mut self) -> io::Result<Reading> {
        loop {
            match self.socket.read() {
                Ok(message) => {
                    if let Some(told) = state(&message)? {
                        self.heard = Instant::now();
                        self.unanswered = self.unanswered.saturating_sub(1);
                        self.take(&told);
                    }
                }
                Err(error) if waits(&error) => break,
                Err(error) => return Err(broken(&error)),
            }
        }
        let gone = |message: &str| Err(io::Error::new(ErrorKind::NotConnected, message.to_owned()));
        if self.unanswered > 0 && self.heard.elapsed() > SILENCE {
            return gone("Haply's Inverse Service does not answer any more");
        }
        if !self.is_told && self.told.elapsed() > SILENCE {
            return gone("Haply's Inverse Service does not tell where the Inverse3 is any more: is it unplugged?");
        }
        Ok(Reading { place_m: self.place_m, enable: self.buttons & 1 != 0 })
    }

    fn write(&mut self, force_n: DVec3) -> io::Result<()> {
        let is_lost = !self.is_told && self.told.elapsed() > STALE;
        let is_stale = is_lost || self.unanswered > 0 && self.heard.elapsed() > STALE;
        let force_n = if is_stale { DVec3::ZERO } else { force_n };
        // A force of zero is sent even to a service that is behind.
        let must = force_n == DVec3::ZERO && self.sent_n != DVec3::ZERO;
        if self.unanswered < UNANSWERED || must { self.send(force_n, false) } else { Ok(()) }
    }

    fn orientation(&self) -> DQuat {
        match self.grip {
            Grip::Told { turn, .. } => turn * HANDLE,
            Grip::Unknown | Grip::Invalid { .. } => DQuat::IDENTITY,
        }
    }

    /// Writes the force: the grip has no motors. An instrument whose orientation is not known gets no force, and after a while the
    /// touch ends; a single tip does not depend on it.
    fn write_wrench(&mut self, wrench: Wrench) -> io::Result<()> {
        let lost = self.grip.lost(Instant::now());
        if lost > SILENCE {
            let message = "Haply's Inverse Service reports no valid orientation of the grip (`state.orientation`: a quaternion w, \
                x, y, z of length 1): is the grip on?";
            return Err(io::Error::new(ErrorKind::NotConnected, message));
        }
        self.write(if lost > STALE { DVec3::ZERO } else { wrench.force_n })
    }

    fn buttons(&self) -> u32 {
        self.buttons
    }

    fn button_count(&self) -> u32 {
        3
    }
}

impl Drop for Inverse3 {
    fn drop(&mut self) {
        // Sent once more, this time waiting for room.
        let _ = self.socket.get_ref().set_nonblocking(false);
        let _ = self.socket.get_ref().set_write_timeout(Some(SILENCE));
        let _ = self.send(DVec3::ZERO, false);
        let _ = self.socket.close(None);
        let _ = self.socket.flush();
    }
}

/// Returns whether there is an Inverse3, and a description.
///
/// # Errors
/// Returns an error if the service does not answer or has another version.
pub(super) fn tell() -> io::Result<(bool, String)> {
    let (_socket, first, field) = begin(ADDRESS)?;
    let ids: Vec<&str> = devices(&first, "inverse3").filter_map(id_of).collect();
    Ok((!ids.is_empty(), format!("Inverse Service (forces as `{field}`): {} Inverse3 {}", ids.len(), ids.join(", "))))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn the_spelling_of_a_force_follows_the_version() {
        let (old, new) = (json!({ "inverse3": [] }), json!({ "session_id": 7, "inverse3": [] }));
        for (version, first, expected) in [
            (Some("3.1.1"), &old, "values"),
            (Some("3.4.9"), &new, "values"),
            (Some("3.5.0"), &old, "vector"),
            (Some("v3.10"), &old, "vector"),
            (None, &old, "values"),
            (None, &new, "vector"),
            (Some("develop"), &new, "vector"),
        ] {
            assert_eq!(field(version, first).unwrap(), expected, "{version:?}");
        }
        for version in ["3.0.7", "2.9", "4.0.0"] {
            let said = field(Some(version), &new).unwrap_err().to_string();
            assert!(said.contains(version) && said.contains("3.1"), "{said}");
        }
    }

    #[test]
    fn buttons_are_those_of_whichever_grip_there_is() {
        let wireless =
            |a, b| json!({ "wireless_verse_grip": [{ "state": { "buttons": { "a": a, "b": b, "c": false } } }] });
        assert_eq!(buttons(&wireless(true, false)), Some(1));
        assert_eq!(buttons(&wireless(false, true)), Some(2));
        assert_eq!(buttons(&json!({ "verse_grip": [{ "state": { "button": true } }] })), Some(1));
        assert_eq!(buttons(&json!({ "inverse3": [], "verse_grip": [] })), None);
        assert_eq!(buttons(&json!({ "wireless_verse_grip": 3 })), None);
    }

    #[test]
    fn the_orientation_is_that_of_the_first_grip_that_reports_a_valid_one() {
        let grip = |w: f64, x: f64| json!([{ "state": { "orientation": { "w": w, "x": x, "y": 0.0, "z": 0.0 } } }]);
        let turned = DQuat::from_xyzw(0.8, 0.0, 0.0, 0.6);
        let wired = json!({ "wireless_verse_grip": [{ "state": {} }], "verse_grip": grip(0.6, 0.8) });
        let told = orientation(&wired).unwrap().unwrap();
        assert!(told.angle_between(turned) < 1e-6 && (told.length() - 1.0).abs() < 1e-15, "{told}");
        let both = json!({ "verse_grip": grip(0.6, 0.8), "wireless_verse_grip": grip(1.0, 0.0) });
        assert_eq!(orientation(&both), Some(Ok(DQuat::IDENTITY)));
        for nothing in [json!({}), json!({ "verse_grip": [] }), json!({ "verse_grip": [{ "state": 3 }] })] {
            assert_eq!(orientation(&nothing), None);
        }
        let wrong = |told: Value| json!({ "verse_grip": [{ "state": { "orientation": told } }] });
        let wrong = [
            json!({ "verse_grip": grip(0.0, 0.0) }),
            json!({ "verse_grip": grip(1e200, 1e300) }),
            json!({ "verse_grip": grip(f64::NAN, 0.0) }),
            wrong(json!({ "w": 1.0, "x": 0.0, "y": 0.0 })),
            wrong(Value::Null),
            wrong(json!([1, 0, 0, 0])),
        ];
        let now = Instant::now();
        let later = now + Duration::from_millis(70);
        let mut known = Grip::default();
        known.take(&both, now);
        for wrong in &wrong {
            assert!(orientation(wrong).unwrap().is_err(), "{wrong}");
            // The last valid one stays, and grows old.
            let mut grip = known;
            grip.take(wrong, later);
            assert_eq!((grip, grip.lost(later)), (known, later - now));
            let mut grip = Grip::default();
            grip.take(wrong, now);
            grip.take(wrong, later);
            assert_eq!(grip.lost(later), later - now);
            grip.take(&both, later);
            assert_eq!(grip.lost(later), Duration::ZERO);
        }
        // A device without a grip is not turned, which is no fault.
        let mut none = Grip::default();
        none.take(&json!({ "inverse3": [] }), now);
        assert_eq!(none.lost(later), Duration::ZERO);
    }

    #[test]
    fn an_address_needs_a_host_and_a_port() {
        assert_eq!(host_of("ws://localhost:10001/x").unwrap(), "localhost:10001");
        for wrong in ["localhost:10001", "http://localhost:10001", "ws://localhost", ""] {
            assert!(host_of(wrong).is_err(), "{wrong}");
        }
    }
}
