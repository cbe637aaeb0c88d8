//! Names and messages of others in what `palpate` prints: they act on no terminal and begin no line.
#![allow(clippy::unwrap_used)]

use std::path::Path;
use std::process::Command;
use std::sync::Arc;

use crate::common::journal_opening::opening;
use palpate_session::input::Input;
use palpate_session::journal::{JournalWriter, Opening, pb};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::{PAPER, Scene};

/// ESC, CR, LF, BEL, DEL, controls C1, controls of direction, a separator of lines.
const HOSTILE: &str = "a\x1b[2J\r\nFORGED\x07\x7f\u{9b}2J\u{85}\u{202e}\u{2066}\u{200f}\u{2028}z";

/// Returns the text of a program on both outputs.
fn printed(folder: &Path, arguments: &[&str]) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_palpate"));
    let output = command.args(arguments).current_dir(folder).output().unwrap();
    [output.stdout, output.stderr].map(|bytes| String::from_utf8(bytes).unwrap()).concat()
}

/// A program prints something of what is hostile, and nothing that acts.
fn check(folder: &Path, arguments: &[&str]) -> String {
    let text = printed(folder, arguments);
    let acts = |c: char| c != '\n' && (c.is_control() || "\u{202e}\u{2066}\u{200f}\u{2028}".contains(c));
    assert!(text.contains("FORGED"), "{arguments:?}: {text:?}");
    assert!(!text.contains(acts), "{arguments:?}: {text:?}");
    assert!(text.lines().all(|line| !line.starts_with("FORGED")), "{arguments:?}: {text:?}");
    text
}

/// A journal whose texts are all hostile.
fn journal() -> Vec<u8> {
    let limits = Limits::default();
    let scene = Scene::parse("paper", PAPER, &["sheet.points=[3, 3]".to_owned()], &limits).unwrap();
    let mut first: Arc<Model> = Model::compile(&scene, &limits).unwrap();
    // No server would take such a name.
    Arc::get_mut(&mut first).unwrap().scene.name = HOSTILE.to_owned();
    let opening = Opening { session_id: HOSTILE, owner: HOSTILE, ..opening(&first) };
    let mut writer = JournalWriter::new(&opening, 1);
    writer.input(3, &Input::Hold(HOSTILE.to_owned()));
    writer.finish(pb::Why::Drained, HOSTILE, 10, 2)
}

#[test]
fn names_in_a_journal_and_of_its_file_act_on_no_terminal() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join(HOSTILE)).unwrap();
    let [good, damaged] = ["good.1.mcap", "damaged.1.mcap"].map(|name| format!("{HOSTILE}/{name}"));
    std::fs::write(folder.path().join(&good), journal()).unwrap();
    std::fs::write(folder.path().join(&damaged), b"damaged").unwrap();
    let list = check(folder.path(), &["journal", "list", HOSTILE]);
    // The header, and a line for each file.
    assert_eq!(list.lines().count(), 3, "{list}");
    let rows: serde_json::Value =
        serde_json::from_str(&check(folder.path(), &["journal", "list", HOSTILE, "--json"])).unwrap();
    assert_eq!(rows[1]["scene"], HOSTILE);
    for more in [&[][..], &["--all"], &["--json"]] {
        check(folder.path(), &[&["journal", "show", &good], more].concat());
    }
    for act in ["show", "verify", "replay", "recover"] {
        check(folder.path(), &["journal", act, &damaged]);
    }
}

#[test]
fn names_of_files_and_in_meshes_act_on_no_terminal() {
    let folder = tempfile::tempdir().unwrap();
    let uri: String = HOSTILE.bytes().map(|byte| format!("%{byte:02x}")).collect();
    let gltf = serde_json::json!({
        "asset": { "version": "2.0" },
        "buffers": [{ "uri": uri, "byteLength": 36 }],
        "bufferViews": [{ "buffer": 0, "byteLength": 36 }],
        "accessors": [{ "bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3" }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 } }] }],
        "nodes": [{ "mesh": 0 }], "scenes": [{ "nodes": [0] }], "scene": 0,
    });
    std::fs::write(folder.path().join("named.gltf"), gltf.to_string()).unwrap();
    check(folder.path(), &["mesh", "named.gltf", "--unit", "m"]);
    check(folder.path(), &["mesh", "named.gltf", "--unit", "m", "--json"]);
    let name = format!("{HOSTILE}.obj");
    std::fs::write(folder.path().join(&name), "v 0 0 0\nv 1 0 0\nf 1 2 9\n").unwrap();
    check(folder.path(), &["mesh", &name, "--unit", "m"]);
    check(folder.path(), &["check", &format!("{HOSTILE}.toml")]);
    for arguments in [&["check", "paper", HOSTILE][..], &["run", "paper", HOSTILE], &["serve", "--scenes", HOSTILE]] {
        check(folder.path(), arguments);
    }
}
