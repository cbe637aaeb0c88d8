//! A tissue in use, as a server has it: commands go through an intake, and the session takes what is due. Beside the hand's tool
//! there is what the setup has put there: a second tool, and a change of the tissue. So the truth and the server have both at
//! the same moments.

use std::sync::Arc;

use glam::DVec3;
use palpate_haptics::{ContactState, Tip};
use palpate_session::Session;
use palpate_session::command::Command;
use palpate_session::input::Input;
use palpate_session::lease::LeaseId;
use palpate_session::simulation::Simulation;
use palpate_simulated::random::Random;
use palpate_simulated::task::{self, Task};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::script::Action;

use super::setup::{Setup, TICK_S};
use super::spot::Spot;

/// The hand's tool and the second one, with their leases.
pub(super) const TOOL: u32 = 0;
pub(super) const LEASE: LeaseId = 1;
const SECOND_TOOL: u32 = 1;
const SECOND_LEASE: LeaseId = 2;

/// The second tool presses to this part of the task's depths: so deep, about, does a hand get that yields.
const SECOND_DEPTHS: f64 = 0.5;

/// A tissue with its tools.
pub(super) struct LinkTissue {
    simulation: Simulation,
    tip: Tip,
    spot: Spot,
    second: Option<Second>,
    change: Option<(f64, Arc<Model>)>,
}

/// A tool that presses by a task of its own, and never leaves its place: nothing holds it up.
struct Second {
    /// From where the hand's task is done, m.
    apart_m: DVec3,
    task: Task,
}

impl Second {
    fn new(setup: &Setup) -> Self {
        let scale = SECOND_DEPTHS * task::scale(&setup.hand, &setup.law, setup.device.most_n());
        let random = &mut Random::new(setup.seed, 6);
        let task = Task::new(DVec3::ZERO, task::LEAD_S, setup.duration_s, scale, random);
        Second { apart_m: DVec3::new(setup.second_m, 0.0, 0.0), task }
    }

    /// As the hand sees it.
    fn place_m(&self, spot: &Spot, now_s: f64) -> DVec3 {
        spot.at_m + self.apart_m + self.task.at(now_s).z * DVec3::Z
    }
}

impl LinkTissue {
    /// At rest, before anything has touched it.
    ///
    /// # Errors
    /// Returns why the intake refuses the tools.
    pub(super) fn new(setup: &Setup) -> Result<Self, String> {
        let limits = Limits::default();
        let mut simulation = Simulation::new(&setup.model, &limits);
        for (tool, lease) in [(TOOL, LEASE), (SECOND_TOOL, SECOND_LEASE)] {
            let acquired = simulation.intake.acquire(&[tool], "palpate-client link", limits.lease_s, lease, 0);
            acquired.map_err(|refusal| refusal.to_string())?;
        }
        Ok(LinkTissue {
            simulation,
            tip: setup.tip,
            spot: setup.spot,
            second: (setup.second_m > 0.0).then(|| Second::new(setup)),
            change: setup.change.as_ref().map(|change| (change.at_s, change.model.clone())),
        })
    }

    /// The session.
    pub(super) fn session(&self) -> &Session {
        &self.simulation.session
    }

    /// A command that leads the tool to a place of the hand's. Its client time 0 says: at once.
    pub(super) fn pose(&self, place_m: DVec3) -> Command {
        Command {
            tool: TOOL,
            sequence: None,
            client_time_ns: 0,
            by_datagram: false,
            at_step: None,
            time_to_live_s: None,
            action: Action::Pose { place_m: self.spot.of_tissue(place_m), velocity_m_per_s: None, tip: self.tip },
            arrival_ns: 0,
        }
    }

    /// Takes in commands that arrive together.
    ///
    /// # Errors
    /// Returns why the intake refuses them.
    pub(super) fn submit(&mut self, lease: LeaseId, commands: Vec<Command>, now_s: f64) -> Result<(), String> {
        self.simulation.intake.submit(lease, commands, ns(now_s)).map_err(|refusal| refusal.to_string())
    }

    /// Does the steps of the tick that begins at `now_s`.
    ///
    /// # Errors
    /// Returns the reason if the guard stops the tissue, or why a command of the second tool is refused.
    pub(super) fn step(&mut self, now_s: f64) -> Result<(), String> {
        // Rounding must not make a step more of it.
        while self.session().time_s() < now_s + TICK_S - 1e-9 {
            let begin_s = self.session().time_s();
            if let Some(second) = &self.second {
                let pose = Command { tool: SECOND_TOOL, ..self.pose(second.place_m(&self.spot, begin_s)) };
                self.submit(SECOND_LEASE, vec![pose], begin_s)?;
            }
            if let Some((_, model)) = self.change.take_if(|change| change.0 <= begin_s + 1e-9) {
                self.simulation.apply(Input::Tissue(model));
            }
            self.simulation.step(ns(begin_s)).map_err(|refusal| refusal.to_string())?;
            if let Some(reason) = self.session().fault() {
                return Err(reason);
            }
        }
        Ok(())
    }

    /// The force on a tool that is at `place_m` now, without any network, N; and whether it touches the tissue.
    ///
    /// # Errors
    /// As [`LinkTissue::step`] does.
    pub(super) fn truth(&mut self, place_m: DVec3, now_s: f64) -> Result<(DVec3, bool), String> {
        self.submit(LEASE, vec![self.pose(place_m)], now_s)?;
        self.step(now_s)?;
        Ok(self.session().tissue().tool_contact(TOOL as usize).map_or((DVec3::ZERO, false), |feel| {
            (self.spot.direction(feel.force_on_tool_n), feel.contact_state != ContactState::Free)
        }))
    }
}

/// A time on the server's clock.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub(super) fn ns(time_s: f64) -> u64 {
    (time_s * 1e9).round() as u64
}
