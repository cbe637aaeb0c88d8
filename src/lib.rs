//! Palpate: a server for touching soft tissue over a network. ARCHITECTURE.md is the map.

pub mod budget;
pub mod haptics;
pub mod limits;
mod lock;
pub mod memory;
pub mod pace;
pub mod refusal;
pub mod render;
pub mod scene;
pub mod server;
pub mod session;
pub mod sheet;
pub mod surface;
pub mod texture;
pub mod wire;
