//! The immutable half of a tissue: its scene, its points, and the scheme with its substep.

use std::sync::Arc;

use glam::DVec3;

use crate::body::MemoryLayout;
use crate::body::Places;
use crate::body::solid::corner_copies::CornerCopies;
use crate::kernel::field::{BLOCK, Layout, State};
use crate::kernel::real::Real;
use crate::scene::graph::GraphFault;
use crate::scene::{Integrator, Lanes, Precision, Scene};
use crate::scheme::stability;
use crate::scheme::{Oscillator, QuadratureNode, Relaxation, Scheme};
use crate::shape::{self, PointId, RestShape};

/// The immutable half of a tissue, compiled from a scene: points, springs, and the scheme with its substep.
/// [`Model::parse`] and [`Model::compile`] create one; [`at_rest`](crate::at_rest) creates a tissue of it. Many
/// tissues may share it.
#[derive(Debug, Clone)]
pub struct Model {
    /// The scene that the model was compiled from, with zeros without a sign. After a change it has the new
    /// coefficients; its `stepping` stays what the user asked for, and [`Model::plan`] what is used.
    pub scene: Scene,
    /// Rows and columns in memory: those of a sheet, or the slots of a mesh in rows of [`BLOCK`] (a slot is a
    /// vertex's place in memory).
    pub(crate) points: [usize; 2],
    /// Row-major indices of the fixed points, ascending.
    pub(crate) fixed: Vec<usize>,
    /// The unit of length: the distance between neighbours, m.
    pub(crate) unit_m: f64,
    /// By which part of its length the pretension stretches each spring at rest; 0 without.
    pub(crate) prestrain: f64,
    /// Where the points are in memory, and how they differ.
    pub(crate) places: Places,
    /// ω_b = √((λ + K″)/m), rad/s, for a point of the reference mass m; λ is the largest eigenvalue of the
    /// springs' stiffness with branches, K″ that of an anchor spring ([`Oscillator::omega_bound_per_s`]). No vibration is
    /// faster, under any deformation.
    pub omega_bound_per_s: f64,
    /// The scheme and the substep with which a tissue begins. The guard may halve the substep of one tissue
    /// ([`Tissue::plan`](crate::Tissue::plan)).
    pub plan: Plan,
    /// The number format of the state that is used; never `Auto`.
    pub precision: Precision,
    /// Expected error of displacement and force, each relative to the largest of its kind: the larger of the
    /// two, from rehearsals ([`choose`](crate::select::scheme_selection::choose)). Infinite if it is unknown.
    pub expected_error: f64,
    /// Largest error that leaving out tiles at rest may add, relative to the largest displacement, 0 to 1. 0
    /// turns sleep off.
    pub sleep_tolerance: f64,
    /// How many numbers this machine works on at once, as the scene asks or the widest that the processor has;
    /// never `Auto`. The bits of the results don't depend on it.
    pub lanes: Lanes,
    /// Warnings for the user, as sentences that often begin with the key they are about (`stepping.tolerance:
    /// …`). Empty if there are none.
    pub warnings: Vec<String>,
    /// The scheme and the least substeps per step of the last correction ([`Model::corrected()`]), to which
    /// later changes of the tissue keep; `None` before the first.
    pub corrected: Option<(Integrator, u32)>,
    /// Points × substeps of the rehearsals that chose the plan, at most `limits.rehearsal_work`. 0 if nothing
    /// was rehearsed, as for [`Model::resumed`].
    pub rehearsed: u64,
    /// By how much each place in memory lets a volume grow under a pressure, m³/Pa. Empty without a volume, or
    /// before it was computed.
    pub(crate) volume_compliance: Arc<[f64]>,
}

/// A scheme fitted to a substep: how a tissue is advanced by one step.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// The integrator that is used; never `Auto`.
    pub integrator: Integrator,
    /// Substeps per step, at least 1.
    pub substeps: u32,
    /// Length dt of a substep, s: the step divided by `substeps`.
    pub substep_s: f64,
    /// The scheme's coefficients, fitted to the tissue and to dt.
    pub scheme: Scheme,
    /// The moments of a substep at which the tools' force is evaluated, with their weights: [`Scheme::nodes`]
    /// of `scheme`.
    pub nodes: Vec<QuadratureNode>,
    /// The weights of the springs' force now and of the kept fields in what viscosity and branches add to it:
    /// [`Scheme::added_weights`].
    pub(crate) added_weights: Vec<f64>,
    /// Whether the substep is within the stability bound ([`stability::is_stable`]). Only a number of substeps
    /// that the scene gives can be beyond it; then the model has a warning.
    pub stable: bool,
}

impl Plan {
    pub(crate) fn new(integrator: Integrator, substeps: u32, step_s: f64, sheet: &Oscillator) -> Self {
        let plan = Plan::unjudged(integrator, substeps, step_s, sheet);
        let stable = stability::is_stable(&plan.scheme, sheet.scaled_spring_stiffness(plan.substep_s));
        Plan { stable, ..plan }
    }

    /// Creates a plan without checking its stability; a rehearsal detects an instability itself.
    pub(crate) fn unjudged(integrator: Integrator, substeps: u32, step_s: f64, sheet: &Oscillator) -> Self {
        let substep_s = step_s / f64::from(substeps);
        let scaled = sheet.scaled(substep_s);
        let scheme = Scheme::fit(integrator, scaled);
        let (nodes, added_weights) = (scheme.nodes(), scheme.added_weights(&scaled));
        Plan { integrator, substeps, substep_s, scheme, nodes, added_weights, stable: true }
    }

    /// Returns the same scheme with `by` times the substeps.
    pub(crate) fn divided(&self, scene: &Scene, by: u32) -> Self {
        Plan::new(self.integrator, self.substeps * by, scene.stepping.rate_hz.recip(), &Oscillator::of(scene))
    }

    /// Returns whether the substep that ends at `fraction` of a step is its first one.
    pub(crate) fn is_first(&self, fraction: f64) -> bool {
        fraction * f64::from(self.substeps) < 1.5
    }

    /// Returns the work of a force of 1 in the fields of the tools along a displacement of 1, J.
    pub(crate) fn unit_of_work_j(&self, model: &Model) -> f64 {
        model.unit_m / (self.scheme.impulse() * self.force_scale(&model.scene))
    }

    /// Returns the factor from newtons on a point of the reference mass to the unit of force of the springs' tables, 1/N.
    pub(crate) fn spring_unit(&self, scene: &Scene) -> f64 {
        self.scheme.spring_scale() * self.force_scale(scene)
    }

    /// Returns the factor from newtons on a point of the reference mass to the scheme's unit of force:
    /// dt²/(m·h), 1/N.
    pub(crate) fn force_scale(&self, scene: &Scene) -> f64 {
        self.substep_s * self.substep_s / (scene.point_mass_kg() * scene.shape().edge_m())
    }
}

impl Oscillator {
    /// Returns the coefficients of a scene, for a point of the reference mass. Zeros are positive here,
    /// whatever their sign was, so that a division by one gives +∞.
    pub fn of(scene: &Scene) -> Self {
        Oscillator {
            mass_kg: scene.point_mass_kg(),
            damping_n_s_per_m: scene.damping_n_s_per_m + 0.0,
            anchor_stiffness_n_per_m: scene.anchor_stiffness_n_per_m + 0.0,
            spring_stiffness_n_per_m: stability::largest_stiffness_n_per_m(scene),
            viscous_time_s: scene.body.kind().viscous_time_s(),
            branches: scene.body.kind().branches(),
        }
    }
}

impl Model {
    /// Creates a model of a scene with a given plan. Nothing is checked, no error is predicted, and nothing
    /// sleeps.
    ///
    /// # Errors
    /// Returns the fault of springs that can't be laid out.
    pub(crate) fn planned(scene: Scene, plan: Plan, precision: Precision, lanes: Lanes) -> Result<Self, GraphFault> {
        let MemoryLayout { points, fixed, places } = MemoryLayout::of(&scene)?;
        Ok(Model {
            points,
            fixed,
            places,
            unit_m: scene.shape().edge_m(),
            prestrain: scene.prestrain(),
            omega_bound_per_s: Oscillator::of(&scene).omega_bound_per_s(),
            plan,
            precision,
            expected_error: 0.0,
            sleep_tolerance: 0.0,
            lanes,
            warnings: Vec::new(),
            corrected: None,
            rehearsed: 0,
            volume_compliance: Arc::default(),
            scene,
        })
    }

    /// Returns the model of the same tissue with cells of `cell_m` (m) and the same plan: for presses, not for stepping. `None` for a
    /// tissue without cells, and if such cells do not fit.
    pub(crate) fn with_cells(&self, cell_m: f64) -> Option<Self> {
        let scene = self.scene.with_cells(cell_m)?;
        Model::planned(scene, self.plan.clone(), self.precision, self.lanes).ok()
    }

    /// Returns the sleep tolerance of the tiles. Where nothing pulls a tissue back, nothing bounds how far an
    /// omitted force would move it; then only tiles that do not move at all may sleep.
    pub(crate) fn tile_tolerance(&self) -> f64 {
        if Relaxation::of(&self.scene).is_bounded() {
            self.sleep_tolerance
        } else {
            self.sleep_tolerance.min(f64::MIN_POSITIVE)
        }
    }

    /// Returns the memory of the model itself, bytes, approximately: tables of a mesh included, states of
    /// tissues ([`Model::state_bytes`]) not.
    pub fn bytes(&self) -> u64 {
        let fixed = self.fixed.len() * (size_of::<usize>() + size_of::<[usize; 2]>());
        let vectors =
            self.warnings.iter().map(String::len).sum::<usize>() + self.plan.nodes.len() * size_of::<QuadratureNode>();
        (size_of::<Model>() + fixed + vectors) as u64 + self.scene.body.kind().table_bytes()
    }

    /// Returns the memory that a session of this model may take, bytes: three states ([`Model::state_bytes`]:
    /// its own, the guard's checkpoint, and the one at which an audit begins) and the model.
    pub fn session_bytes(&self) -> u64 {
        const STATES: u64 = 3;
        STATES * self.state_bytes() + self.bytes()
    }

    /// Returns the memory of one state of a tissue, bytes: three components of u, d and the scheme's kept
    /// values for each place in memory, padding included, in the model's number format.
    pub fn state_bytes(&self) -> u64 {
        let fields = 2 + self.plan.scheme.kept(self.precision == Precision::Compensated);
        let plane_bytes = match self.precision {
            Precision::F64 => Layout::new::<f64>(self.points).plane * size_of::<f64>(),
            Precision::Auto | Precision::F32 | Precision::Compensated => {
                Layout::new::<f32>(self.points).plane * size_of::<f32>()
            }
        };
        (fields * 3 * plane_bytes) as u64
    }

    /// Returns the rest shape: the points, where they rest, and which are joined.
    pub fn shape(&self) -> &dyn RestShape {
        self.scene.shape()
    }

    /// Returns all points, by ascending index ([`PointId::index`]).
    pub fn points(&self) -> impl ExactSizeIterator<Item = PointId> + Clone + use<> {
        shape::points(self.shape())
    }

    /// Returns the number of points, fixed ones included; at least 1.
    pub fn len(&self) -> usize {
        self.shape().point_count()
    }

    /// Returns the number of places in memory; some places of a mesh are empty.
    pub(crate) fn place_count(&self) -> usize {
        self.points[0] * self.points[1]
    }

    /// Returns the number of rows of a sheet over which a spring reaches.
    pub(crate) fn spring_rows(&self) -> usize {
        if self.scene.springs.bending { 2 } else { 1 }
    }

    /// Returns the row-major place of a point in memory.
    pub(crate) fn place_of(&self, point: PointId) -> usize {
        self.places.place_of(point)
    }

    /// Returns the order in which frames show a mesh, as two lists: the vertex at each position of a frame (in
    /// the order of memory, which keeps neighbours together), and the position of each vertex. One is the
    /// inverse of the other, over [`Model::len`] vertices. `None` for a sheet, which frames show in the order
    /// of its points.
    pub fn shown_order(&self) -> Option<[&[u32]; 2]> {
        self.places.order(self.len())
    }

    /// Returns the point at a place in memory; for an empty place, any point.
    pub(crate) fn point_at(&self, index: usize) -> PointId {
        self.places.point_at(index)
    }

    /// Returns the mass of a point, kg: the reference mass [`Scene::point_mass_kg`] times
    /// [`Scene::relative_mass`].
    pub fn mass_kg(&self, point: PointId) -> f64 {
        self.scene.point_mass_kg() * self.scene.relative_mass(point)
    }

    /// Returns K″ of a point's anchor spring, N/m: the reference value times
    /// [`Scene::relative_anchor_stiffness`].
    pub fn anchor_stiffness_n_per_m(&self, point: PointId) -> f64 {
        self.scene.anchor_stiffness_n_per_m * self.scene.relative_anchor_stiffness(point)
    }

    /// Returns C of a point's damping force −C·v, N·s/m: the reference value times [`Scene::relative_mass`].
    /// C/m is the same at every point.
    pub fn damping_n_s_per_m(&self, point: PointId) -> f64 {
        self.scene.damping_n_s_per_m * self.scene.relative_mass(point)
    }

    /// Returns the mass at a place in memory divided by the reference mass. It divides a force there in the
    /// scheme's units ([`Plan::force_scale`]), and multiplies C.
    pub(crate) fn relative_mass_at(&self, index: usize) -> f64 {
        self.places.relative_mass(index)
    }

    /// Returns K″/m at a place in memory divided by the reference value, minus 1.
    pub(crate) fn extra_anchor_at(&self, index: usize) -> f64 {
        self.places.extra_anchor(index)
    }

    /// Returns K″ at a place in memory divided by the reference value.
    pub(crate) fn relative_anchor_stiffness_at(&self, index: usize) -> f64 {
        self.relative_mass_at(index) * (1.0 + self.extra_anchor_at(index))
    }

    /// Returns Young's modulus of a solid without inclusions, Pa: that of the scene, or another one since.
    pub(crate) fn youngs_modulus_pa(&self) -> f64 {
        self.scene.springs.stiffness_n_per_m / self.unit_m
    }

    /// Returns the stiffness that pulls the point at a place in memory back to where it rests, whatever its neighbours do: that of its anchor
    /// spring, or of a foundation, N/m. The place may be one of these copies of a solid's corners.
    pub(crate) fn own_stiffness_n_per_m(&self, index: usize, copies: Option<&CornerCopies>) -> f64 {
        let corner = copies.map_or(index, |copies| copies.corner_of(index));
        let by_foundation = match &self.places {
            Places::Solid(places) => {
                let mass = copies.map_or_else(|| places.mass(index), |copies| copies.mass(places, index));
                places.foundation_n_per_m * places.bed(corner) * mass
            }
            Places::Sheet(_) | Places::Surface(_) => 0.0,
        };
        self.scene.anchor_stiffness_n_per_m * self.relative_anchor_stiffness_at(corner) + by_foundation
    }

    /// Returns whether the point at a place in memory has an anchor spring that may be severed. (A change of the tissue may have set all K″
    /// to 0.)
    pub(crate) fn has_severable_anchor(&self, index: usize) -> bool {
        let is_anchored = self.relative_anchor_stiffness_at(index) > 0.0;
        let is_point = matches!(self.places, Places::Sheet(_)) || self.places.joined(index).next().is_some();
        let is_free = self.fixed.binary_search(&index).is_err();
        self.scene.cutting.anchor_depth_m.is_some() && is_point && is_anchored && is_free
    }

    /// Returns the number of places that a substep computes with all points awake: rows times columns in
    /// memory, a row counting as at least 16 columns, because a short row costs as much as one of a vector's
    /// width.
    pub fn swept_points(&self) -> usize {
        self.rows_of_points() * self.points[1].max(BLOCK)
    }

    /// Returns the number of rows in memory that points are in; beyond them are the spare places of a solid.
    pub(crate) fn rows_of_points(&self) -> usize {
        self.places.solid().map_or(self.points[0], |solid| solid.corner_rows())
    }

    /// Returns false always: a tissue has at least one point.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// Returns the row and column of a row-major index.
    pub(crate) fn point_of(&self, index: usize) -> [usize; 2] {
        [index / self.points[1], index % self.points[1]]
    }

    /// Returns the row-major index of a row and column.
    pub(crate) fn index_of(&self, [i, j]: [usize; 2]) -> usize {
        i * self.points[1] + j
    }
}

/// Returns the displacement of a point from rest, m. For a multistep scheme, it is the predicted one.
#[inline]
pub(crate) fn displacement_m<T: Real>(model: &Model, layout: &Layout, state: &State<T>, [i, j]: [usize; 2]) -> DVec3 {
    let at = i * layout.stride + j;
    let component = |c: usize| state.u[c * layout.plane + at].wide() * model.unit_m;
    DVec3::new(component(0), component(1), component(2))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::lanes;
    use crate::limits::Limits;
    use crate::scene::profile::Poke;

    /// Small, and without a rehearsal: for machines that are emulated, and for memcheck.
    #[test]
    fn a_plan_gives_the_same_bits_on_every_machine() {
        let scene =
            Scene::parse("paper", crate::scene::PAPER, &["sheet.points=[5, 18]".to_owned()], &Limits::default());
        let (scene, mut hashes) = (scene.unwrap(), Vec::new());
        // One or two of each family: their bits are written down below.
        for (integrator, precision) in [
            (Integrator::Central, Precision::F32),
            (Integrator::Rk4, Precision::F64),
            (Integrator::Exponential2, Precision::F32),
            (Integrator::Exponential3, Precision::F64),
            (Integrator::Exponential4, Precision::Compensated),
        ] {
            let plan = Plan::new(integrator, 2, scene.stepping.rate_hz.recip(), &Oscillator::of(&scene));
            let widths =
                [Lanes::Plain, Lanes::Neon, Lanes::Avx2, Lanes::Avx512].into_iter().filter_map(lanes::available);
            let hash = |lanes| {
                let model = Arc::new(Model::planned(scene.clone(), plan.clone(), precision, lanes).unwrap());
                let mut tissue = crate::at_rest(&model);
                for (tool, point) in [[0, 0], [3, 11]].into_iter().enumerate() {
                    let force_n = glam::DVec3::new(0.7, 0.2, -0.9) * [1.0, -1.5][tool];
                    let (centre_m, falloff_per_m) = (scene.shape().rest_m(scene.sheet().unwrap().point(point)), 25.0);
                    let poke = Poke { point: None, centre_m, force_n, falloff_per_m, falloff_offset: 0.0 };
                    tissue.push(tool, Some(crate::Push::Constant(poke)));
                }
                (0..20).for_each(|_| tissue.step().unwrap());
                format!("{:032x}", tissue.state_hash())
            };
            let mut same = widths.map(hash).collect::<Vec<_>>();
            same.dedup();
            hashes.push(same.join(" "));
        }
        assert_eq!(hashes, GOLDEN);
    }

    const GOLDEN: [&str; 5] = [
        "a915f94506d76543883f5a43890290ce",
        "8d95e9119a481c9362c190e7b7d1a3c2",
        "b8601699a70ee0cc686d456d84ed1d2e",
        "83a4672a09aa9fcfbccb48193d6e98c8",
        "d8f80cac7b2adfaa3508266eae6561de",
    ];
}
