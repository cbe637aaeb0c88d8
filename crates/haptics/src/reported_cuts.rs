//! What a server reports of the cuts in its tissue to a client that has a copy of it ([`crate::Predictor::follow_cuts`]).

/// A severed spring, by its name in a snapshot of the tissue.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReportedSpring {
    /// The place in memory of its first end.
    pub place: u32,
    /// Its number among the springs of that end; `u32::MAX` for its anchor spring.
    pub number: u32,
    /// Where it was severed: the part of the way from the first end to the other, 0 to 1.
    pub part: f64,
}

impl ReportedSpring {
    /// Returns its place and its number, which tell it from all others.
    pub fn name(&self) -> (u32, u32) {
        (self.place, self.number)
    }
}

/// The severed springs of a tissue, or those since a report before.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ReportedCuts {
    /// The version of the topology that the springs make complete: 0 if nothing was ever severed. It only grows.
    pub version: u32,
    /// Whether the springs are added to those of earlier reports; otherwise they are all that are severed.
    pub continues: bool,
    /// The springs, in the order in which they were severed.
    pub springs: Vec<ReportedSpring>,
}
