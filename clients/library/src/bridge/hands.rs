//! Two hands of one client: the loop of each device tells the other where its tools are, so that the copy of the tissue of each has
//! the tools of both at once. Neither waits for the other.

use std::fmt;

use palpate_haptics::OtherTool;
use palpate_haptics::prediction::MAX_OTHERS;

use crate::exchange::{NewestReader, NewestWriter, newest};

/// The tools of a hand, at most [`MAX_OTHERS`]; the rest is `None`.
type HandTools = [Option<OtherTool>; MAX_OTHERS];

/// One of two hands, for [`super::Options::hand`]. Each leads a tool of its own, or an instrument, in the same session.
pub struct BridgeHand {
    own: NewestWriter<HandTools>,
    other: NewestReader<HandTools>,
}

/// Creates the two hands of one client.
pub fn two_hands() -> [BridgeHand; 2] {
    let (to_right, from_left) = newest(&[None; MAX_OTHERS]);
    let (to_left, from_right) = newest(&[None; MAX_OTHERS]);
    [BridgeHand { own: to_right, other: from_right }, BridgeHand { own: to_left, other: from_left }]
}

impl BridgeHand {
    /// Tells the other hand where the tools of this one are; none while it has none. Beyond [`MAX_OTHERS`] the last are left out.
    pub(super) fn tell(&mut self, tools: impl Iterator<Item = OtherTool>) {
        self.own.write(|places| {
            *places = [None; MAX_OTHERS];
            places.iter_mut().zip(tools).for_each(|(place, tool)| *place = Some(tool));
        });
    }

    /// Returns the tools of the other hand.
    pub(super) fn other(&mut self) -> impl Iterator<Item = OtherTool> {
        self.other.refresh();
        self.other.read().iter().map_while(|tool| *tool)
    }
}

impl Drop for BridgeHand {
    fn drop(&mut self) {
        self.tell(std::iter::empty());
    }
}

impl fmt::Debug for BridgeHand {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("BridgeHand").finish_non_exhaustive()
    }
}
