//! The output of a benchmark: tables and charts in docs/benchmarks, figures for programs in target/benchmarks; and
//! its clock.
// Each benchmark uses only a part of this module.
#![allow(dead_code, unreachable_pub)]

pub mod chart;

use std::path::Path;
use std::time::Instant;

use chart::Panel;
use serde_json::{Map, Value, json};

/// The results of a benchmark as they come in.
pub struct BenchReport {
    name: &'static str,
    text: String,
    figures: Map<String, Value>,
}

impl BenchReport {
    /// A report that the command `command` reproduces.
    pub fn new(name: &'static str, title: &str, command: &str) -> Self {
        let machine = machine();
        let command = if quick() { format!("{command} ARGUMENTS=--quick") } else { command.to_owned() };
        let text = format!(
            "# {title}\n\n`{command}` wrote this page and the picture, on {machine}.\n\n\
             ![{title}]({name}.svg)\n"
        );
        let mut figures = Map::new();
        figures.insert("machine".to_owned(), json!(machine));
        figures.insert("command".to_owned(), json!(command));
        BenchReport { name, text, figures }
    }

    /// Adds a heading.
    pub fn heading(&mut self, heading: &str) {
        self.text += &format!("\n## {heading}\n");
    }

    /// Adds a paragraph.
    pub fn say(&mut self, paragraph: &str) {
        self.text += &format!("\n{paragraph}\n");
    }

    /// Adds a table. Cells are text.
    pub fn table(&mut self, header: &[String], rows: &[Vec<String>]) {
        let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
        let rule: String = header.iter().map(|_| "|---").collect();
        self.text += &format!("\n{}{rule}|\n", line(header));
        self.text.extend(rows.iter().map(|row| line(row)));
    }

    /// Adds a figure for programs to read.
    pub fn figure(&mut self, name: &str, value: Value) {
        self.figures.insert(name.to_owned(), value);
    }

    /// Prints the page to standard output, and writes no files.
    pub fn print(&self) {
        print!("{}", self.text);
    }

    /// Writes the page and the picture to docs/benchmarks, the figures to target/benchmarks, and the page to standard
    /// output.
    pub fn write(self, columns: usize, panels: &[Panel]) {
        let write = |folder: &str, extension: &str, text: String| {
            let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join(folder);
            std::fs::create_dir_all(&folder).unwrap();
            std::fs::write(folder.join(self.name).with_extension(extension), text).unwrap();
        };
        write("docs/benchmarks", "md", self.text.clone());
        write("docs/benchmarks", "svg", chart::svg(columns, panels));
        write("target/benchmarks", "json", serde_json::to_string_pretty(&self.figures).unwrap() + "\n");
        self.print();
    }
}

/// The name of the machine's processors.
fn machine() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let of = |key: &str| {
        let line = text.lines().find(|line| line.starts_with(key));
        line.and_then(|line| line.split_once(": ")).map(|entry| entry.1)
    };
    let processors = text.lines().filter(|line| line.starts_with("processor")).count();
    match of("model name") {
        Some(model) => {
            let (family, number) = (of("cpu family").unwrap_or("?"), of("model\t").unwrap_or("?"));
            format!("{processors} × {model} (family {family}, model {number})")
        }
        None => format!("a machine that does not tell its name ({})", std::env::consts::ARCH),
    }
}

/// The time of `work`, s, and its result.
pub fn seconds<T>(work: impl FnOnce() -> T) -> (f64, T) {
    let start = Instant::now();
    let result = work();
    (start.elapsed().as_secs_f64(), result)
}

/// The least result of `run` for each job, over `rounds` rounds through all jobs. A temporary slowdown of the machine
/// affects all jobs alike, and the minimum excludes it.
pub fn least<J>(rounds: usize, jobs: &[J], mut run: impl FnMut(&J) -> f64) -> Vec<f64> {
    let mut least = vec![f64::INFINITY; jobs.len()];
    for _ in 0..rounds {
        for (job, least) in jobs.iter().zip(&mut least) {
            *least = least.min(run(job));
        }
    }
    least
}

/// Returns whether to run quickly and roughly: `cargo bench --bench NAME -- --quick`.
pub fn quick() -> bool {
    std::env::args().any(|argument| argument == "--quick")
}

/// Two significant digits: `1.3e-4`.
pub fn rough(value: f64) -> String {
    format!("{value:.1e}")
}

/// Three significant digits, or a dash for a missing value.
pub fn digits(value: f64) -> String {
    let power = value.abs().log10().floor();
    match value.abs() {
        _ if !value.is_finite() => "–".to_owned(),
        0.0 => "0".to_owned(),
        v if v < 1e-3 => format!("{value:.2e}"),
        _ => format!("{value:.*}", (2.0 - power).max(0.0) as usize),
    }
}

/// Text cells of a table.
pub fn cells<S: ToString>(cells: impl IntoIterator<Item = S>) -> Vec<String> {
    cells.into_iter().map(|cell| cell.to_string()).collect()
}
