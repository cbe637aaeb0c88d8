//! The footprint of a tool: a disc of given radius where its tip meets the tissue, distributed over the mass
//! points around it.
//!
//! The surface between points is given by hat functions N_p: the material place c is at Σ N_p(c)·x_p. A disc of
//! radius a around c averages that over its area, s(c) = Σ w_p·x_p with w_p = ⨍ N_p; the weights add up to 1. A
//! tool moves s, and its force goes to the points with the same weights, so its work is force · ds. With a
//! single point instead, the stiffness would fall without limit as the grid gets finer; with the disc it
//! converges.
//!
//! The hats blur the disc: under even pressure it would act as if larger, by much where the points are far
//! apart. The relevant area is A = 1/Σ(w²/A_p), which shares a force, with A_p the area of a point: a
//! foundation of k″ N/m³ has the stiffness k″·A under the disc. So the hats are averaged over a smaller disc,
//! chosen so that A is that of the requested disc: on a sheet in the mean over places
//! (`body::sheet::footprint`), on a mesh at each place (`palpate_geometry::surface`).

use std::sync::Arc;

use glam::{DMat3, DVec2, DVec3};

use crate::body::disc::{DiscPoint, SurfaceSample, TissueDisc};
use crate::body::disc_on;
use crate::body::model::Model;
use crate::body::solid::corner_copies::CornerCopies;
use crate::saved::{SavedPlace, ensure};
use palpate_refusal::Result;

/// The smallest part of a disc that movable points carry. Near fixed points they would otherwise have to move
/// farther than the tool by one over their part, and the stiffness would grow with its square.
const MIN_FREE_PART: f64 = 0.25;

/// If movable points carry less than this part of a disc, it lies on fixed points and moves nothing.
const FIXED_PART: f64 = 0.02;

/// A disc that seeks on a curved surface is where it should be within this part of its radius.
const BESIDE: f64 = 1.0 / 256.0;

/// The disc with which a tool touches a tissue, at a place of the tissue at rest: the points that it covers and their
/// weights. It belongs to the model that it was created for; its functions must get the same.
#[derive(Debug)]
pub struct Footprint {
    radius_m: f64,
    disc: Box<dyn TissueDisc>,
    /// The corners of a solid that cuts have doubled.
    copies: Option<Arc<CornerCopies>>,
    reached: Vec<WeightedNode>,
    /// Factor of the weights of movable points ([`MIN_FREE_PART`]).
    free_factor: f64,
    /// Rest position of the disc, Σ w·X, m, and its derivative by the place.
    rest_m: DVec3,
    along: [DVec3; 2],
    /// Σ w²/mass over the movable points.
    relative_inverse_mass: f64,
}

impl Clone for Footprint {
    fn clone(&self) -> Self {
        Footprint { disc: self.disc.boxed(), copies: self.copies.clone(), reached: self.reached.clone(), ..*self }
    }
}

/// A mass point that a disc covers, and its part of the disc.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WeightedNode {
    /// Row and column in memory; on a sheet, the indices in the grid.
    pub point: [usize; 2],
    /// Whether the point can move: it is not one of the tissue's fixed points.
    pub free: bool,
    /// Mass divided by the reference mass.
    pub mass: f64,
    /// Weight w of the point: its part of the disc's force and place. The weights of a disc add up to 1.
    pub weight: f64,
    /// ∂w/∂c, the derivative of w by the place c of the disc, 1/m, in two perpendicular directions of the surface: x
    /// and y on a sheet.
    pub gradient: DVec2,
}

impl Footprint {
    /// Creates a disc of `radius_m` (m) around the place of the rest surface nearest to `at_m` (m, in the tissue's
    /// frame); on a sheet, the place above or below it.
    pub fn new(model: &Model, radius_m: f64, at_m: DVec3) -> Self {
        let mut footprint = Self::unplaced(model, radius_m);
        footprint.move_to(model, at_m);
        footprint
    }

    /// Creates a disc that covers nothing yet.
    fn unplaced(model: &Model, radius_m: f64) -> Self {
        Footprint {
            radius_m,
            disc: disc_on(&model.scene.body, radius_m),
            copies: None,
            reached: Vec::new(),
            free_factor: 1.0,
            rest_m: DVec3::ZERO,
            along: [DVec3::X, DVec3::Y],
            relative_inverse_mass: 0.0,
        }
    }

    /// Returns the place of the disc as plain data.
    pub(crate) fn saved(&self) -> SavedPlace {
        self.disc.saved()
    }

    /// Restores a disc of `radius_m` at a saved place.
    pub(crate) fn restored(model: &Model, radius_m: f64, saved: &SavedPlace) -> Result<Self> {
        let mut footprint = Self::unplaced(model, radius_m);
        footprint.disc.restore(saved)?;
        footprint.lay(model);
        ensure(footprint.is_sound(), "a tool that is nowhere on the tissue")?;
        Ok(footprint)
    }

    /// Lets the disc move with these copies of a solid's corners; with `None` it keeps the points that it covers until it moves.
    pub(crate) fn follow_cuts(&mut self, model: &Model, copies: Option<&Arc<CornerCopies>>) {
        self.copies = copies.cloned();
        if copies.is_some() {
            self.lay(model);
        }
    }

    /// Returns the corner of a solid of which a place in memory has a copy; the place itself for any other.
    pub(crate) fn corner_of(&self, index: usize) -> usize {
        self.copies.as_ref().map_or(index, |copies| copies.corner_of(index))
    }

    /// Returns the relative mass at a place in memory, after cuts.
    pub(crate) fn mass_at(&self, model: &Model, index: usize) -> f64 {
        mass_at(model, self.copies.as_deref(), index)
    }

    /// Returns a disc at a saved place with the copies of this one.
    pub(crate) fn at_saved(&self, model: &Model, saved: &SavedPlace) -> Result<Self> {
        let mut footprint = Self::restored(model, self.radius_m, saved)?;
        footprint.follow_cuts(model, self.copies.as_ref());
        Ok(footprint)
    }

    /// Moves the disc back to an earlier place ([`Footprint::saved`]).
    pub(crate) fn return_to(&mut self, model: &Model, place: &SavedPlace) {
        if self.disc.return_to(place) {
            self.lay(model);
        }
    }

    /// Returns whether all values are finite.
    fn is_sound(&self) -> bool {
        let is_sound = |point: &WeightedNode| point.weight.is_finite() && point.gradient.is_finite();
        self.rest_m.is_finite() && self.relative_inverse_mass.is_finite() && self.reached.iter().all(is_sound)
    }

    /// Returns samples of the surface around the place ([`TissueDisc::samples`]).
    pub(crate) fn samples(&self, reach_m: f64, spacing_m: f64) -> Vec<SurfaceSample> {
        self.disc.samples(reach_m, spacing_m, self.copies.as_deref())
    }

    /// Returns the radius of the disc, m.
    pub fn radius_m(&self) -> f64 {
        self.radius_m
    }

    /// Returns the rest position of the place of the tissue at the centre of the disc, m.
    pub fn anchor_m(&self) -> DVec3 {
        self.disc.anchor_m()
    }

    /// Moves the disc to another place of the tissue: the place of the rest surface nearest to `at_m`, m. Computes the
    /// covered points and their weights anew.
    pub fn move_to(&mut self, model: &Model, at_m: DVec3) {
        if self.disc.put(at_m) {
            self.lay(model);
        }
    }

    /// Moves the disc by `beside_m`, a vector along the displaced surface. `along` is the derivative of the
    /// surface by the place ([`Footprint::surface`]).
    pub(crate) fn shift(&mut self, model: &Model, beside_m: DVec3, along: &[DVec3; 2]) {
        if self.disc.walk(within(beside_m, along)) {
            self.lay(model);
        }
    }

    /// Returns how far a touching disc may move at once, m. On a flat tissue there is no bound.
    pub(crate) fn stride_m(&self) -> f64 {
        self.disc.stride_m()
    }

    /// Moves the disc of a tool that touches nothing to the place of the displaced surface nearest to
    /// `place_m`, or towards it. This converges if the surface is not folded. `leaps`: another part of a curved surface may be nearer.
    pub(crate) fn seek(
        &mut self,
        model: &Model,
        place_m: DVec3,
        leaps: bool,
        displacement_m: impl Fn([usize; 2]) -> DVec3,
    ) {
        if leaps {
            self.leap(model, place_m, &displacement_m);
        }
        if self.approach(model, place_m, &displacement_m) {
            self.approach(model, place_m, &displacement_m);
        }
    }

    /// Moves the disc to another part of a curved surface if that is nearer to `place_m`.
    pub(crate) fn leap(&mut self, model: &Model, place_m: DVec3, displacement_m: impl Fn([usize; 2]) -> DVec3) {
        if self.disc.leap(place_m, &|point| displacement_m(model.point_of(model.place_of(point)))) {
            self.lay(model);
        }
    }

    /// Moves the disc towards the place of the displaced surface nearest to `place_m`, once. Returns whether it was not there yet.
    pub(crate) fn approach(
        &mut self,
        model: &Model,
        place_m: DVec3,
        displacement_m: impl Fn([usize; 2]) -> DVec3,
    ) -> bool {
        let (surface_m, along) = self.surface(&displacement_m);
        let mut beside_m = place_m - surface_m;
        if !self.disc.is_flat() {
            let outward = self.outward(&along);
            let away_m = beside_m.dot(outward).abs();
            beside_m -= beside_m.dot(outward) * outward;
            // Far from a curved surface, a whole step would lead past the place.
            beside_m *= self.radius_m / (self.radius_m + away_m + beside_m.length());
            if beside_m.length() < BESIDE * self.radius_m {
                return false;
            }
        }
        self.shift(model, beside_m, &along);
        true
    }

    /// Takes over the points that the disc covers.
    fn lay(&mut self, model: &Model) {
        let Footprint { disc, copies, reached, rest_m, along, .. } = self;
        let is_flat = disc.is_flat();
        reached.clear();
        (*rest_m, *along) = (DVec3::ZERO, [DVec3::ZERO; 2]);
        let copies = copies.as_deref();
        disc.cover(copies, &mut |DiscPoint { point, copy }, weight, gradient| {
            let free = is_free(model, model.place_of(point));
            let index = copy.unwrap_or_else(|| model.place_of(point));
            let mass = mass_at(model, copies, index);
            reached.push(WeightedNode { point: model.point_of(index), free, mass, weight, gradient });
            if !is_flat {
                let at_m = model.shape().rest_m(point);
                *rest_m += weight * at_m;
                along[0] += gradient.x * at_m;
                along[1] += gradient.y * at_m;
            }
        });
        if is_flat {
            (*rest_m, *along) = (disc.anchor_m(), [DVec3::X, DVec3::Y]);
        }
        self.weigh(model);
    }

    /// Computes how the disc moves under a force. If few of its points can move, gives these more weight.
    fn weigh(&mut self, model: &Model) {
        self.lean(model);
        let of = |point: &WeightedNode| point.weight * point.weight / point.mass;
        let moves = self.free_factor > 0.0;
        self.relative_inverse_mass =
            if moves { self.reached.iter().filter(|point| point.free).map(of).sum() } else { 0.0 };
    }

    /// Gives the movable points at least [`MIN_FREE_PART`] of the disc. With p their part and q the part they
    /// get, w becomes w·q/p for them and w·(1 − q)/(1 − p) for the others; ∂w changes accordingly.
    fn lean(&mut self, model: &Model) {
        let (mut part, mut change) = (0.0, DVec2::ZERO);
        for point in self.reached.iter().filter(|point| point.free) {
            part += point.weight;
            change += point.gradient;
        }
        self.free_factor = match part {
            MIN_FREE_PART.. => 1.0,
            FIXED_PART.. => MIN_FREE_PART / part,
            _ => 0.0,
        };
        if self.free_factor == 1.0 || self.free_factor == 0.0 {
            return;
        }
        let of_fixed = (1.0 - MIN_FREE_PART) / (1.0 - part);
        (self.rest_m, self.along) = (DVec3::ZERO, [DVec3::ZERO; 2]);
        let copies = &self.copies;
        for point in &mut self.reached {
            let (factor, by) = if point.free {
                (self.free_factor, -self.free_factor / part * change)
            } else {
                (of_fixed, of_fixed / (1.0 - part) * change)
            };
            point.gradient = factor * point.gradient + point.weight * by;
            point.weight *= factor;
            let index = model.index_of(point.point);
            let corner = copies.as_ref().map_or(index, |copies| copies.corner_of(index));
            let rest_m = model.shape().rest_m(model.point_at(corner));
            self.rest_m += point.weight * rest_m;
            self.along[0] += point.gradient.x * rest_m;
            self.along[1] += point.gradient.y * rest_m;
        }
    }

    /// Returns whether the disc lies mostly on fixed points: movable points carry less than a quarter of it, so that
    /// they get a quarter, or less than 2 %, so that it moves nothing.
    pub fn is_on_fixed(&self) -> bool {
        self.free_factor != 1.0
    }

    /// Returns the points that the disc covers, fixed ones included, each once, with their weights; sorted by row and
    /// column on a sheet, in no fixed order on a mesh.
    pub fn reached(&self) -> &[WeightedNode] {
        &self.reached
    }

    /// Returns the weight w of a point; 0 for a point that the disc does not cover. It does not search all
    /// covered points: a tip may be as large as the tissue, and this is called for each of its points.
    pub(crate) fn weight_of(&self, model: &Model, index: usize) -> f64 {
        match self.disc.weight_of(model.point_at(index)) {
            // Only called for movable points.
            Some(weight) => self.free_factor * weight,
            None => {
                let found = self.reached.binary_search_by_key(&model.point_of(index), |reached| reached.point);
                found.map_or(0.0, |place| self.reached[place].weight)
            }
        }
    }

    /// Returns Σ w²/mass over the movable points, with masses relative to the reference mass: the acceleration of the
    /// disc under a force, relative to that of one free point of this mass. 0 if movable points carry less than 2 %.
    pub fn relative_inverse_mass(&self) -> f64 {
        self.relative_inverse_mass
    }

    /// Returns the place s of the disc, m, and ∂s/∂c, its derivative by the place c on the rest surface, in the two
    /// directions of [`WeightedNode::gradient`]: s = Σ w·(X + u) and ∂s/∂c = Σ ∂w/∂c·(X + u), with X the rest
    /// positions and u the displacement that `displacement_m` returns for the row and column of each covered point, m.
    pub fn surface(&self, displacement_m: impl Fn([usize; 2]) -> DVec3) -> (DVec3, [DVec3; 2]) {
        let (mut place, mut along) = (self.rest_m, self.along);
        for WeightedNode { point, weight, gradient, .. } in &self.reached {
            let u = displacement_m(*point);
            place += *weight * u;
            along[0] += gradient.x * u;
            along[1] += gradient.y * u;
        }
        (place, along)
    }

    /// Returns the place of the disc on the tissue at rest, Σ w·X, m, and the unit normal out of the tissue
    /// there, along ∂s/∂c₁ × ∂s/∂c₂.
    pub fn at_rest(&self) -> (DVec3, DVec3) {
        (self.rest_m, self.outward(&self.along))
    }

    /// Returns the surface at rest around the disc, as seen by a tool on this side of it (1 outside, -1
    /// inside); `None` on a flat tissue.
    pub(crate) fn rest_surface(&self, side: f64) -> Option<RestSurface> {
        if self.disc.is_flat() {
            return None;
        }
        let (normal, curvature_per_m) = (side * self.outward(&self.along), side * self.disc.curvature_per_m());
        Some(RestSurface { place_m: self.rest_m, normal, curvature_per_m })
    }

    /// Returns the unit normal out of the tissue. ∂s/∂c₁ × ∂s/∂c₂ is the only choice whose work equals the
    /// energy that the tissue gains when the disc slides over a slope.
    pub(crate) fn outward(&self, along: &[DVec3; 2]) -> DVec3 {
        along[0].cross(along[1]).try_normalize().unwrap_or_else(|| self.disc.outward())
    }

    /// Returns whether a tool whose gap from the disc is `gap_m` is beside the tissue: farther off its edge
    /// than the radius.
    pub(crate) fn is_beside(&self, gap_m: DVec3, outward: DVec3) -> bool {
        let across_m = if self.disc.is_flat() {
            gap_m.truncate().length()
        } else {
            (gap_m - gap_m.dot(outward) * outward).length()
        };
        across_m > self.radius_m
    }

    /// Returns the side of the surface of a newly placed tool that is `height_m` above the surface: 1 outside,
    /// -1 inside. A tool below a flat tissue presses on it from above.
    pub(crate) fn side(&self, height_m: f64) -> f64 {
        self.disc.side(height_m)
    }
}

/// The surface of a mesh at rest around a tool's place, to second order, as seen from the tool's side.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RestSurface {
    /// The place of the tool's disc on the tissue at rest, m.
    pub place_m: DVec3,
    /// The unit normal there, towards the tool.
    pub normal: DVec3,
    /// The change of the normal per metre along the surface, 1/m: symmetric, 1/R on a sphere of radius R seen from
    /// outside, −1/R from inside. Valid for displacements perpendicular to the normal.
    pub curvature_per_m: DMat3,
}

/// Returns the relative mass at a place in memory, after cuts.
pub(crate) fn mass_at(model: &Model, copies: Option<&CornerCopies>, index: usize) -> f64 {
    match (copies, model.places.solid()) {
        (Some(copies), Some(places)) => copies.mass(places, index),
        _ => model.relative_mass_at(index),
    }
}

fn is_free(model: &Model, index: usize) -> bool {
    model.fixed.is_empty() || model.fixed.binary_search(&index).is_err()
}

/// Returns the change of place that moves a surface by `beside_m`, as far as possible: least squares.
fn within(beside_m: DVec3, [one, other]: &[DVec3; 2]) -> DVec2 {
    let [a, b, d] = [one.dot(*one), one.dot(*other), other.dot(*other)];
    let right = DVec2::new(one.dot(beside_m), other.dot(beside_m));
    let determinant = a * d - b * b;
    if determinant <= 1e-12 * a * d {
        return DVec2::ZERO;
    }
    DVec2::new(d * right.x - b * right.y, a * right.y - b * right.x) / determinant
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model(sets: &[&str]) -> std::sync::Arc<Model> {
        let always = ["sheet.spacing_m=0.02", "stepping.integrator=central", "stepping.substeps=1"];
        Model::paper(&[&always[..], sets].concat())
    }

    /// Radii, in spacings.
    const RADII: [f64; 4] = [0.2, 1.0, 1.7, 3.2];

    #[test]
    fn a_point_has_the_weight_with_which_the_disc_covers_it() {
        for (model, at_m, radius_m) in [
            (model(&["sheet.points=[13, 17]"]), DVec3::new(0.11, 0.17, 0.0), 0.05),
            (model(&["sheet.points=[13, 17]"]), DVec3::ZERO, 0.3),
            (Model::gallbladder(&[]), DVec3::new(0.02, 0.0, -0.05), 0.006),
        ] {
            let footprint = Footprint::new(&model, radius_m, at_m);
            let mut weights = vec![0.0; model.place_count()];
            for reached in footprint.reached() {
                weights[model.index_of(reached.point)] = reached.weight;
            }
            assert!(footprint.reached().len() > 9, "{}", footprint.reached().len());
            for point in model.points() {
                let index = model.place_of(point);
                assert_eq!(footprint.weight_of(&model, index), weights[index], "{index}");
            }
        }
    }

    #[test]
    fn a_disc_gives_way_like_its_own_area_of_a_foundation() {
        let model = model(&["sheet.points=[21, 21]"]);
        let spacing_m = model.unit_m;
        for radius in RADII.into_iter().filter(|radius| *radius >= 1.0) {
            // h²/Σ w² is the area, in the mean over places in a cell.
            let places = (0..16).map(|place| DVec2::new(f64::from(place / 4), f64::from(place % 4)) / 4.0);
            let relative_inverse_mass = places.map(|place| {
                Footprint::new(&model, radius * spacing_m, ((place + 10.0) * spacing_m).extend(0.0))
                    .relative_inverse_mass()
            });
            let area = 16.0 / relative_inverse_mass.sum::<f64>();
            let expected = std::f64::consts::PI * radius * radius;
            assert!((area - expected).abs() < 2e-3 * expected, "{radius}: {area} {expected}");
        }
    }

    #[test]
    fn weights_add_up_to_1_about_the_centre_and_follow_a_plane_exactly() {
        let model = model(&["sheet.points=[13, 17]"]);
        let spacing_m = model.unit_m;
        for radius in RADII {
            let centre_m = DVec2::new(6.13, 8.71) * spacing_m;
            let footprint = Footprint::new(&model, radius * spacing_m, centre_m.extend(0.0));
            let rest_m = |[i, j]: [usize; 2]| DVec2::new(i as f64, j as f64) * spacing_m;
            let whole: f64 = footprint.reached().iter().map(|point| point.weight).sum();
            let middle_m: DVec2 = footprint.reached().iter().map(|point| point.weight * rest_m(point.point)).sum();
            assert!((whole - 1.0).abs() < 1e-12 && middle_m.distance(centre_m) < 1e-12, "{radius}: {whole} {middle_m}");
            let (slopes, level_m) = (DVec2::new(0.3, -0.2), 0.01);
            let (place_m, along) = footprint.surface(|point| DVec3::new(0.0, 0.0, level_m + slopes.dot(rest_m(point))));
            assert!((place_m - centre_m.extend(level_m + slopes.dot(centre_m))).length() < 1e-12, "{place_m}");
            let tilted = [DVec3::new(1.0, 0.0, slopes.x), DVec3::new(0.0, 1.0, slopes.y)];
            assert!((0..2).all(|axis| along[axis].distance(tilted[axis]) < 1e-9), "{radius}: {along:?}");
        }
    }

    #[test]
    fn the_slopes_are_the_change_of_place_also_where_the_disc_leaves_the_sheet() {
        let model = model(&["sheet.points=[7, 9]"]);
        let spacing_m = model.unit_m;
        let displacement_m = |[i, j]: [usize; 2]| {
            let (x, y) = (i as f64, j as f64);
            1e-3 * DVec3::new((1.3 * x + y).sin(), (x - 0.7 * y).cos(), (0.9 * x * y).sin())
        };
        for radius in RADII {
            for centre in [[0.31, 0.17], [2.87, 0.05], [5.96, 7.93], [3.11, 4.07]] {
                let mut footprint =
                    Footprint::new(&model, radius * spacing_m, (DVec2::from(centre) * spacing_m).extend(0.0));
                let (centre_m, step_m) = (footprint.anchor_m(), 1e-8 * spacing_m);
                let (_, along) = footprint.surface(displacement_m);
                for axis in 0..2 {
                    let mut step = DVec3::ZERO;
                    step[axis] = step_m;
                    let [ahead_m, behind_m] = [centre_m + step, centre_m - step].map(|place_m| {
                        footprint.move_to(&model, place_m);
                        footprint.surface(displacement_m).0
                    });
                    let slope = (ahead_m - behind_m) / (2.0 * step_m);
                    assert!(slope.distance(along[axis]) < 1e-5, "{radius} {centre:?}: {slope} {}", along[axis]);
                }
            }
        }
    }

    #[test]
    fn a_disc_is_shifted_along_a_curved_surface_as_far_as_it_is_told() {
        let model = Model::gallbladder(&[]);
        let crate::scene::Body::Mesh(mesh) = &model.scene.body else { panic!("of another kind") };
        let (shape, radius_m, way_m) = (model.shape(), 0.006, 0.003);
        let first_m = shape.rest_m(shape.nearest(DVec3::new(0.02, 0.0, -0.05)));
        for turn in 0..8 {
            let mut footprint = Footprint::new(&model, radius_m, first_m);
            let (from_m, outward) = (footprint.anchor_m(), footprint.at_rest().1);
            let (one, other) = outward.any_orthonormal_pair();
            let angle = f64::from(turn) * std::f64::consts::FRAC_PI_4;
            let along = angle.cos() * one + angle.sin() * other;
            let (_, slopes) = footprint.surface(|_| DVec3::ZERO);
            footprint.shift(&model, way_m * along, &slopes);
            let moved_m = footprint.anchor_m() - from_m;
            assert!((0.8 * way_m..1.2 * way_m).contains(&moved_m.dot(along)), "{angle}: {moved_m} m");
            let surface = mesh.shape.surface();
            let nearest_m = surface.at_m(&surface.nearest(footprint.anchor_m()).unwrap());
            assert!(nearest_m.distance(footprint.anchor_m()) < 1e-9, "{angle}: off the surface");
        }
    }

    #[test]
    fn a_surface_is_followed_however_much_it_is_stretched_or_compressed() {
        let along = [DVec3::new(0.9, 0.1, 0.3), DVec3::new(-0.2, 1.1, 0.2)];
        let by = DVec2::new(0.3, -0.7);
        for scale in [1e-4, 1.0, 1e4] {
            let slopes = along.map(|slope| scale * slope);
            let beside_m = by.x * slopes[0] + by.y * slopes[1];
            assert!(within(beside_m, &slopes).distance(by) < 1e-9, "{scale}");
            // What points out of the surface leads nowhere.
            let outward_m = slopes[0].cross(slopes[1]);
            assert!(within(beside_m + outward_m, &slopes).distance(by) < 1e-9, "{scale}");
        }
        // Folded into a line, it has no way to go.
        assert_eq!(within(along[0], &[along[0], -2.0 * along[0]]), DVec2::ZERO);
    }
}
