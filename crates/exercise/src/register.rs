//! The register: all measures, in the order in which they are told.

use crate::definition::MeasureDefinition;
use crate::{answers, coverage, detection, force, hands, incision, jerk, limit, path, press, sparc, tasks, time};

const DEFINITIONS: [&MeasureDefinition; 43] = [
    &time::TIME,
    &time::CONTACT_TIME,
    &time::IDLE_TIME,
    &path::PATH_LENGTH,
    &path::ECONOMY,
    &path::MEAN_SPEED,
    &path::PEAK_SPEED,
    &jerk::LOG_DIMENSIONLESS_JERK,
    &sparc::SPARC,
    &force::PEAK_FORCE,
    &force::MEAN_FORCE,
    &force::FORCE_INTEGRAL,
    &force::FORCE_DERIVATIVE,
    &limit::FORCE_ABOVE_LIMIT,
    &limit::PRESSURE_ABOVE_LIMIT,
    &limit::STRAIN_ABOVE_LIMIT,
    &force::PEAK_PRESSURE,
    &force::PEAK_INDENTATION,
    &force::PEAK_STRAIN,
    &force::WORK,
    &press::PRESS_COUNT,
    &press::MEAN_PRESS_TIME,
    &press::SEARCH_TIME,
    &hands::HAND_BALANCE,
    &hands::BIMANUAL_IDLE,
    &coverage::COVERAGE,
    &coverage::COVERED_AREA,
    &answers::HITS,
    &answers::MISSES,
    &answers::HITS_SHARE,
    &answers::FALSE_ALARMS,
    &detection::D_PRIME,
    &answers::PLACE_ERROR,
    &answers::SIZE_ERROR,
    &incision::LINE_CUT_SHARE,
    &incision::LINE_ERROR,
    &incision::OFF_LINE_SHARE,
    &incision::GAPE,
    &incision::STITCHES,
    &tasks::AVOIDED_CONTACT,
    &tasks::AVOIDED_FORCE,
    &tasks::LIFT_HEIGHT,
    &tasks::HELD_SHARE,
];

/// The first of the measures that need the truth of an exercise: they follow those that need none.
const FIRST_OF_TRUTH: usize = 27;

/// Returns the definitions of all measures. [`Measures`](crate::Measures) gives the first of them, and
/// [`ExerciseTruth`](crate::ExerciseTruth) those that need the truth of an exercise ([`needs_truth`]).
pub fn definitions() -> impl Iterator<Item = &'static MeasureDefinition> {
    DEFINITIONS.into_iter()
}

/// Returns whether a measure needs the truth of an exercise.
pub fn needs_truth(definition: &MeasureDefinition) -> bool {
    DEFINITIONS[FIRST_OF_TRUTH..].iter().any(|of_truth| of_truth.name == definition.name)
}

/// Returns the measure of a name; `None` if there is none.
pub fn find(name: &str) -> Option<&'static MeasureDefinition> {
    definitions().find(|definition| definition.name == name)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use glam::DVec3;

    use super::*;
    use crate::input::{MeasureOptions, PressedDisc, ToolRow};
    use crate::limit::ToolLimits;
    use crate::measures::Measures;

    /// The row of a measure in the guide.
    fn row(definition: &MeasureDefinition) -> String {
        let MeasureDefinition { name, unit, scope, range: [least, most], formula, source, .. } = definition;
        let scope = match scope {
            crate::Scope::Tool => "tool",
            crate::Scope::Total => "all",
            crate::Scope::Both => "both",
        };
        let bound = |bound: f64, open: &str| if bound.is_finite() { bound.to_string() } else { open.to_owned() };
        let formula = formula.replace('|', "\\|");
        format!(
            "| `{name}` | {unit} | {scope} | {} … {} | {formula} | {source} |",
            bound(*least, "−∞"),
            bound(*most, "∞")
        )
    }

    #[test]
    fn the_guide_has_each_measure_with_its_formula_and_source() {
        let guide = include_str!("../../../docs/exercises.md");
        let missing: Vec<String> = definitions().map(row).filter(|row| !guide.contains(row)).collect();
        assert!(missing.is_empty(), "docs/exercises.md has no such rows:\n{}", missing.join("\n"));
    }

    #[test]
    fn every_measure_has_a_figure_within_its_range_and_no_name_comes_twice() {
        let corner = |x: f64, y: f64| DVec3::new(x, y, 0.0);
        let surface = [[corner(0.0, 0.0), corner(0.1, 0.0), corner(0.0, 0.1)]];
        let limits = ToolLimits { force_n: Some(1.0), pressure_pa: Some(1e3), strain: Some(0.1) };
        let options = MeasureOptions { limits, ..MeasureOptions::default() };
        let mut measures = Measures::new(500.0, 0, options, surface.into_iter());
        let mut random = fastrand::Rng::with_seed(5);
        for _ in 0..3000 {
            let mut rows: Vec<ToolRow> = Vec::new();
            for tool in [3, 7] {
                let mut number = || 2.0 * random.f64() - 1.0;
                let (place_m, force_n) =
                    (0.1 * DVec3::new(number(), number(), number()), DVec3::new(number(), 0.0, 1.0));
                let is_in_contact = number() > 0.0;
                let disc =
                    PressedDisc { rest_m: place_m, normal: DVec3::Z, radius_m: 0.05, pressure_pa: 4e3 * number() };
                let (indentation_m, disc, strain) = (number(), Some(disc), Some(number().max(0.0)));
                let row = ToolRow { tool, place_m, force_n, is_in_contact, indentation_m, disc, strain };
                rows.extend((number() > -0.9).then_some(row));
            }
            measures.step(&rows);
        }
        let mut told: BTreeSet<&str> =
            definitions().filter(|definition| needs_truth(definition)).map(|definition| definition.name).collect();
        assert!(told.len() == 16 && told.contains("d_prime") && !told.contains("work_j"), "{told:?}");
        for figure in measures.figures() {
            let MeasureDefinition { name, scope, range: [least, most], .. } = figure.definition;
            assert!((*least..=*most).contains(&figure.value), "{name}: {}", figure.value);
            let expected = if figure.tool.is_some() { crate::Scope::Tool } else { crate::Scope::Total };
            assert!(*scope == crate::Scope::Both || *scope == expected, "{name} of {:?}", figure.tool);
            told.insert(*name);
        }
        let all: Vec<&str> = definitions().map(|definition| definition.name).collect();
        assert_eq!(all.len(), all.iter().collect::<BTreeSet<_>>().len());
        assert_eq!(told, all.into_iter().collect());
    }
}
