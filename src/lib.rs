//! Palpate: a server for touching soft tissue over a network. ARCHITECTURE.md is the overview of its code.
//!
//! **Determinism.** The same scene, commands and steps give the same bits on every processor, lane width, thread
//! count and schedule. The kernel uses only operations that IEEE 754 rounds exactly, in one order for each point;
//! exponentials and sines come from the crate `libm`, not from the platform. No control register of the processor is
//! changed. `state_hash` is XXH3-128 over displacements and increments of all points; `tests/determinism.rs` keeps
//! golden values.

pub mod render;
pub mod server;
