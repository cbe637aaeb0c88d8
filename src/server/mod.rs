//! The server: gRPC and gRPC-web services over `pace`, the page, health, reflection, metrics, and a shutdown with a
//! deadline.

mod address;
mod admin;
mod authorize;
pub mod catalog;
mod charged_caller;
pub mod config;
mod connections;
mod cut;
mod datagrams;
mod descriptors;
mod force_law;
mod haptics;
mod health;
pub mod identity;
mod journals;
mod leases;
mod listeners;
mod mesh_parts;
mod meshes;
mod metrics;
mod page;
mod price;
mod protection;
mod rate;
mod recovered;
mod reload;
mod request;
mod revocation;
mod serve;
mod services;
mod sessions;
pub mod signals;
mod status;
mod textures;
mod tls;
mod traffic;
mod transport;
mod validity;
mod views;
mod workshop;

pub use journals::Keep;
pub use listeners::{Listeners, ServeError};
pub use serve::serve;
