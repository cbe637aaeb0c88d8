//! Touch that stays accurate and safe over a network: the data a server sends with each sample, how a client renders it
//! a thousand times a second, and the limits that protect both. Pure functions: no clock, no socket, no random number;
//! time is an argument, in seconds from any origin.
//!
//! Conventions: `force_on_tool_n` is the force of the tissue on the tool; stiffness and damping are positive; the sheet's
//! frame is right-handed with z out of the tissue.

mod coarse;
pub mod deadband;
pub mod device;
pub mod envelope;
pub mod hand;
pub mod law;
pub mod local;
pub mod path;
pub mod renderer;

pub use deadband::Deadband;
pub use device::Device;
pub use envelope::{Envelope, Reason, State};
pub use law::Law;
pub use local::{LocalModel, Touching, Track};
pub use renderer::Renderer;
