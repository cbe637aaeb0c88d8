//! Computes how stiff the tissue is under a disc: its tangent stiffness around the present state, and the force
//! law of a slow press.
//!
//! Let E be the weights of the disc (`footprint`), one column per direction, and K the tangent stiffness of the
//! tissue. A disc that moves quasi-statically by ds is pushed back by S·ds, S = (Eᵀ K⁻¹ E)⁻¹: three solutions
//! K·φ = E. The shape φ̂ = φ·S, the displacement of all points per unit of the disc's, also gives damping and
//! mass: B = C·φ̂ᵀφ̂, the derivative of the disc's impedance at rest, and M = m·φ̂ᵀφ̂. A disc that slides
//! carries its dimple along, and moves each point by −∂u/∂x·v: drag D = C·Σ ∂u·∂u.
//!
//! K of a spring along n is k[nnᵀ + max(0, 1 − L0/L)(I − nnᵀ)]: without the clamp a compressed spring would
//! make it indefinite. The pressure of a volume adds κ/V0·a·aᵀ over all points: those far away are held too, so
//! κ is reduced by what they would yield ([`volume_compliance`]). The solver is conjugate gradients (Hestenes
//! and Stiefel, Journal of Research of the National Bureau of Standards 49(6), 1952, doi:10.6028/jres.049.044),
//! all systems side by side, preconditioned by the points' own blocks. Points too far away to notice are
//! held: a press reaches √(k/K″) spacings.
//!
//! A tissue with cuts is pressed as it is: without the severed springs, with the copies of a solid's corners, and gaping if it has a
//! pretension.

use std::cell::Cell;
use std::sync::atomic::{AtomicBool, Ordering};

use glam::{DMat3, DQuat, DVec3};

use crate::body::MemoryLayout;
use crate::body::elements::Elements;
use crate::body::footprint::{Footprint, WeightedNode, mass_at};
use crate::body::model::Model;
use crate::body::severed::Cuts;
use crate::body::window::Window;
use crate::memory;

/// The accuracy of a solution: the bounds at which the solvers stop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Accuracy {
    /// Residual of the linear systems of a tangent, relative to the right-hand side.
    residual: f64,
    /// Residual of the linear systems within Newton's method, relative to the right-hand side.
    approximate_residual: f64,
    /// Newton's method stops when no point moves farther than this, in spacings.
    arrived: f64,
}

impl Accuracy {
    /// Forces with a relative error of about 10⁻⁵.
    pub const EXACT: Self = Accuracy { residual: 1e-5, approximate_residual: 1e-3, arrived: 1e-5 };
    /// Forces with a relative error of about 10⁻³, for a third of the work.
    pub const COARSE: Self = Accuracy { residual: 1e-2, approximate_residual: 1e-2, arrived: 1e-3 };
}

/// Most iterations of conjugate gradients.
const MAX_ITERATIONS: u32 = 400;

/// The work that may still be done, and whether the result is still wanted.
#[derive(Debug, Clone)]
struct Allowance<'a> {
    /// Springs times iterations that are left.
    left: Cell<u64>,
    stop: Option<&'a AtomicBool>,
}

impl Default for Allowance<'_> {
    fn default() -> Self {
        Allowance { left: Cell::new(u64::MAX), stop: None }
    }
}

impl<'a> Allowance<'a> {
    /// Allows `work` springs times iterations, until `stop` is set.
    fn of(work: u64, stop: &'a AtomicBool) -> Self {
        Allowance { left: Cell::new(work), stop: Some(stop) }
    }

    /// Takes some work from it. Returns false if not that much is left or `stop` is set; then nothing is left.
    fn take(&self, work: usize) -> bool {
        let is_wanted = self.stop.is_none_or(|stop| !stop.load(Ordering::Relaxed));
        let left = if is_wanted { self.left.get().checked_sub(work as u64) } else { None };
        self.left.set(left.unwrap_or(0));
        left.is_some()
    }

    /// Returns whether some work had to be left out.
    fn is_spent(&self) -> bool {
        self.left.get() == 0
    }
}

/// The tissue around a disc, linearised at given displacements: its springs, anchor springs and the pressure of a
/// volume. Points at the border of its window are held.
#[derive(Debug)]
pub struct LinearPatch<'m> {
    model: &'m Model,
    window: Window,
    /// Displacement from rest, m.
    displacement_m: Vec<DVec3>,
    /// Whether a point moves.
    free: Vec<bool>,
    /// E, one weight per point.
    weights: Vec<f64>,
    /// Mass of each point divided by the reference value.
    masses: Vec<f64>,
    /// What pulls each point back to where it rests, N/m.
    own_n_per_m: Vec<f64>,
    elements: Elements,
    /// The loads that severed springs have left on points, N: the tissue at rest is not where it is without cuts.
    loads_n: Vec<(usize, DVec3)>,
    pressure: Option<SharedPressure>,
    inverses: Vec<DMat3>,
    accuracy: Accuracy,
    allowance: Allowance<'m>,
}

/// The pressure of a volume on the points of a patch.
#[derive(Debug)]
struct SharedPressure {
    /// a of each point that moves, m²; 0 for held points.
    areas_m2: Vec<DVec3>,
    /// The pressure per growth of the volume, Pa/m³: κ/V0, reduced by what the points outside the patch yield.
    pa_per_m3: f64,
}

impl SharedPressure {
    fn of(model: &Model, window: &Window, free: &[bool], turn: &DMat3) -> Option<Self> {
        let places = model.places.volume()?;
        let volume = model.scene.volume()?;
        let unit_m2 = model.unit_m * model.unit_m;
        let pa_per_m3 = model.scene.volume_stiffness_pa / volume.volume_m3;
        let of_point =
            |(index, free): (usize, &bool)| if *free { *turn * places.areas[index] * unit_m2 } else { DVec3::ZERO };
        let within = window.points(model).zip(free).filter(|(_, free)| **free);
        let within: f64 = within.map(|(index, _)| model.volume_compliance.get(index).copied().unwrap_or(0.0)).sum();
        let beyond = (model.volume_compliance.iter().sum::<f64>() - within).max(0.0);
        let areas_m2 = window.points(model).zip(free).map(of_point).collect();
        Some(SharedPressure { areas_m2, pa_per_m3: pa_per_m3 / (1.0 + pa_per_m3 * beyond) })
    }

    /// Returns the growth of the volume, m³.
    fn growth_m3<'x>(&self, moved_m: impl Iterator<Item = &'x DVec3>) -> f64 {
        self.areas_m2.iter().zip(moved_m).map(|(area, moved_m)| area.dot(*moved_m)).sum()
    }
}

/// The resistance that a disc feels against slow and small movements, with C the damping and m the mass of a point.
/// Matrices are in the directions x, y, z of the tissue's frame; in [`Pressed`], they are turned so that z is the
/// normal under the disc.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tangent {
    /// S = (Eᵀ K⁻¹ E)⁻¹, with the weights E of the disc and the tangent stiffness K of the tissue, N/m. 0 if no point
    /// under the disc can move.
    pub stiffness_n_per_m: DMat3,
    /// B = C·φ̂ᵀφ̂ + τ·S of movements with the tissue, φ̂ = K⁻¹·E·S, with τ of a viscous tissue, N·s/m.
    pub damping_n_s_per_m: DMat3,
    /// D = C·Σ ∂u·∂u of sliding within the surface, with ∂u the slope of the displacements, N·s/m: the mean of both
    /// directions.
    pub drag_n_s_per_m: f64,
    /// Mass M = m·φ̂ᵀφ̂ that moves along z, kg.
    pub mass_kg: f64,
    /// Iterations of the solver, at most 400.
    pub iterations: u32,
}

/// The result at one depth of a slow press by a disc, straight into a tissue that is otherwise at rest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pressed {
    /// Depth of the disc below the surface at rest, along the normal there, m.
    pub depth_m: f64,
    /// Force of the tissue on the disc, outward, N.
    pub force_n: f64,
    /// Stiffness, damping and drag at this depth.
    pub tangent: Tangent,
}

impl<'m> LinearPatch<'m> {
    /// Creates the patch of a window around a footprint, with the displacements of its points in their order.
    /// Displacements and results are in directions turned by `turn`.
    fn turned(
        model: &'m Model,
        cuts: &Cuts,
        footprint: &Footprint,
        window: Window,
        displacement_m: Vec<DVec3>,
        turn: &DMat3,
    ) -> Self {
        let mut weights = vec![0.0; window.len()];
        for WeightedNode { point, weight, .. } in footprint.reached().iter().copied() {
            if let Some(at) = window.find(model, point) {
                weights[at] = weight;
            }
        }
        Self::weighted(model, cuts, weights, window, displacement_m, turn)
    }

    /// Creates the patch of a window with given weights of the points. Directions are turned by `turn`.
    fn weighted(
        model: &'m Model,
        cuts: &Cuts,
        weights: Vec<f64>,
        window: Window,
        displacement_m: Vec<DVec3>,
        turn: &DMat3,
    ) -> Self {
        let copies = cuts.copies().map(|copies| &**copies);
        let free = window.free(model, copies);
        let elements = window.elements(model, &free, turn, copies);
        let masses = window.points(model).map(|index| mass_at(model, copies, index)).collect();
        let own_n_per_m = window.points(model).map(|index| model.own_stiffness_n_per_m(index, copies)).collect();
        let mut patch = LinearPatch {
            model,
            pressure: SharedPressure::of(model, &window, &free, turn),
            window,
            displacement_m,
            free,
            weights,
            masses,
            own_n_per_m,
            elements,
            loads_n: Vec::new(),
            inverses: Vec::new(),
            accuracy: Accuracy::EXACT,
            allowance: Allowance::default(),
        };
        patch.sever(cuts, turn);
        patch.stiffen(cuts);
        patch.linearise();
        patch
    }

    /// Creates the patch of a window around a footprint on `model` with these cuts, and linearises it. `displacement_m` has the
    /// displacement from rest of each point of the window, m, in the order of [`Window::points`]. Panics if it is
    /// shorter.
    pub fn new(
        model: &'m Model,
        cuts: &Cuts,
        footprint: &Footprint,
        window: Window,
        displacement_m: Vec<DVec3>,
    ) -> Self {
        Self::turned(model, cuts, footprint, window, displacement_m, &DMat3::IDENTITY)
    }

    /// Takes the severed springs away, anchor springs too. What a pretension leaves of them stays as a load on their ends. (A solid has the
    /// copies of its corners in their place.)
    fn sever(&mut self, cuts: &Cuts, turn: &DMat3) {
        let model = self.model;
        if cuts.is_empty() || model.places.solid().is_some() {
            return;
        }
        let within = |place: u32| self.window.find(model, model.point_of(place as usize));
        let (mut found, mut freed, mut loads_n) = (Vec::new(), Vec::new(), Vec::new());
        for severed in cuts.springs() {
            let [first, second] = severed.ends;
            if severed.is_anchor() {
                freed.extend(within(first));
                continue;
            }
            let at_first = model.springs_at(first as usize);
            let Some(spring) = at_first.iter().find(|spring| spring.number == severed.number as usize) else {
                continue;
            };
            let rest_m = *turn * (model.unit_m * spring.rest);
            let ends = [within(first), within(second)];
            if let [Some(first), Some(second)] = ends {
                found.push(([first, second], rest_m));
            }
            let load_n = spring.tension_n_per_m * rest_m;
            loads_n.extend(ends.into_iter().zip([-load_n, load_n]).filter_map(|(end, load_n)| Some((end?, load_n))));
        }
        found.sort_unstable_by_key(|(ends, _)| *ends);
        self.elements.remove(&found);
        freed.iter().for_each(|at| self.own_n_per_m[*at] = 0.0);
        if model.prestrain != 0.0 {
            self.loads_n = loads_n;
        }
    }

    /// Makes springs as stiff as burns have made them.
    fn stiffen(&mut self, cuts: &Cuts) {
        if !cuts.burnt().is_empty() {
            let places: Vec<usize> = self.window.points(self.model).collect();
            self.elements.stiffen(|ends| cuts.burnt().of_spring(ends.map(|end| places[end])));
        }
    }

    /// Computes forces and tangents at the present displacements.
    fn linearise(&mut self) {
        self.inverses.clear();
        self.inverses.extend(self.own_n_per_m.iter().map(|own| DMat3::from_diagonal(DVec3::splat(*own))));
        self.elements.linearise(&self.displacement_m, &mut self.inverses);
        if let Some(SharedPressure { areas_m2, pa_per_m3 }) = &self.pressure {
            for (block, area) in self.inverses.iter_mut().zip(areas_m2) {
                *block += DMat3::from_cols(*area * area.x, *area * area.y, *area * area.z) * *pa_per_m3;
            }
        }
        for block in &mut self.inverses {
            // A point that nothing holds does not move.
            *block = if block.determinant() > 0.0 { block.inverse() } else { DMat3::ZERO };
        }
    }

    /// Writes K·x for `N` vectors at once to `product`.
    fn times<const N: usize>(&self, x: &[[DVec3; N]], product: &mut [[DVec3; N]]) {
        for ((product, x), own) in product.iter_mut().zip(x).zip(&self.own_n_per_m) {
            for system in 0..N {
                product[system] = *own * x[system];
            }
        }
        self.elements.times(x, product);
        if let Some(pressure) = &self.pressure {
            for system in 0..N {
                let pushed_pa = pressure.pa_per_m3 * pressure.growth_m3(x.iter().map(|x| &x[system]));
                for (product, area) in product.iter_mut().zip(&pressure.areas_m2) {
                    product[system] += pushed_pa * *area;
                }
            }
        }
        for (product, free) in product.iter_mut().zip(&self.free) {
            if !free {
                *product = [DVec3::ZERO; N];
            }
        }
    }

    /// Writes the residual divided by the points' own blocks to `z`.
    fn precondition<const N: usize>(&self, residual: &[[DVec3; N]], z: &mut [[DVec3; N]]) {
        for ((z, residual), inverse) in z.iter_mut().zip(residual).zip(&self.inverses) {
            for system in 0..N {
                z[system] = *inverse * residual[system];
            }
        }
    }

    /// Solves K·x = `right` for `N` systems side by side, to a relative residual of `good`. Also returns the
    /// iterations of the slowest.
    fn solve<const N: usize>(&self, right: &[[DVec3; N]], good: f64) -> (Vec<[DVec3; N]>, u32) {
        let zero = || vec![[DVec3::ZERO; N]; right.len()];
        let (mut x, mut z, mut product) = (zero(), zero(), zero());
        let masked = |(right, free): (&[DVec3; N], &bool)| if *free { *right } else { [DVec3::ZERO; N] };
        let mut residual: Vec<[DVec3; N]> = right.iter().zip(&self.free).map(masked).collect();
        let whole = dot(&residual, &residual);
        self.precondition(&residual, &mut z);
        let mut direction = z.clone();
        let mut rz = dot(&residual, &z);
        for iteration in 0..MAX_ITERATIONS {
            let left = dot(&residual, &residual);
            if (0..N).all(|system| left[system] <= good * good * whole[system]) {
                return (x, iteration);
            }
            if !self.allowance.take(self.elements.work()) {
                return (x, iteration);
            }
            self.times(&direction, &mut product);
            let curvature = dot(&direction, &product);
            let step: [f64; N] = std::array::from_fn(|s| if curvature[s] > 0.0 { rz[s] / curvature[s] } else { 0.0 });
            for (((x, residual), direction), product) in x.iter_mut().zip(&mut residual).zip(&direction).zip(&product) {
                for s in 0..N {
                    x[s] += step[s] * direction[s];
                    residual[s] -= step[s] * product[s];
                }
            }
            self.precondition(&residual, &mut z);
            let next = dot(&residual, &z);
            let turn: [f64; N] = std::array::from_fn(|s| if rz[s] > 0.0 { next[s] / rz[s] } else { 0.0 });
            for (direction, z) in direction.iter_mut().zip(&z) {
                for s in 0..N {
                    direction[s] = z[s] + turn[s] * direction[s];
                }
            }
            rz = next;
        }
        (x, MAX_ITERATIONS)
    }

    /// Computes stiffness, damping, drag and mass under the disc with [`Accuracy::EXACT`], by at most 400 iterations
    /// of conjugate gradients for three systems side by side.
    pub fn tangent(&self) -> Tangent {
        let axes = [DVec3::X, DVec3::Y, DVec3::Z];
        let right: Vec<[DVec3; 3]> = self.weights.iter().map(|weight| axes.map(|axis| *weight * axis)).collect();
        let (shapes, iterations) = self.solve(&right, self.accuracy.residual);
        let compliance = |a: usize, b: usize| -> f64 {
            self.weights.iter().zip(&shapes).map(|(weight, shape)| weight * shape[b][a]).sum()
        };
        let compliance = symmetric(compliance);
        let stiffness_n_per_m = if compliance.determinant() > 0.0 { compliance.inverse() } else { DMat3::ZERO };
        // Damping is in proportion to the mass.
        let overlap =
            symmetric(|a, b| shapes.iter().zip(&self.masses).map(|(shape, mass)| mass * shape[a].dot(shape[b])).sum());
        let unit = stiffness_n_per_m * overlap * stiffness_n_per_m;
        let scene = &self.model.scene;
        Tangent {
            stiffness_n_per_m,
            damping_n_s_per_m: scene.damping_n_s_per_m * unit + scene.body.kind().viscous_time_s() * stiffness_n_per_m,
            drag_n_s_per_m: scene.damping_n_s_per_m
                * self.window.slopes(self.model, self.elements.springs(), &self.masses, &self.displacement_m),
            mass_kg: scene.point_mass_kg() * unit.z_axis.z,
            iterations,
        }
    }

    /// Returns the disc's z, m.
    fn disc_m(&self) -> f64 {
        self.displacement_m.iter().zip(&self.weights).map(|(u, weight)| weight * u.z).sum()
    }

    /// Moves the disc's z to `to_m` quasi-statically (Newton's method), or lets it go (`None`). Returns the force on the disc, N.
    fn press(&mut self, to_m: Option<f64>) -> f64 {
        let mut force_n = 0.0;
        for _ in 0..MAX_NEWTON {
            let mut right: Vec<[DVec3; 2]> = self
                .displacement_m
                .iter()
                .zip(&self.weights)
                .zip(&self.own_n_per_m)
                .map(|((u, weight), own)| [-*own * *u, *weight * DVec3::Z])
                .collect();
            self.elements.forces(|point, force_n| right[point][0] += force_n);
            self.loads_n.iter().for_each(|(point, load_n)| right[*point][0] += *load_n);
            if let Some(pressure) = &self.pressure {
                let pushed_pa = pressure.pa_per_m3 * pressure.growth_m3(self.displacement_m.iter());
                for (right, area) in right.iter_mut().zip(&pressure.areas_m2) {
                    right[0] -= pushed_pa * *area;
                }
            }
            let (x, _) = self.solve(&right, self.accuracy.approximate_residual);
            let on_disc = |x: &dyn Fn(usize) -> f64| -> f64 {
                self.weights.iter().enumerate().map(|(at, weight)| weight * x(at)).sum()
            };
            let (free, forced) = (on_disc(&|at| x[at][0].z), on_disc(&|at| x[at][1].z));
            let applied_n = match to_m {
                Some(to_m) if forced > 0.0 => (to_m - self.disc_m() - free) / forced,
                _ => 0.0,
            };
            force_n = -applied_n;
            let mut largest_m: f64 = 0.0;
            for (u, x) in self.displacement_m.iter_mut().zip(&x) {
                let change = x[0] + applied_n * x[1];
                *u += change;
                largest_m = largest_m.max(change.abs().max_element());
            }
            self.linearise();
            if largest_m < self.accuracy.arrived * self.model.unit_m || self.allowance.is_spent() {
                break;
            }
        }
        force_n
    }
}

/// Springs times iterations for the yielding of a volume's points under a pressure: 3 s on the machine of the
/// benchmarks. A larger mesh uses the approximation reached by then.
const YIELDING: u64 = 100_000_000;

/// Returns by how much each place of a mesh that encloses a volume lets it grow under a pressure, at rest,
/// m³/Pa. Empty without a volume.
pub(crate) fn volume_compliance(model: &Model, stop: &AtomicBool) -> Vec<f64> {
    let Some(volume) = model.places.volume() else { return Vec::new() };
    let (window, unit_m2) = (Window::all(model), model.unit_m * model.unit_m);
    let zero = vec![DVec3::ZERO; window.len()];
    let whole = Cuts::default();
    let patch = LinearPatch::weighted(model, &whole, vec![0.0; window.len()], window, zero, &DMat3::IDENTITY);
    let patch = LinearPatch { pressure: None, allowance: Allowance::of(YIELDING, stop), ..patch };
    let area_m2 = |slot: usize| volume.areas[slot] * unit_m2;
    let pushed: Vec<[DVec3; 1]> = (0..model.len()).map(|slot| [area_m2(slot)]).collect();
    let (moved, _) = patch.solve(&pushed, Accuracy::COARSE.residual);
    moved.iter().enumerate().map(|(slot, [moved_m])| moved_m.dot(area_m2(slot))).collect()
}

/// Returns the scalar products of `N` pairs of vectors, summed in the order of the points.
fn dot<const N: usize>(a: &[[DVec3; N]], b: &[[DVec3; N]]) -> [f64; N] {
    let mut sum = [0.0; N];
    for (a, b) in a.iter().zip(b) {
        for system in 0..N {
            sum[system] += a[system].dot(b[system]);
        }
    }
    sum
}

/// Largest number of steps of Newton's method for one depth.
const MAX_NEWTON: u32 = 30;

/// Returns the matrix of a symmetric function of two indices.
fn symmetric(of: impl Fn(usize, usize) -> f64) -> DMat3 {
    let both = |a: usize, b: usize| 0.5 * (of(a, b) + of(b, a));
    let column = |b: usize| DVec3::new(both(0, b), both(1, b), both(2, b));
    DMat3::from_cols(column(0), column(1), column(2))
}

/// Computes a slow press by a disc of `radius_m` (m) at `centre_m` (m, a place at rest), at `count` depths from 0 on,
/// `step_m` (m) apart, with [`Accuracy::EXACT`] and unlimited work. Returns the results in the order of the depths. At
/// each depth d Newton's method finds the displacements u at which the springs balance the disc's force along the
/// normal, while Σ w·u = −d along it, with w the weights of the disc. Unwinds with a refusal if there is no memory
/// ([`attempt`](crate::memory::attempt)).
pub fn press(model: &Model, radius_m: f64, centre_m: DVec3, step_m: f64, count: u32) -> Vec<Pressed> {
    let course = Course { radius_m, centre_m, step_m, count, points: usize::MAX, within_m: f64::INFINITY };
    let mut press = Press::new(model, course, Accuracy::EXACT);
    let never = AtomicBool::new(false);
    while press.deepen(model, &never) == Deepened::Further {}
    press.pressed
}

/// What a press computes: a disc, where it presses, and the depths.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Course {
    /// Radius of the disc, m.
    pub radius_m: f64,
    /// Middle of the disc at rest, m, in the tissue's frame. The disc is at the place of the rest surface nearest to
    /// this.
    pub centre_m: DVec3,
    /// Distance between depths, m; the first depth is 0.
    pub step_m: f64,
    /// Number of depths, the first included.
    pub count: u32,
    /// Largest number of points of a mesh that are computed, unless the disc itself covers more; those beyond are
    /// held. `usize::MAX` for all that notice the disc. Without effect on a sheet.
    pub points: usize,
    /// Distance from the disc's middle beyond which points of a mesh are held, m; infinite for none. Without effect on a sheet.
    pub within_m: f64,
}

/// A slow press under computation, one depth after another, so that its thread can do other work in between. It holds
/// the displacements at the last depth, from which the next one starts.
#[derive(Debug)]
pub struct Press {
    cuts: Cuts,
    footprint: Footprint,
    window: Window,
    /// Rotates the outward normal under the disc to z.
    turn: DMat3,
    course: Course,
    accuracy: Accuracy,
    /// Springs times iterations that may still be computed.
    left: u64,
    displacement_m: Vec<DVec3>,
    /// Where the disc is without a force, m: not at 0 if the tissue gapes.
    begins_m: f64,
    pressed: Vec<Pressed>,
}

/// The result of [`Press::deepen`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Deepened {
    /// A depth was computed, and further depths are left.
    Further,
    /// All depths are computed; [`Press::pressed`] has them.
    Done,
    /// The work was used up, or the press was stopped: it can't continue. [`Press::pressed`] has the depths before.
    GivenUp,
}

impl Press {
    /// Creates a press into whole tissue along `course` with unlimited work; no depth is computed yet. Unwinds with a refusal if there
    /// is no memory ([`attempt`](crate::memory::attempt)).
    pub fn new(model: &Model, course: Course, accuracy: Accuracy) -> Self {
        let whole = Cuts::default();
        let (footprint, window) = Self::laid(model, &whole, &course);
        Self::begun(whole, footprint, window, course, accuracy)
    }

    /// Returns the disc at its place, and the window of points that notice it.
    fn laid(model: &Model, cuts: &Cuts, course: &Course) -> (Footprint, Window) {
        let mut footprint = Footprint::new(model, course.radius_m, course.centre_m);
        footprint.follow_cuts(model, cuts.copies());
        let window = Window::at(model, course.radius_m, footprint.anchor_m(), course.points, course.within_m);
        (footprint, window.with_copies(cuts))
    }

    fn begun(cuts: Cuts, footprint: Footprint, window: Window, course: Course, accuracy: Accuracy) -> Self {
        memory::require(window.bytes(), "a force law");
        let (_, outward) = footprint.at_rest();
        let turn = DMat3::from_quat(DQuat::from_rotation_arc(outward, DVec3::Z));
        let displacement_m = vec![DVec3::ZERO; window.len()];
        let (left, pressed) = (u64::MAX, Vec::new());
        Press { cuts, footprint, window, turn, course, accuracy, left, displacement_m, begins_m: 0.0, pressed }
    }

    /// Creates a press into a tissue with these cuts along `course`, with at most `work` springs times iterations for all depths. `None` if they
    /// can't suffice (an estimate from the number of points and depths). Unwinds with a refusal if there is no memory.
    pub fn within(model: &Model, cuts: &Cuts, course: Course, accuracy: Accuracy, work: u64) -> Option<Self> {
        // A solution takes about as many iterations as there are points from the middle to where nothing is
        // noticed, and each depth some solutions. A press that can't be completed is not begun, and takes no
        // memory.
        let (footprint, window) = Self::laid(model, cuts, &course);
        let solved = if model.scene.body.kind().law_is_linear() { 1 } else { u64::from(course.count) };
        let least = window.len() as u64 * 4 * solved * (window.across() as u64);
        (least <= work).then(|| Press { left: work, ..Self::begun(cuts.clone(), footprint, window, course, accuracy) })
    }

    /// Returns the springs times iterations that may still be computed; 0 once the press is given up.
    pub fn left(&self) -> u64 {
        self.left
    }

    /// Returns the results at the depths computed so far, from depth 0 downwards.
    pub fn pressed(&self) -> &[Pressed] {
        &self.pressed
    }

    /// Computes the next depth on the calling thread, and appends its result to [`Press::pressed`]. Given up for good
    /// if another thread sets `stop` or the work does not suffice; does nothing after the last depth. `model` must be
    /// the one that the press was created with.
    pub fn deepen(&mut self, model: &Model, stop: &AtomicBool) -> Deepened {
        if self.left == 0 {
            return Deepened::GivenUp;
        }
        let Some(depth_m) = self.next_depth_m() else { return Deepened::Done };
        if let Some(first) = self.pressed.first().filter(|_| model.scene.body.kind().law_is_linear()) {
            let force_n = first.tangent.stiffness_n_per_m.z_axis.z * depth_m;
            self.pressed.push(Pressed { depth_m, force_n, tangent: first.tangent });
            return if self.next_depth_m().is_some() { Deepened::Further } else { Deepened::Done };
        }
        let displacement_m = std::mem::take(&mut self.displacement_m);
        let Press { cuts, footprint, window, turn, .. } = &*self;
        let patch = LinearPatch::turned(model, cuts, footprint, window.clone(), displacement_m, turn);
        let mut patch = LinearPatch { accuracy: self.accuracy, allowance: Allowance::of(self.left, stop), ..patch };
        if self.pressed.is_empty() && !patch.loads_n.is_empty() {
            patch.press(None);
            self.begins_m = patch.disc_m();
        }
        let force_n = if depth_m > 0.0 { patch.press(Some(self.begins_m - depth_m)) } else { 0.0 };
        let tangent = patch.tangent();
        self.left = patch.allowance.left.get();
        if patch.allowance.is_spent() {
            // The last computation is incomplete, and nothing follows from it.
            return Deepened::GivenUp;
        }
        self.displacement_m = patch.displacement_m;
        self.pressed.push(Pressed { depth_m, force_n, tangent });
        if self.next_depth_m().is_some() { Deepened::Further } else { Deepened::Done }
    }

    #[allow(clippy::cast_precision_loss)]
    fn next_depth_m(&self) -> Option<f64> {
        let next = self.pressed.len();
        (next < self.course.count as usize).then_some(next as f64 * self.course.step_m)
    }
}

/// Returns a model of the same tissue with points `spacing_m` (m) apart, out to `half_m` (m) from the middle
/// ([`Body::coarser`](crate::scene::Body::coarser)); if there is none, the model as it is. The k of springs does not
/// depend on their length; mass m, damping C and the stiffness K″ of anchor springs belong to an area and are multiplied
/// by the number of points that one replaces. The result serves presses alone: its plan is that of `model` and is not
/// checked.
pub fn stand_in(model: &Model, spacing_m: f64, half_m: f64) -> Model {
    let Some((body, replaced)) = model.scene.body.coarser(spacing_m, half_m) else { return model.clone() };
    let mut scene = model.scene.clone();
    scene.body = body;
    scene.anchor_stiffness_n_per_m *= replaced;
    scene.damping_n_s_per_m *= replaced;
    let Ok(MemoryLayout { points, fixed, places }) = MemoryLayout::of(&scene) else { return model.clone() };
    Model { points, fixed, places, unit_m: spacing_m, scene, ..model.clone() }
}

#[cfg(test)]
mod tests;
