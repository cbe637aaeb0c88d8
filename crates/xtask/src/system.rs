//! What a machine has for the tasks: its programs, and the parts that are built already.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::SystemTime;

use crate::execute::TaskFailure;

/// The facts on which a plan depends.
#[derive(Debug, Clone)]
pub(crate) struct System {
    /// Windows, where programs and folders have other names.
    pub(crate) is_windows: bool,
    /// The programs, as the environment names them.
    pub(crate) cargo: String,
    pub(crate) python: String,
    pub(crate) node: String,
    pub(crate) npm: String,
    /// Whether Python 3.9 with venv is there.
    pub(crate) has_python: bool,
    /// Whether Node.js 20.19 is there.
    pub(crate) has_node: bool,
    /// Whether `sh` is there.
    pub(crate) has_shell: bool,
    /// Number of cores.
    pub(crate) cores: usize,
    /// The folder of compiled files.
    pub(crate) target: String,
    /// Whether these are newer than what they are made from.
    pub(crate) has_modules: bool,
    pub(crate) has_page: bool,
    pub(crate) has_venv: bool,
}

impl System {
    /// Examines this machine, and makes the folder of the sources the current one.
    ///
    /// # Errors
    /// Returns an error if the folder of the sources does not exist any more.
    pub(crate) fn find() -> Result<Self, TaskFailure> {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let moved =
            |error| TaskFailure::Failed(format!("can't enter the folder of the sources, {}: {error}", root.display()));
        std::env::set_current_dir(&root).map_err(moved)?;
        let is_windows = cfg!(windows);
        let named = |name: &str, otherwise: &str| {
            std::env::var(name).ok().filter(|value| !value.is_empty()).unwrap_or_else(|| otherwise.to_owned())
        };
        let python = named("PYTHON", if is_windows { "python" } else { "python3" });
        let node = named("NODE", "node");
        let version = "import sys, venv, ensurepip; assert sys.version_info >= (3, 9)";
        Ok(System {
            is_windows,
            cargo: named("CARGO", "cargo"),
            has_python: runs(&python, &["-c", version]),
            has_node: runs(&node, &["-e", NODE_VERSION]),
            has_shell: runs("sh", &["-c", "exit 0"]),
            python,
            node,
            // The file without an ending is a shell script there.
            npm: named("NPM", if is_windows { "npm.cmd" } else { "npm" }),
            cores: std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
            target: named("CARGO_TARGET_DIR", "target"),
            has_modules: is_newer("clients/node_modules/.package-lock.json", &["clients/package-lock.json"]),
            has_page: is_newer("clients/viewer/dist/index.html", &PAGE_SOURCES),
            has_venv: is_newer(VENV_READY, &REQUIREMENTS),
        })
    }
}

/// Ends with 0 if Node.js is recent enough.
const NODE_VERSION: &str = "const [major, minor] = process.versions.node.split('.'); \
     process.exit(major > 20 || major == 20 && minor >= 19 ? 0 : 1)";

/// The file that exists when `target/venv` has all its packages.
pub(crate) const VENV_READY: &str = "target/venv/ready";

/// The packages of `target/venv`.
pub(crate) const REQUIREMENTS: [&str; 2] = ["tests/python/requirements.txt", "clients/python/tests/requirements.txt"];

/// Files and folders that the page is made from. Of a folder all files count, without those of its folders.
const PAGE_SOURCES: [&str; 8] = [
    "clients/node_modules/.package-lock.json",
    "clients/viewer",
    "clients/viewer/src",
    "clients/viewer/public",
    "clients/typescript",
    "clients/typescript/src",
    "proto/palpate/v1",
    "clients/package-lock.json",
];

/// Returns whether a program exists and ends with status 0. It has no input, and its output is dropped.
fn runs(program: &str, arguments: &[&str]) -> bool {
    let mut command = Command::new(program);
    command.args(arguments).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.status().is_ok_and(|status| status.success())
}

/// Returns whether a file exists and none of these sources is newer. A source that does not exist makes it outdated.
fn is_newer(file: &str, sources: &[&str]) -> bool {
    let changed = |path: &Path| fs::metadata(path).and_then(|metadata| metadata.modified()).ok();
    let Some(made) = changed(Path::new(file)) else { return false };
    sources.iter().flat_map(|source| files(Path::new(source))).all(|path| {
        let source: Option<SystemTime> = changed(&path);
        source.is_some_and(|source| source <= made)
    })
}

/// Returns the path itself, or the files in the folder that it names.
fn files(path: &Path) -> Vec<PathBuf> {
    match fs::read_dir(path) {
        Ok(entries) => entries.flatten().map(|entry| entry.path()).filter(|path| path.is_file()).collect(),
        Err(_) => vec![path.to_owned()],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_outdated_by_a_newer_source_and_by_a_missing_one() {
        let folder = std::env::temp_dir().join(format!("palpate-xtask-{}", std::process::id()));
        fs::create_dir_all(folder.join("src")).unwrap();
        let write = |name: &str, age_s: u64| {
            let file = fs::File::create(folder.join(name)).unwrap();
            file.set_modified(SystemTime::UNIX_EPOCH + std::time::Duration::from_secs(1_000_000 - age_s)).unwrap();
        };
        let path = |name: &str| folder.join(name).to_str().unwrap().to_owned();
        let (made, source, sources) = (path("made"), path("source"), path("src"));
        write("source", 20);
        write("src/a", 20);
        assert!(!is_newer(&made, &[&source]), "it does not exist");
        write("made", 10);
        assert!(is_newer(&made, &[&source, &sources]));
        write("src/b", 5);
        assert!(is_newer(&made, &[&source]));
        assert!(!is_newer(&made, &[&source, &sources]), "a file of a folder is newer");
        assert!(!is_newer(&made, &[&path("absent")]));
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn the_sources_of_the_page_exist() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        for source in PAGE_SOURCES.iter().chain(&REQUIREMENTS) {
            assert!(source.contains("node_modules") || root.join(source).exists(), "{source}");
        }
    }
}
