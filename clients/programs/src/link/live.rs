//! A run in real time, over a real connection to a real server: it validates the runs in virtual time. The simulated
//! hand, its task and the twin are those of `run`. The twin follows the tool's course afterwards, step by step of the
//! time that has passed, whether the client was late or not.

use std::time::Duration;

use glam::DVec3;
use palpate_client::bridge::{self, Options, SessionChoice, Target, Warn};
use palpate_client::{HapticDevice, Reading, Server};
use palpate_haptics::Device;
use palpate_simulated::network::Transport;
use palpate_simulated::random::Random;
use palpate_simulated::task::Task;

use super::direct::Direct;
use super::measure::{LinkOutcome, LinkTick, Totals};
use super::setup::{Rendering, Setup, TICK_S};
use super::spot::Spot;
use super::tissue::LinkTissue;
use super::with_tissue;
use crate::prediction::When;
use crate::simulated::{CoursePart, Simulated};
use crate::{ClientFailure, interrupted, warn};

/// Time before the first press, s: the server computes its force law first.
const LEAD_S: f64 = 3.0;

/// A simulated device, with the centre of its workspace at a place of the tissue.
struct Laid {
    device: Simulated,
    spot: Spot,
    /// The top of the tissue, where a bridge puts the centre, m.
    top_m: DVec3,
}

impl HapticDevice for Laid {
    fn descriptor(&self) -> Device {
        let device = self.device.descriptor();
        // A bridge measures the workspace from the top of the tissue.
        Device { workspace_m: device.workspace_m + self.spot.at_m.distance(self.top_m), ..device }
    }

    fn read(&mut self) -> std::io::Result<Reading> {
        let reading = self.device.read()?;
        Ok(Reading { place_m: self.spot.of_tissue(self.spot.at_m + reading.place_m) - self.top_m, ..reading })
    }

    fn write(&mut self, force_n: DVec3) -> std::io::Result<()> {
        self.device.write(self.spot.direction(force_n))
    }
}

/// Performs the run at a server, which must know the scene by its name.
pub(super) async fn run(setup: &Setup, server: Server) -> Result<LinkOutcome, ClientFailure> {
    let Setup { model, tip, spot, hand, device, deadband, up_deadband, conditions, duration_s, seed, .. } = setup;
    let direct = with_tissue(|| Direct::new(setup, LEAD_S))?;
    let task = Task::new(DVec3::ZERO, LEAD_S, *duration_s, direct.scale, &mut Random::new(*seed, 0));
    let device = Simulated::new(*device, *hand, task, true);
    let laid = Laid { device, spot: *spot, top_m: model.shape().top_m() };
    let target = Target {
        server,
        session: SessionChoice::New { scene: model.scene.name.clone() },
        tool: 0,
        tip: *tip,
        deadband: *deadband,
        up_deadband: *up_deadband,
        datagrams: conditions.transport == Transport::Datagram,
        holder: "palpate-client link".to_owned(),
    };
    let lasts = Some(Duration::from_secs_f64(*duration_s));
    let when = if setup.scheme == Rendering::Prediction { When::Always } else { When::Never };
    let (told, copies) = (Some(Box::new(warn) as Warn), when.copies());
    let options = Options { lasts, remembers: true, warn: told, copies, ..Options::default() };
    let (Laid { device: simulated, .. }, mut served) = bridge::run(laid, target, options, interrupted()).await?;
    if let Some(error) = &served.lost {
        warn(&error.to_string());
    }
    #[allow(clippy::cast_precision_loss)]
    if let Some(told) =
        too_late([served.late_ticks, served.missed_ticks].map(|ticks| ticks as f64), duration_s / TICK_S)
    {
        warn(&told);
    }
    let mut totals = Totals::default();
    with_tissue(|| {
        let mut twin = LinkTissue::new(setup)?;
        for (tick, part) in (0_u32..).zip(steps(simulated.course())) {
            let CoursePart { time_s: now_s, place_m, force_n } = part;
            // The hand's place is relative to the spot.
            let (true_n, touches) = twin.truth(place_m + spot.at_m, f64::from(tick) * TICK_S)?;
            totals.moved(place_m, 0.0);
            let (depth_m, direct_m) = (-place_m.z, direct.depth_m(tick + 1));
            totals.rendered(&LinkTick { now_s, depth_m, direct_m, force_n, true_n, touches, age_s: None }, None);
        }
        Ok(())
    })?;
    totals.ages_s.append(&mut served.ages_s);
    if let Some(envelope) = &served.envelope {
        totals.limited(envelope);
    }
    let mut outcome = totals.close();
    outcome.scale = direct.scale;
    // From the simulated hand, which is exact between these steps too.
    outcome.energy_min_j = simulated.energy_min_j();
    outcome.packets_per_s = served.traffic.samples as f64 / duration_s;
    outcome.kbit_per_s = served.traffic.bytes as f64 * 8e-3 / duration_s;
    outcome.commands_per_s = served.traffic.poses as f64 / duration_s;
    outcome.carried = Some(served.traffic.carried);
    outcome.late_ticks = Some(served.late_ticks);
    outcome.predicted_ticks = served.predicted_ticks;
    Ok(outcome)
}

/// Fractions of the ticks that may be late or skipped. Beyond them, the figures describe this machine.
const MAX_LATE: f64 = 0.01;

/// Returns a warning about a run in which too many ticks were late or skipped.
fn too_late([late, missed]: [f64; 2], ticks: f64) -> Option<String> {
    (late + missed > MAX_LATE * ticks).then(|| {
        let percent = |count: f64| 100.0 * count / ticks;
        format!(
            "this machine was too late to judge server and network: {:.1} % of the ticks began more than 1 ms late, {:.1} % were \
             skipped; the figures below are no measure of the link",
            percent(late),
            percent(missed)
        )
    })
}

/// Returns a course resampled at each whole tick: the place, interpolated linearly, and the force that the device
/// held.
fn steps(course: &[CoursePart]) -> impl Iterator<Item = CoursePart> {
    let (mut at, mut tick) = (1, 0_u32);
    std::iter::from_fn(move || {
        tick += 1;
        let time_s = f64::from(tick) * TICK_S;
        while course.get(at)?.time_s < time_s {
            at += 1;
        }
        let (before, after) = (&course[at - 1], &course[at]);
        let part = ((time_s - before.time_s) / (after.time_s - before.time_s)).clamp(0.0, 1.0);
        Some(CoursePart { time_s, place_m: before.place_m.lerp(after.place_m, part), force_n: after.force_n })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_machine_that_was_late_is_told_of() {
        assert_eq!(too_late([50.0, 40.0], 1e4), None);
        let told = too_late([200.0, 1000.0], 1e4).unwrap();
        assert!(told.contains("2.0 % of the ticks") && told.contains("10.0 % were skipped"), "{told}");
    }

    #[test]
    fn a_course_with_a_stall_is_resampled_by_the_time_that_passed() {
        let part = |time_s: f64, z_m: f64, z_n: f64| CoursePart {
            time_s,
            place_m: DVec3::new(0.0, 0.0, z_m),
            force_n: DVec3::new(0.0, 0.0, z_n),
        };
        // Two parts, a stall of a tenth of a second, and one more.
        let course =
            [part(0.0005, 0.0, 1.0), part(0.0015, 1.0, 2.0), part(0.1015, 101.0, 3.0), part(0.1025, 101.5, 4.0)];
        let steps: Vec<CoursePart> = steps(&course).collect();
        assert_eq!(steps.len(), 102);
        assert!((steps[0].place_m.z - 0.5).abs() < 1e-9 && steps[0].force_n.z == 2.0);
        assert!((steps[50].place_m.z - 50.5).abs() < 1e-6 && steps[50].force_n.z == 3.0);
    }
}
