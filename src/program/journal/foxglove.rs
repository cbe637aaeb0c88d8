//! `palpate journal export --format mcap`: curves and a moving surface, by the conventions of Foxglove.

use std::io::BufWriter;
use std::path::Path;

use palpate_session::journal::ReplayEvent;
use palpate_session::journal::foxglove::Export;

use super::super::{Failure, with_progress};
use super::JournalSource;
use super::output::{new_file, unwritten};

/// Curves a second, of tools and energies.
const CURVES_HZ: f64 = 100.0;

/// Surfaces a second.
const SURFACES_HZ: f64 = 30.0;

/// Simulates a journal again and writes what Foxglove shows.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub(super) fn export(source: &JournalSource, path: &Path) -> Result<(), Failure> {
    let replay = source.replay(None)?;
    let rate_hz = replay.first().scene.stepping.rate_hz;
    let every = |hz: f64| (rate_hz / hz).round().max(1.0) as u64;
    let [curves, surfaces] = [every(CURVES_HZ), every(SURFACES_HZ)];
    let mut replay = replay.stopping_every(curves);
    let (last, begun_ns) = (replay.survey().until_step, replay.survey().unix_ns[0]);
    let file = new_file(path)?;
    let mut export = Export::new(BufWriter::new(file), begun_ns, replay.session())?;
    with_progress("step", last, false, |progress| {
        replay.advance(last, &mut |seen| {
            let ReplayEvent::Step(session) = seen else { return Ok(()) };
            let step = session.step_count();
            if step.is_multiple_of(curves) {
                export.curves(session)?;
                progress(step);
            }
            if step.is_multiple_of(surfaces) { export.surface(session) } else { Ok(()) }
        })
    })?;
    let file = export.finish()?.into_inner().map_err(|e| unwritten(path, e.error()))?;
    file.sync_all().map_err(|e| unwritten(path, &e))?;
    match replay.difference() {
        Some(difference) => Err(Failure::Failed(format!("{}: {difference}", source.file.display()))),
        None => source.tell_damage(replay.survey().damage.as_deref(), last, None),
    }
}
