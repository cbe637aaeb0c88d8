//! Sleep: parts of a tissue at rest are not computed.

pub(crate) mod criterion;
pub(crate) mod tiles;
