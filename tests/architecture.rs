//! The rooms of the house, and which way imports go (ARCHITECTURE.md).
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::{Path, PathBuf};

/// Each room may use those before it.
const ROOMS: [&str; 17] = [
    "refusal", "limits", "lock", "priority", "ids", "memory", "budget", "scene", "texture", "sheet", "haptics",
    "surface", "session", "pace", "wire", "server", "render",
];

/// What clients may use; `link` alone drives a session.
const FOR_CLIENTS: [&str; 5] = ["refusal", "limits", "scene", "haptics", "wire"];
const FOR_LINK: [&str; 3] = ["memory", "sheet", "session"];

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
            assert!(["main", "lib", "program"].contains(&room), "{room} has no place in the house");
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

/// A module's path within the crate.
type Module = Vec<String>;

/// The module of a file. The files of vectors and of the number format are one: each names the other's trait.
fn module_of(inside: &Path) -> Module {
    let mut module: Module = inside.with_extension("").iter().map(|part| part.to_str().unwrap().to_owned()).collect();
    module.pop_if(|last| *last == "mod");
    if module == ["lib"] {
        module.clear();
    }
    merged(module)
}

fn merged(module: Module) -> Module {
    let is_vector = module.starts_with(&["sheet".into(), "lanes".into()]) || module == ["sheet", "real"];
    if is_vector { vec!["sheet".into(), "lanes".into()] } else { module }
}

/// The paths in the `use` lines of a file, without those of its tests and of modules within it.
fn used(text: &str) -> Vec<String> {
    let own = text.split("\nmod tests").next().unwrap();
    let starts = |line: &str| line.starts_with("use ") || line.starts_with("pub") && line.contains(" use ");
    let mut paths = Vec::new();
    for (at, _) in
        own.match_indices('\n').filter(|(at, _)| starts(&own[at + 1..][..own[at + 1..].find('\n').unwrap_or(0)]))
    {
        let statement: String =
            own[at + 1..].split(';').next().unwrap().split_whitespace().collect::<Vec<_>>().join(" ");
        let path = statement.split_once("use ").unwrap().1;
        match path.split_once('{') {
            Some((prefix, items)) => {
                paths.extend(items.trim_end_matches('}').split(',').map(|item| format!("{prefix}{}", item.trim())));
            }
            None => paths.push(path.to_owned()),
        }
    }
    paths
}

#[test]
fn files_make_no_circle_of_imports() {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let files: Vec<PathBuf> = rust_files(&source);
    let of_crate = |path: &PathBuf| !path.ends_with("main.rs") && !path.starts_with(source.join("program"));
    let mut imports: BTreeMap<Module, BTreeSet<Module>> = BTreeMap::new();
    let modules: BTreeSet<Module> =
        files.iter().filter(|path| of_crate(path)).map(|path| module_of(path.strip_prefix(&source).unwrap())).collect();
    for path in files.iter().filter(|path| of_crate(path)) {
        let inside = path.strip_prefix(&source).unwrap();
        let mut own: Module = inside.with_extension("").iter().map(|part| part.to_str().unwrap().to_owned()).collect();
        own.pop_if(|last| *last == "mod");
        for used in used(&std::fs::read_to_string(path).unwrap()) {
            let mut base = own.clone();
            let mut parts = used.split("::").map(str::to_owned).collect::<VecDeque<_>>();
            let first = parts[0].clone();
            let is_child = modules.contains(&[&own[..], std::slice::from_ref(&first)].concat());
            match first.as_str() {
                "crate" => base.clear(),
                "super" | "self" => {}
                _ if is_child => parts.push_front("self".into()),
                _ => continue,
            }
            while let Some(part) = parts.pop_front() {
                match part.as_str() {
                    "crate" | "self" => {}
                    "super" => _ = base.pop(),
                    _ => base.push(part),
                }
            }
            while !modules.contains(&merged(base.clone())) {
                base.pop();
            }
            let (from, to) = (module_of(inside), merged(base));
            if from != to {
                imports.entry(from).or_default().insert(to);
            }
        }
    }
    assert!(imports.len() > 100, "{} files", imports.len());
    // What imports nothing that is left is in no circle.
    loop {
        let left: BTreeSet<Module> = imports.keys().cloned().collect();
        imports.values_mut().for_each(|used| used.retain(|module| left.contains(module)));
        imports.retain(|_, used| !used.is_empty());
        if imports.len() == left.len() {
            break;
        }
    }
    let names = |module: &Module| module.join("::");
    let left: Vec<String> = imports
        .iter()
        .map(|(module, used)| {
            format!("{} uses {}", names(module), used.iter().map(names).collect::<Vec<_>>().join(", "))
        })
        .collect();
    assert!(left.is_empty(), "circles of imports, and what uses them:\n{}", left.join("\n"));
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

/// Longest first sentence of a file's documentation, characters.
const SHORT: usize = 190;

/// The first sentence of the text that a file begins with, if it begins with `//!`.
fn purpose(text: &str) -> Option<String> {
    let lines = text.lines().map_while(|line| line.strip_prefix("//!")).map(str::trim);
    let paragraph = lines.take_while(|line| !line.is_empty()).collect::<Vec<_>>().join(" ");
    let end =
        paragraph.match_indices('.').find(|(at, _)| matches!(paragraph.as_bytes().get(at + 1), None | Some(b' ')));
    end.map(|(at, _)| paragraph[..=at].to_owned())
}

#[test]
fn every_file_begins_with_what_it_is_for() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut seen = BTreeMap::new();
    for folder in ["src", "clients/src"] {
        for path in rust_files(&root.join(folder)) {
            let purpose = purpose(&std::fs::read_to_string(&path).unwrap());
            let purpose = purpose.unwrap_or_else(|| panic!("{} has no sentence after `//!`", path.display()));
            assert!(purpose.chars().count() <= SHORT, "{}: {purpose}", path.display());
            if let Some(other) = seen.insert(purpose.clone(), path.clone()) {
                panic!("{} and {} are for the same: {purpose}", path.display(), other.display());
            }
        }
    }
}
