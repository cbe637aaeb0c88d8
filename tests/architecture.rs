//! The rooms of the house, and which way imports go (ARCHITECTURE.md).
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

use std::path::{Path, PathBuf};

/// Each room may use those before it.
const ROOMS: [&str; 15] = [
    "refusal", "limits", "lock", "memory", "budget", "scene", "texture", "sheet", "haptics", "surface", "session",
    "pace", "wire", "server", "render",
];

/// What clients may use; `link` alone drives a session.
const FOR_CLIENTS: [&str; 5] = ["refusal", "limits", "scene", "haptics", "wire"];
const FOR_LINK: [&str; 2] = ["sheet", "session"];

fn rust_files(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(rust_files(&path));
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            files.push(path);
        }
    }
    files
}

/// Rooms that a text names after `prefix`.
fn named<'t>(text: &'t str, prefix: &str) -> Vec<&'t str> {
    text.match_indices(prefix)
        .map(|(at, _)| {
            let rest = &text[at + prefix.len()..];
            &rest[..rest.find(|c: char| !c.is_ascii_alphanumeric() && c != '_').unwrap_or(rest.len())]
        })
        .filter(|room| !room.is_empty())
        .collect()
}

#[test]
fn imports_go_one_way_only() {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    for path in rust_files(&source) {
        let inside = path.strip_prefix(&source).unwrap();
        let room = inside.components().next().unwrap().as_os_str().to_str().unwrap().trim_end_matches(".rs");
        let Some(place) = ROOMS.iter().position(|other| *other == room) else {
            assert!(["main", "lib"].contains(&room), "{room} has no place in the house");
            continue;
        };
        let text = std::fs::read_to_string(&path).unwrap();
        for used in named(&text, "crate::") {
            let used_place = ROOMS.iter().position(|other| *other == used);
            let used_place = used_place.unwrap_or_else(|| panic!("{}: unknown room `{used}`", inside.display()));
            // Pictures are for who has no server.
            let drawn = room == "render" && ["pace", "wire", "server"].contains(&used);
            assert!(used_place <= place && !drawn, "{} uses `{used}`, which comes after `{room}`", inside.display());
        }
    }
}

#[test]
fn clients_use_scenes_haptics_and_the_wire() {
    let clients = Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/src");
    for path in rust_files(&clients) {
        let text = std::fs::read_to_string(&path).unwrap();
        for used in named(&text, "palpate::") {
            let is_link = path.components().any(|part| part.as_os_str() == "link");
            let allowed = FOR_CLIENTS.contains(&used) || is_link && FOR_LINK.contains(&used);
            assert!(allowed, "{} uses `{used}`", path.display());
        }
    }
}

#[test]
fn only_pace_reads_the_clock_and_only_the_server_opens_sockets() {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    for path in rust_files(&source) {
        let inside = path.strip_prefix(&source).unwrap().to_str().unwrap().to_owned();
        let text = std::fs::read_to_string(&path).unwrap();
        let core =
            ["scene", "render", "sheet", "haptics", "surface", "session"].iter().any(|room| inside.starts_with(room));
        if core {
            for word in ["Instant", "SystemTime", "tokio", "std::thread", "std::net", "getrandom", "HashMap"] {
                assert!(!text.contains(word), "{inside} has `{word}`");
            }
        }
        if !inside.starts_with("server") && inside != "main.rs" {
            assert!(!text.contains("TcpListener"), "{inside} opens a socket");
        }
    }
}

#[test]
fn unsafe_code_is_where_vectors_are() {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    for path in rust_files(&source) {
        let inside = path.strip_prefix(&source).unwrap().to_str().unwrap();
        let vectors = [
            // One function of the system, which any thread may call at any time.
            "budget/machine.rs",
            "sheet/lanes/mod.rs",
            "sheet/lanes/neon.rs",
            "sheet/lanes/x86.rs",
            "sheet/grid.rs",
            "sheet/sweep.rs",
            "sheet/stage.rs",
            "sheet/bench.rs",
            "sheet/advance.rs",
            "sheet/edge.rs",
            "sheet/survey.rs",
            "sheet/applied.rs",
            "surface/wide.rs",
        ];
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(!text.contains("allow(unsafe_code)") || vectors.contains(&inside), "{inside} has unsafe code");
    }
}

#[test]
fn files_fit_in_the_head() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for folder in ["src", "clients/src"] {
        for path in rust_files(&root.join(folder)) {
            let lines = std::fs::read_to_string(&path).unwrap().lines().count();
            assert!(lines <= 600, "{} has {lines} lines", path.display());
        }
    }
}
