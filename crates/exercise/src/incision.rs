//! How well a cut follows the lines of an exercise, and how well a wound is closed.

use glam::DVec3;

use crate::answers::from_line_m;
use crate::definition::{Figures, MeasureDefinition};

pub(crate) const LINE_CUT_SHARE: MeasureDefinition = MeasureDefinition::of_truth(
    "line_cut_share",
    "1",
    1.0,
    "share of 200 even places of each line that have a severed spring within the line's tolerance, seen along the exercise's direction",
    "Which share of the line was cut.",
);

pub(crate) const LINE_ERROR: MeasureDefinition = MeasureDefinition::of_truth(
    "line_error_rms_m",
    "m",
    f64::INFINITY,
    "√(mean of d²), d the distance of the place at which a spring was severed from the nearest line",
    "How far the cut is from the line.",
);

pub(crate) const OFF_LINE_SHARE: MeasureDefinition = MeasureDefinition::of_truth(
    "off_line_share",
    "1",
    1.0,
    "share of the severed springs that are farther from every line than its tolerance",
    "Which share of the cut is beside the line.",
);

pub(crate) const GAPE: MeasureDefinition = MeasureDefinition::of_truth(
    "gape_max_m",
    "m",
    f64::INFINITY,
    "largest distance between the ends of a severed spring less that at rest, at the end",
    "How far the wound is open at its widest place.",
);

pub(crate) const STITCHES: MeasureDefinition = MeasureDefinition::of_truth(
    "stitches",
    "1",
    f64::INFINITY,
    "threads and clips that hold at the end; with lines, those that cross one between two bites",
    "How many stitches and clips hold.",
);

/// A line that must be cut.
#[derive(Debug, Clone, PartialEq)]
pub struct TargetLine {
    /// Its corners, m; at least two.
    pub points_m: Vec<DVec3>,
    /// How far from it a cut may be, m.
    pub within_m: f64,
}

/// A severed spring at the end of an exercise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeveredPlace {
    /// Where it was severed, on the tissue at rest, m.
    pub rest_m: DVec3,
    /// How much farther its ends are from each other than at rest, m.
    pub opening_m: f64,
}

/// Returns whether the straight way between two places crosses a line, seen along a direction.
pub(crate) fn crosses(line: &TargetLine, ends_m: [DVec3; 2], seen_along: DVec3) -> bool {
    // On which side of the way from `a` to `b` a place is.
    let side = |a: DVec3, b: DVec3, place_m: DVec3| (b - a).cross(place_m - a).dot(seen_along) >= 0.0;
    let [from_m, to_m] = ends_m;
    line.points_m.windows(2).any(|part| {
        side(part[0], part[1], from_m) != side(part[0], part[1], to_m)
            && side(from_m, to_m, part[0]) != side(from_m, to_m, part[1])
    })
}

/// Number of places of a line that are looked at.
const LOOKS: usize = 200;

/// Adds the figures of a cut; those of lines only if there are any.
#[allow(clippy::cast_precision_loss)]
pub(crate) fn figures(lines: &[TargetLine], severed: &[SeveredPlace], seen_along: DVec3, figures: &mut Figures) {
    let widest_m = severed.iter().map(|place| place.opening_m.max(0.0)).reduce(f64::max);
    figures.add(&GAPE, widest_m);
    if lines.is_empty() {
        return;
    }
    let cut: usize = lines.iter().map(|line| looks_cut(line, severed, seen_along)).sum();
    figures.add(&LINE_CUT_SHARE, cut as f64 / (LOOKS * lines.len()) as f64);
    if severed.is_empty() {
        return;
    }
    let (mut squares_m2, mut beside) = (0.0, 0_usize);
    for place in severed {
        let distance_m = |line: &TargetLine| from_line_m(&line.points_m, place.rest_m, seen_along);
        let least_m = lines.iter().map(distance_m).fold(f64::INFINITY, f64::min);
        squares_m2 += least_m * least_m;
        beside += usize::from(lines.iter().all(|line| distance_m(line) > line.within_m));
    }
    figures.add(&LINE_ERROR, (squares_m2 / severed.len() as f64).sqrt());
    figures.add(&OFF_LINE_SHARE, beside as f64 / severed.len() as f64);
}

/// Returns at how many even places of a line something is severed.
#[allow(clippy::cast_precision_loss)]
fn looks_cut(line: &TargetLine, severed: &[SeveredPlace], seen_along: DVec3) -> usize {
    let lengths_m: Vec<f64> = line.points_m.windows(2).map(|ends| ends[0].distance(ends[1])).collect();
    let length_m: f64 = lengths_m.iter().sum();
    let mut found = 0;
    for look in 0..LOOKS {
        let mut left_m = length_m * (look as f64 + 0.5) / LOOKS as f64;
        let mut part = 0;
        while part + 1 < lengths_m.len() && left_m > lengths_m[part] {
            left_m -= lengths_m[part];
            part += 1;
        }
        let at_m = line.points_m[part].lerp(line.points_m[part + 1], (left_m / lengths_m[part]).min(1.0));
        let is_near =
            |place: &SeveredPlace| (place.rest_m - at_m).reject_from_normalized(seen_along).length() <= line.within_m;
        found += usize::from(severed.iter().any(is_near));
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cut(from_m: f64, to_m: f64, beside_m: f64) -> Vec<SeveredPlace> {
        let at = |k: u32| from_m + (to_m - from_m) * f64::from(k) / 60.0;
        (0..=60)
            .map(|k| SeveredPlace { rest_m: DVec3::new(at(k), beside_m, -0.004), opening_m: 1e-4 * at(k) })
            .collect()
    }

    fn value(severed: &[SeveredPlace], name: &str) -> Option<f64> {
        let line = TargetLine {
            points_m: vec![DVec3::ZERO, DVec3::new(0.01, 0.0, 0.0), DVec3::new(0.03, 0.0, 0.0)],
            within_m: 0.002,
        };
        let mut all = Figures::of(None);
        figures(&[line], severed, DVec3::NEG_Z, &mut all);
        all.list.iter().find(|figure| figure.definition.name == name).map(|figure| figure.value)
    }

    #[test]
    fn a_stitch_crosses_a_line_between_bites_on_both_sides_of_it() {
        let line = TargetLine { points_m: vec![DVec3::ZERO, DVec3::new(0.03, 0.0, 0.0)], within_m: 0.002 };
        let at = |x_m: f64, y_m: f64| DVec3::new(x_m, y_m, 0.1 * x_m);
        for (ends_m, expected) in [
            ([at(0.01, -0.004), at(0.012, 0.004)], true),
            ([at(0.01, 0.002), at(0.012, 0.004)], false),
            ([at(-0.01, -0.004), at(-0.01, 0.004)], false),
        ] {
            assert_eq!(crosses(&line, ends_m, DVec3::NEG_Z), expected, "{ends_m:?}");
        }
    }

    #[test]
    fn a_cut_along_the_line_has_no_error_and_one_beside_it_has_its_distance() {
        let near = |severed: &[SeveredPlace], name: &str, expected: f64, tolerance: f64| {
            let value = value(severed, name).unwrap();
            assert!((value - expected).abs() <= tolerance, "{name}: {value} instead of {expected}");
        };
        let whole = cut(0.0, 0.03, 0.0);
        near(&whole, "line_cut_share", 1.0, 0.0);
        near(&whole, "line_error_rms_m", 0.0, 1e-12);
        near(&whole, "off_line_share", 0.0, 0.0);
        near(&whole, "gape_max_m", 3e-6, 1e-12);
        // Half of it, and as far as the tolerance beyond.
        near(&cut(0.0, 0.015, 0.0), "line_cut_share", 17.0 / 30.0, 0.006);
        let beside = cut(0.0, 0.03, 0.003);
        near(&beside, "line_error_rms_m", 0.003, 1e-12);
        near(&beside, "off_line_share", 1.0, 0.0);
        near(&beside, "line_cut_share", 0.0, 0.0);
        near(&[], "line_cut_share", 0.0, 0.0);
        assert_eq!(value(&[], "gape_max_m"), None);
        assert_eq!(value(&[], "line_error_rms_m"), None);
    }
}
