//! Threads and clips: what ties places of a tissue to each other, as a script or a command gives it.

use glam::DVec3;

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
