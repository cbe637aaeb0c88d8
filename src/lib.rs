//! Palpate: a server for touching soft tissue over a network. ARCHITECTURE.md is the map.
//!
//! **Determinism.** The same scene, commands and steps give the same bits, on every processor, lane width, thread count and
//! schedule. The kernel uses only operations that IEEE 754 rounds exactly, in one order for each point; exponentials and sines
//! come from the crate `libm`, not from the platform. No control register of the processor is touched. `state_hash` is XXH3-128
//! over displacements and increments of all points; `tests/determinism.rs` keeps golden values.

pub mod arguments;
pub mod budget;
pub mod cluster;
pub mod files;
pub mod force_law;
mod ids;
pub mod journal;
pub mod limits;
mod lock;
pub mod memory;
pub mod priority;
pub mod realtime;
pub mod render;
pub mod scene;
pub mod server;
pub mod session;
pub mod shape;
pub mod surface;
pub mod texture;
pub mod tissue;
pub mod wire;

// The error of refused inputs, which is also the protocol's.
pub use palpate_proto::refusal;
// How text of others reaches a terminal or a log.
pub use palpate_proto::printable;
