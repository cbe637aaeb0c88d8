//! Load tests of a server: simulated users with sessions, tools and viewers, and measurements of how the server copes.
//!
//! In a [`LoadPlan`], users arrive, stay and leave in phases. A [`LoadTrial`] is a plan of one phase in which all
//! stay to the end.

mod client;
mod connections;
mod holding;
mod led_instrument;
mod objective;
mod plan;
mod plan_run;
mod report;
mod script_player;
mod stroke;
mod tally;
mod tip;
mod trial;
mod user;
mod viewer;

pub use objective::Objective;
pub use plan::LoadPlan;
pub use plan_run::PreparedPlan;
pub use report::{LoadReport, Second};
pub use tally::LoadOutcome;
pub use tip::Deadbands;
pub use trial::LoadTrial;

use std::time::{Duration, Instant};

use tokio::sync::watch;

/// Number of moments of a period at which clients send: not all at once, and without a wake-up for each.
const TURNS: usize = 4;

/// Signals the clients of each turn to send, by the clock and independent of the answers.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn tick(turns: &[watch::Sender<u64>], rate_hz: f64, over: &watch::Receiver<()>) {
    let (begun, apart_s) = (Instant::now(), 1.0 / (rate_hz * turns.len() as f64));
    let mut tick: u64 = 0;
    while over.has_changed().is_ok() {
        let due = Duration::from_secs_f64(tick as f64 * apart_s);
        if let Some(rest) = due.checked_sub(begun.elapsed()) {
            std::thread::sleep(rest.min(Duration::from_secs(1)));
            if begun.elapsed() < due {
                continue;
            }
        }
        // Ticks that are overdue by more than a period are skipped, not caught up; clients count them.
        let count = turns.len() as u64;
        let behind = ((begun.elapsed().as_secs_f64() / apart_s) as u64).saturating_sub(tick) / count * count;
        tick += behind;
        turns[(tick % count) as usize].send_replace(tick / count + 1);
        tick += 1;
    }
}
