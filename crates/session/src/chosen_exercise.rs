//! An exercise with the hidden truth that was drawn for a session.

use std::sync::Arc;

use palpate_exercise::{MeasureOptions, ToolLimits};
use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::Model;
use palpate_tissue::scene::exercise::{CoverageTask, Exercise, FeltLump, Lump};

/// An exercise and its hidden truth.
#[derive(Debug, Clone)]
pub struct ChosenExercise {
    /// The exercise.
    pub exercise: Exercise,
    /// Its text, TOML.
    pub text: Arc<str>,
    /// The seed from which the truth is drawn.
    pub seed: u64,
    /// The lumps that are hidden.
    pub lumps: Vec<Lump>,
    /// The mean pressure under a tip from which on the lump of its `[coverage]` is felt, Pa; `None` if it has none, and before
    /// [`with_noticed_pressure`](crate::felt_lump::with_noticed_pressure).
    pub noticed_pressure_pa: Option<f64>,
}

impl ChosenExercise {
    /// Reads an exercise from TOML text, which refusals call `name`, and draws its truth from `seed`, or from the exercise's own if there
    /// is none.
    ///
    /// # Errors
    /// Refuses what [`Exercise::parse`] refuses, and a seed for whose lumps the exercise has no room, with the field `seed`.
    pub fn new(name: &str, text: &str, seed: Option<u64>) -> Result<Self> {
        let exercise = Exercise::parse(name, text)?;
        let seed = seed.unwrap_or(exercise.seed);
        let lumps = exercise.lumps(seed).ok_or_else(|| {
            let message = format!("{seed}: the lumps of this seed have no room in their box; take another seed");
            Refusal::new(Reason::OutOfRange, "seed", message)
        })?;
        Ok(ChosenExercise { exercise, text: text.into(), seed, lumps, noticed_pressure_pa: None })
    }

    /// Returns the thresholds of the exercise, where it gives any. That of a lump is [`ChosenExercise::noticed_pressure_pa`].
    pub fn thresholds(&self) -> MeasureOptions {
        let Exercise { limits, coverage, seen_along, .. } = &self.exercise;
        let usual = MeasureOptions::default();
        let coverage_pa = match coverage {
            Some(CoverageTask::Pressure(pressure_pa)) => Some(*pressure_pa),
            Some(CoverageTask::Lump(_)) => self.noticed_pressure_pa,
            None => None,
        };
        MeasureOptions {
            limits: ToolLimits { force_n: limits.force_n, pressure_pa: limits.pressure_pa, strain: limits.strain },
            coverage_pa: coverage_pa.unwrap_or(usual.coverage_pa),
            seen_along: Some(*seen_along),
            ..usual
        }
    }

    /// Returns the lump of its `[coverage]` if the pressure from which on it is felt is not known yet: two presses tell it.
    pub fn lump_to_press(&self) -> Option<&FeltLump> {
        match &self.exercise.coverage {
            Some(CoverageTask::Lump(lump)) if self.noticed_pressure_pa.is_none() => Some(lump),
            _ => None,
        }
    }

    /// Returns the assignments by which a scene gets the hidden lumps.
    pub fn assignments(&self) -> Vec<String> {
        self.exercise.assignments(&self.lumps)
    }

    /// Returns what is doubtful about the exercise in a tissue, as sentences: each hidden lump that it can hardly show, and a phase for which
    /// the time limit leaves no time.
    pub fn warnings(&self, model: &Model) -> Vec<String> {
        let edge_m = model.shape().edge_m();
        let doubt = |(index, lump): (usize, &Lump)| {
            let width_m = 2.0 * lump.radius_m;
            let why = match () {
                () if width_m < edge_m => {
                    format!("is {:.1} mm wide, less than the {:.1} mm between two points", 1e3 * width_m, 1e3 * edge_m)
                }
                () if lump.stiffness_factor == 1.0 => {
                    "has a stiffness_factor of 1, that of the tissue around it".to_owned()
                }
                () => return None,
            };
            Some(format!(
                "exercise {}: lump {} of seed {} {why}: nobody can feel it",
                self.exercise.name,
                index + 1,
                self.seed
            ))
        };
        self.lumps.iter().enumerate().filter_map(doubt).chain(self.phase_without_time()).collect()
    }

    /// Tells the first phase that begins only if the trainee ends those before it early, because these may take all of the exercise's time.
    fn phase_without_time(&self) -> Option<String> {
        let Exercise { name, phases, time_limit_s, .. } = &self.exercise;
        let limit_s = (*time_limit_s)?;
        let mut begins_s = 0.0;
        for (index, phase) in phases.iter().enumerate() {
            if begins_s >= limit_s {
                return Some(format!(
                    "exercise {name}: phase {} begins only if the trainee ends those before it early: they may take {begins_s} s, and the \
                     time limit is {limit_s} s",
                    index + 1
                ));
            }
            // Without a limit of its own, the trainee ends it.
            begins_s += phase.time_limit_s?;
        }
        None
    }

    /// Refuses an exercise or a seed that another one contradicts, which is that of the journal `place`.
    ///
    /// # Errors
    /// Refuses another text, with the field `exercise`, and another seed, with the field `seed`.
    pub fn check_same(&self, recorded: &ChosenExercise, place: &str) -> Result<()> {
        let (what, field) = match (self.text == recorded.text, self.seed == recorded.seed) {
            (true, true) => return Ok(()),
            (false, _) => (format!("exercise `{}`", recorded.exercise.name), "exercise"),
            (true, false) => (format!("seed {}", recorded.seed), "seed"),
        };
        let given = if field == "seed" { self.seed.to_string() } else { self.exercise.name.clone() };
        let message = format!("{given}: the session was made for the {what}, which its journal has; leave this out");
        Err(Refusal { place: Some(place.to_owned()), ..Refusal::new(Reason::OutOfRange, field, message) })
    }
}
