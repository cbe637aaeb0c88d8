//! Points that do not move freely: fixed points and grasped points.

use glam::DVec3;

use crate::body::model::Model;
use crate::saved::{
    Checks, SavedGrasp, SavedGrasped, SavedPrescribed, Vector, ensure, restored_motion, restored_moves, saved_motion,
    saved_moves,
};
use crate::scene::action_check::check_free;
use crate::scene::profile::{Motion, MotionProfile};
use palpate_refusal::Result;

/// How a tool moves its grasped point ([`Tissue::grasp`](crate::Tissue::grasp)). It lasts until the next input of the
/// same tool; a point that is let go keeps its velocity.
#[derive(Debug, Clone, PartialEq)]
pub enum Grasp {
    /// Moves the point to this displacement from rest, m, in the tissue's frame, by the end of the next step, at
    /// constant velocity; then it stays.
    Target(DVec3),
    /// A displacement as a function of time, evaluated exactly at each moment within a step.
    Profile(MotionProfile),
}

impl Grasp {
    pub(crate) fn saved(&self) -> SavedGrasp {
        match self {
            Grasp::Target(displacement_m) => SavedGrasp::Target((*displacement_m).into()),
            Grasp::Profile(profile) => saved_moves(profile),
        }
    }

    pub(crate) fn restored(saved: &SavedGrasp, checks: &Checks<'_>) -> Result<Self> {
        Ok(match saved {
            SavedGrasp::Target(displacement_m) => Grasp::Target(checks.vector(*displacement_m)?),
            SavedGrasp::Profile { point, moves } => Grasp::Profile(restored_moves(checks, *point, moves)?),
        })
    }
}

/// Checks the place in memory of a point that a snapshot lists as grasped, and returns it.
#[allow(clippy::cast_possible_truncation)]
pub(crate) fn restored_index(model: &Model, index: u64, checks: &Checks<'_>) -> Result<usize> {
    ensure(index < model.place_count() as u64, "a grasped point that the tissue lacks")?;
    let index = index as usize;
    let point = model.point_at(index);
    ensure(model.place_of(point) == index, "a grasped point that the tissue lacks")?;
    check_free("snapshot", checks.shape, point)?;
    Ok(index)
}

/// One grasped point.
#[derive(Debug, Clone)]
struct Grasped {
    tool: usize,
    index: usize,
    grasp: Grasp,
    /// The motion at the end of the last step.
    now: Motion,
    /// Whether a step was done since the grasp.
    held: bool,
}

/// Grasped points, and those just released.
#[derive(Debug, Clone)]
pub(crate) struct Prescribed {
    grasped: Vec<Grasped>,
    /// Released points and their velocities, m/s, until the next substep.
    released: Vec<(usize, DVec3)>,
}

impl Prescribed {
    pub(crate) fn new() -> Self {
        Prescribed { grasped: Vec::new(), released: Vec::new() }
    }

    pub(crate) fn saved(&self) -> SavedPrescribed {
        let grasped = self.grasped.iter().map(|Grasped { tool, index, grasp, now, held }| SavedGrasped {
            tool: *tool as u64,
            index: *index as u64,
            grasp: grasp.saved(),
            now: saved_motion(now),
            held: *held,
        });
        let released = self.released.iter().map(|(index, velocity)| (*index as u64, Vector::from(*velocity)));
        SavedPrescribed { grasped: grasped.collect(), released: released.collect() }
    }

    /// Restores grasped points. In a state that passed the guard, no point is displaced, or moves in a step, by
    /// `most_m` or more.
    pub(crate) fn restored(saved: &SavedPrescribed, model: &Model, most_m: f64, checks: &Checks<'_>) -> Result<Self> {
        let step_s = model.scene.stepping.rate_hz.recip();
        let is_within = |v: DVec3| ensure(v.abs().max_element() < most_m, "a motion that no point has");
        let mut grasped: Vec<Grasped> = Vec::new();
        for SavedGrasped { tool, index, grasp, now, held } in &saved.grasped {
            let (tool, index) = (checks.tool(*tool)?, restored_index(model, *index, checks)?);
            let is_new = grasped.iter().all(|other| other.tool != tool && other.index != index);
            ensure(is_new, "a tool that grasps twice, or a point that is grasped twice")?;
            let (grasp, now) = (Grasp::restored(grasp, checks)?, restored_motion(checks, now)?);
            is_within(now.displacement_m)?;
            is_within(now.velocity_m_per_s * step_s)?;
            grasped.push(Grasped { tool, index, grasp, now, held: *held });
        }
        let released = saved.released.iter().map(|(index, velocity)| {
            let velocity_m_per_s = checks.vector(*velocity)?;
            is_within(velocity_m_per_s * step_s)?;
            Ok((restored_index(model, *index, checks)?, velocity_m_per_s))
        });
        Ok(Prescribed { grasped, released: released.collect::<Result<_>>()? })
    }

    /// Returns whether no point is grasped and none was just released.
    pub(crate) fn is_empty(&self) -> bool {
        self.grasped.is_empty() && self.released.is_empty()
    }

    /// Makes `tool` move the point at `index` from the next step on, and release the point it held before.
    /// `now` is the present motion of the point. A point that another tool holds is taken over.
    pub(crate) fn grasp(&mut self, tool: usize, index: usize, grasp: Grasp, now: Motion) {
        if let Some(at) = self.grasped.iter().position(|g| g.index == index) {
            let taken = Grasped { tool, grasp, ..self.grasped.remove(at) };
            self.release(tool);
            return self.grasped.push(taken);
        }
        self.release(tool);
        let now = match &grasp {
            Grasp::Target(_) => now,
            Grasp::Profile(profile) => profile.at(0.0),
        };
        self.grasped.push(Grasped { tool, index, grasp, now, held: false });
    }

    /// Releases the point of `tool`. The point keeps its velocity.
    pub(crate) fn release(&mut self, tool: usize) {
        let Some(at) = self.grasped.iter().position(|g| g.tool == tool) else { return };
        let grasped = self.grasped.remove(at);
        // A point that was grasped and released at the same boundary was never held.
        if grasped.held {
            self.released.push((grasped.index, grasped.now.velocity_m_per_s));
        }
    }

    /// Returns the tools that grasp a point.
    pub(crate) fn tools(&self) -> impl Iterator<Item = usize> {
        self.grasped.iter().map(|grasped| grasped.tool)
    }

    /// Returns the points released since the last call: place in memory and velocity, m/s. Empties the list.
    pub(crate) fn take_released(&mut self) -> Vec<(usize, DVec3)> {
        std::mem::take(&mut self.released)
    }

    /// Returns the grasped points at `fraction` of step `step`: place in memory, displacement, m, and velocity,
    /// m/s.
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn at(&self, model: &Model, step: u64, fraction: f64) -> impl Iterator<Item = (usize, DVec3, DVec3)> {
        let rate_hz = model.scene.stepping.rate_hz;
        self.grasped.iter().map(move |grasped| {
            let (displacement_m, velocity_m_per_s) = match &grasped.grasp {
                Grasp::Target(target_m) => {
                    let now_m = grasped.now.displacement_m;
                    let place_m = if fraction >= 1.0 { *target_m } else { now_m.lerp(*target_m, fraction) };
                    (place_m, (*target_m - now_m) * rate_hz)
                }
                Grasp::Profile(profile) => {
                    let motion = profile.at((step as f64 + fraction) / rate_hz);
                    (motion.displacement_m, motion.velocity_m_per_s)
                }
            };
            (grasped.index, displacement_m, velocity_m_per_s)
        })
    }

    /// Ends a step.
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn finish(&mut self, model: &Model, step: u64) {
        let rate_hz = model.scene.stepping.rate_hz;
        for grasped in &mut self.grasped {
            let before = grasped.now;
            grasped.held = true;
            grasped.now = match &grasped.grasp {
                Grasp::Target(target_m) => {
                    let velocity_m_per_s = (*target_m - before.displacement_m) * rate_hz;
                    let acceleration_m_per_s2 = (velocity_m_per_s - before.velocity_m_per_s) * rate_hz;
                    Motion { displacement_m: *target_m, velocity_m_per_s, acceleration_m_per_s2 }
                }
                Grasp::Profile(profile) => profile.at((step + 1) as f64 / rate_hz),
            };
        }
    }

    /// Returns the places of the grasped points and their motions at the end of the last step.
    pub(crate) fn grasped(&self) -> impl Iterator<Item = (usize, Motion)> {
        self.grasped.iter().map(|grasped| (grasped.index, grasped.now))
    }

    /// Returns the imposed motion of a point at the end of the last step; `None` for a free point.
    pub(crate) fn motion(&self, model: &Model, index: usize) -> Option<Motion> {
        let fixed = || model.fixed.binary_search(&index).is_ok().then(Motion::default);
        self.grasped.iter().find(|g| g.index == index).map(|g| g.now).or_else(fixed)
    }
}
