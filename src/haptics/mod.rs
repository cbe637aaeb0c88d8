//! Touch that stays accurate and safe over a network: the data a server sends with each sample, how a client renders it
//! a thousand times a second, and the limits that protect both. Pure functions: no clock, no socket, no random number;
//! time is an argument, in seconds from any origin.
//!
//! Conventions: `force_on_tool_n` is the force of the tissue on the tool; stiffness and damping are positive; the sheet's
//! frame is right-handed with z out of the tissue.
//!
//! **Delay.** Forces are not extrapolated over the delay. The client gets the force law of a slow press ahead of time (`law`). A
//! sample tells where on that law the tissue was, and the client repeats pressure, damping, sticking and sliding along its own
//! path since (`local`). The error is then what the law does not know (other tools, the grain of the grid, inertia) over some
//! milliseconds, and stays at a few tenths of a per cent up to 200 ms of round trip. The safety envelope acts last.

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
