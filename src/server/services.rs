//! What every service shares.

use std::sync::Arc;

use super::catalog::Catalog;
use super::config::Config;
use super::datagrams::Datagrams;
use super::journals::Journals;
use super::meshes::Meshes;
use super::textures::Textures;
use super::traffic::Traffic;
use super::workshop::Workshop;
use crate::pace::Pacer;

/// What every service needs.
#[derive(Clone)]
pub(crate) struct Services {
    pub(crate) config: Arc<Config>,
    pub(super) datagrams: Datagrams,
    pub(crate) catalog: Catalog,
    pub(crate) pacer: Arc<Pacer>,
    pub(crate) textures: Textures,
    pub(crate) meshes: Meshes,
    /// Creates and changes sessions, reads meshes and scripts and computes force laws.
    pub(crate) workshop: Workshop,
    pub(crate) traffic: Arc<Traffic>,
    /// `None` if no journals are kept.
    pub(super) journals: Option<Arc<Journals>>,
}
