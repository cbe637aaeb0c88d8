//! Simulated users of a Palpate server: the movements of their hands, the networks they are behind, and the load that
//! a server can take.
//!
//! [`load`] lets many simulated users use a server and measures how it copes. [`task`] is the movement of a hand,
//! [`network`] decides when a message arrives, [`relay`] is such a network on this machine, and [`random`] are their
//! random numbers. [`scene_file`] sends scenes to a server, [`trainee`] does exercises.

// Clients run in real time; the rule is for what a server computes.
#![allow(clippy::disallowed_methods)]

pub mod load;
pub mod network;
pub mod random;
pub mod relay;
pub mod scene_file;
pub mod task;
pub mod trainee;
