//! Checks of what a tool is asked to do on a sheet, in scripts and in commands.

use glam::{DVec2, DVec3};

use super::Sheet;
use super::law::Poke;
use crate::limits::Limits;
use crate::refusal::{Reason, Refusal, Result, finite, finite_vector, not_negative, number};

/// Refuses a force whose largest value at a point, |force|·e^{c′}, is above the limit.
pub(super) fn check_force(field: &str, force_n: DVec3, factor: f64, limit_n: f64) -> Result<()> {
    finite_vector(field, force_n)?;
    let largest_n = force_n.length() * factor;
    // A force of 0 may have any factor; 0·∞ would be NaN.
    if force_n != DVec3::ZERO && (largest_n.is_nan() || largest_n > limit_n) {
        let message =
            format!("is {largest_n:.6e} N on the control point (|force|·e^offset), above the limit of {limit_n} N");
        return Err(Refusal::new(Reason::ForceTooLarge, field, message));
    }
    Ok(())
}

/// Checks a poke.
///
/// # Errors
/// Refuses a poke that is not finite, too strong, or off the sheet.
pub fn check_poke(poke: &Poke, sheet: &Sheet, limits: &Limits) -> Result<()> {
    not_negative("force.falloff_per_m", poke.falloff_per_m)?;
    finite("force.falloff_offset", poke.falloff_offset)?;
    check_centre("force.centre_m", sheet, poke.centre_m)?;
    check_force("force.force_n", poke.force_n, libm::exp(poke.falloff_offset), limits.point_force_n)
}

/// Checks a displacement of a grasped point.
///
/// # Errors
/// Refuses one beyond the limit.
pub fn check_reach(field: &str, sheet: &Sheet, displacement_m: f64, limits: &Limits) -> Result<()> {
    let limit_m = sheet.longer_side_m() * limits.reach_in_sheets;
    number(field, displacement_m, &format!("at most {limit_m} m from the rest position"), |v| v <= limit_m)?;
    Ok(())
}

/// Checks whether a point can be grasped.
///
/// # Errors
/// Refuses a point that is fixed or not on the sheet.
pub fn check_free(field: &str, sheet: &Sheet, point: [usize; 2]) -> Result<()> {
    sheet.index(field, point)?;
    if sheet.is_fixed(point) {
        let message = format!("[{}, {}] is fixed, and can't be grasped", point[0], point[1]);
        return Err(Refusal::new(Reason::OutOfRange, field, message));
    }
    Ok(())
}

/// Checks a control point. It may be a little off the sheet, because a tool that strokes over the edge is still felt.
///
/// # Errors
/// Refuses a control point farther from the sheet than a tenth of its longer side.
pub fn check_centre(field: &str, sheet: &Sheet, centre_m: DVec2) -> Result<()> {
    for component in centre_m.to_array() {
        finite(field, component)?;
    }
    if !is_near(sheet, centre_m) {
        let DVec2 { x, y } = sheet.extent_m();
        let message = format!(
            "({}, {}) m is off the sheet, which is {x} m × {y} m, by more than a tenth of its longer side",
            centre_m.x, centre_m.y
        );
        return Err(Refusal::new(Reason::OffSheet, field, message));
    }
    Ok(())
}

/// Whether a control point is on the sheet, or off it by at most a tenth of its longer side.
pub fn is_near(sheet: &Sheet, centre_m: DVec2) -> bool {
    let extent_m = sheet.extent_m();
    let margin_m = DVec2::splat(0.1 * sheet.longer_side_m());
    centre_m.cmpge(-margin_m).all() && centre_m.cmple(extent_m + margin_m).all()
}

/// The mass point whose rest position is nearest to a place.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
pub fn nearest_point(sheet: &Sheet, place_m: DVec2) -> [usize; 2] {
    let nearest =
        |place_m: f64, points: usize| (place_m / sheet.spacing_m).round().clamp(0.0, (points - 1) as f64) as usize;
    [nearest(place_m.x, sheet.points[0]), nearest(place_m.y, sheet.points[1])]
}
