//! The crates and modules, and which way imports go (ARCHITECTURE.md).
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Each room may use those before it.
const ROOMS: [&str; 15] = [
    "refusal",
    "limits",
    "lock",
    "memory",
    "budget",
    "scene",
    "texture",
    "sheet",
    "force_law",
    "surface",
    "session",
    "pace",
    "wire",
    "server",
    "render",
];

/// The crates: folder, name, the other crates that it may use, and what must not be in its tree of dependencies.
const CRATES: [(&str, &str, &[&str], &[&str]); 5] = [
    ("clients/touch", "palpate-touch", &[], &["axum", "prost", "tokio", "tonic"]),
    ("proto", "palpate-proto", &["palpate-touch"], &["axum", "clap", "hyper", "tokio-rustls"]),
    (".", "palpate", &["palpate-proto", "palpate-touch"], &["indicatif", "rustls-native-certs"]),
    (
        "clients/library",
        "palpate-client",
        &["palpate-proto", "palpate-touch"],
        &["axum", "clap", "indicatif", "tower-http"],
    ),
    ("clients/programs", "palpate-programs", &["palpate", "palpate-client", "palpate-proto", "palpate-touch"], &[]),
];

/// The modules of `palpate` that a module of the programs may use. `link` simulates the far end; the others read files.
const FOR_PROGRAMS: [(&str, &[&str]); 3] = [
    ("link", &["force_law", "limits", "scene", "session", "sheet"]),
    ("replay", &["limits", "scene", "wire"]),
    ("scene_file", &["limits", "scene", "wire"]),
];

/// The subcommands: none uses another.
const SUBCOMMANDS: [&str; 7] = ["admin", "bridge", "health", "link", "load", "replay", "top"];

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

/// The first folder or file within `source` on the way to `path`.
fn module<'p>(source: &Path, path: &'p Path) -> &'p str {
    let inside = path.strip_prefix(source).unwrap();
    inside.components().next().unwrap().as_os_str().to_str().unwrap().trim_end_matches(".rs")
}

#[test]
fn crates_depend_one_way_only() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for (folder, name, may_use, _) in CRATES {
        let manifest = std::fs::read_to_string(root.join(folder).join("Cargo.toml")).unwrap();
        let manifest: toml::Table = manifest.parse().unwrap();
        assert_eq!(manifest["package"]["name"].as_str(), Some(name));
        let dependencies = manifest["dependencies"].as_table().unwrap();
        for (_, other, ..) in CRATES {
            assert_eq!(dependencies.contains_key(other), may_use.contains(&other), "{name} and {other}");
        }
        for path in rust_files(&root.join(folder).join("src")) {
            let text = std::fs::read_to_string(&path).unwrap();
            // Examples in the documentation are programs of their own.
            let code: Vec<&str> = text.lines().filter(|line| !line.trim_start().starts_with("//")).collect();
            let code = code.join("\n");
            for (_, other, ..) in CRATES.iter().filter(|other| other.1 != name && !may_use.contains(&other.1)) {
                let prefix = format!("{}::", other.replace('-', "_"));
                let uses = code
                    .match_indices(&prefix)
                    .any(|(at, _)| !code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_'));
                assert!(!uses, "{} uses {other}", path.display());
            }
        }
    }
}

#[test]
fn what_a_crate_must_not_have_is_not_in_its_tree() {
    for (_, name, may_use, forbidden) in CRATES {
        let tree = Command::new(env!("CARGO"))
            .args(["tree", "--locked", "--offline", "--edges", "normal", "--prefix", "none", "--format", "{p}"])
            .args(["--package", name])
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .output()
            .unwrap();
        assert!(tree.status.success(), "{}", String::from_utf8_lossy(&tree.stderr));
        let tree = String::from_utf8(tree.stdout).unwrap();
        for dependency in tree.lines().skip(1).filter_map(|line| line.split_whitespace().next()) {
            assert!(!forbidden.contains(&dependency), "{name} depends on {dependency}");
            assert!(
                !dependency.starts_with("palpate") || may_use.contains(&dependency),
                "{name} depends on {dependency}"
            );
        }
    }
}

#[test]
fn the_protocol_enters_at_the_wire() {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    for path in rust_files(&source) {
        let text = std::fs::read_to_string(&path).unwrap();
        let may = ["wire", "server", "lib"].contains(&module(&source, &path));
        assert!(may || !text.contains("palpate_proto"), "{} uses the protocol", path.display());
    }
}

#[test]
fn programs_use_the_library_and_not_each_other() {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/programs/src");
    let allowed: BTreeMap<&str, &[&str]> = FOR_PROGRAMS.into();
    for path in rust_files(&source) {
        let (text, own) = (std::fs::read_to_string(&path).unwrap(), module(&source, &path));
        for used in named(&text, "palpate::") {
            assert!(allowed.get(own).is_some_and(|may| may.contains(&used)), "{} uses `{used}`", path.display());
        }
        for used in named(&text, "crate::") {
            assert!(used == own || !SUBCOMMANDS.contains(&used), "{} uses `{used}`", path.display());
        }
    }
}

/// What a function of its arguments has no use for.
const IMPURE: [&str; 7] = ["Instant", "SystemTime", "tokio", "std::thread", "std::net", "getrandom", "HashMap"];

#[test]
fn only_pace_reads_the_clock_and_only_the_server_opens_sockets() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for path in rust_files(&root.join("clients/touch/src")) {
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(IMPURE.iter().all(|word| !text.contains(word)), "{} is not pure", path.display());
    }
    let source = root.join("src");
    for path in rust_files(&source) {
        let inside = path.strip_prefix(&source).unwrap().to_str().unwrap().to_owned();
        let text = std::fs::read_to_string(&path).unwrap();
        let core =
            ["scene", "render", "sheet", "force_law", "surface", "session"].iter().any(|room| inside.starts_with(room));
        if core {
            for word in IMPURE {
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
            "sheet/sweep.rs",
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
    for (folder, ..) in CRATES {
        for path in rust_files(&root.join(folder).join("src")) {
            let lines = std::fs::read_to_string(&path).unwrap().lines().count();
            assert!(lines <= 600, "{} has {lines} lines", path.display());
        }
    }
}
