//! The crates and modules, and which way imports go (ARCHITECTURE.md).
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

/// The crates of more than a few files, and the order of their modules: each may use those before it. `*` is all
/// others.
const MODULES: [(&str, &[&str]); 6] = [
    (
        "crates/tissue",
        &[
            "limits",
            "lock",
            "memory",
            "files",
            "shape",
            "scene",
            "stage_times",
            "saved",
            "kernel",
            "scheme",
            "body",
            "response",
            "tools",
            "audit_window",
            "interface",
            "state",
            "select",
            "compile",
        ],
    ),
    ("crates/exercise", &["*"]),
    ("crates/fitting", &["parallel", "search", "uncertainty", "*", "runs", "fit"]),
    ("crates/session", &["budget", "*", "surface", "wire", "journal"]),
    ("crates/realtime", &["priority", "ids", "*"]),
    (".", &["server", "render"]),
];

/// The crates: folder, name, the other crates that it may use, and what must not be in its tree of dependencies.
const CRATES: [(&str, &str, &[&str], &[&str]); 19] = [
    ("crates/refusal", "palpate-refusal", &[], &["axum", "clap", "prost", "tokio", "tonic"]),
    ("crates/arguments", "palpate-arguments", &["palpate-refusal"], &["prost", "tokio", "tonic"]),
    ("crates/geometry", "palpate-geometry", &[], &["axum", "clap", "prost", "tokio", "tonic"]),
    (
        "crates/exercise",
        "palpate-exercise",
        &["palpate-refusal"],
        &["axum", "clap", "prost", "serde", "tokio", "tonic"],
    ),
    ("crates/xtask", "palpate-xtask", &[], &["clap", "libc", "serde", "tokio"]),
    ("crates/haptics", "palpate-haptics", &[], &["axum", "prost", "tokio", "tonic"]),
    (
        "crates/tissue",
        "palpate-tissue",
        &["palpate-geometry", "palpate-haptics", "palpate-refusal"],
        &["axum", "clap", "gif", "mcap", "prost", "rcgen", "tokio", "tonic"],
    ),
    (
        "crates/texture",
        "palpate-texture",
        &["palpate-refusal", "palpate-tissue"],
        &["axum", "clap", "gif", "mcap", "prost", "rcgen", "tokio", "tonic"],
    ),
    (
        "proto",
        "palpate-proto",
        &["palpate-haptics", "palpate-refusal"],
        &["axum", "clap", "hyper", "protox", "tokio-rustls"],
    ),
    (
        "crates/session",
        "palpate-session",
        &[
            "palpate-exercise",
            "palpate-geometry",
            "palpate-haptics",
            "palpate-proto",
            "palpate-refusal",
            "palpate-tissue",
        ],
        &["axum", "clap", "gif", "hyper", "rcgen", "tokio-rustls"],
    ),
    (
        "crates/fitting",
        "palpate-fitting",
        &["palpate-haptics", "palpate-refusal", "palpate-session", "palpate-tissue"],
        &["axum", "clap", "gif", "hyper", "rcgen", "tokio-rustls"],
    ),
    (
        "crates/realtime",
        "palpate-realtime",
        &["palpate-haptics", "palpate-refusal", "palpate-session", "palpate-tissue"],
        &["axum", "clap", "gif", "hyper", "rcgen", "tokio-rustls"],
    ),
    (
        "crates/cluster",
        "palpate-cluster",
        &["palpate-proto", "palpate-refusal", "palpate-session", "palpate-tissue"],
        &["axum", "clap", "gif", "rcgen"],
    ),
    (
        ".",
        "palpate",
        &[
            "palpate-arguments",
            "palpate-cluster",
            "palpate-exercise",
            "palpate-fitting",
            "palpate-geometry",
            "palpate-haptics",
            "palpate-proto",
            "palpate-realtime",
            "palpate-refusal",
            "palpate-session",
            "palpate-texture",
            "palpate-tissue",
        ],
        &["indicatif"],
    ),
    (
        "clients/library",
        "palpate-client",
        &["palpate-haptics", "palpate-proto", "palpate-refusal"],
        &["axum", "clap", "indicatif", "tower-http"],
    ),
    (
        "clients/c",
        "palpate-c",
        &["palpate-client", "palpate-haptics", "palpate-proto", "palpate-refusal", "palpate-session", "palpate-tissue"],
        &["axum", "clap", "gif", "rcgen", "tonic-web", "tower-http"],
    ),
    (
        "clients/simulated",
        "palpate-simulated",
        &[
            "palpate-client",
            "palpate-geometry",
            "palpate-haptics",
            "palpate-proto",
            "palpate-refusal",
            "palpate-session",
            "palpate-tissue",
        ],
        &["axum", "clap", "indicatif", "rcgen"],
    ),
    (
        "clients/programs",
        "palpate-programs",
        &[
            "palpate-arguments",
            "palpate-client",
            "palpate-haptics",
            "palpate-proto",
            "palpate-refusal",
            "palpate-session",
            "palpate-simulated",
            "palpate-tissue",
        ],
        &["axum", "rcgen"],
    ),
    (
        "clients/python",
        "palpate-python",
        &[
            "palpate-client",
            "palpate-fitting",
            "palpate-haptics",
            "palpate-proto",
            "palpate-refusal",
            "palpate-session",
            "palpate-simulated",
            "palpate-tissue",
        ],
        &["axum", "clap", "indicatif", "rcgen"],
    ),
];

/// The subcommands: none uses another.
const SUBCOMMANDS: [&str; 12] =
    ["admin", "bridge", "cluster", "devices", "foxglove", "health", "link", "load", "play", "proxy", "replay", "top"];

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
        .filter(|module| !module.is_empty())
        .collect()
}

/// The code of a file, without comments and without the tests at its end.
fn code_of(path: &Path) -> String {
    let text = std::fs::read_to_string(path).unwrap();
    let code = text.split("\n#[cfg(test)]").next().unwrap();
    let lines: Vec<&str> = code.lines().filter(|line| !line.trim_start().starts_with("//")).collect();
    lines.join("\n")
}

/// The folder of a crate's sources.
fn source_of(folder: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(folder).join("src")
}

#[test]
fn imports_go_one_way_only() {
    for (folder, order) in MODULES {
        let source = source_of(folder);
        let place_of =
            |module: &str| order.iter().position(|other| *other == module || *other == "*" && !order.contains(&module));
        for path in rust_files(&source) {
            let (inside, own) = (path.strip_prefix(&source).unwrap(), module(&source, &path));
            if ["main", "lib", "program"].contains(&own) {
                continue;
            }
            let place = place_of(own).unwrap_or_else(|| panic!("{own} has no place in the order of {folder}"));
            if inside.ends_with("tests.rs") || inside.iter().any(|part| part == "tests") {
                continue;
            }
            for used in named(&code_of(&path), "crate::") {
                let used_place =
                    place_of(used).unwrap_or_else(|| panic!("{}: unknown module `{used}`", inside.display()));
                // Pictures are for who has no server.
                let drawn = own == "render" && used == "server";
                assert!(used_place <= place && !drawn, "{} uses `{used}`, which comes after `{own}`", inside.display());
            }
        }
    }
}

/// A module's path within the crate.
type Module = Vec<String>;

/// The module of a file.
fn module_of(inside: &Path) -> Module {
    let mut module: Module = inside.with_extension("").iter().map(|part| part.to_str().unwrap().to_owned()).collect();
    module.pop_if(|last| *last == "mod");
    if module == ["lib"] {
        module.clear();
    }
    module
}

/// The files of vectors and of the number format count as one: each names the other's trait.
fn merged(module: Module) -> Module {
    let is_vector = module.starts_with(&["kernel".into(), "lanes".into()]) || module == ["kernel", "real"];
    if is_vector { vec!["kernel".into(), "lanes".into()] } else { module }
}

/// The paths that a file uses, without those of its tests and of modules within it.
fn used(text: &str) -> Vec<String> {
    let own = text.split("\nmod tests").next().unwrap();
    let mut paths = Vec::new();
    for statement in own.split(';') {
        let starts = ["\nuse ", "\npub use ", "\npub(crate) use ", "\npub(super) use "];
        let after = starts.iter().filter_map(|start| statement.rfind(start).map(|at| at + start.len())).max();
        let Some(after) = after else { continue };
        let path: String = statement[after..].split_whitespace().collect();
        let (prefix, items) = path.split_once('{').unwrap_or((&path, ""));
        paths.extend(items.trim_end_matches('}').split(',').map(|item| format!("{prefix}{item}")));
    }
    paths
}

/// The module that a path in module `own` names, or the one that what it names is in; `None` for another crate.
fn resolved(path: &str, own: &Module, modules: &BTreeSet<Module>) -> Option<Module> {
    let mut parts = path.split("::").map(str::to_owned).peekable();
    let mut module = own.clone();
    match parts.peek()?.as_str() {
        "crate" => module.clear(),
        "super" | "self" => {}
        child if modules.contains(&[&own[..], &[child.to_owned()]].concat()) => {}
        _ => return None,
    }
    for part in parts {
        match part.as_str() {
            "crate" | "self" => {}
            "super" => _ = module.pop(),
            _ => module.push(part),
        }
    }
    while !modules.contains(&merged(module.clone())) {
        module.pop();
    }
    Some(merged(module))
}

#[test]
fn files_make_no_circle_of_imports() {
    let imports: usize = MODULES.iter().map(|(folder, _)| imports_without_circle(&source_of(folder))).sum();
    assert!(imports > 300);
}

/// Returns the number of imports among the files of a crate; panics if they form a circle.
fn imports_without_circle(source: &Path) -> usize {
    let is_program = |path: &PathBuf| path.ends_with("main.rs") || path.starts_with(source.join("program"));
    let files: Vec<(Module, String)> = rust_files(source)
        .into_iter()
        .filter(|path| !is_program(path))
        .map(|path| (module_of(path.strip_prefix(source).unwrap()), std::fs::read_to_string(&path).unwrap()))
        .collect();
    let modules: BTreeSet<Module> = files.iter().map(|file| merged(file.0.clone())).collect();
    let mut imports: BTreeMap<Module, BTreeSet<Module>> = BTreeMap::new();
    for (own, text) in &files {
        let from = merged(own.clone());
        let mut all: BTreeSet<Module> = used(text).iter().filter_map(|path| resolved(path, own, &modules)).collect();
        all.remove(&from);
        imports.entry(from).or_default().extend(all);
    }
    let count = imports.values().map(BTreeSet::len).sum();
    // A file without remaining imports is in no circle, and neither is one that no remaining file imports.
    loop {
        let left: BTreeSet<Module> = imports.keys().cloned().collect();
        let imported: BTreeSet<Module> = imports.values().flatten().cloned().collect();
        imports.values_mut().for_each(|used| used.retain(|module| left.contains(module)));
        imports.retain(|module, used| !used.is_empty() && imported.contains(module));
        if imports.len() == left.len() {
            break;
        }
    }
    let names = |module: &Module| module.join("::");
    let shown = imports.iter().map(|(from, to)| {
        let to: Vec<String> = to.iter().map(names).collect();
        format!("{} uses {}", names(from), to.join(", "))
    });
    let shown: Vec<String> = shown.collect();
    assert!(shown.is_empty(), "circles of imports:\n{}", shown.join("\n"));
    count
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

/// The crates that a crate uses, and those that they use.
fn below(name: &str) -> BTreeSet<&'static str> {
    let uses = CRATES.iter().find(|other| other.1 == name).map_or(&[][..], |found| found.2);
    uses.iter().flat_map(|&used| below(used).into_iter().chain([used])).collect()
}

#[test]
fn what_a_crate_must_not_have_is_not_in_its_tree() {
    for (_, name, _, forbidden) in CRATES {
        let below = below(name);
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
            assert!(!dependency.starts_with("palpate") || below.contains(dependency), "{name} depends on {dependency}");
        }
    }
}

/// The parts of `text` between each `by` that is not in parentheses.
fn split_outside<'t>(text: &'t str, by: &str) -> Vec<&'t str> {
    let (mut parts, mut depth, mut begin) = (Vec::new(), 0, 0);
    for (at, letter) in text.char_indices() {
        depth += i32::from(letter == '(') - i32::from(letter == ')');
        if depth == 0 && at >= begin && text[at..].starts_with(by) {
            parts.push(&text[begin..at]);
            begin = at + by.len();
        }
    }
    parts.push(&text[begin..]);
    parts
}

/// Returns whether an SPDX expression can be met by licences that are `allowed`. `AND` binds closer than `OR`, for
/// which some write `/`.
fn is_met(expression: &str, allowed: &dyn Fn(&str) -> bool) -> bool {
    let text = expression.replace('/', " OR ");
    let is_one_met = |one: &str| match one.trim().strip_prefix('(').and_then(|inner| inner.strip_suffix(')')) {
        Some(inner) => is_met(inner, allowed),
        None => allowed(one.trim()),
    };
    split_outside(&text, " OR ").into_iter().any(|part| split_outside(part, " AND ").into_iter().all(is_one_met))
}

#[test]
fn an_expression_of_licences_is_met_by_one_alternative_and_by_all_of_its_parts() {
    let allowed = |licence: &str| ["MIT", "ISC"].contains(&licence);
    for met in
        ["MIT", "GPL-3.0 OR MIT", "MIT AND ISC", "GPL-3.0/MIT", "(GPL-3.0 OR MIT) AND ISC", "GPL-3.0 AND X OR ISC"]
    {
        assert!(is_met(met, &allowed), "{met}");
    }
    for unmet in ["GPL-3.0", "MIT AND GPL-3.0", "(GPL-3.0 OR X) AND ISC", ""] {
        assert!(!is_met(unmet, &allowed), "{unmet}");
    }
}

#[test]
fn dependencies_are_those_that_deny_toml_allows() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let rules: toml::Table = std::fs::read_to_string(root.join("deny.toml")).unwrap().parse().unwrap();
    let texts = |list: &toml::Value| -> Vec<String> {
        list.as_array().unwrap().iter().map(|text| text.as_str().unwrap().to_owned()).collect()
    };
    let allowed = texts(&rules["licenses"]["allow"]);
    let exceptions: BTreeMap<String, Vec<String>> = rules["licenses"]["exceptions"]
        .as_array()
        .unwrap()
        .iter()
        .map(|one| (one["crate"].as_str().unwrap().to_owned(), texts(&one["allow"])))
        .collect();
    let banned: Vec<&str> =
        rules["bans"]["deny"].as_array().unwrap().iter().map(|one| one["crate"].as_str().unwrap()).collect();
    let tree = Command::new(env!("CARGO"))
        .args(["tree", "--locked", "--offline", "--workspace", "--all-features", "--edges", "normal,build,dev"])
        .args(["--prefix", "none", "--format", "{p}|{l}|{r}"])
        .current_dir(root)
        .output()
        .unwrap();
    assert!(tree.status.success(), "{}", String::from_utf8_lossy(&tree.stderr));
    let tree = String::from_utf8(tree.stdout).unwrap();
    let packages: BTreeSet<&str> =
        tree.lines().filter(|line| !line.is_empty() && !line.starts_with("palpate")).collect();
    assert!(packages.len() > 100, "the tree of dependencies was not read");
    for package in packages {
        let (name, licence) = package.split_once('|').unwrap();
        let licence = licence.split('|').next().unwrap().trim_end_matches(" (*)");
        let name = name.split_whitespace().next().unwrap();
        assert!(!banned.contains(&name), "{name} is banned by deny.toml");
        let is_allowed =
            |one: &str| allowed.iter().chain(exceptions.get(name).into_iter().flatten()).any(|allowed| allowed == one);
        assert!(is_met(licence, &is_allowed), "{name}: deny.toml does not allow {licence:?}");
    }
}

#[test]
fn published_crates_have_the_version_of_the_workspace_and_use_published_ones_alone() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let read = |path: PathBuf| -> toml::Table { std::fs::read_to_string(path).unwrap().parse().unwrap() };
    let workspace = read(root.join("Cargo.toml"))["workspace"].clone();
    let version = &workspace["package"]["version"];
    let mut published = BTreeSet::new();
    for (folder, name, ..) in CRATES {
        let manifest = read(root.join(folder).join("Cargo.toml"));
        if manifest["package"].get("publish").is_some() {
            assert!(workspace["dependencies"].get(name).is_none_or(|path| path.get("version").is_none()), "{name}");
            continue;
        }
        published.insert(name);
        assert_eq!(workspace["dependencies"][name].get("version"), Some(version), "{name}");
        assert!(manifest["package"]["description"].as_str().is_some_and(|text| text.len() > 20), "{name}");
        for licence in ["LICENSE-MIT", "LICENSE-APACHE"] {
            let text = |folder: &Path| std::fs::read_to_string(folder.join(licence)).unwrap();
            assert_eq!(text(&root.join(folder)), text(root), "{name}: {licence}");
        }
    }
    assert_eq!(published.len(), 5, "{published:?}");
    for (_, name, uses, _) in CRATES.iter().filter(|one| published.contains(one.1)) {
        assert!(uses.iter().all(|used| published.contains(used)), "{name} uses a crate that is not published");
    }
}

/// A version of Rust as numbers that compare: 1.89 is 1.89.0.
fn rust_version(text: &str) -> [u32; 3] {
    let mut parts =
        text.split('.').map(|part| part.parse().unwrap_or_else(|_| panic!("{text} is not a version of Rust")));
    std::array::from_fn(|_| parts.next().unwrap_or(0))
}

#[test]
fn no_dependency_needs_a_newer_rust_than_the_workspace_states() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let manifest: toml::Table = std::fs::read_to_string(root.join("Cargo.toml")).unwrap().parse().unwrap();
    let stated = manifest["workspace"]["package"]["rust-version"].as_str().unwrap();
    // All packages of Cargo.lock, also those of other systems and of optional features.
    let metadata = Command::new(env!("CARGO"))
        .args(["metadata", "--locked", "--offline", "--all-features", "--format-version", "1"])
        .current_dir(root)
        .output()
        .unwrap();
    assert!(metadata.status.success(), "{}", String::from_utf8_lossy(&metadata.stderr));
    let metadata: serde_json::Value = serde_json::from_slice(&metadata.stdout).unwrap();
    let packages = metadata["packages"].as_array().unwrap();
    let mut compared = 0;
    for package in packages {
        let (name, version) = (package["name"].as_str().unwrap(), package["version"].as_str().unwrap());
        let Some(needed) = package["rust_version"].as_str() else {
            assert!(!package["source"].is_null(), "{name} does not state its version of Rust");
            continue;
        };
        let newer = rust_version(needed) > rust_version(stated);
        assert!(
            !newer,
            "{name} {version} needs Rust {needed}, but `rust-version` is {stated}: raise it, or take an older {name}"
        );
        compared += usize::from(!package["source"].is_null());
    }
    assert!(compared > 100, "only {compared} dependencies state a version of Rust");
    // The generator of the protocol is a workspace of its own, and the guide states the same version.
    let generator = std::fs::read_to_string(root.join("proto/generator/Cargo.toml")).unwrap();
    assert!(generator.contains(&format!("rust-version = \"{stated}\"")), "proto/generator states another version");
    for guide in
        ["README.md", "CONTRIBUTING.md", "docs/platforms.md", "docs/your-language.md", "clients/python/README.md"]
    {
        let text = std::fs::read_to_string(root.join(guide)).unwrap();
        assert!(text.contains(&format!("Rust {stated}")), "{guide} does not name Rust {stated}");
    }
}

#[test]
fn the_protocol_enters_at_the_wire() {
    for (folder, may) in [("crates/session", &["wire", "journal"][..]), (".", &["server", "program"])] {
        let source = source_of(folder);
        for path in rust_files(&source) {
            let is_used = std::fs::read_to_string(&path).unwrap().contains("palpate_proto");
            assert!(may.contains(&module(&source, &path)) || !is_used, "{} uses the protocol", path.display());
        }
    }
}

#[test]
fn subcommands_do_not_use_each_other() {
    let source = source_of("clients/programs");
    for path in rust_files(&source) {
        let (text, own) = (std::fs::read_to_string(&path).unwrap(), module(&source, &path));
        for used in named(&text, "crate::") {
            assert!(used == own || !SUBCOMMANDS.contains(&used), "{} uses `{used}`", path.display());
        }
    }
}

/// Words of a grid of points.
const GRID: [&str; 5] = ["scene.sheet", "scene::Sheet", "place_of(", "GridPoint", "PointName::Point"];

#[test]
fn above_the_sheet_a_tissue_is_its_rest_shape() {
    // Also the parts of scripts that describe a tissue.
    let of_tissue = ["response/force_law/", "scene/action", "scene/profile", "scene/record", "scene/script"];
    let of_server = ["server/", "render/"];
    // The sheet's own section as a message, the name of its points, and frames, which have rows of either.
    let form = ["wire/scene.rs", "wire/mod.rs", "journal/", "surface/"];
    for (folder, above) in
        [("crates/tissue", &of_tissue[..]), ("crates/session", &[""]), ("crates/realtime", &[""]), (".", &of_server)]
    {
        let source = source_of(folder);
        for path in rust_files(&source) {
            let inside = path.strip_prefix(&source).unwrap().to_str().unwrap();
            let starts = |names: &[&str]| names.iter().any(|name| inside.starts_with(name));
            if !starts(above) || starts(&form) {
                continue;
            }
            let text = std::fs::read_to_string(&path).unwrap();
            let own = text.split("\nmod tests").next().unwrap();
            for word in GRID {
                assert!(!own.contains(word), "{inside} has `{word}`: use the shape of the model");
            }
        }
    }
}

/// Names that a pure function does not use.
const IMPURE: [&str; 7] = ["Instant", "SystemTime", "tokio", "std::thread", "std::net", "getrandom", "HashMap"];

#[test]
fn only_realtime_reads_the_clock_and_only_the_server_opens_sockets() {
    // Waits for pipes, and what calls of a server share.
    let apart = ["files.rs", "budget/"];
    for folder in ["crates/haptics", "crates/tissue", "crates/session"] {
        let source = source_of(folder);
        for path in rust_files(&source) {
            let inside = path.strip_prefix(&source).unwrap().to_str().unwrap();
            let text = std::fs::read_to_string(&path).unwrap();
            let used = IMPURE.iter().find(|word| text.contains(**word));
            assert!(used.is_none() || apart.iter().any(|name| inside.starts_with(name)), "{inside} has `{used:?}`");
        }
    }
    let source = source_of(".");
    for path in rust_files(&source) {
        let inside = path.strip_prefix(&source).unwrap().to_str().unwrap().to_owned();
        let text = std::fs::read_to_string(&path).unwrap();
        for word in IMPURE.iter().filter(|_| inside.starts_with("render")) {
            assert!(!text.contains(word), "{inside} has `{word}`");
        }
        let may = inside.starts_with("server") || inside == "main.rs";
        assert!(may || !text.contains("TcpListener"), "{inside} opens a socket");
    }
}

#[test]
fn unsafe_code_is_where_vectors_are() {
    let vectors = [
        // Functions of the system, which any thread may call at any time.
        ("crates/session", "budget/machine.rs"),
        ("crates/realtime", "priority.rs"),
        ("crates/xtask", "interrupt.rs"),
        ("crates/session", "surface/wide.rs"),
        ("crates/tissue", "kernel/lanes/mod.rs"),
        ("crates/tissue", "kernel/lanes/neon.rs"),
        ("crates/tissue", "kernel/lanes/x86.rs"),
        ("crates/tissue", "body/surface/sweep.rs"),
        ("crates/tissue", "body/surface/mesh_calibration.rs"),
        ("crates/tissue", "body/surface/pressure.rs"),
        ("crates/tissue", "body/sheet/falloff.rs"),
        ("crates/tissue", "body/solid/cut_cubes.rs"),
        ("crates/tissue", "body/solid/sweep.rs"),
        ("crates/tissue", "body/solid/tests.rs"),
        ("crates/tissue", "body/sheet/grid.rs"),
        ("crates/tissue", "body/sheet/sweep.rs"),
        ("crates/tissue", "kernel/stage.rs"),
        ("crates/tissue", "body/tables.rs"),
        ("crates/tissue", "body/advance.rs"),
        ("crates/tissue", "body/sheet/edge.rs"),
        ("crates/tissue", "state/guard/survey.rs"),
        ("crates/tissue", "body/force_field.rs"),
        ("crates/tissue", "body/spring_search.rs"),
    ];
    for (folder, ..) in CRATES.iter().filter(|of| !of.0.starts_with("clients")) {
        let source = source_of(folder);
        for path in rust_files(&source) {
            let inside = path.strip_prefix(&source).unwrap().to_str().unwrap();
            let text = std::fs::read_to_string(&path).unwrap();
            let may = vectors.contains(&(*folder, inside));
            assert!(may || !text.contains("allow(unsafe_code)"), "{folder}: {inside} has unsafe code");
        }
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

/// The names of test programs are written down, so a file that no program has is never compiled.
#[test]
fn every_file_of_tests_belongs_to_a_program() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for (package, folder) in
        [(root.to_owned(), root.join("tests")), (root.join("tests/server"), root.join("tests/server"))]
    {
        let manifest = std::fs::read_to_string(package.join("Cargo.toml")).unwrap();
        let programs: Vec<PathBuf> = manifest
            .split("path = \"")
            .skip(1)
            .filter_map(|rest| rest.split('"').next())
            .map(|path| package.join(path))
            .filter(|path| path.starts_with(&folder))
            .collect();
        assert!(programs.len() > 2 && programs.iter().all(|path| path.is_file()), "{programs:?}");
        let texts: Vec<String> = programs.iter().map(|path| std::fs::read_to_string(path).unwrap()).collect();
        for entry in std::fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            let main = path.join("main.rs");
            let (file, is_file) = if main.is_file() {
                (main, true)
            } else {
                (path.clone(), path.extension().is_some_and(|end| end == "rs"))
            };
            let module = format!("mod {};", path.file_stem().unwrap().to_string_lossy());
            let has = programs.contains(&file) || texts.iter().any(|text| text.contains(&module));
            assert!(!is_file || has, "{} belongs to no program of {}", path.display(), package.display());
        }
    }
}

#[test]
fn every_file_begins_with_what_it_is_for() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut seen = BTreeMap::new();
    for (folder, ..) in CRATES {
        for path in rust_files(&root.join(folder).join("src")) {
            let purpose = purpose(&std::fs::read_to_string(&path).unwrap());
            let purpose = purpose.unwrap_or_else(|| panic!("{} has no sentence after `//!`", path.display()));
            assert!(purpose.chars().count() <= SHORT, "{}: {purpose}", path.display());
            if let Some(other) = seen.insert(purpose.clone(), path.clone()) {
                panic!("{} and {} are for the same: {purpose}", path.display(), other.display());
            }
        }
    }
}
