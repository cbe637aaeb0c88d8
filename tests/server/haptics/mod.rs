//! Touch: contact, force laws, and the streams of devices.

pub(crate) mod blades;
mod commands;
mod contact;
mod copies;
mod instruments;
mod laws;
mod poses;
mod ties;
