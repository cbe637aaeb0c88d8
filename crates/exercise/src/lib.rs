//! Measures of what somebody did with tools on a tissue, for exercises and debriefings: how long, how far, how smoothly,
//! how hard, and where.
//!
//! [`Measures`] takes a [`ToolRow`] for each tool and step, in bounded memory, and gives [`Figure`]s at any time. The same
//! rows give the same bits, during a session and afterwards. Each family of measures has a file, with its formula;
//! [`register::definitions`] lists all of them with unit, range and source.
//!
//! **Truth.** [`ExerciseTruth`] gives the figures that need the truth of an exercise: answers (`answers`), cuts (`incision`), and
//! tasks that are judged step by step (`tasks`).
//!
//! **Windows.** What is derived from motion (path, speed, smoothness) or is a derivative of force uses windows of 10 ms,
//! as the studies do that defined these measures. Differences between single steps would measure the step rate and the
//! noise of a device.

pub mod answers;
pub mod coverage;
pub mod definition;
pub mod detection;
mod force;
mod fourier;
mod hands;
pub mod incision;
mod input;
mod jerk;
pub mod limit;
mod measures;
mod path;
mod press;
pub mod register;
mod sparc;
pub mod tasks;
mod time;
pub mod timeline;
mod tool;
mod truth;
mod window;

pub use definition::{Figure, MeasureDefinition, Scope};
pub use input::{MeasureOptions, PressedDisc, ToolRow};
pub use limit::{LimitKind, ToolLimits};
pub use measures::Measures;
pub use truth::ExerciseTruth;
