//! A run in real time, over a real connection to a real server: to show that virtual time tells the truth. The simulated
//! hand, its task and the twin are those of `run`; the twin follows the tool's course when that is over.

use glam::DVec3;
use palpate::haptics::Reason;

use super::network::Dice;
use super::run::{Account, Found, Setup, TICK_S};
use super::task::{self, Task};
use super::tissue::{Tissue, Twin};
use crate::Failure;
use crate::bridge::device::Simulated;
use crate::bridge::line::Target;
use crate::bridge::{self, Tick};
use crate::connect::Server;

/// Before the first press, s: the server computes its force law first.
const LEAD_S: f64 = 3.0;

/// Runs it at a server that has the scene by its name.
pub(super) async fn run(setup: &Setup, server: Server) -> Result<Found, Failure> {
    let Setup { model, law, tip, hand, device, deadband, duration_s, seed, .. } = setup;
    let middle_m = (model.scene.sheet.extent_m() / 2.0).extend(0.0);
    let scale = task::scale(hand, law, device.most_n());
    let task = Task::new(middle_m, LEAD_S, *duration_s, scale, &mut Dice::new(*seed, 0));
    let mut simulated = Simulated::new(*device, *hand, task, TICK_S);
    let target = Target {
        server,
        session: None,
        made: None,
        scene: model.scene.name.clone(),
        tool: 0,
        tip: *tip,
        deadband: *deadband,
    };
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let ticks = (duration_s / TICK_S).round() as u32;
    let (mut served, shared) = bridge::run(&mut simulated, target, Some(ticks), true).await?;
    let mut twin = Twin::new(Tissue::new(model, *tip, law.clone()));
    let mut account = Account::default();
    for (tick, Tick { place_m, force_n, .. }) in served.course.iter().enumerate() {
        let (true_n, touches) = twin.truth(*place_m).map_err(Failure::Failed)?;
        account.moved(*place_m);
        #[allow(clippy::cast_precision_loss)]
        account.rendered(tick as f64 * TICK_S, *force_n, true_n, touches, None);
    }
    // The last force was let go.
    account.moved(served.course.last().map_or(DVec3::ZERO, |last| last.place_m));
    account.ages_s.append(&mut served.ages_s);
    let mut found = account.close();
    let inbound = shared.inbound();
    found.packets_per_s = inbound.samples as f64 / duration_s;
    found.kbit_per_s = inbound.bytes as f64 * 8e-3 / duration_s;
    found.commands_per_s = TICK_S.recip();
    found.late_ticks = Some(served.late_ticks);
    if let Some(envelope) = &served.envelope {
        let (acted, ticks) = envelope.count(Reason::Passivity);
        found.guard_share = acted as f64 / ticks.max(1) as f64;
        found.interventions = Reason::ALL.iter().map(|(reason, name)| (*name, envelope.count(*reason).0)).collect();
    }
    Ok(found)
}
