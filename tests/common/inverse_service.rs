//! An imitation of Haply's Inverse Service: its messages, and an arm that presses and comes back without end.
#![allow(
    dead_code,
    unreachable_pub,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::disallowed_methods
)]

use std::collections::BTreeSet;
use std::f64::consts::TAU;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use glam::{DQuat, DVec3};
use serde_json::{Value, json};
use tungstenite::Message;

/// Faults of the service.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wrong {
    Nothing,
    NoDevice,
    /// The first message is invalid.
    GarbageAtFirst,
    /// No grip, and so no button.
    NoGrip,
    // The others happen while it is pressed.
    Unplugged,
    /// The message names the device, but has no place.
    Placeless,
    Killed,
    Silent,
    Garbage,
    /// A position that no arm reaches.
    Far,
    /// An orientation of zeros.
    Unturned,
}

/// The messages that it received.
#[derive(Clone, Default)]
pub struct Heard(Arc<Mutex<ServiceState>>);

#[derive(Default)]
struct ServiceState {
    forces_n: Vec<DVec3>,
    fields: BTreeSet<String>,
    profiles: Vec<String>,
}

impl Heard {
    pub fn forces_n(&self) -> Vec<DVec3> {
        self.0.lock().unwrap().forces_n.clone()
    }

    /// The names of the fields that forces came in.
    pub fn fields(&self) -> Vec<String> {
        self.0.lock().unwrap().fields.iter().cloned().collect()
    }

    pub fn profiles(&self) -> Vec<String> {
        self.0.lock().unwrap().profiles.clone()
    }

    /// Takes a message: exactly one device, and a force.
    fn take(&self, message: &Value) {
        let mut told = self.0.lock().unwrap();
        let [device] = message["inverse3"].as_array().unwrap().as_slice() else { panic!("{message}") };
        assert_eq!(device["device_id"], "049D");
        let (field, force) = device["commands"]["set_cursor_force"].as_object().unwrap().iter().next().unwrap();
        let [x, y, z] = ["x", "y", "z"].map(|part| force[part].as_f64().unwrap());
        told.fields.insert(field.clone());
        told.forces_n.push(DVec3::new(x, y, z));
        if let Some(name) = message.pointer("/session/configure/profile/name") {
            told.profiles.push(name.as_str().unwrap().to_owned());
        }
    }
}

/// The grip turns about the axis upwards, to the left and back: returns its orientation at a tick.
pub fn turn(tick: u32) -> DQuat {
    DQuat::from_rotation_z(0.5 + 0.3 * (TAU * f64::from(tick) / 3000.0).sin())
}

pub struct InverseService {
    pub url: String,
    heard: Heard,
}

impl InverseService {
    /// Starts a service of that version; with `None` it reports no version.
    pub fn start(version: Option<&'static str>, wrong: Wrong) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("ws://{}", listener.local_addr().unwrap());
        let heard = Heard::default();
        let told = heard.clone();
        // It ends with the test.
        std::thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                let told = told.clone();
                std::thread::spawn(move || serve(stream, version, wrong, &told));
            }
        });
        InverseService { url, heard }
    }

    pub fn heard(&self) -> Heard {
        self.heard.clone()
    }
}

fn serve(mut stream: TcpStream, version: Option<&str>, wrong: Wrong, told: &Heard) {
    let mut begin = [0; 12];
    loop {
        match stream.peek(&mut begin) {
            Ok(0) | Err(_) => return,
            Ok(count) if count == begin.len() => break,
            Ok(_) => std::thread::sleep(Duration::from_millis(1)),
        }
    }
    if begin == *b"GET /version" {
        let mut request = Vec::new();
        while !request.ends_with(b"\r\n\r\n") {
            let mut byte = [0];
            if stream.read(&mut byte).unwrap_or(0) == 0 {
                return;
            }
            request.extend(byte);
        }
        let answer = version.map_or("HTTP/1.1 404 Not Found\r\n\r\n".to_owned(), |version| {
            let body = json!({ "project_name": "haply-inverse-service", "project_version": version }).to_string();
            format!("HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n\r\n{body}")
        });
        let _ = stream.write_all(answer.as_bytes());
        return;
    }
    let Ok(mut socket) = tungstenite::accept(stream) else { return };
    // As in the real service, the base is the origin.
    let state = |tick: u32| {
        let z_m = 0.16 - 0.001 + 0.004 * (TAU * f64::from(tick) / 2000.0).cos();
        json!({ "cursor_position": { "x": 0.003, "y": -0.118, "z": z_m }, "cursor_velocity": { "x": 0, "y": 0, "z": 0 } })
    };
    let arms = |tick: u32| json!([{ "device_id": "049D", "state": state(tick), "status": { "ready": true } }]);
    let grips = |tick: u32| {
        let DQuat { w, x, y, z } = turn(tick);
        let buttons = json!({ "a": tick % 300 < 150, "b": false, "c": false });
        let orientation = json!({ "w": w, "x": x, "y": y, "z": z });
        json!([{ "device_id": "62", "state": { "buttons": buttons, "orientation": orientation } }])
    };
    let message = |tick: u32, has_arm: bool| {
        let mut message = json!({ "inverse3": if has_arm { arms(tick) } else { json!([]) } });
        if wrong != Wrong::NoGrip {
            message["wireless_verse_grip"] = grips(tick);
        }
        message
    };
    let mut first = message(0, wrong != Wrong::NoDevice);
    if version != Some("3.1.1") {
        first["session_id"] = json!(7);
    }
    let first = if wrong == Wrong::GarbageAtFirst { "hello".to_owned() } else { first.to_string() };
    if socket.send(Message::text(first)).is_err() {
        return;
    }
    let (mut tick, mut pressed) = (0, 0);
    while let Ok(heard) = socket.read() {
        let Message::Text(text) = heard else { continue };
        told.take(&serde_json::from_str(&text).unwrap());
        tick += 1;
        pressed += u32::from(told.0.lock().unwrap().forces_n.last().is_some_and(|force_n| force_n.z > 0.05));
        let is_wrong = pressed > 60;
        let answer = match wrong {
            Wrong::Killed if is_wrong => return,
            Wrong::Silent if is_wrong => continue,
            Wrong::Garbage if is_wrong => "{{{".to_owned(),
            Wrong::Unplugged if is_wrong => message(tick, false).to_string(),
            Wrong::Placeless if is_wrong => {
                let mut message = message(tick, true);
                message["inverse3"][0]["state"] = json!({});
                message.to_string()
            }
            Wrong::Far if is_wrong => {
                let mut message = message(tick, true);
                message["inverse3"][0]["state"]["cursor_position"]["z"] = json!(-1e9);
                message.to_string()
            }
            Wrong::Unturned if is_wrong => {
                let mut message = message(tick, true);
                message["wireless_verse_grip"][0]["state"]["orientation"] =
                    json!({ "w": 0.0, "x": 0.0, "y": 0.0, "z": 0.0 });
                message.to_string()
            }
            _ => message(tick, true).to_string(),
        };
        if socket.send(Message::text(answer)).is_err() {
            return;
        }
    }
}
