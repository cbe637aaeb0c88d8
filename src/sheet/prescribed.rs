//! Points that do not move freely: fixed points and grasped points.

use glam::DVec3;

use super::Sheet;
use super::integrate::Scheme;
use super::model::Model;
use super::real::Real;
use crate::scene::law::{Moment, Motion, MoveLaw};

/// How a tool moves its grasped point.
#[derive(Debug, Clone, PartialEq)]
pub enum Grasp {
    /// To this displacement by the end of the step, at constant velocity; then it stays.
    Held(DVec3),
    /// A law of time, exact within the step.
    Law(MoveLaw),
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

/// All points that do not move freely.
#[derive(Debug, Clone)]
pub(super) struct Prescribed {
    grasped: Vec<Grasped>,
    /// Released points and their velocities, until the coming substep.
    released: Vec<(usize, DVec3)>,
}

impl Prescribed {
    pub(super) fn new() -> Self {
        Prescribed { grasped: Vec::new(), released: Vec::new() }
    }

    /// Whether no point is grasped and none was released just now.
    pub(super) fn is_empty(&self) -> bool {
        self.grasped.is_empty() && self.released.is_empty()
    }

    /// From the coming step on `tool` moves the point at `index`, which now moves like `now`, and releases the point it
    /// held before. A point that another tool holds is taken over.
    pub(super) fn grasp(&mut self, tool: usize, index: usize, grasp: Grasp, now: Motion) {
        if let Some(place) = self.grasped.iter().position(|g| g.index == index) {
            let taken = Grasped { tool, grasp, ..self.grasped.remove(place) };
            self.release(tool);
            return self.grasped.push(taken);
        }
        self.release(tool);
        let now = match &grasp {
            Grasp::Held(_) => now,
            Grasp::Law(law) => law.at(0.0),
        };
        self.grasped.push(Grasped { tool, index, grasp, now, held: false });
    }

    /// `tool` releases its point. The point keeps its velocity.
    pub(super) fn release(&mut self, tool: usize) {
        let Some(place) = self.grasped.iter().position(|g| g.tool == tool) else { return };
        let grasped = self.grasped.remove(place);
        // A point that was grasped and released at the same boundary was never held.
        if grasped.held {
            self.released.push((grasped.index, grasped.now.velocity_m_per_s));
        }
    }

    /// The tools that grasp a point.
    pub(super) fn tools(&self) -> impl Iterator<Item = usize> {
        self.grasped.iter().map(|grasped| grasped.tool)
    }

    /// The points released since the last call, and their velocities, m/s.
    pub(super) fn take_released(&mut self) -> Vec<(usize, DVec3)> {
        std::mem::take(&mut self.released)
    }

    /// The grasped points at `fraction` of step `step`: index, displacement and velocity.
    #[allow(clippy::cast_precision_loss)]
    pub(super) fn at(&self, model: &Model, step: u64, fraction: f64) -> impl Iterator<Item = (usize, DVec3, DVec3)> {
        let rate_hz = model.scene.stepping.rate_hz;
        self.grasped.iter().map(move |grasped| {
            let (displacement_m, velocity_m_per_s) = match &grasped.grasp {
                Grasp::Held(target_m) => {
                    let now_m = grasped.now.displacement_m;
                    let place_m = if fraction >= 1.0 { *target_m } else { now_m.lerp(*target_m, fraction) };
                    (place_m, (*target_m - now_m) * rate_hz)
                }
                Grasp::Law(law) => {
                    let motion = law.at((step as f64 + fraction) / rate_hz);
                    (motion.displacement_m, motion.velocity_m_per_s)
                }
            };
            (grasped.index, displacement_m, velocity_m_per_s)
        })
    }

    /// Ends a step.
    #[allow(clippy::cast_precision_loss)]
    pub(super) fn finish(&mut self, model: &Model, step: u64) {
        let rate_hz = model.scene.stepping.rate_hz;
        for grasped in &mut self.grasped {
            let before = grasped.now;
            grasped.held = true;
            grasped.now = match &grasped.grasp {
                Grasp::Held(target_m) => {
                    let velocity_m_per_s = (*target_m - before.displacement_m) * rate_hz;
                    let acceleration_m_per_s2 = (velocity_m_per_s - before.velocity_m_per_s) * rate_hz;
                    Motion { displacement_m: *target_m, velocity_m_per_s, acceleration_m_per_s2 }
                }
                Grasp::Law(law) => law.at((step + 1) as f64 / rate_hz),
            };
        }
    }

    /// The grasped points and how they moved at the end of the last step.
    pub(super) fn grasped(&self) -> impl Iterator<Item = (usize, Motion)> {
        self.grasped.iter().map(|grasped| (grasped.index, grasped.now))
    }

    /// The imposed motion of a point at the end of the last step, if it has one.
    pub(super) fn motion(&self, model: &Model, index: usize) -> Option<Motion> {
        let fixed = || model.fixed.binary_search(&index).is_ok().then(Motion::default);
        self.grasped.iter().find(|g| g.index == index).map(|g| g.now).or_else(fixed)
    }
}

impl<T: Real> Sheet<T> {
    /// Puts the grasped points at their places at `fraction` of the step, and counts the work if `counted`.
    pub(super) fn hold(&mut self, step: u64, fraction: f64, counted: bool) {
        let unit_j = self.unit_of_work_j();
        let Sheet { model, plan, bench, state, prescribed, work, .. } = self;
        let spacing_m = model.scene.sheet.spacing_m;
        for (index, displacement_m, velocity_m_per_s) in prescribed.at(model, step, fraction) {
            let mut product = 0.0;
            for c in 0..3 {
                let at = c * bench.layout.plane + bench.layout.place(index);
                let (free_u, free_d) = (state.u[at], state.d[at]);
                state.u[at] = T::of(displacement_m[c] / spacing_m);
                state.d[at] = if plan.scheme.takes_means() {
                    // Undo the scheme's own movement: the increment starts from where the point was before.
                    state.u[at] - (free_u - free_d)
                } else {
                    T::of(velocity_m_per_s[c] * plan.substep_s / spacing_m)
                };
                product += (state.d[at].wide() - free_d.wide()) * state.d[at].wide();
            }
            if counted {
                work.add(product * unit_j);
            }
        }
    }

    /// The change of u and d of a point that is released with `velocity`, so that it continues smoothly.
    ///
    /// For a two-step scheme, a release is a jump: before it the whole force on the point without damping was m·a + C·v
    /// with the tool's a and v; after it, the force is F = spring + applied − K″·u. At a jump such a scheme needs the
    /// mean of both (see `applied`), and it uses F with the mean of the applied force. The tool moved at constant
    /// velocity, so a = 0: the point gets ½(C·v + F) less that. In terms of the increment, this is q times the
    /// difference.
    ///
    /// For a multistep scheme, u and d are predictions that the next substep corrects. The tool's values are already
    /// right, so the correction is subtracted.
    pub(super) fn change_at_release(&self, index: usize, velocity_m_per_s: DVec3, moment: Moment) -> [[f64; 2]; 3] {
        let Sheet { model, plan, bench, state, applied, .. } = self;
        let springs = bench.springs.gather(&bench.layout, &state.u, model.point_of(index)).map(Real::wide);
        match &plan.scheme {
            Scheme::TwoStep(two) => {
                let (scale, scene) = (plan.force_scale(&model.scene), &model.scene);
                let applied_n = applied.from(model, index, moment);
                let force = applied.force_at(&bench.layout, 0, model.point_of(index));
                std::array::from_fn(|c| {
                    let at = c * bench.layout.plane + bench.layout.place(index);
                    let elastic = springs[c] - two.q * two.a * state.u[at].wide();
                    let used = elastic + force[c];
                    let lost = scene.damping_n_s_per_m * velocity_m_per_s[c] + applied_n[c];
                    let kick = 0.5 * (two.q * scale * lost + elastic) - used;
                    [kick, kick]
                })
            }
            Scheme::Multistep(multistep) => std::array::from_fn(|c| {
                let at = c * bench.layout.plane + bench.layout.place(index);
                let surprise = multistep.surprise(&state.history(springs[c], multistep.order, at));
                multistep.correction.map(|weight| -weight * surprise)
            }),
            Scheme::Rk4 { .. } => [[0.0; 2]; 3],
        }
    }
}
