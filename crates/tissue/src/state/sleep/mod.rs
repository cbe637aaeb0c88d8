//! Sleep: parts of a tissue that are at rest are not computed.

pub(crate) mod criterion;
pub(crate) mod tiles;
