//! What every kind of tissue answers: how its section is read, where its points rest, what they weigh, and how fast they
//! vibrate.

use std::fmt;
use std::sync::Arc;

use palpate_geometry::TriangleMesh;

use super::graph::MeshGraph;
use super::profile::Poke;
use super::source::Files;
use super::springs::Springs;
use super::stepping::{Integrator, Stepping};
use super::toml_document::Fields;
use super::volume::Volume;
use crate::limits::Limits;
use crate::shape::{PointId, RestShape};
use palpate_refusal::Result;

/// Largest number of branches of a tissue.
pub const MAX_BRANCHES: usize = 3;

/// A part of the springs' force that relaxes (a spring and a damper in series): γ·(N − z), where z follows the springs' force N,
/// ż = (N − z)/τ.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MaxwellBranch {
    /// γ, relative to the stiffness of the springs; 0 for no branch.
    pub stiffness: f64,
    /// τ, s; above 0.
    pub time_s: f64,
}

impl MaxwellBranch {
    /// Returns whether there is a branch among these.
    pub fn any(branches: &[Self]) -> bool {
        branches.iter().any(|branch| branch.stiffness > 0.0)
    }

    /// Returns 1 + Σγ: how many times as stiff the branches make the springs at once.
    pub fn whole(branches: &[Self]) -> f64 {
        1.0 + branches.iter().map(|branch| branch.stiffness).sum::<f64>()
    }
}

impl Default for MaxwellBranch {
    /// No branch.
    fn default() -> Self {
        MaxwellBranch { stiffness: 0.0, time_s: 1.0 }
    }
}

/// An upper bound of the largest eigenvalue of the springs' stiffness under any deformation, and the place of
/// that vibration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StiffnessBound {
    /// Upper bound of the eigenvalue, with the reference masses, divided by the reference k. It bounds the
    /// Laplacian of the weighted graph, Σ k_ij/m_i·(x_i − x_j) = λ·x_i, since a spring along n contributes at
    /// most k·I to the stiffness under any deformation.
    pub bound: f64,
    /// The number of the vertex that moves most in the fastest vibration (estimated); 0 without springs.
    pub vertex: u32,
    /// The bound for the median spring, in the unit of `bound`: half of the springs have at most this.
    pub usual: f64,
    /// The largest excess of K″/m of a point over the reference value, divided by that value; at least 0.
    pub extra_anchor: f64,
}

impl StiffnessBound {
    /// Returns how many times as fast the fastest vibration is as those of half of the springs.
    pub fn fastest_ratio(&self) -> f64 {
        (self.bound / self.usual).sqrt()
    }
}

/// The ratio of speeds above which a warning names the fastest point.
const MUCH_FASTER: f64 = 2.5;

/// The bound of the stiffness of a mesh whose points are all alike, divided by k.
const EVEN: f64 = 12.0;

/// Returns the strain of springs that have the pretension where they resist it with `stiffness_n_per_m`; 0 without a pretension.
pub(super) fn strain_of(springs: &Springs, stiffness_n_per_m: f64) -> f64 {
    if springs.pretension_n_per_m == 0.0 { 0.0 } else { springs.pretension_n_per_m / stiffness_n_per_m }
}

/// A kind of tissue in the text of scenes, and in parts. The list of kinds in the module `scene` calls it.
pub(super) trait KindOfBody: BodyKind + Sized {
    /// The name of the section of a scene that describes the points.
    const SECTION: &'static str;

    /// Reads the section. `of_material` says that a section `[material]` gives the masses.
    ///
    /// # Errors
    /// Refuses keys and values that the section can't have.
    fn read(fields: &mut Fields<'_>, files: Files<'_>, of_material: bool, limits: &Limits) -> Result<Self>;

    /// Reads the section `[springs]`; may change the tissue, which has just been read. By default there is one k.
    ///
    /// # Errors
    /// Refuses keys and values that the springs of this kind can't have.
    fn read_springs(&mut self, fields: &mut Fields<'_>) -> Result<Springs> {
        Ok(Springs::alike(fields.required_number("stiffness_n_per_m")?))
    }

    /// Returns a small part of the tissue that vibrates as fast as the whole, and three points of it
    /// ([`Body::part`](super::Body::part)).
    fn part(&self, side: usize) -> (Self, [PointId; 3]);

    /// Returns the same tissue with points `spacing_m` (m) apart ([`Body::coarser`](super::Body::coarser)).
    fn coarser(&self, _spacing_m: f64, _half_m: f64) -> Option<(Self, f64)> {
        None
    }

    /// Returns the same tissue with cells of `cell_m` (m), without inclusions. `None` for a tissue without cells, and if such
    /// cells do not fit.
    fn with_cells(&self, _cell_m: f64) -> Option<Self> {
        None
    }
}

/// A kind of tissue, as a scene describes it. [`Body::kind`](super::Body::kind) gives that of a scene; nothing else
/// needs to know which kind it is. Stiffnesses are those of a scene: k of its springs, and K″ of its anchor springs.
pub trait BodyKind: fmt::Debug + Send + Sync {
    /// Returns the name of the section of a scene that describes the points.
    fn section(&self) -> &'static str;

    /// Returns the key of the scene that a refusal names for the number of points, and for what is wrong with all of them.
    fn points_key(&self) -> &'static str;

    /// Returns which key of the section gives the unit of length, as a sentence for people who may have missed it.
    fn unit_hint(&self) -> &'static str;

    /// Returns the rest shape of the points.
    fn shape(&self) -> &dyn RestShape;

    /// Returns the rest shape as a shared pointer that can outlive the scene.
    fn shared_shape(&self) -> Arc<dyn RestShape>;

    /// Returns the reference mass of a point, kg.
    fn point_mass_kg(&self) -> f64;

    /// Returns the mass of all points, kg, fixed ones included.
    fn mass_kg(&self) -> f64;

    /// Returns the mass of a point divided by the reference mass; 1 for a point that there is not.
    fn relative_mass(&self, _point: PointId) -> f64 {
        1.0
    }

    /// Returns K″ of a point divided by the reference value; 1 for a point that there is not.
    fn relative_anchor_stiffness(&self, _point: PointId) -> f64 {
        1.0
    }

    /// Returns the triangle mesh that belongs to a scene besides its text, as its file or its client gave it: clients
    /// upload it, and journals keep it. `None` if the text describes the whole tissue.
    fn mesh(&self) -> Option<TriangleMesh> {
        None
    }

    /// Returns the points and their springs, with k relative to that of the scene, for a kind whose points may be in any
    /// arrangement. The default has no point, which is refused: a kind in rows and columns has a layout of its own in the
    /// module `body` of the tissue.
    fn graph(&self) -> MeshGraph {
        MeshGraph::default()
    }

    /// Adds what tells this tissue from another of the same kind with the same coefficients to the bytes of its identity,
    /// beginning with the name of the kind. `order` has the number of the point at each place in memory, or of none;
    /// empty if the points are in memory in their order.
    fn identify(&self, order: &[u32], add: &mut dyn FnMut(&[u8]));

    /// Returns the volume that the tissue encloses, if its pressure counts.
    fn volume(&self) -> Option<&Volume> {
        None
    }

    /// Returns by which part of its length the pretension stretches each spring at rest; 0 without. The same for all springs.
    fn prestrain(&self, _springs: &Springs) -> f64 {
        0.0
    }

    /// Returns an upper bound of the largest eigenvalue of the springs' stiffness matrix under any deformation, with
    /// the reference masses and without the pressure of a volume, N/m. Anchor stiffness beyond the reference K″
    /// (`anchor_n_per_m`) counts among the springs.
    fn spring_bound_n_per_m(&self, springs: &Springs, anchor_n_per_m: f64) -> f64;

    /// Returns the bound of [`BodyKind::spring_bound_n_per_m`] with the pressure of a volume of the stiffness
    /// `volume_pa`, N/m.
    fn stiffness_bound_n_per_m(&self, springs: &Springs, anchor_n_per_m: f64, _volume_pa: f64) -> f64 {
        self.spring_bound_n_per_m(springs, anchor_n_per_m)
    }

    /// Returns the stiffness that pulls a displaced point of the reference mass back wherever the others are, N/m, with
    /// the reference K″ `anchor_n_per_m`; 0 if nothing does.
    fn restoring_n_per_m(&self, _springs: &Springs, anchor_n_per_m: f64) -> f64 {
        anchor_n_per_m
    }

    /// Returns which vibration [`BodyKind::restoring_n_per_m`] belongs to, in a few words.
    fn slowest_vibration(&self) -> &'static str {
        "a point on its anchor spring alone"
    }

    /// Returns the fastest vibration of the springs, and where it is; `None` where all points are alike.
    fn fastest(&self) -> Option<StiffnessBound> {
        None
    }

    /// Returns how many times the bound of the springs is that of a tissue whose points are all alike, at least 1.
    fn unevenness(&self) -> f64 {
        self.fastest().map_or(1.0, |fastest| (fastest.bound / EVEN).max(1.0))
    }

    /// Returns whether a few points vibrate so fast that they alone require many substeps: more than 2.5 times as fast
    /// as half of the springs ([`StiffnessBound::usual`]).
    fn has_fast_point(&self) -> bool {
        self.fastest().is_some_and(|fastest| fastest.fastest_ratio() > MUCH_FASTER)
    }

    /// Returns whether the vibration in which a volume of the stiffness `volume_pa` swells and shrinks is faster than
    /// the bound for the springs alone, so that it decides on the substeps.
    fn volume_is_fastest(&self, _springs: &Springs, _volume_pa: f64) -> bool {
        false
    }

    /// Returns the place of the fastest vibration as the end of a message: `, most of all at vertex n, (x, y, z) m`;
    /// empty where all points are alike.
    fn fastest_place(&self) -> String {
        let Some(StiffnessBound { vertex, .. }) = self.fastest() else { return String::new() };
        let (shape, point) = (self.shape(), PointId::new(vertex as usize));
        format!(", most of all at {}, {:.4} m", shape.name(point), shape.rest_m(point))
    }

    /// Returns warnings for the user, as sentences; empty if there are none.
    fn warnings(&self) -> Vec<String> {
        Vec::new()
    }

    /// Returns whether frames may show vertices between the points; otherwise they show the points alone.
    fn can_refine(&self) -> bool {
        false
    }

    /// Returns the largest displacement under a constant force, m, an upper bound from the springs at rest. `None` if
    /// nothing bounds it, as without anchor springs, or if the tissue is uniform ([`RestShape::is_uniform`]): there the
    /// force law of its middle tells more. The pressure of a volume has the stiffness `volume_pa`.
    fn indentation_m(&self, _springs: &Springs, _anchor_n_per_m: f64, _volume_pa: f64, _poke: &Poke) -> Option<f64> {
        None
    }

    /// Returns whether the force law of a disc has the stiffness at rest at all depths, because a press to each depth would
    /// take too long.
    fn law_is_linear(&self) -> bool {
        false
    }

    /// Returns the thickness of the tissue under a point, m: the distance straight inward, against its normal, to
    /// another part of the surface. `None` if there is none.
    fn thickness_m(&self, _point: PointId) -> Option<f64> {
        None
    }

    /// Returns the number of cells; `None` for a tissue without cells.
    fn cells(&self) -> Option<usize> {
        None
    }

    /// Returns the stepping of a tissue whose scene says nothing about it.
    fn usual_stepping(&self) -> Stepping {
        Stepping::default()
    }

    /// Returns the measured cost of a point relative to a point of a sheet.
    fn relative_cost(&self) -> f64 {
        1.0
    }

    /// Returns the cost of a substep of a scheme relative to `central`, where `of_sweeps` is that with the springs of the paper.
    fn scheme_cost(&self, of_sweeps: f64) -> f64 {
        of_sweeps
    }

    /// Returns τ of the springs, s: their force is N + τ·Ṅ, with N the elastic force.
    fn viscous_time_s(&self) -> f64 {
        0.0
    }

    /// Returns the parts of the springs' force that relax.
    fn branches(&self) -> [MaxwellBranch; MAX_BRANCHES] {
        [MaxwellBranch::default(); MAX_BRANCHES]
    }

    /// Returns the largest measured factor by which the true error of a script with an integrator may exceed that of a rehearsal.
    fn rehearsal_margin(&self, integrator: Integrator) -> f64;

    /// Returns the strength of a rehearsal's forces, 1 for those that move a point that is held by its own anchor by about a
    /// distance between points. Where points hold each other only, forces on many of them add up.
    fn rehearsal_strength(&self) -> f64 {
        1.0
    }

    /// Returns the approximate memory of the tables of a model, bytes, besides those that every kind has.
    fn table_bytes(&self) -> u64 {
        0
    }

    /// Checks size, mass and spacing against their ranges and the limits.
    ///
    /// # Errors
    /// Names the key of the scene that is out of range.
    fn check(&self, limits: &Limits) -> Result<()>;
}
