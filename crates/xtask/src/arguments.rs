//! The command line of `cargo xtask`: its tasks, their options, and the help.

/// What a command line asks for.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum CommandLine {
    /// To print this text.
    Help(&'static str),
    /// To do a task, or only to print its commands.
    ProjectTask { task: ProjectTask, only_plan: bool },
}

/// A task, with its options.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum ProjectTask {
    /// Builds, serves, plays the script, and serves on.
    Run { listen: String, script: String },
    /// Runs these parts of the tests.
    Test(Vec<TestPart>),
    /// Checks formatting, and the warnings of all compilers.
    Lint,
    /// Builds the page.
    Page,
}

/// A part of the tests.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum TestPart {
    Viewer,
    Python,
    Protocol,
    Rust,
    Abi,
    Documents,
}

/// The parts of the tests by their names.
pub(crate) const PARTS: [(&str, TestPart); 6] = [
    ("viewer", TestPart::Viewer),
    ("python", TestPart::Python),
    ("protocol", TestPart::Protocol),
    ("rust", TestPart::Rust),
    ("abi", TestPart::Abi),
    ("documents", TestPart::Documents),
];

const DEFAULT_LISTEN: &str = "127.0.0.1:7117";
const DEFAULT_SCRIPT: &str = "scripts/press.toml";

const HELP: &str = "\
Builds, tests and shows Palpate from its sources. It works on Linux, macOS and Windows, without make or a shell.

Usage: cargo xtask TASK [OPTION…]

Tasks:
  run     build, serve, poke the tissue, plot the force on the tool, and serve a browser until Ctrl-C
  test    run every test, or some parts: cargo xtask test viewer rust
  lint    check the formatting, the warnings of all compilers, and the counts of tests/counts.py
  page    build the page that shows the tissue, clients/viewer/dist

Options of every task:
  --plan  print the commands of the task, and run none
  --help  explain the task

Examples:
  cargo xtask run
  cargo xtask run --listen 127.0.0.1:0
  cargo xtask test --plan

The variables PYTHON, NODE and NPM name other programs, CARGO_TARGET_DIR another folder of compiled files. Start it in the
folder of the sources, or in one below it.

Exit status: 0 done; 1 a command failed; 2 the arguments are wrong; 3 a program or library that the task needs is missing.";

const HELP_OF_RUN: &str = "\
Builds server and client, and the page if Node.js 20.19 or later is there; starts the server; presses the tissue with a
fingertip; plots the force on the tool; and serves until Ctrl-C. It prints the address to open in a browser.

Usage: cargo xtask run [--listen ADDRESS:PORT] [--script FILE] [--plan]

  --listen ADDRESS:PORT  where to serve; port 0 takes a free one [default: 127.0.0.1:7117]
  --script FILE          what to play [default: scripts/press.toml]
  --plan                 print the commands, and run none

The records of the poke are in target/poke.jsonl. The first run compiles for about five minutes on two cores, later ones
take seconds. Without Node.js there is no page; gRPC is served all the same. A second Ctrl-C ends the server at once.

Exit status: 0 the server was ended; 1 a command failed; 2 the arguments are wrong.";

const HELP_OF_TEST: &str = "\
Runs the tests in their short form, all or those of some parts. It stops at the first part that fails.

Usage: cargo xtask test [PART…] [--plan]

Parts:
  viewer     the page in a browser, and the package for TypeScript (Node.js 20.19, Chromium)
  python     the package for Python, installed with pip in target/venv (Python 3.9)
  protocol   is proto/generated that of the protocol?
  rust       all tests of Rust
  abi        the interface of libpalpate, compared with the stored one (a POSIX shell and abidiff)
  documents  the commands and programs in README and guide (Python 3.9)

  --plan     print the commands, and run none

On a system without a POSIX shell, `test` alone leaves out `abi` and says so. docs/tests.md lists the longer forms.

Exit status: 0 all passed; 1 a command failed; 2 the arguments are wrong; 3 a program that the parts need is missing.";

const HELP_OF_LINT: &str = "\
Checks the formatting of Rust, counts what the rules of the code forbid (tests/counts.py), and asks clippy, the TypeScript
compiler and ESLint for warnings. Any finding is a failure.

Usage: cargo xtask lint [--plan]

  --plan  print the commands, and run none

It needs Python 3.9 and Node.js 20.19.

Exit status: 0 nothing found; 1 something found; 2 the arguments are wrong; 3 a program is missing.";

const HELP_OF_PAGE: &str = "\
Builds the page that shows the tissue, clients/viewer/dist, if its sources have changed. npm installs what it needs first.

Usage: cargo xtask page [--plan]

  --plan  print the commands, and run none

Exit status: 0 the page is there; 1 a command failed; 2 the arguments are wrong; 3 Node.js 20.19 is missing.";

/// Reads the arguments after the program's name.
///
/// # Errors
/// Returns the reason why they are refused.
pub(crate) fn read(arguments: &[String]) -> Result<CommandLine, String> {
    let mut words = arguments.iter().map(String::as_str);
    let (task, help) = match words.next() {
        None | Some("--help" | "-h" | "help") => return Ok(CommandLine::Help(HELP)),
        Some("run") => {
            (ProjectTask::Run { listen: DEFAULT_LISTEN.to_owned(), script: DEFAULT_SCRIPT.to_owned() }, HELP_OF_RUN)
        }
        Some("test") => (ProjectTask::Test(Vec::new()), HELP_OF_TEST),
        Some("lint") => (ProjectTask::Lint, HELP_OF_LINT),
        Some("page") => (ProjectTask::Page, HELP_OF_PAGE),
        Some(other) => return Err(format!("there is no task `{other}`; there are run, test, lint and page")),
    };
    let (mut task, mut only_plan) = (task, false);
    while let Some(word) = words.next() {
        let (option, attached) = match word.split_once('=') {
            Some((option, value)) if option.starts_with("--") => (option, Some(value)),
            _ => (word, None),
        };
        match (&mut task, option) {
            (_, "--help" | "-h") => return Ok(CommandLine::Help(help)),
            (_, "--plan") => only_plan = true,
            (ProjectTask::Run { listen: value, .. }, "--listen")
            | (ProjectTask::Run { script: value, .. }, "--script") => {
                let given = attached.or_else(|| words.next()).filter(|given| !given.is_empty());
                given.ok_or_else(|| format!("{option}: its value is missing"))?.clone_into(value);
            }
            (ProjectTask::Test(parts), name) => parts.push(part(name)?),
            (_, unknown) => return Err(format!("unknown argument `{unknown}`; --help lists those of the task")),
        }
    }
    Ok(CommandLine::ProjectTask { task, only_plan })
}

fn part(name: &str) -> Result<TestPart, String> {
    PARTS.iter().find(|(known, _)| *known == name).map(|(_, part)| *part).ok_or_else(|| {
        let names: Vec<&str> = PARTS.iter().map(|(known, _)| *known).collect();
        format!("the tests have no part `{name}`; the parts are {}", names.join(", "))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read_line(line: &str) -> Result<CommandLine, String> {
        let words: Vec<String> = line.split_whitespace().map(str::to_owned).collect();
        read(&words)
    }

    fn task(line: &str) -> ProjectTask {
        match read_line(line) {
            Ok(CommandLine::ProjectTask { task, .. }) => task,
            other => panic!("{line}: {other:?}"),
        }
    }

    #[test]
    fn a_task_has_the_documented_defaults_and_takes_its_options_in_both_forms() {
        let run =
            |listen: &str, script: &str| ProjectTask::Run { listen: listen.to_owned(), script: script.to_owned() };
        assert_eq!(task("run"), run("127.0.0.1:7117", "scripts/press.toml"));
        assert_eq!(task("run --listen 127.0.0.1:0"), run("127.0.0.1:0", "scripts/press.toml"));
        assert_eq!(task("run --script=a.toml --listen=[::1]:1"), run("[::1]:1", "a.toml"));
        assert_eq!(task("test"), ProjectTask::Test(vec![]));
        assert_eq!(task("test rust viewer"), ProjectTask::Test(vec![TestPart::Rust, TestPart::Viewer]));
        assert!(matches!(
            read_line("lint --plan"),
            Ok(CommandLine::ProjectTask { task: ProjectTask::Lint, only_plan: true })
        ));
        assert!(matches!(
            read_line("page"),
            Ok(CommandLine::ProjectTask { task: ProjectTask::Page, only_plan: false })
        ));
    }

    #[test]
    fn what_is_wrong_is_named() {
        for (line, told) in [
            ("walk", "there is no task `walk`; there are run, test, lint and page"),
            ("run --listen", "--listen: its value is missing"),
            ("run --script=", "--script: its value is missing"),
            ("run --port 1", "unknown argument `--port`"),
            ("lint --listen 1", "unknown argument `--listen`"),
            ("test c", "no part `c`; the parts are viewer, python, protocol, rust, abi, documents"),
        ] {
            let message = read_line(line).unwrap_err();
            assert!(message.contains(told), "{line}: {message}");
        }
    }

    #[test]
    fn help_explains_every_task_and_part_and_fits_into_a_terminal() {
        let help = |line: &str| match read_line(line) {
            Ok(CommandLine::Help(text)) => text,
            other => panic!("{line}: {other:?}"),
        };
        for line in ["", "help", "--help", "run --help", "test -h", "lint --plan --help", "page --help"] {
            let text = help(line);
            assert!(text.contains("Usage: ") && text.contains("Exit status: 0"), "{line}: {text}");
            assert!(text.lines().all(|line| line.chars().count() <= 124), "{line}: {text}");
        }
        for name in ["run", "test", "lint", "page"] {
            assert!(help("").contains(&format!("\n  {name} ")), "{name}");
        }
        for (name, _) in PARTS {
            assert!(help("test --help").contains(&format!("\n  {name} ")), "{name}");
        }
    }

    /// The commands `cargo xtask …` in a text, up to the end of the line, of the code or of the command.
    fn commands(text: &str) -> Vec<String> {
        let ends = ['`', '#', ';', '|', '\'', '"', ')', '\n', '&'];
        text.match_indices("cargo xtask ")
            .map(|(at, found)| text[at + found.len()..].split(ends).next().unwrap_or_default().trim().to_owned())
            .collect()
    }

    #[test]
    fn every_command_in_makefile_and_guide_is_accepted() {
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let mut pages = vec![root.join("README.md"), root.join("CONTRIBUTING.md")];
        pages.extend(std::fs::read_dir(root.join("docs")).unwrap().map(|entry| entry.unwrap().path()));
        let mut found = 0;
        for page in pages.iter().filter(|page| page.extension().is_some_and(|ending| ending == "md")) {
            for command in commands(&std::fs::read_to_string(page).unwrap()) {
                assert!(read_line(&command).is_ok(), "{}: cargo xtask {command}", page.display());
                found += 1;
            }
        }
        assert!(found > 3, "{found} commands found");
        let makefile = std::fs::read_to_string(root.join("Makefile")).unwrap();
        let tasks: Vec<String> =
            makefile.lines().filter_map(|line| line.split_once("$(XTASK) ")).map(|(_, task)| task.to_owned()).collect();
        assert!(tasks.len() > 3, "{tasks:?}");
        for line in tasks {
            let line = line.replace("'$(LISTEN)'", "127.0.0.1:0").replace("'$(SCRIPT)'", "a.toml");
            let line = line.split(" ||").next().unwrap_or_default();
            assert!(read_line(line).is_ok(), "Makefile: {line}");
        }
    }
}
