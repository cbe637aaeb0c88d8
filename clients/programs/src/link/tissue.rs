//! A tissue in use, as on a server: commands go through an intake, and the session takes those that are due. It also
//! has the second tool and the change of the tissue of the setup, so that the true tissue and the server's have both
//! at the same times.

use std::sync::Arc;

use glam::DVec3;
use palpate_haptics::{ContactState, Tip};
use palpate_session::Session;
use palpate_session::command::Command;
use palpate_session::input::Input;
use palpate_session::lease::LeaseId;
use palpate_session::simulation::Simulation;
use palpate_session::tissue_copy::ToolWork;
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
pub(super) const SECOND_TOOL: u32 = 1;
pub(super) const SECOND_LEASE: LeaseId = 2;

/// Depth of the second tool's presses as a fraction of the task's depths: about the depth that a yielding hand
/// reaches.
const SECOND_DEPTHS: f64 = 0.5;

/// A tissue with its tools.
pub(super) struct LinkTissue {
    simulation: Simulation,
    tip: Tip,
    spot: Spot,
    /// The second tool, if the tissue leads it.
    pub(super) second: Option<Second>,
    /// The work of the hand's tool.
    work: ToolWork,
    change: Option<(f64, Arc<Model>)>,
}

/// A tool that presses by a task of its own and stays at its place.
pub(super) struct Second {
    /// Offset from the place of the hand's task, m.
    apart_m: DVec3,
    task: Task,
}

impl Second {
    /// Returns the second tool of a setup, if it has one.
    pub(super) fn of(setup: &Setup) -> Option<Self> {
        if setup.second_m <= 0.0 {
            return None;
        }
        let scale = SECOND_DEPTHS * task::scale(&setup.hand, &setup.law, setup.device.most_n());
        let random = &mut Random::new(setup.seed, 6);
        let task = Task::new(DVec3::ZERO, task::LEAD_S, setup.duration_s, scale, random);
        Some(Second { apart_m: DVec3::new(setup.second_m, 0.0, 0.0), task })
    }

    /// Returns the place of the second tool in the hand's frame, m.
    pub(super) fn place_m(&self, spot: &Spot, now_s: f64) -> DVec3 {
        spot.at_m + self.apart_m + self.task.at(now_s).z * DVec3::Z
    }
}

impl LinkTissue {
    /// Creates the tissue at rest, before any touch.
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
            second: Second::of(setup),
            work: ToolWork::default(),
            change: setup.change.as_ref().map(|change| (change.at_s, change.model.clone())),
        })
    }

    /// The session.
    pub(super) fn session(&self) -> &Session {
        &self.simulation.session
    }

    /// Returns the energy that the second tool has given to the hand's through the tissue so far, J: what that got from the
    /// tissue beyond what it gave.
    pub(super) fn supplied_j(&self) -> f64 {
        (-self.work.done_j).max(0.0)
    }

    /// Returns a command that moves the tool to a place in the hand's frame. A client time of 0 means at once.
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

    /// Submits commands that arrive together.
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
        // Rounding must not add a step.
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
            let contact = self.session().tissue().tool_contact(TOOL as usize);
            self.work.add(contact);
            if let Some(reason) = self.session().fault() {
                return Err(reason);
            }
        }
        Ok(())
    }

    /// Returns the force on a tool at `place_m` without a network, N, and whether it touches the tissue.
    ///
    /// # Errors
    /// Returns the errors of [`LinkTissue::step`].
    pub(super) fn truth(&mut self, place_m: DVec3, now_s: f64) -> Result<(DVec3, bool), String> {
        self.submit(LEASE, vec![self.pose(place_m)], now_s)?;
        self.step(now_s)?;
        Ok(self.session().tissue().tool_contact(TOOL as usize).map_or((DVec3::ZERO, false), |feel| {
            (self.spot.direction(feel.force_on_tool_n), feel.contact_state != ContactState::Free)
        }))
    }
}

/// Converts a time to the server's clock.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub(super) fn ns(time_s: f64) -> u64 {
    (time_s * 1e9).round() as u64
}
