//! Two hands of one client: the loop of each device tells the other where its tool is, so that the copy of the tissue of each has
//! both tools at once. Neither waits for the other.

use std::fmt;

use palpate_haptics::OtherTool;

use crate::exchange::{NewestReader, NewestWriter, newest};

/// One of two hands, for [`super::Options::hand`]. Each leads a tool of its own in the same session.
pub struct BridgeHand {
    own: NewestWriter<Option<OtherTool>>,
    other: NewestReader<Option<OtherTool>>,
}

/// Creates the two hands of one client.
pub fn two_hands() -> [BridgeHand; 2] {
    let (to_right, from_left) = newest(&None);
    let (to_left, from_right) = newest(&None);
    [BridgeHand { own: to_right, other: from_right }, BridgeHand { own: to_left, other: from_left }]
}

impl BridgeHand {
    /// Tells the other hand where the tool of this one is; `None` while it has none.
    pub(super) fn tell(&mut self, tool: Option<OtherTool>) {
        self.own.write(|place| *place = tool);
    }

    /// Returns the tool of the other hand, if it has one.
    pub(super) fn other(&mut self) -> Option<OtherTool> {
        self.other.refresh();
        *self.other.read()
    }
}

impl Drop for BridgeHand {
    fn drop(&mut self) {
        self.tell(None);
    }
}

impl fmt::Debug for BridgeHand {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("BridgeHand").finish_non_exhaustive()
    }
}
