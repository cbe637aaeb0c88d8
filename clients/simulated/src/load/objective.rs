//! Objectives of a load test, written like `p99<2ms,dilation>0.999`.

use std::str::FromStr;

use super::tally::LoadOutcome;

/// Reads a quantity from an outcome.
type Quantity = fn(&LoadOutcome) -> f64;

/// The quantities that an objective may bound.
#[allow(clippy::cast_precision_loss)]
const QUANTITIES: &[(&str, Quantity)] = &[
    ("p50", |outcome| outcome.round_trip_us.p50 * 1e-6),
    ("p99", |outcome| outcome.round_trip_us.p99 * 1e-6),
    ("p999", |outcome| outcome.round_trip_us.p999 * 1e-6),
    ("max", |outcome| outcome.round_trip_us.max * 1e-6),
    ("gap_p99", |outcome| outcome.sample_gap_us.p99 * 1e-6),
    ("gap_max", |outcome| outcome.sample_gap_us.max * 1e-6),
    ("frame_age_p99", |outcome| outcome.frame_age_us.p99 * 1e-6),
    ("dilation", |outcome| outcome.dilation_min),
    ("lost", |outcome| outcome.lost as f64),
    ("rejected", |outcome| outcome.rejected as f64),
    // Only plans measure these.
    ("start_p99", |outcome| outcome.start_us.p99 * 1e-6),
    ("turned_away", |outcome| outcome.turned_away as f64),
];

/// One bound of an objective.
#[derive(Debug, Clone)]
struct ObjectiveBound {
    text: String,
    quantity: Quantity,
    is_above: bool,
    /// Bound in s for times; otherwise a plain number.
    bound: f64,
}

/// Objective of a load test: bounds on measured quantities, all of which must hold. It is parsed from a text such as
/// `p99<2ms,dilation>0.999`: times (`p50`, `p99`, `p999` and `max` of round trips, `gap_p99`, `gap_max`,
/// `frame_age_p99`, `start_p99`) with a unit, `us`, `ms` or `s`; `dilation`, `lost`, `rejected` and `turned_away`
/// without one. Other names, or a bound with the wrong kind of unit, are refused with a text that says why.
#[derive(Debug, Clone)]
pub struct Objective(Vec<ObjectiveBound>);

impl FromStr for Objective {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        text.split(',').map(|text| text.trim().parse()).collect::<Result<_, _>>().map(Objective)
    }
}

impl FromStr for ObjectiveBound {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let example = "write `p99<2ms` or `dilation>0.999`";
        let at = text.find(['<', '>']).ok_or_else(|| format!("`{text}` has no < or >: {example}"))?;
        let (name, bound) = (text[..at].trim(), text[at + 1..].trim());
        let Some((_, quantity)) = QUANTITIES.iter().find(|quantity| quantity.0 == name) else {
            let names: Vec<&str> = QUANTITIES.iter().map(|quantity| quantity.0).collect();
            return Err(format!("unknown quantity `{name}`; known are {}", names.join(", ")));
        };
        let units = [("ms", 1e-3), ("us", 1e-6), ("µs", 1e-6), ("s", 1.0)];
        let (number, unit) = units
            .iter()
            .find_map(|(unit, factor)| bound.strip_suffix(unit).map(|number| (number, *factor)))
            .unwrap_or((bound, 1.0));
        let is_time = !["dilation", "lost", "rejected", "turned_away"].contains(&name);
        if is_time == (number.len() == bound.len()) {
            return Err(format!("`{bound}` is not a valid bound of {name}: {example}"));
        }
        let bound = number.trim().parse::<f64>().map_err(|_| format!("`{bound}` is not a number: {example}"))? * unit;
        Ok(ObjectiveBound { text: text.to_owned(), quantity: *quantity, is_above: text.as_bytes()[at] == b'>', bound })
    }
}

impl Objective {
    /// Returns the bounds that an outcome does not meet, as and in the order in which they were written. A quantity
    /// that was not measured meets no bound.
    pub fn missed(&self, outcome: &LoadOutcome) -> Vec<&str> {
        let misses = |bound: &&ObjectiveBound| {
            let value = (bound.quantity)(outcome);
            // NaN, which means not measured, meets no bound.
            let meets = if bound.is_above { value > bound.bound } else { value < bound.bound };
            !meets
        };
        self.0.iter().filter(misses).map(|bound| bound.text.as_str()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::load::tally::Tally;

    #[test]
    fn bounds_have_a_name_a_direction_and_a_unit() {
        for wrong in ["p99", "p98<2ms", "p99<2", "p99<ms", "dilation>1ms", "dilation>", "p99<2ms,,"] {
            assert!(wrong.parse::<Objective>().is_err(), "{wrong}");
        }
        let objective: Objective = "p99<2ms, dilation>0.999,gap_max<500us,lost<1".parse().unwrap();
        let mut outcome = Tally::new().outcome(1);
        outcome.round_trip_us.p99 = 1999.0;
        outcome.sample_gap_us.max = 499.0;
        outcome.dilation_min = 0.9991;
        assert!(objective.missed(&outcome).is_empty());
        outcome.round_trip_us.p99 = 2001.0;
        outcome.dilation_min = f64::NAN;
        outcome.lost = 1;
        assert_eq!(objective.missed(&outcome), ["p99<2ms", "dilation>0.999", "lost<1"]);
    }
}
