//! Numbers and places for people: three digits, in the unit of the file.

use crate::Unit;

/// Returns three digits of a number, without an exponent from a millionth to a million.
#[must_use]
pub fn rounded(number: f64) -> String {
    let text = format!("{number:.2e}");
    let is_short = number == 0.0 || (1e-6..1e6).contains(&number.abs());
    // Without the sign of −0.
    text.parse::<f64>().ok().filter(|_| is_short).map_or(text, |number| (number + 0.0).to_string())
}

/// Returns a length in a unit, with its name.
#[must_use]
pub fn length(length_m: f64, unit: Unit) -> String {
    format!("{} {unit}", rounded(length_m / unit.metres()))
}

/// Returns a place in a unit, with its name.
#[must_use]
pub fn place(place_m: [f64; 3], unit: Unit) -> String {
    let [x, y, z] = place_m.map(|part| rounded(part / unit.metres()));
    format!("({x}, {y}, {z}) {unit}")
}
