//! Tables for terminals, with a name and a value with its unit on each line, and progress bars.

use std::io::IsTerminal;

use indicatif::{ProgressBar, ProgressStyle};
use palpate_refusal::printable::printable;

/// Returns a progress bar with a template of indicatif; it is hidden without a terminal or if it is not wanted.
pub(crate) fn progress_bar(template: &str, length: u64, quiet: bool) -> ProgressBar {
    if quiet || !std::io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template(template);
    ProgressBar::new(length).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
}

/// Prints rows of name and value.
pub(crate) fn print(rows: &[(&str, String)]) {
    crate::tell!("{}", text(rows));
}

/// Returns the rows as text with aligned values.
fn text(rows: &[(&str, String)]) -> String {
    let width = rows.iter().map(|row| row.0.chars().count()).max().unwrap_or(0);
    let lines: Vec<String> = rows.iter().map(|(name, value)| format!("{name:<width$}  {}", printable(value))).collect();
    lines.join("\n")
}

/// Formats a number with three significant digits.
pub(crate) fn rounded(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return format!("{value}").replace("-0", "0");
    }
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let decimals = (2.0 - value.abs().log10().floor()).clamp(0.0, 12.0) as usize;
    let text = format!("{value:.decimals$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

/// Formats a number with its unit, such as "3.5 mN". A value below a billionth counts as 0.
pub(crate) fn with_unit(value: f64, unit: &str) -> String {
    let scales = [(1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n")];
    match scales.into_iter().find(|(scale, _)| value.abs() >= *scale) {
        Some((scale, prefix)) => format!("{} {prefix}{unit}", rounded(value / scale)),
        None => format!("0 {unit}"),
    }
}

/// Formats a fraction in per cent.
pub(crate) fn percent(fraction: f64) -> String {
    format!("{} %", rounded(100.0 * fraction))
}

/// Formats the numbers of ticks in which each limit acted; limits that did not act are left out.
pub(crate) fn acted<'n>(counts: impl IntoIterator<Item = (&'n str, u64)>) -> String {
    let acted = counts.into_iter().filter(|(_, ticks)| *ticks > 0);
    let acted: Vec<String> =
        acted.map(|(name, ticks)| format!("{} in {ticks} ticks", name.replace('_', " "))).collect();
    if acted.is_empty() { "none".to_owned() } else { acted.join(", ") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_three_digits_and_a_unit() {
        for (value, expected) in
            [(0.0, "0"), (1.0, "1"), (1234.5, "1234"), (99.96, "99.96"), (0.012_345, "0.0123"), (-2.5, "-2.5")]
        {
            let found = rounded(value);
            let close = (found.parse::<f64>().unwrap() - value).abs() <= 0.005 * value.abs();
            assert!(close && found.len() <= expected.len() + 1, "{value}: {found}");
        }
        assert_eq!(with_unit(1.5, "N"), "1.5 N");
        assert_eq!(with_unit(-3.456e-7, "J"), "-346 nJ");
        assert_eq!(with_unit(0.0621, "N"), "62.1 mN");
        assert_eq!(with_unit(1e-15, "J"), "0 J");
        assert_eq!(percent(0.004_567), "0.457 %");
    }

    #[test]
    fn values_are_one_below_the_other_and_what_did_not_act_is_left_out() {
        assert_eq!(text(&[("a", "1".to_owned()), ("long", "2".to_owned())]), "a     1\nlong  2");
        assert_eq!(acted([("force", 0), ("not_finite", 3)]), "not finite in 3 ticks");
        assert_eq!(acted([("force", 0)]), "none");
    }
}
