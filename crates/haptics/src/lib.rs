//! Touch that stays accurate and safe over a network: the data of a server's samples, how a client renders them a
//! thousand times a second, and the limits that protect person and device. The crate uses no clock,
//! socket or random number; time is an argument, in seconds from any origin. A Palpate server uses the same
//! functions, so it knows what its clients render.
//!
//! Conventions: `force_on_tool_n` is the force of the tissue on the tool; stiffness and damping are positive; the
//! sheet's frame is right-handed with z out of the tissue.
//!
//! **Delay.** Forces are not extrapolated over the delay. The client receives the force law of a slow press ahead of
//! time ([`force_law`]). A sample contains the tissue's state on that law, and the client computes pressure, damping,
//! sticking and sliding along its own path since then ([`local_model`]). The remaining error comes from what the law
//! omits (other tools, the grain of the grid, inertia) over some milliseconds. It stays at a few tenths of a per cent
//! up to 200 ms of round trip. The safety envelope ([`envelope`]) acts last.
//!
//! **Prediction.** Where the tissue changes within the distance that the hand moves in a round trip (a rim, a fold,
//! the edge of a lump), no sample contains what comes next. A client that has a copy of the tissue renders from the
//! copy ([`prediction`]).
//!
//! # Example
//!
//! A tool is pressed 2 mm into a tissue of 400 N/m.
//!
//! ```
//! use glam::{DMat3, DVec3};
//! use palpate_haptics::{Device, Envelope, Law, LocalModel, Renderer, ContactState};
//!
//! let device = Device::named("omega3").expect("a device of the table");
//! let mut renderer = Renderer::new(Law::linear(400.0, 0.5), Envelope::new(device, DVec3::ZERO));
//! renderer.envelope.enable();
//! // The server's sample for a tool at `place_m`. The surface is at z = 0.
//! let model = |sequence: u64, client_time_s: f64, place_m: DVec3| LocalModel {
//!     sequence,
//!     client_time_s,
//!     step: sequence,
//!     place_m,
//!     velocity_m_per_s: DVec3::ZERO,
//!     force_n: 400.0 * (-place_m.z).max(0.0) * DVec3::Z,
//!     stiffness_n_per_m: 400.0 * DMat3::IDENTITY,
//!     damping_n_s_per_m: 0.5 * DMat3::IDENTITY,
//!     surface_m: DVec3::ZERO,
//!     normal: DVec3::Z,
//!     curvature_per_m: DMat3::ZERO,
//!     valid_m: 0.01,
//!     friction: 0.2,
//!     contact_state: if place_m.z < 0.0 { ContactState::Sticking } else { ContactState::Free },
//!     law: 0,
//! };
//! let mut force_n = DVec3::ZERO;
//! for tick in 0..1500_u32 {
//!     let now_s = f64::from(tick) * 1e-3;
//!     // Above the surface for a second; then the hand moves down by 3 mm.
//!     let place_m = DVec3::new(0.0, 0.0, 0.001 - 0.003 * (5.0 * (now_s - 1.0)).clamp(0.0, 1.0));
//!     renderer.receive(model(1 + u64::from(tick), now_s, place_m), now_s);
//!     force_n = renderer.tick(now_s, place_m);
//! }
//! assert!((force_n - 0.8 * DVec3::Z).length() < 1e-3, "{force_n}");
//! ```

pub mod capsule;
pub mod datagram_health;
pub mod dead_reckoning;
pub mod deadband;
pub mod device;
pub mod envelope;
pub mod force_law;
pub mod hand;
pub mod instrument;
pub mod instrument_contact;
pub mod instrument_pose;
pub mod instrument_renderer;
pub mod jaw_limit;
pub mod local_model;
pub mod port;
pub mod pose_playback;
pub mod prediction;
pub mod renderer;
pub mod reported_cuts;
mod spatial_vector;
pub mod tip;

pub use capsule::{Capsule, MovingCapsule};
pub use dead_reckoning::{MotionState, News, SendInterval};
pub use deadband::ForceDeadband;
pub use device::Device;
pub use envelope::{Envelope, LimitCause, RenderingState};
pub use force_law::Law;
pub use instrument::{Instrument, InstrumentPart, InstrumentTip, TipForce};
pub use instrument_contact::{ContactLoad, InstrumentContact, OtherInstrument, SecondHand};
pub use instrument_pose::{InstrumentPose, InstrumentVelocity, Wrench};
pub use instrument_renderer::{InstrumentRenderer, WrenchSample};
pub use jaw_limit::JawTorqueMonitor;
pub use local_model::{ContactState, LocalModel, Touching, Track};
pub use port::{Port, PortLoad};
pub use prediction::{OtherTool, Predicted, Prediction, Predictor};
pub use renderer::Renderer;
pub use reported_cuts::{ReportedCuts, ReportedSpring};
pub use tip::{Coupling, Tip, TipShape};
