//! The server's side of the loop: a session that plays a tool's commands and returns what the tool felt.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use glam::{DMat3, DQuat, DVec3};
use palpate::force_law::{self, Disc};
use palpate::scene::script::Action;
use palpate::session::Session;
use palpate::session::command::{Command, Due};
use palpate::session::laws::FIRST;
use palpate::session::local::Modeller;
use palpate::sheet::{Feel, Footprint, Model, RestSurface};
use palpate_touch::path::{Path, Play};
use palpate_touch::{ContactState, Law, LocalModel, Tip};

/// The place of a surface at which a task is done, seen by the hand: the task's own place is there, and z is out of the
/// tissue.
#[derive(Debug, Clone, Copy)]
pub(super) struct Spot {
    /// The place at rest, m.
    pub(super) at_m: DVec3,
    /// From directions of the tissue to those of the hand.
    turn: DMat3,
}

impl Spot {
    /// The place of the rest surface that is nearest to `near_m`, as a disc of `radius_m` finds it.
    pub(super) fn new(model: &Model, near_m: DVec3, radius_m: f64) -> Self {
        if model.shape().dimensions() == 2 {
            return Spot { at_m: near_m, turn: DMat3::IDENTITY };
        }
        let (at_m, outward) = Footprint::new(model, radius_m, near_m).at_rest();
        Spot { at_m, turn: DMat3::from_quat(DQuat::from_rotation_arc(outward, DVec3::Z)) }
    }

    /// A place above it, as the hand sees it, where no tool touches.
    fn above_m(&self) -> DVec3 {
        self.at_m + 0.01 * DVec3::Z
    }

    /// Of the hand's place, which has the same middle.
    fn of_tissue(&self, place_m: DVec3) -> DVec3 {
        self.at_m + self.turn.transpose() * (place_m - self.at_m)
    }

    fn of_hand(&self, feel: Feel) -> Feel {
        let place = |place_m: DVec3| self.at_m + self.turn * (place_m - self.at_m);
        Feel {
            place_m: place(feel.place_m),
            velocity_m_per_s: self.turn * feel.velocity_m_per_s,
            force_on_tool_n: self.turn * feel.force_on_tool_n,
            surface_m: place(feel.surface_m),
            anchor_m: place(feel.anchor_m),
            normal: self.turn * feel.normal,
            rest: feel.rest.map(|rest| RestSurface {
                place_m: place(rest.place_m),
                normal: self.turn * rest.normal,
                curvature_per_m: self.turn * rest.curvature_per_m * self.turn.transpose(),
            }),
            ..feel
        }
    }
}

/// A tissue with one tool.
pub(super) struct Tissue {
    session: Session,
    tip: Tip,
    spot: Spot,
    modeller: Modeller,
}

impl Tissue {
    pub(super) fn new(model: &Arc<Model>, tip: Tip, spot: Spot, law: Arc<Law>) -> Self {
        Tissue { session: Session::new(model), tip, spot, modeller: Modeller::new(FIRST, law, false) }
    }

    /// Performs one step, at the end of which the tool is at the hand's `place_m`, or released if that is `None`.
    pub(super) fn step(&mut self, place_m: Option<DVec3>) -> Result<Option<Feel>, String> {
        let (tip, spot) = (self.tip, self.spot);
        let pose = |place_m| Action::Pose { place_m: spot.of_tissue(place_m), velocity_m_per_s: None, tip };
        let action = place_m.map_or(Action::Release, pose);
        let command = Command {
            tool: 0,
            sequence: Some(self.session.step_count() + 1),
            client_time_ns: 0,
            by_datagram: false,
            at_step: None,
            time_to_live_s: None,
            action,
            arrival_ns: 0,
        };
        self.session.advance(&mut vec![Due { command, late: false, late_commands: 0, ends_lease: false }], |_| {});
        match self.session.fault() {
            Some(reason) => Err(reason),
            None => Ok(self.session.tissue().feel(0).map(|feel| spot.of_hand(feel))),
        }
    }

    /// The local model of what the tool felt in the last step.
    fn model(&mut self, feel: &Feel, client_time_s: f64) -> LocalModel {
        let step = self.session.step_count();
        self.modeller.model(feel, step, client_time_s)
    }
}

/// The laws that a client is told, numbered from [`FIRST`] on: of each place one. Computing them takes no virtual time.
pub(super) struct PlaceLaws {
    /// Of the tool's place.
    disc: Disc,
    told: Vec<(Disc, Arc<Law>)>,
}

impl PlaceLaws {
    /// Of a client that begins with `law`, which is of `disc`.
    pub(super) fn new(disc: Disc, law: Arc<Law>) -> Self {
        PlaceLaws { disc, told: vec![(disc, law)] }
    }

    /// The law of a number.
    pub(super) fn law(&self, number: u32) -> &Arc<Law> {
        &self.told.get(number as usize).unwrap_or(&self.told[0]).1
    }

    /// The law that a tool at a place of the tissue wants from now on, and its number, if that is another.
    fn follow(&mut self, model: &Model, place_m: DVec3) -> Option<(u32, Arc<Law>)> {
        let disc = self.disc.follow(model, place_m);
        if disc == self.disc {
            return None;
        }
        self.disc = disc;
        let number = match self.told.iter().position(|told| told.0 == disc) {
            Some(number) => number,
            None => {
                let law = law_at(model, disc)?;
                self.told.push((disc, law));
                self.told.len() - 1
            }
        };
        Some((u32::try_from(number).ok()?, self.told[number].1.clone()))
    }
}

/// The exact law under a disc; none if nothing holds the tissue.
pub(super) fn law_at(model: &Model, disc: Disc) -> Option<Arc<Law>> {
    let law = force_law::exact_within(model, disc, u64::MAX, &AtomicBool::new(false));
    law.filter(Law::is_sound).map(Arc::new)
}

/// A tissue behind a network.
pub(super) struct Server {
    tissue: Tissue,
    pub(super) path: Path,
    pub(super) laws: PlaceLaws,
}

impl Server {
    pub(super) fn new(tissue: Tissue, laws: PlaceLaws) -> Self {
        let spot = tissue.spot;
        // A task begins above the place where it is done; of a sheet, that is where a path begins by itself.
        let is_sheet = tissue.session.model().shape().dimensions() == 2;
        let path = if is_sheet { Path::default() } else { Path::beginning_at(spot.above_m()) };
        Server { tissue, path, laws }
    }

    /// Performs one step; returns its sample while the tool is in use.
    pub(super) fn step(&mut self, now_s: f64, step_s: f64) -> Result<Option<LocalModel>, String> {
        let (place_m, time_s) = match self.path.step(now_s, step_s) {
            Some(Play::Pose(place_m, time_s)) => (Some(place_m), time_s),
            Some(Play::Release) | None => (None, 0.0),
        };
        let feel = self.tissue.step(place_m)?;
        let Tissue { session, spot, modeller, .. } = &mut self.tissue;
        if let Some((number, law)) = place_m.and_then(|at_m| self.laws.follow(session.model(), spot.of_tissue(at_m))) {
            modeller.change_law(number, law);
        }
        Ok(feel.map(|feel| self.tissue.model(&feel, time_s)))
    }
}

/// The same tissue without a network: its force is the true one.
pub(super) struct Twin(Tissue);

impl Twin {
    pub(super) fn new(tissue: Tissue) -> Self {
        Twin(tissue)
    }

    /// The force on the tool at `place_m`, N, and whether the tool touches the tissue.
    pub(super) fn truth(&mut self, place_m: DVec3) -> Result<(DVec3, bool), String> {
        let feel = self.0.step(Some(place_m))?;
        Ok(feel.map_or((DVec3::ZERO, false), |feel| (feel.force_on_tool_n, feel.contact_state != ContactState::Free)))
    }
}
