//! The springs of a tissue that have been severed. They are part of its state: the model never changes.
//!
//! A spring is known by its first end (the one with the lower place in memory) and by its number among the springs of that
//! end ([`Model::springs_at`]). In a solid, the face between two cubes stands for a spring between their middles, whose ends are
//! at the cubes' least corners; what follows from severed faces is in `solid::corner_copies`. An anchor spring of a surface
//! has one end in the tissue, which stands for both, and a number of its own ([`ANCHOR`]). Each change of the set has a version, which only grows: also if the guard goes back to a
//! checkpoint and so undoes a cut.

use std::ops::Deref;
use std::sync::Arc;

use glam::DVec3;
use xxhash_rust::xxh3::Xxh3;

use crate::body::burnt_stiffness::BurntStiffness;
use crate::body::model::Model;
use crate::body::solid::corner_copies::{CornerCopies, DoubledCorner};
use crate::saved::{SavedSpring, ensure, unsound};
use crate::shape::PointId;
use palpate_haptics::ReportedSpring;
use palpate_refusal::Result;

/// Versions in a snapshot are below this, so that counting on does not overflow.
const MAX_VERSION: u32 = u32::MAX / 2;

/// The extra K″/m of a point without an anchor spring, divided by the reference value.
pub(crate) const NO_ANCHOR: f64 = -1.0;

/// The number of the anchor spring of a point, beside those of its other springs.
pub(crate) const ANCHOR: u32 = u32::MAX;

/// A severed spring.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct SeveredSpring {
    /// The places of its ends, ascending; of an anchor spring, that of its point twice.
    pub(crate) ends: [u32; 2],
    /// Its number among the springs of the first end, or [`ANCHOR`].
    pub(crate) number: u32,
    /// Where it was severed: the part of the way from the first end to the second, 0 to 1.
    pub(crate) part: f64,
    /// The version of the topology since which it is severed.
    pub(crate) version: u32,
}

/// The severed springs of a tissue, in the order in which they were severed, and how stiff burns have made the others. Clones share the lists.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Cuts {
    springs: Arc<Vec<SeveredSpring>>,
    /// How many of them are anchor springs.
    anchors: usize,
    version: u32,
    /// The version since which springs were severed only, and none became whole again.
    grows_since: u32,
    /// The energy that has gone into separation, J ([`Cuts::fracture_j`]).
    fracture_j: f64,
    /// The corners of a solid that these cuts double; `None` without any, and for other tissues.
    copies: Option<Arc<CornerCopies>>,
    /// The points that burns have made stiffer: a function of the tissue's burns. They are no part of the topology and its versions.
    burnt: BurntStiffness,
}

/// A spring that is severed, by its points ([`Cuts::joints`]).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeveredJoint {
    /// The points that it joined. In a solid: the least corners of two cubes with a severed face between them.
    pub points: [PointId; 2],
    /// Where it was severed: the part of the way from the first point to the second, 0 to 1.
    pub part: f64,
    /// The version of the topology since which it is severed.
    pub version: u32,
}

impl Cuts {
    /// Returns the version of the topology: 0 while the tissue is as its model has it. It grows by 1 with each step in which anything is
    /// severed, and when the guard goes back to before a cut; it never falls.
    pub fn version(&self) -> u32 {
        self.version
    }

    /// Returns whether a client that knows the springs of version `since` needs only those of later versions; otherwise it needs all,
    /// because since then the guard has undone a cut, or the session was restored.
    pub fn continues(&self, since: u32) -> bool {
        (self.grows_since..=self.version).contains(&since)
    }

    /// Returns whether this is a clone of the same cuts. Cheap; other cuts with equal springs are not the same.
    pub fn is_same(&self, other: &Self) -> bool {
        self.version == other.version && Arc::ptr_eq(&self.springs, &other.springs)
    }

    /// Returns the number of severed springs, anchor springs included.
    pub fn len(&self) -> usize {
        self.springs.len()
    }

    /// Returns the number of severed anchor springs.
    pub fn anchor_count(&self) -> usize {
        self.anchors
    }

    /// Returns the number of severed springs between points, those of [`Cuts::joints`].
    pub fn joint_count(&self) -> usize {
        self.springs.len() - self.anchors
    }

    /// Returns the energy that has gone into separation, J: the work of blades at their edges, Gc for each unit of area that they cut,
    /// and what severed springs had stored. (Severing a face between the cells of a solid sets no energy free.)
    pub fn fracture_j(&self) -> f64 {
        self.fracture_j
    }

    /// Returns whether the tissue is whole.
    pub fn is_empty(&self) -> bool {
        self.springs.is_empty()
    }

    /// Returns the severed springs between points, in the order in which they were severed: all but anchor springs. `model` is that of the
    /// tissue.
    pub fn joints(&self, model: &Model) -> Vec<SeveredJoint> {
        let of = |spring: &SeveredSpring| SeveredJoint {
            points: spring.ends.map(|place| model.point_at(place as usize)),
            part: spring.part,
            version: spring.version,
        };
        self.springs.iter().filter(|spring| !spring.is_anchor()).map(of).collect()
    }

    /// Returns the severed springs from number `from` of their order on, anchor springs included, by the names that they have in a snapshot,
    /// each with the version of the topology since which it is severed.
    pub fn reported(&self, from: usize) -> impl Iterator<Item = (ReportedSpring, u32)> {
        self.springs.iter().skip(from).map(|spring| {
            let SeveredSpring { ends: [place, _], number, part, version } = *spring;
            (ReportedSpring { place, number, part }, version)
        })
    }

    /// Returns whether a severed spring rests within a distance of a place, m, its first end, in a solid the lower of the two cubes; or a
    /// point that a burn has made stiffer.
    pub(crate) fn are_near(&self, model: &Model, place_m: DVec3, within_m: f64) -> bool {
        let first_ends = self.springs.iter().map(|spring| spring.ends[0] as usize);
        first_ends.chain(self.burnt.places()).any(|place| model.end_at_rest_m(place).distance(place_m) <= within_m)
    }

    /// Returns the points that burns have made stiffer.
    pub(crate) fn burnt(&self) -> &BurntStiffness {
        &self.burnt
    }

    /// Returns whether all springs are as the model has them.
    pub(crate) fn are_none(&self) -> bool {
        self.is_empty() && self.burnt.is_empty()
    }

    /// Returns these cuts in a tissue with such burns.
    pub(crate) fn burnt_by(self, burnt: BurntStiffness) -> Self {
        Cuts { burnt, ..self }
    }

    /// Returns the number of parts into which the severed springs divide the tissue: 1 for one that is whole. Points that the model
    /// joins to no other do not count. Looks at all springs. `model` is that of the tissue.
    #[allow(clippy::cast_possible_truncation)]
    pub fn pieces(&self, model: &Model) -> usize {
        let (severed, count) = (Severed::of(self, model), model.place_count());
        let mut parents: Vec<u32> = (0..count as u32).collect();
        let mut is_joined = vec![false; count];
        let mut joints = 0;
        for place in 0..count {
            model.each_spring(place, |spring| {
                if spring.other < place {
                    return;
                }
                is_joined[place] = true;
                is_joined[spring.other] = true;
                if severed.has(model.first_end(place) + spring.number) {
                    return;
                }
                let [one, other] = [place, spring.other].map(|place| root(&mut parents, place as u32));
                if one != other {
                    parents[one.max(other) as usize] = one.min(other);
                    joints += 1;
                }
            });
        }
        (is_joined.into_iter().filter(|joined| *joined).count() - joints).max(1)
    }

    /// Returns the severed springs.
    pub(crate) fn springs(&self) -> &[SeveredSpring] {
        &self.springs
    }

    /// Returns how many springs at the beginning of the list `other` has as well.
    pub(crate) fn shared_with(&self, other: &Self) -> usize {
        if Arc::ptr_eq(&self.springs, &other.springs) {
            return self.springs.len();
        }
        self.springs.iter().zip(&*other.springs).take_while(|(one, other)| one == other).count()
    }

    /// Returns the cuts of the first `count` springs, into which `fracture_j` had gone then.
    pub(crate) fn first(&self, count: usize, fracture_j: f64, model: &Model) -> Self {
        let mut first = Severed::default();
        for spring in &self.springs[..count.min(self.springs.len())] {
            first.add(model, *spring);
        }
        let version = self.springs[..first.len()].last().map_or(0, |last| last.version);
        Cuts { version, grows_since: self.grows_since, fracture_j, ..first.cuts }
    }

    /// Returns the doubled corners of a solid; `None` if nothing is severed, and for other tissues.
    pub(crate) fn copies(&self) -> Option<&Arc<CornerCopies>> {
        self.copies.as_ref()
    }

    /// Returns where the corners of a cell of a solid are in [`Tissue::shown_displacements_m`](crate::Tissue::shown_displacements_m), x before
    /// y before z, if a cut has doubled any of them. `least` is the place of its least corner there.
    pub fn doubled_corners(&self, least: u32) -> Option<[u32; 8]> {
        self.copies.as_ref()?.cut_corners(least as usize)
    }

    /// Returns the version of the topology since which two cells of a solid no longer share a corner that they have in common; `None` if
    /// they share all, and for other tissues. Cells are given by the places of their least corners, as in [`Cuts::doubled_corners`].
    pub fn cells_apart_since(&self, model: &Model, cells: [u32; 2]) -> Option<u32> {
        let (copies, places) = (self.copies.as_ref()?, model.places.solid()?);
        copies.apart_since(places, cells.map(|cell| cell as usize))
    }

    /// Returns whether one more spring can be severed: a solid has spare places for so many doubled corners.
    pub fn has_room(&self, model: &Model) -> bool {
        match (&self.copies, model.places.solid()) {
            (Some(copies), _) => copies.has_room(),
            (None, Some(places)) => CornerCopies::fits_in(places),
            (None, None) => true,
        }
    }

    /// Adds the springs to the hash of a tissue; nothing if none is severed.
    pub(crate) fn hash(&self, hasher: &mut Xxh3) {
        for SeveredSpring { ends: [place, _], number, part, .. } in &*self.springs {
            hasher.update(&place.to_le_bytes());
            hasher.update(&number.to_le_bytes());
            hasher.update(&part.to_bits().to_le_bytes());
        }
    }

    /// Converts the springs to plain data.
    pub(crate) fn saved(&self) -> Vec<SavedSpring> {
        let of = |spring: &SeveredSpring| SavedSpring {
            place: spring.ends[0],
            number: spring.number,
            part: spring.part,
            version: spring.version,
        };
        self.springs.iter().map(of).collect()
    }

    /// Checks saved springs and returns them; `version` is that of the topology, and `fracture_j` has gone into them.
    pub(crate) fn restored(saved: &[SavedSpring], version: u32, fracture_j: f64, model: &Model) -> Result<Self> {
        ensure(version < MAX_VERSION, "a version of the topology beyond what any session has")?;
        let mut severed = Severed::default();
        for SavedSpring { place, number, part, version: since } in saved.iter().copied() {
            let last = severed.springs.last().map_or(1, |last| last.version);
            ensure((last..=version).contains(&since), "a severed spring of another version of the topology")?;
            let spring = SeveredSpring::named(model, ReportedSpring { place, number, part }, since)?;
            ensure(severed.has_room(model), "more severed springs than the tissue has room for")?;
            ensure(severed.add(model, spring).is_some(), "a spring that is severed twice")?;
        }
        Ok(Cuts { version, grows_since: version, fracture_j, ..severed.cuts })
    }
}

impl Model {
    /// Returns the memory that severed springs of a session may take, bytes: five lists of all springs (its own, the
    /// guard's checkpoint's, the one that others read, the one whose surface was shown last, and that of force laws), and their marks. Sheets and surfaces have no more springs
    /// to sever; in a solid the doubled corners come from the spare places of a state.
    pub fn cut_bytes(&self) -> u64 {
        const LISTS: u64 = 5;
        let anchors = if self.scene.cutting.anchor_depth_m.is_some() { self.place_count() as u64 } else { 0 };
        let (springs, ends) = (self.end_count() as u64 / 2 + anchors, self.end_count() as u64 + anchors);
        let burnt =
            if self.scene.cutting.burnt_stiffness() > 1.0 { BurntStiffness::bytes(self.place_count()) } else { 0 };
        LISTS * (springs * size_of::<SeveredSpring>() as u64 + burnt) + ends / 8
    }
}

/// The severed springs of a tissue, and at which ends of springs they are.
#[derive(Debug, Clone, Default)]
pub(crate) struct Severed {
    cuts: Cuts,
    /// A bit for each spring at each of its ends; empty if nothing is severed.
    ends: Vec<u64>,
    /// A bit for the anchor spring of each place; empty if none is severed.
    anchors: Vec<u64>,
}

impl Deref for Severed {
    type Target = Cuts;

    fn deref(&self) -> &Cuts {
        &self.cuts
    }
}

impl Severed {
    /// Returns the set of some severed springs.
    pub(crate) fn of(cuts: &Cuts, model: &Model) -> Self {
        let mut severed = Severed::default();
        severed.replace(model, cuts);
        severed
    }

    /// Returns the severed springs.
    pub(crate) fn cuts(&self) -> &Cuts {
        &self.cuts
    }

    /// Returns whether a spring is severed, by the number of its end among those of all places ([`Model::first_end`]).
    #[inline(always)]
    pub(crate) fn has(&self, end: usize) -> bool {
        self.ends.get(end / 64).is_some_and(|bits| bits >> (end % 64) & 1 != 0)
    }

    /// Returns the factor of the stiffness of a spring between two places, by the number of its end among those of all places; 0: it is severed.
    #[inline(always)]
    pub(crate) fn factor(&self, end: usize, places: [usize; 2]) -> f64 {
        if self.has(end) { 0.0 } else { self.cuts.burnt.of_spring(places) }
    }

    /// Sets the points that burns have made stiffer.
    pub(crate) fn set_burnt(&mut self, burnt: BurntStiffness) {
        self.cuts.burnt = burnt;
    }

    /// Returns whether the anchor spring of the point at a place in memory is severed.
    #[inline(always)]
    pub(crate) fn has_anchor(&self, place: usize) -> bool {
        self.anchors.get(place / 64).is_some_and(|bits| bits >> (place % 64) & 1 != 0)
    }

    /// Returns K″/m at a place in memory divided by the reference value, minus 1, from that of the model.
    #[inline(always)]
    pub(crate) fn extra_anchor(&self, of_model: f64, place: usize) -> f64 {
        if self.has_anchor(place) { NO_ANCHOR } else { of_model }
    }

    /// Returns whether a spring is severed.
    fn has_spring(&self, model: &Model, spring: &SeveredSpring) -> bool {
        if spring.is_anchor() { self.has_anchor(spring.ends[0] as usize) } else { self.has(spring.ends_of(model)[0]) }
    }

    /// Adds a spring. Returns the corners that this doubles, if the spring was whole.
    pub(crate) fn add(&mut self, model: &Model, spring: SeveredSpring) -> Option<Vec<DoubledCorner>> {
        if self.has_spring(model, &spring) {
            return None;
        }
        self.mark(model, &spring, true);
        self.cuts.anchors += usize::from(spring.is_anchor());
        Arc::make_mut(&mut self.cuts.springs).push(spring);
        Some(self.double(model, &spring))
    }

    /// Doubles the corners that a severed face sets free.
    fn double(&mut self, model: &Model, face: &SeveredSpring) -> Vec<DoubledCorner> {
        let Some(places) = model.places.solid() else { return Vec::new() };
        let mut copies = self.cuts.copies.take().unwrap_or_else(|| Arc::new(CornerCopies::none(places)));
        let is_severed = |cube: usize, axis: usize| self.has(model.first_end(cube) + 2 * axis);
        let face_of = (face.ends[0] as usize, face.number as usize / 2);
        let doubled = Arc::make_mut(&mut copies).sever(places, face_of, face.version, is_severed);
        self.cuts.copies = Some(copies);
        doubled
    }

    /// Adds energy that goes into separation, J.
    pub(crate) fn add_fracture(&mut self, energy_j: f64) {
        self.cuts.fracture_j += energy_j;
    }

    /// Begins a version of the topology.
    pub(crate) fn begin_version(&mut self, version: u32) {
        self.cuts.version = version;
    }

    /// Makes the severed springs those of `cuts`, in a new version if that changes anything. Returns the springs that are whole again, and
    /// those that no longer are.
    pub(crate) fn replace(&mut self, model: &Model, cuts: &Cuts) -> [Vec<SeveredSpring>; 2] {
        let shared = self.cuts.shared_with(cuts);
        let changed = [&self.cuts, cuts].map(|cuts| cuts.springs[shared..].to_vec());
        let [whole, severed] = &changed;
        whole.iter().for_each(|spring| self.mark(model, spring, false));
        severed.iter().for_each(|spring| self.mark(model, spring, true));
        let is_same = whole.is_empty() && severed.is_empty();
        let version = (self.cuts.version + u32::from(!is_same)).max(cuts.version);
        let grows_since = if is_same { self.cuts.grows_since.max(cuts.grows_since) } else { version };
        self.cuts = Cuts { version, grows_since, ..cuts.clone() };
        changed
    }

    /// Sets the bits of a spring.
    fn mark(&mut self, model: &Model, spring: &SeveredSpring, is_severed: bool) {
        if spring.is_anchor() {
            return set_bit(&mut self.anchors, model.place_count(), spring.ends[0] as usize, is_severed);
        }
        for end in spring.ends_of(model) {
            set_bit(&mut self.ends, model.end_count(), end, is_severed);
        }
    }
}

impl SeveredSpring {
    /// Returns the spring of a name, severed since a version of the topology.
    ///
    /// # Errors
    /// Refuses a spring that the tissue lacks, and a part of its way that is not from 0 to 1.
    pub(crate) fn named(model: &Model, spring: ReportedSpring, version: u32) -> Result<Self> {
        let ReportedSpring { place, number, part } = spring;
        ensure((0.0..=1.0).contains(&part), "a spring severed beyond its ends")?;
        ensure((place as usize) < model.place_count(), "a severed spring at a place that the tissue lacks")?;
        if number == ANCHOR {
            ensure(model.has_severable_anchor(place as usize), "a severed anchor spring that the tissue lacks")?;
            return Ok(SeveredSpring::anchor(place as usize, part, version));
        }
        let found = model.springs_at(place as usize).into_iter().find(|spring| spring.number == number as usize);
        let other = found.map(|spring| spring.other).filter(|other| *other > place as usize);
        let other = other.and_then(|other| u32::try_from(other).ok());
        let other = other.ok_or_else(|| unsound("a severed spring that the tissue lacks"))?;
        Ok(SeveredSpring { ends: [place, other], number, part, version })
    }

    /// Returns the severed anchor spring of the point at a place in memory. `part` is that of the way from the point to where it is
    /// attached.
    #[allow(clippy::cast_possible_truncation)]
    pub(crate) fn anchor(place: usize, part: f64, version: u32) -> Self {
        SeveredSpring { ends: [place as u32; 2], number: ANCHOR, part, version }
    }

    pub(crate) fn is_anchor(&self) -> bool {
        self.number == ANCHOR
    }

    /// Returns the numbers of both of its ends among those of all places.
    fn ends_of(&self, model: &Model) -> [usize; 2] {
        let [first, second] = self.ends.map(|place| place as usize);
        let number = self.number as usize;
        [model.first_end(first) + number, model.first_end(second) + model.number_at_other_end(first, number)]
    }
}

/// Sets or clears one of `count` bits.
fn set_bit(bits: &mut Vec<u64>, count: usize, which: usize, is_set: bool) {
    if bits.is_empty() {
        bits.resize(count.div_ceil(64), 0);
    }
    let bit = 1 << (which % 64);
    if is_set { bits[which / 64] |= bit } else { bits[which / 64] &= !bit }
}

/// Returns the first place of the part to which a place belongs, and shortens the way to it.
fn root(parents: &mut [u32], mut place: u32) -> u32 {
    while parents[place as usize] != place {
        let above = parents[parents[place as usize] as usize];
        parents[place as usize] = above;
        place = above;
    }
    place
}
