//! Frames for viewers: the sheet refined by bilinear interpolation, encoded, in patches.

pub mod encode;
pub mod refine;
mod snapshot;
pub mod tiles;
mod wide;

pub use encode::{Encoding, Frame, encode, encode_over};
pub use refine::{LARGEST_REFINEMENT, Refinement};
pub use snapshot::Snapshot;
pub use tiles::FrameTiles;
