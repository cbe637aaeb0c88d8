//! Simulated users of a Palpate server: what their hands do, what networks they are behind, and what a server bears of them.
//!
//! [`load`] lets many use a server and counts how it copes. [`task`] is what a hand does, [`network`] when what is sent arrives,
//! [`relay`] such a network on this machine, [`random`] the dice of all of these. [`scene_file`] gives scenes to a server.

// Clients live in real time; the rule is for what a server computes.
#![allow(clippy::disallowed_methods)]

pub mod load;
pub mod network;
pub mod random;
pub mod relay;
pub mod scene_file;
pub mod task;
