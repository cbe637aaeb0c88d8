//! What pages and pictures of this program share: text in markup, and the marks of axes.

use palpate_refusal::printable::printable;

/// Returns a text without what HTML and SVG would act on.
pub(super) fn escaped(text: &str) -> String {
    let mut safe = String::new();
    for letter in printable(text).chars() {
        match letter {
            '&' => safe += "&amp;",
            '<' => safe += "&lt;",
            '>' => safe += "&gt;",
            '"' => safe += "&quot;",
            other => safe.push(other),
        }
    }
    safe
}

/// Returns a round distance between about `count` marks of an axis up to `most`.
pub(super) fn mark_distance(most: f64, count: f64) -> f64 {
    let rough = most / count;
    let power = libm::pow(10.0, rough.log10().floor());
    let steps = [1.0, 2.0, 5.0, 10.0];
    power * steps.into_iter().find(|step| step * power >= rough).unwrap_or(10.0)
}
