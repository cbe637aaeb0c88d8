//! The server: gRPC and gRPC-web services over the stepping threads of `palpate_realtime`, the page, health,
//! reflection, metrics, and shutdown with a deadline.

mod address;
mod admin;
mod authorize;
pub mod catalog;
mod charged_caller;
mod cluster_config;
pub mod config;
mod connection_leases;
mod connections;
mod cpu_account;
mod datagrams;
mod descriptors;
mod fleet;
mod force_law;
pub mod frame_message;
mod haptics;
mod health;
pub mod identity;
mod job_pool;
pub mod journal_key;
mod journals;
mod listeners;
mod mesh_parts;
mod meshes;
mod metrics;
mod nodes;
mod page;
mod protection;
mod rate;
mod recovered;
mod reload;
mod request;
mod revocation;
mod serve;
mod services;
mod session_instruments;
mod sessions;
pub mod signals;
mod status;
mod stream_termination;
mod textures;
mod tls;
mod topology_parts;
#[cfg(feature = "otlp")]
pub mod traces;
mod traffic;
mod transport;
mod uploads;
mod validity;
mod views;
mod wound_parts;

pub use cluster_config::{ClusterConfig, Durable};
pub use journals::Keep;
pub use listeners::{Listeners, ServeError};
pub use serve::serve;
