//! Loads of a server: sessions, users with tools, and viewers, and how it copes.
//!
//! A [`LoadTrial`] has a number of sessions that stay; by a [`LoadPlan`], users arrive, stay and leave in phases.

mod client;
mod course;
mod objective;
mod plan;
mod report;
mod stroke;
mod swarm;
mod tally;
mod tip;
mod trial;

pub use course::PreparedPlan;
pub use objective::Objective;
pub use plan::LoadPlan;
pub use report::{LoadReport, Second};
pub use tally::LoadOutcome;
pub use tip::Deadbands;
pub use trial::{LoadTrial, TrialProgress, trial};

use std::time::{Duration, Instant};

use tokio::sync::watch;

/// Clients send at this many moments of a period: not all at once, and without a wake-up for each.
const PHASES: usize = 4;

/// Tells each phase in turn that its clients are to send: by the clock, independent of the answers.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn tick(phases: &[watch::Sender<u64>], rate_hz: f64, over: &watch::Receiver<()>) {
    let (begun, apart_s) = (Instant::now(), 1.0 / (rate_hz * phases.len() as f64));
    let mut tick: u64 = 0;
    while over.has_changed().is_ok() {
        let due = Duration::from_secs_f64(tick as f64 * apart_s);
        if let Some(rest) = due.checked_sub(begun.elapsed()) {
            std::thread::sleep(rest.min(Duration::from_secs(1)));
            if begun.elapsed() < due {
                continue;
            }
        }
        // Ticks that are overdue by more than a turn are skipped, not caught up; clients count them.
        let count = phases.len() as u64;
        let behind = ((begun.elapsed().as_secs_f64() / apart_s) as u64).saturating_sub(tick) / count * count;
        tick += behind;
        phases[(tick % count) as usize].send_replace(tick / count + 1);
        tick += 1;
    }
}
