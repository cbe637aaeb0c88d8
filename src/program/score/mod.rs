//! A score: the figures of what tools did, as a JSON file and as a table.

pub(crate) mod exercise;
pub(crate) mod report;

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::Path;
use std::str::FromStr;

use palpate_exercise::timeline::LimitCrossing;
use palpate_exercise::{Figure, LimitKind, MeasureOptions, Measures, ToolLimits};
use palpate_refusal::Refusal;
use palpate_refusal::printable::{printable, printable_json};
use serde::{Deserialize, Serialize};

use palpate_session::Session;
use palpate_session::chosen_exercise::ChosenExercise;
use palpate_session::exercise_judge::ExerciseJudge;
use palpate_session::journal::exercise::ExerciseEvents;
use palpate_session::measured_run::MeasuredRun;
use palpate_tissue::Model;
use palpate_tissue::scene::script::Script;

use super::{Failure, write_file};
use exercise::{ScoredExercise, usual_thresholds};

/// Thresholds of measures, and the hands.
#[derive(clap::Args)]
pub(crate) struct ScoreOptions {
    /// The force, N, above which a tool is too strong: the score then has force_above_limit_share, and each time above it
    #[arg(long, value_name = "N")]
    force_limit_n: Option<f64>,
    /// The pressure, Pa, above which a tip presses too hard: the score then has pressure_above_limit_share, and each time above it
    #[arg(long, value_name = "PA")]
    pressure_limit_pa: Option<f64>,
    /// The strain, as of `tear_strain` in a scene, above which a tool stretches the tissue near it too far: the score then has peak_strain,
    /// strain_above_limit_share, and each time above it
    #[arg(long, value_name = "STRAIN")]
    strain_limit: Option<f64>,
    /// The pressure, Pa, from which a place of the surface counts as covered. Default: 2000, a fingertip 2 mm deep in a
    /// liver; deep lumps of a breast need 20000
    #[arg(long, value_name = "PA")]
    coverage_pa: Option<f64>,
    /// The force, N, from which a contact counts as a press. Default: 0.1
    #[arg(long, value_name = "N")]
    press_n: Option<f64>,
    /// The tools of one hand, such as the tips of an instrument: give it twice, `--hand 0,1 --hand 2,3`. Default: each of
    /// two tools is a hand
    #[arg(long, value_name = "TOOL,…")]
    hand: Vec<HandTools>,
}

/// The numbers of the tools of a hand.
#[derive(Debug, Clone)]
struct HandTools(Vec<u32>);

impl FromStr for HandTools {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let tools = text.split(',').map(|tool| tool.trim().parse().ok()).collect::<Option<_>>();
        tools.map(HandTools).ok_or("must be numbers of tools, such as 0,1")
    }
}

impl ScoreOptions {
    /// Returns the limits that were given.
    fn limits(&self) -> ToolLimits {
        ToolLimits { force_n: self.force_limit_n, pressure_pa: self.pressure_limit_pa, strain: self.strain_limit }
    }

    /// Returns the thresholds: those of the options, or else `usual`.
    ///
    /// # Errors
    /// Refuses what [`MeasureOptions::check`] refuses, with the option's name.
    pub(crate) fn checked(&self, usual: MeasureOptions) -> Result<MeasureOptions, Failure> {
        let options = MeasureOptions {
            limits: self.limits().or(usual.limits),
            coverage_pa: self.coverage_pa.unwrap_or(usual.coverage_pa),
            press_n: self.press_n.unwrap_or(usual.press_n),
            hands: self.hand.iter().map(|hand| hand.0.clone()).collect(),
            ..usual
        };
        let named = |refusal: Refusal| {
            let option = match refusal.field.as_str() {
                "hands" => "hand".to_owned(),
                "force_n" => "force-limit-n".to_owned(),
                "pressure_pa" => "pressure-limit-pa".to_owned(),
                "strain" => "strain-limit".to_owned(),
                field => field.replace('_', "-"),
            };
            Refusal { field: format!("--{option}"), ..refusal }
        };
        options.check().map_err(named)?;
        Ok(options)
    }

    /// Returns the name of an option that was given; `None` if none was.
    pub(crate) fn given(&self) -> Option<&'static str> {
        let given = [
            ("--force-limit-n", self.force_limit_n.is_some()),
            ("--pressure-limit-pa", self.pressure_limit_pa.is_some()),
            ("--strain-limit", self.strain_limit.is_some()),
            ("--coverage-pa", self.coverage_pa.is_some()),
            ("--press-n", self.press_n.is_some()),
            ("--hand", !self.hand.is_empty()),
        ];
        given.into_iter().find(|(_, is_given)| *is_given).map(|(option, _)| option)
    }
}

/// Where a score comes from.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct ScoreSource {
    /// The scene's name.
    pub(crate) scene: String,
    /// The script that was played.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) script: Option<String>,
    /// The file of the journal that was simulated again.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) journal: Option<String>,
    /// The recorded session.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) session_id: Option<String>,
    /// When its recording began, UTC, `2026-01-31 12:34:56.789`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) recorded: Option<String>,
}

/// The thresholds with which a score was computed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Thresholds {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) force_limit_n: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) pressure_limit_pa: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) strain_limit: Option<f64>,
    pub(crate) coverage_pa: f64,
    pub(crate) press_n: f64,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) hands: Vec<Vec<u32>>,
    /// The direction against which the surface of the coverage faces; absent: all of it counts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) seen_along: Option<[f64; 3]>,
}

/// A figure in a score.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ScoredMeasure {
    pub(crate) name: String,
    pub(crate) value: f64,
    pub(crate) unit: String,
    /// The tool; not written for all tools together.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) tool: Option<u32>,
}

impl ScoredMeasure {
    fn of(Figure { definition, value, tool }: &Figure) -> Self {
        let (name, unit) = (definition.name.to_owned(), definition.unit.to_owned());
        ScoredMeasure { name, value: *value, unit, tool: *tool }
    }
}

/// A time above a limit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ScoredCrossing {
    pub(crate) tool: u32,
    /// Its key in the `[limits]` of an exercise, which has the unit of `peak`.
    #[serde(default = "force_limit")]
    pub(crate) limit: String,
    pub(crate) from_step: u64,
    pub(crate) to_step: u64,
    pub(crate) from_s: f64,
    pub(crate) to_s: f64,
    #[serde(alias = "peak_n")]
    pub(crate) peak: f64,
}

/// Returns the limit of a crossing in a score from before there were others.
fn force_limit() -> String {
    LimitKind::Force.key().to_owned()
}

impl ScoredCrossing {
    /// Returns the name of the limit and its unit, for people.
    fn name_and_unit(&self) -> (&str, &'static str) {
        let known = LimitKind::ALL.into_iter().find(|kind| kind.key() == self.limit);
        match known {
            Some(kind) => kind.name_and_unit(),
            None => (&self.limit, ""),
        }
    }
}

/// A score, as its JSON file has it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Score {
    /// The version of Palpate that computed it.
    pub(crate) version: String,
    #[serde(flatten)]
    pub(crate) source: ScoreSource,
    pub(crate) rate_hz: f64,
    /// Steps done at the beginning, and since.
    pub(crate) begin_step: u64,
    pub(crate) steps: u64,
    pub(crate) thresholds: Thresholds,
    /// All tools together, then each tool.
    pub(crate) measures: Vec<ScoredMeasure>,
    /// With limits: how often one was exceeded, and the first of these times.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) limit_crossing_count: Option<u64>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) limit_crossings: Vec<ScoredCrossing>,
    /// The exercise, if there was one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) exercise: Option<ScoredExercise>,
}

/// Measures a session, and judges it by an exercise if there is one.
pub(crate) struct ScoreRecorder {
    run: MeasuredRun,
    seed: u64,
    /// The thresholds of the exercise itself.
    own: MeasureOptions,
    /// What the end of the session has shown.
    judged: Option<ScoredExercise>,
}

impl ScoreRecorder {
    /// Begins at step `begin_step`; `continuous` is as for [`MeasuredRun::new`], and `events` are those of a journal.
    ///
    /// # Errors
    /// Refuses what [`MeasuredRun::new`] refuses.
    pub(crate) fn new(
        model: &Model,
        begin_step: u64,
        options: MeasureOptions,
        continuous: Option<&Script>,
        (chosen, events): (Option<&ChosenExercise>, ExerciseEvents),
    ) -> Result<Self, Refusal> {
        let run = MeasuredRun::new(model, begin_step, options, continuous, chosen)?;
        let ends_at = events.result.map(|result| result.step);
        let run = run.ending_phases_at(events.phase_ends).ending_at(ends_at);
        let own = usual_thresholds(chosen);
        Ok(ScoreRecorder { run, seed: chosen.map_or(0, |chosen| chosen.seed), own, judged: None })
    }

    /// Takes the session at its present step. When the exercise ends, judges it; what comes later does not count.
    pub(crate) fn see(&mut self, session: &Session) {
        if self.run.see(session) {
            self.finish(session);
        }
    }

    /// Judges the session at its end.
    pub(crate) fn finish(&mut self, session: &Session) {
        if self.judged.is_none() {
            let ended = self.run.end(session);
            let (figures, judge) = (ended.figures(), ended.judge().cloned());
            let options = self.run.measures().options();
            let of = |judge: &ExerciseJudge| ScoredExercise {
                changed_thresholds: changed(options, &self.own),
                ..ScoredExercise::of(judge, self.seed, session, &figures)
            };
            self.judged = judge.as_ref().map(of);
        }
    }

    /// Returns the score and the measures.
    pub(crate) fn into_score(self, source: ScoreSource, rate_hz: f64) -> (Score, Measures) {
        let measures = self.run.measures();
        let figures = self.run.ended().map_or_else(|| measures.figures(), |ended| ended.figures().figures);
        let score = Score::of(source, rate_hz, measures, &figures);
        (Score { exercise: self.judged, ..score }, measures.clone())
    }
}

/// Returns the names of the thresholds that are not those of the exercise, `own`.
fn changed(options: &MeasureOptions, own: &MeasureOptions) -> Vec<String> {
    let (given, limits) = (&options.limits, &own.limits);
    let changes = [
        ("force_limit_n", given.force_n != limits.force_n),
        ("pressure_limit_pa", given.pressure_pa != limits.pressure_pa),
        ("strain_limit", given.strain != limits.strain),
        ("coverage_pa", options.coverage_pa != own.coverage_pa),
        ("press_n", options.press_n != own.press_n),
        ("hands", options.hands != own.hands),
    ];
    changes.into_iter().filter(|(_, is_changed)| *is_changed).map(|(name, _)| name.to_owned()).collect()
}

impl Score {
    /// Returns the score of what was measured at `rate_hz` steps per second, with all figures.
    #[allow(clippy::cast_precision_loss)]
    fn of(source: ScoreSource, rate_hz: f64, measures: &Measures, figures: &[Figure]) -> Self {
        let crossing = |crossing: &LimitCrossing| {
            let LimitCrossing { tool, limit, steps: [from_step, to_step], peak } = *crossing;
            // A row holds for the step that it ends.
            let from_s = from_step.saturating_sub(1) as f64 / rate_hz;
            let limit = limit.key().to_owned();
            ScoredCrossing { tool, limit, from_step, to_step, from_s, to_s: to_step as f64 / rate_hz, peak }
        };
        let MeasureOptions { limits, coverage_pa, press_n, hands, seen_along } = measures.options().clone();
        let ToolLimits { force_n: force_limit_n, pressure_pa: pressure_limit_pa, strain: strain_limit } = limits;
        let seen_along = seen_along.map(|direction| direction.to_array());
        let timeline = measures.timeline();
        Score {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            source,
            rate_hz,
            begin_step: measures.begin_step(),
            steps: measures.steps(),
            thresholds: Thresholds {
                force_limit_n,
                pressure_limit_pa,
                strain_limit,
                coverage_pa,
                press_n,
                hands,
                seen_along,
            },
            measures: figures.iter().map(ScoredMeasure::of).collect(),
            limit_crossing_count: (limits.given().count() > 0).then(|| timeline.crossing_count()),
            limit_crossings: timeline.crossings().iter().map(crossing).collect(),
            exercise: None,
        }
    }

    /// Returns the score as the text of a JSON file.
    pub(crate) fn json(&self) -> Result<String, Failure> {
        let text = serde_json::to_string_pretty(self).map_err(|e| Failure::Failed(e.to_string()))?;
        Ok(printable_json(text) + "\n")
    }

    /// Writes the score as a JSON file.
    pub(crate) fn write(&self, path: &Path) -> Result<(), Failure> {
        write_file(path, self.json()?.as_bytes())
    }

    /// Returns the numbers of the tools, ascending.
    pub(crate) fn tools(&self) -> Vec<u32> {
        let tools: BTreeSet<u32> = self.measures.iter().filter_map(|measure| measure.tool).collect();
        tools.into_iter().collect()
    }

    /// Returns the value of a measure; `None` if the score has none.
    pub(crate) fn value(&self, name: &str, tool: Option<u32>) -> Option<f64> {
        let of = |measure: &&ScoredMeasure| measure.name == name && measure.tool == tool;
        self.measures.iter().find(of).map(|measure| measure.value)
    }

    /// Returns the names and units of the measures, each once, in the order of the register.
    pub(crate) fn names(&self) -> Vec<(&str, &str)> {
        let has = |name: &str| self.measures.iter().any(|measure| measure.name == name);
        let definitions = palpate_exercise::register::definitions();
        definitions.filter(|definition| has(definition.name)).map(|known| (known.name, known.unit)).collect()
    }

    /// Returns a table for a terminal: a row for each measure, a column for all tools, and one for each tool.
    pub(crate) fn table(&self) -> String {
        let tools = self.tools();
        let mut text = format!("{:<30}{:>14}", "measure", "all tools");
        tools.iter().for_each(|tool| text += &format!("{:>14}", format!("tool {tool}")));
        text += "  unit\n";
        for (name, unit) in self.names() {
            let _ = write!(text, "{name:<30}{:>14}", shown(self.value(name, None)));
            tools.iter().for_each(|tool| text += &format!("{:>14}", shown(self.value(name, Some(*tool)))));
            let _ = writeln!(text, "  {unit}");
        }
        if let Some(ScoredExercise { name, seed, score_percent, criteria, phases, changed_thresholds, .. }) =
            &self.exercise
        {
            let percent = score_percent.map_or("–".to_owned(), |percent| format!("{percent:.1} %"));
            let _ = writeln!(text, "exercise {}, seed {seed}: {percent}", printable(name));
            if !changed_thresholds.is_empty() {
                let names = printable(changed_thresholds.join(", "));
                let _ =
                    writeln!(text, "  not comparable with other scores of the exercise: {names} changed by options");
            }
            for criterion in criteria {
                let (value, earned) = (shown(criterion.value), 100.0 * criterion.earned);
                let _ = writeln!(
                    text,
                    "  {:<28}{value:>14}  {earned:>5.1} % of weight {}",
                    criterion.title(),
                    criterion.weight
                );
            }
            for (index, phase) in phases.iter().enumerate() {
                let (title, time_s) = (printable(&phase.title), phase.time_s(self.rate_hz));
                let _ = writeln!(text, "phase {}, {title}: {} s", index + 1, shown(Some(time_s)));
                for ScoredMeasure { name, value, unit, .. } in phase.of_all_tools() {
                    let _ = writeln!(text, "  {name:<28}{:>14}  {unit}", shown(Some(*value)));
                }
            }
        }
        for crossing in &self.limit_crossings {
            let ScoredCrossing { tool, from_s, to_s, peak, .. } = crossing;
            let ((name, unit), peak) = (crossing.name_and_unit(), shown(Some(*peak)));
            let _ =
                writeln!(text, "above the limit of {name}: tool {tool}, {from_s:.3} s to {to_s:.3} s, {peak}{unit}");
        }
        text
    }

    /// Returns what the score is of, for people.
    pub(crate) fn title(&self) -> String {
        let ScoreSource { scene, script, journal, .. } = &self.source;
        let of = script.as_ref().or(journal.as_ref());
        printable(of.map_or_else(|| scene.clone(), |of| format!("{of} on {scene}")))
    }
}

/// Returns a value with four digits; a dash if there is none.
pub(crate) fn shown(value: Option<f64>) -> String {
    let Some(value) = value else { return "–".to_owned() };
    match value.abs() {
        0.0 => "0".to_owned(),
        size if size >= 10_000.0 => format!("{value:.0}"),
        size if size >= 0.001 => {
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
            let digits = (3.0 - size.log10().floor()).max(0.0) as usize;
            let text = format!("{value:.digits$}");
            if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
        }
        _ => format!("{value:.3e}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shown_value_has_four_digits() {
        for (value, text) in [
            (0.0, "0"),
            (1.0, "1"),
            (0.012_345, "0.01235"),
            (-5.322_03, "-5.322"),
            (123.456, "123.5"),
            (3_612.4, "3612"),
            (123_456.0, "123456"),
            (0.000_012_3, "1.230e-5"),
        ] {
            assert_eq!(shown(Some(value)), text);
        }
    }
}
