//! Reads the motion of points and the forces on them from a state.

use glam::DVec3;

use crate::body::model::{Model, Plan};
use crate::body::tables::SweepTables;
use crate::interface::PointState;
use crate::kernel::field::State;
use crate::kernel::lanes::{self, Scalar, SingleWork};
use crate::kernel::real::Real;
use crate::scene::profile::Moment;
use crate::scheme::arithmetic::MAX_KEPT;
use crate::scheme::observer::Observer;
use crate::state::sleep::tiles::SleepTiles;
use crate::tools::applied_force::Applied;
use crate::tools::contact::Contacts;
use crate::tools::prescribed::Prescribed;

/// A reader of points: what is the same for all points is computed once.
pub(super) struct PointReader<'a, T: Real> {
    pub(super) model: &'a Model,
    pub(super) plan: &'a Plan,
    pub(super) tables: &'a SweepTables<T>,
    pub(super) state: &'a State<T>,
    pub(super) applied: &'a Applied<T>,
    pub(super) prescribed: &'a Prescribed,
    pub(super) contacts: &'a Contacts,
    pub(super) tiles: &'a SleepTiles<T>,
    pub(super) steps: u64,
    /// Growth of the volume, in cubes of the unit of length.
    pub(super) volume_change: f64,
    pub(super) observer: Observer<f64>,
    /// [`Plan::spring_unit`].
    pub(super) spring_unit: f64,
}

impl<T: Real> PointReader<'_, T> {
    /// Returns the force of force-controlled tools on a place in memory, N.
    fn applied_n(&self, index: usize) -> DVec3 {
        match self.steps {
            0 => self.applied.from(self.model, index, Moment::start_of(0)),
            _ => self.applied.until(self.model, index),
        }
    }

    /// Returns the motion of the point at a place in memory, and the forces on it.
    pub(super) fn point(&self, index: usize) -> PointState {
        let (model, scene) = (self.model, &self.model.scene);
        let applied_n = self.applied_n(index);
        let [mut displacement_m, mut velocity_m_per_s, spring_n] = self.free_point(index, applied_n);
        let motion = self.prescribed.motion(model, index);
        if let Some(motion) = motion {
            (displacement_m, velocity_m_per_s) = (motion.displacement_m, motion.velocity_m_per_s);
        }
        let mass = self.tables.relative_mass_at(model, index);
        let anchor_n = -self.tables.anchor_stiffness_at_n_per_m(model, index) * displacement_m;
        let damping_n = -scene.damping_n_s_per_m * mass * velocity_m_per_s;
        let constraint_n = motion.map(|motion| {
            let inertia_n = scene.point_mass_kg() * mass * motion.acceleration_m_per_s2;
            inertia_n - spring_n - anchor_n - damping_n - applied_n
        });
        PointState { displacement_m, velocity_m_per_s, spring_n, anchor_n, damping_n, applied_n, constraint_n }
    }

    /// Returns the force on a free point except that of tips and inertia, N: that of springs, anchor springs, damping and
    /// force-controlled tools; before the first step without the latter.
    pub(super) fn force_on_free_n(&self, index: usize, mass: f64) -> DVec3 {
        let scene = &self.model.scene;
        let applied_n = if self.steps == 0 { DVec3::ZERO } else { self.applied.until(self.model, index) };
        let [u, v, spring_n] = self.free_point(index, applied_n);
        let anchor_n = -self.tables.anchor_stiffness_at_n_per_m(self.model, index) * u;
        let damping_n = -mass * scene.damping_n_s_per_m * v;
        spring_n + anchor_n + damping_n + applied_n
    }

    /// Returns the velocity that a grasped point would have if it were free, m/s.
    pub(super) fn free_velocity_m_per_s(&self, index: usize) -> DVec3 {
        let [_, velocity_m_per_s, _] = self.free_point(index, self.applied.until(self.model, index));
        velocity_m_per_s
    }

    /// Returns displacement, velocity and springs' force of a free point, under the applied force `applied_n`
    /// and that of tips.
    fn free_point(&self, index: usize, applied_n: DVec3) -> [DVec3; 3] {
        lanes::single(&Observation { reader: self, index, applied_n })
    }
}

/// The observation of a free point.
struct Observation<'r, 'a, T: Real> {
    reader: &'r PointReader<'a, T>,
    index: usize,
    applied_n: DVec3,
}

impl<T: Real> SingleWork for Observation<'_, '_, T> {
    type Output = [DVec3; 3];

    // Loops over indices: iterators are not always inlined, and then run without the caller's instructions.
    #[allow(clippy::needless_range_loop)]
    #[inline(always)]
    fn compute(&self) -> [DVec3; 3] {
        let Observation { reader, index, applied_n } = *self;
        let PointReader { model, plan, tables, state, .. } = *reader;
        let springs = tables.springs.gather_inline(
            &tables.severed,
            &tables.layout,
            &state.u,
            reader.volume_change,
            model.point_of(index),
        );
        let [i, j] = model.point_of(index);
        let mass = tables.relative_mass_at(model, index);
        let still = reader.steps == 0 || !reader.tiles.region.is_awake(i, j);
        // Without all present forces, a two-step scheme would report a velocity for a point that rests under a
        // tip.
        let tips_n = if plan.scheme.takes_means() { reader.contacts.steady_on(model, index) } else { DVec3::ZERO };
        let pushed_n = applied_n + tips_n;
        let mut found = [DVec3::ZERO; 3];
        for c in 0..3 {
            let n = springs[c];
            let at = c * tables.layout.plane + tables.layout.offset(index);
            let one = Scalar::<f64>;
            let mut kept = [one(0.0); MAX_KEPT];
            for k in 0..state.kept.len() {
                kept[k] = one(state.kept[k][at].wide());
            }
            let (u, d, n) = (one(state.u[at].wide()), one(state.d[at].wide()), one(n.wide()));
            let force = one(reader.spring_unit * pushed_n[c] / mass);
            let [u, w, _] = reader.observer.observe(u, d, n, &kept, Some(force));
            found[0][c] = u.0 * model.unit_m;
            found[1][c] = if still { 0.0 } else { w.0 * model.unit_m / plan.substep_s };
            // At rest nothing resists.
            let mut added = 0.0;
            if !still && !plan.added_weights.is_empty() {
                added = plan.added_weights[0] * n.0;
                for k in 1..plan.added_weights.len() {
                    added += plan.added_weights[k] * kept[k - 1].0;
                }
            }
            let of_axis = [n.0 + added, state.u[at].wide()];
            found[2][c] = tables.spring_force_n(model, [reader.spring_unit, mass], index, of_axis);
        }
        found
    }
}
