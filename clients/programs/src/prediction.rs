//! Copies of tissues, from which a device's forces are rendered without the delay of the network.

use std::sync::Arc;

use palpate_client::bridge::Copies;
use palpate_session::journal;

/// Kinds of tissue of which a device's loop keeps a copy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum When {
    /// For meshes: a local model does not describe a rim, fold or lump outside its place
    Auto,
    /// For every tissue
    Always,
    /// For no tissue: forces come from local models alone, which need the least time and no memory
    Never,
}

impl When {
    /// Returns the value for the options of a bridge.
    pub(crate) fn copies(self) -> Option<Copies> {
        (self != When::Never).then(|| Copies { make: Arc::new(journal::prediction), of_grids: self == When::Always })
    }
}
