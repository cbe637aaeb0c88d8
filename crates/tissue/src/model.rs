//! The immutable half of a sheet: its scene, its points, and the scheme with its substep.

use std::sync::Arc;

use crate::body::surface::{GraphFault, MeshPlaces};
use crate::kernel::field::{BLOCK, Layout};
use crate::scene::{Body, Integrator, Lanes, Precision, Scene};
use crate::scheme::stability;
use crate::scheme::{Oscillator, QuadratureNode, Scheme};
use crate::shape::{self, PointId, RestShape};

/// The immutable half of a sheet.
#[derive(Debug, Clone)]
pub struct Model {
    /// What it was compiled from.
    pub scene: Scene,
    /// Rows and columns in memory: those of a sheet, or slots of a mesh in rows of [`BLOCK`].
    pub(super) points: [usize; 2],
    /// Row-major indices of the fixed points, ascending.
    pub(super) fixed: Vec<usize>,
    /// The unit of length: the distance between neighbours, m.
    pub(super) unit_m: f64,
    /// Where the points of a mesh are in memory, and its springs; none for a sheet.
    pub(super) graph: Option<Arc<MeshPlaces>>,
    /// ω_b = √((largest spring stiffness + K″)/m): no vibration is faster, under any deformation, rad/s.
    pub omega_bound_per_s: f64,
    /// The scheme.
    pub plan: Plan,
    /// What `auto` became.
    pub precision: Precision,
    /// Expected error of displacement and force, relative to the largest of each (`choice`).
    pub expected_error: f64,
    /// Error that leaving out tiles at rest may cost, relative to the largest displacement.
    pub sleep_tolerance: f64,
    /// What `auto` became on this machine.
    pub lanes: Lanes,
    /// What a user should know, in words.
    pub warnings: Vec<String>,
    /// What a correction asked for, also with another tissue: the scheme, and no fewer substeps than this.
    pub corrected: Option<(Integrator, u32)>,
    /// Points × substeps of the rehearsals by which it was chosen: at most `limits.rehearsal_work`.
    pub rehearsed: u64,
    /// By how much each place in memory lets a volume grow under a pressure, m³/Pa; empty if nobody has found out, or without a
    /// volume.
    pub(super) volume_compliance: Arc<[f64]>,
}

/// A scheme with its substep.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// What `auto` became.
    pub integrator: Integrator,
    /// Substeps a step.
    pub substeps: u32,
    /// Length of a substep, s.
    pub substep_s: f64,
    /// The scheme, fitted to the substep.
    pub scheme: Scheme,
    /// How the tools' force enters a substep.
    pub nodes: Vec<QuadratureNode>,
    /// Whether the substep is within the stability bound. It always is if the number was not given.
    pub stable: bool,
}

impl Plan {
    pub(super) fn new(integrator: Integrator, substeps: u32, step_s: f64, sheet: &Oscillator) -> Self {
        let plan = Plan::unjudged(integrator, substeps, step_s, sheet);
        let stable = stability::is_stable(&plan.scheme, sheet.scaled_spring_stiffness(plan.substep_s));
        Plan { stable, ..plan }
    }

    /// The same without a look at its stability, which a rehearsal sees for itself.
    pub(super) fn unjudged(integrator: Integrator, substeps: u32, step_s: f64, sheet: &Oscillator) -> Self {
        let substep_s = step_s / f64::from(substeps);
        let (a, g) = sheet.scaled(substep_s);
        let scheme = Scheme::fit(integrator, a, g);
        let nodes = scheme.nodes();
        Plan { integrator, substeps, substep_s, scheme, nodes, stable: true }
    }

    /// The same scheme with a shorter substep.
    pub(super) fn divided(&self, scene: &Scene, by: u32) -> Self {
        Plan::new(self.integrator, self.substeps * by, scene.stepping.rate_hz.recip(), &Oscillator::of(scene))
    }

    /// What turns newtons on a point of the mass of reference into the scheme's unit of force: dt²/(m·h), 1/N.
    pub(super) fn force_scale(&self, scene: &Scene) -> f64 {
        self.substep_s * self.substep_s / (scene.point_mass_kg() * scene.shape().edge_m())
    }
}

impl Oscillator {
    /// Returns the coefficients of a scene. A zero is positive here, whatever its sign was: what is divided by it is infinite, not below all.
    pub fn of(scene: &Scene) -> Self {
        Oscillator {
            mass_kg: scene.point_mass_kg(),
            damping_n_s_per_m: scene.damping_n_s_per_m + 0.0,
            anchor_stiffness_n_per_m: scene.anchor_stiffness_n_per_m + 0.0,
            spring_stiffness_n_per_m: stability::largest_stiffness_n_per_m(scene),
        }
    }
}

impl Model {
    /// Of a scene with a scheme that somebody else has chosen: nothing is checked, nothing expected, nothing sleeps.
    ///
    /// # Errors
    /// What is wrong with the springs of a mesh.
    pub(super) fn planned(scene: Scene, plan: Plan, precision: Precision, lanes: Lanes) -> Result<Self, GraphFault> {
        let (points, fixed, graph) = match &scene.body {
            Body::Sheet(sheet) => (sheet.points, sheet.fixed_indices(), None),
            Body::Mesh(mesh) => {
                let graph = MeshPlaces::of(mesh)?;
                let points = shape::points(&*mesh.shape).filter(|point| mesh.shape.is_fixed(*point));
                let mut fixed: Vec<usize> = points.map(|point| graph.slot_of(point)).collect();
                fixed.sort_unstable();
                ([graph.rows(), BLOCK], fixed, Some(Arc::new(graph)))
            }
        };
        Ok(Model {
            points,
            fixed,
            graph,
            unit_m: scene.shape().edge_m(),
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

    /// The tolerance of the sheet's tiles. Without anchor springs nothing bounds how far an omitted force would move a
    /// sheet, so then only what does not move at all may sleep.
    pub(super) fn tile_tolerance(&self) -> f64 {
        let bounded = self.scene.anchor_stiffness_n_per_m > 0.0;
        if bounded { self.sleep_tolerance } else { self.sleep_tolerance.min(f64::MIN_POSITIVE) }
    }

    /// Returns what the model itself takes, bytes.
    pub fn bytes(&self) -> u64 {
        let fixed = self.fixed.len() * (size_of::<usize>() + size_of::<[usize; 2]>());
        let vectors =
            self.warnings.iter().map(String::len).sum::<usize>() + self.plan.nodes.len() * size_of::<QuadratureNode>();
        (size_of::<Model>() + fixed + vectors) as u64 + self.mesh_bytes()
    }

    /// What the tables of a mesh take, bytes, about: places, neighbours, and each spring from both of its ends, as the file of
    /// the scene has it and as the kernel reads it.
    fn mesh_bytes(&self) -> u64 {
        const OF_A_VERTEX: usize = 256;
        const OF_A_SPRING: usize = 192;
        const ENCLOSING: usize = 104;
        match &self.scene.body {
            Body::Sheet(_) => 0,
            Body::Mesh(mesh) => {
                let springs = mesh.shape.edges().len() + mesh.shape.opposite().len();
                let shown = mesh.shape.shown().map_or(0, |shown| shown.places.len());
                let enclosing = if mesh.volume.is_some() { ENCLOSING * self.len() } else { 0 };
                (OF_A_VERTEX * (self.len() + shown) + OF_A_SPRING * springs + enclosing) as u64
            }
        }
    }

    /// Returns what a session of it may take, bytes: its state, the checkpoint, and one more that an audit begins from.
    pub fn session_bytes(&self) -> u64 {
        const STATES: u64 = 3;
        STATES * self.state_bytes() + self.bytes()
    }

    /// Returns what the state of a sheet takes, bytes: three components of u, d and what the scheme keeps, of each place in memory.
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

    /// Returns the rest shape.
    pub fn shape(&self) -> &dyn RestShape {
        self.scene.shape()
    }

    /// Returns all points.
    pub fn points(&self) -> impl ExactSizeIterator<Item = PointId> + Clone + use<> {
        shape::points(self.shape())
    }

    /// Returns the number of points.
    pub fn len(&self) -> usize {
        self.shape().point_count()
    }

    /// Places of points in memory; some of those of a mesh are empty.
    pub(super) fn places(&self) -> usize {
        self.points[0] * self.points[1]
    }

    /// The place of a point in memory, by rows.
    pub(super) fn place_of(&self, point: PointId) -> usize {
        self.graph.as_ref().map_or(point.index(), |graph| graph.slot_of(point))
    }

    /// Returns the vertices of a mesh in the order in which frames show them, that of memory, which keeps neighbours
    /// together; and the place of each vertex in that order. `None` for a sheet, which is shown in the order of its
    /// points.
    pub fn shown_order(&self) -> Option<[&[u32]; 2]> {
        let slots = &self.graph.as_ref()?.slots;
        // What is empty is at the end.
        Some([&slots.vertex_of()[..self.len()], slots.slot_of()])
    }

    /// The point at a place in memory; of an empty one, any.
    pub(super) fn point_at(&self, index: usize) -> PointId {
        self.graph.as_ref().map_or(PointId::new(index), |graph| graph.point_in(index))
    }

    /// Returns the mass of a point, that of reference times the point's factor, kg.
    pub fn mass_kg(&self, point: PointId) -> f64 {
        self.scene.point_mass_kg() * self.scene.relative_mass(point)
    }

    /// Returns K″ of a point, N/m.
    pub fn anchor_stiffness_n_per_m(&self, point: PointId) -> f64 {
        self.scene.anchor_stiffness_n_per_m * self.scene.relative_anchor_stiffness(point)
    }

    /// Returns C of a point, N·s/m: C/m is the same at every point.
    pub fn damping_n_s_per_m(&self, point: PointId) -> f64 {
        self.scene.damping_n_s_per_m * self.scene.relative_mass(point)
    }

    /// The mass at a place in memory over that of reference: what divides a force on it in the scheme's units
    /// ([`Plan::force_scale`]), and multiplies C.
    pub(super) fn relative_mass_at(&self, index: usize) -> f64 {
        self.graph.as_ref().map_or(1.0, |graph| graph.slots.mass(index))
    }

    /// K″/m at a place in memory over that of reference, minus 1.
    pub(super) fn extra_anchor_at(&self, index: usize) -> f64 {
        self.graph.as_ref().map_or(0.0, |graph| graph.slots.extra_at(index))
    }

    /// K″ at a place in memory over that of reference.
    pub(super) fn relative_anchor_stiffness_at(&self, index: usize) -> f64 {
        self.relative_mass_at(index) * (1.0 + self.extra_anchor_at(index))
    }

    /// Returns what a substep computes, in points: rows are padded, and a short one costs what one of a vector's width
    /// does.
    pub fn swept_points(&self) -> usize {
        self.points[0] * self.points[1].max(BLOCK)
    }

    /// Returns false: a sheet has at least one point.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// Row and column of the point with a row-major index.
    pub(super) fn point_of(&self, index: usize) -> [usize; 2] {
        [index / self.points[1], index % self.points[1]]
    }

    /// The row-major index of the point at a row and column of the sheet.
    pub(super) fn index_of(&self, [i, j]: [usize; 2]) -> usize {
        i * self.points[1] + j
    }
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
