//! Cautery: the springs that have been for long enough under a tip that burns.
//!
//! A tip burns the points that its disc covers, the same that it presses or holds, for as long as it touches or holds them. Their times of contact
//! add up, under one tip or several, and stay when the tip goes. A spring is severed in its middle once both of its ends have burnt
//! for as long as the tip that is at one of them takes (`Tip::burn_s`), and springs that resist bending go as in a tear
//! (`tearing`). The anchor spring of a point that has burnt for so long is severed too, if anchors can be (`anchors`).
//!
//! **Solids.** What burns is a cube of the surface, under a rigid tip the one in which a sample that it presses lies. A face is severed once both of
//! its cubes have burnt through. A surface that is turned in the lattice has burnt cubes above each other: so that no cube comes loose, the
//! face towards the deepest neighbour of each stays whole ([`SolidPlaces::deeper_beside`]). From any burnt cube such faces lead inward, to one
//! that no tip burns; a plate that is as thin as a cube burns through. So the depth of a burn is one cube, and what it severs stands across
//! the surface.
//!
//! **Stiffness.** Before that the springs of burnt points become stiffer, if the scene says so (`body::burnt_stiffness`), a level at a time. As with a
//! severed spring, the past forces that a multistep scheme keeps change as if the spring had always been so stiff. What a stretched spring
//! then stores more, the heat has given it. Without a tip that burns nothing is computed.

use std::collections::BTreeMap;

use super::{Crossing, SpringStretch};
use crate::body::model::Model;
use crate::body::solid::SolidPlaces;
use crate::body::spring_ends::SpringEnd;
use crate::body::tables::StiffenedSpring;
use crate::kernel::real::Real;
use crate::state::tissue_state::TissueState;
use crate::tools::contact::Contacts;
use palpate_haptics::ContactState;

impl Model {
    /// Returns whether a face between the cubes of a solid is that to the deepest neighbour of one of both ([`SolidPlaces::deeper_beside`]).
    fn leads_deeper(&self, place: usize, face: &SpringEnd) -> bool {
        let leads = |places: &SolidPlaces, [from, to]: [usize; 2]| places.deeper_beside(from) == Some(to);
        let ends = [place, face.other];
        self.places.solid().is_some_and(|places| leads(places, ends) || leads(places, [ends[1], ends[0]]))
    }
}

impl<T: Real> TissueState<T> {
    /// Burns what lies under tips that burn for a step. Returns the whole springs that this severs; some perhaps twice.
    pub(super) fn burnt(&mut self) -> Vec<Crossing> {
        let TissueState { model, contacts, .. } = self;
        let burning = contacts.tools.iter().filter(|tool| tool.tip.burn_s > 0.0);
        let touching = burning.filter(|tool| tool.contact_state != ContactState::Free);
        let under: Vec<(f64, Vec<usize>)> =
            touching.map(|tool| (tool.tip.burn_s, tool.burning_places(model))).collect();
        if under.is_empty() {
            return Vec::new();
        }
        let burns = &mut contacts.burns;
        // A point under two tips burns once, and as the quicker one has it.
        let mut quickest: BTreeMap<usize, f64> = BTreeMap::new();
        for (burn_s, place) in
            under.iter().flat_map(|(burn_s, places)| places.iter().map(move |place| (*burn_s, *place)))
        {
            quickest.entry(place).and_modify(|least_s| *least_s = least_s.min(burn_s)).or_insert(burn_s);
        }
        burns.add_step(&quickest, model.scene.stepping.rate_hz);
        self.stiffen(quickest.into_keys());
        let TissueState { model, tables, contacts: Contacts { burns, .. }, .. } = &*self;
        let (mut found, mut through) = (Vec::new(), Vec::new());
        for (burn_s, places) in under {
            let is_through = |place| f64::from(burns.steps_at(place)) / model.scene.stepping.rate_hz >= burn_s;
            for place in places.into_iter().filter(|place| is_through(*place)) {
                through.push(place);
                let first_end = model.first_end(place);
                model.each_spring(place, |spring| {
                    let is_severed = || tables.severed.has(first_end + spring.number);
                    if is_through(spring.other) && !is_severed() && !model.leads_deeper(place, &spring) {
                        found.push(Crossing::in_middle(model, place, spring));
                    }
                });
            }
        }
        let bending = self.unspanned(&found);
        found.extend(bending);
        found.extend(through.into_iter().filter_map(|place| self.anchor_in_middle(place)));
        found
    }

    /// Makes the springs of some points as stiff as their burns have made them.
    fn stiffen(&mut self, places: impl Iterator<Item = usize>) {
        let model = self.model.clone();
        if model.scene.cutting.burnt_stiffness() == 1.0 {
            return;
        }
        let mut burnt = self.tables.severed.burnt().clone();
        let mut is_changed = false;
        for place in places {
            let factor = self.contacts.burns.stiffness_at(place, &model);
            if factor != burnt.of_point(place) {
                burnt.set(place, factor);
                is_changed = true;
            }
        }
        if !is_changed {
            return;
        }
        for StiffenedSpring { place, spring, factors: [was, now] } in self.tables.set_burnt(&model, burnt) {
            let SpringStretch { rest_m, delta_m, extension, along } = self.stretch(place, &spring);
            let added_n_per_m = (now - was) * spring.stiffness_n_per_m;
            let force_n = added_n_per_m * along * (rest_m + delta_m);
            self.take_from_history(place, -force_n);
            self.take_from_history(spring.other, force_n);
            self.work.add(0.5 * added_n_per_m * rest_m.length_squared() * extension * extension);
            for place in [place, spring.other] {
                self.tiles.wake_around(model.point_of(place), self.plan.scheme.sweeps());
            }
        }
        // A twin that steps otherwise reaches a level in another step: that is no error of the stepping.
        self.audit_window.give_up();
    }
}

#[cfg(test)]
mod tests;
