//! Setup of a run: tissue, tool, hand, device and network.

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

/// Whose hand leads the second tool.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum SecondLeader {
    /// Another client's: this client learns of it by samples
    Another,
    /// The other hand of this client, whose places go over the same network
    Own,
    /// Another client's, of which samples tell nothing
    Unknown,
}

impl SecondLeader {
    /// Returns the name of the option's value, for tables and JSON.
    pub(super) fn name(self) -> &'static str {
        match self {
            SecondLeader::Another => "another",
            SecondLeader::Own => "own",
            SecondLeader::Unknown => "unknown",
        }
    }
}

/// The setup of a run.
#[derive(Debug, Clone)]
pub(super) struct Setup {
    pub(super) model: Arc<Model>,
    pub(super) laws: Arc<PlaceLaws>,
    /// The first law, and its place.
    pub(super) law: Arc<Law>,
    pub(super) disc: Disc,
    pub(super) tip: Tip,
    /// Place of the task.
    pub(super) spot: Spot,
    pub(super) hand: Hand,
    pub(super) device: Device,
    pub(super) conditions: Conditions,
    /// Once a second the client stalls for this long, s.
    pub(super) stall_s: f64,
    pub(super) scheme: Rendering,
    pub(super) deadband: f64,
    /// Fraction of the force by which the server's estimate of the place must be wrong before the client sends its
    /// place; 0: always.
    pub(super) up_deadband: f64,
    /// Distance of a second tool from the place of the task, m; 0: there is no second tool.
    pub(super) second_m: f64,
    pub(super) second_hand: SecondLeader,
    /// A change of the tissue during the run.
    pub(super) change: Option<TissueChange>,
    pub(super) duration_s: f64,
    pub(super) seed: u64,
}

/// A change of the tissue.
#[derive(Debug, Clone)]
pub(super) struct TissueChange {
    pub(super) at_s: f64,
    /// Stiffness of all springs after the change over that before.
    pub(super) factor: f64,
    /// The tissue after the change.
    pub(super) model: Arc<Model>,
    pub(super) laws: Arc<PlaceLaws>,
}

/// Period of the device's loop, s.
pub(super) const TICK_S: f64 = 1e-3;

/// Returns the number of ticks of a time.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub(super) fn ticks(duration_s: f64) -> u32 {
    (duration_s / TICK_S).round() as u32
}
