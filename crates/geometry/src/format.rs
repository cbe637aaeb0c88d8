//! Formats numbers and places for people: three digits, in the unit of the file.

use crate::Unit;

/// Formats a number with three significant digits, without an exponent from a millionth up to a million (and for 0),
/// otherwise as `1.23e7`.
#[must_use]
pub fn rounded(number: f64) -> String {
    let text = format!("{number:.2e}");
    let is_short = number == 0.0 || (1e-6..1e6).contains(&number.abs());
    // −0 is written without its sign.
    text.parse::<f64>().ok().filter(|_| is_short).map_or(text, |number| (number + 0.0).to_string())
}

/// Formats a length, given in metres, in `unit` with three digits and the unit's name: `12.3 mm`.
#[must_use]
pub fn length(length_m: f64, unit: Unit) -> String {
    format!("{} {unit}", rounded(length_m / unit.metres()))
}

/// Formats a place (x, y, z), given in metres, in `unit` with three digits each and the unit's name: `(1, 2, 3) mm`.
#[must_use]
pub fn place(place_m: [f64; 3], unit: Unit) -> String {
    let [x, y, z] = place_m.map(|part| rounded(part / unit.metres()));
    format!("({x}, {y}, {z}) {unit}")
}
