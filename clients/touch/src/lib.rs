//! Touch that stays accurate and safe over a network: the data a server sends with each sample, how a client renders it
//! a thousand times a second, and the limits that protect both. Pure functions: no clock, no socket, no random number;
//! time is an argument, in seconds from any origin. A Palpate server uses the same functions, so it knows what its clients
//! render.
//!
//! Conventions: `force_on_tool_n` is the force of the tissue on the tool; stiffness and damping are positive; the sheet's
//! frame is right-handed with z out of the tissue.
//!
//! **Delay.** Forces are not extrapolated over the delay. The client gets the force law of a slow press ahead of time (`law`). A
//! sample tells where on that law the tissue was, and the client repeats pressure, damping, sticking and sliding along its own
//! path since (`local`). The error is then what the law does not know (other tools, the grain of the grid, inertia) over some
//! milliseconds, and stays at a few tenths of a per cent up to 200 ms of round trip. The safety envelope acts last.

//!
//! # Example
//!
//! A tool that is pressed 2 mm into a tissue of 400 N/m. The envelope lets the force in slowly.
//!
//! ```
//! use glam::{DMat3, DVec3};
//! use palpate_touch::{Device, Envelope, Law, LocalModel, Renderer, Standing};
//!
//! let device = Device::named("omega3").expect("a device of the table");
//! let mut renderer = Renderer::new(Law::linear(400.0, 0.5), Envelope::new(device, DVec3::ZERO));
//! renderer.envelope.enable();
//! // What the server sent: the tool was above the surface, which is at z = 0.
//! let place_m = DVec3::new(0.0, 0.0, 0.001);
//! let model = LocalModel {
//!     sequence: 1,
//!     client_time_s: 0.0,
//!     step: 1,
//!     place_m,
//!     velocity_m_per_s: DVec3::ZERO,
//!     force_n: DVec3::ZERO,
//!     stiffness_n_per_m: DMat3::ZERO,
//!     damping_n_s_per_m: DMat3::ZERO,
//!     surface_m: DVec3::ZERO,
//!     normal: DVec3::Z,
//!     valid_m: 0.01,
//!     friction: 0.2,
//!     standing: Standing::Free,
//!     law: 0,
//! };
//! let mut force_n = DVec3::ZERO;
//! for tick in 0..1000_u32 {
//!     let now_s = f64::from(tick) * 1e-3;
//!     renderer.receive(LocalModel { sequence: 1 + u64::from(tick), client_time_s: now_s, ..model }, now_s);
//!     // The hand moves down by 3 mm in the last tenth of a second.
//!     let down_m = 0.003 * (10.0 * now_s - 9.0).clamp(0.0, 1.0);
//!     force_n = renderer.tick(now_s, place_m - down_m * DVec3::Z);
//! }
//! assert!(force_n.z > 0.5 && force_n.z < 1.0, "{force_n}");
//! ```

pub mod deadband;
pub mod device;
pub mod envelope;
pub mod hand;
pub mod law;
pub mod local;
pub mod path;
pub mod renderer;
pub mod tip;

pub use deadband::Deadband;
pub use device::Device;
pub use envelope::{Envelope, Reason, State};
pub use law::Law;
pub use local::{LocalModel, Standing, Touching, Track};
pub use renderer::Renderer;
pub use tip::{Coupling, Tip};
