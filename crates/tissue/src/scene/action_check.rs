//! Checks of tool actions, in scripts and in commands.

use glam::DVec3;
use palpate_haptics::{Coupling, Tip, TipShape};

use super::action::PlaceMark;
use super::profile::Poke;
use super::tie::{Bite, MAX_BITES, Tie, TieKind};
use crate::limits::Limits;
use crate::shape::{PointId, RestShape};
use palpate_refusal::{Reason, Refusal, Result, finite, finite_vector, legible, not_negative, number, positive};

/// Checks a physical value of a scene. Squares and products of values in this range stay within single
/// precision.
pub(super) fn physical(field: &str, value: f64) -> Result<f64> {
    number(field, value, "from 1e-12 to 1e12", |v| (1e-12..=1e12).contains(&v))
}

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

/// Checks a force: its values, its place and its strength.
///
/// # Errors
/// Refuses a falloff that is negative, a value that is not finite, a strength |force|·e^{c′} above the limit
/// `point_force_n` ([`Reason::ForceTooLarge`]), and a place that is not near the tissue ([`Reason::OffTissue`],
/// [`RestShape::is_near`]). Fields are `force.falloff_per_m`, `force.falloff_offset`, `force.centre_m` and
/// `force.force_n`.
pub fn check_poke(poke: &Poke, shape: &dyn RestShape, limits: &Limits) -> Result<()> {
    not_negative("force.falloff_per_m", poke.falloff_per_m)?;
    finite("force.falloff_offset", poke.falloff_offset)?;
    shape.check_place("force.centre_m", poke.centre_m)?;
    check_force("force.force_n", poke.force_n, libm::exp(poke.falloff_offset), limits.point_force_n)
}

/// Checks the length of a displacement of a grasped point, or of the way from the middle of the tissue to a
/// tip, m.
///
/// # Errors
/// Refuses a length that is not finite, or above the limit `reach_in_sides` times the tissue's longest side
/// ([`Reason::OutOfRange`]); `field` is the key that the refusal gives.
pub fn check_reach(field: &str, shape: &dyn RestShape, displacement_m: f64, limits: &Limits) -> Result<()> {
    let limit_m = shape.longest_side_m() * limits.reach_in_sides;
    let range = format!("at most {} m from the rest position", legible(limit_m));
    number(field, displacement_m, &range, |v| v <= limit_m).map_err(in_millimetres(displacement_m, limit_m))?;
    Ok(())
}

/// Adds to the refusal of a length the question whether it is in millimetres, if it would then be within the
/// limit.
fn in_millimetres(length_m: f64, limit_m: f64) -> impl Fn(Refusal) -> Refusal {
    let might_be = length_m > limit_m && length_m * 1e-3 <= limit_m;
    move |refusal| {
        let hint = if might_be { " m; millimetres? All lengths are in metres" } else { "" };
        Refusal { message: refusal.message + hint, ..refusal }
    }
}

/// Checks that a point of the tissue can be grasped. Panics if `shape` has no such point.
///
/// # Errors
/// Refuses a fixed point ([`Reason::OutOfRange`]); `field` is the key that the refusal gives.
pub fn check_free(field: &str, shape: &dyn RestShape, point: PointId) -> Result<()> {
    if shape.is_fixed(point) {
        let message = format!("{} is fixed, and can't be grasped", shape.name(point));
        return Err(Refusal::new(Reason::OutOfRange, field, message));
    }
    Ok(())
}

/// Checks the edge of a blade; no other tip has one.
fn check_edge(field: &str, shape: &dyn RestShape, tip: &Tip) -> Result<()> {
    let edge = format!("{field}.edge_m");
    if tip.shape != TipShape::Blade {
        let text = "is for a \"blade\"; other tips have no edge";
        return if tip.edge_m == DVec3::ZERO { Ok(()) } else { Err(Refusal::new(Reason::WrongKind, edge, text)) };
    }
    let most_m = shape.longest_side_m();
    let range = format!("above 0 and at most {} m long, the tissue's longest side", legible(most_m));
    // A turned edge may be longer by rounding.
    number(&edge, tip.edge_m.length(), &range, |length_m| length_m > 0.0 && length_m <= most_m * (1.0 + 1e-9))?;
    let refuse = |key: &str, text: &str| Err(Refusal::new(Reason::WrongKind, format!("{field}.{key}"), text));
    if tip.grasps {
        return refuse("grasps", "is for a tip that holds: a blade cuts");
    }
    if tip.coupling != Coupling::Constraint {
        return refuse("spring", "is for a tip that touches: a blade cuts");
    }
    Ok(())
}

/// Largest radius of a bite, in distances between points: a session may have a thousand of them.
const MAX_BITE_EDGES: f64 = 8.0;

/// The longest time of contact that a tip may take to sever, s.
const MAX_BURN_S: f64 = 3600.0;

/// Checks that a tip that burns is no blade: a sheet or a surface takes only discs besides.
fn check_burning(field: &str, tip: &Tip) -> Result<()> {
    let field = format!("{field}.burn_s");
    let range = format!("from 0 to {MAX_BURN_S}");
    number(&field, tip.burn_s, &range, |burn_s| (0.0..=MAX_BURN_S).contains(&burn_s))?;
    if tip.burn_s > 0.0 && tip.shape == TipShape::Blade {
        return Err(Refusal::new(Reason::WrongKind, field, "is for a tip that touches: a blade does not burn"));
    }
    Ok(())
}

/// Least radius of a rigid tip, in edges of a cell.
const MIN_RIGID_RADIUS: f64 = 0.25;

/// Checks that a tip suits the tissue: radius, friction, coupling, edge and burning.
///
/// # Errors
/// Refuses a value that is not finite or out of range: a radius must be above 0 and at most the tissue's
/// longest side, and on a mesh at most 32 mean edge lengths; friction is from 0 to 10; a coupling spring has a
/// stiffness from 1e-12 to 1e12 N/m and a damping from 0 to 1e12 N·s/m. `field` is the tip's key: the refusal
/// gives `{field}.radius_m` and the like. A rigid shape is for solids, from a quarter of
/// a cell on, without a grasp and without a spring. A blade has an edge and neither of these.
pub fn check_tip(field: &str, shape: &dyn RestShape, tip: &Tip) -> Result<()> {
    let (most_m, what) = shape.most_tip_radius_m();
    let range = format!("above 0 and at most {}, {what}", legible(most_m));
    number(&format!("{field}.radius_m"), tip.radius_m, &range, |v| v > 0.0 && v <= most_m)
        .map_err(in_millimetres(tip.radius_m, most_m))?;
    number(&format!("{field}.friction"), tip.friction, "from 0 to 10", |v| (0.0..=10.0).contains(&v))?;
    if tip.shape.is_rigid() {
        let refuse = |message: &str| Err(Refusal::new(Reason::OutOfRange, format!("{field}.shape"), message));
        if !shape.takes_rigid_tips() {
            return refuse("a rigid tip needs a solid: this tissue is touched by a \"disc\"");
        }
        let least_m = MIN_RIGID_RADIUS * shape.edge_m();
        let range = format!("at least {}, a quarter of a cell, for a rigid tip", legible(least_m));
        number(&format!("{field}.radius_m"), tip.radius_m, &range, |radius_m| radius_m >= least_m)?;
        if tip.grasps {
            return refuse("a tip that grasps is a \"disc\"");
        }
        if tip.coupling != Coupling::Constraint {
            return refuse("a tip on a spring is a \"disc\"");
        }
    }
    check_edge(field, shape, tip)?;
    check_burning(field, tip)?;
    if let Coupling::Spring { stiffness_n_per_m, damping_n_s_per_m } = tip.coupling {
        let field = format!("{field}.spring");
        physical(&format!("{field}.stiffness_n_per_m"), stiffness_n_per_m)?;
        let damps = |v| (0.0..=1e12).contains(&v);
        number(&format!("{field}.damping_n_s_per_m"), damping_n_s_per_m, "from 0 to 1e12", damps)?;
    }
    Ok(())
}

/// Checks a tie; `field` is the key that a refusal gives.
///
/// # Errors
/// Refuses a thread with fewer than two bites or more than [`MAX_BITES`], and a clip with another number than two; a bite off the tissue
/// ([`Reason::OffTissue`]), and a radius that no tip may have there; a length that is not above 0 or longer than a tool may reach; a
/// friction that is not from 0 to 10, and a strength that is not from 1e-12 to 1e12 N.
pub fn check_tie(field: &str, shape: &dyn RestShape, tie: &Tie, limits: &Limits) -> Result<()> {
    let Tie { bites, kind, strength_n } = tie;
    let (is_right, range) = match kind {
        TieKind::Thread { .. } => ((2..=MAX_BITES).contains(&bites.len()), format!("2 to {MAX_BITES} for a thread")),
        TieKind::Clip => (bites.len() == 2, "2 for a clip".to_owned()),
    };
    if !is_right {
        let message = format!("has {} bites: must have {range}", bites.len());
        return Err(Refusal::new(Reason::OutOfRange, format!("{field}.bites"), message));
    }
    let most_m = MAX_BITE_EDGES * shape.edge_m();
    for (index, Bite { place_m, radius_m }) in bites.iter().enumerate() {
        let field = format!("{field}.bites[{index}]");
        finite_vector(&format!("{field}.place_m"), *place_m)?;
        shape.check_place(&format!("{field}.place_m"), *place_m)?;
        let range = format!("above 0 and at most {}, {MAX_BITE_EDGES} distances between points", legible(most_m));
        number(&format!("{field}.radius_m"), *radius_m, &range, |v| v > 0.0 && v <= most_m)?;
    }
    if let TieKind::Thread { length_m, friction } = *kind {
        let of_length = format!("{field}.length_m");
        positive(&of_length, length_m)?;
        check_reach(&of_length, shape, length_m, limits)?;
        number(&format!("{field}.friction"), friction, "from 0 to 10", |v| (0.0..=10.0).contains(&v))?;
    }
    strength_n.map_or(Ok(()), |strength_n| physical(&format!("{field}.strength_n"), strength_n).map(drop))
}

/// Checks a mark; `field` is the key that a refusal gives.
///
/// # Errors
/// Refuses a place off the tissue ([`Reason::OffTissue`]), and a diameter that is not above 0 or longer than the tissue's longest side.
pub fn check_mark(field: &str, shape: &dyn RestShape, mark: &PlaceMark) -> Result<()> {
    finite_vector(&format!("{field}.place_m"), mark.place_m)?;
    shape.check_place(&format!("{field}.place_m"), mark.place_m)?;
    let Some(diameter_m) = mark.diameter_m else { return Ok(()) };
    let most_m = shape.longest_side_m();
    let range = format!("above 0 and at most {}, the longest side of the tissue", legible(most_m));
    number(&format!("{field}.diameter_m"), diameter_m, &range, |v| v > 0.0 && v <= most_m).map(drop)
}

/// Checks the number of a tie.
///
/// # Errors
/// Refuses a number that is not below `limits.ties` ([`Reason::TooLarge`]).
pub fn check_tie_number(field: &str, tie: u32, limits: &Limits) -> Result<()> {
    if tie < limits.ties {
        return Ok(());
    }
    let message = format!("is {tie}, but threads and clips are numbered below {} (limits.ties)", limits.ties);
    Err(Refusal::new(Reason::TooLarge, field, message))
}
