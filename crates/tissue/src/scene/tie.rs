//! Threads and clips: what ties places of a tissue to each other, as a script or a command gives it.

use glam::DVec3;

use super::action_check::{check_reach, physical};
use crate::limits::Limits;
use crate::shape::RestShape;
use palpate_refusal::{Reason, Refusal, Result, finite_vector, legible, number, positive};

/// The most bites of a thread.
pub const MAX_BITES: usize = 16;

/// A place at which a thread goes through the tissue, or a clip holds it: a disc that moves with the tissue.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bite {
    /// The place of the rest surface nearest to this is the middle of the disc, m, in the tissue's frame.
    pub place_m: DVec3,
    /// Radius of the disc over which the force is spread, m.
    pub radius_m: f64,
}

/// A tie between places of a tissue: a thread through two or more bites, or a clip on two. It only holds what is there, so its forces
/// add up to 0.
#[derive(Debug, Clone, PartialEq)]
pub struct Tie {
    /// The bites, in the order in which the thread goes through them.
    pub bites: Vec<Bite>,
    /// What ties them.
    pub kind: TieKind,
    /// Tension at which it breaks, N; `None` if it never does.
    pub strength_n: Option<f64>,
}

/// What ties the bites of a [`Tie`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TieKind {
    /// A thread, which pulls and never pushes. Its ends are held at the first and the last bite, and it slides through those between.
    Thread {
        /// Its length from the first bite to the last, m. It is drawn in, at its last bite, until it has this length.
        length_m: f64,
        /// Coefficient μ of friction between thread and tissue. At a bite at which the thread turns by the angle θ, the tensions of both
        /// sides differ by a factor of at most e^{μθ} (Euler, 1769; Eytelwein, 1808).
        friction: f64,
    },
    /// A clip, which closes, and then holds its two bites at one place.
    Clip,
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
    let (most_m, what) = shape.most_tip_radius_m();
    for (index, Bite { place_m, radius_m }) in bites.iter().enumerate() {
        let field = format!("{field}.bites[{index}]");
        finite_vector(&format!("{field}.place_m"), *place_m)?;
        shape.check_place(&format!("{field}.place_m"), *place_m)?;
        let range = format!("above 0 and at most {}, {what}", legible(most_m));
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
