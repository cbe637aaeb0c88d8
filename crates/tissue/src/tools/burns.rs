//! What tips have burnt: how long each point has been under one, and which part that is of the time in which it burns through. What burns in
//! a solid is a cube, which is named by its least corner; each of its corners is as burnt as the most burnt cube around it.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::body::burnt_stiffness::{self, BurntStiffness};
use crate::body::model::Model;
use crate::saved::ensure;
use crate::shape::PointId;
use palpate_refusal::Result;

/// A version of burns begins when that of a point reaches another multiple of 1/255: as many levels as a viewer has of a colour.
const LEVELS: f64 = 255.0;

/// Versions in a snapshot are below this, so that counting on does not overflow.
const MAX_VERSION: u32 = u32::MAX / 2;

/// A point that has been under a tip that burns and touches; in a solid a cube.
#[derive(Debug, Clone, Copy, PartialEq)]
struct BurntPlace {
    /// Its place in memory; that of the least corner of a cube.
    place: u32,
    /// For how many steps, 1 or more. Steps have one length, so that the time is exact.
    steps: u32,
    /// The least `Tip::burn_s` of the tips that have burnt it, s; infinite if none is known.
    through_s: f64,
    /// The version of the burns since which it has its level.
    version: u32,
}

impl BurntPlace {
    fn burn(&self, rate_hz: f64) -> f64 {
        (f64::from(self.steps) / rate_hz / self.through_s).min(1.0)
    }

    fn stiffness(&self, model: &Model) -> f64 {
        burnt_stiffness::of_point(model.scene.cutting.burnt_stiffness(), self.burn(model.scene.stepping.rate_hz))
    }

    fn level(&self, rate_hz: f64) -> f64 {
        (LEVELS * self.burn(rate_hz)).floor()
    }
}

/// What tips have burnt of a tissue ([`Tissue::burns`](crate::Tissue::burns)). Clones share the list.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Burns {
    /// By ascending place.
    places: Arc<Vec<BurntPlace>>,
    version: u32,
    /// The version since which points were burnt only, and none became as it was before.
    grows_since: u32,
}

/// A burnt point ([`Burns::points`]).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BurntPoint {
    /// The point.
    pub point: PointId,
    /// Its time of contact divided by that in which it burns through, above 0; 1: it has burnt through. Under several tips the shortest time
    /// counts. In a solid, where cells burn, that of the most burnt cell around the point.
    pub burn: f64,
    /// The version of the burns since which a viewer sees it so: its burn has passed no multiple of 1/255 since.
    pub version: u32,
}

impl Burns {
    /// Returns the version of the burns: 0 while nothing is burnt. It grows by 1 with each step in which the burn of a point reaches another
    /// multiple of 1/255, and when the guard goes back to before a burn; it never falls.
    pub fn version(&self) -> u32 {
        self.version
    }

    /// Returns whether a viewer that knows the burns of version `since` needs only those of later versions; otherwise it needs all, because
    /// since then the guard has undone a burn, or the session was restored.
    pub fn continues(&self, since: u32) -> bool {
        (self.grows_since..=self.version).contains(&since)
    }

    /// Returns whether nothing is burnt.
    pub fn is_empty(&self) -> bool {
        self.places.is_empty()
    }

    /// Returns the burnt points, each once; in a solid the corners of burnt cells. `model` is that of the tissue.
    pub fn points(&self, model: &Model) -> impl Iterator<Item = BurntPoint> + use<> {
        let rate_hz = model.scene.stepping.rate_hz;
        let mut points: Vec<BurntPoint> = Vec::with_capacity(self.places.len());
        for burnt in &*self.places {
            let (burn, version) = (burnt.burn(rate_hz), burnt.version);
            let mut add = |place: usize| points.push(BurntPoint { point: model.point_at(place), burn, version });
            match model.places.solid() {
                Some(places) => places.corners_of(burnt.place as usize).into_iter().for_each(&mut add),
                None => add(burnt.place as usize),
            }
        }
        if model.places.solid().is_some() {
            // The most burnt first; of equal ones the one that has been so for longest.
            points.sort_by(|a, b| {
                (a.point.index().cmp(&b.point.index())).then(b.burn.total_cmp(&a.burn)).then(a.version.cmp(&b.version))
            });
            points.dedup_by_key(|burnt| burnt.point);
        }
        points.into_iter()
    }

    /// Returns the memory that the burns of a session may take, bytes: its own, those of the guard's checkpoint, of a snapshot, and those
    /// that others read. `model` is that of the tissue.
    pub fn most_bytes(model: &Model) -> u64 {
        const LISTS: u64 = 4;
        let places = model.places.solid().map_or_else(|| model.place_count(), |places| places.count());
        LISTS * places as u64 * size_of::<BurntPlace>() as u64
    }

    /// Returns the number of steps for which the point at a place in memory has burnt.
    pub(crate) fn steps_at(&self, place: usize) -> u32 {
        self.found(place).map_or(0, |at| self.places[at].steps)
    }

    /// Returns the factor of the stiffness of the point at a place in memory. `model` is that of the tissue.
    pub(crate) fn stiffness_at(&self, place: usize, model: &Model) -> f64 {
        self.found(place).map_or(1.0, |at| self.places[at].stiffness(model))
    }

    /// Returns the points that these burns make stiffer. `model` is that of the tissue.
    pub(crate) fn stiffness(&self, model: &Model) -> BurntStiffness {
        BurntStiffness::of(self.places.iter().map(|burnt| (burnt.place, burnt.stiffness(model))))
    }

    /// Adds a step to the points at places in memory, each with the time in which it burns through there, s.
    #[allow(clippy::cast_possible_truncation)]
    pub(crate) fn add_step(&mut self, under: &BTreeMap<usize, f64>, rate_hz: f64) {
        let (version, mut is_seen) = (self.version.saturating_add(1), false);
        for (place, through_s) in under {
            let found = self.found(*place);
            let places = Arc::make_mut(&mut self.places);
            let at = found.unwrap_or_else(|at| {
                let untouched = BurntPlace { place: *place as u32, steps: 0, through_s: f64::INFINITY, version };
                places.insert(at, untouched);
                at
            });
            let burnt = &mut places[at];
            let level = burnt.level(rate_hz);
            burnt.steps = burnt.steps.saturating_add(1);
            burnt.through_s = burnt.through_s.min(*through_s);
            if burnt.level(rate_hz) > level {
                (burnt.version, is_seen) = (version, true);
            }
        }
        if is_seen {
            self.version = version;
        }
    }

    fn found(&self, place: usize) -> std::result::Result<usize, usize> {
        self.places.binary_search_by_key(&place, |burnt| burnt.place as usize)
    }

    /// Makes what is burnt that of an earlier state, in a new version if that changes anything.
    pub(crate) fn go_back_to(&mut self, earlier: &Self) {
        let state = |burns: &Self| burns.saved().into_iter().zip(burns.saved_times()).collect::<Vec<_>>();
        if Arc::ptr_eq(&self.places, &earlier.places) || state(self) == state(earlier) {
            return;
        }
        let version = self.version.max(earlier.version).saturating_add(1);
        *self = Burns { places: earlier.places.clone(), version, grows_since: version };
    }

    /// Adds what the next steps depend on to a hash: nothing if nothing is burnt.
    pub(crate) fn hash(&self, add: &mut impl FnMut(&[u8])) {
        for BurntPlace { place, steps, .. } in &*self.places {
            add(&place.to_le_bytes());
            add(&steps.to_le_bytes());
        }
    }

    /// Returns the places and their steps.
    pub(crate) fn saved(&self) -> Vec<(u32, u32)> {
        self.places.iter().map(|burnt| (burnt.place, burnt.steps)).collect()
    }

    /// Returns the time in which the point at each place burns through, s.
    pub(crate) fn saved_times(&self) -> Vec<f64> {
        self.places.iter().map(|burnt| burnt.through_s).collect()
    }

    /// Restores what was burnt, in this version. `times` is empty in snapshots that have none: then no burn is known until the next tip
    /// touches the point.
    pub(crate) fn restored(saved: &[(u32, u32)], times: &[f64], version: u32, model: &Model) -> Result<Self> {
        ensure(saved.is_sorted_by(|a, b| a.0 < b.0), "burnt points out of order")?;
        let is_place = |place: usize| place < model.place_count() && model.is_spring_end(place);
        let is_sound = |(place, steps): &(u32, u32)| is_place(*place as usize) && *steps > 0;
        ensure(saved.iter().all(is_sound), "a burnt point that is not of the tissue")?;
        ensure(times.is_empty() || times.len() == saved.len(), "burnt points without their times")?;
        ensure(times.iter().all(|through_s| *through_s > 0.0), "a burnt point without a time")?;
        ensure(version < MAX_VERSION, "a version of the burns beyond what any session has")?;
        let times = times.iter().copied().chain(std::iter::repeat(f64::INFINITY));
        let burnt = |(&(place, steps), through_s)| BurntPlace { place, steps, through_s, version };
        let places = Arc::new(saved.iter().zip(times).map(burnt).collect());
        Ok(Burns { places, version, grows_since: version })
    }
}
