//! What an exercise asks, and what a trainee left at its end: the input of the measures that need a truth.

use glam::DVec3;

use crate::answers::{AnswerRules, HiddenTarget, MarkedPlace};
use crate::definition::{Figure, Figures};
use crate::incision::{self, STITCHES, SeveredPlace, TargetLine};
use crate::tasks::TaskMeasures;

/// The truth of an exercise beside what is there at its end.
#[derive(Debug, Clone, PartialEq)]
pub struct ExerciseTruth {
    /// The direction along which distances do not count, of length 1.
    pub seen_along: DVec3,
    /// What is hidden.
    pub targets: Vec<HiddenTarget>,
    /// How answers are judged; `None` for an exercise without hidden targets.
    pub rules: Option<AnswerRules>,
    /// The marked places.
    pub answers: Vec<MarkedPlace>,
    /// The lines that must be cut.
    pub lines: Vec<TargetLine>,
    /// What is severed.
    pub severed: Vec<SeveredPlace>,
    /// The bites of threads and clips that hold, at rest, m.
    pub stitches_m: Vec<Vec<DVec3>>,
}

impl ExerciseTruth {
    /// Returns the figures that need the truth, with those of `tasks`. `rate_hz` is the number of steps per second.
    #[allow(clippy::cast_precision_loss)]
    pub fn figures(&self, rate_hz: f64, tasks: &TaskMeasures) -> Vec<Figure> {
        let mut figures = Figures::of(None);
        if let Some(rules) = &self.rules {
            rules.judge(&self.targets, &self.answers).figures(&mut figures);
        }
        incision::figures(&self.lines, &self.severed, self.seen_along, &mut figures);
        let crosses = |bites_m: &&Vec<DVec3>| {
            let across = |ends: &[DVec3]| {
                self.lines.iter().any(|line| incision::crosses(line, [ends[0], ends[1]], self.seen_along))
            };
            self.lines.is_empty() || bites_m.windows(2).any(across)
        };
        figures.add(&STITCHES, self.stitches_m.iter().filter(crosses).count() as f64);
        tasks.figures(rate_hz, &mut figures);
        figures.list
    }
}
