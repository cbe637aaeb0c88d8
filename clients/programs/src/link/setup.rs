//! What a run is made of: tissue, tool, hand, device and network.

use std::sync::Arc;

use palpate_haptics::hand::Hand;
use palpate_haptics::{Device, Law, Tip};
use palpate_simulated::network::Conditions;
use palpate_tissue::Model;
use palpate_tissue::response::force_law::Disc;

use super::laws::PlaceLaws;
use super::spot::Spot;

/// How the client renders samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum Rendering {
    /// The newest force, unchanged: no model, no safety envelope
    Raw,
    /// The newest force, held until the next, within the safety envelope
    Hold,
    /// The local model, evaluated along the tool's path, within the safety envelope
    Model,
    /// A copy of the tissue that the client simulates and corrects by samples, or the local model while it recently
    /// matched the samples better; within the safety envelope
    Prediction,
}

/// The setup of a run.
#[derive(Debug, Clone)]
pub(super) struct Setup {
    pub(super) model: Arc<Model>,
    pub(super) laws: Arc<PlaceLaws>,
    /// The law to begin with, and where it is of.
    pub(super) law: Arc<Law>,
    pub(super) disc: Disc,
    pub(super) tip: Tip,
    /// Where the task is done.
    pub(super) spot: Spot,
    pub(super) hand: Hand,
    pub(super) device: Device,
    pub(super) conditions: Conditions,
    /// Once a second the client stalls for this long, s.
    pub(super) stall_s: f64,
    pub(super) scheme: Rendering,
    pub(super) deadband: f64,
    /// The client sends its place only if the server would be wrong about it by more than this part of the force; 0: always.
    pub(super) up_deadband: f64,
    /// A second tool presses so far from where the task is done, m; 0: there is none.
    pub(super) second_m: f64,
    /// A change of the tissue under way.
    pub(super) change: Option<TissueChange>,
    pub(super) duration_s: f64,
    pub(super) seed: u64,
}

/// A change of the tissue.
#[derive(Debug, Clone)]
pub(super) struct TissueChange {
    pub(super) at_s: f64,
    /// Stiffness of all springs after it over that before.
    pub(super) factor: f64,
    /// What the tissue is then.
    pub(super) model: Arc<Model>,
    pub(super) laws: Arc<PlaceLaws>,
}

/// Period of the device's loop, s.
pub(super) const TICK_S: f64 = 1e-3;

/// The ticks of a time.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub(super) fn ticks(duration_s: f64) -> u32 {
    (duration_s / TICK_S).round() as u32
}
