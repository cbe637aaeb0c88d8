//! The commands of each task, in their order, as data: what runs is what `--plan` prints.

use crate::arguments::{ProjectTask, TestPart};
use crate::execute::TaskFailure;
use crate::system::{REQUIREMENTS, System, VENV_READY};

/// A command of a plan.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(crate) struct Step {
    pub(crate) program: String,
    pub(crate) arguments: Vec<String>,
    /// The folder in which it runs, below that of the sources; empty for that folder itself.
    pub(crate) folder: &'static str,
    /// Variables of its environment.
    pub(crate) variables: Vec<(&'static str, String)>,
    /// A folder whose programs it finds before others of the same name.
    pub(crate) path: Option<String>,
}

/// A stage of a plan. The next begins when it has ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum PlanStage {
    /// A command; the plan ends if it fails.
    Step(Step),
    /// A command, and others at the same time, one after another. If one of those fails, the rest of them do not run. The plan ends
    /// then, unless there is a text: that is printed.
    Beside { step: Step, others: Vec<Step>, without: Option<&'static str> },
    /// Writes an empty file, which says that the stages before it are done.
    Mark(&'static str),
    /// Prints what is left out, and why.
    Note(String),
    /// Starts a server, waits until it listens, plays a script on it, and waits until the server ends.
    Serve { server: Step, poke: Step },
}

const WITHOUT_PAGE: &str = "So there is no page to look at; gRPC is served all the same.";

/// The same random cases every time, so that the result is that of the change.
const SEED: (&str, &str) = ("PROPTEST_RNG_SEED", "20261122");

/// What Cargo is asked to test.
const RUST_TESTS: [&str; 4] = ["test", "--release", "--workspace", "--no-fail-fast"];

/// Tests of a program that run at once on each core: those of a running server wait for half of their time.
const TESTS_PER_CORE: usize = 3;

fn step(program: &str, arguments: &[&str]) -> Step {
    Step {
        program: program.to_owned(),
        arguments: arguments.iter().map(|&one| one.to_owned()).collect(),
        ..Step::default()
    }
}

/// Returns the stage of commands of which the first runs beside all others.
fn beside(steps: Vec<Step>) -> Option<PlanStage> {
    let mut steps = steps.into_iter();
    let step = steps.next()?;
    let others: Vec<Step> = steps.collect();
    Some(if others.is_empty() { PlanStage::Step(step) } else { PlanStage::Beside { step, others, without: None } })
}

/// Returns the stages of a task on a system.
///
/// # Errors
/// Returns what is missing for it.
pub(crate) fn plan(task: &ProjectTask, system: &System) -> Result<Vec<PlanStage>, TaskFailure> {
    match task {
        ProjectTask::Run { listen, script } => Ok(system.run(listen, script)),
        ProjectTask::Test(parts) => system.test(parts),
        ProjectTask::Lint => system.lint(),
        ProjectTask::Page => system.need_node().map(|()| system.page().into_iter().map(PlanStage::Step).collect()),
    }
}

impl System {
    fn need_node(&self) -> Result<(), TaskFailure> {
        let told = || TaskFailure::missing("Node.js 20.19 or later", "install it from https://nodejs.org");
        self.has_node.then_some(()).ok_or_else(told)
    }

    fn need_python(&self) -> Result<(), TaskFailure> {
        let told = || {
            let remedy = "install it from https://www.python.org (Debian: apt-get install python3-venv)";
            TaskFailure::missing("Python 3.9 or later with venv", remedy)
        };
        self.has_python.then_some(()).ok_or_else(told)
    }

    fn cargo(&self, arguments: &[&str]) -> Step {
        step(&self.cargo, arguments)
    }

    fn npm(&self, folder: &'static str, arguments: &[&str]) -> Step {
        Step { folder, ..step(&self.npm, arguments) }
    }

    /// Returns the path of a program that `run` has compiled.
    fn built(&self, name: &str) -> String {
        format!("{}/quick/{name}{}", self.target, if self.is_windows { ".exe" } else { "" })
    }

    /// Returns the folder of the programs of `target/venv`.
    fn venv_programs(&self) -> &'static str {
        if self.is_windows { "target/venv/Scripts" } else { "target/venv/bin" }
    }

    fn venv_python(&self, arguments: &[&str]) -> Step {
        let python = if self.is_windows { "python.exe" } else { "python" };
        step(&format!("{}/{python}", self.venv_programs()), arguments)
    }

    fn modules(&self) -> Option<Step> {
        (!self.has_modules).then(|| self.npm("clients", &["ci"]))
    }

    fn page(&self) -> Vec<Step> {
        let build = (!(self.has_page && self.has_modules)).then(|| self.npm("clients/viewer", &["run", "build"]));
        self.modules().into_iter().chain(build).collect()
    }

    fn run(&self, listen: &str, script: &str) -> Vec<PlanStage> {
        // The two programs alone, and optimized where it matters (Cargo.toml): the libraries for C and Python take as long
        // again. The page is built at the same time, because
        // each has parts that keep one core busy alone.
        let programs =
            self.cargo(&["build", "--profile", "quick", "--package", "palpate", "--package", "palpate-programs"]);
        let mut stages = Vec::new();
        match self.has_node {
            true if self.page().is_empty() => stages.push(PlanStage::Step(programs)),
            true => stages.push(PlanStage::Beside { step: programs, others: self.page(), without: Some(WITHOUT_PAGE) }),
            false => {
                let missing = format!("`{}` is not Node.js 20.19 or later. {WITHOUT_PAGE}", self.node);
                stages.extend([PlanStage::Note(missing), PlanStage::Step(programs)]);
            }
        }
        let poke = ["replay", script, "--output", "target/poke.jsonl", "--plot"];
        stages.push(PlanStage::Serve {
            server: step(&self.built("palpate"), &["serve", "--listen", listen, "--log", "warn"]),
            poke: step(&self.built("palpate-client"), &poke),
        });
        stages
    }

    fn test(&self, asked: &[TestPart]) -> Result<Vec<PlanStage>, TaskFailure> {
        let is_asked = |part: TestPart| asked.is_empty() || asked.contains(&part);
        // What is fetched and built for Python and the page waits for the network and for one core: it is made while Cargo
        // compiles.
        let mut built = Vec::new();
        if [TestPart::Viewer, TestPart::Python, TestPart::Rust, TestPart::Abi, TestPart::Documents]
            .into_iter()
            .any(is_asked)
        {
            built.push(self.cargo(&["build", "--release", "--workspace"]));
        }
        let needs_python = [TestPart::Python, TestPart::Documents].into_iter().any(is_asked);
        if needs_python {
            self.need_python()?;
            built.extend(self.venv());
        }
        if is_asked(TestPart::Viewer) {
            self.need_node()?;
            built.extend(self.page());
        }
        let mut stages: Vec<PlanStage> = beside(built).into_iter().collect();
        if needs_python && !self.has_venv {
            stages.push(PlanStage::Mark(VENV_READY));
        }
        if is_asked(TestPart::Viewer) {
            let tests = ["clients/viewer", "clients/typescript"].map(|of| self.npm(of, &["test"]));
            if is_asked(TestPart::Rust) && !self.is_windows {
                // They use a quarter of the machine: the tests in Rust compile in what is left.
                stages.extend(beside([vec![self.compiled_tests()], tests.to_vec()].concat()));
            } else {
                stages.extend(tests.map(PlanStage::Step));
            }
        }
        // These wait for most of their time, so that they run beside the tests in Rust.
        let mut waiting = Vec::new();
        if is_asked(TestPart::Python) {
            // The tools for building are those of the environment, so that pip makes none of its own; what is compiled is what
            // the first stage has compiled.
            let as_compiled = "--config-settings=build-args=--features=workspace-features";
            let install = ["--no-build-isolation", "--no-deps", "--force-reinstall", as_compiled, "./clients/python"];
            let install = Step { path: Some(self.venv_programs().to_owned()), ..self.pip(&install) };
            stages.push(PlanStage::Step(install));
            waiting.push(self.unittest("clients/python/tests"));
        }
        if is_asked(TestPart::Protocol) {
            let generator = ["test", "--quiet", "--locked", "--target-dir", "../../target/generator"];
            waiting.extend(
                [&["fmt", "--check"][..], &generator]
                    .map(|arguments| Step { folder: "proto/generator", ..self.cargo(arguments) }),
            );
        }
        if is_asked(TestPart::Documents) {
            waiting.push(self.unittest("tests/python"));
        }
        let rust = is_asked(TestPart::Rust).then(|| self.rust_tests());
        stages.extend(beside(rust.into_iter().chain(waiting).collect()));
        if is_asked(TestPart::Abi) {
            if self.has_shell && !self.is_windows {
                let built = format!("{}/release", self.target);
                stages.push(PlanStage::Step(step("sh", &["tests/abi/check.sh", &built, "interface"])));
            } else if asked.is_empty() {
                let reason = "the comparison of libpalpate's interface: it needs a Unix with a POSIX shell";
                stages.push(PlanStage::Note(format!("left out: {reason}")));
            } else {
                return Err(TaskFailure::missing("a Unix with a POSIX shell", "the part `abi` can't run here"));
            }
        }
        Ok(stages)
    }

    /// Returns the step that compiles what [`System::rust_tests`] runs, behind all other work.
    fn compiled_tests(&self) -> Step {
        let cargo = self.cargo(&RUST_TESTS);
        let arguments = ["-n", "19", &cargo.program].map(str::to_owned).into_iter().chain(cargo.arguments);
        Step { arguments: arguments.chain(["--no-run".to_owned()]).collect(), ..step("nice", &[]) }
    }

    fn rust_tests(&self) -> Step {
        let test = self.cargo(&RUST_TESTS);
        let threads = ("RUST_TEST_THREADS", (TESTS_PER_CORE * self.cores).to_string());
        Step { variables: vec![(SEED.0, SEED.1.to_owned()), threads], ..test }
    }

    fn pip(&self, arguments: &[&str]) -> Step {
        let own = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check"];
        self.venv_python(&[&own[..], arguments].concat())
    }

    /// Returns what makes the environment for Python; nothing if it is there.
    fn venv(&self) -> Vec<Step> {
        if self.has_venv {
            return Vec::new();
        }
        let install = self.pip(&["-r", REQUIREMENTS[0], "-r", REQUIREMENTS[1]]);
        vec![step(&self.python, &["-m", "venv", "target/venv"]), install]
    }

    fn unittest(&self, folder: &str) -> Step {
        self.venv_python(&["-m", "unittest", "discover", "-s", folder, "-v"])
    }

    fn lint(&self) -> Result<Vec<PlanStage>, TaskFailure> {
        self.need_python()?;
        self.need_node()?;
        let clippy = ["clippy", "--release", "--workspace", "--all-targets", "--", "-D", "warnings"];
        let steps = [self.cargo(&["fmt", "--all", "--check"]), step(&self.python, &["tests/counts.py"])];
        let pages = ["clients/typescript", "clients/viewer"].map(|of| self.npm(of, &["run", "lint"]));
        let checks = [self.cargo(&clippy)].into_iter().chain(self.modules()).chain(pages).collect();
        Ok(steps.into_iter().map(PlanStage::Step).chain(beside(checks)).collect())
    }
}

/// Returns the text of `--plan`: a line for each command, with what else happens as comments.
pub(crate) fn shown(stages: &[PlanStage]) -> String {
    let mut text = String::new();
    let mut add = |line: String| text += &(line + "\n");
    for stage in stages {
        match stage {
            PlanStage::Step(step) => add(step.to_string()),
            PlanStage::Beside { step, others, without } => {
                add(step.to_string());
                let may_fail = if without.is_some() { "; may fail" } else { "" };
                others.iter().for_each(|other| add(format!("{other}   # at the same time{may_fail}")));
            }
            PlanStage::Mark(file) => add(format!("# marks {file}")),
            PlanStage::Note(text) => add(format!("# {text}")),
            PlanStage::Serve { server, poke } => {
                add(format!("{server}   # until Ctrl-C"));
                add(format!("{poke} --server URL   # the server's URL, when it listens"));
            }
        }
    }
    text
}

impl std::fmt::Display for Step {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if !self.folder.is_empty() {
            write!(f, "(in {}) ", self.folder)?;
        }
        for (name, value) in &self.variables {
            write!(f, "{name}={value} ")?;
        }
        write!(f, "{}", self.program)?;
        self.arguments.iter().try_for_each(|argument| write!(f, " {argument}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A machine with everything installed, and nothing built.
    fn machine(is_windows: bool) -> System {
        System {
            is_windows,
            cargo: "cargo".to_owned(),
            python: if is_windows { "python" } else { "python3" }.to_owned(),
            node: "node".to_owned(),
            npm: if is_windows { "npm.cmd" } else { "npm" }.to_owned(),
            has_python: true,
            has_node: true,
            has_shell: !is_windows,
            cores: 2,
            target: "target".to_owned(),
            has_modules: false,
            has_page: false,
            has_venv: false,
        }
    }

    fn built(is_windows: bool) -> System {
        System { has_modules: true, has_page: true, has_venv: true, ..machine(is_windows) }
    }

    fn lines(task: &ProjectTask, system: &System) -> Vec<String> {
        shown(&plan(task, system).unwrap()).lines().map(str::to_owned).collect()
    }

    fn run() -> ProjectTask {
        ProjectTask::Run { listen: "127.0.0.1:0".to_owned(), script: "a.toml".to_owned() }
    }

    const PROGRAMS: &str = "cargo build --profile quick --package palpate --package palpate-programs";
    const WORKSPACE: &str = "cargo build --release --workspace";

    #[test]
    fn run_builds_the_two_programs_and_the_page_then_serves_and_pokes() {
        let serve = |ending: &str| {
            [
                format!("target/quick/palpate{ending} serve --listen 127.0.0.1:0 --log warn   # until Ctrl-C"),
                format!(
                    "target/quick/palpate-client{ending} replay a.toml --output target/poke.jsonl --plot \
                     --server URL   # the server's URL, when it listens"
                ),
            ]
        };
        for (is_windows, npm, ending) in [(false, "npm", ""), (true, "npm.cmd", ".exe")] {
            let first = [
                PROGRAMS.to_owned(),
                format!("(in clients) {npm} ci   # at the same time; may fail"),
                format!("(in clients/viewer) {npm} run build   # at the same time; may fail"),
            ];
            assert_eq!(lines(&run(), &machine(is_windows)), [&first[..], &serve(ending)].concat());
            assert_eq!(lines(&run(), &built(is_windows)), [&[PROGRAMS.to_owned()][..], &serve(ending)].concat());
        }
    }

    #[test]
    fn without_node_run_serves_all_the_same_and_says_so() {
        let lines = lines(&run(), &System { has_node: false, ..machine(false) });
        assert_eq!(lines.len(), 4, "{lines:?}");
        assert!(lines[0].contains("`node` is not Node.js 20.19") && lines[0].contains("gRPC is served"), "{lines:?}");
        assert_eq!(lines[1], PROGRAMS);
    }

    #[test]
    fn test_runs_every_part_with_the_programs_of_the_system() {
        let unix = lines(&ProjectTask::Test(vec![]), &built(false));
        assert_eq!(
            unix,
            [
                WORKSPACE,
                "nice -n 19 cargo test --release --workspace --no-fail-fast --no-run",
                "(in clients/viewer) npm test   # at the same time",
                "(in clients/typescript) npm test   # at the same time",
                "target/venv/bin/python -m pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps \
                 --force-reinstall --config-settings=build-args=--features=workspace-features ./clients/python",
                "PROPTEST_RNG_SEED=20261122 RUST_TEST_THREADS=6 cargo test --release --workspace --no-fail-fast",
                "target/venv/bin/python -m unittest discover -s clients/python/tests -v   # at the same time",
                "(in proto/generator) cargo fmt --check   # at the same time",
                "(in proto/generator) cargo test --quiet --locked --target-dir ../../target/generator   # at the same time",
                "target/venv/bin/python -m unittest discover -s tests/python -v   # at the same time",
                "sh tests/abi/check.sh target/release interface",
            ]
        );
        let windows = lines(&ProjectTask::Test(vec![]), &built(true));
        assert_eq!(windows.len(), unix.len() - 1);
        for (windows, unix) in windows.iter().zip(unix.iter().filter(|line| !line.starts_with("nice "))) {
            let same = unix.replace("venv/bin/python", "venv/Scripts/python.exe").replace(") npm ", ") npm.cmd ");
            let same = if same.contains("npm.cmd test") { same.replace("   # at the same time", "") } else { same };
            assert!(
                *windows == same || windows.starts_with("# left out") && unix.starts_with("sh "),
                "{windows}: {unix}"
            );
        }
    }

    #[test]
    fn parts_run_in_one_order_and_need_only_what_they_use() {
        let bare = System { has_node: false, has_python: false, has_shell: false, ..machine(false) };
        let only_rust = lines(&ProjectTask::Test(vec![TestPart::Rust, TestPart::Protocol]), &bare);
        assert_eq!(only_rust.len(), 4, "{only_rust:?}");
        assert!(only_rust[0] == WORKSPACE && only_rust[1].contains("cargo test --release"), "{only_rust:?}");
        assert_eq!(
            lines(&ProjectTask::Test(vec![TestPart::Protocol]), &bare).len(),
            2,
            "the generator builds by itself"
        );
        for (part, missing) in [
            (TestPart::Viewer, "Node.js"),
            (TestPart::Python, "Python"),
            (TestPart::Documents, "Python"),
            (TestPart::Abi, "POSIX"),
        ] {
            let failure = plan(&ProjectTask::Test(vec![part]), &bare).unwrap_err();
            assert_eq!(failure.status(), 3);
            assert!(failure.to_string().contains(missing), "{failure}");
        }
    }

    #[test]
    fn the_python_environment_is_made_once() {
        let first = lines(&ProjectTask::Test(vec![TestPart::Documents]), &machine(true));
        assert_eq!(first[1], "python -m venv target/venv   # at the same time");
        assert!(first[2].starts_with("target/venv/Scripts/python.exe -m pip install"), "{first:?}");
        assert_eq!(first[3], "# marks target/venv/ready");
        assert_eq!(lines(&ProjectTask::Test(vec![TestPart::Documents]), &built(true)).len(), 2);
    }

    #[test]
    fn lint_and_page_need_node_and_install_its_packages_first() {
        let lint = lines(&ProjectTask::Lint, &machine(false));
        assert_eq!(lint[1], "python3 tests/counts.py");
        assert_eq!(lint[2], "cargo clippy --release --workspace --all-targets -- -D warnings");
        let [install, typescript, viewer] = &lint[3..] else { panic!("{lint:?}") };
        assert_eq!(install, "(in clients) npm ci   # at the same time");
        assert!(
            [typescript, viewer].iter().all(|line| line.ends_with("npm run lint   # at the same time")),
            "{lint:?}"
        );
        assert_eq!(
            lines(&ProjectTask::Page, &machine(false)),
            ["(in clients) npm ci", "(in clients/viewer) npm run build"]
        );
        assert_eq!(lines(&ProjectTask::Page, &built(false)), [""; 0]);
        for task in [ProjectTask::Lint, ProjectTask::Page] {
            assert_eq!(plan(&task, &System { has_node: false, ..built(false) }).unwrap_err().status(), 3);
        }
    }
}
