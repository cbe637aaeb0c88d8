//! Two hands of one client: the loop of each device tells the other where its tools are. So the copy of the tissue of each has the
//! tools of both at once, and their instruments push each other apart. Neither waits for the other.

use std::fmt;

use palpate_haptics::prediction::MAX_OTHERS;
use palpate_haptics::{OtherTool, SecondHand};

use crate::exchange::{NewestReader, NewestWriter, newest};

/// What a hand tells the other.
#[derive(Clone, Copy)]
struct HandTools {
    /// Its tools, at most [`MAX_OTHERS`]; the rest is `None`.
    tools: [Option<OtherTool>; MAX_OTHERS],
    /// Itself with its instrument; `None` if it leads a single tip.
    hand: Option<SecondHand>,
}

const NO_TOOLS: HandTools = HandTools { tools: [None; MAX_OTHERS], hand: None };

/// One of two hands, for [`super::Options::hand`]. Each leads a tool of its own, or an instrument, in the same session.
pub struct BridgeHand {
    own: NewestWriter<HandTools>,
    other: NewestReader<HandTools>,
}

/// Creates the two hands of one client.
pub fn two_hands() -> [BridgeHand; 2] {
    let (to_right, from_left) = newest(&NO_TOOLS);
    let (to_left, from_right) = newest(&NO_TOOLS);
    [BridgeHand { own: to_right, other: from_right }, BridgeHand { own: to_left, other: from_left }]
}

impl BridgeHand {
    /// Tells the other hand where the tools of this one are; none while it has none. Beyond [`MAX_OTHERS`] the last are left out.
    /// `hand` is this one with its instrument.
    pub(super) fn tell(&mut self, tools: impl Iterator<Item = OtherTool>, hand: Option<SecondHand>) {
        self.own.write(|told| {
            *told = HandTools { hand, ..NO_TOOLS };
            told.tools.iter_mut().zip(tools).for_each(|(place, tool)| *place = Some(tool));
        });
    }

    /// Returns the other hand with its instrument, and its tools.
    pub(super) fn other(&mut self) -> (Option<SecondHand>, impl Iterator<Item = OtherTool>) {
        self.other.refresh();
        let told = self.other.read();
        (told.hand, told.tools.iter().map_while(|tool| *tool))
    }
}

impl Drop for BridgeHand {
    fn drop(&mut self) {
        self.tell(std::iter::empty(), None);
    }
}

impl fmt::Debug for BridgeHand {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("BridgeHand").finish_non_exhaustive()
    }
}
