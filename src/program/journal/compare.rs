//! `palpate journal compare`: the figures of several sessions beside each other, with percentiles.

use std::fmt::Write as _;
use std::io::Write;
use std::path::{Path, PathBuf};

use palpate_exercise::MeasureOptions;
use palpate_refusal::printable::printable;
use palpate_tissue::files;

use super::super::score::exercise::ExerciseOptions;
use super::super::score::{Score, ScoreOptions, shown};
use super::super::{Failure, say, write_file};
use super::JournalSource;
use super::output::{output, written};
use super::score::{MeasuredJournal, measure};

/// The first bytes of a journal.
const MCAP: &[u8] = b"\x89MCAP";

/// The largest score that is read, bytes.
const MAX_SCORE_BYTES: u64 = 16 << 20;

/// The largest number of files whose figures fit beside each other.
const MAX_COLUMNS: usize = 8;

/// The percentiles of the table.
const PERCENTILES: [f64; 5] = [10.0, 25.0, 50.0, 75.0, 90.0];

#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
    palpate journal compare monday.json friday.json\n  \
    palpate journal compare cohort/*.mcap --force-limit-n 2 --csv cohort.csv\n\n\
    The files are in the order of their recording: a learning curve. Scores of `palpate run` have no time, and come \
    first, in the given order. The table has the figures of each file, of up to 8 files, and their percentiles; a file \
    without a figure does not count. A figure of one tool has the tool's number in brackets. The CSV file has a row for \
    each file and a column for each figure.\n\n\
    A score keeps the thresholds with which it was computed; those given here are for journals.")]
pub(super) struct CompareArguments {
    /// Journals, or scores (JSON)
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    #[command(flatten)]
    options: ScoreOptions,
    /// Write the figures of all files here, for statistics
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Configuration file (TOML) with other limits, in a section [limits]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Show no progress
    #[arg(short, long)]
    quiet: bool,
}

/// A file and its score.
struct Compared {
    name: String,
    score: Score,
}

fn is_journal(path: &Path) -> bool {
    use std::io::Read;
    let mut begin = [0; MCAP.len()];
    std::fs::File::open(path).and_then(|mut file| file.read_exact(&mut begin)).is_ok() && begin == *MCAP
}

fn read_score(path: &Path) -> Result<Score, Failure> {
    let text = files::read_text(path, MAX_SCORE_BYTES)?;
    serde_json::from_str(&text).map_err(|e| {
        let name = path.display();
        Failure::Refused(format!("{name}: is neither a journal nor a score of `palpate … --score` or `score`: {e}"))
    })
}

/// Returns the names of the figures of all files: a measure, and its tool.
fn columns(compared: &[Compared]) -> Vec<(&'static str, &'static str, Option<u32>)> {
    let mut tools: Vec<u32> = compared.iter().flat_map(|one| one.score.tools()).collect();
    tools.sort_unstable();
    tools.dedup();
    let mut columns = Vec::new();
    for definition in palpate_exercise::register::definitions() {
        for tool in std::iter::once(None).chain(tools.iter().copied().map(Some)) {
            if compared.iter().any(|one| one.score.value(definition.name, tool).is_some()) {
                columns.push((definition.name, definition.unit, tool));
            }
        }
    }
    columns
}

fn label(name: &str, tool: Option<u32>) -> String {
    tool.map_or_else(|| name.to_owned(), |tool| format!("{name}[{tool}]"))
}

/// Returns a percentile of ascending values: linear between the two nearest ranks (Hyndman and Fan 1996, type 7). `None`
/// without values.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn percentile(ascending: &[f64], percent: f64) -> Option<f64> {
    let rank = percent / 100.0 * ascending.len().checked_sub(1)? as f64;
    let (below, part) = (rank.floor() as usize, rank.fract());
    let above = (below + 1).min(ascending.len() - 1);
    Some(ascending[below] + part * (ascending[above] - ascending[below]))
}

fn table(compared: &[Compared]) -> String {
    let mut text = String::new();
    for (number, Compared { name, score }) in compared.iter().enumerate() {
        let recorded =
            score.source.recorded.as_deref().map_or("–", |recorded| recorded.get(..19).unwrap_or(recorded));
        let _ = writeln!(
            text,
            "{:>4}  {:<19}  {}  {}",
            number + 1,
            printable(recorded),
            printable(name),
            printable(&score.source.scene)
        );
    }
    let beside = if compared.len() <= MAX_COLUMNS { compared } else { &[] };
    let _ = write!(text, "\n{:<34}", "measure");
    (1..=beside.len()).for_each(|number| text += &format!("{number:>11}"));
    PERCENTILES.iter().for_each(|percent| text += &format!("{:>11}", format!("{percent} %")));
    text += "  unit\n";
    let columns = columns(compared);
    let has_total = |name: &str| columns.iter().any(|column| column.0 == name && column.2.is_none());
    let has_one_tool = compared.iter().all(|one| one.score.tools().len() <= 1);
    // The figure of a single tool is that of all tools.
    for (name, unit, tool) in
        columns.iter().filter(|column| column.2.is_none() || !has_one_tool || !has_total(column.0))
    {
        let _ = write!(text, "{:<34}", label(name, *tool));
        beside.iter().for_each(|one| text += &format!("{:>11}", shown(one.score.value(name, *tool))));
        let mut values: Vec<f64> = compared.iter().filter_map(|one| one.score.value(name, *tool)).collect();
        values.sort_unstable_by(f64::total_cmp);
        PERCENTILES.iter().for_each(|percent| text += &format!("{:>11}", shown(percentile(&values, *percent))));
        let _ = writeln!(text, "  {unit}");
    }
    text
}

/// Returns a field of a CSV file.
fn quoted(text: &str) -> String {
    format!("\"{}\"", printable(text).replace('"', "\"\""))
}

fn csv(compared: &[Compared]) -> String {
    let columns = columns(compared);
    let mut text = "file,recorded,scene,script".to_owned();
    columns.iter().for_each(|(name, _, tool)| text += &format!(",{}", label(name, *tool)));
    text.push('\n');
    for Compared { name, score } in compared {
        let source = &score.source;
        let [recorded, script] = [&source.recorded, &source.script].map(|field| field.as_deref().unwrap_or_default());
        text += &[name, recorded, &source.scene, script].map(quoted).join(",");
        for (name, _, tool) in &columns {
            let value = score.value(name, *tool).map(|value| value.to_string());
            text += &format!(",{}", value.unwrap_or_default());
        }
        text.push('\n');
    }
    text
}

/// Compares sessions.
pub(super) fn compare(arguments: &CompareArguments) -> Result<(), Failure> {
    let CompareArguments { files, options, csv: file, config, quiet } = arguments;
    options.checked(MeasureOptions::default())?;
    let mut compared = Vec::new();
    for path in files {
        let score = if is_journal(path) {
            let source = JournalSource { file: path.clone(), config: config.clone() };
            let MeasuredJournal { score, damage, .. } = measure(&source, options, &ExerciseOptions::default(), *quiet)?;
            if let Some((damage, until_step)) = damage {
                say!("palpate: warning: {}: {damage}; its figures end at step {until_step}", path.display());
            }
            score
        } else {
            read_score(path)?
        };
        compared.push(Compared { name: path.display().to_string(), score });
    }
    compared.sort_by(|a, b| a.score.source.recorded.cmp(&b.score.source.recorded));
    let first = &compared[0].score.thresholds;
    if let Some(other) = compared.iter().find(|one| one.score.thresholds != *first) {
        let name = &other.name;
        say!("palpate: warning: {name} has other thresholds than {}: not all figures compare", compared[0].name);
    }
    let of_exercise = |score: &Score| score.exercise.as_ref().map(|exercise| (exercise.name.clone(), exercise.seed));
    if let Some(other) = compared.iter().find(|one| of_exercise(&one.score) != of_exercise(&compared[0].score)) {
        let (name, first) = (&other.name, &compared[0].name);
        say!("palpate: warning: {name} is of another exercise or seed than {first}: not all figures compare");
    }
    if let Some(file) = file {
        write_file(file, csv(&compared).as_bytes())?;
    }
    let mut out = output(None)?;
    written(out.write_all(table(&compared).as_bytes()).and_then(|()| out.flush()))
}

#[cfg(test)]
mod tests {
    use super::percentile;

    #[test]
    fn a_percentile_lies_between_the_nearest_ranks() {
        let values = [1.0, 2.0, 4.0, 8.0];
        let of = |percent| percentile(&values, percent);
        assert_eq!([of(0.0), of(50.0), of(75.0), of(100.0)], [1.0, 3.0, 5.0, 8.0].map(Some));
        assert_eq!((percentile(&[3.0], 90.0), percentile(&[], 50.0)), (Some(3.0), None));
    }
}
