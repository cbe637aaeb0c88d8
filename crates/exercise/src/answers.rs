//! Answers of an exercise: which marked places are hits of hidden targets, which are false alarms, and how exact they are.

use glam::{DVec2, DVec3};

use crate::definition::{Figures, MeasureDefinition};
use crate::detection::{D_PRIME, d_prime};

pub(crate) const HITS: MeasureDefinition = MeasureDefinition::of_truth(
    "hits",
    "1",
    f64::INFINITY,
    "targets with a mark within their radius and the tolerance of the exercise, seen along its direction; each mark and each target \
     once, the nearest pairs first",
    "How many hidden lumps were found.",
);

pub(crate) const MISSES: MeasureDefinition = MeasureDefinition::of_truth(
    "misses",
    "1",
    f64::INFINITY,
    "targets that are not hits",
    "How many hidden lumps were not found.",
);

pub(crate) const HITS_SHARE: MeasureDefinition = MeasureDefinition::of_truth(
    "hits_share",
    "1",
    1.0,
    "hits / targets; 1 without a target",
    "Which share of the hidden lumps was found.",
);

pub(crate) const FALSE_ALARMS: MeasureDefinition = MeasureDefinition::of_truth(
    "false_alarms",
    "1",
    f64::INFINITY,
    "marks that are beyond the reach of every target",
    "How many marks were at places without a lump.",
);

pub(crate) const PLACE_ERROR: MeasureDefinition = MeasureDefinition::of_truth(
    "place_error_m",
    "m",
    f64::INFINITY,
    "mean distance of the marks of hits from the centres of their targets, seen along the exercise's direction",
    "How far the marks were from the lumps that they found.",
);

pub(crate) const SIZE_ERROR: MeasureDefinition = MeasureDefinition::of_truth(
    "size_error_m",
    "m",
    f64::INFINITY,
    "mean of |marked diameter − diameter of the target| over the hits with a diameter",
    "How wrong the sizes of the found lumps were estimated.",
);

/// What is hidden: a ball below the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HiddenTarget {
    /// Its centre, m.
    pub centre_m: DVec3,
    /// Its radius, m.
    pub radius_m: f64,
}

/// A marked place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MarkedPlace {
    /// The place, m.
    pub place_m: DVec3,
    /// The diameter that the answer gives, m.
    pub diameter_m: Option<f64>,
}

/// How answers are judged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AnswerRules {
    /// The direction along which distances do not count, of length 1.
    pub seen_along: DVec3,
    /// A mark is a hit up to this far beyond a target's radius, m.
    pub within_m: f64,
    /// Number of places that a trainee could mark, for d′: the area in which targets may be, over that of one target with its
    /// tolerance.
    pub place_count: u32,
}

/// The judgement of all answers.
#[derive(Debug, Clone, PartialEq)]
pub struct JudgedAnswers {
    /// For each target the number of the answer that hit it.
    pub hits: Vec<Option<usize>>,
    /// The numbers of the answers that are false alarms, ascending.
    pub false_alarms: Vec<usize>,
    errors_m: Vec<f64>,
    size_errors_m: Vec<f64>,
    place_count: u32,
}

impl AnswerRules {
    /// Returns the distance of a place from a target's centre, m, seen along the direction.
    fn distance_m(&self, target: &HiddenTarget, answer: &MarkedPlace) -> f64 {
        (answer.place_m - target.centre_m).reject_from_normalized(self.seen_along).length()
    }

    /// Judges answers.
    pub fn judge(&self, targets: &[HiddenTarget], answers: &[MarkedPlace]) -> JudgedAnswers {
        let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
        for (which, target) in targets.iter().enumerate() {
            for (number, answer) in answers.iter().enumerate() {
                let distance_m = self.distance_m(target, answer);
                if distance_m <= target.radius_m + self.within_m {
                    pairs.push((distance_m, which, number));
                }
            }
        }
        pairs.sort_by(|one, other| one.0.total_cmp(&other.0).then(one.1.cmp(&other.1)).then(one.2.cmp(&other.2)));
        let false_alarms = (0..answers.len()).filter(|number| pairs.iter().all(|pair| pair.2 != *number)).collect();
        let (mut hits, mut errors_m, mut size_errors_m) = (vec![None; targets.len()], Vec::new(), Vec::new());
        for (distance_m, which, number) in pairs {
            if hits[which].is_none() && !hits.contains(&Some(number)) {
                hits[which] = Some(number);
                errors_m.push(distance_m);
                let size =
                    answers[number].diameter_m.map(|diameter_m| (diameter_m - 2.0 * targets[which].radius_m).abs());
                size_errors_m.extend(size);
            }
        }
        JudgedAnswers { hits, false_alarms, errors_m, size_errors_m, place_count: self.place_count }
    }
}

/// Returns the number of places that could be marked in a box: its area across a direction over that of a disc of `radius_m`, m, at
/// least 1.
pub fn place_count(from_m: DVec3, to_m: DVec3, seen_along: DVec3, radius_m: f64) -> u32 {
    // The area of the box's shadow: of its three pairs of faces, each by how much it turns to the direction.
    let DVec3 { x, y, z } = (to_m - from_m).abs();
    let area_m2 = DVec3::new(y * z, z * x, x * y).dot(seen_along.abs());
    let places = area_m2 / (std::f64::consts::PI * radius_m * radius_m);
    // Saturating cast.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let places = places as u32;
    places.max(1)
}

impl JudgedAnswers {
    /// Adds the figures.
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation)]
    pub(crate) fn figures(&self, figures: &mut Figures) {
        let (found, all) = (self.hits.iter().flatten().count(), self.hits.len());
        let mean = |values: &[f64]| (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64);
        figures.add(&HITS, found as f64);
        figures.add(&MISSES, (all - found) as f64);
        figures.add(&HITS_SHARE, if all == 0 { 1.0 } else { found as f64 / all as f64 });
        figures.add(&FALSE_ALARMS, self.false_alarms.len() as f64);
        let empty_places = (self.place_count as usize).saturating_sub(all);
        let rejected = empty_places.saturating_sub(self.false_alarms.len());
        let [hits, misses, false_alarms, rejected] =
            [found, all - found, self.false_alarms.len(), rejected].map(|count| count as u32);
        figures.add(&D_PRIME, d_prime(hits, misses, false_alarms, rejected));
        figures.add(&PLACE_ERROR, mean(&self.errors_m));
        figures.add(&SIZE_ERROR, mean(&self.size_errors_m));
    }
}

/// Distance of a place from a line of straight parts, m, seen along a direction.
pub(crate) fn from_line_m(points_m: &[DVec3], place_m: DVec3, seen_along: DVec3) -> f64 {
    let flat = |place_m: DVec3| {
        let (across, beside) = seen_along.any_orthonormal_pair();
        DVec2::new(place_m.dot(across), place_m.dot(beside))
    };
    let at = flat(place_m);
    let of_part = |ends: &[DVec3]| {
        let (from, way) = (flat(ends[0]), flat(ends[1]) - flat(ends[0]));
        let part = ((at - from).dot(way) / way.length_squared()).clamp(0.0, 1.0);
        // A part along the direction is one place.
        let part = if part.is_nan() { 0.0 } else { part };
        at.distance(from + part * way)
    };
    points_m.windows(2).map(of_part).fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;

    const RULES: AnswerRules = AnswerRules { seen_along: DVec3::NEG_Z, within_m: 0.005, place_count: 20 };

    fn target(x_m: f64) -> HiddenTarget {
        HiddenTarget { centre_m: DVec3::new(x_m, 0.0, 0.02), radius_m: 0.006 }
    }

    fn answer(x_m: f64, diameter_m: Option<f64>) -> MarkedPlace {
        MarkedPlace { place_m: DVec3::new(x_m, 0.0, 0.04), diameter_m }
    }

    fn value(judged: &JudgedAnswers, name: &str) -> Option<f64> {
        let mut figures = Figures::of(None);
        judged.figures(&mut figures);
        figures.list.iter().find(|figure| figure.definition.name == name).map(|figure| figure.value)
    }

    #[test]
    fn each_target_is_hit_by_the_nearest_mark_and_a_second_one_there_is_no_false_alarm() {
        let answers =
            [answer(0.008, Some(0.010)), answer(0.003, None), answer(0.05, None), answer(0.0301, Some(0.015))];
        let judged = RULES.judge(&[target(0.0), target(0.03), target(-0.04)], &answers);
        assert_eq!(
            (judged.hits.as_slice(), judged.false_alarms.as_slice()),
            ([Some(1), Some(3), None].as_slice(), [2].as_slice())
        );
        let near = |name: &str, expected: f64| (value(&judged, name).unwrap() - expected).abs() < 1e-12;
        assert!(near("hits", 2.0) && near("misses", 1.0) && near("hits_share", 2.0 / 3.0) && near("false_alarms", 1.0));
        // The depth does not count.
        assert!(near("place_error_m", 0.5 * (0.003 + 0.0001)) && near("size_error_m", 0.003), "{judged:?}");
        // 2 of 3 found, 1 of 17 empty places marked.
        assert!(near("d_prime", d_prime(2, 1, 1, 16)));
    }

    #[test]
    fn without_targets_nothing_is_missed_and_without_answers_nothing_is_found() {
        let judged = RULES.judge(&[], &[answer(0.0, None)]);
        assert_eq!([value(&judged, "hits_share"), value(&judged, "false_alarms")], [Some(1.0), Some(1.0)]);
        let judged = RULES.judge(&[target(0.0)], &[]);
        assert_eq!([value(&judged, "hits_share"), value(&judged, "misses")], [Some(0.0), Some(1.0)]);
        assert_eq!([value(&judged, "place_error_m"), value(&judged, "size_error_m")], [None, None]);
    }

    #[test]
    fn places_of_a_box_are_its_shadow_over_a_disc() {
        let (from_m, to_m) = (DVec3::new(-0.05, -0.05, 0.01), DVec3::new(0.05, 0.05, 0.03));
        assert_eq!(place_count(from_m, to_m, DVec3::NEG_Z, 0.01), 31);
        assert_eq!(place_count(from_m, to_m, DVec3::X, 0.01), 6);
        assert_eq!(place_count(from_m, from_m, DVec3::X, 0.01), 1);
    }

    #[test]
    fn the_distance_from_a_line_is_that_from_its_nearest_part() {
        let line = [DVec3::ZERO, DVec3::new(0.1, 0.0, 0.0), DVec3::new(0.1, 0.1, 0.0)];
        for (place, expected) in [([0.05, 0.01, -0.2], 0.01), ([-0.03, 0.04, 0.0], 0.05), ([0.12, 0.05, 0.0], 0.02)] {
            let found = from_line_m(&line, DVec3::from_array(place), DVec3::NEG_Z);
            assert!((found - expected).abs() < 1e-12, "{place:?}: {found}");
        }
    }
}
