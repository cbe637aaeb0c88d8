//! The force on a blade.
//!
//! A blade that is in the tissue is coupled to the place of the surface that its edge pierces, across the edge, by a stiff
//! spring. Along the edge it slides freely. The spring bears at most R = Gc·d, with the fracture toughness Gc of the tissue and the
//! depth d of the edge in it: the work of separation of a cut of that depth, for each unit of its way. So a blade first pushes
//! the tissue ahead; beyond R the place slides with it, and the blade cuts (`state::cutting` severs what its edge then crosses). The work of
//! R along that way is the fracture work; what the spring stores comes back. The coupling gives no energy.

use glam::DVec3;
use palpate_haptics::{ContactState, Coupling, TipShape};

use crate::body::model::{Model, Plan, displacement_m};
use crate::kernel::field::{Layout, State};
use crate::kernel::real::Real;
use crate::tools::contact::{ContactForce, Tool};

/// The spring between a blade and the tissue: a resistance of 1 N yields by 0.2 mm before the blade cuts.
const COUPLING: Coupling = Coupling::Spring { stiffness_n_per_m: 5000.0, damping_n_s_per_m: 1.0 };

/// The depth of an edge that lies along the surface is counted as if it rose by at least this part of its length.
const MIN_SLOPE: f64 = 0.1;

/// The search for the place that an edge pierces ends once it moves by less than this part of the disc's radius, or after so many
/// moves.
const NEAR: f64 = 0.1;
const MAX_SEEKS: usize = 8;

/// The disc of a blade without a force stays until the place that the edge pierces is so many of the disc's radii away.
const FOLLOWS: f64 = 1.0;

impl Tool {
    /// Returns how the tool is coupled to the tissue.
    pub(crate) fn coupling(&self) -> Coupling {
        if self.tip.shape == TipShape::Blade { COUPLING } else { self.tip.coupling }
    }

    /// Determines the force of a blade on the tissue, N, at the end of a substep, which ends at `fraction` of the step. A blade that finds no
    /// room to cut only pushes. Where a blade without a force pierces the surface is found once in a step.
    pub(crate) fn resist<T: Real>(
        &mut self,
        model: &Model,
        plan: &Plan,
        layout: &Layout,
        state: &State<T>,
        (fraction, has_room): (f64, bool),
    ) -> ContactForce {
        let place_m = self.place_m(fraction);
        let edge_m = self.from_edge_m.lerp(self.tip.edge_m, fraction);
        let (edge, length_m) = (edge_m.normalize_or_zero(), edge_m.length());
        let is_felt = model.scene.cutting.resistance_n(length_m) > 0.0;
        if !is_felt && !plan.is_first(fraction) {
            return ContactForce::default();
        }
        if self.contact_state == ContactState::Free && plan.is_first(fraction) {
            if is_felt {
                self.seek_pierced(model, layout, state, [place_m, edge_m]);
            } else {
                // Nothing depends on where exactly it is: it follows the edge once that is away.
                let displacement_m = |point| displacement_m(model, layout, state, point);
                let sought_m = place_m + self.pierced_m.clamp(0.0, length_m) * edge;
                let away_m = sought_m.distance(self.footprint.surface(displacement_m).0);
                if away_m > FOLLOWS * self.footprint.radius_m() {
                    self.footprint.leap(model, sought_m, displacement_m);
                    self.footprint.approach(model, sought_m, displacement_m);
                }
            }
        }
        let (surface_m, along) = self.footprint.surface(|point| displacement_m(model, layout, state, point));
        self.normal = self.footprint.outward(&along);
        self.side = Some(1.0);
        let depth_m = along_edge(surface_m - place_m, self.normal, edge).min(length_m);
        // Across the edge from the middle of the disc: where an edge leans on the surface, that is not where it leaves it.
        self.pierced_m = (surface_m - place_m).dot(edge);
        let most_n = model.scene.cutting.resistance_n(depth_m);
        self.resistance_n = most_n;
        let pierced_m = place_m + depth_m * edge;
        let is_beside = self.footprint.is_beside(pierced_m - surface_m, self.normal);
        if depth_m <= 0.0 || is_beside || most_n <= 0.0 || self.footprint.relative_inverse_mass() == 0.0 {
            self.contact_state = ContactState::Free;
            return ContactForce::default();
        }
        if self.contact_state == ContactState::Free {
            // The middle of the disc is somewhere beside the place, where the surface is uneven. The spring begins unstretched.
            self.offset_m = (place_m - surface_m).reject_from(edge);
            self.contact_state = ContactState::Sticking;
            return ContactForce::default();
        }
        let across_m = (place_m - self.offset_m - surface_m).reject_from(edge);
        let thrust = self.thrust(model, plan, layout, state, across_m);
        let (force_n, wanted_n) = (thrust.force_n(), thrust.force_n().length());
        if wanted_n <= most_n || !has_room {
            self.contact_state = ContactState::Sticking;
            return thrust;
        }
        self.contact_state = ContactState::Sliding;
        let ahead = force_n / wanted_n;
        let Coupling::Spring { stiffness_n_per_m, .. } = COUPLING else { return thrust };
        let lag_m = most_n / stiffness_n_per_m;
        // Over the surface, to where the edge leaves it farther on.
        let over = ahead - along_edge(ahead, self.normal, edge) * edge;
        let most_m = self.footprint.stride_m() / over.length();
        let slid_m = (across_m.dot(ahead) - lag_m).max(0.0).min(most_m);
        self.footprint.shift(model, slid_m * over, &along);
        self.separated_j += most_n * slid_m;
        self.kicked_to(most_n * ahead)
    }

    /// Moves the disc of a blade that touches nothing to where its edge pierces the surface: first below the heel, and from
    /// there on to where the edge meets the plane that touches the surface there. `blade_m` are its tip and the way to its heel.
    fn seek_pierced<T: Real>(
        &mut self,
        model: &Model,
        layout: &Layout,
        state: &State<T>,
        [place_m, edge_m]: [DVec3; 2],
    ) {
        let (edge, length_m) = (edge_m.normalize_or_zero(), edge_m.length());
        let displacement_m = |point| displacement_m(model, layout, state, point);
        let mut sought_m = place_m + edge_m;
        for _ in 0..MAX_SEEKS {
            self.footprint.seek(model, sought_m, true, displacement_m);
            let (surface_m, along) = self.footprint.surface(displacement_m);
            let depth_m = along_edge(surface_m - place_m, self.footprint.outward(&along), edge).clamp(0.0, length_m);
            let pierced_m = place_m + depth_m * edge;
            let is_found = pierced_m.distance(sought_m) < NEAR * self.footprint.radius_m();
            if depth_m == 0.0 || is_found {
                return;
            }
            sought_m = pierced_m;
        }
    }
}

/// Returns how far a way leads out of the planes that touch the surface, measured along an edge: for the way from a blade's tip to the
/// surface, how deep the tip is, and less than 0 above it.
fn along_edge(way: DVec3, outward: DVec3, edge: DVec3) -> f64 {
    way.dot(outward) / edge.dot(outward).max(MIN_SLOPE)
}
